"""Table 3.1: which stiffness and damping are a free-free frequency and a share of critical damping?

``K = I (2 pi f)^2`` and ``c = zeta 2 sqrt(K I)`` (seed paper eqs. [7], [8]) with the reduced inertia ``I = I_a I_cb /
(I_a + I_cb)`` about the joint. The paper does not print its inertias, but its table holds one number of them: every row
has ``K / f^2 = 693.6``. With it all numbers follow to the last digit printed, where halves are rounded up (3511.35 to
3511.4) and the damping study's row is taken in multiples of its first entry as printed (40 x 2.7597 = 110.388, where
eq. [8] gives 110.390). The vehicle's own inertia gives a second set.
"""

from __future__ import annotations

from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pandas as pd

from flightmodel.vehicle import Vehicle

PAPER_STIFFNESS_OVER_HZ2 = 693.6
PAPER_REDUCED_INERTIA_KGM2 = PAPER_STIFFNESS_OVER_HZ2 / (2.0 * np.pi) ** 2
STUDY_HZ, STUDY_RATIO = 2.5, 0.005
# frequency Hz, K N m/rad, 0.5 % c* N m s/rad as printed
PAPER_STIFFNESS = (
    (2.0, "2774.4", "2.2078"),
    (2.25, "3511.4", "2.4838"),
    (2.5, "4335.0", "2.7597"),
    (3.0, "6242.4", "3.3117"),
    (4.0, "11098", "4.4156"),
)
# damping ratio, zeta c* at 2.5 Hz as printed (the paper's row is headed c*)
PAPER_DAMPING = (
    (0.005, "2.7597"),
    (0.01, "5.5194"),
    (0.025, "13.799"),
    (0.05, "27.597"),
    (0.10, "55.194"),
    (0.20, "110.388"),
)


def stiffness_nmprad(frequency_hz: float, inertia_kgm2: float = PAPER_REDUCED_INERTIA_KGM2) -> float:
    """Bending stiffness of a free-free frequency (seed paper eq. [7])."""
    return float(inertia_kgm2 * (2.0 * np.pi * frequency_hz) ** 2)


def damping_nmsprad(ratio: float, frequency_hz: float, inertia_kgm2: float = PAPER_REDUCED_INERTIA_KGM2) -> float:
    """Damping that is a share of critical (seed paper eq. [8])."""
    return float(ratio * 2.0 * np.sqrt(stiffness_nmprad(frequency_hz, inertia_kgm2) * inertia_kgm2))


def reduced_inertia_kgm2(vehicle: Vehicle) -> float:
    """Reduced transverse inertia of a vehicle about its joint."""
    shell, body = vehicle.transverse_inertia_about_joint()
    return shell * body / (shell + body)


def _as_printed(value: Decimal, printed: str) -> str:
    """Round to as many places as the paper prints, halves up."""
    return str(value.quantize(Decimal(printed), ROUND_HALF_UP))


def table_3_1(vehicle: Vehicle) -> pd.DataFrame:
    """Table 3.1 as printed; as it follows from the paper's 693.6; by eqs. [7], [8], with its and the vehicle's inertia.

    Columns ``study, frequency_hz, damping_percent, quantity, unit, paper, ours, agrees, equation, vehicle``; ``paper``
    and ``ours`` are text, digit for digit.
    """
    own = reduced_inertia_kgm2(vehicle)
    rows: list[tuple[str, float, float, str, str, str, str, float, float]] = []
    for hz, stiffness, damping in PAPER_STIFFNESS:
        k, c = Decimal(str(PAPER_STIFFNESS_OVER_HZ2)) * Decimal(str(hz)) ** 2, damping_nmsprad(STUDY_RATIO, hz)
        for quantity, unit, printed, exact, value, theirs in (
            ("K", "N m/rad", stiffness, k, stiffness_nmprad(hz), stiffness_nmprad(hz, own)),
            ("0.5 % c*", "N m s/rad", damping, Decimal(repr(c)), c, damping_nmsprad(STUDY_RATIO, hz, own)),
        ):
            rounded = _as_printed(exact, printed)
            rows.append(("stiffness", hz, 100 * STUDY_RATIO, quantity, unit, printed, rounded, value, theirs))
    first = Decimal(_as_printed(Decimal(repr(damping_nmsprad(STUDY_RATIO, STUDY_HZ))), PAPER_DAMPING[0][1]))
    for ratio, printed in PAPER_DAMPING:
        rounded = _as_printed(first * Decimal(str(ratio)) / Decimal(str(STUDY_RATIO)), printed)
        values = damping_nmsprad(ratio, STUDY_HZ), damping_nmsprad(ratio, STUDY_HZ, own)
        rows.append(("damping", STUDY_HZ, 100 * ratio, "zeta c*", "N m s/rad", printed, rounded, *values))
    columns = ["study", "frequency_hz", "damping_percent", "quantity", "unit", "paper", "ours", "equation", "vehicle"]
    table = pd.DataFrame(rows, columns=columns)
    table.insert(7, "agrees", table["ours"] == table["paper"])
    return table

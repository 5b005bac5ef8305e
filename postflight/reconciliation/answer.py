"""A reconciled joint in an engineer's units: table with intervals, deflection, lines for a vehicle file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.stats import norm

from flightmodel.checks import FloatArray
from flightmodel.deflection import DeflectionHistory, history_from_lateral, lv_clock
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.candidate import (
    DAMPING_LOG_SD,
    FREEPLAY_SD_RAD,
    HARDENING_SD,
    OFFSET_SD_M,
    STIFFNESS_LOG_SD,
    WINDOWS,
)
from postflight.reconciliation.fit import Reconciled
from postflight.reconciliation.problem import BENDING, MOTION

INTERVAL = 0.90
DIFFERENCE = 1e-4  # of a standard deviation of the prior


def _damping_ratio(vehicle: Vehicle) -> float:
    return vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()


# name, unit, value of a vehicle, and whether it is positive and known to a factor
QUANTITIES: tuple[tuple[str, str, Callable[[Vehicle], float], bool], ...] = (
    ("bending stiffness", "N m/rad", lambda v: v.joint.bending_stiffness_nmprad, True),
    ("free-free frequency", "Hz", lambda v: v.free_free_frequency_hz(), True),
    ("damping", "N m s/rad", lambda v: v.joint.bending_damping_nmsprad, True),
    ("damping ratio", "", _damping_ratio, True),
    ("c.g. offset y", "cm", lambda v: 100.0 * float(v.cg_m[1]), False),
    ("c.g. offset z", "cm", lambda v: 100.0 * float(v.cg_m[2]), False),
    ("c.g. offset", "cm", lambda v: 100.0 * float(np.hypot(*v.cg_m[1:])), False),
    ("c.g. offset's clock", "deg LV", lambda v: float(np.rad2deg(lv_clock(v.cg_m[1:]))), False),
)


def joint_table(found: Reconciled) -> pd.DataFrame:
    """One row a quantity: ``quantity, unit, told, found, sd, low, high`` (90 % interval).

    What is known to a factor has its sd and interval from the logarithm.
    """
    unknown, x = found.problem.unknown, found.unknowns.vehicle
    n = len(x)
    covariance = found.covariance[:n, :n]
    reach = float(norm.ppf(0.5 + 0.5 * INTERVAL))
    told, best = unknown.vehicle(np.zeros(n)), unknown.vehicle(x)
    moved = [[unknown.vehicle(x + side * DIFFERENCE * unit) for side in (-1.0, 1.0)] for unit in np.eye(n)]
    rows = []
    for name, unit, value, by_factor in QUANTITIES:
        f = (lambda v, g=value: float(np.log(g(v)))) if by_factor else value
        slope = np.array([(f(high) - f(low)) / (2.0 * DIFFERENCE) for low, high in moved])
        sd, at = float(np.sqrt(slope @ covariance @ slope)), f(best)
        low, high = at - reach * sd, at + reach * sd
        if by_factor:
            low, high, sd = float(np.exp(low)), float(np.exp(high)), float(np.exp(at)) * sd
        rows.append((name, unit, value(told), value(best), sd, low, high))
    for name, label, unit, scale, start in (
        ("static stability", "static stability", "", unknown.told.uncertainty.cm, 1.0),
        ("freeplay", "freeplay", "deg", float(np.rad2deg(FREEPLAY_SD_RAD)), 0.0),
        ("hardening", "hardening at 4 deg", "", HARDENING_SD, 0.0),
    ):
        if name in unknown.names:
            k = unknown.names.index(name)
            at, sd = start + scale * float(x[k]), scale * float(np.sqrt(covariance[k, k]))
            at = abs(at) if name == "freeplay" else at  # either sign of the unknown is the same band
            rows.append((label, unit, start, at, sd, at - reach * sd, at + reach * sd))
    return pd.DataFrame(rows, columns=["quantity", "unit", "told", "found", "sd", "low", "high"])


def found_sd(found: Reconciled) -> tuple[tuple[float, float], float, float]:
    """One sd: of stiffness and damping (logarithms), of the offset's sides (their mean), m, of the stability."""
    names = found.problem.unknown.names
    sd = dict(zip(names, np.sqrt(np.diag(found.covariance)[: len(names)]).tolist(), strict=True))
    offset = float(OFFSET_SD_M * np.hypot(sd["offset y"], sd["offset z"]) / np.sqrt(2.0))
    joint = STIFFNESS_LOG_SD * sd["stiffness"], DAMPING_LOG_SD * sd["damping"]
    return joint, offset, found.problem.unknown.told.uncertainty.cm * sd["static stability"]


def correlations(found: Reconciled) -> pd.DataFrame:
    """Correlation of the unknowns of the vehicle, those sought first."""
    names = found.problem.unknown.names
    covariance = found.covariance[: len(names), : len(names)]
    sd = np.sqrt(np.diag(covariance))
    return pd.DataFrame(covariance / np.outer(sd, sd), columns=list(names)).assign(unknown=list(names))


def stiffness_and_offset(found: Reconciled) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2) of stiffness, N m/rad, and size of the offset, cm: the ridge between the two."""
    unknown, x = found.problem.unknown, found.unknowns.vehicle
    vehicle = unknown.vehicle(x)
    offset = vehicle.cg_m[1:]
    size = float(np.hypot(*offset))
    slope = np.zeros((2, len(x)))
    slope[0, 0] = STIFFNESS_LOG_SD * vehicle.joint.bending_stiffness_nmprad
    slope[1, 2:4] = 100.0 * OFFSET_SD_M * offset / max(size, 1e-9)
    covariance = slope @ found.covariance[: len(x), : len(x)] @ slope.T
    return np.array([vehicle.joint.bending_stiffness_nmprad, 100.0 * size]), covariance


def deflection_of(found: Reconciled) -> DeflectionHistory:
    """Deflection that the sensors and the joint together imply, in every window; covariance by the spans' starts."""
    problem, seen = found.problem, found.problem.observed
    turned = problem.predicted(found.unknowns).bending.reshape(-1, 3)
    # rotation vector y z to lateral vector: the shell's nose turns about x cross it
    lateral = np.column_stack([turned[:, 2], -turned[:, 1]])
    at_start = np.empty((seen.spans, 2, 2))
    for span in range(seen.spans):
        at = problem.first_motion + MOTION * span + BENDING.start + np.array([2, 1])
        at_start[span] = found.covariance[np.ix_(at, at)] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    words = "by the simulator with the reconciled joint, from accelerometers and rates"
    covariance = np.repeat(at_start, WINDOWS, axis=0)
    return history_from_lateral(seen.time_s.ravel(), lateral, covariance, "reconciled", words)


def vehicle_lines(found: Reconciled) -> str:
    """Lines of a vehicle file with the joint and the centerbody's c.g. as found."""
    vehicle = found.problem.unknown.vehicle(found.unknowns.vehicle)
    joint, body = vehicle.joint, vehicle.centerbody
    lines = [
        f"# reconciled with a flight of {found.problem.unknown.told.name}",
        "[centerbody]",
        f"cg_from_datum_body_m = [{', '.join(f'{c:.6g}' for c in body.cg_from_datum_body_m)}]",
        "[joint]",
        f"bending_stiffness_nmprad = {joint.bending_stiffness_nmprad:.6g}",
        f"bending_damping_nmsprad = {joint.bending_damping_nmsprad:.6g}",
    ]
    if "freeplay" in found.problem.unknown.laws:
        lines.append(f"freeplay_deg = {joint.freeplay_deg:.6g}")
    if "hardening" in found.problem.unknown.laws:
        lines.append(f"hardening_nmprad3 = {joint.hardening_nmprad3:.6g}")
    return "\n".join(lines) + "\n"

"""Does an attitude from magnetometer and Sun sensors alone agree with the trajectory's? A range's check, every run.

The history of `recon.vector_attitude` minus the smoothed trajectory's attitude, about three body axes, against the sum
of both covariances: NEES ``d^T (P_directions + P_trajectory)^-1 d`` and the share inside three standard deviations. It
is independent where the trajectory neither used these sensors nor was started from them. See docs/attitude.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flightmodel import earth, rotations
from flightmodel.airdata import euler_321
from flightmodel.checks import GateError
from flightmodel.statistics import chi_square_quantile
from flightmodel.telemetry import Finding, Telemetry
from flightmodel.trajectory import interpolate_rows, resample
from recon.consistency import ConsistencyCheck
from recon.reconstruct import TrajectorySolution
from recon.vector_attitude import (
    LEAST_INSIDE,
    AttitudeComparison,
    AttitudeHistory,
    Settings,
    compare,
    reconstruct_attitude,
    track,
)

_RATE_HZ = 5.0  # of the history: a second's work for four minutes of flight, as good as 10 Hz (docs/attitude.md)
# why the check is not independent, by code
DEPENDENCE = {
    "": "",
    "filter": "this check is not independent: the trajectory's filter used these sensors too",
    "start": "this check is not independent: the trajectory's attitude was started from these sensors",
}


@dataclass(frozen=True)
class AttitudeCheck:
    """Attitude from directions, and its comparison with the trajectory's.

    Parameters
    ----------
    history : AttitudeHistory or None
        None where the sensors determine no attitude; a finding gives the reason.
    comparison : AttitudeComparison or None
    dependence : str
        ``"filter"`` or ``"start"`` where the trajectory itself depends on these sensors, empty where it does not.
    findings : tuple of Finding
    confidence : float
    """

    history: AttitudeHistory | None
    comparison: AttitudeComparison | None
    dependence: str
    findings: tuple[Finding, ...]
    confidence: float

    @property
    def remark(self) -> str:
        """Result in a sentence, with what limits it."""
        result = "" if self.comparison is None else self.comparison.words
        return "; ".join(part for part in (result, DEPENDENCE[self.dependence]) if part)

    @property
    def consistency_checks(self) -> tuple[ConsistencyCheck, ...]:
        """Size of the differences, their share inside three standard deviations, and the sensors' own residuals."""
        if self.comparison is None or self.history is None:
            return ()
        nees, inside = self.comparison.mean_nees, self.comparison.share_inside
        high = chi_square_quantile(self.confidence, 3)
        return (
            ConsistencyCheck("attitude-nees", "attitude check size", nees, 0.0, high, nees <= high, self.remark),
            ConsistencyCheck(
                "attitude-coverage",
                "attitude check share inside",
                inside,
                LEAST_INSIDE,
                1.0,
                inside >= LEAST_INSIDE,
                self.remark,
            ),
            *(
                ConsistencyCheck(**{**vars(v), "name": f"attitude check {v.name}"})
                for v in self.history.consistency_checks
            ),
        )


def check_attitude(telemetry: Telemetry, bet: TrajectorySolution) -> AttitudeCheck | None:
    """Attitude from directions over the trajectory's span, compared; None without sensors or without an attitude."""
    if telemetry.magnetometer is None or telemetry.sun is None or bet.provenance["motion"] == "ballistic":
        return None
    settings = bet.settings
    dependence = ""
    if settings.attitude_sensors:
        dependence = "filter"
    elif telemetry.attitude_prior is None:
        dependence = "start"
    history, comparison = None, None
    found: list[Finding] = []
    try:
        t, points = track(telemetry)
        ends = np.clip(bet.smoothed.time_s[[0, -1]], t[0], t[-1])
        at = np.union1d(t[(t > ends[0]) & (t < ends[1])], ends)
        chosen = Settings(rate_hz=_RATE_HZ, confidence=settings.check_confidence)
        history = reconstruct_attitude(telemetry, (at, interpolate_rows(at, t, points)), chosen)
        comparison = compare(history, bet.smoothed, settings.check_confidence)
        found += history.findings
    except GateError as fault:
        found.append(Finding("attitude check", str(fault), np.nan, np.nan, "attitude-check-missing"))
    return AttitudeCheck(history, comparison, dependence, tuple(found), settings.check_confidence)


def attitude_table(check: AttitudeCheck, bet: TrajectorySolution) -> pd.DataFrame:
    """Return ``attitude_check.csv``: the independent attitude, its difference from the trajectory's, and all sds."""
    history, comparison = check.history, check.comparison
    assert history is not None
    assert comparison is not None
    rows = np.searchsorted(history.time_s, comparison.time_s)
    path = resample(bet.smoothed, comparison.time_s)
    assert path.covariance is not None
    latitude, longitude, _ = earth.geodetic_from_ecef(path.position_ecef_m, path.planet)
    dcm = earth.dcm_ned_ecef(latitude, longitude) @ rotations.dcm_from_q(history.q_ecef_body[rows])
    columns = {"t_s": comparison.time_s}
    angles = zip(("roll", "pitch", "yaw"), euler_321(dcm), strict=True)
    columns |= {f"{name}_ned_deg": np.rad2deg(angle) for name, angle in angles}
    parts = {
        "difference_{}_body_deg": comparison.difference_body_rad,
        "difference_{}_body_sd_deg": comparison.sd_body_rad,
        "independent_{}_body_sd_deg": np.sqrt(np.diagonal(history.covariance[rows], axis1=1, axis2=2)),
        "bet_{}_body_sd_deg": path.sd()[:, 6:9],
    }
    for pattern, values in parts.items():
        columns |= {pattern.format(a): np.rad2deg(column) for a, column in zip("xyz", values.T, strict=True)}
    return pd.DataFrame(columns)

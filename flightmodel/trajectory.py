"""Where was a vehicle and how was it oriented? One type for truth and estimate, so that they can be subtracted.

The followed point is the structural datum (the nose), fixed hardware: the c.g. is one of the things estimated.
*Body* is the centerbody, where the sensors are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import (
    FloatArray,
    GateError,
    IntArray,
    check_finite,
    check_increasing,
    check_shape,
    check_unit_quaternion,
)
from flightmodel.tabular import Tabular

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, repr=False)
class Trajectory(Tabular):
    """Position, velocity and attitude over time.

    Parameters
    ----------
    epoch_utc : str
        ISO time of ``time_s = 0``.
    time_s : (n,) float
    point : str
        Which point of the vehicle is followed, ``"datum"`` unless moved.
    position_ecef_m : (n, 3) float
    velocity_ecef_mps : (n, 3) float
        Relative to the rotating Earth.
    q_ecef_body : (n, 4) float
        NaN where no sensor gives an attitude.
    omega_body_eci_body_radps : (n, 3) float
        Rate of the body relative to inertial space, body axes; NaN where it is not measured, as in a gap of the gyros.
    covariance : (n, 9, 9) float or None
        Of position ECEF m, velocity ECEF m/s, rotation in body axes rad: the coordinates of `difference`.
    planet : Planet
    """

    epoch_utc: str
    time_s: FloatArray
    point: str
    position_ecef_m: FloatArray
    velocity_ecef_mps: FloatArray
    q_ecef_body: FloatArray
    omega_body_eci_body_radps: FloatArray
    covariance: FloatArray | None = None
    planet: earth.Planet = earth.WGS84

    def __post_init__(self) -> None:
        """Check shapes, finiteness, time order and unit attitudes once."""
        n = len(self.time_s)
        for name, width, or_missing in (
            ("position_ecef_m", 3, False),
            ("velocity_ecef_mps", 3, False),
            ("q_ecef_body", 4, True),
            ("omega_body_eci_body_radps", 3, True),
        ):
            check_finite(name, check_shape(name, getattr(self, name), (n, width)), or_missing)
        check_increasing("trajectory.time_s", self.time_s)
        check_unit_quaternion("q_ecef_body", self.q_ecef_body)
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (n, 9, 9))

    def to_frame(self) -> pd.DataFrame:
        """Place, velocity and attitude, one row a time.

        Returns
        -------
        DataFrame
            ``t_s, x_ecef_m, ..., vz_ecef_mps, qw, qx, qy, qz, p_degps, q_degps, r_degps`` (rates of the body against
            inertial space), ``lat_deg, lon_deg, alt_m``, and with a covariance ``position_sd_m, velocity_sd_mps,
            attitude_sd_deg``, roots of its traces.
        """
        import pandas as pd

        latitude, longitude, altitude = earth.geodetic_from_ecef(self.position_ecef_m, self.planet)
        columns = {"t_s": self.time_s}
        for pattern, letters, values in (
            ("{}_ecef_m", "xyz", self.position_ecef_m),
            ("v{}_ecef_mps", "xyz", self.velocity_ecef_mps),
            ("q{}", "wxyz", self.q_ecef_body),
            ("{}_degps", "pqr", np.rad2deg(self.omega_body_eci_body_radps)),
        ):
            columns |= {pattern.format(letter): values[:, k] for k, letter in enumerate(letters)}
        columns |= {"lat_deg": np.rad2deg(latitude), "lon_deg": np.rad2deg(longitude), "alt_m": altitude}
        if self.covariance is not None:
            variance = self.sd() ** 2
            columns["position_sd_m"] = np.sqrt(variance[:, :3].sum(axis=1))
            columns["velocity_sd_mps"] = np.sqrt(variance[:, 3:6].sum(axis=1))
            columns["attitude_sd_deg"] = np.rad2deg(np.sqrt(variance[:, 6:].sum(axis=1)))
        return pd.DataFrame(columns)

    def at(self, time_s: FloatArray) -> Trajectory:
        """Trajectory at other times ``(m,)``, see `resample`."""
        return resample(self, time_s)

    def minus(self, other: Trajectory) -> FloatArray:
        """Difference ``(n, 9)`` from another trajectory of the same times, see `difference`."""
        return difference(self, other)

    def _about(self) -> str:
        span = f"{self.time_s[0]:.2f} to {self.time_s[-1]:.2f} s after {self.epoch_utc}"
        return f"{self.point}, {len(self.time_s)} samples, {span}"

    def sd(self) -> FloatArray:
        """Standard deviations ``(n, 9)`` in the covariance's coordinates; NaN without covariance."""
        if self.covariance is None:
            return np.full((len(self.time_s), 9), np.nan)
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def resample(trajectory: Trajectory, time_s: FloatArray) -> Trajectory:
    """Trajectory at other times: cubic in position, linear in the rest, shortest arc in attitude.

    Raises
    ------
    GateError
        Where a time lies outside the trajectory; nothing is extrapolated.
    """
    t = trajectory.time_s
    at = np.asarray(time_s, dtype=float)
    if at.min() < t[0] - 1e-9 or at.max() > t[-1] + 1e-9:
        raise GateError(
            f"resample: {at.min():.3f} to {at.max():.3f} s lies outside {t[0]:.3f} to {t[-1]:.3f} s", code="table-range"
        )
    at = np.clip(at, t[0], t[-1])
    from scipy.interpolate import CubicHermiteSpline  # half a second to import

    spline = CubicHermiteSpline(t, trajectory.position_ecef_m, trajectory.velocity_ecef_mps)
    covariance = None
    if trajectory.covariance is not None:
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        w = ((at - t[k]) / (t[k + 1] - t[k]))[:, None, None]
        covariance = (1.0 - w) * trajectory.covariance[k] + w * trajectory.covariance[k + 1]
    return Trajectory(
        trajectory.epoch_utc,
        at,
        trajectory.point,
        spline(at),
        interpolate_rows(at, t, trajectory.velocity_ecef_mps),
        rotations.slerp(t, trajectory.q_ecef_body, at),
        interpolate_rows(at, t, trajectory.omega_body_eci_body_radps),
        covariance,
        trajectory.planet,
    )


def nearest_index(grid: FloatArray, at: FloatArray) -> IntArray:
    """Index of the value of an increasing grid (n,), n > 1, that is nearest to each of ``at``."""
    k = np.clip(np.searchsorted(grid, at), 1, len(grid) - 1)
    return np.asarray(k - (at - grid[k - 1] < grid[k] - at), dtype=np.int64)


def interpolate_rows(at: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    """Linear interpolation of each column of ``values`` (n, m) given at ``t``; outside, the first and last row."""
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, max(len(t) - 2, 0))
    after = np.minimum(k + 1, len(t) - 1)
    inside = np.clip(at, t[0], t[-1]) - t[k]
    slope = (values[after] - values[k]) / np.where(after > k, t[after] - t[k], 1.0)[:, None]
    out = np.ascontiguousarray(slope * inside[:, None] + values[k])  # kernels are compiled for this layout alone
    out[at >= t[-1]] = values[-1]
    return out


def move_point(trajectory: Trajectory, to: str, to_from_point_body_m: FloatArray) -> Trajectory:
    """Trajectory of another point fixed in the body, ``to_from_point_body_m`` (3,) away; covariance is dropped."""
    arm = rotations.rotate(trajectory.q_ecef_body, np.broadcast_to(to_from_point_body_m, (len(trajectory.time_s), 3)))
    rate = rotations.rotate(trajectory.q_ecef_body, trajectory.omega_body_eci_body_radps)
    rate = rate - trajectory.planet.rate_ecef_radps
    return Trajectory(
        trajectory.epoch_utc,
        trajectory.time_s,
        to,
        trajectory.position_ecef_m + arm,
        trajectory.velocity_ecef_mps + np.cross(rate, arm),
        trajectory.q_ecef_body,
        trajectory.omega_body_eci_body_radps,
        planet=trajectory.planet,
    )


def difference(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Error ``(n, 9)``, estimate minus truth, in the covariance's coordinates; times and points must be equal."""
    if estimate.point != truth.point or not np.allclose(estimate.time_s, truth.time_s, atol=1e-9, rtol=0.0):
        raise GateError(
            "difference: the trajectories follow different points or times; resample or move one first",
            code="argument-value",
        )
    return np.hstack(
        [
            estimate.position_ecef_m - truth.position_ecef_m,
            estimate.velocity_ecef_mps - truth.velocity_ecef_mps,
            rotations.boxminus(estimate.q_ecef_body, truth.q_ecef_body),
        ]
    )

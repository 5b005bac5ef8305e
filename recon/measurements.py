"""What a radar should have measured, how that changes with the state, and how noisy it is.

The tracked point sits at ``d`` from the accelerometer in body axes. A point tagged ``t`` was taken at ``t - tau``
(``tau``: time tag minus true time), so the radar sees

    p = r + C d - tau (v + C (w x d)),    z = (range, azimuth, elevation of p from the site) + bias + noise

with ``w`` the body's rate relative to the Earth. The acceleration term ``tau^2 a / 2`` is below a millimetre for
milliseconds and 10 g and is left out; so is the uncertainty of ``w`` times arm and time bias (a micrometre).

A tracker's angle noise is noise of its line of sight: ``angle_sd`` in elevation and in traverse, hence
``angle_sd / cos(elevation)`` in azimuth. `Settings.angle_noise` says ``"axis"`` for a radar whose azimuth readings
scatter by ``angle_sd`` at any elevation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from flightmodel.telemetry import RadarRecord
from recon import _kernels
from recon.state import POSITION, ROTATION, VELOCITY, States

COMPONENTS = ("range", "azimuth", "elevation")


@dataclass(frozen=True)
class RadarModel:
    """One radar as the filter sees it.

    Parameters
    ----------
    name : str
    errors : slice
        Its four errors in the full error vector.
    arm_body_m : (3,) float
        Tracked point from the accelerometer, body axes.
    sd : (3,) float
        Noise of one point in range, traverse (or azimuth) and elevation, m and rad.
    traverse : bool
        Whether the second is noise in traverse.
    site_ecef_m, dcm_ned_ecef : (3,), (3, 3) float
        Where the radar stands and its local axes.
    """

    name: str
    errors: slice
    arm_body_m: FloatArray
    sd: FloatArray
    traverse: bool
    site_ecef_m: FloatArray
    dcm_ned_ecef: FloatArray

    def noise_var(self, elevation_rad: float) -> FloatArray:
        """Covariance (3, 3) of one point at an elevation."""
        sd = self.sd.copy()
        if self.traverse:
            sd[1] /= max(float(np.cos(elevation_rad)), 1e-3)
        return np.diag(sd**2)


def radar_model(
    name: str,
    record: RadarRecord,
    errors: slice,
    cg_m: FloatArray,
    accelerometer_m: FloatArray,
    traverse: bool = True,
) -> RadarModel:
    """Model of one radar; c.g. and accelerometer from the datum, body axes, (3,), m."""
    site = record.site
    point = cg_m if record.point == "cg" else np.zeros(3)
    return RadarModel(
        name,
        errors,
        point - accelerometer_m,
        np.array([site.range_sd_m, site.angle_sd_rad, site.angle_sd_rad]),
        traverse,
        earth.ecef_from_geodetic(site.latitude_rad, site.longitude_rad, site.height_m),
        np.ascontiguousarray(earth.dcm_ned_ecef(site.latitude_rad, site.longitude_rad)),
    )


def predict_radar(model: RadarModel, state: States, rate_body_eci_radps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Predicted range, azimuth, elevation (3,) of one state, and the partials (3, 9 + m), compiled.

    ``rate_body_eci_radps`` (3,) is the body's rate against inertial space.
    """
    h, compact = np.empty(3), np.empty((3, 13))
    first, last = model.errors.start, model.errors.stop
    _kernels.radar_prediction(
        model.dcm_ned_ecef,
        model.site_ecef_m,
        model.arm_body_m,
        state.position_ecef_m,
        state.velocity_ecef_mps,
        state.q_ecef_body,
        state.sensor_errors[first - 9 : last - 9],
        rate_body_eci_radps,
        h,
        compact,
    )
    jacobian = np.zeros((3, 9 + len(state.sensor_errors)))
    jacobian[:, :9] = compact[:, :9]
    jacobian[:, model.errors] = compact[:, 9:]
    return h, jacobian


def predict_radar_plain(
    model: RadarModel, state: States, rate_body_eci_radps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Same as `predict_radar` in numpy; for reading and for tests."""
    c = rotations.dcm_from_q(state.q_ecef_body)
    bias = state.sensor_errors[model.errors.start - 9 : model.errors.stop - 9]
    rate = rate_body_eci_radps - earth.OMEGA_RADPS * c[2]
    swing = np.cross(rate, model.arm_body_m)
    velocity = state.velocity_ecef_mps + c @ swing
    tau = bias[3]
    point = state.position_ecef_m + c @ model.arm_body_m - tau * velocity
    h, partials = _range_az_el(model.dcm_ned_ecef @ (point - model.site_ecef_m))
    partials = partials @ model.dcm_ned_ecef

    jacobian = np.zeros((3, 9 + len(state.sensor_errors)))
    jacobian[:, POSITION] = partials
    jacobian[:, VELOCITY] = -tau * partials
    jacobian[:, ROTATION] = -partials @ c @ rotations.skew(model.arm_body_m - tau * swing)
    jacobian[:, model.errors.start : model.errors.start + 3] = np.eye(3)
    jacobian[:, model.errors.start + 3] = -partials @ velocity
    return h + bias[:3], jacobian


def _range_az_el(ned: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Range, azimuth, elevation of a point at ``ned`` (3,), m, from the radar, and their partials (3, 3)."""
    n, e, d = ned
    level2 = n * n + e * e
    level = np.sqrt(level2)
    slant2 = level2 + d * d
    slant = np.sqrt(slant2)
    h = np.array([slant, np.arctan2(e, n), np.arctan2(-d, level)])
    partials = np.array(
        [
            [n / slant, e / slant, d / slant],
            [-e / level2, n / level2, 0.0],
            [d * n / (slant2 * level), d * e / (slant2 * level), -level / slant2],
        ]
    )
    return h, partials


def residual(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Measured minus predicted (..., 3), with the azimuth's difference wrapped to [-pi, pi)."""
    y = np.asarray(measured - predicted)
    y[..., 1] = np.mod(y[..., 1] + np.pi, 2.0 * np.pi) - np.pi
    return y

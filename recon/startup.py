"""Where the filter starts: attitude from its prior through the gyros, position and velocity from early track points.

Position and velocity get a prior so wide that it carries no information (`DIFFUSE_POSITION_M`,
`DIFFUSE_VELOCITY_MPS`): the fit to the first seconds of tracking only chooses the point about which to linearise, so
no radar point counts twice. The attitude's errors are correlated with those of the gyros that carried it.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray, GateError
from flightmodel.telemetry import AttitudePrior, RadarRecord
from recon.error_model import ErrorModel
from recon.inertial import Bridged, inertial_grid
from recon.measurements import RadarModel
from recon.state import KINEMATIC, States
from recon.strapdown import correct, propagate

DIFFUSE_POSITION_M = 1000.0
DIFFUSE_VELOCITY_MPS = 100.0
FIT_SPAN_S = 3.0
FIT_POINTS = 12
GYRO = slice(18, 27)


def start_attitude(
    prior: AttitudePrior, start_s: float, force: Bridged, rate: Bridged, model: ErrorModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Attitude (4,) at the start, its covariance (3, 3) and its covariance with the gyros' errors (3, 9).

    Raises
    ------
    GateError
        Where gyro data do not reach from the prior to the start.
    """
    q, var = prior.q_ecef_body, np.diag(prior.sd_rad**2)
    if abs(prior.time_s - start_s) < 1e-9:
        return q, var, np.zeros((3, 9))
    lo, hi = sorted((prior.time_s, start_s))
    if lo < rate.time_s[0] - 0.1 or hi > rate.time_s[-1] + 0.1:
        raise GateError(
            f"attitude prior at {prior.time_s:.3f} s: gyro samples cover {rate.time_s[0]:.3f} to "
            f"{rate.time_s[-1]:.3f} s and cannot carry it to the start at {start_s:.3f} s"
        )
    grid, ends = inertial_grid(force, rate, np.array([lo, hi]))
    first, last = (int(ends[0]), int(ends[1])) if prior.time_s < start_s else (int(ends[1]), int(ends[0]))
    somewhere = States(np.array([earth.SEMI_MAJOR_M, 0.0, 0.0]), np.zeros(3), q, np.zeros(model.size))
    step = propagate(grid, first, last, somewhere)
    by_attitude, by_gyro = step.transition[6:9, 6:9], step.transition[6:9, GYRO]
    gyro_var = np.diag(model.prior_sd[9:18] ** 2)
    cross = by_gyro @ gyro_var
    total = by_attitude @ var @ by_attitude.T + cross @ by_gyro.T + step.noise[6:9, 6:9]
    return step.state.q_ecef_body, total, cross


def fit_first_points(records: list[RadarRecord], start_s: float) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (3,) of the tracked point at the start: a parabola through the first seconds.

    Points far from the parabola, in units of the median distance, lose their weight as the fit is repeated.

    Raises
    ------
    GateError
        With fewer than three radar points.
    """
    tau, points = [], []
    for record in records:
        good = np.isfinite(record.range_az_el).all(axis=1) & (record.time_s >= start_s)
        s = record.site
        tau.append(record.time_s[good] - start_s)
        points.append(earth.ecef_from_radar(record.range_az_el[good], s.latitude_rad, s.longitude_rad, s.height_m))
    t, p = np.concatenate(tau), np.concatenate(points)
    if len(t) < 3:
        raise GateError(f"radar: {len(t)} track points after {start_s:.3f} s; at least 3 are needed to start")
    order = np.argsort(t, kind="stable")
    count = max(FIT_POINTS, int(np.searchsorted(t[order], FIT_SPAN_S)))
    t, p = t[order][:count], p[order][:count]
    weight: FloatArray = np.ones(len(t))
    coefficients: FloatArray = np.zeros((3, 3))
    for _ in range(10):
        coefficients = np.asarray(np.polynomial.polynomial.polyfit(t, p, min(2, len(t) - 1), w=weight), dtype=float)
        distance = np.linalg.norm(p - np.polynomial.polynomial.polyval(t, coefficients).T, axis=1)
        scale = float(np.median(distance))
        weight = 1.0 / (1.0 + (distance / (2.0 * scale + 1e-3)) ** 2) ** 2
    return coefficients[0], coefficients[1]


def start_state(
    records: list[RadarRecord],
    radars: list[RadarModel],
    prior: AttitudePrior,
    start_s: float,
    force: Bridged,
    rate: Bridged,
    model: ErrorModel,
) -> tuple[States, FloatArray]:
    """State at the start and its covariance (9 + m, 9 + m)."""
    q, var, cross = start_attitude(prior, start_s, force, rate, model)
    position, velocity = fit_first_points(records, start_s)
    sample = np.array([[np.interp(start_s, rate.time_s, column) for column in rate.measured_sensor.T]])
    w = correct(sample, np.zeros(9), rate.spec.dcm_body_sensor)[0]
    arm = radars[0].arm_body_m
    c = rotations.dcm_from_q(q)
    swing = c @ np.cross(w - c.T @ earth.OMEGA_ECEF_RADPS, arm)
    state = States(position - c @ arm, velocity - swing, q, np.zeros(model.size))

    sd = np.concatenate([np.full(3, DIFFUSE_POSITION_M), np.full(3, DIFFUSE_VELOCITY_MPS), np.zeros(3), model.prior_sd])
    covariance = np.diag(sd**2)
    covariance[6:9, 6:9] = var
    gyro = slice(KINEMATIC + 9, KINEMATIC + 18)
    covariance[6:9, gyro] = cross
    covariance[gyro, 6:9] = cross.T
    return state, covariance

"""Where the filter starts: attitude from its prior through the gyros, position and velocity from early track points.

Position and velocity get a prior so wide that it carries no information (`DIFFUSE_POSITION_M`,
`DIFFUSE_VELOCITY_MPS`): the fit to the first seconds of tracking only chooses the point about which to linearise, so
no point counts twice. The attitude's errors are correlated with those of the gyros that carried it. Ballistic flight
has no attitude; its rotation stands still and is known.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray, GateError
from flightmodel.telemetry import AttitudePrior
from recon._measurement_kernels import POSITION, RADAR
from recon.error_model import ErrorModel
from recon.gaps import Bridged
from recon.inertial import inertial_motion
from recon.measurements import Instrument
from recon.state import KINEMATIC, States
from recon.strapdown import correct, propagate

DIFFUSE_POSITION_M = 1000.0
DIFFUSE_VELOCITY_MPS = 100.0
FIT_SPAN_S = 3.0
LEAST_POINTS = 4
TRACK_SPAN_S = 2.5
STILL_RAD = 1e-6
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
    motion, ends = inertial_motion(force, rate, np.array([lo, hi]))
    first, last = (int(ends[0]), int(ends[1])) if prior.time_s < start_s else (int(ends[1]), int(ends[0]))
    somewhere = States(np.array([earth.SEMI_MAJOR_M, 0.0, 0.0]), np.zeros(3), q, np.zeros(model.size))
    step = propagate(motion, first, last, somewhere)
    by_attitude, by_gyro = step.transition[6:9, 6:9], step.transition[6:9, GYRO]
    gyro_var = np.diag(model.prior_sd[9:18] ** 2)
    cross = by_gyro @ gyro_var
    total = by_attitude @ var @ by_attitude.T + cross @ by_gyro.T + step.noise[6:9, 6:9]
    return step.state.q_ecef_body, total, cross


def places(instruments: tuple[Instrument, ...]) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and points (k, 3), ECEF m, of everything that tells a place by itself, in order."""
    times, points = [], []
    for i in instruments:
        whole = np.isfinite(i.variance).all(axis=1)
        if i.kind == RADAR:
            ned = _ned_from_radar(i.value[whole])
        elif i.kind == POSITION:
            ned = i.value[whole]
        else:
            continue
        times.append(i.time_s[whole])
        points.append(i.site_ecef_m + ned @ i.dcm)
    t = np.concatenate([np.empty(0), *times])
    order = np.argsort(t, kind="stable")
    return t[order], np.concatenate([np.empty((0, 3)), *points])[order]


def _ned_from_radar(range_az_el: FloatArray) -> FloatArray:
    slant, az, el = range_az_el.T
    return np.column_stack([slant * np.cos(el) * np.cos(az), slant * np.cos(el) * np.sin(az), -slant * np.sin(el)])


def fit_first_points(instruments: tuple[Instrument, ...], start_s: float) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (3,) of the tracked point at the start: a parabola through the seconds about it.

    Where they hold fewer than `LEAST_POINTS` a line through two will do (a rocket on its pad whose receiver is silent
    under thrust), and only without two are later points asked. Points far from the curve, in units of the median
    distance, lose their weight as the fit is repeated.

    Raises
    ------
    GateError
        With fewer than three points.
    """
    t, p = places(instruments)
    t, p = t[t >= start_s - FIT_SPAN_S] - start_s, p[t >= start_s - FIT_SPAN_S]
    if len(t) < 3:
        raise GateError(f"tracking: {len(t)} points after {start_s:.3f} s; at least 3 are needed to start")
    near = int(np.searchsorted(t, FIT_SPAN_S))
    count = near if near >= 2 else LEAST_POINTS
    t, p = t[:count], p[:count]
    degree = 2 if len(t) >= LEAST_POINTS else 1
    weight: FloatArray = np.ones(len(t))
    coefficients: FloatArray = np.zeros((3, 3))
    for _ in range(10):
        coefficients = np.asarray(np.polynomial.polynomial.polyfit(t, p, degree, w=weight), dtype=float)
        distance = np.linalg.norm(p - np.polynomial.polynomial.polyval(t, coefficients).T, axis=1)
        scale = float(np.median(distance))
        weight = 1.0 / (1.0 + (distance / (2.0 * scale + 1e-3)) ** 2) ** 2
    return coefficients[0], coefficients[1]


def across_path(instruments: tuple[Instrument, ...]) -> FloatArray:
    """Level direction (3,), ECEF, in which the tracked places lie least far apart.

    Each counts by its direction from the middle one alone, so that a wild point has no more weight than another.
    """
    _, points = places(instruments)
    middle = np.median(points, axis=0)
    up = middle / np.linalg.norm(middle)
    level = points - middle
    level -= np.outer(level @ up, up)
    level /= np.linalg.norm(level, axis=1, keepdims=True) + 1e-9
    # of three axes the least is upright
    return np.asarray(np.linalg.eigh(level.T @ level)[1][:, 1])


def along_track(instruments: tuple[Instrument, ...], time_s: FloatArray, errors: int) -> States | None:
    """States at nodes (n,) that tracking alone tells, without attitude: where to linearise when a filter is lost.

    Parabolas through the points within `TRACK_SPAN_S` of a node give position and velocity; cubics that meet both
    cross the gaps between. None where fewer than two nodes have points about them.
    """
    t, p = places(instruments)
    first, last = np.searchsorted(t, time_s - TRACK_SPAN_S), np.searchsorted(t, time_s + TRACK_SPAN_S)
    told = np.flatnonzero(last - first >= LEAST_POINTS)
    # far from its own points a parabola says nothing
    told = np.array([k for k in told if t[first[k]] <= time_s[k] <= t[last[k] - 1]], dtype=np.int64)
    if len(told) < 2:
        return None
    fits = np.array(
        [
            np.polynomial.polynomial.polyfit(t[a:b] - at, p[a:b], 2)[:2]
            for a, b, at in zip(first[told], last[told], time_s[told], strict=True)
        ]
    )
    from scipy.interpolate import CubicHermiteSpline

    path = CubicHermiteSpline(time_s[told], fits[:, 0], fits[:, 1])
    inside = np.clip(time_s, time_s[told[0]], time_s[told[-1]])
    velocity = path.derivative()(inside)
    position = path(inside) + (time_s - inside)[:, None] * velocity
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    return States(position, velocity, still, np.zeros((len(time_s), errors)))


def _covariance(model: ErrorModel) -> FloatArray:
    """Prior of everything but rotation."""
    sd = np.concatenate([np.full(3, DIFFUSE_POSITION_M), np.full(3, DIFFUSE_VELOCITY_MPS), np.zeros(3), model.prior_sd])
    return np.diag(sd**2)


def start_by_inertial_sensors(
    instruments: tuple[Instrument, ...],
    prior: AttitudePrior,
    start_s: float,
    force: Bridged,
    rate: Bridged,
    model: ErrorModel,
) -> tuple[States, FloatArray]:
    """State at the start and its covariance (9 + m, 9 + m)."""
    q, var, cross = start_attitude(prior, start_s, force, rate, model)
    position, velocity = fit_first_points(instruments, start_s)
    sample = np.array([[np.interp(start_s, rate.time_s, column) for column in rate.measured_sensor.T]])
    w = correct(sample, np.zeros(9), rate.spec.dcm_body_sensor)[0]
    arm = next(i.arm_body_m for i in instruments if i.kind in (RADAR, POSITION))
    c = rotations.dcm_from_q(q)
    swing = c @ np.cross(w - c.T @ earth.OMEGA_ECEF_RADPS, arm)
    state = States(position - c @ arm, velocity - swing, q, np.zeros(model.size))
    covariance = _covariance(model)
    covariance[6:9, 6:9] = var
    gyro = slice(KINEMATIC + 9, KINEMATIC + 18)
    covariance[6:9, gyro] = cross
    covariance[gyro, 6:9] = cross.T
    return state, covariance


def start_ballistic(
    instruments: tuple[Instrument, ...], start_s: float, model: ErrorModel
) -> tuple[States, FloatArray]:
    """State at the start and its covariance (9 + m, 9 + m), without attitude."""
    position, velocity = fit_first_points(instruments, start_s)
    covariance = _covariance(model)
    covariance[range(6, 9), range(6, 9)] = STILL_RAD**2
    return States(position, velocity, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(model.size)), covariance

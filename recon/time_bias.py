"""Do the clocks of accelerometer and gyros agree? Their lag, by the oscillation of the vehicle.

The flow's force on an oscillating vehicle and its moment act at the same instant: normal to the long axis
(body x) specific force and angular acceleration are in phase, each plane with a factor of its own that varies slowly
with pressure. What lever arms add, ``w' x r`` and ``w x (w x r)``, is in phase as well. All of this is the same with
time reversed; damping is not: it lets the force lag by about as long as the flow takes from the c.g. to where damping
arises, for which `_ARM_M` over the speed is the standard deviation. So in windows of `_WINDOW_S`, ``u`` from -1/2 to
1/2,

    f_y(t) = a + b u + c u^2 + (d + e u) w_z'(t - lag) + g w_x w_y(t - lag)

and the same of ``f_z`` with ``w_y'`` and ``w_x w_z``, fit best where the lag is by how much the tags of the force are
later than the rates'. A window counts where the fit explains the force; the answer is the weighted median of all. No
tracker takes part.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from flightmodel.checks import BoolArray, Check, FloatArray
from flightmodel.statistics import NORMAL_MAD
from flightmodel.trajectory import interpolate_rows
from recon.imu_screening import LONGEST_LAG_S, BridgedSensor
from recon.problem import Problem
from recon.state import KINEMATIC, States

_WINDOW_S, _STEP_S = 4.0, 0.01  # some periods of the oscillation; a fortieth of one at 2.5 Hz
_SMOOTH_S, SLOWEST_S = 0.04, 0.05  # of the Gaussian filter of both signals; steps of a record too slow to use
_LAG_STEP_S = 0.01
_LEAST_EXPLAINED = 0.95  # share of the lateral force's square
CORRELATION_S = 0.7  # of residuals
_LEAST_WINDOWS = 4  # so that their scatter says how well the lag is known
_ARM_M = 3.0  # of a vehicle of six metres


class Lag(NamedTuple):
    """How much later the accelerometer's tags are than the gyros', s, with its standard deviation."""

    lag_s: float
    sd_s: float


def lag_between(
    force: BridgedSensor,
    rate: BridgedSensor,
    path: States,
    time_s: FloatArray,
    start_s: float = -np.inf,
    end_s: float = np.inf,
    about_s: float = 0.0,
) -> Lag | None:
    """Lag of the accelerometer behind the gyros from ``start_s`` to ``end_s``; None where oscillations do not show it.

    ``path`` at ``time_s`` (n,) is where the vehicle flew, roughly; the lag is searched ``about_s``.
    """
    start = max(start_s, float(force.time_s[0]), float(rate.time_s[0]) + about_s) + LONGEST_LAG_S
    end = min(end_s, float(force.time_s[-1]), float(rate.time_s[-1]) + about_s) - LONGEST_LAG_S
    if max(np.median(np.diff(t.time_s)) for t in (force, rate)) > SLOWEST_S or end - start < _WINDOW_S:
        return None
    lags_found = []
    (ft, f), (wt, w) = smoothed_body_axes(force), smoothed_body_axes(rate)
    turning = np.column_stack([w, np.gradient(w, wt, axis=0)])
    speed = np.linalg.norm(path.velocity_ecef_mps, axis=1)
    for begin in np.arange(start, end - _WINDOW_S, _WINDOW_S):
        if has_gap(force, begin) or has_gap(rate, begin):
            continue
        at = begin + np.arange(0.0, _WINDOW_S, _STEP_S)
        lags = about_s + np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 1e-9, _LAG_STEP_S)
        shifted = interpolate_rows((at - lags[:, None]).ravel(), wt, turning).reshape(len(lags), len(at), -1)
        damping = _ARM_M / max(float(np.interp(begin + 0.5 * _WINDOW_S, time_s, speed)), 1.0)
        both = (_lag_in_window(interpolate_rows(at, ft, f)[:, i], shifted, lags, i) for i in (1, 2))
        lags_found += [(*one, damping) for one in both if one is not None]
    lag = _combined(np.array(lags_found)) if len(lags_found) >= _LEAST_WINDOWS else None
    # else hardly any lag in the range would be significant
    return lag if lag is not None and lag.sd_s < LONGEST_LAG_S / 10.0 else None


def smoothed_body_axes(sensor: BridgedSensor) -> tuple[FloatArray, FloatArray]:
    """Even times (n,) and samples (n, 3) in body axes, through a Gaussian of `_SMOOTH_S`."""
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(sensor.time_s)))
    at = np.arange(sensor.time_s[0], sensor.time_s[-1], step)
    body = sensor.measured_sensor @ sensor.spec.dcm_body_sensor.T
    return at, gaussian_filter1d(interpolate_rows(at, sensor.time_s, body), _SMOOTH_S / step, axis=0)


def has_gap(sensor: BridgedSensor, begin: float) -> bool:
    """Whether a sensor has a gap in, or near, the window from ``begin`` on."""
    a, b = np.searchsorted(sensor.time_s, [begin - LONGEST_LAG_S, begin + _WINDOW_S + LONGEST_LAG_S])
    gaps: BoolArray = sensor.in_gap[max(a - 1, 0) : b]
    return bool(gaps.any())


def _lag_in_window(force: FloatArray, shifted: FloatArray, lags: FloatArray, axis: int) -> tuple[float, float] | None:
    """Lag and its sd by one axis (1 or 2) of one window, from rates and angular accelerations (l, n, 6) at the lags."""
    u = np.linspace(-0.5, 0.5, len(force))
    slow = np.column_stack([np.ones_like(u), u, u**2])
    normal = shifted[..., 3 + 3 - axis]
    moving = np.stack([normal, normal * u, shifted[..., 0] * shifted[..., axis]], axis=-1)
    rest = _residual_square(force, np.concatenate([np.broadcast_to(slow, moving.shape), moving], axis=-1))
    k = int(np.argmin(rest))
    if not 0 < k < len(lags) - 1 or rest[k] > (1.0 - _LEAST_EXPLAINED) * _residual_square(force, slow):
        return None
    before, here, after = rest[k - 1 : k + 2]
    curvature = before - 2.0 * here + after
    lag = lags[k] + 0.5 * _LAG_STEP_S * (before - after) / curvature
    least = max(here - 0.125 * (before - after) ** 2 / curvature, 0.0)
    return float(lag), float(np.sqrt(least / len(force) * (CORRELATION_S / _STEP_S) / curvature) * _LAG_STEP_S)


def _residual_square(y: FloatArray, columns: FloatArray) -> FloatArray:
    """Sums of squares (...) that least-squares fits of columns (..., n, k) to (n,) leave."""
    orthogonal, _ = np.linalg.qr(columns)
    rest = y - (orthogonal @ (y @ orthogonal)[..., None])[..., 0]
    return np.asarray(np.sum(rest * rest, axis=-1))


def _combined(lags: FloatArray) -> Lag:
    """Weighted median of lags, given with their sds and that of damping (n, 3), and its sd."""
    lag, sd, damping = lags.T
    weight = 1.0 / (sd**2 + damping**2)
    order = np.argsort(lag)
    share = np.cumsum(weight[order]) / weight.sum()
    middle = float(lag[order][int(np.searchsorted(share, 0.5))])
    scatter = max(1.0, NORMAL_MAD * float(np.median(np.abs(lag - middle) * np.sqrt(weight))))
    common = float(damping @ weight / weight.sum())  # windows share it
    return Lag(middle, float(np.hypot(1.25 * scatter / np.sqrt(weight.sum()), common)))


def lag_check(lag: Lag, force: BridgedSensor, rate: BridgedSensor, confidence: float) -> Check:
    """Whether the lag is consistent with the time biases that both data sheets state."""

    allowed = float(np.hypot(force.spec.time_bias_sd_s, rate.spec.time_bias_sd_s))
    limit = float(ndtri(0.5 * (1.0 + confidence)))
    names = f"{force.spec.name} and {rate.spec.name}"
    verb = "lag" if lag.lag_s > 0.0 else "lead"
    symptom = f"{force.spec.name} time tags {verb} those of {rate.spec.name} by {1e3 * abs(lag.lag_s):.1f} ± "
    symptom += f"{1e3 * lag.sd_s:.1f} ms"
    return Check.of(
        "clock-lag", f"clocks of {names}", lag.lag_s / np.hypot(lag.sd_s, allowed), -limit, limit, symptom, symptom,
        advice="more than their data sheets state: check both time bases",
        component="time bias",
    )  # fmt: skip


def with_lag(problem: Problem, lag: Lag | None, force: str, rate: str) -> Problem:
    """Problem whose start holds the lag between two clocks as a measurement of their wide priors."""
    columns = [problem.model.column(name, "time bias") for name in (force, rate)]
    if lag is None or min(columns) < 0:
        return problem
    p, h = problem.start_covariance, np.zeros(problem.size)
    h[KINEMATIC + columns[0]], h[KINEMATIC + columns[1]] = 1.0, -1.0
    errors = problem.start.sensor_errors
    gain = p @ h / (h @ p @ h + lag.sd_s**2)
    moved = gain * (lag.lag_s - h[KINEMATIC:] @ errors)
    start = replace(problem.start, sensor_errors=errors + moved[KINEMATIC:])
    return replace(problem, start=start, start_covariance=p - np.outer(gain, h @ p))

"""Do the clocks of accelerometer and gyros agree, and did one of them jump? Time biases of the inertial sensors.

**Lag.** The flow's force on an oscillating vehicle and its moment act at the same instant: normal to the long axis
(body x) specific force and angular acceleration are in phase, each plane with a factor of its own that varies slowly
with pressure. What lever arms add, ``w' x r`` and ``w x (w x r)``, is in phase as well. All of this is the same with
time reversed; damping is not: it lets the force lag by about as long as the flow takes from the c.g. to where damping
arises, for which `_ARM_M` over the speed is the standard deviation. So in windows of `_WINDOW_S`, ``u`` from -1/2 to
1/2,

    f_y(t) = a + b u + c u^2 + (d + e u) w_z'(t - lag) + g w_x w_y(t - lag)

and the same of ``f_z`` with ``w_y'`` and ``w_x w_z``, fit best where the lag is by how much the tags of the force are
later than the rates'. A window counts where the fit explains the force; the answer is the weighted median of all. No
tracker takes part.

**Jumps.** A clock that jumps ahead leaves a gap like any other, but behind it all tags are late by the gap (or all
before it were early, where the clock was set right). For each short gap the trackers give the likelihood of so late a
clock from there on against that of none (`recon.fault_detection`, with the clock's column in place of a bias's), and
the lags before and after give that of one clock against the other. Where both together exceed a thousand to one, the
tags are corrected.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from flightmodel.checks import BoolArray, Check, FloatArray, Issue
from flightmodel.statistics import NORMAL_MAD
from flightmodel.telemetry import TriadRecord
from flightmodel.trajectory import interpolate_rows
from recon.fault_detection import LOG_LIKELIHOOD_LIMIT, offset_scores
from recon.imu_screening import BridgedSensor, usual_steps
from recon.kalman import ForwardPass
from recon.problem import Problem
from recon.state import KINEMATIC, States

_WINDOW_S, _STEP_S = 4.0, 0.01  # some periods of the oscillation; a fortieth of one at 2.5 Hz
_SMOOTH_S, SLOWEST_S = 0.04, 0.05  # of the Gaussian filter of both signals; steps of a record too slow to use
_LONGEST_LAG_S, _LAG_STEP_S = 0.08, 0.01  # a fifth of a period at 2.5 Hz: a longer one is found by `recon.oscillation`
_LEAST_EXPLAINED = 0.95  # share of the lateral force's square
CORRELATION_S = 0.7  # of residuals
_LEAST_WINDOWS = 4  # so that their scatter says how well the lag is known
_ARM_M = 3.0  # of a vehicle of six metres
_SHORTEST_S = 0.004  # that a step is longer than usual: below it the lag cannot be measured
_LEAST_EXCESS = 0.5  # of a usual step that a step is longer
_MOST_GAPS = 8  # that are tested, the longest


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
    start = max(start_s, float(force.time_s[0]), float(rate.time_s[0]) + about_s) + _LONGEST_LAG_S
    end = min(end_s, float(force.time_s[-1]), float(rate.time_s[-1]) + about_s) - _LONGEST_LAG_S
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
        lags = about_s + np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S + 1e-9, _LAG_STEP_S)
        shifted = interpolate_rows((at - lags[:, None]).ravel(), wt, turning).reshape(len(lags), len(at), -1)
        damping = _ARM_M / max(float(np.interp(begin + 0.5 * _WINDOW_S, time_s, speed)), 1.0)
        both = (_lag_in_window(interpolate_rows(at, ft, f)[:, i], shifted, lags, i) for i in (1, 2))
        lags_found += [(*one, damping) for one in both if one is not None]
    lag = _combined(np.array(lags_found)) if len(lags_found) >= _LEAST_WINDOWS else None
    # else hardly any lag in the range would be significant
    return lag if lag is not None and lag.sd_s < _LONGEST_LAG_S / 10.0 else None


def smoothed_body_axes(sensor: BridgedSensor) -> tuple[FloatArray, FloatArray]:
    """Even times (n,) and samples (n, 3) in body axes, through a Gaussian of `_SMOOTH_S`."""
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(sensor.time_s)))
    at = np.arange(sensor.time_s[0], sensor.time_s[-1], step)
    body = sensor.measured_sensor @ sensor.spec.dcm_body_sensor.T
    return at, gaussian_filter1d(interpolate_rows(at, sensor.time_s, body), _SMOOTH_S / step, axis=0)


def has_gap(sensor: BridgedSensor, begin: float) -> bool:
    """Whether a sensor has a gap in, or near, the window from ``begin`` on."""
    a, b = np.searchsorted(sensor.time_s, [begin - _LONGEST_LAG_S, begin + _WINDOW_S + _LONGEST_LAG_S])
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


class ClockJump(NamedTuple):
    """Tags that jump ahead ``by_s`` at ``at_s``, mid-gap; late ones come ``after`` it, or early ones before.

    ``sensors`` that jump together: 0 the accelerometer, 1 the gyros.
    """

    sensors: tuple[int, ...]
    at_s: float
    by_s: float
    after: bool = True


def jumps_of_clocks(
    problem: Problem,
    run: ForwardPass,
    records: tuple[TriadRecord, TriadRecord],
    sensors: tuple[BridgedSensor, BridgedSensor],
) -> tuple[ClockJump, ...]:
    """Gaps that are jumps of a clock, in order of time.

    Parameters
    ----------
    problem : Problem
    run : ForwardPass
        Made with all tags as delivered.
    records, sensors : (accelerometer, gyros)
        As delivered, and as the run took them.
    """
    gaps = [g for g in _gaps(records) if problem.time_s[0] < g.at_s < problem.time_s[-1] - g.by_s]
    log_ratio, path = _by_trackers(problem, run, gaps), run.states()
    edges = [-np.inf, *(g.at_s for g in gaps), np.inf]
    out = []
    for k, gap in enumerate(gaps):
        likely = log_ratio[k] + _by_lags(gap, edges[k], edges[k + 2], sensors, path, problem.time_s)
        if likely.max() > LOG_LIKELIHOOD_LIMIT:
            out.append(gap._replace(after=bool(likely[0] >= likely[1])))
    return tuple(out)


def with_corrected_tags(record: TriadRecord, sensor: int, jumps: tuple[ClockJump, ...]) -> TriadRecord:
    """Record whose tags are corrected beyond its jumps."""
    t = record.time_s.copy()
    for jump in (j for j in jumps if sensor in j.sensors):
        later = record.time_s > jump.at_s
        t += np.where(later, -jump.by_s, 0.0) if jump.after else np.where(later, 0.0, jump.by_s)
    return replace(record, time_s=t)


def jump_findings(jumps: tuple[ClockJump, ...], names: tuple[str, str]) -> list[Issue]:
    """One finding for each sensor and jump."""
    out = []
    for jump in jumps:
        remark = f"time tags jump {1e3 * jump.by_s:.1f} ms ahead while no sample is missing: those "
        remark += "after it were set back" if jump.after else "before it were set forward"
        span = jump.at_s - 0.5 * jump.by_s, jump.at_s + 0.5 * jump.by_s
        out += [Issue(remark, "clock-jump", names[sensor], *span) for sensor in jump.sensors]
    return out


def _gaps(records: tuple[TriadRecord, TriadRecord]) -> list[ClockJump]:
    """Short gaps of either sensor or, at one time, of both."""
    found = []
    for sensor, record in enumerate(records):
        step = np.diff(record.time_s)
        usual = usual_steps(step)
        longer = step - usual
        for k in np.flatnonzero((longer > _LEAST_EXCESS * usual) & (longer > _SHORTEST_S) & (longer < _LONGEST_LAG_S)):
            found.append(ClockJump((sensor,), float(record.time_s[k] + 0.5 * step[k]), float(longer[k])))
    out: list[ClockJump] = []
    for gap in sorted(found, key=lambda g: g.at_s):
        last = out[-1] if out else None
        if last is not None and gap.at_s - last.at_s < 0.5 * min(gap.by_s, last.by_s) and gap.sensors != last.sensors:
            out[-1] = last._replace(sensors=(0, 1), by_s=0.5 * (last.by_s + gap.by_s))
        else:
            out.append(gap)
    longest = sorted(out, key=lambda g: -g.by_s)[:_MOST_GAPS]
    return sorted(longest, key=lambda g: g.at_s)


def _by_trackers(problem: Problem, run: ForwardPass, gaps: list[ClockJump]) -> FloatArray:
    """Logarithm of the likelihood (g, 2) of late tags after, and of early ones before each gap, against neither."""
    out = np.zeros((len(gaps), 2))
    if not gaps or not problem.motion.clocks or problem.model.wander.considered.any():
        return out
    columns = KINEMATIC + np.array([18, 19])
    nodes = np.searchsorted(problem.time_s, [g.at_s for g in gaps]).astype(np.int64)
    first, last = np.zeros_like(nodes), np.full_like(nodes, len(problem.time_s) - 1)
    both = (offset_scores(problem, run, nodes, last, columns), offset_scores(problem, run, first, nodes, columns))
    for side, (sign, (score, variance)) in enumerate(zip((1.0, -1.0), both, strict=True)):
        for k, gap in enumerate(gaps):
            offset = np.zeros(2)
            offset[list(gap.sensors)] = sign * gap.by_s
            out[k, side] = -score[k] @ offset - 0.5 * offset @ variance[k] @ offset
    return out


def _by_lags(
    gap: ClockJump,
    from_s: float,
    to_s: float,
    sensors: tuple[BridgedSensor, BridgedSensor],
    path: States,
    time_s: FloatArray,
) -> float:
    """Logarithm of the likelihood that one clock jumped against the other, over that of none."""
    if len(gap.sensors) > 1:
        return 0.0
    before = lag_between(*sensors, path, time_s, from_s, gap.at_s - gap.by_s)
    after = lag_between(*sensors, path, time_s, gap.at_s + gap.by_s, to_s)
    if before is None or after is None:
        return 0.0
    jumped = gap.by_s if gap.sensors == (0,) else -gap.by_s
    return ((after.lag_s - before.lag_s) * jumped - 0.5 * jumped**2) / (after.sd_s**2 + before.sd_s**2)

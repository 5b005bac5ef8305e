"""How late is one inertial triad against the other? The vehicle's own swinging tells, without any tracker.

What the flow does to a vehicle that swings pushes it aside and turns it at the same moment: across the long axis (body
x) specific force and angular acceleration are in step, each plane with a factor of its own that varies slowly with
pressure. What lever arms add, ``w' x r`` and ``w x (w x r)``, is in step as well. All of this is the same with time
reversed; damping is not: it lets the force lag by about as long as the flow takes from the c.g. to where damping
arises, for which `ARM_M` over the speed is the standard deviation. So in windows of `WINDOW_S`, ``u`` from -1/2 to 1/2,

    f_y(t) = a + b u + c u^2 + (d + e u) w_z'(t - lag) + g w_x w_y(t - lag)

and the same of ``f_z`` with ``w_y'`` and ``w_x w_z``, fit best where the lag is by how much the tags of the force are
later than the rates'. A window counts where hardly anything is left over; the answer is the weighted median of all.

Did an inertial sensor's clock jump ahead where its record seems to lack samples?

A clock that jumps ahead leaves a gap like any other, but behind it all tags are late by the gap (or all before it were
early, where the clock was set right). Of each short gap that may be asked: the trackers tell the likelihood of so late
a clock from there on against that of none (`recon.unmodelled`, with the clock's column in place of a bias's), and the
vehicle's swinging (`recon.time_bias`) tells what one triad's clock did against the other's, where they have not one
clock. Where both together say a thousand to one that it jumped, the tags are set back.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.telemetry import Finding, TriadRecord
from flightmodel.trajectory import interpolate_rows
from recon.consistency import ConsistencyCheck, consistency_check
from recon.ekf import ForwardPass
from recon.imu_screening import Bridged, usual_steps
from recon.problem import Problem
from recon.state import KINEMATIC, States
from recon.unmodelled import AGAINST, window_scores

WINDOW_S, STEP_S = 4.0, 0.01
SMOOTH_S, SLOWEST_S = 0.04, 0.05  # of the Gaussian both signals are seen through; steps of a record that tells nothing
LONGEST_LAG_S, LAG_STEP_S = 0.08, 0.01
LARGEST_SD_S = LONGEST_LAG_S / 10.0  # else hardly a lag that is looked for would stand out
EXPLAINED = 0.95  # share of the lateral force's square
ALONE_S = 0.7  # residuals within about so long are one
LEAST_WINDOWS = 4
ARM_M = 3.0  # of a vehicle of six metres


class Lag(NamedTuple):
    """How much later the accelerometer's tags are than the gyros', s, with its standard deviation."""

    lag_s: float
    sd_s: float


def lag_between(
    force: Bridged, rate: Bridged, path: States, time_s: FloatArray, start_s: float = -np.inf, end_s: float = np.inf
) -> Lag | None:
    """Lag of the accelerometer behind the gyros from ``start_s`` to ``end_s``; None where no swing tells it.

    ``path`` at ``time_s`` (n,) is where the vehicle flew, roughly.
    """
    start = max(start_s, float(force.time_s[0]), float(rate.time_s[0])) + LONGEST_LAG_S
    end = min(end_s, float(force.time_s[-1]), float(rate.time_s[-1])) - LONGEST_LAG_S
    if max(np.median(np.diff(t.time_s)) for t in (force, rate)) > SLOWEST_S or end - start < WINDOW_S:
        return None
    told = []
    (ft, f), (wt, w) = _smoothed(force), _smoothed(rate)
    turning = np.column_stack([w, np.gradient(w, wt, axis=0)])
    speed = np.linalg.norm(path.velocity_ecef_mps, axis=1)
    for begin in np.arange(start, end - WINDOW_S, WINDOW_S):
        if _has_gap(force, begin) or _has_gap(rate, begin):
            continue
        at = begin + np.arange(0.0, WINDOW_S, STEP_S)
        lags = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 1e-9, LAG_STEP_S)
        seen = [interpolate_rows(at - lag, wt, turning) for lag in lags]
        damping = ARM_M / max(float(np.interp(begin + 0.5 * WINDOW_S, time_s, speed)), 1.0)
        both = (_lag_in_window(interpolate_rows(at, ft, f)[:, i], seen, lags, i) for i in (1, 2))
        told += [(*one, damping) for one in both if one is not None]
    lag = _together(np.array(told)) if len(told) >= LEAST_WINDOWS else None
    return lag if lag is not None and lag.sd_s < LARGEST_SD_S else None


def _smoothed(triad: Bridged) -> tuple[FloatArray, FloatArray]:
    """Even times (n,) and samples (n, 3) in body axes, through a Gaussian of `SMOOTH_S`."""
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(triad.time_s)))
    at = np.arange(triad.time_s[0], triad.time_s[-1], step)
    body = triad.measured_sensor @ triad.spec.dcm_body_sensor.T
    return at, gaussian_filter1d(interpolate_rows(at, triad.time_s, body), SMOOTH_S / step, axis=0)


def _has_gap(triad: Bridged, begin: float) -> bool:
    a, b = np.searchsorted(triad.time_s, [begin - LONGEST_LAG_S, begin + WINDOW_S + LONGEST_LAG_S])
    gaps: BoolArray = triad.in_gap[max(a - 1, 0) : b]
    return bool(gaps.any())


def _lag_in_window(
    force: FloatArray, seen: list[FloatArray], lags: FloatArray, axis: int
) -> tuple[float, float] | None:
    """Lag and its sd by one axis (1 or 2) of one window, from rates and accelerations (n, 6) seen at each lag."""
    u = np.linspace(-0.5, 0.5, len(force))
    slow = np.column_stack([np.ones_like(u), u, u**2])
    left = np.empty(len(lags))
    for k, w in enumerate(seen):
        across = w[:, 3 + 3 - axis]
        left[k] = _left_over(force, np.column_stack([slow, across, across * u, w[:, 0] * w[:, axis]]))
    k = int(np.argmin(left))
    if not 0 < k < len(lags) - 1 or left[k] > (1.0 - EXPLAINED) * _left_over(force, slow):
        return None
    before, here, after = left[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    lag = lags[k] + 0.5 * LAG_STEP_S * (before - after) / bend
    least = max(here - 0.125 * (before - after) ** 2 / bend, 0.0)
    return float(lag), float(np.sqrt(least / len(force) * (ALONE_S / STEP_S) / bend) * LAG_STEP_S)


def _left_over(y: FloatArray, columns: FloatArray) -> float:
    """Sum of squares that a least-squares fit leaves."""
    orthogonal, _ = np.linalg.qr(columns)
    rest = y - orthogonal @ (orthogonal.T @ y)
    return float(rest @ rest)


def _together(told: FloatArray) -> Lag:
    """Weighted median of lags, given with their sds and what damping may add (n, 3), and its sd."""
    lag, sd, damping = told.T
    weight = 1.0 / (sd**2 + damping**2)
    order = np.argsort(lag)
    share = np.cumsum(weight[order]) / weight.sum()
    middle = float(lag[order][int(np.searchsorted(share, 0.5))])
    scatter = max(1.0, 1.4826 * float(np.median(np.abs(lag - middle) * np.sqrt(weight))))
    common = float(damping @ weight / weight.sum())  # windows share it
    return Lag(middle, float(np.hypot(1.25 * scatter / np.sqrt(weight.sum()), common)))


def lag_check(lag: Lag, force: Bridged, rate: Bridged, confidence: float) -> ConsistencyCheck:
    """Whether both clocks may err by as much as the swinging says, by their sheets."""
    from scipy.stats import norm

    allowed = float(np.hypot(force.spec.time_bias_sd_s, rate.spec.time_bias_sd_s))
    limit = float(norm.ppf(0.5 * (1.0 + confidence)))
    names = f"{force.spec.name} and {rate.spec.name}"
    side = "later" if lag.lag_s > 0.0 else "earlier"
    words = f"as the vehicle swings, the tags of {force.spec.name} are {1e3 * abs(lag.lag_s):.1f} ± "
    words += f"{1e3 * lag.sd_s:.1f} ms {side} than those of {rate.spec.name}"
    bad = f"{words}: the clocks of {names} differ by more than stated"
    return consistency_check(
        "clock-lag", f"clocks of {names}", lag.lag_s / np.hypot(lag.sd_s, allowed), -limit, limit, words, bad
    )


def with_lag(problem: Problem, lag: Lag | None, force: str, rate: str) -> Problem:
    """Problem whose start knows by how much two clocks differ, given as wide priors of each."""
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


SHORTEST_S = 0.004
PART = 0.5  # of a usual step that a step is longer
MOST = 8  # gaps that are asked about, the longest


class ClockJump(NamedTuple):
    """Tags that jump ahead ``by_s`` at ``at_s``, mid-gap; late ones come ``after`` it, or early ones before.

    ``triads`` that jump together: 0 the accelerometer, 1 the gyros.
    """

    triads: tuple[int, ...]
    at_s: float
    by_s: float
    after: bool = True


def jumps_of_clocks(
    problem: Problem, run: ForwardPass, records: tuple[TriadRecord, TriadRecord], bridges: tuple[Bridged, Bridged]
) -> tuple[ClockJump, ...]:
    """Gaps that are jumps of a clock, in order of time.

    Parameters
    ----------
    problem : Problem
    run : ForwardPass
        In which all tags were believed.
    records, bridges : (accelerometer, gyros)
        As delivered, and as the run took them.
    """
    gaps = [g for g in _gaps(records) if problem.time_s[0] < g.at_s < problem.time_s[-1] - g.by_s]
    told, path = _by_trackers(problem, run, gaps), run.states()
    edges = [-np.inf, *(g.at_s for g in gaps), np.inf]
    out = []
    for k, gap in enumerate(gaps):
        likely = told[k] + _by_swinging(gap, edges[k], edges[k + 2], bridges, path, problem.time_s)
        if likely.max() > AGAINST:
            out.append(gap._replace(after=bool(likely[0] >= likely[1])))
    return tuple(out)


def mended(record: TriadRecord, triad: int, jumps: tuple[ClockJump, ...]) -> TriadRecord:
    """Record whose tags are set back, or forward, beyond its jumps."""
    t = record.time_s.copy()
    for jump in (j for j in jumps if triad in j.triads):
        later = record.time_s > jump.at_s
        t += np.where(later, -jump.by_s, 0.0) if jump.after else np.where(later, 0.0, jump.by_s)
    return replace(record, time_s=t)


def jump_findings(jumps: tuple[ClockJump, ...], names: tuple[str, str]) -> list[Finding]:
    """One finding for each sensor and jump."""
    out = []
    for jump in jumps:
        words = f"time tags jump {1e3 * jump.by_s:.1f} ms ahead while no sample is missing: those "
        words += "behind it were set back" if jump.after else "before it were set forward"
        span = jump.at_s - 0.5 * jump.by_s, jump.at_s + 0.5 * jump.by_s
        out += [Finding(names[triad], words, *span) for triad in jump.triads]
    return out


def _gaps(records: tuple[TriadRecord, TriadRecord]) -> list[ClockJump]:
    """Short gaps of either triad or, at one time, of both."""
    found = []
    for triad, record in enumerate(records):
        step = np.diff(record.time_s)
        usual = usual_steps(step)
        longer = step - usual
        for k in np.flatnonzero((longer > PART * usual) & (longer > SHORTEST_S) & (longer < LONGEST_LAG_S)):
            found.append(ClockJump((triad,), float(record.time_s[k] + 0.5 * step[k]), float(longer[k])))
    out: list[ClockJump] = []
    for gap in sorted(found, key=lambda g: g.at_s):
        last = out[-1] if out else None
        if last is not None and gap.at_s - last.at_s < 0.5 * min(gap.by_s, last.by_s) and gap.triads != last.triads:
            out[-1] = last._replace(triads=(0, 1), by_s=0.5 * (last.by_s + gap.by_s))
        else:
            out.append(gap)
    longest = sorted(out, key=lambda g: -g.by_s)[:MOST]
    return sorted(longest, key=lambda g: g.at_s)


def _by_trackers(problem: Problem, run: ForwardPass, gaps: list[ClockJump]) -> FloatArray:
    """Logarithm of the likelihood (g, 2) of late tags after, and of early ones before each gap, against neither."""
    out = np.zeros((len(gaps), 2))
    if not gaps or not problem.motion.clocks or problem.model.wander.considered.any():
        return out
    columns = KINEMATIC + np.array([18, 19])
    nodes = np.searchsorted(problem.time_s, [g.at_s for g in gaps]).astype(np.int64)
    first, last = np.zeros_like(nodes), np.full_like(nodes, len(problem.time_s) - 1)
    both = (window_scores(problem, run, nodes, last, columns), window_scores(problem, run, first, nodes, columns))
    for side, (sign, (score, variance)) in enumerate(zip((1.0, -1.0), both, strict=True)):
        for k, gap in enumerate(gaps):
            offset = np.zeros(2)
            offset[list(gap.triads)] = sign * gap.by_s
            out[k, side] = -score[k] @ offset - 0.5 * offset @ variance[k] @ offset
    return out


def _by_swinging(
    gap: ClockJump, from_s: float, to_s: float, bridges: tuple[Bridged, Bridged], path: States, time_s: FloatArray
) -> float:
    """Logarithm of the likelihood that one clock jumped against the other, over that of none."""
    if len(gap.triads) > 1:
        return 0.0
    before = lag_between(*bridges, path, time_s, from_s, gap.at_s - gap.by_s)
    after = lag_between(*bridges, path, time_s, gap.at_s + gap.by_s, to_s)
    if before is None or after is None:
        return 0.0
    jumped = gap.by_s if gap.triads == (0,) else -gap.by_s
    return ((after.lag_s - before.lag_s) * jumped - 0.5 * jumped**2) / (after.sd_s**2 + before.sd_s**2)

"""What in the motion do the trackers contradict? Offsets of readings and clocks (GLR), and unmodelled accelerations.

**Abrupt offsets**: were a sensor's readings, or its clock, offset for a while? The generalised likelihood-ratio (GLR)
test. An offset ``d`` of readings in some steps changes the error of step ``k`` by ``B_k d``, with ``B_k`` the columns
of the sensor's bias (or clock) in its transition. With the filter's adjoint (Bryson-Frazier) ``l_k``, of mean zero and
covariance ``L_k`` where the model holds, carried backwards over a measurement and over a step,

    l- = (1 - K H)^T l+ - H^T S^-1 (y - H x),   L- = (1 - K H)^T L+ (1 - K H) + H^T S^-1 H
    l+ = F^T l-,                               L+ = F^T L- F

and summed over the steps of a window,

    s = sum B_k^T l_k,    V = cov(s),    C_k = cov(l_k, s)
    V += B^T C + C^T B + B^T L B,   C += L B   in a step,   then C = F^T C,   and C = (1 - K H)^T C at a measurement

the maximum-likelihood offset is ``-V^-1 s``, the log-likelihood ratio of an offset ``d`` against none ``-d^T s - d^T V
d / 2``, and ``s^T V^-1 s`` is chi-square where there is none. Optimal gains are presumed: with considered errors the
test is not made. Readable twin of the compiled scores: `tests.oracles.bryson_frazier`.

**Unmodelled accelerations**: a stage separates, a parachute opens, a gyro saturates: from then on the filter's
prediction is wrong by more than its covariance, and the gate rejects every point that follows. A tracker on a false
lock (a side lobe) is distinguished by the others: where any source is still accepted, the rejected one is suspect;
where none is, and none is accepted later, the motion is. Inertial sensors carry a prediction through a false lock to
where the track is accepted again; without them it is soon so uncertain that any track would be, so five seconds decide.
Then white noise of acceleration of density ``D`` along every axis is allowed between the last accepted and the first
rejected point, ten times larger each time it does not suffice. The analyst's own spans (``[[motion.disturbed]]``) are
the same noise (`recon.propagation.with_disturbances`).

What contradicts a whole tracker or a data sheet: `recon.fault_isolation`.

**Jumps of a clock.** A clock that jumps ahead leaves a gap like any other, but behind it all tags are late by the gap
(or all before it were early, where the clock was set right). For each short gap the trackers give the likelihood of so
late a clock from there on against that of none (the scores above, with the clock's column in place of a bias's), and
the lags before and after give that of one clock against the other. Where both together exceed a thousand to one, the
tags are corrected.

References
----------
A. Willsky, H. Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", IEEE Trans. Automatic Control 21 (1976) 108.
P. de Jong, J. Penzer, "Diagnosing shocks in time series", J. Am. Stat. Assoc. 93 (1998) 796.
G. Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18 (1973) 65 (the adjoint).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from flightmodel._kernels import inlined, kernel, multiply
from flightmodel.checks import Check, DivergenceError, FloatArray, IntArray, Issue
from flightmodel.statistics import ACCEPTED_ODDS
from flightmodel.telemetry import TriadRecord
from recon.imu_screening import BridgedSensor, ClockJump, TransientOffset, gaps_of_tags
from recon.kalman import ForwardPass, Innovations
from recon.measurements import SLOTS
from recon.problem import Problem
from recon.state import KINEMATIC, States
from recon.time_bias import lag_between

_BIASES = np.array([9, 10, 11, 18, 19, 20])  # columns of the transition: accelerometer, then gyros
_SCORE_LIMIT = 16.3  # of chi-square with three degrees of freedom, one in a thousand
UNMODELLED_CODE = "unmodelled-acceleration"
_REJECTED_S = 5.0  # no point accepted for so long in ballistic flight, or, in any, to the end of the track
LEAST_REJECTED_POINTS = 6  # sound points are edited so seldom that six in a row have another cause
_LEAST_ACCEPTED_SHARE = 0.5  # with fewer, the filter follows the minority
_FIRST_DENSITY, _GROWTH, _LARGEST_DENSITY = 0.1, 10.0, 1.1e6  # (m/s^2)^2/Hz
MOST_SPANS = 10  # in which inertial sensors may fail to carry the track before the flight is refused


def unsupported_offsets(
    problem: Problem, run: ForwardPass, offsets: tuple[TransientOffset, ...]
) -> tuple[TransientOffset, ...]:
    """Transient offsets that the trackers do not confirm as real motion of the vehicle.

    Parameters
    ----------
    problem : Problem
    run : ForwardPass
        Made with all readings as measured.
    offsets : tuple of TransientOffset
        With ``sensor`` 0 for the accelerometer, 1 for the gyros.
    """
    if not offsets or problem.model.wander.considered.any():  # the adjoint presumes optimal gains
        return offsets
    t = problem.time_s
    inside = [d for d in offsets if d.end_s > t[0] and d.start_s < t[-1]]
    begin = np.searchsorted(t, [d.start_s for d in inside], side="right") - 1
    end = np.searchsorted(t, [d.end_s for d in inside])
    begin, end = np.maximum(begin, 0), np.minimum(end, len(t) - 1)
    score, variance = offset_scores(problem, run, begin, end)
    out = []
    for d, a, b, s, v in zip(inside, begin, end, score, variance, strict=True):
        axes = slice(3 * d.sensor, 3 * d.sensor + 3)
        offset = d.offset * (min(d.end_s, t[b]) - max(d.start_s, t[a])) / (t[b] - t[a])
        k = 3 * d.sensor + d.axis
        log_ratio = -s[k] * offset - 0.5 * offset**2 * v[k, k]
        chi_square = s[axes] @ np.linalg.pinv(v[axes, axes], hermitian=True) @ s[axes]
        if log_ratio > -ACCEPTED_ODDS or chi_square > _SCORE_LIMIT:
            out.append(d)
    return tuple(out)


def offset_scores(
    problem: Problem, run: ForwardPass, begin: IntArray, end: IntArray, columns: IntArray = _BIASES
) -> tuple[FloatArray, FloatArray]:
    """Scores (w, c) of constant offsets of ``columns`` in the steps ``begin`` to ``end``, and covariances (w, c, c)."""
    score, variance = np.zeros((len(begin), len(columns))), np.zeros((len(begin), len(columns), len(columns)))
    if not len(begin):
        return score, variance
    order = np.argsort(-end, kind="stable")
    first, last = begin[order].astype(np.int64), end[order].astype(np.int64)
    most = int(((first[:, None] <= first) & (last[:, None] >= first)).sum(axis=0).max())
    some, more = score.copy(), variance.copy()
    passed = run.steps, problem.observed, problem.sources().slot, run.readings, run.innovations
    window_scores(*passed, columns, first, last, most, some, more)
    score[order], variance[order] = some, more
    return score, variance


@kernel
def window_scores(steps, observed, slots, readings, innovations, columns, begin, end, most, score, variance):
    """Score (w, c) of a constant offset of each of ``columns`` (c,) in the steps ``begin`` to ``end`` of each window.

    Windows come by ``end`` downwards; at most ``most`` of them meet. Score and ``variance`` (w, c, c) come as zeros.
    """
    n, size, c = len(observed.first) - 1, innovations.gain.shape[1], len(columns)
    mean, information = np.zeros(size), np.zeros((size, size))
    product, old = np.empty((size, size)), np.empty(size)
    rest, scratch = np.empty((size, 9 + SLOTS)), np.empty((size, 9 + SLOTS))
    column, partials = np.empty(9 + SLOTS, dtype=np.int64), np.empty((3, 9 + SLOTS))
    active, cross = np.full(most, -1, dtype=np.int64), np.zeros((most, c, size))
    response, moved = np.empty((c, 9)), np.empty((c, size))
    following = 0
    for b in range(n):
        k = n - 1 - b
        for a in range(observed.first[k + 1] - observed.first[k]):
            row = observed.first[k + 1] - 1 - a
            if not innovations.accepted[row]:
                continue
            slot = slots[observed.source[row]]
            adjoint_update(
                readings.by_state[row], readings.by_error[row], slot, innovations.gain[row],
                innovations.covariance[row], innovations.residual[row], observed.variance[row], mean, information, rest,
                scratch,
            )  # fmt: skip
            count = read_columns(readings.by_state[row], readings.by_error[row], slot, column, partials)
            for place in range(most):
                if active[place] >= 0:
                    cross_over_measurement(cross[place], rest, column, count, moved)
        if k == 0:
            break
        phi = steps.transition[k - 1]
        while following < len(end) and end[following] >= k:
            for place in range(most):
                if active[place] < 0:
                    active[place] = following
                    cross[place] = 0.0
                    break
            following += 1
        gather(phi, information, columns, response, moved)
        for place in range(most):
            w = active[place]
            if w >= 0:
                add_step(mean, response, moved, cross[place], score[w], variance[w])
                cross_over_step(phi, steps.decay[k - 1], cross[place], old)
                if begin[w] == k - 1:
                    active[place] = -1
        adjoint_step(phi, steps.decay[k - 1], mean, information, old, product)


@inlined
def cross_over_measurement(cross, rest, column, count, moved):
    """``C = (1 - K H)^T C``, in place; ``cross`` (c, N) holds it transposed."""
    for i in range(len(cross)):
        for a in range(count):
            value = 0.0
            for j in range(cross.shape[1]):
                value += rest[j, a] * cross[i, j]
            moved[i, a] = value
        for a in range(count):
            cross[i, column[a]] = moved[i, a]


@inlined
def cross_over_step(phi, decay, cross, old):
    """``C = F^T C``, in place."""
    size, dense = cross.shape[1], phi.shape[1]
    for i in range(len(cross)):
        for j in range(size):
            old[j] = cross[i, j]
        for j in range(size):
            value = decay[j - 9] * old[j] if j >= 9 else 0.0
            if j < dense:
                for col in range(9):
                    value += phi[col, j] * old[col]
            cross[i, j] = value


@inlined
def gather(phi, information, columns, response, moved):
    """What offsets do in a step, ``response`` (c, 9), and ``L`` times it, ``moved`` (c, N)."""
    for i in range(len(columns)):
        for col in range(9):
            response[i, col] = phi[col, columns[i]]
        for j in range(information.shape[0]):
            value = 0.0
            for col in range(9):
                value += response[i, col] * information[col, j]
            moved[i, j] = value


@inlined
def add_step(mean, response, moved, cross, score, variance):
    """Add one step to the score (c,) of a window, its variance (c, c) and its covariance with the adjoint (c, N)."""
    for i in range(len(response)):
        for col in range(9):
            score[i] += response[i, col] * mean[col]
        for j in range(len(response)):
            for col in range(9):
                variance[i, j] += (
                    response[i, col] * cross[j, col]
                    + response[j, col] * cross[i, col]
                    + response[i, col] * moved[j, col]
                )
    for i in range(len(response)):
        for j in range(cross.shape[1]):
            cross[i, j] += moved[i, j]


@inlined
def adjoint_step(phi, decay, mean, information, old, product):
    """``l = F^T l`` and ``L = F^T L F`` in place."""
    size, dense = len(mean), phi.shape[1]
    for j in range(size):
        old[j] = mean[j]
    for j in range(size):
        value = decay[j - 9] * old[j] if j >= 9 else 0.0
        if j < dense:
            for col in range(9):
                value += phi[col, j] * old[col]
        mean[j] = value
    for i in range(size):
        for j in range(size):
            product[i, j] = decay[j - 9] * information[i, j] if j >= 9 else 0.0
        for col in range(9):
            f = information[i, col]
            for j in range(dense):
                product[i, j] += f * phi[col, j]
    for i in range(size):
        f = decay[i - 9] if i >= 9 else 0.0
        for j in range(size):
            information[i, j] = f * product[i, j]
        if i < dense:
            for col in range(9):
                g = phi[col, i]
                for j in range(size):
                    information[i, j] += g * product[col, j]


@inlined
def adjoint_update(by_state, by_error, slot, gain, covariance, residual, variance, mean, information, rest, out):
    """Carry mean and information back over one measurement, in place.

    ``1 - K H`` is written out in the columns that the measurement reads (N, at most 9 + SLOTS, scratch): after a wide
    prior it is tiny, and ``L - L K H`` would leave nothing of it but rounding.
    """
    size = len(mean)
    inverse, h, weight = np.zeros((3, 3)), np.empty((3, 9 + SLOTS)), np.empty((3, 9 + SLOTS))
    column, response = np.empty(9 + SLOTS, dtype=np.int64), np.empty(9 + SLOTS)
    invert_used(covariance, variance, inverse)
    count = read_columns(by_state, by_error, slot, column, h)
    for a in range(count):
        for r in range(3):
            weight[r, a] = inverse[r, 0] * h[0, a] + inverse[r, 1] * h[1, a] + inverse[r, 2] * h[2, a]
        response[a] = 0.0
        for i in range(size):
            value = 1.0 if i == column[a] else 0.0
            for r in range(3):
                value -= gain[i, r] * h[r, a]
            rest[i, a] = value
            response[a] += value * mean[i]
        for r in range(3):
            response[a] -= weight[r, a] * residual[r]
    for a in range(count):
        mean[column[a]] = response[a]
    multiply(information, rest, size, size, count, out)
    for i in range(size):
        for a in range(count):
            information[i, column[a]] = out[i, a]
            information[column[a], i] = out[i, a]
    for a in range(count):
        for b in range(a + 1):
            value = 0.0
            for i in range(size):
                value += rest[i, a] * out[i, b]
            for r in range(3):
                value += h[r, a] * weight[r, b]
            information[column[a], column[b]], information[column[b], column[a]] = value, value


@inlined
def read_columns(by_state, by_error, slot, column, h):
    """Errors that a measurement depends on, into ``column``, and its partials by them (3, count); their number."""
    for a in range(9):
        column[a] = a
        for r in range(3):
            h[r, a] = by_state[r, a]
    count = 9
    for col in range(SLOTS):
        if slot[col] >= 0:
            column[count] = 9 + slot[col]
            for r in range(3):
                h[r, count] = by_error[r, col]
            count += 1
    return count


@inlined
def invert_used(covariance, variance, inverse):
    """Inverse (3, 3) of an innovation's covariance on the measured components; zero elsewhere."""
    c = covariance
    a00 = c[1, 1] * c[2, 2] - c[1, 2] * c[2, 1]
    a01 = c[0, 2] * c[2, 1] - c[0, 1] * c[2, 2]
    a02 = c[0, 1] * c[1, 2] - c[0, 2] * c[1, 1]
    det = c[0, 0] * a00 + c[1, 0] * a01 + c[2, 0] * a02
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = a00 / det, a01 / det, a02 / det
    inverse[1, 0], inverse[1, 1] = a01 / det, (c[0, 0] * c[2, 2] - c[0, 2] * c[2, 0]) / det
    inverse[1, 2], inverse[2, 0] = (c[0, 2] * c[1, 0] - c[0, 0] * c[1, 2]) / det, a02 / det
    inverse[2, 1] = inverse[1, 2]
    inverse[2, 2] = (c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0]) / det
    for i in range(3):
        if math.isinf(variance[i]):
            for j in range(3):
                inverse[i, j], inverse[j, i] = 0.0, 0.0


@dataclass(frozen=True)
class UnmodelledAcceleration:
    """Span in which an unknown acceleration acts, and its density, (m/s^2)^2/Hz along every axis."""

    start_s: float
    end_s: float
    density: float

    def finding(self) -> Issue:
        """Finding that names its size."""
        gained = np.sqrt(self.density * (self.end_s - self.start_s))
        remark = (
            f"unmodelled acceleration: about {gained:.2g} m/s of velocity along each axis that neither sensors nor the "
            "motion model explain; check for staging, thrust, a parachute or a saturated sensor"
        )
        return Issue(remark, UNMODELLED_CODE, "motion", self.start_s, self.end_s)


def carried_check(spans: tuple[UnmodelledAcceleration, ...]) -> Check:
    """Whether accelerometer and gyros carry the track without any acceleration that they did not measure."""
    where = ", ".join(f"{d.start_s:.1f} to {d.end_s:.1f} s" for d in spans)
    return Check.of(
        UNMODELLED_CODE, "sensors carry the track", len(spans), 0.0, 0.0, "accelerometer and gyros carry the track",
        f"the track requires an acceleration that accelerometer and gyros did not measure ({where})",
        advice="trackers that lag (time tags, a receiver beyond its dynamics), or sensors that saturate: correct or "
        "exclude these (use_s), or state the span in [[motion.disturbed]]",
    )  # fmt: skip


def with_unmodelled(problem: Problem, spans: tuple[UnmodelledAcceleration, ...]) -> Problem:
    """Problem with the process noise of unmodelled accelerations."""
    motion = problem.motion
    density = motion.force_density.copy()
    for d in spans:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        density[inside] += d.density
    return replace(problem, motion=motion._replace(force_density=density))


def _rejected_span(problem: Problem, innovations: Innovations) -> tuple[float, float] | None:
    """Last accepted and first rejected time of the first stretch in which no point is accepted; None without one."""
    tried = problem.observed.usable
    time_s = problem.time_s[problem.node][tried]
    accepted = innovations.accepted[tried]
    good = np.concatenate([[-1], np.flatnonzero(accepted), [len(accepted)]])
    for a, b in pairwise(good):
        first, last = a + 1, b - 1
        if last - first + 1 < LEAST_REJECTED_POINTS:
            continue
        ends = b == len(accepted)
        if ends or (problem.motion.ballistic and time_s[last] - time_s[first] >= _REJECTED_S):
            return (float(time_s[a]) if a >= 0 else float(problem.time_s[0])), float(time_s[first])
    return None


def track_is_lost(problem: Problem, run: ForwardPass) -> bool:
    """Whether a pass accepted less than half of the points it was offered."""
    usable = problem.observed.usable
    return bool(run.innovations.accepted[usable].mean() < _LEAST_ACCEPTED_SHARE)


def with_one_more(
    known: tuple[UnmodelledAcceleration, ...], problem: Problem, run: ForwardPass
) -> tuple[UnmodelledAcceleration, ...] | None:
    """Known spans and one more, or a stronger one, where a pass lost the track; None where it did not."""
    lost = _rejected_span(problem, run.innovations)
    if lost is None:
        return None
    # a slow departure passes the gate for a while
    start, end = max(lost[0] - 1.5, float(problem.time_s[0])), lost[1] + 0.5
    near = [d for d in known if d.start_s <= end and start <= d.end_s]
    density = max((d.density for d in near), default=_FIRST_DENSITY / _GROWTH) * _GROWTH
    if density > _LARGEST_DENSITY:
        return None
    # one that is near but did not suffice is the same one: the track was lost a little later this time
    start, end = min([start, *(d.start_s for d in near)]), max([end, *(d.end_s for d in near)])
    found = (*(d for d in known if d not in near), UnmodelledAcceleration(start, end, density))
    if not problem.motion.ballistic and len(found) > MOST_SPANS:
        raise _not_carried(found)
    return found


def _not_carried(found: tuple[UnmodelledAcceleration, ...]) -> DivergenceError:
    """Refusal of a flight that inertial sensors do not carry: each further span would cost some passes."""
    start, end = min(d.start_s for d in found), max(d.end_s for d in found)
    return DivergenceError(
        f"reconstruction: unmodelled accelerations in more than {MOST_SPANS} spans between {start:.1f} and {end:.1f} "
        "s: accelerometer and gyros do not carry the track. Run `postflight check`; check attitude_prior (q_ecef_body "
        "is scalar first and maps body vectors to ECEF), units, axes and mounting of both sensors, all time tags and "
        "t0_utc. State spans of heavy vibration in [[motion.disturbed]]",
        code="track-not-followed",
    )


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
    gaps = [g for g in gaps_of_tags(records) if problem.time_s[0] < g.at_s < problem.time_s[-1] - g.by_s]
    log_ratio, path = _by_trackers(problem, run, gaps), run.states()
    edges = [-np.inf, *(g.at_s for g in gaps), np.inf]
    out = []
    for k, gap in enumerate(gaps):
        likely = log_ratio[k] + _by_lags(gap, edges[k], edges[k + 2], sensors, path, problem.time_s)
        if likely.max() > ACCEPTED_ODDS:
            out.append(gap._replace(after=bool(likely[0] >= likely[1])))
    return tuple(out)


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

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
test is not made.

**Unmodelled accelerations**: a stage separates, a parachute opens, a gyro saturates: from then on the filter's
prediction is wrong by more than its covariance, and the gate rejects every point that follows. A tracker on a false
lock (a side lobe) is distinguished by the others: where any source is still accepted, the rejected one is suspect;
where none is, and none is accepted later, the motion is. Inertial sensors carry a prediction through a false lock to
where the track is accepted again; without them it is soon so uncertain that any track would be, so five seconds decide.
Then white noise of acceleration of density ``D`` along every axis is allowed between the last accepted and the first
rejected point, ten times larger each time it does not suffice. The analyst's own spans (``[[motion.disturbed]]``) are
the same noise (`recon.propagation.with_disturbances`).

What contradicts a whole tracker or a data sheet: `recon.fault_isolation`.

References
----------
A. Willsky, H. Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", IEEE Trans. Automatic Control 21 (1976) 108.
P. de Jong, J. Penzer, "Diagnosing shocks in time series", J. Am. Stat. Assoc. 93 (1998) 796.
G. Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18 (1973) 65 (the adjoint).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from flightmodel.checks import Check, DivergenceError, FloatArray, IntArray, Issue
from recon import _glr_kernels
from recon.ekf import ForwardPass, Innovations, Problem
from recon.imu_screening import TransientOffset

_BIASES = np.array([9, 10, 11, 18, 19, 20])  # columns of the transition: accelerometer, then gyros
LOG_LIKELIHOOD_LIMIT = np.log(1000.0)  # ratio from which one hypothesis is accepted over the other
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
        if log_ratio > -LOG_LIKELIHOOD_LIMIT or chi_square > _SCORE_LIMIT:
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
    _glr_kernels.offset_scores(
        run.steps, problem.observed, problem.sources().slot, run.innovations, columns, first, last, most, some, more
    )
    score[order], variance[order] = some, more
    return score, variance


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
        f"an acceleration that they did not measure is needed to follow the track ({where})",
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

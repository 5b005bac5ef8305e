"""When does the vehicle do what no sensor on board and no model of its motion tells? Found from the track itself.

A stage separates, a parachute opens, a gyro saturates: from then on the filter's prediction is wrong while it believes
otherwise, and the gate rejects every point that follows. That is told from a tracker that looks at something else for a
while (a side lobe) by the others: where any source is still believed, the rejected one is suspect; where none is, and
none comes back, the motion is. Inertial sensors carry a prediction through a false lock to where the track is believed
again; without them it is soon so uncertain that anything would be, so five seconds decide. Then an unknown acceleration
is allowed between the last point that was believed and the first that was not, white noise of density ``D`` along every
axis, ten times larger each time it does not suffice.

What an analyst states beforehand (``[[motion.disturbed]]``: shaking that turns into bias, a saturated gyro, thrust) is
the same noise, of accelerations and of rates.

Do the trackers tell whether a sensor's readings were off for a while? Scores of offsets that were not modelled.

An offset ``d`` of readings in some steps pushes the error of step ``k`` by ``B_k d`` with ``B_k`` the columns of the
sensor's bias in its transition. With the filter's adjoint (`recon.smoother`, Bryson-Frazier) ``l_k``, of mean zero and
covariance ``L_k`` where nothing is wrong, and summed backwards over the steps,

    s = sum B_k^T l_k,    V = cov(s),    C_k = cov(l_k, s)
    V += B^T C + C^T B + B^T L B,   C += L B   in a step,   then C = F^T C,   and C = (1 - K H)^T C at a measurement

the offset most likely is ``-V^-1 s``, the logarithm of the likelihood of an offset ``d`` against none ``-d^T s - d^T V
d / 2``, and ``s^T V^-1 s`` chi-square where there is none.

References
----------
P. de Jong, J. Penzer, "Diagnosing shocks in time series", J. Am. Stat. Assoc. 93 (1998) 796.
A. Willsky, H. Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", IEEE Trans. Automatic Control 21 (1976) 108.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.telemetry import Finding
from flightmodel.telemetry import Motion as MotionSpec
from recon import _shock_kernels
from recon.ekf import ForwardPass
from recon.imu_screening import Displaced
from recon.motion import Motion
from recon.problem import Problem
from recon.smoother import full_step, read
from recon.state import Innovations, IntArray, Observed, Steps

SOURCE = "motion"  # of the finding
LOST_S = 5.0  # nothing believed for so long in ballistic flight, or, in any, to the end of the track
LOST_POINTS = 6
LEAST_BELIEVED = 0.5
BEFORE_S, AFTER_S = 1.5, 0.5  # a slow departure passes the gate for a while
FIRST_DENSITY, GROWTH, LARGEST_DENSITY = 0.1, 10.0, 1.1e6  # (m/s^2)^2/Hz
MOST = 10  # spans in which inertial sensors may fail to carry the track, before nothing is believed of them


STATED_CORRELATION_S = 1.0  # what is disturbed keeps its value for about so long


def with_stated(motion: Motion, spec: MotionSpec) -> Motion:
    """Motion with the noise of the spans that flight.toml calls disturbed."""
    force, rate = motion.force_density.copy(), motion.rate_density.copy()
    for d in spec.disturbed:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        force[inside] += d.sd_mps2**2 * STATED_CORRELATION_S
        if not motion.ballistic:  # which has no rotation
            rate[inside] += d.sd_radps**2 * STATED_CORRELATION_S
    return motion._replace(force_density=force, rate_density=rate)


@dataclass(frozen=True)
class Disturbance:
    """Span in which an unknown acceleration acts, and its density, (m/s^2)^2/Hz along every axis."""

    start_s: float
    end_s: float
    density: float

    def finding(self) -> Finding:
        """What an analyst should know of it."""
        gained = np.sqrt(self.density * (self.end_s - self.start_s))
        words = (
            f"the track cannot be followed without an acceleration that no sensor and no model tells: up to about "
            f"{gained:.2g} m/s of velocity gained along each axis"
        )
        return Finding(SOURCE, words, self.start_s, self.end_s)


def disturbed(problem: Problem, disturbances: tuple[Disturbance, ...]) -> Problem:
    """Problem with the disturbances' noise."""
    motion = problem.motion
    density = motion.force_density.copy()
    for d in disturbances:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        density[inside] += d.density
    return replace(problem, motion=motion._replace(force_density=density))


def lost_at(problem: Problem, innovations: Innovations) -> tuple[float, float] | None:
    """Last believed and first disbelieved time of the first stretch in which nothing is believed; None without one."""
    tried = problem.observed.usable
    time_s = problem.time_s[problem.node][tried]
    believed = innovations.accepted[tried]
    good = np.concatenate([[-1], np.flatnonzero(believed), [len(believed)]])
    for a, b in pairwise(good):
        first, last = a + 1, b - 1
        if last - first + 1 < LOST_POINTS:
            continue
        ends = b == len(believed)
        if ends or (problem.motion.ballistic and time_s[last] - time_s[first] >= LOST_S):
            return (float(time_s[a]) if a >= 0 else float(problem.time_s[0])), float(time_s[first])
    return None


def is_lost(problem: Problem, run: ForwardPass) -> bool:
    """Whether a pass, with all the disturbances it was given, believed less than half of what it was offered."""
    usable = problem.observed.usable
    return bool(run.innovations.accepted[usable].mean() < LEAST_BELIEVED)


def widened(known: tuple[Disturbance, ...], problem: Problem, run: ForwardPass) -> tuple[Disturbance, ...] | None:
    """Known disturbances and one more, or a stronger one, where a pass lost the track; None where it did not."""
    lost = lost_at(problem, run.innovations)
    if lost is None:
        return None
    start, end = max(lost[0] - BEFORE_S, float(problem.time_s[0])), lost[1] + AFTER_S
    near = [d for d in known if d.start_s <= end and start <= d.end_s]
    density = max((d.density for d in near), default=FIRST_DENSITY / GROWTH) * GROWTH
    if density > LARGEST_DENSITY:
        return None
    # one that is near but did not suffice is the same one: the track was lost a little later this time
    start, end = min([start, *(d.start_s for d in near)]), max([end, *(d.end_s for d in near)])
    found = (*(d for d in known if d not in near), Disturbance(start, end, density))
    if not problem.motion.ballistic and len(found) > MOST:
        raise _not_carried(found)
    return found


def _not_carried(found: tuple[Disturbance, ...]) -> DivergenceError:
    """Refusal of a flight whose inertial sensors carry it nowhere: each span more would cost some passes."""
    start, end = min(d.start_s for d in found), max(d.end_s for d in found)
    return DivergenceError(
        f"reconstruction: accelerometer and gyros do not carry the track: in more than {MOST} spans between "
        f"{start:.1f} and {end:.1f} s accelerations would be needed that nothing tells. Look at the flight with "
        "`postflight check`; check attitude_prior (q_ecef_body has its scalar first and turns body vectors into ECEF), "
        "units, axes and mounts of both sensors, and t0_utc. Where the vehicle was shaken so often, state it in "
        "[[motion.disturbed]]"
    )


BIASES = np.array([9, 10, 11, 18, 19, 20])  # columns of the transition: accelerometer, then gyros
AGAINST = np.log(1000.0)  # likelihood of readings that were right, over that of an offset, from which they are believed
SURPRISING = 16.3  # of chi-square with three degrees of freedom, one in a thousand


def doubtful(problem: Problem, run: ForwardPass, displaced: tuple[Displaced, ...]) -> tuple[Displaced, ...]:
    """Displaced readings but those of which the trackers tell that they were right.

    Parameters
    ----------
    problem : Problem
    run : ForwardPass
        In which all readings were believed.
    displaced : tuple of Displaced
        With ``triad`` 0 for the accelerometer, 1 for the gyros.
    """
    if not displaced or problem.model.wander.considered.any():  # the adjoint presumes optimal gains
        return displaced
    t = problem.time_s
    inside = [d for d in displaced if d.end_s > t[0] and d.start_s < t[-1]]
    begin = np.searchsorted(t, [d.start_s for d in inside], side="right") - 1
    end = np.searchsorted(t, [d.end_s for d in inside])
    begin, end = np.maximum(begin, 0), np.minimum(end, len(t) - 1)
    score, variance = window_scores(problem, run, begin, end)
    out = []
    for d, a, b, s, v in zip(inside, begin, end, score, variance, strict=True):
        mine = slice(3 * d.triad, 3 * d.triad + 3)
        offset = d.offset * (min(d.end_s, t[b]) - max(d.start_s, t[a])) / (t[b] - t[a])
        k = 3 * d.triad + d.axis
        likely = -s[k] * offset - 0.5 * offset**2 * v[k, k]
        surprise = s[mine] @ np.linalg.pinv(v[mine, mine], hermitian=True) @ s[mine]
        if likely > -AGAINST or surprise > SURPRISING:
            out.append(d)
    return tuple(out)


def window_scores(
    problem: Problem, run: ForwardPass, begin: IntArray, end: IntArray, columns: IntArray = BIASES
) -> tuple[FloatArray, FloatArray]:
    """Scores (w, c) of constant offsets of ``columns`` in the steps ``begin`` to ``end``, and covariances (w, c, c)."""
    score, variance = np.zeros((len(begin), len(columns))), np.zeros((len(begin), len(columns), len(columns)))
    if not len(begin):
        return score, variance
    order = np.argsort(-end, kind="stable")
    first, last = begin[order].astype(np.int64), end[order].astype(np.int64)
    most = int(((first[:, None] <= first) & (last[:, None] >= first)).sum(axis=0).max())
    some, more = score.copy(), variance.copy()
    _shock_kernels.window_scores(
        run.steps, problem.observed, problem.sources().slot, run.innovations, columns, first, last, most, some, more
    )
    score[order], variance[order] = some, more
    return score, variance


def readable_scores(
    steps: Steps, observed: Observed, slots: IntArray, innovations: Innovations, columns: IntArray, begin: int, end: int
) -> tuple[FloatArray, FloatArray]:
    """Readable twin of `recon._shock_kernels.window_scores`, of one window: score (c,) and covariance (c, c)."""
    n, size = len(observed.first) - 1, innovations.gain.shape[1]
    mean, information, cross = np.zeros(size), np.zeros((size, size)), np.zeros((size, len(columns)))
    score, variance = np.zeros(len(columns)), np.zeros((len(columns), len(columns)))
    for k in reversed(range(n)):
        for row in reversed(range(observed.first[k], observed.first[k + 1])):
            if not innovations.accepted[row]:
                continue
            used, h = read(observed, slots, innovations, row, size)
            weight = h.T @ np.linalg.inv(innovations.covariance[row][np.ix_(used, used)])
            rest = np.eye(size) - innovations.gain[row][:, used] @ h
            mean = rest.T @ mean - weight @ innovations.residual[row, used]
            information = rest.T @ information @ rest + weight @ h
            cross = rest.T @ cross
        if k == 0:
            break
        f, _ = full_step(steps, k - 1)
        if begin <= k - 1 < end:
            push = np.zeros((size, len(columns)))
            push[:9] = f[:9, columns]
            score += push.T @ mean
            variance += push.T @ cross + cross.T @ push + push.T @ information @ push
            cross = cross + information @ push
        mean, information, cross = f.T @ mean, f.T @ information @ f, f.T @ cross
    return score, variance

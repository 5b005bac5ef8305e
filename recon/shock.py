"""Do the trackers tell whether a sensor's readings were off for a while? Scores of offsets that were not modelled.

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

import numpy as np

from flightmodel.checks import FloatArray
from recon import _shock_kernels
from recon.displaced import Displaced
from recon.ekf import ForwardPass
from recon.packed import Innovations, Observed, Steps
from recon.problem import Problem
from recon.smoother import full_step, read
from recon.state import IntArray

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

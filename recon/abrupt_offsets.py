"""Were a sensor's readings, or its clock, offset for a while? The generalised likelihood-ratio (GLR) test.

An offset ``d`` of readings in some steps changes the error of step ``k`` by ``B_k d``, with ``B_k`` the columns of the
sensor's bias (or clock) in its transition. With the filter's adjoint (Bryson-Frazier) ``l_k``, of mean zero and
covariance ``L_k`` where the model holds, carried backwards over a measurement and over a step,

    l- = (1 - K H)^T l+ - H^T S^-1 (y - H x),   L- = (1 - K H)^T L+ (1 - K H) + H^T S^-1 H
    l+ = F^T l-,                               L+ = F^T L- F

and summed over the steps of a window,

    s = sum B_k^T l_k,    V = cov(s),    C_k = cov(l_k, s)
    V += B^T C + C^T B + B^T L B,   C += L B   in a step,   then C = F^T C,   and C = (1 - K H)^T C at a measurement

the maximum-likelihood offset is ``-V^-1 s``, the log-likelihood ratio of an offset ``d`` against none ``-d^T s - d^T V
d / 2``, and ``s^T V^-1 s`` is chi-square where there is none. Optimal gains are presumed: with considered errors the
test is not made.

References
----------
A. Willsky, H. Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems", IEEE Trans. Automatic Control 21 (1976) 108.
P. de Jong, J. Penzer, "Diagnosing shocks in time series", J. Am. Stat. Assoc. 93 (1998) 796.
G. Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18 (1973) 65 (the adjoint).
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray, IntArray
from recon import _glr_kernels
from recon.ekf import ForwardPass, Problem
from recon.imu_screening import TransientOffset

_BIASES = np.array([9, 10, 11, 18, 19, 20])  # columns of the transition: accelerometer, then gyros
LOG_LIKELIHOOD_LIMIT = np.log(1000.0)  # ratio from which one hypothesis is accepted over the other
_SCORE_LIMIT = 16.3  # of chi-square with three degrees of freedom, one in a thousand


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

"""Bryson-Frazier's fixed-interval smoother and the scores of offsets, in numpy: other formulations to compare with.

Both use the adjoint of the filter (equations: `recon.fault_detection`), which inverts nothing larger than an
innovation's covariance:

    x_{k|N} = x_{k|k-1} - P_{k|k-1} l-,        P_{k|N} = P_{k|k-1} - P_{k|k-1} L- P_{k|k-1}

The smoother loses digits where smoothing takes most of a prior's variance away.
"""

from __future__ import annotations

import numpy as np

from recon.kalman import Smoothed, keep_moments
from recon.linearise import full_step, measured_rows
from recon.state import unpacked


def _before(observed, slots, readings, innovations, row, mean, information):
    """Mean and information before a measurement is used, and ``1 - K H``; as they are where it was not accepted."""
    size = len(mean)
    if not innovations.accepted[row]:
        return mean, information, np.eye(size)
    used, h = measured_rows(observed, slots, readings, row, size)
    weight = h.T @ np.linalg.inv(innovations.covariance[row][np.ix_(used, used)])
    rest = np.eye(size) - innovations.gain[row][:, used] @ h
    mean = rest.T @ mean - weight @ innovations.residual[row, used]
    return mean, rest.T @ information @ rest + weight @ h, rest


def bryson_frazier(steps, run, observed, slots, readings, innovations, x, triangles, variance):
    """Smoothed errors ``x`` (n, N) in place, and moments at kept nodes, as `recon.kalman.rauch_tung_striebel`."""
    n, size = x.shape
    mean, information = np.zeros(size), np.zeros((size, size))
    for k in reversed(range(n)):
        for row in reversed(range(observed.first[k], observed.first[k + 1])):
            mean, information, _ = _before(observed, slots, readings, innovations, row, mean, information)
        p = unpacked(run.p_minus[k])
        x[k] = run.x_minus[k] - p @ mean
        keep_moments(run, k, p - p @ information @ p, triangles, variance)
        if k > 0:
            f, _ = full_step(steps, k - 1)
            mean, information = f.T @ mean, f.T @ information @ f


def offset_scores(steps, observed, slots, readings, innovations, columns, begin, end):
    """Score (c,) and covariance (c, c) of one window; readable twin of `recon.fault_detection.window_scores`."""
    n, size = len(observed.first) - 1, innovations.gain.shape[1]
    mean, information, cross = np.zeros(size), np.zeros((size, size)), np.zeros((size, len(columns)))
    score, variance = np.zeros(len(columns)), np.zeros((len(columns), len(columns)))
    for k in reversed(range(n)):
        for row in reversed(range(observed.first[k], observed.first[k + 1])):
            mean, information, rest = _before(observed, slots, readings, innovations, row, mean, information)
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


def smooth(problem, run):
    """Smoothed errors (n, N), packed covariances (k, ...) and variances (k, N) at the kept nodes of a flight's pass."""
    kept = int(problem.kept.sum())
    x, variance = np.empty_like(run.filtered.x_plus), np.empty((kept, problem.size))
    triangles = np.empty((kept, problem.dense * (problem.dense + 1) // 2))
    bryson_frazier(
        run.steps,
        run.filtered,
        problem.observed,
        problem.sources().slot,
        run.readings,
        run.innovations,
        x,
        triangles,
        variance,
    )
    return Smoothed(x, triangles, variance)

"""Compiled scores of readings that are off for a while. Readable twin, and the equations: `recon.unmodelled`."""

from __future__ import annotations

import numpy as np

from flightmodel._kernels import inlined, kernel
from recon._bryson_frazier_kernels import adjoint_step, adjoint_update, read_columns
from recon._measurement_kernels import SLOTS


@kernel
def window_scores(steps, observed, slots, innovations, columns, begin, end, most, score, variance):
    """Score (w, c) of a constant offset of each of ``columns`` (c,) in the steps ``begin`` to ``end`` of each window.

    Windows come by ``end`` downwards; at most ``most`` of them meet. Score and ``variance`` (w, c, c) come as zeros.
    """
    n, size, c = len(observed.first) - 1, innovations.gain.shape[1], len(columns)
    mean, information = np.zeros(size), np.zeros((size, size))
    product, old = np.empty((size, size)), np.empty(size)
    rest, turned = np.empty((size, 9 + SLOTS)), np.empty((size, 9 + SLOTS))
    column, partials = np.empty(9 + SLOTS, dtype=np.int64), np.empty((3, 9 + SLOTS))
    active, cross = np.full(most, -1, dtype=np.int64), np.zeros((most, c, size))
    push, moved = np.empty((c, 9)), np.empty((c, size))
    following = 0
    for b in range(n):
        k = n - 1 - b
        for a in range(observed.first[k + 1] - observed.first[k]):
            row = observed.first[k + 1] - 1 - a
            if not innovations.accepted[row]:
                continue
            slot = slots[observed.source[row]]
            adjoint_update(
                innovations.by_state[row], innovations.by_error[row], slot, innovations.gain[row],
                innovations.covariance[row], innovations.residual[row], observed.variance[row], mean, information, True,
                rest, turned,
            )  # fmt: skip
            count = read_columns(innovations.by_state[row], innovations.by_error[row], slot, column, partials)
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
        gather(phi, information, columns, push, moved)
        for place in range(most):
            w = active[place]
            if w >= 0:
                add_step(mean, push, moved, cross[place], score[w], variance[w])
                cross_over_step(phi, steps.decay[k - 1], cross[place], old)
                if begin[w] == k - 1:
                    active[place] = -1
        adjoint_step(phi, steps.decay[k - 1], mean, information, old, product, True)


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
def gather(phi, information, columns, push, moved):
    """What offsets do in a step, ``push`` (c, 9), and ``L`` times it, ``moved`` (c, N)."""
    for i in range(len(columns)):
        for col in range(9):
            push[i, col] = phi[col, columns[i]]
        for j in range(information.shape[0]):
            value = 0.0
            for col in range(9):
                value += push[i, col] * information[col, j]
            moved[i, j] = value


@inlined
def add_step(mean, push, moved, cross, score, variance):
    """Add one step to the score (c,) of a window, its variance (c, c) and its covariance with the adjoint (c, N)."""
    for i in range(len(push)):
        for col in range(9):
            score[i] += push[i, col] * mean[col]
        for j in range(len(push)):
            for col in range(9):
                variance[i, j] += (
                    push[i, col] * cross[j, col] + push[j, col] * cross[i, col] + push[i, col] * moved[j, col]
                )
    for i in range(len(push)):
        for j in range(cross.shape[1]):
            cross[i, j] += moved[i, j]

"""Compiled scores for the generalised likelihood-ratio test of offsets; the equations: `recon.fault_detection`.

The filter's adjoint (Bryson-Frazier) is carried backwards over measurements and steps. Readable twin:
`tests.oracles.bryson_frazier`.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel, multiply
from recon._measurement_kernels import SLOTS


@kernel
def offset_scores(steps, observed, slots, innovations, columns, begin, end, most, score, variance):
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
                innovations.by_state[row], innovations.by_error[row], slot, innovations.gain[row],
                innovations.covariance[row], innovations.residual[row], observed.variance[row], mean, information, rest,
                scratch,
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
    """Which errors a measurement reads, into ``column``, and its partials by them (3, count); their number."""
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

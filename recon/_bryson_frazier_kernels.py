"""Compiled Bryson-Frazier smoother. Readable twin, and the equations: `recon.smoother`."""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel, merged
from recon._measurement_kernels import SLOTS
from recon._smoother_kernels import load_triangle, store_moments


@kernel
def bryson_frazier(steps, run, observed, slots, innovations, x, covariance, variance):
    """As `rauch_tung_striebel`, by the adjoint of the filter; nothing larger than (3, 3) is inverted."""
    n, size = x.shape
    dense = steps.transition.shape[2]
    mean, information = np.zeros(size), np.zeros((size, size))
    p, product, out, old = np.empty((size, size)), np.empty((size, size)), np.empty((size, size)), np.empty(size)
    rest, turned = np.empty((size, 9 + SLOTS)), np.empty((size, 9 + SLOTS))
    wanted = len(covariance) > 0
    for b in range(n):
        k = n - 1 - b
        for a in range(observed.first[k + 1] - observed.first[k]):
            row = observed.first[k + 1] - 1 - a
            if innovations.accepted[row]:
                adjoint_update(
                    innovations.by_state[row], innovations.by_error[row], slots[observed.source[row]],
                    innovations.gain[row], innovations.covariance[row], innovations.residual[row],
                    observed.variance[row], mean, information, wanted, rest, turned,
                )  # fmt: skip
        load_triangle(run.p_minus[k], p)
        for i in range(size):
            value = 0.0
            for j in range(size):
                value += p[i, j] * mean[j]
            x[k, i] = run.x_minus[k, i] - value
        if wanted and run.kept[k] >= 0:
            smoothed_covariance(p, information, product, out)
            store_moments(out, dense, covariance[run.kept[k]], variance[run.kept[k]])
        if k > 0:
            adjoint_step(steps.transition[k - 1], steps.decay[k - 1], mean, information, old, product, wanted)


@inlined
def smoothed_covariance(p, information, product, out):
    """``out = P - P L P``; ``product`` (N, N) is scratch."""
    size = p.shape[0]
    for i in range(size):
        for j in range(size):
            product[i, j] = 0.0
            out[i, j] = p[i, j]
        for col in range(size):
            f = p[i, col]
            for j in range(size):
                product[i, j] += f * information[col, j]
        for col in range(size):
            f = product[i, col]
            for j in range(size):
                out[i, j] -= f * p[col, j]


@inlined
def adjoint_step(phi, decay, mean, information, old, product, wanted):
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
    if not wanted:
        return
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


@merged
def adjoint_update(
    by_state, by_error, slot, gain, covariance, residual, variance, mean, information, wanted, rest, out
):
    """Carry mean and information back over one measurement, in place.

    ``1 - K H`` is written out in the columns that the measurement reads (N, at most 9 + SLOTS, scratch): after a wide
    prior it is tiny, and ``L - L K H`` would leave nothing of it but rounding.
    """
    size = len(mean)
    inverse, h, weight = np.zeros((3, 3)), np.empty((3, 9 + SLOTS)), np.empty((3, 9 + SLOTS))
    column, push = np.empty(9 + SLOTS, dtype=np.int64), np.empty(9 + SLOTS)
    invert_used(covariance, variance, inverse)
    count = read_columns(by_state, by_error, slot, column, h)
    for a in range(count):
        for r in range(3):
            weight[r, a] = inverse[r, 0] * h[0, a] + inverse[r, 1] * h[1, a] + inverse[r, 2] * h[2, a]
        push[a] = 0.0
        for i in range(size):
            value = 1.0 if i == column[a] else 0.0
            for r in range(3):
                value -= gain[i, r] * h[r, a]
            rest[i, a] = value
            push[a] += value * mean[i]
        for r in range(3):
            push[a] -= weight[r, a] * residual[r]
    for a in range(count):
        mean[column[a]] = push[a]
    if not wanted:
        return
    for i in range(size):
        for a in range(count):
            out[i, a] = 0.0
        for j in range(size):
            f = information[i, j]
            for a in range(count):
                out[i, a] += f * rest[j, a]
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

"""Compiled smoothers: Rauch-Tung-Striebel and Bryson-Frazier. Readable twin, and the equations: `recon.smoother`."""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel
from recon._measurement_kernels import SLOTS

LEAST_PIVOT = 1e-14  # of a correlation matrix; below it a direction is known exactly


@inlined
def load_triangle(triangle, p):
    """Symmetric ``p`` (N, N) from its packed lower triangle."""
    at = 0
    for i in range(p.shape[0]):
        for j in range(i + 1):
            p[i, j] = triangle[at]
            p[j, i] = triangle[at]
            at += 1


@inlined
def store_moments(p, size, triangle, variance):
    """Lower triangle of the leading rows of ``p``, and its whole diagonal."""
    at = 0
    for i in range(size):
        for j in range(i + 1):
            triangle[at] = 0.5 * (p[i, j] + p[j, i])
            at += 1
    for i in range(p.shape[0]):
        variance[i] = p[i, i]


@inlined
def solve_scaled(p, columns, scale):
    """``columns = P^-1 columns`` by rows (d, N); ``p`` becomes the factor of the correlation matrix."""
    size = p.shape[0]
    for i in range(size):
        scale[i] = math.sqrt(p[i, i])
    for i in range(size):
        for j in range(i + 1):
            p[i, j] /= scale[i] * scale[j]
    for j in range(size):
        for i in range(j, size):
            value = p[i, j]
            for col in range(j):
                value -= p[i, col] * p[j, col]
            p[i, j] = value
        p[j, j] = math.sqrt(max(p[j, j], LEAST_PIVOT))
        for i in range(j + 1, size):
            p[i, j] /= p[j, j]
    for r in range(columns.shape[0]):
        y = columns[r]
        for i in range(size):
            value = y[i] / scale[i]
            for col in range(i):
                value -= p[i, col] * y[col]
            y[i] = value / p[i, i]
        for t in range(size):
            i = size - 1 - t
            value = y[i]
            for col in range(i + 1, size):
                value -= p[col, i] * y[col]
            y[i] = value / p[i, i]
        for i in range(size):
            y[i] /= scale[i]


@inlined
def solve_square(a, b):
    """``b = a^-1 b`` in place for ``a`` (9, 9), which is destroyed; rows are exchanged for the largest pivot."""
    size, width = a.shape[0], b.shape[1]
    for j in range(size):
        best = j
        for i in range(j + 1, size):
            if abs(a[i, j]) > abs(a[best, j]):
                best = i
        if best != j:
            for col in range(size):
                a[j, col], a[best, col] = a[best, col], a[j, col]
            for col in range(width):
                b[j, col], b[best, col] = b[best, col], b[j, col]
        for i in range(j + 1, size):
            f = a[i, j] / a[j, j]
            for col in range(j, size):
                a[i, col] -= f * a[j, col]
            for col in range(width):
                b[i, col] -= f * b[j, col]
    for t in range(size):
        i = size - 1 - t
        for m in range(i + 1, size):
            for col in range(width):
                b[i, col] -= a[i, m] * b[m, col]
        for col in range(width):
            b[i, col] /= a[i, i]


@inlined
def backward_gain(phi, noise, decay, noise_var, moving, still, p, columns, scale, square, gain, added):
    """Gain rows (d, N) and added covariance (d, d) of one step; ``p`` (N, N) is the prior of the later node."""
    size, d, dense = p.shape[0], len(moving), phi.shape[1]
    for r in range(d):
        for j in range(size):
            columns[r, j] = 0.0
        if r < 9:
            for j in range(9):
                columns[r, j] = noise[r, j]
        else:
            columns[r, moving[r]] = noise_var[moving[r] - 9]
    solve_scaled(p, columns, scale)  # row r: P^-1 times column r of Q
    for r in range(d):
        for t in range(d):
            value = 0.0
            if r < 9:
                for col in range(9):
                    value += noise[r, col] * columns[t, col]
            else:
                value = noise_var[moving[r] - 9] * columns[t, moving[r]]
            q = noise[r, t] if r < 9 and t < 9 else (noise_var[moving[r] - 9] if r == t else 0.0)
            added[r, t] = q - value
        for j in range(size):
            gain[r, j] = -columns[r, j]
        gain[r, moving[r]] += 1.0
    for r in range(9, d):  # errors that wander: 1 / decay
        f = 1.0 / decay[moving[r] - 9]
        for j in range(size):
            gain[r, j] *= f
        for t in range(d):
            added[r, t] *= f
        for t in range(d):
            added[t, r] *= f
    for i in range(9):
        for j in range(9, dense):  # what drivers carry into the nine kinematic errors
            if still[j]:
                gain[i, j] -= phi[i, j]
    for r in range(9, d):
        if moving[r] < dense:
            for i in range(9):
                f = phi[i, moving[r]]
                for j in range(size):
                    gain[i, j] -= f * gain[r, j]
                for t in range(d):
                    added[i, t] -= f * added[r, t]
    for r in range(9, d):
        if moving[r] < dense:
            for i in range(9):
                for t in range(d):
                    added[t, i] -= phi[i, moving[r]] * added[t, r]
    left_inverse(phi, square, gain[:9])
    left_inverse(phi, square, added[:9])
    left_inverse(phi, square, added.T[:9])


@inlined
def left_inverse(phi, square, b):
    """``b = A^-1 b`` with ``A`` the kinematic square of ``phi``."""
    for i in range(9):
        for j in range(9):
            square[i, j] = phi[i, j]
    solve_square(square, b)


@kernel
def rauch_tung_striebel(steps, run, moving, x, covariance, variance):
    """Smooth backwards: errors ``x`` (n, N) in place of the filtered ones, moments at kept nodes where wanted.

    ``moving`` (d,) are the nine kinematic errors and those that wander. ``covariance`` (k, D (D + 1) / 2) is empty
    where only the mean is wanted.
    """
    n, size = x.shape
    d, dense = len(moving), steps.transition.shape[2]
    p, prior = run.p_last.copy(), np.empty((size, size))
    columns, gain, rows = np.empty((d, size)), np.empty((d, size)), np.empty((d, size))
    added, square, scale, step = np.empty((d, d)), np.empty((9, 9)), np.empty(size), np.empty(size)
    still = np.full(size, True)
    for r in range(d):
        still[moving[r]] = False
    wanted = len(covariance) > 0
    if wanted and run.kept[n - 1] >= 0:
        store_moments(p, dense, covariance[run.kept[n - 1]], variance[run.kept[n - 1]])
    for b in range(n - 1):
        k = n - 2 - b
        load_triangle(run.p_minus[k + 1], prior)
        backward_gain(
            steps.transition[k], steps.noise[k], steps.decay[k], steps.noise_var[k], moving, still,
            prior, columns, scale, square, gain, added,
        )  # fmt: skip
        for j in range(size):
            step[j] = x[k + 1, j] - run.x_minus[k + 1, j]
            x[k, j] += step[j]
        for r in range(d):
            value = 0.0
            for j in range(size):
                value += gain[r, j] * step[j]
            x[k, moving[r]] += value - step[moving[r]]
        if not wanted:
            continue
        for r in range(d):
            for j in range(size):
                rows[r, j] = 0.0
            for col in range(size):
                f = gain[r, col]
                for j in range(size):
                    rows[r, j] += f * p[col, j]
        for r in range(d):
            for t in range(r + 1):
                value = 0.5 * (added[r, t] + added[t, r])
                for j in range(size):
                    value += rows[r, j] * gain[t, j]
                added[r, t] = value
                added[t, r] = value
        for r in range(d):
            for j in range(size):
                p[moving[r], j] = rows[r, j]
                p[j, moving[r]] = rows[r, j]
        for r in range(d):
            for t in range(d):
                p[moving[r], moving[t]] = added[r, t]
        if run.kept[k] >= 0:
            store_moments(p, dense, covariance[run.kept[k]], variance[run.kept[k]])


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


@inlined
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

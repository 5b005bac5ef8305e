"""Compiled Rauch-Tung-Striebel smoother. Twin of the filterpy engine, and the equations: `recon.smoother`."""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel, multiply

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
def invert_kinematic(phi, square, inverse):
    """Inverse (9, 9) of the kinematic square of ``phi`` by elimination; rows are exchanged for the largest pivot."""
    for i in range(9):
        for j in range(9):
            square[i, j] = phi[i, j]
            inverse[i, j] = 1.0 if i == j else 0.0
    for j in range(9):
        best = j
        for i in range(j + 1, 9):
            if abs(square[i, j]) > abs(square[best, j]):
                best = i
        if best != j:
            for col in range(9):
                square[j, col], square[best, col] = square[best, col], square[j, col]
                inverse[j, col], inverse[best, col] = inverse[best, col], inverse[j, col]
        f = 1.0 / square[j, j]
        for col in range(9):
            square[j, col] *= f
            inverse[j, col] *= f
        for i in range(9):
            if i != j:
                f = square[i, j]
                for col in range(9):
                    square[i, col] -= f * square[j, col]
                    inverse[i, col] -= f * inverse[j, col]


@inlined
def backward_gain(phi, noise, decay, noise_var, moving, still, p, columns, scale, square, inverse, gain, added):
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
    for r in range(9, d):  # Gauss-Markov errors: 1 / decay
        f = 1.0 / decay[moving[r] - 9]
        for j in range(size):
            gain[r, j] *= f
        for t in range(d):
            added[r, t] *= f
        for t in range(d):
            added[t, r] *= f
    for j in range(9, dense):  # what drivers carry into the nine kinematic errors
        if still[j]:
            for i in range(9):
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
    invert_kinematic(phi, square, inverse)
    multiply(inverse, gain, 9, 9, size, columns)
    for i in range(9):
        for j in range(size):
            gain[i, j] = columns[i, j]
    # A^-1 (added) A^-T, in the rows and columns of the nine
    for i in range(9):
        for t in range(d):
            columns[i, t] = 0.0
            for k in range(9):
                columns[i, t] += inverse[i, k] * added[k, t]
    for i in range(9):
        for t in range(9, d):
            added[i, t] = columns[i, t]
            added[t, i] = columns[i, t]
        for j in range(9):
            added[i, j] = 0.0
            for k in range(9):
                added[i, j] += columns[i, k] * inverse[j, k]


@kernel
def rauch_tung_striebel(steps, run, moving, x, covariance, variance):
    """Smooth backwards: errors ``x`` (n, N) in place of the filtered ones, moments at kept nodes where wanted.

    ``moving`` (d,) are the nine kinematic errors and Gauss-Markov ones. ``covariance`` (k, D (D + 1) / 2) is empty
    where only the mean is wanted.
    """
    n, size = x.shape
    d, dense = len(moving), steps.transition.shape[2]
    p, prior = run.p_last.copy(), np.empty((size, size))
    columns, gain, rows = np.empty((d, size)), np.empty((d, size)), np.empty((d, size))
    added, square, inverse = np.empty((d, d)), np.empty((9, 9)), np.empty((9, 9))
    scale, step = np.empty(size), np.empty(size)
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
            prior, columns, scale, square, inverse, gain, added,
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
        multiply(gain, p, d, size, size, rows)
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

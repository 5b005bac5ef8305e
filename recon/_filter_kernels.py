"""Compiled error-state extended Kalman filter over nodes. Model, and the same on filterpy: `recon.ekf`.

The transition is dense in its nine kinematic rows alone, so a prediction costs ``9 D N`` products instead of ``2 N^3``;
a measurement's partials are dense in nine columns and its source's own errors.

Compiled Rauch-Tung-Striebel smoother. Equations: `recon.smoother`; readable twin: `tests.oracles.plain_smoother`.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import boxplus, geodetic, inlined, kernel, multiply, small_cholesky, small_solve
from recon._measurement_kernels import DECELERATION, RADAR, SLOTS, SUN, node_motion, predict, predict_deceleration
from recon._propagation_kernels import propagate_ballistic, propagate_strapdown

TWO_PI = 2.0 * math.pi
LEAST_DECAY = 1e-3  # the smoother divides by it; an error decorrelated to a thousandth is decorrelated
LEAST_PIVOT = 1e-14  # of a correlation matrix; below it a direction is known exactly


@inlined
def level_transition(phi, noise):
    """Set the transition to the identity and its noise to zero."""
    for i in range(9):
        for j in range(phi.shape[1]):
            phi[i, j] = 1.0 if i == j else 0.0
        for j in range(9):
            noise[i, j] = 0.0


@kernel
def propagate_one(motion, first, last, errors, position, velocity, q, phi, noise):
    """Carry a state in place between grid points with its transition ``phi`` (9, D) and ``noise`` (9, 9)."""
    level_transition(phi, noise)
    if motion.ballistic:
        propagate_ballistic(motion, first, last, errors, position, velocity, phi, noise)
    else:
        propagate_strapdown(motion, first, last, errors, position, velocity, q, phi, noise)


@inlined
def height_of(p, planet):
    """Geodetic height of a point (3,), m."""
    _, _, height, _ = geodetic(p[0], p[1], p[2], planet)
    return height


@inlined
def decay_and_noise(wander, dt, climb, decay, noise_var):
    """Decay of each error over a step and the variance that keeps it at its prior; whether any error moves at all."""
    moving = False
    for j in range(len(decay)):
        tau, length = wander.time_constant_s[j], wander.altitude_m[j]
        if math.isinf(tau) and math.isinf(length):
            decay[j], noise_var[j] = 1.0, wander.walk_var_per_s[j] * dt
            moving = moving or noise_var[j] > 0.0
        else:
            decay[j] = max(LEAST_DECAY, math.exp(-dt / tau - climb / length))
            noise_var[j] = wander.sd[j] * wander.sd[j] * (1.0 - decay[j] * decay[j])
            moving = True
    return moving


@inlined
def predict_covariance(p, phi, noise, decay, noise_var, moving, rows):
    """``P = F P F^T + Q`` in place; ``rows`` (9, N) is scratch."""
    size, dense = p.shape[0], phi.shape[1]
    for i in range(9):
        for j in range(size):
            rows[i, j] = 0.0
        for col in range(dense):
            f = phi[i, col]
            if f != 0.0:
                for j in range(size):
                    rows[i, j] += f * p[col, j]
    for i in range(9):
        for j in range(i + 1):
            value = noise[i, j]
            for col in range(dense):
                value += rows[i, col] * phi[j, col]
            p[i, j] = value
            p[j, i] = value
    for i in range(9):
        for j in range(9, size):
            value = rows[i, j] * decay[j - 9]
            p[i, j] = value
            p[j, i] = value
    if moving:
        for i in range(9, size):
            for j in range(9, size):
                p[i, j] *= decay[i - 9] * decay[j - 9]
            p[i, i] += noise_var[i - 9]


@inlined
def linear_step(x, phi, decay, out):
    """``out = F x``."""
    for i in range(9):
        value = 0.0
        for j in range(phi.shape[1]):
            value += phi[i, j] * x[j]
        out[i] = value
    for j in range(9, len(x)):
        out[j] = decay[j - 9] * x[j]


@inlined
def right_jacobian_columns(phi, d0, d1, d2):
    """Turn the rotation columns of ``phi`` (9, D) by ``1 - [d x] / 2 + [d x]^2 / 6``: about ``d`` off the chart."""
    s = d0 * d0 + d1 * d1 + d2 * d2
    j00, j01, j02 = 1.0 + (d0 * d0 - s) / 6.0, 0.5 * d2 + d0 * d1 / 6.0, -0.5 * d1 + d0 * d2 / 6.0
    j10, j11, j12 = -0.5 * d2 + d1 * d0 / 6.0, 1.0 + (d1 * d1 - s) / 6.0, 0.5 * d0 + d1 * d2 / 6.0
    j20, j21, j22 = 0.5 * d1 + d2 * d0 / 6.0, -0.5 * d0 + d2 * d1 / 6.0, 1.0 + (d2 * d2 - s) / 6.0
    for i in range(9):
        a, b, c = phi[i, 6], phi[i, 7], phi[i, 8]
        phi[i, 6] = a * j00 + b * j10 + c * j20
        phi[i, 7] = a * j01 + b * j11 + c * j21
        phi[i, 8] = a * j02 + b * j12 + c * j22


@inlined
def rotation_between(q, reference, out):
    """Rotation vector (3,) in body axes that leads from ``reference`` (4,) to ``q`` (4,)."""
    a, b = reference, q
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    z = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    s = math.sqrt(x * x + y * y + z * z)
    k = 2.0 * math.atan2(s, w) / s if s > 1e-12 else 2.0
    out[0], out[1], out[2] = k * x, k * y, k * z


@inlined
def cross_covariance(p, by_state, by_error, slot, count, rows, used, w):
    """``w`` (3, N) = H P and ``H P H^T`` of the used components in the leading rows of the returned scratch."""
    size = p.shape[0]
    for r in range(count):
        i = used[r]
        for j in range(size):
            w[r, j] = 0.0
        for col in range(9):
            f = by_state[i, col]
            if f != 0.0:
                for j in range(size):
                    w[r, j] += f * p[col, j]
        for col in range(SLOTS):
            if slot[col] >= 0:
                f = by_error[i, col]
                if f != 0.0:
                    for j in range(size):
                        w[r, j] += f * p[9 + slot[col], j]
    for r in range(count):
        for t in range(count):
            rows[r, t] = times(by_state[used[t]], by_error[used[t]], slot, w[r])


@inlined
def times(by_state, by_error, slot, x):
    """One row of H times a vector (N,)."""
    value = 0.0
    for col in range(9):
        value += by_state[col] * x[col]
    for col in range(SLOTS):
        if slot[col] >= 0:
            value += by_error[col] * x[9 + slot[col]]
    return value


@inlined
def gain_and_update(x, p, w, y, factor, count, used, considered, wander_sd, gain):
    """Schmidt's update in place: ``K = P H^T S^-1``, no gain for considered errors, whose own covariance stays."""
    size = len(x)
    column, k = np.empty(3), np.empty((3, size))
    any_considered = False
    for j in range(size):
        for r in range(count):
            column[r] = w[r, j]
        small_solve(factor, count, column)
        for r in range(count):
            k[r, j] = column[r]
    for i in range(size):
        for r in range(count):
            f = k[r, i]
            for j in range(size):
                p[i, j] -= f * w[r, j]
    for j in range(size):
        masked = j >= 9 and considered[j - 9]
        any_considered = any_considered or masked
        for r in range(count):
            gain[j, used[r]] = 0.0 if masked else k[r, j]
            x[j] += 0.0 if masked else k[r, j] * y[r]
    if any_considered:
        for i in range(9, size):
            for j in range(9, size):
                if considered[i - 9] and considered[j - 9]:
                    p[i, j] = wander_sd[i - 9] * wander_sd[i - 9] if i == j else 0.0
    for i in range(size):
        for j in range(i):
            value = 0.5 * (p[i, j] + p[j, i])
            p[i, j] = value
            p[j, i] = value


@kernel
def forward(motion, node_index, sources, observed, wander, gate, follow, start, steps, charts, run, innovations):
    """Run the filter through all nodes, in place.

    ``charts`` hold the start in row 0, or with ``follow`` a reference in all rows; ``start`` (N,) is the start's error
    about row 0, ``run.p_last`` its covariance. ``gate`` (4,) is the largest accepted NIS by number of components.
    """
    n, size = run.x_minus.shape
    x, x_next, p = start.copy(), np.empty(size), run.p_last
    rows = np.empty((9, size))
    for k in range(n):
        if k > 0:
            moving = advance(motion, node_index, wander, follow, steps, charts, x, x_next, k)
            predict_covariance(
                p, steps.transition[k - 1], steps.noise[k - 1], steps.decay[k - 1], steps.noise_var[k - 1], moving, rows
            )
        store_triangle(p, size, run.p_minus[k])
        for j in range(size):
            run.x_minus[k, j] = x[j]
        if observed.first[k + 1] > observed.first[k]:
            update_node(motion, node_index[k], sources, observed, wander, gate, charts, innovations, x, p, k)
        for j in range(size):
            run.x_plus[k, j] = x[j]
        if run.kept[k] >= 0:
            store_triangle(p, steps.transition.shape[2], run.p_plus[run.kept[k]])


@inlined
def store_triangle(p, size, out):
    """Lower triangle of the leading rows of ``p`` into ``out``."""
    at = 0
    for i in range(size):
        for j in range(i + 1):
            out[at] = p[i, j]
            at += 1


@inlined
def advance(motion, node_index, wander, follow, steps, charts, x, x_next, k):
    """Carry chart and error from node ``k - 1`` to ``k``; about its own estimate, or along the reference."""
    a = k - 1
    position, velocity, q = charts.position[a].copy(), charts.velocity[a].copy(), charts.q[a].copy()
    errors = charts.errors[a].copy()
    if not follow:
        for i in range(3):
            position[i] += x[i]
            velocity[i] += x[3 + i]
        boxplus(q, x[6], x[7], x[8])
        for j in range(len(errors)):
            errors[j] += x[9 + j]
    before = height_of(position, motion.planet)
    phi = steps.transition[a]
    noise = steps.noise[a]
    level_transition(phi, noise)
    first, last = node_index[a], node_index[k]
    if motion.ballistic:
        propagate_ballistic(motion, first, last, errors, position, velocity, phi, noise)
    else:
        propagate_strapdown(motion, first, last, errors, position, velocity, q, phi, noise)
    climb = abs(height_of(position, motion.planet) - before)
    dt = motion.time_s[node_index[k]] - motion.time_s[node_index[a]]
    decay = steps.decay[a]
    moving = decay_and_noise(wander, dt, climb, decay, steps.noise_var[a])
    if follow:
        linear_step(x, phi, decay, x_next)
        turn = np.empty(3)
        rotation_between(q, charts.q[k], turn)
        for i in range(3):
            x[i] = x_next[i] + position[i] - charts.position[k, i]
            x[3 + i] = x_next[3 + i] + velocity[i] - charts.velocity[k, i]
            x[6 + i] = x_next[6 + i] + turn[i]
        for j in range(len(errors)):
            x[9 + j] = x_next[9 + j] + decay[j] * errors[j] - charts.errors[k, j]
        return moving
    right_jacobian_columns(phi, x[6], x[7], x[8])
    for i in range(3):
        charts.position[k, i], charts.velocity[k, i] = position[i], velocity[i]
    for i in range(4):
        charts.q[k, i] = q[i]
    for j in range(len(errors)):
        charts.errors[k, j] = decay[j] * errors[j]
    for j in range(len(x)):
        x[j] = 0.0
    return moving


@inlined
def update_node(motion, index, sources, observed, wander, gate, charts, innovations, x, p, k):
    """Use the measurements of node ``k`` that pass the gate."""
    size = len(x)
    c, rate, acceleration = np.empty((3, 3)), np.empty((12, 3)), np.empty(3)
    h, e, y = np.empty(3), np.empty(SLOTS), np.empty(3)
    used, s, factor = np.empty(3, dtype=np.int64), np.empty((3, 3)), np.empty((3, 3))
    w = np.empty((3, size))
    position, velocity = charts.position[k], charts.velocity[k]
    node_motion(motion, index, position, velocity, charts.q[k], charts.errors[k], c, rate, acceleration)
    for row in range(observed.first[k], observed.first[k + 1]):
        source = observed.source[row]
        slot, kind = sources.slot[source], sources.kind[source]
        by_state, by_error = innovations.by_state[row], innovations.by_error[row]
        predict_reading(motion, sources, observed, charts, k, row, c, rate, acceleration, e, h, by_state, by_error)
        count = 0
        for i in range(3):
            if math.isinf(observed.variance[row, i]):
                continue
            z = observed.value[row, i] - h[i]
            if (kind == RADAR and i == 1) or (kind == SUN and i == 0):
                z -= TWO_PI * math.floor(z / TWO_PI + 0.5)
            used[count] = i
            y[count] = z - times(by_state[i], by_error[i], slot, x)
            count += 1
        cross_covariance(p, by_state, by_error, slot, count, s, used, w)
        record(innovations, row, s, y, used, count, observed.variance[row])
        small_cholesky(s, count, factor)
        nis = 0.0
        for i in range(count):
            h[i] = y[i]
            for col in range(i):
                h[i] -= factor[i, col] * h[col]
            h[i] /= factor[i, i]
            nis += h[i] * h[i]
        innovations.nis[row] = nis
        innovations.accepted[row] = nis <= gate[count] and observed.usable[row]
        if innovations.accepted[row]:
            gain_and_update(x, p, w, y, factor, count, used, wander.considered, wander.sd, innovations.gain[row])


@inlined
def predict_reading(motion, sources, observed, charts, k, row, c, rate, acceleration, e, h, by_state, by_error):
    """Prediction ``h`` (3,) of a measurement at the chart of node ``k``, and its partials.

    ``c``, ``rate`` and ``acceleration`` are of `node_motion`; ``e`` (SLOTS,) is scratch.
    """
    source = observed.source[row]
    slot, kind = sources.slot[source], sources.kind[source]
    position, velocity = charts.position[k], charts.velocity[k]
    for col in range(SLOTS):
        e[col] = charts.errors[k, slot[col]] if slot[col] >= 0 else 0.0
    predict(
        kind, sources.arm_body_m[source], sources.site_ecef_m[source], sources.dcm[source], observed.known[row], e,
        position, velocity, c, rate, acceleration, h, by_state, by_error, motion.planet,
    )  # fmt: skip
    if kind == DECELERATION:
        predict_deceleration(motion, e, position, velocity, acceleration, h, by_state, by_error)


@kernel
def predict_one(motion, index, sources, observed, charts, k, row, h, by_state, by_error):
    """`predict_reading` of one measurement, for the filterpy engine."""
    c, rate, acceleration, e = np.empty((3, 3)), np.empty((12, 3)), np.empty(3), np.empty(SLOTS)
    position, velocity = charts.position[k], charts.velocity[k]
    node_motion(motion, index, position, velocity, charts.q[k], charts.errors[k], c, rate, acceleration)
    predict_reading(motion, sources, observed, charts, k, row, c, rate, acceleration, e, h, by_state, by_error)


@inlined
def record(innovations, row, s, y, used, count, variance):
    """Add the noise to ``s`` and keep residual and covariance; components not measured are zero with unit variance."""
    for i in range(3):
        innovations.residual[row, i] = 0.0
        for j in range(3):
            innovations.covariance[row, i, j] = 1.0 if i == j else 0.0
    for r in range(count):
        s[r, r] += variance[used[r]]
        innovations.residual[row, used[r]] = y[r]
    for r in range(count):
        for t in range(count):
            innovations.covariance[row, used[r], used[t]] = s[r, t]


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

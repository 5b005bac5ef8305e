"""Compiled strapdown mechanisation with its transition matrix and process noise.

Readable twin: `recon.strapdown`, which also states the model. Kernels take what the twin takes, as plain arrays, and
check nothing. Error columns, 27 in all: position, velocity, rotation, then bias, scale and mount of the
accelerometer, then of the gyros.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import (
    GM_WGS84,
    OMEGA_WGS84,
    WGS84,
    boxplus,
    dcm_from_quaternion,
    gravitation,
    inlined,
    kernel,
)


@inlined
def turn_ecef(q, angle):
    """Turn the ECEF side of ``q`` (4,) in place by ``-angle`` rad about the Earth's axis."""
    c = math.cos(0.5 * angle)
    s = -math.sin(0.5 * angle)
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] = c * w - s * z
    q[1] = c * x - s * y
    q[2] = c * y + s * x
    q[3] = c * z + s * w


@inlined
def level(q):
    """Set the quaternion ``q`` (4,) to no rotation (element by element: array expressions take seconds to compile)."""
    q[0], q[1], q[2], q[3] = 1.0, 0.0, 0.0, 0.0


@inlined
def cross_into(a, b, out):
    """Cross product of (3,) vectors into ``out``."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    out[0] = x
    out[1] = y


@inlined
def matmul_into(a, b, out):
    """Product of 3x3 matrices into ``out`` (another array than ``a`` and ``b``)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@inlined
def mount_matrices(dcm_body_sensor, mount, body_actual, body_mount):
    """Matrix from actual sensor axes to body, and from a change of the mount vector to body (left Jacobian)."""
    turn = np.empty((3, 3))
    q = np.empty(4)
    level(q)
    boxplus(q, mount[0], mount[1], mount[2])
    dcm_from_quaternion(q[0], q[1], q[2], q[3], turn)
    matmul_into(dcm_body_sensor, turn, body_actual)
    half = np.empty((3, 3))
    half[0, 0], half[0, 1], half[0, 2] = 1.0, -0.5 * mount[2], 0.5 * mount[1]
    half[1, 0], half[1, 1], half[1, 2] = 0.5 * mount[2], 1.0, -0.5 * mount[0]
    half[2, 0], half[2, 1], half[2, 2] = -0.5 * mount[1], 0.5 * mount[0], 1.0
    matmul_into(dcm_body_sensor, half, body_mount)


@inlined
def correct_sample(before, after, errors, offset, body_actual, body_mount, value, columns):
    """Mean of two samples in body axes into ``value`` (3,), and its partials into ``columns`` (3, 9).

    ``errors[offset:offset + 6]`` are bias and scale of the triad.
    """
    for j in range(3):
        gain = 1.0 / (1.0 + errors[offset + 3 + j])
        actual = (0.5 * (before[j] + after[j]) - errors[offset + j]) * gain
        for i in range(3):
            columns[i, j] = -body_actual[i, j] * gain
            columns[i, 3 + j] = columns[i, j] * actual
    for i in range(3):
        value[i] = 0.0
        for j in range(3):
            value[i] -= columns[i, j] * (0.5 * (before[j] + after[j]) - errors[offset + j])
    for j in range(3):
        cross_into(body_mount[:, j], value, columns[:, 6 + j])


@inlined
def advance_columns(phi, dt, half_turn, dcm_mid, force, d_force, d_rate, gradient):
    """Carry the 27 columns of ``phi`` (9, 27) over one step."""
    u = np.empty(3)
    mid = np.empty(3)
    arm = np.empty(3)
    acceleration = np.empty(3)
    two_omega = 2.0 * OMEGA_WGS84
    for j in range(27):
        for i in range(3):
            u[i] = half_turn[0, i] * phi[6, j] + half_turn[1, i] * phi[7, j] + half_turn[2, i] * phi[8, j]
            mid[i] = u[i]
        if j >= 18:
            for i in range(3):
                mid[i] += 0.5 * dt * d_rate[i, j - 18]
                u[i] += dt * d_rate[i, j - 18]
        cross_into(mid, force, arm)
        if 9 <= j < 18:
            for i in range(3):
                arm[i] += d_force[i, j - 9]
        for i in range(3):
            acceleration[i] = dcm_mid[i, 0] * arm[0] + dcm_mid[i, 1] * arm[1] + dcm_mid[i, 2] * arm[2]
            for k in range(3):
                acceleration[i] += gradient[i, k] * (phi[k, j] + 0.5 * dt * phi[3 + k, j])
        vx = phi[3, j] + 0.5 * dt * acceleration[0]
        vy = phi[4, j] + 0.5 * dt * acceleration[1]
        acceleration[0] += two_omega * vy
        acceleration[1] -= two_omega * vx
        for i in range(3):
            phi[i, j] += dt * (phi[3 + i, j] + 0.5 * dt * acceleration[i])
            phi[3 + i, j] += dt * acceleration[i]
            phi[6 + i, j] = half_turn[0, i] * u[0] + half_turn[1, i] * u[1] + half_turn[2, i] * u[2]


@inlined
def noise_rows(matrix, dt, half_turn, lever):
    """Apply the step's kinematic transition to the rows of ``matrix`` (9, 9), in place."""
    for j in range(9):
        a, b, c = matrix[6, j], matrix[7, j], matrix[8, j]
        for i in range(3):
            kick = lever[i, 0] * a + lever[i, 1] * b + lever[i, 2] * c
            matrix[i, j] += dt * (matrix[3 + i, j] + 0.5 * kick)
            matrix[3 + i, j] += kick
        x = half_turn[0, 0] * a + half_turn[1, 0] * b + half_turn[2, 0] * c
        y = half_turn[0, 1] * a + half_turn[1, 1] * b + half_turn[2, 1] * c
        z = half_turn[0, 2] * a + half_turn[1, 2] * b + half_turn[2, 2] * c
        for i in range(3):
            matrix[6 + i, j] = half_turn[0, i] * x + half_turn[1, i] * y + half_turn[2, i] * z


@inlined
def advance_noise(noise, dt, half_turn, dcm_mid, force, force_density, rate_density):
    """Carry the process noise (9, 9) over one step and add the step's own white noise."""
    lever = np.empty((3, 3))
    for i in range(3):
        r0, r1, r2 = dt * dcm_mid[i, 0], dt * dcm_mid[i, 1], dt * dcm_mid[i, 2]
        lever[i, 0] = r2 * force[1] - r1 * force[2]
        lever[i, 1] = r0 * force[2] - r2 * force[0]
        lever[i, 2] = r1 * force[0] - r0 * force[1]
    noise_rows(noise, dt, half_turn, lever)
    noise_rows(noise.T, dt, half_turn, lever)
    span = abs(dt)
    for i in range(3):
        noise[6 + i, 6 + i] += rate_density[i] * span
        for j in range(3):
            value = 0.0
            for k in range(3):
                value += dcm_mid[i, k] * force_density[k] * dcm_mid[j, k]
            noise[3 + i, 3 + j] += value * span
            noise[i, 3 + j] += 0.5 * value * span * dt
            noise[3 + j, i] += 0.5 * value * span * dt
            noise[i, j] += value * span * dt * dt / 3.0


@inlined
def advance_state(position, velocity, q, q_mid, dt, force, rate, half_turn, dcm_mid, gradient):
    """Carry the state over one step in place; leaves mid-step attitude, half turn and gravity gradient behind."""
    one = np.empty(4)
    level(one)
    h = 0.5 * dt
    boxplus(one, h * rate[0], h * rate[1], h * rate[2])
    dcm_from_quaternion(one[0], one[1], one[2], one[3], half_turn)
    for i in range(4):
        q_mid[i] = q[i]
    boxplus(q_mid, h * rate[0], h * rate[1], h * rate[2])
    turn_ecef(q_mid, OMEGA_WGS84 * h)
    dcm_from_quaternion(q_mid[0], q_mid[1], q_mid[2], q_mid[3], dcm_mid)
    for i in range(4):
        q[i] = q_mid[i]
    boxplus(q, h * rate[0], h * rate[1], h * rate[2])
    turn_ecef(q, OMEGA_WGS84 * h)

    x = position[0] + h * velocity[0]
    y = position[1] + h * velocity[1]
    z = position[2] + h * velocity[2]
    gx, gy, gz = gravitation(x, y, z, WGS84)
    w2 = OMEGA_WGS84 * OMEGA_WGS84
    ax = dcm_mid[0, 0] * force[0] + dcm_mid[0, 1] * force[1] + dcm_mid[0, 2] * force[2] + gx + w2 * x
    ay = dcm_mid[1, 0] * force[0] + dcm_mid[1, 1] * force[1] + dcm_mid[1, 2] * force[2] + gy + w2 * y
    az = dcm_mid[2, 0] * force[0] + dcm_mid[2, 1] * force[1] + dcm_mid[2, 2] * force[2] + gz
    two = 2.0 * OMEGA_WGS84
    vx = velocity[0] + h * (ax + two * velocity[1])
    vy = velocity[1] + h * (ay - two * velocity[0])
    ax += two * vy
    ay -= two * vx
    position[0] += dt * (velocity[0] + h * ax)
    position[1] += dt * (velocity[1] + h * ay)
    position[2] += dt * (velocity[2] + h * az)
    velocity[0] += dt * ax
    velocity[1] += dt * ay
    velocity[2] += dt * az

    r2 = x * x + y * y + z * z
    k = GM_WGS84 / (r2 * math.sqrt(r2))
    point = (x, y, z)
    for i in range(3):
        for j in range(3):
            gradient[i, j] = 3.0 * k * point[i] * point[j] / r2
        gradient[i, i] -= k
    gradient[0, 0] += w2
    gradient[1, 1] += w2


@inlined
def propagate(
    time, force_sensor, rate_sensor, force_density, rate_density, first, last, dcm_force, dcm_rate, errors,
    position, velocity, q, phi, noise,
):  # fmt: skip
    """Carry a state in place from grid point ``first`` to ``last`` (either direction) with ``phi`` and ``noise``.

    ``phi`` (9, 27) and ``noise`` (9, 9) are overwritten. Densities hold from a grid point to the next later one.
    """
    for i in range(9):
        for j in range(27):
            phi[i, j] = 1.0 if i == j else 0.0
        for j in range(9):
            noise[i, j] = 0.0
    force_actual, force_mount = np.empty((3, 3)), np.empty((3, 3))
    rate_actual, rate_mount = np.empty((3, 3)), np.empty((3, 3))
    mount_matrices(dcm_force, errors[6:9], force_actual, force_mount)
    mount_matrices(dcm_rate, errors[15:18], rate_actual, rate_mount)
    force, rate, q_mid = np.empty(3), np.empty(3), np.empty(4)
    d_force, d_rate = np.empty((3, 9)), np.empty((3, 9))
    half_turn, dcm_mid, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    step = 1 if last >= first else -1
    for k in range(first, last, step):
        dt = time[k + step] - time[k]
        j = min(k, k + step)
        correct_sample(force_sensor[k], force_sensor[k + step], errors, 0, force_actual, force_mount, force, d_force)
        correct_sample(rate_sensor[k], rate_sensor[k + step], errors, 9, rate_actual, rate_mount, rate, d_rate)
        advance_state(position, velocity, q, q_mid, dt, force, rate, half_turn, dcm_mid, gradient)
        advance_columns(phi, dt, half_turn, dcm_mid, force, d_force, d_rate, gradient)
        advance_noise(noise, dt, half_turn, dcm_mid, force, force_density[j], rate_density[j])


@kernel
def propagate_all(
    time, force_sensor, rate_sensor, force_density, rate_density, node_index, dcm_force, dcm_rate, errors,
    position, velocity, q, phi, noise,
):  # fmt: skip
    """Carry every node's state in place to the next node: rows of ``position``, ``velocity``, ``q``, ``errors``."""
    for k in range(len(node_index) - 1):
        propagate(
            time, force_sensor, rate_sensor, force_density, rate_density, node_index[k], node_index[k + 1],
            dcm_force, dcm_rate, errors[k], position[k], velocity[k], q[k], phi[k], noise[k],
        )  # fmt: skip


@kernel
def propagate_chain(
    time, force_sensor, rate_sensor, force_density, rate_density, node_index, known, dcm_force, dcm_rate, errors,
    position, velocity, q,
):  # fmt: skip
    """Fill the rows of nodes that are not ``known`` by carrying the row before, in place."""
    phi, noise = np.empty((9, 27)), np.empty((9, 9))
    for k in range(len(node_index) - 1):
        if known[k + 1]:
            continue
        for i in range(3):
            position[k + 1, i], velocity[k + 1, i] = position[k, i], velocity[k, i]
        for i in range(4):
            q[k + 1, i] = q[k, i]
        propagate(
            time, force_sensor, rate_sensor, force_density, rate_density, node_index[k], node_index[k + 1],
            dcm_force, dcm_rate, errors[k], position[k + 1], velocity[k + 1], q[k + 1], phi, noise,
        )  # fmt: skip


@kernel
def radar_prediction(dcm_ned_ecef, site, arm, position, velocity, q, bias, rate, h, jacobian):
    """Range, azimuth, elevation into ``h`` (3,) and partials into ``jacobian`` (3, 13); twin: `recon.measurements`.

    Columns: position, velocity, rotation, the radar's four errors. ``rate`` is against inertial space.
    """
    c, m = np.empty((3, 3)), np.empty((3, 3))
    dcm_from_quaternion(q[0], q[1], q[2], q[3], c)
    turn, swing, effective, moving, ned = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        turn[i] = rate[i] - OMEGA_WGS84 * c[2, i]
    cross_into(turn, arm, swing)
    tau = bias[3]
    for i in range(3):
        effective[i] = arm[i] - tau * swing[i]
        moving[i] = velocity[i] + c[i, 0] * swing[0] + c[i, 1] * swing[1] + c[i, 2] * swing[2]
    for i in range(3):
        ned[i] = 0.0
        for j in range(3):
            at = position[j] - site[j] + c[j, 0] * arm[0] + c[j, 1] * arm[1] + c[j, 2] * arm[2] - tau * moving[j]
            ned[i] += dcm_ned_ecef[i, j] * at
    n, e, d = ned[0], ned[1], ned[2]
    level2 = n * n + e * e
    level = math.sqrt(level2)
    slant2 = level2 + d * d
    slant = math.sqrt(slant2)
    h[0] = slant + bias[0]
    h[1] = math.atan2(e, n) + bias[1]
    h[2] = math.atan2(-d, level) + bias[2]
    m[0, 0], m[0, 1], m[0, 2] = n / slant, e / slant, d / slant
    m[1, 0], m[1, 1], m[1, 2] = -e / level2, n / level2, 0.0
    m[2, 0], m[2, 1], m[2, 2] = d * n / (slant2 * level), d * e / (slant2 * level), -level / slant2
    for i in range(3):
        for j in range(13):
            jacobian[i, j] = 0.0
    row, lever = np.empty(3), np.empty(3)
    for i in range(3):
        jacobian[i, 9 + i] = 1.0
        for j in range(3):
            jacobian[i, j] = m[i, 0] * dcm_ned_ecef[0, j] + m[i, 1] * dcm_ned_ecef[1, j] + m[i, 2] * dcm_ned_ecef[2, j]
            jacobian[i, 3 + j] = -tau * jacobian[i, j]
            jacobian[i, 12] -= jacobian[i, j] * moving[j]
        for j in range(3):
            row[j] = jacobian[i, 0] * c[0, j] + jacobian[i, 1] * c[1, j] + jacobian[i, 2] * c[2, j]
        cross_into(effective, row, lever)  # row . (rotation x effective) = rotation . (effective x row)
        for j in range(3):
            jacobian[i, 6 + j] = lever[j]


@kernel
def normalised_square(y, cov):
    """``y^T cov^-1 y`` of three components by Cholesky factors."""
    a = math.sqrt(cov[0, 0])
    b = cov[1, 0] / a
    c = cov[2, 0] / a
    d = math.sqrt(cov[1, 1] - b * b)
    e = (cov[2, 1] - b * c) / d
    f = math.sqrt(cov[2, 2] - c * c - e * e)
    u = y[0] / a
    v = (y[1] - b * u) / d
    w = (y[2] - c * u - e * v) / f
    return u * u + v * v + w * w

"""Compiled ballistic motion: gravity, drag and side force in the sounding's air. Model: `recon.ballistic`.


The state is position and velocity; the six drivers are the logarithm of the drag area, two side forces as fractions of
the drag, and density, wind north and wind east in units of their standard deviations.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import OMEGA_WGS84, WGS84, geodetic, gravitation, inlined

# a filter far from its track may ask for a drag that stops the vehicle within a step: such a step is taken in parts.
# Drag falls with the speed it takes, so their number grows as the logarithm of the drag
MOST_CHANGE = 0.2  # of the velocity in a part: the transition's second order then errs by 1e-2 of itself
MOST_PARTS = 64  # backwards in time drag grows without bound


@inlined
def ballistic_acceleration(air, x, y, z, vx, vy, vz, e0, e1, e2, e3, e4, e5):
    """Acceleration against the rotating Earth, m/s^2, and the rate 1/s at which the air changes the velocity."""
    sin_lat, cos_lat, height, per_p = geodetic(x, y, z, WGS84)
    at = (height - air.from_m) / air.step_m
    row = int(min(max(at, 0.0), len(air.table) - 2.0))
    w = min(max(at - row, 0.0), 1.0)
    low, high = air.table[row], air.table[row + 1]
    density = math.exp(low[0] + w * (high[0] - low[0]) + e3 * (low[3] + w * (high[3] - low[3])))
    wind_sd = low[4] + w * (high[4] - low[4])
    north = low[1] + w * (high[1] - low[1]) + e4 * wind_sd
    east = low[2] + w * (high[2] - low[2]) + e5 * wind_sd
    ce, se = x * per_p, y * per_p
    ux = vx + sin_lat * ce * north + se * east
    uy = vy + sin_lat * se * north - ce * east
    uz = vz - cos_lat * north
    speed = math.sqrt(ux * ux + uy * uy + uz * uz) + 1e-9
    # a filter far from its track may ask for any drag; e^8 is a parachute on a needle
    k = 0.5 * density * air.drag_m2pkg * math.exp(min(max(e0, -8.0), 8.0)) * speed
    # normal to the flow: normal to the path's plane, and in it
    m = 1.0 / speed
    px, py, pz = air.across[0], air.across[1], air.across[2]
    along = m * m * (px * ux + py * uy + pz * uz)
    ax, ay, az = px - along * ux, py - along * uy, pz - along * uz
    n = 1.0 / (math.sqrt(ax * ax + ay * ay + az * az) + 1e-9)
    ax, ay, az = ax * n, ay * n, az * n
    bx, by, bz = m * (uy * az - uz * ay), m * (uz * ax - ux * az), m * (ux * ay - uy * ax)
    gx, gy, gz = gravitation(x, y, z, WGS84)
    w2, two = OMEGA_WGS84 * OMEGA_WGS84, 2.0 * OMEGA_WGS84
    fx = k * (speed * (e1 * ax + e2 * bx) - ux) + gx + w2 * x + two * vy
    fy = k * (speed * (e1 * ay + e2 * by) - uy) + gy + w2 * y - two * vx
    return fx, fy, k * (speed * (e1 * az + e2 * bz) - uz) + gz, k * math.sqrt(1.0 + e1 * e1 + e2 * e2)


@inlined
def ballistic_partials(air, point, partials):
    """Partials (3, 12) of the acceleration by position, velocity and drivers ``point`` (12,), central differences."""
    p = np.empty(12)
    for j in range(12):
        p[j] = point[j]
    for j in range(12):
        h = 1.0 if j < 3 else (0.01 if j < 6 else 1e-4)
        p[j] = point[j] + h
        a = ballistic_acceleration(air, p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11])
        p[j] = point[j] - h
        b = ballistic_acceleration(air, p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11])
        p[j] = point[j]
        partials[0, j] = (a[0] - b[0]) / (2.0 * h)
        partials[1, j] = (a[1] - b[1]) / (2.0 * h)
        partials[2, j] = (a[2] - b[2]) / (2.0 * h)


@inlined
def ballistic_step(air, dt, point, stage, slope, mid):
    """Carry position and velocity ``point[:6]`` over a step by Runge and Kutta's fourth-order rule.

    ``mid`` (12,) is the point half way; ``stage`` (12,) and ``slope`` (6,) are scratch.
    """
    for j in range(12):
        stage[j] = point[j]
    for j in range(6):
        slope[j] = 0.0
    for i in range(4):
        s = stage
        a0, a1, a2, _ = ballistic_acceleration(
            air, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11]
        )
        weight = 1.0 / 6.0 if i == 0 or i == 3 else 1.0 / 3.0
        ahead = dt if i == 2 else 0.5 * dt
        v0, v1, v2 = s[3], s[4], s[5]
        slope[0] += weight * v0
        slope[1] += weight * v1
        slope[2] += weight * v2
        slope[3] += weight * a0
        slope[4] += weight * a1
        slope[5] += weight * a2
        stage[0], stage[1], stage[2] = point[0] + ahead * v0, point[1] + ahead * v1, point[2] + ahead * v2
        stage[3], stage[4], stage[5] = point[3] + ahead * a0, point[4] + ahead * a1, point[5] + ahead * a2
        if i == 1:  # the second estimate of half way
            for j in range(12):
                mid[j] = stage[j]
    for j in range(6):
        point[j] += dt * slope[j]


@inlined
def ballistic_transition(partials, dt, full):
    """Transition (6, 12) of a step, ``1 + M dt + M^2 dt^2 / 2``, from the acceleration's partials (3, 12) half way."""
    for i in range(3):
        for j in range(12):
            a = partials[i, j]
            b = 0.0
            for k in range(3):
                b += partials[i, 3 + k] * partials[k, j]
            if 3 <= j < 6:
                b += partials[i, j - 3]
            full[3 + i, j] = dt * a + 0.5 * dt * dt * b
            full[i, j] = 0.5 * dt * dt * a
        full[i, i] += 1.0
        full[i, 3 + i] += dt
        full[3 + i, 3 + i] += 1.0


@inlined
def followed(air, point, rest):
    """Part of a step ``rest`` in which the air changes the velocity by no more than `MOST_CHANGE`."""
    s = point
    a = ballistic_acceleration(
        air, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11]
    )  # fmt: skip
    change = a[3] * abs(rest)
    return rest if change <= MOST_CHANGE else rest * MOST_CHANGE / change


@inlined
def accumulate(full, density, dt, phi, noise, old):
    """Transition ``phi`` (9, 15) and ``noise`` (9, 9) of all steps so far; ``old`` (6, 15) is scratch."""
    for i in range(6):
        for j in range(15):
            old[i, j] = phi[i, j]
    for i in range(6):
        for j in range(15):
            value = full[i, j - 3] if j >= 9 else 0.0
            for m in range(6):
                value += full[i, m] * old[m, j]
            phi[i, j] = value
    for i in range(6):
        for j in range(6):
            old[i, j] = 0.0
            for m in range(6):
                old[i, j] += full[i, m] * noise[m, j]
    for i in range(6):
        for j in range(6):
            noise[i, j] = 0.0
            for m in range(6):
                noise[i, j] += old[i, m] * full[j, m]
    for i in range(3):
        q = density[i] * abs(dt)
        noise[i, i] += q * dt * dt / 3.0
        noise[i, 3 + i] += 0.5 * q * dt
        noise[3 + i, i] += 0.5 * q * dt
        noise[3 + i, 3 + i] += q


@inlined
def propagate_ballistic(motion, air, first, last, errors, position, velocity, phi, noise):
    """Carry a state in place between grid points, with ``phi`` (9, 15) and ``noise`` (9, 9) from identity and zero."""
    point, stage, slope, mid = np.empty(12), np.empty(12), np.empty(6), np.empty(12)
    partials, full, old = np.empty((3, 12)), np.empty((6, 12)), np.empty((6, 15))
    for j in range(3):
        point[j], point[3 + j] = position[j], velocity[j]
    for j in range(6):
        point[6 + j] = errors[j]
    step = 1 if last >= first else -1
    for k in range(first, last, step):
        density = motion.force_density[min(k, k + step)]
        rest, parts = motion.time_s[k + step] - motion.time_s[k], 0
        while rest != 0.0 and parts < MOST_PARTS:
            parts += 1
            dt = followed(air, point, rest) if parts < MOST_PARTS else rest
            rest -= dt
            ballistic_step(air, dt, point, stage, slope, mid)
            ballistic_partials(air, mid, partials)
            ballistic_transition(partials, dt, full)
            accumulate(full, density, dt, phi, noise, old)
    for j in range(3):
        position[j], velocity[j] = point[j], point[3 + j]

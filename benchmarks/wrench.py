"""Gravity and aerodynamics for a MuJoCo model of the vehicle, compiled and in numpy: what MuJoCo's user would write.

Both write ``xfrc_applied``: force at the c.g. and moment, world (ECI) axes, of the shell (row 1) and the body (row 2).
"""

import math
from dataclasses import dataclass

import numba
import numpy as np

from flightmodel import _kernels as la
from flightmodel import earth
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from synthetic_flight import simulate
from tests.oracles.plain_rotations import matrix


@dataclass(frozen=True)
class Constants:
    """Masses, arms and tables; ``numbers``: masses, reference area and length, shell's c.g. from the nose, joint from
    the nose, body's c.g. from the joint."""

    numbers: FloatArray
    air: FloatArray
    grid: FloatArray
    mach: FloatArray
    coefficients: FloatArray
    free: FloatArray


def constants(vehicle: Vehicle, atmosphere: FloatArray) -> Constants:
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint_m
    head = [shell.mass_kg, body.mass_kg, vehicle.reference.area_m2, vehicle.reference.length_m]
    air, grid, mach, coefficients, free = simulate.kernel_tables(vehicle, atmosphere)
    numbers = np.concatenate([head, shell.cg_m, joint, body.cg_m - joint])
    return Constants(numbers, air[0], grid, mach, coefficients, free)


@numba.njit(error_model="numpy", fastmath=la.FASTMATH)
def _compiled(qpos, qvel, out, planet, n, air, grid, mach, table, free):
    r = la.rotation(qpos[3], qpos[4], qpos[5], qpos[6])
    sin_lat, cos_lat, altitude, per_axis = la.geodetic(qpos[0], qpos[1], qpos[2], planet)
    u = max((altitude - grid[0]) * grid[1], 0.0)
    k = min(int(u), air.shape[0] - 2)
    f = min(u - k, 1.0)
    density = air[k, 0] * math.exp(f * air[k, 1])
    sound = air[k, 2] + f * (air[k + 1, 2] - air[k, 2])
    thin = air[k, 5] + f * (air[k + 1, 5] - air[k, 5])
    north, east = air[k, 3] + f * (air[k + 1, 3] - air[k, 3]), air[k, 4] + f * (air[k + 1, 4] - air[k, 4])
    sl, cl = qpos[1] * per_axis, qpos[0] * per_axis
    u, v, w = la.back(
        r,
        qvel[0] + planet[4] * qpos[1] + north * sin_lat * cl + east * sl,
        qvel[1] - planet[4] * qpos[0] + north * sin_lat * sl - east * cl,
        qvel[2] - north * cos_lat,
    )
    lateral, speed = math.sqrt(v * v + w * w), math.sqrt(u * u + v * v + w * w)
    number, m = speed / sound, 0
    while m < mach.shape[0] - 2 and number > mach[m + 1]:
        m += 1
    f = min(max((number - mach[m]) / (mach[m + 1] - mach[m]), 0.0), 1.0)
    a = la.atan2(lateral, u) * grid[2]
    j = min(int(a), table.shape[1] - 2)
    h = a - j
    b00, b01, b10, b11 = (1.0 - f) * (1.0 - h), (1.0 - f) * h, f * (1.0 - h), f * h
    ca = b00 * table[m, j, 0] + b01 * table[m, j + 1, 0] + b10 * table[m + 1, j, 0] + b11 * table[m + 1, j + 1, 0]
    cn = b00 * table[m, j, 1] + b01 * table[m, j + 1, 1] + b10 * table[m + 1, j, 1] + b11 * table[m + 1, j + 1, 1]
    cm = b00 * table[m, j, 2] + b01 * table[m, j + 1, 2] + b10 * table[m + 1, j, 2] + b11 * table[m + 1, j + 1, 2]
    cq = b00 * table[m, j, 3] + b01 * table[m, j + 1, 3] + b10 * table[m + 1, j, 3] + b11 * table[m + 1, j + 1, 3]
    if thin > 0.0:
        ca += thin * ((1.0 - h) * free[j, 0] + h * free[j + 1, 0] - ca)
        cn += thin * ((1.0 - h) * free[j, 1] + h * free[j + 1, 1] - cn)
        cm += thin * ((1.0 - h) * free[j, 2] + h * free[j + 1, 2] - cm)
        cq += thin * ((1.0 - h) * free[j, 3] + h * free[j + 1, 3] - cq)
    ny, nz = v / (lateral + 1e-12), w / (lateral + 1e-12)
    qs = 0.5 * density * speed * speed * n[2]
    damping = 0.25 * density * speed * n[2] * n[3] * n[3] * cq
    fx, fy, fz = -qs * ca, -qs * cn * ny, -qs * cn * nz
    mx, my, mz = la.cross(-n[4], -n[5], -n[6], fx, fy, fz)
    my += qs * n[3] * cm * nz + damping * qvel[4]
    mz += damping * qvel[5] - qs * n[3] * cm * ny
    x, y, z = la.times(r, n[4], n[5], n[6])
    g0, g1, g2 = la.gravitation(qpos[0] + x, qpos[1] + y, qpos[2] + z, planet)
    fx, fy, fz = la.times(r, fx, fy, fz)
    out[1, 0], out[1, 1], out[1, 2] = n[0] * g0 + fx, n[0] * g1 + fy, n[0] * g2 + fz
    out[1, 3], out[1, 4], out[1, 5] = la.times(r, mx, my, mz)
    c = la.rotation(qpos[7], qpos[8], qpos[9], qpos[10])
    x, y, z = la.times(c, n[10], n[11], n[12])
    x, y, z = la.times(r, n[7] + x, n[8] + y, n[9] + z)
    g0, g1, g2 = la.gravitation(qpos[0] + x, qpos[1] + y, qpos[2] + z, planet)
    out[2, 0], out[2, 1], out[2, 2] = n[1] * g0, n[1] * g1, n[1] * g2


def compiled_wrench(c: Constants):
    """Return ``wrench(qpos, qvel, xfrc_applied)``."""

    numbers, air, grid, mach, table, free = c.numbers, c.air, c.grid, c.mach, c.coefficients, c.free
    planet = tuple(earth.WGS84)  # numba takes a plain tuple several times faster than a named one

    def wrench(qpos, qvel, out):
        _compiled(qpos, qvel, out, planet, numbers, air, grid, mach, table, free)

    return wrench


def numpy_wrench(c: Constants):
    """Return the same in numpy: arrays where they help, floats where numpy would be slow on three numbers."""
    gm, j2, a, flat, rate = earth.WGS84[:5]
    e2 = flat * (2.0 - flat)
    mass_a, mass_b, area, length = (float(x) for x in c.numbers[:4])
    cg_a, joint, cg_b = c.numbers[4:7], c.numbers[7:10], c.numbers[10:13]
    start, per_step, per_alpha = (float(x) for x in c.grid)
    knots, table, air, free = c.mach, c.coefficients, c.air, c.free

    def gravity(p):
        r2 = float(p @ p)
        k, s = 1.5 * j2 * a * a / r2, 5.0 * float(p[2]) ** 2 / r2
        lateral = 1.0 + k * (1.0 - s)
        return (-gm / (r2 * math.sqrt(r2))) * p * np.array([lateral, lateral, 1.0 + k * (3.0 - s)])

    def wrench(qpos, qvel, out):
        r = matrix(qpos[3:7].tolist())
        nose = qpos[:3]
        x, y, z = nose.tolist()
        axis = math.hypot(x, y)
        latitude = math.atan2(z, axis * (1.0 - e2))
        for _ in range(2):
            s = math.sin(latitude)
            latitude = math.atan2(z + e2 * a / math.sqrt(1.0 - e2 * s * s) * s, axis)
        s, cos_lat = math.sin(latitude), math.cos(latitude)
        altitude = axis * cos_lat + z * s - a * math.sqrt(1.0 - e2 * s * s)
        u = max((altitude - start) * per_step, 0.0)
        k = min(int(u), len(air) - 2)
        f = min(u - k, 1.0)
        _, _, sound, north, east, thin = (air[k] + f * (air[k + 1] - air[k])).tolist()
        density = float(air[k, 0]) * math.exp(f * float(air[k, 1]))
        sl, cl = y / axis, x / axis
        stream = np.array(
            [rate * y + north * s * cl + east * sl, -rate * x + north * s * sl - east * cl, -north * cos_lat]
        )
        u, v, w = (r.T @ (qvel[:3] + stream)).tolist()
        lateral, speed = math.hypot(v, w), math.sqrt(u * u + v * v + w * w)
        mach = speed / sound
        m = min(max(int(np.searchsorted(knots, mach)) - 1, 0), len(knots) - 2)
        f = min(max((mach - float(knots[m])) / float(knots[m + 1] - knots[m]), 0.0), 1.0)
        angle = math.atan2(lateral, u) * per_alpha
        j = min(int(angle), table.shape[1] - 2)
        h = angle - j
        low = table[m, j] + h * (table[m, j + 1] - table[m, j])
        high = table[m + 1, j] + h * (table[m + 1, j + 1] - table[m + 1, j])
        c = low + f * (high - low)
        if thin > 0.0:
            c += thin * (free[j] + h * (free[j + 1] - free[j]) - c)
        ca, cn, cm, cmq = c.tolist()
        ny, nz = v / (lateral + 1e-12), w / (lateral + 1e-12)
        qs, damping = 0.5 * density * speed * speed * area, 0.25 * density * speed * area * length * length * cmq
        fx, fy, fz = -qs * ca, -qs * cn * ny, -qs * cn * nz
        cx, cy, cz = cg_a.tolist()
        turn = qs * length * cm
        moment = [
            cz * fy - cy * fz,
            cx * fz - cz * fx + turn * nz + damping * float(qvel[4]),
            cy * fx - cx * fy + damping * float(qvel[5]) - turn * ny,
        ]
        out[1, :3] = mass_a * gravity(nose + r @ cg_a) + r @ np.array([fx, fy, fz])
        out[1, 3:] = r @ np.array(moment)
        out[2, :3] = mass_b * gravity(nose + r @ (joint + matrix(qpos[7:11].tolist()) @ cg_b))

    return wrench

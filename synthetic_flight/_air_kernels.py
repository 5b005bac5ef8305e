"""Compiled air: where the nose is, what blows there, and the aerodynamic wrench; vector loops over lanes.

Readable twin: `synthetic_flight.dynamics.aerodynamics`. The workspace: `synthetic_flight._workspace_kernels`.
"""

from __future__ import annotations

import math

from flightmodel import _kernels as la
from flightmodel._kernels import inlined, kernel
from synthetic_flight import _workspace_kernels as at


@kernel
def place(s, lanes, planet):
    """Rotations, and where the nose is above the Earth."""
    w = len(lanes)
    for i in range(w):
        t = (at.TRIAL + 6) * w + i
        b0, b1, b2, b3 = s[t], s[t + w], s[t + 2 * w], s[t + 3 * w]
        a0, a1, a2, a3 = s[t + 4 * w], s[t + 5 * w], s[t + 6 * w], s[t + 7 * w]
        q0, q1 = a0 * b0 + a1 * b1 + a2 * b2 + a3 * b3, a0 * b1 - a1 * b0 - a2 * b3 + a3 * b2
        q2, q3 = a0 * b2 + a1 * b3 - a2 * b0 - a3 * b1, a0 * b3 - a1 * b2 + a2 * b1 - a3 * b0
        r, c = la.rotation(a0, a1, a2, a3), la.rotation(q0, q1, q2, q3)
        at.put(s, at.R_A, w, i, r[0], r[1], r[2])
        at.put(s, at.R_A + 3, w, i, r[3], r[4], r[5])
        at.put(s, at.R_A + 6, w, i, r[6], r[7], r[8])
        at.put(s, at.C_AB, w, i, c[0], c[1], c[2])
        at.put(s, at.C_AB + 3, w, i, c[3], c[4], c[5])
        at.put(s, at.C_AB + 6, w, i, c[6], c[7], c[8])
        s[at.TWIST * w + i], s[(at.TWIST + 1) * w + i] = q0, q1
        share = s[(at.P + at.SHARE_A) * w + i]
        bx, by, bz = at.three(s, at.P + at.P_B, w, i)
        bx, by, bz = la.times(c, bx, by, bz)
        ax, ay, az = at.three(s, at.P + at.P_A, w, i)
        nx, ny, nz = at.three(s, at.P + at.NOSE_A, w, i)
        x, y, z = la.times(r, nx + share * (ax - bx), ny + share * (ay - by), nz + share * (az - bz))
        x, y, z = x + s[at.TRIAL * w + i], y + s[(at.TRIAL + 1) * w + i], z + s[(at.TRIAL + 2) * w + i]
        sin_lat, cos_lat, altitude, per_radius = la.geodetic(x, y, z, planet)
        s[at.SIN * w + i], s[at.COS * w + i], s[at.ALTITUDE * w + i] = sin_lat, cos_lat, altitude
        s[at.SIN_LON * w + i], s[at.COS_LON * w + i] = y * per_radius, x * per_radius
        # the air's own velocity where it turns with the Earth
        at.put(s, at.FLOW, w, i, -planet[4] * y, planet[4] * x, 0.0)


@inlined
def _four(row):
    return row[0], row[1], row[2], row[3]


@inlined
def _between(a, b, f):
    return a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2]), a[3] + f * (b[3] - a[3])


@kernel
def air(s, lanes, atmosphere, grid):
    """Air of the row of the table below the nose, and what changes up to the next; end values outside."""
    w, last = len(lanes), atmosphere.shape[1] - 2
    for i in range(w):
        a = atmosphere[min(i, atmosphere.shape[0] - 1)]
        u = (s[at.ALTITUDE * w + i] - grid[0]) * grid[1]
        u = u if u > 0.0 else 0.0  # and where it is not a number
        k = int(u) if u < last else last
        f = min(u - k, 1.0)
        # e^x of a small x: a 50 m step of the table changes density by about 1 %
        x = f * a[k, 1]
        s[at.RHO * w + i] = a[k, 0] * (1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0))))
        c = _between(_four(a[k, 2:]), _four(a[k + 1, 2:]), f)
        s[at.SOUND * w + i], s[at.NORTH * w + i], s[at.EAST * w + i], s[at.FREE * w + i] = c


@kernel
def flow(s, lanes):
    """Flow at the nose in shell axes, Mach number, dynamic pressure, total angle of attack."""
    w = len(lanes)
    for i in range(w):
        r, c = at.nine(s, at.R_A, w, i), at.nine(s, at.C_AB, w, i)
        sin_lat, cos_lat, sl, cl = s[at.SIN * w + i], s[at.COS * w + i], s[at.SIN_LON * w + i], s[at.COS_LON * w + i]
        north, east = s[at.NORTH * w + i], s[at.EAST * w + i]
        vx, vy, vz = at.three(s, at.TRIAL + 3, w, i)
        ex, ey, ez = at.three(s, at.FLOW, w, i)
        vx += north * sin_lat * cl + east * sl - ex
        vy += north * sin_lat * sl - east * cl - ey
        u, v, z = la.back(r, vx, vy, vz - north * cos_lat - ez)
        share = s[(at.P + at.SHARE_A) * w + i]
        wb0, wb1, wb2 = at.three(s, at.TRIAL + 14, w, i)
        wb0, wb1, wb2 = la.times(c, wb0, wb1, wb2)
        wa0, wa1, wa2 = at.three(s, at.TRIAL + 17, w, i)
        bx, by, bz = at.three(s, at.P + at.P_B, w, i)
        bx, by, bz = la.times(c, bx, by, bz)
        ax, ay, az = at.three(s, at.P + at.P_A, w, i)
        nx, ny, nz = at.three(s, at.P + at.NOSE_A, w, i)
        sx, sy, sz = la.cross(wb0, wb1, wb2, bx, by, bz)
        tx, ty, tz = la.cross(wa0, wa1, wa2, nx + share * ax, ny + share * ay, nz + share * az)
        u, v, z = u + tx - share * sx, v + ty - share * sy, z + tz - share * sz
        lateral = math.sqrt(v * v + z * z)
        speed = math.sqrt(u * u + v * v + z * z)
        at.put(s, at.FLOW, w, i, u, v, z)
        s[at.SPEED * w + i], s[at.LATERAL * w + i], s[at.ALPHA * w + i] = speed, lateral, la.atan2(lateral, u)
        s[at.MACH * w + i], s[at.DENSITY * w + i] = speed / s[at.SOUND * w + i], s[at.RHO * w + i]
        s[at.PRESSURE * w + i] = 0.5 * s[at.RHO * w + i] * speed * speed


@kernel
def look_up(s, lanes, grid, mach_knots, table, free):
    """C_A, C_N, C_m, C_mq, bilinear, held at the first and last Mach number, bridged to free-molecular ones."""
    w = len(lanes)
    for i in range(w):
        mach = s[at.MACH * w + i]
        m = int(s[at.BRACKET * w + i])  # the last one found: seldom left
        while m < mach_knots.shape[0] - 2 and mach > mach_knots[m + 1]:
            m += 1
        while m > 0 and mach < mach_knots[m]:
            m -= 1
        s[at.BRACKET * w + i] = m
        f = min(max((mach - mach_knots[m]) / (mach_knots[m + 1] - mach_knots[m]), 0.0), 1.0)
        u = s[at.ALPHA * w + i] * grid[2]
        u = u if u > 0.0 else 0.0
        j = min(int(u), table.shape[1] - 2)
        h = u - j
        thin = s[at.FREE * w + i]
        low = _between(_four(table[m, j]), _four(table[m, j + 1]), h)
        c = _between(low, _between(_four(table[m + 1, j]), _four(table[m + 1, j + 1]), h), f)
        if thin > 0.0:
            c = _between(c, _between(_four(free[j]), _four(free[j + 1]), h), thin)
        n = at.COEF * w + i
        s[n], s[n + w], s[n + 2 * w], s[n + 3 * w] = c


@inlined
def wrench(s, w, i, wa1, wa2):
    """Force at the nose and moment about it on the shell, shell axes."""
    _, v, z = at.three(s, at.FLOW, w, i)
    speed, area, length = s[at.SPEED * w + i], s[(at.P + at.REFERENCE) * w + i], s[(at.P + at.REFERENCE + 1) * w + i]
    f = (at.P + at.FACTOR) * w + i
    n = at.COEF * w + i
    ca, cn, cm, cmq = s[n] * s[f], s[n + w] * s[f + w], s[n + 2 * w] * s[f + 2 * w], s[n + 3 * w] + s[f + 3 * w]
    per_lateral = 1.0 / (s[at.LATERAL * w + i] + 1e-12)
    ny, nz = v * per_lateral, z * per_lateral
    qs = s[at.PRESSURE * w + i] * area
    damping = 0.25 * s[at.RHO * w + i] * speed * area * length * length * cmq  # q S l^2 / (2 V)
    # nose-up about n x x_hat = (0, n_z, -n_y)
    turn = qs * length * cm
    return -qs * ca, -qs * cn * ny, -qs * cn * nz, turn * nz + damping * wa1, damping * wa2 - turn * ny

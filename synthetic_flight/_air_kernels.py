"""Compiled air: where the nose is, what blows there, and the aerodynamic wrench; vector loops over lanes.

Readable twin: `synthetic_flight.dynamics.aerodynamics`. The workspace: `synthetic_flight._workspace_kernels`.
"""

from __future__ import annotations

import math

from flightmodel import _kernels as la
from flightmodel._kernels import inlined, kernel
from synthetic_flight import _workspace_kernels as at


@inlined
def place(s, lanes, planet):
    """Where the nose is above the Earth, and how fast the air there turns with it."""
    w = len(lanes)
    for i in range(w):
        r, share = at.nine(s, at.R_A, w, i), s[(at.P + at.SHARE_A) * w + i]
        dx, dy, dz = at.three(s, at.BETWEEN, w, i)
        nx, ny, nz = at.three(s, at.P + at.NOSE_A, w, i)
        dx, dy, dz = la.times(r, nx + share * dx, ny + share * dy, nz + share * dz)
        x, y, z = at.three(s, at.TRIAL, w, i)
        x, y, z = x + dx, y + dy, z + dz
        sin_lat, cos_lat, altitude, per_radius = la.geodetic(x, y, z, planet)
        s[at.SIN * w + i], s[at.COS * w + i], s[at.ALTITUDE * w + i] = sin_lat, cos_lat, altitude
        s[at.SIN_LON * w + i], s[at.COS_LON * w + i] = y * per_radius, x * per_radius
        at.put(s, at.FLOW, w, i, -planet[4] * y, planet[4] * x, 0.0)


@inlined
def _four(row):
    return row[0], row[1], row[2], row[3]


@inlined
def _between(a, b, f):
    return a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2]), a[3] + f * (b[3] - a[3])


@inlined
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
        s[at.DENSITY * w + i] = a[k, 0] * (1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0))))
        c = _between(_four(a[k, 2:]), _four(a[k + 1, 2:]), f)
        s[at.SOUND * w + i], s[at.NORTH * w + i], s[at.EAST * w + i], s[at.FREE * w + i] = c


@inlined
def flow(s, lanes):
    """Flow at the nose in shell axes, Mach number, dynamic pressure, total angle of attack."""
    w = len(lanes)
    for i in range(w):
        r, share = at.nine(s, at.R_A, w, i), s[(at.P + at.SHARE_A) * w + i]
        sin_lat, cos_lat, sl, cl = s[at.SIN * w + i], s[at.COS * w + i], s[at.SIN_LON * w + i], s[at.COS_LON * w + i]
        north, east = s[at.NORTH * w + i], s[at.EAST * w + i]
        vx, vy, vz = at.three(s, at.TRIAL + 3, w, i)
        ex, ey, ez = at.three(s, at.FLOW, w, i)
        vx += north * sin_lat * cl + east * sl - ex
        vy += north * sin_lat * sl - east * cl - ey
        u, v, z = la.back(r, vx, vy, vz - north * cos_lat - ez)
        wb0, wb1, wb2 = at.three(s, at.RATE_B, w, i)
        wa0, wa1, wa2 = at.three(s, at.TRIAL + 17, w, i)
        bx, by, bz = at.three(s, at.ARM_B, w, i)
        ax, ay, az = at.three(s, at.P + at.P_A, w, i)
        nx, ny, nz = at.three(s, at.P + at.NOSE_A, w, i)
        sx, sy, sz = la.cross(wb0, wb1, wb2, bx, by, bz)
        tx, ty, tz = la.cross(wa0, wa1, wa2, nx + share * ax, ny + share * ay, nz + share * az)
        u, v, z = u + tx - share * sx, v + ty - share * sy, z + tz - share * sz
        lateral = math.sqrt(v * v + z * z)
        speed = math.sqrt(u * u + v * v + z * z)
        at.put(s, at.FLOW, w, i, u, v, z)
        s[at.SPEED * w + i], s[at.LATERAL * w + i], s[at.ALPHA * w + i] = speed, lateral, la.atan2(lateral, u)
        s[at.MACH * w + i] = speed / s[at.SOUND * w + i]
        s[at.PRESSURE * w + i] = 0.5 * s[at.DENSITY * w + i] * speed * speed


@inlined
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
        c = (0.0, 0.0, 0.0, 0.0)
        if thin < 1.0:
            low = _between(_four(table[m, j]), _four(table[m, j + 1]), h)
            c = _between(low, _between(_four(table[m + 1, j]), _four(table[m + 1, j + 1]), h), f)
        if thin > 0.0:
            c = _between(c, _between(_four(free[j]), _four(free[j + 1]), h), thin)
        n = at.COEF * w + i
        s[n], s[n + w], s[n + 2 * w], s[n + 3 * w] = c


@inlined
def wrench(s, w, i):
    """Force at the nose on the shell, and y and z of the moment about it; shell axes."""
    _, v, z = at.three(s, at.FLOW, w, i)
    speed, area, length = s[at.SPEED * w + i], s[(at.P + at.REFERENCE) * w + i], s[(at.P + at.REFERENCE + 1) * w + i]
    f = (at.P + at.FACTOR) * w + i
    n = at.COEF * w + i
    ca, cn, cm, cmq = s[n] * s[f], s[n + w] * s[f + w], s[n + 2 * w] * s[f + 2 * w], s[n + 3 * w] + s[f + 3 * w]
    per_lateral = 1.0 / (s[at.LATERAL * w + i] + 1e-12)
    ny, nz = v * per_lateral, z * per_lateral
    qs = s[at.PRESSURE * w + i] * area
    damping = 0.25 * s[at.DENSITY * w + i] * speed * area * length * length * cmq  # q S l^2 / (2 V)
    # nose-up about n x x_hat = (0, n_z, -n_y)
    turn = qs * length * cm
    wa1, wa2 = s[(at.TRIAL + 18) * w + i], s[(at.TRIAL + 19) * w + i]
    return -qs * ca, -qs * cn * ny, -qs * cn * nz, turn * nz + damping * wa1, damping * wa2 - turn * ny


@kernel
def gauss_markov(keep, white, out):
    """Noise of unit variance into ``out`` (n, m): ``keep`` (n - 1,) of the last row is left in the next."""
    for i in range(out.shape[1]):
        out[0, i] = white[0, i]
        for k in range(1, out.shape[0]):
            out[k, i] = keep[k - 1] * out[k - 1, i] + math.sqrt(1.0 - keep[k - 1] * keep[k - 1]) * white[k, i]

"""Compiled ray casting of the film; the model is in `synthetic_flight.film`. Readable twin:
``tests/oracles/plain_film.py``.

Points and directions are in shell axes. ``shell``: station and radius of the innermost centre, cosine and sine of the
half angle, pitch and minor radius of the tori, number of the last, how far a ray goes, angle of a gore. ``warp``:
flattening, lobes, and whether there are any (`synthetic_flight.film.Warp`). ``body``: the centerbody's nose, aft unit
vector, radius and length.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel

STEPS = 80
NEAR_M = 0.05  # from where on the distance changes as a straight line along a ray
STEEPEST = 2.5  # of a step to the distance; it is signed, and an overshoot returns
REACHED_M, HIT_M = 2e-4, 4e-3
SUN_DIAMETER = 0.0093  # rad
LANES = 1024  # rays side by side: their arrays stay in the nearest cache
OFF_SKIN_M = 2e-3  # from where a surface point looks at the Sun


@inlined
def _half_plane(x, y, z, shell, warp):
    """Along the generator from the nearest torus's centre, aft of the generator, and the radius, m."""
    r = math.sqrt(y * y + z * z)
    aft, out = -x - shell[0], r - shell[1]
    if warp[5] != 0.0:
        per = 1.0 / max(r, 1e-3)
        c, s = -y * per, z * per
        turn = warp[0] + warp[1] * (c * c - s * s) + 2.0 * warp[2] * c * s
        turn += warp[3] * c * (4.0 * c * c - 3.0) + warp[4] * s * (3.0 - 4.0 * s * s)
        aft, out = aft - turn * out, out + turn * aft
    a = shell[2] * aft + shell[3] * out
    b = shell[3] * aft - shell[2] * out
    i = min(max(np.floor(a / shell[4] + 0.5), 0.0), shell[6])  # numpy's: Python's is an integer, one ray at a time
    return a - i * shell[4], b, r


@inlined
def _gap(eye, dx, dy, dz, t, shell, warp):
    """Distance from the nearest torus, m, at depth ``t`` along a ray; negative inside."""
    a, b, _ = _half_plane(eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz, shell, warp)
    return math.sqrt(a * a + b * b) - shell[5]


@inlined
def _thickness(shell, warp):
    """How far the stack reaches aft of its generator, m, out of shape as it may be."""
    bent = abs(warp[0]) + abs(warp[1]) + abs(warp[2]) + abs(warp[3]) + abs(warp[4])
    return shell[5] + 0.02 + bent * (shell[6] * shell[4] + 2.0 * shell[5])


@inlined
def _way_to_stack(x, y, z, dx, dy, dz, shell, warp):
    """Way along a direction, m, in which nothing is met, of a point aft of the stack, inside the cone that encloses it.

    It ends where that cone is met, and is infinite where it is not; zero for a point elsewhere.
    """
    r = math.sqrt(y * y + z * z)
    above = shell[3] * (-x - shell[0]) - shell[2] * (r - shell[1]) - _thickness(shell, warp)
    if above <= 0.0:
        return 0.0
    # on the cone r = p + q t
    p, q = r + above / shell[2], -shell[3] * dx / shell[2]
    square, half = dy * dy + dz * dz - q * q, y * dy + z * dz - p * q
    # r^2 - p^2, which is negative: where the square's factor is positive, one root lies ahead
    rest = -(above / shell[2]) * (r + p)
    root = math.sqrt(max(half * half - square * rest, 0.0))
    way = (root - half) / square if half <= 0.0 else -rest / (half + root)
    return way if half * half >= square * rest and way > 0.0 and p + q * way >= 0.0 else math.inf


@inlined
def _march(eye, d, pixel, lanes, depth, shell, warp):
    """Depth, m, at which rays, columns of ``d`` (3, n), meet a torus; infinite where they do not.

    Written to places ``pixel`` (n,) of ``depth``. Rays that are under way lie side by side in arrays, which a processor
    steps several at a time; all of ``d``, ``pixel`` and ``lanes`` (3, n) is used up.
    """
    x, y, z = d
    t, gap, stretch = lanes
    count = len(pixel)
    for k in range(count):
        way = _way_to_stack(eye[0], eye[1], eye[2], x[k], y[k], z[k], shell, warp)
        t[k], stretch[k] = min(max(way, 0.05), 2.0 * shell[7]), 1.0
        gap[k] = _gap(eye, x[k], y[k], z[k], t[k], shell, warp)
    for step in range(STEPS + 1):
        going = 0
        for k in range(count):
            if abs(gap[k]) < REACHED_M or t[k] > shell[7] or step == STEPS:
                depth[pixel[k]] = t[k] if gap[k] < HIT_M and t[k] <= shell[7] else math.inf
            else:
                x[going], y[going], z[going], pixel[going] = x[k], y[k], z[k], pixel[k]
                t[going], gap[going], stretch[going] = t[k], gap[k], stretch[k]
                going += 1
        count = going
        for k in range(count):
            way, before = stretch[k] * gap[k], gap[k]
            t[k] += way
            gap[k] = _gap(eye, x[k], y[k], z[k], t[k], shell, warp)
            # the secant's step, where it is one
            closer = before - gap[k]
            secant = min(max(way / closer, 1.0), STEEPEST)
            stretch[k] = secant if abs(gap[k]) < NEAR_M and closer * way > 0.0 else 1.0
        if count == 0:
            break


@inlined
def _beside_body(x, y, z, sun, body):
    """Share of the Sun's disc that the centerbody leaves free."""
    nose, aft, radius, length = body
    px, py, pz = x - nose[0], y - nose[1], z - nose[2]
    at, climb = px * aft[0] + py * aft[1] + pz * aft[2], sun[0] * aft[0] + sun[1] * aft[1] + sun[2] * aft[2]
    # normal to the axis
    qx, qy, qz = px - at * aft[0], py - at * aft[1], pz - at * aft[2]
    ex, ey, ez = sun[0] - climb * aft[0], sun[1] - climb * aft[1], sun[2] - climb * aft[2]
    across = ex * ex + ey * ey + ez * ez
    if across < 1e-9:
        return 1.0
    k = -(qx * ex + qy * ey + qz * ez) / across
    if k <= 0.0:
        return 1.0
    nearest = math.sqrt((qx + k * ex) ** 2 + (qy + k * ey) ** 2 + (qz + k * ez) ** 2)
    half = math.sqrt(max(radius * radius - nearest * nearest, 0.0) / across)
    first, last = at + (k - half) * climb, at + (k + half) * climb
    blur = SUN_DIAMETER * k
    # beside it, beyond its aft end, before its nose
    clear = max(nearest - radius, max(min(first, last) - length, -max(first, last)))
    return min(max(0.5 + clear / blur, 0.0), 1.0)


@inlined
def _beside_shell(points, pixel, lanes, sun, shell, warp, free):
    """Multiply ``free`` at places ``pixel`` (n,) by the share of the Sun's disc that the tori leave free.

    Seen from points (3, n) off their skin; the points, ``pixel`` and ``lanes`` are used up as by `_march`.
    """
    x, y, z = points
    t, share, _ = lanes
    count = len(pixel)
    t[:count], share[:count] = OFF_SKIN_M, 1.0
    for step in range(STEPS + 1):
        going = 0
        for k in range(count):
            if share[k] == 0.0 or t[k] > shell[7] or step == STEPS:
                free[pixel[k]] *= share[k]
            else:
                x[going], y[going], z[going], pixel[going] = x[k], y[k], z[k], pixel[k]
                t[going], share[going] = t[k], share[k]
                going += 1
        count = going
        for k in range(count):
            px, py, pz = x[k] + t[k] * sun[0], y[k] + t[k] * sun[1], z[k] + t[k] * sun[2]
            a, b, _r = _half_plane(px, py, pz, shell, warp)
            gap = math.sqrt(a * a + b * b) - shell[5]
            share[k] = 0.0 if gap < REACHED_M else min(share[k], gap / (SUN_DIAMETER * t[k]))
            t[k] += max(gap, OFF_SKIN_M, _way_to_stack(px, py, pz, sun[0], sun[1], sun[2], shell, warp))
        if count == 0:
            break


@inlined
def _albedo(y, z, r, a, crest, shell):
    """Seams of 12 mm, dots of 22 mm at mid-gore crests, gores of slightly unlike cloth."""
    clock = math.atan2(z, -y)
    gore = (clock if clock >= 0.0 else clock + 2.0 * math.pi) / shell[8]
    whole = math.floor(gore)
    off_seam = abs(gore - math.floor(gore + 0.5)) * shell[8] * r
    across = (gore - whole - 0.5) * shell[8] * r
    off_dot = math.sqrt(across * across + a * a)
    out = (1.0 - 0.55 * min(max(1.5 - off_seam / 0.006, 0.0), 1.0)) * (1.0 + 0.05 * math.sin(2.4 * whole))
    if crest > 0.5:
        out *= 1.0 - 0.7 * min(max(3.0 - off_dot / 0.0055, 0.0), 1.0)
    return out


@inlined
def _normal(y, z, a, b, r, shell):
    """Outward normal of the skin at a point with its place in the half-plane."""
    n_s = (a * shell[2] + b * shell[3]) / shell[5]
    n_r = (a * shell[3] - b * shell[2]) / shell[5]
    return -n_s, n_r * y / r, n_r * z / r


@inlined
def _shade(eye, d, t, free, sun, shell, warp, painted):
    """Radiance of the skin at depth ``t`` along a ray, of which a share of the Sun's disc is seen."""
    y, z = eye[1] + t * d[1], eye[2] + t * d[2]
    a, b, r = _half_plane(eye[0] + t * d[0], y, z, shell, warp)
    crest = min(max(b / shell[5], 0.0), 1.0)
    nx, ny, nz = _normal(y, z, a, b, r, shell)
    lit = free * max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0)
    value = (0.10 + 0.10 * crest + 0.62 * lit) * (0.55 + 0.45 * math.sqrt(crest))
    return value * _albedo(y, z, r, a, crest, shell) if painted else value


@inlined
def _into_shell(turn, ray, out):
    for k in range(3):
        out[k] = turn[k, 0] * ray[0] + turn[k, 1] * ray[1] + turn[k, 2] * ray[2]


@kernel
def cast(rays, clear, turn, eye, shell, warp, depth):
    """Depth (h, w), m, at which rays (h, w, 3), body axes, meet a torus; infinite where there is none."""
    h, w, _ = rays.shape
    row, pixel, lanes = np.empty((3, w)), np.empty(w, dtype=np.int64), np.empty((3, w))
    for i in range(h):
        count = 0
        for j in range(w):
            depth[i, j] = math.inf
            if clear[i, j]:
                _into_shell(turn, rays[i, j], row[:, count])
                pixel[count] = j
                count += 1
        _march(eye, row, pixel[:count], lanes, depth[i], shell, warp)


@kernel
def closest(rays, near, turn, eye, shell, warp, gap, depth):
    """Where rays (n, 3) come closest to the shell, beginning from depths near it: distance and depth, m."""
    d = np.empty(3)
    step = 0.03
    for i in range(len(rays)):
        _into_shell(turn, rays[i], d)
        t = near[i] if near[i] < shell[7] else 1.0
        for _ in range(4):
            before = _gap(eye, d[0], d[1], d[2], t - step, shell, warp)
            here = _gap(eye, d[0], d[1], d[2], t, shell, warp)
            after = _gap(eye, d[0], d[1], d[2], t + step, shell, warp)
            # of the parabola through three distances
            curve = max(before - 2.0 * here + after, 1e-5)
            t += min(max(0.5 * step * (before - after) / curve, -0.1), 0.1)
        gap[i], depth[i] = _gap(eye, d[0], d[1], d[2], t, shell, warp), t


@kernel
def see_sun(rays, depth, turn, eye, sun, shell, warp, body, free):
    """Share (n,) of the Sun's disc that is seen from where rays (n, 3) meet the skin; found where it is NaN."""
    points, pixel, lanes = np.empty((3, LANES)), np.empty(LANES, dtype=np.int64), np.empty((3, LANES))
    d = np.empty(3)
    for begin in range(0, len(rays), LANES):
        count = 0
        for k in range(begin, min(begin + LANES, len(rays))):
            if not (math.isnan(free[k]) and depth[k] < math.inf):
                continue
            _into_shell(turn, rays[k], d)
            x, y, z = eye[0] + depth[k] * d[0], eye[1] + depth[k] * d[1], eye[2] + depth[k] * d[2]
            a, b, r = _half_plane(x, y, z, shell, warp)
            nx, ny, nz = _normal(y, z, a, b, r, shell)
            free[k] = 0.0
            if nx * sun[0] + ny * sun[1] + nz * sun[2] > 0.0:
                x, y, z = x + OFF_SKIN_M * nx, y + OFF_SKIN_M * ny, z + OFF_SKIN_M * nz
                free[k] = _beside_body(x, y, z, sun, body)
                if free[k] > 0.0:
                    points[0, count], points[1, count], points[2, count], pixel[count] = x, y, z, k
                    count += 1
        _beside_shell(points, pixel[:count], lanes, sun, shell, warp, free)


@kernel
def shade_shell(rays, depth, free, turn, eye, sun, shell, warp, painted, shade):
    """Radiance (n,) of the skin that rays (n, 3) meet, of shares ``free`` (n,) of the Sun's disc; zero where none."""
    d = np.empty(3)
    for k in range(len(rays)):
        shade[k] = 0.0
        if depth[k] < math.inf:
            _into_shell(turn, rays[k], d)
            shade[k] = _shade(eye, d, depth[k], free[k], sun, shell, warp, painted)


@kernel
def shade_mesh(points, normals, sun, shell, body, painted, shadows, shade):
    """Radiance (n,) at points (n, 3) of a mesh, on the unbent shell; the centerbody alone shades it."""
    for i in range(len(points)):
        x, y, z = points[i]
        nx, ny, nz = normals[i]
        a, b, r = _half_plane(x, y, z, shell, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        lit = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0)
        if shadows and lit > 0.0:
            lit *= _beside_body(x + OFF_SKIN_M * nx, y + OFF_SKIN_M * ny, z + OFF_SKIN_M * nz, sun, body)
        crest = min(max(b / shell[5], 0.0), 1.0)
        value = 0.15 + 0.62 * lit
        shade[i] = value * _albedo(y, z, r, a, crest, shell) if painted else value


@kernel
def sunlit(points, sun, shell, warp, share):
    """Share (n,) of the Sun's disc that the tori leave free at points (n, 3) off them."""
    n = len(points)
    share[:] = 1.0
    _beside_shell(points.T.copy(), np.arange(n), np.empty((3, n)), sun, shell, warp, share)

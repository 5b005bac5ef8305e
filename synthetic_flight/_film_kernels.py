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
    i = min(max(math.floor(a / shell[4] + 0.5), 0.0), shell[6])
    return a - i * shell[4], b, r


@inlined
def _gap(eye, d, t, shell, warp):
    """Distance from the nearest torus, m, at depth ``t`` along a ray; negative inside."""
    a, b, _ = _half_plane(eye[0] + t * d[0], eye[1] + t * d[1], eye[2] + t * d[2], shell, warp)
    return math.sqrt(a * a + b * b) - shell[5]


@inlined
def _thickness(shell, warp):
    """How far the stack reaches aft of its generator, m, out of shape as it may be."""
    bent = abs(warp[0]) + abs(warp[1]) + abs(warp[2]) + abs(warp[3]) + abs(warp[4])
    return shell[5] + 0.02 + bent * (shell[6] * shell[4] + 2.0 * shell[5])


@inlined
def _way_to_stack(x, y, z, d, shell, warp):
    """Way along a direction, m, in which nothing is met, of a point aft of the stack, inside the cone that encloses it.

    It ends where that cone is met, and is infinite where it is not; zero for a point elsewhere.
    """
    r = math.sqrt(y * y + z * z)
    above = shell[3] * (-x - shell[0]) - shell[2] * (r - shell[1]) - _thickness(shell, warp)
    if above <= 0.0:
        return 0.0
    # on the cone r = p + q t
    p, q = r + above / shell[2], -shell[3] * d[0] / shell[2]
    square, half = d[1] * d[1] + d[2] * d[2] - q * q, y * d[1] + z * d[2] - p * q
    # r^2 - p^2, which is negative: where the square's factor is positive, one root lies ahead
    rest = -(above / shell[2]) * (r + p)
    root = half * half - square * rest
    if root < 0.0:
        return math.inf
    root = math.sqrt(root)
    way = (root - half) / square if half <= 0.0 else -rest / (half + root)
    return way if way > 0.0 and p + q * way >= 0.0 else math.inf


@inlined
def _march(eye, d, shell, warp):
    """Depth at which a ray meets a torus, m; infinite where it does not."""
    t = max(_way_to_stack(eye[0], eye[1], eye[2], d, shell, warp), 0.05)
    if t > shell[7]:
        return math.inf
    gap, stretch = _gap(eye, d, t, shell, warp), 1.0
    for _ in range(STEPS):
        if abs(gap) < REACHED_M or t > shell[7]:
            break
        step, before = stretch * gap, gap
        t += step
        gap = _gap(eye, d, t, shell, warp)
        # the secant's step, where it is one
        closer = before - gap
        stretch = min(max(step / closer, 1.0), STEEPEST) if abs(gap) < NEAR_M and closer * step > 0.0 else 1.0
    return t if gap < HIT_M and t <= shell[7] else math.inf


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
def _beside_shell(x, y, z, sun, shell, warp):
    """Share of the Sun's disc that the tori leave free, from a point off their skin."""
    t, share = OFF_SKIN_M, 1.0
    for _ in range(STEPS):
        px, py, pz = x + t * sun[0], y + t * sun[1], z + t * sun[2]
        a, b, _r = _half_plane(px, py, pz, shell, warp)
        gap = math.sqrt(a * a + b * b) - shell[5]
        if gap < REACHED_M:
            return 0.0
        share = min(share, gap / (SUN_DIAMETER * t))
        t += max(gap, OFF_SKIN_M, _way_to_stack(px, py, pz, sun, shell, warp))
        if t > shell[7]:
            break
    return share


@inlined
def _albedo(y, z, r, a, crest, shell):
    """Seams of 12 mm, dots of 22 mm at mid-gore crests, gores of slightly unlike cloth."""
    clock = math.atan2(z, -y)
    gore = (clock if clock >= 0.0 else clock + 2.0 * math.pi) / shell[8]
    whole = math.floor(gore)
    off_seam = abs(gore - math.floor(gore + 0.5)) * shell[8] * r
    off_dot = math.hypot(abs(gore - whole - 0.5) * shell[8] * r, a)
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
def _free(eye, d, t, sun, shell, warp, body):
    """Share of the Sun's disc that is seen from where a ray meets the skin."""
    x, y, z = eye[0] + t * d[0], eye[1] + t * d[1], eye[2] + t * d[2]
    a, b, r = _half_plane(x, y, z, shell, warp)
    nx, ny, nz = _normal(y, z, a, b, r, shell)
    if nx * sun[0] + ny * sun[1] + nz * sun[2] <= 0.0:
        return 0.0
    x, y, z = x + OFF_SKIN_M * nx, y + OFF_SKIN_M * ny, z + OFF_SKIN_M * nz
    free = _beside_body(x, y, z, sun, body)
    return free * _beside_shell(x, y, z, sun, shell, warp) if free > 0.0 else 0.0


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


@inlined
def _agreed(free, i, j):
    """What the four pixels around, of every other row and column, all see of the Sun's disc; NaN where they differ."""
    top, left = i - i % 2, j - j % 2
    first = free[top, left]
    if first != 0.0 and first != 1.0:
        return math.nan
    bottom, right = min(top + 2, len(free) - 2 + len(free) % 2), min(left + 2, free.shape[1] - 2 + free.shape[1] % 2)
    same = free[top, right] == first and free[bottom, left] == first and free[bottom, right] == first
    return first if same else math.nan


@kernel
def cast(rays, clear, turn, eye, sun, shell, warp, body, painted, shadows, depth, shade):
    """Depth, m, infinite where there is none, and shade (h, w) of what rays (h, w, 3), body axes, meet.

    Shadows narrower than two pixels may be missed.
    """
    h, w, _ = rays.shape
    d = np.empty(3)
    free = np.full((h, w), math.nan)
    for i in range(h):
        for j in range(w):
            depth[i, j] = math.inf
            if clear[i, j]:
                _into_shell(turn, rays[i, j], d)
                depth[i, j] = _march(eye, d, shell, warp)
                if shadows and i % 2 == 0 and j % 2 == 0 and depth[i, j] < math.inf:
                    free[i, j] = _free(eye, d, depth[i, j], sun, shell, warp, body)
    for i in range(h):
        for j in range(w):
            shade[i, j] = 0.0
            if depth[i, j] < math.inf:
                _into_shell(turn, rays[i, j], d)
                seen = 1.0
                if shadows:
                    seen = free[i, j] if i % 2 == 0 and j % 2 == 0 else _agreed(free, i, j)
                    if math.isnan(seen):
                        seen = _free(eye, d, depth[i, j], sun, shell, warp, body)
                shade[i, j] = _shade(eye, d, depth[i, j], seen, sun, shell, warp, painted)


@kernel
def cast_edge(rays, near, turn, eye, sun, shell, warp, body, painted, shadows, gap, depth, shade):
    """Where rays (n, 3) come closest to the shell, beginning from depths near it: distance, depth, shade there."""
    d = np.empty(3)
    step = 0.03
    for i in range(len(rays)):
        _into_shell(turn, rays[i], d)
        t = near[i] if near[i] < shell[7] else 1.0
        for _ in range(4):
            before = _gap(eye, d, t - step, shell, warp)
            here = _gap(eye, d, t, shell, warp)
            after = _gap(eye, d, t + step, shell, warp)
            # of the parabola through three distances
            curve = max(before - 2.0 * here + after, 1e-5)
            t += min(max(0.5 * step * (before - after) / curve, -0.1), 0.1)
        gap[i], depth[i] = _gap(eye, d, t, shell, warp), t
        seen = _free(eye, d, t, sun, shell, warp, body) if shadows else 1.0
        shade[i] = _shade(eye, d, t, seen, sun, shell, warp, painted)


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
    for i in range(len(points)):
        share[i] = _beside_shell(points[i, 0], points[i, 1], points[i, 2], sun, shell, warp)

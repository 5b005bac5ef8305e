"""What does a camera see of triangles?

They are filled through the lens with a depth buffer. A straight edge in space is straight in the picture only over a
small triangle, so larger ones are split until they span less than `WIDEST_RAD` as seen from the camera; that also
follows those that reach beyond the lens's field or behind the camera.

Assumed: opaque triangles; the lens of `flightmodel.camera`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flightmodel._kernels import inlined, kernel
from flightmodel.camera import FISHEYE, Camera
from flightmodel.checks import BoolArray, FloatArray

WIDEST_RAD, _MARGIN_RAD = float(np.deg2rad(5.0)), float(np.deg2rad(0.5))
_DEEPEST_SPLIT = 20
_WIDE_PX = 8
_BORDER_COS = math.cos(math.radians(0.5))


@dataclass(frozen=True)
class Rendered:
    """A picture of distances.

    Parameters
    ----------
    depth_m : (h, w) float
        Distance from the camera along each pixel's ray; infinite where nothing is met.
    face : (h, w) int
        Index of the face seen; -1 where there is none.
    """

    depth_m: FloatArray
    face: NDArray[np.int64]

    @property
    def is_hit(self) -> BoolArray:
        """Mask ``(h, w)`` of pixels that show the scene."""
        return np.asarray(self.face >= 0)


def face_normals(vertices_m: FloatArray, faces: NDArray[np.int64]) -> FloatArray:
    """Unit normals ``(m, 3)`` of faces, as they are wound."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300))


def against(normals: FloatArray, rays: FloatArray) -> FloatArray:
    """Normals ``(n, 3)`` turned to where rays ``(n, 3)`` come from."""
    return np.asarray(normals * np.where(np.einsum("ni,ni->n", normals, rays) > 0.0, -1.0, 1.0)[:, None])


@inlined
def _pixel_of(x, y, z, lens):
    """Pixel of a point in camera axes; see `flightmodel.camera` for the lenses."""
    model, _, focal, centre, k, _, _ = lens
    if model == FISHEYE:
        r = math.sqrt(x * x + y * y)
        a = math.atan2(r, z)
        a2 = a * a
        scale = a * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3])))) / r if r > 1e-12 else 1.0 / z
        u, v = scale * x, scale * y
    else:
        p, q = x / z, y / z
        r2 = p * p + q * q
        radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        u = p * radial + 2.0 * k[2] * p * q + k[3] * (r2 + 2.0 * p * p)
        v = q * radial + k[2] * (r2 + 2.0 * q * q) + 2.0 * k[3] * p * q
    return focal[0] * u + centre[0], focal[1] * v + centre[1]


@inlined
def _clipped(value, per_step, first, last):
    """Part of ``first`` to ``last`` in which ``value + k / per_step`` is not negative; all of it for no step."""
    if per_step > 0.0:
        first = max(first, -value * per_step)
    elif per_step < 0.0:
        last = min(last, -value * per_step)
    return first, last


@inlined
def fill(ax, ay, bx, by, cx, cy, da, db, dc, face, depth, nearest):
    """Enter one triangle at the pixel centres it covers, where it is the closest so far."""
    h, w = depth.shape
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    left, right = min(ax, bx, cx), max(ax, bx, cx)
    top, bottom = min(ay, by, cy), max(ay, by, cy)
    if abs(area) > 1e-9 and right >= 0.0 and bottom >= 0.0 and left <= w - 1.0 and top <= h - 1.0:
        per = 1.0 / area
        # barycentric coordinates are linear: start of a row, and step along it
        step_b, step_c = (cy - ay) * per, (ay - by) * per
        j0, j1 = math.ceil(max(left, 0.0)), math.floor(min(right, w - 1.0))
        # of a wide triangle most of the box around it is empty: its part of each row is computed
        wide = j1 - j0 >= _WIDE_PX
        per_b = 1.0 / step_b if abs(step_b) > 1e-12 else 0.0
        per_c = 1.0 / step_c if abs(step_c) > 1e-12 else 0.0
        per_a = -1.0 / (step_b + step_c) if abs(step_b + step_c) > 1e-12 else 0.0
        for i in range(math.ceil(max(top, 0.0)), math.floor(min(bottom, h - 1.0)) + 1):
            share_b = ((j0 - ax) * (cy - ay) - (i - ay) * (cx - ax)) * per
            share_c = ((bx - ax) * (i - ay) - (by - ay) * (j0 - ax)) * per
            first, last = 0.0, j1 - j0 + 0.0
            if wide:
                first, last = _clipped(share_b, per_b, first, last)
                first, last = _clipped(share_c, per_c, first, last)
                first, last = _clipped(1.0 - share_b - share_c, per_a, first, last)
                first, last = math.floor(max(first, 0.0)), math.ceil(min(last, j1 - j0 + 0.0))
                share_b += first * step_b
                share_c += first * step_c
            for j in range(j0 + int(first), j0 + int(last) + 1):
                if share_b >= -1e-9 and share_c >= -1e-9 and share_b + share_c <= 1.0 + 1e-9:
                    here = da + share_b * (db - da) + share_c * (dc - da)
                    if here < depth[i, j]:
                        depth[i, j] = here
                        nearest[i, j] = face
                share_b += step_b
                share_c += step_c


@kernel
def raster(vertices, faces, lens, sight, widest, deepest, depth, nearest):
    """Write into ``depth (h, w)`` and ``nearest (h, w)`` the distance and index of the closest face at pixel centres.

    ``vertices (n, 3)`` in body axes; ``lens``: `flightmodel.camera.Camera.lens_terms`. A face that spans more
    than ``widest`` is halved across its widest side, again and again, ``deepest`` times at the most; what lies farther
    than ``sight`` from the optical axis is not in the picture.
    """
    widest_cos = math.cos(widest)
    # where the picture ends well within the lens's field, that field's border needs no care
    border_cos = _BORDER_COS if lens[1] - widest < sight else widest_cos
    position, axes = lens[5], lens[6]
    field_cos = math.cos(lens[1])
    n = len(vertices)
    corner, pixels = np.empty((n, 4)), np.empty((n, 2))
    for i in range(n):
        dx, dy, dz = vertices[i, 0] - position[0], vertices[i, 1] - position[1], vertices[i, 2] - position[2]
        for m in range(3):
            corner[i, m] = axes[m, 0] * dx + axes[m, 1] * dy + axes[m, 2] * dz
        corner[i, 3] = math.sqrt(dx * dx + dy * dy + dz * dz)
        if corner[i, 2] > field_cos * corner[i, 3]:
            pixels[i, 0], pixels[i, 1] = _pixel_of(corner[i, 0], corner[i, 1], corner[i, 2], lens)
    stack, level = np.empty((deepest + 2, 3, 3)), np.empty(deepest + 2, dtype=np.int64)
    length, t = np.empty(3), np.empty((3, 3))
    for f in range(len(faces)):
        a, b, c = faces[f]
        narrow, inside = True, 0
        for p, q in ((a, b), (b, c), (c, a)):
            dot = corner[p, 0] * corner[q, 0] + corner[p, 1] * corner[q, 1] + corner[p, 2] * corner[q, 2]
            narrow = narrow and dot > widest_cos * corner[p, 3] * corner[q, 3]
            inside += 1 if corner[p, 2] > field_cos * corner[p, 3] else 0
        if narrow and (inside == 0 or inside == 3):
            if inside == 3:
                fill(
                    pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1],
                    corner[a, 3], corner[b, 3], corner[c, 3], f, depth, nearest,
                )  # fmt: skip
            continue
        for m in range(3):
            stack[0, 0, m], stack[0, 1, m], stack[0, 2, m] = corner[a, m], corner[b, m], corner[c, m]
        level[0] = 0
        top = 1
        while top > 0:
            top -= 1
            here = level[top]
            for m in range(3):
                t[m, 0], t[m, 1], t[m, 2] = stack[top, m, 0], stack[top, m, 1], stack[top, m, 2]
            # direction of the middle, and how far the corners lie from it: nothing of it may be in the field
            mx, my, mz = t[0, 0] + t[1, 0] + t[2, 0], t[0, 1] + t[1, 1] + t[2, 1], t[0, 2] + t[1, 2] + t[2, 2]
            mid = math.sqrt(mx * mx + my * my + mz * mz) + 1e-300
            spread, inside = 1.0, 0
            for m in range(3):
                length[m] = math.sqrt(t[m, 0] ** 2 + t[m, 1] ** 2 + t[m, 2] ** 2) + 1e-300
                spread = min(spread, (mx * t[m, 0] + my * t[m, 1] + mz * t[m, 2]) / (mid * length[m]))
                inside += 1 if t[m, 2] > field_cos * length[m] else 0
            if spread > 0.5 and math.acos(max(min(mz / mid, 1.0), -1.0)) - math.acos(spread) > sight:
                continue
            side_cos, side = 2.0, 0
            for m in range(3):
                q = (m + 1) % 3
                dot = (t[m, 0] * t[q, 0] + t[m, 1] * t[q, 1] + t[m, 2] * t[q, 2]) / (length[m] * length[q])
                if dot < side_cos:
                    side_cos, side = dot, m
            # across the border of the field it is halved on to a pixel or so, so that the border is kept to
            limit = widest_cos if inside == 0 or inside == 3 else border_cos
            if here >= deepest or side_cos > limit:
                # what is still wide after that is closer than a picture can show
                if inside == 3 and side_cos > widest_cos:
                    ax, ay = _pixel_of(t[0, 0], t[0, 1], t[0, 2], lens)
                    bx, by = _pixel_of(t[1, 0], t[1, 1], t[1, 2], lens)
                    cx, cy = _pixel_of(t[2, 0], t[2, 1], t[2, 2], lens)
                    fill(ax, ay, bx, by, cx, cy, length[0], length[1], length[2], f, depth, nearest)
                continue
            end = (side + 1) % 3
            for child in range(2):
                for m in range(3):
                    moved = m == (end if child == 0 else side)
                    for k in range(3):
                        stack[top, m, k] = 0.5 * (t[side, k] + t[end, k]) if moved else t[m, k]
                level[top] = here + 1
                top += 1


def render(camera: Camera, vertices_body_m: FloatArray, faces: NDArray[np.int64]) -> Rendered:
    """Render triangles.

    Parameters
    ----------
    camera : Camera
    vertices_body_m : (n, 3) float
        From the datum, body axes.
    faces : (m, 3) int
        Indices of vertices.

    Returns
    -------
    Rendered
        ``face`` counts the given faces, whatever was split.
    """
    shape = (camera.height_px, camera.width_px)
    depth, nearest = np.full(shape, np.inf), np.full(shape, -1, dtype=np.int64)
    raster(
        np.ascontiguousarray(vertices_body_m, dtype=float), np.ascontiguousarray(faces, dtype=np.int64),
        camera.lens_terms, camera.picture_half_angle_rad + _MARGIN_RAD, WIDEST_RAD, _DEEPEST_SPLIT, depth, nearest,
    )  # fmt: skip
    return Rendered(depth, nearest)

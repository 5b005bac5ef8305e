"""What would the onboard camera have filmed of the deflected aeroshell, through the lens as built?

The picture is ray-marched, not the estimator's projection: every pixel has its own ray, which marches to the shell by
its distance function and is anti-aliased along the edge by the share of the pixel that the shell covers. With the
shell's tori in the half-plane (station ``s``, radius ``r``), generator and aft normal components ``a`` and ``b`` of the
point from the innermost centre,

    distance = hypot(a - p round(a / p), b) - a_minor,       t <- t + distance,

one expression for the whole stack. A shell that is out of shape is evaluated in the half-plane rotated back about the
innermost ring by the flattening and lobes of two and of three waves round the shell. Shading is Lambert's with
one Sun and a weak sky; seams and dots are painted by surface coordinates. Behind the rim is a dark sky, and the Earth
where the scenario has it. The centerbody and the tori cast shadows, hard but for the Sun's disc: a ray towards the Sun
that passes a body at a distance ``c`` after a way ``k`` leaves ``1/2 + c / (0.0093 k)`` of the disc free, one that
passes a torus ``c / (0.0093 k)``. What lies in shadow has the sky's light alone. The rows of a rolling shutter are
exposed one after the other. Then come interlace and motion, vignetting, blur, sensor noise and compression.

A user's mesh of the shell is filled through the same lens at three by three samples a pixel (`flightmodel.rendering`);
seams and dots are painted on it where the tori would have them.

Rays are cast by compiled loops (readable twin: `tests.oracles.plain_film`), whose points and directions are in shell
axes. ``shell``: station and radius of the innermost centre, cosine and sine of the half angle, pitch and minor radius
of the tori, number of the last, how far a ray goes, angle of a gore. ``warp``: flattening, lobes, and whether there are
any (`Warp`). ``body``: the centerbody's nose, aft unit vector, radius and length.

Assumed: one Sun, no light from the Earth or from one torus on another, no glare (the lens looks away from the Sun); a
mesh casts no shadow on itself, and on the centerbody that of the tori.

Lens and pointing as built are drawn once a flight (`as_built_camera`), and so is the shell's departure from its shape,
as built and under load: an estimator starts from the nominal mount and the nominal shell. The film of a flight is
written as images or as a playable film, with a table of the frames' times.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flightmodel import earth, rotations
from flightmodel._kernels import inlined, kernel
from flightmodel.camera import Camera, camera_from_mount
from flightmodel.checks import FloatArray, GateError, Progress, check_finite, check_shape
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from flightmodel.film import film_frames
from flightmodel.geomagnetism_and_sun import sun_direction_ecef
from flightmodel.geometry import BodyMesh, ShellGeometry, torus_circles
from flightmodel.rendering import against, face_normals, render
from flightmodel.vehicle import CameraMount
from synthetic_flight import sensing
from synthetic_flight.ensemble import available_cores
from synthetic_flight.instrument_errors import FilmQuality, Video
from synthetic_flight.scenarios import Scenario, child_rng
from synthetic_flight.simulate import Truth

Float32 = NDArray[np.float32]
_SAMPLES = 3  # of a mesh, along each side of a pixel
FARTHEST_M, FARTHEST_RADII = 6.0, 4.0  # how far a ray marches: the larger of the two (m, base radii of the shell)
EARTH_RADIUS_M = 6.371e6
LIMB_GLOW_RAD = float(np.deg2rad(0.4))
STEPS = 80
NEAR_M = 0.05  # from where on the distance changes as a straight line along a ray
STEEPEST = 2.5  # of a step to the distance; it is signed, and an overshoot returns
REACHED_M, HIT_M = 2e-4, 4e-3
SUN_DIAMETER = 0.0093  # rad
LANES = 1024  # rays side by side: their arrays stay in the nearest cache
OFF_SKIN_M = 2e-3  # from where a surface point looks at the Sun


@dataclass(frozen=True)
class Warp:
    """Departure of a shell from its nominal shape: half angle, lobes of two and of three waves, rad.

    Parameters
    ----------
    flattening_rad : float
        All round; positive moves the rim aft.
    cosine_2_rad, sine_2_rad, cosine_3_rad, sine_3_rad : float
        Times cosine and sine of two and of three clocking angles.
    """

    flattening_rad: float = 0.0
    cosine_2_rad: float = 0.0
    sine_2_rad: float = 0.0
    cosine_3_rad: float = 0.0
    sine_3_rad: float = 0.0

    def plus(self, other: Warp) -> Warp:
        """Return the sum of two warps."""
        return Warp(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def times(self, load: float) -> Warp:
        """Return the warp scaled to a fraction of the load."""
        return Warp(*(load * part for part in astuple(self)))


@dataclass(frozen=True)
class Background:
    """The Earth behind the rim.

    Parameters
    ----------
    nadir_body : (3,) float
        Unit vector.
    altitude_m : float
    """

    nadir_body: FloatArray
    altitude_m: float


class ShellRenderer:
    """Ray caster for one camera and one shell; caches what is constant over the frames.

    Parameters
    ----------
    geometry : ShellGeometry
    camera : Camera
    joint_station_m : float
        Joint aft of the nose, m.
    vignetting : float
        Share of light that is lost at right angles to the lens's axis.
    painted, shadows : bool
        Whether the shell carries seams and dots, and whether bodies cast shadows.
    """

    def __init__(
        self, geometry: ShellGeometry, camera: Camera, joint_station_m: float, vignetting: float = 0.38,
        painted: bool = True, shadows: bool = True,
    ) -> None:  # fmt: skip
        self.geometry, self.camera = geometry, camera
        self.joint_m = np.array([-joint_station_m, 0.0, 0.0])
        self.painted, self.shadows = painted, shadows
        self.shell = shell_terms(geometry)
        w, h = camera.size_px
        u, v = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
        rays = camera.rays_body(np.column_stack([u.ravel(), v.ravel()]))
        in_field = np.isfinite(rays[:, 0])
        rays[~in_field] = -camera.dcm_cam_body[1]
        self.rays = rays.reshape(h, w, 3)
        self.rays32 = self.rays.astype(np.float32)
        self.few_rays = np.ascontiguousarray(self.rays[::2, ::2]).reshape(-1, 3)
        cosine = self.rays @ camera.dcm_cam_body[2]
        self.vignetting = np.where(in_field.reshape(h, w), 1.0 - vignetting * (1.0 - cosine), 0.0).astype(np.float32)
        self.sky = _sky(self.rays, camera)
        self.body_depth_m, self.body_normal = self._centerbody()
        self.is_clear = ~np.isfinite(self.body_depth_m)

    def radiance(
        self, theta_rad: float, plane_lv_rad: float, sun_direction_body: FloatArray,
        warp: Warp | None = None, background: Background | None = None,
    ) -> Float32:  # fmt: skip
        """Scene radiance ``(h, w)`` before lens and sensor errors; one is full scale. Thread-safe."""
        cover, shade, body = self.seen(theta_rad, plane_lv_rad, sun_direction_body, warp)
        behind = self.sky if background is None else np.maximum(self.sky, self._earth(background))
        return np.asarray(np.where(self.is_clear, cover * shade + (1.0 - cover) * behind, body), dtype=np.float32)

    @cached_property
    def _fine(self) -> tuple[Camera, Float32]:
        """Camera with one pixel per sample, and its rays (h, w, 3)."""
        fine = self.camera.sampled(_SAMPLES)
        v, u = np.indices((fine.height_px, fine.width_px), dtype=float)
        rays = fine.rays_body(np.column_stack([u.ravel(), v.ravel()])).astype(np.float32)
        return fine, rays.reshape(*u.shape, 3)

    def _seen_mesh(self, mesh: BodyMesh, in_shell: _InShell, warp: Warp | None) -> tuple[FloatArray, FloatArray]:
        """Share (h, w) of each pixel that a mesh of the shell covers, and its radiance, sampled finer than pixels."""
        turn, eye, sun, shell, _, body = in_shell
        (h, w), n, (fine, fine_rays) = self.sky.shape, _SAMPLES, self._fine
        vertices = warped(mesh.vertices_m, warp, self.geometry)
        picture = render(fine, (vertices - self.joint_m) @ turn + self.joint_m, mesh.faces)
        v, u = np.nonzero(picture.is_hit)
        rays = fine_rays[v, u] @ turn.T
        normal = against(face_normals(vertices, mesh.faces)[picture.face[v, u]], rays)
        points, shade = eye + picture.depth_m[v, u, None] * rays, np.empty(len(u))
        shade_mesh(points, normal, sun, shell, body, self.painted, self.shadows, shade)
        at = (v // n) * w + u // n
        count = np.bincount(at, minlength=h * w)
        total = np.bincount(at, shade, minlength=h * w)
        return (count / n**2).reshape(h, w), (total / np.maximum(count, 1)).reshape(h, w)

    def seen(
        self, theta_rad: float, plane_lv_rad: float, sun_direction_body: FloatArray, warp: Warp | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fraction of each pixel covered by the shell, radiance of shell and of centerbody, ``(h, w)`` each."""
        rotation = rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))
        turn = rotations.dcm_from_q(rotations.exp(-rotation))
        sun_body, geometry = np.asarray(sun_direction_body, dtype=float), self.geometry
        eye = turn @ (self.camera.position_body_m - self.joint_m) + self.joint_m
        nose, aft = self.joint_m - turn @ self.joint_m, -turn[:, 0]
        body = (nose, np.ascontiguousarray(aft), geometry.centerbody_radius_m, geometry.centerbody_length_m)
        in_shell = (turn, eye, turn @ sun_body, self.shell, warp_terms(warp), body)
        if geometry.mesh is not None:
            return *self._seen_mesh(geometry.mesh, in_shell, warp), self._centerbody_shade(sun_body, in_shell)
        depth = np.empty(self.sky.shape)
        cast(self.rays, self.is_clear, turn, eye, self.shell, in_shell[4], depth)
        shade = self._shade(self.rays, depth, self._sun_seen(depth, in_shell), in_shell)
        return self._cover(in_shell, depth, shade), shade, self._centerbody_shade(sun_body, in_shell)

    def _sun_seen(self, depth: FloatArray, in_shell: _InShell) -> FloatArray:
        """Visible fraction (h, w) of the Sun's disc where four pixels of a half-resolution grid agree, else NaN.

        Shadows narrower than two pixels may be missed.
        """
        if not self.shadows:
            return np.ones(depth.shape)
        turn, eye, sun, shell, warp, body = in_shell
        (h, w), every = depth.shape, depth[::2, ::2]
        few = np.full(every.shape, np.nan)
        see_sun(self.few_rays, every.ravel(), turn, eye, sun, shell, warp, body, few.ravel())
        next_row, next_column = np.append(few[1:], few[-1:], axis=0), np.append(few[:, 1:], few[:, -1:], axis=1)
        across = np.append(next_row[:, 1:], next_row[:, -1:], axis=1)
        agree = ((few == 0.0) | (few == 1.0)) & (few == next_row) & (few == next_column) & (few == across)
        free = np.ascontiguousarray(np.where(agree, few, np.nan).repeat(2, axis=0)[:h].repeat(2, axis=1)[:, :w])
        free[::2, ::2] = few
        return free

    def _shade(self, rays: FloatArray, depth: FloatArray, free: FloatArray, in_shell: _InShell) -> FloatArray:
        """Radiance of the skin met by rays (..., 3) at depths; fills in NaN in ``free``, the Sun's visible fraction."""
        turn, eye, sun, shell, warp, body = in_shell
        shade, flat = np.empty(depth.shape), rays.reshape(-1, 3)
        see_sun(flat, depth.ravel(), turn, eye, sun, shell, warp, body, free.ravel())
        shade_shell(flat, depth.ravel(), free.ravel(), turn, eye, sun, shell, warp, self.painted, shade.ravel())
        return shade

    def _cover(self, in_shell: _InShell, depth: FloatArray, shade: FloatArray) -> FloatArray:
        """Fraction (h, w) of each pixel covered by the shell; fills in ``shade`` where the pixel's centre misses it."""
        hit = np.isfinite(depth).astype(np.uint8)
        kernel = np.ones((7, 7), np.uint8)
        v, u = np.nonzero((cv2.dilate(hit, kernel) != cv2.erode(hit, kernel)) & self.is_clear)
        cover = hit.astype(float)
        gap, at, (turn, eye, _, shell, warp, _) = np.empty(len(u)), np.empty(len(u)), in_shell
        near, rays = cv2.erode(depth, kernel)[v, u], self.rays[v, u]
        closest(rays, near, turn, eye, shell, warp, gap, at)
        cover[v, u] = np.clip(0.5 - gap / (at / self.camera.focal_px.mean()), 0.0, 1.0)
        # at the edge the line of sight grazes the surface: its shade there is that of the whole pixel
        graze = ~hit[v, u].astype(bool)
        free = np.full(graze.sum(), np.nan if self.shadows else 1.0)
        shade[v[graze], u[graze]] = self._shade(rays[graze], at[graze], free, in_shell)
        return cover

    def _earth(self, background: Background) -> Float32:
        """Radiance ``(h, w)`` of the Earth: sea, clouds in bands, haze and a limb that glows above the horizon."""
        down = self.rays32 @ background.nadir_body.astype(np.float32)
        dip = np.arccos(EARTH_RADIUS_M / (EARTH_RADIUS_M + background.altitude_m))
        above = np.arccos(np.clip(down, -1.0, 1.0)) - np.float32(0.5 * np.pi - dip)
        # where the ray leaves the vehicle sideways, in units of altitude: the clouds' map
        east, north = np.cross(background.nadir_body, [0.3, 0.8, 0.5]), np.zeros(3)
        east /= np.linalg.norm(east)
        north = np.cross(background.nadir_body, east)
        reach = 1.0 / np.maximum(down, 0.05)
        e, n = (reach * (self.rays32 @ axis.astype(np.float32)) for axis in (east, north))
        clouds = np.sin(3.1 * e + 1.3 * np.sin(2.3 * n)) * np.sin(2.7 * n - 0.9 * np.sin(1.9 * e))
        ground = 0.16 + 0.20 * np.clip(clouds, 0.0, 1.0) + 0.10 * np.exp(np.minimum(above, 0.0) / np.float32(0.08))
        limb = 0.30 * np.exp(-np.maximum(above, 0.0) / np.float32(LIMB_GLOW_RAD))
        out: Float32 = np.where(above < 0.0, ground, limb).astype(np.float32)
        return out

    def _centerbody(self) -> tuple[FloatArray, FloatArray]:
        """Depth, m (infinite where not seen), and radial normal (h, w, 2) of the cylinder along each pixel's ray."""
        dx, dy, dz = np.moveaxis(self.rays, -1, 0)
        x, y, z = self.camera.position_body_m
        # the lens sits on the skin: keep it a millimetre outside
        radius = min(self.geometry.centerbody_radius_m, float(np.hypot(y, z)) - 1e-3)
        across, half_b, c = np.maximum(dy**2 + dz**2, 1e-9), y * dy + z * dz, y * y + z * z - radius**2
        square = half_b**2 - across * c
        depth = (-half_b - np.sqrt(np.maximum(square, 0.0))) / across
        station = -(x + depth * dx)
        on = (square > 0) & (half_b < 0) & (station > 0.0) & (station < self.geometry.centerbody_length_m)
        reach = np.where(on, depth, 0.0)
        return np.where(on, depth, np.inf), np.stack([y + reach * dy, z + reach * dz], axis=-1) / radius

    def _centerbody_shade(self, sun_body: FloatArray, in_shell: _InShell) -> FloatArray:
        """Radiance (h, w) of the centerbody, lit where the tori do not shade it."""
        lit = np.maximum(self.body_normal @ sun_body[1:], 0.0)
        at = self.shadows & (lit > 0.0) & ~self.is_clear
        turn, eye, sun, shell, warp, _ = in_shell
        points = eye + self.body_depth_m[at][:, None] * self.rays[at] @ turn.T
        share = np.empty(len(points))
        sunlit(points, sun, shell, warp, share)
        lit[at] *= share
        return np.asarray(0.10 + 0.35 * lit)


_InShell = tuple[FloatArray, FloatArray, FloatArray, tuple[float, ...], tuple[float, ...], tuple[object, ...]]
"""Shell against body, eye, Sun, shell, warp and centerbody in shell axes, as the kernels take it."""


def shell_terms(geometry: ShellGeometry) -> tuple[float, ...]:
    """Parameters of the stack of tori, packed for the kernels."""
    station, radius = torus_circles(geometry)
    half = np.deg2rad(geometry.half_angle_deg)
    farthest_m = max(FARTHEST_M, FARTHEST_RADII * geometry.base_radius_m)
    cone = (station[0], radius[0], np.cos(half), np.sin(half))
    tori = (geometry.torus_spacing_m, geometry.torus_minor_radius_m, geometry.torus_count - 1)
    return tuple(float(term) for term in (*cone, *tori, farthest_m, 2.0 * np.pi / geometry.gore_count))


def warp_terms(warp: Warp | None) -> tuple[float, ...]:
    """Parameters of a departure from the nominal shape, packed for the kernels."""
    return (*astuple(warp or Warp()), float(warp is not None))


@inlined
def _half_plane(x, y, z, shell, warp):
    """Distances along the generator from the nearest torus's centre and aft of the generator, and the radius, m."""
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
    """Largest distance of the stack's skin aft of its generator, m, with its departure from shape."""
    bent = abs(warp[0]) + abs(warp[1]) + abs(warp[2]) + abs(warp[3]) + abs(warp[4])
    return shell[5] + 0.02 + bent * (shell[6] * shell[4] + 2.0 * shell[5])


@inlined
def _way_to_stack(x, y, z, dx, dy, dz, shell, warp):
    """Free distance along a ray, m, from a point aft of the stack to the cone that encloses the stack.

    Infinite if the ray does not meet that cone; zero for a point elsewhere.
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
    """Fraction of the Sun's disc not hidden by the centerbody."""
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
    """Multiply ``free`` at pixels ``pixel`` (n,) by the fraction of the Sun's disc not hidden by the tori.

    The points (3, n) lie off the tori's skin; the points, ``pixel`` and ``lanes`` are used up as by `_march`.
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
    """Radiance of the skin at depth ``t`` along a ray, with the given fraction of the Sun's disc visible."""
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
    """Distance and depth, m, at the closest approach of rays (n, 3) to the shell, starting from depths nearby."""
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
    """Fill in NaN in ``free`` (n,): visible fraction of the Sun's disc where rays (n, 3) meet the skin."""
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
    """Radiance (n,) of the skin met by rays (n, 3), zero for a miss; ``free`` (n,): visible fraction of the Sun."""
    d = np.empty(3)
    for k in range(len(rays)):
        shade[k] = 0.0
        if depth[k] < math.inf:
            _into_shell(turn, rays[k], d)
            shade[k] = _shade(eye, d, depth[k], free[k], sun, shell, warp, painted)


@kernel
def shade_mesh(points, normals, sun, shell, body, painted, shadows, shade):
    """Radiance (n,) at points (n, 3) of a mesh on the undeformed shell, shaded by the centerbody alone."""
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
    """Fraction (n,) of the Sun's disc not hidden by the tori, at points (n, 3) off their skin."""
    n = len(points)
    share[:] = 1.0
    _beside_shell(points.T.copy(), np.arange(n), np.empty((3, n)), sun, shell, warp, share)


def warped(points_shell_m: FloatArray, warp: Warp | None, geometry: ShellGeometry) -> FloatArray:
    """Points ``(n, 3)`` of the deformed shell: rotated about the innermost ring in their half-planes."""
    if warp is None:
        return points_shell_m
    station, radius = (float(c[0]) for c in torus_circles(geometry))
    r = np.maximum(np.hypot(*points_shell_m[:, 1:].T), 1e-3)
    clock = lv_clock(points_shell_m[:, 1:])
    turn = warp.flattening_rad + sum(
        part * wave(k * clock)
        for k, parts in ((2, (warp.cosine_2_rad, warp.sine_2_rad)), (3, (warp.cosine_3_rad, warp.sine_3_rad)))
        for part, wave in zip(parts, (np.cos, np.sin), strict=True)
    )
    aft, out = -points_shell_m[:, 0] - station, r - radius
    # the inverse of the casting's turn, which is to first order
    aft, out = (aft + turn * out) / (1.0 + turn**2), (out - turn * aft) / (1.0 + turn**2)
    scale = (radius + out) / r
    return np.column_stack([-(station + aft), scale * points_shell_m[:, 1], scale * points_shell_m[:, 2]])


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def _sky(rays: FloatArray, camera: Camera) -> Float32:
    """Radiance of the sky: almost black, brighter towards the shell's rim by light scattered in the lens."""
    outboard, ahead = np.array([0.0, *camera.position_body_m[1:]]), camera.dcm_cam_body[2]
    upward = rays @ _unit(outboard - (outboard @ ahead) * ahead)
    return np.asarray(0.035 + 0.035 * np.exp(-3.0 * np.clip(upward, 0.0, 1.0)), dtype=np.float32)


Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Imaging:
    """Errors of the camera as built, and of its recording; one standard deviation where drawn.

    Parameters
    ----------
    pointing_sd_rad : float
        About each camera axis.
    focal_sd : float
        Fraction.
    centre_sd_px : float
        Of the principal point along u and v.
    k1_sd, k2_sd : float
        Of the lens's first coefficients.
    position_sd_m : float
        Along each body axis.
    noise_sd : float
        Of a pixel, in grey levels of 255.
    blur_px : float
        Standard deviation of the point-spread function.
    vignetting : float
        Share of light that is lost at right angles to the lens's axis.
    interlace_s : float
        Time from the first field to the second, rows taken in turns; each is open for as long. Zero: the whole frame
        at once.
    readout_s : float
        Time from the exposure of the first row to that of the last, of a rolling shutter; the frame's time is that of
        the middle row.
    quality : int
        Of JPEG compression, 1 to 100; zero: none.
    painted : bool
        Whether the shell carries seams and dots that can be seen.
    shadows : bool
        Whether the centerbody and the tori cast shadows.
    built_sd_rad, loaded_sd_rad : float
        Flattening of the shell as built, and under the largest load; each lobe's cosine and sine half of that.
    loaded : Warp
        Shape under the largest load, beside the drawn one.
    """

    pointing_sd_rad: float = float(np.deg2rad(0.5))
    focal_sd: float = 0.01
    centre_sd_px: float = 1.0
    k1_sd: float = 0.003
    k2_sd: float = 0.0
    position_sd_m: float = 0.002
    noise_sd: float = 2.5
    blur_px: float = 0.8
    vignetting: float = 0.38
    interlace_s: float = 0.0
    readout_s: float = 0.0
    quality: int = 0
    painted: bool = True
    shadows: bool = True
    built_sd_rad: float = 0.0
    loaded_sd_rad: float = 0.0
    loaded: Warp = Warp()


@dataclass(frozen=True)
class Scene:
    """Scene in front of the camera, frame by frame.

    Parameters
    ----------
    theta_rad, plane_lv_rad : (n,) float
        Deflection.
    sun_body : (n, 3) float
        Unit vectors towards the Sun, body axes; zero vectors in darkness.
    nadir_body : (n, 3) float, optional
        Unit vectors to the ground; without them there is no Earth in view.
    altitude_m : (n,) float, optional
    load : (n,) float, optional
        Share of the largest dynamic pressure, for the shell's shape; zero without.
    deflection_rate_yz_radps : (n, 2) float, optional
        Rate of ``theta`` as a lateral vector, for what moves between two fields.
    """

    theta_rad: FloatArray
    plane_lv_rad: FloatArray
    sun_body: FloatArray
    nadir_body: FloatArray | None = None
    altitude_m: FloatArray | None = None
    load: FloatArray | None = None
    deflection_rate_yz_radps: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check lengths and values once."""
        n = len(self.theta_rad)
        shapes = {"theta_rad": (n,), "plane_lv_rad": (n,), "sun_body": (n, 3), "nadir_body": (n, 3),
                  "altitude_m": (n,), "load": (n,), "deflection_rate_yz_radps": (n, 2)}  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None:
                check_finite(f"scene.{name}", check_shape(f"scene.{name}", np.asarray(value, dtype=float), shape))


def as_built_camera(camera_mount: CameraMount, rng: np.random.Generator, imaging: Imaging | None = None) -> Camera:
    """Draw the camera as built: with errors of pointing, lens and position."""
    imaging = imaging or Imaging()
    nominal = camera_from_mount(camera_mount)
    draw = rng.standard_normal(10)
    lens = nominal.distortion.copy()
    lens[0] += imaging.k1_sd * draw[6]
    if imaging.k2_sd:
        lens[1] += imaging.k2_sd * rng.standard_normal()
    built = replace(
        nominal,
        centre_px=nominal.centre_px + imaging.centre_sd_px * draw[4:6],
        distortion=lens,
        position_body_m=nominal.position_body_m + imaging.position_sd_m * draw[7:10],
    )
    return built.turned(imaging.pointing_sd_rad * draw[:3], 1.0 + imaging.focal_sd * draw[3])


def film(
    vehicle_geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    scene: Scene,
    rng: np.random.Generator,
    imaging: Imaging | None = None,
    shape_rng: np.random.Generator | None = None,
) -> Iterator[Image]:
    """Film a scene.

    Parameters
    ----------
    vehicle_geometry : ShellGeometry
    camera_mount : CameraMount
        Nominal; the camera as built is drawn from ``rng`` first (`real_camera`).
    joint_station_m : float
        Joint aft of the nose, m.
    scene : Scene
    rng : numpy.random.Generator
        Of the camera's build, the shell's shape and the pixel noise.
    imaging : Imaging, optional
    shape_rng : numpy.random.Generator, optional
        Of the shell's shape, where several cameras film the same shell.

    Yields
    ------
    (height, width) uint8

    Raises
    ------
    GateError
        When lengths differ or a value is not finite.
    """
    imaging = imaging or Imaging()
    camera = as_built_camera(camera_mount, rng, imaging)
    renderer = ShellRenderer(
        vehicle_geometry, camera, joint_station_m, imaging.vignetting, imaging.painted, imaging.shadows
    )
    built, loaded = _shapes(imaging, shape_rng or rng)

    def radiance(k: int, after_s: float) -> Float32:
        theta, plane = float(scene.theta_rad[k]), float(scene.plane_lv_rad[k])
        if after_s and scene.deflection_rate_yz_radps is not None:
            lateral = theta * np.array([-np.cos(plane), np.sin(plane)]) + after_s * scene.deflection_rate_yz_radps[k]
            theta, plane = float(np.hypot(*lateral)), float(np.arctan2(lateral[1], -lateral[0]))
        load = 0.0 if scene.load is None else float(scene.load[k])
        warp = None if built is None or loaded is None else built.plus(loaded.times(load))
        earth = None
        if scene.nadir_body is not None and scene.altitude_m is not None:
            earth = Background(scene.nadir_body[k], float(scene.altitude_m[k]))
        return renderer.radiance(theta, plane, scene.sun_body[k], warp, earth)

    def exposed(k: int) -> Float32:
        if imaging.interlace_s:
            early, late = (radiance(k, side * 0.5 * imaging.interlace_s) for side in (-1.0, 1.0))
            # each field is open from its start to the other's: it moves while it is exposed
            picture = 0.75 * early + 0.25 * late
            picture[1::2] = 0.25 * early[1::2] + 0.75 * late[1::2]
            return picture
        if imaging.readout_s and scene.deflection_rate_yz_radps is not None:
            return rolled(k, float(np.linalg.norm(scene.deflection_rate_yz_radps[k])))
        return radiance(k, 0.0)

    def rolled(k: int, rate_radps: float) -> Float32:
        # between moments less than half a pixel apart, a blend of two pictures is the picture between them
        apart = 2.0 * rate_radps * imaging.readout_s * float(camera.focal_px.max())
        moments = np.linspace(-0.5, 0.5, 2 + int(apart)) * imaging.readout_s
        row_s = (np.arange(0.5, camera.height_px) / camera.height_px - 0.5) * imaging.readout_s
        picture = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
        for moment in moments:
            share = np.maximum(1.0 - np.abs(row_s - moment) / (moments[1] - moments[0]), 0.0)
            picture += share[:, None].astype(np.float32) * radiance(k, float(moment))
        return picture

    pictures = _ahead(exposed, len(scene.theta_rad))
    return (record(picture, renderer.vignetting, imaging, rng) for picture in pictures)


def _ahead(make: Callable[[int], Float32], count: int) -> Iterator[Float32]:
    """Yield ``make(0)``, ``make(1)``, ... in order, computed a few ahead in threads."""
    threads = available_cores()
    waiting: deque[Future[Float32]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for k in range(count):
            waiting.append(pool.submit(make, k))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def render_video(
    vehicle_geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    theta_rad: FloatArray,
    plane_lv_rad: FloatArray,
    sun_direction_body: FloatArray,
    rng: np.random.Generator,
    imaging: Imaging | None = None,
) -> Iterator[Image]:
    """Film deflections in the light of the Sun alone; see `film` and `Scene`."""
    theta_rad = check_shape("theta_rad", theta_rad, (None,))
    scene = Scene(theta_rad, plane_lv_rad, sun_direction_body)
    return film(vehicle_geometry, camera_mount, joint_station_m, scene, rng, imaging)


def _shapes(imaging: Imaging, rng: np.random.Generator) -> tuple[Warp, Warp] | tuple[None, None]:
    """Draw the shell's departure from its shape, as built and under the largest load."""
    if not imaging.built_sd_rad and not imaging.loaded_sd_rad and imaging.loaded == Warp():
        return None, None
    share = np.array([1.0, 0.5, 0.5, 0.5, 0.5])
    # the fifth of each from a stream of its own: the noise of the pictures stays what it was without it
    fifth = rng.spawn(1)[0]
    built, loaded = (
        Warp(*(sd * share * np.append(rng.standard_normal(4), fifth.standard_normal())).tolist())
        for sd in (imaging.built_sd_rad, imaging.loaded_sd_rad)
    )
    return built, loaded.plus(imaging.loaded)


def record(radiance: Float32, vignetting: Float32, imaging: Imaging, rng: np.random.Generator) -> Image:
    """Turn scene radiance (one is full scale) into grey levels ``(h, w)``: vignetting, blur, noise, compression."""
    grey = cv2.GaussianBlur(radiance * (255.0 * vignetting), (0, 0), imaging.blur_px)
    grey += np.float32(imaging.noise_sd) * rng.standard_normal(grey.shape, dtype=np.float32)
    picture = np.asarray(cv2.convertScaleAbs(np.maximum(grey, 0.0, out=grey)), dtype=np.uint8)
    if imaging.quality:
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, imaging.quality])
        picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return picture


CODECS = {"avi": "MJPG", "webm": "VP90"}


def write_videos(scenario: Scenario, seed: int, truth: Truth, telemetry: Path, report: Progress) -> None:
    """Film the flight with every camera; of several, names go by the tables of the scenario."""
    spec = scenario.spec
    if spec.video is not None:
        _write_video(scenario, spec.video, seed, truth, (telemetry, spec.video.camera, "frames.csv"), report)
    for k, (name, video) in enumerate(spec.videos.items()):
        part = lambda f, what, k=k: report((k + f) / len(spec.videos), what)  # noqa: E731
        shape = child_rng(seed, "shell")
        _write_video(scenario, video, seed, truth, (telemetry, name, f"frames_{name}.csv"), part, shape)


def _write_video(
    scenario: Scenario,
    spec: Video,
    seed: int,
    truth: Truth,
    place: tuple[Path, str, str],
    report: Progress,
    shape_rng: np.random.Generator | None = None,
) -> None:
    """Write a video, as images in a folder or as one film, and its list of frame times, below a folder."""
    vehicle, (telemetry, name, listed) = scenario.vehicle, place
    rng = child_rng(seed, spec.camera)
    at = sensing.sample_times(spec.start_s, min(spec.stop_s, float(truth.time_s[-1])), spec.rate_hz)
    mount, imaging = vehicle.cameras[spec.camera], _imaging_from_quality(spec.imaging)
    seen = scene(truth, at, spec.earth)
    frames = film(vehicle.geometry, mount, vehicle.joint.station_m, seen, rng, imaging, shape_rng)
    images = _reported(frames, len(at), report)
    if spec.format == "png":
        names: list[object] = list(_write_images(images, telemetry / name))
    else:
        _write_film(images, telemetry / f"{name}.{spec.format}", spec, mount.size_px)
        names = list(range(len(at)))
    late = spec.time_offset_s * float(rng.standard_normal())
    table = pd.DataFrame({"t_s": at + late, "frame": names})
    table.to_csv(telemetry / listed, index=False, float_format="%.6f", lineterminator="\n")


def _imaging_from_quality(quality: FilmQuality) -> Imaging:
    """Errors of the film as the scenario states them, in SI units and radians."""
    return Imaging(
        pointing_sd_rad=float(np.deg2rad(quality.pointing_deg)),
        focal_sd=quality.focal,
        centre_sd_px=quality.centre_px,
        k1_sd=quality.k1,
        k2_sd=quality.k2,
        position_sd_m=quality.position_m,
        noise_sd=quality.noise_grey,
        blur_px=quality.blur_px,
        vignetting=quality.vignetting,
        interlace_s=quality.interlace_s,
        readout_s=quality.readout_s,
        quality=quality.quality,
        painted=quality.painted,
        shadows=quality.shadows,
        built_sd_rad=float(np.deg2rad(quality.built_deg)),
        loaded_sd_rad=float(np.deg2rad(quality.loaded_deg)),
        loaded=Warp(*np.deg2rad(quality.loaded_shape_deg).tolist()),
    )


def scene(truth: Truth, at_s: FloatArray, with_earth: bool) -> Scene:
    """Scene in front of the camera at times ``(n,)``."""
    yz = np.column_stack([np.interp(at_s, truth.time_s, c) for c in truth.deflection.theta_yz_rad.T])
    step = 0.005
    ends = [np.column_stack([np.interp(at_s + d, truth.time_s, c) for c in truth.deflection.theta_yz_rad.T])
            for d in (-step, step)]  # fmt: skip
    pressure = truth.dynamic_pressure_pa
    return Scene(
        theta_rad=np.hypot(yz[:, 0], yz[:, 1]),
        plane_lv_rad=np.arctan2(yz[:, 1], -yz[:, 0]),
        sun_body=_to_body(truth, at_s, sun_direction_ecef(truth.trajectory.epoch_utc, at_s)),
        nadir_body=_to_body(truth, at_s, -_up_ecef(truth, at_s)) if with_earth else None,
        altitude_m=np.interp(at_s, truth.time_s, truth.altitude_m) if with_earth else None,
        load=np.interp(at_s, truth.time_s, pressure) / max(float(pressure.max()), 1e-9),
        deflection_rate_yz_radps=(ends[1] - ends[0]) / (2.0 * step),
    )


def _to_body(truth: Truth, at_s: FloatArray, vectors_ecef: FloatArray) -> FloatArray:
    q = rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, at_s)
    return rotations.rotate(rotations.conjugate(q), vectors_ecef)


def _up_ecef(truth: Truth, at_s: FloatArray) -> FloatArray:
    position = np.column_stack([np.interp(at_s, truth.time_s, c) for c in truth.trajectory.position_ecef_m.T])
    latitude, longitude, _ = earth.geodetic_from_ecef(position)
    c = np.cos(latitude)
    return np.column_stack([c * np.cos(longitude), c * np.sin(longitude), np.sin(latitude)])


def _reported(frames: Iterable[Image], count: int, report: Progress) -> Iterable[Image]:
    for k, frame in enumerate(frames):
        report(0.25 + 0.7 * k / count, f"filming frame {k + 1} of {count}")
        yield frame


def _write_images(frames: Iterable[Image], folder: Path) -> Iterable[str]:
    folder.mkdir()
    for k, frame in enumerate(frames):
        name = f"frame_{k:05d}.png"
        # through Python's own file, which raises on a full disk
        (folder / name).write_bytes(cv2.imencode(".png", frame)[1].tobytes())
        yield name


def _write_film(frames: Iterable[Image], path: Path, spec: Video, size_px: tuple[int, int]) -> None:
    code = cv2.VideoWriter.fourcc(*CODECS[path.suffix[1:]])
    writer = cv2.VideoWriter(str(path), code, float(spec.rate_hz), size_px)
    if not writer.isOpened():
        message = f'{path}: this build of OpenCV cannot write such a film; write images: video.format = "png"'
        raise GateError(message, code="package-missing")
    count = 0
    try:
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
            count += 1
    finally:
        writer.release()
    if count and next(film_frames(path, [count - 1])).size == 0:  # OpenCV does not report a full disk
        message = f"{path.name}: the film could not be written whole; make room, or write to another disk"
        raise GateError(message, code="disk-full")

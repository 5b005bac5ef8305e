"""What would the onboard camera have filmed of the deflected aeroshell, through the lens as built?

The picture is ray-marched, not the estimator's projection: every pixel has its own ray, which marches to the shell by
its distance function and is anti-aliased along the edge by the share of the pixel that the shell covers. With the
shell's tori in the half-plane (station ``s``, radius ``r``), generator and aft normal components ``a`` and ``b`` of the
point from the innermost centre,

    distance = hypot(a - p round(a / p), b) - a_minor,       t <- t + distance,

one expression for the whole stack. A shell that is out of shape is evaluated in the half-plane rotated back about the
innermost ring by the flattening and lobes of two and of three waves round the shell. Shading is Lambert's with
one Sun and a weak sky; seams and dots are painted by surface coordinates. Behind the rim is a dark sky, and the Earth
where the scenario has it. Assumed: no shadows. Then come interlace and motion, vignetting, blur, sensor noise and
compression.

Lens and pointing as built are drawn once a flight (`as_built_camera`), and so is the shell's departure from its shape,
as built and under load: an estimator starts from the nominal mount and the nominal shell. The film of a flight is
written as images or as a playable film, with a table of the frames' times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flightmodel import earth, rotations
from flightmodel.camera import Camera, camera_from_mount
from flightmodel.checks import FloatArray, GateError, Progress, check_finite, check_shape
from flightmodel.deflection import rotation_vector_body_shell
from flightmodel.film import film_frames
from flightmodel.geomagnetism_and_sun import sun_direction_ecef
from flightmodel.geometry import ShellGeometry, torus_circles
from flightmodel.vehicle import CameraMount
from synthetic_flight import sensing
from synthetic_flight.ensemble import available_cores
from synthetic_flight.instrument_errors import FilmQuality, Video
from synthetic_flight.scenarios import Scenario, child_rng
from synthetic_flight.simulate import Truth

Float32 = NDArray[np.float32]

MARCHING_STEPS = 5
COARSE, COARSE_STEPS = 4, 50
STRIP_ROWS = 32
FARTHEST_M, FARTHEST_RADII = 6.0, 4.0  # how far a ray marches: the larger of the two (m, base radii of the shell)
EARTH_RADIUS_M = 6.371e6
LIMB_GLOW_RAD = float(np.deg2rad(0.4))


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
        """Return both together."""
        return Warp(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def times(self, load: float) -> Warp:
        """Return the warp under a share of the load."""
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
    """Ray caster for one camera and one shell; holds what does not change from frame to frame."""

    def __init__(
        self, geometry: ShellGeometry, camera: Camera, joint_station_m: float, vignetting: float = 0.38
    ) -> None:
        self.geometry, self.camera = geometry, camera
        self.joint_m = np.array([-joint_station_m, 0.0, 0.0])
        self.stack = _Stack(geometry)
        w, h = camera.size_px
        u, v = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
        rays = camera.rays_body(np.column_stack([u.ravel(), v.ravel()]))
        in_field = np.isfinite(rays[:, 0])
        rays[~in_field] = -camera.dcm_cam_body[1]
        self.rays = np.ascontiguousarray(rays.T.reshape(3, h, w), dtype=np.float32)
        cosine = np.tensordot(camera.dcm_cam_body[2].astype(np.float32), self.rays, axes=1)
        self.vignetting = np.where(in_field.reshape(h, w), 1.0 - vignetting * (1.0 - cosine), 0.0).astype(np.float32)
        self.sky = _sky(self.rays, camera)
        self.body_depth_m, self.body_normal = self._centerbody()
        self.is_clear = ~np.isfinite(self.body_depth_m)

    def radiance(
        self, theta_rad: float, plane_lv_rad: float, sun_direction_body: FloatArray,
        warp: Warp | None = None, background: Background | None = None,
    ) -> Float32:  # fmt: skip
        """Scene radiance ``(h, w)`` before errors of lens and sensor; one is full scale. Threads may ask at once."""
        stack = copy(self.stack)
        stack.warp = warp
        rotation = rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))
        dcm_shell_body = rotations.dcm_from_q(rotations.exp(-rotation))
        eye = dcm_shell_body @ (self.camera.position_body_m - self.joint_m) + self.joint_m
        sun = dcm_shell_body @ np.asarray(sun_direction_body, dtype=float)
        to_shell = dcm_shell_body.astype(np.float32)
        h, w = self.sky.shape
        start = self._near_depth(stack, to_shell, eye)
        depth, shade = np.full((h, w), np.inf, dtype=np.float32), np.zeros((h, w), dtype=np.float32)
        for top in range(0, h, STRIP_ROWS):
            near = start[top : top + STRIP_ROWS].reshape(-1)
            live = np.flatnonzero((near < stack.farthest_m) & self.is_clear[top : top + STRIP_ROWS].reshape(-1))
            if len(live) == 0:
                continue
            rays = _Rays(_rotated(to_shell, self.rays[:, top : top + STRIP_ROWS].reshape(3, -1)[:, live]), eye)
            t, gap = stack.march(rays, near[live], MARCHING_STEPS)
            slow = np.flatnonzero(gap > 0.002)
            t[slow], gap[slow] = stack.march(rays.some(slow), t[slow], 9 * MARCHING_STEPS, 1.6)
            here = live + top * w
            depth.reshape(-1)[here] = np.where(gap < 0.004, t, np.inf)
            shade.reshape(-1)[here] = stack.shade(rays, t, sun)
        behind = self.sky if background is None else np.maximum(self.sky, self._earth(background))
        return self._composed(stack, depth, shade, to_shell, eye, np.asarray(sun_direction_body, dtype=float), behind)

    def _near_depth(self, stack: _Stack, to_shell: Float32, eye: FloatArray) -> Float32:
        """Depth ``(h, w)``, m, a little in front of the shell, from a march of many steps of every fourth ray."""
        coarse = self.rays[:, COARSE // 2 :: COARSE, COARSE // 2 :: COARSE]
        shape = coarse.shape[1:]
        rays = _Rays(_rotated(to_shell, coarse.reshape(3, -1)), eye)
        t, gap = stack.march(rays, np.full(rays.across.shape, 0.05, dtype=np.float32), COARSE_STEPS)
        near = np.where(gap < 0.004, t, np.float32(np.inf)).reshape(shape)
        near = cv2.erode(near, np.ones((3, 3), np.uint8)) - np.float32(0.005)
        return np.asarray(cv2.resize(near, self.camera.size_px, interpolation=cv2.INTER_NEAREST), dtype=np.float32)

    def _composed(
        self,
        stack: _Stack,
        depth: Float32,
        shade: Float32,
        to_shell: Float32,
        eye: FloatArray,
        sun_body: FloatArray,
        behind: Float32,
    ) -> Float32:
        """Shell over sky, its edge weighted by coverage, the centerbody over both."""
        hit = np.isfinite(depth).astype(np.uint8)
        kernel = np.ones((7, 7), np.uint8)
        v, u = np.nonzero((cv2.dilate(hit, kernel) != cv2.erode(hit, kernel)) & self.is_clear)
        cover = hit.astype(np.float32)
        if len(u):
            rays = _Rays(_rotated(to_shell, self.rays[:, v, u]), eye)
            sun = to_shell.astype(float) @ sun_body
            t, gap = stack.closest(rays, cv2.erode(depth, kernel)[v, u])
            pixel_m = t / np.float32(self.camera.focal_px.mean())
            cover[v, u] = np.clip(0.5 - gap / pixel_m, 0.0, 1.0)
            # at the edge the line of sight grazes the surface: its shade there is that of the whole pixel
            graze = ~hit[v, u].astype(bool)
            shade[v[graze], u[graze]] = stack.shade(rays, t, sun)[graze]
        picture = cover * shade + (1.0 - cover) * behind
        out: Float32 = np.where(self.is_clear, picture, self._centerbody_shade(sun_body))
        return out

    def _earth(self, background: Background) -> Float32:
        """Radiance ``(h, w)`` of the Earth: sea, clouds in bands, haze and a limb that glows above the horizon."""
        nx, ny, nz = np.asarray(background.nadir_body, dtype=np.float32)
        dx, dy, dz = self.rays
        down = nx * dx + ny * dy + nz * dz
        dip = np.arccos(EARTH_RADIUS_M / (EARTH_RADIUS_M + background.altitude_m))
        above = np.arccos(np.clip(down, -1.0, 1.0)) - np.float32(0.5 * np.pi - dip)
        # where the ray leaves the vehicle sideways, in units of altitude: the clouds' map
        east, north = np.cross(background.nadir_body, [0.3, 0.8, 0.5]), np.zeros(3)
        east /= np.linalg.norm(east)
        north = np.cross(background.nadir_body, east)
        reach = 1.0 / np.maximum(down, 0.05)
        e, n = (reach * np.tensordot(axis.astype(np.float32), self.rays, axes=1) for axis in (east, north))
        clouds = np.sin(3.1 * e + 1.3 * np.sin(2.3 * n)) * np.sin(2.7 * n - 0.9 * np.sin(1.9 * e))
        ground = 0.16 + 0.20 * np.clip(clouds, 0.0, 1.0) + 0.10 * np.exp(np.minimum(above, 0.0) / np.float32(0.08))
        limb = 0.30 * np.exp(-np.maximum(above, 0.0) / np.float32(LIMB_GLOW_RAD))
        out: Float32 = np.where(above < 0.0, ground, limb).astype(np.float32)
        return out

    def _centerbody(self) -> tuple[Float32, Float32]:
        """Depth, m (infinite where not seen), and radial normal (y, z) of the cylinder along each pixel's ray."""
        dx, dy, dz = self.rays
        x, y, z = self.camera.position_body_m
        # the lens sits on the skin: keep it a millimetre outside
        radius = min(self.geometry.centerbody_radius_m, float(np.hypot(y, z)) - 1e-3)
        across, half_b, c = np.maximum(dy**2 + dz**2, 1e-9), y * dy + z * dz, y * y + z * z - radius**2
        square = half_b**2 - across * c
        depth = (-half_b - np.sqrt(np.maximum(square, 0.0))) / across
        station = -(x + depth * dx)
        on = (square > 0) & (half_b < 0) & (station > 0.0) & (station < self.geometry.centerbody_length_m)
        reach = np.where(on, depth, 0.0)
        normal = np.stack([y + reach * dy, z + reach * dz]) / radius
        return np.where(on, depth, np.inf).astype(np.float32), normal.astype(np.float32)

    def _centerbody_shade(self, sun_body: FloatArray) -> Float32:
        lit = np.float32(sun_body[1]) * self.body_normal[0] + np.float32(sun_body[2]) * self.body_normal[1]
        shade: Float32 = (0.10 + 0.35 * np.maximum(lit, 0.0)).astype(np.float32)
        return shade


def _rotated(dcm: Float32, vectors: Float32) -> Float32:
    """Rotate vectors ``(3, n)`` without BLAS, whose idle threads would wait on the other core."""
    x, y, z = vectors
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in dcm])


def _sky(rays: Float32, camera: Camera) -> Float32:
    """Radiance of the sky: almost black, brighter towards the shell's rim by light scattered in the lens."""
    upward = -np.tensordot(camera.dcm_cam_body[1], rays, axes=1)
    sky: Float32 = (0.035 + 0.035 * np.exp(-3.0 * np.clip(upward, 0.0, 1.0))).astype(np.float32)
    return sky


class _Rays:
    """Rays from one eye point in shell axes, with the products that `_Stack.gap` needs at every depth."""

    def __init__(self, direction: Float32, eye_shell_m: FloatArray) -> None:
        self.direction = direction
        self.eye = [np.float32(e) for e in eye_shell_m]
        (_, ey, ez), (dx, dy, dz) = self.eye, direction
        self.minus_dx = -dx
        self.across = dy * dy + dz * dz
        self.twice_half_b = 2.0 * (ey * dy + ez * dz)
        self.c = ey * ey + ez * ez

    def some(self, index: NDArray[np.intp]) -> _Rays:
        """Return a subset of the rays."""
        return _Rays(self.direction[:, index], np.array(self.eye))


class _Stack:
    """The tori as one distance function in the half-plane of station and radius, float32."""

    def __init__(self, geometry: ShellGeometry) -> None:
        station, radius = torus_circles(geometry)
        half = np.deg2rad(geometry.half_angle_deg)
        self.s0, self.r0 = np.float32(station[0]), np.float32(radius[0])
        self.cos, self.sin = np.float32(np.cos(half)), np.float32(np.sin(half))
        self.pitch, self.minor = np.float32(geometry.torus_spacing_m), np.float32(geometry.torus_minor_radius_m)
        self.last = np.float32(geometry.torus_count - 1)
        self.farthest_m = np.float32(max(FARTHEST_M, FARTHEST_RADII * geometry.base_radius_m))
        self.gore_rad = np.float32(2.0 * np.pi / geometry.gore_count)
        self.warp: Warp | None = None
        self.painted = True

    def gap(self, rays: _Rays, t: Float32) -> Float32:
        """Distance, m, from the nearest torus of points at depth ``t`` along rays; negative inside."""
        r = rays.across * t
        r += rays.twice_half_b
        r *= t
        r += rays.c
        np.sqrt(np.maximum(r, 0.0, out=r), out=r)
        # a and b: along the generator and aft of it, from the innermost centre
        s = rays.minus_dx * t
        if self.warp is not None:
            y, z = rays.eye[1] + t * rays.direction[1], rays.eye[2] + t * rays.direction[2]
            s, r = self._on_nominal_shape(y, z, s - rays.eye[0], r)
            s += rays.eye[0]
        a = self.cos * s
        s *= self.sin
        s += (-rays.eye[0] - self.s0) * self.sin + self.r0 * self.cos
        a += (-rays.eye[0] - self.s0) * self.cos - self.r0 * self.sin
        a += self.sin * r
        r *= self.cos
        s -= r
        i = a * (1.0 / self.pitch)
        np.rint(i, out=i)
        np.minimum(i, self.last, out=i)
        np.maximum(i, 0.0, out=i)
        i *= self.pitch
        a -= i
        a *= a
        s *= s
        a += s
        np.sqrt(a, out=a)
        a -= self.minor
        return a

    def _on_nominal_shape(self, y: Float32, z: Float32, s: Float32, r: Float32) -> tuple[Float32, Float32]:
        """Station and radius, on the nominal shell, of points of the shell that is out of shape."""
        assert self.warp is not None
        per = 1.0 / np.maximum(r * r, np.float32(1e-6))
        # cos and sin of twice the clocking angle, whose cosine is -y / r
        turn = np.float32(self.warp.flattening_rad) + np.float32(self.warp.cosine_2_rad) * ((y * y - z * z) * per)
        turn -= np.float32(2.0 * self.warp.sine_2_rad) * (y * z * per)
        per = np.sqrt(per)
        cosine, sine = -y * per, z * per
        turn += np.float32(self.warp.cosine_3_rad) * cosine * (4.0 * cosine * cosine - 3.0)
        turn += np.float32(self.warp.sine_3_rad) * sine * (3.0 - 4.0 * sine * sine)
        aft, out = s - self.s0, r - self.r0
        return s - turn * out, r + turn * aft

    def march(self, rays: _Rays, start: Float32, steps: int, stretch: float = 1.0) -> tuple[Float32, Float32]:
        """Depth along rays from ``start (n,)`` and the distance left there, m, ``(n,)`` each.

        Near the surface steps may be stretched by a factor below 2: the distance is signed, and an overshoot returns.
        """
        t = start.copy()
        gap = self.gap(rays, t)
        for _ in range(steps):
            gap *= np.float32(stretch)
            t += gap
            np.minimum(t, self.farthest_m, out=t)
            gap = self.gap(rays, t)
        return t, gap

    def closest(self, rays: _Rays, start: Float32) -> tuple[Float32, Float32]:
        """Depth of closest approach to the stack near ``start`` and the signed distance there (parabola steps)."""
        h, t = np.float32(0.03), np.where(start < self.farthest_m, start, 1.0).astype(np.float32)
        for _ in range(4):
            before, here, after = self.gap(rays, t - h), self.gap(rays, t), self.gap(rays, t + h)
            curve = np.maximum(before - 2.0 * here + after, 1e-5)
            t += np.clip(0.5 * h * (before - after) / curve, -0.1, 0.1)
        return t, self.gap(rays, t)

    def shade(self, rays: _Rays, t: Float32, sun_shell: FloatArray) -> Float32:
        """Radiance ``(n,)`` of surface points at depth ``t``, the Sun's direction in shell axes."""
        ex, ey, ez = rays.eye
        dx, dy, dz = rays.direction
        sx, sy, sz = (np.float32(e) for e in sun_shell)
        x, y, z = ex + t * dx, ey + t * dy, ez + t * dz
        r = np.sqrt(y * y + z * z)
        s, rho = (-x, r) if self.warp is None else self._on_nominal_shape(y, z, -x, r)
        a = (s - self.s0) * self.cos + (rho - self.r0) * self.sin
        b = (s - self.s0) * self.sin - (rho - self.r0) * self.cos
        a -= self.pitch * np.clip(np.rint(a / self.pitch), 0.0, self.last)
        # outward normal in the half-plane, then in space
        n_s = (a * self.cos + b * self.sin) / self.minor
        n_r = (a * self.sin - b * self.cos) / self.minor
        lit = np.maximum(n_r * (y * sy + z * sz) / r - n_s * sx, 0.0)
        crest = np.asarray(np.clip(b / self.minor, 0.0, 1.0), dtype=np.float32)
        value = (0.10 + 0.10 * crest + 0.62 * lit) * (0.55 + 0.45 * np.sqrt(crest))
        if self.painted:
            value *= self._paint(y, z, r, a, crest)
        return np.asarray(value, dtype=np.float32)

    def _paint(self, y: Float32, z: Float32, r: Float32, a: Float32, crest: Float32) -> Float32:
        """Return the albedo: seams of 12 mm, dots of 22 mm at mid-gore crests, gores of slightly unlike cloth."""
        clock = cv2.phase(-y.reshape(1, -1), z.reshape(1, -1)).ravel()
        gore = clock / self.gore_rad
        off_seam = np.abs(gore - np.rint(gore)) * self.gore_rad * r
        off_dot = np.abs(gore - np.floor(gore) - 0.5) * self.gore_rad * r
        seam = 1.0 - 0.55 * np.clip(1.5 - off_seam / 0.006, 0.0, 1.0)
        dot = 1.0 - 0.7 * np.clip(3.0 - np.hypot(off_dot, a) / 0.0055, 0.0, 1.0) * (crest > 0.5)
        cloth = 1.0 + 0.05 * np.sin(2.4 * np.floor(gore))
        albedo: Float32 = (seam * dot * cloth).astype(np.float32)
        return albedo


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
    quality : int
        Of JPEG compression, 1 to 100; zero: none.
    painted : bool
        Whether the shell carries seams and dots that can be seen.
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
    quality: int = 0
    painted: bool = True
    built_sd_rad: float = 0.0
    loaded_sd_rad: float = 0.0
    loaded: Warp = Warp()


@dataclass(frozen=True)
class Scene:
    """What the camera has before it, frame by frame.

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
    renderer = ShellRenderer(vehicle_geometry, camera, joint_station_m, imaging.vignetting)
    renderer.stack.painted = imaging.painted
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
        return radiance(k, 0.0)

    pictures = _ahead(exposed, len(scene.theta_rad))
    return (record(picture, renderer.vignetting, imaging, rng) for picture in pictures)


def _ahead(make: Callable[[int], Float32], count: int) -> Iterator[Float32]:
    """What is made of 0, 1, ..., in this order, a few ahead in threads: numpy's arithmetic runs beside Python."""
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
    """Images in a folder or one film of a name, and the list of frames with their times, below a folder."""
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
        _write_film(images, telemetry / f"{name}.{spec.format}", spec, (mount.width_px, mount.height_px))
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
        quality=quality.quality,
        painted=quality.painted,
        built_sd_rad=float(np.deg2rad(quality.built_deg)),
        loaded_sd_rad=float(np.deg2rad(quality.loaded_deg)),
        loaded=Warp(*np.deg2rad(quality.loaded_shape_deg).tolist()),
    )


def scene(truth: Truth, at_s: FloatArray, with_earth: bool) -> Scene:
    """What the camera has before it at times ``(n,)``."""
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
        (folder / name).write_bytes(cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())
        yield name


def _write_film(frames: Iterable[Image], path: Path, spec: Video, size_px: tuple[int, int]) -> None:
    code = cv2.VideoWriter.fourcc(*CODECS[path.suffix[1:]])
    writer = cv2.VideoWriter(str(path), code, float(spec.rate_hz), size_px)
    if not writer.isOpened():
        message = f'{path}: this build of OpenCV cannot write such a film; write images: video.format = "png"'
        raise GateError(message, code="film-codec")
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

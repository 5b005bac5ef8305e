"""The film's stack of tori in plain numpy, float32, without shadows: what the compiled one is held to."""

import cv2
import numpy as np

from flightmodel.geometry import torus_circles
from synthetic_flight.film import FARTHEST_M, FARTHEST_RADII


class Rays:
    """Rays from one eye point in shell axes, with the products that `Stack.gap` needs at every depth."""

    def __init__(self, direction, eye_shell_m):
        self.direction = direction
        self.eye = [np.float32(e) for e in eye_shell_m]
        (_, ey, ez), (dx, dy, dz) = self.eye, direction
        self.minus_dx = -dx
        self.across = dy * dy + dz * dz
        self.twice_half_b = 2.0 * (ey * dy + ez * dz)
        self.c = ey * ey + ez * ez

    def some(self, index):
        """Return a subset of the rays."""
        return Rays(self.direction[:, index], np.array(self.eye))


class Stack:
    """The tori as one distance function in the half-plane of station and radius, float32."""

    def __init__(self, geometry):
        station, radius = torus_circles(geometry)
        half = np.deg2rad(geometry.half_angle_deg)
        self.s0, self.r0 = np.float32(station[0]), np.float32(radius[0])
        self.cos, self.sin = np.float32(np.cos(half)), np.float32(np.sin(half))
        self.pitch, self.minor = np.float32(geometry.torus_spacing_m), np.float32(geometry.torus_minor_radius_m)
        self.last = np.float32(geometry.torus_count - 1)
        self.farthest_m = np.float32(max(FARTHEST_M, FARTHEST_RADII * geometry.base_radius_m))
        self.gore_rad = np.float32(2.0 * np.pi / geometry.gore_count)
        self.warp = None
        self.painted = True

    def gap(self, rays, t):
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

    def _on_nominal_shape(self, y, z, s, r):
        """Station and radius, on the nominal shell, of points of the shell that is out of shape."""
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

    def march(self, rays, start, steps, stretch=1.0):
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

    def closest(self, rays, start):
        """Depth of closest approach to the stack near ``start`` and the signed distance there (parabola steps)."""
        h, t = np.float32(0.03), np.where(start < self.farthest_m, start, 1.0).astype(np.float32)
        for _ in range(4):
            before, here, after = self.gap(rays, t - h), self.gap(rays, t), self.gap(rays, t + h)
            curve = np.maximum(before - 2.0 * here + after, 1e-5)
            t += np.clip(0.5 * h * (before - after) / curve, -0.1, 0.1)
        return t, self.gap(rays, t)

    def shade(self, rays, t, sun_shell):
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

    def _paint(self, y, z, r, a, crest):
        """Return the albedo: seams of 12 mm, dots of 22 mm at mid-gore crests, gores of slightly unlike cloth."""
        clock = cv2.phase(-y.reshape(1, -1), z.reshape(1, -1)).ravel()
        gore = clock / self.gore_rad
        off_seam = np.abs(gore - np.rint(gore)) * self.gore_rad * r
        off_dot = np.abs(gore - np.floor(gore) - 0.5) * self.gore_rad * r
        seam = 1.0 - 0.55 * np.clip(1.5 - off_seam / 0.006, 0.0, 1.0)
        dot = 1.0 - 0.7 * np.clip(3.0 - np.hypot(off_dot, a) / 0.0055, 0.0, 1.0) * (crest > 0.5)
        cloth = 1.0 + 0.05 * np.sin(2.4 * np.floor(gore))
        albedo = (seam * dot * cloth).astype(np.float32)
        return albedo

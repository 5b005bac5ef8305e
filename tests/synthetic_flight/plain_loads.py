"""Air whose tables are exact; the loads and the joint's law derived once more, in plain numbers, for other engines.

Log density, speed of sound and winds are linear in altitude, so no table of them has an interpolation error whatever
its knots. The loads are written from the textbooks (J2 gravitation, geodetic height by iteration, coefficients at the
nose in the plane of the total angle of attack), not from the package.
"""

from dataclasses import dataclass
from math import atan2, cos, exp, hypot, log10, pi, sin, sqrt

import numpy as np

from flightmodel.atmosphere import AirState

A, F, GM, J2, OMEGA = 6378137.0, 1.0 / 298.257223563, 3.986004418e14, 1.082629821313e-3, 7.292115e-5
E2 = F * (2.0 - F)


@dataclass(frozen=True)
class SmoothAir:
    """Exponential density; sound and winds linear in altitude. Stands in for an `AtmosphereProfile`."""

    density_at_zero_kgpm3: float = 1.4
    scale_height_m: float = 7200.0
    sound_mps: tuple = (330.0, -4e-4)
    north_mps: tuple = (-8.0, 5e-4)
    east_mps: tuple = (20.0, -7e-4)

    def at(self, altitude_m, standard=None):
        z = np.asarray(altitude_m, dtype=float)
        density = self.density_at_zero_kgpm3 * np.exp(-z / self.scale_height_m)
        wind = np.stack([self.north_mps[0] + self.north_mps[1] * z, self.east_mps[0] + self.east_mps[1] * z, 0 * z], -1)
        sound = self.sound_mps[0] + self.sound_mps[1] * z
        one = np.ones_like(z)
        return AirState(density, 250.0 * one, one, sound, wind, 0 * one, 0 * one)

    def numbers(self, z):
        """Density, sound, north and east wind at one altitude."""
        return (
            self.density_at_zero_kgpm3 * exp(-z / self.scale_height_m),
            self.sound_mps[0] + self.sound_mps[1] * z,
            self.north_mps[0] + self.north_mps[1] * z,
            self.east_mps[0] + self.east_mps[1] * z,
        )


def gravitation(x, y, z):
    """Gradient of GM/r - GM J2 a^2 (3 z^2/r^5 - 1/r^3)/2."""
    r2 = x * x + y * y + z * z
    r5 = r2 * r2 * sqrt(r2)
    j = 1.5 * J2 * A * A
    lateral = -GM / r2 / sqrt(r2) - GM * j / r5 * (1.0 - 5.0 * z * z / r2)
    axial = -GM / r2 / sqrt(r2) - GM * j / r5 * (3.0 - 5.0 * z * z / r2)
    return lateral * x, lateral * y, axial * z


def latitude_and_height(x, y, z):
    """Geodetic, by fixed-point iteration to rounding (each pass gains a factor 150)."""
    p = hypot(x, y)
    latitude = atan2(z, p * (1.0 - E2))
    for _ in range(8):
        n = A / sqrt(1.0 - E2 * sin(latitude) ** 2)
        latitude = atan2(z + E2 * n * sin(latitude), p)
    n = A / sqrt(1.0 - E2 * sin(latitude) ** 2)
    return latitude, p * cos(latitude) + z * sin(latitude) - A * A / n


def turned(m, a, b, c):
    """Matrix (nine numbers, by rows) times vector."""
    return m[0] * a + m[1] * b + m[2] * c, m[3] * a + m[4] * b + m[5] * c, m[6] * a + m[7] * b + m[8] * c


def turned_back(m, a, b, c):
    return m[0] * a + m[3] * b + m[6] * c, m[1] * a + m[4] * b + m[7] * c, m[2] * a + m[5] * b + m[8] * c


class Aerodynamics:
    """Force at the nose and moment about it from position, velocity, attitude and rate of the shell."""

    def __init__(self, vehicle, air):
        self.air, self.table = air, vehicle.aero.coefficients.tolist()
        self.mach, self.step = vehicle.aero.mach.tolist(), float(vehicle.aero.alpha_rad[1])
        self.area, self.length = vehicle.reference.area_m2, vehicle.reference.length_m
        self.free = None if vehicle.aero.free_molecular is None else vehicle.aero.free_molecular.tolist()

    def thinness(self, rho):
        """sin^2 bridge in log10 Kn from 1e-3 to 10; free path of spheres of 3.65 Angstrom (US76)."""
        free_path = 28.9644e-3 / 6.022169e23 / (sqrt(2.0) * pi * 3.65e-10**2 * rho)
        decade = log10(min(max(free_path / self.length, 1e-3), 10.0))
        return sin(pi * (decade + 3.0) / 8.0) ** 2

    def coefficients(self, mach, alpha, rho):
        """Bilinear; end values outside the Mach numbers; towards free-molecular ones in thin air."""
        mach = min(max(mach, self.mach[0]), self.mach[-1])
        i = max(k for k in range(len(self.mach) - 1) if k == 0 or self.mach[k] <= mach)
        f = (mach - self.mach[i]) / (self.mach[i + 1] - self.mach[i])
        j = min(int(alpha / self.step), len(self.table[0]) - 2)
        h = alpha / self.step - j
        low, high = self.table[i], self.table[i + 1]
        dense = [
            (1 - f) * ((1 - h) * a + h * b) + f * ((1 - h) * c + h * d)
            for a, b, c, d in zip(low[j], low[j + 1], high[j], high[j + 1], strict=True)
        ]
        if self.free is None:
            return dense
        thin = self.thinness(rho)
        free = [(1 - h) * a + h * b for a, b in zip(self.free[j], self.free[j + 1], strict=True)]
        return [(1 - thin) * a + thin * b for a, b in zip(dense, free, strict=True)]

    def wrench(self, r, v, m, w):
        """Force and moment about the nose, ECI; ``r``, ``v`` of the nose, ``m`` ECI from shell, ``w`` shell axes."""
        x, y, z = r
        latitude, height = latitude_and_height(x, y, z)
        rho, sound, north, east = self.air.numbers(height)
        p, sp, cp = hypot(x, y), sin(latitude), cos(latitude)
        cl, sl = x / p, y / p
        # wind in ECI: north = (-sp cl, -sp sl, cp), east = (-sl, cl, 0)
        flow = (
            v[0] + OMEGA * y + north * sp * cl + east * sl,
            v[1] - OMEGA * x + north * sp * sl - east * cl,
            v[2] - north * cp,
        )
        u, lv, lw = turned_back(m, *flow)
        lateral = hypot(lv, lw)
        speed = hypot(u, lateral)
        ca, cn, cm, cmq = self.coefficients(speed / sound, atan2(lateral, u), rho)
        qs = 0.5 * rho * speed * speed * self.area
        ny, nz = lv / lateral, lw / lateral
        pitching, damping = qs * self.length * cm, qs * self.length**2 * cmq / (2.0 * speed)
        force = turned(m, -qs * ca, -qs * cn * ny, -qs * cn * nz)
        moment = turned(m, 0.0, pitching * nz + damping * w[1], -pitching * ny + damping * w[2])
        return force, moment, 0.5 * rho * speed * speed


class JointLaw:
    """Moment of the joint on the body from matrices ECI from body, ECI from shell, and the shell's quaternion on it."""

    def __init__(self, vehicle):
        self.joint = vehicle.joint
        self.freeplay = self.joint.freeplay_deg * 0.017453292519943295
        self.width = self.joint.freeplay_corner * self.freeplay

    def beyond(self, theta):
        """Quadratic over the corner, so that value and slope meet 0 below and theta - freeplay above."""
        if theta > self.freeplay + self.width:
            return theta - self.freeplay
        if theta < self.freeplay - self.width or self.freeplay == 0.0:
            return max(theta - self.freeplay, 0.0)
        return (theta - self.freeplay + self.width) ** 2 / (4.0 * self.width)

    def moment(self, body, shell, q_body_shell, rate):
        """ECI; ``rate`` is the body's against the shell's, ECI."""
        law = self.joint
        b, a = (body[0], body[3], body[6]), (shell[0], shell[3], shell[6])
        n = (b[1] * a[2] - b[2] * a[1], b[2] * a[0] - b[0] * a[2], b[0] * a[1] - b[1] * a[0])
        sine = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        cosine = b[0] * a[0] + b[1] * a[1] + b[2] * a[2]
        theta = atan2(sine, cosine)
        d = self.beyond(theta)
        bend = (law.bending_stiffness_nmprad * d + law.hardening_nmprad3 * d**3) / sine if sine > 0.0 else 0.0
        # half-way axis e; twisting about it by t works K t dt, and the twist's gradient along e is 1/cos(theta/2)
        half = 1.0 / sqrt(2.0 + 2.0 * cosine)
        e = [(p + q) * half for p, q in zip(b, a, strict=True)]
        twist = -2.0 * atan2(q_body_shell[1], q_body_shell[0])
        along = rate[0] * e[0] + rate[1] * e[1] + rate[2] * e[2]
        damping = law.bending_damping_nmsprad + law.damping_hardening_nmsprad3 * theta * theta
        axial = -law.torsion_stiffness_nmprad * twist / cos(0.5 * theta)
        axial += (damping - law.torsion_damping_nmsprad) * along
        return [bend * n[i] + axial * e[i] - damping * rate[i] for i in range(3)]

"""The vehicle R1 of the linear and static check cases: modified Newtonian 60 deg sphere-cone, its c.g.s on the axis."""

from dataclasses import replace

import numpy as np

from flightmodel.aerodynamics import AeroTable
from flightmodel.atmosphere import AirState

NOSE_M, BASE_M, HALF_ANGLE = 0.38, 1.5, np.deg2rad(60.0)
SIN, COS = np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)
K = NOSE_M * COS / BASE_M
CAP = (NOSE_M / BASE_M) ** 2
METACENTRE_M = NOSE_M * (1.0 - 1.0 / SIN) + (2.0 / 3.0) * BASE_M * (1.0 - K**3) / (1.0 - K**2) / (SIN * COS)


def pressure_coefficient(mach, g=1.4):
    """Stagnation pressure coefficient behind a normal shock (Rayleigh's pitot formula)."""
    m2 = mach * mach
    pitot = ((g + 1) ** 2 * m2 / (4 * g * m2 - 2 * (g - 1))) ** (g / (g - 1)) * (1 - g + 2 * g * m2) / (g + 1)
    return 2.0 / (g * m2) * (pitot - 1.0)


def newtonian(alpha, mach):
    """C_A, C_N, C_m about the nose over 3 m, to 60 deg."""
    s, c, top = np.sin(alpha), np.cos(alpha), pressure_coefficient(mach)
    cone, cap = (1 - K * K) * COS * COS, 0.5 * CAP * COS**4
    axial = (1 - K * K) * (c * c * SIN**2 + 0.5 * s * s * COS**2)
    axial = axial + CAP * (0.5 * c * c * (1 - SIN**4) + 0.25 * s * s * COS**4)
    moment = -(cone * METACENTRE_M + cap * NOSE_M) / (2.0 * BASE_M)
    return top * axial, top * s * c * (cone + cap), top * s * c * moment


def table(ca, cn, cm, cmq, knots=7201):
    """Coefficient table from functions of the angle, the same at all Mach numbers."""
    alpha = np.linspace(0.0, np.pi, knots)
    one = np.ones(knots)
    row = np.column_stack([ca(alpha) * one, cn(alpha), cm(alpha), cmq * one])
    return AeroTable(np.array([0.0, 100.0]), alpha, np.stack([row, row]))


def linear_table(slopes):
    """C_N and C_m proportional to the angle."""
    return table(lambda a: slopes.ca, lambda a: slopes.cn_alpha * a, lambda a: slopes.cm_alpha * a, slopes.cmq)


def r1(vehicle, stiffness, damping_ratio=0.0, aero=None, offset_m=0.0):
    """R1 (m 155 kg, I_A 33.7, I_B 36.8 kg m^2 about the joint): the reference vehicle with its c.g.s on the axis.

    ``offset_m`` moves the vehicle's c.g. to +z, all of it in the centerbody.
    """
    share = vehicle.mass_kg / vehicle.centerbody.mass_kg
    cg = (vehicle.centerbody.cg_m[0], 0.0, offset_m * share)
    ia, ib = vehicle.transverse_inertia_about_joint()
    damping = damping_ratio * 2.0 * np.sqrt(stiffness * ia * ib / (ia + ib))
    joint = vehicle.joint.model_copy(update={"bending_stiffness_nmprad": stiffness, "bending_damping_nmsprad": damping})
    body = vehicle.centerbody.model_copy(update={"cg_from_datum_body_m": cg})
    return replace(vehicle, joint=joint, centerbody=body, aero=vehicle.aero if aero is None else aero)


class FrozenAir:
    """One density and one speed of sound everywhere, no wind. Stands in for an `AtmosphereProfile`."""

    def __init__(self, density_kgpm3, sound_mps=325.0):
        self.density, self.sound = density_kgpm3, sound_mps

    def at(self, altitude_m):
        z = np.asarray(altitude_m, dtype=float)
        one = np.ones_like(z)
        wind = np.zeros((*z.shape, 3))
        return AirState(self.density * one, 250.0 * one, one, self.sound * one, wind, 0 * one, 0 * one)

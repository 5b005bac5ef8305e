"""Aerodynamic coefficients of a sphere-cone in modified Newtonian flow at any total angle of attack.

``Cp = Cp_max (n . v)^2`` on the windward side, zero in shadow. Up to the cone's half-angle nothing is in shadow and
the coefficients are closed forms (see `sphere_cone_closed_form`); beyond it, and up to flow from behind on the flat
base, they come from quadrature. Moments act about the nose, nose-up positive.

References
----------
Truitt, "Hypersonic Aerodynamics", 1959; Clark and Trimmer, AEDC-TDR-64-25, 1964.

What the air does where molecules seldom meet: free-molecular coefficients, and the bridge to continuum flow.

``C = C_continuum + (C_free - C_continuum) sin^2(pi (3 + log10 Kn) / 8)`` for ``1e-3 < Kn < 10``. Free-molecular forces
are those of the hypersonic limit (molecular speed ratio much above one, so nothing reaches the lee side) with diffuse
re-emission and full accommodation at the wall's temperature: a panel with outward normal n and velocity u through the
gas takes the incoming momentum and the recoil of what leaves,

    force per area = -rho max(u . n, 0) (u + sqrt(pi)/2 c_w n),   c_w = sqrt(2 R T_w).

The limit errs by ``exp(-S^2)`` windward; at 1500 m/s and 200 K the speed ratio S is 4.4.

References
----------
Bird, "Molecular Gas Dynamics and the Direct Simulation of Gas Flows", 1994, sections 4.2 and 7.4 (sphere, plate).
Wilmoth, Mitcheltree, Moss, "Low-density aerodynamics of the Stardust sample return capsule", AIAA 97-2510 (bridge).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray

GAMMA = 1.4


def stagnation_cp(mach: FloatArray | float) -> FloatArray:
    """Stagnation pressure coefficient: Rayleigh's pitot formula above Mach 1, isentropic below."""
    m = np.maximum(np.asarray(mach, dtype=float), 1e-3)
    g = GAMMA
    sup = np.maximum(m, 1.0) ** 2
    pitot = ((g + 1) ** 2 * sup / (4 * g * sup - 2 * (g - 1))) ** (g / (g - 1)) * (1 - g + 2 * g * sup) / (g + 1)
    isentropic = (1 + 0.5 * (g - 1) * m**2) ** (g / (g - 1))
    return 2.0 / (g * m**2) * (np.where(m > 1.0, pitot, isentropic) - 1.0)


def sphere_cone_closed_form(
    alpha_rad: FloatArray, half_angle_rad: float, nose_radius_m: float, base_radius_m: float, length_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """C_A, C_N and C_m about the nose for ``Cp_max = 1`` and 0 <= alpha <= half-angle, base area as reference.

    The pressure on the cone acts through its metacentre ``x_m``, far aft of the body; on the cap, through the
    sphere's centre.
    """
    s, c = np.sin(half_angle_rad), np.cos(half_angle_rad)
    rn, rb = nose_radius_m, base_radius_m
    k = rn * c / rb
    sa, ca = np.sin(alpha_rad), np.cos(alpha_rad)
    axial = (1 - k**2) * (ca**2 * s**2 + 0.5 * sa**2 * c**2)
    axial = axial + (rn / rb) ** 2 * (0.5 * ca**2 * (1 - s**4) + 0.25 * sa**2 * c**4)
    normal_cone = (1 - k**2) * c**2 * sa * ca
    normal_cap = 0.5 * (rn / rb) ** 2 * c**4 * sa * ca
    mean_radius = 2.0 / 3.0 * rb * (1 - k**3) / (1 - k**2)
    x_m = rn * (1 - 1 / s) + mean_radius / (s * c)
    return axial, normal_cone + normal_cap, -(normal_cone * x_m + normal_cap * rn) / length_m


@dataclass(frozen=True)
class Panels:
    """Rings of a body of revolution times azimuths, every field ``(rings, azimuths)``; body axes x forward, z down.

    Half the body stands for the whole: ``area_m2`` counts each panel and its mirror image in the plane of symmetry.
    """

    normal_x: FloatArray
    normal_z: FloatArray
    aft_m: FloatArray
    lateral_z_m: FloatArray
    area_m2: FloatArray

    def coefficients(self, force_x: FloatArray, force_z: FloatArray, area: float, length: float) -> FloatArray:
        """C_A, C_N and C_m about the nose, (3,), of forces on the panels over dynamic pressure, m^2."""
        moment = (self.lateral_z_m * force_x + self.aft_m * force_z).sum()
        return np.array([-force_x.sum() / area, -force_z.sum() / area, moment / (area * length)])


def sphere_cone_panels(half_angle_rad: float, nose_radius_m: float, base_radius_m: float, points: int) -> Panels:
    """Gauss-Legendre panels of a spherical cap, a cone and a flat base, ``points`` rings on each and azimuths."""
    s, c = np.sin(half_angle_rad), np.cos(half_angle_rad)
    rn, rb = nose_radius_m, base_radius_m
    node, weight = np.polynomial.legendre.leggauss(points)
    azimuth = np.pi * 0.5 * (node + 1)  # half the body; the other half mirrors it
    w_az = np.pi * 0.5 * weight
    polar = 0.5 * (node + 1) * (0.5 * np.pi - half_angle_rad)  # cap, from the axis to the cone
    cap_area = rn**2 * np.sin(polar) * 0.5 * (0.5 * np.pi - half_angle_rad) * weight
    cap = (np.cos(polar), np.sin(polar), rn * (1 - np.cos(polar)), rn * np.sin(polar), cap_area)
    r = rn * c + 0.5 * (node + 1) * (rb - rn * c)
    cone_area = r / s * 0.5 * (rb - rn * c) * weight
    cone = (np.full(points, s), np.full(points, c), rn * (1 - s) + (r - rn * c) / np.tan(half_angle_rad), r, cone_area)
    base_r = 0.5 * (node + 1) * rb
    x_base = rn * (1 - s) + (rb - rn * c) / np.tan(half_angle_rad)
    base = (np.full(points, -1.0), np.zeros(points), np.full(points, x_base), base_r, base_r * 0.5 * rb * weight)
    n_x, n_r, aft, radius, area = (np.concatenate(parts)[:, None] for parts in zip(cap, cone, base, strict=True))
    around = np.ones_like(azimuth)
    return Panels(
        n_x * around, n_r * np.cos(azimuth), aft * around, radius * np.cos(azimuth), 2.0 * area * w_az[None, :]
    )


def sphere_cone_quadrature(
    alpha_rad: float,
    half_angle_rad: float,
    nose_radius_m: float,
    base_radius_m: float,
    length_m: float,
    points: int = 400,
) -> tuple[float, float, float]:
    """C_A, C_N and C_m about the nose for ``Cp_max = 1`` at any angle, with shadow and a flat base."""
    panels = sphere_cone_panels(half_angle_rad, nose_radius_m, base_radius_m, points)
    # the flow comes from (cos a, 0, sin a)
    incidence = panels.normal_x * np.cos(alpha_rad) + panels.normal_z * np.sin(alpha_rad)
    push = np.maximum(incidence, 0.0) ** 2 * panels.area_m2
    force = -push * panels.normal_x, -push * panels.normal_z
    ca, cn, cm = panels.coefficients(*force, np.pi * base_radius_m**2, length_m)
    return float(ca), float(cn), float(cm)


R_AIR_JPKGK = 8314.32 / 28.9644
KN_CONTINUUM, KN_FREE = 1e-3, 10.0


def bridge(knudsen_number: FloatArray | float) -> FloatArray:
    """Share of the free-molecular coefficients, 0 to 1 ``(...)``: sin^2 in log10 Kn between 1e-3 and 10."""
    kn = np.asarray(knudsen_number, dtype=float)
    share = np.where(kn >= KN_FREE, 1.0, 0.0)
    between = (kn > KN_CONTINUUM) & (kn < KN_FREE)
    share[between] = np.sin(0.5 * np.pi * (np.log10(kn[between]) + 3.0) / 4.0) ** 2
    return share[()]


def wall_speed_ratio(wall_temperature_k: float, speed_mps: float) -> float:
    """Ratio of the thermal speed of molecules re-emitted by the wall to the flight speed, ``sqrt(2 R T_w) / V``."""
    return float(np.sqrt(2.0 * R_AIR_JPKGK * wall_temperature_k) / speed_mps)


def sphere_cone_free_molecular(
    alpha_rad: FloatArray,
    half_angle_rad: float,
    nose_radius_m: float,
    base_radius_m: float,
    length_m: float,
    wall_ratio: float,
    points: int = 48,
) -> FloatArray:
    """Free-molecular C_A, C_N, C_m about the nose and C_mq ``(a, 4)`` of a sphere-cone with a flat base.

    Parameters
    ----------
    alpha_rad : (a,) float
        Total angles of attack, 0 to pi.
    half_angle_rad, nose_radius_m, base_radius_m : float
        Shape; the base area is the reference area.
    length_m : float
        Reference length.
    wall_ratio : float
        `wall_speed_ratio`; 0 for a cold wall (C_A = 2 at zero angle), 0.06 at orbital, 0.28 at sounding-rocket speed.
    points : int
        Rings on cap, cone and base each, and azimuths.

    Notes
    -----
    C_mq is the derivative of C_m by ``omega l / (2 V)`` for turning about the nose, the point whose velocity defines
    the angle of attack.
    """
    panels = sphere_cone_panels(half_angle_rad, nose_radius_m, base_radius_m, points)
    area = np.pi * base_radius_m**2

    def at(alpha: float, half_rate: float) -> FloatArray:
        # turning nose-up at omega = 2 V half_rate / l about the nose: a point (-aft, z) moves by
        # omega (z, aft) in (x forward, z down)
        turn = 2.0 * half_rate / length_m
        u_x = np.cos(alpha) + turn * panels.lateral_z_m
        u_z = np.sin(alpha) + turn * panels.aft_m
        flux = 2.0 * np.maximum(u_x * panels.normal_x + u_z * panels.normal_z, 0.0) * panels.area_m2
        recoil = 0.5 * np.sqrt(np.pi) * wall_ratio
        force = -flux * (u_x + recoil * panels.normal_x), -flux * (u_z + recoil * panels.normal_z)
        return panels.coefficients(*force, area, length_m)

    step = 1e-4
    rows = []
    for alpha in np.asarray(alpha_rad, dtype=float):
        damping = (at(alpha, step)[2] - at(alpha, -step)[2]) / (2.0 * step)
        rows.append(np.append(at(alpha, 0.0), damping))
    return np.array(rows)

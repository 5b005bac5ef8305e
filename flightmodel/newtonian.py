"""What modified Newtonian flow does to a sphere-cone at any total angle of attack.

``Cp = Cp_max (n . v)^2`` on the windward side, zero in shadow. Up to the cone's half-angle nothing is in shadow and
the coefficients are closed forms (see `sphere_cone_closed_form`); beyond it, and up to flow from behind on the flat
base, they come from quadrature. Moments act about the nose, nose-up positive.

References
----------
Truitt, "Hypersonic Aerodynamics", 1959; Clark and Trimmer, AEDC-TDR-64-25, 1964.
"""

from __future__ import annotations

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


def sphere_cone_quadrature(
    alpha_rad: float,
    half_angle_rad: float,
    nose_radius_m: float,
    base_radius_m: float,
    length_m: float,
    points: int = 400,
) -> tuple[float, float, float]:
    """C_A, C_N and C_m about the nose for ``Cp_max = 1`` at any angle, with shadow and a flat base."""
    s, c = np.sin(half_angle_rad), np.cos(half_angle_rad)
    rn, rb = nose_radius_m, base_radius_m
    node, weight = np.polynomial.legendre.leggauss(points)
    azimuth = np.pi * 0.5 * (node + 1)  # half the body; the other half mirrors it
    w_az = np.pi * 0.5 * weight
    polar = 0.5 * (node + 1) * (0.5 * np.pi - half_angle_rad)  # cap, from the axis to the cone
    cap_n = np.cos(polar), np.sin(polar)
    cap_area = rn**2 * np.sin(polar) * 0.5 * (0.5 * np.pi - half_angle_rad) * weight
    cap = (cap_n[0], cap_n[1], rn * (1 - np.cos(polar)), rn * np.sin(polar), cap_area)
    r = rn * c + 0.5 * (node + 1) * (rb - rn * c)
    cone_area = r / s * 0.5 * (rb - rn * c) * weight
    cone = (np.full(points, s), np.full(points, c), rn * (1 - s) + (r - rn * c) / np.tan(half_angle_rad), r, cone_area)
    base_r = 0.5 * (node + 1) * rb
    x_base = rn * (1 - s) + (rb - rn * c) / np.tan(half_angle_rad)
    base = (np.full(points, -1.0), np.zeros(points), np.full(points, x_base), base_r, base_r * 0.5 * rb * weight)
    total = np.zeros(3)
    # body axes here: x forward, z down; the flow comes from (cos a, 0, sin a)
    for n_x, n_r, aft, radius, area in (cap, cone, base):
        n_z = n_r[:, None] * np.cos(azimuth)
        cos_incidence = np.maximum(n_x[:, None] * np.cos(alpha_rad) + n_z * np.sin(alpha_rad), 0.0)
        push = cos_incidence**2 * area[:, None] * w_az * 2.0
        force_x, force_z = -push * n_x[:, None], -push * n_z
        arm_x, arm_z = -aft[:, None], radius[:, None] * np.cos(azimuth)
        total += -force_x.sum(), -force_z.sum(), (arm_z * force_x - arm_x * force_z).sum()
    area_ref = np.pi * rb**2
    return float(total[0] / area_ref), float(total[1] / area_ref), float(total[2] / (area_ref * length_m))

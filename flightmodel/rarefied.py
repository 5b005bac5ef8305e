"""What the air does where molecules seldom meet: free-molecular coefficients, and the bridge to continuum flow.

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
US Standard Atmosphere 1976, section 1.2.12 (mean free path, collision diameter 3.65e-10 m).
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.newtonian import sphere_cone_panels

COLLISION_DIAMETER_M = 3.65e-10
MOLECULE_KG = 28.9644e-3 / 6.022169e23
R_AIR_JPKGK = 8314.32 / 28.9644
KN_CONTINUUM, KN_FREE = 1e-3, 10.0


def mean_free_path(density_kgpm3: FloatArray | float) -> FloatArray:
    """Mean free path, m, of sea-level air molecules as hard spheres: ``m / (sqrt(2) pi d^2 rho)`` (US76 eq. [44])."""
    return MOLECULE_KG / (np.sqrt(2.0) * np.pi * COLLISION_DIAMETER_M**2 * np.asarray(density_kgpm3, dtype=float))


def knudsen(density_kgpm3: FloatArray | float, length_m: float) -> FloatArray:
    """Knudsen number ``(...)`` of densities, kg/m^3, against the reference length, m."""
    return mean_free_path(density_kgpm3) / length_m


def bridge(knudsen_number: FloatArray | float) -> FloatArray:
    """Share of the free-molecular coefficients, 0 to 1 ``(...)``: sin^2 in log10 Kn between 1e-3 and 10."""
    kn = np.asarray(knudsen_number, dtype=float)
    share = np.where(kn >= KN_FREE, 1.0, 0.0)
    between = (kn > KN_CONTINUUM) & (kn < KN_FREE)
    share[between] = np.sin(0.5 * np.pi * (np.log10(kn[between]) + 3.0) / 4.0) ** 2
    return share[()]


def wall_speed_ratio(wall_temperature_k: float, speed_mps: float) -> float:
    """Thermal speed of what the wall sends back over the flight speed, ``sqrt(2 R T_w) / V``."""
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

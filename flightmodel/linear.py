"""When is a vehicle on a compliant joint stable? The planar linear model, at constant speed and dynamic pressure.

``y`` is the lateral displacement of the joint, ``theta_A`` and ``theta_B`` the angles of the axes of shell and body;
positive angles move the aft end to ``+y``. Flow angles are taken at the shell's nose (docs/decisions/0005)::

    theta_e = theta_A + (y' - x_J theta_A') / V
    m y''       + m_A r_A theta_A'' + m_B r_B theta_B'' = q S (C_A theta_A - C_Na theta_e)
    m_A r_A y'' + I_A theta_A'' = m_A a_x r_A theta_A + q S (C_ma l + C_Na x_J) theta_e + q S l^2 C_mq theta_A' / 2V
                                  + K (theta_B - theta_A) + C (theta_B' - theta_A')
    m_B r_B y'' + I_B theta_B'' = m_B a_x r_B theta_B - K (theta_B - theta_A) - C (theta_B' - theta_A')

with ``a_x = q S C_A / m`` and inertias about the joint. Where the joint creeps its spring feels ``theta_B - theta_A -
b``, and ``tau b' = k K (theta_B - theta_A - b) - b`` with the delayed compliance ``k`` and the time constant ``tau``;
loads that stay feel the stiffness ``K / (1 + k K)``. Assumed: both bodies axisymmetric with c.g.s on the axis,
constant density, small angles, springs at their stiffness at rest, no freeplay.

References
----------
Axdahl, AIAA 2009-2963 (the three zones); Bose et al., AIAA 2011-2571, section III.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle

STABLE, UNSTABLE, DIVERGENT = 0, 1, 2


@dataclass(frozen=True)
class Slopes:
    """Coefficients at small angles about the nose: C_A, C_N per rad, C_m per rad (negative if stable), C_mq."""

    ca: float
    cn_alpha: float
    cm_alpha: float
    cmq: float = 0.0


def slopes_at(vehicle: Vehicle, mach: FloatArray) -> list[Slopes]:
    """Slopes at Mach numbers ``(n,)`` of a vehicle's coefficient table at angle zero, between its first two angles."""
    step = float(vehicle.aero.alpha_rad[1])
    zero, first = vehicle.aero.at(mach, 0.0), vehicle.aero.at(mach, step)
    columns = np.column_stack([zero[:, 0], first[:, 1] / step, first[:, 2] / step, zero[:, 3]])
    return [Slopes(*row) for row in columns.tolist()]


def linear_matrix(vehicle: Vehicle, slopes: Slopes, pressure_pa: float, speed_mps: float) -> FloatArray:
    """Matrix (5, 5) of ``x' = A x``, ``x = (y', theta_A, theta_B, theta_A', theta_B')``: m/s, rad, rad/s.

    Of a joint that creeps (6, 6), the creep, rad, last.

    Parameters
    ----------
    vehicle : Vehicle
        Masses, stations, mean transverse inertias, reference area and length, linear stiffness and damping.
    slopes : Slopes
    pressure_pa, speed_mps : float
        Dynamic pressure and speed relative to the air.
    """
    shell, body, joint = vehicle.aeroshell, vehicle.centerbody, vehicle.joint
    load, length = pressure_pa * vehicle.reference.area_m2, vehicle.reference.length_m
    # first moments: c.g.s aft of the joint
    first_a = shell.mass_kg * float(vehicle.joint_m[0] - shell.cg_m[0])
    first_b = body.mass_kg * float(vehicle.joint_m[0] - body.cg_m[0])
    inertia_a, inertia_b = vehicle.transverse_inertia_about_joint()
    creeps = joint.creep_share > 0.0
    drift, angle_a, angle_b, rate_a, rate_b, *more = np.eye(6 if creeps else 5)
    creep = more[0] if creeps else 0.0 * drift
    flow = angle_a + (drift - joint.station_m * rate_a) / speed_mps
    elastic = joint.bending_stiffness_nmprad * (angle_b - angle_a - creep)
    spring = elastic + joint.bending_damping_nmsprad * (rate_b - rate_a)
    deceleration = load * slopes.ca / vehicle.mass_kg
    # increments by deflection: as that much more incidence
    bent, terms = angle_a - angle_b, vehicle.aero_terms
    normal = slopes.cn_alpha * flow + terms.cn_deflection * bent
    moment = load * ((slopes.cm_alpha * flow + terms.cm_deflection * bent) * length + normal * joint.station_m)
    moment = moment + load * length**2 * slopes.cmq / (2.0 * speed_mps) * rate_a
    mass = np.array(
        [[vehicle.mass_kg, first_a, first_b], [first_a, inertia_a, 0.0], [first_b, 0.0, inertia_b]],
    )
    right = np.stack(
        [
            load * (slopes.ca * angle_a - normal),
            first_a * deceleration * angle_a + moment + spring,
            first_b * deceleration * angle_b - spring,
        ]
    )
    turning = np.linalg.solve(mass, right)
    settling = [(joint.delayed_compliance_radpnm * elastic - creep) / joint.creep_time_s] * creeps
    return np.stack([turning[0], rate_a, rate_b, turning[1], turning[2], *settling])


@dataclass(frozen=True)
class Modes:
    """Eigenvalues of `linear_matrix` and the zone of stability they give.

    Parameters
    ----------
    eigenvalues_radps : (5,) complex, or (6,) of a joint that creeps
        By falling real part.
    growth_rate_radps : float
        Largest real part, 1/s.
    frequencies_hz : (k,) float
        Of the oscillating modes, rising.
    zone : int
        ``STABLE``, ``UNSTABLE`` (an oscillation grows) or ``DIVERGENT`` (the fastest growth does not oscillate).
    """

    eigenvalues_radps: NDArray[np.complex128]
    growth_rate_radps: float
    frequencies_hz: FloatArray
    zone: int


def modes(matrix: FloatArray) -> Modes:
    """Modes and zone of stability of a matrix of `linear_matrix`."""
    values = np.linalg.eigvals(matrix).astype(np.complex128)
    values = values[np.argsort(-values.real)]
    fastest = values[0]
    zone = STABLE if fastest.real <= 0.0 else UNSTABLE if fastest.imag != 0.0 else DIVERGENT
    frequencies = np.sort(values.imag[values.imag > 0.0]) / (2.0 * np.pi)
    return Modes(values, float(fastest.real), frequencies, zone)


def levers(vehicle: Vehicle, slopes: Slopes) -> tuple[float, float]:
    """Return ``xbar = m_B r_B / m`` and the static margin ``x_m - x_cg``, m (x_m the metacentre)."""
    body = vehicle.centerbody
    xbar = body.mass_kg * float(vehicle.joint_m[0] - body.cg_m[0]) / vehicle.mass_kg
    metacentre = -slopes.cm_alpha * vehicle.reference.length_m / slopes.cn_alpha
    return xbar, metacentre + float(vehicle.cg_m[0])


def critical_stiffness_nmprad(vehicle: Vehicle, slopes: Slopes, pressure_pa: float) -> float:
    """Bending stiffness, N m/rad, below which the vehicle diverges: ``q S C_A xbar (1 + xbar / L)``.

    Of a joint that creeps it is that against loads that stay. Increments of coefficients by deflection are not in it.
    """
    xbar, margin = levers(vehicle, slopes)
    return pressure_pa * vehicle.reference.area_m2 * slopes.ca * xbar * (1.0 + xbar / margin)


def static_trim(vehicle: Vehicle, slopes: Slopes, pressure_pa: float, offset_m: float) -> tuple[float, float]:
    """Angle of attack of the shell and deflection, rad, at which a lateral c.g. offset in the centerbody trims.

    ``offset_m`` is that of the vehicle's c.g. Diverges as the stiffness nears the critical one; with creep, after it.
    """
    xbar, margin = levers(vehicle, slopes)
    softness = critical_stiffness_nmprad(vehicle, slopes, pressure_pa) / vehicle.joint.held_stiffness_nmprad
    alpha = slopes.ca * offset_m / (slopes.cn_alpha * margin) / (1.0 - softness)
    return alpha, offset_m / xbar * softness / (1.0 - softness)

"""How do two rigid bodies on a compliant spherical joint move? The equations of the flight kernel, readable.

Each body obeys ``m a = F +/- Fc`` and ``I w' = T - w x I w +/- (p x Fc + tau)``; the joint's point has one
acceleration: ``a_B + w_B' x p_B + w_B x (w_B x p_B) = a_A + ...``. Here the accelerations of both bodies and the
constraint force are the 15 unknowns of one linear system; the compiled kernel (`synthetic_flight.dynamics`) eliminates
down to a 3x3 system (constraint force equation, seed paper section III). Both must give the same derivative.

B is the centerbody (*body*), A the aeroshell (*shell*).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flightmodel import earth, rotations
from flightmodel.atmosphere import AtmosphereProfile, gas_constant, mean_free_path
from flightmodel.checks import FloatArray
from flightmodel.deflection import lv_direction
from flightmodel.vehicle import Vehicle
from synthetic_flight.dynamics import angle_beyond_freeplay, points, split, spring_deflection, twist


def creeping_moment(vehicle: Vehicle, state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Moment of a spring in series with a Kelvin element on the body, ECI (3,), and the creep's rate (2,).

    The moment is the steepest descent of the potential of deflection less creep, by turning the body about each axis.
    """
    joint, turn = vehicle.joint, 1e-5

    def potential(angles: FloatArray) -> float:
        moved = state.copy()
        moved[6:10] = rotations.multiply(rotations.exp(angles), state[6:10])
        d = angle_beyond_freeplay(
            np.linalg.norm(spring_deflection(moved)), np.deg2rad(joint.freeplay_deg), joint.freeplay_corner
        )
        straight, hardening = 0.5 * joint.bending_stiffness_nmprad * d**2, 0.25 * joint.hardening_nmprad3 * d**4
        return float(straight + joint.quadratic_nmprad2 * d**3 / 3.0 + hardening)

    slope = [(potential(turn * axis) - potential(-turn * axis)) / (2.0 * turn) for axis in np.eye(3)]
    felt = spring_deflection(state)
    d = angle_beyond_freeplay(np.linalg.norm(felt), np.deg2rad(joint.freeplay_deg), joint.freeplay_corner)
    force = spring_moment(vehicle, d) * felt / np.linalg.norm(felt)
    share = joint.creep_share / (1.0 - joint.creep_share)
    return -np.array(slope), (share * force / joint.bending_stiffness_nmprad - state[20:]) / joint.creep_time_s


def spring_moment(vehicle: Vehicle, d: float) -> float:
    """Moment of the bending spring, N m, at an angle beyond the freeplay, rad."""
    joint = vehicle.joint
    straight = joint.bending_stiffness_nmprad * d
    return float(straight + joint.quadratic_nmprad2 * abs(d) * d + joint.hardening_nmprad3 * d**3)


def joint_moment(vehicle: Vehicle, q_b: FloatArray, q_a: FloatArray, rate_eci: FloatArray) -> FloatArray:
    """Moment of the joint on the body, ECI, (3,): springs as gradients of their potentials, dampers on the rate."""
    joint = vehicle.joint
    x_b, x_a = rotations.rotate(q_b, np.array([1.0, 0, 0])), rotations.rotate(q_a, np.array([1.0, 0, 0]))
    normal = np.cross(x_b, x_a)
    sine, cosine = np.linalg.norm(normal), x_b @ x_a
    theta = np.arctan2(sine, cosine)
    d = angle_beyond_freeplay(theta, np.deg2rad(joint.freeplay_deg), joint.freeplay_corner)
    spring = spring_moment(vehicle, d)
    moment = spring * normal / sine if sine > 0 else np.zeros(3)
    middle = x_b + x_a
    moment = moment - joint.torsion_stiffness_nmprad * twist(q_b, q_a) * middle / (1.0 + cosine)
    along = middle * (rate_eci @ middle) / (middle @ middle)
    damping = joint.bending_damping_nmsprad + joint.damping_hardening_nmsprad3 * theta**2
    return moment - damping * (rate_eci - along) - joint.torsion_damping_nmsprad * along


def aerodynamics(
    state: FloatArray, vehicle: Vehicle, profile: AtmosphereProfile, time_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Force and moment about the nose on the shell, ECI, (3,) each."""
    q_a, w_a = state[10:14], state[17:20]
    r, v = points(state, vehicle)["nose"]
    to_ecef = earth.q_ecef_eci(time_s)
    r_ecef = rotations.rotate(to_ecef, r)
    _, _, height = earth.geodetic_from_ecef(r_ecef)
    air = profile.at(height)
    wind = rotations.rotate(rotations.conjugate(to_ecef), earth.ecef_from_ned(air.wind_ned_mps, r_ecef))
    flow = rotations.rotate(rotations.conjugate(q_a), v - np.cross(earth.OMEGA_ECEF_RADPS, r) - wind)
    speed, lateral = float(np.linalg.norm(flow)), float(np.hypot(flow[1], flow[2]))
    n = np.array([0.0, flow[1], flow[2]]) / lateral if lateral > 0 else np.zeros(3)
    x_hat = np.array([1.0, 0.0, 0.0])
    thin = mean_free_path(air.density_kgpm3, gas_constant(height)) / vehicle.reference.length_m
    ca, cn, cm, cmq = vehicle.aero.at(speed / air.sound_speed_mps, np.arctan2(lateral, flow[0]), thin)
    q_area = 0.5 * air.density_kgpm3 * speed**2 * vehicle.reference.area_m2
    length = vehicle.reference.length_m
    terms = vehicle.aero_terms
    bent = rotations.rotate(rotations.conjugate(q_a), rotations.rotate(state[6:10], x_hat)) * [0.0, 1.0, 1.0]
    # clock angles count as those of the launch vehicle's frame do: from the direction at 0 deg to that at 90 deg
    zero, quarter = lv_direction(0.0), lv_direction(np.pi / 2.0)
    clock = np.arctan2(n @ quarter, n @ zero) - np.deg2rad(terms.roll_clock_lv_deg)
    by_roll = 1.0 + terms.roll_share * np.cos(terms.roll_order * clock)
    force = -q_area * ((ca + terms.ca_deflection * bent @ bent) * x_hat + by_roll * cn * n + terms.cn_deflection * bent)
    per_rate = length / (2.0 * speed)
    coning = terms.cnr_less_cmq * (lateral / speed) ** 2 * (w_a @ n) * n
    damping = per_rate * (cmq * np.array([0.0, w_a[1], w_a[2]]) + coning)
    roll = (terms.cl + terms.clp * per_rate * w_a[0]) * x_hat
    tilting = np.cross(by_roll * cm * n + terms.cm_deflection * bent, x_hat)
    moment = q_area * length * (tilting + damping + roll)
    return rotations.rotate(q_a, force), rotations.rotate(q_a, moment)


@dataclass(frozen=True)
class Loads:
    """What acts on the two bodies besides the joint, ECI axes, (3,) each: forces at, moments about the own c.g."""

    force_body_n: FloatArray
    force_shell_n: FloatArray
    moment_shell_nm: FloatArray
    moment_body_nm: FloatArray = field(default_factory=lambda: np.zeros(3))


def flight_loads(state: FloatArray, vehicle: Vehicle, profile: AtmosphereProfile | None, time_s: float = 0.0) -> Loads:
    """Gravity on both bodies and, where there is air, aerodynamics on the shell."""
    where = points(state, vehicle)
    weight_b = vehicle.centerbody.mass_kg * earth.gravitation(where["body"][0])
    weight_a = vehicle.aeroshell.mass_kg * earth.gravitation(where["shell"][0])
    if profile is None:
        return Loads(weight_b, weight_a, np.zeros(3))
    force, moment = aerodynamics(state, vehicle, profile, time_s)
    nose = rotations.rotate(state[10:14], -vehicle.aeroshell.cg_m)
    return Loads(weight_b, weight_a + force, moment + np.cross(nose, force))


def accelerations(state: FloatArray, vehicle: Vehicle, loads: Loads) -> tuple[FloatArray, ...]:
    """c.g. and angular accelerations of body and shell, and the joint's force on the body; ECI axes, (3,) each.

    Returns
    -------
    acceleration_body, angular_body, acceleration_shell, angular_shell, joint_force
    """
    _, _, q_b, q_a, w_b, w_a = split(state)
    body, shell = vehicle.centerbody, vehicle.aeroshell
    r_b, r_a = rotations.dcm_from_q(q_b), rotations.dcm_from_q(q_a)
    rate_b, rate_a = r_b @ w_b, r_a @ w_a
    p_b, p_a = r_b @ (vehicle.joint_m - body.cg_m), r_a @ (vehicle.joint_m - shell.cg_m)
    tau = joint_moment(vehicle, q_b, q_a, rate_b - rate_a)
    inertia_b, inertia_a = r_b @ body.inertia @ r_b.T, r_a @ shell.inertia @ r_a.T
    eye, zero = np.eye(3), np.zeros((3, 3))
    # unknowns: a_B, w_B', a_A, w_A', Fc (on the body)
    matrix = np.block(
        [
            [body.mass_kg * eye, zero, zero, zero, -eye],
            [zero, inertia_b, zero, zero, -rotations.skew(p_b)],
            [zero, zero, shell.mass_kg * eye, zero, eye],
            [zero, zero, zero, inertia_a, rotations.skew(p_a)],
            [eye, -rotations.skew(p_b), -eye, rotations.skew(p_a), zero],
        ]
    )
    right = np.concatenate(
        [
            loads.force_body_n,
            loads.moment_body_nm + tau - np.cross(rate_b, inertia_b @ rate_b),
            loads.force_shell_n,
            loads.moment_shell_nm - tau - np.cross(rate_a, inertia_a @ rate_a),
            np.cross(rate_a, np.cross(rate_a, p_a)) - np.cross(rate_b, np.cross(rate_b, p_b)),
        ]
    )
    a_b, turn_b, a_a, turn_a, force = np.split(np.linalg.solve(matrix, right), 5)
    return a_b, turn_b, a_a, turn_a, force


def rates(state: FloatArray, vehicle: Vehicle, loads: Loads) -> FloatArray:
    """Derivative of one state (20,) under loads and the joint."""
    _, v, q_b, q_a, w_b, w_a = split(state)
    body, shell = vehicle.centerbody, vehicle.aeroshell
    a_b, turn_b, a_a, turn_a, _ = accelerations(state, vehicle, loads)
    acceleration = (body.mass_kg * a_b + shell.mass_kg * a_a) / vehicle.mass_kg
    spin_b = 0.5 * rotations.multiply(q_b, np.concatenate([[0.0], w_b]))
    spin_a = 0.5 * rotations.multiply(q_a, np.concatenate([[0.0], w_a]))
    turn_b, turn_a = (
        rotations.rotate(rotations.conjugate(q_b), turn_b),
        rotations.rotate(rotations.conjugate(q_a), turn_a),
    )
    return np.concatenate([v, acceleration, spin_b, spin_a, turn_b, turn_a])

"""How two rigid bodies on a compliant spherical joint move: the equations, readable, and their invariants.

Each body obeys ``m a = F +/- Fc`` and ``I w' = T - w x I w +/- (p x Fc + tau)``; the joint's point has one
acceleration: ``a_B + w_B' x p_B + w_B x (w_B x p_B) = a_A + ...``. Here the two bodies' accelerations and the
constraint force are the 15 unknowns of one linear system; the compiled kernel eliminates down to a 3x3 system
(constraint force equation, seed paper section III). Both must give the same derivative.

B is the centerbody (*body*), A the aeroshell (*shell*). State as in `synthetic_flight._kernels`.

Whether a step is short enough for a joint: Runge-Kutta's stability for its bending and its torsion.

A free joint's modes obey ``I'' s^2 + C s + K = 0``; a step h multiplies a mode by ``R(h s)``, with ``R(z) = 1 + z +
z^2/2 + z^3/6 + z^4/24``, and must not amplify it. A joint much stiffer than its flight needs is better locked.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from flightmodel import earth, rotations, sphere_cone
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.checks import ConfigError, FloatArray
from flightmodel.vehicle import Vehicle


def split(state: FloatArray) -> tuple[FloatArray, ...]:
    """Position, velocity (ECI), q_eci_body, q_eci_shell, omega_body, omega_shell of states ``(..., 20)``."""
    return (
        state[..., 0:3],
        state[..., 3:6],
        state[..., 6:10],
        state[..., 10:14],
        state[..., 14:17],
        state[..., 17:20],
    )


def offsets(state: FloatArray, vehicle: Vehicle) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Position and velocity, ECI axes ``(..., 3)``, of c.g.s, joint and nose *relative to the composite c.g.*."""
    _, _, q_b, q_a, w_b, w_a = split(state)
    body, shell = vehicle.centerbody, vehicle.aeroshell
    shape = (*state.shape[:-1], 3)
    rate_b, rate_a = rotations.rotate(q_b, w_b), rotations.rotate(q_a, w_a)
    arm_b = rotations.rotate(q_b, np.broadcast_to(body.cg_m - vehicle.joint_m, shape))
    arm_a = rotations.rotate(q_a, np.broadcast_to(shell.cg_m - vehicle.joint_m, shape))
    nose = rotations.rotate(q_a, np.broadcast_to(-vehicle.joint_m, shape))
    swing_b, swing_a = np.cross(rate_b, arm_b), np.cross(rate_a, arm_a)
    joint = -(body.mass_kg * arm_b + shell.mass_kg * arm_a) / vehicle.mass_kg
    joint_v = -(body.mass_kg * swing_b + shell.mass_kg * swing_a) / vehicle.mass_kg
    return {
        "body": (joint + arm_b, joint_v + swing_b),
        "shell": (joint + arm_a, joint_v + swing_a),
        "joint": (joint, joint_v),
        "nose": (joint + nose, joint_v + np.cross(rate_a, nose)),
    }


def points(state: FloatArray, vehicle: Vehicle) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Position and velocity (ECI, ``(..., 3)``) of the c.g.s of body and shell, the joint and the shell's nose."""
    r, v = state[..., 0:3], state[..., 3:6]
    return {name: (r + dr, v + dv) for name, (dr, dv) in offsets(state, vehicle).items()}


def bending(q_eci_body: FloatArray, q_eci_shell: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bending angle, rad, and the shell's nose direction in body axes ``(..., 3)``."""
    nose = rotations.rotate(
        rotations.multiply(rotations.conjugate(q_eci_body), q_eci_shell),
        np.broadcast_to(np.array([1.0, 0.0, 0.0]), (*q_eci_body.shape[:-1], 3)),
    )
    return np.arctan2(np.hypot(nose[..., 1], nose[..., 2]), nose[..., 0]), nose


def twist(q_eci_body: FloatArray, q_eci_shell: FloatArray) -> FloatArray:
    """Twist of body against shell about x, rad, left after swinging one x axis onto the other."""
    q = rotations.multiply(rotations.conjugate(q_eci_shell), q_eci_body)
    angle = 2.0 * np.arctan2(q[..., 1], q[..., 0])
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def beyond_freeplay(theta_rad: FloatArray, freeplay_rad: float, corner: float) -> FloatArray:
    """Bending angle beyond the dead band; within ``corner * freeplay`` of its edge a parabola joins the two slopes."""
    half = corner * freeplay_rad
    parabola = (theta_rad - freeplay_rad + half) ** 2 / (4.0 * half) if half > 0.0 else np.zeros_like(theta_rad)
    outside = np.where(theta_rad >= freeplay_rad + half, theta_rad - freeplay_rad, parabola)
    return np.where(theta_rad <= freeplay_rad - half, 0.0, outside)


def spring_energy(vehicle: Vehicle, q_eci_body: FloatArray, q_eci_shell: FloatArray) -> FloatArray:
    """Energy in the joint's springs, J: the integral of its moment over the angle, freeplay and hardening included."""
    joint = vehicle.joint
    theta, _ = bending(q_eci_body, q_eci_shell)
    node, weight = np.polynomial.legendre.leggauss(64)
    freeplay = np.deg2rad(joint.freeplay_deg)
    # the moment is smooth on each side of the corner: integrate piecewise
    edges = np.array([0.0, freeplay * (1 - joint.freeplay_corner), freeplay * (1 + joint.freeplay_corner), np.inf])
    energy = np.zeros_like(theta)
    for low, high in pairwise(edges):
        a, b = np.minimum(low, theta), np.minimum(high, theta)
        x = a[..., None] + 0.5 * (b - a)[..., None] * (node + 1.0)
        d = beyond_freeplay(x, freeplay, joint.freeplay_corner)
        moment = joint.bending_stiffness_nmprad * d + joint.hardening_nmprad3 * d**3
        energy = energy + 0.5 * (b - a) * np.sum(weight * moment, axis=-1)
    return energy + 0.5 * joint.torsion_stiffness_nmprad * twist(q_eci_body, q_eci_shell) ** 2


def internal_energy(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Energy of springs and of motion about the composite c.g., J, of states ``(..., 20)``."""
    _, _, q_b, q_a, w_b, w_a = split(state)
    about = offsets(state, vehicle)
    total = spring_energy(vehicle, q_b, q_a)
    for part, name, w in ((vehicle.centerbody, "body", w_b), (vehicle.aeroshell, "shell", w_a)):
        v = about[name][1]
        total = total + 0.5 * part.mass_kg * np.sum(v * v, axis=-1)
        total = total + 0.5 * np.einsum("...i,ij,...j->...", w, part.inertia, w)
    return total


def energy(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Kinetic, gravitational and spring energy, J, of states ``(..., 20)``."""
    v = state[..., 3:6]
    where = points(state, vehicle)
    total = internal_energy(state, vehicle) + 0.5 * vehicle.mass_kg * np.sum(v * v, axis=-1)
    for part, name in ((vehicle.centerbody, "body"), (vehicle.aeroshell, "shell")):
        total = total - part.mass_kg * earth.potential(where[name][0])
    return total


def angular_momentum(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Angular momentum of both bodies about the composite c.g., ECI axes, ``(..., 3)``, kg m^2/s."""
    _, _, q_b, q_a, w_b, w_a = split(state)
    about = offsets(state, vehicle)
    total = np.zeros((*state.shape[:-1], 3))
    for part, name, q, w in ((vehicle.centerbody, "body", q_b, w_b), (vehicle.aeroshell, "shell", q_a, w_a)):
        r, v = about[name]
        total = total + part.mass_kg * np.cross(r, v)
        total = total + rotations.rotate(q, np.einsum("ij,...j->...i", part.inertia, w))
    return total


def joint_moment(vehicle: Vehicle, q_b: FloatArray, q_a: FloatArray, rate_eci: FloatArray) -> FloatArray:
    """Moment of the joint on the body, ECI, (3,): springs as gradients of their potentials, dampers on the rate."""
    joint = vehicle.joint
    x_b, x_a = rotations.rotate(q_b, np.array([1.0, 0, 0])), rotations.rotate(q_a, np.array([1.0, 0, 0]))
    normal = np.cross(x_b, x_a)
    sine, cosine = np.linalg.norm(normal), x_b @ x_a
    theta = np.arctan2(sine, cosine)
    d = beyond_freeplay(theta, np.deg2rad(joint.freeplay_deg), joint.freeplay_corner)
    bend = joint.bending_stiffness_nmprad * d + joint.hardening_nmprad3 * d**3
    moment = bend * normal / sine if sine > 0 else np.zeros(3)
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
    thin = sphere_cone.knudsen(air.density_kgpm3, vehicle.reference.length_m)
    ca, cn, cm, cmq = vehicle.aero.at(speed / air.sound_speed_mps, np.arctan2(lateral, flow[0]), thin)
    q_area = 0.5 * air.density_kgpm3 * speed**2 * vehicle.reference.area_m2
    length = vehicle.reference.length_m
    force = -q_area * (ca * x_hat + cn * n)
    transverse = np.array([0.0, w_a[1], w_a[2]])
    moment = q_area * length * (cm * np.cross(n, x_hat) + cmq * length / (2.0 * speed) * transverse)
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


# steps of a mode times its fastest root's size: below this all damped modes are stable
SURELY_STABLE = 2.0


def joint_modes(vehicle: Vehicle) -> dict[str, tuple[float, float, float]]:
    """Effective inertia kg m^2, damping N m s/rad, stiffness N m/rad of bending and torsion of the free vehicle.

    Bending's inertia is that of the two bodies recoiling about their joint, with c.g.s taken on the axis.
    """
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    inertia = vehicle.transverse_inertia_about_joint()
    unbalance = [part.mass_kg * (part.cg_m[0] - vehicle.joint_m[0]) for part in (shell, body)]
    mass = np.diag(inertia) - np.outer(unbalance, unbalance) / vehicle.mass_kg
    apart = np.array([1.0, -1.0])
    bending = 1.0 / float(apart @ np.linalg.solve(mass, apart))
    torsion = 1.0 / float(1.0 / shell.inertia[0, 0] + 1.0 / body.inertia[0, 0])
    return {
        "bending": (bending, joint.bending_damping_nmsprad, joint.bending_stiffness_nmprad),
        "torsion": (torsion, joint.torsion_damping_nmsprad, joint.torsion_stiffness_nmprad),
    }


def largest_step_s(inertia: float, damping: float, stiffness: float) -> float:
    """Longest stable step of one mode, s; infinite where nothing moves."""
    roots = np.roots([inertia, damping, stiffness]).astype(complex)
    fastest = float(np.abs(roots).max())
    if fastest == 0.0:
        return np.inf
    # stability on the imaginary axis ends at 2.828, on the real axis at 2.785
    steps = np.linspace(SURELY_STABLE, 3.0, 2001) / fastest
    amplified = np.array([np.abs(_growth(roots * step)).max() > 1.0 + 1e-9 for step in steps])
    return float(steps[np.argmax(amplified)]) if amplified.any() else float(steps[-1])


def _growth(z: FloatArray) -> FloatArray:
    return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))


def check_step(vehicle: Vehicle, step_s: float) -> None:
    """Refuse a step that would blow up the joint; `ConfigError` says which mode, and the longest step.

    Springs harden with the bending angle; what is checked is their stiffness at rest.
    """
    for name, (inertia, damping, stiffness) in joint_modes(vehicle).items():
        if step_s * float(np.abs(np.roots([inertia, damping, stiffness])).max(initial=0.0)) < SURELY_STABLE:
            continue
        longest = largest_step_s(inertia, damping, stiffness)
        if step_s > longest:
            frequency = np.sqrt(stiffness / inertia) / (2.0 * np.pi)
            raise ConfigError(
                f"step of {1e3 * step_s:g} ms is too long for the joint's {name} at {frequency:.1f} Hz: at most "
                f"{1e3 * longest:.2g} ms is stable (better half of it); shorten time.step_s, or soften the joint"
            )

"""Which states and invariants does the flexible vehicle have, and how short must its integration steps be?

State ``(..., 20)`` as in `synthetic_flight._kernels`: position and velocity of the composite c.g. (ECI), quaternions
ECI from body and ECI from shell, rates of body and shell in their own axes; B is the centerbody (*body*), A the
aeroshell (*shell*). Energy is ``sum(m v^2 + w I w) / 2 + V(theta) + k_t twist^2 / 2 + gravity``, ``V`` the integral of
the joint's moment over the deflection ``theta``; of a joint that creeps over the deflection less the creep, and the
creep's own spring. The equations of motion are compiled in `synthetic_flight._kernels`.

Steps: a free joint's modes obey ``I'' s^2 + C s + K = 0``; a fourth-order Runge-Kutta step h multiplies a mode by
``R(h s)``, ``R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24``, and must not amplify it. Assumed: springs at their stiffness at
rest. A joint much stiffer than its flight needs is better locked. The twist never bounds the step: where it would, it
is given an inertia of its own.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import ConfigError, FloatArray
from flightmodel.vehicle import Vehicle


def split(state: FloatArray) -> tuple[FloatArray, ...]:
    """Position, velocity (ECI), q_eci_body, q_eci_shell, omega_body, omega_shell of states ``(..., 20 or 22)``."""
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


def deflection_angle(q_eci_body: FloatArray, q_eci_shell: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deflection, rad, and the shell's nose direction in body axes ``(..., 3)``, of quaternions ``(..., 4)``."""
    nose = rotations.rotate(
        rotations.multiply(rotations.conjugate(q_eci_body), q_eci_shell),
        np.broadcast_to(np.array([1.0, 0.0, 0.0]), (*q_eci_body.shape[:-1], 3)),
    )
    return np.arctan2(np.hypot(nose[..., 1], nose[..., 2]), nose[..., 0]), nose


def twist(q_eci_body: FloatArray, q_eci_shell: FloatArray) -> FloatArray:
    """Twist of body against shell about x, rad, beyond the shortest rotation of one x axis onto the other."""
    q = rotations.multiply(rotations.conjugate(q_eci_shell), q_eci_body)
    angle = 2.0 * np.arctan2(q[..., 1], q[..., 0])
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def beyond_freeplay(theta_rad: FloatArray, freeplay_rad: float, corner: float) -> FloatArray:
    """Deflection beyond the dead band; within ``corner * freeplay`` of its edge a parabola joins the two slopes."""
    half = corner * freeplay_rad
    parabola = (theta_rad - freeplay_rad + half) ** 2 / (4.0 * half) if half > 0.0 else np.zeros_like(theta_rad)
    outside = np.where(theta_rad >= freeplay_rad + half, theta_rad - freeplay_rad, parabola)
    return np.where(theta_rad <= freeplay_rad - half, 0.0, outside)


def spring_deflection(state: FloatArray) -> FloatArray:
    """Deflection that the joint's spring feels, rad ``(..., 2)``: of the body's x axis, shell axes y and z, less creep.

    As long as the angle: coordinates of the body's x axis on the sphere about the shell's.
    """
    _, _, q_b, q_a, _, _ = split(state)
    theta, _ = deflection_angle(q_b, q_a)
    x_axis = rotations.rotate(
        rotations.multiply(rotations.conjugate(q_a), q_b),
        np.broadcast_to(np.array([1.0, 0.0, 0.0]), (*theta.shape, 3)),
    )
    lateral = x_axis[..., 1:] * (theta / np.maximum(np.hypot(x_axis[..., 1], x_axis[..., 2]), 1e-300))[..., None]
    return np.asarray(lateral - state[..., 20:22] if state.shape[-1] > 20 else lateral)


def _spring_energy(vehicle: Vehicle, state: FloatArray) -> FloatArray:
    """Energy in the joint's springs, J: the integral of its moment over the angle, freeplay and all orders included."""
    joint = vehicle.joint
    theta = (
        np.linalg.norm(spring_deflection(state), axis=-1)
        if state.shape[-1] > 20
        else deflection_angle(state[..., 6:10], state[..., 10:14])[0]
    )
    node, weight = np.polynomial.legendre.leggauss(64)
    freeplay = np.deg2rad(joint.freeplay_deg)
    # the moment is smooth on each side of the corner: integrate piecewise
    edges = np.array([0.0, freeplay * (1 - joint.freeplay_corner), freeplay * (1 + joint.freeplay_corner), np.inf])
    energy = np.zeros_like(theta)
    for low, high in pairwise(edges):
        a, b = np.minimum(low, theta), np.minimum(high, theta)
        x = a[..., None] + 0.5 * (b - a)[..., None] * (node + 1.0)
        d = beyond_freeplay(x, freeplay, joint.freeplay_corner)
        moment = joint.bending_stiffness_nmprad * d + joint.quadratic_nmprad2 * d**2 + joint.hardening_nmprad3 * d**3
        energy = energy + 0.5 * (b - a) * np.sum(weight * moment, axis=-1)
    if joint.creep_share > 0.0 and state.shape[-1] > 20:
        energy = energy + 0.5 * np.sum(state[..., 20:22] ** 2, axis=-1) / joint.delayed_compliance_radpnm
    return energy + 0.5 * joint.torsion_stiffness_nmprad * twist(state[..., 6:10], state[..., 10:14]) ** 2


def internal_energy(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Energy of springs and of motion about the composite c.g., J, of states ``(..., 20)``."""
    *_, w_b, w_a = split(state)
    about = offsets(state, vehicle)
    total = _spring_energy(vehicle, state)
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


# step times the size of a mode's fastest root: below this all damped modes are stable
SURELY_STABLE = 2.0


def joint_modes(vehicle: Vehicle) -> dict[str, tuple[float, float, float]]:
    """Effective inertia kg m^2, damping N m s/rad, stiffness N m/rad of bending and torsion of the free vehicle.

    The inertia of bending is that of the two bodies recoiling about their joint, with c.g.s taken on the axis.
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


def added_twist_inertia(inertia: FloatArray, damping: FloatArray, stiffness: FloatArray, step_s: float) -> FloatArray:
    """Least inertia, kg m^2, that brings a twist's roots within 2 / step; zero where they are.

    The roots of ``I s^2 + C s + K`` lie within a circle of radius s where ``I s^2 >= K`` and ``I s^2 - C s + K >= 0``.
    """
    circle = SURELY_STABLE / step_s
    needed = np.maximum(stiffness, damping * circle - stiffness) / circle**2
    return np.asarray(np.maximum(needed - inertia, 0.0))


def largest_step_s(inertia: float, damping: float, stiffness: float) -> float:
    """Longest stable step of one mode, s; infinite without spring and damper."""
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


# in a step: fourth-order steps then err by 2e-4 of a joint's frequency and damp it by 2e-4 of the critical damping
RESOLVED_PHASE_RAD = 0.4


def resolving_step_s(vehicle: Vehicle) -> float:
    """Longest step that resolves the joint's bending oscillation, s."""
    inertia, _, stiffness = joint_modes(vehicle)["bending"]
    return float(RESOLVED_PHASE_RAD * np.sqrt(inertia / stiffness))


def check_resolved(vehicle: Vehicle, step_s: float) -> None:
    """Refuse a step that blurs the joint's oscillation; `ConfigError` says the longest that does not."""
    inertia, _, stiffness = joint_modes(vehicle)["bending"]
    longest = resolving_step_s(vehicle)
    if step_s > longest:
        raise ConfigError(
            f"step of {1e3 * step_s:.3g} ms is too long for a bending mode of "
            f"{np.sqrt(stiffness / inertia) / (2.0 * np.pi):.1f} Hz: at most {1e3 * longest:.2g} ms resolves it",
            code="step-too-long",
        )


def check_step(vehicle: Vehicle, step_s: float) -> None:
    """Refuse a step at which the joint's bending is unstable; `ConfigError` says the longest step.

    A step too long for the twist is not refused: `added_twist_inertia`.
    """
    inertia, damping, stiffness = joint_modes(vehicle)["bending"]
    fastest = float(np.abs(np.roots([inertia, damping, stiffness])).max(initial=0.0))
    if step_s * fastest > SURELY_STABLE and step_s > (longest := largest_step_s(inertia, damping, stiffness)):
        frequency = np.sqrt(stiffness / inertia) / (2.0 * np.pi)
        raise ConfigError(
            f"step of {1e3 * step_s:g} ms is too long for the joint's bending mode at {frequency:.1f} Hz: at most "
            f"{1e3 * longest:.2g} ms is stable (better a tenth of it); shorten time.step_s, or soften the joint",
            code="step-too-long",
        )
    # under a deflection that is held the creep settles faster than under a load that is
    settles_s = vehicle.joint.creep_time_s * (1.0 - vehicle.joint.creep_share)
    if vehicle.joint.creep_share > 0.0 and step_s > SURELY_STABLE * settles_s:
        raise ConfigError(
            f"step of {1e3 * step_s:g} ms is too long for the joint's creep, which settles in {1e3 * settles_s:g} ms: "
            "shorten time.step_s",
            code="step-too-long",
        )

"""Three formulations of two bodies on a joint give one motion.

1. ours: 15 unknowns or, compiled, the force of the constraint (no drift, as the state holds one position only);
2. maximal coordinates: twelve degrees of freedom, the constraint held by Baumgarte's stabilisation (Toniolo et al.,
   constraint force equation), which may drift;
3. minimal coordinates: joint position and two attitudes, nine degrees of freedom, by Kane's method: the constraint
   never appears.

Forms 2 and 3 are written here from their textbooks, with loads from `plain_loads`.
"""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import rotations
from flightmodel.vehicle import MassProperties
from synthetic_flight import dynamics, simulate
from synthetic_flight.simulate import integrate
from tests.oracles import two_body
from tests.oracles.plain_rotations import matrix, skew

from .conftest import bent_entry_state, with_joint
from .plain_loads import Aerodynamics, JointLaw, SmoothAir, gravitation

AIR = SmoothAir()


def cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def spin(q, w):
    """Rate of a quaternion."""
    v = q[1:]
    return 0.5 * np.concatenate([[-v @ w], q[0] * w + cross(v, w)])


class Bodies:
    """Masses, inertias and arms (joint from c.g.) of body and shell, and the loads on them."""

    def __init__(self, vehicle):
        parts = (vehicle.centerbody, vehicle.aeroshell)
        self.mass = [part.mass_kg for part in parts]
        self.inertia = [part.inertia for part in parts]
        self.arm = [vehicle.joint_m - part.cg_m for part in parts]
        self.nose = -vehicle.aeroshell.cg_m
        self.aerodynamics, self.law = Aerodynamics(vehicle, AIR), JointLaw(vehicle)

    def loads(self, r, v, q, w, turn):
        """Forces (ECI) and moments about the c.g.s (own axes) of both bodies, the joint's moment among them."""
        forces = [m * np.array(gravitation(*x)) for m, x in zip(self.mass, r, strict=True)]
        nose = turn[1] @ self.nose
        at_nose = v[1] + cross(turn[1] @ w[1], nose)
        force, moment, _ = self.aerodynamics.wrench(
            (r[1] + nose).tolist(), at_nose.tolist(), turn[1].ravel().tolist(), w[1].tolist()
        )
        forces[1] = forces[1] + force
        relative = turn[0] @ w[0] - turn[1] @ w[1]
        bent = rotations.multiply(q[0] * np.array([1.0, -1, -1, -1]), q[1])
        law = self.law.moment(turn[0].ravel().tolist(), turn[1].ravel().tolist(), bent.tolist(), relative.tolist())
        tau = np.array(law)
        return forces, [turn[0].T @ tau, turn[1].T @ (np.array(moment) + cross(nose, force) - tau)]


def maximal(bodies, origin, y, a, b):
    """Form 2: derivative of (r1, v1, q1, w1, r2, v2, q2, w2); positions relative to ``origin``. Also Phi and Phi'."""
    r, v, q, w = ([y[i + j : i + k] for i in (0, 13)] for j, k in ((0, 3), (3, 6), (6, 10), (10, 13)))
    turn = [matrix(x / np.linalg.norm(x)) for x in q]
    forces, moments = bodies.loads([origin + x for x in r], v, q, w, turn)
    p = [m @ x for m, x in zip(turn, bodies.arm, strict=True)]
    rate = [m @ x for m, x in zip(turn, w, strict=True)]
    inverse = [m @ np.linalg.inv(i) @ m.T for m, i in zip(turn, bodies.inertia, strict=True)]
    free = [
        g @ (m @ (t - cross(x, i @ x))) for g, m, t, x, i in zip(inverse, turn, moments, w, bodies.inertia, strict=True)
    ]
    phi = r[0] + p[0] - r[1] - p[1]
    phi_rate = v[0] + cross(rate[0], p[0]) - v[1] - cross(rate[1], p[1])
    at_joint = [
        f / m + cross(e, x) + cross(u, cross(u, x))
        for f, m, e, x, u in zip(forces, bodies.mass, free, p, rate, strict=True)
    ]
    mobility = sum(np.eye(3) / m - skew(x) @ g @ skew(x) for m, x, g in zip(bodies.mass, p, inverse, strict=True))
    held = np.linalg.solve(mobility, -2.0 * a * phi_rate - b * b * phi - (at_joint[0] - at_joint[1]))
    rates = []
    for k, sign in enumerate((1.0, -1.0)):
        turning = free[k] + inverse[k] @ cross(p[k], sign * held)
        rates += [v[k], (forces[k] + sign * held) / bodies.mass[k], spin(q[k], w[k]), turn[k].T @ turning]
    return np.concatenate(rates), phi, phi_rate


def minimal(bodies, joint, joint_velocity, q, w):
    """Form 3 by Kane: rates of the joint's velocity (ECI) and of both angular velocities (own axes)."""
    turn = [matrix(x) for x in q]
    r = [joint - m @ x for m, x in zip(turn, bodies.arm, strict=True)]
    v = [joint_velocity - m @ cross(x, p) for m, x, p in zip(turn, w, bodies.arm, strict=True)]
    forces, moments = bodies.loads(r, v, q, w, turn)
    mass, right = np.zeros((9, 9)), np.zeros(9)
    for k in range(2):
        # partial velocities of the c.g.: of the joint, and of turning about it (c.g. from joint is -arm)
        partial = np.zeros((3, 9))
        partial[:, :3] = np.eye(3)
        partial[:, 3 + 3 * k : 6 + 3 * k] = turn[k] @ skew(bodies.arm[k])
        centripetal = -turn[k] @ cross(w[k], cross(w[k], bodies.arm[k]))
        mass += bodies.mass[k] * partial.T @ partial
        right += partial.T @ (forces[k] - bodies.mass[k] * centripetal)
        own = slice(3 + 3 * k, 6 + 3 * k)
        mass[own, own] += bodies.inertia[k]
        right[own] += moments[k] - cross(w[k], bodies.inertia[k] @ w[k])
    return np.linalg.solve(mass, right), turn


def random_vehicle(vehicle, rng):
    """Masses, c.g.s, full inertia tensors and all joint constants at random."""

    def part(mass):
        axes = rotations.dcm_from_q(rotations.exp(rng.normal(size=3)))
        cloud = rng.uniform(1.0, 20.0, 3)  # second moments of a cloud of mass: a tensor that a body can have
        tensor = axes @ np.diag(cloud.sum() - cloud) @ axes.T
        tensor = 0.5 * (tensor + tensor.T)
        cg = np.array([-0.6, 0.0, 0.0]) + 0.2 * rng.normal(size=3)
        return MassProperties(
            mass_kg=mass, cg_from_datum_body_m=tuple(cg), inertia_kgm2=tuple(map(tuple, tensor.tolist()))
        )

    joint = vehicle.joint.model_copy(
        update={
            "station_m": rng.uniform(0.0, 1.0),
            "bending_stiffness_nmprad": rng.uniform(1e2, 1e5),
            "bending_damping_nmsprad": rng.uniform(0.0, 50.0),
            "torsion_stiffness_nmprad": rng.uniform(1e2, 1e5),
            "torsion_damping_nmsprad": rng.uniform(0.0, 50.0),
            "freeplay_deg": rng.uniform(0.0, 2.0),
            "freeplay_corner": rng.uniform(0.05, 0.5),
            "hardening_nmprad3": rng.uniform(0.0, 1e6),
            "damping_hardening_nmsprad3": rng.uniform(0.0, 1e3),
        }
    )
    light, heavy = np.exp(rng.uniform(np.log(5.0), np.log(500.0), 2))
    return replace(vehicle, joint=joint, aeroshell=part(float(light)), centerbody=part(float(heavy)))


def test_all_derivatives_agree_at_random_states_of_random_vehicles(vehicle, measured):
    worst = {"maximal": 0.0, "minimal": 0.0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        body = random_vehicle(vehicle, rng)
        state = bent_entry_state(
            0.3 * rng.normal(size=3), rng.normal(size=3), rng.uniform(3e4, 8e4), rng.uniform(300.0, 6e3)
        )
        state[14:17] += rng.normal(size=3)
        loads = two_body.flight_loads(state, body, AIR)
        a_b, _, a_a, _, force = two_body.accelerations(state, body, loads)
        ours = two_body.rates(state, body, loads)
        bodies, where = Bodies(body), dynamics.points(state, body)
        _, _, q_b, q_a, w_b, w_a = dynamics.split(state)
        about = dynamics.offsets(state, body)
        # form 2; relative to the composite c.g., so that the constraint is not lost in 6e6 m of rounding
        y = np.concatenate(
            [about["body"][0], where["body"][1], q_b, w_b, about["shell"][0], where["shell"][1], q_a, w_a]
        )
        got, _, _ = maximal(bodies, state[:3], y, 0.0, 0.0)
        scale = [np.linalg.norm(x) for x in (a_b, ours[14:17], a_a, ours[17:20])]
        pairs = zip((got[3:6], got[10:13], got[16:19], got[23:26]), (a_b, ours[14:17], a_a, ours[17:20]), strict=True)
        off = [np.linalg.norm(x - z) / s for (x, z), s in zip(pairs, scale, strict=True)]
        worst["maximal"] = max(worst["maximal"], *off)
        # form 3
        solved, turn = minimal(bodies, where["joint"][0], where["joint"][1], [q_b, q_a], [w_b, w_a])
        at_joint = a_b + turn[0] @ (cross(ours[14:17], bodies.arm[0]) + cross(w_b, cross(w_b, bodies.arm[0])))
        pairs = ((solved[:3], at_joint), (solved[3:6], ours[14:17]), (solved[6:], ours[17:20]))
        off = [np.linalg.norm(x - z) / np.linalg.norm(z) for x, z in pairs]
        worst["minimal"] = max(worst["minimal"], *off)
        assert np.linalg.norm(force) > 1.0
    # rounding of positions 6e6 m from the Earth's centre (1e-9 m) in gravity, of speeds in q: below 1e-11
    for form, value in worst.items():
        measured(f"derivatives against {form} coordinates, relative, 40 vehicles", value, 1e-10)


def fly_maximal(vehicle, state, step_s, steps, a, b, apart_m=(0.0, 0.0, 0.0)):
    """Form 2 by RK4 from ``state``, the shell moved by ``apart_m``: attitudes, c.g., sizes of Phi and Phi'."""
    bodies, about = Bodies(vehicle), dynamics.offsets(state, vehicle)
    _, _, q_b, q_a, w_b, w_a = dynamics.split(state)
    r0, v0 = state[:3], state[3:6]
    shell = about["shell"][0] - np.array(apart_m)
    y = np.concatenate([about["body"][0], v0 + about["body"][1], q_b, w_b, shell, v0 + about["shell"][1], q_a, w_a])
    # positions relative to a point that moves on with the first velocity
    moving = np.zeros(26)
    moving[0:3] = moving[13:16] = v0

    def rates(t, x):
        return maximal(bodies, r0 + v0 * t, x, a, b)[0] - moving

    drift = []
    for n in range(steps):
        t = n * step_s
        drift.append([np.linalg.norm(x) for x in maximal(bodies, r0 + v0 * t, y, a, b)[1:]])
        k1 = rates(t, y)
        k2 = rates(t + 0.5 * step_s, y + 0.5 * step_s * k1)
        k3 = rates(t + 0.5 * step_s, y + 0.5 * step_s * k2)
        k4 = rates(t + step_s, y + step_s * k3)
        y = y + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        for i in (6, 19):
            y[i : i + 4] /= np.linalg.norm(y[i : i + 4])
    centre = (bodies.mass[0] * y[0:3] + bodies.mass[1] * y[13:16]) / sum(bodies.mass)
    return y[6:10], y[19:23], r0 + v0 * (steps * step_s) + centre, np.array(drift)


@pytest.mark.slow
def test_flight_in_maximal_coordinates(generic_vehicle, measured):
    vehicle, step, seconds = with_joint(generic_vehicle, freeplay_corner=0.5), 1e-3, 2.0
    state = bent_entry_state([0.004, 0.03, 0.02], [0.03, 0.1, -0.06], 55e3)
    # Baumgarte's a and b: 0.05 / step (rule of thumb 0.1 to 1 over the step; RK4 is stable to 2.8)
    a = 0.05 / step
    q_b, q_a, r, drift = fly_maximal(vehicle, state, step, round(seconds / step), a, a)
    states, aux = integrate(vehicle, simulate.atmosphere_table(AIR), state, 2.5e-4, round(seconds / 2.5e-4), 2)
    assert aux[-1, 3] > 500.0  # dynamic pressure
    # fourth order at 1 ms over 2 s of modes up to 14 Hz: (0.09)^4 / 120 a radian, 1e-5 of 0.01 rad
    for name, ours, theirs in (("body", states[-1, 6:10], q_b), ("shell", states[-1, 10:14], q_a)):
        angle = np.rad2deg(np.linalg.norm(rotations.boxminus(ours, theirs)))
        measured(f"maximal coordinates: attitude of the {name} after 2 s", angle, 1e-5, "deg")
    measured("maximal coordinates: position after 2 s", np.linalg.norm(states[-1, :3] - r), 1e-6, "m")
    measured("maximal coordinates: drift", drift[:, 0].max(), 1e-9, "m")
    measured("maximal coordinates: rate of drift", drift[:, 1].max(), 1e-7, "m/s")


def test_baumgarte_closes_a_gap_as_its_equation_says(generic_vehicle, measured):
    # Phi'' = -2 a Phi' - a^2 Phi from 1 mm at rest: Phi = Phi_0 (1 + a t) exp(-a t)
    state, step, a = bent_entry_state([0.004, 0.03, 0.02], [0.03, 0.1, -0.06], 58e3), 1e-3, 50.0
    *_, drift = fly_maximal(generic_vehicle, state, step, 150, a, a, apart_m=(6e-4, 0.0, -8e-4))
    t = step * np.arange(150)
    want = 1e-3 * (1.0 + a * t) * np.exp(-a * t)
    # RK4 at a step of 0.05 / a: (0.05)^5 / 120 a step, 100 steps
    measured("Baumgarte: gap against its closed form", np.abs(drift[:, 0] - want).max() / 1e-3, 1e-6)

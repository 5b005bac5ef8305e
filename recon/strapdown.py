"""How accelerometers and gyros carry a state forward, in readable form: the twin of `recon._strapdown_kernels`.

Model, Earth-fixed axes, for the point where the accelerometer sits:

    dr/dt = v,   dv/dt = C f + g(r) - W x (W x r) - 2 W x v,   dC/dt = C [w x] - [W x] C

with C from body to ECEF, W the Earth's rate, f and w the corrected specific force and inertial rate in body axes. A
sensor triad measures ``(1 + s) * (R(m)^T D^T x) + b``: D is the nominal mounting (sensor to body), m the mounting
rotation in sensor axes, s the scale errors and b the biases, so ``x = D R(m) ((measured - b) / (1 + s))``. Where
its clock may err, by tau (a late tag is positive), ``measured`` is what it reads at the tag tau later, by its rate of
change: good for some ten milliseconds where a vehicle swings twice a second.

Steps are mid-point steps between samples: mean of the two samples, attitude at mid-step, and what turning and pushing
do to each other within a step when both are straight in time (coning ``dt/12 w x dw``, sculling ``dt/12 (w x df - dw
x f)``). White noise of density N (unit^2/Hz) drives velocity and rotation. The gravity gradient in the transition is
the central one (J2 changes it by 0.2 %, which moves a 100 m error by 0.2 mm in a second).

References
----------
D. Titterton, J. Weston, "Strapdown Inertial Navigation Technology", 2nd ed., chapters 3, 11 and 12.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from recon import _filter_kernels
from recon.motion import Motion
from recon.state import IntArray, States


@dataclass(frozen=True)
class Step:
    """A state carried to another node, with its transition (9, 27 or 29) and process noise (9, 9)."""

    state: States
    transition: FloatArray
    noise: FloatArray


def correct(measured_sensor: FloatArray, errors: FloatArray, dcm_body_sensor: FloatArray) -> FloatArray:
    """True quantity in body axes ``(n, 3)`` from measured ``(n, 3)`` and bias, scale, mount ``(9,)`` or ``(n, 9)``."""
    actual = (measured_sensor - errors[..., 0:3]) / (1.0 + errors[..., 3:6])
    return rotations.rotate(rotations.exp(errors[..., 6:9]), actual) @ dcm_body_sensor.T


def correction_partials(measured_sensor: FloatArray, errors: FloatArray, dcm_body_sensor: FloatArray) -> FloatArray:
    """Partials ``(..., 3, 9)`` of `correct` with respect to bias, scale and mount."""
    mount = errors[..., 6:9]
    gain = 1.0 / (1.0 + errors[..., 3:6])
    actual = (measured_sensor - errors[..., 0:3]) * gain
    body_actual = dcm_body_sensor @ rotations.dcm_from_q(rotations.exp(mount))
    d_bias = -body_actual * gain[..., None, :]
    d_scale = d_bias * actual[..., None, :]
    value = np.einsum("...ij,...j->...i", body_actual, actual)
    d_mount = -rotations.skew(value) @ (dcm_body_sensor @ (np.eye(3) + 0.5 * rotations.skew(mount)))
    return np.concatenate([d_bias, d_scale, d_mount], axis=-1)


def propagate_plain(grid: Motion, first: int, last: int, start: States) -> Step:
    """Carry a state from grid point ``first`` to ``last`` in numpy; slow, for reading and for tests."""
    position, velocity, q = start.position_ecef_m, start.velocity_ecef_mps, start.q_ecef_body
    errors = start.sensor_errors
    drivers = grid.drivers
    clock = errors[18:20] if grid.clocks else np.zeros(2)
    transition = np.hstack([np.eye(9), np.zeros((9, drivers))])
    noise = np.zeros((9, 9))
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    step = 1 if last >= first else -1
    for k in range(first, last, step):
        dt = grid.time_s[k + step] - grid.time_s[k]
        f_change = grid.force_sensor_mps2[k + step] - grid.force_sensor_mps2[k]
        w_change = grid.rate_sensor_radps[k + step] - grid.rate_sensor_radps[k]
        f_measured = grid.force_sensor_mps2[k] + (0.5 + clock[0] / dt) * f_change
        w_measured = grid.rate_sensor_radps[k] + (0.5 + clock[1] / dt) * w_change
        f = correct(f_measured, errors[0:9], grid.dcm_body_force)
        w = correct(w_measured, errors[9:18], grid.dcm_body_rate)
        df = -correction_partials(f_measured, errors[0:9], grid.dcm_body_force)[:, 0:3] @ f_change
        dw = -correction_partials(w_measured, errors[9:18], grid.dcm_body_rate)[:, 0:3] @ w_change
        f, w = f + dt / 12.0 * (np.cross(w, df) - np.cross(dw, f)), w + dt / 12.0 * np.cross(w, dw)

        earth_half = rotations.exp(-0.5 * dt * earth.OMEGA_ECEF_RADPS)
        q_mid = rotations.multiply(earth_half, rotations.boxplus(q, 0.5 * dt * w))
        q = rotations.multiply(earth_half, rotations.boxplus(q_mid, 0.5 * dt * w))
        mid = position + 0.5 * dt * velocity
        c = rotations.dcm_from_q(q_mid)
        a = c @ f + earth.gravitation(mid) - spin @ spin @ mid
        a = a - 2.0 * spin @ (velocity + 0.5 * dt * (a - 2.0 * spin @ velocity))
        position = position + dt * velocity + 0.5 * dt**2 * a
        velocity = velocity + dt * a

        full = _step_transition(dt, c, f, rotations.dcm_from_q(rotations.exp(0.5 * dt * w)), mid, drivers)
        full[3:6, 9:18] = dt * c @ correction_partials(f_measured, errors[0:9], grid.dcm_body_force)
        d_rate = correction_partials(w_measured, errors[9:18], grid.dcm_body_rate)
        half = rotations.dcm_from_q(rotations.exp(0.5 * dt * w))
        full[6:9, 18:27] = dt * half.T @ d_rate
        full[3:6, 18:27] = -0.5 * dt**2 * c @ rotations.skew(f) @ d_rate
        if grid.clocks:
            turned = c - dt * spin @ c  # signals that jump about make these columns large: with Coriolis
            full[3:6, 27] = turned @ df
            full[6:9, 28] = half.T @ dw
            full[3:6, 28] = -0.5 * dt * turned @ np.cross(f, dw)
        full[0:3, 9:] = 0.5 * dt * full[3:6, 9:]
        transition = full @ np.vstack([transition, np.hstack([np.zeros((drivers, 9)), np.eye(drivers)])])

        j = min(k, k + step)
        noise = full[:, :9] @ noise @ full[:, :9].T + _step_noise(dt, c, grid.force_density[j], grid.rate_density[j])
    return Step(States(position, velocity, q, errors), transition, noise)


def _step_transition(
    dt: float, c: FloatArray, f: FloatArray, half: FloatArray, mid: FloatArray, drivers: int
) -> FloatArray:
    """Kinematic part of one step's transition, in a (9, 9 + drivers) matrix whose sensor columns are zero."""
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    gradient = earth.gravitation_gradient(mid) - spin @ spin
    coriolis = np.eye(3) - dt * spin
    by_position = coriolis @ gradient
    by_velocity = 0.5 * dt * by_position - 2.0 * spin
    by_rotation = -coriolis @ c @ rotations.skew(f) @ half.T
    full = np.zeros((9, 9 + drivers))
    for column, block in zip((0, 3, 6), (by_position, by_velocity, by_rotation), strict=True):
        full[3:6, column : column + 3] = dt * block
        full[0:3, column : column + 3] = 0.5 * dt**2 * block
    full[0:3, 0:3] += np.eye(3)
    full[0:3, 3:6] += dt * np.eye(3)
    full[3:6, 3:6] += np.eye(3)
    full[6:9, 6:9] = half.T @ half.T
    return full


def _step_noise(dt: float, c: FloatArray, force_density: FloatArray, rate_density: FloatArray) -> FloatArray:
    """White noise of one step (9, 9)."""
    force = abs(dt) * (c * force_density) @ c.T
    noise = np.zeros((9, 9))
    noise[0:3, 0:3] = force * dt**2 / 3.0
    noise[0:3, 3:6] = noise[3:6, 0:3] = 0.5 * dt * force
    noise[3:6, 3:6] = force
    noise[6:9, 6:9] = abs(dt) * np.diag(rate_density)
    return noise


def propagate(motion: Motion, first: int, last: int, start: States) -> Step:
    """Carry a state from grid point ``first`` to ``last`` (either direction), compiled; whatever carries it."""
    position, velocity, q = start.position_ecef_m.copy(), start.velocity_ecef_mps.copy(), start.q_ecef_body.copy()
    phi, noise = np.empty((9, 9 + motion.drivers)), np.empty((9, 9))
    errors = np.ascontiguousarray(start.sensor_errors)
    _filter_kernels.propagate_one(*motion.split(), first, last, errors, position, velocity, q, phi, noise)
    return Step(States(position, velocity, q, start.sensor_errors), phi, noise)


def fill_between(motion: Motion, node_index: IntArray, known: IntArray, at_known: States) -> States:
    """States at all nodes (n,) from those at the ``known`` ones (indices, the first is 0), noise-free between."""
    n = len(node_index)
    position, velocity, q = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4))
    position[known], velocity[known] = at_known.position_ecef_m, at_known.velocity_ecef_mps
    q[known] = at_known.q_ecef_body
    is_known = np.zeros(n, dtype=bool)
    is_known[known] = True
    errors = np.ascontiguousarray(at_known.sensor_errors[np.cumsum(is_known) - 1])
    for k in np.flatnonzero(~is_known):
        before = States(position[k - 1], velocity[k - 1], q[k - 1], errors[k - 1])
        state = propagate(motion, node_index[k - 1], node_index[k], before).state
        position[k], velocity[k], q[k] = state.position_ecef_m, state.velocity_ecef_mps, state.q_ecef_body
    return States(position, velocity, rotations.continuous(q), errors)

"""How do accelerometers and gyros propagate a state? Strapdown mechanisation (compiled: `recon._strapdown_kernels`).

Model, Earth-fixed axes, for the point where the accelerometer sits:

    dr/dt = v,   dv/dt = C f + g(r) - W x (W x r) - 2 W x v,   dC/dt = C [w x] - [W x] C

with C from body to ECEF, W the Earth's rate, f and w the corrected specific force and inertial rate in body axes. A
sensor measures ``(1 + s) * (R(m)^T D^T x) + b``: D is the nominal mounting (sensor to body), m the mounting
rotation in sensor axes, s the scale errors and b the biases, so ``x = D R(m) ((measured - b) / (1 + s))``. Where
its clock may err, by tau (a late tag is positive), ``measured`` is what it reads at the tag tau later, by its rate of
change: good for some ten milliseconds where a vehicle oscillates twice a second.

Steps are mid-point steps between samples: mean of the two samples, attitude at mid-step, and the coning ``dt/12 w x
dw`` and sculling ``dt/12 (w x df - dw x f)`` corrections of rates and forces that are linear in time within a step.
White noise of density N (unit^2/Hz) drives velocity and rotation. The gravity gradient in the transition is the central
one (J2 changes it by 0.2 %, which moves a 100 m error by 0.2 mm in a second). Numpy form: `tests.oracles.strapdown`.

References
----------
D. Titterton, J. Weston, "Strapdown Inertial Navigation Technology", 2nd ed., chapters 3, 11 and 12.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import rotations
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

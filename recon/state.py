"""What does the filter estimate? Nominal states at nodes, error coordinates about them, and the arrays of a pass.

A state is position and velocity of the accelerometer (ECEF, m and m/s relative to the Earth), attitude of the
body and the vector of sensor errors. Error coordinates add, except for rotation, which is a right-hand vector in body
axes, rad: ``state = nominal [+] error``. Following the accelerometer rather than the datum keeps lever arms, and with
them derivatives of the gyro signal, out of the integration; `recon.reconstruct` moves the answer to the datum.

A pass is plain tuples of arrays, which both engines take: ``n`` nodes, ``M`` measurements, ``m`` errors beside the nine
kinematic ones (``N = 9 + m``), the first ``s`` of them drivers of the motion (`recon.propagation`), ``D = 9 + s``.
Symmetric matrices are stored as packed lower triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flightmodel import rotations
from flightmodel.checks import FloatArray

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
POSITION, VELOCITY, ROTATION = slice(0, 3), slice(3, 6), slice(6, 9)
KINEMATIC, INERTIAL = 9, 27


@dataclass(frozen=True)
class States:
    """States at ``n`` nodes (or one, without the leading axis).

    Parameters
    ----------
    position_ecef_m, velocity_ecef_mps : (n, 3) float
        Of the accelerometer.
    q_ecef_body : (n, 4) float
    sensor_errors : (n, m) float
        In the order of `recon.error_model.ErrorModel`, which starts with the 18 errors of the inertial sensors.
    """

    position_ecef_m: FloatArray
    velocity_ecef_mps: FloatArray
    q_ecef_body: FloatArray
    sensor_errors: FloatArray

    def __getitem__(self, index: int | slice | IntArray) -> States:
        """State of one node, of a range, or of chosen nodes."""
        return States(
            self.position_ecef_m[index],
            self.velocity_ecef_mps[index],
            self.q_ecef_body[index],
            self.sensor_errors[index],
        )


def boxplus(states: States, error: FloatArray) -> States:
    """States moved by errors ``(..., 9 + m)``."""
    return States(
        states.position_ecef_m + error[..., POSITION],
        states.velocity_ecef_mps + error[..., VELOCITY],
        rotations.boxplus(states.q_ecef_body, error[..., ROTATION]),
        states.sensor_errors + error[..., KINEMATIC:],
    )


def boxminus(states: States, reference: States) -> FloatArray:
    """Errors ``(..., 9 + m)`` that `boxplus` needs to go from the reference to ``states``."""
    return np.concatenate(
        [
            states.position_ecef_m - reference.position_ecef_m,
            states.velocity_ecef_mps - reference.velocity_ecef_mps,
            rotations.boxminus(states.q_ecef_body, reference.q_ecef_body),
            states.sensor_errors - reference.sensor_errors,
        ],
        axis=-1,
    )


def stack(states: list[States]) -> States:
    """States of single nodes as one with a leading axis."""
    return States(
        np.array([s.position_ecef_m for s in states]),
        np.array([s.velocity_ecef_mps for s in states]),
        rotations.continuous(np.array([s.q_ecef_body for s in states])),
        np.array([s.sensor_errors for s in states]),
    )


def right_jacobian(rotation_rad: FloatArray) -> FloatArray:
    """Matrix (3, 3) from a change of a rotation vector to the body-axis rotation it causes; second order."""
    k = rotations.skew(rotation_rad)
    return np.eye(3) - 0.5 * k + k @ k / 6.0


class Sources(NamedTuple):
    """Instruments, one row each: kind, lever arm, place, axes, and which error (-1: none) fills each of its slots."""

    kind: IntArray
    arm_body_m: FloatArray
    site_ecef_m: FloatArray
    dcm: FloatArray
    slot: IntArray


class Observed(NamedTuple):
    """Measurements in order of nodes; those of node ``k`` are rows ``first[k]`` to ``first[k + 1]``.

    Parameters
    ----------
    first : (n + 1,) int
    source : (M,) int
    value, variance : (M, 3) float
        Variance is infinite where a component was not measured.
    known : (M, 3) float
        Field or direction to the Sun, Earth-fixed axes; of a radar, the refractivity at its site first.
    usable : (M,) bool
        Whether the filter may use it at all.
    """

    first: IntArray
    source: IntArray
    value: FloatArray
    variance: FloatArray
    known: FloatArray
    usable: BoolArray


class Wander(NamedTuple):
    """Gauss-Markov model of each error (m,).

    Time constant and altitude over which it decorrelates, at its stationary sd; variance of a random walk per second;
    whether it is only considered.
    """

    time_constant_s: FloatArray
    altitude_m: FloatArray
    sd: FloatArray
    walk_var_per_s: FloatArray
    considered: BoolArray


class Charts(NamedTuple):
    """Nominal states at all nodes: position, velocity (n, 3), attitude (n, 4), errors (n, m)."""

    position: FloatArray
    velocity: FloatArray
    q: FloatArray
    errors: FloatArray


class Steps(NamedTuple):
    """Each node to the next: transition (n - 1, 9, D), noise (n - 1, 9, 9), decay and noise of errors (n - 1, m)."""

    transition: FloatArray
    noise: FloatArray
    decay: FloatArray
    noise_var: FloatArray


class Filtered(NamedTuple):
    """Errors about the charts before and after each node's measurements, and their covariance.

    Parameters
    ----------
    x_minus, x_plus : (n, N) float
    p_minus : (n, N (N + 1) / 2) float
        Packed.
    kept : (n,) int
        Row of ``p_plus`` that holds a node's covariance; -1 where it is not wanted.
    p_plus : (k, D (D + 1) / 2) float
        Packed.
    p_last : (N, N) float
        After the last measurement.
    """

    x_minus: FloatArray
    x_plus: FloatArray
    p_minus: FloatArray
    kept: IntArray
    p_plus: FloatArray
    p_last: FloatArray


class Innovations(NamedTuple):
    """Innovation and gain of each measurement; components that were not measured are zero with unit variance.

    Parameters
    ----------
    residual, covariance : (M, 3), (M, 3, 3) float
    nis : (M,) float
    accepted : (M,) bool
    gain : (M, N, 3) float
        Zero where not accepted.
    by_state, by_error : (M, 3, 9), (M, 3, SLOTS) float
        Partials of the prediction.
    """

    residual: FloatArray
    covariance: FloatArray
    nis: FloatArray
    accepted: BoolArray
    gain: FloatArray
    by_state: FloatArray
    by_error: FloatArray


def packed(matrices: FloatArray) -> FloatArray:
    """Lower triangles ``(..., N (N + 1) / 2)`` of symmetric matrices ``(..., N, N)``."""
    return np.asarray(matrices[(..., *np.tril_indices(matrices.shape[-1]))])


def unpacked(triangles: FloatArray, count: int | None = None) -> FloatArray:
    """Symmetric matrices ``(..., c, c)`` from packed lower triangles; of their first ``count`` rows where given."""
    size = int(np.sqrt(2 * triangles.shape[-1]))
    c = size if count is None else count
    rows, columns = np.tril_indices(c)
    out = np.empty((*triangles.shape[:-1], c, c))
    out[..., rows, columns] = triangles[..., : len(rows)]
    out[..., columns, rows] = triangles[..., : len(rows)]
    return out

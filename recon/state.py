"""What the filter estimates: nominal states at nodes, and the error coordinates about them.

A state is position and velocity of the accelerometer triad (ECEF, m and m/s relative to the Earth), attitude of the
body and the vector of sensor errors. Error coordinates add, except for rotation, which is a right-hand vector in body
axes, rad: ``state = nominal [+] error``. Following the accelerometer rather than the datum keeps lever arms, and with
them derivatives of the gyro signal, out of the integration; `recon.bet` moves the answer to the datum.
"""

from __future__ import annotations

from dataclasses import dataclass

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
        Of the accelerometer triad.
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

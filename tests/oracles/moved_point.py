"""Trajectory of another point of a rigid body, from its attitude and rates."""

from __future__ import annotations

import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray
from flightmodel.trajectory import Trajectory


def move_point(trajectory: Trajectory, to: str, to_from_point_body_m: FloatArray) -> Trajectory:
    """Trajectory of another point fixed in the body, ``to_from_point_body_m`` (3,) away; covariance is dropped."""
    arm = rotations.rotate(trajectory.q_ecef_body, np.broadcast_to(to_from_point_body_m, (len(trajectory.time_s), 3)))
    rate = rotations.rotate(trajectory.q_ecef_body, trajectory.omega_body_eci_body_radps)
    rate = rate - trajectory.planet.rate_ecef_radps
    return Trajectory(
        trajectory.epoch_utc,
        trajectory.time_s,
        to,
        trajectory.position_ecef_m + arm,
        trajectory.velocity_ecef_mps + np.cross(rate, arm),
        trajectory.q_ecef_body,
        trajectory.omega_body_eci_body_radps,
        planet=trajectory.planet,
    )

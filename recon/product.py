"""From nodes to what an analyst uses: trajectory of the datum, corrected sensor series, tables.

Moving from the accelerometer (at ``r`` from the datum, body axes) to the datum:

    p = p_imu - C r,   v = v_imu - C (w x r),   w = gyro rate - C^T W

and the errors move with them: ``dp = dp_imu + C [r x] d``, ``dv = dv_imu + C [(w x r) x] d + C [r x] dw`` with rotation
error ``d`` and rate error ``dw`` from the gyros' estimated errors and white noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from flightmodel.telemetry import Finding
from flightmodel.trajectory import Trajectory, interpolate_rows
from recon.ekf import Innovations, Problem
from recon.inertial import Bridged
from recon.measurements import COMPONENTS
from recon.state import INERTIAL, IntArray, States
from recon.strapdown import correct, correction_partials

SAME_STRETCH_S = 1.0


@dataclass(frozen=True)
class Mounting:
    """What moving a node to the datum needs: epoch, accelerometer from datum (3,), m, and gyro noise, rad/s."""

    epoch_utc: str
    arm_body_m: FloatArray
    rate_noise_sd: float


def datum_trajectory(
    problem: Problem, mounting: Mounting, states: States, covariance: FloatArray, output: IntArray
) -> Trajectory:
    """Trajectory of the datum at the nodes ``output`` from states and covariances at all nodes."""
    grid = problem.grid
    measured = grid.rate_sensor_radps[problem.node_index[output]]
    errors = states.sensor_errors[output, 9:18]
    c = rotations.dcm_from_q(states.q_ecef_body[output])
    omega = correct(measured, errors, grid.dcm_body_rate)
    r = mounting.arm_body_m
    swing = np.cross(omega - earth.OMEGA_RADPS * c[:, 2], r)

    n = len(output)
    move = np.zeros((n, 9, 27))
    move[:, range(9), range(9)] = 1.0
    lever = c @ rotations.skew(r)
    move[:, 0:3, 6:9] = lever
    move[:, 3:6, 6:9] = c @ rotations.skew(swing)
    move[:, 3:6, 18:27] = lever @ correction_partials(measured, errors, grid.dcm_body_rate)
    moved = move @ covariance[output] @ np.swapaxes(move, 1, 2)
    moved[:, 3:6, 3:6] += mounting.rate_noise_sd**2 * lever @ np.swapaxes(lever, 1, 2)
    return Trajectory(
        mounting.epoch_utc,
        problem.time_s[output],
        "datum",
        states.position_ecef_m[output] - c @ r,
        states.velocity_ecef_mps[output] - np.einsum("nij,nj->ni", c, swing),
        states.q_ecef_body[output],
        omega,
        0.5 * (moved + np.swapaxes(moved, 1, 2)),
    )


def corrected_series(
    problem: Problem, force: Bridged, rate: Bridged, states: States
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (k,) and corrected specific force and rate (k, 3), body axes, at valid accelerometer samples."""
    t = force.time_s
    opened_by_gap = np.zeros(len(t), dtype=bool)
    opened_by_gap[1:] = force.in_gap[:-1]
    bridged = force.in_gap & opened_by_gap  # samples of a bridge have a gap on both sides
    k = np.clip(np.searchsorted(rate.time_s, t, side="right") - 1, 0, len(rate.time_s) - 1)
    hidden = rate.in_gap[k] & (t - rate.time_s[k] > 1e-6)
    keep = ~bridged & ~hidden & (t >= problem.time_s[0]) & (t <= problem.time_s[-1])
    t = t[keep]
    errors = interpolate_rows(t, problem.time_s, states.sensor_errors[:, :18])
    specific_force = correct(force.measured_sensor[keep], errors[:, 0:9], problem.grid.dcm_body_force)
    measured_rate = interpolate_rows(t, rate.time_s, rate.measured_sensor)
    return t, specific_force, correct(measured_rate, errors[:, 9:18], problem.grid.dcm_body_rate)


def specific_force_cov(problem: Problem, states: States, covariance: FloatArray, output: IntArray) -> FloatArray:
    """Systematic error covariance (n, 3, 3) of the corrected specific force, body axes, (m/s^2)^2."""
    measured = problem.grid.force_sensor_mps2[problem.node_index[output]]
    partials = correction_partials(measured, states.sensor_errors[output, 0:9], problem.grid.dcm_body_force)
    return np.asarray(partials @ covariance[output, 9:18, 9:18] @ np.swapaxes(partials, 1, 2))


def sensor_error_table(problem: Problem, states: States, covariance: FloatArray, last: FloatArray) -> pd.DataFrame:
    """Prior and posterior of every sensor error at mid-span; of constants, from the last covariance ``last`` (N, N)."""
    middle = len(problem.time_s) // 2
    model = problem.model
    return pd.DataFrame(
        {
            "name": model.names,
            "unit": model.units,
            "prior_sd": model.prior_sd,
            "estimate": states.sensor_errors[middle],
            "sd": np.sqrt(np.concatenate([np.diag(covariance[middle])[9:], np.diag(last)[INERTIAL:]])),
        }
    )


def residual_table(time_s: FloatArray, innovations: Innovations, names: list[str]) -> pd.DataFrame:
    """One row for each component of each radar point."""
    n = len(innovations.node)
    return pd.DataFrame(
        {
            "time_s": np.repeat(time_s[innovations.node], 3),
            "source": np.repeat(np.array(names, dtype=object)[innovations.radar], 3),
            "component": list(COMPONENTS) * n,
            "residual": innovations.residual.ravel(),
            "predicted_sd": np.sqrt(np.diagonal(innovations.covariance, axis1=1, axis2=2)).ravel(),
            "accepted": np.repeat(innovations.accepted, 3),
        }
    )


def edit_findings(time_s: FloatArray, innovations: Innovations, names: list[str]) -> list[Finding]:
    """Stretches of track in which points were edited."""
    out = []
    for number, name in enumerate(names):
        times = time_s[innovations.node[(innovations.radar == number) & ~innovations.accepted]]
        if len(times) == 0:
            continue
        for stretch in np.split(times, np.flatnonzero(np.diff(times) > SAME_STRETCH_S) + 1):
            words = f"{len(stretch)} track point{'s' if len(stretch) > 1 else ''} edited"
            out.append(Finding(name, words, float(stretch[0]), float(stretch[-1])))
    return out

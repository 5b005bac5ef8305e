"""What does an analyst get from the filter's nodes? Trajectory of the datum, corrected sensor series, tables.

Moving from the accelerometer (at ``r`` from the datum, body axes) to the datum:

    p = p_imu - C r,   v = v_imu - C (w x r),   w = gyro rate - C^T W

and the errors move with them: ``dp = dp_imu + C [r x] d``, ``dv = dv_imu + C [(w x r) x] d + C [r x] dw`` with
rotation error ``d`` and rate error ``dw`` from the gyros' estimated errors and white noise. In ballistic flight the
tracked point is the datum and the attitude unknown, with the covariance of an unknown attitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.telemetry import Finding
from flightmodel.trajectory import Trajectory, interpolate_rows
from recon.ekf import Innovations, Problem
from recon.imu_screening import BridgedSensor
from recon.propagation import correct, correction_partials
from recon.smoother import Smoothed
from recon.state import INERTIAL, KINEMATIC, States, unpacked

SAME_STRETCH_S = 1.0
_MOST_STRETCHES = 12  # that are listed one by one
_UNKNOWN_ROTATION_VAR = np.pi**2 / 3.0  # of an angle that may be anything


@dataclass(frozen=True)
class Mounting:
    """For moving a node to the datum: epoch, accelerometer from datum (3,), m, and the gyros, if there are."""

    epoch_utc: str
    arm_body_m: FloatArray
    rate: BridgedSensor | None


def datum_trajectory(problem: Problem, mounting: Mounting, states: States, triangles: FloatArray) -> Trajectory:
    """Trajectory of the datum at the kept nodes from states at all nodes and packed covariances at the kept ones."""
    kept = np.flatnonzero(problem.kept)
    covariance = unpacked(triangles, KINEMATIC if mounting.rate is None else INERTIAL)
    states = states[kept]
    n = len(kept)
    if mounting.rate is None:
        covariance[:, 6:9] = 0.0
        covariance[:, :, 6:9] = 0.0
        covariance[:, range(6, 9), range(6, 9)] = _UNKNOWN_ROTATION_VAR
        return Trajectory(
            mounting.epoch_utc, problem.time_s[kept], "datum", states.position_ecef_m, states.velocity_ecef_mps,
            states.q_ecef_body, np.tile(earth.OMEGA_ECEF_RADPS, (n, 1)), covariance,
        )  # fmt: skip
    motion = problem.motion
    measured = interpolate_rows(problem.time_s[kept], mounting.rate.time_s, mounting.rate.measured_sensor)
    errors = states.sensor_errors[:, 9:18]
    c = rotations.dcm_from_q(states.q_ecef_body)
    omega = correct(measured, errors, motion.dcm_body_rate)
    r = mounting.arm_body_m
    lever_velocity = np.cross(omega - earth.OMEGA_RADPS * c[:, 2], r)

    move = np.zeros((n, 9, 27))
    move[:, range(9), range(9)] = 1.0
    lever = c @ rotations.skew(r)
    move[:, 0:3, 6:9] = lever
    move[:, 3:6, 6:9] = c @ rotations.skew(lever_velocity)
    move[:, 3:6, 18:27] = lever @ correction_partials(measured, errors, motion.dcm_body_rate)
    moved = move @ covariance @ np.swapaxes(move, 1, 2)
    moved[:, 3:6, 3:6] += mounting.rate.spec.noise_sd**2 * lever @ np.swapaxes(lever, 1, 2)
    return Trajectory(
        mounting.epoch_utc,
        problem.time_s[kept],
        "datum",
        states.position_ecef_m - c @ r,
        states.velocity_ecef_mps - np.einsum("nij,nj->ni", c, lever_velocity),
        states.q_ecef_body,
        omega,
        0.5 * (moved + np.swapaxes(moved, 1, 2)),
    )


def corrected_series(
    problem: Problem, force: BridgedSensor, rate: BridgedSensor, states: States
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (k,) and corrected specific force and rate (k, 3), body axes, at valid accelerometer samples."""
    t = force.time_s
    after_gap = np.zeros(len(t), dtype=bool)
    after_gap[1:] = force.in_gap[:-1]
    bridged = force.in_gap & after_gap  # samples of a bridge have a gap on both sides
    k = np.clip(np.searchsorted(rate.time_s, t, side="right") - 1, 0, len(rate.time_s) - 1)
    in_rate_gap = rate.in_gap[k] & (t - rate.time_s[k] > 1e-6)
    keep = ~bridged & ~in_rate_gap & (t >= problem.time_s[0]) & (t <= problem.time_s[-1])
    t = t[keep]
    errors = interpolate_rows(t, problem.time_s, states.sensor_errors[:, :18])
    specific_force = correct(force.measured_sensor[keep], errors[:, 0:9], problem.motion.dcm_body_force)
    measured_rate = interpolate_rows(t, rate.time_s, rate.measured_sensor)
    return t, specific_force, correct(measured_rate, errors[:, 9:18], problem.motion.dcm_body_rate)


def specific_force_cov(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Systematic error covariance (k, 3, 3) of the corrected specific force at kept nodes, body axes, (m/s^2)^2."""
    kept = np.flatnonzero(problem.kept)
    measured = problem.motion.force_sensor_mps2[problem.node_index[kept]]
    partials = correction_partials(measured, states.sensor_errors[kept, 0:9], problem.motion.dcm_body_force)
    covariance = unpacked(triangles, 18)[:, 9:18, 9:18]
    return np.asarray(partials @ covariance @ np.swapaxes(partials, 1, 2))


def accelerometer_root(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Response (k, 6, 9) of rotation error and specific force error, body axes, at kept nodes to nine unit normals.

    The nine stand for the accelerometer's constant errors: ``root @ root.T`` of the lower rows is the covariance of
    the corrected specific force, the upper rows are the part of the attitude's error correlated with them.
    Gauss-Markov errors are taken as they are at mid-span.
    """
    kept = np.flatnonzero(problem.kept)
    measured = problem.motion.force_sensor_mps2[problem.node_index[kept]]
    partials = correction_partials(measured, states.sensor_errors[kept, 0:9], problem.motion.dcm_body_force)
    attitude, root = _constant_errors(unpacked(triangles, 18))
    return np.concatenate([attitude, partials @ root], axis=1)


def _constant_errors(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Responses of rotation (k, 3, m) and of the m errors behind the motion (m, m) to unit normals, at mid-span."""
    variance, axes = np.linalg.eigh(covariance[len(covariance) // 2, 9:, 9:])
    sd = np.sqrt(np.maximum(variance, 0.0))
    inverse = np.divide(1.0, sd, out=np.zeros(len(sd)), where=sd > 1e-12)
    return covariance[:, 6:9, 9:] @ (axes * inverse), axes * sd


def triad_root(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Response (k, 9, 18) of rotation, specific force and rate errors, body axes, at kept nodes to unit normals.

    As `accelerometer_root`, of the constant errors of accelerometer and gyros together: what a gyro's mounting does to
    the attitude rolls with the vehicle.
    """
    kept = np.flatnonzero(problem.kept)
    node = problem.node_index[kept]
    motion, errors = problem.motion, states.sensor_errors[kept]
    force = correction_partials(motion.force_sensor_mps2[node], errors[:, 0:9], motion.dcm_body_force)
    rate = correction_partials(motion.rate_sensor_radps[node], errors[:, 9:18], motion.dcm_body_rate)
    attitude, root = _constant_errors(unpacked(triangles, 27))
    return np.concatenate([attitude, force @ root[0:9], rate @ root[9:18]], axis=1)


def rate_cov(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Systematic error covariance (k, 3, 3) of the corrected rates at kept nodes, body axes, (rad/s)^2."""
    kept = np.flatnonzero(problem.kept)
    measured = problem.motion.rate_sensor_radps[problem.node_index[kept]]
    partials = correction_partials(measured, states.sensor_errors[kept, 9:18], problem.motion.dcm_body_rate)
    covariance = unpacked(triangles, 27)[:, 18:27, 18:27]
    return np.asarray(partials @ covariance @ np.swapaxes(partials, 1, 2))


def sensor_error_table(problem: Problem, states: States, smoothed: Smoothed) -> pd.DataFrame:
    """Prior and posterior of every error; of Gauss-Markov errors, the value at mid-span."""
    kept = np.flatnonzero(problem.kept)
    row = len(kept) // 2
    model = problem.model
    return pd.DataFrame(
        {
            "name": model.names,
            "unit": model.units,
            "treated": np.where(model.wander.considered, "considered", "estimated"),
            "prior_sd": model.prior_sd,
            "estimate": states.sensor_errors[kept[row]],
            "sd": np.sqrt(smoothed.variance[row, 9:]),
        }
    )


def residual_table(problem: Problem, innovations: Innovations) -> pd.DataFrame:
    """One row for each component that was measured; what is not ``used`` is held out."""
    row, component = np.nonzero(np.isfinite(problem.observed.variance))
    source = problem.observed.source[row]
    names = np.array([i.name for i in problem.instruments], dtype=object)
    components = np.array([(*i.components, "", "")[:3] for i in problem.instruments], dtype=object)
    return pd.DataFrame(
        {
            "time_s": problem.time_s[problem.node[row]],
            "source": names[source],
            "component": components[source, component],
            "residual": innovations.residual[row, component],
            "predicted_sd": np.sqrt(innovations.covariance[row, component, component]),
            "accepted": innovations.accepted[row],
            "used": problem.observed.usable[row],
        }
    )


def edit_findings(problem: Problem, accepted: BoolArray) -> list[Finding]:
    """Stretches in which measurements were edited; sources excluded by settings have none."""
    out = []
    time_s = problem.time_s[problem.node]
    for number, instrument in enumerate(problem.instruments):
        mine = (problem.observed.source == number) & problem.observed.usable
        times = time_s[mine & ~accepted]
        if len(times) == 0:
            continue
        what = "track point" if instrument.name == instrument.owner else "reading"
        stretches = np.split(times, np.flatnonzero(np.diff(times) > SAME_STRETCH_S) + 1)
        if len(stretches) > _MOST_STRETCHES:
            share = 100.0 * len(times) / int(mine.sum())
            remark = f"{len(times)} {what}s edited in {len(stretches)} stretches ({share:.0f} % of them)"
            out.append(Finding(instrument.name, remark, float(times[0]), float(times[-1]), "points-edited"))
            continue
        for stretch in stretches:
            remark = f"{len(stretch)} {what}{'s' if len(stretch) > 1 else ''} edited"
            out.append(Finding(instrument.name, remark, float(stretch[0]), float(stretch[-1]), "points-edited"))
    return out

"""What the air of the day was: windows of the reconstructed flight, assembled for `recon.air`.

A window is long enough to average the joint's swinging (2.5 Hz), and what it averages of the sensors it averages of
the attitude too, so that the vehicle's own oscillation is smoothed alike on both sides.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, rotations
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.checks import FloatArray
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory, resample
from postflight.sensed import window_means
from recon.air import AirSamples, Drag, ReconstructedAir, reconstruct_air
from recon.bet import Reconstruction

WINDOW_S = 0.4
EDGE_S = 0.05  # half the windows over which rates are averaged at both ends
POINTS = 9  # at which a window's attitude is looked up
LARGEST_GAP_S = 0.1


def day_air(
    telemetry: Telemetry, bet: Reconstruction, profile: AtmosphereProfile, confidence: float
) -> ReconstructedAir:
    """Density and winds along altitude from the reconstruction and the corrected deceleration.

    Raises
    ------
    GateError
        Where there is no vehicle or no inertial sensor, or the air never pushes hard enough.
    """
    vehicle = telemetry.required_vehicle()
    known = vehicle.uncertainty
    drag = Drag(
        vehicle.aero,
        vehicle.reference.area_m2 / vehicle.mass_kg,
        float(np.hypot(known.ca, known.mass)),
        float(np.hypot(known.cn, known.mass)),
        vehicle.reference.length_m,
    )
    return reconstruct_air(air_samples(telemetry, bet), profile, drag, confidence)


def air_samples(telemetry: Telemetry, bet: Reconstruction) -> AirSamples:
    """Means over windows of `WINDOW_S`, side by side, wherever no telemetry gap is near."""
    cg = telemetry.required_vehicle().cg_m
    accelerometer, _ = telemetry.required_triads()
    t = _window_times(bet)
    force = _force_means(bet, cg - accelerometer.spec.position_from_datum_body_m, t)
    inside = WINDOW_S * ((np.arange(POINTS) + 0.5) / POINTS - 0.5)
    dense = resample(bet.smoothed, (t[:, None] + inside).ravel())

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(values.reshape(len(t), POINTS, *values.shape[1:]).mean(axis=1))

    middle = resample(bet.smoothed, t)
    lat, lon, altitude = earth.geodetic_from_ecef(middle.position_ecef_m)
    dcm_ned_ecef = earth.dcm_ned_ecef(lat, lon)
    dcm = rotations.dcm_from_q(dense.q_ecef_body)
    spin = dense.omega_body_eci_body_radps - dcm.transpose(0, 2, 1) @ earth.OMEGA_ECEF_RADPS
    velocity = dense.velocity_ecef_mps + np.einsum("nij,nj->ni", dcm, np.cross(spin, cg))
    return AirSamples(
        t,
        altitude,
        np.einsum("nij,nj->ni", dcm_ned_ecef, mean(velocity)),
        dcm_ned_ecef @ mean(dcm),
        force,
        _error_roots(middle, dcm_ned_ecef),
    )


def _window_times(bet: Reconstruction) -> FloatArray:
    """Middles of the windows in which the sensors are whole."""
    t_imu, t_bet = bet.imu_time_s, bet.smoothed.time_s
    reach = 0.5 * WINDOW_S + EDGE_S
    first, last = max(t_imu[0], t_bet[0]) + reach, min(t_imu[-1], t_bet[-1]) - reach
    t = np.arange(first, last, WINDOW_S)
    gaps = np.flatnonzero(np.diff(t_imu) > LARGEST_GAP_S)
    whole = np.ones(len(t), dtype=bool)
    for k in gaps:
        whole &= (t + reach < t_imu[k]) | (t - reach > t_imu[k + 1])
    return t[whole]


def _force_means(bet: Reconstruction, arm_body_m: FloatArray, t: FloatArray) -> FloatArray:
    """Specific force at a point ``arm_body_m`` from the accelerometer, body axes, means over the windows."""
    t_imu, rate, half = bet.imu_time_s, bet.rate_body_radps, 0.5 * WINDOW_S
    swing = np.cross(rate, np.cross(rate, arm_body_m))
    force = window_means(t_imu, bet.specific_force_body_mps2 + swing, t - half, t + half)
    ends = [window_means(t_imu, rate, at - EDGE_S, at + EDGE_S) for at in (t - half, t + half)]
    return force + np.cross((ends[1] - ends[0]) / WINDOW_S, arm_body_m)


def _error_roots(trajectory: Trajectory, dcm_ned_ecef: FloatArray) -> FloatArray:
    """Roots (n, 6, 6) of the covariance of velocity and rotation in NED axes."""
    assert trajectory.covariance is not None
    turn = np.zeros((len(trajectory.time_s), 6, 6))
    turn[:, 0:3, 0:3] = dcm_ned_ecef
    turn[:, 3:6, 3:6] = dcm_ned_ecef @ rotations.dcm_from_q(trajectory.q_ecef_body)
    return np.asarray(np.linalg.cholesky(turn @ trajectory.covariance[:, 3:9, 3:9] @ turn.transpose(0, 2, 1)))

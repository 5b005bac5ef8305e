"""What the sensors said at the c.g. once the reconstruction has corrected them: means over windows, gaps left out.

What the air of the day was: windows of the reconstructed flight, assembled for `recon.atmosphere`.

A window is long enough to average the joint's swinging (2.5 Hz), and what it averages of the sensors it averages of
the attitude too, so that the vehicle's own oscillation is smoothed alike on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.loads import PulseData, carried
from flightmodel import earth, rotations
from flightmodel.airdata import AirData, angle_partials, lateral_angles
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory, resample
from recon.atmosphere import AirSamples, Drag, ReconstructedAir, reconstruct_air
from recon.reconstruct import TrajectorySolution

# half the window over which sensors are averaged: well below the joint's 2.5 Hz, well above the sampling interval
HALF_WINDOW_S = 0.05
# the same for the estimators of the deflection, which look at the joint's own swinging: at 1 Hz it leaves 0.5 % of the
# angular acceleration out, at 2.5 Hz 3 %; at least some samples must lie in it
SWING_HALF_WINDOW_S, LEAST_SAMPLES = 0.02, 2.5


def window_means(time_s: FloatArray, values: FloatArray, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Means ``(k, m)`` of piecewise linear ``values`` (n, m) over windows; uneven samples are weighted by time."""
    area = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(0.5 * np.diff(time_s)[:, None] * (values[1:] + values[:-1]), axis=0)]
    )

    def integral(at: FloatArray) -> FloatArray:
        at = np.clip(at, time_s[0], time_s[-1])
        k = np.clip(np.searchsorted(time_s, at, side="right") - 1, 0, len(time_s) - 2)
        h = (at - time_s[k])[:, None]
        slope = (values[k + 1] - values[k]) / (time_s[k + 1] - time_s[k])[:, None]
        return area[k] + values[k] * h + 0.5 * slope * h**2

    width = np.clip(end_s, time_s[0], time_s[-1]) - np.clip(start_s, time_s[0], time_s[-1])
    return (integral(end_s) - integral(start_s)) / np.maximum(width, 1e-9)[:, None]


@dataclass(frozen=True)
class Sensed:
    """Means over a half window to both sides of times (k,), body axes: force at sensor and c.g., rate, its change."""

    specific_force_sensor_mps2: FloatArray
    specific_force_cg_mps2: FloatArray
    rate_radps: FloatArray
    angular_acceleration_radps2: FloatArray
    samples: float


def whole_windows(bet: TrajectorySolution, grid: FloatArray) -> BoolArray:
    """Mask (n,) of times with sensor data to both sides and no telemetry gap near."""
    t_imu, h = bet.imu_time_s, HALF_WINDOW_S
    if len(t_imu) < 2:
        return np.zeros(len(grid), dtype=bool)
    inside = (grid - 2 * h >= t_imu[0]) & (grid + 2 * h <= t_imu[-1])
    nearest = np.searchsorted(t_imu, grid).clip(1, len(t_imu) - 1)
    return np.asarray(inside & (t_imu[nearest] - t_imu[nearest - 1] <= 2.0 * h))


def sensed(bet: TrajectorySolution, t: FloatArray, cg_from_sensor_m: FloatArray, h: float = HALF_WINDOW_S) -> Sensed:
    """What the corrected sensors say at times whose windows, ``h`` s to both sides, are whole."""
    t_imu = bet.imu_time_s
    force = window_means(t_imu, bet.specific_force_body_mps2, t - h, t + h)
    rate = window_means(t_imu, bet.rate_body_radps, t - h, t + h)
    after = window_means(t_imu, bet.rate_body_radps, t, t + 2 * h)
    before = window_means(t_imu, bet.rate_body_radps, t - 2 * h, t)
    turn = (after - before) / (2 * h)
    at_cg = force + carried(rate, turn, cg_from_sensor_m)
    return Sensed(force, at_cg, rate, turn, max(1.0, 2 * h / float(np.median(np.diff(t_imu)))))


def pulse_data(telemetry: Telemetry, bet: TrajectorySolution, air: AirData) -> PulseData:
    """Corrected sensors at the c.g. and the flow, at the BET's even output rate, where no telemetry gap is near."""
    grid = bet.smoothed.time_s
    ticks = grid * bet.output_rate_hz
    inside = whole_windows(bet, grid) & (np.abs(ticks - np.round(ticks)) < 1e-5)
    vehicle, (accelerometer, rates) = telemetry.required_vehicle(), telemetry.required_triads()
    t = grid[inside]
    step = np.median(np.diff(bet.imu_time_s)) if len(bet.imu_time_s) > 1 else 0.0
    h = min(HALF_WINDOW_S, max(SWING_HALF_WINDOW_S, LEAST_SAMPLES * float(step)))
    arm = vehicle.cg_m - accelerometer.spec.position_from_datum_body_m
    at = sensed(bet, t, arm, h)
    velocity = air.velocity_air_body_mps[inside]
    root = bet.accelerometer_root[inside]
    return PulseData(
        time_s=t,
        specific_force_body_mps2=at.specific_force_cg_mps2,
        force_noise_sd_mps2=float(accelerometer.spec.noise_sd / np.sqrt(at.samples)),
        force_root_mps2=root[:, 3:],
        flow_root_rad=angle_partials(velocity) @ rotations.skew(velocity) @ root[:, :3],
        rate_body_radps=at.rate_radps,
        angular_acceleration_body_radps2=at.angular_acceleration_radps2,
        angular_acceleration_sd_radps2=float(np.sqrt(2.0 / at.samples) * rates.spec.noise_sd / (2 * h)),
        flow_yz_rad=lateral_angles(velocity),
        flow_cov=air.lateral_flow_cov[inside],
        wind_flow_sd_rad=air.air.wind_sd_mps[inside] / velocity[:, 0],
        altitude_m=air.altitude_m[inside],
        mach=air.mach[inside],
        dynamic_pressure_pa=air.dynamic_pressure_pa[inside],
        dynamic_pressure_sd_pa=air.dynamic_pressure_sd_pa[inside],
        airspeed_mps=air.airspeed_mps[inside],
        vehicle=vehicle,
        force_clock_sd_s=accelerometer.spec.time_bias_sd_s,
        rate_clock_sd_s=rates.spec.time_bias_sd_s,
        cg_from_sensor_m=arm,
    )


WINDOW_S = 0.4
EDGE_S = 0.05  # half the windows over which rates are averaged at both ends
POINTS = 9  # at which a window's attitude is looked up
LARGEST_GAP_S = 0.1


def day_air(
    telemetry: Telemetry, bet: TrajectorySolution, profile: AtmosphereProfile, confidence: float
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


def air_samples(telemetry: Telemetry, bet: TrajectorySolution) -> AirSamples:
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


def _window_times(bet: TrajectorySolution) -> FloatArray:
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


def _force_means(bet: TrajectorySolution, arm_body_m: FloatArray, t: FloatArray) -> FloatArray:
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

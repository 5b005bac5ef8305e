"""What the sensors said at the c.g. once the reconstruction has corrected them: means over windows, gaps left out."""

from __future__ import annotations

import numpy as np

from estimators.pulse import PulseData
from flightmodel.airdata import AirData, lateral_angles
from flightmodel.checks import FloatArray
from flightmodel.telemetry import Telemetry
from recon.bet import Reconstruction

# half the window over which sensors are averaged: well below the joint's 2.5 Hz, well above the sampling interval
HALF_WINDOW_S = 0.05


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


def pulse_data(telemetry: Telemetry, bet: Reconstruction, air: AirData) -> PulseData:
    """Corrected sensors at the c.g. and the flow, on the BET's time grid, where no telemetry gap is near."""
    t_imu, grid = bet.imu_time_s, bet.smoothed.time_s
    h = HALF_WINDOW_S
    inside = (grid - 2 * h >= t_imu[0]) & (grid + 2 * h <= t_imu[-1])
    nearest = np.searchsorted(t_imu, grid).clip(1, len(t_imu) - 1)
    inside &= t_imu[nearest] - t_imu[nearest - 1] <= 2.0 * h
    t = grid[inside]
    force = window_means(t_imu, bet.specific_force_body_mps2, t - h, t + h)
    rate = window_means(t_imu, bet.rate_body_radps, t - h, t + h)
    after = window_means(t_imu, bet.rate_body_radps, t, t + 2 * h)
    before = window_means(t_imu, bet.rate_body_radps, t - 2 * h, t)
    turn = (after - before) / (2 * h)
    samples = max(1.0, 2 * h / float(np.median(np.diff(t_imu))))
    vehicle, (accelerometer, rates) = telemetry.required_vehicle(), telemetry.required_triads()
    arm = vehicle.cg_m - accelerometer.spec.position_from_datum_body_m
    at_cg = force + np.cross(turn, arm) + np.cross(rate, np.cross(rate, arm))
    white = accelerometer.spec.noise_sd**2 / samples * np.eye(3)
    return PulseData(
        time_s=t,
        specific_force_body_mps2=at_cg,
        specific_force_cov=bet.specific_force_cov[inside] + white,
        rate_body_radps=rate,
        angular_acceleration_body_radps2=turn,
        angular_acceleration_sd_radps2=float(np.sqrt(2.0 / samples) * rates.spec.noise_sd / (2 * h)),
        flow_yz_rad=lateral_angles(air.velocity_air_body_mps[inside]),
        flow_cov=air.lateral_flow_cov[inside],
        mach=air.mach[inside],
        dynamic_pressure_pa=air.dynamic_pressure_pa[inside],
        dynamic_pressure_sd_pa=air.dynamic_pressure_sd_pa[inside],
        airspeed_mps=air.airspeed_mps[inside],
        vehicle=vehicle,
    )

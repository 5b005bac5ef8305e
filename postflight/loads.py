"""What loads did the vehicle fly through, as the estimators of the deflection need them?

Joins the siblings: corrected sensors at the c.g. and air data along the reconstructed trajectory (`recon`) become the
`FlightLoads` of `estimators`, at the trajectory's even output rate and away from telemetry gaps. The sensors are
averaged over a window short enough for the joint's own oscillation,

    f_cg = mean(f) + w' x r + w x (w x r),     w' from the rates half a window apart.
"""

from __future__ import annotations

import numpy as np

from estimators.loads import FlightLoads
from estimators.trim import SLOPE_AT_RAD
from flightmodel import rotations
from flightmodel.airdata import AirData, angle_partials, lateral_angles
from flightmodel.telemetry import Telemetry
from flightmodel.vehicle import Vehicle
from recon.atmosphere import HALF_WINDOW_S, cg_accelerations, windows_are_whole
from recon.reconstruct import TrajectorySolution

# of the angular acceleration this half window leaves out 0.5 % at 1 Hz and 3 % at 2.5 Hz; so does a shorter one of a
# vehicle that pitches and spins faster. At least some samples must lie in it
_HALF_WINDOW_S, _MOST_TURN_RAD, _LEAST_SAMPLES = 0.02, 0.31, 2.5


def loads_from_solution(telemetry: Telemetry, bet: TrajectorySolution, air: AirData) -> FlightLoads:
    """Corrected sensors at the c.g. and the flow, at the trajectory's even output rate, where no telemetry gap is near.

    Parameters
    ----------
    telemetry : Telemetry
        With a vehicle and inertial sensors.
    bet : TrajectorySolution
    air : AirData
        At the times of the smoothed trajectory.

    Raises
    ------
    GateError
        Where there is no vehicle or no inertial sensor.
    """
    grid = bet.smoothed.time_s
    ticks = grid * bet.output_rate_hz
    inside = windows_are_whole(bet, grid) & (np.abs(ticks - np.round(ticks)) < 1e-5)
    whole, (accelerometer, rates) = telemetry.required_vehicle(), telemetry.required_triads()
    # where mass properties change in flight: those at peak pressure, and only while they hold
    peak_s = float(grid[np.nanargmax(air.dynamic_pressure_pa)])
    begins, ends, vehicle = next(p for p in whole.phases(-np.inf, np.inf) if p[0] <= peak_s < p[1])
    inside &= (grid >= begins) & (grid < ends)
    t = grid[inside]
    step = np.median(np.diff(bet.imu_time_s)) if len(bet.imu_time_s) > 1 else 0.0
    turning_radps = fastest_radps(vehicle, bet, air)
    wanted = _HALF_WINDOW_S if turning_radps <= 0.0 else min(_HALF_WINDOW_S, _MOST_TURN_RAD / turning_radps)
    h = min(HALF_WINDOW_S, max(wanted, _LEAST_SAMPLES * float(step)))
    arm = vehicle.cg_m - accelerometer.spec.position_from_datum_body_m
    at = cg_accelerations(bet, t, arm, h)
    velocity = air.velocity_air_body_mps[inside]
    root = bet.triad_root[inside]
    return FlightLoads(
        time_s=t,
        specific_force_body_mps2=at.specific_force_cg_mps2,
        force_noise_sd_mps2=float(accelerometer.spec.noise_sd / np.sqrt(at.samples)),
        force_root_mps2=root[:, 3:6],
        rate_root_radps=root[:, 6:9],
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
        point_from_datum_m=vehicle.cg_m,
        accelerometer_time_bias_sd_s=accelerometer.spec.time_bias_sd_s,
        gyro_time_bias_sd_s=rates.spec.time_bias_sd_s,
        cg_from_sensor_m=arm,
        half_window_s=h,
        swing_radps=turning_radps,
    )


def fastest_radps(vehicle: Vehicle, bet: TrajectorySolution, air: AirData) -> float:
    """Rate, rad/s, at which the transverse rates turn in body axes: rigid pitching at peak pressure, and spin there."""
    peak = int(np.nanargmax(air.dynamic_pressure_pa))
    _, normal, moment, _ = vehicle.aero.at(air.mach[peak], SLOPE_AT_RAD) / SLOPE_AT_RAD
    restoring_m = -(moment * vehicle.reference.length_m - normal * vehicle.cg_m[0])
    inertia = 0.5 * (vehicle.inertia[1, 1] + vehicle.inertia[2, 2])
    square = air.dynamic_pressure_pa[peak] * vehicle.reference.area_m2 * restoring_m / inertia
    spin = np.interp(bet.smoothed.time_s[peak], bet.imu_time_s, bet.rate_body_radps[:, 0])
    return float(np.sqrt(max(square, 0.0)) + abs(spin))

"""From a flight folder to answers: read, reconstruct, see the air, estimate the deflection three ways.

Nothing here opens ``truth/``; only `postflight.scoring` does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from estimators.camera_deflection import deflection_from_frames, read_frame, sensitivity_table
from estimators.misalignment import estimate_misalignment
from estimators.pulse import PulseData
from estimators.trim import estimate_trim
from flightmodel.airdata import AirData, air_data, lateral_angles, peak_pressure
from flightmodel.atmosphere import BOTTOM_M, TOP_M, profile_from_sounding
from flightmodel.checks import DivergenceError, FloatArray, GateError
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import geodetic_from_ecef
from flightmodel.flightfolder import read_flight
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory
from recon.bet import Reconstruction, Settings, reconstruct

Progress = Callable[[float, str], None]
METHODS = ("camera", "misalignment", "trim")
NO_VIDEO = "the flight has no video"
# assumed plane, and the deflection that the paper read in it from the frame at 440 s (Table 2.1)
PAPER_TABLE_2_1_DEG = {153.0: 4.2, 183.0: 5.8, 200.0: 6.2}
# half the window over which sensors are averaged: well below the joint's 2.5 Hz, well above the sampling interval
HALF_WINDOW_S = 0.05


@dataclass(frozen=True)
class Flight:
    """A flight with its reconstruction and the air it met."""

    telemetry: Telemetry
    reconstruction: Reconstruction
    air: AirData
    pulse: PulseData

    @property
    def peak_s(self) -> float:
        """Time of peak dynamic pressure by the BET and the day's density, s."""
        return peak_pressure(self.air.time_s, self.air.dynamic_pressure_pa)[0]

    @property
    def peak_is_inside(self) -> bool:
        """Whether the largest dynamic pressure is a peak, not the first or last second of the data."""
        return self.air.time_s[0] + 1.0 < self.peak_s < self.air.time_s[-1] - 1.0


@dataclass(frozen=True)
class Answers:
    """Deflection histories by method, and why a method gave none."""

    histories: dict[str, DeflectionHistory] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)


def reconstruct_flight(folder: Path, settings: Settings | None = None, progress: Progress | None = None) -> Flight:
    """Read a flight folder and reconstruct it; `ConfigError` or `GateError` where the data cannot be used."""
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "reading telemetry")
    telemetry = read_flight(folder)
    return reconstruct_telemetry(telemetry, settings, lambda f, what: report(0.1 + 0.9 * f, what))


def reconstruct_telemetry(
    telemetry: Telemetry, settings: Settings | None = None, progress: Progress | None = None
) -> Flight:
    """Reconstruct a flight that was read already."""
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "reconstructing")
    bet = reconstruct(telemetry, settings, lambda f, what: report(0.95 * f, what))
    profile = profile_from_sounding(telemetry.sounding)
    _check_flown(bet.smoothed)
    air = air_data(bet.smoothed, profile, telemetry.required_vehicle().cg_m)
    report(1.0, "reconstructed")
    return Flight(telemetry, bet, air, pulse_data(telemetry, bet, air))


def _check_flown(trajectory: Trajectory) -> None:
    """Raise `DivergenceError` where the reconstruction left the ground or the atmosphere's tables."""
    _, _, altitude_m = geodetic_from_ecef(trajectory.position_ecef_m)
    wrong = (altitude_m < BOTTOM_M) | (altitude_m > TOP_M)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DivergenceError(
            f"reconstruction: diverged: at {trajectory.time_s[k]:.1f} s the altitude is {altitude_m[k] / 1000:.1f} km. "
            "Check the accelerometer's and gyros' units, signs and mounting, and the attitude prior"
        )


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


def estimate_camera(
    telemetry: Telemetry, plane_lv_rad: float | None = None, joint_station_m: float | None = None
) -> DeflectionHistory:
    """Deflection from the onboard video, in an assumed plane or with the plane found in every frame.

    Raises
    ------
    GateError
        Where there is no video or it cannot be used.
    """
    frames = telemetry.frames
    if frames is None:
        raise GateError(NO_VIDEO)
    vehicle = telemetry.required_vehicle()
    return deflection_from_frames(
        frames.time_s,
        frames.paths,
        vehicle.geometry,
        frames.camera,
        vehicle.joint.station_m if joint_station_m is None else joint_station_m,
        benchmark_time_s=frames.benchmark_s,
        plane_lv_rad=plane_lv_rad,
    )


def camera_sensitivity(telemetry: Telemetry, history: DeflectionHistory) -> pd.DataFrame:
    """Deflection read from the frame of the largest one under other assumptions: the seed paper's Table 2.1.

    Columns ``joint_station_m, plane_lv_deg, deflection_deg, paper_deg``. It need not equal the paper's column: one
    camera sees the component towards it, and the shell and lens are not IRVE-II's.
    """
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    straight, bent = (read_frame(frames.paths[k]) for k in (frames.benchmark, int(np.nanargmax(history.theta_rad))))
    stations = np.array([0.0, vehicle.joint.station_m])
    planes = np.deg2rad(list(PAPER_TABLE_2_1_DEG))
    angles = sensitivity_table(straight, bent, vehicle.geometry, frames.camera, planes, stations)
    rows = [
        (station, plane, np.rad2deg(angle), paper)
        for station, line in zip(stations, angles, strict=True)
        for (plane, paper), angle in zip(PAPER_TABLE_2_1_DEG.items(), line, strict=True)
    ]
    return pd.DataFrame(rows, columns=["joint_station_m", "plane_lv_deg", "deflection_deg", "paper_deg"])


def estimate(
    flight: Flight | None,
    telemetry: Telemetry,
    methods: tuple[str, ...],
    progress: Progress | None = None,
    plane_lv_rad: float | None = None,
    joint_station_m: float | None = None,
) -> Answers:
    """Run the estimators asked for; one that cannot answer says why, and does not stop the others.

    ``flight`` may be None where only the camera is asked for. Plane and joint are assumptions of camera and trim.
    """
    report = progress or (lambda _fraction, _what: None)
    histories, refused = {}, {}
    for k, method in enumerate(methods):
        report(k / len(methods), f"deflection from {method}")
        try:
            if method == "camera":
                history = estimate_camera(telemetry, plane_lv_rad, joint_station_m)
            else:
                assert flight is not None
                pulse = flight.pulse
                history = (
                    estimate_misalignment(pulse) if method == "misalignment" else estimate_trim(pulse, joint_station_m)
                )
        except GateError as fault:
            refused[method] = str(fault)
            continue
        if np.isfinite(history.theta_rad).any():
            histories[method] = history
        else:
            refused[method] = f"no sample could be answered ({history.assumptions})"
    report(1.0, "estimated")
    return Answers(histories, refused)

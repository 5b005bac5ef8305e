"""From a flight folder to answers: read, reconstruct, see the air, estimate the deflection three ways.

A flight whose vehicle or inertial sensors are not known still has a trajectory; what it cannot have says why.

Nothing here opens ``truth/``; only `postflight.score` does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from estimators.benchmark import benchmark_bending
from estimators.camera import ReadFilm, read_film, sensitivity_table
from estimators.fusion import smoothed
from estimators.loads import PulseData
from estimators.misalignment import estimate_misalignment
from estimators.trim import estimate_trim
from flightmodel.airdata import AirData, air_data, peak_pressure
from flightmodel.atmosphere import BOTTOM_M, TOP_M, profile_from_sounding
from flightmodel.checks import DivergenceError, GateError, Progress
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import geodetic_from_ecef
from flightmodel.flightfolder import read_flight
from flightmodel.telemetry import Finding, Telemetry
from flightmodel.trajectory import Trajectory
from postflight.attitude import AttitudeCheck, check_attitude
from postflight.fusing import FusedAnswer, fuse_flight
from postflight.loads import day_air, pulse_data
from recon.atmosphere import ReconstructedAir
from recon.consistency import ConsistencyCheck
from recon.fault_isolation import isolate_faults
from recon.reconstruct import TrajectorySolution, reconstruct
from recon.settings import Settings

METHODS = ("camera", "misalignment", "trim", "fused")
PULSE_RATE_HZ = 50.0
NO_VIDEO = "the flight has no video"
# assumed plane, and the deflection that the paper read in it from the frame at 440 s (Table 2.1)
PAPER_TABLE_2_1_DEG = {153.0: 4.2, 183.0: 5.8, 200.0: 6.2}


@dataclass(frozen=True)
class Flight:
    """A flight with its reconstruction and the air it met; ``missing`` says why there is no pulse or no air of the day.

    ``air`` is the sounding's along the trajectory; ``day`` is what the deceleration adds to it; ``attitude`` is what
    magnetometer and Sun sensors say alone.
    """

    telemetry: Telemetry
    reconstruction: TrajectorySolution
    air: AirData
    pulse: PulseData | None
    day: ReconstructedAir | None = None
    missing: tuple[str, ...] = ()
    attitude: AttitudeCheck | None = None

    @property
    def consistency_checks(self) -> tuple[ConsistencyCheck, ...]:
        """Verdicts on the trajectory, then on its attitude, then on the air."""
        attitude, day = (part.consistency_checks if part is not None else () for part in (self.attitude, self.day))
        return self.reconstruction.consistency_checks + attitude + day

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found in the data, on the way, and by the check of the attitude."""
        attitude = () if self.attitude is None else self.attitude.findings
        return (*self.telemetry.findings, *self.reconstruction.findings, *attitude)

    @property
    def suspects(self) -> tuple[str, ...]:
        """What is most likely wrong, the first first; none where every verdict passes."""
        return isolate_faults(self.consistency_checks, self.reconstruction.left_out)

    @property
    def has_attitude(self) -> bool:
        """Whether inertial sensors carried the attitude; in ballistic flight it is not known."""
        return self.reconstruction.provenance["motion"] != "ballistic"

    def required_pulse(self) -> PulseData:
        """Sensors and flow at the c.g.; `GateError` with the reason where there are none."""
        if self.pulse is None:
            raise GateError("; ".join(self.missing))
        return self.pulse

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
    """Deflection histories by method, why a method gave none, and what stands behind the fused one.

    ``smooth_camera`` is the camera's alone as a second-order process, where it found the plane.
    """

    histories: dict[str, DeflectionHistory] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    fused: FusedAnswer | None = None
    smooth_camera: DeflectionHistory | None = None


def reconstruct_flight(folder: Path, settings: Settings | None = None, progress: Progress | None = None) -> Flight:
    """Read a flight folder and reconstruct it; `ConfigError` or `GateError` where the data cannot be used."""
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "reading telemetry")
    telemetry = read_flight(folder, lambda f: report(0.1 * f, "reading telemetry"))
    return reconstruct_telemetry(telemetry, settings, lambda f, what: report(0.1 + 0.9 * f, what))


def reconstruct_telemetry(
    telemetry: Telemetry, settings: Settings | None = None, progress: Progress | None = None
) -> Flight:
    """Reconstruct a flight that was read already."""
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "reconstructing")
    settings = settings or Settings(pulse_rate_hz=PULSE_RATE_HZ)
    bet = reconstruct(telemetry, settings, lambda f, what: report(0.95 * f, what))
    report(0.95, "checking the attitude")
    attitude = check_attitude(telemetry, bet)
    report(0.97, "finding the air of the day")
    flight = replace(flight_from(telemetry, bet), attitude=attitude)
    report(1.0, "reconstructed")
    return flight


def flight_from(telemetry: Telemetry, bet: TrajectorySolution) -> Flight:
    """Air data, pulse and air of the day along a trajectory; `DivergenceError` where it leaves the air's tables."""
    profile = profile_from_sounding(telemetry.sounding)
    _check_flown(bet.smoothed)
    vehicle = telemetry.vehicle
    air = air_data(bet.smoothed, profile, np.zeros(3) if vehicle is None else vehicle.cg_m)
    pulse, day, missing = None, None, []
    try:
        telemetry.required_vehicle()
        telemetry.required_triads()
        pulse = pulse_data(telemetry, bet, air)
        day = day_air(telemetry, bet, profile, bet.settings.check_confidence)
    except GateError as fault:
        missing.append(str(fault))
    return Flight(telemetry, bet, air, pulse, day, tuple(missing))


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


def estimate_camera(
    telemetry: Telemetry,
    plane_lv_rad: float | None = None,
    joint_station_m: float | None = None,
    progress: Progress | None = None,
) -> DeflectionHistory:
    """Deflection from the onboard video, in an assumed plane or with the plane found in every frame.

    The benchmark frame is taken as not bent; `told_by_the_joint` knows better where there are inertial sensors.

    Raises
    ------
    GateError
        Where there is no video or it cannot be used.
    """
    return camera_film(telemetry, plane_lv_rad, joint_station_m, progress).history()


def camera_film(
    telemetry: Telemetry,
    plane_lv_rad: float | None = None,
    joint_station_m: float | None = None,
    progress: Progress | None = None,
) -> ReadFilm:
    """What the onboard video shows, frame by frame; `GateError` where there is none or it cannot be used."""
    frames = telemetry.frames
    if frames is None:
        raise GateError(NO_VIDEO)
    vehicle = telemetry.required_vehicle()
    return read_film(
        frames.time_s,
        frames.pictures(),
        vehicle.geometry,
        frames.camera,
        vehicle.joint.station_m if joint_station_m is None else joint_station_m,
        benchmark_time_s=frames.benchmark_s,
        plane_lv_rad=plane_lv_rad,
        benchmark=frames.picture(frames.benchmark),
        progress=progress,
    )


def told_by_the_joint(film: ReadFilm, flight: Flight | None, telemetry: Telemetry) -> DeflectionHistory:
    """Camera's history with the benchmark frame as bent as the moment in the joint says; as not bent without one.

    Why there is none stands in the history's words.
    """
    try:
        if flight is None:
            telemetry.required_triads()
            raise GateError("no trajectory was made")
        clock_sd_s = 0.0 if telemetry.frames is None else telemetry.frames.time_bias_sd_s
        frames = film.against_benchmark(clock_sd_s)
        return film.history(benchmark_bending(frames, flight.required_pulse(), film.oriented.held.benchmark_rad))
    except GateError as fault:
        plain = film.history()
        words = f"{plain.assumptions}; the benchmark's bending is not told by the joint ({fault})"
        return replace(plain, assumptions=words)


def camera_sensitivity(telemetry: Telemetry, history: DeflectionHistory) -> pd.DataFrame:
    """Deflection read from the frame of the largest one under other assumptions: the seed paper's Table 2.1.

    Columns ``joint_station_m, plane_lv_deg, deflection_deg, paper_deg``. It need not equal the paper's column: one
    camera sees the component towards it, and the shell and lens are not IRVE-II's.
    """
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    straight, bent = (frames.picture(k) for k in (frames.benchmark, int(np.nanargmax(history.theta_rad))))
    stations = np.array([0.0, vehicle.joint.station_m])
    planes = np.deg2rad(list(PAPER_TABLE_2_1_DEG))
    angles = sensitivity_table(straight, bent, vehicle.geometry, frames.camera, planes, stations)
    rows = [
        (station, plane, np.rad2deg(angle), paper)
        for station, line in zip(stations, angles, strict=True)
        for (plane, paper), angle in zip(PAPER_TABLE_2_1_DEG.items(), line, strict=True)
    ]
    return pd.DataFrame(rows, columns=["joint_station_m", "plane_lv_deg", "deflection_deg", "paper_deg"])


def _part(report: Progress, number: int, parts: int) -> Progress:
    """Report the progress of one of several parts as progress of the whole."""
    return lambda fraction, what: report((number + fraction) / parts, what)


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
    histories: dict[str, DeflectionHistory] = {}
    refused: dict[str, str] = {}
    fused, plain = None, None
    for k, method in enumerate(methods):
        report(k / len(methods), f"deflection from {method}")
        try:
            if method == "camera":
                film = camera_film(telemetry, plane_lv_rad, joint_station_m, _part(report, k, len(methods)))
                # the fusion finds the benchmark's bending itself, from the same sensors: it is given the plain history
                plain, history = film.history(), told_by_the_joint(film, flight, telemetry)
            else:
                assert flight is not None
                pulse = flight.required_pulse()
                if method == "misalignment":
                    history = estimate_misalignment(pulse)
                elif method == "trim":
                    history = estimate_trim(pulse, joint_station_m)
                else:
                    seen = plain if "camera" in histories else _seen(telemetry, refused, plane_lv_rad)
                    film_clock_s = 0.0 if telemetry.frames is None else telemetry.frames.time_bias_sd_s
                    fused = fuse_flight(pulse, seen, joint_station_m, film_clock_s)
                    history = fused.fused.history
        except GateError as fault:
            refused[method] = str(fault)
            continue
        answered = np.isfinite(history.theta_rad)
        if method == "camera" and answered.any() and not answered[film.time_s != film.benchmark_s].any():
            refused[method] = f"no frame but the benchmark frame can be used ({history.assumptions})"
        elif answered.any():
            histories[method] = history
        else:
            refused[method] = f"no sample could be answered ({history.assumptions})"
    report(1.0, "estimated")
    smooth = None
    if "camera" in histories and plane_lv_rad is None:
        try:
            smooth = smoothed(histories["camera"])
        except DivergenceError:
            smooth = None  # a few frames are no history
    return Answers(histories, refused, fused, smooth)


def _seen(telemetry: Telemetry, refused: dict[str, str], plane_lv_rad: float | None) -> DeflectionHistory | None:
    """Camera's history for the fusion, found now; None without usable video."""
    if "camera" in refused or telemetry.frames is None:
        return None
    try:
        return estimate_camera(telemetry, plane_lv_rad)
    except GateError:
        return None

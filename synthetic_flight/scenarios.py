"""What is flown? A scenario file with its vehicle, and its true flight with the atmosphere of one seed.

A scenario gives start, end and steps, the initial state of the composite c.g. ``(r, v, q, omega)`` at zero deflection,
the day-of-flight atmosphere and the instruments. Every random part draws from ``SeedSequence(seed, spawn_key=name)``
with a name of its own, so that one instrument more or less leaves the others' noise as it is. Files are checked whole:
one refusal names every fault.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from flightmodel import earth, rotations
from flightmodel.checks import ConfigError, FloatArray, GateError, Issue, check_type, nearest_name
from flightmodel.config import (
    Angle,
    Duration,
    Elevation,
    KeyFault,
    Label,
    Latitude,
    Longitude,
    Name,
    Section,
    Time,
    parse_section,
    parse_utc,
    read_toml,
)
from flightmodel.vehicle import Vehicle, path_of, shipped, vehicle_from_toml, vehicle_path
from synthetic_flight.instrument_errors import (
    Accelerometer,
    Attitude,
    Gnss,
    Magnetometer,
    Radar,
    Rates,
    SunSensors,
    Triad,
    Video,
    name_key,
)
from synthetic_flight.simulate import Truth, fly, state_from_ecef
from synthetic_flight.weather import DayOfFlightAtmosphere, MeanAir, day_of_flight_atmosphere, mean_air

Altitude = Annotated[float, Field(ge=0.0, le=1e6)]
MOST_RECORDS, MOST_STEPS, MOST_SAMPLES, MOST_FRAMES = 5_000_000, 2_000_000_000, 5_000_000, 20_000


class TimeSpan(Section):
    """Start and stop times of the flight, and its integration and recording steps, s."""

    start_s: Time
    stop_s: Time
    inflated_s: Time | None = None
    telemetry_from_s: Time
    step_s: Duration = 0.002
    record_s: Duration = 0.004

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        span, record, step = self.stop_s - self.start_s, self.record_s, self.step_s
        if not self.start_s <= self.telemetry_from_s < self.stop_s:
            words = f"start_s = {self.start_s:g} <= telemetry_from_s < stop_s = {self.stop_s:g} is wanted"
            yield "telemetry_from_s", self.telemetry_from_s, words
        if span <= 0.0:
            yield "stop_s", self.stop_s, f"after start_s = {self.start_s:g} is wanted"
            return
        if not _is_whole(record / step):
            words = f"a whole multiple of step_s = {step:g} is wanted; try {max(1, round(record / step)) * step:.12g}"
            yield "record_s", record, words
        if not _is_whole(span / record):
            words = f"a whole part of the flight of {span:g} s is wanted; try {span / max(1, round(span / record)):.9g}"
            yield "record_s", record, f"{words}, or another stop_s"
        if span / record > MOST_RECORDS:
            words = f"{span / record:.2g} records, {span / record * 304e-9:.1f} GB, where {MOST_RECORDS} are the most"
            yield "record_s", record, f"{words}; at least {span / MOST_RECORDS:.2g} s is wanted"
        if span / step > MOST_STEPS:
            words = f"{span / step:.2g} steps, hours of computing, where {MOST_STEPS:.0e} are the most"
            yield "step_s", step, f"{words}; at least {span / MOST_STEPS:.2g} s is wanted"


def _is_whole(ratio: float) -> bool:
    return ratio > 0.5 and abs(ratio - round(ratio)) < 1e-6 * max(1.0, ratio * 1e-3)


class Initial(Section):
    """Composite c.g. at the start: place, velocity relative to the Earth, nose direction in north-east-down, spin."""

    latitude_deg: Latitude
    longitude_deg: Longitude
    altitude_m: Altitude
    speed_mps: Annotated[float, Field(ge=1.0, le=2e4)]
    flight_path_deg: Elevation
    azimuth_deg: Angle
    nose_azimuth_deg: Angle
    nose_elevation_deg: Elevation
    roll_deg: Angle = 0.0
    spin_rpm: Annotated[float, Field(ge=-1000.0, le=1000.0)] = 0.0


class EventOfFlight(Section):
    """Named event, written to flight.toml; mass steps of the vehicle may refer to it."""

    name: Label
    t_s: Time


INFLATED = "aeroshell inflated"  # event of `TimeSpan.inflated_s`


class ScenarioFile(Section):
    """Complete content of a scenario file."""

    name: str
    t0_utc: str
    vehicle: str
    time: TimeSpan
    initial: Initial
    events: tuple[EventOfFlight, ...] = ()
    atmosphere: DayOfFlightAtmosphere
    accelerometer: Accelerometer
    rates: Rates
    radars: dict[Name, Radar] = {}
    gnss: dict[Name, Gnss] = {}
    magnetometer: Magnetometer | None = None
    sun: SunSensors | None = None
    video: Video | None = None
    videos: dict[Name, Video] = {}
    attitude_prior: Attitude

    @field_validator("t0_utc")
    @classmethod
    def _parses(cls, value: str) -> str:
        try:
            parse_utc(value)
        except (ValueError, OverflowError):
            raise ValueError("an ISO 8601 time such as 2009-08-17T12:52:00Z is wanted") from None
        return value

    @property
    def event_times(self) -> list[tuple[str, float]]:
        """Named events with their times, s, inflation among them."""
        inflated = [] if self.time.inflated_s is None else [(INFLATED, self.time.inflated_s)]
        return inflated + [(event.name, event.t_s) for event in self.events]

    @property
    def films(self) -> dict[str, Video]:
        """Every camera's film, by its table in the scenario: ``video``, or ``videos.NAME``."""
        alone = {} if self.video is None else {"video": self.video}
        return alone | {f"videos.{name}": video for name, video in self.videos.items()}

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        start, stop = self.time.telemetry_from_s, self.time.stop_s
        words = f"a time of the telemetry, {start:g} to {stop:g} s, is wanted"
        if not self.radars and not self.gnss:
            yield "radars", "", "at least one tracker is wanted: a table [radars.NAME] or [gnss.NAME]"
        for name in sorted(self.gnss.keys() & self.radars.keys()):
            yield f"gnss.{name}", "", "a radar has this name; results go by name"
        if not start <= self.attitude_prior.t_s <= stop:
            yield "attitude_prior.t_s", self.attitude_prior.t_s, words
        instruments: dict[str, Triad | SunSensors | Radar | Gnss | None] = {
            "accelerometer": self.accelerometer,
            "rates": self.rates,
            "magnetometer": self.magnetometer,
            "sun": self.sun,
            **{f"radars.{name}": radar for name, radar in self.radars.items()},
            **{f"gnss.{name}": receiver for name, receiver in self.gnss.items()},
        }
        for name, part in instruments.items():
            if part is not None:
                offset = part.offset_s if isinstance(part, Radar | Gnss) else 0.0
                yield from _rate_faults(name, part.rate_hz, stop - start - offset)
        if self.video is not None and self.videos:
            yield "video", "", "write one camera in [video], several in [videos.NAME]"
        for table, video in self.films.items():
            for key in ("start_s", "stop_s"):
                if not start <= getattr(video, key) <= stop:
                    yield f"{table}.{key}", getattr(video, key), words
            count = (video.stop_s - video.start_s) * video.rate_hz
            if count > MOST_FRAMES:
                yield f"{table}.rate_hz", video.rate_hz, f"{count:.2g} frames, at most {MOST_FRAMES}"


def _rate_faults(name: str, rate_hz: float, span_s: float) -> Iterable[KeyFault]:
    count = rate_hz * span_s
    if count > MOST_SAMPLES:
        yield f"{name}.rate_hz", rate_hz, f"{count:.2g} samples, at most {MOST_SAMPLES}; lower the rate"
    if count < 2.0:
        yield f"{name}.rate_hz", rate_hz, f"fewer than three samples in the telemetry's {span_s:g} s; raise the rate"


@dataclass(frozen=True)
class Scenario:
    """A scenario file with its vehicle."""

    spec: ScenarioFile
    vehicle: Vehicle
    source: Path

    @property
    def mean_air(self) -> MeanAir:
        """Mean atmosphere of the flight's place and day, before any random structure."""
        north, east = np.deg2rad([self.spec.initial.latitude_deg, self.spec.initial.longitude_deg])
        return mean_air(self.spec.atmosphere, self.source.parent, self.spec.t0_utc, float(north), float(east))


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that ship with the toolkit."""
    return shipped("scenario")


def read_scenario(name: str | Path) -> Scenario:
    """Read a scenario: a path to a TOML file, or the name of one that ships with the toolkit."""
    check_type("scenario", name, (str, Path), "a shipped name or the path of a TOML file")
    path = path_of("scenario", str(name), "name-unknown")
    tables = read_toml(path)
    spec, vehicle = None, None
    faults: list[Issue] = []
    try:
        spec = parse_section(ScenarioFile, tables, str(path))
    except ConfigError as fault:
        faults += fault.faults
    try:
        if isinstance(tables.get("vehicle"), str):
            vehicle = vehicle_from_toml(vehicle_path(tables["vehicle"], path.parent))
    except GateError as fault:
        if spec is not None:
            raise
        faults += fault.faults
    if spec is not None and vehicle is not None:
        faults += _vehicle_faults(spec, vehicle, path)
        if not faults:
            return Scenario(spec, vehicle.with_events(spec.event_times), path)
    raise ConfigError(faults)


def _vehicle_faults(spec: ScenarioFile, vehicle: Vehicle, path: Path) -> list[Issue]:
    """Return which sensor packages and cameras the scenario ``path`` needs and the vehicle lacks."""
    packages, cameras = list(vehicle.sensors), list(vehicle.cameras)
    faults = []
    needed = [("accelerometer.mount", spec.accelerometer.mount, packages, "sensors")]
    if spec.magnetometer is not None:
        needed.append(("magnetometer.mount", spec.magnetometer.mount, packages, "sensors"))
    needed += [(f"{table}.camera", video.camera, cameras, "cameras") for table, video in spec.films.items()]
    for key, name, known, table in needed:
        if name not in known:
            hint = f"{nearest_name(name, known)}; known there: {', '.join(known) or 'none'}"
            message = f"{path}: key '{key}' = {name!r}: {vehicle.source} has no [{table}.{name}]{hint}"
            faults.append(Issue(message, "name-unknown"))
    return faults


def child_rng(seed: int, name: str) -> np.random.Generator:
    """Return the generator of one instrument: adding another instrument does not change its noise."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=name_key(name)))


def initial_state(scenario: Scenario) -> FloatArray:
    """State (20,) at the scenario's start, joint undeflected."""
    spec, start = scenario.spec.initial, scenario.spec.time.start_s
    lat, lon, path, azimuth = np.deg2rad(
        [spec.latitude_deg, spec.longitude_deg, spec.flight_path_deg, spec.azimuth_deg]
    )
    nose_az, nose_el, roll = np.deg2rad([spec.nose_azimuth_deg, spec.nose_elevation_deg, spec.roll_deg])
    position = earth.ecef_from_geodetic(lat, lon, spec.altitude_m)
    heading = np.array([np.cos(path) * np.cos(azimuth), np.cos(path) * np.sin(azimuth), -np.sin(path)])
    velocity = earth.ecef_from_ned(spec.speed_mps * heading, position)
    # ECEF from north-east-down, then azimuth, elevation, roll of the nose
    turns = [(2, lon), (1, -0.5 * np.pi - lat), (2, nose_az), (1, nose_el), (0, roll)]
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in turns:
        q = rotations.multiply(q, rotations.exp(angle * np.eye(3)[axis]))
    omega = np.array([spec.spin_rpm * 2.0 * np.pi / 60.0, 0.0, 0.0])
    return state_from_ecef(start, position, velocity, q, omega)


def fly_scenario(scenario: Scenario, seed: int) -> Truth:
    """Fly a scenario with the day-of-flight atmosphere that ``seed`` draws."""
    spec, time = scenario.spec, scenario.spec.time
    profile = day_of_flight_atmosphere(spec.atmosphere, child_rng(seed, "atmosphere"), scenario.mean_air)
    return fly(
        scenario.vehicle,
        profile,
        initial_state(scenario),
        time.start_s,
        time.stop_s,
        spec.t0_utc,
        time.step_s,
        time.record_s,
        time.inflated_s,
    )

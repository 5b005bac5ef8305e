"""What is to be flown: a scenario file, its vehicle, and the flight of it on a day that a seed draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from flightmodel import earth, rotations
from flightmodel.checks import ConfigError, FloatArray, nearest_name
from flightmodel.config import Section, parse_section, read_toml
from flightmodel.vehicle import DATA, Vehicle, vehicle_from_toml, vehicle_path
from synthetic_flight.day_air import DayAtmosphere, day_atmosphere
from synthetic_flight.instrument_sections import (
    Accelerometer,
    Attitude,
    Magnetometer,
    Radar,
    Rates,
    SunSensors,
    Video,
)
from synthetic_flight.simulate import Truth, fly, state_from_ecef

NonNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]


class TimeSpan(Section):
    """When the flight starts and stops, and how finely it is integrated and recorded, s."""

    start_s: float
    stop_s: float
    inflated_s: float | None = None
    telemetry_from_s: float
    step_s: Positive = 0.002
    record_s: Positive = 0.004

    @model_validator(mode="after")
    def _ordered(self) -> TimeSpan:
        if not self.start_s <= self.telemetry_from_s < self.stop_s:
            raise ValueError("start_s <= telemetry_from_s < stop_s is wanted")
        return self


class Initial(Section):
    """Composite c.g. at the start: place, velocity relative to the Earth, nose direction in north-east-down, spin."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    speed_mps: Positive
    flight_path_deg: float
    azimuth_deg: float
    nose_azimuth_deg: float
    nose_elevation_deg: float
    roll_deg: float = 0.0
    spin_rpm: float = 0.0


class ScenarioFile(Section):
    """The whole of a scenario file."""

    name: str
    t0_utc: str
    vehicle: str
    time: TimeSpan
    initial: Initial
    atmosphere: DayAtmosphere
    accelerometer: Accelerometer
    rates: Rates
    radars: dict[str, Radar]
    magnetometer: Magnetometer | None = None
    sun: SunSensors | None = None
    video: Video | None = None
    attitude_prior: Attitude


@dataclass(frozen=True)
class Scenario:
    """A scenario file with its vehicle."""

    spec: ScenarioFile
    vehicle: Vehicle
    source: Path


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that ship with the toolkit."""
    return sorted(p.stem for p in (DATA / "scenarios").glob("*.toml"))


def read_scenario(name: str) -> Scenario:
    """Read a scenario: a path to a TOML file, or the name of one that ships with the toolkit."""
    path = Path(name) if name.endswith(".toml") else DATA / "scenarios" / f"{name}.toml"
    if not path.exists():
        shipped = shipped_scenarios()
        raise ConfigError(f"no scenario '{name}'{nearest_name(name, shipped)}; shipped: {', '.join(shipped)}")
    spec = parse_section(ScenarioFile, read_toml(path), str(path))
    return Scenario(spec, vehicle_from_toml(vehicle_path(spec.vehicle, path.parent)), path)


def child_rng(seed: int, name: str) -> np.random.Generator:
    """Return the generator of one instrument: adding another instrument does not change its noise."""
    key = [int.from_bytes(name.encode()[i : i + 4], "big") for i in range(0, len(name.encode()), 4)]
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def initial_state(scenario: Scenario) -> FloatArray:
    """State (20,) at the scenario's start, joint straight."""
    spec, start = scenario.spec.initial, scenario.spec.time.start_s
    lat, lon, path, azimuth, nose_az, nose_el, roll = np.deg2rad(
        [
            spec.latitude_deg,
            spec.longitude_deg,
            spec.flight_path_deg,
            spec.azimuth_deg,
            spec.nose_azimuth_deg,
            spec.nose_elevation_deg,
            spec.roll_deg,
        ]
    )
    position = earth.ecef_from_geodetic(lat, lon, spec.altitude_m)
    heading = np.array([np.cos(path) * np.cos(azimuth), np.cos(path) * np.sin(azimuth), -np.sin(path)])
    velocity = earth.ecef_from_ned(spec.speed_mps * heading, position)
    nose = np.array([np.cos(nose_el) * np.cos(nose_az), np.cos(nose_el) * np.sin(nose_az), -np.sin(nose_el)])
    right = np.array([-np.sin(nose_az), np.cos(nose_az), 0.0])
    q_ned_body = rotations.q_from_dcm(np.column_stack([nose, right, np.cross(nose, right)])[None])[0]
    q_ecef_ned = rotations.q_from_dcm(earth.dcm_ned_ecef(lat, lon).T[None])[0]
    q = rotations.multiply(rotations.multiply(q_ecef_ned, q_ned_body), rotations.exp(np.array([roll, 0.0, 0.0])))
    omega = np.array([spec.spin_rpm * 2.0 * np.pi / 60.0, 0.0, 0.0])
    return state_from_ecef(start, position, velocity, q, omega)


def fly_scenario(scenario: Scenario, seed: int) -> Truth:
    """Fly a scenario on the day that ``seed`` draws."""
    time = scenario.spec.time
    profile = day_atmosphere(scenario.spec.atmosphere, child_rng(seed, "atmosphere"))
    return fly(
        scenario.vehicle,
        profile,
        initial_state(scenario),
        time.start_s,
        time.stop_s,
        scenario.spec.t0_utc,
        time.step_s,
        time.record_s,
        time.inflated_s,
    )

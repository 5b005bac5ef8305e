"""What is to be flown: a scenario file, and the truth's own atmosphere drawn from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from flightmodel import earth, rotations
from flightmodel.atmosphere import AtmosphereProfile, default_sounding_sd
from flightmodel.checks import ConfigError, FloatArray, nearest_name
from flightmodel.config import Section, parse_section, read_toml
from flightmodel.vehicle import DATA, Vehicle, vehicle_from_toml, vehicle_path
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


class DayAtmosphere(Section):
    """The day's departure from US76 and the size of the sounding's errors."""

    winds: bool = True
    density_sd: NonNegative = 0.015
    wind_sd_mps: NonNegative = 2.0
    sounding_scale: NonNegative = 1.0


class Accelerometer(Section):
    """Errors of the accelerometer triad, one standard deviation."""

    rate_hz: Positive
    noise_mps2: NonNegative
    bias_mps2: NonNegative
    scale: NonNegative
    mount_deg: NonNegative
    resolution_mps2: NonNegative = 0.0


class Rates(Section):
    """Errors of the rate gyros, one standard deviation."""

    rate_hz: Positive
    noise_degps: NonNegative
    bias_degps: NonNegative
    scale: NonNegative
    mount_deg: NonNegative
    resolution_degps: NonNegative = 0.0


class Radar(Section):
    """A radar's site and errors, one standard deviation."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    rate_hz: Positive
    offset_s: NonNegative = 0.0
    range_sd_m: NonNegative
    angle_sd_deg: NonNegative
    range_bias_m: NonNegative
    angle_bias_deg: NonNegative
    time_bias_s: NonNegative


class Video(Section):
    """When the onboard camera records."""

    camera: str
    start_s: float
    stop_s: float
    rate_hz: Positive
    benchmark_s: float


class Attitude(Section):
    """The attitude that the range states to start from."""

    t_s: float
    sd_deg: Positive


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


# altitude km, north and east wind m/s: a smooth mid-latitude August day, assumed
_AUGUST_WIND = np.array(
    [
        [0, 2, 1], [5, 3, 8], [11, 4, 16], [18, 1, 0], [25, 0, -10], [35, 2, -18], [45, 3, -28], [55, -4, -38],
        [65, -6, -45], [75, 10, -36], [82, 4, -12], [90, -12, 14], [100, -8, 22], [115, 0, 0],
    ],
    dtype=float,
)  # fmt: skip


def correlated(altitude_m: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Gauss-Markov noise of unit variance along altitude with a correlation length, m."""
    step = np.exp(-np.diff(altitude_m) / length_m)
    white = rng.standard_normal(len(altitude_m))
    out = np.empty(len(altitude_m))
    out[0] = white[0]
    for k in range(1, len(out)):
        out[k] = step[k - 1] * out[k - 1] + np.sqrt(1.0 - step[k - 1] ** 2) * white[k]
    return out


def day_atmosphere(spec: DayAtmosphere, rng: np.random.Generator) -> AtmosphereProfile:
    """Draw the air that the vehicle really meets, 0 to 130 km."""
    z = np.arange(0.0, 130001.0, 250.0)
    smooth = 0.03 * np.sin(2.0 * np.pi * (z / 45000.0 + rng.random())) * (spec.density_sd > 0.0)
    ratio = smooth + spec.density_sd * correlated(z, 5000.0, rng)
    wind = np.zeros((len(z), 3))
    if spec.winds:
        for axis in (0, 1):
            mean = np.interp(z / 1000.0, _AUGUST_WIND[:, 0], _AUGUST_WIND[:, axis + 1])
            wind[:, axis] = mean + spec.wind_sd_mps * correlated(z, 3000.0, rng)
        wind *= np.interp(z, [110000.0, 130000.0], [1.0, 0.0])[:, None]
    density_sd, wind_sd = default_sounding_sd(z)
    return AtmosphereProfile(z, ratio, np.zeros(len(z)), wind, density_sd, wind_sd)


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

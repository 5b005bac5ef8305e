"""What ``flight.toml`` says: the flight, its sensors and radars, their files, and how their columns are written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from flightmodel.checks import ConfigError
from flightmodel.columns import UNITS, Declared, TimeColumn
from flightmodel.config import Section, parse_section, parse_utc, read_toml

NonNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]


class ColumnEntry(Section):
    """A column of a table under another name or unit than the canonical one."""

    column: str
    unit: str

    @field_validator("unit")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in UNITS:
            raise ValueError(f"unknown unit; known: {', '.join(UNITS)}")
        return value


class TimeEntry(Section):
    """The time column of a table."""

    column: str = "t_s"
    format: Literal["seconds", "utc", "irig_doy"] = "seconds"
    unit: Literal["s", "ms", "us", "min"] = "s"


class Source(Section):
    """A table in the flight folder: its file, its time column, columns that are not canonical."""

    file: str
    time: TimeEntry = TimeEntry()
    columns: dict[str, ColumnEntry] = {}

    def declared(self, short: str) -> Declared | None:
        """Return the declared column of a quantity, or None for the canonical one."""
        entry = self.columns.get(short)
        return Declared(entry.column, entry.unit) if entry else None

    @property
    def time_column(self) -> TimeColumn:
        """The time column in the form the reader takes."""
        return TimeColumn(self.time.column, self.time.format, self.time.unit)


class TriadEntry(Source):
    """Accelerometer triad: file, mounting on the vehicle, errors from the data sheet (one standard deviation)."""

    mount: str = "suba"
    noise_sd_mps2: Positive = 0.049
    bias_sd_mps2: NonNegative = 0.098
    scale_sd: NonNegative = 0.003
    mount_sd_deg: NonNegative = 0.2
    resolution_mps2: NonNegative = 0.0


class RatesEntry(Source):
    """Rate gyros along body axes."""

    noise_sd_degps: Positive = 0.05
    bias_sd_degps: NonNegative = 0.05
    scale_sd: NonNegative = 0.003
    mount_sd_deg: NonNegative = 0.15
    resolution_degps: NonNegative = 0.0


class MagnetometerEntry(Source):
    """Magnetometer: file, mounting on the vehicle, errors; the bias holds the vehicle's hard iron too."""

    mount: str = "magnetometer"
    noise_sd_ut: Positive = 0.2
    bias_sd_ut: NonNegative = 0.5
    scale_sd: NonNegative = 0.003
    soft_iron_sd: NonNegative = 0.0
    mount_sd_deg: NonNegative = 0.2
    resolution_ut: NonNegative = 0.0


class SunEntry(Source):
    """Two-axis Sun sensors, one head looking outward at each clocking angle; an empty cell where a head sees no Sun."""

    heads_lv_deg: Annotated[tuple[float, ...], Field(min_length=1, max_length=8)] = (45.0, 135.0, 225.0, 315.0)
    field_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0
    noise_sd_deg: Positive = 1.0
    bias_sd_deg: NonNegative = 0.5
    mount_sd_deg: NonNegative = 0.2


class RadarEntry(Source):
    """A tracking radar and its site (WGS-84)."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-360.0, le=360.0)]
    height_m: float
    tracks: Literal["cg", "datum"] = "cg"
    range_sd_m: Positive = 5.0
    angle_sd_deg: Positive = 0.0086
    range_bias_sd_m: NonNegative = 3.0
    angle_bias_sd_deg: NonNegative = 0.003
    time_bias_sd_s: NonNegative = 0.001
    mislevel_sd_deg: NonNegative = 0.0
    droop_sd_deg: NonNegative = 0.0
    skew_sd_deg: NonNegative = 0.0
    nonorthogonality_sd_deg: NonNegative = 0.0
    wander_sd_deg: NonNegative = 0.0
    wander_time_constant_s: Positive = 20.0


class AtmosphereEntry(Source):
    """The day's sounding; standard deviations default to those of rocketsondes and balloons."""


class FramesEntry(Source):
    """Onboard video as a list of frames: column ``frame`` holds file names below ``folder``."""

    folder: str
    camera: str = "camera5"
    benchmark_s: float = 421.0


class AttitudeEntry(Section):
    """Attitude from another source (magnetometer and Sun, say) to start from; quaternion scalar first."""

    t_s: float
    q_ecef_body: tuple[float, float, float, float]
    sd_deg: Positive = 3.0


class EventEntry(Section):
    """A named moment."""

    name: str
    t_s: float


class SensorsEntry(Section):
    """The onboard sensors."""

    accelerometer: TriadEntry
    rates: RatesEntry
    magnetometer: MagnetometerEntry | None = None
    sun: SunEntry | None = None


class FlightFile(Section):
    """The whole of ``flight.toml``."""

    name: str
    t0_utc: str
    vehicle: str
    synthetic: bool = False
    description: str = ""
    attitude_prior: AttitudeEntry
    sensors: SensorsEntry
    radars: dict[str, RadarEntry]
    atmosphere: AtmosphereEntry
    frames: FramesEntry | None = None
    events: list[EventEntry] = []

    @field_validator("t0_utc")
    @classmethod
    def _parses(cls, value: str) -> str:
        parse_utc(value)
        return value

    @field_validator("radars")
    @classmethod
    def _at_least_one(cls, value: dict[str, RadarEntry]) -> dict[str, RadarEntry]:
        if not value:
            raise ValueError("at least one radar is needed")
        return value


def read_flight_file(folder: Path) -> FlightFile:
    """Read and check ``flight.toml`` of a flight folder; `ConfigError` with every fault."""
    path = folder / "flight.toml"
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such flight folder")
    return parse_section(FlightFile, read_toml(path), str(path))

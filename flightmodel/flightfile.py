"""What may ``flight.toml`` hold? The flight, its instruments and their tables, how it starts and how it moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from flightmodel.checks import ConfigError, Fault
from flightmodel.config import (
    Angle,
    Duration,
    Elevation,
    KeyFaults,
    Latitude,
    Longitude,
    Name,
    Section,
    Time,
    parse_section,
    parse_utc,
    read_toml,
)
from flightmodel.instruments import (
    AtmosphereEntry,
    BarometerEntry,
    FramesEntry,
    GnssEntry,
    MagnetometerEntry,
    RadarEntry,
    RatesEntry,
    SunEntry,
    TriadEntry,
)
from flightmodel.tables import Source, Spans

AttitudeSd = Annotated[float, Field(ge=1e-9, le=180.0)]


class AttitudeEntry(Section):
    """Attitude to start from: a quaternion (scalar first), or where the body's x axis points and how it is rolled.

    At roll 0 the body's y axis is horizontal and points to the right of one who looks along x, east where x is
    level and north. ``sd_deg`` is one number, or one for each body axis.
    """

    t_s: Time
    q_ecef_body: tuple[float, float, float, float] | None = None
    azimuth_deg: Angle | None = None
    elevation_deg: Elevation | None = None
    roll_deg: Angle | None = None
    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    sd_deg: tuple[AttitudeSd, AttitudeSd, AttitudeSd] = (3.0, 3.0, 3.0)

    @field_validator(
        "sd_deg", mode="before", json_schema_input_type=AttitudeSd | tuple[AttitudeSd, AttitudeSd, AttitudeSd]
    )
    @classmethod
    def _each_axis(cls, value: Any) -> Any:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if not 0.0 < value <= 180.0:
                raise ValueError("above 0 and at most 180 deg is wanted")
            return (float(value),) * 3
        return value

    @model_validator(mode="after")
    def _one_form(self) -> AttitudeEntry:
        pointing = (self.azimuth_deg, self.elevation_deg, self.roll_deg)
        place = (self.latitude_deg, self.longitude_deg)
        if self.q_ecef_body is not None and any(v is not None for v in (*pointing, *place)):
            raise ValueError("q_ecef_body is whole; remove azimuth_deg, elevation_deg, roll_deg and the place")
        if self.q_ecef_body is None and any(v is None for v in pointing):
            raise ValueError("write q_ecef_body, or azimuth_deg, elevation_deg and roll_deg of the body's x axis")
        if (place[0] is None) != (place[1] is None):
            raise ValueError("latitude_deg and longitude_deg belong together")
        return self


class UnmodelledEntry(Section):
    """A span with unmodelled acceleration or rotation; `flightmodel.telemetry.UnmodelledSpan`."""

    from_s: Time
    to_s: Time
    sd_mps2: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0
    sd_degps: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0

    @model_validator(mode="after")
    def _something(self) -> UnmodelledEntry:
        if not self.from_s < self.to_s:
            raise KeyFaults([("to_s", self.to_s, f"a span ends after it begins; it begins at {self.from_s:g} s")])
        if self.sd_mps2 == 0.0 and self.sd_degps == 0.0:
            raise KeyFaults([("sd_mps2", 0.0, "state sd_mps2, sd_degps or both")])
        return self


class MotionEntry(Section):
    """How the vehicle moves between measurements; `flightmodel.telemetry.Motion`."""

    model: Literal["strapdown", "ballistic"] = "strapdown"
    drag_area_per_mass_m2pkg: Annotated[float, Field(ge=1e-9, le=1e3)] | None = None
    drag_sd: Annotated[float, Field(ge=1e-9, le=20.0)] = 1.0
    drag_time_constant_s: Duration = 10.0
    side_sd: Annotated[float, Field(ge=0.0, le=10.0)] = 0.1
    acceleration_density: Annotated[float, Field(ge=0.0, le=100.0)] = 0.002
    powered_s: Spans | None = None
    powered_sd_mps2: Annotated[float, Field(ge=1e-9, le=1e4)] = 50.0
    disturbed: list[UnmodelledEntry] = []

    @model_validator(mode="after")
    def _drag_known(self) -> MotionEntry:
        if self.model == "ballistic" and self.drag_area_per_mass_m2pkg is None:
            raise KeyFaults(
                [("model", self.model, "needs drag_area_per_mass_m2pkg, C_D S / m to a factor of exp(drag_sd)")]
            )
        return self


class EventEntry(Section):
    """A named event."""

    name: str
    t_s: Time


class SensorsEntry(Section):
    """The onboard sensors."""

    accelerometer: TriadEntry | None = None
    rates: RatesEntry | None = None
    magnetometer: MagnetometerEntry | None = None
    sun: SunEntry | None = None


class FlightFile(Section):
    """The whole of ``flight.toml``."""

    name: str
    t0_utc: str
    vehicle: str | None = None
    synthetic: bool = False
    description: str = ""
    attitude_prior: AttitudeEntry | None = None
    motion: MotionEntry = MotionEntry()
    sensors: SensorsEntry = SensorsEntry()
    radars: dict[Name, RadarEntry] = {}
    gnss: dict[Name, GnssEntry] = {}
    barometers: dict[Name, BarometerEntry] = {}
    atmosphere: AtmosphereEntry | None = None
    frames: FramesEntry | None = None
    events: list[EventEntry] = []
    reconstruction: dict[str, Any] = {}  # checked by `recon.settings.Settings`

    @field_validator("t0_utc")
    @classmethod
    def _parses(cls, value: str) -> str:
        parse_utc(value)
        return value

    @property
    def sources(self) -> list[Source]:
        """Every table that is named."""
        onboard = (self.sensors.accelerometer, self.sensors.rates, self.sensors.magnetometer, self.sensors.sun)
        single = [s for s in (*onboard, self.atmosphere, self.frames) if s is not None]
        return [*single, *self.radars.values(), *self.gnss.values(), *self.barometers.values()]

    def misfits(self, needs_path: bool = True) -> list[Fault]:
        """Return what does not go together, each with what to write instead.

        Without ``needs_path`` a folder with a film and neither radar nor receiver is whole.
        """
        out: list[Fault] = []
        if needs_path or self.radars or self.gnss or self.frames is None:
            out += self._misfits_of_path()
        if self.frames and self.vehicle is None:
            out.append(Fault('frames: their camera stands in a vehicle file; add vehicle = "..."', "vehicle-missing"))
        names = [*self.radars, *self.gnss, *self.barometers]
        for name in sorted({n for n in names if names.count(n) > 1}):
            words = f"the name '{name}' stands in more than one of radars, gnss and barometers; results go by name"
            out.append(Fault(words, "name-twice"))
        return out

    def _misfits_of_path(self) -> list[Fault]:
        """Return what keeps a path from being found."""
        out = []
        triads = [name for name in ("accelerometer", "rates") if getattr(self.sensors, name) is not None]
        if not self.radars and not self.gnss:
            also = "; a barometer alone gives no place" if self.barometers else ""
            words = f"no [radars.NAME] and no [gnss.NAME]: a trajectory needs at least one of them{also}"
            out.append(Fault(words, "tracker-missing"))
        if len(triads) == 1:
            other = "rates" if triads == ["accelerometer"] else "accelerometer"
            words = f"[sensors.{triads[0]}] without [sensors.{other}]: only both together carry a state; add the other"
            out.append(Fault(words, "inertial-missing"))
        if self.motion.model == "strapdown" and not triads:
            words = (
                'needs [sensors.accelerometer] and [sensors.rates]; without them write model = "ballistic" in [motion]'
            )
            out.append(Fault(f'motion.model = "strapdown" {words}', "inertial-missing"))
        attitude = self.attitude_prior or (self.sensors.magnetometer and self.sensors.sun)
        if self.motion.model == "strapdown" and not attitude:
            words = "write [attitude_prior] (a quaternion, or azimuth_deg, elevation_deg and roll_deg)"
            words = f"no initial attitude: {words}, or both [sensors.magnetometer] and [sensors.sun]"
            out.append(Fault(words, "attitude-missing"))
        return out


def read_flight_file(folder: Path) -> FlightFile:
    """Read and check ``flight.toml`` of a flight folder; `ConfigError` with every fault."""
    path = folder / "flight.toml"
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such flight folder", code="folder-missing")
    return parse_section(FlightFile, read_toml(path), str(path))

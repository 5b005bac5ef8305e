"""How is a flight folder read? What ``flight.toml`` may hold, and its files to checked SI arrays through the gate.

Every fault is listed at once; what can be used in spite of something odd has a finding. Nothing below ``truth/`` is
opened here. The tables themselves: `flightmodel.sensor_tables`.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, field_validator, model_validator

from flightmodel.atmosphere import standard_sounding
from flightmodel.camera_edits import EDITS_FILE
from flightmodel.checks import ConfigError, FloatArray, GateError, Issue
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
    parse_utc,
    read_section,
)
from flightmodel.csv_reading import file_sha256
from flightmodel.earth import (
    PLANETS,
    WGS84,
    Planet,
    ecef_from_radar,
    geodetic_from_ecef,
    q_ecef_body_from_pointing,
)
from flightmodel.entry_state import DragEntry, StateEntry, read_drag, refuse_misread_entry
from flightmodel.files import nothing_at, open_file
from flightmodel.film import Frames
from flightmodel.gate import Gate
from flightmodel.input_findings import input_findings
from flightmodel.instruments import (
    SITES,
    AtmosphereEntry,
    BarometerEntry,
    FramesEntry,
    GnssEntry,
    LoadsEntry,
    MagnetometerEntry,
    RadarEntry,
    RatesEntry,
    SitesEntry,
    SitesSpec,
    SunEntry,
    TriadEntry,
)
from flightmodel.sensor_tables import (
    read_barometer,
    read_frames,
    read_gnss,
    read_radar,
    read_sounding,
    read_sun,
    read_triad,
    with_least_count,
)
from flightmodel.tables import GNSS_SD, Source, Spans, times_s
from flightmodel.telemetry import (
    AttitudePrior,
    BarometerRecord,
    GnssRecord,
    KnownPlace,
    LoadsTable,
    Motion,
    RadarRecord,
    Sounding,
    Start,
    StatedDrag,
    StatePrior,
    SunRecord,
    Telemetry,
    TriadRecord,
    UnmodelledSpan,
    find_rest,
    mean_readings,
)
from flightmodel.vehicle import Vehicle, vehicle_from_toml, vehicle_path

LEAST_SPAN_S = 1.0
_SD = re.compile(r"(^|_)sd(_|$)")  # in a key: a standard deviation
_TRIM_TIME_CONSTANT_S = 100.0  # of a trimmed entry's drag and lift: about its length
_BIAS_TIMES = 6.0  # no bias of a sound gyro is so large, one in a thousand million
_TAKEN = {SitesSpec.name: "all radar sites together", "rest": "the rest on the pad"}  # names of sources in results
Record = TypeVar("Record")
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
    # of the place, which is compared with the trackers'; written to 0.001 deg it is within 100 m
    place_sd_m: Annotated[float, Field(ge=1e-3, le=1e6)] = 100.0
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

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        pointing = (self.azimuth_deg, self.elevation_deg, self.roll_deg)
        place = (self.latitude_deg, self.longitude_deg)
        if self.q_ecef_body is not None and any(v is not None for v in (*pointing, *place)):
            yield "", None, "q_ecef_body is whole; remove azimuth_deg, elevation_deg, roll_deg and the place"
        elif self.q_ecef_body is None and any(v is None for v in pointing):
            yield "", None, "write q_ecef_body, or azimuth_deg, elevation_deg and roll_deg of the body's x axis"
        elif (place[0] is None) != (place[1] is None):
            yield "", None, "latitude_deg and longitude_deg belong together"


class StartEntry(Section):
    """What is known of the start; `flightmodel.telemetry.Start`."""

    at_rest: tuple[Time, Time] | None = None
    sd_mps: Annotated[float, Field(ge=1e-6, le=10.0)] = 0.01
    azimuth_deg: Angle | None = None
    azimuth_sd_deg: Annotated[float, Field(ge=1e-3, le=180.0)] = 2.0
    state: StateEntry | None = None

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.at_rest is not None and not self.at_rest[0] < self.at_rest[1]:
            yield "at_rest", list(self.at_rest), "a rest ends after it begins: [from, to], s"
        if self.at_rest is None and self.azimuth_deg is not None:
            yield "azimuth_deg", self.azimuth_deg, "counts where at_rest = [from, to] is stated too"
        if self.at_rest is not None and self.state is not None:
            yield "state", "...", "a start at rest has its own state; keep at_rest or state"


class PlaceEntry(Section):
    """A place that the vehicle is known to have been at; `flightmodel.telemetry.KnownPlace`."""

    name: Name
    t_s: Time
    latitude_deg: Latitude
    longitude_deg: Longitude
    height_m: Annotated[float, Field(ge=-1e3, le=1e5)] | None = None
    sd_m: Annotated[float, Field(ge=1e-3, le=1e6)] = 5.0
    height_sd_m: Annotated[float, Field(ge=1e-3, le=1e6)] = 5.0


class UnmodelledEntry(Section):
    """A span with unmodelled acceleration or rotation; `flightmodel.telemetry.UnmodelledSpan`."""

    from_s: Time
    to_s: Time
    sd_mps2: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0
    sd_degps: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if not self.from_s < self.to_s:
            yield "to_s", self.to_s, f"a span ends after it begins; it begins at {self.from_s:g} s"
        if self.sd_mps2 == 0.0 and self.sd_degps == 0.0:
            yield "sd_mps2", 0.0, "state sd_mps2, sd_degps or both"


class MotionEntry(Section):
    """How the vehicle moves between measurements; `flightmodel.telemetry.Motion`."""

    model: Literal["strapdown", "ballistic"] = "strapdown"
    drag_area_per_mass_m2pkg: Annotated[float, Field(ge=1e-9, le=1e3)] | None = None
    drag_sd: Annotated[float, Field(ge=1e-9, le=20.0)] = 1.0
    drag_time_constant_s: Duration = 10.0
    side_sd: Annotated[float, Field(ge=0.0, le=10.0)] = 0.1
    side_time_constant_s: Duration = 10.0
    trim_sd_deg: Annotated[float, Field(gt=0.0, le=20.0)] = 3.0
    acceleration_density: Annotated[float, Field(ge=0.0, le=100.0)] = 0.002
    powered_s: Spans | None = None
    powered_sd_mps2: Annotated[float, Field(ge=1e-9, le=1e4)] = 50.0
    disturbed: list[UnmodelledEntry] = []


class EventEntry(Section):
    """A named event."""

    name: Label
    t_s: Time


class SensorsEntry(Section):
    """The onboard sensors."""

    accelerometer: TriadEntry | None = None
    rates: RatesEntry | None = None
    magnetometer: MagnetometerEntry | None = None
    sun: SunEntry | None = None

    @property
    def triads(self) -> list[tuple[str, TriadEntry | RatesEntry | MagnetometerEntry]]:
        """Sensors with three axes, by name."""
        named = (("accelerometer", self.accelerometer), ("rates", self.rates), ("magnetometer", self.magnetometer))
        return [(name, entry) for name, entry in named if entry is not None]


class FlightFile(Section):
    """The whole of ``flight.toml``."""

    name: Label
    t0_utc: str
    planet: Literal["earth", "mars"] = "earth"
    vehicle: str | None = None
    drag: DragEntry | None = None
    synthetic: bool = False
    description: str = ""
    attitude_prior: AttitudeEntry | None = None
    start: StartEntry = StartEntry()
    motion: MotionEntry = MotionEntry()
    sensors: SensorsEntry = SensorsEntry()
    radars: dict[Name, RadarEntry] = {}
    sites: SitesEntry = SitesEntry()
    places: list[PlaceEntry] = []
    gnss: dict[Name, GnssEntry] = {}
    barometers: dict[Name, BarometerEntry] = {}
    loads: LoadsEntry | None = None
    atmosphere: AtmosphereEntry | None = None
    frames: FramesEntry | None = None
    cameras: dict[Name, FramesEntry] = {}
    events: list[EventEntry] = []
    reconstruction: dict[str, Any] = {}  # checked by `recon.settings.Settings`

    @model_validator(mode="before")
    @classmethod
    def _times_of_others(cls, value: Any) -> Any:
        """``time = "sensors.rates"`` is the time of that table: one delivery of several sensors has one time column."""
        if not isinstance(value, dict):
            return value
        groups = {
            k: dict(value[k]) for k in ("sensors", "radars", "gnss", "barometers") if isinstance(value.get(k), dict)
        }
        for entries in groups.values():
            for name, entry in entries.items():
                if isinstance(entry, dict) and isinstance(entry.get("time"), str):
                    group, _, other = entry["time"].partition(".")
                    found = value.get(group, {}).get(other) if isinstance(value.get(group), dict) else None
                    if isinstance(found, dict):
                        entries[name] = entry | {"time": found.get("time", {})}
        return value | groups

    @field_validator("t0_utc")
    @classmethod
    def _parses(cls, value: str) -> str:
        parse_utc(value)
        return value

    @property
    def body(self) -> Planet:
        """Where the flight was."""
        return PLANETS[self.planet]

    @property
    def measures_deceleration(self) -> bool:
        """Whether the accelerometer measures the deceleration of ballistic flight; else it needs gyros, or is idle."""
        alone = self.sensors.rates is None or "trim_sd_deg" in self.motion.model_fields_set
        return self.motion.model == "ballistic" and self.sensors.accelerometer is not None and alone

    @property
    def films(self) -> dict[str, FramesEntry]:
        """Every camera's film, by its table: ``frames``, or ``cameras.NAME``."""
        alone = {} if self.frames is None else {"frames": self.frames}
        return alone | {f"cameras.{name}": entry for name, entry in self.cameras.items()}

    @property
    def film_names(self) -> dict[str, str]:
        """Name of each camera by its table: of one alone its mount's."""
        alone = {} if self.frames is None else {"frames": self.frames.camera}
        return alone | {f"cameras.{name}": name for name in self.cameras}

    @property
    def sources(self) -> list[Source]:
        """Every table that is named."""
        onboard = (self.sensors.accelerometer, self.sensors.rates, self.sensors.magnetometer, self.sensors.sun)
        drag = None if self.drag is None else self.drag.table
        single = [s for s in (*onboard, self.atmosphere, drag, self.loads) if s is not None]
        return [*single, *self.films.values(), *self.radars.values(), *self.gnss.values(), *self.barometers.values()]

    def misfits(self, needs_path: bool = True) -> Iterator[Issue]:
        """Yield inconsistencies between tables, each with what to write instead.

        Without ``needs_path`` a folder with a film and neither radar nor receiver is whole, and one with loads always.
        """
        yield from self._misfits_of_planet()
        measures_path = bool(self.radars or self.gnss or self.start.state)
        if self.loads is not None and (measures_path or self.sensors.triads):
            words = "[loads] is another team's trajectory, and beside it stands what one is reconstructed from"
            also = "take [loads] out, or [radars.NAME], [gnss.NAME], [start.state] and [sensors]"
            yield Issue(f"{words}; {also}", "keys-conflict")
        if self.drag is not None and self.vehicle is not None:
            words = "[drag] beside vehicle: the vehicle file states C_A, area and mass; take one of the two out"
            yield Issue(words, "keys-conflict")
        if self.loads is None and (needs_path or self.radars or self.gnss or not self.films):
            yield from self._misfits_of_path()
        if self.films and self.vehicle is None:
            tables = ", ".join(self.films)
            yield Issue(f'{tables}: their camera stands in a vehicle file; add vehicle = "..."', "vehicle-missing")
        if self.loads is not None and self.vehicle is None:
            yield Issue('[loads]: mass and coefficients are wanted; add vehicle = "..."', "vehicle-missing")
        if self.frames is not None and self.cameras:
            words = "[frames] beside [cameras.NAME]: one camera stands in [frames], several in [cameras.NAME] each"
            yield Issue(words, "keys-conflict")
        names = [*self.radars, *self.gnss, *self.barometers, *_TAKEN]
        for name in sorted({n for n in names if names.count(n) > 1}):
            words = f"the name '{name}' stands in more than one of radars, gnss and barometers; results go by name"
            if name in _TAKEN:
                words = f"the name '{name}' stands for {_TAKEN[name]}; call the tracker otherwise"
            yield Issue(words, "given-twice")

    def _misfits_of_planet(self) -> Iterator[Issue]:
        """Yield entries that need models available for the Earth only."""
        if self.body == WGS84:
            return
        where = f'planet = "{self.planet}"'
        if self.sensors.magnetometer is not None:
            yield Issue(f"[sensors.magnetometer]: {where} has no field model; take it out", "planet-unsupported")
        if self.sensors.sun is not None:
            words = "the Sun's direction is known from the Earth alone; take it out and state [attitude_prior]"
            yield Issue(f"[sensors.sun]: {where}: {words}", "planet-unsupported")
        for table, entries in (("gnss", self.gnss), ("barometers", self.barometers)):
            for name, entry in entries.items():
                if entry.height_is == "msl" and entry.geoid_undulation_m is None:
                    words = 'state geoid_undulation_m, or heights above the ellipsoid (height_is = "ellipsoid")'
                    yield Issue(f"{table}.{name}: {where} has no geoid here; {words}", "planet-unsupported")
        if self.start.at_rest is not None:
            words = "a rest is levelled by the Earth's gravity and turn; state [start.state]"
            yield Issue(f"start.at_rest: {where}: {words}", "planet-unsupported")

    def _misfits_of_drag(self) -> Iterator[Issue]:
        """Yield what ballistic flight and an accelerometer without gyros lack."""
        if self.motion.model == "ballistic" and self.motion.drag_area_per_mass_m2pkg is None and self.drag is None:
            words = "needs drag_area_per_mass_m2pkg, C_D S / m to a factor of exp(drag_sd), or [drag]"
            yield Issue(f"key 'motion.model' = 'ballistic': {words}", "keys-conflict")
        entry = self.sensors.accelerometer
        if entry is not None and self.measures_deceleration and entry.mount in (None, "body"):
            axial = entry.dcm_body_sensor[0]
            unread = [a for a, part in zip(("ax", "ay", "az"), axial, strict=True) if part and a not in entry.measures]
            if unread:
                words = (
                    f"its {unread[0]} lies along body x, where the deceleration is; add it to measures, or state axes"
                )
                yield Issue(f"sensors.accelerometer: {words}", "input-missing")
        elif entry is not None and len(set(entry.measures)) < 3 and self.motion.model == "strapdown":
            words = 'measures: three axes carry a state; with fewer write model = "ballistic" in [motion]'
            yield Issue(f"sensors.accelerometer.{words}", "inertial-missing")

    def _misfits_of_path(self) -> Iterator[Issue]:
        """Yield missing inputs without which no trajectory can be estimated."""
        yield from self._misfits_of_drag()
        triads = [name for name in ("accelerometer", "rates") if getattr(self.sensors, name) is not None]
        if not self.radars and not self.gnss and self.start.state is None:
            also = "; a barometer alone gives no place" if self.barometers else ""
            words = (
                f"no [radars.NAME] and no [gnss.NAME]: a trajectory needs at least one of them, or [start.state]{also}"
            )
            yield Issue(words, "tracker-missing")
        if len(triads) == 1 and not self.measures_deceleration:
            other = "rates" if triads == ["accelerometer"] else "accelerometer"
            words = f"[sensors.{triads[0]}] without [sensors.{other}]: only both together carry a state; add the other"
            if triads == ["accelerometer"]:
                words += ', or write model = "ballistic" in [motion], where an accelerometer measures the drag'
            yield Issue(words, "inertial-missing")
        if self.motion.model == "strapdown" and not triads:
            words = (
                'needs [sensors.accelerometer] and [sensors.rates]; without them write model = "ballistic" in [motion]'
            )
            yield Issue(f'motion.model = "strapdown" {words}', "inertial-missing")
        attitude = self.attitude_prior or self.start.at_rest or (self.sensors.magnetometer and self.sensors.sun)
        if self.start.at_rest and (self.motion.model != "strapdown" or len(triads) < 2):
            words = "start.at_rest: a rest is measured by accelerometer and gyros, which do not carry this flight"
            yield Issue(f"{words}; take [start] out", "keys-conflict")
        if self.motion.model == "strapdown" and not attitude:
            words = "write [attitude_prior] (a quaternion, or azimuth_deg, elevation_deg and roll_deg)"
            words = f"no initial attitude: {words}, [start] at_rest, or both [sensors.magnetometer] and [sensors.sun]"
            yield Issue(words, "attitude-missing")


def read_flight_file(folder: Path) -> FlightFile:
    """Read and check ``flight.toml`` of a flight folder; `ConfigError` with every fault."""
    path = folder / "flight.toml"
    if not folder.is_dir():
        words = f"is a file; its folder is wanted: {folder.parent}" if folder.is_file() else "no such flight folder"
        raise ConfigError(f"{folder}: {words}", code="file-missing")
    return read_section(FlightFile, path)


@dataclass(frozen=True)
class Sources:
    """What could be read of a flight folder; what could not is among the faults of its ``gate``."""

    gate: Gate
    spec: FlightFile
    vehicle: Vehicle | None
    triads: dict[str, TriadRecord]
    sun: SunRecord | None
    radars: dict[str, RadarRecord]
    gnss: dict[str, GnssRecord]
    barometers: dict[str, BarometerRecord]
    sounding: Sounding | None
    films: dict[str, Frames]
    attitude_prior: AttitudePrior | None
    drag: StatedDrag | None = None
    state: StatePrior | None = None
    loads: LoadsTable | None = None


def read_sources(folder: Path, progress: Callable[[float], None] | None = None, needs_path: bool = True) -> Sources:
    """Read every table of a flight that can be read; faults and findings are kept in the gate.

    Parameters
    ----------
    folder : Path
        Flight folder with ``flight.toml``.
    progress : callable, optional
        Called with the fraction of the large tables that is read.
    needs_path : bool
        Whether a folder without radar and receiver is refused even where it has a film.

    Raises
    ------
    ConfigError
        For faults of ``flight.toml`` itself.
    """
    spec = read_flight_file(folder)
    gate = Gate(folder, parse_utc(spec.t0_utc))
    if progress is not None:
        gate.progress = _share_of(folder, spec, progress)
    for misfit in spec.misfits(needs_path):
        gate.refuse_config(misfit)
    vehicle = _vehicle(gate, spec.vehicle, spec.events) if spec.vehicle is not None else None
    triads = {
        name: read_triad(gate, name, entry, vehicle, spec.vehicle is not None) for name, entry in spec.sensors.triads
    }
    sun = read_sun(gate, spec.sensors.sun) if spec.sensors.sun else None
    radars = _there({name: read_radar(gate, name, entry) for name, entry in spec.radars.items()})
    gnss = _there({name: read_gnss(gate, name, entry, spec.t0_utc, spec.body) for name, entry in spec.gnss.items()})
    sounding = _sounding(gate, spec)
    drag = read_drag(gate, spec.drag) if spec.drag is not None else None
    state = _state(gate, spec)
    if spec.measures_deceleration and (alone := triads.get("accelerometer")) is not None:
        triads["accelerometer"], counted = with_least_count(alone)
        gate.findings.extend(counted)
        if state is not None and not spec.motion.powered_s:
            refuse_misread_entry(gate, alone, state)
    idle = spec.motion.model == "ballistic" and not spec.measures_deceleration
    if idle and triads.get("accelerometer") and triads.get("rates"):
        words = (
            'accelerometer and rates are there, but with model = "ballistic" gravitation and drag carry the flight: '
            "they are not used for its path and attitude; take [motion] out unless that is meant"
        )
        gate.findings.append(Issue(words, "inertial-unused", "motion"))
    measured = spec.atmosphere is not None
    place = _first_place(radars, gnss, spec.body, state)
    barometers = {
        name: read_barometer(gate, name, entry, sounding, measured, place) for name, entry in spec.barometers.items()
    }
    films = _films(gate, spec, vehicle)
    prior = _attitude_prior(gate, spec.attitude_prior, place) if spec.attitude_prior else None
    if spec.motion.model == "strapdown":
        most_g = {name: entry.most_g for name, entry in spec.gnss.items()}
        gate.findings.extend(input_findings(triads.get("accelerometer"), gnss, prior, most_g))
    loads = _loads(gate, spec.loads) if spec.loads is not None else None
    return Sources(
        gate, spec, vehicle, _there(triads), sun, radars, gnss, _there(barometers), sounding, films, prior, drag, state,
        loads,
    )  # fmt: skip


def read_flight(folder: Path, progress: Callable[[float], None] | None = None, needs_path: bool = True) -> Telemetry:
    """Read everything measured on one flight; parameters as of `read_sources`.

    Raises
    ------
    ConfigError
        For faults of ``flight.toml`` or the vehicle file.
    GateError
        For faults of the data files: all of them, each with file, line or time, and what to do.
    """
    found = read_sources(folder, progress, needs_path)
    gate, spec = found.gate, found.spec
    gate.close()
    assert found.sounding is not None
    telemetry = Telemetry(
        name=spec.name,
        t0_utc=spec.t0_utc,
        synthetic=spec.synthetic,
        vehicle=found.vehicle,
        accelerometer=found.triads.get("accelerometer"),
        rates=found.triads.get("rates"),
        radars=found.radars,
        sounding=found.sounding,
        attitude_prior=found.attitude_prior,
        films=found.films,
        magnetometer=found.triads.get("magnetometer"),
        sun=found.sun,
        events=tuple((e.name, e.t_s) for e in spec.events),
        findings=tuple(gate.findings),
        hashes=_hashes(gate, spec, found.vehicle, found.films),
        assumed=assumed_errors(spec, found.radars, found.gnss),
        drag=found.drag,
        planet=spec.body,
        loads=found.loads,
        gnss=found.gnss,
        barometers=found.barometers,
        motion=_motion(spec, found.drag),
        reconstruction=dict(spec.reconstruction),
        sites=SitesSpec(**SITES.from_file(spec.sites)),
        places=_places(spec),
        start=replace(_start(spec.start), state=found.state),
    )
    if not found.radars and not found.gnss and found.state is None:
        return telemetry
    telemetry = replace(telemetry, findings=(*telemetry.findings, *_rest_findings(telemetry)))
    start, stop = telemetry.span_s()
    if stop - start < LEAST_SPAN_S:
        who = "accelerometer, rates and" if telemetry.accelerometer is not None else "the flight's"
        kinds = (("radars", found.radars), ("receivers", found.gnss), ("start", found.state))
        trackers = " and ".join(kind for kind, some in kinds if some)
        raise GateError(
            f"{folder}: {who} {trackers} have no second in common ({start:.2f} to {stop:.2f} s)",
            code="time-not-covered",
        )
    return telemetry


def _share_of(folder: Path, spec: FlightFile, progress: Callable[[float], None]) -> Callable[[int], None]:
    """Convert newly read bytes to a fraction of the bytes of all tables."""
    paths = [folder / source.file for source in spec.sources]
    total, done = sum(path.stat().st_size for path in paths if path.is_file()), 0

    def more_read(more: int) -> None:
        nonlocal done
        done += more
        progress(min(1.0, done / total))

    return more_read


def _there(records: dict[str, Record | None]) -> dict[str, Record]:
    """Those that could be read."""
    return {name: record for name, record in records.items() if record is not None}


def _vehicle(gate: Gate, name: str, events: list[EventEntry]) -> Vehicle | None:
    """Read the vehicle that flight.toml names; None, with its faults kept, where it is refused."""
    try:
        path = vehicle_path(name, gate.folder)
        if gate.is_truth(path):
            raise ConfigError(f"{path} lies in truth/, which no estimator may open", code="path-refused")
        vehicle = vehicle_from_toml(path).with_events((event.name, event.t_s) for event in events)
    except GateError as fault:
        for each in fault.faults:
            gate.refuse_config(Issue(f"vehicle: {each}", each.code))
        return None
    for body, mesh in vehicle.meshes.items():
        use, code = "the camera's fit is of its edge and surface", "mesh-use"
        if body == "centerbody":
            use, code = "it is drawn, while the camera's view is bounded by [geometry]", "mesh-use"
        code = "mesh-use" if mesh.apart else code
        gate.findings.append(Issue(f"{mesh.words}; {use}", code, f"mesh of the {body}"))
    return vehicle


def _films(gate: Gate, spec: FlightFile, vehicle: Vehicle | None) -> dict[str, Frames]:
    """Film of each camera that could be read; one alone goes by its mount's name, several by their tables'."""
    read = {}
    for (table, entry), name in zip(spec.films.items(), spec.film_names.values(), strict=True):
        mount = {} if spec.frames is not None or "camera" in entry.model_fields_set else {"camera": name}
        read[name] = read_frames(gate, entry.model_copy(update=mount), vehicle, table)
    return _there(read)


def _loads(gate: Gate, entry: LoadsEntry) -> LoadsTable | None:
    """Table of loads where it lies; None, with a fault kept, where there is none that may be read."""
    path, time_s = gate.path(entry.file), None
    if path is None:
        return None
    if not path.is_file():
        gate.refuse(f"loads: {path}: {nothing_at(path)}", "file-missing")
        return None
    columns = {short: f"{c.column}:{c.unit}" for short, c in entry.columns.items()}
    if entry.time.format != "seconds":
        frame = gate.csv(path, "loads")
        if frame is None or (time_s := times_s(frame, entry.time_column, gate.t0, path, "loads", gate.faults)) is None:
            return None
    elif "time" in entry.model_fields_set:
        columns["t"] = f"{entry.time.column}:{entry.time.unit}"
    return LoadsTable(path, entry, columns, time_s)


def _sounding(gate: Gate, spec: FlightFile) -> Sounding | None:
    """Read the day's air; the standard's, with a finding, where flight.toml names no table."""
    if spec.atmosphere is not None:
        return read_sounding(gate, spec.atmosphere, spec.body)
    if spec.body != WGS84:
        words = f"no [atmosphere]: the standard atmosphere of {spec.planet.capitalize()} without wind stands for it"
        gate.findings.append(Issue(words, "no-sounding", "atmosphere"))
        return standard_sounding(spec.body)
    if spec.loads is not None:  # it states the air itself
        return standard_sounding()
    words = (
        "no [atmosphere]: the US Standard Atmosphere 1976 stands for it, density to 10 % (24 % from 80 km), "
        "wind to 15 m/s"
    )
    gate.findings.append(Issue(words, "no-sounding", "atmosphere"))
    return standard_sounding()


def _attitude_prior(gate: Gate, entry: AttitudeEntry, place: tuple[float, float] | None) -> AttitudePrior | None:
    """Attitude to start from; None, with a fault kept, where no place is known for it."""
    sd = np.deg2rad(entry.sd_deg)
    if entry.q_ecef_body is not None:
        q = np.array(entry.q_ecef_body)
        norm = float(np.linalg.norm(q))
        if abs(norm - 1.0) > 1e-3:
            gate.refuse_config(f"attitude_prior.q_ecef_body has norm {norm:.4f}, not 1", "value-range")
            return None
        return AttitudePrior(entry.t_s, q / norm, sd)
    if entry.latitude_deg is not None and entry.longitude_deg is not None:
        latitude, longitude = np.deg2rad([entry.latitude_deg, entry.longitude_deg])
    else:
        if place is None:  # its table was refused
            return None
        latitude, longitude = place
    assert entry.azimuth_deg is not None
    assert entry.elevation_deg is not None
    assert entry.roll_deg is not None
    azimuth, elevation, roll = np.deg2rad([entry.azimuth_deg, entry.elevation_deg, entry.roll_deg])
    q = q_ecef_body_from_pointing(azimuth, elevation, roll, float(latitude), float(longitude))
    return AttitudePrior(entry.t_s, q, sd)


def _state(gate: Gate, spec: FlightFile) -> StatePrior | None:
    """State that the flight starts from; None, with a fault kept, where its axes are not known."""
    if spec.start.state is None:
        return None
    try:
        return spec.start.state.prior(spec.t0_utc, spec.body)
    except GateError as fault:
        for each in fault.faults:
            gate.refuse_config(Issue(f"start.state: {each}", each.code))
        return None


def _start(entry: StartEntry) -> Start:
    azimuth = None if entry.azimuth_deg is None else float(np.deg2rad(entry.azimuth_deg))
    return Start(entry.at_rest, entry.sd_mps, azimuth, float(np.deg2rad(entry.azimuth_sd_deg)))


def _rest_findings(telemetry: Telemetry) -> list[Issue]:
    """A rest that the data begin with and flight.toml does not state."""
    if telemetry.motion.model != "strapdown" or telemetry.start.at_rest is not None:
        return []
    if telemetry.accelerometer is None or telemetry.rates is None:
        return []
    span = find_rest(telemetry.accelerometer, telemetry.rates)
    if span is None:
        return []
    noise = [mean_readings(record, span).noise_sd for record in (telemetry.accelerometer, telemetry.rates)]
    words = (
        f"the vehicle stands still: write [start] at_rest = [{span[0]:.2f}, {span[1]:.2f}], which levels it and frees "
        f"its velocity of the trackers; noise there: {noise[0]:.2g} m/s2, {np.rad2deg(noise[1]):.2g} deg/s"
    )
    out = [Issue(words, "rest-found", "start", *span)]
    rates = telemetry.rates
    turning = float(np.abs(mean_readings(rates, span).mean).max()) - telemetry.planet.rate_radps
    times = turning / max(rates.spec.bias_sd, 1e-12)
    if times > _BIAS_TIMES:
        words = f"at rest it reads {times:.0f} times bias_sd_degps: no track can be followed; state it wider"
        out.append(Issue(words, "bias-beyond-data-sheet", rates.spec.name, *span))
    return out


def _places(spec: FlightFile) -> tuple[KnownPlace, ...]:
    """Places that are known: those of ``[[places]]``, and that of the attitude prior where one is stated."""
    out = []
    prior = spec.attitude_prior
    if prior is not None and prior.latitude_deg is not None and prior.longitude_deg is not None:
        lat, lon = (float(x) for x in np.deg2rad([prior.latitude_deg, prior.longitude_deg]))
        out.append(KnownPlace("attitude_prior", prior.t_s, lat, lon, np.nan, prior.place_sd_m, np.inf))
    for entry in spec.places:
        lat, lon = (float(x) for x in np.deg2rad([entry.latitude_deg, entry.longitude_deg]))
        height = np.nan if entry.height_m is None else entry.height_m
        out.append(KnownPlace(entry.name, entry.t_s, lat, lon, height, entry.sd_m, entry.height_sd_m))
    return tuple(out)


def _first_place(
    radars: dict[str, RadarRecord], gnss: dict[str, GnssRecord], planet: Planet, state: StatePrior | None
) -> tuple[float, float] | None:
    """Latitude and longitude, rad, of a stated start, the first receiver's first fix or first radar's first point."""
    points: list[FloatArray] = [] if state is None else [state.position_ecef_m[None]]
    points += [r.position_ecef_m for r in gnss.values()]
    points += [ecef_from_radar(r.range_az_el, *r.spec.geodetic, planet) for r in radars.values()]
    for point in points:
        whole = point[np.isfinite(point).all(axis=1)]
        if len(whole):
            latitude, longitude, _ = geodetic_from_ecef(whole[0], planet)
            return float(latitude), float(longitude)
    site = next((radar.spec for radar in radars.values()), None)
    return None if site is None else (site.latitude_rad, site.longitude_rad)  # angles or ranges alone: nearby


def _motion(spec: FlightFile, drag: StatedDrag | None) -> Motion:
    entry, trim_rad, drag_area = spec.motion, 0.0, spec.motion.drag_area_per_mass_m2pkg
    # a blunt body's lift over drag is about its angle of attack, and a trimmed one keeps it. No tracker says how high
    # it is: a drag that came back soon to what is stated would make the density tell
    known: dict[str, float] = {}
    if spec.measures_deceleration:
        trim_rad = float(np.deg2rad(entry.trim_sd_deg))
        known = {"drag_time_constant_s": _TRIM_TIME_CONSTANT_S, "side_sd": trim_rad}
    known |= {key: getattr(entry, key) for key in entry.model_fields_set}
    drag_time = known.get("drag_time_constant_s", entry.drag_time_constant_s)
    if drag_area is None:
        drag_area = 0.0 if drag is None else float(drag.area_per_mass_m2pkg(drag.mach[-1:])[0])
    return Motion(
        model=entry.model,
        drag_area_per_mass_m2pkg=drag_area,
        drag_sd=entry.drag_sd,
        drag_time_constant_s=drag_time,
        side_sd=known.get("side_sd", entry.side_sd),
        side_time_constant_s=known.get("side_time_constant_s", drag_time),
        trim_sd_rad=trim_rad,
        acceleration_density=entry.acceleration_density,
        powered_s=entry.powered_s or (),
        powered_sd_mps2=entry.powered_sd_mps2,
        disturbed=tuple(
            UnmodelledSpan(d.from_s, d.to_s, d.sd_mps2, float(np.deg2rad(d.sd_degps))) for d in entry.disturbed
        ),
    )


def assumed_errors(
    spec: FlightFile, radars: dict[str, RadarRecord], gnss: dict[str, GnssRecord]
) -> dict[str, dict[str, float]]:
    """Standard deviations that are taken from the defaults because flight.toml does not state them, by table and key.

    Errors whose default is none at all are left out, and those that the table does not measure.
    """
    entries: dict[str, Section | None] = {f"barometers.{name}": entry for name, entry in spec.barometers.items()}
    entries |= {f"sensors.{name}": getattr(spec.sensors, name) for name in type(spec.sensors).model_fields}
    out = {table: assumed_of(entry) for table, entry in entries.items() if entry is not None}
    for name, receiver in spec.gnss.items():
        out[f"gnss.{name}"] = assumed_of(receiver, _not_in_the_fixes(gnss[name]) if name in gnss else set())
    for name, radar in spec.radars.items():
        out[f"radars.{name}"] = assumed_of(radar, _not_measured_or_in_the_table(radar, radars.get(name)))
    if spec.measures_deceleration and "trim_sd_deg" not in spec.motion.model_fields_set:
        out["motion"] = {"trim_sd_deg": spec.motion.trim_sd_deg}
    if spec.loads is not None:
        out["loads"] = assumed_of(spec.loads)
    if spec.start.state is not None:
        out["start.state"] = assumed_of(spec.start.state)
    prior = spec.attitude_prior
    if prior is not None and "sd_deg" not in prior.model_fields_set:
        out["attitude_prior"] = {"sd_deg": float(prior.sd_deg[0])}
    return {table: keys for table, keys in out.items() if keys}


def assumed_of(entry: Section, known: Iterable[str] = ()) -> dict[str, float]:
    """Standard deviations by default of what a table does not state, but for those that are ``known`` otherwise."""
    stated = {*known, *entry.model_fields_set}
    defaults = {key: field.default for key, field in type(entry).model_fields.items() if _SD.search(key)}
    return {key: float(sd) for key, sd in defaults.items() if key not in stated and isinstance(sd, float) and sd > 0.0}


def _not_in_the_fixes(record: GnssRecord) -> set[str]:
    """Keys that do not apply to a receiver: quantities not measured, or noise that is given with each fix."""
    noises = [q.canonical for q in GNSS_SD]
    out = set()
    for read, keys in ((record.position_ecef_m, noises[:2]), (record.velocity_ecef_mps, noises[2:])):
        own = np.full((len(read), 4), np.nan) if record.sd is None else record.sd
        own = own[np.isfinite(read).all(axis=1)]
        out |= {key for key in keys if np.isfinite(own[:, noises.index(key)]).all()}
    return out if record.has_positions else out | {"wander_sd_m"}


def _not_measured_or_in_the_table(radar: RadarEntry, record: RadarRecord | None) -> set[str]:
    """Keys of readings that a radar does not have, or whose noise is stated apart or in each row."""
    rows = None if record is None else record.sd
    range_known, az_known, el_known, rate_known = (rows is not None and np.isfinite(rows[:, k]).all() for k in range(4))
    measures, apart = set(radar.measures), radar.model_fields_set
    out = {"range_sd_m", "range_bias_sd_m"} if "range" not in measures else set()
    out |= {"range_sd_m"} if range_known else set()
    out |= {"range_rate_sd_mps"} if "range_rate" not in measures or rate_known else set()
    known = {"az": az_known or "azimuth_sd_deg" in apart, "el": el_known or "elevation_sd_deg" in apart}
    if all(is_known for angle, is_known in known.items() if angle in measures):
        out.add("angle_sd_deg")
    return out | ({"angle_bias_sd_deg"} if not measures & {"az", "el"} else set())


def _hashes(gate: Gate, spec: FlightFile, vehicle: Vehicle | None, films: dict[str, Frames]) -> dict[str, str]:
    """SHA-256 of every file that the results depend on; all pictures of a film share one."""
    names = {"flight.toml", *(source.file for source in spec.sources)}
    if any(film.edits.rows for film in films.values()):
        names.add(EDITS_FILE)
    digests = {name: gate.sha256(gate.folder / name) for name in sorted(names)}
    if vehicle is not None:
        digests[f"vehicle {vehicle.name}"] = file_sha256(vehicle.source)
        for name in vehicle.files:
            digests[f"vehicle's {name}"] = file_sha256(vehicle.source.parent / name)
    for name, frames in films.items():
        pictures = hashlib.sha256()
        for path in frames.paths:
            with open_file(path, sys.maxsize) as file:
                while piece := file.read(1024**2):
                    pictures.update(piece)
        digests[f"{name}'s pictures" if spec.cameras else "frames' pictures"] = pictures.hexdigest()
    return digests

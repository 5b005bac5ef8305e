"""What is known of a flight before it is reconstructed: its telemetry behind the gate, and what an analyst assumes.

An assumption is part of the flight: `Flight.with_` gives another flight in which it differs, and everything that is
computed from that flight rests on it. Nothing here opens ``truth/``; only `postflight.scoring` does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from flightmodel.atmosphere import standard_sounding
from flightmodel.checks import ConfigError, GateError, Issue, Progress, check_path, nearest_name
from flightmodel.config import parse_section
from flightmodel.files import file_bytes
from flightmodel.flightfolder import assumed_of
from flightmodel.flightfolder import read_flight as read_telemetry
from flightmodel.instruments import LoadsEntry, LoadsErrors
from flightmodel.tabular import Tabular
from flightmodel.telemetry import LoadsTable, Sounding, Telemetry
from flightmodel.vehicle import MassProperties, Vehicle
from recon.settings import Settings

if TYPE_CHECKING:
    from estimators.loads import FlightLoads
    from postflight.loads_table import ReadLoads

READ = "pf.read_flight(folder)"
RECONSTRUCT = "pf.reconstruct(flight)"
PULSE_RATE_HZ = 50.0
_ON_TOP = ("c_a", "c_n", "c_m", "cg_shift_body_m", "density", "wind")  # what acts on earlier changes
SETTINGS = {f.name for f in fields(Settings)}


@dataclass(frozen=True, repr=False)
class Flight(Tabular):
    """A measured flight with the assumptions of one analysis.

    Parameters
    ----------
    telemetry : Telemetry
        Everything measured, and what flight.toml states of vehicle, start and motion.
    settings : Settings
        Of the reconstruction; those of ``[reconstruction]`` in flight.toml where not given.
    camera_plane_lv_rad : float or None
        Clocking angle of the plane in which the camera's deflection is assumed to lie; None where it is estimated.
    folder : Path or None
        Where it was read from.
    changes : tuple of str
        What differs from the folder, one sentence a change (``"c_n = 1.1"``).
    as_read : mapping of str to bytes
        flight.toml and the vehicle's files as they were read; a run keeps them.
    """

    telemetry: Telemetry
    settings: Settings = None  # type: ignore[assignment]
    camera_plane_lv_rad: float | None = None
    folder: Path | None = None
    changes: tuple[str, ...] = ()
    as_read: Mapping[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take the settings that the flight's file states where none are given."""
        if self.settings is None:
            stated = {"pulse_rate_hz": PULSE_RATE_HZ, **self.telemetry.reconstruction}
            object.__setattr__(self, "settings", Settings.from_mapping(stated))

    @property
    def name(self) -> str:
        """Name of the flight in flight.toml."""
        return self.telemetry.name

    @property
    def vehicle(self) -> Vehicle | None:
        """The vehicle as assumed; None where flight.toml names none."""
        return self.telemetry.vehicle

    @property
    def findings(self) -> tuple[Issue, ...]:
        """Findings of the gate in the data: gaps, frozen and missing samples, repairs of row order."""
        return self.telemetry.findings

    @property
    def loads(self) -> FlightLoads | None:
        """Loads of the table that ``[loads]`` names, with the vehicle as assumed; None for a flight without one."""
        return None if self.read_loads is None else self.read_loads.loads

    @cached_property
    def read_loads(self) -> ReadLoads | None:
        """The table that ``[loads]`` names, as it was read; None for a flight without one."""
        from postflight.loads_table import read_table_of_loads

        table = self.telemetry.loads
        if table is None:
            return None
        vehicle = self.telemetry.required_vehicle()
        return read_table_of_loads(table.path, vehicle, table.columns, table.stated, table.time_s)

    @property
    def assumed(self) -> dict[str, dict[str, float]]:
        """Standard deviations that neither flight.toml nor a column of the table of loads states, by table and key."""
        known = set() if self.read_loads is None else self.read_loads.stated
        return {
            table: {key: sd for key, sd in sizes.items() if table != "loads" or key not in known}
            for table, sizes in self.telemetry.assumed.items()
        }

    def with_(self, **changes: Any) -> Flight:
        """Return a flight in which these assumptions differ.

        Factors and shifts act on those of earlier changes: ``with_(c_n=1.2).with_(c_n=1.0)`` has 1.2. All else is
        replaced.

        Parameters
        ----------
        c_a, c_n, c_m : float
            Factor on the coefficient of the vehicle's table, at every Mach number and angle.
        mass_kg : float
            Total mass; both bodies in proportion, their c.g. and inertia tensors as they are.
        cg_shift_body_m : (3,) float
            Shift of the vehicle's c.g., body axes; the centerbody carries it. The c.g. stays inside the vehicle.
        joint_station_m : float
            Joint aft of the nose, inside the vehicle.
        density : float
            Factor on the sounding's density and pressure, temperature as it is.
        wind : float or None
            Factor on the sounding's winds; None for still air.
        attitude_prior : None
            Without the attitude that flight.toml states.
        camera_plane_lv_deg : float or None
            Assumed plane of the camera's deflection; None to estimate it.
        **settings : object
            Any field of `Settings` (``without=("radar_a",)``, ``engine="filterpy"``, ``output_rate_hz=50.0``); of a
            table of loads instead any of its errors (``flow_angle_sd_deg=0.5``).

        Raises
        ------
        ConfigError
            Names that are no assumption, values that cannot be, sources that the flight does not have; all at once.
        """
        from recon.setup import check_sources  # it brings the filter's kernels, which a flight is read without

        flight = self
        faults: list[str] = []
        for name, value in changes.items():
            try:
                kept = [c for c in flight.changes if name in _ON_TOP or not c.startswith(f"{name} = ")]
                flight = replace(_changed(flight, name, value), changes=(*kept, f"{name} = {value}"))
            except GateError as fault:
                faults += fault.faults
        try:
            check_sources(flight.telemetry, flight.settings)
        except ConfigError as fault:
            faults += fault.faults
        if faults:
            raise ConfigError(faults)
        return flight

    def to_frame(self) -> pd.DataFrame:
        """One row a source: ``source, kind, samples, first_s, last_s, rate_hz``."""
        t = self.telemetry
        rows = [(name, "radar", r.time_s) for name, r in t.radars.items()]
        rows += [(name, "receiver", r.time_s) for name, r in t.gnss.items()]
        rows += [(name, "barometer", r.time_s) for name, r in t.barometers.items()]
        inertial = (("accelerometer", t.accelerometer), ("rates", t.rates), ("magnetometer", t.magnetometer))
        rows += [(name, "inertial" if name != "magnetometer" else "field", r.time_s) for name, r in inertial if r]
        rows += [("sun", "Sun sensors", t.sun.time_s)] if t.sun is not None else []
        rows += [("loads", "trajectory", self.loads.time_s)] if self.loads is not None else []
        several = len(t.films) > 1
        rows += [(name if several else "frames", "video", film.time_s) for name, film in t.films.items()]
        table = []
        for name, kind, time_s in rows:
            span = time_s[-1] - time_s[0]
            rate = (len(time_s) - 1) / span if span > 0.0 else np.nan
            table.append((name, kind, len(time_s), time_s[0], time_s[-1], rate))
        return pd.DataFrame(table, columns=["source", "kind", "samples", "first_s", "last_s", "rate_hz"])

    def _about(self) -> str:
        what = f"{self.name}{', synthetic' if self.telemetry.synthetic else ''}, {len(self.to_frame())} sources"
        return "; ".join((what, *self.changes))


def read_flight(folder: str | Path, progress: Progress | None = None, needs_path: bool = True) -> Flight:
    """Read a flight folder through the gate.

    Parameters
    ----------
    folder : path
        With ``flight.toml`` and its tables.
    progress : callable, optional
        Called with the fraction done and what is being done.
    needs_path : bool
        Whether a flight without any tracker is refused; the camera alone needs none, nor do ``[loads]``.

    Raises
    ------
    ConfigError
        flight.toml or the vehicle file cannot be used; every fault at once.
    GateError
        A table cannot be used; every fault at once.
    """
    report: Callable[[float], None] | None = None
    if progress is not None:
        report = lambda fraction: progress(fraction, "reading telemetry")  # noqa: E731
    folder = check_path("read_flight: folder", folder)
    telemetry = read_telemetry(folder, report, needs_path)
    flight = Flight(telemetry, folder=folder, as_read=_as_read(folder, telemetry))
    _ = flight.loads  # whose table is refused here, not later
    return flight


def flight_of_table(table: Path, vehicle: Vehicle, columns: Mapping[str, str], entry: LoadsEntry) -> Flight:
    """Flight that has a table of loads and nothing else, as `postflight.film_alone` makes one of a film."""
    telemetry = Telemetry(
        table.stem, "", False, vehicle, None, None, {}, standard_sounding(), None,
        loads=LoadsTable(table, entry, dict(columns)), assumed={"loads": assumed_of(entry)},
    )  # fmt: skip
    return Flight(telemetry)


def _as_read(folder: Path, telemetry: Telemetry) -> dict[str, bytes]:
    """Content of flight.toml and the vehicle's files; `GateError` if they have changed since they were read."""
    places = {"flight.toml": (folder / "flight.toml", "flight.toml")}
    vehicle = telemetry.vehicle
    if vehicle is not None:
        beside = vehicle.source.parent
        places[f"vehicle/{vehicle.source.name}"] = vehicle.source, f"vehicle {vehicle.name}"
        places |= {f"vehicle/{name}": (beside / name, f"vehicle's {name}") for name in vehicle.files}
    out = {place: file_bytes(path) for place, (path, _) in places.items()}
    for place, (path, digest) in places.items():
        if hashlib.sha256(out[place]).hexdigest() != telemetry.hashes[digest]:
            raise GateError(f"{path}: changed while the flight was read; try again", "inputs-changed")
    return out


def calm(sounding: Sounding) -> Sounding:
    """Sounding without winds."""
    return with_wind(sounding, 0.0)


def with_wind(sounding: Sounding, factor: float) -> Sounding:
    """Sounding with its winds multiplied."""
    return replace(
        sounding, wind_north_mps=factor * sounding.wind_north_mps, wind_east_mps=factor * sounding.wind_east_mps
    )


def with_density(sounding: Sounding, factor: Any) -> Sounding:
    """Sounding with density and pressure multiplied by one factor or one per level ``(n,)``, temperature unchanged."""
    return replace(sounding, density_kgpm3=factor * sounding.density_kgpm3, pressure_pa=factor * sounding.pressure_pa)


def with_mass(telemetry: Telemetry, factor: float) -> Telemetry:
    """Telemetry with all of the vehicle's masses scaled by a factor, and its drag deceleration reduced accordingly."""
    motion = replace(telemetry.motion, drag_area_per_mass_m2pkg=telemetry.motion.drag_area_per_mass_m2pkg / factor)
    vehicle = telemetry.vehicle
    if vehicle is not None:
        vehicle = vehicle.with_bodies(lambda _, part: part.model_copy(update={"mass_kg": factor * part.mass_kg}))
    return replace(telemetry, motion=motion, vehicle=vehicle)


def _changed(flight: Flight, name: str, value: Any) -> Flight:
    """Telemetry with one assumption changed; `GateError` if it cannot be."""
    if flight.telemetry.loads is not None and name not in _OF_VEHICLE:
        return replace(flight, telemetry=_loads_error(flight.telemetry, name, value))
    if name in SETTINGS:
        return replace(flight, settings=_with_setting(flight.settings, name, value))
    if name == "camera_plane_lv_deg":
        return replace(flight, camera_plane_lv_rad=None if value is None else float(np.deg2rad(_number(name, value))))
    if name not in ASSUMPTIONS:
        known = (*ASSUMPTIONS, "camera_plane_lv_deg", *sorted(SETTINGS))
        hint = nearest_name(name, known)
        raise GateError(f"assumption '{name}'{hint}: no such assumption; known: {', '.join(known)}", "name-unknown")
    return replace(flight, telemetry=ASSUMPTIONS[name](flight.telemetry, name, value))


def _with_setting(settings: Settings, name: str, value: Any) -> Settings:
    if isinstance(value, list):
        value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
    elif isinstance(value, str) and isinstance(getattr(settings, name), tuple):
        value = (value,)
    try:
        return replace(settings, **{name: value})
    except TypeError as fault:
        raise GateError(f"setting {name} = {value!r}: {fault}", "value-range") from None


def _number(name: str, value: Any, low: float = -np.inf, high: float = np.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not low < float(value) < high:
        raise GateError(f"assumption {name} = {value!r}: a number between {low:g} and {high:g} wanted", "value-range")
    return float(value)


def _vehicle_of(telemetry: Telemetry, name: str) -> Vehicle:
    if telemetry.vehicle is None:
        raise GateError(f"assumption {name}: flight.toml names no vehicle", "vehicle-missing")
    return telemetry.vehicle


def _reach_m(vehicle: Vehicle) -> float:
    """Largest distance of the vehicle aft of its nose, m: of the centerbody, or of a shell drawn as a sharp cone."""
    shell = vehicle.geometry
    return max(shell.centerbody_length_m, float(shell.base_radius_m / np.tan(np.deg2rad(shell.half_angle_deg))))


def _coefficient(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    vehicle = _vehicle_of(telemetry, name)
    aero = vehicle.aero.scaled(**{name.replace("_", ""): _number(name, value, 0.0, 10.0)})
    return replace(telemetry, vehicle=replace(vehicle, aero=aero))


def _mass(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    return with_mass(telemetry, _number(name, value, 0.0, 1e7) / _vehicle_of(telemetry, name).mass_kg)


def _cg_shift(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    vehicle, wanted = _vehicle_of(telemetry, name), f"assumption {name} = {value!r}"
    try:
        shift = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        shift = np.zeros(0)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise GateError(f"{wanted}: three numbers in body axes, m, are wanted", "value-range")
    x, y, z = vehicle.cg_m + shift
    length, radius = _reach_m(vehicle), vehicle.geometry.base_radius_m
    if not (-length <= x <= 0.0 and np.hypot(y, z) <= radius):
        words = f"the c.g. would lie {-x:.3g} m aft of the nose and {np.hypot(y, z):.3g} m off the axis, outside the "
        raise GateError(f"{wanted}: {words}vehicle: {length:.3g} m and {radius:.3g} m at most", "value-range")
    carried = vehicle.mass_kg / vehicle.centerbody.mass_kg * shift

    def moved(name: str, part: MassProperties) -> MassProperties:
        cg = part.cg_m + (carried if name == "centerbody" else 0.0)
        return part.model_copy(update={"cg_from_datum_body_m": tuple(cg.tolist())})

    return replace(telemetry, vehicle=vehicle.with_bodies(moved))


def _joint_station(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    vehicle = _vehicle_of(telemetry, name)
    station, length = _number(name, value), _reach_m(vehicle)
    if not 0.0 <= station <= length:
        words = f"outside the vehicle, which reaches from the nose to {length:.3g} m aft of it"
        raise GateError(f"assumption {name} = {value!r}: {words}", "value-range")
    joint = vehicle.joint.model_copy(update={"station_m": station})
    return replace(telemetry, vehicle=replace(vehicle, joint=joint))


def _wind(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    factor = 0.0 if value is None else _number(name, value, -10.0, 10.0)
    return replace(telemetry, sounding=with_wind(telemetry.sounding, factor))


def _density(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    return replace(telemetry, sounding=with_density(telemetry.sounding, _number(name, value, 0.0, 10.0)))


def _attitude_prior(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    if value is not None:
        raise GateError([Issue(f"assumption {name}: only None (no prior) can be assumed", "value-range")])
    return replace(telemetry, attitude_prior=None)


def _loads_error(telemetry: Telemetry, name: str, value: Any) -> Telemetry:
    """Telemetry with another standard deviation in the table of loads."""
    table = telemetry.loads
    assert table is not None
    if name not in LoadsErrors.model_fields:
        known = (*_OF_VEHICLE, *LoadsErrors.model_fields)
        words = f"a table of loads takes none such{nearest_name(name, known)}; known: {', '.join(known)}"
        raise GateError(f"assumption '{name}': {words}", "name-unknown")
    stated = table.stated.model_dump(exclude_unset=True) | {name: value}
    entry = parse_section(LoadsEntry, stated, "assumption")
    return replace(telemetry, loads=replace(table, stated=entry), assumed={"loads": assumed_of(entry)})


_OF_VEHICLE = ("c_a", "c_n", "c_m", "mass_kg", "cg_shift_body_m", "joint_station_m", "camera_plane_lv_deg")
ASSUMPTIONS: dict[str, Callable[[Telemetry, str, Any], Telemetry]] = {
    "c_a": _coefficient,
    "c_n": _coefficient,
    "c_m": _coefficient,
    "mass_kg": _mass,
    "cg_shift_body_m": _cg_shift,
    "joint_station_m": _joint_station,
    "density": _density,
    "wind": _wind,
    "attitude_prior": _attitude_prior,
}

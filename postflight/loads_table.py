"""Loads by another trajectory program: one table of accelerations, rates and flow, as the estimators take them.

A team that has its own best-estimated trajectory needs no radar data and no filter of ours to estimate the deflection.
Columns and units are recognised as by ``postflight import``. What a header leaves open is refused, with the way to
state it; what a table does not state of its errors gets a default that widens the answer
(`estimators.loads.LoadsErrors`), unless a column ``<name>_sd`` states it.

Airspeed and Mach number give the speed of sound, airspeed and dynamic pressure the density. Both are compared with the
standard atmosphere at the table's altitude, and the axial force with the vehicle's C_A: a wrong unit, sign or vehicle
stands off by more than a day's air.

References
----------
AIAA 2011-2571, section II; US Standard Atmosphere, 1976.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from estimators.loads import MIN_AXIAL_MPS2, FlightLoads, LoadsColumns, LoadsErrors, loads_from_arrays
from flightmodel.airdata import lateral_angles
from flightmodel.atmosphere import sound_speed, us76
from flightmodel.checks import FloatArray, GateError, Issue, nearest_name
from flightmodel.config import parse_section
from flightmodel.deflection import lv_direction
from flightmodel.tables import to_si
from flightmodel.units import read_unit
from flightmodel.vehicle import Vehicle, read_vehicle
from postflight.intake.column_recognition import Recogniser, SourceProposal, column_unit
from postflight.intake.freeform_tables import FreeFormTable
from postflight.intake.headers import ColumnName
from postflight.intake.stored_tables import read_tables


class _Meaning(NamedTuple):
    """Kind of a quantity, and the words of a header that mean it."""

    kind: str
    words: tuple[str, ...]


# the longer name first: "alpha total" is no alpha
_SCALARS = {
    "mach": _Meaning("fraction", ("mach", "ma")),
    "dynamic_pressure": _Meaning("pressure", ("qbar", "dynamicpressure", "dynpressure", "dynp", "qdyn", "qinf", "q")),
    "airspeed": _Meaning("speed", ("airspeed", "tas", "vtas", "vair", "vrel", "velocity", "speed", "v")),
    "altitude": _Meaning("length", ("altitude", "alt", "height", "h")),
    "alpha_total": _Meaning("angle", ("alphatotalwind", "alphatotal", "totalalpha", "alphat", "totalangleofattack")),
    "clock": _Meaning("angle", ("clocklv", "clock", "clockangle", "clockingangle")),
    "alpha": _Meaning("angle", ("alpha", "aoa", "angleofattack")),
    "beta": _Meaning("angle", ("beta", "sideslip", "aos", "angleofsideslip")),
    "v_north": _Meaning("speed", ("vnorth", "vn", "northvelocity", "velocitynorth", "velnorth", "veln")),
    "v_east": _Meaning("speed", ("veast", "ve", "eastvelocity", "velocityeast", "veleast", "vele")),
    "v_down": _Meaning("speed", ("vdown", "vd", "downvelocity", "velocitydown", "veldown", "veld")),
    "wind_north": _Meaning("speed", ("windnorth", "northwind", "windn", "vwindnorth", "vwn")),
    "wind_east": _Meaning("speed", ("windeast", "eastwind", "winde", "vwindeast", "vwe")),
    "yaw": _Meaning("angle", ("yaw", "psi", "heading")),
    "pitch": _Meaning("angle", ("pitch", "theta")),
    "roll": _Meaning("angle", ("roll", "phi", "bank")),
}
_MOTION = ("v_north", "v_east", "v_down", "wind_north", "wind_east", "yaw", "pitch", "roll")
_WITH_SD = ("dynamic_pressure", "alpha", "beta", "alpha_total")
# columns of this program's own bet.csv that the recognition by words would not choose among several
_OWN = {
    "ax": "ax_cg_mps2", "ay": "ay_cg_mps2", "az": "az_cg_mps2",
    "p": "p_body_degps", "q": "q_body_degps", "r": "r_body_degps", "wind_sd": "wind_sd_mps",
}  # fmt: skip
# all of its columns that loads are made from
LOADS_COLUMNS = (
    "t_s", *_OWN.values(), "mach", "dynamic_pressure_pa", "dynamic_pressure_sd_pa", "airspeed_mps", "alt_m",
    "alpha_total_wind_deg", "alpha_total_wind_sd_deg", "clock_lv_deg",
)  # fmt: skip
_FORCE, _RATES = ("ax", "ay", "az"), ("p", "q", "r")
_TRIADS = {"sensors.accelerometer": _FORCE, "sensors.rates": _RATES}
# a day's temperature departs from the standard by a fifth at the most, in the mesosphere; the root of that
_SOUND_OFF = 0.12
_DENSITY_FACTOR, _STANDARD_HOLDS_M = 2.0, 80e3  # far beyond what a day's density departs from the standard's below
_AXIAL_FACTOR = 1.5  # of the vehicle's own: mass, area and C_A of a preflight model are known better by far


@dataclass
class _Columns:
    """Columns of a table in SI units by their short names; what could not be read is among the faults."""

    label: str
    values: dict[str, FloatArray] = field(default_factory=dict)
    faults: list[Issue] = field(default_factory=list)
    open: set[str] = field(default_factory=set)  # found, with a fault
    unused: list[str] = field(default_factory=list)

    def leave_open(self, short: str, words: str, code: str) -> None:
        """Keep what is wrong with a quantity's column."""
        self.open.add(short)
        self.faults.append(Issue(f"{self.label}: {words}", code))

    def has(self, *names: str) -> bool:
        """Whether all of them were found."""
        return all(name in self.values for name in names)


def read_loads(
    table: str | Path | pd.DataFrame,
    vehicle: str | Path | Vehicle,
    *,
    columns: Mapping[str, str] | None = None,
    acceleration_at: str | tuple[float, float, float] = "cg",
    **errors: Any,
) -> FlightLoads:
    """Loads of a flight from a table of another trajectory program.

    Parameters
    ----------
    table : path or DataFrame
        CSV in any layout, or another format that ``postflight import`` reads. It holds a time, the specific force
        (``ax, ay, az``), rates (``p, q, r``), an altitude, two of Mach number, dynamic pressure and airspeed, and the
        flow: ``alpha`` and ``beta``, or ``alpha_total`` and ``clock`` (LV clocking angle), or the velocity relative to
        the ground ``v_north, v_east, v_down``, the attitude ``yaw, pitch, roll`` (Euler angles 3-2-1 from north, east,
        down) and the air's own velocity ``wind_north, wind_east``, which also give the airspeed.
    vehicle : path, str or Vehicle
        Vehicle file, or the name of a shipped vehicle.
    columns : mapping of str to str, optional
        Which column is which quantity, where the header leaves that open: ``{"ax": "AX [g]"}``, or with its unit
        ``{"ax": "AX:g"}``.
    acceleration_at : "cg", name of a package, or (3,) float
        Place of the accelerometer: the undeflected c.g., a package of the vehicle file, or a place in body axes from
        the datum, m.
    **errors
        Keys of `estimators.loads.LoadsErrors`, such as ``flow_angle_sd_deg=0.5``.

    Returns
    -------
    FlightLoads
        For `estimate_misalignment`, `estimate_trim` and `fuse`.

    Raises
    ------
    GateError
        With every column that is missing or whose unit is open, or where columns contradict each other.
    """
    stated = parse_section(LoadsErrors, errors, "read_loads")
    made = vehicle if isinstance(vehicle, Vehicle) else read_vehicle(vehicle)
    return loads_and_unused(table, made, dict(columns or {}), acceleration_at, stated)[0]


def loads_and_unused(
    table: str | Path | pd.DataFrame,
    vehicle: Vehicle,
    columns: dict[str, str],
    acceleration_at: str | tuple[float, float, float],
    errors: LoadsErrors,
) -> tuple[FlightLoads, list[str]]:
    """Loads, and the names of the table's columns that were not used."""
    arm_m = _cg_from_sensor(vehicle, acceleration_at)
    found = _read(_as_table(table), columns)
    loads = loads_from_arrays(vehicle, _columns(found), errors, arm_m)
    _check(found.label, loads)
    return loads, found.unused


def _as_table(table: str | Path | pd.DataFrame) -> FreeFormTable:
    """The one table of a file, or a DataFrame as one."""
    if isinstance(table, pd.DataFrame):
        rows = [["" if pd.isna(cell) else str(cell) for cell in row] for row in table.itertuples(index=False)]
        return FreeFormTable("table", [str(name) for name in table.columns], [""] * table.shape[1], rows)
    held = read_tables(Path(table))
    if len(held) != 1:
        words = f"{table}: {len(held)} tables; save the one with the loads as CSV"
        raise GateError(words, "columns-ambiguous")
    return held[0]


def _cg_from_sensor(vehicle: Vehicle, at: str | tuple[float, float, float]) -> FloatArray:
    """From the accelerometer to the undeflected c.g., body axes (3,), m."""
    if at == "cg":
        return np.zeros(3)
    if isinstance(at, str):
        if at not in vehicle.sensors:
            known = ", ".join(("cg", *vehicle.sensors))
            words = f"acceleration_at '{at}'{nearest_name(at, vehicle.sensors)}: known are {known}, or a place"
            raise GateError(words, "name-unknown")
        at = vehicle.sensors[at].position_from_datum_body_m
    return np.asarray(vehicle.cg_m - np.asarray(at, dtype=float))


# columns


def _read(table: FreeFormTable, chosen: dict[str, str]) -> _Columns:
    """Every quantity that the table holds, with a fault for each that is open."""
    out = _Columns(table.label)
    own = {short: name for short, name in _OWN.items() if name in table.names}
    recogniser = Recogniser(table)
    _read_time(recogniser, chosen, out)
    stated = own | chosen
    for short, text in stated.items():
        _read_stated(recogniser, short, text, out)
    for source in recogniser.three_axis_sensors():
        if source.section in _TRIADS:
            _read_triad(recogniser, source, out)
    for short, meaning in _SCALARS.items():
        for name in (short, f"{short}_sd") if short in _WITH_SD else (short,):
            if name not in stated:
                _read_scalar(recogniser, name, meaning, out)
    out.unused = [table.names[k] for k in sorted(recogniser.free)]
    return out


def _read_time(recogniser: Recogniser, chosen: dict[str, str], out: _Columns) -> None:
    """Seconds in the table's own time column."""
    text = chosen.pop("t", None)
    if text is not None:
        _read_stated(recogniser, "t", text, out)
        return
    time = recogniser.time
    if time is None or time.format != "seconds":
        out.leave_open("t", 'no column of seconds; state it, as columns={"t": "TIME:s"}', "column-missing")
        return
    if not time.unit:
        out.leave_open(
            "t", f'time: {time.why}; state its unit, as columns={{"t": "{time.columns[0]}:s"}}', "unit-unknown"
        )
        return
    values = recogniser.table.numbers(recogniser.table.names.index(time.columns[0]))
    out.values["t"] = to_si(values.copy(), time.unit)


def _read_stated(recogniser: Recogniser, short: str, text: str, out: _Columns) -> None:
    """A quantity whose column, and unit behind a colon, is stated."""
    table, (name, _, unit) = recogniser.table, text.rpartition(":") if ":" in text else (text, "", "")
    if name not in table.names:
        out.leave_open(short, f"{short}: no column '{name}'{nearest_name(name, table.names)}", "column-missing")
        return
    k = table.names.index(name)
    kind = "time" if short == "t" else _kind_of(short)
    units = [unit] if unit else recogniser.named[k].units(kind) or (["1"] if kind == "fraction" else [])
    known = read_unit(units[0]) if units else None
    if known is None or known.kind != kind:
        out.leave_open(short, f"column '{name}' ({short}): state its unit of {kind}, as '{name}:UNIT'", "unit-unknown")
        return
    out.values[short] = to_si(table.numbers(k), units[0])
    recogniser.free.discard(k)


def _kind_of(short: str) -> str:
    """Kind of a quantity by its short name."""
    base = short.removesuffix("_sd")
    if base in _SCALARS:
        return _SCALARS[base].kind
    return "acceleration" if base in _FORCE else "rate" if base in _RATES else "speed"


def _read_triad(recogniser: Recogniser, source: SourceProposal, out: _Columns) -> None:
    """Three axes of accelerometer or gyros, as the importer recognises them."""
    shorts = _TRIADS[source.section]
    if out.has(*shorts):
        return
    for short, proposal in zip(shorts, source.columns, strict=True):
        if not proposal.unit:
            words = f"its unit is open ({proposal.why}); state it, as columns={{'{short}': '{proposal.column}:UNIT'}}"
            out.leave_open(short, f"column '{proposal.column}' ({short}): {words}", "unit-unknown")
            continue
        values = recogniser.table.numbers(recogniser.table.names.index(proposal.column))
        out.values.setdefault(short, to_si(values, proposal.unit))


def _read_scalar(recogniser: Recogniser, short: str, meaning: _Meaning, out: _Columns) -> None:
    """One quantity by the words of its header, the first of them that a column has."""
    table, wants_sd = recogniser.table, short.endswith("_sd")
    fitting = [k for k in sorted(recogniser.free) if _is_sd(recogniser.named[k]) == wants_sd]
    for word in meaning.words:
        for k in fitting:
            named = recogniser.named[k]
            if _stem(named, short) != word or (named.kinds and meaning.kind not in named.kinds):
                continue
            values = table.numbers(k)
            units = named.units(meaning.kind) or (["1"] if meaning.kind == "fraction" and not named.kinds else [])
            unit = units[0] if units else "" if named.unknown_unit else column_unit(short, meaning.kind, values)[0]
            if not unit:
                words = f"its unit of {meaning.kind} is open; state it, as columns={{'{short}': '{named.name}:UNIT'}}"
                out.leave_open(short, f"column '{named.name}' ({short}): {words}", "unit-unknown")
            else:
                out.values[short] = to_si(values, unit)
            recogniser.free.discard(k)
            return


def _stem(named: ColumnName, short: str) -> str:
    """Words of a name in one, without those that say whose it is or that it is a standard deviation."""
    said = {"sd", "sigma", "std", "deg", "body", "cg"} | (set() if short.startswith("wind") else {"wind"})
    return "".join(token for token in named.tokens if token not in said)


def _is_sd(named: ColumnName) -> bool:
    return bool({"sd", "sigma", "std"} & set(named.tokens))


# what follows from the columns


def _columns(found: _Columns) -> LoadsColumns:
    """Columns as the loads need them; `GateError` with everything that is missing."""
    faults, values = found.faults, found.values
    there = found.open | set(values)
    moving = {"v_north", "yaw"} <= there
    flow = "clock" if "alpha_total" in there else ", ".join(m for m in _MOTION if m not in there)
    flow = flow if moving or "alpha_total" in there else "alpha and beta"
    if set(_MOTION) <= there:
        there.add("airspeed")
    missing = [name for name in ("t", *_FORCE, *_RATES, "altitude") if name not in there]
    if not any(set(names) <= there for names in (("alpha", "beta"), ("alpha_total", "clock"), _MOTION)):
        missing.append(flow)
    if len({"mach", "dynamic_pressure", "airspeed"} & there) < 2:
        missing.append("two of mach, dynamic_pressure and airspeed")
    if missing:
        words = f'{found.label}: no column of {", ".join(missing)}; state which it is, as columns={{"ax": "NAME:UNIT"}}'
        faults.append(Issue(words, "column-missing"))
    if faults:
        raise GateError(faults)
    velocity = _velocity_air_body(values)
    _complete(values, velocity)
    rows = np.isfinite(np.column_stack([v for k, v in values.items() if not k.endswith("_sd")])).all(axis=1)
    at = {name: column[rows] for name, column in values.items()}
    return LoadsColumns(
        time_s=at["t"],
        specific_force_body_mps2=np.column_stack([at[name] for name in _FORCE]),
        rate_body_radps=np.column_stack([at[name] for name in _RATES]),
        flow_yz_rad=_flow(at, None if velocity is None else velocity[rows]),
        mach=at["mach"],
        dynamic_pressure_pa=at["dynamic_pressure"],
        airspeed_mps=at["airspeed"],
        altitude_m=at["altitude"],
        flow_sd_rad=_flow_sd(at),
        dynamic_pressure_sd_pa=_whole(at.get("dynamic_pressure_sd")),
        wind_sd_mps=_whole(at.get("wind_sd")),
    )


def _velocity_air_body(values: dict[str, FloatArray]) -> FloatArray | None:
    """Velocity relative to the air (n, 3), body axes, by velocity, wind and attitude; None where one is missing."""
    from scipy.spatial.transform import Rotation  # for the tables that state it

    if not set(_MOTION) <= set(values):
        return None
    v_north, v_east, v_down, wind_north, wind_east, *turns = (values[name] for name in _MOTION)
    known = np.isfinite(turns).all(axis=0)
    velocity = np.full((len(v_down), 3), np.nan)
    to_ned = Rotation.from_euler("ZYX", np.column_stack(turns)[known])
    velocity[known] = to_ned.inv().apply(np.column_stack([v_north - wind_north, v_east - wind_east, v_down])[known])
    return velocity


def _complete(values: dict[str, FloatArray], velocity: FloatArray | None) -> None:
    """Add the third of Mach number, dynamic pressure and airspeed by the standard atmosphere."""
    if velocity is not None:
        values.setdefault("airspeed", np.linalg.norm(velocity, axis=1))
    density, temperature, _ = us76(np.clip(values["altitude"], 0.0, 150e3))
    sound = sound_speed(values["altitude"], temperature)
    if "airspeed" not in values:
        values["airspeed"] = values["mach"] * sound
    values.setdefault("mach", values["airspeed"] / sound)
    values.setdefault("dynamic_pressure", 0.5 * density * values["airspeed"] ** 2)


def _flow(at: dict[str, FloatArray], velocity: FloatArray | None) -> FloatArray:
    """Total angle of attack as a lateral vector (n, 2), rad; by the velocity (n, 3) where no angles are stated."""
    if "alpha" in at and "beta" in at:
        ca, cb = np.cos(at["alpha"]), np.cos(at["beta"])
        velocity = np.column_stack([ca * cb, np.sin(at["beta"]), np.sin(at["alpha"]) * cb])
        return lateral_angles(velocity)
    if not {"alpha_total", "clock"} <= set(at):
        assert velocity is not None
        return lateral_angles(velocity)
    return np.asarray(at["alpha_total"][:, None] * lv_direction(at["clock"])[:, 1:])


def _flow_sd(at: dict[str, FloatArray]) -> FloatArray | None:
    """Standard deviation (n,) of each component of the flow, of the columns that state one."""
    stated = [at[name] for name in ("alpha_sd", "beta_sd", "alpha_total_sd") if name in at]
    return _whole(np.sqrt(np.mean(np.square(stated[:2]), axis=0))) if stated else None


def _whole(values: FloatArray | None) -> FloatArray | None:
    """A column of standard deviations where every row has one."""
    return values if values is not None and np.isfinite(values).all() else None


def _check(label: str, loads: FlightLoads) -> None:
    """Refuse columns that contradict each other: units, signs, or another vehicle."""
    rows = loads.informative & (loads.altitude_m < _STANDARD_HOLDS_M)
    if not rows.any():
        words = f"nowhere below {_STANDARD_HOLDS_M / 1e3:.0f} km is there {MIN_AXIAL_MPS2:.1f} m/s2 of drag along -x"
        forward = float(loads.specific_force_body_mps2[:, 0].max())
        if forward > MIN_AXIAL_MPS2:
            words += f", but up to {forward:.1f} m/s2 along +x: body x points out of the nose, and drag reads negative"
        raise GateError(f"{label}: {words}", "deceleration-too-small")
    at = loads.rows(rows)
    density, temperature, _ = us76(at.altitude_m)
    sound, air = at.airspeed_mps / at.mach, 2.0 * at.dynamic_pressure_pa / at.airspeed_mps**2
    standard = "of the standard atmosphere's at these altitudes"
    compared = (
        ("airspeed over Mach number", sound / sound_speed(at.altitude_m, temperature), standard, 1.0 + _SOUND_OFF),
        ("the density by dynamic pressure and airspeed", air / density, standard, _DENSITY_FACTOR),
        ("the axial force", _axial_ratio(at), "of the vehicle's C_A S q / m", _AXIAL_FACTOR),
    )
    faults = [
        Issue(f"{label}: {words} is {middle:.3g} {of}; check the units of these columns", "units-and-signs")
        for words, ratio, of, most in compared
        if not 1.0 / most < (middle := float(np.median(ratio))) < most
    ]
    if faults:
        raise GateError(faults)


def _axial_ratio(loads: FlightLoads) -> FloatArray:
    """Axial force over that of the vehicle file's axial coefficient (n,)."""
    vehicle = loads.vehicle
    angle = np.minimum(np.linalg.norm(loads.flow_yz_rad, axis=1), 0.5)
    axial = np.array([vehicle.aero.at(m, a)[0] for m, a in zip(loads.mach, angle, strict=True)])
    force = axial * vehicle.reference.area_m2 * loads.dynamic_pressure_pa / vehicle.mass_kg
    return np.asarray(-loads.specific_force_body_mps2[:, 0] / force)

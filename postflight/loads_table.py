"""Loads by another trajectory program: one table of accelerations, rates and flow, as the estimators take them.

A team that has its own best-estimated trajectory needs no radar data and no filter of ours to estimate the deflection.
Columns and units are recognised as by ``postflight import``. What a header leaves open is refused, with the way to
state it; what a table does not state of its errors gets a default that widens the answer
(`flightmodel.instruments.LoadsErrors`), unless a column ``<name>_sd`` states it.

Airspeed and Mach number give the speed of sound, airspeed and dynamic pressure the density. Both are compared with the
standard atmosphere at the table's altitude, and the axial force with the vehicle's C_A: a wrong unit, sign or vehicle
stands off by more than a day's air.

References
----------
AIAA 2011-2571, section II; US Standard Atmosphere, 1976.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from estimators.loads import MIN_AXIAL_MPS2, FlightLoads, LoadsColumns, loads_from_arrays
from flightmodel.airdata import lateral_angles
from flightmodel.atmosphere import sound_speed, us76
from flightmodel.checks import FloatArray, GateError, Issue, nearest_name
from flightmodel.config import parse_section
from flightmodel.deflection import lv_direction
from flightmodel.instruments import LoadsEntry
from flightmodel.vehicle import Vehicle, read_vehicle
from postflight.intake.freeform_tables import FreeFormTable
from postflight.intake.loads_columns import FORCE, MOTION, OWN_COLUMNS, RATES, FoundColumns, find_columns
from postflight.intake.stored_tables import read_tables

# all of its columns that loads are made from
LOADS_COLUMNS = (
    "t_s", *OWN_COLUMNS.values(), "mach", "dynamic_pressure_pa", "dynamic_pressure_sd_pa", "airspeed_mps", "alt_m",
    "alpha_total_wind_deg", "alpha_total_wind_sd_deg", "clock_lv_deg",
)  # fmt: skip
# errors that columns state, and the keys that they take the place of
_OWN_ERRORS = {
    "flow_sd_rad": "flow_angle_sd_deg", "dynamic_pressure_sd_pa": "dynamic_pressure_sd_percent",
    "wind_sd_mps": "wind_sd_mps",
}  # fmt: skip
# a day's temperature departs from the standard by a fifth at the most, in the mesosphere; the root of that
_SOUND_OFF = 0.12
_DENSITY_FACTOR, _STANDARD_HOLDS_M = 2.0, 80e3  # far beyond what a day's density departs from the standard's below
_AXIAL_FACTOR = 1.5  # of the vehicle's own: mass, area and C_A of a preflight model are known better by far


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
        Keys of `flightmodel.instruments.LoadsErrors`, such as ``flow_angle_sd_deg=0.5``.

    Returns
    -------
    FlightLoads
        For `estimate_misalignment`, `estimate_trim` and `fuse`.

    Raises
    ------
    GateError
        With every column that is missing or whose unit is open, or where columns contradict each other.
    """
    entry = parse_section(LoadsEntry, {"file": "", "acceleration_at": acceleration_at, **errors}, "read_loads")
    made = vehicle if isinstance(vehicle, Vehicle) else read_vehicle(vehicle)
    return read_table_of_loads(table, made, columns or {}, entry).loads


class ReadLoads(NamedTuple):
    """Loads, unused columns of the table, and keys of `LoadsErrors` whose values the table's columns state."""

    loads: FlightLoads
    unused: list[str]
    stated: set[str]


def read_table_of_loads(
    table: str | Path | pd.DataFrame, vehicle: Vehicle, columns: Mapping[str, str], entry: LoadsEntry,
    time_s: FloatArray | None = None,
) -> ReadLoads:  # fmt: skip
    """Loads from a table as flight.toml or a command describes it; ``time_s`` (n,) are its clock times, if any."""
    arm_m = _cg_from_sensor(vehicle, entry.acceleration_at)
    found = find_columns(_as_table(table), dict(columns), time_s)
    made = _columns(found, entry)
    loads = loads_from_arrays(vehicle, made, entry, arm_m)
    _check(found.table.label, loads)
    return ReadLoads(loads, found.unused, {key for name, key in _OWN_ERRORS.items() if getattr(made, name) is not None})


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


# what follows from the columns


def _columns(found: FoundColumns, entry: LoadsEntry) -> LoadsColumns:
    """Columns in the units and axes of the loads; `GateError` with everything that is missing."""
    faults = found.faults
    if missing := found.missing:
        found.leave_open(missing[0], f"no column of {', '.join(missing)}", "column-missing")
    if faults:
        raise GateError(faults)
    values = found.values()
    values["t"] += entry.time.offset_s
    velocity = _velocity_air_body(values)
    _complete(values, velocity)
    rows = np.isfinite(np.column_stack([v for k, v in values.items() if not k.endswith("_sd")])).all(axis=1)
    if entry.use_s is not None:
        rows &= np.any([(values["t"] >= start) & (values["t"] <= stop) for start, stop in entry.use_s], axis=0)
    at = {name: column[rows] for name, column in values.items()}
    return LoadsColumns(
        time_s=at["t"],
        specific_force_body_mps2=np.column_stack([at[name] for name in FORCE]),
        rate_body_radps=np.column_stack([at[name] for name in RATES]),
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

    if not set(MOTION) <= set(values):
        return None
    v_north, v_east, v_down, wind_north, wind_east, *turns = (values[name] for name in MOTION)
    known = np.isfinite(turns).all(axis=0)
    velocity = np.full((len(v_down), 3), np.nan)
    to_ned = Rotation.from_euler("ZYX", np.column_stack(turns)[known])
    velocity[known] = to_ned.inv().apply(np.column_stack([v_north - wind_north, v_east - wind_east, v_down])[known])
    return velocity


def _complete(values: dict[str, FloatArray], velocity: FloatArray | None) -> None:
    """Compute the missing one of Mach number, dynamic pressure and airspeed from the standard atmosphere."""
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
    """Standard deviation (n,) of each flow component, from the columns that state one."""
    stated = [at[name] for name in ("alpha_sd", "beta_sd", "alpha_total_sd") if name in at]
    return _whole(np.sqrt(np.mean(np.square(stated[:2]), axis=0))) if stated else None


def _whole(values: FloatArray | None) -> FloatArray | None:
    """A column of standard deviations where every row has one."""
    return values if values is not None and np.isfinite(values).all() else None


def _check(label: str, loads: FlightLoads) -> None:
    """Refuse columns that contradict each other or the vehicle, in units or signs."""
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
    """Axial force over the one predicted with the vehicle file's axial coefficient (n,)."""
    vehicle = loads.vehicle
    angle = np.minimum(loads.alpha_total_wind_rad, 0.5)
    axial = np.array([vehicle.aero.at(m, a)[0] for m, a in zip(loads.mach, angle, strict=True)])
    force = axial * vehicle.reference.area_m2 * loads.dynamic_pressure_pa / vehicle.mass_kg
    return np.asarray(-loads.specific_force_body_mps2[:, 0] / force)

"""How does each instrument's table become a checked record in SI?

One reader an instrument (`read_radar`, `read_gnss`, `read_barometer`, `read_triad`, `read_sun`, `read_frames`,
`read_sounding`): columns through the gate, what flight.toml states of errors through the instrument's table of rows
(`flightmodel.instruments`), faults and findings into the gate. A reader returns None where anything was refused.

Triads sampled far faster than a vehicle moves are replaced by means of blocks of about 1 ms. A block's mean keeps the
integral that the strapdown equations form from its samples, and the density of their noise; what is lost is motion
within a block. Winds that are given by where they come from become the velocity of the air mass (north, east).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from flightmodel import earth, tables
from flightmodel.atmosphere import (
    EARTH_RADIUS_US76_M,
    R_AIR_JPKGK,
    bottom_m,
    default_sounding_sd,
    gas_constant,
    height_from_pressure,
    profile_from_sounding,
)
from flightmodel.camera_edits import EDITS_FILE, NO_EDITS, CameraEdits, read_edits
from flightmodel.checks import BoolArray, FloatArray, GateError, IntArray, Issue, nearest_name
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.entry_state import fixed_axes
from flightmodel.film import Frames, film_fault, film_timing_fault, image_fault, working_camera
from flightmodel.gate import Gate, Table, find_faults, oversampled, rows_to_use
from flightmodel.instruments import (
    ACCELEROMETER,
    BAROMETER,
    GNSS,
    MAGNETOMETER,
    RADAR,
    RATES,
    SUN,
    AtmosphereEntry,
    BarometerEntry,
    BarometerSpec,
    FramesEntry,
    GnssEntry,
    GnssSpec,
    Heights,
    MagnetometerEntry,
    RadarEntry,
    RadarSite,
    RatesEntry,
    SunEntry,
    SunHeads,
    TriadEntry,
    TriadSpec,
)
from flightmodel.telemetry import (
    BarometerRecord,
    GnssRecord,
    RadarRecord,
    Sounding,
    SunRecord,
    TriadRecord,
)
from flightmodel.vehicle import CameraMount, Vehicle

ECEF, GEODETIC = ("x", "y", "z"), ("lat", "lon", "alt")
ECEF_SPEEDS, NED_SPEEDS = ("vx", "vy", "vz"), ("vn", "ve", "vd")
LEAST_DEPTH_M, LEAST_HEIGHT_M = 78e3, -12e3  # below the equator's radius, and below every ocean's floor
FASTEST_MPS = 2e4
LEAST_SD = 1e-12  # its square is a number that can be divided by
LOWEST_BAROMETER_M, HIGHEST_BAROMETER_M = -2000.0, 80e3


def read_radar(gate: Gate, name: str, source: RadarEntry) -> RadarRecord | None:
    """Read one tracker's readings; None, with the faults kept, where anything in it is refused."""
    label = f"radars.{name}"
    measured = tuple(q for q in tables.TRACKER if q.short in source.measures)
    noises = tuple(q for q in tables.TRACKER_SD if q.short.removesuffix("_sd") in source.measures)
    table = gate.table(label, source, measured + noises)
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults)
    limits = {
        "range": (1.0, np.inf, "no slant range"),
        "el": (-0.5 * np.pi, 0.5 * np.pi, "no elevation"),
        "range_rate": (-FASTEST_MPS, FASTEST_MPS, "no speed near the Earth"),
    }
    for q in measured:
        if q.short in limits:
            gate.refuse_rows(table, q.short, *limits[q.short])
    there = [q for q in noises if q.short in table.columns]
    for q in there:
        gate.refuse_rows(table, q.short, LEAST_SD, np.inf, "no standard deviation")
    if len(gate.faults) > before:
        return None
    if "az" in table.columns:
        table.columns["az"] = np.mod(table.columns["az"], 2.0 * np.pi)
    values = _columns(table, [q.short for q in tables.RADAR])
    read = np.column_stack([table.columns[q.short] for q in measured])
    whole = np.isfinite(read).all(axis=1)
    if not whole.any():
        words = " and ".join(q.short for q in measured)
        gate.refuse(f"{label}: {table.path}: no row with {words}; remove the tracker", "too-few-rows")
        return None
    gate.findings.extend(find_faults(name, table.time_s, tuple(q.short for q in measured), read))
    gate.findings.extend(oversampled(name, table.time_s, source.every_s, source.components))
    place = np.deg2rad([source.latitude_deg, source.longitude_deg])
    site = RadarSite(
        name, float(place[0]), float(place[1]), source.height_m, **RADAR.from_file(source),
        angle_servo_hz=source.angle_servo_hz,
    )  # fmt: skip
    sd = _columns(table, [q.short for q in tables.TRACKER_SD]) if there else None
    rate = table.columns.get("range_rate")
    return RadarRecord(site, table.time_s, values, source.tracks, source.every_s, rate, sd)


def _columns(table: Table, shorts: list[str]) -> FloatArray:
    """Columns (n, k) of a table, NaN where it has none."""
    nothing: FloatArray = np.full(len(table.lines), np.nan)
    return np.column_stack([table.columns.get(short, nothing) for short in shorts])


def read_gnss(
    gate: Gate, name: str, source: GnssEntry, t0_utc: str = "", planet: earth.Planet = earth.WGS84
) -> GnssRecord | None:
    """Read one receiver's fixes; None, with the faults kept, where anything in them is refused."""
    label = f"gnss.{name}"
    least = {"nsat": source.min_satellites, "fix_mode": source.min_fix_mode}
    asked = {short: count for short, count in least.items() if count is not None}
    counts = tuple(tables.GNSS_COUNTS[short] for short in asked)
    table = gate.table(label, source, tables.GNSS + tables.GNSS_SD + counts)
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults) + len(gate.config)
    stated = [q for q in tables.GNSS_SD if q.short in table.columns]
    for q in stated:
        gate.refuse_rows(table, q.short, LEAST_SD, np.inf, "no standard deviation")
    good = _good_fixes(gate, name, table, asked)
    if not good.any():
        return None
    time_s, table = table.time_s[good], table.of_rows(good)
    position = _positions(gate, table, source, planet)
    if position is None or len(gate.faults) + len(gate.config) > before:
        return None
    velocity = _velocities(gate, table, source, position, planet)
    if velocity is None:
        return None
    alone = _has_no_position(table)
    measured, names, what = (velocity, ECEF_SPEEDS, "velocity") if alone else (position, ECEF, "position")
    if not np.isfinite(measured).all(axis=1).any():
        gate.refuse(f"{label}: {table.path}: no fix with a whole {what}; remove the receiver", "too-few-rows")
        return None
    new = _new_fixes(np.column_stack([position, velocity]))
    if 2 <= new.sum() < len(new):
        gate.findings.append(_held(name, time_s, new))
        time_s, table, position, velocity = time_s[new], table.of_rows(new), position[new], velocity[new]
    position, velocity = fixed_axes(source.axes, t0_utc, time_s, position, velocity, planet)
    gate.findings.extend(find_faults(name, time_s, names, velocity if alone else position))
    gate.findings.extend(oversampled(name, time_s, source.every_s, source.components))
    spec = GnssSpec(name, np.array(source.antenna_from_datum_body_m), **GNSS.from_file(source))
    sd = _columns(table, [q.short for q in tables.GNSS_SD]) if stated else None
    return GnssRecord(spec, time_s, position, velocity, source.every_s, sd)


def _good_fixes(gate: Gate, name: str, table: Table, asked: dict[str, int]) -> BoolArray:
    """Which fixes (n,) have satellites and mode enough; a missing count is too few."""
    good = np.ones(len(table.lines), dtype=bool)
    for short, count in asked.items():
        with np.errstate(invalid="ignore"):
            enough = table.columns[short] >= count
        if not enough.all():
            what = "satellites" if short == "nsat" else "mode"
            words = f"{int((~enough).sum())} of {len(enough)} fixes have {what} below {count} and are left out"
            gate.findings.append(Issue(words, "too-few-rows", name))
        good &= enough
    if good.sum() < 2:
        gate.refuse(
            f"{table.label}: {table.path}: {good.sum()} fixes are good enough by flight.toml; lower what it asks",
            "too-few-rows",
        )
    return good


def _new_fixes(values: FloatArray) -> BoolArray:
    """Which rows (n,) of positions and velocities (n, 6) differ from the row before; NaN is equal to NaN."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.append(True, ~same.all(axis=1) | np.isnan(values[1:]).all(axis=1))


def _held(name: str, time_s: FloatArray, new: BoolArray) -> Issue:
    """Finding on a log that repeats the receiver's last fix: it counts once, at the time of its first row."""
    first = np.flatnonzero(new)
    held = time_s[np.append(first[1:], len(new)) - 1] - time_s[first]
    k = int(np.argmax(held))
    words = (
        f"{int((~new).sum())} of {len(new)} rows hold the fix of the row before and are left out, for up to "
        f"{held[k]:.3g} s: a fix counts once, at the time of its first row"
    )
    return Issue(words, "rows-left-out", name, float(time_s[first[k]]), float(time_s[first[k]] + held[k]))


def _positions(gate: Gate, table: Table, source: GnssEntry, planet: earth.Planet) -> FloatArray | None:
    """ECEF positions (n, 3), m, from the available columns; those declared in flight.toml take precedence."""
    whole = {form: set(form) <= set(table.columns) for form in (ECEF, GEODETIC)}
    stated = [form for form in (ECEF, GEODETIC) if set(form) & set(source.columns)]
    if len(stated) == 2:
        gate.refuse_config(
            f"{table.label}.columns declares {' '.join(ECEF)} and {' '.join(GEODETIC)}; keep one of the two",
            "columns-ambiguous",
        )
        return None
    form = stated[0] if stated else ECEF if whole[ECEF] else GEODETIC
    moves = source.velocity and set(ECEF_SPEEDS) <= set(table.columns)
    if _has_no_position(table) and moves and source.axes == "fixed":  # others turn with the planet at a place
        return np.full((len(table.lines), 3), np.nan)
    if not whole[form]:
        canonical = {q.short: q.canonical for q in tables.GNSS}
        absent = ", ".join(canonical[short] for short in form if short not in table.columns)
        gate.refuse(
            f"{table.label}: {table.path}: line 1: no column {absent}; a position is lat_deg, lon_deg, alt_m, or "
            f"x_ecef_m, y_ecef_m, z_ecef_m; without one a velocity is vx_ecef_mps, vy_ecef_mps, vz_ecef_mps; other "
            f"columns are declared in {table.label}.columns",
            "column-missing",
        )
        return None
    if source.axes != "fixed" and (form != ECEF or set(NED_SPEEDS) & set(table.columns)):
        words = (
            f'axes = "{source.axes}" goes with x, y, z and vx, vy, vz; other columns are of the planet: take axes out'
        )
        gate.refuse_config(f"{table.label}: {words}", "keys-conflict")
        return None
    if form == ECEF:
        position = np.column_stack([table.columns[short] for short in ECEF])
        radius = np.linalg.norm(position, axis=1)
        _refuse_fixes(gate, table, radius < planet.semi_major_m - LEAST_DEPTH_M, "lies inside the planet")
        return np.where(np.isfinite(radius)[:, None], position, np.nan)
    if source.height_is is None:
        words = 'alt is above what? write height_is = "ellipsoid" or height_is = "msl"'
        gate.refuse_config(f"{table.label}: {words}; the two differ by up to 107 m", "height-datum")
        return None
    gate.refuse_rows(table, "lat", -0.5 * np.pi, 0.5 * np.pi, "no latitude")
    gate.refuse_rows(table, "alt", LEAST_HEIGHT_M, np.inf, "below any ground")
    lat, lon, alt = (table.columns[short] for short in GEODETIC)
    gate.refuse_rows(table, "lon", -2.0 * np.pi, 2.0 * np.pi, "no longitude")
    _refuse_fixes(gate, table, (lat == 0.0) & (lon == 0.0), "is at latitude and longitude 0")
    undulation = source.to_ellipsoid_m(lat, lon)
    _note_geoid(gate, table.label.rpartition(".")[2], source, undulation)
    position = earth.ecef_from_geodetic(lat, lon, alt + undulation, planet)
    return np.where(np.isfinite(lat + lon + alt)[:, None], position, np.nan)


def _has_no_position(table: Table) -> bool:
    return not set(ECEF + GEODETIC) & set(table.columns)


def _note_geoid(gate: Gate, name: str, source: Heights, undulation_m: FloatArray) -> None:
    """Name what was added to heights above sea level where flight.toml states no undulation."""
    if source.height_is == "msl" and source.geoid_undulation_m is None and np.isfinite(undulation_m).any():
        low, high = np.nanmin(undulation_m), np.nanmax(undulation_m)
        size = f"{low:.1f} m" if high - low < 0.1 else f"{low:.1f} to {high:.1f} m"
        words = f"heights above mean sea level became ellipsoidal with EGM96's undulation, {size}"
        gate.findings.append(Issue(words, "values-converted", name))


def _refuse_fixes(gate: Gate, table: Table, bad: BoolArray, words: str) -> None:
    if bad.any():
        k, count = int(np.argmax(bad)), int(bad.sum())
        hint = "as receivers write that have none: leave the cells empty, or ask for min_satellites or min_fix_mode"
        gate.refuse(f"{table.at(k)}: the fix {words} ({count} in all), {hint}", "fix-impossible")


def _velocities(
    gate: Gate, table: Table, source: GnssEntry, position_ecef_m: FloatArray, planet: earth.Planet
) -> FloatArray | None:
    """ECEF velocities (n, 3), m/s, NaN where there are none; None, with a fault, where some components lack."""
    nothing: FloatArray = np.full(position_ecef_m.shape, np.nan)
    if not source.velocity:
        return nothing
    there = {form: set(form) & set(table.columns) for form in (ECEF_SPEEDS, NED_SPEEDS)}
    for form, found in there.items():
        if found and found != set(form):
            absent = ", ".join(sorted(set(form) - found))
            words = f"a velocity lacks {absent}; declare it in {table.label}.columns, or write velocity = false"
            gate.refuse(f"{table.label}: {table.path}: line 1: {words}", "column-missing")
            return None
    stated = [form for form in there if set(form) & set(source.columns)]
    form = stated[0] if len(stated) == 1 else ECEF_SPEEDS if there[ECEF_SPEEDS] else NED_SPEEDS
    if not there[form]:
        return nothing
    before = len(gate.faults)
    for short in form:
        gate.refuse_rows(table, short, -FASTEST_MPS, FASTEST_MPS, "no speed near the Earth")
    if len(gate.faults) > before:
        return None
    velocity = np.column_stack([table.columns[short] for short in form])
    whole = np.isfinite(velocity).all(axis=1)
    if form == NED_SPEEDS:
        # a velocity without a position has no local axes
        whole &= np.isfinite(position_ecef_m).all(axis=1)
        nothing[whole] = earth.ecef_from_ned(velocity[whole], position_ecef_m[whole], planet)
    else:
        nothing[whole] = velocity[whole]
    return nothing


def read_barometer(
    gate: Gate,
    name: str,
    source: BarometerEntry,
    sounding: Sounding | None,
    measured_air: bool,
    place: tuple[float, float] | None,
) -> BarometerRecord | None:
    """Read one barometer as heights above the ellipsoid; None, with the faults kept, where it is refused.

    Pressures become heights by the flight's air; ``measured_air``: whether that is a sounding, not the standard's.
    ``place``: latitude and longitude, rad, at which the geoid is taken; None where every tracker was refused.
    """
    label = f"barometers.{name}"
    table = gate.table(label, source, tables.BAROMETER)
    if table is None or table.time_s is None:
        return None
    form = _barometer_form(gate, table, source)
    if form is None or sounding is None or place is None:
        return None
    before = len(gate.faults)
    if form == "pressure":
        profile = profile_from_sounding(sounding)
        limits = profile.at(np.array([HIGHEST_BAROMETER_M, LOWEST_BAROMETER_M])).pressure_pa
        low, high = float(limits[0]), float(limits[1])
        gate.refuse_rows(table, "pressure", low, high, "no static pressure between -2 and 80 km")
    else:
        gate.refuse_rows(table, "height", LEAST_HEIGHT_M, HIGHEST_BAROMETER_M, "no height that a barometer can measure")
    if len(gate.faults) > before:
        return None
    if form == "pressure":
        height = height_from_pressure(profile, table.columns["pressure"])
        air = "the day's sounding" if measured_air else "the US Standard Atmosphere 1976"
        words = f"pressures became heights by {air}"
        if source.use_s is None:
            words += (
                "; near and above the speed of sound a port does not measure static pressure: use_s can leave that out"
            )
        gate.findings.append(Issue(words, "values-converted", name))
    else:
        height = table.columns["height"]
    undulation = source.to_ellipsoid_m(*place)
    _note_geoid(gate, name, source, undulation)
    height = height + undulation
    if not np.isfinite(height).any():
        gate.refuse(f"{label}: {table.path}: every reading is missing; remove the barometer", "too-few-rows")
        return None
    gate.findings.extend(find_faults(name, table.time_s, (form,), height[:, None]))
    gate.findings.extend(oversampled(name, table.time_s, source.every_s, source.components))
    return BarometerRecord(BarometerSpec(name, **BAROMETER.from_file(source)), table.time_s, height, source.every_s)


def _barometer_form(gate: Gate, table: Table, source: BarometerEntry) -> str | None:
    """Whether the table's heights or its pressures are read; None, with the faults kept, where that is not clear."""
    there = [short for short in ("height", "pressure") if short in table.columns]
    stated = [short for short in there if short in source.columns]
    clear = next((shorts for shorts in (there, stated) if len(shorts) == 1), None)
    form = clear[0] if clear else None
    if not there:
        words = "no column height_m and none pressure_pa; declare one of the two"
        gate.refuse(f"{table.label}: {table.path}: line 1: {words} in {table.label}.columns", "column-missing")
    elif form is None:
        words = "heights and pressures are both there; declare the one to read"
        gate.refuse_config(
            f"{table.label}: {words} in {table.label}.columns, as height or as pressure", "columns-ambiguous"
        )
    if form is not None and source.height_is is None:
        words = 'say height_is = "ellipsoid" or "msl" (pressures too), or "ground" with ground_height_m'
        gate.refuse_config(f"{table.label}: heights above what? {words}", "height-datum")
        return None
    if form == "pressure" and source.height_is == "ground":
        words = 'pressures are not above the ground: say height_is = "msl", and take ground_height_m out'
        gate.refuse_config(f"{table.label}: {words}", "height-datum")
        return None
    return form


Triad = TriadEntry | RatesEntry | MagnetometerEntry
TRIAD_COLUMNS = {
    TriadEntry: tables.ACCELEROMETER,
    RatesEntry: tables.RATES,
    MagnetometerEntry: tables.MAGNETOMETER,
}
TRIADS = {TriadEntry: ACCELEROMETER, RatesEntry: RATES, MagnetometerEntry: MAGNETOMETER}
BODY = "body"  # the mount of a triad along body axes
# package of the vehicle file where flight.toml names none
DEFAULT_PACKAGE = {TriadEntry: "suba", RatesEntry: BODY, MagnetometerEntry: "magnetometer"}


def read_triad(
    gate: Gate, name: str, source: Triad, vehicle: Vehicle | None, vehicle_stated: bool
) -> TriadRecord | None:
    """Read a triad; None, with the faults kept, where it is refused.

    ``vehicle`` is None where flight.toml states none, and where the stated one is refused.
    """
    quantities = TRIAD_COLUMNS[type(source)]
    if isinstance(source, TriadEntry):
        quantities = tuple(q for q in quantities if q.short in source.measures)
    mounting = _mounting(gate, name, source, vehicle, vehicle_stated)
    table = gate.table(f"sensors.{name}", source, quantities)
    if table is None or table.time_s is None:
        return None
    values = np.column_stack([table.columns[q.short] for q in quantities])
    if not np.isfinite(values).all(axis=1).any():
        gate.refuse(f"sensors.{name}: {table.path}: every sample is missing", "too-few-rows")
        return None
    gate.findings.extend(find_faults(name, table.time_s, tuple(q.short for q in quantities), values))
    if mounting is None:
        return None
    values = _columns(table, [q.short for q in TRIAD_COLUMNS[type(source)]])
    if isinstance(source, MagnetometerEntry) and source.reversed:
        values = -values
    stated = TRIADS[type(source)].from_file(source)
    if stated["bias_wander_sd"] == 0.0:
        stated["bias_time_constant_s"] = np.inf
    record, findings = averaged(TriadRecord(TriadSpec(name, *mounting, **stated), table.time_s, values))
    gate.findings.extend(findings)
    return record


def _mounting(
    gate: Gate, name: str, source: Triad, vehicle: Vehicle | None, vehicle_stated: bool
) -> tuple[FloatArray, FloatArray] | None:
    """Place (3,) and ``dcm_body_sensor`` (3, 3); None, with a fault kept, where no package of that name is known."""
    package = source.mount or DEFAULT_PACKAGE[type(source)]
    if source.axes is not None or package == BODY:
        return source.place_m, source.dcm_body_sensor
    if not vehicle_stated:
        why = "it states no mount" if source.mount is None else f"mount = '{package}' is a vehicle's package"
        words = (
            'write mount = "body" (along body axes) or axes = ["+x", "+y", "+z"] with the body axis of each of its axes'
        )
        gate.refuse_config(f"sensors.{name}: {why}, and flight.toml names no vehicle; {words}", "input-missing")
        return None
    if vehicle is None:  # refused already
        return None
    if package not in vehicle.sensors:
        known = [*vehicle.sensors, BODY]
        hint = nearest_name(package, known)
        gate.refuse_config(f"sensors.{name}.mount = '{package}'{hint}: not on vehicle '{vehicle.name}'", "name-unknown")
        return None
    mount = vehicle.sensors[package]
    return np.array(mount.position_from_datum_body_m), mount.dcm_body_sensor


def read_sun(gate: Gate, source: SunEntry) -> SunRecord | None:
    """Read the Sun heads; None, with the faults kept, where anything in the table is refused."""
    heads = len(source.heads_lv_deg)
    quantities = tables.sun_quantities(heads)
    table = gate.table("sensors.sun", source, quantities)
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults)
    for q in quantities:
        # an elevation may pass 90 deg by its noise
        limit = np.pi if q.short.startswith("az") else 0.6 * np.pi
        gate.refuse_rows(table, q.short, -limit, limit, "no angle of a head")
    if len(gate.faults) > before:
        return None
    values = np.column_stack([table.columns[q.short] for q in quantities])
    seen = np.isfinite(values.reshape(-1, heads, 2)).all(axis=2)
    dark = np.asarray(seen.sum(axis=1) == 0)
    if dark.all():
        gate.refuse(f"sensors.sun: {table.path}: no head ever sees the Sun; remove [sensors.sun]", "too-few-rows")
        return None
    gate.findings.extend(find_faults("sun", table.time_s, tuple(q.short for q in quantities), values, dark))
    clock, field = np.deg2rad(source.heads_lv_deg), float(np.deg2rad(source.field_deg))
    spec = SunHeads("sun", clock, field, **SUN.from_file(source))
    return SunRecord(spec, table.time_s, values.reshape(-1, heads, 2))


def read_frames(gate: Gate, source: FramesEntry, vehicle: Vehicle | None, label: str = "frames") -> Frames | None:
    """Read the list of frames and check every picture; None, with the faults kept, where anything is refused.

    ``label`` is the table of ``flight.toml`` that states it.
    """
    if source.columns:
        gate.refuse_config(f"{label}.columns: the frame list has only t_s and frame", "name-unknown")
    if (source.folder is None) == (source.film is None):
        gate.refuse_config(
            f"{label}: one of folder (of images) and film (a .webm, .mp4 or .avi file) is wanted", "keys-conflict"
        )
        return None
    path, images = gate.path(source.file), gate.path(source.film or source.folder or "")
    if vehicle is not None and source.camera not in vehicle.cameras:
        hint = nearest_name(source.camera, list(vehicle.cameras))
        gate.refuse_config(f"{label}.camera = '{source.camera}'{hint}: not on vehicle '{vehicle.name}'", "name-unknown")
        return None
    if path is None or images is None or vehicle is None:
        return None
    table = gate.csv(path, label)
    if table is None:
        return None
    time_s = tables.times_s(table, source.time_column, gate.t0, path, label, gate.faults)
    if "frame" not in table.columns:
        gate.refuse(
            f"{label}: {path}: line 1: no column 'frame'{nearest_name('frame', table.columns)}", "column-missing"
        )
        return None
    camera = vehicle.cameras[source.camera]
    used = np.ones(len(table), dtype=bool)
    if time_s is not None:
        time_s = time_s + source.time.offset_s
        used, findings = rows_to_use(label, source, time_s)
        gate.findings.extend(findings)
        time_s = time_s[used]
    before = len(gate.faults)
    if source.film is None:
        paths, numbers = _image_paths(gate, images, table, used, path, camera, label), None
    else:
        paths, numbers = (images,), _film_numbers(gate, images, table, used, path, camera, label)
    if time_s is None or len(gate.faults) > before:
        return None
    if not len(time_s):
        gate.refuse(f"{label}: {path}: use_s leaves no frame", "too-few-rows")
        return None
    if not time_s[0] - 2.0 <= source.benchmark_s <= time_s[-1] + 2.0:
        span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s"
        gate.refuse_config(f"{label}.benchmark_s = {source.benchmark_s}: frames span {span}", "time-not-covered")
        return None
    edits = _edits(gate, label, source.camera, time_s, vehicle)
    benchmark_s = source.benchmark_s if edits.benchmark_s is None else edits.benchmark_s
    frames = Frames(camera, source.camera, time_s, paths, benchmark_s, numbers, source.time_bias_sd_s, edits)
    return reduced(gate.findings, label, frames)


def reduced(findings: list[Issue], label: str, frames: Frames) -> Frames:
    """Frames with their pictures read smaller, and a finding, where the camera is finer than is needed."""
    filed_px, camera = frames.camera.size_px, working_camera(frames.camera)
    if camera.size_px == filed_px:
        return frames
    words = f"pictures of {filed_px[0]} x {filed_px[1]} pixels, read at {camera.width_px} x {camera.height_px}"
    findings.append(Issue(words, "frame-size", label))
    edits = frames.edits.resized(filed_px, camera.size_px)
    return replace(frames, camera=camera, edits=edits, filed_px=filed_px)


def _edits(gate: Gate, label: str, name: str, time_s: FloatArray, vehicle: Vehicle) -> CameraEdits:
    """What an analyst decided about a camera's film; nothing, with the faults kept, where the table is refused."""
    path = gate.folder / EDITS_FILE
    if not path.exists():
        return NO_EDITS
    wrong = gate.wrong_place(path, EDITS_FILE)
    if wrong:
        gate.refuse(wrong, getattr(wrong, "code", ""))
        return NO_EDITS
    try:
        camera = vehicle.cameras[name]
        edits = read_edits(path, name, time_s, camera.size_px, vehicle.cameras)
    except GateError as fault:
        gate.faults.extend(f for f in fault.faults if f not in gate.faults)  # of several cameras each reads the table
        return NO_EDITS
    if edits.rows:
        gate.findings.append(Issue(f"edits by hand ({EDITS_FILE}): {edits}", "edited-by-hand", label))
    return edits


def _image_paths(
    gate: Gate, images: Path, table: pd.DataFrame, used: BoolArray, path: Path, camera: CameraMount, label: str
) -> tuple[Path, ...]:
    """Path of every frame's image; what is wrong with one becomes a fault."""
    names, paths = table["frame"].astype(str).str.strip(), []
    for row in np.flatnonzero(used).tolist():
        image = images / names.iloc[row]
        wrong = gate.wrong_place(image, names.iloc[row]) or image_fault(image, camera.size_px)
        if wrong:
            where = f"{label}: {path}: line {tables.line_of(table, row)}: {image}"
            gate.refuse(
                f"{where}: {wrong}; replace the file or remove the line", getattr(wrong, "code", "file-unreadable")
            )
        paths.append(image)
    return tuple(paths)


def _film_numbers(
    gate: Gate, film: Path, table: pd.DataFrame, used: BoolArray, path: Path, camera: CameraMount, label: str
) -> IntArray:
    """Frame number in the film of every frame; problems become faults."""
    text = table["frame"].astype(str).str.strip()
    whole = text.str.fullmatch(r"\d{1,9}").to_numpy(dtype=bool)
    for row in np.flatnonzero(used & ~whole)[:5].tolist():
        where = f"{label}: {path}: line {tables.line_of(table, row)}: frame '{text.iloc[row]}'"
        gate.refuse(
            f'{where}: with film = "{film.name}" a frame\'s number is wanted, the first being 0', "frame-missing"
        )
    numbers = np.array([int(t) for t in text.to_numpy()[used & whole]], dtype=np.int64)
    if len(numbers) and (np.diff(numbers) < 0).any():
        row = int(np.flatnonzero(used & whole)[int(np.argmax(np.diff(numbers) < 0)) + 1])
        where = f"{label}: {path}: line {tables.line_of(table, row)}"
        gate.refuse(f"{where}: frame numbers fall where times rise; sort the list by time", "frame-missing")
    wrong = film_fault(film, camera.size_px, int(numbers.max(initial=0)))
    if wrong:
        gate.refuse(f"{label}: {film}: {wrong}", getattr(wrong, "code", "file-unreadable"))
        return numbers
    again = int((np.diff(numbers) == 0).sum())
    if again:
        words = f"{path.name}: {again} of {len(numbers)} lines name the same frame as the line before; check the list"
        gate.findings.append(Issue(words, "frame-frozen", label))
    timing = film_timing_fault(film)
    if timing:
        gate.findings.append(Issue(f"{film.name}: {timing}", timing.code, label))
    return numbers


LARGEST_RATE_HZ = 2000.0  # samples that come slower are used as they are
WANTED_RATE_HZ = 1000.0  # a sine of 100 Hz, beyond structure and joint, loses 1.6 % in means of 1 ms
STEADY = 0.99  # part of the steps that must be the usual one within a fifth
WHOLE = 0.75  # part of a block's samples that its mean needs
# of readings in whole counts: fewer show no pattern; more values than half the samples are no counts beyond noise
_LEAST_LEVELS, _MOST_LEVELS = 5, 0.5


def averaged(record: TriadRecord) -> tuple[TriadRecord, list[Issue]]:
    """Means of blocks at about 1 kHz of a record of more than 2 kHz, and a finding; other records as they are.

    Noise and resolution of the record's data sheet become those of a mean. A record whose rate changes is left as it
    is: its means would not all have one noise.
    """
    step = np.diff(record.time_s)
    usual = float(np.median(step))
    count = int(1.0 / (usual * WANTED_RATE_HZ) + 0.5)
    if usual * LARGEST_RATE_HZ >= 1.0 or np.mean(np.abs(step - usual) < 0.2 * usual) < STEADY:
        return record, []
    del step
    block = ((record.time_s - record.time_s[0]) / (count * usual) + 0.5 / count).astype(np.int64)
    first = np.flatnonzero(np.diff(block, prepend=-1))
    whole = np.diff(first, append=len(block)) >= WHOLE * count
    time_s = _means(record.time_s, first, 1.0)[whole]
    means = np.column_stack([_means(column, first, WHOLE * count)[whole] for column in record.measured_sensor.T])
    spec = replace(
        record.spec, noise_sd=record.spec.noise_sd / np.sqrt(count), resolution=record.spec.resolution / np.sqrt(count)
    )
    words = f"{len(block)} samples at {1.0 / usual:.0f} Hz, of which means of {count} are used"
    return TriadRecord(spec, time_s, means), [Issue(words, "samples-averaged", spec.name)]


def with_least_count(record: TriadRecord) -> tuple[TriadRecord, list[Issue]]:
    """Record whose resolution is the least count that its readings show, and a finding, where that is not stated.

    Readings of a converter are whole multiples of one step. Left out are steps below the noise, which hides them.
    """
    step = max(map(_least_count, record.measured_sensor.T))
    if step <= 1.1 * max(record.spec.noise_sd, record.spec.resolution):
        return record, []
    words = f"readings are multiples of {step:.3g} (SI), more than noise and resolution state: taken for resolution"
    finding = Issue(words, "least-count", record.spec.name)
    return replace(record, spec=replace(record.spec, resolution=step)), [finding]


def _least_count(column: FloatArray) -> float:
    """Least count: the step that divides nearly all differences of readings (n,); 0 if there is none."""
    known = column[np.isfinite(column)]
    known = known[np.abs(known) <= np.median(np.abs(known))] if len(known) else known  # a short pulse repeats none
    levels = np.unique(known)
    if len(levels) < _LEAST_LEVELS or len(levels) > _MOST_LEVELS * len(known):
        return 0.0
    steps = np.diff(levels)
    step = float(np.quantile(steps, 0.1))
    whole = np.abs(steps / step - np.round(steps / step)) < 0.05  # printed to so many digits
    return step if whole.mean() > STEADY else 0.0


def _means(column: FloatArray, first: IntArray, least: float) -> FloatArray:
    """Mean of the values that are there from each of ``first`` to the next; NaN where fewer than ``least`` are."""
    there = np.isfinite(column)
    count = np.add.reduceat(there, first, dtype=np.int64)
    sums = np.add.reduceat(np.where(there, column, 0.0), first)
    return np.where(count >= least, sums / np.maximum(count, 1), np.nan)


SOURCE = "atmosphere"
TINY = 1e-30
SMALLEST_SD = 1e-6  # a fraction, and m/s
# pressure may depart from the gas law by this much before it is worth a word (separate instruments, humidity)
GAS_LAW_TOLERANCE = 0.05
LOWEST_TOP_M = 60e3
HEATED_M = 100e3  # the thermosphere begins below, and has 400 K of the standard's at 124 km
BALLOON_TOP_M = 32e3  # above it the densities' own errors grow
HYDROSTATIC_TOLERANCE = 0.15  # over a scale height, from two densities with errors of 2 %: 5 sd


def read_sounding(gate: Gate, source: AtmosphereEntry, planet: earth.Planet = earth.WGS84) -> Sounding | None:
    """Read the sounding; None, with the faults kept in the gate, where it cannot be used."""
    table = gate.table(SOURCE, source, tables.ATMOSPHERE, timed=False)
    if table is None:
        return None
    before = len(gate.faults)
    lowest = -1000.0 if planet == earth.WGS84 else bottom_m(planet)
    gate.refuse_rows(table, "alt", lowest, 2.0e5, f"outside {lowest / 1000:.0f} to 200 km")
    gate.refuse_rows(table, "rho", TINY, 2.0, "no density of the Earth's air")
    hottest = np.where(table.columns["alt"] > HEATED_M, 2000.0, 400.0)
    gate.refuse_rows(table, "temperature", 80.0, hottest, "outside 80 to 400 K, above 100 km to 2000 K")
    for short in ("wind_north", "wind_east", "wind_speed"):
        gate.refuse_rows(table, short, -300.0, 300.0, "above 300 m/s")
    gate.refuse_rows(table, "rho_sd", SMALLEST_SD, 10.0, "no standard deviation of a density, as a fraction")
    gate.refuse_rows(table, "wind_sd", SMALLEST_SD, 300.0, "no standard deviation of a wind")
    winds = _winds(gate, table, planet)
    if winds is None or len(gate.faults) > before:
        return None
    return _ordered(gate, table, winds, planet)


def _winds(gate: Gate, table: Table, planet: earth.Planet) -> tuple[FloatArray, FloatArray] | None:
    """North and east components of where the air goes."""
    c = table.columns
    if {"wind_north", "wind_east"} <= set(c):
        return c["wind_north"], c["wind_east"]
    if {"wind_speed", "wind_from"} <= set(c):
        words = "wind is given by where it comes from: converted to the velocity of the air mass"
        gate.findings.append(Issue(words, "values-converted", SOURCE))
        return -c["wind_speed"] * np.cos(c["wind_from"]), -c["wind_speed"] * np.sin(c["wind_from"])
    if planet != earth.WGS84 and not {"wind_north", "wind_east", "wind_speed", "wind_from"} & set(c):
        still = np.zeros(len(table.lines))  # no wind is known there but by models
        return still, still
    needs = "wind_n_mps and wind_e_mps, or wind speed and direction from"
    gate.refuse(f"{SOURCE}: {table.path}: line 1: needs {needs}", "column-missing")
    return None


def hydrostatic_error(altitude_m: FloatArray, pressure_pa: FloatArray, temperature_k: FloatArray) -> float:
    """Fractional excess of temperatures over those hydrostatically consistent with the pressure ``rho R T``.

    By ``d ln p / dh = -g / (R T)`` over each scale height below `BALLOON_TOP_M`: the largest; zero without a whole one.
    """
    low = altitude_m < BALLOON_TOP_M
    if low.sum() < 2:
        return 0.0
    h = EARTH_RADIUS_US76_M * altitude_m[low] / (EARTH_RADIUS_US76_M + altitude_m[low])
    cold = 1.0 / temperature_k[low]
    # scipy's cumulative_trapezoid is a tenth of a second to import
    over = np.concatenate([[0.0], np.cumsum(0.5 * (cold[1:] + cold[:-1]) * np.diff(h))])
    expected = STANDARD_GRAVITY_MPS2 / R_AIR_JPKGK * over
    at = np.arange(np.floor(expected[-1]) + 1.0)
    off = np.diff(np.interp(at, expected, -np.log(pressure_pa[low]))) - 1.0
    return float(off[np.argmax(np.abs(off))]) if len(off) else 0.0


def _ordered(gate: Gate, table: Table, winds: tuple[FloatArray, FloatArray], planet: earth.Planet) -> Sounding | None:
    c = table.columns
    whole = np.isfinite(c["alt"] + c["rho"] + c["temperature"] + winds[0] + winds[1])
    if not whole.all():
        k, count = int(np.argmin(whole)), int((~whole).sum())
        words = f"{count} rows with a missing value left out, the first at line {int(table.lines[k])}"
        gate.findings.append(Issue(words, "rows-left-out", SOURCE))
    rows = np.flatnonzero(whole)[np.argsort(c["alt"][whole], kind="stable")]
    alt, rho, temperature = c["alt"][rows], c["rho"][rows], c["temperature"][rows]
    if len(rows) < 2:
        gate.refuse(f"{SOURCE}: {table.path}: fewer than two complete rows", "too-few-rows")
        return None
    if (np.diff(alt) <= 0).any():
        k = int(rows[int(np.argmax(np.diff(alt) <= 0)) + 1])
        gate.refuse(f"{table.at(k)}: altitude {c['alt'][k]:.1f} m stands twice; keep one row", "rows-contradict")
        return None
    if alt[-1] < LOWEST_TOP_M:
        words = f"ends at {alt[-1] / 1000:.1f} km: above it the standard atmosphere is blended in, winds fade to zero"
        gate.findings.append(Issue(words, "sounding-short", SOURCE))
    pressure = rho * gas_constant(alt, planet) * temperature
    if "pressure" in c:
        off = np.abs(c["pressure"][rows] / pressure - 1.0)
        if np.nanmax(off, initial=0.0) > GAS_LAW_TOLERANCE:
            k = int(rows[int(np.nanargmax(off))])
            words = f"pressure departs from density and temperature by {100 * np.nanmax(off):.0f} % at line "
            gate.findings.append(Issue(f"{words}{int(table.lines[k])}; density is used", "sounding-balance", SOURCE))
    out_of_balance = hydrostatic_error(alt, pressure, temperature) if planet == earth.WGS84 else 0.0
    if abs(out_of_balance) > HYDROSTATIC_TOLERANCE:
        size, side = 100.0 * abs(out_of_balance), "high" if out_of_balance > 0.0 else "low"
        words = (
            f"temperatures are up to {size:.0f} % too {side} for the fall of density with height (hydrostatic "
            "balance): check the units of all three"
        )
        gate.findings.append(Issue(words, "sounding-balance", SOURCE))
    density_sd, wind_sd = default_sounding_sd(alt, planet)
    for key, default in (("rho_sd", density_sd), ("wind_sd", wind_sd)):
        if key in c:
            given = c[key][rows]
            default[np.isfinite(given)] = given[np.isfinite(given)]
    return Sounding(alt, rho, temperature, pressure, winds[0][rows], winds[1][rows], density_sd, wind_sd, planet)

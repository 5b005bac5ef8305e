"""Tables of what tells where the vehicle is: radars, satellite navigation receivers, barometers."""

from __future__ import annotations

import numpy as np

from flightmodel import columns, earth
from flightmodel.atmosphere import height_from_pressure, profile_from_sounding
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.findings import find_faults
from flightmodel.gate import Gate, Table
from flightmodel.instrument_entries import BarometerEntry, GnssEntry, RadarEntry
from flightmodel.instruments import BarometerSpec, GnssSpec, RadarSite
from flightmodel.selection import oversampled
from flightmodel.telemetry import BarometerRecord, Finding, GnssRecord, RadarRecord, Sounding

ECEF, GEODETIC = ("x", "y", "z"), ("lat", "lon", "alt")
ECEF_SPEEDS, NED_SPEEDS = ("vx", "vy", "vz"), ("vn", "ve", "vd")
LEAST_RADIUS_M, LEAST_HEIGHT_M = 6.3e6, -12e3  # below every ocean's floor
FASTEST_MPS = 2e4
LOWEST_BAROMETER_M, HIGHEST_BAROMETER_M = -2000.0, 80e3


def read_radar(gate: Gate, name: str, source: RadarEntry) -> RadarRecord | None:
    """Read one radar's track; None, with the faults kept, where anything in it is refused."""
    label = f"radars.{name}"
    table = gate.table(label, source, columns.RADAR)
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults)
    gate.refuse_rows(table, "range", 1.0, np.inf, "no slant range")
    gate.refuse_rows(table, "el", -0.5 * np.pi, 0.5 * np.pi, "no elevation")
    if len(gate.faults) > before:
        return None
    azimuth = np.mod(table.columns["az"], 2.0 * np.pi)
    values = np.column_stack([table.columns["range"], azimuth, table.columns["el"]])
    if not np.isfinite(values).all(axis=1).any():
        gate.faults.append(f"{label}: {table.path}: no track point with range, azimuth and elevation; remove the radar")
        return None
    gate.findings.extend(find_faults(name, table.time_s, ("range", "az", "el"), values))
    gate.findings.extend(oversampled(name, table.time_s, source.every_s))
    return RadarRecord(_site(name, source), table.time_s, values, source.tracks, source.every_s)


def _site(name: str, source: RadarEntry) -> RadarSite:
    lat, lon, angle_sd, angle_bias_sd = np.deg2rad(
        [source.latitude_deg, source.longitude_deg, source.angle_sd_deg, source.angle_bias_sd_deg]
    )
    mislevel, droop, skew, square, wander = np.deg2rad(
        [
            source.mislevel_sd_deg,
            source.droop_sd_deg,
            source.skew_sd_deg,
            source.nonorthogonality_sd_deg,
            source.wander_sd_deg,
        ]
    )
    own = [None if sd is None else float(np.deg2rad(sd)) for sd in (source.azimuth_sd_deg, source.elevation_sd_deg)]
    return RadarSite(
        name, lat, lon, source.height_m, source.range_sd_m, angle_sd, source.range_bias_sd_m, angle_bias_sd,
        source.time_bias_sd_s, mislevel, droop, skew, square, wander, source.wander_time_constant_s,
        source.refraction_sd, source.range_scale_sd, *own,
    )  # fmt: skip


def read_gnss(gate: Gate, name: str, source: GnssEntry) -> GnssRecord | None:
    """Read one receiver's fixes; None, with the faults kept, where anything in them is refused."""
    label = f"gnss.{name}"
    least = {"nsat": source.min_satellites, "fix_mode": source.min_fix_mode}
    asked = {short: count for short, count in least.items() if count is not None}
    table = gate.table(label, source, columns.GNSS + tuple(columns.GNSS_COUNTS[short] for short in asked))
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults) + len(gate.config)
    good = _good_fixes(gate, name, table, asked)
    if not good.any():
        return None
    time_s, table = table.time_s[good], table.of_rows(good)
    position = _positions(gate, table, source)
    if position is None or len(gate.faults) + len(gate.config) > before:
        return None
    if not np.isfinite(position).all(axis=1).any():
        gate.faults.append(f"{label}: {table.path}: no fix with a whole position; remove the receiver")
        return None
    velocity = _velocities(gate, table, source, position)
    if velocity is None:
        return None
    gate.findings.extend(find_faults(name, time_s, ("x", "y", "z"), position))
    gate.findings.extend(oversampled(name, time_s, source.every_s))
    return GnssRecord(_gnss_spec(name, source), time_s, position, velocity, source.every_s)


def _good_fixes(gate: Gate, name: str, table: Table, asked: dict[str, int]) -> BoolArray:
    """Which fixes (n,) have satellites and mode enough; a missing count is too few."""
    good = np.ones(len(table.lines), dtype=bool)
    for short, count in asked.items():
        with np.errstate(invalid="ignore"):
            enough = table.columns[short] >= count
        if not enough.all():
            what = "satellites" if short == "nsat" else "mode"
            words = f"{int((~enough).sum())} of {len(enough)} fixes have {what} below {count} and are left out"
            gate.findings.append(Finding(name, words, np.nan, np.nan))
        good &= enough
    if good.sum() < 2:
        gate.faults.append(
            f"{table.label}: {table.path}: {good.sum()} fixes are good enough by flight.toml; lower what it asks"
        )
    return good


def _positions(gate: Gate, table: Table, source: GnssEntry) -> FloatArray | None:
    """ECEF positions (n, 3), m, from whichever columns are there; those that flight.toml declares go first."""
    whole = {form: set(form) <= set(table.columns) for form in (ECEF, GEODETIC)}
    stated = [form for form in (ECEF, GEODETIC) if set(form) & set(source.columns)]
    if len(stated) == 2:
        gate.refuse_config(
            f"{table.label}.columns declares {' '.join(ECEF)} and {' '.join(GEODETIC)}; keep one of the two"
        )
        return None
    form = stated[0] if stated else ECEF if whole[ECEF] else GEODETIC
    if not whole[form]:
        canonical = {q.short: q.canonical for q in columns.GNSS}
        absent = ", ".join(canonical[short] for short in form if short not in table.columns)
        gate.faults.append(
            f"{table.label}: {table.path}: line 1: no column {absent}; a position is lat_deg, lon_deg, alt_m, or "
            f"x_ecef_m, y_ecef_m, z_ecef_m; other columns are declared in {table.label}.columns"
        )
        return None
    if form == ECEF:
        position = np.column_stack([table.columns[short] for short in ECEF])
        radius = np.linalg.norm(position, axis=1)
        _refuse_fixes(gate, table, radius < LEAST_RADIUS_M, "lies inside the Earth")
        return np.where(np.isfinite(radius)[:, None], position, np.nan)
    if source.height_is is None:
        words = 'alt is above what? write height_is = "ellipsoid", or height_is = "msl" with geoid_undulation_m'
        gate.refuse_config(f"{table.label}: {words}; the two differ by up to 107 m")
        return None
    gate.refuse_rows(table, "lat", -0.5 * np.pi, 0.5 * np.pi, "no latitude")
    gate.refuse_rows(table, "alt", LEAST_HEIGHT_M, np.inf, "below any ground")
    lat, lon, alt = (table.columns[short] for short in GEODETIC)
    gate.refuse_rows(table, "lon", -2.0 * np.pi, 2.0 * np.pi, "no longitude")
    _refuse_fixes(gate, table, (lat == 0.0) & (lon == 0.0), "is at latitude and longitude 0")
    position = earth.ecef_from_geodetic(lat, lon, alt + source.to_ellipsoid_m)
    return np.where(np.isfinite(lat + lon + alt)[:, None], position, np.nan)


def _refuse_fixes(gate: Gate, table: Table, bad: BoolArray, words: str) -> None:
    if bad.any():
        k, count = int(np.argmax(bad)), int(bad.sum())
        hint = "as receivers write that have none: leave the cells empty, or ask for min_satellites or min_fix_mode"
        gate.faults.append(f"{table.at(k)}: the fix {words} ({count} in all), {hint}")


def _velocities(gate: Gate, table: Table, source: GnssEntry, position_ecef_m: FloatArray) -> FloatArray | None:
    """ECEF velocities (n, 3), m/s, NaN where there are none; None, with a fault, where some components lack."""
    nothing: FloatArray = np.full(position_ecef_m.shape, np.nan)
    if not source.velocity:
        return nothing
    there = {form: set(form) & set(table.columns) for form in (ECEF_SPEEDS, NED_SPEEDS)}
    for form, found in there.items():
        if found and found != set(form):
            absent = ", ".join(sorted(set(form) - found))
            words = f"a velocity lacks {absent}; declare it in {table.label}.columns, or write velocity = false"
            gate.faults.append(f"{table.label}: {table.path}: line 1: {words}")
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
        # a velocity without a position cannot be turned
        whole &= np.isfinite(position_ecef_m).all(axis=1)
        nothing[whole] = earth.ecef_from_ned(velocity[whole], position_ecef_m[whole])
    else:
        nothing[whole] = velocity[whole]
    return nothing


def _gnss_spec(name: str, source: GnssEntry) -> GnssSpec:
    return GnssSpec(
        name,
        np.array(source.antenna_from_datum_body_m),
        source.horizontal_sd_m,
        source.vertical_sd_m,
        source.speed_sd_mps,
        source.vertical_speed_sd_mps,
        source.wander_sd_m,
        source.wander_time_constant_s,
        source.time_bias_sd_s,
    )


def read_barometer(
    gate: Gate, name: str, source: BarometerEntry, sounding: Sounding | None, measured_air: bool
) -> BarometerRecord | None:
    """Read one barometer as heights above the ellipsoid; None, with the faults kept, where it is refused.

    Pressures become heights by the flight's air; ``measured_air`` says whether that is a sounding or the standard's.
    """
    label = f"barometers.{name}"
    table = gate.table(label, source, columns.BAROMETER)
    if table is None or table.time_s is None:
        return None
    form = _barometer_form(gate, table, source)
    if form is None or sounding is None:
        return None
    before = len(gate.faults)
    if form == "pressure":
        profile = profile_from_sounding(sounding)
        limits = profile.at(np.array([HIGHEST_BAROMETER_M, LOWEST_BAROMETER_M])).pressure_pa
        low, high = float(limits[0]), float(limits[1])
        gate.refuse_rows(table, "pressure", low, high, "no static pressure between -2 and 80 km")
    else:
        gate.refuse_rows(table, "height", LEAST_HEIGHT_M, HIGHEST_BAROMETER_M, "no height that a barometer tells")
    if len(gate.faults) > before:
        return None
    if form == "pressure":
        height = height_from_pressure(profile, table.columns["pressure"])
        air = "the day's sounding" if measured_air else "the US Standard Atmosphere 1976"
        words = f"pressures became heights by {air}"
        if source.use_s is None:
            words += (
                "; near and above the speed of sound a port does not tell static pressure: use_s can leave that out"
            )
        gate.findings.append(Finding(name, words, np.nan, np.nan))
    else:
        height = table.columns["height"]
    height = height + source.to_ellipsoid_m
    if not np.isfinite(height).any():
        gate.faults.append(f"{label}: {table.path}: every reading is missing; remove the barometer")
        return None
    gate.findings.extend(find_faults(name, table.time_s, (form,), height[:, None]))
    spec = BarometerSpec(
        name,
        source.sd_m,
        source.bias_sd_m,
        source.scale_sd,
        source.wander_sd_m,
        source.wander_time_constant_s,
        source.time_bias_sd_s,
    )
    gate.findings.extend(oversampled(name, table.time_s, source.every_s))
    return BarometerRecord(spec, table.time_s, height, source.every_s)


def _barometer_form(gate: Gate, table: Table, source: BarometerEntry) -> str | None:
    """Whether the table's heights or its pressures are read; None, with the faults kept, where that is not clear."""
    there = [short for short in ("height", "pressure") if short in table.columns]
    stated = [short for short in there if short in source.columns]
    clear = next((shorts for shorts in (there, stated) if len(shorts) == 1), None)
    form = clear[0] if clear else None
    if not there:
        words = "no column height_m and none pressure_pa; declare one of the two"
        gate.faults.append(f"{table.label}: {table.path}: line 1: {words} in {table.label}.columns")
    elif form is None:
        words = "heights and pressures are both there; declare the one to read"
        gate.refuse_config(f"{table.label}: {words} in {table.label}.columns, as height or as pressure")
    if form is not None and source.height_is is None:
        words = 'say height_is = "ellipsoid", or height_is = "msl" with geoid_undulation_m (pressures too)'
        gate.refuse_config(f"{table.label}: heights above what? {words}")
        return None
    return form

"""The day's sounding through the gate: rows in order, winds turned to where the air goes, what is missing said."""

from __future__ import annotations

import numpy as np

from flightmodel import columns
from flightmodel.atmosphere import R_AIR_JPKGK, default_sounding_sd
from flightmodel.checks import FloatArray
from flightmodel.gate import Gate, Table
from flightmodel.instrument_entries import AtmosphereEntry
from flightmodel.telemetry import Finding, Sounding

SOURCE = "atmosphere"
TINY = 1e-30
SMALLEST_SD = 1e-6  # a fraction, and m/s
# pressure may depart from the gas law by this much before it is worth a word (separate instruments, humidity)
GAS_LAW_TOLERANCE = 0.05
LOWEST_TOP_M = 60e3


def read_sounding(gate: Gate, source: AtmosphereEntry) -> Sounding | None:
    """Read the sounding; None, with the faults kept in the gate, where it cannot be used."""
    table = gate.table(SOURCE, source, columns.ATMOSPHERE, timed=False)
    if table is None:
        return None
    before = len(gate.faults)
    gate.refuse_rows(table, "alt", -1000.0, 2.0e5, "outside -1 to 200 km")
    gate.refuse_rows(table, "rho", TINY, 2.0, "no density of the Earth's air")
    gate.refuse_rows(table, "temperature", 80.0, 400.0, "outside 80 to 400 K")
    for short in ("wind_north", "wind_east", "wind_speed"):
        gate.refuse_rows(table, short, -300.0, 300.0, "above 300 m/s")
    gate.refuse_rows(table, "rho_sd", SMALLEST_SD, 10.0, "no standard deviation of a density, as a fraction")
    gate.refuse_rows(table, "wind_sd", SMALLEST_SD, 300.0, "no standard deviation of a wind")
    winds = _winds(gate, table)
    if winds is None or len(gate.faults) > before:
        return None
    return _ordered(gate, table, winds)


def _winds(gate: Gate, table: Table) -> tuple[FloatArray, FloatArray] | None:
    """North and east components of where the air goes."""
    c = table.columns
    if {"wind_north", "wind_east"} <= set(c):
        return c["wind_north"], c["wind_east"]
    if {"wind_speed", "wind_from"} <= set(c):
        words = "wind is given by where it comes from: turned to where the air goes"
        gate.findings.append(Finding(SOURCE, words, np.nan, np.nan))
        return -c["wind_speed"] * np.cos(c["wind_from"]), -c["wind_speed"] * np.sin(c["wind_from"])
    needs = "wind_n_mps and wind_e_mps, or wind speed and direction from"
    gate.faults.append(f"{SOURCE}: {table.path}: line 1: needs {needs}")
    return None


def _ordered(gate: Gate, table: Table, winds: tuple[FloatArray, FloatArray]) -> Sounding | None:
    c = table.columns
    whole = np.isfinite(c["alt"] + c["rho"] + c["temperature"] + winds[0] + winds[1])
    if not whole.all():
        k, count = int(np.argmin(whole)), int((~whole).sum())
        words = f"{count} rows with a missing value left out, the first at line {int(table.lines[k])}"
        gate.findings.append(Finding(SOURCE, words, np.nan, np.nan))
    rows = np.flatnonzero(whole)[np.argsort(c["alt"][whole], kind="stable")]
    alt, rho, temperature = c["alt"][rows], c["rho"][rows], c["temperature"][rows]
    if len(rows) < 2:
        gate.faults.append(f"{SOURCE}: {table.path}: fewer than two complete rows")
        return None
    if (np.diff(alt) <= 0).any():
        k = int(rows[int(np.argmax(np.diff(alt) <= 0)) + 1])
        gate.faults.append(f"{table.at(k)}: altitude {c['alt'][k]:.1f} m stands twice; keep one row")
        return None
    if alt[-1] < LOWEST_TOP_M:
        words = f"ends at {alt[-1] / 1000:.1f} km: above it the standard atmosphere is blended in, no wind is known"
        gate.findings.append(Finding(SOURCE, words, np.nan, np.nan))
    pressure = rho * R_AIR_JPKGK * temperature
    if "pressure" in c:
        off = np.abs(c["pressure"][rows] / pressure - 1.0)
        if np.nanmax(off, initial=0.0) > GAS_LAW_TOLERANCE:
            k = int(rows[int(np.nanargmax(off))])
            words = f"pressure departs from density and temperature by {100 * np.nanmax(off):.0f} % at line "
            gate.findings.append(Finding(SOURCE, f"{words}{int(table.lines[k])}; density is used", np.nan, np.nan))
    density_sd, wind_sd = default_sounding_sd(alt)
    for key, default in (("rho_sd", density_sd), ("wind_sd", wind_sd)):
        if key in c:
            given = c[key][rows]
            default[np.isfinite(given)] = given[np.isfinite(given)]
    return Sounding(alt, rho, temperature, pressure, winds[0][rows], winds[1][rows], density_sd, wind_sd)

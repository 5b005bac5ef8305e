"""A radiosonde's table as the day's air: density from pressure, temperature and humidity, at geometric heights.

``rho = p / (R T_v)`` with the virtual temperature ``T_v = T / (1 - 0.378 e / p)`` and the vapour pressure ``e`` of the
dew point (Bolton, "The computation of equivalent potential temperature", 1980, eq. 10). Radiosondes give geopotential
heights ``h``; ``z = R h / (R - h)`` with R = 6356.766 km (US Standard Atmosphere 1976, eq. 19). Levels that hold only
wind or only temperature take the other from their neighbours: temperature along the logarithm of pressure, wind by
components along height; nothing beyond the first and last level that has it. Winds stay as they are told, by where they
come from: `flightmodel.sounding` turns them, and says so.
"""

from __future__ import annotations

import numpy as np

from flightmodel.atmosphere import EARTH_RADIUS_US76_M, R_AIR_JPKGK
from flightmodel.checks import FloatArray
from flightmodel.columns import to_si
from postflight.intake.evidence import single_unit
from postflight.intake.loose import LooseTable
from postflight.intake.propose import Reader

NEEDED = {"alt", "temperature", "pressure"}
ZERO_C_K = 273.15
LOWEST_M, HIGHEST_M = -1000.0, 2e5


def radiosonde_table(table: LooseTable) -> LooseTable | None:
    """Return the table of heights, density, temperature, pressure and wind; None where this is no radiosonde's.

    A table that has densities is none: its columns are declared as they are.
    """
    reader = Reader(table)
    found = {q.short: m for q, m in reader.air_columns().items()}
    wind = {"wind_speed", "wind_from"} <= set(found)
    if "rho" in found or not set(found) >= NEEDED or not wind or any(not m.unit for m in found.values()):
        return None
    c = {short: to_si(table.numbers(table.names.index(m.column)), m.unit) for short, m in found.items()}
    notes = [*table.notes, f"radiosonde: {', '.join(f'{m.column} as {s} in {m.unit}' for s, m in found.items())}"]
    dew = _dew_point(reader)
    height, p = c["alt"], c["pressure"]
    with np.errstate(invalid="ignore"):
        whole = (height > LOWEST_M) & (height < HIGHEST_M) & (p > 0.0)
    height = np.where(whole, height, np.nan)
    temperature, filled_t = _between(-np.log(np.where(whole, p, 1.0)), c["temperature"], whole)
    flow = c["wind_speed"][:, None] * np.column_stack([np.cos(c["wind_from"]), np.sin(c["wind_from"])])
    sides = [_between(height, component, whole) for component in flow.T]
    wetness = _between(-np.log(np.where(whole, p, 1.0)), dew, whole)[0] if dew is not None else np.full(len(p), np.nan)
    celsius = np.nan_to_num(wetness - ZERO_C_K, nan=-200.0)
    vapour = np.where(celsius > -150.0, 611.2 * np.exp(17.67 * celsius / np.maximum(celsius + 243.5, 1.0)), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        density = p * (1.0 - 0.378 * vapour / p) / (R_AIR_JPKGK * temperature)
    geometric = EARTH_RADIUS_US76_M * height / (EARTH_RADIUS_US76_M - height)
    from_deg = np.mod(np.rad2deg(np.arctan2(sides[1][0], sides[0][0])), 360.0)
    columns = [geometric, density, temperature, p, np.hypot(sides[0][0], sides[1][0]), from_deg]
    keep = whole & np.isfinite(np.column_stack(columns)).all(axis=1)
    rows = np.flatnonzero(keep)[np.argsort(geometric[keep], kind="stable")]
    rows = rows[np.diff(geometric[rows], prepend=-np.inf) > 0.0]
    if len(rows) < 3:
        return None
    notes += [
        f"temperature of {(filled_t & keep).sum()} levels and wind of {(sides[0][1] & keep).sum()} taken from their "
        "neighbours",
        f"{len(height) - len(rows)} levels left out: no height or pressure, or beyond the first or last that has both",
        "density by gas law" + (" with the dew point's vapour" if dew is not None else ", as of dry air"),
        "geopotential heights became geometric ones",
    ]
    names = ["alt_m", "rho_kgpm3", "t_k", "p_pa", "wind_speed_mps", "wind_from_deg"]
    cells = [[f"{v:.8g}" for v in row] for row in np.column_stack(columns)[rows]]
    return LooseTable(table.label, names, [""] * len(names), cells, notes)


def _dew_point(reader: Reader) -> FloatArray | None:
    for k in reader.columns_of("dewpoint"):
        values = reader.table.numbers(k)
        units = reader.named[k].units("temperature") or [single_unit("temperature", "temperature", values)[0]]
        if units[0]:
            return to_si(values, units[0])
    return None


def _between(at: FloatArray, values: FloatArray, whole: np.ndarray) -> tuple[FloatArray, np.ndarray]:
    """Values with the missing ones taken from their neighbours along ``at``, and which those are."""
    known = whole & np.isfinite(values)
    out = values.copy()
    if known.sum() < 2:
        return out, np.zeros(len(values), dtype=bool)
    order = np.flatnonzero(known)[np.argsort(at[known])]
    missing = whole & ~known
    out[missing] = np.interp(at[missing], at[order], values[order], left=np.nan, right=np.nan)
    return out, missing & np.isfinite(out)

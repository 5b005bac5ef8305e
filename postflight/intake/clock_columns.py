"""Where does a table's time stand, and how is it written?

Times of day (``HH:MM:SS``) become three columns and seconds since 1970 become ISO UTC, as flight.toml reads those.
"""

from __future__ import annotations

import re

import numpy as np

from flightmodel.checks import FloatArray
from postflight.intake.loose import LooseTable
from postflight.intake.proposal import ASKED, NUMBERS, STATED, TimeMapped
from postflight.intake.words import QUANTITY_WORDS, Named

IRIG = re.compile(r"^\d{1,3}:\d{1,2}:\d{2}:\d{2}([.,]\d+)?$")
OF_DAY = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)$")
ISO = re.compile(r"^\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}")
PARTS = ({"h", "hour", "hours", "stunde", "hh"}, {"m", "min", "minute", "mm"}, {"s", "sec", "second", "sekunde", "ss"})
ELSEWHERE = {"tow", "sod", "utc", "gmt", "gps", "week"}  # seconds of these do not start at t0
UNIX = (1e9, 2.5e9)
FASTEST_S, SLOWEST_S = 2e-5, 60.0


def split_clocks(table: LooseTable) -> None:
    """Add columns for times of day and for seconds since 1970; each is noted."""
    for k, name in enumerate(list(table.names)):
        first = [row[k] for row in table.rows[:20] if k < len(row) and row[k]]
        if first and all(OF_DAY.match(c) for c in first):
            parts = [OF_DAY.match(row[k]) if k < len(row) else None for row in table.rows]
            for number, short in enumerate(("h", "m", "s"), start=1):
                _add(table, f"{name}_{short}", [m[number].replace(",", ".") if m else "" for m in parts])
            table.notes.append(f"times of day in '{name}' became columns {name}_h, {name}_m, {name}_s")
        elif first and set(re.findall(r"[a-z]+", name.lower())) & {"time", "t", "unix", "epoch", "timestamp", "zeit"}:
            values = table.numbers(k)
            scale = next(
                (s for s in (1.0, 1e-3, 1e-6) if UNIX[0] < np.nanmin(values, initial=np.inf) * s < UNIX[1]), None
            )
            if scale is not None:
                stamps = (values * scale * 1e6).round()
                iso = [f"{np.datetime64(int(s), 'us')}Z" if np.isfinite(s) else "" for s in stamps]
                _add(table, f"{name}_utc", iso)
                table.notes.append(f"seconds since 1970 in '{name}' became ISO UTC in {name}_utc")


def _add(table: LooseTable, name: str, cells: list[str]) -> None:
    table.raw = None
    table.names.append(name)
    table.units.append("")
    for row, cell in zip(table.rows, cells, strict=True):
        row.append(cell)


def find_time(table: LooseTable, named: list[Named]) -> TimeMapped | None:
    """Return how the table's time is written, or None where no column holds one."""
    for pattern, form in ((IRIG, "irig_doy"), (ISO, "utc")):
        for k, name in enumerate(table.names):
            first = [row[k] for row in table.rows[:20] if k < len(row) and row[k]]
            if first and all(pattern.match(c) for c in first):
                return TimeMapped((name,), form, "", STATED, f"written as {first[0]}")
    parts = _hour_minute_second(table, named)
    seconds = [k for k in range(len(named)) if _is_time(named[k], table.numbers(k))]
    # a time of day is known to the second of UTC; a counter's zero is not
    if parts and not any(table.names[k] == "t_s" for k in seconds):
        others = tuple(table.names[k] for k in seconds)
        return TimeMapped(parts, "utc_hms", "", STATED, "hour, minute and second of the day", others=others)
    if not seconds:
        return None
    best = min(seconds, key=lambda k: (table.names[k] != "t_s", not named[k].units("time"), k))
    others = tuple(table.names[k] for k in seconds if k != best) + (parts or ())
    unit, how, why = _time_unit(named[best], table.numbers(best))
    asked = bool(set(named[best].tokens) & ELSEWHERE)
    return TimeMapped((table.names[best],), "seconds", unit, how, why, asked, others)


def _hour_minute_second(table: LooseTable, named: list[Named]) -> tuple[str, ...] | None:
    found = []
    for words, top in zip(PARTS, (24, 60, 61), strict=True):
        last = [k for k, n in enumerate(named) if (re.findall("[a-z]+", n.name.lower()) or [""])[-1] in words]
        last = [k for k in last if len(re.findall("[a-z]+", named[k].name.lower())) > 1 or len(named[k].name) > 1]
        fitting = [
            k for k in last if np.nanmax(table.numbers(k), initial=-1.0) < top and np.nanmin(table.numbers(k)) >= 0
        ]
        found.append(fitting)
    for h in found[0]:
        stem = re.findall("[a-z]+", table.names[h].lower())[:-1]
        mates = [
            next((k for k in some if re.findall("[a-z]+", table.names[k].lower())[:-1] == stem), None) for some in found
        ]
        if None not in mates and len(set(mates)) == 3:
            return tuple(table.names[k] for k in mates if k is not None)
    return None


def _is_time(named: Named, values: FloatArray) -> bool:
    if not (set(named.tokens) & QUANTITY_WORDS["time"] or named.units("time")) or named.kinds - {"time"} - {
        "magnetic field"
    }:
        return False
    known = values[np.isfinite(values)]
    if len(known) < 3 or len(known) < 0.9 * len(values):
        return False
    step = np.diff(known)
    return bool((step >= 0.0).mean() > 0.98 and (step > 0.0).any())


def _time_unit(named: Named, values: FloatArray) -> tuple[str, str, str]:
    units = named.units("time")
    if units:
        return units[0], STATED, f"'{named.unit_text}' in the header"
    known = values[np.isfinite(values)]
    step = np.diff(known)
    usual = float(np.median(step[step > 0.0]))
    whole = bool((known == np.round(known)).all())
    seen = f"steps of {usual:.4g}"
    if not whole and usual < SLOWEST_S and usual * 1e-3 < FASTEST_S * 10:
        return "s", NUMBERS, f"{seen}: as ms they would be {1e3 / usual:.3g} Hz"
    return "", ASKED, seen

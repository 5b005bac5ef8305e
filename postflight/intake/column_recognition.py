"""Which columns of a table belong to which sensor, in which unit, and which hold the time?

Quantity and unit come from the header's vocabulary (`postflight.intake.headers`). Where the header leaves a unit
open, the numbers decide if one unit alone is possible: 9.8 m/s^2 where a vehicle stands, a field of 22 to 67 uT at
the ground (15 to 100 with iron), 800 to 1100 hPa near the ground, no angle beyond a full turn, no body that rotates
at more than 400 rad/s. Otherwise it is asked: a proposal's ``how`` is ``stated`` (header), ``numbers`` or ``asked``,
and never a guess.

Times of day (``HH:MM:SS``) become three columns and seconds since 1970 become ISO UTC, as flight.toml reads those.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from flightmodel import tables
from flightmodel.checks import FloatArray
from flightmodel.config import FILL_IN_VALUE
from flightmodel.tables import Quantity
from postflight.intake.freeform_tables import FreeFormTable
from postflight.intake.headers import (
    AXES,
    BODY_RATES,
    MARKS,
    NED,
    QUANTITIES,
    SEVERAL_MEANINGS,
    VECTORS,
    ColumnName,
    matching,
    parse_column_name,
    unit_key,
)

STATED, NUMBERS, ASKED = "stated", "numbers", "asked"
FILL_IN_TOML = f'"{FILL_IN_VALUE}"'
_STEADY = 0.02  # of the mean: at rest the noise is no larger
_STEADY_ROWS = 50
_BANDS: dict[str, list[tuple[float, float, str]]] = {
    "acceleration": [(9.6, 10.0, "mps2"), (0.98, 1.02, "g"), (980.0, 1020.0, "mg"), (31.6, 32.8, "ftps2")],
    "magnetic field": [(15.0, 100.0, "ut"), (0.15, 1.0, "gauss"), (15e-6, 100e-6, "t"), (15e3, 100e3, "nt")],
    "pressure": [(6e4, 1.1e5, "pa"), (600.0, 1100.0, "hpa"), (60.0, 110.0, "kpa")],
    "temperature": [(150.0, 400.0, "k"), (-120.0, 60.0, "degc")],
    "density": [(0.5, 1.5, "kgpm3"), (500.0, 1500.0, "gpm3")],
}
_IRIG = re.compile(r"^\d{1,3}:\d{1,2}:\d{2}:\d{2}([.,]\d+)?$")
_OF_DAY = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)$")
_ISO = re.compile(r"^\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}")
_THREE_AXIS: dict[str, tuple[str, tuple[Quantity, ...]]] = {
    "acceleration": ("sensors.accelerometer", tables.ACCELEROMETER),
    "rate": ("sensors.rates", tables.RATES),
    "magnetic field": ("sensors.magnetometer", tables.MAGNETOMETER),
}
_ENDINGS = {"radars": "_radar", "gnss": "_gnss", "barometers": "_baro"}
_MOUNT = 'a package of the vehicle file, or "body"; or axes = ["+x", "+y", "+z"]: which body axis is each of its axes?'
_AIR = ("alt", "rho", "temperature", "pressure", "wind_speed", "wind_from")
_AIR_BY_COMPONENTS = ("wind_north", "wind_east")
_Family = tuple[tuple[str, ...], str]


@dataclass(frozen=True)
class ColumnProposal:
    """One column: the quantity's short name in flight.toml, its unit (empty where it is asked), how and why."""

    short: str
    column: str
    unit: str
    how: str
    why: str
    canonical: bool = False


@dataclass(frozen=True)
class TimeProposal:
    """Where the time is: columns, format, unit (of seconds; empty where it is asked), other candidates.

    ``repeats``: of rows of one time the first is meant.
    """

    columns: tuple[str, ...]
    format: str
    unit: str
    how: str
    why: str
    offset_asked: bool = False
    others: tuple[str, ...] = ()
    repeats: bool = False

    @property
    def is_open(self) -> bool:
        """Whether the unit or the offset of its seconds is asked for."""
        return self.format == "seconds" and (not self.unit or self.offset_asked)


@dataclass
class SourceProposal:
    """One table of flight.toml: its header (``sensors.rates``), columns, further keys as (key, TOML value, comment)."""

    section: str
    columns: list[ColumnProposal]
    keys: list[tuple[str, str, str]] = field(default_factory=list)
    time: TimeProposal | None = None


# units by numbers


def _vector_unit(kind: str, size: FloatArray) -> tuple[str, str]:
    """Return the unit of vectors of magnitudes (n,), and why; if it is open, an empty unit and the evidence."""
    if not len(size):
        return "", "no numbers"
    if kind == "acceleration":
        for part, where in ((size[:_STEADY_ROWS], "first"), (size[-_STEADY_ROWS:], "last")):
            mean = float(part.mean())
            if len(part) == _STEADY_ROWS and part.std() < _STEADY * mean:
                unit = _band(kind, mean)
                if unit:
                    return unit, f"steady at {mean:.4g} in the {where} rows, as at rest"
        return "", f"magnitude {float(np.median(size)):.3g} (median), nowhere steady at 1 g"
    if kind == "magnetic field":
        middle = float(np.median(size))
        return _band(kind, middle), f"magnitude {middle:.3g} (median)"
    if kind == "rate" and size.max() > 400.0:
        return "degps", f"up to {size.max():.4g}: no body rotates at so many rad/s"
    return "", f"magnitude up to {float(size.max()):.3g}"


def column_unit(short: str, kind: str, values: FloatArray) -> tuple[str, str]:
    """Return the unit of one column (n,), and why; if it is open, an empty unit and the evidence."""
    known = values[np.isfinite(values)]
    if not len(known):
        return "", "no numbers"
    low, high = float(known.min()), float(known.max())
    seen = f"{low:.5g} to {high:.5g}"
    most = max(abs(low), abs(high))
    if kind == "angle":
        limit = 0.5 * np.pi if short in ("lat", "el") else 2 * np.pi
        if most > 1e6:
            return "deg1e7", f"{seen}: whole numbers of 1e-7 deg"
        if limit * 1.01 < most <= (90.0 if short in ("lat", "el") else 360.0):
            return "deg", f"{seen}: too large for radians"
        return "", seen
    if kind in ("pressure", "density"):
        return _band(kind, high), f"largest {high:.5g}"
    if kind == "temperature":
        return _band(kind, float(np.median(known))), seen
    return "", seen


def _band(kind: str, value: float) -> str:
    fitting = [unit for low, high, unit in _BANDS[kind] if low <= value <= high]
    return fitting[0] if len(fitting) == 1 else ""


# time


def add_clock_columns(table: FreeFormTable) -> None:
    """Add columns for times and seconds of day and for seconds since 1970; each is noted in the table."""
    for k, name in enumerate(list(table.names)):
        first = table.cells(k, 20)
        words = re.findall(r"[a-z]+", name.lower())
        if first and all(_OF_DAY.match(c) for c in first):
            parts = [_OF_DAY.match(row[k]) if k < len(row) else None for row in table.rows]
            for number, short in enumerate(("h", "m", "s"), start=1):
                _add(table, f"{name}_{short}", [m[number].replace(",", ".") if m else "" for m in parts])
            table.notes.append(f"times of day in '{name}' became columns {name}_h, {name}_m, {name}_s")
        elif first and ({"".join(words), *words} & MARKS["of_day"] or {"of", "day"} <= set(words)):
            _add_seconds_of_day(table, k)
        elif first and set(words) & MARKS["since_1970"]:
            values = table.numbers(k)
            first_s = np.nanmin(values, initial=np.inf)
            scale = next((s for s in (1.0, 1e-3, 1e-6) if 1e9 < first_s * s < 2.5e9), None)
            if scale is not None:
                stamps = (values * scale * 1e6).round()
                iso = [f"{np.datetime64(int(s), 'us')}Z" if np.isfinite(s) else "" for s in stamps]
                _add(table, f"{name}_utc", iso)
                table.notes.append(f"seconds since 1970 in '{name}' became ISO UTC in {name}_utc")


def _add_seconds_of_day(table: FreeFormTable, k: int) -> None:
    """Add hour, minute and second where a column runs through seconds of one day, or of two."""
    name, values = table.names[k], table.numbers(k)
    known = values[np.isfinite(values)]
    if not len(known) or known.min() < 0.0 or known.max() >= 2 * 86400.0:
        return
    of_day = np.round(values, 9) % 86400.0
    parts = of_day // 3600.0, of_day % 3600.0 // 60.0, np.round(of_day % 60.0, 9)
    for short, part in zip("hms", parts, strict=True):
        _add(table, f"{name}_{short}", [f"{x:.11g}" if np.isfinite(x) else "" for x in part])
    table.notes.append(f"seconds of day in '{name}' became columns {name}_h, {name}_m, {name}_s")


def _add(table: FreeFormTable, name: str, cells: list[str]) -> None:
    table.raw = None
    table.names.append(name)
    table.units.append("")
    for row, cell in zip(table.rows, cells, strict=True):
        row.append(cell)


def column_names(table: FreeFormTable) -> list[ColumnName]:
    """Return the parsed column names of the table."""
    return [parse_column_name(n, u) for n, u in zip(table.names, table.units, strict=True)]


def find_time(table: FreeFormTable, named: list[ColumnName]) -> TimeProposal | None:
    """Return how the table's time is written, or None where no column holds one."""
    for pattern, form in ((_IRIG, "irig_doy"), (_ISO, "utc")):
        for k, name in enumerate(table.names):
            first = table.cells(k, 20)
            if first and all(pattern.match(c) for c in first):
                return TimeProposal((name,), form, "", STATED, f"written as {first[0]}")
    parts = _hour_minute_second(table, named)
    seconds = [k for k in range(len(named)) if _is_time(named[k], table.numbers(k))]
    # a time of day is known to the second of UTC; a counter's zero is not
    if parts and not any(table.names[k] == "t_s" for k in seconds) and not _coarser(table, parts, seconds):
        others = tuple(table.names[k] for k in seconds)
        return TimeProposal(parts, "utc_hms", "", STATED, "hour, minute and second of the day", others=others)
    if not seconds:
        return None
    best = min(seconds, key=lambda k: (table.names[k] != "t_s", not named[k].units("time"), k))
    others = tuple(table.names[k] for k in seconds if k != best) + (parts or ())
    unit, how, why = _time_unit(named[best], table.numbers(best))
    asked = bool(set(named[best].tokens) & MARKS["not_from_t0"])
    return TimeProposal((table.names[best],), "seconds", unit, how, why, asked, others)


def _coarser(table: FreeFormTable, parts: tuple[str, ...], seconds: list[int]) -> bool:
    """Whether most rows repeat the time of day of the previous row while a counter of seconds advances in them."""
    of_day = np.column_stack([table.numbers(table.names.index(c)) for c in parts])
    again = (of_day[1:] == of_day[:-1]).all(axis=1)
    if again.mean() <= 0.5:
        return False
    return any((np.diff(table.numbers(k))[again] > 0.0).mean() > 0.5 for k in seconds)


def _hour_minute_second(table: FreeFormTable, named: list[ColumnName]) -> tuple[str, ...] | None:
    """Columns of hour, minute and second whose names differ in their last part alone."""
    parts = [re.findall("[a-z]+", n.name.lower()) for n in named]
    found = []
    for part, top in (("hour", 24), ("minute", 60), ("second", 61)):
        last = [k for k, p in enumerate(parts) if p and p[-1] in MARKS[part] and (len(p) > 1 or len(named[k].name) > 1)]
        fitting = [
            k for k in last if np.nanmax(table.numbers(k), initial=-1.0) < top and np.nanmin(table.numbers(k)) >= 0
        ]
        found.append(fitting)
    for h in found[0]:
        mates = [next((k for k in some if parts[k][:-1] == parts[h][:-1]), None) for some in found]
        if None not in mates and len(set(mates)) == 3:
            return tuple(table.names[k] for k in mates if k is not None)
    return None


def _is_time(named: ColumnName, values: FloatArray) -> bool:
    if not (set(named.tokens) & QUANTITIES["time"] or named.units("time")):
        return False
    if named.kinds - {"time", "magnetic field"}:  # T, of a name's time, is also tesla
        return False
    known = values[np.isfinite(values)]
    if len(known) < 3 or len(known) < 0.9 * len(values):
        return False
    step = np.diff(known)
    return bool((step >= 0.0).mean() > 0.98 and (step > 0.0).any())


def _time_unit(named: ColumnName, values: FloatArray) -> tuple[str, str, str]:
    units = named.units("time")
    if units:
        return units[0], STATED, f"'{named.unit_text}' in the header"
    if named.unknown_unit:
        return "", ASKED, not_known(named)
    known = values[np.isfinite(values)]
    step = np.diff(known)
    usual = float(np.median(step[step > 0.0]))
    whole = bool((known == np.round(known)).all())
    seen = f"steps of {usual:.4g}"
    if not whole and usual < 60.0 and usual * 1e-3 < 2e-4:
        return "s", NUMBERS, f"{seen}: as ms they would be {1e3 / usual:.3g} Hz"
    return "", ASKED, seen


# sensors


class Recogniser:
    """One table being recognised; columns are claimed once."""

    def __init__(self, table: FreeFormTable) -> None:
        self.table = table
        self.named = column_names(table)
        self.time = find_time(table, self.named)
        self.fix_time = self._time_of_fixes()
        self.free = set(range(len(table.names)))
        self.spare: set[int] = set()  # understood, and not used
        if self.time is not None:
            self.free -= {table.names.index(c) for c in (*self.time.columns, *self.time.others)}
        self.name = re.sub(r"[^A-Za-z0-9_-]+", "_", table.label).strip("_")[:64] or "table"

    def proposals(self) -> tuple[list[SourceProposal], list[str]]:
        """Return what the table holds, and the names of columns that were recognised as nothing.

        Three-axis sensors first, whose columns come in threes; then radar, receiver, barometer, sounding.
        """
        if self.is_sounding():
            self.time = None
            found = self._sounding()
        elif self.time is None:
            found = []
        else:
            found = self.three_axis_sensors() + self.radar() + self._receiver() + self._barometer()
        for source in found:
            is_receiver = source.section.startswith("gnss.")
            source.time = self.fix_time if is_receiver and self.fix_time is not None else self.time
        return _named_apart(found), [self.table.names[k] for k in sorted(self.free | self.spare)]

    def _time_of_fixes(self) -> TimeProposal | None:
        """Time of day of the fixes, which a faster log repeats until the next fix; None if there is none."""
        if self.time is None or self.time.format != "seconds" or self.time.columns == ("t_s",):
            return None
        parts = _hour_minute_second(self.table, self.named)
        if parts is None:
            return None
        zero = " ".join(self.time.columns)
        why = f"hour, minute and second repeat until the next fix: its own; t0_utc is then when '{zero}' is 0"
        return TimeProposal(parts, "utc_hms", "", STATED, why, others=self.time.columns, repeats=True)

    # three axes

    def _families(self) -> dict[_Family, dict[int, int]]:
        """Columns whose names differ by an axis alone: (stem, family) -> column by axis."""
        out: dict[_Family, dict[int, int]] = {}
        for k in sorted(self.free):
            for stem, family, axis in _axes_of(self.named[k].tokens):
                out.setdefault((stem, family), {}).setdefault(axis, k)
        return {key: by_axis for key, by_axis in out.items() if len(by_axis) == 3}

    def three_axis_sensors(self) -> list[SourceProposal]:
        """Claim the columns of accelerometer, gyros and magnetometer."""
        found: dict[str, SourceProposal] = {}
        for (stem, family), by_axis in self._families().items():
            at = [by_axis[a] for a in range(3)]
            if not set(at) <= self.free:
                continue
            kind, why = self._vector_kind(stem, family, at)
            if kind not in _THREE_AXIS or _THREE_AXIS[kind][0] in found:
                continue
            section, quantities = _THREE_AXIS[kind]
            source = SourceProposal(section, self._vector_columns(kind, quantities, at, why))
            if family == "numbered":
                source.keys.append(("mount", FILL_IN_TOML, f"{_MOUNT} (1, 2, 3 are taken for x, y, z)"))
            elif family != "body" and not all(m.canonical for m in source.columns):
                source.keys.append(("mount", FILL_IN_TOML, _MOUNT))
            self.free -= set(at)
            found[section] = source
        return list(found.values())

    def _vector_kind(self, stem: tuple[str, ...], family: str, at: list[int]) -> tuple[str, str]:
        stated = self._stated(at)
        worded = [kind for kind, vocabulary in VECTORS.items() if matching(stem, vocabulary)]
        if family == "body" and (not stem or "rate" in worded or stated == {"rate"}):
            return ("rate", "names of body rates") if stated in (set(), {"rate"}) else ("", "")
        if not stated and not worded and "g" in stem and self._beside_accelerometer(at):
            return "rate", "beside ax, ay, az"
        fitting = [kind for kind in worded if not stated or kind in stated]
        if len(stated) == 1:
            kind = next(iter(stated))
            # a unit alone does not identify a vector, except where only one sensor has it
            if kind in ("rate", "magnetic field", "acceleration") or kind in worded:
                return kind, "unit"
            return "", ""
        if stated == {"acceleration", "magnetic field"} and not worded and self._is_g(at):
            return "acceleration", "three axes"
        if stated and len(fitting) != 1:
            return "", ""
        return (fitting[0], "name") if len(fitting) == 1 else ("", "")

    def _beside_accelerometer(self, at: list[int]) -> bool:
        """Whether gx, gy, gz stand beside ax, ay, az without other gyros, and are not gravity's direction."""
        every = {named.tokens for named in self.named}
        mates = [tuple("a" + t[1:] if t in ("gx", "gy", "gz") else t for t in self.named[k].tokens) for k in at]
        if not all(m in every and m != self.named[k].tokens for m, k in zip(mates, at, strict=True)):
            return False
        families = self._families()
        if any(family == "body" or matching(stem, VECTORS["rate"]) for stem, family in families):
            return False
        size = self._sizes(at)
        return len(size) > 0 and float(size.std()) > _STEADY * float(size.mean())

    def _sizes(self, at: list[int]) -> FloatArray:
        """Sizes (n,) of the vectors of three columns where all are known."""
        size: FloatArray = np.linalg.norm(np.column_stack([self.table.numbers(k) for k in at]), axis=1)
        return size[np.isfinite(size)]

    def _is_g(self, at: list[int]) -> bool:
        """Whether ``g`` is not gauss: a lower-case letter, or a magnitude that the Earth's field has nowhere."""
        if all(unit_key(self.named[k].unit_text) == self.named[k].unit_text for k in at):
            return True
        size = self._sizes(at)
        # the Earth's field, with some iron, and less than 1 g
        return len(size) > 0 and not 0.15 < float(np.median(size)) < 0.9

    def may_be_inertial(self) -> bool:
        """Whether unrecognised columns differ by x, y, z alone, as an inertial sensor's do."""
        if self.time is None:
            return False
        unused = {"_".join(self.named[k].tokens): self.named[k].kinds for k in self.free}
        for name, kinds in unused.items():
            for at in (k for k, letter in enumerate(name) if letter == "x"):
                mates = [name[:at] + axis + name[at + 1 :] for axis in "yz"]
                if all(mate in unused for mate in mates) and not kinds - {"acceleration", "rate", "magnetic field"}:
                    return True
        return False

    def _stated(self, at: Iterable[int]) -> set[str]:
        return set.intersection(*(self.named[k].kinds for k in at))

    def _vector_columns(
        self, kind: str, quantities: Iterable[Quantity], at: list[int], why: str
    ) -> list[ColumnProposal]:
        by_numbers, seen = _vector_unit(kind, self._sizes(at))
        out = []
        for q, k in zip(quantities, at, strict=True):
            unit = next(iter(self.named[k].units(kind)), "")
            how, reason = (STATED, f"{why}, '{self.named[k].unit_text}' in the header") if unit else ("", "")
            if not unit and self.named[k].unknown_unit and unit_key(self.named[k].unit_text) not in SEVERAL_MEANINGS:
                how, reason = ASKED, not_known(self.named[k])
            elif not unit:
                meaning = SEVERAL_MEANINGS.get(self.named[k].unit_text, "")
                unit, how = by_numbers, NUMBERS if by_numbers else ASKED
                reason = "; ".join(filter(None, (meaning, why, seen)))
            out.append(self._proposal(q, k, unit, how, reason))
        return out

    # one by one

    def columns_of(self, short: str) -> list[int]:
        """Return free columns whose name has a quantity's vocabulary, those with the fewest other tokens first."""
        words = QUANTITIES[short]
        tokens = {k: self.named[k].tokens for k in sorted(self.free)}
        found = [k for k, own in tokens.items() if matching(own, words) or "".join(own) in words]
        if short == "wind_speed":  # "wind from" is no speed, "wind north" none of the whole wind
            found = [k for k in found if not set(tokens[k]) & (QUANTITIES["wind_from"] | MARKS["wind_component"])]
        return sorted(found, key=lambda k: (len(set(tokens[k]) - words), k))

    def _single(
        self, quantity: Quantity, vocabulary: str = "", among: list[int] | None = None
    ) -> ColumnProposal | None:
        """Claim the column of one quantity, the first that fits; None where there is none."""
        for k in self.columns_of(vocabulary or quantity.short) if among is None else among:
            stated = self.named[k].kinds
            if stated and quantity.kind not in stated:
                continue
            self.free.discard(k)
            unit = next(iter(self.named[k].units(quantity.kind)), "")
            if unit:
                return self._proposal(quantity, k, unit, STATED, f"'{self.named[k].unit_text}' in the header")
            if self.named[k].unknown_unit:
                return self._proposal(quantity, k, "", ASKED, not_known(self.named[k]))
            unit, seen = column_unit(quantity.short, quantity.kind, self.table.numbers(k))
            return self._proposal(quantity, k, unit, NUMBERS if unit else ASKED, seen)
        return None

    def _proposal(self, quantity: Quantity, k: int, unit: str, how: str, why: str) -> ColumnProposal:
        name = self.table.names[k]
        if name == quantity.canonical:
            return ColumnProposal(quantity.short, name, unit, STATED, "its canonical name", canonical=True)
        return ColumnProposal(quantity.short, name, unit, how, why)

    def _own_noise(self, quantities: tuple[Quantity, ...]) -> list[ColumnProposal]:
        """Columns of noise for each row, by canonical names only, since makers differ in the meaning of "accuracy"."""
        found = []
        for quantity in quantities:
            k = next((k for k in sorted(self.free) if self.table.names[k] == quantity.canonical), None)
            if k is not None:
                self.free.discard(k)
                unit = next(iter(self.named[k].units(quantity.kind)), "")
                found.append(self._proposal(quantity, k, unit, STATED, ""))
        return found

    def radar(self) -> list[SourceProposal]:
        """Claim slant range, azimuth, elevation; angles in whole degrees beside fixes were computed from these."""
        if not all(self.columns_of(q.short) for q in tables.RADAR):
            return []
        if all(self.columns_of(short) for short in ("lat", "lon")):
            first = [self.columns_of(q.short)[0] for q in tables.RADAR]
            known = [v[np.isfinite(v)] for v in map(self.table.numbers, first[1:])]
            if all((v == np.round(v)).all() for v in known):
                names = ", ".join(f"'{self.table.names[k]}'" for k in first)
                self.table.notes.append(f"{names}: whole degrees beside fixes are taken as computed from these")
                return []
        found = [m for q in tables.RADAR if (m := self._single(q))]
        if len(found) < len(tables.RADAR):
            return []
        keys = [(key, FILL_IN_TOML, words) for key, words in (
            ("latitude_deg", "deg: the radar's site, WGS-84"), ("longitude_deg", "deg, east positive"),
            ("height_m", "m above the ellipsoid"),
        )]  # fmt: skip
        found += self._own_noise(tables.TRACKER_SD)
        return [SourceProposal(f"radars.{self.name}", found, keys)]

    def _receiver(self) -> list[SourceProposal]:
        """Positions by latitude and longitude or ECEF, velocities."""
        quantity = {q.short: q for q in tables.GNSS}
        beside = [k for short in ("lat", "lon") for k in self.columns_of(short)[:1]]
        ecef = self._vectors("length", ("x", "y", "z"))
        lat_lon = [] if ecef else [m for s in ("lat", "lon") if (m := self._single(quantity[s]))]
        if not ecef and len(lat_lon) < 2:
            return []
        found, keys = list(ecef or lat_lon), []
        if not ecef:
            height, key = self._height(quantity["alt"], beside)
            found += [height] if height else []
            keys += key
        found += self._vectors("speed", ("vx", "vy", "vz")) or self._vectors("speed", ("vn", "ve", "vd"))
        satellites = self.columns_of("nsat")
        if satellites:
            self.free.discard(satellites[0])
            if self.table.names[satellites[0]] != "nsat":
                name = quoted(self.table.names[satellites[0]])
                keys.append(("satellites_column", name, "counted there; min_satellites = 8 leaves poor fixes out"))
        for short in ("lat", "lon", "alt") if ecef else ():  # the same positions once more
            self._set_aside(set(self.columns_of(short)))
        found += self._own_noise(tables.GNSS_SD)
        return [SourceProposal(f"gnss.{self.name}", found, keys)]

    def _vectors(self, kind: str, shorts: tuple[str, ...]) -> list[ColumnProposal]:
        quantities = [next(q for q in tables.GNSS if q.short == s) for s in shorts]
        ned = shorts[0] == "vn"
        for (stem, family), by_axis in self._families().items():
            at = [by_axis[a] for a in range(3)]
            stated = self._stated(at)
            if not set(at) <= self.free or (stated and kind not in stated) or (family == "ned") != ned:
                continue
            if not stated and not set(stem) & VECTORS[kind]:
                continue
            if not ned and "ecef" not in stem and not (kind == "length" and self._earth_sized(at)):
                continue
            self.free -= set(at)
            units = [next(iter(self.named[k].units(kind)), "") for k in at]
            return [
                self._proposal(q, k, unit, STATED if unit else ASKED, f"'{self.named[k].unit_text}' in the header")
                for q, k, unit in zip(quantities, at, units, strict=True)
            ]
        return []

    def _earth_sized(self, at: list[int]) -> bool:
        unit = next(iter(self.named[at[0]].units("length")), "m")
        axes = [tables.to_si(self.table.numbers(k).copy(), unit) for k in at]
        size: FloatArray = np.linalg.norm(np.column_stack(axes), axis=1)
        return bool(6.2e6 < np.nanmedian(size) < 7.5e6)

    def _height(
        self, quantity: Quantity, beside: list[int]
    ) -> tuple[ColumnProposal | None, list[tuple[str, str, str]]]:
        """Claim a receiver's height: by its name, then the one that stands next to its latitude and longitude."""
        candidates = sorted(self.columns_of("alt"), key=lambda k: self._strangeness(k, beside))
        for mark, above in (("ellipsoid", '"ellipsoid"'), ("sea_level", '"msl"')):
            stated = [k for k in candidates if set(self.named[k].tokens) & MARKS[mark]]
            if stated:
                self._set_aside(set(candidates) - {stated[0]})
                return self._single(quantity, among=stated), [("height_is", above, "by the column's name")]
        found = self._single(quantity, among=candidates)
        if found is not None and len(candidates) > 1:
            others = ", ".join(f"'{self.table.names[k]}'" for k in candidates if self.table.names[k] != found.column)
            found = replace(found, why=f"{found.why}; by its name or place the receiver's, not {others}")
        return found, [("height_is", FILL_IN_TOML, '"ellipsoid" or "msl"')]

    def _strangeness(self, k: int, beside: list[int]) -> tuple[bool, bool, int, int, bool]:
        """Dissimilarity of a column from those ``beside`` it: by words, then by place, columns after them first."""
        own = {t for t in self.named[k].tokens if t.isalpha()} - QUANTITIES["alt"]
        theirs = {t for at in beside for t in self.named[at].tokens} - QUANTITIES["lat"] - QUANTITIES["lon"]
        away = min((abs(k - at) for at in beside), default=0)
        return (
            not own & MARKS["receiver"],
            bool(own & MARKS["air"]),
            len(own ^ theirs),
            away,
            k < min(beside, default=0),
        )

    def _set_aside(self, at: set[int]) -> None:
        self.spare |= at & self.free
        self.free -= at

    def _barometer(self) -> list[SourceProposal]:
        """Static pressure, or heights."""
        height, pressure = tables.BAROMETER
        found = self._single(pressure) or self._single(height, "alt")
        if found is None:
            return []
        what = '"ellipsoid" or "msl"; pressures too'
        if found.short == height.short:
            what = '"ellipsoid" or "msl"; an altimeter that starts at 0: "ground", and ground_height_m'
        return [SourceProposal(f"barometers.{self.name}", [found], [("height_is", FILL_IN_TOML, what)])]

    def air_columns(self) -> dict[Quantity, ColumnProposal]:
        """Claim the columns of a sounding; winds by speed and direction go before those by components."""
        found = {q: m for q in tables.ATMOSPHERE if q.short in _AIR and (m := self._single(q))}
        if not {"wind_speed", "wind_from"} <= {q.short for q in found}:
            found |= {q: m for q in tables.ATMOSPHERE if q.short in _AIR_BY_COMPONENTS and (m := self._single(q))}
        return found

    def is_sounding(self) -> bool:
        """Whether height, temperature and wind's direction or density are there, and nothing of a tracker.

        A balloon's table has times, latitudes and longitudes too: with pressure, temperature and wind all there it is
        a sounding and nothing else.
        """
        wind = self._certain("wind_from") or all(self._certain(short) for short in _AIR_BY_COMPONENTS)
        if wind and self._certain("pressure") and self._certain("temperature"):
            return True
        tracker = all(self.columns_of(s) for s in ("lat", "lon")) or all(self.columns_of(q.short) for q in tables.RADAR)
        air = all(self.columns_of(s) for s in ("alt", "temperature"))
        return air and not tracker and bool(self.columns_of("wind_from") or self.columns_of("rho"))

    def _certain(self, short: str) -> bool:
        """Whether a column's name has a full word of the quantity, or a letter with a matching unit."""
        kind = next(q.kind for q in tables.ATMOSPHERE if q.short == short)
        return any(
            kind in self.named[k].kinds or (not self.named[k].kinds and max(map(len, self.named[k].tokens)) > 1)
            for k in self.columns_of(short)
        )

    def _sounding(self) -> list[SourceProposal]:
        """Columns of a table by altitude, unchanged; `postflight.intake.deliveries` derives densities first."""
        found = list(self.air_columns().values())
        shorts = {m.short for m in found}
        return [SourceProposal("atmosphere", found)] if {"alt", "temperature", "rho"} <= shorts else []


def _axes_of(tokens: tuple[str, ...]) -> list[tuple[tuple[str, ...], str, int]]:
    """Ways to read an axis out of a name: (rest of the name, family, axis)."""
    out = []
    stems = {token for vocabulary in VECTORS.values() for token in vocabulary} | {"g"}
    for k, token in enumerate(tokens):
        rest = tokens[:k] + tokens[k + 1 :]
        if token in AXES:
            family = "body" if token in BODY_RATES else "ned" if token in NED else "xyz"
            stem = ("rate", *rest) if token.endswith(("rate", "geschwindigkeit")) else rest
            out.append((stem, family, AXES[token]))
        elif token in ("1", "2", "3"):
            out.append((rest, "numbered", int(token) - 1))
        elif len(token) > 1 and token[-1] in "xyz" and token[:-1] in stems:
            out.append(((token[:-1], *rest), "xyz", AXES[token[-1]]))
        elif len(token) > 3 and token[0] in "xyz" and token[1:] in stems:
            out.append(((token[1:], *rest), "xyz", AXES[token[0]]))
        elif len(token) > 1 and token[-1] in "ned" and token[:-1] == "v":
            out.append((("v", *rest), "ned", AXES[token[-1]]))
    return out


def _named_apart(found: list[SourceProposal]) -> list[SourceProposal]:
    """Give trackers of one table distinct names, by which results are labelled."""
    trackers = [source for source in found if source.section.partition(".")[0] in _ENDINGS]
    for source in trackers if len(trackers) > 1 else ():
        group, _, name = source.section.partition(".")
        source.section = f"{group}.{name[: 64 - len(_ENDINGS[group])]}{_ENDINGS[group]}"
    return found


def not_known(named: ColumnName) -> str:
    """Message on a stated unit that is not known; it takes precedence over any unit that the numbers suggest."""
    return f"'{named.unit_text}' in the header is no unit that is known"


def quoted(name: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(name, ensure_ascii=False)

"""Which columns of a table are which sensor's? Names, units and, where both leave it open, the numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

import numpy as np

from flightmodel import columns
from flightmodel.checks import FloatArray
from flightmodel.columns import UNITS, Quantity
from postflight.intake.clock_columns import find_time
from postflight.intake.evidence import single_unit, triad_unit
from postflight.intake.loose import LooseTable
from postflight.intake.proposal import ASKED, NUMBERS, STATED, Mapped, SourceProposal
from postflight.intake.words import (
    AXES,
    BODY_RATES,
    NED,
    QUANTITY_WORDS,
    SEVERAL_MEANINGS,
    TRIAD_WORDS,
    means,
    take_apart,
    unit_key,
)

TRIADS: dict[str, tuple[str, tuple[Quantity, ...]]] = {
    "acceleration": ("sensors.accelerometer", columns.ACCELEROMETER),
    "rate": ("sensors.rates", columns.RATES),
    "magnetic field": ("sensors.magnetometer", columns.MAGNETOMETER),
}
G_OR_GAUSS = {"acceleration", "magnetic field"}
FIELD_GAUSS = (0.15, 0.9)  # the Earth's, with some iron, and less than 1 g
EARTH_RADII_M = (6.2e6, 7.5e6)
MOUNT = 'a package of the vehicle file, or "body"; or axes = ["+x", "+y", "+z"]: which body axis is each of its axes?'
AIR = ("alt", "rho", "temperature", "pressure", "wind_speed", "wind_from")
AIR_BY_PARTS = ("wind_north", "wind_east")
Family = tuple[tuple[str, ...], str]


class Reader:
    """One table being recognised; columns are claimed once."""

    def __init__(self, table: LooseTable) -> None:
        self.table = table
        self.named = [take_apart(n, u) for n, u in zip(table.names, table.units, strict=True)]
        self.time = find_time(table, self.named)
        self.free = set(range(len(table.names)))
        self.spare: set[int] = set()  # understood, and not used
        if self.time is not None:
            self.free -= {table.names.index(c) for c in (*self.time.columns, *self.time.others)}
        self.name = re.sub(r"[^A-Za-z0-9_-]+", "_", table.label).strip("_")[:64] or "table"

    def everything(self) -> tuple[list[SourceProposal], list[str]]:
        """Return what the table holds, and the names of columns that were recognised as nothing.

        Triads first, whose columns come in threes; then radar, receiver, barometer, sounding.
        """
        if self.is_sounding():
            self.time = None
            found = self.sounding()
        elif self.time is None:
            found = []
        else:
            found = self.triads() + self.radar() + self.receiver() + self.barometer()
        for source in found:
            source.time = self.time
        return found, [self.table.names[k] for k in sorted(self.free | self.spare)]

    # threes

    def families(self) -> dict[Family, dict[int, int]]:
        """Columns whose names differ by an axis alone: (stem, family) -> column by axis."""
        out: dict[Family, dict[int, int]] = {}
        for k in sorted(self.free):
            for stem, family, axis in _axes_of(self.named[k].tokens):
                out.setdefault((stem, family), {}).setdefault(axis, k)
        return {key: by_axis for key, by_axis in out.items() if len(by_axis) == 3}

    def triads(self) -> list[SourceProposal]:
        """Accelerometer, gyros, magnetometer."""
        found: dict[str, SourceProposal] = {}
        for (stem, family), by_axis in self.families().items():
            at = [by_axis[a] for a in range(3)]
            if not set(at) <= self.free:
                continue
            kind, why = self._triad_kind(stem, family, at)
            if kind not in TRIADS or TRIADS[kind][0] in found:
                continue
            section, quantities = TRIADS[kind]
            source = SourceProposal(section, self._triad_columns(kind, quantities, at, why))
            if family != "body" and not all(m.canonical for m in source.columns):
                source.keys.append(("mount", '"FILL IN"', MOUNT))
            if family == "numbered":
                source.keys[-1] = ("mount", '"FILL IN"', f"{MOUNT} (1, 2, 3 are taken for x, y, z)")
            self.free -= set(at)
            found[section] = source
        return list(found.values())

    def _triad_kind(self, stem: tuple[str, ...], family: str, at: list[int]) -> tuple[str, str]:
        stated = self._stated(at)
        worded = [kind for kind, words in TRIAD_WORDS.items() if means(stem, words)]
        if family == "body" and (not stem or "rate" in worded or stated == {"rate"}):
            return ("rate", "names of body rates") if stated in (set(), {"rate"}) else ("", "")
        fitting = [kind for kind in worded if not stated or kind in stated]
        if len(stated) == 1:
            kind = next(iter(stated))
            # a unit alone does not say which vector it is, except where only one sensor has it
            if kind in ("rate", "magnetic field", "acceleration") or kind in worded:
                return kind, "unit"
            return "", ""
        if stated == G_OR_GAUSS and not worded and self._is_g(at):
            return "acceleration", "three axes"
        if stated and len(fitting) != 1:
            return "", ""
        return (fitting[0], "name") if len(fitting) == 1 else ("", "")

    def _is_g(self, at: list[int]) -> bool:
        """Whether ``g`` is no gauss: a small letter, or of a size that the Earth's field has nowhere."""
        if all(unit_key(self.named[k].unit_text) == self.named[k].unit_text for k in at):
            return True
        size = np.linalg.norm(np.column_stack([self.table.numbers(k) for k in at]), axis=1)
        size = size[np.isfinite(size)]
        return len(size) > 0 and not FIELD_GAUSS[0] < float(np.median(size)) < FIELD_GAUSS[1]

    def may_be_inertial(self) -> bool:
        """Whether columns that were recognised as nothing differ by x, y, z alone, as an inertial sensor's do."""
        if self.time is None:
            return False
        left = {"_".join(self.named[k].tokens): self.named[k].kinds for k in self.free}
        for name, kinds in left.items():
            for at in (k for k, letter in enumerate(name) if letter == "x"):
                mates = [name[:at] + axis + name[at + 1 :] for axis in "yz"]
                if all(mate in left for mate in mates) and not kinds - {"acceleration", "rate", "magnetic field"}:
                    return True
        return False

    def _stated(self, at: Iterable[int]) -> set[str]:
        return set.intersection(*(self.named[k].kinds for k in at))

    def _triad_columns(self, kind: str, quantities: Iterable[Quantity], at: list[int], why: str) -> list[Mapped]:
        guess, seen = triad_unit(kind, np.column_stack([self.table.numbers(k) for k in at]))
        out = []
        for q, k in zip(quantities, at, strict=True):
            unit = next(iter(self.named[k].units(kind)), "")
            how, reason = (STATED, f"{why}, '{self.named[k].unit_text}' in the header") if unit else ("", "")
            if not unit:
                meaning = SEVERAL_MEANINGS.get(self.named[k].unit_text, "")
                unit, how, reason = guess, NUMBERS if guess else ASKED, "; ".join(filter(None, (meaning, why, seen)))
            out.append(self._mapped(q, k, unit, how, reason))
        return out

    # one by one

    def columns_of(self, short: str) -> list[int]:
        """Free columns whose name says a quantity, the plainest first."""
        words = QUANTITY_WORDS[short]
        found = [
            k for k in sorted(self.free) if means(self.named[k].tokens, words) or "".join(self.named[k].tokens) in words
        ]
        if short == "wind_speed":  # "wind from" is no speed
            found = [k for k in found if not set(self.named[k].tokens) & QUANTITY_WORDS["wind_from"]]
        return sorted(found, key=lambda k: (len(set(self.named[k].tokens) - words), k))

    def single(self, quantity: Quantity, word: str = "") -> Mapped | None:
        """Return the column of one quantity, claimed; None where there is none."""
        for k in self.columns_of(word or quantity.short):
            stated = self.named[k].kinds
            if stated and quantity.kind not in stated:
                continue
            self.free.discard(k)
            unit = next(iter(self.named[k].units(quantity.kind)), "")
            if unit:
                return self._mapped(quantity, k, unit, STATED, f"'{self.named[k].unit_text}' in the header")
            unit, seen = single_unit(quantity.short, quantity.kind, self.table.numbers(k))
            return self._mapped(quantity, k, unit, NUMBERS if unit else ASKED, seen)
        return None

    def _mapped(self, quantity: Quantity, k: int, unit: str, how: str, why: str) -> Mapped:
        name = self.table.names[k]
        canonical = name == quantity.canonical
        return Mapped(
            quantity.short,
            name,
            unit,
            STATED if canonical else how,
            "its canonical name" if canonical else why,
            canonical,
        )

    def radar(self) -> list[SourceProposal]:
        """Slant range, azimuth, elevation."""
        if not all(self.columns_of(q.short) for q in columns.RADAR):
            return []
        found = [self.single(q) for q in columns.RADAR]
        if any(m is None for m in found):
            return []
        keys = [(key, '"FILL IN"', words) for key, words in (
            ("latitude_deg", "deg: the radar's site, WGS-84"), ("longitude_deg", "deg, east positive"),
            ("height_m", "m above the ellipsoid"),
        )]  # fmt: skip
        return [SourceProposal(f"radars.{self.name}", [m for m in found if m], keys)]

    def receiver(self) -> list[SourceProposal]:
        """Positions by latitude and longitude or ECEF, velocities."""
        quantity = {q.short: q for q in columns.GNSS}
        ecef = self._vectors("length", ("x", "y", "z"))
        lat_lon = [] if ecef else [m for s in ("lat", "lon") if (m := self.single(quantity[s]))]
        if not ecef and len(lat_lon) < 2:
            return []
        found, keys = list(ecef or lat_lon), []
        if not ecef:
            height, key = self._height(quantity["alt"])
            found += [height] if height else []
            keys += key
        for shorts in (("vx", "vy", "vz"), ("vn", "ve", "vd")):
            velocity = self._vectors("speed", shorts)
            if velocity:
                found += velocity
                break
        satellites = self.columns_of("nsat")
        if satellites:
            self.free.discard(satellites[0])
            if self.table.names[satellites[0]] != "nsat":
                name = quoted(self.table.names[satellites[0]])
                keys.append(("satellites_column", name, "counted there; min_satellites = 8 leaves poor fixes out"))
        for short in ("lat", "lon", "alt") if ecef else ():  # the same places once more
            self._set_aside(set(self.columns_of(short)))
        return [SourceProposal(f"gnss.{self.name}", found, keys)]

    def _vectors(self, kind: str, shorts: tuple[str, ...]) -> list[Mapped]:
        quantities = [next(q for q in columns.GNSS if q.short == s) for s in shorts]
        ned = shorts[0] == "vn"
        for (stem, family), by_axis in self.families().items():
            at = [by_axis[a] for a in range(3)]
            stated = self._stated(at)
            if not set(at) <= self.free or (stated and kind not in stated) or (family == "ned") != ned:
                continue
            if not stated and not set(stem) & TRIAD_WORDS[kind]:
                continue
            if not ned and "ecef" not in stem and not (kind == "length" and self._earth_sized(at)):
                continue
            self.free -= set(at)
            return [self._of_vector(q, k, kind) for q, k in zip(quantities, at, strict=True)]
        return []

    def _of_vector(self, quantity: Quantity, k: int, kind: str) -> Mapped:
        unit = next(iter(self.named[k].units(kind)), "")
        return self._mapped(quantity, k, unit, STATED if unit else ASKED, f"'{self.named[k].unit_text}' in the header")

    def _earth_sized(self, at: list[int]) -> bool:
        unit = next(iter(self.named[at[0]].units("length")), "m")
        size: FloatArray = np.linalg.norm(np.column_stack([self.table.numbers(k) for k in at]), axis=1) * UNITS[unit][1]
        return bool(EARTH_RADII_M[0] < np.nanmedian(size) < EARTH_RADII_M[1])

    def _height(self, quantity: Quantity) -> tuple[Mapped | None, list[tuple[str, str, str]]]:
        candidates = self.columns_of("alt")
        ell = [k for k in candidates if set(self.named[k].tokens) & {"ell", "ellipsoid", "hae", "wgs", "wgs84"}]
        msl = [k for k in candidates if set(self.named[k].tokens) & {"msl", "amsl", "geoid", "nn", "sea"}]
        if ell:  # asks for no undulation
            self._set_aside(set(candidates) - {ell[0]})
            return self.single(quantity), [("height_is", '"ellipsoid"', "the column's name says it")]
        undulation = (
            "geoid_undulation_m",
            '"FILL IN"',
            "m: geoid above the ellipsoid at the place (EGM96), -107 to 85",
        )
        if msl:
            self._set_aside(set(candidates) - {msl[0]})
            return self.single(quantity), [("height_is", '"msl"', "the column's name says it"), undulation]
        return self.single(quantity), [("height_is", '"FILL IN"', '"ellipsoid", or "msl" with geoid_undulation_m')]

    def _set_aside(self, at: set[int]) -> None:
        self.spare |= at & self.free
        self.free -= at

    def barometer(self) -> list[SourceProposal]:
        """Static pressure, or heights."""
        height, pressure = columns.BAROMETER
        found = self.single(pressure)
        if found is None:
            found = self.single(height, "alt")
        if found is None:
            return []
        what = '"ellipsoid", or "msl" with geoid_undulation_m = ... (m, geoid above ellipsoid); pressures too'
        return [SourceProposal(f"barometers.{self.name}", [found], [("height_is", '"FILL IN"', what)])]

    def air_columns(self) -> dict[Quantity, Mapped]:
        """Columns of a sounding; winds by speed and direction go before those by components."""
        found = {q: m for q in columns.ATMOSPHERE if q.short in AIR and (m := self.single(q))}
        if not {"wind_speed", "wind_from"} <= {q.short for q in found}:
            found |= {q: m for q in columns.ATMOSPHERE if q.short in AIR_BY_PARTS and (m := self.single(q))}
        return found

    def is_sounding(self) -> bool:
        """Whether height, temperature and wind's direction or density are there, and nothing of a tracker."""
        tracker = all(self.columns_of(s) for s in ("lat", "lon")) or all(
            self.columns_of(q.short) for q in columns.RADAR
        )
        air = all(self.columns_of(s) for s in ("alt", "temperature"))
        return air and not tracker and bool(self.columns_of("wind_from") or self.columns_of("rho"))

    def sounding(self) -> list[SourceProposal]:
        """A table by altitude, as it stands; `postflight.intake.sounding_tables` derives densities before."""
        found = list(self.air_columns().values())
        shorts = {m.short for m in found}
        return [SourceProposal("atmosphere", found)] if {"alt", "temperature", "rho"} <= shorts else []


def _axes_of(tokens: tuple[str, ...]) -> list[tuple[tuple[str, ...], str, int]]:
    """Ways to read an axis out of a name: (rest of the name, family, axis)."""
    out = []
    stems = {w for words in TRIAD_WORDS.values() for w in words} | {"g"}
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


def quoted(name: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(name, ensure_ascii=False)

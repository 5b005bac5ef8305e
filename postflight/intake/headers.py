"""What does a column's name mean? Header vocabulary in English and German: quantities, axes, units however written.

A name is folded (lower case, no umlauts or raised digits), its unit split off, the rest cut into tokens; a quantity is
recognised where a token is in its vocabulary, whole or cut short. What the vocabulary leaves open (``G`` is g or gauss)
stays open here: `postflight.intake.column_recognition` decides by the numbers, or asks.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from flightmodel.tables import UNITS, read_unit

_FOLD = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "µ": "u", "μ": "u", "²": "2", "³": "3", "⁻": "-"}
    | dict.fromkeys("·^*", "")
)
# unit in flight.toml -> spellings in files (folded, without spaces) beside its own name
_SPELLINGS = {
    "s": "sec secs seconds sekunden sek",
    "ms": "msec milliseconds",
    "us": "usec microseconds",
    "min": "minutes",
    "m": "metres meters meter metre",
    "ft": "feet foot",
    "yd": "yards yard yds",
    "nmi": "nm",
    "km": "kilometer",
    "kft": "kilofeet",
    "deg": "degrees degree grad degn dege degrees_north degrees_east degree_north degree_east",
    "rad": "radians radian",
    "mil": "mils",
    "gon": "gons",
    "kyd": "kyds kiloyards",
    "mi": "miles mile",
    "mrad": "milliradians",
    "mps2": "m/s2 m/s/s ms-2 ms2 m/sec2 m_s2",
    "g": "gs g's gee gn g0",
    "gauss": "g gs",
    "mg": "milli-g",
    "ftps2": "ft/s2 ft/sec2",
    "degps": "deg/s deg/sec dps grad/s degs-1 deg_s",
    "degph": "deg/hr deg/h dph grad/h deg/hour",
    "mradps": "mrad/s",
    "radps": "rad/s rad_s rads-1 rad/sec",
    "rpm": "1/min u/min",
    "t": "tesla",
    "ut": "microtesla",
    "nt": "nanotesla",
    "mps": "m/s ms-1 m/sec m_s",
    "cmps": "cm/s",
    "mmps": "mm/s",
    "kmh": "km/h kph km_h",
    "kt": "knots knot kn kts",
    "ftps": "ft/s fps ft_s",
    "mph": "mi/h miles/hour",
    "kgpm3": "kg/m3 kgm-3",
    "gpm3": "g/m3",
    "k": "kelvin",
    "degc": "c celsius degcelsius",
    "degf": "f fahrenheit degfahrenheit",
    "degr": "r rankine",
    "slugpft3": "slug/ft3 slugs/ft3",
    "lbpft3": "lb/ft3 lbm/ft3",
    "hpa": "mbar mb millibar",
    "psi": "psia lb/in2 lbf/in2",
    "psf": "lb/ft2 lbf/ft2 psfa",
    "mmhg": "torr",
    "percent": "%",
}
# spelling -> units in flight.toml; several where the quantity decides
UNIT_SPELLINGS: dict[str, tuple[str, ...]] = {name: (name,) for name in UNITS if name != "1"}
for _unit, _written in _SPELLINGS.items():
    for _spelling in _written.split():
        UNIT_SPELLINGS[_spelling] = (*UNIT_SPELLINGS.get(_spelling, ()), _unit)
_AFTER_TEMPERATURE = {"f", "r", "c"}  # elsewhere these letters at a name's end are a force, an axis, anything
SEVERAL_MEANINGS = {"rps": "rad/s or revolutions a second"}


def _vocabulary(words: dict[str, str]) -> dict[str, set[str]]:
    return {quantity: set(tokens.split()) for quantity, tokens in words.items()}


QUANTITIES = _vocabulary(
    {
        "time": "t time zeit tplus met tlog uhrzeit irig utc timestamp tow gmt sod sekunde",
        "range": "range rng slant slantrange entfernung distanz schraegentfernung dist distance",
        "az": "az azimuth azimut azi azm peilung bearing",
        "el": "el elevation elev elv hoehenwinkel erhebung elevationswinkel",
        "lat": "lat latitude breite breitengrad phi",
        "lon": "lon long lng longitude laenge laengengrad",
        "alt": "alt altitude height hoehe hgt hght h geopot z",
        "pressure": "pressure press druck luftdruck p pres static",
        "temperature": "temperature temp temperatur t lufttemperatur",
        "dewpoint": "td dwpt dewpoint taupunkt dew",
        "rho": "rho density dichte dens luftdichte",
        "wind_speed": "windspeed wspd ff sknt windgeschwindigkeit smps wind speed spd",
        "wind_from": "winddir wdir dd drct windrichtung from wd direction dir",
        "wind_north": "windn v vgrd meridional ncomp north northward",
        "wind_east": "winde u ugrd zonal ecomp east eastward",
        "nsat": "nsat sats satellites satelliten numsv nsats sat",
    }
)
# three orthogonal sensors, or a vector; n and nf are load factors
VECTORS = _vocabulary(
    {
        "acceleration": "a acc accel acceleration accelerometer beschleunigung beschl f n nf sf load loadfactor",
        "rate": "w om omega gyro gyr rate rates drehrate kreisel angular winkelgeschwindigkeit",
        "magnetic field": "m h mag magnet magnetometer b field feld magnetfeld",
        "speed": "v vel velocity geschwindigkeit",
        "length": "pos position r ecef",
    }
)
_ABOUT_AXES = (
    "roll rollrate rollen rollgeschwindigkeit p",
    "pitch pitchrate nicken nick nickrate nickgeschwindigkeit q",
    "yaw yawrate gieren gier gierrate giergeschwindigkeit r",
)
_DIRECTIONS = ("n north nord", "e east ost", "d down unten")
BODY_RATES = {name for names in _ABOUT_AXES for name in names.split()}
NED = {name for names in _DIRECTIONS for name in names.split()}
AXES = {
    name: axis
    for family in (("x", "y", "z"), _ABOUT_AXES, _DIRECTIONS)
    for axis, names in enumerate(family)
    for name in names.split()
}
_EVERY_TOKEN = {token for tokens in (*QUANTITIES.values(), *VECTORS.values(), AXES) for token in tokens}


@dataclass(frozen=True)
class ColumnName:
    """A column's name taken apart: tokens of what it is, and the unit's text where it names one."""

    name: str
    tokens: tuple[str, ...]
    unit_text: str

    @property
    def _stated(self) -> tuple[str, ...]:
        """Units that the stated text may mean, as flight.toml takes them; none where it is not known."""
        key = unit_key(self.unit_text)
        if key in UNIT_SPELLINGS or not key or key in SEVERAL_MEANINGS:
            return UNIT_SPELLINGS.get(key, ())
        known = not self.unit_text.startswith("-") and read_unit(self.unit_text) is not None
        return (self.unit_text,) if known else ()

    def units(self, kind: str) -> list[str]:
        """Return the stated unit's names in flight.toml that fit a kind of quantity; empty where none does."""
        return [u for u in self._stated if _kind(u) == kind]

    @property
    def kinds(self) -> set[str]:
        """Kinds of quantity that the stated unit allows; empty where none is stated."""
        return {_kind(u) for u in self._stated}

    @property
    def unknown_unit(self) -> str:
        """Text that stands where a unit does and is none that is known; empty where there is none such."""
        return "" if self._stated else self.unit_text


def _kind(unit: str) -> str:
    found = read_unit(unit)
    return "" if found is None else found.kind


def parse_column_name(name: str, unit_row: str = "") -> ColumnName:
    """Return tokens and unit of a column's name; a row of units below the header goes before the name's own."""
    base, unit = name.strip(), ""
    bracket = re.match(r"^(.*?)\s*[(\[{<]\s*([^()\[\]{}<>]+?)\s*[)\]}>]\s*$", base)
    if bracket and bracket[1]:
        base, unit = bracket[1], bracket[2]
    else:
        for mark in re.finditer(r"[_\s/.,]+(?:in\s+)?", base):
            head, tail = base[: mark.start()], base[mark.end() :]
            if head and _is_suffix(head, unit_key(tail)):
                base, unit = head, tail
                break
    stated = unit_row.strip().strip("()[]{}<>") or unit
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", base)
    return ColumnName(name, tuple(re.findall(r"[a-z]+|\d+", fold(spaced))), stated)


def _is_suffix(head: str, key: str) -> bool:
    """Whether the end of a column's name, behind a mark, is a unit."""
    if key in _AFTER_TEMPERATURE:
        return bool(matching(tuple(re.findall(r"[a-z]+|\d+", fold(head))), QUANTITIES["temperature"] | {"td"}))
    return key in UNIT_SPELLINGS or key in SEVERAL_MEANINGS


def matching(tokens: tuple[str, ...], vocabulary: set[str]) -> set[str]:
    """Return the tokens in a vocabulary, whole or cut short (``azim``) where that is no token of its own."""
    cut = {t for t in tokens if len(t) >= 3 and t not in _EVERY_TOKEN}
    return set(tokens) & vocabulary | {t for t in cut if any(w.startswith(t) and len(w) >= 6 for w in vocabulary)}


def fold(text: str) -> str:
    """Return lower case without umlauts, Greek mu and raised digits."""
    return text.replace("°C", "degc").replace("°", "deg").lower().translate(_FOLD)


def unit_key(text: str) -> str:
    """Return a unit's text as `UNIT_SPELLINGS` has it."""
    return fold(text).replace(" ", "").strip("()[]{}<>.")

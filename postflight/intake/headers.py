"""What words in a header mean: names of quantities in English and German, abbreviations, and units however written."""

from __future__ import annotations

import re
from dataclasses import dataclass

from flightmodel.tables import UNITS

FOLD = str.maketrans(
    {
        "ä": "ae",
        "ö": "oe",
        "ü": "ue",
        "ß": "ss",
        "µ": "u",
        "μ": "u",
        "²": "2",
        "³": "3",
        "·": "",
        "^": "",
        "*": "",
        "⁻": "-",
    }
)
# a unit as files write it (folded, without spaces) -> names in flight.toml; several where the quantity decides
UNIT_WORDS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in UNITS if name != "1"},
    "sec": ("s",),
    "secs": ("s",),
    "seconds": ("s",),
    "sekunden": ("s",),
    "sek": ("s",),
    "msec": ("ms",),
    "usec": ("us",),
    "microseconds": ("us",),
    "milliseconds": ("ms",),
    "minutes": ("min",),
    "metres": ("m",),
    "meters": ("m",),
    "meter": ("m",),
    "metre": ("m",),
    "feet": ("ft",),
    "foot": ("ft",),
    "yards": ("yd",),
    "yard": ("yd",),
    "yds": ("yd",),
    "nm": ("nmi",),
    "kilometer": ("km",),
    "kilofeet": ("kft",),
    "degrees": ("deg",),
    "degree": ("deg",),
    "grad": ("deg",),
    "degn": ("deg",),
    "dege": ("deg",),
    "radians": ("rad",),
    "radian": ("rad",),
    "mils": ("mil",),
    "m/s2": ("mps2",),
    "m/s/s": ("mps2",),
    "ms-2": ("mps2",),
    "ms2": ("mps2",),
    "m/sec2": ("mps2",),
    "gs": ("g", "gauss"),
    "g's": ("g",),
    "g": ("g", "gauss"),
    "gee": ("g",),
    "gn": ("g",),
    "g0": ("g",),
    "milli-g": ("mg",),
    "ft/s2": ("ftps2",),
    "ft/sec2": ("ftps2",),
    "deg/s": ("degps",),
    "deg/sec": ("degps",),
    "dps": ("degps",),
    "grad/s": ("degps",),
    "degs-1": ("degps",),
    "rad/s": ("radps",),
    "rad_s": ("radps",),
    "deg_s": ("degps",),
    "m_s2": ("mps2",),
    "m_s": ("mps",),
    "ft_s": ("ftps",),
    "km_h": ("kmh",),
    "rads-1": ("radps",),
    "rad/sec": ("radps",),
    "1/min": ("rpm",),
    "u/min": ("rpm",),
    "tesla": ("t",),
    "microtesla": ("ut",),
    "nanotesla": ("nt",),
    "m/s": ("mps",),
    "ms-1": ("mps",),
    "m/sec": ("mps",),
    "cm/s": ("cmps",),
    "mm/s": ("mmps",),
    "km/h": ("kmh",),
    "kph": ("kmh",),
    "knots": ("kt",),
    "knot": ("kt",),
    "kn": ("kt",),
    "kts": ("kt",),
    "ft/s": ("ftps",),
    "fps": ("ftps",),
    "kg/m3": ("kgpm3",),
    "kgm-3": ("kgpm3",),
    "g/m3": ("gpm3",),
    "kelvin": ("k",),
    "c": ("degc",),
    "celsius": ("degc",),
    "mbar": ("hpa",),
    "mb": ("hpa",),
    "%": ("percent",),
}
SEVERAL_MEANINGS = {"rps": "rad/s or revolutions a second"}
# tokens of a name -> quantity
QUANTITY_WORDS: dict[str, set[str]] = {
    "time": {
        "t",
        "time",
        "zeit",
        "tplus",
        "met",
        "tlog",
        "uhrzeit",
        "irig",
        "utc",
        "timestamp",
        "tow",
        "gmt",
        "sod",
        "sekunde",
    },
    "range": {"range", "rng", "slant", "slantrange", "entfernung", "distanz", "schraegentfernung", "dist", "distance"},
    "az": {"az", "azimuth", "azimut", "azi", "azm", "peilung", "bearing"},
    "el": {"el", "elevation", "elev", "elv", "hoehenwinkel", "erhebung", "elevationswinkel"},
    "lat": {"lat", "latitude", "breite", "breitengrad", "phi"},
    "lon": {"lon", "long", "lng", "longitude", "laenge", "laengengrad"},
    "alt": {"alt", "altitude", "height", "hoehe", "hgt", "hght", "h", "geopot", "z"},
    "pressure": {"pressure", "press", "druck", "luftdruck", "p", "pres", "static"},
    "temperature": {"temperature", "temp", "temperatur", "t", "lufttemperatur"},
    "dewpoint": {"td", "dwpt", "dewpoint", "taupunkt", "dew"},
    "rho": {"rho", "density", "dichte", "dens", "luftdichte"},
    "wind_speed": {"windspeed", "wspd", "ff", "sknt", "windgeschwindigkeit", "smps", "wind"},
    "wind_from": {"winddir", "wdir", "dd", "drct", "windrichtung", "from", "wd"},
    "wind_north": {"windn", "v", "vgrd", "meridional"},
    "wind_east": {"winde", "u", "ugrd", "zonal"},
    "nsat": {"nsat", "sats", "satellites", "satelliten", "numsv", "nsats", "sat"},
}
TRIAD_WORDS: dict[str, set[str]] = {
    "acceleration": {
        "a",
        "acc",
        "accel",
        "acceleration",
        "accelerometer",
        "beschleunigung",
        "beschl",
        "f",
        "n",  # load factor
        "nf",
        "sf",
        "load",
        "loadfactor",
    },
    "rate": {
        "w",
        "om",
        "omega",
        "gyro",
        "gyr",
        "rate",
        "rates",
        "drehrate",
        "kreisel",
        "angular",
        "winkelgeschwindigkeit",
    },
    "magnetic field": {"m", "h", "mag", "magnet", "magnetometer", "b", "field", "feld", "magnetfeld"},
    "speed": {"v", "vel", "velocity", "geschwindigkeit"},
    "length": {"pos", "position", "r", "ecef"},
}
AXES = {
    "x": 0,
    "y": 1,
    "z": 2,
    "roll": 0,
    "pitch": 1,
    "yaw": 2,
    "rollrate": 0,
    "pitchrate": 1,
    "yawrate": 2,
    "rollen": 0,
    "nicken": 1,
    "gieren": 2,
    "nick": 1,
    "gier": 2,
    "nickrate": 1,
    "gierrate": 2,
    "p": 0,
    "q": 1,
    "r": 2,
    "rollgeschwindigkeit": 0,
    "nickgeschwindigkeit": 1,
    "giergeschwindigkeit": 2,
    "n": 0,
    "e": 1,
    "d": 2,
    "north": 0,
    "east": 1,
    "down": 2,
    "nord": 0,
    "ost": 1,
    "unten": 2,
}
BODY_RATES = {"roll", "pitch", "yaw", "p", "q", "r", "nick", "gier", "rollen", "nicken", "gieren"} | {
    "rollrate",
    "pitchrate",
    "yawrate",
    "nickrate",
    "gierrate",
    "rollgeschwindigkeit",
    "nickgeschwindigkeit",
    "giergeschwindigkeit",
}
NED = {"n", "e", "d", "north", "east", "down", "nord", "ost", "unten"}


EVERY_WORD = {w for words in (*QUANTITY_WORDS.values(), *TRIAD_WORDS.values(), AXES) for w in words}


def means(tokens: tuple[str, ...], words: set[str]) -> set[str]:
    """Tokens of a name that say one of these words, whole or cut short (``azim``), where that is no word of its own."""
    said = set(tokens) & words
    cut = {t for t in tokens if len(t) >= 3 and t not in EVERY_WORD}
    return said | {t for t in cut if any(w.startswith(t) and len(w) >= 6 for w in words)}


@dataclass(frozen=True)
class Named:
    """A column's name taken apart: tokens of what it is, and the unit's text where it names one."""

    name: str
    tokens: tuple[str, ...]
    unit_text: str

    def units(self, kind: str) -> list[str]:
        """Names in flight.toml of the stated unit that fit a kind of quantity; empty where none is stated or fits."""
        return [u for u in UNIT_WORDS.get(unit_key(self.unit_text), ()) if UNITS[u][0] == kind]

    @property
    def kinds(self) -> set[str]:
        """Kinds of quantity that the stated unit allows; empty where none is stated."""
        return {UNITS[u][0] for u in UNIT_WORDS.get(unit_key(self.unit_text), ())}


def fold(text: str) -> str:
    """Lower case, without umlauts, Greek mu and raised digits."""
    return text.replace("°C", "degc").replace("°", "deg").lower().translate(FOLD)


def unit_key(text: str) -> str:
    """A unit's text as `UNIT_WORDS` has it."""
    return fold(text).replace(" ", "").strip("()[]{}<>.")


def take_apart(name: str, unit_row: str = "") -> Named:
    """Tokens and unit of a column's name; a row of units below the header goes before the name's own."""
    base, unit = name.strip(), ""
    bracket = re.match(r"^(.*?)\s*[(\[{<]\s*([^()\[\]{}<>]+?)\s*[)\]}>]\s*$", base)
    if bracket and bracket[1]:
        base, unit = bracket[1], bracket[2]
    else:
        for mark in re.finditer(r"[_\s/.,]+(?:in\s+)?", base):
            head, tail = base[: mark.start()], base[mark.end() :]
            if head and (unit_key(tail) in UNIT_WORDS or unit_key(tail) in SEVERAL_MEANINGS):
                base, unit = head, tail
                break
    stated = unit_row.strip().strip("()[]{}<>") or unit
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", base)
    return Named(name, tuple(re.findall(r"[a-z]+|\d+", fold(spaced))), stated)

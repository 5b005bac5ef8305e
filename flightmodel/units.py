"""Which unit does a text name, and how does a number in it become SI?

Units have short names in flight.toml and in the names of canonical columns (``_mps2``, ``_degc``); any other text is
read by the library pint (``"slug/ft^3"``, ``"deg/hr"``, ``"inHg"``), as long as it is the unit of a quantity that a
table may hold. One letter is never asked of the library: F is a farad there, and R the gas constant.
"""

from __future__ import annotations

import csv
import re
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple


class Unit(NamedTuple):
    """Kind of quantity; SI is ``factor * value + offset``."""

    kind: str
    factor: float
    offset: float = 0.0


_ALONG_AXES = {"acceleration", "rate", "magnetic field"}
# SI is ``factor * value + offset``: lengths, forces and temperatures by `scipy.constants`, g as the standard gravity
_UNITS = csv.DictReader(files("flightmodel").joinpath("data", "units.csv").read_text(encoding="utf-8").splitlines())
UNITS = {row["unit"]: Unit(row["kind"], float(row["factor"]), float(row["offset"])) for row in _UNITS}
_LETTER = r"A-Za-z\u00b5\u03bc\u00b0"  # with both signs of micro, and the degree
_RAISED = str.maketrans("\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079\u207b", "0123456789-")
_READABLE = re.compile(rf"[{_LETTER}][{_LETTER}0-9_/*^.()\- ]{{1,39}}")
# what pint's parser raises for texts that are no expression
_UNREADABLE = (TypeError, ValueError, AttributeError, ArithmeticError, SyntaxError, AssertionError)
# powers of mass, length, time, temperature and current, and whether the unit holds an angle
_BASES = ("[mass]", "[length]", "[time]", "[temperature]", "[current]")
_KINDS = {
    (0, 0, 1, 0, 0, False): "time",
    (0, 1, 0, 0, 0, False): "length",
    (0, 1, -1, 0, 0, False): "speed",
    (0, 1, -2, 0, 0, False): "acceleration",
    (0, 0, 0, 0, 0, True): "angle",
    (0, 0, -1, 0, 0, True): "rate",
    (1, -3, 0, 0, 0, False): "density",
    (0, 0, 0, 1, 0, False): "temperature",
    (1, -1, -2, 0, 0, False): "pressure",
    (1, 0, -2, 0, -1, False): "magnetic field",
}


def read_unit(text: str) -> Unit | None:
    """Unit by its short name, or as the library reads it; None where it is no unit of a quantity of a table.

    ``-degps`` is of a sensor's axis that points the other way than its name says: mirrored triads have no other words.
    """
    if text.startswith("-") and text[1:2].isalpha():
        along = read_unit(text[1:])
        return along._replace(factor=-along.factor) if along is not None and along.kind in _ALONG_AXES else None
    return UNITS.get(text) or _read(text)


@lru_cache(maxsize=256)
def _read(text: str) -> Unit | None:
    plain = text.strip().translate(_RAISED).replace("\u00b7", "*").replace("**", "^")
    if not _READABLE.fullmatch(plain) or "\n" in text:
        return None
    library, registry = _library()
    plain = re.sub(rf"(?<=[{_LETTER})])(-?\d)", r"^\1", plain)  # m/s2, kg m-3
    plain = re.sub(r"(?<=[\w)]) +(?=[A-Za-z(])", "*", plain)
    try:
        unit = registry.parse_units(plain)
        ends = [registry.Quantity(x, unit).to_base_units() for x in (0.0, 1.0)]
    except (library.errors.PintError, *_UNREADABLE):
        return None
    powers = dict(ends[0].dimensionality)
    found = *(powers.pop(base, 0) for base in _BASES), "radian" in str(ends[1].units)
    kind = None if powers else _KINDS.get(found)
    if kind is None:
        return None
    offset = float(ends[0].magnitude)
    return Unit(kind, float(ends[1].magnitude) - offset, offset)


@lru_cache(maxsize=1)
def _library() -> tuple[Any, Any]:
    import pint  # half a second, which a table of usual units needs not wait for

    return pint, pint.UnitRegistry()

"""Which quantity is a unit's, and how is it turned into SI?

Units have short names in flight.toml and in the names of canonical columns (``_mps2``, ``_degc``); any other text is
read by the library pint (``"slug/ft^3"``, ``"deg/hr"``, ``"inHg"``), as long as it is the unit of a quantity that a
table may hold. One letter is never asked of the library: F is a farad there, and R the gas constant.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import constants

from flightmodel.earth import STANDARD_GRAVITY_MPS2

_DEG = np.pi / 180.0


class Unit(NamedTuple):
    """Kind of quantity; SI is ``factor * value + offset``."""

    kind: str
    factor: float
    offset: float = 0.0


UNITS: dict[str, Unit] = {
    "s": Unit("time", 1.0),
    "ms": Unit("time", 1e-3),
    "us": Unit("time", 1e-6),
    "min": Unit("time", 60.0),
    "m": Unit("length", 1.0),
    "cm": Unit("length", 0.01),
    "mm": Unit("length", 1e-3),
    "km": Unit("length", 1000.0),
    "yd": Unit("length", constants.yard),
    "ft": Unit("length", constants.foot),
    "kft": Unit("length", 1000.0 * constants.foot),
    "kyd": Unit("length", 1000.0 * constants.yard),
    "mi": Unit("length", constants.mile),
    "nmi": Unit("length", constants.nautical_mile),
    "rad": Unit("angle", 1.0),
    "mrad": Unit("angle", 1e-3),
    "deg": Unit("angle", _DEG),
    "gon": Unit("angle", np.pi / 200.0),
    "mil": Unit("angle", 2.0 * np.pi / 6400.0),
    "deg1e7": Unit("angle", 1e-7 * _DEG),  # whole numbers, as many receivers write a latitude
    "mps2": Unit("acceleration", 1.0),
    "g": Unit("acceleration", STANDARD_GRAVITY_MPS2),
    "mg": Unit("acceleration", 1e-3 * STANDARD_GRAVITY_MPS2),
    "ftps2": Unit("acceleration", constants.foot),
    "radps": Unit("rate", 1.0),
    "mradps": Unit("rate", 1e-3),
    "degps": Unit("rate", _DEG),
    "degph": Unit("rate", _DEG / 3600.0),
    "rpm": Unit("rate", 2.0 * np.pi / 60.0),
    "t": Unit("magnetic field", 1.0),
    "ut": Unit("magnetic field", 1e-6),
    "nt": Unit("magnetic field", 1e-9),
    "gauss": Unit("magnetic field", 1e-4),
    "mps": Unit("speed", 1.0),
    "cmps": Unit("speed", 0.01),
    "mmps": Unit("speed", 1e-3),
    "kmh": Unit("speed", constants.kmh),
    "kt": Unit("speed", constants.knot),
    "mph": Unit("speed", constants.mph),
    "ftps": Unit("speed", constants.foot),
    "kgpm3": Unit("density", 1.0),
    "gpm3": Unit("density", 1e-3),
    "slugpft3": Unit("density", constants.slug / constants.foot**3),
    "lbpft3": Unit("density", constants.pound / constants.foot**3),
    "k": Unit("temperature", 1.0),
    "degc": Unit("temperature", 1.0, constants.zero_Celsius),
    "degf": Unit("temperature", constants.degree_Fahrenheit, constants.convert_temperature(0.0, "F", "K")),
    "degr": Unit("temperature", constants.degree_Fahrenheit),
    "pa": Unit("pressure", 1.0),
    "hpa": Unit("pressure", 100.0),
    "kpa": Unit("pressure", 1000.0),
    "psi": Unit("pressure", constants.psi),
    "psf": Unit("pressure", constants.pound_force / constants.foot**2),
    "inhg": Unit("pressure", 1000.0 * constants.inch * constants.mmHg),
    "mmhg": Unit("pressure", constants.mmHg),
    "1": Unit("fraction", 1.0),
    "percent": Unit("fraction", 0.01),
}
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
    """Unit by its short name, or as the library reads it; None where it is no unit of a quantity of a table."""
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
    except (
        library.errors.PintError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        SyntaxError,
        AssertionError,
    ):
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

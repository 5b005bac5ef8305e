"""Which unit would explain a factor between what a column says and what other sensors ask for?"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.columns import UNITS, Quantity, place
from flightmodel.sources import Source

PLAIN = 0.05  # units differ by less than this factor from what is seen, or do not explain it


def unit_of(source: Source, quantity: Quantity) -> str:
    """Unit in which flight.toml, or the column's own name, says a quantity stands."""
    return place(quantity, source.declared(quantity.short))[1]


def unit_that_explains(ratio: float, unit: str, within: float = PLAIN) -> str | None:
    """Return the unit of the same kind in which values read as ``unit`` would be ``ratio`` times as large, or None.

    Where the values fit as they are, that is ``unit`` itself.
    """
    kind, factor, _ = UNITS[unit]
    if not np.isfinite(ratio) or ratio <= 0.0:
        return None
    off = {name: abs(float(np.log(f / factor / ratio))) for name, (k, f, _) in UNITS.items() if k == kind}
    best = min(off, key=lambda name: (off[name], name != unit))
    return best if off[best] < within else None


def slope_through_mean(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope of ``y`` over ``x`` with its standard deviation; infinite where x does not change."""
    dx, dy = x - x.mean(), y - y.mean()
    square = float(dx @ dx)
    if square == 0.0 or len(x) < 3:
        return 0.0, np.inf
    slope = float(dx @ dy) / square
    left = dy - slope * dx
    return slope, float(np.sqrt(left @ left / (len(x) - 2) / square))

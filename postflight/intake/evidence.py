"""Which unit do the numbers themselves allow? Only where one alone is possible; else the analyst is asked.

Bounds are nature's: 9.8 m/s^2 where a vehicle stands, a field of 22 to 67 uT at the ground (15 to 100 with iron),
800 to 1100 hPa near the ground, no angle beyond a full turn, no body that turns with more than 400 rad/s.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray

STEADY = 0.02  # of the mean: what stands still is no noisier
STEADY_ROWS = 50
BANDS: dict[str, list[tuple[float, float, str]]] = {
    "acceleration": [(9.6, 10.0, "mps2"), (0.98, 1.02, "g"), (980.0, 1020.0, "mg"), (31.6, 32.8, "ftps2")],
    "magnetic field": [(15.0, 100.0, "ut"), (0.15, 1.0, "gauss"), (15e-6, 100e-6, "t"), (15e3, 100e3, "nt")],
    "pressure": [(6e4, 1.1e5, "pa"), (600.0, 1100.0, "hpa"), (60.0, 110.0, "kpa")],
    "temperature": [(150.0, 400.0, "k"), (-120.0, 60.0, "degc")],
    "density": [(0.5, 1.5, "kgpm3"), (500.0, 1500.0, "gpm3")],
}


def triad_unit(kind: str, values: FloatArray) -> tuple[str, str]:
    """Unit of a triad (n, 3) of a kind, and why; an empty unit with what was seen where several are possible."""
    size = np.linalg.norm(values, axis=1)
    size = size[np.isfinite(size)]
    if not len(size):
        return "", "no numbers"
    if kind == "acceleration":
        for part, where in ((size[:STEADY_ROWS], "first"), (size[-STEADY_ROWS:], "last")):
            mean = float(part.mean())
            if len(part) == STEADY_ROWS and part.std() < STEADY * mean:
                unit = _band(kind, mean)
                if unit:
                    return unit, f"steady at {mean:.4g} in the {where} rows, as where it stands still"
        return "", f"size {float(np.median(size)):.3g} (median), nowhere steady at 1 g"
    if kind == "magnetic field":
        middle = float(np.median(size))
        return _band(kind, middle), f"size {middle:.3g} (median)"
    if kind == "rate" and size.max() > 400.0:
        return "degps", f"up to {size.max():.4g}: no body turns so many rad/s"
    return "", f"size up to {float(size.max()):.3g}"


def single_unit(short: str, kind: str, values: FloatArray) -> tuple[str, str]:
    """Unit of one column, and why; an empty unit with what was seen where several are possible."""
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
    fitting = [unit for low, high, unit in BANDS[kind] if low <= value <= high]
    return fitting[0] if len(fitting) == 1 else ""

"""When did something happen between two records, and what was the state at that time?

A peak is that of the parabola through the three samples around the largest; a crossing is the root, inside its own
step, of the cubic through the four samples around it; a value at a time is that of the same cubic. Events, peaks,
summary and report of an estimate and the events of a truth all take their times and values from here.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import BoolArray, FloatArray

# above this height a Mach number is a convention, and one that rises and falls with the thermosphere
HIGHEST_M = 130e3


def find_peak(time_s: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Time and size of the largest value, by a parabola through the three samples around it."""
    k = int(np.clip(np.argmax(values), 1, len(time_s) - 2))
    fit = np.polynomial.Polynomial.fit(time_s[k - 1 : k + 2], values[k - 1 : k + 2], 2)
    at = float(fit.deriv().roots()[0].real) if abs(fit.coef[2]) > 0 else float(time_s[k])
    at = float(np.clip(at, time_s[k - 1], time_s[k + 1]))
    return at, float(fit(at))


def has_peak(values: FloatArray) -> bool:
    """Whether the largest value lies inside the record, not at its first or last sample."""
    return 0 < int(np.argmax(values)) < len(values) - 1


def _around(time_s: FloatArray, k: int) -> slice:
    """Four samples around the step from k to k + 1, fewer at the ends."""
    low = int(np.clip(k - 1, 0, max(len(time_s) - 4, 0)))
    return slice(low, low + 4)


def first_fall(time_s: FloatArray, values: FloatArray, level: float, allowed: BoolArray | None = None) -> float | None:
    """Time at which values first fall to a level; None where they never do.

    Parameters
    ----------
    time_s, values : (n,) float
    level : float
    allowed : (n,) bool, optional
        Steps whose second sample is not allowed do not count.
    """
    falls = (values[:-1] > level) & (values[1:] <= level)
    if allowed is not None:
        falls &= allowed[1:]
    if not falls.any():
        return None
    k = int(np.argmax(falls))
    rows = _around(time_s, k)
    size = len(time_s[rows]) - 1
    fit = np.polynomial.Polynomial.fit(time_s[rows], values[rows] - level, size)
    low, high = float(time_s[k]), float(time_s[k + 1])
    # a sample on the level, within rounding, is the crossing itself
    if fit(low) <= 0.0:
        return low
    if fit(high) >= 0.0:
        return high
    from scipy.optimize import brentq  # a quarter of a second to import

    return float(brentq(fit, low, high, xtol=1e-12))


def splashdown_index(altitude_m: FloatArray) -> int | None:
    """Count of the records up to and with the first at or below zero height after one above; None where none is.

    A flight that keeps ``records[:splashdown_index]`` ends at the sea, and its last step holds the time itself.
    """
    fell = (altitude_m[:-1] > 0.0) & (altitude_m[1:] <= 0.0)
    return int(np.argmax(fell)) + 2 if fell.any() else None


def values_at(time_s: FloatArray, columns: FloatArray, at_s: float) -> FloatArray:
    """Columns ``(n, m)`` at one time inside the records, ``(m,)``, by the cubic through four samples around it."""
    k = int(np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2))
    t, v = time_s[_around(time_s, k)], columns[_around(time_s, k)]
    weights = [np.prod([(at_s - t[j]) / (t[i] - t[j]) for j in range(len(t)) if j != i]) for i in range(len(t))]
    return np.array(weights) @ v


def value_at(time_s: FloatArray, values: FloatArray, at_s: float) -> float:
    """One quantity (n,) at one time, as `values_at`; beside a missing sample by a straight line."""
    cubic = float(values_at(time_s, values[:, None], at_s)[0])
    return cubic if np.isfinite(cubic) else float(np.interp(at_s, time_s, values))


def descent_events(time_s: FloatArray, altitude_m: FloatArray, mach: FloatArray) -> list[tuple[str, float]]:
    """Names and times of apogee, and of 80 km, 40 km, Mach 3.5 and Mach 1 in descent, for those within the record."""
    found: list[tuple[str, float | None]] = []
    if has_peak(altitude_m):
        found.append(("apogee", find_peak(time_s, altitude_m)[0]))
    down = (np.arange(len(time_s)) > np.argmax(altitude_m)) & (altitude_m < HIGHEST_M)
    for name, values, level in (
        ("80 km", altitude_m, 80e3),
        ("40 km", altitude_m, 40e3),
        ("Mach 3.5", mach, 3.5),
        ("Mach 1", mach, 1.0),
    ):
        found.append((name, first_fall(time_s, values, level, down)))
    return [(name, at) for name, at in found if at is not None]

"""Which unit, which order of axes and which time bias reconcile one record with another?

A unit is named where another of the same kind meets the ratio of two records within a few per cent,
``f_unit / f_declared = ratio``. Axes are any of the 48 orders and signs of three columns. A time bias is a
cross-check's remark where it exceeds five standard deviations and 0.1 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from flightmodel.checks import FloatArray, Issue
from flightmodel.tables import Quantity, Source, place
from flightmodel.units import UNITS, read_unit

Axes = tuple[tuple[int, ...], tuple[int, ...]]
AS_DECLARED: Axes = ((0, 1, 2), (1, 1, 1))
_SAME_UNIT = 0.05  # logarithm: a unit explains a ratio within this
_SIGNIFICANT_SD, _SIGNIFICANT_S = 5.0, 0.1  # beyond both: a tenth of a second, which the filter's own time bias takes
_WORTH_A_LOOK_SD = 3.0  # a remark, not a warning: one in 370 by chance
_SHARP_S = 0.5  # a time bias of a larger standard deviation says nothing of a clock


def unit_of(source: Source, quantity: Quantity) -> str:
    """Return the unit that flight.toml, or the column's own name, states for a quantity."""
    return place(quantity, source.declared(quantity.short))[1]


def unit_that_explains(ratio: float, unit: str, within: float = _SAME_UNIT) -> str | None:
    """Return the unit that scales values read as ``unit`` by ``ratio``; None if there is none.

    Parameters
    ----------
    ratio : float
        Expected over read, in SI.
    unit : str
        As declared; it is returned where the values fit as they are.
    within : float
        Largest difference of the logarithms.
    """
    declared = read_unit(unit)
    if declared is None:
        return None
    kind, factor, _ = declared
    if not np.isfinite(ratio) or ratio <= 0.0:
        return None
    known = {**UNITS, unit: declared}
    off = {name: abs(float(np.log(f / factor / ratio))) for name, (k, f, _) in known.items() if k == kind}
    best = min(off, key=lambda name: (off[name], name != unit))
    return best if off[best] < within else None


def unit_hint(declared: str, unit: str | None) -> str:
    """Return a message's ending that names the matching unit; empty if there is none or it is the declared one."""
    return f": declared in '{declared}', consistent with '{unit}'" if unit not in (None, declared) else ""


def all_axes() -> list[Axes]:
    """Return the 48 (order, signs) in which three columns may stand for body x, y, z; the first is as declared."""
    return [(order, signs) for order in permutations(range(3)) for signs in product((1, -1), repeat=3)]


def axes_matrix(order: Sequence[int], signs: Sequence[int]) -> FloatArray:
    """Return the matrix (3, 3) from the columns to body components."""
    return np.asarray(np.eye(3)[list(order)] * np.array(signs)[:, None])


def axes_named(order: Sequence[int], signs: Sequence[int]) -> str:
    """Name the rates that stand for body x, y and z: ``+q, -p, +r``."""
    return ", ".join(f"{'+' if s > 0 else '-'}{'pqr'[k]}" for k, s in zip(order, signs, strict=True))


@dataclass(frozen=True)
class TimeBias:
    """Delay of ``source``'s time tags against ``against``'s, s, with one standard deviation."""

    source: str
    against: str
    late_s: float
    sd_s: float

    @property
    def is_significant(self) -> bool:
        """Whether it is beyond five standard deviations and 0.1 s."""
        return abs(self.late_s) > max(_SIGNIFICANT_SD * self.sd_s, _SIGNIFICANT_S)

    @property
    def is_sharp(self) -> bool:
        """Whether the standard deviation is small enough to show the time bias."""
        return self.sd_s < _SHARP_S

    @property
    def is_worth_a_look(self) -> bool:
        """Whether it is beyond three standard deviations, and not significant."""
        return abs(self.late_s) > _WORTH_A_LOOK_SD * self.sd_s and not self.is_significant


def clock_remarks(biases: list[TimeBias], onboard: Sequence[str]) -> list[Issue]:
    """Return a remark for each clock that is off, where time biases between pairs are significant.

    A clock that is late by ``x`` is late against each other by ``x``: the clock that explains the biases best (weighted
    least squares) is named, its part is taken out, and the next one is sought. The sensors ``onboard`` may share one.
    Of clocks that explain the biases equally well the first in ``biases`` is named.
    """
    left, out, named = list(biases), [], set[tuple[str, ...]]()
    while any(bias.is_significant for bias in left):
        far = [bias for bias in left if bias.is_significant]
        names = dict.fromkeys((name,) for bias in far for name in (bias.source, bias.against))
        clocks = [clock for clock in (*names, tuple(onboard)) if _signs(clock, far).any() and clock not in named]
        if not clocks:
            break
        _, clock, late_s, sd_s = max((_explained(clock, left) for clock in clocks), key=lambda found: found[0])
        named.add(clock)
        others = dict.fromkeys(name for b in left for name in (b.source, b.against) if name not in clock)
        which, name = "later" if late_s > 0 else "earlier", ", ".join(clock)
        words = (
            f"time tags are {abs(late_s):.3f} +/- {sd_s:.3f} s {which} than those of {' and '.join(others)}; "
            f"if {name} is the one in error, add {-late_s:+.3f} to its time.offset_s, else {late_s:+.3f} to theirs"
        )
        out.append(Issue(words, "clock-lag", name))
        signs = _signs(clock, left)
        left = [replace(b, late_s=b.late_s - late_s * float(sign)) for b, sign in zip(left, signs, strict=True)]
    return out


def _signs(clock: Sequence[str], biases: list[TimeBias]) -> FloatArray:
    """Change of each pair's time bias per unit delay of this clock: 1, 0 or -1."""
    return np.array([float(b.source in clock) - float(b.against in clock) for b in biases])


def _explained(clock: tuple[str, ...], biases: list[TimeBias]) -> tuple[float, tuple[str, ...], float, float]:
    """Half the chi-square that one clock explains, the clock, how late it is, s, and the standard deviation."""
    signs, sd = _signs(clock, biases), np.array([b.sd_s for b in biases])
    weight = float(np.sum((signs / sd) ** 2))
    late_s = float(np.sum(signs * np.array([b.late_s for b in biases]) / sd**2)) / weight
    return 0.5 * late_s**2 * weight, clock, late_s, weight**-0.5


def slope_through_mean(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the slope of ``y`` (n,) over ``x`` (n,) and its standard deviation; infinite where x is constant."""
    dx, dy = x - x.mean(), y - y.mean()
    square = float(dx @ dx)
    if square == 0.0 or len(x) < 3:
        return 0.0, np.inf
    slope = float(dx @ dy) / square
    residual = dy - slope * dx
    return slope, float(np.sqrt(residual @ residual / (len(x) - 2) / square))


def window_means(time_s: FloatArray, values: FloatArray, grid_s: FloatArray, low_s: float, high_s: float) -> FloatArray:
    """Return means (m, k) of samples (n, k) over windows from ``grid_s + low_s`` to ``grid_s + high_s``."""
    from scipy.integrate import cumulative_trapezoid  # a tenth of a second

    total = cumulative_trapezoid(values, time_s, axis=0, initial=0.0)
    low, high = (np.column_stack([np.interp(grid_s + side, time_s, c) for c in total.T]) for side in (low_s, high_s))
    return np.asarray((high - low) / (high_s - low_s))


def interval_around(time_s: FloatArray, at_s: FloatArray) -> FloatArray:
    """Return the interval (m,) between the samples (n,) on either side of each time (m,), s."""
    after = np.clip(np.searchsorted(time_s, at_s), 1, len(time_s) - 1)
    return np.asarray(time_s[after] - time_s[after - 1])

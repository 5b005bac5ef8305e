"""What an analyst should know of a sensor's samples: gaps, missing, frozen and saturated runs, each with its times.

Of very many of one kind the longest are told one by one and the others together: a list that nobody reads hides them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.telemetry import Finding

GAP_FACTOR = 5.0  # an interval this many times the usual one is a gap
FROZEN_S, FROZEN_SAMPLES = 0.5, 10  # a column unchanged for this long, in at least so many samples, is frozen
SATURATED_SAMPLES = 5  # this many samples in a row at a column's largest or smallest value are a stop
MANY = 20  # runs of one kind that are told one by one
Indices = NDArray[np.int64]


def find_faults(
    source: str, time_s: FloatArray, names: tuple[str, ...], values: FloatArray, missing: BoolArray | None = None
) -> list[Finding]:
    """Findings of one sensor.

    Parameters
    ----------
    source : str
    time_s : (n,) float
    names : tuple of str
        Of the columns.
    values : (n, m) float
        NaN is missing.
    missing : (n,) bool, optional
        Rows that count as missing; where not given, those in which any value is.
    """
    if missing is None:
        missing = np.logical_or.reduce([np.isnan(column) for column in values.T])
    step = np.diff(time_s)
    wide = np.flatnonzero(step > GAP_FACTOR * float(np.median(step)))
    found = told(source, time_s, wide, wide + 1, lambda k: f"gap of {step[wide[k]]:.3f} s", "gaps")
    first, last = runs(missing)
    found += told(source, time_s, first, last, lambda k: f"{last[k] - first[k] + 1} samples missing", "missing runs")
    for name, column in zip(names, values.T, strict=True):
        found += _stuck(source, time_s, name, column)
    return found


def told(
    source: str, time_s: FloatArray, first: Indices, last: Indices, words: Callable[[int], str], kind: str
) -> list[Finding]:
    """Findings of runs of samples ``first`` to ``last``; ``words`` of each, and of what ``kind`` they are."""
    size = last - first + 1
    alone = np.ones(len(size), dtype=bool)
    if len(size) > MANY:
        least = np.partition(size, -MANY)[-MANY]
        alone = size > least
        alone[np.flatnonzero(size == least)[: MANY - int(alone.sum())]] = True
    chosen = np.flatnonzero(alone).tolist()
    found = [Finding(source, words(k), float(time_s[first[k]]), float(time_s[last[k]])) for k in chosen]
    if not alone.all():
        size, first, last = size[~alone], first[~alone], last[~alone]
        together = f"{len(size)} further {kind}, {size.sum()} samples, at most {size.max()} in a row"
        found.append(Finding(source, together, float(time_s[first[0]]), float(time_s[last[-1]])))
    return found


def runs(mask: BoolArray) -> tuple[Indices, Indices]:
    """First and last index of each unbroken run of true."""
    inside = np.flatnonzero(mask)
    breaks = np.flatnonzero(np.diff(inside) > 1)
    if not len(inside):
        return inside, inside
    return inside[np.append(0, breaks + 1)], inside[np.append(breaks, len(inside) - 1)]


def _stuck(source: str, time_s: FloatArray, name: str, column: FloatArray) -> list[Finding]:
    """Runs of one value: long ones anywhere, shorter ones at the column's largest and smallest value."""
    # NaN is equal to nothing; a run of "equal to the sample before" begins one sample earlier
    first, last = runs(column[1:] == column[:-1])
    last = last + 1
    if not len(first):
        return []
    low, high = np.fmin.reduce(column), np.fmax.reduce(column)
    at_end = (column[first] == low) | (column[first] == high)
    saturated = at_end & (last - first + 1 >= SATURATED_SAMPLES) & (low < high)
    frozen = (time_s[last] - time_s[first] >= FROZEN_S) & (last - first + 1 >= FROZEN_SAMPLES)
    some = saturated | frozen
    first, last, saturated, frozen = first[some], last[some], saturated[some], frozen[some]

    def words(k: int) -> str:
        # a long run at an extreme may be either: a stop reached, or a sensor that stuck there
        what = "saturated or frozen" if saturated[k] and frozen[k] else "frozen" if frozen[k] else "saturated"
        return f"{name} {what} at {column[first[k]]:.6g} (SI) for {last[k] - first[k] + 1} samples"

    return told(source, time_s, first, last, words, f"runs of one value of {name}")

"""Fewer points for the eye: what is drawn of long series, with every extreme kept."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray

Rows = NDArray[np.int64]


def extreme_rows(values: FloatArray, buckets: int) -> Rows:
    """Rows of the smallest and the largest value ``(n,)`` in each of equal runs of rows, ascending; NaN is no value."""
    edges = np.linspace(0, len(values), buckets + 1).astype(int)
    found: list[int] = []
    for low, high in pairwise(edges.tolist()):
        part = values[low:high]
        if np.isfinite(part).any():
            found += [low + int(np.nanargmin(part)), low + int(np.nanargmax(part))]
    return np.unique(np.array(found, dtype=np.int64))


def kept_rows(columns: list[FloatArray], limit: int) -> Rows:
    """Rows to draw of columns ``(n,)`` that share their times: all, or every column's extremes within ``limit`` rows.

    First and last row stay, and so do the two sides of every hole, a run of NaN.
    """
    n = len(columns[0])
    if n <= limit:
        return np.arange(n)
    buckets = limit // 2 - 1
    while True:
        sides = [np.flatnonzero(np.diff(np.isfinite(c).astype(int))) for c in columns]
        rows = [extreme_rows(c, buckets) for c in columns] + sides + [s + 1 for s in sides] + [np.array([0, n - 1])]
        kept = np.unique(np.concatenate(rows))
        if len(kept) <= limit or buckets <= 16:
            return kept
        buckets = buckets * 2 // 3


def rounded(values: FloatArray, decimals: int) -> list[float | None]:
    """Numbers for JSON, NaN as None."""
    return [round(x, decimals) + 0.0 if x == x else None for x in np.asarray(values, dtype=float).tolist()]

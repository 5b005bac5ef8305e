"""Which rows of a run's long tables does a report draw?

Of long series the smallest and the largest value of each of equal runs of rows are drawn: every extreme stays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray

Rows = NDArray[np.int64]


def extreme_rows(values: FloatArray, buckets: int) -> Rows:
    """Rows of the smallest and the largest value ``(n,)`` in each of equal runs of rows, ascending; NaN is no value."""
    edges = np.linspace(0, len(values), buckets + 1).astype(int)
    first, last = edges[:-1][np.diff(edges) > 0], edges[1:][np.diff(edges) > 0] - 1
    if not len(first):
        return np.empty(0, dtype=np.int64)
    # a bucket a row; in the shorter ones the last value stands twice
    rows = np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])
    part = values[rows]
    known = np.isfinite(part)
    lowest, highest = np.where(known, part, np.inf).argmin(axis=1), np.where(known, part, -np.inf).argmax(axis=1)
    there, every = known.any(axis=1), np.arange(len(first))
    return np.unique(np.concatenate([rows[every, lowest][there], rows[every, highest][there]]))


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

"""Ways to spoil the telemetry tables of the two-radar reference flight, as an unlucky range delivers them.

Each returns a function that spoils a dictionary of tables by source, in place.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

FROM_S, TO_S = 390.0, 468.0
PEAK_S, QUIET_S, LATE_S = 440.5, 400.0, 455.0  # of dynamic pressure; before and behind the pulse
ISLAND, MAINLAND = "wallops_island", "wallops_mainland"
FILES = {"accelerometer": "accelerometer.csv", "rates": "rates.csv"}
FILES |= {radar: f"radar_{radar}.csv" for radar in (ISLAND, MAINLAND)}
Tables = dict[str, pd.DataFrame]


def rows(table: pd.DataFrame, start: float, end: float) -> np.ndarray:
    t = table["t_s"].to_numpy()
    return np.flatnonzero((t >= start) & (t < end))


def frozen(source, columns, start, end):
    def spoil(tables):
        table = tables[source]
        k = rows(table, start, end)
        for c in columns:
            table.iloc[k, 1 + c] = table.iat[k[0], 1 + c]

    return spoil


def clipped(source, column, part):
    """A stop at a part of the largest value."""

    def spoil(tables):
        values = tables[source].iloc[:, 1 + column]
        most = part * values.abs().max()
        tables[source].iloc[:, 1 + column] = values.clip(-most, most)

    return spoil


def moved(source, column, by, start=-np.inf, end=np.inf, blind=""):
    """Values of a span are off; another radar sees nothing meanwhile."""

    def spoil(tables):
        table = tables[source]
        table.iloc[rows(table, start, end), 1 + column] += by
        if blind:
            lost([blind], start, end)(tables)

    return spoil


def lost(sources, start, end):
    def spoil(tables):
        for s in sources:
            tables[s] = tables[s].drop(index=rows(tables[s], start, end)).reset_index(drop=True)

    return spoil


def late(source, by, after=-np.inf):
    """Time tags from some time on are late by so much."""

    def spoil(tables):
        t = tables[source]["t_s"]
        tables[source]["t_s"] = t + by * (t >= after)

    return spoil


def reordered(source, order):
    """Rows of two seconds from the peak in another order, or some of them twice; ``order`` takes their numbers."""

    def spoil(tables):
        table = tables[source]
        k = rows(table, PEAK_S, PEAK_S + 2.0)
        before, after = np.arange(k[0]), np.arange(k[-1] + 1, len(table))
        tables[source] = table.iloc[np.concatenate([before, order(k), after])].reset_index(drop=True)

    return spoil


def first_again(k):
    half = len(k) // 2
    return np.concatenate([k[:half], k])


def swapped(k):
    half = len(k) // 2
    return np.concatenate([k[half:], k[:half]])


def stale(k):
    """Where time tags are those of delivery: one second twice, the next one never."""
    half = len(k) // 2
    return np.concatenate([k[:half], k[: len(k) - half]])


def shuffled(k):
    return np.random.default_rng(0).permutation(k)


def tagged_on_delivery(source, order):
    """As `reordered`, but the tags stay in order."""

    def spoil(tables):
        t = tables[source]["t_s"].to_numpy()
        reordered(source, order)(tables)
        tables[source]["t_s"] = t

    return spoil


def turned(axis, degrees):
    """The accelerometer is mounted otherwise than flight.toml says."""

    def spoil(tables):
        turn = Rotation.from_rotvec(np.deg2rad(degrees) * np.eye(3)[axis])
        tables["accelerometer"].iloc[:, 1:4] = turn.apply(tables["accelerometer"].iloc[:, 1:4].to_numpy(copy=True))

    return spoil

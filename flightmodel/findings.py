"""What an analyst should know of a sensor's samples: gaps, missing, frozen and saturated runs, each with its times."""

from __future__ import annotations

import numpy as np

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.telemetry import Finding

GAP_FACTOR = 5.0  # an interval this many times the usual one is a gap
FROZEN_S, FROZEN_SAMPLES = 0.5, 10  # a column unchanged for this long, in at least so many samples, is frozen
SATURATED_SAMPLES = 5  # this many samples in a row at a column's largest or smallest value are a stop


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
    found = []
    if missing is None:
        missing = np.asarray(~np.isfinite(values).all(axis=1))
    step = np.diff(time_s)
    for k in np.flatnonzero(step > GAP_FACTOR * float(np.median(step))):
        found.append(Finding(source, f"gap of {step[k]:.3f} s", float(time_s[k]), float(time_s[k + 1])))
    for first, last in runs(missing):
        found.append(Finding(source, f"{last - first + 1} samples missing", float(time_s[first]), float(time_s[last])))
    for name, column in zip(names, values.T, strict=True):
        # a long run at an extreme may be either: a stop reached, or a sensor that stuck there
        frozen, saturated = _frozen(time_s, column), _saturated(column)
        for first, last in sorted({*frozen, *saturated}):
            is_frozen, is_saturated = (first, last) in frozen, (first, last) in saturated
            what = "saturated or frozen" if is_frozen and is_saturated else "frozen" if is_frozen else "saturated"
            words = f"{name} {what} at {column[first]:.6g} (SI) for {last - first + 1} samples"
            found.append(Finding(source, words, float(time_s[first]), float(time_s[last])))
    return found


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """First and last index of each unbroken run of true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _frozen(time_s: FloatArray, column: FloatArray) -> list[tuple[int, int]]:
    with np.errstate(invalid="ignore"):
        same = np.append(False, np.diff(column) == 0.0)
    # a run of "equal to the sample before" begins one sample earlier
    both = [(first - 1, last) for first, last in runs(same)]
    return [(a, b) for a, b in both if time_s[b] - time_s[a] >= FROZEN_S and b - a + 1 >= FROZEN_SAMPLES]


def _saturated(column: FloatArray) -> list[tuple[int, int]]:
    """Runs at the extremes, in a column that holds other values too."""
    known = column[np.isfinite(column)]
    if len(known) == 0 or np.ptp(known) == 0.0:
        return []
    ends = [runs(column == extreme) for extreme in (known.max(), known.min())]
    return sorted((a, b) for side in ends for a, b in side if b - a + 1 >= SATURATED_SAMPLES)

"""Which samples of an inertial sensor hold one value for longer than chance allows: frozen, or at a stop.

White noise on a signal that stands still leaves a reading of step ``d`` at one value for ``n`` samples with probability
``P^(n - 1)``, at most ``P = erf(d / (2 sqrt(2) sd))``. Where the readings next to a run repeat more often than that (a
slow signal, a logger faster than its sensor) their share is ``P``. A sensor whose steps are coarser than its noise may
rest at one value for minutes, and is believed.

A run from the first sample on may be a vehicle at rest, and is believed too.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.findings import runs
from recon.state import IntArray

LEAST_SAMPLES = 5
NEIGHBOURS, LEAST_NEIGHBOURS = 200, 20  # readings on either side that tell how often values repeat
CHANCE = 1e-6  # of one such run in a whole record
CHANCE_AT_STOP = 1e-3  # of one among the runs at a column's largest or smallest value, which a stop explains
SAME_STEP = 1e-9  # of the largest value: two readings closer than this differ by rounding


def stuck_samples(column: FloatArray, noise_sd: float) -> BoolArray:
    """Samples (n,) of a column that tell nothing new; NaN is equal to nothing.

    Parameters
    ----------
    column : (n,) float
    noise_sd : float
        White noise of a sample, in the column's unit.
    """
    out: BoolArray = np.zeros(len(column), dtype=bool)
    same = column[1:] == column[:-1]
    first, last = runs(same)
    last = last + 1
    long = last - first + 1 >= LEAST_SAMPLES
    first, last = first[long & (first > 0)], last[long & (first > 0)]
    if not len(first):
        out[:] = bool(len(column) >= LEAST_SAMPLES and same.all() and noise_sd > 0.0)
        return out
    chance = np.maximum(repeat_by_noise(column, noise_sd), _repeat_nearby(same, first, last))
    with np.errstate(divide="ignore"):
        surprise = (last - first) * np.log(chance)
    at_stop = (column[first] == np.nanmin(column)) | (column[first] == np.nanmax(column))
    stuck = surprise < np.log(CHANCE / len(column))
    stuck |= at_stop & (surprise < np.log(CHANCE_AT_STOP / max(1, int(at_stop.sum()))))
    for a, b in zip(first[stuck], last[stuck], strict=True):
        out[a : b + 1] = True
    return out


def repeat_by_noise(column: FloatArray, noise_sd: float) -> float:
    """Largest probability that noise leaves a reading where it is."""
    if noise_sd <= 0.0:
        return 1.0
    steps = np.abs(np.diff(column))
    steps = steps[steps > SAME_STEP * np.nanmax(np.abs(column))]
    return float(erf(steps.min() / (2.0 * np.sqrt(2.0) * noise_sd))) if len(steps) else 1.0


def _repeat_nearby(same: BoolArray, first: IntArray, last: IntArray) -> FloatArray:
    """Share (k,) of readings that repeat next to each run ``first`` to ``last``, on the side where more of them do."""
    count = np.concatenate([[0], np.cumsum(same)])

    def share(low: IntArray, high: IntArray) -> FloatArray:
        size = high - low
        return np.where(size >= LEAST_NEIGHBOURS, (count[high] - count[low] + 1.0) / (size + 2.0), 0.0)

    before = share(np.maximum(first - 1 - NEIGHBOURS, 0), np.maximum(first - 1, 0))
    after = share(np.minimum(last + 1, len(same)), np.minimum(last + 1 + NEIGHBOURS, len(same)))
    return np.asarray(np.maximum(before, after))

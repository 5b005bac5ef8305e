"""Which samples of an inertial sensor are good readings in the wrong place: moved away and back, or told again?

A vehicle's motion does not jump from one sample to the next and jump back to where it would have been; an offset that
comes and goes does, and so do blocks of samples in the wrong order. The jump between two samples is the difference of
the parabolas through `REACH` samples on either side, carried to the middle. It is a jump where it stands out from the
jumps nearby (or from the sensor's noise, where that is larger), and the samples between jumps whose sum is nothing are
*displaced*. One jump alone may be the vehicle's own: a stage, a parachute. The pulse of a thruster comes and goes, too;
so displaced samples are believed where the trackers tell that they are right (`recon.shock`), and where they are not
believed they are still reckoned with (`recon.gaps`).

A block of samples that is the very same, in all axes, as one before it was sent twice under different times. Noise of
deviation ``sd`` makes a reading of step ``d`` equal to another with probability ``erf(d / (2 sqrt(2) sd))`` at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.findings import runs
from recon.state import IntArray
from recon.stuck import CHANCE, repeat_by_noise

REACH = 6  # samples of the parabola on either side
NEARBY, BESIDE = 201, 41  # jumps whose median size is the usual one: about a jump, and on either side of it
STANDS_OUT = 7.0  # sd; a record of a million samples of white noise holds none
NOTHING = 4.0  # sd of the sum of jumps that cancel
LONGEST_S = 10.0
UNEVEN = 0.25  # of the usual step: by no more do the steps about a jump differ
LEAST_REPEATED = 10
HASH = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)  # odd, of mixed bits
SEED = 10  # samples in a row by which a block is found


@dataclass(frozen=True)
class Displaced:
    """Readings of one axis of a triad (0 accelerometer, 1 gyros) that jump away and back, by ``offset`` on average."""

    triad: int
    axis: int
    start_s: float
    end_s: float
    offset: float


def displaced_runs(time_s: FloatArray, column: FloatArray, noise_sd: float) -> list[tuple[int, int, float]]:
    """First and last sample of each run between jumps that cancel, and the mean offset that the jumps tell.

    Parameters
    ----------
    time_s, column : (n,) float
        Samples that are there.
    noise_sd : float
        White noise of a sample, in the column's unit.
    """
    out: list[tuple[int, int, float]] = []
    if len(column) < 4 * REACH:
        return out
    size, sd = _jumps(time_s, column, noise_sd)
    at = _where_they_stand_out(size, sd)
    first = 0
    while first < len(at) - 1:
        near = at[first:][time_s[at[first:]] - time_s[at[first]] <= LONGEST_S]
        offset, offset_sd = np.cumsum(size[near]), np.sqrt(np.cumsum(sd[near] ** 2))
        closes = np.flatnonzero(np.abs(offset[1:]) < NOTHING * offset_sd[1:])
        if len(closes):
            last = int(closes[0]) + 1
            mean = np.average(offset[:last], weights=np.diff(time_s[near[: last + 1]]))
            out.append((int(near[0]) + 1, int(near[last]), float(mean)))
            first += last
        first += 1
    return out


def _jumps(time_s: FloatArray, column: FloatArray, noise_sd: float) -> tuple[FloatArray, FloatArray]:
    """Jump from each sample to the next and its standard deviation, (n - 1,); no jump where steps are uneven."""
    from scipy.ndimage import median_filter, minimum_filter

    n = len(column)
    reach = -(np.arange(REACH) + 0.5)
    weight = np.linalg.pinv(np.vander(reach, 3, increasing=True))[0]
    size = np.zeros(n - 1)
    for i, w in enumerate(weight):
        size[REACH - 1 : n - REACH] += w * (
            column[REACH + i : n - REACH + 1 + i] - column[REACH - 1 - i : n - REACH - i]
        )
    usual = 1.4826 * median_filter(np.abs(size), size=min(NEARBY, len(size)), mode="nearest")
    beside = 1.4826 * median_filter(np.abs(size), size=min(BESIDE, len(size)), mode="nearest")
    k, away = np.arange(len(size)), REACH + BESIDE // 2 + 1
    for there in (np.maximum(k - away, 0), np.minimum(k + away, len(size) - 1)):
        usual = np.maximum(usual, beside[there])  # where shaking begins, all are jumps
    step = np.diff(time_s)
    even = np.abs(step / np.median(step) - 1.0) < UNEVEN
    size[~minimum_filter(even, size=2 * REACH, mode="nearest")] = 0.0
    least = noise_sd * np.sqrt(2.0 * np.sum(weight**2))
    return size, np.maximum(np.maximum(usual, least), np.finfo(float).tiny)


def _where_they_stand_out(size: FloatArray, sd: FloatArray) -> IntArray:
    """Jumps (k,) larger than chance and than any other within reach."""
    from scipy.ndimage import maximum_filter

    height = np.abs(size) / sd
    return np.flatnonzero((height > STANDS_OUT) & (height == maximum_filter(height, size=4 * REACH - 1)))


def repeated_samples(measured: FloatArray, noise_sd: float) -> tuple[BoolArray, list[tuple[int, int, int]]]:
    """Samples (n,) that repeat a block before them, and first and last of each block with the first it repeats.

    Parameters
    ----------
    measured : (n, 3) float
        Samples that are there.
    noise_sd : float
    """
    n = len(measured)
    out: BoolArray = np.zeros(n, dtype=bool)
    moving = np.append(True, (measured[1:] != measured[:-1]).any(axis=1))
    likely = float(np.prod([repeat_by_noise(column, noise_sd) for column in measured.T]))
    with np.errstate(divide="ignore"):
        least = max(LEAST_REPEATED, np.log(CHANCE / max(n, 1) ** 2) / np.log(min(likely, 1.0 - 1e-9)))
    lag = _lag_to_the_same(measured)
    blocks = []
    for a, b in zip(*runs(np.append(False, (lag[1:] == lag[:-1]) & (lag[1:] > 1))), strict=True):
        if out[b] or moving[a - 1 : b + 1].sum() < min(least, SEED):
            continue
        # by chance one of its samples may repeat a nearer one, too, so that the block falls into parts
        shift = int(lag[b])
        alike = np.append(np.zeros(shift, dtype=bool), (measured[shift:] == measured[:-shift]).all(axis=1))
        first, last = runs(alike)
        k = int(np.searchsorted(first, b, side="right")) - 1
        start, end = int(first[k]), int(last[k])
        if moving[start : end + 1].sum() >= least:
            out[start : end + 1] = True
            blocks.append((start, end, start - shift))
    return out, blocks


def _lag_to_the_same(measured: FloatArray) -> IntArray:
    """How many samples before each (n,) the nearest one stands that is equal in all axes; 0 for none."""
    bits = np.ascontiguousarray(measured + 0.0).view(np.uint64)  # -0 becomes 0
    mark = bits[:, 0] * HASH[0] + bits[:, 1] * HASH[1] + bits[:, 2] * HASH[2]
    order = np.argsort(mark, kind="stable")
    lag = np.zeros(len(measured), dtype=np.int64)
    follows = (measured[order[1:]] == measured[order[:-1]]).all(axis=1)
    lag[order[1:][follows]] = (order[1:] - order[:-1])[follows]
    return lag

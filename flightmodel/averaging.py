"""Triads sampled far faster than a vehicle moves: means of blocks of samples in their place.

A block's mean keeps the integral that mechanisation forms from its samples, and the density of their noise; what is
lost is motion within a block. Memory and time of everything after the reading go with the number of samples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray
from flightmodel.telemetry import Finding, TriadRecord

LARGEST_RATE_HZ = 2000.0  # samples that come slower are used as they are
WANTED_RATE_HZ = 1000.0  # a sine of 100 Hz, beyond structure and joint, loses 1.6 % in means of 1 ms
STEADY = 0.99  # part of the steps that must be the usual one within a fifth
WHOLE = 0.75  # part of a block's samples that its mean needs


def averaged(record: TriadRecord) -> tuple[TriadRecord, list[Finding]]:
    """Means of blocks at about 1 kHz of a record of more than 2 kHz, and a finding; other records as they are.

    Noise and resolution of the record's data sheet become those of a mean. A record whose rate changes is left as it
    is: its means would not all have one noise.
    """
    step = np.diff(record.time_s)
    usual = float(np.median(step))
    count = int(1.0 / (usual * WANTED_RATE_HZ) + 0.5)
    if usual * LARGEST_RATE_HZ >= 1.0 or np.mean(np.abs(step - usual) < 0.2 * usual) < STEADY:
        return record, []
    del step
    block = ((record.time_s - record.time_s[0]) / (count * usual) + 0.5 / count).astype(np.int64)
    first = np.flatnonzero(np.diff(block, prepend=-1))
    whole = np.diff(first, append=len(block)) >= WHOLE * count
    time_s = _means(record.time_s, first, 1.0)[whole]
    means = np.column_stack([_means(column, first, WHOLE * count)[whole] for column in record.measured_sensor.T])
    spec = replace(
        record.spec, noise_sd=record.spec.noise_sd / np.sqrt(count), resolution=record.spec.resolution / np.sqrt(count)
    )
    words = f"{len(block)} samples at {1.0 / usual:.0f} Hz, of which means of {count} are used"
    return TriadRecord(spec, time_s, means), [Finding(spec.name, words, np.nan, np.nan)]


def _means(column: FloatArray, first: NDArray[np.int64], least: float) -> FloatArray:
    """Mean of the values that are there from each of ``first`` to the next; NaN where fewer than ``least`` are."""
    there = np.isfinite(column)
    count = np.add.reduceat(there, first, dtype=np.int64)
    sums = np.add.reduceat(np.where(there, column, 0.0), first)
    return np.where(count >= least, sums / np.maximum(count, 1), np.nan)

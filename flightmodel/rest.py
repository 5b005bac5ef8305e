"""When did the vehicle stand still on its pad, and what did its inertial sensors read there?

Half-second blocks of samples are at rest where accelerometer and gyros scatter no more than in the first blocks, their
means stay within that scatter, and the specific force has about the size of gravity: in free fall there is none, under
a parachute it shakes. Only a rest with which the data begin is looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.telemetry import TriadRecord

BLOCK_S = 0.5
LEAST_REST_S = 2.0  # shorter, and a vehicle that starts at once may pass
_GRAVITY_MPS2 = 9.8
_GRAVITY_SHARE = 0.25  # by which an accelerometer may read another size: a weak one is to be found, not to be missed
_SCATTER = 3.0  # times that of the first blocks


@dataclass(frozen=True)
class RestReadings:
    """Mean and standard deviation (3,) of a triad's whole samples in a span, sensor axes, and how many there are."""

    mean: FloatArray
    sd: FloatArray
    count: int

    @property
    def noise_sd(self) -> float:
        """White noise of a sample, all axes alike."""
        return float(np.sqrt(np.mean(self.sd**2)))


def readings(record: TriadRecord, span_s: tuple[float, float]) -> RestReadings:
    """What a triad reads from one time to another."""
    inside = (record.time_s >= span_s[0]) & (record.time_s <= span_s[1])
    samples = record.measured_sensor[inside]
    samples = samples[np.isfinite(samples).all(axis=1)]
    if len(samples) < 2:
        return RestReadings(np.full(3, np.nan), np.full(3, np.nan), len(samples))
    return RestReadings(samples.mean(axis=0), samples.std(axis=0, ddof=1), len(samples))


def find_rest(force: TriadRecord, rate: TriadRecord) -> tuple[float, float] | None:
    """Span in which the data begin at rest, a block less at its end; None without one of `LEAST_REST_S`."""
    start_s = max(force.time_s[0], rate.time_s[0])
    end_s = min(force.time_s[-1], rate.time_s[-1])
    still: list[tuple[RestReadings, RestReadings]] = []
    at = start_s
    while at + BLOCK_S <= end_s:
        block = readings(force, (at, at + BLOCK_S)), readings(rate, (at, at + BLOCK_S))
        if not _is_still(block, still, (force, rate)):
            break
        still.append(block)
        at += BLOCK_S
    length = BLOCK_S * (len(still) - (at + BLOCK_S <= end_s))
    return (float(start_s), float(start_s + length)) if length >= LEAST_REST_S else None


def _is_still(
    block: tuple[RestReadings, RestReadings],
    before: list[tuple[RestReadings, RestReadings]],
    records: tuple[TriadRecord, TriadRecord],
) -> bool:
    size = float(np.linalg.norm(block[0].mean))
    if not abs(size - _GRAVITY_MPS2) < _GRAVITY_SHARE * _GRAVITY_MPS2:
        return False
    for k, record in enumerate(records):
        first = [b[k] for b in before[:3]] or [block[k]]
        scatter = np.median([b.sd for b in first], axis=0) + record.spec.resolution + 1e-9
        mean = np.median([b.mean for b in first], axis=0)
        if (block[k].sd > _SCATTER * scatter).any() or (np.abs(block[k].mean - mean) > _SCATTER * scatter).any():
            return False
    return True

"""Thousands of flights: many side by side in vector registers, on every core, memory flat in their number.

Sixteen flights fly in the lanes of one kernel call (`synthetic_flight._kernels`), and kernel calls run in threads,
since compiled code holds no interpreter lock. Flight ``run`` is the same to the last bit wherever and beside whichever
other flights it flies: every lane goes through the same instructions.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from flightmodel.checks import ConfigError, FloatArray
from flightmodel.vehicle import Vehicle
from synthetic_flight.simulate import integrate_lanes
from synthetic_flight.step_size import check_step

# two to four vectors of a register each; more lanes outgrow the first-level cache
LANES = 16


@dataclass(frozen=True)
class Start:
    """How one flight of an ensemble differs from the others.

    Parameters
    ----------
    state : (20,) float
        At the start (`synthetic_flight.simulate.state_from_ecef`).
    parameters : (67,) float
        `packing.parameter_vector` of the dispersed vehicle. All flights share one coefficient table; the last four
        parameters scale C_A, C_N, C_m and shift C_mq.
    atmosphere : (rows, 6) float
        `packing.atmosphere_table` of the flight's own day.
    """

    state: FloatArray
    parameters: FloatArray
    atmosphere: FloatArray


@dataclass(frozen=True)
class Flown:
    """One flight of an ensemble: its records; fewer than asked for where the joint diverged, which ``diverged`` says.

    ``states`` ``(n, 20)`` and ``aux`` ``(n, 18)`` as `synthetic_flight.simulate.integrate` gives them.
    """

    run: int
    states: FloatArray
    aux: FloatArray
    diverged: bool


@dataclass(frozen=True)
class Schedule:
    """Steps and records that all flights of an ensemble share: ``records`` of them, ``per_record`` steps apart."""

    step_s: float
    per_record: int
    records: int
    lock_records: int = 0


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def fly_ensemble(
    vehicle: Vehicle,
    start_of: Callable[[int], Start],
    runs: Iterable[int],
    schedule: Schedule,
    workers: int | None = None,
) -> Iterator[Flown]:
    """Fly one flight a run number, in order.

    Parameters
    ----------
    vehicle : Vehicle
        Gives the coefficient table.
    start_of : callable
        From run number to how that flight starts; called in this thread, in order.
    runs : iterable of int
    schedule : Schedule
    workers : int, optional
        Threads; every core by default. No more than two blocks a worker are in memory at a time.

    Yields
    ------
    Flown
    """
    workers = available_cores() if workers is None else workers
    if workers < 1 or schedule.records < 1 or schedule.per_record < 1 or not schedule.step_s > 0.0:
        raise ConfigError(f"fly_ensemble: workers, steps and records must be positive; got {workers}, {schedule}")
    check_step(vehicle, schedule.step_s)
    remaining = iter(runs)
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[tuple[list[int], Future[list[Flown]]]] = deque()
        while True:
            while len(waiting) < workers + 1 and (block := list(islice(remaining, LANES))):
                starts = [start_of(run) for run in block]
                waiting.append((block, pool.submit(fly_block, vehicle, block, starts, schedule)))
            if not waiting:
                return
            yield from waiting.popleft()[1].result()


def fly_block(vehicle: Vehicle, runs: list[int], starts: list[Start], schedule: Schedule) -> list[Flown]:
    """Fly at most `LANES` flights side by side, in this thread; see `fly_ensemble`."""
    padded = starts + [starts[-1]] * (LANES - len(starts))
    shared = all(s.atmosphere is starts[0].atmosphere for s in starts)
    lanes = integrate_lanes(
        vehicle,
        starts[0].atmosphere if shared else np.stack([s.atmosphere for s in padded]),
        np.stack([s.state for s in padded]),
        np.stack([s.parameters for s in padded]),
        schedule.step_s,
        schedule.per_record,
        schedule.records,
        schedule.lock_records,
    )
    return [Flown(run, *lane) for run, lane in zip(runs, lanes, strict=False)]


def fly_legs(vehicle: Vehicle, runs: list[int], starts: list[Start], legs: list[Schedule]) -> list[Flown]:
    """Fly at most `LANES` flights through legs that follow each other; the records of the last are kept.

    A flight that diverges in an earlier leg has no record.
    """
    flown: list[Flown] = []
    for leg in legs:
        if flown:
            ends = [f.states[-1] if len(f.states) and not f.diverged else np.full(len(s.state), np.nan)
                    for f, s in zip(flown, starts, strict=True)]  # fmt: skip
            starts = [replace(s, state=end) for s, end in zip(starts, ends, strict=True)]
        flown = fly_block(vehicle, runs, starts, leg)
    return flown

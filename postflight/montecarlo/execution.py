"""How is a study flown: by which processes, and how is it interrupted, resumed, extended and stopped?

Chunks are flown in this process, in processes of this machine, or by the workers of a Dask scheduler. All three call
the same function with the same runs, and a flight is the same to the last bit in any company, so its numbers do not
depend on where it was flown. Chunks come back in any order.

A folder holds one study: ``study.json`` the settings that determine the numbers and how many flights are wanted,
``chunks/`` the flights. Files are whole or absent, so that a run may be killed at any time and the same command
resumes it.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from flightmodel.checks import ConfigError, GateError, Progress
from flightmodel.files import file_bytes, write_file
from postflight.beside import worker_pool
from postflight.montecarlo.bands import (
    Chunk,
    chunk_from_rows,
    chunk_path,
    is_narrow,
    read_chunk,
    remove_partial,
    write_chunk,
)
from postflight.montecarlo.study import Stop, Study, read_study, run_trials, whole_trial
from synthetic_flight.ensemble import fly_runs

Job = tuple[int, Sequence[int]]
Done = tuple[int, Chunk]
AHEAD = 2  # chunks queued a worker: none waits, and results do not pile up
CONNECT_S = 20


def fly_chunk(study: Study, job: Job) -> Done:
    """Fly the runs of one job; a flight that fails is a row with its reason."""
    number, runs = job
    if study.spec.mode == "whole":
        rows = run_trials(partial(whole_trial, study.plan, study.spec.seed), study.plan, runs)
    else:
        rows = fly_runs(study.plan, runs, study.draws_of)
    return number, chunk_from_rows(rows, study.plan.scalars)


def fly_jobs(study: Study, jobs: list[Job], workers: int, scheduler: str | None) -> Iterator[Done]:
    """Fly jobs here with so many workers, or on the Dask cluster of ``scheduler``; yield each as it is done."""
    if scheduler is not None:
        yield from _on_dask(study, jobs, scheduler)
    elif workers == 1 or len(jobs) < 2:
        for job in jobs:
            yield fly_chunk(study, job)
    else:
        yield from _in_processes(study, jobs, min(workers, len(jobs)))


def _in_processes(study: Study, jobs: list[Job], workers: int) -> Iterator[Done]:
    ahead = iter(jobs)
    # the study goes with every job: given at the start, it would fill the pipe and let workers start one by one
    try:
        with worker_pool(workers) as pool:
            waiting: set[Future[Done]] = {pool.submit(fly_chunk, study, job) for job in islice(ahead, AHEAD * workers)}
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
                    waiting |= {pool.submit(fly_chunk, study, job) for job in islice(ahead, 1)}
    except BrokenProcessPool:
        raise GateError(
            "a worker process was killed (out of memory?); every finished chunk is kept: the same command resumes from "
            "there, with fewer --workers if memory is short",
            code="worker-killed",
        ) from None


def is_open(address: str) -> bool:
    """Whether a scheduler's address is neither of this machine alone nor encrypted."""
    url = urlsplit(address if "://" in address else f"tcp://{address}")
    return url.scheme not in ("tls", "wss") and url.hostname not in ("localhost", "127.0.0.1", "::1")


def _on_dask(study: Study, jobs: list[Job], address: str) -> Iterator[Done]:
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise ConfigError("--scheduler needs Dask: pip install 'postflight[cluster]'", code="package-missing") from None
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as fault:  # TypeError: tls without certificates
        message = f"--scheduler {address}: no scheduler answers there: {fault}"
        raise ConfigError(message, code="scheduler-unreachable") from None
    with client, client.as_current():
        ahead = iter(jobs)

        def submit(count: int) -> list[Any]:
            # the scheduler flies a chunk again whose worker is lost; the study goes with every chunk, since data that
            # were sent once would be lost with the last worker that holds them
            return [client.submit(fly_chunk, study, job, pure=False) for job in islice(ahead, count)]

        threads = max(1, sum(client.nthreads().values()))
        going = as_completed(submit(AHEAD * threads))
        for future in going:
            yield future.result()
            for one in submit(1):
                going.add(one)


MOST_DIFFERENCES = 12


@dataclass(frozen=True)
class Wanted:
    """Requested size and execution of a study: number of flights, stop rule, workers or scheduler."""

    flights: int
    workers: int = 1
    scheduler: str | None = None
    stop: Stop | None = None


def begin(study: Study, folder: Path, flights: int) -> None:
    """Make the folder, or check that it holds this study; note how many flights are wanted.

    Raises
    ------
    ConfigError
        Where the folder holds a study with other settings (which, and both values), or more flights, or other files.
    """
    path = folder / "study.json"
    settings = json.loads(json.dumps(study.settings()))
    if path.exists():
        held = read_settings(folder)
        _check_same(folder, held["settings"], settings)
        if held["version"] != version("postflight"):
            message = (
                f"{folder}: flown by version {held['version']}, this is {version('postflight')}; name a new folder"
            )
            raise ConfigError(message, code="file-exists")
        if flights < held["flights"]:
            message = f"{folder}: holds a study of {held['flights']} flights; at least as many are wanted"
            raise ConfigError(message, code="file-exists")
    elif folder.exists() and any(folder.iterdir()):
        message = f"{folder}: is not empty and holds no study.json; name a new folder"
        raise ConfigError(message, code="file-exists")
    (folder / "chunks").mkdir(parents=True, exist_ok=True)
    remove_partial(folder)
    _note(folder, settings, flights, study.named)


def _note(folder: Path, settings: dict[str, Any], flights: int, source: str) -> None:
    facts = {"version": version("postflight"), "flights": flights, "source": source, "settings": settings}
    write_file(folder / "study.json", json.dumps(facts, indent=1) + "\n")


def read_settings(folder: Path) -> dict[str, Any]:
    """Return ``study.json``; `GateError` where the folder holds no study."""
    path = folder / "study.json"
    try:
        held = json.loads(file_bytes(path))
        kinds = (("settings", dict), ("flights", int), ("source", str))
        if not all(isinstance(held[key], kind) for key, kind in kinds):
            raise ValueError("not a study")
    except FileNotFoundError:
        message = f"{folder}: no study.json; begin with `postflight montecarlo run`"
        raise GateError(message, code="file-missing") from None
    except (ValueError, KeyError, TypeError) as fault:
        raise GateError(f"{path}: damaged: {fault}", code="study-damaged") from None
    found: dict[str, Any] = held
    return found


def study_of(folder: Path) -> tuple[Study, int]:
    """Return the study of a folder, read again from its dispersions file, and how many flights it wants.

    Raises
    ------
    ConfigError
        Where the file is gone, or has other settings now.
    """
    held = read_settings(folder)
    study = read_study(held["source"])
    _check_same(folder, held["settings"], json.loads(json.dumps(study.settings())))
    return study, held["flights"]


def _check_same(folder: Path, held: dict[str, Any], asked: dict[str, Any]) -> None:
    differ = [k for k in dict.fromkeys((*held, *asked)) if held.get(k) != asked.get(k)]
    if not differ:
        return
    lines = [
        f"{folder}: holds flights of other settings: '{k}' is {held.get(k)!r} there, {asked.get(k)!r} now"
        for k in differ[:MOST_DIFFERENCES]
    ]
    more = [f"{folder}: {len(differ)} settings differ in all"] * (len(differ) > MOST_DIFFERENCES)
    remedy = f"{folder}: name a new folder, or restore the settings"
    raise ConfigError([*lines, *more, remedy], code="file-exists")


class _Enough:
    """Stop rule, evaluated on complete chunks in order of run number."""

    def __init__(self, study: Study, stop: Stop | None, flights: int) -> None:
        self.study, self.stop, self.flights = study, stop, flights
        self.column = -1 if stop is None else study.plan.scalars.index(stop.output)
        self.ahead: dict[int, Chunk] = {}
        self.values: list[float] = []
        self.next = 0
        self.reached: int | None = None

    def add(self, number: int, chunk: Chunk) -> bool:
        """Take a chunk; true once there are enough flights."""
        if self.stop is None or self.reached is not None:
            return self.reached is not None
        self.ahead[number] = chunk
        while self.next in self.ahead and self.reached is None:
            chunk = self.ahead.pop(self.next)
            self.values += [v for v in chunk.scalars[:, self.column].tolist() if np.isfinite(v)]
            self.next += 1
            stop = self.stop
            if is_narrow(np.array(self.values), stop.percentile, stop.confidence, stop.width):
                self.reached = min(self.next * self.study.spec.chunk, self.flights)
        return self.reached is not None


def run(study: Study, folder: Path, wanted: Wanted, report: Progress) -> int:
    """Fly the missing flights; return the study's number of flights: as wanted, or fewer if the stop rule is met.

    The stop rule takes flights in the order of their numbers, so it stops at the same flight on any number of workers;
    flights beyond it are removed.
    """
    flights = wanted.flights
    begin(study, folder, flights)
    total = study.chunks(flights)
    enough = _Enough(study, wanted.stop, flights)
    jobs: list[Job] = []
    there = 0
    for number in range(total):
        runs = study.runs_of(number, flights)
        chunk = read_chunk(folder, number, runs, histories=False)
        if chunk is None:
            jobs.append((number, runs))
        else:
            there += 1
            if enough.add(number, chunk):
                break
    report(there / total, f"{there} of {total} chunks are there")
    if enough.reached is None and jobs:
        for number, chunk in fly_jobs(study, jobs, wanted.workers, wanted.scheduler):
            write_chunk(folder, number, chunk)
            there += 1
            report(there / total, f"{min(there * study.spec.chunk, flights)} of {flights} flights")
            if enough.add(number, chunk):
                break
    if enough.reached is not None and enough.reached < flights:
        flights = enough.reached
        for number in range(study.chunks(flights), total):
            chunk_path(folder, number).unlink(missing_ok=True)
        _note(folder, read_settings(folder)["settings"], flights, study.named)
    return flights


@dataclass(frozen=True)
class Status:
    """Contents of a folder: chunks and flights of those wanted, reasons of failures with counts, diverged flights."""

    chunks: int
    chunks_wanted: int
    flights: int
    flights_wanted: int
    failed: Counter[str]
    diverged: int


def status(folder: Path) -> Status:
    """Contents of a folder, without its dispersions file."""
    held = read_settings(folder)
    size, wanted = held["settings"]["chunk"], held["flights"]
    count = flights = diverged = 0
    failed: Counter[str] = Counter()
    total = -(-wanted // size)
    for number in range(total):
        runs = range(number * size, min((number + 1) * size, wanted))
        chunk = read_chunk(folder, number, runs, histories=False)
        if chunk is not None:
            count, flights = count + 1, flights + len(runs)
            failed.update(reason for reason in chunk.reasons if reason)
            diverged += int(np.isfinite(chunk.diverged_s).sum())
    return Status(count, total, flights, wanted, failed, diverged)


def retry_failed(study: Study, folder: Path, wanted: Wanted, report: Progress) -> tuple[int, int]:
    """Fly failed runs again; return how many there were and how many still fail.

    A flight's numbers depend on its run alone: one that failed on bad luck of the machine may fly now, one that was
    drawn outside what can fly fails again.
    """
    begin(study, folder, wanted.flights)
    jobs: list[Job] = []
    before = {}
    for number in range(study.chunks(wanted.flights)):
        chunk = read_chunk(folder, number, study.runs_of(number, wanted.flights))
        if chunk is not None and not chunk.flown.all():
            jobs.append((number, chunk.runs[~chunk.flown].tolist()))
            before[number] = chunk
    tried, still = sum(len(runs) for _, runs in jobs), 0
    for k, (number, again) in enumerate(fly_jobs(study, jobs, wanted.workers, wanted.scheduler)):
        still += int((~again.flown).sum())
        write_chunk(folder, number, _replaced(before[number], again))
        report((k + 1) / len(jobs), "flying failed flights again")
    return tried, still


def _replaced(chunk: Chunk, again: Chunk) -> Chunk:
    """Return a chunk with the rows of ``again`` in place of its own."""
    at = np.searchsorted(chunk.runs, again.runs)
    reasons, diverged = list(chunk.reasons), chunk.diverged_s.copy()
    scalars, histories = chunk.scalars.copy(), chunk.histories.copy()
    for k, row in enumerate(at.tolist()):
        reasons[row] = again.reasons[k]
    diverged[at], scalars[at], histories[at] = again.diverged_s, again.scalars, again.histories
    return Chunk(chunk.runs, tuple(reasons), diverged, scalars, histories)

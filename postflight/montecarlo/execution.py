"""Who flies the chunks: this process, processes of this machine, or the workers of a Dask scheduler.

All three call the same function with the same runs, and a flight is the same to the last bit in any company, so where
it was flown cannot be told from its numbers. Chunks come back as they are done, in any order.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing.connection import wait as wait_for
from typing import Any

from flightmodel.checks import ConfigError, GateError
from postflight.montecarlo import whole
from postflight.montecarlo.chunks import Chunk, chunk_from_rows
from postflight.montecarlo.study import Study
from synthetic_flight.dispersed_ensemble import fly_runs

Job = tuple[int, list[int]]
Done = tuple[int, Chunk]
AHEAD = 2  # chunks a worker has or waits for: enough that none waits, few enough that results do not pile up
CONNECT_S = 20
END_S = 5.0  # within which an ended worker process is gone
THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def fly_chunk(study: Study, job: Job) -> Done:
    """Fly the runs of one job; a flight that fails is a row with its reason."""
    number, runs = job
    if study.spec.mode == "whole":
        rows = whole.fly_whole(study.plan, study.spec.seed, runs)
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


def _begin() -> None:
    """Prepare a worker process: Ctrl-C is its parent's to handle, and it does not outlive its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    sentinel = parent.sentinel

    def follow() -> None:
        wait_for([sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that start now keep their linear algebra to one thread: there are as many of them as cores."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _in_processes(study: Study, jobs: list[Job], workers: int) -> Iterator[Done]:
    ahead = iter(jobs)
    # spawned, not forked: a fork copies locks that threads of this process may hold
    context = multiprocessing.get_context("spawn")
    # the study goes with every job: given at the start, it would fill the pipe and let workers start one by one
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin)
    begun = multiprocessing.active_children()
    try:
        with _one_thread_each():
            waiting: set[Future[Done]] = {pool.submit(fly_chunk, study, job) for job in islice(ahead, AHEAD * workers)}
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
                waiting |= {pool.submit(fly_chunk, study, job) for job in islice(ahead, 1)}
    except BrokenProcessPool:
        raise GateError(
            "a worker process was ended from outside (out of memory?); every finished chunk is kept: the same command "
            "goes on from there, with fewer --workers if memory is short"
        ) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        ours = [process for process in multiprocessing.active_children() if process not in begun]
        for process in ours:
            process.terminate()
        for process in ours:
            process.join(END_S)


def _on_dask(study: Study, jobs: list[Job], address: str) -> Iterator[Done]:
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise ConfigError("--scheduler needs Dask: pip install 'postflight[cluster]'") from None
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as fault:
        raise ConfigError(f"--scheduler {address}: no scheduler answers there: {fault}") from None
    with client, client.as_current():
        ahead = iter(jobs)

        def submit(count: int) -> list[Any]:
            # a chunk whose worker is lost is flown again elsewhere by the scheduler; the study goes with every one, as
            # data that were sent once would be lost with the last worker that holds them
            return [client.submit(fly_chunk, study, job, pure=False) for job in islice(ahead, count)]

        threads = max(1, sum(client.nthreads().values()))
        going = as_completed(submit(AHEAD * threads))
        for future in going:
            yield future.result()
            for one in submit(1):
                going.add(one)

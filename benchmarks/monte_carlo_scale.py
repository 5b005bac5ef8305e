"""A Monte Carlo study at scale: two worker processes against one, what scheduling costs, memory of many flights.

Run: ``python benchmarks/monte_carlo_scale.py [FLIGHTS]`` (512) for throughput and overhead in one run, in turn;
``python benchmarks/monte_carlo_scale.py memory [FLIGHTS]`` (10000) for the peak memory of a study with bands, in one
process and in two. Flights are those of the shipped ``irve2_reference`` dispersions. Each case is flown with few
flights and with FLIGHTS more; what is printed is the difference, so that starting processes and importing drop out.
Where others use the machine, compare processor times: two workers on two free cores take half of one worker's time.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from postflight.montecarlo import execution, running
from postflight.montecarlo.merge import merge, write_merged
from postflight.montecarlo.running import Wanted
from postflight.montecarlo.study import read_study

DISPERSIONS = "irve2_reference"


def jobs_of(study, flights):
    return [(k, study.runs_of(k, flights)) for k in range(study.chunks(flights))]


def cost(stream_of, study, flights):
    """Wall seconds, processor seconds of ended children and of this process, for so many flights."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall, own = time.perf_counter(), time.process_time()
    took, count = stream_of(study, jobs_of(study, flights))
    assert count == flights
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    children = now.ru_utime + now.ru_stime - ended.ru_utime - ended.ru_stime
    return np.array([took or time.perf_counter() - wall, children, time.process_time() - own])


def in_processes(workers):
    def flown(study, jobs):
        return None, sum(len(chunk.runs) for _, chunk in execution._in_processes(study, jobs, workers))

    return flown


def on_dask(workers):
    from distributed import LocalCluster

    def flown(study, jobs):
        with LocalCluster(workers, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
            begun = time.perf_counter()
            count = sum(len(c.runs) for _, c in execution._on_dask(study, jobs, cluster.scheduler_address))
            took = time.perf_counter() - begun
        return took, count

    return flown


def scaling(flights):
    study = read_study(DISPERSIONS)
    execution.fly_chunk(study, (0, [0]))  # compiled
    print(f"{flights} flights a case, chunks of {study.spec.chunk}; load before {os.getloadavg()[0]:.1f}")
    cases = {
        "one process": (1, in_processes(1)),
        "two processes": (2, in_processes(2)),
        "Dask, one worker": (1, on_dask(1)),
        "Dask, two workers": (2, on_dask(2)),
    }
    each = {}
    for name, (workers, stream_of) in cases.items():
        few = workers * study.spec.chunk
        wall, children, own = (cost(stream_of, study, few + flights) - cost(stream_of, study, few)) / flights
        each[name] = wall, children, own
        print(
            f"  {name:20s}{1 / wall:7.1f} flights/s; processor a flight: workers {1e3 * children:6.2f} ms, driver (and "
            f"scheduler) {1e3 * own:.3f} ms",
            flush=True,
        )
    one, two = each["one process"], each["two processes"]
    print(f"two processes over one: {one[0] / two[0]:.2f} by the clock, {2 * one[1] / two[1]:.2f} by processor time")
    for name, base in (("one", one), ("two", two)):
        dask = each[f"Dask, {name} worker{'s' * (name == 'two')}"]
        print(
            f"{name} worker's driver: {100 * base[2] / base[1]:.1f} % of the flights' processor time; with Dask "
            f"{100 * dask[2] / base[1]:.1f} %, and its workers take {100 * (dask[1] / base[1] - 1):+.1f} %"
        )


def memory_child(flights, workers):
    study = read_study(DISPERSIONS)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "study"
        begun = time.perf_counter()
        count = running.run(study, folder, Wanted(flights, workers), lambda *_: None)
        flown = time.perf_counter() - begun
        write_merged(folder, merge(study, folder, count))
        merged = time.perf_counter() - begun - flown
        size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    own = resource.getrusage(resource.RUSAGE_SELF)
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    facts = {
        "own_mib": own.ru_maxrss / 1024,
        "worker_mib": child.ru_maxrss / 1024 if workers > 1 else 0.0,
        "flown_s": flown,
        "merged_s": merged,
        "disk_mb": size / 1e6,
        "cpu_s": own.ru_utime + own.ru_stime + child.ru_utime + child.ru_stime,
    }
    print(json.dumps(facts))


def memory(flights):
    for workers in (1, 2):
        line = [sys.executable, __file__, "child", str(flights), str(workers)]
        out = subprocess.run(line, capture_output=True, text=True, check=True).stdout
        f = json.loads(out.strip().splitlines()[-1])
        total = f["own_mib"] + workers * f["worker_mib"]
        print(
            f"{flights} flights, {workers} worker(s): {total:.0f} MiB in all (driver {f['own_mib']:.0f}, each worker "
            f"{f['worker_mib']:.0f}); flown in {f['flown_s']:.0f} s, merged in {f['merged_s']:.1f} s, "
            f"{f['cpu_s']:.0f} s of processor, {f['disk_mb']:.0f} MB on disk",
            flush=True,
        )


def main():
    words = sys.argv[1:]
    if words[:1] == ["child"]:
        memory_child(int(words[1]), int(words[2]))
    elif words[:1] == ["memory"]:
        memory(int(words[1]) if len(words) > 1 else 10_000)
    else:
        scaling(int(words[0]) if words else 512)


if __name__ == "__main__":
    main()

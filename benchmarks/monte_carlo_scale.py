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

from postflight.montecarlo import execution
from postflight.montecarlo.bands import merge, write_merged
from postflight.montecarlo.execution import Wanted
from postflight.montecarlo.study import read_study

DISPERSIONS = "irve2_reference"


def jobs_of(study, flights):
    return [(k, study.runs_of(k, flights)) for k in range(study.chunks(flights))]


def cost(stream_of, study, flights):
    """Wall seconds, processor seconds of ended children and of this process, for so many flights."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall, own = time.perf_counter(), time.process_time()
    assert stream_of(study, jobs_of(study, flights)) == flights
    wall, own = time.perf_counter() - wall, time.process_time() - own
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    return np.array([wall, now.ru_utime + now.ru_stime - ended.ru_utime - ended.ru_stime, own])


def in_processes(workers):
    def flown(study, jobs):
        return sum(len(chunk.runs) for _, chunk in execution._in_processes(study, jobs, workers))

    return flown


def timed_chunk(study, job):
    """A chunk's flights and the processor seconds of the thread that flew them."""
    begun = time.thread_time()
    _, chunk = execution.fly_chunk(study, job)
    return len(chunk.runs), time.thread_time() - begun


def dask_overhead(study, flights, workers):
    """Processor time a flight inside flights, elsewhere in the workers, and in scheduler and driver, ms."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(workers, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        jobs = jobs_of(study, flights)
        # every worker has imported and loaded its kernels
        client.gather([client.submit(timed_chunk, study, (0, [0]), workers=[w], pure=False) for w in client.nthreads()])
        before, own = sum(client.run(time.process_time).values()), time.process_time()
        found = client.gather([client.submit(timed_chunk, study, job, pure=False) for job in jobs])
        own = time.process_time() - own
        spent = sum(client.run(time.process_time).values()) - before
    inside = sum(seconds for _, seconds in found)
    assert sum(count for count, _ in found) == flights
    return 1e3 * np.array([inside, spent - inside, own]) / flights


def scaling(flights):
    study = read_study(DISPERSIONS)
    execution.fly_chunk(study, (0, [0]))  # compiled
    print(f"{flights} flights a case, chunks of {study.spec.chunk}; load before {os.getloadavg()[0]:.1f}")
    each = []
    for workers in (1, 2):
        few = workers * study.spec.chunk
        stream = in_processes(workers)
        wall, children, own = (cost(stream, study, few + flights) - cost(stream, study, few)) / flights
        each.append((wall, children))
        print(
            f"  {workers} process(es): {1 / wall:.1f} flights/s; processor a flight {1e3 * children:.2f} ms, driver "
            f"{1e3 * own:.3f} ms ({100 * own / children:.1f} %)",
            flush=True,
        )
    (wall, children), (wall_two, children_two) = each
    print(f"two processes over one: {wall / wall_two:.2f} by the clock, {2 * children / children_two:.2f} by processor")
    for workers in (1, 2):
        inside, beside, own = dask_overhead(study, flights, workers)
        print(
            f"  Dask, {workers} worker(s): {inside:.2f} ms of processor a flight, beside it {beside:.3f} ms, "
            f"scheduler and driver {own:.3f} ms: {100 * (beside + own) / inside:.1f} % in all (below 10 wanted)",
            flush=True,
        )


def memory_child(flights, workers):
    study = read_study(DISPERSIONS)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "study"
        begun = time.perf_counter()
        count = execution.run(study, folder, Wanted(flights, workers), lambda *_: None)
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

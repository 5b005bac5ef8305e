"""A Monte Carlo study at scale: two worker processes against one, what scheduling costs, memory of many flights.

Run: ``python benchmarks/monte_carlo_scale.py [FLIGHTS]`` (512) for throughput and overhead in one run, in turn;
``python benchmarks/monte_carlo_scale.py memory [FLIGHTS]`` (10000) for the peak memory of a study with bands, in one
process and in two. Flights are those of the shipped ``irve2_reference`` dispersions. Wall time counts from the first
chunk that comes back, once every worker has come up; processor time is the workers', as the system counts it. Where
others use the machine, compare processor times: two workers on two free cores take half of theirs.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from postflight.montecarlo import execution, running
from postflight.montecarlo.merge import merge, write_merged
from postflight.montecarlo.running import Wanted
from postflight.montecarlo.study import read_study

DISPERSIONS = "irve2_reference"
ROUNDS = 2


def jobs_of(study, flights):
    return [(k, study.runs_of(k, flights)) for k in range(study.chunks(flights))]


def cpu_s():
    """Processor seconds of this process and of its ended children, apart."""
    own, ended = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime, ended.ru_utime + ended.ru_stime


def child_cpu_s():
    """Processor seconds of all live children and theirs, from /proc."""
    parents, times = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(fields[1])
            times[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def below(pid):
        return pid == os.getpid() or (pid in parents and below(parents[pid]))

    return sum(t for pid, t in times.items() if pid != os.getpid() and below(pid))


def paced(stream, skip):
    """Flights, wall, workers' and own processor seconds from the ``skip``-th chunk on."""
    count, begun = 0, None
    for k, (_, chunk) in enumerate(stream):
        now = time.perf_counter(), child_cpu_s(), time.process_time()
        if begun is not None:
            count += len(chunk.runs)
            ended = now
        elif k + 1 == skip:
            begun = now
    return (count, *(b - a for a, b in zip(begun, ended, strict=True)))


def report(name, found):
    flights, wall, workers, own = found
    rate, each = flights / wall, 1e3 * workers / flights
    print(
        f"  {name:34s}{rate:7.1f} flights/s, {each:6.2f} ms of processor a flight, driver {1e3 * own / flights:.3f} ms"
    )
    return rate, each, 1e3 * own / flights


def scaling(flights):
    from distributed import LocalCluster

    study = read_study(DISPERSIONS)
    jobs = jobs_of(study, flights)
    execution.fly_chunk(study, (0, [0]))  # compiled
    print(f"{flights} flights a case, chunks of {study.spec.chunk}; load before {os.getloadavg()[0]:.1f}")
    kept = {}
    for _ in range(ROUNDS):
        found = {
            "one process": paced(execution._in_processes(study, jobs, 1), 2),
            "two processes": paced(execution._in_processes(study, jobs, 2), 4),
        }
        for workers in (1, 2):
            with LocalCluster(workers, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
                stream = execution._on_dask(study, jobs, cluster.scheduler_address)
                found[f"Dask, {workers} worker{'s' * (workers > 1)}"] = paced(stream, 2 * workers)
        for name, one in found.items():
            if name not in kept or one[1] / one[0] < kept[name][1] / kept[name][0]:
                kept[name] = one
    rows = {name: report(name, one) for name, one in kept.items()}
    (one, one_cpu, _), (two, two_cpu, driver) = rows["one process"], rows["two processes"]
    print(f"two processes over one: {two / one:.2f} by the clock, {2 * one_cpu / two_cpu:.2f} by processor time")
    print(f"own driver: {100 * driver / two_cpu:.1f} % of the flights' processor time")
    for name in ("Dask, 1 worker", "Dask, 2 workers"):
        base = one_cpu if "1" in name else two_cpu
        _, each, driver = rows[name]
        print(
            f"{name}: workers {100 * (each / base - 1):+.1f} %, scheduler and driver {100 * driver / each:.1f} % (< 10)"
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

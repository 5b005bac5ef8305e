"""What grows with the size of the problem? Studies on a cluster with a killed worker, long inertial data, long films.

Run: ``python benchmarks/growth.py study [FLIGHTS ...]``, ``merge [FLIGHTS ...]``, ``imu [SECONDS ...]``,
``film FLIGHT [FRAMES ...]``.

``study``: short dispersed flights on the Dask workers of this machine, of which one is killed after a third of them;
its files against those of plain processes, byte by byte. ``merge``: the tables of invented flights, none flown.
``imu``: reading and reconstruction of a coast of up to an hour with inertial data at 1 kHz, cut to each length.
``film``: `postflight deflection --method camera` of FLIGHT (a folder of `postflight simulate`), every frame of whose
film is shown so many times in a row. Of each size: seconds by the clock and of the processor, peak memory, and the
cost of a unit over that at the smallest size.
"""

import argparse
import hashlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from tests.postflight.short_flights import SEEN

ROOT = Path(__file__).parents[1]
SHIPPED = "irve2_reference"
# some milliseconds a flight: four seconds of the entry, few factors, one atmosphere
DISPERSIONS = f"""
scenario = "short.toml"
seed = 7
chunk = 256
{SEEN}
[mass]
offset_y_m = {{ normal = 0.001 }}

[joint]
stiffness = {{ lognormal = 0.1 }}

[atmosphere]
day = false
"""


def spent(command, **options):
    """Seconds by the clock and of the processor, and peak memory, MiB, of a process."""
    begun = time.perf_counter()
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL, **options)
    _, code, used = os.wait4(process.pid, 0)
    if code:
        raise SystemExit(f"{' '.join(map(str, command))}: ended with {os.waitstatus_to_exitcode(code)}")
    return time.perf_counter() - begun, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def print_growth(unit, sizes, rows):
    """Print a row a size: clock, processor, memory, and the processor's cost of a unit over the smallest size's."""
    print(f"{unit:>10s}{'clock s':>10s}{'CPU s':>10s}{'peak MiB':>10s}{'CPU ms each':>13s}{'over first':>12s}")
    first = None
    for size, (clock, cpu, peak) in zip(sizes, rows, strict=True):
        each = 1e3 * cpu / size
        first = first or each
        print(f"{size:10d}{clock:10.1f}{cpu:10.1f}{peak:10.0f}{each:13.3f}{each / first:12.2f}", flush=True)


def digest(folder):
    """Hash of every file of a study but its pictures."""
    found = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".png"):
        found.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return found.hexdigest()


def fly_study(path, folder, flights, workers, scheduler):
    """In its own process: fly and merge; print the seconds of both."""
    from postflight.montecarlo import execution
    from postflight.montecarlo.bands import merge, write_merged
    from postflight.montecarlo.execution import Wanted
    from postflight.montecarlo.study import read_study

    study, begun = read_study(path), time.perf_counter()
    count = execution.run(study, Path(folder), Wanted(flights, workers, scheduler), lambda *_: None)
    flown, at_flown = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    write_merged(Path(folder), merge(study, Path(folder), count))
    print(json.dumps({"flown_s": flown, "merged_s": time.perf_counter() - begun - flown, "flown_mib": at_flown}))


def peak_mib():
    """Peak memory and processor seconds of the process that is asked."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_maxrss / 1024, used.ru_utime + used.ru_stime


def kill_one(folder, chunks, cluster_pids):
    """Kill one of the benchmark's own workers as soon as so many chunks are there."""
    while len(list(folder.glob("chunks/*.npz"))) < chunks:
        time.sleep(0.05)
    os.kill(min(cluster_pids().values()), signal.SIGKILL)


def on_dask(path, folder, flights, workers):
    """Fly a study on so many local Dask workers, one of which is killed; what it took, and the workers' peak, MiB."""
    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.worker.profile.enabled": False})  # as docs/monte-carlo.md begins workers
    with (
        LocalCluster(workers, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        third = max(1, flights // 3 // 256)
        killer = threading.Thread(target=kill_one, args=(folder, third, lambda: client.run(os.getpid)), daemon=True)
        killer.start()
        line = [sys.executable, __file__, "fly", path, folder, flights, workers, cluster.scheduler_address]
        with (folder.parent / "driver.json").open("w") as out:
            used = spent(list(map(str, line)), stdout=out)
        killer.join(60.0)
        if killer.is_alive():
            raise SystemExit("no worker was killed: the flights were too few")
        peaks = client.run(peak_mib)
    facts = json.loads((folder.parent / "driver.json").read_text())
    return used, facts, [peak for peak, _ in peaks.values()], [cpu for _, cpu in peaks.values()]


def study(sizes, workers, compared):
    """Fly studies of several sizes on Dask, one worker killed, and in plain processes; compare their files."""
    from tests.postflight.short_flights import write_short

    for flights in sizes:
        with tempfile.TemporaryDirectory() as temporary:
            root = Path(temporary)
            path = str(write_short(root, DISPERSIONS))
            (root / "dask").mkdir()
            begun = time.perf_counter()
            used, facts, peaks, cpus = on_dask(path, root / "dask" / "study", flights, workers)
            own = resource.getrusage(resource.RUSAGE_SELF)
            print(
                f"{flights} flights on {workers} Dask workers, one killed: {time.perf_counter() - begun:.0f} s by the "
                f"clock (flown {facts['flown_s']:.0f}, merged {facts['merged_s']:.1f}); of the processor: command "
                f"{used[1]:.0f} s, living workers {sum(cpus):.0f} s; peak memory, MiB: command "
                f"{facts['flown_mib']:.0f} flying, {used[2]:.0f} in all, workers at most {max(peaks):.0f}, scheduler "
                f"{own.ru_maxrss / 1024:.0f}",
                flush=True,
            )
            if compared:
                (root / "plain").mkdir()
                line = [sys.executable, __file__, "fly", path, root / "plain" / "study", flights, workers, "none"]
                plain = spent(list(map(str, line)), stdout=subprocess.DEVNULL)
                same = digest(root / "plain" / "study") == digest(root / "dask" / "study")
                words = "the same bytes" if same else "DIFFERENT"
                print(
                    f"  in {workers} processes: {plain[0]:.0f} s by the clock, {plain[1]:.0f} s of the processor, "
                    f"{1e3 * plain[1] / flights:.2f} ms a flight; files are {words}",
                    flush=True,
                )
                if not same:
                    raise SystemExit(1)


def invented_study(path, folder, flights):
    """Write the chunks of a study whose flights were never flown: random numbers, to merge."""
    from postflight.montecarlo.bands import Chunk, write_chunk
    from postflight.montecarlo.study import read_study

    found, rng = read_study(path), np.random.default_rng(0)
    points = len(found.plan.window.history_time_s())
    (folder / "chunks").mkdir(parents=True)
    for number in range(found.chunks(flights)):
        runs = np.array(found.runs_of(number, flights))
        n = len(runs)
        scalars = rng.standard_normal((n, len(found.plan.scalars)))
        histories = rng.standard_normal((n, len(found.plan.histories), points)).astype(np.float32)
        write_chunk(folder, number, Chunk(runs, ("",) * n, np.full(n, np.nan), scalars, histories))


def merge_invented(path, folder, flights):
    """In its own process: merge a study that is there."""
    from postflight.montecarlo.bands import merge, write_merged
    from postflight.montecarlo.study import read_study

    write_merged(Path(folder), merge(read_study(path), Path(folder), flights))


def merging(sizes):
    """Merge invented studies of several sizes, with the outputs of the shipped dispersions."""
    rows = []
    for flights in sizes:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "study"
            invented_study(SHIPPED, folder, flights)
            line = [sys.executable, __file__, "merge-one", SHIPPED, str(folder), str(flights)]
            rows.append(spent(line, stdout=subprocess.DEVNULL))
        print_growth("flights", sizes[: len(rows)], rows)


# a low orbit, followed by a receiver
COAST = {
    "start_s": 90.0, "inflated_s": 100.0, "telemetry_from_s": 100.0, "t_s": 100.0, "altitude_m": 350e3,
    "speed_mps": 7400.0, "flight_path_deg": 0.0,
}  # fmt: skip
RECEIVER = """
[gnss.gps]
rate_hz = 1.0
horizontal_sd_m = 5.0
vertical_sd_m = 8.0
speed_sd_mps = 0.1
vertical_speed_sd_mps = 0.2

"""


def imu(sizes, rate_hz):
    """Reconstruct a coast, cut to several lengths."""
    from flightmodel.vehicle import DATA

    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        text = (DATA / "scenarios" / "irve2_reference.toml").read_text()
        text = re.sub(r"(?ms)^\[(video|radars\.\w+)\].*?(?=^\[)", "", text) + RECEIVER
        for key, value in (COAST | {"stop_s": COAST["start_s"] + 10.0 + max(sizes)}).items():
            text = re.sub(rf"(?m)^{key} = \S+", f"{key} = {value}", text, count=1)
        (root / "coast.toml").write_text(re.sub(r"(?m)^rate_hz = 250\.0", f"rate_hz = {rate_hz}", text))
        whole = root / "whole"
        spent([sys.executable, "-m", "postflight", "simulate", root / "coast.toml", whole], stdout=subprocess.DEVNULL)
        shutil.rmtree(whole / "truth")
        rows = []
        for seconds in sizes:
            cut = root / "cut"
            shutil.copytree(whole, cut)
            for table in (cut / "telemetry").glob("*.csv"):
                shorten(table, COAST["telemetry_from_s"] + seconds)
            rows.append(spent([sys.executable, __file__, "reconstruct-one", str(cut)]))
            shutil.rmtree(cut)
            print_growth("seconds", sizes[: len(rows)], rows)


def reconstruct_one(folder):
    """In its own process: read a flight and find its trajectory once, whatever a check says; name those that fail."""
    from flightmodel.flightfolder import read_flight
    from recon.estimate import estimate
    from recon.settings import Settings

    solution = estimate(read_flight(Path(folder)), Settings())
    print(len(solution.imu_time_s), *(check.code for check in solution.consistency_checks if not check.passed))


def shorten(table, last_s):
    """Keep of a table of times what comes before one."""
    with table.open() as file:
        head = file.readline()
        if not head.startswith("t_s"):
            return
        kept = [head, *(line for line in file if float(line.split(",", 1)[0]) <= last_s)]
    table.write_text("".join(kept))


def film(flight, sizes):
    """Read films whose frames are shown several times in a row."""
    rows, shown = [], flight / "telemetry" / "frames.csv"
    frames = [line.split(",") for line in shown.read_text().splitlines()[1:]]
    times = np.array([float(t) for t, _ in frames])
    period = float(np.diff(times).min())
    for count in sizes:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "flight"
            shutil.copytree(flight, folder, ignore=shutil.ignore_patterns("runs", "truth"))
            repeated = -(-count // len(frames))
            lines = [
                f"{t + k * period / repeated:.6f},{name}"
                for t, (_, name) in zip(times, frames, strict=True)
                for k in range(repeated)
            ]
            text = "\n".join(["t_s,frame", *lines[:count]]) + "\n"
            (folder / "telemetry" / "frames.csv").write_text(text)
            line = [sys.executable, "-m", "postflight", "deflection", folder, "--method", "camera"]
            rows.append(spent(line, stdout=subprocess.DEVNULL))
        print_growth("frames", sizes[: len(rows)], rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    one = kinds.add_parser("study")
    one.add_argument("sizes", type=int, nargs="*", default=[3000, 10_000, 100_000], metavar="FLIGHTS")
    one.add_argument("--workers", type=int, default=3)
    one.add_argument("--alone", action="store_true", help="without plain processes to compare with")
    one = kinds.add_parser("merge")
    one.add_argument("sizes", type=int, nargs="*", default=[10_000, 100_000, 1_000_000], metavar="FLIGHTS")
    one = kinds.add_parser("imu")
    one.add_argument("sizes", type=int, nargs="*", default=[450, 900, 1800, 3600], metavar="SECONDS")
    one.add_argument("--rate", type=float, default=1000.0, help="Hz")
    one = kinds.add_parser("film")
    one.add_argument("flight", type=Path)
    one.add_argument("sizes", type=int, nargs="*", default=[1250, 2500, 5000, 10_000], metavar="FRAMES")
    for name in ("fly", "merge-one", "reconstruct-one"):
        kinds.add_parser(name, help=argparse.SUPPRESS).add_argument("words", nargs="*")
    chosen = parser.parse_args()
    if chosen.kind == "fly":
        path, folder, flights, workers, scheduler = chosen.words
        fly_study(path, folder, int(flights), int(workers), None if scheduler == "none" else scheduler)
    elif chosen.kind == "merge-one":
        merge_invented(chosen.words[0], chosen.words[1], int(chosen.words[2]))
    elif chosen.kind == "reconstruct-one":
        reconstruct_one(chosen.words[0])
    elif chosen.kind == "study":
        study(chosen.sizes, chosen.workers, not chosen.alone)
    elif chosen.kind == "merge":
        merging(chosen.sizes)
    elif chosen.kind == "imu":
        imu(chosen.sizes, chosen.rate)
    else:
        film(chosen.flight, chosen.sizes)


if __name__ == "__main__":
    main()

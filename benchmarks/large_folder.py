"""How much memory and time does `postflight run` take on a flight folder of a gigabyte of telemetry?

python benchmarks/large_folder.py [FLIGHT, default demo-flight] [--rate HZ, default 48000]

FLIGHT's triads (a folder that `postflight demo` wrote: synthetic) are written anew at HZ into a folder that is removed
afterwards: between its samples straight lines, with noise added. The run is a process of its own.
"""

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv


def write_fast(flight: Path, folder: Path, rate_hz: float) -> int:
    """Write a copy of ``flight`` whose triads are sampled at ``rate_hz``; return the bytes of its telemetry."""
    shutil.copytree(flight, folder, ignore=shutil.ignore_patterns("truth", "runs"))
    rng = np.random.default_rng(0)
    for name, noise in (("accelerometer", 0.049), ("rates", 0.05)):
        path = folder / "telemetry" / f"{name}.csv"
        slow = pd.read_csv(path)
        t = slow["t_s"].to_numpy()
        times = t[0] + np.arange(int((t[-1] - t[0]) * rate_hz)) / rate_hz
        columns = {"t_s": np.round(times, 7)}
        for column in slow.columns[1:]:
            columns[column] = np.round(np.interp(times, t, slow[column]) + rng.normal(0.0, noise, len(times)), 9)
        pyarrow.csv.write_csv(pa.table(columns), path)
    return sum(path.stat().st_size for path in (folder / "telemetry").rglob("*") if path.is_file())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flight", type=Path, nargs="?", default=Path("demo-flight"))
    parser.add_argument("--rate", type=float, default=48000.0)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "flight"
        size = write_fast(chosen.flight, folder, chosen.rate)
        print(f"{size / 1e9:.2f} GB of telemetry, triads at {chosen.rate:.0f} Hz")
        begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "postflight.cli", "run", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(
            f"{time.perf_counter() - begun:.0f} s by the clock, {spent:.0f} s of processor, at most "
            f"{after.ru_maxrss / 1024:.0f} MiB; exit {done.returncode}; {done.stdout.splitlines()[-1]}"
        )


if __name__ == "__main__":
    main()

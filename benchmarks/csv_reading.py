"""From a 100 MB telemetry CSV to checked SI arrays: our gate against the readers people use.

Run: ``python benchmarks/csv_reading.py [ROUNDS]``. Ours reads 21 columns, checks every cell, the limits and the times
and looks for gaps, missing, frozen and saturated samples; the peers stop at float64 arrays. The file (time and 20
channels, 6 to 9 digits, 2 % empty cells) is written to a temporary folder and lies in the page cache. Each reader runs
once a round, in turn. pyarrow and polars are used where they are importable, or in an interpreter with both, pandas
and numpy that ``CSV_PEERS_PYTHON`` names: installed beside pandas, pyarrow changes how pandas works.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

PEERS = ("pyarrow", "polars", "pandas, C engine")
CHANNELS = 20
SIZE_BYTES = 100e6
TARGET = 2.0  # of pyarrow's own time


def write_table(path):
    """Time and channels as a logger writes them, a block of rows at a time."""
    rng = np.random.default_rng(20)
    formats = ["%.6f", "%.5f", "%.4f", "%.7g", "%.9g"]
    names = [f"a{k}_mps2" for k in range(CHANNELS)]
    with path.open("w") as file:
        file.write(",".join(["t_s", *names]) + "\n")
        start, level = 0, rng.normal(size=CHANNELS) * 20.0
        while file.tell() < SIZE_BYTES:
            wander = np.cumsum(rng.normal(size=(20000, CHANNELS)), axis=0) * 0.01
            values = level + wander + rng.normal(size=wander.shape) * 3.0
            level = level + wander[-1]
            cells = [np.char.mod("%.4f", (start + np.arange(20000)) * 5e-4)]
            for k in range(CHANNELS):
                cells.append(np.where(rng.random(20000) < 0.02, "", np.char.mod(formats[k % 5], values[:, k])))
            file.write("\n".join(map(",".join, zip(*cells, strict=True))) + "\n")
            start += 20000


def peer(name):
    """Reader of a path into numpy arrays, or None where the library is not there."""
    try:
        if name == "pyarrow":
            import pyarrow.csv

            return lambda path: [c.to_numpy() for c in pyarrow.csv.read_csv(path).columns]
        if name == "polars":
            import polars

            return lambda path: [c.to_numpy() for c in polars.read_csv(path).get_columns()]
        import pandas

        return lambda path: pandas.read_csv(path).to_numpy()
    except ImportError:
        return None


def serve(path):
    """In an interpreter of its own: say which peers are there, then read the file with each that is named."""
    readers = {name: reader for name in PEERS if (reader := peer(name))}
    print(json.dumps(list(readers)), flush=True)
    for line in sys.stdin:
        begun = time.perf_counter()
        readers[line.strip()](path)
        print(time.perf_counter() - begun, flush=True)


def ours(folder):
    """Table and findings of the gate."""
    from flightmodel.gate import Gate, find_faults
    from flightmodel.tables import Quantity, Source

    quantities = tuple(Quantity(f"a{k}", f"a{k}_mps2", "acceleration") for k in range(CHANNELS))
    gate = Gate(folder, datetime(2009, 8, 17, 12, 52, tzinfo=UTC))
    table = gate.table("sensors.many", Source(file="table.csv"), quantities)
    gate.close()
    found = find_faults("many", table.time_s, tuple(table.columns), np.array(list(table.columns.values())).T)
    return table, found


def main(rounds):
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        path = folder / "table.csv"
        write_table(path)
        table, found = ours(folder)  # warm: libraries loaded, file in the page cache
        size = path.stat().st_size / 1e6
        print(f"{size:.0f} MB, {len(table.time_s)} rows, {len(found)} findings")
        python = os.environ.get("CSV_PEERS_PYTHON", sys.executable)
        server = subprocess.Popen(
            [python, __file__, "--serve", str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        there = json.loads(server.stdout.readline())

        def ask(name):
            server.stdin.write(name + "\n")
            server.stdin.flush()
            return float(server.stdout.readline())

        seconds = {name: [] for name in (*there, "ours")}
        for _ in range(rounds):
            for name in there:
                seconds[name].append(ask(name))
            begun = time.perf_counter()
            ours(folder)
            seconds["ours"].append(time.perf_counter() - begun)
        server.stdin.close()
        server.wait()
    least = {name: min(times[1:] or times) for name, times in seconds.items()}
    fastest = min(least[name] for name in there)
    print(f"{'':24s}{'least s':>9s}{'median s':>10s}{'MB/s':>7s}{'of the fastest peer':>21s}")
    for name, times in seconds.items():
        ratio = f"{least[name] / fastest:.2f}"
        goal = f" (target {TARGET} at most)" if name == "ours" else ""
        print(f"{name:24s}{least[name]:9.3f}{np.median(times):10.3f}{size / least[name]:7.0f}{ratio:>21s}{goal}")
    for name in set(PEERS) - set(there):
        print(f"{name}: not there")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(sys.argv[2])
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 7)

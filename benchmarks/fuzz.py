"""How does the toolkit bear spoilt input? Thousands of mutated files through the gates of a user, counted.

python benchmarks/fuzz.py [N, default 10000] [--seed S] [--only KIND ...]

A mutated file is refused in words, or read as exactly what it says, as a plain reader of `tests/fuzzing.py` finds;
anything else is a defect, and the command then ends with 1. One core; some 10 ms a file, half
a second one of HDF5.
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2
import numpy as np

from tests import fuzzing, fuzzing_deliveries

# quick kinds have the larger part of the trials
SHARE = {
    "tables of a flight": 0.05, "flight.toml": 0.08, "vehicle.toml": 0.16, "coefficients": 0.24, "scenario.toml": 0.10,
    "pictures": 0.035, "film, AVI": 0.015, "film, WebM": 0.015, "corners": 0.015,
    "camera edits": 0.10, "shell features": 0.05, "stored tables": 0.01, "spreadsheet": 0.03, "OEM": 0.05,
    "trajectory table": 0.05,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, nargs="?", default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=None)
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as root:
        cases = fuzzing.cases(Path(root)) | fuzzing_deliveries.cases(Path(root) / "deliveries")
        for k, (kind, case) in enumerate(cases.items()):
            if chosen.only and not any(word in kind for word in chosen.only):
                continue
            rng = np.random.default_rng([chosen.seed, k])
            begun, counts = time.perf_counter(), Counter()
            for _ in range(round(chosen.count * SHARE[kind])):
                outcome, words = fuzzing.trial(case, rng)
                counts[outcome] += 1
                if outcome == "defect" and counts["defect"] <= 20:
                    print(f"  {kind}: {words[:400]}")
            total += counts
            print(f"{kind:20s} {dict(sorted(counts.items()))} in {time.perf_counter() - begun:.0f} s", flush=True)
    print(f"{sum(total.values())} mutated inputs: {dict(sorted(total.items()))}")
    return int(total["defect"] > 0)


if __name__ == "__main__":
    sys.exit(main())

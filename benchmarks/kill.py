"""What is left of a `postflight run` that is killed at any moment? SIGKILL at random, then the run again.

python benchmarks/kill.py [N, default 50] [--seed S]

The flight is the tests' own of ten seconds (no physics in it, so no estimator answers: exit code 4). After each kill
whatever has a visible name must be the same, byte by byte, as an undisturbed run left it. Then the run is let to its
end: it must give the same bytes in every file but `run.json` and leave nothing half-written behind.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from postflight.warmup import GROUPS, prepare
from tests.postflight.conftest import write_flight
from tests.postflight.killing import kill_run, run_again, run_whole


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, nargs="?", default=50)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    prepare(GROUPS, print)
    rng = np.random.default_rng(chosen.seed)
    with tempfile.TemporaryDirectory() as root:
        flight = Path(root) / "flight"
        write_flight(flight)
        whole = run_whole(flight)
        begun = time.perf_counter()
        run_whole(flight)
        usual_s = time.perf_counter() - begun
        print(f"{len(whole)} files of a run, which takes {usual_s:.1f} s")
        moments = {"before anything": 0, "while writing": 0, "when done": 0}
        for k in range(chosen.count):
            at_s = float(rng.uniform(0.0, 1.05 * usual_s))
            found = kill_run(flight, at_s, whole)
            moments[found] += 1
            run_again(flight, whole)
            print(f"{k + 1:3d}: killed after {at_s:5.2f} s, {found}; the next run gave the same bytes", flush=True)
        print(f"{chosen.count} kills: {moments}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

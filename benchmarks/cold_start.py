"""What a user waits for in a new process: help, a first flight, everything from an empty kernel cache.

Run: ``python benchmarks/cold_start.py [ROUNDS]``. Whole processes, rounds interleaved, least wall time. Then what
compiling every kernel took, without the kernels that it calls, so that one sees what to shorten.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHOWN = 25
FLIGHT = """
from synthetic_flight.scenarios import fly_scenario, read_scenario
fly_scenario(read_scenario("irve2_reference"), 0)
"""
FOLDER = """
import sys
from dataclasses import replace
from pathlib import Path
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
scenario = read_scenario("irve2_reference")
simulate_to_folder(replace(scenario, spec=scenario.spec.model_copy(update={"video": None})), 0, Path(sys.argv[1]))
"""


def run(arguments, cache):
    """Wall seconds and output of a process with its kernel cache in ``cache``."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(cache), PYTHONPATH=path)
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, check=True, cwd=cache
    )
    return time.perf_counter() - begun, done.stdout


def everything(folder, side_by_side):
    """In its own process: a flight, sixteen, a reconstruction; kernels as a command compiles them, or one by one."""
    from numba.core import event

    from flightmodel.flightfolder import read_flight
    from postflight import warmup
    from recon.reconstruct import reconstruct
    from synthetic_flight import simulate
    from synthetic_flight.ensemble import Start, fly_ensemble
    from synthetic_flight.scenarios import child_rng, fly_scenario, initial_state, read_scenario
    from synthetic_flight.simulate import Schedule
    from synthetic_flight.weather import day_of_flight_atmosphere

    scenario = read_scenario("irve2_reference")
    table = simulate.atmosphere_table(
        day_of_flight_atmosphere(scenario.spec.atmosphere, child_rng(0, "atmosphere"), scenario.mean_air)
    )
    start = Start(initial_state(scenario), simulate.parameter_vector(scenario.vehicle), table)
    short = Schedule(step_s=0.005, per_record=1, records=2)
    stages = {
        "one flight": lambda: fly_scenario(scenario, 0),
        "sixteen lanes": lambda: list(fly_ensemble(scenario.vehicle, lambda _: start, range(16), short)),
        "reconstruction": lambda: reconstruct(read_flight(Path(folder))),
    }
    took, compiled = {}, []
    if side_by_side:
        stages = {
            "kernels side by side": lambda: warmup.prepare(warmup.GROUPS, lambda _fraction, _what: None),
            **stages,
        }
    for name, work in stages.items():
        begun = time.perf_counter()
        with event.install_recorder("numba:compile") as recorder:
            work()
        took[name] = time.perf_counter() - begun
        compiled += compile_times(name, recorder.buffer)
    print(json.dumps({"stages": took, "compiled": compiled}))


def compile_times(stage, events):
    """``[stage, kernel, versions, seconds, of them in numba's own functions]``; kernels that it calls not counted."""
    open_, rows = [], {}
    for when, what in events:
        if what.is_start:
            open_.append([when, 0.0, 0.0])  # begun, in kernels called, in numba's functions
            continue
        begun, kernels, internal = open_.pop()
        function, whole = what.data["dispatcher"].py_func, when - begun
        if function.__module__.startswith("numba."):
            if open_:
                open_[-1][2] += whole
            continue
        if open_:
            open_[-1][1] += whole
        row = rows.setdefault(function.__name__, [stage, function.__name__, 0, 0.0, 0.0])
        row[2] += 1
        row[3] += whole - kernels
        row[4] += internal
    return list(rows.values())


def main():
    if sys.argv[1:2] == ["everything"]:
        everything(sys.argv[2], "side by side" in sys.argv)
        return
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    with tempfile.TemporaryDirectory() as temporary:
        warm, folder = Path(temporary) / "warm", Path(temporary) / "flight"
        warm.mkdir()
        run(["-c", FOLDER, str(folder)], warm)  # also compiles the kernel of one flight
        best, details = {}, {}
        for k in range(rounds):
            empty, other = Path(temporary) / f"empty-{k}", Path(temporary) / f"other-{k}"
            empty.mkdir()
            other.mkdir()
            whole = [str(Path(__file__).resolve()), "everything", str(folder)]
            for name, arguments, cache in (
                ("bare interpreter", ["-c", "pass"], warm),
                ("postflight --help", ["-m", "postflight.cli", "--help"], warm),
                ("a first flight, warm cache", ["-c", FLIGHT], warm),
                ("everything, empty cache", [*whole, "side by side"], empty),
                ("everything, warm cache", whole, empty),
                ("everything, empty cache, one process", whole, other),
            ):
                seconds, output = run(arguments, cache)
                if seconds < best.get(name, float("inf")):
                    best[name], details[name] = seconds, output
    for name, seconds in best.items():
        print(f"{name:40s}{seconds:8.3f} s")
    over = best["postflight --help"] - best["bare interpreter"]
    print(f"--help over the interpreter: {over:.3f} s (target 0.1 at most)")
    print(f"first flight, warm cache: {best['a first flight, warm cache']:.2f} s (target 0.8 at most)")
    print(f"everything from an empty cache: {best['everything, empty cache']:.1f} s (target 15 at most)")
    for name in ("everything, empty cache", "everything, warm cache", "everything, empty cache, one process"):
        stages = json.loads(details[name])["stages"]
        print(f"{name}: " + ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in stages.items()))
    print(f"\n{'compiled from nothing, in':26s}{'kernel':22s}{'versions':>9s}{'seconds':>9s}{'in numba inside':>17s}")
    rows = sorted(json.loads(details["everything, empty cache, one process"])["compiled"], key=lambda row: -row[3])
    for stage, kernel, versions, seconds, internal in rows[:SHOWN]:
        print(f"{stage:26s}{kernel:22s}{versions:9d}{seconds:9.2f}{internal:17.2f}")
    rest = rows[SHOWN:]
    print(f"{'':26s}{'all others':22s}{sum(r[2] for r in rest):9d}{sum(r[3] for r in rest):9.2f}")


if __name__ == "__main__":
    main()

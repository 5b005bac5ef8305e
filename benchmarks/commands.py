"""How long does one wait for a command? Whole processes, in this checkout and in another, in turn.

Run: ``python benchmarks/commands.py FLIGHT [OTHER_CHECKOUT] [ROUNDS]`` on a flight folder of `postflight simulate`. Of
each command the least wall time, processor time and memory (of its largest process) over the rounds, of `run` also the
time when its answer stands on the terminal; with another checkout (its kernels compiled, the same interpreter) the
ratios. A quiet machine is wanted.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parents[1]
ANSWER = "Deflection of the aeroshell"
COMMANDS = ("run", "reconstruct", "report", "simulate", "reconcile")


def arguments(command, flight, scratch):
    """What follows ``postflight`` on the command line."""
    if command == "simulate":
        return [command, "irve2_reference", str(scratch / "flown"), "--force"]
    return [command, str(flight)]


def timed(checkout, command, flight, scratch):
    """Seconds to the answer (of `run`), in all, and of processor time; most memory of a process, MiB."""
    environment = dict(os.environ, PYTHONPATH=str(checkout), PYTHONUNBUFFERED="1")
    begun, answered = time.perf_counter(), float("nan")
    words = [sys.executable, "-m", "postflight", *arguments(command, flight, scratch)]
    with subprocess.Popen(
        words, env=environment, cwd=checkout, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as run:
        for line in run.stdout:
            if command == "run" and ANSWER in line.decode():
                answered = time.perf_counter() - begun
        _, status, used = os.wait4(run.pid, 0)  # with the second process of the command
        run.returncode = os.waitstatus_to_exitcode(status)
    whole = time.perf_counter() - begun
    if run.returncode:
        raise SystemExit(f"{' '.join(words)}: exit code {run.returncode}")
    return answered, whole, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0


def main():
    flight = Path(sys.argv[1]).resolve()
    others = [Path(a).resolve() for a in sys.argv[2:] if not a.isdigit()]
    rounds = next((int(a) for a in sys.argv[2:] if a.isdigit()), 3)
    checkouts = [HERE, *others]
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        flights = []
        for k, _ in enumerate(checkouts):  # each with runs of its own
            flights.append(scratch / f"flight-{k}")
            shutil.copytree(flight, flights[-1], ignore=shutil.ignore_patterns("runs"))
        print(f"{'':14s}{'answer s':>10s}{'whole s':>10s}{'CPU s':>10s}{'MiB':>10s}")
        for command in COMMANDS:
            least = [(float("inf"),) * 4 for _ in checkouts]
            for _ in range(rounds):
                for k, checkout in enumerate(checkouts):
                    found = timed(checkout, command, flights[k], scratch)
                    least[k] = tuple(b if not a < b else a for a, b in zip(found, least[k], strict=True))
            for k, values in enumerate(least):
                print(
                    f"{command if k == 0 else '  other':14s}"
                    + "".join(f"{v:10.2f}" if v < float("inf") else " " * 10 for v in values)
                )
            if others:
                print(f"{'  ratio':14s}" + "".join(f"{a / b:10.2f}" for a, b in zip(*least[:2], strict=True)))


if __name__ == "__main__":
    main()

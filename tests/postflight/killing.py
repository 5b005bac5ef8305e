"""The command in a process of its own, interrupted or killed, and what it leaves; also for ``benchmarks/kill.py``."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

EXIT_NO_ANSWER = 4  # the hand-made flight holds no physics, so no estimator answers
Files = dict[str, bytes]


def start_command(*arguments: str | Path, **options: Any) -> subprocess.Popen[Any]:
    """Start the command with Ctrl-C as a terminal has it.

    A shell's background job, and some CI, starts the tests with SIGINT ignored, and children inherit that.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "postflight.cli", *map(str, arguments)],
        stderr=subprocess.PIPE,
        env={**os.environ, "NO_COLOR": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


def start_run(flight: Path) -> subprocess.Popen[bytes]:
    """Run the whole chain on a flight."""
    return start_command("run", flight, stdout=subprocess.DEVNULL)


def contents(folder: Path) -> Files:
    """Every file of run folders that has a visible name, by its path in its run."""
    out = {}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if path.is_file() and not any(part.startswith(".") for part in parts):
            out["/".join(parts[1:])] = path.read_bytes()
    return out


def hidden(folder: Path) -> list[str]:
    """Names that begin with a dot, anywhere below a folder."""
    return [str(p.relative_to(folder)) for p in folder.rglob(".*")] if folder.is_dir() else []


def run_whole(flight: Path) -> Files:
    """Run undisturbed into an empty ``runs``; return its files."""
    runs = flight / "runs"
    shutil.rmtree(runs, ignore_errors=True)
    process = start_run(flight)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == EXIT_NO_ANSWER, errors.decode()
    assert not hidden(runs)
    return contents(runs)


def kill_run(flight: Path, at_s: float | None, whole: Files) -> str:
    """Kill a run after ``at_s`` and compare what has a visible name with ``whole``; say when it was killed.

    None kills it half a second after it began to write.
    """
    runs = flight / "runs"
    before = set(runs.glob(".*"))
    process = start_run(flight)
    if at_s is None:
        while process.poll() is None and not set(runs.glob(".*")) - before:
            time.sleep(0.02)
    time.sleep(0.5 if at_s is None else at_s)
    process.kill()
    process.communicate(timeout=30)
    left, writing = contents(runs) if runs.is_dir() else {}, bool(set(runs.glob(".*")) - before)
    if left:  # the folder appears at once and whole
        assert_same(left, whole)
        shutil.rmtree(runs)
    return "when done" if left else "while writing" if writing else "before anything"


def run_again(flight: Path, whole: Files) -> None:
    """Run after kills: nothing half-written is left, and the files are those of a run that nobody disturbed."""
    process = start_run(flight)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == EXIT_NO_ANSWER, errors.decode()
    assert not hidden(flight / "runs"), "what a killed run left half-written is still there"
    assert_same(contents(flight / "runs"), whole)
    shutil.rmtree(flight / "runs")


def assert_same(files: Files, whole: Files) -> None:
    """Check names and bytes, but for ``run.json``, which holds the time."""
    assert sorted(files) == sorted(whole)
    assert [n for n in files if files[n] != whole[n] and n != "run.json"] == []

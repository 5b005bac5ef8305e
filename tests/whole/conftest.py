"""One synthetic flight and one delivered flight, flown and run once for all tests of the whole chain."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from postflight import commands
from postflight.deflections import METHODS
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
from tests.postflight.short_flights import write_pulse

SEED = 11
EXAMPLE = Path(__file__).parents[2] / "examples" / "range_package_01"


def postflight(*arguments: str | Path, timeout: float = 180.0) -> subprocess.CompletedProcess[str]:
    """Run the command as a user would."""
    return subprocess.run(
        [sys.executable, "-m", "postflight.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout,
        env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1"},
    )


@pytest.fixture(scope="session")
def command() -> Callable[..., subprocess.CompletedProcess[str]]:
    return postflight


def newest(flight: Path) -> Path:
    runs = sorted(p for p in (flight / "runs").iterdir() if not p.name.startswith("."))
    assert runs, "no run folder was written"
    return runs[-1]


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic flight, simulated and run, with its truth beside it; not to be written to."""
    folder = tmp_path_factory.mktemp("whole") / "flight"
    done = postflight("simulate", "irve2_reference", folder, "--seed", str(SEED))
    assert done.returncode == 0, done.stderr
    done = postflight("run", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="session")
def run_folder(flown: Path) -> Path:
    return newest(flown)


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pulse of a synthetic flight with its film, simulated and run; to be copied."""
    folder = tmp_path_factory.mktemp("short") / "flight"
    simulate_to_folder(read_scenario(str(write_pulse(folder.parent / "pulse.toml"))), SEED, folder)
    commands.run_flight(folder, METHODS, commands.Asked())
    return folder


@pytest.fixture(scope="session")
def delivered(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    """The range's delivery from another simulator, copied and run."""
    folder = tmp_path_factory.mktemp("delivered") / "range_package_01"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("runs"))
    done = postflight("run", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done, newest(folder)

"""A flight folder written by hand, small enough to spoil a hundred times: ten seconds, two radars, three pictures."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flightmodel.atmosphere import default_sounding_sd, us76
from flightmodel.telemetry import Sounding
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from tests.in_process import runner
from tests.recon import conftest as mini

from .short_flights import content, fly, write_short

START_S, END_S = 420.0, 430.0
T0_UTC = "2009-08-17T12:52:00Z"

FLIGHT_TOML = """\
name = "hand-made"
t0_utc = "2009-08-17T12:52:00Z"
vehicle = "irve2_reference"

[attitude_prior]
t_s = 420.0
q_ecef_body = [0.394325, -0.583769, -0.087256, 0.704349]
sd_deg = 3.0

[sensors.accelerometer]
file = "telemetry/accelerometer.csv"
mount = "suba"

[sensors.rates]
file = "telemetry/rates.csv"

[radars.north]
file = "telemetry/radar_north.csv"
latitude_deg = 37.841
longitude_deg = -75.485
height_m = 12.0

[radars.south]
file = "telemetry/radar_south.csv"
latitude_deg = 37.801
longitude_deg = -75.512
height_m = 7.0

[atmosphere]
file = "telemetry/atmosphere.csv"

[frames]
file = "telemetry/frames.csv"
folder = "telemetry/camera5"
camera = "camera5"
benchmark_s = 421.0
"""


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
QUIET = ("disable-gpu", "disable-quic", "no-first-run", "disable-background-networking", "disable-component-update",
         "disable-sync")  # fmt: skip


class FlightFolder:
    """A folder of one flight and the ways to spoil it."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, name: str) -> Path:
        return self.root / name if name == "flight.toml" else self.root / "telemetry" / name

    def lines(self, name: str) -> list[str]:
        return self.path(name).read_text(encoding="utf-8").splitlines()

    def write_lines(self, name: str, lines: list[str]) -> None:
        self.path(name).write_text("\n".join(lines) + "\n", encoding="utf-8")

    def column(self, name: str, index: int) -> list[str]:
        return [line.split(",")[index] for line in self.lines(name)[1:]]

    def replace(self, name: str, old: str, new: str, count: int = 1) -> None:
        """Replace text that must be there, so that a test cannot pass by spoiling nothing."""
        text = self.path(name).read_text(encoding="utf-8")
        assert old in text, f"{old!r} is not in {name}"
        self.path(name).write_text(text.replace(old, new, count), encoding="utf-8")

    def header(self, name: str, old: str, new: str) -> None:
        lines = self.lines(name)
        assert old in lines[0].split(",")
        lines[0] = ",".join(new if cell == old else cell for cell in lines[0].split(","))
        self.write_lines(name, lines)

    def cell(self, name: str, line: int, column: int, text: str) -> str:
        """Put ``text`` in a cell of a line counted from 1 (the header) and return what was there."""
        lines = self.lines(name)
        cells = lines[line - 1].split(",")
        was, cells[column] = cells[column], text
        lines[line - 1] = ",".join(cells)
        self.write_lines(name, lines)
        return was

    def map_column(self, name: str, column: int, change: Callable[[str], str]) -> None:
        """Rewrite one column below the header."""
        lines = self.lines(name)
        for k in range(1, len(lines)):
            cells = lines[k].split(",")
            cells[column] = change(cells[column])
            lines[k] = ",".join(cells)
        self.write_lines(name, lines)

    def declare(self, text: str, after: str) -> None:
        """Add lines to flight.toml directly below the line ``after``."""
        self.replace("flight.toml", after + "\n", after + "\n" + text + "\n")

    def append(self, text: str) -> None:
        path = self.path("flight.toml")
        path.write_text(path.read_text(encoding="utf-8") + "\n" + text + "\n", encoding="utf-8")

    def contents(self) -> set[str]:
        return {str(p.relative_to(self.root)) for p in self.root.rglob("*")}


def _table(path: Path, header: str, table: np.ndarray, fmt: str = "%.9g") -> None:
    np.savetxt(path, table, fmt=fmt, delimiter=",", header=header, comments="")


def write_flight(root: Path) -> None:
    """Write numbers of the right size for a descent through 70 km; no physics is asked of them here."""
    telemetry = root / "telemetry"
    (telemetry / "camera5").mkdir(parents=True)
    (root / "flight.toml").write_text(FLIGHT_TOML, encoding="utf-8")
    t = np.arange(START_S, END_S, 0.05)
    wave = np.column_stack([np.sin(0.9 * t + k) + 0.011 * k * t for k in range(3)])
    accelerometer = np.column_stack([t, wave * [0.4, 0.5, 0.1] - [0.0, 0.0, 12.3]])
    _table(telemetry / "accelerometer.csv", "t_s,ax_suba_mps2,ay_suba_mps2,az_suba_mps2", accelerometer)
    rates = np.column_stack([t, wave * [0.3, 2.0, 2.0] + [36.0, 0.2, -0.1]])
    _table(telemetry / "rates.csv", "t_s,p_body_degps,q_body_degps,r_body_degps", rates)
    for k, name in enumerate(("north", "south")):
        s = np.arange(START_S, END_S, 0.1) + 0.013 * k
        track = np.column_stack([s, 115000.0 - 870.0 * (s - START_S), 130.2 + 0.03 * s + k, 38.0 - 0.4 * (s - START_S)])
        _table(telemetry / f"radar_{name}.csv", "t_s,range_m,az_deg,el_deg", track, "%.10g")
    h = np.arange(0.0, 120001.0, 2000.0)
    air = np.column_stack(
        [
            h,
            1.2 * np.exp(-h / 7100.0),
            250.0 + 20.0 * np.sin(h / 9000.0),
            8.0 * np.sin(h / 15e3 + 0.4),
            9.0 * np.cos(h / 21e3),
        ]
    )
    _table(telemetry / "atmosphere.csv", "alt_m,rho_kgpm3,t_k,wind_n_mps,wind_e_mps", air)
    rows = ["t_s,frame"]
    for k, at in enumerate((421.0, 424.0, 428.5)):
        shade = (np.add.outer(np.arange(480), np.arange(720)) % 200 + 10 * k).astype(np.uint8)
        cv2.imwrite(str(telemetry / "camera5" / f"frame_{k}.png"), shade)
        rows.append(f"{at:.6f},frame_{k}.png")
    (telemetry / "frames.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


@pytest.fixture(scope="session")
def clean_flight(tmp_path_factory: pytest.TempPathFactory) -> FlightFolder:
    """The unspoilt folder; not to be written to."""
    root = tmp_path_factory.mktemp("clean") / "flight"
    write_flight(root)
    return FlightFolder(root)


@pytest.fixture
def flight(clean_flight: FlightFolder, tmp_path: Path) -> FlightFolder:
    """A copy to spoil."""
    shutil.copytree(clean_flight.root, tmp_path / "flight")
    return FlightFolder(tmp_path / "flight")


@pytest.fixture(scope="session")
def postflight() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the command as a user would, in a process of its own."""

    def run(*arguments: str | Path, cwd: Path | None = None, timeout: float = 120.0):
        return subprocess.run(
            [sys.executable, "-m", "postflight.cli", *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=cwd,
            timeout=timeout,
            env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1"},
        )

    return run


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., SimpleNamespace]:
    """Run the command's own ``main`` in this process."""
    return runner(capsys, monkeypatch)


def layer_of_air():
    """Air in a layer only, so that the largest dynamic pressure lies inside the flight; no physics is asked of it."""
    z = np.arange(0.0, 130e3, 2000.0)
    density, temperature, pressure = us76(z)
    density = density * np.exp(-0.5 * ((z - 80e3) / 4e3) ** 2)
    return Sounding(z, density, temperature, pressure, 0.0 * z + 5.0, 0.0 * z, *default_sounding_sd(z))


@pytest.fixture(scope="session")
def mini_flight():
    """``mini_flight(seed)``: telemetry of a minute with every kind of instrument, a vehicle and some air."""
    truth, air, vehicle = mini._truth(), layer_of_air(), vehicle_from_toml(vehicle_path("irve2_reference"))

    def make(seed):
        return replace(mini.sense_everything(truth, seed, mini.SITES), sounding=air, vehicle=vehicle)

    return make


@pytest.fixture(scope="module")
def study_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short study's dispersions file, its scenario beside it."""
    return write_short(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def reference(request: pytest.FixtureRequest, study_path: Path, tmp_path_factory) -> dict[str, bytes]:
    """Bytes of the module's ``FLIGHTS`` of the short study, flown in this process, undisturbed."""
    folder = tmp_path_factory.mktemp("reference") / "study"
    fly(study_path, folder, request.module.FLIGHTS)
    return content(folder)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[object]:
    """A headless Chromium of this machine; skips where there is none."""
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(
            executable_path=path, headless=True, chromium_sandbox=False, args=[f"--{flag}" for flag in QUIET]
        )
        yield started
        started.close()

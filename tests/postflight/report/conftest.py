"""One short synthetic flight with a hostile vehicle, run once, and a browser to read its report with."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight import commands
from postflight.deflections import METHODS
from postflight.plots.style import FigureFolder
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
from tests.in_process import draw_here
from tests.postflight.short_flights import write_pulse

ROOT = Path(__file__).parents[3]
HOSTILE = "<script>alert(1)</script>"
HOSTILE_EVENT = '</script><img src=x onerror="alert(2)">'


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flight folder with one run and its report; not to be written to."""
    root = tmp_path_factory.mktemp("report")
    folder = root / "flight"
    simulate_to_folder(read_scenario(str(write_pulse(root / "short.toml"))), 0, folder)
    shipped = vehicle_path("irve2_reference")
    for table in vehicle_from_toml(shipped).files:
        shutil.copy(shipped.parent / table, folder / table)
    named = re.sub(r'(?m)^name = ".*"', f'name = "{HOSTILE}"', shipped.read_text(), count=1)
    (folder / "vehicle.toml").write_text(named)
    flight = (folder / "flight.toml").read_text()
    flight = flight.replace('vehicle = "irve2_reference"', 'vehicle = "vehicle.toml"')
    flight = flight.replace('name = "irve2_reference"', f'name = "{HOSTILE}"', 1)
    (folder / "flight.toml").write_text(flight + f"\n[[events]]\nname = '{HOSTILE_EVENT}'\nt_s = 430.0\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureFolder, "draw", lambda *_: None)  # nobody looks at them here
        draw_here(patch)
        commands.run_flight(folder, METHODS, commands.Asked())
    return folder


@pytest.fixture(scope="session")
def report(reported: Path) -> Path:
    """The report that the run wrote."""
    return next((reported / "runs").glob("*/report.html"))


@pytest.fixture
def opened(browser, report: Path):
    """``opened(width)``: the report in a new window; what it said and asked for is kept beside the page."""
    contexts = []

    def open_at(width: int = 1440, height: int = 900, path: Path = report) -> SimpleNamespace:
        context = browser.new_context(viewport={"width": width, "height": height})
        contexts.append(context)
        page = context.new_page()
        seen = SimpleNamespace(page=page, said=[], requests=[], dialogs=[])
        page.on("console", lambda message: seen.said.append(message.text))
        page.on("pageerror", lambda fault: seen.said.append(str(fault)))
        page.on("request", lambda request: seen.requests.append(request.url))
        page.on("dialog", lambda dialog: (seen.dialogs.append(dialog.message), dialog.dismiss()))
        page.goto(path.as_uri())
        page.wait_for_function("document.documentElement.dataset.ready === 'yes'")
        return seen

    yield open_at
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
def rocket(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flight folder of a rocket that flew, without vehicle file, inertial sensors and video, with one run."""
    folder = tmp_path_factory.mktemp("rocket") / "flight"
    shutil.copytree(ROOT / "tests" / "data" / "real_flights" / "rocketpy_prometheus", folder)
    commands.run_flight(folder, METHODS, commands.Asked())
    return folder

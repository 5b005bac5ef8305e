"""Every command on every shipped scenario and on the delivered range package; and runs with a gap, read back."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flightmodel.checks import GateError
from flightmodel.vehicle import DATA
from postflight import commands
from synthetic_flight.scenarios import shipped_scenarios
from tests.in_process import runner
from tests.postflight.short_flights import write_pulse

EXAMPLE = Path(__file__).parents[2] / "examples" / "range_package_01"
SHIPPED = tuple(shipped_scenarios())


@pytest.fixture
def command(capsys, monkeypatch):
    """Run the command in this process; it has to end well."""
    run = runner(capsys, monkeypatch)

    def ends_well(*arguments):
        done = run(*arguments)
        assert done.returncode == 0, f"{arguments}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        return done

    return ends_well


def none_by_camera(flight: Path) -> list[str]:
    """Option that names the camera where the flight has no film."""
    return [] if "[frames" in (flight / "flight.toml").read_text() else ["--without", "camera"]


def read_back_everywhere(command, flight: Path, synthetic: bool, again: bool = False) -> None:
    """Run a flight and read the run back by every command; ``again`` compares it with a second run too."""
    command("run", flight)
    if synthetic:
        assert json.loads(command("score", flight, "--json", *none_by_camera(flight)).stdout)["methods"]
    if again:
        command("run", flight, "--set", "density=1.02", "--name", "denser")
        command("compare", flight / "plain", flight / "denser")
    for form in ("csv", "oem", "kml"):
        command("export", flight, "--run", "plain", "--to", form)
    command("compare", flight / "plain", next((flight / "exports").glob("*.oem")))
    command("report", flight, "--run", "plain")


def thinned(scenario: str) -> str:
    """Text of a shipped scenario with a tenth of the samples, and frames a second apart; its physics as it is."""
    text = (DATA / "scenarios" / f"{scenario}.toml").read_text()
    for pattern, slower in (
        (r"(?m)^rate_hz = (?:4\d\d|2\d\d)\.0", "rate_hz = 50.0"),
        (r"(?m)^rate_hz = 4\.0", "rate_hz = 1.0"),
    ):
        text = re.sub(pattern, slower, text)
    return text


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SHIPPED)
def test_a_shipped_scenario_goes_through_every_command(scenario, command, tmp_path):
    flight, path = tmp_path / "flight", tmp_path / f"{scenario}.toml"
    path.write_text(thinned(scenario))
    for table in (DATA / "scenarios").glob("*.csv"):
        shutil.copy(table, tmp_path)
    command("simulate", path, flight, "--seed", "7")
    read_back_everywhere(command, flight, synthetic=True)


@pytest.mark.slow
def test_the_delivered_package_goes_through_every_command(command, tmp_path):
    flight = tmp_path / "flight"
    shutil.copytree(EXAMPLE, flight, ignore=shutil.ignore_patterns("runs"))
    read_back_everywhere(command, flight, synthetic=False, again=True)


@pytest.fixture(scope="module")
def pulse(tmp_path_factory):
    """The pulse of a synthetic flight without film, as simulated."""
    folder = tmp_path_factory.mktemp("pulse")
    path = write_pulse(folder / "pulse.toml")
    path.write_text(re.sub(r"(?ms)^\[video\].*?(?=^\[)", "", path.read_text()))
    commands.simulate(str(path), folder / "flight", 5, force=False)
    return folder / "flight"


def without_rows(table: Path, start_s: float, end_s: float) -> None:
    """Take the rows of a span out of a table of telemetry."""
    rows = pd.read_csv(table)
    time_s = rows.iloc[:, 0]
    rows[(time_s < start_s) | (time_s > end_s)].to_csv(table, index=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    "table", ["rates.csv", "accelerometer.csv", "radar_wallops_island.csv"], ids=lambda name: name.removesuffix(".csv")
)
def test_a_run_with_a_gap_is_read_back_by_every_command(table, pulse, command, tmp_path):
    flight = tmp_path / "flight"
    shutil.copytree(pulse, flight)
    without_rows(flight / "telemetry" / table, 436.0, 436.5)
    read_back_everywhere(command, flight, synthetic=True, again=table == "rates.csv")
    (run,) = (path for path in (flight / "runs").iterdir() if not path.name.endswith("denser"))
    if table == "rates.csv":
        rates = pd.read_csv(run / "bet.csv")["q_body_degps"]
        assert 0 < rates.isna().sum() < 0.1 * len(rates)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "fault"),
    [("entry_bounds", GateError("no entry", "time-not-covered")), ("write_report", RuntimeError("a defect"))],
    ids=["refused bands", "a report that fails"],
)
def test_answers_stay_whatever_ends_what_follows_them(part, fault, pulse, capsys, monkeypatch, tmp_path):
    flight = tmp_path / "flight"
    shutil.copytree(pulse, flight)

    def fails(*_, **__):
        raise fault

    monkeypatch.setattr(commands, part, fails)
    done = runner(capsys, monkeypatch)("run", flight)
    refused = isinstance(fault, GateError)
    assert done.returncode == (0 if refused else 1)
    (run,) = (flight / "runs").iterdir()
    assert (run / "deflection_fused.csv").is_file()
    summary = json.loads((run / "summary.json").read_text())
    assert summary["methods"]["fused"]["deflection_deg"] is not None
    assert any("bounds of the rigid vehicle" in words for words in summary["missing"]) == refused
    assert ("[time-not-covered]" in done.stdout) == refused
    monkeypatch.undo()
    assert runner(capsys, monkeypatch)("score", flight, "--without", "camera").returncode == 0


def test_a_time_days_after_the_flight_is_refused_with_its_line(pulse, command, capsys, monkeypatch, tmp_path):
    flight = tmp_path / "flight"
    shutil.copytree(pulse, flight)
    table = flight / "telemetry" / "rates.csv"
    lines = table.read_text().splitlines()
    cells = lines[-1].split(",")
    table.write_text("\n".join([*lines[:-1], ",".join(["1e12", *cells[1:]])]) + "\n")
    done = runner(capsys, monkeypatch)("run", flight)
    assert done.returncode == 3
    assert "[time-far]" in done.stderr
    assert f"line {len(lines)}" in done.stderr
    text = (flight / "flight.toml").read_text()
    span = "[sensors.rates]\nuse_s = [[0.0, 1000.0]]"
    (flight / "flight.toml").write_text(text.replace("[sensors.rates]", span))
    command("check", flight)


def test_the_drag_table_of_the_form_is_read(command, tmp_path):
    flight = tmp_path / "flight"
    shutil.copytree(EXAMPLE.parent / "mars_entry", flight, ignore=shutil.ignore_patterns("runs"))
    text = (flight / "flight.toml").read_text()
    assert "c_a = 1.70\n" in text
    (flight / "flight.toml").write_text(text.replace("c_a = 1.70\n", 'table = { file = "ca.csv" }\n'))
    (flight / "ca.csv").write_text("mach,c_a\n1.0,1.70\n30.0,1.70\n")
    command("reconstruct", flight)
    (run,) = (flight / "runs").iterdir()
    assert np.isfinite(pd.read_csv(run / "bet.csv")["rho_kgpm3"]).all()

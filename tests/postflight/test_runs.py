"""Runs named and selected, what they keep of their inputs, and that a what-if is one wherever it shows."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from flightmodel.checks import ConfigError, GateError
from postflight import commands, flight, plots, run_folder
from postflight.deflections import Deflections
from postflight.exports import read_source
from postflight.flight import read_flight
from postflight.reconstruction import reconstruct
from postflight.runs import check_name, complete_runs, find_run, read_run
from tests.refusing import printed_codes

ROCKET = Path(__file__).parents[1] / "data" / "real_flights" / "rocketpy_prometheus"


def write_run(folder, looked_at, name=""):
    """A run of the trajectory alone, without figures and report."""
    bet = reconstruct(looked_at)
    settings = {"methods": []} | ({"changes": list(looked_at.changes)} if looked_at.changes else {})
    with run_folder.RunFolder(folder, bet.telemetry, settings, name, looked_at.as_read) as out:
        event_rows = run_folder.write_reconstruction(out, bet)
        out.write_json("summary.json", run_folder.summary(bet, Deflections(), event_rows))
    return out.path


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A rocket's flight folder with a plain run and, later, a what-if."""
    folder = tmp_path_factory.mktemp("runs") / "flight"
    shutil.copytree(ROCKET, folder)
    read = read_flight(folder)
    plain = write_run(folder, read)
    # the folder's name has whole seconds: of two runs in one second the digits would decide
    plain = plain.rename(plain.with_name(plain.name.replace(plain.name[:16], "20200101T000000Z")))
    write_run(folder, read.with_(density=1.05), "dense-air")
    return folder


@pytest.mark.parametrize("name", ["", "plain", "../x", "a/b", "<b>", "x" * 41, ".hidden", "-x", "a b", "ä"])
def test_names_that_are_no_part_of_a_folder_name_are_refused(name):
    with pytest.raises(ConfigError) as fault:
        check_name(name)
    assert fault.value.codes == ("option-format",)


def test_a_run_is_found_by_each_of_its_names(flown):
    plain, dense = complete_runs(flown)
    assert dense.name.endswith("-dense-air")
    assert find_run(flown) == dense
    for word in ("dense-air", dense.name, dense.name.split("-")[1]):
        assert find_run(flown, word) == dense
    for word in ("plain", plain.name, plain.name.split("-")[1]):
        assert find_run(flown, word) == plain
    with pytest.raises(GateError) as fault:
        find_run(flown, "dense-aire")
    assert fault.value.codes == ("name-unknown",)
    assert "did you mean 'dense-air'?" in str(fault.value)


def test_a_run_without_loads_is_read_back_and_says_why_it_has_none(flown):
    """A rocket on radar alone: no inertial sensors, no deflection."""
    run = read_run(flown, "dense-air")
    assert run.name == "dense-air"
    assert run.flight.changes == run.changes == ("density = 1.05",)
    assert len(run.trajectory.time_s) == len(run.table)
    assert run.loads is None
    assert list(run.deflections) == []
    assert plots.figure_flown(run).get_axes()
    assert plots.figure_residuals(run).get_axes()
    for figure, code in ((plots.figure_2_5, "input-missing"), (plots.figure_air, "argument-type")):
        with pytest.raises(GateError) as fault:
            figure(run)
        assert fault.value.codes == (code,)


@pytest.mark.parametrize("missing", ["run.json", "summary.json", "bet_header.json", "bet.csv"])
def test_what_is_not_complete_is_no_last_run(flown, tmp_path, missing):
    folder = tmp_path / "flight"
    shutil.copytree(flown, folder)
    dense = find_run(folder, "dense-air")
    cut = shutil.copytree(dense, dense.with_name("20990101T000000Z-89abcdef-cut"))
    (cut / missing).unlink()
    shutil.copytree(dense, dense.with_name(".partial-01234567-1-89abcdef-run"))
    assert find_run(folder) == dense
    with pytest.raises(GateError) as fault:
        find_run(folder, "cut")
    assert fault.value.codes == ("name-unknown",)


def test_a_flight_without_a_complete_run_has_none(tmp_path):
    with pytest.raises(GateError) as fault:
        find_run(tmp_path, "plain")
    assert fault.value.codes == ("run-missing",)


def test_a_run_keeps_flight_and_vehicle_as_they_were_read(clean_flight, tmp_path):
    """Edited between reading and writing, the copies are still what the results rest on."""
    folder = tmp_path / "flight"
    shutil.copytree(clean_flight.root, folder)
    before = (folder / "flight.toml").read_bytes()
    read = read_flight(folder)
    (folder / "flight.toml").write_text("name = 'another'\n")
    with run_folder.RunFolder(folder, read.telemetry, {}, as_read=read.with_(c_n=1.1).as_read) as out:
        pass
    kept = out.path / "inputs"
    assert (kept / "flight.toml").read_bytes() == before
    vehicle = read.vehicle.source
    assert (kept / "vehicle" / vehicle.name).read_bytes() == vehicle.read_bytes()
    there = {p.relative_to(kept).as_posix() for p in kept.rglob("*") if p.is_file()}
    assert there == {"flight.toml", f"vehicle/{vehicle.name}", *(f"vehicle/{name}" for name in read.vehicle.files)}


def test_a_file_that_changes_while_it_is_read_is_refused(clean_flight, tmp_path, monkeypatch):
    folder = tmp_path / "flight"
    shutil.copytree(clean_flight.root, folder)
    there = flight.read_telemetry

    def edited_meanwhile(*arguments):
        telemetry = there(*arguments)
        (folder / "flight.toml").write_bytes((folder / "flight.toml").read_bytes() + b"# later\n")
        return telemetry

    monkeypatch.setattr(flight, "read_telemetry", edited_meanwhile)
    with pytest.raises(GateError) as fault:
        read_flight(folder)
    assert fault.value.codes == ("inputs-changed",)


def test_a_what_if_is_one_wherever_it_shows(flown):
    plain, dense = complete_runs(flown)
    for run, changes in ((plain, []), (dense, ["density = 1.05"])):
        for name in ("summary", "bet_header"):
            assert json.loads((run / f"{name}.json").read_text())["changes"] == changes
    assert "name" not in json.loads((plain / "run.json").read_text())
    assert json.loads((dense / "run.json").read_text())["name"] == "dense-air"
    assert "what-if" not in read_source(flown, "plain").title
    assert read_source(flown).title.endswith("what-if: density = 1.05")


def test_export_takes_the_run_that_is_asked_for(flown, tmp_path, command):
    tables = []
    for words, mark in (((), "what-if: density = 1.05"), (("--run", "plain"), "")):
        out = tmp_path / f"{len(words)}.csv"
        done = command("export", flown, "--to", "csv", "--out", out, *words)
        assert done.returncode == 0, done.stderr
        assert ("what-if" in done.stdout) == bool(mark)
        assert mark in done.stdout
        tables.append(pd.read_csv(out))
    ratio = tables[0]["rho_kgpm3"] / tables[1]["rho_kgpm3"]
    assert ratio.median() == pytest.approx(1.05, rel=1e-3)


@pytest.mark.parametrize("verb", ["export", "report"])
def test_a_run_that_is_not_there_is_refused(flown, tmp_path, command, verb):
    words = ("--to", "csv") if verb == "export" else ("--output", tmp_path / "r.html")
    done = command(verb, flown, *words, "--run", "dense")
    assert (done.returncode, printed_codes(done.stderr)) == (3, ["name-unknown"])
    assert not (tmp_path / "r.html").exists()


def test_a_bad_name_is_refused_with_every_other_fault_before_anything_is_read():
    with pytest.raises(ConfigError) as fault:
        commands.asked(("c_n",), (), None, "a b")
    assert fault.value.codes == ("option-format", "option-format")


def test_report_says_that_it_is_of_a_what_if(flown, tmp_path, command):
    for word, expected in (("dense-air", True), ("plain", False)):
        out = tmp_path / f"{word}.html"
        done = command("report", flown, "--run", word, "--output", out)
        assert done.returncode == 0, done.stderr
        header = out.read_text().partition("</header>")[0]
        assert ('<span class="tag">what-if</span>' in header) == expected
        assert ("density = 1.05" in header) == expected
        assert ("<title>what-if: " in header) == expected

"""What flight.toml left to the defaults is named, and what the flight shows is offered as lines that it can take."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from flightmodel.flightfolder import read_flight
from postflight.report import write
from postflight.runs import read_run
from tests.in_process import runner
from tests.refusing import printed_codes


@pytest.fixture(scope="module")
def run(reported):
    return read_run(reported)


def edited(clean_flight, tmp_path, *pairs):
    """Folder of the hand-made flight with pieces of flight.toml replaced."""
    folder = shutil.copytree(clean_flight.root, tmp_path / "flight")
    text = (folder / "flight.toml").read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "flight.toml").write_text(text)
    return folder


def test_everything_is_assumed_where_nothing_is_stated(clean_flight):
    found = read_flight(clean_flight.root).assumed
    assert set(found) == {"sensors.accelerometer", "sensors.rates", "radars.north", "radars.south"}
    assert set(found["radars.north"]) == {
        "range_sd_m", "angle_sd_deg", "range_bias_sd_m", "angle_bias_sd_deg", "time_bias_sd_s"
    }  # fmt: skip
    assert found["radars.north"]["range_sd_m"] == 5.0
    assert found["sensors.rates"]["noise_sd_degps"] == 0.05


def test_what_is_stated_or_not_measured_is_not_assumed(clean_flight, tmp_path):
    folder = edited(
        clean_flight, tmp_path,
        ("height_m = 12.0", "height_m = 12.0\nrange_sd_m = 5.0\nazimuth_sd_deg = 0.01\nelevation_sd_deg = 0.02"),
        ("height_m = 7.0", 'height_m = 7.0\nmeasures = ["az", "el"]'), ("sd_deg = 3.0\n", ""),
    )  # fmt: skip
    found = read_flight(folder).assumed
    assert set(found["radars.north"]) == {"range_bias_sd_m", "angle_bias_sd_deg", "time_bias_sd_s"}
    assert set(found["radars.south"]) == {"angle_sd_deg", "angle_bias_sd_deg", "time_bias_sd_s"}
    assert found["attitude_prior"] == {"sd_deg": 3.0}


def test_noise_in_every_row_of_a_table_is_stated(clean_flight, tmp_path):
    folder = edited(clean_flight, tmp_path)
    table = folder / "telemetry" / "radar_north.csv"
    head, *rows = table.read_text().splitlines()
    table.write_text("\n".join([f"{head},range_sd_m", *(f"{row},4.0" for row in rows)]) + "\n")
    found = read_flight(folder).assumed["radars.north"]
    assert "range_sd_m" not in found
    assert "angle_sd_deg" in found


def test_check_names_what_is_assumed(clean_flight, capsys, monkeypatch):
    done = runner(capsys, monkeypatch)("check", clean_flight.root)
    assert printed_codes(done.stdout).count("default-assumed") == 4
    (line,) = [line for line in done.stdout.splitlines() if "[radars.south]" in line]
    assert "range_sd_m = 5" in line
    as_json = json.loads(runner(capsys, monkeypatch)("check", clean_flight.root, "--json").stdout)
    assert as_json["assumed"]["radars.south"]["range_sd_m"] == 5.0


def test_the_lines_offered_can_be_pasted_and_hold_the_noise_that_was_drawn(run):
    """A synthetic flight states the noise that its radars have: measured within 10 %, of 450 points each."""
    offered = tomllib.loads(write.measured(run))
    assert set(offered["radars"]) == set(run.telemetry.radars)
    for name, keys in offered["radars"].items():
        site = run.telemetry.radars[name].spec
        wanted = {"range_sd_m": site.range_sd_m}
        wanted |= dict.fromkeys(("azimuth_sd_deg", "elevation_sd_deg"), float(np.rad2deg(site.angle_sd_rad)))
        assert keys == pytest.approx(wanted, rel=0.1)
    assert re.search(r"# time bias: [-+]", write.measured(run))


def test_noise_that_is_stated_otherwise_is_offered_as_it_is(run):
    """Stated twice as large, with residuals half as large as predicted: the same lines for the noise."""
    sensors = [s | {"range_sd_m": 2.0 * s["range_sd_m"]} if "range_sd_m" in s else s for s in run.header["sensors"]]
    residuals = run.tables["residual_statistics"].copy()
    residuals.loc[residuals["component"] == "range", "rms_normalised"] *= 0.5
    tables = run.tables | {"residual_statistics": residuals}
    other = replace(run, header=run.header | {"sensors": sensors}, tables=tables)
    assert tomllib.loads(write.measured(other)) == tomllib.loads(write.measured(run))


def test_report_and_provenance_name_what_was_assumed(run, report):
    other = replace(run, header=run.header | {"assumed": {"gnss.a": {"x_sd": 2.0}}})
    assert write.assumed(other) == [("gnss.a", "x_sd = 2")]
    assert run.header["assumed"] == run.telemetry.assumed
    text = report.read_text()
    assert ("<h3>Assumed</h3>" in text) == bool(run.telemetry.assumed)
    assert "Measured in this flight" in text

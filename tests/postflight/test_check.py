"""`postflight check`: no remark on flights that are right, and one with its code on every planted fault."""

import json
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from rich.console import Console

from flightmodel.film import Frames
from flightmodel.vehicle import read_vehicle
from postflight.checks import folder_check
from postflight.checks.folder_check import Fact, Report, check_folder, frozen_films
from postflight.cli import cli
from tests.oracles import mars_entry
from tests.refusing import numbers_in

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "examples" / "range_package_01"
REAL_FLIGHTS = ROOT / "tests" / "data" / "real_flights"
REAL = os.environ.get("POSTFLIGHT_REALDATA")


def needs_data(test):
    test = pytest.mark.skipif(REAL is None, reason="POSTFLIGHT_REALDATA names no folder of recorded flights")(test)
    return pytest.mark.realdata(test)


ISLAND = "radar_wallops_island.csv"


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / "flight")
    return tmp_path / "flight"


def edit(folder, *changes):
    path = folder / "flight.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)


def change(folder, name, function):
    path = folder / "telemetry" / name
    table = pd.read_csv(path)
    function(table).to_csv(path, index=False)


def remarks(folder):
    """Cross-checks' remarks as (source, code)."""
    return [(f.source, f.code) for f in check_folder(folder).cross_checks]


def only(folder):
    """The one remark: source, code, words."""
    (remark,) = check_folder(folder).cross_checks
    return remark.source, remark.code, remark.what


# flights that are right


def test_package_as_delivered_has_no_remark():
    report = check_folder(PACKAGE)
    assert not report.cross_checks
    assert report.exit_code == 0
    gaps = {f.what for f in report.findings if f.code == "data-gap"}
    assert {re.search(r"[\d.]+ s", gap)[0] for gap in gaps} >= {"0.460 s", "4.100 s"}
    # each radar's time bias has an sd below 0.2 s and is within three of the true zero
    biases = [c for c in report.time_biases if c.against == "accelerometer"]
    assert len(biases) == 2
    assert all(c.sd_s < 0.2 and abs(c.late_s) < 3 * c.sd_s for c in biases)


@needs_data
@pytest.mark.parametrize("name", sorted(p.name for p in REAL_FLIGHTS.iterdir()))
def test_recorded_flights_as_described_have_no_remark(name, tmp_path):
    tables = REAL_FLIGHTS / name if any((REAL_FLIGHTS / name).glob("*.csv")) else Path(str(REAL)) / name
    for path in (REAL_FLIGHTS / name / "flight.toml", *tables.glob("*.csv")):
        shutil.copy(path, tmp_path)
    assert not remarks(tmp_path)


# planted faults of units


def test_one_channel_beside_a_tracker_is_checked(tmp_path):
    """Mars telemetry of other column names, with the navigation's states: it ended in a traceback."""
    entry = mars_entry.fly(910, to_s=120.0)
    mars_entry.write(entry, tmp_path)
    rows = np.column_stack([entry.time_s, entry.position_m / 1e3])[::16]
    np.savetxt(tmp_path / "nav.csv", rows, fmt="%.6f", delimiter=",", header="ET,X_KM,Y_KM,Z_KM", comments="")
    columns = "".join(f'columns.{c} = {{ column = "{c.upper()}_KM", unit = "km" }}\n' for c in "xyz")
    more = f"""
[gnss.nav]
file = "nav.csv"
time = {{ column = "ET", format = "seconds" }}
{columns}horizontal_sd_m = 10.0
vertical_sd_m = 10.0
wander_sd_m = 0.0
time_bias_sd_s = 0.0
"""
    with (tmp_path / "flight.toml").open("a") as file:
        file.write(more)
    report = check_folder(tmp_path)
    assert report.exit_code == 0
    assert not report.cross_checks
    assert [fact.source for fact in report.facts] == ["accelerometer", "nav"]


def test_samples_too_far_apart_for_forces_are_named(folder):
    change(folder, "rates.csv", lambda t: t.iloc[::100])
    assert ("rates", "too-few-data") in remarks(folder)
    assert ("accelerometer", "too-few-data") not in remarks(folder)


def test_accelerometer_in_g_read_as_metres(folder):
    edit(folder, ('unit = "g"', 'unit = "mps2"'))
    source, code, words = only(folder)
    assert (source, code) == ("accelerometer", "unit-suspect")
    assert "'mps2'" in words
    assert "'g'" in words


def test_accelerometer_in_feet_read_as_metres(folder):
    edit(folder, ('unit = "g"', 'unit = "mps2"'))
    change(folder, "suba_accel.csv", lambda t: t.assign(**{c: t[c] * 32.174 for c in t.columns[1:]}))
    source, code, words = only(folder)
    assert (source, code) == ("accelerometer", "unit-suspect")
    assert "'ftps2'" in words


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("ft", 1.0), ("m", 0.9144e-3)])
def test_range_in_another_unit(folder, unit, factor):
    edit(folder, ('column = "RANGE (yd)", unit = "yd"', f'column = "RANGE (yd)", unit = "{unit}"'))
    change(folder, ISLAND, lambda t: t.assign(**{"RANGE (yd)": t["RANGE (yd)"] * factor}))
    found = check_folder(folder).cross_checks
    assert [(f.source, f.code) for f in found] == [
        ("wallops_island", "unit-suspect"),
        ("wallops_mainland", "unit-suspect"),
    ]
    for remark, right in zip(found, ("yd" if factor == 1.0 else "km", "yd"), strict=True):
        assert re.search(rf"\brange\b[^,;]*'{right}'[^,;]*'{unit}'", remark.what)


def test_angles_in_radians_read_as_degrees(folder):
    change(folder, ISLAND, lambda t: t.assign(**{c: np.deg2rad(t[c]) for c in ("AZ (deg)", "EL (deg)")}))
    source, code, words = only(folder)
    assert (source, code) == ("wallops_island", "unit-suspect")
    assert all(re.search(rf"\b{angle}\b[^,;]*'rad'[^,;]*'deg'", words) for angle in ("az", "el"))


def test_azimuth_and_elevation_exchanged(folder):
    change(folder, ISLAND, lambda t: t.rename(columns={"AZ (deg)": "EL (deg)", "EL (deg)": "AZ (deg)"}))
    # azimuths of 130 deg are no elevations: refused before any cross-check
    report = check_folder(folder)
    assert report.exit_code == 3
    assert {fault.code for fault in report.refused} == {"value-range"}


def test_rates_in_degrees_read_as_radians(folder):
    edit(folder, ('unit = "degps"', 'unit = "radps"'))
    source, code, words = only(folder)
    assert (source, code) == ("rates", "unit-suspect")
    assert "'degps'" in words


# planted faults of axes


def test_accelerometer_axes_in_another_order(folder):
    edit(
        folder,
        ('column = "AX (g)"', 'column = "TMP"'),
        ('column = "AZ (g)"', 'column = "AX (g)"'),
        ('"TMP"', '"AZ (g)"'),
    )
    (remark,) = [f for f in check_folder(folder).cross_checks if f.code == "axes-suspect"]
    assert "+x" in remark.what


def test_accelerometer_of_the_other_sign(folder):
    change(folder, "suba_accel.csv", lambda t: t.assign(**{c: -t[c] for c in t.columns[1:]}))
    (remark,) = [f for f in check_folder(folder).cross_checks if f.code == "axes-suspect"]
    assert "[1.00," in remark.what


def test_roll_and_pitch_rates_exchanged(folder):
    edit(folder, ("ROLL RATE", "TMP"), ("PITCH RATE", "ROLL RATE"), ("TMP", "PITCH RATE"))
    assert remarks(folder) == [("rates", "axes-suspect")]


# planted faults on recorded flights


def recorded(name, into):
    tables = REAL_FLIGHTS / name if any((REAL_FLIGHTS / name).glob("*.csv")) else Path(str(REAL)) / name
    for path in (REAL_FLIGHTS / name / "flight.toml", *tables.glob("*.csv")):
        shutil.copy(path, into)
    return into


def test_barometer_in_feet_read_as_metres(tmp_path):
    folder = recorded("rocketpy_prometheus", tmp_path)
    path = folder / "telemega_baro_axial.csv"
    table = pd.read_csv(path)
    table.assign(height_m=table["baro_alt_msl_m"] / 0.3048).drop(columns="pressure_pa").to_csv(path, index=False)
    edit(folder, ('columns = { pressure = { column = "pressure_pa", unit = "pa" } }\n', ""))
    source, code, words = only(folder)
    assert (source, code) == ("baro", "unit-suspect")
    assert "'ft'" in words


@needs_data
class TestRecorded:
    def test_accelerometer_reads_one_where_it_stands_still(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        path = folder / "adis16405.csv"
        table = pd.read_csv(path)
        table.assign(**{f"a{a}_mps2": table[f"a{a}_mps2"] / 9.80665 for a in "xyz"}).to_csv(path, index=False)
        (remark,) = check_folder(folder).cross_checks
        assert (remark.source, remark.code) == ("accelerometer", "unit-suspect")
        assert remark.end_s - remark.start_s == pytest.approx(2.0)  # by a rest of two seconds, not by a track
        assert "'g'" in remark.what

    def test_receiver_climbs_downward(self, tmp_path):
        folder = recorded("navego_synthetic", tmp_path)
        path = folder / "gnss.csv"
        table = pd.read_csv(path)
        table.assign(vd_mps=-table["vd_mps"]).to_csv(path, index=False)
        assert not remarks(folder), "a car's climb is below the fixes' noise"
        table.assign(vn_mps=-table["vn_mps"]).to_csv(path, index=False)
        source, code, words = only(folder)
        assert (source, code) == ("receiver", "axes-suspect")
        assert "north" in words

    def test_receiver_in_knots(self, tmp_path):
        folder = recorded("navego_synthetic", tmp_path)
        text = "".join(f'v{a} = {{ column = "v{a}_mps", unit = "kt" }}\n' for a in "ned")
        edit(folder, ("[gnss.receiver.columns]\n", f"[gnss.receiver.columns]\n{text}"))
        source, code, words = only(folder)
        assert (source, code) == ("receiver", "unit-suspect")
        assert "'mps'" in words

    def test_magnetometer_a_decade_off(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        edit(folder, ('column = "mx_T", unit = "t"', 'column = "mx_T", unit = "gauss"'))
        edit(folder, ('column = "my_T", unit = "t"', 'column = "my_T", unit = "gauss"'))
        edit(folder, ('column = "mz_T", unit = "t"', 'column = "mz_T", unit = "gauss"'))
        source, code, words = only(folder)
        assert (source, code) == ("magnetometer", "unit-suspect")
        assert "'t'" in words

    @pytest.mark.parametrize("axes", ['["+y", "-x", "+z"]', '["-x", "-y", "+z"]'])
    def test_gyros_along_other_axes(self, tmp_path, axes):
        folder = recorded("psas_l12", tmp_path)
        text = (folder / "flight.toml").read_text()
        head, tail = text.split("[sensors.rates]")
        (folder / "flight.toml").write_text(head + "[sensors.rates]" + tail.replace('["+x", "+y", "+z"]', axes, 1))
        assert ("rates", "axes-suspect") in remarks(folder)

    def test_rates_in_degrees_read_as_radians(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        edit(folder, ('unit = "degps"', 'unit = "radps"'))
        units = [f.what for f in check_folder(folder).cross_checks if (f.source, f.code) == ("rates", "unit-suspect")]
        assert units
        assert all("'radps'" in words and "'degps'" in words for words in units)

    def test_magnetometer_late(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        edit(folder, ("reversed = true", "reversed = true\ntime = { offset_s = 0.2 }"))
        report = check_folder(folder)
        assert [(f.source, f.code) for f in report.cross_checks] == [("magnetometer", "clock-lag")]
        (bias,) = [b for b in report.time_biases if (b.source, b.against) == ("magnetometer", "rates")]
        assert bias.late_s == pytest.approx(0.2, abs=0.05)


# planted faults of clocks


@pytest.mark.parametrize("late_s", [-1.0, 1.2])
def test_accelerometer_and_gyros_late(folder, late_s):
    edit(folder, ('time = { column = "TPLUS (s)" }', f'time = {{ column = "TPLUS (s)", offset_s = {late_s} }}'))
    report = check_folder(folder)
    # their clocks agree with each other, and the radars' with each other: it is the clock on board
    assert [f.source for f in report.cross_checks if f.code == "clock-lag"] == ["accelerometer, rates"]
    biases = [b for b in report.time_biases if b.against == "accelerometer"]
    assert {b.source for b in biases} == {"wallops_island", "wallops_mainland"}
    assert all(abs(b.late_s + late_s) < 3.5 * b.sd_s for b in biases)


def test_one_radar_late(folder):
    head, tail = (
        'format = "irig_doy" }\nlatitude_deg = 37.8410',
        'format = "irig_doy", offset_s = 0.4 }\nlatitude_deg = 37.8410',
    )
    edit(folder, (head, tail))
    report = check_folder(folder)
    pair = next(c for c in report.time_biases if {c.source, c.against} == {"wallops_island", "wallops_mainland"})
    sign = 1.0 if pair.source == "wallops_island" else -1.0
    assert abs(sign * pair.late_s - 0.4) < 3 * pair.sd_s
    assert [(f.source, f.code) for f in report.cross_checks] == [("wallops_island", "clock-lag")]


def test_radar_at_another_site(folder):
    edit(folder, ("latitude_deg = 37.8410", "latitude_deg = 38.8410"))
    assert ("wallops_mainland", "tracker-distance") in remarks(folder)


# the start


def test_attitude_with_the_scalar_last_and_turned_the_other_way(folder):
    q = "[0.41731, -0.53156, -0.11720, 0.72771]"
    edit(folder, (q, "[-0.53156, -0.11720, 0.72771, 0.41731]"))
    assert remarks(folder) == [("attitude_prior", "attitude-convention")]
    edit(folder, ("[-0.53156, -0.11720, 0.72771, 0.41731]", "[0.41731, 0.53156, 0.11720, -0.72771]"))
    assert remarks(folder) == [("attitude_prior", "attitude-convention")]


def test_time_zero_an_hour_off(folder):
    edit(folder, ("12:52:00", "13:52:00"))
    edit(folder, ("t_s = 300.0", "t_s = 3900.0"))
    found = check_folder(folder).cross_checks
    assert [f.source for f in found] == ["wallops_island", "wallops_mainland", "attitude_prior"]
    assert {f.code for f in found} == {"time-not-covered"}
    assert "1 h" in found[0].what


def test_inertial_sensors_beside_ballistic_motion(folder):
    with (folder / "flight.toml").open("a") as text:
        text.write('\n[motion]\nmodel = "ballistic"\ndrag_area_per_mass_m2pkg = 0.006\n')
    assert [f.code for f in check_folder(folder).findings if f.source == "motion"] == ["inertial-unused"]


# what the readers see


def test_gap_duplicates_out_of_order_frozen_and_saturated(folder):
    def spoil(t):
        t = pd.concat([t.iloc[:2000], t.iloc[2400:]], ignore_index=True)  # a gap of 2 s
        t.loc[5000:5200, "AX (g)"] = t.loc[5000, "AX (g)"]  # frozen for a second
        t.loc[8000:8006, "AY (g)"] = 25.0  # at a stop
        t = pd.concat([t.iloc[:9000], t.iloc[8990:]], ignore_index=True)  # ten rows again
        rows = list(range(len(t)))
        rows[12000], rows[12001] = rows[12001], rows[12000]
        return t.iloc[rows]

    change(folder, "suba_accel.csv", spoil)
    found = [(f.code, f.what) for f in check_folder(folder).findings if f.source == "accelerometer"]
    planted = {"data-gap": "2.0", "data-frozen": "ax", "data-saturated": "ay", "rows-left-out": "10 "}
    planted["rows-reordered"] = ""
    for code, value in planted.items():
        assert any(code == own and value in words for own, words in found), found


# the command


@pytest.mark.parametrize("radar", ["WALLOPS_MAINLAND_TWO", "a_name_of_nearly_as_many_letters_as_a_name_may_have_64"])
def test_sensors_names_are_shown_whole(radar, monkeypatch, capsys):
    fact = Fact(radar, f"telemetry/{radar}_and_more.csv", 2300, 300.0, 530.0, 10.0, 0)
    for width in (80, folder_check.WIDE):
        screen = Console(soft_wrap=True, width=width, color_system=None)
        monkeypatch.setattr(folder_check, "console", screen)
        folder_check.print_report(Report(facts=[fact]))
        rows = [line.split("│")[1].strip() for line in capsys.readouterr().out.splitlines() if "│" in line]
        assert "".join(rows) == radar


def test_json_is_whole_and_exit_code_0(folder):
    result = CliRunner().invoke(cli, ["check", str(folder), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert {f["source"] for f in found["facts"]} == {"accelerometer", "rates", "wallops_island", "wallops_mainland"}
    assert found["facts"][0]["rate_hz"] == pytest.approx(200.0, rel=1e-3)
    assert found["cross_checks"] == found["oddities"] == found["refused"] == []
    assert {f["code"] for f in found["findings"]} == {f.code for f in check_folder(folder).findings}


def test_json_and_screen_give_the_code_of_each_remark(folder):
    edit(folder, ("latitude_deg = 37.8410", "latitude_deg = 38.8410"))
    result = CliRunner().invoke(cli, ["check", str(folder), "--json"])
    assert result.exit_code == 0
    rows = json.loads(result.stdout)["cross_checks"]
    assert rows
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)+", row["code"]) for row in rows)
    screen = CliRunner().invoke(cli, ["check", str(folder)]).stdout
    assert all(f"[{row['code']}]" in screen for row in rows)


def test_report_as_a_table_has_a_row_for_each_finding_and_refusal(folder):
    change(folder, ISLAND, lambda t: t.drop(columns="EL (deg)"))
    report = check_folder(folder)
    assert report.to_frame()["kind"].tolist() == ["found"] * len(report.findings) + ["refused"]
    assert numbers_in(repr(report))[-2:] == [len(report.findings), 1.0]
    edit(folder, ("37.8410", '"FILL IN"'))
    assert check_folder(folder).to_frame()["code"].tolist() == ["placeholder"]


def test_what_cannot_be_read_is_refused_beside_what_can(folder):
    change(folder, ISLAND, lambda t: t.drop(columns="EL (deg)"))
    result = CliRunner().invoke(cli, ["check", str(folder), "--json"])
    assert result.exit_code == 3
    found = json.loads(result.stdout)
    assert found["refused_codes"] == ["column-missing"]
    assert "'EL (deg)'" in found["refused"][0]
    assert {f["source"] for f in found["facts"]} == {"accelerometer", "rates", "wallops_mainland"}


def test_folder_without_flight_toml_is_refused(tmp_path):
    result = CliRunner().invoke(cli, ["check", str(tmp_path), "--json"])
    assert result.exit_code == 2
    assert json.loads(result.stdout)["refused_codes"] == ["file-missing"]


def test_a_film_that_stands_still_is_named_with_its_span(tmp_path):
    """Eight noisy frames, of which the third stands for 1 s, and the last two are alike as by a changed frame rate."""
    rng, camera = np.random.default_rng(0), read_vehicle("irve2_reference").cameras["camera5"]
    seen = [rng.integers(0, 255, camera.size_px[::-1], dtype=np.uint8) for _ in range(5)]
    paths = []
    for k, which in enumerate([0, 1, 2, 2, 2, 3, 4, 4]):
        paths.append(tmp_path / f"{k}.png")
        cv2.imwrite(str(paths[-1]), seen[which])
    film = Frames(camera, "camera5", np.arange(8) * 0.5, tuple(paths), 0.0)
    (only,) = frozen_films(SimpleNamespace(films={"frames": film}))
    assert (only.source, only.code, only.start_s, only.end_s) == ("frames", "frame-frozen", 1.0, 2.0)
    (tmp_path / "3.png").write_bytes(b"no picture")
    assert frozen_films(SimpleNamespace(films={"frames": film})) == []

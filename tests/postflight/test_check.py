"""`postflight check`: nothing odd is said of flights that are right, and every planted fault is said, with its time."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from rich.console import Console

from postflight.checks import folder_check
from postflight.checks.folder_check import Fact, Report, check_folder
from postflight.cli import cli

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


def oddities(folder):
    return [f"{f.source}: {f.what}" for f in check_folder(folder).oddities]


def said(folder, *words):
    found = oddities(folder)
    assert any(all(w in line for w in words) for line in found), found
    return found


# flights that are right


def test_package_as_delivered_has_nothing_odd():
    report = check_folder(PACKAGE)
    assert not report.oddities
    assert report.exit_code == 0
    assert {f.what for f in report.findings} >= {"gap of 0.460 s", "gap of 4.100 s"}
    # each radar's clock is told to better than 0.2 s, and right
    clocks = [c for c in report.clocks if c.against == "accelerometer"]
    assert len(clocks) == 2
    assert all(c.sd_s < 0.2 and abs(c.late_s) < 3 * c.sd_s for c in clocks)


@needs_data
@pytest.mark.parametrize("name", sorted(p.name for p in REAL_FLIGHTS.iterdir()))
def test_recorded_flights_as_described_have_nothing_odd(name, tmp_path):
    tables = REAL_FLIGHTS / name if any((REAL_FLIGHTS / name).glob("*.csv")) else Path(str(REAL)) / name
    for path in (REAL_FLIGHTS / name / "flight.toml", *tables.glob("*.csv")):
        shutil.copy(path, tmp_path)
    assert not oddities(tmp_path)


# planted faults of units


def test_accelerometer_in_g_read_as_metres(folder):
    edit(folder, ('unit = "g"', 'unit = "mps2"'))
    found = said(folder, "accelerometer", "'mps2'", "look like 'g'")
    assert len(found) == 1


def test_accelerometer_in_feet_read_as_metres(folder):
    edit(folder, ('unit = "g"', 'unit = "mps2"'))
    change(folder, "suba_accel.csv", lambda t: t.assign(**{c: t[c] * 32.174 for c in t.columns[1:]}))
    assert len(said(folder, "accelerometer", "look like 'ftps2'")) == 1


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("ft", 1.0), ("m", 0.9144e-3)])
def test_range_in_another_unit(folder, unit, factor):
    edit(folder, ('column = "RANGE (yd)", unit = "yd"', f'column = "RANGE (yd)", unit = "{unit}"'))
    change(folder, ISLAND, lambda t: t.assign(**{"RANGE (yd)": t["RANGE (yd)"] * factor}))
    found = said(folder, "wallops_island", "does not fall as the Earth pulls")
    if factor == 1.0:
        said(folder, "wallops_island", "range in 'yd' instead of")
        said(folder, "wallops_mainland", "range in 'yd' instead of")
    else:
        assert "range in 'km' instead of 'm'" in found[0]


def test_angles_in_radians_read_as_degrees(folder):
    change(folder, ISLAND, lambda t: t.assign(**{c: np.deg2rad(t[c]) for c in ("AZ (deg)", "EL (deg)")}))
    assert len(said(folder, "wallops_island", "az in 'rad' instead of 'deg'", "el in 'rad'")) == 1


def test_azimuth_and_elevation_exchanged(folder):
    change(folder, ISLAND, lambda t: t.rename(columns={"AZ (deg)": "EL (deg)", "EL (deg)": "AZ (deg)"}))
    report = check_folder(folder)
    words = [f.what for f in report.oddities] + report.refused
    assert any("exchanged" in w or "no elevation" in w for w in words), words


def test_rates_in_degrees_read_as_radians(folder):
    edit(folder, ('unit = "degps"', 'unit = "radps"'))
    assert len(said(folder, "rates", "whirl the accelerometer", "look like 'degps'")) == 1


# planted faults of axes


def test_accelerometer_axes_in_another_order(folder):
    edit(
        folder,
        ('column = "AX (g)"', 'column = "TMP"'),
        ('column = "AZ (g)"', 'column = "AX (g)"'),
        ('"TMP"', '"AZ (g)"'),
    )
    said(folder, "accelerometer", "the drag on the way down is read mostly along the sensor's +x")


def test_accelerometer_of_the_other_sign(folder):
    change(folder, "suba_accel.csv", lambda t: t.assign(**{c: -t[c] for c in t.columns[1:]}))
    said(folder, "accelerometer", "[1.00,")


def test_roll_and_pitch_rates_exchanged(folder):
    edit(folder, ("ROLL RATE", "TMP"), ("PITCH RATE", "ROLL RATE"), ("TMP", "PITCH RATE"))
    said(folder, "rates", "turn the force")


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
    assert len(said(folder, "baro", "taken as 'm', it looks like 'ft'")) == 1


@needs_data
class TestRecorded:
    def test_accelerometer_reads_one_where_it_stands_still(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        path = folder / "adis16405.csv"
        table = pd.read_csv(path)
        table.assign(**{f"a{a}_mps2": table[f"a{a}_mps2"] / 9.80665 for a in "xyz"}).to_csv(path, index=False)
        assert len(said(folder, "accelerometer", "where it stands still", "look like 'g'")) == 1

    def test_receiver_climbs_downward(self, tmp_path):
        folder = recorded("navego_synthetic", tmp_path)
        path = folder / "gnss.csv"
        table = pd.read_csv(path)
        table.assign(vd_mps=-table["vd_mps"]).to_csv(path, index=False)
        assert not oddities(folder), "a car's climb tells nothing against the fixes' noise"
        table.assign(vn_mps=-table["vn_mps"]).to_csv(path, index=False)
        assert len(said(folder, "receiver", "the other way", "north")) == 1

    def test_receiver_in_knots(self, tmp_path):
        folder = recorded("navego_synthetic", tmp_path)
        text = "".join(f'v{a} = {{ column = "v{a}_mps", unit = "kt" }}\n' for a in "ned")
        edit(folder, ("[gnss.receiver.columns]\n", f"[gnss.receiver.columns]\n{text}"))
        assert len(said(folder, "receiver", "taken as 'kt', they look like 'mps'")) == 1

    def test_magnetometer_a_decade_off(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        edit(folder, ('column = "mx_T", unit = "t"', 'column = "mx_T", unit = "gauss"'))
        edit(folder, ('column = "my_T", unit = "t"', 'column = "my_T", unit = "gauss"'))
        edit(folder, ('column = "mz_T", unit = "t"', 'column = "mz_T", unit = "gauss"'))
        assert len(said(folder, "magnetometer", "looks like 't'")) == 1

    @pytest.mark.parametrize("axes", ['["+y", "-x", "+z"]', '["-x", "-y", "+z"]'])
    def test_gyros_along_other_axes(self, tmp_path, axes):
        folder = recorded("psas_l12", tmp_path)
        text = (folder / "flight.toml").read_text()
        head, tail = text.split("[sensors.rates]")
        (folder / "flight.toml").write_text(head + "[sensors.rates]" + tail.replace('["+x", "+y", "+z"]', axes, 1))
        said(folder, "rates", "as no vehicle does")

    def test_rates_in_degrees_read_as_radians(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        edit(folder, ('unit = "degps"', 'unit = "radps"'))
        report = check_folder(folder)
        assert any("taken as 'radps', they look like 'degps'" in f.what for f in report.oddities), report.oddities

    def test_magnetometer_late(self, tmp_path):
        folder = recorded("psas_l12", tmp_path)
        edit(folder, ("reversed = true", "reversed = true\ntime = { offset_s = 0.2 }"))
        (odd,) = check_folder(folder).oddities
        assert odd.source == "magnetometer"
        assert "later than the rates's by 0.2" in odd.what


# planted faults of clocks


@pytest.mark.parametrize("late_s", [-1.0, 1.2])
def test_accelerometer_and_gyros_late(folder, late_s):
    edit(folder, ('time = { column = "TPLUS (s)" }', f'time = {{ column = "TPLUS (s)", offset_s = {late_s} }}'))
    report = check_folder(folder)
    odd = [f for f in report.oddities if "accelerometer's by" in f.what]
    assert {f.source for f in odd} == {"wallops_island", "wallops_mainland"}
    for clock in report.clocks:
        if clock.against == "accelerometer":
            assert abs(clock.late_s + late_s) < 3.5 * clock.sd_s


def test_one_radar_late(folder):
    head, tail = (
        'format = "irig_doy" }\nlatitude_deg = 37.8410',
        'format = "irig_doy", offset_s = 0.4 }\nlatitude_deg = 37.8410',
    )
    edit(folder, (head, tail))
    report = check_folder(folder)
    pair = next(c for c in report.clocks if {c.source, c.against} == {"wallops_island", "wallops_mainland"})
    sign = 1.0 if pair.source == "wallops_island" else -1.0
    assert abs(sign * pair.late_s - 0.4) < 3 * pair.sd_s
    said(folder, "wallops_mainland", "earlier than wallops_island")


def test_radar_at_another_site(folder):
    edit(folder, ("latitude_deg = 37.8410", "latitude_deg = 38.8410"))
    said(folder, "wallops_mainland", "km from where wallops_island has it")


# the start


def test_attitude_with_the_scalar_last_and_turned_the_other_way(folder):
    q = "[0.41731, -0.53156, -0.11720, 0.72771]"
    edit(folder, (q, "[-0.53156, -0.11720, 0.72771, 0.41731]"))
    found = said(folder, "attitude_prior", "away from where the track has it", "with the scalar last")
    assert len(found) == 1
    edit(folder, ("[-0.53156, -0.11720, 0.72771, 0.41731]", "[0.41731, 0.53156, 0.11720, -0.72771]"))
    said(folder, "attitude_prior", "as from ECEF to body")


def test_time_zero_an_hour_off(folder):
    edit(folder, ("12:52:00", "13:52:00"))
    edit(folder, ("t_s = 300.0", "t_s = 3900.0"))
    found = said(folder, "wallops_island", "lies beside the accelerometer's time", "Moved by 1 h (a time zone?)")
    assert [line.split(":")[0] for line in found] == ["wallops_island", "wallops_mainland", "attitude_prior"]


def test_inertial_sensors_beside_ballistic_motion(folder):
    with (folder / "flight.toml").open("a") as text:
        text.write('\n[motion]\nmodel = "ballistic"\ndrag_area_per_mass_m2pkg = 0.006\n')
    assert any("are not used" in f.what for f in check_folder(folder).findings if f.source == "motion")


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
    words = "\n".join(str(f) for f in check_folder(folder).findings if f.source == "accelerometer")
    for what in ("gap of 2.0", "ax frozen", "ay saturated", "10 rows", "out of order"):
        assert what in words, words


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
    assert not found["oddities"]


def test_what_cannot_be_read_is_said_beside_what_can(folder):
    change(folder, ISLAND, lambda t: t.drop(columns="EL (deg)"))
    result = CliRunner().invoke(cli, ["check", str(folder), "--json"])
    assert result.exit_code == 3
    found = json.loads(result.stdout)
    assert "no column 'EL (deg)'" in found["refused"][0]
    assert {f["source"] for f in found["facts"]} == {"accelerometer", "rates", "wallops_mainland"}


def test_folder_without_flight_toml_is_refused(tmp_path):
    result = CliRunner().invoke(cli, ["check", str(tmp_path)])
    assert result.exit_code == 2
    assert "no such file" in result.stdout

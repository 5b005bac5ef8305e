"""`postflight import` of a delivery: accelerometers however named, video, coefficients, placeholders."""

import json
import re
import shutil
import tomllib

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from flightmodel.checks import ConfigError, GateError
from flightmodel.flightfolder import FlightFile
from flightmodel.vehicle import DATA, vehicle_from_toml, vehicle_path
from postflight.cli import cli
from tests.refusing import numbers_in, printed_codes

N = 60
T = np.arange(N) * 0.1


def run(*arguments):
    result = CliRunner().invoke(cli, [str(a) for a in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def read(folder):
    return tomllib.loads((folder / "flight.toml").read_text())


@pytest.fixture
def folder(tmp_path):
    run("init", tmp_path / "flight", "--vehicle", "form")
    return tmp_path / "flight"


def triad(path, names, size=1.0):
    values = size * np.random.default_rng(3).normal(size=(N, 3))
    pd.DataFrame(np.column_stack([T, values]), columns=["t_s", *names]).to_csv(path, index=False)
    return path


def radar(path):
    pd.DataFrame({"t_s": T, "range_m": 1e5 - T, "az_deg": 90.0, "el_deg": 30.0}).to_csv(path, index=False)
    return path


@pytest.mark.parametrize(
    ("form", "unit"),
    [
        ("SUBA_{} (g)", "g"),
        ("SUBA_{} [G]", "g"),
        ("Accel {} [m/s^2]", "mps2"),
        ("A{}_G", "g"),
        ("N{} (g)", "g"),
        ("ACC_{}", "FILL IN"),
        ("IMU_ACC_{}_MPS2", "mps2"),
        ("{}ACCEL_G", "g"),
        ("accel-{}, g", "g"),
        ("LinAcc.{} (m s^-2)", "mps2"),
        ("Body {} Accel (G's)", "g"),
        ("ACCEL1{} (mg)", "mg"),
    ],
)
def test_accelerometers_however_they_are_named(form, unit, folder, tmp_path):
    run("import", triad(tmp_path / "a.csv", [form.format(a) for a in "XYZ"]), "--into", folder)
    found = read(folder)["sensors"]["accelerometer"]["columns"]
    assert [found[f"a{a}"] for a in "xyz"] == [{"column": form.format(a.upper()), "unit": unit} for a in "xyz"]


@pytest.mark.parametrize(("form", "size"), [("H{} [G]", 0.3), ("SUBA_{} [G]", 0.3), ("P{}", 1.0)])
def test_fields_in_gauss_and_threes_of_nothing_are_no_accelerometer(form, size, folder, tmp_path):
    run("import", triad(tmp_path / "a.csv", [form.format(a) for a in "XYZ"], size), "--into", folder)
    assert "accelerometer" not in read(folder).get("sensors", {})


def test_ballistic_is_proposed_only_where_no_column_may_be_an_accelerometer(folder, tmp_path):
    run("import", radar(tmp_path / "radar.csv"), triad(tmp_path / "suba.csv", ["QX", "QY", "QZ"]), "--into", folder)
    assert "motion" not in read(folder)
    assert "# QUESTION: suba " in (folder / "flight.toml").read_text()
    run("init", tmp_path / "other", "--vehicle", "form")
    run("import", tmp_path / "radar.csv", "--into", tmp_path / "other")
    assert read(tmp_path / "other")["motion"]["model"] == "ballistic"
    later = [
        triad(tmp_path / "acc.csv", ["ax_g", "ay_g", "az_g"]),
        triad(tmp_path / "w.csv", ["p_dps", "q_dps", "r_dps"]),
    ]
    run("import", *later, "--into", tmp_path / "other")
    text = (tmp_path / "other" / "flight.toml").read_text()
    assert "# QUESTION: [motion] " in text
    assert "attitude_prior" in read(tmp_path / "other")


def test_gyros_without_an_accelerometer_leave_it_missing_and_propose_no_motion(folder, tmp_path):
    rates = triad(tmp_path / "gyro.csv", ["p (deg/s)", "q (deg/s)", "r (deg/s)"])
    run("import", radar(tmp_path / "radar.csv"), rates, "--into", folder)
    assert "motion" not in read(folder)
    assert "# QUESTION: the accelerometer is missing" in (folder / "flight.toml").read_text()


def one_logger(path, time, times):
    """A table of five sources with one column of times."""
    rng = np.random.default_rng(3)
    names = [*(f"A{a} [g]" for a in "XYZ"), *(f"{a} (deg/s)" for a in "pqr"), *(f"Mag{a} (uT)" for a in "XYZ")]
    table = pd.DataFrame(rng.normal(size=(N, 9)), columns=names).assign(**{"alt baro (m)": 1e3 - T, time: times})
    table.assign(lat_deg=37.0 + T / 1e3, lon_deg=-75.0, **{"gps height (m)": 1e3 - T}).to_csv(path, index=False)
    return path


def test_the_unit_of_one_column_of_times_is_asked_once(folder, tmp_path):
    run("import", one_logger(tmp_path / "log.csv", "time", np.arange(N)), "--into", folder)
    found = read(folder)
    entries = {f"{g}.{k}": e for g in ("sensors", "gnss", "barometers") for k, e in found.get(g, {}).items()}
    times = [entry["time"] for entry in entries.values()]
    assert len(times) >= 4
    (asked,) = [time for time in times if isinstance(time, dict)]
    assert asked["unit"] == "FILL IN"
    assert {time for time in times if time is not asked} == {next(k for k, e in entries.items() if e["time"] is asked)}
    asked["unit"] = "ms"
    filled = json.loads(json.dumps(found).replace('"FILL IN"', '"ellipsoid"'))
    filled |= {"name": "x", "t0_utc": "2020-01-01T00:00:00Z", "attitude_prior": None}
    for mounted in filled["sensors"].values():
        mounted.pop("mount", None)
    read_back = FlightFile.model_validate(filled)
    assert {source.time.unit for source in read_back.sources} == {"ms"}


@pytest.mark.parametrize("name", ["SOD", "SOD (s)", "seconds of day", "time_of_day (s)"])
def test_seconds_of_day_become_hour_minute_and_second(name, folder, tmp_path):
    """From 20 s before midnight: the reader counts on into the next day."""
    seconds = 86380.0 + 1.25 * np.arange(N)
    path = one_logger(tmp_path / "log.csv", name, np.where(seconds < 86400.0, seconds, seconds - 86400.0))
    run("import", path, "--into", folder)
    times = {json.dumps(entry["time"]) for entry in read(folder)["sensors"].values()}
    ((time,),) = [[json.loads(text) for text in times]]
    assert time["format"] == "utc_hms"
    table = pd.read_csv(folder / "telemetry" / "log.csv")
    h, m, s = (table[column] for column in time["columns"])
    np.testing.assert_allclose((3600.0 * h + 60.0 * m + s - seconds) % 86400.0, 0.0, atol=1e-9)


# video


def film_folder(path, count=5):
    path.mkdir()
    for k in range(count):
        cv2.imwrite(str(path / f"frame_{k:03d}.png"), np.full((8, 8), k, np.uint8))
    return path


def frames_csv(path, names, column="frame"):
    pd.DataFrame({"t_s": 421.0 + 0.5 * np.arange(len(names)), column: names}).to_csv(path, index=False)
    return path


def test_pictures_and_their_list_become_frames(folder, tmp_path):
    pictures = film_folder(tmp_path / "CAM 5")
    names = [f"CAM 5/{p.name}" for p in sorted(pictures.iterdir())]
    out = run("import", pictures, frames_csv(tmp_path / "times.csv", names, "file"), "--into", folder)
    assert out.exit_code == 0
    found = read(folder)["frames"]
    assert found == {
        "file": "telemetry/times.csv", "folder": "telemetry/CAM_5", "camera": "FILL IN", "benchmark_s": "FILL IN",
    }  # fmt: skip
    for picture in pictures.iterdir():
        assert (folder / "telemetry" / "CAM_5" / picture.name).read_bytes() == picture.read_bytes()
    listed = pd.read_csv(folder / "telemetry" / "times.csv")
    assert listed["frame"].tolist() == sorted(p.name for p in pictures.iterdir())
    (line,) = [line for line in (folder / "flight.toml").read_text().splitlines() if line.startswith("benchmark_s")]
    assert numbers_in(line) == [421.0, 423.0]
    with pytest.raises(ConfigError) as refusal:
        run("import", pictures, "--into", folder)
    assert refusal.value.codes == ("file-exists",)


def test_list_after_pictures_a_film_and_the_only_camera(tmp_path):
    folder = tmp_path / "flight"
    run("init", folder, "--vehicle", "irve2_reference")
    run("import", film_folder(tmp_path / "cam"), "--into", folder)
    assert re.search(r"# QUESTION: telemetry/cam\b.*\b5\b", (folder / "flight.toml").read_text())
    run("import", frames_csv(tmp_path / "t.csv", [f"frame_{k:03d}.png" for k in range(5)]), "--into", folder)
    frames = read(folder)["frames"]
    assert (frames["folder"], frames["camera"]) == ("telemetry/cam", "FILL IN")
    assert re.search(r"\ncamera = .*\bcamera5_uncalibrated, camera5\b", (folder / "flight.toml").read_text())
    run("init", tmp_path / "b", "--vehicle", "form")
    with (tmp_path / "b" / "vehicle" / "vehicle.toml").open("a") as form:
        form.write("\n[cameras.aft]\n")
    (tmp_path / "onboard.webm").write_bytes(b"\x1aE\xdf\xa3 no matter")
    run("import", tmp_path / "onboard.webm", frames_csv(tmp_path / "n.csv", [0, 1, 2, 3]), "--into", tmp_path / "b")
    frames = read(tmp_path / "b")["frames"]
    assert (frames["film"], frames["camera"]) == ("telemetry/onboard.webm", "aft")
    assert (tmp_path / "b" / "telemetry" / "onboard.webm").read_bytes() == b"\x1aE\xdf\xa3 no matter"


def test_what_is_no_data_is_named_and_left_out(folder, tmp_path):
    delivery = tmp_path / "delivery"
    delivery.mkdir()
    (delivery / "notes").mkdir()
    (delivery / "notes" / "a.txt").write_text("nothing")
    (delivery / "MEMO.txt").write_text("Launch at noon\n")
    (film_folder(delivery / "cam") / "index.txt").write_text("x")
    radar(delivery / "radar.csv")
    out = run("import", *sorted(delivery.iterdir()), "--into", folder).output
    left_out = [(code, line) for line in out.splitlines() for code in printed_codes(line)]
    assert len(left_out) == 3
    for name, code in (
        ("notes", "nothing-to-import"),
        ("MEMO.txt", "file-unreadable"),
        ("index.txt", "nothing-to-import"),
    ):
        assert any(code == named and name in line for named, line in left_out)
    assert sorted(p.name for p in (folder / "telemetry").iterdir()) == ["cam", "radar.csv"]
    assert sorted(p.suffix for p in (folder / "telemetry" / "cam").iterdir()) == [".png"] * 5
    with pytest.raises(GateError) as refusal:
        run("import", delivery / "MEMO.txt", "--into", folder)
    assert refusal.value.codes == ("file-unreadable",)
    with pytest.raises(GateError) as refusal:
        run("import", delivery / "notes", "--into", folder)
    assert refusal.value.codes == ("nothing-to-import",)


# coefficients


def shipped_table(path, header):
    source = vehicle_path("irve2_reference").parents[1] / "aerodynamics" / "irve2_reference.csv"
    lines = [line for line in source.read_text().splitlines() if not line.startswith("#")]
    path.write_text("\n".join([header, *lines[1:]]) + "\n")
    return path


def test_coefficients_go_beside_the_vehicle_with_a_form_of_their_sidecar(folder, tmp_path):
    table = shipped_table(tmp_path / "AERO 1.csv", "Mach,Alpha_deg,CA,CN,Cm_nose,Cmq")
    out = run("import", table, "--into", folder).output
    assert "vehicle.toml" in out
    assert "[aerodynamics.sphere_cone]" not in out  # which by hand would have to go
    assert not list((folder / "telemetry").iterdir())
    vehicle = tomllib.loads((folder / "vehicle" / "vehicle.toml").read_text())
    assert vehicle["aerodynamics"] == {"table": "AERO_1.csv"}
    sidecar = tomllib.loads((folder / "vehicle" / "AERO_1.toml").read_text())
    assert sidecar["moment_reference_station_m"] == 0.0
    left = json.loads(run("check", folder, "--json").output)["fill_in"]
    assert [w.split("'")[1] for w in left if "AERO_1.toml" in w] == ["source", "licence", "area_m2", "length_m"]
    # filled in, it is the shipped vehicle's
    text = (folder / "vehicle" / "AERO_1.toml").read_text()
    for key, value in (("source", '"x"'), ("licence", '"x"'), ("area_m2", "7.0686"), ("length_m", "3.0")):
        text = text.replace(f'{key} = "FILL IN"', f"{key} = {value}")
    (folder / "vehicle" / "AERO_1.toml").write_text(text)
    shipped = vehicle_path("irve2_reference")
    (folder / "vehicle" / "own.toml").write_text(shipped.read_text().replace("irve2_reference.csv", "AERO_1.csv"))
    own = vehicle_from_toml(folder / "vehicle" / "own.toml")
    np.testing.assert_allclose(own.aero.coefficients, vehicle_from_toml(shipped).aero.coefficients, rtol=1e-12)


def test_a_vehicle_file_comes_with_its_table_and_is_named(tmp_path):
    """Delivered side by side, as `*.toml *.csv`: the table is the vehicle's, no other one's."""
    flight, own = tmp_path / "flight", tmp_path / "ours.toml"
    text = vehicle_path("irve2_reference").read_text()
    own.write_text(text.replace('table = "irve2_reference.csv"', 'table = "coefficients.csv"'))
    delivered = [own, tmp_path / "coefficients.csv", tmp_path / "coefficients.toml"]
    for path in delivered[1:]:
        shutil.copyfile(DATA / "aerodynamics" / f"irve2_reference{path.suffix}", path)
    (tmp_path / "other.toml").write_text("x = 1")
    run("init", flight)
    done = run("import", *delivered, tmp_path / "other.toml", "--into", flight)
    assert done.exit_code == 3
    assert "left out" in done.output
    assert printed_codes(done.output) == ["key-missing"]
    assert read(flight)["vehicle"] == "vehicle/ours.toml"
    assert all((flight / "vehicle" / path.name).read_bytes() == path.read_bytes() for path in delivered)
    assert not list((flight / "telemetry").iterdir())


def test_two_coefficient_tables_of_one_name_are_refused(folder, tmp_path):
    tables = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        tables.append(shipped_table(tmp_path / name / "aero.csv", "Mach,Alpha_deg,CA,CN,Cm_nose,Cmq"))
    before = sorted(folder.rglob("*"))
    with pytest.raises(ConfigError) as refusal:
        run("import", *tables, "--into", folder)
    assert refusal.value.codes == ("file-exists",)
    assert sorted(folder.rglob("*")) == before


def test_a_vehicle_file_that_was_filled_in_is_left_as_it_is(folder, tmp_path):
    path = folder / "vehicle" / "vehicle.toml"
    path.write_text(path.read_text().replace('half_angle_deg = "FILL IN"', "half_angle_deg = 60.0", 1))
    before = path.read_text()
    out = run("import", shipped_table(tmp_path / "vehicle.csv", "mach,aoa,CD,CL,CM,CMQ"), "--into", folder).output
    assert path.read_text() == before
    assert 'write  [aerodynamics]  table = "vehicle_coefficients.csv"' in out
    assert tomllib.loads((folder / "vehicle" / "vehicle_coefficients.toml").read_text())["axes"] == "wind"


# placeholders


def test_import_and_check_count_the_same_values(folder, tmp_path):
    shutil.copy(radar(tmp_path / "radar.csv"), tmp_path / "second.csv")
    out = run("import", tmp_path / "radar.csv", tmp_path / "second.csv", "--into", folder).output
    checked = json.loads(run("check", folder, "--json").output)
    assert re.search(rf"^{len(checked['fill_in'])} values", out, re.MULTILINE)
    keys = [w.split("'")[1] for w in checked["fill_in"]]
    assert {"name", "radars.second.height_m", "motion.drag_area_per_mass_m2pkg", "joint.station_m"} <= set(keys)
    assert all(key in out for key in keys)


def test_a_film_that_is_none_is_refused_before_it_is_copied(folder, tmp_path):
    (tmp_path / "film.mp4").write_text("a line of text\n" * 9)
    (tmp_path / "none.webm").touch()
    with pytest.raises(GateError) as refusal:
        run("import", tmp_path / "film.mp4", tmp_path / "none.webm", "--into", folder)
    assert refusal.value.codes == ("file-unreadable", "file-unreadable")
    assert not list((folder / "telemetry").glob("*"))

"""`postflight import`: tables in any layout come in with the same numbers, and what is unclear is asked."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from flightmodel.checks import ConfigError, GateError
from flightmodel.flightfolder import read_flight, read_sources
from flightmodel.units import read_unit
from postflight.cli import cli

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "examples" / "range_package_01" / "telemetry"
ANSWERS = {
    "name": '"renamed"',
    "t0_utc": '"2009-08-17T12:52:00Z"',
    "latitude_deg": "37.841",
    "longitude_deg": "-75.485",
    "height_m": "12.0",
    "mount": '"suba"',
    "t_s": "300.0",
    "azimuth_deg": "0.0",
    "elevation_deg": "0.0",
    "roll_deg": "0.0",
    "drag_area_per_mass_m2pkg": "0.006",
}


def run(*arguments):
    result = CliRunner().invoke(cli, [str(a) for a in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture
def folder(tmp_path):
    run("init", tmp_path / "flight", "--vehicle", "irve2_reference")
    return tmp_path / "flight"


def text_of(folder):
    return (folder / "flight.toml").read_text()


def answer(folder, **more):
    """Fill in what is left by its key; what has no answer stays."""
    answers = ANSWERS | more
    text = re.sub(
        r'(?m)^(\w+) = "FILL IN"', lambda m: f"{m[1]} = {answers[m[1]]}" if m[1] in answers else m[0], text_of(folder)
    )
    (folder / "flight.toml").write_text(text)


@pytest.fixture(scope="module")
def original():
    return read_sources(ROOT / "examples" / "range_package_01")


@pytest.fixture(scope="module")
def tables():
    """Seconds 436 to 446 of the package: radar, accelerometer and rates."""
    accel, rates = (pd.read_csv(PACKAGE / f"{n}.csv") for n in ("suba_accel", "rates"))
    radar = pd.read_csv(PACKAGE / "radar_wallops_island.csv")
    return accel.iloc[27200:29200], rates.iloc[27200:29200], radar.iloc[1300:1400]


def written(path, table, names=None, units=None, sep=",", decimal=".", preface="", encoding="utf-8", comment=""):
    table = table.copy()
    table.columns = names or list(table.columns)
    body = table.to_csv(index=False, header=False, sep=sep, decimal=decimal, lineterminator="\n")
    head = comment + sep.join(table.columns) + "\n" + (sep.join(units) + "\n" if units else "")
    path.write_bytes((preface + head + body).encode(encoding))
    return path


STYLES = {
    "as delivered": {},
    "underscores": {
        "a": ["time_s", "acc_x_g", "acc_y_g", "acc_z_g"], "r": ["time_s", "w_x_deg_s", "w_y_deg_s", "w_z_deg_s"],
        "t": ["irig_time", "slant_range_yd", "azimuth_deg", "elevation_deg"],
    },
    "camel case and brackets": {
        "a": ["Time [s]", "AccX [g]", "AccY [g]", "AccZ [g]"],
        "r": ["Time [s]", "RollRate [°/s]", "PitchRate [°/s]", "YawRate [°/s]"],
        "t": ["GMT", "Slant Rng [yds]", "Azim [°]", "Elev [°]"],
    },
    "German, semicolons, decimal commas, Latin-1, a row of units": {
        "a": ["Zeit", "Beschl_x", "Beschl_y", "Beschl_z"], "au": ["s", "g", "g", "g"],
        "r": ["Zeit", "Drehrate_x", "Drehrate_y", "Drehrate_z"], "ru": ["s", "°/s", "°/s", "°/s"],
        "t": ["Zeit", "Entfernung", "Azimut", "Höhenwinkel"], "tu": ["", "yd", "°", "°"],
        "sep": ";", "decimal": ",", "encoding": "latin-1",
    },
    "tabs below a preface of comments, with a byte order mark": {
        "a": ["t", "ax", "ay", "az"], "au": ["(s)", "(g)", "(g)", "(g)"],
        "r": ["t", "wx", "wy", "wz"], "ru": ["s", "dps", "dps", "dps"],
        "t": ["irig", "rng", "az", "el"], "tu": ["-", "yd", "deg", "deg"],
        "sep": "\t", "preface": "# recorder 7, range 4\n# version 1.2, 3 channels\n\n", "encoding": "utf-8-sig",
    },
    "spaces below names in a comment": {
        "a": ["t/s", "ax/g", "ay/g", "az/g"], "r": ["t/s", "gyro_x/dps", "gyro_y/dps", "gyro_z/dps"],
        "t": ["IRIG", "RANGE/yd", "AZ/deg", "EL/deg"], "sep": " ", "comment": "% ",
    },
}  # fmt: skip


@pytest.mark.parametrize("style", list(STYLES))
def test_renamed_package_gives_the_same_numbers(style, folder, tables, original, tmp_path):
    s = STYLES[style]
    shared = {k: s[k] for k in ("sep", "decimal", "preface", "encoding", "comment") if k in s}
    files = [
        written(tmp_path / f"{name}.csv", table, s.get(key), s.get(f"{key}u"), **shared)
        for name, key, table in zip(("accel", "gyro", "radar_a"), "art", tables, strict=True)
    ]
    run("import", *files, "--into", folder)
    assert not re.findall(r'.*unit = "FILL IN".*', text_of(folder))
    answer(folder)
    # gyros that are named x, y, z ask for their mount, which is the body's here
    text = text_of(folder)
    head, mark, tail = text.rpartition("\n[sensors.rates]\n")
    (folder / "flight.toml").write_text(head + mark + tail.replace('mount = "suba"', 'mount = "body"', 1))
    flight = read_flight(folder)
    for name, record in (("accelerometer", flight.accelerometer), ("rates", flight.rates)):
        whole = original.triads[name]
        rows = np.searchsorted(whole.time_s, record.time_s)
        np.testing.assert_allclose(record.measured_sensor, whole.measured_sensor[rows], rtol=1e-12)
        np.testing.assert_array_equal(record.spec.dcm_body_sensor, whole.spec.dcm_body_sensor)
    (radar,) = flight.radars.values()
    rows = np.searchsorted(original.radars["wallops_island"].time_s, radar.time_s - 1e-6)
    np.testing.assert_allclose(radar.range_az_el, original.radars["wallops_island"].range_az_el[rows], rtol=1e-12)


def test_matlab_vectors_give_the_same_numbers(folder, tables, tmp_path):
    from scipy.io import savemat

    accel, _, radar = tables
    content = {"t_s": accel.iloc[:, 0].to_numpy()[:, None], "note": "flown", "single": 3.0}
    content |= {f"acc_{a}_g": accel.iloc[:, k].to_numpy() for k, a in enumerate("xyz", start=1)}
    savemat(tmp_path / "suba.mat", content)
    savemat(tmp_path / "radar.mat", {"track": {"time_s": np.arange(100) * 0.1, **dict(zip(
        ("range_yd", "az_deg", "el_deg"), radar.to_numpy()[:, 1:].T.astype(float), strict=True))}})  # fmt: skip
    out = run("import", tmp_path / "suba.mat", tmp_path / "radar.mat", "--into", folder)
    assert all(name in out.output for name in ("note", "single"))
    got = pd.read_csv(folder / "telemetry" / "suba.csv")
    np.testing.assert_array_equal(got.to_numpy(), accel.to_numpy())
    found = tomllib.loads(text_of(folder))
    assert found["sensors"]["accelerometer"]["columns"]["ax"] == {"column": "acc_x_g", "unit": "g"}
    assert found["radars"]["radar_track"]["columns"]["range"]["unit"] == "yd"


def test_matlab_73_is_read_or_refused_with_the_extra(folder, tables, tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    accel = tables[0]
    path = tmp_path / "new.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for k, name in enumerate(("t_s", "ax_g", "ay_g", "az_g")):
            file[name] = accel.iloc[:, k].to_numpy()[None, :]
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes()[512:])
    run("import", path, "--into", folder)
    got = pd.read_csv(folder / "telemetry" / "new.csv")
    np.testing.assert_array_equal(got[["t_s", "ax_g", "ay_g", "az_g"]].to_numpy(), accel.to_numpy())
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    path.rename(tmp_path / "again.mat")
    with pytest.raises(ConfigError) as refusal:
        run("import", tmp_path / "again.mat", "--into", folder)
    assert refusal.value.codes == ("package-missing",)
    assert "postflight[matlab]" in str(refusal.value)


# what is unclear is asked


def frame(n=400, dt=0.01, **columns):
    t = np.arange(n) * dt
    return pd.DataFrame({"t_s": t} | {k: v(t) if callable(v) else np.full(n, v) for k, v in columns.items()})


def test_units_that_numbers_cannot_tell_are_questions(folder, tmp_path):
    wave = lambda t: 0.3 * np.sin(t)  # noqa: E731
    frame(wx=wave, wy=wave, wz=wave).to_csv(tmp_path / "gyro.csv", index=False)
    frame(range=1e5, az=1.0, el=0.5).to_csv(tmp_path / "radar.csv", index=False)
    run("import", tmp_path / "gyro.csv", tmp_path / "radar.csv", "--into", folder)
    found = tomllib.loads(text_of(folder))
    assert all(c["unit"] == "FILL IN" for c in found["sensors"]["rates"]["columns"].values())
    assert all(c["unit"] == "FILL IN" for c in found["radars"]["radar"]["columns"].values())
    assert re.search(r"range = .*m, cm, mm, km, yd, ft", text_of(folder))  # the choices stand beside the question
    answer(folder)
    out = run("check", folder, "--json")
    assert out.exit_code == 2
    still_open = {words.split("'")[1] for words in json.loads(out.stdout)["fill_in"]}
    assert still_open >= {f"sensors.rates.columns.{short}.unit" for short in "pqr"}
    assert still_open >= {f"radars.radar.columns.{short}.unit" for short in ("range", "az", "el")}


@pytest.mark.parametrize(("level", "unit"), [(9.81, "mps2"), (1.001, "g"), (32.2, "ftps2"), (3.0, "FILL IN")])
def test_accelerometer_at_rest_tells_its_unit(folder, tmp_path, level, unit):
    frame(ax=level, ay=0.01 * level, az=0.0).to_csv(tmp_path / "imu.csv", index=False)
    run("import", tmp_path / "imu.csv", "--into", folder)
    assert tomllib.loads(text_of(folder))["sensors"]["accelerometer"]["columns"]["ax"]["unit"] == unit


def test_noise_of_each_fix_is_taken_by_its_canonical_name(folder, tmp_path):
    n = 50
    table = pd.DataFrame(
        {"t_s": np.arange(n) + 0.0, "lat_deg": 37.8, "lon_deg": -75.4, "alt_ell_m": 100.0 + np.arange(n)}
    )
    table.assign(horizontal_sd_m=np.linspace(2.0, 4.0, n), accuracy=3.0).to_csv(tmp_path / "gps.csv", index=False)
    result = run("import", tmp_path / "gps.csv", "--into", folder)
    assert "not used: accuracy" in " ".join(result.output.split())
    answer(folder)
    record = read_sources(folder).gnss["gps"]
    np.testing.assert_allclose(record.sd[:, 0], np.linspace(2.0, 4.0, n))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("utc_h", "utc_m", "utc_s"), {"format": "utc_hms", "columns": ["utc_h", "utc_m", "utc_s"]}),
        (("time_ms",), {"column": "time_ms", "unit": "ms"}),
        (("clock",), {"format": "utc_hms", "columns": ["clock_h", "clock_m", "clock_s"]}),
        (("timestamp",), {"format": "utc", "column": "timestamp_utc"}),
        (("iso",), {"format": "utc", "column": "iso"}),
        (("gps_tow_s",), {"column": "gps_tow_s", "offset_s": "FILL IN"}),
        (("time",), {"column": "time", "unit": "FILL IN"}),
    ],
)
def test_times_in_every_form(folder, tmp_path, names, expected):
    n = 50
    second = np.arange(n)
    stamps = pd.date_range("2009-08-17T12:52:00", periods=n, freq="s")
    columns = {
        "utc_h": 12, "utc_m": 52, "utc_s": second, "time_ms": 1000 * second, "clock": stamps.strftime("%H:%M:%S"),
        "timestamp": 1250513520 + second, "iso": stamps.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "gps_tow_s": 130000.5 + second, "time": second,
    }  # fmt: skip
    table = pd.DataFrame({k: columns[k] for k in names}, index=range(n))
    table.assign(lat_deg=37.8, lon_deg=-75.4, alt_ell_m=100.0 + second).to_csv(tmp_path / "gps.csv", index=False)
    run("import", tmp_path / "gps.csv", "--into", folder)
    found = tomllib.loads(text_of(folder))
    assert found["gnss"]["gps"]["time"] == expected
    assert found["gnss"]["gps"]["height_is"] == "ellipsoid"
    if "FILL IN" not in expected.values():
        answer(folder)
        record = read_sources(folder).gnss["gps"]
        assert np.diff(record.time_s) == pytest.approx(1.0, abs=1e-6)
        if names[0] not in ("time_ms",):
            assert record.time_s[0] == pytest.approx(0.0, abs=1e-6)


def test_two_of_one_sensor_are_a_question(folder, tmp_path):
    for name in ("one", "two"):
        frame(ax_g=1.0, ay_g=0.0, az_g=0.0).to_csv(tmp_path / f"{name}.csv", index=False)
    run("import", tmp_path / "one.csv", tmp_path / "two.csv", "--into", folder)
    assert re.search(r"# QUESTION: \[sensors\.accelerometer\]", text_of(folder))
    assert tomllib.loads(text_of(folder))["sensors"]["accelerometer"]["file"] == "telemetry/one.csv"


def test_nothing_is_overwritten_and_no_half_import_is_left(folder, tmp_path):
    frame(ax_g=1.0, ay_g=0.0, az_g=0.0).to_csv(tmp_path / "one.csv", index=False)
    (tmp_path / "bad.csv").write_text("nothing\nhere\n")
    before = text_of(folder)
    with pytest.raises(GateError) as refusal:
        run("import", tmp_path / "one.csv", tmp_path / "bad.csv", "--into", folder)
    assert refusal.value.codes == ("file-unreadable",)
    assert text_of(folder) == before
    assert not list((folder / "telemetry").iterdir())
    run("import", tmp_path / "one.csv", "--into", folder)
    with pytest.raises(ConfigError) as refusal:
        run("import", tmp_path / "one.csv", "--into", folder)
    assert refusal.value.codes == ("file-exists",)


def test_hostile_names_stay_text(folder, tmp_path):
    evil = 'ax"] \\ #[x] (g)'
    table = frame(**{evil: 1.0, "ay (g)": 0.0, "az (g)": 0.0})
    table.to_csv(tmp_path / "a.csv", index=False)
    before = tomllib.loads(text_of(folder))
    run("import", tmp_path / "a.csv", "--into", folder)
    found = tomllib.loads(text_of(folder))
    assert set(found) <= set(before) | {"sensors"}
    assert evil in pd.read_csv(folder / "telemetry" / "a.csv").columns


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"nothing\nhere\n", "file-unreadable"),
        (b"\0\1\2" * 50, "file-unreadable"),
        (None, "file-missing"),
    ],
)
def test_files_that_are_no_tables_are_refused_with_their_code(folder, tmp_path, content, code):
    if content is not None:
        (tmp_path / "bad.csv").write_bytes(content)
    with pytest.raises(GateError) as refusal:
        run("import", tmp_path / "bad.csv", "--into", folder)
    assert refusal.value.codes == (code,)


def test_damaged_matlab_files_and_folders_without_a_flight_are_refused_with_their_code(folder, tmp_path):
    (tmp_path / "bad.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(200))
    with pytest.raises(GateError) as refusal:
        run("import", tmp_path / "bad.mat", "--into", folder)
    assert refusal.value.codes == ("file-unreadable",)
    with pytest.raises(ConfigError) as refusal:
        run("import", tmp_path / "bad.mat", "--into", tmp_path / "elsewhere")
    assert refusal.value.codes == ("file-missing",)


# recorded flights, whose own flight.toml is the answer

REAL = __import__("os").environ.get("POSTFLIGHT_REALDATA")


@pytest.mark.realdata
@pytest.mark.skipif(REAL is None, reason="POSTFLIGHT_REALDATA names no folder of recorded flights")
@pytest.mark.parametrize(
    "name", ["psas_l12", "euroc21_piccard", "rocketpy_prometheus", "radar_36353", "navego_synthetic"]
)
def test_recorded_flights_are_recognised_as_their_flight_file_has_them(name, folder, tmp_path):
    answers = tomllib.loads((ROOT / "tests" / "data" / "real_flights" / name / "flight.toml").read_text())
    files = {
        s["file"] for group in ("sensors", "radars", "gnss", "barometers") for s in answers.get(group, {}).values()
    }
    for file in files:
        shutil.copy(Path(str(REAL)) / name / file, tmp_path)
    run("import", *(tmp_path / f for f in sorted(files)), "--into", folder)
    found = tomllib.loads(text_of(folder))
    for group in ("sensors", "radars", "gnss", "barometers"):
        kept = {Path(s["file"]).name: s for s in found.get(group, {}).values()}
        for key, wanted in answers.get(group, {}).items():
            got = found["sensors"].get(key) if group == "sensors" else kept.get(wanted["file"])
            assert got, (group, key)
            for short, column in wanted.get("columns", {}).items():
                asked = got.get("columns", {}).get(short, column)
                assert asked["column"] == column["column"], (key, short)
                assert asked["unit"] in (column["unit"], "FILL IN"), (key, short)
    # stands 4.5 s on its pad; the others burn, move or have no inertial unit
    assert ("start" in found) == (name == "psas_l12")


def test_a_rest_is_proposed(folder, tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(-6.0, 5.0, 0.02)
    fires = t > 0.0
    x = 9.8 + 0.05 * rng.standard_normal(len(t)) + 60.0 * fires
    rest = 0.04 * rng.standard_normal((5, len(t))) * (1.0 + 5.0 * fires)
    header = "t_s,ax_mps2,ay_mps2,az_mps2,gx_degps,gy_degps,gz_degps"
    np.savetxt(tmp_path / "imu.csv", np.column_stack([t, x, *rest]), delimiter=",", header=header, comments="")
    run("import", tmp_path / "imu.csv", "--into", folder)
    start, end = tomllib.loads(text_of(folder))["start"]["at_rest"]
    assert start == pytest.approx(-6.0, abs=0.01)
    assert -1.1 < end <= -0.4


def test_mangled_tables_are_read_or_refused_never_a_traceback(tmp_path):
    from postflight.intake.column_recognition import Recogniser, add_clock_columns
    from postflight.intake.deliveries import (
        Video,
        as_coefficients,
        coefficient_columns,
        frame_list,
        radiosonde_table,
        sidecar_text,
    )
    from postflight.intake.flight_form import section_text
    from postflight.intake.freeform_tables import read_text_table

    rng = np.random.default_rng(7)
    whole = [b"\n".join((PACKAGE / name).read_bytes().split(b"\n")[:30]) for name in ("rates.csv", "met_composite.csv")]
    whole.append(b"p_hpa,h_m,T_C,Td_C,from_deg,wind_mps\n" + b"1000,116,11.2,11,30,10.8\n925,764,8,8,30,16.4\n" * 8)
    whole.append(b"GMT,file,n\n" + b"".join(b"2009-08-17T12:52:%02dZ,cam/f_%03d.png,1\n" % (k, k) for k in range(20)))
    whole.append(b"Mach,AoA (deg),CA,CN,Cm_nose,Cmq\n" + b"0.5,0,1,0,0,-0.1\n0.5,90,1,0.1,-0.1,-0.1\n" * 6)
    video = Video(tmp_path, tmp_path / "cam", tuple(f"f_{k:03d}.png" for k in range(20)))
    bits = (b"", b",", b";", b'"', b"\n", b"nan", b"1e999", b"-", b"#", b"\xff", b"(g)", b"9" * 400, b"12:00:00", b"=")
    read = frames_read = coefficients_read = 0
    for _ in range(400):
        content = bytearray(whole[rng.integers(len(whole))])
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(len(content)))
            content[at : at + int(rng.choice([0, 1, 3, 20]))] = bits[rng.integers(len(bits))]
        (tmp_path / "x.csv").write_bytes(bytes(content))
        try:
            table = read_text_table(tmp_path / "x.csv")
        except GateError:
            continue
        table = radiosonde_table(table) or table
        add_clock_columns(table)
        columns = coefficient_columns(table)
        if columns is not None:
            as_coefficients(table, columns)
            tomllib.loads(sidecar_text(columns))
        frames = frame_list(table, [video], ["a"], tmp_path)
        coefficients_read += columns is not None
        frames_read += frames is not None
        for source in [frames] if frames is not None else Recogniser(table).proposals()[0]:
            tomllib.loads(section_text(source, "telemetry/x.csv", table.notes, question=""))
        read += 1
    assert read > 200
    assert frames_read > 5
    assert coefficients_read > 20


# ------------------------------------------------------------------------------------------ units that are written

AIR = {"Height (m)": lambda t: 1000.0 * t, "Density (kg/m3)": lambda t: 1.2 * np.exp(-t / 7.0)}


@pytest.mark.parametrize(
    ("header", "value", "kelvin"),
    [
        ("Temp (F)", 14.0, 263.15), ("Temp [degF]", 14.0, 263.15), ("T_F", 14.0, 263.15), ("Temp (°F)", 14.0, 263.15),
        ("Temperature (R)", 473.67, 263.15), ("T_R", 473.67, 263.15), ("Temp (C)", -10.0, 263.15),
        ("Temp (degree_Rankine)", 473.67, 263.15),
    ],
)  # fmt: skip
def test_a_temperature_is_read_in_the_unit_that_is_written(folder, tmp_path, header, value, kelvin):
    frame(**AIR, **{header: value}).drop(columns="t_s").to_csv(tmp_path / "air.csv", index=False)
    run("import", tmp_path / "air.csv", "--into", folder)
    found = tomllib.loads(text_of(folder))["atmosphere"]["columns"]["temperature"]
    unit = read_unit(found["unit"])
    assert unit.factor * value + unit.offset == pytest.approx(kelvin)


@pytest.mark.parametrize(
    ("unit", "value", "si"),
    [("slug/ft3", 0.002, 1.03076), ("lb/ft^3", 0.06, 0.961108), ("g/cm3", 0.0011, 1.1), ("lbm/ft3", 0.06, 0.961108)],
)
def test_a_density_is_read_in_the_unit_that_is_written(folder, tmp_path, unit, value, si):
    air = frame(**{"Height (kft)": lambda t: 3.0 * t, f"Density ({unit})": value, "Temp (K)": 250.0})
    air.drop(columns="t_s").to_csv(tmp_path / "air.csv", index=False)
    run("import", tmp_path / "air.csv", "--into", folder)
    found = tomllib.loads(text_of(folder))["atmosphere"]["columns"]
    assert read_unit(found["rho"]["unit"]).factor * value == pytest.approx(si, rel=1e-5)
    assert read_unit(found["alt"]["unit"]).factor == pytest.approx(304.8)


@pytest.mark.parametrize(("unit", "factor"), [("deg/hr", 4.84814e-6), ("mrad/s", 1e-3), ("rev/min", None)])
def test_a_rate_is_read_in_the_unit_that_is_written_or_asked_for(folder, tmp_path, unit, factor):
    wave = lambda t: 900.0 * np.sin(t)  # noqa: E731 - by its numbers deg/s
    names = {f"{name} rate ({unit})": wave for name in ("Roll", "Pitch", "Yaw")}
    frame(**names).to_csv(tmp_path / "gyro.csv", index=False)
    run("import", tmp_path / "gyro.csv", "--into", folder)
    for column in tomllib.loads(text_of(folder))["sensors"]["rates"]["columns"].values():
        if factor is None:
            assert column["unit"] == "FILL IN"
        else:
            assert read_unit(column["unit"]).factor == pytest.approx(factor, rel=1e-5)
    if factor is None:
        assert f"'{unit}' in the header is no unit that is known" in text_of(folder)


def test_text_in_a_unit_row_that_is_no_unit_is_asked_for(folder, tmp_path):
    air = frame(height=lambda t: 1000.0 * t, density=lambda t: 1.2 * np.exp(-t / 7.0), temperature=-10.0)
    written(tmp_path / "air.csv", air.drop(columns="t_s"), units=["m", "kg/m3", "cels."])
    run("import", tmp_path / "air.csv", "--into", folder)
    assert tomllib.loads(text_of(folder))["atmosphere"]["columns"]["temperature"]["unit"] == "FILL IN"

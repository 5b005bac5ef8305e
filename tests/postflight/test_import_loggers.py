"""`postflight import` of loggers that write all sensors into one table, at the rate of the fastest."""

import tomllib

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from postflight.cli import cli

N = 2000
T = np.round(-0.3 + 0.01 * np.arange(N), 2)
SECOND = np.floor(T + 40.6)  # of the receiver's last fix: it ticks between the seconds of the logger
BARO_M = 300.0 + 50.0 * np.maximum(T, 0.0)
GPS_M = 355.0 + 50.0 * np.maximum(SECOND - 41.0, 0.0)
FIX = {"lat": 37.1688 + 0.0001 * SECOND, "lon": -97.7339 + 0.0002 * SECOND, "alt": GPS_M}
CLOCK = {"hour": 18, "minute": 54, "second": SECOND}


@pytest.fixture
def folder(tmp_path):
    CliRunner().invoke(cli, ["init", str(tmp_path / "flight")])
    return tmp_path / "flight"


def imported(folder, text):
    """Import a table; return flight.toml, what was printed and the exit code."""
    path = folder.parent / "log.csv"
    path.write_text(text)
    result = CliRunner().invoke(cli, ["import", str(path), "--into", str(folder)], env={"COLUMNS": "200"})
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return tomllib.loads((folder / "flight.toml").read_text()), " ".join(result.output.split()), result.exit_code


def csv(columns, names=None):
    table = pd.DataFrame(columns, index=range(N))
    return table.to_csv(index=False, header=names or list(table))


def altimeter(**more):
    """Barometric altitude first, the receiver's after its latitude and longitude under the same name."""
    columns = {"time": T, "pressure": 101325.0 * np.exp(-BARO_M / 8400.0), "altitude": BARO_M}
    columns |= {"latitude": FIX["lat"], "longitude": FIX["lon"], "b": FIX["alt"], **CLOCK, **more}
    return csv(columns, ["altitude" if name == "b" else name for name in columns])


def test_of_two_altitudes_the_receivers_stands_beside_its_latitude(folder):
    found, _, _ = imported(folder, altimeter())
    assert found["gnss"]["log_gnss"]["columns"]["alt"]["column"] == "altitude_6"


@pytest.mark.parametrize(
    ("first", "second"), [("altitude", "gps_altitude"), ("baro_alt", "alt"), ("height", "gps_height")]
)
def test_of_two_altitudes_the_receivers_has_its_words(first, second, folder):
    columns = {"time": T, "lat": FIX["lat"], "lon": FIX["lon"], first: BARO_M, "speed": 0.0, second: FIX["alt"]}
    found, _, _ = imported(folder, csv(columns))
    assert found["gnss"]["log_gnss"]["columns"]["alt"]["column"] == second
    # without a pressure the other one is the barometer's
    assert found["barometers"]["log_baro"]["columns"]["height"]["column"] == first


def test_a_time_of_day_that_repeats_until_the_next_fix_is_the_receivers_alone(folder):
    found, _, _ = imported(folder, altimeter(ax=9.8, ay=0.0, az=0.0))
    assert found["sensors"]["accelerometer"]["time"] == {"column": "time"}
    assert found["barometers"]["log_baro"]["time"] == {"column": "time"}
    clock = {"columns": ["hour", "minute", "second"], "format": "utc_hms"}
    assert found["gnss"]["log_gnss"]["time"] == clock | {"repeats": "first"}


def test_a_time_of_day_that_runs_with_the_rows_is_the_time_of_all(folder):
    found, _, _ = imported(folder, altimeter(second=np.round(10.0 + 0.01 * np.arange(N), 2)))
    clock = {"columns": ["hour", "minute", "second"], "format": "utc_hms"}
    assert found["gnss"]["log_gnss"]["time"] == found["barometers"]["log_baro"]["time"] == clock


def test_trackers_of_one_table_have_names_of_their_own(folder):
    found, _, _ = imported(folder, altimeter())
    names = [name for group in ("radars", "gnss", "barometers") for name in found.get(group, {})]
    assert sorted(names) == ["log_baro", "log_gnss"]


@pytest.mark.parametrize(("step", "radars"), [(1.0, set()), (0.01, {"log_radar"})])
def test_angles_in_whole_degrees_beside_fixes_are_no_radar(step, radars, folder):
    angle = np.round((20.0 + 30.0 * T / T[-1]) / step) * step
    found, printed, _ = imported(folder, altimeter(distance=50.0 + 40.0 * np.abs(T), az=angle, el=angle))
    assert set(found.get("radars", {})) == radars
    assert ("'distance', 'az', 'el': whole degrees beside fixes" in printed) == (not radars)


def inertial(rates, names=("gx", "gy", "gz")):
    force = {"timestamp_ms": 10 * np.arange(N), "ax": 0.0, "ay": 0.0, "az": 1.0}
    return csv(force | dict(zip(names, rates.T, strict=True)))


def test_gx_gy_gz_beside_an_accelerometer_are_gyros(folder):
    turning = np.column_stack([500.0 * np.sin(T), 20.0 * np.cos(T), T])
    found, _, _ = imported(folder, inertial(turning))
    assert {short: m["column"] for short, m in found["sensors"]["rates"]["columns"].items()} == {
        "p": "gx",
        "q": "gy",
        "r": "gz",
    }
    assert {m["unit"] for m in found["sensors"]["rates"]["columns"].values()} == {"degps"}
    assert found["sensors"]["rates"]["mount"] == "FILL IN"


def test_gravitys_direction_beside_an_accelerometer_is_no_gyro(folder):
    tilt = 0.3 * np.sin(T)
    gravity = np.column_stack([np.sin(tilt), 0 * tilt, np.cos(tilt)])
    assert "rates" not in imported(folder, inertial(gravity))[0]["sensors"]


def test_a_last_line_that_is_cut_short_is_left_out_and_said(folder):
    text = inertial(np.column_stack([500.0 * np.sin(T), T, T]))
    _, printed, code = imported(folder, text[: text.rstrip().rfind(",") - 3])
    assert "the last line is cut short" in printed
    assert code == 0
    table = pd.read_csv(folder / "telemetry" / "log.csv")
    assert len(table) == N - 1
    assert np.isfinite(table.to_numpy()).all()


def test_a_table_without_a_known_time_says_so(folder):
    stamps = [f"2022-5-7--11-24-{56 + k // 1000}-{k % 1000:03d}" for k in range(N)]
    _, printed, code = imported(folder, csv({"Time": stamps, "ax": 9.8, "ay": 0.0, "az": 0.0}))
    assert code == 3
    assert "no column of times is recognised" in printed
    assert "'Time' 2022-5-7--11-24-56-000" in printed

"""The gate with magnetometer and Sun sensors: their faults are refused as those of the other sensors are."""

from __future__ import annotations

import re

import numpy as np
import pytest

from flightmodel.checks import ConfigError, GateError
from flightmodel.flightfolder import read_flight
from tests.refusing import numbers_in, refuses

SECTIONS = """\
[sensors.magnetometer]
file = "telemetry/magnetometer.csv"
noise_sd_ut = 0.2
bias_sd_ut = 0.7
soft_iron_sd = 0.004

[sensors.sun]
file = "telemetry/sun.csv"
heads_lv_deg = [45.0, 135.0, 225.0, 315.0]
noise_sd_deg = 0.8
"""
SUN_HEADER = "t_s," + ",".join(f"az_sun{k}_deg,el_sun{k}_deg" for k in (1, 2, 3, 4))


@pytest.fixture
def equipped(flight):
    """The hand-made folder with both sensors: two heads see the Sun, then the next two, as the vehicle turns."""
    t = np.arange(420.0, 430.0, 0.05)
    turn = 0.6 * (t - 420.0)
    field = np.column_stack([t, 20.0 * np.cos(turn), 20.0 * np.sin(turn), -43.0 + 0.01 * np.sin(7.0 * t)])
    rows = [",".join(f"{v:.6f}" for v in row) for row in field]
    flight.write_lines("magnetometer.csv", ["t_s,bx_magnetometer_ut,by_magnetometer_ut,bz_magnetometer_ut", *rows])
    lines = [SUN_HEADER]
    for at, angle in zip(t, np.rad2deg(turn), strict=True):
        cells = []
        for k in range(4):
            az = (angle - 90.0 * k + 180.0) % 360.0 - 180.0
            cells += [f"{az:.4f}", f"{12.0 + 0.3 * np.sin(9.0 * at + k):.4f}"] if abs(az) < 90.0 else ["", ""]
        lines.append(",".join([f"{at:.6f}", *cells]))
    flight.write_lines("sun.csv", lines)
    flight.append(SECTIONS)
    return flight


def refused(flight, *codes, names=(), kind=GateError):
    with refuses(*codes, names=names, kind=kind):
        read_flight(flight.root)


def findings(flight, source):
    """Code and time of the first of each finding's rows."""
    return sorted((f.code, f.start_s) for f in read_flight(flight.root).findings if f.source == source)


def test_both_are_read_in_si_with_their_data_sheets(equipped):
    telemetry = read_flight(equipped.root)
    assert telemetry.findings == ()
    magnetometer, sun = telemetry.magnetometer, telemetry.sun
    first = [float(v) for v in equipped.lines("magnetometer.csv")[1].split(",")]
    np.testing.assert_allclose(magnetometer.measured_sensor[0], np.array(first[1:]) * 1e-6, rtol=1e-12)
    assert magnetometer.spec.bias_sd == pytest.approx(0.7e-6)
    assert magnetometer.spec.soft_iron_sd == 0.004
    mount = telemetry.vehicle.sensors["magnetometer"]
    np.testing.assert_array_equal(magnetometer.spec.dcm_body_sensor, mount.dcm_body_sensor)
    assert sun.az_el_head_rad.shape == (200, 4, 2)
    assert (np.isfinite(sun.az_el_head_rad[:, :, 0]).sum(axis=1) >= 1).all()
    np.testing.assert_allclose(sun.az_el_head_rad[0, 0, 1], np.deg2rad(float(equipped.column("sun.csv", 2)[0])))
    np.testing.assert_allclose(sun.spec.clock_lv_rad, np.deg2rad([45.0, 135.0, 225.0, 315.0]))
    assert sun.spec.noise_sd_rad == pytest.approx(np.deg2rad(0.8))
    assert {"telemetry/magnetometer.csv", "telemetry/sun.csv"} <= set(telemetry.hashes)


def test_neither_is_needed(clean_flight):
    telemetry = read_flight(clean_flight.root)
    assert telemetry.magnetometer is None
    assert telemetry.sun is None


@pytest.mark.parametrize(
    ("name", "known", "wrong"),
    [
        ("magnetometer.csv", "by_magnetometer_ut", "by_magnetometr_ut"),
        ("sun.csv", "az_sun3_deg", "az_sun_3_deg"),
    ],
)
def test_wrong_column_names_the_nearest(equipped, name, known, wrong):
    equipped.header(name, known, wrong)
    refused(equipped, "column-missing", names=[name, "line 1", f"'{known}'", f"'{wrong}'"])


def test_column_without_unit_is_refused_with_how_to_declare_it(equipped):
    equipped.header("magnetometer.csv", "bx_magnetometer_ut", "bx")
    refused(equipped, "column-missing", names=[r"sensors\.magnetometer", r"columns\.bx = { column"])


@pytest.mark.parametrize(("unit", "factor"), [("nt", 1e3), ("gauss", 1e-2), ("t", 1e-6)])
def test_declared_units_equal_the_canonical_result(equipped, unit, factor):
    before = read_flight(equipped.root).magnetometer.measured_sensor
    equipped.header("magnetometer.csv", "bz_magnetometer_ut", "B-Z")
    equipped.map_column("magnetometer.csv", 3, lambda cell: f"{float(cell) * factor:.12g}")
    equipped.append(f'[sensors.magnetometer.columns]\nbz = {{ column = "B-Z", unit = "{unit}" }}')
    np.testing.assert_allclose(read_flight(equipped.root).magnetometer.measured_sensor, before, rtol=1e-9)


def test_wrong_unit_is_refused_with_those_that_fit(equipped):
    equipped.append('[sensors.magnetometer.columns]\nbz = { column = "bz_magnetometer_ut", unit = "mps2" }')
    refused(equipped, "unit-unknown", names=["magnetic field", "ut, nt, gauss"])


def test_nanotesla_written_as_microtesla_are_refused(equipped):
    equipped.map_column("magnetometer.csv", 1, lambda cell: f"{float(cell) * 1e3:.3f}")
    refused(equipped, "value-range", names=[r"magnetometer\.csv: line 2\b"])


def test_impossible_sun_angle_is_refused_with_its_line(equipped):
    equipped.cell("sun.csv", 7, 1, "260.0")
    refused(equipped, "value-range", names=[r"sensors\.sun", "az1", r"line 7\b"])


@pytest.mark.parametrize("name", ["magnetometer.csv", "sun.csv"])
def test_time_running_backwards_names_line_and_values(equipped, name):
    equipped.cell(name, 9, 0, "420.1")
    refused(equipped, "rows-contradict", names=[name, r"line 9\b"])


@pytest.mark.parametrize("name", ["magnetometer", "sun"])
def test_rows_that_come_twice_or_late_are_findings(equipped, name):
    before = read_flight(equipped.root)
    rows = equipped.lines(f"{name}.csv")
    equipped.write_lines(f"{name}.csv", [*rows[:41], rows[42], rows[41], *rows[43:], *rows[1:4]])
    after = read_flight(equipped.root)
    np.testing.assert_array_equal(after.magnetometer.measured_sensor, before.magnetometer.measured_sensor)
    np.testing.assert_array_equal(after.sun.az_el_head_rad, before.sun.az_el_head_rad)
    assert findings(equipped, name) == [("rows-left-out", 420.0), ("rows-reordered", 422.0)]


def test_mount_that_the_vehicle_lacks(equipped):
    equipped.declare('mount = "magnetometre"', 'file = "telemetry/magnetometer.csv"')
    refused(equipped, "name-unknown", names=[r"sensors\.magnetometer\.mount", "'magnetometer'"], kind=ConfigError)


def test_misspelt_key_names_the_nearest(equipped):
    equipped.replace("flight.toml", "soft_iron_sd", "soft_irn_sd")
    refused(equipped, "key-unknown", names=["soft_irn_sd", "'soft_iron_sd'"], kind=ConfigError)


def test_all_faults_come_at_once(equipped):
    equipped.header("magnetometer.csv", "by_magnetometer_ut", "by_wrong_ut")
    equipped.cell("sun.csv", 4, 2, "bright")
    equipped.cell("rates.csv", 5, 1, "fast")
    refused(equipped, "column-missing", "not-a-number", names=["by_magnetometer_ut", "'bright'", "'fast'"])


def test_gap_frozen_and_saturated_runs_are_findings(equipped):
    lines = equipped.lines("magnetometer.csv")
    equipped.write_lines("magnetometer.csv", lines[:61] + lines[75:])
    for line in range(100, 121):
        equipped.cell("magnetometer.csv", line, 2, "11.111")
    for line in range(20, 27):
        equipped.cell("magnetometer.csv", line, 1, "60.0")
    by_code = {f.code: f.line for f in read_flight(equipped.root).findings if f.source == "magnetometer"}
    assert set(by_code) == {"data-gap", "data-frozen", "data-saturated"}
    assert 0.75 in numbers_in(by_code["data-gap"])
    assert re.search(r"\bby\b.*\b21\b", by_code["data-frozen"])
    assert re.search(r"\bbx\b.*\b6e-05\b.*\b7\b", by_code["data-saturated"])


def test_sun_is_missing_only_where_no_head_sees_it(equipped):
    for line in range(50, 60):
        for column in range(1, 9):
            equipped.cell("sun.csv", line, column, "")
    for line in range(100, 120):
        seen = next(c for c in range(1, 9, 2) if equipped.lines("sun.csv")[line - 1].split(",")[c])
        equipped.cell("sun.csv", line, seen + 1, "11.5")
    found = [f for f in read_flight(equipped.root).findings if f.source == "sun"]
    # equal elevations of two heads one after the other: at an extreme of the record they may be a stop
    assert {f.code for f in found} == {"samples-missing", "data-saturated", "data-frozen-or-saturated"}
    (missing,) = [f for f in found if f.code == "samples-missing"]
    assert (missing.start_s, missing.end_s) == pytest.approx((422.4, 422.85))
    assert all(re.match(r"el\d", f.what) for f in found if f is not missing)


def test_empty_sensors_are_refused(equipped):
    for column in (1, 2, 3):
        equipped.map_column("magnetometer.csv", column, lambda _: "")
    for column in range(1, 9):
        equipped.map_column("sun.csv", column, lambda _: "")
    refused(equipped, "too-few-rows", names=[r"sensors\.magnetometer", r"sensors\.sun"])


def test_number_of_heads_is_that_of_flight_toml(equipped):
    equipped.replace("flight.toml", "[45.0, 135.0, 225.0, 315.0]", "[45.0, 135.0, 225.0, 270.0, 315.0]")
    refused(equipped, "column-missing", names=["'az_sun5_deg'"])
    equipped.replace("flight.toml", "[45.0, 135.0, 225.0, 270.0, 315.0]", "[45.0, 135.0]")
    assert read_flight(equipped.root).sun.az_el_head_rad.shape == (200, 2, 2)

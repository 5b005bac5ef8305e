"""What the gate does with files that are wrong: a clear message with place and remedy, all faults at once.

Every test spoils one thing in a folder that reads without fault (`test_clean_folder`), and checks the words that a user
needs: which file, which line or time, which value, and what to write instead.
"""

from __future__ import annotations

import datetime as dt
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from flightmodel.checks import ConfigError, GateError
from flightmodel.flightfolder import read_flight
from tests.refusing import numbers_in, printed_codes

G0 = 9.80665
YARD_M = 0.9144
T0_UTC = "2009-08-17T12:52:00Z"
LAUNCH = dt.datetime(2009, 8, 17, 12, 52, tzinfo=dt.UTC)


def refused(flight, *words: str, codes: set[str], kind: type[GateError] = GateError) -> GateError:
    """The refusal by these codes and no other, whose text holds every name and value (case apart)."""
    with pytest.raises(kind) as caught:
        read_flight(flight.root)
    assert set(caught.value.codes) <= codes, caught.value
    text = str(caught.value).lower()
    missing = [word for word in words if word.lower() not in text]
    assert not missing, f"no {missing} in the message:\n{caught.value}"
    return caught.value


def findings_of(flight, source: str, code: str) -> list:
    return [f for f in read_flight(flight.root).findings if source in f.source and f.code == code]


def one_line_with(error: GateError, *words: str) -> str:
    """The fault that has all words, so that the place belongs to the value beside it."""
    hits = [fault for fault in error.faults if all(word.lower() in fault.lower() for word in words)]
    assert hits, f"no single fault has {words}:\n{error}"
    return hits[0]


def names_line(text: str, line: int) -> bool:
    """The message names the line as a text editor counts it (header = 1)."""
    return bool(re.search(rf"(line |:){line}\b", text))


# ---------------------------------------------------------------------------------------------------- the clean folder


def test_clean_folder(clean_flight) -> None:
    telemetry = read_flight(clean_flight.root)
    assert telemetry.findings == ()
    assert sorted(telemetry.radars) == ["north", "south"]
    assert telemetry.accelerometer.time_s.size == 200
    assert telemetry.radars["south"].range_az_el.shape == (100, 3)
    assert telemetry.frames is not None
    assert len(telemetry.frames.paths) == 3
    az = [float(v) for v in clean_flight.column("radar_north.csv", 2)]
    np.testing.assert_allclose(telemetry.radars["north"].range_az_el[:, 1], np.deg2rad(az), rtol=1e-12)


def test_every_input_is_hashed(clean_flight) -> None:
    hashes = read_flight(clean_flight.root).hashes
    text = " ".join(hashes)
    files = [p for p in clean_flight.root.rglob("*") if p.is_file() and p.suffix in {".toml", ".csv"}]
    assert files
    for path in files:
        assert path.name in text


def test_changed_picture_changes_a_hash(flight) -> None:
    before = read_flight(flight.root).hashes
    shutil.copyfile(flight.root / "telemetry/camera5/frame_1.png", flight.root / "telemetry/camera5/frame_2.png")
    assert read_flight(flight.root).hashes != before, "the frames are inputs of a run: run.json must tell them apart"


# -------------------------------------------------------------------------------------------------------- whole files


@pytest.mark.parametrize(
    "name", ["accelerometer.csv", "rates.csv", "radar_south.csv", "atmosphere.csv", "frames.csv", "flight.toml"]
)
def test_missing_file(flight, name: str) -> None:
    flight.path(name).unlink()
    refused(flight, name, codes={"file-missing"})


@pytest.mark.parametrize("name", ["accelerometer.csv", "radar_north.csv", "atmosphere.csv", "frames.csv"])
def test_empty_file(flight, name: str) -> None:
    flight.path(name).write_bytes(b"")
    refused(flight, name, codes={"too-few-rows"})


@pytest.mark.parametrize("name", ["accelerometer.csv", "radar_north.csv", "atmosphere.csv", "frames.csv"])
def test_blank_lines_only(flight, name: str) -> None:
    flight.path(name).write_bytes(b"\n\n  \n")
    refused(flight, name, codes={"too-few-rows"})


@pytest.mark.parametrize("name", ["rates.csv", "radar_north.csv", "frames.csv"])
def test_binary_file(flight, name: str) -> None:
    noise = np.random.default_rng(5).integers(0, 256, 4000, dtype=np.uint8).tobytes()
    flight.path(name).write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00" + noise)
    error = refused(flight, name, codes={"file-unreadable"})
    assert len(str(error)) < 1500, "a binary file must not be poured onto the screen"
    assert str(error).isprintable() or all(c.isprintable() or c == "\n" for c in str(error))


def test_spreadsheet_utf16_file(flight) -> None:
    path = flight.path("rates.csv")
    path.write_bytes(path.read_text().encode("utf-16"))
    error = refused(flight, "rates.csv", codes={"file-unreadable"})
    assert all(c.isprintable() or c == "\n" for c in str(error))


def test_directory_in_place_of_a_file(flight) -> None:
    flight.path("rates.csv").unlink()
    flight.path("rates.csv").mkdir()
    refused(flight, "rates.csv", codes={"file-unreadable"})


@pytest.mark.parametrize("name", ["accelerometer.csv", "radar_north.csv", "atmosphere.csv", "frames.csv"])
def test_byte_order_mark_and_crlf_are_read(flight, clean_flight, name: str) -> None:
    path = flight.path(name)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def test_flight_toml_with_byte_order_mark_and_crlf(flight, clean_flight) -> None:
    path = flight.path("flight.toml")
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    _same(read_flight(flight.root), read_flight(clean_flight.root))
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def test_no_newline_at_the_end(flight, clean_flight) -> None:
    path = flight.path("accelerometer.csv")
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def test_empty_lines_at_the_end(flight, clean_flight) -> None:
    path = flight.path("accelerometer.csv")
    path.write_bytes(path.read_bytes() + b"\n\n")
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def _same(a, b, time_tol: float = 0.0, rtol: float = 0.0) -> None:
    """Two telemetries are equal in everything that is measured."""
    for x, y in [(a.accelerometer, b.accelerometer), (a.rates, b.rates)]:
        np.testing.assert_allclose(x.time_s, y.time_s, rtol=0, atol=time_tol)
        np.testing.assert_allclose(x.measured_sensor, y.measured_sensor, rtol=rtol, atol=0)
    assert sorted(a.radars) == sorted(b.radars)
    for name in b.radars:
        np.testing.assert_allclose(a.radars[name].time_s, b.radars[name].time_s, rtol=0, atol=time_tol)
        np.testing.assert_allclose(a.radars[name].range_az_el, b.radars[name].range_az_el, rtol=rtol, atol=0)
    for name in ("altitude_m", "density_kgpm3", "temperature_k", "wind_north_mps", "wind_east_mps"):
        scale = np.abs(getattr(b.sounding, name)).max()
        np.testing.assert_allclose(
            getattr(a.sounding, name), getattr(b.sounding, name), rtol=rtol, atol=rtol * scale, err_msg=name
        )
    np.testing.assert_allclose(a.frames.time_s, b.frames.time_s, rtol=0, atol=time_tol)
    assert [p.name for p in a.frames.paths] == [p.name for p in b.frames.paths]


# ------------------------------------------------------------------------------------------------------------ columns


@pytest.mark.parametrize(
    ("name", "known", "wrong"),
    [
        ("accelerometer.csv", "ax_suba_mps2", "ax_sbua_mps2"),
        ("rates.csv", "q_body_degps", "qbody_degps"),
        ("radar_north.csv", "range_m", "rnage_m"),
        ("atmosphere.csv", "rho_kgpm3", "roh_kgpm3"),
        ("frames.csv", "frame", "fraem"),
        ("radar_north.csv", "t_s", "t_sec"),
    ],
)
def test_wrong_column_names_the_nearest(flight, name: str, known: str, wrong: str) -> None:
    flight.header(name, known, wrong)
    refused(flight, name, known, wrong, codes={"column-missing"})


def test_column_without_unit_tells_how_to_declare_it(flight) -> None:
    flight.header("accelerometer.csv", "ax_suba_mps2", "ax")
    refused(
        flight,
        "accelerometer.csv",
        "ax_suba_mps2",
        "sensors.accelerometer",
        "columns",
        "ax =",
        "unit =",
        codes={"column-missing"},
    )


def test_radar_column_without_unit_tells_how_to_declare_it(flight) -> None:
    flight.header("radar_south.csv", "range_m", "range")
    refused(
        flight,
        "radar_south.csv",
        "range_m",
        "radars.south",
        "columns",
        "range =",
        "unit =",
        codes={"column-missing"},
    )


def test_column_with_another_unit_in_its_name_is_not_guessed(flight) -> None:
    flight.header("radar_south.csv", "range_m", "range_km")
    refused(flight, "radar_south.csv", "range_km", "range_m", codes={"column-missing"})


def test_declared_column_that_the_file_lacks(flight) -> None:
    flight.append('[sensors.accelerometer.columns]\nax = {column = "AX (g)", unit = "g"}')
    refused(flight, "AX (g)", "accelerometer.csv", codes={"column-missing"})


def test_declared_name_that_the_sensor_lacks(flight) -> None:
    flight.append('[sensors.accelerometer.columns]\naxx = {column = "ax_suba_mps2", unit = "mps2"}')
    refused(flight, "axx", "ax", kind=ConfigError, codes={"name-unknown"})


@pytest.mark.parametrize("unit", ["m", "degps", "furlong", "G", ""])
def test_unit_that_does_not_fit(flight, unit: str) -> None:
    flight.append(f'[sensors.accelerometer.columns]\nax = {{column = "ax_suba_mps2", unit = "{unit}"}}')
    refused(flight, f"{unit}", "mps2", "g", codes={"key-value", "unit-unknown"})


def test_duplicate_column_name(flight) -> None:
    flight.header("accelerometer.csv", "ay_suba_mps2", "ax_suba_mps2")
    refused(flight, "accelerometer.csv", "ax_suba_mps2", codes={"given-twice"})


def test_same_column_twice_beside_a_complete_set(flight) -> None:
    flight.write_lines("rates.csv", [f"{row},{row.split(',')[1]}" for row in flight.lines("rates.csv")])
    refused(flight, "rates.csv", "p_body_degps", codes={"given-twice"})


def test_column_order_and_extra_columns_do_not_matter(flight, clean_flight) -> None:
    rows = [row.split(",") for row in flight.lines("accelerometer.csv")]
    flight.write_lines("accelerometer.csv", [f"{r[3]},note {k % 3},{r[1]},{r[0]},{r[2]}" for k, r in enumerate(rows)])
    rows = [row.split(",") for row in flight.lines("atmosphere.csv")]
    flight.write_lines("atmosphere.csv", [",".join([r[3], r[4], r[2], r[0], r[1]]) for r in rows])
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def test_spaces_around_cells_do_not_matter(flight, clean_flight) -> None:
    for name in ("accelerometer.csv", "radar_north.csv", "atmosphere.csv", "frames.csv"):
        flight.write_lines(name, [row.replace(",", " , ") + " " for row in flight.lines(name)])
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def test_semicolons_are_refused_with_words(flight) -> None:
    flight.write_lines("rates.csv", [row.replace(",", ";") for row in flight.lines("rates.csv")])
    refused(flight, "rates.csv", "t_s", codes={"column-missing"})


def test_declared_column_may_hold_a_comma_in_quotes(flight, clean_flight) -> None:
    flight.header("accelerometer.csv", "ax_suba_mps2", '"AX, inboard"')
    flight.append('[sensors.accelerometer.columns]\nax = {column = "AX, inboard", unit = "mps2"}')
    _same(read_flight(flight.root), read_flight(clean_flight.root))


# -------------------------------------------------------------------------------------------------------------- cells


@pytest.mark.parametrize("text", ["abc", "1,5".replace(",", "."[:0] + "_"), "0x1F", "--", "1e", "#REF!", "1 234.5"])
def test_text_in_a_number_cell_names_the_line(flight, text: str) -> None:
    flight.cell("accelerometer.csv", 83, 2, text)
    error = refused(flight, "accelerometer.csv", text, codes={"not-a-number"})
    assert names_line(one_line_with(error, "accelerometer.csv", text), 83)


def test_text_in_a_time_cell_names_the_line(flight) -> None:
    flight.cell("radar_north.csv", 31, 0, "noon")
    error = refused(flight, "radar_north.csv", "noon", codes={"not-a-number", "time-format"})
    assert names_line(one_line_with(error, "noon"), 31)


def test_text_in_several_cells_is_told_at_once(flight) -> None:
    flight.cell("accelerometer.csv", 12, 1, "abc")
    flight.cell("accelerometer.csv", 150, 3, "def")
    flight.cell("rates.csv", 77, 2, "ghi")
    text = str(refused(flight, "abc", "def", "ghi", codes={"not-a-number"}))
    assert all(names_line(text, line) for line in (12, 150, 77))


def test_many_bad_cells_stay_readable(flight) -> None:
    flight.map_column("accelerometer.csv", 1, lambda _: "bad")
    error = refused(flight, "accelerometer.csv", "bad", codes={"not-a-number"})
    assert len(str(error)) < 4000, "two hundred equal faults belong in one sentence with their number"
    assert names_line(str(error), 2)
    assert {200.0, 199.0} & set(numbers_in(str(error)))


@pytest.mark.parametrize("cells", [",1.0", ",1.0,2.0,3.0,4.0", ""])
def test_ragged_row_names_the_line(flight, cells: str) -> None:
    lines = flight.lines("accelerometer.csv")
    lines[40] = lines[40].split(",")[0] + cells
    flight.write_lines("accelerometer.csv", lines)
    assert names_line(str(refused(flight, "accelerometer.csv", codes={"row-ragged"})), 41)


def test_trailing_comma_does_not_shift_the_columns(flight, clean_flight) -> None:
    """Some loggers end each row, not the header, with a comma: read as written or refused for that, never shifted."""
    lines = flight.lines("atmosphere.csv")
    flight.write_lines("atmosphere.csv", [lines[0], *(f"{row}," for row in lines[1:])])
    lines = flight.lines("radar_north.csv")
    flight.write_lines("radar_north.csv", [lines[0], *(f"{row}," for row in lines[1:])])
    try:
        telemetry = read_flight(flight.root)
    except GateError as error:
        text, codes = str(error), set(error.codes)
    else:
        text, codes = "line 2", set()
        _same(telemetry, read_flight(clean_flight.root))
    assert names_line(text, 2), text
    assert codes <= {"row-ragged"}, "the time does not run backwards in this file"


@pytest.mark.parametrize("blank", ["", "   "])
def test_line_numbers_count_blank_lines(flight, blank: str) -> None:
    flight.cell("accelerometer.csv", 83, 2, "abc")
    lines = flight.lines("accelerometer.csv")
    lines.insert(9, blank)
    flight.write_lines("accelerometer.csv", lines)
    error = refused(flight, "accelerometer.csv", codes={"not-a-number"})
    assert names_line(str(error), 84) or names_line(str(error), 10)


def test_file_cut_in_the_middle_of_its_last_row(flight) -> None:
    path = flight.path("rates.csv")
    lines = flight.lines("rates.csv")
    path.write_text("\n".join(lines[:-1]) + "\n" + lines[-1].rsplit(",", 1)[0])
    assert names_line(str(refused(flight, "rates.csv", codes={"row-ragged"})), len(lines))


def test_comment_row_in_the_data_names_the_line(flight) -> None:
    lines = flight.lines("radar_south.csv")
    lines.insert(20, "# track lost here")
    flight.write_lines("radar_south.csv", lines)
    assert names_line(str(refused(flight, "radar_south.csv", codes={"row-ragged"})), 21)


@pytest.mark.parametrize("text", ["inf", "-inf", "Infinity", "1e999"])
def test_infinite_value_is_refused_with_its_line(flight, text: str) -> None:
    flight.cell("rates.csv", 60, 1, text)
    assert names_line(str(refused(flight, "rates.csv", codes={"not-a-number", "value-range"})), 60)


@pytest.mark.parametrize(
    ("name", "column", "value"),
    [("accelerometer.csv", 2, "1e30"), ("rates.csv", 1, "-4e12"), ("radar_north.csv", 1, "1e15")],
)
def test_huge_value_is_refused_with_its_line(flight, name: str, column: int, value: str) -> None:
    flight.cell(name, 55, column, value)
    assert names_line(str(refused(flight, name, codes={"value-range"})), 55)


def test_impossible_radar_values_are_refused(flight) -> None:
    flight.cell("radar_north.csv", 22, 1, "-5000.0")
    flight.cell("radar_south.csv", 33, 3, "260.0")
    text = str(refused(flight, "radar_north.csv", "radar_south.csv", codes={"value-range"}))
    assert names_line(text, 22)
    assert names_line(text, 33)


@pytest.mark.parametrize(("column", "value"), [(1, "-0.5"), (1, "0"), (2, "-12.0")])
def test_negative_density_or_temperature_is_refused_with_its_line(flight, column: int, value: str) -> None:
    flight.cell("atmosphere.csv", 14, column, value)
    assert names_line(str(refused(flight, "atmosphere.csv", codes={"value-range"})), 14)


def test_sounding_from_the_top_down(flight, clean_flight) -> None:
    """A sonde on its parachute reports from the top down: the same profile."""
    lines = flight.lines("atmosphere.csv")
    flight.write_lines("atmosphere.csv", [lines[0], *lines[:0:-1]])
    _same(read_flight(flight.root), read_flight(clean_flight.root))


def test_missing_density_is_not_a_density(flight) -> None:
    """NaN is missing: the row counts as absent, and that is a finding."""
    flight.cell("atmosphere.csv", 14, 1, "nan")
    telemetry = read_flight(flight.root)
    assert np.isfinite(telemetry.sounding.density_kgpm3).all()
    assert 24000.0 not in telemetry.sounding.altitude_m
    assert any("atmosphere" in f.source for f in telemetry.findings)


# --------------------------------------------------------------------------------------------------------------- time


def test_time_running_backwards_names_line_and_values(flight) -> None:
    was = flight.cell("accelerometer.csv", 90, 0, "423.1")
    before = flight.lines("accelerometer.csv")[88].split(",")[0]
    error = refused(flight, "accelerometer.csv", "423.1", before, codes={"rows-contradict"})
    assert names_line(str(error), 90)
    assert was != "423.1"


def test_same_time_twice_names_line_and_value(flight) -> None:
    before = flight.lines("radar_north.csv")[49].split(",")[0]
    flight.cell("radar_north.csv", 51, 0, before)
    error = refused(flight, "radar_north.csv", before, codes={"rows-contradict"})
    assert names_line(str(error), 51)


def test_file_in_reverse_order_is_turned_and_said_so(flight, clean_flight) -> None:
    lines = flight.lines("rates.csv")
    flight.write_lines("rates.csv", [lines[0], *lines[:0:-1]])
    _same(read_flight(flight.root), read_flight(clean_flight.root))
    (told,) = findings_of(flight, "rates", "rows-reordered")
    assert numbers_in(told.what) == [199.0, 1.0]
    assert (told.start_s, told.end_s) == (420.0, pytest.approx(429.9))


@pytest.mark.parametrize(
    ("name", "source"), [("accelerometer.csv", "accelerometer"), ("rates.csv", "rates"), ("radar_south.csv", "south")]
)
def test_blocks_delivered_twice_and_in_the_wrong_order(flight, clean_flight, name: str, source: str) -> None:
    """Lines 12 to 21 come again at the end; lines 32 to 41 and 42 to 51 have changed places."""
    rows = flight.lines(name)
    flight.write_lines(name, [*rows[:31], *rows[41:51], *rows[31:41], *rows[51:], *rows[11:21]])
    telemetry = read_flight(flight.root)
    _same(telemetry, read_flight(clean_flight.root))
    assert {f.source for f in telemetry.findings} == {source}
    times = [float(row.split(",")[0]) for row in rows[1:]]
    (again,), (late,) = findings_of(flight, source, "rows-left-out"), findings_of(flight, source, "rows-reordered")
    assert numbers_in(again.what) == [10.0, 1.0]
    assert (again.start_s, again.end_s) == (times[10], times[19])
    assert numbers_in(late.what) == [10.0, 1.0]
    assert (late.start_s, late.end_s) == (times[30], times[39])


def test_a_clock_that_was_reset_is_refused(flight) -> None:
    """From line 101 on the accelerometer's clock is 2.02 s behind: two stretches of the flight overlap."""
    rows = flight.lines("accelerometer.csv")
    for k in range(100, 201):
        cells = rows[k].split(",")
        rows[k] = ",".join([f"{float(cells[0]) - 2.02:.3f}", *cells[1:]])
    flight.write_lines("accelerometer.csv", rows)
    error = refused(flight, "accelerometer.csv", codes={"rows-contradict"})
    assert names_line(str(error), 101)


def test_one_time_with_two_values_in_a_long_table_is_left_out(flight) -> None:
    rows = flight.lines("accelerometer.csv")
    dense = [f"{420.0 + 0.01 * k:.2f},{0.4 + 0.001 * (k % 7):.4f},0.5,{-12.0 - 0.01 * k:.3f}" for k in range(1000)]
    dense[500] = dense[500].replace("425.00", "424.99")
    flight.write_lines("accelerometer.csv", [rows[0], *dense])
    telemetry = read_flight(flight.root)
    assert telemetry.accelerometer.time_s.size == 998
    assert not np.isclose(telemetry.accelerometer.time_s, 424.99).any()
    (told,) = findings_of(flight, "accelerometer", "rows-contradict")
    assert numbers_in(told.what) == [2.0, 1.0, 424.99]


def test_missing_time_is_refused_with_its_line(flight) -> None:
    flight.cell("rates.csv", 44, 0, "nan")
    flight.cell("radar_north.csv", 45, 0, "")
    text = str(refused(flight, "rates.csv", "radar_north.csv", codes={"time-format"}))
    assert names_line(text, 44)
    assert names_line(text, 45)


def test_frame_times_in_disorder(flight) -> None:
    flight.cell("frames.csv", 3, 0, "420.2")
    assert names_line(str(refused(flight, "frames.csv", "420.2", codes={"time-backwards"})), 3)


def _stamp(seconds: str) -> dt.datetime:
    return LAUNCH + dt.timedelta(microseconds=round(float(seconds) * 1e6))


def _iso(seconds: str) -> str:
    return _stamp(seconds).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def _irig(seconds: str) -> str:
    return _stamp(seconds).strftime("%j:%H:%M:%S.%f")


def test_iso_utc_times_equal_seconds(flight, clean_flight) -> None:
    flight.map_column("accelerometer.csv", 0, _iso)
    flight.header("accelerometer.csv", "t_s", "UTC")
    flight.declare('time = { column = "UTC", format = "utc" }', 'file = "telemetry/accelerometer.csv"')
    flight.map_column("frames.csv", 0, _iso)
    flight.header("frames.csv", "t_s", "UTC")
    flight.declare('time = { column = "UTC", format = "utc" }', 'file = "telemetry/frames.csv"')
    _same(read_flight(flight.root), read_flight(clean_flight.root), time_tol=1.01e-6)


def test_irig_day_of_year_times_equal_seconds(flight, clean_flight) -> None:
    assert _irig("300.0") == "229:12:57:00.000000"
    flight.map_column("radar_north.csv", 0, _irig)
    flight.header("radar_north.csv", "t_s", "IRIG")
    flight.declare('time = { column = "IRIG", format = "irig_doy" }', 'file = "telemetry/radar_north.csv"')
    _same(read_flight(flight.root), read_flight(clean_flight.root), time_tol=1.01e-6)


def test_iso_time_with_another_offset_is_the_same_instant(flight, clean_flight) -> None:
    east = dt.timezone(dt.timedelta(hours=2))
    flight.map_column("rates.csv", 0, lambda s: _stamp(s).astimezone(east).isoformat(timespec="microseconds"))
    flight.declare('time = { column = "t_s", format = "utc" }', 'file = "telemetry/rates.csv"')
    _same(read_flight(flight.root), read_flight(clean_flight.root), time_tol=1.01e-6)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("min", 1 / 60)])
def test_times_in_other_units_equal_seconds(flight, clean_flight, unit: str, factor: float) -> None:
    flight.map_column("rates.csv", 0, lambda s: repr(float(s) * factor))
    flight.header("rates.csv", "t_s", "CLOCK")
    flight.declare(f'time = {{ column = "CLOCK", unit = "{unit}" }}', 'file = "telemetry/rates.csv"')
    _same(read_flight(flight.root), read_flight(clean_flight.root), time_tol=1e-9)


@pytest.mark.parametrize(
    "text", ["367:12:59:00.000", "229:25:59:00.000", "229:12:61:00.000", "229:12:59:75.000", "12:59:00", "000:12:59:00"]
)
def test_impossible_irig_time_names_the_line(flight, text: str) -> None:
    flight.map_column("radar_north.csv", 0, _irig)
    flight.declare('time = { column = "t_s", format = "irig_doy" }', 'file = "telemetry/radar_north.csv"')
    flight.cell("radar_north.csv", 40, 0, text)
    assert names_line(str(refused(flight, "radar_north.csv", text, codes={"time-format"})), 40)


def test_irig_day_366_only_in_leap_years(flight) -> None:
    flight.map_column("radar_north.csv", 0, _irig)
    flight.declare('time = { column = "t_s", format = "irig_doy" }', 'file = "telemetry/radar_north.csv"')
    flight.cell("radar_north.csv", 101, 0, "366:12:59:00.000")
    refused(flight, "radar_north.csv", "366", codes={"time-format"})


def test_seconds_where_iso_was_declared(flight) -> None:
    flight.declare('time = { column = "t_s", format = "utc" }', 'file = "telemetry/rates.csv"')
    error = refused(flight, "rates.csv", "420", codes={"time-format"})
    assert names_line(str(error), 2)
    assert len(str(error)) < 4000


def test_iso_where_seconds_were_expected_names_the_remedy(flight) -> None:
    flight.map_column("accelerometer.csv", 0, _iso)
    error = refused(flight, "accelerometer.csv", "format", codes={"not-a-number", "time-format"})
    assert len(str(error)) < 4000


def test_sensors_that_do_not_overlap_in_time(flight) -> None:
    flight.map_column("rates.csv", 0, lambda s: repr(float(s) + 3600.0))
    refused(flight, "rates", codes={"time-not-covered"})


# -------------------------------------------------------------------------------------------------------------- units


def test_declared_units_equal_the_canonical_result(flight, clean_flight) -> None:
    for k in (1, 2, 3):
        flight.map_column("accelerometer.csv", k, lambda v: repr(float(v) / G0))
        flight.header("accelerometer.csv", flight.lines("accelerometer.csv")[0].split(",")[k], f"A{'XYZ'[k - 1]} (g)")
    flight.append(
        "[sensors.accelerometer.columns]\n"
        + "\n".join(f'{a} = {{ column = "{a.upper()} (g)", unit = "g" }}' for a in ("ax", "ay", "az"))
    )
    flight.map_column("radar_north.csv", 1, lambda v: repr(float(v) / YARD_M))
    flight.header("radar_north.csv", "range_m", "RANGE (yd)")
    flight.append('[radars.north.columns]\nrange = { column = "RANGE (yd)", unit = "yd" }')
    flight.map_column("radar_south.csv", 1, lambda v: repr(float(v) / 1000.0))
    flight.header("radar_south.csv", "range_m", "RANGE (km)")
    flight.map_column("radar_south.csv", 2, lambda v: repr(float(np.deg2rad(float(v)))))
    flight.header("radar_south.csv", "az_deg", "AZ (rad)")
    flight.append(
        "[radars.south.columns]\n"
        'range = { column = "RANGE (km)", unit = "km" }\n'
        'az = { column = "AZ (rad)", unit = "rad" }'
    )
    flight.map_column("rates.csv", 2, lambda v: repr(float(np.deg2rad(float(v)))))
    flight.header("rates.csv", "q_body_degps", "Q")
    flight.append('[sensors.rates.columns]\nq = { column = "Q", unit = "radps" }')
    _same(read_flight(flight.root), read_flight(clean_flight.root), rtol=1e-12)


def test_wind_from_becomes_where_the_air_goes(flight, clean_flight) -> None:
    rows = [[float(c) for c in row.split(",")] for row in flight.lines("atmosphere.csv")[1:]]
    out = ["ALT (km),rho_kgpm3,t_k,SPEED (kt),FROM (deg)"]
    for h, rho, temperature, north, east in rows:
        speed = np.hypot(north, east) / (1852.0 / 3600.0)
        blows_from = np.degrees(np.arctan2(-east, -north)) % 360.0
        out.append(f"{h / 1000!r},{rho!r},{temperature!r},{float(speed)!r},{float(blows_from)!r}")
    flight.write_lines("atmosphere.csv", out)
    flight.append(
        "[atmosphere.columns]\n"
        'alt = { column = "ALT (km)", unit = "km" }\n'
        'wind_speed = { column = "SPEED (kt)", unit = "kt" }\n'
        'wind_from = { column = "FROM (deg)", unit = "deg" }'
    )
    telemetry = read_flight(flight.root)
    _same(telemetry, read_flight(clean_flight.root), rtol=1e-9)
    assert abs(rows[3][3]) > 1.0, "the wind of the test must have a sign to lose"


def test_west_wind_blows_east(flight) -> None:
    rows = [row.split(",")[:3] for row in flight.lines("atmosphere.csv")[1:]]
    flight.write_lines("atmosphere.csv", ["alt_m,rho_kgpm3,t_k,FF,DD", *(",".join([*r, "10.0", "270"]) for r in rows)])
    flight.append(
        "[atmosphere.columns]\n"
        'wind_speed = { column = "FF", unit = "mps" }\n'
        'wind_from = { column = "DD", unit = "deg" }'
    )
    sounding = read_flight(flight.root).sounding
    np.testing.assert_allclose(sounding.wind_east_mps, 10.0, rtol=1e-12)
    np.testing.assert_allclose(sounding.wind_north_mps, 0.0, atol=1e-12)


def test_wind_from_is_said_to_have_been_turned(flight) -> None:
    rows = [row.split(",")[:3] for row in flight.lines("atmosphere.csv")[1:]]
    header = "alt_m,rho_kgpm3,t_k,wind_speed_mps,wind_from_deg"
    flight.write_lines("atmosphere.csv", [header, *(",".join([*r, "10.0", "270"]) for r in rows)])
    assert findings_of(flight, "atmosphere", "values-converted")


def test_pressure_that_contradicts_density_and_temperature_is_told(flight) -> None:
    """Given twice the pressure that the gas law allows, something in the file is not what its column says."""
    rows = [row.split(",") for row in flight.lines("atmosphere.csv")]
    out = [",".join([*rows[0], "p_pa"])]
    out += [",".join([*r, f"{2.0 * 287.05 * float(r[1]) * float(r[2]):.8g}"]) for r in rows[1:]]
    flight.write_lines("atmosphere.csv", out)
    assert findings_of(flight, "atmosphere", "sounding-balance")


def test_times_across_new_year(flight) -> None:
    """Launch on 31 December 23:55: day 366 of 2008 is followed by day 001."""
    flight.replace("flight.toml", T0_UTC, "2008-12-31T23:52:57Z")
    launch = dt.datetime(2008, 12, 31, 23, 52, 57, tzinfo=dt.UTC)

    def irig(seconds: str) -> str:
        return (launch + dt.timedelta(microseconds=round(float(seconds) * 1e6))).strftime("%j:%H:%M:%S.%f")

    seconds = [float(v) for v in flight.column("radar_north.csv", 0)]
    flight.map_column("radar_north.csv", 0, irig)
    assert {c[:3] for c in flight.column("radar_north.csv", 0)} == {"366", "001"}
    flight.declare('time = { column = "t_s", format = "irig_doy" }', 'file = "telemetry/radar_north.csv"')
    np.testing.assert_allclose(read_flight(flight.root).radars["north"].time_s, seconds, rtol=0, atol=1.01e-6)


def test_wind_speed_without_direction_is_refused(flight) -> None:
    flight.header("atmosphere.csv", "wind_n_mps", "FF")
    flight.header("atmosphere.csv", "wind_e_mps", "DD")
    flight.append('[atmosphere.columns]\nwind_speed = { column = "FF", unit = "mps" }')
    refused(flight, "atmosphere", codes={"column-missing"})


# --------------------------------------------------------------------------------------------------- missing and odd


def test_nan_burst_is_accepted_and_becomes_a_finding_with_times(flight) -> None:
    for line in range(52, 72):
        flight.cell("accelerometer.csv", line, 1, "nan")
    telemetry = read_flight(flight.root)
    hits = [f for f in telemetry.findings if "accelerometer" in f.source]
    assert hits, "a burst of missing values must be a finding"
    times = [float(v) for v in flight.column("accelerometer.csv", 0)]
    assert any(abs(f.start_s - times[50]) < 0.11 and abs(f.end_s - times[69]) < 0.11 for f in hits)


def test_radar_nan_burst_is_a_finding_with_times(flight) -> None:
    for line in range(22, 42):
        for column in (1, 2, 3):
            flight.cell("radar_south.csv", line, column, "NaN")
    times = [float(v) for v in flight.column("radar_south.csv", 0)]
    hits = [f for f in read_flight(flight.root).findings if "south" in f.source]
    assert any(abs(f.start_s - times[20]) < 0.21 and abs(f.end_s - times[39]) < 0.21 for f in hits)


def test_empty_cells_are_missing_not_zero(flight) -> None:
    for line in range(52, 72):
        flight.cell("rates.csv", line, 2, "")
    telemetry = read_flight(flight.root)
    assert any("rates" in f.source for f in telemetry.findings)
    inside = (telemetry.rates.time_s > 422.56) & (telemetry.rates.time_s < 423.4)
    assert not (telemetry.rates.measured_sensor[inside, 1] == 0.0).any()


@pytest.mark.parametrize("body", ["", "nan"])
def test_radar_without_data_is_refused(flight, body: str) -> None:
    lines = flight.lines("radar_north.csv")
    if body:
        flight.write_lines("radar_north.csv", [lines[0], *(row.split(",")[0] + ",nan,nan,nan" for row in lines[1:])])
    else:
        flight.write_lines("radar_north.csv", lines[:1])
    refused(flight, "radar_north.csv", "north", codes={"too-few-rows"})


def test_accelerometer_all_missing_is_refused(flight) -> None:
    for k in (1, 2, 3):
        flight.map_column("accelerometer.csv", k, lambda _: "nan")
    refused(flight, "accelerometer", codes={"too-few-rows"})


def test_single_sample_is_refused(flight) -> None:
    flight.write_lines("rates.csv", flight.lines("rates.csv")[:2])
    refused(flight, "rates.csv", codes={"too-few-rows"})


def test_no_radar_at_all(flight) -> None:
    text = flight.path("flight.toml").read_text()
    start, end = text.index("[radars.north]"), text.index("[atmosphere]")
    flight.path("flight.toml").write_text(text[:start] + text[end:])
    refused(flight, "radars", kind=ConfigError, codes={"tracker-missing"})


def test_gap_is_a_finding_with_its_times(flight) -> None:
    lines = flight.lines("rates.csv")
    flight.write_lines("rates.csv", lines[:60] + lines[90:])
    hits = findings_of(flight, "rates", "data-gap")
    assert len(hits) == 1
    assert hits[0].start_s == pytest.approx(float(lines[59].split(",")[0]), abs=1e-9)
    assert hits[0].end_s == pytest.approx(float(lines[90].split(",")[0]), abs=1e-9)


def test_frozen_sensor_is_a_finding_with_its_times(flight) -> None:
    lines = flight.lines("accelerometer.csv")
    held = lines[60].split(",", 1)[1]
    for k in range(60, 140):
        lines[k] = lines[k].split(",")[0] + "," + held
    flight.write_lines("accelerometer.csv", lines)
    hits = findings_of(flight, "accelerometer", "data-frozen")
    assert hits
    assert hits[0].start_s == pytest.approx(float(lines[60].split(",")[0]), abs=0.051)
    assert hits[0].end_s == pytest.approx(float(lines[139].split(",")[0]), abs=0.051)


def test_frozen_single_axis_is_a_finding(flight) -> None:
    lines = flight.lines("rates.csv")
    for k in range(60, 140):
        cells = lines[k].split(",")
        lines[k] = ",".join([cells[0], cells[1], "1.25", cells[3]])
    flight.write_lines("rates.csv", lines)
    assert findings_of(flight, "rates", "data-frozen-or-saturated")


def test_frozen_radar_is_a_finding(flight) -> None:
    lines = flight.lines("radar_north.csv")
    held = lines[20].split(",", 1)[1]
    for k in range(20, 70):
        lines[k] = lines[k].split(",")[0] + "," + held
    flight.write_lines("radar_north.csv", lines)
    assert findings_of(flight, "north", "data-frozen")


def test_saturated_run_is_a_finding_with_its_times(flight) -> None:
    """The package's stop cuts both peaks of az: runs at the largest and smallest value between live samples."""
    flight.map_column("accelerometer.csv", 1, lambda v: repr(max(min(float(v) * 10, 2.0), -2.0)))
    hits = findings_of(flight, "accelerometer", "data-frozen-or-saturated")
    assert hits
    times = read_flight(flight.root).accelerometer.time_s
    assert all(times[0] <= f.start_s < f.end_s <= times[-1] for f in hits)


# -------------------------------------------------------------------------------------------------------- flight.toml


@pytest.mark.parametrize(
    ("old", "new", "nearest"),
    [
        ("t0_utc =", "t0_ucv =", "t0_utc"),
        ("latitude_deg = 37.841", "lattitude_deg = 37.841", "latitude_deg"),
        ('mount = "suba"', 'mout = "suba"', "mount"),
        ("[atmosphere]", "[atmosphre]", "atmosphere"),
        ("benchmark_s", "benchmark", "benchmark_s"),
        ("[sensors.rates]", "[sensors.rate]", "rates"),
        ("sd_deg = 3.0", "sd = 3.0", "sd_deg"),
    ],
)
def test_unknown_key_names_the_nearest(flight, old: str, new: str, nearest: str) -> None:
    flight.replace("flight.toml", old, new)
    wrong = new.split(" =")[0].strip("[]").split(".")[-1]
    error = refused(flight, "flight.toml", wrong, nearest, kind=ConfigError, codes={"key-missing", "key-unknown"})
    one_line_with(error, wrong, f"'{nearest}'")


@pytest.mark.parametrize(("line", "text"), [(4, "name = "), (10, "[sensors.accelerometer"), (3, 'vehicle = "x" "y"')])
def test_bad_toml_names_the_line(flight, line: int, text: str) -> None:
    lines = flight.lines("flight.toml")
    lines.insert(line - 1, text)
    flight.write_lines("flight.toml", lines)
    assert names_line(str(refused(flight, "flight.toml", kind=ConfigError, codes={"toml-syntax"})), line)


def test_toml_that_is_not_text(flight) -> None:
    flight.path("flight.toml").write_bytes(bytes(range(128, 256)) * 4)
    refused(flight, "flight.toml", kind=ConfigError, codes={"toml-syntax"})


@pytest.mark.parametrize("name", ["irve2_refrence", "irve_2_reference", "IRVE2-REFERENCE"])
def test_wrong_vehicle_names_the_nearest(flight, name: str) -> None:
    flight.replace("flight.toml", 'vehicle = "irve2_reference"', f'vehicle = "{name}"')
    refused(flight, name, "irve2_reference", kind=ConfigError, codes={"name-unknown"})


def test_vehicle_file_that_is_missing(flight) -> None:
    flight.replace("flight.toml", 'vehicle = "irve2_reference"', 'vehicle = "mine.toml"')
    refused(flight, "mine.toml", kind=ConfigError, codes={"file-missing"})


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('mount = "suba"', 'mount = "subb"', ("subb", "suba")),
        ('camera = "camera5"', 'camera = "camera6"', ("camera6", "camera5")),
        ('t0_utc = "2009-08-17T12:52:00Z"', 't0_utc = "yesterday"', ("t0_utc", "yesterday")),
        ('t0_utc = "2009-08-17T12:52:00Z"', 't0_utc = "2009-13-41T12:52:00Z"', ("t0_utc", "2009-13-41")),
        ("latitude_deg = 37.841", "latitude_deg = 137.841", ("latitude_deg", "137.841")),
        ("latitude_deg = 37.841", 'latitude_deg = "37.841 N"', ("latitude_deg", "37.841 N")),
        ("longitude_deg = -75.485", "longitude_deg = nan", ("longitude_deg", "nan")),
        ("sd_deg = 3.0", "sd_deg = -3.0", ("sd_deg", "-3")),
        ("0.394325", "1.394325", ("q_ecef_body",)),
        ("[0.394325, -0.583769, -0.087256, 0.704349]", "[0.0, 0.0, 0.0, 0.0]", ("q_ecef_body",)),
        ("[0.394325, -0.583769, -0.087256, 0.704349]", "[0.39, -0.58, 0.7]", ("q_ecef_body",)),
    ],
)
def test_bad_value_names_the_key_and_the_value(flight, old: str, new: str, words: tuple[str, ...]) -> None:
    flight.replace("flight.toml", old, new)
    refused(flight, *words, codes={"name-unknown", "key-missing", "key-value", "value-range"})


def test_zero_standard_deviation_is_refused(flight) -> None:
    flight.declare("range_sd_m = 0.0", "height_m = 12.0")
    refused(flight, "range_sd_m", kind=ConfigError, codes={"key-value"})


def test_all_faults_of_the_configuration_at_once(flight) -> None:
    flight.replace("flight.toml", "latitude_deg = 37.841", "lattitude_deg = 37.841")
    flight.replace("flight.toml", 'mount = "suba"', 'mout = "suba"')
    flight.replace("flight.toml", "height_m = 7.0", 'height_m = "seven"')
    error = refused(
        flight, "lattitude_deg", "mout", "height_m", kind=ConfigError, codes={"key-missing", "key-unknown", "key-value"}
    )
    assert len(error.faults) >= 3


@pytest.mark.parametrize("way", ["../outside.csv", "telemetry/../../outside.csv", "{absolute}"])
def test_a_path_that_leaves_the_folder_is_refused(flight, way: str) -> None:
    outside = flight.root.parent / "outside.csv"
    shutil.copyfile(flight.path("rates.csv"), outside)
    way = way.replace("{absolute}", str(outside))
    flight.replace("flight.toml", "telemetry/rates.csv", way)
    refused(flight, way, kind=ConfigError, codes={"path-refused"})


@pytest.mark.parametrize("way", ["truth/rates.csv", "telemetry/../truth/rates.csv", "./truth/rates.csv"])
def test_a_path_into_the_truth_is_refused(flight, way: str) -> None:
    (flight.root / "truth").mkdir()
    shutil.copyfile(flight.path("rates.csv"), flight.root / "truth" / "rates.csv")
    flight.replace("flight.toml", "telemetry/rates.csv", way)
    refused(flight, "truth", kind=ConfigError, codes={"path-refused"})


def test_a_link_into_the_truth_is_refused(flight) -> None:
    (flight.root / "truth").mkdir()
    shutil.move(flight.path("rates.csv"), flight.root / "truth" / "rates.csv")
    flight.path("rates.csv").symlink_to(flight.root / "truth" / "rates.csv")
    refused(flight, "rates.csv", codes={"path-refused"})


def test_a_picture_outside_the_folder_is_refused(flight) -> None:
    shutil.copyfile(flight.root / "telemetry/camera5/frame_1.png", flight.root.parent / "frame_1.png")
    flight.cell("frames.csv", 3, 1, "../../../frame_1.png")
    refused(flight, "frames.csv", "../../../frame_1.png", codes={"path-refused"})


def test_a_folder_of_pictures_outside_is_refused(flight) -> None:
    shutil.copytree(flight.root / "telemetry/camera5", flight.root.parent / "camera5")
    flight.replace("flight.toml", 'folder = "telemetry/camera5"', 'folder = "../camera5"')
    refused(flight, "../camera5", kind=ConfigError, codes={"path-refused"})


# ------------------------------------------------------------------------------------------------------------- frames


def test_missing_frame(flight) -> None:
    (flight.root / "telemetry/camera5/frame_1.png").unlink()
    error = refused(flight, "frame_1.png", codes={"file-missing"})
    assert "frame_0.png" not in str(error)


@pytest.mark.parametrize("content", [b"", b"not a picture at all", b"\x89PNG\r\n\x1a\n" + bytes(200)])
def test_frame_that_cannot_be_decoded(flight, content: bytes) -> None:
    (flight.root / "telemetry/camera5/frame_2.png").write_bytes(content)
    refused(flight, "frame_2.png", codes={"file-unreadable"})


def test_frame_cut_short(flight) -> None:
    path = flight.root / "telemetry/camera5/frame_2.png"
    path.write_bytes(path.read_bytes()[:-3000] if path.stat().st_size > 6000 else path.read_bytes()[:400])
    refused(flight, "frame_2.png", codes={"file-unreadable"})


def test_frame_of_the_wrong_size_names_both_sizes(flight) -> None:
    import cv2

    cv2.imwrite(str(flight.root / "telemetry/camera5/frame_1.png"), np.full((240, 320), 90, np.uint8))
    refused(flight, "frame_1.png", "320", "240", "720", "480", codes={"frame-size"})


@pytest.mark.parametrize(
    ("form", "t0", "before", "cell"),
    [
        ("utc", "2016-12-31T23:59:00Z", "2016-12-31T23:59:{:07.4f}Z", "2016-12-31T23:59:60.2000Z"),
        ("utc", "2009-08-17T12:52:00Z", "2009-08-17T12:52:{:07.4f}Z", "2009-08-17T12:52:60.000Z"),
        ("irig_doy", "2009-08-17T12:52:00Z", "229:12:52:{:06.3f}", "229:12:52:60.000"),
    ],
)
def test_second_60_says_what_to_do(flight, form: str, t0: str, before: str, cell: str) -> None:
    """A leap second, or a clock that rounds 59.9996."""
    flight.replace("flight.toml", "2009-08-17T12:52:00Z", t0)
    times = [before.format(at) for at in np.linspace(50.0, 59.9, len(flight.lines("rates.csv")) - 1)]
    times[-1] = cell
    remaining = iter(times)
    flight.map_column("rates.csv", 0, lambda _: next(remaining))
    flight.declare(f'time = {{ column = "t_s", format = "{form}" }}', 'file = "telemetry/rates.csv"')
    error = refused(flight, cell, "seconds", codes={"time-format"})
    assert names_line(str(error), len(times) + 1)


def test_second_60_of_a_time_of_day(flight) -> None:
    """In three columns it was taken for the next minute's second 0, which the next row may have as well."""
    lines = flight.lines("radar_north.csv")
    rows = [f"12,{59 + (k >= 20)},{41 + k if k < 20 else k - 20}" for k in range(len(lines) - 1)]
    rows[19] = "12,59,60"
    cells = [line.split(",", 1)[1] for line in lines]
    head = "h,m,s," + cells[0]
    flight.write_lines("radar_north.csv", [head, *(f"{r},{c}" for r, c in zip(rows, cells[1:], strict=True))])
    time = 'time = { format = "utc_hms", columns = ["h", "m", "s"] }'
    flight.declare(time, 'file = "telemetry/radar_north.csv"')
    assert names_line(str(refused(flight, "12:59:60", codes={"time-format"})), 21)


def test_frame_listed_without_a_name(flight) -> None:
    flight.cell("frames.csv", 3, 1, "")
    assert names_line(str(refused(flight, "frames.csv", codes={"file-missing"})), 3)


def test_colour_frame_is_read(flight) -> None:
    import cv2

    path = str(flight.root / "telemetry/camera5/frame_1.png")
    cv2.imwrite(path, np.dstack([cv2.imread(path, cv2.IMREAD_GRAYSCALE)] * 3))
    assert read_flight(flight.root).frames is not None


# -------------------------------------------------------------------------------------------------- all faults at once


def test_faults_of_several_files_are_told_at_once(flight) -> None:
    flight.cell("accelerometer.csv", 83, 2, "abc")
    flight.path("rates.csv").unlink()
    flight.header("radar_north.csv", "az_deg", "azi_deg")
    flight.write_lines("radar_south.csv", flight.lines("radar_south.csv")[:1])
    flight.cell("atmosphere.csv", 9, 1, "-1")
    (flight.root / "telemetry/camera5/frame_1.png").write_bytes(b"spoilt")
    error = refused(
        flight,
        *("accelerometer.csv", "rates.csv", "radar_north.csv", "radar_south.csv", "atmosphere.csv", "frame_1.png"),
        codes={
            "file-missing",
            "file-unreadable",
            "not-a-number",
            "column-missing",
            "too-few-rows",
            "value-range",
        },
    )
    assert len(error.faults) >= 6


def test_faults_of_one_file_are_told_at_once(flight) -> None:
    flight.cell("radar_north.csv", 12, 1, "abc")
    flight.cell("radar_north.csv", 40, 0, "421.0")
    flight.cell("radar_north.csv", 60, 2, "inf")
    text = str(refused(flight, "abc", "421.0", codes={"not-a-number", "rows-contradict", "value-range"}))
    assert all(names_line(text, line) for line in (12, 40, 60))


# --------------------------------------------------------------------------------------- the command and what it leaves


def _spoil_data(flight) -> None:
    flight.cell("accelerometer.csv", 83, 2, "abc")


def _spoil_configuration(flight) -> None:
    flight.replace("flight.toml", "t0_utc =", "t0_ucv =")


@pytest.mark.parametrize(
    ("verb", "spoil", "code"),
    [("run", _spoil_data, 3), ("reconstruct", _spoil_configuration, 2), ("deflection", _spoil_data, 3)],
)
def test_refusal_has_its_exit_code_and_writes_nothing(flight, command, verb: str, spoil, code: int) -> None:
    spoil(flight)
    before = flight.contents()
    done = command(verb, flight.root)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert any(line.startswith("error:") for line in done.stderr.splitlines())
    assert done.stdout == ""
    assert flight.contents() == before
    assert list(flight.root.parent.iterdir()) == [flight.root]


@pytest.mark.parametrize(
    ("verb", "old", "new", "time_s"),
    [
        ("reconstruct", "t_s = 420.0", "t_s = 900.0", 900.0),
        ("reconstruct", "t_s = 420.0", "t_s = -50.0", -50.0),
    ],
)
def test_time_outside_the_data_is_refused(flight, command, verb: str, old: str, new: str, time_s: float) -> None:
    flight.replace("flight.toml", old, new)
    before = flight.contents()
    done = command(verb, flight.root)
    assert done.returncode == 3, done.stdout + done.stderr
    assert printed_codes(done.stderr) == ["time-not-covered"]
    assert time_s in numbers_in(done.stderr)
    assert flight.contents() == before


def test_refusal_leaves_an_older_run_alone(flight, command) -> None:
    old = flight.root / "runs" / "20260101T000000Z-00000000"
    old.mkdir(parents=True)
    (old / "run.json").write_text("{}")
    _spoil_data(flight)
    before = flight.contents()
    assert command("run", flight.root).returncode == 3
    assert flight.contents() == before


def test_message_names_the_file_as_the_user_gave_the_folder(flight, command) -> None:
    """Relative in, relative out: the message leads to the file from where the user stands."""
    _spoil_data(flight)
    done = command("run", flight.root.name, cwd=flight.root.parent)
    assert str(Path(flight.root.name) / "telemetry" / "accelerometer.csv") in done.stderr

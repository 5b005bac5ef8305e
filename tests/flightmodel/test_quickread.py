"""The quick reader gives what the careful reader gives, to the last bit, or nothing: it never decides on its own."""

from __future__ import annotations

import hashlib
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightmodel import csv_reading
from flightmodel.checks import GateError
from flightmodel.csv_reading import read_numbers
from flightmodel.tables import TimeColumn, numbers, read_table, times_s, unordered_times_s
from tests.refusing import refuses

ROOT = Path(__file__).parents[2]
T0 = datetime(2009, 8, 17, 12, 52, tzinfo=UTC)
SHIPPED = sorted(p for d in ("tests/data", "examples") for p in (ROOT / d).rglob("*.csv"))


@pytest.fixture(autouse=True, params=["pyarrow", "pandas"])
def every_file_is_large(monkeypatch, request):
    """Small files are spared the loading of a library; here all go the quick way, in small pieces, by either one."""
    monkeypatch.setattr(csv_reading, "SMALLEST_BYTES", 0)
    monkeypatch.setattr(csv_reading, "PIECE_BYTES", 997)
    if request.param == "pandas":
        monkeypatch.setitem(sys.modules, "pyarrow", None)  # what `import` takes as not installed
    else:
        pytest.importorskip("pyarrow", reason="pyarrow comes with the parquet extra")


def carefully(path, names):
    """Columns as the careful reader has them, its lines, and its faults."""
    faults = []
    frame = read_table(path, "label")
    return {n: numbers(frame, n, path, "label", faults) for n in names}, frame.attrs["lines"], faults


def same_bits(a, b):
    np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
    known = ~np.isnan(a)
    np.testing.assert_array_equal(a[known].view(np.int64), b[known].view(np.int64))


def values_of(texts, folder):
    """What the quick reader makes of cells below each other; None where it leaves them to the careful reader."""
    path = folder / "cells.csv"
    path.write_bytes("".join(f"{text},0\n" for text in ["a", *texts, "1"]).encode())
    read = read_numbers(path, {"a": True})
    return None if read is None else read.columns["a"][:-1]


# ------------------------------------------------------------------------------------------------------------ one cell

FORMS = ("{!r}", "{:.17g}", "{:.20e}", "{:.9f}", "{:.6g}", "{:.25g}")


def test_a_number_is_rounded_as_python_rounds_it(tmp_path):
    rng = np.random.default_rng(7)
    drawn = rng.integers(-(2**63), 2**63, size=2000).view(np.float64)
    drawn = np.concatenate([drawn[np.isfinite(drawn)], rng.normal(size=500), rng.integers(0, 2**63, 500), [5e-324]])
    texts = [form.format(float(value)) for value in drawn for form in FORMS]
    texts += [f"{w}e{q}" for w, q in zip(rng.integers(0, 2**63, 3000), rng.integers(-340, 289, 3000), strict=True)]
    # half way between two float64 numbers, and scaled by powers of ten where that is exact
    odd = (2**53 + 1, 2**53 + 3, 2**54 + 2, 2**60 + 128, 9007199254740995, 5**22 * 3 + 1)
    texts += [f"{w}e{q}" for w in odd for q in range(-20, 30)]
    same_bits(values_of(texts, tmp_path), np.array([float(text) for text in texts]) + 0.0)


@pytest.mark.parametrize(
    ("text", "value"),
    [("+5", 5.0), ("5.", 5.0), (".5", 0.5), ("-.5E-03", -0.0005), ("007.250", 7.25), ("-0.0", 0.0), ("1e-400", 0.0),
     (" 2 ", 2.0), ("\t3", 3.0), ("0" * 30, 0.0), ("00012345678901234.5", 12345678901234.5)],
)  # fmt: skip
def test_plain_forms(tmp_path, text, value):
    same_bits(values_of([text], tmp_path), np.array([value]))


@pytest.mark.parametrize("text", ["", " ", 12 * " ", "nan", "NaN", "NAN", "na", "NA", "null", "Null", "-"])
def test_missing_cells(tmp_path, text):
    assert np.isnan(values_of([text], tmp_path)).all()


@pytest.mark.parametrize(
    "text",
    ["abc", "1_5", "0x1F", "--", "1e", "1e+", "#REF!", "1 234.5", "inf", "-inf", "1e999", "+", ".", "-.", "e5", "nano",
     "nul", "n", "-nan", "+NaN", "1.2.3", "1d5", "١", '"1.0"', "1\v", "1\0", "1;2", "True", "#", "# 1", "Infinity"],
)  # fmt: skip
def test_anything_else_is_left_to_the_careful_reader(tmp_path, text):
    assert values_of([text], tmp_path) is None


# --------------------------------------------------------------------------------------------------------- whole files


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: str(p.relative_to(ROOT)))
def test_shipped_tables_are_equal_to_the_bit(path):
    frame, names = read_table(path, "label"), []
    for name in frame.columns:
        faults = []
        numbers(frame, name, path, "label", faults)
        names += [] if faults else [name]
    quick = read_numbers(path, dict.fromkeys(names, True))
    assert quick is not None
    wanted, lines, _ = carefully(path, names)
    assert list(quick.columns) == [n for n in frame.columns if n in names]
    for name in names:
        same_bits(quick.columns[name], wanted[name])
    np.testing.assert_array_equal(quick.first_line + np.arange(len(lines)), lines)


NUMBER = st.one_of(
    st.floats(-1e6, 1e6).map(lambda v: f"{v:.6g}"),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**6), 10**6).map(str),
    st.sampled_from(["", "nan", "NA", " 2.5 ", "-", "1e3"]),
)
ODD = st.sampled_from(["abc", '"1.5"', "1,2", "1\n", "inf", "٣", "1_0", "\r", "1\v2", "\x00", "1.5.2", '"a', "é"])


@settings(max_examples=120, deadline=None)
@given(data=st.data())
def test_any_table_is_read_alike_or_left_alone(data, tmp_path_factory):
    width = data.draw(st.integers(1, 4))
    rows = data.draw(st.lists(st.lists(NUMBER, min_size=width, max_size=width), min_size=2, max_size=40))
    odd = data.draw(st.integers(0, 2)) == 0
    if odd:
        rows[data.draw(st.integers(0, len(rows) - 1))][data.draw(st.integers(0, width - 1))] = data.draw(ODD)
    end = data.draw(st.sampled_from(["\n", "\r\n"]))
    last = data.draw(st.sampled_from(["", end, end + end, end + "  " + end]))
    mark = data.draw(st.sampled_from(["", "\ufeff"]))
    names = [f"c{k} (m)" for k in range(width)]
    path = tmp_path_factory.mktemp("any") / "table.csv"
    path.write_bytes((mark + end.join([",".join(names), *(",".join(row) for row in rows)]) + last).encode())
    asked = data.draw(st.sets(st.sampled_from(names), min_size=1))
    quick = read_numbers(path, dict.fromkeys(asked, True))
    try:
        wanted, lines, faults = carefully(path, asked)
    except GateError:
        assert quick is None
        return
    if quick is None:
        # only what is odd, or a table of one column, may be left alone
        assert odd or width == 1
        return
    assert not faults
    assert (quick.first_line + np.arange(len(lines)) == lines).all()
    for name in asked:
        same_bits(quick.columns[name], wanted[name])


def test_an_open_quote_is_refused_with_its_line(tmp_path):
    path = tmp_path / "t.csv"
    for rows in (["1,2", '3,"4', "5,6"], ["1,2", '3,"4'], ["1,2", '3,"4', '5",6']):
        path.write_text("\n".join(["a,b", *rows]))
        with refuses("row-ragged", names=["line 3"]):
            read_table(path, "label")
        assert read_numbers(path, {"a": True}) is None


def write(path, header, rows):
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_only_what_is_asked_for_must_be_numbers(tmp_path):
    path = write(tmp_path / "t.csv", "t_s,mode,a", [f"{k},phase {k % 3},{0.1 * k:.3f}" for k in range(300)])
    read = read_numbers(path, {"a": True, "absent": False}, TimeColumn())
    assert list(read.columns) == ["t_s", "a"]
    np.testing.assert_array_equal(read.time, np.arange(300.0))
    assert read_numbers(path, {"mode": True}) is None
    assert read_numbers(path, {"absent": True}) is None


@pytest.mark.parametrize("row", ["1,2", "1,2,3,4", "1,2,3,", '1,"2",3', "", "  ", "1,2\r,3", "1,2,x", "1,é,3"])
def test_an_unusual_row_anywhere_leaves_the_file_to_the_careful_reader(tmp_path, row):
    for place in (0, 1, 150, 298):
        rows = [f"{k},{k}.5,{k}" for k in range(300)]
        rows.insert(place, row)
        path = write(tmp_path / "t.csv", "t_s,a,note", rows)
        usual = row == "1,2,x"
        assert (read_numbers(path, {"a": True}, TimeColumn()) is not None) == usual


@pytest.mark.parametrize(
    "header", ["t_s,a,a", "t_s,a", 't_s,"a,b', "t_s,a,\xff".encode("latin-1"), b"t\0_s,a,b", "t_s,a\rb,c", "t_s,b,c"]
)
def test_a_header_that_is_not_plain_is_left_to_the_careful_reader(tmp_path, header):
    path = tmp_path / "t.csv"
    head = header if isinstance(header, bytes) else header.encode()
    path.write_bytes(head + b"\n" + b"1,2,3\n" * 500)
    assert read_numbers(path, {"a": True}, TimeColumn()) is None


def test_quoted_names_and_lines_before_the_header(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text('\n  \n t_s ,"AX, inboard"\n' + "".join(f"{k},{k}.25\n" for k in range(400)) + "\n\n")
    read = read_numbers(path, {"AX, inboard": True}, TimeColumn())
    np.testing.assert_array_equal(read.columns["AX, inboard"], np.arange(400) + 0.25)
    assert read.first_line == 4
    wanted, lines, _ = carefully(path, ["t_s", "AX, inboard"])
    assert lines[0] == 4
    same_bits(read.time, wanted["t_s"])


@pytest.mark.parametrize("last", ["", "\n", "\n\n \n", "\r\n"])
def test_lines_longer_than_a_piece_and_files_that_end_anyhow(tmp_path, last):
    rows = [f"{k},{'x' * (3000 if k % 7 == 0 else 5)},{k}.5" for k in range(60)]
    path = tmp_path / "t.csv"
    path.write_bytes(("t_s,note,a\n" + "\n".join(rows) + last).encode())
    read = read_numbers(path, {"a": True}, TimeColumn())
    np.testing.assert_array_equal(read.columns["a"], np.arange(60) + 0.5)


# ---------------------------------------------------------------------------------------------------------------- time


def _irig(second):
    return (T0 + timedelta(seconds=second)).strftime("%j:%H:%M:%S.%f")


@pytest.mark.parametrize(
    ("form", "written"),
    [
        ("irig_doy", _irig),
        ("irig_doy", lambda s: _irig(s)[:12]),
        ("irig_doy", lambda s: f"  {_irig(s)[: 13 + int(s) % 4]}"),
        ("utc", lambda s: (T0 + timedelta(seconds=s)).isoformat()),
        ("utc", lambda s: (T0 + timedelta(seconds=s)).strftime("%Y-%m-%dT%H:%M:%S.%fZ") + " "),
    ],
)
def test_clock_times_are_those_of_the_careful_reader(tmp_path, form, written):
    seconds = np.arange(200) * 7.25
    path = write(tmp_path / "t.csv", "clock,a", [f"{written(s)},{k}" for k, s in enumerate(seconds)])
    time = TimeColumn("clock", form)
    read = read_numbers(path, {"a": True}, time, T0)
    faults = []
    wanted = times_s(read_table(path, "x"), time, T0, path, "x", faults)
    if wanted is None:  # whole seconds only, so that times repeat
        wanted = unordered_times_s(read_table(path, "x"), time, T0, path, "x", [])
    same_bits(read.time, wanted)
    np.testing.assert_allclose(read.time, seconds, atol=1.0)


@pytest.mark.parametrize(
    "cell", ["", "noon", "229:25:00:00.0", "367:12:00:00.0", "229:12:61:00", "229:12:00:60.0", "é"]
)
def test_a_time_that_does_not_exist_is_left_to_the_careful_reader(tmp_path, cell):
    rows = [f"{_irig(k)},{k}" for k in range(300)]
    rows[200] = f"{cell},1"
    path = write(tmp_path / "t.csv", "clock,a", rows)
    assert read_numbers(path, {"a": True}, TimeColumn("clock", "irig_doy"), T0) is None


def test_day_366_and_new_year_in_either_reader():
    from flightmodel.tables import clock_times

    eve = datetime(2008, 12, 31, 23, 52, 57, tzinfo=UTC)
    cells = ["366:23:59:59.500", "001:00:00:00.250", "1:00:00:01", "365:23:52:57.0", "366:24:00:00.0", "000:12:00:00.0"]
    told = clock_times(cells, "irig_doy", eve)
    np.testing.assert_array_equal(told[:4], [422.5, 423.25, 424.0, -86400.0])
    assert np.isnan(told[4:]).all()
    assert np.isnan(clock_times(["366:12:00:00.0"], "irig_doy", T0)).all()


# ---------------------------------------------------------------------------------------------------------- at the gate


def test_at_the_gate_both_ways_give_the_same_table(tmp_path, monkeypatch):
    from flightmodel.gate import Gate
    from flightmodel.tables import ACCELEROMETER, Source

    rng = np.random.default_rng(3)
    rows = [f"{1e3 * k + 0.1:.1f},{x:.5f},,{z:.3f},-0.0" for k, (x, z) in enumerate(rng.normal(size=(400, 2)))]
    write(tmp_path / "t.csv", "T (ms),AX (g),ay_suba_mps2,az_suba_mps2,spare", rows)
    source = Source(
        file="t.csv", time={"column": "T (ms)", "unit": "ms"}, columns={"ax": {"column": "AX (g)", "unit": "g"}}
    )
    tables = []
    for smallest in (0, 10**9):
        monkeypatch.setattr(csv_reading, "SMALLEST_BYTES", smallest)
        gate = Gate(tmp_path, T0)
        tables.append(gate.table("sensors.accelerometer", source, ACCELEROMETER))
        assert (tmp_path / "t.csv" in gate.digests) == (smallest == 0)
        assert gate.sha256(tmp_path / "t.csv") == hashlib.sha256((tmp_path / "t.csv").read_bytes()).hexdigest()
        assert not gate.faults
    quick, careful = tables
    same_bits(quick.time_s, careful.time_s)
    assert list(quick.columns) == list(careful.columns)
    for short in ("ax", "ay", "az"):
        same_bits(quick.columns[short], careful.columns[short])
    np.testing.assert_array_equal(quick.lines, careful.lines)
    assert quick.at(7) == careful.at(7)

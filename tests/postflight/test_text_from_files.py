"""Text from files stays text: in the terminal, in a notebook's code and Markdown, in spreadsheets and globes."""

import ast
import io
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from flightmodel.checks import ConfigError
from flightmodel.flightfolder import read_flight
from postflight import exports, run_folder
from postflight.report import notebook
from postflight.streams import visible
from postflight.terminal import Terminal
from tests.refusing import printed_codes, refuses

ESCAPE, BIDI = "\x1b[2J\x1b]0;owned\x07", "\u202etxt.exe\u2066"
WITHIN_S = 120.0


@pytest.mark.parametrize("sign", ["\x1b", "\x07", "\r", "\x9b", "\u202e", "\u2066", "\u200b", "\u2028", "\udc80"])
def test_what_does_something_is_seen_instead(sign):
    assert visible(f"a{sign}b") == "a?b"


def test_words_of_every_language_are_left_alone():
    words = "Größe 温度 مرحبا ± 3.2 °\n\tnext"
    assert visible(words) == words


def test_a_console_on_a_terminal_keeps_its_own_colours_and_no_others():
    out = io.StringIO()
    console = Terminal(file=out, force_terminal=True, width=60, color_system="standard")
    console.print(f"[red]mark[/] {ESCAPE}{BIDI}")
    text = out.getvalue()
    assert "\x1b[31mmark" in text
    assert "\x1b[2J" not in text
    assert not set(text) & set("\x07\u202e\u2066")


@pytest.mark.parametrize("sign", ["\\u001b[31m", "\\u202e", "\\n", "\\r"])
def test_a_name_with_control_characters_is_refused(flight, sign):
    flight.replace("flight.toml", 'name = "hand-made"', f'name = "hand{sign}made"')
    with refuses("key-value", names=["'?name"], kind=ConfigError) as caught:
        read_flight(flight.root)
    assert not set(str(caught.value)) & set("\x1b\u202e\r")


@pytest.mark.parametrize("verb", ["check", "run"])
def test_names_of_columns_and_files_do_not_reach_the_terminal_raw(flight, command, verb):
    flight.header("rates.csv", "q_body_degps", f"q{ESCAPE}{BIDI}")
    done = command(verb, flight.root)
    assert done.returncode in (2, 3)
    assert "column-missing" in printed_codes(done.stdout + done.stderr)
    assert not set(done.stdout + done.stderr) & set("\x1b\x07\u202e\u2066")


def command_line(*arguments):
    return [sys.executable, "-m", "postflight.cli", *map(str, arguments)]


@pytest.mark.parametrize("arguments", [["check"], ["check", "--json"]])
def test_nobody_reads(flight, arguments):
    """As `postflight check FLIGHT | true`."""
    arguments = [arguments[0], flight.root, *arguments[1:]]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(command_line(*arguments), stdout=write, stderr=subprocess.PIPE, text=True, timeout=WITHIN_S)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_closed_output(flight):
    """As `postflight check FLIGHT >&-`."""
    done = subprocess.run(
        ["sh", "-c", '"$@" >&- <&-', "-", *command_line("check", flight.root)],
        stderr=subprocess.PIPE, text=True, timeout=WITHIN_S,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_ascii_output(flight):
    """A log that takes ASCII only; the table's frame and the name are beyond it."""
    flight.replace("flight.toml", '[radars.north]\nfile = "telemetry/radar_north.csv"',
                   '[radars.north]\nfile = "telemetry/radar_größe.csv"')  # fmt: skip
    flight.path("radar_north.csv").rename(flight.path("radar_größe.csv"))
    done = subprocess.run(
        command_line("check", flight.root), capture_output=True, timeout=WITHIN_S,
        env={**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert b"gr\\xf6\\xdfe" in done.stdout


HOSTILE = "{run!r}\\[x](javascript:1) $\\alpha$ `` <img src=x> *b*"


def book(name, folder, run):
    path = SimpleNamespace(name=run)
    flown = SimpleNamespace(telemetry=SimpleNamespace(name=name), path=path, changes=(f"c_n = {name}",))
    return notebook._notebook(flown, folder)


def test_a_notebook_has_a_folder_of_any_name_as_one_string():
    import json

    cells = json.loads(book(HOSTILE, "../{run!r}/{folder!r}", "x'); import os; ('"))["cells"]
    first = "".join(cells[1]["source"]).replace("%matplotlib inline\n", "")
    strings = {node.value for node in ast.walk(ast.parse(first)) if isinstance(node, ast.Constant)}
    assert {"../{run!r}/{folder!r}", "x'); import os; ('"} <= strings
    imported = {a.name for node in ast.walk(ast.parse(first)) if isinstance(node, ast.Import) for a in node.names}
    assert "os" not in imported


def test_a_name_in_a_notebook_is_no_markdown():
    """Every sign that Markdown knows has an odd number of backslashes before it; there is no tag."""
    shown = notebook._text(HOSTILE)
    for k, sign in enumerate(shown):
        if sign in "`*_[]()$!#":
            before = shown[:k]
            assert (len(before) - len(before.rstrip("\\"))) % 2 == 1, shown[k - 3 : k + 1]
    assert "<" not in shown


@pytest.mark.parametrize("cell", ["=1+1", "@SUM(A1)", "\t=1", "-1+cmd|' /C calc'!A0", "+A1*2", "＝1"])
def test_a_formula_in_a_table_is_text(cell, tmp_path):
    run = SimpleNamespace(path=tmp_path)
    run_folder.RunFolder.write_csv(run, "events.csv", pd.DataFrame({"event": [cell, "boost"], "t_s": [-1.5, 2.0]}))
    back = pd.read_csv(tmp_path / "events.csv")
    assert back["event"].tolist() == [f"'{cell}", "boost"]
    assert back["t_s"].tolist() == [-1.5, 2.0]


def test_a_long_table_is_written_as_pandas_writes_it(tmp_path):
    count = 1203
    flags = [None if k % 7 == 0 else f"flag {k}" for k in range(count)]
    values = np.where(np.arange(count) % 5, np.linspace(-1e9, 1e-9, count), np.nan)
    table = pd.DataFrame({"t_s": values, "count": np.arange(count), "used": np.arange(count) % 2 == 0, "flag": flags})
    for name, part in {"long.csv": table, "none.csv": table[:0]}.items():
        run_folder.RunFolder.write_csv(SimpleNamespace(path=tmp_path), name, part)
        assert (tmp_path / name).read_text() == part.to_csv(index=False, float_format="%.10g", lineterminator="\n")


def test_sources_keep_their_names():
    table = pd.DataFrame({"source": ["-x", "_a", "a-b", "+", ""], "value": [-1.0, np.nan, 2.0, 3.0, 4.0]})
    pd.testing.assert_frame_equal(run_folder.plain_text(table), table)


def test_a_globe_shows_names_as_text():
    name = 'x<img src="http://elsewhere/">$[description]&lt;b&gt;'
    t = np.array([0.0, 1.0])
    place = pd.DataFrame({"t_s": t, "lon_deg": t, "lat_deg": t, "alt_m": t})
    events = pd.DataFrame({"event": [name], "t_s": [0.5]})
    header = {"point": "<i>datum</i>"}
    source = exports.Source(name, "run", datetime(2009, 8, 17, tzinfo=UTC), "", True, header, place, events, {}, t, t)
    root = ET.fromstring(exports.FORMS["kml"](source))
    for element in root.iter():
        kind = element.tag.rsplit("}", 1)[1]
        if kind in ("name", "description"):
            text = element.text or ""
            assert "<" not in text
            assert "$[" not in text
        if kind == "description":  # as HTML it reads as the flight file has it
            import html

            assert '<img src="http://elsewhere/">' in html.unescape(text)

"""The comparison of golden numbers (benchmarks/golden.py), on made-up tables: whatever moves is reported."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from benchmarks.golden_numbers import kept, sd_column

from benchmarks import golden, golden_flights

ROWS = 500


@pytest.fixture
def tables():
    t = np.arange(ROWS) / 10.0
    height = 5e4 - 300.0 * t
    bet = pd.DataFrame(
        {"t_s": t, "alt_m": height, "alt_sd_m": 3.0 + 0.01 * t, "mach": np.exp(-t / 20.0), "flag": "used"}
    )
    checks = pd.DataFrame(
        {
            "name": ["NIS radar", "whiteness"],
            "code": ["nis", "whiteness"],
            "value": [2.9, 1e-5],
            "low": [2.8, -0.07],
            "high": [3.1, 0.07],
            "passed": [True, True],
            "remark": ["as large as predicted", "uncorrelated"],
        }
    )
    findings = pd.DataFrame({"source": ["rates", "rates"], "start_s": [1.0, 5.0], "code": ["data-gap", "data-gap"]})
    return {"run/bet": bet, "run/consistency_checks": checks, "run/findings": findings}


def stored(tables):
    """The tables as they come back from a file."""
    return json.loads(golden.as_text({name: kept(table) for name, table in tables.items()}))


def differing(tables, change):
    before = stored(tables)
    fresh = {name: table.copy() for name, table in tables.items()}
    change(fresh)
    found, new = golden.compared("made-up", before, fresh)
    return {(one.table, one.column): one for one in found}, new


def test_the_same_tables_do_not_differ(tables):
    assert differing(tables, lambda fresh: None) == ({}, [])


@pytest.mark.parametrize("row", [0, 7, 250, ROWS - 1])
def test_a_number_that_moved_is_reported_in_its_own_sd_wherever_it_stands(tables, row):
    def change(fresh):
        fresh["run/bet"].loc[row, "alt_m"] += 3e-4

    found, _ = differing(tables, change)
    assert list(found) == [("run/bet", "alt_m")]
    (one,) = found.values()
    assert one.unit == "sd"
    if row in kept(tables["run/bet"])["at"]:
        assert one.size == pytest.approx(3e-4 / tables["run/bet"].alt_sd_m[row], rel=1e-6)
        assert f"t_s {row / 10.0}" in one.where
    else:
        assert "all rows" in one.where
        assert one.size > golden.TOLERANCE


def test_two_rows_that_moved_against_each_other_are_reported(tables):
    def change(fresh):
        fresh["run/bet"].loc[[8, 9], "alt_m"] += [1.0, -1.0]

    assert not {8, 9} & {*kept(tables["run/bet"])["at"]}
    assert ("run/bet", "alt_m") in differing(tables, change)[0]


def test_what_is_less_than_the_tolerance_is_no_difference(tables):
    def change(fresh):
        fresh["run/bet"]["alt_m"] += 1e-9  # 3e-10 sd
        fresh["run/bet"]["mach"] *= 1.0 + 4e-16

    assert differing(tables, change)[0] == {}


def test_a_column_without_sd_is_relative_to_its_rms(tables):
    def change(fresh):
        fresh["run/bet"].loc[0, "mach"] += 1e-6

    (one,) = differing(tables, change)[0].values()
    assert one.unit == "relative"
    assert one.size == pytest.approx(1e-6 / math.sqrt(np.mean(tables["run/bet"].mach ** 2)), rel=1e-6)


@pytest.mark.parametrize(("row", "column", "value"), [
    (0, "passed", False), (0, "code", "data-sheet"), (0, "value", math.nan), (1, "name", "whiteness range"),
])  # fmt: skip
def test_another_verdict_code_or_name_has_no_size(tables, row, column, value):
    def change(fresh):
        fresh["run/consistency_checks"].loc[row, column] = value

    found, _ = differing(tables, change)
    assert {table for table, _ in found} == {"run/consistency_checks"}
    assert all(one.size == math.inf for one in found.values())
    assert found


def test_a_statistic_is_compared_with_the_width_of_its_band_and_sentences_are_not(tables):
    def change(fresh):
        fresh["run/consistency_checks"].loc[1, ["value", "remark"]] = 1e-5 + 1.4e-8, "hardly correlated"

    (one,) = differing(tables, change)[0].values()
    assert one.size == pytest.approx(1e-7, rel=1e-3)
    assert one.where.startswith("whiteness:")


def test_what_is_missing_or_new_is_reported(tables):
    def without_table(fresh):
        del fresh["run/bet"]

    def without_column(fresh):
        del fresh["run/bet"]["mach"]

    def with_finding(fresh):
        fresh["run/findings"].loc[2] = ["rates", 9.0, "data-frozen"]

    def without_finding(fresh):
        fresh["run/findings"] = fresh["run/findings"][:1]

    def with_text(fresh):
        fresh["run/bet"].loc[7, "flag"] = "edited"

    def with_gap(fresh):
        fresh["run/bet"].loc[7, "mach"] = np.nan

    for change, place in (
        (without_table, ("run/bet", "*")),
        (without_column, ("run/bet", "mach")),
        (with_finding, ("run/findings", "row rates data-frozen")),
        (without_finding, ("run/findings", "row rates data-gap (2)")),
        (with_text, ("run/bet", "flag")),
        (with_gap, ("run/bet", "mach")),
    ):
        found, new = differing(tables, change)
        assert found[place].size == math.inf, change
        assert (len(found), new) == (1, []), change


def test_what_is_not_stored_yet_is_named_and_no_difference(tables):
    def change(fresh):
        fresh["run/bet"]["humidity"] = 0.0
        fresh["run/events"] = fresh["run/findings"]

    assert differing(tables, change) == ({}, ["run/bet humidity", "run/events"])


def test_rows_of_a_table_that_became_longer_are_found_by_their_time(tables):
    def change(fresh):
        before = fresh["run/bet"][:3].assign(t_s=[-0.3, -0.2, -0.1])
        fresh["run/bet"] = pd.concat([before, fresh["run/bet"]], ignore_index=True)
        fresh["run/bet"].loc[3, "mach"] += 0.1  # the stored table's first row

    found, _ = differing(tables, change)
    assert set(found) == {("run/bet", "rows"), ("run/bet", "mach")}
    assert found["run/bet", "mach"].where.startswith("t_s 0.0")


MOVE = {"flight": "made-up", "table": "run/bet", "column": "alt_m", "most": 0.01, "reason": "the gas constant"}


@pytest.mark.parametrize(("changed", "left"), [
    ({}, 0),
    ({"flight": "*", "table": "run/*"}, 0),
    ({"flight": "another"}, 1),
    ({"table": "run/events"}, 1),
    ({"column": "mach"}, 1),
    ({"most": 0.001}, 1),
])  # fmt: skip
def test_a_move_is_accepted_for_its_flight_and_quantity_up_to_its_size(tables, capsys, changed, left):
    def change(fresh):
        fresh["run/bet"]["alt_m"] += 0.005 * fresh["run/bet"]["alt_sd_m"]

    found, _ = differing(tables, change)
    move = golden.Move(**MOVE | changed)
    assert golden.verdict(list(found.values()), [move], ["made-up"]) == left
    printed = capsys.readouterr().out
    assert ("because: the gas constant" in printed) == (left == 0)
    assert ("MOVED" in printed) == (left == 1)
    assert ("unused" in printed) == (left == 1 and move.flight != "another")


def test_a_verdict_is_accepted_by_an_infinite_size_alone(tables, tmp_path):
    def change(fresh):
        fresh["run/consistency_checks"].loc[0, "passed"] = False

    found = list(differing(tables, change)[0].values())
    for most, left in (("1e9", 1), ("inf", 0)):
        text = f'[[moved]]\nflight = "*"\ntable = "*"\ncolumn = "passed"\nmost = {most}\nreason = "a new bound"\n'
        (tmp_path / "moves.toml").write_text(text)
        assert golden.verdict(found, golden.read_moves(tmp_path / "moves.toml"), ["made-up"]) == left


@pytest.mark.parametrize("changed", [{"reason": " "}, {"most": 0.0}, {"most": math.nan}])
def test_a_move_without_its_reason_or_size_is_refused(tmp_path, changed):
    entry = MOVE | changed
    text = "".join(f"{key} = {json.dumps(value).lower()}\n" for key, value in entry.items())
    (tmp_path / "moves.toml").write_text(f"[[moved]]\n{text}")
    with pytest.raises(ValueError, match="reason"):
        golden.read_moves(tmp_path / "moves.toml")


def test_the_written_reasons_are_read_and_each_is_of_a_flight_that_is_flown():
    for move in golden.read_moves(golden.STORE / "moves.toml"):
        assert any(golden.fnmatchcase(flight, move.flight) for flight in golden.FLIGHTS)


def test_a_simulator_that_moved_is_told_apart(tables, capsys):
    tables["flight/telemetry/rates"] = tables["run/bet"][["t_s", "mach"]]

    def change(fresh):
        fresh["flight/telemetry/rates"].loc[250, "mach"] += 1.0

    found, _ = differing(tables, change)
    assert golden.verdict(list(found.values()), [], ["made-up"]) == 1
    assert "made-up: what is flown differs" in capsys.readouterr().out


def test_own_sd_are_found_by_name():
    columns = ["alt_m", "alt_sd_m", "mach", "mach_sd", "mach_3sd", "x.deflection_deg", "x.sd_deg", "y.deflection_deg"]
    wanted = {"alt_m": ("alt_sd_m", 1.0), "mach": ("mach_sd", 1.0), "x.deflection_deg": ("x.sd_deg", 1.0)}
    assert {name: sd_column(name, columns) for name in wanted} == wanted
    assert sd_column("mach", ["mach", "mach_3sd"]) == ("mach_3sd", 3.0)
    assert sd_column("y.deflection_deg", columns) == sd_column("alt_sd_m", columns) == ("", 1.0)


def test_rounded_tables_are_not_taken_for_whole_ones(tables):
    whole = tables["run/bet"].assign(alt_m=np.sqrt(tables["run/bet"].alt_m))
    assert golden_flights.has_all_digits(whole)
    assert not golden_flights.has_all_digits(whole.map(lambda x: float(f"{x:.10g}") if isinstance(x, float) else x))

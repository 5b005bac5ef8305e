"""Runs side by side: numbers of the runs themselves, differences that are known, nothing claimed of shared data."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flightmodel import rotations
from flightmodel.checks import ConfigError, GateError
from postflight import commands
from postflight.comparison import CORRELATED, INDEPENDENT, Quantity, compare_runs, sd_bounds
from postflight.report import compare
from postflight.report.compare import PAGE_NAME, TABLES, value_rows
from postflight.runs import find_run, read_tables
from tests.in_process import runner
from tests.postflight.report.conftest import HOSTILE
from tests.refusing import printed_codes

RATIO = 1.05


@pytest.fixture(scope="module")
def flown(rocket: Path, tmp_path_factory) -> Path:
    """The rocket's flight folder with its run and a what-if."""
    folder = tmp_path_factory.mktemp("compared") / "flight"
    shutil.copytree(rocket, folder)
    commands.run_flight(folder, (), commands.asked((f"density={RATIO}",), (), None, "dense"))
    return folder


@pytest.fixture(scope="module")
def pair(flown):
    return compare_runs((read_tables(find_run(flown, "plain")), read_tables(find_run(flown, "dense"))))


@pytest.fixture(scope="module")
def entry(reported):
    """An entry vehicle's run, with every method's answer."""
    return read_tables(find_run(reported))


def moved(run, **tables):
    """The same run at another place with other tables."""
    return replace(run, path=run.path.with_name("20300101T000000Z-00000000-moved"), tables=run.tables | tables)


# ------------------------------------------------------------------------------------------------------- the numbers


@pytest.mark.parametrize("correlation", [-1.0, -0.4, 0.0, 0.7, 1.0])
def test_no_correlation_leaves_the_bounds(correlation):
    """Sd of the difference of 200000 drawn pairs; at both ends the bounds are reached."""
    sd = np.array([0.8, 0.3])
    rng = np.random.default_rng(0)
    first = rng.standard_normal(200_000)
    other = correlation * first + np.sqrt(1.0 - correlation**2) * rng.standard_normal(200_000)
    scatter = np.std(sd[1] * other - sd[0] * first)
    low, high = sd_bounds(*sd)
    assert 0.99 * low < scatter < 1.01 * high
    if abs(correlation) == 1.0:
        assert scatter == pytest.approx(low if correlation > 0 else high, rel=0.01)


def test_values_are_those_of_the_runs_own_summaries(entry):
    compared = compare_runs((entry, moved(entry)))
    row = compared.to_frame().iloc[0]
    answers = entry.summary["methods"]
    assert set(answers) == {"camera", "misalignment", "trim", "fused"}
    for method, answer in answers.items():
        assert row[f"deflection_{method}_deg"] == pytest.approx(answer["deflection_deg"], rel=1e-6)
        assert row[f"deflection_{method}_sd_deg"] == pytest.approx(answer["sd_deg"], rel=1e-6)
        assert row[f"largest_{method}_deg"] == answer["largest_deg"]
    assert row["peak_s"] == entry.summary["peak_dynamic_pressure_s"]
    assert row["dynamic_pressure_pa"] == pytest.approx(entry.summary["peak_dynamic_pressure_pa"], rel=1e-6)
    assert row["alpha_total_wind_sd_deg"] == pytest.approx(entry.summary["alpha_total_wind_sd_deg"], rel=1e-6)
    assert row["checks_passed"] == entry.checks["passed"].sum()


def test_a_what_if_of_the_density_moves_the_pressure_by_it(pair):
    q = Quantity("dynamic pressure", "Pa", "dynamic_pressure_pa")
    (first, first_sd), (other, other_sd) = pair.value(0, q), pair.value(1, q)
    # drag over mass follows the tracks: the speed hardly moves
    assert other / first == pytest.approx(RATIO, rel=2e-3)
    row = pair.differences().iloc[0]
    assert row["dynamic_pressure_difference_pa"] == pytest.approx(other - first)
    assert row["dynamic_pressure_difference_sd_low_pa"] == pytest.approx(abs(other_sd - first_sd))
    assert row["dynamic_pressure_difference_sd_high_pa"] == pytest.approx(other_sd + first_sd)


def test_differences_over_time_are_those_that_were_made(entry):
    """A run moved by 5 m, 0.5 m/s, 0.2 deg about body x, 0.3 deg of deflection and 7 Pa."""
    bet = entry.tables["bet"].copy()
    for axis, metres, mps in (("x", 3.0, 0.3), ("y", 4.0, 0.4)):
        bet[f"r{axis}_ecef_m"] += metres
        bet[f"v{axis}_ecef_mps"] += mps
    q = [f"q{a}_ecef_body" for a in "wxyz"]
    bet[q] = rotations.multiply(bet[q].to_numpy(), rotations.exp(np.deg2rad([0.2, 0.0, 0.0])))
    bet["dynamic_pressure_pa"] += 7.0
    trim = entry.tables["deflection_trim"].assign(theta_deg=lambda table: table["theta_deg"] + 0.3)
    found = compare_runs((entry, moved(entry, bet=bet, deflection_trim=trim))).histories()
    assert len(found) == len(bet)
    wanted = {"position_m": 5.0, "velocity_mps": 0.5, "attitude_deg": 0.2, "dynamic_pressure_pa": 7.0, "alt_m": 0.0,
              "deflection_trim_deg": 0.3, "deflection_camera_deg": 0.0}  # fmt: skip
    for column, size in wanted.items():
        known = found[column].dropna()
        assert len(known) > 100, column
        np.testing.assert_allclose(known, size, atol=1e-5, err_msg=column)


def test_no_deflection_is_compared_across_a_hole(entry):
    table = entry.tables["deflection_trim"]
    hole = table[(table["t_s"] < 435.0) | (table["t_s"] > 437.0)]
    found = compare_runs((entry, moved(entry, deflection_trim=hole))).histories().set_index("t_s")
    assert found.loc[435.1:436.9, "deflection_trim_deg"].isna().all()
    assert found.loc[430.0:434.9, "deflection_trim_deg"].notna().all()


def test_a_difference_has_a_sd_of_its_own_only_where_no_file_is_shared(pair, entry):
    (relation,) = pair.relations
    assert relation.kind == CORRELATED
    assert not [name for name in pair.differences() if name.endswith("_difference_sd_pa")]
    other = moved(entry)
    fresh = {name: f"other {digest}" for name, digest in entry.facts["inputs_sha256"].items()}
    apart = compare_runs((entry, replace(other, facts=other.facts | {"inputs_sha256": fresh})))
    assert apart.relations[0].kind == INDEPENDENT
    row, sd = apart.differences().iloc[0], entry.summary["methods"]["fused"]["sd_deg"]
    assert row["deflection_fused_difference_sd_deg"] == pytest.approx(np.sqrt(2.0) * sd)
    fresh["flight.toml"] = entry.facts["inputs_sha256"]["flight.toml"]  # one is enough
    shared = compare_runs((entry, replace(other, facts=other.facts | {"inputs_sha256": fresh})))
    assert shared.relations[0].kind == CORRELATED


def test_flights_with_other_clocks_are_compared_each_at_its_own_peak(entry, pair):
    apart = compare_runs((entry, pair.runs[0]))
    assert apart.at_s == (entry.peak_s, pair.runs[0].peak_s)
    assert not len(apart.histories().columns)
    assert len(apart.to_frame()) == 2


def test_checks_stand_beside_each_other(pair):
    table = pair.checks()
    first = pair.runs[0].checks
    np.testing.assert_allclose(table["value_1"][: len(first)].astype(float), first["value"])
    assert list(table["name"][: len(first)]) == list(first["name"])
    assert table["passed_2"].notna().sum() == len(pair.runs[1].checks)


# --------------------------------------------------------------------------------------------------------- refusals


def test_too_few_too_many_and_equal_runs_are_refused(pair):
    first, other = pair.runs
    for runs, code in (
        ((first,), "compare-runs"),
        ((first, other) * 4, "compare-runs"),
        ((first, first), "given-twice"),
    ):
        with pytest.raises(ConfigError) as fault:
            compare_runs(runs)
        assert fault.value.codes == (code,)


def test_every_word_that_means_no_run_is_named(flown, tmp_path, capsys, monkeypatch):
    run = runner(capsys, monkeypatch)
    cut = shutil.copytree(find_run(flown, "dense"), tmp_path / "cut" / "runs" / "20200101T000000Z-01234567")
    (cut / "bet.csv").unlink()
    (tmp_path / "empty").mkdir()
    done = run("compare", flown / "dens", tmp_path / "nowhere", cut, tmp_path / "empty", flown / "plain")
    assert done.returncode == 3
    assert printed_codes(done.stderr) == ["name-unknown", "name-unknown", "run-incomplete", "run-missing"]
    assert "did you mean 'dense'?" in done.stderr


def test_a_flight_in_a_folder_called_runs_is_a_flight(flown, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "one").symlink_to(flown, target_is_directory=True)
    assert compare.locate(str(tmp_path / "runs" / "one")).name == find_run(flown).name
    assert compare.locate(str(find_run(flown, "plain"))) == find_run(flown, "plain")


def test_only_an_earlier_comparison_is_replaced(flown, tmp_path, capsys, monkeypatch):
    run = runner(capsys, monkeypatch)
    words = ("compare", flown / "plain", flown / "dense", "--output")
    for _ in range(2):
        assert run(*words, tmp_path / "made").returncode == 0
        assert {p.name for p in (tmp_path / "made").iterdir()} == {PAGE_NAME, *(f"{name}.csv" for name in TABLES)}
    (tmp_path / "made" / "mine.txt").write_text("kept")
    done = run(*words, tmp_path / "made")
    assert (done.returncode, printed_codes(done.stderr)) == (3, ["file-exists"])
    assert (tmp_path / "made" / "mine.txt").read_text() == "kept"
    done = run(*words, flown / "runs" / "x")
    assert (done.returncode, printed_codes(done.stderr)) == (3, ["file-exists"])


@pytest.mark.parametrize("step", ["page", "plain_text"])
def test_an_interrupt_leaves_nothing_half_written(flown, tmp_path, capsys, monkeypatch, step):
    """Before anything is written, and amid the tables."""
    there, left = getattr(compare, step), []

    def interrupted(*arguments):
        left.append(sorted(p.name for p in tmp_path.iterdir()))
        if step == "page" or len(left) == 3:
            raise KeyboardInterrupt
        return there(*arguments)

    monkeypatch.setattr(compare, step, interrupted)
    done = runner(capsys, monkeypatch)("compare", flown / "plain", flown / "dense", "--output", tmp_path / "made")
    assert done.returncode == 130
    assert left
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------------- terminal and page


@pytest.fixture(scope="module")
def written(entry, tmp_path_factory) -> Path:
    """Page of an entry vehicle's run beside itself with another name and all of its answers moved."""
    folder = tmp_path_factory.mktemp("page") / "made"
    theirs = entry.tables["deflection_fused"].assign(theta_deg=lambda table: table["theta_deg"] + 0.5)
    facts = entry.facts | {"settings": entry.facts["settings"] | {"changes": [f"c_n = {HOSTILE}"]}, "name": HOSTILE}
    compared = compare_runs((entry, replace(moved(entry, deflection_fused=theirs), facts=facts)))
    compare._write(folder, compared.runs, {}, compare.page(compared, compared.histories()))
    return folder / PAGE_NAME


def test_one_page_that_needs_nothing_and_runs_nothing_foreign(written):
    text = written.read_text()
    assert HOSTILE not in text
    assert text.count("&lt;script&gt;") >= 4
    assert not re.findall(r'\b(?:src|href|action)\s*=\s*"(?!#|data:)', text[: text.index('id="data"')])
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)[1]
    assert "default-src 'none'" in policy
    for tag in ("script", "style"):
        inline = re.search(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy


def test_the_page_draws_every_run_over_the_other(written, entry):
    text = written.read_text()
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])
    panels = {panel["id"]: panel for panel in data["panels"]}
    assert {"by_fused", "by_camera", "by_trim", "by_misalignment", "mach_0", "pressure_0", "alpha_0"} <= set(panels)
    assert all(len(panel["lines"]) == 2 for panel in panels.values())
    first, other = (np.array(line["y"], dtype=float) for line in panels["by_fused"]["lines"])
    assert np.nanmax(other) == pytest.approx(np.nanmax(first) + 0.5, abs=1e-3)
    (apart,) = (panel["lines"] for panel in data["studies"] if panel["id"] == "apart_deflection_fused_deg")
    np.testing.assert_allclose([y for y in apart[0]["y"] if y is not None], 0.5, atol=1e-3)


@pytest.mark.browser
def test_the_page_starts_and_asks_for_nothing(opened, written):
    seen = opened(path=written)
    assert seen.said == []
    assert seen.dialogs == []
    assert {url for url in seen.requests if not url.startswith("data:")} == {written.as_uri()}
    assert seen.page.evaluate("charts.length") >= 12
    legend = seen.page.locator("#panel-by_fused .legend").inner_text()
    assert HOSTILE in legend
    assert legend.count("±") == 2


def test_the_terminal_names_the_changes_and_bounds(flown, tmp_path, capsys, monkeypatch):
    done = runner(capsys, monkeypatch)("compare", flown, flown / "plain", "--output", tmp_path / "made")
    assert done.returncode == 0, done.stderr
    assert f"density = {RATIO}" in done.stdout
    assert "as flight.toml states it" in done.stdout
    table = pd.read_csv(tmp_path / "made" / "differences.csv")
    assert table["dynamic_pressure_difference_pa"][0] < 0.0  # the flight's last run is the what-if, and stands first
    with pytest.raises(GateError):
        find_run(flown, "no-such")


def test_the_largest_change_stands_first_and_what_did_not_move_is_only_named(entry):
    """1 deg of the trim and 20 Pa: two sd and half of one; nothing else moves."""
    bet = entry.tables["bet"].assign(dynamic_pressure_pa=lambda table: table["dynamic_pressure_pa"] + 20.0)
    trim = entry.tables["deflection_trim"].assign(theta_deg=lambda table: table["theta_deg"] + 1.0)
    compared = compare_runs((entry, moved(entry, bet=bet, deflection_trim=trim)))
    rows, same = value_rows(compared)
    assert [row[0] for row in rows] == ["deflection: trim deg", "dynamic pressure Pa"]
    assert {"Mach number", "deflection: camera", "largest: fused"} <= set(same)
    assert len(rows) + len(same) == len(compared.quantities)

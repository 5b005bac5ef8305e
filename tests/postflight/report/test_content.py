"""What the report holds: the run's own numbers, whole and hostile-proof, and words where a flight has no answer."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from flightmodel.checks import GateError
from flightmodel.deflection import lv_clock
from flightmodel.statistics import decimals, pair
from postflight.commands import console, print_answers
from postflight.plots.style import COLOUR, with_holes
from postflight.report import pictures
from postflight.report import text as texts
from postflight.report.panels import trajectory_panels, trajectory_rows
from postflight.report.source import extreme_rows, kept_rows, rounded
from postflight.report.write import SCRIPTS, STYLES, page, safe_json, write_report
from postflight.runs import read_run, read_tables
from postflight.scoring import score_run
from recon.consistency import doubt
from tests.postflight.report.conftest import HOSTILE

LARGEST_BYTES = 3_000_000


def payload(text: str) -> dict:
    """Numbers that the page's scripts draw."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def plain(words: str) -> str:
    """Words with spaces at which a line may end."""
    return words.replace("\u00a0", " ")


@pytest.fixture(scope="module")
def text(report: Path) -> str:
    return report.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def run(reported: Path):
    return read_run(reported)


def test_a_plane_between_sparse_answers_errs_as_it_says():
    """A shell that swings around the axis, four answers in 1.5 s: the straight line's error is in the plane's sd."""
    t, at = np.arange(0.0, 6.0, 0.25), 3.12
    y, z = 3.0 + np.cos(2.0 * np.pi * t / 1.5), np.sin(2.0 * np.pi * t / 1.5)
    clock = np.rad2deg(lv_clock(np.column_stack([y, z])))
    table = pd.DataFrame({"t_s": t, "theta_deg": np.hypot(y, z), "plane_lv_deg": clock, "plane_sd_deg": 0.01})
    flown = SimpleNamespace(tables={"deflection_camera": table}, summary={"peak_dynamic_pressure_s": at})
    plane, sd = map(float, texts.plane_at(flown, "camera").split(" ± "))
    turn = 2.0 * np.pi * at / 1.5
    true = float(np.rad2deg(lv_clock(np.array([3.0 + np.cos(turn), np.sin(turn)]))))
    assert 0.3 * sd < abs(plane - true) < 2.0 * sd


def frames_table(rms: list[float], theta: list[float], refused: dict[int, str]) -> pd.DataFrame:
    n = len(rms)
    columns = {"camera": "camera5", "t_s": np.arange(n) * 0.5, "edge_points": 300, "features": 100.0,
               "residual_rms_px": rms, "flag": "used", "code": "", "reason": "", "theta_deg": theta,
               "theta_sd_deg": 0.1, "plane_lv_deg": 30.0, "plane_sd_deg": 1.0}  # fmt: skip
    table = pd.DataFrame(columns)
    for k, code in refused.items():
        table.loc[k, ["flag", "code", "reason"]] = "refused", code, "words"
        table.loc[k, ["features", "residual_rms_px", "theta_deg", "theta_sd_deg", "plane_lv_deg"]] = np.nan
    return table


def test_frames_to_look_at_first():
    """Refused frames with one of each code first; then a large residual, and a step against the neighbours."""
    rms, theta = [0.2, 0.21, 0.19, 0.2] * 5, [float(x) for x in np.linspace(1.0, 3.0, 20)]
    rms[12], theta[5] = 0.9, theta[5] + 1.5
    refused = {2: "frame-exposure", 3: "frame-exposure", 8: "edge-too-short", 9: "frame-exposure"}
    first = pictures.worst_first(frames_table(rms, theta, refused))
    assert first[:2] == [2, 8]
    assert first[2] in (3, 9)
    assert set(first[3:5]) == {5, 12}
    assert sorted(first) == list(range(20))
    assert pictures.worst_first(frames_table(rms, theta, {}))[:2] == [5, 12]
    every = dict.fromkeys(range(20), "frame-exposure")
    assert sorted(pictures.worst_first(frames_table(rms, theta, every))) == list(range(20))


def test_a_what_if_says_what_was_assumed(run):
    """The first sentence names every change; a run without changes has no such sentence."""
    changed = replace(run, facts=run.facts | {"settings": {"changes": ["c_n = 1.1", "wind = None"]}})
    first, *others = texts.lead(changed)
    assert "c_n = 1.1; wind = None" in first
    assert others == texts.lead(run)


# ------------------------------------------------------------------------------------------------------- one whole file


def test_one_small_file_that_refers_to_nothing(report: Path, text: str) -> None:
    assert report.stat().st_size < LARGEST_BYTES
    body = text[: text.index('<script type="application/json"')]
    links = re.findall(r'\b(?:src|href|action|poster|data|srcset)\s*=\s*"([^"]*)"', body)
    assert len(links) >= 13, "the pictures were not found"
    assert all(link.startswith(("data:image/jpeg;base64,", "#")) for link in links)
    assert not re.search(r"url\(|@import|@font-face", body)
    assert "default-src 'none'" in text


def test_same_run_gives_the_same_bytes(reported: Path, report: Path, tmp_path: Path) -> None:
    again = write_report(reported, target=tmp_path / "again.html")
    assert again.read_bytes() == report.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["again.html"]


def test_page_names_the_run_by_the_digits_of_its_folder(run, text: str) -> None:
    assert run.path.name.endswith(f"-{run.hash8}")
    assert text.count(f"{run.hash8} ") >= 2


def test_nothing_of_the_clock_or_the_machine(run, text: str) -> None:
    assert run.facts["finished_utc"] not in text
    assert run.path.name[:16] not in text
    assert str(run.path.parent.parent) not in text


def test_hostile_names_are_escaped(text: str) -> None:
    assert text.count("<script") == 2
    assert HOSTILE not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert "<img src=x" not in text


@pytest.mark.parametrize("value", ["</script>", "<!--", "a\u2028b\u2029c", "&amp;", 'quote " and \\'])
def test_json_in_a_script_is_safe_and_the_same(value: str) -> None:
    out = safe_json({"name": value})
    assert not re.search("[<>&\u2028\u2029]", out)
    assert json.loads(out) == {"name": value}


def test_page_files_are_in_the_package() -> None:
    from importlib.resources import files

    here = {p.name for p in files("postflight.report").joinpath("page").iterdir()}
    assert {*SCRIPTS, *STYLES, "page.html", "uPlot.LICENSE"} <= here


# ---------------------------------------------------------------------------------------------------------- its numbers


def test_title_is_the_answer(run, text: str) -> None:
    answer = run.summary["methods"]["fused"]
    numbers = [pair(answer["deflection_deg"], answer["sd_deg"]), pair(answer["mean_deg"], answer["mean_sd_deg"])]
    numbers.append(f"{answer['largest_deg']:.2f}")
    assert plain(texts.title(run)) == "Deflection at peak q {}°, cycle mean {}°, largest {}°".format(*numbers)
    assert f"<h1>{texts.title(run)}</h1>" in text


def test_headline_card_and_terminal_say_one_answer(run, text: str) -> None:
    """The same quantities by the same names: the card's are those of the headline, and so are the command's."""
    fused = next(card for card in texts.cards(run) if card["method"] == "fused")
    on_card = {fused["at"]: f"{fused['value']} ± {fused['sd']}"} | dict(fused["others"])
    with console.capture() as shown:
        print_answers(run.deflections)
    (row,) = [line for line in shown.get().splitlines() if " fused " in line]
    assert list(on_card) == ["at peak q", "cycle mean", "largest"]
    for name, number in on_card.items():
        assert f"{name} {number}°" in plain(texts.title(run))
        assert number in row
    assert all(f"{name} <b>{number}°</b>" in text for name, number in fused["others"])
    assert f"{fused['value']}°<small>± {fused['sd']}</small>" in text


def test_truth_stands_beside_the_estimates(run, reported: Path, text: str) -> None:
    score = score_run(reported, run.path)
    table = texts.against_truth(score)
    assert all(f"<td>{cell}</td>" in text for row in table["rows"] for cell in row if cell)
    for row, (method, scored) in zip(table["rows"], score.methods.items(), strict=False):
        assert method in row[0]
        places = decimals(scored["sd_deg"])
        assert row[2] == f"{scored['deflection_deg']:.{places}f}"
        assert float(row[3]) == pytest.approx(scored["truth_deg"], abs=0.006)
        assert float(row[4]) == pytest.approx(scored["error_deg"], abs=0.6 * 10.0**-places)
    shown = next(card["value"] for card in texts.cards(run) if card["method"] == "fused")
    assert table["rows"][list(score.methods).index("fused")][2] == shown


def test_without_truth_the_page_is_the_same_but_for_its_errors(run, text: str) -> None:
    without = page(run)
    assert 'id="truth"' not in without
    assert re.sub(r'<div id="truth">.*?</table>\n</div>\s*</div>\n', "", text, flags=re.DOTALL) == without


def test_a_fused_angle_beyond_its_inputs_says_why(run) -> None:
    methods = {name: dict(answer) for name, answer in run.summary["methods"].items()}
    for name, angle in (("camera", 3.0), ("misalignment", 3.2), ("trim", 3.4), ("fused", 3.1)):
        methods[name]["deflection_deg"] = angle
    among = replace(run, summary=run.summary | {"methods": methods})
    methods = {name: dict(answer) for name, answer in methods.items()}
    inputs = run.tables["fusion_inputs"]
    for sds, asked in ((0.9, False), (1.1, True)):  # within its sd nobody asks
        methods["fused"]["deflection_deg"] = 3.4 + sds * methods["fused"]["sd_deg"]
        above = replace(run, summary=run.summary | {"methods": methods})
        said = [words for words in texts.lead(above) if words not in texts.lead(among)]
        assert any(inputs["input"][inputs["moved_sd"].abs().idxmax()] in words for words in said) == asked


@pytest.mark.parametrize(
    ("value", "sd", "wanted"), [(4.88, 0.096, "4.88 ± 0.10"), (3.3, 0.49, "3.3 ± 0.5"), (12.0, 2.2, "12.0 ± 2.2"),
                                (0.5, 0.036, "0.50 ± 0.04"), (1198.3, 36.0, "1198 ± 36"), (1.0, 0.0, "1.00 ± 0.00")],
)  # fmt: skip
def test_pair_has_the_digits_that_its_sd_deserves(value: float, sd: float, wanted: str) -> None:
    assert pair(value, sd) == wanted


def test_cards_carry_the_result_of_the_tests_of_pairs(run) -> None:
    pairs = run.tables["fusion_agreement"]
    for card in texts.cards(run):
        method = card["method"]
        mine = pairs if method == "fused" else pairs[[method in m.split(" and ") for m in pairs["methods"]]]
        assert card["state"] == ("agrees" if mine["passed"].all() else "differs")
        answer = run.summary["methods"][method]
        assert f"{card['value']} ± {card['sd']}" == pair(answer["deflection_deg"], answer["sd_deg"])


def test_a_pair_that_disagrees_is_named(run) -> None:
    table = run.tables["fusion_agreement"].assign(passed=[True, False, True], chance=[0.5, 1e-4, 0.5])
    one = replace(run, tables=run.tables | {"fusion_agreement": table})
    first, second = table["methods"][1].split(" and ")
    cards = {card["method"]: card for card in texts.cards(one)}
    assert cards[first]["state"] == cards[second]["state"] == cards["fused"]["state"] == "differs"
    assert second in cards[first]["remark"]
    assert first in cards[second]["remark"]
    assert [c["state"] for m, c in cards.items() if m not in (first, second, "fused")] == ["agrees"]


def test_drawn_numbers_are_the_runs(run, text: str) -> None:
    data, bet = payload(text), run.tables["bet"]
    panels = {p["id"]: p for p in data["panels"]}
    assert list(panels) == ["deflection", "altitude", "speed", "mach", "pressure", "alpha", "axial", "lateral"]
    rows = np.searchsorted(bet["t_s"].to_numpy(), np.array(data["bet"]) - 1e-4)
    assert np.abs(bet["t_s"].to_numpy()[rows] - data["bet"]).max() < 1e-4
    drawn = panels["pressure"]["lines"][0]
    assert drawn["y"] == pytest.approx(bet["dynamic_pressure_pa"].to_numpy()[rows], abs=6e-4)
    assert drawn["sd"] == pytest.approx(bet["dynamic_pressure_sd_pa"].to_numpy()[rows], abs=6e-4)
    assert max(drawn["y"]) == pytest.approx(bet["dynamic_pressure_pa"].max(), abs=6e-4)
    fused = next(one for one in panels["deflection"]["lines"] if one["label"] == "all fused")
    table = run.tables["deflection_fused"]
    kept = [y for y in fused["y"] if y is not None]
    assert kept == pytest.approx(table["theta_deg"].to_numpy(), abs=6e-5)
    assert len(data["residuals"]) == 6
    high = run.tables["rigid_bounds"]["alpha_total_high_deg"].to_numpy()
    assert data["rigid"][0]["lines"][0]["high"] == pytest.approx(high, abs=6e-5)


def test_raw_accelerations_keep_their_extremes(run, text: str) -> None:
    data, record = payload(text), run.telemetry.accelerometer
    body = record.measured_sensor @ record.spec.dcm_body_sensor.T
    raw = next(p for p in data["panels"] if p["id"] == "axial")["raw"][0]
    assert raw["of"] == len(body)
    assert (min(raw["y"]), max(raw["y"])) == pytest.approx((body[:, 0].min(), body[:, 0].max()), abs=6e-4)


# -------------------------------------------------------------------------------------------------- without some answer


def test_rocket_without_vehicle_says_why(rocket: Path) -> None:
    run = read_run(rocket)
    text = (run.path / "report.html").read_text()
    data = payload(text)
    title = texts.title(run).replace("\u00a0", " ")
    assert title.startswith("Prometheus")
    assert "5.500 ± 0.010 km" in title
    assert [p["id"] for p in data["panels"]] == ["altitude", "speed", "mach", "pressure"]
    assert data["solid"] is None
    absent = set(re.findall(r'data-absent="([^"]*)"', text))
    assert absent == {"panel-deflection", "panel-alpha", "panel-axial", "panel-lateral", "vehicle", "video", "rigid"}
    assert text.count('class="card none') == 4
    assert {card["reason"] for card in texts.cards(run)} == {m["reason"] for m in run.summary["methods"].values()}
    assert data["first"] == data["span"]


def test_an_accelerometer_without_gyros_is_not_called_absent(rocket: Path, run) -> None:
    """A deceleration carries the flight, and no force stands in body axes."""
    without = read_run(rocket)
    sensed = replace(
        without,
        given=replace(without.flight, telemetry=replace(without.telemetry, accelerometer=run.telemetry.accelerometer)),
    )
    rows = trajectory_rows(without)
    one, other = (
        {name: why for name, _, why in trajectory_panels(flown, rows)[1] if name in ("axial", "lateral")}
        for flown in (without, sensed)
    )
    assert one.keys() == other.keys() == {"axial", "lateral"}
    assert all(one[name] != other[name] for name in one)


def test_run_of_the_trajectory_alone(run) -> None:
    bare = {**run.summary, "methods": {}, "agreement": None, "southwell": None}
    tables = {k: v for k, v in run.tables.items() if not k.startswith(("deflection", "fusion", "rigid", "camera"))}
    facts = {**run.facts, "settings": {**run.facts["settings"], "methods": []}}
    one = replace(run, summary=bare, tables=tables, facts=facts)
    text = page(one)
    assert "°" not in texts.title(one)
    assert {card["reason"] for card in texts.cards(one)} == {texts.NOT_ASKED}
    assert {"panel-deflection", "video", "rigid"} == set(re.findall(r'data-absent="([^"]*)"', text))


def test_failed_checks_and_findings_are_shown(run) -> None:
    bad = {**run.summary, "verdicts_failed": ["NIS north: too large <b>"], "suspects": ["north: its <i> time bias"]}
    found = pd.DataFrame([("north", "gap of 3 s", 430.0, 433.0)] * 300, columns=["source", "what", "start_s", "end_s"])
    one = replace(run, summary=bad, tables=run.tables | {"findings": found})
    text = page(one)
    assert "✕ NIS north: too large &lt;b&gt;" in text
    assert ": north: its &lt;i&gt; time bias" in text
    assert "gap of 3 s" in text
    assert texts.table_rows(found)["more"] == 300 - texts.SHOWN_ROWS


def test_failed_checks_are_in_the_title_the_first_sentence_and_on_the_fused_card(run) -> None:
    checks = run.tables["consistency_checks"]
    red = checks.assign(passed=~checks["name"].isin(checks["name"].iloc[:2]))
    one = replace(run, tables=run.tables | {"consistency_checks": red})
    failed = red.loc[~red["passed"], "name"]
    words = doubt(list(failed), len(red))
    assert all(name.partition(":")[0] in words for name in failed)
    assert texts.title(one) == f"In doubt: {texts.title(run)}"
    assert texts.lead(one)[0] == f"{words}."
    sound, doubtful = ({card["method"]: card for card in texts.cards(each)} for each in (run, one))
    assert (sound["fused"]["state"], doubtful["fused"]["state"]) == ("agrees", "differs")
    assert doubtful["camera"] == sound["camera"]
    assert doubtful["fused"]["remark"] in page(one)


def test_sensitivity_is_shown_by_groups() -> None:
    columns = ["rerun", "quantity", "change_over_sd", "change_over_expected_sd", "reason"]
    table = pd.DataFrame(
        [
            ("without north", "position north", -0.5, -1.0, ""),
            ("without north", "position east", 1.25, 1.0, ""),
            ("without north", "Mach number", 0.0, 0.0, ""),
            ("winds off", None, np.nan, np.nan, "it diverged"),
        ],
        columns=columns,
    )
    shown = texts.sensitivity_rows(table)
    assert shown["names"] == ["rerun", "position", "Mach number"]
    assert shown["rows"][0] == ["without north", "+1.25", "–"]
    name, reason, empty = shown["rows"][1]
    assert (name, reason.endswith("it diverged"), empty) == ("winds off", True, "")
    assert texts.sensitivity_rows(table[3:]) == {"names": ["rerun", "reason"], "rows": [[name, reason]], "more": 0}


# ---------------------------------------------------------------------------------------------------------- refusals


def test_changed_telemetry_is_refused(rocket: Path, tmp_path: Path) -> None:
    shutil.copytree(rocket, tmp_path / "flight")
    path = tmp_path / "flight" / "flight.toml"
    path.write_text(path.read_text() + "\n# another thought\n")
    with pytest.raises(GateError) as refusal:
        _ = read_run(tmp_path / "flight").flight
    assert refusal.value.codes == ("inputs-changed",)
    assert "flight.toml" in str(refusal.value)


def test_a_run_without_the_table_of_an_answer_is_refused(reported: Path, tmp_path: Path) -> None:
    run = tmp_path / "runs" / "20260101T000000Z-00000000"
    shutil.copytree(next((reported / "runs").iterdir()), run)
    assert read_tables(run).history("fused") is not None
    (run / "deflection_fused.csv").unlink()
    with pytest.raises(GateError) as refusal:
        read_tables(run)
    assert refusal.value.codes == ("run-incomplete",)
    assert "deflection_fused.csv" in str(refusal.value)


@pytest.mark.parametrize("name", ["bet.csv", "summary.json", "residuals.csv"])
def test_run_that_is_not_whole_is_refused(rocket: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(rocket, tmp_path / "flight")
    path = next((tmp_path / "flight" / "runs").iterdir())
    (path / name).unlink()
    with pytest.raises(GateError) as refusal:
        read_run(tmp_path / "flight", path)
    assert refusal.value.codes == ("run-incomplete",)


def test_command_writes_where_told_and_says_so(command, rocket: Path, tmp_path: Path) -> None:
    done = command("report", rocket, "--output", tmp_path / "a.html")
    assert (done.returncode, done.stderr) == (0, "")
    assert str(tmp_path / "a.html") in done.stdout
    done = command("report", rocket, "--output", tmp_path / "new" / "a.html")
    assert (done.returncode, (tmp_path / "new" / "a.html").read_bytes()) == (0, (tmp_path / "a.html").read_bytes())
    done = command("report", rocket, "--output", tmp_path / "a.html" / "b.html")
    assert done.returncode == 3
    assert str(tmp_path / "a.html") in done.stderr
    assert command("report", tmp_path).returncode == 3


# ---------------------------------------------------------------------------------------------------------- thinning


def test_thinning_keeps_every_buckets_extremes() -> None:
    rng = np.random.default_rng(3)
    columns = [np.cumsum(rng.standard_normal(20_000)), np.sin(np.arange(20_000) / 700.0)]
    columns[1][5000:5100] = np.nan
    rows = kept_rows(columns, 1000)
    assert len(rows) <= 1000
    assert {0, 19_999, 4999, 5000, 5099, 5100} <= set(rows.tolist())
    for c in columns:
        assert {int(np.nanargmin(c)), int(np.nanargmax(c))} <= set(rows.tolist())
    spike = np.zeros(50_000)
    spike[12_345] = 1.0
    assert 12_345 in kept_rows([spike], 400)
    assert len(kept_rows([spike], 60_000)) == 50_000


def test_extremes_of_each_run_of_rows() -> None:
    values = np.array([1.0, 5.0, 2.0, np.nan, np.nan, np.nan, 3.0, -1.0, 0.0])
    assert extreme_rows(values, 3).tolist() == [0, 1, 6, 7]


def test_holes_break_the_line_and_two_rates_do_not() -> None:
    t = np.concatenate([np.arange(0.0, 2.0, 0.05), np.arange(2.0, 4.0, 0.02), np.arange(6.0, 8.0, 0.02)])
    times, (values,) = with_holes(t, [np.ones(len(t))])
    assert np.count_nonzero(np.isnan(values)) == 1
    assert 3.98 < times[np.isnan(values)][0] < 6.0
    assert rounded(values, 1).count(None) == 1


@pytest.mark.parametrize(("noise", "coarse"), [(0.0, False), (60.0, True)])
def test_noisy_film_does_not_swell_the_report(noise: float, coarse: bool) -> None:
    rng = np.random.default_rng(1)
    ramp = np.broadcast_to(np.linspace(60.0, 190.0, 1280)[None, :, None], (720, 1280, 3))
    film = [np.clip(ramp + noise * rng.standard_normal(ramp.shape), 0, 255).astype(np.uint8) for _ in range(14)]
    made = pictures.jpegs(film)
    assert sum(map(len, made)) <= pictures.LARGEST_CHARACTERS
    finest = [pictures.jpeg(pictures.narrowed(picture), pictures.QUALITIES[0]) for picture in film]
    assert (made != finest) == coarse


def test_card_panel_and_table_have_one_camera_answer_between_frames(run, text: str) -> None:
    """At the peak, which lies between frames: the smooth answer with its sd everywhere."""
    at, card = run.summary["peak_dynamic_pressure_s"], run.summary["methods"]["camera"]
    assert np.abs(run.tables["deflection_camera"]["t_s"] - at).min() > 0.02
    (panel,) = [p for p in payload(text)["panels"] if p["id"] == "deflection"]
    (line,) = [one for one in panel["lines"] if one["colour"] == COLOUR["camera"]]
    assert np.interp(at, line["t"], line["y"]) == pytest.approx(card["deflection_deg"], abs=2e-3)
    assert np.interp(at, line["t"], line["sd"]) == pytest.approx(card["sd_deg"], abs=2e-3)
    frames = [dots for dots in panel["raw"] if dots["label"] == "frames"]
    assert len(frames[0]["t"]) == len(run.tables["deflection_camera"])


def test_worst_frames_are_shown_with_their_numbers(run, text: str) -> None:
    shown = re.findall(r"<figure><img [^>]*alt=\"Onboard frame at ([0-9.]+) s with the outline", text)
    assert len(shown) == 5
    table = run.tables["camera_frames"]
    assert [float(t) for t in shown] == pytest.approx(table["t_s"].iloc[pictures.worst_first(table)[:5]], abs=0.006)


def test_what_absolute_values_depend_on_is_a_table_and_no_lead(run, text: str) -> None:
    rows = texts.rests_on(run.summary["rests_on"])
    assert [value for value, _ in rows] == ["position", "height", "azimuth", "density's level"]
    assert all(f"<td>{on}</td>" in text for _, on in rows)
    assert not any(on in words for _, on in rows for words in texts.lead(run))
    assert texts.rests_on(["position, height and azimuth rest on the state at 3 s"]) == [
        ["position, height and azimuth", "state at 3 s"]
    ]


@pytest.mark.parametrize(
    ("plane", "end"), [("0 ± 2", [-36.0, 0.0]), ("90 ± 2", [0.0, 36.0]), ("180.0 ± 0.4", [36.0, 0.0])]
)
def test_clocking_is_drawn_as_seen_from_behind(run, monkeypatch, plane: str, end: list[float]) -> None:
    """Body y, at 180 deg, is to the right and body z, at 90 deg, down (SVG's y grows downwards)."""
    monkeypatch.setattr(texts, "plane_at", lambda *_: plane)
    assert texts.clock_drawing(run)["end"] == pytest.approx(end, abs=0.05)
    monkeypatch.setattr(texts, "plane_at", lambda *_: "")
    assert texts.clock_drawing(run) is None

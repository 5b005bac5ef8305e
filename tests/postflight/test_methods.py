"""What can run on which data, as `check` says first and as `run` and `deflection` refuse."""

import json
import shutil

import pandas as pd
import pytest

import postflight as pf
from flightmodel.flightfolder import read_sources
from postflight.deflections import estimate
from postflight.flight import read_flight
from postflight.methods import BY_LOADS, Inputs
from tests.documents import ROOT, blocks, commands
from tests.postflight.test_film import without_radars


@pytest.mark.parametrize(
    ("inputs", "names", "codes"),
    [
        (Inputs(True, True, True, True), "all", {}),
        (Inputs(True, True), "camera alone", {"trajectory": "tracker-missing", "trim": "inertial-missing"}),
        (Inputs(True, True, True), "camera alone", {"trajectory": "tracker-missing", "trim": "tracker-missing"}),
        (Inputs(True, loads=True), "misalignment and trim from loads", {"camera": "video-missing"}),
        (Inputs(tracker=True), "trajectory alone", {"camera": "video-missing", "fused": "vehicle-missing"}),
        (Inputs(film=True, tracker=True), "trajectory alone", {"camera": "vehicle-missing"}),
        (Inputs(True, False, True, True), "trajectory, misalignment, trim, fused", {"camera": "video-missing"}),
        (Inputs(), "nothing", {"misalignment": "vehicle-missing"}),
    ],
)
def test_what_can_run_and_why_not(inputs, names, codes):
    missing = inputs.missing()
    assert inputs.names.startswith(names)
    assert {method: missing[method].code for method in codes} == codes
    assert all(reason in str(inputs) for reason in missing.values())


def test_sources_and_telemetry_of_a_folder_hold_the_same(flight):
    inputs = Inputs.of(read_sources(flight.root))
    assert inputs == Inputs.of(read_flight(flight.root).telemetry) == Inputs(True, True, True, True)


def test_methods_are_refused_with_the_words_of_the_check(flight):
    without_radars(flight)
    flown = read_flight(flight.root, needs_path=False)
    assert Inputs.of(flown.telemetry).names == "camera alone"
    report = pf.check_flight(flight.root)
    assert not report.refused
    refused = estimate(flown, BY_LOADS).refused
    assert set(refused) == set(BY_LOADS)
    assert all(report.can_run.startswith("camera alone") and reason in report.can_run for reason in refused.values())


def test_nothing_runs_before_what_is_refused_is_corrected(flight):
    flight.header("frames.csv", "frame", "picture")
    assert pf.check_flight(flight.root).can_run.startswith("nothing")


@pytest.fixture
def examples(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "examples"


@pytest.mark.parametrize(
    ("name", "can_run", "truth_deg"),
    [
        ("loads_table", "misalignment and trim from loads", {"misalignment": 4.99, "trim": 4.99, "fused": 4.99}),
        ("film_alone", "camera alone", {"camera": 3.0}),
    ],
)
def test_examples_run_as_their_readme_is_written(name, can_run, truth_deg, examples, command):
    page = ROOT / "examples" / name / "README.md"
    check, estimation = commands(page)
    done = command(*check)
    assert done.stdout.startswith(f"can run: {can_run}")
    assert json.loads(command(*check, "--json").stdout)["can_run"].startswith(can_run)
    assert command(*estimation).returncode == 0
    (written,) = (examples / name).glob("*-deflection")
    answers = pd.read_csv(written / "answers.csv").set_index("method")
    for method, truth in truth_deg.items():
        assert abs(answers.theta_deg[method] - truth) < 2.0 * answers.theta_sd_deg[method]
    assert list((written / "figures").glob("*.png"))
    scope = {}
    for block in blocks(page, "python"):
        exec(block, scope)
    assert scope["figure"].axes
    assert sum(path.stat().st_size for path in page.parent.rglob("*") if path.is_file()) < 300e3

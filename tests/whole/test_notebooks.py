"""Every notebook runs from top to bottom, on a synthetic flight or the tree's own, and is stored without outputs."""

import os
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))
LEAST_PICTURES = {
    "one_flight": 5,
    "real_rockets": 3,
    "flight_and_invariants": 2,
    "bet_and_how_we_know": 2,
    "deflection_by_video": 3,
    "three_methods_one_answer": 1,
    "the_joint_that_explains_the_flight": 2,
}
FLOWN = {"deflection_by_video", "three_methods_one_answer"}  # read this suite's own flight


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda p: p.stem)
def test_pair_is_in_step_and_without_outputs(script):
    import jupytext

    stored = jupytext.read(script.with_suffix(".ipynb"))
    assert [c.source for c in stored.cells] == [c.source for c in jupytext.read(script).cells]
    assert not any(c.get("outputs") for c in stored.cells)


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_ends_in_what_it_proved(script):
    if script.stem != "one_flight":  # whose last section is the truth; its claim stands before
        last = script.read_text().rpartition("# %% [markdown]")[2]
        assert "assert " in last


# whole flights, which other tests of every change reconstruct, fuse and reconcile too
LONG = ("one_flight", "real_rockets", "the_joint_that_explains_the_flight", "three_methods_one_answer")


@pytest.mark.slow
@pytest.mark.parametrize(
    "script",
    [pytest.param(p, marks=pytest.mark.long) if p.stem in LONG else p for p in NOTEBOOKS],
    ids=lambda p: p.stem,
)
def test_notebook_runs(script, tmp_path, monkeypatch, request):
    import jupytext
    from nbclient import NotebookClient

    from synthetic_flight.folder import simulate_to_folder
    from synthetic_flight.scenarios import read_scenario

    folder = tmp_path / "flight"
    if script.stem in FLOWN:
        folder = request.getfixturevalue("flown")
    elif script.stem == "one_flight":
        simulate_to_folder(read_scenario("irve2_reference"), 21, folder)
    monkeypatch.delenv("POSTFLIGHT_REALDATA", raising=False)
    monkeypatch.setenv("POSTFLIGHT_FLIGHT", str(folder))
    notebook = jupytext.read(script)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(script.parent)}}).execute()
    pictures = [o for c in notebook.cells for o in c.get("outputs", []) if "image/png" in o.get("data", {})]
    assert len(pictures) >= LEAST_PICTURES[script.stem]
    assert os.environ["POSTFLIGHT_FLIGHT"] == str(folder)

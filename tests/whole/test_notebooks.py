"""Every notebook runs from top to bottom, on a synthetic flight or the tree's own, and is stored without outputs."""

import os
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))
LEAST_PICTURES = {"one_flight": 5, "real_rockets": 3}


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda p: p.stem)
def test_pair_is_in_step_and_without_outputs(script):
    import jupytext

    stored = jupytext.read(script.with_suffix(".ipynb"))
    assert [c.source for c in stored.cells] == [c.source for c in jupytext.read(script).cells]
    assert not any(c.get("outputs") for c in stored.cells)


@pytest.mark.slow
@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(script, tmp_path, monkeypatch):
    import jupytext
    from nbclient import NotebookClient

    from synthetic_flight.folder import simulate_to_folder
    from synthetic_flight.scenarios import read_scenario

    folder = tmp_path / "flight"
    if script.stem == "one_flight":
        simulate_to_folder(read_scenario("irve2_reference"), 21, folder)
    monkeypatch.delenv("POSTFLIGHT_REALDATA", raising=False)
    monkeypatch.setenv("POSTFLIGHT_FLIGHT", str(folder))
    notebook = jupytext.read(script)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(script.parent)}}).execute()
    pictures = [o for c in notebook.cells for o in c.get("outputs", []) if "image/png" in o.get("data", {})]
    assert len(pictures) >= LEAST_PICTURES[script.stem]
    assert os.environ["POSTFLIGHT_FLIGHT"] == str(folder)

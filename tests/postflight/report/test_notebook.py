"""`postflight report --notebook`: a notebook of one flight that runs as it stands, and whose proof can fail."""

import json
from pathlib import Path

import pytest

from postflight.report.notebook import write_notebook
from postflight.runs import read_run
from tests.postflight.report.conftest import HOSTILE
from tests.refusing import numbers_in


def test_same_bytes_without_outputs_and_without_this_machine(reported: Path, tmp_path: Path) -> None:
    one, two = (write_notebook(reported, tmp_path / name).read_text() for name in ("one.ipynb", "two.ipynb"))
    assert one == two
    book = json.loads(one)
    assert not any(cell.get("outputs") for cell in book["cells"])
    assert str(Path.home()) not in one
    assert HOSTILE not in one


def test_it_is_valid_for_its_readers(reported: Path, tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbformat.validate(nbformat.read(write_notebook(reported, tmp_path / "n.ipynb"), 4))


@pytest.mark.slow
def test_it_runs_as_it_stands(reported: Path, tmp_path: Path, command) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    target = tmp_path / "flight.ipynb"
    done = command("report", reported, "--notebook", "--output", target)
    assert done.returncode == 0, done.stderr
    book = nbformat.read(target, 4)
    nbclient.NotebookClient(book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [o for cell in book.cells for o in cell.get("outputs", [])]
    assert sum("image/png" in o.get("data", {}) for o in shown) == 2
    text = "".join(o.get("text", "") for o in shown)
    run = read_run(reported)
    passed = f"{run.summary['verdicts_passed']} of {len(run.checks)} "
    assert any(line.startswith(passed) for line in text.splitlines())
    assert len(run.telemetry.hashes) in numbers_in(text.splitlines()[-1])

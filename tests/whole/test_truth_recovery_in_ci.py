"""The recipes of docs/truth-recovery.md, run as they are written: the pytest file, and every step of the workflow."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.documents import ROOT, blocks

PAGE = ROOT / "docs" / "truth-recovery.md"
OWN = ROOT / "examples" / "own_vehicle"
INSTALL = 'python -m pip install "$POSTFLIGHT"'  # of the program that is tested here


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """What a user's repository holds: scenario and vehicle file."""
    for name in ("scenario.toml", "vehicle.toml"):
        shutil.copy(OWN / name, tmp_path)
    return tmp_path


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a step as the workflow's runner does, with the scripts and the sources of this environment first."""
    paths = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }
    words = ["bash", "-e", "-c", command]
    return subprocess.run(
        words, cwd=folder, env=os.environ | paths, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.slow
def test_the_pytest_recipe_passes_as_written(repository: Path) -> None:
    (recipe,) = blocks(PAGE, "python")
    assert len(recipe.splitlines()) == 9
    (repository / "test_recovery.py").write_text(recipe)
    done = shell("python -m pytest -q test_recovery.py", repository)
    assert done.returncode == 0, done.stdout + done.stderr
    # with a limit that trim cannot show to be kept, the same recipe fails and says why
    (repository / "test_recovery.py").write_text(recipe.replace("limit_deg=0.5", "limit_deg=0.2"))
    done = shell("python -m pytest -q test_recovery.py", repository)
    assert done.returncode == 1
    assert "trim: sd 0.2" in done.stdout


@pytest.mark.slow
def test_every_step_of_the_workflow_passes_as_written(repository: Path) -> None:
    (shown,) = blocks(PAGE, "yaml")
    assert shown == (OWN / "truth-recovery.yml").read_text()
    (job,) = yaml.safe_load(shown)["jobs"].values()
    steps = [step["run"] for step in job["steps"] if "run" in step]
    assert steps[0] == INSTALL
    for step in steps[1:]:
        done = shell(step, repository)
        assert done.returncode == 0, f"{step}\n{done.stdout}{done.stderr}"
    said = json.loads(done.stdout)
    assert said["passed"]
    assert said["limits"] == {"sd": 4.0, "deg": 0.5, "m": None, "mps": None, "without": ["camera"]}
    assert shell(steps[-1].replace("--without camera ", ""), repository).returncode == 5
    # a wrong mass turns checks red: the answers are written first
    heavy = shell("postflight run flight --strict --set mass_kg=99 --name heavy", repository)
    assert heavy.returncode == 5, heavy.stdout + heavy.stderr
    (run,) = (repository / "flight" / "runs").glob("*-heavy")
    assert (run / "report.html").is_file()
    assert shell("postflight run flight --set mass_kg=99", repository).returncode == 0

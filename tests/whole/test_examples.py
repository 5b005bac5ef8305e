"""Examples of the documentation, run as a reader would run them, beside a flight called demo-flight."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents import PAGES, ROOT, blocks, commands

PYTHON = [(page, code) for page in PAGES for code in blocks(page, "python")]
# those that fly or run a flight anew are what this suite's fixtures do; all of them are parsed in test_documentation.py
QUICK = {"score", "report", "calibrate", "deflection", "warmup"}
COMMANDS = [(page, words) for page in PAGES for words in commands(page) if words[0] in QUICK and "demo-flight" in words]


@pytest.fixture(scope="module")
def beside(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reader")
    (folder / "demo-flight").symlink_to(flown, target_is_directory=True)
    for name in ("tests", "examples"):
        (folder / name).symlink_to(ROOT / name, target_is_directory=True)
    return folder


@pytest.mark.slow
def test_python_examples_run(beside: Path) -> None:
    """All in one process, each in a scope of its own, for imports take longer than most of them."""
    code = "\n".join(f"print({page.name!r}); exec({text!r}, {{}})" for page, text in PYTHON)
    done = subprocess.run([sys.executable, "-c", code], cwd=beside, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(PYTHON) >= 5


@pytest.mark.slow
def test_commands_run(beside: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(beside)
    assert COMMANDS
    for page, words in COMMANDS:
        done = command(*words)
        assert done.returncode == 0, f"{page.name}: {' '.join(words)}\n{done.stdout}{done.stderr}"

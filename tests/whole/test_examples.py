"""Python of the documentation, run as a reader would run it, beside a flight called demo-flight."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents import PAGES, ROOT, blocks

PYTHON = [(page, code) for page in PAGES for code in blocks(page, "python")]
PYTHON += [(path, path.read_text()) for path in [ROOT / "examples" / "montecarlo_pbs.py"]]


@pytest.mark.slow
def test_python_examples_run(short: Path, tmp_path: Path) -> None:
    """All in one process, each page in a scope of its own, for imports take longer than most of them."""
    (tmp_path / "demo-flight").symlink_to(short, target_is_directory=True)
    for name in ("tests", "examples"):
        (tmp_path / name).symlink_to(ROOT / name, target_is_directory=True)
    lines = (f"print({page.name!r}); exec({text!r}, scopes.setdefault({page.name!r}, {{}}))" for page, text in PYTHON)
    code = "\n".join(["scopes = {}", *lines])
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(PYTHON) >= 5

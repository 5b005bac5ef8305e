"""The command's own ``main`` in this process: the same codes and words without two seconds of imports.

Films are read and figures drawn here too, as where no process can be started beside: `tests.postflight.test_beside`
has that one.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest


def draw_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let figures be drawn by this process."""
    from postflight.beside import Beside, Task

    def here(_self: Beside, task: Task[object], _wanted: bool) -> Task[object]:
        return task

    monkeypatch.setattr(Beside, "_begun", here)


def runner(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., SimpleNamespace]:
    """``run(*arguments, cwd=None)`` gives ``returncode``, ``stdout`` and ``stderr``, as a process would."""
    from postflight.cli import main

    draw_here(monkeypatch)

    def run(*arguments: str | Path, cwd: Path | None = None) -> SimpleNamespace:
        monkeypatch.setattr(sys, "argv", ["postflight", *map(str, arguments)])
        monkeypatch.setenv("COLUMNS", "200")
        if cwd is not None:
            monkeypatch.chdir(cwd)
        capsys.readouterr()
        code, trace = 0, ""
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except Exception:
            code, trace = 1, traceback.format_exc()
        seen = capsys.readouterr()
        return SimpleNamespace(returncode=code, stdout=seen.out, stderr=seen.err + trace)

    return run

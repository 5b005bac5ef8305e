"""`postflight report --notebook`: a Jupyter notebook filled in for one flight, the place to go on in Python.

It is stored without outputs and names the flight by its path from the notebook, so that both can move together. It
reads what the run wrote and computes nothing anew; its last cell proves that the results are of these inputs. Its cells
are in ``page/notebook.txt``.
"""

from __future__ import annotations

import html
import json
import os
import re
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from postflight.report.write import write_whole
from postflight.runs import Run, read_run


def write_notebook(flight_folder: Path, target: Path | None = None, path: Path | None = None) -> Path:
    """Write the notebook of a run (the last complete one, or the one given) to ``target``; return where it lies.

    Without a target it goes into the run's folder.

    Raises
    ------
    GateError
        Where the run cannot be read, or the file not be written.
    """
    run = read_run(flight_folder, path)
    target = run.path / "notebook.ipynb" if target is None else target
    away = os.path.relpath(flight_folder.resolve(), target.parent.resolve())
    write_whole(target, _notebook(run, Path(away).as_posix()))
    return target


def _notebook(run: Run, folder: str) -> str:
    """Text of the notebook; ``folder`` is the flight's path from where it lies."""
    template = files("postflight.report").joinpath("page", "notebook.txt").read_text(encoding="utf-8")
    names = {"name": _text(run.telemetry.name), "run": _text(run.path.name), "changes": _text("; ".join(run.changes))}
    form = Environment(undefined=StrictUndefined, trim_blocks=True).from_string(template)
    text = form.render(names, folder_path=repr(folder), run_name=repr(run.path.name))
    # a kind, then the text of each cell
    parts = re.split(r"^# %%(| \[markdown\])\n", text, flags=re.MULTILINE)[1:]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    book = {
        "cells": [_cell(k, *cell) for k, cell in enumerate(zip(parts[::2], parts[1::2], strict=True))],
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(book, indent=1, ensure_ascii=False) + "\n"


def _text(words: str) -> str:
    """Words from a file as a line of Markdown that shows them: nothing in it is markup, HTML or a formula."""
    return re.sub(r"([\\`*_{}\[\]()#+!|~$-])", r"\\\1", html.escape(" ".join(words.split()), quote=False))


def _cell(number: int, kind: str, text: str) -> dict[str, object]:
    about = {"id": f"cell-{number}", "metadata": {}}
    source = {"source": text.rstrip("\n").splitlines(keepends=True)}
    if kind:
        return {"cell_type": "markdown", **about, **source}
    return {"cell_type": "code", **about, "execution_count": None, "outputs": [], **source}

"""`postflight report --notebook`: a Jupyter notebook filled in for one flight, the place to go on in Python.

It is stored without outputs and names the flight by its path from the notebook, so that both can move together. It
reads what the run wrote and computes nothing anew; its last cell proves that the results are of these inputs.
"""

from __future__ import annotations

import html
import json
import os
import re
from pathlib import Path

from postflight.report.source import Run, read_run
from postflight.report.write import write_whole

_NAME = "notebook.ipynb"
_START = """\
import json
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

from flightmodel.flightfolder import read_flight

%matplotlib inline
folder = Path({folder!r})
run = folder / "runs" / {run!r}
telemetry = read_flight(folder)
summary = json.loads((run / "summary.json").read_text())
print(telemetry.name, "(synthetic)" if telemetry.synthetic else "", telemetry.t0_utc)
print(*(finding.line for finding in telemetry.findings), sep="\\n")"""
_SENSORS = """\
records = {"accelerometer": telemetry.accelerometer, "rates": telemetry.rates, **telemetry.radars, **telemetry.gnss,
           **telemetry.barometers}
rows = [(name, len(r.time_s), r.time_s[0], r.time_s[-1]) for name, r in records.items() if r is not None]
pd.DataFrame(rows, columns=["sensor", "samples", "from s", "to s"])"""
_TRAJECTORY = """\
bet = pd.read_csv(run / "bet.csv")
shown = [c for c in ("alt_m", "mach", "dynamic_pressure_pa", "alpha_total_wind_deg") if bet[c].notna().any()]
figure, axes = plt.subplots(len(shown), 1, sharex=True, figsize=(9, 2 * len(shown)))
for axis, column in zip(axes, shown):
    axis.plot(bet["t_s"], bet[column])
    if f"{column[:-4]}_sd_deg" in bet and column.endswith("_deg"):
        sd = bet[f"{column[:-4]}_sd_deg"]
        axis.fill_between(bet["t_s"], bet[column] - sd, bet[column] + sd, alpha=0.3)
    axis.set_ylabel(column)
axes[-1].set_xlabel("t_s")
pd.read_csv(run / "events.csv")"""
_CONSISTENCY_CHECKS = """\
checks = pd.read_csv(run / "consistency_checks.csv")
print(f"{checks['passed'].sum()} of {len(checks)} pass")
checks"""
_ANSWERS = """\
answers = pd.DataFrame(summary["methods"]).T
if answers.empty:
    print("the run asked no estimator; `postflight run` asks all of them")
else:
    for method in answers.index[answers["deflection_deg"].notna()]:
        table = pd.read_csv(run / f"deflection_{method}.csv")
        plt.errorbar(table["t_s"], table["theta_deg"], table["theta_sd_deg"], errorevery=10, label=method)
    plt.xlabel("t_s")
    plt.ylabel("deflection deg")
    if plt.gca().get_legend_handles_labels()[0]:
        plt.legend()
answers"""
_PROOF = """\
facts = json.loads((run / "run.json").read_text())
assert facts["inputs_sha256"] == telemetry.hashes, "the telemetry changed since the run"
print(f"postflight {facts['version']}: results of exactly these {len(telemetry.hashes)} inputs")"""
_AGAIN = """\
## Going on

The same from the library, with other settings:

    import postflight as pf
    flight = pf.read_flight(folder)
    bet = pf.reconstruct(flight)
    answers = pf.fuse(bet)
    changed = pf.fuse(pf.reconstruct(flight.with_(c_n=1.1)))
    pf.compare(answers, changed)"""


def write_notebook(flight_folder: Path, target: Path | None = None, path: Path | None = None) -> Path:
    """Write the notebook of a run (the last complete one, or the one given) to ``target``; return where it lies.

    Without a target it goes into the run's folder.

    Raises
    ------
    GateError
        Where the run cannot be read, or the file not be written.
    """
    run = read_run(flight_folder, path)
    target = run.path / _NAME if target is None else target
    away = os.path.relpath(flight_folder.resolve(), target.parent.resolve())
    write_whole(target, _notebook(run, Path(away).as_posix()))
    return target


def _notebook(run: Run, folder: str) -> str:
    """Text of the notebook; ``folder`` is the flight's path from where it lies."""
    code = {"folder": repr(folder), "run": repr(run.path.name)}
    cells = [
        (
            "markdown",
            f"# {_text(run.telemetry.name)}\n\nRun {_text(run.path.name)}. Inputs, results, consistency checks."
            + (f"\n\n**What-if:** {_text('; '.join(run.changes))}" if run.changes else ""),
        ),
        ("code", re.sub(r"\{(folder|run)!r\}", lambda name: code[name[1]], _START)),
        ("markdown", "## Measurements"),
        ("code", _SENSORS),
        ("markdown", "## Best-estimated trajectory, with one standard deviation"),
        ("code", _TRAJECTORY),
        ("markdown", "## Consistency checks: do residuals and sensors behave as assumed?"),
        ("code", _CONSISTENCY_CHECKS),
        ("markdown", "## Deflection by method, and the reason where there is none"),
        ("code", _ANSWERS),
        ("markdown", "## Provenance: these results are of these inputs"),
        ("code", _PROOF),
        ("markdown", _AGAIN),
    ]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    book = {
        "cells": [_cell(k, kind, text) for k, (kind, text) in enumerate(cells)],
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(book, indent=1, ensure_ascii=False) + "\n"


def _text(words: str) -> str:
    """Words from a file as a line of Markdown that shows them: nothing in it is markup, HTML or a formula."""
    return re.sub(r"([\\`*_{}\[\]()#+!|~$-])", r"\\\1", html.escape(" ".join(words.split()), quote=False))


def _cell(number: int, kind: str, text: str) -> dict[str, object]:
    cell: dict[str, object] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
    if kind == "code":
        cell |= {"execution_count": None, "outputs": []}
    return cell | {"source": text.splitlines(keepends=True)}

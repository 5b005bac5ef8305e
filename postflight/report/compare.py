"""`postflight compare`: runs side by side in the terminal, as tables, and over each other on one HTML page.

The page is made of the report's own parts (panels, scripts, styles, policy) and needs nothing else either.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.markup import escape

from flightmodel.checks import ConfigError, GateError, Issue
from flightmodel.files import abandoned, partial_path, writing
from flightmodel.statistics import decimals, pair
from postflight.comparison import CORRELATED, Quantity, RunComparison, compare_runs
from postflight.deflections import METHODS
from postflight.plots.style import LABEL, MANY
from postflight.report.compare_other import OTHER_TABLES, compare_with_other, print_other
from postflight.report.panels import Panel, drawn_answer, line_of, panel_of, quantities_drawn
from postflight.report.source import kept_rows, rounded
from postflight.report.text import cell, date
from postflight.report.write import charts, pulse_window, rendered
from postflight.run_folder import DIGITS, answer_table, plain_text
from postflight.runs import Run, find_run, is_complete, read_tables
from postflight.terminal import terminal

PAGE_NAME = "compare.html"
TABLES = ("runs", "differences", "differences_over_time", "checks")
_FILES = {PAGE_NAME, *(f"{name}.csv" for name in (*TABLES, *OTHER_TABLES))}
_DASHES: tuple[list[int], ...] = ([], [8, 4], [2, 3], [10, 3, 2, 3], [5, 2], [14, 4])
# panels of differences: title, unit, column of the table of differences over time
_APART = (
    ("Position, distance", "m", "position_m"),
    ("Velocity, size of the difference", "m/s", "velocity_mps"),
    ("Total angle of attack", "deg", "alpha_total_wind_deg"),
    ("Dynamic pressure", "Pa", "dynamic_pressure_pa"),
    *((f"Deflection, {LABEL[m]}", "deg", f"deflection_{m}_deg") for m in METHODS),
)
console = terminal()


def locate(word: str) -> Path:
    """Return the run folder that an argument names.

    Parameters
    ----------
    word : str
        A run's folder; a flight folder, for its last complete run; or ``FLIGHT/RUN`` with what `find_run` takes.

    Raises
    ------
    GateError
        ``run-incomplete``, ``name-unknown`` or ``run-missing``.
    """
    path = Path(word)
    is_flight = (path / "flight.toml").is_file() or (path / "runs").is_dir()
    if path.is_dir() and path.absolute().parent.name == "runs" and not is_flight:
        if not is_complete(path):
            words = "is not complete: `postflight run` or `reconstruct` makes runs to compare"
            raise GateError(f"{path}: {words}", "run-incomplete")
        return path
    if path.is_dir():
        return find_run(path)
    if (path.parent / "flight.toml").is_file() or (path.parent / "runs").is_dir():
        return find_run(path.parent, path.name)
    words = "no run: name a run's folder, a flight's, or FLIGHT/RUN with a run's name, such as my-flight/plain"
    raise GateError(f"{word}: {words}", "name-unknown")


def compare(words: tuple[str, ...], output: Path | None) -> None:
    """Print the comparison of runs and write its tables and page.

    Parameters
    ----------
    words : tuple of str
        Runs as `locate` takes them; the others are compared with the first. Or a run and a file with another source's
        trajectory (`postflight.intake.other_trajectory`).
    output : Path or None
        Folder to write; default: ``comparisons/<run>-and-<run>`` in the first run's flight folder.

    Raises
    ------
    ConfigError
        Too few, too many or equal runs; ``compare-runs`` where a file does not stand behind one run.
    GateError
        What a file is refused for; every word that means no run, runs that cannot be read; ``file-exists`` where the
        folder holds other things.
    """
    if any(Path(word).is_file() for word in words):
        _compare_with_file(words, output)
        return
    faults: list[Issue] = []
    found = []
    for word in words:
        try:
            found.append(locate(word))
        except GateError as fault:
            faults += fault.faults
    if faults:
        raise GateError(faults)
    compared = compare_runs(tuple(read_tables(path) for path in found))
    folder = output or _default_folder(compared.runs, ())
    over_time = compared.histories()
    tables = dict(zip(TABLES, (compared.to_frame(), compared.differences(), over_time, compared.checks()), strict=True))
    _write(folder, compared.runs, tables, page(compared, over_time))
    print_comparison(compared)
    console.print(escape(f"tables and {PAGE_NAME} in {folder}"), highlight=False)


def _compare_with_file(words: tuple[str, ...], output: Path | None) -> None:
    """Print and write the comparison of a run with another source's file."""
    if len(words) != 2 or Path(words[0]).is_file():
        raise ConfigError("compare: a run, then one file with another trajectory, is wanted", "compare-runs")
    run, path = read_tables(locate(words[0])), Path(words[1])
    found, tables, text = compare_with_other(run, path)
    folder = output or _default_folder((run,), (path.stem,))
    _write(folder, (run,), tables, text)
    print_other(found)
    console.print(escape(f"tables and {PAGE_NAME} in {folder}"), highlight=False)


def _default_folder(runs: tuple[Run, ...], others: tuple[str, ...]) -> Path:
    called = [run.name or run.path.name.split("-")[1] for run in runs]
    return runs[0].path.parent.parent / "comparisons" / "-and-".join((*called, *others))


def _write(folder: Path, runs: tuple[Run, ...], tables: dict[str, pd.DataFrame], text: str) -> None:
    """Write all files beside the folder and rename; only an earlier comparison may be replaced."""
    if folder.exists() and not (folder.is_dir() and {p.name for p in folder.iterdir()} <= _FILES):
        raise GateError(f"{folder}: exists and is no comparison; name another with --output", "file-exists")
    place = folder.resolve()
    if any(run.path.resolve().parent in (place, *place.parents) for run in runs):
        raise GateError(f"{folder}: run folders stay as they were written; name another place", "file-exists")
    with writing(folder, "name another folder with --output"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        for left in abandoned(folder.parent, folder.name):
            shutil.rmtree(left, ignore_errors=True)
        partial = partial_path(folder)
        try:
            partial.mkdir()
            for name, table in tables.items():
                if len(table.columns):
                    content = plain_text(table).to_csv(index=False, float_format=DIGITS, lineterminator="\n")
                    (partial / f"{name}.csv").write_text(content, encoding="utf-8")
            (partial / PAGE_NAME).write_text(text, encoding="utf-8")
            shutil.rmtree(folder, ignore_errors=True)
            partial.rename(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


# the terminal


def print_comparison(compared: RunComparison) -> None:
    """Print what each run is, values with their sd, and differences with what is known of theirs."""
    for k, (run, label) in enumerate(zip(compared.runs, compared.labels, strict=True), 1):
        about = "; ".join(run.changes) or "as flight.toml states it"
        console.print(escape(f"{k}  {label}: {run.header['flight']}, {about}, run {run.path.name}"), highlight=False)
    t = compared.at_s
    when = f"at {t[0]:.2f} s, peak q of 1" if compared.same_clock else "each at its own peak q"
    (rows, same), count = value_rows(compared), len(compared.runs)
    names = ["quantity", *(str(k + 1) for k in range(count))]
    console.table(f"Runs side by side, {when}; ± is 1 sd", names, [row[: count + 1] for row in rows])
    names = ["quantity", *(name for k in range(2, count + 1) for name in (f"{k} less 1", "its sd"))]
    console.table("Differences, the largest in sd first", names, [[row[0], *row[count + 1 :]] for row in rows])
    if same:
        console.print(f"not moved: {', '.join(same)}")
    for k, relation in enumerate(compared.relations, 2):
        console.print(escape(f"{k} and 1: {relation.words}"), highlight=False)
    if any(relation.kind == CORRELATED for relation in compared.relations):
        console.print("the sd of such a difference lies between |sd - sd| and sd + sd, which is what is shown")
    for run, label in zip(compared.runs, compared.labels, strict=True):
        passed = run.checks["passed"]
        words = f"{label}: {int(passed.sum())} of {len(passed)} consistency checks pass"
        failed = [str(name) for name in run.checks["name"][~passed.astype(bool)]]
        console.print(escape(words + (f"; failed: {', '.join(failed)}" if failed else "")), highlight=False)


def value_rows(compared: RunComparison) -> tuple[list[list[str]], list[str]]:
    """Cells of the table of values, the largest change first, and the quantities that did not move.

    A row has the quantity, each run's value, then each difference and its sd or its bounds. A quantity did not move
    where every difference rounds to zero.
    """
    others = range(1, len(compared.runs))
    rows, same = [], []
    for q in sorted(compared.quantities, key=compared.size_in_sd, reverse=True):
        apart = [cell for k in others for cell in _apart(compared, k, q)]
        if all(change and float(change) == 0.0 for change in apart[::2]):
            same.append(q.words)
        else:
            values = (_number(*compared.value(k, q)) for k in range(len(compared.runs)))
            rows.append([f"{q.words} {q.unit}".strip(), *values, *apart])
    return rows, same


def _number(value: float, sd: float) -> str:
    if not np.isfinite(value):
        return ""
    if not (np.isfinite(sd) and sd > 0.0):
        return f"{value:.2f}"
    return pair(value, sd)


def _apart(compared: RunComparison, number: int, quantity: Quantity) -> list[str]:
    """Difference, and its sd or its bounds, with the digits that the values have."""
    change, sd, low, high = compared.apart(number, quantity)
    if not np.isfinite(change):
        return ["", ""]
    if not (np.isfinite(high) and high > 0.0):
        return [f"{change:+.2f}", ""]
    shown = decimals(high)
    spread = f"{sd:.{shown}f}" if np.isfinite(sd) else f"{low:.{shown}f} to {high:.{shown}f}"
    return [f"{change:+.{shown}f}", spread]


# the page


def page(compared: RunComparison, over_time: pd.DataFrame) -> str:
    """Return the whole page."""
    first = compared.runs[0]
    bet = first.tables["bet"]
    spans = [run.tables["bet"]["t_s"] for run in compared.runs]
    whole = [float(min(t.iloc[0] for t in spans)), float(max(t.iloc[-1] for t in spans))]
    panels = [*_deflection_panels(compared), *_trajectory_panels(compared)]
    data = charts(first, whole, pulse_window(bet), panels, studies=_difference_panels(compared, over_time))
    rows, same = value_rows(compared)
    return rendered(
        "compare.html",
        data,
        compared=compared,
        title=_title(compared),
        flights=sorted({run.header["flight"] for run in compared.runs}),
        synthetic=any(run.header["synthetic"] for run in compared.runs),
        date=date(first.header["epoch_utc"]),
        values={"names": _value_names(compared), "rows": rows, "more": 0},
        same=same,
        checks=_check_rows(compared),
        inputs=_input_rows(compared),
        correlated=any(relation.kind == CORRELATED for relation in compared.relations),
    )


def _title(compared: RunComparison) -> str:
    """Return the main difference in one line: the fused deflection if every run has it."""
    fused = next((q for q in compared.quantities if q.column == "deflection_fused_deg"), None)
    values = [] if fused is None else [compared.value(k, fused) for k in range(len(compared.runs))]
    if values and np.isfinite(values).all():
        angles = [value for value, _ in values]
        if len(values) > 2:
            return f"Deflection {min(angles):.2f} to {max(angles):.2f}° in {len(values)} runs"
        return f"Deflection {' and '.join(f'{_number(*value)}°' for value in values)}"
    return f"{len(compared.runs)} runs compared"


def _value_names(compared: RunComparison) -> list[str]:
    names = ["quantity", *compared.labels]
    for label in compared.labels[1:]:
        names += [f"{label} less {compared.labels[0]}", "sd of the difference"]
    return names


def _overlay(compared: RunComparison, name: str, title: str, unit: str, drawn: list[Any]) -> list[Panel]:
    """One panel with a line a run: times, values and sds of each, None for a run without; none where no run has any."""
    lines = []
    for k, found in enumerate(drawn):
        if found is None or not np.isfinite(found[1]).any():
            continue
        t, values, sd = found
        rows = kept_rows([values], 3000)
        one = line_of(compared.labels[k], values[rows], None if sd is None else sd[rows], MANY[k], _DASHES[k], 4)
        lines.append(one | {"t": rounded(t[rows], 4)})
    return [panel_of(name, title, unit, None, lines, [])] if lines else []


def _deflection_panels(compared: RunComparison) -> list[Panel]:
    """One panel a method."""
    out = []
    for method in METHODS[::-1]:
        tables = [run.tables.get(answer_table(method, run.tables)) for run in compared.runs]
        drawn = [None if table is None or not len(table) else drawn_answer(table) for table in tables]
        panels = _overlay(compared, f"by_{method}", f"Deflection, {LABEL[method]}", "deg", drawn)
        out += [panel | {"floor": 0} for panel in panels]
    return out


def _trajectory_panels(compared: RunComparison) -> list[Panel]:
    out = []
    for identity, title, unit, scale, column, sd_column in quantities_drawn():
        drawn: list[Any] = []
        for run in compared.runs:
            bet = run.tables["bet"]
            values, sd = (scale * bet[name].to_numpy(float) for name in (column, sd_column))
            drawn.append((bet["t_s"].to_numpy(float), values, sd))
        out += _overlay(compared, identity, title, unit, drawn)
    return out


def _difference_panels(compared: RunComparison, over_time: pd.DataFrame) -> list[Panel]:
    out: list[Panel] = []
    for title, unit, column in _APART:
        if column not in over_time or not over_time[column].notna().any():
            continue
        drawn: list[Any] = [None]
        for run in compared.runs[1:]:
            part = over_time[over_time["run"] == run.path.name]
            drawn.append((part["t_s"].to_numpy(float), part[column].to_numpy(float), None))
        out += _overlay(compared, f"apart_{column}", title, unit, drawn)
    return out


def _check_rows(compared: RunComparison) -> dict[str, Any]:
    """Each check, the runs beside each other: passed or not, and the value."""
    table, rows = compared.checks(), []
    for _, row in table.iterrows():
        cells = [str(row["name"])]
        for k in range(1, len(compared.runs) + 1):
            passed = row[f"passed_{k}"]
            mark = "not made" if pd.isna(passed) else f"{'✓ pass' if passed else '✕ fail'} {cell(row[f'value_{k}'])}"
            cells.append(mark)
        rows.append(cells)
    return {"names": ["check", *compared.labels], "rows": rows, "more": 0}


def _input_rows(compared: RunComparison) -> dict[str, Any]:
    """Each input file: the first digits of its SHA-256 in every run."""
    digests = [run.facts["inputs_sha256"] for run in compared.runs]
    names = list(dict.fromkeys(name for own in digests for name in own))
    rows = [[name, *(str(own.get(name, "none"))[:12] for own in digests)] for name in names]
    return {"names": ["input", *compared.labels], "rows": rows, "more": 0}

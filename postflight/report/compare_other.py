"""`postflight compare RUN FILE`: a run against another team's trajectory, in the terminal, as tables, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.markup import escape

from flightmodel.checks import FloatArray, GateError
from flightmodel.earth import require_earth
from flightmodel.files import open_file
from flightmodel.statistics import decimals
from postflight.intake.other_trajectory import read_other
from postflight.plots.style import COLOUR
from postflight.report.panels import Panel, line_of, panel_of
from postflight.report.source import kept_rows, rounded
from postflight.report.text import date
from postflight.report.write import charts, rendered
from postflight.runs import Run, trajectory_of
from postflight.systematic_differences import SystematicDifferences, systematic_differences
from postflight.terminal import terminal

OTHER_TABLES = ("systematic_differences", "chi_square", "differences_over_time")
_TITLES = {"position": ("Position", "m"), "velocity": ("Velocity", "m/s"), "attitude": ("Rotation about body", "deg")}
console = terminal()


def compare_with_other(run: Run, path: Path) -> tuple[SystematicDifferences, dict[str, pd.DataFrame], str]:
    """Compare a run with another source's file: what was found, its tables by `OTHER_TABLES`, the page.

    Raises
    ------
    GateError
        What `read_other` and `systematic_differences` refuse; ``run-incomplete`` without ``covariance.npz``.
    """
    bet = run.tables["bet"]
    epoch = run.header["epoch_utc"]
    require_earth(run.header.get("planet", "earth"), "a comparison with another source's file")
    times, covariance = _covariance(run)
    found = systematic_differences(trajectory_of(bet, epoch), times, covariance, read_other(path, epoch))
    tables = dict(zip(OTHER_TABLES, (found.to_frame(), _chi_square(found), found.histories()), strict=True))
    return found, tables, _page(run, found, tables)


def _covariance(run: Run) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and matrices (k, 9, 9)."""
    path = run.path / "covariance.npz"
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as stored:
            return stored["t_s"], stored["covariance"]
    except (OSError, ValueError, KeyError) as fault:
        raise GateError(f"{path}: cannot be read back ({fault}); run it again", "run-incomplete") from None


def _chi_square(found: SystematicDifferences) -> pd.DataFrame:
    rows = [(name, *values) for name, values in found.chi_square.items()]
    return pd.DataFrame(rows, columns=["part", "given", "less_the_effects", "limit"])


def print_other(found: SystematicDifferences) -> None:
    """Print the paragraph and both small tables."""
    console.print(escape(found.paragraph), highlight=False)
    for note in found.notes:
        console.print(escape(f"{found.label}: {note}"), highlight=False)
    names, rows = _effect_cells(found)
    if rows:
        console.table("Systematic differences, other minus run; ± is 1 sd", names, rows)
    names, rows = _chi_square_cells(found)
    console.table("Chi-square per degree of freedom, mean over epochs", names, rows)


def _effect_cells(found: SystematicDifferences) -> tuple[list[str], list[list[str]]]:
    names = ["effect", "component", "value", "sd", "allowed sd", "unit", "size in allowed sd", "beyond"]
    rows = []
    for r in found.to_frame().itertuples():
        allowed = f"{r.stated_sd:.2g}" if np.isfinite(r.stated_sd) else ""
        size = f"{r.stated_size:.1f}" if np.isfinite(r.stated_size) else ""
        numbers = [
            f"{r.value:.{decimals(r.sd)}f}",
            f"{r.sd:.{decimals(r.sd)}f}",
            allowed,
            r.unit,
            size,
            "yes" if r.beyond else "no",
        ]
        rows.append([r.effect, r.component, *numbers])
    return names, rows


def _chi_square_cells(found: SystematicDifferences) -> tuple[list[str], list[list[str]]]:
    rows = [[name, *(f"{value:.3g}" for value in values)] for name, values in found.chi_square.items()]
    return ["part", "as given", "less the effects", "limit (99.9 %)"], rows


def _page(run: Run, found: SystematicDifferences, tables: dict[str, pd.DataFrame]) -> str:
    span = [float(found.time_s[0]), float(found.time_s[-1])]
    data = charts(run, span, span, _panels(found, tables["differences_over_time"]))
    effects, chi_square = (
        {"names": names, "rows": rows, "more": 0} for names, rows in (_effect_cells(found), _chi_square_cells(found))
    )
    return rendered(
        "compare_other.html",
        data,
        run=run,
        found=found,
        effects=effects,
        chi_square=chi_square,
        title=title_of(found),
        date=date(run.header["epoch_utc"]),
    )


def title_of(found: SystematicDifferences) -> str:
    """Heading of the page: what is beyond the covariances, and what is within."""
    if not found.effects:
        return f"{found.label}: no systematic difference"
    beyond = [effect.name.replace("-", " ") for effect in found.effects if effect.beyond]
    within = [effect.name.replace("-", " ") for effect in found.effects if not effect.beyond]
    parts = ", ".join(beyond), f"{', '.join(within)} within the covariances" if within else ""
    return f"{found.label}: {'; '.join(part for part in parts if part)}"


def _panels(found: SystematicDifferences, table: pd.DataFrame) -> list[Panel]:
    """One panel a component: the difference as given and less the effects, about zero with the sd of both."""
    panels = []
    t = table["t_s"].to_numpy(float)
    for column in table.columns[1::3]:
        group, axis = str(column).split("_")[:2]
        stem, unit = f"{group}_{axis}", str(column).rpartition("_")[2]
        values, left, sd = (table[f"{stem}{what}_{unit}"].to_numpy(float) for what in ("", "_left", "_sd"))
        rows = kept_rows([values, left], 3000)
        drawn: list[tuple[str, FloatArray, FloatArray | None, str, list[int]]] = [
            ("both covariances" if found.both_stated else "run's covariance", 0.0 * sd, sd, COLOUR["prior"], [2, 3]),
            ("as given", values, None, COLOUR["second"], [8, 4]),
        ]
        drawn += [("less the effects", left, None, COLOUR["estimate"], [])] if found.effects else []
        lines: list[dict[str, Any]] = []
        for label, y, y_sd, colour, dash in drawn:
            one = line_of(label, y[rows], None if y_sd is None else y_sd[rows], colour, dash, 6)
            lines.append(one | {"t": rounded(t[rows], 4)})
        title, shown = _TITLES[group]
        panels.append(panel_of(f"other_{stem}", f"{title} {axis}, other minus run", shown, None, lines, []))
    return panels

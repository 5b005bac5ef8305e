"""Which runs has a flight, which one is meant, and what did it write? Runs named, selected and read back.

A run is complete where every file is there that a later command reads; what `postflight deflection` and `postflight
reconcile` leave is none, and what is being written, or was when its process was killed, bears a hidden name.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import rotations
from flightmodel.checks import ConfigError, FloatArray, GateError, nearest_name
from flightmodel.deflection import DeflectionHistory
from flightmodel.files import file_bytes
from flightmodel.trajectory import Trajectory
from postflight.run_folder import FACTS, answer_table, read_csv, run_hash

PLAIN = "plain"  # selects the last run without a changed assumption
STATE_COLUMNS = (
    "t_s",
    *(f"r{a}_ecef_m" for a in "xyz"),
    *(f"v{a}_ecef_mps" for a in "xyz"),
    *(f"q{a}_ecef_body" for a in "wxyz"),
    *(f"{a}_body_degps" for a in "pqr"),
)
_COMPLETE = (FACTS, "summary.json", "bet_header.json", "bet.csv")
_NEEDED = ("bet", "events", "peaks", "residuals", "verdicts", "findings")
_CHECKS = ("name", "value", "low", "high", "passed", "remark", "code")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
_SHOWN = 8  # of a flight's runs, in a message


def check_name(name: str) -> str:
    """Return the name if a run may have it, or raise `ConfigError`: it becomes part of a folder's name."""
    if not _NAME.fullmatch(name) or name == PLAIN:
        words = f"--name {name!r}: letters, digits, '.', '_' and '-', at most 40 of them, are wanted; not '{PLAIN}'"
        raise ConfigError(words, "option-format")
    return name


def is_complete(run: Path) -> bool:
    """Whether a run folder holds everything that later commands read."""
    return all((run / name).is_file() for name in _COMPLETE)


def complete_runs(flight_folder: Path) -> list[Path]:
    """Complete runs of a flight, the oldest first."""
    there = (flight_folder / "runs").glob("*/")
    return sorted(run for run in there if not run.name.startswith(".") and is_complete(run))


def facts_of(run: Path) -> dict[str, Any]:
    """Return ``run.json``; `GateError` where it cannot be read."""
    return read_back(run / FACTS, "settings")


def read_back(path: Path, *parts: str) -> dict[str, Any]:
    """Return a JSON object of a run in which these parts are objects too; `GateError` where it cannot be read."""
    try:
        found = json.loads(file_bytes(path))
        if isinstance(found, dict) and all(isinstance(found.get(part), dict) for part in parts):
            return found
        fault: object = f"it states no {' and no '.join(parts)}"
    except (OSError, ValueError) as refused:
        fault = refused
    raise GateError(f"{path}: cannot be read back ({fault}); run it again", "run-incomplete")


def changes_of(facts: dict[str, Any]) -> tuple[str, ...]:
    """Assumptions in which a run differs from its flight folder."""
    return tuple(map(str, facts["settings"].get("changes") or ()))


def find_run(flight_folder: Path, wanted: str | Path | None = None) -> Path:
    """Return the last complete run, or the last that is meant by a word.

    Parameters
    ----------
    flight_folder : Path
    wanted : str, Path or None
        The run's name, its eight digits, its folder or the folder's name; ``plain`` for the last without a changed
        assumption.

    Raises
    ------
    GateError
        ``run-missing`` where the flight has no complete run, ``name-unknown`` where none is so called,
        ``run-incomplete``, ``run-missing`` where the folder is not one, or of another flight.
    """
    runs = complete_runs(flight_folder)
    named = {name for run in runs for name in _names(run)}
    if wanted is not None and str(wanted) not in (PLAIN, *named) and Path(wanted).is_dir():
        return _whole(flight_folder, Path(wanted))
    if not runs:
        words = f"{flight_folder}: no complete run; use `postflight run {flight_folder}` first"
        raise GateError(words, "run-missing")
    if wanted is None:
        return runs[-1]
    wanted = str(wanted)
    if wanted == PLAIN:
        fitting = [run for run in runs if not changes_of(facts_of(run))]
    else:
        fitting = [run for run in runs if wanted in _names(run)]
    if fitting:
        return fitting[-1]
    known = [PLAIN, *(name for run in runs[-_SHOWN:] for name in _names(run))]
    listed = "; ".join(f"{run.name} ({_about(facts_of(run))})" for run in runs[-_SHOWN:])
    words = f"{flight_folder}: no complete run '{wanted}'{nearest_name(wanted, known)}; there are: {listed}"
    raise GateError(words, "name-unknown")


def _whole(flight_folder: Path, run: Path) -> Path:
    """Return the folder of a run of this flight, or raise `GateError` with what it lacks."""
    if run.resolve().parent != (flight_folder / "runs").resolve():
        words = f"{run}: no run of {flight_folder}, whose runs lie in {flight_folder / 'runs'}"
        raise GateError(words, "run-missing")
    missing = [name for name in _COMPLETE if not (run / name).is_file()]
    if missing:
        words = f"{run}: no complete run, without {', '.join(missing)}; `postflight run` leaves one, `reconcile` and "
        raise GateError(f"{words}`deflection` do not", "run-incomplete")
    return run


def _names(run: Path) -> tuple[str, ...]:
    """What a run is called: its folder's name, its eight digits, and the name that it was given."""
    _, _, rest = run.name.partition("-")
    digits, _, name = rest.partition("-")
    return tuple(filter(None, (run.name, digits, name)))


def _about(facts: dict[str, Any]) -> str:
    return "; ".join(changes_of(facts)) or "as flight.toml states it"


@dataclass(frozen=True)
class RunTables:
    """What a complete run wrote.

    Parameters
    ----------
    path : Path
        The run's folder.
    summary, facts, header : dict
        ``summary.json``, ``run.json``, ``bet_header.json``.
    tables : dict of DataFrame
        Every CSV table of the folder by its stem.
    """

    path: Path
    summary: dict[str, Any]
    facts: dict[str, Any]
    header: dict[str, Any]
    tables: dict[str, pd.DataFrame]

    @property
    def hash8(self) -> str:
        """What stands for inputs, settings and version in the folder's name."""
        return run_hash(self.facts["inputs_sha256"], self.facts["settings"], self.facts["version"])

    @property
    def name(self) -> str:
        """The name that the run was given; empty for none."""
        return str(self.facts.get("name") or "")

    @property
    def changes(self) -> tuple[str, ...]:
        """Assumptions in which the run differs from its flight folder; none for a plain run."""
        return changes_of(self.facts)

    @property
    def checks(self) -> pd.DataFrame:
        """Consistency checks; of a run of version 0.1 those of ``verdicts.csv``, without codes."""
        table = self.tables.get("consistency_checks")
        if table is None:
            table = self.tables["verdicts"].rename(columns={"words": "remark"})
        return table[[name for name in _CHECKS if name in table]]

    @property
    def peak_s(self) -> float:
        """Time of the run's peak dynamic pressure, s."""
        return float(self.summary["peak_dynamic_pressure_s"])

    def peak(self, name: str) -> pd.Series | None:
        """Row of ``peaks.csv``; None where the flight has none of that name."""
        rows = self.tables["peaks"][self.tables["peaks"]["peak"] == name]
        return rows.iloc[0] if len(rows) else None

    def history(self, method: str) -> DeflectionHistory | None:
        """A method's answer at any time; None where it gave none."""
        table = self.tables.get(answer_table(method, self.tables))
        return None if table is None or not len(table) else deflection_history(table, method)


def read_tables(run: Path) -> RunTables:
    """Read a run back.

    Raises
    ------
    GateError
        ``run-incomplete`` where a file of it is missing or cannot be read.
    """
    again = f"use `postflight run {run.parent.parent}` again"
    try:
        summary, header = (json.loads(file_bytes(run / f"{name}.json")) for name in ("summary", "bet_header"))
        tables = {p.stem: read_csv(p) for p in sorted(run.glob("*.csv"))}
    except (OSError, ValueError) as fault:
        raise GateError(f"{run}: not a whole run ({fault}); {again}", "run-incomplete") from None
    answered = [m for m, row in (summary.get("methods") or {}).items() if row.get("deflection_deg") is not None]
    needed = (*_NEEDED, *(answer_table(method, tables) for method in answered))
    missing = [f"{name}.csv" for name in needed if name not in tables]
    if missing:
        raise GateError(f"{run}: not a whole run, without {', '.join(missing)}; {again}", "run-incomplete")
    return RunTables(run, summary, facts_of(run), header, tables)


def deflection_history(table: pd.DataFrame, method: str) -> DeflectionHistory:
    """Angle, its sd and plane of a ``deflection_<method>.csv``."""
    names = ("theta_deg", "plane_lv_deg", "theta_sd_deg")
    theta, plane, sd = (np.deg2rad(table[c].to_numpy(dtype=float)) for c in names)
    cov = np.zeros((len(table), 2, 2))
    cov[:, 0, 0] = sd**2
    return DeflectionHistory(table["t_s"].to_numpy(dtype=float), theta, plane, cov, method)


def trajectory_of(table: pd.DataFrame, epoch_utc: str = "2000-01-01T00:00:00Z") -> Trajectory:
    """Trajectory from the `STATE_COLUMNS` that ``truth.csv`` and ``bet.csv`` share."""

    def columns(pattern: str, letters: str) -> FloatArray:
        return table[[pattern.format(a) for a in letters]].to_numpy(dtype=float)

    q = columns("q{}_ecef_body", "wxyz")
    return Trajectory(
        epoch_utc,
        table["t_s"].to_numpy(dtype=float),
        "datum",
        columns("r{}_ecef_m", "xyz"),
        columns("v{}_ecef_mps", "xyz"),
        rotations.continuous(q / np.linalg.norm(q, axis=1, keepdims=True)),
        np.deg2rad(columns("{}_body_degps", "pqr")),
    )

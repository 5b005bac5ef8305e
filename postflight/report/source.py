"""What is a report made from? A finished run's files, the telemetry behind them, and the rows of them to draw.

Of long series the smallest and the largest value of each of equal runs of rows are drawn: every extreme stays.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flightmodel.checks import FloatArray, GateError
from flightmodel.flightfolder import read_flight
from flightmodel.guarded_files import file_bytes
from flightmodel.telemetry import Telemetry
from postflight.run_folder import newest_run, read_csv, run_hash

_NEEDED = ("bet", "events", "peaks", "residuals", "verdicts", "findings")
_CHECKS = ("name", "value", "low", "high", "passed", "remark", "code")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Parameters
    ----------
    telemetry : Telemetry
        As the run read it.
    path : Path
        The run's folder.
    summary, facts, header : dict
        ``summary.json``, ``run.json``, ``bet_header.json``.
    tables : dict of DataFrame
        Every CSV table of the folder by its stem.
    """

    telemetry: Telemetry
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
    def checks(self) -> pd.DataFrame:
        """Consistency checks; of a run of version 0.1 those of ``verdicts.csv``, without codes."""
        table = self.tables.get("consistency_checks")
        if table is None:
            table = self.tables["verdicts"].rename(columns={"words": "remark"})
        return table[[name for name in _CHECKS if name in table]]

    def peak(self, name: str) -> pd.Series | None:
        """Row of ``peaks.csv``; None where the flight has none of that name."""
        rows = self.tables["peaks"][self.tables["peaks"]["peak"] == name]
        return rows.iloc[0] if len(rows) else None


def read_run(flight_folder: Path, path: Path | None = None, telemetry: Telemetry | None = None) -> Run:
    """Read a run, the newest unless one is named, and its telemetry unless it is at hand.

    Raises
    ------
    GateError
        Where there is no finished run, a file of it is missing, or the telemetry is not what the run was made from.
    """
    path = newest_run(flight_folder) if path is None else path
    again = f"use `postflight run {flight_folder}` again"
    try:
        summary, facts, header = (
            json.loads(file_bytes(path / f"{name}.json")) for name in ("summary", "run", "bet_header")
        )
        tables = {p.stem: read_csv(p) for p in sorted(path.glob("*.csv"))}
    except (OSError, ValueError) as fault:
        raise GateError(f"{path}: not a whole run ({fault}); {again}", "run-incomplete") from None
    missing = [f"{name}.csv" for name in _NEEDED if name not in tables]
    if missing:
        raise GateError(f"{path}: not a whole run, without {', '.join(missing)}; {again}", "run-incomplete")
    telemetry = read_flight(flight_folder) if telemetry is None else telemetry
    then, now = facts["inputs_sha256"], telemetry.hashes
    changed = sorted(name for name in then.keys() | now.keys() if then.get(name) != now.get(name))
    if changed:
        words = f"{flight_folder}: changed since the run {path.name}: {', '.join(changed)}; {again}"
        raise GateError(words, "inputs-changed")
    return Run(telemetry, path, summary, facts, header, tables)


Rows = NDArray[np.int64]


def extreme_rows(values: FloatArray, buckets: int) -> Rows:
    """Rows of the smallest and the largest value ``(n,)`` in each of equal runs of rows, ascending; NaN is no value."""
    edges = np.linspace(0, len(values), buckets + 1).astype(int)
    found: list[int] = []
    for low, high in pairwise(edges.tolist()):
        part = values[low:high]
        if np.isfinite(part).any():
            found += [low + int(np.nanargmin(part)), low + int(np.nanargmax(part))]
    return np.unique(np.array(found, dtype=np.int64))


def kept_rows(columns: list[FloatArray], limit: int) -> Rows:
    """Rows to draw of columns ``(n,)`` that share their times: all, or every column's extremes within ``limit`` rows.

    First and last row stay, and so do the two sides of every hole, a run of NaN.
    """
    n = len(columns[0])
    if n <= limit:
        return np.arange(n)
    buckets = limit // 2 - 1
    while True:
        sides = [np.flatnonzero(np.diff(np.isfinite(c).astype(int))) for c in columns]
        rows = [extreme_rows(c, buckets) for c in columns] + sides + [s + 1 for s in sides] + [np.array([0, n - 1])]
        kept = np.unique(np.concatenate(rows))
        if len(kept) <= limit or buckets <= 16:
            return kept
        buckets = buckets * 2 // 3


def rounded(values: FloatArray, decimals: int) -> list[float | None]:
    """Numbers for JSON, NaN as None."""
    return [round(x, decimals) + 0.0 if x == x else None for x in np.asarray(values, dtype=float).tolist()]

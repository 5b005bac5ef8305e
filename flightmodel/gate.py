"""The gate of a flight folder: keeps faults and findings while files are read, and opens where there is no fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd

from flightmodel import columns
from flightmodel.checks import BoolArray, ConfigError, FloatArray, GateError, nearest_name
from flightmodel.columns import IntArray
from flightmodel.quickread import file_sha256, read_numbers
from flightmodel.roworder import in_order
from flightmodel.selection import rows_to_use
from flightmodel.sources import Source
from flightmodel.telemetry import Finding

# no entry vehicle's instruments read beyond these; a larger number is a wrong unit or a broken word
SANE_LIMIT = {
    "acceleration": 1.0e4,
    "rate": 400.0,
    "length": 1.0e8,
    "angle": 4.0 * np.pi,
    "magnetic field": 1.0e-3,
}


# times, columns by short name, and the file line of each row
Read = tuple[FloatArray | None, dict[str, FloatArray], IntArray]


@dataclass(frozen=True)
class Table:
    """One file's times (where it has any), SI columns by short name, and the file line of each row."""

    path: Path
    label: str
    time_s: FloatArray | None
    columns: dict[str, FloatArray]
    lines: IntArray

    def at(self, row: int) -> str:
        """Return where a row stands, for messages."""
        return f"{self.label}: {self.path}: line {int(self.lines[row])}"

    def of_rows(self, rows: BoolArray) -> Table:
        """Return the table of these rows alone."""
        if rows.all():
            return self
        time_s = None if self.time_s is None else self.time_s[rows]
        kept = {short: values[rows] for short, values in self.columns.items()}
        return Table(self.path, self.label, time_s, kept, self.lines[rows])


@dataclass
class Gate:
    """What is wrong with a folder (``faults`` of the data, ``config`` of flight.toml), and what is notable."""

    folder: Path
    t0: datetime
    faults: list[str] = field(default_factory=list)
    config: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    digests: dict[Path, str] = field(default_factory=dict)
    tell: Callable[[int], None] = lambda _bytes: None  # of how many bytes more were read

    def sha256(self, path: Path) -> str:
        """SHA-256 of a file, from its reading where that made one."""
        return self.digests.get(path) or file_sha256(path)

    def refuse_config(self, words: str) -> None:
        """Keep a fault of flight.toml."""
        self.config.append(f"{self.folder / 'flight.toml'}: {words}")

    def close(self) -> None:
        """Raise `ConfigError` or `GateError` with everything that was refused."""
        if self.config:
            raise ConfigError([*self.config, *self.faults])
        if self.faults:
            raise GateError(self.faults)

    def wrong_place(self, path: Path, named: str) -> str:
        """Return why a named file may not be read: outside the folder, or below its truth; empty where it may."""
        if "\0" in named:
            return f"file {named!r}: a path holds no NUL character"
        root, target = self.folder.resolve(), path.resolve()
        if Path(named).is_absolute() or not target.is_relative_to(root):
            return f"file '{named}' lies outside the flight folder; copy it inside and name it relative to flight.toml"
        if target.is_relative_to(root / "truth"):
            return f"file '{named}' lies below truth/, which no estimator may open"
        return ""

    def path(self, named: str) -> Path | None:
        """Path of a file or folder that flight.toml names; None, with a fault, where it may not be read."""
        path = self.folder / named
        wrong = self.wrong_place(path, named)
        if wrong:
            self.refuse_config(wrong)
        return None if wrong else path

    def csv(self, path: Path, label: str) -> pd.DataFrame | None:
        """Read a CSV as text; None, with its faults kept, where it is no table."""
        try:
            return columns.read_table(path, label)
        except GateError as fault:
            self.faults.extend(fault.faults)
            return None

    def table(
        self, label: str, source: Source, quantities: tuple[columns.Quantity, ...], timed: bool = True
    ) -> Table | None:
        """Read one file; None, with its faults kept, where anything in it is refused."""
        before = len(self.faults) + len(self.config)
        shorts = [q.short for q in quantities]
        for key in (k for k in source.columns if k not in shorts):
            hint = nearest_name(key, shorts)
            self.refuse_config(f"{label}.columns.{key}: no such quantity{hint}")
        path = self.path(source.file)
        if path is None:
            return None
        read = self._read_quickly(path, source, quantities, timed)
        if read is None:
            read = self._read_carefully(path, label, source, quantities, timed)
        if read is None:
            return None
        table = Table(path, label, *read)
        if source.time.repeats == "refuse":  # else the first row of each time is chosen below
            table = self._ordered(table)
        table = self.chosen(table, source)
        if not len(table.lines):
            return None
        for quantity in quantities:
            limit = SANE_LIMIT.get(quantity.kind, np.inf)
            self.refuse_rows(table, quantity.short, -limit, limit, f"beyond any {quantity.kind} of a flight")
        return table if len(self.faults) + len(self.config) == before else None

    def _read_quickly(
        self, path: Path, source: Source, quantities: tuple[columns.Quantity, ...], timed: bool
    ) -> Read | None:
        """Times, columns and lines of a large file without faults; None where the careful reader must look."""
        if timed and (source.time_column.format == "utc_hms" or source.time_column.repeats == "first"):
            return None
        places = {q.short: columns.place(q, source.declared(q.short)) for q in quantities}
        if not all(columns.fits(q, places[q.short][1]) for q in quantities):
            return None
        wanted = {places[q.short][0]: q.required or q.short in source.columns for q in quantities}
        time = source.time_column if timed else None
        found = read_numbers(path, wanted, time, self.t0, self.tell)
        if found is None or len(wanted) < len(places):
            return None
        time_s = found.time
        if time is not None and time_s is not None:
            if time.format == "seconds":
                time_s = columns.to_si(time_s.copy() if time.column in wanted else time_s, time.unit)
            if not np.isfinite(time_s).all():
                return None
        self.digests[path] = found.sha256
        held = {short: place for short, place in places.items() if place[0] in found.columns}
        values = {short: columns.to_si(found.columns[column], unit) for short, (column, unit) in held.items()}
        rows = len(next(iter(values.values())))
        return time_s, values, found.first_line + np.arange(rows)

    def _read_carefully(
        self, path: Path, label: str, source: Source, quantities: tuple[columns.Quantity, ...], timed: bool
    ) -> Read | None:
        """Times, columns and lines of a file read as text; what is wrong with it becomes faults."""
        frame = self.csv(path, label)
        if frame is None:
            return None
        time_s, values = None, {}
        if timed:
            time_s = columns.unordered_times_s(frame, source.time_column, self.t0, path, label, self.faults)
        for quantity in quantities:
            column = columns.column_si(frame, quantity, source.declared(quantity.short), path, label, self.faults)
            if column is not None:
                values[quantity.short] = column
        return time_s, values, frame.attrs["lines"]

    def chosen(self, table: Table, source: Source) -> Table:
        """Return the rows that flight.toml lets be used, at its times, with a finding for those that it does not."""
        if table.time_s is None:
            return table
        time_s = table.time_s + source.time.offset_s
        table = replace(table, time_s=time_s)
        rows, findings = rows_to_use(table.label, source, time_s)
        self.findings.extend(findings)
        if rows.sum() < 2:
            span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s"
            self.faults.append(f"{table.label}: {table.path}: use_s leaves {rows.sum()} rows of {span}; two are needed")
        return table.of_rows(rows)

    def _ordered(self, table: Table) -> Table:
        """Rows in the order of time, each once; what was done to them becomes findings, or a fault."""
        if table.time_s is None:
            return table
        delivery = in_order(table.time_s, list(table.columns.values()), table.lines)
        if delivery.refusal:
            self.faults.append(f"{table.label}: {table.path}: {delivery.refusal}")
        if delivery.refusal or not delivery.repairs:
            return table
        source = table.label.partition(".")[2] or table.label
        self.findings.extend(Finding(source, *repair) for repair in delivery.repairs)
        rows = delivery.rows
        held = {short: column[rows] for short, column in table.columns.items()}
        return Table(table.path, table.label, table.time_s[rows], held, table.lines[rows])

    def refuse_rows(self, table: Table, short: str, low: float, high: float, words: str) -> None:
        """Refuse a column's values outside ``low`` to ``high`` (SI), naming the first's line; missing ones pass."""
        values = table.columns.get(short)
        if values is None:
            return
        if np.fmin.reduce(values) >= low and np.fmax.reduce(values) <= high:
            return
        with np.errstate(invalid="ignore"):
            wild = (values < low) | (values > high)
        if wild.any():
            k = int(np.argmax(wild))
            count = f"({int(wild.sum())} in all)"
            self.faults.append(
                f"{table.at(k)}: {short} = {values[k]:.6g} (SI) is {words} {count}; check its unit or leave it empty"
            )

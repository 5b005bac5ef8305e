"""What ``postflight import`` does: tables into the folder, proposals into flight.toml, and a table of both to read."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flightmodel.checks import ConfigError, GateError
from flightmodel.config import read_toml
from postflight.intake.clock_columns import split_clocks
from postflight.intake.loose import LooseTable, read_loose
from postflight.intake.matlab import read_matlab
from postflight.intake.proposal import SourceProposal
from postflight.intake.propose import propose
from postflight.intake.sounding_tables import radiosonde_table
from postflight.intake.write_mapping import section_text, start_text
from postflight.whole_file import write_file

console = Console(soft_wrap=True)
MATLAB = (".mat",)


def import_files(files: tuple[Path, ...], folder: Path) -> None:
    """Read, propose, write, print.

    Raises
    ------
    ConfigError
        Where the folder has no flight.toml, or a table of that name is there already.
    GateError
        For files in which no table is found: all of them; nothing is written then.
    """
    path = folder / "flight.toml"
    if not path.exists():
        raise ConfigError(f"{folder}: no flight.toml; make one with `postflight init {folder}`")
    tables = read_toml(path)
    read: list[LooseTable] = []
    faults: list[str] = []
    for file in files:
        try:
            read += read_matlab(file) if file.suffix.lower() in MATLAB else [read_loose(file)]
        except ConfigError:
            raise
        except GateError as fault:
            faults += fault.faults
    if faults:
        raise GateError(faults)
    read = [radiosonde_table(table) or table for table in read]
    places = [_place(folder, table) for table in read]
    there = [str(p) for k, p in enumerate(places) if p.exists() or p in places[:k]]
    if there:
        raise ConfigError(
            [f"{p}: exists already, and nothing is overwritten; rename the new one, or remove it there" for p in there]
        )
    added, shown = _proposals(read, places, folder, tables)
    text = path.read_text(encoding="utf-8-sig").rstrip() + "\n" + added
    tomllib.loads(text)  # what is written can be read
    for table, place in zip(read, places, strict=True):
        write_file(place, table.as_csv())
    write_file(path, text)
    print_proposals(shown)
    left = f"{added.count('FILL IN')} values are left to you in {path}. Next: postflight check {folder}"
    console.print(escape(left), highlight=False)


def _place(folder: Path, table: LooseTable) -> Path:
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", table.label).strip("_") or "table"
    return folder / "telemetry" / f"{name}.csv"


def _proposals(
    read: list[LooseTable], places: list[Path], folder: Path, tables: dict[str, Any]
) -> tuple[str, list[tuple[LooseTable, list[SourceProposal], list[str]]]]:
    """Text to add to flight.toml, and what to print."""
    taken = _sections(tables)
    added, shown = [], []
    for table, place in zip(read, places, strict=True):
        split_clocks(table)
        found, left = propose(table)
        shown.append((table, found, left))
        for source in found:
            file = place.relative_to(folder).as_posix()
            added.append(section_text(source, file, table.notes, source.section in taken))
            taken.add(source.section)
    start = start_text(taken, tables)
    return "".join(f"\n{text}" for text in (*added, start) if text), shown


def _sections(tables: dict[str, Any]) -> set[str]:
    out: set[str] = {"atmosphere", "frames"} & set(tables)
    for group in ("sensors", "radars", "gnss", "barometers"):
        out |= {f"{group}.{name}" for name in tables.get(group, {})}
    return out


def print_proposals(shown: list[tuple[LooseTable, list[SourceProposal], list[str]]]) -> None:
    """One table for each file: column, what it is taken for, unit, and why; below it what was changed and not used."""
    for table, found, left in shown:
        screen = Table(title=escape(table.label), title_justify="left")
        for name in ("column", "as", "unit", "how", "why"):
            screen.add_column(name)
        for source in found:
            t = source.time
            if t is not None and source is found[0]:
                unit = t.unit or ("" if t.format != "seconds" else "?")
                screen.add_row(*map(escape, (", ".join(t.columns), f"time, {t.format}", unit, t.how, t.why)))
            for m in source.columns:
                screen.add_row(*map(escape, (m.column, f"{source.section} {m.short}", m.unit or "?", m.how, m.why)))
        if found:
            console.print(screen)
        else:
            words = f"{table.label}: nothing recognised among {', '.join(table.names)}"
            console.print(f"[yellow]{escape(words)}[/]; its columns can be declared in flight.toml by hand")
        for words in (*table.notes, *([f"not used: {', '.join(left)}"] if left and found else [])):
            console.print(f"  {escape(words)}", highlight=False)

"""What ``postflight import`` does: files into the folder, proposals into flight.toml, and a table of both to read.

Tables go to ``telemetry/`` as CSV, pictures and films there as they are, coefficient tables beside the vehicle file.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flightmodel.checks import ConfigError, GateError
from flightmodel.config import read_toml
from flightmodel.vehicle import DATA, vehicle_path
from postflight.intake.clock_columns import split_clocks
from postflight.intake.coefficients import (
    DAVEML,
    as_coefficients,
    coefficient_columns,
    how_to_name,
    named_in_form,
    sidecar_text,
)
from postflight.intake.left import left_to_fill_in
from postflight.intake.loose import LooseTable, read_loose
from postflight.intake.matlab import read_matlab
from postflight.intake.pictures import PICTURES, Video, cameras_of, copied, frame_list, video_of, without_list
from postflight.intake.proposal import ASKED, SourceProposal
from postflight.intake.propose import Reader
from postflight.intake.sounding_tables import radiosonde_table
from postflight.intake.write_mapping import section_text, start_text
from postflight.whole_file import write_file

console = Console(soft_wrap=True)
MATLAB = (".mat",)
TABLES = (".csv", ".tsv", ".dat", ".asc", ".tab", *MATLAB)  # what is named so and holds no table is refused


@dataclass
class Delivered:
    """What came: tables, videos, new files, the vehicle file anew, and what is left alone, with why."""

    tables: list[LooseTable] = field(default_factory=list)
    videos: list[Video] = field(default_factory=list)
    daveml: dict[Path, bytes] = field(default_factory=dict)
    files: dict[Path, bytes | str] = field(default_factory=dict)
    vehicle: dict[Path, str] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def import_files(files: tuple[Path, ...], folder: Path) -> None:
    """Read, propose, write, print.

    Raises
    ------
    ConfigError
        Where the folder has no flight.toml, or a file of that name is there already.
    GateError
        For tables in which no table is found: all of them; nothing is written then.
    """
    path = folder / "flight.toml"
    if not path.exists():
        raise ConfigError(f"{folder}: no flight.toml; make one with `postflight init {folder}`")
    tables = read_toml(path)
    came = _delivered(files, folder)
    _coefficients(came, folder, tables)
    places = [_place(folder, table) for table in came.tables]
    every = [*places, *(v.place for v in came.videos), *came.files]
    there = [str(p) for k, p in enumerate(every) if p.exists() or p in every[:k]]
    if there:
        raise ConfigError(
            [f"{p}: exists already, and nothing is overwritten; rename the new one, or remove it there" for p in there]
        )
    added, shown = _proposals(came, places, folder, tables)
    text = path.read_text(encoding="utf-8-sig").rstrip() + "\n" + added
    tomllib.loads(text)  # what is written can be read
    for video in came.videos:
        copied(video)
    for table, place in zip(came.tables, places, strict=True):
        write_file(place, table.as_csv())
    for place, content in (*came.files.items(), *came.vehicle.items()):
        write_file(place, content)
    write_file(path, text)
    print_proposals(shown)
    for video in came.videos:
        what = "film" if video.is_film else f"{len(video.names)} pictures"
        console.print(f"{escape(str(video.place))}: {what}", highlight=False)
    for words in came.notes:
        console.print(escape(words), highlight=False)
    for words in came.skipped:
        console.print(f"[yellow]left out[/] {escape(words)}", highlight=False)
    print_left(folder)


def print_left(folder: Path) -> None:
    """Say which values are still to write, file by file."""
    left = left_to_fill_in(folder)
    by_file: dict[str, list[str]] = {}
    for words in left:
        file, key = words.split(": key '", 1)
        by_file.setdefault(file, []).append(key.rsplit("'", 1)[0])
    for file, keys in by_file.items():
        console.print(f"[cyan]to fill in[/] {escape(file)}: {escape(', '.join(keys))}", highlight=False)
    said = f"{len(left)} values are left to you. Next: postflight check {folder}"
    console.print(escape(said), highlight=False)


def _delivered(files: tuple[Path, ...], folder: Path) -> Delivered:
    """Sort and read what was delivered; `GateError` with every table that cannot be read."""
    came = Delivered()
    faults: list[str] = []
    for file in files:
        video = video_of(file, folder / "telemetry")
        if video is not None:
            came.videos.append(video)
            came.skipped += _beside_pictures(file, video)
        elif file.is_dir():
            came.skipped.append(f"{file}: a folder without pictures; name the files in it: {file / '*'}")
        elif file.suffix.lower() in DAVEML:
            came.daveml[file] = _bytes_of(file)
        elif file.suffix.lower() in PICTURES:
            came.skipped.append(f"{file}: a picture alone; name the folder that holds a video's pictures")
        else:
            try:
                came.tables += read_matlab(file) if file.suffix.lower() in MATLAB else [read_loose(file)]
            except ConfigError:
                raise
            except GateError as fault:
                if file.suffix.lower() in TABLES or not file.is_file():
                    faults += fault.faults
                else:
                    came.skipped += fault.faults
    if faults:
        raise GateError(faults)
    if not (came.tables or came.videos or came.daveml):
        raise GateError(came.skipped)
    came.tables = [radiosonde_table(table) or table for table in came.tables]
    return came


def _beside_pictures(folder: Path, video: Video) -> list[str]:
    if video.is_film:
        return []
    others = sorted(p.name for p in folder.iterdir() if p.name not in video.names)
    return [f"{folder}: beside its pictures {', '.join(others[:5])}{' ...' if others[5:] else ''}"] if others else []


def _bytes_of(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as fault:
        raise GateError(f"{file}: cannot be read: {fault.strerror or fault}") from None


def _coefficients(came: Delivered, folder: Path, tables: dict[str, Any]) -> None:
    """Move coefficient tables to the files, beside the vehicle file, each with a form for its sidecar."""
    vehicle = _own_vehicle(folder, tables)
    found: list[tuple[Path, bytes, dict[str, str], list[str]]] = []
    for path, content in came.daveml.items():
        found.append((vehicle.parent / path.name, content, {}, []))
    for table in list(came.tables):
        columns = coefficient_columns(table)
        if columns is not None:
            came.tables.remove(table)
            content = as_coefficients(table, columns)
            found.append((vehicle.parent / f"{_plain(table.label)}.csv", content, columns, table.notes))
    for place, content, columns, notes in found:
        if place.with_suffix(".toml") == vehicle:  # the sidecar has the table's stem
            place = place.with_stem(f"{place.stem}_coefficients")
        came.files |= {place: content, place.with_suffix(".toml"): sidecar_text(columns)}
        text = came.vehicle.get(vehicle) or (vehicle.read_text(encoding="utf-8-sig") if vehicle.is_file() else "")
        named = named_in_form(text, place.name)
        if named is not None:
            came.vehicle[vehicle] = named
        came.notes += [f"{place}: {words}" for words in (*notes, *how_to_name(place, vehicle, named is not None))]


def _own_vehicle(folder: Path, tables: dict[str, Any]) -> Path:
    """Vehicle file beside which a flight's coefficients belong: the one it names, unless that ships."""
    named = tables.get("vehicle")
    if isinstance(named, str) and named.endswith(".toml"):
        path = vehicle_path(named, folder)
        if path.parent != DATA / "vehicles":
            return path
    return folder / "vehicle" / "vehicle.toml"


def _plain(label: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", label).strip("_") or "table"


def _place(folder: Path, table: LooseTable) -> Path:
    return folder / "telemetry" / f"{_plain(table.label)}.csv"


def _proposals(
    came: Delivered, places: list[Path], folder: Path, tables: dict[str, Any]
) -> tuple[str, list[tuple[LooseTable, list[SourceProposal], list[str]]]]:
    """Text to add to flight.toml, and what to print."""
    taken = _sections(tables)
    added, shown, doubtful = [], [], []
    videos = [*came.videos, *_earlier_videos(folder)]
    cameras = cameras_of(folder, tables)
    for table, place in zip(came.tables, places, strict=True):
        split_clocks(table)
        frames = frame_list(table, videos, cameras, folder)
        reader = Reader(table)
        found, left = reader.everything() if frames is None else ([frames], [])
        if frames is None and reader.may_be_inertial():
            doubtful.append(table.label)
        shown.append((table, found, left))
        for source in found:
            file = place.relative_to(folder).as_posix()
            added.append(section_text(source, file, table.notes, source.section in taken))
            taken.add(source.section)
    said = "".join(added)
    added += [without_list(v, folder) for v in came.videos if v.place.relative_to(folder).as_posix() not in said]
    start = start_text(taken, tables, doubtful)
    return "".join(f"\n{text}" for text in (*added, start) if text), shown


def _earlier_videos(folder: Path) -> list[Video]:
    """Pictures and films that an earlier import brought."""
    telemetry = folder / "telemetry"
    there = sorted(telemetry.iterdir()) if telemetry.is_dir() else []
    return [v for p in there if not p.name.startswith(".") and (v := video_of(p, telemetry)) is not None]


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
            screen.add_column(name, overflow="fold")
        for source in found:
            t = source.time
            if t is not None and source is found[0]:
                unit = t.unit or ("" if t.format != "seconds" else "?")
                screen.add_row(*map(escape, (", ".join(t.columns), f"time, {t.format}", unit, t.how, t.why)))
            for m in source.columns:
                unit = m.unit or ("?" if m.how == ASKED else "")
                screen.add_row(*map(escape, (m.column, f"{source.section} {m.short}", unit, m.how, m.why)))
        if found:
            console.print(screen)
        else:
            words = f"{table.label}: nothing recognised among {', '.join(table.names)}"
            console.print(f"[yellow]{escape(words)}[/]; its columns can be declared in flight.toml by hand")
        for words in (*table.notes, *([f"not used: {', '.join(left)}"] if left and found else [])):
            console.print(f"  {escape(words)}", highlight=False)

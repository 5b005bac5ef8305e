"""Onboard video as it is delivered: a folder of pictures or a film, and the list of when each frame was taken."""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flightmodel.checks import writing
from flightmodel.config import FILL_IN_VALUE
from postflight.intake.clock_columns import find_time
from postflight.intake.loose import LooseTable
from postflight.intake.proposal import STATED, Mapped, SourceProposal
from postflight.intake.words import take_apart

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
FILMS = (".webm", ".mp4", ".avi")
FRAME_WORDS = {"frame", "frames", "frameno", "picture", "image", "bild"}
BELONG = 0.9  # of a list's names, in the folder that it is of


@dataclass(frozen=True)
class Video:
    """A folder of pictures or a film, where it comes from and where it goes; ``names`` are the pictures'."""

    source: Path
    place: Path
    names: tuple[str, ...] = ()

    @property
    def is_film(self) -> bool:
        """Whether it is one file with numbered frames."""
        return not self.names


def video_of(path: Path, telemetry: Path) -> Video | None:
    """Return a folder that holds pictures, or a film; None for anything else."""
    place = telemetry / re.sub(r"[^A-Za-z0-9_.-]+", "_", path.resolve().name)
    if path.is_dir():
        names = sorted(p.name for p in path.iterdir() if p.suffix.lower() in PICTURES and p.is_file())
        return Video(path, place, tuple(names)) if names else None
    return Video(path, place) if path.suffix.lower() in FILMS and path.is_file() else None


def copied(video: Video) -> None:
    """Copy pictures or film beside their place and rename, so that they are whole or not there."""
    video.place.parent.mkdir(parents=True, exist_ok=True)
    partial = video.place.with_name(f".partial-{video.place.name}")
    with writing(video.place, "choose a folder that you may write to"):
        try:
            if video.is_film:
                shutil.copyfile(video.source, partial)
            else:
                partial.mkdir()
                for name in video.names:
                    shutil.copyfile(video.source / name, partial / name)
            partial.replace(video.place)
        finally:
            partial.unlink(missing_ok=True) if video.is_film else shutil.rmtree(partial, ignore_errors=True)


def frame_list(
    table: LooseTable, videos: Iterable[Video], cameras: Iterable[str], folder: Path
) -> SourceProposal | None:
    """Return what a list of frames is for, its column named ``frame``; None where the table is no such list.

    Parameters
    ----------
    table : LooseTable
        Its column of names or numbers is renamed, with a note; folders before a picture's name are taken away.
    videos : iterable of Video
        Folders of pictures and films that the list may be of.
    cameras : iterable of str
        Names of the vehicle's cameras.
    folder : Path
        The flight folder.
    """
    time = find_time(table, [take_apart(n, u) for n, u in zip(table.names, table.units, strict=True)])
    if time is None:
        return None
    used = set(time.columns)
    free = [k for k, name in enumerate(table.names) if name not in used]
    pictures = next((k for k in free if _cells(table, k) and all(_is_picture(c) for c in _cells(table, k)[:20])), None)
    if pictures is None:
        numbers = [k for k in free if _is_frame_number(table, k)]
        if len(free) != 1 or not numbers:  # a counter beside other columns is a recorder's
            return None
    at = pictures if pictures is not None else numbers[0]
    _rename(table, at, bare=pictures is not None)
    names = set(_cells(table, at))
    films = [v for v in videos if v.is_film]
    folders = [v for v in videos if not v.is_film and len(names & set(v.names)) >= BELONG * len(names)]
    key, fitting = ("folder", folders) if pictures is not None else ("film", films)
    there = f'"{fitting[0].place.relative_to(folder).as_posix()}"' if len(fitting) == 1 else f'"{FILL_IN_VALUE}"'
    where = "where the pictures lie" if key == "folder" else "the first frame's number in it is 0"
    mounted = list(cameras)
    camera = f'"{mounted[0]}"' if len(mounted) == 1 else f'"{FILL_IN_VALUE}"'
    which = f"of the vehicle file: {', '.join(mounted)}" if mounted else "a [cameras.NAME] of the vehicle file"
    keys = [
        (key, there, where if len(fitting) == 1 else f"{where}; none, or several, would fit"),
        ("camera", camera, which),
        ("benchmark_s", f'"{FILL_IN_VALUE}"', f"s: when the shell is taken as not bent{_span(table, time)}"),
    ]
    why = "names of pictures" if pictures is not None else "numbers of frames"
    return SourceProposal("frames", [Mapped("frame", "frame", "", STATED, why, canonical=True)], keys, time)


def without_list(video: Video, folder: Path) -> str:
    """Return the comment that stands in flight.toml where no list says when a video's frames were taken."""
    place = video.place.relative_to(folder).as_posix()
    what = "is a film" if video.is_film else f"holds {len(video.names)} pictures"
    frame = "number" if video.is_film else "name"
    key = "film" if video.is_film else "folder"
    return (
        f"# QUESTION: {place} {what}; when was each frame taken? A table t_s, frame (its {frame}) is wanted:\n"
        f'# [frames]\n# file = "telemetry/frames.csv"\n# {key} = "{place}"\n'
        f'# camera = "{FILL_IN_VALUE}"\n# benchmark_s = "{FILL_IN_VALUE}"\n'
    )


def cameras_of(folder: Path, tables: dict[str, Any]) -> list[str]:
    """Names of the cameras in the vehicle file that flight.toml names; none where it cannot be read yet."""
    from flightmodel.vehicle import vehicle_path

    try:
        made = tomllib.loads(vehicle_path(str(tables.get("vehicle", "")), folder).read_text(encoding="utf-8-sig"))
        return list(made.get("cameras", {}))
    except (OSError, ValueError):
        return []


def _cells(table: LooseTable, k: int) -> list[str]:
    return [row[k] for row in table.rows if k < len(row) and row[k]]


def _is_picture(cell: str) -> bool:
    return Path(cell.replace("\\", "/")).suffix.lower() in PICTURES


def _is_frame_number(table: LooseTable, k: int) -> bool:
    values = table.numbers(k)
    named = set(take_apart(table.names[k]).tokens) & FRAME_WORDS
    return bool(named) and bool((np.isfinite(values) & (values >= 0.0) & (values == np.round(values))).all())


def _rename(table: LooseTable, k: int, bare: bool) -> None:
    """Name a column ``frame``, and leave a picture's bare name, each with a note."""
    if bare:
        long = [row for row in table.rows if k < len(row) and re.search(r"[/\\]", row[k])]
        for row in long:
            row[k] = re.split(r"[/\\]", row[k])[-1]
        if long:
            table.notes.append(f"folders before {len(long)} pictures' names were taken away")
            table.raw = None
    if table.names[k] != "frame":
        table.notes.append(f"column '{table.names[k]}' was named frame")
        table.names[k] = "frame"
        table.raw = None


def _span(table: LooseTable, time: Any) -> str:
    if time.format != "seconds":
        return ""
    known = table.numbers(table.names.index(time.columns[0]))
    return f"; the list goes from {np.nanmin(known):g} to {np.nanmax(known):g}"

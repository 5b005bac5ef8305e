"""How are the numbers of a large, well-formed CSV read in a fraction of a second? By a library, some lines at a time.

pyarrow's reader takes the file in pieces of whole lines; where it is not installed, pandas' C reader does. Columns that
are not asked for are not converted. If a file is not plain (quotes, text in place of a number, a row of another length,
a name that stands twice, a blank line between rows), nothing is returned: the careful reader of `flightmodel.tables`
then reads the file as text and reports what is wrong and where. Both libraries round each number correctly, so a file
that both readers accept gives the same bits in either.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
from collections.abc import Callable, Mapping
from csv import QUOTE_NONE
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.files import open_file
from flightmodel.tables import TimeColumn, clock_times, column_names

SMALLEST_BYTES = 512 * 1024  # below it the careful reader is as quick as loading the library
PIECE_BYTES = 8 * 1024**2
MISSING = ["-", "nan", "NaN", "NAN", "na", "NA", "null", "Null", "NULL", *(n * " " for n in range(40))]
# quotes, binary data, and characters at which text has more lines than bytes have
ODD = (b'"', b"\0", b"\v", b"\f", b"\x1c", b"\x1d", b"\x1e")


@dataclass(frozen=True)
class Numbers:
    """What one reading asked for: times and columns as the file has them, the first row's line, the file's SHA-256."""

    time: FloatArray | None
    columns: dict[str, FloatArray]
    first_line: int
    sha256: str


@dataclass(frozen=True)
class _Layout:
    """All columns of a file, those that are read as numbers, and one that is read as text."""

    names: list[str]
    numbers: list[str]
    text: str | None


def read_numbers(
    path: Path,
    wanted: Mapping[str, bool],
    time: TimeColumn | None = None,
    t0: datetime | None = None,
    tell: Callable[[int], None] = lambda _bytes: None,
) -> Numbers | None:
    """Read columns of numbers; None where the careful reader must have a look.

    Parameters
    ----------
    path : Path
    wanted : mapping
        Names of columns, and whether each must be there.
    time : TimeColumn, optional
        Column of times; those of a clock become seconds after ``t0``.
    t0 : datetime, optional
    tell : callable, optional
        Is called with the number of bytes read since its last call.
    """
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size < SMALLEST_BYTES:
                return None
            names, first_line = _header(file)
            layout = _layout(names, wanted, time)
            begin = file.tell()
            file.seek(0)
            digest = hashlib.sha256(file.read(begin))
            parts: dict[str, list[FloatArray]] = {}
            while piece := file.read(PIECE_BYTES) + file.readline():
                digest.update(piece)
                tell(len(piece))
                rows = piece if file.tell() < size else piece.rstrip() + b"\n"
                values, cells = _parse(rows, layout)
                if cells and time is not None and t0 is not None:
                    values[time.column] = clock_times([cell.strip() for cell in cells], time.format, t0)
                for name, column in values.items():
                    parts.setdefault(name, []).append(column)
    except (OSError, ValueError):
        return None
    columns = {name: np.concatenate(parts.pop(name)) for name in [*parts]}
    times = None if time is None else columns[time.column]
    if layout.text is not None and not np.isfinite(columns.pop(layout.text)).all():
        return None
    if len(columns[layout.numbers[0]]) < 2:
        return None
    return Numbers(times, columns, first_line, digest.hexdigest())


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _header(file: BinaryIO) -> tuple[list[str], int]:
    """Names of the columns and the line of the first row, before which the file then stands."""
    for line, content in enumerate(iter(file.readline, b""), start=1):
        text = content.decode("utf-8-sig" if line == 1 else "utf-8")
        if len(text.splitlines()) != 1 or "\0" in text or text.count('"') % 2:
            raise ValueError("not a plain header")
        if text.strip():
            return column_names(text.splitlines()[0]), line + 1
    raise ValueError("no header")


def _layout(names: list[str], wanted: Mapping[str, bool], time: TimeColumn | None) -> _Layout:
    text = time.column if time is not None and time.format != "seconds" else None
    numbers = set(wanted) | ({time.column} if time is not None and text is None else set())
    needed = {name for name, must in wanted.items() if must} | ({time.column} if time is not None else set())
    layout = _Layout(names, [name for name in names if name in numbers], text)
    if len(set(names)) < len(names) or not needed <= set(names):
        raise ValueError("not the header of a plain table")
    if not layout.numbers or text in numbers:
        raise ValueError("nothing to read, or one column to be read as numbers and as text")
    return layout


def _parse(rows: bytes, layout: _Layout) -> tuple[dict[str, FloatArray], list[str]]:
    """Numbers of some rows by column, and the cells of the column of text; ValueError where anything is unusual."""
    if not rows.isascii() or any(mark in rows for mark in ODD) or rows.count(b"\r") != rows.count(b"\r\n"):
        raise ValueError("not plain rows")
    try:
        from pyarrow import BufferReader, csv, float64, string
    except ImportError:
        return _parse_by_pandas(rows, layout)
    types = dict.fromkeys(layout.numbers, float64()) | ({layout.text: string()} if layout.text else {})
    table = csv.read_csv(
        BufferReader(rows),
        csv.ReadOptions(column_names=layout.names),
        csv.ParseOptions(quote_char=False),
        csv.ConvertOptions(column_types=types, include_columns=[*types], null_values=MISSING),
    )
    values = {name: table[name].to_numpy() + 0.0 for name in layout.numbers}  # no negative zero, as of whole numbers
    if len(table) != rows.count(b"\n"):
        raise ValueError("a blank line")
    # the library takes "inf", "-nan" and numbers beyond all bounds
    if any(np.isfinite(column).sum() + table[name].null_count < len(column) for name, column in values.items()):
        raise ValueError("no finite number")
    return values, table[layout.text].to_pylist() if layout.text else []


def _parse_by_pandas(rows: bytes, layout: _Layout) -> tuple[dict[str, FloatArray], list[str]]:
    import pandas as pd

    marks = np.frombuffer(rows, np.uint8)
    marks = marks[(marks == ord(",")) | (marks == ord("\n"))]
    ends = marks.reshape(-1, len(layout.names)) == ord("\n")  # ValueError where a row has another length
    if ends[:, :-1].any() or not ends[:, -1].all() or re.search(rb"[-+]nan", rows, re.IGNORECASE):
        raise ValueError("not plain rows")
    types = dict.fromkeys(layout.numbers, np.float64) | ({layout.text: str} if layout.text else {})
    frame = pd.read_csv(
        io.BytesIO(rows), header=None, names=layout.names, index_col=False, dtype=types, usecols=[*types],
        keep_default_na=False, na_values=dict.fromkeys(layout.numbers, MISSING),
        quoting=QUOTE_NONE, skipinitialspace=True,
    )  # fmt: skip
    values = {name: frame[name].to_numpy() + 0.0 for name in layout.numbers}
    if len(frame) != len(ends) or any(np.isinf(column).any() for column in values.values()):
        raise ValueError("no finite number")
    return values, frame[layout.text].tolist() if layout.text else []

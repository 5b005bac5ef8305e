"""How is a text table of unknown layout read?

Any delimiter, comments, a preface, a row of units, decimal commas, old encodings, columns between dashed rules. The
table is where most columns stand: names, then three rows of numbers of the same count. Files of programs (spreadsheets,
MATLAB, NetCDF, Parquet): `postflight.intake.stored_tables`.

Nothing is dropped or changed without a note. What comes out are text cells that `flightmodel.tables.read_table` reads
once they are written as plain CSV.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from flightmodel.checks import FloatArray, GateError
from flightmodel.files import UnfitFile, file_bytes, nothing_at
from flightmodel.tables import plain_number
from postflight.intake.headers import SEVERAL_MEANINGS, UNIT_SPELLINGS, unit_key

_LARGEST = 1e100  # what is beyond is a broken word
_HEAD_LINES = 80  # names and first rows are within
_COMMENT = re.compile(r"^\s*(#+|%+|//+|\*+|;|!|\")\s*")
_NUMBER = re.compile(r"^[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?$")
_COMMA_NUMBER = re.compile(r"^[+-]?\d+,\d+([eE][+-]?\d+)?$")
_CLOCK = re.compile(r"^(\d{1,3}[:/])?\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?$|^\d{4}-\d{2}-\d{2}[T ]")
_DELIMITERS = ("\t", ";", ",", "|", None)  # None: runs of spaces
_MISSING = {"", "nan", "na", "n/a", "null", "-", "--", "---", "none"}
LEAST_ROWS = 3


@dataclass
class FreeFormTable:
    """A table of text cells.

    Parameters
    ----------
    label : str
        The file's stem, with the structure's name for MATLAB.
    names, units : list of str
        Of the columns; units as a row below the header gives them, empty for none.
    rows : list of list of str
    notes : list of str
        What was changed or left out.
    raw : bytes or None
        The file's content where it is plain CSV already.
    """

    label: str
    names: list[str]
    units: list[str]
    rows: list[list[str]]
    notes: list[str] = field(default_factory=list)
    raw: bytes | None = None

    def numbers(self, column: int) -> FloatArray:
        """Return a column (n,) as float64, NaN for cells that are not numbers."""
        cells = (row[column] if column < len(row) else "" for row in self.rows)
        out = np.array([plain_number(cell) for cell in cells], dtype=float)
        return np.where(np.abs(out) < _LARGEST, out, np.nan)

    def cells(self, column: int, rows: int | None = None) -> list[str]:
        """Return a column's non-empty cells among the first ``rows``."""
        return [row[column] for row in self.rows[:rows] if column < len(row) and row[column]]

    def as_csv(self) -> bytes:
        """Return the plain CSV that is written."""
        if self.raw is not None:
            return self.raw
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.names)
        writer.writerows(self.rows)
        return out.getvalue().encode()


@contextmanager
def refusing_unfit(path: Path) -> Iterator[None]:
    """Turn errors on opening a file into a `GateError`: it is missing, too large, or not a file."""
    try:
        yield
    except FileNotFoundError:
        raise GateError(f"{path}: {nothing_at(path)}", code="file-missing") from None
    except UnfitFile as fault:
        raise GateError(f"{path}: {fault.strerror}", fault.code) from None


def read_text_table(path: Path) -> FreeFormTable:
    """Read one text table.

    Raises
    ------
    GateError
        ``file-unreadable`` where no names above three rows of numbers are found, ``file-too-large``,
        ``file-unreadable``, or ``file-missing``.
    """
    with refusing_unfit(path):
        raw = file_bytes(path)
    text, notes = _decoded(path, raw)
    table = table_of_lines([line for line in text.splitlines() if line.strip()], path.stem, str(path), notes)
    plain = not table.notes and all(len(r) == len(table.names) for r in table.rows)
    return replace(table, raw=raw) if plain else table


def table_of_lines(lines: list[str], label: str, where: str, notes: list[str]) -> FreeFormTable:
    """Find the table in lines of text, none of them empty.

    Parameters
    ----------
    lines : list of str
    label : str
        Of the table.
    where : str
        What a refusal names.
    notes : list of str
        What was changed already.

    Raises
    ------
    GateError
        ``file-unreadable`` where no names above three rows of numbers are found.
    """
    ruled = _ruled(label, lines)
    if ruled is not None:
        ruled.notes[:0] = notes
        return ruled
    found = _layout(lines[:_HEAD_LINES])
    if found is None:
        words = "no table found: a line of names, three rows of numbers below it and one delimiter are wanted"
        raise GateError(f"{where}: {words}", code="file-unreadable")
    delimiter, first, header, unit_row = found
    names = [n.strip() for n in header]
    units = [u.strip() for u in unit_row] if unit_row else [""] * len(names)
    rows = [_split(line, delimiter) for line in lines[first:] if not _is_comment(line, delimiter)]
    if len(rows) > 3 and len(rows[-1]) < len(names) and all(len(row) >= len(names) for row in rows[:-1]):
        notes.append(f"the last line is cut short ({len(rows[-1])} of {len(names)} cells) and left out")
        lines, rows = lines[:-1], rows[:-1]
    if delimiter != ",":
        notes.append(f"delimiter {'spaces' if delimiter is None else repr(delimiter)} became a comma")
    if delimiter != "," and _decimal_comma(rows[:_HEAD_LINES]):
        rows = [[c.replace(",", ".") if _COMMA_NUMBER.match(c) else c for c in row] for row in rows]
        notes.append("decimal commas became points")
    if unit_row:
        notes.append("the row of units below the names was taken out")
    skipped = len(lines) - len(rows) - 1 - bool(unit_row)
    if skipped:
        notes.append(f"{skipped} lines of comment or preface left out")
    for k, name in enumerate(names):
        if not name or names.index(name) != k:
            names[k] = f"{name or 'column'}_{k + 1}"
            was = f"was named '{name}' like another" if name else "had no name"
            notes.append(f"column {k + 1} {was}: now '{names[k]}'")
    return FreeFormTable(label, names, units, rows, notes)


def _ruled(label: str, lines: list[str]) -> FreeFormTable | None:
    """Read a table of right-aligned columns between dashed rules (as the University of Wyoming lists soundings).

    Empty cells are blanks there: a cell ends below the end of its name.
    """
    rules = [k for k, line in enumerate(lines[:_HEAD_LINES]) if re.fullmatch(r"\s*-{10,}\s*", line)]
    for top, bottom in pairwise(rules):
        if bottom - top not in (2, 3):
            continue
        ends = [m.end() for m in re.finditer(r"\S+", lines[top + 1])]
        names = lines[top + 1].split()
        units = _columns_below(lines[top + 2], ends) if bottom - top == 3 else [""] * len(names)
        rows = []
        for line in lines[bottom + 1 :]:
            cells = _columns_below(line, ends)
            if not _NUMBER.match(cells[0]):
                break
            rows.append(cells)
        if len(rows) >= LEAST_ROWS:
            note = f"columns between rules became CSV; {len(lines) - len(rows)} lines of names, units and text left out"
            return FreeFormTable(label, names, units, rows, [note])
    return None


def _columns_below(line: str, ends: list[int]) -> list[str]:
    """Cells of a line, each ending where a name ends; the last takes the rest."""
    starts = [0, *ends[:-1]]
    return [line[a:b].strip() for a, b in zip(starts, [*ends[:-1], len(line) + 1], strict=True)]


def _decoded(path: Path, raw: bytes) -> tuple[str, list[str]]:
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace"), ["UTF-16 became UTF-8"]
    if b"\0" in raw[:65536]:
        raise GateError(f"{path}: binary data where a text table is wanted", code="file-unreadable")
    try:
        return raw.decode("utf-8-sig"), []
    except UnicodeDecodeError:
        return raw.decode("latin-1"), ["read as Latin-1 (it is no UTF-8)"]


def _is_comment(line: str, delimiter: str | None) -> bool:
    """Whether a line is a comment; with semicolons as delimiters, an empty first cell does not make one."""
    return bool(_COMMENT.match(line)) and not (delimiter == ";" and line.lstrip().startswith(";"))


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    if '"' in line:
        return [c.strip() for c in next(csv.reader([line], delimiter=delimiter))]
    return [c.strip() for c in line.split(delimiter)]


def _is_data(cells: list[str]) -> bool:
    known = [c for c in cells if c.lower() not in _MISSING]
    good = sum(1 for c in known if _NUMBER.match(c) or _COMMA_NUMBER.match(c) or _CLOCK.match(c))
    return len(cells) >= 2 and bool(known) and good >= max(1, 0.5 * len(known))


def _layout(lines: list[str]) -> tuple[str | None, int, list[str], list[str]] | None:
    """Delimiter, first line of data, names and row of units (empty for none) of the widest table of numbers."""
    best = None
    for delimiter in _DELIMITERS:
        cut = [_split(line, delimiter) for line in lines]
        for first in range(1, len(lines) - 2):
            three = cut[first : first + 3]
            if len({len(c) for c in three}) > 1 or not all(map(_is_data, three)):
                continue
            if any(_is_comment(line, delimiter) for line in lines[first : first + 3]):
                continue
            named = _names_above(lines, cut, first, delimiter)
            if named and (best is None or len(three[0]) > len(best[2])):
                best = (delimiter, first, *named)
            break
    return best


def _names_above(
    lines: list[str], cut: list[list[str]], first: int, delimiter: str | None
) -> tuple[list[str], list[str]] | None:
    """Names and units above a first row of numbers; None where there are no names."""
    count = len(cut[first])
    units: list[str] = []
    for k in range(first - 1, max(-1, first - 6), -1):
        cells = cut[k]
        if len(cells) != count or _is_comment(lines[k], delimiter):
            cells = _split(_COMMENT.sub("", lines[k]), delimiter)
        if len(cells) != count:
            continue
        if not units and _are_units(cells):
            units = cells
            continue
        if any(re.search("[A-Za-z]", c) for c in cells) and not _is_data(cells):
            return cells, units
    return None


def _are_units(cells: list[str]) -> bool:
    known = [c for c in cells if c.strip("()[]{}<>- ")]
    fitting = sum(
        1 for c in known if unit_key(c) in UNIT_SPELLINGS or unit_key(c) in SEVERAL_MEANINGS or _CLOCK.match(c)
    )
    formats = sum(1 for c in known if re.match(r"^(DDD|hh|HH)?:?[hH:mMsS.]+$", c))
    return bool(known) and fitting + formats >= 0.6 * len(known) and not any(len(c) > 24 for c in known) and fitting > 0


def _decimal_comma(rows: list[list[str]]) -> bool:
    cells = [c for row in rows for c in row]
    return any(_COMMA_NUMBER.match(c) for c in cells) and not any(_NUMBER.match(c) and "." in c for c in cells)

"""How is a table in a binary format read? Spreadsheets, Parquet, NetCDF and HDF5, MATLAB files; text otherwise.

What a file is, its first bytes say. Only numbers, times and texts are read, no objects, no formulas, no macros.

- xlsx: every sheet with names above three rows of numbers, a row of units between allowed; values as they were computed
  last.
- Parquet: columns, with the unit in their field's metadata (``unit`` or ``units``).
- NetCDF (classic by scipy; version 4, and HDF5 in general, by h5py): variables along one dimension beside each other,
  ``units``, scale, offset and fill value by the conventions; ``seconds since ...`` becomes UTC.
- MATLAB: version 5 to 7 by scipy, 7.3 (HDF5) by h5py. Vectors of one length beside each other (at the top, or in one
  structure) are a table, a matrix with as many rows gives a column for each of its own. Units stand in a field
  ``units``: a structure by name, or a list in the columns' order, whose names a list ``names`` may give; or each
  channel is a structure of ``data``, ``units`` and perhaps ``time``.

Each library but scipy is optional, and what is missing is named with the extra that brings it. What is left out of a
file is noted. A damaged file can keep a compiled library busy without end, deaf to Ctrl-C, or crash it: a process of
its own reads HDF5, MATLAB and Parquet through first.
"""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime, time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import ConfigError, FloatArray, GateError
from flightmodel.files import TABLE_BYTES, open_file
from postflight.intake.freeform_tables import (
    LEAST_ROWS,
    FreeFormTable,
    read_text_table,
    refusing_unfit,
    table_of_lines,
)

_MOST_NUMBERS = 200_000_000  # of a file
_HDF5 = b"\x89HDF\r\n\x1a\n"
EXTRAS = {"openpyxl": "excel", "pyarrow": "parquet", "h5py": "matlab"}
_ERRORS = {"#DIV/0!", "#N/A", "#NAME?", "#NULL!", "#NUM!", "#REF!", "#VALUE!"}  # of a spreadsheet: no value there
_UNITS, _NAMES = ("units", "unit"), ("names", "columns", "channels", "labels", "variables")
_DATA, _TIMES = ("data", "value", "values", "signal"), ("time", "t")
_SINCE = re.compile(r"^\s*(\w+)\s+since\s+(\S+(?:\s+[\d:.]+)?)(?:\s*(?:Z|UTC|\+?0+(?::0+)?))?\s*$", re.IGNORECASE)
# seconds that another process may take to read a file through, and bytes for one more: some hundred times what it needs
_READ_S, _READ_BYTES_PER_S = 20.0, 1e6
_READ_THROUGH = {
    "HDF5": f"""
import h5py, sys

def read(name, item):
    if isinstance(item, h5py.Dataset) and item.size is not None and item.size <= {_MOST_NUMBERS}:
        item[()], dict(item.attrs)

with h5py.File(sys.argv[1], "r") as file:
    file.visititems(read)
""",
    "MATLAB": f"""
import math, scipy.io, sys

if sum(math.prod(shape) for _, shape, _ in scipy.io.whosmat(sys.argv[1])) <= {_MOST_NUMBERS}:
    scipy.io.loadmat(sys.argv[1], chars_as_strings=True)
""",
    "Parquet": f"""
import pyarrow.parquet, sys

file = pyarrow.parquet.ParquetFile(sys.argv[1])
if file.metadata.num_rows * file.metadata.num_columns <= {_MOST_NUMBERS}:
    file.read()
""",
}
_STEP_S = {
    word: step_s
    for step_s, words in (
        (86400.0, "d day days"), (3600.0, "h hr hour hours"), (60.0, "min minute minutes"),
        (1.0, "s sec second seconds"), (1e-3, "ms msec millisecond milliseconds"),
        (1e-6, "us microsecond microseconds"),
    )
    for word in words.split()
}  # fmt: skip
_PACKED = {"scale_factor": 1.0, "add_offset": 0.0}  # and what they are where they are not stated
_CALENDARS = {"", "standard", "gregorian", "proleptic_gregorian"}
Column = tuple[str, str, NDArray[Any]]  # name, unit, values (n,): numbers or texts
Tree = dict[str, Any]  # names: arrays, texts, lists of texts, trees; None for what is none of these


def read_tables(path: Path) -> list[FreeFormTable]:
    """Read every table of a file.

    Raises
    ------
    GateError
        ``file-missing``, ``file-unreadable``, ``file-too-large``, ``file-unreadable`` (``file-unreadable``),
        ``file-unreadable``, and what `read_text_table` refuses.
    ConfigError
        ``package-missing`` (``package-missing`` for MATLAB) with the command that installs the library.
    """
    with refusing_unfit(path), open_file(path) as file:
        head = file.read(1024)  # MATLAB 7.3 has HDF5's mark behind a preface of 512
    if path.suffix.lower() == ".mat":
        version = _version_73 if b"MATLAB 7.3" in head or _HDF5 in head else _version_5
        return _guarded(path, lambda path: _matlab(path, version(path)), "file-unreadable", "package-missing")
    if head.startswith(b"\xd0\xcf\x11\xe0"):
        words = "a spreadsheet in the format of before 2007; save it as .xlsx or CSV"
        raise GateError(f"{path}: {words}", code="file-unreadable")
    if head.startswith(b"PK\x03\x04") and _is_workbook(path):
        return _guarded(path, _workbook)
    if head.startswith(b"PAR1"):
        return _guarded(path, _parquet)
    if head.startswith(b"CDF"):
        if head[3:4] not in (b"\x01", b"\x02"):  # versions that scipy reads
            raise GateError(f"{path}: NetCDF in 64-bit data format; store it as version 4", code="file-unreadable")
        return _guarded(path, _netcdf_classic)
    if _HDF5 in head:
        return _guarded(path, _netcdf_4)
    return [read_text_table(path)]


def _guarded(
    path: Path,
    read: Callable[[Path], list[FreeFormTable]],
    unreadable: str = "file-unreadable",
    missing: str = "package-missing",
) -> list[FreeFormTable]:
    """Tables of a file; any error of a library on a damaged file becomes a refusal with the code ``unreadable``."""
    try:
        tables = read(path)
    except GateError:
        raise
    except ImportError as fault:
        raise ConfigError(f"{path}: {missing_library(fault)}, or store it as CSV", code=missing) from None
    except Exception as fault:  # each library has its own
        words = f"cannot be read ({type(fault).__name__}: {fault}); store it again, or as CSV"
        raise GateError(f"{path}: {words}", code=unreadable) from None
    if not tables:
        words = f"no table found: two columns of numbers of one length, {LEAST_ROWS} rows at least, are wanted"
        raise GateError(f"{path}: {words}", code="file-unreadable")
    return tables


def missing_library(fault: ImportError) -> str:
    """Command that installs the missing optional library, in words; any other import error is raised again."""
    name = (fault.name or "").partition(".")[0]
    if name not in EXTRAS:
        raise fault
    return f"needs {name}, which is not installed: pip install 'postflight[{EXTRAS[name]}]'"


def _check_readable(path: Path, kind: str) -> None:
    """Refuse a file that hangs or crashes the library of its kind."""
    limit_s = _READ_S + path.stat().st_size / _READ_BYTES_PER_S
    command = [sys.executable, "-c", _READ_THROUGH[kind], str(path)]
    try:
        status = subprocess.run(command, capture_output=True, timeout=limit_s, check=False).returncode
        fate = f"dies of it (signal {-status})"
    except subprocess.TimeoutExpired:
        status, fate = -1, f"does not come to its end in {limit_s:.0f} s"
    if status < 0:  # what a library says of a damaged file is its reader's to report
        words = (
            f"a damaged file: the library for {kind} {fate}; compare its checksum with the sender's, or have it as CSV"
        )
        raise GateError(f"{path}: {words}", code="file-unreadable")


def _check_size(path: Path, numbers: int) -> None:
    if numbers > _MOST_NUMBERS:
        raise GateError(f"{path}: more than {_MOST_NUMBERS} numbers; split it", code="file-too-large")


def _cells(values: NDArray[Any]) -> list[str]:
    """Cell texts of a column (n,): numbers at full precision, empty for NaN, times as ISO UTC."""
    if values.dtype.kind == "M":
        return ["" if np.isnat(v) else f"{np.datetime64(v, 'us')}Z" for v in values]
    if values.dtype.kind in "iub":
        return [str(int(v)) for v in values]
    if values.dtype.kind == "f":
        return [repr(float(v)) if np.isfinite(v) else "" for v in values]
    return ["" if v is None else " ".join(str(v).split()) for v in values]


def _table(label: str, columns: list[Column], notes: list[str], left_out: Iterable[str]) -> FreeFormTable:
    """Table of columns; the names of what was left out are noted."""
    rows = [list(row) for row in zip(*(_cells(values) for _, _, values in columns), strict=True)]
    listed = sorted(set(left_out))
    more = f" and {len(listed) - 8} more" if len(listed) > 8 else ""
    notes = notes + ([f"left out, as no columns of numbers: {', '.join(listed[:8])}{more}"] if listed else [])
    return FreeFormTable(label, [name for name, _, _ in columns], [unit for _, unit, _ in columns], rows, notes)


# spreadsheets


def _is_workbook(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return "xl/workbook.xml" in archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError):  # cut, or of a version of its own
        return path.suffix.lower() in (".xlsx", ".xlsm")


def _workbook(path: Path) -> list[FreeFormTable]:
    import openpyxl

    with zipfile.ZipFile(path) as archive:
        if sum(part.file_size for part in archive.infolist()) > TABLE_BYTES:
            raise GateError(f"{path}: unpacks to more than {TABLE_BYTES} bytes; split it", code="file-too-large")
    book = openpyxl.load_workbook(path, read_only=True, data_only=True, keep_links=False)
    tables, without = [], []
    try:
        for sheet in book.worksheets:
            lines, dated = _sheet_lines(sheet)
            label = path.stem if len(book.worksheets) == 1 else f"{path.stem}_{sheet.title}"
            try:
                found = table_of_lines(lines, label, f"{path}, sheet {sheet.title}", [])
            except GateError:
                without.append(sheet.title)
                continue
            notes = ["cells of a spreadsheet became CSV", *(["dates were taken as UTC"] if dated else [])]
            found.notes[:] = notes + [note for note in found.notes if not note.startswith("delimiter")]
            tables.append(found)
    finally:
        book.close()
    for table in tables if without else ():
        table.notes.append(f"sheets without a table left out: {', '.join(without)}")
    return tables


def _sheet_lines(sheet: Any) -> tuple[list[str], bool]:
    """Rows of a sheet as lines of cells with tabs between, columns that are empty left out; whether dates are there."""
    sheet.reset_dimensions()  # what a file states of them may be wrong
    rows = [[_cell_text(value) for value in row] for row in sheet.iter_rows(values_only=True)]
    width = max(map(len, rows), default=0)
    rows = [row + [""] * (width - len(row)) for row in rows if any(row)]
    used = [k for k in range(width) if any(row[k] for row in rows)]
    dated = any(re.match(r"\d{4}-\d\d-\d\dT", row[k]) for row in rows for k in used)
    return ["\t".join(row[k] for k in used) for row in rows], dated


def _cell_text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime):
        return f"{value.isoformat()}Z"
    if isinstance(value, time):
        return value.isoformat()
    if isinstance(value, float):
        return repr(value)
    text = " ".join(str(value).split())
    return "" if text in _ERRORS else text


# Parquet


def _parquet(path: Path) -> list[FreeFormTable]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    _check_readable(path, "Parquet")
    file = pq.ParquetFile(path)
    _check_size(path, file.metadata.num_rows * file.metadata.num_columns)
    columns: list[Column] = []
    left_out = []
    for field, values in zip(file.schema_arrow, file.read().columns, strict=True):
        kind, about = field.type, {k.lower(): v for k, v in (field.metadata or {}).items()}
        if pa.types.is_decimal(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind):
            values = values.cast(pa.float64() if values.null_count or not pa.types.is_integer(kind) else kind)
        elif pa.types.is_dictionary(kind):
            values = values.cast(kind.value_type)
        elif not (pa.types.is_floating(kind) or pa.types.is_timestamp(kind) or pa.types.is_string(kind)):
            left_out.append(field.name)
            continue
        unit = about.get(b"unit") or about.get(b"units") or b""
        columns.append((field.name, unit.decode("utf-8", "replace"), values.to_numpy()))
    if len(columns) < 2 or file.metadata.num_rows < LEAST_ROWS:
        return []
    return [_table(path.stem, columns, ["Parquet became CSV"], left_out)]


# NetCDF and HDF5


def _netcdf_classic(path: Path) -> list[FreeFormTable]:
    from scipy.io import netcdf_file

    found: list[tuple[str, str, str, NDArray[Any], dict[str, Any]]] = []
    left_out = []
    with netcdf_file(path, "r", mmap=False) as file:
        for name, variable in file.variables.items():
            if len(variable.dimensions) == 1 and variable.data.dtype.kind in "fiu":
                values = variable.data.astype(variable.data.dtype.newbyteorder("="))
                found.append(("", variable.dimensions[0], name, values, dict(variable._attributes)))
            else:
                left_out.append(name)
    return _by_dimension(path, found, left_out)


def _netcdf_4(path: Path) -> list[FreeFormTable]:
    import h5py

    _check_readable(path, "HDF5")
    found: list[tuple[str, str, str, NDArray[Any], dict[str, Any]]] = []
    left_out = []

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        parent, _, own = name.rpartition("/")
        if item.dtype.kind not in "fiu" or item.ndim != 1 or item.attrs.get("NAME", b"")[:17] == b"This is a netCDF ":
            left_out.append(own)
            return
        _check_size(path, item.size)
        scale = item.name if item.is_scale else item.dims[0][0].name if len(item.dims[0]) else str(item.size)
        found.append((parent.replace("/", "_"), str(scale), own, item[()], dict(item.attrs)))

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return _by_dimension(path, found, left_out)


def _by_dimension(
    path: Path, found: list[tuple[str, str, str, NDArray[Any], dict[str, Any]]], left_out: list[str]
) -> list[FreeFormTable]:
    """One table a group and dimension: variables are (group, dimension, name, values, attributes)."""
    groups: dict[tuple[str, str], list[Column]] = {}
    notes = ["NetCDF or HDF5 became CSV"]
    for parent, dimension, name, values, attributes in found:
        unit = _attribute(attributes, "units")
        values, changed = _unpacked(values, attributes)
        if changed:
            notes.append(f"'{name}' was stored packed: scale, offset or fill value are applied")
        since = _SINCE.match(unit)
        if since is not None and _attribute(attributes, "calendar").lower() in _CALENDARS:
            stamps = _since(values, since[1].lower(), since[2])
            if stamps is not None:
                notes.append(f"'{name}', {unit}, became ISO UTC")
                values, unit = stamps, ""
        groups.setdefault((parent, dimension), []).append((name, unit, values))
    whole = {key: columns for key, columns in groups.items() if len(columns) >= 2 and len(columns[0][2]) >= LEAST_ROWS}
    left_out += [name for key, columns in groups.items() if key not in whole for name, _, _ in columns]
    tables = []
    for (parent, dimension), columns in whole.items():
        several = "" if len(whole) == 1 or parent else dimension.rpartition("/")[2]
        label = "_".join(filter(None, [path.stem, parent, several]))
        tables.append(_table(label, columns, notes, left_out))
    return tables


def _attribute(attributes: dict[str, Any], name: str) -> str:
    value = attributes.get(name, "")
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    return str(value).strip()


def _unpacked(values: NDArray[Any], attributes: dict[str, Any]) -> tuple[NDArray[Any], bool]:
    """Values (n,) with the conventions' fill value, scale and offset applied, and whether that changed anything."""
    packed = {name: float(np.ravel(attributes[name])[0]) for name in _PACKED if name in attributes}
    gaps = [np.ravel(attributes[name]) for name in ("_FillValue", "missing_value") if name in attributes]
    missing = np.isin(values, np.concatenate(gaps)) if gaps else np.zeros(len(values), dtype=bool)
    if not packed and not missing.any():
        return values, False
    scale, offset = (packed.get(name, usual) for name, usual in _PACKED.items())
    return np.where(missing, np.nan, values * scale + offset), True


def _since(values: NDArray[Any], step: str, epoch: str) -> NDArray[Any] | None:
    """Times (n,) of ``seconds since 2009-08-17 12:52:00``; None where step or epoch cannot be read."""
    try:
        start = np.datetime64(epoch.strip().rstrip("Z").replace(" ", "T"), "us")
        microseconds = np.asarray(values, dtype=float) * _STEP_S[step] * 1e6
    except (ValueError, KeyError):
        return None
    known = np.isfinite(microseconds)
    out = np.full(len(values), np.datetime64("NaT", "us"))
    out[known] = start + np.round(microseconds[known]).astype("timedelta64[us]")
    return out


# MATLAB


def _matlab(path: Path, tree: Tree) -> list[FreeFormTable]:
    """Tables of a MATLAB file of any version."""
    left_out: list[str] = []
    groups: dict[tuple[str, int, bytes], list[Column]] = {}
    for parent, clock, column in _columns(tree, "", left_out):
        stamp = b"" if clock is None else clock.tobytes()
        key = parent, len(column[2]), stamp
        if key not in groups:
            groups[key] = [] if clock is None else [("time", "", clock)]
        groups[key].append(column)
    tables = []
    for k, ((parent, _, _), columns) in enumerate(g for g in groups.items() if len(g[1]) >= 2):
        several = sum(1 for own, columns in groups.items() if own[0] == parent and len(columns) >= 2) > 1
        label = "_".join(filter(None, [path.stem, parent]))
        label += f"_{columns[1][0]}" if parent and several else f"_{k + 1}" if not parent and k else ""
        tables.append(_table(label, columns, ["MATLAB numbers became CSV"], left_out))
    if not tables:
        words = f"no two columns of numbers of one length; left out: {', '.join(left_out) or 'nothing'}"
        raise GateError(f"{path}: {words}", code="file-unreadable")
    return tables


def _columns(tree: Tree, parent: str, left_out: list[str]) -> Iterator[tuple[str, FloatArray | None, Column]]:
    """Columns of a structure and its substructures: name of the structure, the column's own times, the column."""
    units, names = _first(tree, _UNITS), _first(tree, _NAMES)
    own = {k: v for k, v in tree.items() if v is not units and v is not names}
    vectors = [name for name, value in own.items() if _is_vector(value)]
    if isinstance(units, str) or (isinstance(units, list) and len(units) not in (len(vectors), len(names or ()))):
        left_out.append("units")  # of which column is not said
    for name, value in own.items():
        if isinstance(value, dict):
            data, clock = _first(value, _DATA), _first(value, _TIMES)
            others = [one for one in value.values() if _is_vector(one) and one is not data and one is not clock]
            if not _is_vector(data) or others:
                yield from _columns(value, "_".join(filter(None, [parent, name])), left_out)
                continue
            clock = clock.ravel() if _is_vector(clock) and clock.size == max(data.shape) else None
            for column in _split(name, data, _first(value, _UNITS), _first(value, _NAMES), left_out):
                yield parent, clock, column
        elif isinstance(value, np.ndarray):
            unit = units.get(name) if isinstance(units, dict) else None
            if isinstance(units, list) and len(units) == len(vectors):
                unit = units[vectors.index(name)]
            elif isinstance(units, list) and isinstance(names, list) and len(units) == len(names):
                unit = units
            for column in _split(name, value, unit, names, left_out):
                yield parent, None, column
        else:
            left_out.append(name)


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and max(value.shape) >= LEAST_ROWS


def _first(tree: Tree, names: tuple[str, ...]) -> Any:
    return next((value for name, value in tree.items() if name.lower() in names), None)


def _split(name: str, values: NDArray[Any], unit: Any, names: Any, left_out: list[str]) -> list[Column]:
    """Columns of a vector, or of a matrix, which ``names`` and a list of units may name one by one."""
    rows = max(values.shape)
    if values.ndim != 2 or rows < LEAST_ROWS:
        left_out.append(name)
        return []
    block = values if values.shape[0] == rows else values.T
    count = block.shape[1]
    called = [name] if count == 1 else [f"{name}_{k + 1}" for k in range(count)]
    if count > 1 and isinstance(names, list) and len(names) == count:
        called = names
    stated = unit if isinstance(unit, list) and len(unit) == count else [unit if isinstance(unit, str) else ""] * count
    return [(called[k], stated[k], block[:, k]) for k in range(count)]


def _version_5(path: Path) -> Tree:
    from scipy.io import loadmat, whosmat

    _check_readable(path, "MATLAB")
    _check_size(path, sum(int(np.prod(shape)) for _, shape, _ in whosmat(path)))
    content = loadmat(path, chars_as_strings=True)
    return {name: _plain(value) for name, value in content.items() if not name.startswith("__")}


def _plain(value: Any) -> Any:
    """Array of floats (r, c), text, list of texts or tree of what scipy read; None for anything else."""
    kind = getattr(value, "dtype", None)
    if kind is None:
        return None
    if kind.names:
        return {part: _plain(value[part].flat[0]) for part in kind.names} if value.size == 1 else None
    if kind.kind == "U":
        return str(value.flat[0]) if value.size == 1 else [str(v).strip() for v in value.flat]
    if kind.kind == "O":
        inner = [_plain(v) for v in value.flat]
        return inner if inner and all(isinstance(v, str) for v in inner) else None
    if kind.kind in "fiub" and value.size > 0:
        return np.atleast_2d(np.asarray(value, dtype=float))
    return "" if kind.kind in "fiub" else None


def _version_73(path: Path) -> Tree:
    import h5py

    def plain(item: Any) -> Any:
        if isinstance(item, h5py.Group):
            return {name: plain(inner) for name, inner in item.items() if not name.startswith("#")}
        if item.attrs.get("MATLAB_class") == b"char" and item.dtype.kind in "iu":
            return "".join(map(chr, np.ravel(item[()].T))) if item.ndim == 2 and min(item.shape) == 1 else None
        if item.dtype == h5py.ref_dtype and item.size <= _MOST_NUMBERS:
            inner = [plain(item.file[reference]) for reference in np.ravel(item[()].T) if reference]
            return inner if inner and all(isinstance(v, str) for v in inner) else None
        if item.dtype.kind in "fiu" and item.ndim <= 2 and item.size > 0:
            _check_size(path, item.size)
            return np.atleast_2d(np.asarray(item[()], dtype=float))
        return None

    _check_readable(path, "HDF5")
    with h5py.File(path, "r") as file:
        tree: Tree = plain(file)
        return tree

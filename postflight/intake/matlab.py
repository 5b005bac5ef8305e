"""Tables in MATLAB files: numbers alone, no objects, nothing that could run.

Version 5 to 7 by scipy, version 7.3 (HDF5) by h5py where it is installed. Vectors of one length beside each
other (at the top, or in one structure) are a table; a matrix with as many rows gives a column for each of its columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flightmodel.checks import ConfigError, FloatArray, GateError
from postflight.intake.loose import LooseTable

MOST_NUMBERS = 200_000_000
LEAST_ROWS = 3


def read_matlab(path: Path) -> list[LooseTable]:
    """Read every table of a MATLAB file; `GateError` where there is none."""
    try:
        with path.open("rb") as file:
            head = file.read(128)
    except FileNotFoundError:
        raise GateError(f"{path}: no such file") from None
    variables, left_out = _version_73(path) if b"MATLAB 7.3" in head or head[:4] == b"\x89HDF" else _version_5(path)
    groups: dict[tuple[str, int], dict[str, FloatArray]] = {}
    for parent, name, values in variables:
        rows = max(values.shape)
        if rows < LEAST_ROWS or values.ndim != 2:
            left_out.append(name)
            continue
        block = values if values.shape[0] == rows else values.T
        columns = {name: block[:, 0]} if block.shape[1] == 1 else {f"{name}_{k + 1}": c for k, c in enumerate(block.T)}
        groups.setdefault((parent, rows), {}).update(columns)
    tables = []
    for k, ((parent, _), columns) in enumerate(g for g in groups.items() if len(g[1]) >= 2):
        label = "_".join(filter(None, [path.stem, parent])) + (f"_{k + 1}" if not parent and k else "")
        cells = [
            [repr(float(v)) if np.isfinite(v) else "" for v in row] for row in np.column_stack(list(columns.values()))
        ]
        notes = ["MATLAB numbers became CSV"]
        if left_out:
            notes.append(f"left out, as no columns of numbers: {', '.join(sorted(left_out)[:8])}")
        tables.append(LooseTable(label, list(columns), [""] * len(columns), cells, notes))
    if not tables:
        raise GateError(
            f"{path}: no two columns of numbers of one length; left out: {', '.join(left_out) or 'nothing'}"
        )
    return tables


def _version_5(path: Path) -> tuple[list[tuple[str, str, FloatArray]], list[str]]:
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    try:
        if sum(int(np.prod(shape)) for _, shape, _ in whosmat(path)) > MOST_NUMBERS:
            raise GateError(f"{path}: more than {MOST_NUMBERS} numbers; split it")
        content = loadmat(path, chars_as_strings=True)
    except (ValueError, TypeError, OSError, MatReadError, NotImplementedError, KeyError) as fault:
        if isinstance(fault, GateError):
            raise
        raise GateError(f"{path}: not a MATLAB file that can be read ({fault}); save it with -v7, or as CSV") from None
    found, left_out = [], []
    for parent, name, value in _walk(content):
        if _is_numbers(value):
            found.append((parent, name, np.atleast_2d(np.asarray(value, dtype=float))))
        else:
            left_out.append(name)
    return found, left_out


def _walk(content: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Variables, and fields of structures of one element."""
    for name, value in content.items():
        if name.startswith("__"):
            continue
        fields = getattr(getattr(value, "dtype", None), "names", None)
        if fields and value.size == 1:
            yield from ((name, part, value[part].flat[0]) for part in fields)
        else:
            yield "", name, value


def _is_numbers(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 0


def _version_73(path: Path) -> tuple[list[tuple[str, str, FloatArray]], list[str]]:
    try:
        import h5py
    except ImportError:
        words = (
            "a MATLAB 7.3 file needs h5py: pip install 'postflight[matlab]', or save it in MATLAB with -v7, or as CSV"
        )
        raise ConfigError(f"{path}: {words}") from None
    found: list[tuple[str, str, FloatArray]] = []
    left_out: list[str] = []

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        parent, _, own = name.rpartition("/")
        if item.dtype.kind in "fiu" and item.ndim <= 2 and 0 < item.size <= MOST_NUMBERS:
            found.append((parent.replace("/", "_"), own, np.atleast_2d(np.asarray(item[()], dtype=float))))
        else:
            left_out.append(own)

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
    except OSError as fault:
        raise GateError(f"{path}: not a MATLAB file that can be read ({fault})") from None
    return found, left_out

"""What is kept of a table of a flight's answers, and what differs between that and a new one (`benchmarks.golden`).

Of a long table some rows are kept, and of every column the sums of its values and of their squares over all rows.
Tables of named rows (checks, findings, events, sensor errors) are kept whole, and compared name by name.

A number is compared in units of its own sd (``alt_m`` of ``alt_sd_m``) as stored; without one relative to its column's
rms, or in tables of named rows to itself; a check's statistic to the width of its band, where that is larger. Text,
verdicts and codes must be equal; sentences are not looked at. Four units in the last place are no difference.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

CELLS, MOST_ROWS, LEAST_ROWS, ONE_OF = 3000, 48, 16, 6  # of a table of rows without names, kept: one row of so many
MOST_NAMED, MOST_WORDS, LAST_PLACES = 200, 20, 4
SAME_TIME_S = 1e-6
NAMES = ("name", "event", "peak", "input", "methods", "mode", "source", "component")
SENTENCES = {"remark", "symptom", "words", "what", "reason", "assumptions", "description", "agreement", "rests_on",
             "missing", "suspect", "verdicts_failed"}  # fmt: skip
PURE = ("correlation", "lag1", "chance", "probability", "sd_left", "share_inside")  # of the order of one by themselves
OWN_SD = {"estimate": "sd", "value": "sd", "increment": "sd", "mean": "sd", "residual": "predicted_sd",
          "amplitude_deg": "sd_deg", "deflection_deg": "sd_deg", "plane_lv_deg": "plane_sd_deg", "offset_s": "sd_s",
          **{f"theta_p{k}_deg": "theta_sd_deg" for k in (5, 16, 50, 84, 95)}}  # fmt: skip


class Found(NamedTuple):
    """One difference: of which column, how large in which unit (infinite where it has no size), and where."""

    column: str
    size: float
    unit: str
    where: str


def kept(table: pd.DataFrame) -> dict[str, Any]:
    """What is stored of a table, as JSON has it: some rows with all their digits, and sums over all rows.

    Sums of a column are a list: of values; of squares; what a unit in every row would add to either; and how many
    numbers there are.
    """
    table = table[[name for name in table if name not in SENTENCES]]
    out: dict[str, Any] = {"rows": len(table)}
    names = names_of(table)
    if names is not None:
        return out | {"names": names, "columns": {name: cells(table[name]) for name in table}}
    few = int(np.clip(min(CELLS // max(table.shape[1], 1), len(table) // ONE_OF), LEAST_ROWS, MOST_ROWS))
    at = np.unique(np.linspace(0, max(len(table) - 1, 0), min(few, len(table))).round().astype(int))
    columns = {name: cells(table[name].iloc[at]) for name in table}
    out |= {"at": at.tolist(), "columns": columns, "sums": {}, "counts": {}}
    for name in table if len(at) < len(table) else ():
        if table[name].dtype.kind not in "iuf":
            counts = table[name].value_counts().sort_index()
            few_words = len(counts) <= MOST_WORDS
            out["counts"][name] = {str(k): int(n) for k, n in counts.items()} if few_words else len(counts)
            continue
        x = table[name].to_numpy(float)
        by, many = sd_column(name, table)
        sd = pd.to_numeric(table[by], errors="coerce").to_numpy(float) / many if by else np.full(len(x), np.nan)
        there = np.isfinite(x)
        unit = units(sd, rms(math.fsum(x[there] ** 2), int(there.sum())), name)
        values, squares = math.fsum(x[there]), math.fsum(x[there] ** 2)
        scales = (unit, (2.0 * np.abs(x) + unit) * unit)
        out["sums"][name] = [values, squares, *(float(f"{part[there].sum():.6g}") for part in scales), int(there.sum())]
    return out


def cells(column: pd.Series) -> list[Any]:
    """Cells as JSON has them: numbers, text, true, false, and null where nothing stands."""
    return [None if value is None or value != value else value for value in column.astype(object).tolist()]


def names_of(table: pd.DataFrame) -> list[str] | None:
    """Name of each row, numbered where several have one; None where rows have none, or there are very many."""
    by = [name for name in NAMES if name in table]
    if not by or len(table) > MOST_NAMED:
        return None
    by = ["name"] if "name" in by else [*by, *(["code"] if "code" in table else [])]
    seen: dict[str, int] = {}
    out = []
    for row in zip(*(cells(table[column]) for column in by), strict=True):
        name = " ".join(str(part) for part in row if part is not None)
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return out


def sd_column(column: str, columns: Iterable[str]) -> tuple[str, float]:
    """Column that holds a column's own sd, and how many of them it holds; an empty name where there is none."""
    path, dot, leaf = column.rpartition(".")
    stem, _, unit = leaf.rpartition("_")
    columns = set(columns)
    for about, many in (("sd", 1.0), ("3sd", 3.0)):
        for name in (f"{leaf}_{about}", f"{stem}_{about}_{unit}" if stem else ""):
            if name and path + dot + name in columns:
                return path + dot + name, many
    own = path + dot + OWN_SD.get(leaf, "")
    return (own, 1.0) if leaf in OWN_SD and own in columns else ("", 1.0)


def units(sd: np.ndarray, of_column: float, name: str) -> np.ndarray:
    """Unit of each value of a column: its sd, else the column's rms, else one."""
    rest = 1.0 if name.startswith(PURE) or of_column == 0.0 else of_column
    return np.where(np.isfinite(sd) & (sd > 0.0), sd, rest)


def rms(squares: float, count: int) -> float:
    """Root of the mean of squares, of which there may be none."""
    return math.sqrt(squares / count) if count else 0.0


def is_number(value: Any) -> bool:
    """Whether a cell is a number; a verdict is none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def distance(old: Any, new: Any, unit: float) -> float:
    """Difference of two cells in a unit; infinite where it has no size."""
    if not is_number(old) or not is_number(new):
        return 0.0 if old == new and isinstance(old, bool) == isinstance(new, bool) else math.inf
    if old == new or abs(new - old) <= LAST_PLACES * np.spacing(abs(float(old))):
        return 0.0
    size = abs(float(new - old) / unit)
    return size if math.isfinite(size) else math.inf


def differences(stored: dict[str, Any], fresh: pd.DataFrame) -> Iterator[Found]:
    """Compare a table with what is stored of it; sizes may be zero.

    Of a table with another number of rows the kept rows are looked for by its first column, a time.
    """
    now = kept(fresh)
    if ("names" in stored) != ("names" in now):
        yield Found("rows", math.inf, "", "in one of both alone they have names")
        return
    for name in stored["columns"]:
        if name not in now["columns"]:
            yield Found(name, math.inf, "", "the column is gone")
    yield from (_of_named_rows if "names" in stored else _of_rows)(stored, now, fresh)


def _of_named_rows(stored: dict[str, Any], now: dict[str, Any], _: pd.DataFrame) -> Iterator[Found]:
    place = {name: k for k, name in enumerate(now["names"])}
    for name in sorted({*stored["names"]} ^ {*place}):
        yield Found(f"row {name}", math.inf, "", "the row is new" if name in place else "the row is gone")
    for column, old in stored["columns"].items():
        new = now["columns"].get(column, [])
        own, many = sd_column(column, stored["columns"])
        for k, name in enumerate(stored["names"]):
            if name not in place or not new:
                continue
            row = {c: values[k] for c, values in stored["columns"].items()}
            sd = row.get(own)
            by_sd = is_number(sd) and sd > 0.0
            unit = sd / many if by_sd else _size_itself(column, row)
            b = new[place[name]]
            yield Found(column, distance(old[k], b, unit), "sd" if by_sd else "relative", f"{name}: {b} for {old[k]}")


def _size_itself(column: str, row: dict[str, Any]) -> float:
    """Unit of a number of a named row without sd: its size, or of a check its band's width where that is larger."""
    size = abs(row[column]) if is_number(row[column]) else 0.0
    if {"value", "low", "high"} <= row.keys() and is_number(row["low"]) and is_number(row["high"]):
        size = max(size, row["high"] - row["low"])
    return 1.0 if column.startswith(PURE) or not 0.0 < size < math.inf else float(size)


def _of_rows(stored: dict[str, Any], now: dict[str, Any], fresh: pd.DataFrame) -> Iterator[Found]:
    columns, same = stored["columns"], stored["rows"] == now["rows"]
    first = next(iter(columns), "")
    if not same:
        yield Found("rows", math.inf, "", f"{now['rows']} for {stored['rows']}")
        near = _rows_at(columns.get(first, []), fresh, first)
        now["columns"] = {name: cells(fresh[name].iloc[near]) for name in now["columns"]} if near else {}
    for name, old in columns.items():
        own, many = sd_column(name, columns)
        of_row = columns.get(own, [None] * len(old))
        sd = np.array([x / many if is_number(x) else np.nan for x in of_row], float)
        numbers = [x for x in old if is_number(x)]
        sums = stored["sums"].get(name, [0.0, math.fsum(x * x for x in numbers), 0.0, 0.0, len(numbers)])
        unit = units(sd, rms(sums[1], sums[4]), name)
        kind = "sd" if own else "relative"
        for k, (a, b) in enumerate(zip(old, now["columns"].get(name, []), strict=False)):
            where = f"{first} {columns[first][k]}: " if len(old) > 1 else ""
            yield Found(name, distance(a, b, unit[k]), kind, f"{where}{b} for {a}")
        if same and name in now["columns"]:
            yield from _of_sums(name, stored, now, kind)


def _rows_at(times: list[Any], fresh: pd.DataFrame, first: str) -> list[int]:
    """Rows of a table of another length at the stored rows' times; none where not every one is there."""
    if first not in fresh or fresh[first].dtype.kind not in "iuf" or not len(fresh) or not all(map(is_number, times)):
        return []
    there = fresh[first].to_numpy(float)
    near = [int(np.argmin(np.abs(there - t))) for t in times]
    return near if all(abs(there[k] - t) < SAME_TIME_S for k, t in zip(near, times, strict=True)) else []


def _of_sums(name: str, stored: dict[str, Any], now: dict[str, Any], kind: str) -> Iterator[Found]:
    """Compare what is kept of all rows of a column: a mean is smaller than the largest difference that made it."""
    old, new = stored["counts"].get(name), now["counts"].get(name)
    if old != new:
        yield Found(name, math.inf, "", f"all rows: {new} for {old}")
    old, new = stored["sums"].get(name), now["sums"].get(name)
    if not old or not new:
        return
    if old[4] != new[4]:
        yield Found(name, math.inf, "", f"all rows: {new[4]} numbers for {old[4]}")
    for words, k in (("mean over all rows", 0), ("mean square over all rows", 1)):
        yield Found(name, distance(old[k], new[k], old[k + 2] or 1.0), kind, words)

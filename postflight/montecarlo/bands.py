"""Which percentiles and bands do the outputs of a study have, and how certain are they with so many flights?

Chunks on disk: ``chunk-000012.npz`` holds runs, reasons of those that failed, times of divergence, the named numbers as
float64 and the histories as float32. Files are whole or absent, with the same bytes from the same flights; a damaged
one counts as missing and is flown again.

Intervals: of n independent flights the number below the true percentile p is binomial, ``k ~ B(n, p)``, whatever the
distribution; so the k-th and l-th smallest values contain it with a known probability (`scipy.stats.quantile_test`). A
stop rule that is evaluated after every chunk tends to stop when the interval happens to be narrow, so its coverage is a
little below the nominal one (docs/monte-carlo.md has the measured figure).

Bands of histories are exact percentiles over all flights, for as many times at once as fit into `BAND_BYTES`, whatever
the number of flights; every chunk is read once. Flights that failed are in the table of flights and nowhere else.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flightmodel.checks import FloatArray, GateError
from flightmodel.files import abandoned, open_file, partial_path, write_file
from flightmodel.statistics import BAND_COLUMNS, BAND_PERCENTILES, percentile_band
from postflight.montecarlo.study import CONFIDENCE, Study
from synthetic_flight.ensemble import Row


@dataclass(frozen=True)
class Chunk:
    """Rows of one chunk, ``n`` of them, by run number; a failed one has a reason and NaN."""

    runs: NDArray[np.int64]
    reasons: tuple[str, ...]
    diverged_s: FloatArray
    scalars: FloatArray
    histories: NDArray[np.float32]

    @property
    def flown(self) -> NDArray[np.bool_]:
        """Mask of the flights that did not fail."""
        return np.array([not reason for reason in self.reasons], dtype=bool)


def chunk_from_rows(rows: list[Row], scalars: tuple[str, ...]) -> Chunk:
    """Collect rows in the order of their run numbers."""
    rows = sorted(rows, key=lambda row: row.run)
    return Chunk(
        np.array([row.run for row in rows], dtype=np.int64),
        tuple(row.reason for row in rows),
        np.array([row.diverged_s for row in rows]),
        np.array([[row.scalars[name] for name in scalars] for row in rows]).reshape(len(rows), len(scalars)),
        np.stack([row.histories for row in rows]).astype(np.float32),
    )


def chunk_path(folder: Path, number: int) -> Path:
    """File of one chunk."""
    return folder / "chunks" / f"chunk-{number:06d}.npz"


def write_chunk(folder: Path, number: int, chunk: Chunk) -> None:
    """Write a chunk beside its place and rename it."""
    path = chunk_path(folder, number)
    partial = partial_path(path)
    reasons = "\0".join(chunk.reasons).encode()
    try:
        with partial.open("wb") as file:
            np.savez(file, **(vars(chunk) | {"reasons": np.frombuffer(reasons, dtype=np.uint8)}))
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_chunk(folder: Path, number: int, runs: Sequence[int] | None = None, histories: bool = True) -> Chunk | None:
    """Read a chunk; None where it is missing, damaged, or holds other runs than ``runs``.

    Without ``histories`` that array is empty and its bytes are not read.
    """
    path = chunk_path(folder, number)
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as data:
            held = data["runs"]
            reasons = tuple(data["reasons"].tobytes().decode().split("\0"))
            past = data["histories"] if histories else np.empty((len(held), 0, 0), dtype=np.float32)
            chunk = Chunk(held, reasons, data["diverged_s"], data["scalars"], past)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    if len(reasons) != len(held) or (runs is not None and held.tolist() != list(runs)):
        return None
    return chunk


def remove_partial(folder: Path) -> None:
    """Remove half-written files of killed processes."""
    for left in abandoned(folder / "chunks"):
        left.unlink(missing_ok=True)


def percentile_interval(values: FloatArray, percentile: float, confidence: float) -> tuple[float, float]:
    """Two-sided confidence interval of a percentile; NaN at a side where flights are too few.

    Parameters
    ----------
    values : (n,) float
        Of the flights that flew, in any order.
    percentile : float
        0 to 100.
    confidence : float
        At least this share of such intervals holds the true percentile.
    """
    if not len(values):
        return np.nan, np.nan
    from scipy.stats import quantile_test  # half a second to import

    found = quantile_test(values, q=np.inf, p=percentile / 100.0).confidence_interval(confidence)
    return float(found.low), float(found.high)


def is_narrow(values: FloatArray, percentile: float, confidence: float, width: float) -> bool:
    """Whether the interval of a percentile is closed and no wider than ``width``."""
    low, high = percentile_interval(values, percentile, confidence)
    return bool(high - low <= width)


BAND_BYTES = 64 * 1024**2


@dataclass(frozen=True)
class Merged:
    """Results of a study: tables of flights, percentiles and bands, and counts."""

    flights: pd.DataFrame
    percentiles: pd.DataFrame
    bands: pd.DataFrame
    summary: dict[str, Any]


def merge(study: Study, folder: Path, flights: int) -> Merged:
    """Merge the chunks of so many flights.

    Raises
    ------
    GateError
        Where a chunk is missing, with how many are.
    """
    wanted = [study.runs_of(k, flights) for k in range(study.chunks(flights))]
    parts: list[Chunk] = []
    for k, runs in enumerate(wanted):
        chunk = read_chunk(folder, k, runs, histories=False)
        if chunk is None:
            missing = sum(read_chunk(folder, j, r, False) is None for j, r in enumerate(wanted))
            message = f"{folder}: {missing} of {len(wanted)} chunks are missing; the same run command flies them"
            raise GateError(message, code="study-damaged")
        parts.append(chunk)
    names = list(study.plan.scalars)
    table = pd.DataFrame(np.concatenate([c.scalars for c in parts]), columns=names)
    table.insert(0, "run", np.concatenate([c.runs for c in parts]))
    table["diverged_s"] = np.concatenate([c.diverged_s for c in parts])
    table["reason"] = [reason for c in parts for reason in c.reasons]
    flown = np.concatenate([c.flown for c in parts])
    summary: dict[str, Any] = {
        "flights": flights,
        "failed": int((~flown).sum()),
        "diverged": int(np.isfinite(table["diverged_s"]).sum()),
        "seed": study.spec.seed,
        "mode": study.spec.mode,
    }
    if study.spec.mode == "whole":
        summary["coverage"] = coverage(table[flown])
    bands = _bands(study, folder, wanted, flown)
    return Merged(table, _percentiles(table[flown], names), bands, summary)


def _percentiles(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    rows = []
    for name in names:
        values = table[name].to_numpy(dtype=float)
        values = values[np.isfinite(values)]
        band = percentile_band(values) if len(values) else np.full(3, np.nan)
        for percentile, value in zip(BAND_PERCENTILES, band.tolist(), strict=True):
            rows.append((name, len(values), percentile, value, *percentile_interval(values, percentile, CONFIDENCE)))
    return pd.DataFrame(rows, columns=["output", "flights", "percentile", "value", "low_95", "high_95"])


def _bands(study: Study, folder: Path, wanted: Sequence[Sequence[int]], flown: NDArray[np.bool_]) -> pd.DataFrame:
    """Percentiles of every history at every time, computed in blocks of times that fit into memory."""
    time_s, names = study.plan.window.history_time_s(), study.plan.histories
    count, points = int(flown.sum()), len(time_s)
    columns = ["history", "time_s", "flights", *BAND_COLUMNS]
    if not names or not count:
        return pd.DataFrame(columns=columns)
    out = np.empty((len(names), points, len(BAND_PERCENTILES)))
    for part, slab in _slabs(folder, wanted, (len(names), points, count)):
        for k in range(len(names)):  # one at a time: sorting takes a copy
            out[k, part] = percentile_band(slab[k], axis=-1).T
    table = pd.DataFrame(out.reshape(-1, len(BAND_PERCENTILES)), columns=columns[3:])
    table.insert(0, "history", np.repeat(names, points))
    table.insert(1, "time_s", np.tile(np.round(time_s, 9), len(names)))
    table.insert(2, "flights", count)
    return table


def _slabs(
    folder: Path, wanted: Sequence[Sequence[int]], shape: tuple[int, int, int]
) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Histories of all successful flights, ``(names, times, flights)``, block by block in time.

    Chunks hold flight by flight what is wanted time by time. Where not all fits into memory the histories are turned
    round on disk, in a file as large as the chunks, so that every chunk is read once, however many there are.
    """
    names, points, count = shape
    width = BAND_BYTES // (4 * names * count)
    if width >= points:
        yield slice(0, points), _turned(folder, wanted, 0, (names, points))
        return
    width = max(1, width)
    at_once = max(1, BAND_BYTES // (4 * names * points * max(len(runs) for runs in wanted)))
    path = partial_path(folder / "histories")
    try:
        turned, before = np.memmap(path, np.float32, "w+", shape=shape), 0
        for first in range(0, len(wanted), at_once):
            block = _turned(folder, wanted[first : first + at_once], first, (names, points))
            turned[:, :, before : before + block.shape[2]] = block
            before += block.shape[2]
        for at in range(0, points, width):
            part = slice(at, min(at + width, points))
            yield part, turned[:, part]
        del turned
    finally:
        path.unlink(missing_ok=True)


def _turned(folder: Path, wanted: Sequence[Sequence[int]], first: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Histories ``(names, times, flights)`` of the successful flights in consecutive chunks from ``first`` on."""
    out, count = np.empty((*shape, sum(map(len, wanted))), dtype=np.float32), 0
    for number, runs in enumerate(wanted, first):
        chunk = read_chunk(folder, number, runs)
        if chunk is None:
            message = f"{folder}: chunk {number} was damaged while it was read; run again"
            raise GateError(message, code="study-damaged")
        kept = chunk.histories[chunk.flown]
        out[:, :, count : count + len(kept)] = np.moveaxis(kept, 0, -1)
        count += len(kept)
    return out[:, :, :count]


def coverage(table: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Fraction of errors within one and two standard deviations, by estimator, and the mean NEES of nine states."""
    out: dict[str, dict[str, float]] = {}
    for column in table.columns:
        name = column.removesuffix("_error_deg")
        sd = table.get(f"{name}_sd_deg")
        if name == column or sd is None:
            continue
        ratio = np.abs(table[column] / sd).to_numpy(dtype=float)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio):
            out[name] = {
                "answers": float(len(ratio)),
                "inside_1_sd": float(np.mean(ratio < 1.0)),
                "inside_2_sd": float(np.mean(ratio < 2.0)),
                "rms_over_sd": float(np.sqrt(np.mean(ratio**2))),
            }
    if "bet_nees" in table and table["bet_nees"].notna().any():
        out["bet"] = {"answers": float(table["bet_nees"].count()), "mean_nees_of_9": float(table["bet_nees"].mean())}
    return out


def write_merged(folder: Path, merged: Merged) -> None:
    """Write the tables and the counts, each whole or not at all; the same bytes from the same chunks."""
    for name in ("flights", "percentiles", "bands"):
        write_csv(folder / f"{name}.csv", getattr(merged, name))
    write_file(folder / "summary.json", json.dumps(merged.summary, indent=2) + "\n")


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table beside its place and rename it."""
    write_file(path, lambda partial: table.to_csv(partial, index=False, float_format="%.10g", lineterminator="\n"))

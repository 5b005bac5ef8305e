"""Chunks of a study on disk: whole or not there at all, the same bytes from the same flights.

``chunk-000012.npz`` holds runs, reasons of those that failed, when a joint diverged, the named numbers as float64 and
the histories as float32. A file that was damaged counts as missing, and is flown again.
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray
from synthetic_flight.dispersed_ensemble import Row

PARTIAL = ".part"


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
    partial = path.with_name(f".{path.stem}-{os.getpid()}{PARTIAL}")
    reasons = "\0".join(chunk.reasons).encode()
    try:
        with partial.open("wb") as file:
            np.savez(
                file,
                runs=chunk.runs,
                reasons=np.frombuffer(reasons, dtype=np.uint8),
                diverged_s=chunk.diverged_s,
                scalars=chunk.scalars,
                histories=chunk.histories,
            )
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_chunk(folder: Path, number: int, runs: list[int] | None = None, histories: bool = True) -> Chunk | None:
    """Read a chunk; None where it is missing, damaged, or holds other runs than ``runs``.

    Without ``histories`` that array is empty and its bytes are not read.
    """
    path = chunk_path(folder, number)
    try:
        with np.load(path, allow_pickle=False) as data:
            held = data["runs"]
            reasons = tuple(data["reasons"].tobytes().decode().split("\0"))
            past = data["histories"] if histories else np.empty((len(held), 0, 0), dtype=np.float32)
            chunk = Chunk(held, reasons, data["diverged_s"], data["scalars"], past)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    if len(reasons) != len(held) or (runs is not None and held.tolist() != runs):
        return None
    return chunk


def remove_partial(folder: Path) -> None:
    """Remove what killed processes of this machine left half-written."""
    for path in (folder / "chunks").glob(f".*{PARTIAL}"):
        number = path.name.removesuffix(PARTIAL).rpartition("-")[2]
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            path.unlink(missing_ok=True)
        except (PermissionError, ValueError, OverflowError):
            continue

"""How are the numbers of a large, well-formed CSV read in a fraction of a second? In one pass, or from the cache.

The file's bytes go through compiled code (`flightmodel._csv_kernels`) in pieces side by side, straight into one block
of float64; columns that are not asked for are stepped over. Whatever is not plain (quotes, text in a number's place, a
row of another length, a name that stands twice, a blank line between rows) gives no answer here: the careful reader of
`flightmodel.tables` then reads the file as text and reports what is wrong and where. On files that both read they agree
to the last bit.

The cache is the user's, by content: one entry is the block of columns that one reading asked for, named after the
file's size and SHA-256 and a digest of what was asked. Neither path nor time of change is part of it: a file that is
moved is found again, one that is changed is not. ``POSTFLIGHT_CACHE=off`` turns the cache off; XDG_CACHE_HOME moves it.
An entry appears whole or not at all, so that processes need no lock; a damaged one is dropped and written anew. Beyond
`LIMIT_BYTES` the entries that were not used for longest go.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray, IntArray
from flightmodel.tables import TimeColumn, clock_times, column_names

SMALLEST_BYTES = 512 * 1024  # below it the careful reader is as quick as loading compiled code
CACHED_BYTES = 4 * 1024**2
PIECE_BYTES = 4 * 1024**2
HEAD_BYTES = 1024**2  # the header ends within
PADDING = b"\n\0\0\0"  # a last newline, and room to look ahead
NEWLINE = 10
Bytes = NDArray[np.uint8]
Edge = tuple[int, int]


@dataclass(frozen=True)
class Numbers:
    """What one reading asked for: times and columns as the file has them, the first row's line, the file's SHA-256."""

    time: FloatArray | None
    columns: dict[str, FloatArray]
    first_line: int
    sha256: str


@dataclass(frozen=True)
class _Layout:
    """Where the rows begin, and what becomes of each column of the file."""

    body: int
    first_line: int
    names: tuple[str, ...]  # of the numbers, in the order of the block's rows
    slots: IntArray
    text: bool


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
        Is told, as the file is read, of how many bytes more.
    """
    clock = time is not None and time.format != "seconds"
    try:
        size = path.stat().st_size
        if size < SMALLEST_BYTES:
            return None
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        layout = _layout(head, wanted, time)
        if layout is None:
            return None
        about = (time.column, time.format, str(t0)) if time is not None and clock else ()
        shelf = Shelf(size, (*about, *layout.names)) if size >= CACHED_BYTES else None
        block = None
        if shelf is not None and shelf.worth_a_look():
            digest = file_sha256(path)
            block = shelf.load(digest)
            tell(0 if block is None else size)
        if block is None:
            read = _parse(path, size, layout, time if clock else None, t0, tell)
            if read is None:
                return None
            block, digest = read
            if shelf is not None:
                shelf.store(digest, block)
    except OSError:
        return None
    columns = dict(zip(layout.names, block[int(layout.text) :], strict=True))
    if time is None:
        return Numbers(None, columns, layout.first_line, digest)
    return Numbers(block[0] if clock else columns[time.column], columns, layout.first_line, digest)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _layout(head: bytes, wanted: Mapping[str, bool], time: TimeColumn | None) -> _Layout | None:
    from flightmodel import _csv_kernels as kernels

    begin, line = (3 if head.startswith(b"\xef\xbb\xbf") else 0), 1
    while (end := head.find(b"\n", begin)) >= 0 and not head[begin:end].strip():
        begin, line = end + 1, line + 1
    try:
        header = head[begin:end].decode()
    except UnicodeDecodeError:
        return None
    if end < 0 or len(header.splitlines()) != 1 or header.count('"') % 2:
        return None
    names = column_names(header)
    needed = {name for name, must in wanted.items() if must} | ({time.column} if time is not None else set())
    if len(set(names)) < len(names) or not needed <= set(names):
        return None
    text = time is not None and time.format != "seconds"
    numbers = [name for name in names if name in wanted or (time is not None and not text and name == time.column)]
    slots = np.full(len(names), kernels.SKIPPED)
    for k, name in enumerate(numbers):
        slots[names.index(name)] = k + int(text)
    if time is not None and text:
        if time.column in wanted:
            return None
        slots[names.index(time.column)] = kernels.TEXT
    return _Layout(end + 1, line + 1, tuple(numbers), slots, text)


@cache
def _tables() -> tuple[FloatArray, NDArray[np.uint64], NDArray[np.uint64]]:
    from flightmodel import _csv_kernels as kernels

    return (kernels.EXACT_TENS, *kernels.powers_of_five())


def _parse(
    path: Path,
    size: int,
    layout: _Layout,
    clock: TimeColumn | None,
    t0: datetime | None,
    tell: Callable[[int], None],
) -> tuple[FloatArray, str] | None:
    """Block of numbers (times of a clock first) and the content's SHA-256; None where anything is unusual."""
    from flightmodel import _csv_kernels as kernels

    workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    before, pieces = path.stat(), _Pieces(path)
    with ThreadPoolExecutor(workers) as pool:
        digest = pool.submit(file_sha256, path)
        starts = range(0, size, PIECE_BYTES)
        counted = list(pool.map(lambda begin: pieces.newlines(begin, min(begin + PIECE_BYTES, size)), starts))
        edges = _edges(layout, size, counted)
        block = np.empty((len(layout.names) + int(layout.text), edges[-1][1]))
        spans = np.empty((2, edges[-1][1] if layout.text else 0), dtype=np.int64)

        def read(k: int) -> tuple[int, list[str]]:
            (begin, row), (end, _) = edges[k], edges[k + 1]
            data, length = pieces.read(begin, end)
            stop = length + int(data[length - 1] != NEWLINE)  # a last line without a newline: the padding ends it
            rows = int(kernels.read_rows(data, 0, stop, layout.slots, *_tables(), block, spans, row))
            return rows, _cells(data, spans[:, row : row + rows]) if layout.text and rows > 0 else []

        done = []
        for k, got in enumerate(pool.map(read, range(len(edges) - 1))):
            done.append(got)
            tell(edges[k + 1][0] - edges[k][0])
        # blank lines leave rows out; they may stand after the last row alone
        full = [edge[1] + rows for edge, (rows, _) in zip(edges, done, strict=False) if rows > 0]
        total = sum(rows for rows, _ in done)
        if min(rows for rows, _ in done) < 0 or total < 2 or total != full[-1]:
            return None
        block = np.ascontiguousarray(block[:, :total])
        if clock is not None and t0 is not None:
            block[0] = clock_times([cell for _, cells in done for cell in cells], clock.format, t0)
            if not np.isfinite(block[0]).all():
                return None
        after = path.stat()
        changed = (before.st_mtime_ns, before.st_size) != (after.st_mtime_ns, after.st_size)
        return None if changed else (block, digest.result())


class _Pieces:
    """Pieces of a file, each thread's in its own place, used again: fresh memory costs more than reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.own = threading.local()

    def read(self, begin: int, end: int) -> tuple[Bytes, int]:
        """Bytes ``begin`` to ``end`` with the padding behind them, and how many were there to read."""
        wanted = end - begin
        data: Bytes | None = getattr(self.own, "data", None)
        if data is None or len(data) < wanted + len(PADDING):
            data = self.own.data = np.empty(max(wanted, PIECE_BYTES + PIECE_BYTES // 8) + len(PADDING), dtype=np.uint8)
        view, length = memoryview(data)[:wanted], 0  # type: ignore[arg-type]
        with self.path.open("rb", buffering=0) as file:
            file.seek(begin)
            while length < wanted and (got := file.readinto(view[length:])):
                length += got
        data[length : length + len(PADDING)] = np.frombuffer(PADDING, dtype=np.uint8)
        return data, length

    def newlines(self, begin: int, end: int) -> tuple[int, int, bool]:
        """How many newlines a piece has, the byte after the first (0 for none), and whether one ends the piece."""
        data, length = self.read(begin, end)
        newline = data[:length] == NEWLINE
        count = int(np.count_nonzero(newline))
        return count, begin + int(np.argmax(newline)) + 1 if count else 0, bool(length and newline[-1])


def _edges(layout: _Layout, size: int, counted: list[tuple[int, int, bool]]) -> list[Edge]:
    """First byte and row of each stretch of whole lines, and those of the end."""
    edges, rows = [(layout.body, 0)], 1 - layout.first_line
    for newlines, following, _ in counted:
        if edges[-1][0] < following < size:
            edges.append((following, rows + 1))
        rows += newlines
    return [*edges, (size, rows + int(not counted[-1][2]))]


def _cells(data: Bytes, spans: IntArray) -> list[str]:
    """Text of cells, without the spaces around them."""
    cells: list[str] = []
    for k in range(0, spans.shape[1], 16384):  # a table of characters at a time
        begin, end = spans[:, k : k + 16384]
        at = begin[:, None] + np.arange(max(1, int((end - begin).max())))
        table = np.where(at < end[:, None], data[np.minimum(at, end[:, None])], 0).astype(np.uint8)
        cells += [cell.decode("ascii").strip() for cell in table.view(f"S{at.shape[1]}")[:, 0].tolist()]
    return cells


LIMIT_BYTES = 2 * 1024**3
STALE_S = 3600.0  # a file this old that never got its name was left by a process that was killed
VERSION = "1"  # of what an entry holds


def folder() -> Path | None:
    """Folder of the entries, or None where the cache is turned off or there is no home to keep it in."""
    if os.environ.get("POSTFLIGHT_CACHE", "").lower() in ("off", "0", "no", "false"):
        return None
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "postflight" / "tables"
    except RuntimeError:
        return None


class Shelf:
    """Place in the cache for what is asked of files of one size.

    Parameters
    ----------
    size : int
        Of the file, bytes.
    asked : tuple of str
        All that the block depends on beside the file's content.
    """

    def __init__(self, size: int, asked: tuple[str, ...]) -> None:
        self.folder = folder()
        self.stem = f"{hashlib.sha256(repr((VERSION, *asked)).encode()).hexdigest()[:16]}-{size}"

    def worth_a_look(self) -> bool:
        """Whether the file's digest may be here: where not, it need not be awaited before the file is read."""
        return self.folder is not None and any(self.folder.glob(f"{self.stem}-*.npy"))

    def load(self, sha256: str) -> FloatArray | None:
        """Block of a content, or None where it is not here, or damaged."""
        if self.folder is None:
            return None
        path = self.folder / f"{self.stem}-{sha256}.npy"
        try:
            with path.open("rb") as file:
                block = np.load(file, allow_pickle=False)
                if int(np.load(file, allow_pickle=False)) != _sum(block):
                    raise ValueError("not what was written")
            os.utime(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, TypeError):
            with contextlib.suppress(OSError):
                path.unlink()
            return None
        return block

    def store(self, sha256: str, block: FloatArray) -> None:
        """Keep a block; a disk that is full or may not be written to is no fault of the reading."""
        if self.folder is None or block.nbytes > LIMIT_BYTES // 2:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=self.folder, suffix=".part")
            try:
                with os.fdopen(handle, "wb") as file:
                    np.save(file, block)
                    np.save(file, np.uint64(_sum(block)))
                Path(name).replace(self.folder / f"{self.stem}-{sha256}.npy")
            except BaseException:
                Path(name).unlink(missing_ok=True)
                raise
            _keep_within_limit(self.folder)
        except OSError:
            return


def _sum(block: FloatArray) -> int:
    """Sum of all words: a page that never reached the disk changes it."""
    return int(np.add.reduce(np.ascontiguousarray(block).view(np.uint64), axis=None))


def _keep_within_limit(where: Path) -> None:
    entries = []
    for path in where.iterdir():
        with contextlib.suppress(OSError):
            known = path.stat()
            if path.suffix == ".part" and time.time() - known.st_mtime > STALE_S:
                path.unlink()
            elif path.suffix == ".npy":
                entries.append((known.st_mtime, known.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= LIMIT_BYTES:
            return
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size

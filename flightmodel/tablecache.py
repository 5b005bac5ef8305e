"""Where do numbers that were read once from a large CSV wait for the next reading? In the user's cache, by content.

One entry is the block of columns that one reading asked for, named after the file's size and SHA-256 and a digest of
what was asked. Neither path nor time of change is part of it: a file that is moved is found again, one that is changed
is not. ``POSTFLIGHT_CACHE=off`` turns the cache off; XDG_CACHE_HOME moves it. An entry appears whole or not at all, so
that processes need not know of each other; a damaged one is dropped and written anew. Beyond `LIMIT_BYTES` the
entries that were not used for longest go.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from flightmodel.checks import FloatArray

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

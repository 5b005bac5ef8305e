"""Where may compiled kernels be kept? In the user's cache; where that cannot be written, in a folder of this process.

A container has often neither a home nor a user's name, and a file system that may only be read. Whatever is missing
there costs time, never the command.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

REMEDY = "set XDG_CACHE_HOME or NUMBA_CACHE_DIR to a folder that may be written"


@dataclass(frozen=True)
class CacheFolder:
    """A folder for what is compiled: None where there is none at all; ``remark`` says why it is not the usual one."""

    path: Path | None
    remark: str = ""


def cache_folder(name: str) -> CacheFolder:
    """Make the folder ``name`` in the user's cache, or else in a private temporary one that goes with this process.

    Child processes find the temporary one by NUMBA_CACHE_DIR. Where the home cannot be written, matplotlib keeps its
    files here too, or it would make a folder of its own and two lines of warning.
    """
    stated, xdg = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    base = Path(stated or (Path(xdg) if xdg else Path.home() / ".cache") / "postflight")
    try:
        made = CacheFolder(_writable(base / name))
    except OSError as fault:
        made = _private_folder(name, f"{base}: {fault.strerror}")
    if made.path is not None and not os.access(Path.home(), os.W_OK):
        os.environ.setdefault("MPLCONFIGDIR", str(made.path.parent / "matplotlib"))
    return made


def _private_folder(name: str, why: str) -> CacheFolder:
    words = f"the user's cache cannot be written ({why})"
    for place in (None, "/dev/shm"):  # a read-only container has no /tmp, but shared memory
        with contextlib.suppress(OSError):
            private = Path(tempfile.mkdtemp(prefix="postflight-", dir=place))
            break
    else:
        return CacheFolder(None, f"{words}, nor temporary files: kernels are compiled in every process anew; {REMEDY}")
    atexit.register(_remove, private, os.getpid())
    os.environ["NUMBA_CACHE_DIR"] = str(private)
    return CacheFolder(_writable(private / name), f"{words}: compiled kernels go when the command ends; {REMEDY}")


def _writable(folder: Path) -> Path:
    """Make a folder and put a file into it, or raise OSError: what exists may still be read-only."""
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()
    return folder


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # a fork leaves by the same door
        shutil.rmtree(folder, ignore_errors=True)

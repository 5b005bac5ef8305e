"""Which files of a folder may be opened? Regular ones up to a size, inside the folder that names them.

A folder from elsewhere may hold a named pipe, at which opening waits for ever, a link to a device without an end, or a
link that leads out. Every reader opens through `open_file`; libraries that open by name ask `unfit` before.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from flightmodel.checks import NO_FAULT, Fault

TABLE_BYTES = 2 * 1024**3  # of text; the careful reader takes ten times that of memory
PICTURE_BYTES = 256 * 1024**2  # 40 million pixels of three colours, 16 bit each, uncompressed
_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}
# not handed to child processes, bytes as they are, and no waiting for a pipe; each system has some of them
_FLAGS = sum({getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOINHERIT", "O_BINARY", "O_NONBLOCK")})


class UnfitFile(OSError):
    """A file that is not opened; ``strerror`` says why, ``code`` is ``not-a-file`` or ``file-too-large``."""

    def __init__(self, path: Path, fault: Fault) -> None:
        super().__init__(None, str(fault), str(path))
        self.code = fault.code


def open_file(path: Path, most_bytes: int = TABLE_BYTES) -> BinaryIO:
    """Open a regular file of at most so many bytes for reading.

    Raises
    ------
    UnfitFile
        For anything else; other OSErrors as `open` has them.
    """
    _check(path, path.stat(), most_bytes)  # before it is opened: to open a device may already do something
    handle = os.open(path, os.O_RDONLY | _FLAGS)
    try:
        _check(path, os.fstat(handle), most_bytes)  # what was opened, should it have changed in between
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def file_bytes(path: Path, most_bytes: int = TABLE_BYTES) -> bytes:
    """Content of a file as `open_file` opens it; one that grows while it is read, or states no size, has an end too."""
    with open_file(path, most_bytes) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise UnfitFile(path, _too_large(len(content), most_bytes))
    return content


def unfit(path: Path, most_bytes: int) -> Fault:
    """Say why `open_file` would not open a path; empty where it would."""
    try:
        _check(path, path.stat(), most_bytes)
    except UnfitFile as fault:
        return Fault(str(fault.strerror), fault.code)
    except OSError:
        return Fault("no such file", "file-missing")
    return NO_FAULT


def leads_outside(folder: Path, named: str) -> bool:
    """Whether a name below a folder leads out of it, by ``..`` or a link."""
    return not (folder / named).resolve().is_relative_to(folder.resolve())


def _check(path: Path, known: os.stat_result, most_bytes: int) -> None:
    if stat.S_ISDIR(known.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(known.st_mode):
        kind = _KINDS.get(stat.S_IFMT(known.st_mode), "no file")
        raise UnfitFile(path, Fault(f"is {kind}; a file is wanted", "not-a-file"))
    if known.st_size > most_bytes:
        raise UnfitFile(path, _too_large(known.st_size, most_bytes))


def _too_large(size: int, most_bytes: int) -> Fault:
    return Fault(f"has {size} bytes where {most_bytes} at most are read; split it or thin it out", "file-too-large")

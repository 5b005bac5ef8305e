"""Which files may be opened, and how is one written whole or not at all?

**Read**: regular files up to a size, inside the folder that names them. A folder from elsewhere may hold a named pipe,
at which opening waits for ever, a link to a device without an end, or a link that leads out. Every reader opens through
`open_file`; libraries that open by name ask `unfit` before.

**Written**: what is being written bears a name of its own until it is whole; whose process has ended may be removed.
The name says who writes: ``.partial-<machine>-<process>-<any>-<name>``. Process numbers mean something in one PID
namespace of one boot of one machine, which ``<machine>`` identifies; of what another container or host writes, only its
age decides. It is taken for abandoned where nothing in it changed for `LEFT_ALONE_S`.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import stat
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import BinaryIO

from flightmodel.checks import NO_FAULT, GateError, Issue

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
PARTIAL = "partial"
MOST_LISTED = 8  # names of files in a message: about two lines
LEFT_ALONE_S = 86400.0  # far beyond the longest pause in writing and any difference of clocks
_HEX = "[0-9a-f]{8}"
_NAME = re.compile(rf"\.(?P<kind>[a-z]+)-(?P<machine>{_HEX})-(?P<process>\d+)-{_HEX}-(?P<name>.+)", re.DOTALL)
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class UnfitFile(OSError):
    """A file that is not opened; ``strerror`` says why, ``code`` is ``not-a-file`` or ``file-too-large``."""

    def __init__(self, path: Path, fault: Issue) -> None:
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
    """Content of a file opened by `open_file`; reading is bounded even if the file grows or states no size."""
    with open_file(path, most_bytes) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise UnfitFile(path, _too_large(len(content), most_bytes))
    return content


def unfit(path: Path, most_bytes: int) -> Issue:
    """Say why `open_file` would not open a path; empty where it would."""
    try:
        _check(path, path.stat(), most_bytes)
    except UnfitFile as fault:
        return Issue(str(fault.strerror), fault.code)
    except OSError:
        return Issue("no such file", "file-missing")
    return NO_FAULT


def nothing_at(path: Path) -> Issue:
    """Return a message that there is no such file, with the files in its folder."""
    folder = path.parent
    try:
        there = sorted(p.name for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    except OSError:
        return Issue(f"no such file: there is no folder {folder}", "file-missing")
    listed = ", ".join(there[:MOST_LISTED]) + (", ..." if len(there) > MOST_LISTED else "")
    return Issue(f"no such file; there are: {listed or 'none'}", "file-missing")


def leads_outside(folder: Path, named: str) -> bool:
    """Whether a name below a folder leads out of it, by ``..`` or a link."""
    return not (folder / named).resolve().is_relative_to(folder.resolve())


def _check(path: Path, known: os.stat_result, most_bytes: int) -> None:
    if stat.S_ISDIR(known.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(known.st_mode):
        kind = _KINDS.get(stat.S_IFMT(known.st_mode), "no file")
        raise UnfitFile(path, Issue(f"is {kind}; a file is wanted", "not-a-file"))
    if known.st_size > most_bytes:
        raise UnfitFile(path, _too_large(known.st_size, most_bytes))


def _too_large(size: int, most_bytes: int) -> Issue:
    return Issue(f"has {size} bytes where {most_bytes} at most are read; split it or thin it out", "file-too-large")


@contextmanager
def writing(where: Path, remedy: str) -> Iterator[None]:
    """Turn what a disk refuses inside the block into a `GateError` that names the place and a way out."""
    try:
        yield
    except OSError as fault:
        full = fault.errno in NO_ROOM
        named = str(where if fault.filename is None else fault.filename)
        if not full and not named.startswith(str(where)) and not str(where).startswith(named):
            raise  # a file elsewhere, named by the fault itself
        remedy = "make room, or write to another disk" if full else remedy
        words = f"cannot be written: {fault.strerror or fault}; nothing half-written is left; {remedy}"
        raise GateError(f"{where}: {words}", code="disk-full" if full else "cannot-write") from None


def write_file(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write bytes, or text as UTF-8, whole or not at all: beside its place, then renamed; folders are made.

    What is too large to be made at once is written by a function, to the path that it is called with.

    Of several processes that write one file at once, the last one's stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in abandoned(path.parent, path.name):
        left.unlink(missing_ok=True)
    partial = partial_path(path)
    try:
        if callable(content):
            content(partial)
        else:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@cache
def machine() -> str:
    """Eight hexadecimal digits that processes share which see each other by number."""
    try:
        facts = Path("/proc/sys/kernel/random/boot_id").read_text() + os.readlink("/proc/self/ns/pid")
    except OSError:  # no Linux, hence no namespaces
        facts = f"{uuid.getnode()}"
    return hashlib.sha256(facts.encode()).hexdigest()[:8]


def partial_path(target: Path, kind: str = PARTIAL) -> Path:
    """Return a path beside ``target`` that no other process uses."""
    return target.with_name(f".{kind}-{machine()}-{os.getpid()}-{secrets.token_hex(4)}-{target.name}")


def abandoned(folder: Path, name: str | None = None, kind: str = PARTIAL) -> Iterator[Path]:
    """Paths left in a folder by processes that ended, from `partial_path` for any target or for the target ``name``."""
    for path in sorted(folder.glob(f".{kind}-*")):
        found = _NAME.fullmatch(path.name)
        if found is None or found["kind"] != kind or name not in (None, found["name"]):
            continue
        gone = found["machine"] == machine() and not _is_running(int(found["process"]))
        if gone or time.time() - _changed_s(path) > LEFT_ALONE_S:
            yield path


def _is_running(process: int) -> bool:
    if os.name == "nt":  # where signal 0 is Ctrl-C: age decides
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _changed_s(path: Path) -> float:
    """Time of the last change of a file or of anything directly in a folder, s; now where it just went away."""
    try:
        within = list(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
        return max(each.lstat().st_mtime for each in (path, *within))
    except OSError:
        return time.time()

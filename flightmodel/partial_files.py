"""What is being written bears a name of its own until it is whole; whose process has ended may be removed.

A name says who writes: ``.partial-<machine>-<process>-<any>-<name>``. Process numbers mean something in one PID
namespace of one boot of one machine, which ``<machine>`` identifies; of what another container or host writes, only
its age decides. It is taken for abandoned where nothing in it changed for `LEFT_ALONE_S`.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import time
import uuid
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PARTIAL = "partial"
LEFT_ALONE_S = 86400.0  # far beyond the longest pause in writing and any difference of clocks
_HEX = "[0-9a-f]{8}"
_NAME = re.compile(rf"\.(?P<kind>[a-z]+)-(?P<machine>{_HEX})-(?P<process>\d+)-{_HEX}-(?P<name>.+)", re.DOTALL)


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
    """Paths in a folder, of `partial_path` for any target or that ``name``, of which nobody will ever take care."""
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

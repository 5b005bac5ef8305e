"""A file that is whole or not there at all."""

from __future__ import annotations

from pathlib import Path


def write_file(path: Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, beside its place and rename it; folders on the way are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)

"""Examples that stand in the documentation."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[list[str]]:
    """Arguments of every `postflight` command in fenced blocks, comments left out."""
    lines = [line for block in re.findall(r"^```\w*\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
             for line in block.splitlines()]  # fmt: skip
    found = (re.match(r"(?:\$ |\s*(?:\.venv/bin/|\$\(BIN\)/))?postflight (.*)", line) for line in lines)
    return [shlex.split(match[1], comments=True) for match in found if match]

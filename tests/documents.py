"""Examples that stand in the documentation."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("", "console", "bash", "sh", "text")
COMMAND = re.compile(r"(?:\$ )?(?:\.venv/bin/)?((?:postflight|make|dask|export|python|pip)\s.*)")


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def shell_lines(page: Path) -> list[str]:
    """Lines of every fenced block that is neither code nor a file: commands, and what they print."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    return [line for language, block in fenced if language in SHELL for line in block.splitlines()]


def command_lines(page: Path) -> list[str]:
    """Every command in those blocks, in order, without its prompt, its folder and its comment."""
    found = (COMMAND.match(line) for line in shell_lines(page))
    return [" ".join(re.sub(r"\s#.*", "", match[1]).split()) for match in found if match]


def commands(page: Path) -> list[list[str]]:
    """Arguments of every `postflight` command of a page."""
    words = (shlex.split(line) for line in command_lines(page))
    return [arguments for program, *arguments in words if program == "postflight"]

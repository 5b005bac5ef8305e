"""On what do commands print, and how far are they? On rich's console, which text from files cannot steer and a lost
reader cannot end; progress is a bar on a terminal, and a plain line now and then where standard error is none.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich import progress as bars
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table

from flightmodel.checks import Progress
from postflight.streams import into_nothing, visible

if TYPE_CHECKING:  # a first line waits for no numpy
    from flightmodel.checks import Issue


EXIT_NO_ANSWER, EXIT_CHECK_FAILED = 4, 5  # docs/how-to.md has all exit codes


class Terminal(Console):
    """A console that prints what files say as `visible` text, and prints on into nothing where nobody reads."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Segments of text as rich makes them; its own control sequences are segments apart."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)

    def coded(self, mark: str, words: str, code: str = "") -> None:
        """Print a finding, refusal or failed check behind its mark, with its code in brackets at the end."""
        self.print(f"{mark} {escape(words + (f' [{code}]' if code else ''))}", highlight=False)

    def table(
        self, title: str, names: Iterable[str], rows: Iterable[Iterable[object]], words: Collection[str] = ()
    ) -> None:
        """Print a table: its first column and those named in ``words`` are texts, the others numbers."""
        printed = Table(title=escape(title))
        for k, name in enumerate(names):
            is_text = not k or name in words
            printed.add_column(name, justify="left" if is_text else "right", no_wrap=not k)
        for row in rows:
            printed.add_row(*(escape(str(cell)) for cell in row))
        self.print(printed)

    def on_broken_pipe(self) -> None:
        """Continue after a closed pipe, since results are written to files."""
        into_nothing(self.file)


def terminal(**options: Any) -> Terminal:
    """Return a console of the project's settings on standard output, or on standard error where asked."""
    return Terminal(soft_wrap=True, **options)


MOST_ALIKE = 5  # findings of one kind that a reader wants line by line


def few_of_each(findings: Iterable[Issue]) -> list[tuple[str, str]]:
    """Text and code of findings; of many with one source and code, the first, their number and their end."""
    alike: dict[tuple[str, str], list[Issue]] = {}
    for finding in findings:
        alike.setdefault((finding.source, finding.code), []).append(finding)
    out = []
    for (source, code), same in alike.items():
        shown = same if len(same) <= MOST_ALIKE else same[: MOST_ALIKE - 1]
        out += [(finding.line, code) for finding in shown]
        if len(shown) < len(same):
            until = f", the last until {same[-1].end_s:.3f} s" if math.isfinite(same[-1].end_s) else ""
            out.append((f"{source}: {len(same) - len(shown)} more of these{until}", code))
    return out


# progress of a long command: a bar on a terminal, a plain line now and then where standard error is none

_EVERY_S = 10.0  # between plain lines; a shorter command prints none


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Progress on standard error: a bar with remaining time, or a line every ten seconds where that is no terminal."""
    screen = terminal(stderr=True)
    if not screen.is_terminal:
        with plain_lines(screen, _EVERY_S) as report:
            yield report
        return
    columns = (
        bars.TextColumn("{task.description:<34}"),
        bars.BarColumn(),
        bars.TimeElapsedColumn(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda fraction, what: bar.update(task, completed=fraction, description=what)


@contextmanager
def plain_lines(screen: Console, every_s: float) -> Iterator[Progress]:
    """Print elapsed seconds, the part that is done and the present step, every so many seconds.

    A step that takes longer is printed again, so that a log shows that the command is alive.
    """
    begun, now, done = time.monotonic(), (0.0, "starting"), threading.Event()

    def report(fraction: float, what: str) -> None:
        nonlocal now
        now = (fraction, what)

    def print_lines() -> None:
        while not done.wait(every_s):
            fraction, what = now
            line = f"{time.monotonic() - begun:.0f} s: {100.0 * min(fraction, 1.0):.0f} %, {what}"
            screen.print(line, highlight=False, markup=False)

    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        done.set()
        thread.join()

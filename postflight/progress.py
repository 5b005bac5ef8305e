"""How far a long command is: a bar on a terminal, and a plain line now and then where standard error is none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Report = Callable[[float, str], None]
EVERY_S = 10.0  # between plain lines; what is done sooner says nothing


@contextmanager
def progress_bar() -> Iterator[Report]:
    """Progress on standard error: a bar with remaining time, or a line every ten seconds where that is no terminal."""
    screen = Console(stderr=True, soft_wrap=True)
    if not screen.is_terminal:
        with plain_lines(screen, EVERY_S) as tell:
            yield tell
        return
    columns = (TextColumn("{task.description:<34}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda fraction, what: bar.update(task, completed=fraction, description=what)


@contextmanager
def plain_lines(screen: Console, every_s: float) -> Iterator[Report]:
    """Print which step is under way, with elapsed seconds and the part that is done, every so many seconds.

    A step that takes longer is told again: who reads a log sees that it is alive.
    """
    begun, now, done = time.monotonic(), (0.0, "starting"), threading.Event()

    def tell(fraction: float, what: str) -> None:
        nonlocal now
        now = (fraction, what)

    def lines() -> None:
        while not done.wait(every_s):
            fraction, what = now
            words = f"{time.monotonic() - begun:.0f} s: {100.0 * min(fraction, 1.0):.0f} %, {what}"
            screen.print(words, highlight=False, markup=False)

    thread = threading.Thread(target=lines, daemon=True)
    thread.start()
    try:
        yield tell
    finally:
        done.set()
        thread.join()

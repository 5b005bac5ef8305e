"""On what do commands print? On rich's console, which text from files cannot steer and a lost reader cannot end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from postflight.streams import into_nothing, visible


class Terminal(Console):
    """A console that prints what files say as `visible` text, and prints on into nothing where nobody reads."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Segments of text as rich makes them; its own control sequences are segments apart."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)

    def on_broken_pipe(self) -> None:
        """Go on: results are written to files, whoever reads."""
        into_nothing(self.file)


def terminal(**options: Any) -> Terminal:
    """Return a console of the project's settings on standard output, or on standard error where asked."""
    return Terminal(soft_wrap=True, **options)

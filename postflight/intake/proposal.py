"""What is proposed of a table: which column is which, in which unit, how its time is written, and why.

``how`` is ``stated`` where the header says it, ``numbers`` where only one reading of the numbers is possible, ``asked``
where neither tells: that becomes a question, never a guess.
"""

from __future__ import annotations

from dataclasses import dataclass, field

STATED, NUMBERS, ASKED = "stated", "numbers", "asked"


@dataclass(frozen=True)
class Mapped:
    """One column: the quantity's short name in flight.toml, its unit (empty where it is asked), how and why."""

    short: str
    column: str
    unit: str
    how: str
    why: str
    canonical: bool = False


@dataclass(frozen=True)
class TimeMapped:
    """Where the time stands: columns, format, unit (of seconds; empty where it is asked), other candidates."""

    columns: tuple[str, ...]
    format: str
    unit: str
    how: str
    why: str
    offset_asked: bool = False
    others: tuple[str, ...] = ()


@dataclass
class SourceProposal:
    """One table of flight.toml: its header (``sensors.rates``), columns, further keys as (key, TOML value, comment)."""

    section: str
    columns: list[Mapped]
    keys: list[tuple[str, str, str]] = field(default_factory=list)
    time: TimeMapped | None = None

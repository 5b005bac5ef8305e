"""How ``flight.toml`` names a table: its file, its time column, columns of other names, and which rows are used."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from flightmodel.columns import UNITS, Declared, TimeColumn
from flightmodel.config import Section, Time


def _in_order(value: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    for start, stop in value:
        if not start < stop:
            raise ValueError(f"a span ends after it begins; {start:g} to {stop:g} s does not")
    return value


# first and last second of each
Spans = Annotated[tuple[tuple[Time, Time], ...], Field(min_length=1, max_length=100), AfterValidator(_in_order)]


class ColumnEntry(Section):
    """A column of a table under another name or unit than the canonical one."""

    column: str
    unit: str

    @field_validator("unit")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in UNITS:
            raise ValueError(f"unknown unit; known: {', '.join(UNITS)}")
        return value


class TimeEntry(Section):
    """The time column of a table, or three columns with hour, minute and second of the day (UTC).

    ``offset_s`` is added to every time. ``repeats`` says what becomes of rows that repeat the time of the row before.
    """

    column: str = "t_s"
    columns: tuple[str, str, str] | None = None
    format: Literal["seconds", "utc", "irig_doy", "utc_hms"] = "seconds"
    unit: Literal["s", "ms", "us", "min"] = "s"
    offset_s: Time = 0.0
    repeats: Literal["refuse", "first"] = "refuse"

    @model_validator(mode="after")
    def _three_or_one(self) -> TimeEntry:
        if (self.format == "utc_hms") != (self.columns is not None):
            raise ValueError('format = "utc_hms" and columns = ["hour", "minute", "second"] belong together')
        return self


class Source(Section):
    """A table in the flight folder: its file, its time column, columns that are not canonical, spans to use."""

    file: str
    time: TimeEntry = TimeEntry()
    columns: dict[str, ColumnEntry] = {}
    use_s: Spans | None = None

    def declared(self, short: str) -> Declared | None:
        """Return the declared column of a quantity, or None for the canonical one."""
        entry = self.columns.get(short)
        return Declared(entry.column, entry.unit) if entry else None

    @property
    def time_column(self) -> TimeColumn:
        """The time column in the form the reader takes."""
        t = self.time
        parts = t.columns or (t.column,)
        return TimeColumn(parts[0], t.format, t.unit, parts, t.repeats)

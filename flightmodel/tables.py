"""How do columns and times of a CSV become SI arrays and seconds after t0?

A canonical column has its unit in its name (``range_m``, ``az_deg``). Anything else is accepted only where flight.toml
declares column and unit (`Source`); nothing is guessed. This is the only place where degrees, g, yards and the like
become SI and radians.

Times are numbers in a unit, ISO 8601 in UTC, or IRIG day of year ``DDD:HH:MM:SS.fff``; the latter lie in t0's year, or
in the next one where that is nearer (a flight across New Year).

Of an oversampled track some rows are used: ``every_s`` of a tracker in flight.toml is a number for all that it
measures, a table by component, or a list of spans:

    every_s = 4.0
    every_s = { az = 4.0, el = 4.0 }
    every_s = [{ every_s = 4.0 }, { from_s = 600.0, to_s = 640.0, components = ["range"], every_s = 0.0 }]

A component that no entry names keeps all its rows; of several entries about one instant the last one holds.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from flightmodel.checks import BoolArray, FloatArray, GateError, IntArray, Issue, nearest_name
from flightmodel.config import KeyFault, Section, Time
from flightmodel.files import UnfitFile, file_bytes, nothing_at
from flightmodel.units import UNITS, read_unit

if TYPE_CHECKING:
    import pandas as pd

_DEG = np.pi / 180.0
Component = Literal["range", "az", "el", "range_rate", "position", "velocity", "height"]
Spacing = Annotated[float, Field(ge=0.0, le=1e4)]


def ordered_spans(value: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """Refuse spans of which one does not end after it begins."""
    for start, stop in value:
        if not start < stop:
            raise ValueError(f"a span ends after it begins; {start:g} to {stop:g} s does not")
    return value


# first and last second of each
Spans = Annotated[tuple[tuple[Time, Time], ...], Field(min_length=1, max_length=100), AfterValidator(ordered_spans)]


class ColumnEntry(Section):
    """A column of a table under another name or unit than the canonical one."""

    column: str
    unit: str

    @field_validator("unit")
    @classmethod
    def _known(cls, value: str) -> str:
        if read_unit(value) is None:
            raise ValueError(f"unknown unit; known: {', '.join(UNITS)}, and what pint reads, as slug/ft^3 or deg/hr")
        return value


class TimeEntry(Section):
    """The time column of a table, or three columns with hour, minute and second of the day (UTC).

    ``offset_s`` is added to every time. ``repeats`` decides on rows that repeat the time of the row before.
    """

    column: str = "t_s"
    columns: tuple[str, str, str] | None = None
    format: Literal["seconds", "utc", "irig_doy", "utc_hms"] = "seconds"
    unit: Literal["s", "ms", "us", "min"] = "s"
    offset_s: Annotated[float, Field(ge=-1e10, le=1e10)] = 0.0  # a spacecraft's clock counts from 1980 or 2000
    repeats: Literal["refuse", "first"] = "refuse"

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if (self.format == "utc_hms") != (self.columns is not None):
            yield "", None, 'format = "utc_hms" and columns = ["hour", "minute", "second"] belong together'


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


@dataclass(frozen=True)
class Quantity:
    """A column that a table may hold: short name in the flight file, canonical column, kind, whether it is required."""

    short: str
    canonical: str
    kind: str
    required: bool = True


ACCELEROMETER = tuple(Quantity(f"a{a}", f"a{a}_suba_mps2", "acceleration") for a in "xyz")
RATES = tuple(Quantity(a, f"{a}_body_degps", "rate") for a in "pqr")
MAGNETOMETER = tuple(Quantity(f"b{a}", f"b{a}_magnetometer_ut", "magnetic field") for a in "xyz")
RADAR = (Quantity("range", "range_m", "length"), Quantity("az", "az_deg", "angle"), Quantity("el", "el_deg", "angle"))
# what a tracker may measure, and the noise of each reading where it differs from row to row
TRACKER = (*RADAR, Quantity("range_rate", "range_rate_mps", "speed"))
TRACKER_SD = tuple(
    Quantity(f"{q.short}_sd", q.canonical.replace(q.short, f"{q.short}_sd"), q.kind, required=False) for q in TRACKER
)
GNSS = (
    Quantity("lat", "lat_deg", "angle", required=False),
    Quantity("lon", "lon_deg", "angle", required=False),
    Quantity("alt", "alt_m", "length", required=False),
    *(Quantity(a, f"{a}_ecef_m", "length", required=False) for a in "xyz"),
    *(Quantity(f"v{a}", f"v{a}_ecef_mps", "speed", required=False) for a in "xyz"),
    *(Quantity(f"v{a}", f"v{a}_mps", "speed", required=False) for a in "ned"),
)
# noise of each fix, where the receiver states it
GNSS_SD = (
    Quantity("horizontal_sd", "horizontal_sd_m", "length", required=False),
    Quantity("vertical_sd", "vertical_sd_m", "length", required=False),
    Quantity("speed_sd", "speed_sd_mps", "speed", required=False),
    Quantity("vertical_speed_sd", "vertical_speed_sd_mps", "speed", required=False),
)
# counts of a receiver, read where flight.toml asks for a least one
GNSS_COUNTS = {"nsat": Quantity("nsat", "nsat", "fraction"), "fix_mode": Quantity("fix_mode", "fix_mode", "fraction")}
BAROMETER = (
    Quantity("height", "height_m", "length", required=False),
    Quantity("pressure", "pressure_pa", "pressure", required=False),
)
ATMOSPHERE = (
    Quantity("alt", "alt_m", "length"),
    Quantity("rho", "rho_kgpm3", "density"),
    Quantity("temperature", "t_k", "temperature"),
    Quantity("pressure", "p_pa", "pressure", required=False),
    Quantity("wind_north", "wind_n_mps", "speed", required=False),
    Quantity("wind_east", "wind_e_mps", "speed", required=False),
    Quantity("wind_speed", "wind_speed_mps", "speed", required=False),
    Quantity("wind_from", "wind_from_deg", "angle", required=False),
    Quantity("rho_sd", "rho_sd_percent", "fraction", required=False),
    Quantity("wind_sd", "wind_sd_mps", "speed", required=False),
)

AXIAL = (Quantity("mach", "mach", "fraction"), Quantity("c_a", "c_a", "fraction"))  # C_A along Mach number


def sun_quantities(heads: int) -> tuple[Quantity, ...]:
    """Columns of a table of Sun sensors with so many heads, counted from 1."""
    pairs = [(axis, head) for head in range(1, heads + 1) for axis in ("az", "el")]
    return tuple(Quantity(f"{axis}{head}", f"{axis}_sun{head}_deg", "angle") for axis, head in pairs)


@dataclass(frozen=True)
class Declared:
    """A column and its unit as the flight file declares them."""

    column: str
    unit: str


@dataclass(frozen=True)
class TimeColumn:
    """Where a table's time stands and how it is written: ``seconds``, ``utc`` (ISO), ``irig_doy`` or ``utc_hms``.

    ``parts`` are all columns that hold it; ``repeats`` is ``first`` where equal times may follow each other
    (`flightmodel.gate` then keeps the first row).
    """

    column: str = "t_s"
    format: str = "seconds"
    unit: str = "s"
    parts: tuple[str, ...] = ()
    repeats: str = "refuse"

    def __post_init__(self) -> None:
        """Use the one column unless several are named."""
        if not self.parts:
            object.__setattr__(self, "parts", (self.column,))


def column_about(column: str, what: str = "sd") -> str:
    """Name of the column of something about another: ``alt_m`` and ``sd`` make ``alt_sd_m``, ``mach`` ``mach_sd``."""
    stem, _, unit = column.rpartition("_")
    return f"{stem}_{what}_{unit}" if stem and unit in UNITS else f"{column}_{what}"


def read_table(path: Path, label: str, least_rows: int = 2) -> pd.DataFrame:
    """Read a CSV as text; ``attrs["lines"]`` holds each row's line in the file.

    Raises
    ------
    GateError
        For a file that is missing, empty, binary, ragged, or names a column twice.
    """
    try:
        content = file_bytes(path)
        text = "\0" if b"\0" in content else content.decode("utf-8-sig")
    except FileNotFoundError:
        raise GateError(f"{label}: {path}: {nothing_at(path)}", code="file-missing") from None
    except UnfitFile as fault:
        raise GateError(f"{label}: {path}: {fault.strerror}", fault.code) from None
    except (UnicodeDecodeError, OSError) as fault:
        raise GateError(f"{label}: {path}: not a readable CSV table: {fault}", code="file-unreadable") from None
    if "\0" in text:
        raise GateError(f"{label}: {path}: not a readable CSV table: it holds binary data", code="file-unreadable")
    numbered = [(k, line) for k, line in enumerate(text.splitlines(), start=1) if line.strip()]
    if len(numbered) <= least_rows:
        rows = max(0, len(numbered) - 1)
        found = f"{rows} data rows" if numbered else "is empty"
        words = f"{found}; a header and at least {least_rows} rows are needed: deliver it whole, or take its table out"
        raise GateError(f"{label}: {path}: {words}", code="too-few-rows")
    lines = np.array([k for k, _ in numbered[1:]])
    opened = _open_quote(numbered)
    if opened:
        raise GateError(
            f"{label}: {path}: line {opened}: a quote opens and is not closed on the line; mend it", code="row-ragged"
        )
    names, counts = _cells(numbered)
    head = f"{label}: {path}: line {numbered[0][0]}"
    faults = [Issue(f"{head}: column '{n}' stands twice", "given-twice") for n in _twice(names)]
    ragged = np.flatnonzero(counts != len(names))
    if len(ragged):
        k = int(ragged[0])
        faults.append(
            Issue(
                f"{label}: {path}: line {lines[k]}: {counts[k]} cells where the header has {len(names)} "
                f"({len(ragged)} in all); mend or remove them",
                "row-ragged",
            )
        )
    if faults:
        raise GateError(faults)
    body = "\n".join(line for _, line in numbered)
    import pandas as pd  # a quarter of a second, which a first flight needs not wait for

    frame = pd.read_csv(io.StringIO(body), dtype=str, skipinitialspace=True, keep_default_na=False, index_col=False)
    frame.columns = pd.Index(names)
    frame.attrs["lines"] = lines
    return frame


def _open_quote(numbered: list[tuple[int, str]]) -> int:
    """Line of the first quote that is not closed on its own line; 0 for none."""
    if any('"' in line for _, line in numbered):
        for (number, _), row in zip(numbered, csv.reader(line + "\n" for _, line in numbered), strict=False):
            if any("\n" in cell for cell in row):  # the cell took in the end of its line
                return number
    return 0


def _cells(numbered: list[tuple[int, str]]) -> tuple[list[str], IntArray]:
    """Names in the header, and the number of cells of each further row."""
    if any('"' in line for _, line in numbered):
        rows = list(csv.reader(line for _, line in numbered))
        return [c.strip() for c in rows[0]], np.array([len(r) for r in rows[1:]])
    return column_names(numbered[0][1]), np.array([line.count(",") + 1 for _, line in numbered[1:]])


def column_names(header: str) -> list[str]:
    """Names in a header line, without the spaces around them."""
    return [name.strip() for name in next(csv.reader([header]))]


def _twice(names: list[str]) -> list[str]:
    return sorted({n for n in names if names.count(n) > 1})


def line_of(frame: pd.DataFrame, row: int) -> int:
    """Line in the file of a row of a table read by `read_table`."""
    return int(frame.attrs["lines"][row])


def numbers(frame: pd.DataFrame, column: str, path: Path, label: str, faults: list[Issue]) -> FloatArray:
    """Column as float64; empty and NaN cells are missing, any other text is a fault with its file line."""
    import pandas as pd

    text = frame[column].str.strip()
    values = pd.to_numeric(text, errors="coerce").to_numpy(dtype=np.float64, copy=True)
    missing = text.str.lower().isin(["", "nan", "na", "null", "-"]).to_numpy()
    bad = (~np.isfinite(values)) & ~missing
    if bad.any():
        first = int(np.argmax(bad))
        where = f"{label}: {path}: line {line_of(frame, first)}, column '{column}'"
        count = f"({int(bad.sum())} in all)"
        faults.append(
            Issue(
                f"{where}: '{text.iloc[first]}' is no finite number {count}; leave a missing value empty",
                "not-a-number",
            )
        )
    return values + 0.0  # no negative zero: whole-number columns know none


def plain_number(text: str) -> float:
    """Return what a cell says; NaN where it is no number in plain digits (``float`` takes 1_0 and any script)."""
    try:
        return float(text) if text.isascii() and "_" not in text else float("nan")
    except ValueError:
        return float("nan")


def place(quantity: Quantity, declared: Declared | None) -> tuple[str, str]:
    """Column and unit in which a table holds a quantity."""
    if declared is not None:
        return declared.column, declared.unit
    unit = quantity.canonical.rsplit("_", 1)[-1]
    pure = quantity.kind == "fraction" and read_unit(unit) is None  # the names of pure numbers end in no unit
    return quantity.canonical, "1" if pure else unit


def fits(quantity: Quantity, unit: str) -> bool:
    """Whether a unit is valid for a quantity."""
    found = read_unit(unit)
    return found is not None and found.kind == quantity.kind


def to_si(values: FloatArray, unit: str) -> FloatArray:
    """Turn numbers of a unit into SI, in place."""
    known = read_unit(unit)
    assert known is not None
    _, factor, offset = known
    if factor != 1.0:
        with np.errstate(over="ignore"):  # beyond any flight, and refused as such
            values *= factor
    if offset != 0.0:
        values += offset
    return values


def column_si(
    frame: pd.DataFrame,
    quantity: Quantity,
    declared: Declared | None,
    path: Path,
    label: str,
    faults: list[Issue],
) -> FloatArray | None:
    """Return a quantity in SI, or None where it is absent (a fault when it is required)."""
    column, unit = place(quantity, declared)
    if column not in frame.columns:
        if quantity.required or declared:
            faults.append(_absent(frame, quantity, column, path, label))
        return None
    if not fits(quantity, unit):
        fitting = ", ".join(u for u, (kind, _, _) in UNITS.items() if kind == quantity.kind)
        faults.append(
            Issue(
                f"{label}: {path}: column '{column}': unit '{unit}' is not one of {quantity.kind}: {fitting}",
                "unit-unknown",
            )
        )
        return None
    return to_si(numbers(frame, column, path, label, faults), unit)


def _absent(frame: pd.DataFrame, quantity: Quantity, column: str, path: Path, label: str) -> Issue:
    stem = column.rsplit("_", 1)[0]
    bare = [c for c in frame.columns if c.lower() in (stem.lower(), quantity.short.lower())]
    if bare:
        hint = (
            f"; '{bare[0]}' names no unit: declare it in flight.toml, "
            f'columns.{quantity.short} = {{ column = "{bare[0]}", unit = "..." }}'
        )
    else:
        hint = nearest_name(column, frame.columns)
    words = f"{label}: {path}: line 1: no column '{column}'{hint}; found {', '.join(frame.columns)}"
    return Issue(words, "column-missing")


def unordered_times_s(
    frame: pd.DataFrame, spec: TimeColumn, t0: datetime, path: Path, label: str, faults: list[Issue]
) -> FloatArray | None:
    """Seconds after t0 in the file's order, or None with a fault for each thing that is wrong."""
    absent = [column for column in spec.parts if column not in frame.columns]
    if absent:
        found = ", ".join(frame.columns)
        hint = nearest_name(absent[0], frame.columns)
        faults.append(
            Issue(f"{label}: {path}: line 1: no time column '{absent[0]}'{hint}; found {found}", "column-missing")
        )
        return None
    if spec.format == "seconds":
        values = to_si(numbers(frame, spec.column, path, label, faults), spec.unit)
    elif spec.format == "utc_hms":
        values = _times_of_day([numbers(frame, column, path, label, faults) for column in spec.parts], t0)
    else:
        values = clock_times(frame[spec.column].str.strip().tolist(), spec.format, t0)
    bad = ~np.isfinite(values)
    if bad.any():
        first = int(np.argmax(bad))
        cell = ":".join(frame[column].iloc[first].strip() for column in spec.parts)
        where = f"{label}: {path}: line {line_of(frame, first)}: time '{cell}'"
        if _SECOND_60.search(cell):
            faults.append(Issue(f"{where} {SECOND_60}", "time-format"))
        else:
            faults.append(Issue(f"{where} is not in format '{spec.format}' ({int(bad.sum())} in all)", "time-format"))
        return None
    return values


def times_s(
    frame: pd.DataFrame, spec: TimeColumn, t0: datetime, path: Path, label: str, faults: list[Issue]
) -> FloatArray | None:
    """Seconds after t0, strictly increasing, or None with a fault for each thing that is wrong."""
    values = unordered_times_s(frame, spec, t0, path, label, faults)
    if values is None:
        return None
    step = np.diff(values)
    back = step < 0.0 if spec.repeats == "first" else step <= 0.0
    if back.any():
        k = int(np.argmax(back))
        faults.append(
            Issue(
                f"{label}: {path}: line {line_of(frame, k + 1)}: time runs backwards or repeats: {values[k]:.6f} s "
                f"then {values[k + 1]:.6f} s ({int(back.sum())} in all); sort the rows or remove the duplicates",
                "time-backwards",
            )
        )
        return None
    return values


def _times_of_day(parts: list[FloatArray], t0: datetime) -> FloatArray:
    """Seconds after t0 of hours, minutes and seconds of a day (UTC): of the day on which they lie nearest to t0."""
    hour, minute, second = parts
    with np.errstate(invalid="ignore"):
        real = (hour >= 0) & (hour < 24) & (minute >= 0) & (minute < 60) & (second >= 0) & (second < 60)
    of_day = (t0 - t0.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
    after = np.where(real, 3600.0 * hour + 60.0 * minute + second - of_day, np.nan)
    return np.round(after - 86400.0 * np.round(after / 86400.0), 7)


_SECOND_60 = re.compile(r":0?60(\.\d*)?(Z|[+-]00:?00)?$")
# UTC days are taken as 86400 s long, so a leap second has no time of its own after t0
SECOND_60 = (
    "has second 60: where it is a rounded 59.9996, write second 0 of the next minute; where it is a leap second, give "
    'the times of every table as seconds after t0 (format = "seconds")'
)
_IRIG = re.compile(r"^(\d{1,3}):(\d{2}):(\d{2}):(\d{2}(?:\.\d*)?)$", re.ASCII)
HALF_YEAR_S = 183 * 86400.0


def clock_times(cells: Sequence[str], form: str, t0: datetime) -> FloatArray:
    """Seconds after t0 of ``utc`` or ``irig_doy`` times; NaN where a cell does not parse."""
    if form == "irig_doy":
        out = _irig_times(cells, t0)
    else:
        import pandas as pd

        stamps = pd.DatetimeIndex(pd.to_datetime(list(cells), utc=True, errors="coerce", format="ISO8601"))
        out = (stamps - pd.Timestamp(t0)).total_seconds().to_numpy(dtype=float)
    # clocks are written to a microsecond at best: remove the rounding of the large offset
    return np.round(out, 7)


def _irig_times(cells: Sequence[str], t0: datetime) -> FloatArray:
    rows = [cell if _IRIG.match(cell) else "nan:nan:nan:nan" for cell in cells]
    day, hour, minute, second = np.loadtxt(rows, delimiter=":", ndmin=2).T
    return _seconds(day, hour, minute, second, t0)


def _seconds(day: FloatArray, hour: FloatArray, minute: FloatArray, second: FloatArray, t0: datetime) -> FloatArray:
    """Seconds after t0; NaN for a day, hour, minute or second that does not exist."""
    near = []
    for year in (t0.year, t0.year + 1):
        start, after = datetime(year, 1, 1, tzinfo=UTC), datetime(year + 1, 1, 1, tzinfo=UTC)
        exists = (day >= 1) & (day <= (after - start).days) & (hour <= 23) & (minute <= 59) & (second < 60.0)
        seconds = (start - t0).total_seconds() + (day - 1) * 86400.0 + hour * 3600 + minute * 60 + second
        near.append(np.where(exists, seconds, np.nan))
    with np.errstate(invalid="ignore"):
        return np.where(near[0] < -HALF_YEAR_S, near[1], near[0])


class ThinnedSpan(Section):
    """From ``from_s`` to before ``to_s``, rows of ``components`` closer than ``every_s`` are predicted, not used.

    Without ends it holds throughout, without components for all.
    """

    every_s: Spacing
    from_s: Time | None = None
    to_s: Time | None = None
    components: tuple[Component, ...] = ()

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.from_s is not None and self.to_s is not None and self.to_s <= self.from_s:
            yield "to_s", self.to_s, f"is not after from_s = {self.from_s:g}; swap the two"

    def holds(self, time_s: FloatArray, component: str) -> BoolArray:
        """Mask of rows (n,) of a component to which the span applies."""
        inside: BoolArray = np.full(len(time_s), not self.components or component in self.components)
        if self.from_s is not None:
            inside &= time_s >= self.from_s
        if self.to_s is not None:
            inside &= time_s < self.to_s
        return inside


def _as_spans(value: Any) -> Any:
    """Every form of ``every_s`` as a list of spans."""
    if isinstance(value, dict):
        return [{"components": [component], "every_s": spacing} for component, spacing in value.items()]
    return value if isinstance(value, (list, tuple)) else [{"every_s": value}]


Thinning = Annotated[
    tuple[ThinnedSpan, ...],
    BeforeValidator(_as_spans, json_schema_input_type=Spacing | dict[Component, Spacing] | tuple[ThinnedSpan, ...]),
    Field(max_length=100, validate_default=True),
]


def spacing_s(thinning: tuple[ThinnedSpan, ...], time_s: FloatArray, component: str) -> FloatArray:
    """Least time (n,) from each row to the one used before it; 0 where all are used."""
    out: FloatArray = np.zeros(len(time_s))
    for span in thinning:
        out[span.holds(time_s, component)] = span.every_s
    return out


def spaced(time_s: FloatArray, spacing: FloatArray) -> BoolArray:
    """Rows (n,) that keep at least their ``spacing`` (n,) from the one kept before, the first among them."""
    keep: BoolArray = np.ones(len(time_s), dtype=bool)
    if not spacing.any():
        return keep
    last = -np.inf
    for k, (t, least) in enumerate(zip(time_s.tolist(), spacing.tolist(), strict=True)):
        keep[k] = least <= 0.0 or t >= last + least - 1e-6
        last = t if keep[k] else last
    return keep

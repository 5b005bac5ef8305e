"""May this table be used, which of its rows, in which order, and what is notable in it?

`Gate` keeps faults (with their codes) while the files of a flight folder are read, and opens where there is none. A
table's rows pass these steps:

1. **Order.** Telemetry comes in packets: a row or a whole block may come twice, late, or in the wrong order. Rows that
   repeat an earlier one (time and every value) are left out; rows out of order are put in order. Two kinds of rows
   contradict others: those of one time with different values, and late ones for which there is no room, because rows
   that came before stand there at their usual interval (a clock that was reset lays one stretch of the flight over
   another so). A few of them are left out: of one time all, for nothing shows which is right. With `FEW` of the rows or
   more the table is refused. It is refused with fewer, too, where a late block contradicts and the rows run on from it
   into new times at their usual interval: what was sent late ends with a jump forward, a clock that was set back does
   not, and then all that follows has wrong times.
2. **Choice.** Rows inside the spans that flight.toml states, and of repeated times the first; times are those after
   ``time.offset_s`` was added. Of an oversampled tracker's rows some are read but only predicted.
3. **Range.** Values beyond what any entry vehicle's instrument reads are refused: a wrong unit, or a broken word.
4. **Findings.** Gaps, missing, frozen and saturated runs, each with its times.

Every repair is a finding with its number of rows and blocks and its times; nothing is repaired in silence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd

from flightmodel import tables
from flightmodel.checks import NO_FAULT, BoolArray, ConfigError, FloatArray, GateError, IntArray, Issue, nearest_name
from flightmodel.csv_reading import file_sha256, read_numbers
from flightmodel.tables import Source, ThinnedSpan, spaced, spacing_s

MOST_PAUSE_S = 86400.0  # no vehicle is in flight, or on its pad, for a day without a reading
# no entry vehicle's instruments read beyond these; a larger number is a wrong unit or a broken word
SANE_LIMIT = {
    "acceleration": 1.0e4,
    "rate": 400.0,
    "length": 1.0e8,
    "angle": 4.0 * np.pi,
    "magnetic field": 1.0e-3,
}


# times, columns by short name, and the file line of each row
Read = tuple[FloatArray | None, dict[str, FloatArray], IntArray]


@dataclass(frozen=True)
class Table:
    """One file's times (where it has any), SI columns by short name, and the file line of each row."""

    path: Path
    label: str
    time_s: FloatArray | None
    columns: dict[str, FloatArray]
    lines: IntArray

    def at(self, row: int) -> str:
        """Return where a row stands, for messages."""
        return f"{self.label}: {self.path}: line {int(self.lines[row])}"

    def of_rows(self, rows: BoolArray) -> Table:
        """Return the table of these rows alone."""
        if rows.all():
            return self
        time_s = None if self.time_s is None else self.time_s[rows]
        kept = {short: values[rows] for short, values in self.columns.items()}
        return Table(self.path, self.label, time_s, kept, self.lines[rows])


@dataclass
class Gate:
    """What is wrong with a folder (``faults`` of the data, ``config`` of flight.toml), and what is notable."""

    folder: Path
    t0: datetime
    faults: list[Issue] = field(default_factory=list)
    config: list[Issue] = field(default_factory=list)
    findings: list[Issue] = field(default_factory=list)
    digests: dict[Path, str] = field(default_factory=dict)
    progress: Callable[[int], None] = lambda _bytes: None  # called with the bytes read since the last call

    def sha256(self, path: Path) -> str:
        """SHA-256 of a file, from its reading where that made one."""
        return self.digests.get(path) or file_sha256(path)

    def refuse(self, words: str, code: str) -> None:
        """Keep a fault of the data."""
        self.faults.append(Issue(words, code))

    def refuse_config(self, words: str, code: str = "") -> None:
        """Keep a fault of flight.toml."""
        code = code or getattr(words, "code", "")
        self.config.append(Issue(f"{self.folder / 'flight.toml'}: {words}", code))

    def close(self) -> None:
        """Raise `ConfigError` or `GateError` with everything that was refused."""
        if self.config:
            raise ConfigError([*self.config, *self.faults])
        if self.faults:
            raise GateError(self.faults)

    def wrong_place(self, path: Path, named: str) -> str:
        """Return why a named file may not be read: outside the folder, or below its truth; empty where it may."""
        if "\0" in named:
            return Issue(f"file {named!r}: a path holds no NUL character", "path-refused")
        if Path(named).is_absolute() or not path.resolve().is_relative_to(self.folder.resolve()):
            words = f"file '{named}' lies outside the flight folder; copy it inside and name it relative to flight.toml"
            return Issue(words, "path-refused")
        if self.is_truth(path):
            return Issue(f"file '{named}' lies in truth/, which no estimator may open", "path-refused")
        return ""

    def is_truth(self, path: Path) -> bool:
        """Whether a path leads below ``truth/`` of this flight, or to a file there by another name (a hard link)."""
        truth = self.folder / "truth"
        if path.resolve().is_relative_to(truth.resolve()):
            return True
        if not path.is_file() or path.stat().st_nlink == 1:
            return False
        return any(path.samefile(other) for other in truth.rglob("*") if other.is_file())

    def path(self, named: str) -> Path | None:
        """Path of a file or folder that flight.toml names; None, with a fault, where it may not be read."""
        path = self.folder / named
        wrong = self.wrong_place(path, named)
        if wrong:
            self.refuse_config(wrong)
        return None if wrong else path

    def csv(self, path: Path, label: str) -> pd.DataFrame | None:
        """Read a CSV as text; None, with its faults kept, where it is no table."""
        try:
            return tables.read_table(path, label)
        except GateError as fault:
            self.faults.extend(fault.faults)
            return None

    def table(
        self, label: str, source: Source, quantities: tuple[tables.Quantity, ...], timed: bool = True
    ) -> Table | None:
        """Read one file; None, with its faults kept, where anything in it is refused."""
        before = len(self.faults) + len(self.config)
        shorts = [q.short for q in quantities]
        for key in (k for k in source.columns if k not in shorts):
            hint = nearest_name(key, shorts)
            self.refuse_config(f"{label}.columns.{key}: no such quantity{hint}", "name-unknown")
        path = self.path(source.file)
        if path is None:
            return None
        read = self._read_quickly(path, source, quantities, timed)
        if read is None:
            read = self._read_carefully(path, label, source, quantities, timed)
        if read is None:
            return None
        table = Table(path, label, *read)
        if source.time.repeats == "refuse":  # else the first row of each time is chosen below
            table = self._ordered(table)
        table = self.chosen(table, source)
        if not len(table.lines):
            return None
        self._refuse_far_times(table)
        for quantity in quantities:
            limit = SANE_LIMIT.get(quantity.kind, np.inf)
            self.refuse_rows(table, quantity.short, -limit, limit, f"beyond any {quantity.kind} of a flight")
        return table if len(self.faults) + len(self.config) == before else None

    def _read_quickly(
        self, path: Path, source: Source, quantities: tuple[tables.Quantity, ...], timed: bool
    ) -> Read | None:
        """Times, columns and lines of a large file without faults; None where the careful reader must look."""
        if timed and (source.time_column.format == "utc_hms" or source.time_column.repeats == "first"):
            return None
        places = {q.short: tables.place(q, source.declared(q.short)) for q in quantities}
        if not all(tables.fits(q, places[q.short][1]) for q in quantities):
            return None
        wanted = {places[q.short][0]: q.required or q.short in source.columns for q in quantities}
        time = source.time_column if timed else None
        found = read_numbers(path, wanted, time, self.t0, self.progress)
        if found is None or len(wanted) < len(places):
            return None
        time_s = found.time
        if time is not None and time_s is not None:
            if time.format == "seconds":
                time_s = tables.to_si(time_s.copy() if time.column in wanted else time_s, time.unit)
            if not np.isfinite(time_s).all():
                return None
        self.digests[path] = found.sha256
        held = {short: place for short, place in places.items() if place[0] in found.columns}
        if not held:
            return None
        values = {short: tables.to_si(found.columns[column], unit) for short, (column, unit) in held.items()}
        rows = len(next(iter(values.values())))
        return time_s, values, found.first_line + np.arange(rows)

    def _read_carefully(
        self, path: Path, label: str, source: Source, quantities: tuple[tables.Quantity, ...], timed: bool
    ) -> Read | None:
        """Times, columns and lines of a file read as text; what is wrong with it becomes faults."""
        frame = self.csv(path, label)
        if frame is None:
            return None
        time_s, values = None, {}
        if timed:
            time_s = tables.unordered_times_s(frame, source.time_column, self.t0, path, label, self.faults)
        for quantity in quantities:
            column = tables.column_si(frame, quantity, source.declared(quantity.short), path, label, self.faults)
            if column is not None:
                values[quantity.short] = column
        return time_s, values, frame.attrs["lines"]

    def chosen(self, table: Table, source: Source) -> Table:
        """Return the rows within the spans that flight.toml allows, with a finding for those excluded."""
        if table.time_s is None:
            return table
        time_s = table.time_s + source.time.offset_s
        table = replace(table, time_s=time_s)
        rows, findings = rows_to_use(table.label, source, time_s)
        self.findings.extend(findings)
        if rows.sum() < 2:
            span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s"
            self.refuse(
                f"{table.label}: {table.path}: use_s leaves {rows.sum()} rows of {span}; two are needed",
                "too-few-rows",
            )
        return table.of_rows(rows)

    def _ordered(self, table: Table) -> Table:
        """Rows in order of time without repeats; repairs become findings, or a fault."""
        if table.time_s is None:
            return table
        delivery = in_order(table.time_s, list(table.columns.values()), table.lines)
        if delivery.refusal:
            self.refuse(f"{table.label}: {table.path}: {delivery.refusal}", delivery.refusal.code)
        if delivery.refusal or not delivery.repairs:
            return table
        source = table.label.partition(".")[2] or table.label
        self.findings.extend(Issue(repair, "", source, repair.start_s, repair.end_s) for repair in delivery.repairs)
        rows = delivery.rows
        held = {short: column[rows] for short, column in table.columns.items()}
        return Table(table.path, table.label, table.time_s[rows], held, table.lines[rows])

    def _refuse_far_times(self, table: Table) -> None:
        """Refuse a table with a time that lies days from the rows beside it: all in between would be reconstructed."""
        if table.time_s is None or len(table.time_s) < 2:
            return
        k = int(np.argmax(np.diff(table.time_s)))
        before, after = table.time_s[k : k + 2]
        if after - before > MOST_PAUSE_S:
            self.refuse(
                f"{table.at(k + 1)}: time {after:.6g} s follows {before:.6g} s, a pause of {after - before:.3g} s; "
                f"correct or remove the row, or choose a span with use_s; at most {MOST_PAUSE_S:g} s are bridged",
                "time-far",
            )

    def refuse_rows(self, table: Table, short: str, low: float, high: float | FloatArray, words: str) -> None:
        """Refuse a column's values outside ``low`` to ``high`` (SI), naming the first's line; missing ones pass."""
        values = table.columns.get(short)
        if values is None:
            return
        if np.fmin.reduce(values) >= low and np.fmax.reduce(values) <= np.min(high):
            return
        with np.errstate(invalid="ignore"):
            wild = (values < low) | (values > high)
        if wild.any():
            k = int(np.argmax(wild))
            count = f"({int(wild.sum())} in all)"
            self.refuse(
                f"{table.at(k)}: {short} = {values[k]:.6g} (SI) is {words} {count}; check its unit or leave it empty",
                "value-range",
            )


GAP_FACTOR = 5.0  # an interval this many times the usual one is a gap
FROZEN_S, FROZEN_SAMPLES = 0.5, 10  # a column unchanged for this long, in at least so many samples, is frozen
SATURATED_SAMPLES = 5  # this many samples in a row at a column's largest or smallest value are a stop
MANY = 20  # runs of one kind that are listed one by one


def find_faults(
    source: str, time_s: FloatArray, names: tuple[str, ...], values: FloatArray, missing: BoolArray | None = None
) -> list[Issue]:
    """Findings of one sensor.

    Parameters
    ----------
    source : str
    time_s : (n,) float
    names : tuple of str
        Of the columns.
    values : (n, m) float
        NaN is missing.
    missing : (n,) bool, optional
        Rows that count as missing; where not given, those in which any value is.
    """
    if missing is None:
        missing = np.logical_or.reduce([np.isnan(column) for column in values.T])
    step = np.diff(time_s)
    wide = np.flatnonzero(step > GAP_FACTOR * float(np.median(step)))
    found = findings_of_runs(
        source, time_s, wide, wide + 1, lambda k: Issue(f"gap of {step[wide[k]]:.3f} s", "data-gap"), "gaps"
    )
    first, last = runs(missing)
    found += findings_of_runs(
        source, time_s, first, last,
        lambda k: Issue(f"{last[k] - first[k] + 1} samples missing", "samples-missing"), "missing runs",
    )  # fmt: skip
    for name, column in zip(names, values.T, strict=True):
        found += _stuck(source, time_s, name, column)
    return found


def findings_of_runs(
    source: str, time_s: FloatArray, first: IntArray, last: IntArray, words: Callable[[int], Issue], kind: str
) -> list[Issue]:
    """Findings of runs of samples ``first`` to ``last``; ``words`` of each with their code, and ``kind`` in the plural.

    Of very many the longest are listed one by one and the others together.
    """
    size = last - first + 1
    alone = np.ones(len(size), dtype=bool)
    if len(size) > MANY:
        least = np.partition(size, -MANY)[-MANY]
        alone = size > least
        alone[np.flatnonzero(size == least)[: MANY - int(alone.sum())]] = True
    chosen = np.flatnonzero(alone).tolist()
    found = [Issue(words(k), words(k).code, source, float(time_s[first[k]]), float(time_s[last[k]])) for k in chosen]
    if not alone.all():
        size, first, last = size[~alone], first[~alone], last[~alone]
        together = f"{len(size)} further {kind}, {size.sum()} samples, at most {size.max()} in a row"
        code = words(int(np.flatnonzero(~alone)[0])).code
        found.append(Issue(together, code, source, float(time_s[first[0]]), float(time_s[last[-1]])))
    return found


def runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """First and last index of each unbroken run of true."""
    inside = np.flatnonzero(mask)
    breaks = np.flatnonzero(np.diff(inside) > 1)
    if not len(inside):
        return inside, inside
    return inside[np.append(0, breaks + 1)], inside[np.append(breaks, len(inside) - 1)]


def _stuck(source: str, time_s: FloatArray, name: str, column: FloatArray) -> list[Issue]:
    """Runs of one value: long ones anywhere, shorter ones at the column's largest and smallest value."""
    # NaN is equal to nothing; a run of "equal to the sample before" begins one sample earlier
    first, last = runs(column[1:] == column[:-1])
    last = last + 1
    if not len(first):
        return []
    low, high = np.fmin.reduce(column), np.fmax.reduce(column)
    at_end = (column[first] == low) | (column[first] == high)
    saturated = at_end & (last - first + 1 >= SATURATED_SAMPLES) & (low < high)
    frozen = (time_s[last] - time_s[first] >= FROZEN_S) & (last - first + 1 >= FROZEN_SAMPLES)
    some = saturated | frozen
    first, last, saturated, frozen = first[some], last[some], saturated[some], frozen[some]

    def words(k: int) -> Issue:
        # a long run at an extreme may be either: a stop reached, or a sensor that stuck there
        both = saturated[k] and frozen[k]
        what = "frozen or saturated" if both else "frozen" if frozen[k] else "saturated"
        text = f"{name} {what} at {column[first[k]]:.6g} (SI) for {last[k] - first[k] + 1} samples"
        return Issue(text, f"data-{what.replace(' ', '-')}")

    return findings_of_runs(source, time_s, first, last, words, f"runs of one value of {name}")


FEW = 0.01  # part of the rows that may contradict others
MOSTLY = 0.5  # part of the rows of a stretch of old times that contradict, where the clock was set back
ROOM = 1.5  # a late row needs a hole of so many usual intervals among the rows that came before it
REMEDY = "keep one row of each time, or, where the clock was reset, give each stretch its own times"
NAMED = 5  # times that a finding names one by one


@dataclass(frozen=True)
class Delivery:
    """Decision on a table's rows: rows used, repairs, refusal.

    Parameters
    ----------
    rows : (k,) int
        Rows to use, in order of time.
    repairs : tuple of Issue
        What was done, from which to which time; their source is left open.
    refusal : Issue
        Why the table cannot be used; empty where it can.
    """

    rows: IntArray
    repairs: tuple[Issue, ...] = ()
    refusal: Issue = NO_FAULT


def in_order(time_s: FloatArray, values: list[FloatArray], lines: IntArray) -> Delivery:
    """Rows in the order of time, without those that repeat or contradict others.

    Parameters
    ----------
    time_s : (n,) float
        As delivered.
    values : list of (n,) float
        Everything else that was measured; NaN is missing and equal to NaN.
    lines : (n,) int
        Of the file, for the words of a refusal.
    """
    everything = np.arange(len(time_s))
    if (time_s[1:] > time_s[:-1]).all():
        return Delivery(everything)
    again, torn = _of_one_time(time_s, values)
    kept = np.setdiff1d(everything, np.concatenate([again, torn]))
    late = kept[np.append(False, time_s[kept][1:] < np.maximum.accumulate(time_s[kept])[:-1])] if len(kept) else kept
    squeezed = _without_room(time_s, kept, late)
    used = np.setdiff1d(kept, squeezed)
    if len(torn) + len(squeezed) >= FEW * len(time_s) or len(used) < 2:
        return Delivery(everything, refusal=_refusal(time_s, lines, again, torn, squeezed))
    contradicting = np.union1d(torn, squeezed)
    row = _set_back(time_s, _usual_step(time_s[kept]), contradicting)
    if row is not None:
        return Delivery(everything, refusal=_refusal_of_clock(time_s, lines, row, contradicting))
    late = np.setdiff1d(late, squeezed)
    repairs = (
        (again, "repeat earlier rows: left out", "rows-left-out"),
        (late, "came late or out of order: put in order", "rows-reordered"),
        (torn, f"give different values for one time ({_times(time_s, torn)}): none of them is used", "rows-contradict"),
        (squeezed, "came late where earlier rows leave no room: not used", "rows-contradict"),
    )
    findings = tuple(
        Issue(f"{_blocks(k)} {words}", code, "", float(time_s[k].min()), float(time_s[k].max()))
        for k, words, code in repairs
        if len(k)
    )
    return Delivery(used[np.argsort(time_s[used], kind="stable")], findings)


def _of_one_time(time_s: FloatArray, values: list[FloatArray]) -> tuple[IntArray, IntArray]:
    """Rows that repeat an earlier one, and all rows of the times at which rows differ; both as delivered."""
    rows = pd.DataFrame(np.column_stack([time_s, *values]))
    again = rows.duplicated()
    times = rows.loc[~again, 0]
    torn = rows[0].isin(times[times.duplicated()])
    return np.flatnonzero(again & ~torn), np.flatnonzero(torn)


def _without_room(time_s: FloatArray, kept: IntArray, late: IntArray) -> IntArray:
    """Late rows that fall between two earlier rows at their usual spacing, so that no row was missing there."""
    if not len(late):
        return late
    times = time_s[kept]
    usual = _usual_step(times)
    before, after = _neighbours_that_came_before(times)
    inside = (before >= 0) & (after >= 0)
    hole = np.where(inside, times[after] - times[before], np.inf)
    return np.intersect1d(kept[hole < ROOM * usual], late)


def _usual_step(times: FloatArray) -> float:
    """Median step between consecutive rows; infinite if there are none."""
    steps = np.diff(times)
    # in what was shuffled row by row the steps as delivered say nothing
    steps = np.diff(np.sort(times)) if (steps < 0.0).sum() > 0.25 * len(steps) else steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else np.inf


def _set_back(time_s: FloatArray, usual: float, contradicting: IntArray) -> int | None:
    """Row at which the clock is set back: time steps back onto conflicting rows and then runs beyond them; or None."""
    top = np.maximum.accumulate(time_s)
    old = np.append(False, time_s[1:] <= top[:-1])
    doubtful = np.isin(np.arange(len(time_s)), contradicting)
    for first, last in zip(*runs(old), strict=True):
        goes_on = last + 1 < len(time_s) and time_s[last + 1] - time_s[last] < ROOM * usual
        back = time_s[first] < time_s[first - 1]
        if goes_on and back and doubtful[first : last + 1].mean() >= MOSTLY:
            return int(first)
    return None


def _neighbours_that_came_before(times: FloatArray) -> tuple[IntArray, IntArray]:
    """For each row the nearest in time on either side among the rows above it; -1 for none."""
    order = np.argsort(times, kind="stable")
    before, after = np.full(len(times), -1), np.full(len(times), -1)
    for way, found in ((order, before), (order[::-1], after)):
        above: list[int] = []  # rows in the order of time, of which none hides another
        for row in way.tolist():
            while above and above[-1] > row:
                above.pop()
            if above:
                found[row] = above[-1]
            above.append(row)
    return before, after


def _refusal_of_clock(time_s: FloatArray, lines: IntArray, row: int, contradicting: IntArray) -> Issue:
    """Why a table is refused whose clock was set back in ``row``."""
    later = contradicting[contradicting >= row]
    words = (
        f"{_backwards(time_s, lines, row)}, and the rows run on from there as after a reset clock ({len(later)} of "
        f"them contradict earlier ones, all later ones may have wrong times); {REMEDY}"
    )
    return Issue(words, "clock-set-back")


def _backwards(time_s: FloatArray, lines: IntArray, row: int) -> str:
    step = f"{time_s[row - 1]:.6f} s then {time_s[row]:.6f} s"
    return f"line {int(lines[row])}: time runs backwards or repeats: {step}"


def _refusal(time_s: FloatArray, lines: IntArray, again: IntArray, torn: IntArray, squeezed: IntArray) -> Issue:
    """Why the table is refused, with the first line at fault."""
    if len(torn) and len(torn) >= len(squeezed):
        instants, first = np.unique(time_s[torn], return_index=True)
        row = int(np.setdiff1d(torn, torn[first])[0])
        other = int(torn[first[np.searchsorted(instants, time_s[row])]])
        words = f"with other values than in line {int(lines[other])} ({len(torn)} such rows in all)"
        return Issue(f"{_backwards(time_s, lines, row)}, {words}; {REMEDY}", "rows-contradict")
    if len(squeezed):
        words = f"where earlier rows leave no room ({len(squeezed)} such rows in all)"
        return Issue(f"{_backwards(time_s, lines, int(squeezed[0]))}, {words}; {REMEDY}", "rows-contradict")
    words = (
        f"{_backwards(time_s, lines, int(again[0]))}, with the same values throughout: fewer than two different rows"
    )
    return Issue(words, "too-few-rows")


def _blocks(rows: IntArray) -> str:
    """Phrase with the number of rows and of the file's unbroken blocks that they form."""
    if not len(rows):
        return ""
    inside = np.zeros(int(rows[-1]) + 1, dtype=bool)
    inside[rows] = True
    blocks = len(runs(inside)[0])
    return f"{len(rows)} row{'s' * (len(rows) > 1)} in {blocks} block{'s' * (blocks > 1)}"


def _times(time_s: FloatArray, rows: IntArray) -> str:
    times = np.unique(time_s[rows])
    return (
        ", ".join(f"{t:.6f}" for t in times[:NAMED]) + " s" + f" and {len(times) - NAMED} more" * (len(times) > NAMED)
    )


def rows_to_use(label: str, source: Source, time_s: FloatArray) -> tuple[BoolArray, list[Issue]]:
    """Rows to use (n,), and a finding for each reason why others are not."""
    name = label.rsplit(".", 1)[-1]
    findings = []
    use = np.diff(time_s, prepend=-np.inf) > 0.0
    if not use.all():
        again = time_s[~use]
        words = f"{len(again)} rows repeat the time of the row before and are left out, as time.repeats asks"
        findings.append(Issue(words, "rows-left-out", name, float(again[0]), float(again[-1])))
    if source.use_s is not None:
        inside = np.any([(time_s >= start) & (time_s <= stop) for start, stop in source.use_s], axis=0)
        left = int((use & ~inside).sum())
        if left:
            spans = ", ".join(f"{start:g} to {stop:g} s" for start, stop in source.use_s)
            words = f"{left} of {int(use.sum())} rows lie outside use_s ({spans}) and are left out"
            findings.append(Issue(words, "rows-outside-span", name))
        use &= inside
    return use, findings


def oversampled(
    name: str, time_s: FloatArray, thinning: tuple[ThinnedSpan, ...], components: tuple[str, ...]
) -> list[Issue]:
    """Findings that count a tracker's rows that are predicted and not used, by component."""
    idle = {c: int((~spaced(time_s, spacing_s(thinning, time_s, c))).sum()) for c in components}
    if not any(idle.values()):
        return []
    counts = set(idle.values())
    rows = str(counts.pop()) if len(counts) == 1 else ", ".join(f"{count} ({c})" for c, count in idle.items() if count)
    spacings = "; ".join(sorted({f"{s.every_s:g} s" for s in thinning if s.every_s > 0.0}))
    words = f"{rows} of {len(time_s)} rows lie closer than every_s = {spacings}: they are predicted and not used"
    return [Issue(words, "samples-averaged", name)]

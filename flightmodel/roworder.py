"""In which order do the rows of a table belong, and which are not to be believed? Data as ranges deliver them.

Telemetry comes in packets: a row or a whole block may come twice, late, or in the wrong order. Rows that repeat an
earlier one (time and every value) are left out; rows out of order are put in order. Two kinds of rows contradict
others: those of one time with different values, and late ones for which there is no room, because rows that came before
stand there at their usual interval (a clock that was reset lays one stretch of the flight over another so). A few of
them are left out: of one time all, for nobody can say which is right. With `FEW` of the rows or more the table is
refused. It is refused with fewer, too, where a late block contradicts and the rows run on from it into new times at
their usual interval: what was sent late ends with a jump forward, a clock that was set back does not, and then all
that follows has wrong times. Nothing of it happens in silence: each repair has its words, its number of rows and
blocks, and its times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.columns import IntArray
from flightmodel.findings import runs

FEW = 0.01  # part of the rows that may contradict others
MOSTLY = 0.5  # part of the rows of a stretch of old times that contradict, where the clock was set back
ROOM = 1.5  # a late row needs a hole of so many usual intervals among the rows that came before it
REMEDY = "keep one row of each time, or, where the clock was reset, give each stretch its own times"
NAMED = 5  # times that a finding names one by one


@dataclass(frozen=True)
class Delivery:
    """What becomes of a table's rows.

    Parameters
    ----------
    rows : (k,) int
        Rows to use, in order of time.
    repairs : tuple of (str, float, float)
        What was done, from which to which time, s.
    refusal : str
        Why the table cannot be used; empty where it can.
    """

    rows: IntArray
    repairs: tuple[tuple[str, float, float], ...] = ()
    refusal: str = ""


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
        (again, f"{_blocks(again)} repeat earlier rows: left out"),
        (late, f"{_blocks(late)} came late or out of order: put in order"),
        (torn, f"{_blocks(torn)} give different values for one time ({_times(time_s, torn)}): none of them is used"),
        (squeezed, f"{_blocks(squeezed)} came late where earlier rows leave no room: not used"),
    )
    told = tuple((words, float(time_s[k].min()), float(time_s[k].max())) for k, words in repairs if len(k))
    return Delivery(used[np.argsort(time_s[used], kind="stable")], told)


def _of_one_time(time_s: FloatArray, values: list[FloatArray]) -> tuple[IntArray, IntArray]:
    """Rows that repeat an earlier one, and all rows of the times at which rows differ; both as delivered."""
    order = np.argsort(time_s, kind="stable")
    same = np.diff(time_s[order]) == 0.0
    equal = same.copy()
    for column in values:
        one, other = column[order[:-1][equal]], column[order[1:][equal]]
        equal[equal] = (one == other) | (np.isnan(one) & np.isnan(other))
    instant = np.append(0, np.cumsum(~same))
    torn = np.isin(instant, instant[1:][same & ~equal])
    again = np.append(False, same) & ~torn
    return np.sort(order[again]), np.sort(order[torn])


def _without_room(time_s: FloatArray, kept: IntArray, late: IntArray) -> IntArray:
    """Late rows between two rows that came before them and stand at their usual interval."""
    if not len(late):
        return late
    times = time_s[kept]
    usual = _usual_step(times)
    before, after = _neighbours_that_came_before(times)
    inside = (before >= 0) & (after >= 0)
    hole = np.where(inside, times[after] - times[before], np.inf)
    return np.intersect1d(kept[hole < ROOM * usual], late)


def _usual_step(times: FloatArray) -> float:
    """Median step between rows that follow each other; infinite where there are none."""
    steps = np.diff(times)
    # in what was shuffled row by row the steps as delivered say nothing
    steps = np.diff(np.sort(times)) if (steps < 0.0).sum() > 0.25 * len(steps) else steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else np.inf


def _set_back(time_s: FloatArray, usual: float, contradicting: IntArray) -> int | None:
    """Row at which time steps back onto rows that it contradicts, and from which it runs on beyond them; or None."""
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


def _refusal_of_clock(time_s: FloatArray, lines: IntArray, row: int, contradicting: IntArray) -> str:
    """Why a table is refused whose clock was set back in ``row``."""
    later = contradicting[contradicting >= row]
    return (
        f"{_backwards(time_s, lines, row)}, and the rows run on from there as after a reset clock ({len(later)} of "
        f"them contradict earlier ones, all later ones may have wrong times); {REMEDY}"
    )


def _backwards(time_s: FloatArray, lines: IntArray, row: int) -> str:
    step = f"{time_s[row - 1]:.6f} s then {time_s[row]:.6f} s"
    return f"line {int(lines[row])}: time runs backwards or repeats: {step}"


def _refusal(time_s: FloatArray, lines: IntArray, again: IntArray, torn: IntArray, squeezed: IntArray) -> str:
    """Why the table is refused, with the first line at fault."""
    if len(torn) and len(torn) >= len(squeezed):
        instants, first = np.unique(time_s[torn], return_index=True)
        row = int(np.setdiff1d(torn, torn[first])[0])
        other = int(torn[first[np.searchsorted(instants, time_s[row])]])
        words = f"with other values than in line {int(lines[other])} ({len(torn)} such rows in all)"
        return f"{_backwards(time_s, lines, row)}, {words}; {REMEDY}"
    if len(squeezed):
        words = f"where earlier rows leave no room ({len(squeezed)} such rows in all)"
        return f"{_backwards(time_s, lines, int(squeezed[0]))}, {words}; {REMEDY}"
    return f"{_backwards(time_s, lines, int(again[0]))}, with the same values throughout: fewer than two different rows"


def _blocks(rows: IntArray) -> str:
    """How many rows in how many unbroken blocks of the file."""
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

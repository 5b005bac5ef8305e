"""What second of the flight does a clock's text mean? ISO 8601 in UTC, or IRIG day of year, to seconds after t0.

Day-of-year times ``DDD:HH:MM:SS.fff`` lie in t0's year, or in the next one where that is nearer (a flight across New
Year). Cells of the usual width are read many at a time; others, one by one, to the same number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray

_IRIG = re.compile(r"^(\d{1,3}):(\d{2}):(\d{2}):(\d{2}(?:\.\d*)?)$", re.ASCII)
_COLONS, _POINT, _WIDEST = [3, 6, 9], 12, 22  # where the usual form has them; so many digits are exact in float64
HALF_YEAR_S = 183 * 86400.0


def clock_times(cells: Sequence[str], form: str, t0: datetime) -> FloatArray:
    """Seconds after t0 of ``utc`` or ``irig_doy`` times; NaN where a cell does not parse."""
    if form == "irig_doy":
        out = _irig_times(cells, t0)
    else:
        stamps = pd.DatetimeIndex(pd.to_datetime(list(cells), utc=True, errors="coerce", format="ISO8601"))
        out = (stamps - pd.Timestamp(t0)).total_seconds().to_numpy(dtype=float)
    # clocks are written to a microsecond at best: remove the rounding of the large offset
    return np.round(out, 7)


def _irig_times(cells: Sequence[str], t0: datetime) -> FloatArray:
    out = np.full(len(cells), np.nan)
    widths = np.array([len(cell) for cell in cells])
    for width in np.unique(widths).tolist():
        rows = np.flatnonzero(widths == width)
        usual = np.zeros(len(rows), dtype=bool)
        if _POINT <= width <= _WIDEST:
            try:
                table = np.array([cells[k] for k in rows.tolist()], dtype=f"S{width}")
            except UnicodeEncodeError:
                table = np.full(len(rows), b"?" * width)
            usual, seconds = _usual_irig(table.view(np.uint8).reshape(-1, width), t0)
            out[rows[usual]] = seconds
        for k in rows[~usual].tolist():
            match = _IRIG.match(cells[k])
            if match:
                day, hour, minute = (np.array([float(match[part])]) for part in (1, 2, 3))
                out[k] = _seconds(day, hour, minute, np.array([float(match[4])]), t0)[0]
    return out


def _usual_irig(table: np.ndarray, t0: datetime) -> tuple[np.ndarray, FloatArray]:
    """Which rows of characters have the usual form, and their seconds after t0."""
    width = table.shape[1]
    marks = [*_COLONS, _POINT] if width > _POINT else _COLONS
    digits = np.delete(table, marks, axis=1).astype(np.int64) - ord("0")
    usual = np.all(table[:, _COLONS] == ord(":"), axis=1) & np.all((digits >= 0) & (digits <= 9), axis=1)
    if width > _POINT:
        usual &= table[:, _POINT] == ord(".")
    digits = digits[usual]

    def number(first: int, last: int) -> FloatArray:
        return (digits[:, first:last] @ 10 ** np.arange(last - first - 1, -1, -1)).astype(float)

    last = digits.shape[1]
    second = number(7, last) / 10.0 ** (last - 9)
    return usual, _seconds(number(0, 3), number(3, 5), number(5, 7), second, t0)


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

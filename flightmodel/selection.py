"""Which rows of a table are used: those inside the spans that flight.toml states, and of repeated times the first.

Times are those after ``time.offset_s`` was added. Of an oversampled tracker's rows some are read but only predicted.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.sources import Source
from flightmodel.telemetry import Finding


def rows_to_use(label: str, source: Source, time_s: FloatArray) -> tuple[BoolArray, list[Finding]]:
    """Rows to use (n,), and a finding for each reason why others are not."""
    name = label.rsplit(".", 1)[-1]
    findings = []
    use = np.diff(time_s, prepend=-np.inf) > 0.0
    if not use.all():
        again = time_s[~use]
        words = f"{len(again)} rows repeat the time of the row before and are left out, as time.repeats says"
        findings.append(Finding(name, words, float(again[0]), float(again[-1])))
    if source.use_s is not None:
        inside = np.any([(time_s >= start) & (time_s <= stop) for start, stop in source.use_s], axis=0)
        left = int((use & ~inside).sum())
        if left:
            spans = ", ".join(f"{start:g} to {stop:g} s" for start, stop in source.use_s)
            words = f"{left} of {int(use.sum())} rows lie outside use_s ({spans}) and are left out"
            findings.append(Finding(name, words, np.nan, np.nan))
        use &= inside
    return use, findings


def spaced(time_s: FloatArray, every_s: float) -> BoolArray:
    """Rows (n,) that keep at least ``every_s`` from the one kept before, the first among them; all of them for 0."""
    if every_s <= 0.0:
        return np.ones(len(time_s), dtype=bool)
    keep = np.zeros(len(time_s), dtype=bool)
    next_s = -np.inf
    for k, t in enumerate(time_s.tolist()):
        if t >= next_s - 1e-6:
            keep[k], next_s = True, t + every_s
    return keep


def oversampled(name: str, time_s: FloatArray, every_s: float) -> list[Finding]:
    """Say how many of a tracker's rows only check the trajectory."""
    idle = int((~spaced(time_s, every_s)).sum())
    if not idle:
        return []
    words = f"{idle} of {len(time_s)} rows lie closer than every_s = {every_s:g} s: they check the trajectory, no more"
    return [Finding(name, words, np.nan, np.nan)]

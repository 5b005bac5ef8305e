"""Which rows of a table are used: those inside the spans that flight.toml states, and of repeated times the first.

Times are those after ``time.offset_s`` was added.
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

"""Findings of a sensor's samples: every run with its place, and of very many the longest and a sum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flightmodel import gate
from flightmodel.checks import Issue
from flightmodel.gate import find_faults, findings_of_runs, runs
from tests.refusing import numbers_in


@given(hnp.arrays(bool, st.integers(0, 40)))
def test_runs_are_those_that_one_would_count(mask):
    wanted, start = [], None
    for k, inside in enumerate([*mask.tolist(), False]):
        if inside and start is None:
            start = k
        elif not inside and start is not None:
            wanted.append((start, k - 1))
            start = None
    first, last = runs(mask)
    assert list(zip(first.tolist(), last.tolist(), strict=True)) == wanted


def equal_runs(column):
    """Runs of equal values, counted sample by sample."""
    start = 0
    for k in range(1, len(column) + 1):
        if k == len(column) or column[k] != column[k - 1]:
            if k - start > 1:
                yield start, k - 1
            start = k


@settings(max_examples=200)
@given(hnp.arrays(float, st.integers(2, 60), elements=st.sampled_from([0.0, 1.0, 2.0, np.nan])))
def test_stuck_runs_are_those_that_one_would_count(column):
    time_s = np.arange(len(column)) * 0.1
    known = column[~np.isnan(column)]
    wanted = []
    for a, b in equal_runs(column):
        frozen = b - a + 1 >= 10 and time_s[b] - time_s[a] >= 0.5
        saturated = b - a + 1 >= 5 and np.ptp(known) > 0.0 and column[a] in (known.min(), known.max())
        if frozen or saturated:
            what = "frozen-or-saturated" if frozen and saturated else "frozen" if frozen else "saturated"
            wanted.append((f"data-{what}", [column[a], b - a + 1], time_s[a], time_s[b]))
    found = find_faults("sensor", time_s, ("x",), column[:, None], np.zeros(len(column), dtype=bool))
    assert [(f.code, numbers_in(f.what), f.start_s, f.end_s) for f in found] == wanted


@pytest.mark.parametrize("count", [3, gate.MANY, gate.MANY + 1, 500])
def test_of_very_many_the_longest_are_told_and_the_others_together(count):
    rng = np.random.default_rng(count)
    length = rng.integers(1, 40, size=count)
    first = np.cumsum(np.append(5, length[:-1] + rng.integers(1, 9, size=count - 1)))
    last = first + length - 1
    time_s = np.arange(last[-1] + 1) * 0.01
    found = findings_of_runs("s", time_s, first, last, lambda k: Issue(f"{length[k]} samples", "run"), "runs")
    alone = found[: gate.MANY]
    assert len(alone) == min(count, gate.MANY)
    assert [f.start_s for f in alone] == sorted(f.start_s for f in alone)
    assert sorted(int(f.what.split()[0]) for f in alone) == sorted(length)[-len(alone) :]
    if count > gate.MANY:
        others = sorted(length)[: -gate.MANY]
        assert len(found) == gate.MANY + 1
        assert numbers_in(found[-1].what) == [len(others), sum(others), others[-1]]
    else:
        assert len(found) == count


def test_a_table_full_of_holes_gives_a_list_that_one_can_read():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(20000, 3))
    values[rng.random(values.shape) < 0.05] = np.nan
    found = find_faults("sensor", np.arange(20000) * 0.01, ("x", "y", "z"), values)
    assert len(found) == gate.MANY + 1
    samples = sum(int(f.what.split()[0]) for f in found[:-1]) + int(found[-1].what.split("runs, ")[1].split()[0])
    assert samples == np.isnan(values).any(axis=1).sum()

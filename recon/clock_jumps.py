"""Did an inertial sensor's clock jump ahead where its record seems to lack samples?

A clock that jumps ahead leaves a gap like any other, but behind it all tags are late by the gap (or all before it were
early, where the clock was set right). Of each short gap that may be asked: the trackers tell the likelihood of so late
a clock from there on against that of none (`recon.shock`, with the clock's column in place of a bias's), and the
vehicle's swinging (`recon.triad_clocks`) tells what one triad's clock did against the other's, where they have not one
clock. Where both together say a thousand to one that it jumped, the tags are set back.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.telemetry import Finding, TriadRecord
from recon.ekf import ForwardPass
from recon.gaps import Bridged, usual_steps
from recon.problem import Problem
from recon.shock import AGAINST, window_scores
from recon.state import KINEMATIC, States
from recon.triad_clocks import LONGEST_LAG_S, lag_between

SHORTEST_S = 0.004
PART = 0.5  # of a usual step that a step is longer
MOST = 8  # gaps that are asked about, the longest


class ClockJump(NamedTuple):
    """Tags that jump ahead ``by_s`` at ``at_s``, mid-gap; late ones come ``after`` it, or early ones before.

    ``triads`` that jump together: 0 the accelerometer, 1 the gyros.
    """

    triads: tuple[int, ...]
    at_s: float
    by_s: float
    after: bool = True


def jumps_of_clocks(
    problem: Problem, run: ForwardPass, records: tuple[TriadRecord, TriadRecord], bridges: tuple[Bridged, Bridged]
) -> tuple[ClockJump, ...]:
    """Gaps that are jumps of a clock, in order of time.

    Parameters
    ----------
    problem : Problem
    run : ForwardPass
        In which all tags were believed.
    records, bridges : (accelerometer, gyros)
        As delivered, and as the run took them.
    """
    gaps = [g for g in _gaps(records) if problem.time_s[0] < g.at_s < problem.time_s[-1] - g.by_s]
    told, path = _by_trackers(problem, run, gaps), run.states()
    edges = [-np.inf, *(g.at_s for g in gaps), np.inf]
    out = []
    for k, gap in enumerate(gaps):
        likely = told[k] + _by_swinging(gap, edges[k], edges[k + 2], bridges, path, problem.time_s)
        if likely.max() > AGAINST:
            out.append(gap._replace(after=bool(likely[0] >= likely[1])))
    return tuple(out)


def mended(record: TriadRecord, triad: int, jumps: tuple[ClockJump, ...]) -> TriadRecord:
    """Record whose tags are set back, or forward, beyond its jumps."""
    t = record.time_s.copy()
    for jump in (j for j in jumps if triad in j.triads):
        later = record.time_s > jump.at_s
        t += np.where(later, -jump.by_s, 0.0) if jump.after else np.where(later, 0.0, jump.by_s)
    return replace(record, time_s=t)


def jump_findings(jumps: tuple[ClockJump, ...], names: tuple[str, str]) -> list[Finding]:
    """One finding for each sensor and jump."""
    out = []
    for jump in jumps:
        words = f"time tags jump {1e3 * jump.by_s:.1f} ms ahead while no sample is missing: those "
        words += "behind it were set back" if jump.after else "before it were set forward"
        span = jump.at_s - 0.5 * jump.by_s, jump.at_s + 0.5 * jump.by_s
        out += [Finding(names[triad], words, *span) for triad in jump.triads]
    return out


def _gaps(records: tuple[TriadRecord, TriadRecord]) -> list[ClockJump]:
    """Short gaps of either triad or, at one time, of both."""
    found = []
    for triad, record in enumerate(records):
        step = np.diff(record.time_s)
        usual = usual_steps(step)
        longer = step - usual
        for k in np.flatnonzero((longer > PART * usual) & (longer > SHORTEST_S) & (longer < LONGEST_LAG_S)):
            found.append(ClockJump((triad,), float(record.time_s[k] + 0.5 * step[k]), float(longer[k])))
    out: list[ClockJump] = []
    for gap in sorted(found, key=lambda g: g.at_s):
        last = out[-1] if out else None
        if last is not None and gap.at_s - last.at_s < 0.5 * min(gap.by_s, last.by_s) and gap.triads != last.triads:
            out[-1] = last._replace(triads=(0, 1), by_s=0.5 * (last.by_s + gap.by_s))
        else:
            out.append(gap)
    longest = sorted(out, key=lambda g: -g.by_s)[:MOST]
    return sorted(longest, key=lambda g: g.at_s)


def _by_trackers(problem: Problem, run: ForwardPass, gaps: list[ClockJump]) -> FloatArray:
    """Logarithm of the likelihood (g, 2) of late tags after, and of early ones before each gap, against neither."""
    out = np.zeros((len(gaps), 2))
    if not gaps or not problem.motion.clocks or problem.model.wander.considered.any():
        return out
    columns = KINEMATIC + np.array([18, 19])
    nodes = np.searchsorted(problem.time_s, [g.at_s for g in gaps]).astype(np.int64)
    first, last = np.zeros_like(nodes), np.full_like(nodes, len(problem.time_s) - 1)
    both = (window_scores(problem, run, nodes, last, columns), window_scores(problem, run, first, nodes, columns))
    for side, (sign, (score, variance)) in enumerate(zip((1.0, -1.0), both, strict=True)):
        for k, gap in enumerate(gaps):
            offset = np.zeros(2)
            offset[list(gap.triads)] = sign * gap.by_s
            out[k, side] = -score[k] @ offset - 0.5 * offset @ variance[k] @ offset
    return out


def _by_swinging(
    gap: ClockJump, from_s: float, to_s: float, bridges: tuple[Bridged, Bridged], path: States, time_s: FloatArray
) -> float:
    """Logarithm of the likelihood that one clock jumped against the other, over that of none."""
    if len(gap.triads) > 1:
        return 0.0
    before = lag_between(*bridges, path, time_s, from_s, gap.at_s - gap.by_s)
    after = lag_between(*bridges, path, time_s, gap.at_s + gap.by_s, to_s)
    if before is None or after is None:
        return 0.0
    jumped = gap.by_s if gap.triads == (0,) else -gap.by_s
    return ((after.lag_s - before.lag_s) * jumped - 0.5 * jumped**2) / (after.sd_s**2 + before.sd_s**2)

"""A joint with freeplay: the fit of a spring that has a dead band.

Within the band nothing holds the shell and the derivatives say nothing of what lies beyond it. So the first steps fly a
band whose corners are rounded over all its width, and sharpen it as the standard deviations narrow (continuation). The
shell's bending at the starts comes from a plain joint's first, wide steps: the moment is known from them, and with it
by how much further a looser joint is bent. The fit begins where air loads the joint (`observe`).

A span may still settle on a false path, on which the shell strikes the band's edge elsewhere. Before each step every
span is therefore tried from where the one before it ended, and where false paths are left, they are fitted once more
from wide standard deviations, or from another freeplay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flightmodel.checks import FloatArray
from postflight.pipeline import Flight
from postflight.reconciliation.candidate import FREEPLAY_SD_RAD
from postflight.reconciliation.fit import Progress, Reconciled, in_fine_air, problem_of, solve
from postflight.reconciliation.observed import Observed
from postflight.reconciliation.problem import Problem, Unknowns
from postflight.reconciliation.spans import BENDING
from postflight.reconciliation.steps import step_from

# widening of the standard deviations, and corner's half width over the freeplay
EARLY = ((30.0, 1.0), (10.0, 0.5), (3.0, 0.3), (3.0, 0.1), (1.0, 0.1), (1.0, 0.05))
PLAIN_STEPS = 2
STARTS_RAD = np.deg2rad([0.25, 0.5, 0.1])
AGAIN = (30.0, 10.0, 3.0)
FALSE_COST, LEAST_GAIN = 150.0, 10.0  # of a span's 60 readings with both its joins; of a new start


def reconcile_loose(
    flight: Flight, observed: Observed, laws: tuple[str, ...] = ("freeplay",), progress: Progress | None = None
) -> Reconciled:
    """Fit a joint with freeplay, and what else ``laws`` of `candidate.LAWS` name, to the loaded part of a flight.

    Raises
    ------
    DivergenceError
        Where no candidate flies through.
    """
    report = progress or (lambda _fraction, _what: None)
    problem = problem_of(flight, observed, laws)
    plain = problem_of(flight, observed, tuple(law for law in laws if law != "freeplay"))
    first = plain.start()
    for _ in range(PLAIN_STEPS):
        first = step_from(replace(plain, wider=EARLY[0][0]), first).to
    early = [replace(problem, wider=wider, unknown=replace(problem.unknown, corner=corner)) for wider, corner in EARLY]
    found: list[Reconciled] = []
    share = 0.7 / len(STARTS_RAD)
    for k, freeplay_rad in enumerate(STARTS_RAD.tolist()):

        def part(f: float, what: str, k: int = k) -> None:
            report((k + f) * share, what)

        at = solve(problem, loosened(problem, first, freeplay_rad, EARLY[0][1]), early, part, rejoined)
        found.append(_again(at))
        if not false_spans(found[-1]).any():
            break

    def then(fraction: float, what: str) -> None:
        report(0.7 + 0.3 * fraction, what)

    return in_fine_air(min(found, key=lambda each: each.residuals.cost), then, rejoined)


def _again(found: Reconciled) -> Reconciled:
    """Fit once more with false spans and their neighbours wide at first."""
    false = false_spans(found)
    if not false.any():
        return found
    near = np.convolve(false, np.ones(3), "same") > 0.5
    early = [replace(found.problem, wider=np.where(near, wider, 1.0)) for wider in AGAIN]
    return min(found, solve(found.problem, found.unknowns, early, mend=rejoined), key=lambda each: each.residuals.cost)


def false_spans(found: Reconciled) -> FloatArray:
    """Which spans (s,) are far from their readings or from their neighbours."""
    return np.asarray(_local_cost(found.residuals.sensors, found.residuals.joins) > FALSE_COST)


def _local_cost(sensors: FloatArray, joins: FloatArray) -> FloatArray:
    """Sum of squares (s,) of each span's sensors and of both its joins."""
    joined = (joins**2).sum(axis=1)
    return np.asarray((sensors**2).sum(axis=(1, 2)) + np.append(joined, 0.0) + np.append(0.0, joined))


def loosened(problem: Problem, plain: Unknowns, freeplay_rad: float, corner: float) -> Unknowns:
    """Return what a plain joint's fit found, bent as much further as a joint with so much freeplay."""
    bending = plain.motion[:, BENDING].copy()
    half = corner * freeplay_rad
    size = np.linalg.norm(bending[:, 1:], axis=1)
    # where the rounded band gives the plain joint's moment
    bent = np.where(size < half, freeplay_rad - half + 2.0 * np.sqrt(half * size), size + freeplay_rad)
    bending[:, 1:] *= (bent / np.maximum(size, 1e-9))[:, None]
    motion = plain.motion.copy()
    motion[:, BENDING] = bending
    k = problem.unknown.names.index("freeplay")
    return replace(plain, vehicle=np.insert(plain.vehicle, k, freeplay_rad / FREEPLAY_SD_RAD), motion=motion)


def rejoined(problem: Problem, u: Unknowns) -> Unknowns:
    """Every span from where the one before it ended, if that explains it better; of neighbours one only."""
    read = problem.predicted(u)
    ended = u.motion.copy()
    ended[1:] = read.end[:-1]
    now, then = problem.residuals(u, read), problem.predicted(replace(u, motion=ended))
    following = (then.end[:-1] - u.motion[1:]) * problem.join_weight
    sensors = problem.residuals(replace(u, motion=ended), then).sensors
    after = (sensors**2).sum(axis=(1, 2)) + np.append((following**2).sum(axis=1), 0.0)
    gain = _local_cost(now.sensors, now.joins) - after
    gain[0] = 0.0
    motion = u.motion.copy()
    for k in np.argsort(-gain):
        if gain[k] > LEAST_GAIN and gain[k] >= gain[max(k - 1, 0) : k + 2].max():
            motion[k] = ended[k]
    moved = replace(u, motion=motion)
    return moved if problem.residuals(moved).cost < now.cost else u

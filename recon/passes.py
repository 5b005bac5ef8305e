"""Filter and smooth until it stays: thinned data about the filter's own estimate, then all about the smoothed one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon import ekf, smoother, startup, strapdown
from recon.disturbance import Disturbance, disturbed, is_lost, widened
from recon.problem import Problem
from recon.settings import Settings
from recon.smoother import Smoothed
from recon.state import ROTATION, States

Progress = Callable[[float, str], None]
THINNED_STEP_S = 0.5
MOST_THINNED_PASSES = 6
FARTHEST_SD = 3.0
SETTLED_RAD = 0.01  # second-order terms of a rotation this small are 5e-5 of what it does
SETTLED_SD = 0.01  # a pass that moves nothing by more than this part of its sd needs no other


def iterate(
    problem: Problem, settings: Settings, report: Progress
) -> tuple[ekf.ForwardPass, Smoothed, States, int, tuple[Disturbance, ...]]:
    """Filter and smooth: last forward pass, smoothed errors and states, how often it ran, disturbances."""
    reference = None
    found: tuple[Disturbance, ...] = ()
    if settings.passes > 0:
        report(0.02, "first passes on thinned data")
        reference, found = first_reference(problem, settings)
    most = max(1, settings.passes)
    for i in range(most):
        share = 0.85 / most
        report(0.1 + share * i, f"filter, pass {i + 1}")
        run, found = follow_track(problem, reference, settings, found)
        report(0.1 + share * (i + 0.6), f"smoother, pass {i + 1}")
        smoothed = smoother.smooth(problem, run, True, settings.smoother, settings.engine)
        kept = np.flatnonzero(problem.kept)
        moved = np.abs(smoothed.x[kept]) / np.sqrt(np.maximum(smoothed.variance, 1e-300))
        smoothed_states = smoothed.states(run.charts)
        if moved.max() < SETTLED_SD:
            break
        reference = likely(problem, smoothed_states)
    return run, smoothed, smoothed_states, i + 1, found


def follow_track(
    problem: Problem, reference: States | None, settings: Settings, found: tuple[Disturbance, ...]
) -> tuple[ekf.ForwardPass, tuple[Disturbance, ...]]:
    """Forward pass with as many disturbances as it takes to follow the track, and these."""
    while True:
        run = ekf.forward(disturbed(problem, found), reference, settings.engine)
        more = widened(found, problem, run)
        if more is None:
            return run, found
        found = more


def likely(problem: Problem, states: States) -> States:
    """States to linearise about: drivers of ballistic flight no farther than `FARTHEST_SD` from what was stated.

    Drag enters as its logarithm. Seen from a thin, fast flight a parachute asks for a thousandfold drag, and about that
    the next pass would be stiff and far from any truth; any point serves that later passes bring nearer.
    """
    if not problem.motion.ballistic:
        return states
    errors, count = states.sensor_errors.copy(), problem.motion.drivers
    limit = FARTHEST_SD * problem.model.prior_sd[:count]
    errors[:, :count] = np.clip(errors[:, :count], -limit, limit)
    return replace(states, sensor_errors=errors)


def first_reference(problem: Problem, settings: Settings) -> tuple[States, tuple[Disturbance, ...]]:
    """Smoothed states at all nodes from a point of each source every `THINNED_STEP_S`, iterated until they stay."""
    thinned, kept = problem.thinned(THINNED_STEP_S)
    reference = None
    found: tuple[Disturbance, ...] = ()
    for k in range(MOST_THINNED_PASSES):
        run, found = follow_track(thinned, reference, settings, found)
        if k == 0 and problem.motion.ballistic and is_lost(thinned, run):
            # a gap so long that the filter came out of it somewhere else: tracking alone tells where it is
            reference = startup.along_track(problem.instruments, thinned.time_s, problem.model.size)
            run, found = follow_track(thinned, reference, settings, ())
        smoothed = smoother.smooth(thinned, run, False, "rauch-tung-striebel", settings.engine)
        moved = np.abs(smoothed.x[:, ROTATION]).max() if reference is not None else np.inf
        reference = likely(problem, smoothed.states(run.charts))
        if moved < SETTLED_RAD:
            break
    assert reference is not None
    return strapdown.fill_between(problem.motion, problem.node_index, kept, reference), found

"""About which trajectory is the first pass through all data linearised?

Thinned data are filtered about the filter's own estimate and smoothed, until rotations converge. That finds the
trajectory where the filter's prediction is nearly right whenever data arrive. Of a spinning vehicle it is not: a scale
error ``s`` of the gyro along the spin axis turns the attitude by ``s phi`` while it turns by ``phi``; from a stated
attitude to the first force a few hundred turns make half a turn of a scale of one in a thousand. Force then shows the
phase, though not how many turns were miscounted, and an error above a quarter of a turn is corrected the wrong way.

So the prior of the gyros' errors is split, along the combination ``s`` that without tracking would turn the vehicle
most, into normal parts as narrow as a filter can follow, of which each is filtered alone (a Gaussian sum):

    N(0, P) = sum_k w_k N(x_k, P - (1 - d^2 / P_ss) p p^T / P_ss),   x_k = p s_k / P_ss,   w_k ~ exp(-s_k^2 / 2 P_ss)

with ``p`` the covariance of all errors with ``s`` and ``d`` the part's width. From the likeliest parts the whole prior
converges to as many trajectories as there are likely phases; the likeliest is the one to linearise about. A check
compares it with the next.

References
----------
D. Alspach, H. Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Trans. Automatic
Control 17 (1972) 439.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flightmodel.checks import Check, FloatArray, IntArray
from flightmodel.statistics import ACCEPTED_ODDS
from recon import kalman, propagation, setup
from recon.fault_detection import UnmodelledAcceleration, track_is_lost, with_one_more, with_unmodelled
from recon.measurements import DECELERATION
from recon.problem import Problem, with_servo_lag
from recon.settings import Settings
from recon.state import KINEMATIC, ROTATION, States, boxplus, unpacked

THINNED_STEP_S = 0.5  # one only linearises about that path
_FARTHEST_SD = 3.0  # where a pass overshoots, the next one corrects it from within the prior
_CONVERGED_RAD = 0.01  # second-order terms of a rotation this small are 5e-5 of its effect
_FOLLOWED_RAD = 0.5  # sd of a phase whose 3 sd are a quarter of a turn, beyond which lateral force corrects it wrongly
_GYROS = slice(KINEMATIC + 9, KINEMATIC + 18)  # their errors
_CLEAR = 30.0  # logarithm of odds beyond which a part is none of the likely ones
_MOST_PEAKS = 8  # of the likely parts that are tried with the whole prior
_MOST_PARTS = 200  # a minute of computing
# of a longer flight, which leaves more phases open: their time would grow with its square
_COARSE_NODES, _COARSE_TURN_RAD = 1800, 0.1


@dataclass(frozen=True)
class SpinPhase:
    """Which phase the data chose, of gyros too uncertain for one linearisation.

    Parameters
    ----------
    parts : int
        How many were filtered; 0 where nothing could choose, or they would have been too many.
    prior_sd_rad : float
        Of the phase, from the gyros' errors.
    odds : float
        Logarithm of the odds of the likeliest phase over the next.
    """

    parts: int
    prior_sd_rad: float
    odds: float

    def check(self) -> Check:
        """Is one phase far likelier than all others?"""
        prior = f"the gyros' scale and bias leave {np.rad2deg(self.prior_sd_rad):.0f} deg (1 sd) of rotation open"
        odds = f"odds of one phase over the next {np.exp(self.odds):.0f} to 1" if self.odds < 14.0 else "one phase fits"
        return Check.of(
            "spin-phase", "phase of the spin", self.odds, ACCEPTED_ODDS, np.inf, f"{prior}; {odds}", f"{prior}; {odds}",
            advice="the number of turns is ambiguous: state a later attitude, a smaller scale_sd of the gyros, or use "
            "magnetometer and Sun sensors (attitude_sensors)", source="rates", component="scale",
        )  # fmt: skip


class Start(NamedTuple):
    """States to linearise about, unmodelled accelerations, and what the spin's phase was chosen from."""

    reference: States
    unmodelled: tuple[UnmodelledAcceleration, ...]
    phase: SpinPhase | None


def follow_track(
    problem: Problem, reference: States | None, settings: Settings, found: tuple[UnmodelledAcceleration, ...]
) -> tuple[kalman.ForwardPass, tuple[UnmodelledAcceleration, ...]]:
    """Forward pass with as many spans of unmodelled acceleration as it takes to follow the track, and these."""
    while True:
        run = kalman.forward(with_unmodelled(problem, found), reference, settings.engine)
        more = with_one_more(found, problem, run)
        if more is None:
            return run, found
        found = more


def needs_no_reference(problem: Problem) -> bool:
    """Whether one pass, linearised about the filter's own estimate, suffices: if a deceleration is measured.

    The filter is then on the drag throughout. About a smoothed path the drag is an exponential of errors a hundred
    times the process noise: half a scale height up with as much more drag is to first order the same flight, to second
    order another by 1 m/s^2 in 100, and passes swing along that line instead of converging.
    """
    return any(instrument.kind == DECELERATION for instrument in problem.instruments)


def bounded_drivers(problem: Problem, states: States) -> States:
    """States to linearise about: drivers of ballistic flight no farther than `_FARTHEST_SD` from their a priori values.

    Drag enters as its logarithm. Linearised in thin air at high speed, a parachute needs a thousandfold drag, and about
    that the next pass would be stiff and far from the truth; any point serves that later passes bring nearer.
    """
    if not problem.motion.ballistic:
        return states
    errors, count = states.sensor_errors.copy(), problem.motion.drivers
    limit = _FARTHEST_SD * problem.model.prior_sd[:count]
    errors[:, :count] = np.clip(errors[:, :count], -limit, limit)
    return replace(states, sensor_errors=errors)


Forward = Callable[[Problem, States | None], tuple[kalman.ForwardPass, States | None]]


def converged(
    thinned: Problem, engine: str, reference: States | None = None, forward: Forward | None = None
) -> tuple[Problem, kalman.ForwardPass, States]:
    """Thinned problem with its radars' lag, last forward pass and states to linearise about, rotations converged.

    From the filter's own estimate on, or from a reference. ``forward`` makes a pass about one and says about which, as
    `kalman.forward` does by itself; then one that the first pass does not move is the answer.
    """
    for k in range(6):  # the passes with all points go on from there
        thinned = with_servo_lag(thinned, reference)
        if forward is None:
            run = kalman.forward(thinned, reference, engine)
        else:
            run, reference = forward(thinned, reference)
        smoothed = kalman.smooth(thinned, run, with_covariance=False)
        judged = k or (forward is not None and reference is not None)
        moved = np.abs(smoothed.x[:, ROTATION]).max() if judged else np.inf
        reference = bounded_drivers(thinned, smoothed.states(run.charts))
        if moved < _CONVERGED_RAD:
            break
    assert reference is not None
    return thinned, run, reference


def first_reference(problem: Problem, settings: Settings) -> Start:
    """Smoothed states at all nodes from a point of each source every `THINNED_STEP_S`, to convergence."""
    thinned, kept = problem.thinned(THINNED_STEP_S)
    reference, phase = _chosen_phase(thinned, settings.engine)
    found: tuple[UnmodelledAcceleration, ...] = ()

    def following(part: Problem, about: States | None) -> tuple[kalman.ForwardPass, States | None]:
        nonlocal found
        run, found = follow_track(part, about, settings, found)
        if about is None and problem.motion.ballistic and track_is_lost(part, run):
            # after a long gap the filter's prediction is far from the track: linearise about the tracking data
            about = setup.track_fit_states(problem.instruments, part.time_s, problem.model.size)
            run, found = follow_track(part, about, settings, ())
        return run, about

    _, _, reference = converged(thinned, settings.engine, reference, following)
    return Start(propagation.fill_between(problem.motion, problem.node_index, kept, reference), found, phase)


def _chosen_phase(thinned: Problem, engine: str) -> tuple[States | None, SpinPhase | None]:
    """States of the likeliest phase, where the gyros' errors leave more open than a filter can follow; else None."""
    phase_by = None if thinned.motion.ballistic else _phase_by_gyros(thinned, engine)
    if phase_by is None:
        return None, None
    prior = thinned.start_covariance
    p = prior[:, _GYROS] @ phase_by
    phase_sd = float(np.sqrt(phase_by @ p[_GYROS]))
    narrow = prior - (1.0 - (_FOLLOWED_RAD / phase_sd) ** 2) * np.outer(p, p) / phase_sd**2
    most = int(np.ceil(0.5 * _FARTHEST_SD * phase_sd / _FOLLOWED_RAD))
    if 2 * most + 1 > _MOST_PARTS or not thinned.observed.usable.any():
        return None, SpinPhase(0, phase_sd, 0.0)  # too many to try, or nothing that could choose

    def reached(problem: Problem, reference: States | None = None) -> tuple[float, float, States]:
        """Log likelihood, phase and states to which a problem converges."""
        last, run, states = converged(problem, engine, reference)
        likelihood, _ = kalman.log_likelihood(last, run)
        return likelihood, float(states.sensor_errors[0, 9:18] @ phase_by), states

    found: list[tuple[float, float, States]] = []
    coarse, kept = _coarse(thinned)
    for phase in 2.0 * _FOLLOWED_RAD * np.arange(-most, most + 1):
        part = replace(coarse, start=boxplus(thinned.start, p * phase / phase_sd**2), start_covariance=narrow)
        likelihood, there, states = reached(part)
        if np.isfinite(likelihood):
            found.append((likelihood - 0.5 * (phase / phase_sd) ** 2, there, states))
    if not found:
        return None, None
    likely = _likely(found)
    if len(kept) < len(thinned.time_s):
        likely = [propagation.fill_between(thinned.motion, thinned.node_index, kept, states) for states in likely]
    # with the whole prior parts of one phase come together
    peaks = [reached(thinned, states) for states in likely]
    best, phase, states = max(peaks, key=lambda one: one[0])
    # by more than half a turn: another count of turns is off by a whole one where force shows it, more at the end
    others = [one[0] for one in peaks if abs(one[1] - phase) > np.pi]
    return states, SpinPhase(len(found), phase_sd, float(best - max(others, default=-np.inf)))


def _likely(found: list[tuple[float, float, States]]) -> list[States]:
    """States of the likeliest part of each count of turns, the likeliest first, of (likelihood, phase, states)."""
    chosen: list[tuple[float, float, States]] = []
    for one in sorted(found, key=lambda part: -part[0]):
        new = all(abs(one[1] - other[1]) > np.pi for other in chosen)
        if new and len(chosen) < _MOST_PEAKS and (not chosen or one[0] > chosen[0][0] - _CLEAR):
            chosen.append(one)
    return [states for _, _, states in chosen]


def _coarse(thinned: Problem) -> tuple[Problem, IntArray]:
    """Problem on about `_COARSE_NODES` nodes at most, and their indices; unchanged if it has no more.

    It finds the likely parts alone, which are then compared on all nodes.
    """
    step_s = float(thinned.time_s[-1] - thinned.time_s[0]) / _COARSE_NODES
    if step_s <= THINNED_STEP_S:
        return thinned, np.arange(len(thinned.time_s))
    coarse, kept = thinned.thinned(step_s)
    fastest_radps = float(np.linalg.norm(thinned.motion.rate_sensor_radps, axis=1).max())
    motion, node_index = propagation.decimated(coarse.motion, coarse.node_index, _COARSE_TURN_RAD / fastest_radps)
    return replace(coarse, motion=motion, node_index=node_index), kept


def _phase_by_gyros(thinned: Problem, engine: str) -> FloatArray | None:
    """Partials (9,) by the gyros' errors of the rotation that without tracking would be known least.

    None where the filter follows the attitude throughout. What the filter states of its own attitude does not serve:
    linearised about a phase that is off it finds information that is not there.
    """
    t, rate = thinned.motion.time_s, np.linalg.norm(thinned.motion.rate_sensor_radps, axis=1)
    scale_sd = np.sqrt(np.diag(thinned.start_covariance)[_GYROS][3:6].max())
    if 0.5 * np.diff(t) @ (rate[1:] + rate[:-1]) * scale_sd < _FOLLOWED_RAD:
        return None
    free = kalman.forward(thinned.without(np.ones(len(thinned.row), dtype=bool)), None, engine).filtered
    diagonal = [r * (r + 1) // 2 + r for r in range(*ROTATION.indices(KINEMATIC))]
    covariance = unpacked(free.p_minus[int(np.argmax(free.p_minus[:, diagonal].max(axis=1)))])
    _, axes = np.linalg.eigh(covariance[ROTATION, ROTATION])
    by = np.linalg.solve(covariance[_GYROS, _GYROS], covariance[_GYROS, ROTATION] @ axes[:, 2])
    return by if by @ thinned.start_covariance[_GYROS, _GYROS] @ by > _FOLLOWED_RAD**2 else None

"""How are kernels compiled before their first use? Side by side in processes, with progress.

Kernels are compiled for the very processor they run on and kept in a cache whose name carries a hash of their sources
(`flightmodel._kernels`). Without this a first command would compile them one after another, in silence. Each group
calls its kernels once on a tiny problem; a file in the cache marks it as compiled.
"""

from __future__ import annotations

import gc
import hashlib
import math
import os
import time
import types
from collections.abc import Callable, Iterable
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np

from flightmodel import earth
from flightmodel._kernels import CACHE
from flightmodel.checks import FloatArray, GateError, Progress
from flightmodel.vehicle import Vehicle, vehicle_from_toml, vehicle_path
from postflight.beside import start_method, worker_pool
from recon import kalman, linearise, propagation
from recon.measurements import Instrument
from recon.problem import Problem, observe
from recon.propagation import strapdown_motion
from recon.state import Block, ErrorModel, States


def _vehicle_at_rest() -> tuple[Vehicle, FloatArray]:
    from synthetic_flight.simulate import state_from_ecef

    level = np.array([1.0, 0.0, 0.0, 0.0])
    state = state_from_ecef(0.0, np.array([7e6, 0.0, 0.0]), np.zeros(3), level, np.zeros(3))
    return vehicle_from_toml(vehicle_path("irve2_reference")), state


def _simulator() -> None:
    from synthetic_flight.instrument_errors import unit_gauss_markov
    from synthetic_flight.simulate import integrate, vacuum_table

    vehicle, state = _vehicle_at_rest()
    integrate(vehicle, vacuum_table(), state, 0.001, 1, 2)
    unit_gauss_markov(np.zeros(1), np.zeros((2, 1)), np.zeros((2, 1)))


def _fly_ensemble(creep: int) -> None:
    from synthetic_flight.ensemble import Start, fly_legs
    from synthetic_flight.simulate import Schedule, parameter_vector, vacuum_table

    vehicle, state = _vehicle_at_rest()
    start = Start(np.append(state, np.zeros(creep)), parameter_vector(vehicle), vacuum_table())
    fly_legs(vehicle, [0], [start], [Schedule(0.001, 1, 2)])


def _ensembles() -> None:
    _fly_ensemble(0)


def _creep() -> None:
    """Compile the simulator's kernels with creep states, which every reconciliation uses."""
    from synthetic_flight.dynamics import CREEP_STATES

    _fly_ensemble(CREEP_STATES)


def _tiny_problem() -> Problem:
    """Three nodes without a measurement: enough to compile the filter."""
    motion = strapdown_motion(
        np.array([0.0, 0.01, 0.02]), np.zeros((3, 3)), np.zeros((3, 3)), np.ones((3, 3)), np.ones((3, 3)),
        np.eye(3), np.eye(3),
    )  # fmt: skip
    model = ErrorModel((Block("all", tuple("abcdefghijklmnopqr"), "1", 1.0),))
    start = States(earth.ecef_from_geodetic(0.6, -1.3, 5e4), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(18))
    nothing = Instrument(
        "none",
        0,
        "none",
        np.zeros(3),
        np.zeros(3),
        np.eye(3),
        np.empty(0),
        np.empty((0, 3)),
        np.empty((0, 3)),
        np.empty((0, 3)),
        np.empty(0, dtype=np.int64),
        np.empty(0),
    )
    nodes = np.arange(3)
    observed, row = observe(motion.time_s, (nothing,))
    return Problem(
        motion.time_s, nodes, motion, model, (nothing,), row, observed, start, np.eye(27), np.ones(4), nodes >= 0
    )


def _linearise() -> None:
    problem = _tiny_problem()
    states = States(*(np.array([part] * len(problem.time_s)) for part in linearise.as_charts(problem.start)))
    linearise.linearise(problem, states)
    propagation.fill_between(problem.motion, problem.node_index, problem.node_index[:1], states[:1])
    propagation.propagate(problem.motion, 0, 1, problem.start)


def _filter() -> None:
    """Compile the linear filter and smoother, on steps that change nothing."""
    problem = _tiny_problem()
    line, x = linearise.unfilled(problem), np.zeros(problem.size)
    for part in (*line.charts, *line.steps):
        part[:] = 0.0
    line.steps.transition[:, range(9), range(9)] = line.steps.decay[:] = 1.0
    run, innovations = kalman.empty_answer(problem)
    run.p_last[:] = problem.start_covariance
    slots, wander = problem.sources().slot, problem.model.wander
    kalman.filter_nodes(problem.observed, slots, wander, problem.gate, 0, 3, x, *line[1:], run, innovations)
    kalman.smooth(problem, kalman.ForwardPass(States(*line.charts), *line[1:], run, innovations))


def _balance() -> None:
    from estimators import balance

    vehicle, one, rows = _vehicle_at_rest()[0], np.ones(1), np.zeros((1, 3))
    common = rows, rows, np.zeros((1, 2)), one, one, vehicle.aero.mach, vehicle.aero.coefficients, np.empty((1, 2))
    balance.force_left(np.ones(balance.VEHICLE_NUMBERS), np.zeros((3, 1, 2)), rows, *common)
    balance.axial_left(np.ones(balance.VEHICLE_NUMBERS), np.zeros((3, 1, 2)), rows, *common)
    balance.moment_left(np.ones(balance.VEHICLE_NUMBERS), np.zeros((3, 1, 2)), one, *common)


def _spans() -> None:
    from postflight.reconciliation.forward_model import sense
    from postflight.reconciliation.normal_equations import add_part

    records, number, three = np.zeros((1, 3, 22)), np.zeros(1, dtype=np.int64), np.zeros((1, 3))
    windows, slope = np.empty((2, 1, 1, 6))
    aux, simpson = np.zeros((1, 3, 18)), np.ones(3)
    sense(records, aux, number, three, np.ones(1), simpson, 1.0, windows, slope)
    one = np.zeros((1, 1))
    add_part(one, one, one, number, one)


def _camera() -> None:
    """Orient a camera on one synthetic frame, fit it, and lay the virtual camera over it."""
    from estimators.benchmark import orient_camera
    from estimators.overlay import Overlay
    from synthetic_flight.film import render_video

    vehicle, _ = _vehicle_at_rest()
    mount, joint_m = next(iter(vehicle.cameras.values())), vehicle.joint.station_m
    sun = np.array([[0.5, 0.6, 0.6]])
    (frame,) = render_video(vehicle.geometry, mount, joint_m, np.zeros(1), np.zeros(1), sun, np.random.default_rng(0))
    oriented = orient_camera(frame, vehicle.geometry, mount, joint_m)
    fit = oriented.fit(frame)
    Overlay(oriented.view).blended(frame, 0.0, 0.0)
    oriented.view.pixels_of_each(np.ones((1, 3)), np.zeros((1, 3)))
    if fit.refused:  # then a part of the kernels was not called
        raise GateError(fit.refused, code="kernels-not-called")


GROUPS: dict[str, Callable[[], None]] = {
    "linearise": _linearise,
    "camera": _camera,
    "filter": _filter,
    "simulator": _simulator,
    "ensembles": _ensembles,
    "creep": _creep,
    "balance": _balance,
    "spans": _spans,
}
# what shares its parts: in one process these are compiled once
_FAMILIES = (("ensembles", "creep"),)
# time of each group where it is compiled in this order; only ratios count
_SECONDS = {
    "camera": 17.1, "linearise": 11.5, "filter": 6.3, "ensembles": 3.7, "simulator": 3.5, "balance": 1.9,
    "creep": 1.0, "spans": 0.9,
}  # fmt: skip
_FRAME_SLOTS = 1 << 17  # of eight bytes: the piece becomes the next power of two, half of it for callees
_LOOK_S = 0.2  # between two looks at what is compiled
RECONSTRUCTION, ESTIMATES = ("linearise", "filter"), ("balance", "camera")


def _stamp(group: str) -> Path | None:
    """Marker of a compiled group; like numba's cache, it depends on the location of the sources."""
    if CACHE.path is None:
        return None
    location = hashlib.sha256(str(Path(earth.__file__).parent).encode()).hexdigest()[:8]
    return CACHE.path / f"{group}-{location}.compiled"


def missing(groups: Iterable[str]) -> list[str]:
    """Return groups of kernels that were not compiled on this machine from these sources yet."""
    stamps = ((group, _stamp(group)) for group in groups)
    return [group for group, stamp in stamps if stamp is not None and not stamp.exists()]


def prepare(groups: Iterable[str], report: Progress) -> dict[str, str]:
    """Compile what is missing, in as many processes as there are processors.

    Parameters
    ----------
    groups : iterable of str
        Keys of `GROUPS`.
    report : callable
        Takes the part of the time that is over, and which groups are being compiled.

    Returns
    -------
    dict of str
        Groups that failed here, and will be compiled at their first use, with the reason.
    """
    wanted = missing(groups)
    shares = _shares(wanted)
    if not shares:
        return {}
    failed: dict[str, str] = {}
    with worker_pool(min(len(shares), len(os.sched_getaffinity(0))), start_method()) as pool:
        running = {pool.submit(_compile, share): share for share in shares}
        watch, waiting = _Watch(shares), set(running)
        while waiting:
            done, waiting = wait(waiting, _LOOK_S)
            report(*watch.look())
            for future in done:
                try:
                    failed |= future.result()
                except BrokenProcessPool as fault:
                    failed |= dict.fromkeys(missing(running[future]), str(fault))
    return failed


def _shares(groups: list[str]) -> list[list[str]]:
    """Groups that are compiled in one process, the longest first."""
    families = [*_FAMILIES, *((group,) for group in groups if not any(group in family for family in _FAMILIES))]
    shares = [[group for group in family if group in groups] for family in families]
    return sorted(filter(None, shares), key=lambda share: -sum(map(_seconds, share)))


def _seconds(group: str) -> float:
    return _SECONDS.get(group, 1.0)


class _Watch:
    """Progress of compiling, from the groups whose marker exists and the time since each group's turn began."""

    def __init__(self, shares: list[list[str]]) -> None:
        self._shares = shares
        self._begun_s = time.monotonic()
        self._since: dict[str, float] = {}

    def look(self) -> tuple[float, str]:
        """Elapsed fraction of the time, and the groups in work, of how many, with an estimate of the remaining time."""
        now = time.monotonic()
        left = [missing(share) for share in self._shares]
        turn = [share[0] for share in left if share][: len(os.sched_getaffinity(0))]
        every = [group for share in self._shares for group in share]
        over = sum(map(_seconds, every)) - sum(_seconds(group) for share in left for group in share)
        for group in turn:  # of what is not finished never all
            whole = _seconds(group)
            over += whole * -math.expm1(-(now - self._since.setdefault(group, now)) / (2.0 * whole))
        part = over / sum(map(_seconds, every))
        number = len(every) - sum(map(len, left)) + 1
        words = f"compiling kernels, group {min(number, len(every))} of {len(every)}: {', '.join(turn) or every[-1]}"
        taken_s = now - self._begun_s
        if part > 0.05:
            words += f"; {taken_s * (1.0 - part) / part:.0f} s remain"
        return part, words


def _compile(groups: list[str]) -> dict[str, str]:
    """Compile groups in this process; return those that fail, with the reason."""
    gc.set_threshold(200_000, 20, 50)  # a compiler makes many objects and hardly any circle: a sixth of the time
    return _with_room(_compile_each)(groups)


def _with_room(work: Callable[[list[str]], dict[str, str]]) -> Callable[[list[str]], dict[str, str]]:
    """Run work in a frame that claims `_FRAME_SLOTS`, so that CPython allocates its callees' frames at once.

    CPython keeps frames in pieces of 16 KiB and gives a piece back at every return across its edge. A compiler recurses
    to and fro across an edge a million times: a seventh of the time.
    """
    roomy = work.__code__.replace(co_stacksize=_FRAME_SLOTS)
    return types.FunctionType(roomy, work.__globals__)


def _compile_each(groups: list[str]) -> dict[str, str]:
    failed = {}
    for group in groups:
        try:
            GROUPS[group]()
        except Exception as fault:
            failed[group] = f"{type(fault).__name__}: {fault}".splitlines()[0]
            continue
        stamp = _stamp(group)
        if stamp is not None:
            stamp.touch()
    return failed

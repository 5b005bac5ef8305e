"""How are kernels compiled before their first use? Side by side in processes, with a message about the wait.

Kernels are compiled for the very processor they run on and kept in a cache whose name carries a hash of their sources
(`flightmodel._kernels`). Without this a first command would compile them one after another, in silence. Each group
calls its kernels once on a tiny problem; a file in the cache marks it as compiled.

Run as ``python -m postflight.warmup GROUP ...`` it compiles these groups in its own process.
"""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from flightmodel import earth
from flightmodel._compiler_kernels import list_variables_by_type, remember_operators
from flightmodel._kernels import CACHE
from flightmodel.checks import FloatArray, GateError
from flightmodel.vehicle import Vehicle, vehicle_from_toml, vehicle_path
from recon import ekf, propagation, smoother
from recon.ekf import Problem, observe
from recon.measurements import Instrument
from recon.propagation import strapdown_motion
from recon.state import Block, ErrorModel, States, packed


def _vehicle_at_rest() -> tuple[Vehicle, FloatArray]:
    from synthetic_flight.simulate import state_from_ecef

    level = np.array([1.0, 0.0, 0.0, 0.0])
    state = state_from_ecef(0.0, np.array([7e6, 0.0, 0.0]), np.zeros(3), level, np.zeros(3))
    return vehicle_from_toml(vehicle_path("irve2_reference")), state


def _simulator() -> None:
    from synthetic_flight._kernels import gauss_markov
    from synthetic_flight.simulate import integrate, vacuum_table

    vehicle, state = _vehicle_at_rest()
    integrate(vehicle, vacuum_table(), state, 0.001, 1, 2)
    gauss_markov(np.zeros(1), np.zeros((2, 1)), np.zeros((2, 1)))


def _fly_ensemble(creep: int) -> None:
    from synthetic_flight.ensemble import Start, fly_ensemble
    from synthetic_flight.simulate import Schedule, parameter_vector, vacuum_table

    vehicle, state = _vehicle_at_rest()
    start = Start(np.append(state, np.zeros(creep)), parameter_vector(vehicle), vacuum_table())
    list(fly_ensemble(vehicle, lambda _run: start, [0], Schedule(0.001, 1, 2)))


def _ensembles() -> None:
    _fly_ensemble(0)


def _creep() -> None:
    """Of what a joint that creeps adds a reconciliation asks in every flight."""
    from synthetic_flight._kernels import CREEP_STATES

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


def _filter() -> None:
    problem = _tiny_problem()
    ekf.forward(problem)


def _smoothers() -> None:
    problem = _tiny_problem()
    steps, run, innovations = ekf.empty_pass(problem)
    for part in (*steps, run.x_minus, run.x_plus):
        part[:] = 0.0
    run.p_minus[:] = packed(np.eye(27))
    run.p_last[:] = np.eye(27)
    steps.transition[:, range(9), range(9)] = 1.0
    states = States(*(np.array([part] * 3) for part in ekf.as_charts(problem.start)))
    smoother.smooth(problem, ekf.ForwardPass(states, steps, run, innovations))
    propagation.fill_between(problem.motion, problem.node_index, problem.node_index[:1], states[:1])
    propagation.propagate(problem.motion, 0, 1, problem.start)


def _balance() -> None:
    from estimators import _balance_kernels as kernels

    vehicle, one, rows = _vehicle_at_rest()[0], np.ones(1), np.zeros((1, 3))
    common = rows, rows, np.zeros((1, 2)), one, one, vehicle.aero.mach, vehicle.aero.coefficients, np.empty((1, 2))
    kernels.force_left(np.ones(kernels.COUNT), np.zeros((3, 1, 2)), rows, *common)
    kernels.axial_left(np.ones(kernels.COUNT), np.zeros((3, 1, 2)), rows, *common)
    kernels.moment_left(np.ones(kernels.COUNT), np.zeros((3, 1, 2)), one, *common)


def _spans() -> None:
    from postflight.reconciliation import _span_kernels as kernels

    records, number, three = np.zeros((1, 3, 22)), np.zeros(1, dtype=np.int64), np.zeros((1, 3))
    windows, slope = np.empty((2, 1, 1, 6))
    aux, simpson = np.zeros((1, 3, 18)), np.ones(3)
    kernels.sense(records, aux, number, three, np.ones(1), simpson, 1.0, windows, slope)
    one = np.zeros((1, 1))
    kernels.add_part(one, one, one, number, one)


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
    "filter": _filter,
    "camera": _camera,
    "smoothers": _smoothers,
    "simulator": _simulator,
    "ensembles": _ensembles,
    "creep": _creep,
    "balance": _balance,
    "spans": _spans,
}
# what shares its parts: in one process these are compiled once. With the seconds that it takes; only ratios count
_FAMILIES: dict[tuple[str, ...], int] = {
    ("filter", "smoothers"): 18, ("camera",): 18, ("simulator", "ensembles", "creep"): 8, ("balance",): 3,
    ("spans",): 2,
}  # fmt: skip
RECONSTRUCTION, ESTIMATES = ("filter", "smoothers"), ("balance", "camera")


def _stamp(group: str) -> Path | None:
    """Mark of a compiled group. numba keeps compiled code by the sources' location, and so does the mark."""
    if CACHE.path is None:
        return None
    location = hashlib.sha256(str(Path(earth.__file__).parent).encode()).hexdigest()[:8]
    return CACHE.path / f"{group}-{location}.compiled"


def missing(groups: Iterable[str]) -> list[str]:
    """Return groups of kernels that were not compiled on this machine from these sources yet."""
    stamps = ((group, _stamp(group)) for group in groups)
    return [group for group, stamp in stamps if stamp is not None and not stamp.exists()]


def prepare(groups: Iterable[str], report: Callable[[str], None]) -> None:
    """Compile what is missing, in as many processes as there are processors: each begins with a second of imports.

    Parameters
    ----------
    groups : iterable of str
        Keys of `GROUPS`.
    report : callable
        Takes a message: what is compiled, and each group that failed here and will be compiled at its first use.
    """
    wanted = missing(groups)
    if not wanted:
        return
    report(f"compiling kernels for this machine, once (a quarter of a minute to one minute): {', '.join(wanted)}")
    quiet, command = subprocess.DEVNULL, [sys.executable, "-m", "postflight.warmup"]
    plain = {**os.environ, "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}  # numba colours thousands that it drops
    shares = _shares(wanted, len(os.sched_getaffinity(0)))
    running = [
        subprocess.Popen(
            [*command, *share], env=plain, stdin=quiet, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for share in shares
    ]
    try:
        for share, process in zip(shares, running, strict=True):
            failed, why = process.communicate()
            reasons = dict(line.split("\t", 1) for line in failed.splitlines())
            if process.returncode:  # ended before its time
                last = why.strip().splitlines()[-1] if why.strip() else f"exit code {process.returncode}"
                reasons = dict.fromkeys(missing(share), last) | reasons
            for group, reason in reasons.items():
                report(f"kernels of {group} were not compiled beforehand, but will be at their first use: {reason}")
    except BaseException:
        for process in running:
            process.terminate()
        raise


def _shares(groups: list[str], processes: int) -> list[list[str]]:
    """Deal groups, family by family, each to whom has the least to do; what is in none is a family of its own."""
    known = {group for family in _FAMILIES for group in family}
    families = [*_FAMILIES.items(), *(((group,), 1) for group in groups if group not in known)]
    shares: list[list[str]] = [[] for _ in range(processes)]
    load = [0] * processes
    for family, seconds in families:
        if wanted := [group for group in family if group in groups]:
            least = load.index(min(load))
            shares[least] += wanted
            load[least] += seconds
    return [share for share in shares if share]


def _compile(groups: Iterable[str]) -> None:
    """Compile groups in this process; those that fail are written with the reason."""
    remember_operators()
    list_variables_by_type()
    gc.set_threshold(200_000, 20, 50)  # a compiler makes many objects and hardly any circle: a fifth of the time
    for group in groups:
        try:
            GROUPS[group]()
        except Exception as fault:
            sys.stdout.write(f"{group}\t{type(fault).__name__}: {fault}".splitlines()[0] + "\n")
            continue
        stamp = _stamp(group)
        if stamp is not None:
            stamp.touch()


if __name__ == "__main__":
    _compile(sys.argv[1:])
    gc.freeze()  # or all that was made is searched for garbage once more at the end

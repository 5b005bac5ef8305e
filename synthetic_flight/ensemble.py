"""What do thousands of dispersed flights do: their peaks, and their histories over a window?

Sixteen flights fly in the lanes of one kernel call (`synthetic_flight.dynamics`), and kernel calls run in threads,
since compiled code holds no interpreter lock. Flight ``run`` is the same to the last bit in any company: every lane
goes through the same instructions. Memory does not grow with the number of flights.

The joint is locked until the shell is inflated. Until then the vehicle is rigid and outside the atmosphere, and flown
with longer steps; then with those of the window, or the scenario's own. Only the window is recorded. Of each flight
named numbers and histories are kept: ``peak_X`` is the largest sample of the quantity X in the window,
``X_at_peak_pressure`` its sample at the largest dynamic pressure. Angles are degrees and accelerations g, since these
numbers are for files and figures. A joint that diverges ends its flight: histories hold their last value from there
on, so that bands include that flight.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np

from flightmodel import earth, rotations
from flightmodel.airdata import total_angle
from flightmodel.checks import NO_FAULT, ConfigError, FloatArray, GateError, Issue, nearest_name
from flightmodel.vehicle import Vehicle
from synthetic_flight import dynamics, simulate
from synthetic_flight.dispersions import Case, Dispersions, Window, dispersed_case
from synthetic_flight.dynamics import check_step
from synthetic_flight.scenarios import Scenario, TimeSpan, initial_state
from synthetic_flight.simulate import Schedule, integrate_lanes

# two to four vectors of a register each; more lanes outgrow the first-level cache
LANES = 16


@dataclass(frozen=True)
class Start:
    """How one flight of an ensemble differs from the others.

    Parameters
    ----------
    state : (20,) float
        At the start (`synthetic_flight.simulate.state_from_ecef`); (22,) with creep, which is none otherwise.
    parameters : (69,) float
        `synthetic_flight.simulate.parameter_vector` of the dispersed vehicle. All flights share one coefficient table,
        which four of the parameters scale.
    atmosphere : (rows, 6) float
        `synthetic_flight.simulate.atmosphere_table` of the flight's own atmosphere.
    """

    state: FloatArray
    parameters: FloatArray
    atmosphere: FloatArray


@dataclass(frozen=True)
class Flown:
    """One flown flight of an ensemble: its records, fewer than asked for if the joint ``diverged``.

    ``states`` ``(n, 20)`` and ``aux`` ``(n, 18)`` as `synthetic_flight.simulate.integrate` gives them.
    """

    run: int
    states: FloatArray
    aux: FloatArray
    diverged: bool


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def fly_ensemble(
    vehicle: Vehicle,
    start_of: Callable[[int], Start],
    runs: Iterable[int],
    schedule: Schedule,
    workers: int | None = None,
) -> Iterator[Flown]:
    """Fly one flight a run number, in order.

    Parameters
    ----------
    vehicle : Vehicle
        Gives the coefficient table.
    start_of : callable
        From run number to how that flight starts; called in this thread, in order.
    runs : iterable of int
    schedule : Schedule
    workers : int, optional
        Threads; every core by default. A block for each is in memory at a time, two for one.

    Yields
    ------
    Flown
    """
    workers = available_cores() if workers is None else workers
    if workers < 1 or schedule.records < 1 or schedule.per_record < 1 or not schedule.step_s > 0.0:
        raise ConfigError(
            f"fly_ensemble: workers, steps and records must be positive; got {workers}, {schedule}",
            code="argument-value",
        )
    check_mass(vehicle)
    if schedule.frees_joint:
        check_step(vehicle, schedule.step_s)
    remaining = iter(runs)
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[tuple[list[int], Future[list[Flown]]]] = deque()
        while True:
            while len(waiting) < max(workers, 2) and (block := list(islice(remaining, LANES))):
                starts = [start_of(run) for run in block]
                waiting.append((block, pool.submit(_fly_block, vehicle, block, starts, schedule)))
            if not waiting:
                return
            yield from waiting.popleft()[1].result()


def _fly_block(vehicle: Vehicle, runs: list[int], starts: list[Start], schedule: Schedule) -> list[Flown]:
    """Fly at most `LANES` flights side by side, in this thread; see `fly_ensemble`."""
    padded = starts + [starts[-1]] * (LANES - len(starts))
    shared = all(s.atmosphere is starts[0].atmosphere for s in starts)
    lanes = integrate_lanes(
        vehicle,
        starts[0].atmosphere if shared else np.stack([s.atmosphere for s in padded]),
        np.stack([simulate.with_creep(s.state, vehicle) for s in padded]),
        np.stack([s.parameters for s in padded]),
        schedule,
    )
    return [Flown(run, *lane) for run, lane in zip(runs, lanes, strict=False)]


def check_mass(vehicle: Vehicle) -> None:
    """Refuse a vehicle whose mass properties change in flight: all lanes have one set of them throughout."""
    if vehicle.mass_steps:
        raise ConfigError(
            f"{vehicle.source}: [[mass]]: ensembles fly one set of mass properties; take the steps out, and give "
            "[aeroshell] and [centerbody] those of the window",
            code="mass-changes",
        )


def fly_legs(vehicle: Vehicle, runs: list[int], starts: list[Start], legs: list[Schedule]) -> list[Flown]:
    """Fly at most `LANES` flights through legs that follow each other; the records of the last are kept.

    A flight that diverges in an earlier leg has no record.

    Raises
    ------
    ConfigError
        ``mass-changes``: the vehicle's mass properties change in flight.
    """
    check_mass(vehicle)
    flown: list[Flown] = []
    for leg in legs:
        if flown:
            ends = [f.states[-1] if len(f.states) and not f.diverged else np.full(f.states.shape[1], np.nan)
                    for f in flown]  # fmt: skip
            starts = [replace(s, state=end) for s, end in zip(starts, ends, strict=True)]
        flown = _fly_block(vehicle, runs, starts, leg)
    return flown


_TABLE_M = simulate.air_altitudes_m()


def _turned(dcm: FloatArray, vectors: FloatArray) -> FloatArray:
    """Product of matrices (n, 3, 3) and vectors (n, 3)."""
    return np.einsum("nij,nj->ni", dcm, vectors)


def _turned_back(dcm: FloatArray, vectors: FloatArray) -> FloatArray:
    """Product of transposed matrices (n, 3, 3) and vectors (n, 3)."""
    return np.einsum("nji,nj->ni", dcm, vectors)


def _crossed(vectors: FloatArray, by: FloatArray) -> FloatArray:
    """Cross products of vectors (n, 3) and one vector (3,)."""
    return vectors @ rotations.skew(by)


@dataclass(frozen=True)
class Records:
    """One flight: ``states`` (n, 20), ``aux`` (n, 18), its vehicle and its atmosphere table (rows, 6)."""

    states: FloatArray
    aux: FloatArray
    vehicle: Vehicle
    atmosphere: FloatArray

    @cached_property
    def specific_force_body_mps2(self) -> FloatArray:
        """Specific force ``(n, 3)``, body axes, of the centerbody at the undeflected vehicle's c.g.

        Joint force over mass, moved there by lever-arm terms; the difference of gravitation over half a metre (1e-6
        m/s^2) is neglected.
        """
        body = self.vehicle.centerbody
        arm, rate, turn = self.vehicle.cg_m - body.cg_m, self.states[:, 14:17], self.aux[:, 15:18]
        force = _turned_back(self._eci_from_body, self.aux[:, 6:9])
        swing = rate * (rate @ arm)[:, None] - np.einsum("ni,ni->n", rate, rate)[:, None] * arm  # rate x (rate x arm)
        return force / body.mass_kg + _crossed(turn, arm) + swing

    @cached_property
    def _eci_from_body(self) -> FloatArray:
        return rotations.dcm_from_q(self.states[:, 6:10])

    @cached_property
    def velocity_air_body_mps(self) -> FloatArray:
        """Velocity ``(n, 3)``, body axes, of the centerbody relative to the air at the undeflected vehicle's c.g."""
        position, velocity, _, _, rate, shell_rate = dynamics.split(self.states)
        vehicle, to_eci, shell_to_eci = self.vehicle, self._eci_from_body, rotations.dcm_from_q(self.states[:, 10:14])
        # the point lies where the vehicle's c.g. would if the shell, too, had the body's attitude
        shell = vehicle.aeroshell
        arm = (shell.mass_kg / vehicle.mass_kg) * (shell.cg_m - vehicle.joint_m)
        at = position + to_eci @ arm - shell_to_eci @ arm
        velocity = velocity + _turned(to_eci, _crossed(rate, arm)) - _turned(shell_to_eci, _crossed(shell_rate, arm))
        velocity += _crossed(at, earth.OMEGA_ECEF_RADPS)
        # ECI differs from ECEF by a rotation about the Earth's axis: north and east at this longitude of ECI are right
        latitude, longitude, _ = earth.geodetic_from_ecef(at)
        wind = np.zeros_like(velocity)
        for axis in (0, 1):
            wind[:, axis] = np.interp(self.aux[:, 0], _TABLE_M[: len(self.atmosphere)], self.atmosphere[:, 3 + axis])
        wind_eci = np.einsum("nji,nj->ni", earth.dcm_ned_ecef(latitude, longitude), wind)
        return _turned_back(to_eci, velocity - wind_eci)

    @cached_property
    def alpha_total_deg(self) -> FloatArray:
        """Centerbody's total angle of attack, wind-relative, ``(n,)``."""
        return np.rad2deg(total_angle(self.velocity_air_body_mps))

    @cached_property
    def normal_g(self) -> FloatArray:
        """Size of the centerbody's lateral specific force, ``(n,)``."""
        return np.hypot(*self.specific_force_body_mps2[:, 1:].T) / earth.STANDARD_GRAVITY_MPS2


QUANTITIES: dict[str, Callable[[Records], FloatArray]] = {
    "alpha_total_deg": lambda r: r.alpha_total_deg,
    "alpha_shell_deg": lambda r: np.rad2deg(r.aux[:, 4]),
    "deflection_deg": lambda r: np.rad2deg(r.aux[:, 5]),
    "normal_g": lambda r: r.normal_g,
    "axial_g": lambda r: -r.specific_force_body_mps2[:, 0] / earth.STANDARD_GRAVITY_MPS2,
    "dynamic_pressure_pa": lambda r: r.aux[:, 3],
    "mach": lambda r: r.aux[:, 2],
    "altitude_m": lambda r: r.aux[:, 0],
    "rate_degps": lambda r: np.rad2deg(np.linalg.norm(r.states[:, 15:17], axis=1)),
}
PEAK_TIME = "peak_pressure_s"
SCALARS = (
    PEAK_TIME,
    *(f"peak_{name}" for name in QUANTITIES),
    *(f"{name}_at_peak_pressure" for name in QUANTITIES),
)


def check_outputs(names: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Raise `ConfigError` with every name that is unknown or comes twice."""
    faults = [
        Issue(f"unknown output '{n}'{nearest_name(n, known)}; known: {', '.join(known)}", "name-unknown")
        for n in names
        if n not in known
    ]
    faults += [Issue(f"output '{n}' comes twice", "given-twice") for n in dict.fromkeys(names) if names.count(n) > 1]
    if faults:
        raise ConfigError(faults)


def scalars_of(records: Records, names: tuple[str, ...], window: Window) -> dict[str, float]:
    """Return the named numbers of one flight."""
    at_peak = int(np.argmax(records.aux[:, 3]))
    found = {}
    for name in names:
        if name == PEAK_TIME:
            found[name] = window.from_s + window.record_s * at_peak
        elif name.startswith("peak_"):
            found[name] = float(QUANTITIES[name.removeprefix("peak_")](records).max())
        else:
            found[name] = float(QUANTITIES[name.removesuffix("_at_peak_pressure")](records)[at_peak])
    return found


def _histories_of(records: Records, names: tuple[str, ...], window: Window) -> FloatArray:
    """Return the named histories of one flight, ``(names, points)``."""
    points = len(window.history_time_s())
    rows = np.minimum(window.per_history * np.arange(points), len(records.aux) - 1)
    return np.stack([QUANTITIES[name](records)[rows] for name in names]) if names else np.empty((0, points))


def records_of(flown: Flown, vehicle: Vehicle, atmosphere: FloatArray) -> Records:
    """Return the records of a flight; `GateError` if it did not reach its window."""
    if not len(flown.aux):
        raise GateError("no record: the joint diverged, or the state was not finite, before the window", "too-few-data")
    return Records(flown.states, flown.aux, vehicle, atmosphere)


# a rigid vehicle outside the atmosphere rotates at some tenths of a radian a second: errors of 1e-9 a step
LOCKED_STEP_S = 0.02


@dataclass(frozen=True)
class Plan:
    """Settings that all flights of a study share: scenario, dispersions, window, and outputs to keep."""

    scenario: Scenario
    dispersions: Dispersions
    window: Window
    scalars: tuple[str, ...]
    histories: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """Outputs of one flight; ``reason`` says why there are none, ``diverged_s`` when its joint passed 90 deg."""

    run: int
    reason: Issue
    diverged_s: float
    scalars: dict[str, float]
    histories: FloatArray


def legs(time: TimeSpan, window: Window, locked: bool) -> list[Schedule]:
    """Schedules from the scenario's start to the end of the window.

    Raises
    ------
    ConfigError
        Where the window does not lie between inflation and the scenario's end.
    """
    begins, longest = time.start_s, window.step_s or time.step_s
    inflated = begins if time.inflated_s is None else max(time.inflated_s, begins)
    if not inflated <= window.from_s < window.to_s <= time.stop_s:
        raise ConfigError(
            f"window: {max(inflated, begins):g} (inflated) <= from_s = {window.from_s:g} < to_s = {window.to_s:g} <= "
            f"{time.stop_s:g} (the scenario's stop_s) is wanted",
            code="time-not-covered",
        )
    out = []
    for start, end, step, lock in (
        (begins, inflated, LOCKED_STEP_S, True),
        (inflated, window.from_s, longest, locked),
    ):
        if end > start:
            steps = int(np.ceil((end - start) / step - 1e-9))
            out.append(Schedule((end - start) / steps, steps, 2, 2 if lock else 0))
    per_record = int(np.ceil(window.record_s / longest - 1e-9))
    step = window.record_s / per_record
    return [*out, Schedule(step, per_record, window.records, window.records if locked else 0)]


def start_of(case: Case, step_s: float, locked: bool) -> Start:
    """Initial state of a case in the lanes; `GateError` if the step is too long for its joint."""
    if not locked:
        check_step(case.vehicle, step_s)
    parameters = simulate.parameter_vector(case.vehicle, *case.scales)
    return Start(initial_state(case.scenario), parameters, simulate.atmosphere_table(case.profile))


def fly_runs(plan: Plan, runs: Sequence[int], draws_of: Callable[[int], dict[str, float]]) -> list[Row]:
    """Fly runs and return the outputs that the plan asks for, in the order of the runs.

    Parameters
    ----------
    draws_of : callable
        From run number to a number between 0 and 1 for every factor.
    """
    locked = plan.dispersions.joint_is == "locked"
    schedules = legs(plan.scenario.spec.time, plan.window, locked)
    out: dict[int, Row] = {}
    waiting: list[tuple[int, Case, Start]] = []
    for run in runs:
        try:
            case = dispersed_case(plan.scenario, plan.dispersions, draws_of(run))
            waiting.append((run, case, start_of(case, schedules[-1].step_s, locked)))
        except Exception as fault:  # one flight's defect must not cost the others: its row has the reason
            out[run] = _failed(plan, run, failure_reason(fault))
        if len(waiting) == LANES:
            _fly(plan, waiting, schedules, out)
            waiting = []
    if waiting:
        _fly(plan, waiting, schedules, out)
    return [out[run] for run in runs]


def failure_reason(fault: Exception) -> Issue:
    """Return why a flight failed: message and code of a refusal, else type and message of the exception."""
    if isinstance(fault, GateError):
        return Issue(str(fault), fault.codes[0])
    return Issue(f"{type(fault).__name__}: {fault}")


def _failed(plan: Plan, run: int, reason: Issue) -> Row:
    points = len(plan.window.history_time_s())
    nothing = np.full((len(plan.histories), points), np.nan)
    return Row(run, reason, np.nan, dict.fromkeys(plan.scalars, np.nan), nothing)


def _fly(plan: Plan, waiting: list[tuple[int, Case, Start]], schedules: list[Schedule], out: dict[int, Row]) -> None:
    flights = fly_legs(plan.scenario.vehicle, [w[0] for w in waiting], [w[2] for w in waiting], schedules)
    for (run, case, start), flown in zip(waiting, flights, strict=True):
        try:
            records = records_of(flown, case.vehicle, start.atmosphere)
        except GateError as fault:
            out[run] = _failed(plan, run, failure_reason(fault))
            continue
        ended = plan.window.from_s + plan.window.record_s * (len(flown.aux) - 1) if flown.diverged else np.nan
        numbers = scalars_of(records, plan.scalars, plan.window)
        out[run] = Row(run, NO_FAULT, ended, numbers, _histories_of(records, plan.histories, plan.window))

"""Flights of a dispersions file, side by side: from draws to named numbers and histories.

The joint is locked until the shell is inflated. There the vehicle is rigid and outside the air, and flown with longer
steps; then with the scenario's own. Only the window is recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flightmodel.checks import ConfigError, FloatArray, GateError
from synthetic_flight import packing
from synthetic_flight.dispersions import Case, Dispersions, Window, dispersed_case
from synthetic_flight.ensemble import LANES, Schedule, Start, fly_legs
from synthetic_flight.outputs import histories_of, records_of, scalars_of
from synthetic_flight.scenarios import Scenario, TimeSpan, initial_state
from synthetic_flight.step_size import check_step

# a rigid vehicle outside the air turns at some tenths of a radian a second: errors of 1e-9 a step
LOCKED_STEP_S = 0.02


@dataclass(frozen=True)
class Plan:
    """What every flight of a study shares: scenario, dispersions, window, and what is kept."""

    scenario: Scenario
    dispersions: Dispersions
    window: Window
    scalars: tuple[str, ...]
    histories: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """What is kept of one flight; ``reason`` says why there is nothing, ``diverged_s`` when its joint passed 90 deg."""

    run: int
    reason: str
    diverged_s: float
    scalars: dict[str, float]
    histories: FloatArray


def legs(time: TimeSpan, window: Window, locked: bool) -> list[Schedule]:
    """Schedules from the scenario's start to the end of the window."""
    begins = time.start_s
    inflated = begins if time.inflated_s is None else max(time.inflated_s, begins)
    if not inflated <= window.from_s < window.to_s <= time.stop_s:
        raise ConfigError(
            f"window: {max(inflated, begins):g} (inflated) <= from_s = {window.from_s:g} < to_s = {window.to_s:g} <= "
            f"{time.stop_s:g} (the scenario's stop_s) is wanted"
        )
    out = []
    for start, end, step, lock in (
        (begins, inflated, LOCKED_STEP_S, True),
        (inflated, window.from_s, time.step_s, locked),
    ):
        if end > start:
            steps = int(np.ceil((end - start) / step - 1e-9))
            out.append(Schedule((end - start) / steps, steps, 2, 2 if lock else 0))
    per_record = int(np.ceil(window.record_s / time.step_s - 1e-9))
    step = window.record_s / per_record
    return [*out, Schedule(step, per_record, window.records, window.records if locked else 0)]


def start_of(case: Case, step_s: float, locked: bool) -> Start:
    """Start of a case in the lanes; `GateError` where the step is too long for its joint."""
    if not locked:
        check_step(case.vehicle, step_s)
    parameters = packing.parameter_vector(case.vehicle, *case.scales)
    return Start(initial_state(case.scenario), parameters, packing.atmosphere_table(case.profile))


def fly_runs(plan: Plan, runs: list[int], draws_of: Callable[[int], dict[str, float]]) -> list[Row]:
    """Fly runs and keep what the plan asks for, in their order.

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
        except Exception as fault:  # one flight's defect must not cost the others: its row says what
            out[run] = _failed(plan, run, reason_of(fault))
        if len(waiting) == LANES:
            _fly(plan, waiting, schedules, out)
            waiting = []
    if waiting:
        _fly(plan, waiting, schedules, out)
    return [out[run] for run in runs]


def reason_of(fault: Exception) -> str:
    """Return why a flight failed: a refusal's own words, any other fault's with its kind."""
    return str(fault) if isinstance(fault, GateError) else f"{type(fault).__name__}: {fault}"


def _failed(plan: Plan, run: int, reason: str) -> Row:
    points = len(plan.window.history_time_s())
    nothing = np.full((len(plan.histories), points), np.nan)
    return Row(run, reason, np.nan, dict.fromkeys(plan.scalars, np.nan), nothing)


def _fly(plan: Plan, waiting: list[tuple[int, Case, Start]], schedules: list[Schedule], out: dict[int, Row]) -> None:
    flights = fly_legs(plan.scenario.vehicle, [w[0] for w in waiting], [w[2] for w in waiting], schedules)
    for (run, case, start), flown in zip(waiting, flights, strict=True):
        try:
            records = records_of(flown, case.vehicle, start.atmosphere)
        except GateError as fault:
            out[run] = _failed(plan, run, str(fault))
            continue
        ended = plan.window.from_s + plan.window.record_s * (len(flown.aux) - 1) if flown.diverged else np.nan
        numbers = scalars_of(records, plan.scalars, plan.window)
        out[run] = Row(run, "", ended, numbers, histories_of(records, plan.histories, plan.window))

"""Which trajectory stands once the data's contradictions are resolved? Estimate, assess, adapt.

The first estimate (`recon.estimate`) takes every source as it is stated, and is assessed: its consistency checks, the
sensors at rest, and, where a check fails, the likelihood of single faults. Each rule of `RULES` then looks at what has
been found so far. It proposes one `Change` of what is assumed, or none; the changed case is estimated once more, and
the rule judges which of the two stands:

| rule | proposes where | stands where |
|---|---|---|
| `inertial_clock` | the oscillation shows accelerometer and gyros at different times | always |
| `tracker_clocks` | time tags of trackers explain the failed checks best | it fails no check, or both fail some |
| `wider_priors` | an error is larger than its data sheet allows | always; checks still judge what was stated |
| `contradicting_trackers` | a check about a tracker fails | all is consistent without some of its points |
| `shared_errors` | all radar sites may err together | never: it adds a check |

So a flight is estimated at most once more for each rule, and each change that stands is a finding, with what it did to
the trajectory. Where no points of one tracker explain the contradiction, the covariance grows by the difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from flightmodel.checks import Check, GateError, Issue, Progress
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory, difference, resample
from recon import fault_isolation, first_passes, hypotheses, kalman, rest, setup, survey, tracker_time
from recon.estimate import TrajectorySolution, bridge_inertial_sensors, estimate, trackers
from recon.fault_detection import UNMODELLED_CODE
from recon.fault_isolation import INFLATION, Adaptation
from recon.hypotheses import Explanation, Hypothesis
from recon.problem import Problem
from recon.settings import Settings
from recon.state import States

_LEAVE_ONE_OUT_RATE_HZ = 5.0  # of the trajectories in which one tracker is left out
_LINEAR_LAG_S = 0.03  # of an oscillation of a second's period a tenth of a radian


@dataclass(frozen=True)
class Case:
    """Inputs of an estimate."""

    telemetry: Telemetry
    settings: Settings
    adaptation: Adaptation

    def solved(self, report: Progress | None = None) -> TrajectorySolution:
        """Estimate the case."""
        return estimate(self.telemetry, self.settings, report, self.adaptation)

    def adapted(self, solution: TrajectorySolution, **changes: object) -> Case:
        """Return the case with what its solution found, and changes of that."""
        return replace(self, adaptation=replace(solution.adaptation, **changes))  # type: ignore[arg-type]

    def coarse(self) -> Settings:
        """Settings of estimates that are only compared."""
        rate_hz = min(self.settings.output_rate_hz, _LEAVE_ONE_OUT_RATE_HZ)
        return replace(self.settings, output_rate_hz=rate_hz, pulse_rate_hz=0.0)


@dataclass(frozen=True)
class Assessed:
    """A case with its solution, corrections known before any estimate, and single faults for the failed checks."""

    case: Case
    solution: TrajectorySolution
    at_rest: Adaptation
    faults: tuple[Explanation, ...]


@dataclass(frozen=True)
class Change:
    """One change of what is assumed.

    Parameters
    ----------
    words : str
        What was changed.
    case : Case or None
        What is estimated instead; None where nothing is.
    selected : callable
        Takes the new solution, and returns what stands; None where that is ``otherwise``.
    otherwise : TrajectorySolution
    """

    words: str
    case: Case | None
    selected: Callable[[TrajectorySolution], TrajectorySolution | None]
    otherwise: TrajectorySolution


Rule = Callable[[Assessed, Progress], Change | None]


def reconstruct(
    telemetry: Telemetry, settings: Settings | None = None, progress: Progress | None = None
) -> TrajectorySolution:
    """Estimate a flight, and once more for each change that its contradictions ask for.

    Parameters
    ----------
    telemetry : Telemetry
    settings : Settings, optional
        Those of ``[reconstruction]`` in the flight's file where not given.
    progress : callable, optional
        Called with the fraction done and what is being done.

    Raises
    ------
    GateError
        Where the data cannot start or carry a filter (no common span, too few points, prior out of reach).
    """
    settings = settings or Settings.from_mapping(telemetry.reconstruction)
    report = progress or (lambda _fraction, _what: None)
    at_rest = _checks_at_rest(telemetry, settings)
    known = Adaptation(inflated_sd=rest.inflated_priors(telemetry, at_rest, INFLATION))
    case = Case(telemetry, settings, known)
    solution = case.solved(lambda f, what: report(0.5 * f, what))
    now = Assessed(case, solution, known, _single_faults(case, solution, report))
    for rule in RULES:
        now = _adapted(now, rule(now, report), report)
    telemetry, solution = now.case.telemetry, now.solution
    times, lags, table = tracker_time.judged_by_the_stated(
        telemetry, solution.adaptation.late_s, solution.sensor_errors, settings.check_confidence
    )
    report(1.0, "done")
    return replace(
        solution,
        sensor_errors=table,
        consistency_checks=(*solution.consistency_checks, *at_rest, *times),
        findings=(*solution.findings, *lags, *rest.noise_findings(telemetry), *survey.unchecked_state(telemetry)),
        single_faults=now.faults,
    )


def _adapted(now: Assessed, change: Change | None, report: Progress) -> Assessed:
    """Result after a proposed change: the new one if the change is accepted, else the current one."""
    if change is None:
        return now
    unchanged = replace(now, solution=change.otherwise)
    if change.case is None:
        return unchanged
    report(0.5, change.words)
    try:
        again = change.case.solved()
    except GateError:  # a case without a trajectory explains nothing
        return unchanged
    stands = change.selected(again)
    if stands is None:
        return unchanged
    if stands.smoothed is not again.smoothed:
        return replace(now, solution=stands)
    moved = Issue(f"{change.words}: {_moved(now.solution.smoothed, again.smoothed)}", "estimated-again")
    return replace(now, case=change.case, solution=replace(stands, findings=(*stands.findings, moved)))


def _moved(before: Trajectory, after: Trajectory) -> str:
    """Text that states how far a trajectory has moved."""
    t = after.time_s[(after.time_s >= before.time_s[0]) & (after.time_s <= before.time_s[-1])]
    error = difference(resample(after, t), resample(before, t))
    metres, rad = (float(np.linalg.norm(error[:, k : k + 3], axis=1).max()) for k in (0, 6))
    return f"the trajectory moved by up to {metres:.3g} m and {np.rad2deg(rad):.2g} deg"


# ---- rules


def inertial_clock(now: Assessed, _report: Progress) -> Change | None:
    """Correct the tags of the likelier triad, where a lag is too long to be linear."""
    telemetry, first, faults = now.case.telemetry, now.solution, now.faults
    lag, swings = first.adaptation.lag, first.adaptation.oscillation
    if lag is None or not faults or abs(lag.lag_s) < _LINEAR_LAG_S:
        return None
    name = faults[0].sources[0]
    one = next(c for c in hypotheses.corrections(telemetry, swings, lag) if c.sources == (name,))
    # which of the two it is may be open: then both may still be off by all of it
    sure = len(hypotheses.likeliest(faults)) == 1
    wide_s = INFLATION * (lag.sd_s if sure else abs(lag.lag_s))
    known = Adaptation(inflated_sd={f"{triad} time bias": wide_s for triad in hypotheses.TRIADS})
    words = f"{one.words.partition(': ')[2]}: corrected"

    def selected(again: TrajectorySolution) -> TrajectorySolution:
        start_s, end_s = again.smoothed.time_s[[0, -1]].tolist()
        finding = Issue(words, "clock-corrected", name, start_s, end_s)
        failed = [replace(v, source=name if sure else "") for v in first.consistency_checks if v.code == "clock-lag"]
        checks = (*(v for v in again.consistency_checks if v.code != "clock-lag"), *failed)
        return replace(again, consistency_checks=checks, findings=(*again.findings, finding))

    return Change(f"{name}: {words}", replace(now.case, telemetry=one.telemetry, adaptation=known), selected, first)


def tracker_clocks(now: Assessed, _report: Progress) -> Change | None:
    """Set tags of trackers back."""
    first = now.solution
    late_s = tracker_time.lags(now.case.telemetry, now.faults, first.sensor_errors)
    if not late_s:
        return None

    def selected(again: TrajectorySolution) -> TrajectorySolution | None:
        return again if any(all(v.passed for v in one.consistency_checks) for one in (again, first)) else None

    case = replace(now.case, adaptation=replace(now.at_rest, late_s=late_s))
    return Change(f"{' and '.join(late_s)}: time tags set right", case, selected, first)


def wider_priors(now: Assessed, _report: Progress) -> Change | None:
    """Inflate priors that are too small; the checks of the stated priors are kept."""
    first, known = now.solution, now.at_rest.inflated_sd
    inflated = known | fault_isolation.inflated_priors(first.consistency_checks, first.sensor_errors)
    inflated |= fault_isolation.inflated_clocks(first.adaptation.lag, now.case.telemetry)
    if inflated == known:
        return None

    def selected(again: TrajectorySolution) -> TrajectorySolution:
        span = again.smoothed.time_s[[0, -1]].tolist()
        found = fault_isolation.prior_inflation_findings(again.sensor_errors, inflated, *span)
        checks, residuals = first.consistency_checks, first.residuals
        return replace(again, consistency_checks=checks, residuals=residuals, findings=(*again.findings, *found))

    return Change("priors wider than stated", now.case.adapted(first, inflated_sd=inflated), selected, first)


def contradicting_trackers(now: Assessed, report: Progress) -> Change | None:
    """Reject points of the one tracker that contradicts the rest, or add the differences to the covariance."""
    case, solution = now.case, now.solution
    sources = trackers(case.telemetry, case.settings)
    if len(sources) < 2 or not fault_isolation.any_tracker_fails(solution.consistency_checks, sources):
        return None
    held_out: dict[str, pd.DataFrame] = {}

    def unmodelled(made: TrajectorySolution) -> int:
        return sum(f.code == UNMODELLED_CODE for f in made.findings)

    def rerun(source: str) -> tuple[Trajectory, tuple[Check, ...], bool]:
        report(0.5 + 0.5 * sources.index(source) / len(sources), f"without {source}")
        without = replace(case.coarse(), without=(*case.settings.without, source))
        other = replace(case, settings=without, adaptation=solution.adaptation).solved()
        held_out[source] = other.held_out
        return other.smoothed, other.consistency_checks, unmodelled(other) > unmodelled(solution)

    left_out, added = fault_isolation.leave_one_out(solution.smoothed, sources, rerun)
    rejected = fault_isolation.rejected_points(left_out, held_out, solution.residuals, case.settings.gate_probability)

    def selected(again: TrajectorySolution) -> TrajectorySolution | None:
        if any(not v.passed for v in again.consistency_checks) or unmodelled(again) > unmodelled(solution):
            return None
        checks = fault_isolation.edit_checks_with_rejected(again.consistency_checks, again.residuals, rejected)
        return replace(
            again,
            consistency_checks=checks,
            findings=(*again.findings, *fault_isolation.rejected_point_findings(rejected)),
            left_out=tuple(replace(s, inconsistent=False) for s in left_out),
        )

    enlarged = replace(
        solution,
        smoothed=fault_isolation.with_added_covariance(solution.smoothed, added),
        filtered=fault_isolation.with_added_covariance(solution.filtered, added),
        findings=(*solution.findings, *fault_isolation.leave_one_out_findings(left_out)),
        left_out=left_out,
    )
    without = case.adapted(solution, rejected_points=rejected) if rejected else None
    return Change(f"points of {' and '.join(rejected)} rejected", without, selected, enlarged)


def shared_errors(now: Assessed, _report: Progress) -> Change | None:
    """Add a failed check where an error of all radar sites together would make all data consistent."""
    case, solution = now.case, now.solution
    sources = trackers(case.telemetry, case.settings)
    names = [name for name in survey.WIDE_SD if name in set(solution.sensor_errors.name)]
    fails = len(sources) > 1 and fault_isolation.any_tracker_fails(solution.consistency_checks, sources)
    if not (fails and names and case.telemetry.has_other_positions):
        return None

    def selected(again: TrajectorySolution) -> TrajectorySolution:
        consistent = all(v.passed for v in again.consistency_checks if v.source != survey.SITES)
        found = again.sensor_errors.set_index("name").loc[names, ["estimate", "sd"]].to_numpy(dtype=float)
        check = survey.shared_error_check(found, names, consistent)
        return (
            solution if check is None else replace(solution, consistency_checks=(*solution.consistency_checks, check))
        )

    wide = replace(case.adapted(solution, inflated_sd=survey.WIDE_SD), settings=case.coarse())
    return Change("sites wider than stated", wide, selected, solution)


RULES: tuple[Rule, ...] = (inertial_clock, tracker_clocks, wider_priors, contradicting_trackers, shared_errors)


# ---- assessment


def _checks_at_rest(telemetry: Telemetry, settings: Settings) -> list[Check]:
    """Checks of the inertial sensors on the pad; none without a rest, or a place."""
    points = setup.track_points(setup.tracking_instruments(telemetry, settings, np.zeros(3)))[1]
    return rest.rest_checks(telemetry, settings.check_confidence, points[0]) if len(points) else []


def _single_faults(case: Case, solution: TrajectorySolution, report: Progress) -> tuple[Explanation, ...]:
    """Single hypotheses where a check fails, likeliest first; of both triads where their oscillation shows it."""
    of_readings = fault_isolation.ABOUT_DECELERATION
    if all(check.passed or check.code in of_readings for check in solution.consistency_checks):
        return ()
    report(0.5, "trying single faults")
    telemetry, settings = case.telemetry, case.settings
    known, swings = solution.adaptation, solution.adaptation.oscillation
    candidates = by_oscillation = hypotheses.corrections(telemetry, swings, known.lag)
    if not by_oscillation:
        prior_sd = dict(zip(solution.sensor_errors.name, solution.sensor_errors.prior_sd, strict=True))
        candidates = hypotheses.hypotheses_of(telemetry, trackers(telemetry, settings), prior_sd)
    coarse = replace(settings, output_rate_hz=min(settings.output_rate_hz, 1.0), pulse_rate_hz=0.0)
    try:
        as_stated = _coarse_problem(telemetry, coarse, known)

        def filtered(one: Hypothesis) -> tuple[Problem, kalman.ForwardPass, States]:
            # most hypotheses are of the data as delivered, whose screening and integration take the time
            problem = as_stated if one.telemetry is telemetry else _coarse_problem(one.telemetry, coarse, known)
            problem = fault_isolation.with_inflated_priors(problem, one.inflated_sd)
            thinned, _ = hypotheses.with_noise(problem, one.noisier).thinned(first_passes.THINNED_STEP_S)
            return first_passes.converged(thinned, coarse.engine)

        stated, _ = kalman.log_likelihood(*filtered(Hypothesis("", "", (), telemetry))[:2])
    except GateError:
        return ()
    found: list[Explanation] = []
    if not np.isfinite(stated):
        return ()
    for one in candidates:
        try:
            likelihood, misfit = kalman.log_likelihood(*filtered(one)[:2])
        except GateError:
            continue
        found.append(Explanation(one.code, one.words, one.sources, likelihood - stated, misfit))
    if not by_oscillation:
        found += tracker_time.late_trackers(telemetry, settings.without, filtered)
    # what the oscillation has shown needs no other proof: the trackers only say which of the two it is
    shown = known.lag is not None or (bool(found) and found[0].code == "triads-axes")
    return hypotheses.ranked(found, shown)


def _coarse_problem(telemetry: Telemetry, coarse: Settings, known: Adaptation) -> Problem:
    sensors = bridge_inertial_sensors(telemetry, replace(known, rejected_offsets=()))
    return setup.build_problem(telemetry, coarse, sensors, known.rejected_points)

"""Which part of the data or of the models is wrong, and what is the trajectory worth then? Fault isolation.

**Leave-one-out comparison of trackers.** A filter that meets two sources it cannot reconcile edits one and keeps its
covariance, though nothing may show which of the two is wrong. So where a check about a tracker fails, the flight is
reconstructed again without each tracker. Leaving out consistent data moves the answer ``e`` by no more than
``P_without - P_with`` allows (Hausman). A solution that lies further away, and in which all else is consistent, is
another answer that the data support: the reported covariance is enlarged by ``e e^T``, and a finding says so. (Where
no solution is consistent, every one of them is added.) Where without exactly one tracker all else is consistent, and
the answer lies elsewhere, that tracker's points are judged by the trajectory without it, those beyond the gate are
rejected, and the flight is reconstructed once more with the others. Where everything is consistent then, that is the
answer, with the covariance as computed.

**Prior inflation.** An a priori standard deviation that is too small pulls the estimate towards zero, and with it the
trajectory, while both covariances stay as small as the data sheet claims. So where the check of a data sheet fails, the
flight is reconstructed once more with inflated priors of the errors concerned. The checks, which judge what was
stated, stay those of the first time.

**Fault hypotheses.** Failed checks become sentences, the most likely first. Where leaving one tracker out makes
everything else consistent, it is the tracker; where leaving out any of several does, they contradict each other; where
none does, it is what all of them share: the inertial sensors or the motion. An error larger than its data sheet comes
next, then process noise, then the attitude check, and last the air, which takes no part in the trajectory.

References
----------
J. Hausman, "Specification tests in econometrics", Econometrica 46 (1978) 1251 (the covariance of ``e``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from flightmodel.checks import BoolArray, Check, FloatArray, GateError, Issue
from flightmodel.statistics import chi_square_quantile
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory, difference, nearest_index, resample
from recon.consistency import SAME_STRETCH_S, beyond_gate, edit_check
from recon.hypotheses import TRIADS, Explanation, likeliest
from recon.imu_screening import ClockJump, TransientOffset
from recon.measurements import SITES
from recon.oscillation import Oscillation
from recon.problem import Problem
from recon.state import KINEMATIC, MOST_KEPT_SD
from recon.time_bias import Lag

_CONFIDENCE = 0.999  # of each test: of some twenty a flight, one false alarm in fifty flights
_LEAST_LOST = 0.05  # of its variance that a solution loses by leaving a source out, for the test
_ABOUT_SOURCES = ("nis", "whiteness", "edited", "held-out", "data-sheet")  # codes of checks about one tracker or sensor
# of checks of the air; the drag shows density times C_A times area over mass: what is off may be in either file
_AIR_SOURCES = {
    **dict.fromkeys(("sounding", "sounding-density"), ("atmosphere", "vehicle")),
    "pre-flight-drag": ("vehicle", "atmosphere"),
    **dict.fromkeys(("sounding-temperature", "drag-jump", "sounding-wind"), ("atmosphere",)),
    "force-residuals": ("air",),
}
_SHARED_CODES = ("place", "sites")  # about what all trackers share
_ABOUT_BOTH = ("clock-lag", "triads-axes")
# of readings that the drag follows: no likelihood of theirs is for or against another fault
ABOUT_DECELERATION = ("reading-jump", "vacuum-reading", "lateral-reading")
INFLATION = 3.0  # times the estimate: wide enough not to pull, for the estimate was already pulled


@dataclass(frozen=True)
class LeftOut:
    """Solution without one tracker: the checks that still fail, and its distance from the full solution.

    Parameters
    ----------
    source : str
    failed : tuple of Check or None
        None where no trajectory can be made without it.
    distance_m : float
        Largest distance from the solution with all sources.
    inconsistent : bool
        Whether it is further away than the covariances allow, somewhere.
    start_s, end_s : float
        Where it is; NaN where it is nowhere.
    unmodelled : bool
        Whether the rest can be followed only with unmodelled accelerations that all sources together do not need.
    """

    source: str
    failed: tuple[Check, ...] | None
    distance_m: float = 0.0
    inconsistent: bool = False
    start_s: float = float("nan")
    end_s: float = float("nan")
    unmodelled: bool = False

    @property
    def resolves(self) -> bool:
        """Whether everything else is consistent without it."""
        return self.failed is not None and not self.failed and not self.unmodelled


@dataclass(frozen=True)
class Adaptation:
    """Corrections found by one reconstruction and reused by re-runs of the same flight.

    Parameters
    ----------
    inflated_sd : dict
        Errors whose a priori standard deviations are too small, and what to take instead.
    rejected_offsets : tuple of TransientOffset or None
        Readings with a transient offset that the trackers do not support; None where that is still to be found.
    jumps : tuple of ClockJump or None
        Of the inertial sensors' clocks; None where that is still to be found.
    lag : Lag or None
        Of the accelerometer's tags behind the gyros', where it is more than their data sheets allow.
    oscillation : Oscillation or None
        What the oscillation of the vehicle shows of accelerometer and gyros.
    rejected_points : dict
        By name of a tracker, times (k,) of its points that all the rest of the flight contradicts.
    late_s : dict
        By name of a tracker, by how much its tags are set back (`recon.tracker_time`).
    """

    inflated_sd: dict[str, float] = field(default_factory=dict)
    rejected_offsets: tuple[TransientOffset, ...] | None = None
    jumps: tuple[ClockJump, ...] | None = None
    lag: Lag | None = None
    oscillation: Oscillation | None = None
    rejected_points: dict[str, FloatArray] = field(default_factory=dict)
    late_s: dict[str, float] = field(default_factory=dict)


NO_ADAPTATION = Adaptation()


# ---- leave-one-out comparison of trackers


def is_about(check: Check, source: str) -> bool:
    """Whether a check judges this tracker: its residuals, its edits or its a priori errors."""
    return check.code in _ABOUT_SOURCES and check.source == source and not is_generous(check)


def is_generous(check: Check) -> bool:
    """Whether residuals are smaller than predicted: the stated noise is too large, and no sensor is at fault."""
    return check.code == "nis" and check.value < check.low


def any_tracker_fails(checks: tuple[Check, ...], sources: tuple[str, ...]) -> bool:
    """Whether any failed check is about a tracker."""
    return any(not v.passed and is_about(v, s) for v in checks for s in sources)


def leave_one_out(
    smoothed: Trajectory,
    sources: tuple[str, ...],
    rerun: Callable[[str], tuple[Trajectory, tuple[Check, ...], bool]],
) -> tuple[tuple[LeftOut, ...], FloatArray]:
    """Leave-one-out results of all sources, and the covariance to add, (n, 9, 9).

    Parameters
    ----------
    smoothed : Trajectory
        With all sources.
    sources : tuple of str
    rerun : callable
        Trajectory and checks without a source, and whether it needs unmodelled accelerations of its own; `GateError`
        where there is none.
    """
    out: list[LeftOut] = []
    moved: list[FloatArray] = []
    for source in sources:
        moved.append(np.zeros((len(smoothed.time_s), 9)))
        try:
            other, checks, unmodelled = rerun(source)
        except GateError:
            out.append(LeftOut(source, None))
            continue
        failed = tuple(v for v in checks if not v.passed and not is_about(v, source))
        inside, error, far = _compared(smoothed, other)
        moved[-1][inside] = error
        distance = float(np.linalg.norm(error[:, :3], axis=1).max())
        t = smoothed.time_s[inside][far]
        start, end = (float(t[0]), float(t[-1])) if far.any() else (np.nan, np.nan)
        out.append(LeftOut(source, failed, distance, bool(far.any()), start, end, unmodelled))
    supported = [e for s, e in zip(out, moved, strict=True) if s in _supported(tuple(out))]
    return tuple(out), sum((e[:, :, None] * e[:, None, :] for e in supported), np.zeros((len(smoothed.time_s), 9, 9)))


def _supported(left_out: tuple[LeftOut, ...]) -> list[LeftOut]:
    """Inconsistent solutions that the data support: those without contradiction, or all where there are none."""
    any_resolves = any(s.resolves for s in left_out)
    return [s for s in left_out if s.inconsistent and (s.resolves or not any_resolves)]


def _compared(smoothed: Trajectory, other: Trajectory) -> tuple[BoolArray, FloatArray, BoolArray]:
    """Common times (n,) of two solutions, their difference (k, 9), and where it exceeds its limit."""

    inside = np.asarray((smoothed.time_s >= other.time_s[0]) & (smoothed.time_s <= other.time_s[-1]))
    there, mine = (resample(path, smoothed.time_s[inside]) for path in (other, smoothed))
    assert there.covariance is not None
    assert mine.covariance is not None
    error = difference(there, mine)
    size = np.linalg.norm(error[:, :3], axis=1)
    unit = error[:, :3] / np.maximum(size, 1e-30)[:, None]
    along, lost = (
        np.einsum("ni,nij,nj->n", unit, p[:, :3, :3], unit)
        for p in (there.covariance, there.covariance - mine.covariance)
    )
    limit = chi_square_quantile(_CONFIDENCE, 3)
    return inside, error, np.asarray(size**2 > limit * np.maximum(lost, _LEAST_LOST * along))


def with_added_covariance(trajectory: Trajectory, added: FloatArray) -> Trajectory:
    """Trajectory whose covariance covers another answer that the data support."""
    assert trajectory.covariance is not None
    return replace(trajectory, covariance=trajectory.covariance + added)


def leave_one_out_findings(left_out: tuple[LeftOut, ...]) -> list[Issue]:
    """One finding for each source whose exclusion enlarged the covariance."""
    return [
        Issue(
            f"without it the trajectory moves by up to {s.distance_m:.0f} m, more than the standard deviations allow; "
            "they were enlarged by the difference",
            "tracker-inconsistent", s.source, s.start_s, s.end_s,
        )
        for s in _supported(left_out)
    ]  # fmt: skip


def rejected_points(
    left_out: tuple[LeftOut, ...], held_out: dict[str, pd.DataFrame], residuals: pd.DataFrame, gate: float
) -> dict[str, FloatArray]:
    """Times of points beyond the gate of the trajectory without them, by instrument; empty without a single cause.

    Parameters
    ----------
    left_out : tuple of LeftOut
    held_out : dict of DataFrame
        By tracker, `recon.consistency` of the reconstruction without it.
    residuals : DataFrame
        With all trackers; where the other table was thinned, a point is judged with the nearest that is there.
    gate : float
        Probability of a single component.
    """

    resolving = [s for s in left_out if s.resolves]
    if len(resolving) != 1 or not resolving[0].inconsistent:
        return {}
    table, source = held_out[resolving[0].source], resolving[0].source
    out = {}
    for name, far in beyond_gate(table, gate).groupby("source"):
        if str(name) == source or str(name).startswith(f"{source} "):
            judged = far.droplevel("source")
            times = np.unique(residuals.time_s[residuals.source == name])
            out[str(name)] = times[judged.to_numpy()[nearest_index(judged.index.to_numpy(), times)]]
    return {name: times for name, times in out.items() if len(times)}


def edit_checks_with_rejected(
    checks: tuple[Check, ...], residuals: pd.DataFrame, rejected: dict[str, FloatArray]
) -> tuple[Check, ...]:
    """Checks in which rejected points count as edited."""
    again = {}
    for name, times in rejected.items():
        mine = residuals[residuals.source == name].drop_duplicates("time_s")
        at = mine.time_s.to_numpy()
        out = np.abs(times[nearest_index(times, at)] - at) < 1e-5
        offered = mine.used.to_numpy() | out
        check = edit_check(name, (mine.accepted.to_numpy() & ~out)[offered])
        again[check.name] = check
    known = {v.name for v in checks}  # of a tracker without any accepted point there is none
    made = [replace(again[v.name], source=v.source) if v.name in again else v for v in checks]
    return (*made, *(v for name, v in again.items() if name not in known))


def rejected_point_findings(rejected: dict[str, FloatArray]) -> list[Issue]:
    """One finding for each stretch of rejected points."""
    out = []
    for name, times in rejected.items():
        for part in np.split(times, np.flatnonzero(np.diff(times) > SAME_STRETCH_S) + 1):
            remark = f"{len(part)} track points contradict all other data, with which its other points agree: rejected"
            out.append(Issue(remark, "track-points-rejected", name, float(part[0]), float(part[-1])))
    return out


# ---- prior inflation


def inflated_priors(checks: tuple[Check, ...], table: pd.DataFrame) -> dict[str, float]:
    """Standard deviations to take instead, by name of the error; empty where every data sheet is consistent.

    Parameters
    ----------
    checks : tuple of Check
    table : DataFrame
        ``name, treated, prior_sd, estimate, sd``.
    """
    out: dict[str, float] = {}
    for check in checks:
        if check.passed or check.code != "data-sheet":
            continue
        observable = (table.treated == "estimated") & (table.sd < MOST_KEPT_SD * table.prior_sd)
        mine = table[table.name.str.startswith(f"{check.source} ") & observable]
        shift_sd = np.sqrt(mine.prior_sd**2 - mine.sd**2)
        far = mine[mine.estimate.abs() > check.high * shift_sd]
        out |= {str(name): INFLATION * abs(float(found)) for name, found in zip(far.name, far.estimate, strict=True)}
    return out


def inflated_clocks(lag: Lag | None, telemetry: Telemetry) -> dict[str, float]:
    """Standard deviations to take instead of those of the inertial clocks, where they differ by more than stated."""
    if lag is None:
        return {}
    sensors = telemetry.accelerometer, telemetry.rates
    return {f"{t.spec.name} time bias": INFLATION * abs(lag.lag_s) for t in sensors if t is not None}


def with_inflated_priors(problem: Problem, inflated_sd: dict[str, float]) -> Problem:
    """Problem with larger a priori standard deviations of the errors named."""
    covariance = problem.start_covariance.copy()
    for name, sd in inflated_sd.items():
        if name not in problem.model.names:
            continue  # of an instrument that takes no part this time
        k = problem.model.names.index(name)
        covariance[KINEMATIC + k, KINEMATIC + k] += max(0.0, sd**2 - float(problem.model.prior_sd[k]) ** 2)
    return replace(problem, start_covariance=covariance)


def prior_inflation_findings(
    table: pd.DataFrame, inflated_sd: dict[str, float], start_s: float, end_s: float
) -> list[Issue]:
    """One finding for each error whose prior was inflated."""
    rows = table.set_index("name")
    return [
        Issue(
            f"{name}: {rows.estimate[name]:.3g} ± {rows.sd[name]:.2g} {rows.unit[name]}; a priori sd inflated from "
            f"{rows.prior_sd[name]:.2g} to {sd:.2g} {rows.unit[name]}",
            "prior-inflated", name.split()[0], start_s, end_s,
        )
        for name, sd in inflated_sd.items()
        if name in rows.index
    ]  # fmt: skip


# ---- fault hypotheses


def isolate_faults(
    checks: tuple[Check, ...], left_out: tuple[LeftOut, ...], singles: tuple[Explanation, ...] = ()
) -> tuple[Issue, ...]:
    """Fault hypotheses, the most likely first; none where every check passes."""
    failed = [v for v in checks if not v.passed]
    if not failed:
        return ()
    first = _single_hypothesis(singles)
    return (*first, *_from_checks(failed, left_out))


def _single_hypothesis(singles: tuple[Explanation, ...]) -> tuple[Issue, ...]:
    """What one fault explains best, with those that are hardly less likely."""
    if not singles:
        return ()
    named = likeliest(singles)
    words = " or ".join(dict.fromkeys(one.words for one in named))
    sources = tuple(dict.fromkeys(name for one in named for name in one.sources))
    rest = singles[len(named) :]
    odds = f"; odds over {rest[0].words}: 1e{(named[0].gain - rest[0].gain) / np.log(10.0):.0f}" if rest else ""
    return (Issue(f"{words}: this one fault explains the data best{odds}", named[0].code, sources),)


def _from_checks(failed: list[Check], left_out: tuple[LeftOut, ...]) -> tuple[Issue, ...]:
    """What the failed checks and the comparison of trackers say."""
    inertial = [v for v in failed if v.code == "data-sheet" and v.source in TRIADS]
    inertial += [v for v in failed if v.code in _ABOUT_BOTH + ABOUT_DECELERATION]
    shared = [v for v in failed if v.code in _SHARED_CODES or (v.code == "data-sheet" and v.source == SITES)]
    out = [Issue(f"radar sites: {v.remark}", "sites", (v.source,)) for v in shared]
    if any(is_about(v, s.source) for v in failed for s in left_out):
        out.append(_tracker_hypothesis(failed, left_out, inertial))
    elif not left_out:
        out += _single_tracker_hypothesis(failed)
    resolved = any(s.resolves for s in left_out)
    if inertial and not resolved and not any(h.code == "inertial-or-motion" for h in out):
        out.append(Issue(_inertial(inertial), "inertial-sensors", _inertial_sources(inertial)))
    if any(v.code == "filter-smoother" for v in failed) and not out:
        what = "motion: filter and smoother differ by more than sensor noise and errors explain"
        out.append(Issue(what, "motion"))
    rest: list[tuple[str, Check, tuple[str, ...]]] = []
    rest += [("attitude", v, (v.source,)) for v in failed if v.code.startswith("attitude-")]
    of_air = sorted((v for v in failed if v.code in _AIR_SOURCES), key=lambda v: -v.value / v.high)
    rest += [("air", v, _AIR_SOURCES[v.code]) for v in of_air]  # the farthest beyond its limit first
    rest += [("error-model", v, (v.source,)) for v in failed if v.code == "physical-range"]
    rest += [("stated-noise", v, (v.source,)) for v in failed if is_generous(v)]
    sentences = {Issue(f"{what}: {v.remark}", what, names): None for what, v, names in rest}
    return (*out, *sentences)


def _tracker_hypothesis(failed: list[Check], left_out: tuple[LeftOut, ...], inertial: list[Check]) -> Issue:
    """Hypothesis from the leave-one-out comparison, where a check about a tracker failed."""
    resolving = [s for s in left_out if s.resolves]
    names = tuple(s.source for s in resolving)
    if len(resolving) == 1:
        s = resolving[0]
        own = _symptoms([v for v in failed if is_about(v, s.source)])
        moves = f", and the trajectory moves by up to {s.distance_m:.0f} m" if s.inconsistent else ""
        own = f" ({own})" if own else ""
        return Issue(f"{s.source}{own}: without it all other data are consistent{moves}", "tracker", names)
    if len(resolving) > 1:
        distance = max(s.distance_m for s in resolving)
        return Issue(
            f"{' and '.join(names)} contradict each other by up to {distance:.0f} m: leaving out either makes all else "
            "consistent, so the data cannot tell which is wrong; check sites, calibration and time tags of both",
            "trackers-contradict",
            names,
        )
    touched = [s.source for s in left_out if any(is_about(v, s.source) for v in failed)]
    if len(touched) == 1 and not inertial:
        own = _symptoms([v for v in failed if is_about(v, touched[0])])
        what = f"{touched[0]} ({own}): only its residuals fail, but without it the rest is not consistent either"
        return Issue(what, "tracker-residuals", tuple(touched))
    largest = _inertial(inertial) if inertial else "no data sheet's error stands out"
    return Issue(
        f"inertial sensors or motion: leaving out one tracker does not make the rest consistent; {largest}",
        "inertial-or-motion",
        _inertial_sources(inertial),
    )


def _single_tracker_hypothesis(failed: list[Check]) -> list[Issue]:
    """Hypotheses for a flight in which no tracker could be left out."""
    about = [v for v in failed if v.code in _ABOUT_SOURCES and not (v.code == "data-sheet" and v.source in TRIADS)]
    about = [v for v in about if not is_generous(v)]
    if not about:
        return []
    what = f"tracker or motion ({_symptoms(about)}): with one tracker alone the two cannot be separated"
    return [Issue(what, "tracker-or-motion", tuple(dict.fromkeys(v.source for v in about)))]


def _inertial(checks: list[Check]) -> str:
    worst = max(checks, key=lambda v: abs(v.value) / max(v.high, np.finfo(float).tiny))
    if worst.component.startswith("mount"):
        names = " or ".join(f"{v.source} {v.component}" for v in checks if v.component.startswith("mount"))
        return (
            f"inertial sensors: {names}; mounting of accelerometer and gyros is observable only relative to each other"
        )
    return f"inertial sensors: {worst.remark}"


def _inertial_sources(checks: list[Check]) -> tuple[str, ...]:
    names = [name for v in checks for name in ((v.source,) if v.source else TRIADS)]
    return tuple(dict.fromkeys(names))


def _symptoms(checks: list[Check]) -> str:
    return "; ".join(dict.fromkeys(v.symptom for v in checks))

"""Do the trackers contradict each other, and what is the trajectory worth then? Each is left out in turn.

A filter that meets two sources it cannot reconcile edits one and stays as sure as before, though nothing may tell
which of the two is wrong. So where a verdict about a tracker is red, the flight is reconstructed again without each
tracker. Leaving out data that fit moves the answer ``e`` by no more than ``P_without - P_with`` allows. A solution that
lies further away, and in which all else agrees, is another answer that the data support: the reported covariance is
enlarged by ``e e^T``, and a finding says so. (Where nothing agrees whichever is left out, every one of them is added.)
Whether the rest agrees without a tracker is evidence for `recon.fault_isolation`.

Where it is one tracker alone without which all else agrees, and the answer lies elsewhere, the others need not follow
it: its points are judged by the trajectory without it, those beyond the gate are denied, and with the rest of them the
flight is reconstructed once more. Where everything agrees then, that is the answer, and as sure as it says.

References
----------
J. Hausman, "Specification tests in econometrics", Econometrica 46 (1978) 1251 (the covariance of ``e``).

What if the flight finds an error far beyond its data sheet? Then the sheet is wrong, and is not held on to.

A prior that is too narrow pulls the estimate towards nothing, and with it the trajectory, while both stay as sure as
the sheet claims. So where the verdict on a sheet is red, the flight is reconstructed once more with wide priors of the
errors that made it so. The verdicts, which judge what was stated, stay those of the first time.

Which part of the flight's data or models is most likely wrong? Red verdicts turned into sentences.

Evidence comes in this order. Where leaving one tracker out makes everything else agree, it is the tracker; where
leaving out any of several does, they contradict each other and nothing tells which is wrong; where no tracker can be
left out to that effect, it is what all of them meet: the inertial sensors or the motion. An error that the flight
found larger than its data sheet comes next, then the noise of the motion, then what magnetometer and Sun sensors say of
the attitude, and last the air, which takes no part in the trajectory and can only be as wrong as the trajectory is
right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.telemetry import Finding
from flightmodel.trajectory import Trajectory, difference, resample
from recon.consistency import MOST_KEPT_SD, ConsistencyCheck, edit_check
from recon.imu_screening import Displaced
from recon.problem import Problem, nearest_index
from recon.product import SAME_STRETCH_S
from recon.state import KINEMATIC
from recon.time_bias import ClockJump, Lag

CONFIDENCE = 0.999
LEAST_LOST = 0.05  # of its variance that a solution loses by leaving a source out, for the test
ABOUT_TRACKERS = ("NIS", "whiteness", "edited", "data sheet")


@dataclass(frozen=True)
class LeftOut:
    """One tracker left out: which verdicts stay red without it, and how far away that solution lies.

    Parameters
    ----------
    source : str
    red : tuple of Verdict or None
        None where no trajectory can be made without it.
    disturbed : bool
        Whether the rest can be followed only with accelerations that nothing tells, which all sources together do not
        ask for.
    apart_m : float
        Largest distance from the solution with all sources.
    apart : bool
        Whether it is further away than the covariances allow, somewhere.
    start_s, end_s : float
        Where it is; NaN where it is nowhere.
    """

    source: str
    red: tuple[ConsistencyCheck, ...] | None
    apart_m: float = 0.0
    apart: bool = False
    start_s: float = float("nan")
    end_s: float = float("nan")
    disturbed: bool = False

    @property
    def cures(self) -> bool:
        """Whether everything else agrees without it."""
        return self.red is not None and not self.red and not self.disturbed


def is_about(consistency_check: ConsistencyCheck, source: str) -> bool:
    """Whether a verdict judges this tracker: its residuals, its edits or its stated errors."""
    kind = next((k for k in ABOUT_TRACKERS if consistency_check.name.startswith(f"{k} ")), None)
    if kind is None:
        return False
    rest = consistency_check.name.removeprefix(f"{kind} ")
    return rest == source or rest.startswith(f"{source} ")


def suspicious(consistency_checks: tuple[ConsistencyCheck, ...], sources: tuple[str, ...]) -> bool:
    """Whether any red verdict is about a tracker."""
    return any(not v.passed and is_about(v, s) for v in consistency_checks for s in sources)


def leave_each_out(
    smoothed: Trajectory,
    sources: tuple[str, ...],
    rerun: Callable[[str], tuple[Trajectory, tuple[ConsistencyCheck, ...], bool]],
) -> tuple[tuple[LeftOut, ...], FloatArray]:
    """What happens without each source, and what to add to the covariance, (n, 9, 9).

    Parameters
    ----------
    smoothed : Trajectory
        With all sources.
    sources : tuple of str
    rerun : callable
        Trajectory and verdicts without a source, and whether it asks for accelerations of its own; `GateError` where
        there is none.
    """
    out: list[LeftOut] = []
    moved: list[FloatArray] = []
    for source in sources:
        try:
            other, consistency_checks, disturbed = rerun(source)
        except GateError:
            out.append(LeftOut(source, None))
            moved.append(np.zeros((len(smoothed.time_s), 9)))
            continue
        red = tuple(v for v in consistency_checks if not v.passed and not is_about(v, source))
        inside, error, far = _apart(smoothed, other)
        moved.append(np.zeros((len(smoothed.time_s), 9)))
        moved[-1][inside] = error
        distance = float(np.linalg.norm(error[:, :3], axis=1).max())
        t = smoothed.time_s[inside][far]
        start, end = (float(t[0]), float(t[-1])) if far.any() else (np.nan, np.nan)
        out.append(LeftOut(source, red, distance, bool(far.any()), start, end, disturbed))
    cured = any(s.cures for s in out)
    supported = [e for s, e in zip(out, moved, strict=True) if s.apart and (s.cures or not cured)]
    return tuple(out), sum((e[:, :, None] * e[:, None, :] for e in supported), np.zeros((len(smoothed.time_s), 9, 9)))


def _apart(smoothed: Trajectory, other: Trajectory) -> tuple[BoolArray, FloatArray, BoolArray]:
    """Times (n,) that both solutions cover, their difference (k, 9) there, and where it is further than allowed."""
    from scipy.stats import chi2

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
    limit = float(chi2.ppf(CONFIDENCE, 3))
    return inside, error, np.asarray(size**2 > limit * np.maximum(lost, LEAST_LOST * along))


def widened_trajectory(trajectory: Trajectory, more: FloatArray) -> Trajectory:
    """Trajectory whose covariance holds another answer that the data support."""
    assert trajectory.covariance is not None
    return replace(trajectory, covariance=trajectory.covariance + more)


def disagreement_findings(left_out: tuple[LeftOut, ...]) -> list[Finding]:
    """One finding for each source whose being left out enlarged the covariance."""
    cured = any(s.cures for s in left_out)
    return [
        Finding(
            s.source,
            f"without it the trajectory lies up to {s.apart_m:.0f} m away, further than the standard deviations "
            "allow; they were enlarged by the difference",
            s.start_s,
            s.end_s,
        )
        for s in left_out
        if s.apart and (s.cures or not cured)
    ]


def denied_points(
    left_out: tuple[LeftOut, ...], withheld: dict[str, pd.DataFrame], residuals: pd.DataFrame, gate: float
) -> dict[str, FloatArray]:
    """Times of points beyond the gate of the trajectory without them, by instrument; empty without a lone culprit.

    Parameters
    ----------
    left_out : tuple of LeftOut
    withheld : dict of DataFrame
        By tracker, `recon.consistency` of the reconstruction without it.
    residuals : DataFrame
        With all trackers; where the other table was thinned, a point is judged with the nearest that is there.
    gate : float
        Probability of a single component.
    """
    from scipy.stats import norm

    cured = [s for s in left_out if s.cures]
    if len(cured) != 1 or not cured[0].apart:
        return {}
    table, source = withheld[cured[0].source], cured[0].source
    table = table.assign(far=table.residual.abs() > norm.ppf(0.5 * (1.0 + gate)) * table.predicted_sd)
    out = {}
    for name, rows in table.groupby("source"):
        if str(name) == source or str(name).startswith(f"{source} "):
            judged = rows.groupby("time_s").far.any()
            times = np.unique(residuals.time_s[residuals.source == name])
            out[str(name)] = times[judged.to_numpy()[nearest_index(judged.index.to_numpy(), times)]]
    return {name: times for name, times in out.items() if len(times)}


def edited_with_denied(
    consistency_checks: tuple[ConsistencyCheck, ...], residuals: pd.DataFrame, denied: dict[str, FloatArray]
) -> tuple[ConsistencyCheck, ...]:
    """Verdicts in which points that were denied count as edited."""
    again = {}
    for name, times in denied.items():
        mine = residuals[residuals.source == name].drop_duplicates("time_s")
        at = mine.time_s.to_numpy()
        out = np.abs(times[nearest_index(times, at)] - at) < 1e-5
        offered = mine.used.to_numpy() | out
        again[f"edited {name}"] = edit_check(name, (mine.accepted.to_numpy() & ~out)[offered])
    return tuple(again.get(v.name, v) for v in consistency_checks)


def denied_findings(denied: dict[str, FloatArray]) -> list[Finding]:
    """One finding for each stretch of denied points."""
    out = []
    for name, times in denied.items():
        for part in np.split(times, np.flatnonzero(np.diff(times) > SAME_STRETCH_S) + 1):
            words = f"{len(part)} track points contradict all else, with which the rest of its points agree: not used"
            out.append(Finding(name, words, float(part[0]), float(part[-1])))
    return out


SHEET = "data sheet "
TIMES = 3.0  # what was found: wide enough not to pull, for what was found was already pulled


@dataclass(frozen=True)
class Learnt:
    """What a reconstruction learnt of the data that others of the same flight, to be compared with it, start from.

    Parameters
    ----------
    wider : dict
        Errors whose stated standard deviations are too small, and what to take instead.
    doubted : tuple of Displaced or None
        Readings that jump away and back and are not believed; None where that is still to be found out.
    jumps : tuple of ClockJump or None
        Of the inertial triads' clocks; None where that is still to be found out.
    lag : Lag or None
        Of the accelerometer behind the gyros, where it is more than their sheets allow.
    denied : dict
        By name of a tracker, times (k,) of its points that all the rest of the flight contradicts.
    """

    wider: dict[str, float] = field(default_factory=dict)
    doubted: tuple[Displaced, ...] | None = None
    jumps: tuple[ClockJump, ...] | None = None
    lag: Lag | None = None
    denied: dict[str, FloatArray] = field(default_factory=dict)


NOTHING = Learnt()


def beyond_sheet(consistency_checks: tuple[ConsistencyCheck, ...], table: pd.DataFrame) -> dict[str, float]:
    """Standard deviations to take instead, by name of the error; empty where every sheet holds.

    Parameters
    ----------
    verdicts : tuple of Verdict
    table : DataFrame
        ``name, prior_sd, estimate, sd``.
    """
    out: dict[str, float] = {}
    for consistency_check in consistency_checks:
        if consistency_check.passed or not consistency_check.name.startswith(SHEET):
            continue
        owner = consistency_check.name.removeprefix(SHEET)
        learnt_of = (table.treated == "estimated") & (table.sd < MOST_KEPT_SD * table.prior_sd)
        mine = table[table.name.str.startswith(f"{owner} ") & learnt_of]
        learnt = np.sqrt(mine.prior_sd**2 - mine.sd**2)
        far = mine[mine.estimate.abs() > consistency_check.high * learnt]
        out |= {str(name): TIMES * abs(float(found)) for name, found in zip(far.name, far.estimate, strict=True)}
    return out


def with_wider_priors(problem: Problem, wider: dict[str, float]) -> Problem:
    """Problem whose start knows less of the errors named."""
    covariance = problem.start_covariance.copy()
    for name, sd in wider.items():
        if name not in problem.model.names:
            continue  # of an instrument that takes no part this time
        k = problem.model.names.index(name)
        covariance[KINEMATIC + k, KINEMATIC + k] += max(0.0, sd**2 - float(problem.model.prior_sd[k]) ** 2)
    return replace(problem, start_covariance=covariance)


def sheet_findings(table: pd.DataFrame, wider: dict[str, float], start_s: float, end_s: float) -> list[Finding]:
    """One finding for each error whose sheet was not held on to."""
    rows = table.set_index("name")
    return [
        Finding(
            name.split()[0],
            f"{name} was found to be {rows.estimate[name]:.3g} ± {rows.sd[name]:.2g} {rows.unit[name]}; the stated "
            f"{rows.prior_sd[name]:.2g} {rows.unit[name]} was not held on to",
            start_s,
            end_s,
        )
        for name in wider
        if name in rows.index
    ]


INERTIAL = ("accelerometer", "rates")
ATTITUDE = "attitude check"
CLOCKS = "clocks of "
AIR = ("sounding", "pre-flight", "air residuals")


def suspects(consistency_checks: tuple[ConsistencyCheck, ...], left_out: tuple[LeftOut, ...]) -> tuple[str, ...]:
    """Sentences, the most likely suspect first; none where every verdict passes."""
    red = [v for v in consistency_checks if not v.passed]
    sheets = [v for v in red if v.name.startswith("data sheet ")]
    inertial = [v for v in sheets if v.name.removeprefix("data sheet ") in INERTIAL]
    inertial += [v for v in red if v.name.startswith(CLOCKS)]
    out = _trackers(red, left_out, inertial) if any(is_about(v, s.source) for v in red for s in left_out) else []
    if not out and not left_out:
        out += _lone_trackers(red)
    cured = any(s.cures for s in left_out)
    if inertial and not cured and not any("inertial" in words for words in out):
        out.append(_inertial(inertial))
    if any(v.name.startswith("filter-smoother") for v in red) and not out:
        out.append("the motion: filter and smoother differ more than the sensors' noise and errors explain")
    attitude = dict.fromkeys(f"the attitude: {v.remark}" for v in red if v.name.startswith(ATTITUDE))
    return (*out, *attitude, *(f"the air: {v.remark}" for v in red if v.name.startswith(AIR)))


def _trackers(
    red: list[ConsistencyCheck], left_out: tuple[LeftOut, ...], inertial: list[ConsistencyCheck]
) -> list[str]:
    cured = [s for s in left_out if s.cures]
    if len(cured) == 1:
        s = cured[0]
        mine = "; ".join(dict.fromkeys(_short(v) for v in red if is_about(v, s.source)))
        away = f", and the trajectory moves by up to {s.apart_m:.0f} m" if s.apart else ""
        own = f" ({mine})" if mine else ""
        return [f"{s.source}{own}: without it all else agrees{away}"]
    if len(cured) > 1:
        names = " and ".join(s.source for s in cured)
        apart = max(s.apart_m for s in cured)
        return [
            f"{names} contradict each other by up to {apart:.0f} m: without either the rest agrees, and nothing in the "
            "flight tells which is wrong; check their sites, calibration and time tags"
        ]
    most = _inertial(inertial) if inertial else "no data sheet's error stands out"
    touched = [s for s in left_out if any(is_about(v, s.source) for v in red)]
    if len(touched) == 1 and not inertial:
        s = touched[0]
        mine = "; ".join(dict.fromkeys(_short(v) for v in red if is_about(v, s.source)))
        return [f"{s.source} ({mine}): its residuals alone are red, though leaving it out does not mend the rest"]
    return [f"inertial sensors or motion: no tracker can be left out so that the rest agrees; {most}"]


def _lone_trackers(red: list[ConsistencyCheck]) -> list[str]:
    """What can be said where no tracker could be left out."""
    inertial = tuple(f"data sheet {name}" for name in INERTIAL)
    about = ("NIS ", "whiteness ", "edited ", "data sheet ")
    kinds = [v for v in red if v.name.startswith(about) and v.name not in inertial]
    if not kinds:
        return []
    words = "; ".join(dict.fromkeys(_short(v) for v in kinds))
    return [f"the tracker or the motion ({words}): a second tracker would tell which"]


def _inertial(sheets: list[ConsistencyCheck]) -> str:
    worst = max(sheets, key=lambda v: abs(v.value) / max(v.high, np.finfo(float).tiny))
    if " mount " in worst.remark:
        names = " or ".join(v.remark.split(" is larger")[0] for v in sheets if " mount " in v.remark)
        return f"inertial sensors: {names}; the mounts of accelerometer and gyros are seen only against each other"
    return f"inertial sensors: {worst.remark}"


def _short(consistency_check: ConsistencyCheck) -> str:
    """Words of a verdict up to the explanation."""
    return consistency_check.remark.split(":")[0]

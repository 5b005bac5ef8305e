"""Do the trackers contradict each other, and what is the trajectory worth then? Each is left out in turn.

A filter that meets two sources it cannot reconcile edits one and stays as sure as before, though nothing may tell
which of the two is wrong. So where a verdict about a tracker is red, the flight is reconstructed again without each
tracker. Leaving out data that fit moves the answer ``e`` by no more than ``P_without - P_with`` allows. A solution that
lies further away, and in which all else agrees, is another answer that the data support: the reported covariance is
enlarged by ``e e^T``, and a finding says so. (Where nothing agrees whichever is left out, every one of them is added.)
Whether the rest agrees without a tracker is evidence for `recon.suspects`.

Where it is one tracker alone without which all else agrees, and the answer lies elsewhere, the others need not follow
it: its points are judged by the trajectory without it, those beyond the gate are denied, and with the rest of them the
flight is reconstructed once more. Where everything agrees then, that is the answer, and as sure as it says.

References
----------
J. Hausman, "Specification tests in econometrics", Econometrica 46 (1978) 1251 (the covariance of ``e``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.telemetry import Finding
from flightmodel.trajectory import Trajectory, difference, resample
from recon.consistency import Verdict, edit_verdict
from recon.problem import nearest_index
from recon.product import SAME_STRETCH_S

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
    red: tuple[Verdict, ...] | None
    apart_m: float = 0.0
    apart: bool = False
    start_s: float = float("nan")
    end_s: float = float("nan")
    disturbed: bool = False

    @property
    def cures(self) -> bool:
        """Whether everything else agrees without it."""
        return self.red is not None and not self.red and not self.disturbed


def is_about(verdict: Verdict, source: str) -> bool:
    """Whether a verdict judges this tracker: its residuals, its edits or its stated errors."""
    kind = next((k for k in ABOUT_TRACKERS if verdict.name.startswith(f"{k} ")), None)
    if kind is None:
        return False
    rest = verdict.name.removeprefix(f"{kind} ")
    return rest == source or rest.startswith(f"{source} ")


def suspicious(verdicts: tuple[Verdict, ...], sources: tuple[str, ...]) -> bool:
    """Whether any red verdict is about a tracker."""
    return any(not v.passed and is_about(v, s) for v in verdicts for s in sources)


def leave_each_out(
    smoothed: Trajectory,
    sources: tuple[str, ...],
    rerun: Callable[[str], tuple[Trajectory, tuple[Verdict, ...], bool]],
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
            other, verdicts, disturbed = rerun(source)
        except GateError:
            out.append(LeftOut(source, None))
            moved.append(np.zeros((len(smoothed.time_s), 9)))
            continue
        red = tuple(v for v in verdicts if not v.passed and not is_about(v, source))
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
        By tracker, `recon.withheld` of the reconstruction without it.
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
    verdicts: tuple[Verdict, ...], residuals: pd.DataFrame, denied: dict[str, FloatArray]
) -> tuple[Verdict, ...]:
    """Verdicts in which points that were denied count as edited."""
    again = {}
    for name, times in denied.items():
        mine = residuals[residuals.source == name].drop_duplicates("time_s")
        at = mine.time_s.to_numpy()
        out = np.abs(times[nearest_index(times, at)] - at) < 1e-5
        offered = mine.used.to_numpy() | out
        again[f"edited {name}"] = edit_verdict(name, (mine.accepted.to_numpy() & ~out)[offered])
    return tuple(again.get(v.name, v) for v in verdicts)


def denied_findings(denied: dict[str, FloatArray]) -> list[Finding]:
    """One finding for each stretch of denied points."""
    out = []
    for name, times in denied.items():
        for part in np.split(times, np.flatnonzero(np.diff(times) > SAME_STRETCH_S) + 1):
            words = f"{len(part)} track points contradict all else, with which the rest of its points agree: not used"
            out.append(Finding(name, words, float(part[0]), float(part[-1])))
    return out

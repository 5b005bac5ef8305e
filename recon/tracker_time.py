"""By how much are a tracker's time tags late, where that is more than the filter's error state can follow?

The filter has a tracker's time bias as a constant error about which the path is a short series (`recon.measurements`):
with a lag of a second beside inertial sensors it diverges, or settles elsewhere. So where a check fails, the tags are
set back by a lag that climbs the likelihood of all tracking data, `_STEP_S` at a time and then by what the filter's own
error state finds left, with a wide prior. Each radar and receiver is tried alone, and all together, which is the same
as inertial clocks that are early. Shifted, a point may leave the span of the inertial data: the likelihood is taken
over that of noise of the stated size, so that a point more or less hardly counts.

Where no other fault explains the flight better, it is reconstructed with the tags set back, and that stands where no
check of it fails. So it is where nothing is explained by any fault and the error state itself is large. The check
`clock-corrected` judges the lag by what is stated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtri

from flightmodel.checks import Check, FloatArray, GateError, Issue
from flightmodel.telemetry import Telemetry
from recon.hypotheses import Explanation, Hypothesis
from recon.kalman import ForwardPass, log_likelihood
from recon.problem import Problem
from recon.state import States

_STEP_S, _FARTHEST_S = 1.0, 10.0  # of a climb; the filter finds the way from as far
_WIDE_S = 0.5  # a priori sd of what a shift leaves
_LEAST_GAIN = 1.0  # of log likelihood, that a step is taken
_LEAST_LAG_S = 0.1  # below it the error state serves, with a wider prior
_LARGE_S, _KNOWN_SD = 0.25, 5.0  # from here on third order counts; an estimate that is not its prior's
Filtered = Callable[[Hypothesis], tuple[Problem, ForwardPass, States]]


class _Tried(NamedTuple):
    """A trial lag with its log likelihood, the mean square of the innovations, and the remaining lag in the filter."""

    late_s: float
    gain: float
    misfit: float
    rest_s: float


def with_earlier_tags(telemetry: Telemetry, late_s: Mapping[str, float]) -> Telemetry:
    """Telemetry with the tags of some trackers set back, and a time bias of at least `_WIDE_S` left to be found."""

    def shifted(records: Mapping[str, Any]) -> dict[str, Any]:
        out = dict(records)
        for name in out.keys() & late_s.keys():
            spec = replace(out[name].spec, time_bias_sd_s=max(out[name].spec.time_bias_sd_s, _WIDE_S))
            out[name] = replace(out[name], time_s=out[name].time_s - late_s[name], spec=spec)
        return out

    return replace(telemetry, radars=shifted(telemetry.radars), gnss=shifted(telemetry.gnss))


def late_trackers(telemetry: Telemetry, without: tuple[str, ...], filtered: Filtered) -> list[Explanation]:
    """Hypotheses that the tags of one tracker, or of all, are late; ``filtered`` runs the filter on thinned data."""
    names = tuple(name for name in _tracks(telemetry) if name not in without)
    if telemetry.motion.model == "ballistic" or not names:
        return []
    stated = _over_noise(*filtered(Hypothesis("", "", (), telemetry))[:2])[0]
    out = []
    for group in dict.fromkeys([*((name,) for name in names), names]):
        found = _climbed(lambda late_s, group=group: _tried(telemetry, group, late_s, filtered))  # type: ignore[misc]
        if found is not None:
            late_s = found.late_s + found.rest_s
            words = f"{' and '.join(group)}: time tags {_in_words(late_s)}"
            out.append(Explanation("time-bias", words, group, found.gain - stated, found.misfit, late_s))
    return out


def _climbed(tried: Callable[[float], _Tried | None]) -> _Tried | None:
    """Lag of the largest likelihood that is reached from none."""
    best = tried(0.0)
    for way in (_STEP_S, -_STEP_S):
        while best is not None and abs(best.late_s + way) <= _FARTHEST_S:
            other = tried(best.late_s + way)
            if other is None or other.gain <= best.gain + _LEAST_GAIN:
                break
            best = other
    for _ in range(4):
        if best is None or abs(best.rest_s) < 0.02:  # over which the path is straight
            break
        other = tried(best.late_s + best.rest_s)
        if other is None or other.gain < best.gain - _LEAST_GAIN:
            break
        best = other
    return best


def _tried(telemetry: Telemetry, names: tuple[str, ...], late_s: float, filtered: Filtered) -> _Tried | None:
    shifted = with_earlier_tags(telemetry, dict.fromkeys(names, late_s))
    try:
        problem, run, states = filtered(Hypothesis("", "", names, shifted))
    except GateError:
        return None
    gain, misfit = _over_noise(problem, run)
    left = [states.sensor_errors[-1, problem.model.column(name, "time bias")] for name in names]
    return _Tried(late_s, gain, misfit, float(np.mean(left))) if np.isfinite(gain) else None


def _over_noise(problem: Problem, run: ForwardPass) -> tuple[float, float]:
    """Log likelihood over that of noise of the stated size alone, and the innovations' mean square."""
    likelihood, misfit = log_likelihood(problem, run)
    variance: FloatArray = problem.observed.variance[problem.observed.usable]
    return likelihood + 0.5 * float(np.log(variance[np.isfinite(variance)]).sum()), misfit


def lags(telemetry: Telemetry, faults: tuple[Explanation, ...], sensor_errors: pd.DataFrame) -> dict[str, float]:
    """Corrections of trackers' tags, s: the lag that explains failed checks best, if the best explanation is a lag.

    Without such an explanation of anything, time biases that are known and too large for the series about them.
    """
    if faults:
        late_s = faults[0].late_s
        return dict.fromkeys(faults[0].sources, late_s) if abs(late_s) > _LEAST_LAG_S else {}
    if telemetry.motion.model == "ballistic":
        return {}
    names = list(_tracks(telemetry))
    rows = sensor_errors.set_index("name").reindex([f"{name} time bias" for name in names]).set_axis(names)
    large = rows.estimate.abs() > np.maximum(_LARGE_S, _KNOWN_SD * rows.sd)
    return {str(name): float(lag) for name, lag in rows.estimate[large & (rows.treated == "estimated")].items()}


def judged_by_the_stated(
    telemetry: Telemetry, late_s: Mapping[str, float], sensor_errors: pd.DataFrame, confidence: float
) -> tuple[list[Check], list[Issue], pd.DataFrame]:
    """Checks and findings of the tags that were set back, and errors of the tags as delivered."""
    checks, findings, table = [], [], sensor_errors.set_index("name")
    limit = float(ndtri(0.5 * (1.0 + confidence)))
    for name, moved_s in late_s.items():
        error, record = f"{name} time bias", _tracks(telemetry)[name]
        whole_s, sd_s = moved_s + float(table.estimate[error]), float(table.sd[error])
        stated_s = record.spec.time_bias_sd_s
        symptom = f"{name}: time tags {_in_words(whole_s)} ± {sd_s:.3f}, set right"
        made = Check.of(
            "clock-corrected", f"time of {name}", whole_s / max(stated_s, sd_s), -limit, limit, symptom, symptom,
            advice=f"it is more than stated (time_bias_sd_s = {stated_s:g}), or the inertial sensors' tags have the "
            "opposite error: check both", source=name, component="time bias",
        )  # fmt: skip
        checks.append(made)
        findings.append(Issue(symptom, "clock-corrected", name, float(record.time_s[0]), float(record.time_s[-1])))
        table.loc[error, ["prior_sd", "estimate"]] = stated_s, whole_s
    return checks, findings, table.reset_index()


def _tracks(telemetry: Telemetry) -> dict[str, Any]:
    return {**telemetry.radars, **telemetry.gnss}


def _in_words(late_s: float) -> str:
    return f"{abs(late_s):.3f} s {'late' if late_s > 0.0 else 'early'}"

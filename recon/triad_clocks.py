"""How late is one inertial triad against the other? The vehicle's own swinging tells, without any tracker.

What the flow does to a vehicle that swings pushes it aside and turns it at the same moment: across the long axis (body
x) specific force and angular acceleration are in step, each plane with a factor of its own that varies slowly with
pressure. What lever arms add, ``w' x r`` and ``w x (w x r)``, is in step as well. All of this is the same with time
reversed; damping is not: it lets the force lag by about as long as the flow takes from the c.g. to where damping
arises, for which `ARM_M` over the speed is the standard deviation. So in windows of `WINDOW_S`, ``u`` from -1/2 to 1/2,

    f_y(t) = a + b u + c u^2 + (d + e u) w_z'(t - lag) + g w_x w_y(t - lag)

and the same of ``f_z`` with ``w_y'`` and ``w_x w_z``, fit best where the lag is by how much the tags of the force are
later than the rates'. A window counts where hardly anything is left over; the answer is the weighted median of all.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.trajectory import interpolate_rows
from recon.consistency import Verdict, verdict
from recon.gaps import Bridged
from recon.problem import Problem
from recon.state import KINEMATIC, States

WINDOW_S, STEP_S = 4.0, 0.01
SMOOTH_S, SLOWEST_S = 0.04, 0.05  # of the Gaussian both signals are seen through; steps of a record that tells nothing
LONGEST_LAG_S, LAG_STEP_S = 0.08, 0.01
LARGEST_SD_S = LONGEST_LAG_S / 10.0  # else hardly a lag that is looked for would stand out
EXPLAINED = 0.95  # share of the lateral force's square
ALONE_S = 0.7  # residuals within about so long are one
LEAST_WINDOWS = 4
ARM_M = 3.0  # of a vehicle of six metres


class Lag(NamedTuple):
    """How much later the accelerometer's tags are than the gyros', s, with its standard deviation."""

    lag_s: float
    sd_s: float


def lag_between(
    force: Bridged, rate: Bridged, path: States, time_s: FloatArray, start_s: float = -np.inf, end_s: float = np.inf
) -> Lag | None:
    """Lag of the accelerometer behind the gyros from ``start_s`` to ``end_s``; None where no swing tells it.

    ``path`` at ``time_s`` (n,) is where the vehicle flew, roughly.
    """
    start = max(start_s, float(force.time_s[0]), float(rate.time_s[0])) + LONGEST_LAG_S
    end = min(end_s, float(force.time_s[-1]), float(rate.time_s[-1])) - LONGEST_LAG_S
    if max(np.median(np.diff(t.time_s)) for t in (force, rate)) > SLOWEST_S or end - start < WINDOW_S:
        return None
    told = []
    (ft, f), (wt, w) = _smoothed(force), _smoothed(rate)
    turning = np.column_stack([w, np.gradient(w, wt, axis=0)])
    speed = np.linalg.norm(path.velocity_ecef_mps, axis=1)
    for begin in np.arange(start, end - WINDOW_S, WINDOW_S):
        if _has_gap(force, begin) or _has_gap(rate, begin):
            continue
        at = begin + np.arange(0.0, WINDOW_S, STEP_S)
        lags = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 1e-9, LAG_STEP_S)
        seen = [interpolate_rows(at - lag, wt, turning) for lag in lags]
        damping = ARM_M / max(float(np.interp(begin + 0.5 * WINDOW_S, time_s, speed)), 1.0)
        both = (_lag_in_window(interpolate_rows(at, ft, f)[:, i], seen, lags, i) for i in (1, 2))
        told += [(*one, damping) for one in both if one is not None]
    lag = _together(np.array(told)) if len(told) >= LEAST_WINDOWS else None
    return lag if lag is not None and lag.sd_s < LARGEST_SD_S else None


def _smoothed(triad: Bridged) -> tuple[FloatArray, FloatArray]:
    """Even times (n,) and samples (n, 3) in body axes, through a Gaussian of `SMOOTH_S`."""
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(triad.time_s)))
    at = np.arange(triad.time_s[0], triad.time_s[-1], step)
    body = triad.measured_sensor @ triad.spec.dcm_body_sensor.T
    return at, gaussian_filter1d(interpolate_rows(at, triad.time_s, body), SMOOTH_S / step, axis=0)


def _has_gap(triad: Bridged, begin: float) -> bool:
    a, b = np.searchsorted(triad.time_s, [begin - LONGEST_LAG_S, begin + WINDOW_S + LONGEST_LAG_S])
    gaps: BoolArray = triad.in_gap[max(a - 1, 0) : b]
    return bool(gaps.any())


def _lag_in_window(
    force: FloatArray, seen: list[FloatArray], lags: FloatArray, axis: int
) -> tuple[float, float] | None:
    """Lag and its sd by one axis (1 or 2) of one window, from rates and accelerations (n, 6) seen at each lag."""
    u = np.linspace(-0.5, 0.5, len(force))
    slow = np.column_stack([np.ones_like(u), u, u**2])
    left = np.empty(len(lags))
    for k, w in enumerate(seen):
        across = w[:, 3 + 3 - axis]
        left[k] = _left_over(force, np.column_stack([slow, across, across * u, w[:, 0] * w[:, axis]]))
    k = int(np.argmin(left))
    if not 0 < k < len(lags) - 1 or left[k] > (1.0 - EXPLAINED) * _left_over(force, slow):
        return None
    before, here, after = left[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    lag = lags[k] + 0.5 * LAG_STEP_S * (before - after) / bend
    least = max(here - 0.125 * (before - after) ** 2 / bend, 0.0)
    return float(lag), float(np.sqrt(least / len(force) * (ALONE_S / STEP_S) / bend) * LAG_STEP_S)


def _left_over(y: FloatArray, columns: FloatArray) -> float:
    """Sum of squares that a least-squares fit leaves."""
    orthogonal, _ = np.linalg.qr(columns)
    rest = y - orthogonal @ (orthogonal.T @ y)
    return float(rest @ rest)


def _together(told: FloatArray) -> Lag:
    """Weighted median of lags, given with their sds and what damping may add (n, 3), and its sd."""
    lag, sd, damping = told.T
    weight = 1.0 / (sd**2 + damping**2)
    order = np.argsort(lag)
    share = np.cumsum(weight[order]) / weight.sum()
    middle = float(lag[order][int(np.searchsorted(share, 0.5))])
    scatter = max(1.0, 1.4826 * float(np.median(np.abs(lag - middle) * np.sqrt(weight))))
    common = float(damping @ weight / weight.sum())  # windows share it
    return Lag(middle, float(np.hypot(1.25 * scatter / np.sqrt(weight.sum()), common)))


def lag_verdict(lag: Lag, force: Bridged, rate: Bridged, confidence: float) -> Verdict:
    """Whether both clocks may err by as much as the swinging says, by their sheets."""
    from scipy.stats import norm

    allowed = float(np.hypot(force.spec.time_bias_sd_s, rate.spec.time_bias_sd_s))
    limit = float(norm.ppf(0.5 * (1.0 + confidence)))
    names = f"{force.spec.name} and {rate.spec.name}"
    side = "later" if lag.lag_s > 0.0 else "earlier"
    words = f"as the vehicle swings, the tags of {force.spec.name} are {1e3 * abs(lag.lag_s):.1f} ± "
    words += f"{1e3 * lag.sd_s:.1f} ms {side} than those of {rate.spec.name}"
    bad = f"{words}: the clocks of {names} differ by more than stated"
    return verdict(f"clocks of {names}", lag.lag_s / np.hypot(lag.sd_s, allowed), -limit, limit, words, bad)


def with_lag(problem: Problem, lag: Lag | None, force: str, rate: str) -> Problem:
    """Problem whose start knows by how much two clocks differ, given as wide priors of each."""
    columns = [problem.model.column(name, "time bias") for name in (force, rate)]
    if lag is None or min(columns) < 0:
        return problem
    p, h = problem.start_covariance, np.zeros(problem.size)
    h[KINEMATIC + columns[0]], h[KINEMATIC + columns[1]] = 1.0, -1.0
    errors = problem.start.sensor_errors
    gain = p @ h / (h @ p @ h + lag.sd_s**2)
    moved = gain * (lag.lag_s - h[KINEMATIC:] @ errors)
    start = replace(problem.start, sensor_errors=errors + moved[KINEMATIC:])
    return replace(problem, start=start, start_covariance=p - np.outer(gain, h @ p))

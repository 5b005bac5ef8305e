"""Do frames with little load show the shell at rest, as the benchmark frame is taken to?

A benchmark frame under load, or a camera that has moved in its mount since, shows in frames with little load as a
deflection that no load explains. Of the frames before the first, and apart of those after the last, whose load
``l_k`` is more than a tenth of the film's largest, the readings ``r_k`` and their covariances ``S_k`` give

    m = sum w_k r_k,    C = sum w_k V_k + p^2 I,    V_k = S_k + (2 u l_k)^2 I,    w_k ~ 1 / trace V_k

where ``u = max |r| / max |l - l_benchmark|`` is deflection per load, and ``m' C^-1 m`` is a chi-square of two. A film
without such frames can only be asked what its benchmark's own load amounts to, ``u l_benchmark``, against the sd ``p``
with which it is taken as undeflected. Where no load is known, the film itself speaks: before the load, and after it,
nothing deflects the shell, so that of a benchmark frame at rest all frames before it are at rest, or all after it.

Assumed: one pulse of load; deflection follows the load, within a factor of two (dynamic pressure stands for the moment
in the joint where no inertial sensors measured it, whatever the angle of attack was); a joint without load rests within
``p`` of where it rested in the benchmark frame (friction); the frames' errors are in common: the mean's sd is that of
one frame.
"""

from __future__ import annotations

import numpy as np

from estimators.agreement import CONFIDENCE
from flightmodel.checks import BoolArray, Check, FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.statistics import chi_square_quantile

_LITTLE = 0.1  # of the largest load: the frames' own deflection is then small beside what is looked for
_LOAD_FACTOR = 2.0  # of what the load explains: the angle of attack off the peak may be twice that at it
_WORST_BY_LOAD = 2.0  # sd of the benchmark's prior, beyond which the readings' error bars do not hold
_MISREAD = 10  # one frame of so many may be


def _check(over_sd: float, limit: float, good: str, bad: str) -> Check:
    """Check of a deflection over its sd, with its remark and, on failure, advice."""
    passed, name = over_sd <= limit, "deflection without load over its sd"
    return Check("camera-rest", name, over_sd, 0.0, limit, passed, good if passed else bad, "camera")


def rest_check(
    history: DeflectionHistory, load: FloatArray, benchmark_s: float, prior_sd_rad: float, corrected: bool
) -> Check | None:
    """Check that frames with little load show the shell at rest.

    Parameters
    ----------
    history : DeflectionHistory
        Of one camera at its frames, NaN where a frame has no answer.
    load : (n,) float
        Moment in the joint or dynamic pressure at the frames, not negative; NaN where it is not known.
    benchmark_s : float
    prior_sd_rad : float
        Sd, an axis, with which a joint without load is taken as undeflected.
    corrected : bool
        Whether the benchmark's own deflection is in the history: its load then says nothing against it.

    Returns
    -------
    Check or None
        None where neither frames nor load can tell.
    """
    at = int(np.argmin(np.abs(history.time_s - benchmark_s)))
    other = np.arange(len(load)) != at
    theta, covariance = history.theta_yz_rad, history.lateral_cov_without_plane
    answered = other & np.isfinite(theta).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    known = answered & np.isfinite(load)
    if not np.any(load[known] != load[at]) or not np.isfinite(load[at]):
        return None if corrected else _by_sides(history.time_s, theta, covariance, answered, at, prior_sd_rad)
    per_load = np.linalg.norm(theta[known], axis=1).max() / np.abs(load[known] - load[at]).max()
    largest = max(load[known].max(), load[at])
    loaded = history.time_s[(known | ~other) & (load > _LITTLE * largest)]
    before, after = history.time_s < loaded.min(), history.time_s > loaded.max()  # a swing's own zeros lie between
    little = known & (before | after)
    if little.any():
        groups = [rows for side in (before, after) if len(rows := np.flatnonzero(little & side))]
        limit = float(np.sqrt(chi_square_quantile(1.0 - (1.0 - CONFIDENCE) / len(groups), 2)))
        found = []
        for rows in groups:
            by_load = _LOAD_FACTOR * per_load * load[rows]
            mean, spread = _mean(theta[rows], covariance[rows] + by_load[:, None, None] ** 2 * np.eye(2))
            over_sd = float(np.sqrt(mean @ np.linalg.solve(spread + prior_sd_rad**2 * np.eye(2), mean)))
            first, last = (float(history.time_s[rows[k]]) for k in (0, -1))
            words = (
                f"{len(rows)} frames with little load ({first:.2f} to {last:.2f} s) show "
                f"{np.rad2deg(np.linalg.norm(mean)):.2f} deg on average"
            )
            advice = "the benchmark frame is under load (state benchmark_s of one of these), or the camera moved"
            bad = f"{words}, {over_sd:.1f} sd from rest: {advice} in its mount"
            found.append(_check(over_sd, limit, words, bad))
        return max(found, key=lambda one: one.value)
    if corrected:
        return None
    by_load = float(per_load * load[at])
    words = (
        f"the benchmark frame's load deflects the shell by about {np.rad2deg(by_load):.2f} deg, and no frame has less"
    )
    bad = f"{words}: state another benchmark_s, of a frame with little load"
    return _check(by_load / prior_sd_rad, _WORST_BY_LOAD, words, bad)


def _by_sides(
    time_s: FloatArray, theta: FloatArray, covariance: FloatArray, answered: BoolArray, at: int, prior_sd_rad: float
) -> Check | None:
    """Whether all frames on one side of the benchmark frame show rest; None where a side has no answer."""
    number, found = np.arange(len(theta)), []
    for side in (number < at, number > at):
        rows = np.flatnonzero(answered & side)
        if not len(rows):
            return None
        spread = covariance[rows] + prior_sd_rad**2 * np.eye(2)
        square = np.einsum("ni,ni->n", theta[rows], np.linalg.solve(spread, theta[rows][:, :, None])[:, :, 0])
        worst = int(np.argsort(-square)[len(rows) // _MISREAD])
        limit = float(np.sqrt(chi_square_quantile(1.0 - (1.0 - CONFIDENCE) / len(rows), 2)))
        size, over_sd = np.rad2deg(np.linalg.norm(theta[rows[worst]])), float(np.sqrt(square[worst]))
        first, last = time_s[rows[[0, -1]]]
        words = f"{len(rows)} frames on one side of the benchmark frame ({first:.2f} to {last:.2f} s) show "
        bad = (
            f"{words}up to {size:.2f} deg, {over_sd:.1f} sd from rest, those on its other side more: the benchmark "
            "frame is under load: state another benchmark_s, of a frame before or after the load"
        )
        found.append(_check(over_sd, limit, f"{words}the shell at rest", bad))
    return min(found, key=lambda one: one.value / one.high)


def _mean(readings: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted mean of readings (k, 2) whose errors are in common, and its covariance."""
    weight = 1.0 / np.trace(covariance, axis1=1, axis2=2)
    weight /= weight.sum()
    return weight @ readings, np.tensordot(weight, covariance, axes=1)

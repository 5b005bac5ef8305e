"""Is the reconstruction as good as it says? Verdicts in words, from the residuals and the two passes.

Innovations of a filter whose model matches the data are white with the predicted covariance, so the sum of normalised
innovations squared (NIS) is chi-square with as many degrees of freedom as components were measured, and the lag-one
autocorrelation of a component is normal with sd ``1 / sqrt(N)``. Filter minus smoother has covariance ``P_filter -
P_smoother`` (McReynolds); differences last, so one that is beyond three sd by chance may stay there for long: a tenth
of them may. Points of the first seconds are left out: they chose the start. What the flight taught about a sensor
error, ``estimate / sqrt(prior_sd^2 - sd^2)``, is standard normal where the data sheet is right; radars can absorb a
wrong mounting so well that only this shows it.

A failed verdict is a finding about the data or the model, not an error of the program. Each is two-sided at the
settings' confidence, so that eighteen verdicts on a good flight are all green 98 times in a hundred (at 0.999).

References
----------
Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 5.4.
S. McReynolds, "Editing data using sequential smoothing techniques for discrete systems", AIAA 84-2024.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray
from recon.packed import Innovations
from recon.problem import Problem
from recon.startup import FIT_SPAN_S
from recon.state import BoolArray

MOST_EDITED = 0.05
LEAST_INSIDE = 0.90
MOST_KEPT_SD = 0.98
GROUPS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9)}


@dataclass(frozen=True)
class Verdict:
    """One test: its value, the band it should lie in, whether it does, and what that means."""

    name: str
    value: float
    low: float
    high: float
    passed: bool
    words: str


def verdict(name: str, value: float, low: float, high: float, good: str, bad: str) -> Verdict:
    """Verdict with the words that fit."""
    passed = bool(low <= value <= high)
    return Verdict(name, float(value), float(low), float(high), passed, good if passed else bad)


def nis_verdict(source: str, nis: FloatArray, components: int, confidence: float) -> Verdict:
    """Mean normalised innovation squared (n,) of accepted points against its chi-square band; components in all."""
    from scipy.stats import chi2

    n, tail = len(nis), 0.5 * (1.0 - confidence)
    low, high = (float(chi2.ppf(p, components)) / n for p in (tail, 1.0 - tail))
    mean = float(np.mean(nis))
    bad = (
        "residuals are smaller than predicted: the assumed noise is too large"
        if mean < low
        else "residuals are larger than predicted: noise is larger than assumed or an error is not modelled"
    )
    return verdict(f"NIS {source}", mean, low, high, f"residuals as large as predicted ({n} points)", bad)


def whiteness_verdict(source: str, normalised: FloatArray, confidence: float) -> Verdict:
    """Lag-one autocorrelation of one component's normalised innovations (n,) against its band."""
    from scipy.stats import norm

    n = len(normalised)
    centred = normalised - normalised.mean()
    rho = float(centred[1:] @ centred[:-1] / (centred @ centred))
    band = float(norm.ppf(0.5 * (1.0 + confidence))) / np.sqrt(n)
    return verdict(
        f"whiteness {source}",
        rho,
        -band,
        band,
        "successive residuals are independent",
        "successive residuals are correlated: an error that lasts several points is not modelled",
    )


def edit_verdict(source: str, accepted: BoolArray) -> Verdict:
    """Fraction of points that failed the gate."""
    fraction = float(1.0 - np.mean(accepted))
    count = int(np.sum(~accepted))
    return verdict(
        f"edited {source}",
        fraction,
        0.0,
        MOST_EDITED,
        f"{count} of {len(accepted)} points edited",
        f"{count} of {len(accepted)} points edited: it and the rest of the data disagree, and either may be wrong",
    )


def sheet_verdict(
    label: str,
    names: list[str],
    estimate: FloatArray,
    prior_sd: FloatArray,
    sd: FloatArray,
    confidence: float,
    bad: str = "is larger than the data sheet allows: check mounting, units and calibration",
    good: str = "estimated errors are as large as stated; the largest is",
) -> Verdict | None:
    """Largest normalised shift (k,) of stated errors from zero; None where nothing was learnt.

    The words name the error that moved most: ``bad`` follows its name, ``good`` goes before it.
    """
    from scipy.stats import norm

    learnt = sd < MOST_KEPT_SD * prior_sd
    if not learnt.any():
        return None
    shift = np.abs(estimate[learnt]) / np.sqrt(prior_sd[learnt] ** 2 - sd[learnt] ** 2)
    tail = 0.5 * (1.0 - confidence) / int(learnt.sum())
    worst = np.array(names, dtype=object)[learnt][int(np.argmax(shift))]
    limit = float(norm.isf(tail))
    return verdict(label, float(shift.max()), 0.0, limit, f"{good} {worst}", f"{worst} {bad}")


def mcreynolds_verdicts(
    difference: FloatArray, p_filter: FloatArray, p_smoother: FloatArray, groups: list[str]
) -> list[Verdict]:
    """Share of filter-minus-smoother differences ``(n, 9)`` within three sd of their own covariance, by group."""
    var = np.diagonal(p_filter - p_smoother, axis1=1, axis2=2)
    alive = var > 1e-9 * np.diagonal(p_filter, axis1=1, axis2=2)  # at the end both are one
    inside = np.abs(difference) <= 3.0 * np.sqrt(np.where(alive, var, 0.0))
    out = []
    for name in groups:
        part = GROUPS[name]
        use = alive[:, part]
        share = float(inside[:, part][use].mean()) if use.any() else 1.0
        out.append(
            verdict(
                f"filter-smoother {name}",
                share,
                LEAST_INSIDE,
                1.0,
                "filter and smoother differ as predicted",
                "filter and smoother differ more than predicted: process noise or an error model is too small",
            )
        )
    return out


def source_verdicts(problem: Problem, innovations: Innovations, confidence: float) -> list[Verdict]:
    """NIS, whiteness and edits of each source; one that was left out on purpose has none."""
    out = []
    time_s = problem.time_s[problem.node]
    settled = time_s > problem.time_s[0] + FIT_SPAN_S
    measured = np.isfinite(problem.observed.variance)
    normalised = innovations.residual / np.sqrt(np.diagonal(innovations.covariance, axis1=1, axis2=2))
    for number, instrument in enumerate(problem.instruments):
        mine = (problem.observed.source == number) & problem.observed.usable
        if not mine.any():
            continue
        use = mine & settled & innovations.accepted
        if use.sum() >= 10:
            count = int(measured[use].sum())
            out.append(nis_verdict(instrument.name, innovations.nis[use], count, confidence))
            for i, component in enumerate(instrument.components):
                rows = use & measured[:, i]
                if rows.sum() >= 10:
                    out.append(whiteness_verdict(f"{instrument.name} {component}", normalised[rows, i], confidence))
        out.append(edit_verdict(instrument.name, innovations.accepted[mine]))
    return out

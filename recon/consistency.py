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

How well does the trajectory foretell tracking that it never saw?

Some measurements only check: rows of an oversampled tracker, those that settings withhold, sources left out. The
smoothed state and error at their time, ``x_s`` with covariance ``P_s``, predict each one:

    residual = z - h(x_s),   variance = H P_s H^T + R

from all used data before and after it. Normalised by their standard deviations, residuals of an honest trajectory have
a mean square of one. Neighbours share the trajectory's error, so that mean is less certain than their number says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray
from recon import _smoother_kernels, smoother
from recon.ekf import ForwardPass
from recon.problem import FIT_SPAN_S, Problem
from recon.state import KINEMATIC, BoolArray, Innovations, IntArray, unpacked

MOST_EDITED = 0.05
LEAST_INSIDE = 0.90
MOST_KEPT_SD = 0.98
GROUPS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9)}


@dataclass(frozen=True)
class ConsistencyCheck:
    """One statistic, the band it should lie in, whether it does, and what follows.

    ``code`` is short and stable (``"nis"``, ``"whiteness"``); ``name`` adds what it is of, ``remark`` may be reworded.
    """

    code: str
    name: str
    value: float
    low: float
    high: float
    passed: bool
    remark: str


def consistency_check(
    code: str, name: str, value: float, low: float, high: float, good: str, bad: str
) -> ConsistencyCheck:
    """Consistency check with the remark that fits."""
    passed = bool(low <= value <= high)
    return ConsistencyCheck(code, name, float(value), float(low), float(high), passed, good if passed else bad)


def nis_check(source: str, nis: FloatArray, components: int, confidence: float) -> ConsistencyCheck:
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
    return consistency_check(
        "nis", f"NIS {source}", mean, low, high, f"residuals as large as predicted ({n} points)", bad
    )


def whiteness_check(source: str, normalised: FloatArray, confidence: float) -> ConsistencyCheck:
    """Lag-one autocorrelation of one component's normalised innovations (n,) against its band."""
    from scipy.stats import norm

    n = len(normalised)
    centred = normalised - normalised.mean()
    rho = float(centred[1:] @ centred[:-1] / (centred @ centred))
    band = float(norm.ppf(0.5 * (1.0 + confidence))) / np.sqrt(n)
    return consistency_check(
        "whiteness",
        f"whiteness {source}",
        rho,
        -band,
        band,
        "successive residuals are independent",
        "successive residuals are correlated: an error that lasts several points is not modelled",
    )


def edit_check(source: str, accepted: BoolArray) -> ConsistencyCheck:
    """Fraction of points that failed the gate."""
    fraction = float(1.0 - np.mean(accepted))
    count = int(np.sum(~accepted))
    return consistency_check(
        "edited",
        f"edited {source}",
        fraction,
        0.0,
        MOST_EDITED,
        f"{count} of {len(accepted)} points edited",
        f"{count} of {len(accepted)} points edited: it and the rest of the data disagree, and either may be wrong",
    )


def data_sheet_check(
    code: str,
    label: str,
    names: list[str],
    estimate: FloatArray,
    prior_sd: FloatArray,
    sd: FloatArray,
    confidence: float,
    bad: str = "is larger than the data sheet allows: check mounting, units and calibration",
    good: str = "estimated errors are as large as stated; the largest is",
) -> ConsistencyCheck | None:
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
    return consistency_check(code, label, float(shift.max()), 0.0, limit, f"{good} {worst}", f"{worst} {bad}")


def mcreynolds_checks(
    difference: FloatArray, p_filter: FloatArray, p_smoother: FloatArray, groups: list[str]
) -> list[ConsistencyCheck]:
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
            consistency_check(
                "filter-smoother",
                f"filter-smoother {name}",
                share,
                LEAST_INSIDE,
                1.0,
                "filter and smoother differ as predicted",
                "filter and smoother differ more than predicted: process noise or an error model is too small",
            )
        )
    return out


def source_checks(problem: Problem, innovations: Innovations, confidence: float) -> list[ConsistencyCheck]:
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
            out.append(nis_check(instrument.name, innovations.nis[use], count, confidence))
            for i, component in enumerate(instrument.components):
                rows = use & measured[:, i]
                if rows.sum() >= 10:
                    out.append(whiteness_check(f"{instrument.name} {component}", normalised[rows, i], confidence))
        out.append(edit_check(instrument.name, innovations.accepted[mine]))
    return out


MOST_PREDICTED = 4000  # measurements; more are thinned evenly
COLUMNS = ("time_s", "source", "component", "residual", "predicted_sd")


def withheld_table(problem: Problem, run: ForwardPass, engine: str = "compiled") -> pd.DataFrame:
    """One row for each component of the measurements that were not used: `COLUMNS`, in order of time."""
    rows = _chosen(problem)
    if len(rows) == 0:
        return pd.DataFrame({name: [] for name in COLUMNS})
    node = problem.node
    wanted = np.unique(node[rows])
    kept = np.zeros(len(problem.time_s), dtype=bool)
    kept[wanted] = True
    x, covariance = _smoothed(problem, run, kept, engine)
    slots = problem.sources().slot
    out = []
    for row in rows.tolist():
        k = int(node[row])
        h = _jacobian(run.innovations, slots[problem.observed.source[row]], row, problem.size)
        # the innovation is of the state that the measurements before it at the same node had left
        before = run.filtered.x_minus[k].copy()
        for earlier in range(int(problem.observed.first[k]), row):
            if run.innovations.accepted[earlier]:
                before += run.innovations.gain[earlier] @ run.innovations.residual[earlier]
        residual = run.innovations.residual[row] - h @ (x[k] - before)
        p = covariance[int(np.searchsorted(wanted, k))]
        sd = np.sqrt(np.einsum("ij,jk,ik->i", h, p, h) + problem.observed.variance[row])
        instrument = problem.instruments[problem.observed.source[row]]
        for i, component in enumerate(instrument.components):
            if np.isfinite(sd[i]):
                out.append((problem.time_s[k], instrument.name, component, residual[i], sd[i]))
    return pd.DataFrame(out, columns=list(COLUMNS))


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return how many, rms residual and rms normalised residual by source and component."""
    squares = table.assign(square=table.residual**2, normalised=(table.residual / table.predicted_sd) ** 2)
    groups = squares.groupby(["source", "component"], sort=False)
    return pd.DataFrame(
        {
            "count": groups.size(),
            "rms_residual": np.sqrt(groups["square"].mean()),
            "rms_normalised": np.sqrt(groups["normalised"].mean()),
        }
    ).reset_index()


def _chosen(problem: Problem) -> IntArray:
    """Measurements that were not used, thinned evenly to `MOST_PREDICTED`."""
    rows = np.flatnonzero(~problem.observed.usable)
    if len(rows) > MOST_PREDICTED:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_PREDICTED).astype(np.int64)]
    return np.asarray(rows, dtype=np.int64)


def _smoothed(problem: Problem, run: ForwardPass, kept: BoolArray, engine: str) -> tuple[FloatArray, FloatArray]:
    """Smoothed errors at all nodes (n, N) and their whole covariance at the kept ones (k, N, N)."""
    rows: IntArray = np.full(len(kept), -1, dtype=np.int64)
    rows[kept] = np.arange(int(kept.sum()))
    phi = run.steps.transition
    # the smoother keeps the covariance of errors that the motion depends on: of all, where all are columns
    wide = np.concatenate([phi, np.zeros((*phi.shape[:2], problem.size - phi.shape[2]))], axis=2)
    x = run.filtered.x_plus.copy()
    triangles = np.empty((int(kept.sum()), problem.size * (problem.size + 1) // 2))
    backward = _smoother_kernels.rauch_tung_striebel if engine == "compiled" else smoother.rauch_tung_striebel
    backward(
        run.steps._replace(transition=wide), run.filtered._replace(kept=rows), problem.moving, x, triangles,
        np.empty((len(triangles), problem.size)),
    )  # fmt: skip
    return x, unpacked(triangles)


def _jacobian(innovations: Innovations, slot: IntArray, row: int, size: int) -> FloatArray:
    """Partials (3, N) of one prediction by the whole state."""
    h = np.zeros((3, size))
    h[:, :KINEMATIC] = innovations.by_state[row]
    h[:, KINEMATIC + slot[slot >= 0]] += innovations.by_error[row][:, slot >= 0]
    return h

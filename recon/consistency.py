"""Is the reconstruction as accurate as its covariance states? Consistency checks of residuals and of held-out data.

Innovations of a filter whose model matches the data are white with the predicted covariance, so the sum of normalised
innovations squared (NIS) is chi-square with as many degrees of freedom as components were measured, and the lag-one
autocorrelation of a component is normal with sd ``1 / sqrt(N)``. Filter minus smoother has covariance ``P_filter -
P_smoother`` (McReynolds); differences are correlated in time, so one that is large by chance may stay so for long (an
attitude prior 3.2 sd off is so until the first force). A tenth of them may be beyond ``z`` sd. However they are
correlated, more are by chance at most ten times as often as a single one is (Markov's inequality), which sets ``z``:
3.9 at a confidence of 0.999. Points of the first seconds are left out: the start was fitted to them. The normalised
shift of a sensor error from its a priori value, ``estimate / sqrt(prior_sd^2 - sd^2)``, is standard normal where the
data sheet is right; radars can absorb a wrong mounting so well that only this shows it.

Measurements that are predicted but not used (held-out ones, those of an oversampled tracker, sources left out) check
the smoothed trajectory: with state and error ``x_s`` of covariance ``P_s`` at their time,

    residual = z - h(x_s),   variance = H P_s H^T + R

and residuals over their standard deviations have a mean square of one. Neighbours share the trajectory's error, so
that mean is less certain than their number suggests; the check of measurements held out on purpose counts those beyond
the gate, of which independence is not asked.

A failed check is a finding about the data or the model, not an error of the program. Each is two-sided at the
settings' confidence, so that eighteen checks of a consistent flight all pass 98 times in a hundred (at 0.999).

References
----------
Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 5.4.
S. McReynolds, "Editing data using sequential smoothing techniques for discrete systems", AIAA 84-2024.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.special import ndtri

from flightmodel.checks import BoolArray, Check, FloatArray, IntArray, Issue
from flightmodel.instruments import RADAR as RADAR_ERRORS
from flightmodel.statistics import chi_square_quantile
from recon.kalman import ForwardPass, Innovations, Smoothed, smoothed_covariance
from recon.linearise import jacobian
from recon.measurements import DECELERATION, RADAR, REST, SLOT_NAMES
from recon.problem import FIT_SPAN_S, Problem
from recon.settings import Settings
from recon.state import KINEMATIC, States, boxminus, data_sheet_check, unpacked

_MOST_EDITED = 0.05  # share of a source's points
_LEAST_INSIDE = 0.90
_MOST_PREDICTED = 4000  # held-out measurements; more are thinned evenly
_COLUMNS = ("time_s", "source", "component", "residual", "predicted_sd")
# code, name and advice for the a priori errors of a ballistic flight's air and vehicle
_BALLISTIC_CHECKS = {
    "air": (
        "sounding",
        "sounding",
        "is beyond the sounding's uncertainty: check its units, time and place, and the vehicle's C_A, area and mass",
    ),
    "vehicle": (
        "pre-flight-drag",
        "pre-flight drag",
        "is beyond the pre-flight uncertainty: check C_A, area and mass, and the density of the sounding",
    ),
}
_NAMED = 3  # failed checks in one sentence
_MOST_OUTSIDE = 3.0  # sd beyond a physical range
SAME_STRETCH_S = 1.0  # edited measurements closer than this are one stretch
GROUPS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9)}


def doubt(failed: Sequence[str], checks: int) -> str:
    """What failed checks mean for every answer, in one sentence; empty where none fails.

    Parameters
    ----------
    failed : sequence of str
        Names of the checks that fail.
    checks : int
        How many there are.
    """
    if not failed:
        return ""
    names = list(dict.fromkeys(name.partition(":")[0] for name in failed))
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    words = f"{len(failed)} of {checks} consistency checks fail{'s' * (len(failed) == 1)} "
    return f"{words}({', '.join(names[:_NAMED])}{more}): do not use values and their ± before the cause is found"


def nis_check(
    source: str, nis: FloatArray, components: int, confidence: float, allowance: bool = False, measured: str = ""
) -> Check:
    """Mean normalised innovation squared (n,) of accepted points against its band: chi-square of ``components``.

    With an ``allowance`` for noise, not its size, residuals may be as small as they like; else ``measured`` says what
    noise they have, for the data sheet.
    """
    n, tail = len(nis), 0.5 * (1.0 - confidence)
    low, high = (chi_square_quantile(p, components) / n for p in (tail, 1.0 - tail))
    low = 0.0 if allowance else low
    mean = float(np.mean(nis))
    size, advice = (
        ("smaller", f"the assumed noise is too large{f'; measured: {measured}' if measured else ''}")
        if mean < low
        else ("larger", "noise is larger than assumed or an error is not modelled")
    )
    return Check.of(
        "nis", f"NIS {source}", mean, low, high, f"residuals as large as predicted ({n} points)",
        f"residuals are {size} than predicted", advice=advice, source=source,
    )  # fmt: skip


def whiteness_check(source: str, component: str, normalised: FloatArray, confidence: float) -> Check:
    """Lag-one autocorrelation of one component's normalised innovations (n,) against its band."""
    n = len(normalised)
    centred = normalised - normalised.mean()
    rho = float(centred[1:] @ centred[:-1] / (centred @ centred))
    band = float(ndtri(0.5 * (1.0 + confidence))) / np.sqrt(n)
    return Check.of(
        "whiteness", f"whiteness {source} {component}", rho, -band, band, "successive residuals are uncorrelated",
        "successive residuals are correlated", advice="an error that lasts several points is not modelled",
        source=source, component=component,
    )  # fmt: skip


def edit_check(source: str, accepted: BoolArray) -> Check:
    """Fraction of points that failed the gate."""
    count = int(np.sum(~accepted))
    symptom = f"{count} of {len(accepted)} points edited"
    return Check.of(
        "edited", f"edited {source}", float(1.0 - np.mean(accepted)), 0.0, _MOST_EDITED, symptom, symptom,
        advice="it disagrees with the rest of the data, and either may be wrong", source=source,
    )  # fmt: skip


def mcreynolds_checks(
    difference: FloatArray, p_filter: FloatArray, p_smoother: FloatArray, groups: list[str], confidence: float
) -> list[Check]:
    """Share of filter-minus-smoother differences ``(n, 9)`` as small as their covariance says, by group."""
    most_sd = -float(ndtri(0.5 * (1.0 - _LEAST_INSIDE) * (1.0 - confidence)))
    of_filter, of_smoother = (np.diagonal(p, axis1=1, axis2=2) for p in (p_filter, p_smoother))
    var = of_filter - of_smoother
    alive = var > 1e-9 * of_filter  # at the end both are one
    inside = np.abs(difference) <= most_sd * np.sqrt(np.where(alive, var, 0.0))
    out = []
    for name in groups:
        part = GROUPS[name]
        use = alive[:, part]
        share = float(inside[:, part][use].mean()) if use.any() else 1.0
        out.append(
            Check.of(
                "filter-smoother", f"filter-smoother {name}", share, _LEAST_INSIDE, 1.0,
                "filter and smoother differ as predicted", "filter and smoother differ more than predicted",
                advice="process noise or an error model is too small", component=name,
            )
        )  # fmt: skip
    return out


def beyond_gate(held_out: pd.DataFrame, gate: float) -> pd.Series[bool]:
    """Whether a component of a held-out measurement lies beyond the gate, by source and time."""
    far = held_out.residual.abs() > float(ndtri(0.5 * (1.0 + gate))) * held_out.predicted_sd
    return far.groupby([held_out.source, held_out.time_s], sort=False).any()


def held_out_checks(problem: Problem, held_out: pd.DataFrame, settings: Settings) -> list[Check]:
    """Check whether held-out measurements agree with their predictions from the rest of the flight.

    None of trackers that the settings leave out altogether, nor of rows that a tracker's ``every_s`` leaves out where
    nothing is held out.
    """
    if not (settings.hold_out_every or settings.hold_out_spans_s):
        return []
    out = []
    owners = {instrument.name: instrument.owner for instrument in problem.instruments}
    for source, far in beyond_gate(held_out, settings.gate_probability).groupby("source", sort=False):
        owner = owners[str(source)]
        if owner in settings.without:
            continue
        symptom = f"{int(far.sum())} of {len(far)} held-out points farther off than predicted"
        out.append(
            Check.of(
                "held-out", f"held out {source}", float(far.mean()), 0.0, _MOST_EDITED, symptom, symptom,
                advice="the stated noise is too small, these points are faulty, or an error is not modelled",
                source=owner,
            )
        )  # fmt: skip
    return out


def left_out_findings(problem: Problem, held_out: pd.DataFrame, settings: Settings) -> list[Issue]:
    """Say which trackers, left out by the settings, are not where the others predict them: either may be wrong."""
    found = []
    owners = {instrument.name: instrument.owner for instrument in problem.instruments}
    gate = settings.gate_probability
    for source, rows in held_out.groupby("source", sort=False):
        far = beyond_gate(rows, gate).droplevel("source")
        if owners[str(source)] not in settings.without or far.mean() <= _MOST_EDITED:
            continue
        times = far.index[far]
        worst = (rows.residual / rows.predicted_sd).abs().idxmax()
        words = (
            f"left out, and {len(times)} of its {len(far)} points lie farther off than predicted, up to "
            f"{abs(rows.residual[worst]) / rows.predicted_sd[worst]:.1f} sd at {rows.time_s[worst]:.1f} s: it "
            "disagrees with the trajectory, and either may be wrong"
        )
        found.append(Issue(words, "left-out-disagrees", str(source), float(times.min()), float(times.max())))
    return found


def _settled_from_s(problem: Problem) -> float:
    """Time from which on points are tested: the start was fitted to those before; of a short span, the later half."""
    first, last = float(problem.time_s[0]), float(problem.time_s[-1])
    return first + min(FIT_SPAN_S, 0.5 * (last - first))


def source_checks(problem: Problem, innovations: Innovations, confidence: float) -> list[Check]:
    """NIS, whiteness and edits of each source; one that was excluded by settings has none."""
    out: list[Check] = []
    time_s = problem.time_s[problem.node]
    settled = time_s > _settled_from_s(problem)
    measured = np.isfinite(problem.observed.variance)
    normalised = innovations.residual / np.sqrt(np.diagonal(innovations.covariance, axis1=1, axis2=2))
    for number, instrument in enumerate(problem.instruments):
        mine = (problem.observed.source == number) & problem.observed.usable
        if not mine.any():
            continue
        use = mine & settled & innovations.accepted
        checks = []
        # the drag follows each reading of a deceleration, so that its innovations test nothing
        if use.sum() >= 10 and instrument.kind != DECELERATION:
            components, still = int(measured[use].sum()), instrument.name == REST
            noise = "" if still else _measured_noise(normalised[use], measured[use], instrument.components)
            checks.append(nis_check(instrument.name, innovations.nis[use], components, confidence, still, noise))
            for i, component in enumerate(instrument.components):
                rows = use & measured[:, i]
                if rows.sum() >= 10 and not still:
                    checks.append(whiteness_check(instrument.name, component, normalised[rows, i], confidence))
        checks.append(edit_check(instrument.name, innovations.accepted[mine]))
        out += [replace(v, source=instrument.owner) for v in checks]
    return out


def _measured_noise(normalised: FloatArray, measured: BoolArray, components: tuple[str, ...]) -> str:
    """Noise of each component as a share of the stated one, in words: rms of normalised innovations (n, c).

    That is exact where noise is most of an innovation, and where the state's uncertainty goes with the noise.
    """
    there = [(name, normalised[measured[:, i], i]) for i, name in enumerate(components) if measured[:, i].any()]
    return ", ".join(f"{name} {np.sqrt(np.mean(z**2)):.2g}" for name, z in there) + " times the stated"


def filter_against_smoother(
    problem: Problem, run: ForwardPass, smoothed: Smoothed, reference: States, confidence: float
) -> list[Check]:
    """Filter against smoother at the kept nodes after the first seconds."""
    kept = np.flatnonzero(problem.kept)
    settled = problem.time_s[kept] > _settled_from_s(problem)
    difference = boxminus(run.states()[kept], reference[kept])[settled, :KINEMATIC]
    first = KINEMATIC * (KINEMATIC + 1) // 2
    p_filter, p_smoother = (unpacked(t[settled, :first]) for t in (run.filtered.p_plus, smoothed.triangles))
    groups = [name for name in GROUPS if name != "attitude" or not problem.motion.ballistic]
    return mcreynolds_checks(difference, p_filter, p_smoother, groups, confidence)


def data_sheet_checks(problem: Problem, table: pd.DataFrame, confidence: float) -> list[Check]:
    """One check for each instrument with errors that the flight made observable."""
    out = []
    owners = np.array(problem.model.instruments, dtype=object)
    estimated = ~problem.model.wander.considered
    for owner in dict.fromkeys(owners[estimated]):
        name = str(owner)
        rows = table[(owners == name) & estimated]
        estimate, prior_sd, sd = rows[["estimate", "prior_sd", "sd"]].to_numpy(dtype=float).T
        code, label, *bad = _BALLISTIC_CHECKS.get(name, ("data-sheet", f"data sheet {name}"))
        errors = [error.removeprefix(f"{name} ") for error in rows["name"]]
        out.append(data_sheet_check(code, label, name, errors, estimate, prior_sd, sd, confidence, *bad))
    return [v for v in out if v is not None]


def physical_checks(problem: Problem, run: ForwardPass, table: pd.DataFrame, radars: Iterable[str]) -> list[Check]:
    """One check for each estimated radar error with physical limits; if it fails, it names correlated errors."""
    out = []
    rows = table.set_index("name")
    for number, instrument in enumerate(problem.instruments):
        if instrument.name not in radars:
            continue
        for error in RADAR_ERRORS.rows:
            name = f"{instrument.owner} {error.states[0]}" if error.states else ""
            if error.physical is None or name not in rows.index or rows.treated[name] == "considered":
                continue
            low, high = error.physical
            estimate, sd = float(rows.estimate[name]), float(rows.sd[name])
            outside = max(low - estimate, estimate - high, 0.0) / sd
            found = f"{name} {estimate:.2g} ± {sd:.2g}"
            alike = _look_alikes(problem, run, number, error.states[0]) if outside > _MOST_OUTSIDE else []
            advice = (
                f"its readings look alike with {', '.join(alike)}: state these" if alike else "check its correction"
            )
            out.append(
                Check.of(
                    "physical-range", f"physical range {name}", outside, 0.0, _MOST_OUTSIDE,
                    f"{found} is possible", f"{found} is outside {low:g} to {high:g}",
                    advice=f"{advice}, or the range overcorrected it",
                    source=instrument.owner, component=error.states[0],
                )
            )  # fmt: skip
    return out


def _look_alikes(problem: Problem, run: ForwardPass, number: int, component: str) -> list[str]:
    """Errors of the same radar whose partials, less those of its biases, correlate with this one's, most first."""
    rows = np.flatnonzero((problem.observed.source == number) & run.innovations.accepted)
    weight = 1.0 / np.sqrt(problem.observed.variance[rows])  # of components that were not measured zero
    columns = (run.readings.by_error[rows] * weight[:, :, None]).reshape(3 * len(rows), -1)
    names, biases = SLOT_NAMES[RADAR], [0, 1, 2]
    columns = columns - columns[:, biases] @ np.linalg.lstsq(columns[:, biases], columns, rcond=None)[0]
    mine = columns[:, names.index(component)]
    alike = {}
    for k, name in enumerate(names):
        size = np.linalg.norm(columns[:, k]) * np.linalg.norm(mine)
        if k not in biases and name != component and "survey" not in name and size > 0.0:
            alike[name] = abs(float(columns[:, k] @ mine)) / size
    # from a quarter of the variance on a radar hardly separates two errors
    return sorted((name for name, c in alike.items() if c > 0.5), key=lambda name: -alike[name])


def held_out_table(problem: Problem, run: ForwardPass) -> pd.DataFrame:
    """One row for each component of the measurements that were not used: `_COLUMNS`, in order of time."""
    rows = _chosen(problem)
    if len(rows) == 0:
        return pd.DataFrame({name: [] for name in _COLUMNS})
    node = problem.node
    wanted = np.unique(node[rows])
    kept = np.zeros(len(problem.time_s), dtype=bool)
    kept[wanted] = True
    x, covariance = smoothed_covariance(problem, run, kept)
    slots = problem.sources().slot
    out = []
    for row in rows.tolist():
        k = int(node[row])
        h = jacobian(run.readings, slots[problem.observed.source[row]], row, problem.size)
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
    return pd.DataFrame(out, columns=list(_COLUMNS))


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
    """Measurements that were not used, thinned evenly to `_MOST_PREDICTED`."""
    rows = np.flatnonzero(~problem.observed.usable)
    if len(rows) > _MOST_PREDICTED:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST_PREDICTED).astype(np.int64)]
    return np.asarray(rows, dtype=np.int64)


def residual_table(problem: Problem, innovations: Innovations) -> pd.DataFrame:
    """One row for each component that was measured; what is not ``used`` is held out."""
    row, component = np.nonzero(np.isfinite(problem.observed.variance))
    source = problem.observed.source[row]
    names = np.array([i.name for i in problem.instruments], dtype=object)
    components = np.array([(*i.components, "", "")[:3] for i in problem.instruments], dtype=object).reshape(-1, 3)
    return pd.DataFrame(
        {
            "time_s": problem.time_s[problem.node[row]],
            "source": names[source],
            "component": components[source, component],
            "residual": innovations.residual[row, component],
            "predicted_sd": np.sqrt(innovations.covariance[row, component, component]),
            "accepted": innovations.accepted[row],
            "used": problem.observed.usable[row],
        }
    )


def point_findings(problem: Problem, accepted: BoolArray, held_out: pd.DataFrame, settings: Settings) -> list[Issue]:
    """Findings on measurements that were edited, and on trackers that are left out."""
    return edit_findings(problem, accepted) + left_out_findings(problem, held_out, settings)


def edit_findings(problem: Problem, accepted: BoolArray) -> list[Issue]:
    """Stretches in which measurements were edited; sources excluded by settings have none."""
    out = []
    time_s = problem.time_s[problem.node]
    for number, instrument in enumerate(problem.instruments):
        mine = (problem.observed.source == number) & problem.observed.usable
        times = time_s[mine & ~accepted]
        if len(times) == 0:
            continue
        what = "track point" if instrument.name == instrument.owner else "reading"
        stretches = np.split(times, np.flatnonzero(np.diff(times) > SAME_STRETCH_S) + 1)
        if len(stretches) > 12:
            share = 100.0 * len(times) / int(mine.sum())
            remark = f"{len(times)} {what}s edited in {len(stretches)} stretches ({share:.0f} % of them)"
            out.append(Issue(remark, "points-edited", instrument.name, float(times[0]), float(times[-1])))
            continue
        for stretch in stretches:
            remark = f"{len(stretch)} {what}{'s' if len(stretch) > 1 else ''} edited"
            out.append(Issue(remark, "points-edited", instrument.name, float(stretch[0]), float(stretch[-1])))
    return out

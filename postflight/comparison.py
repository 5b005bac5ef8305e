"""How do runs differ? Values of complete runs side by side, and their differences with bounds of the sd.

Values are those at the first run's peak dynamic pressure where all runs count time from the same moment, else each at
its own. The variance of a difference is ``s1^2 + s2^2 - 2 r s1 s2`` with a correlation ``r`` that depends on what the
two runs share. Runs on the same telemetry share nearly everything, and how they are correlated is not known here: their
difference gets no sd of its own but the bounds ``|s1 - s2|`` and ``s1 + s2``, which hold for every correlation. Runs
that share no file are taken as independent: ``sqrt(s1^2 + s2^2)``, and the table says so.

(What a tracker changes when it is left out, against the sd that this should have, is `postflight.sensitivity`'s.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from flightmodel.checks import ConfigError, FloatArray, GateError
from flightmodel.deflection import HOLE_FACTOR, DeflectionHistory
from flightmodel.tables import column_about
from flightmodel.tabular import Tabular
from flightmodel.trajectory import Trajectory, difference, resample
from postflight.deflections import METHODS
from postflight.run_folder import value_and_sd
from postflight.runs import Run, trajectory_of

Sd = TypeVar("Sd", float, pd.Series)
MOST_RUNS = 6  # that strokes and colours keep apart
INDEPENDENT, CORRELATED = "independent", "correlated"
# sizes of the differences of two trajectories, their units, and the scale from SI
APART = (("position_m", "m", 1.0), ("velocity_mps", "m/s", 1.0), ("attitude_deg", "deg", 180.0 / np.pi))


@dataclass(frozen=True)
class Quantity:
    """Compared quantity: words, unit, and its column's name, which ends in the unit."""

    words: str
    unit: str
    column: str


TRAJECTORY = (
    Quantity("dynamic pressure", "Pa", "dynamic_pressure_pa"),
    Quantity("Mach number", "", "mach"),
    Quantity("total angle of attack", "deg", "alpha_total_wind_deg"),
    Quantity("altitude", "m", "alt_m"),
    Quantity("airspeed", "m/s", "airspeed_mps"),
    Quantity("C_A", "", "c_a"),
    Quantity("C_N", "", "c_n"),
)


@dataclass(frozen=True)
class Relation:
    """How the errors of a run and of the first one are related: ``independent`` or ``correlated``, and why."""

    kind: str
    words: str


@dataclass(frozen=True, repr=False)
class RunComparison(Tabular):
    """Complete runs side by side, the first one being what the others are compared with.

    Parameters
    ----------
    runs : tuple of Run
    labels : tuple of str
        What each is called, all different.
    """

    runs: tuple[Run, ...]
    labels: tuple[str, ...]

    @cached_property
    def same_clock(self) -> bool:
        """Whether all runs count time from the same moment."""
        return len({run.header["epoch_utc"] for run in self.runs}) == 1

    @cached_property
    def at_s(self) -> tuple[float, ...]:
        """Time of each run's values."""
        return tuple((self.runs[0] if self.same_clock else run).peak_s for run in self.runs)

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities that at least one run has."""
        methods = [m for m in METHODS if any(run.history(m) is not None for run in self.runs)]
        found = [Quantity(f"deflection: {m}", "deg", f"deflection_{m}_deg") for m in methods]
        found += [Quantity(f"largest: {m}", "deg", f"largest_{m}_deg") for m in methods]
        found += [Quantity("time of peak q", "s", "peak_s"), *TRAJECTORY]
        return tuple(q for q in found if any(np.isfinite(own.get(q.column, (np.nan,))[0]) for own in self.values))

    @cached_property
    def values(self) -> tuple[dict[str, tuple[float, float]], ...]:
        """Value and sd of each quantity, by its column, of each run; NaN where there is none."""
        return tuple(_values(run, at) for run, at in zip(self.runs, self.at_s, strict=True))

    @cached_property
    def relations(self) -> tuple[Relation, ...]:
        """Relation of each run's errors, but the first's, to those of the first."""
        return tuple(_relation(self.runs[0], run) for run in self.runs[1:])

    def value(self, number: int, quantity: Quantity) -> tuple[float, float]:
        """Value of a run and its sd."""
        return self.values[number].get(quantity.column, (np.nan, np.nan))

    def apart(self, number: int, quantity: Quantity) -> tuple[float, float, float, float]:
        """Difference of a run from the first one, its sd (NaN if unknown), and the bounds of the sd."""
        (first, first_sd), (other, other_sd) = self.value(0, quantity), self.value(number, quantity)
        low, high = sd_bounds(first_sd, other_sd)
        independent = self.relations[number - 1].kind == INDEPENDENT
        return other - first, float(np.hypot(first_sd, other_sd)) if independent else np.nan, low, high

    def size_in_sd(self, quantity: Quantity) -> float:
        """Largest difference of any run to the first one over the larger sd of the two; 0 where none is known."""
        sizes = [0.0]
        for k in range(1, len(self.runs)):
            change, sd = self.apart(k, quantity)[0], max(self.value(n, quantity)[1] for n in (0, k))
            if np.isfinite(change) and sd > 0.0:
                sizes.append(abs(change) / sd)
        return max(sizes)

    def to_frame(self) -> pd.DataFrame:
        """One row per run: its identification, then each quantity with its sd, units in the columns' names."""
        rows = []
        for k, run in enumerate(self.runs):
            row: dict[str, Any] = {
                "run": run.path.name, "label": self.labels[k], "flight": run.header["flight"],
                "changes": "; ".join(run.changes), "version": run.facts["version"], "t_s": self.at_s[k],
            }  # fmt: skip
            for q in self.quantities:
                row[q.column], row[column_about(q.column, "sd")] = self.value(k, q)
            checks = run.checks["passed"]
            rows.append(row | {"checks_passed": int(checks.sum()), "checks": len(checks)})
        return pd.DataFrame(rows).dropna(axis=1, how="all")

    def differences(self) -> pd.DataFrame:
        """One row a run but the first: difference, its sd, and ``sd_low``, ``sd_high`` between which that lies."""
        rows = []
        for k, (run, relation) in enumerate(zip(self.runs[1:], self.relations, strict=True), 1):
            row: dict[str, Any] = {"run": run.path.name, "against": self.runs[0].path.name, "errors": relation.kind}
            row["why"] = relation.words
            for q in self.quantities:
                names = [column_about(q.column, f"difference{end}") for end in ("", "_sd", "_sd_low", "_sd_high")]
                row |= dict(zip(names, self.apart(k, q), strict=True))
            rows.append(row)
        return pd.DataFrame(rows).dropna(axis=1, how="all")

    def histories(self) -> pd.DataFrame:
        """Differences over time, at the first run's times; empty where the runs count time from other moments.

        ``position_m``, ``velocity_mps``, ``attitude_deg`` are sizes of vectors, the others are signed.
        """
        if not self.same_clock:
            return pd.DataFrame()
        return pd.concat([_over_time(self.runs[0], run).assign(run=run.path.name) for run in self.runs[1:]])

    def checks(self) -> pd.DataFrame:
        """One row per check: value, limits and whether it passed, for each run by its number."""
        tables = []
        for k, run in enumerate(self.runs, 1):
            table = run.checks[["name", "value", "low", "high", "passed"]]
            table = table.assign(occurrence=table.groupby("name").cumcount()).set_index(["name", "occurrence"])
            tables.append(table.add_suffix(f"_{k}"))
        return pd.concat(tables, axis=1, sort=False).reset_index().drop(columns="occurrence")

    def _about(self) -> str:
        return f"{len(self.runs)} runs, {len(self.quantities)} quantities: {'; '.join(self.labels)}"


def compare_runs(runs: tuple[Run, ...]) -> RunComparison:
    """Set complete runs side by side.

    Raises
    ------
    ConfigError
        ``compare-runs`` for fewer than two or too many runs, ``given-twice`` where one comes twice.
    """
    if not 2 <= len(runs) <= MOST_RUNS:
        words = f"compare: {len(runs)} run{'s' * (len(runs) != 1)} named; 2 to {MOST_RUNS} are wanted"
        raise ConfigError(words, "compare-runs")
    places = [run.path.resolve() for run in runs]
    again = sorted({place.name for k, place in enumerate(places) if place in places[:k]})
    if again:
        words = f"compare: {', '.join(again)} is named more than once; name another run, such as FOLDER/plain"
        raise ConfigError(words, "given-twice")
    return RunComparison(runs, _labels(runs))


def sd_bounds(first_sd: Sd, other_sd: Sd) -> tuple[Sd, Sd]:
    """Bounds of the sd of a difference of two estimates, whatever the correlation of their errors."""
    return abs(first_sd - other_sd), first_sd + other_sd


def _labels(runs: tuple[Run, ...]) -> tuple[str, ...]:
    """Label of each run: its name, or its changes, or "as stated"; with the flight's name if there are several."""
    several = len({run.header["flight"] for run in runs}) > 1
    out = []
    for run in runs:
        label = run.name or "; ".join(run.changes) or "as stated"
        out.append(f"{run.header['flight']}: {label}" if several else label)
    twice = {label for label in out if out.count(label) > 1}
    # equal runs, made again, share their digits too
    return tuple(
        f"{label} ({run.path.name})" if label in twice else label for run, label in zip(runs, out, strict=True)
    )


def _values(run: Run, at_s: float) -> dict[str, tuple[float, float]]:
    bet, nothing = run.tables["bet"], (float("nan"), float("nan"))
    out = {"peak_s": (run.peak_s, np.nan)}
    inside = bet["t_s"].iloc[0] <= at_s <= bet["t_s"].iloc[-1]
    for q in TRAJECTORY:
        known = inside and bet[q.column].notna().any()
        out[q.column] = _near(bet, q.column, at_s) if known else nothing
    for method in METHODS:
        history = run.history(method)
        if history is None:
            continue
        theta, sd = np.rad2deg(history.angle_at(at_s))
        out[f"deflection_{method}_deg"] = float(theta), float(sd)
        out[f"largest_{method}_deg"] = run.summary["methods"][method].get("largest_deg", np.nan), np.nan
    return out


def _near(bet: pd.DataFrame, column: str, at_s: float) -> tuple[float, float]:
    """Value and sd from the nearest rows that have one; NaN if none is near."""
    known = bet[bet[column].notna()]
    step = float(np.median(np.diff(bet["t_s"])))
    if np.abs(known["t_s"] - at_s).min() > step or len(known) < 4:
        return float("nan"), float("nan")
    return value_and_sd(known, column, at_s)


def _relation(first: Run, other: Run) -> Relation:
    a, b = (run.facts["inputs_sha256"] for run in (first, other))
    shared = set(a.values()) & set(b.values())
    if not shared:
        return Relation(INDEPENDENT, "no input file in common: their errors are taken as independent")
    every = "all" if a == b else f"{len(shared)} of {len(a)}"
    words = f"{every} input files in common: their errors are correlated, by how much is not known"
    return Relation(CORRELATED, words)


def _over_time(first: Run, other: Run) -> pd.DataFrame:
    """Differences of a run from the first one, at the first one's times that both cover, in and around the pulse."""
    a, b = first.tables["bet"], other.tables["bet"]
    rows = a["t_s"].between(b["t_s"].iloc[0], b["t_s"].iloc[-1])
    if rows.sum() < 2:
        raise GateError(f"{first.path.name} and {other.path.name}: no time in common", "time-not-covered")
    t = a["t_s"][rows].to_numpy(float)
    out = {"t_s": t, "run": ""} | _vectors(a[rows], b)
    for q in TRAJECTORY:
        out[q.column] = np.interp(t, b["t_s"], b[q.column]) - a[q.column][rows].to_numpy(float)
    for method in METHODS:
        own, theirs = first.history(method), other.history(method)
        if own is not None and theirs is not None:
            out[f"deflection_{method}_deg"] = _angle_deg(theirs, t) - _angle_deg(own, t)
    return pd.DataFrame(out)


def _angle_deg(history: DeflectionHistory, time_s: FloatArray) -> FloatArray:
    """Angle at many times, as `DeflectionHistory.angle_at` has it at one: NaN outside the answers and in holes."""
    t, step = history.time_s, np.diff(history.time_s)
    if len(t) < 2:
        return np.full(len(time_s), np.nan)
    k = np.clip(np.searchsorted(t, time_s, side="right") - 1, 0, len(step) - 1)
    known = (step[k] <= HOLE_FACTOR * np.median(step)) | np.isin(time_s, t)
    return np.where(known, np.interp(time_s, t, np.rad2deg(history.theta_rad), left=np.nan, right=np.nan), np.nan)


def _vectors(a: pd.DataFrame, b: pd.DataFrame) -> dict[str, FloatArray]:
    first, other = trajectory_of(a), trajectory_of(b)
    return sizes_apart(resample(other, first.time_s), first)


def sizes_apart(other: Trajectory, first: Trajectory) -> dict[str, FloatArray]:
    """Sizes (n,) of the differences of position, velocity and attitude, by `APART`; NaN where one has no attitude."""
    gap = difference(other, first).reshape(-1, 3, 3)
    return {name: np.linalg.norm(gap[:, k], axis=1) * scale for k, (name, _, scale) in enumerate(APART)}

"""How large are a run's errors? A finished run of a synthetic flight against its truth.

The only place that opens ``truth/``. Deflections are compared at the true peak of dynamic pressure; the trajectory by
root-mean-square errors ``sqrt(mean |estimate - truth|^2)`` over those rows of the pressure pulse that have a value: a
gap of the gyros has no rates, and a flight without inertial sensors no attitude. An error is too large beyond four
of the run's own standard deviations (of the trajectory their root-mean-square over the pulse), so that a limit fits any
vehicle, flight and instrument. How small the standard deviations are is printed beside them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import FloatArray, GateError, Issue
from flightmodel.deflection import DeflectionHistory
from flightmodel.events import find_peak
from flightmodel.tabular import Tabular
from flightmodel.trajectory import difference, resample
from postflight.run_folder import answer_table, read_csv
from postflight.runs import STATE_COLUMNS, deflection_history, find_run, read_back, trajectory_of

LIMIT_SD = 4.0  # a normal error passes it once in 16 000
METHODS = ("camera", "misalignment", "trim", "fused")
# of the errors that are judged: components of their stated standard deviation in bet.csv
BET_SD = {
    "position_rms_m": tuple(f"r{a}_ecef_sd_m" for a in "xyz"),
    "velocity_rms_mps": tuple(f"v{a}_ecef_sd_mps" for a in "xyz"),
    "alpha_total_rms_deg": ("alpha_total_wind_sd_deg",),
}
# deflections at peak that were published of a shipped vehicle's flight: AIAA 2011-2571, figures 2.3, 2.7 and 2.9
PUBLISHED_DEG = {"irve2_reference": ("IRVE-II (paper)", {"camera": 4.2, "misalignment": 3.5, "trim": 3.75})}


@dataclass(frozen=True, repr=False)
class Score(Tabular):
    """A run against its truth: ``methods`` and ``bet`` as printed by ``score --json``, and what failed.

    ``vehicle`` is the name of the stated one.
    """

    peak_s: float
    methods: dict[str, dict[str, Any]]
    bet: dict[str, float]
    failures: tuple[Issue, ...]
    vehicle: str = ""

    def to_frame(self) -> pd.DataFrame:
        """One row a method at the true peak: ``method, deflection_deg, sd_deg, truth_deg, error_deg, ...``."""
        return pd.DataFrame([{"method": name, **row} for name, row in self.methods.items()])

    def _about(self) -> str:
        found = f"{len(self.failures)} limits exceeded" if self.failures else "truth recovered within every limit"
        return f"at the true peak, {self.peak_s:.3f} s: {found}"

    def as_json(self) -> dict[str, Any]:
        """Return one object for machines."""
        return {
            "peak_dynamic_pressure_s": self.peak_s,
            "methods": self.methods,
            "bet": {name: value if np.isfinite(value) else None for name, value in self.bet.items()},
            "passed": not self.failures,
            "failures": list(self.failures),
        }


def score_run(flight_folder: Path, run: Path | None = None) -> Score:
    """Score the newest (or the given) run.

    Raises
    ------
    GateError
        Where there is no truth or no finished run.
    """
    truth_folder = flight_folder / "truth"
    if not (truth_folder / "truth.csv").is_file():
        raise GateError(f"{flight_folder}: no truth/truth.csv to score against", "truth-missing")
    run = run or find_run(flight_folder)
    truth = _read(truth_folder / "truth.csv", (*STATE_COLUMNS, "dynamic_pressure_pa", "alpha_body_deg"))
    deflection = _read(truth_folder / "deflection.csv", ("t_s", "theta_deg"))
    peak_s, _ = find_peak(truth["t_s"].to_numpy(), truth["dynamic_pressure_pa"].to_numpy())
    true_deg = float(np.interp(peak_s, deflection["t_s"], deflection["theta_deg"]))
    refused = read_back(run / "summary.json", "methods")["methods"]
    methods: dict[str, dict[str, Any]] = {}
    failures: list[Issue] = []
    written = {path.stem for path in run.glob("*.csv")}
    for method in METHODS:
        row = _method_row(run / f"{answer_table(method, written)}.csv", peak_s, true_deg)
        methods[method] = row
        if row["deflection_deg"] is None and refused.get(method, {}).get("applicable", True):
            reason = refused.get(method, {}).get("reason", "not run")
            failures.append(Issue(f"{method}: no answer at peak ({reason})", "deflection-missing"))
        elif row["deflection_deg"] is not None and not abs(row["error_deg"]) <= LIMIT_SD * row["sd_deg"]:
            words = f"{method}: error {row['error_deg']:+.2f} deg beyond {LIMIT_SD:g} sd of {row['sd_deg']:.2f} deg"
            failures.append(Issue(words, "deflection-error"))
    stated = tuple(name for names in BET_SD.values() for name in names)
    bet = _bet_errors(_read(run / "bet.csv", (*STATE_COLUMNS, "alpha_total_wind_deg", *stated)), truth)
    failures += [
        Issue(f"BET {name}: {bet[name]:.3f} beyond {LIMIT_SD:g} sd of {bet[_sd(name)]:.3f}", "trajectory-error")
        for name in BET_SD
        if np.isfinite(bet[_sd(name)]) and not bet[name] <= LIMIT_SD * bet[_sd(name)]
    ]
    vehicle = read_back(run / "bet_header.json").get("vehicle")
    return Score(peak_s, methods, bet, tuple(failures), "" if vehicle is None else vehicle["name"])


def _sd(name: str) -> str:
    """Key of the stated standard deviation of an error."""
    return name.replace("_rms_", "_sd_")


def _read(path: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    """Read a result or truth table; `GateError` where it is no table of numbers with these columns."""
    try:
        table = read_csv(path)
        return table.astype(dict.fromkeys(columns, float))
    except (OSError, ValueError, KeyError, pd.errors.ParserError, pd.errors.EmptyDataError) as fault:
        raise GateError(
            f"{path}: cannot be read as a table with {', '.join(columns)}: {fault}", "file-unreadable"
        ) from None


def _history(path: Path) -> DeflectionHistory:
    """Read a ``deflection_<method>.csv`` back."""
    return deflection_history(_read(path, ("t_s", "theta_deg", "plane_lv_deg", "theta_sd_deg")), path.stem)


def _method_row(path: Path, at_s: float, true_deg: float) -> dict[str, Any]:
    row: dict[str, Any] = {"deflection_deg": None, "sd_deg": None, "truth_deg": true_deg, "error_deg": None}
    if not path.is_file():
        return row
    theta, sd = np.rad2deg(_history(path).angle_at(at_s))
    if np.isfinite(theta) and np.isfinite(sd):
        row |= {"deflection_deg": float(theta), "sd_deg": float(sd), "error_deg": float(theta) - true_deg}
    return row


def _bet_errors(bet: pd.DataFrame, truth: pd.DataFrame) -> dict[str, float]:
    """Root-mean-square errors over the pressure pulse."""
    bet = bet[(bet["t_s"] >= truth["t_s"].iloc[0]) & (bet["t_s"] <= truth["t_s"].iloc[-1])]
    estimate, true = trajectory_of(bet), trajectory_of(truth)
    error = difference(estimate, resample(true, estimate.time_s))

    def along(column: str) -> FloatArray:
        return np.interp(estimate.time_s, truth["t_s"], truth[column])

    pulse = pressure_pulse(along("dynamic_pressure_pa"))
    alpha_error = bet["alpha_total_wind_deg"].to_numpy() - along("alpha_body_deg")

    def rms(values: FloatArray) -> float:
        squares = np.sum(np.atleast_2d(values.T) ** 2, axis=0)[pulse]
        known = squares[np.isfinite(squares)]
        return float(np.sqrt(known.mean())) if len(known) else np.nan

    stated = {_sd(name): rms(bet[list(columns)].to_numpy()) for name, columns in BET_SD.items()}
    return stated | {
        "pulse_start_s": float(estimate.time_s[pulse][0]),
        "pulse_end_s": float(estimate.time_s[pulse][-1]),
        "position_rms_m": rms(error[:, 0:3]),
        "velocity_rms_mps": rms(error[:, 3:6]),
        "attitude_rms_deg": float(np.rad2deg(rms(error[:, 6:9]))),
        "alpha_total_rms_deg": rms(alpha_error),
    }

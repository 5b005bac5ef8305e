"""How large are a run's errors? A finished run of a synthetic flight against its truth.

The only place that opens ``truth/``. Deflections are compared where the run states them, at its peak of dynamic
pressure; the trajectory by
root-mean-square errors ``sqrt(mean |estimate - truth|^2)`` over those rows of the pressure pulse that have a value: a
gap of the gyros has no rates, and a flight without inertial sensors no attitude. An error is too large beyond four
of the run's own standard deviations (of the trajectory their root-mean-square over the pulse), so that a limit fits any
vehicle, flight and instrument. How small the standard deviations are is printed beside them.

A run that knows nothing has large standard deviations, and would keep such a limit with any error. A limit in a
quantity's own unit (`Limits`) therefore bounds the standard deviation as well as the error: an answer that is less
certain than the limit cannot show that the limit is kept. What has no answer fails unless it is named.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import ConfigError, FloatArray, GateError, Issue, nearest_name
from flightmodel.deflection import DeflectionHistory
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
SCORED = (*METHODS, *(name.partition("_rms_")[0] for name in BET_SD))
# deflections at peak that were published of a shipped vehicle's flight: AIAA 2011-2571, figures 2.3, 2.7 and 2.9
PUBLISHED_DEG = {"irve2_reference": ("IRVE-II (paper)", {"camera": 4.2, "misalignment": 3.5, "trim": 3.75})}


class Quantity(NamedTuple):
    """Scored quantity: its name in `SCORED`, values in its unit (NaN for none), and the reason if it has no answer."""

    name: str
    unit: str
    truth: float
    error: float
    sd: float
    reason: str


@dataclass(frozen=True)
class Limits:
    """Largest errors and standard deviations with which the truth counts as recovered.

    Parameters
    ----------
    sd : float
        Of an error, in the quantity's own standard deviations.
    deg, m, mps : float or None
        Of error and standard deviation of every quantity in that unit; None for no limit.
    without : tuple of str
        Quantities of `SCORED` that may be without an answer.

    Raises
    ------
    ConfigError
        ``name-unknown``: ``without`` names what is not scored.
    """

    sd: float = LIMIT_SD
    deg: float | None = None
    m: float | None = None
    mps: float | None = None
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        faults = [
            f"without '{name}': no such quantity{nearest_name(name, SCORED)}; scored are {', '.join(SCORED)}"
            for name in self.without
            if name not in SCORED
        ]
        if faults:
            raise ConfigError(faults, "name-unknown")

    def failures(self, of: Quantity) -> list[Issue]:
        """Limits that a quantity exceeds."""
        name, unit, _, error, sd, reason = of
        missing = "deflection-missing" if name in METHODS else "trajectory-missing"
        too_large = "deflection-error" if name in METHODS else "trajectory-error"
        limit = getattr(self, unit)
        if not np.isfinite(error) or not np.isfinite(sd):
            words = f"{name}: no answer ({reason}); name it with --without if none is expected"
            return [] if name in self.without else [Issue(words, missing, name)]
        words, out = f"{name}: error {error:+.3g} {unit} beyond", list[Issue]()
        if not abs(error) <= self.sd * sd:
            out.append(Issue(f"{words} {self.sd:g} sd of {sd:.3g} {unit}", too_large, name))
        elif limit is not None and not abs(error) <= limit:
            out.append(Issue(f"{words} {limit:g} {unit}", too_large, name))
        if limit is not None and not sd <= limit:
            words = f"{name}: sd {sd:.3g} {unit} above the limit of {limit:g} {unit}: too large to verify the error"
            out.append(Issue(words, "sd-above-limit", name))
        return out


@dataclass(frozen=True, repr=False)
class Score(Tabular):
    """A run against its truth: ``methods`` and ``bet`` as printed by ``score --json``, judged by ``limits``.

    ``vehicle`` is the name of the stated one.
    """

    peak_s: float
    methods: dict[str, dict[str, Any]]
    bet: dict[str, float]
    limits: Limits
    vehicle: str = ""

    def to_frame(self) -> pd.DataFrame:
        """One row a method at the run's peak: ``method, deflection_deg, sd_deg, truth_deg, error_deg, ...``."""
        return pd.DataFrame([{"method": name, **row} for name, row in self.methods.items()])

    @property
    def scored(self) -> list[Quantity]:
        """Every quantity of `SCORED`; of the trajectory rms errors over the pulse, which have no one truth."""
        out = []
        for name, row in self.methods.items():
            error, sd = (np.nan if row[key] is None else row[key] for key in ("error_deg", "sd_deg"))
            out.append(Quantity(name, "deg", row["truth_deg"], error, sd, row.get("reason", "")))
        for key in BET_SD:
            name, _, unit = key.partition("_rms_")
            out.append(Quantity(name, unit, np.nan, self.bet[key], self.bet[_sd(key)], "none was estimated"))
        return out

    def quantities(self) -> pd.DataFrame:
        """Return what is judged: ``quantity, unit, truth, error, sd, limit_sd, limit, passed``, one row each.

        ``truth``, ``error``, ``sd`` and ``limit`` are in ``unit``, ``limit_sd`` in standard deviations.
        """
        rows = [
            (*of[:5], self.limits.sd, getattr(self.limits, of.unit), not self.limits.failures(of)) for of in self.scored
        ]
        columns = ["quantity", "unit", "truth", "error", "sd", "limit_sd", "limit", "passed"]
        return pd.DataFrame(rows, columns=columns)

    @property
    def failures(self) -> tuple[Issue, ...]:
        """Limits that are exceeded."""
        return tuple(issue for of in self.scored for issue in self.limits.failures(of))

    def _about(self) -> str:
        found = f"{len(self.failures)} limits exceeded" if self.failures else "truth recovered within every limit"
        return f"at peak q, {self.peak_s:.3f} s: {found}"

    def assert_recovered(
        self,
        limit_sd: float = LIMIT_SD,
        limit_deg: float | None = None,
        limit_m: float | None = None,
        limit_mps: float | None = None,
        without: Iterable[str] = (),
    ) -> None:
        """Raise where the truth is not recovered within these limits.

        Parameters
        ----------
        limit_sd : float
            Largest error in the quantity's own standard deviations.
        limit_deg, limit_m, limit_mps : float, optional
            Largest error, and largest standard deviation, of quantities in deg (the deflections and the total angle of
            attack), m (position) and m/s (velocity).
        without : iterable of str
            Quantities that need no answer: methods, or ``position``, ``velocity``, ``alpha_total``.

        Raises
        ------
        AssertionError
            With a table of every quantity and one line a failure.
        ConfigError
            ``name-unknown``: ``without`` names what is not scored.
        """
        judged = replace(self, limits=Limits(limit_sd, limit_deg, limit_m, limit_mps, tuple(without)))
        if judged.failures:
            table = judged.quantities().to_string(index=False, na_rep="-", float_format=lambda x: f"{x:.3g}")
            raise AssertionError("\n".join(["the truth is not recovered", table, *judged.failures]))

    def as_json(self) -> dict[str, Any]:
        """Return one object for machines."""
        table = self.quantities().astype(object)
        return {
            "peak_dynamic_pressure_s": self.peak_s,
            "methods": self.methods,
            "bet": {name: value if np.isfinite(value) else None for name, value in self.bet.items()},
            "limits": asdict(self.limits),
            "quantities": table.where(table.notna(), None).to_dict("records"),
            "passed": not self.failures,
            "failures": list(self.failures),
            "failure_codes": [failure.code for failure in self.failures],
        }


def score_run(flight_folder: Path, run: Path | None = None, limits: Limits | None = None) -> Score:
    """Score the newest (or the given) run by these limits, or by `LIMIT_SD` alone.

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
    summary = read_back(run / "summary.json", "methods")
    peak_s, refused = float(summary["peak_dynamic_pressure_s"]), summary["methods"]
    true_deg = float(np.interp(peak_s, deflection["t_s"], deflection["theta_deg"]))
    methods: dict[str, dict[str, Any]] = {}
    written = {path.stem for path in run.glob("*.csv")}
    for method in METHODS:
        methods[method] = _method_row(run / f"{answer_table(method, written)}.csv", peak_s, true_deg)
        if methods[method]["deflection_deg"] is None:
            methods[method]["reason"] = refused.get(method, {}).get("reason", "not run")
    stated = tuple(name for names in BET_SD.values() for name in names)
    bet = _bet_errors(_read(run / "bet.csv", (*STATE_COLUMNS, "alpha_total_wind_deg", *stated)), truth)
    vehicle = read_back(run / "bet_header.json").get("vehicle")
    return Score(peak_s, methods, bet, limits or Limits(), "" if vehicle is None else vehicle["name"])


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

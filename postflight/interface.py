"""Public verbs on folders and studies: check, simulate, score, dispersed flights, what-ifs compared, reports."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from flightmodel.airdata import pressure_pulse
from flightmodel.checks import GateError, Progress, check_path, check_type, check_whole
from flightmodel.tabular import Tabular
from flightmodel.trajectory import resample
from postflight.checks.folder_check import Report, check_folder
from postflight.comparison import APART, sd_bounds, sizes_apart
from postflight.deflections import Deflections
from postflight.flight import RECONSTRUCT
from postflight.montecarlo import execution
from postflight.montecarlo.bands import Merged, merge, write_merged
from postflight.montecarlo.study import read_study
from postflight.reconstruction import Reconstruction
from postflight.report import write
from postflight.run_folder import value_and_sd
from postflight.runs import find_run
from postflight.scoring import Score, score_run
from synthetic_flight.ensemble import available_cores
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import Scenario, fly_scenario, read_scenario
from synthetic_flight.simulate import Truth


def check_flight(folder: str | Path) -> Report:
    """Facts, findings and cross-checks of a flight folder before it is run: units, axes, clocks, gaps, tracks.

    Never refuses: what `read_flight` would refuse is listed in the report.
    """
    return check_folder(check_path("check_flight: folder", folder))


def simulate(
    scenario: str | Path | Scenario,
    folder: str | Path | None = None,
    seed: int = 0,
    replace: bool = False,
    progress: Progress | None = None,
) -> Truth:
    """Fly a scenario with the two-body simulator; with a folder, write telemetry and truth there as a flight folder.

    Parameters
    ----------
    scenario : str, path or Scenario
        Name of a shipped one, a TOML file, or one that was read.
    folder : path, optional
        New flight folder: ``telemetry/`` for the estimators, ``truth/`` apart.
    seed : int
        Draws the day's atmosphere and every instrument's errors.
    replace : bool
        Replace an existing *synthetic* flight folder; anything else is never touched.
    progress : callable, optional

    Returns
    -------
    Truth
        What the vehicle did, for comparison; no estimator takes it.

    Raises
    ------
    ConfigError
        The scenario cannot be used.
    GateError
        The folder exists, or the flight diverged before the telemetry begins.
    """
    check_whole("seed", seed, 0)
    chosen = scenario if isinstance(scenario, Scenario) else read_scenario(scenario)
    if folder is None:
        return fly_scenario(chosen, seed)
    return simulate_to_folder(chosen, seed, check_path("simulate: folder", folder), progress, replace)


def score(folder: str | Path, run: str | Path | None = None) -> Score:
    """Compare a complete run of a synthetic flight with its truth.

    Parameters
    ----------
    folder : path
        The flight's.
    run : str or path, optional
        The run's name, its eight digits or its folder; ``plain`` for the last that is no what-if; the last by default.

    Raises
    ------
    GateError
        Where there is no truth, or no such complete run.
    """
    folder = check_path("score: folder", folder)
    return score_run(folder, _run(folder, run))


def _run(folder: Path, run: str | Path | None) -> Path | None:
    """Folder of the run that is meant; None for the last."""
    if run is None:
        return None
    check_type("run", run, (str, Path), "a run's name, its eight digits or its folder")
    return find_run(folder, run)


def monte_carlo(
    dispersions: str | Path,
    folder: str | Path,
    flights: int | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Merged:
    """Fly a study of dispersed flights into a folder, or what is missing of it, and merge it.

    Parameters
    ----------
    dispersions : str or path
        Name of a shipped dispersions file, or a TOML file.
    folder : path
        Holds one study; killed runs are resumed, more flights extend it.
    flights : int, optional
        In place of the file's number.
    workers : int, optional
        Processes; every core by default.
    progress : callable, optional

    Returns
    -------
    Merged
        Tables ``flights``, ``percentiles`` and ``bands``.

    Raises
    ------
    ConfigError
        The dispersions file cannot be used.
    GateError
        The folder holds another study.
    """
    check_whole("flights", flights, 1)
    check_whole("workers", workers, 1)
    study, folder = read_study(str(dispersions)), check_path("monte_carlo: folder", folder)
    wanted = execution.Wanted(flights or study.spec.flights, workers or available_cores(), None, study.spec.stop)
    count = execution.run(study, folder, wanted, progress or (lambda _fraction, _what: None))
    merged = merge(study, folder, count)
    write_merged(folder, merged)
    return merged


def write_report(folder: str | Path, run: str | Path | None = None) -> Path:
    """Write the report of a complete run as one HTML file; return where it lies.

    Parameters
    ----------
    folder : path
        The flight's.
    run : str or path, optional
        As `score` takes it.

    Raises
    ------
    GateError
        Where the run cannot be read, or the file not be written.
    """
    folder = check_path("write_report: folder", folder)
    return write.write_report(folder, _run(folder, run))


@dataclass(frozen=True, repr=False)
class Comparison(Tabular):
    """Comparison of two analyses of one flight; see `compare`."""

    table: pd.DataFrame
    names: tuple[str, str]

    def to_frame(self) -> pd.DataFrame:
        """One row a quantity: ``quantity, unit, first, first_sd, second, second_sd, difference``, bounds of its sd."""
        return self.table

    def _about(self) -> str:
        return f"{self.names[0]} against {self.names[1]}, {len(self.table)} quantities"


def compare(first: Reconstruction | Deflections, second: Reconstruction | Deflections) -> Comparison:
    """Compare two analyses of one flight, e.g. the flight and a what-if.

    Parameters
    ----------
    first, second : Reconstruction or Deflections
        From `reconstruct`, or from `fuse` to compare the deflections too.

    Returns
    -------
    Comparison
        Peak dynamic pressure and its time, Mach number and total angle of attack there, largest differences of the
        trajectories over the pressure pulse, deflection by method, numbers of consistency checks that pass;
        ``difference`` is second minus first. The two share their data, so that their errors are correlated: the sd of
        the difference lies between ``difference_sd_low`` and ``difference_sd_high`` for every correlation.

    Raises
    ------
    GateError
        Where the two flights have no time in common.
    """
    for look in (first, second):
        check_type("compare", look, (Reconstruction, Deflections), f"{RECONSTRUCT} or pf.fuse(bet)")
    bets = [x if isinstance(x, Reconstruction) else _bet_of(x) for x in (first, second)]
    rows = _peak_rows(bets[0], bets[1]) + _trajectory_rows(bets[0], bets[1])
    if isinstance(first, Deflections) and isinstance(second, Deflections):
        rows += _deflection_rows(first, second)
    rows.append(("consistency checks passed", "", _passed(bets[0]), np.nan, _passed(bets[1]), np.nan))
    table = pd.DataFrame(rows, columns=["quantity", "unit", "first", "first_sd", "second", "second_sd"])
    table["difference"] = table["second"] - table["first"]
    table["difference_sd_low"], table["difference_sd_high"] = sd_bounds(table["first_sd"], table["second_sd"])
    a, b = ("; ".join((bet.flight.name, *bet.flight.changes)) for bet in bets)
    return Comparison(table, (a, b))


Row = tuple[str, str, float, float, float, float]


def _bet_of(answer: Deflections) -> Reconstruction:
    if answer.bet is None:
        raise GateError("compare: these deflections were made without a trajectory", "input-missing")
    return answer.bet


def _passed(bet: Reconstruction) -> float:
    return float(sum(check.passed for check in bet.consistency_checks))


def _peak_rows(first: Reconstruction, second: Reconstruction) -> list[Row]:
    """Values at each one's own peak, as events.csv and peaks.csv have them."""
    bets = (first, second)
    rows: list[Row] = [("time of peak dynamic pressure", "s", first.peak_s, np.nan, second.peak_s, np.nan)]
    for name, unit, column in (
        ("peak dynamic pressure", "Pa", "dynamic_pressure_pa"),
        ("Mach number at peak q", "", "mach"),
        ("total angle of attack at peak q", "deg", "alpha_total_wind_deg"),
    ):
        one, other = (value_and_sd(bet.table, column, bet.peak_s) for bet in bets)
        rows.append((name, unit, *one, *other))
    return rows


def _trajectory_rows(first: Reconstruction, second: Reconstruction) -> list[Row]:
    """Largest differences of the trajectories where dynamic pressure exceeds half its peak; the first is zero."""
    t = first.air.time_s
    use = pressure_pulse(first.air.dynamic_pressure_pa)
    other = second.trajectory.time_s
    use &= (t >= other[0]) & (t <= other[-1])
    if not use.any():
        raise GateError(
            "compare: the two trajectories have no time of the pressure pulse in common", "time-not-covered"
        )
    apart = sizes_apart(resample(second.trajectory, t[use]), resample(first.trajectory, t[use]))
    rows: list[Row] = []
    for column, unit, _ in APART:
        name = f"largest difference of {column.split('_')[0]} over the pulse"
        rows.append((name, unit, 0.0, np.nan, float(apart[column].max()), np.nan))
    return rows


def _deflection_rows(first: Deflections, second: Deflections) -> list[Row]:
    methods = list(dict.fromkeys((*first.histories, *second.histories)))
    tables = [answer.to_frame().set_index("method").reindex(methods) for answer in (first, second)]
    columns = [table[name] for table in tables for name in ("theta_deg", "theta_sd_deg")]
    names = (f"deflection by {method} at peak q" for method in methods)
    return [(name, "deg", *values) for name, *values in zip(names, *columns, strict=True)]

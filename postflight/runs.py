"""Which runs does a flight have, which one is selected, and what did it write? Runs named, selected and read back.

A run is complete where every file is there that a later command reads; what `postflight deflection` and `postflight
reconcile` leave is none, and what is being written, or was when its process was killed, bears a hidden name.

A run that is read back (`Run`) has the same parts as a `Reconstruction`, from its tables: trajectory, air, loads,
deflections. Only its flight is read from the flight folder, when something asks for it.
"""

from __future__ import annotations

import ast
import json
import re
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from estimators.loads import FlightLoads
from flightmodel import rotations
from flightmodel.airdata import AirData, pressure_pulse
from flightmodel.atmosphere import AirState
from flightmodel.checks import Check, ConfigError, FloatArray, GateError, Issue, check_path, check_type, nearest_name
from flightmodel.deflection import QUANTILE_COLUMNS, DeflectionHistory
from flightmodel.earth import PLANETS, WGS84, Planet
from flightmodel.files import file_bytes
from flightmodel.tables import column_about
from flightmodel.tabular import Tabular
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory
from postflight.deflections import METHODS, Deflections
from postflight.flight import Flight, read_flight
from postflight.reconstruction import Reconstruction
from postflight.run_folder import FACTS, answer_table, read_csv, run_hash
from recon.atmosphere import ReconstructedAir

PLAIN = "plain"  # selects the last run without a changed assumption
STATE_COLUMNS = (
    "t_s",
    *(f"r{a}_ecef_m" for a in "xyz"),
    *(f"v{a}_ecef_mps" for a in "xyz"),
    *(f"q{a}_ecef_body" for a in "wxyz"),
    *(f"{a}_body_degps" for a in "pqr"),
)
_COMPLETE = (FACTS, "summary.json", "bet_header.json", "bet.csv")
_NEEDED = ("bet", "events", "peaks", "residuals", "verdicts", "findings")
_CHECKS = ("name", "value", "low", "high", "passed", "remark", "code")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
_SHOWN = 8  # of a flight's runs, in a message


def check_name(name: str) -> str:
    """Return the name if a run may have it, or raise `ConfigError`: it becomes part of a folder's name."""
    if not _NAME.fullmatch(name) or name == PLAIN:
        words = f"--name {name!r}: letters, digits, '.', '_' and '-', at most 40 of them, are wanted; not '{PLAIN}'"
        raise ConfigError(words, "option-format")
    return name


def is_complete(run: Path) -> bool:
    """Whether a run folder holds everything that later commands read."""
    return all((run / name).is_file() for name in _COMPLETE)


def complete_runs(flight_folder: Path) -> list[Path]:
    """Complete runs of a flight, the oldest first."""
    there = (flight_folder / "runs").glob("*/")
    return sorted(run for run in there if not run.name.startswith(".") and is_complete(run))


def facts_of(run: Path) -> dict[str, Any]:
    """Return ``run.json``; `GateError` where it cannot be read."""
    return read_back(run / FACTS, "settings")


def read_back(path: Path, *parts: str) -> dict[str, Any]:
    """Return a JSON object of a run in which these parts are objects too; `GateError` where it cannot be read."""
    try:
        found = json.loads(file_bytes(path))
        if isinstance(found, dict) and all(isinstance(found.get(part), dict) for part in parts):
            return found
        fault: object = f"it states no {' and no '.join(parts)}"
    except (OSError, ValueError) as refused:
        fault = refused
    raise GateError(f"{path}: cannot be read back ({fault}); run it again", "run-incomplete")


def changes_of(facts: dict[str, Any]) -> tuple[str, ...]:
    """Assumptions in which a run differs from its flight folder."""
    return tuple(map(str, facts["settings"].get("changes") or ()))


def find_run(flight_folder: Path, wanted: str | Path | None = None) -> Path:
    """Return the last complete run, or the last one that matches a word.

    Parameters
    ----------
    flight_folder : Path
    wanted : str, Path or None
        The run's name, its eight digits, its folder or the folder's name; ``plain`` for the last without a changed
        assumption.

    Raises
    ------
    GateError
        ``run-missing`` where the flight has no complete run, ``name-unknown`` where none is so called,
        ``run-incomplete``, ``run-missing`` where the folder is not one, or of another flight.
    """
    runs = complete_runs(flight_folder)
    named = {name for run in runs for name in _names(run)}
    if wanted is not None and str(wanted) not in (PLAIN, *named) and Path(wanted).is_dir():
        return _whole(flight_folder, Path(wanted))
    if not runs:
        alone = sorted((flight_folder / "runs").glob("*/answers.csv"))
        holds = f" ({alone[-1].parent} holds a deflection, and no trajectory, which needs trackers)" if alone else ""
        words = f"{flight_folder}: no complete run{holds}; use `postflight run {flight_folder}` first"
        raise GateError(words, "run-missing")
    if wanted is None:
        return runs[-1]
    wanted = str(wanted)
    if wanted == PLAIN:
        fitting = [run for run in runs if not changes_of(facts_of(run))]
    else:
        fitting = [run for run in runs if wanted in _names(run)]
    if fitting:
        return fitting[-1]
    known = [PLAIN, *(name for run in runs[-_SHOWN:] for name in _names(run))]
    listed = "; ".join(f"{run.name} ({_about(facts_of(run))})" for run in runs[-_SHOWN:])
    words = f"{flight_folder}: no complete run '{wanted}'{nearest_name(wanted, known)}; there are: {listed}"
    raise GateError(words, "name-unknown")


def _whole(flight_folder: Path, run: Path) -> Path:
    """Return the folder of a run of this flight, or raise `GateError` with its missing files."""
    if run.resolve().parent != (flight_folder / "runs").resolve():
        words = f"{run}: no run of {flight_folder}, whose runs lie in {flight_folder / 'runs'}"
        raise GateError(words, "run-missing")
    missing = [name for name in _COMPLETE if not (run / name).is_file()]
    if missing:
        words = f"{run}: no complete run, without {', '.join(missing)}; `postflight run` leaves one, `reconcile` and "
        raise GateError(f"{words}`deflection` do not", "run-incomplete")
    return run


def _names(run: Path) -> tuple[str, ...]:
    """What a run is called: its folder's name, its eight digits, and the name that it was given."""
    _, _, rest = run.name.partition("-")
    digits, _, name = rest.partition("-")
    return tuple(filter(None, (run.name, digits, name)))


def _about(facts: dict[str, Any]) -> str:
    return "; ".join(changes_of(facts)) or "as flight.toml states it"


@dataclass(frozen=True, repr=False)
class Run(Tabular):
    """A complete run, read back: trajectory, air, loads and deflections as a fresh reconstruction has them.

    Parameters
    ----------
    path : Path
        The run's folder.
    summary, facts, header : dict
        ``summary.json``, ``run.json``, ``bet_header.json``.
    tables : dict of DataFrame
        Every CSV table of the folder by its stem.
    given : Flight or None
        The flight that it was made from, where it is at hand; else `flight` reads it.
    """

    path: Path
    summary: dict[str, Any]
    facts: dict[str, Any]
    header: dict[str, Any]
    tables: dict[str, pd.DataFrame]
    given: Flight | None = None

    @property
    def hash8(self) -> str:
        """Digits of the folder's name that identify inputs, settings and version."""
        return run_hash(self.facts["inputs_sha256"], self.facts["settings"], self.facts["version"])

    @property
    def name(self) -> str:
        """The name that the run was given; empty for none."""
        return str(self.facts.get("name") or "")

    @property
    def changes(self) -> tuple[str, ...]:
        """Assumptions in which the run differs from its flight folder; none for a plain run."""
        return changes_of(self.facts)

    @property
    def table(self) -> pd.DataFrame:
        """``bet.csv``; not to be changed."""
        return self.tables["bet"]

    def to_frame(self) -> pd.DataFrame:
        """Trajectory and air data with their standard deviations: ``bet.csv`` (docs/bet-product.md)."""
        return self.table.copy()

    def _about(self) -> str:
        deflections = ", ".join(self.deflections) or "no deflection"
        return "; ".join((self.header["flight"], self.path.name, deflections, *self.changes))

    # what it was made from

    @cached_property
    def flight(self) -> Flight:
        """The flight as the run looked at it, with its changed assumptions.

        Raises
        ------
        GateError
            ``inputs-changed`` where the flight folder is not what the run was made from.
        """
        folder = self.path.resolve().parent.parent
        flight = read_flight(folder) if self.given is None else self.given
        then, now = self.facts["inputs_sha256"], flight.telemetry.hashes
        changed = sorted(name for name in then.keys() | now.keys() if then.get(name) != now.get(name))
        if changed:
            again = f"use `postflight run {folder}` again"
            words = f"{folder}: changed since the run {self.path.name}: {', '.join(changed)}; {again}"
            raise GateError(words, "inputs-changed")
        if self.given is None:
            for text in self.changes:
                name, _, value = text.partition(" = ")
                flight = flight.with_(**{name: _literal(value)})
        return flight

    @property
    def telemetry(self) -> Telemetry:
        """What was measured."""
        return self.flight.telemetry

    # trajectory and air

    @cached_property
    def trajectory(self) -> Trajectory:
        """The best estimate.

        Its covariance holds the variances of ``bet.csv``; the terms off the diagonal are NaN (``covariance.npz`` has
        them once a second).
        """
        planet = PLANETS[self.header.get("planet", "earth")]
        parts = ("r{}_ecef_sd_m", "v{}_ecef_sd_mps", "rotation_{}_body_sd_deg")
        place, velocity, turned = (_columns(self.table, pattern, "xyz") for pattern in parts)
        sd = np.hstack([place, velocity, np.deg2rad(turned)])
        covariance = np.where(np.eye(9, dtype=bool), sd[:, :, None] ** 2, np.nan)
        return replace(trajectory_of(self.table, self.header["epoch_utc"], planet), covariance=covariance)

    @property
    def has_attitude(self) -> bool:
        """Whether inertial sensors carried the attitude; in ballistic flight it is not known."""
        return bool(self.header["motion"] != "ballistic")

    @cached_property
    def air(self) -> AirData:
        """Air data along the trajectory (``bet.csv``).

        The path angle is that of the datum, the density's sd holds the altitude's error too, and terms off the diagonal
        of ``lateral_flow_cov`` are NaN.
        """
        return air_of(self.table)

    @property
    def peak_s(self) -> float:
        """Time of the run's peak dynamic pressure, s."""
        return float(self.summary["peak_dynamic_pressure_s"])

    @property
    def pulse_s(self) -> tuple[float, float]:
        """Begin and end of the pressure pulse, s."""
        inside = self.air.time_s[pressure_pulse(np.nan_to_num(self.air.dynamic_pressure_pa))]
        return float(inside[0]), float(inside[-1])

    @property
    def as_flown(self) -> ReconstructedAir | None:
        """As-flown density and winds; None where the run has none."""
        if "air_profile" not in self.tables:
            return None
        profile, drag, parameters = (self.tables[name] for name in ("air_profile", "drag_ratio", "air_parameters"))
        return ReconstructedAir(profile, drag, parameters, ())

    @cached_property
    def loads(self) -> FlightLoads | None:
        """Motion and flow at the c.g., by `read_loads` of ``bet.csv`` with its default errors; None without forces.

        The vehicle is that of `flight`.
        """
        from postflight.loads_table import LOADS_COLUMNS, read_loads

        if not self.table["ax_cg_mps2"].notna().any() or not self.has_attitude:
            return None
        return read_loads(self.table[list(LOADS_COLUMNS)], self.telemetry.required_vehicle())

    def required_loads(self) -> FlightLoads:
        """Motion and flow at the c.g.; `GateError` with the reason where there are none."""
        if self.loads is None:
            why = "; ".join(map(str, self.summary["missing"])) or "bet.csv holds no specific force at the c.g."
            raise GateError(f"{self.path.name}: {why}", "input-missing")
        return self.loads

    # checks and residuals

    @property
    def checks(self) -> pd.DataFrame:
        """Consistency checks; of a run of version 0.1 those of ``verdicts.csv``, without codes."""
        table = self.tables.get("consistency_checks")
        if table is None:
            table = self.tables["verdicts"].rename(columns={"words": "remark"})
        return table[[name for name in _CHECKS if name in table]]

    @property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Checks of the trajectory, the air and the deflections."""
        rows = self.checks.to_dict(orient="records")
        return tuple(Check(**({"code": ""} | {str(name): value for name, value in row.items()})) for row in rows)

    @property
    def findings(self) -> tuple[Issue, ...]:
        """What was found in the data and on the way."""
        rows = self.tables["findings"].astype({"source": str, "what": str}).itertuples()
        return tuple(Issue(r.what, getattr(r, "code", ""), r.source, r.start_s, r.end_s) for r in rows)

    def peak(self, name: str) -> pd.Series | None:
        """Row of ``peaks.csv``; None where the flight has none of that name."""
        rows = self.tables["peaks"][self.tables["peaks"]["peak"] == name]
        return rows.iloc[0] if len(rows) else None

    # deflection

    @cached_property
    def deflections(self) -> Deflections:
        """Answers by method as `fuse` gives them, and the reasons of methods without one.

        What stands behind the fused answer (``fused``, ``camera``) is not stored.
        """
        stems = {method: f"deflection_{method}" for method in METHODS}
        found = {m: deflection_history(self.tables[s], m) for m, s in stems.items() if len(self.tables.get(s, ()))}
        rows = self.summary.get("methods") or {}
        refused = {m: Issue(r["reason"], r["code"]) for m, r in rows.items() if m not in found and "reason" in r}
        smooth = self.history("camera") if "camera_smooth" in self.tables else None
        has_its_parts = cast(Reconstruction, self)
        return Deflections(found, refused, smooth_camera=smooth, bet=has_its_parts)

    def history(self, method: str) -> DeflectionHistory | None:
        """A method's answer at any time; None where it gave none."""
        table = self.tables.get(answer_table(method, self.tables))
        return None if table is None or not len(table) else deflection_history(table, method)


def _literal(text: str) -> Any:
    """Value in Python's notation; anything else is a string."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return text


def read_run(folder: str | Path, run: str | Path | None = None, flight: Flight | None = None) -> Run:
    """Read a finished run back: its trajectory, air, loads and deflections.

    Parameters
    ----------
    folder : path
        The flight's folder, or a run's own.
    run : str or path, optional
        Which run of the flight: its name, its eight digits or its folder; ``plain`` for the last without a changed
        assumption; the last complete one by default.
    flight : Flight, optional
        What the run was made from, where it is at hand.

    Returns
    -------
    Run

    Raises
    ------
    GateError
        Where there is no such complete run, or a file of it is missing or cannot be read.
    """
    folder = check_path("read_run: folder", folder)
    if run is not None:
        check_type("read_run: run", run, (str, Path), "a run's name, its eight digits or its folder")
    return read_tables(folder if run is None and is_complete(folder) else find_run(folder, run), flight)


def read_tables(run: Path, flight: Flight | None = None) -> Run:
    """Read a run back.

    Raises
    ------
    GateError
        ``run-incomplete`` where a file of it is missing or cannot be read.
    """
    again = f"use `postflight run {run.parent.parent}` again"
    try:
        summary, header = (json.loads(file_bytes(run / f"{name}.json")) for name in ("summary", "bet_header"))
        tables = {p.stem: read_csv(p) for p in sorted(run.glob("*.csv"))}
    except (OSError, ValueError) as fault:
        raise GateError(f"{run}: not a whole run ({fault}); {again}", "run-incomplete") from None
    answered = [m for m, row in (summary.get("methods") or {}).items() if row.get("deflection_deg") is not None]
    needed = (*_NEEDED, *(answer_table(method, tables) for method in answered))
    missing = [f"{name}.csv" for name in needed if name not in tables]
    if missing:
        raise GateError(f"{run}: not a whole run, without {', '.join(missing)}; {again}", "run-incomplete")
    return Run(run, summary, facts_of(run), header, tables, flight)


def deflection_history(table: pd.DataFrame, method: str) -> DeflectionHistory:
    """Angle, plane, their sd and the angle's quantiles of a ``deflection_<method>.csv``.

    The correlation of angle and plane, which the table does not hold, is taken as zero.
    """
    names = ("theta_deg", "plane_lv_deg", "theta_sd_deg")
    theta, plane, sd = (np.deg2rad(table[c].to_numpy(dtype=float)) for c in names)
    cov = np.zeros((len(table), 2, 2))
    cov[:, 0, 0] = sd**2
    if "plane_sd_deg" in table:
        cov[:, 1, 1] = np.deg2rad(table["plane_sd_deg"].to_numpy(dtype=float)) ** 2
    stored = all(name in table for name in QUANTILE_COLUMNS)
    quantiles = np.deg2rad(table[list(QUANTILE_COLUMNS)].to_numpy(dtype=float)) if stored else None
    return DeflectionHistory(table["t_s"].to_numpy(dtype=float), theta, plane, cov, method, "", quantiles)


def _columns(table: pd.DataFrame, pattern: str, letters: str) -> FloatArray:
    """Columns (n, k) of a vector."""
    return table[[pattern.format(a) for a in letters]].to_numpy(dtype=float)


def trajectory_of(table: pd.DataFrame, epoch_utc: str = "2000-01-01T00:00:00Z", planet: Planet = WGS84) -> Trajectory:
    """Trajectory from the `STATE_COLUMNS` that ``truth.csv`` and ``bet.csv`` share, without a covariance."""
    q = _columns(table, "q{}_ecef_body", "wxyz")
    return Trajectory(
        epoch_utc,
        table["t_s"].to_numpy(dtype=float),
        "datum",
        _columns(table, "r{}_ecef_m", "xyz"),
        _columns(table, "v{}_ecef_mps", "xyz"),
        rotations.continuous(q / np.linalg.norm(q, axis=1, keepdims=True)),
        np.deg2rad(_columns(table, "{}_body_degps", "pqr")),
        None,
        planet,
    )


# field of the air data that is not the column without its unit, and its column
_AIR_COLUMNS = {
    "time_s": "t_s", "altitude_m": "alt_m", "latitude_rad": "lat_deg", "longitude_rad": "lon_deg",
    "flight_path_angle_rad": "flight_path_deg",
}  # fmt: skip


def air_of(table: pd.DataFrame) -> AirData:
    """Air data from the columns of ``bet.csv``; NaN where the flight has no attitude."""

    def column(name: str) -> FloatArray:
        stored = _AIR_COLUMNS.get(name, name.replace("_rad", "_deg"))
        values = table[stored].to_numpy(dtype=float)
        return np.deg2rad(values) if name.endswith("_rad") else values

    airspeed, density, (alpha, beta) = (
        column("airspeed_mps"),
        column("rho_kgpm3"),
        map(column, ("alpha_rad", "beta_rad")),
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        sound = airspeed / column("mach")
    wind = np.column_stack([column("wind_n_mps"), column("wind_e_mps"), np.zeros(len(table))])
    density_sd = column(column_about("rho_kgpm3")) / density
    air = AirState(density, column("t_k"), column("p_pa"), sound, wind, density_sd, column("wind_sd_mps"))
    ahead = np.column_stack([np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)])
    flow_sd = np.column_stack([column("beta_sd_rad"), column("alpha_sd_rad")])
    made: Any = {
        "air": air,
        "velocity_air_body_mps": airspeed[:, None] * ahead,
        "lateral_flow_cov": np.where(np.eye(2, dtype=bool), flow_sd[:, :, None] ** 2, np.nan),
    }
    return AirData(**made | {f.name: column(f.name) for f in fields(AirData) if f.name not in made})

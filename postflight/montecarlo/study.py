"""What is a Monte Carlo study, which draws does each run have, and which dispersion contributes most to an output?

A study is a dispersions file with its scenario. Two studies are the same where their settings are: everything but the
number of flights and the stop rule. Runs draw at random, or by Saltelli's design for Sobol indices: two independent
samples A and B of ``n`` points of the unit cube from one Sobol' sequence, and for every column the sample A with that
column from B, ``n (columns + 2)`` flights. A column is a factor, or a section of the dispersions file with all its
factors; the day-of-flight atmosphere, a whole profile, is drawn from the digits of one coordinate and so is one factor.

``S_i = V(E(y | x_i)) / V(y)`` is the share of the variance by column i alone (first order), ``S_Ti`` its share with all
interactions (total). `scipy.stats.sobol_indices` gives the same numbers but needs every flight to succeed.

References
----------
Saltelli et al., "Variance based sensitivity analysis of model output", Comput. Phys. Commun. 181, 2010, Table 2 (b)
and (f).

Are reconstruction and estimators as accurate as they state? Whole trials against the truth of a synthetic flight.

A trial is a callable ``trial(run_index) -> flat mapping of named numbers``: fly, sense, reconstruct, estimate, compare.
Flown is the dispersed vehicle, with atmosphere and instruments of the run's own; reconstructed is with the nominal
vehicle and the data sheets' standard deviations. Errors are ``estimate - truth`` at the flight's true peak of dynamic
pressure, NEES is ``e^T P^-1 e`` of the nine components of the trajectory. Without the camera: rendering and reading a
film takes minutes a flight.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from flightmodel.airdata import air_data
from flightmodel.checks import NO_FAULT, ConfigError, FloatArray, GateError, Issue, nearest_name
from flightmodel.config import Section, parse_section, read_toml
from flightmodel.events import find_peak
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import difference, resample
from flightmodel.vehicle import DATA, Vehicle
from postflight.deflections import estimate
from postflight.flight import Flight
from postflight.reconstruction import reconstruct
from synthetic_flight.dispersions import SMALLEST, Dispersions, Window, dispersed_case, draws, run_seed
from synthetic_flight.dynamics import check_resolved
from synthetic_flight.ensemble import QUANTITIES, SCALARS, Plan, Row, check_outputs, failure_reason, legs
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

MOST_FLIGHTS = 10_000_000
CONFIDENCE = 0.95
Flights = Annotated[int, Field(ge=1, le=MOST_FLIGHTS)]
METHODS = ("misalignment", "trim", "fused")
TRIAL_SCALARS = (
    "truth_deg",
    *(f"{method}_{what}" for method in METHODS for what in ("deg", "sd_deg", "error_deg")),
    "bet_position_m",
    "bet_velocity_mps",
    "bet_attitude_deg",
    "bet_nees",
    "alpha_total_error_deg",
    "alpha_total_sd_deg",
)


class Outputs(Section):
    """Recorded of every flight: named numbers, and histories for the bands."""

    scalars: tuple[str, ...]
    histories: tuple[str, ...] = ()


class Stop(Section):
    """Stop rule: the interval of one output's percentile is narrower than a width, in the output's unit."""

    output: str
    width: Annotated[float, Field(gt=0.0)]
    percentile: Annotated[float, Field(gt=0.0, lt=100.0)] = 97.7
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = CONFIDENCE


class DispersionsFile(Dispersions):
    """The whole of a dispersions file."""

    scenario: str
    flights: Flights = 1000
    seed: Annotated[int, Field(ge=0)] = 0
    mode: Literal["simulation", "whole"] = "simulation"
    chunk: Annotated[int, Field(ge=1, le=4096)] = 64
    window: Window
    outputs: Outputs
    stop: Stop | None = None


@dataclass(frozen=True)
class Study:
    """A study ready to fly.

    Parameters
    ----------
    spec : DispersionsFile
    plan : Plan
        With the outputs that the mode gives.
    source : Path
    design : Design or None
        Saltelli's, where draws are not random.
    """

    spec: DispersionsFile
    plan: Plan
    source: Path
    design: Design | None = None

    @property
    def named(self) -> str:
        """Name of a shipped dispersions file, or the whole path of another."""
        shipped = self.source.parent == DATA / "dispersions"
        return self.source.stem if shipped else str(self.source.resolve())

    def draws_of(self, run: int) -> dict[str, float]:
        """Return the number between 0 and 1 of every factor in one run."""
        if self.design is not None:
            return self.design.draws_of(run)
        return draws(self.plan.dispersions, self.spec.seed, run)

    def runs_of(self, chunk: int, flights: int) -> range:
        """Run numbers of one chunk of a study of so many flights."""
        first = chunk * self.spec.chunk
        return range(first, min(first + self.spec.chunk, flights))

    def chunks(self, flights: int) -> int:
        """Return how many chunks so many flights are."""
        return -(-flights // self.spec.chunk)

    def settings(self) -> dict[str, Any]:
        """All settings that determine the numbers, flat: key to value."""
        scenario = self.plan.scenario
        out = _flat("", self.spec.model_dump(mode="json", exclude={"flights", "stop", "scenario"}))
        out |= _flat("scenario.", scenario.spec.model_dump(mode="json"))
        out |= _flat("vehicle.", _vehicle_facts(scenario.vehicle))
        return out | ({} if self.design is None else _flat("sobol.", self.design.settings()))


def _vehicle_facts(vehicle: Vehicle) -> dict[str, Any]:
    """Properties of a vehicle that determine its flight and its reconstruction."""
    table = vehicle.aero.coefficients.tobytes() + vehicle.aero.mach.tobytes() + vehicle.aero.alpha_rad.tobytes()
    if vehicle.aero.free_molecular is not None:
        table += vehicle.aero.free_molecular.tobytes()
    parts = ("reference", "joint", "aeroshell", "centerbody", "uncertainty", "geometry", "aero_terms")
    facts = {name: getattr(vehicle, name).model_dump(mode="json") for name in parts}
    return facts | {"coefficients_sha256": hashlib.sha256(table).hexdigest()}


def sobol_study(study: Study, by: str, base: int) -> Study:
    """Return a study that flies Saltelli's design instead of random draws, one column a factor or a section."""
    if study.spec.mode == "whole":
        message = f"{study.source}: mode = 'whole': Sobol indices are of mode = 'simulation' alone"
        raise ConfigError(message, code="sobol-mode")
    design = design_for(tuple(study.spec.factors()), by, base, study.spec.seed)
    return replace(study, plan=replace(study.plan, histories=()), design=design)


def _flat(prefix: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix.removesuffix("."): value}
    out: dict[str, Any] = {}
    for key, part in value.items():
        out |= _flat(f"{prefix}{key}.", part)
    return out


def shipped_dispersions() -> list[str]:
    """Names of the dispersions files that ship with the toolkit."""
    return sorted(p.stem for p in (DATA / "dispersions").glob("*.toml"))


def dispersions_path(name: str) -> Path:
    """Find a dispersions file: a path, or the name of one that ships with the toolkit."""
    if name.endswith(".toml"):
        return Path(name)
    shipped = shipped_dispersions()
    if name not in shipped:
        hint = f"{nearest_name(name, shipped)}; shipped: {', '.join(shipped)}; a path ends in .toml"
        raise ConfigError(f"no dispersions file '{name}'{hint}", code="dispersions-unknown")
    return DATA / "dispersions" / f"{name}.toml"


def read_study(name: str) -> Study:
    """Read a dispersions file and its scenario.

    Parameters
    ----------
    name : str
        Path of a TOML file, or the name of one that ships with the toolkit. A scenario given as a path is looked for
        beside the file.

    Raises
    ------
    ConfigError
        With every fault of the file.
    """
    path = dispersions_path(name)
    spec = parse_section(DispersionsFile, read_toml(path), str(path))
    own = path.parent / spec.scenario
    scenario = read_scenario(str(own) if spec.scenario.endswith(".toml") else spec.scenario)
    faults: list[Issue] = []
    known = TRIAL_SCALARS if spec.mode == "whole" else SCALARS
    histories = () if spec.mode == "whole" else tuple(QUANTITIES)
    for key, names, allowed in (
        ("outputs.scalars", spec.outputs.scalars, known),
        ("outputs.histories", spec.outputs.histories, histories),
        ("stop.output", () if spec.stop is None else (spec.stop.output,), spec.outputs.scalars),
    ):
        try:
            check_outputs(names, allowed)
        except ConfigError as fault:
            faults += [Issue(f"{path}: key '{key}': {words}", words.code) for words in fault.faults]
    if spec.mode == "whole":
        faults += [Issue(f"{path}: {words}", words.code) for words in impossible_dispersions(spec)]
    try:
        legs(scenario.spec.time, spec.window, spec.joint_is == "locked")
        if spec.window.step_s is not None and spec.joint_is == "flexible":
            check_resolved(scenario.vehicle, spec.window.step_s)
    except ConfigError as fault:
        faults += [Issue(f"{path}: {words}", words.code) for words in fault.faults]
    if faults:
        raise ConfigError(faults)
    return Study(spec, Plan(scenario, spec, spec.window, spec.outputs.scalars, spec.outputs.histories), path)


LARGEST_BASE = 2**16


@dataclass(frozen=True)
class Design:
    """Saltelli's design as runs: A, then B, then A with each column from B.

    Parameters
    ----------
    factors : tuple of str
    columns : tuple of str
        Name of the column of every factor: its own, or its section's.
    base : int
        Points of A and of B, a power of two.
    seed : int
        Scrambles the sequence.
    """

    factors: tuple[str, ...]
    columns: tuple[str, ...]
    base: int
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        """Columns, each once."""
        return tuple(dict.fromkeys(self.columns))

    @property
    def flights(self) -> int:
        """Runs of the whole design."""
        return self.base * (len(self.names) + 2)

    def settings(self) -> dict[str, Any]:
        """Settings that determine the numbers."""
        return {"base": self.base, "by": "factor" if self.columns == self.factors else "section"}

    @cached_property
    def _points(self) -> FloatArray:
        from scipy.stats import qmc  # half a second to import

        sequence = qmc.Sobol(2 * len(self.factors), scramble=True, rng=np.random.default_rng(self.seed))
        points: FloatArray = sequence.random(self.base)
        return np.clip(points, SMALLEST, 1.0 - 2.0**-53)

    def draws_of(self, run: int) -> dict[str, float]:
        """Return the number between 0 and 1 of every factor in one run."""
        block, row = divmod(run, self.base)
        a, b = np.split(self._points[row], 2)
        if block == 0:
            u = a
        elif block == 1:
            u = b
        else:
            u = np.where(np.array(self.columns) == self.names[block - 2], b, a)
        return dict(zip(self.factors, u.tolist(), strict=True))


def design_for(factors: tuple[str, ...], by: str, base: int, seed: int) -> Design:
    """Make a design over factors, one column a factor or a section.

    Raises
    ------
    ConfigError
        Where the base is no power of two, or fewer than two columns are dispersed.
    """
    if base < 8 or base > LARGEST_BASE or base & (base - 1):
        raise ConfigError(f"--base {base}: a power of two from 8 to {LARGEST_BASE} is wanted", code="sobol-base")
    columns = tuple(f.split(".")[0] if by == "section" else f for f in factors)
    if len(set(columns)) < 2:
        message = f"Sobol indices: at least two dispersed {by}s are wanted; got {', '.join(columns) or 'none'}"
        raise ConfigError(message, code="sobol-columns")
    return Design(factors, columns, base, seed)


RESAMPLES = 999


def indices(design: Design, values: FloatArray) -> tuple[pd.DataFrame, int]:
    """First-order and total indices with 95 % bootstrap intervals.

    Parameters
    ----------
    values : (flights,) float
        Output of every run, NaN where it failed. A point of the design of which one run failed is left out.

    Returns
    -------
    table : columns factor, first, first_low_95, first_high_95, total, total_low_95, total_high_95
    left_out : int
        Points left out of ``base``.

    Raises
    ------
    GateError
        Where fewer than eight points are left, or the output does not vary.
    """
    runs = values.reshape(len(design.names) + 2, design.base)
    whole = np.isfinite(runs).all(axis=0)
    kept = runs[:, whole]
    if kept.shape[1] < 8 or not np.ptp(kept) > 0.0:
        raise GateError(
            f"Sobol indices: {kept.shape[1]} whole points of {design.base} with a spread of "
            f"{np.ptp(kept) if kept.size else 0.0:g}; more flights, or an output that varies, are wanted",
            code="sobol-spread",
        )

    from scipy.stats import bootstrap  # half a second to import

    found = bootstrap(
        (np.arange(kept.shape[1]),), lambda rows: _estimate(kept[:, rows]), vectorized=False,
        n_resamples=RESAMPLES, method="percentile", confidence_level=0.95, rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    table = pd.DataFrame({"factor": design.names})
    for name, value, low, high in zip(("first", "total"), _estimate(kept), found.low, found.high, strict=True):
        table[name], table[f"{name}_low_95"], table[f"{name}_high_95"] = value, low, high
    return table, int(design.base - kept.shape[1])


def _estimate(runs: FloatArray) -> FloatArray:
    """First-order and total indices ``(2, columns)`` of runs A, B and A with columns of B, ``(columns + 2, n)``."""
    runs = runs - runs[:2].mean()
    a, b, mixed = runs[0], runs[1], runs[2:]
    variance = runs[:2].var()
    if not variance > 0.0:
        return np.zeros((2, len(mixed)))
    first, total = np.mean(b * (mixed - a), axis=1), 0.5 * np.mean((a - mixed) ** 2, axis=1)
    return np.stack([first, total]) / variance


def impossible_dispersions(dispersions: Dispersions) -> list[Issue]:
    """Return the keys of a dispersions file that whole trials cannot have."""
    air, found = dispersions.atmosphere, []
    for key in ("density", "wind_north_mps", "wind_east_mps"):
        if getattr(air, key) is not None:
            found.append(f"key 'atmosphere.{key}': whole trials draw the scenario's own day alone; leave it out")
    if not air.day:
        found.append("key 'atmosphere.day' = False: whole trials have a day each; leave it out")
    if dispersions.joint_is == "locked":
        found.append("key 'joint_is' = 'locked': whole trials fly the joint; leave it out")
    return [Issue(words, "whole-mode-dispersion") for words in found]


def run_trials(trial: Callable[[int], Mapping[str, float]], plan: Plan, runs: Sequence[int]) -> list[Row]:
    """Run trials, one after another; one that raises is a row with its reason.

    Parameters
    ----------
    trial : callable
        From run number to a flat mapping that has every one of ``plan.scalars``.
    plan : Plan
    runs : list of int
    """
    rows = []
    for run in runs:
        numbers: Mapping[str, float] = dict.fromkeys(plan.scalars, np.nan)
        reason = NO_FAULT
        try:
            numbers = trial(run)
        except Exception as fault:  # one flight's defect must not cost the others: its row has the reason
            reason = failure_reason(fault)
        kept = {name: numbers[name] for name in plan.scalars}
        rows.append(Row(run, reason, np.nan, kept, np.empty((0, len(plan.window.history_time_s())))))
    return rows


def whole_trial(plan: Plan, seed: int, run: int) -> dict[str, float]:
    """Fly, reconstruct and score one run: all of `TRIAL_SCALARS`, NaN where a method has no answer at the peak."""
    nominal = plan.scenario.vehicle
    case = dispersed_case(plan.scenario, plan.dispersions, draws(plan.dispersions, seed, run))
    flown = replace(case.vehicle, aero=nominal.aero.scaled(*case.scales))
    spec = case.scenario.spec.model_copy(update={"video": None, "videos": {}})
    scenario = replace(case.scenario, spec=spec, vehicle=flown)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        truth = simulate_to_folder(scenario, run_seed(seed, run), folder)
        telemetry = replace(read_flight(folder), vehicle=nominal)
    flight = reconstruct(Flight(telemetry))
    answers = estimate(flight, METHODS)
    peak_s, _ = find_peak(truth.time_s, truth.dynamic_pressure_pa)
    out = dict.fromkeys(TRIAL_SCALARS, np.nan)
    out["truth_deg"] = float(np.rad2deg(np.interp(peak_s, truth.time_s, truth.deflection.theta_rad)))
    for method, history in answers.continuous.items():
        theta, sd = np.rad2deg(history.at(peak_s))
        out |= {f"{method}_deg": float(theta), f"{method}_sd_deg": float(sd)}
        out[f"{method}_error_deg"] = float(theta) - out["truth_deg"]
    at = np.array([peak_s])
    estimated, path = resample(flight.solution.smoothed, at), resample(truth.trajectory, at)
    error = difference(estimated, path)[0]
    out["bet_position_m"], out["bet_velocity_mps"], rotation_rad = (
        float(np.linalg.norm(error[k : k + 3])) for k in (0, 3, 6)
    )
    out["bet_attitude_deg"] = float(np.rad2deg(rotation_rad))
    if estimated.covariance is not None:
        out["bet_nees"] = float(error @ np.linalg.solve(estimated.covariance[0], error))
    alpha = air_data(path, truth.profile, flown.cg_m).alpha_total_wind_rad[0]
    air = flight.air
    estimated_alpha = np.interp(peak_s, air.time_s, air.alpha_total_wind_rad)
    out["alpha_total_error_deg"] = float(np.rad2deg(estimated_alpha - alpha))
    out["alpha_total_sd_deg"] = float(np.rad2deg(np.interp(peak_s, air.time_s, air.alpha_total_wind_sd_rad)))
    return out

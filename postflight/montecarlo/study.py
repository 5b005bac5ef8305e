"""What defines a Monte Carlo study, and which draws does each run have?

A study is a dispersions file with its scenario. Two studies are the same where their settings are: everything but the
number of flights and the stop rule.

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
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from flightmodel.airdata import air_data
from flightmodel.checks import NO_FAULT, ConfigError, Issue, nearest_name
from flightmodel.config import Section, parse_section, read_toml
from flightmodel.events import find_peak
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import difference, resample
from flightmodel.vehicle import DATA, Vehicle
from postflight.deflections import estimate
from postflight.flight import Flight
from postflight.reconstruction import reconstruct
from synthetic_flight.dispersions import Dispersions, Window, dispersed_case, draws, run_seed
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
    """Recorded outputs of every flight: named numbers, and histories for the bands."""

    scalars: tuple[str, ...]
    histories: tuple[str, ...] = ()


class Stop(Section):
    """Stop rule: the interval of one output's percentile is narrower than a width, in the output's unit."""

    output: str
    width: Annotated[float, Field(gt=0.0)]
    percentile: Annotated[float, Field(gt=0.0, lt=100.0)] = 97.7
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = CONFIDENCE


class DispersionsFile(Dispersions):
    """Complete content of a dispersions file."""

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
    """

    spec: DispersionsFile
    plan: Plan
    source: Path

    @property
    def named(self) -> str:
        """Name of a shipped dispersions file, or the whole path of another."""
        shipped = self.source.parent == DATA / "dispersions"
        return self.source.stem if shipped else str(self.source.resolve())

    def draws_of(self, run: int) -> dict[str, float]:
        """Return the number between 0 and 1 of every factor in one run."""
        return draws(self.plan.dispersions, self.spec.seed, run)

    def runs_of(self, chunk: int, flights: int) -> range:
        """Run numbers of one chunk of a study of so many flights."""
        first = chunk * self.spec.chunk
        return range(first, min(first + self.spec.chunk, flights))

    def chunks(self, flights: int) -> int:
        """Return the number of chunks for this number of flights."""
        return -(-flights // self.spec.chunk)

    def settings(self) -> dict[str, Any]:
        """All settings that affect the results, as flat keys and values."""
        scenario = self.plan.scenario
        out = _flat("", self.spec.model_dump(mode="json", exclude={"flights", "stop", "scenario"}))
        out |= _flat("scenario.", scenario.spec.model_dump(mode="json"))
        return out | _flat("vehicle.", _vehicle_facts(scenario.vehicle))


def _vehicle_facts(vehicle: Vehicle) -> dict[str, Any]:
    """Properties of a vehicle that determine its flight and its reconstruction."""
    table = vehicle.aero.coefficients.tobytes() + vehicle.aero.mach.tobytes() + vehicle.aero.alpha_rad.tobytes()
    if vehicle.aero.free_molecular is not None:
        table += vehicle.aero.free_molecular.tobytes()
    parts = ("reference", "joint", "aeroshell", "centerbody", "uncertainty", "geometry", "aero_terms")
    facts = {name: getattr(vehicle, name).model_dump(mode="json") for name in parts}
    return facts | {"coefficients_sha256": hashlib.sha256(table).hexdigest()}


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
        raise ConfigError(f"no dispersions file '{name}'{hint}", code="name-unknown")
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
        theta, sd = np.rad2deg(history.angle_at(peak_s))
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

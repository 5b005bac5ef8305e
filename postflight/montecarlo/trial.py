"""Are reconstruction and estimators as accurate as they state? Whole trials against the truth of a synthetic flight.

A trial is a callable ``trial(run_index) -> flat mapping of named numbers``: fly, sense, reconstruct, estimate, compare.
Flown is the dispersed vehicle, with atmosphere and instruments of the run's own; reconstructed is with the nominal
vehicle and the data sheets' standard deviations. Errors are ``estimate - truth`` at the flight's true peak of dynamic
pressure, NEES is ``e^T P^-1 e`` of the nine components of the trajectory. Without the camera: rendering and reading a
film takes minutes a flight.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flightmodel.airdata import air_data
from flightmodel.checks import NO_FAULT, Fault
from flightmodel.events import find_peak
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import difference, resample
from postflight.deflections import estimate
from postflight.flight import Flight
from postflight.reconstruction import reconstruct
from synthetic_flight.dispersions import Dispersions, dispersed_case, draws, run_seed
from synthetic_flight.ensemble import Plan, Row, failure_reason
from synthetic_flight.folder import simulate_to_folder

METHODS = ("misalignment", "trim", "fused")
SCALARS = (
    "truth_deg",
    *(f"{method}_{what}" for method in METHODS for what in ("deg", "sd_deg", "error_deg")),
    "bet_position_m",
    "bet_velocity_mps",
    "bet_attitude_deg",
    "bet_nees",
    "alpha_total_error_deg",
    "alpha_total_sd_deg",
)


def impossible_dispersions(dispersions: Dispersions) -> list[Fault]:
    """Return the keys of a dispersions file that whole trials cannot have."""
    air, found = dispersions.atmosphere, []
    for key in ("density", "wind_north_mps", "wind_east_mps"):
        if getattr(air, key) is not None:
            found.append(f"key 'atmosphere.{key}': whole trials draw the scenario's own day alone; leave it out")
    if not air.day:
        found.append("key 'atmosphere.day' = False: whole trials have a day each; leave it out")
    if dispersions.joint_is == "locked":
        found.append("key 'joint_is' = 'locked': whole trials fly the joint; leave it out")
    return [Fault(words, "whole-mode-dispersion") for words in found]


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
    """Fly, reconstruct and score one run; every name of `SCALARS`, NaN where a method has no estimate at the peak."""
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
    out = dict.fromkeys(SCALARS, np.nan)
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

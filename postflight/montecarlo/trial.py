"""Whole trials: fly, sense, reconstruct, estimate, and compare with the truth; do the error bars say what they mean?

The analyst is told the nominal vehicle and what its data sheets say; flown is the dispersed one, on a day and with
instruments of the run's own. The camera is left out: rendering and reading a film takes minutes a flight. Everything is
taken at the flight's true peak of dynamic pressure.

What whole trials give (`postflight.montecarlo.trial`) and cannot have; one that fails is a row with its reason.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from flightmodel.airdata import air_data
from flightmodel.events import find_peak
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import difference, resample
from postflight.deflections import estimate
from postflight.flight import Flight
from postflight.reconstruction import reconstruct
from synthetic_flight.dispersions import Dispersions, dispersed_case, draws, run_seed
from synthetic_flight.ensemble import Plan, Row, reason_of
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


def not_possible(dispersions: Dispersions) -> list[str]:
    """Say what of a dispersions file whole trials cannot have."""
    air, words = dispersions.atmosphere, []
    for key in ("density", "wind_north_mps", "wind_east_mps"):
        if getattr(air, key) is not None:
            words.append(f"key 'atmosphere.{key}': whole trials draw the scenario's own day alone; leave it out")
    if not air.day:
        words.append("key 'atmosphere.day' = False: whole trials have a day each; leave it out")
    if dispersions.joint_is == "locked":
        words.append("key 'joint_is' = 'locked': whole trials fly the joint; leave it out")
    return words


def fly_whole(plan: Plan, seed: int, runs: list[int]) -> list[Row]:
    """Trials of runs, one after another; one that cannot be flown or reconstructed is a row with its reason."""

    rows = []
    for run in runs:
        try:
            found, reason = trial(plan, seed, run), ""
        except Exception as fault:  # one flight's defect must not cost the others: its row says what
            found, reason = dict.fromkeys(SCALARS, np.nan), reason_of(fault)
        kept = {name: found[name] for name in plan.scalars}
        rows.append(Row(run, reason, np.nan, kept, np.empty((0, len(plan.window.history_time_s())))))
    return rows


def trial(plan: Plan, seed: int, run: int) -> dict[str, float]:
    """Fly and judge one run; every name of `SCALARS`, NaN for a method that gave no answer at the peak."""
    told = plan.scenario.vehicle
    case = dispersed_case(plan.scenario, plan.dispersions, draws(plan.dispersions, seed, run))
    flown = replace(case.vehicle, aero=told.aero.scaled(*case.scales))
    spec = case.scenario.spec.model_copy(update={"video": None})
    scenario = replace(case.scenario, spec=spec, vehicle=flown)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        truth = simulate_to_folder(scenario, run_seed(seed, run), folder)
        telemetry = replace(read_flight(folder), vehicle=told)
    flight = reconstruct(Flight(telemetry))
    answers = estimate(flight, METHODS)
    peak_s, _ = find_peak(truth.time_s, truth.dynamic_pressure_pa)
    out = dict.fromkeys(SCALARS, np.nan)
    out["truth_deg"] = float(np.rad2deg(np.interp(peak_s, truth.time_s, truth.deflection.theta_rad)))
    for method, history in answers.histories.items():
        theta, sd = np.rad2deg(history.at(peak_s))
        out |= {f"{method}_deg": float(theta), f"{method}_sd_deg": float(sd)}
        out[f"{method}_error_deg"] = float(theta) - out["truth_deg"]
    at = np.array([peak_s])
    found, path = resample(flight.solution.smoothed, at), resample(truth.trajectory, at)
    error = difference(found, path)[0]
    out["bet_position_m"], out["bet_velocity_mps"], turned = (
        float(np.linalg.norm(error[k : k + 3])) for k in (0, 3, 6)
    )
    out["bet_attitude_deg"] = float(np.rad2deg(turned))
    if found.covariance is not None:
        out["bet_nees"] = float(error @ np.linalg.solve(found.covariance[0], error))
    alpha = air_data(path, truth.profile, flown.cg_m).alpha_total_wind_rad[0]
    air = flight.air
    told_alpha = np.interp(peak_s, air.time_s, air.alpha_total_wind_rad)
    out["alpha_total_error_deg"] = float(np.rad2deg(told_alpha - alpha))
    out["alpha_total_sd_deg"] = float(np.rad2deg(np.interp(peak_s, air.time_s, air.alpha_total_wind_sd_rad)))
    return out

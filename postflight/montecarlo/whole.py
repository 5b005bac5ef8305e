"""What whole trials give (`postflight.montecarlo.trial`) and cannot have; one that fails is a row with its reason."""

from __future__ import annotations

import numpy as np

from synthetic_flight.dispersed_ensemble import Plan, Row, reason_of
from synthetic_flight.dispersions import Dispersions

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
    from postflight.montecarlo.trial import trial  # two seconds to import, and simulations need none of it

    rows = []
    for run in runs:
        try:
            found, reason = trial(plan, seed, run), ""
        except Exception as fault:  # one flight's defect must not cost the others: its row says what
            found, reason = dict.fromkeys(SCALARS, np.nan), reason_of(fault)
        kept = {name: found[name] for name in plan.scalars}
        rows.append(Row(run, reason, np.nan, kept, np.empty((0, len(plan.window.history_time_s())))))
    return rows

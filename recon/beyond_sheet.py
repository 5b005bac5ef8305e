"""What if the flight finds an error far beyond its data sheet? Then the sheet is wrong, and is not held on to.

A prior that is too narrow pulls the estimate towards nothing, and with it the trajectory, while both stay as sure as
the sheet claims. So where the verdict on a sheet is red, the flight is reconstructed once more with wide priors of the
errors that made it so. The verdicts, which judge what was stated, stay those of the first time.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray
from flightmodel.telemetry import Finding
from recon.clock_jumps import ClockJump
from recon.consistency import MOST_KEPT_SD, Verdict
from recon.displaced import Displaced
from recon.problem import Problem
from recon.state import KINEMATIC
from recon.triad_clocks import Lag

SHEET = "data sheet "
TIMES = 3.0  # what was found: wide enough not to pull, for what was found was already pulled


@dataclass(frozen=True)
class Learnt:
    """What a reconstruction learnt of the data that others of the same flight, to be compared with it, start from.

    Parameters
    ----------
    wider : dict
        Errors whose stated standard deviations are too small, and what to take instead.
    doubted : tuple of Displaced or None
        Readings that jump away and back and are not believed; None where that is still to be found out.
    jumps : tuple of ClockJump or None
        Of the inertial triads' clocks; None where that is still to be found out.
    lag : Lag or None
        Of the accelerometer behind the gyros, where it is more than their sheets allow.
    denied : dict
        By name of a tracker, times (k,) of its points that all the rest of the flight contradicts.
    """

    wider: dict[str, float] = field(default_factory=dict)
    doubted: tuple[Displaced, ...] | None = None
    jumps: tuple[ClockJump, ...] | None = None
    lag: Lag | None = None
    denied: dict[str, FloatArray] = field(default_factory=dict)


NOTHING = Learnt()


def beyond_sheet(verdicts: tuple[Verdict, ...], table: pd.DataFrame) -> dict[str, float]:
    """Standard deviations to take instead, by name of the error; empty where every sheet holds.

    Parameters
    ----------
    verdicts : tuple of Verdict
    table : DataFrame
        ``name, prior_sd, estimate, sd``.
    """
    out: dict[str, float] = {}
    for verdict in verdicts:
        if verdict.passed or not verdict.name.startswith(SHEET):
            continue
        owner = verdict.name.removeprefix(SHEET)
        learnt_of = (table.treated == "estimated") & (table.sd < MOST_KEPT_SD * table.prior_sd)
        mine = table[table.name.str.startswith(f"{owner} ") & learnt_of]
        learnt = np.sqrt(mine.prior_sd**2 - mine.sd**2)
        far = mine[mine.estimate.abs() > verdict.high * learnt]
        out |= {str(name): TIMES * abs(float(found)) for name, found in zip(far.name, far.estimate, strict=True)}
    return out


def with_wider_priors(problem: Problem, wider: dict[str, float]) -> Problem:
    """Problem whose start knows less of the errors named."""
    covariance = problem.start_covariance.copy()
    for name, sd in wider.items():
        if name not in problem.model.names:
            continue  # of an instrument that takes no part this time
        k = problem.model.names.index(name)
        covariance[KINEMATIC + k, KINEMATIC + k] += max(0.0, sd**2 - float(problem.model.prior_sd[k]) ** 2)
    return replace(problem, start_covariance=covariance)


def sheet_findings(table: pd.DataFrame, wider: dict[str, float], start_s: float, end_s: float) -> list[Finding]:
    """One finding for each error whose sheet was not held on to."""
    rows = table.set_index("name")
    return [
        Finding(
            name.split()[0],
            f"{name} was found to be {rows.estimate[name]:.3g} ± {rows.sd[name]:.2g} {rows.unit[name]}; the stated "
            f"{rows.prior_sd[name]:.2g} {rows.unit[name]} was not held on to",
            start_s,
            end_s,
        )
        for name in wider
        if name in rows.index
    ]

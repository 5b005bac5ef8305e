"""Which joint, offset and stability explain the flight best, and how well does the flight tell them?

Steps (`steps`) on `Problem`, first with all standard deviations many times wider, so that far starts find the valley,
at last with the air as fine as the flight says (`fine_air`). The covariance is that of the linear problem at the
answer, widened by measured factors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from postflight.pipeline import Flight
from postflight.reconciliation.candidate import AirUnknowns, VehicleUnknowns
from postflight.reconciliation.fine_air import fine_air
from postflight.reconciliation.observed import Observed, observe
from postflight.reconciliation.problem import Problem, Residuals, Unknowns
from postflight.reconciliation.steps import step_from

WIDER = (30.0, 10.0, 3.0)
MOST_STEPS = 20  # after the widened ones
# of the cost that a step may still promise: at the end, and before the share of fine air is asked for
SETTLED, NEARLY = 0.05, 2.0
# by how much errors were larger than the linear problem says over ten dispersed flights, seeds 0 to 9; of damping and
# static stability they were not (docs/reconciliation.md)
WIDER_SD = {"stiffness": 1.7, "offset y": 1.2, "offset z": 1.2}
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Reconciled:
    """The joint that explains the flight.

    Parameters
    ----------
    problem : Problem
    unknowns : Unknowns
        Most probable of all.
    linear_covariance : (n, n) float
        Of all unknowns, in their order, of the linear problem at the answer.
    residuals : Residuals
    steps : int
    converged : bool
    """

    problem: Problem
    unknowns: Unknowns
    linear_covariance: FloatArray
    residuals: Residuals
    steps: int
    converged: bool

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all unknowns, in their order: the linear one, widened by `WIDER_SD`."""
        return self.linear_covariance * np.outer(self.wider, self.wider)

    @property
    def wider(self) -> FloatArray:
        """How much wider each unknown's standard deviation is than the linear problem's."""
        out = np.ones(len(self.linear_covariance))
        for name, factor in WIDER_SD.items():
            out[self.problem.unknown.names.index(name)] = factor
        return out

    @property
    def sensor_rms_sd(self) -> float:
        """Rms of the sensors' residuals over their standard deviations."""
        return float(np.sqrt(np.mean(self.residuals.sensors**2)))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the probability of the data by Laplace's method, up to what all models of a flight share."""
        sd = np.sqrt(np.diag(self.linear_covariance))
        _, shape = np.linalg.slogdet(self.linear_covariance / np.outer(sd, sd))
        # freeplay has one sign: its prior is folded
        folded = np.log(2.0) if "freeplay" in self.problem.unknown.laws else 0.0
        return float(folded + self.problem.log_weight + 0.5 * shape + np.log(sd).sum() - 0.5 * self.residuals.cost)

    @property
    def vehicle(self) -> Vehicle:
        """Vehicle with the joint, the offset and the coefficients found."""
        return self.problem.unknown.flown(self.unknowns.vehicle)


def reconcile(
    flight: Flight, laws: tuple[str, ...] = (), loaded: bool = False, progress: Progress | None = None
) -> Reconciled:
    """Fit joint, offset and static stability to a reconstructed flight.

    Parameters
    ----------
    flight : Flight
    laws : tuple of str
        What the spring may have beside its slope, of `candidate.LAWS`; for freeplay see `freeplay.reconcile_loose`.
    loaded : bool
        Only where air loads the joint (`observe`).
    progress : callable, optional

    Raises
    ------
    GateError
        Where sensors or vehicle are missing, or there is no pressure pulse.
    DivergenceError
        Where no candidate flies through.
    """
    problem = problem_of(flight, observe(flight, loaded), laws)
    report = progress or (lambda _fraction, _what: None)

    def first(fraction: float, what: str) -> None:
        report(0.6 * fraction, what)

    def then(fraction: float, what: str) -> None:
        report(0.6 + 0.4 * fraction, what)

    early = [replace(problem, wider=wider) for wider in WIDER]
    return in_fine_air(solve(problem, problem.start(), early, first, enough=NEARLY), then)


def in_fine_air(
    found: Reconciled, report: Progress, mend: Callable[[Problem, Unknowns], Unknowns] | None = None
) -> Reconciled:
    """Fit again with the air as fine as the flight says."""
    report(0.0, "how fine is the air's structure?")
    air = replace(found.problem.air, fine=fine_air(found.problem, found.unknowns))

    def part(fraction: float, what: str) -> None:
        report(0.2 + 0.8 * fraction, f"{what} in that air")

    return solve(replace(found.problem, air=air), found.unknowns, progress=part, mend=mend)


def problem_of(flight: Flight, observed: Observed, laws: tuple[str, ...]) -> Problem:
    """Problem of a flight."""
    air = AirUnknowns(flight.telemetry.sounding, float(observed.altitude_m.min()))
    return Problem(observed, VehicleUnknowns(flight.telemetry.required_vehicle(), laws), air)


def solve(
    problem: Problem,
    start: Unknowns,
    early: Sequence[Problem] = (),
    progress: Progress | None = None,
    mend: Callable[[Problem, Unknowns], Unknowns] | None = None,
    enough: float = SETTLED,
) -> Reconciled:
    """Most probable unknowns from a start.

    Parameters
    ----------
    problem : Problem
    start : Unknowns
    early : sequence of Problem
        Easier ones, one for each of the first steps.
    progress : callable, optional
    mend : callable, optional
        Betters the unknowns of a problem before each step.
    enough : float
        Of the cost, that may be left to gain.
    """
    report = progress or (lambda _fraction, _what: None)
    most, u = len(early) + MOST_STEPS, start
    for number in range(most):
        report(number / most, f"reconciling, step {number + 1}")
        at = early[number] if number < len(early) else problem
        step = step_from(at, mend(at, u) if mend else u)
        u, settled = step.to, number >= len(early) and step.promised < enough
        if settled:
            break
    report(1.0, "reconciled")
    return Reconciled(problem, u, step.normal.covariance, step.residuals, number + 1, settled)

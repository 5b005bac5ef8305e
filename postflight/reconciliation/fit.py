"""Which joint, offset and stability explain the flight best, and how well does the flight tell them?

Gauss-Newton's steps on `Problem`, first with all standard deviations many times wider, so that far starts find the
valley. The valley is long and bent (stiffness, inertias and stability nearly scale together), so every step gets the
second-order correction of geodesic acceleration. The covariance is that of the linear problem at the answer, widened by
a measured factor.

References
----------
M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization", 2012 (geodesic acceleration).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.vehicle import Vehicle
from postflight.pipeline import Flight
from postflight.reconciliation.candidate import AirUnknowns, VehicleUnknowns
from postflight.reconciliation.observed import Observed, observe
from postflight.reconciliation.problem import Problem, Residuals, Unknowns

WIDER = (30.0, 10.0, 3.0)
MOST_STEPS, SETTLED_SD = 9, 0.1  # steps after the widened ones
PARTS = (1.0, 0.5, 0.25)  # of a step
# over thirty dispersed flights (seeds 0 to 29) errors of stiffness were 1.5, of offset 1.2, of stability 1.1 times what
# the linear problem says; the posterior's shape is the linear problem's (docs/reconciliation.md), so this is what the
# model of the noise leaves out
UNMODELLED = 1.4
LOOK_AHEAD = 0.1  # of a step, over which its curvature is taken
FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e3
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
        """Covariance of all unknowns, in their order: the linear one, widened for what the noise model leaves out."""
        return self.linear_covariance * UNMODELLED**2

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
        return float(folded + 0.5 * shape + np.log(sd).sum() - 0.5 * self.residuals.cost)

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
    return solve(problem, problem.start(), [replace(problem, wider=wider) for wider in WIDER], progress)


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
    """
    report = progress or (lambda _fraction, _what: None)
    most, u, converged, step = len(early) + MOST_STEPS, start, False, 0
    while True:
        report(step / most, f"reconciling, step {step + 1}")
        at = early[step] if step < len(early) else problem
        u, moved_sd, residuals, normal = step_from(at, mend(at, u) if mend else u)
        converged = step >= len(early) and moved_sd < SETTLED_SD
        if converged or step + 1 >= most:
            break
        step += 1
    report(1.0, "reconciled")
    return Reconciled(problem, u, normal.covariance, residuals, step + 1, converged)


@dataclass(frozen=True)
class Normal:
    """Normal equations of a step, scaled to a diagonal of one."""

    matrix: FloatArray
    right: FloatArray

    @cached_property
    def scale(self) -> FloatArray:
        """One over the root of the diagonal."""
        return np.asarray(1.0 / np.sqrt(np.diag(self.matrix)))

    def damped(self, damping: float) -> Callable[[FloatArray], FloatArray]:
        """Solver of the equations with a share of the diagonal added."""
        scaled = self.matrix * self.scale[:, None] * self.scale
        scaled[np.diag_indices_from(scaled)] += damping
        factor = cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)
        return lambda right: np.asarray((cho_solve(factor, (right.T * self.scale).T).T * self.scale).T)

    @cached_property
    def solve(self) -> Callable[[FloatArray], FloatArray]:
        """Solver of the equations."""
        return self.damped(0.0)

    def sd(self, count: int) -> FloatArray:
        """Standard deviations of the first unknowns."""
        return np.asarray(np.sqrt(np.diag(self.solve(np.eye(len(self.right), count)))))

    @property
    def covariance(self) -> FloatArray:
        """Of all unknowns."""
        return self.solve(np.eye(len(self.right)))


def step_from(problem: Problem, u: Unknowns) -> tuple[Unknowns, float, Residuals, Normal]:
    """One damped, corrected step: where to, how far in sd of what is sought, residuals there, its equations."""
    linear = problem.linear(u)
    if not np.isfinite(linear.found.cost):
        raise DivergenceError(
            "reconciliation: a span of the flight cannot be flown with the vehicle as told: its joint diverges; give "
            "a stiffer joint in the vehicle file to start from"
        )
    normal = Normal(*problem.normal(u, linear))
    sought = normal.sd(problem.unknown.physical)
    damping = 0.0
    while damping < MOST_DAMPING:
        solved = normal.damped(damping) if damping else normal.solve
        step = solved(normal.right)
        ahead, behind = (problem.residuals(u.moved(side * LOOK_AHEAD * step)) for side in (1.0, -1.0))
        bent = solved(
            linear.back(
                (ahead.sensors - 2.0 * linear.found.sensors + behind.sensors) / LOOK_AHEAD**2,
                (ahead.joins - 2.0 * linear.found.joins + behind.joins) / LOOK_AHEAD**2,
            )
        )
        # a bent path, of which the straight part alone may go too far
        paths = [part * step + 0.5 * part**2 * bent for part in PARTS if np.isfinite(bent).all()] or [step]
        found, moved = min(
            ((problem.residuals(end), end) for end in map(u.moved, paths)), key=lambda pair: pair[0].cost
        )
        if found.cost < linear.found.cost:
            far = np.abs(moved.vehicle - u.vehicle)[: problem.unknown.physical] / sought
            return moved, float(far.max()), found, normal
        damping = max(10.0 * damping, FIRST_DAMPING)
    return u, 0.0, linear.found, normal

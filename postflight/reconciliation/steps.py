"""One step towards the most probable unknowns of a `Problem`.

Gauss-Newton's, with the second-order correction of geodesic acceleration, since the valley is long and bent
(stiffness, inertias and stability nearly scale together); damped where the bend is sharper than that.

References
----------
M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization", 2012 (geodesic acceleration).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flightmodel.checks import DivergenceError, FloatArray
from postflight.reconciliation.problem import Linear, Problem, Residuals, Unknowns

PARTS = (1.0, 0.5, 0.25)  # of a step
LOOK_AHEAD = 0.1  # of a step, over which its curvature is taken
# shares of the diagonal that are added, until a step falls by a fair part of what an undamped one promises
DAMPINGS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3)
FIRST_DAMPING, MOST_DAMPING, FAIR = 1e-2, 1e3, 0.5


@dataclass(frozen=True)
class Normal:
    """Normal equations of a step, scaled to a diagonal of one."""

    matrix: FloatArray
    right: FloatArray

    @cached_property
    def scale(self) -> FloatArray:
        """One over the root of the diagonal."""
        return np.asarray(1.0 / np.sqrt(np.diag(self.matrix)))

    def factor(self, damping: float) -> FloatArray:
        """Lower Cholesky factor of the scaled matrix with a share of the diagonal added."""
        scaled = self.matrix * self.scale[:, None] * self.scale
        scaled[np.diag_indices_from(scaled)] += damping
        return np.asarray(cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)[0])

    @cached_property
    def undamped(self) -> FloatArray:
        """Factor of the matrix as it is."""
        return self.factor(0.0)

    def solver(self, damping: float) -> Callable[[FloatArray], FloatArray]:
        """Solver of the equations with a share of the diagonal added."""
        factor, scale = self.factor(damping) if damping else self.undamped, self.scale
        return lambda right: np.asarray((cho_solve((factor, True), (right.T * scale).T).T * scale).T)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the equations."""
        return self.solver(0.0)(right)

    @property
    def covariance(self) -> FloatArray:
        """Of all unknowns."""
        return self.solve(np.eye(len(self.right)))

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant."""
        return float(2.0 * (np.log(np.diag(self.undamped)).sum() - np.log(self.scale).sum()))


@dataclass(frozen=True)
class Step:
    """Where a step leads, by how much the cost may still fall by the linear problem, residuals there, its equations."""

    to: Unknowns
    promised: float
    residuals: Residuals
    normal: Normal


def step_from(problem: Problem, u: Unknowns) -> Step:
    """Take the best of some damped, corrected steps.

    Raises
    ------
    DivergenceError
        Where the candidate cannot be flown.
    """
    linear = problem.linear(u)
    if not np.isfinite(linear.found.cost):
        raise DivergenceError(
            "reconciliation: a span of the flight cannot be flown with the vehicle as told: its joint diverges; give "
            "a stiffer joint in the vehicle file to start from"
        )
    normal = Normal(*problem.normal(u, linear))
    promised = float(normal.solve(normal.right) @ normal.right)
    best = linear.found, u
    for damping in DAMPINGS:
        best = _better(problem, u, linear, normal, damping, best)
        if linear.found.cost - best[0].cost > FAIR * promised:
            break
    damping = FIRST_DAMPING
    while best[0].cost >= linear.found.cost and damping < MOST_DAMPING:
        best = _better(problem, u, linear, normal, damping, best)
        damping *= 10.0
    return Step(best[1], promised, best[0], normal)


def _better(
    problem: Problem,
    u: Unknowns,
    linear: Linear,
    normal: Normal,
    damping: float,
    best: tuple[Residuals, Unknowns],
) -> tuple[Residuals, Unknowns]:
    """Return the lowest of the best so far and parts of one corrected step."""
    solved = normal.solver(damping)
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
    return min([best, *((problem.residuals(end), end) for end in map(u.moved, paths))], key=lambda pair: pair[0].cost)

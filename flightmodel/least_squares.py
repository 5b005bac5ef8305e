"""Which values explain measurements best that are not linear in them? Gauss-Newton with Marquardt's damping.

Of unknowns ``x``, residuals ``r = measured - predicted(x)`` with derivatives ``J`` of the prediction and weights ``w``
(one over variance), and a priori information ``M`` about ``m``, the cost is lowest::

    C(x) = sum w rho(r) + (x - m)^T M (x - m),           rho(r) = r^2 where no robust factor is given
    (N + damping diag N) step = J^T W r - M (x - m),     N = J^T W J + M

- *Robust*: Huber's ``rho`` is quadratic up to a limit and straight beyond it. ``W`` then holds ``w h`` with the factor
  ``h = min(1, limit / |r|)`` of the point (iteratively reweighted least squares), for which ``rho = h (2 - h) r^2``.
- *Damping*: none at first. A step is taken if it lowers the cost. If it lowers it by less than a quarter of what the
  linear problem promises, the next one has `FIRST_DAMPING`, then ten times as much, and so on; if by more than three
  quarters, a tenth, and below the first none.
- *Stop*: a step that is shorter than ``settled_sd`` in its own standard deviations, of all unknowns together,
  ``step^T (J^T W r - M (x - m)) < settled_sd^2``. Undamped, no unknown and no combination of them then moves by more of
  its sd. A damped one counts if the undamped one and all between do not lower the cost: that is lowest in a kink of the
  model, as tables have them, whatever its slopes promise. The last step is taken, and the problem stays as it was
  linearised before it.
- *Covariance*: ``N^-1`` at the end.

``N`` is an `Arrow`: of many unknowns that follow each other in time its band is sparse, of a few it is the corner.

References
----------
D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11 (1963) 431.
P. J. Huber, "Robust Statistics", 1981, chapter 7. B. D. Tapley, B. E. Schutz, G. H. Born, "Statistical Orbit
Determination", 2004, chapter 4 (a priori information).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flightmodel.arrow import Arrow, ArrowFactor
from flightmodel.checks import FloatArray

FIRST_DAMPING = 1e-3  # of the diagonal: less hardly turns a step, a thousand times more makes it short


@dataclass(frozen=True)
class Linearised:
    """Least-squares problem of ``n`` unknowns, linear about a point.

    Parameters
    ----------
    matrix : Arrow
        ``N`` of the module's equations, (n, n).
    right : (n,) float
        Right-hand side of a step from the point.
    cost : float
        At the point; infinite where anything is not finite.
    residual : (m,) float
        Measured minus predicted, unweighted.
    """

    matrix: Arrow
    right: FloatArray
    cost: float
    residual: FloatArray

    @classmethod
    def of(
        cls,
        residual: FloatArray,
        jacobian: FloatArray,
        weight: FloatArray | float = 1.0,
        information: FloatArray | float = 0.0,
        off_prior: FloatArray | float = 0.0,
        robust: FloatArray | float = 1.0,
    ) -> Linearised:
        """Problem of dense derivatives.

        Parameters
        ----------
        residual : (m,) float
            Measured minus predicted.
        jacobian : (m, n) float
            Of the prediction.
        weight : (m,) float or float
            One over the variances.
        information : (n, n) float, optional
            Inverse of the a priori covariance.
        off_prior : (n,) float, optional
            The point, less the a priori mean.
        robust : (m,) float, optional
            Huber's factors; see `huber_factor`.
        """
        weighted, pull = jacobian.T * (weight * robust), np.dot(information, off_prior)
        cost = float(np.sum(weight * robust * (2.0 - robust) * residual**2) + np.sum(off_prior * pull))
        corner = np.asarray(weighted @ jacobian + information)
        matrix = Arrow(np.zeros((1, 0)), np.zeros((0, len(corner))), corner)
        return cls(matrix, weighted @ residual - pull, cost if np.isfinite(cost + corner.sum()) else np.inf, residual)

    @cached_property
    def factor(self) -> ArrowFactor:
        """Cholesky factor; `numpy.linalg.LinAlgError` where the measurements do not determine all unknowns."""
        return self.matrix.factor()

    @property
    def is_determined(self) -> bool:
        """Whether there is a factor."""
        with suppress(np.linalg.LinAlgError):
            return bool(self.factor)
        return False

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the unknowns; of those in the border where the matrix has a band."""
        return self.factor.border_covariance

    def step(self, damping: float = 0.0) -> FloatArray:
        """Step (n,) to the lowest cost of the linear problem, with a share of the diagonal added."""
        if not damping:
            return self.factor.solve(self.right)
        scale = 1.0 / np.sqrt(np.maximum(self.matrix.diagonal, np.finfo(float).tiny))
        return scale * self.matrix.scaled(scale, np.full(len(scale), damping)).factor().solve(scale * self.right)


@dataclass(frozen=True)
class Estimate:
    """Most probable values.

    Parameters
    ----------
    value : (n,) float
    linear : Linearised
        The problem at the solution.
    converged : bool
        Whether the last step was as short as was asked for, and all unknowns are determined.
    steps : int
        Steps that were tried.
    """

    value: FloatArray
    linear: Linearised
    converged: bool
    steps: int

    @property
    def covariance(self) -> FloatArray:
        """Covariance (n, n); see `Linearised.covariance`."""
        return self.linear.covariance

    @property
    def condition(self) -> float:
        """Condition number of the normal equations: from 1e12 on some combination is lost in rounding."""
        return float(np.linalg.cond(self.linear.matrix.dense))


def least_squares(
    linearised: Callable[[FloatArray], Linearised], start: FloatArray, settled_sd: float, most_steps: int = 100
) -> Estimate:
    """Values of the lowest cost, from a start near enough.

    Parameters
    ----------
    linearised : callable
        The problem, linear about a point (n,).
    start : (n,) float
    settled_sd : float
        See the module's stop.
    most_steps : int
        Tried, damped ones included.
    """
    value, here, damping, least, steps = start, linearised(start), 0.0, np.inf, 0
    while steps < most_steps and np.isfinite(here.cost):
        floor = 0.0 if here.is_determined else FIRST_DAMPING
        damping = max(damping, floor)
        least = min(least, damping)  # that was tried from this point
        step, steps = here.step(damping), steps + 1
        promised = float(here.right @ step)
        if promised < settled_sd**2:
            if least == floor:
                return Estimate(value + step, here, here.is_determined, steps)
            damping = 0.0
            continue
        there = linearised(value + step)
        share = (here.cost - there.cost) / promised
        if share >= 0.0:
            value, here, least = value + step, there, np.inf
        if share < 0.25:
            damping = max(10.0 * damping, FIRST_DAMPING)
        elif share > 0.75:
            damping = 0.1 * damping if damping > FIRST_DAMPING else 0.0
    return Estimate(value, here, False, steps)


def huber_factor(residual_sd: FloatArray, limit_sd: float) -> FloatArray:
    """Huber's factor on the weight of each residual, both in standard deviations."""
    return 1.0 / np.maximum(1.0, np.abs(residual_sd) / limit_sd)

"""How is one step of a multi-span fit solved, and what is its covariance?

The parameters of vehicle and instruments are shared by all spans; the motion at a span's start and the air that the
span falls through have elements in common with theirs and with those of the next spans alone. So the matrix of the
normal equations is an arrow (`flightmodel.arrow`), with the spans as its band and what they share as its border.

An error of the sounding that is the same at all altitudes would couple all air with all air, as the product ``-u u^T``
in the inverse covariance. It is one row and column more of the border: the equations of ``A - u u^T`` are those of
``[[A, u], [u^T, 1]]`` with zero on its right, and both determinants are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flightmodel._kernels import kernel
from flightmodel.arrow import Arrow, ArrowFactor
from flightmodel.checks import FloatArray
from postflight.reconciliation.forward_model import Index


@kernel
def add_part(band, across, corner, place, part):
    """Add a symmetric part (k, k) at rows and columns ``place`` (k,) of a `flightmodel.arrow.Arrow`'s three pieces."""
    n = len(across)
    for i, row in enumerate(place):
        for j, column in enumerate(place):
            if column >= n:
                if row >= n:
                    corner[row - n, column - n] += part[i, j]
                else:
                    across[row, column - n] += part[i, j]
            elif column <= row < n:
                band[row - column, column] += part[i, j]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a step, solved with the diagonal scaled to one.

    Parameters
    ----------
    matrix : Arrow
        Of ``m >= n`` rows: those of no parameter are in its border, and each has one on the diagonal.
    right : (n,) float
        Right-hand side, in the order of the parameters.
    place : (n,) int
        The parameters' rows.
    """

    matrix: Arrow
    right: FloatArray
    place: Index

    @cached_property
    def _constant(self) -> tuple[Index, FloatArray]:
        """Rows that belong to no parameter, and their columns."""
        rows = np.setdiff1d(np.arange(len(self.matrix.diagonal)), self.place)
        return rows, self.matrix.columns(rows - len(self.matrix.across))

    @cached_property
    def scale(self) -> FloatArray:
        """Inverse square root of the diagonal (m,); one for rows that belong to no parameter."""
        rows, columns = self._constant
        diagonal = self.matrix.diagonal - (columns**2).sum(axis=1)
        diagonal[rows] = 1.0
        return np.asarray(1.0 / np.sqrt(diagonal))

    @cached_property
    def undamped(self) -> ArrowFactor:
        """Factor of the scaled matrix as it is."""
        return self._factor(0.0)

    def _factor(self, damping: float) -> ArrowFactor:
        more = np.zeros(len(self.scale))
        more[self.place] = damping
        return self.matrix.scaled(self.scale, more).factor()

    def solver(self, damping: float) -> Callable[[FloatArray], FloatArray]:
        """Solver of the equations with a share of the diagonal added."""
        factor = self._factor(damping) if damping else self.undamped
        scale = self.scale[self.place]

        def solve(right: FloatArray) -> FloatArray:
            whole = np.zeros((len(self.scale), *right.shape[1:]))
            whole[self.place] = (right.T * scale).T
            return np.asarray((factor.solve(whole)[self.place].T * scale).T)

        return solve

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the equations."""
        return self.solver(0.0)(right)

    def covariance_of(self, columns: Index) -> FloatArray:
        """Covariance (k, k) of parameters by their columns (k,)."""
        units = np.zeros((len(self.right), len(columns)))
        units[columns, np.arange(len(columns))] = 1.0
        return self.solve(units)[columns]

    def without(self, p: int) -> tuple[FloatArray, NormalEquations]:
        """Columns (n - p, p) by which the first p parameters, all shared, act on the others, and the others' equations.

        The first p rows of the border are theirs.
        """
        matrix, place = self.matrix, self.place[p:]
        others = Arrow(matrix.band, matrix.across[:, p:], matrix.corner[p:, p:])
        moved = np.where(place < len(matrix.across), place, place - p)
        return matrix.columns(np.arange(p))[place], NormalEquations(others, self.right[p:], moved)

    @property
    def dense(self) -> FloatArray:
        """Matrix (n, n) in the order of the parameters."""
        constant = self._constant[1][self.place]
        return np.asarray(self.matrix.dense[np.ix_(self.place, self.place)] - constant @ constant.T)

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant."""
        return float(self.undamped.log_det - 2.0 * np.log(self.scale).sum())

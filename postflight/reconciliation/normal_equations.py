"""How is a step of a fit of many spans solved, and what is its covariance?

The parameters of vehicle and instruments are shared by all spans; the motion at a span's start and the air that the
span falls through have elements in common with theirs and with those of the next spans alone. So the matrix of the
normal equations is an arrow: a band, with full rows and columns beside it. Its Cholesky factorisation with the band
first fills in nothing.

An error of the sounding that is the same at all altitudes would couple all air with all air, as the product ``-u u^T``
in the inverse covariance. It is a border, a row and column beside the parameters' own: the equations of ``A - u u^T``
are those of ``[[A, u], [u^T, 1]]`` with zero on the border's right, and both determinants are equal.

References
----------
G. H. Golub, C. F. Van Loan, "Matrix Computations", 4th ed., 4.3 (band and arrow systems).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from flightmodel._kernels import kernel
from flightmodel.checks import FloatArray
from postflight.reconciliation.forward_model import Index


@kernel
def add_part(corner, across, band, place, part):
    """Add a symmetric part (k, k) at rows and columns ``place`` (k,) of an arrow matrix in its three pieces."""
    shared = len(corner)
    for i in range(len(place)):
        row = place[i]
        for j in range(len(place)):
            column = place[j]
            if row < shared:
                if column < shared:
                    corner[row, column] += part[i, j]
            elif column < shared:
                across[row - shared, column] += part[i, j]
            elif row >= column:
                band[row - column, column - shared] += part[i, j]


@dataclass(frozen=True)
class ArrowMatrix:
    """Symmetric matrix that is a band but for its first rows and columns: ``[[corner, across^T], [across, band]]``.

    What belongs to a span has elements in common with that of the next spans alone, and with what all spans share.

    Parameters
    ----------
    corner : (shared, shared) float
    across : (n, shared) float
    band : (reach + 1, n) float
        Diagonal and what lies below it, as LAPACK stores lower bands.
    """

    corner: FloatArray
    across: FloatArray
    band: FloatArray

    @classmethod
    def zeros(cls, shared: int, n: int, reach: int) -> ArrowMatrix:
        """Return one of zeros."""
        return cls(np.zeros((shared, shared)), np.zeros((n, shared)), np.zeros((min(reach, max(n - 1, 0)) + 1, n)))

    def add(self, columns: Index, part: FloatArray) -> None:
        """Add a full symmetric part (k, k) at columns (k,), each at most once."""
        add_part(self.corner, self.across, self.band, columns, part)

    def add_pairs(self, row: Index, column: Index, values: FloatArray) -> None:
        """Add elements (k,) of the band and what they mirror, each pair of a row and a column (k,) at most once."""
        first, second = np.minimum(row, column), np.maximum(row, column)
        self.band[second - first, first - len(self.corner)] += values

    @property
    def diagonal(self) -> FloatArray:
        """Diagonal (shared + n,)."""
        return np.concatenate([np.diag(self.corner), self.band[0]])

    @property
    def dense(self) -> FloatArray:
        """The same as a full matrix."""
        shared, n = len(self.corner), len(self.across)
        out = np.zeros((shared + n, shared + n))
        out[:shared, :shared], out[shared:, :shared], out[:shared, shared:] = self.corner, self.across, self.across.T
        for k, values in enumerate(self.band):
            at = shared + np.arange(n - k)
            out[at + k, at] = out[at, at + k] = values[: n - k]
        return out

    def columns(self, at: Index) -> FloatArray:
        """Columns (shared + n, k) of what is shared, by their numbers (k,)."""
        return np.concatenate([self.corner[:, at], self.across[:, at]])

    def scaled(self, by: FloatArray, more: FloatArray) -> ArrowMatrix:
        """Rows and columns times ``by`` (shared + n,), with ``more`` (shared + n,) added to the diagonal then."""
        shared, n = len(self.corner), len(self.across)
        first, rest = by[:shared], by[shared:]
        band = self.band * rest
        for k in range(len(band)):
            band[k, : n - k] *= rest[k:]
        band[0] += more[shared:]
        corner = self.corner * first[:, None] * first + np.diag(more[:shared])
        return ArrowMatrix(corner, self.across * rest[:, None] * first, band)

    def without(self, p: int) -> ArrowMatrix:
        """Return what is left without the first p rows and columns, at most all that are shared."""
        return ArrowMatrix(self.corner[p:, p:], self.across[:, p:], self.band)

    def factor(self) -> ArrowFactor:
        """Cholesky factor, with the band's part first; `numpy.linalg.LinAlgError` where it is not positive definite."""
        band = self.band
        if band.size:
            band = cholesky_banded(band, lower=True, check_finite=False)
        across = _band_solved(band, self.across, transposed=False)
        return ArrowFactor(cholesky(self.corner - across.T @ across, lower=True, check_finite=False), across, band)


@dataclass(frozen=True)
class ArrowFactor:
    """Factor of an `ArrowMatrix` whose band comes first, ``[[L, 0], [V^T, C]]``: C corner, V across, L band."""

    corner: FloatArray
    across: FloatArray
    band: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the system of a right-hand side ``(shared + n,)`` or ``(shared + n, m)``."""
        shared = len(self.corner)
        half = _band_solved(self.band, right[shared:], transposed=False)
        first = cho_solve((self.corner, True), right[:shared] - self.across.T @ half, check_finite=False)
        return np.concatenate([first, _band_solved(self.band, half - self.across @ first, transposed=True)])

    @property
    def log_det(self) -> float:
        """Logarithm of the matrix's determinant."""
        return float(2.0 * (np.log(self.band[0]).sum() + np.log(np.diag(self.corner)).sum()))


def _band_solved(band: FloatArray, right: FloatArray, transposed: bool) -> FloatArray:
    """``L^-1 right``, or ``L^-T right``, of a lower triangle in band storage."""
    if not right.size:
        return np.zeros(right.shape)
    return np.asarray(dtbtrs(band, right, uplo="L", trans="T" if transposed else "N")[0]).reshape(right.shape)


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a step, solved with a diagonal of one.

    Parameters
    ----------
    matrix : ArrowMatrix
        Of ``m >= n`` rows: those of no parameter are borders, of which each has one on the diagonal.
    right : (n,) float
        Right-hand side, in the order of the parameters.
    place : (n,) int
        The parameters' rows.
    """

    matrix: ArrowMatrix
    right: FloatArray
    place: Index

    @cached_property
    def _borders(self) -> Index:
        return np.setdiff1d(np.arange(len(self.matrix.diagonal)), self.place)

    @cached_property
    def scale(self) -> FloatArray:
        """One over the root of the diagonal (m,); of borders one."""
        diagonal = self.matrix.diagonal - (self.matrix.columns(self._borders) ** 2).sum(axis=1)
        diagonal[self._borders] = 1.0
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

        The first p rows are theirs.
        """
        others = NormalEquations(self.matrix.without(p), self.right[p:], self.place[p:] - p)
        return self.matrix.columns(np.arange(p))[self.place[p:]], others

    @property
    def dense(self) -> FloatArray:
        """Matrix (n, n) in the order of the parameters."""
        whole, borders = self.matrix.dense, self.matrix.columns(self._borders)[self.place]
        return np.asarray(whole[np.ix_(self.place, self.place)] - borders @ borders.T)

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant."""
        return float(self.undamped.log_det - 2.0 * np.log(self.scale).sum())

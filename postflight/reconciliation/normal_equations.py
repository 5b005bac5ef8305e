"""How is a step of a fit of many spans solved, and what is its covariance?

The parameters of vehicle, instruments and air are shared by all spans; the motion at a span's start has elements in
common with theirs and with the next span's alone. So the matrix of the normal equations is an arrow: a band, with full
rows and columns beside it. Its Cholesky factorisation with the band first fills in nothing: 140 motions cost as much as
one full matrix of the shared parameters.

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

from flightmodel.checks import FloatArray
from postflight.reconciliation.forward_model import Index


@dataclass(frozen=True)
class ArrowMatrix:
    """Symmetric matrix that is a band but for its first rows and columns: ``[[corner, across^T], [across, band]]``.

    A motion at a span's start has elements in common with the next span's alone, and with what all spans share.

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
        shared = len(self.corner)
        first, rest = np.flatnonzero(columns < shared), np.flatnonzero(columns >= shared)
        at, along = columns[first], columns[rest] - shared
        self.corner[np.ix_(at, at)] += part[np.ix_(first, first)]
        self.across[np.ix_(along, at)] += part[np.ix_(rest, first)]
        row, column = np.nonzero(along[:, None] >= along)
        self.band[along[row] - along[column], along[column]] += part[rest[row], rest[column]]

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

    def scaled(self, by: FloatArray, more: float) -> ArrowMatrix:
        """Rows and columns times ``by`` (shared + n,), with ``more`` added to the diagonal then."""
        shared, n = len(self.corner), len(self.across)
        first, rest = by[:shared], by[shared:]
        band = self.band * rest
        for k in range(len(band)):
            band[k, : n - k] *= rest[k:]
        band[0] += more
        corner = self.corner * first[:, None] * first + more * np.eye(shared)
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
    """Normal equations of a step, matrix (n, n) and right-hand side (n,); solved with a diagonal of one."""

    matrix: ArrowMatrix
    right: FloatArray

    @cached_property
    def scale(self) -> FloatArray:
        """One over the root of the diagonal."""
        return np.asarray(1.0 / np.sqrt(self.matrix.diagonal))

    @cached_property
    def undamped(self) -> ArrowFactor:
        """Factor of the scaled matrix as it is."""
        return self.matrix.scaled(self.scale, 0.0).factor()

    def solver(self, damping: float) -> Callable[[FloatArray], FloatArray]:
        """Solver of the equations with a share of the diagonal added."""
        scale = self.scale
        factor = self.matrix.scaled(scale, damping).factor() if damping else self.undamped
        return lambda right: np.asarray((factor.solve((right.T * scale).T).T * scale).T)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the equations."""
        return self.solver(0.0)(right)

    def covariance_of(self, columns: Index) -> FloatArray:
        """Covariance (k, k) of parameters by their columns (k,)."""
        units = np.zeros((len(self.right), len(columns)))
        units[columns, np.arange(len(columns))] = 1.0
        return self.solve(units)[columns]

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant."""
        return float(self.undamped.log_det - 2.0 * np.log(self.scale).sum())

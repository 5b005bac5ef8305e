"""How are least squares solved whose unknowns follow each other in time, beside some that act at all times?

Unknowns of one time have elements in common with those of the next times alone: a band. Constant errors, which act at
all times, are a border beside it, so that the matrix of the normal equations is an arrow::

    A = [B    R]  =  [L    0] [L^T  V]     B = L L^T,   V = L^-1 R,   D D^T = C - V^T V
        [R^T  C]     [V^T  D] [0  D^T]

With the band first its Cholesky factor fills in nothing; the border costs a Schur complement. What follows from it:

    log det A = 2 sum log diag L + 2 sum log diag D
    covariance of the border's unknowns        (D D^T)^-1
    of the band's, the border's known          B^-1
    change of the band's per unit of these     G = -B^-1 R,   so that in all   B^-1 + G (D D^T)^-1 G^T

Of ``B^-1`` only what lies near the diagonal is ever asked for, the covariance of neighbours. In blocks so large that
only neighbours are coupled, with ``L`` of the diagonal blocks ``L_k`` and below them ``M_k``, it follows from the last
block to the first (Takahashi), for ``W_k = M_k L_k^-1``::

    (B^-1)_kk = L_k^-T L_k^-1 + W_k^T (B^-1)_(k+1,k+1) W_k,     (B^-1)_(k+1,k) = -(B^-1)_(k+1,k+1) W_k

References
----------
G. H. Golub, C. F. Van Loan, "Matrix Computations", 4th ed., 4.3 (band and arrow systems). K. Takahashi, J. Fagan,
M. Chin, PICA 1973 (blocks of the inverse from the factor).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, cholesky_banded
from scipy.linalg.lapack import dpotri, dtbtrs
from scipy.sparse import bsr_array, coo_array, csr_array, dia_array

from flightmodel.checks import FloatArray, IntArray


@dataclass(frozen=True)
class Arrow:
    """Symmetric matrix ``[[band, across], [across^T, corner]]``, positive definite where it is factored.

    Parameters
    ----------
    band : (reach + 1, n) float
        Diagonal and what lies below it, as LAPACK stores lower bands: element ``(j + k, j)`` at ``[k, j]``.
    across : (n, m) float
    corner : (m, m) float
    """

    band: FloatArray
    across: FloatArray
    corner: FloatArray

    def columns(self, at: IntArray) -> FloatArray:
        """Columns (n + m, k) of the border, by their numbers in it (k,)."""
        return np.concatenate([self.across[:, at], self.corner[:, at]])

    @property
    def diagonal(self) -> FloatArray:
        """Diagonal (n + m,)."""
        return np.concatenate([self.band[0], np.diag(self.corner)])

    @property
    def dense(self) -> FloatArray:
        """The matrix in dense form."""
        below = dia_array((self.band, -np.arange(len(self.band))), shape=(len(self.across),) * 2).toarray()
        return np.block([[below + np.tril(below, -1).T, self.across], [self.across.T, self.corner]])

    def scaled(self, by: FloatArray, more: FloatArray) -> Arrow:
        """Rows and columns times ``by`` (n + m,), with ``more`` (n + m,) added to the diagonal then."""
        first, rest = np.split(by, [len(self.across)])
        band = self.band * first
        for k in range(1, len(band)):
            band[k, :-k] *= first[k:]
        band[0] = band[0] * first + more[: len(first)]
        return Arrow(
            band, self.across * first[:, None] * rest, self.corner * rest[:, None] * rest + np.diag(more[len(first) :])
        )

    def factor(self) -> ArrowFactor:
        """Cholesky factor; `numpy.linalg.LinAlgError` where the matrix is not positive definite."""
        band = cholesky_banded(self.band, lower=True, check_finite=False) if self.band.size else self.band
        across = _band_solved(band, self.across)
        return ArrowFactor(band, across, cholesky(self.corner - across.T @ across, lower=True, check_finite=False))


@dataclass(frozen=True)
class ArrowFactor:
    """Factor of an `Arrow`: ``L`` (reach + 1, n) as a band, ``V`` (n, m) and ``D`` (m, m) of the module's equations."""

    band: FloatArray
    across: FloatArray
    corner: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the system of a right-hand side ``(n + m,)`` or ``(n + m, k)``."""
        n = len(self.across)
        half = _band_solved(self.band, right[:n])
        rest = cho_solve((self.corner, True), right[n:] - self.across.T @ half, check_finite=False)
        return np.concatenate([_band_solved(self.band, half - self.across @ rest, transposed=True), rest])

    @property
    def log_det(self) -> float:
        """Logarithm of the matrix's determinant."""
        return float(2.0 * (np.log(self.band[0]).sum() + np.log(np.diag(self.corner)).sum()))

    @cached_property
    def gain(self) -> FloatArray:
        """Change (n, m) of the band's unknowns per unit of the border's."""
        return -_band_solved(self.band, self.across, transposed=True)

    @cached_property
    def border_covariance(self) -> FloatArray:
        """Covariance (m, m) of the border's unknowns, the band's being anything."""
        lower = np.tril(dpotri(self.corner, lower=1)[0]) if self.corner.size else self.corner
        return np.asarray(lower + np.tril(lower, -1).T)

    def inverse_blocks(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Covariance of the band's unknowns, the border's known, in blocks (k, b, b) and below them (k - 1, b, b).

        In blocks of ``size`` the matrix has none but on the diagonal and beside it. The last block may be longer than
        what is left of the unknowns; in what is too much of it stands one on the diagonal.
        """
        n, count = len(self.across), -(-len(self.across) // size)
        band, (row, column) = np.zeros((2 * size, count * size)), _of_block_column(size)
        band[: len(self.band), :n], band[0, n:] = self.band, 1.0
        blocks = np.zeros((count, 2 * size, size))
        blocks[:, row, column] = band.reshape(2 * size, count, size)[row - column, :, column].T
        inverse = np.linalg.inv(blocks[:, :size])
        own, gain = inverse.transpose(0, 2, 1) @ inverse, blocks[:-1, size:] @ inverse[:-1]
        for k in range(count - 2, -1, -1):
            own[k] += gain[k].T @ own[k + 1] @ gain[k]
        return own, -own[1:] @ gain

    def inverse_near_diagonal(self) -> csr_array:
        """Covariance (n, n) of the band's unknowns given the border's: elements in the band, and some next to it."""
        own, below = self.inverse_blocks(max(len(self.band) - 1, 1))
        at, shape = np.arange(len(own) + 1), (len(own) * own.shape[1],) * 2
        lower = bsr_array((below, at[:-2], np.append(0, at[:-1])), shape=shape)
        whole = csr_array(bsr_array((own, at[:-1], at), shape=shape) + lower + lower.T)
        return whole[: len(self.across), : len(self.across)]


def lower_band(matrix: csr_array) -> FloatArray:
    """Symmetric sparse matrix (n, n) as an `Arrow`'s band."""
    entries = coo_array(matrix)
    below = entries.row - entries.col
    out, keep = np.zeros((int(np.max(below, initial=0)) + 1, matrix.shape[0])), below >= 0
    out[below[keep], entries.col[keep]] = entries.data[keep]
    return out


def _of_block_column(size: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the lower triangle's elements in a column of two blocks, one below the other."""
    row, column = np.nonzero(np.tri(2 * size, size))
    return row, column


def _band_solved(band: FloatArray, right: FloatArray, transposed: bool = False) -> FloatArray:
    """``L^-1 right``, or ``L^-T right``, of a lower triangle in band storage."""
    if not right.size:
        return np.zeros(right.shape)
    return np.asarray(dtbtrs(band, right, uplo="L", trans="T" if transposed else "N")[0]).reshape(right.shape)

"""How are the deflection's spline and the inputs found together? Normal equations that stay a band.

The deflection's lateral vector is a cubic spline with even knots, of which four basis functions differ from
zero at a time: rows of the least-squares problem are sparse in its coefficients, and their normal matrix ``N`` is a
band, whatever the length of the flight. Only the inputs' unit normals ``x`` are dense. With ``C`` the block across and
``Q`` the process's precision, the inputs' precision and mean are those of the Schur complement

    S = I + X - C' (N + Q)^-1 C,   x = S^-1 (b_x - C' (N + Q)^-1 b),

and the deflection's covariance is ``(N + Q)^-1 + G S^-1 G'`` with ``G = -(N + Q)^-1 C``, its change per unit normal of
each input.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular, solveh_banded
from scipy.linalg.lapack import dpotri
from scipy.sparse import coo_array, csr_array, dia_array, eye_array, kron

from estimators.evidence import Deflection
from flightmodel.checks import DivergenceError, FloatArray

# longest spacing of knots: a quarter of a joint's period of 0.4 s; knots at half of a period cannot follow it
KNOT_S = 0.1
# a priori of the process's size, median and sd of its logarithm: a degree of swing at 2 Hz, between a degree at 0.5 Hz
# and ten at 3 Hz
SIZE_RADPS2, SIZE_LOG_SD = 3.0, 1.5
# within which it is looked for: a tenth of a degree of swing at 1.2 Hz, which a joint in the air keeps, while the
# allowance for neglected terms, no noise, may hide it from the evidence; ten degrees at 12 Hz
_SIZES_RADPS2, FREE_RADPS2 = (0.1, 1e3), 1e3
DEFLECTION_SD_RAD = 1.0  # of the deflection itself: no information
_BASIS = BSpline.basis_element(np.arange(5.0))  # the cubic one, of knots one apart
_WITHOUT_SAMPLES = 1e-12  # weight of a coefficient that no sample reaches, of one that they reach
Inputs = dict[str, FloatArray]


@dataclass(frozen=True)
class InputPosterior:
    """Posterior of all inputs: ``mean`` (k,) and ``covariance`` (k, k) of their unit normals, ``place`` of each."""

    mean: FloatArray
    covariance: FloatArray
    place: dict[str, slice]


@dataclass(frozen=True)
class Spline:
    """Cubic B-spline of ``count`` coefficients with knots ``step_s`` apart."""

    knots_s: FloatArray
    count: int
    step_s: float

    @classmethod
    def over(cls, low: float, high: float, step_s: float = KNOT_S) -> Spline:
        """Spline whose knots reach from ``low`` to ``high``, s."""
        knots = low + step_s * np.arange(max(int(np.ceil((high - low) / step_s)), 1) + 1)
        return cls(np.asarray(knots), len(knots) + 2, step_s)

    @cached_property
    def stiffness(self) -> csr_array:
        """Matrix (2 count, 2 count) of the sum over the knots of both axes' squared second derivatives."""
        curvature = self.rows(self.knots_s, 2)
        return csr_array(kron(curvature.T @ curvature, eye_array(2)))

    def at(self, time_s: FloatArray, derivative: int = 0) -> tuple[NDArray[np.int64], FloatArray]:
        """Numbers (n, 4) and values of the basis functions that differ from zero at times (n,), or of derivatives."""
        at = (np.clip(time_s, self.knots_s[0], self.knots_s[-1]) - self.knots_s[0]) / self.step_s
        first = np.asarray(np.minimum(at.astype(np.int64), len(self.knots_s) - 2))
        value = _BASIS((at - first)[:, None] + np.arange(3.0, -1.0, -1.0), derivative)
        return first[:, None] + np.arange(4), value / self.step_s**derivative

    def rows(self, time_s: FloatArray, derivative: int = 0) -> csr_array:
        """Values (n, count) of every basis function, or of its first or second derivative."""
        column, value = self.at(time_s, derivative)
        return csr_array((value.ravel(), column.ravel(), 4 * np.arange(len(value) + 1)), (len(value), self.count))

    def responses(self, time_s: FloatArray, by_order: Iterable[FloatArray]) -> csr_array:
        """Rows (n c, 2 count) of what depends on the lateral vector, its rate and acceleration by (n, c, 2) each."""
        column, parts = self.at(time_s)[0], []
        for order, by in enumerate(by_order):
            parts.append(by[:, :, None, :] * self.at(time_s, order)[1][:, None, :, None])
        value = np.asarray(sum(parts))
        column = np.broadcast_to(2 * column[:, None, :, None] + np.arange(2), value.shape)
        count = len(value) * by.shape[1]
        return csr_array((value.ravel(), column.ravel(), 8 * np.arange(count + 1)), (count, 2 * self.count))

    def smooth(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Least-squares fit to values (n, c) at times (n,), there; the smallest one where samples are too few."""
        rows = self.rows(time_s)
        band = upper_band(csr_array(rows.T @ rows))
        band[-1] += _WITHOUT_SAMPLES * band[-1].max()
        found = np.zeros((self.count, values.shape[1]))
        for _ in range(3):  # what the weight takes from coefficients that samples hardly reach
            found += solveh_banded(band, rows.T @ (values - rows @ found))
        return np.asarray(rows @ found)


@dataclass(frozen=True)
class SplineDeflection:
    """Lateral vectors (n, 2) over time, of a spline's coefficients (count, 2), rad."""

    spline: Spline
    coefficients: FloatArray

    def __call__(self, time_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Vectors or their derivatives at times (n,)."""
        return np.asarray(self.spline.rows(time_s, derivative) @ self.coefficients)


@dataclass(frozen=True)
class Solution:
    """Posterior of the deflection's coefficients and the inputs' unit normals.

    Parameters
    ----------
    mean : (2 m + k,) float
    own : (2 m, 2 m) float, sparse
        Covariance of the coefficients, the inputs known; of those that act at one time, no others.
    by_input : (2 m, k) float
        Change of the coefficients per unit normal of each input.
    inputs : (k, k) float
        Covariance of the inputs.
    """

    mean: FloatArray
    own: csr_array
    by_input: FloatArray
    inputs: FloatArray

    @cached_property
    def sd(self) -> FloatArray:
        """Standard deviations (2 m + k,)."""
        moved = np.sum((self.by_input @ self.inputs) * self.by_input, axis=1)
        return np.sqrt(np.concatenate([self.own.diagonal() + moved, np.diag(self.inputs)]))

    def lateral_cov(self, value: csr_array) -> FloatArray:
        """Covariance (n, 2, 2) of the lateral vectors at rows (n, m) of the spline."""
        moved = np.stack([value @ self.by_input[axis::2] for axis in range(2)], axis=1)
        # one product for all times: many of two rows each take much longer
        spread = (moved.reshape(2 * len(moved), len(self.inputs)) @ self.inputs).reshape(moved.shape)
        cov = spread @ moved.transpose(0, 2, 1)
        for i in range(2):
            for j in range(2):
                cov[:, i, j] += (value @ self.own[i::2, j::2]).multiply(value).sum(axis=1)
        return np.asarray(cov)

    def covariance_of(self, pick: FloatArray) -> FloatArray:
        """Covariance (g, g) of combinations (g, 2 m + k) of inputs and of the deflection at one time."""
        of_deflection, of_inputs = np.hsplit(pick, [self.own.shape[0]])
        moved = of_deflection @ self.by_input + of_inputs
        return np.asarray(of_deflection @ (self.own @ of_deflection.T) + moved @ self.inputs @ moved.T)


@dataclass(frozen=True)
class Rows:
    """Rows of the least-squares problem, errors of unit variance.

    Parameters
    ----------
    by_deflection : (r, 2 m) float, sparse
    by_input : (r, k) float
    want : (r,) float
    """

    by_deflection: csr_array
    by_input: FloatArray
    want: FloatArray


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of the deflection's spline and of the inputs' unit normals, without the process's prior.

    Blocks: ``deflection`` of the spline's coefficients, y and z of each knot side by side, the upper band (w, 2 m) of
    a matrix; ``across`` (2 m, k); ``inputs`` (k, k), at ``place``. Right-hand sides (2 m,) and (k,).
    """

    spline: Spline
    place: dict[str, slice]
    deflection: FloatArray
    across: FloatArray
    inputs: FloatArray
    right: FloatArray
    right_inputs: FloatArray

    @classmethod
    def of_rows(cls, spline: Spline, place: dict[str, slice], parts: Iterable[Rows]) -> NormalEquations:
        """Equations of all rows of the least-squares problem."""
        total = max((p.stop for p in place.values()), default=0)
        band, across = csr_array((2 * spline.count,) * 2), np.zeros((2 * spline.count, total))
        inputs, right, right_inputs = np.eye(total), np.zeros(2 * spline.count), np.zeros(total)
        for part in parts:
            turned = part.by_deflection.T
            band = band + turned @ part.by_deflection
            across += turned @ part.by_input
            inputs += part.by_input.T @ part.by_input
            right += turned @ part.want
            right_inputs += part.by_input.T @ part.want
        return cls(spline, place, upper_band(csr_array(band)), across, inputs, right, right_inputs)

    def solved(self, size_radps2: float, method: str) -> Solution:
        """Posterior of all unknowns, the process of a size."""
        factor = self._factor(size_radps2, method)
        gain = cho_solve_banded((factor, False), self.across)
        mean, precision, found = self._of_inputs(factor, gain, method)
        return Solution(np.concatenate([found, mean]), inverse_in_band(factor), -gain, inverse(precision))

    def smoothed(self, inputs: InputPosterior, method: str) -> tuple[Solution, float]:
        """Posterior of all unknowns, of inputs found without the process, and the process's size."""
        given = replace(self, right=self.right - self.across @ inputs.mean)
        size_radps2 = given.process_size()
        factor = self._factor(size_radps2, method)
        own, by_input = inverse_in_band(factor), -cho_solve_banded((factor, False), self.across)
        found = cho_solve_banded((factor, False), given.right)
        return Solution(np.concatenate([found, inputs.mean]), own, by_input, inputs.covariance), size_radps2

    def of_inputs(self, size_radps2: float, method: str) -> tuple[FloatArray, FloatArray, Deflection]:
        """Posterior mean and precision of the inputs, the deflection integrated over, and the deflection's mean."""
        factor = self._factor(size_radps2, method)
        gain = cho_solve_banded((factor, False), self.across)
        mean, precision, found = self._of_inputs(factor, gain, method)
        return mean, precision, self.history(found)

    def _of_inputs(
        self, factor: FloatArray, gain: FloatArray, method: str
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean and precision of the inputs, and the deflection's coefficients."""
        precision = self.inputs - self.across.T @ gain
        try:
            mean = cho_solve(cho_factor(precision), self.right_inputs - gain.T @ self.right)
        except np.linalg.LinAlgError:
            raise _undetermined(method) from None
        return mean, precision, cho_solve_banded((factor, False), self.right - self.across @ mean)

    def without_inputs(self, kept: slice = slice(0)) -> NormalEquations:
        """Equations of the deflection and the ``kept`` inputs, the others being anything that their priors allow.

        The deflection's block is no band any more.
        """
        others = np.delete(np.arange(len(self.inputs)), kept)
        # half of a solution: its product with itself is what the inputs take, for half the work
        root = np.linalg.cholesky(self.inputs[np.ix_(others, others)])
        blocks = self.across[:, others].T, self.inputs[others, kept], self.right_inputs[others]
        across, inputs, right = (solve_triangular(root, block, lower=True) for block in blocks)
        full, n = -across.T @ across, len(self.right)
        band = np.zeros((n, n))
        for above in range(n):
            band[n - 1 - above, above:] = np.diagonal(full, above)
        band[-len(self.deflection) :] += self.deflection
        return replace(
            self, place={}, deflection=band, across=self.across[:, kept] - across.T @ inputs,
            inputs=self.inputs[kept, kept] - inputs.T @ inputs, right=self.right - across.T @ right,
            right_inputs=self.right_inputs[kept] - inputs.T @ right,
        )  # fmt: skip

    def with_inputs(self, columns: slice) -> NormalEquations:
        """Equations with some of the inputs alone, the others as stated."""
        return replace(
            self, place={}, across=self.across[:, columns], inputs=self.inputs[columns, columns],
            right_inputs=self.right_inputs[columns],
        )  # fmt: skip

    def process_size(self) -> float:
        """Most probable size of the process, rad/s^2, of the deflection's block alone."""
        from scipy.optimize import minimize_scalar  # a tenth of a second

        def surprise(log_size: float) -> float:
            size = float(np.exp(log_size))
            factor = self._factor(size, "")
            prior = 0.5 * ((log_size - np.log(SIZE_RADPS2)) / SIZE_LOG_SD) ** 2
            # a determinant is the square of the product of its Cholesky factor's diagonal, the last row of the band
            volume = np.log(factor[-1]).sum() - np.log(cholesky_banded(self._prior_band(size))[-1]).sum()
            return float(prior + volume - 0.5 * self.right @ cho_solve_banded((factor, False), self.right))

        found = minimize_scalar(surprise, bounds=np.log(_SIZES_RADPS2), method="bounded", options={"xatol": 0.05})
        return float(np.exp(found.x))

    def mean(self, size_radps2: float, method: str) -> FloatArray:
        """Posterior mean of the deflection's coefficients alone."""
        return np.asarray(cho_solve_banded((self._factor(size_radps2, method), False), self.right))

    @cached_property
    def _stiffness_band(self) -> FloatArray:
        return upper_band(self.spline.stiffness)

    def _prior_band(self, size_radps2: float) -> FloatArray:
        """Upper band of the process's precision."""
        out = self._stiffness_band / size_radps2**2
        out[-1] += 1.0 / DEFLECTION_SD_RAD**2
        return out

    def _factor(self, size_radps2: float, method: str) -> FloatArray:
        """Cholesky factor of the deflection's block with the process's prior, an upper band."""
        prior = self._prior_band(size_radps2)
        band = np.zeros((max(len(prior), len(self.deflection)), len(self.right)))
        band[-len(self.deflection) :] = self.deflection
        band[-len(prior) :] += prior
        try:
            return np.asarray(cholesky_banded(band))
        except np.linalg.LinAlgError:
            raise _undetermined(method) from None

    def history(self, found: FloatArray) -> Deflection:
        """Lateral vectors (n, 2) of a solution, from times."""
        return SplineDeflection(self.spline, found[: 2 * self.spline.count].reshape(-1, 2))


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a positive definite matrix."""
    if not len(matrix):
        return matrix
    upper = np.triu(dpotri(cho_factor(matrix)[0])[0])
    return np.asarray(upper + np.triu(upper, 1).T)


def inverse_in_band(factor: FloatArray) -> csr_array:
    """Those elements of a matrix's inverse that lie in the band of its upper Cholesky factor (w + 1, n).

    Row by row from the last, each from the block below it (Takahashi, Fagan, Chen, 1973): the work of the whole inverse
    grows with the square of ``n``, this with ``n``.
    """
    width, n = len(factor) - 1, factor.shape[1]
    band, below = np.zeros((width + 1, n)), np.zeros((width, width))
    own = np.array([np.append(factor[width - k, k:], np.zeros(k)) for k in range(width + 1)])
    right = own[1:] / own[0]
    for i in range(n - 1, -1, -1):
        across = -below @ right[:, i]
        band[0, i], band[1:, i] = 1.0 / own[0, i] ** 2 - right[:, i] @ across, across
        below[1:, 1:] = below[:-1, :-1].copy()
        below[0, :], below[:, 0] = band[:width, i], band[:width, i]
    upper = dia_array((np.array([np.roll(one, k) for k, one in enumerate(band)]), np.arange(width + 1)), (n, n))
    return csr_array(upper + dia_array((band[1:], -np.arange(1, width + 1)), (n, n)))


def _undetermined(method: str) -> DivergenceError:
    return DivergenceError(f"{method}: the readings do not determine the deflection", code="not-observable")


def upper_band(matrix: csr_array) -> FloatArray:
    """Symmetric matrix (n, n) as the rows of its upper band, the diagonal last."""
    entries = coo_array(matrix)
    above = entries.col - entries.row
    width = int(np.max(above, initial=0))
    out, keep = np.zeros((width + 1, matrix.shape[0])), above >= 0
    out[width - above[keep], entries.col[keep]] = entries.data[keep]
    return out


def block_diagonal(blocks: FloatArray) -> csr_array:
    """Sparse matrix (c n, c n) of blocks (n, c, c) on its diagonal."""
    n, c = blocks.shape[:2]
    column = c * np.arange(n)[:, None, None] + np.broadcast_to(np.arange(c), (c, c))
    return csr_array((blocks.ravel(), column.ravel(), c * np.arange(n * c + 1)), (n * c, n * c))

"""How are the deflection's spline and the inputs estimated jointly? Least squares with banded normal equations.

The deflection's lateral vector is a cubic spline with even knots, of which four basis functions differ from
zero at a time: rows of the least-squares problem are sparse in its coefficients, and their normal matrix ``N`` is a
band, whatever the length of the flight. Only the inputs' unit normals ``x`` are dense: with ``Q`` the process's
precision, ``C`` the block across and ``X`` that of the inputs, it is an arrow (`flightmodel.arrow`)::

    [N + Q    C  ]
    [C'     I + X]
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.sparse import csr_array, eye_array, kron

from estimators.evidence import Deflection
from flightmodel.arrow import Arrow, ArrowFactor, lower_band
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
    """Posterior of all inputs' unit normals: ``mean`` (k,), ``covariance`` (k, k), and ``place``, each one's slice."""

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
    def _stiffness(self) -> FloatArray:
        """Band of the sum over the knots of both axes' squared second derivatives."""
        curvature = self.rows(self.knots_s, 2)
        return lower_band(csr_array(kron(curvature.T @ curvature, eye_array(2))))

    def process_precision(self, size_radps2: float) -> Arrow:
        """A priori precision of the coefficients, y and z of each knot side by side, by a process of a size."""
        band = self._stiffness / size_radps2**2
        band[0] += 1.0 / DEFLECTION_SD_RAD**2
        return Arrow(band, np.zeros((2 * self.count, 0)), np.zeros((0, 0)))

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
        """Rows (n c, 2 count) of readings with derivatives (n, c, 2) by lateral vector, rate and acceleration."""
        column, parts = self.at(time_s)[0], []
        for order, by in enumerate(by_order):
            parts.append(by[:, :, None, :] * self.at(time_s, order)[1][:, None, :, None])
        value = np.asarray(sum(parts))
        column = np.broadcast_to(2 * column[:, None, :, None] + np.arange(2), value.shape)
        count = len(value) * by.shape[1]
        return csr_array((value.ravel(), column.ravel(), 8 * np.arange(count + 1)), (count, 2 * self.count))

    def smooth(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Least-squares fit at times (n,) to values (n, c); the minimum-norm one if samples are too few."""
        rows = self.rows(time_s)
        band = lower_band(csr_array(rows.T @ rows))
        band[0] += _WITHOUT_SAMPLES * band[0].max()
        factor, found = (
            Arrow(band, np.zeros((self.count, 0)), np.zeros((0, 0))).factor(),
            np.zeros((self.count, values.shape[1])),
        )
        for _ in range(3):  # what the weight takes from coefficients that samples hardly reach
            found += factor.solve(rows.T @ (values - rows @ found))
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
    """Posterior of the deflection and of the inputs on which the methods depend.

    Parameters
    ----------
    spline : Spline
    mean : (2 m,) float
        The spline's coefficients, y and z of each side by side.
    factor : ArrowFactor
        Of the normal equations.
    input_posterior : InputPosterior
    process_size_radps2 : float
        Of the joint's acceleration at each knot.
    """

    spline: Spline
    mean: FloatArray
    factor: ArrowFactor
    input_posterior: InputPosterior
    process_size_radps2: float

    @property
    def deflection(self) -> Deflection:
        """Mean lateral vectors (n, 2), from times."""
        return SplineDeflection(self.spline, self.mean.reshape(-1, 2))

    @property
    def inputs(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Mean (k,) and covariance (k, k) of each input's unit normals."""
        post = self.input_posterior
        return {name: (post.mean[at], post.covariance[at, at]) for name, at in post.place.items()}

    @cached_property
    def own(self) -> csr_array:
        """Covariance (2 m, 2 m) of the coefficients given the inputs, only between those that overlap in time."""
        return self.factor.inverse_near_diagonal()

    @property
    def by_input(self) -> FloatArray:
        """Change (2 m, k) of the coefficients per unit normal of each input."""
        return self.factor.gain

    @cached_property
    def sd(self) -> FloatArray:
        """Standard deviations (2 m,) of the coefficients."""
        moved = np.sum((self.by_input @ self.input_posterior.covariance) * self.by_input, axis=1)
        return np.sqrt(self.own.diagonal() + moved)

    def lateral_cov(self, time_s: FloatArray) -> FloatArray:
        """Covariance (n, 2, 2) of the lateral vectors at times (n,)."""
        value, of_inputs = self.spline.rows(time_s), self.input_posterior.covariance
        moved = np.stack([value @ self.by_input[axis::2] for axis in range(2)], axis=1)
        # one product for all times: many of two rows each take much longer
        spread = (moved.reshape(2 * len(moved), len(of_inputs)) @ of_inputs).reshape(moved.shape)
        cov = spread @ moved.transpose(0, 2, 1)
        for i in range(2):
            for j in range(2):
                cov[:, i, j] += (value @ self.own[i::2, j::2]).multiply(value).sum(axis=1)
        return np.asarray(cov)

    def correlation_at(self, time_s: float) -> FloatArray:
        """Correlation of the deflection's two components at a time and of each input's leading unit normal."""
        post = self.input_posterior
        of_deflection = np.zeros((2 + len(post.place), len(self.mean)))
        of_deflection[0, 0::2] = of_deflection[1, 1::2] = self.spline.rows(np.array([time_s])).toarray()[0]
        moved = of_deflection @ self.by_input
        for k, at in enumerate(post.place.values()):
            moved[2 + k, at.start] = 1.0
        covariance = of_deflection @ (self.own @ of_deflection.T) + moved @ post.covariance @ moved.T
        sd = np.sqrt(np.diag(covariance))
        return np.asarray(covariance / np.outer(sd, sd))


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

    Parameters
    ----------
    spline : Spline
    place : dict of str to slice
        Of each input's unit normals among all.
    matrix : Arrow
        The spline's coefficients, y and z of each knot side by side, as its band; the inputs as its border.
    right : (2 m + k,) float
    """

    spline: Spline
    place: dict[str, slice]
    matrix: Arrow
    right: FloatArray

    @classmethod
    def of_rows(cls, spline: Spline, place: dict[str, slice], parts: Iterable[Rows]) -> NormalEquations:
        """Equations of all rows of the least-squares problem."""
        total, size = max((p.stop for p in place.values()), default=0), 2 * spline.count
        band, across = csr_array((size, size)), np.zeros((size, total))
        inputs, right = np.eye(total), np.zeros(size + total)
        for part in parts:
            turned = part.by_deflection.T
            band = band + turned @ part.by_deflection
            across += turned @ part.by_input
            inputs += part.by_input.T @ part.by_input
            right += np.concatenate([turned @ part.want, part.by_input.T @ part.want])
        return cls(spline, place, Arrow(lower_band(csr_array(band)), across, inputs), right)

    def with_inputs(self, columns: NDArray[np.int64]) -> NormalEquations:
        """Equations with some of the inputs alone, by their columns, the others as stated."""
        size, whole = 2 * self.spline.count, self.matrix
        part = Arrow(whole.band, whole.across[:, columns], whole.corner[np.ix_(columns, columns)])
        return NormalEquations(self.spline, {}, part, np.concatenate([self.right[:size], self.right[size:][columns]]))

    def solved(self, size_radps2: float, method: str) -> Solution:
        """Posterior of all unknowns, the process of a size."""
        try:
            factor = self._factor(size_radps2)
        except np.linalg.LinAlgError:
            message = f"{method}: the readings do not determine the deflection"
            raise DivergenceError(message, code="not-observable") from None
        mean, inputs = np.split(factor.solve(self.right), [2 * self.spline.count])
        input_posterior = InputPosterior(inputs, factor.border_covariance, self.place)
        return Solution(self.spline, mean, factor, input_posterior, size_radps2)

    def smoothed(self, inputs: InputPosterior, method: str) -> Solution:
        """Posterior of all unknowns, of inputs found without the process, which has its most probable size."""
        alone, size = self.with_inputs(np.arange(0)), 2 * self.spline.count
        given = replace(alone, right=self.right[:size] - self.matrix.across @ inputs.mean)
        size_radps2 = given.process_size()
        mean = given.solved(size_radps2, method).mean
        return replace(self.solved(size_radps2, method), mean=mean, input_posterior=inputs)

    def process_size(self) -> float:
        """Most probable size of the process, rad/s^2, deflection and inputs integrated over."""
        from scipy.optimize import minimize_scalar  # a tenth of a second

        def surprise(log_size: float) -> float:
            size = float(np.exp(log_size))
            factor, prior = self._factor(size), self.spline.process_precision(size)
            a_priori = 0.5 * ((log_size - np.log(SIZE_RADPS2)) / SIZE_LOG_SD) ** 2
            volume = 0.5 * factor.log_det - 0.5 * prior.factor().log_det
            return float(a_priori + volume - 0.5 * self.right @ factor.solve(self.right))

        found = minimize_scalar(surprise, bounds=np.log(_SIZES_RADPS2), method="bounded", options={"xatol": 0.05})
        return float(np.exp(found.x))

    def _factor(self, size_radps2: float) -> ArrowFactor:
        """Cholesky factor with the process's prior."""
        readings, prior = self.matrix.band, self.spline.process_precision(size_radps2).band
        band = np.zeros((max(len(prior), len(readings)), readings.shape[1]))
        band[: len(readings)] = readings
        band[: len(prior)] += prior
        return replace(self.matrix, band=band).factor()


def block_diagonal(blocks: FloatArray) -> csr_array:
    """Sparse matrix (c n, c n) of blocks (n, c, c) on its diagonal."""
    n, c = blocks.shape[:2]
    column = c * np.arange(n)[:, None, None] + np.broadcast_to(np.arange(c), (c, c))
    return csr_array((blocks.ravel(), column.ravel(), c * np.arange(n * c + 1)), (n * c, n * c))

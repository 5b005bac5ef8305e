"""What was the deflection, given all readings at once? One posterior for angle and plane over the pressure pulse.

Unknown are the deflection's history, a cubic spline of its lateral vector with a white second derivative at its knots
(the joint as a second-order process), and every input on which the methods depend (`estimators.evidence`). Readings
and priors are Gaussian and linear in both::

    read(t) = theta(t) + B(t) theta'(t) + A(t) theta''(t) - J(t) x + e,   theta'' ~ N(0, s^2) a knot,   x ~ N(0, 1)

so the posterior is one least-squares problem: its normal equations are solved (`NormalEquations`), again with the
readings taken at the inputs just estimated, until these settle (Gauss-Newton). It is a smoother with the deflection as
its state, in which shared errors are correlated and an input observed by one method improves the others. Its covariance
is the Cramer-Rao bound of the same data and priors. One method alone gives that method's own smooth history.

The size ``s`` of the process is the flight's own: a soft joint under spin accelerates a hundred times as much as a
stiff one. It is the most probable one given the inputs, the deflection integrated over (type-II maximum likelihood):
with the normal matrix ``N`` and right-hand side ``b`` of the readings and the process's precision ``Q(s)``,

    log p(readings | s) = log det Q(s) / 2 - log det(N + Q(s)) / 2 + b' (N + Q(s))^-1 b / 2 + constant,

times a prior of ``s`` (`SIZE_RADPS2`, `SIZE_LOG_SD`) that says little. The process has no say in the inputs: these are
found with a free one (`FREE_RADPS2`), so that only what the methods read counts. A swing is a line in the spectrum;
priced by a white process at every one of some 600 knots it would be cheaper to take as an error of C_N, by up to ten
of its standard deviations.

Assumed: Gaussian errors; neglected terms of the methods' equations as `LEFT_OUT_RAD`, decorrelated after
`LEFT_OUT_TIME_S`; a prior of the deflection's size so wide that it carries no information.

References
----------
B. D. Tapley, B. E. Schutz, G. H. Born, "Statistical Orbit Determination", 2004, chapter 4 (least squares with a priori
information). D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4 (1992) 415 (size of a smoothing prior).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded, lstsq
from scipy.linalg.lapack import dpotri
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from estimators.evidence import (
    LIGHT_TIME_S,
    Deflection,
    Evidence,
    corrected_loads,
    evidence_of_history,
    moved_evidence,
)
from estimators.loads import FlightLoads
from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.deflection import HOLE_FACTOR, DeflectionHistory, history_from_lateral
from flightmodel.trajectory import nearest_index
from flightmodel.vehicle import Vehicle

KNOT_S = 0.1  # a quarter of the joint's period: knots at half of it cannot follow its oscillation
# a priori of the process's size, median and sd of its logarithm: a degree of swing at 2 Hz, between a degree at 0.5 Hz
# and ten at 3 Hz
SIZE_RADPS2, SIZE_LOG_SD = 3.0, 1.5
_SIZES_RADPS2, FREE_RADPS2 = (1e-3, 1e3), 1e3  # within which it is looked for; ten degrees of swing at 12 Hz
DEFLECTION_SD_RAD = 1.0  # of the deflection itself: no information
# neglected by the methods' equations, second order in the angles and gusts shorter than the wind's knots: with true
# inputs 0.01 to 0.02 deg rms over the pulses of thirty flights, decorrelated within half a second
LEFT_OUT_RAD, LEFT_OUT_TIME_S = np.deg2rad(0.02), 0.4
LEAST_SAMPLES = 8
_MOST_INPUT_SD, SETTLED_SD, MOST_STEPS, _WHOLE_STEPS = 8.0, 0.05, 30, 4
_NEAR_S = 0.5  # an answer is given no further from a reading
_BIAS_STEP_S, _FARTHEST_BIAS_SD = 0.01, 3.0
MOVES = 1.75  # rms rate of the deflection over its sd; of noise alone it is 1
_SMOOTH_RATE_HZ = 50.0
# The vehicle's pitching drives the deflection at up to 0.35 of the joint's frequency (four synthetic flights, stiffness
# 0.75 to 3 times the reference's), which twice as many readings resolve
_READINGS_A_SWING = 0.8
_HOLE = 1.5  # of the readings' usual spacing: one is missing
_LOCAL = 5  # readings about one, over which the swing's variance is taken
Inputs = dict[str, FloatArray]
Read = Callable[[Inputs, Deflection | None], list[Evidence]]


@dataclass(frozen=True)
class InputPosterior:
    """Posterior of all inputs: ``mean`` (k,) and ``covariance`` (k, k) of their unit normals, ``place`` of each."""

    mean: FloatArray
    covariance: FloatArray
    place: dict[str, slice]


@dataclass(frozen=True)
class Spline:
    """Cubic B-spline with even knots."""

    knots_s: FloatArray
    count: int
    _full: FloatArray

    @classmethod
    def over(cls, low: float, high: float) -> Spline:
        """Spline whose knots reach from ``low`` to ``high``, s."""
        inner = low + KNOT_S * np.arange(int(np.ceil((high - low) / KNOT_S)) + 1)
        full = np.concatenate([inner[0] - KNOT_S * np.arange(3, 0, -1), inner, inner[-1] + KNOT_S * np.arange(1, 4)])
        return cls(np.asarray(inner), len(full) - 4, np.asarray(full))

    @cached_property
    def stiffness(self) -> FloatArray:
        """Matrix (2 count, 2 count) of the sum over the knots of both axes' squared second derivatives."""
        curvature = self.rows(self.knots_s, 2)
        return np.asarray(np.kron(curvature.T @ curvature, np.eye(2)), dtype=float)

    def rows(self, time_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Values (n, count) of every basis function, or of its derivative."""
        basis = BSpline(self._full, np.eye(self.count), 3)
        at = np.clip(time_s, self.knots_s[0], self.knots_s[-1])
        return np.asarray(basis(at, nu=derivative))


@dataclass(frozen=True)
class SplineDeflection:
    """Lateral vectors (n, 2) over time, of a spline's coefficients (count, 2), rad."""

    spline: Spline
    coefficients: FloatArray

    def __call__(self, time_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Vectors or their derivatives at times (n,)."""
        return self.spline.rows(time_s, derivative) @ self.coefficients


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of the deflection's spline and of the inputs' unit normals, without the process's prior.

    Blocks: ``deflection`` (2 m, 2 m) of the spline's coefficients, y and z of each knot side by side, so that it is a
    band; ``across`` (2 m, k); ``inputs`` (k, k), at ``place``. Right-hand sides (2 m,) and (k,).
    """

    spline: Spline
    place: dict[str, slice]
    deflection: FloatArray
    across: FloatArray
    inputs: FloatArray
    right: FloatArray
    right_inputs: FloatArray

    @classmethod
    def of(cls, readings: list[Evidence], inputs: Inputs, span_s: tuple[float, float]) -> NormalEquations:
        """Equations of the methods' readings at ``inputs``; the spline reaches over ``span_s``."""
        spline, place = Spline.over(*span_s), places(e.by_input for e in readings)
        return cls.of_rows(spline, place, (whitened(one, spline, place, inputs) for one in readings))

    @classmethod
    def of_rows(
        cls, spline: Spline, place: dict[str, slice], parts: Iterable[tuple[FloatArray, FloatArray]]
    ) -> NormalEquations:
        """Equations of rows (r, unknowns) of the least-squares problem and their right-hand sides, of unit variance."""
        size, total = 2 * spline.count, max((p.stop for p in place.values()), default=0)
        normal, right = np.zeros((size + total,) * 2), np.zeros(size + total)
        for rows, want in parts:
            normal += rows.T @ rows
            right += rows.T @ want
        own = normal[size:, size:] + np.eye(total)
        return cls(spline, place, normal[:size, :size], normal[:size, size:], own, right[:size], right[size:])

    def solved(self, size_radps2: float, method: str) -> tuple[FloatArray, FloatArray]:
        """Posterior mean and covariance of all unknowns, the process of a size."""
        prior = self.spline.stiffness / size_radps2**2 + np.eye(len(self.right)) / DEFLECTION_SD_RAD**2
        normal = np.block([[self.deflection + prior, self.across], [self.across.T, self.inputs]])
        try:
            factor = cho_factor(normal)[0]
        except np.linalg.LinAlgError:
            raise _undetermined(method) from None
        right = np.concatenate([self.right, self.right_inputs])
        return cho_solve((factor, False), right), _inverse_of_factor(factor)

    def smoothed(self, inputs: InputPosterior, method: str) -> tuple[FloatArray, FloatArray, float]:
        """Mean and covariance of all unknowns, of inputs found without the process, and the process's size."""
        given = replace(self, right=self.right - self.across @ inputs.mean)
        size_radps2 = given.process_size()
        own = cho_solve_banded((self._factor(size_radps2, method), False), np.eye(len(self.right)))
        by_input = -own @ self.across
        across = by_input @ inputs.covariance
        covariance = np.block([[own + across @ by_input.T, across], [across.T, inputs.covariance]])
        return np.concatenate([own @ given.right, inputs.mean]), covariance, size_radps2

    def of_inputs(self, size_radps2: float, method: str) -> tuple[FloatArray, FloatArray, Deflection]:
        """Posterior mean and precision of the inputs, the deflection integrated over, and the deflection's mean."""
        factor = self._factor(size_radps2, method)
        gain = cho_solve_banded((factor, False), self.across)
        precision = self.inputs - self.across.T @ gain
        try:
            mean = cho_solve(cho_factor(precision), self.right_inputs - gain.T @ self.right)
        except np.linalg.LinAlgError:
            raise _undetermined(method) from None
        return mean, precision, self.history(cho_solve_banded((factor, False), self.right - self.across @ mean))

    def without_inputs(self) -> NormalEquations:
        """Equations of the deflection alone, the inputs being anything that their priors allow."""
        gain = cho_solve(cho_factor(self.inputs), self.across.T).T
        return replace(
            self, deflection=self.deflection - gain @ self.across.T, right=self.right - gain @ self.right_inputs
        )

    def process_size(self) -> float:
        """Most probable size of the process, rad/s^2, of the deflection's block alone."""

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
    def _bands(self) -> tuple[FloatArray, FloatArray]:
        """Upper bands of the deflection's block and of the spline's stiffness; the first is the wider, if they differ.

        Without the inputs the first is a whole triangle, where the process's determinant need not be one.
        """
        stiffness = self.spline.stiffness
        narrow = _width(stiffness)
        return _upper_band(self.deflection, max(_width(self.deflection), narrow)), _upper_band(stiffness, narrow)

    def _prior_band(self, size_radps2: float) -> FloatArray:
        """Upper band of the process's precision."""
        out = self._bands[1] / size_radps2**2
        out[-1] += 1.0 / DEFLECTION_SD_RAD**2
        return out

    def _factor(self, size_radps2: float, method: str) -> FloatArray:
        """Cholesky factor of the deflection's block with the process's prior, an upper band."""
        band, prior = self._bands[0].copy(), self._prior_band(size_radps2)
        band[-len(prior) :] += prior
        try:
            return np.asarray(cholesky_banded(band))
        except np.linalg.LinAlgError:
            raise _undetermined(method) from None

    def history(self, found: FloatArray) -> Deflection:
        """Lateral vectors (n, 2) of a solution, from times."""
        return SplineDeflection(self.spline, found[: 2 * self.spline.count].reshape(-1, 2))


def _inverse_of_factor(factor: FloatArray) -> FloatArray:
    """Inverse of the matrix whose upper Cholesky factor is given."""
    upper = np.triu(dpotri(factor)[0])
    return np.asarray(upper + np.triu(upper, 1).T)


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a positive definite matrix."""
    return _inverse_of_factor(cho_factor(matrix)[0])


def _undetermined(method: str) -> DivergenceError:
    return DivergenceError(f"{method}: the readings do not determine the deflection", code="deflection-undetermined")


def _width(matrix: FloatArray) -> int:
    """Number of diagonals above the main one, up to the last that is not zero."""
    return int(np.max(np.subtract(*np.nonzero(matrix)), initial=0))


def _upper_band(matrix: FloatArray, width: int) -> FloatArray:
    """Symmetric matrix (n, n) as the rows of its upper band, the diagonal last."""
    out = np.zeros((width + 1, len(matrix)))
    for k in range(width + 1):
        out[width - k, k:] = np.diagonal(matrix, k)
    return out


def places(of: Iterable[dict[str, FloatArray]]) -> dict[str, slice]:
    """Place of each input's unit normals among all, of responses (n, c, k) by name."""
    out: dict[str, slice] = {}
    total = 0
    for name, response in (item for by_input in of for item in by_input.items()):
        if name not in out:
            out[name] = slice(total, total + response.shape[2])
            total = out[name].stop
    return out


def whitened(one: Evidence, spline: Spline, place: dict[str, slice], inputs: Inputs) -> tuple[FloatArray, FloatArray]:
    """Rows ``(2 n, unknowns)`` of the least-squares problem and their right-hand side, errors of unit variance.

    Unknowns are in the order of `NormalEquations`.
    """
    keep = np.isfinite(one.theta_yz_rad).all(axis=1)
    n, m = int(keep.sum()), spline.count
    value, first, second = (spline.rows(one.time_s[keep], order) for order in range(3))
    by_rate, by_acceleration = one.by_rate_s[keep], one.by_acceleration_s2[keep]
    rows = np.zeros((n, 2, 2 * m + max((p.stop for p in place.values()), default=0)))
    for axis in range(2):
        for other in range(2):
            moving = by_rate[:, axis, other, None] * first + by_acceleration[:, axis, other, None] * second
            rows[:, axis, other : 2 * m : 2] = moving
        rows[:, axis, axis : 2 * m : 2] += value
    want = one.theta_yz_rad[keep].copy()
    for name, every in one.by_input.items():
        response = every[keep]
        rows[:, :, 2 * m + place[name].start : 2 * m + place[name].stop] = -response
        if name in inputs:
            want -= response @ inputs[name]
    share = means_over_spans(one.time_s[keep], one.averaged_s, one.time_s[keep][0])
    rows = (csr_array(share) @ rows.reshape(n, -1)).reshape(len(share), 2, -1)
    cov = np.einsum("bn,nij->bij", share**2, one.independent_cov[keep])
    cov += LEFT_OUT_RAD**2 * LEFT_OUT_TIME_S / one.averaged_s * np.eye(2)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    return (whiten @ rows).reshape(2 * len(share), -1), (whiten @ (share @ want)[:, :, None]).ravel()


def span_numbers(time_s: FloatArray, width_s: float, from_s: float) -> NDArray[np.int64]:
    """Number of the span in which each time (n,) lies, one of which begins at ``from_s``."""
    return np.asarray(np.floor((time_s - from_s) / width_s + 1e-6).astype(np.int64))


def means_over_spans(time_s: FloatArray, width_s: float, from_s: float) -> FloatArray:
    """Weights (bins, n) of the means over spans of time, one of which begins at ``from_s``; empty ones are left out."""
    _, which, count = np.unique(span_numbers(time_s, width_s, from_s), return_inverse=True, return_counts=True)
    out = np.zeros((len(count), len(time_s)))
    out[which, np.arange(len(time_s))] = 1.0 / count[which]
    return out


class Method(Protocol):
    """Reads the deflection at all samples of loads, linear about a deflection; the inputs' responses on demand."""

    def __call__(self, loads: FlightLoads, about: Deflection | None = None, with_inputs: bool = True) -> Evidence:
        """Readings of the method."""


@dataclass(frozen=True)
class Fused:
    """Posterior of the deflection and of the inputs on which the methods depend.

    Parameters
    ----------
    history : DeflectionHistory
        At the times of the method with most samples.
    input_posterior : InputPosterior
        Of the inputs, given all readings.
    correlation : (g, g) float
        Of the inputs' leading unit normals and of the deflection's two components at ``at_s``, in order of ``names``.
    names : tuple of str
    at_s : float
        Time of the smallest deflection sd.
    deflection : Deflection
    process_size_radps2 : float
        Of the joint's acceleration at each knot, as this flight has it.
    """

    history: DeflectionHistory
    input_posterior: InputPosterior
    correlation: FloatArray
    names: tuple[str, ...]
    at_s: float
    deflection: Deflection
    process_size_radps2: float

    @property
    def inputs(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Mean (k,) and covariance (k, k) of each input's unit normals, given all readings."""
        post = self.input_posterior
        return {name: (post.mean[at], post.covariance[at, at]) for name, at in post.place.items()}


class FarInputsError(DivergenceError):
    """Readings agree only with inputs far beyond their stated sd: ``input_posterior`` has which."""

    def __init__(self, message: str, input_posterior: InputPosterior) -> None:
        super().__init__(message, code="inputs-far-off")
        self.input_posterior = input_posterior


def fuse(
    read: Read,
    method: str = "fused",
    at_s: FloatArray | None = None,
    near_s: float = _NEAR_S,
    *,
    free_process: bool = True,
) -> Fused:
    """Fuse the methods' readings; one method alone is smoothed.

    Parameters
    ----------
    read : callable
        From inputs, moved by so many standard deviations, and a deflection to be linear about (from times to lateral
        vectors; None: each method's own) to the methods' readings.
    method : str
        Name of the answer.
    at_s : (n,) float, optional
        Times of the answer, s; else those of the method with most samples.
    near_s : float
        An answer is given no further from a reading.
    free_process : bool
        False gives the process, of its most probable size, a say in the inputs: those of several films are the films'
        own errors, and the deflection does not step where one film ends. How far these are off is then not limited.

    Raises
    ------
    DivergenceError
        Where there is too little to read, or the inputs do not settle.
    FarInputsError
        Where the readings ask for inputs far beyond their stated sd.
    """
    readings = [e for e in read({}, None) if np.isfinite(e.theta_yz_rad).all(axis=1).sum() >= LEAST_SAMPLES]
    if not readings:
        raise DivergenceError(
            f"{method}: no method has {LEAST_SAMPLES} readings of the deflection", code="too-few-readings"
        )
    methods = [e.method for e in readings]
    # first every sample by itself, without shared errors: a deflection to be linear about
    inputs: Inputs = _initial_time_bias(readings, method)
    span = span_of(readings)
    alone = [_uncorrelated(moved_evidence(e, inputs)) for e in readings]
    problem = NormalEquations.of(alone, {}, span)
    found, size_radps2 = problem.mean(problem.process_size(), method), FREE_RADPS2
    for step in range(MOST_STEPS):
        readings = [e for e in read(inputs, problem.history(found)) if e.method in methods]
        if min(np.isfinite(e.theta_yz_rad).all(axis=1).sum() for e in readings) < LEAST_SAMPLES:
            raise DivergenceError(
                f"{method}: the steps lead to deflections at which no method has an answer; see each method's own",
                code="fusion-not-converged",
            )
        problem, before = NormalEquations.of(readings, inputs, span), found
        if not free_process and step < _WHOLE_STEPS:  # then held: its own small changes would go on moving the inputs
            size_radps2 = problem.without_inputs().process_size()
        found, covariance = problem.solved(size_radps2, method)
        size = 2 * problem.spline.count
        new = {name: found[size:][place] for name, place in problem.place.items()}
        sd = np.sqrt(np.diag(covariance))
        moved = float((np.abs(found[:size] - before[:size]) / sd[:size]).max())
        for name in {e.time_bias for e in readings} & new.keys():
            bias = np.abs(new[name] - inputs.get(name, 0.0)) / sd[size:][problem.place[name]]
            moved = max(moved, float(bias.max()))
        if moved < SETTLED_SD and step > 0:
            input_posterior = InputPosterior(found[size:], covariance[size:, size:], problem.place)
            if free_process:
                _check_inputs(new, input_posterior, method)
            times = max(readings, key=lambda e: len(e.time_s)).time_s if at_s is None else at_s
            times = times[_apart_from_readings(times, readings) <= near_s]
            answer = (found, covariance, size_radps2)
            if free_process:
                answer = problem.smoothed(input_posterior, method)
            return _posterior(answer, problem, input_posterior, readings, method, times)
        # whole Gauss-Newton steps first, then half steps, which cannot oscillate
        part = 1.0 if step < _WHOLE_STEPS else 0.5
        inputs = {name: part * x + (1.0 - part) * inputs.get(name, 0.0 * x) for name, x in new.items()}
    raise DivergenceError(
        f"{method}: the deflection did not converge: after {MOST_STEPS} steps it still moves by {moved:.2g} sd, where "
        f"{SETTLED_SD:g} are allowed; see each method's own answer",
        code="fusion-not-converged",
    )


def smoothed(
    history: DeflectionHistory, rate_hz: float = _SMOOTH_RATE_HZ, swing_hz: float | None = None
) -> DeflectionHistory:
    """One method's history as a smooth one, every ``1 / rate_hz`` s: the joint as a second-order process.

    Its sd grows between readings and through short holes. It has no answer further from a reading than `_NEAR_S`, or,
    of sparse readings, than half of what `DeflectionHistory.at` takes for a hole.

    Where readings are too sparse for the motion of a joint that swings at ``swing_hz``, its swing between them is in
    the sd (`_unresolved_swing_var`).

    Raises
    ------
    DivergenceError
        Where there are too few readings.
    """
    known = history.time_s[np.isfinite(history.theta_rad)]
    if len(known) < LEAST_SAMPLES:
        raise DivergenceError(
            f"{history.method}: no smooth history of {len(known)} readings; {LEAST_SAMPLES} are the least",
            code="too-few-readings",
        )
    first, last = np.ceil(known[0] * rate_hz), np.floor(known[-1] * rate_hz)
    one = evidence_of_history(history)
    at_s, near_s = np.arange(first, last + 1.0) / rate_hz, 0.5 * HOLE_FACTOR * float(np.median(np.diff(known)))
    out = fuse(lambda _inputs, _about: [one], history.method, at_s, max(near_s, _NEAR_S)).history
    return out if swing_hz is None else with_unresolved_swing(history, out, swing_hz)


def with_unresolved_swing(readings: DeflectionHistory, smooth: DeflectionHistory, swing_hz: float) -> DeflectionHistory:
    """Smooth history of readings with the swing in its sd that they are too sparse to follow; as it is elsewhere."""
    known = readings.time_s[np.isfinite(readings.theta_rad)]
    after = np.searchsorted(known, smooth.time_s).clip(1, len(known) - 1)
    sparse = (known[after] - known[after - 1]) * swing_hz * _READINGS_A_SWING > 1.0
    if not sparse.any():
        return smooth
    var = np.where(sparse, _unresolved_swing_var(readings, smooth, swing_hz), 0.0)
    cov = smooth.lateral_cov_without_plane + var[:, None, None] * np.eye(2)
    words = (
        f"{smooth.assumptions}; where readings are sparser than its swing at {swing_hz:.1f} Hz needs, that is in the sd"
    )
    return history_from_lateral(smooth.time_s, smooth.theta_yz_rad, cov, smooth.method, words)


def _unresolved_swing_var(readings: DeflectionHistory, at: DeflectionHistory, swing_hz: float) -> FloatArray:
    """Variance ``(n,)`` of a swing between readings that do not follow it, rad^2.

    A swing of variance ``v`` is off by ``2 v (1 - cos)`` of its phase since the nearest reading, up to ``2 v``. Its
    variance is the readings' own about their local mean; at a multiple of their rate they would not show it, so that it
    is at least that of a swing of any amplitude up to the level itself, which is a load's put on at once.
    """
    seen = np.isfinite(readings.theta_rad)
    time_s, yz = readings.time_s[seen], readings.theta_yz_rad[seen]
    off = np.sum((yz - uniform_filter1d(yz, _LOCAL, axis=0, mode="nearest")) ** 2, axis=1)
    var = uniform_filter1d(off, _LOCAL, mode="nearest") * _LOCAL / (_LOCAL - 1.0)
    level = uniform_filter1d(np.sum(yz**2, axis=1), _LOCAL, mode="nearest")
    # in a hole it may be that of the readings around, whose local mean follows the swing
    hole = np.diff(time_s, append=time_s[-1])
    for k in np.flatnonzero(hole > _HOLE * np.median(np.diff(time_s))):
        around = (time_s > time_s[k] - hole[k]) & (time_s < time_s[k + 1] + hole[k])
        var[k : k + 2] = np.maximum(var[k : k + 2], yz[around].var(axis=0, ddof=1).sum())
    near = np.abs(at.time_s - time_s[nearest_index(time_s, at.time_s)])
    share = 1.0 - np.cos(np.minimum(2.0 * np.pi * swing_hz * near, 0.5 * np.pi))
    # a uniform amplitude's mean square is a third of its largest, a swing's variance half of its amplitude's square
    return np.asarray(np.interp(at.time_s, time_s, np.maximum(var, level / 6.0)) * share)


def _uncorrelated(one: Evidence) -> Evidence:
    """Evidence with every sample's error independent of the others."""
    return replace(one, by_input={}, independent_cov=one.covariance)


def span_of(readings: list[Evidence]) -> tuple[float, float]:
    """First and last time of all readings, whatever their time biases."""
    wide = [_FARTHEST_BIAS_SD * e.time_bias_sd_s for e in readings]
    low = min(e.time_s[0] - w for e, w in zip(readings, wide, strict=True))
    return float(low), float(max(e.time_s[-1] + w for e, w in zip(readings, wide, strict=True)))


def time_bias_is_observable(read: Read) -> bool:
    """Whether the deflection by the methods with the gyros' time tags moves enough for a time bias to be observed.

    A constant deflection fits any time bias, and the rate of mere noise would fit a wrong one with a small sd.
    """
    readings = [e for e in read({}, None) if np.isfinite(e.theta_yz_rad).all(axis=1).sum() >= LEAST_SAMPLES]
    off, own = [e for e in readings if e.time_bias_sd_s > 0.0], [e for e in readings if e.time_bias_sd_s == 0.0]
    if not off or not own:
        return False
    span = span_of(own)
    # a constant error does not move
    problem = NormalEquations.of([replace(e, by_input={}) for e in own], {}, span)
    try:
        found, covariance = problem.solved(problem.process_size(), "camera time bias")
    except DivergenceError:
        return False
    time_s = np.concatenate([e.time_s for e in off])
    rows = problem.spline.rows(time_s[(time_s > span[0]) & (time_s < span[1])], 1)
    axes = slice(0, None, 2), slice(1, None, 2)
    square = sum(float(np.sum((rows @ found[axis]) ** 2)) for axis in axes)
    variance = sum(float(np.sum((rows @ covariance[axis, axis]) * rows)) for axis in axes)
    return square > MOVES**2 * variance


def _initial_time_bias(readings: list[Evidence], method: str) -> Inputs:
    """Time bias to start from, in its standard deviations; none where all methods share the gyros' time tags.

    The joint oscillates several times within the bias's a priori sd: the sum of squares has a minimum at every period,
    and the lowest is looked for, with the prior's term. Errors longer than `LIGHT_TIME_S` carry no information on it.
    """
    off, own = [e for e in readings if e.time_bias_sd_s > 0.0], [e for e in readings if e.time_bias_sd_s == 0.0]
    if not off or not own:
        return {}
    span = span_of(own)
    problem = NormalEquations.of([_uncorrelated(e) for e in own], {}, span)
    deflection = problem.history(problem.mean(problem.process_size(), method))
    starts = {one.time_bias: _lowest_bias_sd(one, deflection, span) for one in off}
    return {name: np.array([bias_sd]) for name, bias_sd in starts.items() if bias_sd is not None}


def _lowest_bias_sd(one: Evidence, deflection: Deflection, span: tuple[float, float]) -> float | None:
    """Time bias of readings at the lowest sum of squares against a deflection, in its sd; None with too few."""
    reach = _FARTHEST_BIAS_SD * one.time_bias_sd_s
    late_s = np.arange(-np.ceil(reach / _BIAS_STEP_S), np.ceil(reach / _BIAS_STEP_S) + 1.0) * _BIAS_STEP_S
    inside = (one.time_s > span[0] + reach) & (one.time_s < span[1] - reach) & np.isfinite(one.theta_yz_rad[:, 0])
    time_s, read = one.time_s[inside], one.theta_yz_rad[inside]
    if len(time_s) < LEAST_SAMPLES:
        return None
    window = max(3, round(LIGHT_TIME_S / float(np.median(np.diff(time_s)))))
    square = np.empty(len(late_s))
    for k, late in enumerate(late_s):
        off_rad = read - deflection(time_s - late)
        square[k] = np.sum((off_rad - uniform_filter1d(off_rad, window, axis=0, mode="nearest")) ** 2)
    variance = float(square.min()) / (2.0 * len(time_s)) + LEFT_OUT_RAD**2
    best = int(np.argmin(square / variance + (late_s / one.time_bias_sd_s) ** 2))
    return float(late_s[best] / one.time_bias_sd_s)


@dataclass(frozen=True)
class LoadsReader:
    """Reader for `fuse`: methods that read the flight loads, and others whose readings are given.

    Inputs scale the measurements, and would scale their noise too, which no input can have made smaller: they act only
    on the measurements' part that the spline can follow, ``smooth``.
    """

    pulse: FlightLoads
    smooth: FlightLoads
    methods: dict[str, Method]
    others: list[Evidence]

    def with_vehicle(self, vehicle: Vehicle) -> LoadsReader:
        """Return the reader of the same measurements of another vehicle."""
        return replace(self, pulse=replace(self.pulse, vehicle=vehicle), smooth=replace(self.smooth, vehicle=vehicle))

    def __call__(self, inputs: Inputs, about: Deflection | None) -> list[Evidence]:
        """Readings, as `fuse` asks for them."""
        if about is None:
            return [*(method(self.pulse) for method in self.methods.values()), *self.others]
        moved, out = corrected_loads(self.smooth, inputs), []
        for method in self.methods.values():
            found = method(moved, about)
            raw, even = (method(one, about, with_inputs=False).theta_yz_rad for one in (self.pulse, self.smooth))
            out.append(replace(found, theta_yz_rad=found.theta_yz_rad + raw - even))
        return [*out, *(moved_evidence(other, inputs, about) for other in self.others)]


def loads_reader(loads: FlightLoads, methods: dict[str, Method], others: list[Evidence]) -> LoadsReader:
    """Reader of the loads through the pressure pulse."""
    pulse = loads.rows(loads.through_pulse)
    return LoadsReader(pulse, _smoothed_loads(pulse), methods, others)


def _smoothed_loads(loads: FlightLoads) -> FlightLoads:
    """Loads with force, rate and angular acceleration smoothed to a spline with knots `KNOT_S` apart."""
    t = loads.time_s
    value = Spline.over(float(t[0]), float(t[-1])).rows(t)
    as_read = [loads.specific_force_body_mps2, loads.rate_body_radps, loads.angular_acceleration_body_radps2]
    smooth = value @ lstsq(value, np.hstack(as_read), lapack_driver="gelsy")[0]
    force, rate, turn = map(np.ascontiguousarray, np.hsplit(smooth, 3))
    return replace(loads, specific_force_body_mps2=force, rate_body_radps=rate, angular_acceleration_body_radps2=turn)


def _check_inputs(inputs: Inputs, input_posterior: InputPosterior, method: str) -> None:
    for name, moved in inputs.items():
        worst = float(np.abs(moved).max())
        if not worst <= _MOST_INPUT_SD:
            raise FarInputsError(
                f"{method}: the readings agree only with {name} {worst:.0f} sd off its stated value, where "
                f"{_MOST_INPUT_SD:.0f} are allowed; check it in the flight and vehicle files, and each method's own "
                "answer",
                input_posterior,
            )


def _apart_from_readings(time_s: FloatArray, readings: list[Evidence]) -> FloatArray:
    """Distance (n,) of each time from the nearest reading of any method, s."""
    read = np.sort(np.concatenate([e.time_s for e in readings]))
    return np.abs(time_s - read[nearest_index(read, time_s)])


def _posterior(
    answer: tuple[FloatArray, FloatArray, float],
    problem: NormalEquations,
    input_posterior: InputPosterior,
    readings: list[Evidence],
    method: str,
    t: FloatArray,
) -> Fused:
    found, covariance, size_radps2 = answer
    spline = problem.spline
    size = 2 * spline.count
    value = spline.rows(t)
    theta_yz = problem.history(found)(t)
    cov = np.zeros((len(t), 2, 2))
    for i in range(2):
        for j in range(2):
            cov[:, i, j] = np.sum((value @ covariance[i:size:2, j:size:2]) * value, axis=1)
    remark = f"from {', '.join(e.method for e in readings)} with their shared errors; joint as a second-order process"
    history = history_from_lateral(t, theta_yz, cov, method, remark)
    best = int(np.argmin(np.trace(cov, axis1=1, axis2=2)))
    pick = np.zeros((2 + len(problem.place), len(found)))
    pick[0, 0:size:2], pick[1, 1:size:2] = value[best], value[best]
    for k, place in enumerate(problem.place.values()):
        pick[2 + k, size + place.start] = 1.0
    joint = pick @ covariance @ pick.T
    sd = np.sqrt(np.diag(joint))
    names = ("deflection y", "deflection z", *problem.place)
    correlation = joint / np.outer(sd, sd)
    return Fused(history, input_posterior, correlation, names, float(t[best]), problem.history(found), size_radps2)

"""What was the deflection, given all that was read of it at once? One posterior for angle and plane over the pulse.

Unknown are the deflection's history, a cubic spline of its lateral vector whose second derivative is white (the joint
as a second-order process of which only the size is taken as known), and every input that the methods lean on
(`estimators.evidence`). Readings and priors are Gaussian and linear in both::

    read(t) = theta(t) + A(t) theta''(t) - J(t) x + e,     theta'' ~ N(0, ACCELERATION_SD^2) a knot,     x ~ N(0, 1)

so that the posterior is one least-squares problem, solved again with the readings taken at the inputs just found until
these settle (Gauss and Newton's): a smoother with the deflection as its state, in which what methods
share is correlated and what one method learns of an input helps the others. Its covariance is the Cramer-Rao bound of
the same data and priors. One method alone gives that method's own smooth history.

Normal equations of the fusion: a cubic spline for the deflection's lateral vector, unit normals for every input.

A prior holds the spline's second derivative at its knots white, and says next to nothing of the deflection's size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, lstsq
from scipy.linalg.lapack import dpotri
from scipy.ndimage import uniform_filter1d

from estimators.evidence import (
    FILM_CLOCK,
    LIGHT_TIME_S,
    Deflection,
    Evidence,
    corrected_pulse,
    evidence_of_history,
    moved_evidence,
)
from estimators.loads import PulseData
from flightmodel.checks import BoolArray, DivergenceError, FloatArray
from flightmodel.deflection import DeflectionHistory, history_from_lateral

KNOT_S = 0.1  # a quarter of the joint's period: knots at half of it cannot follow its swinging
# of the joint, at each knot; three of it are 1 deg of swinging at the joint's 2.85 Hz, 20 deg at the slow aerodynamic
# mode's 0.65 Hz, so that swinging is no reason to believe in other inputs
ACCELERATION_SD_RADPS2 = 2.0
SIZE_SD_RAD = 1.0  # of the deflection itself: says nothing
# what the methods' equations leave out, second order in the angles and gusts shorter than the wind's knots: with true
# inputs 0.01 to 0.02 deg rms over the pulses of thirty flights, forgotten within half a second
LEFT_OUT_RAD, LEFT_OUT_TIME_S = np.deg2rad(0.02), 0.4
Inputs = dict[str, FloatArray]


@dataclass(frozen=True)
class Learnt:
    """What readings say of all inputs: ``mean`` (k,) and ``covariance`` (k, k) of their unit normals, by place."""

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
        """Return the spline whose knots reach from ``low`` to ``high``, s."""
        inner = low + KNOT_S * np.arange(int(np.ceil((high - low) / KNOT_S)) + 1)
        full = np.concatenate([inner[0] - KNOT_S * np.arange(3, 0, -1), inner, inner[-1] + KNOT_S * np.arange(1, 4)])
        return cls(np.asarray(inner), len(full) - 4, np.asarray(full))

    def rows(self, time_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Values (n, count) of every basis function, or of its derivative."""
        basis = BSpline(self._full, np.eye(self.count), 3)
        at = np.clip(time_s, self.knots_s[0], self.knots_s[-1])
        return np.asarray(basis(at, nu=derivative))


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of the deflection's spline (y, then z) and of the inputs; where each input's normals stand."""

    spline: Spline
    place: dict[str, slice]
    normal: FloatArray
    right: FloatArray

    @classmethod
    def of(cls, told: list[Evidence], inputs: Inputs, span_s: tuple[float, float]) -> NormalEquations:
        """Return the equations of what methods read at ``inputs``; the spline reaches over ``span_s``."""
        spline = Spline.over(*span_s)
        place: dict[str, slice] = {}
        total = 0
        for name, response in (item for e in told for item in e.by_input.items()):
            if name not in place:
                place[name] = slice(total, total + response.shape[2])
                total = place[name].stop
        size = 2 * spline.count
        normal, right = np.zeros((size + total,) * 2), np.zeros(size + total)
        for one in told:
            rows, want = whitened(one, spline, place, inputs)
            normal += rows.T @ rows
            right += rows.T @ want
        curvature = spline.rows(spline.knots_s, 2) / ACCELERATION_SD_RADPS2
        bending = curvature.T @ curvature + np.eye(spline.count) / SIZE_SD_RAD**2
        for axis in range(2):
            part = slice(axis * spline.count, (axis + 1) * spline.count)
            normal[part, part] += bending
        normal[range(size, len(right)), range(size, len(right))] += 1.0
        return cls(spline, place, normal, right)

    def deflection(self, found: FloatArray) -> Deflection:
        """Lateral vectors (n, 2) of a solution, from times."""
        coefficients = found[: 2 * self.spline.count].reshape(2, -1)
        return lambda time_s: self.spline.rows(time_s) @ coefficients.T

    def solved(self, method: str) -> tuple[FloatArray, FloatArray]:
        """Posterior mean and covariance of all unknowns."""
        factor = self._factor(method)
        upper = np.triu(dpotri(factor)[0])
        return cho_solve((factor, False), self.right), upper + np.triu(upper, 1).T

    def mean(self, method: str) -> FloatArray:
        """Posterior mean of all unknowns."""
        return np.asarray(cho_solve((self._factor(method), False), self.right))

    def _factor(self, method: str) -> FloatArray:
        try:
            return np.asarray(cho_factor(self.normal)[0])
        except np.linalg.LinAlgError:
            raise DivergenceError(f"{method}: the readings do not determine the deflection") from None


def whitened(one: Evidence, spline: Spline, place: dict[str, slice], inputs: Inputs) -> tuple[FloatArray, FloatArray]:
    """Rows ``(2 n, unknowns)`` of the least-squares problem and what they should give, errors of unit variance."""
    keep = np.isfinite(one.theta_yz_rad).all(axis=1)
    n, m = int(keep.sum()), spline.count
    value, second = spline.rows(one.time_s[keep]), spline.rows(one.time_s[keep], 2)
    swing = one.by_acceleration_s2[keep]
    rows = np.zeros((n, 2, 2 * m + max((p.stop for p in place.values()), default=0)))
    for axis in range(2):
        for other in range(2):
            rows[:, axis, other * m : (other + 1) * m] = swing[:, axis, other, None] * second
        rows[:, axis, axis * m : (axis + 1) * m] += value
    want = one.theta_yz_rad[keep].copy()
    for name, every in one.by_input.items():
        response = every[keep]
        rows[:, :, 2 * m + place[name].start : 2 * m + place[name].stop] = -response
        if name in inputs:
            want -= response @ inputs[name]
    share = means_over_spans(one.time_s[keep], one.averaged_s, one.time_s[keep][0])
    rows = (share @ rows.reshape(n, -1)).reshape(len(share), 2, -1)
    cov = np.einsum("bn,nij->bij", share**2, one.independent_cov[keep])
    cov += LEFT_OUT_RAD**2 * LEFT_OUT_TIME_S / one.averaged_s * np.eye(2)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    return (whiten @ rows).reshape(2 * len(share), -1), (whiten @ (share @ want)[:, :, None]).ravel()


def means_over_spans(time_s: FloatArray, width_s: float, from_s: float) -> FloatArray:
    """Weights (bins, n) of the means over spans of time, one of which begins at ``from_s``; empty ones are left out."""
    which = np.floor((time_s - from_s) / width_s + 1e-6).astype(int)
    _, which, count = np.unique(which, return_inverse=True, return_counts=True)
    out = np.zeros((len(count), len(time_s)))
    out[which, np.arange(len(time_s))] = 1.0 / count[which]
    return out


LEAST_SAMPLES = 8
MOST_INPUT_SD, SETTLED_SD, MOST_STEPS, WHOLE_STEPS = 8.0, 0.05, 30, 4
NEAR_S = 0.5  # an answer is given no further from a reading
CLOCK_STEP_S, FARTHEST_CLOCK_SD = 0.01, 3.0
MOVES = 1.75  # rms rate of the deflection against its sd; of noise alone it is 1
SMOOTH_RATE_HZ = 50.0

Read = Callable[[Inputs, Deflection | None], list[Evidence]]


class Method(Protocol):
    """Reads the deflection from a pulse where a mask says, linear about a deflection; inputs' responses on demand."""

    def __call__(
        self, pulse: PulseData, use: BoolArray, about_yz_rad: FloatArray | None, *, with_inputs: bool = True
    ) -> Evidence:
        """Return what it reads."""


@dataclass(frozen=True)
class Fused:
    """Posterior of the deflection and of what the methods lean on.

    Parameters
    ----------
    history : DeflectionHistory
        At the times of the method with most samples.
    learnt : Learnt
        Of the inputs, given all readings.
    correlation : (g, g) float
        Of the inputs' leading unit normals and of the deflection's two components at ``at_s``, in order of ``names``.
    names : tuple of str
    at_s : float
        Where the readings bear most: the time of the smallest deflection error.
    deflection : callable
        From times to lateral vectors (n, 2), rad.
    """

    history: DeflectionHistory
    learnt: Learnt
    correlation: FloatArray
    names: tuple[str, ...]
    at_s: float
    deflection: Deflection

    @property
    def inputs(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Mean (k,) and covariance (k, k) of each input's unit normals, given all readings."""
        known = self.learnt
        return {name: (known.mean[at], known.covariance[at, at]) for name, at in known.place.items()}


class FarInputsError(DivergenceError):
    """Readings agree only with inputs far beyond what is known of them: ``learnt`` says which."""

    def __init__(self, words: str, learnt: Learnt) -> None:
        super().__init__(words)
        self.learnt = learnt


def fuse(read: Read, method: str = "fused", at_s: FloatArray | None = None) -> Fused:
    """Fuse what the methods read; one method alone is smoothed.

    Parameters
    ----------
    read : callable
        From inputs, moved by so many standard deviations, and a deflection to be linear about (from times to lateral
        vectors; None: each method's own) to what the methods then read.
    method : str
        Name of the answer.
    at_s : (n,) float, optional
        Times of the answer, s; else those of the method with most samples.

    Raises
    ------
    DivergenceError
        Where there is too little to read, or the inputs do not settle.
    FarInputsError
        Where the readings ask for inputs far beyond what is known of them.
    """
    told = [e for e in read({}, None) if np.isfinite(e.theta_yz_rad).all(axis=1).sum() >= LEAST_SAMPLES]
    if not told:
        raise DivergenceError(f"{method}: no method has {LEAST_SAMPLES} readings of the deflection")
    methods = [e.method for e in told]
    # first every sample by itself, without what they share: a deflection to be linear about
    inputs: Inputs = _started_clock(told, method)
    span = _span(told)
    apart = [_apart(moved_evidence(e, inputs)) for e in told]
    problem = NormalEquations.of(apart, {}, span)
    found = problem.mean(method)
    for step in range(MOST_STEPS):
        told = [e for e in read(inputs, problem.deflection(found)) if e.method in methods]
        problem, before = NormalEquations.of(told, inputs, span), found
        found, covariance = problem.solved(method)
        size = 2 * problem.spline.count
        new = {name: found[size:][place] for name, place in problem.place.items()}
        sd = np.sqrt(np.diag(covariance))
        moved = float((np.abs(found[:size] - before[:size]) / sd[:size]).max())
        if FILM_CLOCK in new:
            clock = np.abs(new[FILM_CLOCK] - inputs.get(FILM_CLOCK, 0.0)) / sd[size:][problem.place[FILM_CLOCK]]
            moved = max(moved, float(clock.max()))
        if moved < SETTLED_SD and step > 0:
            learnt = Learnt(found[size:], covariance[size:, size:], problem.place)
            _check(new, learnt, method)
            times = max(told, key=lambda e: len(e.time_s)).time_s if at_s is None else at_s
            return _posterior(found, covariance, problem, learnt, told, method, times)
        # Newton's whole steps first, then half steps, which cannot swing to and fro
        part = 1.0 if step < WHOLE_STEPS else 0.5
        inputs = {name: part * x + (1.0 - part) * inputs.get(name, 0.0 * x) for name, x in new.items()}
    raise DivergenceError(
        f"{method}: the deflection does not settle: after {MOST_STEPS} steps it still moves by {moved:.2g} "
        "standard deviations; see each method's own answer"
    )


def smoothed(history: DeflectionHistory, rate_hz: float = SMOOTH_RATE_HZ) -> DeflectionHistory:
    """One method's history as a smooth one, every ``1 / rate_hz`` s: the joint as a second-order process.

    Between readings and through short holes its error bar grows; further than `NEAR_S` from a reading it has no answer.

    Raises
    ------
    DivergenceError
        Where there are too few readings.
    """
    known = history.time_s[np.isfinite(history.theta_rad)]
    if len(known) < LEAST_SAMPLES:
        raise DivergenceError(f"{history.method}: no smooth history of {len(known)} readings")
    first, last = np.ceil(known[0] * rate_hz), np.floor(known[-1] * rate_hz)
    one = evidence_of_history(history)
    return fuse(lambda _inputs, _about: [one], history.method, np.arange(first, last + 1.0) / rate_hz).history


def _apart(one: Evidence) -> Evidence:
    """Evidence whose every sample stands by itself."""
    return replace(one, by_input={}, independent_cov=one.covariance)


def _span(told: list[Evidence]) -> tuple[float, float]:
    """First and last time that any clock may mean."""
    wide = [FARTHEST_CLOCK_SD * e.clock_sd_s for e in told]
    low = min(e.time_s[0] - w for e, w in zip(told, wide, strict=True))
    return float(low), float(max(e.time_s[-1] + w for e, w in zip(told, wide, strict=True)))


def clock_is_seen(read: Read) -> bool:
    """Whether the deflection by the methods on the gyros' clock moves enough to tell another clock's offset.

    A deflection that stands still fits any offset, and the rate of what is but noise would fit a wrong one closely.
    """
    told = [e for e in read({}, None) if np.isfinite(e.theta_yz_rad).all(axis=1).sum() >= LEAST_SAMPLES]
    off, own = [e for e in told if e.clock_sd_s > 0.0], [e for e in told if e.clock_sd_s == 0.0]
    if not off or not own:
        return False
    span = _span(own)
    # what lasts in a reading does not move
    problem = NormalEquations.of([replace(e, by_input={}) for e in own], {}, span)
    try:
        found, covariance = problem.solved("clock")
    except DivergenceError:
        return False
    m = problem.spline.count
    time_s = np.concatenate([e.time_s for e in off])
    rows = problem.spline.rows(time_s[(time_s > span[0]) & (time_s < span[1])], 1)
    square = sum(float(np.sum((rows @ found[part]) ** 2)) for part in (slice(0, m), slice(m, 2 * m)))
    variance = sum(float(np.sum((rows @ covariance[p, p]) * rows)) for p in (slice(0, m), slice(m, 2 * m)))
    return square > MOVES**2 * variance


def _started_clock(told: list[Evidence], method: str) -> Inputs:
    """Offset of a clock that is not the gyros', in its standard deviations, to start from; none where it is theirs.

    The joint rings several times within what such a clock may be off: the sum of squares has a minimum at every swing,
    and the lowest is looked for, with the clock's own term. What lasts longer than `LIGHT_TIME_S` says nothing of it.
    """
    off, own = [e for e in told if e.clock_sd_s > 0.0], [e for e in told if e.clock_sd_s == 0.0]
    if not off or not own:
        return {}
    one, span = off[0], _span(own)
    problem = NormalEquations.of([_apart(e) for e in own], {}, span)
    bent = problem.deflection(problem.mean(method))
    reach = FARTHEST_CLOCK_SD * one.clock_sd_s
    late_s = np.arange(-np.ceil(reach / CLOCK_STEP_S), np.ceil(reach / CLOCK_STEP_S) + 1.0) * CLOCK_STEP_S
    inside = (one.time_s > span[0] + reach) & (one.time_s < span[1] - reach) & np.isfinite(one.theta_yz_rad[:, 0])
    time_s, read = one.time_s[inside], one.theta_yz_rad[inside]
    if len(time_s) < LEAST_SAMPLES:
        return {}
    window = max(3, round(LIGHT_TIME_S / float(np.median(np.diff(time_s)))))
    square = np.empty(len(late_s))
    for k, late in enumerate(late_s):
        off_rad = read - bent(time_s - late)
        square[k] = np.sum((off_rad - uniform_filter1d(off_rad, window, axis=0, mode="nearest")) ** 2)
    variance = float(square.min()) / (2.0 * len(time_s)) + LEFT_OUT_RAD**2
    best = int(np.argmin(square / variance + (late_s / one.clock_sd_s) ** 2))
    return {FILM_CLOCK: np.array([late_s[best] / one.clock_sd_s])}


def pulse_reader(
    pulse: PulseData, methods: dict[str, Method],
    others: list[Evidence],
) -> Read:  # fmt: skip
    """Return what `fuse` reads: methods that look at the pulse, and others whose readings are what they are.

    Inputs scale what was measured, and would scale its noise too, which no input can have made smaller: they act on
    the measurements' part that the spline can follow alone.
    """
    use = pulse.through_pulse
    smooth = _smoothed(pulse, use)

    def read(inputs: Inputs, about: Deflection | None) -> list[Evidence]:
        if about is None:
            return [*(method(pulse, use, None) for method in methods.values()), *others]
        at, moved, out = about(pulse.time_s[use]), corrected_pulse(smooth, use, inputs), []
        for method in methods.values():
            found = method(moved, use, at)
            raw, even = (method(one, use, at, with_inputs=False).theta_yz_rad for one in (pulse, smooth))
            out.append(replace(found, theta_yz_rad=found.theta_yz_rad + raw - even))
        return [*out, *(moved_evidence(other, inputs, about) for other in others)]

    return read


def _smoothed(pulse: PulseData, use: BoolArray) -> PulseData:
    """Pulse whose force, rate and angular acceleration are what a spline with `KNOT_S` can follow."""
    t = pulse.time_s[use]
    value = Spline.over(float(t[0]), float(t[-1])).rows(t)
    names = ("specific_force_body_mps2", "rate_body_radps", "angular_acceleration_body_radps2")
    moved = {}
    for name in names:
        moved[name] = getattr(pulse, name).copy()
        moved[name][use] = value @ lstsq(value, moved[name][use], lapack_driver="gelsy")[0]
    return replace(pulse, **moved)


def _check(inputs: Inputs, learnt: Learnt, method: str) -> None:
    for name, moved in inputs.items():
        worst = float(np.abs(moved).max())
        if not worst <= MOST_INPUT_SD:
            raise FarInputsError(
                f"{method}: the readings agree only if {name} is {worst:.0f} standard deviations off what is stated; "
                "check what the flight and vehicle files say of it, and each method's own answer",
                learnt,
            )


def _posterior(
    found: FloatArray,
    covariance: FloatArray,
    problem: NormalEquations,
    learnt: Learnt,
    told: list[Evidence],
    method: str,
    t: FloatArray,
) -> Fused:
    spline = problem.spline
    m, size = spline.count, 2 * spline.count
    read = np.concatenate([e.time_s for e in told])
    read.sort()
    after = np.searchsorted(read, t).clip(1, len(read) - 1)
    t = t[np.minimum(np.abs(read[after] - t), np.abs(t - read[after - 1])) <= NEAR_S]
    value = spline.rows(t)
    theta_yz = np.stack([value @ found[axis * m : (axis + 1) * m] for axis in range(2)], axis=-1)
    cov = np.zeros((len(t), 2, 2))
    for i in range(2):
        for j in range(2):
            block = covariance[i * m : (i + 1) * m, j * m : (j + 1) * m]
            cov[:, i, j] = np.sum((value @ block) * value, axis=1)
    words = f"from {', '.join(e.method for e in told)} with what they share; joint as a second-order process"
    history = history_from_lateral(t, theta_yz, cov, method, words)
    best = int(np.argmin(np.trace(cov, axis1=1, axis2=2)))
    pick = np.zeros((2 + len(problem.place), len(found)))
    pick[0, :m], pick[1, m:size] = value[best], value[best]
    for k, place in enumerate(problem.place.values()):
        pick[2 + k, size + place.start] = 1.0
    joint = pick @ covariance @ pick.T
    sd = np.sqrt(np.diag(joint))
    names = ("deflection y", "deflection z", *problem.place)
    return Fused(history, learnt, joint / np.outer(sd, sd), names, float(t[best]), problem.deflection(found))

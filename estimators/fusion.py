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
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.sparse import csr_array, eye_array, kron

from estimators.deflection_spline import (
    FREE_RADPS2,
    KNOT_S,
    InputPosterior,
    Inputs,
    NormalEquations,
    Rows,
    Solution,
    Spline,
    block_diagonal,
)
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

# neglected by the methods' equations, second order in the angles and gusts shorter than the wind's knots: with true
# inputs 0.01 to 0.02 deg rms over the pulses of thirty flights, decorrelated within half a second
LEFT_OUT_RAD, LEFT_OUT_TIME_S = np.deg2rad(0.02), 0.4
LEAST_SAMPLES = 8
_MOST_INPUT_SD, SETTLED_SD, MOST_STEPS, _WHOLE_STEPS = 8.0, 0.05, 30, 4
_NEAR_S = 0.5  # an answer is given no further from a reading
_BIAS_STEP_S, _FARTHEST_BIAS_SD = 0.01, 3.0  # of time biases tried: 0.16 rad of oscillation at 2.5 Hz; all but 0.3 %
MOVES = 1.75  # rms rate of the deflection over its sd; of noise alone it is 1
_SMOOTH_RATE_HZ = 50.0  # ten samples a period of a joint at 5 Hz
# The vehicle's pitching drives the deflection at up to 0.35 of the joint's frequency (four synthetic flights, stiffness
# 0.75 to 3 times the reference's), which twice as many readings resolve
_READINGS_A_SWING = 0.8
_HOLE = 1.5  # of the readings' usual spacing: one is missing
_LOCAL = 5  # readings about one, over which the swing's variance is taken
Read = Callable[[Inputs, Deflection | None], list[Evidence]]


def places(of: Iterable[dict[str, FloatArray]]) -> dict[str, slice]:
    """Place of each input's unit normals among all, of responses (n, c, k) by name."""
    out: dict[str, slice] = {}
    total = 0
    for name, response in (item for by_input in of for item in by_input.items()):
        if name not in out:
            out[name] = slice(total, total + response.shape[2])
            total = out[name].stop
    return out


def equations_of(
    readings: list[Evidence], inputs: Inputs, span_s: tuple[float, float], knot_s: float = KNOT_S
) -> NormalEquations:
    """Equations of the methods' readings at ``inputs``; the spline reaches over ``span_s``."""
    spline, place = Spline.over(*span_s, knot_s), places(e.by_input for e in readings)
    return NormalEquations.of_rows(spline, place, (whitened(one, spline, place, inputs) for one in readings))


def whitened(one: Evidence, spline: Spline, place: dict[str, slice], inputs: Inputs) -> Rows:
    """Rows of the least-squares problem of a method's readings, two of each."""
    keep = np.isfinite(one.theta_yz_rad).all(axis=1)
    n, by_lateral = int(keep.sum()), np.broadcast_to(np.eye(2), one.by_rate_s[keep].shape)
    by_deflection = spline.responses(one.time_s[keep], (by_lateral, one.by_rate_s[keep], one.by_acceleration_s2[keep]))
    by_input = np.zeros((n, 2, max((p.stop for p in place.values()), default=0)))
    want = one.theta_yz_rad[keep].copy()
    for name, every in one.by_input.items():
        response = every[keep]
        by_input[:, :, place[name]] = -response
        if name in inputs:
            want -= response @ inputs[name]
    share = shares_of_spans(one.time_s[keep], one.averaged_s, one.time_s[keep][0])
    cov = (share.power(2) @ one.independent_cov[keep].reshape(n, 4)).reshape(-1, 2, 2)
    cov += LEFT_OUT_RAD**2 * LEFT_OUT_TIME_S / one.averaged_s * np.eye(2)
    whiten = block_diagonal(np.linalg.inv(np.linalg.cholesky(cov)))
    return Rows(
        whiten @ (csr_array(kron(share, eye_array(2))) @ by_deflection),
        whiten @ (share @ by_input.reshape(n, -1)).reshape(whiten.shape[0], -1),
        whiten @ (share @ want).ravel(),
    )


def span_numbers(time_s: FloatArray, width_s: float, from_s: float) -> NDArray[np.int64]:
    """Index of the span that contains each time (n,); one span begins at ``from_s``."""
    return np.asarray(np.floor((time_s - from_s) / width_s + 1e-6).astype(np.int64))


def shares_of_spans(time_s: FloatArray, width_s: float, from_s: float) -> csr_array:
    """Weights (bins, n) of the means over spans of time, one of which begins at ``from_s``; empty ones are left out."""
    _, which, count = np.unique(span_numbers(time_s, width_s, from_s), return_inverse=True, return_counts=True)
    place = (which, np.arange(len(time_s)))
    return csr_array((1.0 / count[which], place), (len(count), len(time_s)))


class Method(Protocol):
    """Reads the deflection at all samples of loads, linear about a deflection; the inputs' responses on demand."""

    def __call__(self, loads: FlightLoads, about: Deflection | None = None, with_inputs: bool = True) -> Evidence:
        """Readings of the method."""


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
    knot_s: float = KNOT_S,
) -> tuple[DeflectionHistory, Solution]:
    """Fuse the methods' readings; one method alone is smoothed. Return the deflection's history, and the posterior.

    Parameters
    ----------
    read : callable
        From inputs, moved by so many standard deviations, and a deflection to be linear about (from times to lateral
        vectors; None: each method's own) to the methods' readings.
    method : str
        Name of the answer.
    at_s : (n,) float, optional
        Times of the answer, s; else those of the method with most samples, and as dense in its gaps.
    near_s : float
        An answer is given no further from a reading.
    free_process : bool
        False gives the process, of its most probable size, a say in the inputs: those of several films are the films'
        own errors, and the deflection does not step where one film ends. How far these are off is then not limited.
    knot_s : float
        Spacing of the spline's knots.

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
            f"{method}: no method has {LEAST_SAMPLES} readings of the deflection", code="too-few-data"
        )
    methods = [e.method for e in readings]
    # first every sample by itself, without shared errors: a deflection to be linear about
    inputs: Inputs = _initial_time_bias(readings, method, knot_s)
    span = span_of(readings)
    alone = [_uncorrelated(moved_evidence(e, inputs)) for e in readings]
    problem = equations_of(alone, {}, span, knot_s)
    answer, size_radps2 = problem.solved(problem.process_size(), method), FREE_RADPS2
    about = answer.deflection
    for step in range(MOST_STEPS):
        readings = [e for e in read(inputs, about) if e.method in methods]
        if min(np.isfinite(e.theta_yz_rad).all(axis=1).sum() for e in readings) < LEAST_SAMPLES:
            raise DivergenceError(
                f"{method}: the steps lead to deflections at which no method has an answer; see each method's own",
                code="not-converged",
            )
        problem, before = equations_of(readings, inputs, span, knot_s), answer.mean
        if not free_process and step < _WHOLE_STEPS:  # then held: its own small changes would go on moving the inputs
            size_radps2 = problem.process_size()
        answer = problem.solved(size_radps2, method)
        new = {name: mean for name, (mean, _) in answer.inputs.items()}
        moved = float((np.abs(answer.mean - before) / answer.sd).max())
        for name in {e.time_bias for e in readings} & new.keys():
            bias = np.abs(new[name] - inputs.get(name, 0.0)) / np.sqrt(np.diag(answer.inputs[name][1]))
            moved = max(moved, float(bias.max()))
        if moved < SETTLED_SD and step > 0:
            if free_process:
                _check_inputs(new, answer.input_posterior, method)
                answer = problem.smoothed(answer.input_posterior, method)
            densest = max(readings, key=lambda e: len(e.time_s)).time_s
            times = _without_holes(densest) if at_s is None else at_s
            times = times[_apart_from_readings(times, readings) <= near_s]
            sources = ", ".join(e.method for e in readings)
            remark = f"from {sources} with their shared errors; joint as a second-order process"
            theta_yz, cov = answer.deflection(times), answer.lateral_cov(times)
            return history_from_lateral(times, theta_yz, cov, method, remark), answer
        # whole Gauss-Newton steps first, then half steps, which cannot oscillate, about the smooth deflection: at the
        # ends of a long pulse the free one is off by ten degrees, where the methods are not linear, anew at each step
        part, smooth = 1.0 if step < _WHOLE_STEPS else 0.5, answer
        if free_process and step >= _WHOLE_STEPS:
            smooth = problem.smoothed(answer.input_posterior, method)
        about = smooth.deflection
        inputs = {name: part * x + (1.0 - part) * inputs.get(name, 0.0 * x) for name, x in new.items()}
    raise DivergenceError(
        f"{method}: the deflection did not converge: after {MOST_STEPS} steps it still moves by {moved:.2g} sd, where "
        f"{SETTLED_SD:g} are allowed; see each method's own answer",
        code="not-converged",
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
            code="too-few-data",
        )
    first, last = np.ceil(known[0] * rate_hz), np.floor(known[-1] * rate_hz)
    one = evidence_of_history(history)
    at_s, near_s = np.arange(first, last + 1.0) / rate_hz, 0.5 * HOLE_FACTOR * float(np.median(np.diff(known)))
    out, _ = fuse(lambda _inputs, _about: [one], history.method, at_s, max(near_s, _NEAR_S))
    return out if swing_hz is None else with_unresolved_swing(history, out, swing_hz)


def with_unresolved_swing(readings: DeflectionHistory, smooth: DeflectionHistory, swing_hz: float) -> DeflectionHistory:
    """Smooth history with the oscillation added to its sd where readings are too sparse to resolve it."""
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
    """Evidence with independent errors of all samples."""
    return replace(one, by_input={}, independent_cov=one.covariance)


def span_of(readings: list[Evidence]) -> tuple[float, float]:
    """First and last time of all readings, whatever their time biases."""
    wide = [_FARTHEST_BIAS_SD * e.time_bias_sd_s for e in readings]
    low = min(e.time_s[0] - w for e, w in zip(readings, wide, strict=True))
    return float(low), float(max(e.time_s[-1] + w for e, w in zip(readings, wide, strict=True)))


def time_bias_is_observable(read: Read, knot_s: float = KNOT_S) -> bool:
    """Whether the deflection by the methods with the gyros' time tags moves enough for a time bias to be observed.

    A constant deflection fits any time bias, and the rate of mere noise would fit a wrong one with a small sd.
    """
    readings = [e for e in read({}, None) if np.isfinite(e.theta_yz_rad).all(axis=1).sum() >= LEAST_SAMPLES]
    off, own = [e for e in readings if e.time_bias_sd_s > 0.0], [e for e in readings if e.time_bias_sd_s == 0.0]
    if not off or not own:
        return False
    span = span_of(own)
    # a constant error does not move
    problem = equations_of([replace(e, by_input={}) for e in own], {}, span, knot_s)
    try:
        answer = problem.solved(problem.process_size(), "camera time bias")
    except DivergenceError:
        return False
    time_s = np.concatenate([e.time_s for e in off])
    rows = problem.spline.rows(time_s[(time_s > span[0]) & (time_s < span[1])], 1)
    axes = slice(0, None, 2), slice(1, None, 2)
    square = sum(float(np.sum((rows @ answer.mean[axis]) ** 2)) for axis in axes)
    variance = sum(float((rows @ answer.own[axis, axis]).multiply(rows).sum()) for axis in axes)
    return square > MOVES**2 * variance


def _initial_time_bias(readings: list[Evidence], method: str, knot_s: float) -> Inputs:
    """Time bias to start from, in its standard deviations; none where all methods share the gyros' time tags.

    The joint oscillates several times within the bias's a priori sd: the sum of squares has a minimum at every period,
    and the lowest is looked for, with the prior's term. Errors longer than `LIGHT_TIME_S` carry no information on it.
    """
    off, own = [e for e in readings if e.time_bias_sd_s > 0.0], [e for e in readings if e.time_bias_sd_s == 0.0]
    if not off or not own:
        return {}
    span = span_of(own)
    problem = equations_of([_uncorrelated(e) for e in own], {}, span, knot_s)
    deflection = problem.solved(problem.process_size(), method).deflection
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


def knots_of(loads: FlightLoads) -> float:
    """Spacing, s, of knots that follow the vehicle's swing: a quarter of its period, `KNOT_S` at most."""
    return min(KNOT_S, loads.quarter_swing_s)


def loads_reader(loads: FlightLoads, methods: dict[str, Method], others: list[Evidence]) -> LoadsReader:
    """Reader of the loads through the pressure pulse."""
    pulse = loads.rows(loads.through_pulse)
    return LoadsReader(pulse, _smoothed_loads(pulse), methods, others)


def _smoothed_loads(loads: FlightLoads) -> FlightLoads:
    """Loads with force, rate and angular acceleration smoothed to a spline with the deflection's knots."""
    t = loads.time_s
    as_read = [loads.specific_force_body_mps2, loads.rate_body_radps, loads.angular_acceleration_body_radps2]
    smooth = Spline.over(float(t[0]), float(t[-1]), knots_of(loads)).smooth(t, np.hstack(as_read))
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


def _without_holes(time_s: FloatArray) -> FloatArray:
    """Times with gaps filled at the usual spacing."""
    step = np.diff(time_s)
    missing = np.round(step / np.median(step)).astype(np.int64) - 1
    hole = np.flatnonzero(missing > 0)
    more = [np.linspace(time_s[k], time_s[k + 1], missing[k] + 2)[1:-1] for k in hole]
    return np.sort(np.concatenate([time_s, *more]))


def _apart_from_readings(time_s: FloatArray, readings: list[Evidence]) -> FloatArray:
    """Distance (n,) of each time from the nearest reading of any method, s."""
    read = np.sort(np.concatenate([e.time_s for e in readings]))
    return np.abs(time_s - read[nearest_index(read, time_s)])

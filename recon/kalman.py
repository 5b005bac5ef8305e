"""How do measurements correct the state, and what do all of them say of every time? Linear Kalman filter and smoother.

`recon.linearise` makes a flight linear: errors ``x`` about a chart at each node. From node to node

    x_{k+1} = F_k x_k + u_k,   P_{k+1} = F_k P_k F_k^T + Q_k

and a measurement ``y = H x + noise`` is used where ``y - H x`` passes a chi-square gate, with the gain
``K = P H^T S^-1``, ``S = H P H^T + R``, in which the rows of considered errors are zero (Schmidt), so that

    P+ = (1 - K H) P (1 - K H)^T + K R K^T

(Joseph), by which a considered error keeps its own variance.

`forward` runs the filter about a reference trajectory, or, where there is none, about its own estimate: the same two
kernels by turns, node by node, which is the extended Kalman filter.

Sizes are those of `recon.linearise`. Symmetric matrices are stored as packed lower triangles. A prediction costs
``9 D N`` products instead of ``2 N^3``, since F is dense in nine rows alone.

Engines: ``"compiled"`` (the default, `filter_nodes`) and ``"filterpy"`` (`filterpy_nodes`), filterpy's filter on the
same arrays, in whose place another can be put. Measured speeds: docs/decisions/0007-two-engines.md.

Fixed-interval smoothing is by **Rauch, Tung and Striebel** on the stored priors. With the filter's prior
``P = P_{k+1|k}`` the textbook gain ``C = P_{k|k} F^T P^-1`` equals ``C = F^-1 (1 - Q P^-1)``, and

    x_{k|N} = x_{k|k} + C (x_{k+1|N} - x_{k+1|k})
    P_{k|N} = C P_{k+1|N} C^T + F^-1 (Q - Q P^-1 Q) F^-T

a sum of two positive terms: no difference of nearly equal covariances is formed. Constants (no noise) have unit rows
in ``C`` and stay exactly constant, so only the rows of *moving* errors are formed. ``P`` is scaled to a correlation
matrix before it is solved with.

It presumes optimal gains, which a filter that only *considers* some errors (Schmidt) has not: its own covariance is
still right, but a later change of everything else is taken as if considered errors could have changed with it. With a
considered scale of an accelerometer the result is ten times worse than the filter that it smooths. Then the
**two-filter** smoother is used: an information filter from the end,

    l- = l+ + L+ K y + H^T R^-1 y,     L- = L+ + H^T R^-1 H        (y: the forward filter's residual)
    l+ = F^T (1 + L- Q)^-1 l-,         L+ = F^T (1 + L- Q)^-1 L- F

holds the information of all later data on the errors of the forward estimate, and Schmidt's rule uses that as one
measurement,

    x_{k|N} = x_{k|k-1} + P_{k|k-1} (1 + L- P_{k|k-1})^-1 l-,     P_{k|N} = P_{k|k-1} (1 + L- P_{k|k-1})^-1

in the rows of the estimated errors; considered ones stay at zero with their own variance. It is never worse than the
filter, its covariance is exact, and without considered errors it equals Rauch-Tung-Striebel. The tests compare both
with the Bryson-Frazier smoother and with the conditioning of one joint Gaussian. Rauch-Tung-Striebel is compiled
(readable twin: `tests.oracles.plain_smoother`), the two-filter smoother exists in numpy alone.

References
----------
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
H. Rauch, F. Tung, C. Striebel, AIAA J. 3 (1965) 1445, eqs. (3.23)-(3.30).
D. Fraser, J. Potter, "The optimum linear smoother as a combination of two optimum linear filters", IEEE Trans.
Automatic Control 14 (1969) 387.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flightmodel import rotations
from flightmodel._kernels import inlined, kernel, multiply, small_cholesky, small_solve
from flightmodel.checks import BoolArray, DivergenceError, FloatArray, IntArray
from recon.linearise import (
    Linearised,
    Readings,
    Steps,
    flight_of,
    full_step,
    in_one_piece,
    linear_step,
    linearise,
    linearise_nodes,
    measured_rows,
    unfilled,
)
from recon.measurements import SLOTS
from recon.problem import Observed, Problem
from recon.settings import COMPILED, FILTERPY
from recon.state import KINEMATIC, States, Wander, boxminus, boxplus, packed, unpacked

LEAST_PIVOT = 1e-14  # of a correlation matrix; below it a direction is known exactly


class Filtered(NamedTuple):
    """Errors about the charts before and after each node's measurements, and their covariance.

    Parameters
    ----------
    x_minus, x_plus : (n, N) float
    p_minus : (n, N (N + 1) / 2) float
        Packed.
    kept : (n,) int
        Row of ``p_plus`` that holds a node's covariance; -1 where it is not wanted.
    p_plus : (k, D (D + 1) / 2) float
        Packed.
    p_last : (N, N) float
        After the last measurement.
    """

    x_minus: FloatArray
    x_plus: FloatArray
    p_minus: FloatArray
    kept: IntArray
    p_plus: FloatArray
    p_last: FloatArray


class Innovations(NamedTuple):
    """Innovation and gain of each measurement; components that were not measured are zero with unit variance.

    Parameters
    ----------
    residual, covariance : (M, 3), (M, 3, 3) float
    nis : (M,) float
    accepted : (M,) bool
    gain : (M, N, 3) float
        Zero where not accepted.
    """

    residual: FloatArray
    covariance: FloatArray
    nis: FloatArray
    accepted: BoolArray
    gain: FloatArray


@dataclass(frozen=True)
class ForwardPass:
    """What a flight looked like to the filter, and what the filter made of it, node by node."""

    charts: States
    steps: Steps
    readings: Readings
    filtered: Filtered
    innovations: Innovations

    def states(self) -> States:
        """Filtered states at every node."""
        return boxplus(self.charts, self.filtered.x_plus)


def forward(problem: Problem, reference: States | None = None, engine: str = COMPILED) -> ForwardPass:
    """Run the filter through all nodes, about its own estimate or about a reference trajectory."""
    if reference is not None:
        return filtered(problem, linearise(problem, reference), boxminus(problem.start, reference[0]), engine)
    n, flight, use = len(problem.time_s), flight_of(problem), ENGINES[engine]
    *_, sources, observed, wander = flight
    run, innovations = empty_answer(problem)
    line, x = unfilled(problem), np.zeros(problem.size)
    for k in range(n):
        linearise_nodes(*flight, k, k + 1, x, False, *line)
        use(observed, sources.slot, wander, problem.gate, k, k + 1, x, line.steps, line.readings, run, innovations)
    return forward_pass(line, run, innovations)


def filtered(problem: Problem, line: Linearised, x: FloatArray, engine: str = COMPILED) -> ForwardPass:
    """Run the filter through the nodes of a flight made linear, from the error ``x`` (N,) about its first chart."""
    *_, sources, observed, wander = flight_of(problem)
    run, innovations = empty_answer(problem)
    ENGINES[engine](
        observed, sources.slot, wander, problem.gate, 0, len(problem.time_s), x, line.steps, line.readings, run,
        innovations,
    )  # fmt: skip
    return forward_pass(line, run, innovations)


def forward_pass(line: Linearised, run: Filtered, innovations: Innovations) -> ForwardPass:
    """What was filtered, with charts that do not change the sign of a quaternion."""
    charts = States(*line.charts)
    charts = replace(charts, q_ecef_body=rotations.continuous(charts.q_ecef_body))
    return ForwardPass(charts, line.steps, line.readings, run, innovations)


def log_likelihood(problem: Problem, run: ForwardPass) -> tuple[float, float]:
    """Log likelihood of all measurements that the filter was offered, up to a constant, and their mean square.

    Of a filter that diverged it is minus infinity.
    """
    offered, found = problem.observed.usable, run.innovations
    count = np.isfinite(problem.observed.variance).sum(axis=1)[offered]
    nis, covariance = found.nis[offered], found.covariance[offered]
    if not (np.isfinite(nis).all() and np.isfinite(covariance).all()):
        return -np.inf, np.inf
    size = np.minimum(nis, problem.gate[count])
    _, log_det = np.linalg.slogdet(covariance)  # components that were not measured have unit variance there
    return float(-0.5 * (size + log_det).sum()), float(size.sum() / max(count.sum(), 1))


def empty_answer(problem: Problem) -> tuple[Filtered, Innovations]:
    """Arrays for one pass, of which the covariance is the start's."""
    n, size, dense, count = len(problem.time_s), problem.size, problem.dense, len(problem.row)
    kept: IntArray = np.full(n, -1, dtype=np.int64)
    kept[problem.kept] = np.arange(int(problem.kept.sum()))
    x_minus, x_plus, p_minus, p_plus, p_last = in_one_piece(
        (n, size), (n, size), (n, size * (size + 1) // 2), (int(problem.kept.sum()), dense * (dense + 1) // 2),
        (size, size),
    )  # fmt: skip
    p_last[:] = problem.start_covariance
    return Filtered(x_minus, x_plus, p_minus, kept, p_plus, p_last), Innovations(
        np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count), np.zeros(count, dtype=bool),
        np.zeros((count, size, 3)),
    )  # fmt: skip


@kernel
def filter_nodes(observed, slots, wander, gate, first, last, x, steps, readings, run, innovations):
    """Run the filter through the nodes ``first`` to ``last``, in place.

    ``x`` (N,) and ``run.p_last`` are the error and its covariance after the node before; of the first node, at the
    start. ``gate`` (4,) is the largest accepted NIS by number of components.
    """
    size, p = len(x), run.p_last
    ahead, rows = np.empty(size), np.empty((9, size))
    for k in range(first, last):
        if k > 0:
            a = k - 1
            linear_step(x, steps.transition[a], steps.decay[a], ahead)
            for j in range(size):
                x[j] = ahead[j] + steps.offset[a, j]
            predict_covariance(p, steps.transition[a], steps.noise[a], steps.decay[a], steps.noise_var[a], rows)
        store_triangle(p, size, run.p_minus[k])
        for j in range(size):
            run.x_minus[k, j] = x[j]
        if observed.first[k + 1] > observed.first[k]:
            update_node(observed, slots, wander, gate, k, x, p, readings, innovations)
        for j in range(size):
            run.x_plus[k, j] = x[j]
        if run.kept[k] >= 0:
            store_triangle(p, steps.transition.shape[2], run.p_plus[run.kept[k]])


@inlined
def predict_covariance(p, phi, noise, decay, noise_var, rows):
    """``P = F P F^T + Q`` in place; ``rows`` (9, N) is scratch."""
    size, dense = p.shape[0], phi.shape[1]
    for i in range(9):
        for j in range(size):
            rows[i, j] = 0.0
        for col in range(dense):
            f = phi[i, col]
            if f != 0.0:
                for j in range(size):
                    rows[i, j] += f * p[col, j]
    for i in range(9):
        for j in range(i + 1):
            value = noise[i, j]
            for col in range(dense):
                value += rows[i, col] * phi[j, col]
            p[i, j] = value
            p[j, i] = value
    moving = False
    for j in range(9, size):
        moving = moving or decay[j - 9] != 1.0 or noise_var[j - 9] > 0.0
        for i in range(9):
            value = rows[i, j] * decay[j - 9]
            p[i, j] = value
            p[j, i] = value
    if moving:
        for i in range(9, size):
            for j in range(9, size):
                p[i, j] *= decay[i - 9] * decay[j - 9]
            p[i, i] += noise_var[i - 9]


@inlined
def update_node(observed, slots, wander, gate, k, x, p, readings, innovations):
    """Use the measurements of node ``k`` that pass the gate."""
    size = len(x)
    half, y, used = np.empty(3), np.empty(3), np.empty(3, dtype=np.int64)
    s, factor, w = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, size))
    for row in range(observed.first[k], observed.first[k + 1]):
        slot = slots[observed.source[row]]
        by_state, by_error = readings.by_state[row], readings.by_error[row]
        count = 0
        for i in range(3):
            if not math.isinf(observed.variance[row, i]):
                used[count] = i
                y[count] = readings.off_chart[row, i] - times(by_state[i], by_error[i], slot, x)
                count += 1
        cross_covariance(p, by_state, by_error, slot, count, s, used, w)
        record(innovations, row, s, y, used, count, observed.variance[row])
        small_cholesky(s, count, factor)
        nis = 0.0
        for i in range(count):
            half[i] = y[i]
            for col in range(i):
                half[i] -= factor[i, col] * half[col]
            half[i] /= factor[i, i]
            nis += half[i] * half[i]
        innovations.nis[row] = nis
        innovations.accepted[row] = nis <= gate[count] and observed.usable[row]
        if innovations.accepted[row]:
            gain_and_update(x, p, w, y, factor, count, used, wander.considered, wander.sd, innovations.gain[row])


@inlined
def cross_covariance(p, by_state, by_error, slot, count, rows, used, w):
    """``w`` (3, N) = H P and ``H P H^T`` of the used components in the leading rows of the returned scratch."""
    size = p.shape[0]
    for r in range(count):
        i = used[r]
        for j in range(size):
            w[r, j] = 0.0
        for col in range(9):
            f = by_state[i, col]
            if f != 0.0:
                for j in range(size):
                    w[r, j] += f * p[col, j]
        for col in range(SLOTS):
            if slot[col] >= 0:
                f = by_error[i, col]
                if f != 0.0:
                    for j in range(size):
                        w[r, j] += f * p[9 + slot[col], j]
    for r in range(count):
        for t in range(count):
            rows[r, t] = times(by_state[used[t]], by_error[used[t]], slot, w[r])


@inlined
def times(by_state, by_error, slot, x):
    """One row of H times a vector (N,)."""
    value = 0.0
    for col in range(9):
        value += by_state[col] * x[col]
    for col in range(SLOTS):
        if slot[col] >= 0:
            value += by_error[col] * x[9 + slot[col]]
    return value


@inlined
def record(innovations, row, s, y, used, count, variance):
    """Add the noise to ``s`` and keep residual and covariance; components not measured are zero with unit variance."""
    for i in range(3):
        innovations.residual[row, i] = 0.0
        for j in range(3):
            innovations.covariance[row, i, j] = 1.0 if i == j else 0.0
    for r in range(count):
        s[r, r] += variance[used[r]]
        innovations.residual[row, used[r]] = y[r]
    for r in range(count):
        for t in range(count):
            innovations.covariance[row, used[r], used[t]] = s[r, t]


@inlined
def gain_and_update(x, p, w, y, factor, count, used, considered, wander_sd, gain):
    """Schmidt's update in place: ``K = P H^T S^-1``; considered errors get no gain and keep their own covariance."""
    size = len(x)
    column, k = np.empty(3), np.empty((3, size))
    any_considered = False
    for j in range(size):
        for r in range(count):
            column[r] = w[r, j]
        small_solve(factor, count, column)
        for r in range(count):
            k[r, j] = column[r]
    for i in range(size):
        for r in range(count):
            f = k[r, i]
            for j in range(size):
                p[i, j] -= f * w[r, j]
    for j in range(size):
        masked = j >= 9 and considered[j - 9]
        any_considered = any_considered or masked
        for r in range(count):
            gain[j, used[r]] = 0.0 if masked else k[r, j]
            x[j] += 0.0 if masked else k[r, j] * y[r]
    if any_considered:
        for i in range(9, size):
            for j in range(9, size):
                if considered[i - 9] and considered[j - 9]:
                    p[i, j] = wander_sd[i - 9] * wander_sd[i - 9] if i == j else 0.0
    for i in range(size):
        for j in range(i):
            value = 0.5 * (p[i, j] + p[j, i])
            p[i, j] = value
            p[j, i] = value


@inlined
def store_triangle(p, size, out):
    """Lower triangle of the leading rows of ``p`` into ``out``."""
    at = 0
    for i in range(size):
        for j in range(i + 1):
            out[at] = p[i, j]
            at += 1


def filterpy_nodes(
    observed: Observed, slots: IntArray, wander: Wander, gate: FloatArray, first: int, last: int, x: FloatArray,
    steps: Steps, readings: Readings, run: Filtered, innovations: Innovations,
) -> None:  # fmt: skip
    """As `filter_nodes`, by filterpy's filter; another with the same methods may stand in its place."""
    from filterpy.kalman import KalmanFilter

    one = KalmanFilter(len(x), 3)
    one.x, one.P, one.B = x.copy(), run.p_last.copy(), np.eye(len(x))
    for k in range(first, last):
        if k > 0:
            one.F, one.Q = full_step(steps, k - 1)
            one.predict(u=steps.offset[k - 1])
        run.x_minus[k], run.p_minus[k] = one.x, packed(one.P)
        for row in range(observed.first[k], observed.first[k + 1]):
            used, h = measured_rows(observed, slots, readings, row, len(x))
            noise = np.diag(observed.variance[row, used])
            y, s = readings.off_chart[row, used] - h @ one.x, h @ one.P @ h.T + noise
            innovations.residual[row], innovations.covariance[row] = 0.0, np.eye(3)
            innovations.residual[row, used], innovations.covariance[row][np.ix_(used, used)] = y, s
            innovations.nis[row] = y @ np.linalg.solve(s, y)
            innovations.accepted[row] = innovations.nis[row] <= gate[len(used)] and observed.usable[row]
            if innovations.accepted[row]:
                innovations.gain[row][:, used] = _updated(one, y, h, noise, wander.considered)
        run.x_plus[k] = one.x
        if run.kept[k] >= 0:
            dense = steps.transition.shape[2]
            run.p_plus[run.kept[k]] = packed(one.P[:dense, :dense])
    x[:], run.p_last[:] = one.x, one.P


def _updated(one: Any, y: FloatArray, h: FloatArray, noise: FloatArray, considered: BoolArray) -> FloatArray:
    """Update filterpy's filter by an innovation ``y`` and return the gain.

    Without considered errors the update is filterpy's own; its gain cannot be masked, so with them Joseph's form
    stands here.
    """
    if not considered.any():
        one.dim_z = len(y)
        one.update(y + h @ one.x, R=noise, H=h)
        one.P = 0.5 * (one.P + one.P.T)
        return np.asarray(one.K)
    gain = np.linalg.solve(h @ one.P @ h.T + noise, h @ one.P).T
    gain[KINEMATIC:][considered] = 0.0
    one.x = one.x + gain @ y
    rest = np.eye(len(one.x)) - gain @ h
    p = rest @ one.P @ rest.T + gain @ noise @ gain.T
    one.P = 0.5 * (p + p.T)
    return gain


ENGINES = {COMPILED: filter_nodes, FILTERPY: filterpy_nodes}


@dataclass(frozen=True)
class Smoothed:
    """Smoothed errors about the charts of a pass.

    Parameters
    ----------
    x : (n, N) float
    triangles : (k, D (D + 1) / 2) float
        Covariance of kinematic errors and drivers at the kept nodes, packed.
    variance : (k, N) float
        Of all errors there.
    """

    x: FloatArray
    triangles: FloatArray
    variance: FloatArray

    def states(self, charts: States) -> States:
        """Smoothed states at every node."""
        return boxplus(charts, self.x)


def smooth(problem: Problem, run: ForwardPass, with_covariance: bool = True) -> Smoothed:
    """Smooth a forward pass; without covariance where only a reference trajectory is wanted.

    Where errors are only considered this is `two_filter`, which exists in numpy alone.

    Raises
    ------
    DivergenceError
        Where readings are so far from the flight that what `two_filter` factors is no longer positive definite.
    """
    kept = int(problem.kept.sum()) if with_covariance else 0
    return _smoothed(problem, run, kept)


def smoothed_covariance(problem: Problem, run: ForwardPass, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Smoothed errors at all nodes (n, N) and their whole covariance at the kept ones (k, N, N)."""
    count = int(kept.sum())
    rows: IntArray = np.full(len(kept), -1, dtype=np.int64)
    rows[kept] = np.arange(count)
    phi = run.steps.transition
    # covariance is kept of errors that the motion depends on: of all, where all are columns
    wide = np.concatenate([phi, np.zeros((*phi.shape[:2], problem.size - phi.shape[2]))], axis=2)
    steps, filtered = run.steps._replace(transition=wide), run.filtered._replace(kept=rows)
    made = _smoothed(problem, replace(run, steps=steps, filtered=filtered), count)
    return made.x, unpacked(made.triangles)


def _smoothed(problem: Problem, run: ForwardPass, kept: int) -> Smoothed:
    """Smoothed errors, with moments of as many nodes as are ``kept``; of none where that is 0."""
    steps, filtered = run.steps, run.filtered
    dense = steps.transition.shape[2]
    triangles, variance = np.empty((kept, dense * (dense + 1) // 2)), np.empty((kept, problem.size))
    considered = KINEMATIC + np.flatnonzero(problem.model.wander.considered)
    if not len(considered):
        x = filtered.x_plus.copy()
        rauch_tung_striebel(steps, filtered, problem.moving, x, triangles, variance)
        return Smoothed(x, triangles, variance)
    x, slots = filtered.x_minus.copy(), problem.sources().slot
    try:
        two_filter(
            steps, filtered, problem.observed, slots, run.readings, run.innovations, considered, x, triangles, variance
        )
    except np.linalg.LinAlgError:
        words = "readings contradict the flight beyond what numbers hold. Check their units and signs"
        raise DivergenceError(f"reconstruction: diverged: {words}", "trajectory-diverged") from None
    return Smoothed(x, triangles, variance)


@kernel
def rauch_tung_striebel(steps, run, moving, x, covariance, variance):
    """Smooth backwards: errors ``x`` (n, N) in place of the filtered ones, moments at kept nodes where wanted.

    ``moving`` (d,) are the nine kinematic errors and Gauss-Markov ones. ``covariance`` (k, D (D + 1) / 2) is empty
    where only the mean is wanted.
    """
    n, size = x.shape
    d, dense = len(moving), steps.transition.shape[2]
    p, prior = run.p_last.copy(), np.empty((size, size))
    columns, gain, rows = np.empty((d, size)), np.empty((d, size)), np.empty((d, size))
    added, square, inverse = np.empty((d, d)), np.empty((9, 9)), np.empty((9, 9))
    scale, step = np.empty(size), np.empty(size)
    still = np.full(size, True)
    for r in range(d):
        still[moving[r]] = False
    wanted = len(covariance) > 0
    if wanted and run.kept[n - 1] >= 0:
        store_moments(p, dense, covariance[run.kept[n - 1]], variance[run.kept[n - 1]])
    for b in range(n - 1):
        k = n - 2 - b
        load_triangle(run.p_minus[k + 1], prior)
        backward_gain(
            steps.transition[k], steps.noise[k], steps.decay[k], steps.noise_var[k], moving, still,
            prior, columns, scale, square, inverse, gain, added,
        )  # fmt: skip
        for j in range(size):
            step[j] = x[k + 1, j] - run.x_minus[k + 1, j]
            x[k, j] += step[j]
        for r in range(d):
            value = 0.0
            for j in range(size):
                value += gain[r, j] * step[j]
            x[k, moving[r]] += value - step[moving[r]]
        if not wanted:
            continue
        multiply(gain, p, d, size, size, rows)
        for r in range(d):
            for t in range(r + 1):
                value = 0.5 * (added[r, t] + added[t, r])
                for j in range(size):
                    value += rows[r, j] * gain[t, j]
                added[r, t] = value
                added[t, r] = value
        for r in range(d):
            for j in range(size):
                p[moving[r], j] = rows[r, j]
                p[j, moving[r]] = rows[r, j]
        for r in range(d):
            for t in range(d):
                p[moving[r], moving[t]] = added[r, t]
        if run.kept[k] >= 0:
            store_moments(p, dense, covariance[run.kept[k]], variance[run.kept[k]])


@inlined
def backward_gain(phi, noise, decay, noise_var, moving, still, p, columns, scale, square, inverse, gain, added):
    """Gain rows (d, N) and added covariance (d, d) of one step; ``p`` (N, N) is the prior of the later node."""
    size, d, dense = p.shape[0], len(moving), phi.shape[1]
    for r in range(d):
        for j in range(size):
            columns[r, j] = 0.0
        if r < 9:
            for j in range(9):
                columns[r, j] = noise[r, j]
        else:
            columns[r, moving[r]] = noise_var[moving[r] - 9]
    solve_scaled(p, columns, scale)  # row r: P^-1 times column r of Q
    for r in range(d):
        for t in range(d):
            value = 0.0
            if r < 9:
                for col in range(9):
                    value += noise[r, col] * columns[t, col]
            else:
                value = noise_var[moving[r] - 9] * columns[t, moving[r]]
            q = noise[r, t] if r < 9 and t < 9 else (noise_var[moving[r] - 9] if r == t else 0.0)
            added[r, t] = q - value
        for j in range(size):
            gain[r, j] = -columns[r, j]
        gain[r, moving[r]] += 1.0
    for r in range(9, d):  # Gauss-Markov errors: 1 / decay
        f = 1.0 / decay[moving[r] - 9]
        for j in range(size):
            gain[r, j] *= f
        for t in range(d):
            added[r, t] *= f
        for t in range(d):
            added[t, r] *= f
    for j in range(9, dense):  # what drivers carry into the nine kinematic errors
        if still[j]:
            for i in range(9):
                gain[i, j] -= phi[i, j]
    for r in range(9, d):
        if moving[r] < dense:
            for i in range(9):
                f = phi[i, moving[r]]
                for j in range(size):
                    gain[i, j] -= f * gain[r, j]
                for t in range(d):
                    added[i, t] -= f * added[r, t]
    for r in range(9, d):
        if moving[r] < dense:
            for i in range(9):
                for t in range(d):
                    added[t, i] -= phi[i, moving[r]] * added[t, r]
    invert_kinematic(phi, square, inverse)
    multiply(inverse, gain, 9, 9, size, columns)
    for i in range(9):
        for j in range(size):
            gain[i, j] = columns[i, j]
    # A^-1 (added) A^-T, in the rows and columns of the nine
    for i in range(9):
        for t in range(d):
            columns[i, t] = 0.0
            for k in range(9):
                columns[i, t] += inverse[i, k] * added[k, t]
    for i in range(9):
        for t in range(9, d):
            added[i, t] = columns[i, t]
            added[t, i] = columns[i, t]
        for j in range(9):
            added[i, j] = 0.0
            for k in range(9):
                added[i, j] += columns[i, k] * inverse[j, k]


@inlined
def solve_scaled(p, columns, scale):
    """``columns = P^-1 columns`` by rows (d, N); ``p`` becomes the factor of the correlation matrix."""
    size = p.shape[0]
    for i in range(size):
        scale[i] = math.sqrt(p[i, i])
    for i in range(size):
        for j in range(i + 1):
            p[i, j] /= scale[i] * scale[j]
    for j in range(size):
        for i in range(j, size):
            value = p[i, j]
            for col in range(j):
                value -= p[i, col] * p[j, col]
            p[i, j] = value
        p[j, j] = math.sqrt(max(p[j, j], LEAST_PIVOT))
        for i in range(j + 1, size):
            p[i, j] /= p[j, j]
    for r in range(columns.shape[0]):
        y = columns[r]
        for i in range(size):
            value = y[i] / scale[i]
            for col in range(i):
                value -= p[i, col] * y[col]
            y[i] = value / p[i, i]
        for t in range(size):
            i = size - 1 - t
            value = y[i]
            for col in range(i + 1, size):
                value -= p[col, i] * y[col]
            y[i] = value / p[i, i]
        for i in range(size):
            y[i] /= scale[i]


@inlined
def invert_kinematic(phi, square, inverse):
    """Inverse (9, 9) of the kinematic square of ``phi`` by elimination; rows are exchanged for the largest pivot."""
    for i in range(9):
        for j in range(9):
            square[i, j] = phi[i, j]
            inverse[i, j] = 1.0 if i == j else 0.0
    for j in range(9):
        best = j
        for i in range(j + 1, 9):
            if abs(square[i, j]) > abs(square[best, j]):
                best = i
        if best != j:
            for col in range(9):
                square[j, col], square[best, col] = square[best, col], square[j, col]
                inverse[j, col], inverse[best, col] = inverse[best, col], inverse[j, col]
        f = 1.0 / square[j, j]
        for col in range(9):
            square[j, col] *= f
            inverse[j, col] *= f
        for i in range(9):
            if i != j:
                f = square[i, j]
                for col in range(9):
                    square[i, col] -= f * square[j, col]
                    inverse[i, col] -= f * inverse[j, col]


@inlined
def load_triangle(triangle, p):
    """Symmetric ``p`` (N, N) from its packed lower triangle."""
    at = 0
    for i in range(p.shape[0]):
        for j in range(i + 1):
            p[i, j] = triangle[at]
            p[j, i] = triangle[at]
            at += 1


@inlined
def store_moments(p, size, triangle, variance):
    """Lower triangle of the leading rows of ``p``, and its whole diagonal."""
    at = 0
    for i in range(size):
        for j in range(i + 1):
            triangle[at] = 0.5 * (p[i, j] + p[j, i])
            at += 1
    for i in range(p.shape[0]):
        variance[i] = p[i, i]


def keep_moments(run: Filtered, k: int, p: FloatArray, triangles: FloatArray, variance: FloatArray) -> None:
    """Store the moments of node ``k`` where they are wanted."""
    row = run.kept[k]
    if row >= 0 and len(triangles):
        dense = int(np.sqrt(2 * triangles.shape[1]))
        triangles[row], variance[row] = packed(p[:dense, :dense]), np.diag(p)


def _root(covariance: FloatArray) -> FloatArray:
    """Square root ``B`` with ``B B^T`` equal to a possibly singular covariance; computed from its correlations."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    return np.asarray(sd[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def two_filter(
    steps: Steps, run: Filtered, observed: Observed, slots: IntArray, readings: Readings, innovations: Innovations,
    considered: IntArray, x: FloatArray, triangles: FloatArray, variance: FloatArray,
) -> None:  # fmt: skip
    """Smooth ``x`` (n, N), which comes as the predicted errors, in place; moments at kept nodes where wanted."""
    n, size = x.shape
    mean, information = np.zeros(size), np.zeros((size, size))
    first, v = observed.first, innovations
    estimated = np.setdiff1d(np.arange(size), considered)
    for k in reversed(range(n)):
        for row in reversed(range(first[k], first[k + 1])):
            if not v.accepted[row]:
                continue
            used, h = measured_rows(observed, slots, readings, row, size)
            weight, y = h.T / observed.variance[row, used], v.residual[row, used]
            mean = mean + information @ (v.gain[row][:, used] @ y) + weight @ y
            information = information + weight @ h
        prior = unpacked(run.p_minus[k])
        b = _root(prior)
        whole = np.eye(size) + b.T @ information @ b
        half = np.linalg.solve(np.linalg.cholesky(0.5 * (whole + whole.T)), b.T)  # half^T half = P (1 + L P)^-1
        x[k, estimated] += (half.T @ (half @ mean))[estimated]
        if run.kept[k] >= 0 and len(triangles):
            p = half.T @ half
            p[np.ix_(considered, considered)] = prior[np.ix_(considered, considered)]
            keep_moments(run, k, p, triangles, variance)
        if k > 0:
            f, q = full_step(steps, k - 1)
            moving = np.flatnonzero(np.diag(q) > 0.0)
            b = np.zeros((size, len(moving)))
            b[moving] = _root(q[np.ix_(moving, moving)])
            j = np.linalg.solve(np.eye(len(moving)) + b.T @ information @ b, b.T @ information)
            rest = (np.eye(size) - b @ j) @ f  # (1 + L Q)^-T F; a sum of two positive terms, as in Joseph's form
            mean = rest.T @ mean
            information = rest.T @ information @ rest + f.T @ j.T @ j @ f
            information = 0.5 * (information + information.T)

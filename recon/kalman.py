"""How do measurements correct the state? A linear Kalman filter on plain arrays, with two engines of one algebra.

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

References
----------
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flightmodel import rotations
from flightmodel._kernels import inlined, kernel, small_cholesky, small_solve
from flightmodel.checks import BoolArray, FloatArray, IntArray
from recon import state
from recon.linearise import (
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
from recon.state import KINEMATIC, States, Wander, boxminus, packed


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
        return state.boxplus(self.charts, self.filtered.x_plus)


def forward(problem: Problem, reference: States | None = None, engine: str = COMPILED) -> ForwardPass:
    """Run the filter through all nodes, about its own estimate or about a reference trajectory."""
    n, flight, use = len(problem.time_s), flight_of(problem), ENGINES[engine]
    *_, sources, observed, wander = flight
    given = observed, sources.slot, wander, problem.gate
    run, innovations = empty_answer(problem)
    run.p_last[:] = problem.start_covariance
    if reference is not None:
        line, x = linearise(problem, reference), boxminus(problem.start, reference[0])
        use(*given, 0, n, x, line.steps, line.readings, run, innovations)
    else:
        line, x = unfilled(problem), np.zeros(problem.size)
        for k in range(n):
            linearise_nodes(*flight, k, k + 1, x, False, *line)
            use(*given, k, k + 1, x, line.steps, line.readings, run, innovations)
    charts = States(*line.charts)
    charts = replace(charts, q_ecef_body=rotations.continuous(charts.q_ecef_body))
    return ForwardPass(charts, line.steps, line.readings, run, innovations)


def empty_answer(problem: Problem) -> tuple[Filtered, Innovations]:
    """Arrays for one pass."""
    n, size, dense, count = len(problem.time_s), problem.size, problem.dense, len(problem.row)
    kept: IntArray = np.full(n, -1, dtype=np.int64)
    kept[problem.kept] = np.arange(int(problem.kept.sum()))
    x_minus, x_plus, p_minus, p_plus, p_last = in_one_piece(
        (n, size), (n, size), (n, size * (size + 1) // 2), (int(problem.kept.sum()), dense * (dense + 1) // 2),
        (size, size),
    )  # fmt: skip
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

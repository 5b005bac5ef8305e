"""What the data up to a time say: an extended Kalman filter on the error state, forward through all nodes.

Built on `filterpy.kalman.ExtendedKalmanFilter`, which predicts and updates; retraction, gate and bookkeeping are here.
At every node ``k`` errors ``x_k`` are coordinates about a nominal state (the *chart*). Between nodes

    x_{k+1} = F_k x_k + u_k + w_k,   F_k = transition of the strapdown, cov(w_k) = its process noise

First pass: the next chart is the propagated estimate, so ``u_k = -F_k x_k`` returns the error state to zero, and
``F_k`` contains the turn of the tangent plane. Later passes: the charts are the previous pass's smoothed states and
``u_k`` is the step from a chart's propagation to the next chart; iterating is Gauss-Newton on the whole flight
(the iterated extended Kalman smoother), which matters where attitude is off by ten degrees as the pulse sets in.

References
----------
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flightmodel.checks import FloatArray
from recon import _kernels
from recon.error_model import ErrorModel
from recon.measurements import RadarModel, predict_radar, residual
from recon.state import (
    INERTIAL,
    KINEMATIC,
    ROTATION,
    BoolArray,
    IntArray,
    States,
    boxminus,
    boxplus,
    right_jacobian,
    stack,
)
from recon.strapdown import InertialGrid, correct, propagate, propagate_all


@dataclass(frozen=True)
class Problem:
    """Everything the filter needs.

    Parameters
    ----------
    time_s : (n,) float
        Nodes, the first is the start.
    node_index : (n,) int
        Where each node stands in the grid.
    points : list of n lists of (int, (3,) float)
        Radar number and its range, azimuth, elevation at each node.
    start, start_covariance : States, (9 + m, 9 + m) float
    gate : float
        Largest normalised innovation squared that is used.
    """

    time_s: FloatArray
    node_index: IntArray
    grid: InertialGrid
    model: ErrorModel
    radars: list[RadarModel]
    points: list[list[tuple[int, FloatArray]]]
    start: States
    start_covariance: FloatArray
    gate: float

    def thinned(self, step_s: float) -> tuple[Problem, IntArray]:
        """Problem with at most one point of each radar every ``step_s``, and which nodes (k,) it keeps."""
        seen: dict[int, float] = {}
        points, keep = [], [0]
        for node, (t, here) in enumerate(zip(self.time_s, self.points, strict=True)):
            chosen = [(number, z) for number, z in here if np.floor(t / step_s) > seen.get(number, -np.inf)]
            for number, _ in chosen:
                seen[number] = float(np.floor(t / step_s))
            if chosen and node > 0:
                keep.append(node)
            if chosen or node == 0:
                points.append(chosen)
        index = np.array(keep)
        return replace(self, time_s=self.time_s[index], node_index=self.node_index[index], points=points), index


@dataclass(frozen=True)
class Innovations:
    """One row for each radar point: node, radar number, residual (3,), its covariance (3, 3), NIS, accepted."""

    node: IntArray
    radar: IntArray
    residual: FloatArray
    covariance: FloatArray
    nis: FloatArray
    accepted: BoolArray


@dataclass(frozen=True)
class ForwardPass:
    """What the smoother needs of a linear (or linearised) filter, node by node.

    Parameters
    ----------
    charts : States
        Nominal states.
    x_minus, x_plus : (n, N) float
        Errors about the charts before and after the node's measurements.
    p_minus : (n, N, N) float
    p_plus : (n, 27, 27) float
        Without the radars' errors.
    p_last : (N, N) float
        After the last node's measurements.
    transition : (n - 1, 9, 27) float
        Kinematic rows; sensor errors only decay.
    noise : (n - 1, 9, 9) float
        Kinematic process noise.
    decay, noise_var : (n - 1, m) float
        Of the sensor errors.
    innovations : Innovations
    """

    charts: States
    x_minus: FloatArray
    x_plus: FloatArray
    p_minus: FloatArray
    p_plus: FloatArray
    p_last: FloatArray
    transition: FloatArray
    noise: FloatArray
    decay: FloatArray
    noise_var: FloatArray
    innovations: Innovations

    def filtered(self) -> States:
        """Filtered states at every node."""
        return boxplus(self.charts, self.x_plus)


def forward(
    problem: Problem, reference: States | None = None, progress: Callable[[float], None] | None = None
) -> ForwardPass:
    """Run the filter through all nodes, about its own estimate or about a reference trajectory."""
    run = _Run(problem, reference)
    n = len(problem.time_s)
    for k in range(n):
        if k > 0:
            run.predict(k)
        run.update(k)
        if progress is not None and k % 500 == 0:
            progress(k / n)
    return run.result()


class _Run:
    """One forward pass in the making."""

    def __init__(self, problem: Problem, reference: States | None) -> None:
        from filterpy.kalman import ExtendedKalmanFilter

        n, size = len(problem.time_s), KINEMATIC + problem.model.size
        self.problem = problem
        self.reference = reference
        dt = np.diff(problem.time_s)
        self.decay = problem.model.decay(dt)
        self.noise_var = problem.model.noise_var(self.decay)
        self.transition = np.empty((n - 1, KINEMATIC, INERTIAL))
        self.noise = np.empty((n - 1, KINEMATIC, KINEMATIC))
        self.x_minus, self.x_plus = np.zeros((2, n, size))
        self.p_minus, self.p_plus = np.empty((n, size, size)), np.empty((n, INERTIAL, INERTIAL))
        self.charts: list[States] = []
        self.rows: list[tuple[int, int, FloatArray, FloatArray, float, bool]] = []

        self.ekf = ExtendedKalmanFilter(size, 3)
        self.ekf.x = np.zeros(size)
        self.ekf.P = problem.start_covariance.copy()
        self.ekf.F = np.eye(size)
        self.ekf.Q = np.zeros((size, size))
        self.ekf.B = np.eye(size)
        self.sensor_diagonal = np.arange(KINEMATIC, size)
        self.wandering = bool((self.decay < 1.0).any())
        if reference is None:
            self.charts.append(problem.start)
        else:
            self.ekf.x = boxminus(problem.start, reference[0])
            self._follow(reference)

    def _follow(self, reference: States) -> None:
        """Linearise every step about the reference at once."""
        step = propagate_all(self.problem.grid, self.problem.node_index, reference)
        self.transition[:] = step.transition
        self.noise[:] = step.noise
        reached = States(
            step.state.position_ecef_m,
            step.state.velocity_ecef_mps,
            step.state.q_ecef_body,
            reference.sensor_errors[:-1] * self.decay,
        )
        self.offset = boxminus(reached, reference[1:])
        self.rates = correct(
            self.problem.grid.rate_sensor_radps[self.problem.node_index],
            reference.sensor_errors[:, 9:18],
            self.problem.grid.dcm_body_rate,
        )
        self.charts = [reference[k] for k in range(len(self.problem.time_s))]

    def predict(self, k: int) -> None:
        """From node ``k - 1`` to node ``k``."""
        ekf, j = self.ekf, k - 1
        if self.reference is None:
            estimate = boxplus(self.charts[j], ekf.x)
            step = propagate(self.problem.grid, self.problem.node_index[j], self.problem.node_index[k], estimate)
            tangent = right_jacobian(ekf.x[ROTATION])
            self.transition[j] = step.transition
            self.transition[j][:, ROTATION] = step.transition[:, ROTATION] @ tangent
            self.noise[j] = step.noise
            state = step.state
            self.charts.append(
                States(
                    state.position_ecef_m,
                    state.velocity_ecef_mps,
                    state.q_ecef_body,
                    state.sensor_errors * self.decay[j],
                )
            )
        ekf.F[:KINEMATIC, :INERTIAL] = self.transition[j]
        ekf.Q[:KINEMATIC, :KINEMATIC] = self.noise[j]
        if self.wandering:
            ekf.F[self.sensor_diagonal, self.sensor_diagonal] = self.decay[j]
            ekf.Q[self.sensor_diagonal, self.sensor_diagonal] = self.noise_var[j]
        offset = -(ekf.F @ ekf.x) if self.reference is None else self.offset[j]
        ekf.predict(u=offset)

    def update(self, k: int) -> None:
        """Use the radar points of node ``k`` that pass the gate."""
        ekf, problem, chart = self.ekf, self.problem, self.charts[k]
        ekf.P = 0.5 * (ekf.P + ekf.P.T)
        self.x_minus[k], self.p_minus[k] = ekf.x, ekf.P
        points = problem.points[k]
        rate = self._rate(k) if points else np.zeros(3)
        for number, measured in points:
            radar = problem.radars[number]
            h, jacobian = predict_radar(radar, chart, rate)
            y = residual(measured, h) - jacobian @ ekf.x
            noise_var = radar.noise_var(h[2])
            cov = jacobian @ ekf.P @ jacobian.T + noise_var
            nis = _kernels.normalised_square(y, cov)
            accepted = nis <= problem.gate
            self.rows.append((k, number, y, cov, nis, accepted))
            if accepted:
                _update(ekf, y, jacobian, noise_var)
        self.x_plus[k], self.p_plus[k] = ekf.x, ekf.P[:INERTIAL, :INERTIAL]

    def _rate(self, k: int) -> FloatArray:
        """Rate of the body against inertial space (3,) at a node."""
        if self.reference is not None:
            return self.rates[k]
        grid = self.problem.grid
        measured = grid.rate_sensor_radps[self.problem.node_index[k]]
        return correct(measured[None], self.charts[k].sensor_errors[9:18], grid.dcm_body_rate)[0]

    def result(self) -> ForwardPass:
        """Everything as arrays."""
        node, radar, y, cov, nis, accepted = (list(c) for c in zip(*self.rows, strict=True))
        innovations = Innovations(
            np.array(node), np.array(radar), np.array(y), np.array(cov), np.array(nis), np.array(accepted)
        )
        return ForwardPass(
            stack(self.charts),
            self.x_minus,
            self.x_plus,
            self.p_minus,
            self.p_plus,
            self.ekf.P.copy(),
            self.transition,
            self.noise,
            self.decay,
            self.noise_var,
            innovations,
        )


def _update(ekf: object, innovation: FloatArray, jacobian: FloatArray, noise_var: FloatArray) -> None:
    """One update of filterpy's filter with an innovation that is known already."""
    ekf.update(  # type: ignore[attr-defined]
        innovation, lambda _x: jacobian, lambda _x: np.zeros(len(innovation)), R=noise_var
    )

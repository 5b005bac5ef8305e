"""How do measurements correct the state? The error-state extended Kalman filter, with two engines of one algebra.

The filter's state is the error about a nominal state at each node, its *chart*. In the first pass the chart is the
prediction itself; in later passes it is the smoothed trajectory of the pass before, about which everything is
linearised (iterated Kalman smoothing). In both cases a step is affine,

    x_{k+1} = F_k x_k + u_k,   P_{k+1} = F_k P_k F_k^T + Q_k

and a measurement is ``y = z - h(chart) = H x + noise``; it is used where ``y - H x`` passes a chi-square gate, with
the gain ``K = P H^T S^-1`` in which the rows of considered errors are zero (Schmidt), so that

    P+ = (1 - K H) P (1 - K H)^T + K R K^T

(Joseph), by which a considered error keeps its own variance.

Engines: ``"compiled"`` (the default, `recon._filter_kernels`) and ``"filterpy"``, filterpy's `ExtendedKalmanFilter`
with sensor models in numpy, which is also where another filter can be put in its place. Both step the nominal state by
the same compiled mechanisation. Measured speeds: docs/decisions/0007-two-engines.md.

References
----------
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray
from recon import _filter_kernels, _measurement_kernels
from recon._measurement_kernels import SLOTS
from recon.measurements import NodeMotion, predict, wrapped
from recon.problem import Problem
from recon.propagation import propagate
from recon.state import (
    KINEMATIC,
    ROTATION,
    Charts,
    Filtered,
    Innovations,
    IntArray,
    States,
    Steps,
    boxminus,
    boxplus,
    packed,
    right_jacobian,
)

COMPILED, FILTERPY = ENGINES = ("compiled", "filterpy")


@dataclass(frozen=True)
class ForwardPass:
    """What the smoother needs of a linear (or linearised) filter, node by node; see `recon.state`."""

    charts: States
    steps: Steps
    filtered: Filtered
    innovations: Innovations

    def states(self) -> States:
        """Filtered states at every node."""
        return boxplus(self.charts, self.filtered.x_plus)


def forward(problem: Problem, reference: States | None = None, engine: str = COMPILED) -> ForwardPass:
    """Run the filter through all nodes, about its own estimate or about a reference trajectory."""
    steps, run, innovations = empty_pass(problem)
    n = len(problem.time_s)
    if reference is None:
        charts = Charts(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)), np.empty((n, problem.model.size)))
        for part, value in zip(charts, as_charts(problem.start), strict=True):
            part[0] = value
        start = np.zeros(problem.size)
    else:
        charts = Charts(*(np.array(part, order="C") for part in as_charts(reference)))
        start = boxminus(problem.start, reference[0])
    run.p_last[:] = problem.start_covariance
    if engine == COMPILED:
        _filter_kernels.forward(
            *problem.motion.split(), problem.node_index, problem.sources(), problem.observed, problem.model.wander,
            problem.gate, reference is not None, start, steps, charts, run, innovations,
        )  # fmt: skip
    else:
        _FilterpyPass(problem, reference is not None, start, steps, charts, run, innovations).run_all()
    states = States(charts.position, charts.velocity, rotations.continuous(charts.q), charts.errors)
    return ForwardPass(states, steps, run, innovations)


def as_charts(states: States) -> Charts:
    """Arrays of states."""
    return Charts(states.position_ecef_m, states.velocity_ecef_mps, states.q_ecef_body, states.sensor_errors)


def empty_pass(problem: Problem) -> tuple[Steps, Filtered, Innovations]:
    """Arrays for one pass."""
    n, size, dense, m = len(problem.time_s), problem.size, problem.dense, problem.model.size
    count = len(problem.row)
    kept: IntArray = np.full(n, -1, dtype=np.int64)
    kept[problem.kept] = np.arange(int(problem.kept.sum()))
    steps = Steps(np.empty((n - 1, 9, dense)), np.empty((n - 1, 9, 9)), np.empty((n - 1, m)), np.empty((n - 1, m)))
    run = Filtered(
        np.empty((n, size)),
        np.empty((n, size)),
        np.empty((n, size * (size + 1) // 2)),
        kept,
        np.empty((int(problem.kept.sum()), dense * (dense + 1) // 2)),
        np.empty((size, size)),
    )
    innovations = Innovations(
        np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count), np.zeros(count, dtype=bool),
        np.zeros((count, size, 3)), np.zeros((count, 3, 9)), np.zeros((count, 3, SLOTS)),
    )  # fmt: skip
    return steps, run, innovations


class _FilterpyPass:
    """One forward pass on filterpy's `ExtendedKalmanFilter`."""

    def __init__(
        self,
        problem: Problem,
        follow: bool,
        start: FloatArray,
        steps: Steps,
        charts: Charts,
        run: Filtered,
        innovations: Innovations,
    ) -> None:
        self.problem, self.follow = problem, follow
        self.steps, self.charts, self.run, self.innovations = steps, charts, run, innovations
        self.ekf = make_filter(problem.size, start, run.p_last.copy())
        self.wander = problem.model.wander
        self.considered = KINEMATIC + np.flatnonzero(self.wander.considered)
        self.slots = [i.slots(problem.model) for i in problem.instruments]

    def run_all(self) -> None:
        """All nodes in turn."""
        for k in range(len(self.problem.time_s)):
            if k > 0:
                self.predict(k)
            self.run.x_minus[k], self.run.p_minus[k] = self.ekf.x, packed(self.ekf.P)
            for row in range(self.problem.observed.first[k], self.problem.observed.first[k + 1]):
                self.update(k, row)
            self.run.x_plus[k] = self.ekf.x
            if self.run.kept[k] >= 0:
                dense = self.problem.dense
                self.run.p_plus[self.run.kept[k]] = packed(self.ekf.P[:dense, :dense])
        self.run.p_last[:] = self.ekf.P

    def chart(self, k: int) -> States:
        """Nominal state of a node."""
        return States(*(part[k] for part in self.charts))

    def predict(self, k: int) -> None:
        """From node ``k - 1`` to node ``k``."""
        problem, ekf, j = self.problem, self.ekf, k - 1
        estimate = self.chart(j) if self.follow else boxplus(self.chart(j), ekf.x)
        step = propagate(problem.motion, problem.node_index[j], problem.node_index[k], estimate)
        phi = step.transition
        if not self.follow:
            phi[:, ROTATION] = phi[:, ROTATION] @ right_jacobian(ekf.x[ROTATION])
        climb = abs(height(step.state) - height(estimate))
        decay, noise_var = self._decay(problem.time_s[k] - problem.time_s[j], climb)
        reached = States(*as_charts(step.state)[:3], step.state.sensor_errors * decay)
        self.steps.transition[j], self.steps.noise[j] = phi, step.noise
        self.steps.decay[j], self.steps.noise_var[j] = decay, noise_var

        ekf.F = np.diag(np.concatenate([np.ones(KINEMATIC), decay]))
        ekf.F[:KINEMATIC, : problem.dense] = phi
        ekf.Q = np.diag(np.concatenate([np.zeros(KINEMATIC), noise_var]))
        ekf.Q[:KINEMATIC, :KINEMATIC] = step.noise
        if self.follow:
            ekf.predict(u=boxminus(reached, self.chart(k)))
            return
        for part, value in zip(self.charts, as_charts(reached), strict=True):
            part[k] = value
        ekf.predict(u=-(ekf.F @ ekf.x))

    def _decay(self, dt_s: float, climb_m: float) -> tuple[FloatArray, FloatArray]:
        """Decay of each error over a step, and the variance that comes new."""
        w = self.wander
        decay = np.maximum(_filter_kernels.LEAST_DECAY, np.exp(-dt_s / w.time_constant_s - climb_m / w.altitude_m))
        stays = np.isinf(w.time_constant_s) & np.isinf(w.altitude_m)
        return decay, np.where(stays, w.walk_var_per_s * dt_s, w.sd**2 * (1.0 - decay**2))

    def node_motion(self, k: int) -> NodeMotion:
        """Motion of a node, as measurements are predicted from it."""
        chart = self.chart(k)
        rate, acceleration = np.empty(3), np.empty(3)
        _measurement_kernels.motion_at(
            *self.problem.motion.split(), self.problem.node_index[k], *as_charts(chart), rate, acceleration
        )
        c = rotations.dcm_from_q(chart.q_ecef_body)
        return NodeMotion(chart.position_ecef_m, chart.velocity_ecef_mps, c, rate, acceleration)

    def update(self, k: int, row: int) -> None:
        """Use one measurement if it passes the gate."""
        ekf, observed = self.ekf, self.problem.observed
        source = observed.source[row]
        instrument, slot = self.problem.instruments[source], self.slots[source]
        there = slot >= 0
        e = np.where(there, self.charts.errors[k][slot], 0.0)
        h, by_state, by_error = predict(instrument, observed.known[row], e, self.node_motion(k))
        jacobian = np.zeros((3, self.problem.size))
        jacobian[:, :KINEMATIC] = by_state
        jacobian[:, KINEMATIC + slot[there]] += by_error[:, there]
        used = np.flatnonzero(np.isfinite(observed.variance[row]))
        jacobian, noise = jacobian[used], np.diag(observed.variance[row, used])
        y = wrapped(instrument.kind, observed.value[row] - h)[used] - jacobian @ ekf.x
        s = jacobian @ ekf.P @ jacobian.T + noise
        nis = float(y @ np.linalg.solve(s, y))
        accepted = bool(nis <= self.problem.gate[len(used)] and observed.usable[row])

        out, both = self.innovations, np.ix_(used, used)
        out.residual[row], out.covariance[row] = 0.0, np.eye(3)
        out.residual[row, used], out.covariance[row][both] = y, s
        out.nis[row], out.accepted[row] = nis, accepted
        out.by_state[row], out.by_error[row] = by_state, by_error
        if accepted:
            gain = schmidt_update(ekf, y, jacobian, noise, self.considered)
            out.gain[row][:, used] = gain


def make_filter(size: int, x: FloatArray, p: FloatArray) -> Any:
    """Filterpy's extended Kalman filter at its start; another filter with the same methods may stand here."""
    from filterpy.kalman import ExtendedKalmanFilter

    ekf = ExtendedKalmanFilter(size, 3)
    ekf.x, ekf.P, ekf.B = x.copy(), p.copy(), np.eye(size)
    return ekf


def schmidt_update(
    ekf: Any, innovation: FloatArray, jacobian: FloatArray, noise: FloatArray, considered: IntArray
) -> FloatArray:
    """Update filterpy's filter by a known innovation; errors that are only considered get no gain. Returns the gain.

    Without considered errors this is filterpy's own update; its gain cannot be masked, so with them Joseph's form
    stands here.
    """
    if len(considered) == 0:
        ekf.update(innovation, lambda _x: jacobian, lambda _x: np.zeros(len(innovation)), R=noise)
        ekf.P = 0.5 * (ekf.P + ekf.P.T)
        return np.asarray(ekf.K)
    s = jacobian @ ekf.P @ jacobian.T + noise
    gain = np.linalg.solve(s, jacobian @ ekf.P).T
    gain[considered] = 0.0
    ekf.x = ekf.x + gain @ innovation
    rest = np.eye(len(ekf.x)) - gain @ jacobian
    p = rest @ ekf.P @ rest.T + gain @ noise @ gain.T
    ekf.P = 0.5 * (p + p.T)
    return np.asarray(gain)


def height(state: States) -> float:
    """Geodetic height of one state, m."""
    return float(_filter_kernels.height(state.position_ecef_m))

"""How do measurements correct the state? The error-state extended Kalman filter, with two engines of one algebra.

The filter's state is the error about a nominal state at each node, its *chart*. In the first pass the chart is the
prediction itself; in later passes it is the smoothed trajectory of the pass before, about which everything is
linearised (iterated Kalman smoothing). In both cases a step is affine,

    x_{k+1} = F_k x_k + u_k,   P_{k+1} = F_k P_k F_k^T + Q_k

and a measurement is ``y = z - h(chart) = H x + noise``; it is used where ``y - H x`` passes a chi-square gate, with
the gain ``K = P H^T S^-1`` in which the rows of considered errors are zero (Schmidt), so that

    P+ = (1 - K H) P (1 - K H)^T + K R K^T

(Joseph), by which a considered error keeps its own variance.

A pass is plain tuples of arrays, which both engines take: ``n`` nodes, ``M`` measurements, ``m`` errors beside the nine
kinematic ones (``N = 9 + m``), the first ``s`` of them drivers of the motion (`recon.propagation`), ``D = 9 + s``.
Symmetric matrices are stored as packed lower triangles. A `Problem` is all that a pass is given.

Engines: ``"compiled"`` (the default, `recon._filter_kernels`) and ``"filterpy"``, the forward pass by filterpy's
`ExtendedKalmanFilter`, in whose place another filter can be put. Both take steps and measurements as the same compiled
kernels linearise them. Measured speeds: docs/decisions/0007-two-engines.md.

References
----------
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flightmodel import rotations
from flightmodel.checks import BoolArray, FloatArray, IntArray
from flightmodel.trajectory import nearest_index
from recon import _filter_kernels
from recon._measurement_kernels import RADAR, SLOTS
from recon.measurements import Instrument, servo_lag, wrapped
from recon.propagation import SAME_INSTANT_S, Motion
from recon.settings import COMPILED
from recon.state import KINEMATIC, ErrorModel, States, boxminus, boxplus, packed

FIT_SPAN_S = 3.0  # of the track points that the start is fitted to


class Sources(NamedTuple):
    """Instruments, one row each: kind, lever arm, place, axes, and which error (-1: none) fills each of its slots."""

    kind: IntArray
    arm_body_m: FloatArray
    site_ecef_m: FloatArray
    dcm: FloatArray
    slot: IntArray


class Observed(NamedTuple):
    """Measurements in order of nodes; those of node ``k`` are rows ``first[k]`` to ``first[k + 1]``.

    Parameters
    ----------
    first : (n + 1,) int
    source : (M,) int
    value, variance : (M, 3) float
        Variance is infinite where a component was not measured.
    known : (M, 3) float
        Field or direction to the Sun, Earth-fixed axes; of a radar, the refractivity at its site, and the lag of both
        angles behind the path about which the filter is linearised.
    usable : (M,) bool
        Whether the filter may use it at all.
    """

    first: IntArray
    source: IntArray
    value: FloatArray
    variance: FloatArray
    known: FloatArray
    usable: BoolArray


class Charts(NamedTuple):
    """Nominal states at all nodes: position, velocity (n, 3), attitude (n, 4), errors (n, m)."""

    position: FloatArray
    velocity: FloatArray
    q: FloatArray
    errors: FloatArray


class Steps(NamedTuple):
    """Each node to the next: transition (n - 1, 9, D), noise (n - 1, 9, 9), decay and noise of errors (n - 1, m)."""

    transition: FloatArray
    noise: FloatArray
    decay: FloatArray
    noise_var: FloatArray


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
    by_state, by_error : (M, 3, 9), (M, 3, SLOTS) float
        Partials of the prediction.
    """

    residual: FloatArray
    covariance: FloatArray
    nis: FloatArray
    accepted: BoolArray
    gain: FloatArray
    by_state: FloatArray
    by_error: FloatArray


@dataclass(frozen=True)
class Problem:
    """Everything the filter needs.

    Parameters
    ----------
    time_s : (n,) float
        Nodes, the first is the start.
    node_index : (n,) int
        Where each node stands in the motion's grid.
    instruments : tuple of Instrument
    row : (M,) int
        Which of its instrument's measurements each observation is.
    observed : Observed
        All measurements by node.
    start, start_covariance : States, (9 + m, 9 + m) float
    gate : (4,) float
        Largest normalised innovation squared that is used, by number of components.
    kept : (n,) bool
        Nodes at which covariances are wanted.
    """

    time_s: FloatArray
    node_index: IntArray
    motion: Motion
    model: ErrorModel
    instruments: tuple[Instrument, ...]
    row: IntArray
    observed: Observed
    start: States
    start_covariance: FloatArray
    gate: FloatArray
    kept: BoolArray

    @property
    def size(self) -> int:
        """Number of errors in all."""
        return KINEMATIC + self.model.size

    @property
    def dense(self) -> int:
        """Kinematic errors and drivers."""
        return KINEMATIC + self.motion.drivers

    @property
    def node(self) -> IntArray:
        """Node of every measurement, (M,)."""
        return np.repeat(np.arange(len(self.time_s)), np.diff(self.observed.first))

    @property
    def moving(self) -> IntArray:
        """Errors that change: the nine kinematic ones and Gauss-Markov ones."""
        return np.concatenate([np.arange(KINEMATIC), KINEMATIC + self.model.wandering])

    def sources(self) -> Sources:
        """Instruments as arrays."""
        return Sources(  # shaped where there is no instrument, too
            np.array([i.kind for i in self.instruments], dtype=np.int64),
            np.array([i.arm_body_m for i in self.instruments]).reshape(-1, 3),
            np.array([i.site_ecef_m for i in self.instruments]).reshape(-1, 3),
            np.array([i.dcm for i in self.instruments]).reshape(-1, 3, 3),
            np.array([i.slots(self.model) for i in self.instruments], dtype=np.int64).reshape(-1, SLOTS),
        )

    @property
    def group(self) -> IntArray:
        """Group of components (M,) that each measurement is of."""
        return np.array(
            [self.instruments[s].group[r] for s, r in zip(self.observed.source, self.row, strict=True)], dtype=np.int64
        )

    def without(self, unusable: BoolArray) -> Problem:
        """Same problem in which some measurements (M,) are only predicted, never used."""
        return replace(self, observed=self.observed._replace(usable=self.observed.usable & ~unusable))

    def thinned(self, step_s: float) -> tuple[Problem, IntArray]:
        """Problem with at most one used measurement of an instrument every ``step_s``, and the nodes (k,) it keeps.

        Components with rows of their own count as instruments.

        A node of every step stays even where nothing is measured: after a long step a decorrelated error cannot be
        smoothed.
        """
        node, used = self.node, np.flatnonzero(self.observed.usable)
        cell = np.floor(self.time_s[node[used]] / step_s).astype(np.int64)
        _, first = np.unique(
            np.column_stack([self.observed.source[used], self.group[used], cell]), axis=0, return_index=True
        )
        chosen = np.sort(used[first])
        _, first_of_step = np.unique(np.floor(self.time_s / step_s), return_index=True)
        index = np.unique(np.concatenate([first_of_step, node[chosen]])).astype(np.int64)
        observed = self.observed
        thin = Observed(
            np.searchsorted(node[chosen], np.concatenate([index, [len(self.time_s)]])).astype(np.int64),
            observed.source[chosen],
            observed.value[chosen],
            observed.variance[chosen],
            observed.known[chosen],
            observed.usable[chosen],
        )
        return (
            replace(
                self,
                time_s=self.time_s[index],
                node_index=self.node_index[index],
                row=self.row[chosen],
                observed=thin,
                kept=np.zeros(len(index), dtype=bool),
            ),
            index,
        )


def with_servo_lag(problem: Problem, states: States | None) -> Problem:
    """Problem whose radars lag behind a path through all its nodes; as it is without servos, or a path."""
    lagging = [k for k, one in enumerate(problem.instruments) if one.kind == RADAR and one.servo_hz > 0.0]
    if states is None or not lagging or len(problem.time_s) < 4:
        return problem
    known, at_s = problem.observed.known.copy(), problem.time_s[problem.node]
    for number in lagging:
        mine = problem.observed.source == number
        known[mine, 1:] = servo_lag(problem.instruments[number], problem.time_s, states, at_s[mine])
    return replace(problem, observed=problem.observed._replace(known=known))


def observe(time_s: FloatArray, instruments: tuple[Instrument, ...]) -> tuple[Observed, IntArray]:
    """All measurements of instruments that lie on nodes (within `SAME_INSTANT_S`), by node, and their rows (M,)."""
    none = np.empty(0, dtype=np.int64)  # an entry state and inertial sensors need no tracker
    source, row, node = [none], [none], [none]
    for number, instrument in enumerate(instruments):
        nearest = nearest_index(time_s, instrument.time_s)
        on = np.flatnonzero(np.abs(time_s[nearest] - instrument.time_s) <= SAME_INSTANT_S)
        source.append(np.full(len(on), number, dtype=np.int64))
        row.append(on)
        node.append(nearest[on])
    sources, rows, nodes = (np.concatenate(part).astype(np.int64) for part in (source, row, node))
    order = np.lexsort((rows, sources, nodes))
    sources, rows, nodes = sources[order], rows[order], nodes[order]

    def gathered(name: str) -> FloatArray:
        out = np.empty((len(rows), 3))
        for number, instrument in enumerate(instruments):
            mine = sources == number
            out[mine] = getattr(instrument, name)[rows[mine]]
        return out

    first = np.searchsorted(nodes, np.arange(len(time_s) + 1)).astype(np.int64)
    usable = np.ones(len(rows), dtype=bool)
    return Observed(first, sources, gathered("value"), gathered("variance"), gathered("known"), usable), rows


@dataclass(frozen=True)
class ForwardPass:
    """What the smoother needs of a linear (or linearised) filter, node by node."""

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
            problem.motion, problem.node_index, problem.sources(), problem.observed, problem.model.wander,
            problem.gate, reference is not None, start, steps, charts, run, innovations,
        )  # fmt: skip
    else:
        _forward_by_filterpy(problem, reference is not None, start, steps, charts, run, innovations)
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


def _forward_by_filterpy(
    problem: Problem,
    follow: bool,
    start: FloatArray,
    steps: Steps,
    charts: Charts,
    run: Filtered,
    innovations: Innovations,
) -> None:
    """As `recon._filter_kernels.forward`, with filterpy's algebra on the same linearised steps and measurements."""
    ekf, observed, sources = make_filter(problem.size, start, run.p_last), problem.observed, problem.sources()
    considered = KINEMATIC + np.flatnonzero(problem.model.wander.considered)
    for k in range(len(problem.time_s)):
        if k > 0:
            x, scratch = ekf.x.copy(), np.empty(problem.size)
            _filter_kernels.advance(
                problem.motion, problem.node_index, problem.model.wander, follow, steps, charts, x, scratch, k
            )
            ekf.F, ekf.Q = full_step(steps, k - 1)
            ekf.predict(u=x - ekf.F @ ekf.x)
        run.x_minus[k], run.p_minus[k] = ekf.x, packed(ekf.P)
        for row in range(observed.first[k], observed.first[k + 1]):
            prediction, by = np.empty(3), (innovations.by_state[row], innovations.by_error[row])
            _filter_kernels.predict_one(
                problem.motion, problem.node_index[k], sources, observed, charts, k, row, prediction, *by
            )
            off_chart = wrapped(sources.kind[observed.source[row]], observed.value[row] - prediction)
            used, h = measured_rows(observed, sources.slot, innovations, row, problem.size)
            _use(ekf, problem, innovations, row, used, off_chart[used], h, considered)
        run.x_plus[k] = ekf.x
        if run.kept[k] >= 0:
            run.p_plus[run.kept[k]] = packed(ekf.P[: problem.dense, : problem.dense])
    run.p_last[:] = ekf.P


def _use(
    ekf: Any, problem: Problem, innovations: Innovations, row: int,
    used: IntArray, off_chart: FloatArray, h: FloatArray, considered: IntArray,
) -> None:  # fmt: skip
    """Use the components (k,) of one measurement if they pass the gate."""
    noise = np.diag(problem.observed.variance[row, used])
    y, s = off_chart - h @ ekf.x, h @ ekf.P @ h.T + noise
    innovations.residual[row], innovations.covariance[row] = 0.0, np.eye(3)
    innovations.residual[row, used], innovations.covariance[row][np.ix_(used, used)] = y, s
    innovations.nis[row] = y @ np.linalg.solve(s, y)
    innovations.accepted[row] = innovations.nis[row] <= problem.gate[len(used)] and problem.observed.usable[row]
    if innovations.accepted[row]:
        innovations.gain[row][:, used] = schmidt_update(ekf, y, h, noise, considered)


def full_step(steps: Steps, k: int) -> tuple[FloatArray, FloatArray]:
    """Whole transition and noise (N, N) of a step from its blocks."""
    decay, noise_var = steps.decay[k], steps.noise_var[k]
    f = np.diag(np.concatenate([np.ones(KINEMATIC), decay]))
    q = np.diag(np.concatenate([np.zeros(KINEMATIC), noise_var]))
    phi = steps.transition[k]
    f[:KINEMATIC, : phi.shape[1]] = phi
    q[:KINEMATIC, :KINEMATIC] = steps.noise[k]
    return f, q


def jacobian(innovations: Innovations, slot: IntArray, row: int, size: int) -> FloatArray:
    """Partials (3, N) of one measurement's prediction by all errors; ``slot`` (SLOTS,) of its instrument."""
    h = np.zeros((3, size))
    h[:, :KINEMATIC] = innovations.by_state[row]
    h[:, KINEMATIC + slot[slot >= 0]] += innovations.by_error[row][:, slot >= 0]
    return h


def measured_rows(
    observed: Observed, slots: IntArray, innovations: Innovations, row: int, size: int
) -> tuple[IntArray, FloatArray]:
    """Components (k,) that a measurement has, and their partials by all errors (k, N)."""
    used = np.flatnonzero(np.isfinite(observed.variance[row]))
    return used, jacobian(innovations, slots[observed.source[row]], row, size)[used]


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

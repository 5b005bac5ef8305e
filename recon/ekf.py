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

The transition is dense in its nine kinematic rows alone, so a compiled prediction costs ``9 D N`` products instead of
``2 N^3``; a measurement's partials are dense in nine columns and its source's own errors.

Engines: ``"compiled"`` (the default, `forward_compiled`) and ``"filterpy"``, the forward pass by filterpy's
`ExtendedKalmanFilter`, in whose place another filter can be put. Both take steps and measurements as the same compiled
kernels linearise them. Measured speeds: docs/decisions/0007-two-engines.md.

References
----------
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems 3 (1966) 293.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flightmodel import rotations
from flightmodel._kernels import boxplus, geodetic, inlined, kernel, small_cholesky, small_solve
from flightmodel.checks import BoolArray, FloatArray, IntArray
from flightmodel.trajectory import nearest_index
from recon import state
from recon.measurements import (
    DECELERATION,
    RADAR,
    SLOTS,
    SUN,
    Instrument,
    node_motion,
    predict,
    predict_deceleration,
    servo_lag,
    wrapped,
)
from recon.propagation import SAME_INSTANT_S, Motion, level_transition, propagate_ballistic, propagate_strapdown
from recon.settings import COMPILED
from recon.state import KINEMATIC, ErrorModel, States, boxminus, packed

FIT_SPAN_S = 3.0  # of the track points that the start is fitted to
TWO_PI = 2.0 * math.pi
LEAST_DECAY = 1e-3  # the smoother divides by it; an error decorrelated to a thousandth is decorrelated


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
    """Results of a linear (or linearised) filter pass that the smoother uses, node by node."""

    charts: States
    steps: Steps
    filtered: Filtered
    innovations: Innovations

    def states(self) -> States:
        """Filtered states at every node."""
        return state.boxplus(self.charts, self.filtered.x_plus)


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
        forward_compiled(
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
    # one piece for what a pass needs alone, so that it goes back to the system whole
    triangles = size * (size + 1) // 2, dense * (dense + 1) // 2
    shapes = (
        (n - 1, 9, dense), (n - 1, 9, 9), (n - 1, m), (n - 1, m), (n, size), (n, size), (n, triangles[0]),
        (int(problem.kept.sum()), triangles[1]), (size, size),
    )  # fmt: skip
    sizes = [math.prod(shape) for shape in shapes]
    pieces = np.split(np.empty(sum(sizes)), np.cumsum(sizes[:-1]))
    parts = [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]
    x_minus, x_plus, p_minus, p_plus, p_last = parts[4:]
    steps, run = Steps(*parts[:4]), Filtered(x_minus, x_plus, p_minus, kept, p_plus, p_last)
    innovations = Innovations(
        np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count), np.zeros(count, dtype=bool),
        np.zeros((count, size, 3)), np.zeros((count, 3, 9)), np.zeros((count, 3, SLOTS)),
    )  # fmt: skip
    return steps, run, innovations


@kernel
def forward_compiled(
    motion, node_index, sources, observed, wander, gate, follow, start, steps, charts, run, innovations
):
    """Run the filter through all nodes, in place.

    ``charts`` hold the start in row 0, or with ``follow`` a reference in all rows; ``start`` (N,) is the start's error
    about row 0, ``run.p_last`` its covariance. ``gate`` (4,) is the largest accepted NIS by number of components.
    """
    n, size = run.x_minus.shape
    x, x_next, p = start.copy(), np.empty(size), run.p_last
    rows = np.empty((9, size))
    for k in range(n):
        if k > 0:
            moving = advance(motion, node_index, wander, follow, steps, charts, x, x_next, k)
            predict_covariance(
                p, steps.transition[k - 1], steps.noise[k - 1], steps.decay[k - 1], steps.noise_var[k - 1], moving, rows
            )
        store_triangle(p, size, run.p_minus[k])
        for j in range(size):
            run.x_minus[k, j] = x[j]
        if observed.first[k + 1] > observed.first[k]:
            update_node(motion, node_index[k], sources, observed, wander, gate, charts, innovations, x, p, k)
        for j in range(size):
            run.x_plus[k, j] = x[j]
        if run.kept[k] >= 0:
            store_triangle(p, steps.transition.shape[2], run.p_plus[run.kept[k]])


@inlined
def advance(motion, node_index, wander, follow, steps, charts, x, x_next, k):
    """Carry chart and error from node ``k - 1`` to ``k``; about its own estimate, or along the reference."""
    a = k - 1
    position, velocity, q = charts.position[a].copy(), charts.velocity[a].copy(), charts.q[a].copy()
    errors = charts.errors[a].copy()
    if not follow:
        for i in range(3):
            position[i] += x[i]
            velocity[i] += x[3 + i]
        boxplus(q, x[6], x[7], x[8])
        for j in range(len(errors)):
            errors[j] += x[9 + j]
    before = height_of(position, motion.planet)
    phi = steps.transition[a]
    noise = steps.noise[a]
    level_transition(phi, noise)
    first, last = node_index[a], node_index[k]
    if motion.ballistic:
        propagate_ballistic(motion, first, last, errors, position, velocity, phi, noise)
    else:
        propagate_strapdown(motion, first, last, errors, position, velocity, q, phi, noise)
    climb = abs(height_of(position, motion.planet) - before)
    dt = motion.time_s[node_index[k]] - motion.time_s[node_index[a]]
    decay = steps.decay[a]
    moving = decay_and_noise(wander, dt, climb, decay, steps.noise_var[a])
    if follow:
        linear_step(x, phi, decay, x_next)
        turn = np.empty(3)
        rotation_between(q, charts.q[k], turn)
        for i in range(3):
            x[i] = x_next[i] + position[i] - charts.position[k, i]
            x[3 + i] = x_next[3 + i] + velocity[i] - charts.velocity[k, i]
            x[6 + i] = x_next[6 + i] + turn[i]
        for j in range(len(errors)):
            x[9 + j] = x_next[9 + j] + decay[j] * errors[j] - charts.errors[k, j]
        return moving
    right_jacobian_columns(phi, x[6], x[7], x[8])
    for i in range(3):
        charts.position[k, i], charts.velocity[k, i] = position[i], velocity[i]
    for i in range(4):
        charts.q[k, i] = q[i]
    for j in range(len(errors)):
        charts.errors[k, j] = decay[j] * errors[j]
    for j in range(len(x)):
        x[j] = 0.0
    return moving


@inlined
def height_of(p, planet):
    """Geodetic height of a point (3,), m."""
    _, _, height, _ = geodetic(p[0], p[1], p[2], planet)
    return height


@inlined
def decay_and_noise(wander, dt, climb, decay, noise_var):
    """Decay of each error over a step and the variance that keeps it at its prior; whether any error moves at all."""
    moving = False
    for j in range(len(decay)):
        tau, length = wander.time_constant_s[j], wander.altitude_m[j]
        if math.isinf(tau) and math.isinf(length):
            decay[j], noise_var[j] = 1.0, wander.walk_var_per_s[j] * dt
            moving = moving or noise_var[j] > 0.0
        else:
            decay[j] = max(LEAST_DECAY, math.exp(-dt / tau - climb / length))
            noise_var[j] = wander.sd[j] * wander.sd[j] * (1.0 - decay[j] * decay[j])
            moving = True
    return moving


@inlined
def linear_step(x, phi, decay, out):
    """``out = F x``."""
    for i in range(9):
        value = 0.0
        for j in range(phi.shape[1]):
            value += phi[i, j] * x[j]
        out[i] = value
    for j in range(9, len(x)):
        out[j] = decay[j - 9] * x[j]


@inlined
def rotation_between(q, reference, out):
    """Rotation vector (3,) in body axes that leads from ``reference`` (4,) to ``q`` (4,)."""
    a, b = reference, q
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1]
    z = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    s = math.sqrt(x * x + y * y + z * z)
    k = 2.0 * math.atan2(s, w) / s if s > 1e-12 else 2.0
    out[0], out[1], out[2] = k * x, k * y, k * z


@inlined
def right_jacobian_columns(phi, d0, d1, d2):
    """Turn the rotation columns of ``phi`` (9, D) by ``1 - [d x] / 2 + [d x]^2 / 6``: about ``d`` off the chart."""
    s = d0 * d0 + d1 * d1 + d2 * d2
    j00, j01, j02 = 1.0 + (d0 * d0 - s) / 6.0, 0.5 * d2 + d0 * d1 / 6.0, -0.5 * d1 + d0 * d2 / 6.0
    j10, j11, j12 = -0.5 * d2 + d1 * d0 / 6.0, 1.0 + (d1 * d1 - s) / 6.0, 0.5 * d0 + d1 * d2 / 6.0
    j20, j21, j22 = 0.5 * d1 + d2 * d0 / 6.0, -0.5 * d0 + d2 * d1 / 6.0, 1.0 + (d2 * d2 - s) / 6.0
    for i in range(9):
        a, b, c = phi[i, 6], phi[i, 7], phi[i, 8]
        phi[i, 6] = a * j00 + b * j10 + c * j20
        phi[i, 7] = a * j01 + b * j11 + c * j21
        phi[i, 8] = a * j02 + b * j12 + c * j22


@inlined
def predict_covariance(p, phi, noise, decay, noise_var, moving, rows):
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
    for i in range(9):
        for j in range(9, size):
            value = rows[i, j] * decay[j - 9]
            p[i, j] = value
            p[j, i] = value
    if moving:
        for i in range(9, size):
            for j in range(9, size):
                p[i, j] *= decay[i - 9] * decay[j - 9]
            p[i, i] += noise_var[i - 9]


@inlined
def update_node(motion, index, sources, observed, wander, gate, charts, innovations, x, p, k):
    """Use the measurements of node ``k`` that pass the gate."""
    size = len(x)
    c, rate, acceleration = np.empty((3, 3)), np.empty((12, 3)), np.empty(3)
    h, e, y = np.empty(3), np.empty(SLOTS), np.empty(3)
    used, s, factor = np.empty(3, dtype=np.int64), np.empty((3, 3)), np.empty((3, 3))
    w = np.empty((3, size))
    position, velocity = charts.position[k], charts.velocity[k]
    node_motion(motion, index, position, velocity, charts.q[k], charts.errors[k], c, rate, acceleration)
    for row in range(observed.first[k], observed.first[k + 1]):
        source = observed.source[row]
        slot, kind = sources.slot[source], sources.kind[source]
        by_state, by_error = innovations.by_state[row], innovations.by_error[row]
        predict_reading(motion, sources, observed, charts, k, row, c, rate, acceleration, e, h, by_state, by_error)
        count = 0
        for i in range(3):
            if math.isinf(observed.variance[row, i]):
                continue
            z = observed.value[row, i] - h[i]
            if (kind == RADAR and i == 1) or (kind == SUN and i == 0):
                z -= TWO_PI * math.floor(z / TWO_PI + 0.5)
            used[count] = i
            y[count] = z - times(by_state[i], by_error[i], slot, x)
            count += 1
        cross_covariance(p, by_state, by_error, slot, count, s, used, w)
        record(innovations, row, s, y, used, count, observed.variance[row])
        small_cholesky(s, count, factor)
        nis = 0.0
        for i in range(count):
            h[i] = y[i]
            for col in range(i):
                h[i] -= factor[i, col] * h[col]
            h[i] /= factor[i, i]
            nis += h[i] * h[i]
        innovations.nis[row] = nis
        innovations.accepted[row] = nis <= gate[count] and observed.usable[row]
        if innovations.accepted[row]:
            gain_and_update(x, p, w, y, factor, count, used, wander.considered, wander.sd, innovations.gain[row])


@inlined
def predict_reading(motion, sources, observed, charts, k, row, c, rate, acceleration, e, h, by_state, by_error):
    """Prediction ``h`` (3,) of a measurement at the chart of node ``k``, and its partials.

    ``c``, ``rate`` and ``acceleration`` are of `node_motion`; ``e`` (SLOTS,) is scratch.
    """
    source = observed.source[row]
    slot, kind = sources.slot[source], sources.kind[source]
    position, velocity = charts.position[k], charts.velocity[k]
    for col in range(SLOTS):
        e[col] = charts.errors[k, slot[col]] if slot[col] >= 0 else 0.0
    predict(
        kind, sources.arm_body_m[source], sources.site_ecef_m[source], sources.dcm[source], observed.known[row], e,
        position, velocity, c, rate, acceleration, h, by_state, by_error, motion.planet,
    )  # fmt: skip
    if kind == DECELERATION:
        predict_deceleration(motion, e, position, velocity, acceleration, h, by_state, by_error)


@kernel
def predict_one(motion, index, sources, observed, charts, k, row, h, by_state, by_error):
    """`predict_reading` of one measurement, for the filterpy engine."""
    c, rate, acceleration, e = np.empty((3, 3)), np.empty((12, 3)), np.empty(3), np.empty(SLOTS)
    position, velocity = charts.position[k], charts.velocity[k]
    node_motion(motion, index, position, velocity, charts.q[k], charts.errors[k], c, rate, acceleration)
    predict_reading(motion, sources, observed, charts, k, row, c, rate, acceleration, e, h, by_state, by_error)


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


def _forward_by_filterpy(
    problem: Problem,
    follow: bool,
    start: FloatArray,
    steps: Steps,
    charts: Charts,
    run: Filtered,
    innovations: Innovations,
) -> None:
    """As `forward_compiled`, with filterpy's algebra on the same linearised steps and measurements."""
    ekf, observed, sources = make_filter(problem.size, start, run.p_last), problem.observed, problem.sources()
    considered = KINEMATIC + np.flatnonzero(problem.model.wander.considered)
    for k in range(len(problem.time_s)):
        if k > 0:
            x, scratch = ekf.x.copy(), np.empty(problem.size)
            advance(problem.motion, problem.node_index, problem.model.wander, follow, steps, charts, x, scratch, k)
            ekf.F, ekf.Q = full_step(steps, k - 1)
            ekf.predict(u=x - ekf.F @ ekf.x)
        run.x_minus[k], run.p_minus[k] = ekf.x, packed(ekf.P)
        for row in range(observed.first[k], observed.first[k + 1]):
            prediction, by = np.empty(3), (innovations.by_state[row], innovations.by_error[row])
            predict_one(problem.motion, problem.node_index[k], sources, observed, charts, k, row, prediction, *by)
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

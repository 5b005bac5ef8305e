"""What does a linear filter see of a flight? Steps and readings as plain arrays, about a state at each node.

The unknown ``x`` (N,) is the error about a nominal state at each node, its *chart*. About the charts the flight is

    x_{k+1} = F_k x_k + u_k + w_k,   cov(w_k) = Q_k;      y = z - h(chart) = H x_k + v,   cov(v) = R

of which `linearise` gives F, Q, u (`Steps`) and y, H (`Readings`) at all nodes; R comes with the measurements. Charts
are a reference trajectory, as a rule the smoothed one of the pass before (iterated Kalman smoothing: Gauss and
Newton's method). Then ``u`` is by how much the chart that is carried on misses the next one.

Where there is no reference, charts follow the filter: node by node (`linearise_nodes`), a step begins at the corrected
state, where it ends is the next chart, and ``u = -F x``.

Sizes: ``n`` nodes, ``M`` measurements, ``m`` errors beside the nine kinematic ones (``N = 9 + m``), the first ``s`` of
them drivers of the motion (`recon.propagation`), ``D = 9 + s``. F is dense in its nine kinematic rows alone, which have
D columns; every other error decays by itself. H is dense in nine columns and its source's own errors.

References
----------
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flightmodel._kernels import boxplus, geodetic, inlined, kernel
from flightmodel.checks import FloatArray, IntArray
from recon.measurements import (
    DECELERATION,
    RADAR,
    SLOTS,
    SUN,
    node_motion,
    predict,
    predict_deceleration,
)
from recon.problem import Observed, Problem, Sources
from recon.propagation import Motion, level_transition, propagate_ballistic, propagate_strapdown
from recon.state import KINEMATIC, States, Wander

TWO_PI = 2.0 * math.pi
LEAST_DECAY = 1e-3  # the smoother divides by it; an error decorrelated to a thousandth is decorrelated


class Charts(NamedTuple):
    """Nominal states at all nodes: position, velocity (n, 3), attitude (n, 4), errors (n, m)."""

    position: FloatArray
    velocity: FloatArray
    q: FloatArray
    errors: FloatArray


class Steps(NamedTuple):
    """Each node to the next: F, Q and u by their blocks.

    Parameters
    ----------
    transition, noise : (n - 1, 9, D), (n - 1, 9, 9) float
        Of the kinematic errors.
    decay, noise_var : (n - 1, m) float
        Of the others, each by itself.
    offset : (n - 1, N) float
    """

    transition: FloatArray
    noise: FloatArray
    decay: FloatArray
    noise_var: FloatArray
    offset: FloatArray


class Readings(NamedTuple):
    """Measurements about the charts: ``y`` and H.

    Parameters
    ----------
    off_chart : (M, 3) float
        Measured less predicted at the chart; zero where a component was not measured.
    by_state, by_error : (M, 3, 9), (M, 3, SLOTS) float
        Partials of the prediction, by the kinematic errors and by its source's own.
    """

    off_chart: FloatArray
    by_state: FloatArray
    by_error: FloatArray


class Linearised(NamedTuple):
    """A flight as a linear filter sees it."""

    charts: Charts
    steps: Steps
    readings: Readings


def flight_of(problem: Problem) -> tuple[Motion, IntArray, Sources, Observed, Wander]:
    """What of a problem the kernels linearise."""
    return problem.motion, problem.node_index, problem.sources(), problem.observed, problem.model.wander


def linearise(problem: Problem, reference: States) -> Linearised:
    """Steps and readings at all nodes, about a reference at all nodes."""
    line = unfilled(problem)
    for part, value in zip(line.charts, as_charts(reference), strict=True):
        part[:] = value
    linearise_nodes(*flight_of(problem), 0, len(problem.time_s), np.zeros(problem.size), True, *line)
    return line


def unfilled(problem: Problem) -> Linearised:
    """Arrays of a problem's size, of which the first chart is the start."""
    n, dense, m, count = len(problem.time_s), problem.dense, problem.model.size, len(problem.row)
    charts = Charts(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)), np.empty((n, m)))
    for part, value in zip(charts, as_charts(problem.start), strict=True):
        part[0] = value
    steps = Steps(*in_one_piece((n - 1, 9, dense), (n - 1, 9, 9), (n - 1, m), (n - 1, m), (n - 1, problem.size)))
    return Linearised(
        charts, steps, Readings(np.zeros((count, 3)), np.zeros((count, 3, 9)), np.zeros((count, 3, SLOTS)))
    )


def as_charts(states: States) -> Charts:
    """Arrays of states."""
    return Charts(states.position_ecef_m, states.velocity_ecef_mps, states.q_ecef_body, states.sensor_errors)


def in_one_piece(*shapes: tuple[int, ...]) -> list[FloatArray]:
    """Arrays side by side in one allocation, which goes back to the system whole."""
    sizes = [math.prod(shape) for shape in shapes]
    pieces = np.split(np.empty(sum(sizes)), np.cumsum(sizes[:-1]))
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


@kernel
def linearise_nodes(motion, node_index, sources, observed, wander, first, last, x, given, charts, steps, readings):
    """Linearise the steps into the nodes ``first`` to ``last`` and their readings, in place.

    With ``given`` the charts of all nodes are there. Else those before ``first`` are, ``x`` (N,) is the filter's error
    about the last of them, and the charts that follow are made.
    """
    for k in range(first, last):
        if k > 0:
            step_into(motion, node_index, wander, k, x, given, charts, steps)
        if observed.first[k + 1] > observed.first[k]:
            readings_at(motion, node_index[k], sources, observed, k, charts, readings)


@inlined
def step_into(motion, node_index, wander, k, x, given, charts, steps):
    """Linearise the step from node ``k - 1`` to ``k``: about its chart, or about the corrected state ``x`` off it."""
    a = k - 1
    position, velocity, q = charts.position[a].copy(), charts.velocity[a].copy(), charts.q[a].copy()
    errors = charts.errors[a].copy()
    if not given:
        for i in range(3):
            position[i] += x[i]
            velocity[i] += x[3 + i]
        boxplus(q, x[6], x[7], x[8])
        for j in range(len(errors)):
            errors[j] += x[9 + j]
    before = height_of(position, motion.planet)
    phi, noise, decay, offset = steps.transition[a], steps.noise[a], steps.decay[a], steps.offset[a]
    level_transition(phi, noise)
    if motion.ballistic:
        propagate_ballistic(motion, node_index[a], node_index[k], errors, position, velocity, phi, noise)
    else:
        propagate_strapdown(motion, node_index[a], node_index[k], errors, position, velocity, q, phi, noise)
    climb = abs(height_of(position, motion.planet) - before)
    dt = motion.time_s[node_index[k]] - motion.time_s[node_index[a]]
    decay_and_noise(wander, dt, climb, decay, steps.noise_var[a])
    if given:
        rotation_between(q, charts.q[k], offset[6:9])
        for i in range(3):
            offset[i] = position[i] - charts.position[k, i]
            offset[3 + i] = velocity[i] - charts.velocity[k, i]
        for j in range(len(errors)):
            offset[9 + j] = decay[j] * errors[j] - charts.errors[k, j]
        return
    for i in range(3):
        charts.position[k, i], charts.velocity[k, i] = position[i], velocity[i]
    for i in range(4):
        charts.q[k, i] = q[i]
    for j in range(len(errors)):
        charts.errors[k, j] = decay[j] * errors[j]
    right_jacobian_columns(phi, x[6], x[7], x[8])
    linear_step(x, phi, decay, offset)
    for j in range(len(x)):
        offset[j] = -offset[j]


@inlined
def height_of(p, planet):
    """Geodetic height of a point (3,), m."""
    _, _, height, _ = geodetic(p[0], p[1], p[2], planet)
    return height


@inlined
def decay_and_noise(wander, dt, climb, decay, noise_var):
    """Decay of each error over a step, and the variance that keeps it at its prior."""
    for j in range(len(decay)):
        tau, length = wander.time_constant_s[j], wander.altitude_m[j]
        if math.isinf(tau) and math.isinf(length):
            decay[j], noise_var[j] = 1.0, wander.walk_var_per_s[j] * dt
        else:
            decay[j] = max(LEAST_DECAY, math.exp(-dt / tau - climb / length))
            noise_var[j] = wander.sd[j] * wander.sd[j] * (1.0 - decay[j] * decay[j])


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
def readings_at(motion, index, sources, observed, k, charts, readings):
    """Linearise the measurements of node ``k`` about its chart."""
    c, rate, acceleration = np.empty((3, 3)), np.empty((12, 3)), np.empty(3)
    h, e = np.empty(3), np.empty(SLOTS)
    position, velocity = charts.position[k], charts.velocity[k]
    node_motion(motion, index, position, velocity, charts.q[k], charts.errors[k], c, rate, acceleration)
    for row in range(observed.first[k], observed.first[k + 1]):
        source = observed.source[row]
        slot, kind = sources.slot[source], sources.kind[source]
        by_state, by_error = readings.by_state[row], readings.by_error[row]
        for col in range(SLOTS):
            e[col] = charts.errors[k, slot[col]] if slot[col] >= 0 else 0.0
        predict(
            kind, sources.arm_body_m[source], sources.site_ecef_m[source], sources.dcm[source], observed.known[row], e,
            position, velocity, c, rate, acceleration, h, by_state, by_error, motion.planet,
        )  # fmt: skip
        if kind == DECELERATION:
            predict_deceleration(motion, e, position, velocity, acceleration, h, by_state, by_error)
        for i in range(3):
            if math.isinf(observed.variance[row, i]):
                continue
            y = observed.value[row, i] - h[i]
            if (kind == RADAR and i == 1) or (kind == SUN and i == 0):
                y -= TWO_PI * math.floor(y / TWO_PI + 0.5)
            readings.off_chart[row, i] = y


def full_step(steps: Steps, k: int) -> tuple[FloatArray, FloatArray]:
    """Whole transition and noise (N, N) of a step from its blocks."""
    decay, noise_var = steps.decay[k], steps.noise_var[k]
    f = np.diag(np.concatenate([np.ones(KINEMATIC), decay]))
    q = np.diag(np.concatenate([np.zeros(KINEMATIC), noise_var]))
    phi = steps.transition[k]
    f[:KINEMATIC, : phi.shape[1]] = phi
    q[:KINEMATIC, :KINEMATIC] = steps.noise[k]
    return f, q


def jacobian(readings: Readings, slot: IntArray, row: int, size: int) -> FloatArray:
    """Partials (3, N) of one measurement's prediction by all errors; ``slot`` (SLOTS,) of its instrument."""
    h = np.zeros((3, size))
    h[:, :KINEMATIC] = readings.by_state[row]
    h[:, KINEMATIC + slot[slot >= 0]] += readings.by_error[row][:, slot >= 0]
    return h


def measured_rows(
    observed: Observed, slots: IntArray, readings: Readings, row: int, size: int
) -> tuple[IntArray, FloatArray]:
    """Components (k,) that a measurement has, and their partials by all errors (k, N)."""
    used = np.flatnonzero(np.isfinite(observed.variance[row]))
    return used, jacobian(readings, slots[observed.source[row]], row, size)[used]

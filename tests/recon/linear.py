"""Linear problems in the filter's block form, taken through the filter's own arithmetic and solved by brute force.

A problem is given by its steps and measurements; nothing of a flight stands behind it. `run` takes it through the
filter of either engine, so that the smoothers can be run on what comes out.
"""

from dataclasses import dataclass, replace

import numpy as np

from recon import kalman
from recon.kalman import Filtered, Innovations
from recon.linearise import Readings, Steps, full_step
from recon.measurements import SLOTS
from recon.problem import Observed
from recon.settings import COMPILED
from recon.state import Wander
from tests.oracles import bryson_frazier, plain_smoother

NO_GATE = np.full(4, np.inf)
EMPTY = np.full(SLOTS, -1, dtype=np.int64)


@dataclass
class Linear:
    """A linear problem of n nodes with N errors; ``offset`` (n, N) is added by the step that leads to each node."""

    steps: Steps
    wander: Wander
    observed: Observed
    slots: np.ndarray
    by_state: np.ndarray
    by_error: np.ndarray
    start: np.ndarray
    start_covariance: np.ndarray
    offset: np.ndarray

    @property
    def moving(self):
        w = self.wander
        moves = np.isfinite(w.time_constant_s) | np.isfinite(w.altitude_m) | (w.walk_var_per_s > 0.0)
        return np.r_[np.arange(9), 9 + np.flatnonzero(moves)].astype(np.int64)

    @property
    def considered(self):
        return 9 + np.flatnonzero(self.wander.considered)

    @property
    def node(self):
        return np.repeat(np.arange(len(self.offset)), np.diff(self.observed.first))

    @property
    def readings(self):
        return Readings(self.observed.value, self.by_state, self.by_error)

    def jacobian(self, row):
        """Partials (k, N) of the measured components."""
        slot = self.slots[self.observed.source[row]]
        h = np.zeros((3, len(self.start)))
        h[:, :9] = self.by_state[row]
        for column in np.flatnonzero(slot >= 0):
            h[:, 9 + slot[column]] += self.by_error[row][:, column]
        return h[np.isfinite(self.observed.variance[row])]

    def noise(self, row):
        variance = self.observed.variance[row]
        return np.diag(variance[np.isfinite(variance)])

    def value(self, row):
        return self.observed.value[row, np.isfinite(self.observed.variance[row])]


def empty_answer(problem):
    n, size = problem.offset.shape
    dense, count = problem.steps.transition.shape[2], len(problem.observed.source)
    run = Filtered(
        np.zeros((n, size)), np.zeros((n, size)), np.zeros((n, size * (size + 1) // 2)), np.arange(n),
        np.zeros((n, dense * (dense + 1) // 2)), problem.start_covariance.copy(),
    )  # fmt: skip
    return run, Innovations(
        np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count), np.ones(count, dtype=bool),
        np.zeros((count, size, 3)),
    )  # fmt: skip


def run(problem, engine=COMPILED):
    """One forward pass without a gate: `Filtered` and `Innovations`."""
    out, innovations = empty_answer(problem)
    steps, every = problem.steps._replace(offset=problem.offset[1:]), (0, len(problem.offset))
    kalman.ENGINES[engine](
        problem.observed, problem.slots, problem.wander, NO_GATE, *every, problem.start.copy(), steps, problem.readings,
        out, innovations,
    )  # fmt: skip
    return out, innovations


def smooth(problem, out, innovations, method):
    """Errors (n, N), packed covariances of the dense errors (n, ...) and variances (n, N) of one smoother."""
    n, size = out.x_plus.shape
    triangles, variance = np.empty_like(out.p_plus), np.empty((n, size))
    if method == "two-filter":
        x = out.x_minus.copy()
        kalman.two_filter(
            problem.steps, out, problem.observed, problem.slots, problem.readings, innovations, problem.considered, x,
            triangles, variance,
        )  # fmt: skip
    elif method == "bryson-frazier":
        x = np.empty_like(out.x_plus)
        bryson_frazier.bryson_frazier(
            problem.steps, out, problem.observed, problem.slots, problem.readings, innovations, x, triangles, variance
        )
    else:
        x = out.x_plus.copy()
        one = plain_smoother if method.startswith("plain") else kalman
        one.rauch_tung_striebel(problem.steps, out, problem.moving, x, triangles, variance)
    return x, triangles, variance


def condition(problem):
    """Mean (n, N) and covariance (nN, nN) of all nodes' errors given all measurements: one solve, no recursion."""
    n, size = problem.offset.shape
    mean, joint = [problem.start], {(0, 0): problem.start_covariance}
    for k in range(1, n):
        f, q = full_step(problem.steps, k - 1)
        mean.append(f @ mean[-1] + problem.offset[k])
        for j in range(k):
            joint[j, k] = joint[j, k - 1] @ f.T
            joint[k, j] = joint[j, k].T
        joint[k, k] = f @ joint[k - 1, k - 1] @ f.T + q
    prior = np.block([[joint[i, j] for j in range(n)] for i in range(n)])
    rows = [np.zeros((0, n * size))]
    for row, k in enumerate(problem.node):
        h = problem.jacobian(row)
        rows.append(np.zeros((len(h), n * size)))
        rows[-1][:, k * size : (k + 1) * size] = h
    h = np.vstack(rows)
    r = np.diag(np.concatenate([np.diag(problem.noise(row)) for row in range(len(problem.node))]))
    z = np.concatenate([problem.value(row) for row in range(len(problem.node))])
    first = np.concatenate(mean)
    gain = np.linalg.solve(h @ prior @ h.T + r, h @ prior).T
    return (first + gain @ (z - h @ first)).reshape(n, size), prior - gain @ h @ prior


def estimator_covariance(problem, method):
    """Exact covariances (n, N, N) of filtered and smoothed errors and their difference: no recursion, no claim.

    With gains fixed, filter and smoother are linear maps of the data: found column by column from unit data. Data and
    truth are linear maps of independent unit noises (start, every step, every measurement), so the error is one too.
    """
    n, size = problem.offset.shape
    parts = [
        (r, c) for r in range(len(problem.node)) for c in np.flatnonzero(np.isfinite(problem.observed.variance[r]))
    ]
    still = replace(problem, offset=np.zeros((n, size)), start=np.zeros(size))
    maps = []
    for row, component in parts:
        value = np.zeros_like(problem.observed.value)
        value[row, component] = 1.0
        one = replace(still, observed=problem.observed._replace(value=value))
        out, innovations = run(one)
        maps.append([out.x_plus.ravel(), smooth(one, out, innovations, method)[0].ravel()])
    truth = np.zeros((n, size, n * size))
    truth[0, :, :size] = np.linalg.cholesky(problem.start_covariance)
    for k in range(1, n):
        f, q = full_step(problem.steps, k - 1)
        values, vectors = np.linalg.eigh(q)
        truth[k] = f @ truth[k - 1]
        truth[k, :, k * size : (k + 1) * size] = vectors * np.sqrt(np.maximum(values, 0.0))
    seen = np.vstack([problem.jacobian(row) @ truth[k] for row, k in enumerate(problem.node)])
    noise = np.concatenate([np.diag(problem.noise(row)) for row in range(len(problem.node))])
    answers = []
    for which in (0, 1, None):
        by_data = np.array([m[0] - m[1] if which is None else m[which] for m in maps]).T
        error = by_data @ seen - (0.0 if which is None else truth.reshape(n * size, -1))
        whole = error @ error.T + (by_data * noise) @ by_data.T
        answers.append(np.array([whole[k * size : (k + 1) * size, k * size : (k + 1) * size] for k in range(n)]))
    return answers


def random_problem(seed, drivers=18, others=6, nodes=14, considered=(), prior=2.0):
    """Uneven steps, gaps without measurements, drivers and source errors that wander in time or walk, constants."""
    rng = np.random.default_rng(seed)
    m = drivers + others
    size, dense = 9 + m, 9 + drivers
    dt = rng.uniform(0.1, 3.0, nodes - 1) ** 2
    tau, walk = np.full(m, np.inf), np.zeros(m)
    tau[[0, 2, drivers]] = [5.0, 2.0, 8.0]
    walk[[1, drivers + 1]] = 0.3
    flags = np.zeros(m, dtype=bool)
    flags[list(considered)] = True
    tau[flags], walk[flags] = np.inf, 0.0
    sd = rng.uniform(0.5, prior, m)
    wander = Wander(tau, np.full(m, np.inf), sd, walk, flags)
    decay = np.exp(-dt[:, None] / tau)
    noise_var = np.where(np.isinf(tau), walk * dt[:, None], sd**2 * (1.0 - decay**2))
    transition = rng.normal(0.0, 0.3, (nodes - 1, 9, dense))
    transition[:, range(9), range(9)] += 1.0
    root = rng.normal(0.0, 1.0, (nodes - 1, 9, 9)) * rng.uniform(0.01, 1.0, (nodes - 1, 1, 1))
    noise = root @ np.swapaxes(root, 1, 2)

    at = np.sort(np.r_[0, rng.choice(np.setdiff1d(np.arange(1, nodes), [4, 5, 6, nodes - 2]), 7), nodes - 1])
    count = len(at)
    slots = np.tile(EMPTY, (2, 1))
    slots[0, :3] = [drivers, drivers + 2, drivers + 3]
    slots[1, [1, 4, 5]] = [drivers + 4, drivers + 1, drivers]
    variance = rng.uniform(0.01, 0.2, (count, 3))
    variance[2, 1] = variance[4, 0] = variance[4, 2] = np.inf
    observed = Observed(
        np.searchsorted(at, np.arange(nodes + 1)).astype(np.int64), rng.integers(0, 2, count),
        rng.normal(0.0, 3.0, (count, 3)), variance, np.zeros((count, 3)), np.ones(count, dtype=bool),
    )  # fmt: skip
    p0 = np.diag(np.r_[rng.uniform(0.5, prior, 9), sd] ** 2)
    if drivers == 18:  # a start's attitude errs with the gyros that carried it
        p0[6:9, 18:27] = rng.normal(0.0, 0.02, (3, 9))
        p0[18:27, 6:9] = p0[6:9, 18:27].T
    by_state, by_error = rng.normal(0.0, 1.0, (count, 3, 9)), np.zeros((count, 3, SLOTS))
    by_error[:, :, :13] = rng.normal(0.0, 1.0, (count, 3, 13))  # more than the slots that are taken
    offset = rng.normal(0.0, 1.0, (nodes, size))
    return Linear(
        Steps(transition, noise, decay, noise_var, offset[1:]), wander, observed, slots, by_state, by_error,
        rng.normal(0.0, 1.0, size), p0, offset,
    )  # fmt: skip

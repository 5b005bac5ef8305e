"""What is the best estimate at every time from the data of the whole flight? Fixed-interval smoothing.

**Rauch-Tung-Striebel** on the stored priors. With ``x_{k+1} = F x_k + u + w``, ``cov(w) = Q`` and the filter's prior
``P = P_{k+1|k}``, the textbook gain ``C = P_{k|k} F^T P^-1`` equals ``C = F^-1 (1 - Q P^-1)``, and

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
with the Bryson-Frazier smoother and with the conditioning of one joint Gaussian.

References
----------
H. Rauch, F. Tung, C. Striebel, AIAA J. 3 (1965) 1445, eqs. (3.23)-(3.30).
D. Fraser, J. Potter, "The optimum linear smoother as a combination of two optimum linear filters", IEEE Trans.
Automatic Control 14 (1969) 387.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import BoolArray, DivergenceError, FloatArray, IntArray
from recon import _filter_kernels
from recon.ekf import Filtered, ForwardPass, Innovations, Observed, Problem, Steps, full_step, measured_rows
from recon.state import KINEMATIC, States, boxplus, packed, unpacked


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
    return _smoothed(problem, run.steps, run.filtered, run.innovations, kept)


def smoothed_covariance(problem: Problem, run: ForwardPass, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Smoothed errors at all nodes (n, N) and their whole covariance at the kept ones (k, N, N)."""
    count = int(kept.sum())
    rows: IntArray = np.full(len(kept), -1, dtype=np.int64)
    rows[kept] = np.arange(count)
    phi = run.steps.transition
    # covariance is kept of errors that the motion depends on: of all, where all are columns
    wide = np.concatenate([phi, np.zeros((*phi.shape[:2], problem.size - phi.shape[2]))], axis=2)
    steps, filtered = run.steps._replace(transition=wide), run.filtered._replace(kept=rows)
    made = _smoothed(problem, steps, filtered, run.innovations, count)
    return made.x, unpacked(made.triangles)


def _smoothed(problem: Problem, steps: Steps, filtered: Filtered, innovations: Innovations, kept: int) -> Smoothed:
    """Smoothed errors, with moments of as many nodes as are ``kept``; of none where that is 0."""
    dense = steps.transition.shape[2]
    triangles, variance = np.empty((kept, dense * (dense + 1) // 2)), np.empty((kept, problem.size))
    considered = KINEMATIC + np.flatnonzero(problem.model.wander.considered)
    if not len(considered):
        x = filtered.x_plus.copy()
        _filter_kernels.rauch_tung_striebel(steps, filtered, problem.moving, x, triangles, variance)
        return Smoothed(x, triangles, variance)
    x, slots = filtered.x_minus.copy(), problem.sources().slot
    try:
        two_filter(steps, filtered, problem.observed, slots, innovations, considered, x, triangles, variance)
    except np.linalg.LinAlgError:
        words = "readings contradict the flight beyond what numbers hold. Check their units and signs"
        raise DivergenceError(f"reconstruction: diverged: {words}", "trajectory-diverged") from None
    return Smoothed(x, triangles, variance)


def store_moments(run: Filtered, k: int, p: FloatArray, triangles: FloatArray, variance: FloatArray) -> None:
    """Store the moments of node ``k`` where they are wanted."""
    row = run.kept[k]
    if row >= 0 and len(triangles):
        dense = int(np.sqrt(2 * triangles.shape[1]))
        triangles[row], variance[row] = packed(p[:dense, :dense]), np.diag(p)


def _root(covariance: FloatArray) -> FloatArray:
    """Square root ``B`` with ``B B^T`` a covariance that may be singular; taken of its correlations."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    return np.asarray(sd[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def two_filter(
    steps: Steps, run: Filtered, observed: Observed, slots: IntArray, innovations: Innovations, considered: IntArray,
    x: FloatArray, triangles: FloatArray, variance: FloatArray,
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
            used, h = measured_rows(observed, slots, v, row, size)
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
            store_moments(run, k, p, triangles, variance)
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

"""How well does the trajectory foretell tracking that it never saw?

Some measurements only check: rows of an oversampled tracker, those that settings withhold, sources left out. The
smoothed state and error at their time, ``x_s`` with covariance ``P_s``, predict each one:

    residual = z - h(x_s),   variance = H P_s H^T + R

from all used data before and after it. Normalised by their standard deviations, residuals of an honest trajectory have
a mean square of one. Neighbours share the trajectory's error, so that mean is less certain than their number says.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray
from recon import _smoother_kernels, smoother
from recon.ekf import ForwardPass
from recon.packed import Innovations, unpacked
from recon.problem import Problem
from recon.state import KINEMATIC, BoolArray, IntArray

MOST_PREDICTED = 4000  # measurements; more are thinned evenly
COLUMNS = ("time_s", "source", "component", "residual", "predicted_sd")


def withheld_table(problem: Problem, run: ForwardPass, engine: str = "compiled") -> pd.DataFrame:
    """One row for each component of the measurements that were not used: `COLUMNS`, in order of time."""
    rows = _chosen(problem)
    if len(rows) == 0:
        return pd.DataFrame({name: [] for name in COLUMNS})
    node = problem.node
    wanted = np.unique(node[rows])
    kept = np.zeros(len(problem.time_s), dtype=bool)
    kept[wanted] = True
    x, covariance = _smoothed(problem, run, kept, engine)
    slots = problem.sources().slot
    out = []
    for row in rows.tolist():
        k = int(node[row])
        h = _jacobian(run.innovations, slots[problem.observed.source[row]], row, problem.size)
        # the innovation is of the state that the measurements before it at the same node had left
        before = run.filtered.x_minus[k].copy()
        for earlier in range(int(problem.observed.first[k]), row):
            if run.innovations.accepted[earlier]:
                before += run.innovations.gain[earlier] @ run.innovations.residual[earlier]
        residual = run.innovations.residual[row] - h @ (x[k] - before)
        p = covariance[int(np.searchsorted(wanted, k))]
        sd = np.sqrt(np.einsum("ij,jk,ik->i", h, p, h) + problem.observed.variance[row])
        instrument = problem.instruments[problem.observed.source[row]]
        for i, component in enumerate(instrument.components):
            if np.isfinite(sd[i]):
                out.append((problem.time_s[k], instrument.name, component, residual[i], sd[i]))
    return pd.DataFrame(out, columns=list(COLUMNS))


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return how many, rms residual and rms normalised residual by source and component."""
    squares = table.assign(square=table.residual**2, normalised=(table.residual / table.predicted_sd) ** 2)
    groups = squares.groupby(["source", "component"], sort=False)
    return pd.DataFrame(
        {
            "count": groups.size(),
            "rms_residual": np.sqrt(groups["square"].mean()),
            "rms_normalised": np.sqrt(groups["normalised"].mean()),
        }
    ).reset_index()


def _chosen(problem: Problem) -> IntArray:
    """Measurements that were not used, thinned evenly to `MOST_PREDICTED`."""
    rows = np.flatnonzero(~problem.observed.usable)
    if len(rows) > MOST_PREDICTED:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_PREDICTED).astype(np.int64)]
    return np.asarray(rows, dtype=np.int64)


def _smoothed(problem: Problem, run: ForwardPass, kept: BoolArray, engine: str) -> tuple[FloatArray, FloatArray]:
    """Smoothed errors at all nodes (n, N) and their whole covariance at the kept ones (k, N, N)."""
    rows: IntArray = np.full(len(kept), -1, dtype=np.int64)
    rows[kept] = np.arange(int(kept.sum()))
    phi = run.steps.transition
    # the smoother keeps the covariance of errors that the motion depends on: of all, where all are columns
    wide = np.concatenate([phi, np.zeros((*phi.shape[:2], problem.size - phi.shape[2]))], axis=2)
    x = run.filtered.x_plus.copy()
    triangles = np.empty((int(kept.sum()), problem.size * (problem.size + 1) // 2))
    backward = _smoother_kernels.rauch_tung_striebel if engine == "compiled" else smoother.rauch_tung_striebel
    backward(
        run.steps._replace(transition=wide), run.filtered._replace(kept=rows), problem.moving, x, triangles,
        np.empty((len(triangles), problem.size)),
    )  # fmt: skip
    return x, unpacked(triangles)


def _jacobian(innovations: Innovations, slot: IntArray, row: int, size: int) -> FloatArray:
    """Partials (3, N) of one prediction by the whole state."""
    h = np.zeros((3, size))
    h[:, :KINEMATIC] = innovations.by_state[row]
    h[:, KINEMATIC + slot[slot >= 0]] += innovations.by_error[row][:, slot >= 0]
    return h

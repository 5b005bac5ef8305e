"""What all data say about every time: Rauch-Tung-Striebel smoothing of the forward pass's stored priors.

With ``x_{k+1} = F x_k + u + w``, ``cov(w) = Q`` and the filter's prior ``P = P_{k+1|k}``, the textbook gain
``C = P_{k|k} F^T P^-1`` equals ``C = F^-1 (1 - Q P^-1)``, and

    x_{k|N} = x_{k|k} + C (x_{k+1|N} - x_{k+1|k})
    P_{k|N} = C P_{k+1|N} C^T + F^-1 (Q - Q P^-1 Q) F^-T

a sum of two positive terms: no difference of nearly equal covariances is formed. Constants (no noise) have unit rows
in ``C`` and stay exactly constant, so only the rows of *moving* errors are formed. ``P`` is scaled to a correlation
matrix before it is solved with.

References
----------
H. Rauch, F. Tung, C. Striebel, AIAA J. 3 (1965) 1445, eqs. (3.23)-(3.30).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray
from recon.ekf import ForwardPass
from recon.state import INERTIAL, KINEMATIC, IntArray, States, boxplus

CHUNK = 256


@dataclass(frozen=True)
class Smoothed:
    """Smoothed errors (n, N) about the charts of the pass, and their covariances (n, 27, 27).

    Radar errors are constants: their smoothed covariance is the filter's last one.
    """

    x: FloatArray
    covariance: FloatArray

    def states(self, charts: States) -> States:
        """Smoothed states at every node."""
        return boxplus(charts, self.x)


def step_gains(
    transition: FloatArray, noise: FloatArray, p_next: FloatArray, moving: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Rows of the smoother gain ``(k, d, N)`` and added covariance ``(k, d, d)`` of the moving errors.

    Parameters
    ----------
    transition : (k, d, N) float
        Rows of the moving errors; all other rows are unit rows.
    noise : (k, d, d) float
        Noise of the moving errors.
    p_next : (k, N, N) float
        Filter covariance predicted for the later node.
    moving : (d,) int
        Errors that change or are driven by noise.
    """
    size = p_next.shape[-1]
    scale = np.sqrt(np.diagonal(p_next, axis1=1, axis2=2))
    columns = np.zeros((len(p_next), size, len(moving)))
    columns[:, moving] = noise
    correlation = p_next / (scale[:, :, None] * scale[:, None, :])
    solved = np.linalg.solve(correlation, columns / scale[:, :, None]) / scale[:, :, None]  # P^-1 Q
    rest = noise - noise @ solved[:, moving]
    inverse = np.linalg.inv(transition[:, :, moving])
    gain = -np.swapaxes(solved, 1, 2)  # rows of 1 - Q P^-1, less what constants carry into moving errors
    gain[:, np.arange(len(moving)), moving] += 1.0
    constant = np.setdiff1d(np.arange(size), moving)
    gain[:, :, constant] -= transition[:, :, constant]
    return inverse @ gain, inverse @ rest @ np.swapaxes(inverse, 1, 2)


def smooth(run: ForwardPass, with_covariance: bool = True) -> Smoothed:
    """Smooth a forward pass; without covariance where only a reference trajectory is wanted."""
    n = len(run.x_plus)
    wandering = (run.decay < 1.0).any(axis=0) | (run.noise_var > 0.0).any(axis=0)
    moving = np.concatenate([np.arange(KINEMATIC), KINEMATIC + np.flatnonzero(wandering)])
    x = run.x_plus.copy()
    covariance = np.empty_like(run.p_plus) if with_covariance else np.empty((0, INERTIAL, INERTIAL))
    p = run.p_last.copy()
    if with_covariance:
        covariance[-1] = p[:INERTIAL, :INERTIAL]
    for start in reversed(range(0, n - 1, CHUNK)):
        stop = min(start + CHUNK, n - 1)
        gain, added = step_gains(*_rows(run, start, stop, moving), run.p_minus[start + 1 : stop + 1], moving)
        for k in reversed(range(start, stop)):
            c = gain[k - start]
            step = x[k + 1] - run.x_minus[k + 1]
            x[k] += step
            x[k, moving] += c @ step - step[moving]
            if with_covariance:
                rows = c @ p
                block = rows @ c.T + added[k - start]
                p[moving] = rows
                p[:, moving] = rows.T
                p[moving[:, None], moving] = 0.5 * (block + block.T)
                covariance[k] = p[:INERTIAL, :INERTIAL]
    return Smoothed(x, covariance)


def _rows(run: ForwardPass, start: int, stop: int, moving: IntArray) -> tuple[FloatArray, FloatArray]:
    """Transition rows and noise of the moving errors for steps ``start`` to ``stop - 1``."""
    count, size = stop - start, run.x_plus.shape[1]
    transition = np.zeros((count, len(moving), size))
    noise = np.zeros((count, len(moving), len(moving)))
    transition[:, :KINEMATIC, :INERTIAL] = run.transition[start:stop]
    noise[:, :KINEMATIC, :KINEMATIC] = run.noise[start:stop]
    for row, error in enumerate(moving[KINEMATIC:], start=KINEMATIC):
        transition[:, row, error] = run.decay[start:stop, error - KINEMATIC]
        noise[:, row, row] = run.noise_var[start:stop, error - KINEMATIC]
    return transition, noise

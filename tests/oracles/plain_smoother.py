"""Rauch-Tung-Striebel's smoother in numpy: readable twin of `recon.kalman.rauch_tung_striebel`."""

import numpy as np

from recon.kalman import keep_moments
from recon.linearise import full_step
from recon.state import unpacked


def step_gain(transition, noise, p_next, moving):
    """Rows of the smoother's gain ``(d, N)`` and added covariance ``(d, d)`` of the moving errors in one step.

    Parameters
    ----------
    transition : (d, N) float
        Rows of the moving errors; all other rows are unit rows.
    noise : (d, d) float
        Noise of the moving errors.
    p_next : (N, N) float
        Filter covariance predicted for the later node.
    moving : (d,) int
        Errors that change or are driven by noise.
    """
    size = len(p_next)
    scale = np.sqrt(np.diag(p_next))
    columns = np.zeros((size, len(moving)))
    columns[moving] = noise
    solved = np.linalg.solve(p_next / np.outer(scale, scale), columns / scale[:, None]) / scale[:, None]  # P^-1 Q
    rest = noise - noise @ solved[moving]
    inverse = np.linalg.inv(transition[:, moving])
    gain = -solved.T  # rows of 1 - Q P^-1, less what constants carry into moving errors
    gain[np.arange(len(moving)), moving] += 1.0
    constant = np.setdiff1d(np.arange(size), moving)
    gain[:, constant] -= transition[:, constant]
    return inverse @ gain, inverse @ rest @ inverse.T


def rauch_tung_striebel(steps, run, moving, x, triangles, variance):
    """Smooth ``x`` (n, N), which comes as the filtered errors, in place; moments at kept nodes where wanted."""
    p = run.p_last.copy()
    keep_moments(run, len(x) - 1, p, triangles, variance)
    for k in reversed(range(len(x) - 1)):
        f, q = full_step(steps, k)
        prior = unpacked(run.p_minus[k + 1])
        c, added = step_gain(f[moving], q[np.ix_(moving, moving)], prior, moving)
        step = x[k + 1] - run.x_minus[k + 1]
        x[k] += step
        x[k, moving] += c @ step - step[moving]
        rows = c @ p
        p[moving], p[:, moving] = rows, rows.T
        block = rows @ c.T + added
        p[np.ix_(moving, moving)] = 0.5 * (block + block.T)
        keep_moments(run, k, p, triangles, variance)

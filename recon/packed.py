"""The filter's problem and its answer as plain tuples of arrays, which compiled and readable engines both take.

``n`` nodes, ``M`` measurements, ``m`` errors beside the nine kinematic ones (``N = 9 + m``), the first ``s`` of them
drivers of the motion (`recon.motion`), ``D = 9 + s``. Symmetric matrices are stored as packed lower triangles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flightmodel.checks import FloatArray
from recon.state import BoolArray, IntArray


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
        Field or direction to the Sun, Earth-fixed axes; of a radar, the refractivity at its site first.
    usable : (M,) bool
        Whether the filter may use it at all.
    """

    first: IntArray
    source: IntArray
    value: FloatArray
    variance: FloatArray
    known: FloatArray
    usable: BoolArray


class Wander(NamedTuple):
    """How each error (m,) wanders.

    Time constant and altitude over which it forgets and returns to its sd; variance by which it walks away in a second;
    whether it is only considered.
    """

    time_constant_s: FloatArray
    altitude_m: FloatArray
    sd: FloatArray
    walk_var_per_s: FloatArray
    considered: BoolArray


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
    """What each measurement brought; components that were not measured are zero with unit variance.

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


def packed(matrices: FloatArray) -> FloatArray:
    """Lower triangles ``(..., N (N + 1) / 2)`` of symmetric matrices ``(..., N, N)``."""
    return np.asarray(matrices[(..., *np.tril_indices(matrices.shape[-1]))])


def unpacked(triangles: FloatArray, count: int | None = None) -> FloatArray:
    """Symmetric matrices ``(..., c, c)`` from packed lower triangles; of their first ``count`` rows where given."""
    size = int(np.sqrt(2 * triangles.shape[-1]))
    c = size if count is None else count
    rows, columns = np.tril_indices(c)
    out = np.empty((*triangles.shape[:-1], c, c))
    out[..., rows, columns] = triangles[..., : len(rows)]
    out[..., columns, rows] = triangles[..., : len(rows)]
    return out

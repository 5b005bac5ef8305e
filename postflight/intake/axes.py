"""Every way in which three columns can be taken for three body axes: 6 orders with 8 signs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from flightmodel.checks import FloatArray

Axes = tuple[tuple[int, ...], tuple[int, ...]]


def all_axes() -> list[Axes]:
    """All 48; the first is x, y, z as they stand."""
    return [(order, signs) for order in permutations(range(3)) for signs in product((1, -1), repeat=3)]


def matrix(order: Sequence[int], signs: Sequence[int]) -> FloatArray:
    """Return the matrix (3, 3) that makes body components of the columns."""
    return np.asarray(np.eye(3)[list(order)] * np.array(signs)[:, None])


def named(order: Sequence[int], signs: Sequence[int]) -> str:
    """Name the columns that stand for body x, y and z, as rates: ``+q, -p, +r``."""
    return ", ".join(f"{'+' if s > 0 else '-'}{'pqr'[k]}" for k, s in zip(order, signs, strict=True))

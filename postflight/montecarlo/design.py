"""Saltelli's design: which draws each run of a Sobol study has.

Two independent samples A and B of ``n`` points of the unit cube from one Sobol' sequence, and for every column the
sample A with that column from B, ``n (columns + 2)`` flights. A column is a factor, or a section of the dispersions
file with all its factors; the day's air, a whole profile, is drawn from the digits of one coordinate and so is one
factor like the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from flightmodel.checks import ConfigError, FloatArray
from synthetic_flight.dispersions import SMALLEST

LARGEST_BASE = 2**16


@dataclass(frozen=True)
class Design:
    """Saltelli's design as runs: A, then B, then A with each column from B.

    Parameters
    ----------
    factors : tuple of str
    columns : tuple of str
        Name of the column of every factor: its own, or its section's.
    base : int
        Points of A and of B, a power of two.
    seed : int
        Scrambles the sequence.
    """

    factors: tuple[str, ...]
    columns: tuple[str, ...]
    base: int
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        """Columns, each once."""
        return tuple(dict.fromkeys(self.columns))

    @property
    def flights(self) -> int:
        """Runs of the whole design."""
        return self.base * (len(self.names) + 2)

    def settings(self) -> dict[str, Any]:
        """What decides the numbers."""
        return {"base": self.base, "by": "factor" if self.columns == self.factors else "section"}

    @cached_property
    def _points(self) -> FloatArray:
        from scipy.stats import qmc  # half a second to import

        sequence = qmc.Sobol(2 * len(self.factors), scramble=True, rng=np.random.default_rng(self.seed))
        points: FloatArray = sequence.random(self.base)
        return np.clip(points, SMALLEST, 1.0 - 2.0**-53)

    def draws_of(self, run: int) -> dict[str, float]:
        """Return the number between 0 and 1 of every factor in one run."""
        block, row = divmod(run, self.base)
        a, b = np.split(self._points[row], 2)
        if block == 0:
            u = a
        elif block == 1:
            u = b
        else:
            u = np.where(np.array(self.columns) == self.names[block - 2], b, a)
        return dict(zip(self.factors, u.tolist(), strict=True))


def design_for(factors: tuple[str, ...], by: str, base: int, seed: int) -> Design:
    """Make a design over factors, one column a factor or a section.

    Raises
    ------
    ConfigError
        Where the base is no power of two, or fewer than two columns are dispersed.
    """
    if base < 8 or base > LARGEST_BASE or base & (base - 1):
        raise ConfigError(f"--base {base}: a power of two from 8 to {LARGEST_BASE} is wanted")
    columns = tuple(f.split(".")[0] if by == "section" else f for f in factors)
    if len(set(columns)) < 2:
        raise ConfigError(f"Sobol indices: at least two dispersed {by}s are wanted; got {', '.join(columns) or 'none'}")
    return Design(factors, columns, base, seed)

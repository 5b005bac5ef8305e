"""Which uncertainty makes an output uncertain: Sobol indices over the factors of a dispersions file.

Saltelli's design: two independent samples A and B of ``n`` points of the unit cube from one Sobol' sequence, and for
every column the sample A with that column from B, ``n (columns + 2)`` flights. A column is a factor, or a section of
the file with all its factors; the day's air, a whole profile, is drawn from the digits of one coordinate and so is one
factor like the others. First order is the share of the variance that a factor explains alone, total its share with all
that it does together with others. `scipy.stats.sobol_indices` gives the same numbers but wants every flight to succeed.

References
----------
Saltelli et al., "Variance based sensitivity analysis of model output", Comput. Phys. Commun. 181, 2010, Table 2 (b)
and (f).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import bootstrap, qmc

from flightmodel.checks import ConfigError, FloatArray, GateError
from synthetic_flight.dispersions import SMALLEST

RESAMPLES = 999
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


def indices(design: Design, values: FloatArray, seed: int = 0) -> tuple[pd.DataFrame, int]:
    """First-order and total indices with 95 % bootstrap intervals.

    Parameters
    ----------
    values : (flights,) float
        Output of every run, NaN where it failed. A point of the design of which one run failed is left out.
    seed : int
        Of the bootstrap.

    Returns
    -------
    table : columns factor, first, first_low_95, first_high_95, total, total_low_95, total_high_95
    left_out : int
        Points left out of ``base``.

    Raises
    ------
    GateError
        Where fewer than eight points are left, or the output does not vary.
    """
    runs = values.reshape(len(design.names) + 2, design.base)
    whole = np.isfinite(runs).all(axis=0)
    kept = runs[:, whole]
    if kept.shape[1] < 8 or not np.ptp(kept) > 0.0:
        raise GateError(
            f"Sobol indices: {kept.shape[1]} whole points of {design.base} with a spread of "
            f"{np.ptp(kept) if kept.size else 0.0:g}; more flights, or an output that varies, are wanted"
        )

    found = bootstrap(
        (np.arange(kept.shape[1]),), lambda rows: _estimate(kept[:, rows]), vectorized=False,
        n_resamples=RESAMPLES, method="percentile", confidence_level=0.95, rng=np.random.default_rng(seed),
    ).confidence_interval  # fmt: skip
    table = pd.DataFrame({"factor": design.names})
    for name, value, low, high in zip(("first", "total"), _estimate(kept), found.low, found.high, strict=True):
        table[name], table[f"{name}_low_95"], table[f"{name}_high_95"] = value, low, high
    return table, int(design.base - kept.shape[1])


def _estimate(runs: FloatArray) -> FloatArray:
    """First-order and total indices ``(2, columns)`` of runs A, B and A with columns of B, ``(columns + 2, n)``."""
    runs = runs - runs[:2].mean()
    a, b, mixed = runs[0], runs[1], runs[2:]
    variance = runs[:2].var()
    if not variance > 0.0:
        return np.zeros((2, len(mixed)))
    first, total = np.mean(b * (mixed - a), axis=1), 0.5 * np.mean((a - mixed) ** 2, axis=1)
    return np.stack([first, total]) / variance

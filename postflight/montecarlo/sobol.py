"""Which uncertainty makes an output uncertain: Sobol indices over the factors of a dispersions file.

First order is the share of the variance that a column of the design (`postflight.montecarlo.design`) explains alone,
total its share with all that it does together with others. `scipy.stats.sobol_indices` gives the same numbers but wants
every flight to succeed.

References
----------
Saltelli et al., "Variance based sensitivity analysis of model output", Comput. Phys. Commun. 181, 2010, Table 2 (b)
and (f).
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import bootstrap

from flightmodel.checks import FloatArray, GateError
from postflight.montecarlo.design import Design

RESAMPLES = 999


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

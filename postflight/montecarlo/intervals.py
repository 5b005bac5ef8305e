"""How well so many flights know a percentile: intervals by order statistics, and the rule that says when to stop.

Of n independent flights the number below the true percentile p is binomial, whatever the distribution; so the k-th and
l-th smallest values hold it with a probability that is known (`scipy.stats.quantile_test`). Stopping when the interval
looks narrow favours moments when it looks narrower than it is: a rule that looks after every chunk covers a little less
than it says (docs/monte-carlo.md has the measured figure).
"""

from __future__ import annotations

import numpy as np
from scipy.stats import quantile_test

from flightmodel.checks import FloatArray


def percentile_interval(values: FloatArray, percentile: float, confidence: float) -> tuple[float, float]:
    """Two-sided confidence interval of a percentile; NaN at the side that too few flights leave open.

    Parameters
    ----------
    values : (n,) float
        Of the flights that flew, in any order.
    percentile : float
        0 to 100.
    confidence : float
        At least this share of such intervals holds the true percentile.
    """
    if not len(values):
        return np.nan, np.nan
    found = quantile_test(values, q=np.inf, p=percentile / 100.0).confidence_interval(confidence)
    return float(found.low), float(found.high)


def is_narrow(values: FloatArray, percentile: float, confidence: float, width: float) -> bool:
    """Whether the interval of a percentile is closed and no wider than ``width``."""
    low, high = percentile_interval(values, percentile, confidence)
    return bool(high - low <= width)

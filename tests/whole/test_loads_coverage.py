"""Estimates from another team's table err as they say: 40 dispersed flights, with the errors of the defaults drawn."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.loads_coverage import scored

FLIGHTS = range(200, 240)
LOW, HIGH = 0.85, 1.15  # of the root mean square of errors over their sd, as asked of these flights


@pytest.mark.long
def test_errors_are_as_large_as_stated():
    rows = pd.DataFrame([scored(seed) for seed in FLIGHTS])
    assert "refused" not in rows
    for method in ("misalignment", "trim", "fused"):
        z = (rows[f"{method}_error"] / rows[f"{method}_sd"]).dropna()
        assert len(z) >= 0.9 * len(FLIGHTS)  # trim has no answer beyond the angles of its table
        assert LOW < np.sqrt((z**2).mean()) < HIGH, method

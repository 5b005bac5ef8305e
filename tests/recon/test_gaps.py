"""Gaps of inertial data that lie close to each other."""

import numpy as np
import pytest

from flightmodel.instruments import TriadSpec
from flightmodel.telemetry import TriadRecord
from recon.gaps import bridge

SPEC = TriadSpec("rates", np.zeros(3), np.eye(3), 0.01, 0.01, 0.003, 0.002)


@pytest.mark.parametrize("apart_s", [0.1, 0.3, 0.8, 1.9])
def test_short_gap_beside_a_long_one_is_bridged(apart_s):
    """Pieces to learn from may lie wholly inside the other gap, where there is nothing to learn."""
    t = np.arange(0.0, 20.0, 0.004)
    x = np.column_stack([np.sin(t), np.cos(2.0 * t), 0.1 * t])
    second = 10.06 + apart_s
    lost = ((t > 10.0) & (t < 10.06)) | ((t > second) & (t < second + 0.7))
    bridged = bridge(TriadRecord(SPEC, t[~lost], x[~lost]))
    assert len(bridged.findings) == 2
    assert np.isfinite(bridged.density).all()
    assert np.diff(bridged.time_s).max() < 0.01
    missed = np.array([bridged.density[np.searchsorted(bridged.time_s, s)] for s in (10.03, second + 0.35)])
    assert (missed[0] < missed[1]).all()

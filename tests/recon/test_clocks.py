"""Accelerometer and gyros whose clocks err: found as far as the flight tells, and no surer than it allows."""

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel.trajectory import difference
from recon.estimate import estimate
from recon.settings import Settings

from .problems import build

SD_S = 5e-3
SEEDS = range(8)
NAMES = ["accelerometer time bias", "rates time bias"]


@pytest.fixture(scope="module")
def flown(mini_sense):
    """Reconstructions, and by how much the clocks of both triads were late."""
    out = []
    for seed in SEEDS:
        late_s = SD_S * np.random.default_rng([seed, 1]).standard_normal(2)
        out.append((estimate(mini_sense(seed, clock_sd_s=SD_S)[0], Settings(output_rate_hz=5.0)), late_s))
    return out


def test_clocks_are_found_as_sure_as_they_are_said_to_be(flown):
    rows = [r.sensor_errors.set_index("name").loc[NAMES] for r, _ in flown]
    z = np.array([(row.estimate - late) / row.sd for row, (_, late) in zip(rows, flown, strict=True)])
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], z.size)
    assert low < np.sum(z**2) < high
    # when a pulse of 8 g comes is seen from the ground; when the vehicle turns is not
    assert all(row.sd.iloc[0] < 0.5 * SD_S for row in rows)
    assert all(row.sd.iloc[1] > 0.9 * SD_S for row in rows)
    assert all(row.unit.eq("s").all() for row in rows)


def test_the_trajectory_is_as_sure_as_it_says(flown, mini_truth):
    squares = []
    for r, _ in flown:
        t = r.smoothed
        error = difference(t, mini_truth.trajectory(t.time_s))[150]  # 130 s, at the pulse
        squares.append(error @ np.linalg.solve(t.covariance[150], error))
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 9 * len(squares))
    assert low < np.sum(squares) < high


def test_without_stated_errors_there_are_no_clocks(mini_sense):
    plain, clocks = build(mini_sense(1)[0]), build(mini_sense(1, clock_sd_s=SD_S)[0])
    assert not plain.motion.clocks
    assert clocks.motion.clocks
    assert clocks.model.size == plain.model.size + 2
    assert clocks.model.names[18:20] == NAMES
    assert clocks.dense == plain.dense + 2

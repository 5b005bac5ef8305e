"""On the pad: velocity, level, heading and biases from a rest, and what the rest shows of data sheets."""

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel.telemetry import find_rest
from recon.estimate import estimate
from recon.reconstruct import reconstruct
from recon.settings import Settings
from tests.recon import pad_flight
from tests.recon.pad_flight import DEG, REST, off, sense
from tests.refusing import refuses

QUICK = Settings(output_rate_hz=2.0)


def failed(solution):
    return {(v.code, v.source, v.component) for v in solution.consistency_checks if not v.passed}


def sd_of(bet, at_s, part):
    return np.sqrt(np.diag(off(bet, at_s)[1])[part])


def test_it_stands_still_on_its_pad():
    """Velocity within what may sway, where the trackers alone leave half a metre a second."""
    loose = reconstruct(sense(1, at_rest=False), QUICK)
    still = reconstruct(sense(1), QUICK)
    assert not failed(still)
    assert "rest" in set(still.residuals.source)
    on_pad = (still.smoothed.time_s >= REST[0]) & (still.smoothed.time_s <= REST[1])
    speed = np.linalg.norm(still.smoothed.velocity_ecef_mps, axis=1)
    assert speed[on_pad].max() < 0.03
    assert (sd_of(still.smoothed, -4.0, slice(3, 6)) < 0.02).all()
    assert (sd_of(loose.smoothed, -4.0, slice(3, 6)) > 0.05).all()
    # levelled to the accelerometer's bias and mounting, where the prior says 3 deg
    assert (sd_of(still.smoothed, -1.0, slice(7, 9)) < 0.7 * DEG).all()


def test_errors_are_as_large_as_stated_on_the_pad_and_after():
    squares = dict.fromkeys((-4.0, -0.5, 5.0, 20.0), 0.0)
    seeds = range(8)
    for seed in seeds:
        bet = estimate(sense(seed), QUICK).smoothed
        for at in squares:
            error, covariance = off(bet, at)
            squares[at] += error @ np.linalg.solve(covariance, error)
    low, high = chi2.ppf([0.0005, 0.9995], 9 * len(seeds))
    # zero velocities err by less than the sway that is allowed for: on the pad no lower limit
    assert max(squares.values()) < high
    assert squares[20.0] > low


@pytest.mark.parametrize(
    ("how", "most_deg"),
    [
        ({"azimuth_sd_deg": 1.0}, 8.0),
        ({"magnetometer": True}, 5.0),
        ({"rates": pad_flight.replace(pad_flight.RATES, noise_sd=1e-3 * DEG, bias_sd=1e-4 * DEG)}, 8.0),
    ],
    ids=["launcher", "magnetometer", "earth-rate"],
)
def test_attitude_from_the_rest_alone(how, most_deg):
    squares, seeds = 0.0, range(3)
    for seed in seeds:
        bet = estimate(sense(seed, prior_sd_deg=None, **how), QUICK).smoothed
        error, covariance = off(bet, -1.0)
        squares += error[6:9] @ np.linalg.solve(covariance[6:9, 6:9], error[6:9])
        assert np.sqrt(covariance[6, 6]) < most_deg * DEG
    assert squares < chi2.ppf(0.9995, 3 * len(seeds))


def test_a_heading_that_nothing_gives_is_refused():
    with refuses("heading-unknown"):
        estimate(sense(1, prior_sd_deg=None), QUICK)


def test_a_weak_accelerometer_is_red_by_name():
    """Ten per cent on a data sheet of half a per cent; with its prior inflated the flight comes out right."""
    solution = reconstruct(sense(2, weak=0.9), QUICK)
    assert ("at-rest", "accelerometer", "scale or bias") in failed(solution)
    error, covariance = off(solution.smoothed, 20.0)
    assert error[:3] @ np.linalg.solve(covariance[:3, :3], error[:3]) < chi2.ppf(0.9995, 3)


def test_a_gyro_bias_thirty_times_its_data_sheet_is_red_by_name():
    solution = reconstruct(sense(3, gyro_bias_degps=3.0), QUICK)
    assert ("at-rest", "rates", "bias") in failed(solution)
    row = solution.sensor_errors.set_index("name").loc["rates bias y"]
    assert abs(row.estimate - 3.0 * DEG) < 4.0 * max(row.sd, pad_flight.RATES.bias_sd)


def test_a_radar_that_acquires_late_leaves_the_start_on_the_pad():
    solution = reconstruct(sense(4, gps=False, radar_from_s=5.0), QUICK)
    bet = solution.smoothed
    assert bet.time_s[0] <= REST[0] + 0.5
    error, covariance = off(bet, REST[0] + 1.0)
    assert np.abs(error[3:6]).max() < 0.03
    assert error[:3] @ np.linalg.solve(covariance[:3, :3], error[:3]) < chi2.ppf(0.9995, 3)


def test_a_rest_is_found_in_the_data_and_only_there(mini_sense):
    telemetry = sense(5)
    start, end = find_rest(telemetry.accelerometer, telemetry.rates)
    assert start == pytest.approx(REST[0] - 1.0, abs=0.1)
    assert -1.1 < end < 0.1
    falling = mini_sense(1)[0]
    assert find_rest(falling.accelerometer, falling.rates) is None
    weak = sense(5, weak=0.9)
    assert find_rest(weak.accelerometer, weak.rates) is not None


def test_noise_at_rest_is_proposed_for_the_data_sheet():
    telemetry = sense(6)
    assert not [f for f in reconstruct(telemetry, QUICK).findings if f.code == "noise-at-rest"]
    coarse = pad_flight.replace(telemetry.accelerometer.spec, noise_sd=0.2)
    telemetry = pad_flight.replace(telemetry, accelerometer=pad_flight.replace(telemetry.accelerometer, spec=coarse))
    found = [f for f in reconstruct(telemetry, QUICK).findings if f.code == "noise-at-rest"]
    assert [f.source for f in found] == ["accelerometer"]

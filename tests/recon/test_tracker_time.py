"""Trackers whose tags are late by seconds, and receivers whose fixes lag where they cannot follow the vehicle."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.instruments import GnssSpec
from recon.estimate import estimate
from recon.fault_isolation import isolate_faults
from recon.reconstruct import reconstruct
from recon.settings import Settings
from tests.recon.conftest import END, START, measure_gnss
from tests.recon.test_fault_isolation import nees, spoiled

FAST = Settings(output_rate_hz=5.0)
SPEC = GnssSpec("gps", np.array([-0.5, 0.0, 0.0]), 3.0, 5.0, 0.5, 1.0)


def codes(bet):
    return {(v.code, v.source) for v in bet.consistency_checks if not v.passed}


@pytest.fixture
def with_receiver(mini_sense, mini_truth):
    """Telemetry of a receiver at 5 Hz in place of the radars, late by so much at each of its tags."""

    def make(late_s, seed=50, prior_s=0.5, step_s=0.2):
        telemetry, _ = mini_sense(seed)
        t = np.arange(START + 0.5, END - 4.0, step_s)
        record = measure_gnss(mini_truth, SPEC, t - late_s(t), np.random.default_rng(seed))
        record = replace(record, time_s=t, spec=replace(SPEC, time_bias_sd_s=prior_s))
        return replace(telemetry, radars={}, gnss={"gps": record})

    return make


def always(late_s):
    return lambda t: np.full(len(t), late_s)


@pytest.mark.parametrize(("late_s", "red"), [(-0.8, set()), (1.4, set()), (3.0, {("clock-corrected", "gps")})])
def test_a_lag_of_seconds_is_found_and_judged_by_what_is_stated(late_s, red, with_receiver, mini_truth):
    telemetry = with_receiver(always(late_s))
    bet = reconstruct(telemetry, FAST)
    assert codes(bet) == red
    assert nees(bet.smoothed, mini_truth).mean() < 6.0
    (check,) = (v for v in bet.consistency_checks if v.code == "clock-corrected")
    row = bet.sensor_errors.set_index("name").loc["gps time bias"]
    assert row.estimate == pytest.approx(late_s, abs=4.0 * row.sd)
    assert row.sd < 0.02
    assert check.value == pytest.approx(row.estimate / row.prior_sd)
    assert row.prior_sd == 0.5
    assert [f.source for f in bet.findings if f.code == "clock-corrected"] == ["gps"]
    again = estimate(telemetry, FAST, adaptation=bet.adaptation)  # as what is compared with it is made
    np.testing.assert_array_equal(again.smoothed.position_ecef_m, bet.smoothed.position_ecef_m)


def test_without_a_stated_time_bias_a_lag_is_named(with_receiver, mini_truth):
    bet = reconstruct(with_receiver(always(0.5), prior_s=0.0), FAST)
    assert codes(bet) == {("clock-corrected", "gps")}
    assert isolate_faults(bet.consistency_checks, bet.left_out, bet.single_faults)[0].sources == ("gps",)
    assert nees(bet.smoothed, mini_truth).mean() < 6.0


def test_tags_that_are_right_are_left(with_receiver):
    telemetry = with_receiver(always(0.0))
    bet = reconstruct(telemetry, FAST)
    assert codes(bet) == set()
    assert "clock-corrected" not in {v.code for v in bet.consistency_checks}
    np.testing.assert_array_equal(bet.smoothed.covariance, estimate(telemetry, FAST).smoothed.covariance)


def test_both_radars_that_are_late_are_named_and_set_right(mini_sense, mini_truth):
    telemetry, _ = mini_sense(51)
    for name in ("north", "west"):
        telemetry = spoiled(telemetry, name, seconds=0.5)
    bet = reconstruct(telemetry, FAST)
    assert codes(bet) == {("clock-corrected", "north"), ("clock-corrected", "west")}
    assert nees(bet.smoothed, mini_truth).mean() < 6.0


def test_fixes_that_lag_from_where_a_receiver_cannot_follow_are_red(with_receiver, mini_truth):
    """No constant lag explains them; the filter follows by an acceleration that no sensor measured."""
    bet = reconstruct(with_receiver(lambda t: 0.6 * np.clip((t - 126.0) / 4.0, 0.0, 1.0), step_s=1.0), FAST)
    assert ("unmodelled-acceleration", "") in codes(bet)
    assert nees(bet.smoothed, mini_truth).mean() > 15.0

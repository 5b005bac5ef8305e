"""Sizes of what the methods lean on: responses in axes that do not roll, and the share of a joint that swings."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.evidence import ATTITUDE, WIND, Evidence, flow_inputs, history_of_evidence

from .conftest import pulse_of


def rolling(rate_radps, n=60):
    pulse, _ = pulse_of(np.random.default_rng(2), n, theta_yz=np.full((n, 2), 0.02))
    rate = np.zeros((n, 3))
    rate[:, 0] = rate_radps(pulse.time_s - pulse.time_s[0])
    return replace(pulse, rate_body_radps=rate), pulse.time_s - pulse.time_s[0]


def test_flow_s_error_turns_against_a_roll_that_speeds_up():
    # rate a t: the roll is a t^2 / 2 to rounding where the rate is integrated by trapezoids; by rectangles 20 ms of
    # the last rate are missing or too many, 0.08 rad here
    a = 1.1
    pulse, t = rolling(lambda t: a * t)
    inputs = flow_inputs(pulse)
    for name in (WIND, ATTITUDE):
        # the first normal is along y of the axes that do not roll: in the body it turns backwards
        along_y = inputs[name][:, :, 0]
        seen = np.unwrap(np.arctan2(along_y[:, 1], along_y[:, 0]))
        moving = np.linalg.norm(along_y, axis=1) > 1e-6 * np.linalg.norm(along_y, axis=1).max()
        assert moving.sum() > 10
        np.testing.assert_allclose(seen[moving], -0.5 * a * t[moving] ** 2, atol=1e-9)


def test_flow_s_error_keeps_its_size_while_it_rolls():
    # the three parts together are the stated covariance, at any roll
    pulse, _ = rolling(lambda t: 3.0 + 0.0 * t)
    parts = flow_inputs(pulse)
    total = sum(j @ j.transpose(0, 2, 1) for j in parts.values())
    wind = parts[WIND] @ parts[WIND].transpose(0, 2, 1)
    np.testing.assert_allclose(wind, pulse.wind_flow_sd_rad[:, None, None] ** 2 * np.eye(2), rtol=0.15, atol=1e-12)
    # knots of a history that forgets keep its variance to a few percent between them
    trace = np.trace(total, axis1=1, axis2=2) / np.trace(pulse.flow_cov, axis1=1, axis2=2)
    assert trace.min() > 0.85
    assert trace.max() < 1.15


def sine_left_out(way):
    """Readings of a joint that swings as a sine, which leave out its rate and acceleration; what that is worth."""
    rate_hz, swing_hz, size, share = 100.0, 2.5, 0.01, 7e-4
    t = np.arange(0.0, 12.0, 1.0 / rate_hz)
    w = 2.0 * np.pi * swing_hz
    theta = size * np.sin(w * t)[:, None] * np.array(way)
    n = len(t)
    # by the rate as much again: of a sine its mean square is the acceleration's over the square of the frequency
    by_acceleration, by_rate = np.tile(share * np.eye(2), (n, 1, 1)), np.tile(share * w * np.eye(2), (n, 1, 1))
    one = Evidence("trim", t, theta, by_rate, by_acceleration, {}, np.zeros((n, 2, 2)), 1.0)
    pulse, _ = pulse_of(np.random.default_rng(1), n, theta_yz=np.full((n, 2), 0.02))
    clear = (t > 2.0) & (t < 10.0) & (np.abs(np.sin(w * t)) > 0.7)  # where the plane is known at all
    return one, replace(pulse, time_s=t), (share * size * w**2) ** 2, clear


@pytest.mark.parametrize("way", [[1.0, 0.0], [0.6, 0.8]])
def test_a_swinging_joint_widens_by_the_mean_square_of_what_is_left_out(way):
    # a reading that leaves out A theta'' of a sine errs by that, whose mean square over a period is the trace of what
    # is added to the covariance; windows and differences (40 samples a period) leave 3 %
    one, loads, want, clear = sine_left_out(way)
    added = np.trace(history_of_evidence(one, loads, "").lateral_cov, axis1=1, axis2=2)
    assert np.mean(added[clear]) == pytest.approx(want, rel=0.03)


def test_readings_beside_holes_keep_their_uncertainty():
    # a method without an answer now and then: the others have all of theirs, with an sd as wide as without holes, and
    # the one reading that stands alone, far from all others, has neither angle nor sd
    one, loads, want, clear = sine_left_out([0.6, 0.8])
    gone = np.arange(len(one.time_s)) % 20 < 5
    gone[:400], gone[100] = True, False
    theta = np.where(gone[:, None], np.nan, one.theta_yz_rad)
    history = history_of_evidence(replace(one, theta_yz_rad=theta), loads, "")
    lonely = np.arange(len(gone)) == 100
    assert np.isnan(history.theta_rad[lonely | gone]).all()
    assert np.isfinite(history.theta_rad[~gone & ~lonely]).all()
    assert np.isfinite(history.theta_sd_rad[~gone & ~lonely]).all()
    added = np.trace(history.lateral_cov, axis1=1, axis2=2)
    inside = clear & ~gone & (np.arange(len(gone)) > 500)
    assert np.mean(added[inside]) == pytest.approx(want, rel=0.05)


def test_a_swing_that_a_method_does_not_show_is_bounded_by_one_that_does():
    # the moment balance reads theta + A theta'': of a swing with A w^2 = 1 nothing, and is wrong by all of it
    one, loads, want, clear = sine_left_out([0.6, 0.8])
    blind = replace(one, theta_yz_rad=np.full_like(one.theta_yz_rad, 0.02))
    alone = np.trace(history_of_evidence(blind, loads, "").lateral_cov, axis1=1, axis2=2)
    assert np.mean(alone[clear]) < 0.01 * want
    noise = 1e-4 * np.random.default_rng(8).standard_normal(one.theta_yz_rad.shape)
    seen = replace(
        one, theta_yz_rad=one.theta_yz_rad + noise, independent_cov=np.tile(1e-8 * np.eye(2), (len(noise), 1, 1))
    )
    added = np.trace(history_of_evidence(blind, loads, "", seen).lateral_cov, axis1=1, axis2=2)
    assert np.mean(added[clear]) == pytest.approx(want, rel=0.05)

"""Clocks of accelerometer and gyros against each other, by the vehicle's swinging; clocks that jump ahead."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.instruments import TriadSpec
from flightmodel.telemetry import TriadRecord
from recon import time_bias
from recon.estimate import estimate
from recon.imu_screening import ClockJump, bridge, with_corrected_tags
from recon.settings import Settings
from recon.state import States
from recon.time_bias import lag_between

FINE_S, STEP_S, END_S, SPIN = 0.002, 0.005, 60.0, 0.6
FORCE = TriadSpec("accelerometer", np.zeros(3), np.eye(3), 0.05, 0.1, 0.003, 0.002, time_bias_sd_s=0.001)
RATE = TriadSpec("rates", np.zeros(3), np.eye(3), 1e-3, 1e-3, 0.003, 0.002, time_bias_sd_s=0.001)


def swinging(late_s=0.0, damping=0.0, seed=0, kicks=0.0):
    """Both sensors of a vehicle that spins, swings in either plane, faster as pressure grows, and is kicked by gusts.

    In a plane ``a'' = -w^2 a - damping a' + gusts``, which pushes it aside by ``-9 w^2 a`` beside a lever arm's 0.7
    ``a''``. The force's tags are ``late_s`` late.
    """
    rng = np.random.default_rng(seed)
    fine = np.arange(-1.0, END_S + 1.0, FINE_S)
    stiff = (2.0 + 2.5 * np.exp(-(((fine - 35.0) / 12.0) ** 2))) ** 2
    a, rate = np.array([0.05, -0.02]), np.array([0.1, 0.2])
    turn, push = np.empty((len(fine), 2)), np.empty((len(fine), 2))
    for k, w2 in enumerate(stiff):
        gust = kicks * rng.standard_normal(2)
        change = -w2 * (a + gust) - damping * rate
        turn[k], push[k] = rate, -9.0 * w2 * (a + gust) + 0.7 * change
        rate = rate + FINE_S * change
        a = a + FINE_S * rate
    t = np.arange(0.0, END_S, STEP_S)

    def seen(at, columns):
        return np.column_stack([np.interp(at, fine, c) for c in columns.T])

    w = seen(t, turn)
    rates = np.column_stack([np.full(len(t), SPIN), -w[:, 1], w[:, 0]])  # a plane's y is pushed as z is turned
    forces = np.column_stack([-2.0 - 0.1 * t, seen(t - late_s, push)])
    forces += 0.05 * rng.standard_normal(forces.shape)
    rates += 1e-3 * rng.standard_normal(rates.shape)
    return TriadRecord(FORCE, t, forces), TriadRecord(RATE, t, rates)


def lag(force, rate, speed=2000.0, **span):
    path = States(np.zeros((2, 3)), np.full((2, 3), speed / np.sqrt(3.0)), np.zeros((2, 4)), np.zeros((2, 0)))
    return lag_between(bridge(force), bridge(rate, 1), path, np.array([0.0, END_S]), **span)


@pytest.mark.parametrize("late_s", [-0.03, 0.0, 0.004, 0.02])
def test_lag_is_what_was_planted(late_s):
    found = [lag(*swinging(late_s, seed=seed, kicks=1e-3)) for seed in range(2)]
    assert all(abs(f.lag_s - late_s) < 2.5 * f.sd_s for f in found)
    assert all(f.sd_s < 0.004 for f in found)  # 20 ms stand out


def test_windows_err_as_much_as_each_says(monkeypatch):
    """Windows that gusts kick: their lags scatter about the planted one by their own standard deviations."""
    found = []
    monkeypatch.setattr(time_bias, "_combined", lambda rows: found.append(rows))
    for seed in range(10, 13):
        lag(*swinging(0.004, seed=seed, kicks=1e-3))
    late, sd, _ = np.concatenate(found).T
    scatter = 1.4826 * np.median(np.abs(late - 0.004) / sd)
    # some 50 windows, two axes of each: the median is known to a seventh
    assert 0.6 < scatter < 1.5


def test_damping_is_no_lag_beyond_what_the_flow_may_do():
    """Damping of 2 m over 500 m/s lets the force lag by 4 ms; the slower the flow the less is claimed."""
    found = lag(*swinging(damping=9.0 * 2.0 / 500.0), speed=500.0)
    assert abs(found.lag_s) < 2.0 * found.sd_s
    assert lag(*swinging(), speed=200.0) is None


def test_nothing_is_said_where_nothing_swings_in_step():
    force, rate = swinging()
    still = replace(rate, measured_sensor=1e-3 * np.random.default_rng(1).standard_normal(rate.measured_sensor.shape))
    assert lag(force, still) is None
    assert lag(replace(force, measured_sensor=force.measured_sensor[:, [1, 0, 2]]), still) is None
    assert lag(force, rate, start_s=10.0, end_s=15.0) is None  # a window is no sample
    slow = replace(rate, time_s=rate.time_s[::20], measured_sensor=rate.measured_sensor[::20])
    assert lag(force, slow) is None


def test_tags_are_set_back_behind_a_jump_or_forward_before_it():
    force, _ = swinging()
    t = force.time_s
    late = replace(force, time_s=t + 0.02 * (t > 30.0))
    early = replace(force, time_s=t - 0.02 * (t <= 30.0))
    np.testing.assert_allclose(with_corrected_tags(late, 0, (ClockJump((0,), 30.01, 0.02),)).time_s, t, atol=1e-12)
    np.testing.assert_allclose(
        with_corrected_tags(early, 0, (ClockJump((0, 1), 29.99, 0.02, False),)).time_s, t, atol=1e-12
    )
    assert np.array_equal(with_corrected_tags(late, 1, (ClockJump((0,), 30.01, 0.02),)).time_s, late.time_s)


@pytest.mark.parametrize(("sensors", "early"), [((0,), False), ((0, 1), False), ((0, 1), True)])
def test_trackers_tell_a_jump_from_lost_samples(mini_sense, sensors, early):
    """8 g are felt when they come: 40 ms late from mid-pulse on, or early until then, is seen from the ground."""
    telemetry, _ = mini_sense(3, clock_sd_s=1e-3)
    clean = estimate(telemetry, Settings(output_rate_hz=5.0))
    records = [telemetry.accelerometer, telemetry.rates]
    lost, jumped = list(records), list(records)
    for k in sensors:
        r = records[k]
        gone = (r.time_s > 130.0) & (r.time_s < 130.04)
        lost[k] = replace(r, time_s=r.time_s[~gone], measured_sensor=r.measured_sensor[~gone])
        jumped[k] = replace(r, time_s=r.time_s + 0.04 * ((r.time_s > 130.0) - float(early)))
    found = [
        estimate(replace(telemetry, accelerometer=a, rates=w), Settings(output_rate_hz=5.0)) for a, w in (lost, jumped)
    ]
    assert clean.adaptation.jumps == ()
    assert found[0].adaptation.jumps == ()
    (jump,) = found[1].adaptation.jumps
    assert jump.sensors == sensors
    assert jump.after is not early
    assert jump.by_s == pytest.approx(0.04, abs=1e-3)
    named = {f.source for f in found[1].findings if f.code == "clock-jump"}
    assert named == {records[k].spec.name for k in sensors}


def test_a_clock_beyond_its_data_sheet_is_estimated_from_the_oscillation(monkeypatch, mini_sense):
    """The lag goes into the second reconstruction; the check stays that of the first."""
    from recon import time_bias
    from recon.reconstruct import reconstruct

    telemetry, _ = mini_sense(4, clock_sd_s=1e-3)
    rates = telemetry.rates
    early = replace(telemetry, rates=replace(rates, time_s=rates.time_s - 0.02))
    lag = time_bias.Lag(0.02, 0.002)
    monkeypatch.setattr(time_bias, "lag_between", lambda *_, **__: lag)
    found = reconstruct(early, Settings(output_rate_hz=5.0))
    (check,) = (v for v in found.consistency_checks if v.code == "clock-lag")
    assert not check.passed
    table = found.sensor_errors.set_index("name")
    between = table.estimate["accelerometer time bias"] - table.estimate["rates time bias"]
    assert between == pytest.approx(0.02, abs=0.004)
    assert abs(table.estimate["rates time bias"] + 0.02) < 3.0 * table.sd["rates time bias"]

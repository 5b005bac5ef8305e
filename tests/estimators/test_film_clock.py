"""A film's clock against the gyros', and the camera's history smoothed in time: planted offsets, errors as stated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from estimators import fusion
from estimators.evidence import (
    FILM_CLOCK,
    LIGHT_TIME_S,
    Evidence,
    evidence_of_history,
    moved_evidence,
    read_later,
)
from estimators.fusion import clock_is_seen, fuse, smoothed
from estimators.loads import carried
from flightmodel.checks import DivergenceError
from flightmodel.deflection import history_from_lateral
from flightmodel.statistics import correlation_root
from postflight.fusing import FilmClock, fuse_flight

from .conftest import pulse_of

TIME_S = 430.0 + 0.05 * np.arange(200)
CAMERA_SD = np.deg2rad(0.15)
TOLD_SD_S = 0.3


def bent(time_s, swing=1.0):
    """A deflection through a pulse that swings with the slow mode and rings, lateral, rad."""
    x = time_s - 435.0
    slow = np.exp(-((x / 4.0) ** 2)) * (3.0 + swing * np.sin(2.0 * np.pi * 0.65 * x))
    ring = 0.15 * swing * np.exp(-((x / 3.0) ** 2))
    turn = 2.0 * np.pi * 1.6 * x
    return np.deg2rad(np.column_stack([0.8 * slow + ring * np.cos(turn), -0.6 * slow + ring * np.sin(turn)]))


def camera(rng, late_s, rate=2, swing=1.0, sd=CAMERA_SD):
    """Camera's history with the errors that the fusion takes it to have, its times late."""
    t = TIME_S[::rate]
    light = correlation_root(t, LIGHT_TIME_S)
    drawn = np.sqrt(0.5) * (rng.standard_normal(2) + light @ rng.standard_normal((light.shape[1], 2)))
    cov = np.tile(sd**2 * np.eye(2), (len(t), 1, 1))
    return history_from_lateral(t, bent(t - late_s, swing) + sd * drawn, cov, "camera", "")


def sensed(rng, swing=1.0):
    """Another method on the gyros' clock: a lasting error of 0.3 deg and noise."""
    n = len(TIME_S)
    response = np.deg2rad(0.3) * np.tile(np.eye(2), (n, 1, 1))
    read = bent(TIME_S, swing) - response @ rng.standard_normal(2) + np.deg2rad(0.05) * rng.standard_normal((n, 2))
    cov = np.tile(np.deg2rad(0.05) ** 2 * np.eye(2), (n, 1, 1))
    return Evidence("sensed", TIME_S, read, np.zeros((n, 2, 2)), {"lasting": response}, cov, 0.1)


def clock_of(told):
    """Offset and sd, s."""
    got = fuse(lambda inputs, about: [moved_evidence(e, inputs, about) for e in told])
    mean, cov = got.inputs[FILM_CLOCK]
    return TOLD_SD_S * float(mean[0]), TOLD_SD_S * float(np.sqrt(cov[0, 0])), got


def test_planted_offsets_are_found_with_honest_sd():
    errors, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        late = (0.0, 0.05, 0.2, -0.05, -0.2, 0.4)[seed % 6]
        found, sd, _ = clock_of([sensed(rng), evidence_of_history(camera(rng, late), TOLD_SD_S)])
        errors.append(found - late)
        stated.append(sd)
    errors, stated = np.array(errors), np.array(stated)
    # a fifth of the ring's period at the most: no wrong minimum
    assert np.abs(errors).max() < 0.04
    assert stated.max() < 0.02
    low, high = chi2.ppf([0.005, 0.995], len(errors)) / len(errors)
    # what the equations leave out is allowed for and not drawn: smaller errors than stated are right
    assert np.mean((errors / stated) ** 2) < high
    assert np.mean((errors / stated) ** 2) > 0.3 * low


def test_the_fused_deflection_is_that_of_the_right_times():
    def answer(late_s, told_late_s, clock_sd_s):
        rng = np.random.default_rng(3)
        told = [sensed(rng), evidence_of_history(camera(rng, late_s), clock_sd_s)]
        told[1] = replace(told[1], time_s=told[1].time_s - told_late_s)
        got = fuse(lambda inputs, about: [moved_evidence(e, inputs, about) for e in told]).history
        return got.theta_yz_rad[(got.time_s > 431.0) & (got.time_s < 439.0)]

    # 0.2 s taken as right leave no common answer
    known, found, blind = answer(0.1, 0.1, 0.0), answer(0.1, 0.0, TOLD_SD_S), answer(0.1, 0.0, 0.0)
    assert np.sqrt(np.mean((found - known) ** 2)) < np.deg2rad(0.05)
    assert np.sqrt(np.mean((blind - known) ** 2)) > 5.0 * np.sqrt(np.mean((found - known) ** 2))


def test_a_deflection_that_stands_still_tells_no_time():
    def told(moving):
        rng = np.random.default_rng(5)
        shift = 0.0 if moving else np.deg2rad([2.0, 1.0]) - bent(TIME_S)
        one, seen = sensed(rng), camera(rng, 0.0)
        yz = seen.theta_yz_rad + (0.0 if moving else shift[::2])
        history = history_from_lateral(seen.time_s, yz, seen.lateral_cov, "camera", "")
        return [replace(one, theta_yz_rad=one.theta_yz_rad + shift), evidence_of_history(history, TOLD_SD_S)]

    assert clock_is_seen(lambda _inputs, _about: told(True))
    assert not clock_is_seen(lambda _inputs, _about: told(False))
    # of a clock alone, and of none but the gyros', nothing can be said
    assert not clock_is_seen(lambda _inputs, _about: told(True)[1:])
    assert not clock_is_seen(lambda _inputs, _about: told(True)[:1])


def test_a_clock_taken_as_right_moves_nothing_but_is_told():
    pulse, truth = pulse_of(np.random.default_rng(11), len(TIME_S), bent(TIME_S, 0.7))
    late = 0.12
    cov = np.tile(CAMERA_SD**2 * np.eye(2), (len(TIME_S), 1, 1))
    told = history_from_lateral(TIME_S + late, truth, cov, "camera", "")
    trusted, allowed = fuse_flight(pulse, told), fuse_flight(pulse, told, film_clock_sd_s=TOLD_SD_S)
    assert FILM_CLOCK not in trusted.fused.inputs
    assert not trusted.film_clock.applied
    assert trusted.film_clock.is_off
    assert "late by 0.1" in trusted.film_clock.words
    assert "time_bias_sd_s in [frames] is 0" in trusted.film_clock.words
    assert allowed.film_clock.applied
    for clock in (trusted.film_clock, allowed.film_clock):
        assert clock.offset_s == pytest.approx(late, abs=max(4.0 * clock.sd_s, 0.01))
    assert fuse_flight(pulse, None).film_clock is None
    assert fuse_flight(pulse, None).clock_summary() is None
    assert allowed.clock_summary()["applied"]
    assert not FilmClock(0.01, 0.01, False).is_off


def test_late_triads_are_set_right():
    """What accelerometer and gyros say, each with its own clock, and what the one carries for the other."""
    arm, late_force, late_rate = np.array([-0.4, 0.1, 0.2]), 0.004, -0.003

    def signals(time_s):
        turn = 2.0 * np.pi * 0.65 * time_s[:, None] + np.array([0.0, 1.0, 2.5])
        rate = 0.2 * np.sin(turn)
        return 5.0 * np.cos(2.0 * turn), rate, 0.4 * np.pi * 0.65 * np.cos(turn)

    def told(force_s, rate_s):
        (force, _, _), (_, rate, turn) = signals(TIME_S - force_s), signals(TIME_S - rate_s)
        flow = 0.3 * rate[:, 1:]
        return replace(
            pulse_of(np.random.default_rng(1), len(TIME_S), bent(TIME_S))[0],
            specific_force_body_mps2=force + carried(rate, turn, arm),
            flow_yz_rad=flow,
            rate_body_radps=rate,
            angular_acceleration_body_radps2=turn,
            cg_from_sensor_m=arm,
        )

    got, want = (
        read_later(told(late_force, late_rate), np.full(len(TIME_S), True), late_force, late_rate),
        told(0.0, 0.0),
    )
    for name in ("specific_force_body_mps2", "flow_yz_rad", "rate_body_radps", "angular_acceleration_body_radps2"):
        scale = np.abs(getattr(want, name)).max()
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), atol=1e-3 * scale, err_msg=name)


def test_the_triads_clocks_are_in_the_films_sd():
    pulse, truth = pulse_of(np.random.default_rng(11), len(TIME_S), bent(TIME_S, 0.7))
    cov = np.tile(np.deg2rad(0.05) ** 2 * np.eye(2), (len(TIME_S), 1, 1))
    told = history_from_lateral(TIME_S, truth, cov, "camera", "")
    late = read_later(pulse, np.full(len(TIME_S), True), -0.01, -0.01)
    trusting = fuse_flight(late, told, film_clock_sd_s=TOLD_SD_S).film_clock
    stated = replace(late, force_clock_sd_s=0.01, rate_clock_sd_s=0.01)
    allowing = fuse_flight(stated, told, film_clock_sd_s=TOLD_SD_S).film_clock
    assert trusting.offset_s == pytest.approx(-0.01, abs=3.0 * trusting.sd_s)
    assert allowing.sd_s**2 > trusting.sd_s**2 + 0.5 * 0.01**2
    assert abs(allowing.offset_s) < 2.0 * allowing.sd_s


def test_a_late_film_that_leaves_no_common_answer_is_told_as_such():
    pulse, truth = pulse_of(np.random.default_rng(11), len(TIME_S), bent(TIME_S, 0.8))
    cov = np.tile(np.deg2rad(0.01) ** 2 * np.eye(2), (len(TIME_S), 1, 1))
    with pytest.raises(DivergenceError, match=r"answer if the film's clock is late by 0\.3.* time_bias_sd_s in"):
        fuse_flight(pulse, history_from_lateral(TIME_S + 0.3, truth, cov, "camera", ""))


def test_the_smooth_history_errs_less_than_the_frames_and_says_how_much():
    normal, raw, smooth = [], [], []
    noise = fusion.LEFT_OUT_RAD * np.sqrt(fusion.LEFT_OUT_TIME_S / 0.1)
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        seen = camera(rng, 0.0, swing=0.0, sd=np.deg2rad(0.03))
        yz = seen.theta_yz_rad + noise * rng.standard_normal((len(seen.time_s), 2))
        got = smoothed(history_from_lateral(seen.time_s, yz, seen.lateral_cov, "camera", ""))
        np.testing.assert_allclose(np.diff(got.time_s), 0.02, atol=1e-9)
        inner = (got.time_s > 431.0) & (got.time_s < 439.0)
        off = got.theta_yz_rad - bent(got.time_s, 0.0)
        smooth.append(np.mean(off[inner] ** 2))
        raw.append(np.mean((yz - bent(seen.time_s, 0.0)) ** 2))
        k = int(np.argmin(np.abs(got.time_s - 435.03)))
        normal.append(off[k] @ np.linalg.solve(got.lateral_cov[k], off[k]))
    # frames are as far apart as the knots that a ringing joint needs: little averages out
    assert np.mean(smooth) < np.mean(raw)
    low, high = chi2.ppf([0.005, 0.995], 2 * len(normal)) / len(normal)
    assert low < np.mean(normal) < high


def test_holes_widen_the_smooth_history_and_long_ones_stay():
    seen = camera(np.random.default_rng(1), 0.0)
    theta = seen.theta_rad.copy()
    short = (seen.time_s > 434.0) & (seen.time_s < 434.55)
    long = (seen.time_s > 436.5) & (seen.time_s < 438.5)
    theta[short | long] = np.nan
    got = smoothed(replace(seen, theta_rad=theta))
    assert np.isfinite(got.theta_rad).all()
    inside = (got.time_s > 434.2) & (got.time_s < 434.4)
    beside = (got.time_s > 433.2) & (got.time_s < 433.6)
    assert got.theta_sd_rad[inside].max() > 1.2 * got.theta_sd_rad[beside].max()
    assert not ((got.time_s > 437.1) & (got.time_s < 437.9)).any()
    with pytest.raises(DivergenceError, match="no smooth history of 3 readings"):
        smoothed(history_from_lateral(TIME_S[:3], bent(TIME_S[:3]), np.tile(np.eye(2), (3, 1, 1)), "camera", ""))

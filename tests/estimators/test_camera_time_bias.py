"""Camera time bias against the gyros', and the camera's history smoothed in time: planted biases, errors as stated."""

from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from estimators import fusion
from estimators.evidence import (
    CAMERA_TIME_BIAS,
    LIGHT_TIME_S,
    Evidence,
    delayed,
    evidence_of_history,
    moved_evidence,
)
from estimators.fusing import CameraTimeBias, fuse_flight, time_bias_if_free
from estimators.fusion import fuse, smoothed, time_bias_is_observable
from flightmodel import rotations
from flightmodel.checks import DivergenceError
from flightmodel.deflection import history_from_lateral
from flightmodel.statistics import correlation

from .conftest import pulse_of

TIME_S = 430.0 + 0.05 * np.arange(200)
CAMERA_SD = np.deg2rad(0.15)
PRIOR_SD_S = 0.3


def motion(time_s, oscillation=1.0):
    """A deflection through a pulse that swings with the slow mode and rings, lateral, rad."""
    x = time_s - 435.0
    slow = np.exp(-((x / 4.0) ** 2)) * (3.0 + oscillation * np.sin(2.0 * np.pi * 0.65 * x))
    ring = 0.15 * oscillation * np.exp(-((x / 3.0) ** 2))
    turn = 2.0 * np.pi * 1.6 * x
    return np.deg2rad(np.column_stack([0.8 * slow + ring * np.cos(turn), -0.6 * slow + ring * np.sin(turn)]))


def camera(rng, late_s, rate=2, oscillation=1.0, sd=CAMERA_SD):
    """Camera's history with the errors that the fusion takes it to have, its times late."""
    t = TIME_S[::rate]
    light = np.linalg.cholesky(correlation(t, LIGHT_TIME_S))
    drawn = np.sqrt(0.5) * (rng.standard_normal(2) + light @ rng.standard_normal((light.shape[1], 2)))
    cov = np.tile(sd**2 * np.eye(2), (len(t), 1, 1))
    return history_from_lateral(t, motion(t - late_s, oscillation) + sd * drawn, cov, "camera", "")


def other_method(rng, oscillation=1.0):
    """Another method on the gyros' clock: a lasting error of 0.3 deg and noise."""
    n = len(TIME_S)
    response = np.deg2rad(0.3) * np.tile(np.eye(2), (n, 1, 1))
    read = (
        motion(TIME_S, oscillation) - response @ rng.standard_normal(2) + np.deg2rad(0.05) * rng.standard_normal((n, 2))
    )
    cov = np.tile(np.deg2rad(0.05) ** 2 * np.eye(2), (n, 1, 1))
    return Evidence("sensed", TIME_S, read, *[np.zeros((n, 2, 2))] * 2, {"lasting": response}, cov, 0.1)


def time_bias_of(readings):
    """Offset and sd, s."""
    _, got = fuse(lambda inputs, about: [moved_evidence(e, inputs, about) for e in readings])
    mean, cov = got.inputs[CAMERA_TIME_BIAS]
    return PRIOR_SD_S * float(mean[0]), PRIOR_SD_S * float(np.sqrt(cov[0, 0])), got


def test_planted_offsets_are_found_with_honest_sd():
    errors, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        late = (0.0, 0.05, 0.2, -0.05, -0.2, 0.4)[seed % 6]
        found, sd, _ = time_bias_of([other_method(rng), evidence_of_history(camera(rng, late), PRIOR_SD_S)])
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
    def answer(late_s, corrected_s, time_bias_sd_s):
        rng = np.random.default_rng(3)
        readings = [other_method(rng), evidence_of_history(camera(rng, late_s), time_bias_sd_s)]
        readings[1] = replace(readings[1], time_s=readings[1].time_s - corrected_s)
        got, _ = fuse(lambda inputs, about: [moved_evidence(e, inputs, about) for e in readings])
        return got.theta_yz_rad[(got.time_s > 431.0) & (got.time_s < 439.0)]

    # 0.2 s taken as right leave no common answer
    known, found, blind = answer(0.1, 0.1, 0.0), answer(0.1, 0.0, PRIOR_SD_S), answer(0.1, 0.0, 0.0)
    assert np.sqrt(np.mean((found - known) ** 2)) < np.deg2rad(0.05)
    assert np.sqrt(np.mean((blind - known) ** 2)) > 5.0 * np.sqrt(np.mean((found - known) ** 2))


def test_a_time_bias_is_not_observable_from_a_constant_deflection():
    def readings(moving):
        rng = np.random.default_rng(5)
        shift = 0.0 if moving else np.deg2rad([2.0, 1.0]) - motion(TIME_S)
        one, film = other_method(rng), camera(rng, 0.0)
        yz = film.theta_yz_rad + (0.0 if moving else shift[::2])
        history = history_from_lateral(film.time_s, yz, film.lateral_cov, "camera", "")
        return [replace(one, theta_yz_rad=one.theta_yz_rad + shift), evidence_of_history(history, PRIOR_SD_S)]

    assert time_bias_is_observable(lambda _inputs, _about: readings(True))
    assert not time_bias_is_observable(lambda _inputs, _about: readings(False))
    # nor from one time reference alone
    assert not time_bias_is_observable(lambda _inputs, _about: readings(True)[1:])
    assert not time_bias_is_observable(lambda _inputs, _about: readings(True)[:1])


def test_a_time_bias_stated_as_zero_is_tested_but_not_applied():
    loads, truth = pulse_of(np.random.default_rng(11), len(TIME_S), motion(TIME_S, 0.7))
    late = 0.12
    cov = np.tile(CAMERA_SD**2 * np.eye(2), (len(TIME_S), 1, 1))
    readings = history_from_lateral(TIME_S + late, truth, cov, "camera", "")
    trusted, allowed = fuse_flight(loads, readings), fuse_flight(loads, readings, camera_time_bias_sd_s=PRIOR_SD_S)
    assert CAMERA_TIME_BIAS not in trusted.solution.inputs
    assert not trusted.camera_time_bias.applied
    assert trusted.camera_time_bias.is_off
    assert "+0.1" in trusted.camera_time_bias.remark
    assert "time_bias_sd_s" in trusted.camera_time_bias.remark
    assert trusted.time_bias_summary()["words"] == trusted.camera_time_bias.remark
    assert allowed.camera_time_bias.applied
    for clock in (trusted.camera_time_bias, allowed.camera_time_bias):
        assert clock.offset_s == pytest.approx(late, abs=max(4.0 * clock.sd_s, 0.01))
    assert fuse_flight(loads, None).camera_time_bias is None
    assert fuse_flight(loads, None).time_bias_summary() is None
    assert allowed.time_bias_summary()["applied"]
    assert not CameraTimeBias(0.01, 0.01, False).is_off
    # tested elsewhere meanwhile it is the same, and what comes from there is taken
    assert time_bias_if_free(loads, readings) == trusted.camera_time_bias
    other, found = CameraTimeBias(0.5, 0.1, False), Future()
    found.set_result(other)
    assert fuse_flight(loads, readings, time_bias=found).camera_time_bias == other
    assert fuse_flight(loads, None, time_bias=found).camera_time_bias is None


def test_late_triads_are_set_right():
    """What accelerometer and gyros say, each with its own clock, and what the one carries for the other."""
    arm, late_force, late_rate = np.array([-0.4, 0.1, 0.2]), 0.004, -0.003

    def signals(time_s):
        turn = 2.0 * np.pi * 0.65 * time_s[:, None] + np.array([0.0, 1.0, 2.5])
        rate = 0.2 * np.sin(turn)
        return 5.0 * np.cos(2.0 * turn), rate, 0.4 * np.pi * 0.65 * np.cos(turn)

    def readings(force_s, rate_s):
        (force, _, _), (_, rate, turn) = signals(TIME_S - force_s), signals(TIME_S - rate_s)
        flow = 0.3 * rate[:, 1:]
        return replace(
            pulse_of(np.random.default_rng(1), len(TIME_S), motion(TIME_S))[0],
            specific_force_body_mps2=force + rotations.lever_arm_acceleration(rate, turn, arm),
            flow_yz_rad=flow,
            rate_body_radps=rate,
            angular_acceleration_body_radps2=turn,
            cg_from_sensor_m=arm,
        )

    got, want = (
        delayed(readings(late_force, late_rate), late_force, late_rate),
        readings(0.0, 0.0),
    )
    for name in ("specific_force_body_mps2", "flow_yz_rad", "rate_body_radps", "angular_acceleration_body_radps2"):
        scale = np.abs(getattr(want, name)).max()
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), atol=1e-3 * scale, err_msg=name)


def test_the_triads_clocks_are_in_the_films_sd():
    loads, truth = pulse_of(np.random.default_rng(11), len(TIME_S), motion(TIME_S, 0.7))
    cov = np.tile(np.deg2rad(0.05) ** 2 * np.eye(2), (len(TIME_S), 1, 1))
    readings = history_from_lateral(TIME_S, truth, cov, "camera", "")
    late = delayed(loads, -0.01, -0.01)
    trusting = fuse_flight(late, readings, camera_time_bias_sd_s=PRIOR_SD_S).camera_time_bias
    stated = replace(late, accelerometer_time_bias_sd_s=0.01, gyro_time_bias_sd_s=0.01)
    allowing = fuse_flight(stated, readings, camera_time_bias_sd_s=PRIOR_SD_S).camera_time_bias
    assert trusting.offset_s == pytest.approx(-0.01, abs=3.0 * trusting.sd_s)
    assert allowing.sd_s**2 > trusting.sd_s**2 + 0.5 * 0.01**2
    assert abs(allowing.offset_s) < 2.0 * allowing.sd_s


def test_a_time_bias_that_leaves_no_common_answer_is_named():
    # the film is left out, and the bias with which it would agree is said
    loads, truth = pulse_of(np.random.default_rng(11), len(TIME_S), motion(TIME_S, 0.8))
    cov = np.tile(np.deg2rad(0.01) ** 2 * np.eye(2), (len(TIME_S), 1, 1))
    answer = fuse_flight(loads, history_from_lateral(TIME_S + 0.3, truth, cov, "camera", ""))
    assert answer.left_out == "camera"
    assert answer.camera_time_bias.is_off
    assert answer.camera_time_bias.offset_s == pytest.approx(0.3, abs=0.02)
    red = {check.code for check in answer.consistency_checks if not check.passed}
    assert red == {"deflection-methods", "camera-time-bias"}
    # whatever else might explain the contradiction, the film comes first
    assert answer.camera_time_bias.cause in answer.remark
    on_time = fuse_flight(loads, history_from_lateral(TIME_S, truth, cov, "camera", "")).camera_time_bias
    assert not on_time.cause


def test_the_smooth_history_errs_less_than_the_frames_and_says_how_much():
    normal, raw, smooth = [], [], []
    noise = fusion.LEFT_OUT_RAD * np.sqrt(fusion.LEFT_OUT_TIME_S / 0.1)
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        film = camera(rng, 0.0, oscillation=0.0, sd=np.deg2rad(0.03))
        yz = film.theta_yz_rad + noise * rng.standard_normal((len(film.time_s), 2))
        got = smoothed(history_from_lateral(film.time_s, yz, film.lateral_cov, "camera", ""))
        np.testing.assert_allclose(np.diff(got.time_s), 0.02, atol=1e-9)
        inner = (got.time_s > 431.0) & (got.time_s < 439.0)
        off = got.theta_yz_rad - motion(got.time_s, 0.0)
        smooth.append(np.mean(off[inner] ** 2))
        raw.append(np.mean((yz - motion(film.time_s, 0.0)) ** 2))
        k = int(np.argmin(np.abs(got.time_s - 435.03)))
        normal.append(off[k] @ np.linalg.solve(got.lateral_cov[k], off[k]))
    # frames are as far apart as the knots that a ringing joint needs: little averages out
    assert np.mean(smooth) < np.mean(raw)
    low, high = chi2.ppf([0.005, 0.995], 2 * len(normal)) / len(normal)
    assert low < np.mean(normal) < high


def test_holes_widen_the_smooth_history_and_long_ones_stay():
    film = camera(np.random.default_rng(1), 0.0)
    theta = film.theta_rad.copy()
    short = (film.time_s > 434.0) & (film.time_s < 434.55)
    long = (film.time_s > 436.5) & (film.time_s < 438.5)
    theta[short | long] = np.nan
    got = smoothed(replace(film, theta_rad=theta))
    assert np.isfinite(got.theta_rad).all()
    inside = (got.time_s > 434.2) & (got.time_s < 434.4)
    beside = (got.time_s > 433.2) & (got.time_s < 433.6)
    assert got.theta_sd_rad[inside].max() > 1.2 * got.theta_sd_rad[beside].max()
    assert not ((got.time_s > 437.1) & (got.time_s < 437.9)).any()
    with pytest.raises(DivergenceError) as refusal:
        smoothed(history_from_lateral(TIME_S[:3], motion(TIME_S[:3]), np.tile(np.eye(2), (3, 1, 1)), "camera", ""))
    assert refusal.value.codes == ("too-few-data",)

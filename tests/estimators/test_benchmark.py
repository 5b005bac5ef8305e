"""The benchmark frame's deflection from the moment in the joint: the law, its error bar, and where it does not hold."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from estimators.benchmark import (
    BenchmarkDeflection,
    RelativeDeflections,
    _camera_covariance,
    benchmark_deflection,
    joint_moment,
)
from estimators.camera import read_film
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from flightmodel.checks import GateError
from flightmodel.statistics import correlation_root
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, film
from tests.refusing import numbers_in

from .conftest import VEHICLE, pulse_of

PRIOR_RAD = D(0.12)
TIME_S = 419.0 + 0.05 * np.arange(561)
FRAMES_S = np.arange(421.0, 446.0, 1.0)
READ_SD_RAD = D(0.05)


def flown():
    """A pulse of pressure through which the joint swings at 2.5 Hz, and the moment swings with it."""
    n = len(TIME_S)
    start, _ = pulse_of(np.random.default_rng(0), n)
    t = TIME_S - TIME_S[0]
    axial = 4.0 + 78.0 * np.exp(-(((t - 21.0) / 8.0) ** 2))
    side = 0.07 * axial[:, None] * np.stack([np.cos(0.3 + 0.03 * t), np.sin(0.3 + 0.03 * t)], axis=-1)
    ring = np.stack([0.25 * np.sin(15.7 * t), -0.2 * np.cos(15.7 * t), 0.25 * np.sin(15.7 * t + 1.0)], axis=-1)
    root = np.zeros((n, 3, 9))
    root[:, 1, 0] = root[:, 2, 1] = 0.03
    root[:, 1, 2] = root[:, 2, 3] = 2e-3 * axial
    return replace(
        start, time_s=TIME_S, specific_force_body_mps2=np.column_stack([-axial, side]), force_root_mps2=root,
        rate_body_radps=np.tile([0.6, 0.0, 0.0], (n, 1)), angular_acceleration_body_radps2=ring * [0.0, 1.0, 1.0],
        angular_acceleration_sd_radps2=0.01,
    )  # fmt: skip


PULSE = flown()


def drawn(rng, freeplay_rad=0.0):
    """A film's readings, and the true bendings in its frames: compliance, sensors' and camera's errors are drawn."""
    stated = joint_moment(PULSE)
    compliance = 1.0 / rng.uniform(3000.0, 9000.0)
    moment = stated.value_nm + stated.by_input_nm @ rng.standard_normal(stated.by_input_nm.shape[2])
    side = moment / np.linalg.norm(moment, axis=1, keepdims=True)
    theta = compliance * moment + freeplay_rad * side
    theta_yz = np.stack([np.interp(FRAMES_S, TIME_S, column) for column in theta.T], axis=-1)
    light = correlation_root(FRAMES_S, LIGHT_TIME_S)
    camera = np.sqrt(CONSTANT_PART) * rng.standard_normal(2)
    camera = camera + np.sqrt(1.0 - CONSTANT_PART) * light @ rng.standard_normal((light.shape[1], 2))
    n = len(FRAMES_S)
    read = theta_yz - theta_yz[0] + READ_SD_RAD * camera
    covariance = np.tile(READ_SD_RAD**2 * np.eye(2), (n, 1, 1))
    return RelativeDeflections(FRAMES_S, read, covariance, np.tile(np.eye(2), (n, 1, 1)), FRAMES_S[0]), theta_yz


def errors_of(count, freeplay_rad=0.0):
    """Errors (count, 2) and standard deviations (count, 2), rad."""
    rng, rows = np.random.default_rng(4), []
    for _ in range(count):
        frames, true = drawn(rng, freeplay_rad)
        got = benchmark_deflection(frames, PULSE, PRIOR_RAD)
        rows.append((got.theta_yz_rad - true[0], np.sqrt(np.diag(got.covariance)), true[0]))
    error, sd, true = np.moveaxis(np.array(rows), 1, 0)
    return error, sd, true


def test_the_moment_is_that_about_the_joint():
    """The same law with the inertia and the specific force at the joint, not at the c.g."""
    rng = np.random.default_rng(1)
    loads = replace(
        PULSE,
        rate_body_radps=rng.normal(size=(len(TIME_S), 3)),
        angular_acceleration_body_radps2=rng.normal(size=(len(TIME_S), 3)),
    )
    body = VEHICLE.centerbody
    rate, turn = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    r = body.cg_m - VEHICLE.joint_m
    about = body.inertia + body.mass_kg * (r @ r * np.eye(3) - np.outer(r, r))
    to = VEHICLE.joint_m - VEHICLE.cg_m
    at_joint = loads.specific_force_body_mps2 + np.cross(turn, to) + np.cross(rate, np.cross(rate, to))
    tau = turn @ about.T + np.cross(rate, rate @ about.T) + np.cross(r, body.mass_kg * at_joint)
    np.testing.assert_allclose(joint_moment(loads).value_nm, np.column_stack([tau[:, 2], -tau[:, 1]]), atol=1e-9)


def test_errors_lie_in_their_bars_whatever_the_compliance():
    """200 draws of two axes."""
    error, sd, true = errors_of(200)
    assert np.sqrt(np.mean(error**2)) < 0.7 * np.sqrt(np.mean(true**2))
    # slack and freeplay that the film cannot rule out stay in the bar: it is wide, but a quarter of the former 0.12 deg
    assert np.sqrt(np.mean(sd**2)) < D(0.04)
    assert np.mean(np.abs(error) < sd) > 0.61
    assert np.mean(np.abs(error) < 2.0 * sd) > 0.93


def test_its_error_goes_against_that_of_the_readings_as_it_says():
    """100 draws of two axes, mean over all frames; mirror images of the camera's errors make the rest fall out."""
    rng, k, products, stated = np.random.default_rng(5), 20, [], []
    for _ in range(100):
        frames, true = drawn(rng)
        error = frames.theta_yz_rad - (true - true[0])
        mirrored = replace(frames, theta_yz_rad=frames.theta_yz_rad - 2.0 * error)
        got, other = (benchmark_deflection(f, PULSE, PRIOR_RAD) for f in (frames, mirrored))
        products.append(error.mean(axis=0) * 0.5 * (got.theta_yz_rad - other.theta_yz_rad))
        stated.append(0.5 * np.diag((got.with_readings + other.with_readings).mean(axis=0)))
        whole = np.block([[frames.covariance[k], got.with_readings[k]], [got.with_readings[k].T, got.covariance]])
        assert np.linalg.eigvalsh(whole).min() > 0.0
    mean, sd_of_mean = np.mean(products), np.std(products) / np.sqrt(np.size(products))
    assert mean < -4.0 * sd_of_mean
    assert np.mean(stated) == pytest.approx(mean, abs=3.0 * sd_of_mean)


def test_with_freeplay_the_bar_grows():
    error, sd, _ = errors_of(40, D(0.3))
    _, without, _ = errors_of(20)
    assert sd.mean() > 2.0 * without.mean()
    assert np.mean(np.abs(error) < sd) > 0.4
    assert np.mean(np.abs(error) < 2.0 * sd) > 0.7


def test_a_camera_time_bias_widens_the_bar():
    frames, _ = drawn(np.random.default_rng(2))
    sharp = benchmark_deflection(frames, PULSE, PRIOR_RAD)
    late = benchmark_deflection(replace(frames, time_bias_sd_s=0.02), PULSE, PRIOR_RAD)
    assert np.trace(late.covariance) > np.trace(sharp.covariance)


def refused(frames, loads, code):
    with pytest.raises(GateError) as refusal:
        benchmark_deflection(frames, loads, PRIOR_RAD)
    assert refusal.value.codes == (code,)
    return str(refusal.value)


def test_what_is_not_observable_is_refused_with_the_reason():
    frames, _ = drawn(np.random.default_rng(3))
    assert "0.30 s" in refused(replace(frames, time_bias_sd_s=0.3), PULSE, "camera-time-bias")
    refused(replace(frames, benchmark_s=410.0), PULSE, "data-gap")
    dark = frames.theta_yz_rad.copy()
    dark[6:] = np.nan
    assert numbers_in(refused(replace(frames, theta_yz_rad=dark), PULSE, "too-few-data"))[0] == 6.0
    n = len(TIME_S)
    even = {"specific_force_body_mps2": np.tile([-9.0, 0.5, 0.2], (n, 1)), "rate_body_radps": np.zeros((n, 3))}
    light = replace(PULSE, **even, angular_acceleration_body_radps2=np.zeros((n, 3)))
    refused(frames, light, "benchmark-loaded")


def test_a_known_benchmark_deflection_is_as_good_as_none():
    """Benchmark deflected by 0.4 deg, more than its prior allows: missing everywhere, and added again."""
    theta_deg, plane_deg = [0.4, 4.0, 3.5], [40.0, 190.0, 170.0]
    frames = film(3, theta_deg, plane_deg)
    read = read_film(np.array([421.0, 440.0, 441.0]), frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None)
    true = D(0.4) * np.array([-np.cos(D(40.0)), np.sin(D(40.0))])
    plain = read.history()
    put_back = read.history(BenchmarkDeflection(true, D(0.01) ** 2 * np.eye(2)))
    assert np.abs(plain.theta_rad[1:] - D(np.array(theta_deg[1:]))).max() > D(0.25)
    assert np.abs(put_back.theta_rad[1:] - D(np.array(theta_deg[1:]))).max() < D(0.12)
    assert (put_back.theta_sd_rad < 0.7 * plain.theta_sd_rad)[1:].all()
    assert (0.4, 40.0) in itertools.pairwise(numbers_in(put_back.assumptions))
    # what its error and the readings' share is in the bar; a frame that was refused has none
    together = np.array([np.full((2, 2), np.nan), -2e-8 * np.eye(2), -2e-8 * np.eye(2)])
    less = read.history(BenchmarkDeflection(true, D(0.01) ** 2 * np.eye(2), together))
    shared = together @ read.relative_to_benchmark().per_benchmark.transpose(0, 2, 1)
    shared = shared + shared.transpose(0, 2, 1)
    np.testing.assert_allclose((less.lateral_cov - put_back.lateral_cov)[1:], shared[1:], atol=1e-14)
    # nothing is added to a history by telling what was taken before
    same = read.history(BenchmarkDeflection(np.zeros(2), PRIOR_RAD**2 * np.eye(2)))
    np.testing.assert_allclose(same.theta_rad, plain.theta_rad, atol=1e-12)
    np.testing.assert_allclose(same.covariance, plain.covariance, atol=1e-12)


def test_an_assumed_plane_has_no_relative_deflections():
    frames = film(4, [0.0, 4.0], [0.0, 160.0])
    read = read_film(np.array([421.0, 440.0]), frames, GEOMETRY, MOUNT, JOINT_M)
    with pytest.raises(GateError) as refusal:
        read.relative_to_benchmark()
    assert refusal.value.codes == ("keys-conflict",)


def test_a_shape_that_follows_the_load_does_not_pass_for_compliance():
    """A reading's error that grows with the pressure, in any direction: stated as common it leaves less of it."""
    rng, stated, hidden = np.random.default_rng(9), [], []
    pressure = -np.interp(FRAMES_S, TIME_S, PULSE.specific_force_body_mps2[:, 0])
    load = (pressure - pressure[0]) / pressure.max()
    by_shape = D(0.3) * load[:, None, None] * np.eye(2)
    for _ in range(25):
        frames, true = drawn(rng)
        read = frames.theta_yz_rad + by_shape @ rng.standard_normal(2)
        whole = frames.covariance + by_shape @ by_shape.transpose(0, 2, 1)
        spoilt = replace(frames, theta_yz_rad=read, covariance=whole)
        for given, rows in ((replace(spoilt, by_shape=by_shape), stated), (spoilt, hidden)):
            got = benchmark_deflection(given, PULSE, PRIOR_RAD)
            rows.append(got.theta_yz_rad - true[0])
    assert np.mean(np.square(stated)) < np.mean(np.square(hidden))


def test_the_shape_s_error_is_common_to_all_frames_and_the_rest_is_the_camera_s_own():
    frames, _ = drawn(np.random.default_rng(3))
    by_shape = D(0.1) * np.random.default_rng(4).standard_normal((len(FRAMES_S), 2, 3))
    square = by_shape @ by_shape.transpose(0, 2, 1)
    with_shape = replace(frames, by_shape=by_shape, covariance=frames.covariance + square)
    rows = np.arange(len(FRAMES_S))
    blocks = _camera_covariance(with_shape, rows, rows).reshape(len(rows), 2, len(rows), 2)
    alone = _camera_covariance(frames, rows, rows).reshape(len(rows), 2, len(rows), 2)
    for i, j in ((0, 0), (3, 20), (20, 3)):
        np.testing.assert_allclose(blocks[i, :, j], alone[i, :, j] + by_shape[i] @ by_shape[j].T, atol=1e-12)

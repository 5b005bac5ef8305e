"""Transient offsets and repeated blocks: found where they are, and nowhere else; accepted or rejected."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.telemetry import TriadRecord
from recon.estimate import bridge_inertial_sensors, estimate
from recon.fault_detection import unsupported_offsets, window_scores
from recon.imu_screening import _REACH, TransientOffset, bridge, repeated_samples, transient_offsets
from recon.kalman import forward
from recon.settings import Settings
from recon.setup import build_problem
from tests.oracles import bryson_frazier

from . import linear
from .conftest import ACCELEROMETER

SD, STEP_S = 0.05, 0.004
T = np.arange(0.0, 20.0, STEP_S)


def oscillation(seed, amplitude=20.0, hz=2.5):
    """Samples of a vehicle that oscillates at a slowly growing rate."""
    rng = np.random.default_rng(seed)
    return amplitude * np.sin(2.0 * np.pi * hz * T * (1.0 + 0.01 * T)) + SD * rng.standard_normal(len(T))


def rows(start, end):
    return slice(*np.searchsorted(T, [start - 1e-9, end - 1e-9]))


@pytest.mark.parametrize("seed", range(20))
def test_an_oscillation_holds_no_offset(seed):
    assert transient_offsets(T, oscillation(seed), SD) == []


@pytest.mark.parametrize("offset", [1.0, -1.0, 5.0])
@pytest.mark.parametrize("length", [0.2, 2.0, 9.0])
def test_an_offset_that_comes_and_goes(offset, length):
    x = oscillation(1)
    span = rows(5.0, 5.0 + length)
    x[span] += offset
    ((first, last, size),) = transient_offsets(T, x, SD)
    assert (first, last) == (span.start, span.stop - 1)
    # a parabola through six samples carried half a step further has 1.3 times their noise; four of its sd
    assert size == pytest.approx(offset, abs=4.0 * 1.3 * SD * np.sqrt(2.0))


def test_blocks_in_the_wrong_order():
    x = oscillation(2)
    one, other = x[rows(5.0, 6.0)].copy(), x[rows(6.0, 7.0)].copy()
    x[rows(5.0, 6.0)], x[rows(6.0, 7.0)] = other, one
    ((first, last, _),) = transient_offsets(T, x, SD)
    assert (first, last) == (rows(5.0, 7.0).start, rows(5.0, 7.0).stop - 1)


def test_motion_of_a_vehicle_is_no_transient_offset():
    rng = np.random.default_rng(3)
    stage = oscillation(3) + 30.0 * (T > 8.0)
    pulse_too_long = oscillation(3) + 3.0 * ((T > 4.0) & (T < 15.0))
    motor = oscillation(3) + 20.0 * np.clip((T - 5.0) / 0.2, 0.0, 1.0) * (T < 9.0)
    motor[(T > 5.0) & (T < 9.0)] += 3.0 * rng.standard_normal(int(((T > 5.0) & (T < 9.0)).sum()))
    one_wild = oscillation(3)
    one_wild[2500] += 9.0
    for x in (stage, pulse_too_long, motor, one_wild):
        assert transient_offsets(T, x, SD) == []


def test_a_gap_is_no_jump():
    kept = np.ones(len(T), dtype=bool)
    kept[rows(5.0, 5.1)] = kept[rows(7.0, 7.06)] = False
    assert transient_offsets(T[kept], oscillation(4)[kept], SD) == []
    few = 4 * _REACH - 1
    assert transient_offsets(T[:few], oscillation(4)[:few], SD) == []


def repeated_block(seed, step):
    """Readings of step ``step`` in which the second from 6 s is that from 5 s once more."""
    x = np.column_stack([oscillation(seed + k) for k in range(3)])
    x = step * np.round(x / step)
    x[rows(6.0, 7.0)] = x[rows(5.0, 6.0)]
    return x


@pytest.mark.parametrize("step", [1e-4, 0.03])
@pytest.mark.parametrize("seed", range(3))
def test_a_block_repeated_block(seed, step):
    x = repeated_block(seed, step)
    repeated, blocks = repeated_samples(x, SD)
    span = rows(6.0, 7.0)
    assert blocks == [(span.start, span.stop - 1, rows(5.0, 6.0).start)]
    assert np.array_equal(np.flatnonzero(repeated), np.arange(span.start, span.stop))


@pytest.mark.parametrize("seed", range(5))
def test_a_coarse_sensor_at_rest_repeats_no_block(seed):
    """Of a step twice the noise a reading repeats in two of three cases: no run of repeats is a surprise."""
    rng = np.random.default_rng(seed)
    x = 2.0 * SD * np.round(rng.standard_normal((20_000, 3)) / 2.0)
    assert repeated_samples(x, SD)[1] == []
    assert repeated_samples(np.repeat(x[::40], 40, axis=0), 0.0)[1] == []


def test_rejected_readings_are_bridged_and_add_to_the_noise():
    """Bridge and readings may both be right: the integral is uncertain by as much as they differ."""
    x = np.column_stack([oscillation(k, amplitude=1.0, hz=0.2) for k in range(3)])
    x[rows(6.0, 8.0), 1] += 2.0
    record = TriadRecord(replace(ACCELEROMETER, noise_sd=SD, resolution=0.0, dcm_body_sensor=np.eye(3)), T, x)
    (offset,) = bridge(record).offsets
    assert (offset.axis, offset.sensor) == (1, 0)
    accepted, rejected = bridge(record), bridge(record, 0, (offset,))
    assert not accepted.findings
    assert {(f.source, f.code) for f in rejected.findings} == {
        ("accelerometer", "transient-offset"), ("accelerometer", "gap-bridged"),
    }  # fmt: skip
    inside = (rejected.time_s > 6.01) & (rejected.time_s < 7.99)
    moved = accepted.measured_sensor[inside, 1] - rejected.measured_sensor[inside, 1]
    assert np.array_equal(rejected.measured_sensor[:, [0, 2]], accepted.measured_sensor[:, [0, 2]])
    integral_sd = np.sqrt(rejected.density[inside, 1] * 2.0)
    assert (integral_sd >= abs(moved.mean()) * 1.99).all()
    assert moved.mean() == pytest.approx(2.0, abs=0.7)  # as good as a cubic over a fifth of a period is


@pytest.fixture(scope="module")
def forward_pass(mini_sense):
    telemetry, _ = mini_sense(5)
    problem = build_problem(telemetry, Settings(output_rate_hz=5.0), bridge_inertial_sensors(telemetry))
    return problem, forward(problem)


def test_offsets_are_accepted_where_the_trackers_support_them(forward_pass):
    right = tuple(
        TransientOffset(sensor, axis, 125.0, 129.0, size) for sensor, size in ((0, 5.0), (1, 0.3)) for axis in (1, 2)
    )
    unclear = tuple(replace(d, offset=0.001 * d.offset) for d in right)
    assert unsupported_offsets(*forward_pass, right) == ()
    assert unsupported_offsets(*forward_pass, unclear) == unclear
    considering = replace(forward_pass[0], model=forward_pass[0].model.considering(["accelerometer scale"]))
    assert unsupported_offsets(considering, forward_pass[1], right) == right
    assert unsupported_offsets(*forward_pass, ()) == ()


def test_a_fault_is_rejected_and_the_next_reconstruction_starts_from_that(mini_sense):
    telemetry, _ = mini_sense(6)
    force = telemetry.accelerometer
    x = force.measured_sensor.copy()
    x[(force.time_s > 126.0) & (force.time_s < 128.0), 2] += 4.0
    wrong = replace(telemetry, accelerometer=replace(force, measured_sensor=x))
    found = estimate(wrong, Settings(output_rate_hz=5.0))
    (rejected,) = found.adaptation.rejected_offsets
    assert (rejected.sensor, rejected.axis) == (0, 2)
    assert rejected.offset == pytest.approx(4.0, abs=0.5)
    assert "transient-offset" in {f.code for f in found.findings}
    again = estimate(wrong, Settings(output_rate_hz=5.0), adaptation=found.adaptation)
    assert np.array_equal(again.smoothed.position_ecef_m, found.smoothed.position_ecef_m)
    clean = estimate(telemetry, Settings(output_rate_hz=5.0))
    assert clean.adaptation.rejected_offsets == ()


def likelihood(problem, columns, begin, end, offset):
    """Logarithm of the likelihood of all measurements where an offset (c,) acts in some steps."""
    moved = problem.offset.copy()
    for k in range(begin, end):
        moved[k + 1, :9] += problem.steps.transition[k][:, columns] @ offset
    _, v = linear.run(replace(problem, offset=moved))
    total = 0.0
    for row, variance in enumerate(problem.observed.variance):
        used = np.flatnonzero(np.isfinite(variance))
        y = v.residual[row, used]
        total -= 0.5 * y @ np.linalg.solve(v.covariance[row][np.ix_(used, used)], y)
    return total


@pytest.mark.parametrize("seed", range(3))
def test_scores_are_the_likelihood_of_an_offset(seed):
    problem = linear.random_problem(seed)
    columns = np.array([9, 11, 19])
    _, innovations = linear.run(problem)
    about = problem.steps, problem.observed, problem.slots, problem.readings, innovations, columns
    begin, end = np.array([9, 3, 3, 0]), np.array([13, 8, 5, 2])
    score, variance = np.zeros((4, 3)), np.zeros((4, 3, 3))
    window_scores(*about, begin, end, 3, score, variance)
    rng = np.random.default_rng(seed)
    for w in range(4):
        s, v = bryson_frazier.offset_scores(*about, begin[w], end[w])
        np.testing.assert_allclose(score[w], s, rtol=1e-9, atol=1e-9 * np.abs(s).max())
        np.testing.assert_allclose(variance[w], v, rtol=1e-9, atol=1e-9 * np.abs(v).max())
        d = rng.standard_normal(3)
        gained = likelihood(problem, columns, begin[w], end[w], d) - likelihood(problem, columns, 0, 0, d)
        assert -s @ d - 0.5 * d @ v @ d == pytest.approx(gained, rel=1e-7, abs=1e-7)

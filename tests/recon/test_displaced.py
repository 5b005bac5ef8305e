"""Readings that jump away and back, blocks told twice: found where they are, and nowhere else; doubted or believed."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.telemetry import TriadRecord
from recon import unmodelled
from recon.ekf import forward
from recon.imu_screening import REACH, Displaced, bridge, displaced_runs, repeated_samples
from recon.reconstruct import bridge_triads, reconstruct_once
from recon.settings import Settings
from recon.setup import build_problem

from . import linear
from .conftest import ACCELEROMETER

SD, STEP_S = 0.05, 0.004
T = np.arange(0.0, 20.0, STEP_S)


def swinging(seed, amplitude=20.0, hz=2.5):
    """Samples of a vehicle that swings at a slowly growing rate."""
    rng = np.random.default_rng(seed)
    return amplitude * np.sin(2.0 * np.pi * hz * T * (1.0 + 0.01 * T)) + SD * rng.standard_normal(len(T))


def rows(start, end):
    return slice(*np.searchsorted(T, [start - 1e-9, end - 1e-9]))


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_displaced_in_what_swings(seed):
    assert displaced_runs(T, swinging(seed), SD) == []


@pytest.mark.parametrize("offset", [1.0, -1.0, 5.0])
@pytest.mark.parametrize("length", [0.2, 2.0, 9.0])
def test_an_offset_that_comes_and_goes(offset, length):
    x = swinging(1)
    span = rows(5.0, 5.0 + length)
    x[span] += offset
    ((first, last, size),) = displaced_runs(T, x, SD)
    assert (first, last) == (span.start, span.stop - 1)
    # a parabola through six samples carried half a step further has 1.3 times their noise; four of its sd
    assert size == pytest.approx(offset, abs=4.0 * 1.3 * SD * np.sqrt(2.0))


def test_blocks_in_the_wrong_order():
    x = swinging(2)
    one, other = x[rows(5.0, 6.0)].copy(), x[rows(6.0, 7.0)].copy()
    x[rows(5.0, 6.0)], x[rows(6.0, 7.0)] = other, one
    ((first, last, _),) = displaced_runs(T, x, SD)
    assert (first, last) == (rows(5.0, 7.0).start, rows(5.0, 7.0).stop - 1)


def test_what_a_vehicle_does_is_not_displaced():
    rng = np.random.default_rng(3)
    stage = swinging(3) + 30.0 * (T > 8.0)
    pulse_too_long = swinging(3) + 3.0 * ((T > 4.0) & (T < 15.0))
    motor = swinging(3) + 20.0 * np.clip((T - 5.0) / 0.2, 0.0, 1.0) * (T < 9.0)
    motor[(T > 5.0) & (T < 9.0)] += 3.0 * rng.standard_normal(int(((T > 5.0) & (T < 9.0)).sum()))
    one_wild = swinging(3)
    one_wild[2500] += 9.0
    for x in (stage, pulse_too_long, motor, one_wild):
        assert displaced_runs(T, x, SD) == []


def test_a_gap_is_no_jump():
    kept = np.ones(len(T), dtype=bool)
    kept[rows(5.0, 5.1)] = kept[rows(7.0, 7.06)] = False
    assert displaced_runs(T[kept], swinging(4)[kept], SD) == []
    few = 4 * REACH - 1
    assert displaced_runs(T[:few], swinging(4)[:few], SD) == []


def told_twice(seed, step):
    """Readings of step ``step`` in which the second from 6 s is that from 5 s once more."""
    x = np.column_stack([swinging(seed + k) for k in range(3)])
    x = step * np.round(x / step)
    x[rows(6.0, 7.0)] = x[rows(5.0, 6.0)]
    return x


@pytest.mark.parametrize("step", [1e-4, 0.03])
@pytest.mark.parametrize("seed", range(3))
def test_a_block_told_twice(seed, step):
    x = told_twice(seed, step)
    repeated, blocks = repeated_samples(x, SD)
    span = rows(6.0, 7.0)
    assert blocks == [(span.start, span.stop - 1, rows(5.0, 6.0).start)]
    assert np.array_equal(np.flatnonzero(repeated), np.arange(span.start, span.stop))


@pytest.mark.parametrize("seed", range(5))
def test_a_coarse_sensor_at_rest_tells_nothing_twice(seed):
    """Of a step twice the noise a reading repeats in two of three cases: no run of repeats is a surprise."""
    rng = np.random.default_rng(seed)
    x = 2.0 * SD * np.round(rng.standard_normal((20_000, 3)) / 2.0)
    assert repeated_samples(x, SD)[1] == []
    assert repeated_samples(np.repeat(x[::40], 40, axis=0), 0.0)[1] == []


def test_what_is_doubted_is_bridged_and_reckoned_with():
    """Bridge and readings may both be right: the integral is uncertain by as much as they differ."""
    x = np.column_stack([swinging(k, amplitude=1.0, hz=0.2) for k in range(3)])
    x[rows(6.0, 8.0), 1] += 2.0
    record = TriadRecord(replace(ACCELEROMETER, noise_sd=SD, resolution=0.0), T, x)
    (displaced,) = bridge(record).displaced
    assert (displaced.axis, displaced.triad) == (1, 0)
    believed, doubted = bridge(record), bridge(record, 0, (displaced,))
    assert not believed.findings
    assert {f.source for f in doubted.findings} == {"accelerometer"}
    inside = (doubted.time_s > 6.01) & (doubted.time_s < 7.99)
    moved = believed.measured_sensor[inside, 1] - doubted.measured_sensor[inside, 1]
    assert np.array_equal(doubted.measured_sensor[:, [0, 2]], believed.measured_sensor[:, [0, 2]])
    (told,) = (f for f in doubted.findings if "bridged" in f.what)
    assert float(told.what.split("uncertain by ")[1].split()[0]) >= abs(moved.mean()) * 1.99
    assert moved.mean() == pytest.approx(2.0, abs=0.7)  # as good as a cubic over a fifth of a period is


@pytest.fixture(scope="module")
def believed(mini_sense):
    telemetry, _ = mini_sense(5)
    problem = build_problem(telemetry, Settings(output_rate_hz=5.0), bridge_triads(telemetry))
    return problem, forward(problem)


def test_readings_are_believed_where_the_trackers_tell_that_they_are_right(believed):
    right = tuple(Displaced(triad, axis, 125.0, 129.0, size) for triad, size in ((0, 5.0), (1, 0.3)) for axis in (1, 2))
    unclear = tuple(replace(d, offset=0.001 * d.offset) for d in right)
    assert unmodelled.doubtful(*believed, right) == ()
    assert unmodelled.doubtful(*believed, unclear) == unclear
    considering = replace(believed[0], model=believed[0].model.considering(["accelerometer scale"]))
    assert unmodelled.doubtful(considering, believed[1], right) == right
    assert unmodelled.doubtful(*believed, ()) == ()


def test_a_fault_is_doubted_and_the_next_reconstruction_knows(mini_sense):
    telemetry, _ = mini_sense(6)
    force = telemetry.accelerometer
    x = force.measured_sensor.copy()
    x[(force.time_s > 126.0) & (force.time_s < 128.0), 2] += 4.0
    wrong = replace(telemetry, accelerometer=replace(force, measured_sensor=x))
    found = reconstruct_once(wrong, Settings(output_rate_hz=5.0))
    (doubted,) = found.learnt.doubted
    assert (doubted.triad, doubted.axis) == (0, 2)
    assert doubted.offset == pytest.approx(4.0, abs=0.5)
    assert any("jumps by about" in f.what for f in found.findings)
    again = reconstruct_once(wrong, Settings(output_rate_hz=5.0), learnt=found.learnt)
    assert np.array_equal(again.smoothed.position_ecef_m, found.smoothed.position_ecef_m)
    clean = reconstruct_once(telemetry, Settings(output_rate_hz=5.0))
    assert clean.learnt.doubted == ()


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
    about = problem.steps, problem.observed, problem.slots, innovations, columns
    begin, end = np.array([9, 3, 3, 0]), np.array([13, 8, 5, 2])
    score, variance = np.zeros((4, 3)), np.zeros((4, 3, 3))
    unmodelled._shock_kernels.window_scores(*about, begin, end, 3, score, variance)
    rng = np.random.default_rng(seed)
    for w in range(4):
        s, v = unmodelled.readable_scores(*about, begin[w], end[w])
        np.testing.assert_allclose(score[w], s, rtol=1e-9, atol=1e-9 * np.abs(s).max())
        np.testing.assert_allclose(variance[w], v, rtol=1e-9, atol=1e-9 * np.abs(v).max())
        d = rng.standard_normal(3)
        gained = likelihood(problem, columns, begin[w], end[w], d) - likelihood(problem, columns, 0, 0, d)
        assert -s @ d - 0.5 * d @ v @ d == pytest.approx(gained, rel=1e-7, abs=1e-7)

"""Every smoother is the conditioning of one large Gaussian; on flights, where that cannot be solved, all are one."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.instruments import GnssSpec
from recon import fault_detection, kalman
from recon.kalman import forward, smooth
from recon.linearise import full_step
from recon.settings import ENGINES
from recon.state import unpacked
from tests.oracles import bryson_frazier
from tests.oracles.plain_smoother import rauch_tung_striebel, step_gain

from . import linear
from .ballistic_flight import fly, watch
from .conftest import END, START, measure_gnss
from .problems import build, off_in_covariance

ALL = ("rauch-tung-striebel", "plain rauch-tung-striebel", "bryson-frazier", "two-filter")


def node_blocks(covariance, n, size):
    return np.array([covariance[k * size : (k + 1) * size, k * size : (k + 1) * size] for k in range(n)])


@pytest.mark.parametrize("drivers", [18, 6])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("forward_engine", ENGINES)
def test_smoothers_equal_conditioning_the_joint_gaussian(seed, drivers, forward_engine):
    """Uneven steps, nodes without measurements, drivers and source errors that wander or walk, and constants.

    Condition of the joint covariance is about 1e6, of decays 0.01: rounding of 1e-16 leaves 1e-9. Measured 5e-10.
    """
    problem = linear.random_problem(seed, drivers)
    posterior, covariance = linear.condition(problem)
    n, size = posterior.shape
    exact = node_blocks(covariance, n, size)
    sd = np.sqrt(np.diagonal(exact, axis1=1, axis2=2))
    dense = slice(0, 9 + drivers)
    out, innovations = linear.run(problem, forward_engine)
    for method in ALL:
        x, triangles, variance = linear.smooth(problem, out, innovations, method)
        assert (np.abs(x - posterior) / sd).max() < 1e-8, method
        off = np.abs(unpacked(triangles) - exact[:, dense, dense]) / (sd[:, dense, None] * sd[:, None, dense])
        assert off.max() < 1e-8, method
        assert np.abs(variance / sd**2 - 1.0).max() < 1e-8, method


def test_problem_is_as_hard_as_it_says():
    problem = linear.random_problem(0)
    per_node = np.diff(problem.observed.first)
    assert (per_node[4:7] == 0).all()
    assert (per_node > 0).sum() >= 6
    decay = problem.steps.decay
    assert decay.min() < 0.05
    assert (decay == 1.0).any()
    assert len(problem.moving) == 9 + 5
    assert np.isinf(problem.observed.variance).sum() == 3
    assert set(problem.observed.source) == {0, 1}


def test_gain_equals_the_textbook_form():
    problem = linear.random_problem(2)
    out, _ = linear.run(problem)
    x, p = problem.start, problem.start_covariance
    moving = problem.moving
    for k in range(len(problem.offset) - 1):
        for row in np.flatnonzero(problem.node == k):
            h, r = problem.jacobian(row), problem.noise(row)
            gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
            p = (np.eye(len(x)) - gain @ h) @ p
        f, q = full_step(problem.steps, k)
        prior = f @ p @ f.T + q
        textbook = p @ f.T @ np.linalg.inv(prior)
        ours, added = step_gain(f[moving], q[np.ix_(moving, moving)], unpacked(out.p_minus[k + 1]), moving)
        assert np.allclose(ours, textbook[moving], rtol=1e-7, atol=1e-8)
        assert np.allclose(added, (p - textbook @ prior @ textbook.T)[np.ix_(moving, moving)], atol=1e-8)
        still = np.setdiff1d(np.arange(len(x)), moving)
        assert np.abs(textbook[still] - np.eye(len(x))[still]).max() < 1e-6  # constants stay what they are
        p = prior


def forgetful(problem, least):
    """Same problem with steps of many time constants; a decay is at least what it is told."""
    s, sd = problem.steps, problem.wander.sd
    decay, noise_var = s.decay.copy(), s.noise_var.copy()
    for j in np.flatnonzero(np.isfinite(problem.wander.time_constant_s)):
        decay[:, j] = np.maximum(least, decay[:, j] ** 40)
        noise_var[:, j] = sd[j] ** 2 * (1.0 - decay[:, j] ** 2)
    return replace(problem, steps=s._replace(decay=decay, noise_var=noise_var))


@pytest.mark.parametrize("seed", range(3))
def test_errors_that_were_forgotten_are_smoothed_without_garbage(seed):
    """Decays of 1e-3 cost six digits of a variance; those of 1e-6, which the filter does not let happen, all."""
    problem = forgetful(linear.random_problem(seed), 1e-3)
    posterior, covariance = linear.condition(problem)
    sd = np.sqrt(np.diag(covariance)).reshape(posterior.shape)
    out, innovations = linear.run(problem)
    for method in ALL:
        x, _, variance = linear.smooth(problem, out, innovations, method)
        assert (np.abs(x - posterior) / sd).max() < 1e-8
        assert np.abs(variance / sd**2 - 1.0).max() < 3e-6
    worse = forgetful(linear.random_problem(seed), 1e-6)
    posterior, covariance = linear.condition(worse)
    sd = np.sqrt(np.diag(covariance)).reshape(posterior.shape)
    _, _, variance = linear.smooth(worse, *linear.run(worse), "rauch-tung-striebel")
    assert np.abs(variance / sd**2 - 1.0).max() > 1e-4


@pytest.fixture(scope="module")
def flights(mini_everything):
    t, states = fly(5, end_s=60.0)
    fall = watch(t, states, 5, gap_s=(20.0, 40.0))
    return {
        "trackers": build(mini_everything(2)),
        "all kinds": build(mini_everything(2), attitude_sensors=True, end_s=107.0),
        "ballistic with a gap": build(fall, end_s=60.0),
    }


@pytest.mark.parametrize("name", ["trackers", "all kinds", "ballistic with a gap"])
def test_smoothers_agree_on_a_flight(flights, name):
    """After a prior of 1 km, smoothed to metres: P - P L P loses 1e6 of 1e-16, a few hundred times. Measured 6e-9."""
    problem = flights[name]
    first = forward(problem)
    reference = smooth(problem, first, with_covariance=False).states(first.charts)
    kept = problem.kept
    for run in (first, forward(problem, reference)):
        ours = smooth(problem, run)
        x, triangles, variance = run.filtered.x_plus.copy(), *map(np.empty_like, (ours.triangles, ours.variance))
        rauch_tung_striebel(run.steps, run.filtered, problem.moving, x, triangles, variance)
        other = bryson_frazier.smooth(problem, run)
        sd = np.sqrt(ours.variance)
        assert (np.abs(other.x - ours.x)[kept] / sd).max() < 1e-8
        assert off_in_covariance(ours.triangles, other.triangles) < 3e-8
        assert np.abs(other.variance / ours.variance - 1.0).max() < 3e-8
        assert (np.abs(x - ours.x)[kept] / sd).max() < 1e-11
        assert off_in_covariance(ours.triangles, triangles) < 1e-11
        assert np.abs(variance / ours.variance - 1.0).max() < 1e-11


@pytest.mark.parametrize("name", ["trackers", "ballistic with a gap"])
def test_two_filters_equal_the_others_where_nothing_is_considered(flights, name):
    problem = flights[name]
    run = forward(problem)
    x, count = run.filtered.x_minus.copy(), int(problem.kept.sum())
    triangles, variance = np.empty((count, problem.dense * (problem.dense + 1) // 2)), np.empty((count, problem.size))
    kalman.two_filter(
        run.steps, run.filtered, problem.observed, problem.sources().slot, run.readings, run.innovations,
        np.empty(0, dtype=np.int64), x, triangles, variance,
    )  # fmt: skip
    other = smooth(problem, run)
    assert (np.abs(other.x - x)[problem.kept] / np.sqrt(other.variance)).max() < 1e-8
    assert off_in_covariance(other.triangles, triangles) < 3e-8


def test_adjoint_keeps_its_digits_after_precise_points(mini_sense, mini_truth):
    """A receiver of 2 cm after a prior of 1 km: (1e3 / 0.02)^2 = 2.5e9 of 1e-16 is lost at the first nodes.

    Written as L - L K H the square of that would be: the covariance was noise.
    """
    spec = GnssSpec("fine", np.zeros(3), 0.02, 0.02, 0.01, 0.01)
    t = np.arange(START, START + 8.0, 0.2)
    fine = measure_gnss(mini_truth, spec, t, np.random.default_rng(1))
    telemetry = replace(mini_sense(1)[0], gnss={"fine": fine}, radars={})
    problem = build(telemetry, end_s=108.0)
    run = forward(problem)
    one, other = smooth(problem, run), bryson_frazier.smooth(problem, run)
    assert np.sqrt(one.variance[0, :3]).max() < 0.02
    assert (other.variance > 0.0).all()
    # sums of 40 points: a few thousand times 2.5e-7
    assert off_in_covariance(one.triangles, other.triangles) < 1e-3
    assert (np.abs(one.x - other.x)[problem.kept] / np.sqrt(one.variance)).max() < 1e-3
    begin, end = np.array([0]), np.array([len(problem.time_s) - 1])
    score, variance = fault_detection.offset_scores(problem, run, begin, end)
    slots, columns = problem.sources().slot, fault_detection._BIASES
    s, v = bryson_frazier.offset_scores(
        run.steps, problem.observed, slots, run.readings, run.innovations, columns, 0, end[0]
    )
    sd = np.sqrt(np.diagonal(v))
    assert (np.abs(score[0] - s) / sd).max() < 1e-3
    assert (np.abs(variance[0] - v) / np.outer(sd, sd)).max() < 1e-3


def test_smoother_of_a_last_node_is_the_filter(flights):
    for problem in flights.values():
        run = forward(problem)
        assert np.abs(smooth(problem, run).x[-1] - run.filtered.x_plus[-1]).max() < 1e-9
    assert END > START

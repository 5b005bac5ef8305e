"""What a filter that only considers some errors may claim, against the exact covariance of what it does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from recon.kalman import forward, smooth
from recon.settings import ENGINES
from recon.state import unpacked

from . import linear
from .problems import build, off_in_covariance

CONSIDERED = [3, 4, 5, 10, 18, 20, 22]  # drivers and errors of both sources
SEEDS = range(6)


def problem_of(seed):
    """Half of them with steps that hardly mix and make little noise, so that smoothing has much to do."""
    problem = linear.random_problem(seed, considered=CONSIDERED, prior=2.0 + 3.0 * seed)
    if seed < 3:
        return problem
    transition = problem.steps.transition.copy()
    transition[:, :, :9] = np.eye(9) + 0.1 * (transition[:, :, :9] - np.eye(9))
    return replace(problem, steps=problem.steps._replace(transition=transition, noise=1e-3 * problem.steps.noise))


@cache
def exact(seed, method):
    return linear.estimator_covariance(problem_of(seed), method)


def off(claimed, right):
    """Largest difference of covariances (n, d, d), scaled to correlations."""
    d = claimed.shape[-1]
    sd = np.sqrt(np.diagonal(right, axis1=1, axis2=2))[:, :d]
    return (np.abs(claimed - right[:, :d, :d]) / (sd[:, :, None] * sd[:, None, :])).max()


def free(problem):
    return np.setdiff1d(np.arange(len(problem.start)), problem.considered)


@pytest.mark.parametrize("seed", SEEDS)
def test_claims_are_exact(seed):
    """Filter, both smoothers that may follow it. Rounding as in the smoothers' own test; measured 3e-10 at most."""
    problem = problem_of(seed)
    for engine in ENGINES:
        out, innovations = linear.run(problem, engine)
        filtered = exact(seed, "two-filter")[0]
        assert off(unpacked(out.p_plus), filtered) < 1e-10
        for method in ("two-filter", "rauch-tung-striebel"):
            right = exact(seed, method)[1]
            _, triangles, variance = linear.smooth(problem, out, innovations, method)
            assert off(unpacked(triangles), right) < 1e-8
            ratio = np.sqrt(variance / np.diagonal(right, axis1=1, axis2=2))
            assert np.abs(ratio - 1.0).max() < 1e-8


@pytest.mark.parametrize("seed", SEEDS)
def test_two_filters_are_never_worse_than_the_filter_nor_better_than_estimating(seed):
    problem = problem_of(seed)
    out, innovations = linear.run(problem)
    filtered, smoothed = (
        np.sqrt(np.diagonal(p, axis1=1, axis2=2))[:, free(problem)] for p in exact(seed, "two-filter")[:2]
    )
    whole = replace(problem, wander=problem.wander._replace(considered=np.zeros_like(problem.wander.considered)))
    _, _, variance = linear.smooth(whole, *linear.run(whole), "rauch-tung-striebel")
    best = np.sqrt(variance)[:, free(problem)]
    assert (smoothed < filtered * (1.0 + 1e-9)).all()
    assert (smoothed > best * (1.0 - 1e-9)).all()
    assert (smoothed / filtered).min() < 0.7
    assert np.abs(linear.smooth(problem, out, innovations, "two-filter")[0][:, problem.considered]
                  - out.x_minus[:, problem.considered]).max() == 0.0  # fmt: skip


def test_rauch_tung_striebel_is_honest_but_worse_than_the_filter_that_it_smooths():
    """Why it is not used here: up to six times the filter's sd, and eight of what two filters reach."""
    worst, median = 0.0, []
    for seed in SEEDS:
        problem = problem_of(seed)
        filtered, smoothed = exact(seed, "rauch-tung-striebel")[:2]
        ratio = np.sqrt(np.diagonal(smoothed, axis1=1, axis2=2) / np.diagonal(filtered, axis1=1, axis2=2))
        worst = max(worst, ratio.max())
        median.append(np.median(ratio[:, free(problem)]))
    assert 4.0 < worst < 8.0  # measured 6.2
    assert max(median) < 1.0


@pytest.mark.parametrize("seed", SEEDS)
def test_difference_of_filter_and_smoother_is_as_large_as_claimed(seed):
    """McReynolds: cov(filtered - smoothed) = P_filter - P_smoother, which verdicts rest upon, holds for two filters."""
    problem = problem_of(seed)
    rows = free(problem)
    filtered, smoothed, difference = exact(seed, "two-filter")
    sd = np.sqrt(np.diagonal(filtered, axis1=1, axis2=2))
    wrong = np.abs(filtered - smoothed - difference) / (sd[:, :, None] * sd[:, None, :])
    assert wrong[:, rows][:, :, rows].max() < 1e-9
    filtered, smoothed, difference = exact(seed, "rauch-tung-striebel")
    wrong = np.abs(filtered - smoothed - difference) / (sd[:, :, None] * sd[:, None, :])
    assert wrong[:, rows][:, :, rows].max() > 0.1


CHOICES = [
    ("accelerometer bias",),
    ("accelerometer scale",),
    ("accelerometer mount", "rates mount"),
    ("west range bias", "west azimuth bias"),
]


@pytest.mark.parametrize("consider", CHOICES, ids=lambda names: names[0])
def test_considering_on_a_flight(mini_sense, consider):
    """Less certain than estimating, more than the filter; what it costs shows in the filter at least."""
    telemetry, _ = mini_sense(1)
    options = {"end_s": 125.0, "output_rate_hz": 2.0}
    whole, some = build(telemetry, **options), build(telemetry, **options, consider=consider)
    first = forward(whole)
    reference = smooth(whole, first, with_covariance=False).states(first.charts)
    run, full = forward(some, reference), forward(whole, reference)
    smoothed, best = smooth(some, run), smooth(whole, full)
    dense = [np.sqrt(np.diagonal(unpacked(t), axis1=1, axis2=2)) for t in (run.filtered.p_plus, smoothed.triangles)]
    assert (dense[1] <= dense[0] * (1.0 + 1e-7)).all()
    estimated = np.r_[np.arange(9), 9 + np.flatnonzero(~some.model.wander.considered)]
    # gates may edit a point more or less: then the two are not the same problem
    assert np.array_equal(run.innovations.accepted, full.innovations.accepted)
    assert (smoothed.variance[:, estimated] >= best.variance[:, estimated] * (1.0 - 1e-7)).all()
    assert np.sqrt(run.filtered.p_last.diagonal()[:9] / full.filtered.p_last.diagonal()[:9]).max() > 1.0005
    assert off_in_covariance(run.filtered.p_plus, run.filtered.p_plus) == 0.0


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("consider", CHOICES[1:3], ids=lambda names: names[0])
def test_considered_flights_err_as_they_claim(mini_sense, mini_truth, consider):
    """Ten flights whose errors are drawn from the data sheets: squared errors of nine coordinates over time."""
    from scipy.stats import chi2

    from flightmodel.trajectory import difference
    from recon.reconstruct import reconstruct
    from recon.settings import Settings

    values = []
    for seed in range(10):
        telemetry, _ = mini_sense(seed + 5000)
        r = reconstruct(telemetry, Settings(output_rate_hz=1.0, consider=consider, end_s=140.0))
        for trajectory in (r.smoothed, r.filtered):
            d = difference(trajectory, mini_truth.trajectory(trajectory.time_s))
            solved = np.linalg.solve(trajectory.covariance, d[..., None])[..., 0]
            values.append(np.einsum("ni,ni->n", d, solved)[[5, 15, 30, -1]])
        assert (r.sensor_errors.estimate[r.sensor_errors.treated == "considered"] == 0.0).all()
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 9 * 10) / 10
    mean = np.array(values).reshape(10, 2, 4).mean(axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean

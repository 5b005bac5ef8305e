"""Gauss-Newton finds what general optimisers find; its covariance is the scatter of its answers; it says failure."""

import numpy as np
import pytest
from scipy import optimize
from scipy.sparse import csr_array
from scipy.special import huber

from flightmodel.arrow import Arrow, lower_band
from flightmodel.least_squares import FIRST_DAMPING, Linearised, huber_factor, least_squares

TIME_S = np.linspace(0.0, 4.0, 60)
TRUE, MEAN = np.array([1.5, 0.6, 3.0]), np.array([1.2, 0.8, 2.5])
SD = 0.05 + 0.02 * np.cos(TIME_S)
ROOT = np.linalg.cholesky(np.array([[0.3, 0.1, 0.05], [0.1, 0.2, -0.04], [0.05, -0.04, 0.4]]))
INFORMATION = np.linalg.inv(ROOT @ ROOT.T)


def swing(x):
    """A decaying swing (n,) of an amplitude, a decay and a frequency, and its derivatives (n, 3)."""
    fade, phase = np.exp(-x[1] * TIME_S), x[2] * TIME_S
    value = x[0] * fade * np.cos(phase)
    return value, np.column_stack([fade * np.cos(phase), -TIME_S * value, -x[0] * TIME_S * fade * np.sin(phase)])


def fitted(read, start=MEAN, information=INFORMATION, mean=MEAN, limit_sd=np.inf, settled_sd=1e-6, **more):
    """The swing estimated of readings (n,)."""

    def linearised(x):
        value, slope = swing(x)
        robust = huber_factor((read - value) / SD, limit_sd)
        return Linearised.of(read - value, slope, SD**-2.0, information, x - mean, robust)

    return least_squares(linearised, np.array(start, dtype=float), settled_sd, **more)


def noisy(seed):
    return swing(TRUE)[0] + SD * np.random.default_rng(seed).standard_normal(len(TIME_S))


# from 0.3 the undamped first step doubles the frequency, and the steps end in another valley
@pytest.mark.parametrize("start", [MEAN, [0.3, 1.5, 2.0]])
def test_it_ends_where_scipy_does_with_a_prior(start):
    read = noisy(1)

    def rows(x):
        return np.concatenate([(read - swing(x)[0]) / SD, np.linalg.solve(ROOT, x - MEAN)])

    want = optimize.least_squares(rows, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    got = fitted(read, start)
    assert got.converged
    sd = np.sqrt(np.diag(got.covariance))
    # the derivatives of the peer are differences
    np.testing.assert_allclose((got.value - want.x) / sd, 0.0, atol=1e-5)
    assert got.linear.cost == pytest.approx(2.0 * want.cost, rel=1e-9)
    np.testing.assert_allclose(got.covariance, np.linalg.inv(want.jac.T @ want.jac), rtol=1e-5)
    assert got.condition == pytest.approx(np.linalg.cond(want.jac.T @ want.jac), rel=1e-4)


def test_robust_weights_lead_to_the_lowest_sum_of_huber_s_function():
    read = noisy(2)
    read[::7] += 1.0  # 15 to 30 sd
    limit = 1.5

    def cost(x):
        return 2.0 * np.sum(huber(limit, (read - swing(x)[0]) / SD)) + (x - MEAN) @ INFORMATION @ (x - MEAN)

    got = fitted(read, limit_sd=limit)
    best = optimize.minimize(cost, TRUE, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 9999})
    assert got.converged
    assert got.linear.cost == pytest.approx(best.fun, abs=1e-8)
    np.testing.assert_allclose(got.value, best.x, atol=1e-6)
    plain = fitted(read)
    assert np.linalg.norm(got.value - TRUE) < 0.5 * np.linalg.norm(plain.value - TRUE)


def test_covariance_is_the_scatter_of_the_answers_about_truths_that_the_prior_draws():
    rng, off, count = np.random.default_rng(3), [], 1500
    for seed in range(count):
        truth = MEAN + 0.1 * ROOT @ rng.standard_normal(3)
        read = swing(truth)[0] + SD * rng.standard_normal(len(TIME_S))
        got = fitted(read, information=100.0 * INFORMATION, settled_sd=1e-3)
        assert got.converged, seed
        off.append(np.linalg.solve(np.linalg.cholesky(got.covariance), got.value - truth))
    # mean squares of normals: 1 with an sd of sqrt(2 / count), products of two: 0 with 1 / sqrt(count); within 4 sd
    scatter = np.array(off).T @ np.array(off) / count
    assert np.abs(np.diag(scatter) - 1.0).max() < 4.0 * np.sqrt(2.0 / count)
    assert np.abs(scatter - np.diag(np.diag(scatter))).max() < 4.0 / np.sqrt(count)


def test_the_stop_is_a_share_of_the_sd_of_any_combination():
    read = noisy(4)
    exact = fitted(read, settled_sd=1e-9)
    root = np.linalg.cholesky(exact.linear.matrix.dense)
    steps = []
    for settled_sd in (10.0, 0.1, 1e-5):
        got = fitted(read, settled_sd=settled_sd)
        # steps shrink, so that those not taken are together shorter than the last one
        assert np.linalg.norm(root.T @ (got.value - exact.value)) < settled_sd
        steps.append(got.steps)
    assert steps == sorted(set(steps))


def test_what_does_not_converge_says_so():
    read = noisy(5)
    few = fitted(read, [0.3, 1.5, 2.0], most_steps=2)
    assert not few.converged
    assert few.steps == 2
    # no minimum at all: the cost falls for ever
    falling = least_squares(lambda x: Linearised.of(2.0 + np.exp(-x), np.exp(-x)[:, None]), np.zeros(1), 1e-9)
    assert not falling.converged
    # readings that depend on one combination alone, and none that is a number
    blind = fitted(read, information=0.0, mean=0.0)
    assert blind.converged
    for slope in ([[1.0, 1.0]], [[1.0, 0.0]], [[np.nan, 1.0]]):  # singular to the last bit
        one = np.array(slope)
        lost = least_squares(lambda x, one=one: Linearised.of(2.0 - one @ x, one), np.zeros(2), 1e-9)
        assert not lost.converged


def test_a_step_that_raises_the_cost_is_damped():
    looks = []

    def linearised(x):
        looks.append(float(x[0]))
        return Linearised.of(-np.arctan(x), 1.0 / (1.0 + x**2)[:, None])

    # Newton's steps on the arc tangent diverge from beyond 1.39
    got = least_squares(linearised, np.array([3.0]), 1e-9)
    assert got.converged
    assert got.value[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(looks[1]) > 3.0
    damped = 3.0 + (looks[1] - 3.0) / (1.0 + FIRST_DAMPING)
    assert looks[2] == pytest.approx(damped)


def test_an_arrow_as_the_matrix_is_solved_as_the_dense_one():
    # a random walk read through its sine, with an offset that all readings share: a band and a border
    rng, count = np.random.default_rng(6), 40
    walk, offset, sd = np.cumsum(0.1 * rng.standard_normal(count)), 0.6, 0.05
    read = offset + np.sin(walk) + sd * rng.standard_normal(count)
    change = np.diff(np.eye(count), axis=0)
    prior = np.zeros((count + 1, count + 1))
    prior[:count, :count] = change.T @ change / 0.1**2 + np.eye(count)
    prior[count, count] = 1.0 / 0.5**2
    mean = np.append(np.zeros(count), 1.0)

    def dense(x):
        slope = np.column_stack([np.diag(np.cos(x[:-1])), np.ones(count)])
        return Linearised.of(read - x[-1] - np.sin(x[:-1]), slope, sd**-2.0, prior, x - mean)

    def banded(x):
        whole = dense(x)
        matrix = whole.matrix.dense
        arrow = Arrow(lower_band(csr_array(matrix[:count, :count])), matrix[:count, count:], matrix[count:, count:])
        assert len(arrow.band) == 2
        return Linearised(arrow, whole.right, whole.cost, whole.residual)

    one, other = (least_squares(problem, mean, 0.01) for problem in (dense, banded))
    assert one.converged
    assert other.converged
    assert one.steps == other.steps > 3
    np.testing.assert_allclose(one.value, other.value, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(other.covariance, one.covariance[count:, count:], rtol=1e-9)
    for damping in (0.0, 1e-3, 10.0):
        np.testing.assert_allclose(banded(mean).step(damping), dense(mean).step(damping), rtol=1e-9, atol=1e-12)
    assert other.condition == pytest.approx(one.condition)

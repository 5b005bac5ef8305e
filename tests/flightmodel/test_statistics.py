"""Correlated errors: the root squares to the correlation; bands are those of two standard deviations."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2

from flightmodel.atmosphere import (
    SOUNDING_CONSTANT_PART,
    WIND_LENGTH_M,
    sounding_correlation,
    sounding_correlation_root,
    unresolved_variance,
    wave_correlation,
    wind_error_root,
)
from flightmodel.statistics import (
    chi_square_quantile,
    correlation,
    correlation_inverse,
    correlation_root,
    jackknife_variance,
    percentile_band,
)


@pytest.mark.parametrize("degrees", [1, 3, 57.5])
def test_quantiles_of_chi_square_are_those_of_the_library(degrees):
    for p in (1e-4, 0.3, 0.9999):
        assert chi_square_quantile(p, degrees) == pytest.approx(chi2.ppf(p, degrees), rel=1e-12)


def test_correlation_is_a_constant_part_and_a_decay():
    at = np.array([0.0, 1.0, 4.0])
    rho = correlation(at, 2.0, 0.3)
    assert np.allclose(np.diag(rho), 1.0)
    assert rho[0, 2] == pytest.approx(0.3 + 0.7 * np.exp(-2.0))
    assert (np.linalg.eigvalsh(rho) > 0.0).all()


def test_the_inverse_is_tridiagonal_less_an_outer_product():
    at = np.array([0.0, 0.4, 1.0, 1.1, 4.0])
    for part in (0.0, 0.3):
        diagonal, beside, u = correlation_inverse(at, 2.0, part)
        inverse = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1) - np.outer(u, u)
        np.testing.assert_allclose(inverse @ correlation(at, 2.0, part), np.eye(5), atol=1e-12)


def test_root_squares_to_the_correlation_at_its_knots():
    # three knots a length: places on the knots, shuffled, so that order does not matter
    at = 30e3 + 1000.0 * np.array([4.0, 0.0, 2.0, 6.0, 1.0, 3.0, 5.0])
    root = sounding_correlation_root(at, WIND_LENGTH_M)
    assert np.allclose(root @ root.T, sounding_correlation(at, WIND_LENGTH_M), atol=1e-12)


def test_places_between_knots_keep_unit_variance():
    root = correlation_root(np.linspace(0.0, 7.3, 50), 2.0, 0.4)
    assert np.allclose((root**2).sum(axis=1), 1.0)
    assert np.allclose(root[:, 0], np.sqrt(0.4))
    assert correlation_root(np.full(4, 3.0), 2.0).shape == (4, 1)
    assert correlation_root(np.empty(0), 2.0).shape == (0, 1)


def test_what_straight_lines_leave_out_is_the_mean_of_the_bridge():
    """Variance of a Gauss-Markov process about the line between its ends, averaged: to first order 2 h / L / 6."""
    length, h = WIND_LENGTH_M, 100.0
    x = np.linspace(0.0, 1.0, 1001)
    rho = np.exp(-h / length)
    to_ends = np.stack([np.exp(-x * h / length), np.exp(-(1.0 - x) * h / length)])
    w = np.stack([1.0 - x, x])
    variance = 1.0 - 2.0 * (w * to_ends).sum(axis=0) + (w**2).sum(axis=0) + 2.0 * rho * w[0] * w[1]
    share = np.trapezoid(variance, x)
    assert unresolved_variance(h, length) == pytest.approx((1.0 - SOUNDING_CONSTANT_PART) * share, rel=0.03)


def test_bands_hold_two_standard_deviations_of_a_normal_ensemble():
    from scipy.stats import norm

    values = norm.ppf((np.arange(20000) + 0.5) / 20000.0)
    assert percentile_band(values) == pytest.approx([-1.9954, 0.0, 1.9954], abs=2e-3)
    assert percentile_band(np.tile(values, (3, 1)), axis=1).shape == (3, 3)


def test_a_mean_s_jackknife_is_its_standard_error():
    """Of a mean it is exactly the scatter over the root of the count (Efron 1982, chapter 3)."""
    x = np.random.default_rng(5).standard_normal((9, 2))
    without = np.array([np.delete(x, k, axis=0).mean(axis=0) for k in range(9)])
    np.testing.assert_allclose(jackknife_variance(without), x.var(axis=0, ddof=1) / 9.0, rtol=1e-12)


def test_waves_have_the_spectrum_of_saturated_ones():
    for apart_m in (0.0, 400.0, 2000.0, 3500.0, 9000.0):
        a = 2.0 * np.pi * apart_m / 7000.0
        want = 4.0 / np.pi * quad(lambda x, a=a: x / (1.0 + x**4) * np.cos(a * x), 0.0, 300.0, limit=2000)[0]
        assert wave_correlation(np.array([apart_m]))[0] == pytest.approx(want, abs=1e-3)


def test_the_wind_s_error_is_a_constant_waves_and_gusts():
    at = 30e3 + 300.0 * np.array([4.0, 0.0, 2.0, 6.0, 1.0, 3.0, 5.0])  # on the knots, shuffled
    root = wind_error_root(at)
    apart = np.abs(at[:, None] - at)
    want = (1.0 + wave_correlation(apart) + np.exp(-apart / WIND_LENGTH_M)) / 3.0
    assert np.allclose(root @ root.T, want, atol=1e-12)
    assert np.allclose((wind_error_root(np.linspace(20e3, 60e3, 999)) ** 2).sum(axis=1), 1.0)
    # a metre of altitude, one altitude, none: still one constant and what can change
    assert wind_error_root(np.full(3, 4e4)).shape == (3, 2)
    assert np.isfinite(wind_error_root(np.linspace(4e4, 4e4 + 1e-6, 5))).all()
    assert wind_error_root(np.empty(0)).shape == (0, 2)


@pytest.mark.parametrize("length_m", [5000.0, 7000.0, 10000.0])
def test_a_wave_of_the_stated_size_is_no_contradiction(length_m):
    # half of the variance in one wave: its chi-square is no more than the readings' number
    at = np.arange(30e3, 60e3, 1000.0)
    root = wind_error_root(at)
    cov = root @ root.T + 0.2**2 * np.eye(len(at))
    wave = np.sin(2.0 * np.pi * at / length_m)
    assert wave @ np.linalg.solve(cov, wave) < len(at)
    markov = sounding_correlation(at, WIND_LENGTH_M) + 0.2**2 * np.eye(len(at))
    assert wave @ np.linalg.solve(markov, wave) > 1.5 * wave @ np.linalg.solve(cov, wave)

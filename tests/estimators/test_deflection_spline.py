"""Spline and band of the fused deflection, against scipy's spline and full matrices."""

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.linalg import cholesky_banded, lstsq
from scipy.sparse import csr_array

from estimators.deflection_spline import KNOT_S, Spline, block_diagonal, inverse_in_band, upper_band


def unbanded(band):
    """Symmetric matrix (n, n) of its upper band, the diagonal last."""
    width, n = len(band) - 1, band.shape[1]
    upper = sum(np.diag(band[width - k, k:], k) for k in range(width + 1))
    assert upper.shape == (n, n)
    return upper + np.triu(upper, 1).T


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_the_basis_is_that_of_the_even_cubic_spline(derivative):
    spline = Spline.over(430.02, 431.17)
    knots = spline.knots_s[0] + KNOT_S * np.arange(-3, len(spline.knots_s) + 3)
    time_s = np.concatenate([spline.knots_s, np.random.default_rng(0).uniform(429.5, 431.5, 40)])
    inside = np.clip(time_s, spline.knots_s[0], spline.knots_s[-1])
    wanted = BSpline(knots, np.eye(spline.count), 3)(inside, nu=derivative)
    np.testing.assert_allclose(spline.rows(time_s, derivative).toarray(), wanted, atol=1e-8)


def test_responses_are_those_of_the_lateral_vector_and_its_derivatives():
    rng, spline = np.random.default_rng(1), Spline.over(0.0, 1.0)
    time_s, by_order = rng.uniform(0.0, 1.0, 9), rng.normal(size=(3, 9, 2, 2))
    coefficients = rng.normal(size=(spline.count, 2))
    wanted = sum(
        np.einsum("ncj,nj->nc", by, spline.rows(time_s, order) @ coefficients) for order, by in enumerate(by_order)
    )
    got = spline.responses(time_s, by_order) @ coefficients.ravel()
    np.testing.assert_allclose(got.reshape(-1, 2), wanted, rtol=1e-9, atol=1e-9)


def test_smooth_values_are_the_least_squares_fit_over_holes_too():
    rng = np.random.default_rng(2)
    time_s = 0.013 + 0.05 * np.arange(99)
    time_s = time_s[(time_s < 2.0) | (time_s > 3.0)]
    values, spline = rng.normal(size=(len(time_s), 3)), Spline.over(0.0, 5.0)
    full = spline.rows(time_s).toarray()
    wanted = full @ lstsq(full, values, lapack_driver="gelsy")[0]
    np.testing.assert_allclose(spline.smooth(time_s, values), wanted, atol=1e-6)


def test_the_inverse_in_the_band_is_that_of_the_whole_matrix():
    rng, n, width = np.random.default_rng(3), 40, 5
    root = np.triu(np.tril(rng.normal(size=(n, n)), width)) + 4.0 * np.eye(n)
    matrix = root.T @ root
    band = upper_band(csr_array(matrix))
    np.testing.assert_array_equal(unbanded(band), np.triu(matrix) + np.triu(matrix, 1).T)
    got, whole = inverse_in_band(cholesky_banded(band)).toarray(), np.linalg.inv(matrix)
    inside = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= width
    np.testing.assert_allclose(got, np.where(inside, whole, 0.0), atol=1e-12)


def test_blocks_stand_on_the_diagonal():
    blocks = np.random.default_rng(4).normal(size=(3, 2, 2))
    got = block_diagonal(blocks).toarray()
    for k in range(3):
        np.testing.assert_array_equal(got[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], blocks[k])
    assert np.count_nonzero(got) == 12

"""Spline and band of the fused deflection, against scipy's spline and full matrices."""

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.linalg import cholesky_banded, lstsq
from scipy.sparse import csr_array

from estimators.deflection_spline import (
    KNOT_S,
    NormalEquations,
    Rows,
    Spline,
    block_diagonal,
    inverse,
    inverse_in_band,
    upper_band,
)


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


def equations(columns):
    """Of 60 readings at random with the responses to nine inputs, of which those of some columns are asked for."""
    rng, spline = np.random.default_rng(6), Spline.over(0.0, 1.5)
    time_s, by_input, want = rng.uniform(0.0, 1.5, 60), rng.normal(size=(120, 9)), rng.normal(size=120)
    lateral = np.broadcast_to(30.0 * np.eye(2), (60, 2, 2))
    rows = Rows(spline.responses(time_s, (lateral,)), by_input[:, columns], want)
    return NormalEquations.of_rows(spline, {"all": slice(0, by_input[:, columns].shape[1])}, [rows])


def test_inputs_integrated_over_leave_the_posterior_of_the_rest():
    whole, kept, size = equations(slice(None)), slice(3, 5), 2.0
    answer, others = whole.solved(size, ""), equations(np.r_[0:3, 5:9])
    part = whole.without_inputs(kept)
    mean, precision, _ = part.of_inputs(size, "")
    first = 2 * whole.spline.count
    np.testing.assert_allclose(mean, answer.mean[first:][kept], rtol=1e-9)
    np.testing.assert_allclose(inverse(precision), answer.inputs[kept, kept], rtol=1e-9)
    np.testing.assert_allclose(whole.without_inputs().mean(size, ""), answer.mean[:first], atol=1e-12)
    # the kept ones taken as stated
    stated = part.with_inputs(slice(0, 0)).mean(size, "")
    np.testing.assert_allclose(stated, others.solved(size, "").mean[:first], atol=1e-12)
    assert np.abs(stated - answer.mean[:first]).max() > 1e-4


def test_one_input_of_several_is_found_as_if_it_were_the_only_one():
    mean, precision, found = equations(slice(None)).with_inputs(slice(4, 6)).of_inputs(2.0, "")
    alone = equations(slice(4, 6)).of_inputs(2.0, "")
    np.testing.assert_allclose(mean, alone[0], rtol=1e-12)
    np.testing.assert_allclose(precision, alone[1], rtol=1e-12)
    np.testing.assert_allclose(found(np.array([0.7])), alone[2](np.array([0.7])), rtol=1e-12)

"""A band with a border is solved, inverted and measured as the full matrix is, every term of it alive."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from flightmodel.arrow import Arrow, lower_band


def arrow_of(n, m, reach, seed=5):
    """An arrow, and the same positive definite matrix in full, with nothing in it zero but what lies off the band."""
    rng = np.random.default_rng(seed)
    response = rng.standard_normal((3 * (n + m), n + m)) * np.exp(rng.standard_normal(n + m))
    matrix = response.T @ response
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) > reach
    matrix[:n, :n][apart] = 0.0
    matrix[:n, :n] += np.diag(np.abs(matrix[:n]).sum(axis=1))  # positive definite without what was taken out
    return Arrow(lower_band(csr_array(matrix[:n, :n])), matrix[:n, n:].copy(), matrix[n:, n:].copy()), matrix


SHAPES = pytest.mark.parametrize(("n", "m", "reach"), [(60, 7, 5), (12, 0, 3), (0, 6, 0), (5, 2, 4), (23, 3, 0)])


@SHAPES
def test_it_is_what_its_parts_say(n, m, reach):
    arrow, matrix = arrow_of(n, m, reach)
    assert len(arrow.band) == reach + 1
    np.testing.assert_array_equal(arrow.dense, matrix)
    np.testing.assert_array_equal(arrow.diagonal, np.diag(matrix))
    np.testing.assert_array_equal(arrow.columns(np.arange(m)[::-1]), matrix[:, n:][:, ::-1])
    by, more = np.random.default_rng(6).uniform(0.5, 2.0, (2, n + m))
    want = by[:, None] * matrix * by + np.diag(more)
    np.testing.assert_allclose(arrow.scaled(by, more).dense, want, rtol=1e-14)


@SHAPES
def test_solution_determinant_and_covariances_are_those_of_the_full_matrix(n, m, reach):
    arrow, matrix = arrow_of(n, m, reach)
    factor, inverse = arrow.factor(), np.linalg.inv(matrix)
    for right in np.random.default_rng(7).standard_normal((n + m, 4)), np.arange(1.0, n + m + 1.0):
        np.testing.assert_allclose(factor.solve(right), inverse @ right, rtol=1e-10, atol=1e-13)
    assert factor.log_det == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-10)
    np.testing.assert_allclose(factor.border_covariance, inverse[n:, n:], rtol=1e-9, atol=1e-14)
    if n == 0:
        return
    alone = np.linalg.inv(matrix[:n, :n])
    np.testing.assert_allclose(factor.gain, -alone @ matrix[:n, n:], rtol=1e-9, atol=1e-13)
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= reach
    got = factor.inverse_near_diagonal().toarray()
    np.testing.assert_allclose(got[near], alone[near], rtol=1e-9, atol=1e-14)
    stored = got != 0.0
    np.testing.assert_allclose(got[stored], alone[stored], rtol=1e-8, atol=1e-14)
    # what is said of the whole: own covariance, and what the border's unknowns carry into it
    whole = alone + factor.gain @ factor.border_covariance @ factor.gain.T
    np.testing.assert_allclose(whole, inverse[:n, :n], rtol=1e-8, atol=1e-13)


def test_blocks_of_the_inverse_on_the_diagonal_and_below():
    rng, count, size = np.random.default_rng(9), 5, 3
    own, below = rng.standard_normal((count, size, size)), rng.standard_normal((count - 1, size, size))
    own = own @ own.transpose(0, 2, 1) + 9.0 * np.eye(size)
    across, corner = rng.standard_normal((count * size, 2)), 9.0 * np.eye(2)
    want = np.zeros((count, size, count, size))
    for k in range(count):
        want[k, :, k] = own[k]
    for k in range(count - 1):
        want[k + 1, :, k], want[k, :, k + 1] = below[k], below[k].T
    want = want.reshape(count * size, -1)
    arrow = Arrow(lower_band(csr_array(want)), across, corner)
    inverse = np.linalg.inv(want).reshape(count, size, count, size)
    got, got_below = arrow.factor().inverse_blocks(size)
    np.testing.assert_allclose(got, [inverse[k, :, k] for k in range(count)], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(got_below, [inverse[k + 1, :, k] for k in range(count - 1)], rtol=1e-12, atol=1e-15)


def test_what_is_not_positive_definite_is_refused():
    arrow, _ = arrow_of(6, 2, 2)
    for spoilt in (Arrow(-arrow.band, arrow.across, arrow.corner), Arrow(arrow.band, arrow.across, -arrow.corner)):
        with pytest.raises(np.linalg.LinAlgError):
            spoilt.factor()

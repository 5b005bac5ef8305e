"""Spline and band of the fused deflection, against scipy's spline and full matrices."""

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.linalg import lstsq

from estimators.deflection_spline import (
    KNOT_S,
    SIZE_LOG_SD,
    SIZE_RADPS2,
    NormalEquations,
    Rows,
    Spline,
    block_diagonal,
)


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


def test_blocks_stand_on_the_diagonal():
    blocks = np.random.default_rng(4).normal(size=(3, 2, 2))
    got = block_diagonal(blocks).toarray()
    for k in range(3):
        np.testing.assert_array_equal(got[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], blocks[k])
    assert np.count_nonzero(got) == 12


def written_out(columns):
    """Rows of 60 readings at random with the responses to nine inputs, of which those of some columns are asked for."""
    rng, spline = np.random.default_rng(6), Spline.over(0.0, 1.5)
    time_s, by_input, want = rng.uniform(0.0, 1.5, 60), rng.normal(size=(120, 9)), rng.normal(size=120)
    lateral = np.broadcast_to(30.0 * np.eye(2), (60, 2, 2))
    return Rows(spline.responses(time_s, (lateral,)), by_input[:, columns], want)


def equations(columns):
    """Normal equations of these rows."""
    rows = written_out(columns)
    return NormalEquations.of_rows(Spline.over(0.0, 1.5), {"all": slice(0, rows.by_input.shape[1])}, [rows])


def test_one_input_of_several_is_found_as_if_it_were_the_only_one():
    got, alone = (
        equations(slice(None)).with_inputs(np.array([4, 5])).solved(2.0, ""),
        equations(slice(4, 6)).solved(2.0, ""),
    )
    one, other = got.input_posterior, alone.input_posterior
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12)
    np.testing.assert_allclose(got.deflection(np.array([0.7])), alone.deflection(np.array([0.7])), rtol=1e-12)


def test_the_process_has_the_size_of_the_readings_whole_density():
    """The readings' covariance with deflection and inputs integrated over, written out at a few sizes."""
    normal, rows = equations(slice(0, 3)), written_out(slice(0, 3))

    def surprise(size):
        prior = np.linalg.inv(normal.spline.process_precision(size).dense)
        cov = np.eye(len(rows.want)) + rows.by_input @ rows.by_input.T
        cov += rows.by_deflection @ prior @ rows.by_deflection.toarray().T
        a_priori = 0.5 * (np.log(size / SIZE_RADPS2) / SIZE_LOG_SD) ** 2
        return a_priori + 0.5 * rows.want @ np.linalg.solve(cov, rows.want) + 0.5 * np.linalg.slogdet(cov)[1]

    found = normal.process_size()
    assert surprise(found) < min(surprise(0.8 * found), surprise(1.25 * found))

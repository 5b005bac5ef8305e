"""Quantiles of the deflection's angle, where a standard deviation says too little of it."""

import numpy as np
import pytest
from scipy.signal import find_peaks
from scipy.stats import rice

from flightmodel.deflection import (
    QUANTILE_COLUMNS,
    QUANTILES,
    _clear_minima,
    cycle_about,
    history_from_lateral,
    length_quantiles,
    mean_over,
)

SD = np.deg2rad(0.2)


def history(size_rad, sd=SD, drawn=None):
    yz = np.array([[0.6, 0.8]]) * np.atleast_1d(size_rad)[:, None]
    cov = np.tile(sd**2 * np.eye(2), (len(yz), 1, 1))
    quantiles = None if drawn is None else length_quantiles(drawn)
    return history_from_lateral(430.0 + np.arange(len(yz)), yz, cov, "fused", "", quantiles)


@pytest.mark.parametrize("size_deg", [0.0, 0.1, 0.5, 2.0])
def test_of_a_round_gaussian_they_are_those_of_rice(size_deg):
    got = history(np.deg2rad(size_deg)).theta_quantiles_rad[0]
    want = rice.ppf(QUANTILES, np.deg2rad(size_deg) / SD, scale=SD)
    # even draws know a quantile to a few hundredths of a sd
    np.testing.assert_allclose(got, want, atol=0.06 * SD)


def test_of_an_ellipse_along_the_deflection_they_are_normal():
    root = np.array([[0.6, -0.8], [0.8, 0.6]]) @ np.diag([SD, 0.1 * SD])
    yz = np.deg2rad(3.0) * np.array([[0.6, 0.8]])
    one = history_from_lateral(np.zeros(1), yz, (root @ root.T)[None], "trim", "")
    want = np.deg2rad(3.0) + SD * np.array([-1.645, -0.994, 0.0, 0.994, 1.645])
    np.testing.assert_allclose(one.theta_quantiles_rad[0], want, atol=0.06 * SD)


def test_draws_of_a_posterior_with_a_tail_are_taken_as_they_are():
    drawn = np.zeros((1, 1000, 2))
    drawn[0, :, 1] = -np.deg2rad(np.linspace(0.0, 10.0, 1000) ** 2)
    one = history(np.deg2rad(25.0), drawn=drawn)
    np.testing.assert_allclose(np.rad2deg(one.theta_quantiles_rad[0]), (10.0 * np.array(QUANTILES)) ** 2, rtol=1e-2)


def test_they_stand_beside_the_sd_and_cover_what_they_say():
    rng = np.random.default_rng(3)
    table = history(np.deg2rad([0.2, 1.0])).to_frame()
    assert list(table.columns[-5:]) == list(QUANTILE_COLUMNS)
    assert (np.diff(table[list(QUANTILE_COLUMNS)].to_numpy(), axis=1) > 0.0).all()
    # read and posterior are both longer than the truth by sd^2 / 2 theta: at five sd a tenth of a sd each
    for true_deg, allowed in ((1.0, 0.15), (5.0, 0.08)):
        read = np.deg2rad(true_deg) * np.array([0.6, 0.8]) + SD * rng.standard_normal((400, 2))
        many = history_from_lateral(np.arange(400.0), read, np.tile(SD**2 * np.eye(2), (400, 1, 1)), "fused", "")
        below = (np.deg2rad(true_deg) < many.theta_quantiles_rad).mean(axis=0)
        # 400 draws know a share to 2.5 %
        np.testing.assert_allclose(below, QUANTILES, atol=allowed)
    # of no deflection at all the upper ends are bounds that always hold
    read = SD * rng.standard_normal((400, 2))
    many = history_from_lateral(np.arange(400.0), read, np.tile(SD**2 * np.eye(2), (400, 1, 1)), "fused", "")
    assert (many.theta_quantiles_rad[:, -1] > SD).all()


def test_a_plane_that_is_lost_leaves_the_angle_s_own():
    one = history(np.deg2rad(0.01))
    assert np.isnan(one.lateral_cov[0]).all()
    want = rice.ppf(QUANTILES, np.deg2rad(0.01) / SD, scale=SD)
    np.testing.assert_allclose(one.theta_quantiles_rad[0], want, atol=0.06 * SD)


# ------------------------------------------------------------------------------------------------- a cycle and its mean


def swinging(amplitude_deg, sd_deg=0.05, keep=slice(None)):
    t = np.arange(0.0, 16.0, 0.1)
    theta = np.deg2rad(4.0 + 0.1 * (t - 8.0) + amplitude_deg * np.sin(2.0 * np.pi * t / 1.6))
    cov = np.tile(np.deg2rad(sd_deg) ** 2 * np.eye(2), (len(t), 1, 1))
    return history_from_lateral(t[keep], theta[keep, None] * np.array([[0.6, 0.8]]), cov[keep], "fused", "")


def test_a_cycle_lies_between_the_minima_about_a_time_and_its_mean_is_what_it_oscillates_about():
    one = swinging(1.0)
    first, last = cycle_about(one, 8.3)
    # minima of 4 + sin: 1.2 s after each multiple of 1.6 s, to a step
    assert (first, last) == pytest.approx((7.6, 9.2), abs=0.11)
    mean, sd = np.rad2deg(mean_over(one, (first, last)))
    assert mean == pytest.approx(4.0 + 0.1 * (0.5 * (first + last) - 8.0), abs=0.05)
    assert sd == pytest.approx(0.05, rel=1e-6)


def test_what_does_not_stand_out_of_its_error_or_is_not_covered_is_no_cycle():
    assert cycle_about(swinging(0.1), 8.3) is None
    assert cycle_about(swinging(1.0), 0.3) is None
    gap = np.r_[0:80, 88:160]
    assert cycle_about(swinging(1.0, keep=gap), 8.3) is None
    assert np.isnan(mean_over(swinging(1.0, keep=gap), (7.6, 9.2))).all()
    assert np.isnan(mean_over(swinging(1.0), (15.0, 17.0))).all()


@pytest.mark.parametrize("rise", [0.5, 2.0, 5.0])
def test_minima_that_stand_out_are_those_of_the_library(rise):
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = np.cumsum(rng.standard_normal(200)) + rng.standard_normal(200)
        np.testing.assert_array_equal(_clear_minima(values, rise), find_peaks(-values, prominence=rise)[0])

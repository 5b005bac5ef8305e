"""Each error of a triad alone, against its own formula; statistics with bounds of four of their standard deviations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from synthetic_flight import instrument_errors
from synthetic_flight.instrument_errors import (
    DropoutErrors,
    TriadErrors,
    child,
    gauss_markov,
    kept,
    low_pass,
    measured,
    tilted_axes,
)

QUIET = {"mount_rad": 0.0, "scale": 0.0, "bias": 0.0, "noise": 0.0}
STEP = 0.004


def delivered(values, seed=0, **errors):
    at = STEP * np.arange(len(values))
    return measured(
        at, np.asarray(values, dtype=float), TriadErrors(**{**QUIET, **errors}), np.random.default_rng(seed)
    )


def wave(t):
    """Three unlike signals below 6 Hz."""
    return np.column_stack(
        [np.sin(2 * np.pi * f * t + p) + 0.3 * np.sin(5.1 * t) for f, p in ((1.3, 0), (2.8, 1), (5.7, 2))]
    )


@pytest.mark.parametrize("order", [1, 2])
def test_low_pass_of_a_ramp_is_the_analytic_one(order):
    """First-order hold is exact for a ramp: only rounding is left."""
    t = STEP * np.arange(400)
    w = 2.0 * np.pi * 3.0
    out = low_pass(np.column_stack([2.0 + t, -7.0 * t]), STEP, 3.0, order)
    if order == 1:
        lag = (1.0 - np.exp(-w * t)) / w
    else:  # Butterworth: damping 1 / sqrt 2, so the sine's factor 2 zeta^2 - 1 vanishes
        zw = w / np.sqrt(2.0)
        lag = np.sqrt(2.0) / w * (1.0 - np.exp(-zw * t) * np.cos(zw * t))
    np.testing.assert_allclose(out[:, 0], 2.0 + t - lag, atol=1e-11)
    np.testing.assert_allclose(out[:, 1], -7.0 * (t - lag), atol=1e-10)


@pytest.mark.parametrize("order", [1, 2])
def test_the_corner_is_at_minus_three_decibels(order):
    t = STEP * np.arange(5000)
    out = low_pass(np.sin(2.0 * np.pi * 10.0 * t)[:, None], STEP, 10.0, order)[2500:, 0]
    # straight lines between samples lose sinc^2 of 10 Hz x 4 ms: 0.5 %
    assert np.sqrt(2.0) * out.std() == pytest.approx(np.sqrt(0.5), rel=8e-3)


@pytest.mark.parametrize(("delay_s", "bandwidth_hz"), [(0.0123, 0.0), (-0.006, 0.0), (0.0, 25.0), (0.004, 25.0)])
def test_delay_is_found_by_matching(delay_s, bandwidth_hz):
    t = STEP * np.arange(10000)
    at = t[500:-500]
    errors = TriadErrors(**QUIET, delay_s=delay_s, bandwidth_hz=bandwidth_hz)
    late = instrument_errors.sampled(at, t, wave(t), errors)
    tries = np.arange(-0.04, 0.041, 0.002)
    for axis in range(3):
        # where the difference of late and shifted signals is smallest; near there it is a parabola
        match = [-np.sum((late[:, axis] - wave(at - shift)[:, axis]) ** 2) for shift in tries]
        k = int(np.argmax(match))
        a, b, c = match[k - 1 : k + 2]
        found = tries[k] + 0.002 * 0.5 * (a - c) / (a - 2.0 * b + c)
        # slow signals pass a Butterworth late by sqrt(2) / w; at 5.7 of 25 Hz that is 2.5 % more of 9 ms
        lag = np.sqrt(2.0) / (2.0 * np.pi * bandwidth_hz) if bandwidth_hz else 0.0
        assert found == pytest.approx(delay_s + lag, abs=1e-4 + 0.03 * lag)


def test_clocks_scatter_as_declared_and_move_nothing_else():
    errors = TriadErrors(**QUIET, time_bias_s=0.002)
    late = [instrument_errors.clock_late_s(errors, np.random.default_rng(seed)) for seed in range(400)]
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 400) / 400
    assert low < np.mean(np.square(late)) / 0.002**2 < high
    rng = np.random.default_rng(1)
    assert instrument_errors.clock_late_s(TriadErrors(**QUIET), rng) == 0.0
    instrument_errors.clock_late_s(errors, rng)
    assert rng.standard_normal() == np.random.default_rng(1).standard_normal()
    t = STEP * np.arange(2000)
    at = t[500:-500]
    both = [
        instrument_errors.sampled(at, t, wave(t), TriadErrors(**QUIET, delay_s=d), late)
        for d, late in ((0.003, 0.002), (0.005, 0.0))
    ]
    np.testing.assert_allclose(*both, atol=1e-12)


def test_axes_out_of_square_have_their_declared_angles():
    products = []
    for seed in range(200):
        axes = delivered(np.eye(3), seed, nonorthogonality_rad=0.01)[1].T
        np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(axes[0], [1.0, 0.0, 0.0], atol=1e-12)
        products.append([axes[0] @ axes[1], axes[0] @ axes[2], axes[1] @ axes[2]])
    # 200 draws: 5 % of a standard deviation
    np.testing.assert_allclose(np.std(products, axis=0), 0.01, rtol=0.2)


def test_misalignment_comes_before_scale_and_scale_before_bias():
    """With all three alive the sensor is diag(1 + s) N R^T v + b: R and s are told apart by their order."""
    rng = np.random.default_rng(3)
    v = rng.standard_normal((50, 3))
    kind = {"mount_rad": 0.05, "nonorthogonality_rad": 0.03, "scale": 0.2, "bias": 0.7}
    out = delivered(v, 8, **kind)[1]
    solved = np.linalg.lstsq(np.column_stack([v, np.ones(50)]), out, rcond=None)[0]
    matrix, bias = solved[:3].T, solved[3]
    drawn = np.random.default_rng(8)
    turn = drawn.standard_normal(3)
    scale = 1.0 + 0.2 * drawn.standard_normal(3)
    np.testing.assert_allclose(bias, 0.7 * drawn.standard_normal(3), atol=1e-12)
    # rows of N are unit vectors and R is a rotation, so each row's length is its axis's scale
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=1), scale, rtol=1e-12)
    # written out with the draws in their order, which the seeds of flights already flown rest upon
    tilt = 0.03 * child(np.random.default_rng(8), "nonorthogonality").standard_normal(3)
    turned = Rotation.from_rotvec(0.05 * turn).as_matrix()
    np.testing.assert_allclose(matrix, np.diag(scale) @ tilted_axes(tilt) @ turned.T, atol=1e-12)
    first = matrix[0] / scale[0]  # the first axis is R^T's own: its angle to x is the turn's across x
    assert np.arccos(first[0]) == pytest.approx(0.05 * np.hypot(turn[1], turn[2]), rel=0.02)


def test_scale_asymmetry_acts_on_negative_values_only():
    sums = []
    for seed in range(150):
        both = delivered([[2.0, 3.0, 4.0], [-2.0, -3.0, -4.0]], seed, scale_asymmetry=0.01, scale=0.05)[1]
        alone = delivered([[2.0, 3.0, 4.0]], seed, scale=0.05)[1]
        np.testing.assert_array_equal(both[0], alone[0])
        sums.append((both[0] + both[1]) / [-2.0, -3.0, -4.0])
    # 450 draws: 3.3 % of a standard deviation
    assert np.std(sums) == pytest.approx(0.01, rel=0.14)


def test_drift_is_a_gauss_markov_process_of_its_own_draws():
    t = np.array([0.0, 3.0, 4.0, 50.0])
    many = gauss_markov(t, 0.3, 5.0, 20000, np.random.default_rng(0))
    # 20000 pairs: 0.7 % of a correlation or a variance
    correlation = many @ many.T / 20000 / 0.09
    np.testing.assert_allclose(correlation, np.exp(-np.abs(t[:, None] - t) / 5.0), atol=0.04)
    still = np.zeros((500, 3))
    noisy, drifting = (delivered(still, 4, noise=0.1, drift=size, drift_time_constant_s=1.0)[1] for size in (0.0, 0.2))
    drift = drifting - noisy  # the noise is the same, sample by sample
    at = STEP * np.arange(500)
    expected = gauss_markov(at, 0.2, 1.0, 3, child(np.random.default_rng(4), "drift"))
    np.testing.assert_allclose(drift, expected, atol=1e-12)


def test_saturation_and_quantisation():
    ramp = np.linspace(-2.0, 2.0, 401)[:, None] * np.ones(3)
    out = delivered(ramp, bias=0.0, limit=(1.0, 1.5, 3.0), resolution=0.3)[1]
    np.testing.assert_allclose(np.mod(out / 0.3 + 0.5, 1.0), 0.5, atol=1e-9)
    # whole steps inside the range: 0.9, 1.5 and, never reached, 3.0
    np.testing.assert_allclose(out.max(axis=0), [0.9, 1.5, 2.1], atol=1e-12)
    np.testing.assert_allclose(out.min(axis=0), [-0.9, -1.5, -2.1], atol=1e-12)
    free = delivered(ramp, limit=(1.0, 1.5, 3.0))[1]
    np.testing.assert_allclose(free, np.clip(ramp, [-1.0, -1.5, -3.0], [1.0, 1.5, 3.0]))
    # the stop is in the electronics: bias shifts what reaches it, not where it is
    pushed = delivered(ramp, 2, bias=0.5, limit=(1.0, 1.0, 1.0))[1]
    np.testing.assert_array_equal(pushed.max(axis=0), 1.0)
    step = delivered(ramp, resolution=0.01)[1] - ramp
    assert np.abs(step).max() <= 0.005 + 1e-12


def test_dropped_samples_are_missing_rows():
    t = 0.02 * np.arange(100000)  # 2000 s
    spec = DropoutErrors(0.5, 0.2, ((100.0, 130.0),))
    keep = kept(t, spec, np.random.default_rng(6))
    assert not keep[(t >= 100.0) & (t < 130.0)].any()
    outside = keep[(t < 100.0) | (t >= 130.0)]
    # bursts that begin at random cover 1 - exp(-rate x mean); 985 of them scatter by 3.2 % x sqrt 2 of 9.5 %
    assert 1.0 - outside.mean() == pytest.approx(1.0 - np.exp(-0.1), rel=0.18)
    gaps = np.diff(t[keep])
    assert (gaps > 0.03).sum() > 600
    at, out = delivered(np.ones((5000, 3)), 1, noise=0.1, dropouts=DropoutErrors(1.0, 0.1))
    whole_at, whole = delivered(np.ones((5000, 3)), 1, noise=0.1)
    assert 4000 < len(at) < 4800  # 20 s, of which 10 % are lost
    rows = np.searchsorted(whole_at, at)
    np.testing.assert_array_equal(out, whole[rows])  # the others are what they would have been


def test_children_have_their_own_draws():
    rng = np.random.default_rng(9)
    a, b, again = (child(rng, name).standard_normal(4) for name in ("drift", "dropouts", "drift"))
    np.testing.assert_array_equal(a, again)
    assert not np.allclose(a, b)
    np.testing.assert_array_equal(rng.standard_normal(4), np.random.default_rng(9).standard_normal(4))

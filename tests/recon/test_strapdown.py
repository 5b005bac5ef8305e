"""The kernel does what the readable twin does, and every column of its transition is the derivative it claims to be."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from flightmodel import earth, rotations
from recon import kalman
from recon.propagation import correct, correction_partials, fill_between, propagate, strapdown_motion
from recon.state import States, boxminus, boxplus
from tests.oracles import strapdown as plain_strapdown

from .problems import build

# column groups: position, velocity, rotation, then bias, scale, mount of accelerometer and gyros; their clocks
STEPS = np.r_[np.repeat([10.0, 0.01, 1e-4, 1e-2, 1e-4, 1e-4, 1e-5, 1e-4, 1e-4], 3), 1e-4, 1e-4]


@pytest.fixture
def grid():
    rng = np.random.default_rng(3)
    n = 80
    return strapdown_motion(
        np.cumsum(rng.uniform(0.002, 0.006, n)),
        rng.normal(0.0, 20.0, (n, 3)),
        rng.normal(0.0, 0.6, (n, 3)),
        rng.uniform(1.0, 2.0, (n, 3)) * 1e-4,
        rng.uniform(1.0, 2.0, (n, 3)) * 1e-6,
        rotations.dcm_from_q(rotations.exp(rng.normal(0.0, 1.0, 3))),
        rotations.dcm_from_q(rotations.exp(rng.normal(0.0, 1.0, 3))),
    )


@pytest.fixture
def smooth_grid(grid):
    """Signals of up to 3 Hz, as a vehicle has them."""
    rng = np.random.default_rng(9)
    phase = 2.0 * np.pi * np.multiply.outer(grid.time_s, rng.uniform(0.5, 3.0, 6)) + rng.uniform(0.0, 6.0, 6)
    signal = rng.normal(0.0, 1.0, 6) + np.sin(phase)
    return grid._replace(force_sensor_mps2=20.0 * signal[:, :3], rate_sensor_radps=0.6 * signal[:, 3:])


@pytest.fixture
def state():
    rng = np.random.default_rng(4)
    position = earth.ecef_from_geodetic(-0.6, 1.2, 9e4)
    return States(
        position, np.array([1500.0, -900.0, 700.0]), rotations.exp(rng.normal(0, 1, 3)), rng.normal(0, 0.01, 18)
    )


def with_clocks(grid, state):
    """The same where accelerometer and gyros have clocks that err by 4 and -3 ms."""
    return grid._replace(clocks=True), replace(state, sensor_errors=np.r_[state.sensor_errors, 4e-3, -3e-3])


@pytest.mark.parametrize("clocks", [False, True])
@pytest.mark.parametrize(("first", "last"), [(3, 70), (70, 3)])
def test_kernel_equals_readable_twin(grid, state, first, last, clocks):
    if clocks:
        grid, state = with_clocks(grid, state)
    fast, plain = propagate(grid, first, last, state), plain_strapdown.propagate(grid, first, last, state)
    # positions are 6.4e6 m with 1e-16 relative rounding over 67 steps: 67 * 1e-9 m
    assert np.abs(fast.state.position_ecef_m - plain.state.position_ecef_m).max() < 1e-7
    assert np.abs(fast.state.velocity_ecef_mps - plain.state.velocity_ecef_mps).max() < 1e-10
    assert np.abs(rotations.boxminus(fast.state.q_ecef_body, plain.state.q_ecef_body)).max() < 1e-12
    # the kernel leaves out dt times Coriolis on gradient and noise transitions: below 1e-4 of the block's size
    scale = np.abs(plain.transition).max(axis=1, keepdims=True)
    assert np.abs((fast.transition - plain.transition) / scale).max() < 1e-6
    assert np.abs(fast.noise - plain.noise).max() < 1e-4 * np.abs(plain.noise).max()
    assert np.linalg.eigvalsh(fast.noise).min() > -1e-18


def test_a_late_clock_is_taken_back_from_the_signal(smooth_grid, state):
    """Samples of another moment, told by how late they are, lead where those of the right moment do.

    By a sample's rate of change: of 3 Hz at 1 ms terms of second order are 2 pi f t / 2 = 1 % of those of first order.
    """
    late = np.array([1e-3, -1e-3])
    t = smooth_grid.time_s
    shifted = [
        np.column_stack([CubicSpline(t, column)(t - tau) for column in samples.T])
        for tau, samples in zip(late, (smooth_grid.force_sensor_mps2, smooth_grid.rate_sensor_radps), strict=True)
    ]
    grid = smooth_grid._replace(force_sensor_mps2=shifted[0], rate_sensor_radps=shifted[1], clocks=True)
    right = propagate(smooth_grid, 10, 70, state).state
    wrong = propagate(grid, 10, 70, replace(state, sensor_errors=np.r_[state.sensor_errors, 0.0, 0.0])).state
    told = propagate(grid, 10, 70, replace(state, sensor_errors=np.r_[state.sensor_errors, late])).state
    missed, left = (boxminus(replace(s, sensor_errors=right.sensor_errors), right)[3:9] for s in (wrong, told))
    assert np.abs(missed[:3]).max() > 5e-3
    assert np.abs(missed[3:]).max() > 2e-4
    assert np.abs(left[:3]).max() < 0.05 * np.abs(missed[:3]).max()
    assert np.abs(left[3:]).max() < 0.05 * np.abs(missed[3:]).max()


@pytest.mark.parametrize("clocks", [False, True])
@pytest.mark.parametrize(("first", "last"), [(3, 70), (70, 3)])
def test_transition_is_the_derivative_in_every_block(smooth_grid, state, first, last, clocks):
    grid = smooth_grid
    if clocks:
        grid, state = with_clocks(grid, state)
    transition = propagate(grid, first, last, state).transition
    for j in range(transition.shape[1]):
        e = np.zeros(transition.shape[1])
        e[j] = STEPS[j]
        ahead, behind = (propagate(grid, first, last, boxplus(state, s * e)).state for s in (1.0, -1.0))
        column = boxminus(ahead, behind)[:9] / (2.0 * STEPS[j])
        for rows, rounding in ((slice(0, 3), 4e-9), (slice(3, 6), 1e-12), (slice(6, 9), 1e-14)):
            size = max(np.abs(column[rows]).max(), 1e-300)
            # the central gradient leaves out J2 (0.2 % of what a position error does to velocity); J_l of a mount
            # to second order; what sensor errors do to the sculling, (W dt)^2 / 12 = 5e-4; all below 5e-3 of the
            # block, the rest is rounding of the difference
            assert np.abs(transition[rows, j] - column[rows]).max() < 5e-3 * size + 20.0 * rounding / STEPS[j], (
                j,
                rows,
            )


def test_every_term_is_alive(grid, state):
    transition = propagate(grid, 0, 79, state).transition
    blocks = np.abs(transition).reshape(3, 3, 9, 3).max(axis=(1, 3))
    zero_by_nature = np.zeros((3, 9), dtype=bool)
    zero_by_nature[2, [0, 1, 3, 4, 5]] = True  # attitude hears only attitude and gyros
    assert ((blocks == 0.0) == zero_by_nature).all()


def test_steps_compose(grid, state):
    whole = propagate(grid, 0, 60, state)
    half = propagate(grid, 0, 25, state)
    rest = propagate(grid, 25, 60, half.state)
    lower = np.hstack([np.zeros((18, 9)), np.eye(18)])
    assert np.allclose(rest.transition @ np.vstack([half.transition, lower]), whole.transition, rtol=1e-9, atol=1e-9)
    a = rest.transition[:, :9]
    # gravity and Coriolis (1e-4 a step) are left out of the carried noise
    assert np.allclose(a @ half.noise @ a.T + rest.noise, whole.noise, rtol=1e-3, atol=1e-4 * whole.noise.max())


def test_forward_then_back_returns(grid, state):
    there = propagate(grid, 0, 79, state)
    back = boxminus(propagate(grid, 79, 0, there.state).state, state)
    assert np.abs(back[:3]).max() < 2e-5  # mid-point steps are reversible to third order in a step
    assert np.abs(back[6:9]).max() < 1e-12
    again = propagate(grid, 79, 0, there.state).transition[:, :9] @ there.transition[:, :9]
    assert np.abs(again - np.eye(9)).max() < 1e-6


def test_noise_of_a_free_vehicle_is_the_textbook_double_integrator(grid, state):
    n = 80
    still = strapdown_motion(
        grid.time_s,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.full((n, 3), 2e-4),
        np.full((n, 3), 3e-6),
        np.eye(3),
        np.eye(3),
    )
    quiet = States(state.position_ecef_m, state.velocity_ecef_mps, state.q_ecef_body, np.zeros(18))
    noise = propagate(still, 0, n - 1, quiet).noise
    span = still.time_s[-1] - still.time_s[0]
    assert np.allclose(np.diag(noise), np.repeat([2e-4 * span**3 / 3, 2e-4 * span, 3e-6 * span], 3), rtol=1e-9)


def test_noise_is_the_scatter_of_noisy_samples(grid, state):
    """White noise on every sample, 400 times: the scatter of the outcome, with a spinning body's lever in it."""
    rng = np.random.default_rng(6)
    n, span = 80, np.diff(grid.time_s, append=2.0 * grid.time_s[-1] - grid.time_s[-2])[:, None]
    steady = grid._replace(
        force_sensor_mps2=np.tile([-80.0, 3.0, -2.0], (n, 1)), rate_sensor_radps=np.tile([0.6, -0.4, 0.3], (n, 1))
    )
    claimed = propagate(steady, 0, n - 1, state).noise
    ends = []
    for _ in range(400):
        force = steady.force_sensor_mps2 + (rng.standard_normal((n, 3)) * np.sqrt(grid.force_density / span)) @ (
            grid.dcm_body_force
        )
        rate = steady.rate_sensor_radps + (rng.standard_normal((n, 3)) * np.sqrt(grid.rate_density / span)) @ (
            grid.dcm_body_rate
        )
        noisy = steady._replace(force_sensor_mps2=force, rate_sensor_radps=rate)
        ends.append(boxminus(propagate(noisy, 0, n - 1, state).state, propagate(steady, 0, n - 1, state).state)[:9])
    root = np.linalg.cholesky(claimed)
    white = np.linalg.solve(root, np.array(ends).T)
    # each of 81 elements of a sample covariance of 400 scatters by 1 / sqrt(400), doubled on the diagonal: 5 sd, and
    # mean of two samples loses half a step at each end
    assert np.abs(white @ white.T / 400 - np.eye(9)).max() < 5.0 * np.sqrt(2.0 / 400) + 1.0 / n


def test_nodes_between_known_ones_are_carried_from_them(grid, state):
    nodes = np.array([0, 7, 30, 31, 79])
    known = np.array([0, 2])
    second = propagate(grid, 0, 30, state).state
    at_known = States(*(np.stack([getattr(state, f), getattr(second, f)]) for f in States.__dataclass_fields__))
    filled = fill_between(grid, nodes, known, at_known)
    for k in range(4):
        one = propagate(grid, nodes[k], nodes[k + 1], filled[k])
        assert np.allclose(one.state.position_ecef_m, filled[k + 1].position_ecef_m, atol=1e-7)
        assert np.allclose(one.state.velocity_ecef_mps, filled[k + 1].velocity_ecef_mps, atol=1e-9)
        assert np.abs(rotations.boxminus(one.state.q_ecef_body, filled[k + 1].q_ecef_body)).max() < 1e-12


def test_steps_of_a_pass_along_a_reference_are_single_propagations(mini_sense):
    problem = build(mini_sense(1)[0], end_s=108.0)
    first = kalman.forward(problem)
    reference = first.states()
    run = kalman.forward(problem, reference)
    for k in range(0, len(problem.time_s) - 1, 7):
        one = propagate(problem.motion, problem.node_index[k], problem.node_index[k + 1], reference[k])
        # one kernel inlined in another: fused multiply-adds differ by rounding
        assert np.allclose(one.transition, run.steps.transition[k], rtol=1e-12, atol=1e-12)
        assert np.allclose(one.noise, run.steps.noise[k], rtol=1e-12, atol=1e-24)


def test_correction_undoes_a_measurement():
    rng = np.random.default_rng(5)
    dcm = rotations.dcm_from_q(rotations.exp(rng.normal(0, 1, 3)))
    errors, true = rng.normal(0.0, 0.01, 9), rng.normal(0.0, 30.0, (50, 3))
    actual = true @ dcm @ rotations.dcm_from_q(rotations.exp(errors[6:9]))
    measured = (1.0 + errors[3:6]) * actual + errors[0:3]
    assert np.abs(correct(measured, errors, dcm) - true).max() < 1e-12


@pytest.mark.parametrize(("degrees", "off"), [(1.0, 6e-5), (3.0, 5e-4), (5.0, 1.4e-3)])
def test_how_far_the_partials_of_a_mount_hold(degrees, off):
    """The left Jacobian to first order leaves out m^2 / 6: 5e-5 of a degree, 1.3e-3 of five."""
    rng = np.random.default_rng(8)
    dcm = rotations.dcm_from_q(rotations.exp(rng.normal(0, 1, 3)))
    mount = rng.normal(0, 1, 3)
    errors = np.concatenate([np.zeros(6), np.deg2rad(degrees) * mount / np.linalg.norm(mount)])
    sample = np.array([-70.0, 20.0, 35.0])
    partials = correction_partials(sample, errors, dcm)[:, 6:9]
    h = 1e-5
    columns = [(correct(sample[None], errors + s, dcm) - correct(sample[None], errors - s, dcm))[0] / (2 * h) for s in
               h * np.eye(9)[6:]]  # fmt: skip
    worst = np.abs(np.array(columns).T - partials).max() / np.abs(partials).max()
    assert 0.1 * off < worst < off


@pytest.mark.parametrize("hz", [50, 100, 250])
def test_integration_follows_an_independent_truth(mini_truth, hz):
    """Perfect samples of a spinning, coning 8 g flight, integrated for 60 s, against DOP853 in inertial axes."""
    t = np.arange(100 * hz, 160 * hz) / hz
    zero = np.zeros((len(t), 3))
    omega = mini_truth.state(t)[3]
    grid = strapdown_motion(t, mini_truth.specific_force_imu(t), omega, zero, zero, np.eye(3), np.eye(3))
    start = mini_truth.trajectory(grid.time_s[:1], (-0.95, 0.04, -0.03))
    end = mini_truth.trajectory(grid.time_s[-1:], (-0.95, 0.04, -0.03))
    begin = States(start.position_ecef_m[0], start.velocity_ecef_mps[0], start.q_ecef_body[0], np.zeros(18))
    last = propagate(grid, 0, len(grid.time_s) - 1, begin).state
    # joins of samples: w'' dt^2 / 12 of 0.2 rad/s at 2 rad/s over 20 ms is 3e-5 rad/s, swinging; measured 1.7e-5 rad,
    # 4 mm/s and 11 cm at 50 Hz, less as the square of the step; far below any gyro
    slower = (50 / hz) ** 2
    assert np.abs(rotations.boxminus(last.q_ecef_body, end.q_ecef_body[0])).max() < 2.5e-5 * slower
    assert np.abs(last.velocity_ecef_mps - end.velocity_ecef_mps[0]).max() < 6e-3 * slower + 2e-4
    assert np.abs(last.position_ecef_m - end.position_ecef_m[0]).max() < 0.2 * slower + 5e-3

"""The filter is a Kalman filter, the smoother is conditioning of a Gaussian; both on problems solved another way."""

import numpy as np
import pytest

from recon import ekf, inertial, smoother
from recon.bet import Settings, build_problem
from recon.ekf import ForwardPass, Innovations, forward
from recon.measurements import predict_radar_plain, residual
from recon.smoother import smooth
from recon.strapdown import correct


def build(telemetry, **options):
    force, rate = inertial.bridge(telemetry.accelerometer), inertial.bridge(telemetry.rates)
    return build_problem(telemetry, Settings(output_rate_hz=5.0, end_s=112.0, **options), force, rate)


@pytest.fixture(scope="module")
def passes(mini_sense):
    problem, _ = build(mini_sense(1)[0])
    first = forward(problem)
    reference = smooth(first, with_covariance=False).states(first.charts)
    return problem, first, reference, forward(problem, reference)


def full_transition(run, k):
    size = run.x_plus.shape[1]
    f = np.eye(size)
    f[range(9, size), range(9, size)] = run.decay[k]
    f[:9, :27] = run.transition[k]
    return f


def test_linear_pass_equals_a_textbook_kalman_filter(passes):
    """About a fixed reference the filter is linear: gains from the information form, no filterpy, no Joseph form."""
    problem, _, reference, run = passes
    x, p = run.x_minus[0].copy(), problem.start_covariance.copy()
    scale = np.sqrt(np.diag(p))
    for k in range(len(problem.time_s)):
        if k > 0:
            f = full_transition(run, k - 1)
            q = np.zeros_like(p)
            q[:9, :9] = run.noise[k - 1]
            x, p = f @ x + (run.x_minus[k] - f @ run.x_plus[k - 1]), f @ p @ f.T + q
        for number, z in problem.points[k]:
            radar = problem.radars[number]
            rate = correct(
                problem.grid.rate_sensor_radps[problem.node_index[k]][None],
                reference[k].sensor_errors[9:18],
                problem.grid.dcm_body_rate,
            )[0]
            h, jacobian = predict_radar_plain(radar, reference[k], rate)
            gain = p @ jacobian.T @ np.linalg.inv(jacobian @ p @ jacobian.T + radar.noise_var(h[2]))
            x = x + gain @ (residual(z, h) - jacobian @ x)
            p = (np.eye(len(x)) - gain @ jacobian) @ p
            p = 0.5 * (p + p.T)
        # 600 updates from a prior of 1 km to a metre: cancellation of 1e6 in P leaves about 1e-9 of the prior's sd
        assert (np.abs(x - run.x_plus[k]) < 1e-6 * scale + 1e-5 * np.sqrt(np.diag(p))).all(), k
        assert np.allclose(np.diag(p)[:27], np.diag(run.p_plus[k]), rtol=1e-4, atol=0.0)
    assert np.allclose(np.diag(p), np.diag(run.p_last), rtol=1e-4, atol=0.0)
    assert run.innovations.accepted.all()


def test_smoother_never_knows_less_than_the_filter(passes):
    *_, run = passes
    filtered = np.diagonal(run.p_plus, axis1=1, axis2=2)
    smoothed = np.diagonal(smooth(run).covariance, axis1=1, axis2=2)
    assert (smoothed <= filtered * (1.0 + 1e-6)).all()
    assert np.linalg.eigvalsh(run.p_plus / np.sqrt(filtered[:, :, None] * filtered[:, None, :])).min() > 0.0


def test_constants_stay_constant_through_the_smoother(passes):
    *_, run = passes
    states = smooth(run).states(run.charts)
    spread = np.ptp(states.sensor_errors, axis=0)
    assert (spread <= 1e-9 * np.sqrt(np.diag(run.p_last))[9:] + 1e-15).all()


def linear_run(seed, wander):
    """A random linear problem in the filter's block form, its plain Kalman filter and the same as one Gaussian."""
    rng = np.random.default_rng(seed)
    n, size = 7, 31
    m = size - 9
    decay = np.ones((n - 1, m))
    noise_var = np.zeros((n - 1, m))
    if wander:
        decay[:, [0, 1, 20]] = rng.uniform(0.7, 0.95, (n - 1, 3))
        noise_var[:, [0, 1, 20]] = rng.uniform(0.1, 0.5, (n - 1, 3))
    transition = rng.normal(0.0, 0.3, (n - 1, 9, 27))
    transition[:, range(9), range(9)] += 1.0
    root = rng.normal(0.0, 1.0, (n - 1, 9, 9)) * rng.uniform(0.01, 1.0, (n - 1, 1, 1))
    noise = root @ np.swapaxes(root, 1, 2)
    offsets = rng.normal(0.0, 1.0, (n, size))
    run = ForwardPass(
        None, np.zeros((n, size)), np.zeros((n, size)), np.zeros((n, size, size)), np.zeros((n, 27, 27)),
        np.zeros((size, size)), transition, noise, decay, noise_var, Innovations(*(np.zeros(0),) * 6),
    )  # fmt: skip
    p0 = np.diag(rng.uniform(0.5, 4.0, size))
    x, p = np.zeros(size), p0
    mean, joint = [x], {(0, 0): p0}
    rows, before = [], []
    for k in range(n):
        if k > 0:
            f, q = full_transition(run, k - 1), np.diag(np.r_[np.zeros(9), noise_var[k - 1]])
            q[:9, :9] = noise[k - 1]
            x, p = f @ x + offsets[k], f @ p @ f.T + q
            mean.append(f @ mean[-1] + offsets[k])
            for j in range(k):
                joint[j, k] = joint[j, k - 1] @ f.T
                joint[k, j] = joint[j, k].T
            joint[k, k] = f @ joint[k - 1, k - 1] @ f.T + q
        run.x_minus[k], run.p_minus[k] = x, p
        if k in (0, 1, 4, 6):  # gaps between
            h, r = rng.normal(0.0, 1.0, (3, size)), np.diag(rng.uniform(0.01, 0.2, 3))
            z = rng.normal(0.0, 3.0, 3)
            gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
            x, p = x + gain @ (z - h @ x), (np.eye(size) - gain @ h) @ p
            rows.append((k, h, r, z))
        run.x_plus[k], run.p_plus[k] = x, p[:27, :27]
        if k == n - 1:
            run.p_last[:] = 0.5 * (p + p.T)
        before.append(p)
    return run, np.concatenate(mean), np.block([[joint[i, j] for j in range(n)] for i in range(n)]), rows, before


@pytest.mark.parametrize("wander", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_smoother_equals_conditioning_the_joint_gaussian(seed, wander):
    run, mean, joint, rows, _ = linear_run(seed, wander)
    n, size = run.x_plus.shape
    h = np.zeros((3 * len(rows), n * size))
    r, z = np.zeros((3 * len(rows),) * 2), np.zeros(3 * len(rows))
    for i, (k, part, noise, value) in enumerate(rows):
        here = slice(3 * i, 3 * i + 3)
        h[here, k * size : (k + 1) * size], r[here, here], z[here] = part, noise, value
    gain = joint @ h.T @ np.linalg.inv(h @ joint @ h.T + r)
    posterior, covariance = mean + gain @ (z - h @ mean), joint - gain @ h @ joint
    smoothed = smooth(run)
    assert np.allclose(smoothed.x.ravel(), posterior, rtol=1e-7, atol=1e-7)
    for k in range(n):
        here = slice(k * size, k * size + 27)
        assert np.allclose(smoothed.covariance[k], covariance[here, here], rtol=1e-6, atol=1e-7), k


def test_smoother_gain_equals_the_textbook_form():
    run, _, _, _, before = linear_run(2, True)
    moving = np.r_[np.arange(9), 9, 10, 29]
    gain, _ = smoother.step_gains(*smoother._rows(run, 0, 6, moving), run.p_minus[1:], moving)
    for k in range(6):
        textbook = before[k] @ full_transition(run, k).T @ np.linalg.inv(run.p_minus[k + 1])
        assert np.allclose(gain[k], textbook[moving], rtol=1e-7, atol=1e-8)


def test_thinning_keeps_one_point_of_each_radar_per_step(mini_sense):
    problem, _ = build(mini_sense(1)[0])
    thinned, kept = problem.thinned(0.5)
    assert kept[0] == 0
    for number in (0, 1):
        times = [t for t, here in zip(thinned.time_s, thinned.points, strict=True) for i, _ in here if i == number]
        assert (
            len(times) == len(set(np.floor(np.array(times) / 0.5))) == len({np.floor(t / 0.5) for t in problem.time_s})
        )
    assert isinstance(thinned, ekf.Problem)

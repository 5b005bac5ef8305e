"""The filter is a Kalman filter: two engines with the same numbers, and a textbook's third, with everything alive."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import rotations
from flightmodel.telemetry import RadarRecord
from recon.kalman import forward, smooth, smoothed_covariance
from recon.linearise import as_charts, full_step
from recon.measurements import wrapped
from recon.settings import ENGINES, FILTERPY
from recon.state import boxminus, boxplus, packed, unpacked
from tests.oracles.plain_measurements import NodeMotion, predict

from .ballistic_flight import fly, watch
from .one_node import motion_at
from .problems import build, off_in_covariance, off_in_states

SHORT = {"end_s": 106.2, "output_rate_hz": 4.0}


def damaged(telemetry):
    """A track that lost some azimuths and ranges, whole points, and holds gross errors."""
    radar = telemetry.radars["north"] if "north" in telemetry.radars else telemetry.radars["near"]
    track = radar.range_az_el.copy()
    track[5:9, 1] = np.nan
    track[12:14, 0] = np.nan
    track[16] = np.nan
    track[20:24, 0] += 900.0
    track[26, 2] += 0.05
    return replace(telemetry, radars=telemetry.radars | {radar.spec.name: RadarRecord(radar.spec, radar.time_s, track)})


def wandering_bias(telemetry):
    """Biases that walk."""
    triads = {
        name: replace(
            getattr(telemetry, name), spec=replace(getattr(telemetry, name).spec, bias_wander_sd=sd,
            bias_time_constant_s=30.0)
        )
        for name, sd in (("accelerometer", 0.02), ("rates", 5e-4))
    }  # fmt: skip
    return replace(telemetry, **triads)


CONSIDERED = ("accelerometer mount", "rates scale", "north tilt", "west time bias", "barometer bias")


@pytest.fixture(scope="module")
def problems(mini_everything):
    """Problems by name, the last two ballistic; their kinds of measurements are all there are."""
    telemetry = wandering_bias(damaged(mini_everything(1)))
    t, states = fly(3, end_s=40.0)
    fall = damaged(watch(t, states, 3, receiver=True))
    short = {"start_s": None, "end_s": 14.0, "output_rate_hz": 4.0}
    return {
        "trackers": build(telemetry, **SHORT),
        "all six kinds": build(telemetry, **SHORT, attitude_sensors=True),
        "considered": build(telemetry, **SHORT, consider=CONSIDERED),
        "all, considered": build(
            telemetry, **SHORT, attitude_sensors=True, consider=("magnetometer mount", "sun2 mount", *CONSIDERED)
        ),
        "ballistic": build(fall, **short),
        "ballistic, considered": build(fall, **short, consider=("air density", "near azimuth bias", "vehicle drag")),
    }  # fmt: skip


NAMES = ["trackers", "all six kinds", "considered", "all, considered", "ballistic", "ballistic, considered"]


@pytest.fixture(scope="module")
def passes(problems):
    """Compiled pass about its own estimate, smoothed states, and the pass along them."""

    def make(name):
        problem = problems[name]
        first = forward(problem)
        reference = smooth(problem, first, with_covariance=False).states(first.charts)
        return problem, first, reference, forward(problem, reference)

    made = {}
    return lambda name: made.setdefault(name, make(name))


def test_problems_hold_what_they_should(problems):
    six = problems["all six kinds"]
    assert {i.kind for i in six.instruments} == set(range(6))
    assert set(six.observed.source) == set(range(len(six.instruments)))
    assert np.isinf(six.observed.variance[six.observed.source == 0]).any(axis=1).sum() == 6
    w = six.model.wander
    assert np.isfinite(w.time_constant_s).sum() == 8  # both radars, receiver and barometer
    assert (w.walk_var_per_s > 0.0).sum() == 6
    assert not w.considered.any()
    assert np.isfinite(problems["ballistic"].model.wander.altitude_m).sum() == 3
    assert problems["considered"].model.wander.considered.sum() == 3 + 3 + 2 + 1 + 1
    assert problems["ballistic, considered"].model.wander.considered.sum() == 1 + 2 + 1


@pytest.mark.parametrize("along_reference", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_engines_have_the_same_numbers(passes, name, along_reference):
    """Prior of a kilometre, points of metres: 1e6 in variance on 1e-16 leaves 1e-10 of what stays, times some hundred
    updates; Joseph's form against the plain one. Measured 1.5e-9 in states and covariances.
    """
    problem, first, reference, along = passes(name)
    run = along if along_reference else first
    plain = forward(problem, reference if along_reference else None, FILTERPY)
    a, b = run.filtered, plain.filtered
    assert np.array_equal(run.innovations.accepted, plain.innovations.accepted)
    assert not run.innovations.accepted.all()
    assert run.innovations.accepted.mean() > 0.9
    assert np.allclose(run.innovations.nis, plain.innovations.nis, rtol=1e-7, atol=1e-7)
    assert off_in_states(a.x_minus, b.x_minus, a.p_minus) < 1e-8
    assert off_in_states(a.x_plus, b.x_plus, a.p_minus) < 1e-8
    assert off_in_covariance(a.p_minus, b.p_minus) < 5e-9
    assert off_in_covariance(a.p_plus, b.p_plus) < 5e-9
    assert off_in_covariance(packed(a.p_last), packed(b.p_last)) < 5e-9
    assert np.allclose(run.charts.position_ecef_m, plain.charts.position_ecef_m, rtol=0.0, atol=1e-7)
    assert np.abs(rotations.boxminus(run.charts.q_ecef_body, plain.charts.q_ecef_body)).max() < 1e-10
    for part, other in zip(run.innovations[:2], plain.innovations[:2], strict=True):
        scale = np.sqrt(np.diagonal(run.innovations.covariance, axis1=1, axis2=2))
        scale = scale if part.ndim == 2 else scale[:, :, None] * scale[:, None, :]
        assert (np.abs(part - other) / scale).max() < 1e-7
    gain = run.innovations.gain / np.sqrt(unpacked(a.p_minus)[problem.node].diagonal(axis1=1, axis2=2))[:, :, None]
    other = plain.innovations.gain / np.sqrt(unpacked(a.p_minus)[problem.node].diagonal(axis1=1, axis2=2))[:, :, None]
    assert np.allclose(gain * scale_of(run), other * scale_of(run), atol=1e-7)


def scale_of(run):
    """Standard deviations of innovations, to take the unit out of gains."""
    return np.sqrt(np.diagonal(run.innovations.covariance, axis1=1, axis2=2))[:, None, :]


@pytest.mark.parametrize("name", ["trackers", "ballistic"])
def test_linear_pass_equals_a_textbook_kalman_filter(passes, name):
    """About a fixed reference the filter is linear: plain gains by inversion, no filterpy, no Joseph form."""
    problem, _, reference, run = passes(name)
    x, p = run.filtered.x_minus[0].copy(), problem.start_covariance.copy()
    scale = np.sqrt(np.diag(p))
    slots, observed = problem.sources().slot, problem.observed
    kept = unpacked(run.filtered.p_plus)
    for k in range(len(problem.time_s)):
        if k > 0:
            f, q = full_step(run.steps, k - 1)
            x = f @ x + (run.filtered.x_minus[k] - f @ run.filtered.x_plus[k - 1])
            p = f @ p @ f.T + q
        for row in np.flatnonzero(problem.node == k):
            if not run.innovations.accepted[row]:
                continue
            h, jacobian, noise, used = textbook_measurement(problem, reference, row, slots)
            gain = p @ jacobian.T @ np.linalg.inv(jacobian @ p @ jacobian.T + noise)
            kind = problem.instruments[observed.source[row]].kind
            x = x + gain @ (wrapped(kind, observed.value[row] - h)[used] - jacobian @ x)
            p = (np.eye(len(x)) - gain @ jacobian) @ p
            p = 0.5 * (p + p.T)
        # 200 updates from a prior of 1 km to a metre: cancellation of 1e6 in P leaves about 1e-9 of the prior's sd
        assert (np.abs(x - run.filtered.x_plus[k]) < 1e-6 * scale + 1e-5 * np.sqrt(np.diag(p))).all(), k
        if run.filtered.kept[k] >= 0:
            dense = problem.dense
            claimed = np.diag(kept[run.filtered.kept[k]])
            assert np.allclose(np.diag(p)[:dense], claimed, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("name", ["trackers", "ballistic"])
def test_the_answer_does_not_depend_on_the_reference(passes, name):
    """A reference moved at random, node by node, by 0.1 sd of each error: what it misses comes back as an offset.

    Left: second-order terms, of the move times the filter's own error: measured 0.009 sd.
    """
    problem, _, reference, along = passes(name)
    every = np.ones(len(problem.time_s), dtype=bool)
    rng, (_, covariance) = np.random.default_rng(5), smoothed_covariance(problem, along, every)
    moves = 0.1 * rng.standard_normal((len(every), problem.size)) * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    run = forward(problem, boxplus(reference, moves))
    assert np.array_equal(run.innovations.accepted, along.innovations.accepted)
    sd = np.sqrt(np.diagonal(unpacked(along.filtered.p_minus), axis1=1, axis2=2))
    assert (np.abs(boxminus(run.states(), along.states())) / sd).max() < 0.02


def textbook_measurement(problem, reference, row, slots):
    """Prediction, partials by all errors, noise and used components of one measurement, from the numpy twins."""
    k, source = problem.node[row], problem.observed.source[row]
    at, slot = reference[int(k)], slots[source]
    rate, acceleration = motion_at(problem.motion, problem.node_index[k], *as_charts(at))
    e = np.where(slot >= 0, at.sensor_errors[slot], 0.0)
    c = rotations.dcm_from_q(at.q_ecef_body)
    motion = NodeMotion(at.position_ecef_m, at.velocity_ecef_mps, c, rate, acceleration)
    h, by_state, by_error = predict(problem.instruments[source], problem.observed.known[row], e, motion)
    used = np.isfinite(problem.observed.variance[row])
    jacobian = np.zeros((3, problem.size))
    jacobian[:, :9] = by_state
    for column in np.flatnonzero(slot >= 0):
        jacobian[:, 9 + slot[column]] += by_error[:, column]
    return h, jacobian[used], np.diag(problem.observed.variance[row][used]), used


@pytest.mark.parametrize("name", ["considered", "all, considered", "ballistic, considered"])
@pytest.mark.parametrize("engine", ENGINES)
def test_considered_errors_never_move(problems, name, engine):
    problem = problems[name]
    run = forward(problem, engine=engine)
    rows = 9 + np.flatnonzero(problem.model.wander.considered)
    sd = np.concatenate([np.zeros(9), problem.model.prior_sd])[rows]
    assert not run.states().sensor_errors[:, rows - 9].any()
    assert not run.innovations.gain[:, rows].any()
    p = unpacked(run.filtered.p_minus)[:, rows][:, :, rows]
    assert np.abs(p / np.outer(sd, sd) - np.eye(len(rows))).max() < 1e-12
    smoothed = smooth(problem, run)
    assert not smoothed.x[:, rows].any()
    assert np.allclose(smoothed.variance[:, rows], sd**2, rtol=1e-12)
    # what they may have done is in everything else
    assert np.abs(unpacked(run.filtered.p_minus)[-1, :6][:, rows]).max() > 0.0


def test_rejected_points_change_nothing(problems):
    """Taking out the points that the gate refused gives the same estimates to the last bit."""
    problem = problems["trackers"]
    run = forward(problem)
    refused = ~run.innovations.accepted
    assert refused.sum() >= 4
    again = forward(problem.without(refused))
    assert np.array_equal(run.filtered.x_plus, again.filtered.x_plus)
    assert np.array_equal(run.filtered.p_minus, again.filtered.p_minus)
    assert np.array_equal(run.innovations.nis, again.innovations.nis)
    assert not again.innovations.gain[refused].any()


def test_packing_is_lossless():
    rng = np.random.default_rng(0)
    matrices = rng.normal(0.0, 1.0, (4, 7, 7))
    matrices += np.swapaxes(matrices, 1, 2)
    assert np.array_equal(unpacked(packed(matrices)), matrices)
    assert np.array_equal(unpacked(packed(matrices), 3), matrices[:, :3, :3])

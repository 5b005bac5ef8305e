"""One posterior from all methods: against the joint Gaussian written out, against ideal data, and what disagrees."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from estimators import fusion
from estimators.agreement import COEFFICIENTS, FAULT_MOUNT_RAD, MOUNT, OFFSET, agreement, fault_gain, fault_hypotheses
from estimators.deflection_spline import SIZE_LOG_SD, SIZE_RADPS2, InputPosterior, Spline
from estimators.evidence import (
    ACCELEROMETER,
    ACCELEROMETER_TIME_BIAS,
    GYRO_TIME_BIAS,
    WIND,
    Evidence,
    corrected_loads,
    evidence_of_history,
    flow_inputs,
    moved_evidence,
    moved_vehicle,
    offset_sd_m,
)
from estimators.fusion import FarInputsError, fuse, knots_of, loads_reader
from estimators.misalignment import misalignment_evidence
from estimators.trim import trim_evidence
from flightmodel.checks import DivergenceError
from flightmodel.deflection import history_from_lateral
from flightmodel.statistics import correlation_root

from .conftest import VEHICLE, pulse_of

N = 160
TIME_S = 430.0 + 0.05 * np.arange(N)


def motion():
    """A deflection that grows and swings slowly, in a plane that is none of the axes'."""
    x = (TIME_S - 434.0) / 4.0
    size = np.deg2rad(3.5) * np.exp(-(x**2)) + np.deg2rad(0.4) * np.sin(2 * np.pi * 0.6 * (TIME_S - 430.0))
    return size[:, None] * np.array([0.8, -0.6])


METHODS = {"misalignment": misalignment_evidence, "trim": trim_evidence}
STILL = np.zeros((N, 2, 2))


def linear_evidence(rng, name, inputs, noise_sd=1e-3):
    """Evidence of a method that leans on inputs with smooth responses."""
    t = TIME_S - TIME_S[0]
    response = {k: 2e-3 * rng.normal(size=(1, 2, 1)) * (1.0 + 0.3 * np.sin(t + j))[:, None, None]
                for j, k in enumerate(inputs)}  # fmt: skip
    cov = np.tile(noise_sd**2 * np.eye(2), (N, 1, 1))
    return Evidence(name, TIME_S, np.zeros((N, 2)), STILL, np.tile(-1e-3 * np.eye(2), (N, 1, 1)), response, cov, 0.1)


def linear_reader(readings):
    """Readings that move with the inputs exactly as their responses say."""
    return lambda inputs, _about: [moved_evidence(e, inputs) for e in readings]


def whole(rows):
    """Rows of the least-squares problem as one full matrix, and their right-hand side."""
    return np.hstack([rows.by_deflection.toarray(), rows.by_input]), rows.want


def test_posterior_is_that_of_the_joint_gaussian():
    """The same problem by the covariance form: condition prior on readings, no normal equations."""
    rng = np.random.default_rng(0)
    readings = [linear_evidence(rng, "a", ("p", "q")), linear_evidence(rng, "b", ("q", "r"))]
    readings = [replace(e, theta_yz_rad=motion() + 1e-3 * rng.normal(size=(N, 2))) for e in readings]
    history, got = fuse(linear_reader(readings))
    spline = Spline.over(TIME_S[0], TIME_S[-1])
    curvature = spline.rows(spline.knots_s, 2).toarray()
    place = {"p": slice(0, 1), "q": slice(1, 2), "r": slice(2, 3)}
    rows, want = zip(*(whole(fusion.whitened(e, spline, place, {})) for e in readings), strict=True)
    rows, want = np.concatenate(rows), np.concatenate(want)
    size = 2 * spline.count

    def posterior(process_size, before_inputs, mean_inputs):
        prior = np.linalg.inv((curvature.T @ curvature) / process_size**2 + np.eye(spline.count))
        before = np.zeros((size + 3, size + 3))
        before[:size, :size] = np.kron(prior, np.eye(2))
        before[size:, size:] = before_inputs
        gain = before @ rows.T @ np.linalg.inv(rows @ before @ rows.T + np.eye(len(want)))
        shift = np.concatenate([np.zeros(size), mean_inputs])
        return shift + gain @ (want - rows @ shift), before - gain @ rows @ before

    # the inputs: with a process that is free
    mean, after = posterior(1e3, np.eye(3), np.zeros(3))
    np.testing.assert_allclose([got.inputs[k][0][0] for k in "pqr"], mean[size:], atol=1e-5)
    np.testing.assert_allclose([got.inputs[k][1][0, 0] for k in "pqr"], np.diag(after)[size:], rtol=1e-4)
    # the deflection, given these, with the process of the flight's own size; their covariance comes on top
    x, x_cov = mean[size:], after[size:, size:]
    given, own = posterior(got.process_size_radps2, np.zeros((3, 3)), x)
    value = spline.rows(history.time_s).toarray()
    lateral = np.stack([value @ given[axis:size:2] for axis in (0, 1)], axis=-1)
    np.testing.assert_allclose(history.theta_yz_rad, lateral, atol=1e-7)
    steps = [(posterior(got.process_size_radps2, np.zeros((3, 3)), x + e)[0] - given)[0:size:2] for e in np.eye(3)]
    total = own[0:size:2, 0:size:2] + np.stack(steps, -1) @ x_cov @ np.stack(steps)
    np.testing.assert_allclose(history.lateral_cov[:, 0, 0], np.einsum("ni,ij,nj->n", value, total, value), rtol=1e-3)


def test_the_size_of_the_process_is_the_most_probable_one():
    """The evidence by the readings' whole covariance, for a few sizes: no normal equations, no band."""
    rng = np.random.default_rng(21)
    one = replace(linear_evidence(rng, "a", ()), theta_yz_rad=4.0 * motion() + 1e-3 * rng.normal(size=(N, 2)))
    spline = Spline.over(TIME_S[0], TIME_S[-1])
    curvature = spline.rows(spline.knots_s, 2).toarray()
    rows, want = whole(fusion.whitened(one, spline, {}, {}))

    def surprise(size):
        prior = np.kron(np.linalg.inv((curvature.T @ curvature) / size**2 + np.eye(spline.count)), np.eye(2))
        cov = rows @ prior @ rows.T + np.eye(len(want))
        a_priori = 0.5 * (np.log(size / SIZE_RADPS2) / SIZE_LOG_SD) ** 2
        return a_priori + 0.5 * want @ np.linalg.solve(cov, want) + 0.5 * np.linalg.slogdet(cov)[1]

    found = fuse(linear_reader([one]))[1].process_size_radps2
    assert 0.15 < found < 20.0
    assert surprise(found) < min(surprise(0.8 * found), surprise(1.25 * found))
    # a joint that hardly moves: a tenth of a degree of swing at 1.2 Hz stays possible
    still = replace(one, theta_yz_rad=1e-3 * rng.normal(size=(N, 2)))
    assert fuse(linear_reader([still]))[1].process_size_radps2 == pytest.approx(0.1, rel=0.1)


def test_knots_follow_the_swing_of_a_small_vehicle():
    """A metre across, it swings at 4.7 Hz in body axes: between knots of 0.1 s that was 3 sd of error, all green."""
    rng, hz, sd = np.random.default_rng(5), 4.7, 1e-3
    turn = 2.0 * np.pi * hz * (TIME_S - 430.0)
    swing = np.deg2rad(0.35) * np.column_stack([np.cos(turn), np.sin(turn)])
    cov = np.tile(sd**2 * np.eye(2), (N, 1, 1))
    read = motion() + swing + sd * rng.normal(size=(N, 2))
    loads = pulse_of(rng, N, motion())[0]
    loads = replace(loads, swing_radps=2.0 * np.pi * hz)
    one = Evidence("a", TIME_S, read, STILL, STILL, {}, cov, loads.quarter_swing_s)
    inside = slice(8, -8)

    def off_sd(knot_s):
        found, _ = fuse(linear_reader([one]), knot_s=knot_s)
        off = (found.theta_yz_rad - motion() - swing)[inside]
        return np.sqrt(np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.lateral_cov[inside]), off)) / 2.0)

    assert knots_of(loads) == pytest.approx(0.25 / hz)
    assert off_sd(knots_of(loads)) < 1.25
    assert off_sd(0.1) > 2.5
    # readings resolve no more than their spacing, and a slow vehicle's knots are as they were
    assert knots_of(replace(loads, swing_radps=100.0)) == pytest.approx(np.median(np.diff(loads.time_s)))
    assert knots_of(replace(loads, swing_radps=5.0)) == knots_of(replace(loads, swing_radps=0.0)) == 0.1


def test_linear_readings_err_as_the_posterior_says(monkeypatch):
    """Normalised squares of the deflection's errors over draws are chi-squares; the equations leave nothing out."""
    monkeypatch.setattr(fusion, "LEFT_OUT_RAD", 1e-5)
    rng = np.random.default_rng(1)
    template = [linear_evidence(rng, "a", ("p", "q")), linear_evidence(rng, "b", ("q", "r"), 2e-3)]
    truth, squares = motion(), []
    for _ in range(40):
        x = {k: rng.normal(size=1) for k in "pqr"}
        second = np.gradient(np.gradient(truth, TIME_S, axis=0), TIME_S, axis=0)
        readings = []
        for e in template:
            read = truth + np.einsum("nij,nj->ni", e.by_acceleration_s2, second)
            read -= sum(j @ x[k] for k, j in e.by_input.items())
            readings.append(
                replace(e, theta_yz_rad=read + np.sqrt(e.independent_cov[0, 0, 0]) * rng.normal(size=(N, 2)))
            )
        history, _ = fuse(linear_reader(readings))
        k = N // 2
        d = history.theta_yz_rad[k] - truth[k]
        squares.append(d @ np.linalg.solve(history.lateral_cov[k], d))
    low, high = chi2.ppf([0.005, 0.995], 80) / 40
    assert low < np.mean(squares) < high


def test_a_ringing_joint_is_no_scale_error():
    """Swings at the stiffest joint's 2.85 Hz are followed, and not taken for a scale factor, known to 0.3 %."""
    w = 2.0 * np.pi * 2.85
    theta = motion() + (np.deg2rad(0.3) * np.sin(w * (TIME_S - 430.0)))[:, None] * np.array([0.8, -0.6])
    second = -(w**2) * (theta - motion()) + np.gradient(np.gradient(motion(), TIME_S, axis=0), TIME_S, axis=0)
    inertial = np.tile(1e-3 * np.eye(2), (N, 1, 1))
    read = theta + 1e-3 * second
    scale = {"scale": 0.003 * read[:, :, None]}
    one = Evidence("a", TIME_S, read, STILL, inertial, scale, np.tile((2e-4) ** 2 * np.eye(2), (N, 1, 1)), 0.1)
    history, got = fuse(linear_reader([one]))
    assert abs(got.inputs["scale"][0][0]) < 0.5
    inner = slice(10, -10)
    at = np.searchsorted(TIME_S, history.time_s[inner])
    np.testing.assert_allclose(history.theta_yz_rad[inner], theta[at], atol=np.deg2rad(0.06))


def test_ideal_data_give_the_deflection_back():
    loads, truth = pulse_of(np.random.default_rng(2), N, motion())
    history, got = fuse(loads_reader(loads, METHODS, []))
    at = np.searchsorted(loads.time_s, history.time_s)
    inner = (history.time_s > TIME_S[8]) & (history.time_s < TIME_S[-9])
    np.testing.assert_allclose(history.theta_yz_rad[inner], truth[at][inner], atol=np.deg2rad(0.1))
    assert agreement(loads_reader(loads, METHODS, [])({}, got.deflection)).hypotheses == ()


def test_noise_at_the_ends_does_not_keep_it_from_settling():
    """A method is not linear in the twenty degrees that the free process makes of noise there."""
    rng = np.random.default_rng(22)
    at_end = np.minimum(np.arange(N), N - 1 - np.arange(N)) < 6
    sd = np.where(at_end, 0.3, 1e-3)
    seen = motion() + sd[:, None] * rng.normal(size=(N, 2))
    cov = sd[:, None, None] ** 2 * np.eye(2)

    def read(_inputs, about):
        curved = 0.0 if about is None else 0.5 * np.tanh((about(TIME_S) / 0.25) ** 5)
        return [Evidence("a", TIME_S, seen - curved, STILL, STILL, {}, cov, 0.1)]

    history, _ = fuse(read)
    inner = np.abs(history.time_s - 434.0) < 3.0
    at = np.searchsorted(TIME_S, history.time_s[inner])
    np.testing.assert_allclose(history.theta_yz_rad[inner], motion()[at], atol=2e-3)


def test_a_camera_off_by_a_sd_is_found_out():
    """Its error is an input as any other, and its readings move with it."""
    loads, truth = pulse_of(np.random.default_rng(9), N, motion())
    off = np.deg2rad(0.8)
    cov = np.tile(off**2 * np.eye(2), (N, 1, 1))
    camera = evidence_of_history(history_from_lateral(TIME_S, truth + np.array([off, 0.0]), cov, "camera", ""))
    _, got = fuse(loads_reader(loads, METHODS, [camera]))
    k = N // 2
    np.testing.assert_allclose(got.deflection(TIME_S[k : k + 1])[0], truth[k], atol=np.deg2rad(0.12))
    readings = camera.by_input["camera"] @ got.inputs["camera"][0]
    np.testing.assert_allclose(readings[k], [-off, 0.0], atol=np.deg2rad(0.15))


def test_fused_is_better_than_each_and_learns_the_coefficient():
    """A C_m that is two sd off is found from the difference of the methods, and its own sd shrinks."""
    flown = moved_vehicle(VEHICLE, {"C_m": 2.0})
    loads, _ = pulse_of(np.random.default_rng(3), N, motion(), flown)
    history, got = fuse(loads_reader(loads, METHODS, []))
    mean, cov = got.inputs["C_m"]
    assert np.sqrt(cov[0, 0]) < 0.8
    assert abs(mean[0] - 2.0) < 2.0 * np.sqrt(cov[0, 0])
    k = N // 2
    own = misalignment_evidence(loads).covariance[k], trim_evidence(loads).covariance[k]
    fused = np.trace(history.lateral_cov[np.searchsorted(history.time_s, TIME_S[k])])
    assert fused < min(np.trace(c) for c in own)


def test_moving_the_inputs_moves_the_reading_by_the_response():
    """J of every input against a finite change, both methods; the deflection to be linear about is the reading."""
    loads, _ = pulse_of(np.random.default_rng(4), 30)
    loads = replace(
        loads, accelerometer_time_bias_sd_s=2e-3, gyro_time_bias_sd_s=1e-3, cg_from_sensor_m=np.array([-0.4, 0.1, 0.2])
    )
    rng = np.random.default_rng(5)
    assert {ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS} <= misalignment_evidence(loads).by_input.keys()
    for method in METHODS.values():
        base = method(loads)
        for name, response in base.by_input.items():
            x = 1e-3 * rng.normal(size=response.shape[2])
            moved = method(corrected_loads(loads, {name: x}))
            change = moved.theta_yz_rad - base.theta_yz_rad
            scale = np.abs(response).max() * 1e-3 + 1e-9
            np.testing.assert_allclose(change, response @ x, atol=0.05 * scale + 2e-8, err_msg=name)


def test_flow_parts_add_up_to_its_covariance():
    loads, _ = pulse_of(np.random.default_rng(6), 40)
    parts = flow_inputs(loads)
    total = sum(j @ j.transpose(0, 2, 1) for j in parts.values())
    np.testing.assert_allclose(np.trace(total, axis1=1, axis2=2), np.trace(loads.flow_cov, axis1=1, axis2=2))
    wind = parts[WIND] @ parts[WIND].transpose(0, 2, 1)
    np.testing.assert_allclose(wind[:, 0, 0], loads.wind_flow_sd_rad**2)


def test_a_gauss_markov_basis_has_its_correlation():
    at = np.linspace(0.0, 30.0, 400)
    root = correlation_root(at, 3.0)
    correlation = root @ root.T
    np.testing.assert_allclose(np.diag(correlation), 1.0)
    # straight lines between knots a third of the length apart: neighbours are too much alike
    np.testing.assert_allclose(correlation, np.exp(-np.abs(at[:, None] - at) / 3.0), atol=0.15)


def test_no_common_answer_is_refused():
    loads, _ = pulse_of(np.random.default_rng(7), N, motion())
    far = trim_evidence(loads.rows(loads.through_pulse)).theta_yz_rad + np.deg2rad(25.0)

    def apart(inputs, about):
        own = loads_reader(loads, {"misalignment": misalignment_evidence}, [])(inputs, about)
        other = trim_evidence(corrected_loads(loads, inputs).rows(loads.through_pulse))
        return [*own, replace(other, theta_yz_rad=far)]

    with pytest.raises(DivergenceError) as refusal:
        fuse(apart)
    assert refusal.value.codes[0] in {"inputs-far-off", "not-converged", "not-observable"}
    with pytest.raises(DivergenceError) as refusal:
        fuse(lambda _i, _a: [])
    assert refusal.value.codes == ("too-few-data",)


@pytest.mark.parametrize(
    ("moved", "hypothesis"),
    [
        ({"C_m": 6.0}, "aerodynamic coefficients"),
        ({"initial offset y": 20.0}, "initial c.g. offset"),
    ],
)
def test_a_large_planted_fault_is_named(moved, hypothesis):
    """The scores' ranking, far from the noise; how often it is right near it is measured over flights."""
    loads, truth = pulse_of(np.random.default_rng(8), N, motion(), moved_vehicle(VEHICLE, moved))
    cov = np.tile(np.deg2rad(0.1) ** 2 * np.eye(2), (N, 1, 1))
    camera = evidence_of_history(history_from_lateral(TIME_S, truth, cov, "camera", ""))
    read = loads_reader(loads, METHODS, [camera])
    try:
        input_posterior = fuse(read)[1].input_posterior
    except FarInputsError as fault:
        input_posterior = fault.input_posterior
    found = agreement(read({}, None), input_posterior)
    assert found.hypotheses[0] == hypothesis
    assert hypothesis in found.likeliest
    assert hypothesis in found.remark


def linear_posterior(rng, place):
    """Inputs estimated from readings that hold nothing but them and noise: rows, readings, posterior."""
    size = max(at.stop for at in place.values())
    rows = rng.normal(size=(3 * size, size))
    read = rows @ rng.standard_normal(size) + rng.standard_normal(3 * size)
    covariance = np.linalg.inv(np.eye(size) + rows.T @ rows)
    return rows, read, InputPosterior(covariance @ rows.T @ read, covariance, place)


def test_the_gain_of_a_fault_is_its_likelihood_ratio():
    """Against the two densities of the readings written out."""
    rng = np.random.default_rng(12)
    rows, read, input_posterior = linear_posterior(rng, {"a": slice(0, 3), "b": slice(3, 5)})
    columns = rng.normal(size=(5, 2))
    sound = np.eye(len(read)) + rows @ rows.T
    wrong = sound + rows @ columns @ columns.T @ rows.T
    ratio = [-0.5 * (read @ np.linalg.solve(c, read) + np.linalg.slogdet(c)[1]) for c in (wrong, sound)]
    assert fault_gain(input_posterior, columns) == pytest.approx(ratio[0] - ratio[1])


def test_faults_move_the_readings_by_their_sizes():
    """Each column's response is what the error itself does to the readings, to first order."""
    loads, _ = pulse_of(np.random.default_rng(13), N, motion())
    use = loads.through_pulse
    _, got = fuse(loads_reader(loads, METHODS, []))
    faults = fault_hypotheses(loads, got.input_posterior, np.deg2rad(1.0))
    assert set(faults) == {COEFFICIENTS, MOUNT, OFFSET}  # no camera, no plane of its own
    for hypothesis, column, moved in (
        (COEFFICIENTS, 0, {"C_m": 0.15 / VEHICLE.uncertainty.cm}),
        (OFFSET, 1, {"initial offset z": 0.005 / np.sqrt(2.0) / offset_sd_m(VEHICLE)}),
    ):
        inputs = {name: faults[hypothesis][at, column] for name, at in got.input_posterior.place.items()}
        for name, value in moved.items():
            assert inputs.pop(name)[0] == pytest.approx(value)
        assert not any(x.any() for x in inputs.values())
    # the conftest's accelerometer has three biases: a rotation of the drag is what they can produce
    turn = loads.force_root_mps2[use] @ faults[MOUNT][got.input_posterior.place[ACCELEROMETER], 1]
    want = np.cross(FAULT_MOUNT_RAD / np.sqrt(2.0) * np.array([0.0, 0.0, 1.0]), loads.specific_force_body_mps2[use])
    assert np.linalg.norm(turn - want) < 0.5 * np.linalg.norm(want)

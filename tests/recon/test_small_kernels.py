"""The filter's kernels on problems small enough to run interpreted, against the numpy twins and brute force."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from recon import kalman, linearise, propagation
from recon.fault_detection import window_scores
from recon.propagation import correct, propagate, strapdown_motion, with_exact_integrals
from recon.settings import ENGINES, FILTERPY
from recon.state import States, Wander, unpacked
from tests.oracles import ballistic as plain_ballistic
from tests.oracles import bryson_frazier
from tests.oracles import strapdown as plain_strapdown

from . import linear
from .ballistic_flight import SPEC, across_plane, entry_state, fly, watch, windy_sounding
from .one_node import motion_at
from .problems import build

DRIVERS = np.array([0.1, 0.05, -0.08, 0.7, -1.1, 0.6])


def test_smoothers_equal_conditioning_the_joint_gaussian():
    problem = linear.random_problem(0, drivers=6)
    posterior, covariance = linear.condition(problem)
    n, size = posterior.shape
    exact = np.array([covariance[k * size : (k + 1) * size, k * size : (k + 1) * size] for k in range(n)])
    sd = np.sqrt(np.diagonal(exact, axis1=1, axis2=2))
    out, innovations = linear.run(problem)
    for method in ("rauch-tung-striebel", "bryson-frazier"):
        x, triangles, variance = linear.smooth(problem, out, innovations, method)
        assert (np.abs(x - posterior) / sd).max() < 1e-8, method
        assert np.abs(variance / sd**2 - 1.0).max() < 1e-8, method
        dense = slice(0, 15)
        off = np.abs(unpacked(triangles) - exact[:, dense, dense]) / (sd[:, dense, None] * sd[:, None, dense])
        assert off.max() < 1e-8, method


def test_considered_errors_get_no_gain():
    problem = linear.random_problem(1, drivers=6, considered=(1, 7))
    fast, slow = (linear.run(problem, engine) for engine in ENGINES)
    np.testing.assert_allclose(fast[0].x_plus, slow[0].x_plus, atol=1e-9)
    np.testing.assert_allclose(fast[0].p_minus, slow[0].p_minus, atol=1e-8)
    assert (fast[1].gain[:, [10, 16]] == 0.0).all()
    # what is only considered moves by what the steps themselves add, never by a measurement
    for k in range(len(problem.offset)):
        np.testing.assert_allclose(fast[0].x_plus[k, [10, 16]], fast[0].x_minus[k, [10, 16]], atol=0.0)


def test_glr_scores_are_those_of_the_numpy_form():
    problem = linear.random_problem(3, drivers=6)
    _, innovations = linear.run(problem)
    columns = np.array([9, 10, 12])
    begin, end = np.array([7, 2], dtype=np.int64), np.array([11, 9], dtype=np.int64)
    score, variance = np.zeros((2, 3)), np.zeros((2, 3, 3))
    about = problem.steps, problem.observed, problem.slots, problem.readings, innovations, columns
    window_scores(*about, begin, end, 2, score, variance)
    for k in range(2):
        s, v = bryson_frazier.offset_scores(*about, int(begin[k]), int(end[k]))
        np.testing.assert_allclose(score[k], s, rtol=1e-8)
        np.testing.assert_allclose(variance[k], v, rtol=1e-8, atol=1e-9 * np.abs(v).max())


def test_chart_turns_with_the_right_jacobian():
    # exp(d + e) = exp(d) exp(J e) to first order in e; the series ends at d^2: 0.1^3 / 24 is left
    d, step = np.array([0.06, -0.08, 0.03]), 1e-5
    phi = np.zeros((9, 9))
    phi[6:9, 6:9] = np.eye(3)
    linearise.right_jacobian_columns(phi, *d)
    reference = rotations.exp(d)
    for j in range(3):
        e = step * np.eye(3)[j]
        column = rotations.boxminus(rotations.exp(d + e), rotations.exp(d - e))
        whole = rotations.boxminus(rotations.exp(d + e), reference) - rotations.boxminus(
            rotations.exp(d - e), reference
        )
        np.testing.assert_allclose(phi[6:9, 6 + j], whole / (2.0 * step), atol=1e-4)
        np.testing.assert_allclose(column / (2.0 * step), phi[6:9, 6 + j], atol=1e-3)


def test_wander_keeps_its_stated_size():
    # stationary: what is forgotten in a step comes new, whatever the step; a walk grows with time
    sd = np.array([2.0, 0.3, 1.0, 5.0])
    tau, length = np.array([10.0, np.inf, np.inf, 4.0]), np.array([np.inf, 3000.0, np.inf, 8000.0])
    walk = np.array([0.0, 0.0, 0.04, 0.0])
    wander = Wander(tau, length, sd, walk, np.zeros(4, dtype=bool))
    decay, new = np.empty(4), np.empty(4)
    for dt, climb in ((0.5, 30.0), (7.0, 900.0)):
        linearise.decay_and_noise(wander, dt, climb, decay, new)
        forgets = [0, 1, 3]
        np.testing.assert_allclose((decay**2 * sd**2 + new)[forgets], sd[forgets] ** 2, rtol=1e-12)
        np.testing.assert_allclose(-np.log(decay[forgets]), (dt / tau + climb / length)[forgets], rtol=1e-12)
        assert decay[2] == 1.0
        assert new[2] == pytest.approx(0.04 * dt)


def test_motion_at_a_node_is_newton_s_on_a_turning_earth():
    # specific force and gravitation in inertial space, seen from the Earth: less Coriolis and centripetal acceleration
    rng = np.random.default_rng(2)
    mounts = [rotations.dcm_from_q(rotations.exp(rng.normal(0.0, 1.0, 3))) for _ in range(2)]
    force, rate = rng.normal(0.0, 20.0, (2, 3)), rng.normal(0.0, 0.6, (2, 3))
    one = np.ones((2, 3))
    motion = strapdown_motion(np.array([0.0, 0.01]), force, rate, one, one, *mounts)
    position, velocity = earth.ecef_from_geodetic(-0.6, 1.2, 9e4), np.array([1500.0, -900.0, 700.0])
    q, errors = rotations.exp(rng.normal(0, 1, 3)), rng.normal(0, 0.02, 18)
    seen_rate, acceleration = motion_at(motion, 1, position, velocity, q, errors)
    f, w = (correct(s[1], e, m) for s, e, m in zip((force, rate), (errors[:9], errors[9:]), mounts, strict=True))
    spin = earth.OMEGA_ECEF_RADPS
    want = rotations.rotate(q, f) + earth.gravitation(position)
    want = want - 2.0 * np.cross(spin, velocity) - np.cross(spin, np.cross(spin, position))
    # differentiated in inertial space it is the other way round: the two terms are 0.2 and 0.03 m/s^2
    np.testing.assert_allclose(acceleration, want, rtol=1e-11)
    np.testing.assert_allclose(seen_rate[0], w, rtol=1e-11)
    change = (w - correct(rate[0], errors[9:], mounts[1])) / 0.01
    np.testing.assert_allclose(seen_rate[1], change, rtol=1e-9)
    assert np.linalg.norm(2.0 * np.cross(spin, velocity)) > 0.1


def test_the_rate_at_a_node_is_the_curve_s_by_the_gyros_own_clock():
    """What samples give that are moved for exact integrals, and late by a millisecond, of a vehicle that turns fast."""
    w, late_s, t = 30.0, 1e-3, 0.005 * np.arange(9)

    def curve(at):
        return 20.0 * np.column_stack([np.cos(w * at), np.sin(w * at), 0.2 + 0.0 * at])

    errors = np.concatenate([np.random.default_rng(4).normal(0.0, 0.002, 18), [0.0, late_s]])
    tagged = (curve(t - late_s) * (1.0 + errors[12:15])) + errors[9:12]
    level = np.eye(3)
    errors[15:18] = 0.0
    one = np.ones((len(t), 3))
    motion = strapdown_motion(t, 0.0 * one, with_exact_integrals(t, tagged), one, one, level, level, True)
    place = earth.ecef_from_geodetic(-0.6, 1.2, 9e4), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    seen, _ = motion_at(motion, 4, *place, errors)
    np.testing.assert_allclose(seen[0], curve(t[[4]])[0], atol=0.015)  # a tag's second order
    # as read it is 0.6 rad/s off
    assert np.linalg.norm(tagged[4] - errors[9:12] - curve(t[[4]])[0]) > 0.5
    change = (curve(t[[4]] + 1e-5) - curve(t[[4]] - 1e-5))[0] / 2e-5
    np.testing.assert_allclose(seen[1], change, atol=0.04 * np.linalg.norm(change))


@pytest.mark.parametrize(("first", "last", "clocks"), [(0, 7, False), (7, 0, True)])
def test_strapdown_steps_are_those_of_the_readable_form(first, last, clocks):
    rng = np.random.default_rng(3)
    n = 8
    motion = strapdown_motion(
        np.cumsum(rng.uniform(0.004, 0.02, n)),
        rng.normal(0.0, 20.0, (n, 3)),
        rng.normal(0.0, 0.6, (n, 3)),
        rng.uniform(1.0, 2.0, (n, 3)) * 1e-4,
        rng.uniform(1.0, 2.0, (n, 3)) * 1e-6,
        *(rotations.dcm_from_q(rotations.exp(rng.normal(0.0, 1.0, 3))) for _ in range(2)),
        clocks,
    )
    errors = np.r_[rng.normal(0.0, 0.05, 18), [4e-4, -3e-4] if clocks else []]
    start = States(
        earth.ecef_from_geodetic(-0.6, 1.2, 9e4), np.array([1500.0, -900.0, 700.0]),
        rotations.exp(rng.normal(0, 1, 3)), errors,
    )  # fmt: skip
    fast, plain = propagate(motion, first, last, start), plain_strapdown.propagate(motion, first, last, start)
    assert np.abs(fast.state.position_ecef_m - plain.state.position_ecef_m).max() < 1e-8
    assert np.abs(fast.state.velocity_ecef_mps - plain.state.velocity_ecef_mps).max() < 1e-11
    assert np.abs(rotations.boxminus(fast.state.q_ecef_body, plain.state.q_ecef_body)).max() < 1e-13
    # Coriolis on gradient and noise is left out of the kernel's derivatives: 1e-6 a step of what they are; a gradient
    # of gravity of 1.5e-6 /s^2 over 0.1 s is compared with itself
    for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
        for columns in range(0, fast.transition.shape[1], 3):
            got, want = (s.transition[rows, columns : columns + 3] for s in (fast, plain))
            still = np.eye(fast.transition.shape[1])[rows, columns : columns + 3]
            assert np.abs(got - want).max() < 1e-4 * np.abs(want - still).max() + 1e-18, (rows, columns)
    sd = np.sqrt(np.diagonal(plain.noise))
    # the turn of half a step is left out of the noise's lever
    assert np.abs((fast.noise - plain.noise) / np.outer(sd, sd)).max() < 1e-3


@pytest.fixture(scope="module")
def carried():
    nodes = np.array([0.0, 0.11, 0.2])
    spec = replace(SPEC, drag_area_per_mass_m2pkg=0.01)
    state = entry_state(60e3, (800.0, 1500.0, 900.0))
    motion, index = propagation.ballistic_motion(spec, windy_sounding(), across_plane(state), nodes)
    return motion, index, replace(state, sensor_errors=np.concatenate([DRIVERS, [9.0, 9.0]]))


@pytest.mark.parametrize(("first", "last"), [(0, 2), (2, 1)])
def test_ballistic_steps_are_those_of_the_readable_form(carried, first, last):
    motion, index, start = carried
    fast = propagate(motion, index[first], index[last], start)
    plain = plain_ballistic.propagate(motion, index[first], index[last], start)
    np.testing.assert_allclose(fast.state.position_ecef_m, plain.state.position_ecef_m, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(fast.state.velocity_ecef_mps, plain.state.velocity_ecef_mps, rtol=0.0, atol=1e-8)
    size = np.abs(plain.transition).reshape(3, 3, 5, 3).max(axis=(1, 3)).repeat(3, axis=0).repeat(3, axis=1)
    assert (np.abs(fast.transition - plain.transition) <= 1e-8 * size).all()


def test_a_step_of_hard_braking_is_of_fourth_order(carried):
    # a drag that takes a tenth of the speed in a step: rules of second order differ by 0.1^3 of it, 1 m/s
    motion, index, start = carried
    braked = replace(start, sensor_errors=np.r_[6.0, start.sensor_errors[1:]])
    fast = propagate(motion, index[0], index[1], braked)
    plain = plain_ballistic.propagate(motion, index[0], index[1], braked)
    lost = np.linalg.norm(fast.state.velocity_ecef_mps - start.velocity_ecef_mps)
    assert lost > 50.0
    np.testing.assert_allclose(fast.state.velocity_ecef_mps, plain.state.velocity_ecef_mps, rtol=0.0, atol=1e-7 * lost)


def short_fall():
    t, states = fly(3, end_s=6.2)
    return watch(t, states, 3)


def turned_round(telemetry, turns):
    """The same azimuths a whole turn on."""
    radars = {
        name: replace(record, range_az_el=record.range_az_el + np.array([0.0, 2.0 * np.pi * turns, 0.0]))
        for name, record in telemetry.radars.items()
    }
    return replace(telemetry, radars=radars)


def far_off(telemetry, rows, by_m):
    record = telemetry.radars["near"]
    track = record.range_az_el.copy()
    track[rows, 0] += by_m
    return replace(telemetry, radars=telemetry.radars | {"near": replace(record, range_az_el=track)})


SHORT = {"start_s": None, "end_s": 6.1, "output_rate_hz": 1.0}  # six seconds are the least


def test_a_short_fall_is_filtered_alike_by_both_engines_whatever_turn_the_azimuth_is_on():
    telemetry = far_off(short_fall(), [3], 900.0)
    problem = build(telemetry, **SHORT)
    plain = kalman.forward(problem, None, FILTERPY)
    run = kalman.forward(build(turned_round(telemetry, 1), **SHORT))
    assert np.array_equal(run.innovations.accepted, plain.innovations.accepted)
    sd = np.sqrt(np.diagonal(unpacked(plain.filtered.p_minus), axis1=1, axis2=2))
    assert (np.abs(run.filtered.x_plus - plain.filtered.x_plus) / sd).max() < 1e-6
    np.testing.assert_allclose(run.innovations.nis, plain.innovations.nis, rtol=1e-5, atol=1e-8)
    off = np.abs(unpacked(run.filtered.p_minus) - unpacked(plain.filtered.p_minus)) / (sd[:, :, None] * sd[:, None, :])
    assert off.max() < 1e-6
    assert not plain.innovations.accepted.all()
    assert plain.innovations.accepted.any()

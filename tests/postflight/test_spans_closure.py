"""The reconciliation's spans close on a flight of the simulator, truth in, nothing left; its cost has its gradient."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.atmosphere import profile_from_sounding, standard_sounding
from flightmodel.trajectory import resample
from postflight.reconciliation.fit import _linearized_with_creep
from postflight.reconciliation.forward_model import (
    DAMPING_LOG_SD,
    HARDENING_AT_RAD,
    HARDENING_SD,
    OFFSET_SD_M,
    SPAN_S,
    STIFFNESS_LOG_SD,
    VELOCITY,
    WINDOW_S,
    WINDOWS,
    AtmosphereParameters,
    Measurements,
    SpanFlights,
    VehicleParameters,
    _start_states,
)
from postflight.reconciliation.gauss_newton import Problem
from synthetic_flight import dynamics
from synthetic_flight.simulate import ATMOSPHERE_START_M, ATMOSPHERE_STEP_M, fly
from tests.estimators.test_closure import EPOCH, START_S, VEHICLE, start

SPANS, LATE_S, STEP_S = 3, np.array([0.001, -0.001]), 1e-3


@cache
def flown():
    """Three spans at 45 km at 6 rpm, the joint swinging, recorded every millisecond."""
    state = start(6.0, [0.1, -0.15], [0.02, -0.03], [0.015, -0.02])
    profile = profile_from_sounding(standard_sounding())
    return fly(VEHICLE, profile, state, START_S, START_S + SPANS * SPAN_S + 0.1, EPOCH, STEP_S, STEP_S)


def means(values, begin_s):
    """Means of records over windows, by trapezoids over forty of them."""
    t = flown().time_s
    out = []
    for b in begin_s.ravel():
        rows = slice(round((b - t[0]) / STEP_S), round((b - t[0] + WINDOW_S) / STEP_S) + 1)
        out.append(np.trapezoid(values[rows], dx=STEP_S, axis=0) / WINDOW_S)
    return np.array(out).reshape(*begin_s.shape, values.shape[1])


@cache
def problem():
    truth = flown()
    starts = START_S + SPAN_S * np.arange(SPANS + 1)
    begin = starts[:-1, None] + WINDOW_S * np.arange(WINDOWS)
    # near the axis: the joint's twist, of which a window's mean by three records misses 5 %, hardly reaches it
    sensor = VEHICLE.cg_m + np.array([-0.4, 0.015, 0.01])
    at = resample(truth.trajectory, starts)
    at = replace(at, covariance=np.tile(1e-6 * np.eye(9), (SPANS + 1, 1, 1)))
    rate, force = truth.state_eci[:, 14:17], truth.specific_force_body(sensor)
    response = np.zeros((4, 3, 9))
    response[0, :, :3] = 1e-3 * np.eye(3)
    response[1:, :, 3:6] = 0.01 * np.einsum("kj,ij->kij", np.eye(3), np.eye(3))
    middle = START_S + SPAN_S * (np.arange(SPANS) + 0.5)
    pressure, altitude = (np.interp(middle, truth.time_s, x) for x in (truth.dynamic_pressure_pa, truth.altitude_m))
    observed = Measurements(
        at, pressure, altitude,
        begin + 0.5 * WINDOW_S, means(rate, begin), means(force, begin), 1e-4, 1e-2, response, response, LATE_S, sensor,
        np.full(6, 0.1),
    )  # fmt: skip
    air = AtmosphereParameters(standard_sounding(), float(truth.altitude_m.min()))
    return Problem(observed, VehicleParameters(VEHICLE), air)


@cache
def true_unknowns():
    """Motion at the starts of the spans from the truth itself."""
    truth, one = flown(), problem()
    rows = np.rint(SPAN_S * np.arange(SPANS) / STEP_S).astype(int)
    state = truth.state_eci[rows]
    bent = rotations.multiply(rotations.conjugate(state[:, 6:10]), state[:, 10:14])
    across = state[:, 17:20] - rotations.rotate(rotations.conjugate(bent), state[:, 14:17])
    still = np.zeros((SPANS, 3))
    motion = np.column_stack([still, state[:, 14:17], rotations.log(bent), across, still])
    return replace(one.start(), motion=motion)


def test_spans_flown_from_the_truth_read_and_end_as_the_truth():
    one, u = problem(), true_unknowns()
    read = one.predict(u)
    seen = one.measured
    # steps of 4 ms and Simpson's mean of three records: 2e-5 of swings of 0.5 rad/s and 30 m/s^2 at 3 Hz; about x the
    # joint twists at 15 Hz, of which Simpson's rule misses 5 %
    np.testing.assert_allclose(read.windows[..., 1:3], seen.rate_radps[..., 1:], atol=2e-5)
    np.testing.assert_allclose(read.windows[..., 0], seen.rate_radps[..., 0], atol=1e-3)
    np.testing.assert_allclose(read.windows[..., 3:], seen.specific_force_mps2, atol=6e-3)
    assert np.abs(np.diff(seen.specific_force_mps2[..., 1], axis=1)).max() > 0.2
    # a span ends as the next begins, across the axis; about it by the twist's phase after a hundred steps of 4 ms
    across = [1, 2, 4, 5, 7, 8, 10, 11]
    np.testing.assert_allclose(read.end[:-1, across], u.motion[1:, across], atol=5e-5)
    np.testing.assert_allclose(read.end[:-1, [0, 3, 6]], u.motion[1:, [0, 3, 6]], atol=2e-3)
    # and with the path's velocity
    np.testing.assert_allclose(read.end[:-1, VELOCITY], 0.0, atol=5e-4)


def test_a_problem_with_fine_steps_predicts_what_they_do_and_changes_as_before():
    one, u = problem(), true_unknowns()
    fine = one.with_fine_steps(u)
    seen, own, corrected = one.measured, one.predict(u), fine.predict(u)
    truth = np.concatenate([seen.rate_radps, seen.specific_force_mps2], axis=2)
    across = [1, 2, 4, 5, 7, 8, 10, 11]
    for names, want in ((("windows", slice(None)), truth), (("end", across), u.motion[1:, across])):
        off = [np.abs(getattr(each, names[0])[: len(want), ..., names[1]] - want) for each in (own, corrected)]
        before, after = (each.reshape(-1, want.shape[-1]).max(axis=0) for each in off)
        assert (after < 0.75 * before + 1e-7).all()
    moved = u.plus(0.05 * np.random.default_rng(4).standard_normal(one.count))
    for name in ("windows", "end"):
        want = getattr(one.predict(moved), name) - getattr(own, name)
        np.testing.assert_allclose(getattr(fine.predict(moved), name) - getattr(corrected, name), want, atol=1e-12)
    plain, settled = one.linearize(u), fine.linearize(u)
    for (_, a), (_, b) in zip(plain.joins, settled.joins, strict=True):
        np.testing.assert_array_equal(a, b)
    # once more changes nothing: what is taken out is the error of the steps themselves
    np.testing.assert_array_equal(fine.with_fine_steps(u).predict(u).end, corrected.end)


def test_trials_flown_side_by_side_leave_what_each_leaves_alone():
    one, u = problem(), true_unknowns()
    rng = np.random.default_rng(2)
    trials = [u, *(u.plus(0.05 * rng.standard_normal(one.count)) for _ in range(2))]
    together = one.residuals_of(trials)
    for trial, found in zip(trials, together, strict=True):
        alone = one.residuals(trial)
        np.testing.assert_allclose(found.sensors, alone.sensors, rtol=0.0, atol=1e-9 * np.abs(alone.sensors).max())
        np.testing.assert_allclose(found.joins, alone.joins, rtol=0.0, atol=1e-9 * np.abs(alone.joins).max())
    assert together[1].cost > 2.0 * together[0].cost


def test_spans_start_with_the_datum_where_it_was_reconstructed():
    # the composite c.g. of a bent vehicle is put so that the body's datum has the reconstruction's place and velocity
    one, u = problem(), true_unknowns()
    spans = np.arange(SPANS)
    zero = np.zeros_like(spans)
    flights = SpanFlights(spans, zero, u.motion, zero, [one.trial_vehicle(u.vehicle)], np.zeros((0, 6)))
    state = _start_states(one.measured, flights)
    place, velocity = dynamics.points(state, VEHICLE)["body"]
    back = rotations.rotate(state[:, 6:10], np.tile(-VEHICLE.centerbody.cg_m, (SPANS, 1)))
    swing = np.cross(rotations.rotate(state[:, 6:10], state[:, 14:17]), back)
    to_ecef = earth.q_ecef_eci(one.measured.start.time_s[:-1])
    r = rotations.rotate(to_ecef, place + back)
    v = rotations.rotate(to_ecef, velocity + swing) - np.cross(earth.OMEGA_ECEF_RADPS, r)
    np.testing.assert_allclose(r, one.measured.start.position_ecef_m[:-1], rtol=0.0, atol=1e-6)
    # the arm of 0.4 m turns with the rate against inertial space: the Earth's share of that is 3e-5 m/s
    np.testing.assert_allclose(v, one.measured.start.velocity_ecef_mps[:-1], rtol=0.0, atol=1e-4)
    # or so much faster
    motion = u.motion.copy()
    motion[:, VELOCITY] = [0.3, -0.2, 0.1]
    faster = _start_states(one.measured, replace(flights, motion=motion))
    gained = rotations.rotate(to_ecef, faster[:, 3:6] - state[:, 3:6])
    np.testing.assert_allclose(gained, np.tile([0.3, -0.2, 0.1], (SPANS, 1)), atol=1e-9)


def test_a_late_clock_shows_what_was_earlier():
    # readings with tags that are late by a standard deviation of each clock leave nothing once that is taken for true
    one, u = problem(), true_unknowns()
    begin = one.measured.time_s - 0.5 * WINDOW_S
    truth = flown()
    inside = begin[1:-1] if SPANS > 2 else begin
    rate = means(truth.state_eci[:, 14:17], inside - LATE_S[0])
    force = means(truth.specific_force_body(one.measured.accelerometer_m), inside - LATE_S[1])
    read = one.predict(u)
    late = u.instruments.copy()
    late[18:20] = 1.0
    shown = read.windows + one.instrument_response(read) @ late
    # slopes are those of windows' ends: of a signal of 3 Hz over 40 ms they miss 2.4 %; second order of 1 ms 1 %
    for part, want, own in (
        (slice(1, 3), rate[..., 1:], one.measured.rate_radps[1:-1, :, 1:]),
        (slice(4, 6), force[..., 1:], one.measured.specific_force_mps2[1:-1, :, 1:]),
    ):
        left = np.abs(shown[1:-1][..., part] - want).max()
        assert left < 0.08 * np.abs(own - want).max()


def test_the_normal_equations_are_those_of_all_residuals():
    one, u = problem(), true_unknowns()
    linear = one.linearize(u)
    normal = one.normal_equations(u, linear)
    want = np.zeros((one.count, one.count))
    for column, response in (*linear.sensors, *linear.joins):
        want[np.ix_(column, column)] += response.T @ response
    for part, precision, _ in one._priors(u):
        want[part, part] += precision
    size = np.sqrt(np.diag(want))
    np.testing.assert_allclose(normal.dense / np.outer(size, size), want / np.outer(size, size), atol=1e-12)
    sought, (coupling, others) = 5, normal.without(5)
    np.testing.assert_allclose(coupling / size[5:, None], want[sought:, :sought] / size[5:, None], atol=1e-9)
    assert others.log_det == pytest.approx(np.linalg.slogdet(want[sought:, sought:])[1], abs=1e-6)


def test_the_cost_falls_along_the_right_hand_side():
    # half the gradient of the sum of squares, by differences of the cost itself, at a candidate off the prior's middle
    one, rng = problem(), np.random.default_rng(3)
    u = true_unknowns()
    u = replace(
        u,
        vehicle=0.3 * rng.standard_normal(len(u.vehicle)),
        instruments=0.5 * rng.standard_normal(20),
        air=0.02 * rng.standard_normal(u.air.shape) * np.array([[0.1], [10.0], [10.0]]),
        warmer_k=2.0 * rng.standard_normal(u.warmer_k.shape),
    )
    linear = one.linearize(u)
    right = one.right_hand_side(u, linear, linear.residuals)
    assert len(right) == one.count
    first_air = one.first_instrument + 20
    last = one.first_motion + VELOCITY.start + 1
    late, warm = one.first_instrument + 18, one.first_temperature + 1
    for k in (0, 2, one.first_instrument, late, first_air, warm, one.first_motion + 1, last):
        step = np.zeros(one.count)
        step[k] = 1e-5
        up, down = (one.residuals(u.plus(side * step)).cost for side in (1.0, -1.0))
        slope = (up - down) / 2e-5
        assert slope == pytest.approx(-2.0 * right[k], rel=0.02, abs=1e-3 * np.abs(right).max()), k
    # the priors alone, exactly
    priors = one.prior_cost(u)
    assert priors > 0.0
    nothing = replace(linear.residuals, sensors=0.0 * linear.residuals.sensors, joins=0.0 * linear.residuals.joins)
    pull = one.right_hand_side(u, linear, nothing)
    for k in (1, one.first_instrument + 3, first_air + 2, one.first_temperature, last):
        step = np.zeros(one.count)
        step[k] = 1e-3
        up, down = (one.prior_cost(u.plus(side * step)) for side in (1.0, -1.0))
        assert (up - down) / 2e-3 == pytest.approx(-2.0 * pull[k], rel=1e-6)


def vehicle_at(laws=(), **moved):
    unknown = VehicleParameters(VEHICLE, laws)
    x = np.zeros(len(unknown.names))
    for name, value in moved.items():
        x[unknown.names.index(name.replace("_", " ").replace("cg", "c.g."))] = value
    return unknown.vehicle(x)


def test_unknowns_move_what_their_names_say():
    told = VEHICLE
    ratio = told.joint.bending_damping_nmsprad / told.critical_damping_nmsprad()
    stiff = vehicle_at(stiffness=1.0)
    assert stiff.joint.bending_stiffness_nmprad == pytest.approx(
        told.joint.bending_stiffness_nmprad * np.exp(STIFFNESS_LOG_SD)
    )
    # the damping ratio stays, whatever the stiffness
    assert stiff.joint.bending_damping_nmsprad / stiff.critical_damping_nmsprad() == pytest.approx(ratio, rel=1e-12)
    damped = vehicle_at(damping=-1.0)
    assert damped.joint.bending_damping_nmsprad / damped.critical_damping_nmsprad() == pytest.approx(
        ratio * np.exp(-DAMPING_LOG_SD)
    )
    # the whole vehicle's offset; a shell that is heavy to one side leaves it where it is
    for shell_side in (0.0, 2.0):
        unknown = VehicleParameters(VEHICLE)
        x = np.zeros(len(unknown.names))
        x[unknown.names.index("offset y")], x[unknown.names.index("shell's c.g. y")] = 1.0, shell_side
        np.testing.assert_allclose(unknown.vehicle(x).cg_m[1:] - told.cg_m[1:], [OFFSET_SD_M, 0.0], atol=1e-15)
    # tangent stiffness at the angle of reference: K + 3 k3 theta^2
    hard = vehicle_at(("hardening",), hardening=1.0).joint
    tangent = hard.bending_stiffness_nmprad + 3.0 * hard.hardening_nmprad3 * HARDENING_AT_RAD**2
    assert tangent / hard.bending_stiffness_nmprad == pytest.approx(1.0 + HARDENING_SD)


def test_the_air_s_table_holds_the_difference_at_and_between_its_rows():
    air = AtmosphereParameters(standard_sounding(), 43e3)
    difference = np.zeros((3, len(air.knots_m)))
    difference[0] = 0.1 * np.sin(air.knots_m / 3e3)
    difference[1] = 7.0
    warmer = np.full(len(air.temperature_knots_m), 0.01)
    plain, moved = air.table(0.0 * difference, 0.0 * warmer), air.table(difference, warmer)
    rows = ATMOSPHERE_START_M + ATMOSPHERE_STEP_M * np.arange(len(plain))
    inside = (rows > air.knots_m[0]) & (rows < air.knots_m[-2])
    want = np.interp(rows, air.knots_m, difference[0])
    np.testing.assert_allclose(np.log(moved[:, 0] / plain[:, 0])[inside], want[inside], atol=1e-12)
    np.testing.assert_allclose((moved[:, 3] - plain[:, 3])[inside], 7.0)
    # 0.01 K warmer: the speed of sound, sqrt(1.4 * 287.053 T) where the gas is the ground's
    low = rows < 86e3
    np.testing.assert_allclose((moved[low, 2] ** 2 - plain[low, 2] ** 2) / (1.4 * 287.053), 0.01, rtol=1e-4)
    # each row's change up to the next is the next one's density
    np.testing.assert_allclose(np.diff(np.log(moved[:, 0])), moved[:-1, 1], atol=1e-12)


def test_the_sounding_s_errors_are_half_constant():
    # the precision is that of a covariance whose far corners stay at half the variance
    air = AtmosphereParameters(standard_sounding(), 60e3)
    at = profile_from_sounding(standard_sounding()).at(air.knots_m)
    for kind, (sd, length) in enumerate(((at.density_sd, 5000.0), (at.wind_sd_mps, 3000.0), (at.wind_sd_mps, 3000.0))):
        covariance = np.linalg.inv(air.precision[kind])
        correlation = covariance / np.outer(sd, sd)
        np.testing.assert_allclose(np.diag(correlation), 1.0, rtol=1e-6)
        far = air.knots_m[-1] - air.knots_m[0]
        assert correlation[0, -1] == pytest.approx(0.5 + 0.5 * np.exp(-far / length), rel=1e-6)


def test_creep_is_linearized_by_what_it_adds():
    """The same equations as with all of its spans flown, to what forward differences leave."""
    plain, u = problem(), true_unknowns()
    creeping = replace(plain, vehicle_parameters=VehicleParameters(VEHICLE, ("creep",)), creep_per_s=0.1)
    vehicle = np.insert(u.vehicle, plain.vehicle_parameters.sought, [0.0, 1.0])
    start = replace(u, vehicle=vehicle, motion=np.pad(u.motion, ((0, 0), (0, creeping.motion - plain.motion))))
    found = _linearized_with_creep(plain, plain.linearize(u), creeping, start)
    want = creeping.linearize(start)
    np.testing.assert_array_equal(found.residuals.joins, want.residuals.joins)
    dense = [creeping.normal_equations(start, each).dense for each in (found, want)]
    size = np.sqrt(np.diag(dense[1]))
    off = (dense[0] - dense[1]) / np.outer(size, size)
    np.testing.assert_allclose(off, 0.0, atol=1e-4)
    growth = creeping.vehicle_parameters.names.index("creep growth")
    assert dense[1][growth, growth] > 1.1  # more than the prior's: creep acts

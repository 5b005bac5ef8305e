"""Evidence, intervals, spectra and loosened joints of the reconciliation, each by its definition."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.atmosphere import default_sounding_sd, us76
from flightmodel.telemetry import Sounding
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.reconciliation.command import MOST_MOVED_SD, credibility
from postflight.reconciliation.fit import CreepScore, JointFit, require_damping, with_freeplay
from postflight.reconciliation.forward_model import (
    FAST_JOINT,
    FREEPLAY_SD_RAD,
    MOTION,
    OFFSET_SD_M,
    SLOW_JOINT,
    STIFFNESS_LOG_SD,
    AtmosphereParameters,
    SpanFlights,
    VehicleParameters,
    integrable,
    resolved_stiffness_nmprad,
    steps_for,
)
from postflight.reconciliation.gauss_newton import (
    LEAST_COMPLIANCE,
    Linearization,
    Parameters,
    Residuals,
    _better,
    stiffness_step,
)
from postflight.reconciliation.modes import HOP, PADDED, RATE_HZ, WINDOW, _spectra
from postflight.reconciliation.normal_equations import ArrowMatrix, NormalEquations
from postflight.reconciliation.posterior import joint_table, stiffness_bound
from synthetic_flight.dynamics import beyond_freeplay, joint_modes
from tests.refusing import refuses

VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))


def full(matrix):
    """Matrix as one without a band."""
    out = ArrowMatrix.zeros(len(matrix), 0, 0)
    out.add(np.arange(len(matrix)), matrix)
    return out


def test_evidence_is_the_integral_of_the_posterior():
    # a cost that is quadratic about its lowest: exp(-cost / 2) summed over a fine grid of both unknowns
    covariance, lowest, weights = np.array([[0.5, 0.2], [0.2, 0.9]]), 3.7, 1.3
    grid = np.linspace(-8.0, 8.0, 801)
    x = np.stack(np.meshgrid(grid, grid), axis=-1)
    cost = lowest + np.einsum("...i,ij,...j->...", x, np.linalg.inv(covariance), x)
    integral = np.exp(-0.5 * cost).sum() * (grid[1] - grid[0]) ** 2 / (2.0 * np.pi)
    problem = SimpleNamespace(vehicle_parameters=SimpleNamespace(laws=()), log_weight=weights)
    normal = NormalEquations(full(np.linalg.inv(covariance)), np.zeros(2), np.arange(2))
    found = JointFit(problem, None, normal, SimpleNamespace(cost=lowest), 1, True)
    assert found.log_evidence == pytest.approx(weights + np.log(integral), rel=1e-6)


def test_intervals_hold_nine_tenths():
    # the c.g.'s offset is linear in its unknown: of drawn offsets nine in ten lie inside, a twentieth on either side
    unknown = VehicleParameters(VEHICLE)
    n = len(unknown.names)
    found = SimpleNamespace(
        problem=SimpleNamespace(vehicle_parameters=unknown), parameters=SimpleNamespace(vehicle=np.zeros(n)),
        covariance=0.01 * np.eye(n),
    )  # fmt: skip
    row = joint_table(found).set_index("quantity").loc["c.g. offset y"]
    told = 100.0 * VEHICLE.cg_m[1]
    drawn = told + 100.0 * OFFSET_SD_M * 0.1 * np.random.default_rng(1).standard_normal(40000)
    # the shell's lateral c.g. and the masses move it too, by less
    assert row.sd == pytest.approx(np.std(drawn), rel=0.05)
    assert np.mean(drawn < row.low) == pytest.approx(0.05, abs=0.012)
    assert np.mean(drawn > row.high) == pytest.approx(0.05, abs=0.012)


def test_a_swing_that_does_not_roll_has_its_own_frequency_whatever_the_roll():
    # a lateral vector that turns at 3 Hz in space, told in a body that rolls at 0.7 Hz
    t = np.arange(0.0, 14.0, 1.0 / 200.0)
    roll = 2.0 * np.pi * 0.7 * t
    seen = np.exp(1j * (2.0 * np.pi * 3.0 * t - roll)) + 0.01 * np.random.default_rng(2).standard_normal(len(t))
    three = np.column_stack([np.full(len(t), 2.0 * np.pi * 0.7), seen.real, seen.imag])
    bet = SimpleNamespace(imu_time_s=t, rate_body_radps=three, specific_force_body_mps2=three)
    at, power = _spectra(SimpleNamespace(solution=bet), np.array([1.0, 13.0]))
    assert len(at) >= (12.0 * RATE_HZ - WINDOW) / HOP - 1
    frequency = np.fft.fftfreq(PADDED, 1.0 / RATE_HZ)
    np.testing.assert_allclose(frequency[np.argmax(power, axis=1)], 3.0, atol=0.1)


@pytest.mark.parametrize("corner", [1.0, 0.1])
def test_a_loosened_joint_carries_the_plain_one_s_moment(corner):
    # bent so much further that beyond the dead band as much is left as the plain joint was bent
    sizes, freeplay = np.deg2rad([0.02, 0.1, 0.6, 3.0]), np.deg2rad(0.25)
    names = ("stiffness", "damping", "offset y", "offset z", "static stability", "freeplay")
    motion = np.zeros((4, MOTION))
    motion[:, 7], motion[:, 8] = 0.6 * sizes, -0.8 * sizes
    plain = Parameters(np.zeros(5), np.zeros(20), np.zeros((3, 4)), np.zeros(2), motion)
    made = with_freeplay(SimpleNamespace(vehicle_parameters=SimpleNamespace(names=names)), plain, freeplay, corner)
    bent = np.linalg.norm(made.motion[:, 7:9], axis=1)
    np.testing.assert_allclose(beyond_freeplay(bent, freeplay, corner), sizes, rtol=1e-9)
    np.testing.assert_allclose(made.motion[:, 7] / made.motion[:, 8], -0.75)
    assert made.vehicle[5] * FREEPLAY_SD_RAD == pytest.approx(freeplay)


def test_a_step_whose_look_ahead_tumbles_is_tried_straight():
    # residual 1 - x, of which nothing can be flown between 0.05 and 0.9
    def residuals(u):
        x = float(u.instruments[0])
        left = np.array([np.nan if 0.05 < abs(x) < 0.9 else 1.0 - x])
        return Residuals(left, np.zeros(0), float(left[0] ** 2) if np.isfinite(left[0]) else np.inf)

    u = Parameters(np.zeros(1), np.zeros(1), np.zeros((3, 0)), np.zeros(0), np.zeros((0, MOTION)))
    first = residuals(u)
    linear = Linearization(first, [(np.array([0, 1]), np.array([[0.0, 1.0]]))], [], 2)
    normal = NormalEquations(full(np.eye(2)), np.array([0.0, 1.0]), np.arange(2))
    problem = SimpleNamespace(residuals_of=lambda trials: [residuals(u) for u in trials])
    found, end = _better(problem, u, linear, normal, 0.0, (first, u))
    assert end.instruments[0] == pytest.approx(1.0)
    assert found.cost == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("shared", "blocks", "size"), [(7, 12, 5), (0, 4, 3), (6, 0, 5), (3, 1, 4)])
def test_normal_equations_of_an_arrow_are_solved_as_full_ones(shared, blocks, size):
    rng = np.random.default_rng(5)
    n = shared + blocks * size
    response = rng.standard_normal((3 * n, n)) * np.exp(3.0 * rng.standard_normal(n))
    matrix = response.T @ response
    block = np.maximum(np.arange(n) - shared, -1) // size
    apart = np.abs(block[:, None] - block) > 1
    matrix[apart & (block[:, None] >= 0) & (block >= 0)] = 0.0
    matrix += np.diag(0.5 * np.abs(matrix).sum(axis=1) * (block >= 0))  # positive definite without what was taken out
    right = rng.standard_normal(n)
    arrow = ArrowMatrix.zeros(shared, blocks * size, 2 * size - 1)
    # all that is shared, then the rest block by block with the next
    arrow.add(np.arange(shared), matrix[:shared, :shared])
    left = matrix.copy()
    left[:shared, :shared] = 0.0
    for start in range(shared, n, size):
        columns = np.concatenate([np.arange(shared), np.arange(start, min(start + 2 * size, n))])
        part = left[np.ix_(columns, columns)]
        arrow.add(columns, part)
        left[np.ix_(columns, columns)] = 0.0
    np.testing.assert_allclose(arrow.dense, matrix, rtol=1e-14)
    normal = NormalEquations(arrow, right, np.arange(n))
    scale = 1.0 / np.sqrt(np.diag(matrix))
    for damping in (0.0, 0.3):
        damped = matrix + damping * np.diag(np.diag(matrix))
        want = np.linalg.solve(damped * scale[:, None] * scale, right * scale) * scale
        np.testing.assert_allclose(normal.solver(damping)(right) / scale, want / scale, rtol=1e-9, atol=1e-10)
    some = rng.permutation(n)[:4]
    want = np.linalg.inv(matrix * scale[:, None] * scale)[np.ix_(some, some)]
    np.testing.assert_allclose(normal.covariance_of(some) / np.outer(scale[some], scale[some]), want, atol=1e-9)
    assert normal.log_det == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-9)
    np.testing.assert_allclose(arrow.without(shared // 2).dense, matrix[shared // 2 :, shared // 2 :], rtol=1e-14)


def test_a_border_takes_an_outer_product_from_the_matrix():
    rng = np.random.default_rng(6)
    shared, n = 3, 12
    response, u = rng.standard_normal((40, n)), 0.5 * rng.standard_normal((n, 2))
    want = response.T @ response + 2.0 * np.eye(n) - u @ u.T
    place, borders = rng.permutation(np.r_[0:2, 4 : n + 2]), np.array([2, 3])
    arrow = ArrowMatrix.zeros(shared + 1, n + 2 - shared - 1, n)
    arrow.add(place, response.T @ response + 2.0 * np.eye(n))
    bordered = np.zeros((n + 2, 2))
    bordered[place] = u
    bordered[borders] = np.eye(2)
    arrow.corner[:, borders], arrow.across[:, borders] = bordered[:4], bordered[4:]
    arrow.corner[borders] = arrow.corner[:, borders].T
    normal, right = NormalEquations(arrow, rng.standard_normal(n), place), rng.standard_normal((n, 3))
    np.testing.assert_allclose(normal.dense, want, rtol=1e-12, atol=1e-12)
    for damping in (0.0, 0.3):
        damped = want + damping * np.diag(np.diag(want))
        np.testing.assert_allclose(normal.solver(damping)(right), np.linalg.solve(damped, right), rtol=1e-9, atol=1e-12)
    assert normal.log_det == pytest.approx(np.linalg.slogdet(want)[1], abs=1e-9)


def stiff(factor):
    """The reference vehicle with another stiffness."""
    joint = VEHICLE.joint
    changed = {"bending_stiffness_nmprad": factor * joint.bending_stiffness_nmprad}
    return replace(VEHICLE, joint=joint.model_copy(update=changed))


@pytest.mark.parametrize("steps", [SLOW_JOINT, FAST_JOINT])
def test_a_window_s_mean_is_simpson_s(steps):
    # exact for a cubic, and the weights sum to one
    t = np.linspace(0.0, 1.0, steps.intervals + 1)
    assert steps.simpson @ np.ones_like(t) == pytest.approx(1.0)
    assert steps.simpson @ (4.0 * t**3 - t) == pytest.approx(0.5)


def test_a_joint_that_steps_and_windows_resolve_is_flown_as_it_is():
    soft = integrable(VEHICLE, SLOW_JOINT).joint
    assert soft.bending_stiffness_nmprad == pytest.approx(VEHICLE.joint.bending_stiffness_nmprad, rel=1e-6)
    assert soft.bending_damping_nmsprad == VEHICLE.joint.bending_damping_nmsprad
    assert steps_for(VEHICLE) is SLOW_JOINT
    assert steps_for(stiff(20.0)) is FAST_JOINT


def test_a_joint_beyond_the_windows_is_damped_and_no_stiffer_than_the_steps_follow():
    locked = integrable(stiff(1e3), FAST_JOINT)
    inertia, damping, stiffness = joint_modes(locked)["bending"]
    assert np.sqrt(stiffness / inertia) * FAST_JOINT.step_s == pytest.approx(0.8, rel=1e-3)
    assert damping / (2.0 * np.sqrt(stiffness * inertia)) == pytest.approx(0.2)


def test_a_step_of_the_stiffness_is_straight_in_the_compliance():
    def compliance(step):
        return np.exp(-STIFFNESS_LOG_SD * stiffness_step(step))

    assert compliance(-2.0) == pytest.approx(1.0 + 2.0 * STIFFNESS_LOG_SD)
    assert compliance(0.2) == pytest.approx(1.0 - 0.2 * STIFFNESS_LOG_SD)
    edge = (1.0 - LEAST_COMPLIANCE) / STIFFNESS_LOG_SD
    slopes = [(compliance(edge + d) - compliance(edge)) / d for d in (-1e-6, 1e-6)]
    assert slopes == pytest.approx([-STIFFNESS_LOG_SD] * 2, rel=1e-4)
    assert 0.0 < compliance(5.0) < 0.01


def found_at(x, precision):
    """Fit whose measurements know the stiffness's parameter with a precision, and nothing else."""
    parameters = VehicleParameters(VEHICLE)
    vehicle, covariance = np.zeros(len(parameters.names)), np.eye(len(parameters.names))
    vehicle[0], covariance[0, 0] = x, 1.0 / (precision + 1.0)
    return SimpleNamespace(
        problem=SimpleNamespace(vehicle_parameters=parameters),
        parameters=SimpleNamespace(vehicle=vehicle),
        covariance=covariance,
    )


def test_a_soft_joint_is_estimated_and_a_locked_one_bounded():
    assert stiffness_bound(found_at(0.0, (STIFFNESS_LOG_SD / 0.02) ** 2)) is None
    # a compliance 0.5 +/- 0.5 of the most probable joint's, of which only the positive part is possible
    precision = (STIFFNESS_LOG_SD / 0.5) ** 2
    x = 0.5 * precision / STIFFNESS_LOG_SD
    found = found_at(x, precision)
    drawn = 0.5 + 0.5 * np.random.default_rng(1).standard_normal(400_000)
    largest = np.quantile(drawn[drawn > 0.0], 0.95)
    best = VehicleParameters(VEHICLE).vehicle(found.parameters.vehicle)
    expected = min(best.joint.bending_stiffness_nmprad / largest, resolved_stiffness_nmprad(best))
    assert stiffness_bound(found) == pytest.approx(expected, rel=0.01)
    row = joint_table(found).set_index("quantity").loc["bending stiffness"]
    assert row.kind == "lower bound"
    assert np.isinf(row.high)
    assert row.low == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("of_limit", "bounded"), [(0.88, False), (0.92, True), (0.98, True)])
def test_a_joint_near_the_frequency_that_windows_resolve_is_bounded(of_limit, bounded):
    """However small the sd: a faster joint may have been fitted at a false frequency."""
    nominal = VehicleParameters(VEHICLE).nominal
    limit = resolved_stiffness_nmprad(nominal) / nominal.joint.bending_stiffness_nmprad
    found = found_at(float(np.log(limit * of_limit**2)) / STIFFNESS_LOG_SD, (STIFFNESS_LOG_SD / 0.014) ** 2)
    best = found.problem.vehicle_parameters.vehicle(found.parameters.vehicle).joint.bending_stiffness_nmprad
    bound = stiffness_bound(found)
    assert (bound is not None) is bounded
    assert not bounded or bound <= best


def test_the_bound_is_continuous_where_the_tail_is_an_exponential():
    # compliances 9.9 and 10.1 sd below zero by the measurements
    bounds = []
    for below in (9.9, 10.1):
        precision = 0.01
        found = found_at(
            (1.0 + below * STIFFNESS_LOG_SD / np.sqrt(precision)) * precision / STIFFNESS_LOG_SD, precision
        )
        best = found.problem.vehicle_parameters.vehicle(found.parameters.vehicle).joint.bending_stiffness_nmprad
        bounds.append(stiffness_bound(found) / best)
    assert bounds[0] == pytest.approx(bounds[1], rel=0.05)
    assert bounds[0] > 0.0


def fit_with(vehicle=0.0, cost=900.0, spans=1.0, converged=True, creep=1.0, by_steps=0.1):
    """Fit of ten spans: residuals, move of one stated number of the vehicle, creep that it lacks and moves by finer
    steps, sd.
    """
    parameters = VehicleParameters(VEHICLE)
    values = np.zeros(len(parameters.names))
    values[parameters.names.index("mass of the shell")] = vehicle
    joins = np.zeros((9, 12))
    joins[3, 4] = spans
    residuals = SimpleNamespace(sensors=np.ones((10, 10, 6)), joins=joins, cost=cost)
    problem = SimpleNamespace(
        vehicle_parameters=parameters, measured=SimpleNamespace(spans=10), weight=np.ones((10, 10, 6)),
        motion=parameters.motion, held=(), first_instrument=len(values),
    )  # fmt: skip
    unknown = SimpleNamespace(vehicle=values, instruments=np.zeros(20))
    n = len(values) + 20
    normal = NormalEquations(full(2.0 * np.eye(n)), np.zeros(n), np.arange(n))
    found = JointFit(problem, unknown, normal, residuals, 4, converged)
    found.__dict__["moves_by_steps_sd"] = np.array([0.0, -by_steps, 0.0])
    found.__dict__["creep_scores"] = (CreepScore(2.0, -0.3, 0.05), CreepScore(10.0, 0.02 * creep, 0.02))
    return found


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"cost": 1.3 * 597.0}, "joint-residuals"),
        ({"vehicle": 1.1 * MOST_MOVED_SD}, "joint-moves"),
        ({"spans": 12.0}, "joint-spans"),
        ({"converged": False}, "not-converged"),
        ({"by_steps": 0.6}, "joint-steps"),
        ({"creep": 4.5}, "joint-creep"),
    ],
)
def test_a_fit_that_cannot_be_believed_turns_red(wrong, code):
    assert all(each.passed for each in credibility(fit_with(cost=597.0)))
    assert [each.code for each in credibility(fit_with(**{"cost": 597.0, **wrong})) if not each.passed] == [code]


@pytest.mark.parametrize(("factor", "passed"), [(1.4, True), (1.7, False), (0.6, False)])
def test_a_joint_that_oscillates_at_another_frequency_turns_red(factor, passed):
    # the fit knows the stiffness to 2 %, its frequency to a tenth: 1.4 is 3.3 sd, 1.7 is 5.2 and 0.6 as many
    fit = fit_with(cost=597.0)
    fit.covariance[0, 0] = (0.02 / STIFFNESS_LOG_SD) ** 2
    stiffness = factor * VEHICLE.joint.bending_stiffness_nmprad
    modal = SimpleNamespace(stiffness_nmprad=stiffness, sd_nmprad=0.1 * stiffness)
    *others, check = credibility(fit, modal)
    assert check.code == "joint-frequency"
    assert check.value == pytest.approx(abs(np.log(factor)) / np.hypot(0.1, 0.02), rel=1e-6)
    assert check.passed is passed
    assert all(each.passed for each in others)


def test_a_table_moved_at_a_knot_is_that_of_the_moved_differences():
    z = np.arange(0.0, 100e3, 500.0)
    density, temperature, pressure = us76(z)
    sounding = Sounding(z, density, temperature, pressure, 0.0 * z + 5.0, 0.0 * z, *default_sounding_sd(z))
    air = AtmosphereParameters(sounding, 30e3)
    rng = np.random.default_rng(2)
    knots, warm = len(air.knots_m), rng.standard_normal(len(air.temperature_knots_m))
    difference = rng.standard_normal((3, knots)) * np.array([[0.02], [5.0], [5.0]])
    table = air.table(difference, warm)
    for kind in range(3):
        for knot in (0, 1, knots // 2, knots - 2, knots - 1):
            moved = difference.copy()
            moved[kind, knot] += 0.1
            rows = air.moved_rows(table, kind, knot, 0.1)
            np.testing.assert_allclose(with_rows(table, rows), air.table(moved, warm), rtol=1e-13, atol=1e-12)
            assert not np.array_equal(air.table(moved, warm), table)
    for knot in (0, 1, len(warm) // 2, len(warm) - 1):
        moved = warm.copy()
        moved[knot] += 0.1
        rows = air.moved_rows(table, 3, knot, 0.1)
        np.testing.assert_allclose(with_rows(table, rows), air.table(difference, moved), rtol=1e-13, atol=1e-12)
        assert not np.array_equal(air.table(difference, moved), table)


def with_rows(table, moved):
    """Return table 1 of flights that differ in some rows of the air, by way of a part of it."""
    none, one = np.zeros(2, dtype=np.int64), np.array([0, 1])
    flights = SpanFlights(none, none, np.zeros((2, 15)), one, [], table, [moved])
    first = flights.air_of(none, slice(0, len(table)))
    np.testing.assert_array_equal(first, table)
    middle = moved.first + len(moved.rows) // 2
    parts = [flights.air_of(one, slice(0, middle)), flights.air_of(one, slice(middle, len(table)))]
    np.testing.assert_array_equal(np.concatenate([part[0] for part in parts]), table)
    return np.concatenate([part[1] for part in parts])


def test_a_joint_without_damping_is_refused_and_told_what_to_state():
    """A factor on nothing stays nothing: it would be sought without end."""
    vehicle = vehicle_from_toml(vehicle_path("fire2"))
    with refuses("joint-undamped", names=["bending_damping_nmsprad", "fire2"]):
        require_damping(vehicle)
    require_damping(vehicle_from_toml(vehicle_path("irve3")))

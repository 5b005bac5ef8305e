"""Increments along Mach number: the prior as stated, the sums exact, and errors of a table's shape found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array

from estimators import increments
from estimators.deflection_spline import DEFLECTION_SD_RAD, FREE_RADPS2
from estimators.fusion import equations_of, fuse, loads_reader
from estimators.increments import COEFFICIENTS, SHAPE_LENGTH, STATED, Processes, estimate_increments
from flightmodel.atmosphere import standard_atmosphere
from synthetic_flight.simulate import fly

from .conftest import VEHICLE
from .test_closure import EPOCH, START_S, pulse_of_truth, start
from .test_fusion import METHODS, TIME_S, N, linear_evidence, motion

MACH = np.linspace(1.5, 3.4, 40)
PROCESSES = Processes.over(MACH, VEHICLE.uncertainty)
SD = np.array([getattr(VEHICLE.uncertainty, name) for name in STATED])


def test_a_priori_variance_is_the_stated_one_and_forgets_over_the_stated_length():
    stated = VEHICLE.uncertainty.model_copy(update={"cm_shape_part": 0.2, "cmq_shape_part": 0.0})
    processes = Processes.over(MACH, stated)
    for k, (root, part) in enumerate(zip(processes.roots(), (0.5, 0.5, 0.2, 0.0), strict=True)):
        cov = root @ root.T
        np.testing.assert_allclose(np.diag(cov), SD[k] ** 2, rtol=1e-9)
        apart = processes.log_mach[-1] - processes.log_mach[0]
        expected = (1.0 - part + part * np.exp(-apart / SHAPE_LENGTH)) * SD[k] ** 2
        assert cov[0, -1] == pytest.approx(expected, rel=1e-9)


def test_a_coefficient_that_errs_by_a_factor_alone_has_one_increment():
    values = np.tile(0.05, (4, len(PROCESSES.log_mach)))
    factors = replace(PROCESSES, shape_part=np.zeros(4))
    np.testing.assert_allclose(factors.at(np.array([0.0, 3.3, 25.0]), values), 0.05)


def test_beyond_the_knots_an_increment_fades_to_its_constant_part():
    """The mean of the joint Gaussian given the knots, by the precision of knots and one place more."""
    values = np.random.default_rng(1).standard_normal((4, len(PROCESSES.log_mach)))
    np.testing.assert_allclose(PROCESSES.at(np.exp(PROCESSES.log_mach), values), values, atol=1e-9)
    far = 25.0
    places = np.append(PROCESSES.log_mach, np.log(far))
    joint = 0.5 + 0.5 * np.exp(-np.abs(places[:, None] - places[None, :]) / SHAPE_LENGTH)
    precision = np.linalg.inv(joint)
    expected = -(values @ precision[-1, :-1]) / precision[-1, -1]
    np.testing.assert_allclose(PROCESSES.at(np.array([far]), values)[:, 0], expected, atol=1e-9)


def test_the_flown_table_has_the_increments_at_all_angles():
    values = np.outer([0.03, -0.07, 0.1, 0.2], np.linspace(-1.0, 1.0, len(PROCESSES.log_mach)))
    flown = PROCESSES.flown(VEHICLE.aero, values)
    mach = np.exp(PROCESSES.log_mach)
    for alpha in np.deg2rad([0.0, 7.3, 40.0]):
        before, after = VEHICLE.aero.at(mach, alpha), flown.at(mach, alpha)
        np.testing.assert_allclose(after[:, :3], before[:, :3] * (1.0 + values[:3].T), atol=1e-12)
        np.testing.assert_allclose(after[:, 3], before[:, 3] + values[3], atol=1e-12)


def test_inputs_with_the_deflection_integrated_over_are_those_of_the_whole_problem():
    rng = np.random.default_rng(5)
    one = replace(linear_evidence(rng, "a", ("p", "q")), theta_yz_rad=motion() + 1e-3 * rng.normal(size=(N, 2)))
    normal = equations_of([one], {}, (TIME_S[0], TIME_S[-1]))
    size = 2 * normal.spline.count
    matrix = normal.matrix.dense
    curvature = np.kron(normal.spline.rows(normal.spline.knots_s, 2).toarray(), np.eye(2))
    matrix[:size, :size] += curvature.T @ curvature / FREE_RADPS2**2 + np.eye(size) / DEFLECTION_SD_RAD**2
    covariance = np.linalg.inv(matrix)
    mean = covariance @ normal.right
    found = normal.solved(FREE_RADPS2, "whole")
    inputs = found.input_posterior
    np.testing.assert_allclose(inputs.mean, mean[size:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(inputs.covariance, covariance[size:, size:], rtol=1e-6)
    whole = normal.spline.rows(TIME_S) @ mean[:size].reshape(-1, 2)
    np.testing.assert_allclose(found.deflection(TIME_S), whole, atol=1e-9)
    np.testing.assert_allclose(found.sd, np.sqrt(np.diag(covariance))[:size], rtol=1e-5)
    value = normal.spline.rows(TIME_S[::7]).toarray()
    lateral = value @ covariance[:size:2, 1:size:2] @ value.T
    got = found.lateral_cov(TIME_S[::7])
    np.testing.assert_allclose(got[:, 0, 1], np.diag(lateral), rtol=1e-4, atol=1e-14)


@cache
def flown(k=0, size=0.0):
    """Loads of twelve seconds of the simulator and what is uncertain of them; the analyst has the table as it was.

    One coefficient's increment grows along Mach number, by ``size`` of its stated sd to both sides.
    """
    return flown_with(slope(k, size))


def flown_with(change):
    """Loads of a vehicle whose table has increments ``change`` (4, k) at the knots of `PROCESSES`."""
    vehicle = replace(VEHICLE, aero=PROCESSES.flown(VEHICLE.aero, change))
    state = start(12.0, [0.1, -0.15], [0.06, -0.08], np.deg2rad([2.0, -1.5]))
    truth = fly(vehicle, standard_atmosphere(), state, START_S, START_S + 12.0, EPOCH, 0.002, 0.01)
    assert truth.remark == ""
    loads = pulse_of_truth(truth).rows(np.arange(len(truth.time_s)) % 5 == 0)
    n = len(loads.time_s)
    force_root = np.zeros((n, 3, 9))
    force_root[:, :, :3] = 0.05 * np.eye(3)
    flow_cov = np.deg2rad(0.2) ** 2 * np.tile(np.eye(2), (n, 1, 1))
    return replace(
        loads, vehicle=VEHICLE, force_noise_sd_mps2=0.01, force_root_mps2=force_root, flow_cov=flow_cov,
        wind_flow_sd_rad=np.full(n, np.deg2rad(0.1)), angular_acceleration_sd_radps2=0.02,
        dynamic_pressure_sd_pa=0.03 * loads.dynamic_pressure_pa,
    )  # fmt: skip


def slope(k, size):
    """Increments (4, k) of which one grows along Mach number."""
    out = np.zeros((4, len(PROCESSES.log_mach)))
    out[k] = size * SD[k] * np.linspace(-1.0, 1.0, out.shape[1])
    return out


def found_of(loads):
    reader = loads_reader(loads, METHODS, [])
    found = estimate_increments(reader, fuse(reader)[1])
    return found, np.sqrt(np.diag(found.covariance)).reshape(4, -1)


def test_of_the_table_as_it_is_nothing_is_found():
    found, sd = found_of(flown())
    # of exact data what is left is what the methods' equations leave out
    assert np.abs(found.mean / sd).max() < 0.7
    assert np.sqrt(np.mean((found.mean / sd) ** 2)) < 0.2
    assert (sd <= SD[:, None] * (1.0 + 1e-9)).all()


# of C_A and density each has its share of what the axial force says; C_N hides behind the deflection
@pytest.mark.parametrize(("k", "least"), [(0, 0.2), (2, 0.8), (3, 0.2)])
def test_an_error_of_the_table_s_shape_is_found(k, least):
    """A factor cannot follow it; what is found lies within its sd, and is most of the error where that is small."""
    found, sd = found_of(flown(k, 1.0))
    true = PROCESSES.at(found.mach, slope(k, 1.0))
    assert np.abs((found.mean - true) / sd).max() < 2.0
    grows = np.polyfit(np.log(found.mach), found.mean[k], 1)[0] / np.polyfit(np.log(found.mach), true[k], 1)[0]
    assert least < grows < 1.1


def test_what_the_axial_force_says_of_c_a_is_shared_with_density():
    """With the density known the mass is what is left; of a density that is not known C_A stays as it was."""
    loads, sds = flown(), []
    for part in (0.0005, 0.2):
        found, _ = found_of(replace(loads, dynamic_pressure_sd_pa=part * loads.dynamic_pressure_pa))
        knots = len(found.mach)
        mean = np.zeros(4 * knots)
        mean[:knots] = 1.0 / knots
        sds.append(float(np.sqrt(mean @ found.covariance @ mean)))
    bodies = np.array([VEHICLE.aeroshell.mass_kg, VEHICLE.centerbody.mass_kg])
    mass_part = VEHICLE.uncertainty.mass * np.linalg.norm(bodies) / VEHICLE.mass_kg
    assert sds[0] == pytest.approx(mass_part, rel=0.3)
    prior = PROCESSES.roots()[0].mean(axis=0)
    assert 0.85 < sds[1] / np.linalg.norm(prior) < 1.0


def test_what_is_stated_to_be_known_stays():
    known = VEHICLE.uncertainty.model_copy(update={"cm": 0.0})
    loads = flown()
    found, _ = found_of(replace(loads, vehicle=replace(VEHICLE, uncertainty=known)))
    assert np.abs(found.mean[COEFFICIENTS.index("C_m")]).max() < 1e-4


def test_a_sample_whose_force_points_forward_says_nothing_along_the_axis():
    pulse = flown()
    n = len(pulse.time_s)
    want, response = np.ones(n), np.ones((n, 1, 1))
    want[100], response[100] = np.nan, np.nan
    one = increments._AxialReading(csr_array((n, 2)), {"C_A": response}, want, np.ones(n), np.zeros(n))
    rows = increments._axial_rows(one, one.by_input, {"C_A": slice(0, 1)}, {}, pulse)
    np.testing.assert_allclose(rows.by_input[:, 0], rows.want)  # both over the same sd
    counts = np.round(rows.want**2).astype(int)  # the sum of so many samples of unit variance
    assert counts.sum() == n - 1


def test_means_over_windows_are_taken_back():
    """Force, rate and angular acceleration as their windows have them give the increments of the instants."""
    loads, h = flown(), 0.05
    t = loads.time_s
    rate, force = (CubicSpline(t, v) for v in (loads.rate_body_radps, loads.specific_force_body_mps2))
    spread = h * np.linspace(-1.0, 1.0, 41)

    def mean(of, at):
        return np.mean([of(np.clip(at + s, t[0], t[-1])) for s in spread], axis=0)

    inner = (t > t[0] + 0.2) & (t < t[-1] - 0.2)
    turn = (mean(rate, t + h) - mean(rate, t - h)) / (2.0 * h)
    means = {"rate_body_radps": mean(rate, t), "specific_force_body_mps2": mean(force, t)}
    windows = replace(loads, **means, angular_acceleration_body_radps2=turn).rows(inner)
    want, sd = found_of(loads.rows(inner))
    without, with_them = (found_of(replace(windows, half_window_s=width))[0] for width in (0.0, h))
    off, left = (np.abs((one.mean - want.mean) / sd)[2] for one in (without, with_them))
    assert np.sqrt(np.mean(off**2)) > 0.3
    assert np.sqrt(np.mean(left**2)) < 0.3 * np.sqrt(np.mean(off**2))


def test_a_constant_between_the_knots_is_a_constant():
    weights = PROCESSES.weights(MACH)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(weights @ PROCESSES.log_mach, np.log(MACH), atol=1e-9)

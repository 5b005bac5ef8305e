"""The model of the as-flown air against forces that it did not make itself: the simulator's, of a rigid vehicle."""

from dataclasses import replace

import numpy as np

from flightmodel import earth, rotations
from flightmodel.airdata import air_data
from flightmodel.atmosphere import standard_atmosphere
from recon import atmosphere
from synthetic_flight.simulate import fly
from tests.estimators.test_closure import EPOCH, START_S, VEHICLE, start

DRAG = atmosphere.Drag(
    VEHICLE.aero, VEHICLE.reference.area_m2 / VEHICLE.mass_kg, 0.03, 0.07, VEHICLE.reference.length_m, 0.02
)  # fmt: skip


def windy():
    calm = standard_atmosphere()
    return replace(calm, wind_ned_mps=np.tile([14.0, -25.0, 0.0], (len(calm.altitude_m), 1)))


def true_samples(error_root=0.0):
    state = start(6.0, [0.1, -0.15], [0.03, -0.04], [0.0, 0.0])
    truth = fly(VEHICLE, windy(), state, START_S, START_S + 2.0, EPOCH, 0.002, 0.02, START_S + 9.0)
    path, cg = truth.trajectory, VEHICLE.cg_m
    seen = air_data(path, windy(), cg)
    ned = earth.dcm_ned_ecef(seen.latitude_rad, seen.longitude_rad)
    dcm = ned @ rotations.dcm_from_q(path.q_ecef_body)
    spin = path.omega_body_eci_body_radps - earth.OMEGA_RADPS * rotations.dcm_from_q(path.q_ecef_body)[:, 2]
    velocity = path.velocity_ecef_mps + rotations.rotate(path.q_ecef_body, np.cross(spin, cg))
    n = len(path.time_s)
    return atmosphere.AirSamples(
        path.time_s, seen.altitude_m, np.einsum("nij,nj->ni", ned, velocity), dcm, truth.specific_force_body(cg),
        np.tile(error_root * np.eye(6), (n, 1, 1)), np.zeros((n, 3, 12)),
    )  # fmt: skip


def forces(samples, x):
    return atmosphere._Model(samples, windy(), DRAG).forces(np.tile(x, (len(samples.time_s), 1)))[0]


def test_forces_are_those_that_the_simulator_s_vehicle_feels():
    samples = true_samples()
    got, felt = forces(samples, np.zeros(atmosphere._UNKNOWNS)), samples.specific_force_body_mps2
    np.testing.assert_allclose(got[:, 0], felt[:, 0], rtol=1e-3)
    # across: the simulator takes the flow at the nose, half a metre ahead, where turning by 0.3 rad/s moves it by
    # 0.15 m/s of 1050; pitch damping makes no force
    assert np.abs(felt[:, 1:]).max() > 0.2
    np.testing.assert_allclose(got[:, 1:], felt[:, 1:], atol=0.03 * np.abs(felt[:, 1:]).max())


def test_a_trajectory_s_errors_are_taken_off_it():
    # a trajectory whose velocity is off by e (and attitude by a turn d of the body) with these errors stated is the
    # true one without
    samples = true_samples(error_root=1.0)
    e, d = np.array([3.0, -5.0, 2.0]), np.array([0.004, -0.006, 0.003])
    x = np.zeros(atmosphere._UNKNOWNS)
    x[11:14], x[14:17] = e, d
    # NED axes: an estimated body that is turned by d against the true one
    turn = rotations.dcm_from_q(rotations.exp(d))
    wrong = replace(samples, velocity_ned_mps=samples.velocity_ned_mps + e, dcm_ned_body=turn @ samples.dcm_ned_body)
    nothing = np.zeros(atmosphere._UNKNOWNS)
    want, got = forces(samples, nothing), forces(wrong, x)
    without = forces(wrong, nothing)
    # second order of 0.008 rad is left of what the errors do
    assert np.abs(got - want).max() < 0.03 * np.abs(without - want).max()
    assert np.abs(without - want)[:, 1:].max() > 0.05


def test_structure_between_knots_keeps_a_wind_from_being_known_better():
    # data without end: what a mean over a knot cannot tell of a wind that forgets over 3 km stays in its sd
    samples = true_samples()
    model = atmosphere._Model(samples, windy(), DRAG)
    height = atmosphere._knots(samples.altitude_m, atmosphere._KNOT_M)
    k = len(height)
    table = atmosphere._profile(model, height, np.zeros(3 * k), np.full(3 * k, 1e-6))
    # half of the variance forgets: about a knot, between neighbours a km apart, a third of its first-order loss
    left = np.sqrt(0.5 * 1000.0 / (3.0 * 3000.0))
    np.testing.assert_allclose(table.wind_north_sd_mps / table.wind_prior_sd_mps, left, rtol=1e-3)


def test_tilted_shell_pushes_along_its_own_axes():
    # exactly: C_A against the shell's axis, C_N across it in the plane of the flow. A shell that adds (b, c) to the
    # flow's lateral angles has its axis turned by (-b, -c)
    tilt, flow = np.deg2rad([4.0, -2.0]), np.deg2rad([5.0, 7.0])
    u = 1000.0 * np.array([np.cos(np.hypot(*flow)), *(np.sin(np.hypot(*flow)) * flow / np.hypot(*flow))])
    size = np.hypot(*tilt)
    axis = np.array([np.cos(size), *(-np.sin(size) * tilt / size)])
    alpha = np.arccos(u @ axis / 1000.0)
    across = u - (u @ axis) * axis
    samples = atmosphere.AirSamples(
        np.zeros(1), np.array([50e3]), u[None] + [14.0, -25.0, 0.0], np.eye(3)[None], np.zeros((1, 3)),
        np.zeros((1, 6, 6)), np.zeros((1, 3, 12)),
    )  # fmt: skip
    x = np.zeros((1, atmosphere._UNKNOWNS))
    x[:, 9:11] = tilt
    got, q, mach = atmosphere._Model(samples, windy(), DRAG).forces(x)
    ca, cn = DRAG.table.at(mach, alpha)[0, :2]
    want = -q[0] * DRAG.area_per_mass_m2pkg * (ca * axis + cn * across / np.linalg.norm(across))
    assert abs(got[0, 0] / want[0] - 1.0) < 3e-4
    # without both terms of second order it would be off by more than ten times that
    assert abs(-q[0] * DRAG.area_per_mass_m2pkg * ca / want[0] - 1.0) > 2e-3
    np.testing.assert_allclose(got[0, 1:], want[1:], atol=3e-3 * abs(want[0]))

from dataclasses import replace

import numpy as np
import pytest

from estimators.evidence import VEHICLE_INPUTS, moved_vehicle
from estimators.trim import (
    estimate_trim,
    moment_term,
    solve_trim,
    trim_evidence,
    trim_model,
)
from tests.oracles.paper_forms import deflection_for_trim_angle, trim_angle_for_deflection

from .conftest import VEHICLE, pulse_of

MODEL = trim_model(VEHICLE)


def test_both_ways_are_inverse_for_joint_at_torus_and_nose():
    for station in (None, 0.0):
        model = trim_model(VEHICLE, station)
        for theta_deg in (0.0, 1.3, 3.75, 6.0):
            alpha = trim_angle_for_deflection(model, 3.2, np.deg2rad(theta_deg))
            assert np.rad2deg(deflection_for_trim_angle(model, 3.2, alpha)) == pytest.approx(theta_deg, abs=5e-3)


def test_the_paper_s_pair():
    # "a deflection of 3.75 deg is required for an aeroshell trim angle of attack of 5 deg": the reference vehicle's
    # static stability was set so that this holds about peak pressure (Mach 3.2)
    assert np.rad2deg(deflection_for_trim_angle(MODEL, 3.2, np.deg2rad(5.0))) == pytest.approx(3.75, rel=0.05)


def test_joint_at_the_nose_needs_less_deflection():
    # a longer arm from the joint to the centerbody's c.g. shifts the c.g. more per degree
    at_nose, at_torus = (deflection_for_trim_angle(trim_model(VEHICLE, s), 3.2, np.deg2rad(5.0)) for s in (0.0, 0.2))
    assert at_nose / at_torus == pytest.approx(0.32 / 0.52, rel=1e-3)


def test_moment_about_the_cg_vanishes_as_a_cross_product():
    # eq. [6] against forces and arms: nose moment + (nose - cg) x F has no transverse part
    theta_yz = np.array([0.03, -0.05])
    z = MODEL.offset_yz_m + MODEL.xbar_m * theta_yz
    mach = np.array([3.1])
    flow = theta_yz + 0.05 * z / np.linalg.norm(z)
    got = solve_trim(MODEL, mach, flow[None], np.zeros((1, 2)))[0]
    alpha_yz = flow - got
    alpha = np.linalg.norm(alpha_yz)
    n = np.array([0.0, *alpha_yz / alpha])
    ca, cn, cm, _ = MODEL.aero.at(3.1, alpha)
    x_hat = np.array([1.0, 0.0, 0.0])
    cg = np.array([-MODEL.x_cg_m, *(MODEL.offset_yz_m + MODEL.xbar_m * got)])
    moment = MODEL.length_m * cm * np.cross(n, x_hat) + np.cross(-cg, -(ca * x_hat + cn * n))
    np.testing.assert_allclose(moment[1:], 0.0, atol=1e-5)  # table knots of 0.25 deg: (0.25 deg)^2/8 of curvature


@pytest.mark.parametrize("seed", range(4))
def test_recovers_any_plane_from_ideal_data(seed):
    loads, truth = pulse_of(np.random.default_rng(seed), n=40)
    for dynamic in (False, True):
        np.testing.assert_allclose(trim_evidence(loads, dynamic=dynamic).theta_yz_rad, truth, atol=2e-4)


def test_measured_moment_moves_the_balance_by_its_offset():
    loads, truth = pulse_of(np.random.default_rng(5), n=20)
    turn = np.array([0.0, 0.4, -0.7])
    turning = replace(loads, angular_acceleration_body_radps2=np.tile(turn, (20, 1)))
    u = moment_term(MODEL, turning, loads.informative, True)
    moment = MODEL.inertia_kgm2 @ turn
    ca = MODEL.aero.at(loads.mach, np.linalg.norm(loads.flow_yz_rad, axis=1))[:, 0]
    pressure = loads.dynamic_pressure_pa * MODEL.area_m2 * ca
    # a lateral force offset u times the axial force is the moment: u x x_hat
    want = np.cross(np.column_stack([np.zeros(20), u]), [1.0, 0.0, 0.0]) * pressure[:, None]
    np.testing.assert_allclose(want[:, 1:], np.broadcast_to(moment[1:], (20, 2)), rtol=1e-12)
    ignored = trim_evidence(turning, dynamic=False).theta_yz_rad
    seen = trim_evidence(turning).theta_yz_rad
    np.testing.assert_allclose(ignored, truth, atol=2e-4)
    assert np.abs(seen - truth).max() > 1e-3


def test_sd_equals_a_monte_carlo_over_the_vehicle():
    rng = np.random.default_rng(6)
    one, _ = pulse_of(rng, n=1)
    nominal = estimate_trim(one, dynamic=False)
    got = []
    root = np.linalg.cholesky(one.flow_cov[0])
    for _ in range(600):
        moved = {name: rng.normal() for name in VEHICLE_INPUTS}
        flow = one.flow_yz_rad + root @ rng.normal(size=2)
        got.append(solve_trim(trim_model(moved_vehicle(VEHICLE, moved)), one.mach, flow, np.zeros((1, 2)))[0])
    sampled = np.cov(np.array(got).T)
    d = nominal.theta_yz_rad[0] / nominal.theta_rad[0]
    assert nominal.theta_sd_rad[0] == pytest.approx(np.sqrt(d @ sampled @ d), rel=0.10)
    # the curvature by C_m shifts the mean: 600 draws know it to sd/24
    shift = (np.mean(got, axis=0) - nominal.theta_yz_rad[0]) @ d
    assert abs(shift) < 3.0 * nominal.theta_sd_rad[0] / np.sqrt(600)


def test_no_answer_beyond_30_deg():
    assert np.isnan(trim_angle_for_deflection(MODEL, 3.2, np.deg2rad(60.0)))
    flow = np.array([[np.deg2rad(80.0), 0.0]])
    assert np.isnan(solve_trim(MODEL, np.array([3.2]), flow, np.zeros((1, 2)))).all()

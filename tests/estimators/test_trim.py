from dataclasses import replace

import numpy as np
import pytest

from estimators.balance import moment_residual
from estimators.evidence import VEHICLE_INPUTS, held_balance, moved_vehicle
from estimators.misalignment import estimate_misalignment
from estimators.trim import (
    estimate_trim,
    moment_term,
    solve_trim,
    trim_curvature,
    trim_evidence,
    trim_model,
)
from tests.oracles.paper_forms import deflection_for_trim_angle, trim_angle_for_deflection

from .conftest import VEHICLE, pulse_of

MODEL = trim_model(VEHICLE)


def with_joint(station_m):
    return replace(VEHICLE, joint=VEHICLE.joint.model_copy(update={"station_m": station_m}))


def test_both_ways_are_inverse_for_joint_at_torus_and_nose():
    for station in (VEHICLE.joint.station_m, 0.0):
        model = trim_model(with_joint(station))
        for theta_deg in (0.0, 1.3, 3.75, 6.0):
            alpha = trim_angle_for_deflection(model, 3.2, np.deg2rad(theta_deg))
            assert np.rad2deg(deflection_for_trim_angle(model, 3.2, alpha)) == pytest.approx(theta_deg, abs=5e-3)


def test_the_paper_s_pair():
    # "a deflection of 3.75 deg is required for an aeroshell trim angle of attack of 5 deg": the reference vehicle's
    # static stability was set so that this holds about peak pressure (Mach 3.2)
    assert np.rad2deg(deflection_for_trim_angle(MODEL, 3.2, np.deg2rad(5.0))) == pytest.approx(3.75, rel=0.05)


def test_joint_at_the_nose_needs_less_deflection():
    # a longer arm from the joint to the centerbody's c.g. shifts the c.g. more per degree
    at_nose, at_torus = (deflection_for_trim_angle(trim_model(with_joint(s)), 3.2, np.deg2rad(5.0)) for s in (0.0, 0.2))
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
    np.testing.assert_allclose(trim_evidence(loads).theta_yz_rad, truth, atol=1e-7)


@pytest.mark.parametrize("estimate", [estimate_trim, estimate_misalignment])
def test_deflections_of_up_to_30_deg_are_read_as_they_are(estimate):
    # twice the static stability keeps the shell's own angle below trim's 30 deg
    rng, stable = np.random.default_rng(12), replace(VEHICLE, aero=VEHICLE.aero.scaled(cm=2.0))
    clock, size = rng.uniform(0.0, 2.0 * np.pi, 60), np.deg2rad(np.linspace(0.5, 30.0, 60))
    truth = size[:, None] * np.column_stack([np.cos(clock), np.sin(clock)])
    loads = replace(pulse_of(rng, 60, truth, stable)[0], vehicle=stable)
    got = estimate(loads)
    mean = trim_curvature(loads) if estimate is estimate_trim else 0.0
    known = np.isfinite(got.theta_rad)
    assert known.mean() > 0.9
    np.testing.assert_allclose((got.theta_yz_rad - mean)[known], truth[known], atol=np.deg2rad(0.001))


def test_measured_moment_moves_the_balance_by_its_offset():
    loads, truth = pulse_of(np.random.default_rng(5), n=20)
    turn = np.array([0.0, 0.4, -0.7])
    turning = replace(loads, angular_acceleration_body_radps2=np.tile(turn, (20, 1)))
    u = moment_term(MODEL, turning)
    moment = MODEL.inertia_kgm2 @ turn
    ca = MODEL.aero.at(loads.mach, np.linalg.norm(loads.flow_yz_rad, axis=1))[:, 0]
    pressure = loads.dynamic_pressure_pa * MODEL.area_m2 * ca
    # a lateral force offset u times the axial force is the moment: u x x_hat
    want = np.cross(np.column_stack([np.zeros(20), u]), [1.0, 0.0, 0.0]) * pressure[:, None]
    np.testing.assert_allclose(want[:, 1:], np.broadcast_to(moment[1:], (20, 2)), rtol=1e-12)
    # the balance without small angles sees it as well, of the deflected vehicle's inertia: within some percent
    seen = trim_evidence(turning).theta_yz_rad - truth
    model = solve_trim(MODEL, loads.mach, loads.flow_yz_rad, u) - solve_trim(
        MODEL, loads.mach, loads.flow_yz_rad, np.zeros((20, 2))
    )
    assert np.abs(model).max() > 1e-3
    np.testing.assert_allclose(seen, model, atol=0.05 * np.abs(model).max())


def test_sd_equals_a_monte_carlo_over_the_vehicle():
    rng = np.random.default_rng(6)
    one, _ = pulse_of(rng, n=1)
    nominal = estimate_trim(one)
    got = []
    root = np.linalg.cholesky(one.flow_cov[0])
    pressure_sd = float(one.dynamic_pressure_sd_pa[0] / one.dynamic_pressure_pa[0])
    start = solve_trim(MODEL, one.mach, one.flow_yz_rad, np.zeros((1, 2)))
    for _ in range(300):
        vehicle = moved_vehicle(VEHICLE, {name: rng.normal() for name in VEHICLE_INPUTS})
        flow = one.flow_yz_rad + root @ rng.normal(size=2)
        pressure = one.dynamic_pressure_pa * (1.0 + pressure_sd * rng.normal())
        moved = replace(one, vehicle=vehicle, flow_yz_rad=flow, dynamic_pressure_pa=pressure)
        got.append(held_balance(moment_residual, moved, start).theta_yz_rad[0])
    sampled = np.cov(np.array(got).T)
    d = nominal.theta_yz_rad[0] / nominal.theta_rad[0]
    # 300 draws know an sd to 4 %
    assert nominal.theta_sd_rad[0] == pytest.approx(np.sqrt(d @ sampled @ d), rel=0.13)
    # the curvature by C_m shifts the mean: 300 draws know it to sd/17
    shift = (np.mean(got, axis=0) - nominal.theta_yz_rad[0]) @ d
    assert abs(shift) < 3.0 * nominal.theta_sd_rad[0] / np.sqrt(300)


def test_no_answer_beyond_30_deg():
    assert np.isnan(trim_angle_for_deflection(MODEL, 3.2, np.deg2rad(60.0)))
    flow = np.array([[np.deg2rad(80.0), 0.0]])
    assert np.isnan(solve_trim(MODEL, np.array([3.2]), flow, np.zeros((1, 2)))).all()

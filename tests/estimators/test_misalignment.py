from dataclasses import replace

import numpy as np
import pytest

from estimators.misalignment import (
    aerodynamic_angle,
    aeroshell_acceleration,
    estimate_misalignment,
    force_tilt,
    psi_from_acceleration,
    solve_deflection,
)
from flightmodel import rotations
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from tests.oracles.paper_forms import deflection_along_acceleration
from tests.refusing import numbers_in

from .conftest import AERO, pulse_of


def test_eq_4_vector():
    a = np.array([-80.0, 3.0, -4.0])
    psi = psi_from_acceleration(a)
    assert np.rad2deg(psi) == pytest.approx(-143.13, abs=0.005)
    turned = aeroshell_acceleration(a, np.deg2rad(3.5), psi)
    np.testing.assert_allclose(turned, [-80.156, 0.0641, -0.0854], atol=6e-4)
    assert np.hypot(*turned[1:]) == pytest.approx(0.1068, abs=1e-4)
    # the sign in the paper's text makes the normal acceleration grow
    wrong = aeroshell_acceleration(a, np.deg2rad(3.5), np.arctan2(a[1], a[2]))
    np.testing.assert_allclose(wrong, [-79.936, 5.932, -0.091], atol=1e-3)


def test_eq_4_is_the_rotation_of_the_deflection_history():
    # psi along a_N and theta > 0 is a deflection in the plane opposite a_N: one sign convention throughout
    rng = np.random.default_rng(0)
    for _ in range(20):
        a = np.array([-80.0, *rng.normal(size=2) * 4])
        theta, plane = rng.uniform(0.0, 0.1), lv_clock(-a[1:])
        q_body_shell = rotations.exp(rotation_vector_body_shell(np.array(theta), plane))
        want = rotations.rotate(rotations.conjugate(q_body_shell), a)
        np.testing.assert_allclose(aeroshell_acceleration(a, theta, psi_from_acceleration(a)), want, atol=1e-12)


def test_closed_form_in_one_plane():
    # theta = atan(r) - atan(C_N/C_A (alpha_BET - theta))
    mach, theta, alpha = np.array([3.2]), np.deg2rad(3.6), np.deg2rad(5.3)
    d = np.array([[-0.6, 0.8]])
    tilt = d * (theta + np.arctan(AERO.ratio(mach, alpha)))[:, None]
    got = solve_deflection(AERO, mach, tilt, d * (alpha + theta))
    np.testing.assert_allclose(got, theta * d, atol=1e-12)


def test_paper_s_form_brings_both_angles_together():
    # after eq. [4]'s rotation by the answer, eq. [3]'s angle is the BET's less the answer: Figure 2.7's two curves
    rng = np.random.default_rng(7)
    mach = rng.uniform(2.6, 4.5, 12)
    alpha_shell, theta, side = (np.deg2rad(rng.uniform(*span, 12)) for span in ((1.0, 6.0), (0.5, 5.0), (0.0, 360.0)))
    tilt = theta + np.arctan(AERO.ratio(mach, alpha_shell))
    force = np.stack([-80.0 * np.cos(tilt), 80.0 * np.sin(tilt) * np.cos(side), 80.0 * np.sin(tilt) * np.sin(side)], -1)
    got = deflection_along_acceleration(AERO, mach, force, alpha_shell + theta)
    np.testing.assert_allclose(got, theta, atol=1e-9)
    turned = aeroshell_acceleration(force, got, psi_from_acceleration(force))
    np.testing.assert_allclose(aerodynamic_angle(AERO, mach, turned), alpha_shell, atol=1e-4)
    # in one plane the general form is the same
    lateral = -force[:, 1:] / np.linalg.norm(force[:, 1:], axis=1, keepdims=True)
    general = solve_deflection(AERO, mach, force_tilt(force), lateral * (alpha_shell + theta)[:, None])
    np.testing.assert_allclose(np.linalg.norm(general, axis=1), got, atol=1e-9)
    assert np.isnan(deflection_along_acceleration(AERO, mach[:1], -force[:1], alpha_shell[:1])).all()


@pytest.mark.parametrize("seed", range(4))
def test_recovers_any_plane_exactly_from_ideal_data(seed):
    rng = np.random.default_rng(seed)
    loads, truth = pulse_of(rng, n=40)
    history = estimate_misalignment(loads)
    np.testing.assert_allclose(history.theta_yz_rad, truth, atol=1e-7)


def test_no_answer_where_there_is_no_deceleration():
    loads, _ = pulse_of(np.random.default_rng(1), n=10)
    weak = replace(loads, specific_force_body_mps2=loads.specific_force_body_mps2 * 0.01)
    history = estimate_misalignment(weak)
    assert np.isnan(history.theta_rad).all()
    assert 0.3 in numbers_in(history.assumptions)


def test_sd_equals_a_monte_carlo():
    rng = np.random.default_rng(8)
    one, _ = pulse_of(rng, n=1)
    nominal = estimate_misalignment(one)
    draws = 600
    flow_root = np.linalg.cholesky(one.flow_cov[0])
    known = one.vehicle.uncertainty
    got = []
    for _ in range(draws):
        cn, ca = 1.0 + known.cn * rng.normal(), 1.0 + known.ca * rng.normal()
        force = one.specific_force_body_mps2 + one.force_root_mps2[0] @ rng.normal(size=9)
        tilt = force_tilt(force + one.force_noise_sd_mps2 * rng.normal(size=3))
        flow = one.flow_yz_rad + flow_root @ rng.normal(size=2)
        got.append(solve_deflection(AERO.scaled(cn=cn, ca=ca), one.mach, tilt, flow)[0])
    sampled = np.cov(np.array(got).T)
    d = nominal.theta_yz_rad[0] / nominal.theta_rad[0]
    # 600 draws: 3 % of a standard deviation, 3 sd
    assert nominal.theta_sd_rad[0] == pytest.approx(np.sqrt(d @ sampled @ d), rel=0.09)


def test_uncorrected_look_up_reads_far_too_high():
    # the "sharp contrast" of the seed paper's Figure 2.5
    rng = np.random.default_rng(3)
    loads, truth = pulse_of(rng, n=30)
    raw = aerodynamic_angle(AERO, loads.mach, loads.specific_force_body_mps2)
    bet = np.linalg.norm(loads.flow_yz_rad, axis=1)
    deflected = np.linalg.norm(truth, axis=1) > np.deg2rad(2.0)
    assert (raw[deflected & np.isfinite(raw)] > 1.5 * bet[deflected & np.isfinite(raw)]).mean() > 0.8
    assert np.isnan(aerodynamic_angle(AERO, np.array([3.0]), np.array([[1.0, 0.1, 0.0]]))).all()

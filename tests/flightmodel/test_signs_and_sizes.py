"""Signs, sizes and spreads that other packages lean on: by differences, by definition, by almanac."""

from dataclasses import replace
from types import SimpleNamespace

import erfa
import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.airdata import air_data, derived_with_sd, lateral_angles
from flightmodel.atmosphere import standard_atmosphere
from flightmodel.camera import one_to_one_half_angle_rad
from flightmodel.deflection import lv_direction, polar_from_lateral
from flightmodel.geomagnetism_and_sun import sun_direction_ecef
from flightmodel.instruments import dcm_body_from_sun_head
from flightmodel.refraction import site_radius_m
from flightmodel.sensor_tables import _winds
from flightmodel.trajectory import Trajectory, difference, resample
from tests.oracles.moved_point import move_point
from tests.oracles.plain_balance import left_jacobian
from tests.oracles.strapdown import gravitation_gradient


def test_left_jacobian_is_the_derivative_of_the_exponential():
    w, step = np.array([0.4, -0.7, 0.3]), 1e-6
    back = rotations.conjugate(rotations.exp(w))
    for j in range(3):
        e = step * np.eye(3)[j]
        up, down = (rotations.log(rotations.multiply(rotations.exp(w + side * e), back)) for side in (1.0, -1.0))
        np.testing.assert_allclose(left_jacobian(w)[:, j], (up - down) / (2.0 * step), atol=1e-8)


def test_gravity_gradient_is_the_change_of_gravitation():
    r = earth.ecef_from_geodetic(0.7, -1.1, 9e4)
    columns = [(earth.gravitation(r + d) - earth.gravitation(r - d)) / 200.0 for d in 100.0 * np.eye(3)]
    # the central term alone: J2 changes it by three times 1.5 J2
    size = earth.GM_M3PS2 / np.linalg.norm(r) ** 3
    np.testing.assert_allclose(gravitation_gradient(r), np.column_stack(columns), atol=0.01 * size)


def test_sound_is_as_fast_as_the_standard_prints():
    # US76, table I: 340.294 m/s at sea level, 295.07 at 11 km geopotential and up to 20 km
    sound = standard_atmosphere().at(np.array([0.0, 15e3])).sound_speed_mps
    np.testing.assert_allclose(sound, [340.294, 295.069], atol=2e-3)


def test_far_above_a_sounding_only_the_standard_is_known():
    profile = standard_atmosphere()
    air = profile.at(profile.altitude_m[-1] + np.array([0.0, profile.fade_m * np.log(2.0), 300e3]))
    half = 0.5 * (profile.density_sd[-1] + 0.15), 0.5 * (profile.wind_sd_mps[-1] + 20.0)
    np.testing.assert_allclose(air.density_sd, [profile.density_sd[-1], half[0], 0.15], rtol=1e-6)
    np.testing.assert_allclose(air.wind_sd_mps, [profile.wind_sd_mps[-1], half[1], 20.0], rtol=1e-6)


def test_a_wind_from_the_west_goes_east():
    columns = {"wind_speed": np.array([10.0, 5.0]), "wind_from": np.deg2rad([270.0, 0.0])}
    gate = SimpleNamespace(findings=[], faults=[])
    north, east = _winds(gate, SimpleNamespace(columns=columns), earth.WGS84)
    np.testing.assert_allclose(north, [0.0, -5.0], atol=1e-12)
    np.testing.assert_allclose(east, [10.0, 0.0], atol=1e-12)


def flight(omega_body, covariance=None, velocity_body=(900.0, 40.0, -70.0)):
    r = earth.ecef_from_geodetic(0.5, 0.2, 5e4)
    q = rotations.exp(np.array([0.3, -1.1, 0.6]))
    v = rotations.rotate(q, np.array(velocity_body))
    two = np.ones((2, 1))
    cov = None if covariance is None else np.tile(covariance, (2, 1, 1))
    return Trajectory(
        "2009-08-17T12:50:00Z", np.array([0.0, 1.0]), "datum", two * r, two * v, two * q, two * omega_body, cov
    )  # fmt: skip


def turning_with_the_earth():
    return rotations.rotate(rotations.conjugate(rotations.exp(np.array([0.3, -1.1, 0.6]))), earth.OMEGA_ECEF_RADPS)


def test_what_turns_with_the_earth_has_one_velocity_everywhere():
    path, arm = flight(turning_with_the_earth()), np.array([-200.0, 300.0, 100.0])
    air = air_data(path, standard_atmosphere(), arm)
    np.testing.assert_allclose(air.velocity_air_body_mps[0], [900.0, 40.0, -70.0], rtol=0.0, atol=1e-9)
    moved = move_point(path, "there", arm)
    np.testing.assert_allclose(moved.velocity_ecef_mps, path.velocity_ecef_mps, rtol=0.0, atol=1e-9)
    # and what turns faster by w has w x arm more
    faster = flight(turning_with_the_earth() + np.array([0.0, 0.0, 0.1]))
    air = air_data(faster, standard_atmosphere(), arm)
    want = np.array([900.0, 40.0, -70.0]) + np.cross([0.0, 0.0, 0.1], arm)
    np.testing.assert_allclose(air.velocity_air_body_mps[0], want, rtol=0.0, atol=1e-9)
    assert air.alpha_rad[0] == pytest.approx(np.arctan2(want[2], want[0]))
    assert air.beta_rad[0] == pytest.approx(np.arcsin(want[1] / np.linalg.norm(want)))


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_flow_and_pressure_are_those_of_moved_states(seed):
    # a covariance of one direction of velocity and attitude together: what it does by moving along it
    e = np.zeros(9)
    e[3:] = np.random.default_rng(seed).normal(size=6) * [0.4, 0.4, 0.4, 4e-4, 4e-4, 4e-4]
    calm = replace(standard_atmosphere(), wind_sd_mps=np.zeros(41), density_sd=np.zeros(41))
    path = flight(np.zeros(3), np.outer(e, e) + 1e-30 * np.eye(9), (900.0, 4.0, -7.0))
    air = air_data(path, calm, np.zeros(3))
    flows, pressures = [], []
    for side in (1.0, -1.0):
        q = rotations.boxplus(path.q_ecef_body[0], side * e[6:9])
        v = path.velocity_ecef_mps[0] + side * e[3:6]
        flows.append(lateral_angles(rotations.rotate(rotations.conjugate(q), v)))
        pressures.append(0.5 * air.air.density_kgpm3[0] * (v @ v))
    change = 0.5 * (flows[0] - flows[1])
    # to first order in the angle, here 9 mrad
    size = np.abs(change).max()
    np.testing.assert_allclose(air.lateral_flow_cov[0], np.outer(change, change), atol=0.02 * size**2)
    assert air.dynamic_pressure_sd_pa[0] == pytest.approx(0.5 * abs(pressures[0] - pressures[1]), rel=1e-3)


@pytest.mark.parametrize("met_m", [None, (0.0, 1e5)])
def test_dynamic_pressure_has_one_sd(met_m):
    """That of `air_data`, to first order, is that of the moved states of bet.csv: height and a level wind included."""
    root = np.random.default_rng(5).normal(size=(9, 9)) * np.repeat([60.0, 0.5, 1e-3], 3)[:, None]
    for velocity in ((900.0, 4.0, -7.0), (300.0, 250.0, -600.0)):
        path = flight(np.zeros(3), root @ root.T, velocity)
        n = len(standard_atmosphere().wind_sd_mps)
        air = replace(standard_atmosphere(), wind_sd_mps=np.full(n, 20.0), density_sd=np.zeros(n), met_m=met_m)
        _, sd = derived_with_sd(path, air, np.zeros(3))
        found = air_data(path, air, np.zeros(3)).dynamic_pressure_sd_pa
        np.testing.assert_allclose(found, sd["dynamic_pressure"], rtol=0.01)


def test_a_pinhole_folds_where_its_polynomial_turns():
    # x = r (1 + k1 r^2) grows up to r = 1/sqrt(-3 k1)
    k1 = -0.4
    got = one_to_one_half_angle_rad(np.array([k1, 0.0, 0.0, 0.0]), "pinhole")
    assert got == pytest.approx(np.arctan(1.0 / np.sqrt(-3.0 * k1)), abs=2e-3)


def test_site_s_sphere_has_the_ellipsoid_s_mean_curvature():
    # 1/R^2 is the product of meridian's and prime vertical's curvatures
    e2 = earth.FLATTENING * (2.0 - earth.FLATTENING)
    for latitude in (0.0, 0.7, 0.5 * np.pi):
        w2 = 1.0 - e2 * np.sin(latitude) ** 2
        meridian, vertical = earth.SEMI_MAJOR_M * (1.0 - e2) / w2**1.5, earth.SEMI_MAJOR_M / w2**0.5
        assert site_radius_m(latitude, 120.0) == pytest.approx(np.sqrt(meridian * vertical) + 120.0, abs=1e-6)


def test_a_plane_that_may_be_anything_has_the_variance_of_that():
    _, _, cov = polar_from_lateral(np.array([[1e-6, 0.0]]), np.array([1e-4 * np.eye(2)]))
    anything = np.linspace(-np.pi, np.pi, 100001)
    assert cov[0, 1, 1] == pytest.approx(np.mean(anything**2), rel=1e-3)


def test_a_sun_head_s_axes_are_right_handed_with_x_forward_and_z_outward():
    for clock in np.deg2rad([0.0, 75.0, 200.0]):
        dcm = dcm_body_from_sun_head(clock)
        assert np.linalg.det(dcm) == pytest.approx(1.0)
        np.testing.assert_allclose(dcm[:, 0], [1.0, 0.0, 0.0], atol=1e-15)
        np.testing.assert_allclose(dcm[:, 2], lv_direction(clock), atol=1e-15)


def test_the_sun_stands_where_the_almanac_has_it():
    # Meeus, "Astronomical Algorithms", example 25.b: 1992 October 13, 0 h TD, apparent right ascension 13 h 13 min
    # 30.749 s, declination -7 deg 47' 01.74"; aberration is 20.5" of it. TT - UTC was 59.184 s
    direction = sun_direction_ecef("1992-10-12T23:59:00.816Z", 0.0)[0]
    utc = erfa.dtf2d("UTC", 1992, 10, 12, 23, 59, 0.816)
    gast = erfa.gst06a(*utc, *erfa.taitt(*erfa.utctai(*utc)))
    right_ascension = np.mod(np.arctan2(direction[1], direction[0]) + gast, 2.0 * np.pi)
    arcsec = np.deg2rad(1.0 / 3600.0)
    assert right_ascension == pytest.approx(np.deg2rad(15.0 * (13 + 13 / 60 + 30.749 / 3600)), abs=1.0 * arcsec)
    assert np.arcsin(direction[2]) == pytest.approx(-np.deg2rad(7 + 47 / 60 + 1.74 / 3600), abs=1.0 * arcsec)


def test_covariance_between_records_is_the_nearer_one_s():
    path = flight(np.zeros(3), np.eye(9))
    path = replace(path, covariance=np.stack([np.eye(9), 5.0 * np.eye(9)]))
    np.testing.assert_allclose(resample(path, np.array([0.25])).covariance[0], 2.0 * np.eye(9))


def test_error_is_estimate_minus_truth_in_every_coordinate():
    truth = flight(np.zeros(3))
    e = np.array([3.0, -4.0, 5.0, 0.1, 0.2, -0.3, 1e-3, -2e-3, 3e-3])
    estimate = replace(
        truth,
        position_ecef_m=truth.position_ecef_m + e[:3],
        velocity_ecef_mps=truth.velocity_ecef_mps + e[3:6],
        q_ecef_body=rotations.boxplus(truth.q_ecef_body, np.tile(e[6:], (2, 1))),
    )
    np.testing.assert_allclose(difference(estimate, truth), np.tile(e, (2, 1)), atol=1e-8)

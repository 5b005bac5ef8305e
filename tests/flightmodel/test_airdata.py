from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.airdata import air_data, derived_with_sd, lateral_angles, pressure_pulse, total_angle
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.deflection import lv_clock
from flightmodel.events import find_peak
from flightmodel.trajectory import Trajectory

WIND = np.array([11.0, -37.0, 0.0])


def profile():
    z = np.array([0.0, 90e3])
    return AtmosphereProfile(z, np.zeros(2), np.zeros(2), np.tile(WIND, (2, 1)), np.full(2, 0.03), np.full(2, 4.0))


def trajectory(covariance=None, n=3):
    t = np.linspace(430.0, 430.2, n)
    lat, lon = -0.61, 2.3
    r0 = earth.ecef_from_geodetic(lat, lon, 45e3)
    v = earth.ecef_from_ned(np.array([210.0, -170.0, 960.0]), r0)
    axis = v / np.linalg.norm(v)
    side = np.cross(axis, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side)
    q = rotations.q_from_dcm(np.column_stack([axis, side, np.cross(axis, side)])[None])[0]
    q = rotations.boxplus(q, np.deg2rad([25.0, 6.0, -4.0]))
    rows = np.ones((n, 1))
    return Trajectory(
        "2009-08-17T12:52:00Z", t, "datum", r0 + (t - t[0])[:, None] * v, rows * v, rows * q,
        rows * np.array([0.63, 0.04, -0.09]), covariance,
    )  # fmt: skip


def test_flow_angles_have_one_definition():
    v = np.array([[900.0, 80.0, -140.0]])
    assert total_angle(v)[0] == pytest.approx(np.arctan(np.hypot(80, 140) / 900))
    np.testing.assert_allclose(np.linalg.norm(lateral_angles(v), axis=1), total_angle(v))
    assert lv_clock(lateral_angles(v))[0] == pytest.approx(lv_clock(v[:, 1:])[0])
    assert total_angle(np.array([[-5.0, 0.0, 0.0]]))[0] == pytest.approx(np.pi)


def test_wind_is_where_the_air_goes_and_the_earth_turns():
    path = trajectory()
    air = air_data(path, profile(), np.zeros(3))
    ground = earth.ned_from_ecef(path.velocity_ecef_mps, path.position_ecef_m)
    np.testing.assert_allclose(air.airspeed_mps, np.linalg.norm(ground - WIND, axis=1), rtol=1e-12)
    inertial = path.velocity_ecef_mps + np.cross(earth.OMEGA_ECEF_RADPS, path.position_ecef_m)
    in_body = rotations.rotate(rotations.conjugate(path.q_ecef_body), inertial)
    np.testing.assert_allclose(air.alpha_total_inertial_rad, total_angle(in_body), atol=1e-12)
    assert air.dynamic_pressure_pa[0] == pytest.approx(0.5 * air.air.density_kgpm3[0] * air.airspeed_mps[0] ** 2)


def test_point_that_meets_the_air_moves_with_the_rotation():
    arm = np.array([-0.5, 0.2, 0.1])
    path = trajectory()
    moved = (
        air_data(path, profile(), arm).velocity_air_body_mps
        - air_data(path, profile(), np.zeros(3)).velocity_air_body_mps
    )
    np.testing.assert_allclose(moved, np.cross(path.omega_body_eci_body_radps, arm), atol=2e-4)


@pytest.mark.filterwarnings("error")
def test_of_what_stands_still_in_still_air_angles_have_no_sd():
    path = trajectory(np.tile(np.eye(9), (3, 1, 1)))
    still = replace(path, velocity_ecef_mps=np.array([[0.0] * 3, [1.0] * 3, [1.0] * 3]))
    air = air_data(still, replace(profile(), wind_ned_mps=np.zeros((2, 3))), np.zeros(3))
    for sd in (air.alpha_total_wind_sd_rad, air.alpha_total_ground_sd_rad, air.dynamic_pressure_sd_pa, air.beta_rad):
        np.testing.assert_array_equal(np.isfinite(sd), [False, True, True])


def test_standard_deviations_equal_a_monte_carlo():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(9, 9)) * np.array([30.0] * 3 + [0.4] * 3 + [0.003] * 3)[:, None] * 0.4
    cov = root @ root.T
    path = trajectory(np.tile(cov, (3, 1, 1)))
    air = air_data(path, profile(), np.zeros(3))
    draws, flows, pressure = 4000, [], []
    noise = rng.multivariate_normal(np.zeros(9), cov, draws)
    wind = rng.normal(size=(draws, 2)) * 4.0
    for d, w in zip(noise, wind, strict=True):
        v = (
            path.velocity_ecef_mps[0]
            + d[3:6]
            - earth.ecef_from_ned(np.array([*(WIND[:2] + w), 0.0]), path.position_ecef_m[0])
        )
        q = rotations.boxplus(path.q_ecef_body[0], d[6:])
        body = rotations.rotate(rotations.conjugate(q), v)
        flows.append(lateral_angles(body[None])[0])
        pressure.append(body @ body)
    measured = np.cov(np.array(flows).T)
    # 4000 draws: 1 sd of a sample variance is 2.2 %; the horizontal wind is modelled as if it blew along any axis,
    # which a vehicle descending at 75 deg makes right to cos^2 of its incidence
    np.testing.assert_allclose(np.sqrt(np.diag(measured)), np.sqrt(np.diagonal(air.lateral_flow_cov[0])), rtol=0.09)


def test_standard_deviations_of_a_place_that_is_hardly_known_are_linear():
    # one sd below the trajectory there is neither air nor ground; small errors elsewhere keep theirs
    small = np.diag([300.0**2] * 3 + [0.4**2] * 3 + [0.001**2] * 3)
    wide = small.copy()
    wide[:3, :3] *= 200.0**2
    _, known = derived_with_sd(trajectory(np.tile(small, (3, 1, 1))), profile(), np.zeros(3))
    _, unknown = derived_with_sd(trajectory(np.tile(wide, (3, 1, 1))), profile(), np.zeros(3))
    np.testing.assert_allclose(unknown["altitude"], 200.0 * known["altitude"], rtol=0.01)
    np.testing.assert_allclose(unknown["speed_ground"], known["speed_ground"], rtol=0.01)


def test_peak_and_pulse():
    t = np.arange(0.0, 40.0, 0.5)
    q = 1200.0 * np.exp(-((t - 17.3) ** 2) / 40.0)
    at, value = find_peak(t, q)
    assert at == pytest.approx(17.3, abs=0.01)
    assert value == pytest.approx(1200.0, rel=1e-3)
    pulse = pressure_pulse(q + 300.0 * (t > 38.0))
    half = np.sqrt(40.0 * np.log(2.0))
    assert t[pulse][0] == pytest.approx(17.3 - half, abs=0.5)
    assert t[pulse][-1] == pytest.approx(17.3 + half, abs=0.5)

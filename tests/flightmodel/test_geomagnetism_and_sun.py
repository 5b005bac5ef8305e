"""Field and Sun against identities, published coefficients and a formula of the Astronomical Almanac."""

from datetime import UTC, datetime

import numpy as np
import pytest

from flightmodel import earth
from flightmodel.geomagnetism_and_sun import (
    is_sun_visible,
    magnetic_field_ecef_t,
    magnetic_field_ned_t,
    sun_direction_ecef,
)
from tests.refusing import refuses

T0 = "2009-08-17T12:52:00Z"
PAD = np.deg2rad([37.838, -75.483])


def test_field_over_wallops():
    """facts of the site: 49-51 uT (48.9 found at 100 km), inclination near 66 deg, declination near -11 deg."""
    north, east, down = magnetic_field_ned_t(*PAD, 100e3, T0)[0] * 1e6
    assert 48.5 < np.linalg.norm([north, east, down]) < 51.0
    assert np.rad2deg(np.arctan2(down, np.hypot(north, east))) == pytest.approx(66.0, abs=1.0)
    assert np.rad2deg(np.arctan2(east, north)) == pytest.approx(-11.0, abs=0.5)


def test_far_away_the_field_is_the_published_dipole():
    """IGRF 2010.0: g10 = -29496.57, g11 = -1586.42, h11 = 4944.26 nT; the quadrupole adds (a/r) of some per cent."""
    lat, lon = np.deg2rad([35.0, -70.0])
    height = 1000.0 * 6371.2e3
    r = earth.ecef_from_geodetic(lat, lon, height)
    moment = np.array([-1586.42, 4944.26, -29496.57]) * 1e-9
    n = r / np.linalg.norm(r)
    dipole = (6371.2e3 / np.linalg.norm(r)) ** 3 * (3.0 * n * (n @ moment) - moment)
    field = magnetic_field_ecef_t(r[None], "2010-01-01T00:00:00Z")[0]
    # quadrupole terms are up to 0.2 of the dipole's at the surface, 2e-4 of them here
    np.testing.assert_allclose(field, dipole, atol=5e-4 * np.linalg.norm(dipole))


def test_field_has_neither_sources_nor_currents():
    """Divergence and curl vanish in ECEF only if places and components are both turned rightly."""
    centre, h = earth.ecef_from_geodetic(*PAD, 150e3), 20e3
    gradient = np.empty((3, 3))
    for axis in range(3):
        step = h * np.eye(3)[axis]
        ahead, behind = (magnetic_field_ecef_t((centre + s)[None], T0)[0] for s in (step, -step))
        gradient[axis] = (ahead - behind) / (2.0 * h)
    # differences err by h^2 / 6 of the third derivative, some 60 B / r^3 against 3 B / r: 3e-5 of the gradient
    size = np.abs(gradient).max()
    assert abs(np.trace(gradient)) < 1e-4 * size
    assert np.abs(gradient - gradient.T).max() < 1e-4 * size


def test_interpolated_path_is_within_a_nanotesla():
    """A ballistic arc: steep, over the top and down again, with samples every 0.4 s."""
    t = np.linspace(-160.0, 160.0, 801)
    along = 350.0 * t
    position = earth.ecef_from_geodetic(PAD[0] - along / 6.4e6, PAD[1] + 1.2 * along / 6.4e6, 218e3 - 0.5 * 9.2 * t**2)
    exact = earth.ecef_from_ned(magnetic_field_ned_t(*earth.geodetic_from_ecef(position), T0), position)
    assert np.abs(magnetic_field_ecef_t(position, T0) - exact).max() < 0.2e-9
    coarse = magnetic_field_ecef_t(position, T0, spacing_m=50e3)
    assert np.abs(coarse - exact).max() > 1e-9  # the spacing matters: the test above can fail


def test_one_place_and_a_place_held():
    place = earth.ecef_from_geodetic(*PAD, 100e3)
    one = magnetic_field_ecef_t(place[None], T0)
    held = magnetic_field_ecef_t(np.repeat(place[None], 5, axis=0), T0)
    np.testing.assert_allclose(held, np.repeat(one, 5, axis=0), rtol=1e-12)


def test_dates_without_coefficients_are_refused():
    with refuses("value-range", names=["1900 to 2030"]):
        magnetic_field_ned_t(0.5, 0.5, 0.0, "2031-01-01T00:00:00Z")


def almanac_sun(stamp):
    """Low-precision Sun of the Astronomical Almanac (0.01 deg, 1950-2050) and mean sidereal time: ECEF unit vector."""
    days = (stamp - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400.0
    mean_longitude, anomaly = np.deg2rad([280.460 + 0.9856474 * days, 357.528 + 0.9856003 * days])
    longitude = mean_longitude + np.deg2rad(1.915) * np.sin(anomaly) + np.deg2rad(0.020) * np.sin(2 * anomaly)
    tilt = np.deg2rad(23.439 - 4e-7 * days)
    n = np.array([np.cos(longitude), np.cos(tilt) * np.sin(longitude), np.sin(tilt) * np.sin(longitude)])
    turn = np.deg2rad(280.46061837 + 360.98564736629 * days)
    return np.array([np.cos(turn) * n[0] + np.sin(turn) * n[1], -np.sin(turn) * n[0] + np.cos(turn) * n[1], n[2]])


@pytest.mark.parametrize("when", [T0, "1999-12-21T03:10:20Z", "2026-03-20T18:00:00Z", "2015-06-01T23:59:00Z"])
def test_sun_against_the_almanac_formula(when):
    stamp = datetime.fromisoformat(when.replace("Z", "+00:00"))
    # 0.01 deg of the formula; UT1 - UTC below 0.9 s is 0.004 deg
    assert np.rad2deg(np.arccos(sun_direction_ecef(when, 0.0)[0] @ almanac_sun(stamp))) < 0.016


def test_sun_over_the_pad_at_launch():
    north, east, down = earth.dcm_ned_ecef(*PAD) @ sun_direction_ecef(T0, 0.0)[0]
    # the site's sheet gives 28.9 and 95.5 deg, to 0.1
    assert np.rad2deg(np.arcsin(-down)) == pytest.approx(28.9, abs=0.1)
    assert np.rad2deg(np.arctan2(east, north)) == pytest.approx(95.5, abs=0.1)


def test_sun_between_knots_is_the_exact_one():
    t = np.linspace(300.0, 530.0, 2300)
    dense = sun_direction_ecef(T0, t)
    for k in (0, 37, 1111, 2299):
        # (15 deg/h * 10 s)^2 / 8 = 7e-8 rad
        assert np.linalg.norm(dense[k] - sun_direction_ecef(T0, t[k])[0]) < 1e-7
    # and it moves as the Earth turns: 15 deg an hour times the cosine of the declination (13.3 deg)
    moved = np.arccos(dense[0] @ dense[-1])
    assert moved == pytest.approx(230.0 * 7.2722e-5 * np.cos(np.deg2rad(13.3)), rel=2e-3)


@pytest.mark.parametrize("height_m", [1000.0, 20e3, 218e3])
def test_sun_sets_at_the_dip_of_the_horizon(height_m):
    place = earth.ecef_from_geodetic(*PAD, height_m)
    # the limb from a height over a sphere of the ellipsoid's own radius; bulge within the view moves it by 0.1 deg
    dip = np.arccos(6.37e6 / (6.37e6 + height_m))
    for azimuth in np.deg2rad([10.0, 100.0, 250.0]):
        for margin, lit in ((0.15, True), (-0.15, False)):
            el = -dip + np.deg2rad(margin)
            ned = np.array([np.cos(el) * np.cos(azimuth), np.cos(el) * np.sin(azimuth), -np.sin(el)])
            to_sun = earth.dcm_ned_ecef(*PAD).T @ ned
            assert is_sun_visible(place[None], to_sun[None])[0] == lit

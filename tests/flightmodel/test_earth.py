import json
from pathlib import Path

import numpy as np
import pytest

from flightmodel import _kernels, earth

VALUES = json.loads((Path(__file__).parents[1] / "data" / "geodesy_test_values.json").read_text())
# generic points: both hemispheres, far from axes and symmetry planes, below and above the atmosphere
PLACES = [(-0.93, 2.1, 44e3), (0.66, -1.31, 218e3), (0.17, 0.4, 10.0), (-1.45, -2.9, 9.0e5)]
GENERIC = [earth.ecef_from_geodetic(*place) for place in PLACES]


@pytest.mark.parametrize("position", GENERIC)
def test_gravitation_is_the_gradient_of_its_potential(position):
    step = 20.0
    gradient = np.array(
        [(earth.potential(position + step * e) - earth.potential(position - step * e)) / (2 * step) for e in np.eye(3)]
    )
    # central differences of a 6e7 m^2/s^2 potential: rounding 1e-16 * 6e7 / 20 m, truncation g (step/r)^2
    np.testing.assert_allclose(earth.gravitation(position), gradient, atol=2e-9)


@pytest.mark.parametrize("position", GENERIC)
def test_j2_term_is_alive_and_has_the_right_size(position):
    central = -earth.GM_M3PS2 * position / np.linalg.norm(position) ** 3
    relative = np.linalg.norm(earth.gravitation(position) - central) / np.linalg.norm(central)
    scale = earth.J2 * (earth.SEMI_MAJOR_M / np.linalg.norm(position)) ** 2
    assert 1.0 * scale < relative < 3.1 * scale


def test_normal_gravity_at_pole_and_equator():
    # WGS-84 normal gravity; J2 alone leaves the J4 term, 5 J4 = 8e-6 of g at the pole, and its square's share
    for lat, g in ((0.0, 9.7803253359), (np.pi / 2, 9.8321849378)):
        r = earth.ecef_from_geodetic(lat, 0.3, 0.0)
        omega = earth.OMEGA_ECEF_RADPS
        assert np.linalg.norm(earth.gravitation(r) - np.cross(omega, np.cross(omega, r))) == pytest.approx(
            g, abs=1.5e-4
        )


def test_geodetic_against_sofa():
    case = VALUES["sofa_gd2gc"]
    given = case["input"]
    np.testing.assert_allclose(
        earth.ecef_from_geodetic(given["lat_rad"], given["lon_rad"], given["h_m"]), case["WGS84_xyz_m"], atol=1e-7
    )
    case = VALUES["sofa_gc2gd"]
    lat, lon, h = earth.geodetic_from_ecef(np.array(case["input_xyz_m"]))
    want = case["WGS84"]
    assert float(lat) == pytest.approx(want["lat_rad"], abs=1e-12)
    assert float(lon) == pytest.approx(want["lon_rad"], abs=1e-14)
    assert float(h) == pytest.approx(want["h_m"], abs=1e-6)


def test_radar_against_matlab_mapping_toolbox():
    case = VALUES["pymap3d_matlab"]
    lat, lon, h = case["geodetic_deg_m"]
    az, el, slant = case["aer_deg_m"]
    site = (np.deg2rad(lat), np.deg2rad(lon), h)
    point = earth.ecef_from_radar(np.array([slant, np.deg2rad(az), np.deg2rad(el)]), *site)
    np.testing.assert_allclose(point, case["aer_point_ecef_m"], atol=0.01)
    back = earth.radar_from_ecef(np.array(case["aer_point_ecef_m"]), *site)
    np.testing.assert_allclose(back, [slant, np.deg2rad(az), np.deg2rad(el)], atol=2e-5)


@pytest.mark.parametrize(("place", "position"), list(zip(PLACES, GENERIC, strict=True)))
def test_kernels_against_the_readable_form_and_the_way_back(place, position):
    np.testing.assert_allclose(_kernels.gravitation(*position, earth.WGS84), earth.gravitation(position), rtol=1e-14)
    sin_lat, cos_lat, height, _ = _kernels.geodetic(*position, earth.WGS84)
    assert np.arctan2(sin_lat, cos_lat) == pytest.approx(place[0], abs=1e-7)
    assert np.hypot(sin_lat, cos_lat) == pytest.approx(1.0, abs=1e-13)
    assert height == pytest.approx(place[2], abs=1e-6)
    lat, lon, h = earth.geodetic_from_ecef(position)
    # the library's closed form is good to 2 mm at 900 km
    assert (float(lat), float(lon)) == pytest.approx(place[:2], abs=5e-10)
    assert float(h) == pytest.approx(place[2], abs=1e-5)


def test_eci_turns_with_the_earth():
    from flightmodel import rotations

    r_eci = np.array([4.1e6, -3.3e6, 2.9e6])
    later = rotations.rotate(earth.q_ecef_eci(1000.0), r_eci)
    assert np.arctan2(later[1], later[0]) - np.arctan2(r_eci[1], r_eci[0]) == pytest.approx(-1000 * earth.OMEGA_RADPS)
    assert later[2] == pytest.approx(r_eci[2])

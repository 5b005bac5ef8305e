"""Mars by outside authority: its gravity, turn, place and air; and what flight.toml may state of an entry there."""

import os
from pathlib import Path

import numpy as np
import pytest

from flightmodel import earth
from flightmodel.atmosphere import (
    default_sounding_sd,
    heat_ratio,
    standard_air,
    standard_sounding,
    temperature_sd,
)
from flightmodel.checks import GateError
from flightmodel.config import parse_section
from flightmodel.earth import MARS
from flightmodel.entry_state import StateEntry
from flightmodel.flightfolder import FlightFile

FIRST_LINES = {"name": "a", "t0_utc": "2012-08-06T05:10:00Z", "planet": "mars"}


def test_gravity_at_the_surface_is_the_published_one():
    """JPL Horizons' page of Mars: 3.71 m/s^2 at the equator, 3.758 at the pole."""
    equator, pole = np.array([MARS.semi_major_m, 0.0, 0.0]), earth.ecef_from_geodetic(0.5 * np.pi, 0.0, 0.0, MARS)
    turn = MARS.rate_radps**2 * MARS.semi_major_m
    assert np.linalg.norm(earth.gravitation(equator, MARS)) - turn == pytest.approx(3.71, abs=0.005)
    assert pole[2] == pytest.approx(3376200.0, abs=1.0)  # IAU: polar radius
    # the spheroid's flattening and J2 leave 0.01 between this and a polar 3.758 of the whole field
    assert np.linalg.norm(earth.gravitation(pole, MARS)) == pytest.approx(3.758, abs=0.05)
    assert 2.0 * np.pi / MARS.rate_radps == pytest.approx(24.622962 * 3600.0, abs=0.05)  # Horizons: sidereal period


def test_gravitation_is_the_gradient_of_the_potential():
    place, step = np.array([1.2e6, -2.6e6, 1.9e6]), 50.0
    moved = [earth.potential(place + h, MARS) - earth.potential(place - h, MARS) for h in step * np.eye(3)]
    np.testing.assert_allclose(np.array(moved) / (2.0 * step), earth.gravitation(place, MARS), rtol=1e-7)


def test_the_standard_air_is_vikings():
    """Viking 1 at its landing site: 7.3 mbar (Nier et al., Science 193 (1976) 786); five orders of magnitude less at
    100 km (Seiff, Adv. Space Res. 2 (1982) 3). The site lies 3.6 km below the areoid.
    """
    z = np.array([-3.6e3, 0.0, 100e3])
    density, temperature, pressure = standard_air(z, MARS)
    sd = standard_sounding(MARS).density_sd[0]
    assert abs(np.log(pressure[0] / 730.0)) < 2.0 * sd
    assert 4.5 < np.log10(pressure[1] / pressure[2]) < 5.5
    np.testing.assert_allclose(pressure, density * MARS.gas_jpkgk * temperature)


def test_the_density_errs_by_what_the_temperature_does_to_the_weight_of_the_air():
    """Temperatures alike over two scale heights: each such layer's errors add by their squares."""
    z = np.arange(0.0, 130e3, 100.0)
    temperature = standard_air(z, MARS)[1]
    scale = MARS.gas_jpkgk * temperature * 3.39e6**2 / MARS.gm_m3ps2
    part = (temperature_sd(z, MARS) / temperature / scale) ** 2 * 2.0 * scale
    expected = np.sqrt(0.12**2 + np.cumsum(part) * 100.0)
    stated = default_sounding_sd(z, MARS)[0]
    np.testing.assert_allclose(stated, expected, rtol=0.15)


def test_speed_of_sound_follows_the_heat_capacity_of_carbon_dioxide():
    """JANAF tables (Chase 1998), molar heat capacity of CO2 at 100, 200, 298.15, 400 K, J/(mol K); its mixture with
    N2 (7 R / 2) and argon (5 R / 2) as Viking's landers found it.
    """
    temperature = np.array([100.0, 200.0, 298.15, 400.0])
    capacity = 0.9549 * np.array([29.208, 32.359, 37.129, 41.325]) / 8.31446 + 0.0291 * 3.5 + 0.0160 * 2.5
    gamma = heat_ratio(np.zeros(4), temperature, MARS)
    np.testing.assert_allclose(gamma, capacity / (capacity - 1.0), rtol=5e-4)
    assert np.ptp(gamma) > 0.1


def test_air_is_in_hydrostatic_balance():
    z = np.linspace(-9e3, 140e3, 60)
    up, down = (standard_air(z + h, MARS)[2] for h in (200.0, -200.0))
    gravity = MARS.gm_m3ps2 / (3389.5e3 + z) ** 2
    np.testing.assert_allclose((down - up) / 400.0, standard_air(z, MARS)[0] * gravity, rtol=2e-3)


def entry(**changed):
    state = {
        "t_s": 10.0, "axes": "inertial", "radius_m": 3522.2e3, "latitude_deg": 22.6, "longitude_deg": 338.0,
        "speed_mps": 7264.2, "flight_path_deg": -14.06, "azimuth_deg": 253.1, "radius_sd_m": 1500.0,
        "latitude_sd_deg": 0.02, "longitude_sd_deg": 0.03, "speed_sd_mps": 0.7, "flight_path_sd_deg": 0.02,
        "azimuth_sd_deg": 0.03,
    }  # fmt: skip
    state |= changed
    return parse_section(StateEntry, {k: v for k, v in state.items() if v is not None}, "flight.toml")


def test_a_spherical_state_comes_back():
    prior = entry(t_sd_s=0.0).prior(FIRST_LINES["t0_utc"], MARS)
    r = prior.position_ecef_m
    v = prior.velocity_ecef_mps + np.cross(MARS.rate_ecef_radps, r)
    assert np.linalg.norm(r) == pytest.approx(3522.2e3)
    assert np.linalg.norm(v) == pytest.approx(7264.2)
    assert np.rad2deg(np.arcsin(r @ v / np.linalg.norm(r) / np.linalg.norm(v))) == pytest.approx(-14.06)
    assert np.sqrt(r @ prior.covariance[:3, :3] @ r) / np.linalg.norm(r) == pytest.approx(1500.0, rel=1e-4)


def test_what_the_time_may_err_moves_the_state_along_its_free_fall():
    """Jacobi's integral of the rotating planet stays as it is: the clock's part of the covariance, to first order."""
    sound, late = (entry(t_sd_s=t).prior(FIRST_LINES["t0_utc"], MARS) for t in (0.0, 3.0))
    added = late.covariance - sound.covariance
    r, v = late.position_ecef_m, late.velocity_ecef_mps
    moved = added[:, 0] / np.sqrt(added[0, 0]) * np.sign(v[0])
    np.testing.assert_allclose(added, np.outer(moved, moved), rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(moved[:3], 3.0 * v, rtol=1e-6)

    def jacobi(state):
        turned = np.cross(MARS.rate_ecef_radps, state[:3])
        return 0.5 * state[3:] @ state[3:] - earth.potential(state[:3], MARS) - 0.5 * turned @ turned

    step = 1e-4 * moved
    change = jacobi(np.concatenate([r, v]) + step) - jacobi(np.concatenate([r, v]) - step)
    assert abs(change) < 1e-3 * abs(2.0 * step[3:] @ v)


def test_a_covariance_of_the_state_says_the_same_as_its_sds():
    sds = [1500.0, 0.02, 0.03, 0.7, 0.02, 0.03]
    keys = (
        "radius_sd_m",
        "latitude_sd_deg",
        "longitude_sd_deg",
        "speed_sd_mps",
        "flight_path_sd_deg",
        "azimuth_sd_deg",
    )
    other = entry(covariance=np.diag(np.square(sds)).tolist(), **dict.fromkeys(keys))
    np.testing.assert_allclose(
        other.prior("2012-08-06T05:10:00Z", MARS).covariance, entry().prior("2012-08-06T05:10:00Z", MARS).covariance
    )


@pytest.mark.parametrize("changed", [{"radius_sd_m": None}, {"position_m": [1.0, 2.0, 3.0]}, {"axes": "j2000"}])
def test_half_a_state_is_refused(changed):
    with pytest.raises(GateError) as found:
        entry(**changed)
    assert {fault.code for fault in found.value.faults} == {"keys-conflict"}


REFUSED = {
    "sensors.magnetometer": {"sensors": {"magnetometer": {"file": "m.csv"}}},
    "sensors.sun": {"sensors": {"sun": {"file": "s.csv"}}},
    "barometers.b": {"barometers": {"b": {"file": "b.csv", "height_is": "msl"}}},
    "start.at_rest": {"start": {"at_rest": [0.0, 1.0]}},
}


@pytest.mark.parametrize("place", REFUSED)
def test_what_is_known_of_the_earth_alone_is_refused_by_name(place):
    on_mars = parse_section(FlightFile, FIRST_LINES | REFUSED[place], "flight.toml")
    on_earth = parse_section(FlightFile, FIRST_LINES | REFUSED[place] | {"planet": "earth"}, "flight.toml")
    named = [fault for fault in on_mars.misfits() if fault.code == "planet-unsupported"]
    assert any(place in fault for fault in named), named
    assert "planet-unsupported" not in {fault.code for fault in on_earth.misfits()}


def test_j2000_is_of_mars_alone():
    with pytest.raises(GateError) as found:
        earth.planet_from_j2000("2012-08-06T05:10:00Z", 0.0, earth.WGS84)
    assert found.value.faults[0].code == "planet-unsupported"


@pytest.mark.realdata
def test_a_recorded_entry_ends_above_its_landing_site():
    """Curiosity landed at 4.5895 S, 137.4417 E (planetocentric); the table ends 30 km or less before, 2012-08-06.

    The pole and prime meridian are right to far less: an error of a degree would be 59 km.
    """
    root = os.environ.get("POSTFLIGHT_REALDATA")
    if not root:
        pytest.skip("POSTFLIGHT_REALDATA is not set")
    table = np.loadtxt(Path(root) / "msl_entry" / "msl_position_j2000.csv", delimiter=",", skiprows=1)
    # the entry interface, 3522.2 km, was at 05:10:45.7 UTC at the spacecraft; the table begins 0.15 s into its time
    end = earth.planet_from_j2000("2012-08-06T05:10:45.7Z", table[-1, 0], MARS) @ table[-1, 1:]
    latitude, longitude = np.arcsin(end[2] / np.linalg.norm(end)), np.arctan2(end[1], end[0])
    assert np.rad2deg(latitude) == pytest.approx(-4.59, abs=0.5)
    assert np.rad2deg(longitude) == pytest.approx(137.44, abs=0.5)

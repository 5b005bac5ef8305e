"""Signs and sizes of what the simulator adds: gravity's difference over a lever, and factors on the air."""

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.atmosphere import standard_atmosphere
from synthetic_flight.dispersions import AirDispersions, Dispersions, Factor, dispersed_case
from synthetic_flight.scenarios import read_scenario
from synthetic_flight.simulate import fly, state_from_ecef


def test_an_accelerometer_above_the_cg_feels_the_tide(vehicle):
    # falling without turning, 400 km up: a point d farther out is held back by 2 GM d / r^3, felt inwards
    r = earth.ecef_from_geodetic(0.0, 0.3, 398e3)
    state = state_from_ecef(0.0, r, np.array([10.0, 0.0, 0.0]), rotations.exp(np.array([0.1, 0.2, 0.3])), np.zeros(3))
    state[14:20] = 0.0
    truth = fly(vehicle, standard_atmosphere(), state, 0.0, 0.02, "2009-08-17T12:50:00Z", 0.002, 0.01, 9.0)
    up = rotations.rotate(rotations.conjugate(truth.state_eci[0, 6:10]), state[:3] / np.linalg.norm(state[:3]))
    apart = 5000.0
    felt = truth.specific_force_body(vehicle.centerbody.cg_m + apart * up)[0]
    own = truth.specific_force_body(vehicle.centerbody.cg_m)[0]
    turn = truth.angular_acceleration_body_radps2[0]
    tide = felt - own - np.cross(turn, apart * up)
    size = 2.0 * earth.GM_M3PS2 * apart / np.linalg.norm(state[:3]) ** 3
    # to first order in the distance, and without J2
    np.testing.assert_allclose(tide, -size * up, atol=0.01 * size)


def test_a_factor_on_the_density_is_one():
    scenario = read_scenario("irve2_reference")
    plain = Dispersions(atmosphere=AirDispersions(day=False))
    thicker = Dispersions(atmosphere=AirDispersions(day=False, density=Factor(uniform=(0.0, 0.2))))
    z = np.array([5e3, 40e3, 90e3])
    base = dispersed_case(scenario, plain, {}).profile.at(z).density_kgpm3
    more = dispersed_case(scenario, thicker, {"atmosphere.density": 0.75}).profile.at(z).density_kgpm3
    assert more / base == pytest.approx(np.full(3, 1.15), rel=1e-12)

"""Temperatures of a sounding against the fall of its pressure: the standard atmosphere, drawn errors, wrong units."""

import numpy as np
import pytest

from flightmodel.atmosphere import R_AIR_JPKGK, us76
from flightmodel.sensor_tables import HYDROSTATIC_TOLERANCE, hydrostatic_error
from flightmodel.units import UNITS


def read_as(temperature_k, true, declared):
    """Temperatures written in one unit and read in another."""
    written = (temperature_k - UNITS[true].offset) / UNITS[true].factor
    return written * UNITS[declared].factor + UNITS[declared].offset


@pytest.mark.parametrize("top_m", [25e3, 40e3, 80e3, 120e3])
def test_the_standard_atmosphere_is_in_balance(top_m):
    z = np.arange(0.0, top_m + 1.0, 250.0)
    _, temperature, pressure = us76(z)
    assert abs(hydrostatic_error(z, pressure, temperature)) < 3e-3


@pytest.mark.parametrize("seed", range(40))
def test_densities_with_errors_of_2_percent_stay_in_balance(seed):
    z = np.arange(0.0, 40e3, 500.0)
    density, temperature, _ = us76(z)
    density = density * np.exp(0.02 * np.random.default_rng(seed).standard_normal(len(z)))
    error = hydrostatic_error(z, density * R_AIR_JPKGK * temperature, temperature)
    assert 0.0 < abs(error) < HYDROSTATIC_TOLERANCE


@pytest.mark.parametrize(
    ("true", "declared", "given", "sign"),
    [("degf", "degc", "density", 1), ("degr", "k", "density", 1), ("degr", "k", "pressure", 1),
     ("k", "degr", "density", -1)],
)  # fmt: skip
def test_a_wrong_unit_of_temperature_is_out_of_balance(true, declared, given, sign):
    """Fahrenheit for Celsius shows with densities alone: with pressures both scales cross in the middle."""
    z = np.arange(0.0, 40e3, 500.0)
    density, temperature, pressure = us76(z)
    wrong = read_as(temperature, true, declared)
    # the file holds densities, or `import` derives them from pressure and temperature
    found = density * R_AIR_JPKGK * wrong if given == "density" else pressure
    error = hydrostatic_error(z, found, wrong)
    assert sign * error > HYDROSTATIC_TOLERANCE


def test_little_height_says_nothing():
    z = np.linspace(0.0, 5e3, 40)
    _, temperature, pressure = us76(z)
    assert hydrostatic_error(z, pressure, 1.3 * temperature) == 0.0

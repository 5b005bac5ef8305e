"""What air the vehicle met: the US Standard Atmosphere 1976, the day's soundings blended into it, and winds.

To 86 km the standard's exact equations; above, its printed tables to 1000 km, interpolated by cubic splines of
log density and log pressure, and its temperature equations. A modelled profile of the day (NRLMSIS) is held as its
ratio to the standard, as a sounding is. Above 86 km the gas is the standard's own, of any density and temperature:
its gas constant is ``p / (rho T)`` of the printed tables, and gamma follows from the share of free atoms, each of which
lacks a molecule's two rotations. Speed of sound is the equilibrium one of the air ahead of the vehicle; what the shock
makes of the gas is in the vehicle's coefficients, not in Mach number or dynamic pressure.

Of Mars the standard is the model of the northern summer after Viking: temperatures to 100 km, and pressure from them by
hydrostatic equilibrium in the planet's own gravity. Above, its temperature is assumed to rise to 200 K at 150 km, as
Viking's entries found it to between 120 and 200 km (140 to 220 K), and to stay there. Its gas is mixed everywhere;
gamma follows the temperature by the vibrations of carbon dioxide, harmonic oscillators in equilibrium.

References
----------
NOAA/NASA/USAF, "U.S. Standard Atmosphere, 1976", NOAA-S/T 76-1562: tables I, VIII and section 1.2.
T. Owen et al., "The composition of the atmosphere at the surface of Mars", J. Geophys. Res. 82 (1977) 4635: mole
fractions, with which Seiff's molecular weight agrees.
T. Shimanouchi, "Tables of molecular vibrational frequencies", NSRDS-NBS 39 (1972): carbon dioxide's.
A. Seiff, "Post-Viking models for the structure of the summer atmosphere of Mars", Adv. Space Res. 2 (1982) 3.
A. Seiff, D. Kirk, "Structure of the atmosphere of Mars in summer at mid-latitudes", J. Geophys. Res. 82 (1977) 4364.
Emmert et al., "NRLMSIS 2.1", J. Geophys. Res. Space Phys. 127, 2022 (the table in ``data/atmosphere``).
D. C. Fritts, T. E. VanZandt, "Spectral estimates of gravity wave energy and momentum fluxes, part I", J. Atmos. Sci. 50
(1993) 3685: the waves' spectrum. D. C. Fritts, M. J. Alexander, "Gravity wave dynamics and effects in the middle
atmosphere", Rev. Geophys. 41 (2003) 1003: their vertical wavelengths. R. J. Sica, A. T. Russell, "How many waves are in
the gravity wave spectrum?", Geophys. Res. Lett. 26 (1999) 3617: a few carry most of it in the upper stratosphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flightmodel.checks import ConfigError, FloatArray, GateError, check_finite, check_increasing
from flightmodel.config import parse_utc
from flightmodel.earth import MARS, STANDARD_GRAVITY_MPS2, WGS84, Planet
from flightmodel.statistics import KNOTS_A_LENGTH, correlation, correlation_inverse, correlation_root, knots_root
from flightmodel.telemetry import Sounding

R_AIR_JPKGK = WGS84.gas_jpkgk
EARTH_RADIUS_US76_M = 6356766.0
_AIR_MOLECULE_KG = 28.9644e-3 / 6.022169e23
# geopotential base m, base temperature K, lapse K/m
_LAYERS = np.array(
    [
        [0.0, 288.15, -0.0065],
        [11000.0, 216.65, 0.0],
        [20000.0, 216.65, 0.001],
        [32000.0, 228.65, 0.0028],
        [47000.0, 270.65, 0.0],
        [51000.0, 270.65, -0.0028],
        [71000.0, 214.65, -0.002],
    ]
)
TABLES = Path(__file__).parent / "data" / "atmosphere"
_UPPER = np.loadtxt(TABLES / "us76_upper.csv", delimiter=",", skiprows=3)  # height km, density kg/m^3, pressure Pa
# geometric height km, mole fraction of O, Ar, He and H together, of the number densities as printed; at 86 km none: the
# 1.4 below leaves argon's 1 % out
_ATOMS = np.array(
    [
        [86, 0.0], [90, 0.01268], [95, 0.02380], [100, 0.04416], [110, 0.11233], [115, 0.15105], [120, 0.18436],
        [130, 0.24161], [140, 0.29428], [150, 0.34460], [200, 0.56603], [300, 0.84655], [400, 0.95460], [500, 0.98796],
        [600, 0.99732],
    ]
)  # fmt: skip
# a sounding's errors: correlation lengths of density and wind, and the part of the variance that is one constant over
# all altitudes (calibration, drag coefficient of the sphere); assumed, after falling spheres and datasondes
DENSITY_LENGTH_M, WIND_LENGTH_M = 5000.0, 3000.0
SOUNDING_CONSTANT_PART = 0.5
# vertical wavelength of the gravity waves that a wind sounding misses or met at another phase: 2 to 5 km in the lower
# stratosphere, 10 to 30 km at the mesopause; between them, where blunt vehicles have their pressure pulse
_WAVE_LENGTH_M = 7000.0
_WIND_CONSTANT = 1.0 / 3.0  # of a sounded wind's variance, beside waves and gusts in equal parts
# a vehicle turns into gusts: those that no knot resolves look like a smaller C_m. 300 m are crossed at 1 km/s in half a
# period of pitching at 1.7 Hz; with 1 km the C_m of a light vehicle at small angles came out 4 sd low
_WAVE_KNOT_M = 300.0
TOP_M = 1.0e6
BOTTOM_M, BOTTOM_MARS_M = -5000.0, -10000.0  # Hellas lies 8 km below Mars's ellipsoid
# height km, temperature K; below the first and above the last as there
_MARS_TEMPERATURE = np.array(
    [
        [0, 214.0], [2, 213.8], [4, 213.4], [6, 212.4], [8, 209.2], [10, 205.0], [14, 197.8], [18, 191.4], [22, 185.2],
        [26, 180.0], [38, 164.8], [42, 160.0], [46, 156.0], [50, 152.2], [54, 148.7], [60, 144.2], [62, 143.0],
        [68, 140.0], [72, 139.0], [100, 139.0], [150, 200.0],
    ]
)  # fmt: skip
_MARS_PRESSURE_PA = 636.0  # at height 0; over a year and over the planet's weather it swings by 15 %
# heights m, and sd of the density's natural logarithm there: season, tide and dust about a mean of one season. What
# `temperature_sd` does to the weight of the air below, d ln p = (g / R T) (dT / T) dz, where temperatures err alike
# over two scale heights (assumed), on 12 % of the ground's pressure. A dust storm's air is two to three of them denser.
_MARS_DENSITY_SD = np.array([[0.0, 40e3, 80e3, 130e3], [0.12, 0.3, 0.7, 1.1]])
_US76_DENSITY_SD = np.array([[40e3, 50e3, 60e3, 70e3, 80e3, 100e3, 110e3], [0.1, 0.14, 0.19, 0.23, 0.24, 0.24, 0.28]])
_MARS_WIND_SD_MPS = 25.0  # of each component; assumed
_MARS_MEAN_RADIUS_M = 3389.5e3
# mole fractions of carbon dioxide, of N2, O2 and CO, and of argon
_MARS_TRIATOMIC, _MARS_DIATOMIC, _MARS_ATOMIC = np.array([0.9532, 0.0270 + 0.0013 + 0.0007, 0.016]) / 0.9982
_CO2_VIBRATIONS_K = 1.438777 * np.array([667.0, 667.0, 1333.0, 2349.0])  # of their wave numbers, 1/cm


@dataclass(frozen=True)
class AirState:
    """Air at given altitudes, all arrays ``(...)``; ``density_sd`` is a fraction, wind the velocity of the air mass."""

    density_kgpm3: FloatArray
    temperature_k: FloatArray
    pressure_pa: FloatArray
    sound_speed_mps: FloatArray
    wind_ned_mps: FloatArray
    density_sd: FloatArray
    wind_sd_mps: FloatArray


def _in_range(name: str, altitude_m: FloatArray | float, lowest_m: float) -> FloatArray:
    z = np.asarray(altitude_m, dtype=float)
    if not ((z >= lowest_m) & (z <= TOP_M)).all():
        words = f"altitude {np.min(z):.0f} to {np.max(z):.0f} m lies outside {lowest_m:.0f} to {TOP_M:.0f} m"
        raise GateError(f"{name}: {words}", code="value-range")
    return z


def us76(altitude_m: FloatArray | float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Density kg/m^3, temperature K, pressure Pa at geometric altitudes from -5 to 1000 km.

    Raises
    ------
    GateError
        Outside that range.
    """
    z = _in_range("US76", altitude_m, BOTTOM_M)
    low = np.minimum(z, 86000.0)
    t_low, p_low = _below_86_km(EARTH_RADIUS_US76_M * low / (EARTH_RADIUS_US76_M + low))
    high = np.maximum(z, 86000.0)
    above = z > 86000.0
    temperature = np.where(above, _temperature_above_86_km(high), t_low)
    pressure = np.where(above, np.exp(_LOG_PRESSURE(high)), p_low)
    density = np.where(above, np.exp(_LOG_DENSITY(high)), p_low / (R_AIR_JPKGK * t_low))
    return density, temperature, pressure


def bottom_m(planet: Planet) -> float:
    """Lowest height of a planet's standard atmosphere, m."""
    return BOTTOM_M if planet == WGS84 else BOTTOM_MARS_M


def standard_air(altitude_m: FloatArray | float, planet: Planet) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Density kg/m^3, temperature K, pressure Pa of a planet's standard atmosphere; `us76` of the Earth."""
    if planet == WGS84:
        return us76(altitude_m)
    z = _in_range("Mars", altitude_m, BOTTOM_MARS_M)
    temperature = _mars_temperature(z)
    grid, log_pressure = _mars_log_pressure()
    pressure = np.exp(np.interp(z, grid, log_pressure))
    return pressure / (planet.gas_jpkgk * temperature), temperature, pressure


def gas_constant(altitude_m: FloatArray | float, planet: Planet = WGS84) -> FloatArray:
    """Gas constant, J/(kg K), ``(...)`` at geometric altitudes, m: mixed air's up to 86 km, the standard's above."""
    z = np.asarray(altitude_m, dtype=float)
    if planet != WGS84:
        return np.full(z.shape, planet.gas_jpkgk)
    high = np.clip(z, 86000.0, TOP_M)
    unmixed = np.exp(_LOG_PRESSURE(high) - _LOG_DENSITY(high)) / _temperature_above_86_km(high)
    return np.where(z > 86000.0, unmixed, R_AIR_JPKGK)


def heat_ratio(altitude_m: FloatArray | float, temperature_k: FloatArray | float, planet: Planet = WGS84) -> FloatArray:
    """Ratio of specific heats ``(...)`` at geometric altitudes, m, and temperatures, K.

    Of the Earth 1.4 up to 86 km and by the share of atoms above, whatever the temperature (nitrogen's and oxygen's
    vibrations change it by 1 % at 600 K); of Mars that of Viking's mixture at the temperature.
    """
    if planet != WGS84:
        x = _CO2_VIBRATIONS_K / np.asarray(temperature_k, dtype=float)[..., None]
        vibrating = np.sum((0.5 * x / np.sinh(0.5 * x)) ** 2, axis=-1)
        own = _MARS_TRIATOMIC * (2.5 + vibrating) + 2.5 * _MARS_DIATOMIC + 1.5 * _MARS_ATOMIC
        return np.asarray(1.0 + 1.0 / own)
    atoms = np.interp(altitude_m, 1000.0 * _ATOMS[:, 0], _ATOMS[:, 1])
    return np.asarray(1.0 + 1.0 / (2.5 - atoms))


def sound_speed(altitude_m: FloatArray | float, temperature_k: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """Speed of sound, m/s, ``(...)`` at geometric altitudes, m, and temperatures, K."""
    return np.asarray(np.sqrt(_sound_square_per_k(altitude_m, temperature_k, planet) * temperature_k))


def _sound_square_per_k(
    altitude_m: FloatArray | float, temperature_k: FloatArray | float, planet: Planet
) -> FloatArray:
    return np.asarray(heat_ratio(altitude_m, temperature_k, planet) * gas_constant(altitude_m, planet))


class StandardAir(NamedTuple):
    """Standard air at altitudes that are looked up repeatedly: `us76`, and speed of sound squared per kelvin."""

    density_kgpm3: FloatArray
    temperature_k: FloatArray
    pressure_pa: FloatArray
    sound_square_per_k: FloatArray


def earths_standard_air(altitude_m: FloatArray) -> StandardAir:
    """Return the Earth's standard air at altitudes (n,), m, as `AtmosphereProfile.at` uses it."""
    density, temperature, pressure = us76(altitude_m)
    return StandardAir(density, temperature, pressure, _sound_square_per_k(altitude_m, temperature, WGS84))


def _mars_temperature(z: FloatArray) -> FloatArray:
    return np.interp(z, 1000.0 * _MARS_TEMPERATURE[:, 0], _MARS_TEMPERATURE[:, 1])


def mean_free_path(
    density_kgpm3: FloatArray | float, gas_jpkgk: FloatArray | float = R_AIR_JPKGK, planet: Planet = WGS84
) -> FloatArray:
    """Mean free path, m, ``(...)`` of hard spheres, ``m / (sqrt(2) pi d^2 rho)`` (US76 eq. [44]).

    The gas constant ``(...)``, J/(kg K), says how heavy a molecule is on the average.
    """
    section = np.sqrt(2.0) * np.pi * planet.molecule_m**2 * np.asarray(density_kgpm3, dtype=float)
    return np.asarray(_AIR_MOLECULE_KG * (R_AIR_JPKGK / gas_jpkgk) / section)


@cache
def _mars_log_pressure() -> tuple[FloatArray, FloatArray]:
    """Heights, m, and log pressure there: ``d ln p / dz = -g / (R T)``, by Simpson's rule over 100 m."""
    z = np.arange(BOTTOM_MARS_M, TOP_M + 1.0, 100.0)

    def slope(at: FloatArray) -> FloatArray:
        return -MARS.gm_m3ps2 / (_MARS_MEAN_RADIUS_M + at) ** 2 / (MARS.gas_jpkgk * _mars_temperature(at))

    part = 100.0 / 6.0 * (slope(z[:-1]) + 4.0 * slope(z[:-1] + 50.0) + slope(z[1:]))
    total = np.concatenate([np.zeros(1), np.cumsum(part)])
    return z, total - np.interp(0.0, z, total) + np.log(_MARS_PRESSURE_PA)


def _below_86_km(h: FloatArray) -> tuple[FloatArray, FloatArray]:
    base_p = [101325.0]
    for (h0, t0, lapse), (h1, _, _) in pairwise(_LAYERS):
        base_p.append(base_p[-1] * float(_pressure_ratio(np.array(h1 - h0), t0, lapse)))
    k = np.clip(np.searchsorted(_LAYERS[:, 0], h, side="right") - 1, 0, len(_LAYERS) - 1)
    h0, t0, lapse = _LAYERS[k].T if np.ndim(h) == 0 else np.moveaxis(_LAYERS[k], -1, 0)
    return t0 + lapse * (h - h0), np.asarray(base_p)[k] * _pressure_ratio(h - h0, t0, lapse)


def _pressure_ratio(dh: FloatArray, t0: FloatArray, lapse: FloatArray) -> FloatArray:
    isothermal = np.abs(lapse) < 1e-12
    safe = np.where(isothermal, 1.0, lapse)
    power = np.where(isothermal, 0.0, STANDARD_GRAVITY_MPS2 / (R_AIR_JPKGK * safe))
    return np.where(
        isothermal, np.exp(-STANDARD_GRAVITY_MPS2 * dh / (R_AIR_JPKGK * t0)), (t0 / (t0 + lapse * dh)) ** power
    )


def _temperature_above_86_km(z: FloatArray) -> FloatArray:
    km = z / 1000.0
    ellipse = 263.1905 - 76.3232 * np.sqrt(np.maximum(1.0 - ((np.clip(km, 91.0, 110.0) - 91.0) / 19.9429) ** 2, 0.0))
    xi = (np.maximum(km, 120.0) - 120.0) * (6356.766 + 120.0) / (6356.766 + km)
    upper = 1000.0 - 640.0 * np.exp(-0.01875 * xi)
    return np.select([km <= 91.0, km <= 110.0, km <= 120.0], [186.8673, ellipse, 240.0 + 12.0 * (km - 110.0)], upper)


def _spline(column: int) -> Callable[[FloatArray], FloatArray]:
    """Return the cubic spline of the log over height, joined to the equations below 86 km with their slope.

    Natural at its top. Written out, since importing a library's takes longer than flying a flight; a test holds it to
    `scipy.interpolate.CubicSpline`.
    """
    h = EARTH_RADIUS_US76_M * np.array([85990.0, 86000.0]) / (EARTH_RADIUS_US76_M + np.array([85990.0, 86000.0]))
    t, p = _below_86_km(h)
    value = np.log(p if column == 2 else p / (R_AIR_JPKGK * t))
    x, y = _UPPER[:, 0] * 1000.0, np.log(_UPPER[:, column])
    y[0] = value[1]
    step, slope = np.diff(x), np.diff(y) / np.diff(x)
    # slopes at the knots: given below, continuous curvature between, none at the top
    n = len(x)
    matrix, right = np.zeros((n, n)), np.zeros(n)
    matrix[0, 0], right[0] = 1.0, (value[1] - value[0]) / 10.0
    for k in range(1, n - 1):
        matrix[k, k - 1 : k + 2] = step[k], 2.0 * (step[k - 1] + step[k]), step[k - 1]
        right[k] = 3.0 * (step[k] * slope[k - 1] + step[k - 1] * slope[k])
    matrix[-1, -2:], right[-1] = (1.0, 2.0), 3.0 * slope[-1]
    d = np.linalg.solve(matrix, right)
    square = (3.0 * slope - 2.0 * d[:-1] - d[1:]) / step
    cube = (d[:-1] + d[1:] - 2.0 * slope) / step**2

    def at(z: FloatArray) -> FloatArray:
        k = np.clip(np.searchsorted(x, z, side="right") - 1, 0, n - 2)
        u = z - x[k]
        return y[k] + u * (d[k] + u * (square[k] + u * cube[k]))

    return at


_LOG_DENSITY = _spline(1)
_LOG_PRESSURE = _spline(2)


def default_sounding_sd(altitude_m: FloatArray, planet: Planet = WGS84) -> tuple[FloatArray, FloatArray]:
    """Usual error of rocketsonde and balloon profiles: density (fraction) and wind per component (m/s), 1 sd.

    2, 3, 5, 10 % and 2, 4, 8, 15 m/s below 35, 60, 80 km and above (assumed sizes, after the accuracy of falling
    spheres and datasondes), joined linearly over 5 km. Of Mars what stands beside its temperatures above.
    """
    if planet != WGS84:
        return np.interp(altitude_m, *_MARS_DENSITY_SD), np.full(np.shape(altitude_m), _MARS_WIND_SD_MPS)
    knots = [32500.0, 37500.0, 57500.0, 62500.0, 77500.0, 82500.0]
    density = np.interp(altitude_m, knots, [0.02, 0.03, 0.03, 0.05, 0.05, 0.10])
    return density, np.interp(altitude_m, knots, [2.0, 4.0, 4.0, 8.0, 8.0, 15.0])


def temperature_sd(altitude_m: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """Usual error of datasonde and sphere temperatures, K: 1 at 30 km, 3 at 70 km, 5 from 80 km (1 sd).

    Of Mars, what season, hour and dust do to the standard's: 20 to 50 km, 35 from 80 km (assumed; Pathfinder met 92 K
    at 80 km, 45 K below it: Schofield et al., Science 278 (1997) 1752).
    """
    if planet != WGS84:
        return np.asarray(np.interp(altitude_m, [50e3, 80e3], [20.0, 35.0]))
    return np.asarray(np.interp(altitude_m, [30e3, 70e3, 80e3], [1.0, 3.0, 5.0]))


def standard_temperature_sd(altitude_m: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """Sd of a day's temperature about the standard's, K: 10 to 110 km, 30 from 120 km; for Mars `temperature_sd`.

    Rms of NRLMSIS 2.1 less US76 between 30 and 60 deg of latitude, all seasons, hours and solar fluxes from 70 to 200:
    6 to 13 K up to 110 km, 29 K at 120 km.
    """
    if planet != WGS84:
        return temperature_sd(altitude_m, planet)
    return np.asarray(np.interp(altitude_m, [110e3, 120e3], [10.0, 30.0]))


def sounding_correlation(altitude_m: FloatArray, length_m: float) -> FloatArray:
    """Correlation ``(n, n)`` of a sounding's error between altitudes (n,); the length is that of density or wind."""
    return correlation(altitude_m, length_m, SOUNDING_CONSTANT_PART)


def sounding_correlation_inverse(altitude_m: FloatArray, length_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Inverse of `sounding_correlation` at rising altitudes (n,), as `statistics.correlation_inverse` has it."""
    return correlation_inverse(altitude_m, length_m, SOUNDING_CONSTANT_PART)


def sounding_correlation_root(
    altitude_m: FloatArray, length_m: float, knots_a_length: int = KNOTS_A_LENGTH
) -> FloatArray:
    """Root ``(n, k)`` of `sounding_correlation`: a sounding's error, over its sd, per unit normal."""
    return correlation_root(altitude_m, length_m, SOUNDING_CONSTANT_PART, knots_a_length)


@cache
def _wave_table() -> tuple[FloatArray, FloatArray]:
    """Distances, in wavelengths over 2 pi, and the waves' correlation over them, by the spectrum's transform."""
    step, count = 0.005, 2**15  # to 160 times the characteristic wavenumber: it leaves 2e-5 of the variance out
    x = step * np.arange(count + 1)
    even = np.fft.irfft(x / (1.0 + x**4))[:count]
    return np.asarray(np.pi / (step * count) * np.arange(count)), np.asarray(even / even[0])


def wave_correlation(apart_m: FloatArray) -> FloatArray:
    """Correlation of the wind of gravity waves between altitudes so far apart, m.

    Their spectrum over vertical wavenumber is ``x / (1 + x^4)`` with ``x`` the wavenumber over the characteristic one:
    saturated waves fall as ``x^-3``. Half a wavelength away the wind is more likely the opposite one.
    """
    return np.interp(2.0 * np.pi / _WAVE_LENGTH_M * np.abs(apart_m), *_wave_table())


def wind_error_root(altitude_m: FloatArray) -> FloatArray:
    """Error ``(n, k)`` of a sounded wind component at altitudes (n,), over its sd, per unit normal.

    A third of the variance each (assumed) is one constant, gravity waves (`wave_correlation`), and Gauss-Markov over
    `WIND_LENGTH_M`: what the sounding smoothed or measured with noise. Straight lines join knots that resolve gusts
    into which a vehicle turns. Without the waves, one of the stated size looks like methods that disagree: a
    Gauss-Markov history has a third of their power at their wavelength. Without the latter, gusts below a kilometre,
    of which waves have next to none, are taken for the flow's and C_m, a slope over it, comes out low.
    """
    constant = np.full((len(altitude_m), 1), np.sqrt(_WIND_CONSTANT))

    def both(knots: FloatArray) -> FloatArray:
        apart = np.abs(knots[:, None] - knots)
        return np.asarray(0.5 * (wave_correlation(apart) + np.exp(-apart / WIND_LENGTH_M)))

    changing = knots_root(altitude_m, _WAVE_KNOT_M, both)
    size = np.sqrt(np.sum(changing**2, axis=1, keepdims=True))  # straight lines between knots are a little too small
    return np.column_stack([constant, np.sqrt(1.0 - _WIND_CONSTANT) / size * changing])


def unresolved_variance(spacing_m: FloatArray | float, length_m: float) -> FloatArray:
    """Part of a sounding's error variance that straight lines between knots ``spacing_m`` apart leave out."""
    return np.asarray((1.0 - SOUNDING_CONSTANT_PART) * spacing_m / (3.0 * length_m))


@dataclass(frozen=True)
class AtmosphereProfile:
    """Air over altitude: log density relative to the standard (US76), temperature, winds, each linear between knots.

    Between the knots the US76 carries the exponential; outside them the ratio to US76 and the winds fade with
    ``fade_m``, and the standard deviations grow to 15 % and 20 m/s.
    """

    altitude_m: FloatArray
    log_density_ratio: FloatArray
    temperature_offset_k: FloatArray
    wind_ned_mps: FloatArray
    density_sd: FloatArray
    wind_sd_mps: FloatArray
    fade_m: float = 10000.0
    planet: Planet = WGS84
    temperature_sd_k: FloatArray | None = None  # at the knots; None: the usual one, `temperature_sd`
    # heights between which a flight's own deceleration measured it: an error of the path's height is the profile's, too
    met_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Check once."""
        check_increasing("atmosphere altitude", self.altitude_m)
        check_finite("atmosphere wind", self.wind_ned_mps)
        check_finite("atmosphere density", self.log_density_ratio)

    def at(self, altitude_m: FloatArray | float, standard: StandardAir | None = None) -> AirState:
        """Air at geometric altitudes, m; ``standard`` is `earths_standard_air` there, where it is known already."""
        z = np.asarray(altitude_m, dtype=float)
        density, temperature, pressure = standard_air(z, self.planet) if standard is None else standard[:3]
        beyond = np.maximum(z - self.altitude_m[-1], 0.0) + np.maximum(self.altitude_m[0] - z, 0.0)
        fade = np.exp(-beyond / self.fade_m)

        def column(values: FloatArray) -> FloatArray:
            return np.interp(z, self.altitude_m, values)

        ratio = np.exp(fade * column(self.log_density_ratio))
        warmer = temperature + fade * column(self.temperature_offset_k)
        wind = np.stack([fade * column(w) for w in self.wind_ned_mps.T], axis=-1)
        return AirState(
            density_kgpm3=density * ratio,
            temperature_k=warmer,
            pressure_pa=pressure * ratio * warmer / temperature,
            sound_speed_mps=(
                sound_speed(z, warmer, self.planet)
                if standard is None
                else np.sqrt(standard.sound_square_per_k * warmer)
            ),
            wind_ned_mps=wind,
            density_sd=column(self.density_sd) * fade + 0.15 * (1.0 - fade),
            wind_sd_mps=column(self.wind_sd_mps) * fade + 20.0 * (1.0 - fade),
        )

    def temperature_sd(self, altitude_m: FloatArray) -> FloatArray:
        """Standard deviation of the temperature, K, at geometric altitudes, m; beyond the knots the standard's."""
        if self.temperature_sd_k is None:
            own = temperature_sd(altitude_m, self.planet)
        else:
            own = np.interp(altitude_m, self.altitude_m, self.temperature_sd_k)
        inside = (altitude_m >= self.altitude_m[0]) & (altitude_m <= self.altitude_m[-1])
        return np.where(inside, own, standard_temperature_sd(altitude_m, self.planet))


def profile_from_sounding(sounding: Sounding) -> AtmosphereProfile:
    """Blend the day's sounding into the planet's standard atmosphere."""
    density, temperature, _ = standard_air(sounding.altitude_m, sounding.planet)
    return AtmosphereProfile(
        altitude_m=sounding.altitude_m,
        log_density_ratio=np.log(sounding.density_kgpm3 / density),
        temperature_offset_k=sounding.temperature_k - temperature,
        wind_ned_mps=np.column_stack(
            [sounding.wind_north_mps, sounding.wind_east_mps, np.zeros_like(sounding.altitude_m)]
        ),
        density_sd=sounding.density_sd,
        wind_sd_mps=sounding.wind_sd_mps,
        planet=sounding.planet,
        temperature_sd_k=sounding.temperature_sd_k,
    )


def height_from_pressure(profile: AtmosphereProfile, pressure_pa: FloatArray) -> FloatArray:
    """Geometric heights (n,), m, at which a profile has these pressures, from -5 to 100 km; NaN stays.

    Log pressure is interpolated between heights 20 m apart: its curvature errs by less than a millimetre.
    """
    z = np.arange(BOTTOM_M, 100001.0, 20.0)
    return np.interp(-np.log(pressure_pa), -np.log(profile.at(z).pressure_pa), z)


def standard_atmosphere() -> AtmosphereProfile:
    """US76 without winds."""
    z = np.arange(0.0, 100001.0, 2500.0)
    density_sd, wind_sd = default_sounding_sd(z)
    return AtmosphereProfile(z, np.zeros(len(z)), np.zeros(len(z)), np.zeros((len(z), 3)), density_sd, wind_sd)


def standard_sounding(planet: Planet = WGS84) -> Sounding:
    """US76 without winds in the form of a sounding, 0 to 120 km, for a flight of which no sounding was made.

    What a day's air differs from the standard, not an instrument's error: density by 10 % to 40 km, 19 % at 60 km, 24 %
    from 80 km, 28 % from 110 km, temperature by `standard_temperature_sd`; each component of the wind by 15 m/s, as is
    usual in the stratosphere. Density is the rms of NRLMSIS 2.1 less US76 as of the temperature there, but no less than
    10 % (3 % at the ground, 6 % at 30 km): over all latitudes it is up to 1.7 times as large, at 40 km. Of Mars, 0 to
    250 km, by what stands beside its temperatures above.
    """
    if planet != WGS84:
        z = np.arange(BOTTOM_MARS_M, 250001.0, 1000.0)
        sd = default_sounding_sd(z, planet)
    else:
        z = np.arange(0.0, 120001.0, 1000.0)
        sd = np.interp(z, *_US76_DENSITY_SD), np.full(len(z), 15.0)
    still = np.zeros(len(z))
    return Sounding(z, *standard_air(z, planet), still, still, *sd, planet, standard_temperature_sd(z, planet))


@cache
def nrlmsis_profile(name: str = "nrlmsis_2009_08_17") -> AtmosphereProfile:
    """Modelled profile of a day that ships with the toolkit, 0 to 400 km, without winds.

    Parameters
    ----------
    name : str
        Stem of a table in ``data/atmosphere``, whose head names its source.

    Notes
    -----
    Temperature is the kinetic one; the gas is US76's, as everywhere here.
    """
    z, density, temperature, _ = np.loadtxt(TABLES / f"{name}.csv", delimiter=",", comments="#", skiprows=3).T
    return _still_profile(z, density, temperature)


def _still_profile(z: FloatArray, density: FloatArray, temperature: FloatArray) -> AtmosphereProfile:
    standard, standard_t, _ = us76(z)
    sd = default_sounding_sd(z)
    still = np.zeros((len(z), 3))
    return AtmosphereProfile(z, np.log(density / standard), temperature - standard_t, still, *sd)


@cache
def nrlmsis_of(t0_utc: str, latitude_rad: float, longitude_rad: float, f107: float, ap: float) -> AtmosphereProfile:
    """NRLMSIS 2.1 of a time and place, 0 to 400 km, without winds, through pymsis.

    Parameters
    ----------
    t0_utc : str
        ISO 8601.
    f107, ap : float
        Solar flux (of the day and its mean) and geomagnetic index: nothing is looked up, nothing downloaded.

    Raises
    ------
    ConfigError
        ``package-missing`` without the library.
    """
    try:
        import pymsis
    except ImportError:
        words = "NRLMSIS needs pymsis: pip install 'postflight[msis]', or choose base = \"us76\""
        raise ConfigError(words, code="package-missing") from None
    z = np.concatenate([np.arange(0.0, 130e3, 1000.0), np.arange(130e3, 200e3, 2000.0), np.arange(200e3, 4.01e5, 1e4)])
    time = np.datetime64(parse_utc(t0_utc).replace(tzinfo=None))
    east, north = np.rad2deg([longitude_rad, latitude_rad])
    out = pymsis.calculate(time, east, north, z / 1000.0, [f107], [f107], [[ap] * 7], version=2.1)
    out = np.asarray(out, dtype=float).reshape(len(z), 11)
    return _still_profile(z, out[:, 0], out[:, 10])

"""What is the true atmosphere of the day of flight, and what would a sounding of it report?

``rho = rho_base exp(wave + structure)`` with a base of US76, NRLMSIS or a measured sounding, a smooth gravity wave and
a Gauss-Markov structure of 5 km correlation length; winds are those of the place and month, of the scenario or of the
sounding, with a structure of 3 km (`MeanAir`). A measured sounding holds its own structure: none is added unless the
scenario states its size. Then come the disturbances that the scenario names: density pockets, wind shears, turbulence,
discrete gusts.

Two soundings can be had of it. The simple one errs by a constant part, a gravity wave and small structure of the size
that the filter assumes. The range's is a balloon below 30 km, a datasonde and an inflatable sphere above, each with its
own accuracy, smoothed to the vertical wavelength that a falling sphere resolves, and some hours old.

References
----------
Schmidlin et al., "The inflatable sphere: a technique for the accurate measurement of middle atmosphere temperatures",
J. Geophys. Res. 96, 1991 (resolution); the accuracies are those ranges quote for these instruments.
MIL-F-8785C, section 3.7 (Dryden spectra, 1-cosine gust).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from flightmodel.atmosphere import (
    TABLES,
    AtmosphereProfile,
    default_sounding_sd,
    nrlmsis_of,
    nrlmsis_profile,
    profile_from_sounding,
    standard_atmosphere,
    us76,
)
from flightmodel.checks import ConfigError, FloatArray
from flightmodel.config import FileBeside, Fraction, KeyFault, Section, parse_utc
from synthetic_flight.instrument_errors import gauss_markov

Wind = Annotated[float, Field(ge=-500.0, le=500.0)]
WindSize = Annotated[float, Field(ge=0.0, le=500.0)]
# the dynamics' table of the atmosphere has a row every 50 m: a layer must span at least four of them
Thickness = Annotated[float, Field(ge=200.0, le=110e3)]
Altitude = Annotated[float, Field(gt=0.0, lt=110e3)]
WindHeight = Annotated[float, Field(ge=-500.0, le=110e3)]
STEP_M, TOP_M = 250.0, 130000.0
POINTS_PER_LENGTH = 10  # knots along a disturbance's thickness
# gain 1/2 of a Gaussian of standard deviation s at wavelength l: s = l sqrt(ln 2 / 2) / pi
HALF_GAIN = float(np.sqrt(0.5 * np.log(2.0)) / np.pi)


class Pocket(Section):
    """A layer thinner (or, with a negative depth, denser) than the air around it, at unchanged pressure."""

    altitude_m: Altitude
    depth: Annotated[float, Field(gt=-1.0, lt=1.0)]
    thickness_m: Thickness


class Shear(Section):
    """Change of wind through a layer; above the layer the full change applies."""

    altitude_m: Altitude
    north_mps: Wind
    east_mps: Wind
    thickness_m: Thickness


class Turbulence(Section):
    """Random horizontal gusts in a band of altitudes, with Dryden's transverse spectrum."""

    sd_mps: WindSize
    length_m: Thickness
    from_m: Altitude
    to_m: Altitude

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.to_m - self.from_m < 2.0 * self.length_m:
            yield "", None, "a band from_m to to_m of at least two length_m is wanted"


class DiscreteGust(Section):
    """A single gust, ``(1 + cos)/2`` of its peak over twice ``thickness_m``."""

    altitude_m: Altitude
    north_mps: Wind
    east_mps: Wind
    thickness_m: Thickness


class RangeSounding(Section):
    """The range's sounding: its age at the flight, its top, the vertical wavelength it resolves."""

    age_h: Annotated[float, Field(ge=0.0, le=240.0)] = 3.0
    top_m: Annotated[float, Field(ge=35e3, le=100e3)] = 90e3
    resolution_m: Annotated[float, Field(ge=500.0, le=20e3)] = 2000.0


class DayOfFlightAtmosphere(Section):
    """Departure of the day-of-flight atmosphere from its base, and the size of the sounding's errors.

    The base is a model (``base``) or a measured sounding (``from``, a table as flight folders have it). ``winds`` are
    those of the place and month, ``mean_wind`` (altitude m, north and east m/s) instead, or the sounding's.
    """

    base: Literal["us76", "nrlmsis_2009_08_17", "nrlmsis"] = "us76"
    from_: FileBeside | None = Field(default=None, alias="from")
    f107: Annotated[float, Field(ge=50.0, le=500.0)] = 120.0
    ap: Annotated[float, Field(ge=0.0, le=400.0)] = 9.0
    winds: bool = True
    mean_wind: Annotated[tuple[tuple[WindHeight, Wind, Wind], ...], Field(min_length=2)] | None = None
    density_sd: Fraction = 0.015
    wind_sd_mps: WindSize = 2.0
    pockets: tuple[Pocket, ...] = ()
    shears: tuple[Shear, ...] = ()
    gusts: tuple[Turbulence, ...] = ()
    discrete_gusts: tuple[DiscreteGust, ...] = ()
    sounding_scale: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0
    sounding: RangeSounding | None = None

    @field_validator("winds", mode="before")
    @classmethod
    def _no_wind_model(cls, value: object) -> object:
        if isinstance(value, str) and value.lower().startswith("hwm"):
            raise ValueError(
                "the Horizontal Wind Model has no library that installs without a Fortran compiler; write its winds as "
                "mean_wind = [[altitude_m, north_mps, east_mps], ...]"
            )
        return value

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if self.from_ is not None and "base" in self.model_fields_set:
            yield "from", self.from_, f"base = '{self.base}' states another air; keep one of the two"
        if self.mean_wind is not None and not self.winds:
            yield "winds", False, "mean_wind states winds; remove one of the two"
        if any(b[0] <= a[0] for a, b in pairwise(self.mean_wind or ())):
            yield "mean_wind", "", "altitudes must increase"

    @property
    def structure_sd(self) -> tuple[float, float]:
        """Size of the random structure: density (fraction), wind m/s. A sounding has none unless one is stated."""
        if self.from_ is None:
            return self.density_sd, self.wind_sd_mps
        stated = self.model_dump(include=self.model_fields_set)
        return stated.get("density_sd", 0.0), stated.get("wind_sd_mps", 0.0)


# altitude km, north and east wind m/s: a smooth mid-latitude August day, assumed; flown 30 to 45 N in July and August
_AUGUST_WIND = np.array(
    [
        [0, 2, 1], [5, 3, 8], [11, 4, 16], [18, 1, 0], [25, 0, -10], [35, 2, -18], [45, 3, -28], [55, -4, -38],
        [65, -6, -45], [75, 10, -36], [82, 4, -12], [90, -12, 14], [100, -8, 22], [115, 0, 0],
    ],
    dtype=float,
)  # fmt: skip


_AUGUST_MONTHS, _AUGUST_LATITUDES_DEG = (7, 8), (30.0, 45.0)


@dataclass(frozen=True)
class MeanAir:
    """Mean atmosphere of the place and day, before any random structure.

    Parameters
    ----------
    base : AtmosphereProfile or None
        Density, temperature and, where measured, winds; None is US76 without winds.
    wind : (n, 3) float
        Altitude km, mean north and east wind m/s, added to the base's; linear between the rows.
    """

    base: AtmosphereProfile | None
    wind: FloatArray


AUGUST = MeanAir(None, _AUGUST_WIND)
_NO_WIND = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])


def mean_air(
    spec: DayOfFlightAtmosphere, folder: Path, t0_utc: str, latitude_rad: float, longitude_rad: float
) -> MeanAir:
    """Mean atmosphere as stated by a scenario, or else that of its place and month.

    Raises
    ------
    ConfigError
        Where its sounding cannot be read, or NRLMSIS is asked for without the library (``package-missing``).
    """
    if spec.from_ is not None:
        base: AtmosphereProfile | None = _measured(folder / spec.from_)
    elif spec.base == "us76":
        base = None
    elif spec.base == "nrlmsis":
        base = nrlmsis_of(t0_utc, latitude_rad, longitude_rad, spec.f107, spec.ap)
    else:
        base = nrlmsis_profile(spec.base)
    if spec.mean_wind is not None:
        return MeanAir(base, np.array(spec.mean_wind) / [1000.0, 1.0, 1.0])
    if not spec.winds or spec.from_ is not None:
        return MeanAir(base, _NO_WIND)
    month, (low, high) = parse_utc(t0_utc).month, np.deg2rad(_AUGUST_LATITUDES_DEG)
    if month in _AUGUST_MONTHS and low <= latitude_rad <= high:
        return MeanAir(base, _AUGUST_WIND)
    return MeanAir(base, seasonal_wind(month, latitude_rad))


@cache
def _wind_table() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitudes (k,) deg, altitudes (n,) km and east wind ``(12, k, n)``, m/s, of ``mean_winds.csv``."""
    path = TABLES / "mean_winds.csv"
    head = next(line for line in path.read_text().splitlines() if not line.startswith("#"))
    altitude_km = np.array([float(name[1:-2]) for name in head.split(",")[2:]])
    rows = np.loadtxt(path, delimiter=",", comments="#", skiprows=3).reshape(12, -1, 2 + len(altitude_km))
    return rows[0, :, 1], altitude_km, rows[:, :, 2:]


def seasonal_wind(month: int, latitude_rad: float) -> FloatArray:
    """Zonal-mean wind of a month (1 to 12) and latitude, ``(n, 3)``: altitude km, north (0) and east wind m/s.

    In gradient balance with NRLMSIS 2.1's pressures (``tools/mean_winds.py``).
    """
    latitudes, altitude_km, wind = _wind_table()
    east = [np.interp(np.rad2deg(latitude_rad), latitudes, column) for column in wind[month - 1].T]
    return np.column_stack([altitude_km, np.zeros(len(altitude_km)), east])


def _measured(path: Path) -> AtmosphereProfile:
    """Read a sounding as a profile, on knots that follow its blending into the standard atmosphere beyond its ends."""
    from flightmodel.gate import Gate  # these import pandas: longer than a flight takes
    from flightmodel.instruments import AtmosphereEntry
    from flightmodel.sensor_tables import read_sounding

    gate = Gate(path.parent, datetime(2000, 1, 1, tzinfo=UTC))  # a sounding has no times
    sounding = read_sounding(gate, AtmosphereEntry(file=path.name))
    if sounding is None:
        raise ConfigError([*gate.config, *gate.faults])
    profile = profile_from_sounding(sounding)
    above = np.arange(sounding.altitude_m[-1], TOP_M + 60e3, 1000.0)
    z = np.union1d(profile.altitude_m, np.union1d(above, np.arange(0.0, sounding.altitude_m[0], STEP_M)))
    air, (density, temperature, _) = profile.at(z), us76(z)
    return AtmosphereProfile(
        z,
        np.log(air.density_kgpm3 / density),
        air.temperature_k - temperature,
        air.wind_ned_mps,
        air.density_sd,
        air.wind_sd_mps,
    )


def correlated(altitude_m: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Gauss-Markov noise of unit variance along altitude with a correlation length, m."""
    return gauss_markov(altitude_m, 1.0, length_m, 1, rng)[:, 0]


def dryden_transverse(count: int, step_m: float, length_m: float, rng: np.random.Generator) -> FloatArray:
    """``(count,)`` samples of unit variance, ``step_m`` apart, with Dryden's transverse spectrum.

    Notes
    -----
    Spectrum ``L/pi (1 + 3 (L w)^2) / (1 + (L w)^2)^2``, correlation ``(1 - d/2L) exp(-d/L)``. Drawn by circulant
    embedding: exact in its covariance up to wrap-round terms of ``exp(-count step / L)``.
    """
    n = 2 * count
    lag = step_m * np.minimum(np.arange(n), n - np.arange(n))
    power = np.fft.fft((1.0 - 0.5 * lag / length_m) * np.exp(-lag / length_m)).real
    white = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    return np.fft.fft(np.sqrt(np.maximum(power, 0.0) / n) * white).real[:count]


def _raised_cosine(altitude_m: FloatArray, centre_m: float, thickness_m: float) -> FloatArray:
    """One at the centre, a half ``thickness_m / 2`` beside it, zero from ``thickness_m`` on."""
    x = np.clip((altitude_m - centre_m) / thickness_m, -1.0, 1.0)
    return 0.5 * (1.0 + np.cos(np.pi * x))


def _smooth_step(altitude_m: FloatArray, centre_m: float, thickness_m: float) -> FloatArray:
    """Rise from zero to one over ``thickness_m`` around the centre, by a half cosine."""
    x = np.clip((altitude_m - centre_m) / thickness_m, -0.5, 0.5)
    return 0.5 * (1.0 + np.sin(np.pi * x))


def day_of_flight_atmosphere(spec: DayOfFlightAtmosphere, rng: np.random.Generator, mean: MeanAir) -> AtmosphereProfile:
    """Draw the true atmosphere of the flight: structure from 0 to 130 km, its base above.

    ``mean`` is the air without random structure (`mean_air`). Turbulence draws from children of ``rng``, one a band, so
    it leaves all other draws as they are.
    """
    z = np.arange(0.0, TOP_M + 1.0, STEP_M)
    density_structure, wind_structure = spec.structure_sd
    smooth = 0.03 * np.sin(2.0 * np.pi * (z / 45000.0 + rng.random())) * (density_structure > 0.0)
    ratio = smooth + density_structure * correlated(z, 5000.0, rng)
    wind = np.zeros((len(z), 3))
    if spec.winds:
        for axis in (0, 1):
            of_place = np.interp(z / 1000.0, mean.wind[:, 0], mean.wind[:, axis + 1])
            wind[:, axis] = of_place + wind_structure * correlated(z, 3000.0, rng)
        wind *= np.interp(z, [110000.0, 130000.0], [1.0, 0.0])[:, None]
    density_sd, wind_sd = default_sounding_sd(z)
    day = AtmosphereProfile(z, ratio, np.zeros(len(z)), wind, density_sd, wind_sd)
    if mean.base is not None:
        day = _on_base(day, mean.base if spec.winds else replace(mean.base, wind_ned_mps=0.0 * mean.base.wind_ned_mps))
    structures = (*spec.pockets, *spec.shears, *spec.gusts, *spec.discrete_gusts)
    return _with_structures(day, spec, rng) if structures else day


def _resampled(profile: AtmosphereProfile, z: FloatArray) -> AtmosphereProfile:
    """Return the same piecewise linear profile on more knots; ``z`` holds all of the old ones."""

    def column(values: FloatArray) -> FloatArray:
        return np.interp(z, profile.altitude_m, values)

    return AtmosphereProfile(
        z,
        column(profile.log_density_ratio),
        column(profile.temperature_offset_k),
        np.column_stack([column(w) for w in profile.wind_ned_mps.T]),
        column(profile.density_sd),
        column(profile.wind_sd_mps),
        profile.fade_m,
    )


def _on_base(day: AtmosphereProfile, base: AtmosphereProfile) -> AtmosphereProfile:
    """Add the day's structure to a modelled base; above 130 km the structure decays over 10 km."""
    z = np.union1d(base.altitude_m, np.union1d(day.altitude_m, np.arange(TOP_M, TOP_M + 60e3, 1000.0)))
    under = _resampled(base, z)
    fade = np.exp(-np.maximum(z - TOP_M, 0.0) / day.fade_m)
    return AtmosphereProfile(
        z,
        under.log_density_ratio + fade * np.interp(z, day.altitude_m, day.log_density_ratio),
        under.temperature_offset_k,
        under.wind_ned_mps + np.column_stack([fade * np.interp(z, day.altitude_m, w) for w in day.wind_ned_mps.T]),
        under.density_sd,
        under.wind_sd_mps,
    )


def _with_structures(
    day: AtmosphereProfile, spec: DayOfFlightAtmosphere, rng: np.random.Generator
) -> AtmosphereProfile:
    """Add pockets, shears and gusts, with knots that resolve the thinnest of them."""
    knots = [day.altitude_m]
    parts: list[Pocket | Shear | DiscreteGust] = [*spec.pockets, *spec.shears, *spec.discrete_gusts]
    for part in parts:
        reach = part.thickness_m
        knots.append(np.linspace(part.altitude_m - reach, part.altitude_m + reach, 2 * POINTS_PER_LENGTH + 1))
    bands = [
        np.linspace(g.from_m, g.to_m, int(np.ceil((g.to_m - g.from_m) / g.length_m * POINTS_PER_LENGTH)) + 1)
        for g in spec.gusts
    ]
    z = np.unique(np.round(np.concatenate([*knots, *bands]), 3))
    fine = _resampled(day, z[(z >= 0.0) & (z <= day.altitude_m[-1])])
    z, ratio, wind = fine.altitude_m, fine.log_density_ratio.copy(), fine.wind_ned_mps.copy()
    thinner = np.ones(len(z))
    for pocket in spec.pockets:
        thinner *= 1.0 - pocket.depth * _raised_cosine(z, pocket.altitude_m, pocket.thickness_m)
    for shear in spec.shears:
        # fades out above 110 km as the winds do
        rise = _smooth_step(z, shear.altitude_m, shear.thickness_m) * np.interp(z, [110e3, 130e3], [1.0, 0.0])
        wind[:, :2] += rise[:, None] * (shear.north_mps, shear.east_mps)
    for gust in spec.discrete_gusts:
        shape = _raised_cosine(z, gust.altitude_m, gust.thickness_m)
        wind[:, :2] += shape[:, None] * (gust.north_mps, gust.east_mps)
    for band, gusts, child in zip(bands, spec.gusts, rng.spawn(len(bands)), strict=True):
        edge = np.clip(np.minimum(band - gusts.from_m, gusts.to_m - band) / gusts.length_m, 0.0, 1.0)
        for axis in (0, 1):
            drawn = dryden_transverse(len(band), band[1] - band[0], gusts.length_m, child)
            wind[:, axis] += np.interp(z, band, gusts.sd_mps * edge * drawn, left=0.0, right=0.0)
    # ideal gas at unchanged pressure: temperature grows as density falls
    warmer = fine.at(z).temperature_k * (1.0 / thinner - 1.0)
    return AtmosphereProfile(
        z, ratio + np.log(thinner), fine.temperature_offset_k + warmer, wind, fine.density_sd, fine.wind_sd_mps
    )


def sense_atmosphere(
    profile: AtmosphereProfile, spec: DayOfFlightAtmosphere, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sounding of the day: the simple one, or the range's where the scenario has ``[atmosphere.sounding]``.

    Returns
    -------
    altitude_m (n,), density_temperature (n, 2) in kg/m^3 and K, wind_ned_mps (n, 2) north and east
    """
    if spec.sounding is not None:
        return _range_sounding(profile, spec.sounding, spec.sounding_scale, rng)
    z = np.arange(0.0, 95001.0, 1000.0)
    fine = z[:, None] + np.linspace(-1000.0, 1000.0, 9)
    air = profile.at(np.maximum(fine, 0.0))
    density = np.exp(np.log(air.density_kgpm3).mean(axis=1))
    # the mean of the logarithm over 2 km removes structure alone: that of an exponential does not move
    wind = air.wind_ned_mps.mean(axis=1)[:, :2]
    density_sd, wind_sd = default_sounding_sd(z)

    def error() -> FloatArray:
        wave = np.sqrt(2.0) * np.sin(2.0 * np.pi * (z / 7000.0 + rng.random()))
        return 0.6 * rng.standard_normal() + 0.6 * wave + 0.5 * correlated(z, 2500.0, rng)

    density = density * np.exp(spec.sounding_scale * density_sd * error())
    wind = wind + spec.sounding_scale * wind_sd[:, None] * np.column_stack([error(), error()])
    temperature = profile.at(z).temperature_k + spec.sounding_scale * 1.5 * error()
    return z, np.column_stack([density, temperature]), wind


BALLOON_TOP_M = 30e3


def range_sounding_sd(altitude_m: FloatArray, pressure_pa: FloatArray, temperature_k: FloatArray) -> FloatArray:
    """Standard deviation of the range's instruments: density (fraction), temperature K, wind m/s, ``(n, 3)``.

    Balloon below 30 km: 0.5 K, 1 m/s, and a pressure cell of 1 hPa up to where that is 1 %, which the hydrostatic
    equation carries on above. Above: sphere density 3 % to 80 km, 10 % at 90 km; datasonde temperature 1 K at 30 to
    3 K at 70 km, sphere 5 K from 80 km; winds 1, 3, 7 m/s at 40, 60, 80 km.
    """
    balloon = altitude_m < BALLOON_TOP_M
    pressure = np.minimum(100.0 / pressure_pa, 0.01)
    density = np.where(
        balloon, np.hypot(pressure, 0.5 / temperature_k), np.interp(altitude_m, [80e3, 90e3], [0.03, 0.10])
    )
    temperature = np.where(balloon, 0.5, np.interp(altitude_m, [30e3, 70e3, 80e3], [1.0, 3.0, 5.0]))
    wind = np.interp(altitude_m, [40e3, 60e3, 80e3, 100e3], [1.0, 3.0, 7.0, 11.0])
    return np.column_stack([density, temperature, wind])


def _range_sounding(
    profile: AtmosphereProfile, spec: RangeSounding, scale: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sounding by balloon, datasonde and inflatable sphere, ``spec.age_h`` hours before the flight.

    Half of each instrument's variance is a constant bias through its profile (calibration, drag coefficient, pressure
    cell), half is Gauss-Markov with a correlation length of 5 km (density, temperature) or 3 km (winds). The atmosphere
    has changed since by 0.5 % and 1 m/s an hour. Above the balloon only structure longer than ``resolution_m`` is left
    (gain 1/2 there).

    Returns
    -------
    altitude_m (n,), density_temperature (n, 2) in kg/m^3 and K, wind_ned_mps (n, 2)
    """
    step = 250.0
    grid = np.arange(0.0, spec.top_m + 5001.0, step)
    air, standard = profile.at(grid), standard_atmosphere().at(grid)
    # density as the logarithm of its ratio to the standard: smoothing then removes structure alone
    columns = np.column_stack(
        [np.log(air.density_kgpm3 / standard.density_kgpm3), air.temperature_k, air.wind_ned_mps[:, :2]]
    )
    reach = HALF_GAIN * spec.resolution_m / step
    kernel = np.exp(-0.5 * (np.arange(-int(4 * reach) - 1, int(4 * reach) + 2) / reach) ** 2)
    padded = np.pad(columns, ((len(kernel) // 2,) * 2, (0, 0)), mode="edge")
    smoothed = np.column_stack([np.convolve(c, kernel / kernel.sum(), mode="valid") for c in padded.T])
    measured = np.where(grid[:, None] < BALLOON_TOP_M, columns, smoothed)
    z = np.arange(0.0, spec.top_m + 1.0, 500.0)
    rows = np.searchsorted(grid, z)
    sd = range_sounding_sd(z, air.pressure_pa[rows], air.temperature_k[rows])[:, [0, 1, 2, 2]]
    stale = spec.age_h * np.array([0.005, 0.0, 1.0, 1.0])
    for k, length in enumerate((5000.0, 5000.0, 3000.0, 3000.0)):
        constant = np.where(z < BALLOON_TOP_M, *rng.standard_normal(2))
        own = sd[:, k] * np.sqrt(0.5) * (constant + correlated(z, length, rng))
        measured[rows, k] += scale * (own + stale[k] * correlated(z, length, rng))
    ratio, temperature, north, east = measured[rows].T
    density = standard.density_kgpm3[rows] * np.exp(ratio)
    return z, np.column_stack([density, temperature]), np.column_stack([north, east])

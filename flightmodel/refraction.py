"""Atmospheric refraction and delay of a radar's beam: readings of a point at a known position.

Refractivity ``N = (n - 1) 1e6`` falls with height in spherical layers about the site's osculating sphere. Along a ray
``n r cos(elevation)`` is constant (Bouguer), so the angle at the Earth's centre and the electrical length are

``phi = int a dr / (r sqrt(n^2 r^2 - a^2))``,  ``L = int n^2 r dr / sqrt(n^2 r^2 - a^2)``,  ``a = n_0 r_0 cos(E_0)``.

Above 130 km the ray is straight. The apparent elevation ``E_0`` is the one whose ray goes through the target. The
ionosphere is left out: at C band (5.6 GHz) it delays by decimetres. So are ducts and anything that differs along the
horizon.

References
----------
Bean and Dutton, "Radio Meteorology", NBS Monograph 92, 1966, sections 1.4 and 3. ITU-R P.453 (exponential profile: 315
at sea level, scale height 7.35 km).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import earth
from flightmodel.checks import FloatArray, check_increasing

# edges of the layers of the quadrature, m above the site; eight Gauss-Legendre nodes in each
_EDGES_M = np.array([0.0, 50.0, 200.0, 600.0, 1500.0, 3e3, 5e3, 8e3, 12e3, 17e3, 23e3, 30e3, 40e3, 55e3, 80e3, 130e3])
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
ITERATIONS = 12


@dataclass(frozen=True)
class Refractivity:
    """Refractivity against height: measured values where given, exponential above them (and everywhere without).

    Parameters
    ----------
    surface : float
        ``N`` at sea level, N-units (parts in a million).
    scale_height_m : float
    height_m, measured : (n,) float
        Heights above the ellipsoid, increasing, and ``N`` there; interpolated in the logarithm, held below the lowest.
    """

    surface: float
    scale_height_m: float
    height_m: FloatArray | None = None
    measured: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check once."""
        if self.height_m is not None:
            check_increasing("refractivity heights", self.height_m)

    def at(self, height_m: FloatArray) -> FloatArray:
        """``N`` at heights ``(...)`` above the ellipsoid."""
        if self.height_m is None or self.measured is None:
            return self.surface * np.exp(-height_m / self.scale_height_m)
        inside = np.exp(np.interp(height_m, self.height_m, np.log(self.measured)))
        above = np.maximum(height_m - self.height_m[-1], 0.0)
        return inside * np.exp(-above / self.scale_height_m)


def site_radius_m(latitude_rad: float, height_m: float) -> float:
    """Radius of the osculating sphere at a site (Gaussian mean of the ellipsoid's curvatures) plus its height, m."""
    e2 = earth.FLATTENING * (2.0 - earth.FLATTENING)
    return earth.SEMI_MAJOR_M * float(np.sqrt(1.0 - e2) / (1.0 - e2 * np.sin(latitude_rad) ** 2)) + height_m


def refracted(
    range_m: FloatArray, elevation_rad: FloatArray, latitude_rad: float, height_m: float, air: Refractivity
) -> tuple[FloatArray, FloatArray]:
    """What bending adds to elevation and delay to range.

    Parameters
    ----------
    range_m, elevation_rad : (n,) float
        True slant range and elevation from the site; elevations above about 0.5 deg.
    latitude_rad, height_m : float
        Of the site.
    air : Refractivity

    Returns
    -------
    range_excess_m, elevation_excess_rad : (n,) float
        Apparent minus true, both positive in air that thins upwards.
    """
    r0 = site_radius_m(latitude_rad, height_m)
    across, up = range_m * np.cos(elevation_rad), r0 + range_m * np.sin(elevation_rad)
    target = np.hypot(across, up)
    edges = np.minimum(_EDGES_M, (target - r0)[:, None])
    top = r0 + edges[:, -1]
    half = 0.5 * np.diff(edges, axis=1)[..., None]
    h = (edges[:, :-1, None] + half * (1.0 + _NODES)).reshape(len(range_m), -1)
    weight = (half * _WEIGHTS).reshape(len(range_m), -1)
    n = 1.0 + 1e-6 * air.at(height_m + h)
    n0 = 1.0 + 1e-6 * float(air.at(np.array(height_m)))
    # sqrt((n r)^2 - a^2) without loss of digits: with n r = n0 r0 + rise, it is rise (2 n0 r0 + rise) + (n0 r0 sin E)^2
    rise = n * h + (n - n0) * r0
    r = r0 + h
    apparent = elevation_rad.copy()
    for _ in range(ITERATIONS):
        root = np.sqrt(rise * (2.0 * n0 * r0 + rise) + (n0 * r0 * np.sin(apparent))[:, None] ** 2)
        a = n0 * r0 * np.cos(apparent)
        straight = _straight(a, target) - _straight(a, top)
        centre = np.sum(weight * a[:, None] / (r * root), axis=1) + straight[0]
        reached = np.arctan2(target * np.cos(centre) - r0, target * np.sin(centre))
        apparent += elevation_rad - reached
    length = np.sum(weight * n**2 * r / root, axis=1) + straight[1]
    return length - range_m, apparent - elevation_rad


def _straight(nearest_m: FloatArray, radius_m: FloatArray) -> FloatArray:
    """Angle at the centre and length ``(2, n)`` of a straight ray from its nearest point out to a radius."""
    ratio = np.minimum(nearest_m / radius_m, 1.0)
    return np.stack([np.arccos(ratio), radius_m * np.sqrt(1.0 - ratio**2)])

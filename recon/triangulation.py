"""Where is the vehicle, by angles and ranges of several sites, none of which fixes a position by itself?

At times of the sites' readings, at most two a second, the others' readings are interpolated where they have some on
both sides within `_BRIDGED_S`. With three components or more a point is their weighted least-squares solution
(`flightmodel.least_squares`), started on a site's ray where there is one, else above the sites. Points whose normal
matrix is nearly singular (rays that are parallel, ranges from sites on a line) are left out. The filter takes the
readings themselves; from these points it only starts.

References
----------
T. Foy, "Position-location solutions by Taylor-series estimation", IEEE Trans. AES 12 (1976) 187.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.least_squares import Estimate, Linearised, least_squares
from recon.measurements import RADAR, Instrument, sight, sight_partials, wrapped

_BRIDGED_S = 3.0  # over which a parabola's chord is off by some tens of metres at 10 m/s2: enough to linearise about
_WORST_SD_M = 5e3  # of a point: beyond it the filter would linearise far from the path
_SETTLED_SD = 1e-3  # of a point: its readings are known to some metres at the best


def triangulated(sites: tuple[Instrument, ...]) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and points (k, 3), ECEF m, at which readings of several sites together fix a position."""
    if len(sites) < 2:
        return np.empty(0), np.empty((0, 3))
    t = np.unique(np.concatenate([site.time_s for site in sites]))
    t = t[np.unique(np.floor(t / 0.5), return_index=True)[1]]
    readings = np.array([_at(site, t) for site in sites])  # (sites, n, 3)
    weights = np.array([_weights(site) for site in sites])
    enough = np.isfinite(readings).sum(axis=(0, 2)) >= 3
    t, readings = t[enough], readings[:, enough]
    out, good = np.empty((len(t), 3)), np.zeros(len(t), dtype=bool)
    before = None
    for k in range(len(t)):
        point = _point(sites, readings[:, k], weights, before)
        good[k] = point.converged and point.condition < 1e12 and np.trace(point.covariance) < _WORST_SD_M**2
        out[k] = point.value
        before = out[k] if good[k] else before
    return t[good], out[good]


def _weights(site: Instrument) -> FloatArray:
    """One over the usual noise of each component (3,); 0 where there is none."""
    out = np.zeros(3)
    for k, variance in enumerate(site.variance.T):
        measured = variance[np.isfinite(variance)]
        out[k] = 1.0 / np.sqrt(np.median(measured)) if len(measured) else 0.0
    return out


def _at(site: Instrument, t: FloatArray) -> FloatArray:
    """Readings (n, 3) of a site at other times; NaN where it has none near on both sides."""
    out = np.full((len(t), 3), np.nan)
    for k in range(3):
        rows = np.isfinite(site.variance[:, k])
        at = site.time_s[rows]
        if not len(at):
            continue
        values = site.value[rows, k]
        after = np.searchsorted(at, t)
        gap = at[np.minimum(after, len(at) - 1)] - at[np.maximum(after - 1, 0)]
        inside = (t >= at[0]) & (t <= at[-1]) & (gap <= _BRIDGED_S)
        out[inside, k] = np.interp(t[inside], at, np.unwrap(values) if k == 1 else values)
    return out


def _point(
    sites: tuple[Instrument, ...], readings: FloatArray, weights: FloatArray, before: FloatArray | None
) -> Estimate:
    """Least-squares point (3,) of readings (sites, 3), whose noise is one over ``weights``."""

    def linearised(at: FloatArray) -> Linearised:
        ned = [site.dcm @ (at - site.site_ecef_m) for site in sites]
        missed = np.array([wrapped(RADAR, read - sight(*one)) for read, one in zip(readings, ned, strict=True)])
        partials = np.array([sight_partials(*one) @ site.dcm for site, one in zip(sites, ned, strict=True)])
        there = np.isfinite(missed)
        return Linearised.of(missed[there], partials[there], weights[there] ** 2)

    return least_squares(linearised, _first_guess(sites, readings) if before is None else before, _SETTLED_SD)


def _first_guess(sites: tuple[Instrument, ...], readings: FloatArray) -> FloatArray:
    """Where the rays pass nearest, on one ray at its range, or above the sites at their ranges."""
    rays = np.array(np.isfinite(readings[:, 1:]).all(axis=1))
    places = np.array([site.site_ecef_m for site in sites])
    up = places.mean(axis=0) / np.linalg.norm(places.mean(axis=0))
    ranges = readings[np.isfinite(readings[:, 0]), 0]
    if not rays.any():
        return np.asarray(places.mean(axis=0) + up * ranges.mean())
    along = []
    for site, (_, az, el) in zip(sites, readings, strict=True):
        along.append(np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), -np.sin(el)]) @ site.dcm)
    if rays.sum() == 1:
        k = int(np.argmax(rays))
        return np.asarray(places[k] + along[k] * (ranges.mean() if len(ranges) else 1e5))
    across = [np.eye(3) - np.outer(u, u) for u, there in zip(along, rays, strict=True) if there]
    met = sum(a @ p for a, p in zip(across, places[rays], strict=True))
    return np.asarray(np.linalg.lstsq(sum(across, np.zeros((3, 3))), met, rcond=None)[0])

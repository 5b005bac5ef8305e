"""Compiled primitives of the Earth and of attitudes, shared by the simulator's and the filter's kernels.

Readable twins: `flightmodel.earth`, `flightmodel.rotations`. Importing this module also points numba's cache at a
folder whose name carries a hash of every kernel source: numba does not notice a change in a callee of another file,
so a stale cache must not be reachable.
"""

from __future__ import annotations

import hashlib
import importlib.util
import math
import os
from pathlib import Path

import numba

# Contraction and reordering are allowed; assuming away NaN is not: telemetry marks gaps with it.
FASTMATH = {"contract", "reassoc", "arcp", "nsz", "afn"}


def _point_cache_at_these_sources() -> None:
    digest = hashlib.sha256(numba.__version__.encode())
    for package in ("flightmodel", "recon", "estimators", "synthetic_flight"):
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            source = Path(folder) / "_kernels.py"
            if source.exists():
                digest.update(source.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    cache = Path(os.environ.get("NUMBA_CACHE_DIR") or base / "postflight") / f"kernels-{digest.hexdigest()[:16]}"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:  # a read-only home: numba compiles anew, which is slow but right
        return
    numba.config.CACHE_DIR = str(cache)


_point_cache_at_these_sources()


def kernel(function):
    """Compile with the project's settings."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FASTMATH)(function)


A_WGS84 = 6378137.0
F_WGS84 = 1.0 / 298.257223563
E2_WGS84 = F_WGS84 * (2.0 - F_WGS84)
B_WGS84 = A_WGS84 * (1.0 - F_WGS84)
GM_WGS84 = 3.986004418e14
J2_WGS84 = 1.082629821313e-3
OMEGA_WGS84 = 7.292115e-5


@kernel
def gravitation(x, y, z):
    """J2 gravitation at a point with components along axes whose z is the Earth's, m/s^2."""
    r2 = x * x + y * y + z * z
    r = math.sqrt(r2)
    g = -GM_WGS84 / (r2 * r)
    k = 1.5 * J2_WGS84 * A_WGS84 * A_WGS84 / r2
    s = 5.0 * z * z / r2
    lateral = g * (1.0 + k * (1.0 - s))
    return lateral * x, lateral * y, g * (1.0 + k * (3.0 - s)) * z


@kernel
def geodetic(x, y, z):
    """Sine and cosine of geodetic latitude and height above WGS-84 (Bowring's formula, below 1 mm to 1000 km)."""
    p = math.sqrt(x * x + y * y)
    r = math.sqrt(p * p + z * z)
    tu = z / (p + 1e-300) * (1.0 - F_WGS84) * (1.0 + E2_WGS84 / (1.0 - E2_WGS84) * B_WGS84 / r)
    cu = 1.0 / math.sqrt(1.0 + tu * tu)
    su = tu * cu
    num = z + E2_WGS84 / (1.0 - E2_WGS84) * B_WGS84 * su * su * su
    den = p - E2_WGS84 * A_WGS84 * cu * cu * cu
    norm = math.sqrt(num * num + den * den)
    sin_lat = num / norm
    cos_lat = den / norm
    n = A_WGS84 / math.sqrt(1.0 - E2_WGS84 * sin_lat * sin_lat)
    height = p * cos_lat + z * sin_lat - A_WGS84 * A_WGS84 / n
    return sin_lat, cos_lat, height


@kernel
def dcm_from_quaternion(w, x, y, z, out):
    """Direction cosine matrix of a unit quaternion, into ``out`` (3, 3)."""
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@kernel
def boxplus(q, d0, d1, d2):
    """Turn the quaternion ``q`` (4,) in place by the rotation vector (d0, d1, d2), rad, and renormalise it."""
    half2 = 0.25 * (d0 * d0 + d1 * d1 + d2 * d2)
    half = math.sqrt(half2)
    c = math.cos(half)
    s = 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0 - half2 / 6.0)
    w, x, y, z = q[0], q[1], q[2], q[3]
    ex, ey, ez = s * d0, s * d1, s * d2
    q0 = w * c - x * ex - y * ey - z * ez
    q1 = w * ex + x * c + y * ez - z * ey
    q2 = w * ey - x * ez + y * c + z * ex
    q3 = w * ez + x * ey - y * ex + z * c
    n = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q[0], q[1], q[2], q[3] = q0 * n, q1 * n, q2 * n, q3 * n

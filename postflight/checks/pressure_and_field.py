"""Do barometer and magnetometer fit the track, and does the field rotate in the body as the gyros indicate?

Heights by pressure change as a track's do; the magnetometer's magnitude is within a factor of five of the Earth's field
(IGRF) at the track. A field that is fixed in space rotates in the body as ``db/dt = (b - b0) x w``, with ``b0`` the
vehicle's own iron. Every order and sign of the gyros' axes is tried, with a scale: the declared one is suspicious only
where it explains little of the rotation and another explains nearly all.

Assumptions: iron is fixed in the body; the field hardly changes along the path within a cell.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, tables
from flightmodel.checks import FloatArray, Issue
from flightmodel.flightfolder import Sources
from flightmodel.geomagnetism_and_sun import magnetic_field_ned_t
from flightmodel.telemetry import BarometerRecord, TriadRecord
from postflight.checks.units_and_axes import (
    AS_DECLARED,
    all_axes,
    axes_matrix,
    axes_named,
    interval_around,
    slope_through_mean,
    unit_hint,
    unit_of,
    unit_that_explains,
    window_means,
)

_DECADE = 5.0  # iron and calibration change a field's magnitude by less
_CELL_RAD = 0.3  # rotation within a cell: as long as the field's direction allows, against the readings' noise
_EXPLAINED = 0.6  # of the rotation's square; noise and iron that is not fixed are the rest
_MOST_SAMPLES = 4000  # enough for two numbers, and quick on a long flight
_LARGEST_LAG_S, _COARSE_S = 0.5, 0.025  # of a clock set to half a second; a sixteenth of a turn at 2.5 Hz


def barometer_unit(found: Sources, record: BarometerRecord, time_s: FloatArray, height_m: FloatArray) -> list[Issue]:
    """Check a barometer's unit by its changes of height against a track's: ``unit-suspect`` or none.

    The track has heights above the ellipsoid (n,) at its times (n,).
    """
    name = record.spec.name
    entry = found.spec.barometers[name]
    if "height" not in entry.columns and "pressure" in entry.columns:
        return []
    t = record.time_s[np.isfinite(record.height_m)]
    inside = (t > time_s[0]) & (t < time_s[-1])
    inside &= interval_around(time_s, t) < 5.0
    if inside.sum() < 20:
        return []
    own = record.height_m[np.isfinite(record.height_m)][inside]
    track = np.interp(t[inside], time_s, height_m)
    if np.ptp(track) < 500.0:
        return []
    ratio, sd = slope_through_mean(own, track)
    declared = unit_of(entry, tables.BAROMETER[0])
    hint = unit_hint(declared, unit_that_explains(ratio, declared, 0.1))
    if not hint or sd > 0.05 * ratio:
        return []
    words = f"its height changes by 1/{ratio:.3g} of the track's{hint}"
    return [Issue(words, "unit-suspect", name, float(t[inside][0]), float(t[inside][-1]))]


def field_size(found: Sources, time_s: FloatArray, position_ecef_m: FloatArray) -> list[Issue]:
    """Check the magnitude of the magnetometer's reading against the Earth's field: ``unit-suspect`` or none.

    Parameters
    ----------
    found : Sources
    time_s : (n,) float
    position_ecef_m : (n, 3) float
        Of a track.
    """
    record = found.triads.get("magnetometer")
    if record is None:
        return []
    rows = (record.time_s >= time_s[0]) & (record.time_s <= time_s[-1])
    seen = np.linalg.norm(record.measured_sensor[rows], axis=1)
    seen = seen[np.isfinite(seen)]
    if len(seen) < 20:
        return []
    where = position_ecef_m[np.linspace(0, len(position_ecef_m) - 1, 20).astype(int)]
    lat, lon, height = earth.geodetic_from_ecef(where)
    expected = float(np.median(np.linalg.norm(magnetic_field_ned_t(lat, lon, height, found.spec.t0_utc), axis=1)))
    ratio = expected / max(float(np.median(seen)), 1e-30)
    if 1 / _DECADE < ratio < _DECADE:
        return []
    source = found.spec.sensors.magnetometer
    assert source is not None
    declared = unit_of(source, tables.MAGNETOMETER[0])
    hint = unit_hint(declared, unit_that_explains(ratio, declared, np.log(3.0)))
    words = f"reads {1e6 * float(np.median(seen)):.3g} uT where the Earth's field is {1e6 * expected:.3g} uT{hint}"
    times = record.time_s[rows]
    return [Issue(words, "unit-suspect", "magnetometer", float(times[0]), float(times[-1]))]


def field_rotation(found: Sources) -> tuple[list[Issue], tuple[float, float] | None]:
    """Compare the gyros with the rotation of the magnetic field in the body.

    Returns
    -------
    findings : list of Issue
        ``axes-suspect``, ``unit-suspect``, or none.
    lag : (float, float) or None
        How late the magnetometer's time tags are against the gyros', s, and its standard deviation; None where the
        gyros do not explain the rotation.
    """
    gyros, field = found.triads.get("rates"), found.triads.get("magnetometer")
    source = found.spec.sensors.rates
    if gyros is None or field is None or source is None:
        return [], None
    grid = _grid(gyros, field, _CELL_RAD)
    if grid is None:
        return [], None
    w, b = _on(gyros, grid), _on(field, grid)
    if not np.isfinite(w).all() or not np.isfinite(b).all():
        return [], None
    change = np.gradient(b, grid, axis=0)
    shares = {axes: _explained(w @ axes_matrix(*axes).T, b, change) for axes in all_axes()}
    own, scale = shares[AS_DECLARED]
    best = max(share for share, _ in shares.values())
    span = (float(grid[0]), float(grid[-1]))
    if best > _EXPLAINED and own < 0.5 * best:
        near = [axes for axes, (share, _) in shares.items() if share > best - 0.02]
        others = " or ".join(axes_named(*axes) for axes in near[:3])
        words = (
            f"explain {100 * own:.0f} % of the field's rotation in the body; with body x, y, z read from {others} it "
            f"is {100 * best:.0f} %: check order, signs and both mounts"
        )
        return [Issue(words, "axes-suspect", "rates", *span)], None
    out: list[Issue] = []
    if own > _EXPLAINED and not 0.8 < scale < 1.25:
        declared = unit_of(source, tables.RATES[0])
        hint = unit_hint(declared, unit_that_explains(scale, declared, 0.2))
        out.append(
            Issue(f"the field rotates {scale:.3g} times as fast as they read{hint}", "unit-suspect", "rates", *span)
        )
    return out, _lag(gyros, field) if own > _EXPLAINED else None


def _grid(gyros: TriadRecord, field: TriadRecord, cell_rad: float) -> FloatArray | None:
    """Even times of cells in which the body rotates by ``cell_rad`` or less; None where the two hardly overlap."""
    start, end = max(gyros.time_s[0], field.time_s[0]), min(gyros.time_s[-1], field.time_s[-1])
    rows = (gyros.time_s >= start) & (gyros.time_s <= end)
    if rows.sum() < 50:
        return None
    size = np.linalg.norm(gyros.measured_sensor[rows], axis=1)
    fast = float(np.nanpercentile(size, 95))
    if not fast > 0.0:
        return None
    step = max(float(np.median(np.diff(field.time_s))), (end - start) / _MOST_SAMPLES, min(cell_rad / fast, 1.0))
    return np.arange(start + step, end - step, step)


def _on(record: TriadRecord, grid: FloatArray) -> FloatArray:
    """Means of a triad, body axes, over the cells of an even grid (n, 3)."""
    whole = np.isfinite(record.measured_sensor).all(axis=1)
    t, v = record.time_s[whole], record.measured_sensor[whole] @ record.spec.dcm_body_sensor.T
    step = grid[1] - grid[0]
    return window_means(t, v, grid, -step, step)


def _explained(w: FloatArray, b: FloatArray, change: FloatArray) -> tuple[float, float]:
    """Fraction of the squared rotation that ``w`` explains, and the scale of ``w``."""
    # db/dt = k b x w + w x (k b0): linear in k and k b0
    design = np.stack([np.cross(b, w).ravel(), *(np.cross(w, axis).ravel() for axis in np.eye(3))])
    design = design / (norm := np.sqrt(np.maximum(np.einsum("ik,ik->i", design, design), 1e-300)))[:, None]
    wanted = change.ravel()
    # normal equations: four columns of one size need no better
    fit = np.linalg.pinv(np.einsum("ik,jk->ij", design, design)) @ np.einsum("ik,k->i", design, wanted)
    residual = wanted - np.einsum("i,ik->k", fit, design)
    fit = fit / norm
    total = float(change.ravel() @ change.ravel())
    share = 1.0 - float(residual @ residual) / total if total > 0.0 and fit[0] > 0.0 else 0.0
    return share, float(fit[0])


def _lag(gyros: TriadRecord, field: TriadRecord) -> tuple[float, float] | None:
    """Delay of the magnetometer against the gyros, s, with its sd: maximum of a parabola through the best lags."""
    grid = _grid(gyros, field, 0.0)  # as fine as can be: lags show in what happens fast
    if grid is None:
        return None
    b = _on(field, grid)
    change = np.gradient(b, grid, axis=0)
    step = grid[1] - grid[0]
    coarse = np.arange(-_LARGEST_LAG_S, _LARGEST_LAG_S + 1e-9, _COARSE_S)
    near = coarse[int(np.argmax([_explained(_on(gyros, grid - lag), b, change)[0] for lag in coarse]))]
    lags = near + np.arange(-_COARSE_S, _COARSE_S + 1e-9, max(step / 2, 0.005))
    shares = [_explained(_on(gyros, grid - lag), b, change)[0] for lag in lags]
    k = int(np.argmax(shares))
    if not 0 < k < len(lags) - 1:
        return None
    low, mid, high = shares[k - 1 : k + 2]
    spacing = lags[1] - lags[0]
    curvature = (2 * mid - low - high) / spacing**2
    if curvature <= 0.0:
        return None
    lag = float(lags[k] + 0.5 * spacing * (high - low) / (2 * mid - low - high))
    # residuals of neighbouring samples go together: a tenth of them is taken as independent
    return lag, float(np.sqrt(2.0 * (1.0 - mid) / curvature / (0.1 * 3 * len(grid))))

"""Do gyros turn the accelerometer's force so that it points where the track's force points?

The force's direction in the body, turned by the integrated rates from every scale and every order and sign of the axes,
is laid over the track's by one rotation (Wahba's problem, solved by singular values). Declared rates are doubted only
where the force then wanders by far more than the track allows and exactly another reading brings it to rest. Rates that
are read far too small stay unseen: a body that hardly turns is no contradiction where the force hardly does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flightmodel import columns, rotations
from flightmodel.checks import FloatArray
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding
from postflight.intake.axes import all_axes, matrix, named
from postflight.intake.track import TrackForce
from postflight.intake.units import unit_of, unit_that_explains

CELL_S = 0.05
SPAN_S = 60.0  # in which a gyro's bias of 0.2 deg/s adds 12 deg
CLEAR = 12.0  # standard deviations of a window's force, so that its direction is known to 5 deg
LEAST_WINDOWS = 6
WRONG_RAD, RIGHT_RAD = np.deg2rad(30.0), np.deg2rad(12.0)
DEGREE = np.pi / 180.0
Reading = tuple[float, tuple[int, ...], tuple[int, ...]]
AS_DECLARED: Reading = (1.0, (0, 1, 2), (1, 1, 1))


def turned_force(found: Sources, force: TrackForce) -> list[Finding]:
    """Tell of gyros that turn the force out of where the track has it."""
    gyros, sensed = found.triads.get("rates"), found.triads.get("accelerometer")
    source = found.spec.sensors.rates
    if gyros is None or sensed is None or source is None:
        return []
    size, sd = force.size()
    clear = np.flatnonzero(size > CLEAR * sd)
    if not len(clear):
        return []
    middle = force.time_s[clear[int(np.argmax(size[clear]))]]
    clear = clear[np.abs(force.time_s[clear] - middle) < SPAN_S / 2]
    times = force.time_s[clear]
    if len(clear) < LEAST_WINDOWS:
        return []
    grid = np.arange(times[0] - force.width_s / 2, times[-1] + force.width_s / 2, CELL_S)
    w, a = (
        cell_means(record.time_s, record.measured_sensor @ record.spec.dcm_body_sensor.T, grid)
        for record in (gyros, sensed)
    )
    if not (np.isfinite(w).all() and np.isfinite(a).all()):
        return []
    readings: list[Reading] = [(scale, *axes) for scale in (1.0, DEGREE, 1.0 / DEGREE) for axes in all_axes()]
    off = _wander(readings, grid, w, a, force, clear)
    best, own = int(np.argmin(off)), readings.index(AS_DECLARED)
    if off[own] < WRONG_RAD or off[best] > RIGHT_RAD:
        return []
    scale, *axes = readings[best]
    said = f"turn the force {np.rad2deg(off[own]):.0f} deg out of where the track has it"
    near = [r for r, value in zip(readings, off, strict=True) if value < max(2 * off[best], RIGHT_RAD)]
    if all(r[1:] == AS_DECLARED[1:] for r in near):
        declared = unit_of(source, columns.RATES[0])
        unit = unit_that_explains(scale, declared)
        words = f"{said}: taken as '{declared}', they look like '{unit}'"
    elif all(r[0] == 1.0 for r in near):
        words = f"{said}; with body x, y, z read from {named(*axes)} it is {np.rad2deg(off[best]):.0f} deg"
    else:
        words = f"{said}: check their unit, order and signs"
    return [Finding("rates", words, float(times[0]), float(times[-1]))]


def cell_means(time_s: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """Means of columns (n, 3) over cells that begin at the grid's times; NaN in gaps of 0.5 s and beyond the ends."""
    whole = np.isfinite(values).all(axis=1)
    t, v = time_s[whole], values[whole]
    if len(t) < 2:
        return np.full((len(grid), 3), np.nan)
    total = np.vstack([np.zeros(3), np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t)[:, None], axis=0)])
    ends = [np.column_stack([np.interp(grid + side, t, c) for c in total.T]) for side in (0.0, CELL_S)]
    out = (ends[1] - ends[0]) / CELL_S
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    bad = (grid < t[0]) | (grid + CELL_S > t[-1]) | (t[after] - t[after - 1] > 0.5)
    return np.where(bad[:, None], np.nan, out)


def _wander(
    readings: list[Reading], grid: FloatArray, w: FloatArray, a: FloatArray, force: TrackForce, clear: NDArray[np.intp]
) -> FloatArray:
    """Rms angle between the turned force and the track's for each reading, rad."""
    turn = np.stack([scale * matrix(order, signs) for scale, order, signs in readings])  # (c, 3, 3)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(readings), 1))
    sums = np.zeros((len(readings), len(clear), 3))
    half = 0.5 * force.width_s
    for k, t in enumerate(grid):
        vector = rotations.rotate(q, np.tile(a[k], (len(readings), 1)))
        u = (t - force.time_s[clear]) / half
        sums += vector[:, None, :] * (np.maximum(1 - u * u, 0.0) ** 2)[None, :, None]
        q = rotations.boxplus(q, (turn @ w[k]) * CELL_S)
    told = force.force_mps2[clear] / np.linalg.norm(force.force_mps2[clear], axis=1)[:, None]
    out = np.empty(len(readings))
    for c, vectors in enumerate(sums):
        seen = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)[:, None]
        left, _, right = np.linalg.svd(told.T @ seen)
        best = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        angle = np.arccos(np.clip(np.einsum("ki,ki->k", told, seen @ best.T), -1.0, 1.0))
        out[c] = float(np.sqrt(np.mean(angle**2)))
    return out

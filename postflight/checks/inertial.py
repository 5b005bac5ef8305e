"""Every way in which three columns can be taken for three body axes: 6 orders with 8 signs.

Does the accelerometer read what its unit and its axes say, by rest, by the track and by the way an entry flies?

Do gyros turn the accelerometer's force so that it points where the track's force points?

The force's direction in the body, turned by the integrated rates from every scale and every order and sign of the axes,
is laid over the track's by one rotation (Wahba's problem, solved by singular values). Declared rates are doubted only
where the force then wanders by far more than the track allows and exactly another reading brings it to rest. Rates that
are read far too small stay unseen: a body that hardly turns is no contradiction where the force hardly does.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from flightmodel import earth, rotations, tables
from flightmodel.checks import FloatArray
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding, TriadRecord
from postflight.checks.track_force import Comparison, TrackForce, unit_of, unit_that_explains

Axes = tuple[tuple[int, ...], tuple[int, ...]]


def all_axes() -> list[Axes]:
    """All 48; the first is x, y, z as they stand."""
    return [(order, signs) for order in permutations(range(3)) for signs in product((1, -1), repeat=3)]


def matrix(order: Sequence[int], signs: Sequence[int]) -> FloatArray:
    """Return the matrix (3, 3) that makes body components of the columns."""
    return np.asarray(np.eye(3)[list(order)] * np.array(signs)[:, None])


def named(order: Sequence[int], signs: Sequence[int]) -> str:
    """Name the columns that stand for body x, y and z, as rates: ``+q, -p, +r``."""
    return ", ".join(f"{'+' if s > 0 else '-'}{'pqr'[k]}" for k, s in zip(order, signs, strict=True))


REST_S = 2.0
REST_SPREAD = 0.02  # of the reading's size: what stands still is steadier
REST_RATE_RADPS = 0.02
FAR = 1.2  # a factor that no accelerometer's scale error makes
SURE = 6.0  # standard deviations
LEAST_DRAG = 0.5  # share of the force along -x of the body on an entry: 60 deg of total angle of attack
STRONG_MPS2 = 5.0


def at_rest(found: Sources) -> list[Finding]:
    """Tell of an accelerometer that stands still, at the record's start or end, and does not read 9.8 m/s^2."""
    record, rates = found.triads.get("accelerometer"), found.triads.get("rates")
    if record is None or rates is None:
        return []
    for start in (record.time_s[0], record.time_s[-1] - REST_S):
        rows = (record.time_s >= start) & (record.time_s <= start + REST_S)
        turning = rates.measured_sensor[(rates.time_s >= start) & (rates.time_s <= start + REST_S)]
        turning = turning[np.isfinite(turning).all(axis=1)]
        size = np.linalg.norm(record.measured_sensor[rows], axis=1)
        size = size[np.isfinite(size)]
        if len(size) < 20 or not len(turning) or np.abs(turning.mean(axis=0)).max() > REST_RATE_RADPS:
            continue
        mean = float(size.mean())
        if size.std() > REST_SPREAD * mean:
            continue
        declared = accelerometer_unit(found)
        unit = unit_that_explains(earth.STANDARD_GRAVITY_MPS2 / mean, declared, 0.02)
        if unit is not None and unit != declared:
            words = (
                f"reads {mean:.4g} m/s^2 where it stands still and 9.81 is expected: flight.toml takes the columns as "
                f"'{declared}', they look like '{unit}'"
            )
            return [Finding("accelerometer", words, float(start), float(start + REST_S))]
    return []


def accelerometer_unit(found: Sources) -> str:
    """Unit in which the accelerometer's columns are read."""
    source = found.spec.sensors.accelerometer
    assert source is not None
    return unit_of(source, tables.ACCELEROMETER[0])


def against_track(found: Sources, tracker: str, seen: Comparison) -> list[Finding]:
    """Tell of an accelerometer that reads several times less or more than the track's own acceleration asks for."""
    if seen.scale <= 0.0 or seen.scale_sd > 0.1 * seen.scale or 1 / FAR < seen.scale < FAR:
        return []
    if abs(np.log(seen.scale)) * seen.scale < SURE * seen.scale_sd:
        return []
    declared = accelerometer_unit(found)
    unit = unit_that_explains(seen.scale, declared, max(0.05, 3.0 * seen.scale_sd / seen.scale))
    words = f"{tracker}'s track asks for {seen.scale:.3g} +- {seen.scale_sd:.2g} times what it reads"
    if unit is not None and unit != declared:
        words += f": flight.toml takes the columns as '{declared}', they look like '{unit}'"
    else:
        words += "; no other unit explains it: check both units"
    return [Finding("accelerometer", words, seen.start_s, seen.end_s)]


def entry_axis(found: Sources, force: TrackForce) -> list[Finding]:
    """Tell of an accelerometer whose largest force on the way down is not a drag along -x of the body."""
    record = found.triads.get("accelerometer")
    if record is None or found.vehicle is None:
        return []
    down = np.einsum("ki,ki->k", force.velocity_mps, force.position_m) < 0.0
    size, sd = force.size()
    # against the flow, or what acts is no drag
    braking = -np.einsum("ki,ki->k", force.force_mps2, _unit(_relative(force)))
    strong = down & (size > 6.0 * sd) & (size > STRONG_MPS2) & (braking > 0.8 * size)
    strong &= (force.time_s > record.time_s[0]) & (force.time_s < record.time_s[-1])
    if strong.sum() < 4:
        return []
    mean, start, end = _sum_sensor(record, force, strong)
    if not mean.any():
        return []
    body = record.spec.dcm_body_sensor @ mean / np.linalg.norm(mean)
    if -body[0] > LEAST_DRAG:
        return []
    axis = int(np.argmax(np.abs(mean)))
    along = f"the sensor's {'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}"
    words = (
        f"the drag on the way down is read mostly along {along}, by its mount [{body[0]:.2f}, {body[1]:.2f}, "
        f"{body[2]:.2f}] in body axes; a vehicle that flies nose first has it along -x: check mount, order of the "
        "columns, signs"
    )
    return [Finding("accelerometer", words, start, end)]


def lever(found: Sources) -> list[Finding]:
    """Tell of gyros that would whirl the accelerometer about the c.g. far harder than it feels."""
    record, rates, vehicle = found.triads.get("accelerometer"), found.triads.get("rates"), found.vehicle
    source = found.spec.sensors.rates
    if record is None or rates is None or vehicle is None or source is None:
        return []
    arm = record.spec.position_from_datum_body_m - vehicle.cg_m
    w = rates.measured_sensor @ rates.spec.dcm_body_sensor.T
    inward = np.linalg.norm(np.cross(w, np.cross(w, arm)), axis=1)
    felt = np.interp(rates.time_s, record.time_s, np.linalg.norm(record.measured_sensor, axis=1))
    own = SURE * (record.spec.noise_sd + record.spec.bias_sd)
    # the arm to the c.g. is known to a centimetre or so: a factor of ten is beyond it
    impossible = inward > 10.0 * (felt + own)
    if np.mean(impossible) < 0.5 or not np.isfinite(inward).any():
        return []
    declared = unit_of(source, tables.RATES[0])
    worst = f"{float(np.nanmedian(inward)):.3g} m/s^2 where it reads {float(np.nanmedian(felt)):.2g}"
    hint = f": taken as '{declared}', they look like 'degps'" if declared == "radps" else ": check their unit"
    words = f"would whirl the accelerometer about the c.g. with {worst} (medians){hint}"
    return [Finding("rates", words, float(rates.time_s[0]), float(rates.time_s[-1]))]


def _relative(force: TrackForce) -> FloatArray:
    """Velocity against the rotating Earth, inertial axes."""
    return force.velocity_mps - np.cross(earth.OMEGA_ECEF_RADPS, force.position_m)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None])


def _sum_sensor(record: TriadRecord, force: TrackForce, use: FloatArray) -> tuple[FloatArray, float, float]:
    times = force.time_s[use]
    half = 0.5 * force.width_s
    rows = np.zeros(len(record.time_s), dtype=bool)
    for t in times:
        rows[slice(*np.searchsorted(record.time_s, [t - half, t + half]))] = True
    seen = record.measured_sensor[rows]
    return seen[np.isfinite(seen).all(axis=1)].sum(axis=0), float(times[0]), float(times[-1])


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
        declared = unit_of(source, tables.RATES[0])
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

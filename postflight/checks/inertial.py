"""Do accelerometer, gyros and attitude prior fit rest, track and descent, in units, axes, signs?

At rest the magnitude of specific force is 9.81 m/s^2. In flight it is that of a track's specific force
(`postflight.checks.track_force`), and in descent a vehicle that flies nose first has its drag along -x of the body.
Gyros that imply a centripetal acceleration ``|w x (w x r)|`` far above the reading are in a wrong unit.

The gyros carry the accelerometer's force to where the track has it: the specific force in the body, ``f_i(t) = q(t)
f_b(t)`` with ``q`` from the integrated rates, is compared with the track's over windows. Among themselves the windows
fix no attitude: one rotation lays the carried forces over the track's (Wahba's problem, SIAM Review 7, 1965, solved by
singular values), for every scale, order and sign of the rates. Declared rates are suspicious only where the force then
wanders by far more than the track allows and exactly another choice brings it to rest. Rates read far too small are not
detected: a body that hardly rotates is no contradiction where the force hardly does. From the attitude prior the
carried force has a direction of its own; the prior is suspicious beyond four standard deviations of itself and of the
gyros' drift since.

Accelerometer and gyros sense one oscillation, at one time and in one set of axes: `recon.oscillation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flightmodel import earth, rotations, tables
from flightmodel.checks import BoolArray, FloatArray, GateError, Issue
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import LARGEST_GAP_S, AttitudePrior, TriadRecord
from flightmodel.vehicle import Vehicle
from postflight.checks.track_force import Comparison, TrackForce
from postflight.checks.units_and_axes import (
    AS_DECLARED,
    Axes,
    TimeBias,
    all_axes,
    axes_matrix,
    axes_named,
    interval_around,
    unit_hint,
    unit_of,
    unit_that_explains,
    window_means,
)

_REST_S = 2.0  # at the record's ends, before release or after landing
_REST_SPREAD = 0.02  # of the reading's magnitude: at rest it is steadier
_REST_RATE_RADPS = 0.02  # 1 deg/s: more than a gyro's bias, less than any flight
_FAR = 1.2  # a factor that no accelerometer's scale error makes
_SURE = 6.0  # standard deviations
_LEAST_DRAG = 0.5  # share of the force along -x of the body on an entry: 60 deg of total angle of attack
_STRONG_MPS2 = 5.0  # half a g of drag, whose direction is the flow's
_Rows = NDArray[np.intp]
_Reading = tuple[float, Axes]
_CELL_S = 0.05  # over which rates up to 1 rev/s turn by 18 deg, integrated by their mean
_GAP_S = 0.5  # beyond it an integrated attitude is lost
_SPAN_S = 60.0  # in which a gyro's bias of 0.2 deg/s adds 12 deg
_CLEAR = 12.0  # standard deviations of a window's force, so that its direction is known to 5 deg
_LEAST_WINDOWS = 6  # so that one strange direction decides nothing
_WRONG_RAD = np.deg2rad(30.0)  # more than the angle of attack may turn the force from the flow
_RATES_RIGHT_RAD, _ATTITUDE_RIGHT_RAD = np.deg2rad(12.0), np.deg2rad(15.0)  # of a gyro's bias; half of wrong
_ATTITUDE_SD = 4.0  # of the stated attitude carried by the gyros
_FARTHEST_S = 600.0  # that gyros are trusted to carry an attitude
_DEGREE = np.pi / 180.0
# slips in writing a quaternion: hint and code, and the order that undoes it (None: the conjugate)
_SLIPS = {
    Issue("with the scalar last, so put its last number first", "attitude-convention"): [3, 0, 1, 2],
    Issue("as from ECEF to body, so change the signs of its last three numbers", "attitude-convention"): None,
}


def sparse(found: Sources) -> list[Issue]:
    """Name sensors sampled too sparsely for the forces of a flight (``too-few-data``)."""
    if found.spec.motion.model == "ballistic":
        return []
    out = []
    for name in ("accelerometer", "rates"):
        record = found.triads.get(name)
        step = 0.0 if record is None or len(record.time_s) < 2 else float(np.median(np.diff(record.time_s)))
        if record is not None and step > 1.01 * LARGEST_GAP_S:
            words = f"samples are usually {step:.3g} s apart: forces at the c.g. need ten a second, an attitude more"
            ends = float(record.time_s[0]), float(record.time_s[-1])
            out.append(Issue(f"{words}; deliver the data at their full rate", "too-few-data", name, *ends))
    return out


def at_rest(found: Sources) -> list[Issue]:
    """Check the accelerometer's unit where it is at rest, at the record's start or end.

    Parameters
    ----------
    found : Sources
        Of a flight folder; without accelerometer or gyros there is no remark.

    Returns
    -------
    list of Issue
        ``unit-suspect``, or none.
    """
    record, rates = found.triads.get("accelerometer"), found.triads.get("rates")
    if record is None or rates is None:
        return []
    for start in (record.time_s[0], record.time_s[-1] - _REST_S):
        rows = (record.time_s >= start) & (record.time_s <= start + _REST_S)
        turning = rates.measured_sensor[(rates.time_s >= start) & (rates.time_s <= start + _REST_S)]
        turning = turning[np.isfinite(turning).all(axis=1)]
        size = np.linalg.norm(record.measured_sensor[rows], axis=1)
        size = size[np.isfinite(size)]
        if len(size) < 20 or not len(turning) or np.abs(turning.mean(axis=0)).max() > _REST_RATE_RADPS:
            continue
        mean = float(size.mean())
        if size.std() > _REST_SPREAD * mean:
            continue
        declared = _accelerometer_unit(found)
        hint = unit_hint(declared, unit_that_explains(earth.STANDARD_GRAVITY_MPS2 / mean, declared, 0.02))
        if hint:
            words = f"reads {mean:.4g} m/s2 at rest, where 9.81 is expected{hint}"
            return [Issue(words, "unit-suspect", "accelerometer", float(start), float(start + _REST_S))]
    return []


def against_track(found: Sources, tracker: str, seen: Comparison) -> list[Issue]:
    """Check the accelerometer's scale against a track's: ``unit-suspect``, ``accelerometer-scale`` or none."""
    if seen.scale <= 0.0 or seen.scale_sd > 0.1 * seen.scale or 1 / _FAR < seen.scale < _FAR:
        return []
    if abs(np.log(seen.scale)) * seen.scale < _SURE * seen.scale_sd:
        return []
    declared = _accelerometer_unit(found)
    hint = unit_hint(declared, unit_that_explains(seen.scale, declared, max(0.05, 3.0 * seen.scale_sd / seen.scale)))
    words = f"{tracker}'s track implies {seen.scale:.3g} +/- {seen.scale_sd:.2g} times its reading"
    code = "unit-suspect" if hint else "accelerometer-scale"
    words += hint or "; no other unit explains it: check both units"
    return [Issue(words, code, "accelerometer", seen.start_s, seen.end_s)]


def entry_axis(found: Sources, force: TrackForce) -> list[Issue]:
    """Check that the drag in descent is read along -x of the body: ``axes-suspect`` or none."""
    record = found.triads.get("accelerometer")
    if record is None or found.vehicle is None:
        return []
    descending = np.einsum("ki,ki->k", force.velocity_mps, force.position_m) < 0.0
    size, sd = force.size()
    # opposite to the flow, or it is no drag
    flow = force.relative_velocity_mps
    flow = flow / np.maximum(np.linalg.norm(flow, axis=1), 1e-9)[:, None]
    braking = -np.einsum("ki,ki->k", force.force_mps2, flow)
    strong = descending & (size > 6.0 * sd) & (size > _STRONG_MPS2) & (braking > 0.8 * size)
    strong &= (force.time_s > record.time_s[0]) & (force.time_s < record.time_s[-1])
    if strong.sum() < 4:
        return []
    mean = _sum_of_readings(record, force, strong)
    if not mean.any():
        return []
    body = record.spec.dcm_body_sensor @ mean / np.linalg.norm(mean)
    if -body[0] > _LEAST_DRAG:
        return []
    axis = int(np.argmax(np.abs(mean)))
    words = (
        f"drag in descent is read along the sensor's {'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}, by its mount "
        f"[{body[0]:.2f}, {body[1]:.2f}, {body[2]:.2f}] in body axes; a vehicle flying nose first has [-1, 0, 0]: "
        "check mount, column order, signs"
    )
    times = force.time_s[strong]
    return [Issue(words, "axes-suspect", "accelerometer", float(times[0]), float(times[-1]))]


def lever(found: Sources) -> list[Issue]:
    """Check the gyros' unit by the centripetal acceleration at the accelerometer: ``unit-suspect`` or none."""
    record, rates, vehicle = found.triads.get("accelerometer"), found.triads.get("rates"), found.vehicle
    source = found.spec.sensors.rates
    if record is None or rates is None or vehicle is None or source is None:
        return []
    arm = record.spec.position_from_datum_body_m - vehicle.cg_m
    w = rates.measured_sensor @ rates.spec.dcm_body_sensor.T
    inward = np.linalg.norm(np.cross(w, np.cross(w, arm)), axis=1)
    felt = np.interp(rates.time_s, record.time_s, np.linalg.norm(record.measured_sensor, axis=1))
    own = _SURE * (record.spec.noise_sd + record.spec.bias_sd)
    # the arm from the c.g. is known to a centimetre or so: a factor of ten is beyond it
    impossible = inward > 10.0 * (felt + own)
    if np.mean(impossible) < 0.5 or not np.isfinite(inward).any():
        return []
    declared = unit_of(source, tables.RATES[0])
    hint = unit_hint(declared, "degps") if declared == "radps" else ": check their unit"
    words = (
        f"imply a centripetal acceleration of {float(np.nanmedian(inward)):.3g} m/s2 at the accelerometer, which reads "
        f"{float(np.nanmedian(felt)):.2g} (medians){hint}"
    )
    return [Issue(words, "unit-suspect", "rates", float(rates.time_s[0]), float(rates.time_s[-1]))]


def place(found: Sources) -> list[Issue]:
    """Check that the accelerometer lies between the nose and the aft end: ``sensor-outside`` or none."""
    record, vehicle = found.triads.get("accelerometer"), found.vehicle
    if record is None or vehicle is None:
        return []
    x = float(record.spec.position_from_datum_body_m[0])
    length = vehicle.geometry.centerbody_length_m
    if -length <= x <= 0.0:
        return []
    words = f"lies {x:+.2f} m from the nose, x forward; the vehicle reaches from {-length:.2f} to 0 m: check its sign"
    return [Issue(words, "sensor-outside", "accelerometer")]


def _accelerometer_unit(found: Sources) -> str:
    """Unit in which the accelerometer's columns are read."""
    source = found.spec.sensors.accelerometer
    assert source is not None
    return unit_of(source, tables.ACCELEROMETER[0])


def _sum_of_readings(record: TriadRecord, force: TrackForce, use: BoolArray) -> FloatArray:
    """Sum (3,) of a triad's readings in the windows used, sensor axes."""
    half = 0.5 * force.width_s
    rows = np.zeros(len(record.time_s), dtype=bool)
    for t in force.time_s[use]:
        rows[slice(*np.searchsorted(record.time_s, [t - half, t + half]))] = True
    seen = record.measured_sensor[rows]
    return np.asarray(seen[np.isfinite(seen).all(axis=1)].sum(axis=0))


def gyro_axes(found: Sources, force: TrackForce) -> list[Issue]:
    """Check scale, order and signs of the gyros by the specific force rotated with their rates.

    Parameters
    ----------
    found : Sources
        Of a flight folder; without accelerometer and gyros there is no remark.
    force : TrackForce
        Of a track that is not suspicious.

    Returns
    -------
    list of Issue
        ``unit-suspect``, ``axes-suspect``, ``axes-suspect`` (which of both is open), or none.
    """
    gyros, sensed = found.triads.get("rates"), found.triads.get("accelerometer")
    source = found.spec.sensors.rates
    if gyros is None or sensed is None or source is None:
        return []
    size, sd = force.size()
    clear = np.flatnonzero(size > _CLEAR * sd)
    if not len(clear):
        return []
    middle = force.time_s[clear[int(np.argmax(size[clear]))]]
    clear = clear[np.abs(force.time_s[clear] - middle) < _SPAN_S / 2]
    times = force.time_s[clear]
    if len(clear) < _LEAST_WINDOWS:
        return []
    grid = np.arange(times[0] - force.width_s / 2, times[-1] + force.width_s / 2, _CELL_S)
    w, a = (_cells(record, grid) for record in (gyros, sensed))
    if not (np.isfinite(w).all() and np.isfinite(a).all()):
        return []
    readings = [(scale, axes) for scale in (1.0, _DEGREE, 1.0 / _DEGREE) for axes in all_axes()]
    turn = np.stack([scale * axes_matrix(*axes) for scale, axes in readings])
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(readings), 1))
    off = _wander(_carried(level, turn, grid, w, a, force, clear), force.force_mps2[clear])
    own, best = off[readings.index((1.0, AS_DECLARED))], float(off.min())
    if own < _WRONG_RAD or best > _RATES_RIGHT_RAD:
        return []
    near = [r for r, value in zip(readings, off, strict=True) if value < max(2 * best, _RATES_RIGHT_RAD)]
    code, hint = _which(near, readings[int(np.argmin(off))], best, unit_of(source, tables.RATES[0]))
    words = f"carry the specific force {np.rad2deg(own):.0f} deg away from the track's{hint}"
    return [Issue(words, code, "rates", float(times[0]), float(times[-1]))]


def _which(near: list[_Reading], best: _Reading, off_rad: float, declared: str) -> tuple[str, str]:
    """Code and hint for the rates: all good candidates differ by unit alone, by axes alone, or by both."""
    scale, axes = best
    if all(r[1] == AS_DECLARED for r in near):
        return "unit-suspect", unit_hint(declared, unit_that_explains(scale, declared))
    if all(r[0] == 1.0 for r in near):
        return "axes-suspect", f"; with body x, y, z read from {axes_named(*axes)} it is {np.rad2deg(off_rad):.0f} deg"
    return "axes-suspect", ": check their unit, order and signs"


def attitude_prior(found: Sources, force: TrackForce) -> list[Issue]:
    """Check the attitude prior by the specific force rotated with the gyros from it: ``attitude-prior`` or none."""
    prior, gyros, sensed = found.attitude_prior, found.triads.get("rates"), found.triads.get("accelerometer")
    if prior is None or gyros is None or sensed is None:
        return []
    size, sd = force.size()
    half = 0.5 * force.width_s
    clear = np.flatnonzero((size > _CLEAR * sd) & (force.time_s - half > prior.time_s))
    clear = clear[force.time_s[clear] < prior.time_s + _FARTHEST_S]
    if not len(clear):
        return []
    clear = clear[force.time_s[clear] < force.time_s[clear[0]] + _SPAN_S]
    if len(clear) < _LEAST_WINDOWS:
        return []
    grid = np.arange(prior.time_s, force.time_s[clear[-1]] + half, _CELL_S)
    w, a = (_cells(record, grid) for record in (gyros, sensed))
    first = int(np.searchsorted(grid, force.time_s[clear[0]] - half))
    if not (np.isfinite(w).all() and np.isfinite(a[first:]).all()):
        return []
    q = _as_stated_and_slipped(prior, found.spec.body)
    sums = _carried(q, np.tile(np.eye(3), (len(q), 1, 1)), grid, w, np.nan_to_num(a), force, clear)
    track = force.force_mps2[clear]
    cosine = np.einsum("cki,ki->ck", sums, track) / (np.linalg.norm(sums, axis=2) * np.linalg.norm(track, axis=1))
    off = np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2, axis=1))
    if off[0] < max(_WRONG_RAD, _ATTITUDE_SD * _carried_sd_rad(prior, gyros, grid, w)):
        return []
    fitting = [slip for slip, value in zip(_SLIPS, off[1:], strict=True) if value < _ATTITUDE_RIGHT_RAD]
    entry, code = found.spec.attitude_prior, "attitude-prior"
    if entry is None or entry.q_ecef_body is None:
        hint = ": check azimuth_deg, elevation_deg, roll_deg, the place and the time"
    elif len(fitting) == 1:
        hint, code = f"; it fits when read {fitting[0]}", fitting[0].code
    else:
        hint = ": is q_ecef_body scalar first, from body to ECEF, and of that time?"
    words = f"the gyros carry the specific force from it {np.rad2deg(off[0]):.0f} deg away from the track's{hint}"
    return [Issue(words, code, "attitude_prior", prior.time_s, float(force.time_s[clear[-1]]))]


def _as_stated_and_slipped(prior: AttitudePrior, planet: earth.Planet) -> FloatArray:
    """Quaternions (1 + slips, 4), body to inertial axes: as stated, and with each slip undone."""
    q = prior.q_ecef_body
    every = [q, *(rotations.conjugate(q) if order is None else q[order] for order in _SLIPS.values())]
    inertial = rotations.conjugate(earth.q_ecef_eci(prior.time_s, planet))
    return np.array([rotations.multiply(inertial, one) for one in every])


def _carried_sd_rad(prior: AttitudePrior, gyros: TriadRecord, grid: FloatArray, w: FloatArray) -> float:
    """Standard deviation of a correct attitude at the end: the prior's, with the gyros' bias and scale."""
    turned = float(np.linalg.norm(w, axis=1).sum()) * _CELL_S
    s = gyros.spec
    return float(np.linalg.norm([prior.sd_rad.max(), s.bias_sd * (grid[-1] - grid[0]), s.scale_sd * turned]))


def _cells(record: TriadRecord, grid: FloatArray) -> FloatArray:
    """Means (m, 3), body axes, over cells starting at each time of the grid; NaN in gaps and beyond the ends."""
    body = record.measured_sensor @ record.spec.dcm_body_sensor.T
    whole = np.isfinite(body).all(axis=1)
    t, v = record.time_s[whole], body[whole]
    if len(t) < 2:
        return np.full((len(grid), 3), np.nan)
    bad = (grid < t[0]) | (grid + _CELL_S > t[-1]) | (interval_around(t, grid) > _GAP_S)
    return np.where(bad[:, None], np.nan, window_means(t, v, grid, 0.0, _CELL_S))


def _carried(
    q: FloatArray, turn: FloatArray, grid: FloatArray, w: FloatArray, a: FloatArray, force: TrackForce, clear: _Rows
) -> FloatArray:
    """Forces (c, k, 3) of k windows, carried from attitudes (c, 4) by rates: (c, 3, 3) matrices times ``w``."""
    sums = np.zeros((len(q), len(clear), 3))
    half = 0.5 * force.width_s
    for k, t in enumerate(grid):
        u = (t - force.time_s[clear]) / half
        weight = np.maximum(1 - u * u, 0.0) ** 2
        if weight.any():
            sums += rotations.rotate(q, np.tile(a[k], (len(q), 1)))[:, None, :] * weight[None, :, None]
        q = rotations.boxplus(q, (turn @ w[k]) * _CELL_S)
    return sums


def _wander(sums: FloatArray, track_mps2: FloatArray) -> FloatArray:
    """Rms angle (c,), rad, between carried forces (c, k, 3) and the track's (k, 3), after the best rotation of each."""
    track = track_mps2 / np.linalg.norm(track_mps2, axis=1)[:, None]
    out = np.empty(len(sums))
    for c, vectors in enumerate(sums):
        seen = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)[:, None]
        left, _, right = np.linalg.svd(track.T @ seen)
        best = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        angle = np.arccos(np.clip(np.einsum("ki,ki->k", track, seen @ best.T), -1.0, 1.0))
        out[c] = float(np.sqrt(np.mean(angle**2)))
    return out


class Swings(NamedTuple):
    """Remarks about axes, and the time bias of the accelerometer against the gyros; None where nothing shows it."""

    remarks: list[Issue]
    bias: TimeBias | None


def oscillation_of(triads: Mapping[str, TriadRecord], vehicle: Vehicle | None) -> Swings:
    """Compare accelerometer and gyros by the oscillation of the vehicle; ``triads-axes`` or none."""
    # the filter's package, loaded where there are tables alone
    from recon.imu_screening import bridge
    from recon.oscillation import DELIVERED, LAG, LAG_STEP_S, axes_check, oscillation

    force, rate = triads.get("accelerometer"), triads.get("rates")
    if force is None or rate is None:
        return Swings([], None)
    try:
        sensors = bridge(force, 0), bridge(rate, 1)
    except GateError:
        return Swings([], None)
    swings = oscillation(*sensors, -np.inf, np.inf, vehicle)
    if swings is None:
        return Swings([], None)
    if swings.kind in (DELIVERED, LAG):
        return Swings([], TimeBias("accelerometer", "rates", swings.lag_s, LAG_STEP_S / 2.0))
    check = axes_check(swings, *sensors)
    span = float(force.time_s[0]), float(force.time_s[-1])
    return Swings([Issue(check.remark, "triads-axes", "accelerometer, rates", *span)], None)

"""Do the accelerometer's unit and axes fit rest, track and descent, and the gyros' unit the accelerometer?

At rest the magnitude of specific force is 9.81 m/s^2. In flight it is that of a track's specific force
(`postflight.checks.track_force`), and in descent a vehicle that flies nose first has its drag along -x of the body.
Gyros that imply a centripetal acceleration ``|w x (w x r)|`` far above the reading are in a wrong unit.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, tables
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding, TriadRecord
from postflight.checks.track_force import Comparison, TrackForce
from postflight.checks.units_and_axes import unit_hint, unit_of, unit_that_explains

_REST_S = 2.0
_REST_SPREAD = 0.02  # of the reading's magnitude: at rest it is steadier
_REST_RATE_RADPS = 0.02
_FAR = 1.2  # a factor that no accelerometer's scale error makes
_SURE = 6.0  # standard deviations
_LEAST_DRAG = 0.5  # share of the force along -x of the body on an entry: 60 deg of total angle of attack
_STRONG_MPS2 = 5.0


def at_rest(found: Sources) -> list[Finding]:
    """Check the accelerometer's unit where it is at rest, at the record's start or end.

    Parameters
    ----------
    found : Sources
        Of a flight folder; without accelerometer or gyros there is no remark.

    Returns
    -------
    list of Finding
        ``accelerometer-unit``, or none.
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
            return [Finding("accelerometer", words, float(start), float(start + _REST_S), "accelerometer-unit")]
    return []


def against_track(found: Sources, tracker: str, seen: Comparison) -> list[Finding]:
    """Check the accelerometer's scale against a track's: ``accelerometer-unit``, ``accelerometer-scale`` or none."""
    if seen.scale <= 0.0 or seen.scale_sd > 0.1 * seen.scale or 1 / _FAR < seen.scale < _FAR:
        return []
    if abs(np.log(seen.scale)) * seen.scale < _SURE * seen.scale_sd:
        return []
    declared = _accelerometer_unit(found)
    hint = unit_hint(declared, unit_that_explains(seen.scale, declared, max(0.05, 3.0 * seen.scale_sd / seen.scale)))
    words = f"{tracker}'s track implies {seen.scale:.3g} +/- {seen.scale_sd:.2g} times its reading"
    code = "accelerometer-unit" if hint else "accelerometer-scale"
    words += hint or "; no other unit explains it: check both units"
    return [Finding("accelerometer", words, seen.start_s, seen.end_s, code)]


def entry_axis(found: Sources, force: TrackForce) -> list[Finding]:
    """Check that the drag in descent is read along -x of the body: ``accelerometer-axes`` or none."""
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
    return [Finding("accelerometer", words, float(times[0]), float(times[-1]), "accelerometer-axes")]


def lever(found: Sources) -> list[Finding]:
    """Check the gyros' unit by the centripetal acceleration at the accelerometer: ``gyro-unit`` or none."""
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
    return [Finding("rates", words, float(rates.time_s[0]), float(rates.time_s[-1]), "gyro-unit")]


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

"""Does the accelerometer read what its unit and its axes say, by rest, by the track and by the way an entry flies?"""

from __future__ import annotations

import numpy as np

from flightmodel import columns, earth
from flightmodel.checks import FloatArray
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding, TriadRecord
from postflight.intake.track import Comparison, TrackForce
from postflight.intake.units import unit_of, unit_that_explains

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
    return unit_of(source, columns.ACCELEROMETER[0])


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
    declared = unit_of(source, columns.RATES[0])
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

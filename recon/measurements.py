"""What does each instrument measure, how does its reading change with the state, and how large is its noise?

A tracked point at ``d`` from the accelerometer in body axes, tagged ``t``, was observed at ``t - tau`` (``tau``: time
tag minus true time), so

    p = r + C d - tau (v + C (w x d)) + tau^2 a_p / 2 - tau^3 j / 6,     a_p = a + C s,   j = C (w x (f + s))

with ``w`` the body's rate against the Earth at the tag, by the gyros' own clock, ``a`` and ``f`` the acceleration of
the accelerometer and its specific force, and ``s = w' x d + w x (w x d)``; of ``j`` what turns with a fast vehicle.
Errors of the gyros move ``dp/dt`` by ``C (dw x d)``, a clock late by ``e`` by ``dw = e w'``. Then, each plus its errors
and noise:

* radar: range, azimuth, elevation of ``p`` from the site, with the pedestal's errors (RCC 753-95), the lag of its servo
  (below, ``1 + e`` times the one of the path about which one is linearised), residual
  refraction, ``N cot(E)`` for a ray through the whole atmosphere, and errors of the site's survey, its own and those
  common to all sites: with a stated place ``d`` off the true one, ``r = (1 - rho x) (R (p - site) + d)``, where ``rho``
  is the turn of north, east and down over ``d`` on the Earth;
* Doppler: ``u . dp/dt`` along the line of sight ``u``;
* receiver: ``p`` north, east and down of a reference, and its velocity along the same axes;
* barometer: geodetic height of ``p``;
* an accelerometer without gyros, in ballistic flight: the deceleration along the flow, ``(1 + s) a + b`` with
  ``a = rho |u|^2 B e^d / 2`` of `recon.propagation`. The vehicle is taken to be trimmed with body x along the velocity
  against the air, so that body x reads ``-a``: off by an angle ``e`` the axial reading differs by about ``e^2``
  (``C_A = C_D cos e - C_L sin e`` with a lift of ``-e`` of the drag, as a blunt body has), which widens ``s``;
* at rest (`recon.rest`): zero velocity; of the gyros as of a magnetometer, with the Earth's rate for ``B``;
* magnetometer: ``S R(m)^T D^T C^T (B + f) + b``, S with scales and soft iron, m the mounting rotation, D its nominal
  axes, f the error of the field;
* Sun head: azimuth and elevation of ``R(m)^T D^T C^T (s - e u)`` with ``u`` up and ``e`` the weight of the Earth's
  light, of which a part is for heads that have the nadir in their field alone; a head whose tag is late by ``tau``
  reads what was, by the body's rate. No data sheet states ``f``, ``e`` and ``tau``; `recon.vector_attitude` estimates
  them.

A tracker's angle noise is noise of its line of sight: ``angle_sd`` in elevation and in traverse, hence
``angle_sd / cos(elevation)`` in azimuth. `Settings.angle_noise` is ``"axis"`` for a radar whose azimuth readings
scatter by ``angle_sd`` at any elevation.

The compiled prediction of a kind fills ``h`` (3,), ``by_state`` (3, 9) by position, velocity, rotation, and
``by_error`` (3, `SLOTS`) by the source's own errors in the order of `SLOT_NAMES`; ``e`` (SLOTS,) holds their values,
zero where off. Readable twin: `tests.oracles.plain_measurements`.

The antenna follows the target as a second-order servo without velocity lag: damping and integral of the angle's error
drive it, ``F(s) = (2 z w s + w^2) / (s^2 + 2 z w s + w^2)`` with ``w`` its bandwidth and ``z = 1 / sqrt(2)``
(Butterworth), so that the encoders read ``angle + (F - 1) angle``. The lag ``(F - 1) angle``, for slow motion
``- acceleration / w^2``, is that of a path: of the one about which the filter is linearised, made anew for every pass.
What the pass itself moves the path by is smoother than the path, and its own lag the next pass has. A bandwidth that is
not known exactly makes the lag larger or smaller at all times: the error state "servo lag" is the fraction, twice that
of ``1 / w``.

References
----------
RCC 753-95 (dynamic lag). Skolnik, Radar Handbook, 3rd ed., 9.10: errors of servos.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flightmodel import earth, instruments, rotations
from flightmodel._kernels import RATE, boxplus, dcm_from_quaternion, geodetic, gravitation, inlined
from flightmodel.checks import FloatArray, IntArray
from flightmodel.earth import WGS84, Planet
from flightmodel.tables import spacing_s
from flightmodel.telemetry import BarometerRecord, GnssRecord, RadarRecord, SunRecord, TriadRecord
from recon.imu_screening import frozen_rows
from recon.propagation import ballistic_acceleration, cross_into, level, matmul_into, mount_matrices
from recon.state import DRIVERS, ErrorModel, States

RADAR, POSITION, VELOCITY, HEIGHT, FIELD, SUN, RANGE_RATE, DECELERATION = range(8)
REST = "rest"  # zero velocities on the pad
SITES = "sites"  # owner of the errors that are common to all radar sites
DECELERATION_RATE_HZ = 20.0  # of block means: over 50 ms an entry's deceleration is a straight line to 1e-3 m/s^2
COMPONENTS = {
    RADAR: ("range", "azimuth", "elevation"),
    POSITION: ("north", "east", "down"),
    VELOCITY: ("velocity north", "velocity east", "velocity down"),
    HEIGHT: ("height",),
    FIELD: ("field x", "field y", "field z"),
    SUN: ("azimuth", "elevation"),
    RANGE_RATE: ("range rate",),
    DECELERATION: ("deceleration",),
}
_STATES = instruments.RADAR.states
_RANGE_RATE_AT = _STATES.index("range rate bias")  # a reading of its own, with two errors
_OWN_RADAR, _DOPPLER, _LAST = _STATES[:_RANGE_RATE_AT], _STATES[_RANGE_RATE_AT:-2], _STATES[-2:]
# slots of a radar's errors, in the order of the instrument's table; of a survey, north, east and height
(
    RANGE_BIAS, AZIMUTH_BIAS, ELEVATION_BIAS, TIME_BIAS, TILT_NORTH, TILT_EAST, DROOP, SKEW, NON_ORTHOGONALITY,
    TRAVERSE_WANDER, ELEVATION_WANDER, REFRACTION, RANGE_SCALE, SURVEY, _, _, NORTH, SITES_SURVEY, _, _, SITES_NORTH,
    RANGE_WANDER, SERVO_LAG,
) = range(len(_OWN_RADAR) + len(instruments.SITES.states) + len(_LAST))  # fmt: skip
# of a magnetometer the field's error; of a Sun head the Earth's light where it has the nadir in its field, and anywhere
FIELD_ERROR, EARTHLIGHT, EVERYWHERE = 12, 2, 7
# errors that the velocity of a point beside the accelerometer depends on
_GYROS = (*instruments.RATES.states[:9], "time bias")
# time biases stand in a radar's slot
SLOT_NAMES: dict[int, tuple[str, ...]] = {
    RADAR: (*_OWN_RADAR, *instruments.SITES.states, *_LAST),
    RANGE_RATE: (*_DOPPLER, "", _STATES[3], *_GYROS),
    POSITION: instruments.GNSS.states[:4],
    VELOCITY: (*instruments.GNSS.states[4:], instruments.GNSS.states[3], *_GYROS),
    HEIGHT: instruments.BAROMETER.states,
    FIELD: (*instruments.MAGNETOMETER.states, "field x", "field y", "field z"),
    SUN: (*instruments.SUN.states[:2], "earthlight", "time bias", *instruments.SUN.states[2:], "earthlight everywhere"),
    DECELERATION: ("bias", "scale", "", "time bias", *(name for _, name in DRIVERS)),
}
SLOTS = max(map(len, SLOT_NAMES.values()))
_OWNERS = {DECELERATION: dict(enumerate((owner for owner, _ in DRIVERS), start=4))}  # of slots that are not its own
_OWNERS |= dict.fromkeys((VELOCITY, RANGE_RATE), dict.fromkeys(range(4, 14), "rates"))
_OWNERS[SUN] = dict.fromkeys((EARTHLIGHT, TIME_BIAS, EVERYWHERE), "sun")  # of all heads


def component_unit(component: str) -> str:
    """SI unit of a component's readings and residuals."""
    if component.startswith(("field", "rate ")):
        return "T" if component.startswith("field") else "rad/s"
    if component.startswith("velocity") or component == "range rate":
        return "m/s"
    if component == "deceleration":
        return "m/s2"
    return "rad" if component in ("azimuth", "elevation") else "m"


@dataclass(frozen=True)
class Instrument:
    """One source of measurements and all that it measured.

    Parameters
    ----------
    name, kind : str, int
        Name of the source in tables and checks; kind, `RADAR` to `DECELERATION`.
    owner : str
        Instrument whose errors it carries; a receiver's position and velocity share one.
    arm_body_m : (3,) float
        Tracked point from the accelerometer, body axes.
    site_ecef_m : (3,) float
        Radar, or reference of a receiver; of a barometer, the height above which its scale acts, first; of a Sun head,
        the cosine of half its field, first.
    dcm : (3, 3) float
        ``dcm_ned_ecef`` at the site, or ``dcm_body_sensor``.
    time_s : (k,) float
    value, variance, known : (k, 3) float
        As in `recon.state.Observed`.
    group : (k,) int
        Components that are thinned alike share rows; others have rows of their own at the same times.
    spacing_s : (k,) float
        Of rows of one group closer than this some are predicted, not used.
    labels : tuple of str
        Names of its components where they are not those of its kind.
    servo_hz : float
        Bandwidth of a radar's servo; 0 for none.
    """

    name: str
    kind: int
    owner: str
    arm_body_m: FloatArray
    site_ecef_m: FloatArray
    dcm: FloatArray
    time_s: FloatArray
    value: FloatArray
    variance: FloatArray
    known: FloatArray
    group: IntArray
    spacing_s: FloatArray
    labels: tuple[str, ...] = ()
    servo_hz: float = 0.0

    @property
    def components(self) -> tuple[str, ...]:
        """Names of its components."""
        return self.labels or COMPONENTS[self.kind]

    @property
    def count(self) -> IntArray:
        """Components measured in each row, (k,)."""
        return np.isfinite(self.variance).sum(axis=1)

    def joined(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times, values and variances (n, 3) with the components of one instant in one row again."""
        if not self.group.any():
            return self.time_s, self.value, self.variance
        time_s, first, instant = np.unique(self.time_s, return_index=True, return_inverse=True)
        variance: FloatArray = np.full((len(time_s), 3), np.inf)
        np.minimum.at(variance, instant, self.variance)
        return time_s, self.value[first], variance

    def slots(self, model: ErrorModel) -> IntArray:
        """Index of the model's error in each slot (`SLOTS`,); -1 for none."""
        names = SLOT_NAMES[self.kind]
        common = range(len(_OWN_RADAR), len(_OWN_RADAR) + len(instruments.SITES.states))  # to all sites
        shared = _OWNERS.get(self.kind, {})
        owners = [shared.get(k, SITES if k in common else self.owner) for k in range(len(names))]
        found = [model.column(owner, name) if name else -1 for owner, name in zip(owners, names, strict=True)]
        return np.array([*found, *[-1] * (SLOTS - len(found))], dtype=np.int64)


def instrument_of(
    name: str, kind: int, owner: str, arm: FloatArray, site: FloatArray, dcm: FloatArray,
    time_s: FloatArray, value: FloatArray, sd: FloatArray, known: FloatArray | None = None,
    spacing_s: FloatArray | None = None, labels: tuple[str, ...] = (),
) -> Instrument:  # fmt: skip
    """Instrument with NaN readings taken as not measured, rows without any left out.

    Components that are thinned differently, by ``spacing_s`` (k, 1 or 3), become rows of their own, whose variances of
    the others are infinite.
    """
    variance = np.where(np.isfinite(value), np.broadcast_to(sd, value.shape) ** 2, np.inf)
    known = np.zeros((len(value), 3)) if known is None else known
    value = np.where(np.isfinite(value), value, 0.0)
    spacing = np.zeros((len(value), 1)) if spacing_s is None else spacing_s
    columns = [tuple(column) for column in spacing.T.tolist()]
    groups = sorted(set(columns))
    alike, member = np.array(groups).T, np.array([groups.index(column) for column in columns])
    row, group = np.divmod(np.arange(len(value) * len(groups)), len(groups))
    variance = variance[row]
    if len(groups) > 1:
        variance[member != group[:, None]] = np.inf
    keep = np.isfinite(variance).any(axis=1)
    row, group = row[keep], group[keep]
    return Instrument(
        name, kind, owner, np.asarray(arm, dtype=float), np.asarray(site, dtype=float), np.ascontiguousarray(dcm),
        time_s[row], value[row], variance[keep], known[row], group, alike[row, group], labels,
    )  # fmt: skip


def radar_instrument(
    name: str, record: RadarRecord, arm_body_m: FloatArray, traverse: bool = True, planet: Planet = WGS84
) -> Instrument:
    """Instrument of one radar; components may be missing individually."""
    site = record.spec
    sd = _noise(record, [site.range_sd_m, *site.angles_sd_rad], slice(0, 3))
    if traverse:
        elevation = np.where(np.isfinite(record.range_az_el[:, 2]), record.range_az_el[:, 2], 0.0)
        sd[:, 1] /= np.maximum(np.cos(elevation), 1e-3)
    known = np.tile([3.2e-4, 0.0, 0.0], (len(sd), 1))  # n - 1 at a site near the sea
    place = earth.ecef_from_geodetic(*site.geodetic, planet)
    dcm = earth.dcm_ned_ecef(site.latitude_rad, site.longitude_rad)
    made = instrument_of(
        name, RADAR, site.name, arm_body_m, place, dcm, record.time_s, record.range_az_el, sd, known,
        _spacing(record, "range", "az", "el"),
    )  # fmt: skip
    return replace(made, servo_hz=site.angle_servo_hz)


def range_rate_instrument(
    name: str, record: RadarRecord, arm_body_m: FloatArray, planet: Planet = WGS84
) -> Instrument | None:
    """Range rates of one radar or Doppler station; None where it gives none."""
    site = record.spec
    if record.range_rate_mps is None:
        return None
    value = np.column_stack([record.range_rate_mps, np.full((len(record.time_s), 2), np.nan)])
    sd = np.tile(_noise(record, [site.range_rate_sd_mps], slice(3, 4)), 3)
    place = earth.ecef_from_geodetic(*site.geodetic, planet)
    dcm = earth.dcm_ned_ecef(site.latitude_rad, site.longitude_rad)
    return instrument_of(
        f"{name} range rate", RANGE_RATE, site.name, arm_body_m, place, dcm, record.time_s, value, sd,
        spacing_s=_spacing(record, "range_rate"),
    )  # fmt: skip


def _spacing(record: RadarRecord | GnssRecord | BarometerRecord, *components: str) -> FloatArray:
    """Least time (k, components) to the row used before."""
    return np.column_stack([spacing_s(record.every_s, record.time_s, c) for c in components])


def _noise(record: RadarRecord | GnssRecord, stated: list[float], columns: slice | list[int]) -> FloatArray:
    """Noise (n, k) of each reading: its own where the table states it, else the instrument's."""
    sd = np.tile(stated, (len(record.time_s), 1))
    return sd if record.sd is None else np.where(np.isfinite(record.sd[:, columns]), record.sd[:, columns], sd)


def _turned_from(record: GnssRecord, planet: Planet, reference_ecef_m: FloatArray, dcm: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) from north, east, down of each fix to axes ``dcm``; one without a place has the last."""
    there = np.isfinite(record.position_ecef_m).all(axis=1)
    last = np.maximum.accumulate(np.where(there, np.arange(len(record.time_s)), -1))
    near = np.where(last[:, None] < 0, reference_ecef_m, record.position_ecef_m[last])
    latitude, longitude, _ = earth.geodetic_from_ecef(near, planet)
    return np.asarray(dcm @ earth.dcm_ned_ecef(latitude, longitude).transpose(0, 2, 1))


def gnss_instruments(
    name: str,
    record: GnssRecord,
    accelerometer_m: FloatArray,
    planet: Planet = WGS84,
    near_ecef_m: FloatArray | None = None,
) -> list[Instrument]:
    """Position of one receiver and velocity, those of both that it gives.

    Axes are those at its first fix; of a receiver that gives velocities alone, those at ``near_ecef_m`` (3,), without
    which it is of no use. Noise is stated north, east and down of each fix, and is turned into these axes; the
    correlation of two axes that this makes is left out (0.3 where down is twice as noisy, 1400 km on).
    """
    spec = record.spec
    good = np.isfinite(record.position_ecef_m).all(axis=1)
    reference = record.position_ecef_m[good][0] if good.any() else near_ecef_m
    if reference is None:
        return []
    latitude, longitude, _ = earth.geodetic_from_ecef(reference, planet)
    dcm = earth.dcm_ned_ecef(float(latitude), float(longitude))
    arm = spec.antenna_from_datum_body_m - accelerometer_m
    place_sd = _noise(record, [spec.horizontal_sd_m, spec.horizontal_sd_m, spec.vertical_sd_m], [0, 0, 1])
    speed_sd = _noise(record, [spec.speed_sd_mps, spec.speed_sd_mps, spec.vertical_speed_sd_mps], [2, 2, 3])
    place = (record.position_ecef_m - reference) @ dcm.T
    squared = _turned_from(record, planet, reference, dcm) ** 2
    place_sd, speed_sd = (np.sqrt(np.einsum("nij,nj->ni", squared, sd**2)) for sd in (place_sd, speed_sd))
    both = [
        instrument_of(
            name, POSITION, spec.name, arm, reference, dcm, record.time_s, place, place_sd,
            spacing_s=_spacing(record, "position"),
        ),
        instrument_of(
            f"{name} velocity", VELOCITY, spec.name, arm, reference, dcm,
            record.time_s, record.velocity_ecef_mps @ dcm.T, speed_sd,
            spacing_s=_spacing(record, "velocity"),
        ),
    ]  # fmt: skip
    return [i for i in both if len(i.time_s)]


def barometer_instrument(name: str, record: BarometerRecord, accelerometer_m: FloatArray) -> Instrument:
    """Pressure height as a measurement of the datum's height."""
    first = next(iter(record.height_m[np.isfinite(record.height_m)]), 0.0)
    value = np.column_stack([record.height_m, np.full((len(record.height_m), 2), np.nan)])
    return instrument_of(
        name, HEIGHT, record.spec.name, -accelerometer_m, np.array([first, 0.0, 0.0]), np.eye(3),
        record.time_s, value, np.full(3, record.spec.sd_m),
        spacing_s=_spacing(record, "height"),
    )  # fmt: skip


def deceleration_instrument(record: TriadRecord) -> Instrument:
    """Deceleration by an accelerometer whose body x axis is taken to lie along the velocity against the air.

    Frozen samples are left out: of a sensor at the end of its range the density came out 39 sd low, all checks green.
    """
    spec, axial = record.spec, record.spec.dcm_body_sensor[0]
    used = np.abs(axial) > 1e-9
    reading = -record.measured_sensor[:, used] @ axial[used]
    there = np.isfinite(reading) & ~frozen_rows(record)
    t, reading = record.time_s[there], reading[there]
    block = np.floor(t * DECELERATION_RATE_HZ).astype(np.int64)
    first = np.flatnonzero(np.diff(block, prepend=-(2**62)))
    count = np.diff(np.append(first, len(t)))
    mean = np.add.reduceat(reading, first) / count
    noise = np.hypot(spec.noise_sd, spec.resolution / np.sqrt(12.0)) / np.sqrt(count)
    value = np.column_stack([mean, np.full((len(mean), 2), np.nan)])
    return instrument_of(
        spec.name, DECELERATION, spec.name, np.zeros(3), np.zeros(3), np.eye(3),
        np.add.reduceat(t, first) / count, value, np.tile(noise[:, None], (1, 3)),
    )  # fmt: skip


def magnetometer_instrument(name: str, record: TriadRecord, field_ecef_t: FloatArray, rows: IntArray) -> Instrument:
    """Chosen samples of a magnetometer, with the field (n, 3) at them in Earth-fixed axes."""
    spec = record.spec
    sd = np.full(3, np.hypot(spec.noise_sd, spec.resolution / np.sqrt(12.0)))
    return instrument_of(
        name, FIELD, spec.name, np.zeros(3), np.zeros(3), spec.dcm_body_sensor,
        record.time_s[rows], record.measured_sensor[rows], sd, field_ecef_t,
    )  # fmt: skip


def sun_instruments(name: str, record: SunRecord, sun_ecef: FloatArray, rows: IntArray) -> list[Instrument]:
    """Every head of a set of Sun sensors at chosen samples, with the Sun's direction (n, 3) at them."""
    out = []
    for number, dcm in enumerate(record.spec.dcm_body_head, start=1):
        angles = record.az_el_head_rad[rows, number - 1]
        sd = np.full((len(rows), 3), record.spec.noise_sd_rad)
        sd[:, 0] /= np.maximum(np.cos(np.where(np.isfinite(angles[:, 1]), angles[:, 1], 0.0)), 1e-3)
        value = np.column_stack([angles, np.full(len(rows), np.nan)])
        head, edge = f"{name}{number}", np.array([np.cos(0.5 * record.spec.field_rad), 0.0, 0.0])
        out.append(instrument_of(head, SUN, head, np.zeros(3), edge, dcm, record.time_s[rows], value, sd, sun_ecef))
    return [i for i in out if len(i.time_s)]


@inlined
def node_motion(motion, index, position, velocity, q, errors, c, rate, acceleration):
    """Attitude matrix, inertial rate in body axes and acceleration against the Earth at a grid point, in place.

    ``rate`` (12, 3), all in body axes, are the rate, its rate of change and the specific force, by which an antenna
    beside the accelerometer moves, and the rate's partials by the gyros' nine errors.
    """
    dcm_from_quaternion(q[0], q[1], q[2], q[3], c)
    if motion.ballistic:
        for j in range(1, 12):
            for i in range(3):
                rate[j, i] = 0.0
        a = ballistic_acceleration(
            motion, position[0], position[1], position[2], velocity[0], velocity[1], velocity[2],
            errors[0], errors[1], errors[2], errors[3], errors[4], errors[5],
        )  # fmt: skip
        for i in range(3):
            rate[0, i] = motion.planet[RATE] * c[2, i]
            acceleration[i] = a[i]
        return
    force = np.empty(3)
    corrected(motion.force_sensor_mps2[index], errors, 0, motion.dcm_body_force, force)
    node_rate(motion, index, errors, rate)
    x, y, z = position[0], position[1], position[2]
    gx, gy, gz = gravitation(x, y, z, motion.planet)
    w2, two = motion.planet[RATE] * motion.planet[RATE], 2.0 * motion.planet[RATE]
    for i in range(3):
        rate[2, i] = force[i]
        acceleration[i] = c[i, 0] * force[0] + c[i, 1] * force[1] + c[i, 2] * force[2]
    acceleration[0] += gx + w2 * x + two * velocity[1]
    acceleration[1] += gy + w2 * y - two * velocity[0]
    acceleration[2] += gz


@inlined
def node_rate(motion, index, errors, rate):
    """Inertial rate at a grid point, its rate of change and its partials in body axes into ``rate`` (12, 3).

    The gyros' clock and what `with_exact_integrals` took from the sample (at even steps) are made good.
    """
    w, t = motion.rate_sensor_radps, motion.time_s
    before, after = max(index - 1, 0), min(index + 1, len(t) - 1)
    late = errors[19] if motion.clocks else 0.0
    first, second = t[index] - t[before], t[after] - t[index]
    even = before < index < after and abs(second - first) < 0.05 * second
    sample, change, turn = np.empty(3), np.empty(3), np.empty(3)
    for j in range(3):
        slope = (w[after, j] - w[before, j]) / (first + second)
        sample[j] = w[index, j] + late * slope
        if even:
            sample[j] += (w[after, j] - 2.0 * w[index, j] + w[before, j]) / 12.0
        change[j] = slope + errors[9 + j]  # of which `corrected` takes the bias
    corrected(sample, errors, 9, motion.dcm_body_rate, turn)
    body_actual, body_mount, column = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    mount_matrices(motion.dcm_body_rate, errors[15:18], body_actual, body_mount)
    for j in range(3):
        rate[0, j] = turn[j]
        gain = 1.0 / (1.0 + errors[12 + j])
        actual = (sample[j] - errors[9 + j]) * gain
        cross_into(body_mount[:, j], turn, column)  # -[w x] of a column
        for i in range(3):
            rate[3 + j, i] = -gain * body_actual[i, j]
            rate[6 + j, i] = actual * rate[3 + j, i]
            rate[9 + j, i] = column[i]
    corrected(change, errors, 9, motion.dcm_body_rate, turn)
    for j in range(3):
        rate[1, j] = turn[j]


@inlined
def corrected(measured, errors, offset, dcm_body_sensor, out):
    """True quantity (3,) in body axes of one sample, ``out = D R(mount) (measured - bias) / (1 + scale)``."""
    q, turn, actual = np.empty(4), np.empty((3, 3)), np.empty(3)
    level(q)
    boxplus(q, errors[offset + 6], errors[offset + 7], errors[offset + 8])
    dcm_from_quaternion(q[0], q[1], q[2], q[3], turn)
    for i in range(3):
        actual[i] = 0.0
        for j in range(3):
            actual[i] += turn[i, j] * (measured[j] - errors[offset + j]) / (1.0 + errors[offset + 3 + j])
    for i in range(3):
        out[i] = 0.0
        for j in range(3):
            out[i] += dcm_body_sensor[i, j] * actual[j]


@inlined
def observed_point(arm, tau, position, velocity, c, rate, acceleration, point, speed, effective, sweep, pulled, planet):
    """Observed point (3,), its velocity, levers of rotation of both, and the point's acceleration (3,) then, in place.

    ``p = r + C d - tau (v + C (w x d)) + tau^2 a_p / 2 - tau^3 j / 6``, ``a_p = a + C s``, ``s = w' x d + w x (w x d)``
    with ``w`` against the Earth; ``j = C (w x (f + s))`` of a force that turns with the body.
    """
    turn, change, lever_velocity = np.empty(3), np.empty(3), np.empty(3)
    swing, inward, pull, jerk = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        turn[i], change[i] = rate[0, i] - planet[RATE] * c[2, i], rate[1, i]
    cross_into(turn, arm, lever_velocity)
    cross_into(change, arm, swing)
    cross_into(turn, lever_velocity, inward)
    for i in range(3):
        swing[i] += inward[i]
        effective[i] = arm[i] - tau * (lever_velocity[i] - 0.5 * tau * swing[i])
        sweep[i] = lever_velocity[i] - tau * swing[i]
        pull[i] = rate[2, i] + swing[i]
    cross_into(turn, pull, jerk)
    for i in range(3):
        moving = velocity[i] + c[i, 0] * lever_velocity[0] + c[i, 1] * lever_velocity[1] + c[i, 2] * lever_velocity[2]
        pulled[i] = acceleration[i] + c[i, 0] * swing[0] + c[i, 1] * swing[1] + c[i, 2] * swing[2]
        late = tau * (c[i, 0] * jerk[0] + c[i, 1] * jerk[1] + c[i, 2] * jerk[2])
        point[i] = position[i] + c[i, 0] * arm[0] + c[i, 1] * arm[1] + c[i, 2] * arm[2]
        point[i] += tau * (0.5 * tau * (pulled[i] - late / 3.0) - moving)
        sweep[i] += 0.5 * tau * tau * jerk[i]
        effective[i] -= tau * tau * tau / 6.0 * jerk[i]
        speed[i] = moving - tau * (pulled[i] - 0.5 * late)
        pulled[i] -= late


@inlined
def state_rows(m, count, tau, c, effective, speed, by_state, by_error):
    """Partials of readings with partials ``m`` (3, 3) by the observed point: by state, and by the time tag (slot 3)."""
    row, lever = np.empty(3), np.empty(3)
    for i in range(count):
        by_error[i, TIME_BIAS] = -(m[i, 0] * speed[0] + m[i, 1] * speed[1] + m[i, 2] * speed[2])
        for j in range(3):
            by_state[i, j] = m[i, j]
            by_state[i, 3 + j] = -tau * m[i, j]
            row[j] = m[i, 0] * c[0, j] + m[i, 1] * c[1, j] + m[i, 2] * c[2, j]
        cross_into(effective, row, lever)  # row . (rotation x effective) = rotation . (effective x row)
        for j in range(3):
            by_state[i, 6 + j] = lever[j]


@inlined
def site_partials(site, dcm_ned_ecef, north, east, down, out):
    """Partials (3, 3) of a point's north, east, down at a site by how far north, east and up of its place it is stated.

    The antenna is levelled where it stands, so that its axes turn with the place: ``(1 - rho x) (r + d)`` with
    ``rho = (-d_e, d_n, d_e tan(latitude)) / R``, to first order.
    """
    per_m = 1.0 / math.sqrt(site[0] * site[0] + site[1] * site[1] + site[2] * site[2])
    tan_lat = -dcm_ned_ecef[2, 2] / max(dcm_ned_ecef[0, 2], 1e-6)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - down * per_m, tan_lat * east * per_m, 0.0
    out[1, 0], out[1, 1], out[1, 2] = 0.0, 1.0 - (tan_lat * north + down) * per_m, 0.0
    out[2, 0], out[2, 1], out[2, 2] = north * per_m, east * per_m, -1.0


@inlined
def predict_radar(site, dcm_ned_ecef, known, e, point, h, m, by_error):
    """Range, azimuth, elevation and partials (3, 3) by the observed point.

    ``known`` (3,) are the site's refractivity and the servo's lag of azimuth and elevation.
    """
    ned = np.empty(3)
    for i in range(3):
        ned[i] = 0.0
        for j in range(3):
            ned[i] += dcm_ned_ecef[i, j] * (point[j] - site[j])
    moved = np.empty((3, 3))
    site_partials(site, dcm_ned_ecef, ned[0], ned[1], ned[2], moved)
    for i in range(3):
        for j in range(3):
            ned[i] += moved[i, j] * (e[SURVEY + j] + e[SITES_SURVEY + j])
    north, east, down = ned[0], ned[1], ned[2]
    level2 = north * north + east * east
    horizontal = math.sqrt(level2)
    slant2 = level2 + down * down
    slant = math.sqrt(slant2)
    p = (
        (north / slant, east / slant, down / slant),
        (-east / level2, north / level2, 0.0),
        (down * north / (slant2 * horizontal), down * east / (slant2 * horizontal), -horizontal / slant2),
    )
    sin_az, cos_az = east / horizontal, north / horizontal
    sin_el, cos_el = -down / slant, horizontal / slant
    sec = 1.0 / max(cos_el, 1e-3)
    tan = sin_el * sec
    by_error[0, RANGE_BIAS], by_error[1, AZIMUTH_BIAS], by_error[2, ELEVATION_BIAS] = 1.0, 1.0, 1.0
    # a pedestal tilted by (tn, te) about north and east: RCC 753-95, to first order
    by_error[1, TILT_NORTH], by_error[1, TILT_EAST] = -cos_az * tan, -sin_az * tan
    by_error[2, TILT_NORTH], by_error[2, TILT_EAST] = sin_az, -cos_az
    by_error[2, DROOP], by_error[1, SKEW], by_error[1, NON_ORTHOGONALITY] = cos_el, sec, tan
    by_error[1, TRAVERSE_WANDER], by_error[2, ELEVATION_WANDER] = sec, 1.0
    # refraction of a ray through the whole atmosphere; near the horizon it stays at its value at 2 deg
    by_error[2, REFRACTION] = known[0] * cos_el / max(sin_el, 0.035)
    by_error[0, RANGE_SCALE] = slant
    by_error[1, NORTH], by_error[1, SITES_NORTH] = 1.0, 1.0
    by_error[0, RANGE_WANDER] = 1.0
    by_error[1, SERVO_LAG], by_error[2, SERVO_LAG] = known[1], known[2]
    # the errors themselves change with azimuth and elevation: near the horizon that of the refraction by a tenth
    by_tilt = cos_az * e[TILT_NORTH] + sin_az * e[TILT_EAST]
    cosecant_square = 1.0 / (sin_el * sin_el) if sin_el > 0.035 else sin_el / 0.035
    turned_az = tan * (cos_az * e[TILT_EAST] - sin_az * e[TILT_NORTH])
    az_by_el = sec * sec * (e[NON_ORTHOGONALITY] - by_tilt) + sec * tan * (e[SKEW] + e[TRAVERSE_WANDER])
    bent_el = sin_el * e[DROOP] + known[0] * cosecant_square * e[REFRACTION]
    g = ((1.0 + e[RANGE_SCALE], 0.0, 0.0), (0.0, 1.0 - turned_az, az_by_el), (0.0, by_tilt, 1.0 - bent_el))
    h[0], h[1], h[2] = slant, math.atan2(east, north) + known[1], math.atan2(-down, horizontal) + known[2]
    for i in range(3):
        for j in range(SLOTS):
            if j != TIME_BIAS:
                h[i] += by_error[i, j] * e[j]
    for i in range(3):
        for j in range(3):
            m[i, j] = 0.0
            by_error[i, SURVEY + j] = 0.0
            for k in range(3):
                f = g[i][0] * p[0][k] + g[i][1] * p[1][k] + g[i][2] * p[2][k]
                m[i, j] += f * dcm_ned_ecef[k, j]
                by_error[i, SURVEY + j] += f * moved[k, j]
            by_error[i, SITES_SURVEY + j] = by_error[i, SURVEY + j]


def sight(n: Any, east: Any, d: Any) -> tuple[Any, Any, Any]:
    """Range, azimuth, elevation of a point north, east, down of a site, or of points (k,)."""
    level = np.hypot(n, east)
    return np.hypot(level, d), np.arctan2(east, n), np.arctan2(-d, level)


def servo_lag(instrument: Instrument, time_s: FloatArray, states: States, at_s: FloatArray) -> FloatArray:
    """Lag (k, 2) of azimuth and elevation behind a path, rad: reading minus angle.

    Parameters
    ----------
    instrument : Instrument
        Radar with the bandwidth of its servo, Hz.
    time_s : (n,) float
        Nodes of the path, s.
    states : States
        At the nodes.
    at_s : (k,) float
        Times of the readings, s; the servo has settled on the target where the path begins.
    """
    from scipy import signal  # half a second to import
    from scipy.interpolate import CubicHermiteSpline

    c = rotations.dcm_from_q(states.q_ecef_body)
    point = CubicHermiteSpline(time_s, states.position_ecef_m + c @ instrument.arm_body_m, states.velocity_ecef_mps)
    # exact for an angle that runs straight between steps: the path's own are a tenth of a second
    step_s = float(np.clip(1.0 / (50 * instrument.servo_hz), 0.01, 0.1))
    even_s, step_s = np.linspace(
        time_s[0], time_s[-1], 1 + int(np.ceil((time_s[-1] - time_s[0]) / step_s)), retstep=True
    )
    ned = (point(even_s) - instrument.site_ecef_m) @ instrument.dcm.T
    _, azimuth, elevation = sight(*ned.T)
    angles = np.column_stack([np.unwrap(azimuth), elevation])
    # a straight line has no lag, and without that of the start there is no transient
    start, rate = angles[0], (angles[1] - angles[0]) / step_s
    bent = angles - start - rate * (even_s - even_s[0])[:, None]
    w = 2.0 * np.pi * instrument.servo_hz
    behind = ([-1.0, 0.0, 0.0], [1.0, 2.0 * instruments.BUTTERWORTH * w, w * w])
    top, bottom, _ = signal.cont2discrete(behind, step_s, method="foh")
    lag = signal.lfilter(np.ravel(top), bottom, bent, axis=0)
    return np.column_stack([np.interp(at_s, even_s, column) for column in lag.T])


def sight_partials(n: float, east: float, d: float) -> FloatArray:
    """Partials (3, 3) of range, azimuth, elevation by north, east, down."""
    level = np.hypot(n, east)
    slant = np.hypot(level, d)
    return np.array(
        [
            [n / slant, east / slant, d / slant],
            [-east / level**2, n / level**2, 0.0],
            [d * n / (slant**2 * level), d * east / (slant**2 * level), -level / slant**2],
        ]
    )


@inlined
def predict_place(kind, site, dcm_ned_ecef, e, point, speed, h, m, by_error, planet):
    """Position or velocity along a reference's axes, or height; partials by the observed point."""
    if kind == HEIGHT:
        sin_lat, cos_lat, height, per_p = geodetic(point[0], point[1], point[2], planet)
        level_part = (1.0 + e[1]) * cos_lat * per_p
        m[0, 0], m[0, 1], m[0, 2] = level_part * point[0], level_part * point[1], (1.0 + e[1]) * sin_lat
        by_error[0, 0], by_error[0, 1], by_error[0, 2] = 1.0, height - site[0], 1.0
        h[0] = height + e[0] + (height - site[0]) * e[1] + e[2]
        return
    for i in range(3):
        h[i] = e[i]
        by_error[i, i] = 1.0
        for j in range(3):
            m[i, j] = dcm_ned_ecef[i, j]
            h[i] += m[i, j] * (point[j] - site[j] if kind == POSITION else speed[j])


@inlined
def mount_row(row, value, e, offset, out):
    """Partials of ``row . R(mount)^T b`` by the mount (3,): ``row [value x] J``, with ``value`` = R^T b.

    The right Jacobian ``J = 1 - [m x] / 2 + [m x]^2 / 6`` leaves out 2e-4 of a mount of 10 deg.
    """
    m, half, sixth = np.empty(3), np.empty(3), np.empty(3)
    m[0], m[1], m[2] = e[offset], e[offset + 1], e[offset + 2]
    cross_into(row, value, out)
    cross_into(out, m, half)
    cross_into(half, m, sixth)
    for j in range(3):
        out[j] += sixth[j] / 6.0 - 0.5 * half[j]


@inlined
def in_mounted_axes(dcm_body_sensor, known, e, offset, c, mount, body, actual):
    """A known ECEF direction in body axes and in those of a sensor whose mount errs by ``e[offset:]``."""
    q, turn = np.empty(4), np.empty((3, 3))
    level(q)
    boxplus(q, e[offset], e[offset + 1], e[offset + 2])
    dcm_from_quaternion(q[0], q[1], q[2], q[3], turn)
    matmul_into(dcm_body_sensor, turn, mount)
    for i in range(3):
        body[i] = c[0, i] * known[0] + c[1, i] * known[1] + c[2, i] * known[2]
    for i in range(3):
        actual[i] = mount[0, i] * body[0] + mount[1, i] * body[1] + mount[2, i] * body[2]


@inlined
def partials_by_rotations(by_axes, i, mount, body, actual, e, offset, by_state, by_error):
    """Partials of component ``i`` by attitude and by mount, of those by the direction in the sensor's axes, (3,).

    A body rotated by d measures ``b + b x d``, a mount rotated by m about sensor axes likewise.
    """
    row, lever = np.empty(3), np.empty(3)
    for j in range(3):
        row[j] = by_axes[0] * mount[j, 0] + by_axes[1] * mount[j, 1] + by_axes[2] * mount[j, 2]
    cross_into(row, body, lever)
    for j in range(3):
        by_state[i, 6 + j] = lever[j]
    row[0], row[1], row[2] = by_axes
    mount_row(row, actual, e, offset, lever)
    for j in range(3):
        by_error[i, offset + j] = lever[j]


@inlined
def partials_by_known(by_axes, mount, c, out):
    """Partials (3,) by a direction in Earth-fixed axes, of those by the direction in the sensor's axes, (3,)."""
    for k in range(3):
        out[k] = 0.0
        for j in range(3):
            out[k] += (by_axes[0] * mount[j, 0] + by_axes[1] * mount[j, 1] + by_axes[2] * mount[j, 2]) * c[k, j]


@inlined
def predict_field(dcm_body_sensor, known, e, c, h, by_state, by_error):
    """Field in a magnetometer's axes: ``S (R(mount)^T D^T C^T (B + f)) + bias``, S with scales and soft iron."""
    mount, body, actual, field, row = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        field[i] = known[i] + e[FIELD_ERROR + i]
    in_mounted_axes(dcm_body_sensor, field, e, 6, c, mount, body, actual)
    iron = ((1.0 + e[3], e[9], e[10]), (e[9], 1.0 + e[4], e[11]), (e[10], e[11], 1.0 + e[5]))
    for i in range(3):
        h[i] = e[i] + iron[i][0] * actual[0] + iron[i][1] * actual[1] + iron[i][2] * actual[2]
        by_error[i, i], by_error[i, 3 + i] = 1.0, actual[i]
        partials_by_rotations(iron[i], i, mount, body, actual, e, 6, by_state, by_error)
        partials_by_known(iron[i], mount, c, row)
        for j in range(3):
            by_error[i, FIELD_ERROR + j] = row[j]
    by_error[0, 9], by_error[1, 9] = actual[1], actual[0]
    by_error[0, 10], by_error[2, 10] = actual[2], actual[0]
    by_error[1, 11], by_error[2, 11] = actual[2], actual[1]


@inlined
def predict_sun(edge, dcm_body_head, known, e, position, c, rate, h, by_state, by_error):
    """Azimuth and elevation of the Sun in a head's axes; ``edge`` is the cosine of half its field."""
    mount, body, s, light, row = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    radius = math.sqrt(position[0] * position[0] + position[1] * position[1] + position[2] * position[2])
    seen = 0.0  # of the nadir, along the head's axis
    for i in range(3):
        light[i] = -position[i] / radius
        for j in range(3):
            seen += light[i] * c[i, j] * dcm_body_head[j, 2]
    share = 1.0 if seen > edge else 0.0
    for i in range(3):
        s[i] = known[i] + (e[EVERYWHERE] + share * e[EARTHLIGHT]) * light[i]
    in_mounted_axes(dcm_body_head, s, e, 4, c, mount, body, s)
    normal2 = s[1] * s[1] + s[2] * s[2] + 1e-30
    normal = math.sqrt(normal2)
    whole2 = normal2 + s[0] * s[0]
    less = e[0] / (normal2 * normal)  # of the bias, as the Sun nears the head's x axis
    p = (
        (0.0, s[2] / normal2 - less * s[1], -s[1] / normal2 - less * s[2]),
        (normal / whole2, -s[0] * s[1] / (whole2 * normal), -s[0] * s[2] / (whole2 * normal)),
    )
    h[0] = math.atan2(s[1], s[2]) + e[0] / normal
    h[1] = math.atan2(s[0], normal) + e[1]
    by_error[0, 0], by_error[1, 1] = 1.0 / normal, 1.0
    for i in range(2):
        partials_by_rotations(p[i], i, mount, body, s, e, 4, by_state, by_error)
        partials_by_known(p[i], mount, c, row)
        for j in range(3):
            by_error[i, EVERYWHERE] += row[j] * light[j]
            by_error[i, TIME_BIAS] -= by_state[i, 6 + j] * rate[0, j]
        by_error[i, EARTHLIGHT] = share * by_error[i, EVERYWHERE]
        h[i] += e[TIME_BIAS] * by_error[i, TIME_BIAS]


@inlined
def predict(kind, arm, site, dcm, known, e, position, velocity, c, rate, acceleration, h, by_state, by_error, planet):
    """Prediction and partials of one measurement, in place."""
    for i in range(3):
        h[i] = 0.0
        for j in range(9):
            by_state[i, j] = 0.0
        for j in range(SLOTS):
            by_error[i, j] = 0.0
    if kind == FIELD:
        predict_field(dcm, known, e, c, h, by_state, by_error)
        return
    if kind == SUN:
        predict_sun(site[0], dcm, known, e, position, c, rate, h, by_state, by_error)
        return
    point, speed, effective, m = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    tau, sweep, pulled = e[TIME_BIAS], np.empty(3), np.empty(3)
    observed_point(arm, tau, position, velocity, c, rate, acceleration, point, speed, effective, sweep, pulled, planet)
    if kind == RADAR:
        predict_radar(site, dcm, known, e, point, h, m, by_error)
        state_rows(m, 3, tau, c, effective, speed, by_state, by_error)
        return
    if kind == RANGE_RATE:
        predict_range_rate(site, tau, e, c, sweep, pulled, point, speed, effective, h, m, by_state, by_error)
        gyro_rows(by_state[:, 3:6], 1, arm, c, rate, by_error)
        return
    predict_place(kind, site, dcm, e, point, speed, h, m, by_error, planet)
    if kind == VELOCITY:
        velocity_rows(m, 3, c, sweep, pulled, by_state, by_error)
        gyro_rows(m, 3, arm, c, rate, by_error)
        return
    state_rows(m, 1 if kind == HEIGHT else 3, tau, c, effective, speed, by_state, by_error)


@inlined
def predict_range_rate(site, tau, e, c, sweep, pulled, point, speed, effective, h, m, by_state, by_error):
    """Range rate ``u . v`` along the line of sight ``u`` from a site, plus its bias; partials by state and errors."""
    slant = 0.0
    for i in range(3):
        slant += (point[i] - site[i]) * (point[i] - site[i])
    slant = math.sqrt(slant)
    along = np.empty((3, 3))
    h[0] = 0.0
    for i in range(3):
        along[0, i] = (point[i] - site[i]) / slant
        h[0] += along[0, i] * speed[i]
    for i in range(3):
        m[0, i] = (speed[i] - h[0] * along[0, i]) / slant
    velocity_rows(along, 1, c, sweep, pulled, by_state, by_error)
    swing = by_state[0].copy()
    late = by_error[0, TIME_BIAS]
    state_rows(m, 1, tau, c, effective, speed, by_state, by_error)
    for j in range(3, 9):
        by_state[0, j] += swing[j]
    by_error[0, TIME_BIAS] += late
    by_error[0, 0], by_error[0, 1] = 1.0, 1.0
    h[0] += e[0]
    h[0] += e[1]


@inlined
def velocity_rows(m, count, c, sweep, pulled, by_state, by_error):
    """Partials of a velocity along the first axes of ``m`` (3, 3): ``m (v + C (w x d) - tau a_p)``."""
    row, lever = np.empty(3), np.empty(3)
    for i in range(count):
        by_error[i, TIME_BIAS] = -(m[i, 0] * pulled[0] + m[i, 1] * pulled[1] + m[i, 2] * pulled[2])
        for j in range(3):
            by_state[i, 3 + j] = m[i, j]
            row[j] = m[i, 0] * c[0, j] + m[i, 1] * c[1, j] + m[i, 2] * c[2, j]
        cross_into(sweep, row, lever)
        for j in range(3):
            by_state[i, 6 + j] = lever[j]


@inlined
def gyro_rows(m, count, arm, c, rate, by_error):
    """Partials of a velocity along the first axes of ``m`` (3, 3) by the gyros' errors, slots 4 to 13.

    ``m C (dw x d)``; of a late clock ``dw = w'``: without it the filter would find by how much all clocks are late
    alike, which nothing shows. Left out, of what a late tag adds: a twentieth at 37 rad/s and a millisecond.
    """
    row, lever = np.empty(3), np.empty(3)
    for i in range(count):
        for j in range(3):
            row[j] = m[i, 0] * c[0, j] + m[i, 1] * c[1, j] + m[i, 2] * c[2, j]
        cross_into(arm, row, lever)  # row . (dw x d) = dw . (d x row)
        for j in range(9):
            by_error[i, 4 + j] = rate[3 + j, 0] * lever[0] + rate[3 + j, 1] * lever[1] + rate[3 + j, 2] * lever[2]
        by_error[i, 13] = rate[1, 0] * lever[0] + rate[1, 1] * lever[1] + rate[1, 2] * lever[2]


@inlined
def predict_deceleration(motion, e, position, velocity, acceleration, h, by_state, by_error):
    """Deceleration along the flow, ``(1 + scale) a + bias``, of slots 1 and 0; slots 4 to 9 are the air's drivers.

    A late tag, slot 3, reads what was: ``a - tau da/dt`` along the path, the drivers constant.
    """
    s, partial = np.empty(12), np.empty(12)
    for j in range(3):
        s[j], s[3 + j] = position[j], velocity[j]
    for j in range(6):
        s[6 + j] = e[4 + j]
    drag = 0.0
    for k in range(25):  # in one loop: what is written once is compiled once
        j = k // 2 if k < 24 else 0
        middle, step = s[j], 1.0 if j < 3 else (0.01 if j < 6 else 1e-4)
        s[j] = middle + (0.0 if k == 24 else (step if k % 2 == 0 else -step))
        a = ballistic_acceleration(motion, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11])
        drag = a[4]
        s[j] = middle
        if k < 24:
            partial[j] = drag if k % 2 == 0 else (partial[j] - drag) / (2.0 * step)
    change = 0.0
    for j in range(3):
        change += partial[j] * velocity[j] + partial[3 + j] * acceleration[j]
    gain = 1.0 + e[1]
    for i in range(3):
        h[i] = 0.0
        for j in range(9):
            by_state[i, j] = gain * partial[j] if i == 0 and j < 6 else 0.0
        for j in range(SLOTS):
            by_error[i, j] = gain * partial[2 + j] if i == 0 and 4 <= j < 10 else 0.0
    h[0] = gain * (drag - e[3] * change) + e[0]
    by_error[0, 0], by_error[0, 1], by_error[0, 3] = 1.0, drag, -gain * change


def wrapped(instrument_kind: int, residual: FloatArray) -> FloatArray:
    """Residual (3,) with angles that come round taken the short way."""
    component = 1 if instrument_kind == RADAR else 0 if instrument_kind == SUN else None
    if component is not None:
        residual[component] = np.mod(residual[component] + np.pi, 2.0 * np.pi) - np.pi
    return residual

"""What is the filter given? From telemetry to nodes, instruments, error model, motion and the state at the start.

A state that flight.toml gives ([start.state]) is the start, with its covariance, and no tracker is needed. Else:

The attitude at the start comes from its prior through the gyros (or from a rest, or from magnetometer and Sun sensors),
position and velocity from early track points, or from a rest. Position and velocity get a prior so wide that it carries
no information (`_DIFFUSE_POSITION_M`, `_DIFFUSE_VELOCITY_MPS`): the fit to the first seconds of tracking only chooses
the point about which to linearise, so no point counts twice. The attitude's errors are correlated with those of the
gyros that propagated it. Ballistic flight has no attitude; its rotation is held fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from flightmodel import geomagnetism_and_sun, rotations
from flightmodel.checks import BoolArray, ConfigError, FloatArray, GateError, IntArray, Issue, nearest_name
from flightmodel.earth import Planet
from flightmodel.instruments import BAROMETER, GNSS, MAGNETOMETER, SITES, SitesSpec
from flightmodel.instruments import RADAR as RADAR_ERRORS
from flightmodel.statistics import chi_square_quantile
from flightmodel.tables import spaced
from flightmodel.telemetry import AttitudePrior, Start, StatePrior, Telemetry
from flightmodel.trajectory import nearest_index
from recon import measurements
from recon.imu_screening import BridgedSensor
from recon.measurements import HEIGHT, POSITION, RADAR, RANGE_RATE, VELOCITY, Instrument
from recon.problem import FIT_SPAN_S, Problem, observe
from recon.propagation import (
    SAME_INSTANT_S,
    Motion,
    ballistic_motion,
    correct,
    inertial_motion,
    propagate,
    with_disturbances,
)
from recon.rest import levelled_attitude, rest_instruments
from recon.settings import Settings
from recon.state import (
    KINEMATIC,
    ErrorModel,
    States,
    ballistic_blocks,
    deceleration_blocks,
    imu_blocks,
    instrument_blocks,
    sun_blocks,
)
from recon.triangulation import triangulated
from recon.vector_attitude import start_attitude_from_vectors

Track = tuple[FloatArray, FloatArray]  # times (n,) and points (n, 3), ECEF m
_TRACKING = (RADAR, POSITION, VELOCITY, HEIGHT, RANGE_RATE)
# of means in which the pulse is found; half a g, below which nothing deflects
_PULSE_CELL_S, _LEAST_PULSE_MPS2 = 0.5, 5.0
_NO_POINTS: Mapping[str, FloatArray] = MappingProxyType({})
_MOST_NODES = 2_000_000  # 28 h of a deceleration at 20 Hz, some 4 GB: an entry takes minutes
_DIFFUSE_POSITION_M = 1000.0  # no information beside one point of any tracker
_DIFFUSE_VELOCITY_MPS = 100.0  # the same, beside the line that is fitted
_LEAST_POINTS = 4  # of a parabola, with one over
_LEAST_SPAN_S = 2.0  # its later half gives a tracker of ten points a second the ten that residuals are tested with
_TRACK_SPAN_S = 2.5  # a parabola at 10 m/s2 with a jerk of 3 m/s3 is off by 8 m: enough to linearise about
_LEAST_SURVEY_M, _LEAST_NORTH_RAD = 1e-3, 1e-9  # a millimetre, and at 1000 km too


@dataclass(frozen=True)
class InertialSensors:
    """Accelerometer and gyros without gaps."""

    force: BridgedSensor
    rate: BridgedSensor


def build_problem(
    telemetry: Telemetry,
    settings: Settings,
    sensors: InertialSensors | None,
    rejected: Mapping[str, FloatArray] = _NO_POINTS,
) -> Problem:
    """Everything that the filter needs; points of a source at its ``rejected`` times are predicted, never used.

    Raises
    ------
    GateError
        Where the data cannot start or carry a filter (no common span, too few points, prior out of reach).
    """
    arm = _accelerometer_arm(sensors)
    instruments = tracking_instruments(telemetry, settings, arm)
    stated = telemetry.start.state
    model = _named_model(telemetry, settings, sensors, instruments)
    used = tuple(_without_rejected(i, rejected) for i in instruments if not _is_excluded(i, settings))
    track = track_points(used)
    begin = (track[1][0] if stated is None else stated.position_ecef_m) if stated or len(track[0]) else np.zeros(3)
    start_s, end_s = _span(track[0], settings, sensors, telemetry.start, used)
    if (end_s - start_s) * settings.output_rate_hz > _MOST_NODES:
        raise GateError(
            f"reconstruction: from {start_s:.6g} to {end_s:.6g} s there are more than {_MOST_NODES} steps. Check the "
            "unit of the times and offset_s (readings count from t0), or limit them by use_s",
            code="flight-too-long",
        )
    output_s = _output_times(start_s, end_s, settings.output_rate_hz)
    if sensors is not None and settings.pulse_rate_hz > settings.output_rate_hz:
        output_s = _union([output_s, *_pulse_times(instruments, sensors.force, start_s, end_s, settings.pulse_rate_hz)])
    if sensors is not None:
        instruments += rest_instruments(telemetry, start_s, begin)
    if settings.attitude_sensors:
        instruments += _attitude_instruments(telemetry, track, start_s, end_s)
    inside = [i.time_s[(i.time_s >= start_s - 1e-9) & (i.time_s <= end_s + 1e-9)] for i in instruments]
    # drivers are constant within a step, and decorrelate in seconds and kilometres
    between = np.arange(start_s, end_s, 0.5) if sensors is None else np.empty(0)
    time_s = _union([output_s, between, *inside])
    if sensors is None and len(time_s) > _MOST_NODES:
        raise GateError(
            f"reconstruction: {end_s - start_s:.6g} s of ballistic flight in {len(time_s)} steps, where {_MOST_NODES} "
            "are the most. Check the unit of the times, or limit them by use_s",
            code="flight-too-long",
        )
    observed, row = observe(time_s, instruments)
    if sensors is None:
        across = _cross_path_direction(track[1]) if stated is None else _normal_of_path(stated)
        motion, node_index = ballistic_motion(telemetry.motion, telemetry.sounding, across, time_s)
        start, covariance = _start_ballistic(track, start_s, model, stated)
    else:
        force, rate = sensors.force, sensors.rate
        clocks = model.column(rate.spec.name, "time bias") >= 0
        motion, node_index = inertial_motion(force, rate, time_s, clocks, telemetry.planet)
        prior = _attitude_prior(telemetry, start_s, begin)
        attitude = _start_attitude(prior, start_s, force, rate, model, telemetry.planet)
        if stated is None:
            point = (*fit_start(track, start_s), next(i.arm_body_m for i in used if i.kind in (RADAR, POSITION)))
        else:
            point = stated.position_ecef_m, stated.velocity_ecef_mps, -arm
        start, covariance = _start_by_inertial_sensors(point, attitude, start_s, rate, model, telemetry.planet)
        if stated is not None:
            covariance[:6, :6] = stated.covariance
        if telemetry.start.at_rest is not None and telemetry.start.at_rest[0] <= start_s < telemetry.start.at_rest[1]:
            start = _start_at_rest(track, telemetry.start.at_rest, motion, start, time_s, node_index)
    motion = with_disturbances(motion, telemetry.motion)

    gate = np.array([0.0, *(chi_square_quantile(settings.gate_probability, k) for k in (1, 2, 3))])
    kept: BoolArray = np.zeros(len(time_s), dtype=bool)
    kept[nearest_index(time_s, output_s)] = True
    problem = Problem(time_s, node_index, motion, model, instruments, row, observed, start, covariance, gate, kept)
    return problem.without(_only_predicted(problem, settings, rejected))


def _without_rejected(instrument: Instrument, rejected: Mapping[str, FloatArray]) -> Instrument:
    """Instrument without its measurements at rejected times."""
    keep = ~_at_any(instrument.time_s, rejected.get(instrument.name))
    parts = {
        name: getattr(instrument, name)[keep] for name in ("time_s", "value", "variance", "known", "group", "spacing_s")
    }
    return replace(instrument, **parts)


def _at_any(time_s: FloatArray, times: FloatArray | None) -> BoolArray:
    if times is None or len(times) == 0:
        return np.zeros(len(time_s), dtype=bool)
    return np.asarray(np.abs(times[nearest_index(times, time_s)] - time_s) <= SAME_INSTANT_S)


def _is_excluded(instrument: Instrument, settings: Settings) -> bool:
    return instrument.name in settings.without or instrument.owner in settings.without


def _named_model(
    telemetry: Telemetry, settings: Settings, sensors: InertialSensors | None, trackers: tuple[Instrument, ...]
) -> ErrorModel:
    """Error model as the settings want it, or every fault of the names in them at once."""
    faults = _unknown_sources(telemetry, settings, trackers)
    if settings.attitude_sensors and sensors is None:
        remark = "attitude_sensors: a ballistic motion has no attitude; switch them off"
        faults.append(Issue(remark, "keys-conflict"))
    model = _build_error_model(telemetry, sensors, settings.attitude_sensors)
    try:
        model = model.considering(settings.consider)
    except GateError as unknown:
        faults += unknown.faults
    if faults:
        raise ConfigError(faults)
    return model


def check_sources(telemetry: Telemetry, settings: Settings) -> None:
    """Raise `ConfigError` where ``settings.without`` names what the flight does not have."""
    faults = _unknown_sources(telemetry, settings, tracking_instruments(telemetry, settings, np.zeros(3)))
    if faults:
        raise ConfigError(faults)


def _unknown_sources(telemetry: Telemetry, settings: Settings, trackers: tuple[Instrument, ...]) -> list[Issue]:
    known = sorted({name for i in trackers for name in (i.name, i.owner)})
    if settings.attitude_sensors:
        known += ["magnetometer"] if telemetry.magnetometer is not None else []
        known += [f"sun{k + 1}" for k in range(len(telemetry.sun.spec.clock_lv_rad))] if telemetry.sun else []
    return [
        Issue(f"source '{name}'{nearest_name(name, known)}: no such source; known: {', '.join(known)}", "name-unknown")
        for name in settings.without
        if name not in known
    ]


def _only_predicted(problem: Problem, settings: Settings, rejected: Mapping[str, FloatArray]) -> BoolArray:
    """Measurements (M,) that check the trajectory: whole sources, oversampled and rejected ones, spans, every n-th."""
    out: BoolArray = np.zeros(len(problem.row), dtype=bool)
    at = problem.time_s[problem.node]
    for number, i in enumerate(problem.instruments):
        mine = np.flatnonzero(problem.observed.source == number)
        out[mine] = _is_excluded(i, settings) | _at_any(at[mine], rejected.get(i.name))
        if i.kind not in _TRACKING:
            continue
        group = i.group[problem.row[mine]]
        for alike in (mine[group == g] for g in np.unique(group)):
            out[alike] |= ~spaced(at[alike], i.spacing_s[problem.row[alike]])
            if settings.hold_out_every:
                left = alike[~out[alike]]
                out[left[settings.hold_out_every - 1 :: settings.hold_out_every]] = True
        for start, end in settings.hold_out_spans_s:
            out[mine] |= (at[mine] >= start) & (at[mine] < end)
    return out


def _attitude_prior(telemetry: Telemetry, start_s: float, point_ecef_m: FloatArray) -> AttitudePrior:
    """Attitude as it is stated; where it is not, from a rest, or magnetometer and Sun sensors about the start.

    Raises
    ------
    GateError
        Where there is neither.
    """
    if telemetry.attitude_prior is not None:
        return telemetry.attitude_prior
    if telemetry.start.at_rest is not None:
        return levelled_attitude(telemetry, max(start_s, telemetry.start.at_rest[0]), point_ecef_m)
    if telemetry.magnetometer is None or telemetry.sun is None:
        raise GateError(
            [
                f"flight '{telemetry.name}' has no attitude to start from; add [attitude_prior], or both "
                "[sensors.magnetometer] and [sensors.sun] with their tables, to flight.toml"
            ],
            code="attitude-missing",
        )
    return start_attitude_from_vectors(telemetry, start_s)


def _accelerometer_arm(sensors: InertialSensors | None) -> FloatArray:
    """Accelerometer from the datum; in ballistic flight the followed point is the tracked one."""
    if sensors is None:
        return np.zeros(3)
    return sensors.force.spec.position_from_datum_body_m


def tracking_instruments(telemetry: Telemetry, settings: Settings, arm_body_m: FloatArray) -> tuple[Instrument, ...]:
    """Radars, receivers and barometers, and an accelerometer that measures ballistic flight's deceleration."""
    traverse = settings.angle_noise == "traverse"
    planet, drag = telemetry.planet, telemetry.drag_accelerometer
    ballistic = telemetry.accelerometer is None or telemetry.rates is None or drag is not None
    out: list[Instrument] = []
    for name, record in telemetry.radars.items():
        cg = telemetry.vehicle.cg_m if telemetry.vehicle is not None and record.point == "cg" else np.zeros(3)
        arm = np.zeros(3) if ballistic else cg - arm_body_m
        radar = measurements.radar_instrument(name, record, arm, traverse, planet)
        doppler = measurements.range_rate_instrument(name, record, arm, planet)
        out += [i for i in (radar, doppler) if i is not None and len(i.time_s)]
    radars = tuple(out)
    for name, fixes in telemetry.gnss.items():
        near = None if fixes.has_positions else _any_place(telemetry, radars)
        antenna = fixes.spec.antenna_from_datum_body_m
        out += measurements.gnss_instruments(name, fixes, antenna if ballistic else arm_body_m, planet, near)
    for name, heights in telemetry.barometers.items():
        out.append(measurements.barometer_instrument(name, heights, arm_body_m))
    if drag is not None:
        out.append(measurements.deceleration_instrument(drag))
    return tuple(out)


def _any_place(telemetry: Telemetry, radars: tuple[Instrument, ...]) -> FloatArray | None:
    """Place (3,) by the flight's first position, ECEF, m: the local axes of velocities alone."""
    tracks = [record.position_ecef_m for record in telemetry.gnss.values()]
    for points in (*tracks, track_points(radars)[1]):
        whole = points[np.isfinite(points).all(axis=1)]
        if len(whole):
            return np.asarray(whole[0])
    return None if telemetry.start.state is None else telemetry.start.state.position_ecef_m


def _attitude_instruments(telemetry: Telemetry, track: Track, start_s: float, end_s: float) -> tuple[Instrument, ...]:
    """Magnetometer and Sun heads as measurements, thinned; positions for the field come from the tracking data."""
    t, points = track
    out: list[Instrument] = []
    if telemetry.magnetometer is not None:
        record = telemetry.magnetometer
        good = np.asarray(np.isfinite(record.measured_sensor).all(axis=1))
        rows = _thinned(record.time_s, good, start_s, end_s)
        at = record.time_s[rows]
        place = np.column_stack([np.interp(at, t, column) for column in points.T])
        field = geomagnetism_and_sun.magnetic_field_ecef_t(place, telemetry.t0_utc)
        out.append(measurements.magnetometer_instrument("magnetometer", record, field, rows))
    if telemetry.sun is not None:
        lit = np.asarray(np.isfinite(telemetry.sun.az_el_head_rad).any(axis=(1, 2)))
        rows = _thinned(telemetry.sun.time_s, lit, start_s, end_s)
        to_sun = geomagnetism_and_sun.sun_direction_ecef(telemetry.t0_utc, telemetry.sun.time_s[rows])
        out += measurements.sun_instruments("sun", telemetry.sun, to_sun, rows)
    return tuple(out)


def _thinned(time_s: FloatArray, good: BoolArray, start_s: float, end_s: float) -> IntArray:
    """Rows of the first good sample of each cell of time within a span."""
    rows = np.flatnonzero(good & (time_s >= start_s) & (time_s <= end_s))
    _, first = np.unique(np.floor(time_s[rows] * 10.0), return_index=True)
    return rows[first]


def _build_error_model(telemetry: Telemetry, sensors: InertialSensors | None, attitude_sensors: bool) -> ErrorModel:
    """All errors that the flight file states, drivers of the motion first."""
    if sensors is None:
        blocks = ballistic_blocks(telemetry.motion)
        if telemetry.drag_accelerometer is not None:
            tracked = bool(telemetry.radars or telemetry.gnss or telemetry.barometers)
            blocks += deceleration_blocks(telemetry.drag_accelerometer.spec, telemetry.motion.trim_sd_rad, tracked)
    else:
        blocks = imu_blocks(sensors.force.spec, sensors.rate.spec)
    for radar in telemetry.radars.values():
        blocks += instrument_blocks(RADAR_ERRORS, radar.spec)
    blocks += instrument_blocks(SITES, _sites(telemetry))
    for fixes in telemetry.gnss.values():
        blocks += instrument_blocks(GNSS, fixes.spec)
    for heights in telemetry.barometers.values():
        blocks += instrument_blocks(BAROMETER, heights.spec)
    if attitude_sensors and telemetry.magnetometer is not None:
        blocks += instrument_blocks(MAGNETOMETER, telemetry.magnetometer.spec)
    if attitude_sensors and telemetry.sun is not None:
        blocks += sun_blocks(telemetry.sun.spec)
    return ErrorModel(tuple(blocks))


def _sites(telemetry: Telemetry) -> SitesSpec:
    """Errors common to all radar sites: as stated, and so small that nothing moves where others can contradict them.

    What an error that is not stated would do to the answer is its covariance with the answer over its variance.
    """
    stated = telemetry.sites
    if not telemetry.radars:
        return SitesSpec()
    if not (telemetry.places or telemetry.has_other_positions):
        return stated
    return SitesSpec(
        stated.name,
        max(stated.survey_sd_m, _LEAST_SURVEY_M),
        max(stated.height_datum_sd_m, _LEAST_SURVEY_M),
        max(stated.north_sd_rad, _LEAST_NORTH_RAD),
    )


def _span(
    t: FloatArray, settings: Settings, sensors: InertialSensors | None, start: Start, used: tuple[Instrument, ...]
) -> tuple[float, float]:
    """First and last time that inertial sensors and track points (n,), or a rest, cover, within the settings' span.

    With a stated state the span begins at its time, and track points are not needed.
    """
    at_rest, stated = start.at_rest, start.state
    if stated is not None:
        start_s = stated.time_s
        ends = [i.time_s[-1] for i in used if len(i.time_s)]
        end_s = max([start_s, *map(float, ends)]) + settings.carry_on_s if sensors is None else np.inf
        _check_reach(stated.time_s, settings, sensors)
    elif len(t) == 0:
        raise GateError(
            "no radar or receiver has a usable point, and angles or ranges of several sites do not meet in one; a "
            "trajectory needs at least one",
            code="too-few-data",
        )
    else:
        start_s, end_s = float(t[0]), float(t[-1]) + settings.carry_on_s
    if at_rest is not None:
        start_s = min(start_s, at_rest[0])
    if sensors is not None:
        start_s = max(start_s, sensors.force.time_s[0], sensors.rate.time_s[0])
        end_s = min(end_s, sensors.force.time_s[-1], sensors.rate.time_s[-1])
    if settings.start_s is not None:
        start_s = max(start_s, settings.start_s)
    if settings.end_s is not None:
        end_s = min(end_s, settings.end_s)
    if end_s - start_s < _LEAST_SPAN_S:
        raise GateError(
            f"inertial sensors and trackers share only {start_s:.3f} to {end_s:.3f} s; "
            f"at least {_LEAST_SPAN_S:g} s are needed: check time bases and the chosen span",
            code="time-not-covered",
        )
    return float(start_s), float(end_s)


def _check_reach(state_s: float, settings: Settings, sensors: InertialSensors | None) -> None:
    """Raise `GateError` where a reconstruction cannot begin at the time of the stated state."""
    words = ""
    if settings.start_s is not None and settings.start_s > state_s:
        words = f"the reconstruction is to begin at {settings.start_s:.3f} s; take start_s out"
    if sensors is not None:
        first = max(sensors.force.time_s[0], sensors.rate.time_s[0])
        if first > state_s + 0.1:
            words = f"accelerometer and gyros begin at {first:.3f} s; propagate the state and its covariance to there"
    if words:
        raise GateError(f"start.state is of {state_s:.3f} s, but {words}", code="time-not-covered")


def _normal_of_path(state: StatePrior) -> FloatArray:
    """Horizontal direction (3,), ECEF, normal to the path that a state is on."""
    normal = np.cross(state.position_ecef_m, state.velocity_ecef_mps)
    return np.asarray(normal / np.linalg.norm(normal))


def _output_times(start_s: float, end_s: float, rate_hz: float) -> FloatArray:
    """Multiples of the output step inside the span, and the start itself."""
    first, last = np.ceil(start_s * rate_hz - 1e-6), np.floor(end_s * rate_hz + 1e-6)
    times = np.clip(np.arange(first, last + 1.0) / rate_hz, start_s, end_s)
    return _union([np.array([start_s]), times])


def _pulse_times(
    instruments: tuple[Instrument, ...], force: BridgedSensor, start_s: float, end_s: float, rate_hz: float
) -> list[FloatArray]:
    """Multiples of the pulse's step where the descent's specific force exceeds half its largest; empty without one."""
    at, points = track_points(instruments)
    apex_s = float(at[int(np.argmax(np.linalg.norm(points, axis=1)))]) if len(at) else start_s
    inside = (force.time_s >= max(start_s, apex_s)) & (force.time_s <= end_s)
    if inside.sum() < 2:
        return []
    cell = np.floor((force.time_s[inside] - force.time_s[inside][0]) / _PULSE_CELL_S).astype(np.int64)
    count = np.bincount(cell)
    size = np.bincount(cell, np.linalg.norm(force.measured_sensor[inside], axis=1)) / np.maximum(count, 1)
    size = np.interp(np.arange(len(size)), np.flatnonzero(count), size[count > 0])
    if size.max() < _LEAST_PULSE_MPS2:
        return []
    peak, weak = int(np.argmax(size)), size < 0.5 * size.max()
    first = int(np.flatnonzero(weak[:peak])[-1]) + 1 if weak[:peak].any() else 0
    last = peak + int(np.argmax(weak[peak:])) if weak[peak:].any() else len(size)
    begin = float(force.time_s[inside][0]) + _PULSE_CELL_S * first
    return [_output_times(begin, min(begin + _PULSE_CELL_S * (last - first), end_s), rate_hz)[1:]]


def _union(times: list[FloatArray]) -> FloatArray:
    """All times in order, instants closer than `recon.propagation.SAME_INSTANT_S` taken once."""
    t = np.sort(np.concatenate(times))
    kept = t[np.diff(t, prepend=-np.inf) > SAME_INSTANT_S]
    # in a chain of near instants the last may be far from the first
    far = t[np.abs(kept[nearest_index(kept, t)] - t) > SAME_INSTANT_S]
    return np.asarray(kept if len(far) == 0 else _union([kept, far]))


def _start_attitude(
    prior: AttitudePrior, start_s: float, force: BridgedSensor, rate: BridgedSensor, model: ErrorModel, planet: Planet
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Attitude (4,) at the start, its covariance (3, 3) and its covariance with the gyros' errors (3, 9).

    Raises
    ------
    GateError
        Where gyro data do not reach from the prior to the start.
    """
    q, var = prior.q_ecef_body, np.diag(prior.sd_rad**2)
    if abs(prior.time_s - start_s) < 1e-9:
        return q, var, np.zeros((3, 9))
    lo, hi = sorted((prior.time_s, start_s))
    if lo < rate.time_s[0] - 0.1 or hi > rate.time_s[-1] + 0.1:
        raise GateError(
            f"attitude prior at {prior.time_s:.3f} s: gyro samples cover {rate.time_s[0]:.3f} to "
            f"{rate.time_s[-1]:.3f} s and cannot carry it to the start at {start_s:.3f} s",
            code="time-not-covered",
        )
    motion, ends = inertial_motion(force, rate, np.array([lo, hi]), planet=planet)
    first, last = (int(ends[0]), int(ends[1])) if prior.time_s < start_s else (int(ends[1]), int(ends[0]))
    anywhere = States(np.array([planet.semi_major_m, 0.0, 0.0]), np.zeros(3), q, np.zeros(model.size))
    step = propagate(motion, first, last, anywhere)
    by_attitude, by_gyro = step.transition[6:9, 6:9], step.transition[6:9, 18:27]
    gyro_var = np.diag(model.prior_sd[9:18] ** 2)
    cross = by_gyro @ gyro_var
    total = by_attitude @ var @ by_attitude.T + cross @ by_gyro.T + step.noise[6:9, 6:9]
    return step.state.q_ecef_body, total, cross


def track_points(instruments: tuple[Instrument, ...]) -> Track:
    """Times (k,) and points (k, 3), ECEF m, of every measurement that fixes a position by itself, in order.

    Where none does, of instants at which angles and ranges of several sites do together (`recon.triangulation`).
    """
    times, points = [], []
    for i in instruments:
        time_s, value, variance = i.joined()
        whole = np.isfinite(variance).all(axis=1)
        if i.kind == RADAR:
            ned = _ned_from_radar(value[whole])
        elif i.kind == POSITION:
            ned = value[whole]
        else:
            continue
        times.append(time_s[whole])
        points.append(i.site_ecef_m + ned @ i.dcm)
    t = np.concatenate([np.empty(0), *times])
    if not len(t):
        return triangulated(tuple(i for i in instruments if i.kind == RADAR))
    order = np.argsort(t, kind="stable")
    return t[order], np.concatenate([np.empty((0, 3)), *points])[order]


def _ned_from_radar(range_az_el: FloatArray) -> FloatArray:
    slant, az, el = range_az_el.T
    return np.column_stack([slant * np.cos(el) * np.cos(az), slant * np.cos(el) * np.sin(az), -slant * np.sin(el)])


def fit_start(track: Track, start_s: float) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (3,) of the tracked point at the start: a parabola through the seconds about it.

    With fewer than `_LEAST_POINTS` in them a line through two is used (a rocket on its pad whose receiver gives no fix
    under thrust), and only without two are later points used. Points far from the curve, in units of the median
    distance, are down-weighted as the fit is repeated.

    Raises
    ------
    GateError
        With fewer than three points.
    """
    t, p = track
    t, p = t[t >= start_s - FIT_SPAN_S] - start_s, p[t >= start_s - FIT_SPAN_S]
    if len(t) < 3:
        what = f"tracking: {len(t)} points after {start_s:.3f} s; at least 3 are needed to start"
        raise GateError(what, code="too-few-data")
    near = int(np.searchsorted(t, FIT_SPAN_S))
    count = near if near >= 2 else _LEAST_POINTS
    t, p = t[:count], p[:count]
    degree = 2 if len(t) >= _LEAST_POINTS else 1
    weight: FloatArray = np.ones(len(t))
    coefficients: FloatArray = np.zeros((3, 3))
    for _ in range(10):
        coefficients = np.asarray(np.polynomial.polynomial.polyfit(t, p, degree, w=weight), dtype=float)
        distance = np.linalg.norm(p - np.polynomial.polynomial.polyval(t, coefficients).T, axis=1)
        scale = float(np.median(distance))
        weight = 1.0 / (1.0 + (distance / (2.0 * scale + 1e-3)) ** 2) ** 2
    return coefficients[0], coefficients[1]


def _cross_path_direction(points: FloatArray) -> FloatArray:
    """Horizontal direction (3,), ECEF, normal to the path: that in which track points (n, 3) scatter least.

    Each counts by its direction from the median alone, so that an outlier has no more weight than another.
    """
    middle = np.median(points, axis=0)
    up = middle / np.linalg.norm(middle)
    level = points - middle
    level -= np.outer(level @ up, up)
    level /= np.linalg.norm(level, axis=1, keepdims=True) + 1e-9
    # of three axes the least is vertical
    return np.asarray(np.linalg.eigh(level.T @ level)[1][:, 1])


def track_fit_states(instruments: tuple[Instrument, ...], time_s: FloatArray, errors: int) -> States | None:
    """States at nodes (n,) from tracking alone, without attitude: where to linearise when a filter lost the track.

    Parabolas through the points within `_TRACK_SPAN_S` of a node give position and velocity; cubics that meet both
    bridge the gaps between. None where fewer than two nodes have points about them.
    """
    t, p = track_points(instruments)
    first, last = np.searchsorted(t, time_s - _TRACK_SPAN_S), np.searchsorted(t, time_s + _TRACK_SPAN_S)
    fitted = np.flatnonzero(last - first >= _LEAST_POINTS)
    # a parabola is not extrapolated
    fitted = np.array([k for k in fitted if t[first[k]] <= time_s[k] <= t[last[k] - 1]], dtype=np.int64)
    if len(fitted) < 2:
        return None
    fits = np.array(
        [
            np.polynomial.polynomial.polyfit(t[a:b] - at, p[a:b], 2)[:2]
            for a, b, at in zip(first[fitted], last[fitted], time_s[fitted], strict=True)
        ]
    )
    from scipy.interpolate import CubicHermiteSpline

    path = CubicHermiteSpline(time_s[fitted], fits[:, 0], fits[:, 1])
    inside = np.clip(time_s, time_s[fitted[0]], time_s[fitted[-1]])
    velocity = path.derivative()(inside)
    position = path(inside) + (time_s - inside)[:, None] * velocity
    no_rotation = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    return States(position, velocity, no_rotation, np.zeros((len(time_s), errors)))


def _covariance(model: ErrorModel) -> FloatArray:
    """Prior of everything but rotation."""
    sd = np.concatenate(
        [np.full(3, _DIFFUSE_POSITION_M), np.full(3, _DIFFUSE_VELOCITY_MPS), np.zeros(3), model.prior_sd]
    )
    return np.diag(sd**2)


def _start_by_inertial_sensors(
    point: tuple[FloatArray, FloatArray, FloatArray],
    attitude: tuple[FloatArray, FloatArray, FloatArray],
    start_s: float,
    rate: BridgedSensor,
    model: ErrorModel,
    planet: Planet,
) -> tuple[States, FloatArray]:
    """State at the start and its covariance (9 + m, 9 + m)."""
    position, velocity, arm = point
    q, var, cross = attitude
    sample = np.array([[np.interp(start_s, rate.time_s, column) for column in rate.measured_sensor.T]])
    w = correct(sample, np.zeros(9), rate.spec.dcm_body_sensor)[0]
    c = rotations.dcm_from_q(q)
    lever_velocity = c @ np.cross(w - c.T @ planet.rate_ecef_radps, arm)
    state = States(position - c @ arm, velocity - lever_velocity, q, np.zeros(model.size))
    covariance = _covariance(model)
    covariance[6:9, 6:9] = var
    gyro = slice(KINEMATIC + 9, KINEMATIC + 18)
    covariance[6:9, gyro] = cross
    covariance[gyro, 6:9] = cross.T
    return state, covariance


def _start_at_rest(
    track: Track,
    at_rest: tuple[float, float],
    motion: Motion,
    start: States,
    time_s: FloatArray,
    node_index: IntArray,
) -> States:
    """Initial state with zero velocity: at the tracked rest, or where the path to the first track point began."""
    t, points = track
    still = points[(t >= time_s[0] - SAME_INSTANT_S) & (t <= at_rest[1])]
    start = replace(start, velocity_ecef_mps=np.zeros(3))
    if len(still):
        return replace(start, position_ecef_m=np.median(still, axis=0))
    first = int(np.searchsorted(t, time_s[0]))
    node = int(nearest_index(time_s, t[first : first + 1])[0])
    place = replace(start, position_ecef_m=points[first])
    for _ in range(2):  # gravity is that of the place
        reached = propagate(motion, int(node_index[0]), int(node_index[node]), place).state.position_ecef_m
        place = replace(place, position_ecef_m=place.position_ecef_m + points[first] - reached)
    return place


def _start_ballistic(
    track: Track, start_s: float, model: ErrorModel, stated: StatePrior | None
) -> tuple[States, FloatArray]:
    """State at the start and its covariance (9 + m, 9 + m), without attitude."""
    covariance = _covariance(model)
    if stated is not None:
        position, velocity = stated.position_ecef_m, stated.velocity_ecef_mps
        covariance[:6, :6] = stated.covariance
    else:
        position, velocity = fit_start(track, start_s)
    covariance[range(6, 9), range(6, 9)] = 1e-6**2  # rotation is held fixed
    return States(position, velocity, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(model.size)), covariance

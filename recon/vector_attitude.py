"""How was the vehicle oriented, by magnetometer and Sun sensors alone, and does the trajectory agree?

Two directions known in space and measured in the vehicle fix three angles (Wahba's problem),

    b_body = C^T b,   s_body = C^T s

and the project's own filter and smoother make a history of them that is far more accurate than one sample, because a
spinning vehicle separates errors of its sensors from its motion. The filter is given these sensors and nothing else:

* Readings are means of `_STEP_S` about evenly spaced *knots*. A mean stands at its samples' mean time, so the direction
  that it is compared with is turned by as much as the vehicle turns from the knot to there.
* The motion is that of gyros that read nothing. Their bias, minus the body's rate, may be anything and walks. How fast
  is estimated for each body axis and each stretch of `_STRETCH_S`, by MacKay's fixed point for the maximum of the
  marginal likelihood: ``walk = sum r^2 / gamma``, where ``r`` are the smoothed steps of the rate over ``sqrt(dt)`` and
  ``gamma`` their number less the part of it that the data leave undetermined. The accelerometer reads nothing without
  error. No reading depends on position and velocity, and they stay those of the track.
* Errors that multiply the motion (scale, soft iron) need one more term. The most probable motion *and* scale together
  are a motion too small and a scale too large. The scale that is most probable with the motion integrated out also
  includes the volume of motions that fit, ``-log det(information) / 2``, and is unbiased (Laplace's approximation). Its
  slope moves the mean of the errors' prior (`_volume_slope`).
* Besides the errors of the data sheets there are those that no data sheet states: of the field, of the Sun heads by the
  light of the Earth, and of the heads' time tags.

The first pass is linearised about attitudes that two directions give in closed form, each later one about the smoothed
attitudes of the one before.

Where no head sees the Sun only two angles are observable: short stretches are bridged by the smoother, with the
covariance that this costs; longer ones, over which the vehicle may have rotated by more than a quarter turn, have no
rows.

`compare` checks a trajectory's attitude against the history and names the sensor that contradicts it, as a range does
with its own attitude solution (seed paper, section on the reconstruction); `start_attitude_from_vectors` starts a
filter where no attitude is stated. The comparison is of two independent attitudes only if the trajectory was made
without these sensors: one whose filter used them too, or was started from them, agrees too well.

References
----------
F. Markley, "Attitude determination using vector observations and the singular value decomposition", J. Astronautical
Sciences 36 (1988) 245. M. Shuster, S. Oh, "Three-axis attitude determination from vector observations", J. Guidance and
Control 4 (1981) 70 (covariance of QUEST). D. MacKay, "Bayesian interpolation", Neural Computation 4 (1992) 415, section
4. L. Tierney, J. Kadane, J. Amer. Statist. Assoc. 81 (1986) 82 (Laplace's approximation).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, Check, FloatArray, GateError, IntArray, Issue
from flightmodel.geomagnetism_and_sun import magnetic_field_ecef_t, sun_direction_ecef
from flightmodel.instruments import MAGNETOMETER, TriadSpec, direction_from_sun_angles, sun_angles_from_direction
from flightmodel.statistics import chi_square_quantile
from flightmodel.telemetry import AttitudePrior, SunRecord, Telemetry, TriadRecord
from flightmodel.trajectory import Trajectory, interpolate_rows, resample
from recon.kalman import Filtered, Innovations, filtered, smoothed_covariance
from recon.linearise import linearise
from recon.measurements import FIELD, SUN, Instrument, magnetometer_instrument, sun_instruments
from recon.problem import Problem, observe
from recon.propagation import strapdown_motion
from recon.state import (
    KINEMATIC,
    ROTATION,
    Block,
    ErrorModel,
    States,
    boxminus,
    boxplus,
    data_sheet_check,
    imu_blocks,
    instrument_blocks,
    sun_blocks,
    unpacked,
)

Track = tuple[FloatArray, FloatArray]  # times (n,) and points (n, 3), ECEF m
_STEP_S = 0.2  # four minutes of flight cost half a second; coning of a second's period turns by a fifth within
_BLIND_RAD = 0.3  # a single attitude with an angle as uncertain as this starts nothing
_START_SPAN_S = 60.0  # longer, and constant errors were known better; attitude and rate follow within seconds
_TRACK_BLOCK_S = 1.0  # a block a second carries what a velocity's direction says of the attitude
LEAST_INSIDE = 0.90  # of 95 % regions, less what blocks that are not independent scatter
_MISFIT_ALLOWANCE = 0.15  # motion is no white noise, and blocks are not quite independent
# what no data sheet states: crust and currents above, per axis; weight of the Earth against the Sun in a head; a tag
_FIELD_SD_T, _EARTHLIGHT_SD, _SUN_TIME_SD_S = 1e-7, 0.01, 0.005
_SHARED = {FIELD: "", SUN: "sun"}  # owner of errors that several instruments of a kind have in common
_GYRO_BIAS = slice(9, 12)  # among the drivers of the motion
_STRETCH_S = 5.0  # over which the motion is taken as equally rough: a few periods of coning or pitching
# least, first and largest walk of a rate, rad^2/s^3: what no sensor would show, coning, and no information
_WALKS = (4e-8, 2.5e-3, 400.0)
_SMALL_RAD = 1e-5  # of a numerical derivative: its square is rounding
_PASSES = 7  # the attitudes move by a milliradian at most from the seventh on
_EDIT_SD, _MOST_EDITED = 5.0, 0.05  # of white noise one in two million; more are no outliers


@dataclass(frozen=True)
class Sighting:
    """Directions that one sensor measured.

    Parameters
    ----------
    name : str
    row : (r,) int
        Of the history.
    body, ecef : (r, 3) float
        Unit vectors: as measured, by nominal mounting and without sensor errors, and as known.
    constant_sd_rad : float
        Of a direction by all constant errors together, per axis.
    """

    name: str
    row: IntArray
    body: FloatArray
    ecef: FloatArray
    constant_sd_rad: float


@dataclass(frozen=True)
class AttitudeHistory:
    """Attitude over time from magnetometer and Sun sensors.

    Parameters
    ----------
    time_s : (n,) float
        Evenly spaced but for stretches without a solution.
    q_ecef_body : (n, 4) float
    covariance : (n, 3, 3) float
        Of the right-hand rotation in body axes, rad^2, constant errors included.
    findings : tuple of Issue
    consistency_checks : tuple of Check
        Residuals and constant errors of each sensor against its data sheet.
    sightings : tuple of Sighting
        Those that were used.
    """

    time_s: FloatArray
    q_ecef_body: FloatArray
    covariance: FloatArray
    findings: tuple[Issue, ...]
    consistency_checks: tuple[Check, ...]
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True)
class Means:
    """Means of one sensor at knots, as the filter takes them, and the time (k,) from a knot to that of its mean."""

    instrument: Instrument
    lag_s: FloatArray

    def at_knots(self, time_s: FloatArray, states: States) -> Instrument:
        """Instrument whose known directions are those that the vehicle, turned back to the knot, would have seen."""
        at = np.minimum(np.searchsorted(time_s, self.instrument.time_s), len(time_s) - 1)
        q, turn = states.q_ecef_body[at], -states.sensor_errors[at, _GYRO_BIAS] * self.lag_s[:, None]
        back = rotations.rotate(rotations.exp(-turn), rotations.rotate(rotations.conjugate(q), self.instrument.known))
        return replace(self.instrument, known=rotations.rotate(q, back))


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors ``(..., 3)`` made one long."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def reconstruct_attitude(
    telemetry: Telemetry,
    position: Track | None = None,
    confidence: float = 0.999,
    span_s: tuple[float, float] = (-np.inf, np.inf),
) -> AttitudeHistory:
    """Attitude of the body over the time that magnetometer, Sun sensors and position cover together.

    Parameters
    ----------
    telemetry : Telemetry
    position : (time_s (k,), position_ecef_m (k, 3)), optional
        Where the vehicle was. It only places the vehicle in the Earth's field, which changes by 25 nT/km at most: a
        kilometre is 0.03 deg, so a raw track is accurate enough, and no filter's attitude is used. Medians
        over a second of the flight's radars and receivers where it is not given.
    confidence : float
        Two-sided, of each consistency check.
    span_s : (float, float)
        Time outside which no reading is used.

    Raises
    ------
    GateError
        Where magnetometer or Sun sensors are missing, share no time, or never fix an attitude.
    """
    magnetometer, sun = _required_vectors(telemetry)
    t, points = track(telemetry) if position is None else position
    if len(t) == 0 or not np.isfinite(points).all():
        what = f"flight '{telemetry.name}': position is empty or not finite; the field needs a position"
        raise GateError(what, code="input-missing")
    spans = [(times[0], times[-1]) for times in (t, magnetometer.time_s, sun.time_s)] + [span_s]
    start_s, end_s = max(a for a, _ in spans), min(b for _, b in spans)
    first, last = np.ceil(start_s / _STEP_S - 1e-6), np.floor(end_s / _STEP_S + 1e-6)
    if last - first < 2:
        raise GateError(
            f"flight '{telemetry.name}': magnetometer, Sun sensors and position share {start_s:.3f} to {end_s:.3f} s, "
            "too little for an attitude; check their time bases",
            code="time-not-covered",
        )
    knots_s = np.arange(first, last + 1.0) * _STEP_S
    model = _error_model(magnetometer, sun)
    means = _means(telemetry.t0_utc, magnetometer, sun, knots_s, interpolate_rows(knots_s, t, points))
    seen = [_sighting(one.instrument, np.arange(len(one.lag_s)), knots_s, model) for one in means]
    solved, q = _solve_each(telemetry.name, seen, len(knots_s))
    keep, findings = _bridged(knots_s, solved, q)
    kept_s = knots_s[keep]
    q_start = rotations.slerp(knots_s[solved], q, kept_s) if len(solved) > 1 else q
    fit = _fit(means, model, kept_s, interpolate_rows(kept_s, t, points), q_start)
    source, used = fit.problem.observed.source, fit.innovations.accepted
    return AttitudeHistory(
        time_s=kept_s,
        q_ecef_body=fit.states.q_ecef_body,
        covariance=fit.covariance[:, ROTATION, ROTATION],
        findings=(*findings, *_fit_findings(fit)),
        consistency_checks=tuple(_consistency_checks(fit, confidence)),
        sightings=tuple(
            _sighting(instrument, fit.problem.row[used & (source == number)], kept_s, model)
            for number, instrument in enumerate(fit.problem.instruments)
        ),
    )


def _required_vectors(telemetry: Telemetry) -> tuple[TriadRecord, SunRecord]:
    """Magnetometer and Sun record, or `GateError` that names what flight.toml lacks."""
    wanted = {"magnetometer": telemetry.magnetometer, "sun": telemetry.sun}
    faults = [
        f"flight '{telemetry.name}' has no [sensors.{name}], and an attitude from directions needs both magnetometer "
        f"and Sun sensors; add [sensors.{name}] with its table to flight.toml"
        for name, record in wanted.items()
        if record is None
    ]
    if faults or telemetry.magnetometer is None or telemetry.sun is None:
        raise GateError(faults, code="input-missing")
    return telemetry.magnetometer, telemetry.sun


def track(telemetry: Telemetry) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and positions (k, 3), ECEF m: medians over `_TRACK_BLOCK_S` of all radar points and receiver fixes."""
    times = [r.time_s for r in telemetry.radars.values()] + [r.time_s for r in telemetry.gnss.values()]
    points = [earth.ecef_from_radar(r.range_az_el, *r.spec.geodetic) for r in telemetry.radars.values()]
    points += [r.position_ecef_m for r in telemetry.gnss.values()]
    t, p = np.concatenate(times), np.concatenate(points)
    whole = np.isfinite(p).all(axis=1)
    if not whole.any():
        what = f"flight '{telemetry.name}': no radar point and no fix locates the vehicle in the Earth's field"
        raise GateError(what, code="too-few-data")
    block = np.floor(t[whole] / _TRACK_BLOCK_S)
    table = pd.DataFrame(np.column_stack([t, p])[whole]).groupby(block).median().to_numpy(copy=True)
    # within a block the vehicle moves by less than changes the field
    table[0, 0], table[-1, 0] = t[whole].min(), max(t[whole].max(), table[0, 0] + 1e-3)
    return table[:, 0], table[:, 1:]


def _error_model(magnetometer: TriadRecord, sun: SunRecord) -> ErrorModel:
    """Errors of accelerometer and gyros that do not exist, of two data sheets, and of what these leave out."""
    spec, heads = magnetometer.spec, sun.spec
    exact = TriadSpec("accelerometer", np.zeros(3), np.eye(3), 0.0, 0.0, 0.0, 0.0)
    rates = replace(exact, name="rates", bias_wander_sd=10.0, bias_time_constant_s=1.0)  # any; its walk is `_fit`'s
    # the diagonal of the soft iron is one with the scale
    scaled = replace(spec, scale_sd=float(np.hypot(spec.scale_sd, spec.soft_iron_sd)))
    blocks = imu_blocks(exact, rates) + instrument_blocks(MAGNETOMETER, scaled) + sun_blocks(heads)
    blocks += [Block(spec.name, ("field x", "field y", "field z"), "T", _FIELD_SD_T)]
    blocks += [Block(heads.name, ("earthlight", "earthlight everywhere"), "1", _EARTHLIGHT_SD)]
    return ErrorModel((*blocks, Block(heads.name, ("time bias",), "s", _SUN_TIME_SD_S)))


def _means(
    t0_utc: str, magnetometer: TriadRecord, sun: SunRecord, knots_s: FloatArray, position_ecef_m: FloatArray
) -> list[Means]:
    """Means of the magnetometer and of every Sun head that ever has the Sun in its field."""
    directions = direction_from_sun_angles(sun.az_el_head_rad)
    rows = [_mean_rows(magnetometer.time_s, magnetometer.measured_sensor, knots_s)]
    rows += [_mean_rows(sun.time_s, directions[:, head], knots_s) for head in range(directions.shape[1])]
    field = TriadRecord(magnetometer.spec, knots_s, rows[0][2])
    angles = np.stack([sun_angles_from_direction(mean) for _, _, mean in rows[1:]], axis=1)
    known, every = magnetic_field_ecef_t(position_ecef_m, t0_utc), np.arange(len(knots_s))
    instruments = [magnetometer_instrument("magnetometer", field, known, every)]
    known = sun_direction_ecef(t0_utc, knots_s)
    instruments += sun_instruments("sun", SunRecord(sun.spec, knots_s, angles), known, every)
    out = []
    for instrument in instruments:
        count, lag, _ = rows[0 if instrument.kind == FIELD else int(instrument.name.removeprefix("sun"))]
        there = np.searchsorted(knots_s, instrument.time_s)
        out.append(Means(replace(instrument, variance=instrument.variance / count[there, None]), lag[there]))
    return out


def _mean_rows(time_s: FloatArray, values: FloatArray, knots_s: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Count and time from the knot (k,), and means (k, m), of the complete samples nearest to each knot."""
    size, knot = len(knots_s), np.round((time_s - knots_s[0]) / _STEP_S).astype(int)
    good = np.isfinite(values).all(axis=1) & (knot >= 0) & (knot < size)
    knot = knot[good]
    # against the knot, so that a time keeps its digits
    columns = (time_s[good] - knots_s[knot], *values[good].T)
    count = np.bincount(knot, minlength=size).astype(np.int64)
    sums = np.column_stack([np.bincount(knot, weights=column, minlength=size) for column in columns])
    means = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], np.nan)
    return count, means[:, 0], means[:, 1:]


def _sighting(instrument: Instrument, rows: IntArray, time_s: FloatArray, model: ErrorModel) -> Sighting:
    """Directions of some of an instrument's rows, which are at some of the times (n,)."""
    value, is_field = instrument.value[rows], instrument.kind == FIELD
    sensor = value if is_field else direction_from_sun_angles(value[:, :2])
    # one axis of each kind stands for all; bias and field error rotate a direction by their part of the field
    size = {"T": float(np.median(np.linalg.norm(value, axis=1)))}
    errors = [b for b in model.blocks if b.unit != "s" and b.instrument in (instrument.owner, _SHARED[instrument.kind])]
    return Sighting(
        instrument.name, np.searchsorted(time_s, instrument.time_s[rows]), unit(sensor @ instrument.dcm.T),
        unit(instrument.known[rows]), float(np.linalg.norm([b.prior_sd / size.get(b.unit, 1.0) for b in errors])),
    )  # fmt: skip


def _solve_each(name: str, seen: list[Sighting], count: int) -> tuple[IntArray, FloatArray]:
    """Knots at which the directions alone give an attitude, and these attitudes (k, 4)."""
    body, known, weight = np.zeros((count, 2, 3)), np.zeros((count, 2, 3)), np.zeros((count, 2))
    for one in seen:
        which = 0 if one.name == "magnetometer" else 1
        share = 1.0 / one.constant_sd_rad**2
        body[one.row, which] += share * one.body
        known[one.row, which] = one.ecef
        weight[one.row, which] += share
    both = np.flatnonzero((weight > 0.0).all(axis=1) & (np.linalg.norm(body, axis=2) > 0.0).all(axis=1))
    q, covariance = solve_vectors(unit(body[both]), known[both], weight[both] ** -0.5)
    sharp = np.linalg.eigvalsh(covariance)[:, -1] < _BLIND_RAD**2
    if not sharp.any():
        why = (
            "field and Sun directions are so near to one line that rotation about it is not observable"
            if len(both)
            else "no head sees the Sun while the magnetometer measures"
        )
        raise GateError(f"flight '{name}': no attitude from directions: {why}", code="not-observable")
    return both[sharp], rotations.continuous(q[sharp])


def solve_vectors(
    direction_body: FloatArray, direction_eci: FloatArray, sd_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Attitudes that fit measured directions best, at each time (Wahba's problem), with their covariance.

    Parameters
    ----------
    direction_body, direction_eci : (n, m, 3) float
        Unit vectors of ``m`` directions, in body axes and in those that the attitude is against.
    sd_rad : (n, m) float
        Of each direction, per axis normal to it; infinite for one that is missing.

    Returns
    -------
    q_eci_body : (n, 4) float
    covariance : (n, 3, 3) float
        Of the rotation in body axes, rad^2; no angle is taken as worse known than pi.

    Notes
    -----
    Markley: with ``sum w_i v_i^T / sd_i^2 = U S V^T`` (``w`` body, ``v`` eci) the matrix to body is
    ``U diag(1, 1, det U det V) V^T``. Shuster and Oh: ``P^-1 = sum (1 - w_i w_i^T) / sd_i^2``.
    """
    weight = sd_rad**-2.0
    left, _, right = np.linalg.svd(np.einsum("nm,nmi,nmj->nij", weight, direction_body, direction_eci))
    left[:, :, 2] *= (np.linalg.det(left) * np.linalg.det(right))[:, None]
    q = rotations.q_from_dcm(np.swapaxes(left @ right, 1, 2))
    along = np.einsum("nm,nmi,nmj->nij", weight, direction_body, direction_body)
    known, axes = np.linalg.eigh(weight.sum(axis=1)[:, None, None] * np.eye(3) - along)
    return q, (axes / np.maximum(known, np.pi**-2)[:, None, :]) @ np.swapaxes(axes, 1, 2)


def _bridged(knots_s: FloatArray, solved: IntArray, q: FloatArray) -> tuple[BoolArray, list[Issue]]:
    """Knots to solve at: between those with an attitude, less gaps too long to be bridged, which are findings."""
    step = np.diff(knots_s[solved])
    rotated = np.linalg.norm(rotations.boxminus(q[1:], q[:-1]), axis=1)
    rate = float(np.median(rotated / step)) if len(step) else 0.0
    # longer ones are not bridged, nor those in which the vehicle turns by more than a quarter
    longest = min(5.0, 0.5 * np.pi / max(rate, 1e-9))
    keep = np.zeros(len(knots_s), dtype=bool)
    keep[solved[0] : solved[-1] + 1] = True
    found = []
    for k in np.flatnonzero(step > longest):
        keep[solved[k] + 1 : solved[k + 1]] = False
        remark = f"no attitude for {step[k]:.1f} s: field or Sun missing, and up to {longest:.1f} s can be bridged"
        span = float(knots_s[solved[k]]), float(knots_s[solved[k + 1]])
        found.append(Issue(remark, "too-few-data", "attitude check", *span))
    return keep, found


@dataclass(frozen=True)
class _Fit:
    """Last pass: what was filtered, about which attitudes, with which result, and how far that moved them, rad."""

    problem: Problem
    innovations: Innovations
    covariance: FloatArray
    states: States
    moved_rad: float


def _fit(
    means: list[Means], model: ErrorModel, time_s: FloatArray, position_ecef_m: FloatArray, q_ecef_body: FloatArray
) -> _Fit:
    """Filter and smooth at times (n,) until the motion's noise fits, at first about attitudes (n, 4)."""
    n, still = len(time_s), np.zeros((len(time_s), 3))
    step_s = np.diff(time_s)
    linked = step_s < 1.5 * _STEP_S
    errors = np.zeros((n, model.size))
    errors[:-1, _GYRO_BIAS] = -rotations.boxminus(q_ecef_body[1:], q_ecef_body[:-1]) / step_s[:, None]
    errors[-1] = errors[-2]
    states = States(position_ecef_m, still, q_ecef_body, errors)
    start = states[0]
    # after a gap the rate may be any
    walk = np.where(linked[:, None], np.full(3, _WALKS[1]), _WALKS[2])
    stretch = ((time_s[:-1] - time_s[0]) // _STRETCH_S).astype(np.int64)
    # nothing depends on position and velocity, which only must have a covariance; half a turn is any attitude
    start_sd = np.concatenate([np.repeat([1.0, 1e-3, np.pi], 3), model.prior_sd])
    far = np.zeros(1, dtype=bool)
    slope = np.zeros(model.size)
    for _ in range(_PASSES):
        instruments = tuple(one.at_knots(time_s, states) for one in means)
        observed, row = observe(time_s, instruments)
        walked = walk * step_s[:, None]
        # a walk's mean over a step is off its middle by a twelfth of the walk; after a gap the attitude may be any
        density = np.where(linked[:, None], walked / 12.0, np.pi**2 / step_s[:, None] ** 2) * step_s[:, None]
        density = np.vstack([density, density[-1:]])
        motion = strapdown_motion(time_s, still, still, still, density, np.eye(3), np.eye(3))
        problem = Problem(
            time_s, np.arange(n), motion, model, instruments, row, observed, start, np.diag(start_sd**2),
            np.full(4, np.inf), np.ones(n, dtype=bool),
        ).without(far)  # fmt: skip
        line = linearise(problem, states)
        line.steps.noise_var[:, _GYRO_BIAS] = walked
        first = boxminus(start, states[0])
        first[KINEMATIC:] -= model.prior_sd**2 * slope
        run = filtered(problem, line, first)
        x, covariance = smoothed_covariance(problem, run, problem.kept)
        found = boxplus(run.charts, x)
        states = States(position_ecef_m, still, rotations.continuous(found.q_ecef_body), found.sensor_errors)
        slope = _volume_slope(problem, states, covariance)
        growth = _growth(run.filtered, covariance, states.sensor_errors, walked, stretch, linked)
        walk[linked] = np.clip(walk * growth, _WALKS[0], _WALKS[2])[linked]
        far = _outliers(problem, run.innovations)
    return _Fit(problem, run.innovations, covariance, states, float(np.abs(x[:, ROTATION]).max()))


def _volume_slope(problem: Problem, states: States, covariance: FloatArray) -> FloatArray:
    """Derivative (m,) of half the log-determinant of the motion's information by the errors of the magnetometer.

    A reading's part by a rotation changes with an error as its part by that error changes with the rotation.
    """
    field = np.flatnonzero(problem.observed.source == 0)
    node, slot = problem.node[field], problem.sources().slot[0]
    owned = KINEMATIC + slot[slot >= 0]
    spread = covariance[node]
    by_errors = spread[:, ROTATION, owned]
    alone = by_errors @ np.linalg.solve(spread[:, owned[:, None], owned], np.swapaxes(by_errors, 1, 2))
    alone = spread[:, ROTATION, ROTATION] - alone  # with the errors known
    now = linearise(problem, states).readings
    weighted = now.by_state[field][:, :, ROTATION] @ alone / problem.observed.variance[field, :, None]
    slope = np.zeros(problem.model.size)
    for axis, turn in enumerate(_SMALL_RAD * np.eye(3)):
        turned = replace(states, q_ecef_body=rotations.boxplus(states.q_ecef_body, turn))
        change = (linearise(problem, turned).readings.by_error - now.by_error)[field] / _SMALL_RAD
        slope[slot[slot >= 0]] += np.tensordot(weighted[:, :, axis], change, 2)[slot >= 0]
    return slope


def _growth(
    run: Filtered, covariance: FloatArray, errors: FloatArray, walked: FloatArray, stretch: IntArray, linked: BoolArray
) -> FloatArray:
    """Factor (n - 1, 3) by which the variance ``walked`` of each step of the rates should grow.

    Squares of the smoothed steps over the part of ``walked`` that the data determine: with the filter's prior ``P`` and
    the smoothed covariance ``P_N`` of the later node that is ``walked^2 P^-1 (P - P_N) P^-1``.

    Downwards three times as far, since that is slow where the data contain little information.
    """
    every, prior = np.arange(covariance.shape[1]), unpacked(run.p_minus[1:])
    rates = every[KINEMATIC:][_GYRO_BIAS]
    sd = np.sqrt(prior[:, every, every])
    sd[sd == 0.0] = 1.0  # what is known exactly has no part in anything
    prior /= sd[:, :, None] * sd[:, None, :]
    prior[:, every, every] = 1.0
    inverse = np.linalg.solve(prior, np.eye(len(every))[:, rates] / sd[:, :, None]) / sd[:, :, None]
    left = np.swapaxes(inverse, 1, 2) @ covariance[1:] @ inverse
    determined = np.diagonal(inverse[:, rates] - left, axis1=1, axis2=2) * walked
    squares = np.diff(errors[:, _GYRO_BIAS], axis=0) ** 2 / walked
    inside = (stretch == np.arange(stretch[-1] + 1)[:, None]) & linked
    # half a step as assumed, for stretches without information
    growth = (inside @ squares + 0.5) / (np.maximum(inside @ determined, 0.0) + 0.5)
    return np.where(growth < 1.0, growth**3, growth)[stretch]


def _outliers(problem: Problem, innovations: Innovations) -> BoolArray:
    """Readings (M,) that lie far from their prediction, unless they are too many of their sensor's to be outliers."""
    chance = 2.0 * ndtr(-_EDIT_SD)
    limit = np.array([chi_square_quantile(1.0 - chance, count) for count in (1, 2, 3)])
    measured, source = np.isfinite(problem.observed.variance).sum(axis=1), problem.observed.source
    far = innovations.nis > limit[measured - 1]
    share = np.bincount(source, far) / np.maximum(np.bincount(source), 1)
    return np.asarray(far & (share[source] <= _MOST_EDITED))


def _fit_findings(fit: _Fit) -> list[Issue]:
    ends, unused = (float(fit.problem.time_s[0]), float(fit.problem.time_s[-1])), ~fit.innovations.accepted
    edited = np.bincount(fit.problem.observed.source[unused], minlength=len(fit.problem.instruments))
    found = [
        Issue(f"{count} blocks edited from the attitude check", "points-edited", instrument.name, *ends)
        for count, instrument in zip(edited, fit.problem.instruments, strict=True)
        if count
    ]
    moved_deg = np.rad2deg(fit.moved_rad)
    if moved_deg > 0.1:
        words = f"not converged after {_PASSES} passes, the last of which moved by {moved_deg:.1f} deg"
        found.append(Issue(words, "not-converged", "attitude check", *ends))
    return found


def _consistency_checks(fit: _Fit, confidence: float) -> list[Check]:
    """Of each sensor its residuals, and its constant errors against its data sheet."""
    out: list[Check] = []
    tail, observed, model = 0.5 * (1.0 - confidence), fit.problem.observed, fit.problem.model
    estimate, sd = fit.states.sensor_errors[0], np.sqrt(np.diagonal(fit.covariance[0])[KINEMATIC:])
    for number, instrument in enumerate(fit.problem.instruments):
        used, name = (observed.source == number) & fit.innovations.accepted, instrument.name
        expected = float(np.isfinite(observed.variance[used]).sum())
        low, high = (chi_square_quantile(p, expected) / expected for p in (tail, 1.0 - tail))
        out.append(
            Check.of(
                "attitude-residuals", f"residuals {name}", float(fit.innovations.nis[used].sum()) / expected,
                low - _MISFIT_ALLOWANCE, high + _MISFIT_ALLOWANCE, f"{name}: residuals match the stated noise",
                f"{name}: residuals do not match the stated noise",
                advice="check noise, clocking and interference", source=name,
            )
        )  # fmt: skip
        own = np.array([owner == name for owner in model.instruments])
        errors = [error.removeprefix(f"{name} ") for error, mine in zip(model.names, own, strict=True) if mine]
        check = data_sheet_check(
            "attitude-data-sheet", name, name, errors, estimate[own], model.prior_sd[own], sd[own], confidence
        )
        out += [check] if check is not None else []
    return out


@dataclass(frozen=True)
class AttitudeComparison:
    """History minus trajectory.

    Parameters
    ----------
    time_s : (n,) float
    difference_body_rad, sd_body_rad : (n, 3) float
        About body axes, and their predicted standard deviation (both attitudes', as if independent).
    mean_body_rad : (3,) float
    share_inside : float
        Of all differences, within three standard deviations.
    mean_nees : float
        Over time, of squared differences in units of their covariance; 3 is expected.
    passed : bool
    words : str
    """

    time_s: FloatArray
    difference_body_rad: FloatArray
    sd_body_rad: FloatArray
    mean_body_rad: FloatArray
    share_inside: float
    mean_nees: float
    passed: bool
    words: str


def compare(history: AttitudeHistory, trajectory: Trajectory, confidence: float = 0.999) -> AttitudeComparison:
    """History minus trajectory at the history's times within the trajectory.

    Differences are correlated in time, so that neither their number inside a band nor their mean square scatters as
    that of independent ones. The mean square in units of the covariance is at most as spread as that of one time,
    so it passes below the chi-square quantile of three degrees of freedom; a tenth of the differences may lie beyond
    three standard deviations.

    Where they do not agree, the constant rotation of every sensor relative to the trajectory indicates which one is
    wrong; one that all share indicates the trajectory.

    Raises
    ------
    GateError
        Where the two share no time.
    """

    t = history.time_s
    rows = np.flatnonzero((t >= trajectory.time_s[0]) & (t <= trajectory.time_s[-1]))
    if len(rows) == 0:
        raise GateError(
            f"attitude check: the history's {t[0]:.3f} to {t[-1]:.3f} s lie outside the trajectory's "
            f"{trajectory.time_s[0]:.3f} to {trajectory.time_s[-1]:.3f} s",
            code="time-not-covered",
        )
    other = resample(trajectory, t[rows])
    off = rotations.boxminus(history.q_ecef_body[rows], other.q_ecef_body)
    theirs = np.zeros((len(rows), 3, 3)) if other.covariance is None else other.covariance[:, 6:9, 6:9]
    covariance = history.covariance[rows] + theirs
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    nees = float(np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).mean())
    inside = float(np.mean(np.abs(off) <= 3.0 * sd))
    passed = bool(nees <= chi_square_quantile(confidence, 3) and inside >= LEAST_INSIDE)
    rms, predicted = (float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in (off, sd))
    spread = float(np.sqrt(np.trace(theirs, axis1=1, axis2=2).mean() / 3.0))
    words = (
        f"attitude from magnetometer and Sun {'agrees with' if passed else 'contradicts'} the trajectory: "
        f"{np.rad2deg(rms):.2f} deg rms where {np.rad2deg(predicted):.2f} deg is predicted, "
        f"{100.0 * inside:.0f} % inside three standard deviations"
    )
    if not passed:
        offsets, allowed = _constant_rotations(history, other, rows, spread)
        words += f"; {_inconsistent_sensors(offsets, allowed, confidence)}"
    return AttitudeComparison(t[rows], off, sd, off.mean(axis=0), inside, nees, passed, words)


def _constant_rotations(
    history: AttitudeHistory, other: Trajectory, rows: IntArray, spread_rad: float
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Constant rotation (3,) of each sensor relative to a trajectory at the history's ``rows``, and its sd."""
    offsets, allowed = {}, {}
    number = np.full(len(history.time_s), -1)
    number[rows] = np.arange(len(rows))
    for seen in history.sightings:
        at = number[seen.row]
        use = at >= 0
        if not use.any():
            continue
        predicted = rotations.rotate(rotations.conjugate(other.q_ecef_body[at[use]]), seen.ecef[use])
        crossed = np.cross(predicted, seen.body[use]).sum(axis=0)
        information = use.sum() * np.eye(3) - predicted.T @ predicted
        # a rotation about the only direction that a sensor observed stays zero
        offsets[seen.name] = np.linalg.solve(information + 0.01 * use.sum() * np.eye(3), crossed)
        allowed[seen.name] = float(np.hypot(seen.constant_sd_rad, spread_rad))
    return offsets, allowed


def _inconsistent_sensors(offsets: dict[str, FloatArray], allowed: dict[str, float], confidence: float) -> str:
    """Sensors whose constant rotation relative to the trajectory is larger than its sd allows."""

    limit = float(-ndtri(0.5 * (1.0 - confidence) / (3 * len(offsets))))
    angle = {name: float(np.linalg.norm(offset)) for name, offset in offsets.items()}
    off = [name for name in offsets if np.abs(offsets[name]).max() > limit * allowed[name]]
    listed = ", ".join(f"{name} ({np.rad2deg(angle[name]):.1f} deg)" for name in sorted(off, key=lambda n: -angle[n]))
    if not off:
        return "no single sensor is misaligned: check noise, time tags and the trajectory's attitude"
    if len(off) == len(offsets) > 1:
        return f"all sensors disagree with it: {listed}; check the trajectory's attitude, then what the sensors share"
    return f"misaligned relative to it: {listed}; check mounting, clocking and signs"


def start_attitude_from_vectors(telemetry: Telemetry, around_s: float) -> AttitudePrior:
    """Attitude near a time, from the data of a minute about it, as flight.toml would state it to start a filter with.

    Its standard deviations are about the body axes, without their correlation.

    Raises
    ------
    GateError
        As `reconstruct_attitude`, and where there are no data in the span.
    """
    _, sun = _required_vectors(telemetry)
    last_s = max(sun.time_s[0], sun.time_s[-1] - _START_SPAN_S)
    begin = float(np.clip(around_s - 0.5 * _START_SPAN_S, sun.time_s[0], last_s))
    history = reconstruct_attitude(telemetry, span_s=(begin, begin + _START_SPAN_S))
    k = int(np.argmin(np.abs(history.time_s - around_s)))
    sd_rad = np.sqrt(np.diagonal(history.covariance[k]))
    return AttitudePrior(float(history.time_s[k]), history.q_ecef_body[k], sd_rad)

"""How was the vehicle oriented, by magnetometer and Sun sensors alone, and does the trajectory agree?

Two directions known in space and measured in the vehicle fix three angles (Wahba's problem),

    b_body = C^T b_eci,   s_body = C^T s_eci

and a smoother over attitude, rate and the sensors' constant errors (`recon.attitude_smoother`) makes a history of them
that is far more accurate than one sample, because a spinning vehicle separates errors of its sensors from its motion.
No gyro, no accelerometer and no filter of the trajectory takes part. Where no head sees the Sun only two angles are
observable: short stretches are bridged by the smoother, with the covariance that this costs; longer ones, over which
the vehicle may have rotated by more than a quarter turn, have no rows.

`compare` checks a trajectory's attitude against the history and names the sensor that contradicts it, as a range does
with its own attitude solution (seed paper, section on the reconstruction); `start_attitude_from_vectors` starts a
filter where no attitude is stated. The comparison is of two independent attitudes only if the trajectory was made
without these sensors: one whose filter used them too, or was started from them, agrees too well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.special import ndtri

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, Check, FloatArray, GateError, IntArray, Issue
from flightmodel.statistics import chi_square_quantile
from flightmodel.telemetry import AttitudePrior, SunRecord, Telemetry, TriadRecord
from flightmodel.trajectory import Trajectory, interpolate_rows, resample
from recon.attitude_smoother import (
    ErrorTerms,
    Fit,
    Knots,
    Position,
    VectorObservations,
    error_terms,
    observe_magnetometer,
    observe_sun,
    smooth,
    solve_vectors,
    unit,
)
from recon.state import data_sheet_check

_BLIND_RAD = 0.3  # a single attitude with an angle as uncertain as this starts nothing
_START_SPAN_S = 60.0  # longer, and constant errors were known better; attitude and rate follow within seconds
_TRACK_BLOCK_S = 1.0  # a block a second carries what a velocity's direction says of the attitude
LEAST_INSIDE = 0.90  # of 95 % regions, less what blocks that are not independent scatter
_MISFIT_ALLOWANCE = 0.15  # motion is no white noise, and blocks are not quite independent


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
    rate_body_radps : (n, 3) float
        Of the body against inertial space, body axes.
    method : str
    findings : tuple of Issue
    consistency_checks : tuple of Check
        Residuals and constant errors of each sensor against its data sheet.
    sensor_errors : DataFrame
        ``name, unit, prior_sd, estimate, sd`` (SI).
    observations : tuple of Sightings
        Those fitted; knots are rows of the history.
    """

    time_s: FloatArray
    q_ecef_body: FloatArray
    covariance: FloatArray
    rate_body_radps: FloatArray
    method: str
    findings: tuple[Issue, ...]
    consistency_checks: tuple[Check, ...]
    sensor_errors: pd.DataFrame
    observations: tuple[VectorObservations, ...]


def reconstruct_attitude(
    telemetry: Telemetry,
    position: Position | tuple[FloatArray, FloatArray] | None = None,
    rate_hz: float = 10.0,
    confidence: float = 0.999,
) -> AttitudeHistory:
    """Attitude of the body over the time that magnetometer, Sun sensors and position cover together.

    Parameters
    ----------
    telemetry : Telemetry
    position : callable or (time_s (k,), position_ecef_m (k, 3)), optional
        Where the vehicle was. It only places the vehicle in the Earth's field, which changes by 25 nT/km at most: a
        kilometre is 0.03 deg, so a raw track is accurate enough, and no filter's attitude is used. Medians
        over a second of the flight's radars and receivers where it is not given.
    rate_hz : float
        Of blocks, knots and the history.
    confidence : float
        Two-sided, of each consistency check.

    Raises
    ------
    GateError
        Where magnetometer or Sun sensors are missing, share no time, or never fix an attitude.
    """
    magnetometer, sun = _required_vectors(telemetry)
    place, spans = _place(telemetry, position)
    spans += [(magnetometer.time_s[0], magnetometer.time_s[-1]), (sun.time_s[0], sun.time_s[-1])]
    start_s, end_s = max(a for a, _ in spans), min(b for _, b in spans)
    step_s = 1.0 / rate_hz
    first, last = np.ceil(start_s * rate_hz - 1e-6), np.floor(end_s * rate_hz + 1e-6)
    if last - first < 2:
        raise GateError(
            f"flight '{telemetry.name}': magnetometer, Sun sensors and position share {start_s:.3f} to {end_s:.3f} s, "
            "too little for an attitude; check their time bases",
            code="time-not-covered",
        )
    knots_s = np.arange(first, last + 1.0) / rate_hz
    terms = error_terms(magnetometer.spec, sun.spec, float(knots_s[0]), float(knots_s[-1]))
    about = telemetry.t0_utc, knots_s, step_s, place, terms
    observations = [observe_magnetometer(magnetometer, *about), *observe_sun(sun, *about)]
    solved, q = _solve_each(telemetry.name, observations, len(knots_s))
    keep, findings = _bridged(knots_s, solved, q)
    kept_s = knots_s[keep]
    number = np.cumsum(keep) - 1
    observations = [one.take(rows := keep[one.knot], number[one.knot[rows]]) for one in observations]
    q_start = rotations.slerp(knots_s[solved], q, kept_s) if len(solved) > 1 else q
    knots = Knots(kept_s, step_s, np.asarray(np.diff(np.flatnonzero(keep)) == 1))
    fit, used = smooth(knots, [observed for observed in observations if len(observed.knot)], terms, q_start)
    columns = terms.names, terms.units, terms.prior_sd, fit.errors, np.sqrt(np.diagonal(fit.error_covariance))
    return AttitudeHistory(
        time_s=kept_s,
        q_ecef_body=rotations.continuous(rotations.multiply(earth.q_ecef_eci(kept_s), fit.q_eci_body)),
        covariance=fit.covariance[:, :3, :3],
        rate_body_radps=fit.rate_radps,
        method="magnetometer and Sun sensors, smoothed; no gyro, no accelerometer",
        findings=(*findings, *_fit_findings(fit, observations, used, kept_s)),
        consistency_checks=tuple(_consistency_checks(fit, terms, confidence)),
        sensor_errors=pd.DataFrame(dict(zip(("name", "unit", "prior_sd", "estimate", "sd"), columns, strict=True))),
        observations=tuple(used),
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


def _place(
    telemetry: Telemetry, position: Position | tuple[FloatArray, FloatArray] | None
) -> tuple[Position, list[tuple[float, float]]]:
    """Position by time, and the span that it covers, as a list; a callable covers all times."""
    if callable(position):
        return position, []
    if position is None:
        position = track(telemetry)
    time_s, points = position
    if len(time_s) == 0 or not np.isfinite(points).all():
        what = f"flight '{telemetry.name}': position is empty or not finite; the field needs a position"
        raise GateError(what, code="input-missing")
    return lambda at: interpolate_rows(at, time_s, points), [(float(time_s[0]), float(time_s[-1]))]


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


def _solve_each(name: str, observations: list[VectorObservations], count: int) -> tuple[IntArray, FloatArray]:
    """Knots at which the directions alone give an attitude, and these attitudes (k, 4), relative to inertial axes."""
    body, reference = np.zeros((count, 2, 3)), np.zeros((count, 2, 3))
    weight = np.zeros((count, 2))
    for observed in observations:
        which = 0 if observed.is_field else 1
        share = 1.0 / observed.constant_sd_rad**2
        body[observed.knot, which] += share * observed.directions_body()
        reference[observed.knot, which] = unit(observed.reference_eci)
        weight[observed.knot, which] += share
    both = np.flatnonzero((weight > 0.0).all(axis=1) & (np.linalg.norm(body, axis=2) > 0.0).all(axis=1))
    q, covariance = solve_vectors(unit(body[both]), reference[both], weight[both] ** -0.5)
    sharp = np.linalg.eigvalsh(covariance)[:, -1] < _BLIND_RAD**2
    if not sharp.any():
        why = (
            "field and Sun directions are so near to one line that rotation about it is not observable"
            if len(both)
            else "no head sees the Sun while the magnetometer measures"
        )
        raise GateError(f"flight '{name}': no attitude from directions: {why}", code="not-observable")
    return both[sharp], rotations.continuous(q[sharp])


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


def _fit_findings(
    fit: Fit, before: list[VectorObservations], after: list[VectorObservations], time_s: FloatArray
) -> list[Issue]:
    ends, kept = (float(time_s[0]), float(time_s[-1])), {observed.name: len(observed.knot) for observed in after}
    edited = {observed.name: len(observed.knot) - kept.get(observed.name, len(observed.knot)) for observed in before}
    found = [
        Issue(f"{count} blocks edited from the attitude check", "points-edited", name, *ends)
        for name, count in edited.items()
        if count
    ]
    if not fit.converged:
        found.append(Issue(f"not converged after {fit.steps} steps", "not-converged", "attitude check", *ends))
    return found


def _consistency_checks(fit: Fit, terms: ErrorTerms, confidence: float) -> list[Check]:
    """Of each sensor its residuals, and its constant errors against its data sheet."""

    out: list[Check] = []
    tail = 0.5 * (1.0 - confidence)
    for name, (squares, expected) in fit.misfit.items():
        low, high = (chi_square_quantile(p, expected) / expected for p in (tail, 1.0 - tail))
        out.append(
            Check.of(
                "attitude-residuals", f"residuals {name}", squares / expected, float(low) - _MISFIT_ALLOWANCE,
                float(high) + _MISFIT_ALLOWANCE, f"{name}: residuals match the stated noise",
                f"{name}: residuals do not match the stated noise",
                advice="check noise, clocking and interference", source=name,
            )
        )  # fmt: skip
    sd = np.sqrt(np.diagonal(fit.error_covariance))
    for name in dict.fromkeys(terms.instruments):
        own = terms.of(name)
        errors = [terms.names[i].removeprefix(f"{name} ") for i in own]
        check = data_sheet_check(
            "attitude-data-sheet", name, name, errors, fit.errors[own], terms.prior_sd[own], sd[own], confidence
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
    for observed in history.observations:
        at = number[observed.knot]
        use = at >= 0
        if not use.any():
            continue
        lag = observed.lag_s[use]
        q = rotations.multiply(
            rotations.conjugate(earth.q_ecef_eci(other.time_s[at[use]])),
            rotations.boxplus(other.q_ecef_body[at[use]], other.omega_body_eci_body_radps[at[use]] * lag[:, None]),
        )
        predicted = rotations.rotate(rotations.conjugate(q), unit(observed.reference_eci[use]))
        crossed = np.cross(predicted, observed.directions_body()[use]).sum(axis=0)
        information = use.sum() * np.eye(3) - predicted.T @ predicted
        # a rotation about the only direction that a sensor observed stays zero
        offsets[observed.name] = np.linalg.solve(information + 0.01 * use.sum() * np.eye(3), crossed)
        allowed[observed.name] = float(np.hypot(observed.constant_sd_rad, spread_rad))
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
    magnetometer, sun = _required_vectors(telemetry)
    last_s = max(sun.time_s[0], sun.time_s[-1] - _START_SPAN_S)
    begin = float(np.clip(around_s - 0.5 * _START_SPAN_S, sun.time_s[0], last_s))

    def near(record: TriadRecord | SunRecord) -> BoolArray:
        return np.asarray((record.time_s >= begin) & (record.time_s <= begin + _START_SPAN_S))

    in_field, in_sun = near(magnetometer), near(sun)
    if not in_field.any() or not in_sun.any():
        raise GateError(
            f"flight '{telemetry.name}': no attitude from directions at {around_s:.3f} s: magnetometer covers "
            f"{magnetometer.time_s[0]:.3f} to {magnetometer.time_s[-1]:.3f} s, Sun sensors {sun.time_s[0]:.3f} to "
            f"{sun.time_s[-1]:.3f} s",
            code="time-not-covered",
        )
    part = replace(
        telemetry,
        magnetometer=TriadRecord(
            magnetometer.spec, magnetometer.time_s[in_field], magnetometer.measured_sensor[in_field]
        ),
        sun=SunRecord(sun.spec, sun.time_s[in_sun], sun.az_el_head_rad[in_sun]),
    )
    history = reconstruct_attitude(part)
    k = int(np.argmin(np.abs(history.time_s - around_s)))
    sd_rad = np.sqrt(np.diagonal(history.covariance[k]))
    return AttitudePrior(float(history.time_s[k]), history.q_ecef_body[k], sd_rad)

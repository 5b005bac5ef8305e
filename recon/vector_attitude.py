"""How was the vehicle turned, by magnetometer and Sun sensors alone?

Two directions known in space and measured in the vehicle fix three angles. A smoother over attitude, rate and the
sensors' constant errors (`recon.vector_models`) makes a history of them that is known far better than one sample
tells, because a spinning vehicle shows the errors of its sensors to be its own. No gyro, no accelerometer and no filter
of the trajectory takes part.

Where no head sees the Sun only two angles are known. Short stretches are bridged by the smoother, and their covariance
says what that costs; longer ones, over which the vehicle may have turned by more than a quarter, have no rows.

Does the trajectory's attitude agree with one from magnetometer and Sun sensors alone, and what does that start with?

The check that a range makes with its own attitude solution (seed paper, section on the reconstruction):
`reconstruct_attitude` takes neither gyro nor accelerometer nor filter, `compare` holds it against a trajectory and
names the sensor that contradicts it, `start_attitude_from_vectors` starts a filter where no attitude is stated.

A comparison is of two independent attitudes only if the trajectory was made without these sensors: one whose filter
read them too, or was started from them, agrees too well.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.telemetry import AttitudePrior, Finding, SunRecord, Telemetry, TriadRecord
from flightmodel.trajectory import Trajectory, interpolate_rows, resample
from recon.consistency import ConsistencyCheck, consistency_check, data_sheet_check
from recon.vector_models import (
    ErrorTerms,
    Fit,
    IntArray,
    Knots,
    Position,
    Sightings,
    Unstated,
    error_terms,
    sight_magnetometer,
    sight_sun,
    smooth,
    solve_vectors,
    unit,
)

QUARTER_RAD = 0.5 * np.pi
BLIND_RAD = 0.3  # a sample that leaves an angle as open as this starts nothing
TRACK_BLOCK_S = 1.0
MISFIT_ALLOWANCE = 0.15  # motion is no white noise, and blocks are not quite independent
TABLE = ("name", "unit", "prior_sd", "estimate", "sd")


@dataclass(frozen=True)
class Settings:
    """What an analyst may choose.

    Parameters
    ----------
    rate_hz : float
        Of blocks, knots and the history.
    longest_gap_s : float
        Without field or Sun, that is bridged; shorter where the vehicle turns by a quarter in less.
    confidence : float
        Two-sided, of each verdict.
    unstated : Unstated
        Errors that no data sheet states.
    """

    rate_hz: float = 10.0
    longest_gap_s: float = 5.0
    confidence: float = 0.999
    unstated: Unstated = field(default_factory=Unstated)


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
    findings : tuple of Finding
    verdicts : tuple of Verdict
        Whether each sensor's residuals and constant errors are as large as its data sheet says.
    sensor_errors : DataFrame
        ``name, unit, prior_sd, estimate, sd`` (SI).
    sightings : tuple of Sightings
        What was fitted; knots are rows of the history.
    """

    time_s: FloatArray
    q_ecef_body: FloatArray
    covariance: FloatArray
    rate_body_radps: FloatArray
    method: str
    findings: tuple[Finding, ...]
    consistency_checks: tuple[ConsistencyCheck, ...]
    sensor_errors: pd.DataFrame
    sightings: tuple[Sightings, ...]


def reconstruct_attitude(
    telemetry: Telemetry,
    position: Position | tuple[FloatArray, FloatArray] | None = None,
    settings: Settings | None = None,
) -> AttitudeHistory:
    """Attitude of the body over the time that magnetometer, Sun sensors and position cover together.

    Parameters
    ----------
    telemetry : Telemetry
    position : callable or (time_s (k,), position_ecef_m (k, 3)), optional
        Where the vehicle was. It only places the vehicle in the Earth's field, which changes by 25 nT/km at most: a
        kilometre is 0.03 deg, so a raw track is plenty, and no attitude of a filter comes in by this door. Medians
        over a second of the flight's radars and receivers where it is not given.
    settings : Settings, optional

    Raises
    ------
    GateError
        Where magnetometer or Sun sensors are missing, share no time, or never fix an attitude.
    """
    settings = settings or Settings()
    magnetometer, sun = required_vectors(telemetry)
    place, spans = _place(telemetry, position)
    spans += [(magnetometer.time_s[0], magnetometer.time_s[-1]), (sun.time_s[0], sun.time_s[-1])]
    start_s, end_s = max(a for a, _ in spans), min(b for _, b in spans)
    step_s = 1.0 / settings.rate_hz
    first, last = np.ceil(start_s * settings.rate_hz - 1e-6), np.floor(end_s * settings.rate_hz + 1e-6)
    if last - first < 2:
        raise GateError(
            f"flight '{telemetry.name}': magnetometer, Sun sensors and position share {start_s:.3f} to {end_s:.3f} s, "
            "too little for an attitude; check their time bases"
        )
    knots_s = np.arange(first, last + 1.0) / settings.rate_hz
    terms = error_terms(magnetometer.spec, sun.spec, settings.unstated, float(knots_s[0]), float(knots_s[-1]))
    sightings = [
        sight_magnetometer(magnetometer, telemetry.t0_utc, knots_s, step_s, place, terms),
        *sight_sun(sun, telemetry.t0_utc, knots_s, step_s, place, terms),
    ]
    solved, q = _solve_each(telemetry.name, sightings, len(knots_s))
    keep, findings = _bridged(knots_s, solved, q, settings)
    kept_s = knots_s[keep]
    sightings = [_renumbered(seen, keep) for seen in sightings]
    q_start = rotations.slerp(knots_s[solved], q, kept_s) if len(solved) > 1 else q
    knots = Knots(kept_s, step_s, np.asarray(np.diff(np.flatnonzero(keep)) == 1))
    fit, used = smooth(knots, [seen for seen in sightings if len(seen.knot)], terms, q_start)
    return _history(knots, fit, terms, used, [*findings, *_fit_findings(fit, sightings, used, knots)], settings)


def required_vectors(telemetry: Telemetry) -> tuple[TriadRecord, SunRecord]:
    """Magnetometer and Sun record, or `GateError` that says what flight.toml lacks."""
    wanted = {"magnetometer": telemetry.magnetometer, "sun": telemetry.sun}
    faults = [
        f"flight '{telemetry.name}' has no [sensors.{name}], and an attitude from directions needs both magnetometer "
        f"and Sun sensors; add [sensors.{name}] with its table to flight.toml"
        for name, record in wanted.items()
        if record is None
    ]
    if faults or telemetry.magnetometer is None or telemetry.sun is None:
        raise GateError(faults)
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
        raise GateError(f"flight '{telemetry.name}': position is empty or not finite; the field needs a place")
    return lambda at: interpolate_rows(at, time_s, points), [(float(time_s[0]), float(time_s[-1]))]


def track(telemetry: Telemetry) -> tuple[FloatArray, FloatArray]:
    """Times (k,) and positions (k, 3), ECEF m: medians over `TRACK_BLOCK_S` of all radar points and receiver fixes."""
    times = [r.time_s for r in telemetry.radars.values()] + [r.time_s for r in telemetry.gnss.values()]
    points = [
        earth.ecef_from_radar(r.range_az_el, r.site.latitude_rad, r.site.longitude_rad, r.site.height_m)
        for r in telemetry.radars.values()
    ] + [r.position_ecef_m for r in telemetry.gnss.values()]
    t, p = np.concatenate(times), np.concatenate(points)
    whole = np.isfinite(p).all(axis=1)
    if not whole.any():
        raise GateError(f"flight '{telemetry.name}': no radar point and no fix places the vehicle in the Earth's field")
    block = np.floor(t[whole] / TRACK_BLOCK_S)
    table = pd.DataFrame(np.column_stack([t, p])[whole]).groupby(block).median().to_numpy(copy=True)
    # a block's ends are nearer to its median than a field of a kilometre
    table[0, 0], table[-1, 0] = t[whole].min(), max(t[whole].max(), table[0, 0] + 1e-3)
    return table[:, 0], table[:, 1:]


def _solve_each(name: str, sightings: list[Sightings], count: int) -> tuple[IntArray, FloatArray]:
    """Knots that an attitude can be told at by themselves, and these attitudes (k, 4), against inertial axes."""
    body, reference = np.zeros((count, 2, 3)), np.zeros((count, 2, 3))
    weight = np.zeros((count, 2))
    for seen in sightings:
        which = 0 if seen.is_field else 1
        share = 1.0 / seen.constant_sd_rad**2
        body[seen.knot, which] += share * seen.directions_body()
        reference[seen.knot, which] = unit(seen.reference_eci)
        weight[seen.knot, which] += share
    both = np.flatnonzero((weight > 0.0).all(axis=1) & (np.linalg.norm(body, axis=2) > 0.0).all(axis=1))
    q, covariance = solve_vectors(unit(body[both]), reference[both], weight[both] ** -0.5)
    sharp = np.linalg.eigvalsh(covariance)[:, -1] < BLIND_RAD**2
    if not sharp.any():
        why = (
            "field and Sun stand so near to one line that a turn about it is not seen"
            if len(both)
            else "no head sees the Sun while the magnetometer measures"
        )
        raise GateError(f"flight '{name}': no attitude from directions: {why}")
    return both[sharp], rotations.continuous(q[sharp])


def _bridged(
    knots_s: FloatArray, solved: IntArray, q: FloatArray, settings: Settings
) -> tuple[BoolArray, list[Finding]]:
    """Knots to solve at: between those that tell an attitude, less gaps too long to be bridged, which are findings."""
    step = np.diff(knots_s[solved])
    turned = np.linalg.norm(rotations.boxminus(q[1:], q[:-1]), axis=1)
    rate = float(np.median(turned / step)) if len(step) else 0.0
    longest = min(settings.longest_gap_s, QUARTER_RAD / max(rate, 1e-9))
    keep = np.zeros(len(knots_s), dtype=bool)
    keep[solved[0] : solved[-1] + 1] = True
    found = []
    for k in np.flatnonzero(step > longest):
        keep[solved[k] + 1 : solved[k + 1]] = False
        words = f"no attitude for {step[k]:.1f} s: field or Sun missing, and up to {longest:.1f} s can be bridged"
        found.append(Finding("attitude check", words, float(knots_s[solved[k]]), float(knots_s[solved[k + 1]])))
    return keep, found


def _renumbered(seen: Sightings, keep: BoolArray) -> Sightings:
    rows = np.asarray(keep[seen.knot])
    return seen.take(rows, (np.cumsum(keep) - 1)[seen.knot[rows]])


def _fit_findings(fit: Fit, before: list[Sightings], after: list[Sightings], knots: Knots) -> list[Finding]:
    ends = float(knots.time_s[0]), float(knots.time_s[-1])
    left = {seen.name: len(seen.knot) for seen in after}
    found = [
        Finding(seen.name, f"{len(seen.knot) - left[seen.name]} blocks edited from the attitude check", *ends)
        for seen in before
        if len(seen.knot) > left.get(seen.name, len(seen.knot))
    ]
    if not fit.converged:
        found.append(Finding("attitude check", f"not settled after {fit.steps} steps", *ends))
    return found


def _history(
    knots: Knots, fit: Fit, terms: ErrorTerms, used: list[Sightings], findings: list[Finding], settings: Settings
) -> AttitudeHistory:
    sd = np.sqrt(np.diagonal(fit.error_covariance))
    table = pd.DataFrame(
        dict(zip(TABLE, (list(terms.names), list(terms.units), terms.prior_sd, fit.errors, sd), strict=True))
    )
    return AttitudeHistory(
        time_s=knots.time_s,
        q_ecef_body=rotations.continuous(rotations.multiply(earth.q_ecef_eci(knots.time_s), fit.q_eci_body)),
        covariance=fit.covariance[:, :3, :3],
        rate_body_radps=fit.rate_radps,
        method="magnetometer and Sun sensors, smoothed; no gyro, no accelerometer",
        findings=tuple(findings),
        consistency_checks=tuple(_consistency_checks(fit, terms, settings.confidence)),
        sensor_errors=table,
        sightings=tuple(used),
    )


def _consistency_checks(fit: Fit, terms: ErrorTerms, confidence: float) -> list[ConsistencyCheck]:
    """Of each sensor its residuals, and its constant errors against its data sheet."""
    from scipy.stats import chi2

    out: list[ConsistencyCheck] = []
    tail = 0.5 * (1.0 - confidence)
    for name, (squares, expected) in fit.misfit.items():
        low, high = chi2.ppf([tail, 1.0 - tail], expected) / expected
        out.append(
            consistency_check(
                "attitude-residuals",
                f"residuals {name}",
                squares / expected,
                float(low) - MISFIT_ALLOWANCE,
                float(high) + MISFIT_ALLOWANCE,
                f"{name}: residuals as large as its noise",
                f"{name}: residuals are not as large as its noise says: check noise, clocking and interference",
            )
        )
    sd = np.sqrt(np.diagonal(fit.error_covariance))
    for name in dict.fromkeys(terms.instruments):
        own = terms.of(name)
        names = [terms.names[i] for i in own]
        said = data_sheet_check("data-sheet", name, names, fit.errors[own], terms.prior_sd[own], sd[own], confidence)
        out += [said] if said is not None else []
    return out


__all__ = [
    "AttitudeComparison",
    "AttitudeHistory",
    "Settings",
    "StartAttitude",
    "Unstated",
    "compare",
    "reconstruct_attitude",
    "start_attitude_from_vectors",
]
LEAST_INSIDE = 0.90


@dataclass(frozen=True)
class StartAttitude:
    """Attitude at one time, and its covariance (3, 3) of the right-hand rotation in body axes, rad^2."""

    time_s: float
    q_ecef_body: FloatArray
    covariance: FloatArray

    def prior(self) -> AttitudePrior:
        """As flight.toml would state it: standard deviations about the body axes, without their correlation."""
        return AttitudePrior(self.time_s, self.q_ecef_body, np.sqrt(np.diagonal(self.covariance)))


@dataclass(frozen=True)
class AttitudeComparison:
    """History minus trajectory.

    Parameters
    ----------
    time_s : (n,) float
    difference_body_rad, sd_body_rad : (n, 3) float
        About body axes, and their predicted standard deviation (both attitudes', as if independent).
    rms_rad : float
        Of the total angle.
    mean_body_rad : (3,) float
    share_inside : float
        Of all differences, within three standard deviations.
    mean_nees : float
        Over time, of squared differences in units of their covariance; 3 is expected.
    turn_body_rad, turn_sd_rad : dict
        For each sensor the constant turn (3,) by which it differs from the trajectory, and how large that may be.
    passed : bool
    words : str
    """

    time_s: FloatArray
    difference_body_rad: FloatArray
    sd_body_rad: FloatArray
    rms_rad: float
    mean_body_rad: FloatArray
    share_inside: float
    mean_nees: float
    turn_body_rad: dict[str, FloatArray]
    turn_sd_rad: dict[str, float]
    passed: bool
    words: str


def compare(history: AttitudeHistory, trajectory: Trajectory, confidence: float = 0.999) -> AttitudeComparison:
    """History minus trajectory at the history's times within the trajectory.

    Differences last, so that neither their number inside a band nor their mean square scatters as that of independent
    ones. The mean square in units of the covariance is at most as spread as that of one time, so it passes below the
    chi-square quantile of three degrees of freedom; a tenth of the differences may lie beyond three standard
    deviations.

    Where they do not agree, the constant turn of every sensor against the trajectory says which one it is; a turn that
    all share speaks against the trajectory.

    Raises
    ------
    GateError
        Where the two share no time.
    """
    from scipy.stats import chi2

    t = history.time_s
    rows = np.flatnonzero((t >= trajectory.time_s[0]) & (t <= trajectory.time_s[-1]))
    if len(rows) == 0:
        raise GateError(
            f"attitude check: the history's {t[0]:.3f} to {t[-1]:.3f} s lie outside the trajectory's "
            f"{trajectory.time_s[0]:.3f} to {trajectory.time_s[-1]:.3f} s"
        )
    other = resample(trajectory, t[rows])
    off = rotations.boxminus(history.q_ecef_body[rows], other.q_ecef_body)
    theirs = np.zeros((len(rows), 3, 3)) if other.covariance is None else other.covariance[:, 6:9, 6:9]
    covariance = history.covariance[rows] + theirs
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    nees = float(np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).mean())
    inside = float(np.mean(np.abs(off) <= 3.0 * sd))
    passed = bool(nees <= chi2.ppf(confidence, 3) and inside >= LEAST_INSIDE)
    rms, predicted = (float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in (off, sd))
    spread = float(np.sqrt(np.trace(theirs, axis1=1, axis2=2).mean() / 3.0))
    turns, allowed = _turns(history, other, rows, spread)
    words = (
        f"attitude from magnetometer and Sun {'agrees with' if passed else 'contradicts'} the trajectory: "
        f"{np.rad2deg(rms):.2f} deg rms where {np.rad2deg(predicted):.2f} deg is predicted, "
        f"{100.0 * inside:.0f} % inside three standard deviations"
    )
    if not passed:
        words += f"; {_suspects(turns, allowed, confidence)}"
    return AttitudeComparison(t[rows], off, sd, rms, off.mean(axis=0), inside, nees, turns, allowed, passed, words)


def _turns(
    history: AttitudeHistory, other: Trajectory, rows: IntArray, spread_rad: float
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Constant turn (3,) of each sensor's directions against a trajectory at the history's ``rows``, and its size."""
    turns, allowed = {}, {}
    number = np.full(len(history.time_s), -1)
    number[rows] = np.arange(len(rows))
    for seen in history.sightings:
        at = number[seen.knot]
        use = at >= 0
        if not use.any():
            continue
        lag = seen.lag_s[use]
        q = rotations.multiply(
            rotations.conjugate(earth.q_ecef_eci(other.time_s[at[use]])),
            rotations.boxplus(other.q_ecef_body[at[use]], other.omega_body_eci_body_radps[at[use]] * lag[:, None]),
        )
        predicted = rotations.rotate(rotations.conjugate(q), unit(seen.reference_eci[use]))
        crossed = np.cross(predicted, seen.directions_body()[use]).sum(axis=0)
        seen_twice = use.sum() * np.eye(3) - predicted.T @ predicted
        # a sensor that saw one direction only is not said to be turned about it
        turns[seen.name] = np.linalg.solve(seen_twice + 0.01 * use.sum() * np.eye(3), crossed)
        allowed[seen.name] = float(np.hypot(seen.constant_sd_rad, spread_rad))
    return turns, allowed


def _suspects(turns: dict[str, FloatArray], allowed: dict[str, float], confidence: float) -> str:
    """Which sensors stand off the trajectory by more than they may."""
    from scipy.stats import norm

    limit = float(norm.isf(0.5 * (1.0 - confidence) / (3 * len(turns))))
    angle = {name: float(np.linalg.norm(turn)) for name, turn in turns.items()}
    off = [name for name in turns if np.abs(turns[name]).max() > limit * allowed[name]]
    said = ", ".join(f"{name} ({np.rad2deg(angle[name]):.1f} deg)" for name in sorted(off, key=lambda n: -angle[n]))
    if not off:
        return "no single sensor stands off: check noise, time tags and the trajectory's attitude"
    if len(off) == len(turns) > 1:
        return f"all sensors stand off it: {said}; the trajectory's attitude is doubtful, or what they share"
    return f"what stands off it: {said}; check mounting, clocking and signs"


def start_attitude_from_vectors(
    telemetry: Telemetry,
    around_s: float,
    position: Position | tuple[FloatArray, FloatArray] | None = None,
    settings: Settings | None = None,
    span_s: float = 60.0,
) -> StartAttitude:
    """Attitude near a time, from the data of ``span_s`` about it, to start a filter with.

    A longer span teaches more about the sensors' constant errors; attitude and rate themselves follow within seconds.

    Raises
    ------
    GateError
        As `reconstruct_attitude`, and where there are no data in the span.
    """
    magnetometer, sun = required_vectors(telemetry)
    begin = float(np.clip(around_s - 0.5 * span_s, sun.time_s[0], max(sun.time_s[0], sun.time_s[-1] - span_s)))

    def near(record: TriadRecord | SunRecord) -> BoolArray:
        return np.asarray((record.time_s >= begin) & (record.time_s <= begin + span_s))

    in_field, in_sun = near(magnetometer), near(sun)
    if not in_field.any() or not in_sun.any():
        raise GateError(
            f"flight '{telemetry.name}': no attitude from directions at {around_s:.3f} s: magnetometer covers "
            f"{magnetometer.time_s[0]:.3f} to {magnetometer.time_s[-1]:.3f} s, Sun sensors {sun.time_s[0]:.3f} to "
            f"{sun.time_s[-1]:.3f} s"
        )
    part = replace(
        telemetry,
        magnetometer=TriadRecord(
            magnetometer.spec, magnetometer.time_s[in_field], magnetometer.measured_sensor[in_field]
        ),
        sun=SunRecord(sun.spec, sun.time_s[in_sun], sun.az_el_head_rad[in_sun]),
    )
    history = reconstruct_attitude(part, position, settings)
    k = int(np.argmin(np.abs(history.time_s - around_s)))
    return StartAttitude(float(history.time_s[k]), history.q_ecef_body[k], history.covariance[k])

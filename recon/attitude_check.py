"""Does the trajectory's attitude agree with one from magnetometer and Sun sensors alone, and what does that start with?

The check that a range makes with its own attitude solution (seed paper, section on the reconstruction):
`reconstruct_attitude` takes neither gyro nor accelerometer nor filter, `compare` holds it against a trajectory and
names the sensor that contradicts it, `start_attitude_from_vectors` starts a filter where no attitude is stated.

A comparison is of two independent attitudes only if the trajectory was made without these sensors: one whose filter
read them too, or was started from them, agrees too well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.telemetry import AttitudePrior, SunRecord, Telemetry, TriadRecord
from flightmodel.trajectory import Trajectory, resample
from recon.vector_attitude import AttitudeHistory, Settings, reconstruct_attitude, required_vectors
from recon.vector_sensors import IntArray, Position, Unstated, unit

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

"""Do all tables, and the attitude to start from, lie in one span of time, and does that attitude fit the force?

A wrong t0 moves what tells its time by a clock and leaves what counts seconds where it is. A wrong attitude points the
accelerometer's force, turned by the gyros from the attitude's time on, away from where the track has the force; it is
doubted beyond four standard deviations of the attitude and of what the gyros add to it on the way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import AttitudePrior, Finding, TriadRecord
from postflight.intake.odd_turning import CELL_S, CLEAR, LEAST_WINDOWS, SPAN_S, cell_means
from postflight.intake.track import TrackForce

CARRIED_S = 0.1  # the gyros' samples reach this far beyond their ends
FARTHEST_S = 600.0  # that gyros are trusted to carry an attitude
DOUBT_SD, WRONG_RAD, RIGHT_RAD = 4.0, np.deg2rad(30.0), np.deg2rad(15.0)
MOST_HOURS = 24
READINGS = {
    "with the scalar last, so put its last number first": [3, 0, 1, 2],
    "as from ECEF to body, so turn the signs of its last three numbers": None,
}


def apart_in_time(found: Sources) -> list[Finding]:
    """Tell of tables, and of an attitude prior, that lie outside the time of the others."""
    spans = _spans(found)
    first = next((name for name in ("accelerometer", "rates", *found.radars, *found.gnss) if name in spans), None)
    if first is None:
        return []
    low, high = spans[first]
    out = []
    for name, (start, stop) in spans.items():
        if stop < low or start > high:
            words = f"lies beside the {first}'s time, {low:.1f} to {high:.1f} s{_hours(start, stop, low, high)}"
            out.append(Finding(name, words, start, stop))
    prior = found.attitude_prior
    carrier = spans.get("rates")
    if prior is not None and carrier is not None and found.spec.motion.model == "strapdown":
        low, high = carrier
        t = prior.time_s
        if not low - CARRIED_S <= t <= high + CARRIED_S:
            hint = _hours(t, t, low, high)
            words = f"lies beside the gyros' time, {low:.1f} to {high:.1f} s, and they cannot carry it{hint}"
            out.append(Finding("attitude_prior", words, t, t))
    return out


def _spans(found: Sources) -> dict[str, tuple[float, float]]:
    records: dict[str, Any] = {**found.triads, **found.radars, **found.gnss, **found.barometers}
    if found.sun is not None:
        records["sun"] = found.sun
    if found.frames is not None:
        records["frames"] = found.frames
    return {name: (float(r.time_s[0]), float(r.time_s[-1])) for name, r in records.items() if len(r.time_s)}


def _hours(start: float, stop: float, low: float, high: float) -> str:
    """Say how many whole hours of t0 would bring a span among the others, if any do."""
    for hours in range(1, MOST_HOURS + 1):
        for shift in (3600.0 * hours, -3600.0 * hours):
            if low <= start + shift and stop + shift <= high:
                return f": is t0_utc right? Moved by {hours} h (a time zone?), times by clock and those in seconds meet"
    return ": is t0_utc right, and do all count from it?"


def attitude_and_force(found: Sources, force: TrackForce) -> list[Finding]:
    """Tell of an attitude prior from which the gyros turn the felt force away from where the track has it."""
    prior, gyros, sensed = found.attitude_prior, found.triads.get("rates"), found.triads.get("accelerometer")
    if prior is None or gyros is None or sensed is None:
        return []
    size, sd = force.size()
    half = 0.5 * force.width_s
    clear = np.flatnonzero((size > CLEAR * sd) & (force.time_s - half > prior.time_s))
    clear = clear[force.time_s[clear] < prior.time_s + FARTHEST_S] if len(clear) else clear
    if not len(clear):
        return []
    clear = clear[force.time_s[clear] < force.time_s[clear[0]] + SPAN_S]
    if len(clear) < LEAST_WINDOWS:
        return []
    grid = np.arange(prior.time_s, force.time_s[clear[-1]] + half, CELL_S)
    w, a = (cell_means(r.time_s, r.measured_sensor @ r.spec.dcm_body_sensor.T, grid) for r in (gyros, sensed))
    first = int(np.searchsorted(grid, force.time_s[clear[0]] - half))
    if not (np.isfinite(w).all() and np.isfinite(a[first:]).all()):
        return []
    off = _off(_readings(prior), grid, w, np.nan_to_num(a), force, clear)
    limit = max(WRONG_RAD, DOUBT_SD * _sd_rad(prior, gyros, grid, w))
    if off[0] < limit:
        return []
    right = [words for words, value in zip(READINGS, off[1:], strict=True) if value < RIGHT_RAD]
    said = f"points the force {np.rad2deg(off[0]):.0f} deg away from where the track has it, turned there by the gyros"
    entry = found.spec.attitude_prior
    told = entry is not None and entry.q_ecef_body is not None
    if told and len(right) == 1:
        hint = f"; it fits when read {right[0]}"
    elif told:
        hint = ": is q_ecef_body scalar first, from body to ECEF, and of that time?"
    else:
        hint = ": check azimuth_deg, elevation_deg, roll_deg, the place and the time"
    return [Finding("attitude_prior", f"{said}{hint}", prior.time_s, float(force.time_s[clear[-1]]))]


def _readings(prior: AttitudePrior) -> FloatArray:
    """Quaternions (1 + readings, 4), body to inertial axes: as stated, and as a slip of the pen would have it."""
    q = prior.q_ecef_body
    every = [q, *(rotations.conjugate(q) if order is None else q[order] for order in READINGS.values())]
    inertial = rotations.conjugate(earth.q_ecef_eci(prior.time_s))
    return np.array([rotations.multiply(inertial, one) for one in every])


def _sd_rad(prior: AttitudePrior, gyros: TriadRecord, grid: FloatArray, w: FloatArray) -> float:
    """How far a right attitude may be off at the end: its own deviation, the gyros' bias and scale."""
    turned = float(np.linalg.norm(w, axis=1).sum()) * CELL_S
    s = gyros.spec
    return float(np.linalg.norm([prior.sd_rad.max(), s.bias_sd * (grid[-1] - grid[0]), s.scale_sd * turned]))


def _off(
    q: FloatArray, grid: FloatArray, w: FloatArray, a: FloatArray, force: TrackForce, clear: np.ndarray
) -> FloatArray:
    """Rms angle between the turned force and the track's for each attitude to start from, rad."""
    sums = np.zeros((len(q), len(clear), 3))
    half = 0.5 * force.width_s
    for k, t in enumerate(grid):
        u = (t - force.time_s[clear]) / half
        weight = np.maximum(1 - u * u, 0.0) ** 2
        if weight.any():
            sums += rotations.rotate(q, np.tile(a[k], (len(q), 1)))[:, None, :] * weight[None, :, None]
        q = rotations.boxplus(q, np.tile(w[k] * CELL_S, (len(q), 1)))
    told = force.force_mps2[clear]
    cosine = np.einsum("cki,ki->ck", sums, told) / (np.linalg.norm(sums, axis=2) * np.linalg.norm(told, axis=1))
    return np.asarray(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2, axis=1)))

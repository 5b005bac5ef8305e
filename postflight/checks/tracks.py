"""Do tracks fall as the Earth pulls, do they lie where the others lie, and do their clocks agree?

A vehicle above the air falls freely. A range in feet that is read as metres falls three times too slowly or too fast;
so every unit that a radar's columns may have is tried, and one is named only where the declared one is denied by nearly
all windows in free fall and that one is borne out by nearly all.

Do all tables, and the attitude to start from, lie in one span of time, and does that attitude fit the force?

A wrong t0 moves what tells its time by a clock and leaves what counts seconds where it is. A wrong attitude points the
accelerometer's force, turned by the gyros from the attitude's time on, away from where the track has the force; it is
doubted beyond four standard deviations of the attitude and of what the gyros add to it on the way.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from flightmodel import earth, rotations, tables
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.flightfolder import Sources
from flightmodel.instruments import RADAR
from flightmodel.tables import UNITS
from flightmodel.telemetry import AttitudePrior, Finding, GnssRecord, RadarRecord, TriadRecord
from postflight.checks.inertial import CELL_S, CLEAR, LEAST_WINDOWS, SPAN_S, cell_means
from postflight.checks.track_force import (
    TrackForce,
    coasting,
    slope_through_mean,
    track_force,
    unit_of,
    unit_that_explains,
)

FALL_WIDTH_S = 16.0
STILL_MPS2 = 0.3
SHARP_MPS2 = 1.0  # windows that tell acceleration worse than this tell no unit
FREE = 5.0  # standard deviations that a free fall may be off
DENIED, BORNE_OUT = 0.1, 0.8
APART_SD, APART_M = 20.0, 1000.0
STRETCH_S = 10.0
CLOCK_SD, CLOCK_S = 5.0, 0.1


def tracks(found: Sources) -> dict[str, RadarRecord | GnssRecord]:
    """Radars and receivers by name."""
    return {**found.radars, **found.gnss}


def position_of(record: RadarRecord | GnssRecord) -> FloatArray:
    """Places (n, 3), ECEF m."""
    if isinstance(record, GnssRecord):
        return record.position_ecef_m
    s = record.site
    return earth.ecef_from_radar(record.range_az_el, s.latitude_rad, s.longitude_rad, s.height_m)


def free_fall(found: Sources, name: str, record: RadarRecord) -> list[Finding]:
    """Tell of a radar whose units, or order of angles, make a free fall that is none."""
    declared = tuple(unit_of(found.spec.radars[name], q) for q in tables.RADAR)
    shares = {}
    for units in _candidates(declared):
        tried = _reread(record, declared, units)
        if tried is not None:
            shares[units] = _share_that_falls(found, record, tried)
    own, span = shares.pop((*declared, "az el"))
    better = {units: share for units, (share, _) in shares.items() if share is not None and share > BORNE_OUT}
    if own is None or own > DENIED or not better:
        return []
    best = max(better, key=lambda units: better[units])
    if any(share > better[best] - 0.1 for units, share in better.items() if units != best):
        named = "several other units of its columns would do"
    else:
        swapped = " with azimuth and elevation exchanged" if best[3] == "el az" else ""
        pairs = zip(("range", "az", "el"), declared, best, strict=False)
        changed = ", ".join(f"{short} in '{new}' instead of '{old}'" for short, old, new in pairs if old != new)
        named = f"{changed}{swapped} would fall as the Earth pulls"
    words = f"its track does not fall as the Earth pulls where nothing else acts; {named.strip()}"
    return [Finding(name, words, *span)]


def _candidates(declared: tuple[str, ...]) -> list[tuple[str, ...]]:
    ranges = dict.fromkeys([declared[0], "m", "yd", "ft", "km", "kft", "nmi"])
    angles = dict.fromkeys([declared[1], "deg", "rad"])
    return [
        (r, a, a if a != declared[1] else declared[2], o) for r, a, o in product(ranges, angles, ("az el", "el az"))
    ]


def _reread(record: RadarRecord, declared: tuple[str, ...], units: tuple[str, ...]) -> FloatArray | None:
    """Places as other units, or exchanged angles, would have them; None where they cannot be."""
    factor = [UNITS[new][1] / UNITS[old][1] for new, old in zip(units, declared, strict=False)]
    values = record.range_az_el * np.array(factor)
    if units[3] == "el az":
        values = values[:, [0, 2, 1]]
    elevation = values[:, 2][np.isfinite(values[:, 2])]
    if np.abs(elevation).max(initial=0.0) > 0.5 * np.pi or np.abs(values[:, 1]).max(initial=0.0) > 4 * np.pi:
        return None
    s = record.site
    return earth.ecef_from_radar(values, s.latitude_rad, s.longitude_rad, s.height_m)


def _share_that_falls(
    found: Sources, record: RadarRecord, position_m: FloatArray
) -> tuple[float | None, tuple[float, float]]:
    """Share of windows (in coast, where an accelerometer tells it) without force, and their span."""
    nothing = (np.nan, np.nan)
    force = track_force(record.time_s, position_m, FALL_WIDTH_S)
    if force is None:
        return None, nothing
    use = _sharp(force)
    sensed = found.triads.get("accelerometer")
    if sensed is not None:
        use &= coasting(force, sensed.time_s, sensed.measured_sensor, STILL_MPS2)
    if use.sum() < 4:
        return None, nothing
    off = force.force_mps2[use]
    z = np.sqrt(np.einsum("ki,kij,kj->k", off, np.linalg.inv(force.covariance[use]), off))
    small = np.linalg.norm(off, axis=1) < 0.5
    times = force.time_s[use]
    return float(((z < FREE) | small).mean()), (float(times[0]), float(times[-1]))


def _sharp(force: TrackForce) -> BoolArray:
    largest = np.linalg.eigvalsh(force.covariance)
    return np.asarray((np.sqrt(largest[:, 2]) < SHARP_MPS2) & (largest[:, 0] > 0.0))


def receiver_velocity(found: Sources, name: str, record: GnssRecord) -> list[Finding]:
    """Tell of a receiver whose velocities are not how its places change: unit, sign of an axis."""
    t, p, v = record.time_s, record.position_ecef_m, record.velocity_ecef_mps
    whole = np.isfinite(p).all(axis=1) & np.isfinite(v).all(axis=1)
    t, p, v = t[whole], p[whole], v[whole]
    if len(t) < 20:
        return []
    # way over stretches of some seconds: from fix to fix the noise of places hides it
    step = np.diff(t)
    way = np.vstack([np.zeros(3), np.cumsum(0.5 * (v[1:] + v[:-1]) * step[:, None], axis=0)])
    first = np.searchsorted(t, np.arange(t[0], t[-1] - STRETCH_S, STRETCH_S))
    last = np.minimum(np.searchsorted(t, t[first] + STRETCH_S), len(t) - 1)
    gaps = np.concatenate([[0], np.cumsum(step > 5.0 * float(np.median(step)))])
    whole = gaps[first] == gaps[last]
    first, last = first[whole], last[whole]
    if len(first) < 6:
        return []
    moved = earth.ned_from_ecef((p[last] - p[first]) / STRETCH_S, p[first])
    told = earth.ned_from_ecef((way[last] - way[first]) / STRETCH_S, p[first])
    span = (float(t[0]), float(t[-1]))
    slopes = [slope_through_mean(told[:, k], moved[:, k]) for k in range(3)]
    sure = [(k, s) for k, (s, sd) in enumerate(slopes) if sd < 0.1 * abs(s)]
    out = []
    for k, slope in sure:
        if abs(slope + 1.0) < 0.2:
            axis = ("north", "east", "down")[k]
            words = f"its places move the other way than its velocities say, {axis}: turn that axis (up for down?)"
            out.append(Finding(name, words, *span))
    ratio = float(np.median([abs(s) for _, s in sure])) if sure else 1.0
    entry = found.spec.gnss[name]
    stated = next((q for q in tables.GNSS if q.kind == "speed" and q.short in entry.columns), tables.GNSS[6])
    unit = unit_that_explains(ratio, unit_of(entry, stated))
    if ratio > 0.0 and not 0.8 < ratio < 1.25:
        hint = f": speeds are taken as '{unit_of(entry, stated)}', they look like '{unit}'" if unit else ""
        out.append(Finding(name, f"its places move {ratio:.3g} times as fast as its velocities say{hint}", *span))
    return out


def apart(found: Sources, first: str, second: str) -> tuple[list[Finding], tuple[float, float] | None]:
    """Compare two tracks where both are: findings, and how late the second's clock is (s, sd), where that can be told.

    The distance along the motion is a late clock and the sensors' own errors, which the standard deviations of
    flight.toml bound.
    """
    a, b = tracks(found)[first], tracks(found)[second]
    pa, pb = position_of(a), position_of(b)
    a_whole, b_whole = np.isfinite(pa).all(axis=1), np.isfinite(pb).all(axis=1)
    ta, pa, tb, pb = a.time_s[a_whole], pa[a_whole], b.time_s[b_whole], pb[b_whole]
    inside = (tb > ta[0]) & (tb < ta[-1])
    after = np.clip(np.searchsorted(ta, tb), 1, len(ta) - 1)
    inside &= ta[after] - ta[after - 1] < 2.0  # no bridge over gaps
    if inside.sum() < 20:
        return [], None
    tb, pb = tb[inside], pb[inside]
    other = np.column_stack([np.interp(tb, ta, c) for c in pa.T])
    force = track_force(ta, pa, 4.0) or track_force(ta, pa, FALL_WIDTH_S)
    off = pb - other
    own = float(np.median(np.hypot(_sd_m(a, other), _sd_m(b, pb))))
    distance = float(np.median(np.linalg.norm(off, axis=1)))
    span = (float(tb[0]), float(tb[-1]))
    clock = None
    if force is not None:
        moving = force.velocity_mps - np.cross(earth.OMEGA_ECEF_RADPS, force.position_m)
        speed = np.interp(tb, force.time_s, np.linalg.norm(moving, axis=1))
        direction = np.gradient(other, tb, axis=0)
        direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None]
        fast = speed > 50.0
        if fast.sum() >= 20:
            # b is late by d: it shows at t what a showed at t - d
            d = -np.einsum("ki,ki->k", off[fast], direction[fast]) / speed[fast]
            across = np.linalg.norm(off[fast], axis=1) ** 2 - (d * speed[fast]) ** 2
            if float(np.median(across)) < max(9.0 * own**2, (0.1 * distance) ** 2):
                clock = float(np.median(d)), own / float(np.median(speed[fast]))
    if clock is not None and abs(clock[0]) > max(CLOCK_SD * clock[1], CLOCK_S):
        words = f"its times are {_late(clock[0])} {first}'s by {abs(clock[0]):.3f} +- {clock[1]:.3f} s"
        return [Finding(second, words, *span)], clock
    if distance > max(APART_SD * own, APART_M):
        words = f"lies {distance / 1000:.3g} km from where {first} has it (median), where {own:.0f} m would be usual"
        return [Finding(second, f"{words}: check site, units and times of both", *span)], clock
    return [], clock


def _late(lag_s: float) -> str:
    return "later than" if lag_s > 0 else "earlier than"


def _sd_m(record: RadarRecord | GnssRecord, position_m: FloatArray) -> FloatArray:
    """Usual size of a track's own errors at its places (n,), m, biases with noise."""
    if isinstance(record, GnssRecord):
        s = record.spec
        return np.full(
            len(position_m), float(np.sqrt(2 * s.horizontal_sd_m**2 + s.vertical_sd_m**2 + s.wander_sd_m**2))
        )
    site = record.site
    at = earth.ecef_from_geodetic(site.latitude_rad, site.longitude_rad, site.height_m)
    slant = np.linalg.norm(position_m - at, axis=1)
    own = [getattr(site, row.name) for row in RADAR.rows if row.unit == "rad" and row.states]
    angle = np.sqrt(2 * (site.angle_sd_rad**2 + sum(sd**2 for sd in own)))
    scale = site.range_scale_sd * slant
    return np.asarray(np.sqrt(site.range_sd_m**2 + site.range_bias_sd_m**2 + scale**2 + (angle * slant) ** 2))


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

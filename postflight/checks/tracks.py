"""Do tracks fall as gravity requires, agree with each other in place and time, and cover the same span of time?

Above the atmosphere the specific force of a track is zero. A range in feet that is read as metres falls three times too
slowly or too fast; so every unit that a radar's columns may have is tried, and one is named only where the declared one
is contradicted in nearly all coasting windows and another is borne out in nearly all. Two trackers differ along the
motion by a time bias, ``dx = -v d``, and by their own errors, which the standard deviations of flight.toml bound. A
receiver's velocity integrates to its displacement. A wrong ``t0_utc`` moves tables whose times are of the day against
those that count seconds from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from flightmodel import earth, tables
from flightmodel.checks import BoolArray, FloatArray, Issue
from flightmodel.flightfolder import Sources
from flightmodel.instruments import RADAR
from flightmodel.telemetry import GnssRecord, RadarRecord, Telemetry
from flightmodel.units import read_unit
from postflight.checks.track_force import TrackForce, coasting, track_force
from postflight.checks.units_and_axes import (
    TimeBias,
    interval_around,
    slope_through_mean,
    unit_hint,
    unit_of,
    unit_that_explains,
)

# long, as free fall changes slowly: the acceleration of a radar of 5 m is good to 0.05 m/s2
_FALL_WIDTH_S = 16.0
_STILL_MPS2 = 0.3  # of a vehicle that coasts: bias of a coarse accelerometer
_SHARP_MPS2 = 1.0  # windows with a larger sd of acceleration decide on no unit
_FREE = 5.0  # standard deviations that a free fall may be off
_DENIED, _BORNE_OUT = 0.1, 0.8  # shares of windows in free fall: a wrong unit has hardly any, the right one nearly all
_APART_SD, _APART_M = 20.0, 1000.0  # no survey or bias is so far off: another place, or another flight
_STRETCH_S = 10.0  # over which a velocity's frame moves a position by more than a receiver's noise
_LEAST_SPEED_MPS = 50.0  # below it a time bias hardly moves a track
_CARRIED_S = 0.1  # the gyros' samples reach this far beyond their ends
_MOST_HOURS = 24  # of local time taken for UTC


def tracks(found: Sources | Telemetry) -> dict[str, RadarRecord | GnssRecord]:
    """Return radars and receivers that fix positions by themselves, by name."""
    whole = {name: r for name, r in found.radars.items() if np.isfinite(r.range_az_el).all(axis=1).any()}
    return {**whole, **{name: record for name, record in found.gnss.items() if record.has_positions}}


def position_of(record: RadarRecord | GnssRecord, planet: earth.Planet = earth.WGS84) -> FloatArray:
    """Return a tracker's positions (n, 3), ECEF m."""
    if isinstance(record, GnssRecord):
        return record.position_ecef_m
    return earth.ecef_from_radar(record.range_az_el, *record.spec.geodetic, planet)


# spans of time


def outside_time(found: Sources) -> list[Issue]:
    """Check that tables and the attitude prior overlap the others in time: ``time-not-covered`` if not."""
    spans = _spans(found)
    first = next((name for name in ("accelerometer", "rates", *found.radars, *found.gnss) if name in spans), None)
    if first is None:
        return []
    low, high = spans[first]
    out = []
    for name, (start, stop) in spans.items():
        if stop < low or start > high:
            words = f"lies outside the {first}'s time, {low:.1f} to {high:.1f} s{_hours(start, stop, low, high)}"
            out.append(Issue(words, "time-not-covered", name, start, stop))
    prior = found.attitude_prior
    carrier = spans.get("rates")
    if prior is not None and carrier is not None and found.spec.motion.model == "strapdown":
        low, high = carrier
        t = prior.time_s
        if not low - _CARRIED_S <= t <= high + _CARRIED_S:
            hint = _hours(t, t, low, high)
            words = f"lies outside the gyros' time, {low:.1f} to {high:.1f} s, and they cannot carry it{hint}"
            out.append(Issue(words, "time-not-covered", "attitude_prior", t, t))
    return out


def _spans(found: Sources) -> dict[str, tuple[float, float]]:
    records: dict[str, Any] = {**found.triads, **found.radars, **found.gnss, **found.barometers}
    if found.sun is not None:
        records["sun"] = found.sun
    records |= {table: found.films[name] for table, name in found.spec.film_names.items() if name in found.films}
    return {name: (float(r.time_s[0]), float(r.time_s[-1])) for name, r in records.items() if len(r.time_s)}


def _hours(start: float, stop: float, low: float, high: float) -> str:
    """Hint with the whole hours by which t0 would have to change, if any bring the span among the others."""
    for hours in range(1, _MOST_HOURS + 1):
        for shift in (3600.0 * hours, -3600.0 * hours):
            if low <= start + shift and stop + shift <= high:
                return f": is t0_utc right? Moved by {hours} h (a time zone?), times of day and seconds after t0 agree"
    return ": is t0_utc right, and do all count from it?"


# units of a radar, by free fall


def free_fall(found: Sources, record: RadarRecord) -> list[Issue]:
    """Check a radar's units and order of angles by free fall: ``unit-suspect``, ``axes-suspect``, or none."""
    name = record.spec.name
    declared = tuple(unit_of(found.spec.radars[name], q) for q in tables.RADAR)
    shares = {}
    for units in _candidates(declared):
        tried = _reread(record, declared, units, found.spec.body)
        if tried is not None:
            shares[units] = _share_that_falls(found, record, tried)
    own, span = shares.pop((*declared, "az el"))
    better = {units: share for units, (share, _) in shares.items() if share is not None and share > _BORNE_OUT}
    if own is None or own > _DENIED or not better:
        return []
    best = max(better, key=lambda units: better[units])
    code, hint = "unit-suspect", "several other units of its columns fit"
    if not any(share > better[best] - 0.1 for units, share in better.items() if units != best):
        pairs = zip(("range", "az", "el"), declared, best, strict=False)
        changes = [f"{short} in '{new}' instead of '{old}'" for short, old, new in pairs if old != new]
        if best[3] == "el az":
            code, changes = "axes-suspect", [*changes, "azimuth and elevation exchanged"]
        hint = f"{', '.join(changes)} would fit"
    words = f"in coast {100 * own:.0f} % of its track's windows are free of force, as gravitation asks; {hint}"
    return [Issue(words, code, name, *span)]


def _candidates(declared: tuple[str, ...]) -> list[tuple[str, ...]]:
    ranges = dict.fromkeys([declared[0], "m", "yd", "ft", "km", "kft", "nmi"])
    angles = dict.fromkeys([declared[1], "deg", "rad"])
    return [
        (r, a, a if a != declared[1] else declared[2], o) for r, a, o in product(ranges, angles, ("az el", "el az"))
    ]


def _reread(
    record: RadarRecord, declared: tuple[str, ...], units: tuple[str, ...], planet: earth.Planet
) -> FloatArray | None:
    """Positions (n, 3), ECEF m, with other units or exchanged angles assumed; None if they are impossible."""
    pairs = [(read_unit(new), read_unit(old)) for new, old in zip(units[:3], declared[:3], strict=True)]
    factor = [new.factor / old.factor for new, old in pairs if new is not None and old is not None]
    values = record.range_az_el * np.array(factor)
    if units[3] == "el az":
        values = values[:, [0, 2, 1]]
    elevation = values[:, 2][np.isfinite(values[:, 2])]
    if np.abs(elevation).max(initial=0.0) > 0.5 * np.pi or np.abs(values[:, 1]).max(initial=0.0) > 4 * np.pi:
        return None
    return earth.ecef_from_radar(values, *record.spec.geodetic, planet)


def _share_that_falls(
    found: Sources, record: RadarRecord, position_m: FloatArray
) -> tuple[float | None, tuple[float, float]]:
    """Fraction of windows without force (in coast, if an accelerometer shows it), and their span."""
    nothing = (np.nan, np.nan)
    force = track_force(record.time_s, position_m, _FALL_WIDTH_S, found.spec.body)
    if force is None:
        return None, nothing
    use = _sharp(force)
    sensed = found.triads.get("accelerometer")
    if sensed is not None:
        use &= coasting(force, sensed.time_s, sensed.measured_sensor, _STILL_MPS2)
    if use.sum() < 4:
        return None, nothing
    off = force.force_mps2[use]
    z = np.sqrt(np.einsum("ki,kij,kj->k", off, np.linalg.inv(force.covariance[use]), off))
    small = np.linalg.norm(off, axis=1) < 0.5
    times = force.time_s[use]
    return float(((z < _FREE) | small).mean()), (float(times[0]), float(times[-1]))


def _sharp(force: TrackForce) -> BoolArray:
    largest = np.linalg.eigvalsh(force.covariance)
    return np.asarray((np.sqrt(largest[:, 2]) < _SHARP_MPS2) & (largest[:, 0] > 0.0))


# a receiver's velocities


def receiver_velocity(found: Sources, record: GnssRecord) -> list[Issue]:
    """Check a receiver's velocities against displacements: ``axes-suspect``, ``unit-suspect`` or none."""
    from scipy.integrate import cumulative_trapezoid  # a tenth of a second

    name, t, p, v = record.spec.name, record.time_s, record.position_ecef_m, record.velocity_ecef_mps
    whole = np.isfinite(p).all(axis=1) & np.isfinite(v).all(axis=1)
    t, p, v = t[whole], p[whole], v[whole]
    if len(t) < 20:
        return []
    # displacement over stretches of some seconds: from fix to fix the noise of positions hides it
    step = np.diff(t)
    way = cumulative_trapezoid(v, t, axis=0, initial=0.0)
    first = np.searchsorted(t, np.arange(t[0], t[-1] - _STRETCH_S, _STRETCH_S))
    last = np.minimum(np.searchsorted(t, t[first] + _STRETCH_S), len(t) - 1)
    gaps = np.concatenate([[0], np.cumsum(step > 5.0 * float(np.median(step)))])
    whole = gaps[first] == gaps[last]
    first, last = first[whole], last[whole]
    if len(first) < 6:
        return []
    moved = earth.ned_from_ecef((p[last] - p[first]) / _STRETCH_S, p[first], found.spec.body)
    integrated = earth.ned_from_ecef((way[last] - way[first]) / _STRETCH_S, p[first], found.spec.body)
    span = (float(t[0]), float(t[-1]))
    slopes = [slope_through_mean(integrated[:, k], moved[:, k]) for k in range(3)]
    sure = [(k, s) for k, (s, sd) in enumerate(slopes) if sd < 0.1 * abs(s)]
    out = []
    for k, slope in sure:
        if abs(slope + 1.0) < 0.2:
            axis = ("north", "east", "down")[k]
            words = f"its velocity has the opposite sign of its displacement, {axis}: check that axis (up for down?)"
            out.append(Issue(words, "axes-suspect", name, *span))
    ratio = float(np.median([abs(s) for _, s in sure])) if sure else 1.0
    if ratio > 0.0 and not 0.8 < ratio < 1.25:
        entry = found.spec.gnss[name]
        stated = next((q for q in tables.GNSS if q.kind == "speed" and q.short in entry.columns), tables.GNSS[6])
        declared = unit_of(entry, stated)
        hint = unit_hint(declared, unit_that_explains(ratio, declared))
        words = f"its displacement is {ratio:.3g} times its integrated velocity{hint}"
        out.append(Issue(words, "unit-suspect", name, *span))
    return out


# two trackers


def tracker_pair(
    trackers: Mapping[str, RadarRecord | GnssRecord], first: str, second: str, planet: earth.Planet
) -> tuple[list[Issue], TimeBias | None]:
    """Compare two trackers over the times that both cover.

    Parameters
    ----------
    trackers : mapping
        Of `tracks`.
    first, second : str
        Names of two of them.
    planet : Planet

    Returns
    -------
    findings : list of Issue
        ``tracker-distance``, or none.
    bias : TimeBias or None
        Of the second's time tags against the first's, where the distance lies along the motion.
    """
    a, b = trackers[first], trackers[second]
    pa, pb = position_of(a, planet), position_of(b, planet)
    a_whole, b_whole = np.isfinite(pa).all(axis=1), np.isfinite(pb).all(axis=1)
    ta, pa, tb, pb = a.time_s[a_whole], pa[a_whole], b.time_s[b_whole], pb[b_whole]
    inside = (tb > ta[0]) & (tb < ta[-1])
    inside &= interval_around(ta, tb) < 2.0  # no bridge over gaps
    if inside.sum() < 20:
        return [], None
    tb, pb = tb[inside], pb[inside]
    other = np.column_stack([np.interp(tb, ta, c) for c in pa.T])
    off = pb - other
    own = float(np.median(np.hypot(_sd_m(a, other, planet), _sd_m(b, pb, planet))))
    distance = float(np.median(np.linalg.norm(off, axis=1)))
    span = (float(tb[0]), float(tb[-1]))
    lag = _lag_along_motion(ta, pa, tb, other, off, max(9.0 * own**2, (0.1 * distance) ** 2), planet)
    bias = None if lag is None else TimeBias(second, first, lag[0], own / lag[1])
    if bias is not None and bias.is_significant:
        return [], bias
    if distance > max(_APART_SD * own, _APART_M):
        words = (
            f"{distance / 1000:.3g} km from {first} (median), where their errors are {own:.0f} m: check site, units "
            "and times of both"
        )
        return [Issue(words, "tracker-distance", second, *span)], bias
    return [], bias


def _lag_along_motion(
    ta: FloatArray,
    pa: FloatArray,
    tb: FloatArray,
    other: FloatArray,
    off: FloatArray,
    most_normal_m2: float,
    planet: earth.Planet,
) -> tuple[float, float] | None:
    """Lag of the second tracker's tags, s, and the speed, m/s; None if the distance is not along the motion."""
    force = track_force(ta, pa, 4.0, planet) or track_force(ta, pa, _FALL_WIDTH_S, planet)
    if force is None:
        return None
    speed = np.interp(tb, force.time_s, np.linalg.norm(force.relative_velocity_mps, axis=1))
    direction = np.gradient(other, tb, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None]
    fast = speed > _LEAST_SPEED_MPS
    if fast.sum() < 20:
        return None
    # b is late by d: it shows at t what a showed at t - d
    d = -np.einsum("ki,ki->k", off[fast], direction[fast]) / speed[fast]
    normal = np.linalg.norm(off[fast], axis=1) ** 2 - (d * speed[fast]) ** 2
    if not float(np.median(normal)) < most_normal_m2:
        return None
    return float(np.median(d)), float(np.median(speed[fast]))


def _sd_m(record: RadarRecord | GnssRecord, position_m: FloatArray, planet: earth.Planet) -> FloatArray:
    """Standard deviation (n,) of a track's own errors at positions (n, 3), biases with noise, m."""
    if isinstance(record, GnssRecord):
        s = record.spec
        return np.full(
            len(position_m), float(np.sqrt(2 * s.horizontal_sd_m**2 + s.vertical_sd_m**2 + s.wander_sd_m**2))
        )
    site = record.spec
    at = earth.ecef_from_geodetic(*site.geodetic, planet)
    slant = np.linalg.norm(position_m - at, axis=1)
    own = [getattr(site, row.name) for row in RADAR.rows if row.unit == "rad" and row.states]
    angle = np.sqrt(2 * (site.angle_sd_rad**2 + sum(sd**2 for sd in own)))
    scale = site.range_scale_sd * slant
    return np.asarray(np.sqrt(site.range_sd_m**2 + site.range_bias_sd_m**2 + scale**2 + (angle * slant) ** 2))

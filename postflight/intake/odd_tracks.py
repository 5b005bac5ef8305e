"""Do tracks fall as the Earth pulls, do they lie where the others lie, and do their clocks agree?

A vehicle above the air falls freely. A range in feet that is read as metres falls three times too slowly or too fast;
so every unit that a radar's columns may have is tried, and one is named only where the declared one is denied by nearly
all windows in free fall and that one is borne out by nearly all.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from flightmodel import columns, earth
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.columns import UNITS
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding, GnssRecord, RadarRecord
from postflight.intake.track import TrackForce, coasting, track_force
from postflight.intake.units import slope_through_mean, unit_of, unit_that_explains

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
    declared = tuple(unit_of(found.spec.radars[name], q) for q in columns.RADAR)
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
    stated = next((q for q in columns.GNSS if q.kind == "speed" and q.short in entry.columns), columns.GNSS[6])
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
    own = (site.mislevel_sd_rad, site.droop_sd_rad, site.skew_sd_rad, site.nonorthogonality_sd_rad, site.wander_sd_rad)
    angle = np.sqrt(2 * (site.angle_sd_rad**2 + site.angle_bias_sd_rad**2 + sum(sd**2 for sd in own)))
    scale = site.range_scale_sd * slant
    return np.asarray(np.sqrt(site.range_sd_m**2 + site.range_bias_sd_m**2 + scale**2 + (angle * slant) ** 2))

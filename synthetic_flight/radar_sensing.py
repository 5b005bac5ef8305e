"""What a tracking radar would have measured of the vehicle, with the systematic errors that ranges calibrate for.

In the order of the echo's way: time of the stamp, transit, bending and delay in the air, lag of the servo, errors of
the pedestal, wander, bias, noise, quantisation, lost points. With azimuth A and elevation E as they arrive there,

``dA = k sec E + n tan E + (tilt) + encoder(A) + wander sec E``,  ``dE = d cos E + (tilt) + encoder(E) + wander``,
``dR = s R``,

with skew k, non-orthogonality n, droop d, range scale s; the tilt is an exact rotation of the pedestal against the
local vertical. Each factor is drawn once a flight from a generator of its own.

References
----------
Range Commanders Council 753-95 (error model of tracking radars). Bean and Dutton, 1966, for the air
(`flightmodel.refraction`).
"""

from __future__ import annotations

import numpy as np
from scipy.constants import speed_of_light
from scipy.interpolate import CubicHermiteSpline

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray, GateError
from flightmodel.refraction import refracted
from synthetic_flight.instrument_sections import Radar
from synthetic_flight.sensing import sample_times
from synthetic_flight.simulate import Truth
from synthetic_flight.triad_errors import BUTTERWORTH, child, filtered, gauss_markov, kept

LOWEST_RAD = np.deg2rad(0.5)


def sense_radar(
    truth: Truth, spec: Radar, start_s: float, rng: np.random.Generator, name: str = "radar"
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and slant range m, azimuth, elevation rad ``(n, 3)`` of the vehicle's true c.g. (or its datum).

    Angle noise is that of the beam: across the line of sight, so azimuth scatters by ``1 / cos(elevation)`` more. A
    positive time bias stamps a point later than it was measured.

    Raises
    ------
    GateError
        Where fewer than two points are left, with ``name`` and what took them.
    """
    at = sample_times(start_s, truth.time_s[-1] - 0.05, spec.rate_hz, spec.offset_s)
    if len(at) < 2:
        raise GateError(
            f"radars.{name}: {len(at)} points from {start_s + spec.offset_s:g} s to the flight's end at "
            f"{truth.time_s[-1]:.2f} s; two are the least: raise rate_hz or lower offset_s"
        )
    bias_sd = np.array([spec.range_bias_m, *np.deg2rad([spec.angle_bias_deg] * 2)])
    bias = bias_sd * rng.standard_normal(3)
    late = spec.time_bias_s * rng.standard_normal()
    seen_at = np.clip(at - late, truth.time_s[0], truth.time_s[-1])
    arrived = echo(truth, spec, seen_at)
    noise_sd = np.array([spec.range_sd_m, *np.deg2rad([spec.angle_sd_deg] * 2)])
    noise = noise_sd * rng.standard_normal(arrived.shape)
    noise[:, 1] /= np.cos(arrived[:, 2])
    observed = in_air(arrived, spec) + servo_lag(truth, spec, seen_at)
    measured = observed + pedestal_errors(observed, spec, rng) + wander(at, observed, spec, rng) + bias + noise
    steps = (spec.range_resolution_m, *np.deg2rad([spec.angle_resolution_deg] * 2))
    for column, step in enumerate(steps):
        if step > 0.0:
            measured[:, column] = np.round(measured[:, column] / step) * step
    measured[:, 1] = np.mod(measured[:, 1], 2.0 * np.pi)
    keep = np.ones(len(at), dtype=bool)
    if spec.dropouts:
        keep &= kept(at, spec.dropouts.errors, child(rng, "dropouts"))
    near = np.full(len(at), True) if spec.max_range_m is None else arrived[:, 0] <= spec.max_range_m
    above = arrived[:, 2] >= np.deg2rad(spec.min_elevation_deg)
    if (keep & near & above).sum() < 2:
        highest, nearest = np.rad2deg(arrived[:, 2].max()), arrived[:, 0].min()
        raise GateError(
            f"radars.{name}: fewer than two of {len(at)} points are tracked; elevation is {highest:.2f} deg at most "
            f"(min_elevation_deg = {spec.min_elevation_deg:g}), range {nearest:.0f} m at least (max_range_m = "
            f"{'none' if spec.max_range_m is None else format(spec.max_range_m, 'g')}), dropouts take "
            f"{(~keep).sum()}; put the radar elsewhere or leave it out"
        )
    keep &= near & above
    return at[keep], measured[keep]


def echo(truth: Truth, spec: Radar, time_s: FloatArray) -> FloatArray:
    """Geometric slant range m, azimuth, elevation rad ``(n, 3)`` of the echo that arrives at a time.

    With ``transit_time`` it shows the vehicle where it was hit, ``R / c`` earlier.
    """
    if spec.tracks == "cg":
        path = CubicHermiteSpline(truth.time_s, truth.state_eci[:, 0:3], truth.state_eci[:, 3:6])
    else:
        datum = truth.trajectory
        path = CubicHermiteSpline(truth.time_s, datum.position_ecef_m, datum.velocity_ecef_mps)
    site = np.deg2rad([spec.latitude_deg, spec.longitude_deg])

    def geometric(at: FloatArray) -> FloatArray:
        position = path(at)
        ecef = rotations.rotate(earth.q_ecef_eci(at), position) if spec.tracks == "cg" else position
        return earth.radar_from_ecef(ecef, site[0], site[1], spec.height_m)

    now = geometric(time_s)
    if not spec.transit_time:
        return now
    # the range changes by 1 m in the half millisecond of transit: twice round is exact to a nanometre
    for _ in range(2):
        now = geometric(np.maximum(time_s - now[:, 0] / speed_of_light, truth.time_s[0]))
    return now


def in_air(geometric: FloatArray, spec: Radar) -> FloatArray:
    """Range, azimuth, elevation ``(n, 3)`` with that part of refraction which the range's correction leaves in.

    Below 0.5 deg of elevation, where layers along the horizon rule, refraction stays what it is there.
    """
    if spec.refraction is None or spec.refraction.residual == 0.0:
        return geometric
    air = spec.refraction.air
    elevation = np.maximum(geometric[:, 2], LOWEST_RAD)
    delay, bend = refracted(geometric[:, 0], elevation, np.deg2rad(spec.latitude_deg), spec.height_m, air)
    return geometric + spec.refraction.residual * np.column_stack([delay, np.zeros_like(delay), bend])


def servo_lag(truth: Truth, spec: Radar, time_s: FloatArray) -> FloatArray:
    """Lag ``(n, 3)`` of the angles behind a servo without velocity lag: ``- acceleration / w^2`` when slow."""
    if spec.angle_servo_hz == 0.0:
        return np.zeros((len(time_s), 3))
    # ten seconds before the first point the servo has forgotten its start (0.1 Hz and up)
    rows = truth.time_s >= time_s[0] - max(10.0, 3.0 / spec.angle_servo_hz)
    t = truth.time_s[rows]
    angles = np.unwrap(echo(truth, spec, t)[:, 1:], axis=0)
    w = 2.0 * np.pi * spec.angle_servo_hz
    damping = 2.0 * BUTTERWORTH * w
    behind = filtered(angles, float(t[1] - t[0]), [damping, w * w], [1.0, damping, w * w]) - angles
    return np.column_stack([np.zeros(len(time_s)), *(np.interp(time_s, t, column) for column in behind.T)])


def pedestal_errors(observed: FloatArray, spec: Radar, rng: np.random.Generator) -> FloatArray:
    """Systematic errors ``(n, 3)`` of range, azimuth and elevation that the pedestal adds to what arrives at it."""

    def drawn(name: str, size: float, count: int) -> FloatArray:
        # np.zeros keeps an absent error from costing a generator
        return size * child(rng, name).standard_normal(count) if size > 0.0 else np.zeros(count)

    slant, az, el = observed.T
    out = np.zeros_like(observed)
    out[:, 0] = drawn("range scale", spec.range_scale, 1) * slant
    out[:, 1] = np.deg2rad(drawn("skew", spec.skew_deg, 1)) / np.cos(el)
    out[:, 1] += np.deg2rad(drawn("nonorthogonality", spec.nonorthogonality_deg, 1)) * np.tan(el)
    out[:, 2] = np.deg2rad(drawn("droop", spec.droop_deg, 1)) * np.cos(el)
    for name, size, turns in (("once", spec.encoder_once_deg, 1), ("twice", spec.encoder_twice_deg, 2)):
        wave = np.deg2rad(drawn(f"encoder {name}", size, 4))
        out[:, 1] += wave[0] * np.sin(turns * az) + wave[1] * np.cos(turns * az)
        out[:, 2] += wave[2] * np.sin(turns * el) + wave[3] * np.cos(turns * el)
    if spec.mislevel_deg > 0.0:
        out[:, 1:] += mislevel(az, el, np.deg2rad(drawn("mislevel", spec.mislevel_deg, 2)))
    return out


def mislevel(azimuth_rad: FloatArray, elevation_rad: FloatArray, tilt_rad: FloatArray) -> FloatArray:
    """Errors ``(n, 2)`` in azimuth and elevation of a pedestal turned by ``tilt_rad`` (2,) about north and east."""
    turn = rotations.dcm_from_q(rotations.exp(np.array([*tilt_rad, 0.0])))
    level = np.column_stack(
        [
            np.cos(elevation_rad) * np.cos(azimuth_rad),
            np.cos(elevation_rad) * np.sin(azimuth_rad),
            -np.sin(elevation_rad),
        ]
    )
    north, east, down = (level @ turn).T
    az = np.arctan2(east, north) - azimuth_rad
    el = np.arctan2(-down, np.hypot(north, east)) - elevation_rad
    return np.column_stack([np.mod(az + np.pi, 2.0 * np.pi) - np.pi, el])


def wander(time_s: FloatArray, observed: FloatArray, spec: Radar, rng: np.random.Generator) -> FloatArray:
    """Slow random error ``(n, 3)`` of both angles, of one size across the line of sight."""
    out = np.zeros_like(observed)
    if spec.wander_deg > 0.0:
        size = float(np.deg2rad(spec.wander_deg))
        out[:, 1:] = gauss_markov(time_s, size, spec.wander_time_constant_s, 2, child(rng, "wander"))
        out[:, 1] /= np.cos(observed[:, 2])
    return out

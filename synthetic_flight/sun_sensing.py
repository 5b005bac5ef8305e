"""What two-axis Sun sensors around the roll axis would have measured: two angles per head, where it sees the Sun.

A head sees the Sun inside its cone while the Sun stands above the Earth's limb. Errors, per head: mounting, constant
part and noise across the line of sight, and the pull of the sunlit Earth, by which the direction turns towards
``s + w (u . s)+ (R / r)^2 nadir`` (``u`` up, ``w`` the weight ``albedo``): a crude model of the light that comes back,
largest over the subsolar point and zero on the night side.
"""

from __future__ import annotations

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.geomagnetism_and_sun import is_sun_visible, sun_direction_ecef
from flightmodel.instruments import dcm_body_from_sun_head, sun_angles_from_direction
from flightmodel.trajectory import interpolate_rows
from synthetic_flight.instrument_sections import SunSensors
from synthetic_flight.sensing import sample_times
from synthetic_flight.simulate import Truth
from synthetic_flight.triad_errors import child, kept


def sense_sun(
    truth: Truth, spec: SunSensors, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and azimuth and elevation ``(n, heads, 2)``, rad, in each head's axes; NaN where it sees no Sun.

    Each head draws from a generator of its own, by its number.
    """
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    seen_at = np.clip(at - spec.delay_s, truth.time_s[0], truth.time_s[-1])
    position = interpolate_rows(seen_at, truth.time_s, truth.trajectory.position_ecef_m)
    to_sun = sun_direction_ecef(truth.trajectory.epoch_utc, seen_at)
    lit = is_sun_visible(position, to_sun)
    to_body = rotations.conjugate(rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, seen_at))
    radius = np.linalg.norm(position, axis=1, keepdims=True)
    up = position / radius
    noon = np.maximum(np.sum(up * to_sun, axis=1, keepdims=True), 0.0)
    earthlight = -spec.albedo * noon * (earth.SEMI_MAJOR_M / radius) ** 2 * up
    sun_body, earth_body = rotations.rotate(to_body, to_sun), rotations.rotate(to_body, earthlight)
    heads = [
        _head(sun_body, earth_body, lit, clock, spec, child(rng, f"head {k}"))
        for k, clock in enumerate(np.deg2rad(spec.heads_lv_deg))
    ]
    angles = np.stack(heads, axis=1)
    if spec.dropouts:
        keep = kept(at, spec.dropouts.errors, child(rng, "dropouts"))
        return at[keep], angles[keep]
    return at, angles


def _head(
    sun_body: FloatArray,
    earth_body: FloatArray,
    lit: BoolArray,
    clock_lv_rad: float,
    spec: SunSensors,
    rng: np.random.Generator,
) -> FloatArray:
    """Azimuth and elevation ``(n, 2)`` of one head."""
    noise, bias, mount, step = np.deg2rad([spec.noise_deg, spec.bias_deg, spec.mount_deg, spec.resolution_deg])
    dcm = dcm_body_from_sun_head(clock_lv_rad) @ rotations.dcm_from_q(rotations.exp(mount * rng.standard_normal(3)))
    sun, glow = sun_body @ dcm, earth_body @ dcm
    edge = np.cos(0.5 * np.deg2rad(spec.field_deg))
    # the Earth fills half the sky: a head has its middle in view or takes none of its light
    light = sun + np.where(glow[:, 2:] > edge * np.linalg.norm(glow, axis=1, keepdims=True), glow, 0.0)
    angles = sun_angles_from_direction(light)
    error = bias * rng.standard_normal(2) + noise * rng.standard_normal(angles.shape)
    error[:, 0] /= np.maximum(np.cos(angles[:, 1]), 1e-3)
    angles = angles + error
    angles[:, 0] = np.mod(angles[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    if step > 0.0:
        angles = np.round(angles / step) * step
    angles[~lit | (sun[:, 2] < edge)] = np.nan
    return np.asarray(angles)

"""What instruments on and around the vehicle would have measured: truth plus the errors of real instruments.

Each instrument draws from its own generator. Systematic errors are drawn once a flight. The sounding of the day is in
`synthetic_flight.day_air`.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray
from flightmodel.trajectory import interpolate_rows
from flightmodel.vehicle import Vehicle
from synthetic_flight.scenarios import Accelerometer, Attitude, Radar, Rates
from synthetic_flight.simulate import Truth


def sample_times(start_s: float, stop_s: float, rate_hz: float, offset_s: float = 0.0) -> FloatArray:
    """Times of samples at a rate, rounded to a microsecond so that files hold them exactly."""
    n = int(np.floor((stop_s - start_s - offset_s) * rate_hz + 1e-9)) + 1
    return np.round(start_s + offset_s + np.arange(n) / rate_hz, 6)


def _triad_errors(
    ideal_sensor: FloatArray, noise: float, bias: float, scale: float, mount_rad: float, resolution: float,
    rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """Measured values ``(n, 3)`` of a triad whose axes are turned by a small mounting error."""
    turn = rotations.dcm_from_q(rotations.exp(mount_rad * rng.standard_normal(3)))
    factor = 1.0 + scale * rng.standard_normal(3)
    offset = bias * rng.standard_normal(3)
    measured = (ideal_sensor @ turn) * factor + offset + noise * rng.standard_normal(ideal_sensor.shape)
    return np.round(measured / resolution) * resolution if resolution > 0.0 else measured


def sense_accelerometer(
    truth: Truth, vehicle: Vehicle, mount: str, spec: Accelerometer, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and specific force ``(n, 3)`` in the package's own axes, m/s^2, at its own place."""
    package = vehicle.sensors[mount]
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    body = interpolate_rows(at, truth.time_s, truth.specific_force_body(np.array(package.position_from_datum_body_m)))
    ideal = body @ package.dcm_body_sensor
    mount_rad = float(np.deg2rad(spec.mount_deg))
    return at, _triad_errors(ideal, spec.noise_mps2, spec.bias_mps2, spec.scale, mount_rad, spec.resolution_mps2, rng)


def sense_rates(truth: Truth, spec: Rates, start_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and rates ``(n, 3)`` of the body against inertial space, body axes, rad/s."""
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    ideal = interpolate_rows(at, truth.time_s, truth.trajectory.omega_body_eci_body_radps)
    noise, bias, mount, step = np.deg2rad([spec.noise_degps, spec.bias_degps, spec.mount_deg, spec.resolution_degps])
    return at, _triad_errors(ideal, noise, bias, spec.scale, mount, step, rng)


def sense_radar(truth: Truth, spec: Radar, start_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and slant range m, azimuth, elevation rad ``(n, 3)`` of the vehicle's true c.g.

    Angle noise is that of the beam: across the line of sight, so azimuth scatters by ``1 / cos(elevation)`` more. A
    positive time bias stamps a point later than it was measured.
    """
    at = sample_times(start_s, truth.time_s[-1] - 0.05, spec.rate_hz, spec.offset_s)
    bias_sd = np.array([spec.range_bias_m, *np.deg2rad([spec.angle_bias_deg] * 2)])
    bias = bias_sd * rng.standard_normal(3)
    late = spec.time_bias_s * rng.standard_normal()
    true_at = np.clip(at - late, truth.time_s[0], truth.time_s[-1])
    cg = CubicHermiteSpline(truth.time_s, truth.state_eci[:, 0:3], truth.state_eci[:, 3:6])(true_at)
    ecef = rotations.rotate(earth.q_ecef_eci(true_at), cg)
    site = np.deg2rad([spec.latitude_deg, spec.longitude_deg])
    ideal = earth.radar_from_ecef(ecef, site[0], site[1], spec.height_m)
    noise_sd = np.array([spec.range_sd_m, *np.deg2rad([spec.angle_sd_deg] * 2)])
    noise = noise_sd * rng.standard_normal(ideal.shape)
    noise[:, 1] /= np.cos(ideal[:, 2])
    measured = ideal + bias + noise
    measured[:, 1] = np.mod(measured[:, 1], 2.0 * np.pi)
    return at, measured


def sense_attitude(truth: Truth, spec: Attitude, rng: np.random.Generator) -> FloatArray:
    """Quaternion (4,) ECEF from body that another source states for one time."""
    q = rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, np.array([spec.t_s]))[0]
    return rotations.boxplus(q, np.deg2rad(spec.sd_deg) * rng.standard_normal(3))

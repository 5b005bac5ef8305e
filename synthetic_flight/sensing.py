"""What instruments on and around the vehicle would have measured: truth plus the errors of real instruments.

Each instrument draws from its own generator. Systematic errors are drawn once a flight. Radars are in
`synthetic_flight.radar_sensing`, Sun sensors in `synthetic_flight.sun_sensing`, the sounding of the day in
`synthetic_flight.day_air`.
"""

from __future__ import annotations

import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray
from flightmodel.geomagnetism_and_sun import magnetic_field_ecef_t
from flightmodel.vehicle import Vehicle
from synthetic_flight.instrument_sections import Accelerometer, Attitude, Magnetometer, Rates
from synthetic_flight.simulate import Truth
from synthetic_flight.triad_errors import child, clock_late_s, measured, sampled


def sample_times(start_s: float, stop_s: float, rate_hz: float, offset_s: float = 0.0) -> FloatArray:
    """Times of samples at a rate, rounded to a microsecond so that files hold them exactly."""
    n = int(np.floor((stop_s - start_s - offset_s) * rate_hz + 1e-9)) + 1
    return np.round(start_s + offset_s + np.arange(n) / rate_hz, 6)


def sense_accelerometer(
    truth: Truth, vehicle: Vehicle, mount: str, spec: Accelerometer, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and specific force ``(n, 3)`` in the package's own axes, m/s^2, at its own place.

    Where the three elements have places of their own, each feels what is felt there.
    """
    package, errors = vehicle.sensors[mount], spec.errors
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    place, dcm = np.array(package.position_from_datum_body_m), package.dcm_body_sensor

    late_s = clock_late_s(errors, rng)

    def felt(position_from_datum_body_m: FloatArray) -> FloatArray:
        return sampled(at, truth.time_s, truth.specific_force_body(position_from_datum_body_m), errors, late_s) @ dcm

    if spec.elements_sensor_m:
        places = [place + dcm @ np.array(element) for element in spec.elements_sensor_m]
        ideal = np.column_stack([felt(each)[:, axis] for axis, each in enumerate(places)])
    else:
        ideal = felt(place)
    return measured(at, ideal, errors, rng)


def sense_rates(truth: Truth, spec: Rates, start_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and rates ``(n, 3)`` of the body against inertial space, body axes, rad/s."""
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    late_s = clock_late_s(spec.errors, rng)
    ideal = sampled(at, truth.time_s, truth.trajectory.omega_body_eci_body_radps, spec.errors, late_s)
    return measured(at, ideal, spec.errors, rng)


def sense_magnetometer(
    truth: Truth, vehicle: Vehicle, spec: Magnetometer, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and magnetic field ``(n, 3)`` in the package's own axes, tesla.

    The Earth's field at the package's own place, bent by the vehicle's iron (symmetric matrix) and added to the
    field of its magnets; both are fixed to the vehicle.
    """
    package = vehicle.sensors[spec.mount]
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    # what the low-pass still remembers of before the first sample
    rows = truth.time_s >= start_s - abs(spec.delay_s) - (10.0 / spec.bandwidth_hz if spec.bandwidth_hz > 0.0 else 0.1)
    t, q = truth.time_s[rows], truth.trajectory.q_ecef_body[rows]
    arm = np.broadcast_to(package.position_from_datum_body_m, (len(t), 3))
    place = truth.trajectory.position_ecef_m[rows] + rotations.rotate(q, arm)
    field = rotations.rotate(rotations.conjugate(q), magnetic_field_ecef_t(place, truth.trajectory.epoch_utc))
    if spec.soft_iron > 0.0:
        upper = np.triu(spec.soft_iron * child(rng, "soft iron").standard_normal((3, 3)))
        field = field @ (np.eye(3) + upper + np.triu(upper, 1).T)
    if spec.hard_iron_ut > 0.0:
        field = field + 1e-6 * spec.hard_iron_ut * child(rng, "hard iron").standard_normal(3)
    return measured(at, sampled(at, t, field, spec.errors) @ package.dcm_body_sensor, spec.errors, rng)


def sense_attitude(truth: Truth, spec: Attitude, rng: np.random.Generator) -> FloatArray:
    """Quaternion (4,) ECEF from body that another source states for one time."""
    q = rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, np.array([spec.t_s]))[0]
    return rotations.boxplus(q, np.deg2rad(spec.sd_deg) * rng.standard_normal(3))

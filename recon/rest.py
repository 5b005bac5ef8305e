"""What is known of a vehicle at rest on its pad? Velocity, level, heading, and the errors of its inertial sensors.

At rest on the Earth the accelerometer's velocity is zero, and accelerometer and gyros measure

    f = -C^T g,   w = C^T W

in body axes, with gravity ``g`` and the Earth's rate ``W``. In the filter the rest is a series of zero-velocity
measurements, which level the vehicle to the accelerometer's bias and observe that bias where the attitude is known
better, and one measurement of the Earth's rate by the mean of the gyros, which observes their biases and, where these
are small against the Earth's rate, the heading (gyrocompassing). Before the filter the size of the mean specific force
is compared with gravity, and the mean rates with the Earth's, against the data sheets (check ``at-rest``): a filter
that trusts a wrong data sheet would reject the rest instead.

Without an attitude prior the start's attitude is levelled by the mean specific force; its heading is that of the
launcher, of the magnetometer, or of the Earth's rate, in this order. What the filter measures again enters the prior
with so wide a standard deviation that it does not count twice.

References
----------
P. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd ed., 5.6 and 15.3.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from flightmodel import earth, geomagnetism_and_sun, rotations
from flightmodel.checks import Check, FloatArray, GateError, Issue
from flightmodel.telemetry import AttitudePrior, RestReadings, Telemetry, TriadRecord, mean_readings
from recon.measurements import FIELD, REST, VELOCITY, Instrument, instrument_of

_LEVEL_SD_RAD = float(np.deg2rad(5.0))  # of the levelled prior, which zero velocities measure to a tenth of a degree
_MOST_HEADING_RAD = float(np.deg2rad(30.0))  # beyond it linearisation fails
_AGAIN = 3.0  # the Earth's rate is measured again in the filter: a ninth of its information counts twice
_NOISE_FACTOR = 1.5  # between noise at rest and the data sheet's, from which it is worth a word


def gravity_ecef_mps2(position_ecef_m: FloatArray) -> FloatArray:
    """Gravity (3,): gravitation and centrifugal acceleration."""
    centrifugal = -np.cross(earth.OMEGA_ECEF_RADPS, np.cross(earth.OMEGA_ECEF_RADPS, position_ecef_m))
    return earth.gravitation(position_ecef_m) + centrifugal


def rest_instruments(telemetry: Telemetry, start_s: float, point_ecef_m: FloatArray) -> tuple[Instrument, ...]:
    """Zero velocities, and the Earth's rate by the gyros' mean; none without a rest after the start."""
    span = telemetry.start.at_rest
    if span is None or telemetry.rates is None:
        return ()
    times = np.arange(max(span[0], start_s), span[1] + 1e-9, 0.5)  # as first passes are thinned
    if not len(times):
        return ()
    latitude, longitude, _ = earth.geodetic_from_ecef(point_ecef_m)
    still = instrument_of(
        REST, VELOCITY, REST, np.zeros(3), np.zeros(3), earth.dcm_ned_ecef(float(latitude), float(longitude)),
        times, np.zeros((len(times), 3)), np.full(3, telemetry.start.sd_mps),
    )  # fmt: skip
    spec, mean = telemetry.rates.spec, mean_readings(telemetry.rates, span)
    if mean.count < 2:
        return (still,)
    walked = 2.0 * spec.bias_wander_sd**2 / spec.bias_time_constant_s * (span[1] - span[0]) / 3.0
    turning = instrument_of(
        f"{REST} rate", FIELD, spec.name, np.zeros(3), np.zeros(3), spec.dcm_body_sensor, times[:1], mean.mean[None],
        np.full(3, np.sqrt(_mean_var(telemetry.rates, mean) + walked)), earth.OMEGA_ECEF_RADPS[None],
        labels=("rate x", "rate y", "rate z"),
    )  # fmt: skip
    return still, turning


def _mean_var(record: TriadRecord, mean: RestReadings) -> float:
    """Variance of each axis of a mean: the larger of measured and stated noise, plus rounding."""
    noise = max(mean.noise_sd, record.spec.noise_sd)
    return noise**2 / mean.count + record.spec.resolution**2 / 12.0


def levelled_attitude(telemetry: Telemetry, start_s: float, point_ecef_m: FloatArray) -> AttitudePrior:
    """Attitude at rest by gravity and the best heading there is.

    Raises
    ------
    GateError
        ``heading-unknown``: neither launcher, magnetometer nor Earth rate give a heading to 30 deg.
    """
    span = telemetry.start.at_rest
    assert span is not None
    force, _ = telemetry.required_triads()
    f = force.spec.dcm_body_sensor @ mean_readings(force, span).mean
    up = f / np.linalg.norm(f)
    latitude, longitude, _ = (float(x) for x in earth.geodetic_from_ecef(point_ecef_m))
    ned = earth.dcm_ned_ecef(latitude, longitude)
    level_sd = force.spec.bias_sd / float(np.linalg.norm(gravity_ecef_mps2(point_ecef_m)))
    seen, true, sd = _heading(telemetry, span, ned, point_ecef_m, up, level_sd)
    if not sd < _MOST_HEADING_RAD:
        words = f"at rest from {span[0]:g} to {span[1]:g} s the heading is known to {np.rad2deg(sd):.0f} deg only"
        raise GateError(
            f"{words}; state the launcher's azimuth_deg and azimuth_sd_deg in [start], [attitude_prior], or "
            "[sensors.magnetometer] with a bias_sd_ut below the level field",
            code="heading-unknown",
        )
    c = _axes(np.array([0.0, 0.0, -1.0]), true) @ _axes(up, seen).T
    sd_body = np.sqrt(_LEVEL_SD_RAD**2 * (1.0 - up**2) + sd**2 * up**2)
    return AttitudePrior(start_s, rotations.q_from_dcm((ned.T @ c)[None])[0], sd_body)


def _axes(up: FloatArray, aside: FloatArray) -> FloatArray:
    """Columns: ``aside`` made level, the third, and up."""
    level = aside - (aside @ up) * up
    level = level / np.linalg.norm(level)
    return np.column_stack([level, np.cross(up, level), up])


def _heading(
    telemetry: Telemetry,
    span: tuple[float, float],
    dcm_ned_ecef: FloatArray,
    point_ecef_m: FloatArray,
    up_body: FloatArray,
    level_sd_rad: float,
) -> tuple[FloatArray, FloatArray, float]:
    """A direction in body axes and in north, east, down, and the standard deviation of the heading it gives, rad."""
    start = telemetry.start
    if start.azimuth_rad is not None:
        along = np.array([np.cos(start.azimuth_rad), np.sin(start.azimuth_rad), 0.0])
        lean = float(np.hypot(*up_body[1:]))  # sine of the nose's angle from the vertical
        return np.array([1.0, 0.0, 0.0]), along, float(np.hypot(start.azimuth_sd_rad, level_sd_rad / max(lean, 1e-6)))
    if telemetry.magnetometer is not None:
        record = telemetry.magnetometer
        field = dcm_ned_ecef @ geomagnetism_and_sun.magnetic_field_ecef_t(point_ecef_m[None], telemetry.t0_utc)[0]
        spec = record.spec
        size = np.linalg.norm(field)
        error = np.hypot(spec.bias_sd, size * max(spec.scale_sd, spec.soft_iron_sd))
        seen = spec.dcm_body_sensor @ mean_readings(record, span).mean
        if np.isfinite(seen).all():
            return seen, field, float(error / np.linalg.norm(field[:2]))
    rates = telemetry.required_triads()[1]
    turning = dcm_ned_ecef @ earth.OMEGA_ECEF_RADPS
    seen = rates.spec.dcm_body_sensor @ mean_readings(rates, span).mean
    error = np.sqrt(rates.spec.bias_sd**2 + _mean_var(rates, mean_readings(rates, span)))
    return seen, turning, float(_AGAIN * error / np.linalg.norm(turning[:2]))


def rest_checks(telemetry: Telemetry, confidence: float, point_ecef_m: FloatArray) -> list[Check]:
    """Mean specific force against gravity, mean rates against the Earth's, by the data sheets; none without a rest."""

    span = telemetry.start.at_rest
    if span is None or telemetry.accelerometer is None or telemetry.rates is None:
        return []
    most = float(-ndtri(0.5 * (1.0 - confidence)))
    out = []
    gravity = float(np.linalg.norm(gravity_ecef_mps2(point_ecef_m)))
    force, mean = telemetry.accelerometer, mean_readings(telemetry.accelerometer, span)
    if mean.count > 1:
        s, size = force.spec, float(np.linalg.norm(mean.mean))
        sd = np.sqrt(s.bias_sd**2 + s.bias_wander_sd**2 + (gravity * s.scale_sd) ** 2 + _mean_var(force, mean))
        symptom = f"at rest the accelerometer reads {size:.3f} m/s2 where gravity is {gravity:.3f}"
        out.append(
            Check.of(
                "at-rest", "at rest accelerometer", abs(size - gravity) / sd, 0.0, most, symptom,
                f"{symptom} ({100.0 * (size / gravity - 1.0):+.1f} %)", source=s.name, component="scale or bias",
                advice="scale factor or bias exceed the data sheet: check units and calibration",
            )
        )  # fmt: skip
    rates, turn = telemetry.rates, mean_readings(telemetry.rates, span)
    if turn.count > 1:
        s = rates.spec
        beyond = np.maximum(np.abs(turn.mean) - earth.OMEGA_RADPS, 0.0)
        sd = np.sqrt(s.bias_sd**2 + s.bias_wander_sd**2 + _mean_var(rates, turn))
        symptom = f"at rest the gyros read {', '.join(f'{x:+.3g}' for x in np.rad2deg(turn.mean))} deg/s"
        out.append(
            Check.of(
                "at-rest", "at rest gyros", float(beyond.max()) / sd, 0.0, most, symptom, symptom, source=s.name,
                component="bias", advice=f"a bias of {beyond.max() / s.bias_sd:.0f} times the data sheet's, or no rest",
            )
        )  # fmt: skip
    return out


def inflated_priors(telemetry: Telemetry, checks: list[Check], times: float) -> dict[str, float]:
    """Standard deviations, ``times`` what was found, of the errors that failed checks at rest are about."""
    out: dict[str, float] = {}
    span = telemetry.start.at_rest
    assert span is not None or not checks
    for check in (c for c in checks if not c.passed):
        record = telemetry.accelerometer if check.component != "bias" else telemetry.rates
        assert record is not None
        assert span is not None
        mean = mean_readings(record, span).mean
        if check.component == "bias":
            out |= {f"{record.spec.name} bias {a}": times * float(np.abs(mean).max()) for a in "xyz"}
            continue
        off = abs(float(np.linalg.norm(mean)) - earth.STANDARD_GRAVITY_MPS2)
        out |= {f"{record.spec.name} bias {a}": times * off for a in "xyz"}
        out |= {f"{record.spec.name} scale {a}": times * off / earth.STANDARD_GRAVITY_MPS2 for a in "xyz"}
    return out


def noise_findings(telemetry: Telemetry) -> list[Issue]:
    """Noise at rest where it differs from the data sheet's by more than half, as a proposal for it."""
    span, out = telemetry.start.at_rest, []
    if span is None:
        return []
    sensors = ((telemetry.accelerometer, "m/s2", 1.0), (telemetry.rates, "deg/s", float(np.rad2deg(1.0))))
    for record, unit, factor in sensors:
        if record is None:
            continue
        found = mean_readings(record, span).noise_sd
        stated = float(np.hypot(record.spec.noise_sd, record.spec.resolution / np.sqrt(12.0)))
        if not 1.0 / _NOISE_FACTOR < found / stated < _NOISE_FACTOR:
            words = f"noise at rest is {factor * found:.3g} {unit}, stated is {factor * stated:.3g}"
            words += ": proposed for the data sheet where the flight shakes no more"
            out.append(Issue(words, "noise-at-rest", record.spec.name, *span))
    return out

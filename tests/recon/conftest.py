"""A short flight with known truth, integrated by other means than the filter's, and sensors that err as on paper.

`sense` gives it inertial sensors and radars with plain errors, `sense_everything` every instrument and every error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from flightmodel import earth, geomagnetism_and_sun, rotations
from flightmodel.instruments import (
    BarometerSpec,
    GnssSpec,
    RadarSite,
    SunHeads,
    TriadSpec,
    dcm_body_from_clocking,
    sun_angles_from_direction,
)
from flightmodel.telemetry import (
    AttitudePrior,
    BarometerRecord,
    GnssRecord,
    RadarRecord,
    SunRecord,
    Telemetry,
    TriadRecord,
)
from flightmodel.trajectory import Trajectory
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from synthetic_flight.sensing import mislevel

from .ballistic_flight import gauss_markov

DEG = np.pi / 180.0
START, END = 100.0, 160.0
CG = np.array([-0.54, 0.004, -0.0004])
IMU = np.array([-0.95, 0.04, -0.03])
SPIN = 36.0 * DEG
REFERENCE = vehicle_from_toml(vehicle_path("irve2_reference"))
# what pitch damping depends on
PITCHING = {name: getattr(REFERENCE, name) for name in ("mass_kg", "inertia", "reference", "aero", "uncertainty")}
CLOCK_SD_S = 1e-3  # of both triads' clocks where these err
ACCELEROMETER = TriadSpec(
    "accelerometer", IMU, dcm_body_from_clocking(135 * DEG, 225 * DEG), 0.04, 0.05, 0.003, 0.15 * DEG, 0.01
)
RATES = TriadSpec("rates", np.zeros(3), np.eye(3), 0.05 * DEG, 0.04 * DEG, 0.003, 0.15 * DEG)
# southern latitude, so that no term of the Earth's rotation or shape is switched off
SITES = [
    RadarSite("north", -33.0 * DEG, 18.0 * DEG, 40.0, 5.0, 0.006 * DEG, 5.0, 0.005 * DEG, 0.002),
    RadarSite("west", -33.4 * DEG, 17.6 * DEG, 120.0, 2.0, 0.004 * DEG, 2.0, 0.003 * DEG, 0.001),
]
PRIOR_SD = 3.0 * DEG
EPOCH = "2009-08-17T12:52:00Z"
# every error alive: pedestals a few times worse than good ones, so that second order would show
FULL_SITES = [
    RadarSite(
        "north", -33.0 * DEG, 18.0 * DEG, 40.0, 5.0, 0.006 * DEG, 5.0, 0.005 * DEG, 0.002, mislevel_sd_rad=2e-4,
        droop_sd_rad=1e-4, skew_sd_rad=1e-4, nonorthogonality_sd_rad=1e-4, wander_sd_rad=5e-5,
        wander_time_constant_s=15.0, refraction_sd=0.1, range_scale_sd=2e-5,
    ),
    RadarSite(
        "west", -33.4 * DEG, 17.6 * DEG, 120.0, 2.0, 0.004 * DEG, 2.0, 0.003 * DEG, 0.001, mislevel_sd_rad=1e-4,
        droop_sd_rad=2e-4, skew_sd_rad=2e-4, nonorthogonality_sd_rad=2e-4, wander_sd_rad=1e-4,
        wander_time_constant_s=30.0, refraction_sd=0.2, range_scale_sd=1e-5,
    ),
]  # fmt: skip
RECEIVER = GnssSpec("receiver", np.array([-0.7, 0.2, 0.9]), 3.0, 5.0, 0.2, 0.3, 4.0, 60.0, 0.02)
BAROMETER = BarometerSpec("barometer", 20.0, 80.0, 0.01, 30.0, 25.0, 0.05)
MAGNETOMETER = TriadSpec(
    "magnetometer", np.zeros(3), dcm_body_from_clocking(40 * DEG, 130 * DEG), 1e-7, 5e-7, 0.01, 1.0 * DEG, 2e-8, 0.01
)
SUN = SunHeads("sun", np.array([20.0, 110.0, 200.0, 290.0]) * DEG, 120.0 * DEG, 0.2 * DEG, 0.3 * DEG, 0.5 * DEG)


def body_rate(t):
    """Spin with slow growing coning, rad/s, (..., 3)."""
    cone = (2.0 + 0.1 * (t - START)) * DEG
    phase = 2.1 * (t - START) + 0.4
    return np.stack([SPIN + 0.01 * np.sin(0.3 * t), cone * np.sin(phase), 1.3 * cone * np.cos(0.9 * phase)], axis=-1)


def specific_force_cg(t):
    """Drag pulse of about 8 g with lateral force, body axes, m/s^2, (..., 3)."""
    pulse = 80.0 * np.exp(-0.5 * ((t - 130.0) / 7.0) ** 2)
    swing = 1.7 * (t - START)
    return np.stack([-pulse, 0.05 * pulse * np.sin(swing), 0.04 * pulse * np.cos(1.1 * swing) + 0.01 * pulse], axis=-1)


@dataclass(frozen=True)
class MiniTruth:
    """Dense truth of the c.g. in inertial axes (equal to ECEF at time zero)."""

    dense: object

    def state(self, t):
        """ECEF position and velocity of the c.g., attitude, inertial rate in body axes."""
        y = self.dense(t).T
        turn = earth.q_ecef_eci(t)
        position = rotations.rotate(turn, y[..., 0:3])
        velocity = rotations.rotate(turn, y[..., 3:6]) - np.cross(earth.OMEGA_ECEF_RADPS, position)
        q = y[..., 6:10] / np.linalg.norm(y[..., 6:10], axis=-1, keepdims=True)
        return position, velocity, rotations.multiply(turn, q), body_rate(t)

    def trajectory(self, t, point=(0.0, 0.0, 0.0)):
        """Trajectory of a point given from the datum, body axes."""
        position, velocity, q, omega = self.state(t)
        arm = np.broadcast_to(np.array(point) - CG, (len(t), 3))
        rate = omega - rotations.rotate(rotations.conjugate(q), np.broadcast_to(earth.OMEGA_ECEF_RADPS, (len(t), 3)))
        return Trajectory(
            EPOCH,
            t,
            "datum",
            position + rotations.rotate(q, arm),
            velocity + rotations.rotate(q, np.cross(rate, arm)),
            rotations.continuous(q),
            omega,
        )

    def specific_force_imu(self, t):
        """Specific force at the accelerometer, body axes."""
        h = 1e-4
        w = body_rate(t)
        alpha = (body_rate(t + h) - body_rate(t - h)) / (2.0 * h)
        r = IMU - CG
        return specific_force_cg(t) + np.cross(alpha, r) + np.cross(w, np.cross(w, r))


def _truth():
    lat, lon = -33.6 * DEG, 18.9 * DEG
    position = earth.ecef_from_geodetic(lat, lon, 120e3)
    velocity = earth.ecef_from_ned(np.array([500.0, 700.0, 1300.0]), position)
    c_ned = earth.dcm_ned_ecef(lat, lon).T
    forward = c_ned.T @ velocity / np.linalg.norm(velocity)
    x = forward + np.array([0.06, -0.05, 0.03])
    x /= np.linalg.norm(x)
    y = np.cross([0.2, 0.5, -0.8], x)
    y /= np.linalg.norm(y)
    dcm_ned_body = np.column_stack([x, y, np.cross(x, y)])
    q_ecef = rotations.q_from_dcm((c_ned @ dcm_ned_body)[None])[0]
    turn = rotations.conjugate(earth.q_ecef_eci(START))

    def rhs(t, s):
        c = rotations.dcm_from_q(s[6:10] / np.linalg.norm(s[6:10]))
        qdot = 0.5 * rotations.multiply(s[6:10], np.concatenate([[0.0], body_rate(np.float64(t))]))
        return np.concatenate([s[3:6], earth.gravitation(s[0:3]) + c @ specific_force_cg(np.float64(t)), qdot])

    inertial_velocity = velocity + np.cross(earth.OMEGA_ECEF_RADPS, position)
    s0 = np.concatenate(
        [rotations.rotate(turn, position), rotations.rotate(turn, inertial_velocity), rotations.multiply(turn, q_ecef)]
    )
    sol = solve_ivp(rhs, (START - 5.0, END), s0, method="DOP853", rtol=1e-11, atol=1e-9, dense_output=True)
    return MiniTruth(sol.sol)


def measure_triad(spec, true_body, rng, errors=None):
    """What a triad measures of ``true_body`` (n, 3); returns samples and the drawn bias, scale, mount (9,)."""
    if errors is None:
        sd = np.repeat([spec.bias_sd, spec.scale_sd, spec.mount_sd_rad], 3)
        errors = sd * rng.standard_normal(9)
    actual = Rotation.from_rotvec(errors[6:9]).inv().apply(true_body @ spec.dcm_body_sensor)
    measured = (1.0 + errors[3:6]) * actual + errors[0:3] + spec.noise_sd * rng.standard_normal(true_body.shape)
    if spec.resolution > 0.0:
        measured = spec.resolution * np.round(measured / spec.resolution)
    return measured, errors


def measure_radar(truth, site, t, rng, point=CG, noise_factor=1.0):
    """Track points of one radar at tags ``t``; angle noise is of the line of sight. Also the drawn errors (4,)."""
    sd = [site.range_bias_sd_m, site.angle_bias_sd_rad, site.angle_bias_sd_rad, site.time_bias_sd_s]
    errors = np.array(sd) * rng.standard_normal(4)
    track = truth.trajectory(t - errors[3], point)
    z = earth.radar_from_ecef(track.position_ecef_m, site.latitude_rad, site.longitude_rad, site.height_m)
    noise = noise_factor * rng.standard_normal(z.shape) * [site.range_sd_m, site.angle_sd_rad, site.angle_sd_rad]
    noise[:, 1] /= np.cos(z[:, 2])
    return z + errors[:3] + noise + pedestal(site, t, z, rng), errors


def pedestal(site, t, z, rng):
    """What a pedestal that errs adds to range, azimuth and elevation (n, 3); the tilt is an exact turn."""
    out = np.zeros_like(z)
    if site.mislevel_sd_rad == 0.0:
        return out
    draw = rng.standard_normal
    az, el = z[:, 1], z[:, 2]
    out[:, 1:] = mislevel(az, el, site.mislevel_sd_rad * draw(2))
    out[:, 1] += site.skew_sd_rad * draw() / np.cos(el) + site.nonorthogonality_sd_rad * draw() * np.tan(el)
    out[:, 2] += site.droop_sd_rad * draw() * np.cos(el) + 3.2e-4 * site.refraction_sd * draw() / np.tan(el)
    out[:, 0] += site.range_scale_sd * draw() * z[:, 0]
    slow = gauss_markov(t, 2, site.wander_sd_rad, site.wander_time_constant_s, rng)
    out[:, 1] += slow[:, 0] / np.cos(el)
    out[:, 2] += slow[:, 1]
    if site.range_wander_sd_m > 0.0:
        out[:, 0] += gauss_markov(t, 1, site.range_wander_sd_m, site.range_wander_time_constant_s, rng)[:, 0]
    return out


def measure_gnss(truth, spec, t, rng):
    """Fixes of a receiver; its slow error is along north, east and down of the first fix."""
    track = truth.trajectory(t - spec.time_bias_sd_s * rng.standard_normal(), spec.antenna_from_datum_body_m)
    latitude, longitude, _ = earth.geodetic_from_ecef(track.position_ecef_m[0])
    ned = earth.dcm_ned_ecef(float(latitude), float(longitude))
    sd = np.array([spec.horizontal_sd_m, spec.horizontal_sd_m, spec.vertical_sd_m])
    speed_sd = np.array([spec.speed_sd_mps, spec.speed_sd_mps, spec.vertical_speed_sd_mps])
    place = sd * rng.standard_normal((len(t), 3))
    place += gauss_markov(t, 3, spec.wander_sd_m, spec.wander_time_constant_s, rng)
    speed = speed_sd * rng.standard_normal((len(t), 3))
    if spec.velocity_wander_sd_mps > 0.0:
        speed += gauss_markov(t, 3, spec.velocity_wander_sd_mps, spec.velocity_wander_time_constant_s, rng)
    return GnssRecord(spec, t, track.position_ecef_m + place @ ned, track.velocity_ecef_mps + speed @ ned)


def measure_barometer(truth, spec, t, rng):
    """Heights of the datum's point."""
    late = spec.time_bias_sd_s * rng.standard_normal()
    height = earth.geodetic_from_ecef(truth.trajectory(t - late).position_ecef_m)[2]
    slow = gauss_markov(t, 1, spec.wander_sd_m, spec.wander_time_constant_s, rng)[:, 0]
    bias, scale = spec.bias_sd_m * rng.standard_normal(), spec.scale_sd * rng.standard_normal()
    error = bias + scale * (height - height[0]) + slow + spec.sd_m * rng.standard_normal(len(t))
    return BarometerRecord(spec, t, height + error)


def measure_magnetometer(truth, spec, t, rng):
    """Field in the magnetometer's axes, bent by the vehicle's iron."""
    position, _, q, _ = truth.state(t)
    field = geomagnetism_and_sun.magnetic_field_ecef_t(position, EPOCH)
    body = rotations.rotate(rotations.conjugate(q), field)
    actual = Rotation.from_rotvec(spec.mount_sd_rad * rng.standard_normal(3)).inv().apply(body @ spec.dcm_body_sensor)
    iron = np.diag(1.0 + spec.scale_sd * rng.standard_normal(3))
    iron[[0, 0, 1], [1, 2, 2]] = iron[[1, 2, 2], [0, 0, 1]] = spec.soft_iron_sd * rng.standard_normal(3)
    measured = actual @ iron + spec.bias_sd * rng.standard_normal(3) + spec.noise_sd * rng.standard_normal(actual.shape)
    return TriadRecord(spec, t, spec.resolution * np.round(measured / spec.resolution))


def measure_sun(truth, spec, t, rng):
    """Angles of the Sun in each head that sees it."""
    q = truth.state(t)[2]
    body = rotations.rotate(rotations.conjugate(q), geomagnetism_and_sun.sun_direction_ecef(EPOCH, t))
    angles = np.empty((len(t), len(spec.clock_lv_rad), 2))
    for k, dcm in enumerate(spec.dcm_body_head):
        head = Rotation.from_rotvec(spec.mount_sd_rad * rng.standard_normal(3)).inv().apply(body @ dcm)
        exact = sun_angles_from_direction(head)
        error = spec.bias_sd_rad * rng.standard_normal(2) + spec.noise_sd_rad * rng.standard_normal((len(t), 2))
        error[:, 0] /= np.cos(exact[:, 1])
        unseen = head[:, 2] < np.cos(0.5 * spec.field_rad)
        angles[:, k] = np.where(unseen[:, None], np.nan, exact + error)
    return SunRecord(spec, t, angles)


def sense_everything(truth, seed, sites=FULL_SITES):
    """Telemetry in which every kind of instrument, and every error that a flight file can state, is alive."""
    telemetry, _ = sense(truth, seed, sites, clock_sd_s=CLOCK_SD_S)
    rng = np.random.default_rng(10_000 + seed)
    t = np.arange(START - 1.0, END - 0.3, 0.1)
    return replace(
        telemetry,
        gnss={"receiver": measure_gnss(truth, RECEIVER, np.arange(START, END - 1.0, 0.5) + 0.0137, rng)},
        barometers={"barometer": measure_barometer(truth, BAROMETER, np.arange(START, END - 1.0, 0.7) + 0.31, rng)},
        magnetometer=measure_magnetometer(truth, MAGNETOMETER, t + 0.0021, rng),
        sun=measure_sun(truth, SUN, t + 0.0007, rng),
    )


def sense(
    truth, seed, sites=SITES, prior_time_s=START - 2.0, noise_factor=1.0, accelerometer_errors=None, hz=100.0,
    clock_sd_s=0.0,
):  # fmt: skip
    """Telemetry of the short flight and the true sensor errors in the filter's order (without the triads' clocks)."""
    rng = np.random.default_rng(seed)
    late_s = clock_sd_s * np.random.default_rng([seed, 1]).standard_normal(2)
    t = np.arange(START - 4.0, END - 0.01, 1.0 / hz) + 0.0013
    force, e_force = measure_triad(ACCELEROMETER, truth.specific_force_imu(t - late_s[0]), rng, accelerometer_errors)
    t_rate = np.arange(START - 4.0, END - 0.01, 1.0 / hz) + 0.0046
    rate, e_rate = measure_triad(RATES, body_rate(t_rate - late_s[1]), rng)
    radars, errors = {}, [e_force, e_rate]
    for site in sites:
        tags = np.arange(START, END - 0.5, 0.1)
        z, e = measure_radar(truth, site, tags, rng, noise_factor=noise_factor)
        radars[site.name] = RadarRecord(site, tags, z)
        errors.append(e)
    q = truth.state(np.array([prior_time_s]))[2][0]
    prior = AttitudePrior(prior_time_s, rotations.boxplus(q, PRIOR_SD * rng.standard_normal(3)), np.full(3, PRIOR_SD))
    telemetry = Telemetry(
        "mini",
        EPOCH,
        True,
        SimpleNamespace(cg_m=CG, **PITCHING),
        TriadRecord(replace(ACCELEROMETER, time_bias_sd_s=clock_sd_s), t, force),
        TriadRecord(replace(RATES, time_bias_sd_s=clock_sd_s), t_rate, rate),
        radars,
        None,
        prior,
    )
    return telemetry, np.concatenate(errors)


@pytest.fixture(scope="session")
def mini_truth():
    return _truth()


@pytest.fixture(scope="session")
def mini_sense(mini_truth):
    """``mini_sense(seed, ...)`` gives telemetry and the true sensor errors."""

    def make(seed, **options):
        return sense(mini_truth, seed, **options)

    return make


@pytest.fixture(scope="session")
def mini_everything(mini_truth):
    """``mini_everything(seed)`` gives telemetry with every kind of instrument and error."""

    def make(seed, **options):
        return sense_everything(mini_truth, seed, **options)

    return make

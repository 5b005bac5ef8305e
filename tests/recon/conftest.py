"""A short flight with known truth, integrated by other means than the filter's, and sensors that err as on paper."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from flightmodel import earth, rotations
from flightmodel.instruments import RadarSite, TriadSpec, dcm_body_from_clocking
from flightmodel.telemetry import AttitudePrior, RadarRecord, Telemetry, TriadRecord
from flightmodel.trajectory import Trajectory

DEG = np.pi / 180.0
START, END = 100.0, 160.0
CG = np.array([-0.54, 0.004, -0.0004])
IMU = np.array([-0.95, 0.04, -0.03])
SPIN = 36.0 * DEG
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
            "2009-08-17T12:52:00Z",
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
    return z + errors[:3] + noise, errors


def sense(truth, seed, sites=SITES, prior_time_s=START - 2.0, noise_factor=1.0, accelerometer_errors=None, hz=100.0):
    """Telemetry of the short flight and the true sensor errors in the filter's order."""
    rng = np.random.default_rng(seed)
    t = np.arange(START - 4.0, END - 0.01, 1.0 / hz) + 0.0013
    force, e_force = measure_triad(ACCELEROMETER, truth.specific_force_imu(t), rng, accelerometer_errors)
    t_rate = np.arange(START - 4.0, END - 0.01, 1.0 / hz) + 0.0046
    rate, e_rate = measure_triad(RATES, body_rate(t_rate), rng)
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
        "2009-08-17T12:52:00Z",
        True,
        SimpleNamespace(cg_m=CG),
        TriadRecord(ACCELEROMETER, t, force),
        TriadRecord(RATES, t_rate, rate),
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

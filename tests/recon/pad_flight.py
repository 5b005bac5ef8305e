"""A rocket that stands on its launcher, burns and rolls: kinematics in closed form, truth integrates nothing."""

from dataclasses import dataclass, replace

import numpy as np

from flightmodel import earth, geomagnetism_and_sun, rotations
from flightmodel.atmosphere import standard_sounding
from flightmodel.instruments import GnssSpec, RadarSite, TriadSpec
from flightmodel.telemetry import AttitudePrior, GnssRecord, RadarRecord, Start, Telemetry, TriadRecord
from tests.recon.conftest import gauss_markov, measure_triad

DEG = np.pi / 180.0
EPOCH = "2021-10-13T10:00:00Z"
LAT, LON, HEIGHT = 39.4 * DEG, -8.3 * DEG, 170.0
AZIMUTH, ELEVATION, ROLL0 = 140.0 * DEG, 82.0 * DEG, 25.0 * DEG
BURN_S, THRUST_MPS2, ROLL_RADPS = 6.0, 90.0, 80.0 * DEG
REST, END_S = (-8.0, -0.2), 25.0
ACCELEROMETER = TriadSpec("accelerometer", np.zeros(3), np.eye(3), 0.05, 0.08, 0.005, 0.2 * DEG)
RATES = TriadSpec("rates", np.zeros(3), np.eye(3), 0.1 * DEG, 0.1 * DEG, 0.005, 0.2 * DEG)
MAGNETOMETER = TriadSpec("magnetometer", np.zeros(3), np.eye(3), 2e-7, 1e-6, 0.003, 0.2 * DEG)
RECEIVER = GnssSpec("gps", np.zeros(3), 3.0, 5.0, 0.2, 0.3, 2.0, 60.0, 0.0)
RADAR = RadarSite("radar", LAT - 0.03 * DEG, LON + 0.05 * DEG, 120.0, 4.0, 0.01 * DEG, 3.0, 0.005 * DEG, 1e-3)


@dataclass(frozen=True)
class Motion:
    """Position, velocity, acceleration (n, 3) against the Earth, attitude (n, 4), inertial body rate (n, 3)."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    q: np.ndarray
    rate: np.ndarray


def _pulse(t, size):
    """Integrals of a sine-squared pulse of the burn's length: first and second, and itself."""
    x = np.clip(t, 0.0, BURN_S)
    w = 2.0 * np.pi / BURN_S
    once = 0.5 * size * (x - np.sin(w * x) / w)
    twice = 0.5 * size * (0.5 * x**2 + (np.cos(w * x) - 1.0) / w**2)
    return np.where(t > BURN_S, twice + once * (t - BURN_S), twice), once, 0.5 * size * (1.0 - np.cos(w * x))


def motion(t):
    """Truth at times (n,)."""
    t = np.asarray(t, dtype=float)
    place = earth.ecef_from_geodetic(LAT, LON, HEIGHT)
    ned = earth.dcm_ned_ecef(LAT, LON)
    along = ned.T @ [
        np.cos(ELEVATION) * np.cos(AZIMUTH),
        np.cos(ELEVATION) * np.sin(AZIMUTH),
        -np.sin(ELEVATION),
    ]
    s, v, a = _pulse(t, THRUST_MPS2)
    roll, _, _ = _pulse(t, ROLL_RADPS / BURN_S)
    turning = _pulse(t, ROLL_RADPS / BURN_S)[1]
    q0 = earth.q_ecef_body_from_pointing(AZIMUTH, ELEVATION, ROLL0, LAT, LON)
    q = rotations.multiply(q0, rotations.exp(np.outer(roll, [1.0, 0.0, 0.0])))
    rate = np.outer(turning, [1.0, 0.0, 0.0]) + rotations.rotate(rotations.conjugate(q), earth.OMEGA_ECEF_RADPS)
    return Motion(place + np.outer(s, along), np.outer(v, along), np.outer(a, along), q, rate)


def specific_force(t):
    """In body axes (n, 3): acceleration against inertial space less gravitation."""
    m, w = motion(t), earth.OMEGA_ECEF_RADPS
    felt = m.acceleration + 2.0 * np.cross(w, m.velocity) + np.cross(w, np.cross(w, m.position))
    return rotations.rotate(rotations.conjugate(m.q), felt - earth.gravitation(m.position))


def sense(
    seed, gps=True, radar_from_s=None, prior_sd_deg=(20.0, 3.0, 3.0), magnetometer=False, at_rest=True, weak=1.0,
    gyro_bias_degps=0.0, rates=RATES, azimuth_sd_deg=None,
):  # fmt: skip
    """Telemetry; ``weak`` and ``gyro_bias_degps`` are what no data sheet says."""
    rng = np.random.default_rng(seed)
    t = np.arange(REST[0] - 1.0, END_S, 0.01) + 0.0013
    force, _ = measure_triad(ACCELEROMETER, specific_force(t), rng)
    turning, _ = measure_triad(rates, motion(t + 0.002).rate, rng)
    turning += np.array([0.0, gyro_bias_degps * DEG, 0.0])
    gnss, radars = {}, {}
    if gps:
        at = np.arange(REST[0] - 0.5, END_S - 1.0, 1.0) + 0.0137
        m, ned = motion(at), earth.dcm_ned_ecef(LAT, LON)
        place = rng.standard_normal((len(at), 3)) * [3.0, 3.0, 5.0] + gauss_markov(at, 3, 2.0, 60.0, rng)
        speed = rng.standard_normal((len(at), 3)) * [0.2, 0.2, 0.3]
        gnss["gps"] = GnssRecord(RECEIVER, at, m.position + place @ ned, m.velocity + speed @ ned)
    if radar_from_s is not None:
        at = np.arange(radar_from_s, END_S - 1.0, 0.1)
        site = RADAR
        z = earth.radar_from_ecef(motion(at).position, site.latitude_rad, site.longitude_rad, site.height_m)
        bias = rng.standard_normal(3) * [site.range_bias_sd_m, site.angle_bias_sd_rad, site.angle_bias_sd_rad]
        noise = rng.standard_normal(z.shape) * [site.range_sd_m, site.angle_sd_rad, site.angle_sd_rad]
        noise[:, 1] /= np.cos(z[:, 2])
        radars["radar"] = RadarRecord(site, at, z + bias + noise, "datum")
    prior = None
    if prior_sd_deg is not None:
        sd = np.array(prior_sd_deg) * DEG
        q = rotations.boxplus(motion([-2.0]).q[0], sd * rng.standard_normal(3))
        prior = AttitudePrior(-2.0, q, sd)
    field = None
    if magnetometer:
        q = motion(t).q
        b = geomagnetism_and_sun.magnetic_field_ecef_t(motion(t).position, EPOCH)
        samples, _ = measure_triad(MAGNETOMETER, rotations.rotate(rotations.conjugate(q), b), rng)
        field = TriadRecord(MAGNETOMETER, t, samples)
    start = Start(REST if at_rest else None)
    if azimuth_sd_deg is not None:
        sd = azimuth_sd_deg * DEG
        start = replace(start, azimuth_rad=AZIMUTH + sd * rng.standard_normal(), azimuth_sd_rad=sd)
    return Telemetry(
        "pad", EPOCH, True, None, TriadRecord(ACCELEROMETER, t, weak * force),
        TriadRecord(rates, t + 0.002, turning), radars, standard_sounding(), prior,
        magnetometer=field, gnss=gnss, start=start,
    )  # fmt: skip


def off(bet, at_s):
    """Position, velocity, rotation error (9,) of a trajectory's row nearest to a time, and its covariance."""
    k = int(np.argmin(np.abs(bet.time_s - at_s)))
    m = motion(bet.time_s[k : k + 1])
    turn = rotations.boxminus(bet.q_ecef_body[k], m.q[0])
    error = np.concatenate([bet.position_ecef_m[k] - m.position[0], bet.velocity_ecef_mps[k] - m.velocity[0], turn])
    return error, bet.covariance[k]

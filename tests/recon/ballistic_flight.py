"""A fall from 90 km with winds, drawn from the ballistic model itself, and radars and a receiver that watch it."""

from dataclasses import replace
from functools import cache

import numpy as np

from flightmodel import earth
from flightmodel.atmosphere import DENSITY_LENGTH_M, WIND_LENGTH_M, standard_sounding
from flightmodel.instruments import GnssSpec, RadarSite
from flightmodel.telemetry import GnssRecord, Motion, RadarRecord, Telemetry
from recon.propagation import ballistic_motion, propagate
from recon.state import States

from .one_node import height

EPOCH = "2009-08-17T12:52:00Z"
LATITUDE, LONGITUDE = -0.58, 0.31
SPEC = Motion(
    "ballistic", drag_area_per_mass_m2pkg=0.004, drag_sd=0.3, drag_time_constant_s=10.0, side_sd=0.05,
    acceleration_density=0.05,
)  # fmt: skip
SITES = [
    RadarSite("near", -0.585, 0.305, 40.0, 5.0, 1e-4, 3.0, 5e-5, 1e-3),
    RadarSite("far", -0.60, 0.32, 90.0, 3.0, 5e-5, 5.0, 1e-4, 2e-3),
]
RECEIVER = GnssSpec("receiver", np.array([0.3, 0.0, 0.0]), 4.0, 6.0, 0.1, 0.2)


def windy_sounding():
    """Standard air with winds that turn with altitude."""
    calm = standard_sounding()
    z = calm.altitude_m
    north = 20.0 * np.sin(z / 9e3) - 5.0
    east = 30.0 * np.exp(-(((z - 12e3) / 6e3) ** 2)) + 8.0
    return replace(calm, wind_north_mps=north, wind_east_mps=east)


def entry_state(height_m=90e3, velocity_ned_mps=(300.0, 900.0, 400.0), errors=8):
    """Start of an entry arc, southern latitude."""
    ned = earth.dcm_ned_ecef(LATITUDE, LONGITUDE)
    position = earth.ecef_from_geodetic(LATITUDE, LONGITUDE, height_m)
    return States(position, np.array(velocity_ned_mps) @ ned, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(errors))


def across_plane(state):
    """Level direction (3,), ECEF, across a state's vertical plane."""
    across = np.cross(state.position_ecef_m, state.velocity_ecef_mps)
    return across / np.linalg.norm(across)


def gauss_markov(t, count, sd, time_constant_s, rng):
    """Stationary first-order Gauss-Markov sequences (n, count)."""
    out = sd * rng.standard_normal((len(t), count))
    for k in range(1, len(t)):
        keeps = np.exp(-(t[k] - t[k - 1]) / time_constant_s)
        out[k] = keeps * out[k - 1] + np.sqrt(1.0 - keeps**2) * out[k]
    return out


def squared_errors(trajectory, states, at_s):
    """Squared normalised errors, of six components, of position and velocity at some times of a flight."""
    out = []
    for moment in at_s:
        k, j = int(np.argmin(np.abs(trajectory.time_s - moment))), round(moment / 0.05)
        d = np.r_[
            trajectory.position_ecef_m[k] - states[j].position_ecef_m,
            trajectory.velocity_ecef_mps[k] - states[j].velocity_ecef_mps,
        ]
        out.append(d @ np.linalg.solve(trajectory.covariance[k, :6, :6], d))
    return out


@cache
def fly(seed, end_s=80.0, spec=SPEC, height_m=90e3, velocity_ned_mps=(300.0, 900.0, 400.0)):
    """Times and states of one flight drawn from the model: drivers that wander, white acceleration noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, end_s + 1e-9, 0.05)
    state = entry_state(height_m, velocity_ned_mps, errors=6)
    across = across_plane(state)
    motion, index = ballistic_motion(spec, windy_sounding(), across, t)
    sd = np.array([spec.drag_sd, spec.side_sd, spec.side_sd, 1.0, 1.0, 1.0])
    length = np.array([np.inf] * 3 + [DENSITY_LENGTH_M] + [WIND_LENGTH_M] * 2)
    tau = np.array([spec.drag_time_constant_s] * 3 + [np.inf] * 3)
    drivers = sd * rng.standard_normal(6)
    out = []
    for k in range(len(t)):
        state = replace(state, sensor_errors=drivers)
        out.append(state)
        if k == len(t) - 1:
            break
        before = height(state)
        state = propagate(motion, index[k], index[k + 1], state).state
        climb = abs(height(state) - before)
        keeps = np.exp(-(t[k + 1] - t[k]) / tau - climb / length)
        drivers = keeps * drivers + sd * np.sqrt(1.0 - keeps**2) * rng.standard_normal(6)
        kick = spec.acceleration_density * np.sqrt(0.05) * rng.standard_normal(3)
        state = replace(state, velocity_ecef_mps=state.velocity_ecef_mps + kick)
    return t, out


def watch(t, states, seed, sites=SITES, gap_s=None, receiver=False):
    """Telemetry of a flight without inertial sensors."""
    rng = np.random.default_rng(1000 + seed)
    position = np.array([s.position_ecef_m for s in states])
    velocity = np.array([s.velocity_ecef_mps for s in states])
    radars = {}
    for number, site in enumerate(sites):
        rows = np.arange(number, len(t), 4)
        if gap_s is not None:
            rows = rows[(t[rows] < gap_s[0]) | (t[rows] > gap_s[1])]
        sd = [site.range_bias_sd_m, site.angle_bias_sd_rad, site.angle_bias_sd_rad]
        late = site.time_bias_sd_s * rng.standard_normal()
        point = position[rows] - late * velocity[rows]
        z = earth.radar_from_ecef(point, site.latitude_rad, site.longitude_rad, site.height_m)
        noise = rng.standard_normal(z.shape) * [site.range_sd_m, site.angle_sd_rad, site.angle_sd_rad]
        if site.wander_sd_rad > 0.0:
            noise[:, 1:] += gauss_markov(t[rows], 2, site.wander_sd_rad, site.wander_time_constant_s, rng)
        if site.range_wander_sd_m > 0.0:
            tau_s = site.range_wander_time_constant_s
            noise[:, 0] += gauss_markov(t[rows], 1, site.range_wander_sd_m, tau_s, rng)[:, 0]
        noise[:, 1] /= np.cos(z[:, 2])
        radars[site.name] = RadarRecord(site, t[rows], z + np.array(sd) * rng.standard_normal(3) + noise)
    gnss = {}
    if receiver:
        rows = np.arange(3, len(t), 10)
        ned = earth.dcm_ned_ecef(LATITUDE, LONGITUDE)
        place = rng.standard_normal((len(rows), 3)) * [4.0, 4.0, 6.0] @ ned
        speed = rng.standard_normal((len(rows), 3)) * [0.1, 0.1, 0.2] @ ned
        gnss["receiver"] = GnssRecord(RECEIVER, t[rows], position[rows] + place, velocity[rows] + speed)
    return Telemetry("fall", EPOCH, True, None, None, None, radars, windy_sounding(), None, gnss=gnss, motion=SPEC)

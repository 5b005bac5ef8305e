"""Predictions of every kind of measurement and their partials: numpy twin of `recon.measurements.predict`."""

from dataclasses import dataclass

import numpy as np

from flightmodel import earth, rotations
from flightmodel.earth import WGS84, Planet
from recon.measurements import (
    FIELD,
    POSITION,
    RADAR,
    RANGE_RATE,
    SLOTS,
    SUN,
    VELOCITY,
    sight,
    sight_partials,
)


@dataclass(frozen=True)
class NodeMotion:
    """Attitude matrix, turning in body axes and acceleration against the Earth.

    Turning (12, 3) are the inertial rate, its rate of change (the partial by the gyros' clock as well), the specific
    force, and the rate's partials by the gyros' nine other errors.
    """

    position_ecef_m: np.ndarray
    velocity_ecef_mps: np.ndarray
    dcm_ecef_body: np.ndarray
    turning_body: np.ndarray
    acceleration_ecef_mps2: np.ndarray
    planet: Planet = WGS84


def right_jacobian(rotation_rad):
    """Matrix (3, 3) from a change of a rotation vector to the body-axis rotation it causes; second order."""
    k = rotations.skew(rotation_rad)
    return np.eye(3) - 0.5 * k + k @ k / 6.0


def _magnetometer(instrument, known, e, at):
    """Reading (3,) of a magnetometer, its partials by the field in body axes, that field, and partials by errors."""
    by_error, to_body = np.zeros((3, SLOTS)), at.dcm_ecef_body.T
    to_sensor = (instrument.dcm @ rotations.dcm_from_q(rotations.exp(e[6:9]))).T
    body = to_body @ (known + e[12:15])
    x = to_sensor @ body
    iron = np.diag(1.0 + e[3:6])
    by_error[:, 0:3], by_error[:, 3:6] = np.eye(3), np.diag(x)
    for slot, (i, j) in zip((9, 10, 11), ((0, 1), (0, 2), (1, 2)), strict=True):
        iron[i, j] = iron[j, i] = e[slot]
        by_error[i, slot], by_error[j, slot] = x[j], x[i]
    by_error[:, 6:9] = iron @ rotations.skew(x) @ right_jacobian(e[6:9])
    by_error[:, 12:15] = iron @ to_sensor @ to_body
    return iron @ x + e[0:3], iron @ to_sensor, body, by_error


def _sun_head(instrument, known, e, at):
    """Azimuth and elevation (2,) of the Sun in a head, and partials as the magnetometer's."""
    by_error, to_body = np.zeros((2, SLOTS)), at.dcm_ecef_body.T
    to_head = (instrument.dcm @ rotations.dcm_from_q(rotations.exp(e[4:7]))).T
    nadir = -at.position_ecef_m / np.linalg.norm(at.position_ecef_m)
    seen = instrument.dcm[:, 2] @ to_body @ nadir > instrument.site_ecef_m[0]
    body = to_body @ (known + (e[7] + seen * e[2]) * nadir)
    s = to_head @ body
    normal, whole2 = np.hypot(s[1], s[2]), s @ s
    p = np.array(
        [
            [0.0, s[2] / normal**2 - e[0] * s[1] / normal**3, -s[1] / normal**2 - e[0] * s[2] / normal**3],
            [normal / whole2, -s[0] * s[1] / (whole2 * normal), -s[0] * s[2] / (whole2 * normal)],
        ]
    )
    by_error[:, 4:7] = p @ rotations.skew(s) @ right_jacobian(e[4:7])
    by_error[0, 0], by_error[1, 1] = 1.0 / normal, 1.0
    by_error[:, 7] = p @ to_head @ to_body @ nadir
    by_error[:, 2] = seen * by_error[:, 7]
    by_error[:, 3] = -p @ to_head @ rotations.skew(body) @ at.turning_body[0]
    h = np.array([np.arctan2(s[1], s[2]) + e[0] / normal, np.arctan2(s[0], normal) + e[1]])
    return h + e[3] * by_error[:, 3], p @ to_head, body, by_error


def predict(instrument, known, e, at):
    """Prediction (3,) and partials by state (3, 9) and by the instrument's own errors ``e`` (3, `SLOTS`)."""
    by_state, by_error = np.zeros((3, 9)), np.zeros((3, SLOTS))
    if instrument.kind in (FIELD, SUN):
        model = _magnetometer if instrument.kind == FIELD else _sun_head
        reading, by_body, body, own = model(instrument, known, e, at)
        by_state[: len(reading), 6:9] = by_body @ rotations.skew(body)
        by_error[: len(reading)] = own
        return np.append(reading, np.zeros(3 - len(reading))), by_state, by_error
    c, arm, tau = at.dcm_ecef_body, instrument.arm_body_m, e[3]
    turning, change, force = at.turning_body[:3]
    turning = turning - at.planet.rate_radps * c[2]
    lever_velocity = np.cross(turning, arm)
    moving = at.velocity_ecef_mps + c @ lever_velocity
    swing = np.cross(change, arm) + np.cross(turning, lever_velocity)
    pulled = at.acceleration_ecef_mps2 + c @ swing
    jerk = np.cross(turning, force + swing)
    point = at.position_ecef_m + c @ arm - tau * moving + 0.5 * tau**2 * pulled - tau**3 / 6.0 * c @ jerk
    speed, pulled = moving - tau * pulled + 0.5 * tau**2 * c @ jerk, pulled - tau * c @ jerk
    effective = arm - tau * (lever_velocity - 0.5 * tau * swing) - tau**3 / 6.0 * jerk
    sweep = lever_velocity - tau * swing + 0.5 * tau**2 * jerk
    by_gyros = -c @ rotations.skew(arm) @ at.turning_body[[*range(3, 12), 1]].T
    if instrument.kind == VELOCITY:
        by_state[:, 3:6] = instrument.dcm
        by_state[:, 6:9] = -instrument.dcm @ c @ rotations.skew(sweep)
        by_error[:, 0:3] = np.eye(3)
        by_error[:, 3], by_error[:, 4:14] = -instrument.dcm @ pulled, instrument.dcm @ by_gyros
        return instrument.dcm @ speed + e[0:3], by_state, by_error
    if instrument.kind == RANGE_RATE:
        sight = point - instrument.site_ecef_m
        u = sight / np.linalg.norm(sight)
        across = (speed - (u @ speed) * u) / np.linalg.norm(sight)
        by_state[0, 0:3], by_state[0, 3:6] = across, u - tau * across
        by_state[0, 6:9] = -u @ c @ rotations.skew(sweep)
        by_state[0, 6:9] -= across @ c @ rotations.skew(effective)
        by_error[0, 0:2], by_error[0, 3] = 1.0, -across @ speed - u @ pulled
        by_error[0, 4:14] = by_state[0, 3:6] @ by_gyros
        return np.array([u @ speed + e[0] + e[1], 0.0, 0.0]), by_state, by_error
    if instrument.kind == RADAR:
        h, m = _radar(instrument, known, e, point, by_error)
    elif instrument.kind == POSITION:
        m, by_error[:, 0:3] = instrument.dcm, np.eye(3)
        h = m @ (point - instrument.site_ecef_m) + e[0:3]
    else:
        h, m = _height(instrument, e, point, by_error, at.planet)
    by_state[:, 0:3] = m
    by_state[:, 3:6] = -tau * m
    by_state[:, 6:9] = -m @ c @ rotations.skew(effective)
    by_error[:, 3] = -m @ speed
    return h, by_state, by_error


def _radar(instrument, known, e, point, by_error):
    ned = instrument.dcm @ (point - instrument.site_ecef_m)
    moved = _site_partials(instrument, ned)
    n, east, d = ned + moved @ (e[13:16] + e[17:20])
    slant, az, el = sight(n, east, d)
    partials = sight_partials(n, east, d)
    sec = 1.0 / max(np.cos(el), 1e-3)
    tan = np.sin(el) * sec
    by_error[:, 0:3] = np.eye(3)
    by_error[1, 4:6] = -tan * np.cos(az), -tan * np.sin(az)
    by_error[2, 4:6] = np.sin(az), -np.cos(az)
    by_error[2, 6], by_error[1, 7], by_error[1, 8] = np.cos(el), sec, tan
    by_error[1, 9], by_error[2, 10] = sec, 1.0
    by_error[2, 11] = known[0] * np.cos(el) / max(np.sin(el), 0.035)
    by_error[0, 12] = slant
    by_error[1, [16, 20]] = 1.0
    by_error[0, 21] = 1.0
    by_error[1:, 22] = known[1:]
    # the errors themselves change with azimuth and elevation
    g = np.eye(3) + np.diag([e[12], 0.0, 0.0])
    g[1, 1] += tan * (np.sin(az) * e[4] - np.cos(az) * e[5])
    g[1, 2] = sec**2 * (e[8] - np.cos(az) * e[4] - np.sin(az) * e[5]) + sec * tan * (e[7] + e[9])
    g[2, 1] = np.cos(az) * e[4] + np.sin(az) * e[5]
    cosecant_square = 1.0 / np.sin(el) ** 2 if np.sin(el) > 0.035 else np.sin(el) / 0.035
    g[2, 2] -= np.sin(el) * e[6] + known[0] * cosecant_square * e[11]
    others = np.delete(np.arange(SLOTS), 3)
    h = np.array([slant, az + known[1], el + known[2]]) + by_error[:, others] @ e[others]
    by_error[:, 13:16] = by_error[:, 17:20] = g @ partials @ moved
    return h, g @ partials @ instrument.dcm


def _site_partials(instrument, ned):
    """Partials (3, 3) of north, east, down by the stated place's error to the north, to the east and upwards."""
    per_m = 1.0 / float(np.linalg.norm(instrument.site_ecef_m))
    tan_lat = -instrument.dcm[2, 2] / max(instrument.dcm[0, 2], 1e-6)
    turns = per_m * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, tan_lat]])  # of a metre to the north, to the east
    moved = np.diag([1.0, 1.0, -1.0])
    moved[:, :2] -= np.cross(turns, ned).T
    return moved


def _height(instrument, e, point, by_error, planet):
    latitude, longitude, height = earth.geodetic_from_ecef(point, planet)
    m = np.zeros((3, 3))
    m[0] = -(1.0 + e[1]) * earth.dcm_ned_ecef(float(latitude), float(longitude))[2]
    above = float(height) - instrument.site_ecef_m[0]
    by_error[0, 0:3] = 1.0, above, 1.0
    return np.array([float(height) + e[0] + above * e[1] + e[2], 0.0, 0.0]), m

"""Ballistic motion with its transition and noise in numpy: readable twin of `recon.propagation`."""

import numpy as np

from flightmodel import earth, rotations
from recon.propagation import MOST_CHANGE, MOST_PARTS, Step
from recon.state import States


def _flow(motion, position, velocity, drivers):
    """Velocity against the air (3,), airspeed, and drag over airspeed, 1/s."""
    latitude, longitude, height = (float(x) for x in earth.geodetic_from_ecef(position))
    altitude = motion.air_from_m + motion.air_step_m * np.arange(len(motion.air))
    log_density, north, east, density_sd, wind_sd = (np.interp(height, altitude, column) for column in motion.air.T)
    density = np.exp(log_density + drivers[3] * density_sd)
    wind = np.array([north + drivers[4] * wind_sd, east + drivers[5] * wind_sd, 0.0])
    u = velocity - earth.dcm_ned_ecef(latitude, longitude).T @ wind
    speed = float(np.linalg.norm(u))
    drag_per_speed = 0.5 * density * motion.drag_m2pkg * np.exp(np.clip(drivers[0], -8.0, 8.0)) * speed
    return u, speed, float(drag_per_speed)


def acceleration(motion, position, velocity, drivers):
    """Acceleration (3,) against the rotating Earth, m/s^2."""
    u, speed, drag_per_speed = _flow(motion, position, velocity, drivers)
    across = motion.across_ecef - (motion.across_ecef @ u) * u / speed**2
    across /= np.linalg.norm(across)
    within = np.cross(u / speed, across)
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    force = drag_per_speed * (speed * (drivers[1] * across + drivers[2] * within) - u)
    return np.asarray(force + earth.gravitation(position) - spin @ spin @ position - 2.0 * spin @ velocity)


def propagate(motion, first, last, start):
    """Carry a state between grid points in numpy."""
    y = np.concatenate([start.position_ecef_m, start.velocity_ecef_mps])
    drivers = start.sensor_errors[:6]
    transition, noise = np.hstack([np.eye(9), np.zeros((9, 6))]), np.zeros((9, 9))
    step = 1 if last >= first else -1

    def slope(at):
        return np.concatenate([at[3:6], acceleration(motion, at[:3], at[3:6], drivers)])

    for k in range(first, last, step):
        spectrum = np.diag(motion.force_density[min(k, k + step)])
        for dt in _parts(motion, y, drivers, motion.time_s[k + step] - motion.time_s[k]):
            k1 = slope(y)
            k2 = slope(y + 0.5 * dt * k1)
            mid = y + 0.5 * dt * k2
            k3 = slope(mid)
            k4 = slope(y + dt * k3)
            m = np.zeros((6, 12))
            m[:3, 3:6] = np.eye(3)
            m[3:] = _partials(motion, np.concatenate([mid, drivers]))
            y += dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            full = np.hstack([np.eye(6), np.zeros((6, 6))]) + dt * m + 0.5 * dt**2 * m[:, :6] @ m
            transition[:6] = full[:, :6] @ transition[:6]
            transition[:6, 9:] += full[:, 6:]
            q = spectrum * abs(dt)
            new = np.block([[q * dt**2 / 3.0, q * dt / 2.0], [q * dt / 2.0, q]])
            noise[:6, :6] = full[:, :6] @ noise[:6, :6] @ full[:, :6].T + new
    return Step(States(y[:3], y[3:], start.q_ecef_body, start.sensor_errors), transition, noise)


def _parts(motion, y, drivers, dt):
    """Parts of a step in which the air changes the velocity ``y[3:]``, carried on in place, by a fifth at most."""
    for _ in range(MOST_PARTS - 1):
        change = _flow(motion, y[:3], y[3:], drivers)[2] * np.hypot(1.0, np.hypot(*drivers[1:3])) * abs(dt)
        part = dt if change <= MOST_CHANGE else dt * MOST_CHANGE / change
        yield part
        dt -= part
        if dt == 0.0:
            return
    yield dt


def _partials(motion, point):
    """Partials (3, 12) of the acceleration by position, velocity and drivers, central differences."""
    out = np.empty((3, 12))
    for j, h in enumerate([1.0] * 3 + [0.01] * 3 + [1e-4] * 6):
        both = []
        for sign in (1.0, -1.0):
            p = point.copy()
            p[j] += sign * h
            both.append(acceleration(motion, p[:3], p[3:6], p[6:]))
        out[:, j] = (both[0] - both[1]) / (2.0 * h)
    return out

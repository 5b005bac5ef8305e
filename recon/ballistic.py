"""How gravity and the day's air carry a vehicle that has no inertial sensors, in readable form.

With ``u`` the velocity against the air and ``B`` the drag area per mass,

    dv/dt = g(r) - W x (W x r) - 2 W x v + rho |u| B e^d / 2 (-u + |u| (s1 n1 + s2 n2)),   rho = rho0(h) e^(c0 sd(h))

with ``n1`` and ``n2`` across the flow, ``n1`` as near as can be to a level direction across the path's plane, ``n2`` in
that plane. (Level and upright axes would turn without end where a parachute sinks straight down.) The six drivers
``d, s1, s2, c0, cN, cE`` are errors of the filter: drag and side forces wander along time, density and the winds'
``c sd(h)`` along altitude. What a thrust or an opening parachute does in stated spans is white noise of acceleration.
Steps are fourth-order Runge-Kutta steps, the transition is ``1 + M dt + M^2 dt^2 / 2`` of the partials half way; a step
in which the air would change the velocity by more than a fifth is taken in parts. Attitude takes no part.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flightmodel import earth, rotations
from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import FloatArray
from flightmodel.telemetry import Motion as MotionSpec
from flightmodel.telemetry import Sounding
from recon._ballistic_kernels import MOST_CHANGE, MOST_PARTS
from recon.motion import Motion
from recon.state import IntArray, States
from recon.strapdown import Step

GRID_STEP_S = 0.05
AIR_FROM_M, AIR_TO_M, AIR_STEP_M = -500.0, 900e3, 100.0
POWERED_CORRELATION_S = 1.0  # a thrust that may be anything keeps its value for about so long


def air_table(sounding: Sounding) -> FloatArray:
    """Rows of `recon.motion.Motion.air` on the fixed altitudes above."""
    altitude = np.arange(AIR_FROM_M, AIR_TO_M, AIR_STEP_M)
    air = profile_from_sounding(sounding).at(altitude)
    wind = air.wind_ned_mps
    return np.column_stack([np.log(air.density_kgpm3), wind[:, 0], wind[:, 1], air.density_sd, air.wind_sd_mps])


def ballistic_motion(
    spec: MotionSpec, sounding: Sounding, across_ecef: FloatArray, node_time_s: FloatArray, same_s: float
) -> tuple[Motion, IntArray]:
    """Motion on the nodes and steps of `GRID_STEP_S` between, and each node's index."""
    first, last = node_time_s[0], node_time_s[-1]
    steps = np.arange(first, last, GRID_STEP_S)
    near = np.clip(np.searchsorted(node_time_s, steps), 1, len(node_time_s) - 1)
    clear = np.minimum(np.abs(steps - node_time_s[near - 1]), np.abs(steps - node_time_s[near])) > same_s
    t = np.sort(np.concatenate([steps[clear], node_time_s]))
    density = np.full((len(t), 3), spec.acceleration_density**2)
    for start, end in spec.powered_s:
        density[(t >= start) & (t < end)] += spec.powered_sd_mps2**2 * POWERED_CORRELATION_S
    still = np.zeros((len(t), 3))
    motion = Motion(
        True, t, still, still, density, still, np.eye(3), np.eye(3), False, air_table(sounding), AIR_FROM_M,
        AIR_STEP_M, spec.drag_area_per_mass_m2pkg, across_ecef,
    )  # fmt: skip
    return motion, np.searchsorted(t, node_time_s).astype(np.int64)


def _flow(
    motion: Motion, position: FloatArray, velocity: FloatArray, drivers: FloatArray
) -> tuple[FloatArray, float, float]:
    """Velocity against the air (3,), airspeed, and drag over airspeed, 1/s."""
    latitude, longitude, height = (float(x) for x in earth.geodetic_from_ecef(position))
    altitude = motion.air_from_m + motion.air_step_m * np.arange(len(motion.air))
    log_density, north, east, density_sd, wind_sd = (np.interp(height, altitude, column) for column in motion.air.T)
    density = np.exp(log_density + drivers[3] * density_sd)
    wind = np.array([north + drivers[4] * wind_sd, east + drivers[5] * wind_sd, 0.0])
    u = velocity - earth.dcm_ned_ecef(latitude, longitude).T @ wind
    speed = float(np.linalg.norm(u))
    push = 0.5 * density * motion.drag_m2pkg * np.exp(np.clip(drivers[0], -8.0, 8.0)) * speed
    return u, speed, float(push)


def acceleration(motion: Motion, position: FloatArray, velocity: FloatArray, drivers: FloatArray) -> FloatArray:
    """Acceleration (3,) against the rotating Earth, m/s^2."""
    u, speed, push = _flow(motion, position, velocity, drivers)
    across = motion.across_ecef - (motion.across_ecef @ u) * u / speed**2
    across /= np.linalg.norm(across)
    within = np.cross(u / speed, across)
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    force = push * (speed * (drivers[1] * across + drivers[2] * within) - u)
    return np.asarray(force + earth.gravitation(position) - spin @ spin @ position - 2.0 * spin @ velocity)


def propagate_plain(motion: Motion, first: int, last: int, start: States) -> Step:
    """Carry a state between grid points in numpy; slow, for reading and for tests."""
    y = np.concatenate([start.position_ecef_m, start.velocity_ecef_mps])
    drivers = start.sensor_errors[:6]
    transition, noise = np.hstack([np.eye(9), np.zeros((9, 6))]), np.zeros((9, 9))
    step = 1 if last >= first else -1

    def slope(at: FloatArray) -> FloatArray:
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


def _parts(motion: Motion, y: FloatArray, drivers: FloatArray, dt: float) -> Iterator[float]:
    """Parts of a step in which the air changes the velocity ``y[3:]``, carried on in place, by a fifth at most."""
    for _ in range(MOST_PARTS - 1):
        change = _flow(motion, y[:3], y[3:], drivers)[2] * np.hypot(1.0, np.hypot(*drivers[1:3])) * abs(dt)
        part = dt if change <= MOST_CHANGE else dt * MOST_CHANGE / change
        yield part
        dt -= part
        if dt == 0.0:
            return
    yield dt


def _partials(motion: Motion, point: FloatArray) -> FloatArray:
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

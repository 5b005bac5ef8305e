"""Strapdown mechanisation with its transition and noise in numpy: readable twin of `recon.propagation`."""

import numpy as np

from flightmodel import earth, rotations
from recon.propagation import Step, correct, correction_partials
from recon.state import States


def propagate(grid, first, last, start):
    """Carry a state from grid point ``first`` to ``last`` in numpy."""
    position, velocity, q = start.position_ecef_m, start.velocity_ecef_mps, start.q_ecef_body
    errors = start.sensor_errors
    drivers = grid.drivers
    clock = errors[18:20] if grid.clocks else np.zeros(2)
    transition = np.hstack([np.eye(9), np.zeros((9, drivers))])
    noise = np.zeros((9, 9))
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    step = 1 if last >= first else -1
    for k in range(first, last, step):
        dt = grid.time_s[k + step] - grid.time_s[k]
        f_change = grid.force_sensor_mps2[k + step] - grid.force_sensor_mps2[k]
        w_change = grid.rate_sensor_radps[k + step] - grid.rate_sensor_radps[k]
        f_measured = grid.force_sensor_mps2[k] + (0.5 + clock[0] / dt) * f_change
        w_measured = grid.rate_sensor_radps[k] + (0.5 + clock[1] / dt) * w_change
        f = correct(f_measured, errors[0:9], grid.dcm_body_force)
        w = correct(w_measured, errors[9:18], grid.dcm_body_rate)
        df = -correction_partials(f_measured, errors[0:9], grid.dcm_body_force)[:, 0:3] @ f_change
        dw = -correction_partials(w_measured, errors[9:18], grid.dcm_body_rate)[:, 0:3] @ w_change
        f, w = f + dt / 12.0 * (np.cross(w, df) - np.cross(dw, f)), w + dt / 12.0 * np.cross(w, dw)

        earth_half = rotations.exp(-0.5 * dt * earth.OMEGA_ECEF_RADPS)
        q_mid = rotations.multiply(earth_half, rotations.boxplus(q, 0.5 * dt * w))
        q = rotations.multiply(earth_half, rotations.boxplus(q_mid, 0.5 * dt * w))
        mid = position + 0.5 * dt * velocity
        c = rotations.dcm_from_q(q_mid)
        a = c @ f + earth.gravitation(mid) - spin @ spin @ mid
        a = a - 2.0 * spin @ (velocity + 0.5 * dt * (a - 2.0 * spin @ velocity))
        position = position + dt * velocity + 0.5 * dt**2 * a
        velocity = velocity + dt * a

        full = _step_transition(dt, c, f, rotations.dcm_from_q(rotations.exp(0.5 * dt * w)), mid, drivers)
        full[3:6, 9:18] = dt * c @ correction_partials(f_measured, errors[0:9], grid.dcm_body_force)
        d_rate = correction_partials(w_measured, errors[9:18], grid.dcm_body_rate)
        half = rotations.dcm_from_q(rotations.exp(0.5 * dt * w))
        full[6:9, 18:27] = dt * half.T @ d_rate
        full[3:6, 18:27] = -0.5 * dt**2 * c @ rotations.skew(f) @ d_rate
        if grid.clocks:
            turned = c - dt * spin @ c  # signals that jump about make these columns large: with Coriolis
            full[3:6, 27] = turned @ df
            full[6:9, 28] = half.T @ dw
            full[3:6, 28] = -0.5 * dt * turned @ np.cross(f, dw)
        full[0:3, 9:] = 0.5 * dt * full[3:6, 9:]
        transition = full @ np.vstack([transition, np.hstack([np.zeros((drivers, 9)), np.eye(drivers)])])

        j = min(k, k + step)
        noise = full[:, :9] @ noise @ full[:, :9].T + _step_noise(dt, c, grid.force_density[j], grid.rate_density[j])
    return Step(States(position, velocity, q, errors), transition, noise)


def gravitation_gradient(position_m):
    """Gradient of gravitation (3, 3) at one position, central term only (J2 changes it by 0.2 %), 1/s^2."""
    r = np.linalg.norm(position_m)
    n = position_m / r
    return earth.GM_M3PS2 / r**3 * (3.0 * np.outer(n, n) - np.eye(3))


def _step_transition(dt, c, f, half, mid, drivers):
    """Kinematic part of one step's transition, in a (9, 9 + drivers) matrix whose sensor columns are zero."""
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)
    gradient = gravitation_gradient(mid) - spin @ spin
    coriolis = np.eye(3) - dt * spin
    by_position = coriolis @ gradient
    by_velocity = 0.5 * dt * by_position - 2.0 * spin
    by_rotation = -coriolis @ c @ rotations.skew(f) @ half.T
    full = np.zeros((9, 9 + drivers))
    for column, block in zip((0, 3, 6), (by_position, by_velocity, by_rotation), strict=True):
        full[3:6, column : column + 3] = dt * block
        full[0:3, column : column + 3] = 0.5 * dt**2 * block
    full[0:3, 0:3] += np.eye(3)
    full[0:3, 3:6] += dt * np.eye(3)
    full[3:6, 3:6] += np.eye(3)
    full[6:9, 6:9] = half.T @ half.T
    return full


def _step_noise(dt, c, force_density, rate_density):
    """White noise of one step (9, 9)."""
    force = abs(dt) * (c * force_density) @ c.T
    noise = np.zeros((9, 9))
    noise[0:3, 0:3] = force * dt**2 / 3.0
    noise[0:3, 3:6] = noise[3:6, 0:3] = 0.5 * dt * force
    noise[3:6, 3:6] = force
    noise[6:9, 6:9] = abs(dt) * np.diag(rate_density)
    return noise

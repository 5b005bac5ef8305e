"""The least errors that any estimator of the short flight can have: the Cramer-Rao bound, written without the filter.

About the *true* trajectory everything is linearised by finite differences of trajectories, not by the filter's
transition matrices: unknowns (start, sensor errors) are moved one by one, the flight is integrated again in inertial
axes by a Runge-Kutta method of its own, and the radars are asked again. With

    z = Z (x0 + w(t)) + W b + v,     X(t) = F(t) (x0 + w(t)) + G(t) b

x0 the start's errors, b the sensors' (priors P0, Pb), v the radars' white noise R and w the noise of the inertial
sensors carried back to the start, ``cov(w(s), w(t)) = M(min(s, t))``, ``M(t) = int F^-1 Q F^-T dt``, so that process
noise is integrated out, not stepped. The inverse of the Fisher information ``J = A^T R^-1 A + P^-1`` of all unknowns
together, seen through X(t), is by the matrix inversion lemma

    B(t) = cov(X) - cov(X, z) cov(z, z)^-1 cov(z, X)

which needs no information matrix of the 36 000 noises. With priors this is the Bayesian bound.

References
----------
H. van Trees, "Detection, Estimation, and Modulation Theory, Part I", section 2.4.3 (Bayesian bound).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from flightmodel import earth, rotations

from .conftest import ACCELEROMETER, CG, END, IMU, PRIOR_SD, RATES, SITES, START, body_rate

STEP_S = 0.1  # from a track point to the next, and of the quadrature of the noise
SUBSTEPS = 2
DIFFUSE = np.repeat([1000.0, 100.0, PRIOR_SD], 3)  # prior of the start
START_MOVES = np.repeat([100.0, 10.0, 1e-3], 3)
SENSOR_MOVES = np.repeat([1e-2, 1e-3, 1e-3, 1e-5, 1e-3, 1e-3], 3)  # bias, scale, mount of both triads


def corrected(true_body, dcm, errors):
    """What an estimator with wrong ``errors`` (k, 9) makes of a true quantity (3,), body axes (k, 3)."""
    actual = (true_body @ dcm - errors[:, 0:3]) / (1.0 + errors[:, 3:6])
    return rotations.rotate(rotations.exp(errors[:, 6:9]), actual) @ dcm.T


def fly_again(truth, moved_start, moved_sensors):
    """Inertial position, velocity, attitude of the accelerometer at all nodes, (n, k, 10), for k moved unknowns."""
    t0 = np.array([START])
    at = truth.trajectory(t0, IMU)
    turn = rotations.conjugate(earth.q_ecef_eci(START))
    position, velocity = at.position_ecef_m[0] + moved_start[:, 0:3], at.velocity_ecef_mps[0] + moved_start[:, 3:6]
    q = rotations.boxplus(np.tile(at.q_ecef_body[0], (len(moved_start), 1)), moved_start[:, 6:9])
    inertial = velocity + np.cross(earth.OMEGA_ECEF_RADPS, position)
    turns = np.tile(turn, (len(q), 1))
    y = np.hstack([rotations.rotate(turns, position), rotations.rotate(turns, inertial), rotations.multiply(turns, q)])

    def slope(t, y):
        time = np.array([t])
        force = corrected(truth.specific_force_imu(time)[0], ACCELEROMETER.dcm_body_sensor, moved_sensors[:, 0:9])
        rate = corrected(body_rate(time)[0], RATES.dcm_body_sensor, moved_sensors[:, 9:18])
        spin = 0.5 * rotations.multiply(y[:, 6:10], np.hstack([np.zeros((len(y), 1)), rate]))
        return np.hstack([y[:, 3:6], earth.gravitation(y[:, 0:3]) + rotations.rotate(y[:, 6:10], force), spin])

    out = [y]
    h = STEP_S / SUBSTEPS
    for k in range(round((END - 0.6 - START) / STEP_S)):
        for i in range(SUBSTEPS):
            t = START + k * STEP_S + i * h
            a = slope(t, y)
            b = slope(t + 0.5 * h, y + 0.5 * h * a)
            c = slope(t + 0.5 * h, y + 0.5 * h * b)
            d = slope(t + h, y + h * c)
            y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            y[:, 6:10] /= np.linalg.norm(y[:, 6:10], axis=1, keepdims=True)
        out.append(y)
    return np.array(out)


@dataclass(frozen=True)
class Linear:
    """Sensitivities at all nodes: state (n, 9, 9), (n, 9, 18), points (n, 6, 9), (n, 6, 26); noise (n, 9, 9).

    States are the datum's; the noise is carried back to the accelerometer's start.
    """

    time_s: np.ndarray
    by_start: np.ndarray
    by_sensors: np.ndarray
    points_by_start: np.ndarray
    points_by_errors: np.ndarray
    noise: np.ndarray
    points_sd: np.ndarray


def errors_between(a, b, point, rate_a, rate_b):
    """Error (n, k, 9) of inertial states a against b (n, k, 10) of a point from the datum: ECEF and body axes."""
    out = []
    for y, w in ((a, rate_a), (b, rate_b)):
        arm = np.broadcast_to(np.array(point) - IMU, w.shape)
        q = y[..., 6:10]
        out.append((y[..., 0:3] + rotations.rotate(q, arm), y[..., 3:6] + rotations.rotate(q, np.cross(w, arm)), q))
    return np.concatenate([out[0][0] - out[1][0], out[0][1] - out[1][1], rotations.boxminus(out[0][2], out[1][2])], -1)


def track(t, y):
    """Both radars' readings (n, k, 6) of the c.g."""
    turn = np.broadcast_to(earth.q_ecef_eci(t)[:, None], (*y.shape[:2], 4))
    arm = np.broadcast_to(CG - IMU, (*y.shape[:2], 3))
    place = rotations.rotate(turn, y[..., 0:3] + rotations.rotate(y[..., 6:10], arm))
    return np.concatenate(
        [earth.radar_from_ecef(place, s.latitude_rad, s.longitude_rad, s.height_m) for s in SITES], axis=-1
    )


def linearised(truth):
    """Sensitivities about the true trajectory, central differences."""
    moves = np.concatenate([START_MOVES, SENSOR_MOVES])
    steps = np.vstack([np.diag(moves), -np.diag(moves)])
    y = fly_again(truth, steps[:, :9], steps[:, 9:])
    n = len(y)
    t = START + STEP_S * np.arange(n)
    count = len(moves)
    up, down = y[:, :count], y[:, count:]
    rates = np.array([corrected(w, RATES.dcm_body_sensor, steps[:, 18:27]) for w in body_rate(t)])
    dcm = rotations.dcm_from_q(earth.q_ecef_eci(t))
    spin = rotations.skew(earth.OMEGA_ECEF_RADPS)

    def sensitivity(point):
        d = errors_between(up, down, point, rates[:, :count], rates[:, count:]) / (2.0 * moves[:, None])
        d = np.swapaxes(d, 1, 2)  # (n, 9, unknowns)
        position = dcm @ d[:, 0:3]
        return np.concatenate([position, dcm @ d[:, 3:6] - spin @ position, d[:, 6:9]], axis=1)

    datum, own = sensitivity((0.0, 0.0, 0.0)), sensitivity(IMU)[:, :, :9]
    points = np.swapaxes(track(t, up) - track(t, down), 1, 2) / (2.0 * moves)
    here = truth.trajectory(t, CG)
    radars = np.zeros((n, 6, 8))
    sd = np.empty((n, 6))
    for i, s in enumerate(SITES):
        place = (s.latitude_rad, s.longitude_rad, s.height_m)
        h = 0.01
        ahead, behind = (
            earth.radar_from_ecef(here.position_ecef_m + k * here.velocity_ecef_mps, *place) for k in (h, -h)
        )
        rows = slice(3 * i, 3 * i + 3)
        radars[:, rows, 4 * i : 4 * i + 3] = np.eye(3)
        radars[:, rows, 4 * i + 3] = -(ahead - behind) / (2.0 * h)
        elevation = 0.5 * (ahead + behind)[:, 2]
        sd[:, rows] = np.array([s.range_sd_m, s.angle_sd_rad, s.angle_sd_rad])
        sd[:, 3 * i + 1] /= np.cos(elevation)
    return Linear(
        t,
        datum[:, :, :9],
        datum[:, :, 9:],
        points[:, :, :9],
        np.concatenate([points[:, :, 9:], radars], axis=2),
        noise_from_start(own),
        sd,
    )


def noise_from_start(by_start):
    """``M(t)`` (n, 9, 9): both triads' white noise up to each node, carried back to the start; trapezoids."""
    rate_hz = 100.0
    density = [(s.noise_sd**2 + s.resolution**2 / 12.0) / rate_hz for s in (ACCELEROMETER, RATES)]
    q = np.diag(np.repeat([0.0, *density], 3))
    back = np.linalg.inv(by_start)
    flow = back @ q @ np.swapaxes(back, 1, 2)
    out = np.zeros_like(flow)
    out[1:] = np.cumsum(0.5 * STEP_S * (flow[1:] + flow[:-1]), axis=0)
    return out


def error_prior_sd():
    """Prior of both triads' and both radars' errors, (26,)."""
    triads = [np.repeat([s.bias_sd, s.scale_sd, s.mount_sd_rad], 3) for s in (ACCELEROMETER, RATES)]
    radars = [[s.range_bias_sd_m, s.angle_bias_sd_rad, s.angle_bias_sd_rad, s.time_bias_sd_s] for s in SITES]
    return np.concatenate([*triads, *radars])


def bounds(linear, nodes, until_now=False):
    """Least covariance (e, 9, 9) of the datum at chosen nodes: from all track points, or from those up to then."""
    n = len(linear.time_s)
    start, sensors = np.diag(DIFFUSE**2), np.diag(error_prior_sd() ** 2)
    first = np.repeat(np.arange(n), 6)
    a = (linear.points_by_start / linear.points_sd[..., None]).reshape(6 * n, 9)
    b = (linear.points_by_errors / linear.points_sd[..., None]).reshape(6 * n, 26)
    s = np.eye(6 * n) + b @ sensors @ b.T
    carried = [a[6 * k : 6 * k + 6] @ (start + linear.noise[k]) for k in range(n)]  # (6, 9): of node k with any later
    for k in range(n):
        block = carried[k] @ a[6 * k :].T
        s[6 * k : 6 * k + 6, 6 * k :] += block
        s[6 * k + 6 :, 6 * k : 6 * k + 6] += block[:, 6:].T
    whole = None if until_now else cho_factor(s)
    out = []
    for e in nodes:
        f = linear.by_start[e]
        use = slice(0, 6 * (e + 1) if until_now else 6 * n)
        g = np.hstack([linear.by_sensors[e], np.zeros((9, 8))])
        earlier = np.where(first[use, None, None] < e, linear.noise[first[use]], linear.noise[e])
        cross = np.einsum("ij,mjk,mk->im", f, start + earlier, a[use]) + g @ sensors @ b[use].T
        p = f @ (start + linear.noise[e]) @ f.T + g @ sensors @ g.T
        p = p - cross @ cho_solve(whole or cho_factor(s[use, use]), cross.T)
        out.append(0.5 * (p + p.T))
    return np.array(out)

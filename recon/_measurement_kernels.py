"""Compiled measurement predictions and their partials. Model: `recon.measurements`; readable twin:
`tests.oracles.plain_measurements`.

A kind fills ``h`` (3,), ``by_state`` (3, 9) by position, velocity, rotation, and ``by_error`` (3, `SLOTS`) by the
source's own errors in the order of `recon.measurements.SLOT_NAMES`; ``e`` (SLOTS,) holds their values, zero where off.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import RATE, boxplus, dcm_from_quaternion, geodetic, gravitation, inlined
from recon._propagation_kernels import ballistic_acceleration, cross_into, level, matmul_into, mount_matrices

RADAR, POSITION, VELOCITY, HEIGHT, FIELD, SUN, RANGE_RATE, DECELERATION = range(8)
SLOTS = 23


@inlined
def node_motion(motion, index, position, velocity, q, errors, c, rate, acceleration):
    """Attitude matrix, inertial rate in body axes and acceleration against the Earth at a grid point, in place.

    ``rate`` (12, 3), all in body axes, are the rate, its rate of change and the specific force, by which an antenna
    beside the accelerometer moves, and the rate's partials by the gyros' nine errors.
    """
    dcm_from_quaternion(q[0], q[1], q[2], q[3], c)
    if motion.ballistic:
        for j in range(1, 12):
            for i in range(3):
                rate[j, i] = 0.0
        a = ballistic_acceleration(
            motion, position[0], position[1], position[2], velocity[0], velocity[1], velocity[2],
            errors[0], errors[1], errors[2], errors[3], errors[4], errors[5],
        )  # fmt: skip
        for i in range(3):
            rate[0, i] = motion.planet[RATE] * c[2, i]
            acceleration[i] = a[i]
        return
    force = np.empty(3)
    corrected(motion.force_sensor_mps2[index], errors, 0, motion.dcm_body_force, force)
    node_rate(motion, index, errors, rate)
    x, y, z = position[0], position[1], position[2]
    gx, gy, gz = gravitation(x, y, z, motion.planet)
    w2, two = motion.planet[RATE] * motion.planet[RATE], 2.0 * motion.planet[RATE]
    for i in range(3):
        rate[2, i] = force[i]
        acceleration[i] = c[i, 0] * force[0] + c[i, 1] * force[1] + c[i, 2] * force[2]
    acceleration[0] += gx + w2 * x + two * velocity[1]
    acceleration[1] += gy + w2 * y - two * velocity[0]
    acceleration[2] += gz


@inlined
def node_rate(motion, index, errors, rate):
    """Inertial rate at a grid point, its rate of change and its partials in body axes into ``rate`` (12, 3).

    The gyros' clock and what `with_exact_integrals` took from the sample (at even steps) are made good.
    """
    w, t = motion.rate_sensor_radps, motion.time_s
    before, after = max(index - 1, 0), min(index + 1, len(t) - 1)
    late = errors[19] if motion.clocks else 0.0
    first, second = t[index] - t[before], t[after] - t[index]
    even = before < index < after and abs(second - first) < 0.05 * second
    sample, change, turn = np.empty(3), np.empty(3), np.empty(3)
    for j in range(3):
        slope = (w[after, j] - w[before, j]) / (first + second)
        sample[j] = w[index, j] + late * slope
        if even:
            sample[j] += (w[after, j] - 2.0 * w[index, j] + w[before, j]) / 12.0
        change[j] = slope + errors[9 + j]  # of which `corrected` takes the bias
    corrected(sample, errors, 9, motion.dcm_body_rate, turn)
    body_actual, body_mount, column = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    mount_matrices(motion.dcm_body_rate, errors[15:18], body_actual, body_mount)
    for j in range(3):
        rate[0, j] = turn[j]
        gain = 1.0 / (1.0 + errors[12 + j])
        actual = (sample[j] - errors[9 + j]) * gain
        cross_into(body_mount[:, j], turn, column)  # -[w x] of a column
        for i in range(3):
            rate[3 + j, i] = -gain * body_actual[i, j]
            rate[6 + j, i] = actual * rate[3 + j, i]
            rate[9 + j, i] = column[i]
    corrected(change, errors, 9, motion.dcm_body_rate, turn)
    for j in range(3):
        rate[1, j] = turn[j]


@inlined
def corrected(measured, errors, offset, dcm_body_sensor, out):
    """True quantity (3,) in body axes of one sample, ``out = D R(mount) (measured - bias) / (1 + scale)``."""
    q, turn, actual = np.empty(4), np.empty((3, 3)), np.empty(3)
    level(q)
    boxplus(q, errors[offset + 6], errors[offset + 7], errors[offset + 8])
    dcm_from_quaternion(q[0], q[1], q[2], q[3], turn)
    for i in range(3):
        actual[i] = 0.0
        for j in range(3):
            actual[i] += turn[i, j] * (measured[j] - errors[offset + j]) / (1.0 + errors[offset + 3 + j])
    for i in range(3):
        out[i] = 0.0
        for j in range(3):
            out[i] += dcm_body_sensor[i, j] * actual[j]


@inlined
def observed_point(arm, tau, position, velocity, c, rate, acceleration, point, speed, effective, sweep, pulled, planet):
    """Observed point (3,), its velocity, levers of rotation of both, and the point's acceleration (3,) then, in place.

    ``p = r + C d - tau (v + C (w x d)) + tau^2 a_p / 2 - tau^3 j / 6``, ``a_p = a + C s``, ``s = w' x d + w x (w x d)``
    with ``w`` against the Earth; ``j = C (w x (f + s))`` of a force that turns with the body.
    """
    turn, change, lever_velocity = np.empty(3), np.empty(3), np.empty(3)
    swing, inward, pull, jerk = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        turn[i], change[i] = rate[0, i] - planet[RATE] * c[2, i], rate[1, i]
    cross_into(turn, arm, lever_velocity)
    cross_into(change, arm, swing)
    cross_into(turn, lever_velocity, inward)
    for i in range(3):
        swing[i] += inward[i]
        effective[i] = arm[i] - tau * (lever_velocity[i] - 0.5 * tau * swing[i])
        sweep[i] = lever_velocity[i] - tau * swing[i]
        pull[i] = rate[2, i] + swing[i]
    cross_into(turn, pull, jerk)
    for i in range(3):
        moving = velocity[i] + c[i, 0] * lever_velocity[0] + c[i, 1] * lever_velocity[1] + c[i, 2] * lever_velocity[2]
        pulled[i] = acceleration[i] + c[i, 0] * swing[0] + c[i, 1] * swing[1] + c[i, 2] * swing[2]
        late = tau * (c[i, 0] * jerk[0] + c[i, 1] * jerk[1] + c[i, 2] * jerk[2])
        point[i] = position[i] + c[i, 0] * arm[0] + c[i, 1] * arm[1] + c[i, 2] * arm[2]
        point[i] += tau * (0.5 * tau * (pulled[i] - late / 3.0) - moving)
        sweep[i] += 0.5 * tau * tau * jerk[i]
        effective[i] -= tau * tau * tau / 6.0 * jerk[i]
        speed[i] = moving - tau * (pulled[i] - 0.5 * late)
        pulled[i] -= late


@inlined
def state_rows(m, count, tau, c, effective, speed, by_state, by_error):
    """Partials of readings with partials ``m`` (3, 3) by the observed point: by state, and by the time tag (slot 3)."""
    row, lever = np.empty(3), np.empty(3)
    for i in range(count):
        by_error[i, 3] = -(m[i, 0] * speed[0] + m[i, 1] * speed[1] + m[i, 2] * speed[2])
        for j in range(3):
            by_state[i, j] = m[i, j]
            by_state[i, 3 + j] = -tau * m[i, j]
            row[j] = m[i, 0] * c[0, j] + m[i, 1] * c[1, j] + m[i, 2] * c[2, j]
        cross_into(effective, row, lever)  # row . (rotation x effective) = rotation . (effective x row)
        for j in range(3):
            by_state[i, 6 + j] = lever[j]


@inlined
def site_partials(site, dcm_ned_ecef, north, east, down, out):
    """Partials (3, 3) of a point's north, east, down at a site by how far north, east and up of its place it is stated.

    The antenna is levelled where it stands, so that its axes turn with the place: ``(1 - rho x) (r + d)`` with
    ``rho = (-d_e, d_n, d_e tan(latitude)) / R``, to first order.
    """
    per_m = 1.0 / math.sqrt(site[0] * site[0] + site[1] * site[1] + site[2] * site[2])
    tan_lat = -dcm_ned_ecef[2, 2] / max(dcm_ned_ecef[0, 2], 1e-6)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - down * per_m, tan_lat * east * per_m, 0.0
    out[1, 0], out[1, 1], out[1, 2] = 0.0, 1.0 - (tan_lat * north + down) * per_m, 0.0
    out[2, 0], out[2, 1], out[2, 2] = north * per_m, east * per_m, -1.0


@inlined
def predict_radar(site, dcm_ned_ecef, known, e, point, h, m, by_error):
    """Range, azimuth, elevation and partials (3, 3) by the observed point.

    ``known`` (3,) are the site's refractivity and the servo's lag of azimuth and elevation.
    """
    ned = np.empty(3)
    for i in range(3):
        ned[i] = 0.0
        for j in range(3):
            ned[i] += dcm_ned_ecef[i, j] * (point[j] - site[j])
    moved = np.empty((3, 3))
    site_partials(site, dcm_ned_ecef, ned[0], ned[1], ned[2], moved)
    for i in range(3):
        for j in range(3):
            ned[i] += moved[i, j] * (e[13 + j] + e[17 + j])
    north, east, down = ned[0], ned[1], ned[2]
    level2 = north * north + east * east
    horizontal = math.sqrt(level2)
    slant2 = level2 + down * down
    slant = math.sqrt(slant2)
    p = (
        (north / slant, east / slant, down / slant),
        (-east / level2, north / level2, 0.0),
        (down * north / (slant2 * horizontal), down * east / (slant2 * horizontal), -horizontal / slant2),
    )
    sin_az, cos_az = east / horizontal, north / horizontal
    sin_el, cos_el = -down / slant, horizontal / slant
    sec = 1.0 / max(cos_el, 1e-3)
    tan = sin_el * sec
    by_error[0, 0], by_error[1, 1], by_error[2, 2] = 1.0, 1.0, 1.0
    # a pedestal tilted by (tn, te) about north and east: RCC 753-95, to first order
    by_error[1, 4], by_error[1, 5] = -cos_az * tan, -sin_az * tan
    by_error[2, 4], by_error[2, 5] = sin_az, -cos_az
    by_error[2, 6], by_error[1, 7], by_error[1, 8] = cos_el, sec, tan
    by_error[1, 9], by_error[2, 10] = sec, 1.0
    # refraction of a ray through the whole atmosphere; near the horizon it stays at its value at 2 deg
    by_error[2, 11] = known[0] * cos_el / max(sin_el, 0.035)
    by_error[0, 12] = slant
    by_error[1, 16], by_error[1, 20] = 1.0, 1.0
    by_error[0, 21] = 1.0
    by_error[1, 22], by_error[2, 22] = known[1], known[2]
    # the errors themselves change with azimuth and elevation: near the horizon that of the refraction by a tenth
    by_tilt = cos_az * e[4] + sin_az * e[5]
    cosecant_square = 1.0 / (sin_el * sin_el) if sin_el > 0.035 else sin_el / 0.035
    g = (
        (1.0 + e[12], 0.0, 0.0),
        (0.0, 1.0 - tan * (cos_az * e[5] - sin_az * e[4]),
         sec * sec * (e[8] - by_tilt) + sec * tan * (e[7] + e[9])),
        (0.0, by_tilt, 1.0 - sin_el * e[6] - known[0] * cosecant_square * e[11]),
    )  # fmt: skip
    h[0], h[1], h[2] = slant, math.atan2(east, north) + known[1], math.atan2(-down, horizontal) + known[2]
    for i in range(3):
        for j in range(SLOTS):
            if j != 3:
                h[i] += by_error[i, j] * e[j]
    for i in range(3):
        for j in range(3):
            m[i, j] = 0.0
            by_error[i, 13 + j] = 0.0
            for k in range(3):
                f = g[i][0] * p[0][k] + g[i][1] * p[1][k] + g[i][2] * p[2][k]
                m[i, j] += f * dcm_ned_ecef[k, j]
                by_error[i, 13 + j] += f * moved[k, j]
            by_error[i, 17 + j] = by_error[i, 13 + j]


@inlined
def predict_place(kind, site, dcm_ned_ecef, e, point, speed, h, m, by_error, planet):
    """Position or velocity along a reference's axes, or height; partials by the observed point."""
    if kind == HEIGHT:
        sin_lat, cos_lat, height, per_p = geodetic(point[0], point[1], point[2], planet)
        level_part = (1.0 + e[1]) * cos_lat * per_p
        m[0, 0], m[0, 1], m[0, 2] = level_part * point[0], level_part * point[1], (1.0 + e[1]) * sin_lat
        by_error[0, 0], by_error[0, 1], by_error[0, 2] = 1.0, height - site[0], 1.0
        h[0] = height + e[0] + (height - site[0]) * e[1] + e[2]
        return
    for i in range(3):
        h[i] = e[i]
        by_error[i, i] = 1.0
        for j in range(3):
            m[i, j] = dcm_ned_ecef[i, j]
            h[i] += m[i, j] * (point[j] - site[j] if kind == POSITION else speed[j])


@inlined
def mount_row(row, value, e, offset, out):
    """Partials of ``row . R(mount)^T b`` by the mount (3,): ``row [value x] J``, with ``value`` = R^T b.

    The right Jacobian ``J = 1 - [m x] / 2 + [m x]^2 / 6`` leaves out 2e-4 of a mount of 10 deg.
    """
    m, half, sixth = np.empty(3), np.empty(3), np.empty(3)
    m[0], m[1], m[2] = e[offset], e[offset + 1], e[offset + 2]
    cross_into(row, value, out)
    cross_into(out, m, half)
    cross_into(half, m, sixth)
    for j in range(3):
        out[j] += sixth[j] / 6.0 - 0.5 * half[j]


@inlined
def in_mounted_axes(dcm_body_sensor, known, e, offset, c, mount, body, actual):
    """A known ECEF direction in body axes and in those of a sensor whose mount errs by ``e[offset:]``."""
    q, turn = np.empty(4), np.empty((3, 3))
    level(q)
    boxplus(q, e[offset], e[offset + 1], e[offset + 2])
    dcm_from_quaternion(q[0], q[1], q[2], q[3], turn)
    matmul_into(dcm_body_sensor, turn, mount)
    for i in range(3):
        body[i] = c[0, i] * known[0] + c[1, i] * known[1] + c[2, i] * known[2]
    for i in range(3):
        actual[i] = mount[0, i] * body[0] + mount[1, i] * body[1] + mount[2, i] * body[2]


@inlined
def partials_by_rotations(by_axes, i, mount, body, actual, e, offset, by_state, by_error):
    """Partials of component ``i`` by attitude and by mount, of those by the direction in the sensor's axes, (3,).

    A body rotated by d measures ``b + b x d``, a mount rotated by m about sensor axes likewise.
    """
    row, lever = np.empty(3), np.empty(3)
    for j in range(3):
        row[j] = by_axes[0] * mount[j, 0] + by_axes[1] * mount[j, 1] + by_axes[2] * mount[j, 2]
    cross_into(row, body, lever)
    for j in range(3):
        by_state[i, 6 + j] = lever[j]
    row[0], row[1], row[2] = by_axes
    mount_row(row, actual, e, offset, lever)
    for j in range(3):
        by_error[i, offset + j] = lever[j]


@inlined
def predict_field(dcm_body_sensor, known, e, c, h, by_state, by_error):
    """Field in a magnetometer's axes: ``S (R(mount)^T D^T C^T B) + bias``, S with scales and soft iron."""
    mount, body, actual = np.empty((3, 3)), np.empty(3), np.empty(3)
    in_mounted_axes(dcm_body_sensor, known, e, 6, c, mount, body, actual)
    iron = ((1.0 + e[3], e[9], e[10]), (e[9], 1.0 + e[4], e[11]), (e[10], e[11], 1.0 + e[5]))
    for i in range(3):
        h[i] = e[i] + iron[i][0] * actual[0] + iron[i][1] * actual[1] + iron[i][2] * actual[2]
        by_error[i, i], by_error[i, 3 + i] = 1.0, actual[i]
        partials_by_rotations(iron[i], i, mount, body, actual, e, 6, by_state, by_error)
    by_error[0, 9], by_error[1, 9] = actual[1], actual[0]
    by_error[0, 10], by_error[2, 10] = actual[2], actual[0]
    by_error[1, 11], by_error[2, 11] = actual[2], actual[1]


@inlined
def predict_sun(dcm_body_head, known, e, c, h, by_state, by_error):
    """Azimuth and elevation of the Sun in a head's axes; errors: biases normal to the line of sight, mount."""
    mount, body, s = np.empty((3, 3)), np.empty(3), np.empty(3)
    in_mounted_axes(dcm_body_head, known, e, 4, c, mount, body, s)
    normal2 = s[1] * s[1] + s[2] * s[2] + 1e-30
    normal = math.sqrt(normal2)
    whole2 = normal2 + s[0] * s[0]
    less = e[0] / (normal2 * normal)  # of the bias, as the Sun nears the head's x axis
    p = (
        (0.0, s[2] / normal2 - less * s[1], -s[1] / normal2 - less * s[2]),
        (normal / whole2, -s[0] * s[1] / (whole2 * normal), -s[0] * s[2] / (whole2 * normal)),
    )
    h[0] = math.atan2(s[1], s[2]) + e[0] / normal
    h[1] = math.atan2(s[0], normal) + e[1]
    by_error[0, 0], by_error[1, 1] = 1.0 / normal, 1.0
    for i in range(2):
        partials_by_rotations(p[i], i, mount, body, s, e, 4, by_state, by_error)


@inlined
def predict(kind, arm, site, dcm, known, e, position, velocity, c, rate, acceleration, h, by_state, by_error, planet):
    """Prediction and partials of one measurement, in place."""
    for i in range(3):
        h[i] = 0.0
        for j in range(9):
            by_state[i, j] = 0.0
        for j in range(SLOTS):
            by_error[i, j] = 0.0
    if kind == FIELD:
        predict_field(dcm, known, e, c, h, by_state, by_error)
        return
    if kind == SUN:
        predict_sun(dcm, known, e, c, h, by_state, by_error)
        return
    point, speed, effective, m = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    tau, sweep, pulled = e[3], np.empty(3), np.empty(3)
    observed_point(arm, tau, position, velocity, c, rate, acceleration, point, speed, effective, sweep, pulled, planet)
    if kind == RADAR:
        predict_radar(site, dcm, known, e, point, h, m, by_error)
        state_rows(m, 3, tau, c, effective, speed, by_state, by_error)
        return
    if kind == RANGE_RATE:
        predict_range_rate(site, tau, e, c, sweep, pulled, point, speed, effective, h, m, by_state, by_error)
        gyro_rows(by_state[:, 3:6], 1, arm, c, rate, by_error)
        return
    predict_place(kind, site, dcm, e, point, speed, h, m, by_error, planet)
    if kind == VELOCITY:
        velocity_rows(m, 3, c, sweep, pulled, by_state, by_error)
        gyro_rows(m, 3, arm, c, rate, by_error)
        return
    state_rows(m, 1 if kind == HEIGHT else 3, tau, c, effective, speed, by_state, by_error)


@inlined
def predict_range_rate(site, tau, e, c, sweep, pulled, point, speed, effective, h, m, by_state, by_error):
    """Range rate ``u . v`` along the line of sight ``u`` from a site, plus its bias; partials by state and errors."""
    slant = 0.0
    for i in range(3):
        slant += (point[i] - site[i]) * (point[i] - site[i])
    slant = math.sqrt(slant)
    along = np.empty((3, 3))
    h[0] = 0.0
    for i in range(3):
        along[0, i] = (point[i] - site[i]) / slant
        h[0] += along[0, i] * speed[i]
    for i in range(3):
        m[0, i] = (speed[i] - h[0] * along[0, i]) / slant
    velocity_rows(along, 1, c, sweep, pulled, by_state, by_error)
    swing = by_state[0].copy()
    late = by_error[0, 3]
    state_rows(m, 1, tau, c, effective, speed, by_state, by_error)
    for j in range(3, 9):
        by_state[0, j] += swing[j]
    by_error[0, 3] += late
    by_error[0, 0], by_error[0, 1] = 1.0, 1.0
    h[0] += e[0]
    h[0] += e[1]


@inlined
def velocity_rows(m, count, c, sweep, pulled, by_state, by_error):
    """Partials of a velocity along the first axes of ``m`` (3, 3): ``m (v + C (w x d) - tau a_p)``."""
    row, lever = np.empty(3), np.empty(3)
    for i in range(count):
        by_error[i, 3] = -(m[i, 0] * pulled[0] + m[i, 1] * pulled[1] + m[i, 2] * pulled[2])
        for j in range(3):
            by_state[i, 3 + j] = m[i, j]
            row[j] = m[i, 0] * c[0, j] + m[i, 1] * c[1, j] + m[i, 2] * c[2, j]
        cross_into(sweep, row, lever)
        for j in range(3):
            by_state[i, 6 + j] = lever[j]


@inlined
def gyro_rows(m, count, arm, c, rate, by_error):
    """Partials of a velocity along the first axes of ``m`` (3, 3) by the gyros' errors, slots 4 to 13.

    ``m C (dw x d)``; of a late clock ``dw = w'``: without it the filter would find by how much all clocks are late
    alike, which nothing shows. Left out, of what a late tag adds: a twentieth at 37 rad/s and a millisecond.
    """
    row, lever = np.empty(3), np.empty(3)
    for i in range(count):
        for j in range(3):
            row[j] = m[i, 0] * c[0, j] + m[i, 1] * c[1, j] + m[i, 2] * c[2, j]
        cross_into(arm, row, lever)  # row . (dw x d) = dw . (d x row)
        for j in range(9):
            by_error[i, 4 + j] = rate[3 + j, 0] * lever[0] + rate[3 + j, 1] * lever[1] + rate[3 + j, 2] * lever[2]
        by_error[i, 13] = rate[1, 0] * lever[0] + rate[1, 1] * lever[1] + rate[1, 2] * lever[2]


@inlined
def predict_deceleration(motion, e, position, velocity, acceleration, h, by_state, by_error):
    """Deceleration along the flow, ``(1 + scale) a + bias``, of slots 1 and 0; slots 4 to 9 are the air's drivers.

    A late tag, slot 3, reads what was: ``a - tau da/dt`` along the path, the drivers constant.
    """
    s, partial = np.empty(12), np.empty(12)
    for j in range(3):
        s[j], s[3 + j] = position[j], velocity[j]
    for j in range(6):
        s[6 + j] = e[4 + j]
    drag = 0.0
    for k in range(25):  # in one loop: what is written once is compiled once
        j = k // 2 if k < 24 else 0
        middle, step = s[j], 1.0 if j < 3 else (0.01 if j < 6 else 1e-4)
        s[j] = middle + (0.0 if k == 24 else (step if k % 2 == 0 else -step))
        a = ballistic_acceleration(motion, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11])
        drag = a[4]
        s[j] = middle
        if k < 24:
            partial[j] = drag if k % 2 == 0 else (partial[j] - drag) / (2.0 * step)
    change = 0.0
    for j in range(3):
        change += partial[j] * velocity[j] + partial[3 + j] * acceleration[j]
    gain = 1.0 + e[1]
    for i in range(3):
        h[i] = 0.0
        for j in range(9):
            by_state[i, j] = gain * partial[j] if i == 0 and j < 6 else 0.0
        for j in range(SLOTS):
            by_error[i, j] = gain * partial[2 + j] if i == 0 and 4 <= j < 10 else 0.0
    h[0] = gain * (drag - e[3] * change) + e[0]
    by_error[0, 0], by_error[0, 1], by_error[0, 3] = 1.0, drag, -gain * change

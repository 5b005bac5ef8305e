"""Compiled two-body dynamics: right-hand side, Runge-Kutta steps, recording.

Readable twin: `synthetic_flight.dynamics`.

State (20): position and velocity of the composite c.g. (ECI), quaternions ECI from body and ECI from shell, rates of
body and shell (own axes). The joint's constraint is eliminated, so nothing drifts: its force comes from one 3x3
symmetric positive-definite solve (the constraint force equation of a spherical joint).
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import OMEGA_WGS84, geodetic, gravitation, kernel

STATES = 20
# what is recorded beside the state: altitude, density, Mach, dynamic pressure, shell's total angle of attack,
# bending angle, joint force on the body (ECI, 3), joint moment on the body (ECI, 3), aerodynamic force (ECI, 3),
# angular acceleration of the body (body axes, 3)
AUX = 18
# layout of the parameter vector
M_B, M_A, I_B, I_A, W_B, W_A, N_B, N_A, P_B, P_A, NOSE_A, JOINT, REFERENCE = (
    0,
    1,
    2,
    11,
    20,
    29,
    38,
    47,
    56,
    59,
    62,
    65,
    75,
)
PARAMETERS = 77


@kernel
def _rotation(q0, q1, q2, q3):
    return (
        1.0 - 2.0 * (q2 * q2 + q3 * q3), 2.0 * (q1 * q2 - q0 * q3), 2.0 * (q1 * q3 + q0 * q2),
        2.0 * (q1 * q2 + q0 * q3), 1.0 - 2.0 * (q1 * q1 + q3 * q3), 2.0 * (q2 * q3 - q0 * q1),
        2.0 * (q1 * q3 - q0 * q2), 2.0 * (q2 * q3 + q0 * q1), 1.0 - 2.0 * (q1 * q1 + q2 * q2),
    )  # fmt: skip


@kernel
def _apply(m, x, y, z):
    return m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z


@kernel
def _apply_transposed(m, x, y, z):
    return m[0] * x + m[3] * y + m[6] * z, m[1] * x + m[4] * y + m[7] * z, m[2] * x + m[5] * y + m[8] * z


@kernel
def _cross(a0, a1, a2, b0, b1, b2):
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@kernel
def _nine(p, i):
    return p[i], p[i + 1], p[i + 2], p[i + 3], p[i + 4], p[i + 5], p[i + 6], p[i + 7], p[i + 8]


@kernel
def _turned(r, m):
    """R M R^T of a 3x3 matrix given as nine numbers."""
    a = (
        r[0] * m[0] + r[1] * m[3] + r[2] * m[6], r[0] * m[1] + r[1] * m[4] + r[2] * m[7],
        r[0] * m[2] + r[1] * m[5] + r[2] * m[8], r[3] * m[0] + r[4] * m[3] + r[5] * m[6],
        r[3] * m[1] + r[4] * m[4] + r[5] * m[7], r[3] * m[2] + r[4] * m[5] + r[5] * m[8],
        r[6] * m[0] + r[7] * m[3] + r[8] * m[6], r[6] * m[1] + r[7] * m[4] + r[8] * m[7],
        r[6] * m[2] + r[7] * m[5] + r[8] * m[8],
    )  # fmt: skip
    return (
        a[0] * r[0] + a[1] * r[1] + a[2] * r[2], a[0] * r[3] + a[1] * r[4] + a[2] * r[5],
        a[0] * r[6] + a[1] * r[7] + a[2] * r[8], a[3] * r[0] + a[4] * r[1] + a[5] * r[2],
        a[3] * r[3] + a[4] * r[4] + a[5] * r[5], a[3] * r[6] + a[4] * r[7] + a[5] * r[8],
        a[6] * r[0] + a[7] * r[1] + a[8] * r[2], a[6] * r[3] + a[7] * r[4] + a[8] * r[5],
        a[6] * r[6] + a[7] * r[7] + a[8] * r[8],
    )  # fmt: skip


@kernel
def _solve3(m, b0, b1, b2):
    """Solution of a 3x3 system by cofactors."""
    c0 = m[4] * m[8] - m[5] * m[7]
    c1 = m[5] * m[6] - m[3] * m[8]
    c2 = m[3] * m[7] - m[4] * m[6]
    d = 1.0 / (m[0] * c0 + m[1] * c1 + m[2] * c2)
    x = c0 * b0 + (m[2] * m[7] - m[1] * m[8]) * b1 + (m[1] * m[5] - m[2] * m[4]) * b2
    y = c1 * b0 + (m[0] * m[8] - m[2] * m[6]) * b1 + (m[2] * m[3] - m[0] * m[5]) * b2
    z = c2 * b0 + (m[1] * m[6] - m[0] * m[7]) * b1 + (m[0] * m[4] - m[1] * m[3]) * b2
    return x * d, y * d, z * d


@kernel
def beyond_freeplay(theta, freeplay, corner):
    """Bending angle beyond the dead band, with a corner that is smooth in slope over +/- ``corner * freeplay``."""
    w = corner * freeplay
    if theta >= freeplay + w:
        return theta - freeplay
    if theta <= freeplay - w:
        return 0.0
    return (theta - freeplay + w) ** 2 / (4.0 * w)


@kernel
def _joint_moment(p, rb, ra, qb, qa, db, da, dc):
    """Moment of the joint on the body (ECI) and the bending angle; (db, da, dc) is body's rate against shell's (ECI).

    Bending potential of the angle between the two x axes, torsion potential of the twist left after swinging one x
    axis onto the other; both moments are exact gradients, so springs conserve energy at any angle.
    """
    bx, by, bz = rb[0], rb[3], rb[6]
    ax, ay, az = ra[0], ra[3], ra[6]
    ex, ey, ez = _cross(bx, by, bz, ax, ay, az)
    s = math.sqrt(ex * ex + ey * ey + ez * ez)
    c = bx * ax + by * ay + bz * az
    theta = math.atan2(s, c)
    d = beyond_freeplay(theta, p[JOINT + 6], p[JOINT + 7])
    bend = p[JOINT] * d + p[JOINT + 1] * d * d * d
    k = bend / s if s > 1e-9 else p[JOINT] if p[JOINT + 6] == 0.0 else 0.0
    # twist of body against shell: scalar and x parts of conj(q_eci_shell) q_eci_body
    w = qa[0] * qb[0] + qa[1] * qb[1] + qa[2] * qb[2] + qa[3] * qb[3]
    x = qa[0] * qb[1] - qa[1] * qb[0] - qa[2] * qb[3] + qa[3] * qb[2]
    twist = 2.0 * math.atan2(x, w)
    if twist > math.pi:
        twist -= 2.0 * math.pi
    elif twist < -math.pi:
        twist += 2.0 * math.pi
    t = -p[JOINT + 2] * twist / (1.0 + c)
    tx, ty, tz = bx + ax, by + ay, bz + az
    along = (db * tx + da * ty + dc * tz) / (2.0 + 2.0 * c)
    damp = p[JOINT + 3] + p[JOINT + 4] * theta * theta
    roll = (p[JOINT + 5] - damp) * along
    return (
        k * ex + t * tx - damp * db - roll * tx,
        k * ey + t * ty - damp * da - roll * ty,
        k * ez + t * tz - damp * dc - roll * tz,
        theta,
    )


@kernel
def _air(atmosphere, start, step, altitude):
    """Log density, speed of sound, north and east wind at an altitude; end values outside."""
    u = (altitude - start) / step
    u = min(max(u, 0.0), atmosphere.shape[0] - 1.000001)
    i = int(u)
    f = u - i
    g = 1.0 - f
    return (
        g * atmosphere[i, 0] + f * atmosphere[i + 1, 0],
        g * atmosphere[i, 1] + f * atmosphere[i + 1, 1],
        g * atmosphere[i, 2] + f * atmosphere[i + 1, 2],
        g * atmosphere[i, 3] + f * atmosphere[i + 1, 3],
    )


@kernel
def _coefficients(mach_knots, alpha_step, table, mach, alpha):
    """C_A, C_N, C_m, C_mq, bilinear; held at the first and last Mach number."""
    i = 0
    while i < mach_knots.shape[0] - 2 and mach > mach_knots[i + 1]:
        i += 1
    f = min(max((mach - mach_knots[i]) / (mach_knots[i + 1] - mach_knots[i]), 0.0), 1.0)
    u = alpha / alpha_step
    j = min(int(u), table.shape[1] - 2)
    h = u - j
    a, b, c, d = (1.0 - f) * (1.0 - h), (1.0 - f) * h, f * (1.0 - h), f * h
    return (
        a * table[i, j, 0] + b * table[i, j + 1, 0] + c * table[i + 1, j, 0] + d * table[i + 1, j + 1, 0],
        a * table[i, j, 1] + b * table[i, j + 1, 1] + c * table[i + 1, j, 1] + d * table[i + 1, j + 1, 1],
        a * table[i, j, 2] + b * table[i, j + 1, 2] + c * table[i + 1, j, 2] + d * table[i + 1, j + 1, 2],
        a * table[i, j, 3] + b * table[i, j + 1, 3] + c * table[i + 1, j, 3] + d * table[i + 1, j + 1, 3],
    )


@kernel
def _aerodynamics(p, ra, x, v, w, atmosphere, grid, mach_knots, table, aux):
    """Force at the nose and moment about it on the shell (ECI); ``x``, ``v`` of the nose (ECI), ``w`` shell rate."""
    sin_lat, cos_lat, altitude = geodetic(x[0], x[1], x[2])
    log_rho, sound, north, east = _air(atmosphere, grid[0], grid[1], altitude)
    rho = math.exp(log_rho)
    equatorial = math.sqrt(x[0] * x[0] + x[1] * x[1])
    cl, sl = x[0] / equatorial, x[1] / equatorial
    ux = v[0] + OMEGA_WGS84 * x[1] + north * sin_lat * cl + east * sl
    uy = v[1] - OMEGA_WGS84 * x[0] + north * sin_lat * sl - east * cl
    uz = v[2] - north * cos_lat
    u, lv, lw = _apply_transposed(ra, ux, uy, uz)
    lateral = math.sqrt(lv * lv + lw * lw)
    speed = math.sqrt(u * u + lateral * lateral)
    alpha = math.atan2(lateral, u)
    pressure = 0.5 * rho * speed * speed
    mach = speed / sound
    ca, cn, cm, cmq = _coefficients(mach_knots, grid[2], table, mach, alpha)
    area, length = p[REFERENCE], p[REFERENCE + 1]
    ny, nz = (lv / lateral, lw / lateral) if lateral > 1e-12 else (0.0, 0.0)
    qs = pressure * area
    fx, fy, fz = _apply(ra, -qs * ca, -qs * cn * ny, -qs * cn * nz)
    damping = qs * length * length * cmq / (2.0 * max(speed, 1e-3))
    # nose-up about n x x_hat = (0, n_z, -n_y)
    mx, my, mz = _apply(ra, 0.0, qs * length * cm * nz + damping * w[1], -qs * length * cm * ny + damping * w[2])
    aux[0], aux[1], aux[2], aux[3], aux[4] = altitude, rho, mach, pressure, alpha
    return fx, fy, fz, mx, my, mz


@kernel
def rates(y, p, atmosphere, grid, mach_knots, table, locked, dy, aux):
    """Time derivative of the state into ``dy`` and what is recorded into ``aux``."""
    qb, qa = y[6:10], y[10:14]
    wb, wa = y[14:17], y[17:20]
    rb = _rotation(qb[0], qb[1], qb[2], qb[3])
    ra = _rotation(qa[0], qa[1], qa[2], qa[3])
    mb, ma = p[M_B], p[M_A]
    mass = mb + ma
    # joint from each c.g. (ECI), then c.g.s from the composite c.g.
    pb = _apply(rb, p[P_B], p[P_B + 1], p[P_B + 2])
    pa = _apply(ra, p[P_A], p[P_A + 1], p[P_A + 2])
    sx, sy, sz = pa[0] - pb[0], pa[1] - pb[1], pa[2] - pb[2]  # body's c.g. from the shell's
    fb, fa = ma / mass, -mb / mass
    gb = gravitation(y[0] + fb * sx, y[1] + fb * sy, y[2] + fb * sz)
    ga = gravitation(y[0] + fa * sx, y[1] + fa * sy, y[2] + fa * sz)
    wbi = _apply(rb, wb[0], wb[1], wb[2])
    wai = _apply(ra, wa[0], wa[1], wa[2])
    vb = _cross(wbi[0], wbi[1], wbi[2], pb[0], pb[1], pb[2])  # joint's velocity from each c.g.'s
    va = _cross(wai[0], wai[1], wai[2], pa[0], pa[1], pa[2])
    nose = _apply(ra, p[NOSE_A], p[NOSE_A + 1], p[NOSE_A + 2])
    vn = _cross(wai[0], wai[1], wai[2], nose[0], nose[1], nose[2])
    x = (y[0] + fa * sx + nose[0], y[1] + fa * sy + nose[1], y[2] + fa * sz + nose[2])
    v = (
        y[3] + fa * (va[0] - vb[0]) + vn[0],
        y[4] + fa * (va[1] - vb[1]) + vn[1],
        y[5] + fa * (va[2] - vb[2]) + vn[2],
    )
    aero = _aerodynamics(p, ra, x, v, wa, atmosphere, grid, mach_knots, table, aux)
    arm = _cross(nose[0], nose[1], nose[2], aero[0], aero[1], aero[2])
    ta = (aero[3] + arm[0], aero[4] + arm[1], aero[5] + arm[2])  # moment on the shell about its c.g. (ECI)
    for k in range(3):
        dy[k] = y[3 + k]
        dy[3 + k] = (mb * gb[k] + ma * ga[k] + aero[k]) / mass
    if locked:
        tau, theta, force = _locked(p, y, rb, ra, pb, sx, sy, sz, gb, ga, aero, ta, fb, fa, dy)
    else:
        tau, theta, force = _hinged(p, qb, qa, wb, wa, rb, ra, pb, pa, wbi, wai, vb, va, gb, ga, aero, ta, dy)
    _quaternion_rate(qb, wb, dy, 6)
    _quaternion_rate(qa, wa, dy, 10)
    aux[5] = theta
    for k in range(3):
        aux[6 + k] = force[k]
        aux[9 + k] = tau[k]
        aux[12 + k] = aero[k]
        aux[15 + k] = dy[14 + k]


@kernel
def _quaternion_rate(q, w, dy, i):
    dy[i] = 0.5 * (-q[1] * w[0] - q[2] * w[1] - q[3] * w[2])
    dy[i + 1] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1])
    dy[i + 2] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2])
    dy[i + 3] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0])


@kernel
def _euler(inertia, inverse, w, tx, ty, tz):
    """Angular acceleration, own axes, under a moment in own axes."""
    h = _apply(inertia, w[0], w[1], w[2])
    g = _cross(w[0], w[1], w[2], h[0], h[1], h[2])
    return _apply(inverse, tx - g[0], ty - g[1], tz - g[2])


@kernel
def _hinged(p, qb, qa, wb, wa, rb, ra, pb, pa, wbi, wai, vb, va, gb, ga, aero, ta, dy):
    """Rates of both bodies with the joint's force from the constraint force equation."""
    mb, ma = p[M_B], p[M_A]
    jx, jy, jz, theta = _joint_moment(p, rb, ra, qb, qa, wbi[0] - wai[0], wbi[1] - wai[1], wbi[2] - wai[2])
    tb = _apply_transposed(rb, jx, jy, jz)
    tas = _apply_transposed(ra, ta[0] - jx, ta[1] - jy, ta[2] - jz)
    ib, ia, ivb, iva = _nine(p, I_B), _nine(p, I_A), _nine(p, W_B), _nine(p, W_A)
    eb = _euler(ib, ivb, wb, tb[0], tb[1], tb[2])
    ea = _euler(ia, iva, wa, tas[0], tas[1], tas[2])
    ebi, eai = _apply(rb, eb[0], eb[1], eb[2]), _apply(ra, ea[0], ea[1], ea[2])
    ub = _cross(ebi[0], ebi[1], ebi[2], pb[0], pb[1], pb[2])
    ua = _cross(eai[0], eai[1], eai[2], pa[0], pa[1], pa[2])
    cb = _cross(wbi[0], wbi[1], wbi[2], vb[0], vb[1], vb[2])
    ca = _cross(wai[0], wai[1], wai[2], va[0], va[1], va[2])
    mob_b, mob_a = _turned(rb, _nine(p, N_B)), _turned(ra, _nine(p, N_A))
    k = 1.0 / mb + 1.0 / ma
    m = (
        mob_b[0] + mob_a[0] + k, mob_b[1] + mob_a[1], mob_b[2] + mob_a[2],
        mob_b[3] + mob_a[3], mob_b[4] + mob_a[4] + k, mob_b[5] + mob_a[5],
        mob_b[6] + mob_a[6], mob_b[7] + mob_a[7], mob_b[8] + mob_a[8] + k,
    )  # fmt: skip
    force = _solve3(
        m,
        ga[0] + aero[0] / ma + ua[0] + ca[0] - gb[0] - ub[0] - cb[0],
        ga[1] + aero[1] / ma + ua[1] + ca[1] - gb[1] - ub[1] - cb[1],
        ga[2] + aero[2] / ma + ua[2] + ca[2] - gb[2] - ub[2] - cb[2],
    )
    fb, fa = (
        _cross(pb[0], pb[1], pb[2], force[0], force[1], force[2]),
        _cross(pa[0], pa[1], pa[2], force[0], force[1], force[2]),
    )
    lb, la = _apply_transposed(rb, fb[0], fb[1], fb[2]), _apply_transposed(ra, fa[0], fa[1], fa[2])
    cb2, ca2 = _apply(ivb, lb[0], lb[1], lb[2]), _apply(iva, la[0], la[1], la[2])
    for i in range(3):
        dy[14 + i] = eb[i] + cb2[i]
        dy[17 + i] = ea[i] - ca2[i]
    return (jx, jy, jz), theta, force


@kernel
def _locked(p, y, rb, ra, pb, sx, sy, sz, gb, ga, aero, ta, fb, fa, dy):
    """Rates of one rigid body: joint locked, both rates equal; returns the moment and force that the lock carries."""
    mb, ma = p[M_B], p[M_A]
    ib, ia = _turned(rb, _nine(p, I_B)), _turned(ra, _nine(p, I_A))
    reduced = mb * ma / (mb + ma)
    s2 = sx * sx + sy * sy + sz * sz
    m = (
        ib[0] + ia[0] + reduced * (s2 - sx * sx), ib[1] + ia[1] - reduced * sx * sy, ib[2] + ia[2] - reduced * sx * sz,
        ib[3] + ia[3] - reduced * sy * sx, ib[4] + ia[4] + reduced * (s2 - sy * sy), ib[5] + ia[5] - reduced * sy * sz,
        ib[6] + ia[6] - reduced * sz * sx, ib[7] + ia[7] - reduced * sz * sy, ib[8] + ia[8] + reduced * (s2 - sz * sz),
    )  # fmt: skip
    w = _apply(rb, y[14], y[15], y[16])
    h = _apply(m, w[0], w[1], w[2])
    g = _cross(w[0], w[1], w[2], h[0], h[1], h[2])
    # moments about the composite c.g.: aerodynamics (ta is about the shell's c.g.) and gravity's gradient
    t1 = _cross(fa * sx, fa * sy, fa * sz, aero[0], aero[1], aero[2])
    t2 = _cross(sx, sy, sz, reduced * (gb[0] - ga[0]), reduced * (gb[1] - ga[1]), reduced * (gb[2] - ga[2]))
    e = _solve3(m, ta[0] + t1[0] + t2[0] - g[0], ta[1] + t1[1] + t2[1] - g[1], ta[2] + t1[2] + t2[2] - g[2])
    eb, ea = _apply_transposed(rb, e[0], e[1], e[2]), _apply_transposed(ra, e[0], e[1], e[2])
    for k in range(3):
        dy[14 + k] = eb[k]
        dy[17 + k] = ea[k]
    # force on the body: its c.g.'s acceleration less gravity
    r1 = _cross(w[0], w[1], w[2], fb * sx, fb * sy, fb * sz)
    r2 = _cross(w[0], w[1], w[2], r1[0], r1[1], r1[2])
    r3 = _cross(e[0], e[1], e[2], fb * sx, fb * sy, fb * sz)
    force = (
        mb * (dy[3] + r2[0] + r3[0] - gb[0]),
        mb * (dy[4] + r2[1] + r3[1] - gb[1]),
        mb * (dy[5] + r2[2] + r3[2] - gb[2]),
    )
    # moment on the body about its c.g. that is not the force's at the joint
    hb = _apply(ib, w[0], w[1], w[2])
    g1 = _cross(w[0], w[1], w[2], hb[0], hb[1], hb[2])
    ie = _apply(ib, e[0], e[1], e[2])
    arm = _cross(pb[0], pb[1], pb[2], force[0], force[1], force[2])
    tau = (ie[0] + g1[0] - arm[0], ie[1] + g1[1] - arm[1], ie[2] + g1[2] - arm[2])
    c = rb[0] * ra[0] + rb[3] * ra[3] + rb[6] * ra[6]
    ex, ey, ez = _cross(rb[0], rb[3], rb[6], ra[0], ra[3], ra[6])
    return tau, math.atan2(math.sqrt(ex * ex + ey * ey + ez * ez), c), force


@kernel
def integrate(y0, p, atmosphere, grid, mach_knots, table, step, per_record, records, lock_records, limit, out, out_aux):
    """Fly ``records - 1`` intervals of ``per_record`` RK4 steps; joint locked for the first ``lock_records`` intervals.

    Returns the number of records written: less than ``records`` where the bending angle passed ``limit`` or a number
    stopped being finite.
    """
    y, trial = y0.copy(), np.empty(STATES)
    k1, k2, k3, k4 = np.empty(STATES), np.empty(STATES), np.empty(STATES), np.empty(STATES)
    aux = np.empty(AUX)
    for record in range(records):
        locked = record < lock_records
        rates(y, p, atmosphere, grid, mach_knots, table, locked, k1, aux)
        for i in range(STATES):
            out[record, i] = y[i]
        for i in range(AUX):
            out_aux[record, i] = aux[i]
        if not aux[5] < limit:
            return record + 1
        if record == records - 1:
            break
        for _ in range(per_record):
            rates(y, p, atmosphere, grid, mach_knots, table, locked, k1, aux)
            for i in range(STATES):
                trial[i] = y[i] + 0.5 * step * k1[i]
            rates(trial, p, atmosphere, grid, mach_knots, table, locked, k2, aux)
            for i in range(STATES):
                trial[i] = y[i] + 0.5 * step * k2[i]
            rates(trial, p, atmosphere, grid, mach_knots, table, locked, k3, aux)
            for i in range(STATES):
                trial[i] = y[i] + step * k3[i]
            rates(trial, p, atmosphere, grid, mach_knots, table, locked, k4, aux)
            for i in range(STATES):
                y[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
            for j in (6, 10):
                n = 1.0 / math.sqrt(y[j] * y[j] + y[j + 1] * y[j + 1] + y[j + 2] * y[j + 2] + y[j + 3] * y[j + 3])
                for i in range(4):
                    y[j + i] *= n
    return records

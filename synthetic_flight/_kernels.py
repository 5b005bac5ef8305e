"""Compiled two-body dynamics: right-hand side, Runge-Kutta steps, recording; one flight or many side by side.

Readable twin: `synthetic_flight.dynamics`.

State (20): position and velocity of the composite c.g. (ECI), quaternions ECI from body and ECI from shell, rates of
body and shell (own axes). The joint's constraint is eliminated, so nothing drifts: its force comes from one 3x3
symmetric positive-definite solve (the constraint force equation of a spherical joint), in shell axes, where the
shell's inertia, its arm to the joint and the aerodynamic wrench need no turning.

One flight is a long chain of dependent arithmetic, so a processor mostly waits. Flights do not depend on each other,
so they fly in lanes: row ``r`` of the workspace ``s`` holds one quantity of every flight, ``s[r * lanes + i]``, and
loops over ``i`` become vector instructions. The number of lanes is the length of the tuple ``lanes``, which the
compiler knows; one lane is the plain simulator. Table look-ups, which do not vectorise, have loops of their own. All
rows lie in one array, so that the compiler sees that none overlap. Branches in vector loops must be arithmetic.
"""

from __future__ import annotations

import math

from flightmodel import _kernels as la
from flightmodel._kernels import inlined, kernel
from synthetic_flight import _air_kernels as air
from synthetic_flight import _workspace_kernels as at


@kernel
def beyond_freeplay(theta, freeplay, half, per_four_half):
    """Bending angle beyond the dead band, with a corner that is smooth in slope over +/- ``half``."""
    inside = min(max(theta - freeplay + half, 0.0), 2.0 * half)
    return inside * inside * per_four_half + max(theta - freeplay - half, 0.0)


@inlined
def _joint(s, w, i, c, wx, wy, wz):
    """Moment of the joint on the body and the bending angle; ``w``: body's rate against the shell's. Shell axes.

    Bending potential of the angle between the two x axes, torsion potential of the twist left after swinging one x
    axis onto the other; both moments are exact gradients, so springs conserve energy at any angle.
    """
    # body's x axis is (c0, c3, c6), the shell's (1, 0, 0): their cross product is (0, c6, -c3)
    sine = math.sqrt(c[6] * c[6] + c[3] * c[3])
    theta = la.atan2(sine, c[0])
    j = (at.P + at.JOINT) * w + i
    d = beyond_freeplay(theta, s[j + 6 * w], s[j + 7 * w], s[j + 8 * w])
    k = d * (s[j] + s[j + w] * d * d) / (sine + 1e-300)
    twist = 2.0 * la.atan2(s[(at.TWIST + 1) * w + i], s[at.TWIST * w + i])
    twist -= 2.0 * math.pi * ((1.0 if twist > math.pi else 0.0) - (1.0 if twist < -math.pi else 0.0))
    tx, ty, tz = 1.0 + c[0], c[3], c[6]
    damp = s[j + 3 * w] + s[j + 4 * w] * theta * theta
    per_tx = 1.0 / tx
    t = -per_tx * (s[j + 2 * w] * twist + 0.5 * (s[j + 5 * w] - damp) * (wx * tx + wy * ty + wz * tz))
    return t * tx - damp * wx, k * c[6] + t * ty - damp * wy, t * tz - k * c[3] - damp * wz, theta


@inlined
def _common(s, w, i, planet):
    """What both joints need: rotations, rates, arms, and gravity and aerodynamics, their sum already in the rates."""
    r, c = at.nine(s, at.R_A, w, i), at.nine(s, at.C_AB, w, i)
    mb, ma, per_mass = s[(at.P + at.M_B) * w + i], s[(at.P + at.M_A) * w + i], s[(at.P + at.PER_MASS) * w + i]
    bx, by, bz = at.three(s, at.P + at.P_B, w, i)
    bx, by, bz = la.times(c, bx, by, bz)
    ax, ay, az = at.three(s, at.P + at.P_A, w, i)
    sx, sy, sz = ax - bx, ay - by, az - bz  # body's c.g. from the shell's
    ex, ey, ez = la.times(r, sx, sy, sz)
    fb, fa = s[(at.P + at.SHARE_B) * w + i], s[(at.P + at.SHARE_A) * w + i]
    x, y, z = at.three(s, at.TRIAL, w, i)
    g0, g1, g2 = la.gravitation(x + fb * ex, y + fb * ey, z + fb * ez, planet)
    h0, h1, h2 = la.gravitation(x + fa * ex, y + fa * ey, z + fa * ez, planet)
    _, wa1, wa2 = at.three(s, at.TRIAL + 17, w, i)
    fx, fy, fz, mx, my = air.wrench(s, w, i, wa1, wa2)
    nx, ny, nz = at.three(s, at.P + at.NOSE_A, w, i)
    tx, ty, tz = la.cross(nx, ny, nz, fx, fy, fz)
    gx, gy, gz = la.times(r, fx, fy, fz)
    vx, vy, vz = at.three(s, at.TRIAL + 3, w, i)
    at.put(s, at.RATE, w, i, vx, vy, vz)
    a0, a1, a2 = mb * g0 + ma * h0 + gx, mb * g1 + ma * h1 + gy, mb * g2 + ma * h2 + gz
    at.put(s, at.RATE + 3, w, i, a0 * per_mass, a1 * per_mass, a2 * per_mass)
    at.put(s, at.AERO, w, i, fx, fy, fz)
    tide = la.back(r, h0 - g0, h1 - g1, h2 - g2)
    for k, q in ((6, 14), (10, 17)):
        t = (at.TRIAL + k) * w + i
        q0, q1, q2, q3 = s[t], s[t + w], s[t + 2 * w], s[t + 3 * w]
        w0, w1, w2 = at.three(s, at.TRIAL + q, w, i)
        t = (at.RATE + k) * w + i
        s[t], s[t + w] = 0.5 * (-q1 * w0 - q2 * w1 - q3 * w2), 0.5 * (q0 * w0 + q2 * w2 - q3 * w1)
        s[t + 2 * w], s[t + 3 * w] = 0.5 * (q0 * w1 + q3 * w0 - q1 * w2), 0.5 * (q0 * w2 + q1 * w1 - q2 * w0)
    return c, (bx, by, bz), (ax, ay, az), (sx, sy, sz), tide, (tx, ty + mx, tz + my), (fx, fy, fz)


@kernel
def _hinged(s, lanes, planet):
    """Rates of both bodies with the joint's force from the constraint force equation."""
    w = len(lanes)
    for i in range(w):
        c, _, pa, _, tide, ta, aero = _common(s, w, i, planet)
        wb0, wb1, wb2 = at.three(s, at.TRIAL + 14, w, i)
        wa0, wa1, wa2 = at.three(s, at.TRIAL + 17, w, i)
        vx, vy, vz = la.times(c, wb0, wb1, wb2)
        jx, jy, jz, theta = _joint(s, w, i, c, vx - wa0, vy - wa1, vz - wa2)
        inverse_b, inverse_a = at.six(s, at.P + at.W_B, w, i), at.six(s, at.P + at.W_A, w, i)
        g0, g1, g2 = la.gyroscopic(at.six(s, at.P + at.I_B, w, i), wb0, wb1, wb2)
        h0, h1, h2 = la.gyroscopic(at.six(s, at.P + at.I_A, w, i), wa0, wa1, wa2)
        tx, ty, tz = la.back(c, jx, jy, jz)
        eb0, eb1, eb2 = la.symmetric(inverse_b, tx - g0, ty - g1, tz - g2)
        ea0, ea1, ea2 = la.symmetric(inverse_a, ta[0] - jx - h0, ta[1] - jy - h1, ta[2] - jz - h2)
        # what the joint's point would do without the joint's force
        p0, p1, p2 = at.three(s, at.P + at.P_B, w, i)
        x, y, z = la.cross(eb0, eb1, eb2, p0, p1, p2)
        u, v, t = la.centripetal(wb0, wb1, wb2, p0, p1, p2)
        x, y, z = la.times(c, x + u, y + v, z + t)
        u, v, t = la.cross(ea0, ea1, ea2, pa[0], pa[1], pa[2])
        m0, m1, m2 = la.centripetal(wa0, wa1, wa2, pa[0], pa[1], pa[2])
        x, y, z = tide[0] + u + m0 - x, tide[1] + v + m1 - y, tide[2] + t + m2 - z
        per_a = s[(at.P + at.PER_A) * w + i]
        k, n, m = (
            per_a + s[(at.P + at.PER_B) * w + i],
            la.turned(c, at.six(s, at.P + at.N_B, w, i)),
            at.six(s, at.P + at.N_A, w, i),
        )
        n = (n[0] + m[0] + k, n[1] + m[1], n[2] + m[2], n[3] + m[3] + k, n[4] + m[4], n[5] + m[5] + k)
        fx, fy, fz = la.solved(n, x + aero[0] * per_a, y + aero[1] * per_a, z + aero[2] * per_a)
        u, v, t = la.back(c, fx, fy, fz)
        u, v, t = la.cross(p0, p1, p2, u, v, t)
        u, v, t = la.symmetric(inverse_b, u, v, t)
        x, y, z = la.cross(pa[0], pa[1], pa[2], fx, fy, fz)
        x, y, z = la.symmetric(inverse_a, x, y, z)
        at.put(s, at.RATE + 14, w, i, eb0 + u, eb1 + v, eb2 + t)
        at.put(s, at.RATE + 17, w, i, ea0 - x, ea1 - y, ea2 - z)
        s[at.THETA * w + i] = theta
        at.put(s, at.FORCE, w, i, fx, fy, fz)
        at.put(s, at.MOMENT, w, i, jx, jy, jz)
        at.put(s, at.TURN, w, i, eb0 + u, eb1 + v, eb2 + t)


@kernel
def _locked(s, lanes, planet):
    """Rates of one rigid body: joint locked, both rates equal; the moment and force that the lock carries."""
    w = len(lanes)
    for i in range(w):
        c, pb, _, d, tide, ta, aero = _common(s, w, i, planet)
        w0, w1, w2 = at.three(s, at.TRIAL + 17, w, i)
        mb, f, share = s[(at.P + at.M_B) * w + i], s[(at.P + at.SHARE_A) * w + i], s[(at.P + at.SHARE_B) * w + i]
        per_mass = s[(at.P + at.PER_MASS) * w + i]
        m, square = mb * share, d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        b, a = la.turned(c, at.six(s, at.P + at.I_B, w, i)), at.six(s, at.P + at.I_A, w, i)
        n = (
            a[0] + b[0] + m * (square - d[0] * d[0]), a[1] + b[1] - m * d[0] * d[1], a[2] + b[2] - m * d[0] * d[2],
            a[3] + b[3] + m * (square - d[1] * d[1]), a[4] + b[4] - m * d[1] * d[2],
            a[5] + b[5] + m * (square - d[2] * d[2]),
        )  # fmt: skip
        g0, g1, g2 = la.gyroscopic(n, w0, w1, w2)
        # moments about the composite c.g.: aerodynamics (ta is about the shell's c.g.) and gravity's gradient
        x, y, z = f * aero[0] - m * tide[0], f * aero[1] - m * tide[1], f * aero[2] - m * tide[2]
        x, y, z = la.cross(d[0], d[1], d[2], x, y, z)
        e0, e1, e2 = la.solved(n, ta[0] + x - g0, ta[1] + y - g1, ta[2] + z - g2)
        # the body's c.g. moves with the composite c.g. and turns about it
        x, y, z = la.centripetal(w0, w1, w2, d[0], d[1], d[2])
        u, v, t = la.cross(e0, e1, e2, d[0], d[1], d[2])
        fx = mb * (share * (tide[0] + x + u) + aero[0] * per_mass)
        fy = mb * (share * (tide[1] + y + v) + aero[1] * per_mass)
        fz = mb * (share * (tide[2] + z + t) + aero[2] * per_mass)
        # moment on the body about its c.g. that is not the force's at the joint
        g0, g1, g2 = la.gyroscopic(b, w0, w1, w2)
        x, y, z = la.symmetric(b, e0, e1, e2)
        u, v, t = la.cross(pb[0], pb[1], pb[2], fx, fy, fz)
        at.put(s, at.FORCE, w, i, fx, fy, fz)
        at.put(s, at.MOMENT, w, i, x + g0 - u, y + g1 - v, z + g2 - t)
        x, y, z = la.back(c, e0, e1, e2)
        at.put(s, at.RATE + 14, w, i, x, y, z)
        at.put(s, at.RATE + 17, w, i, e0, e1, e2)
        at.put(s, at.TURN, w, i, x, y, z)
        s[at.THETA * w + i] = la.atan2(math.sqrt(c[6] * c[6] + c[3] * c[3]), c[0])


@kernel
def rates(s, lanes, atmosphere, grid, mach_knots, table, free, planet, locked):
    """Time derivative of the trial state of every lane, and what is recorded."""
    air.place(s, lanes, planet)
    air.air(s, lanes, atmosphere, grid)
    air.flow(s, lanes)
    air.look_up(s, lanes, grid, mach_knots, table, free)
    if locked:
        _locked(s, lanes, planet)
    else:
        _hinged(s, lanes, planet)


@kernel
def _record(s, w, record, limit, out, out_aux, written):
    """Write state and record of every lane that still flies; true while one does."""
    flying = False
    for i in range(w):
        if written[i] < record:
            continue
        written[i] = record + 1
        for k in range(at.STATES):
            out[i, record, k] = s[(at.Y + k) * w + i]
        for k in range(at.AUX):
            out_aux[i, record, k] = s[(at.REC + k) * w + i]
        if s[at.THETA * w + i] < limit:
            flying = True
        else:
            written[i] = -record - 1  # ended here
    return flying


@kernel
def _advance(s, w, stage, step):
    """After a stage of RK4: add to the next state, and set the next trial state."""
    ahead = step * (1.0 if stage == 2 else 0.5)
    if stage == 0:
        for k in range(at.STATES * w):
            s[at.NEXT * w + k] = s[at.Y * w + k] + step / 6.0 * s[at.RATE * w + k]
    else:
        for k in range(at.STATES * w):
            s[at.NEXT * w + k] += step / 3.0 * s[at.RATE * w + k]
    for k in range(at.STATES * w):
        s[at.TRIAL * w + k] = s[at.Y * w + k] + ahead * s[at.RATE * w + k]


@kernel
def _finish(s, w, step):
    """After the last stage: the new state, quaternions of length one, and the trial state equal to it."""
    for k in range(at.STATES * w):
        s[at.Y * w + k] = s[at.NEXT * w + k] + step / 6.0 * s[at.RATE * w + k]
    for row in (at.Y + 6, at.Y + 10):
        for i in range(w):
            j = row * w + i
            a, b, c, d = s[j], s[j + w], s[j + 2 * w], s[j + 3 * w]
            n = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
            s[j], s[j + w], s[j + 2 * w], s[j + 3 * w] = a * n, b * n, c * n, d * n
    for k in range(at.STATES * w):
        s[at.TRIAL * w + k] = s[at.Y * w + k]


@kernel
def integrate(lanes, s, tables, planet, step, per_record, records, lock_records, limit, out, out_aux, written):
    """Fly ``records - 1`` intervals of ``per_record`` RK4 steps; joint locked for the first ``lock_records`` intervals.

    ``written`` becomes the number of records of every lane, negative where the flight ended because the bending angle
    passed ``limit`` or was not a number any more.
    """
    w = len(lanes)
    for k in range(at.STATES * w):
        s[at.TRIAL * w + k] = s[at.Y * w + k]
    for record in range(records):
        locked = record < lock_records
        for sub in range(per_record):
            for stage in range(4):
                rates(s, lanes, tables[0], tables[1], tables[2], tables[3], tables[4], planet, locked)
                if stage + sub == 0:
                    flying = _record(s, w, record, limit, out, out_aux, written)
                    if record == records - 1 or not flying:
                        return
                if stage < 3:
                    _advance(s, w, stage, step)
            _finish(s, w, step)

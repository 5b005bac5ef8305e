"""Compiled two-body dynamics: right-hand side, Runge-Kutta steps, recording; one flight or many side by side.

Readable twin: `synthetic_flight.dynamics`.

State (20): position and velocity of the composite c.g. (ECI), quaternions ECI from body and ECI from shell, rates of
body and shell (own axes). The joint's constraint is eliminated, so nothing drifts: its force comes from one 3x3
symmetric positive-definite solve (the constraint force equation of a spherical joint), in shell axes, where the
shell's inertia, its arm to the joint and the aerodynamic wrench need no turning.

One flight is a long chain of dependent arithmetic, so a processor mostly waits. Flights do not depend on each other,
so they fly in lanes: row ``r`` of the workspace ``s`` holds one quantity of every flight, ``s[r * lanes + i]``, and
loops over ``i`` become vector instructions. The number of lanes is the length of the tuple ``lanes``, which the
compiler knows; one lane is the plain simulator. Loops are short, so that the processor works at the chains of several
lanes at once; table look-ups, which do not vectorise, have loops of their own. All rows lie in one array, so that the
compiler sees that none overlap. Branches in vector loops must be arithmetic (`tests` watch the machine code).
"""

from __future__ import annotations

import math

from flightmodel import _kernels as la
from flightmodel._kernels import inlined, kernel
from synthetic_flight import _air_kernels as air
from synthetic_flight import _workspace_kernels as at


@inlined
def beyond_freeplay(theta, freeplay, half, per_four_half):
    """Bending angle beyond the dead band, with a corner that is smooth in slope over +/- ``half``."""
    inside = min(max(theta - freeplay + half, 0.0), 2.0 * half)
    return inside * inside * per_four_half + max(theta - freeplay - half, 0.0)


@inlined
def _attitudes(s, lanes):
    """Rotations, and what of the body is wanted in shell axes."""
    w = len(lanes)
    for i in range(w):
        t = (at.TRIAL + 6) * w + i
        b0, b1, b2, b3 = s[t], s[t + w], s[t + 2 * w], s[t + 3 * w]
        a0, a1, a2, a3 = s[t + 4 * w], s[t + 5 * w], s[t + 6 * w], s[t + 7 * w]
        q0, q1 = a0 * b0 + a1 * b1 + a2 * b2 + a3 * b3, a0 * b1 - a1 * b0 - a2 * b3 + a3 * b2
        q2, q3 = a0 * b2 + a1 * b3 - a2 * b0 - a3 * b1, a0 * b3 - a1 * b2 + a2 * b1 - a3 * b0
        s[at.TWIST * w + i], s[(at.TWIST + 1) * w + i] = q0, q1
        at.put_nine(s, at.R_A, w, i, la.rotation(a0, a1, a2, a3))
        c = la.rotation(q0, q1, q2, q3)
        at.put_nine(s, at.C_AB, w, i, c)
        wb0, wb1, wb2 = at.three(s, at.TRIAL + 14, w, i)
        x, y, z = la.times(c, wb0, wb1, wb2)
        at.put(s, at.RATE_B, w, i, x, y, z)
        ax, ay, az = at.three(s, at.P + at.P_A, w, i)
        x, y, z = at.three(s, at.P + at.P_B, w, i)
        x, y, z = la.times(c, x, y, z)
        at.put(s, at.ARM_B, w, i, x, y, z)
        at.put(s, at.BETWEEN, w, i, ax - x, ay - y, az - z)
        wa0, wa1, wa2 = at.three(s, at.TRIAL + 17, w, i)
        _spin(s, w, i, at.RATE + 6, b0, b1, b2, b3, wb0, wb1, wb2)
        _spin(s, w, i, at.RATE + 10, a0, a1, a2, a3, wa0, wa1, wa2)
        x, y, z = at.three(s, at.TRIAL + 3, w, i)
        at.put(s, at.RATE, w, i, x, y, z)


@inlined
def _spin(s, w, i, row, q0, q1, q2, q3, w0, w1, w2):
    t = row * w + i
    s[t], s[t + w] = 0.5 * (-q1 * w0 - q2 * w1 - q3 * w2), 0.5 * (q0 * w0 + q2 * w2 - q3 * w1)
    s[t + 2 * w], s[t + 3 * w] = 0.5 * (q0 * w1 + q3 * w0 - q1 * w2), 0.5 * (q0 * w2 + q1 * w1 - q2 * w0)


@inlined
def _joint(s, lanes):
    """Moment of the joint on the body, and the bending angle.

    Bending potential of the angle between the two x axes, torsion potential of the twist left after swinging one x
    axis onto the other; both moments are exact gradients, so springs conserve energy at any angle.
    """
    w = len(lanes)
    for i in range(w):
        # the body's x axis; the shell's is (1, 0, 0), and their cross product (0, z, -y)
        x, y, z = s[at.C_AB * w + i], s[(at.C_AB + 3) * w + i], s[(at.C_AB + 6) * w + i]
        sine = math.sqrt(y * y + z * z)
        theta = la.atan2(sine, x)
        j = (at.P + at.JOINT) * w + i
        d = beyond_freeplay(theta, s[j + 6 * w], s[j + 7 * w], s[j + 8 * w])
        k = d * (s[j] + s[j + w] * d * d) / (sine + 1e-300)
        twist = 2.0 * la.atan2(s[(at.TWIST + 1) * w + i], s[at.TWIST * w + i])
        twist -= 2.0 * math.pi * ((1.0 if twist > math.pi else 0.0) - (1.0 if twist < -math.pi else 0.0))
        b0, b1, b2 = at.three(s, at.RATE_B, w, i)
        a0, a1, a2 = at.three(s, at.TRIAL + 17, w, i)
        w0, w1, w2, damp = b0 - a0, b1 - a1, b2 - a2, s[j + 3 * w] + s[j + 4 * w] * theta * theta
        along = 0.5 * (w0 * (1.0 + x) + w1 * y + w2 * z)
        t = -(s[j + 2 * w] * twist + (s[j + 5 * w] - damp) * along) / (1.0 + x)
        s[at.THETA * w + i] = theta
        at.put(s, at.MOMENT, w, i, t * (1.0 + x) - damp * w0, k * z + t * y - damp * w1, t * z - k * y - damp * w2)


@inlined
def _pull(s, lanes, planet):
    """Acceleration of the composite c.g. under gravity and aerodynamics, and the loads on the two bodies."""
    w = len(lanes)
    for i in range(w):
        r, per_mass = at.nine(s, at.R_A, w, i), s[(at.P + at.PER_MASS) * w + i]
        mb, ma = s[(at.P + at.M_B) * w + i], s[(at.P + at.M_A) * w + i]
        fb, fa = s[(at.P + at.SHARE_B) * w + i], s[(at.P + at.SHARE_A) * w + i]
        dx, dy, dz = at.three(s, at.BETWEEN, w, i)
        dx, dy, dz = la.times(r, dx, dy, dz)
        x, y, z = at.three(s, at.TRIAL, w, i)
        g0, g1, g2 = la.gravitation(x + fb * dx, y + fb * dy, z + fb * dz, planet)
        h0, h1, h2 = la.gravitation(x + fa * dx, y + fa * dy, z + fa * dz, planet)
        x, y, z = la.back(r, h0 - g0, h1 - g1, h2 - g2)
        at.put(s, at.TIDE, w, i, x, y, z)
        fx, fy, fz, my, mz = air.wrench(s, w, i)
        at.put(s, at.AERO, w, i, fx, fy, fz)
        nx, ny, nz = at.three(s, at.P + at.NOSE_A, w, i)
        x, y, z = la.cross(nx, ny, nz, fx, fy, fz)
        at.put(s, at.SHELL, w, i, x, y + my, z + mz)
        x, y, z = la.times(r, fx, fy, fz)
        x, y, z = mb * g0 + ma * h0 + x, mb * g1 + ma * h1 + y, mb * g2 + ma * h2 + z
        at.put(s, at.RATE + 3, w, i, x * per_mass, y * per_mass, z * per_mass)


@inlined
def _hinged(s, lanes):
    """Angular accelerations of both bodies with the joint's force from the constraint force equation."""
    w = len(lanes)
    for i in range(w):
        c, per_a = at.nine(s, at.C_AB, w, i), s[(at.P + at.PER_A) * w + i]
        wb0, wb1, wb2 = at.three(s, at.TRIAL + 14, w, i)
        wa0, wa1, wa2 = at.three(s, at.TRIAL + 17, w, i)
        inverse_b, inverse_a = at.six(s, at.P + at.W_B, w, i), at.six(s, at.P + at.W_A, w, i)
        g0, g1, g2 = la.gyroscopic(at.six(s, at.P + at.I_B, w, i), wb0, wb1, wb2)
        h0, h1, h2 = la.gyroscopic(at.six(s, at.P + at.I_A, w, i), wa0, wa1, wa2)
        jx, jy, jz = at.three(s, at.MOMENT, w, i)
        x, y, z = la.back(c, jx, jy, jz)
        eb0, eb1, eb2 = la.symmetric(inverse_b, x - g0, y - g1, z - g2)
        x, y, z = at.three(s, at.SHELL, w, i)
        ea0, ea1, ea2 = la.symmetric(inverse_a, x - jx - h0, y - jy - h1, z - jz - h2)
        # what would part the two joint points, without the joint's force
        p0, p1, p2 = at.three(s, at.P + at.P_B, w, i)
        x, y, z = la.cross(eb0, eb1, eb2, p0, p1, p2)
        u, v, t = la.centripetal(wb0, wb1, wb2, p0, p1, p2)
        x, y, z = la.times(c, x + u, y + v, z + t)
        a0, a1, a2 = at.three(s, at.P + at.P_A, w, i)
        u, v, t = la.cross(ea0, ea1, ea2, a0, a1, a2)
        g0, g1, g2 = la.centripetal(wa0, wa1, wa2, a0, a1, a2)
        h0, h1, h2 = at.three(s, at.TIDE, w, i)
        x, y, z = h0 + u + g0 - x, h1 + v + g1 - y, h2 + t + g2 - z
        fx, fy, fz = at.three(s, at.AERO, w, i)
        n, m = la.turned(c, at.six(s, at.P + at.N_B, w, i)), at.six(s, at.P + at.N_A, w, i)
        k = per_a + s[(at.P + at.PER_B) * w + i]
        n = (n[0] + m[0] + k, n[1] + m[1], n[2] + m[2], n[3] + m[3] + k, n[4] + m[4], n[5] + m[5] + k)
        fx, fy, fz = la.solved(n, x + fx * per_a, y + fy * per_a, z + fz * per_a)
        at.put(s, at.FORCE, w, i, fx, fy, fz)
        x, y, z = la.back(c, fx, fy, fz)
        x, y, z = la.cross(p0, p1, p2, x, y, z)
        x, y, z = la.symmetric(inverse_b, x, y, z)
        at.put(s, at.RATE + 14, w, i, eb0 + x, eb1 + y, eb2 + z)
        x, y, z = la.cross(a0, a1, a2, fx, fy, fz)
        x, y, z = la.symmetric(inverse_a, x, y, z)
        at.put(s, at.RATE + 17, w, i, ea0 - x, ea1 - y, ea2 - z)


@inlined
def _locked(s, lanes):
    """Angular acceleration of one rigid body, and the moment and force that the lock of the joint carries."""
    w = len(lanes)
    for i in range(w):
        c, mb, share = at.nine(s, at.C_AB, w, i), s[(at.P + at.M_B) * w + i], s[(at.P + at.SHARE_B) * w + i]
        w0, w1, w2 = at.three(s, at.TRIAL + 17, w, i)
        d0, d1, d2 = at.three(s, at.BETWEEN, w, i)
        m, square = mb * share, d0 * d0 + d1 * d1 + d2 * d2
        b, a = la.turned(c, at.six(s, at.P + at.I_B, w, i)), at.six(s, at.P + at.I_A, w, i)
        n = (
            a[0] + b[0] + m * (square - d0 * d0), a[1] + b[1] - m * d0 * d1, a[2] + b[2] - m * d0 * d2,
            a[3] + b[3] + m * (square - d1 * d1), a[4] + b[4] - m * d1 * d2, a[5] + b[5] + m * (square - d2 * d2),
        )  # fmt: skip
        g0, g1, g2 = la.gyroscopic(n, w0, w1, w2)
        f0, f1, f2 = at.three(s, at.AERO, w, i)
        t0, t1, t2 = at.three(s, at.TIDE, w, i)
        # moments about the composite c.g.: aerodynamics (known about the shell's c.g.) and gravity's gradient
        f = s[(at.P + at.SHARE_A) * w + i]
        x, y, z = la.cross(d0, d1, d2, f * f0 - m * t0, f * f1 - m * t1, f * f2 - m * t2)
        u, v, t = at.three(s, at.SHELL, w, i)
        e0, e1, e2 = la.solved(n, u + x - g0, v + y - g1, t + z - g2)
        # the body's c.g. moves with the composite c.g. and turns about it
        x, y, z = la.centripetal(w0, w1, w2, d0, d1, d2)
        u, v, t = la.cross(e0, e1, e2, d0, d1, d2)
        per_mass = s[(at.P + at.PER_MASS) * w + i]
        fx = mb * (share * (t0 + x + u) + f0 * per_mass)
        fy = mb * (share * (t1 + y + v) + f1 * per_mass)
        fz = mb * (share * (t2 + z + t) + f2 * per_mass)
        at.put(s, at.FORCE, w, i, fx, fy, fz)
        # moment on the body about its c.g. that is not the force's at the joint
        g0, g1, g2 = la.gyroscopic(b, w0, w1, w2)
        x, y, z = la.symmetric(b, e0, e1, e2)
        u, v, t = at.three(s, at.ARM_B, w, i)
        u, v, t = la.cross(u, v, t, fx, fy, fz)
        at.put(s, at.MOMENT, w, i, x + g0 - u, y + g1 - v, z + g2 - t)
        x, y, z = la.back(c, e0, e1, e2)
        at.put(s, at.RATE + 14, w, i, x, y, z)
        at.put(s, at.RATE + 17, w, i, e0, e1, e2)
        s[at.THETA * w + i] = la.atan2(math.sqrt(c[6] * c[6] + c[3] * c[3]), c[0])


@inlined
def rates(s, lanes, atmosphere, grid, mach_knots, table, free, planet, locked):
    """Time derivative of the trial state of every lane, and what is recorded."""
    _attitudes(s, lanes)
    air.place(s, lanes, planet)
    air.air(s, lanes, atmosphere, grid)
    air.flow(s, lanes)
    air.look_up(s, lanes, grid, mach_knots, table, free)
    _pull(s, lanes, planet)
    if locked:
        _locked(s, lanes)
    else:
        _joint(s, lanes)
        _hinged(s, lanes)


@inlined
def _record(s, w, record, limit, out, out_aux, written):
    """Write state and record of every lane that still flies, forces and moments in ECI; true while one flies."""
    flying = False
    for i in range(w):
        if written[i] < record:
            continue
        written[i] = record + 1
        for k in range(at.STATES):
            out[i, record, k] = s[(at.Y + k) * w + i]
        for k in range(6):
            out_aux[i, record, k] = s[(at.ALTITUDE + k) * w + i]
        r = at.nine(s, at.R_A, w, i)
        for k in range(3):
            x, y, z = at.three(s, at.FORCE + 3 * k, w, i)
            n = 6 + 3 * k
            out_aux[i, record, n], out_aux[i, record, n + 1], out_aux[i, record, n + 2] = la.times(r, x, y, z)
            out_aux[i, record, 15 + k] = s[(at.RATE + 14 + k) * w + i]
        if s[at.THETA * w + i] < limit:
            flying = True
        else:
            written[i] = -record - 1  # ended here
    return flying


@inlined
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


@inlined
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

"""How do two rigid bodies on a compliant joint move, what do they conserve, and how short must their steps be?

State (20): position and velocity of the composite c.g. (ECI), quaternions ECI from body and ECI from shell, rates of
body and shell (own axes); of a joint that creeps two more, the creep (shell axes y and z). Whether there are any is the
length of the tuple ``creep``, a constant of the compiler: flights without them run through the same instructions as if
there were no such law. ``m_B a_B = F_B + Fc`` and ``m_A a_A = F_A - Fc`` with one acceleration of the joint's point:
the constraint is eliminated, so nothing drifts, and the joint's force ``Fc`` comes from one 3x3 symmetric
positive-definite solve (constraint force equation of a spherical joint), in shell axes, where the shell's inertia, its
arm to the joint and the aerodynamic wrench need no rotation. The readable form that tests compare with is
`tests.oracles.two_body`.

The joint's twist is stiff: tens of hertz, which nobody needs and which alone would bound the step. Where a step is too
long for it, the twist gets an inertia of its own beside those of the two bodies (`_slow_twist`), just large enough for
the step. The deflection by loads that change slowly stays exact, and so do momentum and all other motion; free
vibrations of the twist are slowed.

One flight is a long chain of dependent arithmetic, in which a processor mostly waits. Flights do not depend on each
other, so they fly in lanes: row ``r`` of the workspace ``s`` holds one quantity of every flight, ``s[r * lanes + i]``,
and loops over ``i`` become vector instructions. The number of lanes is the length of the tuple ``lanes``, a constant of
the compiler; one lane is the plain simulator. Loops are short, so that the chains of several lanes overlap; table
look-ups, which do not vectorise, have loops of their own. All rows lie in one array, so that the compiler sees that
none overlap. Branches in vector loops must be arithmetic (a test reads the machine code).

Energy of states ``(..., 20)`` is ``sum(m v^2 + w I w) / 2 + V(theta) + k_t twist^2 / 2 + gravity``, ``V`` the integral
of the joint's moment over the deflection ``theta``; of a joint that creeps over the deflection less the creep, and the
creep's own spring. B is the centerbody (*body*), A the aeroshell (*shell*).

Steps: a free joint's modes obey ``I'' s^2 + C s + K = 0``; a fourth-order Runge-Kutta step h multiplies a mode by
``R(h s)``, ``R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24``, and must not amplify it. Assumed: springs at their stiffness at
rest. A joint much stiffer than its flight needs is better locked. The twist never bounds the step: where it would, it
is given an inertia of its own.

Order of this file: the workspace's rows and access to them; attitudes; atmosphere and aerodynamic wrench; accelerations
of the two bodies; integration; states and invariants; steps.

References
----------
Bose et al., AIAA 2011-2571, section III (constraint force equation).
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from flightmodel import _kernels as la
from flightmodel import earth, rotations
from flightmodel._kernels import inlined, kernel
from flightmodel.checks import ConfigError, FloatArray
from flightmodel.vehicle import Vehicle

# columns of a record: state, what a joint that creeps adds to it, and the auxiliary quantities beside it
STATES, CREEP_STATES, AUX = 20, 2, 18

# parameters of a vehicle: masses of body and shell, 1/m_B, 1/m_A, m_A/m, -m_B/m, 1/m; of the body, then of the shell,
# inertia, its inverse, and -[p] I^-1 [p] of the arm p from c.g. to joint (6 each: xx xy xz yy yz zz); those arms; nose
# from the shell's c.g.; the joint's nine numbers; area, length; factors on C_A, C_N, C_m, shift of C_mq; the delayed
# compliance, rad/(N m), and 1 / its time constant; the joint's quadratic stiffness; the nine of
# `flightmodel.vehicle.AeroTerms`
M_B, M_A, PER_B, PER_A, SHARE_B, SHARE_A, PER_MASS = 0, 1, 2, 3, 4, 5, 6
I_B, W_B, N_B, I_A, W_A, N_A = 7, 13, 19, 25, 31, 37
P_B, P_A, NOSE_A, JOINT, REFERENCE, FACTOR, DELAYED, QUADRATIC, TERMS = 43, 46, 49, 52, 61, 63, 67, 69, 70
PARAMETERS = 79

# rows: state, trial state of a Runge-Kutta stage, its derivative, the next state; in `CREEP` those of the creep
Y, TRIAL, RATE, NEXT = 0, 20, 40, 60
# recorded: altitude, density, Mach, dynamic pressure, shell's total angle of attack, deflection; in shell axes force
# and moment of the joint on the body, and aerodynamic force
ALTITUDE, DENSITY, MACH, PRESSURE, ALPHA, THETA, FORCE, MOMENT, AERO = 80, 81, 82, 83, 84, 85, 86, 89, 92
# ECI from shell, shell from body (matrices), and scalar and x part of the latter's quaternion
R_A, C_AB, TWIST = 95, 104, 113
# in shell axes: body's rate, its arm to the joint, its c.g. from the shell's, gravitation at the shell's c.g. less that
# at the body's, moment on the shell about its c.g. without that of the joint
RATE_B, ARM_B, BETWEEN, GRAVITY_GRADIENT, SHELL = 115, 118, 121, 124, 127
# sine and cosine of latitude, of longitude; sound, north and east wind, free-molecular fraction
SIN, COS, SIN_LON, COS_LON, SOUND, NORTH, EAST, FREE = 130, 131, 132, 133, 134, 135, 136, 137
# C_A C_N C_m C_mq; flow at the nose, shell axes; its size, its lateral part; Mach bracket of the last look-up
COEF, FLOW, SPEED, LATERAL, BRACKET = 138, 142, 145, 146, 147
P = 148
# inertia that is added to the joint's twist, kg m^2: `synthetic_flight.dynamics.added_twist_inertia`
ADDED = P + PARAMETERS
CREEP = ADDED + 1
ROWS = CREEP + 4 * CREEP_STATES


@inlined
def _three(s, row, w, i):
    return s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i]


@inlined
def _six(s, row, w, i):
    return (
        s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i],
        s[(row + 3) * w + i], s[(row + 4) * w + i], s[(row + 5) * w + i],
    )  # fmt: skip


@inlined
def _nine(s, row, w, i):
    return (
        s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i],
        s[(row + 3) * w + i], s[(row + 4) * w + i], s[(row + 5) * w + i],
        s[(row + 6) * w + i], s[(row + 7) * w + i], s[(row + 8) * w + i],
    )  # fmt: skip


@inlined
def _put(s, row, w, i, x, y, z):
    s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i] = x, y, z


@inlined
def _put_nine(s, row, w, i, m):
    _put(s, row, w, i, m[0], m[1], m[2])
    _put(s, row + 3, w, i, m[3], m[4], m[5])
    _put(s, row + 6, w, i, m[6], m[7], m[8])


@inlined
def _attitudes(s, lanes):
    """Rotations, kinematic rates, and the body's rate and arms in shell axes."""
    w = len(lanes)
    for i in range(w):
        t = (TRIAL + 6) * w + i
        b0, b1, b2, b3 = s[t], s[t + w], s[t + 2 * w], s[t + 3 * w]
        a0, a1, a2, a3 = s[t + 4 * w], s[t + 5 * w], s[t + 6 * w], s[t + 7 * w]
        q0, q1 = a0 * b0 + a1 * b1 + a2 * b2 + a3 * b3, a0 * b1 - a1 * b0 - a2 * b3 + a3 * b2
        q2, q3 = a0 * b2 + a1 * b3 - a2 * b0 - a3 * b1, a0 * b3 - a1 * b2 + a2 * b1 - a3 * b0
        s[TWIST * w + i], s[(TWIST + 1) * w + i] = q0, q1
        _put_nine(s, R_A, w, i, la.rotation(a0, a1, a2, a3))
        c = la.rotation(q0, q1, q2, q3)
        _put_nine(s, C_AB, w, i, c)
        wb0, wb1, wb2 = _three(s, TRIAL + 14, w, i)
        x, y, z = la.times(c, wb0, wb1, wb2)
        _put(s, RATE_B, w, i, x, y, z)
        ax, ay, az = _three(s, P + P_A, w, i)
        x, y, z = _three(s, P + P_B, w, i)
        x, y, z = la.times(c, x, y, z)
        _put(s, ARM_B, w, i, x, y, z)
        _put(s, BETWEEN, w, i, ax - x, ay - y, az - z)
        wa0, wa1, wa2 = _three(s, TRIAL + 17, w, i)
        _spin(s, w, i, RATE + 6, b0, b1, b2, b3, wb0, wb1, wb2)
        _spin(s, w, i, RATE + 10, a0, a1, a2, a3, wa0, wa1, wa2)
        x, y, z = _three(s, TRIAL + 3, w, i)
        _put(s, RATE, w, i, x, y, z)


@inlined
def _spin(s, w, i, row, q0, q1, q2, q3, w0, w1, w2):
    t = row * w + i
    s[t], s[t + w] = 0.5 * (-q1 * w0 - q2 * w1 - q3 * w2), 0.5 * (q0 * w0 + q2 * w2 - q3 * w1)
    s[t + 2 * w], s[t + 3 * w] = 0.5 * (q0 * w1 + q3 * w0 - q1 * w2), 0.5 * (q0 * w2 + q1 * w1 - q2 * w0)


@inlined
def _position(s, lanes, planet):
    """Altitude, latitude and longitude of the nose, and velocity of the air there that rotates with the Earth."""
    w = len(lanes)
    for i in range(w):
        r, share = _nine(s, R_A, w, i), s[(P + SHARE_A) * w + i]
        dx, dy, dz = _three(s, BETWEEN, w, i)
        nx, ny, nz = _three(s, P + NOSE_A, w, i)
        dx, dy, dz = la.times(r, nx + share * dx, ny + share * dy, nz + share * dz)
        x, y, z = _three(s, TRIAL, w, i)
        x, y, z = x + dx, y + dy, z + dz
        sin_lat, cos_lat, altitude, per_radius = la.geodetic(x, y, z, planet)
        s[SIN * w + i], s[COS * w + i], s[ALTITUDE * w + i] = sin_lat, cos_lat, altitude
        s[SIN_LON * w + i], s[COS_LON * w + i] = y * per_radius, x * per_radius
        _put(s, FLOW, w, i, -planet[4] * y, planet[4] * x, 0.0)


@inlined
def _four(row):
    return row[0], row[1], row[2], row[3]


@inlined
def _between(a, b, f):
    return a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2]), a[3] + f * (b[3] - a[3])


@inlined
def _air(s, lanes, atmosphere, grid):
    """Air at the nose, between two rows of the table; the first and last rows hold outside of it."""
    w, last = len(lanes), atmosphere.shape[1] - 2
    for i in range(w):
        a = atmosphere[min(i, atmosphere.shape[0] - 1)]
        u = (s[ALTITUDE * w + i] - grid[0]) * grid[1]
        u = u if u > 0.0 else 0.0  # and where it is not a number
        k = int(u) if u < last else last
        f = min(u - k, 1.0)
        # e^x of a small x: a 50 m step of the table changes density by about 1 %
        x = f * a[k, 1]
        s[DENSITY * w + i] = a[k, 0] * (1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0))))
        c = _between(_four(a[k, 2:]), _four(a[k + 1, 2:]), f)
        s[SOUND * w + i], s[NORTH * w + i], s[EAST * w + i], s[FREE * w + i] = c


@inlined
def _flow(s, lanes):
    """Flow at the nose in shell axes, Mach number, dynamic pressure, total angle of attack."""
    w = len(lanes)
    for i in range(w):
        r, share = _nine(s, R_A, w, i), s[(P + SHARE_A) * w + i]
        sin_lat, cos_lat, sl, cl = s[SIN * w + i], s[COS * w + i], s[SIN_LON * w + i], s[COS_LON * w + i]
        north, east = s[NORTH * w + i], s[EAST * w + i]
        vx, vy, vz = _three(s, TRIAL + 3, w, i)
        ex, ey, ez = _three(s, FLOW, w, i)
        vx += north * sin_lat * cl + east * sl - ex
        vy += north * sin_lat * sl - east * cl - ey
        u, v, z = la.back(r, vx, vy, vz - north * cos_lat - ez)
        wb0, wb1, wb2 = _three(s, RATE_B, w, i)
        wa0, wa1, wa2 = _three(s, TRIAL + 17, w, i)
        bx, by, bz = _three(s, ARM_B, w, i)
        ax, ay, az = _three(s, P + P_A, w, i)
        nx, ny, nz = _three(s, P + NOSE_A, w, i)
        sx, sy, sz = la.cross(wb0, wb1, wb2, bx, by, bz)
        tx, ty, tz = la.cross(wa0, wa1, wa2, nx + share * ax, ny + share * ay, nz + share * az)
        u, v, z = u + tx - share * sx, v + ty - share * sy, z + tz - share * sz
        lateral = math.sqrt(v * v + z * z)
        speed = math.sqrt(u * u + v * v + z * z)
        _put(s, FLOW, w, i, u, v, z)
        s[SPEED * w + i], s[LATERAL * w + i], s[ALPHA * w + i] = speed, lateral, la.atan2(lateral, u)
        s[MACH * w + i] = speed / s[SOUND * w + i]
        s[PRESSURE * w + i] = 0.5 * s[DENSITY * w + i] * speed * speed


@inlined
def _coefficients(s, lanes, grid, mach_knots, table, free):
    """C_A, C_N, C_m, C_mq: bilinear, held at the first and last Mach number, bridged to free-molecular ones."""
    w = len(lanes)
    for i in range(w):
        mach = s[MACH * w + i]
        m = int(s[BRACKET * w + i])  # the last bracket found: seldom left
        while m < mach_knots.shape[0] - 2 and mach > mach_knots[m + 1]:
            m += 1
        while m > 0 and mach < mach_knots[m]:
            m -= 1
        s[BRACKET * w + i] = m
        f = min(max((mach - mach_knots[m]) / (mach_knots[m + 1] - mach_knots[m]), 0.0), 1.0)
        u = s[ALPHA * w + i] * grid[2]
        u = u if u > 0.0 else 0.0
        j = min(int(u), table.shape[1] - 2)
        h = u - j
        thin = s[FREE * w + i]
        c = (0.0, 0.0, 0.0, 0.0)
        if thin < 1.0:
            low = _between(_four(table[m, j]), _four(table[m, j + 1]), h)
            c = _between(low, _between(_four(table[m + 1, j]), _four(table[m + 1, j + 1]), h), f)
        if thin > 0.0:
            c = _between(c, _between(_four(free[j]), _four(free[j + 1]), h), thin)
        n = COEF * w + i
        s[n], s[n + w], s[n + 2 * w], s[n + 3 * w] = c


@inlined
def _wrench(s, w, i):
    """Force at the nose on the shell, and y and z of the moment about it; shell axes."""
    _, v, z = _three(s, FLOW, w, i)
    speed, area, length = s[SPEED * w + i], s[(P + REFERENCE) * w + i], s[(P + REFERENCE + 1) * w + i]
    f = (P + FACTOR) * w + i
    n = COEF * w + i
    ca, cn, cm, cmq = s[n] * s[f], s[n + w] * s[f + w], s[n + 2 * w] * s[f + 2 * w], s[n + 3 * w] + s[f + 3 * w]
    per_lateral = 1.0 / (s[LATERAL * w + i] + 1e-12)
    ny, nz = v * per_lateral, z * per_lateral
    qs = s[PRESSURE * w + i] * area
    damping = 0.25 * s[DENSITY * w + i] * speed * area * length * length * cmq  # q S l^2 / (2 V)
    # nose-up about n x x_hat = (0, n_z, -n_y)
    turn = qs * length * cm
    wa1, wa2 = s[(TRIAL + 18) * w + i], s[(TRIAL + 19) * w + i]
    return -qs * ca, -qs * cn * ny, -qs * cn * nz, turn * nz + damping * wa1, damping * wa2 - turn * ny


@inlined
def _terms(s, lanes):
    """Add the `flightmodel.vehicle.AeroTerms` beyond the coefficient table to force and moment on the shell."""
    w = len(lanes)
    for i in range(w):
        _, v, z = _three(s, FLOW, w, i)
        speed, area, length = s[SPEED * w + i], s[(P + REFERENCE) * w + i], s[(P + REFERENCE + 1) * w + i]
        lateral = s[LATERAL * w + i] + 1e-12
        ny, nz = v / lateral, z / lateral
        t, f, n = (P + TERMS) * w + i, (P + FACTOR) * w + i, COEF * w + i
        qs = s[PRESSURE * w + i] * area
        ey, ez = s[(C_AB + 3) * w + i], s[(C_AB + 6) * w + i]
        by_roll = s[t + 7 * w] * math.cos(s[t + 6 * w] * (la.atan2(z, v) - s[t + 8 * w]))
        cn, cm = by_roll * s[n + w] * s[f + w], by_roll * s[n + 2 * w] * s[f + 2 * w]
        fx = -qs * s[t + 3 * w] * (ey * ey + ez * ez)
        fy, fz = -qs * (cn * ny + s[t + 4 * w] * ey), -qs * (cn * nz + s[t + 4 * w] * ez)
        my, mz = cm * ny + s[t + 5 * w] * ey, cm * nz + s[t + 5 * w] * ez
        wa0, wa1, wa2 = _three(s, TRIAL + 17, w, i)
        per_rate = 0.5 * length / (speed + 1e-12)
        coning = s[t + 2 * w] * per_rate * (lateral / (speed + 1e-12)) ** 2 * (wa1 * ny + wa2 * nz)
        x, y, t2 = qs * length * (s[t] + s[t + w] * per_rate * wa0), qs * length * mz, -qs * length * my
        y, t2 = y + qs * length * coning * ny, t2 + qs * length * coning * nz
        a0, a1, a2 = _three(s, P + NOSE_A, w, i)
        c0, c1, c2 = la.cross(a0, a1, a2, fx, fy, fz)
        m, a = SHELL * w + i, AERO * w + i
        s[m], s[m + w], s[m + 2 * w] = s[m] + x + c0, s[m + w] + y + c1, s[m + 2 * w] + t2 + c2
        s[a], s[a + w], s[a + 2 * w] = s[a] + fx, s[a + w] + fy, s[a + 2 * w] + fz
        per_mass = s[(P + PER_MASS) * w + i]
        c0, c1, c2 = la.times(_nine(s, R_A, w, i), fx * per_mass, fy * per_mass, fz * per_mass)
        r = (RATE + 3) * w + i
        s[r], s[r + w], s[r + 2 * w] = s[r] + c0, s[r + w] + c1, s[r + 2 * w] + c2


@inlined
def _loads(s, lanes, planet):
    """Acceleration of the composite c.g. by gravity and aerodynamics, and the loads on the two bodies."""
    w = len(lanes)
    for i in range(w):
        r, per_mass = _nine(s, R_A, w, i), s[(P + PER_MASS) * w + i]
        mb, ma = s[(P + M_B) * w + i], s[(P + M_A) * w + i]
        fb, fa = s[(P + SHARE_B) * w + i], s[(P + SHARE_A) * w + i]
        dx, dy, dz = _three(s, BETWEEN, w, i)
        dx, dy, dz = la.times(r, dx, dy, dz)
        x, y, z = _three(s, TRIAL, w, i)
        g0, g1, g2 = la.gravitation(x + fb * dx, y + fb * dy, z + fb * dz, planet)
        h0, h1, h2 = la.gravitation(x + fa * dx, y + fa * dy, z + fa * dz, planet)
        x, y, z = la.back(r, h0 - g0, h1 - g1, h2 - g2)
        _put(s, GRAVITY_GRADIENT, w, i, x, y, z)
        fx, fy, fz, my, mz = _wrench(s, w, i)
        _put(s, AERO, w, i, fx, fy, fz)
        nx, ny, nz = _three(s, P + NOSE_A, w, i)
        x, y, z = la.cross(nx, ny, nz, fx, fy, fz)
        _put(s, SHELL, w, i, x, y + my, z + mz)
        x, y, z = la.times(r, fx, fy, fz)
        x, y, z = mb * g0 + ma * h0 + x, mb * g1 + ma * h1 + y, mb * g2 + ma * h2 + z
        _put(s, RATE + 3, w, i, x * per_mass, y * per_mass, z * per_mass)


@inlined
def beyond_freeplay(theta, freeplay, half, per_four_half):
    """Deflection beyond the dead band, with a corner that is smooth in slope over +/- ``half``."""
    inside = min(max(theta - freeplay + half, 0.0), 2.0 * half)
    return inside * inside * per_four_half + max(theta - freeplay - half, 0.0)


@inlined
def _spring(s, w, i, d):
    """Moment of the spring at an angle beyond the freeplay."""
    j = (P + JOINT) * w + i
    return d * (s[j] + d * (s[(P + QUADRATIC) * w + i] + s[j + w] * d))


@inlined
def _joint(s, lanes):
    """Moment of the joint on the body, and the deflection.

    Bending potential of the angle between the two x axes, torsion potential of the twist that is left after the
    shortest rotation of one x axis onto the other; both moments are exact gradients, so springs conserve energy at any
    angle.
    """
    w = len(lanes)
    for i in range(w):
        # the body's x axis; the shell's is (1, 0, 0), and their cross product (0, z, -y)
        x, y, z = s[C_AB * w + i], s[(C_AB + 3) * w + i], s[(C_AB + 6) * w + i]
        sine = math.sqrt(y * y + z * z)
        theta = la.atan2(sine, x)
        j = (P + JOINT) * w + i
        d = beyond_freeplay(theta, s[j + 6 * w], s[j + 7 * w], s[j + 8 * w])
        k = _spring(s, w, i, d) / (sine + 1e-300)
        twist = 2.0 * la.atan2(s[(TWIST + 1) * w + i], s[TWIST * w + i])
        twist -= 2.0 * math.pi * ((1.0 if twist > math.pi else 0.0) - (1.0 if twist < -math.pi else 0.0))
        b0, b1, b2 = _three(s, RATE_B, w, i)
        a0, a1, a2 = _three(s, TRIAL + 17, w, i)
        w0, w1, w2, damp = b0 - a0, b1 - a1, b2 - a2, s[j + 3 * w] + s[j + 4 * w] * theta * theta
        along = 0.5 * (w0 * (1.0 + x) + w1 * y + w2 * z)
        t = -(s[j + 2 * w] * twist + (s[j + 5 * w] - damp) * along) / (1.0 + x)
        s[THETA * w + i] = theta
        _put(s, MOMENT, w, i, t * (1.0 + x) - damp * w0, k * z + t * y - damp * w1, t * z - k * y - damp * w2)


@inlined
def _creep(s, lanes):
    """Replace the joint's moment without creep by that with creep, and compute the creep's rate.

    Spring and a Kelvin element in series: of the deflection ``e`` (shell axes y and z of the body's x axis, as long as
    the angle) the spring feels ``e - b``, and ``b' = (k F - b) / tau`` with the spring's force ``F`` and the delayed
    compliance ``k``. The potential of ``e - b`` has a slope across the plane of ``e``, too; the moment is its gradient.
    """
    w = len(lanes)
    for i in range(w):
        x, y, z = s[C_AB * w + i], s[(C_AB + 3) * w + i], s[(C_AB + 6) * w + i]
        per_sine, theta = 1.0 / (math.sqrt(y * y + z * z) + 1e-300), s[THETA * w + i]
        u, v = y * per_sine, z * per_sine
        t = (CREEP + CREEP_STATES) * w + i
        p, q = theta * u - s[t], theta * v - s[t + w]
        size = math.sqrt(p * p + q * q)
        j, k = (P + JOINT) * w + i, (P + DELAYED) * w + i
        d = beyond_freeplay(theta, s[j + 6 * w], s[j + 7 * w], s[j + 8 * w])
        without = _spring(s, w, i, d)
        d = beyond_freeplay(size, s[j + 6 * w], s[j + 7 * w], s[j + 8 * w])
        per_size = _spring(s, w, i, d) / (size + 1e-300)
        p, q = p * per_size, q * per_size
        along, across = p * u + q * v - without, (p * v - q * u) * theta * per_sine
        m = MOMENT * w + i
        s[m] += across * y * u + across * z * v
        s[m + w] += along * v - across * x * u
        s[m + 2 * w] -= along * u + across * x * v
        r = t + CREEP_STATES * w
        s[r], s[r + w] = s[k + w] * (s[k] * p - s[t]), s[k + w] * (s[k] * q - s[t + w])


@inlined
def _joined(s, lanes):
    """Angular accelerations of both bodies with the joint's force from the constraint force equation."""
    w = len(lanes)
    for i in range(w):
        c, per_a = _nine(s, C_AB, w, i), s[(P + PER_A) * w + i]
        wb0, wb1, wb2 = _three(s, TRIAL + 14, w, i)
        wa0, wa1, wa2 = _three(s, TRIAL + 17, w, i)
        inverse_b, inverse_a = _six(s, P + W_B, w, i), _six(s, P + W_A, w, i)
        g0, g1, g2 = la.gyroscopic(_six(s, P + I_B, w, i), wb0, wb1, wb2)
        h0, h1, h2 = la.gyroscopic(_six(s, P + I_A, w, i), wa0, wa1, wa2)
        jx, jy, jz = _three(s, MOMENT, w, i)
        x, y, z = la.back(c, jx, jy, jz)
        eb0, eb1, eb2 = la.symmetric(inverse_b, x - g0, y - g1, z - g2)
        x, y, z = _three(s, SHELL, w, i)
        ea0, ea1, ea2 = la.symmetric(inverse_a, x - jx - h0, y - jy - h1, z - jz - h2)
        # relative acceleration of the two joint points without the joint's force
        p0, p1, p2 = _three(s, P + P_B, w, i)
        x, y, z = la.cross(eb0, eb1, eb2, p0, p1, p2)
        u, v, t = la.centripetal(wb0, wb1, wb2, p0, p1, p2)
        x, y, z = la.times(c, x + u, y + v, z + t)
        a0, a1, a2 = _three(s, P + P_A, w, i)
        u, v, t = la.cross(ea0, ea1, ea2, a0, a1, a2)
        g0, g1, g2 = la.centripetal(wa0, wa1, wa2, a0, a1, a2)
        h0, h1, h2 = _three(s, GRAVITY_GRADIENT, w, i)
        x, y, z = h0 + u + g0 - x, h1 + v + g1 - y, h2 + t + g2 - z
        fx, fy, fz = _three(s, AERO, w, i)
        n, m = la.turned(c, _six(s, P + N_B, w, i)), _six(s, P + N_A, w, i)
        k = per_a + s[(P + PER_B) * w + i]
        n = (n[0] + m[0] + k, n[1] + m[1], n[2] + m[2], n[3] + m[3] + k, n[4] + m[4], n[5] + m[5] + k)
        fx, fy, fz = la.solved(n, x + fx * per_a, y + fy * per_a, z + fz * per_a)
        _put(s, FORCE, w, i, fx, fy, fz)
        x, y, z = la.back(c, fx, fy, fz)
        x, y, z = la.cross(p0, p1, p2, x, y, z)
        x, y, z = la.symmetric(inverse_b, x, y, z)
        _put(s, RATE + 14, w, i, eb0 + x, eb1 + y, eb2 + z)
        x, y, z = la.cross(a0, a1, a2, fx, fy, fz)
        x, y, z = la.symmetric(inverse_a, x, y, z)
        _put(s, RATE + 17, w, i, ea0 - x, ea1 - y, ea2 - z)


@inlined
def _slow_twist(s, lanes):
    """Correct accelerations and the joint's force and moment for the inertia added to the twist.

    The twist changes at ``p' = w n / (1 + x)``, with ``w`` the body's rate less the shell's, ``x y z`` the body's x
    axis (shell axes) and ``n = (1 + x, y, z)``; the torsion ``T n / (1 + x)`` does the work ``T p'``. An inertia of the
    twist alone adds the torsion ``-I p''``; as accelerations are linear in it, one solution for a torsion of one
    newton metre gives how much.
    """
    w = len(lanes)
    for i in range(w):
        c = _nine(s, C_AB, w, i)
        x, y, z = c[0], c[3], c[6]
        per = 1.0 / (1.0 + x)
        b0, b1, b2 = _three(s, RATE_B, w, i)
        a0, a1, a2 = _three(s, TRIAL + 17, w, i)
        r0, r1, r2 = b0 - a0, b1 - a1, b2 - a2
        u, v, t = la.times(c, s[(RATE + 14) * w + i], s[(RATE + 15) * w + i], s[(RATE + 16) * w + i])
        d0, d1, d2 = la.cross(r0, r1, r2, a0, a1, a2)  # of the body's rate, seen from the shell
        e0, e1, e2 = _three(s, RATE + 17, w, i)
        u, v, t = u + d0 - e0, v + d1 - e1, t + d2 - e2
        n0, n1, n2 = la.cross(r0, r1, r2, x, y, z)
        rate = (r0 * (1.0 + x) + r1 * y + r2 * z) * per
        turn = (u * (1.0 + x) + v * y + t * z + r0 * n0 + r1 * n1 + r2 * n2 - rate * n0) * per
        # a torsion of one: of the bodies held apart, then with the force that keeps their joint together
        m1, m2 = y * per, z * per
        p0, p1, p2 = _three(s, P + P_B, w, i)
        q0, q1, q2 = _three(s, P + P_A, w, i)
        inverse_b, inverse_a = _six(s, P + W_B, w, i), _six(s, P + W_A, w, i)
        u, v, t = la.back(c, 1.0, m1, m2)
        b0, b1, b2 = la.symmetric(inverse_b, u, v, t)
        a0, a1, a2 = la.symmetric(inverse_a, -1.0, -m1, -m2)
        u, v, t = la.cross(b0, b1, b2, p0, p1, p2)
        u, v, t = la.times(c, u, v, t)
        d0, d1, d2 = la.cross(a0, a1, a2, q0, q1, q2)
        n, m = la.turned(c, _six(s, P + N_B, w, i)), _six(s, P + N_A, w, i)
        k = s[(P + PER_A) * w + i] + s[(P + PER_B) * w + i]
        n = (n[0] + m[0] + k, n[1] + m[1], n[2] + m[2], n[3] + m[3] + k, n[4] + m[4], n[5] + m[5] + k)
        f0, f1, f2 = la.solved(n, d0 - u, d1 - v, d2 - t)
        u, v, t = la.back(c, f0, f1, f2)
        u, v, t = la.cross(p0, p1, p2, u, v, t)
        u, v, t = la.symmetric(inverse_b, u, v, t)
        b0, b1, b2 = b0 + u, b1 + v, b2 + t
        u, v, t = la.cross(q0, q1, q2, f0, f1, f2)
        u, v, t = la.symmetric(inverse_a, u, v, t)
        a0, a1, a2 = a0 - u, a1 - v, a2 - t
        u, v, t = la.times(c, b0, b1, b2)
        added = s[ADDED * w + i]
        yielding = u - a0 + (v - a1) * m1 + (t - a2) * m2
        share = -added * turn / (1.0 + added * yielding)
        for row, e in ((RATE + 14, (b0, b1, b2)), (RATE + 17, (a0, a1, a2)), (FORCE, (f0, f1, f2)),
                       (MOMENT, (1.0, m1, m2))):  # fmt: skip
            g0, g1, g2 = _three(s, row, w, i)
            _put(s, row, w, i, g0 + share * e[0], g1 + share * e[1], g2 + share * e[2])


@inlined
def _rigid(s, lanes):
    """Angular acceleration of one rigid body, and the moment and force that the lock of the joint carries."""
    w = len(lanes)
    for i in range(w):
        c, mb, share = _nine(s, C_AB, w, i), s[(P + M_B) * w + i], s[(P + SHARE_B) * w + i]
        w0, w1, w2 = _three(s, TRIAL + 17, w, i)
        d0, d1, d2 = _three(s, BETWEEN, w, i)
        m, square = mb * share, d0 * d0 + d1 * d1 + d2 * d2
        b, a = la.turned(c, _six(s, P + I_B, w, i)), _six(s, P + I_A, w, i)
        n = (
            a[0] + b[0] + m * (square - d0 * d0), a[1] + b[1] - m * d0 * d1, a[2] + b[2] - m * d0 * d2,
            a[3] + b[3] + m * (square - d1 * d1), a[4] + b[4] - m * d1 * d2, a[5] + b[5] + m * (square - d2 * d2),
        )  # fmt: skip
        g0, g1, g2 = la.gyroscopic(n, w0, w1, w2)
        f0, f1, f2 = _three(s, AERO, w, i)
        t0, t1, t2 = _three(s, GRAVITY_GRADIENT, w, i)
        # moments about the composite c.g.: aerodynamics (given about the shell's c.g.) and gravity gradient
        f = s[(P + SHARE_A) * w + i]
        x, y, z = la.cross(d0, d1, d2, f * f0 - m * t0, f * f1 - m * t1, f * f2 - m * t2)
        u, v, t = _three(s, SHELL, w, i)
        e0, e1, e2 = la.solved(n, u + x - g0, v + y - g1, t + z - g2)
        # the body's c.g. moves with the composite c.g. and rotates about it
        x, y, z = la.centripetal(w0, w1, w2, d0, d1, d2)
        u, v, t = la.cross(e0, e1, e2, d0, d1, d2)
        per_mass = s[(P + PER_MASS) * w + i]
        fx = mb * (share * (t0 + x + u) + f0 * per_mass)
        fy = mb * (share * (t1 + y + v) + f1 * per_mass)
        fz = mb * (share * (t2 + z + t) + f2 * per_mass)
        _put(s, FORCE, w, i, fx, fy, fz)
        # moment on the body about its c.g. that is not the force's at the joint
        g0, g1, g2 = la.gyroscopic(b, w0, w1, w2)
        x, y, z = la.symmetric(b, e0, e1, e2)
        u, v, t = _three(s, ARM_B, w, i)
        u, v, t = la.cross(u, v, t, fx, fy, fz)
        _put(s, MOMENT, w, i, x + g0 - u, y + g1 - v, z + g2 - t)
        x, y, z = la.back(c, e0, e1, e2)
        _put(s, RATE + 14, w, i, x, y, z)
        _put(s, RATE + 17, w, i, e0, e1, e2)
        s[THETA * w + i] = la.atan2(math.sqrt(c[6] * c[6] + c[3] * c[3]), c[0])


@inlined
def rates(s, lanes, creep, terms, atmosphere, grid, mach_knots, table, free, planet, locked, slowed):
    """Time derivative of every lane's trial state, and the recorded auxiliary quantities.

    Whether ``terms`` is empty is a constant of the compiler, as for ``creep``.
    """
    _attitudes(s, lanes)
    _position(s, lanes, planet)
    _air(s, lanes, atmosphere, grid)
    _flow(s, lanes)
    _coefficients(s, lanes, grid, mach_knots, table, free)
    _loads(s, lanes, planet)
    if len(terms) > 0:
        _terms(s, lanes)
    if locked:
        _rigid(s, lanes)
    else:
        _joint(s, lanes)
        if len(creep) > 0:
            _creep(s, lanes)
        _joined(s, lanes)
        if slowed:
            _slow_twist(s, lanes)


@inlined
def _record(s, w, creep, record, limit, out, out_aux, written):
    """Write state and record of every lane that still flies, forces and moments in ECI; true while any flies."""
    flying = False
    for i in range(w):
        if written[i] < record:
            continue
        written[i] = record + 1
        for k in range(STATES):
            out[i, record, k] = s[(Y + k) * w + i]
        for k in range(len(creep)):
            out[i, record, STATES + k] = s[(CREEP + k) * w + i]
        for k in range(6):
            out_aux[i, record, k] = s[(ALTITUDE + k) * w + i]
        r = _nine(s, R_A, w, i)
        for k in range(3):
            x, y, z = _three(s, FORCE + 3 * k, w, i)
            n = 6 + 3 * k
            out_aux[i, record, n], out_aux[i, record, n + 1], out_aux[i, record, n + 2] = la.times(r, x, y, z)
            out_aux[i, record, 15 + k] = s[(RATE + 14 + k) * w + i]
        if s[THETA * w + i] < limit:
            flying = True
        else:
            written[i] = -record - 1  # ended here
    return flying


@inlined
def _advance(s, w, stage, step):
    """After a stage of RK4: add to the next state, and set the next trial state."""
    ahead = step * (1.0 if stage == 2 else 0.5)
    if stage == 0:
        for k in range(STATES * w):
            s[NEXT * w + k] = s[Y * w + k] + step / 6.0 * s[RATE * w + k]
    else:
        for k in range(STATES * w):
            s[NEXT * w + k] += step / 3.0 * s[RATE * w + k]
    for k in range(STATES * w):
        s[TRIAL * w + k] = s[Y * w + k] + ahead * s[RATE * w + k]


@inlined
def _advance_creep(s, w, creep, stage, step):
    """`_advance` of the creep states; one shared function with rows as arguments would slow ensembles by a quarter."""
    n, ahead, share = len(creep) * w, step * (1.0 if stage == 2 else 0.5), step / (6.0 if stage == 0 else 3.0)
    for k in range(CREEP * w, CREEP * w + n):
        s[k + 3 * n] = (s[k] if stage == 0 else s[k + 3 * n]) + share * s[k + 2 * n]
        s[k + n] = s[k] + ahead * s[k + 2 * n]


@inlined
def _finish_creep(s, w, creep, step):
    """`_finish` of the creep."""
    n = len(creep) * w
    for k in range(CREEP * w, CREEP * w + n):
        s[k] = s[k + 3 * n] + step / 6.0 * s[k + 2 * n]
        s[k + n] = s[k]


@inlined
def _finish(s, w, step):
    """Finish an RK4 step: new state with unit quaternions, and the trial state set equal to it."""
    for k in range(STATES * w):
        s[Y * w + k] = s[NEXT * w + k] + step / 6.0 * s[RATE * w + k]
    for row in (Y + 6, Y + 10):
        for i in range(w):
            j = row * w + i
            a, b, c, d = s[j], s[j + w], s[j + 2 * w], s[j + 3 * w]
            n = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
            s[j], s[j + w], s[j + 2 * w], s[j + 3 * w] = a * n, b * n, c * n, d * n
    for k in range(STATES * w):
        s[TRIAL * w + k] = s[Y * w + k]


@kernel
def integrate(
    lanes, creep, terms, s, tables, planet, step, per_record, records, lock_records, limit, out, out_aux, written
):
    """Fly ``records - 1`` intervals of ``per_record`` RK4 steps; joint locked for the first ``lock_records`` intervals.

    ``written`` becomes the number of records of every lane, negative where the flight ended because the deflection
    passed ``limit`` or was not a number any more.
    """
    w = len(lanes)
    slowed = False  # by one for all lanes: an added inertia of zero changes nothing
    for i in range(w):
        slowed = slowed or s[ADDED * w + i] > 0.0
    for k in range(STATES * w):
        s[TRIAL * w + k] = s[Y * w + k]
    for k in range(len(creep) * w):
        s[(CREEP + CREEP_STATES) * w + k] = s[CREEP * w + k]
    for record in range(records):
        locked = record < lock_records
        for sub in range(per_record):
            for stage in range(4):
                air, grid, knots, table, free = tables
                rates(s, lanes, creep, terms, air, grid, knots, table, free, planet, locked, slowed)
                if stage + sub == 0:
                    flying = _record(s, w, creep, record, limit, out, out_aux, written)
                    if record == records - 1 or not flying:
                        return
                if stage < 3:
                    _advance(s, w, stage, step)
                    if len(creep) > 0:
                        _advance_creep(s, w, creep, stage, step)
            _finish(s, w, step)
            if len(creep) > 0:
                _finish_creep(s, w, creep, step)


def split(state: FloatArray) -> tuple[FloatArray, ...]:
    """Position, velocity (ECI), q_eci_body, q_eci_shell, omega_body, omega_shell of states ``(..., 20 or 22)``."""
    return (
        state[..., 0:3],
        state[..., 3:6],
        state[..., 6:10],
        state[..., 10:14],
        state[..., 14:17],
        state[..., 17:20],
    )


def offsets(state: FloatArray, vehicle: Vehicle) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Position and velocity, ECI axes ``(..., 3)``, of c.g.s, joint and nose *relative to the composite c.g.*."""
    _, _, q_b, q_a, w_b, w_a = split(state)
    body, shell = vehicle.centerbody, vehicle.aeroshell
    shape = (*state.shape[:-1], 3)
    rate_b, rate_a = rotations.rotate(q_b, w_b), rotations.rotate(q_a, w_a)
    arm_b = rotations.rotate(q_b, np.broadcast_to(body.cg_m - vehicle.joint_m, shape))
    arm_a = rotations.rotate(q_a, np.broadcast_to(shell.cg_m - vehicle.joint_m, shape))
    nose = rotations.rotate(q_a, np.broadcast_to(-vehicle.joint_m, shape))
    swing_b, swing_a = np.cross(rate_b, arm_b), np.cross(rate_a, arm_a)
    joint = -(body.mass_kg * arm_b + shell.mass_kg * arm_a) / vehicle.mass_kg
    joint_v = -(body.mass_kg * swing_b + shell.mass_kg * swing_a) / vehicle.mass_kg
    return {
        "body": (joint + arm_b, joint_v + swing_b),
        "shell": (joint + arm_a, joint_v + swing_a),
        "joint": (joint, joint_v),
        "nose": (joint + nose, joint_v + np.cross(rate_a, nose)),
    }


def points(state: FloatArray, vehicle: Vehicle) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Position and velocity (ECI, ``(..., 3)``) of the c.g.s of body and shell, the joint and the shell's nose."""
    r, v = state[..., 0:3], state[..., 3:6]
    return {name: (r + dr, v + dv) for name, (dr, dv) in offsets(state, vehicle).items()}


def deflection_angle(q_eci_body: FloatArray, q_eci_shell: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deflection, rad, and the shell's nose direction in body axes ``(..., 3)``, of quaternions ``(..., 4)``."""
    nose = rotations.rotate(
        rotations.multiply(rotations.conjugate(q_eci_body), q_eci_shell),
        np.broadcast_to(np.array([1.0, 0.0, 0.0]), (*q_eci_body.shape[:-1], 3)),
    )
    return np.arctan2(np.hypot(nose[..., 1], nose[..., 2]), nose[..., 0]), nose


def twist(q_eci_body: FloatArray, q_eci_shell: FloatArray) -> FloatArray:
    """Twist of body against shell about x, rad, beyond the shortest rotation that aligns both x axes."""
    q = rotations.multiply(rotations.conjugate(q_eci_shell), q_eci_body)
    angle = 2.0 * np.arctan2(q[..., 1], q[..., 0])
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def angle_beyond_freeplay(theta_rad: FloatArray, freeplay_rad: float, corner: float) -> FloatArray:
    """Deflection beyond the dead band; within ``corner * freeplay`` of its edge a parabola joins the two slopes."""
    half = corner * freeplay_rad
    parabola = (theta_rad - freeplay_rad + half) ** 2 / (4.0 * half) if half > 0.0 else np.zeros_like(theta_rad)
    outside = np.where(theta_rad >= freeplay_rad + half, theta_rad - freeplay_rad, parabola)
    return np.where(theta_rad <= freeplay_rad - half, 0.0, outside)


def spring_deflection(state: FloatArray) -> FloatArray:
    """Deflection that the joint's spring feels, rad ``(..., 2)``: of the body's x axis, shell axes y and z, less creep.

    As long as the angle: coordinates of the body's x axis on the sphere about the shell's.
    """
    _, _, q_b, q_a, _, _ = split(state)
    theta, _ = deflection_angle(q_b, q_a)
    x_axis = rotations.rotate(
        rotations.multiply(rotations.conjugate(q_a), q_b),
        np.broadcast_to(np.array([1.0, 0.0, 0.0]), (*theta.shape, 3)),
    )
    lateral = x_axis[..., 1:] * (theta / np.maximum(np.hypot(x_axis[..., 1], x_axis[..., 2]), 1e-300))[..., None]
    return np.asarray(lateral - state[..., 20:22] if state.shape[-1] > 20 else lateral)


def _spring_energy(vehicle: Vehicle, state: FloatArray) -> FloatArray:
    """Energy in the joint's springs, J: the integral of its moment over the angle, freeplay and all orders included."""
    joint = vehicle.joint
    theta = (
        np.linalg.norm(spring_deflection(state), axis=-1)
        if state.shape[-1] > 20
        else deflection_angle(state[..., 6:10], state[..., 10:14])[0]
    )
    node, weight = np.polynomial.legendre.leggauss(64)
    freeplay = np.deg2rad(joint.freeplay_deg)
    # the moment is smooth on each side of the corner: integrate piecewise
    edges = np.array([0.0, freeplay * (1 - joint.freeplay_corner), freeplay * (1 + joint.freeplay_corner), np.inf])
    energy = np.zeros_like(theta)
    for low, high in pairwise(edges):
        a, b = np.minimum(low, theta), np.minimum(high, theta)
        x = a[..., None] + 0.5 * (b - a)[..., None] * (node + 1.0)
        d = angle_beyond_freeplay(x, freeplay, joint.freeplay_corner)
        moment = joint.bending_stiffness_nmprad * d + joint.quadratic_nmprad2 * d**2 + joint.hardening_nmprad3 * d**3
        energy = energy + 0.5 * (b - a) * np.sum(weight * moment, axis=-1)
    if joint.creep_share > 0.0 and state.shape[-1] > 20:
        energy = energy + 0.5 * np.sum(state[..., 20:22] ** 2, axis=-1) / joint.delayed_compliance_radpnm
    return energy + 0.5 * joint.torsion_stiffness_nmprad * twist(state[..., 6:10], state[..., 10:14]) ** 2


def internal_energy(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Energy of springs and of motion about the composite c.g., J, of states ``(..., 20)``."""
    *_, w_b, w_a = split(state)
    about = offsets(state, vehicle)
    total = _spring_energy(vehicle, state)
    for part, name, w in ((vehicle.centerbody, "body", w_b), (vehicle.aeroshell, "shell", w_a)):
        v = about[name][1]
        total = total + 0.5 * part.mass_kg * np.sum(v * v, axis=-1)
        total = total + 0.5 * np.einsum("...i,ij,...j->...", w, part.inertia, w)
    return total


def energy(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Kinetic, gravitational and spring energy, J, of states ``(..., 20)``."""
    v = state[..., 3:6]
    where = points(state, vehicle)
    total = internal_energy(state, vehicle) + 0.5 * vehicle.mass_kg * np.sum(v * v, axis=-1)
    for part, name in ((vehicle.centerbody, "body"), (vehicle.aeroshell, "shell")):
        total = total - part.mass_kg * earth.potential(where[name][0])
    return total


def angular_momentum(state: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Angular momentum of both bodies about the composite c.g., ECI axes, ``(..., 3)``, kg m^2/s."""
    _, _, q_b, q_a, w_b, w_a = split(state)
    about = offsets(state, vehicle)
    total = np.zeros((*state.shape[:-1], 3))
    for part, name, q, w in ((vehicle.centerbody, "body", q_b, w_b), (vehicle.aeroshell, "shell", q_a, w_a)):
        r, v = about[name]
        total = total + part.mass_kg * np.cross(r, v)
        total = total + rotations.rotate(q, np.einsum("ij,...j->...i", part.inertia, w))
    return total


# step times the size of a mode's fastest root: below this all damped modes are stable
SURELY_STABLE = 2.0


def joint_modes(vehicle: Vehicle) -> dict[str, tuple[float, float, float]]:
    """Effective inertia kg m^2, damping N m s/rad, stiffness N m/rad of bending and torsion of the free vehicle.

    The inertia of bending is that of the two bodies recoiling about their joint, with c.g.s taken on the axis.
    """
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    inertia = vehicle.transverse_inertia_about_joint()
    unbalance = [part.mass_kg * (part.cg_m[0] - vehicle.joint_m[0]) for part in (shell, body)]
    mass = np.diag(inertia) - np.outer(unbalance, unbalance) / vehicle.mass_kg
    apart = np.array([1.0, -1.0])
    bending = 1.0 / float(apart @ np.linalg.solve(mass, apart))
    torsion = 1.0 / float(1.0 / shell.inertia[0, 0] + 1.0 / body.inertia[0, 0])
    return {
        "bending": (bending, joint.bending_damping_nmsprad, joint.bending_stiffness_nmprad),
        "torsion": (torsion, joint.torsion_damping_nmsprad, joint.torsion_stiffness_nmprad),
    }


def added_twist_inertia(inertia: FloatArray, damping: FloatArray, stiffness: FloatArray, step_s: float) -> FloatArray:
    """Smallest added inertia, kg m^2, that brings the twist's roots within 2 / step; zero if they already are.

    The roots of ``I s^2 + C s + K`` lie within a circle of radius s where ``I s^2 >= K`` and ``I s^2 - C s + K >= 0``.
    """
    circle = SURELY_STABLE / step_s
    needed = np.maximum(stiffness, damping * circle - stiffness) / circle**2
    return np.asarray(np.maximum(needed - inertia, 0.0))


def largest_step_s(inertia: float, damping: float, stiffness: float) -> float:
    """Longest stable step of one mode, s; infinite without spring and damper."""
    roots = np.roots([inertia, damping, stiffness]).astype(complex)
    fastest = float(np.abs(roots).max())
    if fastest == 0.0:
        return np.inf
    # stability on the imaginary axis ends at 2.828, on the real axis at 2.785
    steps = np.linspace(SURELY_STABLE, 3.0, 2001) / fastest
    amplified = np.array([np.abs(_growth(roots * step)).max() > 1.0 + 1e-9 for step in steps])
    return float(steps[np.argmax(amplified)]) if amplified.any() else float(steps[-1])


def _growth(z: FloatArray) -> FloatArray:
    return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))


# in a step: fourth-order steps then err by 2e-4 of a joint's frequency and damp it by 2e-4 of the critical damping
RESOLVED_PHASE_RAD = 0.4


def resolving_step_s(vehicle: Vehicle) -> float:
    """Longest step that resolves the joint's bending oscillation, s."""
    inertia, _, stiffness = joint_modes(vehicle)["bending"]
    return float(RESOLVED_PHASE_RAD * np.sqrt(inertia / stiffness))


def check_resolved(vehicle: Vehicle, step_s: float) -> None:
    """Raise `ConfigError`, with the longest valid step, if the step does not resolve the joint's oscillation."""
    inertia, _, stiffness = joint_modes(vehicle)["bending"]
    longest = resolving_step_s(vehicle)
    if step_s > longest:
        raise ConfigError(
            f"step of {1e3 * step_s:.3g} ms is too long for a bending mode of "
            f"{np.sqrt(stiffness / inertia) / (2.0 * np.pi):.1f} Hz: at most {1e3 * longest:.2g} ms resolves it",
            code="step-too-long",
        )


def check_step(vehicle: Vehicle, step_s: float) -> None:
    """Raise `ConfigError`, with the longest valid step, if the joint's bending is unstable at this step.

    A step too long for the twist is not refused: `added_twist_inertia`.
    """
    inertia, damping, stiffness = joint_modes(vehicle)["bending"]
    fastest = float(np.abs(np.roots([inertia, damping, stiffness])).max(initial=0.0))
    if step_s * fastest > SURELY_STABLE and step_s > (longest := largest_step_s(inertia, damping, stiffness)):
        frequency = np.sqrt(stiffness / inertia) / (2.0 * np.pi)
        raise ConfigError(
            f"step of {1e3 * step_s:g} ms is too long for the joint's bending mode at {frequency:.1f} Hz: at most "
            f"{1e3 * longest:.2g} ms is stable (better a tenth of it); shorten time.step_s, or soften the joint",
            code="step-too-long",
        )
    # under a deflection that is held the creep settles faster than under a load that is
    settles_s = vehicle.joint.creep_time_s * (1.0 - vehicle.joint.creep_share)
    if vehicle.joint.creep_share > 0.0 and step_s > SURELY_STABLE * settles_s:
        raise ConfigError(
            f"step of {1e3 * step_s:g} ms is too long for the joint's creep, which settles in {1e3 * settles_s:g} ms: "
            "shorten time.step_s",
            code="step-too-long",
        )

"""The workspace of the flight kernels: which row holds what, and how three, six or nine rows are read as one.

Row ``r`` holds one quantity of every lane, ``s[r * lanes + i]``.
"""

from __future__ import annotations

from flightmodel._kernels import inlined

# of a flight: state, and what is recorded beside it
STATES, AUX = 20, 18

# parameters of a vehicle: masses of body and shell, 1/m_B, 1/m_A, m_A/m, -m_B/m, 1/m; of the body, then of the shell,
# inertia, its inverse, and -[p] I^-1 [p] of the arm p from c.g. to joint (6 each: xx xy xz yy yz zz); those arms; nose
# from the shell's c.g.; the joint's nine numbers; area, length; factors on C_A, C_N, C_m, shift of C_mq
M_B, M_A, PER_B, PER_A, SHARE_B, SHARE_A, PER_MASS = 0, 1, 2, 3, 4, 5, 6
I_B, W_B, N_B, I_A, W_A, N_A = 7, 13, 19, 25, 31, 37
P_B, P_A, NOSE_A, JOINT, REFERENCE, FACTOR = 43, 46, 49, 52, 61, 63
PARAMETERS = 67

# rows: state, trial state of a Runge-Kutta stage, its derivative, the next state
Y, TRIAL, RATE, NEXT = 0, 20, 40, 60
# what is recorded: altitude, density, Mach, dynamic pressure, shell's total angle of attack, bending angle; in shell
# axes force and moment of the joint on the body and aerodynamic force
ALTITUDE, DENSITY, MACH, PRESSURE, ALPHA, THETA, FORCE, MOMENT, AERO = 80, 81, 82, 83, 84, 85, 86, 89, 92
# ECI from shell, shell from body (matrices), and scalar and x part of the latter's quaternion
R_A, C_AB, TWIST = 95, 104, 113
# in shell axes: body's rate, its arm to the joint, its c.g. from the shell's, gravitation at the shell's c.g. less that
# at the body's, moment on the shell about its c.g. without the joint's
RATE_B, ARM_B, BETWEEN, TIDE, SHELL = 115, 118, 121, 124, 127
# sine and cosine of latitude, of longitude; sound, north and east wind, free-molecular fraction
SIN, COS, SIN_LON, COS_LON, SOUND, NORTH, EAST, FREE = 130, 131, 132, 133, 134, 135, 136, 137
# C_A C_N C_m C_mq; flow at the nose, shell axes; its size, its lateral part; Mach bracket of the last look-up
COEF, FLOW, SPEED, LATERAL, BRACKET = 138, 142, 145, 146, 147
P = 148
ROWS = P + PARAMETERS


@inlined
def three(s, row, w, i):
    return s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i]


@inlined
def six(s, row, w, i):
    return (
        s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i],
        s[(row + 3) * w + i], s[(row + 4) * w + i], s[(row + 5) * w + i],
    )  # fmt: skip


@inlined
def nine(s, row, w, i):
    return (
        s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i],
        s[(row + 3) * w + i], s[(row + 4) * w + i], s[(row + 5) * w + i],
        s[(row + 6) * w + i], s[(row + 7) * w + i], s[(row + 8) * w + i],
    )  # fmt: skip


@inlined
def put(s, row, w, i, x, y, z):
    s[row * w + i], s[(row + 1) * w + i], s[(row + 2) * w + i] = x, y, z


@inlined
def put_nine(s, row, w, i, m):
    put(s, row, w, i, m[0], m[1], m[2])
    put(s, row + 3, w, i, m[3], m[4], m[5])
    put(s, row + 6, w, i, m[6], m[7], m[8])

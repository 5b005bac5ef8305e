"""Which forces and moments does the motion that the centerbody's sensors measured require of a deflected vehicle?

Momentum and angular momentum of two rigid bodies that turn against each other about the joint, exact in the deflection
and in the rates. Body axes are the centerbody's; ``R(theta)`` turns shell axes into them, with ``rho`` the shell's c.g.
from the joint and ``w``, ``w'`` the measured rate and angular acceleration. Measured is the specific force ``f`` at a
point of the centerbody; the vehicle's c.g. lies ``d(theta)`` from it and moves::

    F = m (f + d'' + 2 w x d' + w' x d + w x (w x d))                                        aerodynamic force
    M = H' + w x H,   H = I_B w + R I_A R^T (w + phi) + mu r x (r' + w x r)                  about the c.g.

with ``phi`` the shell's rate against the body, ``r`` from the centerbody's c.g. to the shell's, ``mu = m_A m_B / m``.
Centrifugal, Coriolis and gyroscopic terms are all in these. Both must be those of the air, which acts on the shell
alone, at its nose, in shell axes::

    F = -q S (C_A x + C_N n),   M_nose = q S l (C_m n x x + C_mq l/(2V) w_A,transverse)

``n`` is the unit vector of the nose's lateral velocity in the air and ``w_A`` the shell's own rate. What is left of the
two balances are the residuals of the estimators: the force's *direction* (`force_residual`; neither mass nor dynamic
pressure enters but through the motion), its *size* along the shell's axis as a logarithm (`axial_residual`) and the
transverse *moment*, over ``q S C_A``, as a shift of the c.g. (`moment_residual`).

They are compiled, one sample after another: a vehicle comes as one row of numbers, motion and flow as columns. Time
derivatives are differences over `STEP_S` of what the deflection's derivatives make of a step. The readable form that
tests compare with is `tests.oracles.plain_balance`.

Assumed: rigid bodies, no twist, no air on the centerbody, no difference of gravitation within the vehicle.

References
----------
P. C. Hughes, "Spacecraft Attitude Dynamics", 1986, chapter 3 (two bodies on a spherical joint).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimators.loads import FlightLoads
from flightmodel import _kernels as la
from flightmodel._kernels import inlined, kernel
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle

STEP_S = 1e-4  # of rates of some rad/s it leaves 1e-8 of truncation and 1e-9 of rounding
# where in a vehicle's row: joint, shell's c.g. from it, centerbody's c.g., vehicle's c.g., point of the loads (three
# numbers each), shell's share of the mass, reduced mass, inertias of shell and centerbody (xx xy xz yy yz zz),
# reference length and area, the nine of `flightmodel.vehicle.AeroTerms`
_JOINT, _ARM, _BODY_CG, _CG, _POINT = 0, 3, 6, 9, 12
VEHICLE_NUMBERS = 40
_SHARE, _REDUCED, _SHELL, _BODY, _LENGTH, _AREA, _TERMS = 15, 16, 17, 23, 29, 30, 31


@dataclass(frozen=True)
class Swing:
    """Deflection as a lateral vector, rad, and its first and second derivative by time; (n, 2) each."""

    theta_yz_rad: FloatArray
    rate_yz_radps: FloatArray
    acceleration_yz_radps2: FloatArray

    @classmethod
    def held(cls, theta_yz_rad: FloatArray) -> Swing:
        """Constant deflection, with zero rate and acceleration."""
        still = np.zeros_like(theta_yz_rad)
        return cls(theta_yz_rad, still, still)

    @classmethod
    def of(cls, deflection: Callable[[FloatArray, int], FloatArray], time_s: FloatArray) -> Swing:
        """Deflection at times, from a function of times and the order of the derivative."""
        return cls(*(deflection(time_s, order) for order in range(3)))

    @cached_property
    def orders(self) -> FloatArray:
        """Deflection, rate and acceleration, (3, n, 2)."""
        return np.stack([self.theta_yz_rad, self.rate_yz_radps, self.acceleration_yz_radps2])

    def moved(self, theta: FloatArray, rate: FloatArray, acceleration: FloatArray) -> Swing:
        """Deflection, rate and acceleration moved by so much."""
        return Swing(self.theta_yz_rad + theta, self.rate_yz_radps + rate, self.acceleration_yz_radps2 + acceleration)


@inlined
def _vector(values, at):
    return values[at], values[at + 1], values[at + 2]


@inlined
def _inertia(v, at):
    return v[at], v[at + 1], v[at + 2], v[at + 3], v[at + 4], v[at + 5]


@inlined
def _axes(ty, tz):
    """Matrix that turns shell components into the body's: rotation by (0, -tz, ty)."""
    square = 0.25 * (ty * ty + tz * tz)
    half = math.sqrt(square)
    s = 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0 - square / 6.0)
    return la.rotation(math.cos(half), 0.0, -s * tz, s * ty)


@inlined
def _relative_rate(ty, tz, ry, rz):
    """Rate of the shell against the body, body axes: the rotation vector's left Jacobian times its rate."""
    square = ty * ty + tz * tz
    angle = math.sqrt(square)
    # by series where a difference would be rounding
    small = angle < 1e-2
    half = 0.5 * angle
    safe = 1.0 if small else angle
    s = 1.0 - square / 24.0 if small else math.sin(half) / (0.5 * safe)
    third = 1.0 / 6.0 - square / 120.0 if small else (safe - math.sin(safe)) / (safe * safe * safe)
    a = la.cross(0.0, -tz, ty, 0.0, -rz, ry)
    b = la.cross(0.0, -tz, ty, a[0], a[1], a[2])
    k = 0.5 * s * s
    return k * a[0] + third * b[0], -rz + k * a[1] + third * b[1], ry + k * a[2] + third * b[2]


@inlined
def _at_step(k, state):
    """Deflection and rate (four numbers) a step ``k`` later, of deflection, rate and acceleration (six)."""
    s = k * STEP_S
    ty, tz, ry, rz, ay, az = state
    return ty + s * ry + 0.5 * s * s * ay, tz + s * rz + 0.5 * s * s * az, ry + s * ay, rz + s * az


@inlined
def _cg(v, ty, tz):
    """Vehicle's c.g. from the point of the loads."""
    a = _vector(v, _ARM)
    m = la.times(_axes(ty, tz), a[0], a[1], a[2])
    share = v[_SHARE]
    return (
        v[_CG] - v[_POINT] + share * (m[0] - a[0]),
        v[_CG + 1] - v[_POINT + 1] + share * (m[1] - a[1]),
        v[_CG + 2] - v[_POINT + 2] + share * (m[2] - a[2]),
    )


@inlined
def _specific_force(v, state, f, w, turning):
    """Specific force at the moving c.g., body axes, m/s^2."""
    early, late = _at_step(-1.0, state), _at_step(1.0, state)
    before, now, after = _cg(v, early[0], early[1]), _cg(v, state[0], state[1]), _cg(v, late[0], late[1])
    h, h2 = 1.0 / STEP_S, 1.0 / (STEP_S * STEP_S)
    coriolis = la.cross(
        w[0], w[1], w[2], h * (after[0] - before[0]), h * (after[1] - before[1]), h * (after[2] - before[2])
    )
    euler = la.cross(turning[0], turning[1], turning[2], now[0], now[1], now[2])
    pulled = la.centripetal(w[0], w[1], w[2], now[0], now[1], now[2])
    return (
        f[0] + h2 * (after[0] - 2.0 * now[0] + before[0]) + coriolis[0] + euler[0] + pulled[0],
        f[1] + h2 * (after[1] - 2.0 * now[1] + before[1]) + coriolis[1] + euler[1] + pulled[1],
        f[2] + h2 * (after[2] - 2.0 * now[2] + before[2]) + coriolis[2] + euler[2] + pulled[2],
    )


@inlined
def _nose_flow(v, state, turn, w, airspeed, flow_y, flow_z):
    """Direction (unit y, z) and size, rad, of the flow's lateral angle at the shell's nose, shell axes."""
    alpha = math.sqrt(flow_y * flow_y + flow_z * flow_z)
    side = math.sin(alpha) / alpha if alpha > 0.0 else 0.0
    p = _relative_rate(state[0], state[1], state[2], state[3])
    arm = la.times(turn, -v[_JOINT], -v[_JOINT + 1], -v[_JOINT + 2])
    a = la.cross(
        w[0], w[1], w[2],
        v[_JOINT] + arm[0] - v[_POINT], v[_JOINT + 1] + arm[1] - v[_POINT + 1], v[_JOINT + 2] + arm[2] - v[_POINT + 2],
    )  # fmt: skip
    b = la.cross(p[0], p[1], p[2], arm[0], arm[1], arm[2])
    u = la.back(
        turn,
        airspeed * math.cos(alpha) + a[0] + b[0],
        airspeed * side * flow_y + a[1] + b[1],
        airspeed * side * flow_z + a[2] + b[2],
    )
    lateral = math.hypot(u[1], u[2])
    per = 1.0 / lateral if lateral > 0.0 else 0.0
    return u[1] * per, u[2] * per, math.atan2(lateral, u[0])


@inlined
def _coefficients(mach, alpha, knots, table):
    """C_A, C_N, C_m, C_mq: bilinear in Mach and uniform angles from 0 to pi, held at the first and last Mach number."""
    if not (alpha >= 0.0 and mach >= 0.0):  # of what is no number
        return math.nan, math.nan, math.nan, math.nan
    low, high = 0, len(knots) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if mach < knots[middle]:
            high = middle
        else:
            low = middle
    f = min(max((mach - knots[low]) / (knots[high] - knots[low]), 0.0), 1.0) if high > low else 0.0
    u = alpha * ((table.shape[1] - 1) / math.pi)
    j = min(int(u), table.shape[1] - 2)
    g = min(u - j, 1.0)
    a, b = (1.0 - f) * (1.0 - g), (1.0 - f) * g
    c, d = f * (1.0 - g), f * g
    p, q, r, s = table[low, j], table[low, j + 1], table[high, j], table[high, j + 1]
    return (
        a * p[0] + b * q[0] + c * r[0] + d * s[0], a * p[1] + b * q[1] + c * r[1] + d * s[1],
        a * p[2] + b * q[2] + c * r[2] + d * s[2], a * p[3] + b * q[3] + c * r[3] + d * s[3],
    )  # fmt: skip


@inlined
def _air(v, turn, y, z, c):
    """C_A, lateral force (y, z) and lateral flow of the moment (y, z), over ``q S``, of the coefficients ``c``.

    ``turn`` has the body's x axis in shell axes as its first row.
    """
    by_roll = 1.0
    if v[_TERMS + 7] != 0.0:
        by_roll += v[_TERMS + 7] * math.cos(v[_TERMS + 6] * (math.atan2(z, y) - v[_TERMS + 8]))
    ey, ez = turn[1], turn[2]
    normal, moment, cn, cm = by_roll * c[1], by_roll * c[2], v[_TERMS + 4], v[_TERMS + 5]
    axial = c[0] + v[_TERMS + 3] * (ey * ey + ez * ez)
    return axial, normal * y + cn * ey, normal * z + cn * ez, moment * y + cm * ey, moment * z + cm * ez


@inlined
def _state(swing, i):
    return swing[0, i, 0], swing[0, i, 1], swing[1, i, 0], swing[1, i, 1], swing[2, i, 0], swing[2, i, 1]


@inlined
def _force_and_flow(v, swing, i, force, rate, turning, flow, airspeed):
    """Axes of the shell, specific force along them and flow at its nose (y, z, total angle) at one time."""
    state, w = _state(swing, i), _vector(rate[i], 0)
    turn = _axes(state[0], state[1])
    f = _specific_force(v, state, _vector(force[i], 0), w, _vector(turning[i], 0))
    y, z, alpha = _nose_flow(v, state, turn, w, airspeed[i], flow[i, 0], flow[i, 1])
    return turn, la.back(turn, f[0], f[1], f[2]), y, z, alpha


@kernel
def force_left(v, swing, force, rate, turning, flow, mach, airspeed, knots, table, out):
    """Tilt of the force against the shell less the air's, shell y, z, rad, into ``out`` (n, 2).

    ``swing`` (3, n, 2) holds deflection, rate and acceleration; ``force``, ``rate``, ``turning`` (n, 3), ``flow``
    (n, 2), ``mach`` and ``airspeed`` (n,) the loads; ``knots`` (m,) and ``table`` (m, a, 4) the coefficients.
    """
    for i in range(len(out)):
        turn, f, y, z, alpha = _force_and_flow(v, swing, i, force, rate, turning, flow, airspeed)
        axial, ny, nz, _, _ = _air(v, turn, y, z, _coefficients(mach[i], alpha, knots, table))
        lateral = math.hypot(f[1], f[2])
        tilt = math.atan2(lateral, -f[0]) / lateral if lateral > 0.0 else 0.0
        # a force that points to where the flow comes from has a negative coefficient
        size = math.hypot(ny, nz)
        air = math.atan2(size, axial) / size if size > 0.0 else 0.0
        out[i, 0] = -tilt * f[1] - ny * air
        out[i, 1] = -tilt * f[2] - nz * air


def force_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Tilt of the force against the shell less the air's, ``atan(C_N/C_A)`` on the flow's side; shell y, z (n, 2), rad.

    Parameters
    ----------
    vehicle : Vehicle
        In place of the loads' own.
    swing : Swing
    loads : FlightLoads
    """
    out, motion = np.empty(swing.theta_yz_rad.shape), _motion(loads)
    force = np.ascontiguousarray(loads.specific_force_body_mps2)
    force_left(_numbers(vehicle, loads), swing.orders, force, *motion, *_table(vehicle), out)
    return out


@kernel
def axial_left(v, swing, force, rate, turning, flow, mach, airspeed, knots, table, out):
    """Logarithm of the specific force along the shell's axis over C_A, into ``out`` (n, 1); see above."""
    for i in range(len(out)):
        turn, f, y, z, alpha = _force_and_flow(v, swing, i, force, rate, turning, flow, airspeed)
        ratio = -f[0] / _air(v, turn, y, z, _coefficients(mach[i], alpha, knots, table))[0]
        out[i, 0] = math.log(ratio) if ratio > 0.0 else math.nan


def axial_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Logarithm of the force along the shell's axis over the air's ``q S C_A`` (n, 1); NaN where it points forward.

    Parameters as of `force_residual`.
    """
    out, motion = np.empty((len(loads.time_s), 1)), _motion(loads)
    force = np.ascontiguousarray(loads.specific_force_body_mps2)
    axial_left(_numbers(vehicle, loads), swing.orders, force, *motion, *_table(vehicle), out)
    mass_per_force = vehicle.mass_kg / (loads.dynamic_pressure_pa * vehicle.reference.area_m2)
    return out + np.log(mass_per_force)[:, None]


@inlined
def _momentum(v, moved, w0, w1, w2):
    """Angular momentum about the vehicle's c.g., body axes."""
    turn = _axes(moved[0], moved[1])
    p = _relative_rate(moved[0], moved[1], moved[2], moved[3])
    arm = la.times(turn, v[_ARM], v[_ARM + 1], v[_ARM + 2])
    x, y, z = (
        v[_JOINT] + arm[0] - v[_BODY_CG],
        v[_JOINT + 1] + arm[1] - v[_BODY_CG + 1],
        v[_JOINT + 2] + arm[2] - v[_BODY_CG + 2],
    )
    a, b = la.cross(p[0], p[1], p[2], arm[0], arm[1], arm[2]), la.cross(w0, w1, w2, x, y, z)
    apart = la.cross(x, y, z, a[0] + b[0], a[1] + b[1], a[2] + b[2])
    own = la.back(turn, w0 + p[0], w1 + p[1], w2 + p[2])
    own = la.symmetric(_inertia(v, _SHELL), own[0], own[1], own[2])
    own = la.times(turn, own[0], own[1], own[2])
    body = la.symmetric(_inertia(v, _BODY), w0, w1, w2)
    mu = v[_REDUCED]
    return body[0] + own[0] + mu * apart[0], body[1] + own[1] + mu * apart[1], body[2] + own[2] + mu * apart[2]


@inlined
def _moment(v, state, w, turning):
    """Moment about the c.g. that the motion needs, body axes, N m."""
    s = STEP_S
    before = _momentum(v, _at_step(-1.0, state), w[0] - s * turning[0], w[1] - s * turning[1], w[2] - s * turning[2])
    after = _momentum(v, _at_step(1.0, state), w[0] + s * turning[0], w[1] + s * turning[1], w[2] + s * turning[2])
    now = _momentum(v, _at_step(0.0, state), w[0], w[1], w[2])
    gyro = la.cross(w[0], w[1], w[2], now[0], now[1], now[2])
    k = 0.5 / s
    return (
        k * (after[0] - before[0]) + gyro[0], k * (after[1] - before[1]) + gyro[1], k * (after[2] - before[2]) + gyro[2]
    )  # fmt: skip


@kernel
def moment_left(v, swing, pressure, rate, turning, flow, mach, airspeed, knots, table, out):
    """Aerodynamic minus required transverse moment over ``q S C_A``, as a c.g. shift, body y, z, m; see above."""
    for i in range(len(out)):
        state, w = _state(swing, i), _vector(rate[i], 0)
        turn = _axes(state[0], state[1])
        y, z, alpha = _nose_flow(v, state, turn, w, airspeed[i], flow[i, 0], flow[i, 1])
        c = _coefficients(mach[i], alpha, knots, table)
        axial, ny, nz, my, mz = _air(v, turn, y, z, c)
        length, p = v[_LENGTH], _relative_rate(state[0], state[1], state[2], state[3])
        own = la.back(turn, w[0] + p[0], w[1] + p[1], w[2] + p[2])
        damping = c[3] * length / (2.0 * airspeed[i])
        coning = v[_TERMS + 2] * length / (2.0 * airspeed[i]) * math.sin(alpha) ** 2 * (own[1] * y + own[2] * z)
        # (0, y, z) x x_hat = (0, z, -y)
        about = la.times(
            turn,
            0.0,
            length * (mz + damping * own[1] + coning * y),
            length * (-my + damping * own[2] + coning * z),
        )
        force = la.times(turn, -axial, -ny, -nz)
        nose = la.times(turn, -v[_JOINT], -v[_JOINT + 1], -v[_JOINT + 2])
        cg = _cg(v, state[0], state[1])
        lever = la.cross(
            v[_JOINT] + nose[0] - v[_POINT] - cg[0],
            v[_JOINT + 1] + nose[1] - v[_POINT + 1] - cg[1],
            v[_JOINT + 2] + nose[2] - v[_POINT + 2] - cg[2],
            force[0], force[1], force[2],
        )  # fmt: skip
        needed = _moment(v, state, w, _vector(turning[i], 0))
        per = 1.0 / (pressure[i] * v[_AREA])
        # a lateral shift d of the c.g. against the axial force has the moment d x x_hat = (0, d_z, -d_y)
        out[i, 0] = -(about[2] + lever[2] - per * needed[2]) / axial
        out[i, 1] = (about[1] + lever[1] - per * needed[1]) / axial


def moment_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Aerodynamic minus required transverse moment over ``q S C_A``, as a c.g. shift; body y, z (n, 2), m.

    Parameters as of `force_residual`.
    """
    out, motion = np.empty(swing.theta_yz_rad.shape), _motion(loads)
    pressure = np.ascontiguousarray(loads.dynamic_pressure_pa)
    moment_left(_numbers(vehicle, loads), swing.orders, pressure, *motion, *_table(vehicle), out)
    return out


def _motion(loads: FlightLoads) -> tuple[FloatArray, ...]:
    """Rates, their derivatives, flow, Mach numbers and airspeeds in the one layout that kernels are compiled for."""
    rate, turning = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    columns = rate, turning, loads.flow_yz_rad, loads.mach, loads.airspeed_mps
    return tuple(np.ascontiguousarray(column, dtype=np.float64) for column in columns)


def _table(vehicle: Vehicle) -> tuple[FloatArray, FloatArray]:
    return np.ascontiguousarray(vehicle.aero.mach), np.ascontiguousarray(vehicle.aero.coefficients)


def _numbers(vehicle: Vehicle, loads: FlightLoads) -> FloatArray:
    """Parameters of a vehicle in the kernels' layout."""
    shell, body = vehicle.aeroshell, vehicle.centerbody
    upper = np.triu_indices(3)
    return np.concatenate(
        [
            vehicle.joint_m,
            shell.cg_m - vehicle.joint_m,
            body.cg_m,
            vehicle.cg_m,
            loads.point_from_datum_m,
            [shell.mass_kg / vehicle.mass_kg, shell.mass_kg * body.mass_kg / vehicle.mass_kg],
            shell.inertia[upper],
            body.inertia[upper],
            [vehicle.reference.length_m, vehicle.reference.area_m2],
            vehicle.aero_terms.numbers,
        ]
    )

"""What propagates a state in time? Inertial sensors (strapdown mechanisation), or a ballistic model of drag in the air.

Both drive the nine kinematic errors (position, velocity, rotation) through a few *drivers*, errors that the motion
depends on: with inertial sensors their bias, scale and mount, 18 in all, and the errors of their clocks, 2, where such
are stated; in ballistic flight drag, side forces, density and winds, 6 in all, and rotation is held fixed. So one
filter serves both. Compiled kernels carry a state; readable twins: `tests.oracles.strapdown` and
`tests.oracles.ballistic`.

**Strapdown**, Earth-fixed axes, for the point where the accelerometer sits:

    dr/dt = v,   dv/dt = C f + g(r) - W x (W x r) - 2 W x v,   dC/dt = C [w x] - [W x] C

with C from body to ECEF, W the Earth's rate, f and w the corrected specific force and inertial rate in body axes. A
sensor measures ``(1 + s) * (R(m)^T D^T x) + b``: D is the nominal mounting (sensor to body), m the mounting
rotation in sensor axes, s the scale errors and b the biases, so ``x = D R(m) ((measured - b) / (1 + s))``. Where
its clock may err, by tau (a late tag is positive), ``measured`` is what it reads at the tag tau later, by its rate of
change: good for some ten milliseconds where a vehicle oscillates twice a second.

Steps are mid-point steps between samples: mean of the two samples, attitude at mid-step, and the coning ``dt/12 w x
dw`` and sculling ``dt/12 (w x df - dw x f)`` corrections of rates and forces that are linear in time within a step.
White noise of density N (unit^2/Hz) drives velocity and rotation. The gravity gradient in the transition is the central
one (J2 changes it by 0.2 %, which moves a 100 m error by 0.2 mm in a second).
Error columns, 27 in all: position, velocity, rotation, then bias, scale and mount of the accelerometer, then of the
gyros; and two more, their clocks, where these may err.

Mechanisation joins samples by straight lines. `with_exact_integrals` moves them so that the lines have the integral of
the curve, to fourth order,

    x_k <- x_k - (x_{k+1} - 2 x_k + x_{k-1}) / 12

else the error of the joins would be as large as the coning and sculling that are corrected for.

**Ballistic.** With ``u`` the velocity against the air and ``B`` the drag area per mass,

    dv/dt = g(r) - W x (W x r) - 2 W x v + rho |u| B e^d / 2 (-u + |u| (s1 n1 + s2 n2)),   rho = rho0(h) e^(c0 sd(h))

with ``n1`` and ``n2`` normal to the flow, ``n1`` as near as can be to the horizontal normal of the path's plane, ``n2``
in that plane. (Horizontal and vertical axes would spin where a parachute sinks straight down.) The six drivers
``d, s1, s2, c0, cN, cE`` are errors of the filter: drag and side forces are Gauss-Markov in time, density and the
winds' ``c sd(h)`` in altitude. Thrust or an opening parachute in stated spans is white noise of acceleration.
Steps are fourth-order Runge-Kutta steps, the transition is ``1 + M dt + M^2 dt^2 / 2`` of the partials half way; a step
in which the air would change the velocity by more than a fifth is taken in parts. Attitude takes no part.

References
----------
D. Titterton, J. Weston, "Strapdown Inertial Navigation Technology", 2nd ed., chapters 3, 11 and 12.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flightmodel import rotations
from flightmodel._kernels import GM, RATE, boxplus, dcm_from_quaternion, geodetic, gravitation, inlined, kernel
from flightmodel.atmosphere import bottom_m, profile_from_sounding
from flightmodel.checks import FloatArray, IntArray
from flightmodel.earth import WGS84, Planet
from flightmodel.telemetry import Motion as MotionSpec
from flightmodel.telemetry import Sounding
from flightmodel.trajectory import interpolate_rows
from recon.imu_screening import BridgedSensor
from recon.state import States

SAME_INSTANT_S = 2e-6
GRID_STEP_S = 0.05  # in ballistic flight
AIR_FROM_M, AIR_STEP_M = -500.0, 100.0
_CORRELATION_S = 1.0  # a stated disturbance, or a thrust that may be anything, keeps its value for about so long
# a filter far from its track may ask for a drag that stops the vehicle within a step: such a step is taken in parts.
# Drag falls with the speed it takes, so their number grows as the logarithm of the drag
MOST_CHANGE = 0.2  # of the velocity in a part: the transition's second order then errs by 1e-2 of itself
MOST_PARTS = 64  # backwards in time drag grows without bound


class Motion(NamedTuple):
    """Time grid that contains every node, and the inputs of the motion, in the form kernels take for either model.

    Parameters
    ----------
    ballistic : bool
        Whether there are no inertial sensors.
    time_s : (k,) float
    force_sensor_mps2, rate_sensor_radps : (k, 3) float
        As measured, in sensor axes, gaps bridged, `with_exact_integrals`; zeros in ballistic flight.
    force_density, rate_density : (k, 3) float
        White-noise densities, (m/s^2)^2/Hz and (rad/s)^2/Hz, from a grid point to the next: along body axes, in
        ballistic flight along Earth-fixed axes.
    dcm_body_force, dcm_body_rate : (3, 3) float
        Nominal mountings.
    clocks : bool
        Whether the clocks of accelerometer and gyros may err.
    air : (a, 5) float
        Logarithm of density, wind north and east, sd of density's logarithm, sd of wind, at equally spaced altitudes.
    air_from_m, air_step_m : float
        Their first altitude and spacing.
    drag_m2pkg : float
        A priori drag area per mass.
    across_ecef : (3,) float
        Normal of the path's plane, for the axes of side forces.
    planet : Planet
    """

    ballistic: bool
    time_s: FloatArray
    force_sensor_mps2: FloatArray
    rate_sensor_radps: FloatArray
    force_density: FloatArray
    rate_density: FloatArray
    dcm_body_force: FloatArray
    dcm_body_rate: FloatArray
    clocks: bool
    air: FloatArray
    air_from_m: float
    air_step_m: float
    drag_m2pkg: float
    across_ecef: FloatArray
    planet: Planet = WGS84

    @property
    def drivers(self) -> int:
        """Number of errors that the motion depends on."""
        return 6 if self.ballistic else 18 + 2 * self.clocks

    def air_at(self, height_m: FloatArray) -> FloatArray:
        """Columns of ``air``, (5, n), at heights (n,)."""
        row, grid = (height_m - self.air_from_m) / self.air_step_m, np.arange(len(self.air))
        return np.array([np.interp(row, grid, column) for column in self.air.T])


def strapdown_motion(
    time_s: FloatArray,
    force_sensor_mps2: FloatArray,
    rate_sensor_radps: FloatArray,
    force_density: FloatArray,
    rate_density: FloatArray,
    dcm_body_force: FloatArray,
    dcm_body_rate: FloatArray,
    clocks: bool = False,
) -> Motion:
    """Motion propagated by inertial sensors."""
    # numba compiles anew for every other memory layout
    return Motion(
        ballistic=False,
        time_s=np.ascontiguousarray(time_s, dtype=float),
        force_sensor_mps2=np.ascontiguousarray(force_sensor_mps2, dtype=float),
        rate_sensor_radps=np.ascontiguousarray(rate_sensor_radps, dtype=float),
        force_density=np.ascontiguousarray(force_density, dtype=float),
        rate_density=np.ascontiguousarray(rate_density, dtype=float),
        dcm_body_force=np.ascontiguousarray(dcm_body_force, dtype=float),
        dcm_body_rate=np.ascontiguousarray(dcm_body_rate, dtype=float),
        clocks=clocks,
        air=np.zeros((2, 5)),
        air_from_m=0.0,
        air_step_m=1.0,
        drag_m2pkg=0.0,
        across_ecef=np.zeros(3),
    )


def with_exact_integrals(time_s: FloatArray, samples: FloatArray) -> FloatArray:
    """Samples (n, 3) whose straight joins have the integral of the curve: less a twelfth of the second difference.

    Where steps are uneven by a twentieth, at gaps and ends, samples stay as they are. White noise keeps its integral.
    """
    out = samples.copy()
    step = np.diff(time_s)
    even = np.abs(np.diff(step)) < 0.05 * step[1:]
    second_difference = samples[2:] - 2.0 * samples[1:-1] + samples[:-2]
    out[1:-1][even] -= second_difference[even] / 12.0
    return out


def inertial_motion(
    force: BridgedSensor,
    rate: BridgedSensor,
    node_time_s: FloatArray,
    clocks: bool = False,
    planet: Planet = WGS84,
) -> tuple[Motion, IntArray]:
    """Both sensors from first to last node, on the faster one's times and the nodes', and each node's index."""
    first, last = node_time_s[0], node_time_s[-1]
    finer = rate if np.median(np.diff(rate.time_s)) < 0.9 * np.median(np.diff(force.time_s)) else force
    inner = finer.time_s[(finer.time_s > first) & (finer.time_s < last)]
    t = _with_nodes(inner, node_time_s)
    motion = strapdown_motion(
        t,
        interpolate_rows(t, force.time_s, with_exact_integrals(force.time_s, force.measured_sensor)),
        interpolate_rows(t, rate.time_s, with_exact_integrals(rate.time_s, rate.measured_sensor)),
        _held(t, force),
        _held(t, rate),
        force.spec.dcm_body_sensor,
        rate.spec.dcm_body_sensor,
        clocks,
    )
    return motion._replace(planet=planet), np.searchsorted(t, node_time_s).astype(np.int64)


def decimated(motion: Motion, node_index: IntArray, step_s: float) -> tuple[Motion, IntArray]:
    """Inertial sensors' motion on its nodes (n,) and at steps between, with the same integrals; each node's index.

    Parameters
    ----------
    step_s : float
        Of the new grid; coning within it is lost.
    """
    from scipy.integrate import cumulative_trapezoid  # a tenth of a second, for long flights alone

    nodes = motion.time_s[node_index]
    t = _with_nodes(np.arange(nodes[0], nodes[-1], step_s), nodes)
    if len(t) >= len(motion.time_s):
        return motion, node_index
    # means between the middles of steps, of which the straight joins have the integral
    ends = np.concatenate([t[:1], 0.5 * (t[1:] + t[:-1]), t[-1:]])

    def means(samples: FloatArray) -> FloatArray:
        total = cumulative_trapezoid(samples, motion.time_s, axis=0, initial=0.0)
        return np.diff(interpolate_rows(ends, motion.time_s, total), axis=0) / np.diff(ends)[:, None]

    held = np.searchsorted(motion.time_s, t + SAME_INSTANT_S, side="right") - 1
    coarse = motion._replace(
        time_s=t,
        force_sensor_mps2=means(motion.force_sensor_mps2),
        rate_sensor_radps=means(motion.rate_sensor_radps),
        force_density=motion.force_density[held],
        rate_density=motion.rate_density[held],
    )
    return coarse, np.searchsorted(t, nodes).astype(np.int64)


def _with_nodes(between: FloatArray, node_time_s: FloatArray) -> FloatArray:
    """Nodes and the times between that are at no node's instant, in order."""
    near = np.clip(np.searchsorted(node_time_s, between), 1, len(node_time_s) - 1)
    away = np.minimum(np.abs(between - node_time_s[near - 1]), np.abs(between - node_time_s[near]))
    return np.sort(np.concatenate([between[away > SAME_INSTANT_S], node_time_s]))


def _held(at: FloatArray, sensor: BridgedSensor) -> FloatArray:
    """Density of the interval that each grid point opens."""
    k = np.clip(np.searchsorted(sensor.time_s, at + SAME_INSTANT_S, side="right") - 1, 0, len(sensor.time_s) - 1)
    return np.ascontiguousarray(sensor.density[k])


def air_table(sounding: Sounding) -> FloatArray:
    """Rows of `Motion.air` on the fixed altitudes above."""
    altitude = np.arange(air_from_m(sounding.planet), 900e3, AIR_STEP_M)
    air = profile_from_sounding(sounding).at(altitude)
    wind = air.wind_ned_mps
    return np.column_stack([np.log(air.density_kgpm3), wind[:, 0], wind[:, 1], air.density_sd, air.wind_sd_mps])


def air_from_m(planet: Planet) -> float:
    """Lowest altitude of `air_table`, m."""
    return AIR_FROM_M if planet == WGS84 else bottom_m(planet)


def ballistic_motion(
    spec: MotionSpec, sounding: Sounding, across_ecef: FloatArray, node_time_s: FloatArray
) -> tuple[Motion, IntArray]:
    """Motion on the nodes and steps of `GRID_STEP_S` between, and each node's index."""
    first, last = node_time_s[0], node_time_s[-1]
    steps = np.arange(first, last, GRID_STEP_S)
    t = _with_nodes(steps, node_time_s)
    density = np.full((len(t), 3), spec.acceleration_density**2)
    for start, end in spec.powered_s:
        density[(t >= start) & (t < end)] += spec.powered_sd_mps2**2 * _CORRELATION_S
    still = np.zeros((len(t), 3))
    motion = Motion(
        True, t, still, still, density, still, np.eye(3), np.eye(3), False, air_table(sounding),
        air_from_m(sounding.planet), AIR_STEP_M, spec.drag_area_per_mass_m2pkg, across_ecef, sounding.planet,
    )  # fmt: skip
    return motion, np.searchsorted(t, node_time_s).astype(np.int64)


def with_disturbances(motion: Motion, spec: MotionSpec) -> Motion:
    """Motion with process noise added to accelerations and rates in the spans of ``[[motion.disturbed]]``.

    Causes are vibration that rectifies to a bias, a saturated gyro, or thrust.
    """
    force, rate = motion.force_density.copy(), motion.rate_density.copy()
    for d in spec.disturbed:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        force[inside] += d.sd_mps2**2 * _CORRELATION_S
        if not motion.ballistic:  # which has no rotation
            rate[inside] += d.sd_radps**2 * _CORRELATION_S
    return motion._replace(force_density=force, rate_density=rate)


def correct(measured_sensor: FloatArray, errors: FloatArray, dcm_body_sensor: FloatArray) -> FloatArray:
    """True quantity in body axes ``(n, 3)`` from measured ``(n, 3)`` and bias, scale, mount ``(9,)`` or ``(n, 9)``."""
    actual = (measured_sensor - errors[..., 0:3]) / (1.0 + errors[..., 3:6])
    return rotations.rotate(rotations.exp(errors[..., 6:9]), actual) @ dcm_body_sensor.T


def correction_partials(measured_sensor: FloatArray, errors: FloatArray, dcm_body_sensor: FloatArray) -> FloatArray:
    """Partials ``(..., 3, 9)`` of `correct` with respect to bias, scale and mount."""
    mount = errors[..., 6:9]
    gain = 1.0 / (1.0 + errors[..., 3:6])
    actual = (measured_sensor - errors[..., 0:3]) * gain
    body_actual = dcm_body_sensor @ rotations.dcm_from_q(rotations.exp(mount))
    d_bias = -body_actual * gain[..., None, :]
    d_scale = d_bias * actual[..., None, :]
    value = np.einsum("...ij,...j->...i", body_actual, actual)
    d_mount = -rotations.skew(value) @ (dcm_body_sensor @ (np.eye(3) + 0.5 * rotations.skew(mount)))
    return np.concatenate([d_bias, d_scale, d_mount], axis=-1)


@inlined
def turn_ecef(q, angle):
    """Turn the ECEF side of ``q`` (4,) in place by ``-angle`` rad about the Earth's axis."""
    c = math.cos(0.5 * angle)
    s = -math.sin(0.5 * angle)
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] = c * w - s * z
    q[1] = c * x - s * y
    q[2] = c * y + s * x
    q[3] = c * z + s * w


@inlined
def level(q):
    """Set the quaternion ``q`` (4,) to no rotation (element by element: array expressions take seconds to compile)."""
    q[0], q[1], q[2], q[3] = 1.0, 0.0, 0.0, 0.0


@inlined
def cross_into(a, b, out):
    """Cross product of (3,) vectors into ``out``."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    out[0] = x
    out[1] = y


@inlined
def matmul_into(a, b, out):
    """Product of 3x3 matrices into ``out`` (another array than ``a`` and ``b``)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@inlined
def mount_matrices(dcm_body_sensor, mount, body_actual, body_mount):
    """Matrix from actual sensor axes to body, and from a change of the mount vector to body (left Jacobian)."""
    turn = np.empty((3, 3))
    q = np.empty(4)
    level(q)
    boxplus(q, mount[0], mount[1], mount[2])
    dcm_from_quaternion(q[0], q[1], q[2], q[3], turn)
    matmul_into(dcm_body_sensor, turn, body_actual)
    half = np.empty((3, 3))
    half[0, 0], half[0, 1], half[0, 2] = 1.0, -0.5 * mount[2], 0.5 * mount[1]
    half[1, 0], half[1, 1], half[1, 2] = 0.5 * mount[2], 1.0, -0.5 * mount[0]
    half[2, 0], half[2, 1], half[2, 2] = -0.5 * mount[1], 0.5 * mount[0], 1.0
    matmul_into(dcm_body_sensor, half, body_mount)


@inlined
def correct_sample(before, after, errors, offset, late, body_actual, body_mount, value, change, columns):
    """Mean of two samples in body axes into ``value`` (3,), with partials in ``columns`` (3, 9); ``change`` (3,) too.

    ``errors[offset:offset + 6]`` are bias and scale of the sensor; ``late`` is its tags' lateness in steps;
    ``change`` is the second sample less the first.
    """
    for j in range(3):
        gain = 1.0 / (1.0 + errors[offset + 3 + j])
        actual = (0.5 * (before[j] + after[j]) + late * (after[j] - before[j]) - errors[offset + j]) * gain
        for i in range(3):
            columns[i, j] = -body_actual[i, j] * gain
            columns[i, 3 + j] = columns[i, j] * actual
    for i in range(3):
        value[i] = 0.0
        change[i] = 0.0
        for j in range(3):
            difference = after[j] - before[j]
            value[i] -= columns[i, j] * (0.5 * (before[j] + after[j]) + late * difference - errors[offset + j])
            change[i] -= columns[i, j] * difference
    for j in range(3):
        cross_into(body_mount[:, j], value, columns[:, 6 + j])


@inlined
def coning_and_sculling(force, d_force, rate, d_rate, dt):
    """Add coning and sculling corrections of a step to mean force and rate (3,), in place (linear signals).

    ``d_force``, ``d_rate`` are their changes over the step: ``w + dt/12 w x dw``, ``f + dt/12 (w x df - dw x f)``.
    """
    k = dt / 12.0
    w0, w1, w2 = rate[0], rate[1], rate[2]
    f0, f1, f2 = force[0], force[1], force[2]
    a0, a1, a2 = d_rate[0], d_rate[1], d_rate[2]
    b0, b1, b2 = d_force[0], d_force[1], d_force[2]
    rate[0] += k * (w1 * a2 - w2 * a1)
    rate[1] += k * (w2 * a0 - w0 * a2)
    rate[2] += k * (w0 * a1 - w1 * a0)
    force[0] += k * (w1 * b2 - w2 * b1 - a1 * f2 + a2 * f1)
    force[1] += k * (w2 * b0 - w0 * b2 - a2 * f0 + a0 * f2)
    force[2] += k * (w0 * b1 - w1 * b0 - a0 * f1 + a1 * f0)


@inlined
def advance_columns(
    phi, dt, half_turn, dcm_mid, force, d_force, d_rate, by_clock, gradient, rotated, forced, moved, planet
):
    """Carry the columns of ``phi`` (9, 27 or 29) over one step; ``rotated``, ``forced``, ``moved`` (3, ...): scratch.

    ``by_clock`` (2, 3) is what force and rate change in a second. Along rows, which lie side by side in memory: the
    compiler puts several columns into one instruction.
    """
    width = phi.shape[1]
    h, two_omega = 0.5 * dt, 2.0 * planet[RATE]
    for i in range(3):
        a, b, c = half_turn[0, i], half_turn[1, i], half_turn[2, i]
        for j in range(width):
            rotated[i, j] = a * phi[6, j] + b * phi[7, j] + c * phi[8, j]
            moved[i, j] = rotated[i, j]
        for j in range(9):
            moved[i, 18 + j] += h * d_rate[i, j]
            rotated[i, 18 + j] += dt * d_rate[i, j]
        if width > 27:
            moved[i, 28] += h * by_clock[1, i]
            rotated[i, 28] += dt * by_clock[1, i]
    f0, f1, f2 = force[0], force[1], force[2]
    for j in range(width):
        m0, m1, m2 = moved[0, j], moved[1, j], moved[2, j]
        forced[0, j] = m1 * f2 - m2 * f1
        forced[1, j] = m2 * f0 - m0 * f2
        forced[2, j] = m0 * f1 - m1 * f0
    for i in range(3):
        for j in range(9):
            forced[i, 9 + j] += d_force[i, j]
        if width > 27:
            forced[i, 27] += by_clock[0, i]
    for i in range(3):
        a, b, c = dcm_mid[i, 0], dcm_mid[i, 1], dcm_mid[i, 2]
        x, y, z = gradient[i, 0], gradient[i, 1], gradient[i, 2]
        for j in range(width):
            moved[i, j] = (
                a * forced[0, j] + b * forced[1, j] + c * forced[2, j]
                + x * (phi[0, j] + h * phi[3, j]) + y * (phi[1, j] + h * phi[4, j]) + z * (phi[2, j] + h * phi[5, j])
            )  # fmt: skip
    for j in range(width):
        vx, vy = phi[3, j] + h * moved[0, j], phi[4, j] + h * moved[1, j]
        moved[0, j] += two_omega * vy
        moved[1, j] -= two_omega * vx
    for i in range(3):
        a, b, c = half_turn[0, i], half_turn[1, i], half_turn[2, i]
        for j in range(width):
            phi[i, j] += dt * (phi[3 + i, j] + h * moved[i, j])
            phi[3 + i, j] += dt * moved[i, j]
            phi[6 + i, j] = a * rotated[0, j] + b * rotated[1, j] + c * rotated[2, j]


@inlined
def noise_rows(matrix, dt, half_turn, lever):
    """Apply the step's kinematic transition to the rows of ``matrix`` (9, 9), in place."""
    for j in range(9):
        a, b, c = matrix[6, j], matrix[7, j], matrix[8, j]
        for i in range(3):
            kick = lever[i, 0] * a + lever[i, 1] * b + lever[i, 2] * c
            matrix[i, j] += dt * (matrix[3 + i, j] + 0.5 * kick)
            matrix[3 + i, j] += kick
        x = half_turn[0, 0] * a + half_turn[1, 0] * b + half_turn[2, 0] * c
        y = half_turn[0, 1] * a + half_turn[1, 1] * b + half_turn[2, 1] * c
        z = half_turn[0, 2] * a + half_turn[1, 2] * b + half_turn[2, 2] * c
        for i in range(3):
            matrix[6 + i, j] = half_turn[0, i] * x + half_turn[1, i] * y + half_turn[2, i] * z


@inlined
def advance_noise(noise, dt, half_turn, dcm_mid, force, force_density, rate_density):
    """Carry the process noise (9, 9) over one step and add the step's own white noise."""
    lever = np.empty((3, 3))
    for i in range(3):
        r0, r1, r2 = dt * dcm_mid[i, 0], dt * dcm_mid[i, 1], dt * dcm_mid[i, 2]
        lever[i, 0] = r2 * force[1] - r1 * force[2]
        lever[i, 1] = r0 * force[2] - r2 * force[0]
        lever[i, 2] = r1 * force[0] - r0 * force[1]
    noise_rows(noise, dt, half_turn, lever)
    noise_rows(noise.T, dt, half_turn, lever)
    span = abs(dt)
    for i in range(3):
        noise[6 + i, 6 + i] += rate_density[i] * span
        for j in range(3):
            value = 0.0
            for k in range(3):
                value += dcm_mid[i, k] * force_density[k] * dcm_mid[j, k]
            noise[3 + i, 3 + j] += value * span
            noise[i, 3 + j] += 0.5 * value * span * dt
            noise[3 + j, i] += 0.5 * value * span * dt
            noise[i, j] += value * span * dt * dt / 3.0


@inlined
def advance_state(position, velocity, q, q_mid, dt, force, rate, half_turn, dcm_mid, gradient, planet):
    """Carry the state over one step in place; leaves mid-step attitude, half turn and gravity gradient behind."""
    one = np.empty(4)
    level(one)
    h = 0.5 * dt
    boxplus(one, h * rate[0], h * rate[1], h * rate[2])
    dcm_from_quaternion(one[0], one[1], one[2], one[3], half_turn)
    for i in range(4):
        q_mid[i] = q[i]
    boxplus(q_mid, h * rate[0], h * rate[1], h * rate[2])
    turn_ecef(q_mid, planet[RATE] * h)
    dcm_from_quaternion(q_mid[0], q_mid[1], q_mid[2], q_mid[3], dcm_mid)
    for i in range(4):
        q[i] = q_mid[i]
    boxplus(q, h * rate[0], h * rate[1], h * rate[2])
    turn_ecef(q, planet[RATE] * h)

    x = position[0] + h * velocity[0]
    y = position[1] + h * velocity[1]
    z = position[2] + h * velocity[2]
    gx, gy, gz = gravitation(x, y, z, planet)
    w2 = planet[RATE] * planet[RATE]
    ax = dcm_mid[0, 0] * force[0] + dcm_mid[0, 1] * force[1] + dcm_mid[0, 2] * force[2] + gx + w2 * x
    ay = dcm_mid[1, 0] * force[0] + dcm_mid[1, 1] * force[1] + dcm_mid[1, 2] * force[2] + gy + w2 * y
    az = dcm_mid[2, 0] * force[0] + dcm_mid[2, 1] * force[1] + dcm_mid[2, 2] * force[2] + gz
    two = 2.0 * planet[RATE]
    vx = velocity[0] + h * (ax + two * velocity[1])
    vy = velocity[1] + h * (ay - two * velocity[0])
    ax += two * vy
    ay -= two * vx
    position[0] += dt * (velocity[0] + h * ax)
    position[1] += dt * (velocity[1] + h * ay)
    position[2] += dt * (velocity[2] + h * az)
    velocity[0] += dt * ax
    velocity[1] += dt * ay
    velocity[2] += dt * az

    r2 = x * x + y * y + z * z
    k = planet[GM] / (r2 * math.sqrt(r2))
    point = (x, y, z)
    for i in range(3):
        for j in range(3):
            gradient[i, j] = 3.0 * k * point[i] * point[j] / r2
        gradient[i, i] -= k
    gradient[0, 0] += w2
    gradient[1, 1] += w2


@inlined
def propagate_strapdown(motion, first, last, errors, position, velocity, q, phi, noise):
    """Carry a state in place from grid point ``first`` to ``last`` (either direction) with ``phi`` and ``noise``.

    ``phi`` (9, 27), or (9, 29) with clocks, and ``noise`` (9, 9) come as the identity and zero. Densities hold from a
    grid point to the next later one.
    """
    force_actual, force_mount = np.empty((3, 3)), np.empty((3, 3))
    rate_actual, rate_mount = np.empty((3, 3)), np.empty((3, 3))
    mount_matrices(motion.dcm_body_force, errors[6:9], force_actual, force_mount)
    mount_matrices(motion.dcm_body_rate, errors[15:18], rate_actual, rate_mount)
    force, rate, q_mid = np.empty(3), np.empty(3), np.empty(4)
    force_change, rate_change = np.empty(3), np.empty(3)
    d_force, d_rate = np.empty((3, 9)), np.empty((3, 9))
    half_turn, dcm_mid, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    width = phi.shape[1]
    rotated, forced, moved = np.empty((3, width)), np.empty((3, width)), np.empty((3, width))
    late_force, late_rate, by_clock = 0.0, 0.0, np.zeros((2, 3))
    if width > 27:
        late_force, late_rate = errors[18], errors[19]
    f, w = motion.force_sensor_mps2, motion.rate_sensor_radps
    step = 1 if last >= first else -1
    for k in range(first, last, step):
        n = k + step
        dt = motion.time_s[n] - motion.time_s[k]
        j = min(k, n)
        a, b = late_force / dt, late_rate / dt
        correct_sample(f[k], f[n], errors, 0, a, force_actual, force_mount, force, force_change, d_force)
        correct_sample(w[k], w[n], errors, 9, b, rate_actual, rate_mount, rate, rate_change, d_rate)
        for i in range(3):
            by_clock[0, i], by_clock[1, i] = force_change[i] / dt, rate_change[i] / dt
        coning_and_sculling(force, force_change, rate, rate_change, dt)
        advance_state(position, velocity, q, q_mid, dt, force, rate, half_turn, dcm_mid, gradient, motion.planet)
        advance_columns(
            phi, dt, half_turn, dcm_mid, force, d_force, d_rate, by_clock, gradient, rotated, forced, moved,
            motion.planet,
        )  # fmt: skip
        advance_noise(noise, dt, half_turn, dcm_mid, force, motion.force_density[j], motion.rate_density[j])


@inlined
def ballistic_acceleration(motion, x, y, z, vx, vy, vz, e0, e1, e2, e3, e4, e5):
    """Acceleration against the rotating planet, m/s^2, rate 1/s at which the air changes the velocity, deceleration."""
    sin_lat, cos_lat, height, per_p = geodetic(x, y, z, motion.planet)
    at = (height - motion.air_from_m) / motion.air_step_m
    row = int(min(max(at, 0.0), len(motion.air) - 2.0))
    w = min(max(at - row, 0.0), 1.0)
    low, high = motion.air[row], motion.air[row + 1]
    density = math.exp(low[0] + w * (high[0] - low[0]) + e3 * (low[3] + w * (high[3] - low[3])))
    wind_sd = low[4] + w * (high[4] - low[4])
    north = low[1] + w * (high[1] - low[1]) + e4 * wind_sd
    east = low[2] + w * (high[2] - low[2]) + e5 * wind_sd
    ce, se = x * per_p, y * per_p
    ux = vx + sin_lat * ce * north + se * east
    uy = vy + sin_lat * se * north - ce * east
    uz = vz - cos_lat * north
    speed = math.sqrt(ux * ux + uy * uy + uz * uz) + 1e-9
    # a filter far from its track may ask for any drag; e^8 is a parachute on a needle
    k = 0.5 * density * motion.drag_m2pkg * math.exp(min(max(e0, -8.0), 8.0)) * speed
    # normal to the flow: normal to the path's plane, and in it
    m = 1.0 / speed
    px, py, pz = motion.across_ecef[0], motion.across_ecef[1], motion.across_ecef[2]
    along = m * m * (px * ux + py * uy + pz * uz)
    ax, ay, az = px - along * ux, py - along * uy, pz - along * uz
    n = 1.0 / (math.sqrt(ax * ax + ay * ay + az * az) + 1e-9)
    ax, ay, az = ax * n, ay * n, az * n
    bx, by, bz = m * (uy * az - uz * ay), m * (uz * ax - ux * az), m * (ux * ay - uy * ax)
    gx, gy, gz = gravitation(x, y, z, motion.planet)
    w2, two = motion.planet[RATE] * motion.planet[RATE], 2.0 * motion.planet[RATE]
    fx = k * (speed * (e1 * ax + e2 * bx) - ux) + gx + w2 * x + two * vy
    fy = k * (speed * (e1 * ay + e2 * by) - uy) + gy + w2 * y - two * vx
    return fx, fy, k * (speed * (e1 * az + e2 * bz) - uz) + gz, k * math.sqrt(1.0 + e1 * e1 + e2 * e2), k * speed


@inlined
def ballistic_partials(motion, point, partials):
    """Partials (3, 12) of the acceleration by position, velocity and drivers ``point`` (12,), central differences."""
    p = np.empty(12)
    for j in range(12):
        p[j] = point[j]
    for k in range(24):  # both sides in one loop: what is written once is compiled once
        j = k // 2
        h = 1.0 if j < 3 else (0.01 if j < 6 else 1e-4)
        p[j] = point[j] + h if k % 2 == 0 else point[j] - h
        a = ballistic_acceleration(motion, p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11])
        p[j] = point[j]
        for i in range(3):
            partials[i, j] = a[i] if k % 2 == 0 else (partials[i, j] - a[i]) / (2.0 * h)


@inlined
def ballistic_step(motion, dt, point, stage, slope, mid):
    """Carry position and velocity ``point[:6]`` over a step by Runge and Kutta's fourth-order rule.

    ``mid`` (12,) is the point half way; ``stage`` (12,) and ``slope`` (6,) are scratch.
    """
    for j in range(12):
        stage[j] = point[j]
    for j in range(6):
        slope[j] = 0.0
    for i in range(4):
        s = stage
        a0, a1, a2, _, _ = ballistic_acceleration(
            motion, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11]
        )
        weight = 1.0 / 6.0 if i == 0 or i == 3 else 1.0 / 3.0
        ahead = dt if i == 2 else 0.5 * dt
        v0, v1, v2 = s[3], s[4], s[5]
        slope[0] += weight * v0
        slope[1] += weight * v1
        slope[2] += weight * v2
        slope[3] += weight * a0
        slope[4] += weight * a1
        slope[5] += weight * a2
        stage[0], stage[1], stage[2] = point[0] + ahead * v0, point[1] + ahead * v1, point[2] + ahead * v2
        stage[3], stage[4], stage[5] = point[3] + ahead * a0, point[4] + ahead * a1, point[5] + ahead * a2
        if i == 1:  # the second estimate of half way
            for j in range(12):
                mid[j] = stage[j]
    for j in range(6):
        point[j] += dt * slope[j]


@inlined
def ballistic_transition(partials, dt, full):
    """Transition (6, 12) of a step, ``1 + M dt + M^2 dt^2 / 2``, from the acceleration's partials (3, 12) half way."""
    for i in range(3):
        for j in range(12):
            a = partials[i, j]
            b = 0.0
            for k in range(3):
                b += partials[i, 3 + k] * partials[k, j]
            if 3 <= j < 6:
                b += partials[i, j - 3]
            full[3 + i, j] = dt * a + 0.5 * dt * dt * b
            full[i, j] = 0.5 * dt * dt * a
        full[i, i] += 1.0
        full[i, 3 + i] += dt
        full[3 + i, 3 + i] += 1.0


@inlined
def followed(motion, point, rest):
    """Part of a step ``rest`` in which the air changes the velocity by no more than `MOST_CHANGE`."""
    s = point
    a = ballistic_acceleration(
        motion, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11]
    )  # fmt: skip
    change = a[3] * abs(rest)
    return rest if change <= MOST_CHANGE else rest * MOST_CHANGE / change


@inlined
def accumulate(full, density, dt, phi, noise, old):
    """Transition ``phi`` (9, 15) and ``noise`` (9, 9) of all steps so far; ``old`` (6, 15) is scratch."""
    for i in range(6):
        for j in range(15):
            old[i, j] = phi[i, j]
    for i in range(6):
        for j in range(15):
            value = full[i, j - 3] if j >= 9 else 0.0
            for m in range(6):
                value += full[i, m] * old[m, j]
            phi[i, j] = value
    for i in range(6):
        for j in range(6):
            old[i, j] = 0.0
            for m in range(6):
                old[i, j] += full[i, m] * noise[m, j]
    for i in range(6):
        for j in range(6):
            noise[i, j] = 0.0
            for m in range(6):
                noise[i, j] += old[i, m] * full[j, m]
    for i in range(3):
        q = density[i] * abs(dt)
        noise[i, i] += q * dt * dt / 3.0
        noise[i, 3 + i] += 0.5 * q * dt
        noise[3 + i, i] += 0.5 * q * dt
        noise[3 + i, 3 + i] += q


@inlined
def propagate_ballistic(motion, first, last, errors, position, velocity, phi, noise):
    """Carry a state in place between grid points, with ``phi`` (9, 15) and ``noise`` (9, 9) from identity and zero."""
    point, stage, slope, mid = np.empty(12), np.empty(12), np.empty(6), np.empty(12)
    partials, full, old = np.empty((3, 12)), np.empty((6, 12)), np.empty((6, 15))
    for j in range(3):
        point[j], point[3 + j] = position[j], velocity[j]
    for j in range(6):
        point[6 + j] = errors[j]
    step = 1 if last >= first else -1
    for k in range(first, last, step):
        density = motion.force_density[min(k, k + step)]
        rest, parts = motion.time_s[k + step] - motion.time_s[k], 0
        while rest != 0.0 and parts < MOST_PARTS:
            parts += 1
            dt = followed(motion, point, rest) if parts < MOST_PARTS else rest
            rest -= dt
            ballistic_step(motion, dt, point, stage, slope, mid)
            ballistic_partials(motion, mid, partials)
            ballistic_transition(partials, dt, full)
            accumulate(full, density, dt, phi, noise, old)
    for j in range(3):
        position[j], velocity[j] = point[j], point[3 + j]


@dataclass(frozen=True)
class Step:
    """A state carried to another node, with its transition (9, 27 or 29) and process noise (9, 9)."""

    state: States
    transition: FloatArray
    noise: FloatArray


@inlined
def level_transition(phi, noise):
    """Set the transition to the identity and its noise to zero."""
    for i in range(9):
        for j in range(phi.shape[1]):
            phi[i, j] = 1.0 if i == j else 0.0
        for j in range(9):
            noise[i, j] = 0.0


@kernel
def propagate_one(motion, first, last, errors, position, velocity, q, phi, noise):
    """Carry a state in place between grid points with its transition ``phi`` (9, D) and ``noise`` (9, 9)."""
    level_transition(phi, noise)
    if motion.ballistic:
        propagate_ballistic(motion, first, last, errors, position, velocity, phi, noise)
    else:
        propagate_strapdown(motion, first, last, errors, position, velocity, q, phi, noise)


def propagate(motion: Motion, first: int, last: int, start: States) -> Step:
    """Carry a state from grid point ``first`` to ``last`` (either direction), compiled; whatever carries it."""
    position, velocity, q = start.position_ecef_m.copy(), start.velocity_ecef_mps.copy(), start.q_ecef_body.copy()
    phi, noise = np.empty((9, 9 + motion.drivers)), np.empty((9, 9))
    errors = np.ascontiguousarray(start.sensor_errors)
    propagate_one(motion, first, last, errors, position, velocity, q, phi, noise)
    return Step(States(position, velocity, q, start.sensor_errors), phi, noise)


def fill_between(motion: Motion, node_index: IntArray, known: IntArray, at_known: States) -> States:
    """States at all nodes (n,) from those at the ``known`` ones (indices, the first is 0), noise-free between."""
    n = len(node_index)
    position, velocity, q = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4))
    position[known], velocity[known] = at_known.position_ecef_m, at_known.velocity_ecef_mps
    q[known] = at_known.q_ecef_body
    is_known = np.zeros(n, dtype=bool)
    is_known[known] = True
    errors = np.ascontiguousarray(at_known.sensor_errors[np.cumsum(is_known) - 1])
    unused = np.empty((9, 9 + motion.drivers)), np.empty((9, 9))
    for k in np.flatnonzero(~is_known):
        state = position[k], velocity[k], q[k]
        for row, before in zip(state, (position[k - 1], velocity[k - 1], q[k - 1]), strict=True):
            row[:] = before
        propagate_one(motion, node_index[k - 1], node_index[k], errors[k - 1], *state, *unused)
    return States(position, velocity, rotations.continuous(q), errors)

"""What propagates a state in time? Inertial sensors (strapdown mechanisation), or a ballistic model of drag in the air.

Both drive the nine kinematic errors (position, velocity, rotation) through a few *drivers*, errors that the motion
depends on: with inertial sensors their bias, scale and mount, 18 in all, and the errors of their clocks, 2, where such
are stated; in ballistic flight drag, side forces, density and winds, 6 in all, and rotation is held fixed. So one
filter serves both. Kernels: `recon._propagation_kernels`; readable twins: `tests.oracles.strapdown` and
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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flightmodel import rotations
from flightmodel.atmosphere import bottom_m, profile_from_sounding
from flightmodel.checks import FloatArray, IntArray
from flightmodel.earth import WGS84, Planet
from flightmodel.telemetry import Motion as MotionSpec
from flightmodel.telemetry import Sounding
from flightmodel.trajectory import interpolate_rows
from recon import _filter_kernels
from recon.imu_screening import BridgedSensor
from recon.state import States

SAME_INSTANT_S = 2e-6
GRID_STEP_S = 0.05  # in ballistic flight
AIR_FROM_M, AIR_STEP_M = -500.0, 100.0
_CORRELATION_S = 1.0  # a stated disturbance, or a thrust that may be anything, keeps its value for about so long


class Motion(NamedTuple):
    """Time grid that contains every node, and what acts on it: as kernels take it, whatever carries the state.

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


@dataclass(frozen=True)
class Step:
    """A state carried to another node, with its transition (9, 27 or 29) and process noise (9, 9)."""

    state: States
    transition: FloatArray
    noise: FloatArray


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


def propagate(motion: Motion, first: int, last: int, start: States) -> Step:
    """Carry a state from grid point ``first`` to ``last`` (either direction), compiled; whatever carries it."""
    position, velocity, q = start.position_ecef_m.copy(), start.velocity_ecef_mps.copy(), start.q_ecef_body.copy()
    phi, noise = np.empty((9, 9 + motion.drivers)), np.empty((9, 9))
    errors = np.ascontiguousarray(start.sensor_errors)
    _filter_kernels.propagate_one(motion, first, last, errors, position, velocity, q, phi, noise)
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
        _filter_kernels.propagate_one(motion, node_index[k - 1], node_index[k], errors[k - 1], *state, *unused)
    return States(position, velocity, rotations.continuous(q), errors)


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
    """Motion with the noise of the spans that flight.toml states as disturbed, of accelerations and of rates.

    They are vibration that rectifies to a bias, a saturated gyro, thrust.
    """
    force, rate = motion.force_density.copy(), motion.rate_density.copy()
    for d in spec.disturbed:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        force[inside] += d.sd_mps2**2 * _CORRELATION_S
        if not motion.ballistic:  # which has no rotation
            rate[inside] += d.sd_radps**2 * _CORRELATION_S
    return motion._replace(force_density=force, rate_density=rate)

"""Residuals of a candidate flight in spans, and how they fall with every unknown.

The flight is cut into spans of about a joint's period, each flown by the simulator from a motion of its own
(multiple shooting: one flight of fifty seconds depends on its start so strongly that a fit of it stops in any of many
false minima). Sought is the most probable of all unknowns together::

    | (sensors - simulated) / sd |^2 + | (end of a span - start of the next) / sd |^2 + | unknowns' priors |^2

Ends and starts differ by what the air's structure between its knots does to the motion.

References
----------
H. G. Bock, "Recent advances in parameter identification techniques for O.D.E.", 1983 (multiple shooting).

What would the sensors have read in short spans of a flight, and how would each have ended?

Many spans at once: each starts from a motion of its own at the reconstruction's place and speed, and is flown by the
simulator.

One step towards the most probable unknowns of a `Problem`.

Gauss-Newton's, with the second-order correction of geodesic acceleration, since the valley is long and bent
(stiffness, inertias and stability nearly scale together); damped where the bend is sharper than that.

References
----------
M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization", 2012 (geodesic acceleration).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from flightmodel import earth, rotations
from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.candidate import SPAN_S, WINDOWS, AirUnknowns, Observed, VehicleUnknowns
from synthetic_flight import simulate
from synthetic_flight.ensemble import Schedule, Start, fly_ensemble

INSTRUMENTS = 20
# per angle of flow, rad, that the air's structure between knots GUST_KNOT_M apart makes, at the largest dynamic
# pressure within a span: rotation rad, rate rad/s, bending rad, its rate rad/s; and what to divide by
# where there is no air
GUST = np.array([0.3, 0.3, 0.3, 3.0, 3.0, 3.0, 0.0, 0.3, 0.3, 0.0, 9.0, 9.0])
STILL_SD = np.deg2rad([0.001, 0.001, 0.001, 0.003, 0.003, 0.003, 1e-4, 0.001, 0.001, 0.03, 0.01, 0.01])
GUST_KNOT_M = 300.0
LARGE_ANGLE_RAD = np.deg2rad(5.0)  # at which structure of the density turns the vehicle
GUST_RATE, GUST_FORCE_MPS2 = 2.0, 60.0  # of the windows' rates and lateral force, as if it forgot from one to the next
MOTION_STEP = np.deg2rad(np.repeat([2e-5, 5e-5, 2e-5, 2e-4], 3))
VEHICLE_STEP, AIR_STEP = 1e-5, np.array([1e-6, 2e-4, 2e-4])


@dataclass(frozen=True)
class Unknowns:
    """One candidate: vehicle (v,), instruments (20,), air (3, k), motion at the start of each span (s, 12)."""

    vehicle: FloatArray
    instruments: FloatArray
    air: FloatArray
    motion: FloatArray

    def moved(self, step: FloatArray) -> Unknowns:
        """Candidate moved by a step of all unknowns in this order."""
        parts = (self.vehicle, self.instruments, self.air, self.motion)
        ends = np.cumsum([part.size for part in parts])[:-1]
        return Unknowns(*(p + d.reshape(p.shape) for p, d in zip(parts, np.split(step, ends), strict=True)))


@dataclass(frozen=True)
class Residuals:
    """In standard deviations: sensors (s, WINDOWS, 6), joins (s - 1, 12); sum of squares with the priors'."""

    sensors: FloatArray
    joins: FloatArray
    cost: float


@dataclass(frozen=True)
class Linear:
    """Residuals at a candidate, and how they fall with the unknowns: columns and responses, span by span."""

    found: Residuals
    sensors: list[tuple[Index, FloatArray]]
    joins: list[tuple[Index, FloatArray]]
    count: int

    def back(self, sensors: FloatArray, joins: FloatArray) -> FloatArray:
        """Transpose of the derivatives times numbers laid out as the residuals."""
        out = np.zeros(self.count)
        for parts, values in ((self.sensors, sensors), (self.joins, joins)):
            for (column, response), value in zip(parts, values, strict=True):
                out[column] += response.T @ value.ravel()
        return out


@dataclass(frozen=True)
class Problem:
    """Flight, unknowns, those of the vehicle that are held, and by how much standard deviations are widened.

    Parameters
    ----------
    observed : Observed
    unknown : VehicleUnknowns
    air : AirUnknowns
    held : tuple of str
        Unknowns of the vehicle that no step moves.
    wider : float or (s,) float
        All, or each span's.
    """

    observed: Observed
    unknown: VehicleUnknowns
    air: AirUnknowns
    held: tuple[str, ...] = ()
    wider: float | FloatArray = 1.0

    @property
    def first_instrument(self) -> int:
        """Where the instruments' unknowns begin; after them the air's."""
        return len(self.unknown.names)

    @property
    def first_motion(self) -> int:
        """Where the spans' unknowns begin."""
        return self.first_instrument + INSTRUMENTS + 3 * len(self.air.knots_m)

    @property
    def count(self) -> int:
        """Unknowns altogether."""
        return self.first_motion + MOTION * self.observed.spans

    @cached_property
    def unsteady(self) -> FloatArray:
        """Flow's angle (s,) that the air's structure between its knots makes, rad, times the share of the load.

        Each stretch between two knots pushes for a time that grows with their distance, and they push at random: over
        a span what they do grows, per angle, with the root of the distance (docs/reconciliation.md).
        """
        seen = self.observed
        forgets = np.sqrt(self.air.apart_m(seen.altitude_m) / GUST_KNOT_M)
        density, wind = self.air.between_knots(seen.altitude_m)
        speed = np.linalg.norm(seen.start.velocity_ecef_mps[:-1], axis=1)
        load = seen.dynamic_pressure_pa / seen.dynamic_pressure_pa.max()
        return np.asarray(load * forgets * np.hypot(wind / speed, density * LARGE_ANGLE_RAD))

    @cached_property
    def data(self) -> FloatArray:
        """Windows (s, WINDOWS, 6) as measured; zero where sensors are missing."""
        return np.nan_to_num(np.concatenate([self.observed.rate_radps, self.observed.specific_force_mps2], axis=2))

    @cached_property
    def weight(self) -> FloatArray:
        """Inverse standard deviations of the windows (s, WINDOWS, 6), zero where sensors are missing."""
        seen = self.observed
        size = np.abs(seen.specific_force_mps2)
        density, _ = self.air.between_knots(seen.altitude_m)
        gust = self.unsteady[:, None, None]
        rate_sd = np.hypot(seen.rate_sd_radps, GUST_RATE * gust) * np.ones_like(size)
        left_out = np.hypot(density[:, None, None] * size, GUST_FORCE_MPS2 * gust)
        force_sd = np.hypot(seen.force_sd_mps2, left_out)
        weight = 1.0 / (self._widened[:, None, None] * np.concatenate([rate_sd, force_sd], axis=2))
        return np.where(np.isfinite(seen.specific_force_mps2[..., :1]), np.nan_to_num(weight), 0.0)

    @cached_property
    def join_weight(self) -> FloatArray:
        """Inverse standard deviations (s - 1, 12) of ends against starts."""
        wider = np.maximum(self._widened[:-1], self._widened[1:])
        return np.asarray(1.0 / (wider[:, None] * np.hypot(GUST * self.unsteady[:-1, None], STILL_SD)))

    @property
    def log_weight(self) -> float:
        """Sum of the logarithms of all weights."""
        return float(np.log(self.weight[self.weight > 0.0]).sum() + np.log(self.join_weight).sum())

    @property
    def _widened(self) -> FloatArray:
        return np.asarray(np.broadcast_to(self.wider, self.observed.spans))

    @cached_property
    def near(self) -> list[Index]:
        """Knots of the air that each span passes."""
        z, knots = self.observed.altitude_m, self.air.knots_m
        reach = 0.55 * np.abs(np.gradient(z)) + 50.0
        apart = np.diff(knots, append=2 * knots[-1] - knots[-2])
        return [np.flatnonzero(np.abs(knots - at) < r + apart) for at, r in zip(z, reach, strict=True)]

    @cached_property
    def attitude_precision(self) -> FloatArray:
        """Inverse covariance (3, 3) of the reconstructed attitude at the first start."""
        covariance = self.observed.start.covariance
        assert covariance is not None
        return np.asarray(np.linalg.inv(covariance[0, 6:9, 6:9]))

    def start(self) -> Unknowns:
        """Everything as told, motion as reconstructed."""
        motion = np.zeros((self.observed.spans, MOTION))
        motion[:, RATE] = self.observed.start.omega_body_eci_body_radps[:-1]
        air = np.zeros((3, len(self.air.knots_m)))
        return Unknowns(np.zeros(len(self.unknown.names)), np.zeros(INSTRUMENTS), air, motion)

    def candidate(self, x: FloatArray) -> Candidate:
        """Vehicle of unknowns in standard deviations."""
        vehicle = self.unknown.vehicle(x)
        return Candidate(vehicle, simulate.parameter_vector(vehicle, *self.unknown.factors(x)))

    def predicted(self, u: Unknowns) -> Read:
        """Every span once; windows without the instruments' errors."""
        spans = np.arange(self.observed.spans)
        zero = np.zeros_like(spans)
        flights = Flights(spans, zero, u.motion, zero, [self.candidate(u.vehicle)], [self.air.table(u.air)])
        return fly_spans(self.observed, self.unknown.told, flights)

    def instrument_rows(self, read: Read) -> FloatArray:
        """Response of the windows to the instruments' unknowns, (s, WINDOWS, 6, 20).

        Scale and mounting work on what is flown, not on what was measured: on measured rates a gyro's scale would pay
        for itself by scaling the noise.
        """
        seen = self.observed
        rows = np.zeros((*read.windows.shape, INSTRUMENTS))
        for axes, columns, response in (
            (slice(0, 3), slice(0, 9), seen.rate_response),
            (slice(3, 6), slice(9, 18), seen.force_response),
        ):
            rows[..., axes, columns] = response[0] + np.tensordot(read.windows[..., axes], response[1:], axes=1)
        # a late clock shows what was earlier
        rows[..., :3, 18] = -seen.clock_sd_s[0] * read.slope[..., :3]
        rows[..., 3:, 19] = -seen.clock_sd_s[1] * read.slope[..., 3:]
        return rows

    def shown(self, u: Unknowns, windows: FloatArray, slope: FloatArray) -> FloatArray:
        """Changes (..., 6) of what the sensors show, by those of what is flown and of how fast that changes."""
        seen = self.observed
        gain = np.eye(6)
        gain[:3, :3] += np.einsum("kij,j->ik", seen.rate_response[1:], u.instruments[0:9])
        gain[3:, 3:] += np.einsum("kij,j->ik", seen.force_response[1:], u.instruments[9:18])
        late = np.repeat(seen.clock_sd_s * u.instruments[18:20], 3)
        return np.asarray(windows @ gain.T - late * slope)

    def residuals(self, u: Unknowns, read: Read | None = None) -> Residuals:
        """Where a span diverges the cost is infinite."""
        read = read or self.predicted(u)
        told = self.instrument_rows(read) @ u.instruments
        sensors = (self.data - read.windows - told) * self.weight
        joins = (read.end[:-1] - u.motion[1:]) * self.join_weight
        with np.errstate(over="ignore", invalid="ignore"):  # a candidate that tumbles
            total = float((sensors**2).sum() + (joins**2).sum()) + self.prior_cost(u)
        return Residuals(sensors, joins, total if np.isfinite(total) else np.inf)

    def prior_cost(self, u: Unknowns) -> float:
        """Sum of squares of what was known before."""
        return sum(float(value @ precision @ value) for _, precision, value in self._priors(u))

    def linear(self, u: Unknowns) -> Linear:
        """Residuals' derivatives about ``u``."""
        flights, columns, steps = self._moves(u)
        moved, read = fly_spans(self.observed, self.unknown.told, flights), self.predicted(u)
        found, rows = self.residuals(u, read), self.instrument_rows(read)
        at, sensors, joins = 0, [], []
        for span, (column, step) in enumerate(zip(columns, steps, strict=True)):
            part = slice(at, at := at + len(column))
            step[self.held_columns] = np.inf  # no step moves what is held
            change = self.shown(u, moved.windows[part] - read.windows[span], moved.slope[part] - read.slope[span])
            sensed = change / step[:, None, None] * self.weight[span]
            told = (rows[span] * self.weight[span][..., None]).reshape(-1, INSTRUMENTS)
            both = np.concatenate([column, self.first_instrument + np.arange(INSTRUMENTS)])
            sensors.append((both, np.column_stack([sensed.reshape(len(step), -1).T, told])))
            if span + 1 < self.observed.spans:
                ended = (moved.end[part] - read.end[span]) / step[:, None]
                following = self.first_motion + MOTION * (span + 1) + np.arange(MOTION)
                response = np.column_stack([ended.T, -np.eye(MOTION)]) * self.join_weight[span][:, None]
                joins.append((np.concatenate([column, following]), -response))
        return Linear(found, sensors, joins, self.count)

    def normal(self, u: Unknowns, linear: Linear) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and right-hand side of a step from ``u``."""
        matrix = np.zeros((self.count, self.count))
        for column, response in (*linear.sensors, *linear.joins):
            matrix[np.ix_(column, column)] += response.T @ response
        for part, precision, _ in self._priors(u):
            matrix[part, part] += precision
        return matrix, self.right(u, linear, linear.found)

    def right(self, u: Unknowns, linear: Linear, found: Residuals) -> FloatArray:
        """Right-hand side of a step from ``u`` with residuals ``found``, by derivatives of there or nearby."""
        right = linear.back(found.sensors, found.joins)
        for part, precision, value in self._priors(u):
            right[part] -= precision @ value
        right[self.held_columns] = 0.0
        return right

    @property
    def held_columns(self) -> list[int]:
        """Places of the unknowns that are held."""
        return [self.unknown.names.index(name) for name in self.held]

    def _moves(self, u: Unknowns) -> tuple[Flights, list[Index], list[FloatArray]]:
        """Spans with one unknown moved, which unknown (columns) and by how much, span by span."""
        v, knots = self.first_instrument, len(self.air.knots_m)
        candidates = [self.candidate(u.vehicle + VEHICLE_STEP * unit) for unit in np.eye(v)] + [
            self.candidate(u.vehicle)
        ]
        tables, number = [self.air.table(u.air)], {}
        for kind in range(3):
            for knot in range(knots):
                air = u.air.copy()
                air[kind, knot] += AIR_STEP[kind]
                number[kind, knot] = len(tables)
                tables.append(self.air.table(air))
        rows: list[tuple[int, int, FloatArray, int]] = []
        columns, steps = [], []
        for span in range(self.observed.spans):
            motion = u.motion[span]
            rows += [(span, j, motion, 0) for j in range(v)]
            rows += [(span, v, motion + d, 0) for d in np.diag(MOTION_STEP)]
            places = [(kind, knot) for kind in range(3) for knot in self.near[span].tolist()]
            rows += [(span, v, motion, number[place]) for place in places]
            in_air = [v + INSTRUMENTS + kind * knots + knot for kind, knot in places]
            columns.append(np.array([*range(v), *(self.first_motion + MOTION * span + np.arange(MOTION)), *in_air]))
            steps.append(np.array([VEHICLE_STEP] * v + MOTION_STEP.tolist() + [AIR_STEP[kind] for kind, _ in places]))
        which = np.array([(row[0], row[1], row[3]) for row in rows]).T
        motions = np.array([row[2] for row in rows])
        return Flights(which[0], which[1], motions, which[2], candidates, tables), columns, steps

    def _priors(self, u: Unknowns) -> list[tuple[slice, FloatArray, FloatArray]]:
        """Which unknowns, their inverse covariance before the flight, their values."""
        free, knots, first = self.first_instrument + INSTRUMENTS, len(self.air.knots_m), self.first_motion
        return [
            (slice(0, free), np.eye(free), np.concatenate([u.vehicle, u.instruments])),
            *[
                (slice(free + kind * knots, free + (kind + 1) * knots), self.air.precision[kind], u.air[kind])
                for kind in range(3)
            ],
            (slice(first, first + 3), self.attitude_precision, u.motion[0, ATTITUDE]),
            (slice(first + 6, first + MOTION), np.diag(self.observed.first_bending_sd**-2.0), u.motion[0, 6:]),
        ]


STEP_S = 0.004
PER_RECORD = 5  # two records a window: its mean is Simpson's of its ends and middle
RECORDS = 2 * WINDOWS + 1
# of a span's start: rotation against the reconstructed attitude, body's rate, shell's rotation vector against the body
# (x is its twist), shell's rate against the body, shell axes
MOTION = 12
ATTITUDE, RATE, BENDING, BENDING_RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Candidate:
    """A vehicle with its `packing.parameter_vector`."""

    vehicle: Vehicle
    parameters: FloatArray


@dataclass(frozen=True)
class Flights:
    """Spans to fly: which, with which candidate, from which motion, in which air.

    Parameters
    ----------
    span, candidate, table : (m,) int
    motion : (m, 12) float
    candidates : list of Candidate
    tables : list of (rows, 6) float
        Kernel tables of the air.
    """

    span: Index
    candidate: Index
    motion: FloatArray
    table: Index
    candidates: list[Candidate]
    tables: list[FloatArray]


@dataclass(frozen=True)
class Read:
    """What sensors read; NaN after a divergence.

    Parameters
    ----------
    windows, slope : (m, WINDOWS, 6) float
        Rates, rad/s, and specific force, m/s^2, means over windows, and how fast they change.
    bending : (m, WINDOWS, 3) float
        Shell's rotation vector against the body at the windows' middles, rad.
    end : (m, 12) float
        Motion at the end of the span, as the next one counts it.
    """

    windows: FloatArray
    slope: FloatArray
    bending: FloatArray
    end: FloatArray


def fly_spans(observed: Observed, told: Vehicle, flights: Flights) -> Read:
    """Fly spans and read the sensors."""
    starts = _start_states(observed, flights)

    def start_of(k: int) -> Start:
        return Start(starts[k], flights.candidates[flights.candidate[k]].parameters, flights.tables[flights.table[k]])

    states, aux = np.full((len(starts), RECORDS, 20), np.nan), np.full((len(starts), RECORDS, 18), np.nan)
    for flown in fly_ensemble(told, start_of, range(len(starts)), Schedule(STEP_S, PER_RECORD, RECORDS)):
        states[flown.run, : len(flown.states)], aux[flown.run, : len(flown.aux)] = flown.states, flown.aux
    windows, slope = _windows(observed, flights, states, aux)
    middle = states[:, 1::2]
    bent = rotations.log(rotations.multiply(rotations.conjugate(middle[..., 6:10]), middle[..., 10:14]))
    return Read(windows, slope, bent, _ends(observed, flights.span, states[:, -1]))


def _start_states(observed: Observed, flights: Flights) -> FloatArray:
    """States (m, 20) as `synthetic_flight.simulate.state_from_ecef` lays them out, of the bent vehicle's c.g."""
    at, span, motion = observed.start, flights.span, flights.motion
    vehicles = [c.vehicle for c in flights.candidates]
    cg = np.array([v.cg_m for v in vehicles])[flights.candidate]
    # of the shell's c.g., from the joint; its share in the vehicle's
    arm = np.array([v.aeroshell.cg_m - v.joint_m for v in vehicles])[flights.candidate]
    share = np.array([v.aeroshell.mass_kg / v.mass_kg for v in vehicles])[flights.candidate, None]
    q = rotations.boxplus(at.q_ecef_body[span], motion[:, ATTITUDE])
    omega, bent = motion[:, RATE], rotations.exp(motion[:, BENDING])
    shell_rate = rotations.rotate(rotations.conjugate(bent), omega) + motion[:, BENDING_RATE]
    place = cg + share * (rotations.rotate(bent, arm) - arm)
    swing = np.cross(omega, cg) + share * (rotations.rotate(bent, np.cross(shell_rate, arm)) - np.cross(omega, arm))
    r = at.position_ecef_m[span] + rotations.rotate(q, place)
    v = at.velocity_ecef_mps[span] + rotations.rotate(q, swing)
    to_eci = rotations.conjugate(earth.q_ecef_eci(at.time_s[span]))
    q_body = rotations.multiply(to_eci, q)
    return np.column_stack(
        [
            rotations.rotate(to_eci, r),
            rotations.rotate(to_eci, v + np.cross(earth.OMEGA_ECEF_RADPS, r)),
            q_body,
            rotations.multiply(q_body, bent),
            omega,
            shell_rate,
        ]
    )


def _windows(
    observed: Observed, flights: Flights, states: FloatArray, aux: FloatArray
) -> tuple[FloatArray, FloatArray]:
    bodies = [c.vehicle.centerbody for c in flights.candidates]
    arm = np.array([observed.accelerometer_m - body.cg_m for body in bodies])[flights.candidate][:, None]
    mass = np.array([body.mass_kg for body in bodies])[flights.candidate][:, None, None]
    omega, turn = states[..., 14:17], aux[..., 15:18]
    force = rotations.rotate(rotations.conjugate(states[..., 6:10]), aux[..., 6:9]) / mass
    force = force + np.cross(turn, arm) + np.cross(omega, np.cross(omega, arm))
    records = np.concatenate([omega, force], axis=2)
    before, middle, after = records[:, 0:-1:2], records[:, 1::2], records[:, 2::2]
    return (before + 4.0 * middle + after) / 6.0, (after - before) / (2.0 * PER_RECORD * STEP_S)


def _ends(observed: Observed, span: Index, state: FloatArray) -> FloatArray:
    """Motion as the next span counts it."""
    q_body, q_shell = state[:, 6:10], state[:, 10:14]
    q = rotations.multiply(earth.q_ecef_eci(observed.start.time_s[span] + SPAN_S), q_body)
    turned = rotations.boxminus(q, observed.start.q_ecef_body[span + 1])
    bent = rotations.multiply(rotations.conjugate(q_body), q_shell)
    across = state[:, 17:20] - rotations.rotate(rotations.conjugate(bent), state[:, 14:17])
    return np.column_stack([turned, state[:, 14:17], rotations.log(bent), across])


PARTS = (1.0, 0.5, 0.25)  # of a step
LOOK_AHEAD = 0.1  # of a step, over which its curvature is taken
# shares of the diagonal that are added, until a step falls by a fair part of what an undamped one promises
DAMPINGS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3)
FIRST_DAMPING, MOST_DAMPING, FAIR = 1e-2, 1e3, 0.5


@dataclass(frozen=True)
class Normal:
    """Normal equations of a step, scaled to a diagonal of one."""

    matrix: FloatArray
    right: FloatArray

    @cached_property
    def scale(self) -> FloatArray:
        """One over the root of the diagonal."""
        return np.asarray(1.0 / np.sqrt(np.diag(self.matrix)))

    def factor(self, damping: float) -> FloatArray:
        """Lower Cholesky factor of the scaled matrix with a share of the diagonal added."""
        scaled = self.matrix * self.scale[:, None] * self.scale
        scaled[np.diag_indices_from(scaled)] += damping
        return np.asarray(cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)[0])

    @cached_property
    def undamped(self) -> FloatArray:
        """Factor of the matrix as it is."""
        return self.factor(0.0)

    def solver(self, damping: float) -> Callable[[FloatArray], FloatArray]:
        """Solver of the equations with a share of the diagonal added."""
        factor, scale = self.factor(damping) if damping else self.undamped, self.scale
        return lambda right: np.asarray((cho_solve((factor, True), (right.T * scale).T).T * scale).T)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of the equations."""
        return self.solver(0.0)(right)

    @property
    def covariance(self) -> FloatArray:
        """Of all unknowns."""
        return self.solve(np.eye(len(self.right)))

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant."""
        return float(2.0 * (np.log(np.diag(self.undamped)).sum() - np.log(self.scale).sum()))


@dataclass(frozen=True)
class Step:
    """Where a step leads, by how much the cost may still fall by the linear problem, residuals there, its equations."""

    to: Unknowns
    promised: float
    residuals: Residuals
    normal: Normal


def step_from(problem: Problem, u: Unknowns) -> Step:
    """Take the best of some damped, corrected steps.

    Raises
    ------
    DivergenceError
        Where the candidate cannot be flown.
    """
    linear = problem.linear(u)
    if not np.isfinite(linear.found.cost):
        raise DivergenceError(
            "reconciliation: a span of the flight cannot be flown with the vehicle as told: its joint diverges; give "
            "a stiffer joint in the vehicle file to start from"
        )
    normal = Normal(*problem.normal(u, linear))
    promised = float(normal.solve(normal.right) @ normal.right)
    best = linear.found, u
    for damping in DAMPINGS:
        best = _better(problem, u, linear, normal, damping, best)
        if linear.found.cost - best[0].cost > FAIR * promised:
            break
    damping = FIRST_DAMPING
    while best[0].cost >= linear.found.cost and damping < MOST_DAMPING:
        best = _better(problem, u, linear, normal, damping, best)
        damping *= 10.0
    return Step(best[1], promised, best[0], normal)


def _better(
    problem: Problem,
    u: Unknowns,
    linear: Linear,
    normal: Normal,
    damping: float,
    best: tuple[Residuals, Unknowns],
) -> tuple[Residuals, Unknowns]:
    """Return the lowest of the best so far and parts of one corrected step."""
    solved = normal.solver(damping)
    step = solved(normal.right)
    ahead, behind = (problem.residuals(u.moved(side * LOOK_AHEAD * step)) for side in (1.0, -1.0))
    bent = solved(
        linear.back(
            (ahead.sensors - 2.0 * linear.found.sensors + behind.sensors) / LOOK_AHEAD**2,
            (ahead.joins - 2.0 * linear.found.joins + behind.joins) / LOOK_AHEAD**2,
        )
    )
    # a bent path, of which the straight part alone may go too far
    paths = [part * step + 0.5 * part**2 * bent for part in PARTS if np.isfinite(bent).all()] or [step]
    return min([best, *((problem.residuals(end), end) for end in map(u.moved, paths))], key=lambda pair: pair[0].cost)

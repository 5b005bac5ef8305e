"""Which parameters of joint, vehicle, instruments, atmosphere and motion fit the measurements best? Gauss-Newton steps.

The flight is cut into spans, each flown from a motion of its own (multiple shooting: a flight of fifty seconds depends
on its start so strongly that a fit of it stops in one of many false minima). Minimised over all parameters together is

    | (sensors - predicted) / sd |^2 + | (end of a span - start of the next) / sd |^2 + | a priori residuals |^2

Ends and starts differ by what atmospheric structure between its knots does to the motion (process noise of the joins).
A step is Gauss-Newton's with the second-order correction of geodesic acceleration, since the valley is long and curved
(stiffness, inertias and stability nearly scale together); it is damped where the curvature is larger than that.

References
----------
H. G. Bock, "Recent advances in parameter identification techniques for O.D.E.", 1983 (multiple shooting).
M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization", 2012 (geodesic acceleration).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flightmodel.arrow import Arrow
from flightmodel.checks import BoolArray, DivergenceError, FloatArray
from postflight.reconciliation.forward_model import (
    ATTITUDE,
    CREEP,
    FINE,
    MOTION,
    RATE,
    SPAN_S,
    STIFFNESS_LOG_SD,
    VELOCITY,
    AtmosphereParameters,
    Index,
    Measurements,
    MovedRows,
    PredictedSpans,
    SpanFlights,
    TrialVehicle,
    VehicleParameters,
    fly_spans,
    integrable,
)
from postflight.reconciliation.normal_equations import NormalEquations, add_part
from synthetic_flight import simulate
from synthetic_flight.dynamics import joint_modes

INSTRUMENTS = 20
CONSTANT = 3  # rows of the normal equations: the sounding's errors that are constant in density, north and east wind
# process noise of the joins per rad of flow angle that turbulence between knots GUST_KNOT_M apart makes, at the largest
# dynamic pressure: rotation rad, rate rad/s, deflection rad, its rate rad/s, velocity m/s (of a span's lateral force);
# and the noise that is left in vacuum
GUST = np.array([0.3, 0.3, 0.3, 3.0, 3.0, 3.0, 0.0, 0.3, 0.3, 0.0, 9.0, 9.0, 24.0, 24.0, 24.0])
VACUUM_SD = np.append(
    np.deg2rad([0.001, 0.001, 0.001, 0.003, 0.003, 0.003, 1e-4, 0.001, 0.001, 0.03, 0.01, 0.01]), [1e-3, 1e-3, 1e-3]
)
GUST_KNOT_M = 300.0
MOTION_STEP = np.append(np.deg2rad(np.repeat([2e-5, 5e-5, 2e-5, 2e-4], 3)), [1e-3, 1e-3, 1e-3])
LEAST_COMPLIANCE = 0.5  # of a joint's compliance: a step that lessens it by more is shortened
VEHICLE_STEP, AIR_STEP = 1e-5, np.array([1e-6, 2e-4, 2e-4, 1e-2])


@dataclass(frozen=True)
class Parameters:
    """All parameters: vehicle (v,), instruments (20,), air (3, k), temperature (n,), motion at starts (s, 15 or 17)."""

    vehicle: FloatArray
    instruments: FloatArray
    air: FloatArray
    warmer_k: FloatArray
    motion: FloatArray

    def plus(self, step: FloatArray) -> Parameters:
        """Parameters moved by a step (n,) of all of them in this order, the stiffness by `stiffness_step`."""
        return self.straight(np.concatenate([[stiffness_step(float(step[0]))], step[1:]]))

    def straight(self, step: FloatArray) -> Parameters:
        """Parameters with a step (n,) added."""
        parts = (self.vehicle, self.instruments, self.air, self.warmer_k, self.motion)
        ends = np.cumsum([part.size for part in parts])[:-1]
        return Parameters(*(p + d.reshape(p.shape) for p, d in zip(parts, np.split(step, ends), strict=True)))


def stiffness_step(step: float) -> float:
    """Change of the stiffness parameter for a step that is linear in the compliance.

    Deflections, and with them the measurements, follow the compliance 1/K: by its logarithm a step from a joint that is
    too stiff would be many times too long. Compliance stays positive: below `LEAST_COMPLIANCE` of what it was it falls
    as an exponential, with the slope that it has there.
    """
    change = STIFFNESS_LOG_SD * step
    edge = 1.0 - LEAST_COMPLIANCE
    log_softer = np.log1p(-change) if change < edge else np.log(LEAST_COMPLIANCE) - (change - edge) / LEAST_COMPLIANCE
    return float(-log_softer / STIFFNESS_LOG_SD)


@dataclass(frozen=True)
class Residuals:
    """In sd: sensors (s, WINDOWS, 6), joins (s - 1, 15 or 17); ``cost``: sum of squares with priors."""

    sensors: FloatArray
    joins: FloatArray
    cost: float


@dataclass(frozen=True)
class Linearization:
    """Residuals and minus their derivatives by the parameters: columns and responses, span by span."""

    residuals: Residuals
    sensors: list[tuple[Index, FloatArray]]
    joins: list[tuple[Index, FloatArray]]
    count: int

    def transpose_times(self, sensors: FloatArray, joins: FloatArray) -> FloatArray:
        """Transpose of the derivatives times numbers laid out as the residuals."""
        out = np.zeros(self.count)
        for parts, values in ((self.sensors, sensors), (self.joins, joins)):
            for (column, response), value in zip(parts, values, strict=True):
                out[column] += response.T @ value.ravel()
        return out


@dataclass(frozen=True)
class Problem:
    """Least-squares problem of one flight.

    Parameters
    ----------
    measured : Measurements
    vehicle_parameters : VehicleParameters
    air : AtmosphereParameters
    held : tuple of str
        Parameters of the vehicle that no step moves.
    sd_factor : float or (s,) float
        Factor on all standard deviations, or on each span's.
    creep_per_s : float
        Delayed compliance over the spring's and over the time constant: how fast creep follows a gust.
    step_error : PredictedSpans, optional
        What fine integration steps predict, less what the problem's own do: of windows and ends.
    """

    measured: Measurements
    vehicle_parameters: VehicleParameters
    air: AtmosphereParameters
    held: tuple[str, ...] = ()
    sd_factor: float | FloatArray = 1.0
    creep_per_s: float = 0.0
    step_error: PredictedSpans | None = None

    @property
    def first_instrument(self) -> int:
        """Column of the first instrument parameter; the air's follow them."""
        return len(self.vehicle_parameters.names)

    @property
    def first_temperature(self) -> int:
        """Column of the first temperature."""
        return self.first_instrument + INSTRUMENTS + 3 * len(self.air.knots_m)

    @property
    def first_motion(self) -> int:
        """Column of the first motion parameter."""
        return self.first_temperature + len(self.air.temperature_knots_m)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.first_motion + self.motion * self.measured.spans

    @property
    def motion(self) -> int:
        """Numbers of the motion at a span's start."""
        return self.vehicle_parameters.motion

    @cached_property
    def turbulence_rad(self) -> FloatArray:
        """Flow angle (s,), rad, from atmospheric structure between the knots, times pressure over its largest value.

        The structure between two knots acts for a time that grows with their spacing, and at random from one stretch to
        the next: its effect over a span grows, per angle, with the root of the spacing (docs/reconciliation.md).
        """
        measured = self.measured
        correlated = np.sqrt(self.air.knot_spacing_m(measured.altitude_m) / GUST_KNOT_M)
        density, wind = self.air.unresolved_structure(measured.altitude_m)
        speed = np.linalg.norm(measured.start.velocity_ecef_mps[:-1], axis=1)
        load = measured.dynamic_pressure_pa / measured.dynamic_pressure_pa.max()
        # density structure rotates the vehicle at angles of attack of 5 deg
        return np.asarray(load * correlated * np.hypot(wind / speed, density * np.deg2rad(5.0)))

    @cached_property
    def data(self) -> FloatArray:
        """Windows (s, WINDOWS, 6) as measured; zero where data are missing."""
        return np.nan_to_num(np.concatenate([self.measured.rate_radps, self.measured.specific_force_mps2], axis=2))

    @cached_property
    def weight(self) -> FloatArray:
        """Inverse standard deviations of the windows (s, WINDOWS, 6), zero where data are missing."""
        measured = self.measured
        size = np.abs(measured.specific_force_mps2)
        density, _ = self.air.unresolved_structure(measured.altitude_m)
        gust = self.turbulence_rad[:, None, None]
        # what gusts do to the rates (2 1/s) and to the lateral force (60 m/s^2) is as if white from window to window
        rate_sd = np.hypot(measured.rate_sd_radps, 2.0 * gust) * np.ones_like(size)
        unresolved = np.hypot(density[:, None, None] * size, 60.0 * gust)
        force_sd = np.hypot(measured.force_sd_mps2, unresolved)
        weight = 1.0 / (self._sd_factors[:, None, None] * np.concatenate([rate_sd, force_sd], axis=2))
        return np.where(np.isfinite(measured.specific_force_mps2[..., :1]), np.nan_to_num(weight), 0.0)

    @cached_property
    def join_weight(self) -> FloatArray:
        """Inverse standard deviations (s - 1, motion) of the gaps between ends and next starts."""
        factor = np.maximum(self._sd_factors[:-1], self._sd_factors[1:])
        more = self.motion - MOTION
        # what a gust does to the deflection comes late for half a span on average
        late = 0.5 * SPAN_S * GUST[7] * self.creep_per_s
        gust, vacuum = np.append(GUST, [late] * more), np.append(VACUUM_SD, [np.deg2rad(2e-5)] * more)
        return np.asarray(1.0 / (factor[:, None] * np.hypot(gust * self.turbulence_rad[:-1, None], vacuum)))

    @property
    def motion_step(self) -> FloatArray:
        """Steps (motion,) for the numerical derivatives with respect to a span's start."""
        return np.append(MOTION_STEP, [np.deg2rad(2e-5)] * (self.motion - MOTION))

    @property
    def log_weight(self) -> float:
        """Sum of the logarithms of all weights, without prior terms common to all models of a flight."""
        first_creep = -np.log(self.first_creep_sd).sum()
        return float(np.log(self.weight[self.weight > 0.0]).sum() + np.log(self.join_weight).sum() + first_creep)

    @property
    def first_creep_sd(self) -> FloatArray:
        """A priori sd of the creep at the first start, rad, (2,) or empty; creep is bounded by the deflection."""
        return self.measured.first_deflection_sd[1 : 1 + self.motion - MOTION]

    @property
    def _sd_factors(self) -> FloatArray:
        return np.asarray(np.broadcast_to(self.sd_factor, self.measured.spans))

    def _passed(self, knots_m: FloatArray) -> list[Index]:
        """Numbers of the knots (k,) that each span passes."""
        z = self.measured.altitude_m
        reach = 0.55 * np.abs(np.gradient(z)) + 50.0
        apart = np.diff(knots_m, append=2 * knots_m[-1] - knots_m[-2])
        return [np.flatnonzero(np.abs(knots_m - at) < r + apart) for at, r in zip(z, reach, strict=True)]

    def first_precision(self, rows: slice) -> FloatArray:
        """Inverse covariance (3, 3) of the reconstructed path at the first start."""
        covariance = self.measured.start.covariance
        assert covariance is not None
        return np.asarray(np.linalg.inv(covariance[0, rows, rows]))

    def start(self) -> Parameters:
        """Nominal vehicle, instruments and sounding, motion as reconstructed."""
        motion = np.zeros((self.measured.spans, self.motion))
        motion[:, RATE] = self.measured.start.omega_body_eci_body_radps[:-1]
        air = np.zeros((3, len(self.air.knots_m)))
        warmer = np.zeros(len(self.air.temperature_knots_m))
        return Parameters(np.zeros(len(self.vehicle_parameters.names)), np.zeros(INSTRUMENTS), air, warmer, motion)

    def trial_vehicle(self, x: FloatArray) -> TrialVehicle:
        """Vehicle of parameters (v,) in standard deviations."""
        vehicle = integrable(self.vehicle_parameters.vehicle(x), self.measured.steps)
        return TrialVehicle(vehicle, simulate.parameter_vector(vehicle, *self.vehicle_parameters.factors(x)))

    def predict(self, u: Parameters) -> PredictedSpans:
        """Fly every span once; windows without the instruments' errors."""
        return self._predictions([u])[0]

    def with_fine_steps(self, u: Parameters) -> Problem:
        """Problem corrected at ``u`` to fine integration steps; changes near ``u`` are predicted as before.

        The twist is critically damped there: it follows its load as before, and does not ring from starts that were
        found with long steps.
        """
        nominal = self.vehicle_parameters.nominal
        inertia, _, stiffness = joint_modes(nominal)["torsion"]
        damped = nominal.joint.model_copy(update={"torsion_damping_nmsprad": 2.0 * float(np.sqrt(inertia * stiffness))})
        calm = replace(self.vehicle_parameters, nominal=replace(nominal, joint=damped))
        fine_steps = replace(self.measured, steps=FINE)
        (fine,) = replace(self, measured=fine_steps, vehicle_parameters=calm, step_error=None)._flown([u])
        (own,) = self._flown([u])
        return replace(self, step_error=replace(fine, windows=fine.windows - own.windows, end=fine.end - own.end))

    def _predictions(self, trials: Sequence[Parameters]) -> list[PredictedSpans]:
        """`predict` of several parameters, side by side."""
        return [self._corrected(flown) for flown in self._flown(trials)]

    def _corrected(self, flown: PredictedSpans) -> PredictedSpans:
        """Predicted spans corrected for the error of the integration steps."""
        if self.step_error is None:
            return flown
        end = flown.end.copy()
        end[:, : self.step_error.end.shape[1]] += self.step_error.end  # a creep that came later has none
        return replace(flown, windows=flown.windows + self.step_error.windows, end=end)

    def _flown(self, trials: Sequence[Parameters]) -> list[PredictedSpans]:
        """Spans of several parameter sets with the problem's own steps, grouped by span so that they share its air."""
        spans, count = self.measured.spans, len(trials)
        number = np.tile(np.arange(count), spans)
        air, *others = [self.air.table(u.air, u.warmer_k) for u in trials]
        flights = SpanFlights(
            np.repeat(np.arange(spans), count), number, np.concatenate(np.stack([u.motion for u in trials], axis=1)),
            number, [self.trial_vehicle(u.vehicle) for u in trials], air, [MovedRows(0, table) for table in others],
        )  # fmt: skip
        flown = fly_spans(self.measured, self.vehicle_parameters.nominal, flights)
        return [flown.part(slice(k, None, count)) for k in range(count)]

    def instrument_response(self, predicted: PredictedSpans) -> FloatArray:
        """Response of the windows to the instruments' parameters, (s, WINDOWS, 6, 20).

        Scale and mounting errors act on the predicted motion, not on the measured one: on measured rates a gyro's scale
        would lower the cost by scaling the noise.
        """
        measured = self.measured
        rows = np.zeros((*predicted.windows.shape, INSTRUMENTS))
        for axes, columns, response in (
            (slice(0, 3), slice(0, 9), measured.rate_response),
            (slice(3, 6), slice(9, 18), measured.force_response),
        ):
            rows[..., axes, columns] = response[0] + np.tensordot(predicted.windows[..., axes], response[1:], axes=1)
        # a late time tag carries an earlier value
        rows[..., :3, 18] = -measured.clock_sd_s[0] * predicted.slope[..., :3]
        rows[..., 3:, 19] = -measured.clock_sd_s[1] * predicted.slope[..., 3:]
        return rows

    def sensed_change(self, u: Parameters, windows: FloatArray, slope: FloatArray) -> FloatArray:
        """Changes (..., 6) of the sensed windows by those of the predicted windows and of their slope."""
        measured = self.measured
        gain = np.eye(6)
        gain[:3, :3] += np.einsum("kij,j->ik", measured.rate_response[1:], u.instruments[0:9])
        gain[3:, 3:] += np.einsum("kij,j->ik", measured.force_response[1:], u.instruments[9:18])
        late = np.repeat(measured.clock_sd_s * u.instruments[18:20], 3)
        return np.asarray(windows @ gain.T - late * slope)

    def residuals(self, u: Parameters, predicted: PredictedSpans | None = None) -> Residuals:
        """Residuals of measurements, joins and priors; the cost is infinite if a span diverges."""
        predicted = predicted or self.predict(u)
        errors = self.instrument_response(predicted) @ u.instruments
        sensors = (self.data - predicted.windows - errors) * self.weight
        joins = (predicted.end[:-1] - u.motion[1:]) * self.join_weight
        with np.errstate(over="ignore", invalid="ignore"):  # a trial vehicle that tumbles
            total = float((sensors**2).sum() + (joins**2).sum()) + self.prior_cost(u)
        return Residuals(sensors, joins, total if np.isfinite(total) else np.inf)

    def residuals_of(self, trials: Sequence[Parameters]) -> list[Residuals]:
        """`residuals` of several parameters."""
        return [self.residuals(*each) for each in zip(trials, self._predictions(trials), strict=True)]

    def prior_cost(self, u: Parameters) -> float:
        """Sum of squares of the a priori residuals."""
        return sum(float(value @ precision @ value) for _, precision, value in self._priors(u))

    def linearize(self, u: Parameters, wanted: BoolArray | None = None) -> Linearization:
        """Residuals and their derivatives at ``u``, by forward differences of flown spans.

        With a mask ``wanted`` (count,) by those parameters alone, and by the instruments'.
        """
        flights, columns, steps = self._perturbed(u, np.ones(self.count, dtype=bool) if wanted is None else wanted)
        moved, base = fly_spans(self.measured, self.vehicle_parameters.nominal, flights), self._flown([u])[0]
        predicted = self._corrected(base)
        rows = self.instrument_response(predicted)
        at, sensors, joins = 0, [], []
        for span, (column, step) in enumerate(zip(columns, steps, strict=True)):
            part = slice(at, at := at + len(column))
            step[np.isin(column, self.held_columns)] = np.inf  # no step moves what is held
            change = self.sensed_change(
                u, moved.windows[part] - base.windows[span], moved.slope[part] - base.slope[span]
            )
            response = change / step[:, None, None] * self.weight[span]
            errors = (rows[span] * self.weight[span][..., None]).reshape(-1, INSTRUMENTS)
            both = np.concatenate([column, self.first_instrument + np.arange(INSTRUMENTS)])
            sensors.append((both, np.column_stack([response.reshape(len(step), -1).T, errors])))
            if span + 1 < self.measured.spans:
                ended = (moved.end[part] - base.end[span]) / step[:, None]
                following = self.first_motion + self.motion * (span + 1) + np.arange(self.motion)
                response = np.column_stack([-ended.T, np.eye(self.motion)]) * self.join_weight[span][:, None]
                joins.append((np.concatenate([column, following]), response))
        return Linearization(self.residuals(u, predicted), sensors, joins, self.count)

    def normal_equations(self, u: Parameters, linear: Linearization) -> NormalEquations:
        """Normal equations of a step from ``u``."""
        place, n, reach = self._arranged
        shared, knots, first_air = len(place) + CONSTANT - n, len(self.air.knots_m), self.first_instrument + INSTRUMENTS
        matrix = Arrow(np.zeros((reach + 1, n)), np.zeros((n, shared)), np.zeros((shared, shared)))
        for column, response in (*linear.sensors, *linear.joins):
            add_part(matrix.band, matrix.across, matrix.corner, place[column], response.T @ response)
        for part, precision, _ in self._priors(u):
            if not first_air <= part.start < self.first_temperature:
                add_part(matrix.band, matrix.across, matrix.corner, place[part], precision)
        for kind, (diagonal, beside, constant) in enumerate(self.air.inverse_covariance):
            at, border = place[first_air + kind * knots :][:knots], shared - CONSTANT + kind
            first, second = np.minimum(at[:-1], at[1:]), np.maximum(at[:-1], at[1:])
            matrix.band[0, at] += diagonal
            matrix.band[second - first, first] += beside
            matrix.across[at, border] = constant
            matrix.corner[border, border] = 1.0
        return NormalEquations(matrix, self.right_hand_side(u, linear, linear.residuals), place)

    @cached_property
    def _arranged(self) -> tuple[Index, int, int]:
        """Row (count,) of each parameter in the matrix, number of banded rows, and the bandwidth.

        First span by span the air that it is the first to pass, from above, and its motion; then vehicle, instruments,
        temperature, and a row for each kind of air. Air that no span passes comes before all spans, or after.
        """
        measured, free = self.measured, self.first_instrument + INSTRUMENTS
        warm, spans = self.first_motion - self.first_temperature, np.arange(self.measured.spans)
        passed = np.where(self.air.knots_m < measured.altitude_m.min(), len(spans), 0)
        for span in spans[::-1]:
            passed[self._passed_knots[span]] = span
        by_span = np.concatenate([np.tile(passed, 3), np.repeat(spans, self.motion)])
        deeper = np.concatenate([np.tile(-self.air.knots_m, 3), np.full(self.motion * len(spans), np.inf)])
        order = np.lexsort((deeper, by_span))
        local = np.empty_like(order)
        local[order] = np.arange(len(order))
        air, shared = 3 * len(self.air.knots_m), len(order) + np.arange(free + warm)
        place = np.concatenate([shared[:free], local[:air], shared[free:], local[air:]])
        reach = int(np.abs(np.diff(local[:air].reshape(3, -1), axis=1)).max())
        for span, near in enumerate(self._nearby_air):
            motions = local[air + self.motion * span :][: 2 * self.motion]  # its own and the next one's
            reach = max(reach, int(np.ptp(np.concatenate([local[near[near < air]], motions]))))
        return place, len(order), reach

    def right_hand_side(self, u: Parameters, linear: Linearization, residuals: Residuals) -> FloatArray:
        """Right-hand side of a step from ``u`` with its residuals, by derivatives at ``u`` or nearby."""
        right = linear.transpose_times(residuals.sensors, residuals.joins)
        for part, precision, value in self._priors(u):
            right[part] -= precision @ value
        right[self.held_columns] = 0.0
        return right

    @property
    def held_columns(self) -> list[int]:
        """Columns of the parameters that are held."""
        return [self.vehicle_parameters.names.index(name) for name in self.held]

    def _perturbed(self, u: Parameters, wanted: BoolArray) -> tuple[SpanFlights, list[Index], list[FloatArray]]:
        """Spans with each ``wanted`` parameter perturbed, its column and step, span by span."""
        v, m = self.first_instrument, self.motion
        vehicles = [self.trial_vehicle(u.vehicle + VEHICLE_STEP * unit) for unit in np.eye(v)]
        vehicles.append(self.trial_vehicle(u.vehicle))
        air = self.air.table(u.air, u.warmer_k)
        felt = np.unique(np.concatenate(self._nearby_air))
        moved, air_steps = self._moved_air(air, felt)
        first_air, own = v + INSTRUMENTS, self.first_motion + np.arange(m)
        columns, steps, motions = [], [], []
        numbers: list[Index] = []
        for span, near in enumerate(self._nearby_air):
            count = v + m + len(near)
            column = np.concatenate([np.arange(v), own + m * span, first_air + near])
            at = np.searchsorted(felt, near)
            step = np.concatenate([np.full(v, VEHICLE_STEP), self.motion_step, air_steps[at]])
            motion = np.tile(u.motion[span], (count, 1))
            motion[v : v + m] += np.diag(self.motion_step)
            table = np.concatenate([np.zeros(v + m, dtype=np.int64), 1 + at])
            number = np.stack([np.full(count, span), np.minimum(np.arange(count), v), table])
            kept = wanted[column]
            columns.append(column[kept])
            steps.append(step[kept])
            motions.append(motion[kept])
            numbers.append(number[:, kept])
        spans, which, table = np.concatenate(numbers, axis=1)
        return SpanFlights(spans, which, np.concatenate(motions), table, vehicles, air, moved), columns, steps

    def _moved_air(self, air: FloatArray, which: Index) -> tuple[list[MovedRows], FloatArray]:
        """Changed rows of kernel tables for perturbed air parameters (k,), counted from the first one; their steps."""
        knots = len(self.air.knots_m)
        kinds = np.minimum(which // knots, 3)
        steps = AIR_STEP[kinds]
        each = zip(kinds.tolist(), (which - knots * kinds).tolist(), steps.tolist(), strict=True)
        return [self.air.moved_rows(air, *one) for one in each], steps

    @cached_property
    def _passed_knots(self) -> list[Index]:
        return self._passed(self.air.knots_m)

    @cached_property
    def _nearby_air(self) -> list[Index]:
        """Air parameters, counted from the first one, that influence each span."""
        knots = len(self.air.knots_m)
        by_span = zip(self._passed_knots, self._passed(self.air.temperature_knots_m), strict=True)
        return [np.concatenate([near, knots + near, 2 * knots + near, 3 * knots + warm]) for near, warm in by_span]

    def _priors(self, u: Parameters) -> list[tuple[slice, FloatArray, FloatArray]]:
        """Columns of parameters, their a priori inverse covariance, their values."""
        free, knots, first = self.first_instrument + INSTRUMENTS, len(self.air.knots_m), self.first_motion
        return [
            (slice(0, free), np.eye(free), np.concatenate([u.vehicle, u.instruments])),
            *[
                (slice(free + kind * knots, free + (kind + 1) * knots), self.air.precision[kind], u.air[kind])
                for kind in range(3)
            ],
            (slice(self.first_temperature, first), self.air.temperature_precision, u.warmer_k),
            (slice(first, first + 3), self.first_precision(slice(6, 9)), u.motion[0, ATTITUDE]),
            (slice(first + 6, first + 12), np.diag(self.measured.first_deflection_sd**-2.0), u.motion[0, 6:12]),
            (slice(first + 12, first + MOTION), self.first_precision(slice(3, 6)), u.motion[0, VELOCITY]),
            (slice(first + MOTION, first + self.motion), np.diag(self.first_creep_sd**-2.0), u.motion[0, CREEP]),
        ]


LOOK_AHEAD = 0.1  # of a step, over which its curvature is taken
# predicted decrease by a step of one sd in all. A shorter one is not damped while it lowers the cost at all: what is
# left of its prediction is the coefficient table's kinks at its Mach numbers, which no damping takes away
KINKED = 1.0


@dataclass(frozen=True)
class Step:
    """Result of a step: parameters, predicted decrease of the cost, residuals there, and the normal equations."""

    end: Parameters
    predicted_decrease: float
    residuals: Residuals
    normal: NormalEquations


def step_from(problem: Problem, u: Parameters) -> Step:
    """Take the best of some damped steps with geodesic acceleration.

    Raises
    ------
    DivergenceError
        Where the spans cannot be flown with these parameters.
    """
    linear = problem.linearize(u)
    right = linear.transpose_times(linear.residuals.sensors, linear.residuals.joins)
    if not (np.isfinite(linear.residuals.cost) and np.isfinite(right).all()):
        raise DivergenceError(
            "reconciliation: a span of the flight cannot be flown with the vehicle file's joint, which diverges; give "
            "a stiffer joint in the vehicle file to start from",
            code="joint-diverges",
        )
    normal = problem.normal_equations(u, linear)
    predicted_decrease = float(normal.solve(normal.right) @ normal.right)
    best = linear.residuals, u
    # shares of the diagonal that are added, until the cost falls by half of the undamped step's predicted decrease
    for damping in (0.0, 1e-6, 1e-5, 1e-4, 1e-3):
        best = _better(problem, u, linear, normal, damping, best)
        if linear.residuals.cost - best[0].cost > 0.5 * predicted_decrease or predicted_decrease < KINKED:
            break
    damping = 1e-2
    while best[0].cost >= linear.residuals.cost and damping < 1e3:
        best = _better(problem, u, linear, normal, damping, best)
        damping *= 10.0
    return Step(best[1], predicted_decrease, best[0], normal)


def _better(
    problem: Problem,
    u: Parameters,
    linear: Linearization,
    normal: NormalEquations,
    damping: float,
    best: tuple[Residuals, Parameters],
) -> tuple[Residuals, Parameters]:
    """Return the lowest-cost step among the best so far and fractions of one step with its curvature."""
    solved = normal.solver(damping)
    step = solved(normal.right)
    ahead, behind = problem.residuals_of([u.plus(side * LOOK_AHEAD * step) for side in (1.0, -1.0)])
    bend = linear.transpose_times(
        (ahead.sensors - 2.0 * linear.residuals.sensors + behind.sensors) / LOOK_AHEAD**2,
        (ahead.joins - 2.0 * linear.residuals.joins + behind.joins) / LOOK_AHEAD**2,
    )
    paths = [step]
    if np.isfinite(bend).all():
        # a curved path, whose straight part alone may go too far
        curvature = solved(bend)
        paths = [part * step + 0.5 * part**2 * curvature for part in (1.0, 0.5, 0.25)]
    ends = [u.plus(path) for path in paths]
    return min([best, *zip(problem.residuals_of(ends), ends, strict=True)], key=lambda pair: pair[0].cost)


def descend(
    problems: Iterable[Problem],
    start: Parameters,
    correct: Callable[[Problem, Parameters], Parameters] | None = None,
) -> Iterator[Step]:
    """Take one step on each problem in turn, each starting from the end of the previous one.

    Parameters
    ----------
    problems : iterable of Problem
    start : Parameters
    correct : callable, optional
        Improves the parameters of a problem before each step.

    Yields
    ------
    Step
    """
    end = start
    for problem in problems:
        step = step_from(problem, correct(problem, end) if correct else end)
        end = step.end
        yield step

"""What does one method read of the deflection, and on which uncertain inputs do its readings depend?

Every method reads the deflection with an error that is linear in named inputs, which several methods share (the flow's
angle, coefficients, masses, the accelerometer's errors), and in the oscillation of the joint::

    read(t) = theta(t) + B(t) theta'(t) + A(t) theta''(t) - sum over inputs J_i(t) x_i + independent error

with ``x_i ~ N(0, 1)``. The methods that read the loads balance forces or moments (`estimators.balance`): with what is
left of a balance ``r``, linear about a deflection, a reading is ``theta - (dr/dtheta)^-1 r`` (`evidence_of_balance`).

Each input is scaled to unit normals: ``J`` is the change of the reading per standard deviation of the input. An input
with a history (wind, attitude) is many unit normals, each with its own course over time. Inputs of the same name are
the same random variables in all methods: that is all of their correlation. The readings are curved functions of the
worst known coefficient: the curvature shifts the mean of the deflection and widens it.

The flow's error has three parts: that of the inertial sensors' constant errors (estimated together with the attitude,
and rolling with the vehicle), the rest of the trajectory's, and the wind's. The last two do not roll with the vehicle:
they are written in axes across the flow that do not roll about it. The body rolls about the flow, which meets it at the
angle ``alpha`` from the side of the unit vector ``e``, at the rate (that of the twist about a fixed direction)

    w . (x + v) / (1 + x . v) = w_x + tan(alpha / 2) e . w_yz,        v = x cos(alpha) + e sin(alpha)

A body that cones by 25 deg goes on by 34 deg about the flow for every turn by its own gyro, and a steady wind looks to
the latter as one that turns. The trajectory's is a Gauss-Markov process with the correlation time
`TRAJECTORY_TIME_S`; the wind's is constant bias, gravity waves and gusts along the altitude (`wind_error_root`); the
density's in the dynamic pressure half constant, half Gauss-Markov with the correlation length `DENSITY_LENGTH_M`.

Accelerometer and gyros have time biases of a millisecond or so: what oscillates is read late, and what the gyros carry
from the accelerometer to the c.g. does not match the force. The camera's time bias is relative to both.

Assumed: small errors, so that responses add; Gaussian priors of the stated standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.ndimage import uniform_filter1d

from estimators.balance import Swing
from estimators.loads import FlightLoads, lateral_and_size
from flightmodel import rotations
from flightmodel.atmosphere import DENSITY_LENGTH_M, sounding_correlation_root, wind_error_root
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import (
    QUANTILES,
    DeflectionHistory,
    drawn_together,
    history_from_lateral,
    length_quantiles,
    standard_normals,
)
from flightmodel.statistics import correlation_root, correlation_root_and_rest, symmetric_root
from flightmodel.vehicle import Vehicle

CONSTANT_PART, TRAJECTORY_TIME_S = 0.5, 20.0  # assumed: half of the variance lasts, half decorrelates, as the air's
# with three knots in this time, frames between two of them could err as a straight line only: the rest of the error
# looked like the deflection's motion, and without spin like a c.g. station 4 sd off
LIGHT_TIME_S, _LIGHT_KNOTS_A_TIME = 2.5, 10
ACCELEROMETER, ATTITUDE, WIND, PRESSURE = "accelerometer", "BET attitude", "wind", "dynamic pressure"
CAMERA_TIME_BIAS = "camera time bias"
ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS = "accelerometer time bias", "gyro time bias"
CAMERA_PLANE = "camera clocking"
Residual = Callable[[Vehicle, Swing, FlightLoads], FloatArray]
_NEWTON_STEPS, _SETTLED_RAD = 6, 1e-6  # from the small angles' solution four suffice
# steps of differences: of deflection and flow, the deflection's rate, angular accelerations, force, log pressure
_THETA_RAD, _RATE_RADPS, _TURN_RADPS2, _FORCE_MPS2, _PRESSURE = 1e-5, 1e-3, 1e-2, 1e-4, 1e-4
_OF_SD = 0.01  # of a vehicle's input
_LEAST_DETERMINANT = 1e-9  # of a balance's derivative by the deflection: of a force 1, of a moment some 0.1 m^2
_LEAST_VAR = 1e-16  # rad^2, so that a root exists where nothing errs
_OSCILLATION_WINDOW_S = 2.0  # about a period of the slow aerodynamic mode, over which the joint's is averaged
_FROM_BEHIND_RAD = np.deg2rad(170.0)  # where the flow comes from no side that lasts, the roll about it goes to infinity
_BODIES = ("aeroshell", "centerbody")
VEHICLE_INPUTS = (
    "C_A",
    "C_N",
    "C_m",
    "C_mq",
    *(f"{body} {what}" for body in _BODIES for what in ("mass", "c.g. station", "roll inertia", "pitch inertia")),
    *(f"centerbody product {axes}" for axes in ("xy", "xz")),
    "initial offset y",
    "initial offset z",
)


class Deflection(Protocol):
    """Lateral deflection vectors (n, 2), rad, at times, or a derivative of them by time."""

    def __call__(self, time_s: FloatArray, derivative: int = 0, /) -> FloatArray:
        """Vectors or derivatives at times."""


@dataclass(frozen=True)
class Evidence:
    """Readings of one method at the times it answers; see the module's equation.

    Parameters
    ----------
    method : str
    time_s : (n,) float
    theta_yz_rad : (n, 2) float
        Lateral deflection vectors in body y, z.
    by_rate_s, by_acceleration_s2 : (n, 2, 2) float
        ``B``, ``A``: reading per angular rate and acceleration of the joint.
    by_input : dict of str to (n, 2, k) float
        ``J``, rad per unit normal.
    independent_cov : (n, 2, 2) float
        Error that no other sample and no other method shares, rad^2.
    averaged_s : float
        Span over which readings may be averaged without loss of information, s.
    bend : (n, 2) float or None
        Half the second derivative of the reading by its most uncertain input, rad; None: negligible.
    time_bias_sd_s : float
        A priori sd of the time bias of ``time_s`` against the gyros' time tags, s; zero: the same clock.
    time_bias : str
        Name of that input: films of several cameras have one each.
    """

    method: str
    time_s: FloatArray
    theta_yz_rad: FloatArray
    by_rate_s: FloatArray
    by_acceleration_s2: FloatArray
    by_input: dict[str, FloatArray]
    independent_cov: FloatArray
    averaged_s: float
    half_curvature_rad: FloatArray | None = None
    time_bias_sd_s: float = 0.0
    time_bias: str = CAMERA_TIME_BIAS

    @property
    def mean_yz_rad(self) -> FloatArray:
        """Mean ``(n, 2)`` of the deflection over the inputs' distribution."""
        return self.theta_yz_rad if self.half_curvature_rad is None else self.theta_yz_rad + self.half_curvature_rad

    @property
    def covariance(self) -> FloatArray:
        """Covariance ``(n, 2, 2)`` of every sample by itself, the joint at rest."""
        total = self.independent_cov.copy()
        for response in self.by_input.values():
            total += response @ response.transpose(0, 2, 1)
        if self.half_curvature_rad is not None:
            total += 2.0 * self.half_curvature_rad[:, :, None] * self.half_curvature_rad[:, None, :]
        return total


def flow_inputs(loads: FlightLoads) -> dict[str, FloatArray]:
    """Flow's error ``(n, 2, k)``, rad, per unit normal, by the name of each of its three parts."""
    root, wind = loads.flow_root_rad, loads.wind_flow_sd_rad
    left = loads.flow_cov - root @ root.transpose(0, 2, 1) - (wind**2)[:, None, None] * np.eye(2)
    trajectory = np.sqrt(np.maximum(0.5 * np.trace(left, axis1=1, axis2=2), 0.0))
    roll = _roll(loads)
    c, s = np.cos(roll), np.sin(roll)
    # body components of vectors that do not roll
    body_from_fixed = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=1)
    gusts = wind_error_root(loads.altitude_m)
    return {
        ACCELEROMETER: root,
        ATTITUDE: _rolled(body_from_fixed, trajectory[:, None] * correlation_root(loads.time_s, TRAJECTORY_TIME_S)),
        WIND: _rolled(body_from_fixed, wind[:, None] * gusts),
    }


def pressure_input(loads: FlightLoads) -> FloatArray:
    """Dynamic pressure's error ``(n, k)``, a fraction, per unit normal."""
    relative = loads.dynamic_pressure_sd_pa / loads.dynamic_pressure_pa
    return np.asarray(relative[:, None] * sounding_correlation_root(loads.altitude_m, DENSITY_LENGTH_M))


def delayed(loads: FlightLoads, force_s: float, rate_s: float) -> FlightLoads:
    """Loads with accelerometer and gyros read so much later, to first order: corrected for these time biases, s.

    With the gyros go the attitude, and so the flow's angle, and the lever-arm acceleration from the accelerometer to
    the c.g.; pressure and Mach number change too slowly to matter.
    """
    t = loads.time_s
    if force_s == rate_s == 0.0 or len(t) < 2:
        return loads
    from scipy.interpolate import CubicSpline  # a fifth of a second to import, for those who fuse alone

    def later(values: FloatArray, late_s: float) -> FloatArray:
        return values if late_s == 0.0 else np.asarray(values + late_s * CubicSpline(t, values)(t, 1))

    force, flow = loads.specific_force_body_mps2, loads.flow_yz_rad
    rate, turn = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    arm = rotations.lever_arm_acceleration(rate, turn, loads.cg_from_sensor_m)
    return replace(
        loads,
        specific_force_body_mps2=later(force - arm, force_s) + later(arm, rate_s),
        flow_yz_rad=later(flow, rate_s),
        rate_body_radps=later(rate, rate_s),
        angular_acceleration_body_radps2=later(turn, rate_s),
    )


def _rolled(body_from_fixed: FloatArray, columns: FloatArray) -> FloatArray:
    """Body components ``(n, 2, 2 k)`` of two like histories (n, k), one an axis that does not roll."""
    n, k = columns.shape
    return np.asarray(np.einsum("nij,nk->nijk", body_from_fixed, columns).reshape(n, 2, 2 * k))


def _roll(loads: FlightLoads) -> FloatArray:
    """Roll (n,) about the flow since the first sample, rad."""
    e, alpha = lateral_and_size(loads.flow_yz_rad)
    w, step = loads.rate_body_radps, np.diff(loads.time_s)
    rate = w[:, 0] + np.tan(0.5 * np.minimum(alpha, _FROM_BEHIND_RAD)) * np.sum(e * w[:, 1:], axis=1)
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])


def offset_sd_m(vehicle: Vehicle) -> float:
    """Standard deviation, m, of the initial c.g. offset, each axis, as a shift of the centerbody's c.g."""
    masses = np.array([getattr(vehicle, name).mass_kg for name in _BODIES])
    return float(vehicle.uncertainty.cg_lateral_m * np.hypot(*masses) / masses[1])


def moved_vehicle(vehicle: Vehicle, moved: dict[str, float]) -> Vehicle:
    """Vehicle with its uncertain inputs moved by so many standard deviations, by the inputs' names.

    Stated uncertainties of mass, c.g. and inertia are each body's own, of its roll and of its two transverse moments;
    the lateral c.g.s of both bodies act together as the initial offset, taken as the centerbody's.
    """
    known, side = vehicle.uncertainty, offset_sd_m(vehicle)
    bodies = {}
    for name in _BODIES:
        body = getattr(vehicle, name)
        x, y, z = body.cg_from_datum_body_m
        x -= moved.get(f"{name} c.g. station", 0.0) * known.cg_station_m
        if name == "centerbody":
            y += moved.get("initial offset y", 0.0) * side
            z += moved.get("initial offset z", 0.0) * side
        inertia = body.inertia.copy()
        for k, what in enumerate(("roll inertia", "pitch inertia", "pitch inertia")):
            inertia[k, k] *= 1.0 + moved.get(f"{name} {what}", 0.0) * known.inertia
        if name == "centerbody":
            size = 0.5 * known.inertia_products * (body.inertia[1, 1] + body.inertia[2, 2])
            for k, axes in ((1, "xy"), (2, "xz")):
                inertia[0, k] += size * moved.get(f"centerbody product {axes}", 0.0)
                inertia[k, 0] = inertia[0, k]
        mass = body.mass_kg * (1.0 + moved.get(f"{name} mass", 0.0) * known.mass)
        bodies[name] = body.model_copy(
            update={
                "mass_kg": float(mass),
                "cg_from_datum_body_m": (x, y, z),
                "inertia_kgm2": tuple(map(tuple, inertia.tolist())),
            }
        )
    ca, cn, cm = (1.0 + moved.get(k, 0.0) * sd for k, sd in (("C_A", known.ca), ("C_N", known.cn), ("C_m", known.cm)))
    return replace(vehicle, aero=vehicle.aero.scaled(ca, cn, cm, moved.get("C_mq", 0.0) * known.cmq), **bodies)


def held_balance(residual: Residual, loads: FlightLoads, start_yz_rad: FloatArray) -> Swing:
    """Deflection that balances every sample with the joint at rest, by Newton's method; NaN where it does not settle.

    ``start_yz_rad`` (n, 2) may hold NaN: no answer there.
    """
    vehicle = loads.vehicle
    theta = np.where(np.isfinite(start_yz_rad), start_yz_rad, 0.0)
    change = np.zeros_like(theta)
    for _ in range(_NEWTON_STEPS):
        base = residual(vehicle, Swing.held(theta), loads)
        moved = [residual(vehicle, Swing.held(theta + _THETA_RAD * e), loads) - base for e in np.eye(2)]
        inverse, good = _inverse(np.stack(moved, -1) / _THETA_RAD)
        change = np.where(good[:, None], (inverse @ base[:, :, None])[:, :, 0], np.inf)
        theta = np.where(good[:, None], theta - change, theta)
    settled: BoolArray = np.asarray(
        np.isfinite(start_yz_rad).all(axis=1) & (np.linalg.norm(change, axis=1) < _SETTLED_RAD)
    )
    return Swing.held(np.where(settled[:, None], theta, np.nan))


def _inverse(matrices: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Inverses of (n, 2, 2) and mask of those that exist; singular ones become the identity."""
    size = np.linalg.det(matrices)
    good: BoolArray = np.asarray(np.isfinite(size) & (np.abs(size) > _LEAST_DETERMINANT))
    return np.asarray(np.linalg.inv(np.where(good[:, None, None], matrices, np.eye(2)))), good


def evidence_of_balance(
    method: str,
    residual: Residual,
    loads: FlightLoads,
    swing: Swing,
    averaged_s: float,
    with_inputs: bool = True,
) -> Evidence:
    """Readings of a method that balances the loads, linear about a swing, with their responses to uncertain inputs.

    Parameters
    ----------
    method : str
    residual : callable
        What is left of the balance (n, 2), of a vehicle, a swing and loads.
    loads : FlightLoads
        Of the samples to read.
    swing : Swing
    averaged_s : float
        As in `Evidence`.
    with_inputs : bool
        False leaves the responses to inputs and the noise out.
    """
    vehicle = loads.vehicle
    known: BoolArray = np.asarray(np.isfinite(swing.theta_yz_rad).all(axis=1))
    swing = replace(swing, theta_yz_rad=np.where(known[:, None], swing.theta_yz_rad, 0.0))

    def left(one: FlightLoads = loads, of: Vehicle = vehicle, at: Swing = swing) -> FloatArray:
        return residual(of, at, one)

    base = left()

    by_theta, by_rate, by_turn = swing_responses(lambda at: left(at=at), swing, base)
    solve, good = _inverse(by_theta)
    known = np.asarray(known & good)
    by_rate, by_turn = solve @ by_rate, solve @ by_turn
    read = swing.theta_yz_rad - (solve @ base[:, :, None])[:, :, 0]
    read += np.einsum("nij,nj->ni", by_rate, swing.rate_yz_radps)
    read += np.einsum("nij,nj->ni", by_turn, swing.acceleration_yz_radps2)

    inputs: dict[str, FloatArray] = {}
    noise = np.zeros((len(base), 2, 2))
    if with_inputs:
        inputs, noise = input_responses(left, loads, base, solve)
    read = np.where(known[:, None], read, np.nan)
    return Evidence(method, loads.time_s, read, by_rate, by_turn, inputs, noise, averaged_s)


def swing_responses(
    left: Callable[[Swing], FloatArray], swing: Swing, base: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Jacobian (n, c, 2) of the balance residual (n, c) with respect to deflection, rate and acceleration."""
    none = np.zeros(2)

    def by(step: float, moved: Callable[[FloatArray], Swing]) -> FloatArray:
        return np.stack([(left(moved(step * e)) - base) / step for e in np.eye(2)], -1)

    return (
        by(_THETA_RAD, lambda by_so_much: swing.moved(by_so_much, none, none)),
        by(_RATE_RADPS, lambda by_so_much: swing.moved(none, by_so_much, none)),
        by(_TURN_RADPS2, lambda by_so_much: swing.moved(none, none, by_so_much)),
    )


def input_responses(
    left: Callable[..., FloatArray], loads: FlightLoads, base: FloatArray, solve: FloatArray
) -> tuple[dict[str, FloatArray], FloatArray]:
    """Responses of readings to every uncertain input, and the covariance of their own noise.

    Parameters
    ----------
    left : callable
        What is left of a balance (n, c), of loads and, as ``of``, of a vehicle.
    loads : FlightLoads
    base : (n, c) float
        What is left of it as things are.
    solve : (n, c, c) float
        A reading is ``-solve @ left``.

    Returns
    -------
    dict of str to (n, c, k) float
        Per unit normal of each input that a reading responds to.
    (n, c, c) float
    """

    def history(name: str, step: float) -> FloatArray:
        """Response ``(n, c, 3)`` of the reading to a measured vector."""
        values = getattr(loads, name)
        moved = [left(replace(loads, **{name: values + step * e})) for e in np.eye(values.shape[1])]
        return np.asarray(-solve @ np.stack([(m - base) / step for m in moved], -1))

    by_force = history("specific_force_body_mps2", _FORCE_MPS2)
    noise = loads.force_noise_sd_mps2**2 * by_force @ by_force.transpose(0, 2, 1)
    if loads.angular_acceleration_sd_radps2 > 0.0:
        by_turning = history("angular_acceleration_body_radps2", _TURN_RADPS2)
        noise += loads.angular_acceleration_sd_radps2**2 * by_turning @ by_turning.transpose(0, 2, 1)
    by_flow = history("flow_yz_rad", _THETA_RAD)
    inputs = {name: by_flow @ part for name, part in flow_inputs(loads).items()}
    own = by_force @ loads.force_root_mps2 + history("rate_body_radps", _RATE_RADPS) @ loads.rate_root_radps
    inputs[ACCELEROMETER] = inputs[ACCELEROMETER] + own
    return inputs | _other_inputs(loads, base, solve, left), noise


def _other_inputs(
    loads: FlightLoads, base: FloatArray, solve: FloatArray, left: Callable[..., FloatArray]
) -> dict[str, FloatArray]:
    """Responses (n, 2, k) to time biases, dynamic pressure and the vehicle's inputs; none that is nothing."""
    out = {}
    biases = {
        ACCELEROMETER_TIME_BIAS: (loads.accelerometer_time_bias_sd_s, 0.0),
        GYRO_TIME_BIAS: (0.0, loads.gyro_time_bias_sd_s),
    }
    for name, late_s in biases.items():
        if any(late_s):
            out[name] = (left(delayed(loads, *late_s)) - base)[:, :, None]
    denser = replace(loads, dynamic_pressure_pa=loads.dynamic_pressure_pa * (1.0 + _PRESSURE))
    by_pressure = (left(denser) - base) / _PRESSURE
    out[PRESSURE] = by_pressure[:, :, None] * pressure_input(loads)[:, None, :]
    for name in VEHICLE_INPUTS:
        # slightly curved, and to be linear at the vehicle as stated
        out[name] = (left(of=moved_vehicle(loads.vehicle, {name: _OF_SD})) - base)[:, :, None] / _OF_SD
    return {name: -solve @ response for name, response in out.items() if response.any()}


def evidence_of_history(history: DeflectionHistory, time_bias_sd_s: float = 0.0, plane_sd_rad: float = 0.0) -> Evidence:
    """Evidence from a history alone, e.g. the camera's, with a time bias of ``time_bias_sd_s``.

    All its planes have a common error of ``plane_sd_rad``: a camera clocked otherwise than the vehicle file states.

    A history's covariance does not state how its errors are correlated in time. `CONSTANT_PART` of the variance is
    taken as a constant bias (orientation, benchmark), the rest as Gauss-Markov with the correlation time `LIGHT_TIME_S`
    (light, which rolls with the vehicle), with straight lines between knots; only what lies off these is a frame's own.
    """
    cov = history.lateral_cov
    known = np.isfinite(history.theta_rad) & np.isfinite(cov[:, 0, 0])
    time_s, theta_yz, cov = history.time_s[known], history.theta_yz_rad[known], cov[known]
    return evidence_of_readings(history.method, time_s, theta_yz, cov, time_bias_sd_s, plane_sd_rad)


def evidence_of_readings(
    method: str,
    time_s: FloatArray,
    theta_yz: FloatArray,
    cov: FloatArray,
    time_bias_sd_s: float = 0.0,
    plane_sd_rad: float = 0.0,
) -> Evidence:
    """Evidence from lateral vectors ``(n, 2)``, rad, and their covariance ``(n, 2, 2)``; as `evidence_of_history`."""
    light, rest = correlation_root_and_rest(time_s, LIGHT_TIME_S, CONSTANT_PART, _LIGHT_KNOTS_A_TIME)
    inputs = {method: _rolled(symmetric_root(cov), light)}
    if plane_sd_rad > 0.0:
        normal = np.stack([-theta_yz[:, 1], theta_yz[:, 0]], axis=-1)
        inputs[CAMERA_PLANE] = plane_sd_rad * normal[:, :, None]
    return Evidence(
        method,
        time_s,
        theta_yz,
        np.zeros_like(cov),
        np.zeros_like(cov),
        inputs,
        rest[:, None, None] * cov,
        averaged_s=float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0,
        time_bias_sd_s=time_bias_sd_s,
    )


def moved_evidence(one: Evidence, inputs: dict[str, FloatArray], about: Deflection | None = None) -> Evidence:
    """Evidence of a method whose readings are linear in their inputs, with these moved.

    With a time bias ``b`` the reading tagged ``t`` is ``theta(t - b)``: its times are moved, and the rest of the bias
    enters by the rate of the deflection ``about`` (from times to lateral vectors) at those.
    """
    linear = {name: j for name, j in one.by_input.items() if name != one.time_bias}
    change = sum((j @ inputs[name] for name, j in linear.items() if name in inputs), np.zeros(2))
    moved = replace(one, theta_yz_rad=one.theta_yz_rad + change)
    if one.time_bias_sd_s == 0.0:
        return moved
    time_s = one.time_s - one.time_bias_sd_s * float(inputs.get(one.time_bias, np.zeros(1))[0])
    if about is None:
        return replace(moved, time_s=time_s)
    response = one.time_bias_sd_s * about(time_s, 1)[:, :, None]
    return replace(moved, time_s=time_s, by_input=linear | {one.time_bias: response})


def history_of_evidence(
    evidence: Evidence, loads: FlightLoads, assumptions: str, seen: Evidence | None = None
) -> DeflectionHistory:
    """Sample-by-sample history of a single method: NaN without an answer, or without an uncertainty.

    The terms of the joint's oscillation are bounded by the rms of the readings' own derivatives over
    `_OSCILLATION_WINDOW_S`; a reading without neighbours has no derivatives. ``seen`` are readings of the same samples
    that show the oscillation, for a method whose own do not.
    """
    rows, n = np.searchsorted(loads.time_s, evidence.time_s), len(loads.time_s)
    theta_yz, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
    swinging = _oscillation_var(evidence, seen or evidence)[:, None, None] * np.eye(2)
    theta_yz[rows] = np.where(np.isfinite(swinging[:, :1, 0]), evidence.mean_yz_rad, np.nan)
    cov[rows] = evidence.covariance + swinging
    quantiles = None
    if evidence.half_curvature_rad is not None:
        quantiles = np.full((n, len(QUANTILES)), np.nan)
        quantiles[rows] = _curved_quantiles(evidence, swinging)
    return history_from_lateral(loads.time_s, theta_yz, cov, evidence.method, assumptions, quantiles)


def _curved_quantiles(evidence: Evidence, swinging: FloatArray) -> FloatArray:
    """`length_quantiles` ``(n, 5)`` of deflections curved by the most uncertain input, C_m."""
    assert evidence.half_curvature_rad is not None
    # without samples, or of a C_m that is known, there is no response
    by_moment = evidence.by_input.get("C_m", np.zeros((len(evidence.time_s), 2, 1)))[:, :, 0]
    normals = standard_normals(3)
    others = evidence.independent_cov + swinging
    for name, response in evidence.by_input.items():
        if name != "C_m":
            others = others + response @ response.transpose(0, 2, 1)
    known = np.flatnonzero(np.isfinite(evidence.theta_yz_rad).all(axis=1) & np.isfinite(swinging[:, 0, 0]))
    x = normals[None, :, 2:]
    out = np.full((len(others), len(QUANTILES)), np.nan)
    for k in drawn_together(known):
        root = np.linalg.cholesky(others[k] + _LEAST_VAR * np.eye(2))
        drawn = normals[:, :2] @ root.transpose(0, 2, 1)
        drawn += evidence.theta_yz_rad[k, None]
        drawn += by_moment[k, None] * x + evidence.half_curvature_rad[k, None] * x**2
        out[k] = length_quantiles(drawn)
    return out


def _oscillation_var(evidence: Evidence, seen: Evidence) -> FloatArray:
    """Mean square (n,), rad^2 per axis, of a method's rate and acceleration terms for the observed oscillation."""
    t, theta_yz = evidence.time_s, seen.theta_yz_rad
    if len(t) < 5:
        return np.zeros(len(t))
    step = float(np.median(np.diff(t)))
    rate = np.gradient(theta_yz, t, axis=0)
    second = np.gradient(rate, t, axis=0)
    # the readings' own noise in differences of two and of three of them
    noise = np.trace(seen.independent_cov, axis1=1, axis2=2)
    window = max(1, round(_OSCILLATION_WINDOW_S / step))
    total = np.zeros(len(t))
    for derivative, response, noisy in (
        (rate, evidence.by_rate_s, noise / (2.0 * step**2)),
        (second, evidence.by_acceleration_s2, 6.0 * noise / (16.0 * step**4)),
    ):
        square = np.sum(derivative**2, axis=1) - noisy
        known = np.isfinite(square)
        share = uniform_filter1d(known.astype(float), window, mode="nearest")
        sums = uniform_filter1d(np.where(known, square, 0.0), window, mode="nearest")
        mean_square = np.divide(sums, share, out=np.full(len(t), np.nan), where=share > 0.5 / window).clip(0.0)
        total += 0.5 * mean_square * np.mean(np.sum(response**2, axis=2), axis=1)
    return total


def corrected_loads(loads: FlightLoads, inputs: dict[str, FloatArray]) -> FlightLoads:
    """Loads corrected for inputs that are so many standard deviations off their stated values."""
    flow, force = loads.flow_yz_rad.copy(), loads.specific_force_body_mps2.copy()
    for name, part in flow_inputs(loads).items():
        flow += part @ inputs.get(name, np.zeros(part.shape[2]))
    rate = loads.rate_body_radps
    if ACCELEROMETER in inputs:
        force += loads.force_root_mps2 @ inputs[ACCELEROMETER]
        rate = rate + loads.rate_root_radps @ inputs[ACCELEROMETER]
    pressure = loads.dynamic_pressure_pa
    if PRESSURE in inputs:
        pressure = np.maximum(pressure * (1.0 + pressure_input(loads) @ inputs[PRESSURE]), 1e-3)
    bias = [float(inputs[name][0]) if name in inputs else 0.0 for name in (ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS)]
    moved = replace(loads, flow_yz_rad=flow, specific_force_body_mps2=force, rate_body_radps=rate)
    return replace(
        delayed(moved, bias[0] * loads.accelerometer_time_bias_sd_s, bias[1] * loads.gyro_time_bias_sd_s),
        dynamic_pressure_pa=pressure,
        vehicle=moved_vehicle(loads.vehicle, {k: float(v[0]) for k, v in inputs.items() if k in VEHICLE_INPUTS}),
    )

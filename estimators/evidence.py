"""What does one method read of the deflection, and which uncertain inputs does it depend on?

Every method reads the deflection with an error that is linear in named inputs, which several methods share (the flow's
angle, coefficients, masses, the accelerometer's errors), and in the oscillation of the joint::

    read(t) = theta(t) + A(t) theta''(t) - sum over inputs J_i(t) x_i + independent error,      x_i ~ N(0, 1)

Each input is scaled to unit normals: ``J`` is the change of the reading per standard deviation of the input. An input
with a history (wind, attitude) is many unit normals, each with its own course over time. Inputs of the same name are
the same random variables in all methods: that is all of their correlation. The readings are curved functions of the
worst known coefficient: the curvature shifts the mean of the deflection and widens it.

The flow's error has three parts: that of the accelerometer's errors (estimated together with the attitude), the rest
of the trajectory's, and the wind's. The last two do not roll with the vehicle: they are written in axes that do not
roll. The trajectory's is a Gauss-Markov process with the correlation time `TRAJECTORY_TIME_S`; the wind's is half
constant bias, half Gauss-Markov with the correlation length `WIND_LENGTH_M` of altitude, as in the reconstruction of
the atmosphere; so is the density's in the dynamic pressure, with `DENSITY_LENGTH_M`.

Accelerometer and gyros have time biases of a millisecond or so: what oscillates is read late, and what the gyros carry
from the accelerometer to the c.g. does not match the force. The camera's time bias is relative to both.

Assumed: small errors, so that responses add; Gaussian priors of the stated standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from estimators.loads import FlightLoads
from flightmodel import rotations
from flightmodel.atmosphere import DENSITY_LENGTH_M, WIND_LENGTH_M, sounding_correlation_root
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory, history_from_lateral
from flightmodel.statistics import correlation_root
from flightmodel.vehicle import Vehicle

CONSTANT_PART, TRAJECTORY_TIME_S = 0.5, 20.0
LIGHT_TIME_S = 2.5
ACCELEROMETER, ATTITUDE, WIND, PRESSURE = "accelerometer", "BET attitude", "wind", "dynamic pressure"
CAMERA_TIME_BIAS, _RATE_STEP_S = "camera time bias", 0.005
ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS = "accelerometer time bias", "gyro time bias"
CAMERA_PLANE = "camera clocking"
Deflection = Callable[[FloatArray], FloatArray]
_OSCILLATION_WINDOW_S = 2.0  # about a period of the slow aerodynamic mode, over which the joint's is averaged
_BODIES = ("aeroshell", "centerbody")
VEHICLE_INPUTS = (
    "C_A",
    "C_N",
    "C_m",
    "C_mq",
    *(f"{body} {what}" for body in _BODIES for what in ("mass", "c.g. station", "inertia")),
    "initial offset y",
    "initial offset z",
)


@dataclass(frozen=True)
class Evidence:
    """Readings of one method at the times it answers; see the module's equation.

    Parameters
    ----------
    method : str
    time_s : (n,) float
    theta_yz_rad : (n, 2) float
        Lateral deflection vectors in body y, z.
    by_acceleration_s2 : (n, 2, 2) float
        ``A``: reading per angular acceleration of the joint.
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
    """

    method: str
    time_s: FloatArray
    theta_yz_rad: FloatArray
    by_acceleration_s2: FloatArray
    by_input: dict[str, FloatArray]
    independent_cov: FloatArray
    averaged_s: float
    half_curvature_rad: FloatArray | None = None
    time_bias_sd_s: float = 0.0

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


def flow_inputs(loads: FlightLoads, use: BoolArray) -> dict[str, FloatArray]:
    """Flow's error ``(n, 2, k)``, rad, per unit normal, by the name of each of its three parts."""
    root = loads.flow_root_rad[use]
    wind = loads.wind_flow_sd_rad[use]
    left = loads.flow_cov[use] - root @ root.transpose(0, 2, 1) - (wind**2)[:, None, None] * np.eye(2)
    trajectory = np.sqrt(np.maximum(0.5 * np.trace(left, axis1=1, axis2=2), 0.0))
    roll = _roll(loads)[use]
    c, s = np.cos(roll), np.sin(roll)
    # body components of vectors that do not roll
    body_from_fixed = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=1)
    return {
        ACCELEROMETER: root,
        ATTITUDE: _rolled(
            body_from_fixed, trajectory[:, None] * correlation_root(loads.time_s[use], TRAJECTORY_TIME_S)
        ),
        WIND: _rolled(body_from_fixed, wind[:, None] * sounding_correlation_root(loads.altitude_m[use], WIND_LENGTH_M)),
    }


def pressure_input(loads: FlightLoads, use: BoolArray) -> FloatArray:
    """Dynamic pressure's error ``(n, k)``, a fraction, per unit normal."""
    relative = loads.dynamic_pressure_sd_pa[use] / loads.dynamic_pressure_pa[use]
    return np.asarray(relative[:, None] * sounding_correlation_root(loads.altitude_m[use], DENSITY_LENGTH_M))


def delayed(loads: FlightLoads, use: BoolArray, force_s: float, rate_s: float) -> FlightLoads:
    """Loads with accelerometer and gyros read so much later, to first order: corrected for these time biases, s.

    With the gyros go the attitude, and so the flow's angle, and the lever-arm acceleration from the accelerometer to
    the c.g.; pressure and Mach number change too slowly to matter.
    """
    if force_s == rate_s == 0.0 or np.count_nonzero(use) < 2:
        return loads
    t = loads.time_s[use]

    def later(values: FloatArray, late_s: float) -> FloatArray:
        out = values.copy()
        out[use] += late_s * CubicSpline(t, values[use])(t, 1)
        return out

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
    rate, step = loads.rate_body_radps[:, 0], np.diff(loads.time_s)
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])


def offset_sd_m(vehicle: Vehicle) -> float:
    """Standard deviation, m, of the initial c.g. offset, each axis, as a shift of the centerbody's c.g."""
    masses = np.array([getattr(vehicle, name).mass_kg for name in _BODIES])
    return float(vehicle.uncertainty.cg_lateral_m * np.hypot(*masses) / masses[1])


def moved_vehicle(vehicle: Vehicle, moved: dict[str, float]) -> Vehicle:
    """Vehicle with its uncertain inputs moved by so many standard deviations, by the inputs' names.

    Stated uncertainties of mass, c.g. and inertia are each body's own; the lateral c.g.s of both bodies act together as
    the initial offset, taken as the centerbody's.
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
        inertia = (1.0 + moved.get(f"{name} inertia", 0.0) * known.inertia) * body.inertia
        mass = body.mass_kg * (1.0 + moved.get(f"{name} mass", 0.0) * known.mass)
        bodies[name] = body.model_copy(
            update={
                "mass_kg": float(mass),
                "cg_from_datum_body_m": (x, y, z),
                "inertia_kgm2": tuple(map(tuple, inertia.tolist())),
            }
        )
    return replace(vehicle, aero=vehicle.aero.scaled(*_scaling(vehicle, moved)), **bodies)


def moved_coefficients(vehicle: Vehicle, moved: dict[str, float], coefficients: FloatArray) -> FloatArray:
    """Coefficients ``(..., 4)`` of the vehicle's table as `moved_vehicle` would have them."""
    ca, cn, cm, cmq_shift = _scaling(vehicle, moved)
    return coefficients * np.array([ca, cn, cm, 1.0]) + np.array([0.0, 0.0, 0.0, cmq_shift])


def _scaling(vehicle: Vehicle, moved: dict[str, float]) -> tuple[float, float, float, float]:
    """Factors on C_A, C_N, C_m and the shift of C_mq."""
    known = vehicle.uncertainty
    ca, cn, cm = (1.0 + moved.get(k, 0.0) * sd for k, sd in (("C_A", known.ca), ("C_N", known.cn), ("C_m", known.cm)))
    return ca, cn, cm, moved.get("C_mq", 0.0) * known.cmq


def evidence_of_history(history: DeflectionHistory, time_bias_sd_s: float = 0.0, plane_sd_rad: float = 0.0) -> Evidence:
    """Evidence from a history alone, e.g. the camera's, with a time bias of ``time_bias_sd_s``.

    All its planes have a common error of ``plane_sd_rad``: a camera clocked otherwise than the vehicle file states.

    A history's covariance does not state how its errors are correlated in time. `CONSTANT_PART` of the variance is
    taken as a constant bias (orientation, benchmark), the rest as Gauss-Markov with the correlation time `LIGHT_TIME_S`
    (light, which rolls with the vehicle); nothing averages out from frame to frame.
    """
    cov = history.lateral_cov
    known = np.isfinite(history.theta_rad) & np.isfinite(cov[:, 0, 0])
    time_s, theta_yz, cov = history.time_s[known], history.theta_yz_rad[known], cov[known]
    value, axes = np.linalg.eigh(cov)
    # symmetric square root: smooth in time whatever the order of the eigenvalues
    root = (axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)
    inputs = {history.method: _rolled(root, correlation_root(time_s, LIGHT_TIME_S, CONSTANT_PART))}
    if plane_sd_rad > 0.0:
        normal = np.stack([-theta_yz[:, 1], theta_yz[:, 0]], axis=-1)
        inputs[CAMERA_PLANE] = plane_sd_rad * normal[:, :, None]
    return Evidence(
        history.method,
        time_s,
        theta_yz,
        np.zeros((len(theta_yz), 2, 2)),
        inputs,
        np.zeros_like(cov),
        averaged_s=float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0,
        time_bias_sd_s=time_bias_sd_s,
    )


def moved_evidence(one: Evidence, inputs: dict[str, FloatArray], about: Deflection | None = None) -> Evidence:
    """Evidence of a method whose readings are linear in their inputs, with these moved.

    With a time bias ``b`` the reading tagged ``t`` is ``theta(t - b)``: its times are moved, and the rest of the bias
    enters by the rate of the deflection ``about`` (from times to lateral vectors) at those.
    """
    linear = {name: j for name, j in one.by_input.items() if name != CAMERA_TIME_BIAS}
    change = sum((j @ inputs[name] for name, j in linear.items() if name in inputs), np.zeros(2))
    moved = replace(one, theta_yz_rad=one.theta_yz_rad + change)
    if one.time_bias_sd_s == 0.0:
        return moved
    time_s = one.time_s - one.time_bias_sd_s * float(inputs.get(CAMERA_TIME_BIAS, np.zeros(1))[0])
    if about is None:
        return replace(moved, time_s=time_s)
    rate = (about(time_s + _RATE_STEP_S) - about(time_s - _RATE_STEP_S)) / (2.0 * _RATE_STEP_S)
    return replace(moved, time_s=time_s, by_input=linear | {CAMERA_TIME_BIAS: one.time_bias_sd_s * rate[:, :, None]})


def history_of_evidence(evidence: Evidence, loads: FlightLoads, assumptions: str) -> DeflectionHistory:
    """History of a method by itself, sample by sample: NaN where it has no answer.

    The term of the joint's oscillation is bounded by the rms of the readings' own second derivative over
    `_OSCILLATION_WINDOW_S`.
    """
    rows = np.searchsorted(loads.time_s, evidence.time_s)
    theta_yz, cov = np.full((len(loads.time_s), 2), np.nan), np.full((len(loads.time_s), 2, 2), np.nan)
    theta_yz[rows] = evidence.mean_yz_rad
    cov[rows] = evidence.covariance + _oscillation_var(evidence)[:, None, None] * np.eye(2)
    return history_from_lateral(loads.time_s, theta_yz, cov, evidence.method, assumptions)


def _oscillation_var(evidence: Evidence) -> FloatArray:
    t, theta_yz = evidence.time_s, evidence.theta_yz_rad
    if len(t) < 5:
        return np.zeros(len(t))
    second = np.gradient(np.gradient(theta_yz, t, axis=0), t, axis=0)
    window = max(1, round(_OSCILLATION_WINDOW_S / float(np.median(np.diff(t)))))
    mean_square = uniform_filter1d(np.sum(second**2, axis=1), window, mode="nearest")
    return np.asarray(0.5 * mean_square * np.mean(np.sum(evidence.by_acceleration_s2**2, axis=2), axis=1))


def corrected_loads(loads: FlightLoads, use: BoolArray, inputs: dict[str, FloatArray]) -> FlightLoads:
    """Loads corrected for inputs that are so many standard deviations off their stated values.

    Flow inputs with a history are defined on the samples in ``use`` alone; the other samples stay.
    """
    flow, force = loads.flow_yz_rad.copy(), loads.specific_force_body_mps2.copy()
    for name, part in flow_inputs(loads, use).items():
        flow[use] += part @ inputs.get(name, np.zeros(part.shape[2]))
    force[use] += loads.force_root_mps2[use] @ inputs.get(ACCELEROMETER, np.zeros(9))
    pressure = loads.dynamic_pressure_pa.copy()
    if PRESSURE in inputs:
        pressure[use] *= 1.0 + pressure_input(loads, use) @ inputs[PRESSURE]
    bias = [float(inputs[name][0]) if name in inputs else 0.0 for name in (ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS)]
    moved = replace(loads, flow_yz_rad=flow, specific_force_body_mps2=force)
    return replace(
        delayed(moved, use, bias[0] * loads.accelerometer_time_bias_sd_s, bias[1] * loads.gyro_time_bias_sd_s),
        dynamic_pressure_pa=np.maximum(pressure, 1e-3),
        vehicle=moved_vehicle(loads.vehicle, {k: float(v[0]) for k, v in inputs.items() if k in VEHICLE_INPUTS}),
    )

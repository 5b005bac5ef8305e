"""What one method says of the deflection, and what it leans on, so that methods can be weighed against each other.

Every method reads the deflection with an error that is linear in named inputs that several methods share (the flow's
angle, coefficients, masses, the accelerometer's errors) and in the swinging of the joint::

    read(t) = theta(t) + A(t) theta''(t) - sum over inputs J_i(t) x_i + independent error,      x_i ~ N(0, 1)

Each input is scaled to unit normals: ``J`` is the change of what is read per standard deviation that it is moved.
Inputs with a history (wind, attitude) are many unit normals with their own spread over time. What two methods share is
then correlated by having the same names, and nothing else needs saying. Of coefficients known to a tenth the readings
are curved functions: their curvature shifts the mean of what the deflection may be and widens it.

The flow's error has three parts: what goes with the accelerometer's errors (found together by the reconstruction), what
is left of the trajectory's, and the wind's. The last two do not turn with the vehicle: they are written in axes that do
not roll, where the trajectory's forgets over `TRAJECTORY_TIME_S` and the wind's has a constant half and a half that
forgets over `WIND_LENGTH_M` of altitude, as the reconstruction of the air takes it. The same goes for the density in
the dynamic pressure, over `DENSITY_LENGTH_M`.

Accelerometer and gyros have clocks of their own, known to a millisecond or so: what swings is read that much late, and
what the gyros carry from the accelerometer to the c.g. does not fit what it felt. The film's clock is told by both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from estimators.loads import PulseData, carried
from flightmodel.atmosphere import DENSITY_LENGTH_M, WIND_LENGTH_M, sounding_correlation_root
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory, history_from_lateral
from flightmodel.statistics import correlation_root
from flightmodel.vehicle import Vehicle

CONSTANT_PART, TRAJECTORY_TIME_S = 0.5, 20.0
LIGHT_TIME_S = 2.5
ACCELEROMETER, ATTITUDE, WIND, PRESSURE = "accelerometer", "BET attitude", "wind", "dynamic pressure"
FILM_CLOCK, RATE_STEP_S = "film's clock", 0.005
FORCE_CLOCK, RATE_CLOCK = "accelerometer's clock", "gyros' clock"
CAMERA_PLANE = "camera's plane"
Deflection = Callable[[FloatArray], FloatArray]
SWING_WINDOW_S = 2.0  # about a period of the slow aerodynamic mode, over which the joint's swinging is averaged
BODIES = ("aeroshell", "centerbody")
VEHICLE_INPUTS = (
    "C_A",
    "C_N",
    "C_m",
    "C_mq",
    *(f"{body} {what}" for body in BODIES for what in ("mass", "c.g. station", "inertia")),
    "initial offset y",
    "initial offset z",
)


@dataclass(frozen=True)
class Evidence:
    """What one method read at the times it answers; see the module's equation.

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
        Of what no other sample and no other method shares, rad^2.
    averaged_s : float
        Span over which readings may be averaged without loss of what they say.
    bend : (n, 2) float or None
        Half the second derivative of the reading by its most uncertain input, rad; None where that is nothing.
    clock_sd_s : float
        How well the clock that ``time_s`` was read from is known against the gyros'; zero: it is theirs.
    """

    method: str
    time_s: FloatArray
    theta_yz_rad: FloatArray
    by_acceleration_s2: FloatArray
    by_input: dict[str, FloatArray]
    independent_cov: FloatArray
    averaged_s: float
    bend: FloatArray | None = None
    clock_sd_s: float = 0.0

    @property
    def mean_yz_rad(self) -> FloatArray:
        """Mean ``(n, 2)`` of the deflection over what the inputs may be."""
        return self.theta_yz_rad if self.bend is None else self.theta_yz_rad + self.bend

    @property
    def covariance(self) -> FloatArray:
        """Covariance ``(n, 2, 2)`` of every sample by itself, the joint at rest."""
        total = self.independent_cov.copy()
        for response in self.by_input.values():
            total += response @ response.transpose(0, 2, 1)
        if self.bend is not None:
            total += 2.0 * self.bend[:, :, None] * self.bend[:, None, :]
        return total


def flow_inputs(pulse: PulseData, use: BoolArray) -> dict[str, FloatArray]:
    """Flow's error ``(n, 2, k)``, rad, per unit normal of each of its three parts."""
    root = pulse.flow_root_rad[use]
    wind = pulse.wind_flow_sd_rad[use]
    left = pulse.flow_cov[use] - root @ root.transpose(0, 2, 1) - (wind**2)[:, None, None] * np.eye(2)
    trajectory = np.sqrt(np.maximum(0.5 * np.trace(left, axis1=1, axis2=2), 0.0))
    roll = _roll(pulse)[use]
    c, s = np.cos(roll), np.sin(roll)
    # body components of vectors that do not roll
    turn = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=1)
    return {
        ACCELEROMETER: root,
        ATTITUDE: _turned(turn, trajectory[:, None] * correlation_root(pulse.time_s[use], TRAJECTORY_TIME_S)),
        WIND: _turned(turn, wind[:, None] * sounding_correlation_root(pulse.altitude_m[use], WIND_LENGTH_M)),
    }


def pressure_input(pulse: PulseData, use: BoolArray) -> FloatArray:
    """Dynamic pressure's error ``(n, k)``, a fraction, per unit normal."""
    relative = pulse.dynamic_pressure_sd_pa[use] / pulse.dynamic_pressure_pa[use]
    return np.asarray(relative[:, None] * sounding_correlation_root(pulse.altitude_m[use], DENSITY_LENGTH_M))


def read_later(pulse: PulseData, use: BoolArray, force_s: float, rate_s: float) -> PulseData:
    """Pulse with what accelerometer and gyros say so much later: as it is where their clocks are so late.

    With the gyros' clock go the attitude, and so the flow's angle, and what carries the force from the accelerometer to
    the c.g.; pressure and Mach number are too slow to tell.
    """
    if force_s == rate_s == 0.0 or np.count_nonzero(use) < 2:
        return pulse
    t = pulse.time_s[use]

    def later(values: FloatArray, late_s: float) -> FloatArray:
        out = values.copy()
        out[use] += late_s * CubicSpline(t, values[use])(t, 1)
        return out

    force, flow = pulse.specific_force_body_mps2, pulse.flow_yz_rad
    rate, turn = pulse.rate_body_radps, pulse.angular_acceleration_body_radps2
    arm = carried(rate, turn, pulse.cg_from_sensor_m)
    return replace(
        pulse,
        specific_force_body_mps2=later(force - arm, force_s) + later(arm, rate_s),
        flow_yz_rad=later(flow, rate_s),
        rate_body_radps=later(rate, rate_s),
        angular_acceleration_body_radps2=later(turn, rate_s),
    )


def _turned(turn: FloatArray, columns: FloatArray) -> FloatArray:
    """Body components ``(n, 2, 2 k)`` of two like histories (n, k) in axes that do not roll."""
    n, k = columns.shape
    return np.asarray(np.einsum("nij,nk->nijk", turn, columns).reshape(n, 2, 2 * k))


def _roll(pulse: PulseData) -> FloatArray:
    rate, step = pulse.rate_body_radps[:, 0], np.diff(pulse.time_s)
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])


def offset_sd_m(vehicle: Vehicle) -> float:
    """Initial offset's standard deviation, each axis, carried by the centerbody's c.g."""
    masses = np.array([getattr(vehicle, name).mass_kg for name in BODIES])
    return float(vehicle.uncertainty.cg_lateral_m * np.hypot(*masses) / masses[1])


def moved_vehicle(vehicle: Vehicle, moved: dict[str, float]) -> Vehicle:
    """Vehicle with its uncertain inputs moved by so many standard deviations, by the inputs' names.

    Stated uncertainties of mass, c.g. and inertia are each body's own; lateral c.g.s of the two bodies act together as
    the initial offset, carried by the centerbody.
    """
    known, side = vehicle.uncertainty, offset_sd_m(vehicle)
    bodies = {}
    for name in BODIES:
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


def evidence_of_history(history: DeflectionHistory, clock_sd_s: float = 0.0, plane_sd_rad: float = 0.0) -> Evidence:
    """Evidence from a history alone, e.g. the camera's, whose clock may be off by ``clock_sd_s``.

    All its planes may be turned together by ``plane_sd_rad``: as by a camera that is clocked otherwise than it is told.

    Of what a history's errors share from sample to sample its covariance says nothing. `CONSTANT_PART` is taken as one
    error in all samples (orientation, benchmark), the rest as one that forgets over `LIGHT_TIME_S` (light, which turns
    with the vehicle); nothing averages out from frame to frame.
    """
    cov = history.lateral_cov
    known = np.isfinite(history.theta_rad) & np.isfinite(cov[:, 0, 0])
    time_s, theta_yz, cov = history.time_s[known], history.theta_yz_rad[known], cov[known]
    value, axes = np.linalg.eigh(cov)
    # symmetric square root: smooth in time whatever the order of the eigenvalues
    root = (axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)
    inputs = {history.method: _turned(root, correlation_root(time_s, LIGHT_TIME_S, CONSTANT_PART))}
    if plane_sd_rad > 0.0:
        across = np.stack([-theta_yz[:, 1], theta_yz[:, 0]], axis=-1)
        inputs[CAMERA_PLANE] = plane_sd_rad * across[:, :, None]
    return Evidence(
        history.method,
        time_s,
        theta_yz,
        np.zeros((len(theta_yz), 2, 2)),
        inputs,
        np.zeros_like(cov),
        averaged_s=float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0,
        clock_sd_s=clock_sd_s,
    )


def moved_evidence(one: Evidence, inputs: dict[str, FloatArray], about: Deflection | None = None) -> Evidence:
    """Evidence of a method whose readings are linear in their inputs, with these moved.

    A clock that is late by ``late`` read ``theta(t - late)`` at what it calls ``t``: its times are moved, and what is
    left of its error enters by the rate of the deflection ``about`` (from times to lateral vectors) at those.
    """
    linear = {name: j for name, j in one.by_input.items() if name != FILM_CLOCK}
    change = sum((j @ inputs[name] for name, j in linear.items() if name in inputs), np.zeros(2))
    moved = replace(one, theta_yz_rad=one.theta_yz_rad + change)
    if one.clock_sd_s == 0.0:
        return moved
    time_s = one.time_s - one.clock_sd_s * float(inputs.get(FILM_CLOCK, np.zeros(1))[0])
    if about is None:
        return replace(moved, time_s=time_s)
    rate = (about(time_s + RATE_STEP_S) - about(time_s - RATE_STEP_S)) / (2.0 * RATE_STEP_S)
    return replace(moved, time_s=time_s, by_input=linear | {FILM_CLOCK: one.clock_sd_s * rate[:, :, None]})


def history_of_evidence(evidence: Evidence, pulse: PulseData, assumptions: str) -> DeflectionHistory:
    """History of a method by itself, sample by sample: NaN where it has no answer.

    The joint's swinging is bounded: by the rms of the readings' own curvature over `SWING_WINDOW_S`.
    """
    rows = np.searchsorted(pulse.time_s, evidence.time_s)
    theta_yz, cov = np.full((len(pulse.time_s), 2), np.nan), np.full((len(pulse.time_s), 2, 2), np.nan)
    theta_yz[rows] = evidence.mean_yz_rad
    cov[rows] = evidence.covariance + _swing_var(evidence)[:, None, None] * np.eye(2)
    return history_from_lateral(pulse.time_s, theta_yz, cov, evidence.method, assumptions)


def _swing_var(evidence: Evidence) -> FloatArray:
    t, theta_yz = evidence.time_s, evidence.theta_yz_rad
    if len(t) < 5:
        return np.zeros(len(t))
    second = np.gradient(np.gradient(theta_yz, t, axis=0), t, axis=0)
    window = max(1, round(SWING_WINDOW_S / float(np.median(np.diff(t)))))
    mean_square = uniform_filter1d(np.sum(second**2, axis=1), window, mode="nearest")
    return np.asarray(0.5 * mean_square * np.mean(np.sum(evidence.by_acceleration_s2**2, axis=2), axis=1))


def corrected_pulse(pulse: PulseData, use: BoolArray, inputs: dict[str, FloatArray]) -> PulseData:
    """Pulse with its inputs as they are where they are so many standard deviations off what was told.

    Histories of flow inputs are defined on the samples in ``use`` alone; the others stay.
    """
    flow, force = pulse.flow_yz_rad.copy(), pulse.specific_force_body_mps2.copy()
    for name, part in flow_inputs(pulse, use).items():
        flow[use] += part @ inputs.get(name, np.zeros(part.shape[2]))
    force[use] += pulse.force_root_mps2[use] @ inputs.get(ACCELEROMETER, np.zeros(9))
    pressure = pulse.dynamic_pressure_pa.copy()
    if PRESSURE in inputs:
        pressure[use] *= 1.0 + pressure_input(pulse, use) @ inputs[PRESSURE]
    late = [float(inputs[name][0]) if name in inputs else 0.0 for name in (FORCE_CLOCK, RATE_CLOCK)]
    moved = replace(pulse, flow_yz_rad=flow, specific_force_body_mps2=force)
    return replace(
        read_later(moved, use, late[0] * pulse.force_clock_sd_s, late[1] * pulse.rate_clock_sd_s),
        dynamic_pressure_pa=np.maximum(pressure, 1e-3),
        vehicle=moved_vehicle(pulse.vehicle, {k: float(v[0]) for k, v in inputs.items() if k in VEHICLE_INPUTS}),
    )

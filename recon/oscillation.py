"""Do accelerometer and gyros sense one oscillation, at one time, in one set of axes? No tracker takes part.

The flow's force on an oscillating vehicle and its moment act at the same instant and in the same plane. With the
lateral components as complex numbers, ``F = f_y + i f_z`` and ``W = w_y + i w_z``, a vehicle of equal moments of
inertia about y and z has

    F(t) = a + b u + c u^2 + (d + e u) i (W'(t) + k W(t)) + g w_x W(t),        d, e, g real, ``u`` from -1/2 to 1/2,

in windows of `_WINDOW_S`: slow loads, the force of a moment that changes slowly with pressure, the lever arm of the
accelerometer, and the coupling with roll. Pitch damping is part of the moment and not of the force,

    k = -q S l^2 C_mq / (2 V I) = -m |a_x| l^2 C_mq / (2 V C_A I),

by the axial force and the trajectory's speed, with the C_mq that explains the readings best, given its stated sd. Of a
vehicle that cones at ``w`` it turns the relation by ``k / w``: 3 deg in the slow descent of a large shell. A fault of
one of the two sensors changes the relation in a way of its own:

* a **lag** of the accelerometer's tags: ``W(t - lag)``;
* a triad turned about **roll**: a common phase of ``d``, ``e`` and ``g``;
* two lateral axes **exchanged**, or one of wrong sign: the complex conjugate of ``W``, with a phase of 0, 90, 180 or
  270 deg for each of the four slips.

Each is a single hypothesis, its likelihood that of all windows with an unknown noise in each: ``-n / 2 log rest``, with
``n`` the number of independent samples. ``d`` is positive where the vehicle is statically stable and the accelerometer
lies aft of the c.g.; elsewhere its sign is open, and a triad turned by half a turn cannot be recognised.

A hypothesis takes over from the data as delivered at a thousand to one. On a vehicle that cones, a lag turns the
lateral components as a roll does (37 rad/s and 1.4 ms: 3 deg): the angle about roll is known no better than what the
stated time biases of both clocks make of it. A mount is the same in all windows; where the angle differs between them
by more than noise (a joint that gives way by degrees, a cone of 30 deg) it is the relation's own, and adds to the sd.

References
----------
R. DerSimonian, N. Laird, "Meta-analysis in clinical trials", 1986 (a mean of values that differ among themselves).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import BoolArray, Check, FloatArray
from flightmodel.statistics import ACCEPTED_ODDS
from flightmodel.trajectory import interpolate_rows
from flightmodel.vehicle import Vehicle
from recon.imu_screening import BridgedSensor
from recon.time_bias import CORRELATION_S, SLOWEST_S, has_gap, smoothed_body_axes

ComplexArray = NDArray[np.complex128]
DELIVERED, LAG, ROLL, MIRRORED = "as delivered", "lag", "roll", "mirrored"
_WINDOW_S, _STEP_S = 4.0, 0.02  # some periods of the oscillation; a twentieth of one at 2.5 Hz
_LONGEST_LAG_S, LAG_STEP_S = 1.5, 0.02  # of a clock that was set wrongly; beyond it trackers show it by themselves
_ROLL_STEP_RAD = np.deg2rad(1.0)  # of the search, half of what is called a roll
_MOST_WINDOWS = 24  # those with the largest lateral force: enough, and quick on a long flight
_LEAST_WINDOWS = 4  # so that their scatter says how well the roll is known
_LEAST_EXPLAINED = 0.95  # share of the lateral force's square, by the best hypothesis
# unequal inertia, c.g. offsets and the joint turn the relation: 0.37 deg rms, at most 0.63, on 13 sound flights
_LEAST_ROLL_RAD = np.deg2rad(2.0)
_ROLL_SD = 4.0
# C_mq less the stated one, in its sd, among which it is looked for; dense where an unknown speed may make it small
_DAMPING_SD = np.array([0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0])
_DAMPING_SD = np.concatenate([-_DAMPING_SD[:0:-1], _DAMPING_SD])
_USELESS_ROLL_RAD = np.deg2rad(10.0)  # a sixth of the lateral force is then in the wrong plane
_SLIPS = (  # phase of the conjugate, in quarter turns, and what each sensor's slip would be
    "the sign of a lateral axis of one of them (r, or the accelerometer's body z)",
    "two lateral axes of one of them (q and r, or the accelerometer's body y and z)",
    "the sign of a lateral axis of one of them (q, or the accelerometer's body y)",
    "two lateral axes of one of them, and their signs",
)


@dataclass(frozen=True)
class Oscillation:
    """The likeliest relation of accelerometer and gyros.

    Parameters
    ----------
    kind : str
        `DELIVERED`, `LAG`, `ROLL` or `MIRRORED`.
    gain : float
        Its log likelihood over that of the data as delivered.
    lag_s : float
        How much later the accelerometer's tags are than the gyros', to `LAG_STEP_S`; zero for other kinds.
    roll_rad, roll_sd_rad : float
        How far the accelerometer is turned about +x against the gyros; of `MIRRORED` the phase.
    windows : int
        How many showed it.
    """

    kind: str
    gain: float
    lag_s: float
    roll_rad: float
    roll_sd_rad: float
    windows: int

    @property
    def one_set_of_axes(self) -> bool:
        """Whether both sensors have the same axes, to a few degrees: without, forces and rates make no motion."""
        return self.kind != MIRRORED and not (self.kind == ROLL and abs(self.roll_rad) > _USELESS_ROLL_RAD)


@dataclass(frozen=True)
class _Normal:
    """Normal equations of w windows at l lags: square of the force (w,), ``Re C^H C`` (w, l, 5, 5), ``C^H F``.

    Columns: ``i (W' + k W)``, the same times ``u``, ``i W`` by the sd of ``k``, the same times ``u``, ``w_x W``.
    """

    square: FloatArray
    gram: FloatArray
    moment: ComplexArray

    def at(self, lag: int) -> _Normal:
        """Return those of one lag alone."""
        return _Normal(self.square, self.gram[:, [lag]], self.moment[:, [lag]])

    def damped(self, by_sd: float) -> _Normal:
        """Return those of the three columns with ``k`` moved by so many of its sd."""
        pick = np.array([[1.0, 0.0, by_sd, 0.0, 0.0], [0.0, 1.0, 0.0, by_sd, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
        return _Normal(self.square, pick @ self.gram @ pick.T, self.moment @ pick.T)

    def rest(self, phase_rad: FloatArray) -> FloatArray:
        """Residual share (w, l, p) of the squared force at phases (p,), with three columns."""
        turned = (self.moment[:, :, None] * np.exp(-1j * phase_rad)[:, None]).real
        solved = np.linalg.solve(self.gram[:, :, None], turned[..., None])[..., 0]
        return np.asarray(1.0 - np.einsum("wlpi,wlpi->wlp", turned, solved) / self.square[:, None, None])

    def rests(self, phase_rad: FloatArray) -> FloatArray:
        """Shares (s, w, l, p) that are left with each damping of `_DAMPING_SD` at phases (p,)."""
        return np.stack([self.damped(by_sd).rest(phase_rad) for by_sd in _DAMPING_SD.tolist()])

    def first(self, lag: int, phase_rad: float) -> FloatArray:
        """Coefficient ``d`` (w,) at one lag and phase, damping as stated."""
        stated = self.damped(0.0)
        turned = (stated.moment[:, lag] * np.exp(-1j * phase_rad)).real
        return np.asarray(np.linalg.solve(stated.gram[:, lag], turned[..., None])[:, 0, 0])


def oscillation(
    force: BridgedSensor,
    rate: BridgedSensor,
    start_s: float,
    end_s: float,
    vehicle: Vehicle | None,
    speed: tuple[FloatArray, FloatArray] | None = None,
) -> Oscillation | None:
    """Likeliest relation of both sensors between two times; None where no oscillation shows it.

    Parameters
    ----------
    force, rate : BridgedSensor
    start_s, end_s : float
    vehicle : Vehicle or None
        Without one nothing is known of how the body moves in the flow (a car is pushed aside by its wheels), and
        nothing is said.
    speed : ((n,) float, (n,) float), optional
        Times, s, and speed, m/s. Without it damping is whatever explains the readings best.
    """
    if vehicle is None or max(np.median(np.diff(t.time_s)) for t in (force, rate)) > SLOWEST_S:
        return None
    aft = bool(force.spec.position_from_datum_body_m[0] <= vehicle.cg_m[0])
    steps = round(_LONGEST_LAG_S / LAG_STEP_S)
    lags = np.asarray(LAG_STEP_S * np.arange(-steps, steps + 1), dtype=np.float64)
    found = _normal_equations(force, rate, start_s, end_s, lags, _damping_by_force(vehicle, speed))
    if found is None:
        return None
    proper, mirrored = found
    none = len(lags) // 2
    quarter = np.linspace(0.0, 1.5 * np.pi, 4)
    phases = np.linspace(-np.pi, np.pi, round(2.0 * np.pi / _ROLL_STEP_RAD), endpoint=False)
    by_lag = proper.rests(np.zeros(1))[..., 0]
    at_none = proper.at(none)
    by_roll, by_mirror = at_none.rests(phases)[:, :, 0], mirrored.rests(quarter)[:, :, 0]
    best = np.minimum.reduce([rest.min(axis=(0, 2)) for rest in (by_lag, by_roll, by_mirror)])
    use = best < 1.0 - _LEAST_EXPLAINED
    if use.sum() < _LEAST_WINDOWS:
        return None
    samples = 2.0 * _WINDOW_S / CORRELATION_S  # of both components

    def log_likelihood(rests: FloatArray) -> FloatArray:
        """Of the likeliest damping, its prior included."""
        fits = -0.5 * samples * np.log(np.maximum(rests[:, use], 1e-9)).sum(axis=1)
        return np.asarray((fits - 0.5 * _DAMPING_SD[:, None] ** 2).max(axis=0))

    lag_log, roll_log, mirror_log = (log_likelihood(rests) for rests in (by_lag, by_roll, by_mirror))
    gains = {
        DELIVERED: 0.0,
        LAG: float(lag_log.max() - lag_log[none]),
        ROLL: float(roll_log.max() - lag_log[none]),
        MIRRORED: float(mirror_log.max() - lag_log[none]),
    }
    logs = -0.5 * samples * np.log(np.maximum(by_roll[:, use], 1e-9))
    likeliest = int((logs.sum(axis=1).max(axis=1) - 0.5 * _DAMPING_SD**2).argmax())
    roll, roll_sd = common_angle(_refined(roll_log, _ROLL_STEP_RAD)[0], logs[likeliest], _ROLL_STEP_RAD)
    beside = (log_likelihood(proper.at(none + k).rests(phases)[:, :, 0]) for k in (-1, 1))
    either_side = [_refined(log, _ROLL_STEP_RAD)[0] for log in beside]
    # a phase and its opposite leave the same rest: half a turn more or less is none
    per_lag = np.mod(either_side[1] - either_side[0] + 0.5 * np.pi, np.pi) - 0.5 * np.pi
    clocks_s = np.hypot(force.spec.time_bias_sd_s, rate.spec.time_bias_sd_s)
    roll_sd = float(np.hypot(roll_sd, clocks_s * per_lag / (2.0 * LAG_STEP_S)))
    roll = _with_positive(at_none, use, phases[0] + roll, aft)
    kind = max(gains, key=lambda name: gains[name])
    if gains[kind] < ACCEPTED_ODDS or (kind == ROLL and abs(roll) < max(_LEAST_ROLL_RAD, _ROLL_SD * roll_sd)):
        kind = DELIVERED
    if kind == DELIVERED and abs(roll) > 0.5 * np.pi:
        kind = ROLL  # half a turn: the rest is as small, but the force has the wrong sign
    if kind == MIRRORED:
        roll = _with_positive(mirrored, use, float(quarter[int(np.argmax(mirror_log))]), aft)
    late_s = float(lags[int(np.argmax(lag_log))]) if kind == LAG else 0.0
    return Oscillation(kind, gains[kind], late_s, roll, roll_sd, int(use.sum()))


def _with_positive(normal: _Normal, use: BoolArray, phase_rad: float, aft: bool) -> float:
    """Of a phase and its opposite, which leave the same rest, that with positive ``d``, or the smaller; -pi to pi."""
    phase = float(np.angle(np.exp(1j * phase_rad)))
    wrong = np.median(normal.first(0, phase)[use]) < 0.0 if aft else abs(phase) > 0.5 * np.pi
    return float(np.angle(-np.exp(1j * phase))) if wrong else phase


def _damping_by_force(vehicle: Vehicle, speed: tuple[FloatArray, FloatArray] | None) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and ``k / |a_x|`` of the module's equation and its sd (n, 2), s/m.

    Without a speed that of a slow descent, where damping is largest, and anything between it and none.
    """
    time_s, speed_mps = (np.zeros(1), np.full(1, 100.0)) if speed is None else speed
    speed_mps = np.maximum(speed_mps, 1.0)  # slower is no flight
    # sound in thin air has 270 to 340 m/s: C_A and C_mq change slowly with Mach number
    ca, _, _, cmq = vehicle.aero.at(speed_mps / 300.0, 0.0).T
    inertia = 0.5 * (vehicle.inertia[1, 1] + vehicle.inertia[2, 2])
    per_cmq = vehicle.mass_kg * vehicle.reference.length_m**2 / (2.0 * speed_mps * ca * inertia)
    sd = np.full(len(cmq), vehicle.uncertainty.cmq)
    stated = (-cmq, sd) if speed is not None else (0.0 * cmq, np.hypot(cmq, sd))
    return time_s, per_cmq[:, None] * np.column_stack(stated)


def _normal_equations(
    force: BridgedSensor,
    rate: BridgedSensor,
    start_s: float,
    end_s: float,
    lags: FloatArray,
    damping_by_force: tuple[FloatArray, FloatArray],
) -> tuple[_Normal, _Normal] | None:
    """Normal equations of the proper relation at all lags and of the mirrored one at none; None without windows."""
    (ft, f), (wt, w) = smoothed_body_axes(force), smoothed_body_axes(rate)
    deceleration = np.maximum(-np.interp(wt, ft, f[:, 0]), 0.0)
    damping = deceleration[:, None] * interpolate_rows(wt, *damping_by_force)
    rates = np.column_stack([w, np.gradient(w, wt, axis=0)[:, 1:] + damping[:, :1] * w[:, 1:], damping[:, 1]])
    start = max(start_s, ft[0], wt[0] + _LONGEST_LAG_S)
    end = min(end_s, ft[-1], wt[-1] - _LONGEST_LAG_S)
    begins = [b for b in np.arange(start, end - _WINDOW_S, _WINDOW_S) if not (has_gap(force, b) or has_gap(rate, b))]
    if len(begins) < _LEAST_WINDOWS:
        return None
    u = np.linspace(-0.5, 0.5, round(_WINDOW_S / _STEP_S))
    slow, _ = np.linalg.qr(np.column_stack([np.ones_like(u), u, u**2]))

    forces = []
    for begin in begins:
        values = interpolate_rows(begin + (u + 0.5) * _WINDOW_S, ft, f)
        forces.append(_fast(values[:, 1] + 1j * values[:, 2], slow))
    square = np.array([np.vdot(x, x).real for x in forces])
    strongest = np.sort(np.argsort(-square)[:_MOST_WINDOWS])
    proper, mirrored = [], []
    for k in strongest:
        at = begins[k] + (u + 0.5) * _WINDOW_S - lags[:, None]
        p, q, r, q_turn, r_turn, damped = interpolate_rows(at.ravel(), wt, rates).T.reshape(6, *at.shape)
        lateral, normal, none = q + 1j * r, q_turn + 1j * r_turn, [len(lags) // 2]
        columns = p * lateral, normal, damped * lateral
        proper.append(_gram_and_moment(u, *columns, slow, forces[k]))
        mirror = (p[none] * lateral[none].conj(), normal[none].conj(), damped[none] * lateral[none].conj())
        mirrored.append(_gram_and_moment(u, *mirror, slow, forces[k]))
    at_lags, at_none = (
        _Normal(square[strongest], *(np.array(part) for part in zip(*rows, strict=True))) for rows in (proper, mirrored)
    )
    return at_lags, at_none


def _fast(columns: ComplexArray, slow: FloatArray) -> ComplexArray:
    """Columns (..., n, k) less what is a combination of slow ones (n, s)."""
    return np.asarray(columns - slow @ (slow.T @ columns))


def _gram_and_moment(
    u: FloatArray, roll: ComplexArray, normal: ComplexArray, damped: ComplexArray, slow: FloatArray, force: ComplexArray
) -> tuple[FloatArray, ComplexArray]:
    """Normal matrix (l, 5, 5) and right-hand side (l, 5) of one window at lags: columns are (l, n), the force (n,)."""
    turning = [1j * normal, u * 1j * normal, 1j * damped, u * 1j * damped, roll]
    columns = _fast(np.stack(turning, axis=-1), slow)
    adjoint = columns.conj().swapaxes(-1, -2)
    gram = (adjoint @ columns).real
    regular = 1e-12 * np.trace(gram, axis1=-2, axis2=-1)[:, None, None] * np.eye(5)
    return gram + regular, adjoint @ force


def _refined(log: FloatArray, step: float) -> tuple[float, float]:
    """Argument of the maximum of a periodic log likelihood, from its first, and its standard deviation."""
    k = int(np.argmax(log))
    before, here, after = (float(log[(k + j) % len(log)]) for j in (-1, 0, 1))
    curvature = 2.0 * here - before - after
    if curvature <= 0.0:
        return k * step, np.inf
    return float((k + 0.5 * (after - before) / curvature) * step), float(step / np.sqrt(curvature))


def common_angle(near: float, logs: FloatArray, step: float) -> tuple[float, float]:
    """Random-effects mean of the windows' angles, and its sd.

    Parameters
    ----------
    near : float
        The likeliest of all windows together, from the first of the angles, rad.
    logs : (w, p) float
        Log likelihood of each window at angles ``step`` apart, of a period of half a turn.
    step : float
    """
    each = np.array([_refined(log, step) for log in logs])
    off = np.mod(each[:, 0] - near + 0.5 * np.pi, np.pi) - 0.5 * np.pi
    weight = each[:, 1] ** -2.0
    if not weight.any():
        return near, np.inf
    mean = weight @ off / weight.sum()
    spread = weight @ (off - mean) ** 2 - (len(off) - 1)
    between = max(spread / (weight.sum() - weight @ weight / weight.sum()), 0.0)
    weight = 1.0 / (each[:, 1] ** 2 + between)
    return float(near + weight @ off / weight.sum()), float(weight.sum() ** -0.5)


def axes_check(found: Oscillation, force: BridgedSensor, rate: BridgedSensor) -> Check:
    """Whether both sensors have one set of axes, as far as the oscillation shows it."""
    names = f"{force.spec.name} and {rate.spec.name}"
    off = found.kind in (ROLL, MIRRORED)
    good = f"their oscillations lie in one plane ({found.windows} spans)"
    if found.kind == MIRRORED:
        slip = _SLIPS[round(found.roll_rad / (0.5 * np.pi)) % 4]
        bad, advice = "their oscillations are mirror images", f"check {slip}"
    else:
        turned = np.rad2deg(found.roll_rad)
        bad = f"{force.spec.name} is turned {turned:+.1f} ± {np.rad2deg(found.roll_sd_rad):.1f} deg about roll against "
        bad += rate.spec.name
        advice = "check the mount and the column order of both"
    value = max(found.gain, ACCEPTED_ODDS + 1.0) if off else 0.0
    limits, kind = (0.0, ACCEPTED_ODDS), found.kind
    return Check.of("triads-axes", f"axes of {names}", value, *limits, good, bad, advice=advice, component=kind)

"""Where was the vehicle, how was it oriented, and how accurately is that known, if the data are as stated?

One estimate: inertial sensors propagate the state, trackers (radars, receivers, barometers) correct it, a smoother
carries later data back to every earlier time, and the whole is repeated about the smoothed trajectory until that no
longer changes the result (`Settings.passes`):

    x_{k+1} = f(x_k, inertial samples) + w,   z = h(x_k) + v;   x = kinematics and sensor errors

Aerodynamics and atmosphere take no part: the answer is inertial, and aerodynamic quantities can be derived from it. A
flight without inertial sensors is propagated by gravity and drag in the sounding's air instead (`recon.propagation`).
First passes use thinned data about the filter's own estimate, later ones all data about the smoothed trajectory
(Gauss-Newton); of ballistic flight with a measured deceleration one pass about the filter's own estimate is all
(`recon.first_passes`). What an estimate contradicts is changed by `recon.reconstruct`; jumps of the inertial clocks
and transient offsets of readings, which spoil the filter itself, are screened here.

The answer is of the datum, and of the accelerometer's samples. From the accelerometer (at ``r`` from the datum, body
axes) to the datum:

    p = p_imu - C r,   v = v_imu - C (w x r),   w = gyro rate - C^T W

and the errors move with them: ``dp = dp_imu + C [r x] d``, ``dv = dv_imu + C [(w x r) x] d + C [r x] dw`` with
rotation error ``d`` and rate error ``dw`` from the gyros' estimated errors, their clock's too, and white noise. In
ballistic flight the tracked point is the datum and the attitude unknown, with the covariance of an unknown attitude.

References
----------
P. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd ed., chapters 3 and 14.
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import pandas as pd

from flightmodel import rotations
from flightmodel.checks import Check, FloatArray, Issue, Progress
from flightmodel.earth import WGS84, name_of
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory, interpolate_rows
from recon import (
    consistency,
    fault_isolation,
    first_passes,
    imu_screening,
    kalman,
    oscillation,
    survey,
    time_bias,
    tracker_time,
)
from recon.consistency import held_out_table
from recon.deceleration import deceleration_checks
from recon.entry_density import DragHistory, drag_of_drivers, drag_of_readings
from recon.fault_detection import (
    UnmodelledAcceleration,
    carried_check,
    jumps_of_clocks,
    unsupported_offsets,
    with_unmodelled,
)
from recon.fault_isolation import NO_ADAPTATION, Adaptation, LeftOut
from recon.first_passes import SpinPhase
from recon.hypotheses import Explanation
from recon.imu_screening import BridgedSensor
from recon.kalman import Smoothed
from recon.measurements import DECELERATION
from recon.problem import Problem, with_servo_lag
from recon.propagation import correct, correction_partials
from recon.settings import Settings
from recon.setup import InertialSensors, build_problem
from recon.state import KINEMATIC, States, unpacked

_BLOCK = 1 << 16  # samples that are corrected at a time
_NODES = 512  # whose covariances are unpacked at a time


@dataclass(frozen=True)
class TrajectorySolution:
    """Best-estimated trajectory with sensor errors, residuals, consistency checks and findings.

    Parameters
    ----------
    smoothed, filtered : Trajectory
        Of the datum, with covariance; ``filtered`` uses data up to each time (in the last pass).
    sensor_errors : DataFrame
        ``name, unit, treated, prior_sd, estimate, sd``; of Gauss-Markov errors, the value at mid-span.
    residuals : DataFrame
        ``time_s, source, component, residual, predicted_sd, accepted, used``: innovations of the last pass, SI; what is
        not used was held out and only checks.
    held_out : DataFrame
        ``time_s, source, component, residual, predicted_sd``: measurements that were not used, against the smoothed
        trajectory (`recon.consistency`).
    consistency_checks : tuple of Check
    imu_time_s : (k,) float
        Times of the accelerometer's valid samples outside gyro gaps.
    specific_force_body_mps2, rate_body_radps : (k, 3) float
        At the accelerometer, corrected for estimated bias, scale and mount; not smoothed.
    specific_force_cov, rate_cov : (n, 3, 3) float
        Systematic error covariance of the corrected specific force, (m/s^2)^2, and rates, (rad/s)^2, on the
        trajectory's times; empty without inertial sensors.
    accelerometer_root : (n, 6, 9) float
        Rotation and specific force error per unit normal of the accelerometer's errors, `accelerometer_root`.
    triad_root : (n, 9, 18) float
        Rotation, specific force and rate error per unit normal of both triads' errors, `triad_root`.
    findings : tuple of Issue
        Gaps that were bridged, stretches of radar track that were edited, and so on.
    provenance : dict
    left_out : tuple of LeftOut
        Leave-one-out comparison of the trackers, where a check about one failed.
    adaptation : Adaptation
        What was found in the data, for other reconstructions that are to be compared with this one.
    single_faults : tuple of Explanation
        Single hypotheses that explain what failed, the likeliest first.
    drag : DragHistory or None
        What the deceleration says of the air; None without accelerometer and drag.
    """

    smoothed: Trajectory
    filtered: Trajectory
    sensor_errors: pd.DataFrame
    residuals: pd.DataFrame
    held_out: pd.DataFrame
    consistency_checks: tuple[Check, ...]
    imu_time_s: FloatArray
    specific_force_body_mps2: FloatArray
    rate_body_radps: FloatArray
    specific_force_cov: FloatArray
    rate_cov: FloatArray
    accelerometer_root: FloatArray
    triad_root: FloatArray
    findings: tuple[Issue, ...]
    provenance: dict[str, object]
    left_out: tuple[LeftOut, ...] = ()
    adaptation: Adaptation = NO_ADAPTATION
    single_faults: tuple[Explanation, ...] = ()
    drag: DragHistory | None = None

    @property
    def settings(self) -> Settings:
        """Settings of the estimate."""
        chosen = self.provenance["settings"]
        assert isinstance(chosen, dict)
        return Settings(**chosen)

    @property
    def output_rate_hz(self) -> float:
        """Rate of the trajectories outside the pulse."""
        return self.settings.output_rate_hz


def trackers(telemetry: Telemetry, settings: Settings) -> tuple[str, ...]:
    """Radars, receivers and barometers that are used."""
    names = (*telemetry.radars, *telemetry.gnss, *telemetry.barometers)
    return tuple(name for name in names if name not in settings.without)


def estimate(
    telemetry: Telemetry,
    settings: Settings,
    progress: Progress | None = None,
    adaptation: Adaptation = NO_ADAPTATION,
) -> TrajectorySolution:
    """Estimate a flight with the covariance as the filter has it, whatever its consistency checks find.

    ``adaptation`` is what an earlier estimate found in the same data; clock jumps and transient offsets are looked for
    where it does not state them.
    """
    report = progress or (lambda _fraction, _what: None)
    screened, settled = adaptation, False
    while not settled:  # clock jumps first, then transient offsets
        adaptation = screened
        report(0.0, "bridging gaps")
        sensors = bridge_inertial_sensors(telemetry, adaptation)
        problem = _adapted_problem(telemetry, settings, sensors, adaptation)
        problem, run, smoothed, reference, passes, spans, phase = _iterate(problem, settings, report)
        screened = _screened(telemetry, problem, run, sensors, adaptation)
        known = adaptation.jumps or (), adaptation.rejected_offsets or ()
        settled = (screened.jumps, screened.rejected_offsets) == known
    adaptation = screened

    report(0.95, "testing consistency")
    mount = _mounting(telemetry, sensors)
    table = sensor_error_table(problem, reference, smoothed)
    checks = consistency.source_checks(problem, run.innovations, settings.check_confidence)
    checks += consistency.filter_against_smoother(problem, run, smoothed, reference, settings.check_confidence)
    checks += deceleration_checks(telemetry, problem, run, settings.check_confidence)
    checks += consistency.data_sheet_checks(problem, table, settings.check_confidence)
    checks += [] if phase is None else [phase.check()]
    checks += [] if sensors is None else [carried_check(spans)]
    checks += consistency.physical_checks(problem, run, table, telemetry.radars)
    held_out = held_out_table(problem, run)
    checks += consistency.held_out_checks(problem, held_out, settings)
    missed = survey.missed_places(problem, run, reference, mount.arm_body_m, telemetry.places)
    tracked = bool(trackers(telemetry, settings))
    checks += survey.place_checks(missed, settings.check_confidence, tracked)
    filtered = datum_trajectory(problem, mount, run.states(), run.filtered.p_plus)
    residuals = consistency.residual_table(problem, run.innovations)
    edits = consistency.point_findings(problem, run.innovations.accepted, held_out, settings)
    about = run.charts
    del run  # as large as all that follows together
    if sensors is not None and adaptation.lag is None:
        more, adaptation = _oscillation_checks(telemetry, settings, sensors, problem, reference, adaptation)
        checks += more
    series = _series(problem, sensors, reference, smoothed)
    findings = _sensor_findings(telemetry, sensors, adaptation)
    report(1.0, "done")
    path = datum_trajectory(problem, mount, reference, smoothed.triangles)
    return TrajectorySolution(
        smoothed=path,
        filtered=filtered,
        sensor_errors=table,
        residuals=residuals,
        held_out=held_out,
        consistency_checks=tuple(checks),
        imu_time_s=series[0],
        specific_force_body_mps2=series[1],
        rate_body_radps=series[2],
        specific_force_cov=series[3],
        rate_cov=series[4],
        accelerometer_root=series[5],
        triad_root=series[6],
        findings=(*findings, *(span.finding() for span in spans), *edits),
        provenance=_provenance(telemetry, settings, problem, passes),
        adaptation=adaptation,
        drag=drag_of_drivers(problem, reference, smoothed.triangles, path, about)
        if sensors is None
        else drag_of_readings(telemetry, path, series[0], series[1], series[3]),
    )


def _provenance(telemetry: Telemetry, settings: Settings, problem: Problem, passes: int) -> dict[str, object]:
    """Inputs and provenance of a trajectory."""
    return {
        "flight": telemetry.name,
        "settings": asdict(settings),
        "start_s": float(problem.time_s[0]),
        "end_s": float(problem.time_s[-1]),
        "nodes": len(problem.time_s),
        "states": problem.size,
        "passes": passes,
        "motion": "ballistic" if problem.motion.ballistic else "strapdown",
        "hashes": dict(telemetry.hashes),
        **_assumptions(telemetry),
    }


def _adapted_problem(
    telemetry: Telemetry, settings: Settings, sensors: InertialSensors | None, adaptation: Adaptation
) -> Problem:
    telemetry = tracker_time.with_earlier_tags(telemetry, adaptation.late_s)
    problem = build_problem(telemetry, settings, sensors, adaptation.rejected_points)
    problem = fault_isolation.with_inflated_priors(problem, adaptation.inflated_sd)
    if sensors is None:
        return problem
    return time_bias.with_lag(problem, adaptation.lag, sensors.force.spec.name, sensors.rate.spec.name)


@dataclass(frozen=True)
class Linearised:
    """A flight's reconstructed states at all nodes, about which others of the same data and other noise are linearised.

    Parameters
    ----------
    states : States
    adaptation : Adaptation
    unmodelled : tuple of UnmodelledAcceleration
    sensors : InertialSensors or None
    """

    states: States
    adaptation: Adaptation
    unmodelled: tuple[UnmodelledAcceleration, ...]
    sensors: InertialSensors | None

    def problem_of(self, telemetry: Telemetry, settings: Settings) -> Problem:
        """Problem of the same flight with other standard deviations; its data are screened as before."""
        sensors = self.sensors
        if sensors is not None and telemetry.accelerometer is not None and telemetry.rates is not None:
            force = imu_screening.with_noise(sensors.force, telemetry.accelerometer.spec.noise_sd)
            sensors = InertialSensors(force, imu_screening.with_noise(sensors.rate, telemetry.rates.spec.noise_sd))
        problem = _adapted_problem(telemetry, settings, sensors, self.adaptation)
        return with_unmodelled(with_servo_lag(problem, self.states), self.unmodelled)


def linearised(telemetry: Telemetry, settings: Settings) -> Linearised:
    """Reconstruct a flight as `estimate` does, for its states at all nodes."""
    adaptation = estimate(telemetry, settings).adaptation
    sensors = bridge_inertial_sensors(telemetry, adaptation)
    problem = _adapted_problem(telemetry, settings, sensors, adaptation)
    *_, states, _, unmodelled, _ = _iterate(problem, settings, lambda _fraction, _what: None)
    return Linearised(states, adaptation, unmodelled, sensors)


def _assumptions(telemetry: Telemetry) -> dict[str, object]:
    """Assumptions that replace a missing sensor, and the planet if it is not the Earth."""
    out: dict[str, object] = {} if telemetry.planet == WGS84 else {"planet": name_of(telemetry.planet)}
    trim_deg = float(np.rad2deg(telemetry.motion.trim_sd_rad))
    if trim_deg > 0.0:
        out["attitude"] = (
            f"assumed: trimmed, body x along the velocity against the air within {trim_deg:.2g} deg (1 sd)"
        )
    return out


def _oscillation_checks(
    telemetry: Telemetry,
    settings: Settings,
    sensors: InertialSensors,
    problem: Problem,
    states: States,
    known: Adaptation,
) -> tuple[list[Check], Adaptation]:
    """Checks of both triads against each other by the oscillation, and the adaptation with what it shows."""
    force, rate, checks = sensors.force, sensors.rate, []
    span = float(problem.time_s[0]), float(problem.time_s[-1])
    speed = problem.time_s, np.linalg.norm(states.velocity_ecef_mps, axis=-1)
    swings = oscillation.oscillation(force, rate, *span, telemetry.vehicle, speed)
    if swings is not None:
        checks.append(oscillation.axes_check(swings, force, rate))
        known = replace(known, oscillation=swings)
    about_s = 0.0 if swings is None else swings.lag_s
    lag = time_bias.lag_between(force, rate, states, problem.time_s, about_s=about_s)
    if lag is not None and (swings is None or swings.kind in (oscillation.DELIVERED, oscillation.LAG)):
        checks.append(time_bias.lag_check(lag, force, rate, settings.check_confidence))
        known = replace(known, lag=None if checks[-1].passed else lag)
    return checks, known


def _screened(
    telemetry: Telemetry,
    problem: Problem,
    run: kalman.ForwardPass,
    sensors: InertialSensors | None,
    adaptation: Adaptation,
) -> Adaptation:
    """Adaptation with clock jumps and, once these are corrected, transient offsets that are rejected."""
    if sensors is None or telemetry.accelerometer is None or telemetry.rates is None:
        return replace(adaptation, jumps=(), rejected_offsets=())
    both = sensors.force, sensors.rate
    if adaptation.jumps is None:
        jumps = jumps_of_clocks(problem, run, (telemetry.accelerometer, telemetry.rates), both)
        adaptation = replace(adaptation, jumps=jumps)
        if jumps:
            return adaptation
    if adaptation.rejected_offsets is None:
        rejected = unsupported_offsets(problem, run, (*both[0].offsets, *both[1].offsets))
        adaptation = replace(adaptation, rejected_offsets=rejected)
    return adaptation


def bridge_inertial_sensors(telemetry: Telemetry, adaptation: Adaptation = NO_ADAPTATION) -> InertialSensors | None:
    """Accelerometer and gyros with gaps and rejected readings bridged; None where the flight has none."""
    records = telemetry.accelerometer, telemetry.rates
    if records[0] is None or records[1] is None or telemetry.motion.model == "ballistic":
        return None
    out = []
    for number, record in enumerate(r for r in records if r is not None):
        rejected = tuple(d for d in adaptation.rejected_offsets or () if d.sensor == number)
        tags = imu_screening.with_corrected_tags(record, number, adaptation.jumps or ())
        out.append(imu_screening.bridge(tags, number, rejected))
    return InertialSensors(*out)


def _mounting(telemetry: Telemetry, sensors: InertialSensors | None) -> Mounting:
    if sensors is None:
        return Mounting(telemetry.t0_utc, np.zeros(3), None)
    arm = sensors.force.spec.position_from_datum_body_m
    return Mounting(telemetry.t0_utc, arm, sensors.rate)


def _sensor_findings(telemetry: Telemetry, sensors: InertialSensors | None, adaptation: Adaptation) -> list[Issue]:
    """What the inertial sensors' samples show by themselves."""
    findings = [] if sensors is None else [*sensors.force.findings, *sensors.rate.findings]
    if telemetry.drag_accelerometer is not None:
        findings += imu_screening.frozen_findings(telemetry.drag_accelerometer)
    if sensors is not None:
        findings += imu_screening.jump_findings(
            adaptation.jumps or (), (sensors.force.spec.name, sensors.rate.spec.name)
        )
    return findings


def _series(
    problem: Problem, sensors: InertialSensors | None, states: States, smoothed: Smoothed
) -> tuple[FloatArray, ...]:
    """Corrected specific force and rates with their times, and at kept nodes how well both are known."""
    if sensors is None:
        return tuple(np.empty(s) for s in ((0,), (0, 3), (0, 3), (0, 3, 3), (0, 3, 3), (0, 6, 9), (0, 9, 18)))
    series = corrected_series(problem, sensors.force, sensors.rate, states)
    known = (specific_force_cov, rate_cov, accelerometer_root, triad_root)
    return (*series, *(make(problem, states, smoothed.triangles) for make in known))


def _iterate(
    problem: Problem, settings: Settings, report: Progress
) -> tuple[Problem, kalman.ForwardPass, Smoothed, States, int, tuple[UnmodelledAcceleration, ...], SpinPhase | None]:
    """Problem with servo lag, last forward pass, smoothed errors and states, passes, unmodelled accelerations.

    Last, what the phase of a fast spin was chosen from.
    """
    reference, phase = None, None
    found: tuple[UnmodelledAcceleration, ...] = ()
    passes = 0 if first_passes.needs_no_reference(problem) else settings.passes
    if passes > 0:
        report(0.02, "first passes on thinned data")
        reference, found, phase = first_passes.first_reference(problem, settings)
    most, i = max(1, passes), 0
    while True:
        share = 0.85 / most
        report(0.1 + share * i, f"filter, pass {i + 1}")
        problem = with_servo_lag(problem, reference)
        run, found = first_passes.follow_track(problem, reference, settings, found)
        report(0.1 + share * (i + 0.6), f"smoother, pass {i + 1}")
        smoothed = kalman.smooth(problem, run)
        kept = np.flatnonzero(problem.kept)
        moved = np.abs(smoothed.x[kept]) / np.sqrt(np.maximum(smoothed.variance, 1e-300))
        smoothed_states = smoothed.states(run.charts)
        i += 1
        if moved.max() < 0.01 or i == most:
            return problem, run, smoothed, smoothed_states, i, found, phase
        reference = first_passes.bounded_drivers(problem, smoothed_states)
        del run, smoothed  # as large as all else together, and the next pass makes its own


@dataclass(frozen=True)
class Mounting:
    """For moving a node to the datum: epoch, accelerometer from datum (3,), m, and the gyros, if there are."""

    epoch_utc: str
    arm_body_m: FloatArray
    rate: BridgedSensor | None


def datum_trajectory(problem: Problem, mounting: Mounting, states: States, triangles: FloatArray) -> Trajectory:
    """Trajectory of the datum at the kept nodes from states at all nodes and packed covariances at the kept ones."""
    kept = np.flatnonzero(problem.kept)
    states = states[kept]
    n, planet = len(kept), problem.motion.planet
    if mounting.rate is None:
        covariance = unpacked(triangles, KINEMATIC)
        covariance[:, 6:9] = 0.0
        covariance[:, :, 6:9] = 0.0
        covariance[:, range(6, 9), range(6, 9)] = np.pi**2 / 3.0  # angles that may be anything
        if any(i.kind == DECELERATION for i in problem.instruments):
            covariance[:, 3:6, 3:6] += turned_velocity_cov(states.velocity_ecef_mps, covariance[:, 3:6, 3:6])
        return Trajectory(
            mounting.epoch_utc, problem.time_s[kept], "datum", states.position_ecef_m, states.velocity_ecef_mps,
            states.q_ecef_body, np.tile(planet.rate_ecef_radps, (n, 1)), covariance, planet,
        )  # fmt: skip
    motion = problem.motion
    rate, errors = mounting.rate, states.sensor_errors[:, 9:18]
    tagged = problem.time_s[kept] + (states.sensor_errors[:, 19] if motion.clocks else 0.0)
    step = float(np.median(np.diff(rate.time_s)))
    before, measured, after = (
        interpolate_rows(at, rate.time_s, rate.measured_sensor) for at in (tagged - step, tagged, tagged + step)
    )
    slope = (after - before) / (2.0 * step)
    c = rotations.dcm_from_q(states.q_ecef_body)
    omega = correct(measured, errors, motion.dcm_body_rate)
    r = mounting.arm_body_m
    lever_velocity = np.cross(omega - planet.rate_radps * c[:, 2], r)

    covariance = np.empty((n, 9, 9))
    for first in range(0, n, _NODES):  # unpacked, the nodes' covariances are the largest of all arrays
        k = slice(first, first + _NODES)
        lever = c[k] @ rotations.skew(r)
        by_gyros = lever @ correction_partials(measured[k], errors[k], motion.dcm_body_rate)
        move = np.zeros((len(lever), 9, KINEMATIC + motion.drivers))
        move[:, range(9), range(9)] = 1.0
        move[:, 0:3, 6:9] = lever
        move[:, 3:6, 6:9] = c[k] @ rotations.skew(lever_velocity[k])
        move[:, 3:6, 18:27] = by_gyros
        if motion.clocks:  # a late tag reads too little of what grows, as a bias would
            move[:, 3:6, 28] = -np.einsum("nij,nj->ni", by_gyros[:, :, 0:3], slope[k])
        moved = move @ unpacked(triangles[k], move.shape[2]) @ np.swapaxes(move, 1, 2)
        moved[:, 3:6, 3:6] += rate.spec.noise_sd**2 * lever @ np.swapaxes(lever, 1, 2)
        covariance[k] = 0.5 * (moved + np.swapaxes(moved, 1, 2))
    return Trajectory(
        mounting.epoch_utc, problem.time_s[kept], "datum", states.position_ecef_m - c @ r,
        states.velocity_ecef_mps - np.einsum("nij,nj->ni", c, lever_velocity), states.q_ecef_body, omega, covariance,
        planet,
    )  # fmt: skip


def turned_velocity_cov(velocity_mps: FloatArray, covariance: FloatArray) -> FloatArray:
    """Second-order covariance (n, 3, 3) of velocities whose magnitude, not direction, is known from a deceleration.

    Turned by an unknown lift, a velocity ``V`` that errs by ``c`` across has ``|c|^2 / (2 V)`` less along, of normal
    ``c`` with covariance ``A`` a mean square of ``(tr(A)^2 + 2 tr(A^2)) / (4 V^2)``; ``V^2`` is that of both parts.
    """
    square = np.sum(velocity_mps**2, axis=1)
    along = velocity_mps / np.sqrt(square)[:, None]
    outer = along[:, :, None] * along[:, None, :]
    across = np.eye(3) - outer
    left = across @ covariance @ across
    trace = np.trace(left, axis1=1, axis2=2)
    mean = (trace**2 + 2.0 * np.sum(left**2, axis=(1, 2))) / (4.0 * (square + trace))
    return np.asarray(mean[:, None, None] * outer)


def corrected_series(
    problem: Problem, force: BridgedSensor, rate: BridgedSensor, states: States
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (k,), corrected specific force and rate (k, 3), body axes, at accelerometer samples that both measure."""
    t = force.time_s
    k = np.clip(np.searchsorted(rate.time_s, t, side="right") - 1, 0, len(rate.time_s) - 1)
    # the sample from which a gap begins is measured; one of the other's bridge may have its time
    in_rate_gap = rate.in_gap[k] & (rate.of_bridge[k] | (t - rate.time_s[k] > 1e-6))
    keep = ~force.of_bridge & ~in_rate_gap & (t >= problem.time_s[0]) & (t <= problem.time_s[-1])
    t, measured_force = t[keep], force.measured_sensor[keep]
    specific_force, rates = np.empty((2, len(t), 3))
    for first in range(0, len(t), _BLOCK):  # eighteen errors a sample are six times the samples
        part = slice(first, first + _BLOCK)
        errors = interpolate_rows(t[part], problem.time_s, states.sensor_errors[:, :18])
        specific_force[part] = correct(measured_force[part], errors[:, 0:9], problem.motion.dcm_body_force)
        measured_rate = interpolate_rows(t[part], rate.time_s, rate.measured_sensor)
        rates[part] = correct(measured_rate, errors[:, 9:18], problem.motion.dcm_body_rate)
    return t, specific_force, rates


def _force_partials(problem: Problem, states: States) -> FloatArray:
    """Partials (k, 3, 9) of the corrected specific force at kept nodes by the accelerometer's errors."""
    measured = problem.motion.force_sensor_mps2[problem.node_index[problem.kept]]
    return correction_partials(measured, states.sensor_errors[problem.kept, 0:9], problem.motion.dcm_body_force)


def _rate_partials(problem: Problem, states: States) -> FloatArray:
    """Partials (k, 3, 9) of the corrected rates at kept nodes by the gyros' errors."""
    measured = problem.motion.rate_sensor_radps[problem.node_index[problem.kept]]
    return correction_partials(measured, states.sensor_errors[problem.kept, 9:18], problem.motion.dcm_body_rate)


def specific_force_cov(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Systematic error covariance (k, 3, 3) of the corrected specific force at kept nodes, body axes, (m/s^2)^2."""
    partials = _force_partials(problem, states)
    covariance = unpacked(triangles, 18)[:, 9:18, 9:18]
    return np.asarray(partials @ covariance @ np.swapaxes(partials, 1, 2))


def accelerometer_root(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Response (k, 6, 9) of rotation error and specific force error, body axes, at kept nodes to nine unit normals.

    The nine stand for the accelerometer's constant errors: ``root @ root.T`` of the lower rows is the covariance of
    the corrected specific force, the upper rows are the part of the attitude's error correlated with them.
    Gauss-Markov errors are taken as they are at mid-span.
    """
    attitude, root = _constant_errors(unpacked(triangles, 18))
    return np.concatenate([attitude, _force_partials(problem, states) @ root], axis=1)


def _constant_errors(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Responses of rotation (k, 3, m) and of the m errors behind the motion (m, m) to unit normals, at mid-span."""
    variance, axes = np.linalg.eigh(covariance[len(covariance) // 2, 9:, 9:])
    sd = np.sqrt(np.maximum(variance, 0.0))
    inverse = np.divide(1.0, sd, out=np.zeros(len(sd)), where=sd > 1e-12)
    return covariance[:, 6:9, 9:] @ (axes * inverse), axes * sd


def triad_root(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Response (k, 9, 18) of rotation, specific force and rate errors, body axes, at kept nodes to unit normals.

    As `accelerometer_root`, of the constant errors of accelerometer and gyros together: what a gyro's mounting does to
    the attitude rolls with the vehicle.
    """
    force, rate = _force_partials(problem, states), _rate_partials(problem, states)
    attitude, root = _constant_errors(unpacked(triangles, 27))
    return np.concatenate([attitude, force @ root[0:9], rate @ root[9:18]], axis=1)


def rate_cov(problem: Problem, states: States, triangles: FloatArray) -> FloatArray:
    """Systematic error covariance (k, 3, 3) of the corrected rates at kept nodes, body axes, (rad/s)^2."""
    partials = _rate_partials(problem, states)
    covariance = unpacked(triangles, 27)[:, 18:27, 18:27]
    return np.asarray(partials @ covariance @ np.swapaxes(partials, 1, 2))


def sensor_error_table(problem: Problem, states: States, smoothed: Smoothed) -> pd.DataFrame:
    """Prior and posterior of every error; of Gauss-Markov errors, the value at mid-span."""
    kept = np.flatnonzero(problem.kept)
    row = len(kept) // 2
    model = problem.model
    return pd.DataFrame(
        {
            "name": model.names,
            "unit": model.units,
            "treated": np.where(model.wander.considered, "considered", "estimated"),
            "prior_sd": model.prior_sd,
            "estimate": states.sensor_errors[kept[row]],
            "sd": np.sqrt(smoothed.variance[row, 9:]),
        }
    )

"""Where was the vehicle, how was it oriented, and how accurately is that known? The best-estimated trajectory.

Inertial sensors propagate the state, trackers (radars, receivers, barometers) correct it, a smoother carries later data
back to every earlier time, and the whole is repeated about the smoothed trajectory until that no longer changes the
result (`Settings.passes`):

    x_{k+1} = f(x_k, inertial samples) + w,   z = h(x_k) + v;   x = kinematics and sensor errors

Aerodynamics and atmosphere take no part: the answer is inertial, and aerodynamic quantities can be derived from it. A
flight without inertial sensors is propagated by gravity and drag in the sounding's air instead (`recon.propagation`).

What the data contradict is found on the way and the flight reconstructed again: jumps of the inertial clocks, transient
offsets of readings, a priori uncertainties that are too small, trackers that contradict the rest
(`recon.fault_isolation`). First passes use thinned data about the filter's own estimate, later ones all data about the
smoothed trajectory (Gauss-Newton).

References
----------
P. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd ed., chapters 3 and 14.
B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray, Progress
from flightmodel.telemetry import Finding, Telemetry
from flightmodel.trajectory import Trajectory
from recon import (
    consistency,
    ekf,
    fault_isolation,
    imu_screening,
    product,
    propagation,
    setup,
    smoother,
    time_bias,
)
from recon.consistency import ConsistencyCheck, held_out_table
from recon.ekf import FIT_SPAN_S, Problem
from recon.fault_detection import (
    UNMODELLED_CODE,
    UnmodelledAcceleration,
    track_is_lost,
    unsupported_offsets,
    with_one_more,
    with_unmodelled,
)
from recon.fault_isolation import INFLATION, NO_ADAPTATION, Adaptation, LeftOut
from recon.settings import Settings
from recon.setup import InertialSensors, build_problem
from recon.smoother import Smoothed
from recon.state import ROTATION, States, boxminus, unpacked

_LEAVE_ONE_OUT_RATE_HZ = 5.0  # of the trajectories in which one tracker is left out
# code, name and advice for the a priori errors of a ballistic flight's air and vehicle
_BALLISTIC_CHECKS = {
    "air": ("sounding", "sounding", "is beyond the sounding's uncertainty: check its units, its time and place"),
    "vehicle": (
        "pre-flight-drag",
        "pre-flight drag",
        "is beyond the pre-flight uncertainty: check mass, area and coefficients",
    ),
}
_THINNED_STEP_S = 0.5
_MOST_THINNED_PASSES = 6
_FARTHEST_SD = 3.0
_CONVERGED_RAD = 0.01  # second-order terms of a rotation this small are 5e-5 of its effect
_CONVERGED_SD = 0.01  # a pass that changes nothing by more than this part of its sd is the last


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
    consistency_checks : tuple of ConsistencyCheck
    imu_time_s : (k,) float
        Times of the accelerometer's valid samples outside gyro gaps.
    specific_force_body_mps2, rate_body_radps : (k, 3) float
        At the accelerometer, corrected for estimated bias, scale and mount; not smoothed.
    specific_force_cov, rate_cov : (n, 3, 3) float
        Systematic error covariance of the corrected specific force, (m/s^2)^2, and rates, (rad/s)^2, on the
        trajectory's times; empty without inertial sensors.
    accelerometer_root : (n, 6, 9) float
        Rotation and specific force error per unit normal of the accelerometer's errors, `product.accelerometer_root`.
    triad_root : (n, 9, 18) float
        Rotation, specific force and rate error per unit normal of both triads' errors, `product.triad_root`.
    findings : tuple of Finding
        Gaps that were bridged, stretches of radar track that were edited, and so on.
    provenance : dict
    left_out : tuple of LeftOut
        Leave-one-out comparison of the trackers, where a check about one failed.
    adaptation : Adaptation
        What was found in the data, for other reconstructions that are to be compared with this one.
    """

    smoothed: Trajectory
    filtered: Trajectory
    sensor_errors: pd.DataFrame
    residuals: pd.DataFrame
    held_out: pd.DataFrame
    consistency_checks: tuple[ConsistencyCheck, ...]
    imu_time_s: FloatArray
    specific_force_body_mps2: FloatArray
    rate_body_radps: FloatArray
    specific_force_cov: FloatArray
    rate_cov: FloatArray
    accelerometer_root: FloatArray
    triad_root: FloatArray
    findings: tuple[Finding, ...]
    provenance: dict[str, object]
    left_out: tuple[LeftOut, ...] = ()
    adaptation: Adaptation = NO_ADAPTATION

    @property
    def settings(self) -> Settings:
        """Settings that it was made with."""
        chosen = self.provenance["settings"]
        assert isinstance(chosen, dict)
        return Settings(**chosen)

    @property
    def output_rate_hz(self) -> float:
        """Rate of the trajectories outside the pulse."""
        return self.settings.output_rate_hz


def reconstruct(
    telemetry: Telemetry, settings: Settings | None = None, progress: Progress | None = None
) -> TrajectorySolution:
    """Reconstruct a flight; where a check about a tracker fails, compare solutions without each tracker.

    Parameters
    ----------
    telemetry : Telemetry
    settings : Settings, optional
        Those of ``[reconstruction]`` in the flight's file where not given.
    progress : callable, optional
        Called with the fraction done and what is being done.

    Raises
    ------
    GateError
        Where the data cannot start or carry a filter (no common span, too few points, prior out of reach).
    """
    settings = settings or Settings.from_mapping(telemetry.reconstruction)
    report = progress or (lambda _fraction, _what: None)
    solution = reconstruct_once(telemetry, settings, lambda f, what: report(0.5 * f, what))
    inflated = fault_isolation.inflated_priors(solution.consistency_checks, solution.sensor_errors)
    inflated |= _inflated_clocks(telemetry, solution)
    if inflated:
        solution = _with_inflated_priors(telemetry, settings, solution, inflated)
    sources = trackers(telemetry, settings)
    if len(sources) > 1 and fault_isolation.any_tracker_fails(solution.consistency_checks, sources):
        solution = _compared_leaving_one_out(telemetry, settings, solution, sources, report)
    report(1.0, "done")
    return solution


def _with_inflated_priors(
    telemetry: Telemetry, settings: Settings, first: TrajectorySolution, inflated_sd: dict[str, float]
) -> TrajectorySolution:
    """Solution with inflated priors; its checks, which judge what was stated, stay those of the first."""
    again = reconstruct_once(telemetry, settings, adaptation=replace(first.adaptation, inflated_sd=inflated_sd))
    span = again.smoothed.time_s[[0, -1]].tolist()
    findings = (
        *again.findings,
        *fault_isolation.prior_inflation_findings(again.sensor_errors, inflated_sd, *span),
    )
    return replace(again, consistency_checks=first.consistency_checks, residuals=first.residuals, findings=findings)


def _inflated_clocks(telemetry: Telemetry, solution: TrajectorySolution) -> dict[str, float]:
    """Standard deviations to take instead of those of the inertial clocks, where they differ by more than stated."""
    lag, sensors = solution.adaptation.lag, (telemetry.accelerometer, telemetry.rates)
    if lag is None:
        return {}
    return {f"{t.spec.name} time bias": INFLATION * abs(lag.lag_s) for t in sensors if t is not None}


def trackers(telemetry: Telemetry, settings: Settings) -> tuple[str, ...]:
    """Radars, receivers and barometers that are used."""
    names = (*telemetry.radars, *telemetry.gnss, *telemetry.barometers)
    return tuple(name for name in names if name not in settings.without)


def _compared_leaving_one_out(
    telemetry: Telemetry, settings: Settings, solution: TrajectorySolution, sources: tuple[str, ...], report: Progress
) -> TrajectorySolution:
    """Solution whose covariance and findings include how far the trackers contradict each other."""
    coarse = min(settings.output_rate_hz, _LEAVE_ONE_OUT_RATE_HZ)
    held_out: dict[str, pd.DataFrame] = {}

    def unmodelled(made: TrajectorySolution) -> int:
        return sum(f.code == UNMODELLED_CODE for f in made.findings)

    def rerun(source: str) -> tuple[Trajectory, tuple[ConsistencyCheck, ...], bool]:
        report(0.5 + 0.5 * sources.index(source) / len(sources), f"without {source}")
        without = replace(settings, without=(*settings.without, source), output_rate_hz=coarse, pulse_rate_hz=0.0)
        other = reconstruct_once(telemetry, without, adaptation=solution.adaptation)
        held_out[source] = other.held_out
        return other.smoothed, other.consistency_checks, unmodelled(other) > unmodelled(solution)

    left_out, added = fault_isolation.leave_one_out(solution.smoothed, sources, rerun)
    rejected = fault_isolation.rejected_points(left_out, held_out, solution.residuals, settings.gate_probability)
    if rejected:
        again = reconstruct_once(telemetry, settings, adaptation=replace(solution.adaptation, rejected_points=rejected))
        if all(v.passed for v in again.consistency_checks) and unmodelled(again) <= unmodelled(solution):
            checks = fault_isolation.edit_checks_with_rejected(again.consistency_checks, again.residuals, rejected)
            return replace(
                again,
                consistency_checks=checks,
                findings=(*again.findings, *fault_isolation.rejected_point_findings(rejected)),
                left_out=tuple(replace(s, inconsistent=False) for s in left_out),
            )
    return replace(
        solution,
        smoothed=fault_isolation.with_added_covariance(solution.smoothed, added),
        filtered=fault_isolation.with_added_covariance(solution.filtered, added),
        findings=(*solution.findings, *fault_isolation.leave_one_out_findings(left_out)),
        left_out=left_out,
    )


def reconstruct_once(
    telemetry: Telemetry,
    settings: Settings,
    progress: Progress | None = None,
    adaptation: Adaptation = NO_ADAPTATION,
) -> TrajectorySolution:
    """Reconstruct a flight with the covariance as the filter has it, whatever its consistency checks find.

    ``adaptation`` is what an earlier reconstruction found in the same data; clock jumps and transient offsets are
    looked for where it does not state them.
    """
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "bridging gaps")
    sensors = bridge_inertial_sensors(telemetry, adaptation)
    problem = build_problem(telemetry, settings, sensors, adaptation.rejected_points)
    problem = fault_isolation.with_inflated_priors(problem, adaptation.inflated_sd)
    if sensors is not None:
        problem = time_bias.with_lag(problem, adaptation.lag, sensors.force.spec.name, sensors.rate.spec.name)
    run, smoothed, reference, passes, spans = _iterate(problem, settings, report)
    screened = _screened(telemetry, problem, run, sensors, adaptation)
    known = adaptation.jumps or (), adaptation.rejected_offsets or ()
    if (screened.jumps, screened.rejected_offsets) != known:
        return reconstruct_once(telemetry, settings, progress, screened)
    adaptation = screened

    report(0.95, "testing consistency")
    mount = _mounting(telemetry, sensors)
    table = product.sensor_error_table(problem, reference, smoothed)
    checks = consistency.source_checks(problem, run.innovations, settings.check_confidence)
    checks += _mcreynolds(problem, run, smoothed, reference)
    checks += _data_sheet_checks(problem, table, settings.check_confidence)
    if sensors is not None and adaptation.lag is None:
        lag = time_bias.lag_between(sensors.force, sensors.rate, reference, problem.time_s)
        if lag is not None:
            checks.append(time_bias.lag_check(lag, sensors.force, sensors.rate, settings.check_confidence))
            adaptation = replace(adaptation, lag=None if checks[-1].passed else lag)
    series = _series(problem, sensors, reference, smoothed)
    findings = [] if sensors is None else [*sensors.force.findings, *sensors.rate.findings]
    if sensors is not None:
        findings += time_bias.jump_findings(adaptation.jumps or (), (sensors.force.spec.name, sensors.rate.spec.name))
    report(1.0, "done")
    return TrajectorySolution(
        smoothed=product.datum_trajectory(problem, mount, reference, smoothed.triangles),
        filtered=product.datum_trajectory(problem, mount, run.states(), run.filtered.p_plus),
        sensor_errors=table,
        residuals=product.residual_table(problem, run.innovations),
        held_out=held_out_table(problem, run, settings.engine),
        consistency_checks=tuple(checks),
        imu_time_s=series[0],
        specific_force_body_mps2=series[1],
        rate_body_radps=series[2],
        specific_force_cov=series[3],
        rate_cov=series[4],
        accelerometer_root=series[5],
        triad_root=series[6],
        findings=(
            *findings,
            *(span.finding() for span in spans),
            *product.edit_findings(problem, run.innovations.accepted),
        ),
        provenance={
            "flight": telemetry.name,
            "settings": asdict(settings),
            "start_s": float(problem.time_s[0]),
            "end_s": float(problem.time_s[-1]),
            "nodes": len(problem.time_s),
            "states": problem.size,
            "passes": passes,
            "motion": "ballistic" if problem.motion.ballistic else "strapdown",
            "hashes": dict(telemetry.hashes),
        },
        adaptation=adaptation,
    )


def _screened(
    telemetry: Telemetry,
    problem: Problem,
    run: ekf.ForwardPass,
    sensors: InertialSensors | None,
    adaptation: Adaptation,
) -> Adaptation:
    """Adaptation with clock jumps and, once these are corrected, transient offsets that are rejected."""
    if sensors is None or telemetry.accelerometer is None or telemetry.rates is None:
        return replace(adaptation, jumps=(), rejected_offsets=())
    both = sensors.force, sensors.rate
    if adaptation.jumps is None:
        jumps = time_bias.jumps_of_clocks(problem, run, (telemetry.accelerometer, telemetry.rates), both)
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
        tags = time_bias.with_corrected_tags(record, number, adaptation.jumps or ())
        out.append(imu_screening.bridge(tags, number, rejected))
    return InertialSensors(*out)


def _mounting(telemetry: Telemetry, sensors: InertialSensors | None) -> product.Mounting:
    if sensors is None:
        return product.Mounting(telemetry.t0_utc, np.zeros(3), None)
    arm = sensors.force.spec.position_from_datum_body_m
    return product.Mounting(telemetry.t0_utc, arm, sensors.rate)


def _series(
    problem: Problem, sensors: InertialSensors | None, states: States, smoothed: Smoothed
) -> tuple[FloatArray, ...]:
    """Corrected specific force and rates with their times, and at kept nodes how well both are known."""
    if sensors is None:
        return tuple(np.empty(s) for s in ((0,), (0, 3), (0, 3), (0, 3, 3), (0, 3, 3), (0, 6, 9), (0, 9, 18)))
    series = product.corrected_series(problem, sensors.force, sensors.rate, states)
    known = (product.specific_force_cov, product.rate_cov, product.accelerometer_root, product.triad_root)
    return (*series, *(make(problem, states, smoothed.triangles) for make in known))


def _mcreynolds(
    problem: Problem, run: ekf.ForwardPass, smoothed: Smoothed, reference: States
) -> list[ConsistencyCheck]:
    """Filter against smoother at the kept nodes after the first seconds."""
    kept = np.flatnonzero(problem.kept)
    settled = problem.time_s[kept] > problem.time_s[0] + FIT_SPAN_S
    difference = boxminus(run.states()[kept], reference[kept])[settled, :9]
    p_filter, p_smoother = (unpacked(t[settled], 9) for t in (run.filtered.p_plus, smoothed.triangles))
    groups = [name for name in consistency.GROUPS if name != "attitude" or not problem.motion.ballistic]
    return consistency.mcreynolds_checks(difference, p_filter, p_smoother, groups)


def _data_sheet_checks(problem: Problem, table: pd.DataFrame, confidence: float) -> list[ConsistencyCheck]:
    """One check for each instrument with errors that the flight made observable."""
    out = []
    owners = np.array(problem.model.instruments, dtype=object)
    estimated = ~problem.model.wander.considered
    for owner in dict.fromkeys(owners[estimated]):
        name = str(owner)
        rows = table[(owners == name) & estimated]
        estimate, prior_sd, sd = rows[["estimate", "prior_sd", "sd"]].to_numpy(dtype=float).T
        code, label, *bad = _BALLISTIC_CHECKS.get(name, ("data-sheet", f"data sheet {name}"))
        errors = [error.removeprefix(f"{name} ") for error in rows["name"]]
        out.append(consistency.data_sheet_check(code, label, name, errors, estimate, prior_sd, sd, confidence, *bad))
    return [v for v in out if v is not None]


def _iterate(
    problem: Problem, settings: Settings, report: Progress
) -> tuple[ekf.ForwardPass, Smoothed, States, int, tuple[UnmodelledAcceleration, ...]]:
    """Last forward pass, smoothed errors and states, how often it ran, spans of unmodelled acceleration."""
    reference = None
    found: tuple[UnmodelledAcceleration, ...] = ()
    if settings.passes > 0:
        report(0.02, "first passes on thinned data")
        reference, found = _first_reference(problem, settings)
    most = max(1, settings.passes)
    for i in range(most):
        share = 0.85 / most
        report(0.1 + share * i, f"filter, pass {i + 1}")
        run, found = _follow_track(problem, reference, settings, found)
        report(0.1 + share * (i + 0.6), f"smoother, pass {i + 1}")
        smoothed = smoother.smooth(problem, run, True, settings.engine)
        kept = np.flatnonzero(problem.kept)
        moved = np.abs(smoothed.x[kept]) / np.sqrt(np.maximum(smoothed.variance, 1e-300))
        smoothed_states = smoothed.states(run.charts)
        if moved.max() < _CONVERGED_SD:
            break
        reference = _bounded_drivers(problem, smoothed_states)
    return run, smoothed, smoothed_states, i + 1, found


def _follow_track(
    problem: Problem, reference: States | None, settings: Settings, found: tuple[UnmodelledAcceleration, ...]
) -> tuple[ekf.ForwardPass, tuple[UnmodelledAcceleration, ...]]:
    """Forward pass with as many spans of unmodelled acceleration as it takes to follow the track, and these."""
    while True:
        run = ekf.forward(with_unmodelled(problem, found), reference, settings.engine)
        more = with_one_more(found, problem, run)
        if more is None:
            return run, found
        found = more


def _bounded_drivers(problem: Problem, states: States) -> States:
    """States to linearise about: drivers of ballistic flight no farther than `_FARTHEST_SD` from their a priori values.

    Drag enters as its logarithm. Linearised in thin air at high speed, a parachute needs a thousandfold drag, and about
    that the next pass would be stiff and far from the truth; any point serves that later passes bring nearer.
    """
    if not problem.motion.ballistic:
        return states
    errors, count = states.sensor_errors.copy(), problem.motion.drivers
    limit = _FARTHEST_SD * problem.model.prior_sd[:count]
    errors[:, :count] = np.clip(errors[:, :count], -limit, limit)
    return replace(states, sensor_errors=errors)


def _first_reference(problem: Problem, settings: Settings) -> tuple[States, tuple[UnmodelledAcceleration, ...]]:
    """Smoothed states at all nodes from a point of each source every `_THINNED_STEP_S`, to convergence."""
    thinned, kept = problem.thinned(_THINNED_STEP_S)
    reference = None
    found: tuple[UnmodelledAcceleration, ...] = ()
    for k in range(_MOST_THINNED_PASSES):
        run, found = _follow_track(thinned, reference, settings, found)
        if k == 0 and problem.motion.ballistic and track_is_lost(thinned, run):
            # after a long gap the filter's prediction is far from the track: linearise about the tracking data
            reference = setup.track_fit_states(problem.instruments, thinned.time_s, problem.model.size)
            run, found = _follow_track(thinned, reference, settings, ())
        smoothed = smoother.smooth(thinned, run, False, settings.engine)
        moved = np.abs(smoothed.x[:, ROTATION]).max() if reference is not None else np.inf
        reference = _bounded_drivers(problem, smoothed.states(run.charts))
        if moved < _CONVERGED_RAD:
            break
    assert reference is not None
    return propagation.fill_between(problem.motion, problem.node_index, kept, reference), found

"""Where the vehicle was and how it was turned: the best estimated trajectory from trackers and inertial sensors.

Inertial sensors carry the state, trackers (radars, receivers, barometers) correct it, a smoother brings what was
learnt later back to every earlier time, and the whole is repeated about the smoothed trajectory until that no longer
moves the result (`Settings.passes`). Aerodynamics and atmosphere take no part: the answer is inertial, and what the
air did can be inferred from it. A flight without inertial sensors is carried by gravity and the drag of the day's air
instead (`recon.ballistic`).

Filter and smooth until it stays: thinned data about the filter's own estimate, then all about the smoothed one.
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
    setup,
    smoother,
    strapdown,
    time_bias,
    unmodelled,
)
from recon.consistency import ConsistencyCheck, withheld_table
from recon.fault_isolation import NOTHING, TIMES, Learnt, LeftOut, beyond_sheet, sheet_findings, with_wider_priors
from recon.problem import FIT_SPAN_S, Problem
from recon.settings import Settings
from recon.setup import Bridges, build_problem
from recon.smoother import Smoothed
from recon.state import ROTATION, States, boxminus, unpacked
from recon.unmodelled import Disturbance, disturbed, doubtful, is_lost, widened

EXAMINED_RATE_HZ = 5.0  # of the trajectories in which one tracker is left out
# what states the errors of a ballistic flight's air and vehicle, and what to say where they are larger
SHEETS = {
    "air": ("sounding", "is further from the sounding than its accuracy allows: check its units, its time and place"),
    "vehicle": ("pre-flight drag", "is larger than stated before flight: check mass, area and coefficients"),
}


@dataclass(frozen=True)
class TrajectorySolution:
    """The best estimated trajectory and everything that was learnt on the way.

    Parameters
    ----------
    smoothed, filtered : Trajectory
        Of the datum, with covariance; ``filtered`` uses data up to each time (in the last pass).
    sensor_errors : DataFrame
        ``name, unit, prior_sd, estimate, sd``; of errors that wander, the value at mid-span.
    residuals : DataFrame
        ``time_s, source, component, residual, predicted_sd, accepted, used``: innovations of the last pass, SI; what is
        not used was withheld and only checks.
    withheld : DataFrame
        ``time_s, source, component, residual, predicted_sd``: measurements that were not used, against the smoothed
        trajectory (`recon.consistency`).
    verdicts : tuple of Verdict
    imu_time_s : (k,) float
        Times of the accelerometer's valid samples outside gyro gaps.
    specific_force_body_mps2, rate_body_radps : (k, 3) float
        At the accelerometer, corrected for estimated bias, scale and mount; not smoothed.
    specific_force_cov, rate_cov : (n, 3, 3) float
        Systematic error covariance of the corrected specific force, (m/s^2)^2, and rates, (rad/s)^2, on the
        trajectory's times; empty without inertial sensors.
    accelerometer_root : (n, 6, 9) float
        Rotation and specific force error per unit normal of the accelerometer's errors, `product.accelerometer_root`.
    findings : tuple of Finding
        Gaps that were bridged, stretches of radar track that were edited.
    provenance : dict
    left_out : tuple of LeftOut
        What happens without each tracker, where a verdict on one was red.
    learnt : Learnt
        What was found of priors and readings, for others that are to be compared with this one.
    """

    smoothed: Trajectory
    filtered: Trajectory
    sensor_errors: pd.DataFrame
    residuals: pd.DataFrame
    withheld: pd.DataFrame
    consistency_checks: tuple[ConsistencyCheck, ...]
    imu_time_s: FloatArray
    specific_force_body_mps2: FloatArray
    rate_body_radps: FloatArray
    specific_force_cov: FloatArray
    rate_cov: FloatArray
    accelerometer_root: FloatArray
    findings: tuple[Finding, ...]
    provenance: dict[str, object]
    left_out: tuple[LeftOut, ...] = ()
    learnt: Learnt = NOTHING

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
    """Reconstruct a flight; where a verdict on a tracker is red, find out what each tracker does to it.

    Parameters
    ----------
    telemetry : Telemetry
    settings : Settings, optional
    progress : callable, optional
        Called with the fraction done and what is being done.

    Raises
    ------
    GateError
        Where the data cannot start or carry a filter (no common span, too few points, prior out of reach).
    """
    settings = settings or Settings()
    report = progress or (lambda _fraction, _what: None)
    found = reconstruct_once(telemetry, settings, lambda f, what: report(0.5 * f, what))
    wider = beyond_sheet(found.consistency_checks, found.sensor_errors) | _clocks_that_differ(telemetry, found)
    if wider:
        found = _with_wider(telemetry, settings, found, wider)
    sources = trackers(telemetry, settings)
    if len(sources) > 1 and fault_isolation.suspicious(found.consistency_checks, sources):
        found = _examined(telemetry, settings, found, sources, report)
    report(1.0, "done")
    return found


def _with_wider(
    telemetry: Telemetry, settings: Settings, found: TrajectorySolution, wider: dict[str, float]
) -> TrajectorySolution:
    """Reconstruction that does not hold on to the data sheets its verdicts, which stay, found wrong."""
    again = reconstruct_once(telemetry, settings, learnt=replace(found.learnt, wider=wider))
    told = sheet_findings(again.sensor_errors, wider, *again.smoothed.time_s[[0, -1]].tolist())
    findings = (*again.findings, *told)
    return replace(again, consistency_checks=found.consistency_checks, residuals=found.residuals, findings=findings)


def _clocks_that_differ(telemetry: Telemetry, found: TrajectorySolution) -> dict[str, float]:
    """Standard deviations to take instead of those of the inertial clocks, where they differ by more than stated."""
    lag, triads = found.learnt.lag, (telemetry.accelerometer, telemetry.rates)
    if lag is None:
        return {}
    return {f"{t.spec.name} time bias": TIMES * abs(lag.lag_s) for t in triads if t is not None}


def trackers(telemetry: Telemetry, settings: Settings) -> tuple[str, ...]:
    """Radars, receivers and barometers that are used."""
    names = (*telemetry.radars, *telemetry.gnss, *telemetry.barometers)
    return tuple(name for name in names if name not in settings.without)


def _examined(
    telemetry: Telemetry, settings: Settings, found: TrajectorySolution, sources: tuple[str, ...], report: Progress
) -> TrajectorySolution:
    """Reconstruction whose covariance and findings know how far the trackers contradict each other."""
    coarse = min(settings.output_rate_hz, EXAMINED_RATE_HZ)
    withheld: dict[str, pd.DataFrame] = {}

    def unknown(made: TrajectorySolution) -> int:
        return sum(f.source == unmodelled.SOURCE for f in made.findings)

    def rerun(source: str) -> tuple[Trajectory, tuple[ConsistencyCheck, ...], bool]:
        report(0.5 + 0.5 * sources.index(source) / len(sources), f"without {source}")
        without = replace(settings, without=(*settings.without, source), output_rate_hz=coarse, pulse_rate_hz=0.0)
        other = reconstruct_once(telemetry, without, learnt=found.learnt)
        withheld[source] = other.withheld
        return other.smoothed, other.consistency_checks, unknown(other) > unknown(found)

    left_out, more = fault_isolation.leave_each_out(found.smoothed, sources, rerun)
    denied = fault_isolation.denied_points(left_out, withheld, found.residuals, settings.gate_probability)
    if denied:
        again = reconstruct_once(telemetry, settings, learnt=replace(found.learnt, denied=denied))
        if all(v.passed for v in again.consistency_checks) and unknown(again) <= unknown(found):
            return replace(
                again,
                consistency_checks=fault_isolation.edited_with_denied(
                    again.consistency_checks, again.residuals, denied
                ),
                findings=(*again.findings, *fault_isolation.denied_findings(denied)),
                left_out=tuple(replace(s, apart=False) for s in left_out),
            )
    return replace(
        found,
        smoothed=fault_isolation.widened_trajectory(found.smoothed, more),
        filtered=fault_isolation.widened_trajectory(found.filtered, more),
        findings=(*found.findings, *fault_isolation.disagreement_findings(left_out)),
        left_out=left_out,
    )


def reconstruct_once(
    telemetry: Telemetry,
    settings: Settings,
    progress: Progress | None = None,
    learnt: Learnt = NOTHING,
) -> TrajectorySolution:
    """Reconstruct a flight with the covariance as the filter has it, whatever its verdicts say.

    ``learnt`` is what an earlier reconstruction found of the same data; displaced readings are judged where it does
    not say which to doubt.
    """
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "bridging gaps")
    bridges = bridge_triads(telemetry, learnt)
    problem = with_wider_priors(build_problem(telemetry, settings, bridges, learnt.denied), learnt.wider)
    if bridges is not None:
        problem = time_bias.with_lag(problem, learnt.lag, bridges.force.spec.name, bridges.rate.spec.name)
    run, smoothed, reference, passes, disturbances = iterate(problem, settings, report)
    judged = _judged(telemetry, problem, run, bridges, learnt)
    if judged.jumps != (learnt.jumps or ()) or judged.doubted != (learnt.doubted or ()):
        return reconstruct_once(telemetry, settings, progress, judged)
    learnt = judged

    report(0.95, "testing consistency")
    mount = _mounting(telemetry, bridges)
    table = product.sensor_error_table(problem, reference, smoothed)
    consistency_checks = consistency.source_checks(problem, run.innovations, settings.check_confidence)
    consistency_checks += _mcreynolds(problem, run, smoothed, reference)
    consistency_checks += _data_sheet_checks(problem, table, settings.check_confidence)
    if bridges is not None and learnt.lag is None:
        lag = time_bias.lag_between(bridges.force, bridges.rate, reference, problem.time_s)
        if lag is not None:
            consistency_checks.append(time_bias.lag_check(lag, bridges.force, bridges.rate, settings.check_confidence))
            learnt = replace(learnt, lag=None if consistency_checks[-1].passed else lag)
    series = _series(problem, bridges, reference, smoothed)
    found = [] if bridges is None else [*bridges.force.findings, *bridges.rate.findings]
    if bridges is not None:
        found += time_bias.jump_findings(learnt.jumps or (), (bridges.force.spec.name, bridges.rate.spec.name))
    report(1.0, "done")
    return TrajectorySolution(
        smoothed=product.datum_trajectory(problem, mount, reference, smoothed.triangles),
        filtered=product.datum_trajectory(problem, mount, run.states(), run.filtered.p_plus),
        sensor_errors=table,
        residuals=product.residual_table(problem, run.innovations),
        withheld=withheld_table(problem, run, settings.engine),
        consistency_checks=tuple(consistency_checks),
        imu_time_s=series[0],
        specific_force_body_mps2=series[1],
        rate_body_radps=series[2],
        specific_force_cov=series[3],
        rate_cov=series[4],
        accelerometer_root=series[5],
        findings=(
            *found,
            *(d.finding() for d in disturbances),
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
        learnt=learnt,
    )


def _judged(
    telemetry: Telemetry, problem: Problem, run: ekf.ForwardPass, bridges: Bridges | None, learnt: Learnt
) -> Learnt:
    """What was learnt with clocks that jumped and, once these are set right, readings that are not believed."""
    if bridges is None or telemetry.accelerometer is None or telemetry.rates is None:
        return replace(learnt, jumps=(), doubted=())
    both = bridges.force, bridges.rate
    if learnt.jumps is None:
        jumps = time_bias.jumps_of_clocks(problem, run, (telemetry.accelerometer, telemetry.rates), both)
        learnt = replace(learnt, jumps=jumps)
        if jumps:
            return learnt
    if learnt.doubted is None:
        learnt = replace(learnt, doubted=doubtful(problem, run, (*both[0].displaced, *both[1].displaced)))
    return learnt


def bridge_triads(telemetry: Telemetry, learnt: Learnt = NOTHING) -> Bridges | None:
    """Inertial triads with their gaps bridged, doubted readings with them; None where the flight has none."""
    records = telemetry.accelerometer, telemetry.rates
    if records[0] is None or records[1] is None or telemetry.motion.model == "ballistic":
        return None
    out = []
    for triad, record in enumerate(r for r in records if r is not None):
        doubted = tuple(d for d in learnt.doubted or () if d.triad == triad)
        out.append(imu_screening.bridge(time_bias.mended(record, triad, learnt.jumps or ()), triad, doubted))
    return Bridges(*out)


def _mounting(telemetry: Telemetry, bridges: Bridges | None) -> product.Mounting:
    if bridges is None:
        return product.Mounting(telemetry.t0_utc, np.zeros(3), None)
    arm = bridges.force.spec.position_from_datum_body_m
    return product.Mounting(telemetry.t0_utc, arm, bridges.rate)


def _series(problem: Problem, bridges: Bridges | None, states: States, smoothed: Smoothed) -> tuple[FloatArray, ...]:
    """Corrected specific force and rates with their times, and at kept nodes how well both are known."""
    if bridges is None:
        return tuple(np.empty(s) for s in ((0,), (0, 3), (0, 3), (0, 3, 3), (0, 3, 3), (0, 6, 9)))
    series = product.corrected_series(problem, bridges.force, bridges.rate, states)
    known = (product.specific_force_cov, product.rate_cov, product.accelerometer_root)
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
    """One verdict for each instrument whose errors the flight taught something about."""
    out = []
    owners = np.array(problem.model.instruments, dtype=object)
    estimated = ~problem.model.wander.considered
    for name in dict.fromkeys(owners[estimated]):
        rows = table[(owners == name) & estimated]
        estimate, prior_sd, sd = rows[["estimate", "prior_sd", "sd"]].to_numpy(dtype=float).T
        label, *bad = SHEETS.get(str(name), (f"data sheet {name}",))
        names = rows["name"].tolist()
        out.append(consistency.data_sheet_check("data-sheet", label, names, estimate, prior_sd, sd, confidence, *bad))
    return [v for v in out if v is not None]


THINNED_STEP_S = 0.5
MOST_THINNED_PASSES = 6
FARTHEST_SD = 3.0
SETTLED_RAD = 0.01  # second-order terms of a rotation this small are 5e-5 of what it does
SETTLED_SD = 0.01  # a pass that moves nothing by more than this part of its sd needs no other


def iterate(
    problem: Problem, settings: Settings, report: Progress
) -> tuple[ekf.ForwardPass, Smoothed, States, int, tuple[Disturbance, ...]]:
    """Filter and smooth: last forward pass, smoothed errors and states, how often it ran, disturbances."""
    reference = None
    found: tuple[Disturbance, ...] = ()
    if settings.passes > 0:
        report(0.02, "first passes on thinned data")
        reference, found = first_reference(problem, settings)
    most = max(1, settings.passes)
    for i in range(most):
        share = 0.85 / most
        report(0.1 + share * i, f"filter, pass {i + 1}")
        run, found = follow_track(problem, reference, settings, found)
        report(0.1 + share * (i + 0.6), f"smoother, pass {i + 1}")
        smoothed = smoother.smooth(problem, run, True, settings.smoother, settings.engine)
        kept = np.flatnonzero(problem.kept)
        moved = np.abs(smoothed.x[kept]) / np.sqrt(np.maximum(smoothed.variance, 1e-300))
        smoothed_states = smoothed.states(run.charts)
        if moved.max() < SETTLED_SD:
            break
        reference = likely(problem, smoothed_states)
    return run, smoothed, smoothed_states, i + 1, found


def follow_track(
    problem: Problem, reference: States | None, settings: Settings, found: tuple[Disturbance, ...]
) -> tuple[ekf.ForwardPass, tuple[Disturbance, ...]]:
    """Forward pass with as many disturbances as it takes to follow the track, and these."""
    while True:
        run = ekf.forward(disturbed(problem, found), reference, settings.engine)
        more = widened(found, problem, run)
        if more is None:
            return run, found
        found = more


def likely(problem: Problem, states: States) -> States:
    """States to linearise about: drivers of ballistic flight no farther than `FARTHEST_SD` from what was stated.

    Drag enters as its logarithm. Seen from a thin, fast flight a parachute asks for a thousandfold drag, and about that
    the next pass would be stiff and far from any truth; any point serves that later passes bring nearer.
    """
    if not problem.motion.ballistic:
        return states
    errors, count = states.sensor_errors.copy(), problem.motion.drivers
    limit = FARTHEST_SD * problem.model.prior_sd[:count]
    errors[:, :count] = np.clip(errors[:, :count], -limit, limit)
    return replace(states, sensor_errors=errors)


def first_reference(problem: Problem, settings: Settings) -> tuple[States, tuple[Disturbance, ...]]:
    """Smoothed states at all nodes from a point of each source every `THINNED_STEP_S`, iterated until they stay."""
    thinned, kept = problem.thinned(THINNED_STEP_S)
    reference = None
    found: tuple[Disturbance, ...] = ()
    for k in range(MOST_THINNED_PASSES):
        run, found = follow_track(thinned, reference, settings, found)
        if k == 0 and problem.motion.ballistic and is_lost(thinned, run):
            # a gap so long that the filter came out of it somewhere else: tracking alone tells where it is
            reference = setup.along_track(problem.instruments, thinned.time_s, problem.model.size)
            run, found = follow_track(thinned, reference, settings, ())
        smoothed = smoother.smooth(thinned, run, False, "rauch-tung-striebel", settings.engine)
        moved = np.abs(smoothed.x[:, ROTATION]).max() if reference is not None else np.inf
        reference = likely(problem, smoothed.states(run.charts))
        if moved < SETTLED_RAD:
            break
    assert reference is not None
    return strapdown.fill_between(problem.motion, problem.node_index, kept, reference), found

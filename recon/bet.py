"""Where the vehicle was and how it was turned: the best estimated trajectory from radar, accelerometers and gyros.

Inertial sensors carry the state, radars correct it, a smoother brings what was learnt later back to every earlier time,
and the whole is repeated about the smoothed trajectory until linearisation no longer matters (`Settings.passes`).
Aerodynamics and atmosphere take no part: the answer is inertial, and what the air did can be inferred from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray, GateError
from flightmodel.telemetry import Finding, RadarRecord, Telemetry
from flightmodel.trajectory import Trajectory
from recon import consistency, ekf, inertial, product, smoother, startup, strapdown
from recon.consistency import Verdict
from recon.error_model import build_error_model
from recon.measurements import radar_model
from recon.state import ROTATION, BoolArray, IntArray, States, boxminus

Progress = Callable[[float, str], None]
THINNED_STEP_S = 0.5
MOST_THINNED_PASSES = 6
SETTLED_RAD = 0.01  # second-order terms of a rotation this small are 5e-5 of what it does


@dataclass(frozen=True)
class Settings:
    """What an analyst may choose.

    Parameters
    ----------
    output_rate_hz : float
        Of the trajectories.
    start_s, end_s : float or None
        Span; the data's own common span where None.
    passes : int
        Forward passes. With one, an extended Kalman filter about its own estimate. With more, the first is that
        filter on thinned radar data, iterated until attitudes settle, and the others, on all data, are linearised
        about the smoothed trajectory of the one before.
    gate_probability : float
        A radar point is edited where its normalised innovation squared is beyond this chi-square quantile.
    bias_time_constant_s : float
        Of the inertial sensors' biases; infinite for constants.
    verdict_confidence : float
        Two-sided confidence of each verdict.
    angle_noise : str
        ``"traverse"`` or ``"axis"``, see `recon.measurements`.
    """

    output_rate_hz: float = 20.0
    start_s: float | None = None
    end_s: float | None = None
    passes: int = 2
    gate_probability: float = 0.9999
    bias_time_constant_s: float = np.inf
    verdict_confidence: float = 0.999
    angle_noise: str = "traverse"

    def __post_init__(self) -> None:
        """Check once."""
        faults = []
        if not 0.1 <= self.output_rate_hz <= 1000.0:
            faults.append(f"output_rate_hz {self.output_rate_hz} must lie in 0.1 to 1000")
        if not 1 <= self.passes <= 10:
            faults.append(f"passes {self.passes} must lie in 1 to 10")
        for name in ("gate_probability", "verdict_confidence"):
            if not 0.5 <= getattr(self, name) < 1.0:
                faults.append(f"{name} {getattr(self, name)} must lie in 0.5 to 1 (1 excluded)")
        if not self.bias_time_constant_s > 0.0:
            faults.append(f"bias_time_constant_s {self.bias_time_constant_s} must be positive (infinite for constants)")
        if self.angle_noise not in ("traverse", "axis"):
            faults.append(f"angle_noise '{self.angle_noise}' must be 'traverse' or 'axis'")
        if faults:
            raise GateError(faults)


@dataclass(frozen=True)
class Reconstruction:
    """The best estimated trajectory and everything that was learnt on the way.

    Parameters
    ----------
    smoothed, filtered : Trajectory
        Of the datum, with covariance; ``filtered`` uses data up to each time (in the last pass).
    sensor_errors : DataFrame
        ``name, unit, prior_sd, estimate, sd``; of errors that wander, the value at mid-span.
    residuals : DataFrame
        ``time_s, source, component, residual, predicted_sd, accepted``: radar innovations of the last pass, m and rad.
    verdicts : tuple of Verdict
    imu_time_s : (k,) float
        Times of the accelerometer's valid samples outside gyro gaps.
    specific_force_body_mps2, rate_body_radps : (k, 3) float
        At the accelerometer, corrected for estimated bias, scale and mount; not smoothed.
    specific_force_cov : (n, 3, 3) float
        Systematic error covariance of the corrected specific force on the trajectory's times, (m/s^2)^2.
    findings : tuple of Finding
        Gaps that were bridged, stretches of radar track that were edited.
    provenance : dict
    """

    smoothed: Trajectory
    filtered: Trajectory
    sensor_errors: pd.DataFrame
    residuals: pd.DataFrame
    verdicts: tuple[Verdict, ...]
    imu_time_s: FloatArray
    specific_force_body_mps2: FloatArray
    rate_body_radps: FloatArray
    specific_force_cov: FloatArray
    findings: tuple[Finding, ...]
    provenance: dict[str, object]


def reconstruct(
    telemetry: Telemetry, settings: Settings | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Reconstruct a flight.

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
    report(0.0, "bridging gaps")
    accelerometer, rates = telemetry.required_triads()
    force, rate = inertial.bridge(accelerometer), inertial.bridge(rates)
    problem, output = build_problem(telemetry, settings, force, rate)
    run, smoothed, reference = _iterate(problem, settings.passes, report)

    report(0.95, "testing consistency")
    arm = accelerometer.spec.position_from_datum_body_m
    mount = product.Mounting(telemetry.t0_utc, arm, rates.spec.noise_sd)
    final = product.datum_trajectory(problem, mount, reference, smoothed.covariance, output)
    filtered = product.datum_trajectory(problem, mount, run.filtered(), run.p_plus, output)
    names = [radar.name for radar in problem.radars]
    settled = problem.time_s > problem.time_s[0] + startup.FIT_SPAN_S
    verdicts = consistency.radar_verdicts(problem.time_s, run.innovations, names, settings.verdict_confidence)
    verdicts += consistency.mcreynolds_verdicts(
        boxminus(run.filtered(), reference)[settled, :9],
        run.p_plus[settled, :9, :9],
        smoothed.covariance[settled, :9, :9],
    )
    table = product.sensor_error_table(problem, reference, smoothed.covariance, run.p_last)
    verdicts += _sheet_verdicts(problem, table, settings.verdict_confidence)
    imu_time_s, specific_force, body_rate = product.corrected_series(problem, force, rate, reference)
    edits = product.edit_findings(problem.time_s, run.innovations, names)
    report(1.0, "done")
    return Reconstruction(
        smoothed=final,
        filtered=filtered,
        sensor_errors=table,
        residuals=product.residual_table(problem.time_s, run.innovations, names),
        verdicts=tuple(verdicts),
        imu_time_s=imu_time_s,
        specific_force_body_mps2=specific_force,
        rate_body_radps=body_rate,
        specific_force_cov=product.specific_force_cov(problem, reference, smoothed.covariance, output),
        findings=(*force.findings, *rate.findings, *edits),
        provenance={
            "flight": telemetry.name,
            "settings": asdict(settings),
            "start_s": float(problem.time_s[0]),
            "end_s": float(problem.time_s[-1]),
            "nodes": len(problem.time_s),
            "states": problem.model.size + 9,
            "hashes": dict(telemetry.hashes),
        },
    )


def _sheet_verdicts(problem: ekf.Problem, table: pd.DataFrame, confidence: float) -> list[Verdict]:
    """One verdict for each instrument whose errors the flight taught something about."""
    out = []
    owners = np.array(problem.model.instruments, dtype=object)
    for name in dict.fromkeys(owners):
        rows = table[owners == name]
        estimate, prior_sd, sd = rows[["estimate", "prior_sd", "sd"]].to_numpy(dtype=float).T
        out.append(consistency.sheet_verdict(name, rows["name"].tolist(), estimate, prior_sd, sd, confidence))
    return [v for v in out if v is not None]


def _iterate(problem: ekf.Problem, passes: int, report: Progress) -> tuple[ekf.ForwardPass, smoother.Smoothed, States]:
    """Filter and smooth ``passes`` times; the last forward pass, its smoothed errors and the smoothed states."""
    reference = None
    if passes > 1:
        report(0.02, "first pass on thinned data")
        reference = _first_reference(problem)
    whole_passes = max(1, passes - 1)
    share = 0.85 / whole_passes
    for i in range(whole_passes):
        done = 0.1 + share * i

        def tell(fraction: float, done: float = done) -> None:
            report(done + 0.6 * share * fraction, "filter")

        run = ekf.forward(problem, reference, tell)
        report(done + 0.6 * share, "smoother")
        smoothed = smoother.smooth(run, with_covariance=i == whole_passes - 1)
        reference = smoothed.states(run.charts)
    assert reference is not None
    return run, smoothed, reference


def _first_reference(problem: ekf.Problem) -> States:
    """Smoothed states at all nodes from a point of each radar every `THINNED_STEP_S`, iterated until they stay."""
    thinned, kept = problem.thinned(THINNED_STEP_S)
    reference = None
    for _ in range(MOST_THINNED_PASSES):
        run = ekf.forward(thinned, reference)
        smoothed = smoother.smooth(run, with_covariance=False)
        moved = np.abs(smoothed.x[:, ROTATION]).max() if reference is not None else np.inf
        reference = smoothed.states(run.charts)
        if moved < SETTLED_RAD:
            break
    assert reference is not None
    return strapdown.fill_between(problem.grid, problem.node_index, kept, reference)


def build_problem(
    telemetry: Telemetry, settings: Settings, force: inertial.Bridged, rate: inertial.Bridged
) -> tuple[ekf.Problem, IntArray]:
    """Nodes, grid, models and start of the filter, and which nodes are output times."""
    start_s, end_s = _span(telemetry, settings, force, rate)
    records = list(telemetry.radars.values())
    names = list(telemetry.radars)
    output_s = _output_times(start_s, end_s, settings.output_rate_hz)
    within = [_usable(r, start_s, end_s) for r in records]
    time_s = _union([output_s, *(r.time_s[w] for r, w in zip(records, within, strict=True))])

    points: list[list[tuple[int, FloatArray]]] = [[] for _ in time_s]
    for number, (record, use) in enumerate(zip(records, within, strict=True)):
        nearest = _nearest(time_s, record.time_s[use])
        for node, measured in zip(nearest, record.range_az_el[use], strict=True):
            points[node].append((number, measured))

    accelerometer, rates = (record.spec for record in telemetry.required_triads())
    sites = [r.site for r in records]
    model = build_error_model(accelerometer, rates, sites, settings.bias_time_constant_s)
    arm = accelerometer.position_from_datum_body_m
    traverse = settings.angle_noise == "traverse"
    radars = [
        radar_model(name, record, model.radar_slice(i), telemetry.required_vehicle().cg_m, arm, traverse)
        for i, (name, record) in enumerate(zip(names, records, strict=True))
    ]
    if telemetry.attitude_prior is None:
        raise GateError(f"flight '{telemetry.name}' has no [attitude_prior] in flight.toml; a reconstruction needs one")
    start, covariance = startup.start_state(records, radars, telemetry.attitude_prior, start_s, force, rate, model)
    grid, node_index = inertial.inertial_grid(force, rate, time_s)
    from scipy.stats import chi2

    gate = float(chi2.ppf(settings.gate_probability, 3))
    problem = ekf.Problem(time_s, node_index, grid, model, radars, points, start, covariance, gate)
    return problem, _nearest(time_s, output_s)


def _span(
    telemetry: Telemetry, settings: Settings, force: inertial.Bridged, rate: inertial.Bridged
) -> tuple[float, float]:
    """First and last time that both triads and at least one radar cover, within the settings' span."""
    radar_times = [r.time_s[np.isfinite(r.range_az_el).all(axis=1)] for r in telemetry.radars.values()]
    radar_times = [t for t in radar_times if len(t)]
    if not radar_times:
        raise GateError("no radar has a usable track point; a trajectory needs at least one radar")
    start_s = max(min(t[0] for t in radar_times), force.time_s[0], rate.time_s[0])
    end_s = min(max(t[-1] for t in radar_times), force.time_s[-1], rate.time_s[-1])
    if settings.start_s is not None:
        start_s = max(start_s, settings.start_s)
    if settings.end_s is not None:
        end_s = min(end_s, settings.end_s)
    if end_s - start_s < 2.0 * startup.FIT_SPAN_S:
        raise GateError(
            f"accelerometer, gyros and radars share only {start_s:.3f} to {end_s:.3f} s; "
            f"at least {2.0 * startup.FIT_SPAN_S:.0f} s are needed: check time bases and the chosen span"
        )
    return float(start_s), float(end_s)


def _usable(record: RadarRecord, start_s: float, end_s: float) -> BoolArray:
    """Which points (n,) lie in the span and are complete."""
    t = record.time_s
    return np.isfinite(record.range_az_el).all(axis=1) & (t >= start_s - 1e-9) & (t <= end_s + 1e-9)


def _output_times(start_s: float, end_s: float, rate_hz: float) -> FloatArray:
    """Multiples of the output step inside the span, and the start itself."""
    first, last = np.ceil(start_s * rate_hz - 1e-6), np.floor(end_s * rate_hz + 1e-6)
    times = np.clip(np.arange(first, last + 1.0) / rate_hz, start_s, end_s)
    return _union([np.array([start_s]), times])


def _union(times: list[FloatArray]) -> FloatArray:
    """All times in order, instants closer than `inertial.SAME_INSTANT_S` taken once."""
    t = np.sort(np.concatenate(times))
    return t[np.diff(t, prepend=-np.inf) > inertial.SAME_INSTANT_S]


def _nearest(grid_s: FloatArray, at_s: FloatArray) -> IntArray:
    k = np.clip(np.searchsorted(grid_s, at_s), 1, len(grid_s) - 1)
    return k - (at_s - grid_s[k - 1] < grid_s[k] - at_s)

"""Which joint, c.g. offset and static stability explain the flight? Does the joint have freeplay, hardening or creep?

``max p(parameters | measurements)`` by Gauss-Newton (`gauss_newton`), first with all standard deviations many times
wider, so that distant starts reach the minimum, at last with the estimated turbulence. The first stiffness is guessed
on the loaded part of the flight (`stiffness_guess`). The covariance is that of the linear problem at the solution.

Turbulence. A sounding's statistics extrapolated to a hundred metres are a guess, and a wrong guess biases the fit:
turbulence assumed too strong leaves damping undetermined and low, too weak biases the offset. So the share of it is
taken under which the measurements are most probable, all parameters integrated over in the linear problem.

Freeplay. Within the dead band the joint has no stiffness, and derivatives do not reach beyond it. So the first steps
fly a band whose corners are rounded over all its width, and sharpen it as the standard deviations narrow
(continuation). The deflection at the starts of spans is that of a first, wide fit without freeplay, increased so that
the joint's moment is the same. The fit begins where air loads the joint (`select_measurements`). A span may still
settle on a false path, with impacts at the wrong edge of the band. Before each step every span is therefore tried from
the end of the one before it, and spans that do not match are fitted once more from wide standard deviations, or from
another freeplay.

Creep. The fit without it is the start: about it the linear problem says how much creep of each of some time constants
would lower the cost (`CreepScore`), and the steps begin with the time constant of the largest. The creep at the
starts of spans is sought as the rest of the motion is, since it remembers more than a span.

Freeplay, creep and hardening are kept where the evidence favours them. Freeplay is compared first, on the loaded part
of the flight; where it is rejected the joint is fitted to the whole flight again. Creep is compared next, since a
spring that hardens is a smaller part of what a shell does under load, then hardening.

Start. A joint may be ten times softer or a thousand times stiffer than the vehicle file states, and Gauss-Newton steps
from a joint that diverges under the flight's loads, or from one far too soft, end with another vehicle. So a few spans
about the largest dynamic pressure are fitted from several stiffnesses, counted from the one at which the stated vehicle
diverges, with wide standard deviations; the fit begins with the stiffness that explains them best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from flightmodel.checks import DivergenceError, FloatArray, GateError, Progress, part_of
from flightmodel.linear import critical_stiffness_nmprad, slopes_at
from flightmodel.trajectory import resample
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.forward_model import (
    CREEP_PER_S,
    DAMPING_LOG_SD,
    DEFLECTION,
    FREEPLAY_SD_RAD,
    LOADED_SD,
    SLOW_JOINT,
    STIFFNESS_LOG_SD,
    AtmosphereParameters,
    Measurements,
    VehicleParameters,
    resolved_stiffness_nmprad,
    select_measurements,
    steps_for,
)
from postflight.reconciliation.gauss_newton import (
    INSTRUMENTS,
    KINKED,
    Linearization,
    Parameters,
    Problem,
    Residuals,
    descend,
)
from postflight.reconciliation.normal_equations import NormalEquations
from postflight.reconstruction import Reconstruction

Correction = Callable[[Problem, Parameters], Parameters]
SD_FACTORS_EARLY = (30.0, 10.0, 3.0)
MOST_STEPS = 20  # after the early ones
# predicted decrease of the cost at which a fit ends: the last one, and the one before the turbulence is estimated
TOLERANCE, EARLY_TOLERANCE = 0.05, 2.0
# in a kink of the coefficient table the cost is lowest whatever its slopes predict. So a fit ends, too, where no step
# lowers the cost by more than `STILL` and the slopes promise less than one sd (`KINKED`)
STILL = 0.01
# of freeplay: factors on standard deviations, and half width of the band's corners over the freeplay
CONTINUATION = ((30.0, 1.0), (10.0, 0.5), (3.0, 0.3), (3.0, 0.1), (1.0, 0.1), (1.0, 0.05))
STARTS_RAD = np.deg2rad([0.25, 0.5, 0.1])
# shares of the turbulence of the sounding's statistics
SHARES = np.geomspace(0.05, 2.0, 7)
# of creep, that are tried: a factor of five apart the answers differ by less than a sd
CREEP_TIMES_S = (2.0, 10.0, 50.0)
SPANS = 24  # about 10 s: several periods of the vehicle's own oscillation under load
EVERY_LOAD = 20  # samples of the pulse, of which there are thousands


@dataclass(frozen=True)
class JointFit:
    """A joint fitted to a flight.

    Parameters
    ----------
    problem : Problem
    parameters : Parameters
        The most probable.
    normal : NormalEquations
        Of the linear problem at the solution.
    residuals : Residuals
    steps : int
    converged : bool
    """

    problem: Problem
    parameters: Parameters
    normal: NormalEquations
    residuals: Residuals
    steps: int
    converged: bool

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (v, v) of the vehicle's parameters, in their order."""
        return self.normal.covariance_of(np.arange(self.problem.first_instrument))

    @property
    def sensor_rms_sd(self) -> float:
        """Rms of the sensors' residuals over their standard deviations."""
        return float(np.sqrt(np.mean(self.residuals.sensors**2)))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence by Laplace's method, up to a constant common to all models of a flight."""
        # freeplay has one sign: its prior is folded
        folded = np.log(2.0) if "freeplay" in self.problem.vehicle_parameters.laws else 0.0
        return float(folded + self.problem.log_weight - 0.5 * self.normal.log_det - 0.5 * self.residuals.cost)

    @property
    def vehicle(self) -> Vehicle:
        """Vehicle with the fitted joint, offset and coefficients."""
        return self.problem.vehicle_parameters.flown(self.parameters.vehicle)

    @cached_property
    def linear(self) -> Linearization:
        """Linear problem at the solution."""
        return self.problem.linearize(self.parameters)

    @cached_property
    def creep_scores(self) -> tuple[CreepScore, ...]:
        """Linear estimates of creep at the solution for each of `CREEP_TIMES_S`, for a fit without creep."""
        return tuple(_creep_score(self, self.linear, time_s) for time_s in CREEP_TIMES_S)

    @cached_property
    def finer(self) -> Problem:
        """Problem with the predictions of fine integration steps at the solution."""
        return self.problem.with_fine_steps(self.parameters)

    @cached_property
    def moves_by_steps_sd(self) -> FloatArray:
        """Shift of each parameter sought, (v,), with fine integration steps, in its sd."""
        fine = self.finer.residuals(self.parameters)
        step = self.normal.solve(self.problem.right_hand_side(self.parameters, self.linear, fine))
        sought = self.problem.vehicle_parameters.sought
        return np.asarray(step[:sought] / np.sqrt(np.diag(self.covariance))[:sought])


@dataclass(frozen=True)
class LawSelection:
    """The joint with the laws that the evidence favours.

    Parameters
    ----------
    fit : JointFit
    compared : dict
        Of every law that was asked for: the fits without and with it.
    """

    fit: JointFit
    compared: dict[str, tuple[JointFit, JointFit]]

    @property
    def log_odds(self) -> dict[str, float]:
        """Log odds of a joint with each requested law against one without it."""
        return {law: having.log_evidence - lacking.log_evidence for law, (lacking, having) in self.compared.items()}


def select_laws(flight: Reconstruction, asked: tuple[str, ...] = (), progress: Progress | None = None) -> LawSelection:
    """Fit the joint; of the ``asked`` laws of `forward_model.LAWS`, keep those that the evidence favours.

    Raises
    ------
    GateError, DivergenceError
        As `reconcile`.
    """
    report = progress or (lambda _fraction, _what: None)
    fits, most = 0, 1 + 3 * ("freeplay" in asked) + sum(law in asked for law in ("creep", "hardening"))

    def next_part() -> Progress:
        nonlocal fits
        fits += 1
        return part_of(report, (fits - 1) / most, fits / most)

    def fitted(laws: tuple[str, ...], loaded: bool) -> JointFit:
        part = next_part()
        if "freeplay" in laws:
            return reconcile_with_freeplay(flight, select_measurements(flight, loaded), laws, part)
        return reconcile(flight, laws, loaded, part)

    compared: dict[str, tuple[JointFit, JointFit]] = {}
    best: JointFit | None = None
    if "freeplay" in asked:
        tight, loose = compared["freeplay"] = fitted((), True), fitted(("freeplay",), True)
        best = loose if loose.log_evidence > tight.log_evidence else None
    kept = best.problem.vehicle_parameters.laws if best else ()
    best = best or fitted((), False)
    if "creep" in asked:
        creeping = reconcile_with_creep(best, next_part())
        compared["creep"] = best, creeping
        # a joint that recoils from its load is not a law, but something else that is wrong
        if creeping.log_evidence > best.log_evidence and creeping.vehicle.joint.creep_share > 0.0:
            best = creeping
    if "hardening" in asked:
        creeps = "creep" in best.problem.vehicle_parameters.laws
        hard = _with_hardening(best, next_part()) if creeps else fitted((*kept, "hardening"), bool(kept))
        compared["hardening"] = best, hard
        # the vehicle file has no joint that softens: such a fit is reported, not flown
        if hard.log_evidence > best.log_evidence and hard.vehicle.joint.hardening_nmprad3 > 0.0:
            best = hard
    report(1.0, "reconciled")
    return LawSelection(best, compared)


@dataclass(frozen=True)
class CreepScore:
    """Creep with one time constant, estimated by the linear problem about a fit without creep.

    Parameters
    ----------
    time_s : float
    delayed : float
        Compliance that would come late over that of the spring, and ``sd``.
    sd : float
    """

    time_s: float
    delayed: float
    sd: float

    @property
    def sds(self) -> float:
        """Delayed compliance in standard deviations: its square is the predicted decrease of the cost."""
        return self.delayed / self.sd


def _creep_score(fit: JointFit, plain: Linearization, time_s: float) -> CreepScore:
    """Delayed compliance and its sd, from one linear step with all other parameters free."""
    problem, start = _without_creep_yet(fit, time_s)
    k = problem.vehicle_parameters.names.index("creep growth")
    normal = problem.normal_equations(start, _linearized_with_creep(fit.problem, plain, problem, start))
    unit = np.eye(len(normal.right))[k]
    step, variance = normal.solve(normal.right)[k], normal.solve(unit)[k]
    return CreepScore(time_s, CREEP_PER_S * time_s * float(step), CREEP_PER_S * time_s * float(np.sqrt(variance)))


def _linearized_with_creep(plain: Problem, known: Linearization, problem: Problem, start: Parameters) -> Linearization:
    """Linearize a problem at zero creep: only the columns that creep adds are flown, the others are reused.

    Without creep no other parameter moves it, so that the joins' last rows are of creep alone.
    """
    sought, more = plain.vehicle_parameters.sought, problem.first_instrument - plain.first_instrument
    column = np.arange(plain.first_motion)
    column[sought:] += more
    motion = problem.first_motion + problem.motion * np.arange(plain.measured.spans)[:, None] + np.arange(plain.motion)
    column = np.concatenate([column, motion.ravel()])
    wanted = np.ones(problem.count, dtype=bool)
    wanted[column] = False
    added = problem.linearize(start, wanted)
    sensors, joins = [], []
    for (old, response), (new, by_creep) in zip(known.sensors, added.sensors, strict=True):
        own = len(new) - INSTRUMENTS  # which both have
        sensors.append((np.concatenate([new[:own], column[old]]), np.column_stack([by_creep[:, :own], response])))
    for (old, response), (new, by_creep) in zip(known.joins, added.joins, strict=True):
        own = len(old) - plain.motion  # without the next start's, which both have
        still = np.zeros((problem.motion - plain.motion, own))
        both = np.column_stack([by_creep, np.concatenate([response[:, :own], still])])
        joins.append((np.concatenate([new, column[old[:own]]]), both))
    return Linearization(added.residuals, sensors, joins, problem.count)


def _without_creep_yet(fit: JointFit, time_s: float) -> tuple[Problem, Parameters]:
    """Problem with creep of a time constant, and the fit's parameters with none of it."""
    problem, start = _with_parameters(fit, "creep", [0.0, float(np.arcsinh(1.0 / (CREEP_PER_S * time_s)))])
    # the usual delayed compliance over the spring's, until a fit has found its own
    return replace(problem, creep_per_s=0.3 / time_s), start


def _with_parameters(fit: JointFit, law: str, values: list[float]) -> tuple[Problem, Parameters]:
    """Problem of a fit with one more law, and the fit's parameters with those of the law; creep zero everywhere."""
    before = fit.problem.vehicle_parameters
    problem = replace(fit.problem, vehicle_parameters=replace(before, laws=(*before.laws, law)))
    motion = np.zeros((len(fit.parameters.motion), problem.motion))
    motion[:, : fit.problem.motion] = fit.parameters.motion
    vehicle = np.insert(fit.parameters.vehicle, before.sought, values)
    return problem, replace(fit.parameters, vehicle=vehicle, motion=motion)


def reconcile_with_creep(plain: JointFit, progress: Progress | None = None) -> JointFit:
    """Fit a joint that creeps, from a fit without creep."""
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "reconciling, creep")
    likeliest = max(plain.creep_scores, key=lambda score: abs(score.sds))
    return _from_fit(*_without_creep_yet(plain, likeliest.time_s), report)


def _with_hardening(fit: JointFit, report: Progress) -> JointFit:
    """Fit hardening besides the laws that a fit has, from that fit."""
    return _from_fit(*_with_parameters(fit, "hardening", [0.0]), report)


def _from_fit(problem: Problem, start: Parameters, report: Progress) -> JointFit:
    """Fit with one law more, from the parameters of a fit without it."""
    correct = reconnected if "freeplay" in problem.vehicle_parameters.laws else None
    # the change from the held to the fast stiffness needs wide standard deviations at first
    early = [replace(problem, sd_factor=factor) for factor in (10.0, 3.0)]
    first = solve(problem, start, early, part_of(report, 0.2, 0.6), correct, EARLY_TOLERANCE)
    joint = first.vehicle.joint
    if "creep" in problem.vehicle_parameters.laws and joint.creep_share > 0.0:
        per_s = joint.delayed_compliance_radpnm * joint.bending_stiffness_nmprad / joint.creep_time_s
        first = replace(first, problem=replace(problem, creep_per_s=per_s))
    return _refit_with_turbulence(first, part_of(report, 0.6, 1.0), correct)


def reconcile(
    flight: Reconstruction, laws: tuple[str, ...] = (), loaded: bool = False, progress: Progress | None = None
) -> JointFit:
    """Fit joint, offset and static stability to a reconstructed flight.

    Parameters
    ----------
    flight : Flight
    laws : tuple of str
        Terms of the spring beside its stiffness, of `forward_model.LAWS`; with freeplay see `reconcile_with_freeplay`.
    loaded : bool
        Only where air loads the joint (`select_measurements`).
    progress : callable, optional
        It raises as `postflight.reconciliation.command.reconcile`.
    """
    problem = problem_of(flight, select_measurements(flight, loaded), laws)
    report = progress or (lambda _fraction, _what: None)
    report(0.0, "reconciling, first guess of the stiffness")
    problem, start = stiffness_guess(flight, problem)
    early = [replace(problem, sd_factor=factor) for factor in SD_FACTORS_EARLY]
    first = solve(problem, start, early, part_of(report, 0.15, 0.6), tolerance=EARLY_TOLERANCE)
    return _refit_with_turbulence(first, part_of(report, 0.6, 1.0))


def require_damping(vehicle: Vehicle) -> None:
    """Refuse a vehicle whose file states no damping of the joint, on which a factor is sought; `GateError`."""
    if not vehicle.joint.bending_damping_nmsprad > 0.0:
        raise GateError(
            f"reconciliation: vehicle '{vehicle.name}' states no damping of its joint, on which the fit estimates a "
            "factor: state joint.bending_damping_nmsprad; the critical damping is "
            f"{vehicle.critical_damping_nmsprad():.3g}; a rigid vehicle has no joint to reconcile",
            code="joint-undamped",
        )


def problem_of(flight: Reconstruction, measured: Measurements, laws: tuple[str, ...]) -> Problem:
    """Least-squares problem of a flight."""
    require_damping(flight.telemetry.required_vehicle())
    air = AtmosphereParameters(flight.telemetry.sounding, float(measured.altitude_m.min()))
    return Problem(measured, VehicleParameters(flight.required_loads().vehicle, laws), air)


def solve(
    problem: Problem,
    start: Parameters,
    early: Sequence[Problem] = (),
    progress: Progress | None = None,
    correct: Correction | None = None,
    tolerance: float = TOLERANCE,
) -> JointFit:
    """Most probable parameters, from a starting point.

    Parameters
    ----------
    problem : Problem
    start : Parameters
    early : sequence of Problem
        Easier ones, one for each of the first steps.
    progress : callable, optional
    correct : callable, optional
        Improves the parameters of a problem before each step.
    tolerance : float
        Predicted decrease of the cost below which the fit has converged.
    """
    report = progress or (lambda _fraction, _what: None)
    most = len(early) + MOST_STEPS
    report(0.0, "reconciling, step 1")
    cost = np.inf
    for number, step in enumerate(descend([*early, *[problem] * MOST_STEPS], start, correct), 1):
        still = number > len(early) + 1 and step.predicted_decrease < KINKED and cost - step.residuals.cost < STILL
        converged = number > len(early) and (step.predicted_decrease < tolerance or still)
        if converged or number == most:
            break
        cost = step.residuals.cost
        report(number / most, f"reconciling, step {number + 1}")
    report(1.0, "reconciled")
    return JointFit(problem, step.end, step.normal, step.residuals, number, converged)


def _refit_with_turbulence(fit: JointFit, report: Progress, correct: Correction | None = None) -> JointFit:
    """Fit again with the turbulence of largest evidence."""
    report(0.0, "estimating turbulence")
    air = replace(fit.problem.air, turbulence_share=estimate_turbulence_share(fit.problem, fit.parameters))
    problem = resolved(replace(fit.problem, air=air), fit.parameters.vehicle)
    if is_unresolved(problem, fit.parameters):
        problem = replace(problem, held=("stiffness", "damping"))
    fitted = solve(problem, fit.parameters, progress=part_of(report, 0.2, 1.0), correct=correct)
    return _with_fine_steps(fitted, correct)


def _with_fine_steps(fit: JointFit, correct: Correction | None) -> JointFit:
    """Fit again with the predictions of finer integration steps, if they shift a parameter that is sought.

    In a vehicle that spins with a joint bent by many degrees the steps' error couples the stiff twist into the bending:
    with 13 to 23 deg at 49 to 60 rpm the damping is 7 to 20 % low (4 to 10 sd).
    """
    for _ in range(3):
        if fit.problem.held or np.abs(fit.moves_by_steps_sd).max() < 0.1:
            break
        fit = solve(fit.finer, fit.parameters, correct=correct)
    return fit


def is_unresolved(problem: Problem, u: Parameters) -> bool:
    """Whether the joint is too fast for the windows, so that its stiffness is only bounded from below.

    Neither stiffness nor damping can be determined, and steps along them would go on without gain.
    """
    vehicle = problem.vehicle_parameters.vehicle(u.vehicle)
    return vehicle.joint.bending_stiffness_nmprad >= resolved_stiffness_nmprad(vehicle)


def estimate_turbulence_share(problem: Problem, u: Parameters) -> float:
    """Turbulence as a share of the sounding statistics', at the largest evidence, by the linear problem at ``u``."""
    linear = problem.linearize(u)
    tried = [replace(problem, air=replace(problem.air, turbulence_share=float(share))) for share in SHARES]
    evidence = np.array([_log_evidence(problem, other, u, linear) for other in tried])
    k = int(np.clip(evidence.argmax(), 1, len(SHARES) - 2))
    near = np.log(SHARES[k - 1 : k + 2])
    curvature, slope, _ = np.polyfit(near, evidence[k - 1 : k + 2], 2)
    best = -0.5 * slope / curvature if curvature < 0.0 else np.log(SHARES[evidence.argmax()])
    return float(np.exp(np.clip(best, near[0], near[-1])))


def _log_evidence(problem: Problem, other: Problem, u: Parameters, linear: Linearization) -> float:
    """Logarithm of the evidence with the standard deviations of ``other``, derivatives as in ``problem``."""
    sensors = np.divide(other.weight, problem.weight, out=np.zeros_like(other.weight), where=problem.weight > 0.0)
    joins = other.join_weight / problem.join_weight
    residuals = Residuals(linear.residuals.sensors * sensors, linear.residuals.joins * joins, 0.0)
    weighted = Linearization(
        residuals,
        [(column, rows * by.ravel()[:, None]) for (column, rows), by in zip(linear.sensors, sensors, strict=True)],
        [(column, rows * by[:, None]) for (column, rows), by in zip(linear.joins, joins, strict=True)],
        linear.count,
    )
    normal = other.normal_equations(u, weighted)
    cost = (residuals.sensors**2).sum() + (residuals.joins**2).sum() + other.prior_cost(u)
    lowest = cost - normal.solve(normal.right) @ normal.right
    return float(other.log_weight - 0.5 * lowest - 0.5 * normal.log_det)


def reconcile_with_freeplay(
    flight: Reconstruction,
    measured: Measurements,
    laws: tuple[str, ...] = ("freeplay",),
    progress: Progress | None = None,
) -> JointFit:
    """Fit a joint with freeplay, and the other ``laws`` of `forward_model.LAWS`, to the loaded part of a flight.

    Raises
    ------
    DivergenceError
        Where the vehicle file's joint diverges.
    """
    report = progress or (lambda _fraction, _what: None)
    problem = problem_of(flight, measured, laws)
    plain = problem_of(flight, measured, tuple(law for law in laws if law != "freeplay"))
    wide = replace(plain, sd_factor=CONTINUATION[0][0])
    *_, first = descend([wide] * 2, plain.start())
    early = [
        replace(problem, sd_factor=factor, vehicle_parameters=replace(problem.vehicle_parameters, corner=corner))
        for factor, corner in CONTINUATION
    ]
    fits: list[JointFit] = []
    share = 0.7 / len(STARTS_RAD)
    for k, freeplay_rad in enumerate(STARTS_RAD.tolist()):
        start = with_freeplay(problem, first.end, freeplay_rad, CONTINUATION[0][1])
        fits.append(
            _refit_mismatched(solve(problem, start, early, part_of(report, k * share, (k + 1) * share), reconnected))
        )
        if not mismatched_spans(fits[-1]).any():
            break
    return _refit_with_turbulence(min(fits, key=lambda fit: fit.residuals.cost), part_of(report, 0.7, 1.0), reconnected)


def with_freeplay(problem: Problem, plain: Parameters, freeplay_rad: float, corner: float) -> Parameters:
    """Parameters of a fit without freeplay, with deflections that give the same moment with so much freeplay."""
    deflection = plain.motion[:, DEFLECTION].copy()
    half = corner * freeplay_rad
    size = np.linalg.norm(deflection[:, 1:], axis=1)
    loose = np.where(size < half, freeplay_rad - half + 2.0 * np.sqrt(half * size), size + freeplay_rad)
    deflection[:, 1:] *= (loose / np.maximum(size, 1e-9))[:, None]
    motion = plain.motion.copy()
    motion[:, DEFLECTION] = deflection
    k = problem.vehicle_parameters.names.index("freeplay")
    return replace(plain, vehicle=np.insert(plain.vehicle, k, freeplay_rad / FREEPLAY_SD_RAD), motion=motion)


def _refit_mismatched(fit: JointFit) -> JointFit:
    """Fit once more with wide initial priors on mismatched spans and their neighbours."""
    mismatched = mismatched_spans(fit)
    if not mismatched.any():
        return fit
    near = np.convolve(mismatched, np.ones(3), "same") > 0.5
    early = [replace(fit.problem, sd_factor=np.where(near, factor, 1.0)) for factor in SD_FACTORS_EARLY]
    again = solve(fit.problem, fit.parameters, early, correct=reconnected)
    return min(fit, again, key=lambda each: each.residuals.cost)


def mismatched_spans(fit: JointFit) -> FloatArray:
    """Mask (s,) of the spans that are far from their measurements or from their neighbours."""
    # a span has 60 samples and two joins
    return np.asarray(_local_cost(fit.residuals.sensors, fit.residuals.joins) > 150.0)


def _local_cost(sensors: FloatArray, joins: FloatArray) -> FloatArray:
    """Sum of squares (s,) of each span's sensors and of both its joins."""
    joined = (joins**2).sum(axis=1)
    return np.asarray((sensors**2).sum(axis=(1, 2)) + np.append(joined, 0.0) + np.append(0.0, joined))


def reconnected(problem: Problem, u: Parameters) -> Parameters:
    """Restart spans from the end of the previous one if that lowers the cost; only one of two neighbours at a time."""
    predicted = problem.predict(u)
    ends = u.motion.copy()
    ends[1:] = predicted.end[:-1]
    now, then = problem.residuals(u, predicted), problem.predict(replace(u, motion=ends))
    following = (then.end[:-1] - u.motion[1:]) * problem.join_weight
    sensors = problem.residuals(replace(u, motion=ends), then).sensors
    after = (sensors**2).sum(axis=(1, 2)) + np.append((following**2).sum(axis=1), 0.0)
    gain = _local_cost(now.sensors, now.joins) - after
    gain[0] = 0.0
    motion = u.motion.copy()
    for k in np.argsort(-gain):
        # a new start is worth the change from a decrease of the cost by 10 on
        if gain[k] > 10.0 and gain[k] >= gain[max(k - 1, 0) : k + 2].max():
            motion[k] = ends[k]
    moved = replace(u, motion=motion)
    return moved if problem.residuals(moved).cost < now.cost else u


def stiffness_guess(flight: Reconstruction, problem: Problem) -> tuple[Problem, Parameters]:
    """Starting point of a fit: nominal, with the stiffness that best explains the loaded part; and its problem.

    Raises
    ------
    DivergenceError
        Where the spans cannot be flown with any of the candidates.
    """
    start, nominal = problem.start(), problem.vehicle_parameters.nominal
    measured = loaded_part(problem.measured)
    air = AtmosphereParameters(flight.telemetry.sounding, float(measured.altitude_m.min()))
    part = replace(problem, measured=measured, air=air, sd_factor=30.0)
    lowest, best, critical = np.inf, None, critical_stiffness(flight)

    def with_stiffness(parameter: float) -> FloatArray:
        vehicle = start.vehicle.copy()
        vehicle[0] = parameter
        vehicle[1] = damping_guess(problem, vehicle)
        return vehicle

    # over the stiffness at which the stated vehicle diverges; from one to the next two steps reach
    for factor in (1.2, 1.8, 3.5, 10.0, 40.0, 200.0):
        stiffness = factor * critical / nominal.joint.bending_stiffness_nmprad
        vehicle = with_stiffness(float(np.log(stiffness)) / STIFFNESS_LOG_SD)
        try:
            *_, end = descend([resolved(part, vehicle)] * 2, replace(part.start(), vehicle=vehicle))
        except DivergenceError as fault:
            failed = fault
            continue
        if end.residuals.cost < lowest:
            lowest, best = end.residuals.cost, end.end.vehicle[0]
    if best is None:
        raise failed
    vehicle = with_stiffness(best)
    return resolved(problem, vehicle), replace(start, vehicle=vehicle)


def resolved(problem: Problem, x: FloatArray) -> Problem:
    """Problem with integration steps that resolve the joint of the vehicle's parameters (v,)."""
    steps = steps_for(problem.vehicle_parameters.vehicle(x))
    if steps == problem.measured.steps:
        return problem
    return replace(problem, measured=replace(problem.measured, steps=steps))


def damping_guess(problem: Problem, x: FloatArray) -> float:
    """Initial parameter of the damping; large for a fast joint, so that its oscillation decays within a span.

    A slightly damped oscillation of many periods a span would fit, badly, at many false frequencies.
    """
    vehicle = problem.vehicle_parameters.vehicle(x)
    if steps_for(vehicle) is SLOW_JOINT:
        return 0.0
    ratio = vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()
    return max(0.0, float(np.log(0.1 / ratio)) / DAMPING_LOG_SD)  # a tenth of critical damping


def critical_stiffness(flight: Reconstruction) -> float:
    """Bending stiffness, N m/rad, below which the stated vehicle diverges at the flight's largest load."""
    pulse = flight.required_loads()
    stated = pulse.vehicle
    loads = pulse.dynamic_pressure_pa[::EVERY_LOAD].tolist()
    at = zip(loads, slopes_at(stated, pulse.mach[::EVERY_LOAD]), strict=True)
    return max(critical_stiffness_nmprad(stated, slopes, load) for load, slopes in at)


def loaded_part(measured: Measurements) -> Measurements:
    """Return the spans about the largest dynamic pressure."""
    peak = int(np.argmax(measured.dynamic_pressure_pa))
    first = max(min(peak - SPANS // 2, measured.spans - SPANS), 0)
    part = slice(first, min(first + SPANS, measured.spans))
    start = resample(measured.start, measured.start.time_s[part.start : part.stop + 1])
    names = ("dynamic_pressure_pa", "altitude_m", "time_s", "rate_radps", "specific_force_mps2")
    of_part: dict[str, Any] = {name: getattr(measured, name)[part] for name in names}
    return replace(measured, start=start, first_deflection_sd=LOADED_SD, **of_part)

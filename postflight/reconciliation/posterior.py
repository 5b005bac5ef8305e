"""Which stiffness, damping, offset and stability does a fitted joint have, and with which uncertainty?

From the linear problem: covariance ``P = (J^T W J + P_0^-1)^-1`` of all parameters, and by differences the standard
deviations and 90 % intervals of what an engineer asks for.

By sampling: posterior of the few parameters sought, by emcee. The nuisance parameters (some 2700:
motion, atmosphere, instruments, masses) are put at their most probable values for each candidate of the few (a profile
likelihood). To that end they follow the linear problem about the best fit and are then corrected by the gradient at the
candidate with the derivatives of the best fit, which costs one flight of all spans a correction. The profile is taken
at some two hundred candidates and interpolated between them by radial functions; the sampler evaluates the
interpolation, whose error is `Posterior.refit_error`: candidates fitted anew with new derivatives. A profile is no
marginal: that the scatter of the nuisance parameters differs from candidate to candidate is neglected.

References
----------
D. Foreman-Mackey et al., "emcee: The MCMC Hammer", 2013.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.special import ndtr, ndtri

from flightmodel.checks import ConfigError, FloatArray, Progress
from flightmodel.deflection import DeflectionHistory, history_from_lateral, lv_clock
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.fit import JointFit
from postflight.reconciliation.forward_model import (
    DAMPING_LOG_SD,
    DEFLECTION,
    FREEPLAY_SD_RAD,
    HARDENING_SD,
    OFFSET_SD_M,
    STIFFNESS_LOG_SD,
    WINDOWS,
    VehicleParameters,
    creep_law,
    resolved_stiffness_nmprad,
)
from postflight.reconciliation.gauss_newton import Linearization, Parameters, descend
from postflight.reconciliation.normal_equations import NormalEquations

INTERVAL, BOUND = 0.90, 0.95
FROM_ZERO_SD = 3.0  # of the compliance: nearer to zero the stiffness has no upper limit
# of the stiffness that the windows resolve, a tenth of the frequency: a faster joint may be fitted at a false frequency
# (one of 95 flights: 6 % below its own, 4 % below the limit, with a sd of 0.7 %)
SURELY_RESOLVED = 0.81
FAR_SD = 10.0  # where the tail of a normal law is an exponential, to a percent
LEAST_PRECISION = 1e-6  # of the stiffness's parameter, over the a priori one
# what follows from the stiffness, and with which power of it
BOUNDED = {"bending stiffness": 1.0, "free-free frequency": 0.5}
SEED = 2009
PER_UNKNOWN, REACH, CORRECTIONS = 32, 5.0, 3  # candidates; reach in sd of the linear problem
REFITS, REFIT_STEPS, REFIT_REACH = 4, 2, 2.0
WALKERS, MOVES, BURNT, THINNED = 32, 2500, 500, 20
DIFFERENCE = 1e-4  # of an a priori standard deviation


def _damping_ratio(vehicle: Vehicle) -> float:
    return vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()


# name, unit, value of a vehicle, and whether its uncertainty is that of its logarithm
QUANTITIES: tuple[tuple[str, str, Callable[[Vehicle], float], bool], ...] = (
    ("bending stiffness", "N m/rad", lambda v: v.joint.bending_stiffness_nmprad, True),
    ("free-free frequency", "Hz", lambda v: v.free_free_frequency_hz(), True),
    ("damping", "N m s/rad", lambda v: v.joint.bending_damping_nmsprad, True),
    ("damping ratio", "", _damping_ratio, True),
    ("c.g. offset y", "cm", lambda v: 100.0 * float(v.cg_m[1]), False),
    ("c.g. offset z", "cm", lambda v: 100.0 * float(v.cg_m[2]), False),
    ("c.g. offset", "cm", lambda v: 100.0 * float(np.hypot(*v.cg_m[1:])), False),
    ("c.g. offset's clock", "deg LV", lambda v: float(np.rad2deg(lv_clock(v.cg_m[1:]))), False),
)


@dataclass(frozen=True)
class _LinearQuantity:
    """Quantity that is linear in one of the vehicle's parameters: ``nominal + scale x[index]``."""

    label: str
    column: str
    unit: str
    nominal: float
    scale: float
    index: int
    is_size: bool = False  # either sign of the parameter is the same

    def of(self, x: FloatArray) -> FloatArray:
        """Values (...) of parameters (..., v)."""
        value = self.nominal + self.scale * x[..., self.index]
        return np.abs(value) if self.is_size else value


def _creep_rows(fit: JointFit, reach: float) -> list[tuple[str, str, float, float, float, float, float, str]]:
    """Rows of `joint_table` for creep: delayed share of the compliance, and its time constant.

    The interval of the time constant is that of its inverse; it has no end where creep may settle later than any time.
    """
    names = fit.problem.vehicle_parameters.names
    if "creep growth" not in names:
        return []
    at = names.index("creep growth")
    x, covariance = fit.parameters.vehicle[at : at + 2], fit.covariance[at : at + 2, at : at + 2]
    share, time_s = creep_law(*x.tolist())
    moved = np.array(
        [creep_law(*(x + side * DIFFERENCE * unit).tolist()) for unit in np.eye(2) for side in (1.0, -1.0)]
    )
    by_share, by_settling = ((c[::2] - c[1::2]) / (2.0 * DIFFERENCE) for c in (moved[:, 0], 1.0 / moved[:, 1]))
    share_sd, settling_sd = (float(np.sqrt(slope @ covariance @ slope)) for slope in (by_share, by_settling))
    slowest = 1.0 / time_s - reach * settling_sd
    times = 1.0 / (1.0 / time_s + reach * settling_sd), 1.0 / slowest if slowest > 0.0 else np.inf
    file = fit.problem.vehicle_parameters.nominal.joint
    ends = share - reach * share_sd, share + reach * share_sd
    return [
        ("creep share", "", file.creep_share, share, share_sd, *ends, "estimate"),
        ("creep time", "s", file.creep_time_s, time_s, time_s**2 * settling_sd, *times, "estimate"),
    ]


def _linear_quantities(parameters: VehicleParameters) -> list[_LinearQuantity]:
    """Static stability, and the coefficients of the laws that the joint has."""
    known = {
        "static stability": ("static stability", "static_stability", "", 1.0, parameters.nominal.uncertainty.cm),
        "freeplay": ("freeplay", "freeplay_deg", "deg", 0.0, float(np.rad2deg(FREEPLAY_SD_RAD))),
        "hardening": ("hardening at 4 deg", "hardening_at_4_deg", "", 0.0, HARDENING_SD),
    }
    names = parameters.names
    return [
        _LinearQuantity(*about, names.index(name), name == "freeplay") for name, about in known.items() if name in names
    ]


def joint_table(fit: JointFit) -> pd.DataFrame:
    """One row a quantity: ``quantity, unit, told (the vehicle file's), found, sd, low, high`` (90 % interval), kind.

    Positive quantities have sd and interval from their logarithm. Where the flight only bounds the stiffness
    (`stiffness_bound`) the kind of what follows from it is "lower bound" and not "estimate": ``low`` is the bound that
    holds with 95 %, ``high`` infinite, and ``found`` the most probable value, which the a priori one determines.
    """
    vehicle_parameters, x = fit.problem.vehicle_parameters, fit.parameters.vehicle
    n = len(x)
    covariance = fit.covariance
    reach = float(ndtri(0.5 + 0.5 * INTERVAL))
    nominal, best = vehicle_parameters.vehicle(np.zeros(n)), vehicle_parameters.vehicle(x)
    moved = [[vehicle_parameters.vehicle(x + side * DIFFERENCE * unit) for side in (-1.0, 1.0)] for unit in np.eye(n)]
    bound = stiffness_bound(fit)
    rows = []
    for name, unit, value, by_factor in QUANTITIES:
        f = (lambda v, g=value: float(np.log(g(v)))) if by_factor else value
        slope = np.array([(f(high) - f(low)) / (2.0 * DIFFERENCE) for low, high in moved])
        sd, at, kind = float(np.sqrt(slope @ covariance @ slope)), f(best), "estimate"
        low, high = at - reach * sd, at + reach * sd
        if by_factor:
            low, high, sd = float(np.exp(low)), float(np.exp(high)), float(np.exp(at)) * sd
        if bound is not None and name in BOUNDED:
            power = BOUNDED[name]
            low = value(best) * (bound / best.joint.bending_stiffness_nmprad) ** power
            high, kind = np.inf, "lower bound"
        rows.append((name, unit, value(nominal), value(best), sd, low, high, kind))
    for linear in _linear_quantities(vehicle_parameters):
        at, sd = float(linear.of(x)), linear.scale * float(np.sqrt(covariance[linear.index, linear.index]))
        rows.append((linear.label, linear.unit, linear.nominal, at, sd, at - reach * sd, at + reach * sd, "estimate"))
    rows += _creep_rows(fit, reach)
    return pd.DataFrame(rows, columns=["quantity", "unit", "told", "found", "sd", "low", "high", "kind"])


def stiffness_bound(fit: JointFit) -> float | None:
    """Lower 95 % bound of the stiffness, N m/rad; None if the flight limits it above as well.

    Measurements follow the compliance 1/K, which they know by a normal law, whatever its size. The a priori law is
    taken out of the posterior; where less than `FROM_ZERO_SD` sd are left between compliance and zero, the joint may as
    well be rigid, and the bound is that of a compliance of which nothing is known but that it is not negative. No bound
    is higher than the stiffness whose oscillation the windows still resolve, and a joint within a tenth of that
    frequency is bounded only.
    """
    precision = max(1.0 / float(fit.covariance[0, 0]) - 1.0, LEAST_PRECISION)
    x = float(fit.parameters.vehicle[0])
    # compliance by the measurements alone, and its sd, over the most probable one
    compliance, sd = 1.0 - STIFFNESS_LOG_SD * x / precision, STIFFNESS_LOG_SD / np.sqrt(precision)
    below = -compliance / sd
    if below < FAR_SD:
        largest = compliance + sd * float(-ndtri((1.0 - BOUND) * ndtr(-below)))
    else:  # what is left of a normal law so far out falls as an exponential
        largest = -sd * float(np.log(1.0 - BOUND)) / below
    best = fit.problem.vehicle_parameters.vehicle(fit.parameters.vehicle)
    stiffness, resolved = best.joint.bending_stiffness_nmprad, resolved_stiffness_nmprad(best)
    if compliance > FROM_ZERO_SD * sd and stiffness < SURELY_RESOLVED * resolved:
        return None
    return min(stiffness / largest, resolved)


def posterior_sd(fit: JointFit) -> tuple[tuple[float, float], float, float]:
    """Sd of stiffness and damping (logarithms), of the offset (mean of y and z), m, and of the static stability.

    Of a stiffness that is only bounded the sd is that with which the bound holds with 95 %.
    """
    names = fit.problem.vehicle_parameters.names
    sd = dict(zip(names, np.sqrt(np.diag(fit.covariance)).tolist(), strict=True))
    offset = float(OFFSET_SD_M * np.hypot(sd["offset y"], sd["offset z"]) / np.sqrt(2.0))
    stiffness, bound = STIFFNESS_LOG_SD * sd["stiffness"], stiffness_bound(fit)
    if bound is not None:
        best = fit.problem.vehicle_parameters.vehicle(fit.parameters.vehicle).joint.bending_stiffness_nmprad
        stiffness = min(stiffness, float(np.log(max(best / bound, 1.0)) / ndtri(BOUND)))
    joint = stiffness, DAMPING_LOG_SD * sd["damping"]
    return joint, offset, fit.problem.vehicle_parameters.nominal.uncertainty.cm * sd["static stability"]


def correlations(fit: JointFit) -> pd.DataFrame:
    """Correlation of the vehicle's parameters, those sought first."""
    names = fit.problem.vehicle_parameters.names
    covariance = fit.covariance
    sd = np.sqrt(np.diag(covariance))
    return pd.DataFrame(covariance / np.outer(sd, sd), columns=list(names)).assign(unknown=list(names))


def stiffness_and_offset(fit: JointFit) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2) of stiffness, N m/rad, and size of the offset, cm."""
    vehicle_parameters, x = fit.problem.vehicle_parameters, fit.parameters.vehicle
    vehicle = vehicle_parameters.vehicle(x)
    offset = vehicle.cg_m[1:]
    size = float(np.hypot(*offset))
    slope = np.zeros((2, len(x)))
    slope[0, 0] = STIFFNESS_LOG_SD * vehicle.joint.bending_stiffness_nmprad
    slope[1, 2:4] = 100.0 * OFFSET_SD_M * offset / max(size, 1e-9)
    covariance = slope @ fit.covariance @ slope.T
    return np.array([vehicle.joint.bending_stiffness_nmprad, 100.0 * size]), covariance


def deflection_of(fit: JointFit) -> DeflectionHistory:
    """Deflection of the fitted flight in every window; covariance by the spans' starts."""
    problem, measured = fit.problem, fit.problem.measured
    rotation = problem.predict(fit.parameters).deflection.reshape(-1, 3)
    # rotation vector y z to lateral vector: the shell's nose moves along its cross product with x
    lateral = np.column_stack([rotation[:, 2], -rotation[:, 1]])
    span = np.arange(measured.spans)
    at = problem.first_motion + problem.motion * span[:, None] + DEFLECTION.start + np.array([2, 1])
    whole = fit.normal.covariance_of(at.ravel()).reshape(measured.spans, 2, measured.spans, 2)
    at_start = whole[span, :, span] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    assumptions = "by the simulator with the reconciled joint, from accelerometers and rates"
    covariance = np.repeat(at_start, WINDOWS, axis=0)
    return history_from_lateral(measured.time_s.ravel(), lateral, covariance, "reconciled", assumptions)


def vehicle_file_lines(fit: JointFit) -> str:
    """Lines of a vehicle file with the fitted joint and centerbody c.g."""
    vehicle = fit.problem.vehicle_parameters.vehicle(fit.parameters.vehicle)
    joint, body = vehicle.joint, vehicle.centerbody
    lines = [
        f"# reconciled with a flight of {fit.problem.vehicle_parameters.nominal.name}",
        "[centerbody]",
        f"cg_from_datum_body_m = [{', '.join(f'{c:.6g}' for c in body.cg_from_datum_body_m)}]",
        "[joint]",
        f"bending_stiffness_nmprad = {joint.bending_stiffness_nmprad:.6g}",
        f"bending_damping_nmsprad = {joint.bending_damping_nmsprad:.6g}",
    ]
    if "freeplay" in fit.problem.vehicle_parameters.laws:
        lines.append(f"freeplay_deg = {joint.freeplay_deg:.6g}")
    if "hardening" in fit.problem.vehicle_parameters.laws:
        lines.append(f"hardening_nmprad3 = {joint.hardening_nmprad3:.6g}")
    if "creep" in fit.problem.vehicle_parameters.laws:
        lines += [f"creep_share = {joint.creep_share:.6g}", f"creep_time_s = {joint.creep_time_s:.6g}"]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Posterior:
    """Samples of the parameters sought.

    Parameters
    ----------
    fit : JointFit
    samples : (n, v) float
        The vehicle's parameters, a priori standard deviations; nuisance parameters follow those sought.
    refit_error : (REFITS,) float
        Interpolated cost less that of a new fit, at candidates two sd away.
    autocorrelation_steps : float
        Longest autocorrelation time of the walkers, steps.
    """

    fit: JointFit
    samples: FloatArray
    refit_error: FloatArray
    autocorrelation_steps: float


def require_sampler() -> None:
    """Refuse where emcee is not installed."""
    if find_spec("emcee") is None:
        raise ConfigError(
            "--posterior: emcee not installed; pip install 'postflight[posterior]', or leave the option out: the "
            "intervals are then Gaussian",
            code="package-missing",
        )


@dataclass(frozen=True)
class Profile:
    """Profile cost: candidates of the parameters sought, with all others at their most probable values.

    A candidate ``(p,)`` is the difference to the best fit in independent standard deviations of the linear problem.
    """

    fit: JointFit

    @property
    def count(self) -> int:
        """How many parameters are sought."""
        return self.fit.problem.vehicle_parameters.sought

    @cached_property
    def root(self) -> FloatArray:
        """Square root (p, p) of the linear covariance, which maps a candidate to the parameters sought."""
        return np.asarray(np.linalg.cholesky(self.fit.covariance[: self.count, : self.count]))

    @cached_property
    def _linear_problem(self) -> tuple[Linearization, FloatArray, NormalEquations]:
        """Derivatives at the best fit, steps (n, p) of all parameters to a candidate, equations of the others."""
        p, problem = self.count, self.fit.problem
        linear = problem.linearize(self.fit.parameters)
        whole = problem.normal_equations(self.fit.parameters, linear)
        coupling, others = whole.without(p)
        return linear, np.concatenate([self.root, -others.solve(coupling @ self.root)]), others

    def one_sided(self, z: FloatArray) -> NDArray[np.bool_]:
        """Mask (n,) of candidates with the best fit's sign of freeplay; the opposite sign gives the same flights."""
        names, best = self.fit.problem.vehicle_parameters.names, self.fit.parameters.vehicle
        if "freeplay" not in names:
            return np.ones(len(z), dtype=bool)
        k = names.index("freeplay")
        return np.asarray((best[k] + z @ self.root[k]) * best[k] > 0.0)

    def vehicles(self, z: FloatArray) -> FloatArray:
        """Vehicle's parameters (n, v) of candidates (n, p), nuisance parameters by the linear problem."""
        names = self.fit.problem.vehicle_parameters.names
        away = z @ self._linear_problem[1][: len(names)].T
        return np.asarray(self.fit.parameters.vehicle + away)

    def at(self, z: FloatArray) -> tuple[float, Parameters]:
        """Cost of a candidate and all its parameters."""
        problem, p = self.fit.problem, self.count
        linear, steps, others = self._linear_problem
        u = self.fit.parameters.straight(steps @ z)
        residuals = problem.residuals(u)
        best = residuals.cost, u
        for _ in range(CORRECTIONS):
            if not np.isfinite(residuals.cost):
                break
            right = problem.right_hand_side(u, linear, residuals)
            u = u.plus(np.concatenate([np.zeros(p), others.solve(right[p:])]))
            residuals = problem.residuals(u)
            best = min(best, (residuals.cost, u), key=lambda pair: pair[0])
        return best

    def refitted(self, z: FloatArray) -> float:
        """Cost of a candidate after new steps of all other parameters, with new derivatives."""
        problem = self.fit.problem
        held = replace(problem, held=problem.vehicle_parameters.names[: self.count])
        cost, u = self.at(z)
        return min(cost, *(step.residuals.cost for step in descend([held] * REFIT_STEPS, u)))


def sample(fit: JointFit, progress: Progress | None = None) -> Posterior:
    """Sample the posterior of the parameters sought; the same fit gives the same samples.

    Raises
    ------
    ConfigError
        Where emcee is not installed.
    """
    require_sampler()
    report = progress or (lambda _fraction, _what: None)
    profile, rng = Profile(fit), np.random.default_rng(SEED)
    p = profile.count
    candidates = PER_UNKNOWN * p
    where = rng.standard_normal((candidates, p))
    where *= (REACH * np.sqrt(rng.random(candidates)) / np.linalg.norm(where, axis=1))[:, None]
    where[0] = 0.0
    cost = np.empty(candidates)
    for k, z in enumerate(where):
        cost[k] = profile.at(z)[0] - fit.residuals.cost
        report(0.8 * k / candidates, "profile of the posterior")
    finite = np.isfinite(cost)
    interpolated = RBFInterpolator(where[finite], cost[finite], kernel="cubic", degree=2)

    def log_probability(z: FloatArray) -> FloatArray:
        inside = (np.linalg.norm(z, axis=1) < REACH) & profile.one_sided(z)
        return np.where(inside, -0.5 * interpolated(z), -np.inf)

    report(0.8, "posterior: re-fits")
    away = rng.standard_normal((REFITS, p))
    away *= REFIT_REACH / np.linalg.norm(away, axis=1)[:, None]
    refit_error = interpolated(away) - [profile.refitted(z) - fit.residuals.cost for z in away]
    report(0.9, "posterior: emcee")
    chain, autocorrelation = _walk(log_probability, p, rng)
    report(1.0, "posterior sampled")
    return Posterior(fit, profile.vehicles(chain), np.asarray(refit_error), autocorrelation)


def quantities(vehicle_parameters: VehicleParameters, x: FloatArray) -> pd.DataFrame:
    """Engineering quantities of vehicle parameters ``(n, v)``, one row each."""
    out = pd.DataFrame([_joint(vehicle_parameters.vehicle(row)) for row in x])
    for linear in _linear_quantities(vehicle_parameters):
        out[linear.column] = linear.of(x)
    if "creep" in vehicle_parameters.laws:
        at = vehicle_parameters.names.index("creep growth")
        out["creep_share"], out["creep_time_s"] = np.array([creep_law(*row) for row in x[:, at : at + 2].tolist()]).T
    return out


def _joint(vehicle: Vehicle) -> dict[str, float]:
    offset_cm = 100.0 * vehicle.cg_m[1:]
    return {
        "stiffness_nmprad": vehicle.joint.bending_stiffness_nmprad,
        "damping_ratio": vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad(),
        "cg_offset_cm": float(np.hypot(*offset_cm)),
        "cg_offset_y_cm": float(offset_cm[0]),
        "cg_offset_z_cm": float(offset_cm[1]),
    }


def linear_quantities(posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Values (q,) of `quantities` at the best fit and their covariance (q, q) by the linear problem."""
    vehicle_parameters, x = posterior.fit.problem.vehicle_parameters, posterior.fit.parameters.vehicle
    n = len(x)
    at = np.concatenate([x[None], x + DIFFERENCE * np.eye(n), x - DIFFERENCE * np.eye(n)])
    values = quantities(vehicle_parameters, at).to_numpy()
    slope = (values[1 : n + 1] - values[n + 1 :]) / (2.0 * DIFFERENCE)
    return values[0], slope.T @ posterior.fit.covariance @ slope


def posterior_summary(posterior: Posterior) -> pd.DataFrame:
    """One row a quantity: ``quantity, best, linear_sd, median, sd, low, high`` (90 % interval of the samples)."""
    table = quantities(posterior.fit.problem.vehicle_parameters, posterior.samples)
    best, covariance = linear_quantities(posterior)
    low, median, high = table.quantile([0.05, 0.5, 0.95]).to_numpy()
    out = {"quantity": list(table), "best": best, "linear_sd": np.sqrt(np.diag(covariance)), "median": median}
    return pd.DataFrame({**out, "sd": table.std().to_numpy(), "low": low, "high": high})


def _walk(
    log_probability: Callable[[FloatArray], FloatArray], p: int, rng: np.random.Generator
) -> tuple[FloatArray, float]:
    """Thinned samples (n, p) of emcee's walkers, and their longest autocorrelation time."""
    import emcee

    start = 0.3 * rng.standard_normal((50 * WALKERS, p))
    start = start[np.isfinite(log_probability(start))][:WALKERS]
    seeded = np.random.RandomState(SEED).get_state()
    sampler = emcee.EnsembleSampler(WALKERS, p, log_probability, vectorize=True)
    sampler.run_mcmc(emcee.State(start, random_state=seeded), MOVES)
    autocorrelation = sampler.get_autocorr_time(tol=0, discard=BURNT)
    return np.asarray(sampler.get_chain(discard=BURNT, thin=THINNED, flat=True)), float(np.max(autocorrelation))

"""Posterior of the few unknowns that are sought, sampled by emcee, and its volume by dynesty.

The other unknowns (some 2700: motion, air, instruments, masses) are put at their most probable for each candidate of
the few (a profile). To that end they follow the linear problem about the best fit and are then corrected by the
gradient at the candidate with the derivatives of the best fit, which costs one flight of all spans a correction. The
profile is taken at some two hundred candidates and interpolated between them by radial functions; the samplers see the
interpolation. What that leaves out is told by `Posterior.refit_error`: candidates fitted anew with new derivatives.

The samples are widened as the fit's covariance is (`fit.WIDER_SD`); for the evidence they are not.
A profile is no marginal: that the others' scatter differs from candidate to candidate is left out.

References
----------
D. Foreman-Mackey et al., "emcee: The MCMC Hammer", 2013. J. S. Speagle, "dynesty: a dynamic nested sampling package",
2020.
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

from flightmodel.checks import ConfigError, FloatArray
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.candidate import FREEPLAY_SD_RAD, HARDENING_SD, VehicleUnknowns
from postflight.reconciliation.fit import Explained, Progress, Reconciled
from postflight.reconciliation.problem import Linear, Normal, Unknowns, step_from

SEED = 2009
PER_UNKNOWN, REACH, CORRECTIONS = 32, 5.0, 3  # candidates; reach in sd of the linear problem
REFITS, REFIT_STEPS, REFIT_REACH = 4, 2, 2.0
WALKERS, MOVES, BURNT, THINNED = 32, 2500, 500, 20
NEVER = -1e300
OPEN_ODDS = 20.0  # logarithm beyond which no better integral changes the answer
DIFFERENCE = 1e-4  # of a standard deviation of the prior
LIVE, LEFT = 250, 0.05  # nested sampling's live points; log evidence still to be found when it stops


@dataclass(frozen=True)
class Posterior:
    """Samples of the few unknowns.

    Parameters
    ----------
    found : Reconciled
    samples : (n, v) float
        The vehicle's unknowns, standard deviations of their priors; those carried along follow those sought.
    log_evidence : float
        As `Reconciled.log_evidence`, by nested sampling of the profile in place of Laplace's method.
    log_evidence_sd : float
        Of the nested sampling.
    refit_error : (REFITS,) float
        Interpolated cost less that of a new fit, at candidates two sd away.
    steps_to_forget : float
        Longest autocorrelation time of the walkers, steps.
    """

    found: Reconciled
    samples: FloatArray
    log_evidence: float
    log_evidence_sd: float
    refit_error: FloatArray
    steps_to_forget: float


def require_samplers() -> None:
    """Refuse where emcee or dynesty are not installed."""
    missing = [name for name in ("emcee", "dynesty") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"--posterior: {' and '.join(missing)} not installed; pip install 'postflight[posterior]', or leave the "
            "option out: the intervals are then Gaussian"
        )


@dataclass(frozen=True)
class Profile:
    """Cost of candidates of the few unknowns, the others at their most probable.

    A candidate is counted from the best fit, ``(p,)``, in independent standard deviations of the linear problem.
    """

    found: Reconciled

    @property
    def count(self) -> int:
        """How many unknowns are sought."""
        return self.found.problem.unknown.physical

    @cached_property
    def root(self) -> FloatArray:
        """From a candidate to the unknowns sought: root (p, p) of their linear covariance."""
        return np.asarray(np.linalg.cholesky(self.found.linear_covariance[: self.count, : self.count]))

    @cached_property
    def _about(self) -> tuple[Linear, FloatArray, Normal]:
        """Linear problem at the best fit, its steps (n, p) of all unknowns to a candidate, equations of the others."""
        p, problem = self.count, self.found.problem
        linear = problem.linear(self.found.unknowns)
        matrix, right = problem.normal(self.found.unknowns, linear)
        others = Normal(matrix[p:, p:], right[p:])
        return linear, np.concatenate([self.root, -others.solve(matrix[p:, :p] @ self.root)]), others

    def one_sided(self, z: FloatArray) -> NDArray[np.bool_]:
        """Which candidates (n,) lie on the best fit's side of no freeplay: the other side is the same again."""
        names, best = self.found.problem.unknown.names, self.found.unknowns.vehicle
        if "freeplay" not in names:
            return np.ones(len(z), dtype=bool)
        k = names.index("freeplay")
        return np.asarray((best[k] + z @ self.root[k]) * best[k] > 0.0)

    def vehicles(self, z: FloatArray) -> FloatArray:
        """Vehicle's unknowns (n, v) of candidates (n, p), those carried along by the linear problem."""
        names = self.found.problem.unknown.names
        away = z @ self._about[1][: len(names)].T * self.found.wider[: len(names)]
        return np.asarray(self.found.unknowns.vehicle + away)

    def at(self, z: FloatArray) -> tuple[float, Unknowns]:
        """Cost of a candidate and all its unknowns."""
        problem, p = self.found.problem, self.count
        linear, steps, others = self._about
        u = self.found.unknowns.moved(steps @ z)
        residuals = problem.residuals(u)
        best = residuals.cost, u
        for _ in range(CORRECTIONS):
            if not np.isfinite(residuals.cost):
                break
            right = problem.right(u, linear, residuals)
            u = u.moved(np.concatenate([np.zeros(p), others.solve(right[p:])]))
            residuals = problem.residuals(u)
            best = min(best, (residuals.cost, u), key=lambda pair: pair[0])
        return best

    def refitted(self, z: FloatArray) -> float:
        """Cost of a candidate by new steps of all others, with new derivatives."""
        problem = self.found.problem
        held = replace(problem, held=problem.unknown.names[: self.count])
        cost, u = self.at(z)
        for _ in range(REFIT_STEPS):
            step = step_from(held, u)
            u, cost = step.to, min(cost, step.residuals.cost)
        return cost


def sample(found: Reconciled, progress: Progress | None = None) -> Posterior:
    """Sample the few unknowns' posterior; the same fit gives the same samples.

    Raises
    ------
    ConfigError
        Where the samplers are not installed.
    """
    require_samplers()
    report = progress or (lambda _fraction, _what: None)
    profile, rng = Profile(found), np.random.default_rng(SEED)
    p = profile.count
    candidates = PER_UNKNOWN * p
    where = rng.standard_normal((candidates, p))
    where *= (REACH * np.sqrt(rng.random(candidates)) / np.linalg.norm(where, axis=1))[:, None]
    where[0] = 0.0
    cost = np.empty(candidates)
    for k, z in enumerate(where):
        cost[k] = profile.at(z)[0] - found.residuals.cost
        report(0.8 * k / candidates, "profile of the posterior")
    flown = np.isfinite(cost)
    between = RBFInterpolator(where[flown], cost[flown], kernel="cubic", degree=2)

    def log_probability(z: FloatArray) -> FloatArray:
        inside = (np.linalg.norm(z, axis=1) < REACH) & profile.one_sided(z)
        return np.where(inside, -0.5 * between(z), -np.inf)

    report(0.8, "posterior: re-fits")
    away = rng.standard_normal((REFITS, p))
    away *= REFIT_REACH / np.linalg.norm(away, axis=1)[:, None]
    refit_error = between(away) - [profile.refitted(z) - found.residuals.cost for z in away]
    report(0.9, "posterior: emcee")
    chain, forgot = _walk(log_probability, p, rng)
    report(0.95, "posterior: dynesty")
    volume, volume_sd = _volume(log_probability, p)
    evidence = found.log_evidence + volume - 0.5 * p * np.log(2.0 * np.pi)
    report(1.0, "posterior sampled")
    return Posterior(found, profile.vehicles(chain), evidence, volume_sd, np.asarray(refit_error), forgot)


def quantities(unknown: VehicleUnknowns, x: FloatArray) -> pd.DataFrame:
    """Return what an engineer asks for, by vehicle's unknowns ``(n, v)``, one row each."""
    out = pd.DataFrame([_joint(unknown.vehicle(row)) for row in x])
    for name, column, start, scale in (
        ("static stability", "static_stability", 1.0, unknown.told.uncertainty.cm),
        ("freeplay", "freeplay_deg", 0.0, float(np.rad2deg(FREEPLAY_SD_RAD))),
        ("hardening", "hardening_at_4_deg", 0.0, HARDENING_SD),
    ):
        if name in unknown.names:
            value = start + scale * x[:, unknown.names.index(name)]
            out[column] = np.abs(value) if name == "freeplay" else value
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
    unknown, x = posterior.found.problem.unknown, posterior.found.unknowns.vehicle
    n = len(x)
    at = np.concatenate([x[None], x + DIFFERENCE * np.eye(n), x - DIFFERENCE * np.eye(n)])
    values = quantities(unknown, at).to_numpy()
    slope = (values[1 : n + 1] - values[n + 1 :]) / (2.0 * DIFFERENCE)
    return values[0], slope.T @ posterior.found.covariance[:n, :n] @ slope


def posterior_summary(posterior: Posterior) -> pd.DataFrame:
    """One row a quantity: ``quantity, best, linear_sd, median, sd, low, high`` (90 % interval of the samples)."""
    table = quantities(posterior.found.problem.unknown, posterior.samples)
    best, covariance = linear_quantities(posterior)
    low, median, high = table.quantile([0.05, 0.5, 0.95]).to_numpy()
    out = {"quantity": list(table), "best": best, "linear_sd": np.sqrt(np.diag(covariance)), "median": median}
    return pd.DataFrame({**out, "sd": table.std().to_numpy(), "low": low, "high": high})


def sample_all(explained: Explained, progress: Progress) -> tuple[Posterior, dict[str, float]]:
    """Posterior of the joint found, and log odds by nested sampling of the laws that Laplace's method leaves open."""
    fits = [explained.found]
    for law, (lacking, having) in explained.compared.items():
        if abs(explained.log_odds[law]) < OPEN_ODDS:
            fits += [fit for fit in (lacking, having) if not any(fit is each for each in fits)]
    sampled = []
    for k, fit in enumerate(fits):

        def part(fraction: float, what: str, k: int = k) -> None:
            progress((k + fraction) / len(fits), what)

        sampled.append(sample(fit, part))

    def evidence(fit: Reconciled) -> float:
        return next((each.log_evidence for each in sampled if each.found is fit), fit.log_evidence)

    odds = {
        law: evidence(having) - evidence(lacking)
        for law, (lacking, having) in explained.compared.items()
        if abs(explained.log_odds[law]) < OPEN_ODDS
    }
    return sampled[0], odds


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
    forgot = sampler.get_autocorr_time(tol=0, discard=BURNT)
    return np.asarray(sampler.get_chain(discard=BURNT, thin=THINNED, flat=True)), float(np.max(forgot))


def _volume(log_probability: Callable[[FloatArray], FloatArray], p: int) -> tuple[float, float]:
    """Logarithm of the integral of a probability whose peak is one, over the cube within reach, and its sd."""
    import dynesty

    def within(cube: FloatArray) -> FloatArray:
        return REACH * (2.0 * cube - 1.0)

    def one(z: FloatArray) -> float:
        return max(float(log_probability(z[None])[0]), NEVER)

    sampler = dynesty.NestedSampler(one, within, p, nlive=LIVE, rstate=np.random.default_rng(SEED))
    sampler.run_nested(dlogz=LEFT, print_progress=False)
    return float(sampler.results.logz[-1] + p * np.log(2.0 * REACH)), float(sampler.results.logzerr[-1])

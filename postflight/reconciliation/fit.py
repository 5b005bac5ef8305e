"""Which joint, offset and stability explain the flight best, and how well does the flight tell them?

Steps (`steps`) on `Problem`, first with all standard deviations many times wider, so that far starts find the valley,
at last with the air as fine as the flight says (`fine_air`). The covariance is that of the linear problem at the
answer, widened by measured factors.

A joint with freeplay: the fit of a spring that has a dead band.

Within the band nothing holds the shell and the derivatives say nothing of what lies beyond it. So the first steps fly a
band whose corners are rounded over all its width, and sharpen it as the standard deviations narrow (continuation). The
shell's bending at the starts comes from a plain joint's first, wide steps: the moment is known from them, and with it
by how much further a looser joint is bent. The fit begins where air loads the joint (`observe`).

A span may still settle on a false path, on which the shell strikes the band's edge elsewhere. Before each step every
span is therefore tried from where the one before it ended, and where false paths are left, they are fitted once more
from wide standard deviations, or from another freeplay.

Has the joint freeplay, does its spring harden? Yes or no by the evidence.

Freeplay is asked first, on the loaded part of the flight (`observe`), with and without it; where it is denied the joint
is fitted to the whole flight again. Hardening is asked next, of what freeplay left.

How strong was the air's structure between the knots that may move? The flight tells.

A sounding's statistics carried on to a hundred metres are a guess, and a poor guess costs: gusts taken for stronger
than they were leave damping open and pull it down, gusts taken for weaker throw the offset off. So the share is taken
under which the readings are most probable, all unknowns integrated over by the linear problem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flightmodel.checks import FloatArray, Progress
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.candidate import FREEPLAY_SD_RAD, AirUnknowns, Observed, VehicleUnknowns, observe
from postflight.reconciliation.problem import BENDING, Linear, Normal, Problem, Residuals, Unknowns, step_from
from postflight.reconstruction import Reconstruction

WIDER = (30.0, 10.0, 3.0)
MOST_STEPS = 20  # after the widened ones
# of the cost that a step may still promise: at the end, and before the share of fine air is asked for
SETTLED, NEARLY = 0.05, 2.0
# by how much errors were larger than the linear problem says over ten dispersed flights, seeds 0 to 9; of damping and
# static stability they were not (docs/reconciliation.md)
WIDER_SD = {"stiffness": 1.7, "offset y": 1.2, "offset z": 1.2}


@dataclass(frozen=True)
class Reconciled:
    """The joint that explains the flight.

    Parameters
    ----------
    problem : Problem
    unknowns : Unknowns
        Most probable of all.
    linear_covariance : (n, n) float
        Of all unknowns, in their order, of the linear problem at the answer.
    residuals : Residuals
    steps : int
    converged : bool
    """

    problem: Problem
    unknowns: Unknowns
    linear_covariance: FloatArray
    residuals: Residuals
    steps: int
    converged: bool

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all unknowns, in their order: the linear one, widened by `WIDER_SD`."""
        return self.linear_covariance * np.outer(self.wider, self.wider)

    @property
    def wider(self) -> FloatArray:
        """How much wider each unknown's standard deviation is than the linear problem's."""
        out = np.ones(len(self.linear_covariance))
        for name, factor in WIDER_SD.items():
            out[self.problem.unknown.names.index(name)] = factor
        return out

    @property
    def sensor_rms_sd(self) -> float:
        """Rms of the sensors' residuals over their standard deviations."""
        return float(np.sqrt(np.mean(self.residuals.sensors**2)))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the probability of the data by Laplace's method, up to what all models of a flight share."""
        sd = np.sqrt(np.diag(self.linear_covariance))
        _, shape = np.linalg.slogdet(self.linear_covariance / np.outer(sd, sd))
        # freeplay has one sign: its prior is folded
        folded = np.log(2.0) if "freeplay" in self.problem.unknown.laws else 0.0
        return float(folded + self.problem.log_weight + 0.5 * shape + np.log(sd).sum() - 0.5 * self.residuals.cost)

    @property
    def vehicle(self) -> Vehicle:
        """Vehicle with the joint, the offset and the coefficients found."""
        return self.problem.unknown.flown(self.unknowns.vehicle)


def reconcile(
    flight: Reconstruction, laws: tuple[str, ...] = (), loaded: bool = False, progress: Progress | None = None
) -> Reconciled:
    """Fit joint, offset and static stability to a reconstructed flight.

    Parameters
    ----------
    flight : Flight
    laws : tuple of str
        What the spring may have beside its slope, of `candidate.LAWS`; for freeplay see `freeplay.reconcile_loose`.
    loaded : bool
        Only where air loads the joint (`observe`).
    progress : callable, optional

    Raises
    ------
    GateError
        Where sensors or vehicle are missing, or there is no pressure pulse.
    DivergenceError
        Where no candidate flies through.
    """
    problem = problem_of(flight, observe(flight, loaded), laws)
    report = progress or (lambda _fraction, _what: None)

    def first(fraction: float, what: str) -> None:
        report(0.6 * fraction, what)

    def then(fraction: float, what: str) -> None:
        report(0.6 + 0.4 * fraction, what)

    early = [replace(problem, wider=wider) for wider in WIDER]
    return in_fine_air(solve(problem, problem.start(), early, first, enough=NEARLY), then)


def in_fine_air(
    found: Reconciled, report: Progress, mend: Callable[[Problem, Unknowns], Unknowns] | None = None
) -> Reconciled:
    """Fit again with the air as fine as the flight says."""
    report(0.0, "how fine is the air's structure?")
    air = replace(found.problem.air, fine=fine_air(found.problem, found.unknowns))

    def part(fraction: float, what: str) -> None:
        report(0.2 + 0.8 * fraction, f"{what} in that air")

    return solve(replace(found.problem, air=air), found.unknowns, progress=part, mend=mend)


def problem_of(flight: Reconstruction, observed: Observed, laws: tuple[str, ...]) -> Problem:
    """Problem of a flight."""
    air = AirUnknowns(flight.telemetry.sounding, float(observed.altitude_m.min()))
    return Problem(observed, VehicleUnknowns(flight.telemetry.required_vehicle(), laws), air)


def solve(
    problem: Problem,
    start: Unknowns,
    early: Sequence[Problem] = (),
    progress: Progress | None = None,
    mend: Callable[[Problem, Unknowns], Unknowns] | None = None,
    enough: float = SETTLED,
) -> Reconciled:
    """Most probable unknowns from a start.

    Parameters
    ----------
    problem : Problem
    start : Unknowns
    early : sequence of Problem
        Easier ones, one for each of the first steps.
    progress : callable, optional
    mend : callable, optional
        Betters the unknowns of a problem before each step.
    enough : float
        Of the cost, that may be left to gain.
    """
    report = progress or (lambda _fraction, _what: None)
    most, u = len(early) + MOST_STEPS, start
    for number in range(most):
        report(number / most, f"reconciling, step {number + 1}")
        at = early[number] if number < len(early) else problem
        step = step_from(at, mend(at, u) if mend else u)
        u, settled = step.to, number >= len(early) and step.promised < enough
        if settled:
            break
    report(1.0, "reconciled")
    return Reconciled(problem, u, step.normal.covariance, step.residuals, number + 1, settled)


# widening of the standard deviations, and corner's half width over the freeplay
EARLY = ((30.0, 1.0), (10.0, 0.5), (3.0, 0.3), (3.0, 0.1), (1.0, 0.1), (1.0, 0.05))
PLAIN_STEPS = 2
STARTS_RAD = np.deg2rad([0.25, 0.5, 0.1])
AGAIN = (30.0, 10.0, 3.0)
FALSE_COST, LEAST_GAIN = 150.0, 10.0  # of a span's 60 readings with both its joins; of a new start


def reconcile_loose(
    flight: Reconstruction, observed: Observed, laws: tuple[str, ...] = ("freeplay",), progress: Progress | None = None
) -> Reconciled:
    """Fit a joint with freeplay, and what else ``laws`` of `candidate.LAWS` name, to the loaded part of a flight.

    Raises
    ------
    DivergenceError
        Where no candidate flies through.
    """
    report = progress or (lambda _fraction, _what: None)
    problem = problem_of(flight, observed, laws)
    plain = problem_of(flight, observed, tuple(law for law in laws if law != "freeplay"))
    first = plain.start()
    for _ in range(PLAIN_STEPS):
        first = step_from(replace(plain, wider=EARLY[0][0]), first).to
    early = [replace(problem, wider=wider, unknown=replace(problem.unknown, corner=corner)) for wider, corner in EARLY]
    found: list[Reconciled] = []
    share = 0.7 / len(STARTS_RAD)
    for k, freeplay_rad in enumerate(STARTS_RAD.tolist()):

        def part(f: float, what: str, k: int = k) -> None:
            report((k + f) * share, what)

        at = solve(problem, loosened(problem, first, freeplay_rad, EARLY[0][1]), early, part, rejoined)
        found.append(_again(at))
        if not false_spans(found[-1]).any():
            break

    def then(fraction: float, what: str) -> None:
        report(0.7 + 0.3 * fraction, what)

    return in_fine_air(min(found, key=lambda each: each.residuals.cost), then, rejoined)


def _again(found: Reconciled) -> Reconciled:
    """Fit once more with false spans and their neighbours wide at first."""
    false = false_spans(found)
    if not false.any():
        return found
    near = np.convolve(false, np.ones(3), "same") > 0.5
    early = [replace(found.problem, wider=np.where(near, wider, 1.0)) for wider in AGAIN]
    return min(found, solve(found.problem, found.unknowns, early, mend=rejoined), key=lambda each: each.residuals.cost)


def false_spans(found: Reconciled) -> FloatArray:
    """Which spans (s,) are far from their readings or from their neighbours."""
    return np.asarray(_local_cost(found.residuals.sensors, found.residuals.joins) > FALSE_COST)


def _local_cost(sensors: FloatArray, joins: FloatArray) -> FloatArray:
    """Sum of squares (s,) of each span's sensors and of both its joins."""
    joined = (joins**2).sum(axis=1)
    return np.asarray((sensors**2).sum(axis=(1, 2)) + np.append(joined, 0.0) + np.append(0.0, joined))


def loosened(problem: Problem, plain: Unknowns, freeplay_rad: float, corner: float) -> Unknowns:
    """Return what a plain joint's fit found, bent as much further as a joint with so much freeplay."""
    bending = plain.motion[:, BENDING].copy()
    half = corner * freeplay_rad
    size = np.linalg.norm(bending[:, 1:], axis=1)
    # where the rounded band gives the plain joint's moment
    bent = np.where(size < half, freeplay_rad - half + 2.0 * np.sqrt(half * size), size + freeplay_rad)
    bending[:, 1:] *= (bent / np.maximum(size, 1e-9))[:, None]
    motion = plain.motion.copy()
    motion[:, BENDING] = bending
    k = problem.unknown.names.index("freeplay")
    return replace(plain, vehicle=np.insert(plain.vehicle, k, freeplay_rad / FREEPLAY_SD_RAD), motion=motion)


def rejoined(problem: Problem, u: Unknowns) -> Unknowns:
    """Every span from where the one before it ended, if that explains it better; of neighbours one only."""
    read = problem.predicted(u)
    ended = u.motion.copy()
    ended[1:] = read.end[:-1]
    now, then = problem.residuals(u, read), problem.predicted(replace(u, motion=ended))
    following = (then.end[:-1] - u.motion[1:]) * problem.join_weight
    sensors = problem.residuals(replace(u, motion=ended), then).sensors
    after = (sensors**2).sum(axis=(1, 2)) + np.append((following**2).sum(axis=1), 0.0)
    gain = _local_cost(now.sensors, now.joins) - after
    gain[0] = 0.0
    motion = u.motion.copy()
    for k in np.argsort(-gain):
        if gain[k] > LEAST_GAIN and gain[k] >= gain[max(k - 1, 0) : k + 2].max():
            motion[k] = ended[k]
    moved = replace(u, motion=motion)
    return moved if problem.residuals(moved).cost < now.cost else u


@dataclass(frozen=True)
class Explained:
    """The joint with the laws that the evidence asks for.

    Parameters
    ----------
    found : Reconciled
    compared : dict
        Of every law that was asked for: the fits without and with it.
    """

    found: Reconciled
    compared: dict[str, tuple[Reconciled, Reconciled]]

    @property
    def log_odds(self) -> dict[str, float]:
        """Of every law that was asked for: logarithm of the odds of a joint with it against one without."""
        return {law: having.log_evidence - lacking.log_evidence for law, (lacking, having) in self.compared.items()}


def explain(flight: Reconstruction, asked: tuple[str, ...] = (), progress: Progress | None = None) -> Explained:
    """Fit the joint; of the laws of `candidate.LAWS` that are ``asked`` for keep those that the evidence favours.

    Raises
    ------
    GateError, DivergenceError
        As `fit.reconcile`.
    """
    report = progress or (lambda _fraction, _what: None)
    fits, most = 0, 1 + 3 * ("freeplay" in asked) + ("hardening" in asked)

    def fitted(laws: tuple[str, ...], loaded: bool) -> Reconciled:
        nonlocal fits
        begun, fits = fits / most, fits + 1

        def part(fraction: float, what: str) -> None:
            report(begun + fraction / most, what)

        if "freeplay" in laws:
            return reconcile_loose(flight, observe(flight, loaded), laws, part)
        return reconcile(flight, laws, loaded, part)

    compared: dict[str, tuple[Reconciled, Reconciled]] = {}
    found: Reconciled | None = None
    if "freeplay" in asked:
        tight, loose = compared["freeplay"] = fitted((), True), fitted(("freeplay",), True)
        found = loose if loose.log_evidence > tight.log_evidence else None
    kept = found.problem.unknown.laws if found else ()
    found = found or fitted((), False)
    if "hardening" in asked:
        hard = fitted((*kept, "hardening"), bool(kept))
        compared["hardening"] = found, hard
        # a spring that softens is no joint that the vehicle file knows: it is said, not flown
        if hard.log_evidence > found.log_evidence and hard.vehicle.joint.hardening_nmprad3 > 0.0:
            found = hard
    report(1.0, "reconciled")
    return Explained(found, compared)


# shares of the structure between knots that the sounding's statistics would have
SHARES = np.geomspace(0.05, 2.0, 7)


def fine_air(problem: Problem, u: Unknowns) -> float:
    """Share of the air's structure between knots under which the readings are most probable, by the linear problem."""
    linear = problem.linear(u)
    tried = [replace(problem, air=replace(problem.air, fine=float(share))) for share in SHARES]
    evidence = np.array([_evidence(problem, other, u, linear) for other in tried])
    k = int(np.clip(evidence.argmax(), 1, len(SHARES) - 2))
    near = np.log(SHARES[k - 1 : k + 2])
    bend, slope, _ = np.polyfit(near, evidence[k - 1 : k + 2], 2)
    best = -0.5 * slope / bend if bend < 0.0 else np.log(SHARES[evidence.argmax()])
    return float(np.exp(np.clip(best, near[0], near[-1])))


def _evidence(problem: Problem, other: Problem, u: Unknowns, linear: Linear) -> float:
    """Logarithm of the readings' probability with other standard deviations, derivatives as in ``problem``."""
    sensors = np.divide(other.weight, problem.weight, out=np.zeros_like(other.weight), where=problem.weight > 0.0)
    joins = other.join_weight / problem.join_weight
    found = Residuals(linear.found.sensors * sensors, linear.found.joins * joins, 0.0)
    weighed = Linear(
        found,
        [(column, rows * by.ravel()[:, None]) for (column, rows), by in zip(linear.sensors, sensors, strict=True)],
        [(column, rows * by[:, None]) for (column, rows), by in zip(linear.joins, joins, strict=True)],
        linear.count,
    )
    normal = Normal(*other.normal(u, weighed))
    cost = (found.sensors**2).sum() + (found.joins**2).sum() + other.prior_cost(u)
    lowest = cost - normal.solve(normal.right) @ normal.right
    return float(other.log_weight - 0.5 * lowest - 0.5 * normal.log_det)

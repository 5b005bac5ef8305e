"""Has the joint freeplay, does its spring harden? Yes or no by the evidence.

Freeplay is asked first, on the loaded part of the flight (`observe`), with and without it; where it is denied the joint
is fitted to the whole flight again. Hardening is asked next, of what freeplay left.
"""

from __future__ import annotations

from dataclasses import dataclass

from postflight.pipeline import Flight
from postflight.reconciliation.fit import Progress, Reconciled, reconcile
from postflight.reconciliation.freeplay import reconcile_loose
from postflight.reconciliation.observed import observe


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


def explain(flight: Flight, asked: tuple[str, ...] = (), progress: Progress | None = None) -> Explained:
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

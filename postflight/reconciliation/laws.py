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
    log_odds : dict
        Of every law that was asked for: logarithm of the odds of a joint with it against one without.
    """

    found: Reconciled
    log_odds: dict[str, float]


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

    odds: dict[str, float] = {}
    kept: tuple[str, ...] = ()
    chosen: Reconciled | None = None
    if "freeplay" in asked:
        tight, loose = fitted((), True), fitted(("freeplay",), True)
        odds["freeplay"] = loose.log_evidence - tight.log_evidence
        if odds["freeplay"] > 0.0:
            kept, chosen = ("freeplay",), loose
    found = chosen or fitted((), False)
    if "hardening" in asked:
        hard = fitted((*kept, "hardening"), bool(kept))
        odds["hardening"] = hard.log_evidence - found.log_evidence
        # a spring that softens is no joint that the vehicle file knows: it is said, not flown
        if odds["hardening"] > 0.0 and hard.vehicle.joint.hardening_nmprad3 > 0.0:
            found = hard
    report(1.0, "reconciled")
    return Explained(found, odds)

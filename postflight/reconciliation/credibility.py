"""Can a fit be believed? Does it explain the measurements, with a vehicle and instruments that are as stated?

Gauss-Newton steps also end where nothing flies as the flight did: in a false minimum, with a vehicle far from the
stated one, or with a motion that does not join from span to span. Each check is a finding about data or model, as those
of the reconstruction are (`recon.consistency`).
"""

from __future__ import annotations

import numpy as np

from flightmodel.statistics import chi_square_quantile
from postflight.reconciliation.fit import JointFit, mismatched_spans
from postflight.reconciliation.forward_model import MOTION
from postflight.reconciliation.modes import ModalStiffness
from postflight.reconciliation.posterior import posterior_sd
from recon.consistency import ConsistencyCheck, consistency_check

CONFIDENCE = 0.999  # as the reconstruction's checks
MOST_OFF_SD = 4.0  # as the camera's time bias
MOST_MOVED_SD = 4.0  # of some forty parameters of a right fit one is beyond it in two fits of a thousand
JOINT_WORDS = (
    "another joint, or freeplay (--freeplay) or creep (--creep), than was fitted; mass properties or sensors' places "
    "that are wrong"
)
# their a priori law says next to nothing of them
OPEN = ("stiffness", "damping", "freeplay", "hardening", "creep growth", "creep settling")


def credibility(fit: JointFit, modal: ModalStiffness | None = None) -> tuple[ConsistencyCheck, ...]:
    """Checks of residuals, moves, joins and convergence, and against the stiffness by the joint's frequency."""
    checks = (_residuals(fit), _moves(fit), _spans(fit), _convergence(fit), *_creep(fit))
    # a loose joint oscillates at the frequency of a softer one
    if modal is None or "freeplay" in fit.problem.vehicle_parameters.laws:
        return checks
    return (*checks, _frequency(fit, modal))


def _residuals(fit: JointFit) -> ConsistencyCheck:
    """All residuals against chi-square: one each for what was measured, joined and stated, less one a parameter."""
    problem = fit.problem
    # every parameter but the motion has an a priori residual; of the first motion all but the three rates
    first = problem.motion - 3
    degrees = int((problem.weight > 0.0).sum()) + fit.residuals.joins.size - problem.motion * problem.measured.spans
    degrees += first
    high = chi_square_quantile(CONFIDENCE, degrees) / degrees
    return consistency_check(
        "joint-residuals", "reconciliation: residuals", fit.residuals.cost / degrees, 0.0, high,
        "residuals no larger than predicted", "residuals are larger than predicted", advice=JOINT_WORDS,
    )  # fmt: skip


def _moves(fit: JointFit) -> ConsistencyCheck:
    """Largest move of what is stated of vehicle and instruments, over its a priori sd."""
    names = fit.problem.vehicle_parameters.names
    stated = np.array([name not in OPEN for name in names])
    moved = np.abs(np.concatenate([fit.parameters.vehicle * stated, fit.parameters.instruments]))
    worst = int(np.argmax(moved))
    name = names[worst] if worst < len(names) else _instrument(worst - len(names))
    return consistency_check(
        "joint-moves", "reconciliation: moves of what is stated", float(moved[worst]), 0.0, MOST_MOVED_SD,
        f"vehicle and instruments are as stated; largest: {name}, {moved[worst]:.1f} sd",
        f"{name} is {moved[worst]:.1f} sd from what is stated",
        advice="the interval of the joint cannot be believed; check the vehicle file and the sensors' places",
        component=name,
    )  # fmt: skip


def _instrument(number: int) -> str:
    if number >= 18:
        return ("rates' clock", "accelerometer's clock")[number - 18]
    return "rates' errors" if number < 9 else "accelerometer's errors"


def _spans(fit: JointFit) -> ConsistencyCheck:
    """Number of spans that do not match their measurements or their neighbours."""
    count = int(mismatched_spans(fit).sum())
    bad = f"{count} of {fit.problem.measured.spans} spans do not match sensors or neighbours"
    return consistency_check(
        "joint-spans", "reconciliation: spans", count, 0.0, 0.0, "all spans match sensors and neighbours", bad,
        advice="the motion between them is not the fitted joint's",
    )  # fmt: skip


def _creep(fit: JointFit) -> tuple[ConsistencyCheck, ...]:
    """How many sd of creep the fit is short of, where it has none and the joint is resolved."""
    problem = fit.problem
    if problem.motion > MOTION or problem.held:
        return ()
    worst = max(fit.creep_scores, key=lambda score: score.sds)
    share = worst.delayed / (1.0 + worst.delayed)
    words = f"{100.0 * share:.0f} % of the compliance with a time constant of {worst.time_s:g} s"
    return (
        consistency_check(
            "joint-creep", "reconciliation: creep of the joint", max(worst.sds, 0.0), 0.0, MOST_OFF_SD,
            "deflections follow the moment without creep",
            f"deflections lag behind the moment, as of a joint that creeps (linear estimate: {words})",
            advice="one stiffness does not describe this joint; fit its law with --creep",
        ),
    )  # fmt: skip


def _frequency(fit: JointFit, modal: ModalStiffness) -> ConsistencyCheck:
    """Stiffness by the joint's frequency against the fit's: difference of the logarithms over its sd."""
    sd = np.hypot(modal.sd_nmprad / modal.stiffness_nmprad, posterior_sd(fit)[0][0])
    off = np.log(modal.stiffness_nmprad / fit.vehicle.joint.bending_stiffness_nmprad)
    words = f"{modal.stiffness_nmprad:.0f} +/- {modal.sd_nmprad:.0f} N m/rad"
    return consistency_check(
        "joint-frequency", "reconciliation: stiffness by the joint's frequency", float(abs(off) / sd), 0.0, MOST_OFF_SD,
        f"the joint oscillates as fitted ({words})", f"the joint oscillates as one of {words}",
        advice=JOINT_WORDS,
    )  # fmt: skip


def _convergence(fit: JointFit) -> ConsistencyCheck:
    """Whether the last step had nothing left to gain."""
    return consistency_check(
        "joint-converged", "reconciliation: convergence", float(not fit.converged), 0.0, 0.0,
        f"converged in {fit.steps} steps", f"not converged after {fit.steps} steps",
        advice="estimates and intervals are those of the last step",
    )  # fmt: skip

"""What does ``postflight reconcile`` do? Fit the joint to a flight, write tables and figures, print the result.

A fit is checked (`credibility`): does it explain the measurements, with a vehicle and instruments as stated?
Gauss-Newton steps also end where nothing flies as the flight did: in a false minimum, with a vehicle far from the
stated one, or with a motion that does not join from span to span. Each check is a finding about data or model, as those
of the reconstruction are (`recon.consistency`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from rich.markup import escape

from flightmodel.checks import Check, GateError, Progress, check_type, part_of
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import name_of, require_earth
from flightmodel.flightfolder import read_flight
from flightmodel.statistics import chi_square_quantile
from flightmodel.tabular import Tabular
from flightmodel.vehicle import Vehicle
from postflight import run_folder
from postflight.beside import Beside, same
from postflight.commands import compile_kernels, console, print_checks
from postflight.deflections import camera_for_fusion
from postflight.flight import RECONSTRUCT, Flight
from postflight.reconciliation.fit import JointFit, mismatched_spans, require_damping, select_laws
from postflight.reconciliation.fit import reconcile as fit_joint
from postflight.reconciliation.forward_model import MOTION, SLOW_JOINT, integrable
from postflight.reconciliation.modes import ModalStiffness, stiffness_from_modes
from postflight.reconciliation.posterior import (
    Posterior,
    correlations,
    deflection_of,
    joint_table,
    posterior_sd,
    posterior_summary,
    quantities,
    require_sampler,
    sample,
    stiffness_bound,
    vehicle_file_lines,
)
from postflight.reconstruction import Reconstruction, reconstruct
from postflight.streams import on_one_thread
from postflight.studies.preflight import ENTRIES, Bounds, entry_bounds, shares, without_fit
from postflight.terminal import progress_bar
from postflight.warmup import RECONSTRUCTION
from synthetic_flight.dispersions import Factor, JointDispersions

STRONG = 3.0  # logarithm of odds of twenty to one
LAW_NAMES = {
    "freeplay": "freeplay",
    "creep": "creep (part of the compliance comes late)",
    "hardening": "a spring whose slope changes with the angle",
}
CONFIDENCE = 0.999  # as the reconstruction's checks
MOST_OFF_SD = 4.0  # as the camera's time bias
MOST_MOVED_SD = 4.0  # of some forty parameters of a right fit one is beyond it in two fits of a thousand
JOINT_WORDS = (
    "another joint, or freeplay (--freeplay) or creep (--creep), than was fitted; mass properties or sensors' places "
    "that are wrong"
)
# their a priori law says next to nothing of them
OPEN = ("stiffness", "damping", "freeplay", "hardening", "creep growth", "creep settling")


@dataclass(frozen=True, repr=False)
class Reconciliation(Tabular):
    """The joint that explains a flight; see `reconcile`.

    Parameters
    ----------
    bet : Reconstruction
    fit : JointFit
        The fit with all its parameters, covariance and residuals.
    """

    bet: Reconstruction
    fit: JointFit

    @cached_property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Checks whether the fit is credible."""
        return credibility(self.fit, _modes(self.bet, self.fit)[0])

    @property
    def deflection(self) -> DeflectionHistory:
        """Deflection of the simulated flight with the fitted joint."""
        return deflection_of(self.fit)

    def modal_stiffness(self) -> ModalStiffness:
        """Bending stiffness by the joint's frequency; `GateError` where the mode is not detected."""
        return _modal(self.bet, self.fit)

    def bounds(self, flights: int = 60, progress: Progress | None = None) -> tuple[Bounds, Bounds]:
        """Bands of dispersed entries with the joint locked, and with the fitted joint."""
        report = progress or (lambda _fraction, _what: None)
        rigid = entry_bounds(self.bet, None, flights, progress=part_of(report, 0.0, 0.3))
        laws, vehicle = dispersed(self.fit)
        return rigid, entry_bounds(self.bet, laws, ENTRIES, progress=part_of(report, 0.3, 1.0), vehicle=vehicle)

    def shares_inside(self, rigid: Bounds, flexible: Bounds) -> pd.DataFrame:
        """Share of the pressure pulse inside each band: ``joint, quantity, share_inside, ...``."""
        return shares(self.bet, rigid, flexible)

    def to_frame(self) -> pd.DataFrame:
        """The rows of ``joint.csv``: stiffness, damping, offset, stability, with a priori and posterior sd."""
        return joint_table(self.fit)

    def _about(self) -> str:
        row = self.to_frame().set_index("quantity").loc["bending stiffness"]
        how = "converged" if self.fit.converged else "NOT converged"
        failed = [each.code for each in self.consistency_checks if not each.passed]
        how += f", checks failed: {', '.join(failed)}" if failed else ""
        if row["kind"] == "lower bound":
            return f"bending stiffness above {row['low']:.0f} N m/rad (95 %), {how}"
        return f"bending stiffness {row['found']:.0f} +/- {row['sd']:.0f} N m/rad, {how}"


@on_one_thread
def reconcile(bet: Reconstruction, progress: Progress | None = None) -> Reconciliation:
    """Find the stiffness, damping and c.g. offset with which the simulator flies like the flight.

    Parameters
    ----------
    bet : Reconstruction
    progress : callable, optional

    Raises
    ------
    GateError
        Where sensors or vehicle are missing, or there is no pressure pulse.
    DivergenceError
        Where the vehicle file's joint diverges.
    """
    check_type("reconcile", bet, Reconstruction, RECONSTRUCT)
    require_earth(name_of(bet.telemetry.planet), "the reconciliation's simulator")
    return Reconciliation(bet, fit_joint(bet, progress=progress))


def run(folder: Path, laws: tuple[str, ...], sampled: bool) -> None:
    """Reconstruct, reconcile, write a run folder and print the result."""
    settings = {"reconcile": True, "laws": list(laws), "posterior": sampled}
    if sampled:
        require_sampler()
    with progress_bar() as report:
        telemetry = read_flight(folder, lambda f: report(f, "reading telemetry"))
    require_earth(name_of(telemetry.planet), "the reconciliation's simulator")
    require_damping(telemetry.required_vehicle())
    compile_kernels(*RECONSTRUCTION, "simulator", "ensembles", "creep", "spans")
    with Beside() as beside, progress_bar() as report:
        measured = Flight(telemetry)
        camera = beside.keep(camera_for_fusion, measured)
        flight = reconstruct(measured, progress=lambda f, what: report(0.02 + 0.18 * f, what))
        kept = beside.keep(same, flight)
        no_fit = beside.submit(without_fit, kept, camera)
        fitting = 0.4 if sampled else 0.7
        selection = select_laws(flight, laws, lambda f, what: report(0.2 + fitting * f, what))
        fit, odds = selection.fit, selection.log_odds
        posterior = None
        if sampled:
            posterior = sample(fit, lambda f, what: report(0.6 + 0.3 * f, what))
        report(0.9, "flying entries with the fitted joint")
        laws_flown, vehicle = dispersed(fit)
        with_fit = beside.submit(entry_bounds, kept, laws_flown, ENTRIES, 0, None, vehicle)
        # a third of a second to import, while the other process flies
        from postflight.plots.reconciliation import figure_modes, figure_posterior, figure_reconciled
        from postflight.plots.studies import figure_preflight
        from postflight.plots.style import draw
        from postflight.studies.commands import bands

        modal, no_modes = _modes(flight, fit)
        fused, rigid = no_fit.result()
        settings["output_rate_hz"] = flight.flight.settings.output_rate_hz
        with run_folder.RunFolder(folder, telemetry, settings) as out:
            table = joint_table(fit)
            out.write_csv("joint.csv", table)
            out.write_csv("joint_correlations.csv", correlations(fit))
            checks = credibility(fit, modal)
            out.write_csv("consistency_checks.csv", pd.DataFrame([vars(each) for each in checks]))
            found = Reconciliation(flight, fit)
            out.write_csv("deflection_reconciled.csv", found.deflection.to_frame())
            facts = _summary(fit, table, odds, checks)
            facts |= _modal_summary(modal, no_modes) | _posterior_summary(posterior)
            out.write_json("reconciliation.json", facts)
            (out.path / "joint.toml").write_text(vehicle_file_lines(fit))
            if posterior is not None:
                out.write_csv("posterior.csv", quantities(fit.problem.vehicle_parameters, posterior.samples))
                out.write_csv("posterior_summary.csv", posterior_summary(posterior))
            figures = out.path / "figures"
            if modal is not None:
                draw(figures / "modes.png", figure_modes, found, modal)
            if posterior is not None:
                draw(figures / "posterior.png", figure_posterior, found, posterior)
            draw(figures / "reconciled.png", figure_reconciled, found, fused)
            flexible = with_fit.result()
            inside = shares(flight, rigid, flexible)
            out.write_csv("bands.csv", bands(rigid, flexible))
            out.write_csv("bands_shares.csv", inside)
            draw(figures / "bands.png", figure_preflight, flight, rigid, flexible)
    _print_joint(fit, table, odds)
    print_checks(checks, "fit")
    if posterior is not None:
        _print_posterior(posterior)
    if modal is None:
        console.print(f"stiffness by the joint's frequency: none ({escape(no_modes)})")
    else:
        by_modes = f"{modal.stiffness_nmprad:.0f} +/- {modal.sd_nmprad:.0f} N m/rad"
        console.print(f"stiffness by the joint's frequency: {by_modes}")
    within = ", ".join(
        f"{r.joint} {100 * r.share_inside:.0f} % ({r.quantity.split('_')[0]})" for r in inside.itertuples(index=False)
    )
    console.print(f"the flight lies inside the bands of {ENTRIES} entries, of the pulse: {within}")
    console.print(f"results in {escape(str(out.path))}")


def _modal(flight: Reconstruction, fit: JointFit) -> ModalStiffness:
    """Stiffness by the joint's frequency, looked for about the fit's."""
    if stiffness_bound(fit) is not None:
        raise GateError("modes: the joint is too stiff to be seen oscillating", code="not-observable")
    return stiffness_from_modes(flight, fit.vehicle.joint.bending_stiffness_nmprad)


def _modes(flight: Reconstruction, fit: JointFit) -> tuple[ModalStiffness | None, str]:
    """Stiffness by the joint's frequency, or why it cannot be estimated."""
    try:
        return _modal(flight, fit), ""
    except GateError as fault:
        return None, str(fault)


def _modal_summary(modal: ModalStiffness | None, no_modes: str) -> dict[str, object]:
    """Return the stiffness by the joint's frequency, for ``reconciliation.json``."""
    if modal is None:
        return {"stiffness_by_modes_nmprad": None, "no_modes": no_modes}
    return {"stiffness_by_modes_nmprad": modal.stiffness_nmprad, "stiffness_by_modes_sd_nmprad": modal.sd_nmprad}


def _posterior_summary(posterior: Posterior | None) -> dict[str, object]:
    """Return the errors of the sampling, for ``reconciliation.json``."""
    if posterior is None:
        return {}
    return {
        "posterior_refit_error_of_cost": posterior.refit_error.tolist(),
        "posterior_steps_to_forget": posterior.autocorrelation_steps,
    }


def _print_posterior(posterior: Posterior) -> None:
    """Table of the samples beside the linear problem."""
    rows = []
    for r in posterior_summary(posterior).itertuples(index=False):
        interval = f"{r.low:.4g} to {r.high:.4g}"
        rows.append((r.quantity, f"{r.best:.4g}", f"{r.linear_sd:.2g}", f"{r.median:.4g}", f"{r.sd:.2g}", interval))
    names = ("quantity", "most probable", "linear sd", "median", "sd", "90 % interval")
    console.table("Posterior (emcee)", names, rows)


def dispersed(fit: JointFit) -> tuple[JointDispersions, Vehicle]:
    """Dispersions of the fitted joint and of the vehicle with it; offset and stability have their posterior sd."""
    joint, offset, stability = posterior_sd(fit)
    # a joint that is only known to be stiff is flown no stiffer than the simulator's steps can follow
    vehicle = fit.vehicle if stiffness_bound(fit) is None else integrable(fit.vehicle, SLOW_JOINT)
    known = vehicle.uncertainty.model_copy(update={"cg_lateral_m": offset, "cm": stability})
    laws = JointDispersions(stiffness=Factor(lognormal=joint[0]), damping=Factor(lognormal=joint[1]))
    return laws, replace(vehicle, uncertainty=known)


def _summary(
    fit: JointFit, table: pd.DataFrame, odds: dict[str, float], checks: tuple[Check, ...]
) -> dict[str, object]:
    """Return the fit's quality and the joint, for ``reconciliation.json``."""
    return {
        "converged": fit.converged,
        "passed": all(each.passed for each in checks),
        "failed_checks": [each.code for each in checks if not each.passed],
        "stiffness_lower_bound_nmprad": stiffness_bound(fit),
        "steps": fit.steps,
        "sensor_residual_rms_sd": fit.sensor_rms_sd,
        "join_rms_sd": float(np.sqrt(np.mean(fit.residuals.joins**2))),
        "share_of_fine_air": fit.problem.air.turbulence_share,
        "joint": table.replace(np.inf, None).to_dict(orient="records"),
        "log_odds": odds,
    }


def _print_joint(fit: JointFit, table: pd.DataFrame, odds: dict[str, float]) -> None:
    """Table of the joint, and the odds of the laws that were asked for."""
    rows = []
    for r in table.itertuples(index=False):
        found = f"{r.found:.4g}", f"{r.sd:.2g}", f"{r.low:.4g} to {r.high:.4g}"
        if r.kind == "lower bound":
            found = f"above {r.low:.3g}", "", "95 % lower bound"
        rows.append((f"{r.quantity} ({r.unit})" if r.unit else r.quantity, f"{r.told:.4g}", *found))
    names = ("quantity", "vehicle file", "found", "1 sd", "90 % interval")
    console.table("The joint that explains the flight", names, rows)
    for law, name in LAW_NAMES.items():
        if law not in odds:
            continue
        side = "for" if odds[law] > 0.0 else "against"
        open_words = "not determined" if law == "creep" else "no clear evidence"
        evidence = open_words if abs(odds[law]) < STRONG else f"strong evidence {side}"
        console.print(f"{name}: {evidence} (odds e^{odds[law]:+.1f})")
    if odds.get("hardening", 0.0) > STRONG and "hardening" not in fit.problem.vehicle_parameters.laws:
        console.print(
            "[yellow]the stiffness falls with the angle: freeplay in part of the pulse, or a joint that yields[/]"
        )


def credibility(fit: JointFit, modal: ModalStiffness | None = None) -> tuple[Check, ...]:
    """Checks of residuals, moves, joins and convergence, and against the stiffness by the joint's frequency."""
    checks = (_residuals(fit), _moves(fit), _spans(fit), _convergence(fit), *_steps(fit), *_creep(fit))
    # a loose joint oscillates at the frequency of a softer one
    if modal is None or "freeplay" in fit.problem.vehicle_parameters.laws:
        return checks
    return (*checks, _frequency(fit, modal))


def _residuals(fit: JointFit) -> Check:
    """Check of all residuals against chi-square; degrees of freedom: measurements, joins and priors less parameters."""
    problem = fit.problem
    # every parameter but the motion has an a priori residual; of the first motion all but the three rates
    first = problem.motion - 3
    degrees = int((problem.weight > 0.0).sum()) + fit.residuals.joins.size - problem.motion * problem.measured.spans
    degrees += first
    high = chi_square_quantile(CONFIDENCE, degrees) / degrees
    return Check.of(
        "joint-residuals", "reconciliation: residuals", fit.residuals.cost / degrees, 0.0, high,
        "residuals no larger than predicted", "residuals are larger than predicted", advice=JOINT_WORDS,
    )  # fmt: skip


def _moves(fit: JointFit) -> Check:
    """Largest correction of stated vehicle and instrument values, over its a priori sd."""
    names = fit.problem.vehicle_parameters.names
    stated = np.array([name not in OPEN for name in names])
    moved = np.abs(np.concatenate([fit.parameters.vehicle * stated, fit.parameters.instruments]))
    worst = int(np.argmax(moved))
    name = names[worst] if worst < len(names) else _instrument(worst - len(names))
    return Check.of(
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


def _spans(fit: JointFit) -> Check:
    """Number of spans that do not match their measurements or their neighbours."""
    count = int(mismatched_spans(fit).sum())
    bad = f"{count} of {fit.problem.measured.spans} spans do not match sensors or neighbours"
    return Check.of(
        "joint-spans", "reconciliation: spans", count, 0.0, 0.0, "all spans match sensors and neighbours", bad,
        advice="the motion between them is not the fitted joint's",
    )  # fmt: skip


def _steps(fit: JointFit) -> tuple[Check, ...]:
    """Shift of an estimate with finer integration steps, in its sd; for a joint with an estimate, not only a bound.

    Half a sd widens an interval by an eighth; the fit corrects what is above a tenth.
    """
    if fit.problem.held:
        return ()
    moved = np.abs(fit.moves_by_steps_sd)
    name = fit.problem.vehicle_parameters.names[int(np.argmax(moved))]
    return (
        Check.of(
            "joint-steps", "reconciliation: integration steps", float(moved.max()), 0.0, 0.5,
            "finer integration steps move no estimate", f"finer integration steps move {name}",
            advice="the fit's own steps are too long for this motion: its intervals do not hold", component=name,
        ),
    )  # fmt: skip


def _creep(fit: JointFit) -> tuple[Check, ...]:
    """Check for creep that the fit lacks, in its sd, if the joint is resolved."""
    problem = fit.problem
    if problem.motion > MOTION or problem.held:
        return ()
    worst = max(fit.creep_scores, key=lambda score: score.sds)
    share = worst.delayed / (1.0 + worst.delayed)
    words = f"{100.0 * share:.0f} % of the compliance with a time constant of {worst.time_s:g} s"
    return (
        Check.of(
            "joint-creep", "reconciliation: creep of the joint", max(worst.sds, 0.0), 0.0, MOST_OFF_SD,
            "deflections follow the moment without creep",
            f"deflections lag behind the moment, as of a joint that creeps (linear estimate: {words})",
            advice="one stiffness does not describe this joint; fit its law with --creep",
        ),
    )  # fmt: skip


def _frequency(fit: JointFit, modal: ModalStiffness) -> Check:
    """Stiffness by the joint's frequency against the fit's: difference of the logarithms over its sd."""
    sd = np.hypot(modal.sd_nmprad / modal.stiffness_nmprad, posterior_sd(fit)[0][0])
    off = np.log(modal.stiffness_nmprad / fit.vehicle.joint.bending_stiffness_nmprad)
    words = f"{modal.stiffness_nmprad:.0f} +/- {modal.sd_nmprad:.0f} N m/rad"
    return Check.of(
        "joint-frequency", "reconciliation: stiffness by the joint's frequency", float(abs(off) / sd), 0.0, MOST_OFF_SD,
        f"the joint oscillates as fitted ({words})", f"the joint oscillates as one of {words}",
        advice=JOINT_WORDS,
    )  # fmt: skip


def _convergence(fit: JointFit) -> Check:
    """Whether the last step could not reduce the cost any further."""
    return Check.of(
        "not-converged", "reconciliation: convergence", float(not fit.converged), 0.0, 0.0,
        f"converged in {fit.steps} steps", f"not converged after {fit.steps} steps",
        advice="estimates and intervals are those of the last step",
    )  # fmt: skip

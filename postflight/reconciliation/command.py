"""What ``postflight reconcile`` does: fit the joint to a flight, write tables and a figure, print the story."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from rich.markup import escape
from rich.table import Table

from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from postflight import run_folder
from postflight.commands import compile_kernels, console
from postflight.deflections import estimate
from postflight.flight import PULSE_RATE_HZ, Flight
from postflight.plots.paper_figures import save
from postflight.plots.reconciliation import figure_modes, figure_posterior, figure_reconciled
from postflight.progress import Report, progress_bar
from postflight.reconciliation.answer import correlations, deflection_of, found_sd, joint_table, vehicle_lines
from postflight.reconciliation.fit import Reconciled, explain
from postflight.reconciliation.modes import ModalStiffness, stiffness_by_modes
from postflight.reconciliation.posterior import Posterior, posterior_summary, quantities, require_samplers, sample_all
from postflight.reconstruction import Reconstruction, reconstruct
from postflight.studies.commands import bands, held_against
from postflight.studies.preflight import Bounds, entry_bounds, rigid_bounds
from postflight.warmup import RECONSTRUCTION
from recon.settings import Settings
from synthetic_flight.dispersions import Factor, JointDispersions

ENTRIES = 300
STRONG = 3.0  # logarithm of odds of twenty to one
MISFIT = 1.5  # rms of the sensors' residuals over their sd; some 0.6 where the joint explains the flight
LAW_WORDS = {"freeplay": "freeplay", "hardening": "a spring whose slope changes with the angle"}


def run(folder: Path, laws: tuple[str, ...], sampled: bool) -> None:
    """Reconstruct, reconcile, write a run folder and print what was found."""
    settings = {"reconcile": True, "laws": list(laws), "posterior": sampled, "output_rate_hz": 20.0}
    if sampled:
        require_samplers()
    with progress_bar() as report:
        report(0.0, "reading telemetry")
        telemetry = read_flight(folder, lambda f: report(0.02 * f, "reading telemetry"))
        compile_kernels(*RECONSTRUCTION, "simulator", "ensembles")
        flight = reconstruct(
            Flight(telemetry), Settings(pulse_rate_hz=PULSE_RATE_HZ), lambda f, what: report(0.02 + 0.18 * f, what)
        )
        answers = estimate(flight, ("fused",), lambda f, what: report(0.2 + 0.1 * f, what))
        fitting = 0.3 if sampled else 0.6
        explained = explain(flight, laws, lambda f, what: report(0.3 + fitting * f, what))
        found, odds = explained.found, explained.log_odds
        posterior = None
        if sampled:
            posterior, nested = sample_all(explained, lambda f, what: report(0.6 + 0.3 * f, what))
            odds |= nested
        modal, no_modes = _modes(flight)
        rigid = rigid_bounds(flight, ENTRIES, progress=lambda f, what: report(0.9 + 0.05 * f, what))
        flexible = reconciled_bounds(found, flight, lambda f, what: report(0.95 + 0.05 * f, what))
        shares, _, bands_picture = held_against(flight, rigid, flexible)
        with run_folder.RunFolder(folder, telemetry, settings) as out:
            table = joint_table(found)
            out.write_csv("joint.csv", table)
            out.write_csv("joint_correlations.csv", correlations(found))
            bent = deflection_of(found)
            out.write_csv("deflection_reconciled.csv", bent.to_frame())
            story = summary(found, table, odds) | modal_summary(modal, no_modes) | posterior_words(posterior)
            out.write_json("reconciliation.json", story)
            out.write_csv("bands.csv", bands(rigid, flexible))
            out.write_csv("bands_shares.csv", shares)
            save(bands_picture, out.path / "figures" / "bands.png")
            if modal is not None:
                save(figure_modes(modal, telemetry), out.path / "figures" / "modes.png")
            (out.path / "joint.toml").write_text(vehicle_lines(found))
            if posterior is not None:
                out.write_csv("posterior.csv", quantities(found.problem.unknown, posterior.samples))
                out.write_csv("posterior_summary.csv", posterior_summary(posterior))
                save(figure_posterior(posterior, telemetry), out.path / "figures" / "posterior.png")
            fused = answers.histories.get("fused")
            save(figure_reconciled(found, telemetry, bent, fused), out.path / "figures" / "reconciled.png")
    print_joint(found, table, odds)
    if posterior is not None:
        print_posterior(posterior)
    if modal is None:
        console.print(f"stiffness by the joint's frequency: none ({escape(no_modes)})")
    else:
        by_modes = f"{modal.stiffness_nmprad:.0f} +/- {modal.sd_nmprad:.0f} N m/rad"
        console.print(f"stiffness by the joint's frequency alone, independently: {by_modes}")
    inside = ", ".join(
        f"{r.joint} {100 * r.share_inside:.0f} % ({r.quantity.split('_')[0]})" for r in shares.itertuples(index=False)
    )
    console.print(f"the flight lies inside the bands of {ENTRIES} entries, of the pulse: {inside}")
    console.print(f"results in {escape(str(out.path))}")


def _modes(flight: Reconstruction) -> tuple[ModalStiffness | None, str]:
    """Stiffness by the joint's frequency, or why there is none."""
    try:
        return stiffness_by_modes(flight), ""
    except GateError as fault:
        return None, str(fault)


def modal_summary(modal: ModalStiffness | None, no_modes: str) -> dict[str, object]:
    """Return the second way's answer, for ``reconciliation.json``."""
    if modal is None:
        return {"stiffness_by_modes_nmprad": None, "no_modes": no_modes}
    return {"stiffness_by_modes_nmprad": modal.stiffness_nmprad, "stiffness_by_modes_sd_nmprad": modal.sd_nmprad}


def posterior_words(posterior: Posterior | None) -> dict[str, object]:
    """Return how far the samples may be trusted, for ``reconciliation.json``."""
    if posterior is None:
        return {}
    return {
        "posterior_refit_error_of_cost": posterior.refit_error.tolist(),
        "posterior_steps_to_forget": posterior.steps_to_forget,
        "posterior_log_evidence_over_laplace": posterior.log_evidence - posterior.found.log_evidence,
        "posterior_log_evidence_sd": posterior.log_evidence_sd,
    }


def print_posterior(posterior: Posterior) -> None:
    """Table of the samples beside the linear problem."""
    printed = Table(title="Posterior (emcee)")
    for name in ("quantity", "most probable", "linear sd", "median", "sd", "90 % interval"):
        printed.add_column(name, justify="left" if name == "quantity" else "right")
    for r in posterior_summary(posterior).itertuples(index=False):
        interval = f"{r.low:.4g} to {r.high:.4g}"
        printed.add_row(r.quantity, f"{r.best:.4g}", f"{r.linear_sd:.2g}", f"{r.median:.4g}", f"{r.sd:.2g}", interval)
    console.print(printed)


def reconciled_bounds(found: Reconciled, flight: Reconstruction, report: Report) -> Bounds:
    """Bands of entries with the joint, offset and stability found, dispersed as far as they are open still."""
    joint, offset, stability = found_sd(found)
    vehicle = found.vehicle
    known = vehicle.uncertainty.model_copy(update={"cg_lateral_m": offset, "cm": stability})
    laws = JointDispersions(stiffness=Factor(lognormal=joint[0]), damping=Factor(lognormal=joint[1]))
    return entry_bounds(flight, laws, ENTRIES, progress=report, vehicle=replace(vehicle, uncertainty=known))


def summary(found: Reconciled, table: pd.DataFrame, odds: dict[str, float]) -> dict[str, object]:
    """Return the short story, for ``reconciliation.json``."""
    return {
        "converged": found.converged,
        "steps": found.steps,
        "sensor_residual_rms_sd": found.sensor_rms_sd,
        "join_rms_sd": float(np.sqrt(np.mean(found.residuals.joins**2))),
        "share_of_fine_air": found.problem.air.fine,
        "joint": table.to_dict(orient="records"),
        "log_odds": odds,
    }


def print_joint(found: Reconciled, table: pd.DataFrame, odds: dict[str, float]) -> None:
    """Table of the joint, and a word where the fit did not settle or does not fit."""
    printed = Table(title="The joint that explains the flight")
    for name in ("quantity", "told", "found", "1 sd", "90 % interval"):
        printed.add_column(name, justify="left" if name == "quantity" else "right")
    for r in table.itertuples(index=False):
        name = f"{r.quantity} ({r.unit})" if r.unit else str(r.quantity)
        printed.add_row(name, f"{r.told:.4g}", f"{r.found:.4g}", f"{r.sd:.2g}", f"{r.low:.4g} to {r.high:.4g}")
    console.print(printed)
    for law, words in LAW_WORDS.items():
        if law not in odds:
            continue
        side = "for" if odds[law] > 0.0 else "against"
        evidence = "no clear evidence" if abs(odds[law]) < STRONG else f"strong evidence {side}"
        console.print(f"{words}: {evidence} (odds e^{odds[law]:+.1f})")
    if odds.get("hardening", 0.0) > STRONG and "hardening" not in found.problem.unknown.laws:
        console.print("[yellow]the slope falls with the angle: freeplay in part of the pulse, or a joint that gives[/]")
    if found.sensor_rms_sd > MISFIT:
        console.print(
            f"[yellow]the sensors lie {found.sensor_rms_sd:.1f} sd (rms) from the flight flown: no such joint explains "
            "it; a joint with freeplay does that to a fit without --freeplay[/]"
        )
    if not found.converged:
        console.print("[yellow]the fit had not settled after its last step: take the intervals as too narrow[/]")

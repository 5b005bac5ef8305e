"""Which figures does a run get? Everything its answers allow, under fixed file names, each from which data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from estimators.loads import FlightLoads
from estimators.trim import static_trim
from flightmodel.checks import GateError, Progress
from flightmodel.deflection import DeflectionHistory
from flightmodel.telemetry import Telemetry
from postflight.deflections import Deflections
from postflight.filming import by_camera
from postflight.flight import Flight
from postflight.plots.deflection import figure_correlation, figure_fusion, figure_summary
from postflight.plots.overlay import deflection_at, oriented_camera, write_overlay
from postflight.plots.paper_figures import figure_1_3, figure_2_3, figure_2_5, figure_2_7, figure_2_9
from postflight.plots.style import save, stamp
from postflight.plots.trajectory import (
    figure_air,
    figure_attitude,
    figure_filter_and_smoother,
    figure_flown,
    figure_residuals,
    figure_sensitivity,
)
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds, rigid_bounds

_PAPER_OFFSETS_M = (0.01, 0.0254)  # of the c.g., beside the vehicle's own, as in the paper's Figure 2.9


def draw_run(flight: Reconstruction, answers: Deflections, folder: Path, report: Progress) -> Bounds | None:
    """Draw everything that the run's answers allow; return the rigid vehicle's bands where it was flown."""
    bounds = None
    if flight.loads is not None:
        report(0.0, "flying the rigid vehicle")
        bounds = rigid_bounds(flight, progress=lambda f, what: report(0.6 * f, what))
        save(figure_1_3(flight, bounds), folder / "figure_1_3.png")
        save(figure_2_5(flight), folder / "figure_2_5.png")
    else:
        save(figure_flown(flight), folder / "flown.png")
    report(0.6, "drawing")
    if flight.as_flown is not None:
        save(figure_air(flight, flight.as_flown), folder / "air.png")
    if flight.attitude is not None and flight.attitude.comparison is not None:
        save(figure_attitude(flight, flight.attitude), folder / "attitude_check.png")
    save(figure_filter_and_smoother(flight), folder / "filter_and_smoother.png")
    save(figure_residuals(flight), folder / "residuals.png")
    if "misalignment" in answers.histories:
        save(figure_2_7(flight, answers.histories["misalignment"]), folder / "figure_2_7.png")
    if "camera" in answers.histories:
        draw_camera(flight.flight, answers.histories["camera"], folder)
    if answers.fused is not None:
        answer = answers.fused
        words = f"{answer.agreement.remark}; {answer.limbs_remark}"
        for name, figure in (
            ("fusion.png", figure_fusion(answer.fused, answer.limbs, words)),
            ("told_apart.png", figure_correlation(answer.fused, answer.agreement.singular_values)),
        ):
            stamp(figure, flight.telemetry)
            save(figure, folder / name)
    if flight.loads is not None:
        _draw_static_trim(flight.loads, flight.telemetry, folder)
    if answers.histories:
        save(figure_summary(flight, answers), folder / "summary.png")
    report(1.0, "drawn")
    return bounds


def _draw_static_trim(pulse: FlightLoads, telemetry: Telemetry, folder: Path) -> None:
    """Draw Figure 2.9 for the vehicle at the flight's peak of dynamic pressure; none where it has no static trim."""
    vehicle, k = pulse.vehicle, int(np.argmax(pulse.dynamic_pressure_pa))
    mach, pressure = float(pulse.mach[k]), float(pulse.dynamic_pressure_pa[k])
    try:
        static = static_trim(vehicle, mach, pressure)
    except GateError:
        return
    own = float(np.linalg.norm(vehicle.cg_m[1:]))
    offsets = sorted({round(own, 5), *_PAPER_OFFSETS_M})
    title = f"Static trim at {pressure:.0f} Pa, Mach {mach:.1f} (AIAA 2011-2571, Figure 2.9)"
    figure = figure_2_9(static, offsets, vehicle.joint.bending_stiffness_nmprad, title)
    stamp(figure, telemetry)
    save(figure, folder / "figure_2_9.png")


def draw_sensitivity(flight: Reconstruction, table: pd.DataFrame, folder: Path) -> None:
    """Draw the changes in the reruns, where any succeeded."""
    if table["quantity"].notna().any():
        save(figure_sensitivity(flight, table), folder / "sensitivity.png")


def draw_camera(flight: Flight, history: DeflectionHistory, folder: Path) -> None:
    """Draw benchmark frame and frame of the largest deflection with the virtual camera over them (Figure 2.3).

    Of several cameras each has files of its own, with its name.
    """
    several = len(flight.telemetry.films) > 1
    for name, (telemetry, own) in by_camera(flight.telemetry, history).items():
        _draw_one_camera(telemetry, own, folder, f"_{name}" if several else "")


def _draw_one_camera(telemetry: Telemetry, history: DeflectionHistory, folder: Path, ending: str) -> None:
    frames = telemetry.frames
    assert frames is not None
    oriented, benchmark = oriented_camera(telemetry, history)
    largest = int(np.nanargmax(np.abs(history.theta_rad)))
    pick = [benchmark, largest]
    times = [float(t) for t in frames.time_s[pick]]
    theta, plane = zip(*(deflection_at(history, t) for t in times), strict=True)
    meshes = telemetry.required_vehicle().meshes
    figure = figure_2_3(oriented, [frames.picture(k) for k in pick], times, theta, plane, meshes)
    stamp(figure, telemetry)
    save(figure, folder / f"figure_2_3{ending}.png")
    write_overlay(oriented, telemetry, largest, theta[1], plane[1], folder / f"overlay{ending}.png")

"""Which figures does a run get? Everything its answers allow, under fixed file names, each from which data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec

import numpy as np
import pandas as pd

from estimators.loads import FlightLoads
from estimators.trim import static_trim
from flightmodel.checks import GateError
from flightmodel.deflection import DeflectionHistory
from postflight.deflections import Deflections
from postflight.filming import by_camera, keep_oriented
from postflight.flight import Flight
from postflight.flown_coefficients import AeroIncrements
from postflight.plots.deflection import figure_correlation, figure_fusion, figure_increments, figure_summary
from postflight.plots.overlay import deflection_at, oriented_camera, write_overlay
from postflight.plots.paper_figures import figure_1_3, figure_2_3, figure_2_5, figure_2_7, figure_2_9
from postflight.plots.style import draw, stamp
from postflight.plots.trajectory import (
    figure_air,
    figure_attitude,
    figure_filter_and_smoother,
    figure_flown,
    figure_residuals,
    figure_sensitivity,
)
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Parameters = ParamSpec("Parameters")


def draw_run(
    flight: Reconstruction,
    answers: Deflections,
    folder: Path,
    bounds: Bounds | None = None,
    reran: pd.DataFrame | None = None,
) -> None:
    """Draw everything that the run's answers allow, Figure 1.3 where the rigid vehicle's ``bounds`` are given.

    ``reran`` is the table of `postflight.sensitivity`. A figure that fails costs itself alone, with a
    `postflight.plots.style.FigureWarning`.
    """
    draw_trajectory(flight, folder)
    draw_deflections(flight, folder, answers)
    draw_studies(flight, folder, bounds, reran, answers.increments)


def draw_trajectory(flight: Reconstruction, folder: Path) -> None:
    """Draw what the trajectory alone shows."""
    if flight.loads is not None:
        draw(folder / "figure_2_5.png", figure_2_5, flight)
    else:
        draw(folder / "flown.png", figure_flown, flight)
    if flight.as_flown is not None:
        draw(folder / "air.png", figure_air, flight, flight.as_flown)
    if flight.attitude is not None and flight.attitude.comparison is not None:
        draw(folder / "attitude_check.png", figure_attitude, flight, flight.attitude)
    draw(folder / "filter_and_smoother.png", figure_filter_and_smoother, flight)
    residuals = flight.solution.residuals
    if len(residuals) and residuals["used"].any():  # an entry state and inertial sensors have none
        draw(folder / "residuals.png", figure_residuals, flight)
    if flight.loads is not None:
        _draw_static_trim(flight.loads, flight.flight, folder)


def draw_deflections(flight: Reconstruction, folder: Path, answers: Deflections) -> None:
    """Draw the answers of the methods, and what the fusion rests on."""
    if "misalignment" in answers.histories:
        draw(folder / "figure_2_7.png", figure_2_7, flight, answers.histories["misalignment"])
    if "camera" in answers.histories:
        if answers.camera is not None:  # in a second process nothing is oriented yet
            keep_oriented(flight.telemetry, answers.camera.oriented)
        draw_camera(flight.flight, answers.histories["camera"], folder)
    if answers.fused is not None:
        answer = answers.fused
        words = f"{answer.agreement.remark}; {answer.limbs_remark}"
        draw(folder / "fusion.png", _stamped(figure_fusion, flight.flight), answer, answer.limbs, words)
        correlation = _stamped(figure_correlation, flight.flight)
        draw(folder / "correlation.png", correlation, answer, answer.agreement.singular_values)
    if answers.histories:
        draw(folder / "summary.png", figure_summary, flight, answers)


def draw_studies(
    flight: Reconstruction,
    folder: Path,
    bounds: Bounds | None,
    reran: pd.DataFrame | None,
    increments: AeroIncrements | None = None,
) -> None:
    """Draw the flight among rigid ones (Figure 1.3), sensitivity and aerodynamic increments, where they are given."""
    if increments is not None:
        draw(folder / "aero_increments.png", _stamped(figure_increments, flight.flight), increments)
    if bounds is not None:
        draw(folder / "figure_1_3.png", figure_1_3, flight, bounds)
    if reran is not None and reran["quantity"].notna().any():
        draw(folder / "sensitivity.png", figure_sensitivity, flight, reran)


def _stamped(figure: Callable[Parameters, Figure], flight: Flight) -> Callable[Parameters, Figure]:
    """Let a figure bear the flight's name in its corner."""

    def with_stamp(*args: Parameters.args, **named: Parameters.kwargs) -> Figure:
        made = figure(*args, **named)
        stamp(made, flight.telemetry, flight.changes)
        return made

    return with_stamp


def _draw_static_trim(pulse: FlightLoads, flight: Flight, folder: Path) -> None:
    """Draw Figure 2.9 for the vehicle at the flight's peak of dynamic pressure; none where it has no static trim."""
    vehicle, k = pulse.vehicle, int(np.argmax(pulse.dynamic_pressure_pa))
    mach, pressure = float(pulse.mach[k]), float(pulse.dynamic_pressure_pa[k])
    try:
        static = static_trim(vehicle, mach, pressure)
    except GateError:
        return
    own = float(np.linalg.norm(vehicle.cg_m[1:]))
    offsets = sorted({round(own, 5), 0.01, 0.0254})  # its own, and those of the paper's figure
    title = f"Static trim at {pressure:.0f} Pa, Mach {mach:.1f} (AIAA 2011-2571, Figure 2.9)"
    stiffness = vehicle.joint.bending_stiffness_nmprad
    draw(folder / "figure_2_9.png", _stamped(figure_2_9, flight), static, offsets, stiffness, title)


def draw_camera(flight: Flight, history: DeflectionHistory, folder: Path) -> None:
    """Draw benchmark frame and frame of the largest deflection with the virtual camera over them (Figure 2.3).

    Of several cameras each has files of its own, with its name.
    """
    several = len(flight.telemetry.films) > 1
    for name, (telemetry, own) in by_camera(flight.telemetry, history).items():
        seen = replace(flight, telemetry=telemetry)
        _draw_one_camera(seen, own, folder, f"_{name}" if several else "")


def _draw_one_camera(flight: Flight, history: DeflectionHistory, folder: Path, ending: str) -> None:
    telemetry = flight.telemetry
    frames = telemetry.frames
    assert frames is not None
    oriented, benchmark = oriented_camera(telemetry, history)
    largest = history.largest()
    pick = [benchmark, largest]
    times = [float(t) for t in frames.time_s[pick]]
    theta, plane = zip(*(deflection_at(history, t) for t in times), strict=True)
    meshes = telemetry.required_vehicle().meshes
    pictures = [frames.picture(k) for k in pick]
    path = folder / f"figure_2_3{ending}.png"
    draw(path, _stamped(figure_2_3, flight), oriented, pictures, times, theta, plane, meshes)
    write_overlay(oriented, telemetry, largest, theta[1], plane[1], folder / f"overlay{ending}.png")

"""Which figures does a run get? Everything its answers allow, under fixed file names, each from which data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd

from flightmodel.deflection import DeflectionHistory
from postflight.deflections import Deflections
from postflight.filming import by_camera, keep_oriented
from postflight.flight import Flight
from postflight.flown_coefficients import AeroIncrements
from postflight.plots.deflection import (
    figure_correlation,
    figure_deflection,
    figure_fusion,
    figure_increments,
    figure_summary,
)
from postflight.plots.overlay import deflection_at, oriented_camera, write_overlay
from postflight.plots.paper_figures import (
    figure_1_3,
    figure_2_3,
    figure_2_5,
    figure_2_7,
    figure_2_9,
    has_static_trim,
)
from postflight.plots.style import FigureFolder
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


def draw_run(
    flight: Reconstruction,
    answers: Deflections,
    folder: Path,
    bounds: Bounds | None = None,
    reran: pd.DataFrame | None = None,
    formats: tuple[str, ...] = ("png",),
) -> None:
    """Draw everything that the run's answers allow, Figure 1.3 where the rigid vehicle's ``bounds`` are given.

    ``reran`` is the table of `postflight.sensitivity`. A figure that fails costs itself alone, with a
    `postflight.plots.style.FigureWarning`.
    """
    figures = FigureFolder(folder, formats)
    draw_trajectory(flight, figures)
    draw_deflections(flight, figures, answers)
    draw_studies(flight, figures, bounds, reran, answers.increments)


def draw_trajectory(flight: Reconstruction, figures: FigureFolder) -> None:
    """Draw what the trajectory alone shows."""
    if flight.loads is not None:
        figures.draw("figure_2_5", figure_2_5, flight)
    else:
        figures.draw("flown", figure_flown, flight)
    if flight.as_flown is not None:
        figures.draw("air", figure_air, flight)
    if flight.attitude is not None and flight.attitude.comparison is not None:
        figures.draw("attitude_check", figure_attitude, flight)
    figures.draw("filter_and_smoother", figure_filter_and_smoother, flight)
    residuals = flight.solution.residuals
    if len(residuals) and residuals["used"].any():  # an entry state and inertial sensors have none
        figures.draw("residuals", figure_residuals, flight)
    if flight.loads is not None and has_static_trim(flight.loads):
        figures.draw("figure_2_9", figure_2_9, flight)


def draw_deflections(flight: Reconstruction, figures: FigureFolder, answers: Deflections) -> None:
    """Draw the answers of the methods, and what the fusion rests on."""
    answers = replace(answers, bet=flight)  # which is not handed over twice to a second process
    if "camera" in answers.histories:
        if answers.camera is not None:  # in a second process nothing is oriented yet
            keep_oriented(flight.telemetry, answers.camera.oriented)
        _draw_cameras(flight.flight, answers.histories["camera"], figures)
    _draw_loads(answers, figures)


def draw_alone(answers: Deflections, figures: FigureFolder, flight: Flight) -> None:
    """Draw answers that no run holds: by a table of loads, by a film, or by a trajectory that is not written."""
    if "camera" in answers.histories:
        _draw_cameras(flight, answers.histories["camera"], figures)
    if answers.loads is not None:
        _draw_loads(answers, figures)
    elif answers.histories:
        figures.draw("deflection", figure_deflection, answers)


def _draw_loads(answers: Deflections, figures: FigureFolder) -> None:
    """Draw what answers and their loads show together."""
    if "misalignment" in answers.histories:
        figures.draw("figure_2_7", figure_2_7, answers)
    if answers.fused is not None:
        figures.draw("fusion", figure_fusion, answers)
        figures.draw("correlation", figure_correlation, answers)
    if answers.histories:
        figures.draw("summary", figure_summary, answers)


def draw_studies(
    flight: Reconstruction,
    figures: FigureFolder,
    bounds: Bounds | None,
    reran: pd.DataFrame | None,
    increments: AeroIncrements | None = None,
) -> None:
    """Draw the flight among rigid ones (Figure 1.3), sensitivity and aerodynamic increments, where they are given."""
    if increments is not None:
        figures.draw("aero_increments", figure_increments, Deflections(bet=flight, increments=increments))
    if bounds is not None:
        figures.draw("figure_1_3", figure_1_3, flight, bounds)
    if reran is not None and reran["quantity"].notna().any():
        figures.draw("sensitivity", figure_sensitivity, flight, reran)


def draw_camera(flight: Flight, history: DeflectionHistory, folder: Path) -> None:
    """Draw benchmark frame and frame of the largest deflection with the virtual camera over them (Figure 2.3).

    Of several cameras each has files of its own, with its name.
    """
    _draw_cameras(flight, history, FigureFolder(folder))


def _draw_cameras(flight: Flight, history: DeflectionHistory, figures: FigureFolder) -> None:
    several = len(flight.telemetry.films) > 1
    for name, (telemetry, own) in by_camera(flight.telemetry, history).items():
        ending = f"_{name}" if several else ""
        figures.draw(f"figure_2_3{ending}", figure_2_3, flight, history, name)
        oriented, largest = oriented_camera(telemetry, own)[0], own.largest()
        theta, plane = deflection_at(own, float(own.time_s[largest]))
        write_overlay(oriented, telemetry, largest, theta, plane, figures.path / f"overlay{ending}.png")

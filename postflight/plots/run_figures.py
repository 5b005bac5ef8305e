"""Which figures a run gets, and what is drawn from which data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from estimators.benchmark import orient_camera, with_bent_benchmark
from estimators.camera_fit import OrientedCamera
from estimators.loads import PulseData
from estimators.overlay import GREY, YELLOW, Overlay, draw_row, horizon_row
from estimators.trim import static_trim
from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import DeflectionHistory
from flightmodel.telemetry import Telemetry
from postflight.deflections import Deflections
from postflight.plots import paper_figures
from postflight.plots import trajectory as product_figures
from postflight.plots.deflection import figure_camera_overlay, figure_fusion, figure_static_trim, figure_told_apart
from postflight.reconstruction import Reconstruction
from postflight.studies.preflight import Bounds, rigid_bounds

UNBENT_RAD = 1e-4  # less than a fit resolves: the benchmark frame where it was taken as not bent

Report = Callable[[float, str], None]


def draw_run(flight: Reconstruction, answers: Deflections, folder: Path, report: Report) -> Bounds | None:
    """Draw everything that the run's answers allow; return the rigid vehicle's bands where it was flown."""
    bounds = None
    if flight.loads is not None:
        report(0.0, "flying the rigid vehicle")
        bounds = rigid_bounds(flight, progress=lambda f, what: report(0.6 * f, what))
        paper_figures.save(paper_figures.figure_1_3(flight, bounds), folder / "figure_1_3.png")
        paper_figures.save(paper_figures.figure_2_5(flight), folder / "figure_2_5.png")
    else:
        paper_figures.save(paper_figures.figure_flown(flight), folder / "flown.png")
    report(0.6, "drawing")
    if flight.as_flown is not None:
        paper_figures.save(product_figures.figure_air(flight, flight.as_flown), folder / "air.png")
    if flight.attitude is not None and flight.attitude.comparison is not None:
        paper_figures.save(product_figures.figure_attitude(flight, flight.attitude), folder / "attitude_check.png")
    paper_figures.save(product_figures.figure_filter_and_smoother(flight), folder / "filter_and_smoother.png")
    paper_figures.save(paper_figures.figure_residuals(flight), folder / "residuals.png")
    if "misalignment" in answers.histories:
        paper_figures.save(
            paper_figures.figure_2_7(flight, answers.histories["misalignment"]), folder / "figure_2_7.png"
        )
    if "camera" in answers.histories:
        draw_camera(flight.telemetry, answers.histories["camera"], folder)
    if answers.fused is not None:
        fused = answers.fused
        answer = figure_fusion(fused.fused, fused.limbs, f"{fused.agreement.words}; {fused.limbs_words}")
        apart = figure_told_apart(fused.fused, fused.agreement.singular_values)
        for name, figure in (("fusion.png", answer), ("told_apart.png", apart)):
            paper_figures.stamp(figure, flight.telemetry)
            paper_figures.save(figure, folder / name)
    if flight.loads is not None:
        draw_static_trim(flight.loads, flight.telemetry, folder)
    if answers.histories:
        paper_figures.save(summary_figure(flight, answers), folder / "summary.png")
    report(1.0, "drawn")
    return bounds


def draw_static_trim(pulse: PulseData, telemetry: Telemetry, folder: Path) -> None:
    """Draw Figure 2.9 for the vehicle at the flight's peak of dynamic pressure, with its own offset and the paper's."""
    vehicle, k = pulse.vehicle, int(np.argmax(pulse.dynamic_pressure_pa))
    mach, pressure = float(pulse.mach[k]), float(pulse.dynamic_pressure_pa[k])
    try:
        static = static_trim(vehicle, mach, pressure)
    except GateError:
        return
    own = float(np.linalg.norm(vehicle.cg_m[1:]))
    offsets = sorted({round(own, 5), 0.01, 0.0254})
    title = f"static trim at {pressure:.0f} Pa, Mach {mach:.1f} (seed paper Figure 2.9)"
    figure = figure_static_trim(static, offsets, vehicle.joint.bending_stiffness_nmprad, title)
    paper_figures.stamp(figure, telemetry)
    paper_figures.save(figure, folder / "figure_2_9.png")


def draw_sensitivity(flight: Reconstruction, table: pd.DataFrame, folder: Path) -> None:
    """Draw what moved in the reruns, where any succeeded."""
    if table["quantity"].notna().any():
        paper_figures.save(product_figures.figure_sensitivity(flight, table), folder / "sensitivity.png")


def oriented_camera(telemetry: Telemetry, history: DeflectionHistory) -> tuple[OrientedCamera, int]:
    """Camera oriented on the benchmark frame, the shell there as bent as the history says, and that frame's index."""
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    benchmark = frames.benchmark
    station = vehicle.joint.station_m
    oriented = orient_camera(frames.picture(benchmark), vehicle.geometry, frames.camera, station)
    return with_bent_benchmark(oriented, *bending_at(history, float(frames.time_s[benchmark]))), benchmark


def bending_at(history: DeflectionHistory, time_s: float) -> tuple[float, float]:
    """Angle and plane, rad, in the frame of that time; not bent where it has no answer or less than a fit resolves."""
    k = int(np.argmin(np.abs(history.time_s - time_s)))
    theta, plane = float(history.theta_rad[k]), float(history.plane_lv_rad[k])
    return (theta, plane) if abs(theta) > UNBENT_RAD and abs(history.time_s[k] - time_s) < 1e-3 else (0.0, 0.0)


def draw_camera(telemetry: Telemetry, history: DeflectionHistory, folder: Path) -> None:
    """Benchmark frame and frame of the largest deflection with the virtual camera over them (Figure 2.3)."""
    frames = telemetry.frames
    assert frames is not None
    oriented, benchmark = oriented_camera(telemetry, history)
    meshes = telemetry.required_vehicle().meshes
    largest = int(np.nanargmax(np.abs(history.theta_rad)))
    pick = [benchmark, largest]
    pictures = [frames.picture(k) for k in pick]
    times = [float(t) for t in frames.time_s[pick]]
    theta, plane = zip(*(bending_at(history, t) for t in times), strict=True)
    figure = figure_camera_overlay(oriented, pictures, times, theta, plane, meshes)
    paper_figures.stamp(figure, telemetry)
    paper_figures.save(figure, folder / "figure_2_3.png")
    overlay = Overlay(oriented.view, meshes)
    picture = overlay.side_by_side(pictures[1], theta[1], plane[1])
    (folder / "overlay.png").write_bytes(cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())


def summary_figure(
    flight: Reconstruction, answers: Deflections, truth: tuple[FloatArray, FloatArray] | None = None
) -> paper_figures.Figure:
    """Return the one-page picture; with the truth where it is known and everything is estimated."""
    if "camera" not in answers.histories:
        return paper_figures.figure_summary(flight, answers, truth)
    history, video = answers.histories["camera"], flight.telemetry.frames
    assert video is not None
    oriented, benchmark = oriented_camera(flight.telemetry, history)
    largest = int(np.nanargmax(history.theta_rad))
    shown = [(k, *bending_at(history, float(video.time_s[k]))) for k in (benchmark, largest)]
    overlay = Overlay(oriented.view, flight.telemetry.required_vehicle().meshes)
    pictures = [overlay.blended(video.picture(k), theta, plane) for k, theta, plane in shown]
    # the benchmark's horizon in both, so that the eye sees how far the edge moved; its own in the second
    rows = [horizon_row(oriented.view, theta, plane) for _, theta, plane in shown]
    for picture, row, colour in (
        (pictures[0], rows[0], YELLOW),
        (pictures[1], rows[0], GREY),
        (pictures[1], rows[1], YELLOW),
    ):
        draw_row(picture, row, colour)
    between = np.full((len(pictures[0]), 12, 3), 255, dtype=np.uint8)
    strip = np.concatenate([pictures[0], between, pictures[1]], axis=1)
    bent = np.rad2deg(shown[1][1])
    words = (
        f"left: {video.time_s[benchmark]:.2f} s, benchmark; right: {video.time_s[largest]:.2f} s, {bent:.1f} deg; "
        "the virtual camera over the right half of each, its horizon in yellow, the benchmark's in grey"
    )
    return paper_figures.figure_summary(flight, answers, truth, (strip, words))

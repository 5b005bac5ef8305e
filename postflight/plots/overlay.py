"""Does the virtual camera see the aeroshell where the onboard camera saw it? Pictures and film of one over the other.

The camera is oriented on the benchmark frame; the aeroshell is then drawn over the right half of a frame at the
deflection that was estimated for it. Where the drawn edge meets the filmed one, the estimate fits. The yellow line is
the smallest row of the drawn edge, the grey one that of the benchmark frame. Films are VP9 in WebM, for browsers.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from estimators.benchmark import with_deflected_benchmark
from estimators.camera_fit import OrientedCamera
from estimators.overlay import GREY, YELLOW, Overlay, draw_row, horizon_row, write_lines
from flightmodel.checks import GateError, Progress
from flightmodel.deflection import DeflectionHistory
from flightmodel.film import Image, film_frames
from flightmodel.telemetry import Telemetry
from postflight.deflections import Deflections
from postflight.filming import orient_on_film, with_largest
from postflight.flight import Flight
from postflight.plots.subject import film_of
from postflight.reconstruction import Reconstruction
from postflight.runs import Run


def deflection_at(history: DeflectionHistory, time_s: float) -> tuple[float, float]:
    """Angle and plane, rad, in the frame at that time; zero without an answer or below the resolution of a fit."""
    k = int(np.argmin(np.abs(history.time_s - time_s)))
    theta, plane = float(history.theta_rad[k]), float(history.plane_lv_rad[k])
    # less than a fit resolves: the benchmark frame where it was taken as undeflected
    return (theta, plane) if abs(theta) > 1e-4 and abs(history.time_s[k] - time_s) < 1e-3 else (0.0, 0.0)


def oriented_camera(telemetry: Telemetry, history: DeflectionHistory) -> tuple[OrientedCamera, int]:
    """Camera oriented on the benchmark frame with the deflection of the history there, and that frame's index."""
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    benchmark = frames.benchmark
    deflected = deflection_at(history, float(frames.time_s[benchmark]))
    return with_deflected_benchmark(orient_on_film(frames, vehicle), *deflected), benchmark


def benchmark_and_largest(telemetry: Telemetry, history: DeflectionHistory) -> tuple[Image, str]:
    """Benchmark frame and frame of the largest deflection side by side (h, w, 3), and the caption."""
    telemetry, history = with_largest(telemetry, history)
    video = telemetry.frames
    assert video is not None
    oriented, benchmark = oriented_camera(telemetry, history)
    largest = history.largest()
    shown = [(k, *deflection_at(history, float(video.time_s[k]))) for k in (benchmark, largest)]
    overlay = Overlay(oriented.view, telemetry.required_vehicle().meshes)
    first, second = (overlay.blended(video.picture(k), theta, plane) for k, theta, plane in shown)
    # the benchmark's edge in both, so that the eye sees how far it moved; its own in the second
    rows = [horizon_row(oriented.view, theta, plane) for _, theta, plane in shown]
    draw_row(first, rows[0], YELLOW)
    draw_row(second, rows[0], GREY)
    draw_row(second, rows[1], YELLOW)
    white = np.full((len(first), 12, 3), 255, dtype=np.uint8)
    caption = (
        f"left: {video.time_s[benchmark]:.2f} s, benchmark; right: {video.time_s[largest]:.2f} s, "
        f"{np.rad2deg(shown[1][1]):.1f} deg; the virtual camera over the right half of each, its edge in yellow, "
        "the benchmark's in grey"
    )
    return np.concatenate([first, white, second], axis=1), caption


def write_overlay(
    oriented: OrientedCamera, telemetry: Telemetry, frame: int, theta_rad: float, plane_rad: float, path: Path
) -> None:
    """Write a PNG of one frame and the virtual camera's view of it side by side."""
    frames = telemetry.frames
    assert frames is not None
    overlay = Overlay(oriented.view, telemetry.required_vehicle().meshes)
    picture = overlay.side_by_side(frames.picture(frame), theta_rad, plane_rad)
    mark = "SYNTHETIC flight, " if telemetry.synthetic else ""
    angles = f"{np.rad2deg(theta_rad):.2f} deg towards {np.rad2deg(plane_rad):.0f} deg LV"
    write_lines(picture, [f"{telemetry.name}: {mark}{frames.time_s[frame]:.2f} s; virtual camera at {angles}"])
    path.write_bytes(cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())


def write_overlay_film(
    flown: Flight | Reconstruction | Run | Deflections,
    path: str | Path,
    history: DeflectionHistory | None = None,
    camera: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the film: the virtual view over the right half, its edge in yellow, the benchmark's in grey, the answer.

    A frame that was rejected is shown as it is, with the remark. The file appears when it is whole.

    Parameters
    ----------
    flown : Deflections or Run
        With a ``history`` also Flight or Reconstruction.
    path : path
        ``.webm``.
    history : DeflectionHistory, optional
        The camera's; that of the answers without.
    camera : str, optional
        Name of one of several cameras; the first without.
    progress : callable, optional

    Raises
    ------
    GateError
        Where there is no answer of the camera, this build of OpenCV cannot write VP9, or the disk is full.
    """
    path, report = Path(path), progress or (lambda _fraction, _what: None)
    telemetry, history = film_of("write_overlay_film", flown, history, camera)
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    oriented, benchmark = oriented_camera(telemetry, history)
    overlay = Overlay(oriented.view, vehicle.meshes)
    before = horizon_row(oriented.view, *deflection_at(history, float(frames.time_s[benchmark])))
    partial = path.with_suffix(".part.webm")
    rate = 1.0 / float(np.median(np.diff(frames.time_s))) if len(frames.time_s) > 1 else 1.0
    size = frames.camera.size_px
    with _without_standard_error():  # OpenCV warns there that it takes another tag for VP9, which is no fault
        writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*"VP90"), round(rate, 3), size)
    if not writer.isOpened():
        raise GateError(f"{path}: this build of OpenCV cannot write VP9 films; leave out --film", "package-missing")
    try:
        for k, image in enumerate(frames.pictures()):
            report(k / len(frames.time_s), f"drawing frame {k + 1} of {len(frames.time_s)}")
            theta, plane = float(history.theta_rad[k]), float(history.plane_lv_rad[k])
            time = f"{frames.time_s[k]:8.2f} s   "
            if image.shape != size[::-1]:
                picture = np.zeros((size[1], size[0], 3), dtype=np.uint8)
                write_lines(picture, [time + "cannot be decoded"])
            elif not np.isfinite(theta):
                picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
                write_lines(picture, [time + "not used"])
            else:
                picture = overlay.blended(image, theta, plane)
                draw_row(picture, before, GREY)
                draw_row(picture, horizon_row(oriented.view, theta, plane), YELLOW)
                sd = float(np.rad2deg(history.theta_sd_rad[k]))
                answer = f"{np.rad2deg(theta):5.2f} +/- {sd:.2f} deg   plane {np.rad2deg(plane):4.0f} deg LV"
                write_lines(picture, [time + answer])
            writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        writer.release()
        if next(film_frames(partial, [len(frames.time_s) - 1])).size == 0:  # OpenCV reports no full disk
            words = f"{path.name}: the film could not be written whole; make room, or leave out --film"
            raise GateError(words, "disk-full")
        partial.replace(path)
    finally:
        writer.release()
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _without_standard_error() -> Iterator[None]:
    """Suppress standard error output that libraries write there past Python."""
    try:
        kept = os.dup(2)
    except OSError:  # closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(nowhere)
        os.close(kept)

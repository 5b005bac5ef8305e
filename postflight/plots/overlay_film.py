"""The onboard film with the virtual camera over it, frame by frame, as a film that plays in a browser (VP9 WebM)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from estimators.overlay import GREY, YELLOW, Overlay, draw_row, horizon_row, write_words
from flightmodel.checks import GateError
from flightmodel.deflection import DeflectionHistory
from flightmodel.film import film_frames
from flightmodel.telemetry import Telemetry
from postflight.flight import Progress
from postflight.plots.run_figures import bending_at, oriented_camera


def write_overlay_film(telemetry: Telemetry, history: DeflectionHistory, path: Path, progress: Progress) -> None:
    """Write the film: the virtual view over the right half, its horizon in yellow, the benchmark's in grey, the answer.

    A frame that was refused is shown as it is, and says so. The file appears when it is whole.

    Raises
    ------
    GateError
        Where this build of OpenCV cannot write VP9.
    """
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    oriented, benchmark = oriented_camera(telemetry, history)
    overlay = Overlay(oriented.view, vehicle.meshes)
    before = horizon_row(oriented.view, *bending_at(history, float(frames.time_s[benchmark])))
    partial = path.with_suffix(".part.webm")
    rate = 1.0 / float(np.median(np.diff(frames.time_s))) if len(frames.time_s) > 1 else 1.0
    size = (frames.camera.width_px, frames.camera.height_px)
    with _without_standard_error():  # OpenCV says there that it takes another tag for VP9, which is no fault
        writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*"VP90"), round(rate, 3), size)
    if not writer.isOpened():
        raise GateError(f"{path}: this build of OpenCV cannot write VP9 films; leave out --film")
    try:
        for k, image in enumerate(frames.pictures()):
            progress(k / len(frames.time_s), f"drawing frame {k + 1} of {len(frames.time_s)}")
            theta, plane = float(history.theta_rad[k]), float(history.plane_lv_rad[k])
            said = f"{frames.time_s[k]:8.2f} s   "
            if image.shape != size[::-1]:
                picture = np.zeros((size[1], size[0], 3), dtype=np.uint8)
                write_words(picture, [said + "cannot be decoded"])
            elif not np.isfinite(theta):
                picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
                write_words(picture, [said + "not used"])
            else:
                picture = overlay.blended(image, theta, plane)
                draw_row(picture, before, GREY)
                draw_row(picture, horizon_row(oriented.view, theta, plane), YELLOW)
                sd = float(np.rad2deg(history.theta_sd_rad[k]))
                bent = f"{np.rad2deg(theta):5.2f} +/- {sd:.2f} deg   plane {np.rad2deg(plane):4.0f} deg LV"
                write_words(picture, [said + bent])
            writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        writer.release()
        if next(film_frames(partial, [len(frames.time_s) - 1])).size == 0:  # OpenCV tells of no full disk
            raise GateError(f"{path.name}: the film could not be written whole; make room, or leave out --film")
        partial.replace(path)
    finally:
        writer.release()
        partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _without_standard_error() -> Iterator[None]:
    """Let nothing through to standard error that libraries write there past Python."""
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

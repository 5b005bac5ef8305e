"""The film strip: frames of the onboard video with the virtual camera laid over, as JPEG."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np

from estimators.overlay import GREY, YELLOW, Overlay, draw_row, horizon_row
from flightmodel.deflection import DeflectionHistory
from flightmodel.film import Image
from postflight.drawing import bending_at, oriented_camera
from postflight.report.source import Run

FRAMES, WIDTH_PX, DASH_PX = 12, 480, 12
QUALITIES, LARGEST_CHARACTERS = (78, 60, 40, 20), 600_000  # the whole strip stays below, or has the last quality


def film_strip(run: Run) -> list[dict[str, Any]]:
    """Benchmark frame, frame of the largest deflection and others spread between, each with its answer.

    Empty where the camera gave none.
    """
    table, frames = run.tables.get("deflection_camera"), run.telemetry.frames
    if table is None or frames is None:
        return []
    answered = np.searchsorted(frames.time_s, table["t_s"] - 1e-6)
    largest = int(answered[int(table["theta_deg"].argmax())])
    picks = np.linspace(answered[0], answered[-1], FRAMES).round().astype(int).tolist()
    time_s, theta_deg, plane_deg = (table[name].to_numpy() for name in ("t_s", "theta_deg", "plane_lv_deg"))
    history = DeflectionHistory(time_s, np.deg2rad(theta_deg), np.deg2rad(plane_deg), None, "camera", "")
    oriented, benchmark = oriented_camera(run.telemetry, history)
    overlay = Overlay(oriented.view, run.telemetry.required_vehicle().meshes)
    before = horizon_row(oriented.view, *bending_at(history, float(frames.time_s[benchmark])))
    chosen = sorted({*_without_near(picks, (benchmark, largest)), benchmark, largest})
    rows = dict(zip(answered.tolist(), table.itertuples(index=False), strict=True))
    out: list[dict[str, Any]] = []
    drawn: list[Image] = []
    for k, image in zip(chosen, frames.pictures(chosen), strict=True):
        if image.size == 0:
            continue
        said: dict[str, Any] = {"t": round(float(frames.time_s[k]), 4), "benchmark": k == benchmark}
        said |= {"largest": k == largest, "theta": None, "sd": None}
        if k in rows:
            theta, plane = np.deg2rad([rows[k].theta_deg, rows[k].plane_lv_deg])
            picture = overlay.blended(image, float(theta), float(plane))
            picture = dashed_row(picture, before)
            draw_row(picture, horizon_row(oriented.view, float(theta), float(plane)), YELLOW)
            said |= {"theta": round(rows[k].theta_deg, 3), "sd": round(rows[k].theta_sd_deg, 3)}
        else:
            picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        out.append(said)
        drawn.append(picture)
    return [said | {"jpeg": text} for said, text in zip(out, jpegs(drawn), strict=True)]


def dashed_row(picture: Image, row: int) -> Image:
    """Picture with the grey line in dashes, so that it stands apart from the yellow one without colours."""
    drawn = picture.copy()
    draw_row(drawn, row, GREY)
    dash = (np.arange(picture.shape[1]) // DASH_PX % 2 == 0)[None, :, None]
    return np.where(dash, drawn, picture)


def _without_near(picks: list[int], wanted: tuple[int, ...]) -> list[int]:
    """Picks without the one nearest to each frame that is shown anyway."""
    left = list(picks)
    for k in wanted:
        left.remove(min(left, key=lambda pick: abs(pick - k)))
    return left


def jpegs(pictures: list[Image]) -> list[str]:
    """Data URIs of RGB pictures ``(h, w, 3)``, as fine as lets all of them together stay small."""
    small = [narrowed(picture) for picture in pictures]
    told: list[str] = []
    for quality in QUALITIES:
        told = [jpeg(picture, quality) for picture in small]
        if sum(map(len, told)) <= LARGEST_CHARACTERS:
            break
    return told


def narrowed(picture: Image) -> Image:
    """Picture made ``WIDTH_PX`` wide where it is wider."""
    height, width = picture.shape[:2]
    if width <= WIDTH_PX:
        return picture
    size = (WIDTH_PX, round(height * WIDTH_PX / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def jpeg(picture: Image, quality: int) -> str:
    """Data URI of one RGB picture."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()

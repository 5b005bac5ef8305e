"""What does the report show of the video? Onboard frames with the virtual camera's shell over them."""

from __future__ import annotations

import base64
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pandas as pd
from scipy.ndimage import maximum_filter1d

from estimators.overlay import GREY, YELLOW, Overlay, draw_outline, draw_row, horizon_row
from estimators.virtual_camera import VirtualCamera
from flightmodel.deflection import DeflectionHistory, lv_direction
from flightmodel.film import Image
from flightmodel.telemetry import Telemetry
from postflight.filming import by_camera
from postflight.plots.overlay import deflection_at, oriented_camera
from postflight.runs import Run

_WIDTH_PX, _WORST = 480, 5
QUALITIES, LARGEST_CHARACTERS = (78, 60, 40, 20), 600_000  # the whole strip stays below, or has the last quality


def film_strip(run: Run) -> list[dict[str, Any]]:
    """Benchmark frame, frame of the largest deflection and others spread between, each with its answer, by time.

    Of several cameras each has its own, fewer; empty where none gave an answer.
    """
    table, films = run.tables.get("deflection_camera"), run.telemetry.films
    if table is None:
        return []
    time_s, theta, plane = (table[name].to_numpy() for name in ("t_s", "theta_deg", "plane_lv_deg"))
    history = DeflectionHistory(time_s, np.deg2rad(theta), np.deg2rad(plane), None, "camera", "")
    strips = []
    for name, (seen, own) in by_camera(run.telemetry, history).items():
        near = np.isin(np.round(table["t_s"], 3), np.round(own.time_s[np.isfinite(own.theta_rad)], 3))
        strips += _strip(name, seen, table[near], max(12 // len(films), 4))
    strips.sort(key=lambda one: one[0]["t"])
    texts = jpegs([picture for _, picture in strips])
    return [frame | {"jpeg": text} for (frame, _), text in zip(strips, texts, strict=True)]


def _strip(name: str, telemetry: Telemetry, table: pd.DataFrame, count: int) -> list[tuple[dict[str, Any], Image]]:
    """One camera's frames and their pictures; ``table`` has its answers."""
    frames = telemetry.frames
    assert frames is not None
    answered = np.searchsorted(frames.time_s, table["t_s"] - 1e-6)
    largest = int(answered[int(table["theta_deg"].argmax())])
    picks = np.linspace(answered[0], answered[-1], count).round().astype(int).tolist()
    time_s, theta_deg, plane_deg = (table[column].to_numpy() for column in ("t_s", "theta_deg", "plane_lv_deg"))
    history = DeflectionHistory(time_s, np.deg2rad(theta_deg), np.deg2rad(plane_deg), None, "camera", "")
    oriented, benchmark = oriented_camera(telemetry, history)
    overlay = Overlay(oriented.view, telemetry.required_vehicle().meshes)
    before = horizon_row(oriented.view, *deflection_at(history, float(frames.time_s[benchmark])))
    chosen = sorted({*_without_near(picks, (benchmark, largest)), benchmark, largest})
    rows = dict(zip(answered.tolist(), table.itertuples(index=False), strict=True))
    out: list[tuple[dict[str, Any], Image]] = []
    for k, image in zip(chosen, frames.pictures(chosen), strict=True):
        if image.size == 0:
            continue
        frame: dict[str, Any] = {"t": round(float(frames.time_s[k]), 4), "camera": name, "benchmark": k == benchmark}
        frame |= {"largest": k == largest, "theta": None, "sd": None}
        if k in rows:
            theta, plane = np.deg2rad([rows[k].theta_deg, rows[k].plane_lv_deg])
            picture = overlay.blended(image, float(theta), float(plane))
            picture = _dashed_row(picture, before)
            draw_row(picture, horizon_row(oriented.view, float(theta), float(plane)), YELLOW)
            frame |= {"theta": round(rows[k].theta_deg, 3), "sd": round(rows[k].theta_sd_deg, 3)}
        else:
            picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        out.append((frame, picture))
    return out


def worst_frames(run: Run) -> list[dict[str, Any]]:
    """Frames that an analyst should check first, with the virtual camera's outline; empty without a film.

    The outline is drawn at a used frame's own answer (yellow), at its neighbours' where it was refused (grey).
    """
    every = run.tables.get("camera_frames")
    if every is None:
        return []
    out, drawn, cameras = [], [], {}
    for at in worst_first(every)[:_WORST]:
        name = str(every["camera"][at])
        if name not in cameras:
            cameras[name] = _oriented_on(run.telemetry, name, every[every["camera"] == name])
        view, history = cameras[name]
        row, frames = every.iloc[at], run.telemetry.films[name]
        k = int(np.abs(frames.time_s - row["t_s"]).argmin())
        image, used = frames.picture(k), np.isfinite(history.theta_rad)
        if image.size == 0:
            picture = np.zeros((frames.camera.height_px, frames.camera.width_px, 3), dtype=np.uint8)
        else:
            picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
            known = history.time_s[used], history.theta_yz_rad[used]
            yz = [float(np.interp(row["t_s"], known[0], c)) if used.any() else 0.0 for c in known[1].T]
            draw_outline(picture, view, np.array(yz), YELLOW if used[k] else GREY)
        drawn.append(picture)
        numbers = {"t": float(row["t_s"]), "camera": name, "theta": row["theta_deg"], "sd": row["theta_sd_deg"]}
        out.append(numbers | {key: row[key] for key in ("edge_points", "features", "residual_rms_px")})
        out[-1] |= {"refused": "" if used[k] else f"{row['reason']} [{row['code']}]"}
    return [frame | {"jpeg": text} for frame, text in zip(out, jpegs(drawn), strict=True)]


def _oriented_on(telemetry: Telemetry, name: str, table: pd.DataFrame) -> tuple[VirtualCamera, DeflectionHistory]:
    """One camera's view, oriented on its benchmark frame, and what it read in every frame."""
    theta, plane = (np.deg2rad(table[column].to_numpy(float)) for column in ("theta_deg", "plane_lv_deg"))
    history = DeflectionHistory(telemetry.films[name].time_s, theta, plane, None, "camera", "")
    oriented, _ = oriented_camera(replace(telemetry, films={name: telemetry.films[name]}), history)
    return oriented.view, history


def worst_first(table: pd.DataFrame) -> list[int]:
    """Rows of ``camera_frames.csv``: refused frames, one of each code first, and used ones, the largest first.

    Large is a residual against its film's median one, or a distance from the line between the neighbours, over its sd
    and the film's median one where that is larger.
    Of the first five, at least two are used ones where there are as many.
    """
    refused = table["flag"] == "refused"
    again = table[refused].groupby("code").cumcount().sort_values(kind="stable")
    bad = again.index.tolist()
    sizes = [_sizes(one) for _, one in table[~refused].groupby("camera")]
    size = pd.concat(sizes) if sizes else pd.Series(dtype=float)
    good = size.sort_values(ascending=False, kind="stable").index.tolist()
    first = min(len(bad), max(_WORST - 2, _WORST - len(good)))
    return [*bad[:first], *good, *bad[first:]]


def _sizes(used: pd.DataFrame) -> pd.Series:
    """Size of each used frame's residual or step, of one camera."""
    size = used["residual_rms_px"] / max(used["residual_rms_px"].median(), 1e-9)
    if len(used) > 2:
        yz = lv_direction(np.deg2rad(used["plane_lv_deg"].to_numpy()))[:, 1:] * used["theta_deg"].to_numpy()[:, None]
        t = used["t_s"].to_numpy()
        share = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
        off = np.linalg.norm(yz[1:-1] - (1.0 - share) * yz[:-2] - share * yz[2:], axis=1)
        off = np.concatenate([[0.0], off, [0.0]]) / used["theta_sd_deg"].to_numpy()
        # the neighbours of a step are off the line as well, by half of it
        steps = np.where(off >= maximum_filter1d(off, 3), off, 0.0)
        size = np.maximum(size, steps / max(float(np.median(off)), 1.0))
    return size


def _dashed_row(picture: Image, row: int) -> Image:
    """Picture with the grey line in dashes, so that it stands apart from the yellow one without colours."""
    drawn = picture.copy()
    draw_row(drawn, row, GREY)
    dash = (np.arange(picture.shape[1]) // 12 % 2 == 0)[None, :, None]
    return np.where(dash, drawn, picture)


def _without_near(picks: list[int], wanted: tuple[int, ...]) -> list[int]:
    """Picks without the one nearest to each frame that is shown anyway."""
    left = list(picks)
    for k in wanted:
        left.remove(min(left, key=lambda pick: abs(pick - k)))
    return left


def jpegs(pictures: list[Image]) -> list[str]:
    """Data URIs of RGB pictures ``(h, w, 3)``, at the best quality for which their total size stays small."""
    small = [narrowed(picture) for picture in pictures]
    out: list[str] = []
    for quality in QUALITIES:
        out = [jpeg(picture, quality) for picture in small]
        if sum(map(len, out)) <= LARGEST_CHARACTERS:
            break
    return out


def narrowed(picture: Image) -> Image:
    """Picture made ``_WIDTH_PX`` wide where it is wider."""
    height, width = picture.shape[:2]
    if width <= _WIDTH_PX:
        return picture
    size = (_WIDTH_PX, round(height * _WIDTH_PX / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def jpeg(picture: Image, quality: int) -> str:
    """Data URI of one RGB picture."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()

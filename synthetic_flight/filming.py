"""The film of a flight: what there is to see at each frame's time, written as images or as a playable film."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from flightmodel import earth, rotations
from flightmodel.checks import FloatArray, GateError
from flightmodel.film import film_frames
from flightmodel.geomagnetism_and_sun import sun_direction_ecef
from synthetic_flight import sensing
from synthetic_flight.instrument_sections import FilmQuality, Video
from synthetic_flight.scenarios import Scenario, child_rng
from synthetic_flight.simulate import Truth
from synthetic_flight.video import Image, Imaging, Scene, film

Progress = Callable[[float, str], None]
CODECS = {"avi": "MJPG", "webm": "VP90"}


def write_video(scenario: Scenario, seed: int, truth: Truth, telemetry: Path, report: Progress) -> None:
    """Film the flight: images in a folder of the camera's name or one film, and the list of frames with their times."""
    spec, vehicle = scenario.spec.video, scenario.vehicle
    assert spec is not None
    rng = child_rng(seed, spec.camera)
    at = sensing.sample_times(spec.start_s, min(spec.stop_s, float(truth.time_s[-1])), spec.rate_hz)
    mount, imaging = vehicle.cameras[spec.camera], imaging_of(spec.imaging)
    frames = film(vehicle.geometry, mount, vehicle.joint.station_m, scene(truth, at, spec.earth), rng, imaging)
    told = _reported(frames, len(at), report)
    if spec.format == "png":
        names: list[object] = list(_write_images(told, telemetry / spec.camera))
    else:
        _write_film(told, telemetry / f"{spec.camera}.{spec.format}", spec, (mount.width_px, mount.height_px))
        names = list(range(len(at)))
    late = spec.time_offset_s * float(rng.standard_normal())
    table = pd.DataFrame({"t_s": at + late, "frame": names})
    table.to_csv(telemetry / "frames.csv", index=False, float_format="%.6f", lineterminator="\n")


def imaging_of(told: FilmQuality) -> Imaging:
    """How a scenario says that the film is, in memory's units."""
    return Imaging(
        pointing_sd_rad=float(np.deg2rad(told.pointing_deg)),
        focal_sd=told.focal,
        centre_sd_px=told.centre_px,
        k1_sd=told.k1,
        k2_sd=told.k2,
        position_sd_m=told.position_m,
        noise_sd=told.noise_grey,
        blur_px=told.blur_px,
        vignetting=told.vignetting,
        interlace_s=told.interlace_s,
        quality=told.quality,
        painted=told.painted,
        built_sd_rad=float(np.deg2rad(told.built_deg)),
        loaded_sd_rad=float(np.deg2rad(told.loaded_deg)),
    )


def scene(truth: Truth, at_s: FloatArray, with_earth: bool) -> Scene:
    """What there is to film at times ``(n,)``."""
    yz = np.column_stack([np.interp(at_s, truth.time_s, c) for c in truth.deflection.theta_yz_rad.T])
    step = 0.005
    ends = [np.column_stack([np.interp(at_s + d, truth.time_s, c) for c in truth.deflection.theta_yz_rad.T])
            for d in (-step, step)]  # fmt: skip
    pressure = truth.dynamic_pressure_pa
    return Scene(
        theta_rad=np.hypot(yz[:, 0], yz[:, 1]),
        plane_lv_rad=np.arctan2(yz[:, 1], -yz[:, 0]),
        sun_body=_to_body(truth, at_s, sun_direction_ecef(truth.trajectory.epoch_utc, at_s)),
        nadir_body=_to_body(truth, at_s, -_up_ecef(truth, at_s)) if with_earth else None,
        altitude_m=np.interp(at_s, truth.time_s, truth.altitude_m) if with_earth else None,
        load=np.interp(at_s, truth.time_s, pressure) / max(float(pressure.max()), 1e-9),
        bending_rate_yz_radps=(ends[1] - ends[0]) / (2.0 * step),
    )


def _to_body(truth: Truth, at_s: FloatArray, vectors_ecef: FloatArray) -> FloatArray:
    q = rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, at_s)
    return rotations.rotate(rotations.conjugate(q), vectors_ecef)


def _up_ecef(truth: Truth, at_s: FloatArray) -> FloatArray:
    position = np.column_stack([np.interp(at_s, truth.time_s, c) for c in truth.trajectory.position_ecef_m.T])
    latitude, longitude, _ = earth.geodetic_from_ecef(position)
    c = np.cos(latitude)
    return np.column_stack([c * np.cos(longitude), c * np.sin(longitude), np.sin(latitude)])


def _reported(frames: Iterable[Image], count: int, report: Progress) -> Iterable[Image]:
    for k, frame in enumerate(frames):
        report(0.25 + 0.7 * k / count, f"filming frame {k + 1} of {count}")
        yield frame


def _write_images(frames: Iterable[Image], folder: Path) -> Iterable[str]:
    folder.mkdir()
    for k, frame in enumerate(frames):
        name = f"frame_{k:05d}.png"
        # through Python's own file, which tells of a full disk
        (folder / name).write_bytes(cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())
        yield name


def _write_film(frames: Iterable[Image], path: Path, spec: Video, size_px: tuple[int, int]) -> None:
    code = cv2.VideoWriter.fourcc(*CODECS[path.suffix[1:]])
    writer = cv2.VideoWriter(str(path), code, float(spec.rate_hz), size_px)
    if not writer.isOpened():
        raise GateError(f'{path}: this build of OpenCV cannot write such a film; write images: video.format = "png"')
    count = 0
    try:
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
            count += 1
    finally:
        writer.release()
    if count and next(film_frames(path, [count - 1])).size == 0:  # OpenCV tells of no full disk
        raise GateError(f"{path.name}: the film could not be written whole; make room, or write to another disk")

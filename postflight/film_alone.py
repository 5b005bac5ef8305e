"""A film without a flight folder: pictures, the time of each, and a vehicle file, as the camera takes them.

The camera measures the deflection against its benchmark frame and needs neither a trajectory nor an epoch. What is
read here is a `Flight` that has a film and nothing else, so that `estimate_camera`, figures and what-ifs
(``film.with_(camera_plane_lv_deg=183.0)``) work as with a flight folder. A trajectory cannot be made from it.

Times count from any zero. A list of times has the columns ``t_s`` and ``frame`` of ``frames.csv`` in a flight folder:
names of pictures, or numbers of frames in the film, the first being 0. Without a list, pictures are taken in the order
of their names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flightmodel.atmosphere import standard_sounding
from flightmodel.checks import (
    FloatArray,
    GateError,
    IntArray,
    Issue,
    check_finite,
    check_increasing,
    check_shape,
    nearest_name,
)
from flightmodel.film import Frames, Image, film_fault, film_timing_fault, frame_times_ms, image_fault
from flightmodel.sensor_tables import reduced
from flightmodel.tables import TimeColumn, read_table, times_s
from flightmodel.telemetry import Telemetry
from flightmodel.vehicle import CameraMount, Vehicle, read_vehicle
from postflight.flight import Flight

_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class _Pictures:
    """Pictures in files, a film or memory, and how many there are."""

    label: str
    count: int
    paths: tuple[Path, ...] = ()
    numbers: IntArray | None = None
    held: tuple[Image, ...] = ()


def read_film(
    pictures: str | Path | Sequence[Image],
    times: str | Path | float | Sequence[float] | FloatArray,
    vehicle: str | Path | Vehicle,
    *,
    start_s: float = 0.0,
    camera: str | None = None,
    benchmark_s: float | None = None,
) -> Flight:
    """Read an onboard film that stands alone, without trajectory, epoch and flight.toml.

    Parameters
    ----------
    pictures : path or sequence of (h, w) uint8
        Folder of pictures, a film (.webm, .mp4, .avi), or grey pictures in memory.
    times : path, (n,) float or float
        List of frames (CSV with ``t_s, frame``), the time of each picture in s, or their rate in Hz.
    vehicle : path, str or Vehicle
        Vehicle file, or the name of a shipped vehicle: geometry, joint and camera.
    start_s : float
        Time of the first picture, where ``times`` is a rate.
    camera : str, optional
        Of the vehicle file; needed where that has several.
    benchmark_s : float, optional
        When the shell is taken as undeflected; default: the first picture.

    Returns
    -------
    Flight
        With the film alone, for `estimate_camera` and figures.

    Raises
    ------
    GateError
        With every picture that cannot be used; where times and pictures do not match, or no camera is meant.
    """
    made = vehicle if isinstance(vehicle, Vehicle) else read_vehicle(vehicle)
    name = _camera_name(made, camera)
    mount = made.cameras[name]
    if isinstance(times, str | Path):
        time_s, frames = _listed(Path(times))
        found = _pictures(pictures, frames, mount)
    else:
        found = _pictures(pictures, None, mount)
        time_s = _times(times, start_s, found)
    benchmark_s = float(time_s[0]) if benchmark_s is None else benchmark_s
    if not time_s[0] <= benchmark_s <= time_s[-1]:
        words = f"benchmark_s = {benchmark_s}: the frames span {time_s[0]:.2f} to {time_s[-1]:.2f} s"
        raise GateError(words, "time-not-covered")
    findings: list[Issue] = []
    if found.numbers is not None and (timing := film_timing_fault(found.paths[0])):
        findings.append(Issue(f"{found.label}: {timing}", timing.code, "frames"))
    film = Frames(mount, name, time_s, found.paths, benchmark_s, found.numbers, held=found.held)
    films = {name: reduced(findings, "frames", film)}
    telemetry = Telemetry(
        Path(found.label).stem, "", False, made, None, None, {}, standard_sounding(), None, films,
        findings=tuple(findings),
    )  # fmt: skip
    return Flight(telemetry)


def _camera_name(vehicle: Vehicle, camera: str | None) -> str:
    """Name of the requested camera, or of the only one."""
    names = list(vehicle.cameras)
    if camera in names or (camera is None and len(names) == 1):
        return camera or names[0]
    asked = "which camera?" if camera is None else f"no camera '{camera}'{nearest_name(camera, names)}"
    raise GateError(f"{asked} Vehicle '{vehicle.name}' has: {', '.join(names) or 'none'}", "name-unknown")


def _listed(path: Path) -> tuple[FloatArray, list[str]]:
    """Times (n,) in s and names or numbers of the frames in a list."""
    table, faults = read_table(path, "frames"), list[Issue]()
    no_epoch = datetime(1970, 1, 1, tzinfo=UTC)  # seconds count from a zero of their own
    time_s = times_s(table, TimeColumn(), no_epoch, path, "frames", faults)
    if "frame" not in table.columns:
        hint = nearest_name("frame", table.columns)
        faults.append(Issue(f"frames: {path}: line 1: no column 'frame'{hint}", "column-missing"))
    if faults or time_s is None:
        raise GateError(faults)
    return time_s, table["frame"].astype(str).str.strip().tolist()


def _times(times: float | Sequence[float] | FloatArray, start_s: float, found: _Pictures) -> FloatArray:
    """Time (n,) of every picture, s."""
    given = np.asarray(times, dtype=float)
    if given.ndim == 0:
        if not 0.0 < given < np.inf:
            raise GateError(f"times = {times}: a rate above 0 Hz is wanted, a list, or an array", "value-range")
        return start_s + np.arange(found.count) / float(given)
    given = check_shape(f"times of {found.count} pictures", given, (found.count,))
    check_finite("times", given)
    check_increasing("times", given)
    return given


def _pictures(given: str | Path | Sequence[Image], frames: list[str] | None, mount: CameraMount) -> _Pictures:
    """Pictures by their names or numbers in a list, or all; `GateError` naming those that cannot be used."""
    if not isinstance(given, str | Path):
        return _in_memory(given, mount)
    path = Path(given)
    if not path.is_dir():
        return _of_film(path, frames, mount)
    names = frames or sorted(file.name for file in path.iterdir() if file.suffix.lower() in _ENDINGS)
    wrong = [(name, image_fault(path / name, mount.size_px)) for name in names]
    faults = [Issue(f"{path / name}: {why}", getattr(why, "code", "")) for name, why in wrong if why]
    if faults or not names:
        raise GateError(faults or [Issue(f"{path}: no pictures", "file-missing")])
    return _Pictures(path.name, len(names), tuple(path / name for name in names))


def _of_film(path: Path, frames: list[str] | None, mount: CameraMount) -> _Pictures:
    """Frames of a film, by number."""
    if frames is not None and not all(frame.isdecimal() for frame in frames):
        raise GateError(f"{path}: the list must give numbers of its frames, the first being 0", "frame-missing")
    last = 0 if frames is None else max(map(int, frames))
    if why := film_fault(path, mount.size_px, last):
        raise GateError(f"{path}: {why}", getattr(why, "code", ""))
    numbers = np.arange(len(frame_times_ms(path))) if frames is None else np.array(frames, dtype=np.int64)
    if (np.diff(numbers) < 0).any():
        raise GateError(f"{path}: frame numbers fall where times rise; sort the list by time", "frame-missing")
    return _Pictures(path.name, len(numbers), (path,), numbers)


def _in_memory(given: Sequence[Image], mount: CameraMount) -> _Pictures:
    """Grey pictures (h, w) of eight bits."""
    held = tuple(np.asarray(picture) for picture in given)
    size = mount.size_px[::-1]
    wrong = [f"{k}: {p.dtype} {p.shape}" for k, p in enumerate(held) if p.shape != size or p.dtype != np.uint8]
    if wrong or not held:
        words = f"pictures: grey ones of uint8 {size} are wanted; others are {', '.join(wrong) or 'none'}"
        raise GateError(words, "frame-size")
    return _Pictures("pictures in memory", len(held), held=held)

"""Tables of what flew on board: triads with their mounting, Sun heads, video frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flightmodel import columns
from flightmodel.averaging import averaged
from flightmodel.checks import BoolArray, FloatArray, nearest_name
from flightmodel.film import Frames, doubt_of_film, fault_of_film, fault_of_image
from flightmodel.findings import find_faults
from flightmodel.flightfile import FlightFile
from flightmodel.gate import Gate
from flightmodel.instrument_entries import FramesEntry, MagnetometerEntry, RatesEntry, SunEntry, TriadEntry
from flightmodel.instruments import SunHeads, TriadSpec
from flightmodel.selection import rows_to_use
from flightmodel.telemetry import Finding, SunRecord, TriadRecord
from flightmodel.vehicle import CameraMount, Vehicle

Triad = TriadEntry | RatesEntry | MagnetometerEntry
TRIAD_COLUMNS = {
    TriadEntry: columns.ACCELEROMETER,
    RatesEntry: columns.RATES,
    MagnetometerEntry: columns.MAGNETOMETER,
}
BODY = "body"  # the mount of a triad along body axes
# package of the vehicle file where flight.toml names none
DEFAULT_PACKAGE = {TriadEntry: "suba", RatesEntry: BODY, MagnetometerEntry: "magnetometer"}


def read_triad(gate: Gate, name: str, spec: FlightFile, vehicle: Vehicle | None) -> TriadRecord | None:
    """Read a triad that flight.toml names; None where it names none, or, with the faults kept, where it is refused."""
    source: Triad | None = getattr(spec.sensors, name)
    if source is None:
        return None
    quantities = TRIAD_COLUMNS[type(source)]
    mounting = _mounting(gate, name, source, spec, vehicle)
    table = gate.table(f"sensors.{name}", source, quantities)
    if table is None or table.time_s is None:
        return None
    values = np.column_stack([table.columns[q.short] for q in quantities])
    if not np.isfinite(values).all(axis=1).any():
        gate.faults.append(f"sensors.{name}: {table.path}: every sample is missing")
        return None
    gate.findings.extend(find_faults(name, table.time_s, tuple(q.short for q in quantities), values))
    if mounting is None:
        return None
    if isinstance(source, MagnetometerEntry) and source.reversed:
        values = -values
    record, told = averaged(TriadRecord(_triad_spec(name, source, *mounting), table.time_s, values))
    gate.findings.extend(told)
    return record


def _mounting(
    gate: Gate, name: str, source: Triad, spec: FlightFile, vehicle: Vehicle | None
) -> tuple[FloatArray, FloatArray] | None:
    """Place (3,) and ``dcm_body_sensor`` (3, 3); None, with a fault kept, where no package of that name is known."""
    package = source.mount or DEFAULT_PACKAGE[type(source)]
    if source.axes is not None or package == BODY:
        return source.place_m, source.dcm_body_sensor
    if spec.vehicle is None:
        said = "nothing is said of its mount" if source.mount is None else f"mount = '{package}' is a vehicle's package"
        words = (
            'write mount = "body" (along body axes) or axes = ["+x", "+y", "+z"] with the body axis of each of its axes'
        )
        gate.refuse_config(f"sensors.{name}: {said}, and flight.toml names no vehicle; {words}")
        return None
    if vehicle is None:  # refused already
        return None
    if package not in vehicle.sensors:
        known = [*vehicle.sensors, BODY]
        hint = nearest_name(package, known)
        gate.refuse_config(f"sensors.{name}.mount = '{package}'{hint}: not on vehicle '{vehicle.name}'")
        return None
    mount = vehicle.sensors[package]
    return np.array(mount.position_from_datum_body_m), mount.dcm_body_sensor


def _triad_spec(name: str, source: Triad, place_m: FloatArray, dcm: FloatArray) -> TriadSpec:
    soft_iron = 0.0
    if isinstance(source, RatesEntry):
        in_files = [source.noise_sd_degps, source.bias_sd_degps, source.resolution_degps, source.bias_wander_sd_degps]
        noise, bias, step, wander = np.deg2rad(in_files)
    elif isinstance(source, MagnetometerEntry):
        in_files = [source.noise_sd_ut, source.bias_sd_ut, source.resolution_ut, source.bias_wander_sd_ut]
        noise, bias, step, wander = 1e-6 * np.array(in_files)
        soft_iron = source.soft_iron_sd
    else:
        noise, bias, step = source.noise_sd_mps2, source.bias_sd_mps2, source.resolution_mps2
        wander = source.bias_wander_sd_mps2
    return TriadSpec(
        name,
        place_m,
        dcm,
        float(noise),
        float(bias),
        source.scale_sd,
        float(np.deg2rad(source.mount_sd_deg)),
        float(step),
        soft_iron,
        float(wander),
        source.bias_time_constant_s if wander > 0.0 else np.inf,
        0.0 if isinstance(source, MagnetometerEntry) else source.time_bias_sd_s,
    )


def read_sun(gate: Gate, source: SunEntry) -> SunRecord | None:
    """Read the Sun heads; None, with the faults kept, where anything in the table is refused."""
    heads = len(source.heads_lv_deg)
    quantities = columns.sun_quantities(heads)
    table = gate.table("sensors.sun", source, quantities)
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults)
    for q in quantities:
        # an elevation may pass 90 deg by its noise
        limit = np.pi if q.short.startswith("az") else 0.6 * np.pi
        gate.refuse_rows(table, q.short, -limit, limit, "no angle of a head")
    if len(gate.faults) > before:
        return None
    values = np.column_stack([table.columns[q.short] for q in quantities])
    seen = np.isfinite(values.reshape(-1, heads, 2)).all(axis=2)
    dark = np.asarray(seen.sum(axis=1) == 0)
    if dark.all():
        gate.faults.append(f"sensors.sun: {table.path}: no head ever sees the Sun; remove [sensors.sun]")
        return None
    gate.findings.extend(find_faults("sun", table.time_s, tuple(q.short for q in quantities), values, dark))
    noise, bias, mount, field = np.deg2rad(
        [source.noise_sd_deg, source.bias_sd_deg, source.mount_sd_deg, source.field_deg]
    )
    spec = SunHeads("sun", np.deg2rad(source.heads_lv_deg), field, noise, bias, mount)
    return SunRecord(spec, table.time_s, values.reshape(-1, heads, 2))


def read_frames(gate: Gate, source: FramesEntry, vehicle: Vehicle | None) -> Frames | None:
    """Read the list of frames and check every picture; None, with the faults kept, where anything is refused."""
    label = "frames"
    if source.columns:
        gate.refuse_config("frames.columns: the frame list has only t_s and frame")
    if (source.folder is None) == (source.film is None):
        gate.refuse_config("frames: one of folder (of images) and film (a .webm, .mp4 or .avi file) is wanted")
        return None
    path, images = gate.path(source.file), gate.path(source.film or source.folder or "")
    if vehicle is not None and source.camera not in vehicle.cameras:
        hint = nearest_name(source.camera, list(vehicle.cameras))
        gate.refuse_config(f"frames.camera = '{source.camera}'{hint}: not on vehicle '{vehicle.name}'")
        return None
    if path is None or images is None or vehicle is None:
        return None
    table = gate.csv(path, label)
    if table is None:
        return None
    time_s = columns.times_s(table, source.time_column, gate.t0, path, label, gate.faults)
    if "frame" not in table.columns:
        gate.faults.append(f"{label}: {path}: line 1: no column 'frame'{nearest_name('frame', table.columns)}")
        return None
    camera = vehicle.cameras[source.camera]
    used = np.ones(len(table), dtype=bool)
    if time_s is not None:
        time_s = time_s + source.time.offset_s
        used, findings = rows_to_use(label, source, time_s)
        gate.findings.extend(findings)
        time_s = time_s[used]
    if source.film is None:
        paths, numbers = _image_paths(gate, images, table, used, path, camera), None
    else:
        paths, numbers = (images,), _film_numbers(gate, images, table, used, path, camera)
    if time_s is None:
        return None
    if not len(time_s):
        gate.faults.append(f"{label}: {path}: use_s leaves no frame")
        return None
    if not time_s[0] - 2.0 <= source.benchmark_s <= time_s[-1] + 2.0:
        span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s"
        gate.refuse_config(f"frames.benchmark_s = {source.benchmark_s}: frames span {span}")
        return None
    return Frames(camera, source.camera, time_s, paths, source.benchmark_s, numbers, source.time_bias_sd_s)


def _image_paths(
    gate: Gate, images: Path, table: pd.DataFrame, used: BoolArray, path: Path, camera: CameraMount
) -> tuple[Path, ...]:
    """Path of every frame's image; what is wrong with one becomes a fault."""
    names, paths = table["frame"].astype(str).str.strip(), []
    for row in np.flatnonzero(used).tolist():
        image = images / names.iloc[row]
        wrong = gate.wrong_place(image, names.iloc[row]) or fault_of_image(image, camera)
        if wrong:
            where = f"frames: {path}: line {columns.line_of(table, row)}: {image}"
            gate.faults.append(f"{where}: {wrong}; replace the file or remove the line")
        paths.append(image)
    return tuple(paths)


def _film_numbers(
    gate: Gate, film: Path, table: pd.DataFrame, used: BoolArray, path: Path, camera: CameraMount
) -> NDArray[np.int64]:
    """Number of every frame in the film; what is wrong becomes a fault."""
    text = table["frame"].astype(str).str.strip()
    whole = text.str.fullmatch(r"\d{1,9}").to_numpy(dtype=bool)
    for row in np.flatnonzero(used & ~whole)[:5].tolist():
        where = f"frames: {path}: line {columns.line_of(table, row)}: frame '{text.iloc[row]}'"
        gate.faults.append(f'{where}: with film = "{film.name}" a frame\'s number is wanted, the first being 0')
    numbers = np.array([int(t) for t in text.to_numpy()[used & whole]], dtype=np.int64)
    if len(numbers) and (np.diff(numbers) < 0).any():
        row = int(np.flatnonzero(used & whole)[int(np.argmax(np.diff(numbers) < 0)) + 1])
        where = f"frames: {path}: line {columns.line_of(table, row)}"
        gate.faults.append(f"{where}: frame numbers fall where times rise; sort the list by time")
    wrong = fault_of_film(film, camera, int(numbers.max(initial=0)))
    if wrong:
        gate.faults.append(f"frames: {film}: {wrong}")
        return numbers
    again = int((np.diff(numbers) == 0).sum())
    if again:
        words = f"{path.name}: {again} of {len(numbers)} lines name the same frame as the line before; check the list"
        gate.findings.append(Finding("frames", words, np.nan, np.nan))
    doubt = doubt_of_film(film)
    if doubt:
        gate.findings.append(Finding("frames", f"{film.name}: {doubt}", np.nan, np.nan))
    return numbers

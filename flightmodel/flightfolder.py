"""Reading a flight folder through the gate: files to checked SI arrays, with every fault at once and findings.

Nothing below ``truth/`` is opened here.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np

from flightmodel import columns
from flightmodel.checks import GateError, nearest_name
from flightmodel.config import parse_utc
from flightmodel.findings import find_faults
from flightmodel.flightfile import (
    FlightFile,
    FramesEntry,
    MagnetometerEntry,
    RadarEntry,
    RatesEntry,
    SunEntry,
    TriadEntry,
    read_flight_file,
)
from flightmodel.gate import Gate
from flightmodel.instruments import RadarSite, SunHeads, TriadSpec
from flightmodel.sounding import read_sounding
from flightmodel.telemetry import AttitudePrior, Frames, RadarRecord, SunRecord, Telemetry, TriadRecord
from flightmodel.vehicle import CameraMount, Vehicle, vehicle_from_toml, vehicle_path


def read_flight(folder: Path) -> Telemetry:
    """Read everything measured on one flight.

    Parameters
    ----------
    folder : Path
        Flight folder with ``flight.toml``.

    Raises
    ------
    ConfigError
        For faults of ``flight.toml`` or the vehicle file.
    GateError
        For faults of the data files: all of them, each with file, line or time, and what to do.
    """
    spec = read_flight_file(folder)
    gate = Gate(folder, parse_utc(spec.t0_utc))
    vehicle = _vehicle(gate, spec)
    accelerometer = _triad(gate, "accelerometer", spec.sensors.accelerometer, vehicle)
    rates = _triad(gate, "rates", spec.sensors.rates, vehicle)
    magnetometer = (
        _triad(gate, "magnetometer", spec.sensors.magnetometer, vehicle) if spec.sensors.magnetometer else None
    )
    sun = _sun(gate, spec.sensors.sun) if spec.sensors.sun else None
    radars = {name: _radar(gate, name, entry) for name, entry in spec.radars.items()}
    sounding = read_sounding(gate, spec.atmosphere)
    frames = _frames(gate, spec.frames, vehicle) if spec.frames else None
    gate.close()
    assert vehicle is not None
    assert accelerometer is not None
    assert rates is not None
    assert sounding is not None
    q = np.array(spec.attitude_prior.q_ecef_body)
    prior = AttitudePrior(
        spec.attitude_prior.t_s, q / np.linalg.norm(q), np.full(3, np.deg2rad(spec.attitude_prior.sd_deg))
    )
    telemetry = Telemetry(
        name=spec.name,
        t0_utc=spec.t0_utc,
        synthetic=spec.synthetic,
        vehicle=vehicle,
        accelerometer=accelerometer,
        rates=rates,
        radars={name: record for name, record in radars.items() if record is not None},
        sounding=sounding,
        attitude_prior=prior,
        frames=frames,
        magnetometer=magnetometer,
        sun=sun,
        events=tuple((e.name, e.t_s) for e in spec.events),
        findings=tuple(gate.findings),
        hashes=_hashes(folder, spec, vehicle, frames),
    )
    start, stop = telemetry.span_s()
    if stop - start < 1.0:
        raise GateError(
            f"{folder}: accelerometer, rates and radars have no second in common ({start:.2f} to {stop:.2f} s)"
        )
    return telemetry


def _vehicle(gate: Gate, spec: FlightFile) -> Vehicle | None:
    """Read the vehicle that flight.toml names; None, with faults kept, where it or what it must carry is missing."""
    try:
        vehicle = vehicle_from_toml(vehicle_path(spec.vehicle, gate.folder))
    except GateError as fault:
        for words in fault.faults:
            gate.refuse_config(f"vehicle: {words}")
        return None

    def missing(key: str, name: str, known: list[str]) -> None:
        if name not in known:
            hint = nearest_name(name, known)
            gate.refuse_config(f"{key} = '{name}'{hint}: not on vehicle '{vehicle.name}'")

    missing("sensors.accelerometer.mount", spec.sensors.accelerometer.mount, list(vehicle.sensors))
    if spec.sensors.magnetometer:
        missing("sensors.magnetometer.mount", spec.sensors.magnetometer.mount, list(vehicle.sensors))
    if spec.frames:
        missing("frames.camera", spec.frames.camera, list(vehicle.cameras))
    norm = float(np.linalg.norm(spec.attitude_prior.q_ecef_body))
    if abs(norm - 1.0) > 1e-3:
        gate.refuse_config(f"attitude_prior.q_ecef_body has norm {norm:.4f}, not 1")
    return None if gate.config else vehicle


Triad = TriadEntry | RatesEntry | MagnetometerEntry
TRIAD_COLUMNS = {
    TriadEntry: columns.ACCELEROMETER,
    RatesEntry: columns.RATES,
    MagnetometerEntry: columns.MAGNETOMETER,
}


def _triad(gate: Gate, name: str, source: Triad, vehicle: Vehicle | None) -> TriadRecord | None:
    quantities = TRIAD_COLUMNS[type(source)]
    table = gate.table(f"sensors.{name}", source, quantities)
    if table is None or table.time_s is None:
        return None
    values = np.column_stack([table.columns[q.short] for q in quantities])
    if not np.isfinite(values).all(axis=1).any():
        gate.faults.append(f"sensors.{name}: {table.path}: every sample is missing")
        return None
    gate.findings.extend(find_faults(name, table.time_s, tuple(q.short for q in quantities), values))
    if vehicle is None:
        return None
    return TriadRecord(_triad_spec(name, source, vehicle), table.time_s, values)


def _triad_spec(name: str, source: Triad, vehicle: Vehicle) -> TriadSpec:
    mount_sd = float(np.deg2rad(source.mount_sd_deg))
    if isinstance(source, RatesEntry):
        noise, bias, step = np.deg2rad([source.noise_sd_degps, source.bias_sd_degps, source.resolution_degps])
        return TriadSpec(name, np.zeros(3), np.eye(3), noise, bias, source.scale_sd, mount_sd, step)
    mount = vehicle.sensors[source.mount]
    place, dcm = np.array(mount.position_from_datum_body_m), mount.dcm_body_sensor
    if isinstance(source, MagnetometerEntry):
        noise, bias, step = 1e-6 * np.array([source.noise_sd_ut, source.bias_sd_ut, source.resolution_ut])
        return TriadSpec(name, place, dcm, noise, bias, source.scale_sd, mount_sd, step, source.soft_iron_sd)
    noise, bias, step = source.noise_sd_mps2, source.bias_sd_mps2, source.resolution_mps2
    return TriadSpec(name, place, dcm, noise, bias, source.scale_sd, mount_sd, step)


def _sun(gate: Gate, source: SunEntry) -> SunRecord | None:
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


def _radar(gate: Gate, name: str, source: RadarEntry) -> RadarRecord | None:
    label = f"radars.{name}"
    table = gate.table(label, source, columns.RADAR)
    if table is None or table.time_s is None:
        return None
    before = len(gate.faults)
    gate.refuse_rows(table, "range", 1.0, np.inf, "no slant range")
    gate.refuse_rows(table, "el", -0.5 * np.pi, 0.5 * np.pi, "no elevation")
    if len(gate.faults) > before:
        return None
    azimuth = np.mod(table.columns["az"], 2.0 * np.pi)
    values = np.column_stack([table.columns["range"], azimuth, table.columns["el"]])
    if not np.isfinite(values).all(axis=1).any():
        gate.faults.append(f"{label}: {table.path}: no track point with range, azimuth and elevation; remove the radar")
        return None
    gate.findings.extend(find_faults(name, table.time_s, ("range", "az", "el"), values))
    return RadarRecord(_site(name, source), table.time_s, values, source.tracks)


def _site(name: str, source: RadarEntry) -> RadarSite:
    lat, lon, angle_sd, angle_bias_sd = np.deg2rad(
        [source.latitude_deg, source.longitude_deg, source.angle_sd_deg, source.angle_bias_sd_deg]
    )
    mislevel, droop, skew, square, wander = np.deg2rad(
        [
            source.mislevel_sd_deg,
            source.droop_sd_deg,
            source.skew_sd_deg,
            source.nonorthogonality_sd_deg,
            source.wander_sd_deg,
        ]
    )
    return RadarSite(
        name, lat, lon, source.height_m, source.range_sd_m, angle_sd, source.range_bias_sd_m, angle_bias_sd,
        source.time_bias_sd_s, mislevel, droop, skew, square, wander, source.wander_time_constant_s,
    )  # fmt: skip


def _frames(gate: Gate, source: FramesEntry, vehicle: Vehicle | None) -> Frames | None:
    label = "frames"
    if source.columns:
        gate.refuse_config("frames.columns: the frame list has only t_s and frame")
    path, images = gate.path(source.file), gate.path(source.folder)
    if path is None or images is None or vehicle is None:
        return None
    table = gate.csv(path, label)
    if table is None:
        return None
    time_s = columns.times_s(table, source.time_column, gate.t0, path, label, gate.faults)
    if "frame" not in table.columns:
        gate.faults.append(f"{label}: {path}: line 1: no column 'frame'{nearest_name('frame', table.columns)}")
        return None
    camera, paths = vehicle.cameras[source.camera], []
    for row, name in enumerate(table["frame"].str.strip()):
        image = images / name
        wrong = gate.wrong_place(image, name) or _image_fault(image, camera)
        if wrong:
            where = f"{label}: {path}: line {columns.line_of(table, row)}: {image}"
            gate.faults.append(f"{where}: {wrong}; replace the file or remove the line")
        paths.append(image)
    if time_s is None:
        return None
    if not time_s[0] - 2.0 <= source.benchmark_s <= time_s[-1] + 2.0:
        span = f"{time_s[0]:.2f} to {time_s[-1]:.2f} s"
        gate.refuse_config(f"frames.benchmark_s = {source.benchmark_s}: frames span {span}")
        return None
    return Frames(camera, source.camera, time_s, tuple(paths), source.benchmark_s)


def _image_fault(path: Path, camera: CameraMount) -> str:
    if not path.is_file():
        return "no such file"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        return "cannot be decoded as an image"
    if image.shape != (camera.height_px, camera.width_px):
        return f"is {image.shape[1]} x {image.shape[0]} pixels, the camera {camera.width_px} x {camera.height_px}"
    return ""


def _hashes(folder: Path, spec: FlightFile, vehicle: Vehicle, frames: Frames | None) -> dict[str, str]:
    """SHA-256 of every file that the results depend on; all frames' pictures share one."""
    names = ["flight.toml", spec.sensors.accelerometer.file, spec.sensors.rates.file, spec.atmosphere.file]
    names += [s.file for s in (spec.sensors.magnetometer, spec.sensors.sun) if s is not None]
    names += [r.file for r in spec.radars.values()] + ([spec.frames.file] if spec.frames else [])
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in sorted(set(names))}
    digests[f"vehicle {vehicle.name}"] = hashlib.sha256(vehicle.source.read_bytes()).hexdigest()
    if frames is not None:
        pictures = hashlib.sha256()
        for path in frames.paths:
            pictures.update(path.read_bytes())
        digests["frames' pictures"] = pictures.hexdigest()
    return digests

"""Reading a flight folder through the gate: files to checked SI arrays, with every fault at once and findings.

Nothing below ``truth/`` is opened here.
"""

from __future__ import annotations

import hashlib
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np

from flightmodel import columns
from flightmodel.atmosphere import R_AIR_JPKGK, default_sounding_sd
from flightmodel.checks import BoolArray, ConfigError, FloatArray, GateError, nearest_name
from flightmodel.flightfile import (
    AtmosphereEntry,
    FlightFile,
    FramesEntry,
    RadarEntry,
    RatesEntry,
    Source,
    TriadEntry,
    parse_utc,
    read_flight_file,
)
from flightmodel.instruments import RadarSite, TriadSpec
from flightmodel.telemetry import (
    AttitudePrior,
    Finding,
    Frames,
    RadarRecord,
    Sounding,
    Telemetry,
    TriadRecord,
)
from flightmodel.vehicle import CameraMount, Vehicle, vehicle_from_toml, vehicle_path

GAP_FACTOR = 5.0  # an interval this many times the usual one is a gap
FROZEN_S = 0.5  # all columns unchanged for this long is a frozen run
# no entry vehicle's instruments read beyond these; a larger number is a wrong unit or a broken word
SANE_LIMIT = {"acceleration": 1.0e4, "rate": 400.0, "length": 1.0e8, "angle": 4.0 * np.pi}


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
    t0 = parse_utc(spec.t0_utc)
    vehicle = vehicle_from_toml(vehicle_path(spec.vehicle, folder))
    faults: list[str] = []
    findings: list[Finding] = []
    _check_against_vehicle(spec, vehicle, folder)
    accelerometer = _triad(folder, "accelerometer", spec.sensors.accelerometer, vehicle, t0, faults, findings)
    rates = _triad(folder, "rates", spec.sensors.rates, vehicle, t0, faults, findings)
    radars = {n: _radar(folder, n, r, t0, faults, findings) for n, r in spec.radars.items()}
    sounding = _sounding(folder, spec.atmosphere, faults)
    frames = _frames(folder, spec.frames, vehicle, t0, faults) if spec.frames else None
    q = np.array(spec.attitude_prior.q_ecef_body)
    if abs(np.linalg.norm(q) - 1.0) > 1e-3:
        faults.append(f"{folder / 'flight.toml'}: attitude_prior.q_ecef_body has norm {np.linalg.norm(q):.4f}, not 1")
    known = {n: r for n, r in radars.items() if r is not None}
    if faults or accelerometer is None or rates is None or sounding is None:
        raise GateError(faults)
    telemetry = Telemetry(
        name=spec.name,
        t0_utc=spec.t0_utc,
        synthetic=spec.synthetic,
        vehicle=vehicle,
        accelerometer=accelerometer,
        rates=rates,
        radars=known,
        sounding=sounding,
        attitude_prior=AttitudePrior(
            spec.attitude_prior.t_s, q / np.linalg.norm(q), np.deg2rad(spec.attitude_prior.sd_deg)
        ),
        frames=frames,
        events=tuple((e.name, e.t_s) for e in spec.events),
        findings=tuple(findings),
        hashes=_hashes(folder, spec, vehicle),
    )
    start, stop = telemetry.span_s()
    if stop - start < 1.0:
        raise GateError(
            f"{folder}: accelerometer, rates and radars have no second in common ({start:.2f} to {stop:.2f} s)"
        )
    return telemetry


def _check_against_vehicle(spec: FlightFile, vehicle: Vehicle, folder: Path) -> None:
    faults = []
    mount = spec.sensors.accelerometer.mount
    if mount not in vehicle.sensors:
        faults.append(f"sensors.accelerometer.mount = '{mount}'{nearest_name(mount, vehicle.sensors)}")
    if spec.frames and spec.frames.camera not in vehicle.cameras:
        faults.append(f"frames.camera = '{spec.frames.camera}'{nearest_name(spec.frames.camera, vehicle.cameras)}")
    if faults:
        raise ConfigError([f"{folder / 'flight.toml'}: {f}: not on vehicle '{vehicle.name}'" for f in faults])


def inside(folder: Path, name: str) -> Path:
    """Return ``folder / name``; `GateError` where that leaves the flight folder."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise GateError(f"{folder / 'flight.toml'}: file '{name}' lies outside the flight folder; copy it inside")
    return path


def _table(
    folder: Path,
    label: str,
    source: Source,
    quantities: tuple[columns.Quantity, ...],
    t0: datetime,
    faults: list[str],
    timed: bool = True,
) -> tuple[FloatArray | None, dict[str, FloatArray]]:
    """Times and SI columns of one file; faults are appended, and what could not be read is left out."""
    unknown = [k for k in source.columns if k not in {q.short for q in quantities}]
    for key in unknown:
        hint = nearest_name(key, [q.short for q in quantities])
        faults.append(f"{folder / 'flight.toml'}: {label}.columns.{key}: no such quantity{hint}")
    try:
        path = inside(folder, source.file)
        frame = columns.read_table(path, label)
    except GateError as fault:
        faults.extend(fault.faults)
        return None, {}
    time_s = columns.times_s(frame, source.time_column, t0, path, label, faults) if timed else None
    out = {}
    for quantity in quantities:
        values = columns.column_si(frame, quantity, source.declared(quantity.short), path, label, faults)
        if values is None:
            continue
        limit = SANE_LIMIT.get(quantity.kind, np.inf)
        with np.errstate(invalid="ignore"):
            wild = np.abs(values) > limit
        if wild.any():
            k = int(np.argmax(wild))
            faults.append(
                f"{label}: {path}: line {k + 2}: {quantity.short} = {values[k]:.6g} (SI) is beyond any {quantity.kind} "
                f"of a flight ({int(wild.sum())} such cells); check its unit or leave it empty"
            )
        out[quantity.short] = values
    return time_s, out


def _triad(
    folder: Path,
    label: str,
    source: TriadEntry | RatesEntry,
    vehicle: Vehicle,
    t0: datetime,
    faults: list[str],
    findings: list[Finding],
) -> TriadRecord | None:
    quantities = columns.ACCELEROMETER if isinstance(source, TriadEntry) else columns.RATES
    time_s, table = _table(folder, f"sensors.{label}", source, quantities, t0, faults)
    if time_s is None or len(table) < 3:
        return None
    values = np.column_stack([table[q.short] for q in quantities])
    if not np.isfinite(values).all(axis=1).any():
        faults.append(f"sensors.{label}: {source.file}: every sample is missing")
        return None
    findings.extend(find_faults(label, time_s, values))
    if isinstance(source, TriadEntry):
        mount = vehicle.sensors[source.mount]
        spec = TriadSpec(
            label,
            np.array(mount.position_from_datum_body_m),
            mount.dcm_body_sensor,
            source.noise_sd_mps2,
            source.bias_sd_mps2,
            source.scale_sd,
            np.deg2rad(source.mount_sd_deg),
            source.resolution_mps2,
        )
    else:
        noise, bias, mount_sd, step = np.deg2rad(
            [source.noise_sd_degps, source.bias_sd_degps, source.mount_sd_deg, source.resolution_degps]
        )
        spec = TriadSpec(label, np.zeros(3), np.eye(3), noise, bias, source.scale_sd, mount_sd, step)
    return TriadRecord(spec, time_s, values)


def _radar(
    folder: Path, name: str, source: RadarEntry, t0: datetime, faults: list[str], findings: list[Finding]
) -> RadarRecord | None:
    label = f"radars.{name}"
    time_s, table = _table(folder, label, source, columns.RADAR, t0, faults)
    if time_s is None or len(table) < 3:
        return None
    values = np.column_stack([table["range"], np.mod(table["az"], 2.0 * np.pi), table["el"]])
    if not np.isfinite(values).all(axis=1).any():
        faults.append(f"{label}: {source.file}: no track point with range, azimuth and elevation; remove the radar")
        return None
    findings.extend(find_faults(label, time_s, values))
    lat, lon = np.deg2rad([source.latitude_deg, source.longitude_deg])
    angle_sd, angle_bias_sd = np.deg2rad([source.angle_sd_deg, source.angle_bias_sd_deg])
    site = RadarSite(
        name, lat, lon, source.height_m, source.range_sd_m, angle_sd, source.range_bias_sd_m, angle_bias_sd,
        source.time_bias_sd_s,
    )  # fmt: skip
    return RadarRecord(site, time_s, values, source.tracks)


def _sounding(folder: Path, source: AtmosphereEntry, faults: list[str]) -> Sounding | None:
    before = len(faults)
    _, table = _table(folder, "atmosphere", source, columns.ATMOSPHERE, datetime.min, faults, timed=False)
    if len(faults) > before:
        return None
    if {"wind_north", "wind_east"} <= set(table):
        north, east = table["wind_north"], table["wind_east"]
    elif {"wind_speed", "wind_from"} <= set(table):
        # a meteorological wind is named after where it comes from; the air goes the other way
        north = -table["wind_speed"] * np.cos(table["wind_from"])
        east = -table["wind_speed"] * np.sin(table["wind_from"])
    else:
        faults.append(f"atmosphere: {source.file}: needs wind_n_mps and wind_e_mps, or wind speed and direction from")
        return None
    keep = np.isfinite(table["alt"] + table["rho"] + table["temperature"] + north + east)
    order = np.argsort(table["alt"][keep], kind="stable")
    alt, rho, temperature, north, east = (
        v[keep][order] for v in (table["alt"], table["rho"], table["temperature"], north, east)
    )
    for words, wrong in (
        ("fewer than two complete rows", len(alt) < 2),
        ("an altitude twice", bool((np.diff(alt) <= 0).any())),
        ("a density that is not positive", bool((rho <= 0).any())),
        ("a temperature outside 80 to 400 K", bool(((temperature < 80) | (temperature > 400)).any())),
        ("a wind above 300 m/s", bool((np.hypot(north, east) > 300).any())),
        ("altitudes outside -1 to 200 km", bool(((alt < -1e3) | (alt > 2e5)).any())),
    ):
        if wrong:
            faults.append(f"atmosphere: {source.file}: holds {words}")
    if len(faults) > before:
        return None
    density_sd, wind_sd = default_sounding_sd(alt)
    for key, default in (("rho_sd", density_sd), ("wind_sd", wind_sd)):
        if key in table:
            given = table[key][keep][order]
            default[np.isfinite(given)] = given[np.isfinite(given)]
    pressure = rho * R_AIR_JPKGK * temperature
    return Sounding(alt, rho, temperature, pressure, north, east, density_sd, wind_sd)


def _frames(folder: Path, source: FramesEntry, vehicle: Vehicle, t0: datetime, faults: list[str]) -> Frames | None:
    label = "frames"
    try:
        path = inside(folder, source.file)
        images = inside(folder, source.folder)
        table = columns.read_table(path, label)
    except GateError as fault:
        faults.extend(fault.faults)
        return None
    time_s = columns.times_s(table, source.time_column, t0, path, label, faults)
    if "frame" not in table.columns:
        faults.append(f"{label}: {path}: line 1: no column 'frame'{nearest_name('frame', table.columns)}")
        return None
    paths = []
    for line, name in enumerate(table["frame"], start=2):
        try:
            image = inside(images, name.strip())
        except GateError as fault:
            faults.extend(fault.faults)
            continue
        wrong = _image_fault(image, vehicle.cameras[source.camera])
        if wrong:
            faults.append(f"{label}: {path}: line {line}: {image}: {wrong}; replace the file or remove the line")
        paths.append(image)
    if time_s is None:
        return None
    return Frames(vehicle.cameras[source.camera], source.camera, time_s, tuple(paths), source.benchmark_s)


def _image_fault(path: Path, camera: CameraMount) -> str:
    if not path.is_file():
        return "no such file"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        return "cannot be decoded as an image"
    if image.shape != (camera.height_px, camera.width_px):
        return f"is {image.shape[1]} x {image.shape[0]} pixels, the camera {camera.width_px} x {camera.height_px}"
    return ""


def find_faults(source: str, time_s: FloatArray, values: FloatArray) -> list[Finding]:
    """Gaps, missing runs and frozen runs of one sensor, with their times."""
    found = []
    step = np.diff(time_s)
    usual = float(np.median(step))
    for k in np.flatnonzero(step > GAP_FACTOR * usual):
        found.append(Finding(source, f"gap of {step[k]:.3f} s", float(time_s[k]), float(time_s[k + 1])))
    missing = ~np.isfinite(values).all(axis=1)
    for first, last in _runs(np.asarray(missing)):
        found.append(Finding(source, f"{last - first + 1} samples missing", float(time_s[first]), float(time_s[last])))
    with np.errstate(invalid="ignore"):
        same = np.append(False, (np.diff(values, axis=0) == 0.0).all(axis=1))
    for first, last in _runs(np.asarray(same)):
        if time_s[last] - time_s[first - 1] >= FROZEN_S:
            words = f"frozen for {last - first + 2} samples"
            found.append(Finding(source, words, float(time_s[first - 1]), float(time_s[last])))
    return found


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _hashes(folder: Path, spec: FlightFile, vehicle: Vehicle) -> dict[str, str]:
    """SHA-256 of every file that the results depend on."""
    names = ["flight.toml", spec.sensors.accelerometer.file, spec.sensors.rates.file, spec.atmosphere.file]
    names += [r.file for r in spec.radars.values()] + ([spec.frames.file] if spec.frames else [])
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in sorted(set(names))}
    digests[f"vehicle {vehicle.name}"] = hashlib.sha256(vehicle.source.read_bytes()).hexdigest()
    return digests

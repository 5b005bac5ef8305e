"""Reading a flight folder through the gate: files to checked SI arrays, with every fault at once and findings.

Nothing below ``truth/`` is opened here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from flightmodel.atmosphere import standard_sounding
from flightmodel.checks import Fault, FloatArray, GateError
from flightmodel.config import parse_utc
from flightmodel.earth import ecef_from_radar, geodetic_from_ecef, q_ecef_body_from_pointing
from flightmodel.film import Frames
from flightmodel.flightfile import AttitudeEntry, FlightFile, MotionEntry, read_flight_file
from flightmodel.gate import Gate
from flightmodel.sensor_tables import (
    read_barometer,
    read_frames,
    read_gnss,
    read_radar,
    read_sounding,
    read_sun,
    read_triad,
)
from flightmodel.telemetry import (
    AttitudePrior,
    BarometerRecord,
    Finding,
    GnssRecord,
    Motion,
    RadarRecord,
    Sounding,
    SunRecord,
    Telemetry,
    TriadRecord,
    UnmodelledSpan,
)
from flightmodel.vehicle import Vehicle, vehicle_from_toml, vehicle_path

LEAST_SPAN_S = 1.0
Record = TypeVar("Record")


@dataclass(frozen=True)
class Sources:
    """What could be read of a flight folder; what could not is among the faults of its ``gate``."""

    gate: Gate
    spec: FlightFile
    vehicle: Vehicle | None
    triads: dict[str, TriadRecord]
    sun: SunRecord | None
    radars: dict[str, RadarRecord]
    gnss: dict[str, GnssRecord]
    barometers: dict[str, BarometerRecord]
    sounding: Sounding | None
    frames: Frames | None
    attitude_prior: AttitudePrior | None


def read_sources(folder: Path, progress: Callable[[float], None] | None = None, needs_path: bool = True) -> Sources:
    """Read every table of a flight that can be read; faults and findings are kept in the gate.

    Parameters
    ----------
    folder : Path
        Flight folder with ``flight.toml``.
    progress : callable, optional
        Called with the fraction of the large tables that is read.
    needs_path : bool
        Whether a folder without radar and receiver is refused even where it has a film.

    Raises
    ------
    ConfigError
        For faults of ``flight.toml`` itself.
    """
    spec = read_flight_file(folder)
    gate = Gate(folder, parse_utc(spec.t0_utc))
    if progress is not None:
        gate.progress = _share_of(folder, spec, progress)
    for misfit in spec.misfits(needs_path):
        gate.refuse_config(misfit)
    vehicle = _vehicle(gate, spec.vehicle) if spec.vehicle is not None else None
    triads = {name: read_triad(gate, name, spec, vehicle) for name in ("accelerometer", "rates", "magnetometer")}
    sun = read_sun(gate, spec.sensors.sun) if spec.sensors.sun else None
    radars = _there({name: read_radar(gate, name, entry) for name, entry in spec.radars.items()})
    gnss = _there({name: read_gnss(gate, name, entry) for name, entry in spec.gnss.items()})
    sounding = _sounding(gate, spec)
    if spec.motion.model == "ballistic" and triads["accelerometer"] is not None and triads["rates"] is not None:
        words = (
            'accelerometer and rates are there, but with model = "ballistic" gravitation and drag carry the flight: '
            "they are not used for its path and attitude; take [motion] out unless that is meant"
        )
        gate.findings.append(Finding("motion", words, np.nan, np.nan, code="inertial-unused"))
    measured = spec.atmosphere is not None
    barometers = {
        name: read_barometer(gate, name, entry, sounding, measured) for name, entry in spec.barometers.items()
    }
    frames = read_frames(gate, spec.frames, vehicle) if spec.frames else None
    prior = _attitude_prior(gate, spec.attitude_prior, radars, gnss) if spec.attitude_prior else None
    return Sources(gate, spec, vehicle, _there(triads), sun, radars, gnss, _there(barometers), sounding, frames, prior)


def read_flight(folder: Path, progress: Callable[[float], None] | None = None, needs_path: bool = True) -> Telemetry:
    """Read everything measured on one flight.

    Parameters
    ----------
    folder : Path
        Flight folder with ``flight.toml``.
    progress : callable, optional
        Called with the fraction of the large tables that is read.
    needs_path : bool
        Whether a folder without radar and receiver is refused even where it has a film.

    Raises
    ------
    ConfigError
        For faults of ``flight.toml`` or the vehicle file.
    GateError
        For faults of the data files: all of them, each with file, line or time, and what to do.
    """
    found = read_sources(folder, progress, needs_path)
    gate, spec = found.gate, found.spec
    gate.close()
    assert found.sounding is not None
    telemetry = Telemetry(
        name=spec.name,
        t0_utc=spec.t0_utc,
        synthetic=spec.synthetic,
        vehicle=found.vehicle,
        accelerometer=found.triads.get("accelerometer"),
        rates=found.triads.get("rates"),
        radars=found.radars,
        sounding=found.sounding,
        attitude_prior=found.attitude_prior,
        frames=found.frames,
        magnetometer=found.triads.get("magnetometer"),
        sun=found.sun,
        events=tuple((e.name, e.t_s) for e in spec.events),
        findings=tuple(gate.findings),
        hashes=_hashes(gate, spec, found.vehicle, found.frames),
        gnss=found.gnss,
        barometers=found.barometers,
        motion=_motion(spec.motion),
        reconstruction=dict(spec.reconstruction),
    )
    if not found.radars and not found.gnss:
        return telemetry
    start, stop = telemetry.span_s()
    if stop - start < LEAST_SPAN_S:
        who = "accelerometer, rates and" if telemetry.accelerometer is not None else "the flight's"
        trackers = " and ".join(kind for kind, some in (("radars", found.radars), ("receivers", found.gnss)) if some)
        raise GateError(
            f"{folder}: {who} {trackers} have no second in common ({start:.2f} to {stop:.2f} s)", code="no-common-time"
        )
    return telemetry


def _share_of(folder: Path, spec: FlightFile, progress: Callable[[float], None]) -> Callable[[int], None]:
    """Turn bytes that were read more into the part of all tables' bytes."""
    paths = [folder / source.file for source in spec.sources]
    total, done = sum(path.stat().st_size for path in paths if path.is_file()), 0

    def more_read(more: int) -> None:
        nonlocal done
        done += more
        progress(min(1.0, done / total))

    return more_read


def _there(records: dict[str, Record | None]) -> dict[str, Record]:
    """Those that could be read."""
    return {name: record for name, record in records.items() if record is not None}


def _vehicle(gate: Gate, name: str) -> Vehicle | None:
    """Read the vehicle that flight.toml names; None, with its faults kept, where it is refused."""
    try:
        vehicle = vehicle_from_toml(vehicle_path(name, gate.folder))
    except GateError as fault:
        for each in fault.faults:
            gate.refuse_config(Fault(f"vehicle: {each}", each.code))
        return None
    for body, mesh in vehicle.meshes.items():
        words = f"{mesh.words}; it is drawn, while the camera's fit is of [geometry]"
        code = "mesh-apart" if mesh.apart else "mesh-drawn"
        gate.findings.append(Finding(f"mesh of the {body}", words, np.nan, np.nan, code))
    return vehicle


def _sounding(gate: Gate, spec: FlightFile) -> Sounding | None:
    """Read the day's air; the standard's, with a finding, where flight.toml names no table."""
    if spec.atmosphere is not None:
        return read_sounding(gate, spec.atmosphere)
    words = (
        "no [atmosphere]: the US Standard Atmosphere 1976 without wind stands for it, density to 10 %, wind to 15 m/s"
    )
    gate.findings.append(Finding("atmosphere", words, np.nan, np.nan, code="no-sounding"))
    return standard_sounding()


def _attitude_prior(
    gate: Gate, entry: AttitudeEntry, radars: dict[str, RadarRecord], gnss: dict[str, GnssRecord]
) -> AttitudePrior | None:
    """Attitude to start from; None, with a fault kept, where no place is known for it."""
    sd = np.deg2rad(entry.sd_deg)
    if entry.q_ecef_body is not None:
        q = np.array(entry.q_ecef_body)
        norm = float(np.linalg.norm(q))
        if abs(norm - 1.0) > 1e-3:
            gate.refuse_config(f"attitude_prior.q_ecef_body has norm {norm:.4f}, not 1", "quaternion-norm")
            return None
        return AttitudePrior(entry.t_s, q / norm, sd)
    if entry.latitude_deg is not None and entry.longitude_deg is not None:
        latitude, longitude = np.deg2rad([entry.latitude_deg, entry.longitude_deg])
    else:
        place = _first_place(radars, gnss)
        if place is None:  # its table was refused
            return None
        latitude, longitude = place
    assert entry.azimuth_deg is not None
    assert entry.elevation_deg is not None
    assert entry.roll_deg is not None
    azimuth, elevation, roll = np.deg2rad([entry.azimuth_deg, entry.elevation_deg, entry.roll_deg])
    q = q_ecef_body_from_pointing(azimuth, elevation, roll, float(latitude), float(longitude))
    return AttitudePrior(entry.t_s, q, sd)


def _first_place(radars: dict[str, RadarRecord], gnss: dict[str, GnssRecord]) -> tuple[float, float] | None:
    """Latitude and longitude, rad, of the first receiver's first fix, or of the first radar's first point."""
    points: list[FloatArray] = [r.position_ecef_m for r in gnss.values()]
    for radar in radars.values():
        s = radar.site
        points.append(ecef_from_radar(radar.range_az_el, s.latitude_rad, s.longitude_rad, s.height_m))
    if not points:
        return None
    whole = points[0][np.isfinite(points[0]).all(axis=1)]
    latitude, longitude, _ = geodetic_from_ecef(whole[0])
    return float(latitude), float(longitude)


def _motion(entry: MotionEntry) -> Motion:
    return Motion(
        model=entry.model,
        drag_area_per_mass_m2pkg=entry.drag_area_per_mass_m2pkg or 0.0,
        drag_sd=entry.drag_sd,
        drag_time_constant_s=entry.drag_time_constant_s,
        side_sd=entry.side_sd,
        acceleration_density=entry.acceleration_density,
        powered_s=entry.powered_s or (),
        powered_sd_mps2=entry.powered_sd_mps2,
        disturbed=tuple(
            UnmodelledSpan(d.from_s, d.to_s, d.sd_mps2, float(np.deg2rad(d.sd_degps))) for d in entry.disturbed
        ),
    )


def _hashes(gate: Gate, spec: FlightFile, vehicle: Vehicle | None, frames: Frames | None) -> dict[str, str]:
    """SHA-256 of every file that the results depend on; all frames' pictures share one."""
    names = {"flight.toml", *(source.file for source in spec.sources)}
    digests = {name: gate.sha256(gate.folder / name) for name in sorted(names)}
    if vehicle is not None:
        digests[f"vehicle {vehicle.name}"] = hashlib.sha256(vehicle.source.read_bytes()).hexdigest()
        for name in vehicle.files:
            digests[f"vehicle's {name}"] = hashlib.sha256((vehicle.source.parent / name).read_bytes()).hexdigest()
    if frames is not None:
        pictures = hashlib.sha256()
        for path in frames.paths:
            pictures.update(path.read_bytes())
        digests["frames' pictures"] = pictures.hexdigest()
    return digests

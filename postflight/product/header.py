"""What the numbers of a trajectory product refer to: epoch, frames, vehicle, air, sensors, settings, version."""

from __future__ import annotations

from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np

from postflight.pipeline import Flight

FORMAT = 1
FRAMES = {
    "eci": "equal to ECEF at time zero (epoch_utc), then fixed in space",
    "ecef": "WGS-84, Earth-fixed; velocities relative to the rotating Earth",
    "ned": "north, east, down at the vehicle, geodetic",
    "body": "of the centerbody: x forward out of the nose; datum is the nose",
    "rotation": "q_ecef_body is scalar first and takes body components to ECEF; Euler 3-2-1 from NED: yaw about down, "
    "then pitch, then roll; small rotations are right-hand vectors in body axes",
    "rates": "p, q, r: of the body relative to inertial space, body components",
    "flow": "with (u, v, w) the velocity relative to the air in body axes: alpha = atan2(w, u), beta = asin(v / V), "
    "total alpha = atan2(hypot(v, w), u); clock: LV clocking angle of (v, w)",
    "wind": "where the air goes",
    "force": "specific force in body axes; C_A along -x, C_N the size of the lateral force, reference area below",
}


def header(flight: Flight) -> dict[str, Any]:
    """Head of ``bet.csv`` for ``bet_header.json``; nothing in it depends on when or where it was made."""
    telemetry, bet = flight.telemetry, flight.reconstruction
    settings = bet.provenance["settings"]
    return {
        "format": FORMAT,
        "postflight": version("postflight"),
        "flight": telemetry.name,
        "synthetic": telemetry.synthetic,
        "epoch_utc": telemetry.t0_utc,
        "start_s": bet.provenance["start_s"],
        "end_s": bet.provenance["end_s"],
        "point": "datum (the nose); air data and flow angles at the c.g.",
        "motion": bet.provenance["motion"],
        "frames": FRAMES,
        "standard_deviations": "1 sd, of the smoothed trajectory and, in air data, of the sounding",
        "vehicle": _vehicle(flight),
        "atmosphere": _atmosphere(flight),
        "sensors": _sensors(flight),
        "settings": settings,
        "inputs_sha256": telemetry.hashes,
        "missing": list(flight.missing),
    }


def _vehicle(flight: Flight) -> dict[str, Any] | None:
    vehicle = flight.telemetry.vehicle
    if vehicle is None:
        return None
    return {
        "name": vehicle.name,
        "reference_area_m2": vehicle.reference.area_m2,
        "reference_length_m": vehicle.reference.length_m,
        "mass_kg": vehicle.mass_kg,
        "cg_from_datum_body_m": [float(x) for x in vehicle.cg_m],
        "inertia_about_cg_kgm2": [[float(x) for x in row] for row in vehicle.inertia],
        "uncertainty": vehicle.uncertainty.model_dump(),
    }


def _atmosphere(flight: Flight) -> dict[str, Any]:
    sounding = flight.telemetry.sounding
    files = [name for name in flight.telemetry.hashes if "atmosphere" in name or "sounding" in name]
    return {
        "file": files[0] if files else None,
        "lowest_m": float(sounding.altitude_m[0]),
        "highest_m": float(sounding.altitude_m[-1]),
        "density_sd": [float(np.min(sounding.density_sd)), float(np.max(sounding.density_sd))],
        "wind_sd_mps": [float(np.min(sounding.wind_sd_mps)), float(np.max(sounding.wind_sd_mps))],
        "columns": "rho, p, t, mach, winds, alpha: the sounding's air; density_ratio: what the deceleration adds to it",
    }


def _sensors(flight: Flight) -> list[dict[str, Any]]:
    """Every sensor with its stated accuracies, SI units and radians."""
    telemetry = flight.telemetry
    out: list[dict[str, Any]] = []
    for record in (telemetry.accelerometer, telemetry.rates, telemetry.magnetometer):
        if record is not None:
            out.append({"samples": len(record.time_s), **_plain(asdict(record.spec))})
    if telemetry.sun is not None:
        out.append({"samples": len(telemetry.sun.time_s), **_plain(asdict(telemetry.sun.spec))})
    for radar in telemetry.radars.values():
        out.append({"samples": len(radar.time_s), "tracks": radar.point, **_plain(asdict(radar.site))})
    for fixes in telemetry.gnss.values():
        out.append({"samples": len(fixes.time_s), **_plain(asdict(fixes.spec))})
    for heights in telemetry.barometers.values():
        out.append({"samples": len(heights.time_s), **_plain(asdict(heights.spec))})
    return out


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value

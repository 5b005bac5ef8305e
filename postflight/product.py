"""What stands beside the trajectory of a run? Its header, events and peaks, residual statistics, covariances.

``bet_header.json`` states what the numbers refer to (epoch, frames, vehicle, atmosphere, sensors, settings, version);
events and peaks are read from the trajectory's table, residual statistics and covariances from the reconstruction.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import events
from flightmodel.checks import FloatArray
from postflight.reconstruction import Reconstruction

_FORMAT = 1
_COVARIANCE_RATE_HZ = 1.0
_FRAMES = {
    "eci": "equal to ECEF at time zero (epoch_utc), then fixed in space",
    "ecef": "WGS-84, Earth-fixed; velocities relative to the rotating Earth",
    "ned": "north, east, down at the vehicle, geodetic",
    "body": "of the centerbody: x forward out of the nose; datum is the nose",
    "rotation": "q_ecef_body is scalar first and takes body components to ECEF; Euler 3-2-1 from NED: yaw about down, "
    "then pitch, then roll; small rotations are right-hand vectors in body axes",
    "rates": "p, q, r: of the body relative to inertial space, body components",
    "flow": "with (u, v, w) the velocity relative to the air in body axes: alpha = atan2(w, u), beta = asin(v / V), "
    "total alpha = atan2(hypot(v, w), u); clock: LV clocking angle of (v, w)",
    "wind": "velocity of the air mass, north and east",
    "force": "specific force in body axes; C_A along -x, C_N the size of the normal force, reference area below",
}
_STATISTICS = ("source", "component", "unit", "count", "edited", "mean", "sd", "rms_normalised", "lag1", "nis")
# peak of the size of which column of bet.csv, and the column of its standard deviation
_PEAKS = {
    "dynamic pressure": ("dynamic_pressure_pa", "dynamic_pressure_sd_pa"),
    "Mach number": ("mach", "mach_sd"),
    "airspeed": ("airspeed_mps", "airspeed_sd_mps"),
    "axial deceleration": ("ax_cg_mps2", "ax_cg_sd_mps2"),
    "total angle of attack in the pulse": ("alpha_total_wind_deg", "alpha_total_wind_sd_deg"),
    "altitude": ("alt_m", "alt_sd_m"),
}
_EVENT_COLUMNS = {
    "alt_m": "alt_sd_m",
    "speed_ground_mps": "speed_ground_sd_mps",
    "flight_path_deg": "flight_path_sd_deg",
    "mach": "mach_sd",
    "dynamic_pressure_pa": "dynamic_pressure_sd_pa",
    "alpha_total_wind_deg": "alpha_total_wind_sd_deg",
}


def header(flight: Reconstruction) -> dict[str, Any]:
    """Head of ``bet.csv`` for ``bet_header.json``; nothing in it depends on when or where it was made."""
    telemetry, bet = flight.telemetry, flight.solution
    settings = bet.provenance["settings"]
    return {
        "format": _FORMAT,
        "postflight": version("postflight"),
        "flight": telemetry.name,
        "synthetic": telemetry.synthetic,
        "epoch_utc": telemetry.t0_utc,
        "start_s": bet.provenance["start_s"],
        "end_s": bet.provenance["end_s"],
        "point": "datum (the nose); air data and flow angles at the c.g.",
        "motion": bet.provenance["motion"],
        "frames": _FRAMES,
        "standard_deviations": "1 sd, of the smoothed trajectory and, in air data, of the sounding",
        "vehicle": _vehicle(flight),
        "atmosphere": _atmosphere(flight),
        "sensors": _sensors(flight),
        "settings": settings,
        "inputs_sha256": telemetry.hashes,
        "missing": list(flight.missing),
    }


def _vehicle(flight: Reconstruction) -> dict[str, Any] | None:
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


def _atmosphere(flight: Reconstruction) -> dict[str, Any]:
    sounding = flight.telemetry.sounding
    files = [name for name in flight.telemetry.hashes if "atmosphere" in name or "sounding" in name]
    return {
        "file": files[0] if files else None,
        "lowest_m": float(sounding.altitude_m[0]),
        "highest_m": float(sounding.altitude_m[-1]),
        "density_sd": [float(np.min(sounding.density_sd)), float(np.max(sounding.density_sd))],
        "wind_sd_mps": [float(np.min(sounding.wind_sd_mps)), float(np.max(sounding.wind_sd_mps))],
        "columns": "rho, p, t, mach, winds, alpha: with the sounding's air; density_ratio: as-flown density over the "
        "sounding's",
    }


def _sensors(flight: Reconstruction) -> list[dict[str, Any]]:
    """Every sensor with its stated accuracies, SI units and radians."""
    has = flight.telemetry
    onboard = [r for r in (has.accelerometer, has.rates, has.magnetometer, has.sun) if r is not None]
    out = [{"samples": len(r.time_s), **_plain(asdict(r.spec))} for r in onboard]
    out += [{"samples": len(r.time_s), "tracks": r.point, **_plain(asdict(r.site))} for r in has.radars.values()]
    return out + [
        {"samples": len(r.time_s), **_plain(asdict(r.spec))}
        for records in (has.gnss, has.barometers)
        for r in records.values()
    ]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def event_table(flight: Reconstruction, table: pd.DataFrame) -> pd.DataFrame:
    """Events with the values of ``bet.csv`` there; the ``_3sd_`` columns hold three standard deviations."""
    air = flight.air
    named = [(name, t) for name, t in flight.telemetry.events if air.time_s[0] <= t <= air.time_s[-1]]
    peak = "peak dynamic pressure" if flight.peak_is_inside else "largest dynamic pressure (edge of data)"
    named.append((peak, flight.peak_s))
    named += events.descent_events(air.time_s, air.altitude_m, air.mach)
    rows = []
    for name, t in sorted(named, key=lambda event: event[1]):
        row: dict[str, object] = {"event": name, "t_s": t}
        for column, sd_column in _EVENT_COLUMNS.items():
            row[column], sd = value_and_sd(table, column, sd_column, t)
            row[_three_sd(column)] = 3.0 * sd
        rows.append(row)
    names = [c for column in _EVENT_COLUMNS for c in (column, _three_sd(column))]
    return pd.DataFrame(rows, columns=["event", "t_s", *names])


def value_and_sd(table: pd.DataFrame, column: str, sd_column: str, at_s: float) -> tuple[float, float]:
    """Value of a column of ``bet.csv`` at a time, and its standard deviation, in the column's unit."""
    time_s, values, sd = (table[name].to_numpy(dtype=float) for name in ("t_s", column, sd_column))
    value = events.value_at(time_s, values, at_s)
    # a cubic through a touch of zero may pass below it
    return max(value, 0.0) if values.min() >= 0.0 else value, float(np.interp(at_s, time_s, sd))


def _three_sd(column: str) -> str:
    """``alt_m`` to ``alt_3sd_m``."""
    stem, _, unit = column.rpartition("_")
    return f"{stem}_3sd_{unit}" if stem else f"{column}_3sd"


def peak_table(flight: Reconstruction, table: pd.DataFrame) -> pd.DataFrame:
    """Peak values with times and standard deviations; ``inside`` is false where one lies at an end of the data."""
    q = table["dynamic_pressure_pa"].to_numpy()
    pulse, time_s = q >= 0.5 * q.max(), table["t_s"].to_numpy()
    rows = []
    for name, (column, sd_column) in _PEAKS.items():
        size = np.abs(table[column].to_numpy(dtype=float))
        use = np.isfinite(size) & (pulse if "pulse" in name else size > -1.0)
        if name in ("Mach number", "airspeed"):
            use &= flight.air.altitude_m < events.HIGHEST_M
        if not use.any():
            continue
        k = int(np.flatnonzero(use)[np.argmax(size[use])])
        inside = 0 < k < len(size) - 1 and bool(use[k - 1] and use[k + 1])
        first = int(np.clip(k - 1, 0, len(size) - 3))
        near = slice(first, first + 3)
        at = events.find_peak(time_s[near], size[near])[0] if use[near].all() else time_s[k]
        rows.append((name, column, at, *value_and_sd(table, column, sd_column, at), inside))
    return pd.DataFrame(rows, columns=["peak", "column", "t_s", "value", "sd", "inside"])


def residual_statistics(flight: Reconstruction) -> pd.DataFrame:
    """Statistics of the residuals of each source and component; edited points are in ``count`` and ``edited`` alone.

    Mean and sd are in metres and radians (m/s for velocities); ``rms_normalised`` is over the predicted sd and should
    be one; ``lag1``, the autocorrelation of successive residuals, should be zero; ``nis`` is the source's own.
    """
    checks = flight.solution.consistency_checks
    nis = {check.name.removeprefix("NIS "): check.value for check in checks if check.code == "nis"}
    rows = []
    for (source, component), part in flight.solution.residuals.groupby(["source", "component"], sort=False):
        good = part[part["accepted"]]
        r, z = good["residual"].to_numpy(), (good["residual"] / good["predicted_sd"]).to_numpy()
        unit = "rad" if component in ("azimuth", "elevation") else "m"
        unit = "m/s" if "velocity" in f"{source} {component}" else unit
        values = (np.nan,) * 4
        if len(r) > 2:
            values = (float(r.mean()), float(r.std(ddof=1)), float(np.sqrt((z**2).mean())), _lag1(z))
        edited = len(part) - len(good)
        rows.append((source, component, unit, len(part), edited, *values, nis.get(source, np.nan)))
    return pd.DataFrame(rows, columns=list(_STATISTICS))


def _lag1(z: FloatArray) -> float:
    centred = z - z.mean()
    return float(centred[1:] @ centred[:-1] / max(float(centred @ centred), 1e-300))


def slow_covariance(flight: Reconstruction) -> dict[str, FloatArray]:
    """Whole covariances (k, 9, 9) at `_COVARIANCE_RATE_HZ`: position ECEF m, velocity ECEF m/s, rotation body rad."""
    bet = flight.solution.smoothed
    assert bet.covariance is not None
    ticks = np.floor(bet.time_s * _COVARIANCE_RATE_HZ + 1e-6)
    rows = np.flatnonzero(np.diff(ticks, prepend=-np.inf) > 0.0)
    return {"t_s": bet.time_s[rows], "covariance": bet.covariance[rows]}

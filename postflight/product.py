"""What is known of the trajectory, column by column? The best-estimated trajectory and the tables beside it.

``bet.csv`` has every column an analyst asks for, each with its standard deviation; ``bet_header.json`` states what the
numbers refer to (epoch, frames, vehicle, atmosphere, sensors, settings, version); events and peak values are read from
the table, residual statistics and covariances from the reconstruction. What a flight cannot have (attitude in ballistic
flight, sensors in a telemetry gap, force coefficients where the dynamic pressure is too low) is an empty cell.

A coefficient is ``C = m a / (q S)``, and its standard deviation carries those of the specific force, of dynamic
pressure and of the mass; all are one standard deviation. Columns, units and frames: docs/bet-product.md.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np
import pandas as pd

from flightmodel import earth, events, rotations
from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import FloatArray
from postflight.kinematics import derived_with_sd, is_angle
from postflight.reconstruction import Reconstruction
from recon.atmosphere import LEAST_AXIAL_MPS2, cg_accelerations, windows_are_whole

Columns = dict[str, FloatArray]
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
# quantity of `kinematics.derived`, its column, and the column of its sd
_DERIVED = {
    "latitude": ("lat_deg", "lat_sd_deg"),
    "longitude": ("lon_deg", "lon_sd_deg"),
    "altitude": ("alt_m", "alt_sd_m"),
    "speed_inertial": ("speed_inertial_mps", "speed_inertial_sd_mps"),
    "path_inertial": ("flight_path_inertial_deg", "flight_path_inertial_sd_deg"),
    "heading_inertial": ("heading_inertial_deg", "heading_inertial_sd_deg"),
    "speed_ground": ("speed_ground_mps", "speed_ground_sd_mps"),
    "path_ground": ("flight_path_deg", "flight_path_sd_deg"),
    "heading_ground": ("heading_deg", "heading_sd_deg"),
    "speed_wind": ("airspeed_mps", "airspeed_sd_mps"),
    "path_wind": ("flight_path_wind_deg", "flight_path_wind_sd_deg"),
    "heading_wind": ("heading_wind_deg", "heading_wind_sd_deg"),
    "roll": ("roll_ned_deg", "roll_ned_sd_deg"),
    "pitch": ("pitch_ned_deg", "pitch_ned_sd_deg"),
    "yaw": ("yaw_ned_deg", "yaw_ned_sd_deg"),
    "mach": ("mach", "mach_sd"),
    "dynamic_pressure": ("dynamic_pressure_pa", "dynamic_pressure_sd_pa"),
    "density": ("rho_kgpm3", "rho_sd_kgpm3"),
    "pressure": ("p_pa", "p_sd_pa"),
    "temperature": ("t_k", "t_sd_k"),
    "alpha": ("alpha_deg", "alpha_sd_deg"),
    "beta": ("beta_deg", "beta_sd_deg"),
    "alpha_total_wind": ("alpha_total_wind_deg", "alpha_total_wind_sd_deg"),
    "alpha_total_ground": ("alpha_total_ground_deg", "alpha_total_ground_sd_deg"),
    "alpha_total_inertial": ("alpha_total_inertial_deg", "alpha_total_inertial_sd_deg"),
    "clock_wind": ("clock_lv_deg", "clock_lv_sd_deg"),
    "clock_inertial": ("clock_inertial_lv_deg", "clock_inertial_lv_sd_deg"),
}
_NEED_ATTITUDE = ("roll", "pitch", "yaw", "alpha", "beta", "clock", "alpha_total")
_FORCE_NAMES = (
    *(f"a{a}_imu_mps2" for a in "xyz"),
    *(f"a{a}_imu_sd_mps2" for a in "xyz"),
    *(f"a{a}_cg_mps2" for a in "xyz"),
    *(f"a{a}_cg_sd_mps2" for a in "xyz"),
    "c_a", "c_a_sd", "c_n", "c_n_sd", "cn_over_ca", "cn_over_ca_sd",
)  # fmt: skip
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


def _vector(pattern: str, letters: str, values: FloatArray) -> Columns:
    """Columns of a vector."""
    return {pattern.format(a): c for a, c in zip(letters, values.T, strict=True)}


def bet_table(flight: Reconstruction) -> pd.DataFrame:
    """Best estimated trajectory, one row an output time."""
    bet = flight.solution.smoothed
    sd = bet.sd()
    columns: Columns = {"t_s": bet.time_s}
    columns |= _vector("r{}_ecef_m", "xyz", bet.position_ecef_m)
    columns |= _vector("v{}_ecef_mps", "xyz", bet.velocity_ecef_mps)
    columns |= _vector("q{}_ecef_body", "wxyz", bet.q_ecef_body)
    columns |= _vector("{}_body_degps", "pqr", np.rad2deg(bet.omega_body_eci_body_radps))
    columns |= _vector("r{}_ecef_sd_m", "xyz", sd[:, 0:3])
    columns |= _vector("v{}_ecef_sd_mps", "xyz", sd[:, 3:6])
    columns |= _vector("rotation_{}_body_sd_deg", "xyz", np.rad2deg(sd[:, 6:9]))
    columns |= _vector("{}_body_sd_degps", "pqr", np.rad2deg(_rate_sd(flight)))
    columns |= _inertial(flight)
    columns |= _derived(flight)
    columns |= _force(flight)
    columns |= _density_ratio(flight)
    if not flight.has_attitude:  # the trajectory's own attitude is a placeholder there
        blank = np.full(len(bet.time_s), np.nan)
        columns |= {name: blank for name in columns if "_body" in name}
    return pd.DataFrame(columns)


def _rate_sd(flight: Reconstruction) -> FloatArray:
    """Standard deviations (n, 3) of the rates: estimated errors and a sample's white noise."""
    bet, rates = flight.solution, flight.telemetry.rates
    if not len(bet.rate_cov) or rates is None:
        return np.full((len(bet.smoothed.time_s), 3), np.nan)
    return np.asarray(np.sqrt(np.diagonal(bet.rate_cov, axis1=1, axis2=2) + rates.spec.noise_sd**2))


def _inertial(flight: Reconstruction) -> Columns:
    """Position and velocity in ECI with standard deviations."""
    bet = flight.solution.smoothed
    assert bet.covariance is not None
    turn = rotations.conjugate(earth.q_ecef_eci(bet.time_s))
    dcm = rotations.dcm_from_q(turn)
    r = rotations.rotate(turn, bet.position_ecef_m)
    v = rotations.rotate(turn, bet.velocity_ecef_mps) + np.cross(earth.OMEGA_ECEF_RADPS, r)
    move = np.zeros((len(r), 6, 6))
    move[:, 0:3, 0:3] = move[:, 3:6, 3:6] = dcm
    move[:, 3:6, 0:3] = rotations.skew(earth.OMEGA_ECEF_RADPS) @ dcm
    moved = move @ bet.covariance[:, :6, :6] @ move.transpose(0, 2, 1)
    sd = np.sqrt(np.diagonal(moved, axis1=1, axis2=2))
    out = _vector("r{}_eci_m", "xyz", r) | _vector("v{}_eci_mps", "xyz", v)
    return out | _vector("r{}_eci_sd_m", "xyz", sd[:, 0:3]) | _vector("v{}_eci_sd_mps", "xyz", sd[:, 3:6])


def _derived(flight: Reconstruction) -> Columns:
    """Air data, flow angles and attitude angles; winds."""
    vehicle, profile = flight.telemetry.vehicle, profile_from_sounding(flight.telemetry.sounding)
    arm = np.zeros(3) if vehicle is None else vehicle.cg_m
    value, sd = derived_with_sd(flight.solution.smoothed, profile, arm)
    out: Columns = {}
    for name, (column, sd_column) in _DERIVED.items():
        unknown = not flight.has_attitude and name.startswith(_NEED_ATTITUDE)
        for key, numbers in ((column, value[name]), (sd_column, sd[name])):
            out[key] = np.full(len(numbers), np.nan) if unknown else np.rad2deg(numbers) if is_angle(name) else numbers
    air = flight.air
    for kind in ("wind", "ground", "inertial"):  # to first order, as the estimators have them
        if flight.has_attitude:
            out[f"alpha_total_{kind}_sd_deg"] = np.rad2deg(getattr(air, f"alpha_total_{kind}_sd_rad"))
    out |= {"wind_n_mps": air.air.wind_ned_mps[:, 0], "wind_e_mps": air.air.wind_ned_mps[:, 1]}
    return out | {"wind_sd_mps": air.air.wind_sd_mps}


def _force(flight: Reconstruction) -> Columns:
    """Specific force at the sensor and at the c.g., and the force coefficients that follow with the sounding's air."""
    bet, telemetry = flight.solution, flight.telemetry
    t = bet.smoothed.time_s
    out = {name: np.full(len(t), np.nan) for name in _FORCE_NAMES}
    rows = windows_are_whole(bet, t)
    if telemetry.accelerometer is None or not rows.any():
        return out
    spec, vehicle = telemetry.accelerometer.spec, telemetry.vehicle
    arm = np.zeros(3) if vehicle is None else vehicle.cg_m - spec.position_from_datum_body_m
    at = cg_accelerations(bet, t[rows], arm)
    cov = bet.specific_force_cov[rows] + spec.noise_sd**2 / at.samples * np.eye(3)
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    found = _vector("a{}_imu_mps2", "xyz", at.specific_force_sensor_mps2) | _vector("a{}_imu_sd_mps2", "xyz", sd)
    if vehicle is not None:
        force = at.specific_force_cg_mps2
        found |= _vector("a{}_cg_mps2", "xyz", force) | _vector("a{}_cg_sd_mps2", "xyz", sd)
        q, q_sd = (getattr(flight.air, f"dynamic_pressure{end}_pa")[rows] for end in ("", "_sd"))
        mass_per_area = vehicle.mass_kg / vehicle.reference.area_m2
        found |= _coefficients(force, cov, q / mass_per_area, np.hypot(q_sd / q, vehicle.uncertainty.mass))
    for name, numbers in found.items():
        out[name][rows] = numbers
    return out


def _coefficients(force: FloatArray, cov: FloatArray, scale_mps2: FloatArray, scale_sd: FloatArray) -> Columns:
    """C_A, C_N and their ratio with sds; ``scale_mps2`` (n,) is q S / m, ``scale_sd`` its sd as a fraction."""
    axial, normal = -force[:, 0], np.hypot(force[:, 1], force[:, 2])
    way = force[:, 1:] / np.maximum(normal, 1e-12)[:, None]
    axial_part = np.sqrt(cov[:, 0, 0]) / np.abs(axial)
    normal_sd = np.sqrt(np.einsum("ni,nij,nj->n", way, cov[:, 1:, 1:], way))
    ca, cn, ratio = axial / scale_mps2, normal / scale_mps2, normal / axial
    out = {
        "c_a": ca,
        "c_a_sd": np.abs(ca) * np.hypot(axial_part, scale_sd),
        "c_n": cn,
        "c_n_sd": np.hypot(normal_sd / scale_mps2, cn * scale_sd),
        "cn_over_ca": ratio,
        "cn_over_ca_sd": np.hypot(normal_sd / axial, ratio * axial_part),
    }
    weak = axial < LEAST_AXIAL_MPS2
    return {name: np.where(weak, np.nan, numbers) for name, numbers in out.items()}


def _density_ratio(flight: Reconstruction) -> Columns:
    """As-flown density, from the deceleration, over the sounding's, on the descent."""
    n = len(flight.air.time_s)
    out = {"density_ratio": np.full(n, np.nan), "density_ratio_sd": np.full(n, np.nan)}
    if flight.as_flown is None:
        return out
    p, span = flight.as_flown.profile, flight.as_flown.drag["time_s"]
    h = flight.air.altitude_m
    rows = (flight.air.time_s >= span.min()) & (flight.air.time_s <= span.max())
    rows &= (h >= p["altitude_m"].min()) & (h <= p["altitude_m"].max())
    for name in out:
        out[name][rows] = np.interp(h[rows], p["altitude_m"], p[name])
    return out


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
    named += events.descent_moments(air.time_s, air.altitude_m, air.mach)
    rows = []
    for name, t in sorted(named, key=lambda m: m[1]):
        row: dict[str, object] = {"event": name, "t_s": t}
        for column, sd_column in _EVENT_COLUMNS.items():
            row[column] = np.interp(t, table["t_s"], table[column])
            row[_three_sd(column)] = 3.0 * np.interp(t, table["t_s"], table[sd_column])
        rows.append(row)
    names = [c for column in _EVENT_COLUMNS for c in (column, _three_sd(column))]
    return pd.DataFrame(rows, columns=["event", "t_s", *names])


def _three_sd(column: str) -> str:
    """``alt_m`` to ``alt_3sd_m``."""
    stem, _, unit = column.rpartition("_")
    return f"{stem}_3sd_{unit}" if stem else f"{column}_3sd"


def peak_table(flight: Reconstruction, table: pd.DataFrame) -> pd.DataFrame:
    """Peak values with times and standard deviations; ``inside`` is false where one lies at an end of the data."""
    q = table["dynamic_pressure_pa"].to_numpy()
    pulse = q >= 0.5 * q.max()
    rows = []
    for name, (column, sd_column) in _PEAKS.items():
        values, sd = (table[c].to_numpy(dtype=float) for c in (column, sd_column))
        size = np.abs(values)
        use = np.isfinite(size) & (pulse if "pulse" in name else size > -1.0)
        if name in ("Mach number", "airspeed"):
            use &= flight.air.altitude_m < events.HIGHEST_M
        if not use.any():
            continue
        k = int(np.flatnonzero(use)[np.argmax(size[use])])
        inside = 0 < k < len(size) - 1 and bool(use[k - 1] and use[k + 1])
        rows.append((name, column, table["t_s"].iloc[k], values[k], sd[k], inside))
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

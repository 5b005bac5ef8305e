"""Tables beside the trajectory: events and peaks with their uncertainty, and how the residuals behaved."""

from __future__ import annotations

import numpy as np
import pandas as pd

from flightmodel import moments
from flightmodel.checks import FloatArray
from postflight.pipeline import Flight

COVARIANCE_RATE_HZ = 1.0
STATISTICS = ("source", "component", "unit", "count", "edited", "mean", "sd", "rms_normalised", "lag1", "nis")
# column of bet.csv whose largest size is looked for, and the column of its standard deviation
PEAKS = {
    "dynamic pressure": ("dynamic_pressure_pa", "dynamic_pressure_sd_pa"),
    "Mach number": ("mach", "mach_sd"),
    "airspeed": ("airspeed_mps", "airspeed_sd_mps"),
    "axial deceleration": ("ax_cg_mps2", "ax_cg_sd_mps2"),
    "total angle of attack in the pulse": ("alpha_total_wind_deg", "alpha_total_wind_sd_deg"),
    "altitude": ("alt_m", "alt_sd_m"),
}
EVENT_COLUMNS = {
    "alt_m": "alt_sd_m",
    "speed_ground_mps": "speed_ground_sd_mps",
    "flight_path_deg": "flight_path_sd_deg",
    "mach": "mach_sd",
    "dynamic_pressure_pa": "dynamic_pressure_sd_pa",
    "alpha_total_wind_deg": "alpha_total_wind_sd_deg",
}


def event_table(flight: Flight, table: pd.DataFrame) -> pd.DataFrame:
    """Moments of the flight with what ``bet.csv`` says of them: each value with three standard deviations."""
    air = flight.air
    named = [(name, t) for name, t in flight.telemetry.events if air.time_s[0] <= t <= air.time_s[-1]]
    peak = "peak dynamic pressure" if flight.peak_is_inside else "largest dynamic pressure (edge of data)"
    named.append((peak, flight.peak_s))
    named += moments.descent_moments(air.time_s, air.altitude_m, air.mach)
    rows = []
    for name, t in sorted(named, key=lambda m: m[1]):
        row: dict[str, object] = {"event": name, "t_s": t}
        for column, sd_column in EVENT_COLUMNS.items():
            row[column] = np.interp(t, table["t_s"], table[column])
            row[_three_sd(column)] = 3.0 * np.interp(t, table["t_s"], table[sd_column])
        rows.append(row)
    names = [c for column in EVENT_COLUMNS for c in (column, _three_sd(column))]
    return pd.DataFrame(rows, columns=["event", "t_s", *names])


def _three_sd(column: str) -> str:
    """``alt_m`` to ``alt_3sd_m``."""
    stem, _, unit = column.rpartition("_")
    return f"{stem}_3sd_{unit}" if stem else f"{column}_3sd"


def peak_table(flight: Flight, table: pd.DataFrame) -> pd.DataFrame:
    """Largest values with their times; ``inside`` is false where one lies at an end of the data."""
    q = table["dynamic_pressure_pa"].to_numpy()
    pulse = q >= 0.5 * q.max()
    rows = []
    for name, (column, sd_column) in PEAKS.items():
        values, sd = (table[c].to_numpy(dtype=float) for c in (column, sd_column))
        size = np.abs(values)
        use = np.isfinite(size) & (pulse if "pulse" in name else size > -1.0)
        if name in ("Mach number", "airspeed"):
            use &= flight.air.altitude_m < moments.HIGHEST_M
        if not use.any():
            continue
        k = int(np.flatnonzero(use)[np.argmax(size[use])])
        inside = 0 < k < len(size) - 1 and bool(use[k - 1] and use[k + 1])
        rows.append((name, column, table["t_s"].iloc[k], values[k], sd[k], inside))
    return pd.DataFrame(rows, columns=["peak", "column", "t_s", "value", "sd", "inside"])


def residual_statistics(flight: Flight) -> pd.DataFrame:
    """How the residuals of each source and component behaved; edited points count in ``count`` and ``edited`` alone.

    Mean and sd are in metres and radians (m/s for velocities); ``rms_normalised`` is over the predicted sd and should
    be one, ``lag1`` the autocorrelation of successive ones and should be none; ``nis`` repeats the source's verdict.
    """
    nis = {v.name.removeprefix("NIS "): v.value for v in flight.reconstruction.verdicts if v.name.startswith("NIS ")}
    rows = []
    for (source, component), part in flight.reconstruction.residuals.groupby(["source", "component"], sort=False):
        good = part[part["accepted"]]
        r, z = good["residual"].to_numpy(), (good["residual"] / good["predicted_sd"]).to_numpy()
        unit = "rad" if component in ("azimuth", "elevation") else "m"
        unit = "m/s" if "velocity" in f"{source} {component}" else unit
        values = (_mean(r), _sd(r), float(np.sqrt(_mean(z**2))), _lag1(z)) if len(r) > 2 else (np.nan,) * 4
        edited = len(part) - len(good)
        rows.append((source, component, unit, len(part), edited, *values, nis.get(source, np.nan)))
    return pd.DataFrame(rows, columns=list(STATISTICS))


def _mean(values: FloatArray) -> float:
    return float(np.mean(values))


def _sd(values: FloatArray) -> float:
    return float(np.std(values, ddof=1))


def _lag1(z: FloatArray) -> float:
    centred = z - z.mean()
    return float(centred[1:] @ centred[:-1] / max(float(centred @ centred), 1e-300))


def slow_covariance(flight: Flight) -> dict[str, FloatArray]:
    """Whole covariances (k, 9, 9) at `COVARIANCE_RATE_HZ`: position ECEF m, velocity ECEF m/s, rotation body rad."""
    bet = flight.reconstruction.smoothed
    assert bet.covariance is not None
    ticks = np.floor(bet.time_s * COVARIANCE_RATE_HZ + 1e-6)
    rows = np.flatnonzero(np.diff(ticks, prepend=-np.inf) > 0.0)
    return {"t_s": bet.time_s[rows], "covariance": bet.covariance[rows]}

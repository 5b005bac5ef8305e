"""Which density did a vehicle meet whose drag is stated? From the deceleration, without a vehicle file.

    rho = 2 a / (C_A S / m |u|^2),   q = a m / (C_A S)

``a`` is the deceleration along the flow, ``u`` the velocity against the air. In ballistic flight both are those of the
smoothed drivers (`recon.propagation`): ``ln(2 a / |u|^2) = ln(B rho0(h)) + d + c0 sd(h)``, with the smoothed covariance
of place and drivers, so that noise and bias of an accelerometer, trim and wind are all in it. With gyros ``a`` is the
corrected axial reading, averaged over a window, taken to lie along the flow. C_A and mass are stated; what they may err
is one factor of the whole profile. Mach number takes the temperature of the flight's atmosphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flightmodel import earth
from flightmodel.airdata import air_data, temperature_sd
from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import FloatArray, GateError
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory
from recon.ekf import Problem
from recon.state import KINEMATIC, States, unpacked

LEAST_KNOWN = 0.5  # fractional sd of density, C_A apart, from which a row is given
_HALF_WINDOW_S = 0.25  # of an axial reading


@dataclass(frozen=True)
class DragHistory:
    """What the deceleration says of the air at a trajectory's times (n,).

    Parameters
    ----------
    log_drag : (n,) float
        ``ln(2 a / |u|^2)``, of ``rho C_A S / m`` in 1/m.
    sd : (n,) float
        Its standard deviation.
    pressure_sd : (n,) float
        That of ``ln a``, which dynamic pressure has.
    """

    log_drag: FloatArray
    sd: FloatArray
    pressure_sd: FloatArray


def drag_of_drivers(problem: Problem, states: States, triangles: FloatArray, path: Trajectory) -> DragHistory:
    """Drag of ballistic flight at the kept nodes, from states at all nodes and packed covariances at the kept ones."""
    motion, at = problem.motion, states[np.flatnonzero(problem.kept)]
    _, _, height = earth.geodetic_from_ecef(at.position_ecef_m, motion.planet)
    row = (height - motion.air_from_m) / motion.air_step_m
    grid = np.arange(len(motion.air))
    log_density, wind_north, wind_east, density_sd, wind_sd = (np.interp(row, grid, c) for c in motion.air.T)
    steeper = np.interp(row + 0.5, grid, motion.air[:, 0]) - np.interp(row - 0.5, grid, motion.air[:, 0])
    latitude, longitude, _ = earth.geodetic_from_ecef(at.position_ecef_m, motion.planet)
    ned = earth.dcm_ned_ecef(latitude, longitude)
    drivers = at.sensor_errors[:, :6]
    covariance = unpacked(triangles, KINEMATIC + 6)
    by = np.zeros((len(height), KINEMATIC + 6))
    by[:, 0:3] = -ned[:, 2] * (steeper / motion.air_step_m)[:, None]
    by[:, KINEMATIC], by[:, KINEMATIC + 3] = 1.0, density_sd
    wind = np.column_stack([wind_north + drivers[:, 4] * wind_sd, wind_east + drivers[:, 5] * wind_sd])
    flow = path.velocity_ecef_mps - np.einsum("nji,nj->ni", ned[:, :2], wind)
    along = flow / np.sum(flow**2, axis=1)[:, None]
    to_force = by.copy()
    to_force[:, 3:6] = 2.0 * along
    to_force[:, KINEMATIC + 4 :] = -2.0 * wind_sd[:, None] * np.einsum("nij,nj->ni", ned[:, :2], along)
    log_drag = np.log(motion.drag_m2pkg) + log_density + drivers[:, 0] + drivers[:, 3] * density_sd
    sd, force_sd = (np.sqrt(np.einsum("ni,nij,nj->n", j, covariance, j)) for j in (by, to_force))
    return DragHistory(log_drag, sd, force_sd)


def drag_of_readings(
    telemetry: Telemetry, path: Trajectory, time_s: FloatArray, force_body_mps2: FloatArray, force_cov: FloatArray
) -> DragHistory | None:
    """Drag by an accelerometer with gyros: corrected readings (k, 3), their times, systematic covariance (n, 3, 3)."""
    if telemetry.drag is None or telemetry.accelerometer is None:
        return None
    t = path.time_s
    first, last = np.searchsorted(time_s, t - _HALF_WINDOW_S), np.searchsorted(time_s, t + _HALF_WINDOW_S)
    count = np.maximum(last - first, 1)
    total = np.concatenate([[0.0], np.cumsum(-force_body_mps2[:, 0])])
    mean = np.where(last > first, (total[last] - total[first]) / count, np.nan)
    noise = telemetry.accelerometer.spec.noise_sd / np.sqrt(count)
    air = air_data(path, profile_from_sounding(telemetry.sounding), np.zeros(3))
    speed = air.airspeed_mps
    assert path.covariance is not None
    unit = path.velocity_ecef_mps / np.linalg.norm(path.velocity_ecef_mps, axis=1)[:, None]
    speed_var = np.einsum("ni,nij,nj->n", unit, path.covariance[:, 3:6, 3:6], unit) + air.air.wind_sd_mps**2
    with np.errstate(invalid="ignore", divide="ignore"):
        log_drag = np.log(2.0 * mean / speed**2)  # none where it pushes, as noise does in thin air
        own = np.sqrt(force_cov[:, 0, 0] + noise**2) / mean
    return DragHistory(log_drag, np.sqrt(own**2 + 4.0 * speed_var / speed**2), own)


def density_by_drag(telemetry: Telemetry, path: Trajectory, history: DragHistory | None) -> pd.DataFrame:
    """Density, dynamic pressure and Mach number as flown, a row a time at which the deceleration determines them.

    Raises
    ------
    GateError
        ``drag-missing`` where flight.toml states no drag, ``deceleration-missing`` where nothing measures it.
    """
    drag = telemetry.drag
    if drag is None:
        raise GateError("density as flown: state [drag] (c_a, area, mass) or a vehicle in flight.toml", "drag-missing")
    if history is None:
        raise GateError("density as flown: no accelerometer and no ballistic motion", "deceleration-missing")
    air = air_data(path, profile_from_sounding(telemetry.sounding), np.zeros(3))
    area = drag.area_per_mass_m2pkg(air.mach)
    rho, sd = np.exp(history.log_drag) / area, np.hypot(history.sd, drag.sd)
    pressure = 0.5 * rho * air.airspeed_mps**2
    covariance = path.covariance
    assert covariance is not None
    down = earth.dcm_ned_ecef(air.latitude_rad, air.longitude_rad)[:, 2]
    height_sd = np.sqrt(np.einsum("ni,nij,nj->n", down, covariance[:, :3, :3], down))
    known = np.isfinite(sd) & (history.sd < LEAST_KNOWN) & np.isfinite(rho)
    table = pd.DataFrame(
        {
            "time_s": path.time_s,
            "altitude_m": air.altitude_m,
            "altitude_sd_m": height_sd,
            "density_kgpm3": rho,
            "density_sd_kgpm3": rho * sd,
            "density_ratio": rho / air.air.density_kgpm3,
            "density_ratio_sd": rho / air.air.density_kgpm3 * sd,
            "common_factor_sd": np.full(len(rho), drag.sd),
            "mach": air.mach,
            "mach_sd": air.mach * _mach_sd(air.air.temperature_k, air.airspeed_mps, path, air.air.wind_sd_mps),
            "dynamic_pressure_pa": pressure,
            "dynamic_pressure_sd_pa": pressure * np.hypot(history.pressure_sd, drag.sd),
        }
    )
    return table[known].reset_index(drop=True)


def _mach_sd(temperature_k: FloatArray, speed_mps: FloatArray, path: Trajectory, wind_sd: FloatArray) -> FloatArray:
    """Fractional sd of the Mach number by temperature, velocity and wind."""
    assert path.covariance is not None
    unit = path.velocity_ecef_mps / np.linalg.norm(path.velocity_ecef_mps, axis=1)[:, None]
    var = np.einsum("ni,nij,nj->n", unit, path.covariance[:, 3:6, 3:6], unit) + wind_sd**2
    _, _, height = earth.geodetic_from_ecef(path.position_ecef_m, path.planet)
    return np.asarray(np.hypot(0.5 * temperature_sd(height, path.planet) / temperature_k, np.sqrt(var) / speed_mps))

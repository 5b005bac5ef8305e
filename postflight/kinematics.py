"""Everything that follows from place, velocity, attitude and air, and how uncertain it is: one function, differenced.

The root of the trajectory's covariance and the air's standard deviations are directions in which the inputs may err;
half the central difference along each is what a quantity may err by, and their root sum of squares is its standard
deviation. No derivative is written down twice, and angles are differenced the short way round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flightmodel import earth, rotations
from flightmodel.airdata import total_angle
from flightmodel.atmosphere import GAMMA, R_AIR_JPKGK, AtmosphereProfile
from flightmodel.checks import FloatArray
from flightmodel.deflection import lv_clock
from flightmodel.trajectory import Trajectory

VELOCITIES = ("inertial", "ground", "wind")
ANGLES = ("latitude", "longitude", "roll", "pitch", "yaw", "alpha", "beta")


@dataclass(frozen=True)
class Inputs:
    """What may err: a trajectory's rows, and departures of winds (n, 2), log density (n,), temperature (n,)."""

    trajectory: Trajectory
    wind_mps: FloatArray
    log_density: FloatArray
    temperature_k: FloatArray


def temperature_sd(altitude_m: FloatArray) -> FloatArray:
    """Usual error of datasonde and sphere temperatures, K: 1 at 30 km, 3 at 70 km, 5 from 80 km (1 sd)."""
    return np.asarray(np.interp(altitude_m, [30e3, 70e3, 80e3], [1.0, 3.0, 5.0]))


def _angles_of(velocity_ned: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Speed, flight-path angle above the horizon, heading from north."""
    north, east, down = velocity_ned.T
    speed = np.sqrt(north**2 + east**2 + down**2)
    return speed, np.arctan2(-down, np.hypot(north, east)), np.mod(np.arctan2(east, north), 2.0 * np.pi)


def euler_321(dcm_ned_body: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll, pitch, yaw (n,), rad: yaw about down, then pitch, then roll, from NED to body."""
    c = dcm_ned_body
    return (
        np.arctan2(c[:, 2, 1], c[:, 2, 2]),
        np.arcsin(np.clip(-c[:, 2, 0], -1.0, 1.0)),
        np.mod(np.arctan2(c[:, 1, 0], c[:, 0, 0]), 2.0 * np.pi),
    )


def derived(inputs: Inputs, profile: AtmosphereProfile, arm_body_m: FloatArray) -> dict[str, FloatArray]:
    """All derived quantities (n,), rad and SI; the air meets the point ``arm_body_m`` from the trajectory's."""
    path = inputs.trajectory
    r = path.position_ecef_m
    lat, lon, altitude = earth.geodetic_from_ecef(r)
    air = profile.at(altitude)
    dcm_ned_ecef = earth.dcm_ned_ecef(lat, lon)
    dcm = rotations.dcm_from_q(path.q_ecef_body)
    spin = path.omega_body_eci_body_radps - earth.OMEGA_RADPS * dcm[:, 2]
    v_point = path.velocity_ecef_mps + np.einsum("nij,nj->ni", dcm, np.cross(spin, arm_body_m))
    wind = air.wind_ned_mps.copy()
    wind[:, :2] += inputs.wind_mps
    carried = np.cross(earth.OMEGA_ECEF_RADPS, r)
    ecef = {
        "inertial": (path.velocity_ecef_mps + carried, v_point + carried),
        "ground": (path.velocity_ecef_mps, v_point),
    }
    blown = np.einsum("nji,nj->ni", dcm_ned_ecef, wind)
    ecef["wind"] = (v_point - blown,) * 2
    out = {"latitude": lat, "longitude": lon, "altitude": altitude}
    body = {}
    for name in VELOCITIES:
        along, at_point = ecef[name]
        parts = _angles_of(np.einsum("nij,nj->ni", dcm_ned_ecef, along))
        out |= {f"{what}_{name}": part for what, part in zip(("speed", "path", "heading"), parts, strict=True)}
        body[name] = np.einsum("nji,nj->ni", dcm, at_point)
        out[f"alpha_total_{name}"] = total_angle(body[name])
        out[f"clock_{name}"] = lv_clock(body[name][:, 1:])
    out |= dict(zip(("roll", "pitch", "yaw"), euler_321(dcm_ned_ecef @ dcm), strict=True))
    out["alpha"] = np.arctan2(body["wind"][:, 2], body["wind"][:, 0])
    out["beta"] = np.arcsin(np.clip(body["wind"][:, 1] / out["speed_wind"], -1.0, 1.0))
    out["temperature"] = air.temperature_k + inputs.temperature_k
    out["mach"] = out["speed_wind"] / np.sqrt(GAMMA * R_AIR_JPKGK * out["temperature"])
    out["density"] = air.density_kgpm3 * np.exp(inputs.log_density)
    out["pressure"] = out["density"] * R_AIR_JPKGK * out["temperature"]
    out["dynamic_pressure"] = 0.5 * out["density"] * out["speed_wind"] ** 2
    return out


def is_angle(name: str) -> bool:
    """Whether a quantity wraps."""
    return name in ANGLES or name.startswith(("path_", "heading_", "clock_", "alpha_total_"))


def derived_with_sd(
    trajectory: Trajectory, profile: AtmosphereProfile, arm_body_m: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Quantities (n,) and their standard deviations, which carry the trajectory's covariance and the air's errors."""
    assert trajectory.covariance is not None
    n = len(trajectory.time_s)
    nothing = Inputs(trajectory, np.zeros((n, 2)), np.zeros(n), np.zeros(n))
    value = derived(nothing, profile, arm_body_m)
    air = profile.at(value["altitude"])
    root: FloatArray = np.asarray(np.linalg.cholesky(trajectory.covariance + 1e-18 * np.eye(9)), dtype=np.float64)
    warm = temperature_sd(value["altitude"])

    def moved(k: int, sign: float) -> dict[str, FloatArray]:
        if k < 9:
            step = sign * root[:, :, k]
            path = replace(
                trajectory,
                position_ecef_m=trajectory.position_ecef_m + step[:, 0:3],
                velocity_ecef_mps=trajectory.velocity_ecef_mps + step[:, 3:6],
                q_ecef_body=rotations.boxplus(trajectory.q_ecef_body, step[:, 6:9]),
            )
            return derived(replace(nothing, trajectory=path), profile, arm_body_m)
        if k < 11:
            wind = np.zeros((n, 2))
            wind[:, k - 9] = sign * air.wind_sd_mps
            return derived(replace(nothing, wind_mps=wind), profile, arm_body_m)
        if k == 11:
            return derived(replace(nothing, log_density=sign * air.density_sd), profile, arm_body_m)
        return derived(replace(nothing, temperature_k=sign * warm), profile, arm_body_m)

    variance = {name: np.zeros(n) for name in value}
    for k in range(13):
        up, down = moved(k, 1.0), moved(k, -1.0)
        for name in value:
            gap = up[name] - down[name]
            if is_angle(name):
                gap = np.mod(gap + np.pi, 2.0 * np.pi) - np.pi
            variance[name] += (0.5 * gap) ** 2
    return value, {name: np.sqrt(v) for name, v in variance.items()}

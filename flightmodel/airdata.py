"""How fast, at what pressure and at what angle the air met the vehicle: one definition of flow angles.

From the velocity relative to the air in body axes ``(u, v, w)``: angle of attack ``atan2(w, u)``, sideslip
``asin(v / V)``, total angle of attack ``atan2(hypot(v, w), u)``, clock the LV clocking angle of the lateral velocity
``(v, w)``. The centerbody's angles are what sensors see; the aeroshell's differ by the deflection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import earth, rotations
from flightmodel.atmosphere import AirState, AtmosphereProfile
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock
from flightmodel.events import peak
from flightmodel.trajectory import Trajectory


@dataclass(frozen=True)
class AirData:
    """Air data along a trajectory, every quantity ``(n,)`` with its sd where the inputs carry one.

    ``alpha_total_*`` are total angles of attack of the body's x axis against three velocities: ``wind``, relative to
    the moving air; ``ground``, relative to the rotating Earth (no wind); ``inertial``, relative to inertial space.
    """

    time_s: FloatArray
    altitude_m: FloatArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    air: AirState
    velocity_air_body_mps: FloatArray
    airspeed_mps: FloatArray
    mach: FloatArray
    dynamic_pressure_pa: FloatArray
    dynamic_pressure_sd_pa: FloatArray
    alpha_rad: FloatArray
    beta_rad: FloatArray
    alpha_total_wind_rad: FloatArray
    alpha_total_ground_rad: FloatArray
    alpha_total_inertial_rad: FloatArray
    alpha_total_wind_sd_rad: FloatArray
    alpha_total_ground_sd_rad: FloatArray
    alpha_total_inertial_sd_rad: FloatArray
    clock_lv_rad: FloatArray
    lateral_flow_cov: FloatArray
    flight_path_angle_rad: FloatArray


def total_angle(velocity_body_mps: FloatArray) -> FloatArray:
    """Total angle of attack, rad in [0, pi], of velocities ``(..., 3)`` in body axes."""
    lateral = np.hypot(velocity_body_mps[..., 1], velocity_body_mps[..., 2])
    return np.arctan2(lateral, velocity_body_mps[..., 0])


def lateral_angles(velocity_body_mps: FloatArray) -> FloatArray:
    """Total angle of attack as a lateral vector ``(..., 2)`` in body y, z: its length is the angle, rad."""
    lateral = velocity_body_mps[..., 1:]
    size = np.linalg.norm(lateral, axis=-1, keepdims=True)
    direction = lateral / np.where(size > 0.0, size, 1.0)
    return direction * total_angle(velocity_body_mps)[..., None]


def angle_partials(velocity_body_mps: FloatArray) -> FloatArray:
    """Derivatives ``(n, 2, 3)`` of the lateral angles by the velocity (n, 3), to first order in the angle."""
    u = velocity_body_mps[:, 0]
    out = np.zeros((len(u), 2, 3))
    out[:, 0, 1] = out[:, 1, 2] = 1.0 / u
    out[:, :, 0] = -velocity_body_mps[:, 1:] / u[:, None] ** 2
    return out


def peak_pressure(time_s: FloatArray, dynamic_pressure_pa: FloatArray) -> tuple[float, float]:
    """Time and value of the largest dynamic pressure, by a parabola through the three samples around it."""
    return peak(time_s, dynamic_pressure_pa)


def pressure_pulse(dynamic_pressure_pa: FloatArray) -> BoolArray:
    """Mask of the pressure pulse: the unbroken run around the peak where dynamic pressure exceeds half its peak.

    Half, because a light vehicle's terminal descent alone holds a fifth of it.
    """
    above = dynamic_pressure_pa >= 0.5 * dynamic_pressure_pa.max()
    peak = int(np.argmax(dynamic_pressure_pa))
    below = np.flatnonzero(~above)
    first = below[below < peak][-1] + 1 if (below < peak).any() else 0
    last = below[below > peak][0] if (below > peak).any() else len(above)
    mask = np.zeros(len(above), dtype=bool)
    mask[first:last] = True
    return mask


def air_data(trajectory: Trajectory, profile: AtmosphereProfile, arm_body_m: FloatArray) -> AirData:
    """Air data of the body along a trajectory.

    Parameters
    ----------
    trajectory : Trajectory
    profile : AtmosphereProfile
    arm_body_m : (3,) float
        Point whose velocity meets the air (the c.g.), from the trajectory's point, body axes.
    """
    r, q = trajectory.position_ecef_m, trajectory.q_ecef_body
    lat, lon, altitude = earth.geodetic_from_ecef(r)
    air = profile.at(altitude)
    dcm_ecef_body = rotations.dcm_from_q(q)
    spin = trajectory.omega_body_eci_body_radps - dcm_ecef_body.transpose(0, 2, 1) @ earth.OMEGA_ECEF_RADPS
    v_ground = trajectory.velocity_ecef_mps + rotations.rotate(q, np.cross(spin, arm_body_m))
    v_ned = np.einsum("nij,nj->ni", earth.dcm_ned_ecef(lat, lon), v_ground)
    v_air = v_ground - np.einsum("nji,nj->ni", earth.dcm_ned_ecef(lat, lon), air.wind_ned_mps)
    v_inertial = v_ground + np.cross(earth.OMEGA_ECEF_RADPS, r)
    in_body = [np.einsum("nji,nj->ni", dcm_ecef_body, v) for v in (v_air, v_ground, v_inertial)]
    speed = np.linalg.norm(in_body[0], axis=1)
    pressure = 0.5 * air.density_kgpm3 * speed**2
    wind_var = air.wind_sd_mps**2
    still = np.zeros(len(speed))
    variances: tuple[FloatArray, ...] = (wind_var, still, still)
    covs = [_lateral_cov(trajectory, dcm_ecef_body, v, var) for v, var in zip(in_body, variances, strict=True)]
    speed_var = _speed_var(trajectory, v_air, speed) + wind_var
    return AirData(
        time_s=trajectory.time_s,
        altitude_m=altitude,
        latitude_rad=lat,
        longitude_rad=lon,
        air=air,
        velocity_air_body_mps=in_body[0],
        airspeed_mps=speed,
        mach=speed / air.sound_speed_mps,
        dynamic_pressure_pa=pressure,
        dynamic_pressure_sd_pa=pressure * np.sqrt(air.density_sd**2 + 4.0 * speed_var / speed**2),
        alpha_rad=np.arctan2(in_body[0][:, 2], in_body[0][:, 0]),
        beta_rad=np.arcsin(in_body[0][:, 1] / speed),
        alpha_total_wind_rad=total_angle(in_body[0]),
        alpha_total_ground_rad=total_angle(in_body[1]),
        alpha_total_inertial_rad=total_angle(in_body[2]),
        alpha_total_wind_sd_rad=_total_sd(in_body[0], covs[0]),
        alpha_total_ground_sd_rad=_total_sd(in_body[1], covs[1]),
        alpha_total_inertial_sd_rad=_total_sd(in_body[2], covs[2]),
        clock_lv_rad=lv_clock(in_body[0][:, 1:]),
        lateral_flow_cov=covs[0],
        flight_path_angle_rad=np.arctan2(-v_ned[:, 2], np.hypot(v_ned[:, 0], v_ned[:, 1])),
    )


def _lateral_cov(
    trajectory: Trajectory, dcm_ecef_body: FloatArray, v_body: FloatArray, wind_var: FloatArray
) -> FloatArray:
    """Covariance ``(n, 2, 2)`` of the flow's lateral angles in body y, z, rad^2; NaN without a trajectory covariance.

    To first order in the angle, ``angle = (v, w) / u``: a velocity error moves it by ``(dv, dw)/u``, a rotation
    error ``d`` of the body by ``v_body x d`` over ``u``.
    """
    if trajectory.covariance is None:
        return np.full((len(v_body), 2, 2), np.nan)
    u = v_body[:, 0]
    to_angle = angle_partials(v_body)
    jacobian = np.concatenate([to_angle @ dcm_ecef_body.transpose(0, 2, 1), to_angle @ rotations.skew(v_body)], axis=2)
    cov = jacobian @ trajectory.covariance[:, 3:, 3:] @ jacobian.transpose(0, 2, 1)
    return cov + (wind_var / u**2)[:, None, None] * np.eye(2)


def _total_sd(v_body: FloatArray, cov: FloatArray) -> FloatArray:
    """Return the sd of the total angle: that of its component along the lateral direction."""
    lateral = v_body[:, 1:]
    size = np.linalg.norm(lateral, axis=1, keepdims=True)
    direction = lateral / np.where(size > 0.0, size, 1.0)
    return np.sqrt(np.einsum("ni,nij,nj->n", direction, cov, direction))


def _speed_var(trajectory: Trajectory, v_air: FloatArray, speed: FloatArray) -> FloatArray:
    if trajectory.covariance is None:
        return np.full(len(speed), np.nan)
    unit = v_air / speed[:, None]
    return np.einsum("ni,nij,nj->n", unit, trajectory.covariance[:, 3:6, 3:6], unit)

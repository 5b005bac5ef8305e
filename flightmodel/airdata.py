"""How fast, at what pressure and at what angle did the air meet the vehicle, and how uncertain is that?

From the velocity relative to the air in body axes ``(u, v, w)``: angle of attack ``atan2(w, u)``, sideslip
``asin(v / V)``, total angle of attack ``atan2(hypot(v, w), u)``, clock the LV clocking angle of the lateral velocity
``(v, w)``; Mach number ``V / sqrt(gamma R T)``, dynamic pressure ``rho V^2 / 2``. The centerbody's angles are what
sensors measure; the aeroshell's differ by the deflection.

Uncertainties come in two forms. `air_data` has those that the estimators use, to first order in the angle. For all
other derived quantities `derived_with_sd` takes the root of the trajectory's covariance and the air's standard
deviations as directions in which the inputs may err: half the central difference along each is what a quantity may err
by, and their root sum of squares is its standard deviation. Angles are differenced the short way round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flightmodel import earth, rotations
from flightmodel.atmosphere import AirState, AtmosphereProfile, gas_constant, sound_speed
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock
from flightmodel.trajectory import Trajectory

VELOCITIES = ("inertial", "ground", "wind")
ANGLES = ("latitude", "longitude", "roll", "pitch", "yaw", "alpha", "beta")
_SLOPE_STEP_M = 100.0  # either side: density's slope; far above rounding, a hundredth of the scale height
_STEP_M = 1000.0  # over which air is linear enough: an eighth of its scale height


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
    """Derivatives ``(n, 2, 3)`` of the lateral angles by the velocity (n, 3), to first order; NaN at rest."""
    u = _or_nan(velocity_body_mps[:, 0])
    out = np.zeros((len(u), 2, 3))
    out[:, 0, 1] = out[:, 1, 2] = 1.0 / u
    out[:, :, 0] = -velocity_body_mps[:, 1:] / u[:, None] ** 2
    return out


def _or_nan(divisor: FloatArray) -> FloatArray:
    """Copy with zeros replaced by NaN: the direction of a zero vector is undefined."""
    return np.where(divisor == 0.0, np.nan, divisor)


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


@dataclass(frozen=True)
class Inputs:
    """What may err: a trajectory's rows, and departures of winds (n, 2), log density (n,), temperature (n,).

    ``higher_m`` (n,) is by how much the profile, measured from the path, errs in height with it.
    """

    trajectory: Trajectory
    wind_mps: FloatArray
    log_density: FloatArray
    temperature_k: FloatArray
    higher_m: FloatArray | float = 0.0


@dataclass(frozen=True)
class _Flow:
    """Air and velocities at a point of the body: the one place where flow angles, Mach number and q come from.

    ``point_ecef_mps`` and ``body_mps`` hold the point's velocity (n, 3) for each name of `VELOCITIES`.
    """

    latitude_rad: FloatArray
    longitude_rad: FloatArray
    altitude_m: FloatArray
    dcm_ned_ecef: FloatArray
    dcm_ecef_body: FloatArray
    air: AirState
    temperature_k: FloatArray
    density_kgpm3: FloatArray
    point_ecef_mps: dict[str, FloatArray]
    body_mps: dict[str, FloatArray]
    planet: earth.Planet

    @property
    def airspeed_mps(self) -> FloatArray:
        return np.linalg.norm(self.body_mps["wind"], axis=1)

    @property
    def mach(self) -> FloatArray:
        return self.airspeed_mps / sound_speed(self.altitude_m, self.temperature_k, self.planet)

    @property
    def dynamic_pressure_pa(self) -> FloatArray:
        return 0.5 * self.density_kgpm3 * self.airspeed_mps**2

    @property
    def alpha_rad(self) -> FloatArray:
        return np.arctan2(self.body_mps["wind"][:, 2], self.body_mps["wind"][:, 0])

    @property
    def beta_rad(self) -> FloatArray:
        return np.arcsin(np.clip(self.body_mps["wind"][:, 1] / _or_nan(self.airspeed_mps), -1.0, 1.0))


def _flow(inputs: Inputs, profile: AtmosphereProfile, arm_body_m: FloatArray) -> _Flow:
    path = inputs.trajectory
    r, q = path.position_ecef_m, path.q_ecef_body
    lat, lon, altitude = earth.geodetic_from_ecef(r, path.planet)
    air = profile.at(altitude - inputs.higher_m)
    dcm_ned_ecef, dcm_ecef_body = earth.dcm_ned_ecef(lat, lon), rotations.dcm_from_q(q)
    spin = path.omega_body_eci_body_radps - dcm_ecef_body.transpose(0, 2, 1) @ path.planet.rate_ecef_radps
    ground = path.velocity_ecef_mps + rotations.rotate(q, np.cross(spin, arm_body_m))
    wind_ned = air.wind_ned_mps + np.pad(inputs.wind_mps, ((0, 0), (0, 1)))
    point = {
        "inertial": ground + np.cross(path.planet.rate_ecef_radps, r),
        "ground": ground,
        "wind": ground - np.einsum("nji,nj->ni", dcm_ned_ecef, wind_ned),
    }
    return _Flow(
        latitude_rad=lat,
        longitude_rad=lon,
        altitude_m=altitude,
        dcm_ned_ecef=dcm_ned_ecef,
        dcm_ecef_body=dcm_ecef_body,
        air=air,
        temperature_k=air.temperature_k + inputs.temperature_k,
        density_kgpm3=air.density_kgpm3 * np.exp(inputs.log_density),
        point_ecef_mps=point,
        planet=path.planet,
        body_mps={name: np.einsum("nji,nj->ni", dcm_ecef_body, v) for name, v in point.items()},
    )


def _as_stated(trajectory: Trajectory) -> Inputs:
    n = len(trajectory.time_s)
    return Inputs(trajectory, np.zeros((n, 2)), np.zeros(n), np.zeros(n))


def air_data(trajectory: Trajectory, profile: AtmosphereProfile, arm_body_m: FloatArray) -> AirData:
    """Air data of the body along a trajectory.

    Parameters
    ----------
    trajectory : Trajectory
    profile : AtmosphereProfile
    arm_body_m : (3,) float
        Point whose velocity meets the air (the c.g.), from the trajectory's point, body axes.
    """
    flow = _flow(_as_stated(trajectory), profile, arm_body_m)
    air, speed, pressure = flow.air, flow.airspeed_mps, flow.dynamic_pressure_pa
    wind_var, still = air.wind_sd_mps**2, np.zeros(len(speed))
    total = {name: total_angle(flow.body_mps[name]) for name in VELOCITIES}
    cov = {
        name: _lateral_cov(trajectory, flow.dcm_ecef_body, flow.body_mps[name], wind_var if name == "wind" else still)
        for name in VELOCITIES
    }
    sd = {name: _total_sd(flow.body_mps[name], cov[name]) for name in VELOCITIES}
    v_ned = np.einsum("nij,nj->ni", flow.dcm_ned_ecef, flow.point_ecef_mps["ground"])
    return AirData(
        time_s=trajectory.time_s,
        altitude_m=flow.altitude_m,
        latitude_rad=flow.latitude_rad,
        longitude_rad=flow.longitude_rad,
        air=air,
        velocity_air_body_mps=flow.body_mps["wind"],
        airspeed_mps=speed,
        mach=flow.mach,
        dynamic_pressure_pa=pressure,
        dynamic_pressure_sd_pa=pressure * np.sqrt(air.density_sd**2 + _pressure_var(trajectory, flow, profile)),
        alpha_rad=flow.alpha_rad,
        beta_rad=flow.beta_rad,
        alpha_total_wind_rad=total["wind"],
        alpha_total_ground_rad=total["ground"],
        alpha_total_inertial_rad=total["inertial"],
        alpha_total_wind_sd_rad=sd["wind"],
        alpha_total_ground_sd_rad=sd["ground"],
        alpha_total_inertial_sd_rad=sd["inertial"],
        clock_lv_rad=lv_clock(flow.body_mps["wind"][:, 1:]),
        lateral_flow_cov=cov["wind"],
        flight_path_angle_rad=_path_angles(v_ned)[1],
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
    u = _or_nan(v_body[:, 0])
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


def _pressure_var(trajectory: Trajectory, flow: _Flow, profile: AtmosphereProfile) -> FloatArray:
    """Relative variance (n,) of dynamic pressure by height, velocity and the sounding's horizontal wind.

    To first order what `derived_with_sd` has; NaN without a trajectory covariance, and at rest.
    """
    if trajectory.covariance is None:
        return np.full(len(flow.altitude_m), np.nan)
    height, speed = flow.altitude_m, _or_nan(flow.airspeed_mps)
    low, high = (np.log(profile.at(height + side * _SLOPE_STEP_M).density_kgpm3) for side in (-1.0, 1.0))
    thinner = (high - low) / (2.0 * _SLOPE_STEP_M)
    if profile.met_m is not None:  # air that was measured where the vehicle was rises with it
        thinner[(height >= profile.met_m[0]) & (height <= profile.met_m[1])] = 0.0
    up, along = -flow.dcm_ned_ecef[:, 2], flow.point_ecef_mps["wind"] / speed[:, None]
    jacobian = np.concatenate([thinner[:, None] * up, 2.0 * along / speed[:, None]], axis=1)
    by_path = np.einsum("ni,nij,nj->n", jacobian, trajectory.covariance[:, :6, :6], jacobian)
    level = 1.0 - np.einsum("ni,ni->n", up, along) ** 2  # of the flow's direction, squared: it alone meets the wind
    return np.asarray(by_path + 4.0 * level * (flow.air.wind_sd_mps / speed) ** 2)


def _path_angles(velocity_ned: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
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
    """All derived quantities (n,), rad and SI; the air meets the point ``arm_body_m`` from the trajectory's.

    Speeds, path angles and headings are those of the trajectory's point, against the air those of the other point.
    """
    path, flow = inputs.trajectory, _flow(inputs, profile, arm_body_m)
    carried = np.cross(path.planet.rate_ecef_radps, path.position_ecef_m)
    along = {
        "inertial": path.velocity_ecef_mps + carried,
        "ground": path.velocity_ecef_mps,
        "wind": flow.point_ecef_mps["wind"],
    }
    out = {"latitude": flow.latitude_rad, "longitude": flow.longitude_rad, "altitude": flow.altitude_m}
    for name in VELOCITIES:
        parts = _path_angles(np.einsum("nij,nj->ni", flow.dcm_ned_ecef, along[name]))
        out |= {f"{what}_{name}": part for what, part in zip(("speed", "path", "heading"), parts, strict=True)}
        out[f"alpha_total_{name}"] = total_angle(flow.body_mps[name])
        out[f"clock_{name}"] = lv_clock(flow.body_mps[name][:, 1:])
    out |= dict(zip(("roll", "pitch", "yaw"), euler_321(flow.dcm_ned_ecef @ flow.dcm_ecef_body), strict=True))
    out |= {"alpha": flow.alpha_rad, "beta": flow.beta_rad, "mach": flow.mach}
    out |= {"temperature": flow.temperature_k, "density": flow.density_kgpm3}
    out["pressure"] = flow.density_kgpm3 * gas_constant(flow.altitude_m, path.planet) * flow.temperature_k
    out["dynamic_pressure"] = flow.dynamic_pressure_pa
    return out


def is_angle(name: str) -> bool:
    """Whether a quantity wraps."""
    return name in ANGLES or name.startswith(("path_", "heading_", "clock_", "alpha_total_"))


def derived_with_sd(
    trajectory: Trajectory, profile: AtmosphereProfile, arm_body_m: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Quantities (n,) and their standard deviations, which carry the trajectory's covariance and the air's errors."""
    assert trajectory.covariance is not None
    n, nothing = len(trajectory.time_s), _as_stated(trajectory)
    value = derived(nothing, profile, arm_body_m)
    air = profile.at(value["altitude"])
    root: FloatArray = np.asarray(np.linalg.cholesky(trajectory.covariance + 1e-18 * np.eye(9)), dtype=np.float64)
    warm = profile.temperature_sd(value["altitude"])
    # derivatives are taken over one sd, of very unsure positions over a part of it: they stay where there is air
    share = np.minimum(1.0, _STEP_M / np.linalg.norm(root[:, :3, :3], axis=(1, 2)))

    def with_path(path: Trajectory) -> FloatArray | float:
        if profile.met_m is None:
            return nothing.higher_m
        low, high = profile.met_m
        higher = earth.geodetic_from_ecef(path.position_ecef_m, path.planet)[2] - value["altitude"]
        return np.where((value["altitude"] >= low) & (value["altitude"] <= high), higher, 0.0)

    def moved(k: int, sign: float) -> dict[str, FloatArray]:
        if k < 9:
            step = sign * share[:, None] * root[:, :, k]
            path = replace(
                trajectory,
                position_ecef_m=trajectory.position_ecef_m + step[:, 0:3],
                velocity_ecef_mps=trajectory.velocity_ecef_mps + step[:, 3:6],
                q_ecef_body=rotations.boxplus(trajectory.q_ecef_body, step[:, 6:9]),
            )
            return derived(replace(nothing, trajectory=path, higher_m=with_path(path)), profile, arm_body_m)
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
            gap = gap / share if k < 9 else gap
            variance[name] += (0.5 * gap) ** 2
    return value, {name: np.sqrt(v) for name, v in variance.items()}

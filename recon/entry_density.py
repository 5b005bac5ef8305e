"""Which density did a vehicle meet whose drag is stated? From the deceleration, without a vehicle file.

    rho = 2 a / (C_A S / m |u|^2),   q = a m / (C_A S)

``a`` is the deceleration along the flow, ``u`` the velocity against the air. In ballistic flight both are those of the
smoothed drivers (`recon.propagation`): ``ln(2 a / |u|^2) = ln(B rho0(h)) + d + c0 sd(h)``, with the smoothed covariance
of place and drivers, so that noise and bias of an accelerometer, trim and wind are all in it. With gyros ``a`` is the
corrected axial reading, averaged over a window, taken to lie along the flow. C_A and mass are stated; what they may err
is one factor of the whole profile.

Pressure is the weight of the air above, and temperature follows from the gas law (Seiff and Kirk 1977)::

    p(h) = p(top) + integral of rho g from h to top,   T = p / (R rho)

from the uppermost row on, whose temperature is the stated atmosphere's; what that errs is gone two scale heights below.
The factor of C_A and mass is in pressure as in density, and not in temperature. Other errors of density and those of
the vertical velocity (the layers' thickness) are taken to be of one sign over all heights in the pressure, and
independent of it in the temperature. Temperature is the mean of that and the stated atmosphere's, by their variances.
Assumed: level surfaces of pressure along the path.

References
----------
A. Seiff, D. B. Kirk, "Structure of the atmosphere of Mars in summer at mid-latitudes", J. Geophys. Res. 82 (1977) 4364.
J. A. Magalhaes, J. T. Schofield, A. Seiff, "Results of the Mars Pathfinder atmospheric structure investigation",
J. Geophys. Res. 104 (1999) 8943.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtri

from flightmodel import earth
from flightmodel.airdata import AirData, air_data
from flightmodel.atmosphere import (
    DENSITY_LENGTH_M,
    SOUNDING_CONSTANT_PART,
    AtmosphereProfile,
    gas_constant,
    profile_from_sounding,
    sound_speed,
    standard_air,
)
from flightmodel.checks import BoolArray, Check, FloatArray, GateError
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory
from recon.problem import Problem
from recon.propagation import Motion
from recon.state import KINEMATIC, States, unpacked

LEAST_KNOWN = 0.5  # fractional sd of density, C_A apart, from which a row is given
# and of the deceleration, an exponential of what is estimated: the second order, half its square, is then a tenth of it
_LEAST_FELT = 0.2
_HALF_WINDOW_S = 0.25  # of an axial reading
_INDEPENDENT_M = 2.0 * DENSITY_LENGTH_M  # thickness of layers in which the stated density errs each by itself
_WAVES = 0.14  # of density over a kilometre or two: waves of 20 K in 140 K, assumed
_SWING = 0.005  # of an axial force, while the vehicle swings by 4 deg; in level flight nothing else changes
_LAYER_M = 250.0  # over which rows are one knot of the atmosphere as flown: a fortieth of Mars's scale height


@dataclass(frozen=True)
class DragHistory:
    """Drag and density information from the deceleration at a trajectory's times (n,).

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


def drag_of_drivers(
    problem: Problem, states: States, triangles: FloatArray, path: Trajectory, about: States
) -> DragHistory:
    """Drag of ballistic flight at the kept nodes, from states at all nodes and packed covariances at the kept ones.

    ``about`` are the states at all nodes about which readings were linearised. The drag is an exponential: where the
    smoother moved its logarithm by ``m`` it took ``1 + m`` for ``exp(m)``, and what that errs is in the sd.
    """
    motion, kept = problem.motion, np.flatnonzero(problem.kept)
    at = states[kept]
    latitude, longitude, height = earth.geodetic_from_ecef(at.position_ecef_m, motion.planet)
    _, wind_north, wind_east, density_sd, wind_sd = motion.air_at(height)
    steeper = np.subtract(*(motion.air_at(height + side * motion.air_step_m)[0] for side in (0.5, -0.5)))
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
    log_drag = _log_drag(motion, at)
    moved = log_drag - _log_drag(motion, about[kept])
    left_out = _spread(np.abs(1.0 - (1.0 + moved) * np.exp(-moved)), height)
    sd, force_sd = (np.hypot(np.sqrt(np.einsum("ni,nij,nj->n", j, covariance, j)), left_out) for j in (by, to_force))
    return DragHistory(log_drag, sd, force_sd)


def _log_drag(motion: Motion, at: States) -> FloatArray:
    """Logarithm (n,) of the drag over the velocity's square."""
    log_density, _, _, density_sd, _ = motion.air_at(earth.geodetic_from_ecef(at.position_ecef_m, motion.planet)[2])
    drivers = at.sensor_errors
    return np.asarray(np.log(motion.drag_m2pkg) + log_density + drivers[:, 0] + drivers[:, 3] * density_sd)


def _spread(error: FloatArray, height_m: FloatArray) -> FloatArray:
    """Errors (n,) with those of their neighbours, which share the density's process, as it decorrelates with height."""
    out, stays = error.copy(), np.exp(-np.abs(np.diff(height_m)) / DENSITY_LENGTH_M)
    for k in range(1, len(out)):
        out[k] = max(out[k], stays[k - 1] * out[k - 1])
    for k in range(len(out) - 2, -1, -1):
        out[k] = max(out[k], stays[k] * out[k + 1])
    return out


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
    speed, speed_var = air.airspeed_mps, _speed_var(path, air)
    with np.errstate(invalid="ignore", divide="ignore"):
        log_drag = np.log(2.0 * mean / speed**2)  # none where it pushes, as noise does in thin air
        own = np.sqrt(force_cov[:, 0, 0] + noise**2) / mean
    return DragHistory(log_drag, np.sqrt(own**2 + 4.0 * speed_var / speed**2), own)


def density_by_drag(telemetry: Telemetry, path: Trajectory, history: DragHistory | None) -> pd.DataFrame:
    """Density, pressure, temperature, dynamic pressure and Mach number as flown, where the deceleration determines it.

    Raises
    ------
    GateError
        ``drag-missing`` where flight.toml states no drag, ``input-missing`` where nothing measures it.
    """
    drag = telemetry.drag
    if drag is None:
        raise GateError("density as flown: state [drag] (c_a, area, mass) or a vehicle in flight.toml", "drag-missing")
    if history is None:
        raise GateError("density as flown: no accelerometer and no ballistic motion", "input-missing")
    profile = profile_from_sounding(telemetry.sounding)
    air = air_data(path, profile, np.zeros(3))
    rho = np.exp(history.log_drag) / drag.area_per_mass_m2pkg(air.mach)
    known = (history.sd < LEAST_KNOWN) & (history.pressure_sd < _LEAST_FELT) & np.isfinite(rho)
    rho, own_sd, sd = rho[known], history.sd[known], np.hypot(history.sd, drag.sd)[known]
    pressure, weight_sd = _weight_of_air(path, air, profile, known, rho, own_sd)
    # the uppermost row's temperature is the stated one, whose error the weight has too
    height, gas = air.altitude_m[known], gas_constant(air.altitude_m[known], path.planet)
    warm_sd = profile.temperature_sd(height)
    temperature, temperature_sd = _mean(
        pressure / (gas * rho), np.hypot(own_sd, weight_sd), air.air.temperature_k[known], warm_sd
    )
    speed, covariance = air.airspeed_mps[known], path.covariance
    assert covariance is not None
    down = _down(air)
    height_sd = np.sqrt(np.einsum("ni,nij,nj->n", down, covariance[:, :3, :3], down))[known]
    mach = speed / sound_speed(height, temperature, path.planet)
    mach_sd = np.hypot(0.5 * temperature_sd / temperature, np.sqrt(_speed_var(path, air))[known] / speed)
    ratio, q = rho / air.air.density_kgpm3[known], 0.5 * rho * speed**2
    return pd.DataFrame(
        {
            "time_s": path.time_s[known],
            "altitude_m": height,
            "altitude_sd_m": height_sd,
            "density_kgpm3": rho,
            "density_sd_kgpm3": rho * sd,
            "density_ratio": ratio,
            "density_ratio_sd": ratio * sd,
            "common_factor_sd": np.full(len(rho), drag.sd),
            "pressure_pa": pressure,
            "pressure_sd_pa": pressure * np.hypot(weight_sd, drag.sd),
            "temperature_k": temperature,
            "temperature_sd_k": temperature_sd,
            "mach": mach,
            "mach_sd": mach * mach_sd,
            "dynamic_pressure_pa": q,
            "dynamic_pressure_sd_pa": q * np.hypot(history.pressure_sd[known], drag.sd),
        }
    )


def _weight_of_air(
    path: Trajectory, air: AirData, profile: AtmosphereProfile, known: BoolArray, rho: FloatArray, own_sd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pressure, Pa, at the known rows (k,) by the weight of the air above, and its fractional sd without C_A's."""
    if not len(rho):
        return rho, rho
    height, planet = air.altitude_m[known], path.planet
    time_s, position, down = path.time_s[known], path.position_ecef_m[known], _down(air)[known]
    spin, covariance = planet.rate_ecef_radps, path.covariance
    assert covariance is not None
    gravity = np.linalg.norm(earth.gravitation(position, planet) - np.cross(spin, np.cross(spin, position)), axis=1)
    sink_sd = np.sqrt(np.einsum("ni,nij,nj->n", down, covariance[known, 3:6, 3:6], down))
    top = int(np.argmax(height))
    warm, warm_sd = air.air.temperature_k[known][top], profile.temperature_sd(height[[top]])[0]
    above = rho[top] * gas_constant(height[top], planet) * warm
    # between two rows density is exponential
    low, high = (rho * gravity)[:-1], (rho * gravity)[1:]
    step = np.log(high / low)
    mean = np.where(np.abs(step) > 1e-6, (high - low) / np.where(step == 0.0, 1.0, step), low)
    thickness = -np.diff(height)
    wrong_m = 0.5 * (own_sd[:-1] + own_sd[1:]) * np.abs(thickness) + 0.5 * (sink_sd[:-1] + sink_sd[1:]) * np.diff(
        time_s
    )
    weight, wrong = (np.concatenate([[0.0], np.cumsum(mean * metres)]) for metres in (thickness, wrong_m))
    pressure = above + weight - weight[top]
    sd = above * np.hypot(own_sd[top], warm_sd / warm) + np.abs(wrong - wrong[top])
    return pressure, sd / pressure


def _mean(
    flown: FloatArray, flown_part: FloatArray, stated: FloatArray, stated_sd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean of two temperatures by their variances, and its sd; of the flown one a fractional sd is given."""
    # of a temperature that is wrong by a factor the sd is that of the stated one's size
    weight = 1.0 / (1.0 + (flown_part * stated / stated_sd) ** 2)
    return weight * flown + (1.0 - weight) * stated, np.sqrt(1.0 - weight) * stated_sd


def density_check(table: pd.DataFrame, stated: AtmosphereProfile, confidence: float) -> Check | None:
    """Check the density by the drag against the stated atmosphere, by the error of both and of the height.

    With neither tracker nor gyros this alone shows a radius for a diameter or a height that is 20 km off.

    Parameters
    ----------
    table : DataFrame
        Of `density_by_drag`.
    stated : AtmosphereProfile
    confidence : float
        Two-sided, of the check.

    Returns
    -------
    Check or None
        None of an empty table.
    """
    if table.empty:
        return None
    height = table["altitude_m"].to_numpy()
    knots = stated.altitude_m
    per_m = np.gradient(np.log(stated.at(knots).density_kgpm3), knots)
    parts = (
        table["density_ratio_sd"] / table["density_ratio"],
        stated.at(height).density_sd,
        table["altitude_sd_m"] * np.interp(height, knots, per_m),
    )
    sd = np.sqrt(sum(part**2 for part in parts))
    layer = _worst_layer(height, np.log(table["density_ratio"]).to_numpy(), np.asarray(sd), confidence)
    found = f"density at {layer.between} is {np.exp(layer.mean):.2g} times the stated atmosphere's"
    return Check.of(
        "sounding-density", "sounding density", layer.away, 0.0, layer.most, f"{found}, within what both may err",
        found,
        advice="the air differed, or mass, area or C_A of [drag], height or speed of the stated state, or the "
        "deceleration are in error", component=f"density at {layer.between}",
    )  # fmt: skip


def temperature_check(table: pd.DataFrame, stated: AtmosphereProfile, confidence: float) -> Check | None:
    """Check the temperature by the weight of the air above against the stated one, by the errors of both.

    It is of another kind than density: a factor of the drag is not in it, but a deceleration that is too small, or rows
    that are missing with their time, leave the vehicle too fast, the air below too thin for what weighs on it, and so
    too hot. C_A may err along the path by as much as in common.

    Parameters
    ----------
    table : DataFrame
        Of `density_by_drag`.
    stated : AtmosphereProfile
    confidence : float
        Two-sided, of the check.

    Returns
    -------
    Check or None
        None of an empty table.
    """
    if table.empty:
        return None
    height = table["altitude_m"].to_numpy()
    flown = table["pressure_pa"] / (gas_constant(height, stated.planet) * table["density_kgpm3"])
    of_density = table["density_sd_kgpm3"] / table["density_kgpm3"]
    of_pressure = table["pressure_sd_pa"] / table["pressure_pa"]
    own = np.sqrt(of_density**2 + of_pressure**2 - table["common_factor_sd"] ** 2)
    usual = stated.at(height).temperature_k
    sd = np.hypot(own * usual, stated.temperature_sd(height))
    layer = _worst_layer(height, (flown - usual).to_numpy(), np.asarray(sd), confidence)
    found = f"temperature by the drag at {layer.between} is {layer.mean:+.0f} K from the stated atmosphere's"
    return Check.of(
        "sounding-temperature", "sounding temperature", layer.away, 0.0, layer.most,
        f"{found}, within what both may err", found,
        advice="check scale and axis of the accelerometer, missing rows with their times, the stated state, and C_A "
        "over Mach number; or the atmosphere differed",
        component=f"temperature at {layer.between}",
    )  # fmt: skip


class _Layer(NamedTuple):
    """Layer in which a profile deviates most: mean deviation, the same over its sd, its limit, and heights as text."""

    mean: float
    away: float
    most: float
    between: str


def _worst_layer(height_m: FloatArray, off: FloatArray, sd: FloatArray, confidence: float) -> _Layer:
    """Layer farthest beyond its limit, of a profile's differences (n,) with their sd.

    The surest layer is chosen before its value is seen, and has all the confidence; it is shared among the others.
    """
    rows = pd.DataFrame({"off": off, "sd": sd})
    layers = rows.groupby(np.floor(height_m / _INDEPENDENT_M)).mean()
    shift = np.abs(layers["off"] / layers["sd"]).to_numpy()
    most = np.full(len(layers), -ndtri(0.5 * (1.0 - confidence) / len(layers)))
    most[int(np.argmin(layers["sd"]))] = -ndtri(0.5 * (1.0 - confidence))
    worst = int(np.argmax(shift / most))
    below = _INDEPENDENT_M * layers.index[worst]
    between = f"{below / 1e3:.0f} to {(below + _INDEPENDENT_M) / 1e3:.0f} km"
    return _Layer(float(layers["off"].iloc[worst]), float(shift[worst]), float(most[worst]), between)


def drag_jump_check(table: pd.DataFrame, stated: AtmosphereProfile, confidence: float) -> Check | None:
    """Check that the density by the drag does not jump, as where a parachute opens or a part separates.

    Means over a second are compared with those two seconds before, or before a gap, since the filter rejects the first
    readings of another drag. What the air may change between the two heights beside the stated density follows from its
    uncertainty, of which the constant part has no share, and a climate's, wider than `_WAVES`, is of the whole profile;
    what the readings scatter, from differences of neighbours. Errors of speed and height are the same at both times.

    Parameters
    ----------
    table : DataFrame
        Of `density_by_drag`.
    stated : AtmosphereProfile
    confidence : float
        Two-sided, of the check.

    Returns
    -------
    Check or None
        None where no two means are two seconds apart or more.
    """
    log_ratio = np.log(table["density_ratio"])
    beside = table["time_s"].diff() < 1.0  # not across a gap
    noise = 0.5 * log_ratio.diff().where(beside) ** 2
    rows = pd.DataFrame({"log_ratio": log_ratio, "height": table["altitude_m"], "noise": noise, "count": 1.0})
    whole = rows.groupby(np.floor(table["time_s"]).astype(int)).agg(
        {"log_ratio": "mean", "height": "mean", "noise": "mean", "count": "sum"}
    )
    # over a few seconds noise is the same, and a parachute inflates within a second or two
    noise = whole["noise"].rolling(11, center=True, min_periods=1).mean() / whole["count"]
    second = whole.index.to_numpy()
    at = np.searchsorted(second, second - 2, side="right") - 1
    last = np.flatnonzero(at >= 0)
    if not len(last):
        return None
    before, after = whole.iloc[at[last]], whole.iloc[last]
    heights = before["height"].to_numpy(), after["height"].to_numpy()
    forgotten = 1.0 - np.exp(-np.abs(heights[1] - heights[0]) / DENSITY_LENGTH_M)
    waves = np.minimum(np.sqrt(1.0 - SOUNDING_CONSTANT_PART) * stated.at(heights[1]).density_sd, _WAVES)
    weather = 2.0 * forgotten * waves**2
    change = after["log_ratio"].to_numpy() - before["log_ratio"].to_numpy()
    jump = change / np.sqrt(weather + _SWING**2 + noise.to_numpy()[last] + noise.to_numpy()[at[last]])
    worst = int(np.argmax(np.abs(jump)))
    when = f"from {before.index[worst]} to {after.index[worst]} s"
    found = f"{np.exp(change[worst]):.2g} times the stated atmosphere's change {when}"
    return Check.of(
        "drag-jump", "density by the drag does not jump", float(np.abs(jump[worst])), 0.0,
        float(-ndtri(0.5 * (1.0 - confidence) / len(last))), f"{found}, as air may", found,
        advice="a parachute opened, a part separated or the reading jumped: leave out what follows by use_s, or state "
        "the drag of each part of the flight by itself", component=when,
    )  # fmt: skip


def profile_as_flown(stated: AtmosphereProfile, table: pd.DataFrame) -> AtmosphereProfile:
    """Stated atmosphere, with as-flown density and temperature where the deceleration gives a smaller density sd.

    Parameters
    ----------
    stated : AtmosphereProfile
    table : DataFrame
        Of `density_by_drag`.
    """
    part = (table["density_ratio_sd"] / table["density_ratio"]).to_numpy()
    better = table[part < stated.at(table["altitude_m"].to_numpy()).density_sd]
    if better.empty:
        return stated
    rows = better.groupby(np.floor(better["altitude_m"] / _LAYER_M)).mean()
    z = rows["altitude_m"].to_numpy()
    beyond = (stated.altitude_m < z[0] - _LAYER_M) | (stated.altitude_m > z[-1] + _LAYER_M)
    knots = np.concatenate([z, stated.altitude_m[beyond]])
    order = np.argsort(knots)
    density, temperature, _ = standard_air(z, stated.planet)

    def joined(flown: FloatArray, own: FloatArray) -> FloatArray:
        return np.concatenate([flown, own[beyond]])[order]

    wind = np.column_stack([np.interp(knots[order], stated.altitude_m, w) for w in stated.wind_ned_mps.T])
    return replace(
        stated,
        altitude_m=knots[order],
        log_density_ratio=joined(np.log(rows["density_kgpm3"].to_numpy() / density), stated.log_density_ratio),
        temperature_offset_k=joined(rows["temperature_k"].to_numpy() - temperature, stated.temperature_offset_k),
        wind_ned_mps=wind,
        density_sd=joined((rows["density_sd_kgpm3"] / rows["density_kgpm3"]).to_numpy(), stated.density_sd),
        wind_sd_mps=np.interp(knots[order], stated.altitude_m, stated.wind_sd_mps),
        temperature_sd_k=joined(rows["temperature_sd_k"].to_numpy(), stated.temperature_sd(stated.altitude_m)),
        met_m=(float(better["altitude_m"].min()), float(better["altitude_m"].max())),
    )


def _down(air: AirData) -> FloatArray:
    """Direction (n, 3) of the local vertical, ECEF axes."""
    return np.asarray(earth.dcm_ned_ecef(air.latitude_rad, air.longitude_rad)[:, 2])


def _speed_var(path: Trajectory, air: AirData) -> FloatArray:
    """Variance (n,) of the speed against the air, (m/s)^2."""
    assert path.covariance is not None
    unit = path.velocity_ecef_mps / np.linalg.norm(path.velocity_ecef_mps, axis=1)[:, None]
    return np.asarray(np.einsum("ni,nij,nj->n", unit, path.covariance[:, 3:6, 3:6], unit) + air.air.wind_sd_mps**2)

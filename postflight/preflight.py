"""What a rigid vehicle would have done: the pre-flight view that the flight is held against (seed paper Figure 1.3).

The vehicle with its joint locked is flown many times from the reconstructed state above the atmosphere, with mass
properties, coefficients, damping, density, winds and start attitude dispersed by their pre-flight uncertainty. Unlike
a true pre-flight study it does not disperse the launch, so its bands are about this flight's own entry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from flightmodel import rotations
from flightmodel.atmosphere import AtmosphereProfile, profile_from_sounding
from flightmodel.checks import FloatArray, GateError
from flightmodel.trajectory import resample
from flightmodel.vehicle import Vehicle
from postflight.pipeline import Flight
from synthetic_flight import packing
from synthetic_flight.day_air import correlated
from synthetic_flight.simulate import integrate, state_from_ecef

START_ALTITUDE_M = 100e3
# the rigid vehicle's fastest motion is its pitch at 1 Hz; fourth-order steps of 10 ms hold it to 1e-6
STEP_S, RECORD_S, SPAN_S = 0.01, 0.05, 70.0
PERCENTILES = (2.3, 50.0, 97.7)
CMQ_SD = 0.15


@dataclass(frozen=True)
class RigidBounds:
    """Percentile bands ``(3, n)`` of a rigid vehicle, and the nominal flight ``(n,)``."""

    time_s: FloatArray
    alpha_total_deg: FloatArray
    normal_g: FloatArray
    nominal_alpha_deg: FloatArray
    nominal_normal_g: FloatArray
    flights: int

    def table(self) -> pd.DataFrame:
        """Return the bands as columns, for ``rigid_bounds.csv``."""
        columns: dict[str, FloatArray] = {"t_s": self.time_s}
        for name, unit, bands, nominal in (
            ("alpha_total", "deg", self.alpha_total_deg, self.nominal_alpha_deg),
            ("normal", "g", self.normal_g, self.nominal_normal_g),
        ):
            columns |= {f"{name}_{part}_{unit}": c for part, c in zip(("low", "median", "high"), bands, strict=True)}
            columns[f"{name}_nominal_{unit}"] = nominal
        return pd.DataFrame(columns).assign(flights=self.flights)


def rigid_bounds(
    flight: Flight, flights: int = 100, seed: int = 0, progress: Callable[[float, str], None] | None = None
) -> RigidBounds:
    """Fly the rigid vehicle ``flights`` times; run ``k`` is the same flight whatever the number."""
    report = progress or (lambda _fraction, _what: None)
    air = flight.air
    below = np.flatnonzero((air.altitude_m < START_ALTITUDE_M) & (air.flight_path_angle_rad < 0.0))
    if not len(below):
        raise GateError("pre-flight bounds: the reconstruction never comes below 100 km")
    start_s = float(air.time_s[below[0]])
    vehicle, profile = flight.telemetry.required_vehicle(), profile_from_sounding(flight.telemetry.sounding)
    records = round(min(SPAN_S, air.time_s[-1] - start_s) / RECORD_S)
    alpha, normal = np.full((flights, records), np.nan), np.full((flights, records), np.nan)
    nominal = _fly(flight, vehicle, profile, start_s, records, np.zeros(3))
    for k in range(flights):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(k,)))
        turn = rng.standard_normal(3) * _attitude_sd(flight, start_s)
        alpha[k], normal[k] = _fly(flight, _disperse(vehicle, rng), _disperse_air(profile, rng), start_s, records, turn)
        report((k + 1) / flights, f"rigid flight {k + 1} of {flights}")
    return RigidBounds(
        time_s=start_s + RECORD_S * np.arange(records),
        alpha_total_deg=np.nanpercentile(alpha, PERCENTILES, axis=0),
        normal_g=np.nanpercentile(normal, PERCENTILES, axis=0),
        nominal_alpha_deg=nominal[0],
        nominal_normal_g=nominal[1],
        flights=flights,
    )


def _attitude_sd(flight: Flight, at_s: float) -> FloatArray:
    sd = resample(flight.reconstruction.smoothed, np.array([at_s])).sd()[0, 6:9]
    return np.asarray(sd)


def _fly(
    flight: Flight, vehicle: Vehicle, profile: AtmosphereProfile, start_s: float, records: int, turn_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Total angle of attack, deg, and normal acceleration, g, of one rigid flight."""
    start = resample(flight.reconstruction.smoothed, np.array([start_s]))
    q = rotations.boxplus(start.q_ecef_body[0], turn_rad)
    arm = rotations.rotate(q, vehicle.cg_m)
    omega = start.omega_body_eci_body_radps[0]
    state = state_from_ecef(start_s, start.position_ecef_m[0] + arm, start.velocity_ecef_mps[0], q, omega)
    per_record = round(RECORD_S / STEP_S)
    states, aux = integrate(vehicle, packing.atmosphere_table(profile), state, STEP_S, per_record, records, records)
    force_body = rotations.rotate(rotations.conjugate(states[:, 6:10]), aux[:, 12:15])
    out = np.full((2, records), np.nan)
    out[0, : len(aux)] = np.rad2deg(aux[:, 4])
    out[1, : len(aux)] = np.hypot(force_body[:, 1], force_body[:, 2]) / vehicle.mass_kg / 9.80665
    return out[0], out[1]


def _disperse(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    known, body, shell = vehicle.uncertainty, vehicle.centerbody, vehicle.aeroshell
    g = rng.standard_normal(9)
    heavier, stiffer = 1.0 + known.mass * g[0], 1.0 + known.inertia * g[1]
    shift = np.array([known.cg_station_m * g[2], known.cg_lateral_m * g[3], known.cg_lateral_m * g[4]])
    # the whole vehicle's c.g. is known to that; the centerbody carries it
    moved = body.cg_m + shift * vehicle.mass_kg / body.mass_kg
    return replace(
        vehicle,
        aero=vehicle.aero.scaled(1 + known.ca * g[5], 1 + known.cn * g[6], 1 + known.cm * g[7], CMQ_SD * g[8]),
        centerbody=body.model_copy(
            update={
                "mass_kg": body.mass_kg * heavier,
                "cg_from_datum_body_m": tuple(moved),
                "inertia_kgm2": tuple(map(tuple, body.inertia * stiffer)),
            }
        ),
        aeroshell=shell.model_copy(update={"mass_kg": shell.mass_kg * heavier}),
    )


def _disperse_air(profile: AtmosphereProfile, rng: np.random.Generator) -> AtmosphereProfile:
    z = profile.altitude_m
    wind = profile.wind_ned_mps.copy()
    for axis in (0, 1):
        wind[:, axis] += profile.wind_sd_mps * correlated(z, 3000.0, rng)
    ratio = profile.log_density_ratio + profile.density_sd * correlated(z, 5000.0, rng)
    return replace(profile, log_density_ratio=ratio, wind_ned_mps=wind)

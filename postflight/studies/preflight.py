"""Which bands did the pre-flight uncertainty predict for the flight's angle of attack and normal acceleration?

The vehicle is flown many times from the reconstructed state above the atmosphere, with mass properties, coefficients,
damping, density, winds and start attitude dispersed by their pre-flight uncertainty; the bands are percentiles of the
histories (2.3, 50, 97.7 %). The joint is locked, as before the paper's reconciliation, or flexible and dispersed, as
after it. Unlike a true pre-flight study (`postflight montecarlo`) the launch is not dispersed: the bands are about this
flight's own entry.

References
----------
Bose et al., AIAA 2011-2571, Figure 1.3.

What of a reconciliation does not need the fit? The second process does it, and loads nothing else for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from flightmodel import rotations
from flightmodel.airdata import pressure_pulse
from flightmodel.atmosphere import AtmosphereProfile, profile_from_sounding
from flightmodel.checks import FloatArray, GateError, Progress
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.statistics import inside, percentile_band
from flightmodel.tables import column_about
from flightmodel.trajectory import resample
from flightmodel.vehicle import Uncertainty, Vehicle
from postflight.deflections import fused_history
from postflight.reconstruction import Reconstruction, fastest_radps
from synthetic_flight import simulate
from synthetic_flight.dispersions import (
    AeroDispersions,
    Dispersions,
    Factor,
    JointDispersions,
    MassDispersions,
    Shift,
    dispersed_scales,
    dispersed_vehicle,
    draw_one,
    draws,
    rng_from_draw,
)
from synthetic_flight.dynamics import check_step, resolving_step_s
from synthetic_flight.ensemble import LANES, Flown, Records, Start, fly_ensemble
from synthetic_flight.simulate import Schedule, state_from_ecef
from synthetic_flight.weather import correlated

START_ALTITUDE_M = 100e3
RECORD_S, SPAN_S = 0.05, 70.0
# up to 30 km above the start: no entry climbs so far, and blocks of flights have tables of their own
AIR_ROWS = int((START_ALTITUDE_M + 30e3 - simulate.ATMOSPHERE_START_M) / simulate.ATMOSPHERE_STEP_M) + 1
# steps of a slow vehicle; of a faster one so many that it turns by `STEP_RAD` in each: fourth-order steps then err by
# 1e-6 rad
STEP_RAD = 0.15
ENTRIES = 300


@dataclass(frozen=True)
class Bounds:
    """Percentile bands ``(3, n)`` of dispersed entries, and the nominal history ``(n,)``.

    ``ended`` of ``flights`` ended early, their deflection or angle of attack beyond 90 deg: a vehicle that tumbles with
    a C_mq above zero would turn ever faster. They hold their last value from there on.
    """

    time_s: FloatArray
    alpha_total_deg: FloatArray
    normal_g: FloatArray
    nominal_alpha_deg: FloatArray
    nominal_normal_g: FloatArray
    flights: int
    ended: int = 0

    @property
    def by_quantity(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Bands ``(3, n)`` and nominal history ``(n,)`` of each quantity."""
        return {
            "alpha_total_deg": (self.alpha_total_deg, self.nominal_alpha_deg),
            "normal_g": (self.normal_g, self.nominal_normal_g),
        }

    def table(self) -> pd.DataFrame:
        """Return the bands as columns, for ``rigid_bounds.csv``."""
        columns: dict[str, FloatArray] = {"t_s": self.time_s}
        for quantity, (bands, nominal) in self.by_quantity.items():
            for part, values in zip(("low", "median", "high", "nominal"), (*bands, nominal), strict=True):
                columns[column_about(quantity, part)] = values
        return pd.DataFrame(columns).assign(flights=self.flights)


def bounds_of(table: pd.DataFrame) -> Bounds:
    """Bounds from their columns in ``rigid_bounds.csv``."""
    angle, force = (
        [table[column_about(quantity, part)].to_numpy(dtype=float) for part in ("low", "median", "high", "nominal")]
        for quantity in ("alpha_total_deg", "normal_g")
    )
    bands = np.array(angle[:3]), np.array(force[:3])
    return Bounds(table["t_s"].to_numpy(dtype=float), *bands, angle[3], force[3], int(table["flights"].iloc[0]))


def dispersions_of(stated: Uncertainty, joint: JointDispersions | None) -> Dispersions:
    """Dispersions that a vehicle file states; with a flexible joint where those of the joint are given."""

    mass, inertia = Factor(normal=stated.mass), Factor(normal=stated.inertia)
    station, lateral = Shift(normal=stated.cg_station_m), Shift(normal=stated.cg_lateral_m)
    return Dispersions(
        joint_is="locked" if joint is None else "flexible",
        mass=MassDispersions(
            aeroshell_mass=mass, aeroshell_inertia=inertia, aeroshell_cg_station_m=station,
            centerbody_mass=mass, centerbody_inertia=inertia, centerbody_cg_station_m=station,
            offset_y_m=lateral, offset_z_m=lateral,
        ),
        aerodynamics=AeroDispersions(
            ca=Factor(normal=stated.ca), cn=Factor(normal=stated.cn), cm=Factor(normal=stated.cm),
            cmq=Shift(normal=stated.cmq),
        ),
        joint=joint or JointDispersions(),
    )  # fmt: skip


def entry_bounds(
    flight: Reconstruction,
    joint: JointDispersions | None,
    flights: int = 100,
    seed: int = 0,
    progress: Progress | None = None,
    vehicle: Vehicle | None = None,
) -> Bounds:
    """Fly the flight's own entry ``flights`` times; run ``k`` is the same flight whatever their number.

    Parameters
    ----------
    flight : Flight
        With a vehicle; its reconstruction gives the start, its sounding the air.
    joint : JointDispersions or None
        Dispersions of the joint; None locks it.
    vehicle : Vehicle, optional
        Flown instead of the flight's own, such as a reconciled one.

    Raises
    ------
    GateError
        Where the reconstruction never comes below 100 km, or a draw cannot fly.
    """
    report = progress or (lambda _fraction, _what: None)
    entry = _Entry(flight, vehicle or flight.telemetry.required_vehicle().at(flight.peak_s), joint)
    alpha, normal = np.empty((2, 1 + flights, entry.records))  # the nominal flight first
    ended = 0
    what = "rigid" if joint is None else "flexible"
    for k, found in enumerate(entry.fly([None, *((seed, run) for run in range(flights))])):
        alpha[k], normal[k], diverged = found
        ended += diverged and k > 0
        if k % LANES == 0 or k == flights:
            report(k / flights, f"{what} flight {k} of {flights}")
    time_s = entry.start_s + RECORD_S * np.arange(entry.records)
    return Bounds(time_s, percentile_band(alpha[1:]), percentile_band(normal[1:]), alpha[0], normal[0], flights, ended)


class _Entry:
    """The entry of one flight, ready to be flown from dispersed starts."""

    def __init__(self, flight: Reconstruction, vehicle: Vehicle, joint: JointDispersions | None) -> None:
        air = flight.air
        below = np.flatnonzero((air.altitude_m < START_ALTITUDE_M) & (air.flight_path_angle_rad < 0.0))
        if not len(below):
            raise GateError("pre-flight bounds: the reconstruction never comes below 100 km", code="time-not-covered")
        self.start_s = float(air.time_s[below[0]])
        pulse_end_s = float(air.time_s[np.flatnonzero(pressure_pulse(air.dynamic_pressure_pa))[-1]])
        span = max(SPAN_S, pulse_end_s - self.start_s)
        self.records = round(min(span, air.time_s[-1] - self.start_s) / RECORD_S)
        self.vehicle, self.locked = vehicle, joint is None
        self.dispersions = dispersions_of(vehicle.uncertainty, joint)
        self.profile = profile_from_sounding(flight.telemetry.sounding)
        self.at_start = resample(flight.solution.smoothed, np.array([self.start_s]))
        turning_radps = fastest_radps(vehicle, flight.solution, air)
        steps = 3 if self.locked else round(RECORD_S / min(0.005, resolving_step_s(vehicle)))
        steps = max(steps, int(np.ceil(RECORD_S * turning_radps / STEP_RAD)))
        self.schedule = Schedule(RECORD_S / steps, steps, self.records, self.records if self.locked else 0)

    def start(self, run: tuple[int, int] | None) -> tuple[Start, Vehicle]:
        """Start and vehicle of one run, given as seed and number; None is the nominal one."""
        vehicle, scales, profile, rotation = self.vehicle, (1.0, 1.0, 1.0, 0.0), self.profile, np.zeros(3)
        if run is not None:
            u = draws(self.dispersions, *run)
            deviation = {name: law.at(u[name]) for name, law in self.dispersions.factors().items() if law is not None}
            vehicle = dispersed_vehicle(self.vehicle, lambda name: deviation.get(name, 0.0))
            scales = dispersed_scales(lambda name: deviation.get(name, 0.0))
            profile = _dispersed_atmosphere(self.profile, rng_from_draw(draw_one(*run, "sounding")))
            attitude = rng_from_draw(draw_one(*run, "attitude")).standard_normal(3)
            rotation = attitude * self.at_start.sd()[0, 6:9]
        if not self.locked:
            check_step(vehicle, self.schedule.step_s)
        q = rotations.boxplus(self.at_start.q_ecef_body[0], rotation)
        position = self.at_start.position_ecef_m[0] + rotations.rotate(q, vehicle.cg_m)
        velocity, omega = self.at_start.velocity_ecef_mps[0], self.at_start.omega_body_eci_body_radps[0]
        state = state_from_ecef(self.start_s, position, velocity, q, omega)
        parameters = simulate.parameter_vector(vehicle, *scales)
        return Start(state, parameters, simulate.atmosphere_table(profile)[:AIR_ROWS].copy()), vehicle

    def fly(self, runs: list[tuple[int, int] | None]) -> Iterator[tuple[FloatArray, FloatArray, bool]]:
        """Centerbody's total angle of attack, deg, normal acceleration, g, and whether it ended early, of each run."""
        begun: dict[int, tuple[Start, Vehicle]] = {}

        def start_of(k: int) -> Start:
            begun[k] = self.start(runs[k])
            return begun[k][0]

        for flown in fly_ensemble(self.vehicle, start_of, range(len(runs)), self.schedule):
            yield self._kept(flown, *begun.pop(flown.run))

    def _kept(self, flown: Flown, start: Start, vehicle: Vehicle) -> tuple[FloatArray, FloatArray, bool]:
        if not len(flown.aux):
            message = "pre-flight bounds: a flight has no record; the reconstruction's state at 100 km cannot be flown"
            raise GateError(message, code="too-few-data")
        records = Records(flown.states, flown.aux, vehicle, start.atmosphere)
        tumbling = (records.alpha_total_deg > np.rad2deg(simulate.TUMBLE_RAD)) & (flown.aux[:, 3] > simulate.AIR_PA)
        last = int(np.argmax(tumbling)) if tumbling.any() else len(flown.aux) - 1
        rows = np.minimum(np.arange(self.records), last)
        return records.alpha_total_deg[rows], records.normal_g[rows], flown.diverged or bool(tumbling.any())


def _dispersed_atmosphere(profile: AtmosphereProfile, rng: np.random.Generator) -> AtmosphereProfile:
    z = profile.altitude_m
    wind = profile.wind_ned_mps.copy()
    for axis in (0, 1):
        wind[:, axis] += profile.wind_sd_mps * correlated(z, 3000.0, rng)
    ratio = profile.log_density_ratio + profile.density_sd * correlated(z, 5000.0, rng)
    return replace(profile, log_density_ratio=ratio, wind_ned_mps=wind)


def without_fit(flight: Reconstruction, camera: DeflectionHistory | None) -> tuple[DeflectionHistory | None, Bounds]:
    """Fused deflection, with what the camera reads without a trajectory, and bands of entries with the joint locked."""
    return fused_history(flight, camera), entry_bounds(flight, None, ENTRIES)


# the flight against the bands


def pulse_columns(flight: Reconstruction) -> pd.DataFrame:
    """The flight's own columns ``time_s, alpha_total_deg, normal_g``, at the times of its loads."""
    pulse = flight.required_loads()
    alpha_deg = np.rad2deg(np.interp(pulse.time_s, flight.air.time_s, flight.air.alpha_total_wind_rad))
    normal_g = np.hypot(*pulse.specific_force_body_mps2[:, 1:].T) / STANDARD_GRAVITY_MPS2
    return pd.DataFrame({"time_s": pulse.time_s, "alpha_total_deg": alpha_deg, "normal_g": normal_g})


def shares(flight: Reconstruction, rigid: Bounds, flexible: Bounds) -> pd.DataFrame:
    """Share of the pulse's samples between the outer percentiles, by joint and quantity; excess of the others.

    Columns ``joint, quantity, share_inside, largest_excess`` (over the upper percentile, in the quantity's unit); where
    the flight has its peak, ``over_median_at_peak`` and ``peak_over_upper`` (a ratio); ``diverged`` flights.
    """
    flown = pulse_columns(flight)
    rows = flown[flown["time_s"].between(*flight.pulse_s)]
    if rows.empty:
        raise GateError("pre-flight bounds: the flight has no sample in its pulse", code="time-not-covered")
    time_s, out = rows["time_s"].to_numpy(), []
    for joint, bounds in (("rigid", rigid), ("flexible", flexible)):
        for quantity, (band, _) in bounds.by_quantity.items():
            values = rows[quantity].to_numpy()
            at = int(np.argmax(values))
            middle, upper = (np.interp(time_s, bounds.time_s, band[k]) for k in (1, 2))
            out.append(
                {
                    "joint": joint,
                    "quantity": quantity,
                    "share_inside": float(np.mean(inside(time_s, values, bounds.time_s, band[0], band[2]))),
                    "largest_excess": float(np.max(values - upper)),
                    "over_median_at_peak": float(values[at] - middle[at]),
                    "peak_over_upper": float(values[at] / upper[at]),
                    "diverged": bounds.ended,
                }
            )
    return pd.DataFrame(out)

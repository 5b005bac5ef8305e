"""What is kept of a flight of an ensemble: named histories over its window, and named numbers.

``peak_X`` is the largest sample of the quantity X in the window, ``X_at_peak_pressure`` its sample where dynamic
pressure is largest. Angles are degrees and accelerations g, since these numbers are for files and figures. A joint that
diverges ends its flight: histories hold their last value from there on, so that bands do not forget that flight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flightmodel import earth, rotations
from flightmodel.airdata import total_angle
from flightmodel.checks import ConfigError, FloatArray, GateError, nearest_name
from flightmodel.vehicle import Vehicle
from synthetic_flight import dynamics
from synthetic_flight.dispersions import Window
from synthetic_flight.ensemble import Flown
from synthetic_flight.packing import ATMOSPHERE_ROWS, ATMOSPHERE_START_M, ATMOSPHERE_STEP_M

G0_MPS2 = 9.80665
_TABLE_M = ATMOSPHERE_START_M + ATMOSPHERE_STEP_M * np.arange(ATMOSPHERE_ROWS)


@dataclass(frozen=True)
class Records:
    """One flown flight: ``states`` (n, 20), ``aux`` (n, 18), its vehicle and its table of the air."""

    states: FloatArray
    aux: FloatArray
    vehicle: Vehicle
    atmosphere: FloatArray

    @cached_property
    def specific_force_body_mps2(self) -> FloatArray:
        """Of the centerbody's point where the unbent vehicle's c.g. is, ``(n, 3)``, body axes.

        The joint's force moved there by lever arms; the difference of gravitation over half a metre (1e-6 m/s^2) is
        left out.
        """
        body = self.vehicle.centerbody
        arm, rate, turn = self.vehicle.cg_m - body.cg_m, self.states[:, 14:17], self.aux[:, 15:18]
        force = rotations.rotate(rotations.conjugate(self.states[:, 6:10]), self.aux[:, 6:9])
        return force / body.mass_kg + np.cross(turn, arm) + np.cross(rate, np.cross(rate, arm))

    @cached_property
    def velocity_air_body_mps(self) -> FloatArray:
        """Velocity of that point relative to the air, ``(n, 3)``, body axes."""
        q, rate = self.states[:, 6:10], self.states[:, 14:17]
        position, velocity = dynamics.points(self.states, self.vehicle)["body"]
        arm = self.vehicle.cg_m - self.vehicle.centerbody.cg_m
        at = position + rotations.rotate(q, np.broadcast_to(arm, position.shape))
        velocity = velocity + rotations.rotate(q, np.cross(rate, arm)) - np.cross(earth.OMEGA_ECEF_RADPS, at)
        # ECI turned about the Earth's axis alone: latitude is right, and north and east at this longitude of ECI
        latitude, longitude, _ = earth.geodetic_from_ecef(at)
        wind = np.zeros_like(velocity)
        for axis in (0, 1):
            wind[:, axis] = np.interp(self.aux[:, 0], _TABLE_M, self.atmosphere[:, 3 + axis])
        wind_eci = np.einsum("nji,nj->ni", earth.dcm_ned_ecef(latitude, longitude), wind)
        return rotations.rotate(rotations.conjugate(q), velocity - wind_eci)

    @cached_property
    def alpha_total_deg(self) -> FloatArray:
        """Centerbody's total angle of attack, wind-relative, ``(n,)``."""
        return np.rad2deg(total_angle(self.velocity_air_body_mps))

    @cached_property
    def normal_g(self) -> FloatArray:
        """Size of the centerbody's lateral specific force, ``(n,)``."""
        return np.hypot(*self.specific_force_body_mps2[:, 1:].T) / G0_MPS2


QUANTITIES: dict[str, Callable[[Records], FloatArray]] = {
    "alpha_total_deg": lambda r: r.alpha_total_deg,
    "alpha_shell_deg": lambda r: np.rad2deg(r.aux[:, 4]),
    "deflection_deg": lambda r: np.rad2deg(r.aux[:, 5]),
    "normal_g": lambda r: r.normal_g,
    "axial_g": lambda r: -r.specific_force_body_mps2[:, 0] / G0_MPS2,
    "dynamic_pressure_pa": lambda r: r.aux[:, 3],
    "mach": lambda r: r.aux[:, 2],
    "altitude_m": lambda r: r.aux[:, 0],
    "rate_degps": lambda r: np.rad2deg(np.linalg.norm(r.states[:, 15:17], axis=1)),
}
PEAK_TIME = "peak_pressure_s"
SCALARS = (
    PEAK_TIME,
    *(f"peak_{name}" for name in QUANTITIES),
    *(f"{name}_at_peak_pressure" for name in QUANTITIES),
)


def check_names(names: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Raise `ConfigError` with every name that is unknown or comes twice."""
    faults = [f"unknown output '{n}'{nearest_name(n, known)}; known: {', '.join(known)}" for n in names
              if n not in known]  # fmt: skip
    faults += [f"output '{n}' comes twice" for n in dict.fromkeys(names) if names.count(n) > 1]
    if faults:
        raise ConfigError(faults)


def scalars_of(records: Records, names: tuple[str, ...], window: Window) -> dict[str, float]:
    """Return the named numbers of one flight."""
    at_peak = int(np.argmax(records.aux[:, 3]))
    found = {}
    for name in names:
        if name == PEAK_TIME:
            found[name] = window.from_s + window.record_s * at_peak
        elif name.startswith("peak_"):
            found[name] = float(QUANTITIES[name.removeprefix("peak_")](records).max())
        else:
            found[name] = float(QUANTITIES[name.removesuffix("_at_peak_pressure")](records)[at_peak])
    return found


def histories_of(records: Records, names: tuple[str, ...], window: Window) -> FloatArray:
    """Return the named histories of one flight, ``(names, points)``."""
    points = len(window.history_time_s())
    rows = np.minimum(window.per_history * np.arange(points), len(records.aux) - 1)
    return np.stack([QUANTITIES[name](records)[rows] for name in names]) if names else np.empty((0, points))


def records_of(flown: Flown, vehicle: Vehicle, atmosphere: FloatArray) -> Records:
    """Return what a flight recorded; `GateError` where it did not reach its window."""
    if not len(flown.aux):
        raise GateError("the joint diverged, or the state was no number any more, before the window")
    return Records(flown.states, flown.aux, vehicle, atmosphere)

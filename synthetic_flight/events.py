"""What happened when: the moments a flight is told by, each with the true state of the vehicle, from the records.

Separation (the first record), inflation (the joint unlocks), apogee, 80 km, peak heating, Mach 3.5, peak dynamic
pressure, 40 km, Mach 1, splashdown; those that the flown span does not hold are absent. Heating is the stagnation
point's by Sutton and Graves, ``1.7415e-4 sqrt(rho / r_nose) V^3`` W/m^2 with the vehicle's own nose radius.

References
----------
Sutton and Graves, "A general stagnation-point convective-heating equation for arbitrary gas mixtures", NASA TR R-376.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flightmodel import earth, moments
from flightmodel.atmosphere import G0_MPS2
from flightmodel.checks import FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from synthetic_flight.simulate import Truth

SUTTON_GRAVES = 1.7415e-4


@dataclass(frozen=True)
class Event:
    """A moment of the flight and the true state at it.

    Altitude, Mach number and dynamic pressure are those at the shell's nose, place and velocity (relative to the
    rotating Earth) those of the datum; angles of attack are total and against the wind; ``sensed_g`` is the size of
    the specific force at the vehicle's unbent c.g., in standard gravities.
    """

    name: str
    time_s: float
    altitude_m: float
    latitude_rad: float
    longitude_rad: float
    speed_mps: float
    flight_path_rad: float
    airspeed_mps: float
    mach: float
    dynamic_pressure_pa: float
    heat_flux_wpm2: float
    alpha_shell_rad: float
    alpha_body_rad: float
    deflection_rad: float
    sensed_g: float


def heat_flux(density_kgpm3: FloatArray, airspeed_mps: FloatArray, nose_radius_m: float) -> FloatArray:
    """Stagnation-point convective heat flux of a cold wall, W/m^2 (Sutton and Graves)."""
    return SUTTON_GRAVES * np.sqrt(density_kgpm3 / nose_radius_m) * airspeed_mps**3


def flight_events(truth: Truth, inflated_s: float | None = None) -> list[Event]:
    """Events of a flight in order of time.

    Parameters
    ----------
    truth : Truth
    inflated_s : float or None
        When the joint was unlocked; no inflation is named without it.
    """
    whole = moments.splashdown_index(truth.altitude_m)
    rows = slice(0, whole)
    t, altitude = truth.time_s[rows], truth.altitude_m[rows]
    density, pressure = truth.density_kgpm3[rows], truth.dynamic_pressure_pa[rows]
    airspeed = np.sqrt(2.0 * pressure / density)
    flux = heat_flux(density, airspeed, truth.vehicle.geometry.nose_radius_m)
    named = [("separation", float(t[0])), *moments.descent_moments(t, altitude, truth.mach[rows])]
    if inflated_s is not None and t[0] < inflated_s < t[-1]:
        named.append(("inflation", inflated_s))
    for name, values in (("peak heating", flux), ("peak dynamic pressure", pressure)):
        if moments.has_peak(values):
            named.append((name, moments.peak(t, values)[0]))
    if whole is not None:
        splash = moments.first_fall(t, altitude, 0.0)
        named.append(("splashdown", float(t[-1]) if splash is None else splash))
    force = truth.specific_force_body(truth.vehicle.cg_m)[rows]
    columns = np.column_stack(
        [
            altitude,
            truth.trajectory.position_ecef_m[rows],
            truth.trajectory.velocity_ecef_mps[rows],
            airspeed,
            truth.mach[rows],
            pressure,
            flux,
            truth.alpha_shell_rad[rows],
            truth.alpha_body_rad[rows],
            truth.deflection.theta_rad[rows],
            np.linalg.norm(force, axis=1) / G0_MPS2,
        ]
    )
    return [_event(name, at, moments.values_at(t, columns, at)) for name, at in sorted(named, key=lambda one: one[1])]


def _event(name: str, at_s: float, state: FloatArray) -> Event:
    place, velocity = state[1:4], state[4:7]
    latitude, longitude, _ = earth.geodetic_from_ecef(place)
    north, east, down = earth.ned_from_ecef(velocity, place)
    # angles and force have no sign: a cubic through a touch of zero may pass below it
    sizes = [float(x) for x in (*state[7:11], *np.maximum(state[11:], 0.0))]
    path = float(np.arctan2(-down, np.hypot(north, east)))
    speed = float(np.linalg.norm(velocity))
    return Event(name, at_s, float(state[0]), float(latitude), float(longitude), speed, path, *sizes)


def event_table(events: list[Event]) -> pd.DataFrame:
    """Events as a table with angles in degrees, as ``truth/events.csv`` holds it."""
    rows = [
        {
            "event": e.name,
            "t_s": e.time_s,
            "alt_m": e.altitude_m,
            "lat_deg": np.rad2deg(e.latitude_rad),
            "lon_deg": np.rad2deg(e.longitude_rad),
            "speed_ground_mps": e.speed_mps,
            "flight_path_deg": np.rad2deg(e.flight_path_rad),
            "airspeed_mps": e.airspeed_mps,
            "mach": e.mach,
            "dynamic_pressure_pa": e.dynamic_pressure_pa,
            "heat_flux_wpm2": e.heat_flux_wpm2,
            "alpha_shell_deg": np.rad2deg(e.alpha_shell_rad),
            "alpha_body_deg": np.rad2deg(e.alpha_body_rad),
            "deflection_deg": np.rad2deg(e.deflection_rad),
            "sensed_g": e.sensed_g,
        }
        for e in events
    ]
    import pandas as pd

    return pd.DataFrame(rows)

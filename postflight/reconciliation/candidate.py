"""A vehicle and its air as they might have been.

Physical unknowns are the joint's (stiffness, damping, freeplay and hardening where asked for), the side and size of the
c.g.'s offset and the static stability. All else that the motion depends on and that is known only so well is carried
along, so that the answer's uncertainty holds it: masses, stations, inertias, the other coefficients, the instruments'
constant errors, and the air. Unknowns of vehicle and instruments are counted in standard deviations of what was known
before; those of the air are the density's log ratio and the winds' difference, m/s, to the sounding, at knots along
altitude.

What a simulated flight is held against: corrected inertial sensors over windows, in short spans.

Rates and specific force at the accelerometer are what the joint's motion was felt by; angle of attack and normal
acceleration follow from them, from the attitude and from the air. Deflections by misalignment and trim are made of the
same sensors and would count them twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flightmodel.atmosphere import (
    DENSITY_LENGTH_M,
    WIND_LENGTH_M,
    profile_from_sounding,
    sounding_correlation,
    unresolved_variance,
)
from flightmodel.checks import FloatArray, GateError
from flightmodel.instruments import TriadSpec
from flightmodel.rotations import skew
from flightmodel.telemetry import Sounding
from flightmodel.trajectory import Trajectory, resample
from flightmodel.vehicle import MassProperties, Uncertainty, Vehicle
from postflight.loads import sensed, whole_windows
from postflight.reconstruction import Reconstruction
from synthetic_flight import simulate

# at 1200 m/s a tenth of a second: gusts at the joint's own 2 to 4 Hz are the knots', not noise; coarser in thin air
KNOT_M, UPPER_KNOT_M = 125.0, 250.0
UPPER_M, TOP_M, BELOW_M = 75e3, 105e3, 1e3
# priors before the flight speaks, one standard deviation: factors as logarithms
STIFFNESS_LOG_SD, DAMPING_LOG_SD, OFFSET_SD_M = 0.5, 1.0, 0.005
FREEPLAY_SD_RAD, HARDENING_SD = np.deg2rad(0.5), 1.0
# hardening is counted as the share by which the tangent stiffness has grown at this angle; negative: it softens
HARDENING_AT_RAD = np.deg2rad(4.0)
JOINT = ("stiffness", "damping", "offset y", "offset z", "static stability")
LAWS = ("freeplay", "hardening")
CARRIED = (
    "C_A", "C_N", "C_mq", "mass of the shell", "mass of the centerbody", "station of the shell's c.g.",
    "station of the centerbody's c.g.", "shell's c.g. y", "shell's c.g. z", "inertia of the shell",
    "inertia of the centerbody",
)  # fmt: skip


@dataclass(frozen=True)
class VehicleUnknowns:
    """From unknowns, in standard deviations, to vehicles.

    Parameters
    ----------
    told : Vehicle
    laws : tuple of str
        What the spring may have beside its slope, of `LAWS`.
    corner : float, optional
        How far the dead band's corners are rounded, of the freeplay; as told by default.
    """

    told: Vehicle
    laws: tuple[str, ...] = ()
    corner: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, the joint's first."""
        return (*JOINT, *self.laws, *CARRIED)

    @property
    def physical(self) -> int:
        """How many of them are sought rather than carried along."""
        return len(JOINT) + len(self.laws)

    def vehicle(self, x: FloatArray) -> Vehicle:
        """Vehicle of one candidate, with its coefficients as they are told (`factors` scales them)."""
        told, known, v = self.told, self.told.uncertainty, dict(zip(self.names, x.tolist(), strict=True))
        joint, shell, body = told.joint, told.aeroshell, told.centerbody
        stiffer = STIFFNESS_LOG_SD * v["stiffness"]
        stiffness = joint.bending_stiffness_nmprad * np.exp(stiffer)
        # the damping ratio is what is unknown: at a given ratio the constant grows with the root of the stiffness
        damping = joint.bending_damping_nmsprad * np.exp(DAMPING_LOG_SD * v["damping"] + 0.5 * stiffer)
        changed = {"bending_stiffness_nmprad": stiffness, "bending_damping_nmsprad": damping}
        if "freeplay" in v:
            changed["freeplay_deg"] = float(np.rad2deg(FREEPLAY_SD_RAD) * abs(v["freeplay"]))
            if self.corner is not None:
                changed["freeplay_corner"] = self.corner
        if "hardening" in v:
            changed["hardening_nmprad3"] = stiffness * HARDENING_SD * v["hardening"] / (3.0 * HARDENING_AT_RAD**2)
        # the whole vehicle's offset; the centerbody carries it
        lateral = known.cg_lateral_m * np.array([v["shell's c.g. y"], v["shell's c.g. z"]])
        offset = OFFSET_SD_M * np.array([v["offset y"], v["offset z"]]) * told.mass_kg - lateral * shell.mass_kg
        return replace(
            told,
            joint=joint.model_copy(update=changed),
            aeroshell=_moved(shell, known, v["mass of the shell"], v["station of the shell's c.g."], lateral,
                             v["inertia of the shell"]),
            centerbody=_moved(body, known, v["mass of the centerbody"], v["station of the centerbody's c.g."],
                              offset / body.mass_kg, v["inertia of the centerbody"]),
        )  # fmt: skip

    def flown(self, x: FloatArray) -> Vehicle:
        """Vehicle of one candidate with its own coefficients."""
        vehicle = self.vehicle(x)
        return replace(vehicle, aero=vehicle.aero.scaled(*self.factors(x)))

    def factors(self, x: FloatArray) -> tuple[float, float, float, float]:
        """Factors on C_A, C_N, C_m and shift of C_mq."""
        known, v = self.told.uncertainty, dict(zip(self.names, x.tolist(), strict=True))
        return (
            1.0 + known.ca * v["C_A"], 1.0 + known.cn * v["C_N"], 1.0 + known.cm * v["static stability"],
            known.cmq * v["C_mq"],
        )  # fmt: skip


def _moved(
    part: MassProperties, known: Uncertainty, mass: float, station: float, lateral_m: FloatArray, inertia: float
) -> MassProperties:
    """Return a body with mass, c.g. and inertia off by so many standard deviations, and a lateral shift, m."""
    x, y, z = part.cg_from_datum_body_m
    moved = {
        "mass_kg": part.mass_kg * (1.0 + known.mass * mass),
        "cg_from_datum_body_m": (x + known.cg_station_m * station, y + float(lateral_m[0]), z + float(lateral_m[1])),
        "inertia_kgm2": tuple(map(tuple, (part.inertia * (1.0 + known.inertia * inertia)).tolist())),
    }
    return part.model_copy(update=moved)


@dataclass(frozen=True)
class AirUnknowns:
    """From differences to the sounding at knots, ``(3, k)``: log density, north and east wind, to kernel tables.

    Parameters
    ----------
    sounding : Sounding
    lowest_m : float
        Of the flight.
    fine : float
        Share of the structure between knots, against what the sounding's statistics would have (`fine_air`).
    """

    sounding: Sounding
    lowest_m: float
    fine: float = 1.0

    @cached_property
    def knots_m(self) -> FloatArray:
        """Altitudes (k,) at which the air may differ from the sounding."""
        lower = np.arange(UPPER_M, min(self.lowest_m, UPPER_M) - BELOW_M, -KNOT_M)[:0:-1]
        return np.concatenate([lower, np.arange(UPPER_M, TOP_M, UPPER_KNOT_M)])

    def apart_m(self, altitude_m: FloatArray) -> FloatArray:
        """Distance of the knots about altitudes."""
        apart = np.diff(self.knots_m, append=2 * self.knots_m[-1] - self.knots_m[-2])
        return np.asarray(np.interp(altitude_m, self.knots_m, apart))

    @cached_property
    def precision(self) -> FloatArray:
        """Inverse covariance (3, k, k) of the sounding's errors: half constant, half forgetting along altitude."""
        at = profile_from_sounding(self.sounding).at(self.knots_m)
        out = []
        for sd, length in ((at.density_sd, DENSITY_LENGTH_M), *[(at.wind_sd_mps, WIND_LENGTH_M)] * 2):
            correlation = sounding_correlation(self.knots_m, length)
            out.append(np.linalg.inv(sd[:, None] * correlation * sd))
        return np.array(out)

    def between_knots(self, altitude_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log density and wind, m/s, one sd, of structure that a straight line between knots leaves out."""
        apart = np.diff(self.knots_m, append=2 * self.knots_m[-1] - self.knots_m[-2])
        at = profile_from_sounding(self.sounding).at(self.knots_m)

        def left(sd: FloatArray, length_m: float) -> FloatArray:
            bridged = self.fine * sd * np.sqrt(unresolved_variance(apart, length_m))
            return np.asarray(np.interp(altitude_m, self.knots_m, bridged))

        return left(at.density_sd, DENSITY_LENGTH_M), left(at.wind_sd_mps, WIND_LENGTH_M)

    @cached_property
    def _sounded(self) -> tuple[FloatArray, FloatArray]:
        table = simulate.atmosphere_table(profile_from_sounding(self.sounding))
        rows = simulate.ATMOSPHERE_START_M + simulate.ATMOSPHERE_STEP_M * np.arange(len(table), dtype=np.float64)
        return table, np.asarray(rows)

    def table(self, difference: FloatArray) -> FloatArray:
        """Kernel table of the air."""
        table, rows = self._sounded
        table = table.copy()
        ratio, north, east = (np.interp(rows, self.knots_m, part) for part in difference)
        table[:, 0] *= np.exp(ratio)
        table[:-1, 1] += np.diff(ratio)
        table[:, 3] += north
        table[:, 4] += east
        return table


START_ALTITUDE_M = 100e3
WINDOW_S = 0.04  # of the joint's swinging at 2.5 Hz it passes 98 %, and the simulated flight is averaged alike
WINDOWS = 10  # a span
SPAN_S = WINDOWS * WINDOW_S
LEAST_SPANS = 20
LOADED = 0.1  # of the largest dynamic pressure
# bending and its rate (about x, y, z) at the first start, as known before: at rest above the air; swinging under load
REST_SD, LOADED_SD = np.deg2rad([1e-3, 0.1, 0.1, 0.1, 1.0, 1.0]), np.deg2rad([1e-3, 3.0, 3.0, 0.1, 30.0, 30.0])


@dataclass(frozen=True)
class Observed:
    """Windows of corrected sensors, body axes, and where each of ``s`` spans starts.

    Parameters
    ----------
    start : Trajectory
        Of the datum, at the starts of the spans and at the end of the last, ``s + 1`` points.
    dynamic_pressure_pa, altitude_m : (s,) float
        At the middles of the spans, by the sounding.
    time_s : (s, WINDOWS) float
        Middles of the windows.
    rate_radps, specific_force_mps2 : (s, WINDOWS, 3) float
        NaN where sensors are missing; specific force at the accelerometer.
    rate_sd_radps, force_sd_mps2 : float
        White noise of a window, each axis.
    rate_response, force_response : (4, 3, 9) float
        Response to nine unit normals that stand for the triad's constant errors: of the gyros as their sheet states
        bias, scale and mounting, of the accelerometer as the reconstruction left them. First the part that is always
        there, then what is to be multiplied by the true x, y and z.
    clock_sd_s : (2,) float
        Of the gyros' and of the accelerometer's clock.
    accelerometer_m : (3,) float
        From the datum, body axes.
    first_bending_sd : (6,) float
        Of the shell's rotation vector against the body, rad, and its rate, rad/s, at the first start.
    """

    start: Trajectory
    dynamic_pressure_pa: FloatArray
    altitude_m: FloatArray
    time_s: FloatArray
    rate_radps: FloatArray
    specific_force_mps2: FloatArray
    rate_sd_radps: float
    force_sd_mps2: float
    rate_response: FloatArray
    force_response: FloatArray
    clock_sd_s: FloatArray
    accelerometer_m: FloatArray
    first_bending_sd: FloatArray

    @property
    def spans(self) -> int:
        """Number of spans."""
        return len(self.time_s)


def observe(flight: Reconstruction, loaded: bool = False) -> Observed:
    """Take what a joint can be reconciled with from a reconstructed flight, 100 km down to the end of the pulse.

    Parameters
    ----------
    flight : Flight
    loaded : bool
        Begin only where a tenth of the largest dynamic pressure loads the joint: in thinner air a shell with freeplay
        rattles between the edges of its dead band, and no start of a span tells where it will strike.

    Raises
    ------
    GateError
        Where sensors or vehicle are missing, or no pressure pulse was reconstructed.
    """
    pulse, bet, air = flight.required_loads(), flight.solution, flight.air
    accelerometer, rates = flight.telemetry.required_triads()
    falling = (air.altitude_m < START_ALTITUDE_M) & (air.flight_path_angle_rad < 0.0)
    if loaded:
        falling &= air.dynamic_pressure_pa > LOADED * pulse.dynamic_pressure_pa.max()
    if not falling.any():
        raise GateError("reconciliation: the reconstruction never comes below 100 km")
    first_s = float(np.ceil(air.time_s[np.argmax(falling)] / WINDOW_S) * WINDOW_S)
    last_s = float(pulse.time_s[np.flatnonzero(pulse.through_pulse)[-1]])
    spans = int((last_s - first_s) / SPAN_S)
    starts = np.asarray(first_s + SPAN_S * np.arange(max(spans, 0) + 1), dtype=np.float64)
    t = (starts[:-1, None] + WINDOW_S * (np.arange(WINDOWS) + 0.5)).ravel()
    whole = whole_windows(bet, t)
    if spans < LEAST_SPANS or whole.mean() < 0.5:
        raise GateError(
            f"reconciliation: {whole.sum() * WINDOW_S:.1f} s of whole sensor data between 100 km ({first_s:.1f} s) "
            f"and the end of the pressure pulse ({last_s:.1f} s); at least {LEAST_SPANS * SPAN_S:g} s and half of the "
            "time are wanted"
        )
    means = sensed(bet, t, np.zeros(3), 0.5 * WINDOW_S)
    near = np.abs(bet.smoothed.time_s[:, None] - t).argmin(axis=0)
    shape = (spans, WINDOWS)

    def windows(values: FloatArray) -> FloatArray:
        return np.where(whole[:, None], values, np.nan).reshape(*shape, 3)

    middle = starts[:-1] + 0.5 * SPAN_S
    return Observed(
        resample(bet.smoothed, starts),
        np.interp(middle, air.time_s, air.dynamic_pressure_pa),
        np.interp(middle, air.time_s, air.altitude_m),
        t.reshape(shape),
        windows(means.rate_radps),
        windows(means.specific_force_sensor_mps2),
        float(rates.spec.noise_sd / np.sqrt(means.samples)),
        float(accelerometer.spec.noise_sd / np.sqrt(means.samples)),
        _rate_response(rates.spec),
        _affine(means.specific_force_sensor_mps2[whole], bet.accelerometer_root[near][whole, 3:]),
        np.array([rates.spec.time_bias_sd_s, accelerometer.spec.time_bias_sd_s]),
        accelerometer.spec.position_from_datum_body_m,
        LOADED_SD if loaded else REST_SD,
    )


def _rate_response(spec: TriadSpec) -> FloatArray:
    """Response (4, 3, 9) to unit normals of bias, scale and mounting."""
    out = np.zeros((4, 3, 9))
    out[0, :, 0:3] = spec.bias_sd * np.eye(3)
    out[1:, :, 3:6] = spec.scale_sd * np.einsum("kj,ij->kij", np.eye(3), np.eye(3))
    out[1:, :, 6:9] = spec.mount_sd_rad * skew(np.eye(3))
    return out


def _affine(values: FloatArray, responses: FloatArray) -> FloatArray:
    """Response (4, 3, 9) of which ``responses`` (n, 3, 9) to readings (n, 3) are made, without the readings' noise."""
    ones = np.column_stack([np.ones(len(values)), values])
    fitted, *_ = np.linalg.lstsq(ones, responses.reshape(len(values), -1), rcond=None)
    return np.asarray(fitted.reshape(4, *responses.shape[1:]))

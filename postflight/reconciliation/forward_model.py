"""What would the sensors have measured in short spans of a flight, with another joint, vehicle and atmosphere?

The measurements are corrected inertial data: rates and specific force at the accelerometer, means over windows of 40
ms. They hold all that was measured of the joint's motion; angle of attack and normal acceleration follow from them,
from attitude and atmosphere, and deflections by misalignment and trim are made of the same sensors and would
count them twice. Spans of ten windows, about a period of the joint, start from a motion of their own at the
reconstruction's position and velocity and are flown by the simulator, many at once.

Sought are the joint's parameters (stiffness, damping; freeplay, hardening and creep where asked for), the lateral
c.g. offset and the static stability. Nuisance parameters are all else that the motion depends on within its a priori
uncertainty: masses, stations, inertias, other coefficients, the instruments' constant errors, and the atmosphere.
Parameters of vehicle and instruments count in a priori standard deviations; those of the atmosphere are the logarithm
of the density ratio and the differences of the winds, m/s, and of the temperature, K, to the sounding, at knots along
altitude.

The velocity at the starts is a parameter, too, and joined from span to span. What an accelerometer misaligned by 2 mrad
or a gyro's mounting does to a reconstructed path of 9 g turns with the vehicle, as the c.g.'s offset does: at 50 rpm
0.04 m/s, of 0.1 mm of offset.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flightmodel import _kernels as la
from flightmodel import earth, rotations
from flightmodel._kernels import kernel
from flightmodel.atmosphere import (
    DENSITY_LENGTH_M,
    WIND_LENGTH_M,
    profile_from_sounding,
    sounding_correlation,
    sounding_correlation_inverse,
    temperature_sd,
    unresolved_variance,
)
from flightmodel.checks import FloatArray, GateError
from flightmodel.instruments import TriadSpec
from flightmodel.rotations import skew
from flightmodel.telemetry import Sounding
from flightmodel.trajectory import Trajectory, nearest_index, resample
from flightmodel.vehicle import MassProperties, Uncertainty, Vehicle
from postflight.reconstruction import Reconstruction
from recon.atmosphere import cg_accelerations, windows_are_whole
from synthetic_flight import simulate
from synthetic_flight.dynamics import CREEP_STATES, check_step, joint_modes
from synthetic_flight.ensemble import LANES, available_cores, check_mass

KNOT_M = 125.0  # at 1200 m/s a tenth of a second: knots resolve gusts at the joint's 2 to 4 Hz
TEMPERATURE_KNOT_M = 1e3  # of a correlation length of 5 km; by Mach number it moves the coefficients, slowly
UPPER_M, TOP_M, BELOW_M = 75e3, 105e3, 1e3
# a priori standard deviations; of factors those of their logarithms
STIFFNESS_LOG_SD, DAMPING_LOG_SD, OFFSET_SD_M = 1.5, 1.0, 0.005
FREEPLAY_SD_RAD, HARDENING_SD = np.deg2rad(0.5), 1.0
# hardening is counted as the share by which the tangent stiffness has grown at this angle; negative: it softens
HARDENING_AT_RAD = np.deg2rad(4.0)
# creep by how fast it grows, delayed compliance over the spring's and over the time constant, and how fast it settles,
# 1 / time constant: of creep slower than the flight the growth is measured and the rest is not, so that both follow
# from the data by nearly straight lines. Both as sinh of the parameter: one sd is 0.06 1/s, four are 1.4 1/s
CREEP_PER_S = 0.05
JOINT = ("stiffness", "damping", "offset y", "offset z", "static stability")
# laws, and their parameters
LAWS = {"freeplay": ("freeplay",), "hardening": ("hardening",), "creep": ("creep growth", "creep settling")}
NUISANCE = (
    "C_A", "C_N", "C_mq", "mass of the shell", "mass of the centerbody", "station of the shell's c.g.",
    "station of the centerbody's c.g.", "shell's c.g. y", "shell's c.g. z", "inertia of the shell",
    "inertia of the centerbody", "axial inertia of the shell", "axial inertia of the centerbody",
    "centerbody's product xy", "centerbody's product xz", "centerbody's product yz",
)  # fmt: skip


@dataclass(frozen=True)
class VehicleParameters:
    """Map from parameters, in a priori standard deviations, to vehicles.

    Parameters
    ----------
    nominal : Vehicle
        Of the vehicle file.
    laws : tuple of str
        Terms of the spring beside its stiffness, of `LAWS`.
    corner : float, optional
        Half width of the dead band's rounded corners over the freeplay; the vehicle file's by default.
    """

    nominal: Vehicle
    laws: tuple[str, ...] = ()
    corner: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, the joint's first."""
        return (*JOINT, *self._of_laws, *NUISANCE)

    @property
    def sought(self) -> int:
        """Number of parameters sought; the others are nuisance parameters."""
        return len(JOINT) + len(self._of_laws)

    @property
    def _of_laws(self) -> tuple[str, ...]:
        return tuple(name for law in self.laws for name in LAWS[law])

    @property
    def motion(self) -> int:
        """Number of motion coordinates at a span's start; with creep, its two lateral components are included."""
        creeps = "creep" in self.laws or self.nominal.joint.creep_share > 0.0
        return MOTION + (CREEP_STATES if creeps else 0)

    def vehicle(self, x: FloatArray) -> Vehicle:
        """Vehicle of parameters (v,), with nominal coefficients (`factors` scales them)."""
        nominal, known, v = self.nominal, self.nominal.uncertainty, dict(zip(self.names, x.tolist(), strict=True))
        joint, shell, body = nominal.joint, nominal.aeroshell, nominal.centerbody
        # a spring stiffer by e^30 is a lock: a trial step ends there before numbers overflow
        stiffer = min(STIFFNESS_LOG_SD * v["stiffness"], 30.0)
        stiffness = joint.bending_stiffness_nmprad * np.exp(stiffer)
        # the parameter is the damping ratio: at a given ratio damping grows with the root of the stiffness
        damping = joint.bending_damping_nmsprad * np.exp(DAMPING_LOG_SD * v["damping"] + 0.5 * stiffer)
        changed = {"bending_stiffness_nmprad": stiffness, "bending_damping_nmsprad": damping}
        if "freeplay" in v:
            changed["freeplay_deg"] = float(np.rad2deg(FREEPLAY_SD_RAD) * abs(v["freeplay"]))
            if self.corner is not None:
                changed["freeplay_corner"] = self.corner
        if "hardening" in v:
            changed["hardening_nmprad3"] = stiffness * HARDENING_SD * v["hardening"] / (3.0 * HARDENING_AT_RAD**2)
        if "creep growth" in v:
            changed["creep_share"], changed["creep_time_s"] = creep_law(v["creep growth"], v["creep settling"])
        # the whole vehicle's offset; the centerbody carries it
        lateral = known.cg_lateral_m * np.array([v["shell's c.g. y"], v["shell's c.g. z"]])
        offset = OFFSET_SD_M * np.array([v["offset y"], v["offset z"]]) * nominal.mass_kg - lateral * shell.mass_kg
        return replace(
            nominal,
            joint=joint.model_copy(update=changed),
            aeroshell=_perturbed(shell, known, v, "shell", lateral),
            centerbody=_perturbed(body, known, v, "centerbody", offset / body.mass_kg),
        )

    def flown(self, x: FloatArray) -> Vehicle:
        """Vehicle of parameters (v,) with its own coefficients."""
        vehicle = self.vehicle(x)
        return replace(vehicle, aero=vehicle.aero.scaled(*self.factors(x)))

    def factors(self, x: FloatArray) -> tuple[float, float, float, float]:
        """Factors on C_A, C_N, C_m and shift of C_mq."""
        known, v = self.nominal.uncertainty, dict(zip(self.names, x.tolist(), strict=True))
        return (
            1.0 + known.ca * v["C_A"], 1.0 + known.cn * v["C_N"], 1.0 + known.cm * v["static stability"],
            known.cmq * v["C_mq"],
        )  # fmt: skip


def creep_law(growth: float, settling: float) -> tuple[float, float]:
    """Delayed share of the compliance and its time constant, s, from the two parameters.

    Rates are 10 1/s at most, time constants 300 s, and the delayed compliance is -0.5 to 9 times the spring's: a joint
    that runs away from its load is none, and a vehicle file has no share above 0.9 and no time constant below 0.1 s.
    """
    most = np.arcsinh(10.0 / CREEP_PER_S)
    grows, settles = CREEP_PER_S * np.sinh(np.clip([growth, settling], -most, most))
    time_s = float(1.0 / np.hypot(1.0 / 300.0, settles))
    delayed = float(np.clip(grows * time_s, -0.5, 9.0))
    return delayed / (1.0 + delayed), time_s


def _perturbed(
    part: MassProperties, known: Uncertainty, v: dict[str, float], name: str, lateral_m: FloatArray
) -> MassProperties:
    """Return a body with mass, c.g. and inertia off by so many standard deviations, and a lateral shift, m.

    Moments about the axis and across it have factors of their own: a spinning vehicle measures their difference.
    """
    x, y, z = part.cg_from_datum_body_m
    axial, across = (1.0 + known.inertia * v[f"{kind}inertia of the {name}"] for kind in ("axial ", ""))
    # at least a hundredth of the stated one: a trial step never makes an inertia negative
    root = np.sqrt(np.maximum([axial, across, across], 0.01))
    inertia = part.inertia * np.outer(root, root)
    if f"{name}'s product xy" in v:
        size = known.inertia_products * 0.5 * (part.inertia[1, 1] + part.inertia[2, 2])
        for row, column, axes in ((0, 1, "xy"), (0, 2, "xz"), (1, 2, "yz")):
            inertia[row, column] += size * v[f"{name}'s product {axes}"]
            inertia[column, row] = inertia[row, column]
    x += known.cg_station_m * v[f"station of the {name}'s c.g."]
    moved = {
        "mass_kg": part.mass_kg * (1.0 + known.mass * v[f"mass of the {name}"]),
        "cg_from_datum_body_m": (x, y + float(lateral_m[0]), z + float(lateral_m[1])),
        "inertia_kgm2": tuple(map(tuple, inertia.tolist())),
    }
    return part.model_copy(update=moved)


@dataclass(frozen=True)
class AtmosphereParameters:
    """Map from differences to the sounding to kernel tables.

    Differences of log density, north and east wind, m/s, at knots ``(3, k)``; of temperature, K, at knots of its own.

    Parameters
    ----------
    sounding : Sounding
    lowest_m : float
        Of the flight.
    fine : float
        Structure between the knots over that of the sounding's statistics (`fit.estimate_turbulence_share`).
    """

    sounding: Sounding
    lowest_m: float
    turbulence_share: float = 1.0

    @cached_property
    def knots_m(self) -> FloatArray:
        """Altitudes (k,) at which the atmosphere may differ from the sounding."""
        lower = np.arange(UPPER_M, min(self.lowest_m, UPPER_M) - BELOW_M, -KNOT_M)[:0:-1]
        return np.concatenate([lower, np.arange(UPPER_M, TOP_M, 2.0 * KNOT_M)])  # coarser in thin air

    @cached_property
    def temperature_knots_m(self) -> FloatArray:
        """Altitudes (n,) at which the temperature may differ from the sounding."""
        return np.arange(TOP_M, self.lowest_m - BELOW_M - TEMPERATURE_KNOT_M, -TEMPERATURE_KNOT_M)[::-1]

    @cached_property
    def temperature_precision(self) -> FloatArray:
        """Inverse covariance (n, n) of the sounding's temperatures, correlated as its densities."""
        knots = self.temperature_knots_m
        sd = temperature_sd(knots)
        return np.asarray(np.linalg.inv(sd[:, None] * sounding_correlation(knots, DENSITY_LENGTH_M) * sd))

    def knot_spacing_m(self, altitude_m: FloatArray) -> FloatArray:
        """Spacing of the knots near given altitudes."""
        apart = np.diff(self.knots_m, append=2 * self.knots_m[-1] - self.knots_m[-2])
        return np.asarray(np.interp(altitude_m, self.knots_m, apart))

    @cached_property
    def inverse_covariance(self) -> tuple[tuple[FloatArray, FloatArray, FloatArray], ...]:
        """Inverse covariance of the sounding by kind: diagonal (k,), off-diagonal (k - 1,), ``u`` (k,).

        Half of the variance is a constant bias, which makes ``-u u^T``, half Gauss-Markov along altitude.
        """
        at = profile_from_sounding(self.sounding).at(self.knots_m)
        out = []
        for sd, length in ((at.density_sd, DENSITY_LENGTH_M), *[(at.wind_sd_mps, WIND_LENGTH_M)] * 2):
            diagonal, beside, u = sounding_correlation_inverse(self.knots_m, length)
            out.append((diagonal / sd**2, beside / (sd[:-1] * sd[1:]), u / sd))
        return tuple(out)

    @cached_property
    def precision(self) -> FloatArray:
        """The same as full matrices (3, k, k)."""
        parts = self.inverse_covariance
        return np.array([np.diag(d) + np.diag(e, 1) + np.diag(e, -1) - np.outer(u, u) for d, e, u in parts])

    def unresolved_structure(self, altitude_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (n,) of log density and of wind, m/s, of the structure between the knots."""
        apart = np.diff(self.knots_m, append=2 * self.knots_m[-1] - self.knots_m[-2])
        at = profile_from_sounding(self.sounding).at(self.knots_m)

        def bridge(sd: FloatArray, length_m: float) -> FloatArray:
            bridged = self.turbulence_share * sd * np.sqrt(unresolved_variance(apart, length_m))
            return np.asarray(np.interp(altitude_m, self.knots_m, bridged))

        return bridge(at.density_sd, DENSITY_LENGTH_M), bridge(at.wind_sd_mps, WIND_LENGTH_M)

    @cached_property
    def _sounded(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        profile = profile_from_sounding(self.sounding)
        table = simulate.atmosphere_table(profile)
        rows = simulate.air_altitudes_m(len(table))
        passed = rows <= TOP_M  # of a table a knot, each copied for every flight, three quarters lie above
        return table[passed], rows[passed], profile.at(rows[passed]).temperature_k

    def table(self, difference: FloatArray, warmer_k: FloatArray) -> FloatArray:
        """Kernel table (rows, 6) of the atmosphere, of differences (3, k) and (n,)."""
        table, rows, temperature = self._sounded
        table = table.copy()
        ratio, north, east = (np.interp(rows, self.knots_m, part) for part in difference)
        table[:, 0] *= np.exp(ratio)
        table[:-1, 1] += np.diff(ratio)
        # the root of the ratio of temperatures, which no trial step makes negative
        warmer = np.interp(rows, self.temperature_knots_m, warmer_k)
        table[:, 2] *= np.exp(0.5 * warmer / temperature)
        table[:, 3] += north
        table[:, 4] += east
        return table

    def moved_rows(self, table: FloatArray, kind: int, knot: int, step: float) -> MovedRows:
        """Rows of a kernel table that change with log density, north or east wind, or temperature at one knot."""
        near, hat = self._hats[kind == 3][knot]
        rows, change = table[near].copy(), step * hat
        if kind == 0:
            rows[:, 0] *= np.exp(change)
            rows[:-1, 1] += change[1:] - change[:-1]
        elif kind == 3:
            rows[:, 2] *= np.exp(0.5 * change / self._sounded[2][near])
        else:
            rows[:, 2 + kind] += change
        return MovedRows(near.start, rows)

    @cached_property
    def _hats(self) -> tuple[list[tuple[slice, FloatArray]], list[tuple[slice, FloatArray]]]:
        """`hats` of the atmosphere knots and of the temperature knots."""
        rows_m = self._sounded[1]
        return hats(rows_m, self.knots_m), hats(rows_m, self.temperature_knots_m)


def hats(rows_m: FloatArray, knots_m: FloatArray) -> list[tuple[slice, FloatArray]]:
    """Linear basis function of each knot: rows up to the neighbouring knots or the table's end, and values there."""
    low = np.maximum(np.searchsorted(rows_m, knots_m[:-1]) - 1, 0).tolist()
    high = (np.searchsorted(rows_m, knots_m[1:]) + 1).tolist()
    near = [slice(*ends) for ends in zip([0, *low], [*high, len(rows_m)], strict=True)]
    units = np.eye(len(knots_m))
    return [(part, np.interp(rows_m[part], knots_m, unit)) for part, unit in zip(near, units, strict=True)]


@dataclass(frozen=True)
class MovedRows:
    """Changed part of a kernel table of the air: ``rows`` (n, 6) from row ``first`` on."""

    first: int
    rows: FloatArray


WINDOW_S = 0.04  # passes 98 % of the joint's oscillation at 2.5 Hz; the simulated flight is averaged alike
WINDOWS = 10  # a span
SPAN_S = WINDOWS * WINDOW_S
LEAST_SPANS = 20
# a priori sd of deflection and its rate (about x, y, z) at the first start: at rest above the atmosphere; under load
REST_SD, LOADED_SD = np.deg2rad([1e-3, 0.1, 0.1, 0.1, 1.0, 1.0]), np.deg2rad([1e-3, 3.0, 3.0, 0.1, 30.0, 30.0])


@dataclass(frozen=True)
class WindowSteps:
    """Integration of a window: Simpson's mean over an even number of ``intervals`` of ``per_record`` steps each."""

    intervals: int
    per_record: int

    @property
    def step_s(self) -> float:
        """Integration step."""
        return WINDOW_S / (self.intervals * self.per_record)

    @property
    def records(self) -> int:
        """Records of a span, its start among them."""
        return WINDOWS * self.intervals + 1

    @property
    def simpson(self) -> FloatArray:
        """Weights of a window's records."""
        weights = np.full(self.intervals + 1, 2.0)
        weights[1::2] = 4.0
        weights[[0, -1]] = 1.0
        return np.asarray(weights / (3.0 * self.intervals))


SLOW_JOINT, FAST_JOINT = WindowSteps(2, 2), WindowSteps(4, 2)
FINE = WindowSteps(4, 8)  # resolve the joint's twist too: twice as long they leave half a sd of the damping


def steps_for(vehicle: Vehicle) -> WindowSteps:
    """Steps that resolve a vehicle's bending; too few records would alias a fast oscillation into an offset."""
    inertia, _, stiffness = joint_modes(vehicle)["bending"]
    # a window's mean of an oscillation faster than 6 Hz is off by more than half a percent with two intervals
    return SLOW_JOINT if np.sqrt(stiffness / inertia) < 2.0 * np.pi * 6.0 else FAST_JOINT


@dataclass(frozen=True)
class Measurements:
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
        NaN where data are missing; specific force at the accelerometer.
    rate_sd_radps, force_sd_mps2 : float
        White noise of a window, each axis.
    rate_response, force_response : (4, 3, 9) float
        Response to nine unit normals that stand for the constant errors: of the gyros a priori by the data sheet's
        bias, scale and mounting, of the accelerometer a posteriori by the reconstruction. First the constant part, then
        the factors of the true x, y and z.
    clock_sd_s : (2,) float
        Of the gyros' and of the accelerometer's clock.
    accelerometer_m : (3,) float
        From the datum, body axes.
    first_deflection_sd : (6,) float
        Of the shell's rotation vector against the body, rad, and its rate, rad/s, at the first start.
    steps : WindowSteps
        Of the integration.
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
    first_deflection_sd: FloatArray
    steps: WindowSteps = field(default_factory=lambda: SLOW_JOINT)

    @property
    def spans(self) -> int:
        """Number of spans."""
        return len(self.time_s)


def select_measurements(flight: Reconstruction, loaded: bool = False) -> Measurements:
    """Select the data of a reconstructed flight to which a joint is fitted, 100 km down to the end of the pulse.

    Parameters
    ----------
    flight : Flight
    loaded : bool
        Begin only where a tenth of the largest dynamic pressure loads the joint: in thinner air a shell with freeplay
        oscillates between the edges of its dead band, and its impacts cannot be predicted from a span's start.

    Raises
    ------
    GateError
        Where sensors or vehicle are missing, or no pressure pulse was reconstructed.
    """
    pulse, bet, air = flight.required_loads(), flight.solution, flight.air
    accelerometer, rates = flight.telemetry.required_triads()
    falling = (air.altitude_m < 100e3) & (air.flight_path_angle_rad < 0.0)
    if loaded:
        falling &= air.dynamic_pressure_pa > 0.1 * pulse.dynamic_pressure_pa.max()
    if not falling.any():
        raise GateError("reconciliation: the reconstruction never comes below 100 km", code="time-not-covered")
    first_s = float(np.ceil(air.time_s[np.argmax(falling)] / WINDOW_S) * WINDOW_S)
    last_s = float(pulse.time_s[np.flatnonzero(pulse.through_pulse)[-1]])
    spans = int((last_s - first_s) / SPAN_S)
    starts = np.asarray(first_s + SPAN_S * np.arange(max(spans, 0) + 1), dtype=np.float64)
    t = (starts[:-1, None] + WINDOW_S * (np.arange(WINDOWS) + 0.5)).ravel()
    whole = windows_are_whole(bet, t)
    if spans < LEAST_SPANS or whole.mean() < 0.5:
        raise GateError(
            f"reconciliation: {whole.sum() * WINDOW_S:.1f} s of whole sensor data between 100 km ({first_s:.1f} s) "
            f"and the end of the pressure pulse ({last_s:.1f} s); at least {LEAST_SPANS * SPAN_S:g} s and half of the "
            "time are wanted",
            code="data-gap",
        )
    means = cg_accelerations(bet, t, np.zeros(3), 0.5 * WINDOW_S)
    near = nearest_index(bet.smoothed.time_s, t)
    shape = (spans, WINDOWS)

    def windows(values: FloatArray) -> FloatArray:
        return np.where(whole[:, None], values, np.nan).reshape(*shape, 3)

    middle = starts[:-1] + 0.5 * SPAN_S
    return Measurements(
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
    """Response (4, 3, 9), affine in the readings (n, 3), that fits ``responses`` (n, 3, 9)."""
    ones = np.column_stack([np.ones(len(values)), values])
    fitted, *_ = np.linalg.lstsq(ones, responses.reshape(len(values), -1), rcond=None)
    return np.asarray(fitted.reshape(4, *responses.shape[1:]))


# of a span's start: rotation from the reconstructed attitude, body's rate, shell's rotation vector from the body (x is
# its twist), shell's rate relative to the body, shell axes; velocity less the reconstructed one, ECEF; of a joint that
# creeps its creep as `synthetic_flight.dynamics` has it
MOTION = 15
ATTITUDE, RATE, DEFLECTION, DEFLECTION_RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
VELOCITY, CREEP = slice(12, 15), slice(15, 17)
Index = NDArray[np.int64]


@dataclass(frozen=True)
class TrialVehicle:
    """A vehicle with its vector for the kernels, `simulate.parameter_vector` (69,)."""

    vehicle: Vehicle
    kernel_vector: FloatArray


@dataclass(frozen=True)
class SpanFlights:
    """Spans to fly: numbers of span, vehicle and atmosphere table of each, and the motion at its start.

    Parameters
    ----------
    span, vehicle, table : (m,) int
        Table 0 is ``air``, table k has the rows of ``moved[k - 1]``.
    motion : (m, 15 or 17) float
    vehicles : list of TrialVehicle
    air : (rows, 6) float
        Kernel table of the atmosphere.
    moved : list of MovedRows
    """

    span: Index
    vehicle: Index
    motion: FloatArray
    table: Index
    vehicles: list[TrialVehicle]
    air: FloatArray
    moved: list[MovedRows] = field(default_factory=list)

    def air_of(self, flights: Index, rows: slice) -> FloatArray:
        """Table rows of the air for flights (k,): (k, n, 6), or (n, 6) if all use table 0."""
        whole, tables = self.air[rows], self.table[flights].tolist()
        if not any(tables):
            return whole
        out = np.repeat(whole[None], len(tables), axis=0)
        for lane, k in zip(out, tables, strict=True):
            if k:
                moved = self.moved[k - 1]
                first, last = max(moved.first, rows.start), min(moved.first + len(moved.rows), rows.stop)
                if last > first:
                    lane[first - rows.start : last - rows.start] = moved.rows[first - moved.first : last - moved.first]
        return out


@dataclass(frozen=True)
class PredictedSpans:
    """Predicted sensor data of ``m`` spans; NaN after a divergence.

    Parameters
    ----------
    windows, slope : (m, WINDOWS, 6) float
        Rates, rad/s, and specific force, m/s^2, means over windows, and their rates of change.
    attitudes : (m, WINDOWS, 8) float
        Quaternions of body and shell at the windows' middles, from ECI.
    end : (m, 15 or 17) float
        Motion at the end of the span, in the coordinates of the next one's start.
    """

    windows: FloatArray
    slope: FloatArray
    attitudes: FloatArray
    end: FloatArray

    @property
    def deflection(self) -> FloatArray:
        """Shell's rotation vector (m, WINDOWS, 3) from the body at the windows' middles, rad."""
        body, shell = self.attitudes[..., :4], self.attitudes[..., 4:]
        return rotations.log(rotations.multiply(rotations.conjugate(body), shell))

    def part(self, rows: slice) -> PredictedSpans:
        """Return some of the spans."""
        return PredictedSpans(self.windows[rows], self.slope[rows], self.attitudes[rows], self.end[rows])


def integrable(vehicle: Vehicle, steps: WindowSteps) -> Vehicle:
    """Vehicle with its joint limited to what the steps can integrate and the windows can resolve.

    A stiffer spring than the steps can follow leaves a deflection too small to move a sensor. Slightly damped
    oscillations near the windows' Nyquist frequency (12.5 Hz) or beyond it fit at many false frequencies: there the
    joint is so much damped that it follows its load.
    """
    inertia, _, stiffness = joint_modes(vehicle)["bending"]
    # of the joint's bending in a step 0.8 rad at most, with an error of a percent a radian; unstable from 2.8
    most = inertia * (0.8 / steps.step_s) ** 2
    # smooth, so that steps of a fit see where it ends; a tenth of the limit is lowered by 3e-5
    limited = stiffness / (1.0 + (stiffness / most) ** 4) ** 0.25
    frequency = np.sqrt(limited / inertia) / (2.0 * np.pi)
    # a mode that windows do not resolve has a damping ratio of 0.2: its oscillation decays within a few windows, and
    # deflections lag their load by few milliseconds. The ratio grows from 0.43 periods a window (10.7 Hz) to 0.5
    ratio = 0.2 * np.clip((frequency * WINDOW_S - 0.43) / 0.07, 0.0, 1.0)
    damping = max(vehicle.joint.bending_damping_nmsprad, float(ratio * 2.0 * np.sqrt(limited * inertia)))
    changed = {"bending_stiffness_nmprad": limited, "bending_damping_nmsprad": damping}
    return replace(vehicle, joint=vehicle.joint.model_copy(update=changed))


def resolved_stiffness_nmprad(vehicle: Vehicle) -> float:
    """Bending stiffness, N m/rad, above which the windows do not resolve the joint's oscillation."""
    # up to 0.41 periods a window (10.2 Hz) a stiffness can be found: a fit of a faster joint ends at the next
    return float(joint_modes(vehicle)["bending"][0] * (2.0 * np.pi * 0.41 / WINDOW_S) ** 2)


def fly_spans(measured: Measurements, nominal: Vehicle, flights: SpanFlights) -> PredictedSpans:
    """Fly spans and predict the sensors' windows; ``nominal`` gives the coefficient table.

    Sixteen fly side by side, and of their records only what is predicted is kept: all records of a linearisation are
    hundreds of megabytes.
    """
    steps, vehicle = measured.steps, integrable(nominal, measured.steps)
    check_mass(vehicle)
    check_step(vehicle, steps.step_s)
    starts, first, last = _start_states(measured, flights), *_rows_passed(measured, flights)
    parameters = np.array([each.kernel_vector for each in flights.vehicles])
    bodies = [each.vehicle.centerbody for each in flights.vehicles]
    arms, masses = np.array([measured.accelerometer_m - b.cg_m for b in bodies]), np.array([b.mass_kg for b in bodies])
    windows, slope = np.empty((2, len(starts), WINDOWS, 6))
    attitudes, ends = np.empty((len(starts), WINDOWS, 8)), np.empty_like(starts)
    schedule, simpson = simulate.Schedule(steps.step_s, steps.per_record, steps.records), steps.simpson

    def fly(part: slice) -> None:
        count = part.stop - part.start
        which = np.minimum(np.arange(part.start, part.start - count // -LANES * LANES), part.stop - 1)
        rows = slice(int(first[part].min()), int(last[part].max()))
        states, aux = (np.full((len(which), steps.records, n), np.nan) for n in (starts.shape[1], simulate.AUX))
        simulate.integrate_into(
            states, aux, vehicle, flights.air_of(which, rows), starts[which], parameters[flights.vehicle[which]],
            schedule, air_from_m=simulate.ATMOSPHERE_START_M + rows.start * simulate.ATMOSPHERE_STEP_M, lanes=LANES,
        )  # fmt: skip
        states, aux = _until_lost(states[:count], aux[:count])
        numbers = np.ascontiguousarray(flights.vehicle[part])  # or the kernel would be compiled for both
        sense(states, aux, numbers, arms, masses, simpson, WINDOW_S, windows[part], slope[part])
        attitudes[part] = states[:, steps.intervals // 2 :: steps.intervals, 6:14]
        ends[part] = states[:, -1]

    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(fly, _parts(len(starts))))
    return PredictedSpans(windows, slope, attitudes, _ends(measured, flights, ends))


@kernel
def sense(states, aux, vehicle, arms, masses, simpson, window_s, windows, slope):
    """Means over windows of rates and specific force, and their rates of change, into (m, windows, 6) each.

    ``states`` (m, records, 20 or 22) and ``aux`` (m, records, 18) as `synthetic_flight.dynamics` has them, of the
    vehicles numbered ``vehicle`` (m,): accelerometer from the centerbody's c.g. (k, 3), and the centerbody's mass (k,).
    """
    intervals = len(simpson) - 1
    records = np.empty((states.shape[1], 6))
    for i in range(len(states)):
        x, y, z = arms[vehicle[i]]
        mass = masses[vehicle[i]]
        for k in range(len(records)):
            s, a = states[i, k], aux[i, k]
            force = la.back(la.rotation(s[6], s[7], s[8], s[9]), a[6], a[7], a[8])
            turn = la.cross(a[15], a[16], a[17], x, y, z)
            speed = la.cross(s[14], s[15], s[16], x, y, z)
            swing = la.cross(s[14], s[15], s[16], speed[0], speed[1], speed[2])
            for j in range(3):
                records[k, j] = s[14 + j]
                records[k, 3 + j] = force[j] / mass + turn[j] + swing[j]
        for w in range(windows.shape[1]):
            first = w * intervals
            for j in range(6):
                total = 0.0
                for k in range(intervals + 1):
                    total += simpson[k] * records[first + k, j]
                windows[i, w, j] = total
                slope[i, w, j] = (records[first + intervals, j] - records[first, j]) / window_s


def _parts(flights: int) -> list[slice]:
    """Slices of the flights, in whole blocks of lanes, that one thread flies in sequence.

    Handing over a block takes as long as flying it; a large part's air reaches over many spans. The same on every
    machine: where a part's air begins is seen in the last bits.
    """
    blocks = -(-flights // LANES)
    # 16 blocks in a row at most, about three spans of a linearisation; at least 8 parts, a few for each thread
    size = LANES * min(16, -(-blocks // 8))
    return [slice(begin, min(begin + size, flights)) for begin in range(0, flights, size)]


def _until_lost(states: FloatArray, aux: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States and auxiliaries of flights, NaN from the first non-finite record on."""
    if not np.isfinite(states[:, -1]).all():  # what is lost once stays so
        lost = ~np.isfinite(states).all(axis=2)
        lost = np.logical_or.accumulate(lost, axis=1)
        states[lost], aux[lost] = np.nan, np.nan
    return states, aux


def _rows_passed(measured: Measurements, flights: SpanFlights) -> tuple[Index, Index]:
    """First row (m,) of the air tables that each flight needs, and one past the last (m,), at least two rows.

    A span that leaves them by a trial vehicle's tumbling meets the air at their ends.
    """
    # beside what a span falls through, 200 m of air about it
    passed = np.abs(np.gradient(measured.altitude_m)) + 200.0
    ends = np.stack([measured.altitude_m - passed, measured.altitude_m + passed])
    low, high = (ends - simulate.ATMOSPHERE_START_M) / simulate.ATMOSPHERE_STEP_M
    count = len(flights.air)
    first = np.clip(np.floor(low).astype(np.int64), 0, count - 2)
    last = np.clip(np.ceil(high).astype(np.int64) + 1, first + 2, count)
    return first[flights.span], last[flights.span]


def _start_states(measured: Measurements, flights: SpanFlights) -> FloatArray:
    """States (m, 20) as `synthetic_flight.simulate.state_from_ecef` lays them out, of the deflected vehicle's c.g.

    (m, 22) of joints that creep.
    """
    at, span, motion = measured.start, flights.span, flights.motion
    q = rotations.boxplus(at.q_ecef_body[span], motion[:, ATTITUDE])
    omega, q_body_shell = motion[:, RATE], rotations.exp(motion[:, DEFLECTION])
    shell_rate = rotations.rotate(rotations.conjugate(q_body_shell), omega) + motion[:, DEFLECTION_RATE]
    place, velocity = _cg_from_datum(flights, omega, q_body_shell, shell_rate)
    r = at.position_ecef_m[span] + rotations.rotate(q, place)
    v = at.velocity_ecef_mps[span] + motion[:, VELOCITY] + rotations.rotate(q, velocity)
    to_eci = rotations.conjugate(earth.q_ecef_eci(at.time_s[span]))
    q_body = rotations.multiply(to_eci, q)
    inertial = rotations.rotate(to_eci, v + np.cross(earth.OMEGA_ECEF_RADPS, r))
    q_shell = rotations.multiply(q_body, q_body_shell)
    return np.column_stack(
        [rotations.rotate(to_eci, r), inertial, q_body, q_shell, omega, shell_rate, motion[:, CREEP]]
    )


def _cg_from_datum(
    flights: SpanFlights, omega: FloatArray, q_body_shell: FloatArray, shell_rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Place and velocity (m, 3) of the deflected vehicle's c.g. from the datum, body axes; shell's rate in its own."""
    vehicles = [c.vehicle for c in flights.vehicles]
    cg = np.array([v.cg_m for v in vehicles])[flights.vehicle]
    # of the shell's c.g., from the joint; its share in the vehicle's
    arm = np.array([v.aeroshell.cg_m - v.joint_m for v in vehicles])[flights.vehicle]
    share = np.array([v.aeroshell.mass_kg / v.mass_kg for v in vehicles])[flights.vehicle, None]
    place = cg + share * (rotations.rotate(q_body_shell, arm) - arm)
    drift = rotations.rotate(q_body_shell, np.cross(shell_rate, arm)) - np.cross(omega, arm)
    return place, np.cross(omega, cg) + share * drift


def _ends(measured: Measurements, flights: SpanFlights, state: FloatArray) -> FloatArray:
    """Motion (m, 15 or 17) in the coordinates of the next span's start."""
    span, at = flights.span, measured.start
    q_body, q_shell, omega, shell = state[:, 6:10], state[:, 10:14], state[:, 14:17], state[:, 17:20]
    to_ecef = earth.q_ecef_eci(at.time_s[span] + SPAN_S)
    q = rotations.multiply(to_ecef, q_body)
    q_body_shell = rotations.multiply(rotations.conjugate(q_body), q_shell)
    _, from_datum = _cg_from_datum(flights, omega, q_body_shell, shell)
    r, v = rotations.rotate(to_ecef, state[:, 0:3]), rotations.rotate(to_ecef, state[:, 3:6])
    velocity = v - np.cross(earth.OMEGA_ECEF_RADPS, r) - rotations.rotate(q, from_datum)
    attitude, velocity = rotations.boxminus(q, at.q_ecef_body[span + 1]), velocity - at.velocity_ecef_mps[span + 1]
    shell_rate = shell - rotations.rotate(rotations.conjugate(q_body_shell), omega)
    return np.column_stack([attitude, omega, rotations.log(q_body_shell), shell_rate, velocity, state[:, 20:]])

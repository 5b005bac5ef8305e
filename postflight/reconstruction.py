"""Where was the vehicle, in which air, and how well is it known? A flight's best-estimated trajectory and its table.

``bet.csv`` has every column an analyst asks for, each with its standard deviation. What a flight cannot have
(attitude in ballistic flight, sensors in a telemetry gap, force coefficients where the dynamic pressure is too low)
is an empty cell. A coefficient is ``C = m a / (q S)``, and its standard deviation carries those of the specific
force, of dynamic pressure and of the mass. Columns, units and frames: docs/bet-product.md.

The loads of the flight, as the estimators of the deflection need them (`loads_from_solution`): corrected sensors at the
c.g. and air data along the reconstructed trajectory (`recon`) become the `FlightLoads` of `estimators`, at the
trajectory's even output rate and away from telemetry gaps. The sensors are averaged over a window short enough for the
joint's own oscillation,

    f_cg = mean(f) + w' x r + w x (w x r),     w' from the rates half a window apart.

An attitude from magnetometer and Sun sensors alone is compared with the trajectory's, as ranges do: the history of
`recon.vector_attitude` minus the smoothed trajectory's attitude, about three body axes, against the sum of both
covariances: NEES ``d^T (P_directions + P_trajectory)^-1 d`` and the share inside three standard deviations. It is
independent where the trajectory neither used these sensors nor was started from them. See docs/attitude.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from estimators.loads import FlightLoads, pitching_radps
from flightmodel import airdata, earth, rotations
from flightmodel.airdata import AirData, angle_partials, derived_with_sd, euler_321, is_angle, lateral_angles
from flightmodel.atmosphere import TOP_M, AtmosphereProfile, bottom_m, profile_from_sounding
from flightmodel.checks import BoolArray, Check, DivergenceError, FloatArray, GateError, Issue, Progress, check_type
from flightmodel.events import find_peak
from flightmodel.statistics import chi_square_quantile
from flightmodel.tables import column_about
from flightmodel.tabular import Tabular
from flightmodel.telemetry import LARGEST_GAP_S, Telemetry
from flightmodel.trajectory import Trajectory, interpolate_rows, resample
from flightmodel.vehicle import Vehicle
from postflight.checks.track_clocks import clock_faults
from postflight.flight import READ, Flight
from postflight.methods import Inputs
from postflight.streams import on_one_thread
from recon.atmosphere import (
    HALF_WINDOW_S,
    LEAST_AXIAL_MPS2,
    ReconstructedAir,
    as_flown_atmosphere,
    cg_accelerations,
    too_sparse,
    windows_are_whole,
)
from recon.consistency import doubt
from recon.entry_density import (
    density_by_drag,
    density_check,
    drag_jump_check,
    profile_as_flown,
    temperature_check,
)
from recon.estimate import TrajectorySolution
from recon.fault_isolation import isolate_faults
from recon.reconstruct import reconstruct as solve
from recon.settings import Settings
from recon.survey import rests_on
from recon.vector_attitude import (
    LEAST_INSIDE,
    AttitudeComparison,
    AttitudeHistory,
    reconstruct_attitude,
    track,
)
from recon.vector_attitude import compare as compare_attitudes

Columns = dict[str, FloatArray]
# quantity of `airdata.derived` and its column
_DERIVED = {
    "latitude": "lat_deg",
    "longitude": "lon_deg",
    "altitude": "alt_m",
    "speed_inertial": "speed_inertial_mps",
    "path_inertial": "flight_path_inertial_deg",
    "heading_inertial": "heading_inertial_deg",
    "speed_ground": "speed_ground_mps",
    "path_ground": "flight_path_deg",
    "heading_ground": "heading_deg",
    "speed_wind": "airspeed_mps",
    "path_wind": "flight_path_wind_deg",
    "heading_wind": "heading_wind_deg",
    "roll": "roll_ned_deg",
    "pitch": "pitch_ned_deg",
    "yaw": "yaw_ned_deg",
    "mach": "mach",
    "dynamic_pressure": "dynamic_pressure_pa",
    "density": "rho_kgpm3",
    "pressure": "p_pa",
    "temperature": "t_k",
    "alpha": "alpha_deg",
    "beta": "beta_deg",
    "alpha_total_wind": "alpha_total_wind_deg",
    "alpha_total_ground": "alpha_total_ground_deg",
    "alpha_total_inertial": "alpha_total_inertial_deg",
    "clock_wind": "clock_lv_deg",
    "clock_inertial": "clock_inertial_lv_deg",
}
_NEED_ATTITUDE = ("roll", "pitch", "yaw", "alpha", "beta", "clock", "alpha_total")
_FORCE_NAMES = (
    *(f"a{a}_imu_mps2" for a in "xyz"),
    *(f"a{a}_imu_sd_mps2" for a in "xyz"),
    *(f"a{a}_cg_mps2" for a in "xyz"),
    *(f"a{a}_cg_sd_mps2" for a in "xyz"),
    "c_a", "c_a_sd", "c_n", "c_n_sd", "cn_over_ca", "cn_over_ca_sd",
)  # fmt: skip
# of the angular acceleration this half window leaves out 0.5 % at 1 Hz and 3 % at 2.5 Hz; so does a shorter one of a
# vehicle that pitches and spins faster. At least some samples must lie in it
_HALF_WINDOW_S, _MOST_TURN_RAD, _LEAST_SAMPLES = 0.02, 0.31, 2.5
_CODE = "trajectory-diverged"
_DIVERGED = (
    "Check planet, [start.state] and its time, the accelerometer's and gyros' units, signs and mounting, and the "
    "attitude prior; `postflight check` compares them"
)
_EDGE_S = 1.0  # from data's end, or a gap's, within which a largest value is not taken for a peak
_NO_READINGS = ("data-gap", "samples-missing", "frozen-data")
# why the check is not independent, by code
DEPENDENCE = {
    "": "",
    "filter": "this check is not independent: the trajectory's filter used these sensors too",
    "start": "this check is not independent: the trajectory's attitude was started from these sensors",
}


@dataclass(frozen=True, repr=False)
class Reconstruction(Tabular):
    """A flight's best-estimated trajectory and the atmosphere along it.

    Parameters
    ----------
    flight : Flight
        What it was made from, with its assumptions.
    solution : TrajectorySolution
        Smoothed and filtered trajectory, sensor errors, residuals, consistency checks.
    air : AirData
        Along the trajectory, by ``profile``.
    profile : AtmosphereProfile
        The sounding's; with [drag] the atmosphere as flown, where the deceleration determines it better.
    loads : FlightLoads or None
        Motion and flow at the c.g., for the estimators of the deflection; None where ``missing`` says why.
    as_flown : ReconstructedAir or None
        As-flown density, winds and C_A, from the deceleration.
    missing : tuple of Issue
        Why there are no loads or no as-flown atmosphere.
    attitude : AttitudeCheck or None
        Comparison with an attitude from magnetometer and Sun sensors alone.
    density : DataFrame or None
        Air by the deceleration with the drag of [drag], `recon.entry_density`.
    density_checks : tuple of Check
        Of that density against the stated atmosphere's.
    clocks : tuple of Issue
        Time tags that are off by tracks against inertial sensors; looked for where a check fails.
    """

    flight: Flight
    solution: TrajectorySolution
    air: AirData
    profile: AtmosphereProfile
    loads: FlightLoads | None
    as_flown: ReconstructedAir | None = None
    missing: tuple[Issue, ...] = ()
    attitude: AttitudeCheck | None = None
    density: pd.DataFrame | None = None
    density_checks: tuple[Check, ...] = ()
    clocks: tuple[Issue, ...] = ()

    @property
    def telemetry(self) -> Telemetry:
        """What was measured."""
        return self.flight.telemetry

    @property
    def trajectory(self) -> Trajectory:
        """The best estimate: the smoothed trajectory of the datum."""
        return self.solution.smoothed

    @property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Checks of the trajectory, then of its attitude, then of the atmosphere."""
        attitude, air = (part.consistency_checks if part is not None else () for part in (self.attitude, self.as_flown))
        return self.solution.consistency_checks + attitude + air + self.density_checks

    @property
    def findings(self) -> tuple[Issue, ...]:
        """What was found in the data, on the way, and by the check of the attitude."""
        attitude = () if self.attitude is None else self.attitude.findings
        return (*self.telemetry.findings, *self.solution.findings, *attitude)

    @property
    def suspects(self) -> tuple[Issue, ...]:
        """Fault hypotheses, the most likely first; none where every consistency check passes."""
        checks, solution = self.consistency_checks, self.solution
        return (*self.clocks, *isolate_faults(checks, solution.left_out, solution.single_faults))

    @property
    def rests_on(self) -> tuple[str, ...]:
        """Assumptions behind position, height, azimuth and the density level that residuals cannot test."""
        lines, vehicle = rests_on(self.telemetry, self.solution.settings), self.telemetry.vehicle
        if self.density is not None and self.telemetry.drag is not None:
            drag_percent = 100.0 * self.telemetry.drag.sd
            return (*lines, f"density's level rests on C_A and mass to {drag_percent:.2g} %")
        if self.as_flown is None or vehicle is None:
            return lines
        stated = vehicle.uncertainty
        ca = 100.0 * stated.ca * np.sqrt(1.0 - stated.ca_shape_part)  # what is one factor at all Mach numbers
        return (*lines, f"density's level rests on C_A to {ca:.2g} % and mass to {100.0 * stated.mass:.2g} %")

    @property
    def has_attitude(self) -> bool:
        """Whether inertial sensors carried the attitude; in ballistic flight it is not known."""
        return self.solution.provenance["motion"] != "ballistic"

    @property
    def deceleration(self) -> tuple[FloatArray, FloatArray] | None:
        """Deceleration along the flow of ballistic flight and its sd (n,), m/s^2, by the smoothed drag."""
        drag = self.solution.drag
        if self.has_attitude or drag is None:
            return None
        value = 0.5 * np.exp(drag.log_drag) * self.air.airspeed_mps**2
        value[self._unread(self.air.time_s)] = np.nan
        return value, value * drag.pressure_sd

    def required_loads(self) -> FlightLoads:
        """Motion and flow at the c.g.; `GateError` with the reason where there are none."""
        if self.loads is None:
            raise GateError("; ".join(self.missing), "input-missing")
        return self.loads

    @property
    def peak_s(self) -> float:
        """Time of peak dynamic pressure by the BET and its air's density, s."""
        return find_peak(self.air.time_s, self.air.dynamic_pressure_pa)[0]

    @property
    def pulse_s(self) -> tuple[float, float]:
        """Begin and end of the pressure pulse, s."""
        inside = self.air.time_s[airdata.pressure_pulse(np.nan_to_num(self.air.dynamic_pressure_pa))]
        return float(inside[0]), float(inside[-1])

    @property
    def peak_lies(self) -> str:
        """Why the largest dynamic pressure is not a peak: gap or edge of the data; empty if it is a peak."""
        if self._unread(np.array([self.peak_s]), _EDGE_S)[0]:
            return "gap in the data"
        return "" if self.air.time_s[0] + _EDGE_S < self.peak_s < self.air.time_s[-1] - _EDGE_S else "edge of data"

    def _unread(self, time_s: FloatArray, about_s: float = 0.0) -> BoolArray:
        """Whether the accelerometer of the drag has a long gap at, or about, times (n,)."""
        record, out = self.telemetry.drag_accelerometer, np.zeros(len(time_s), dtype=bool)
        for gap in self.findings:
            long = gap.end_s - gap.start_s > _EDGE_S
            if record is not None and gap.source == record.spec.name and gap.code in _NO_READINGS and long:
                out |= (gap.start_s - about_s < time_s) & (time_s < gap.end_s + about_s)
        return out

    def to_frame(self) -> pd.DataFrame:
        """Trajectory and air data with their standard deviations: the columns of ``bet.csv`` (docs/bet-product.md)."""
        return self.table.copy()

    @cached_property
    def table(self) -> pd.DataFrame:
        """Table of `to_frame`, made once; not to be changed."""
        return bet_table(self)

    def _about(self) -> str:
        checks = self.consistency_checks
        doubtful = doubt([c.name for c in checks if not c.passed], len(checks))
        peak = f"peak q {self.air.dynamic_pressure_pa.max():.0f} Pa at {self.peak_s:.2f} s"
        passed = f"all {len(checks)} consistency checks pass"
        parts = (doubtful, self.flight.name, peak, *(() if doubtful else (passed,)), *self.flight.changes)
        return "; ".join(filter(None, parts))


@on_one_thread
def reconstruct(flight: Flight, settings: Settings | None = None, progress: Progress | None = None) -> Reconstruction:
    """Reconstruct a flight: trajectory, attitude check, air data, flight loads and as-flown atmosphere.

    Parameters
    ----------
    flight : Flight
    settings : Settings, optional
        In place of the flight's own.
    progress : callable, optional
        Called with the fraction done and what is being done.

    Raises
    ------
    GateError
        Where the data cannot start or carry the filter.
    DivergenceError
        Where the trajectory leaves the atmosphere's tables.
    """
    check_type("reconstruct: flight", flight, Flight, READ)
    report = progress or (lambda _fraction, _what: None)
    if settings is not None:
        check_type("reconstruct: settings", settings, Settings, "pf.Settings(...)")
        flight = replace(flight, settings=settings)
    Inputs.of(flight.telemetry).require("trajectory")
    report(0.0, "reconstructing")
    try:
        solution = solve(flight.telemetry, flight.settings, lambda f, what: report(0.95 * f, what))
    except GateError as fault:
        if "not-finite" in fault.codes:  # of a path: telemetry that is not finite does not pass its reader
            fault = DivergenceError(f"reconstruction: diverged beyond all numbers. {_DIVERGED}", _CODE)
        raise _with_clocks(flight, fault) from None
    report(0.95, "checking the attitude")
    attitude = check_attitude(flight.telemetry, solution)
    report(0.97, "finding the as-flown atmosphere")
    try:
        found = replace(reconstruction_from(flight, solution), attitude=attitude)
    except DivergenceError as fault:
        raise _with_clocks(flight, fault) from None
    if not all(check.passed for check in found.consistency_checks):
        found = replace(found, clocks=clock_faults(flight.telemetry, flight.settings.without))
    report(1.0, "reconstructed")
    return found


def _with_clocks(flight: Flight, fault: GateError) -> GateError:
    """Return the error; for a diverging trajectory, extended by the time tags that are off."""
    found = clock_faults(flight.telemetry, flight.settings.without) if isinstance(fault, DivergenceError) else ()
    return DivergenceError("; ".join((str(fault), *found)), fault.codes[0]) if found else fault


def reconstruction_from(flight: Flight, solution: TrajectorySolution) -> Reconstruction:
    """Air data, loads and as-flown atmosphere along a solution; `DivergenceError` where it leaves the air's tables."""
    telemetry = flight.telemetry
    _check_inside_tables(solution.smoothed)
    stated = profile = profile_from_sounding(telemetry.sounding)
    density, checks = None, tuple[Check, ...]()
    if telemetry.drag is not None:
        density = density_by_drag(telemetry, solution.smoothed, solution.drag)
        tests, confidence = (density_check, temperature_check, drag_jump_check), solution.settings.check_confidence
        found = (test(density, stated, confidence) for test in tests)
        checks = tuple(each for each in found if each is not None)
        profile = profile_as_flown(stated, density)
    air = airdata.air_data(solution.smoothed, profile, _arm(flight.vehicle))
    loads, as_flown = None, None
    missing: list[Issue] = []
    try:
        telemetry.required_vehicle()
        telemetry.required_triads()
        _check_axes(solution)
        loads = loads_from_solution(telemetry, solution, air)
        as_flown = as_flown_atmosphere(telemetry, solution, stated, solution.settings.check_confidence)
    except GateError as fault:
        missing += fault.faults
    return Reconstruction(
        flight, solution, air, profile, loads, as_flown, tuple(missing), density=density, density_checks=checks
    )


def _check_axes(solution: TrajectorySolution) -> None:
    """Raise `GateError` if accelerometer and gyros do not share one set of axes, since loads need both."""
    swings = solution.adaptation.oscillation
    if swings is not None and not swings.one_set_of_axes:
        (check,) = (v for v in solution.consistency_checks if v.code == "triads-axes")
        raise GateError(f"{check.name}: {check.remark}", "triads-axes")


def air_data(trajectory: Trajectory, flight: Flight) -> AirData:
    """Flow angles, Mach number and dynamic pressure along any trajectory of a flight, by its sounding.

    Parameters
    ----------
    trajectory : Trajectory
        The flight's best estimate, or another team's.
    flight : Flight
        Whose sounding and vehicle (c.g.) are used.

    Returns
    -------
    AirData
        At the trajectory's times, of the vehicle's c.g. (of the followed point without a vehicle).
    """
    check_type("air_data: trajectory", trajectory, Trajectory, "bet.trajectory")
    check_type("air_data: flight", flight, Flight, READ)
    return airdata.air_data(trajectory, profile_from_sounding(flight.telemetry.sounding), _arm(flight.vehicle))


def _arm(vehicle: Vehicle | None) -> FloatArray:
    """Reference point of the flow, from the datum, body axes (3,), m: the c.g., or without a vehicle the datum."""
    return np.zeros(3) if vehicle is None else vehicle.cg_m


def _check_inside_tables(trajectory: Trajectory) -> None:
    """Raise `DivergenceError` if the reconstruction leaves the altitudes between ground and top of the air tables."""
    _, _, altitude_m = earth.geodetic_from_ecef(trajectory.position_ecef_m, trajectory.planet)
    wrong = (altitude_m < bottom_m(trajectory.planet)) | (altitude_m > TOP_M)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DivergenceError(
            f"reconstruction: diverged: at {trajectory.time_s[k]:.1f} s the altitude is {altitude_m[k] / 1000:.1f} km. "
            f"{_DIVERGED}",
            _CODE,
        )


def _vector(pattern: str, letters: str, values: FloatArray) -> Columns:
    """Columns of a vector."""
    return {pattern.format(a): c for a, c in zip(letters, values.T, strict=True)}


def bet_table(flight: Reconstruction) -> pd.DataFrame:
    """Best estimated trajectory, one row an output time."""
    bet = flight.solution.smoothed
    sd = bet.sd()
    columns: Columns = {"t_s": bet.time_s}
    columns |= _vector("r{}_ecef_m", "xyz", bet.position_ecef_m)
    columns |= _vector("v{}_ecef_mps", "xyz", bet.velocity_ecef_mps)
    columns |= _vector("q{}_ecef_body", "wxyz", bet.q_ecef_body)
    rate_sd = _rate_sd(flight)
    bridged = np.isnan(rate_sd) & bool(len(flight.solution.rate_cov))
    rate = np.where(bridged, np.nan, bet.omega_body_eci_body_radps)
    columns |= _vector("{}_body_degps", "pqr", np.rad2deg(rate))
    columns |= _vector("r{}_ecef_sd_m", "xyz", sd[:, 0:3])
    columns |= _vector("v{}_ecef_sd_mps", "xyz", sd[:, 3:6])
    columns |= _vector("rotation_{}_body_sd_deg", "xyz", np.rad2deg(sd[:, 6:9]))
    columns |= _vector("{}_body_sd_degps", "pqr", np.rad2deg(rate_sd))
    columns |= _inertial(flight)
    columns |= _derived(flight)
    columns |= _force(flight)
    columns |= _density_ratio(flight)
    if not flight.has_attitude:  # the trajectory's own attitude is a placeholder there
        blank = np.full(len(bet.time_s), np.nan)
        columns |= {name: blank for name in columns if "_body" in name}
    return pd.DataFrame(columns)


def _rate_sd(flight: Reconstruction) -> FloatArray:
    """Standard deviations (n, 3) of the rates, by estimated errors and white noise; NaN where none is measured."""
    bet, rates = flight.solution, flight.telemetry.rates
    if not len(bet.rate_cov) or rates is None:
        return np.full((len(bet.smoothed.time_s), 3), np.nan)
    sd = np.sqrt(np.diagonal(bet.rate_cov, axis1=1, axis2=2) + rates.spec.noise_sd**2)
    time_s = bet.smoothed.time_s
    for gap in bet.findings:
        if gap.code == "gap-bridged" and gap.source == rates.spec.name and gap.end_s - gap.start_s > LARGEST_GAP_S:
            sd[(time_s > gap.start_s) & (time_s < gap.end_s)] = np.nan
    return np.asarray(sd)


def _inertial(flight: Reconstruction) -> Columns:
    """Position and velocity in ECI with standard deviations."""
    bet = flight.solution.smoothed
    assert bet.covariance is not None
    turn = rotations.conjugate(earth.q_ecef_eci(bet.time_s, bet.planet))
    dcm = rotations.dcm_from_q(turn)
    r = rotations.rotate(turn, bet.position_ecef_m)
    v = rotations.rotate(turn, bet.velocity_ecef_mps) + np.cross(bet.planet.rate_ecef_radps, r)
    move = np.zeros((len(r), 6, 6))
    move[:, 0:3, 0:3] = move[:, 3:6, 3:6] = dcm
    move[:, 3:6, 0:3] = rotations.skew(bet.planet.rate_ecef_radps) @ dcm
    moved = move @ bet.covariance[:, :6, :6] @ move.transpose(0, 2, 1)
    sd = np.sqrt(np.diagonal(moved, axis1=1, axis2=2))
    out = _vector("r{}_eci_m", "xyz", r) | _vector("v{}_eci_mps", "xyz", v)
    return out | _vector("r{}_eci_sd_m", "xyz", sd[:, 0:3]) | _vector("v{}_eci_sd_mps", "xyz", sd[:, 3:6])


def _derived(flight: Reconstruction) -> Columns:
    """Air data, flow angles and attitude angles; winds."""
    value, sd = derived_with_sd(flight.solution.smoothed, flight.profile, _arm(flight.telemetry.vehicle))
    out: Columns = {}
    for name, column in _DERIVED.items():
        unknown = not flight.has_attitude and name.startswith(_NEED_ATTITUDE)
        for key, numbers in ((column, value[name]), (column_about(column), sd[name])):
            out[key] = np.full(len(numbers), np.nan) if unknown else np.rad2deg(numbers) if is_angle(name) else numbers
    air = flight.air
    for kind in ("wind", "ground", "inertial"):  # to first order, as the estimators have them
        if flight.has_attitude:
            out[f"alpha_total_{kind}_sd_deg"] = np.rad2deg(getattr(air, f"alpha_total_{kind}_sd_rad"))
    out |= {"wind_n_mps": air.air.wind_ned_mps[:, 0], "wind_e_mps": air.air.wind_ned_mps[:, 1]}
    return out | {"wind_sd_mps": air.air.wind_sd_mps}


def _force(flight: Reconstruction) -> Columns:
    """Specific force at the sensor and at the c.g., and the force coefficients that follow with the sounding's air."""
    bet, telemetry = flight.solution, flight.telemetry
    t = bet.smoothed.time_s
    out = {name: np.full(len(t), np.nan) for name in _FORCE_NAMES}
    rows = windows_are_whole(bet, t)
    if telemetry.accelerometer is None or not rows.any():
        return out
    spec, vehicle = telemetry.accelerometer.spec, telemetry.vehicle
    arm = np.zeros(3) if vehicle is None else vehicle.cg_m - spec.position_from_datum_body_m
    at = cg_accelerations(bet, t[rows], arm)
    cov = bet.specific_force_cov[rows] + spec.noise_sd**2 / at.samples * np.eye(3)
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    found = _vector("a{}_imu_mps2", "xyz", at.specific_force_sensor_mps2) | _vector("a{}_imu_sd_mps2", "xyz", sd)
    if vehicle is not None:
        force = at.specific_force_cg_mps2
        found |= _vector("a{}_cg_mps2", "xyz", force) | _vector("a{}_cg_sd_mps2", "xyz", sd)
        q, q_sd = (getattr(flight.air, f"dynamic_pressure{end}_pa")[rows] for end in ("", "_sd"))
        mass_per_area = vehicle.mass_at(t[rows]) / vehicle.reference.area_m2
        found |= _coefficients(force, cov, q / mass_per_area, np.hypot(q_sd / q, vehicle.uncertainty.mass))
    for name, numbers in found.items():
        out[name][rows] = numbers
    return out


def _coefficients(force: FloatArray, cov: FloatArray, scale_mps2: FloatArray, scale_sd: FloatArray) -> Columns:
    """C_A, C_N and their ratio with sds; ``scale_mps2`` (n,) is q S / m, ``scale_sd`` its sd as a fraction."""
    axial, normal = -force[:, 0], np.hypot(force[:, 1], force[:, 2])
    way = force[:, 1:] / np.maximum(normal, 1e-12)[:, None]
    axial_part = np.sqrt(cov[:, 0, 0]) / np.abs(axial)
    normal_sd = np.sqrt(np.einsum("ni,nij,nj->n", way, cov[:, 1:, 1:], way))
    ca, cn, ratio = axial / scale_mps2, normal / scale_mps2, normal / axial
    out = {
        "c_a": ca,
        "c_a_sd": np.abs(ca) * np.hypot(axial_part, scale_sd),
        "c_n": cn,
        "c_n_sd": np.hypot(normal_sd / scale_mps2, cn * scale_sd),
        "cn_over_ca": ratio,
        "cn_over_ca_sd": np.hypot(normal_sd / axial, ratio * axial_part),
    }
    weak = axial < LEAST_AXIAL_MPS2
    return {name: np.where(weak, np.nan, numbers) for name, numbers in out.items()}


def _density_ratio(flight: Reconstruction) -> Columns:
    """As-flown density, from the deceleration, over the sounding's, on the descent."""
    n = len(flight.air.time_s)
    out = {"density_ratio": np.full(n, np.nan), "density_ratio_sd": np.full(n, np.nan)}
    if flight.as_flown is None:
        return out
    p, span = flight.as_flown.profile, flight.as_flown.drag["time_s"]
    h = flight.air.altitude_m
    rows = (flight.air.time_s >= span.min()) & (flight.air.time_s <= span.max())
    rows &= (h >= p["altitude_m"].min()) & (h <= p["altitude_m"].max())
    for name in out:
        out[name][rows] = np.interp(h[rows], p["altitude_m"], p[name])
    return out


def loads_from_solution(telemetry: Telemetry, bet: TrajectorySolution, air: AirData) -> FlightLoads:
    """Corrected sensors at the c.g. and the flow, at the trajectory's even output rate, where no telemetry gap is near.

    Parameters
    ----------
    telemetry : Telemetry
        With a vehicle and inertial sensors.
    bet : TrajectorySolution
    air : AirData
        At the times of the smoothed trajectory.

    Raises
    ------
    GateError
        Where there is no vehicle or no inertial sensor.
    """
    grid = bet.smoothed.time_s
    ticks = grid * bet.output_rate_hz
    inside = windows_are_whole(bet, grid) & (np.abs(ticks - np.round(ticks)) < 1e-5)
    whole, (accelerometer, rates) = telemetry.required_vehicle(), telemetry.required_triads()
    # where mass properties change in flight: those at peak pressure, and only while they hold
    peak_s = float(grid[np.nanargmax(air.dynamic_pressure_pa)])
    begins, ends, vehicle = next(p for p in whole.phases(-np.inf, np.inf) if p[0] <= peak_s < p[1])
    inside &= (grid >= begins) & (grid < ends)
    t = grid[inside]
    if len(t) == 0:
        raise too_sparse(bet, 4.0 * HALF_WINDOW_S)
    step = np.median(np.diff(bet.imu_time_s)) if len(bet.imu_time_s) > 1 else 0.0
    turning_radps = fastest_radps(vehicle, bet, air)
    wanted = _HALF_WINDOW_S if turning_radps <= 0.0 else min(_HALF_WINDOW_S, _MOST_TURN_RAD / turning_radps)
    h = min(HALF_WINDOW_S, max(wanted, _LEAST_SAMPLES * float(step)))
    arm = vehicle.cg_m - accelerometer.spec.position_from_datum_body_m
    at = cg_accelerations(bet, t, arm, h)
    velocity = air.velocity_air_body_mps[inside]
    root = bet.triad_root[inside]
    return FlightLoads(
        time_s=t,
        specific_force_body_mps2=at.specific_force_cg_mps2,
        force_noise_sd_mps2=float(accelerometer.spec.noise_sd / np.sqrt(at.samples)),
        force_root_mps2=root[:, 3:6],
        rate_root_radps=root[:, 6:9],
        flow_root_rad=angle_partials(velocity) @ rotations.skew(velocity) @ root[:, :3],
        rate_body_radps=at.rate_radps,
        angular_acceleration_body_radps2=at.angular_acceleration_radps2,
        angular_acceleration_sd_radps2=float(np.sqrt(2.0 / at.samples) * rates.spec.noise_sd / (2 * h)),
        flow_yz_rad=lateral_angles(velocity),
        flow_cov=air.lateral_flow_cov[inside],
        wind_flow_sd_rad=air.air.wind_sd_mps[inside] / velocity[:, 0],
        altitude_m=air.altitude_m[inside],
        mach=air.mach[inside],
        dynamic_pressure_pa=air.dynamic_pressure_pa[inside],
        dynamic_pressure_sd_pa=air.dynamic_pressure_sd_pa[inside],
        airspeed_mps=air.airspeed_mps[inside],
        vehicle=vehicle,
        point_from_datum_m=vehicle.cg_m,
        accelerometer_time_bias_sd_s=accelerometer.spec.time_bias_sd_s,
        gyro_time_bias_sd_s=rates.spec.time_bias_sd_s,
        cg_from_sensor_m=arm,
        half_window_s=h,
        swing_radps=turning_radps,
    )


def fastest_radps(vehicle: Vehicle, bet: TrajectorySolution, air: AirData) -> float:
    """Angular frequency, rad/s, of the transverse rates in body axes: rigid pitching with spin, at peak pressure."""
    peak = int(np.nanargmax(air.dynamic_pressure_pa))
    spin = float(np.interp(bet.smoothed.time_s[peak], bet.imu_time_s, bet.rate_body_radps[:, 0]))
    return pitching_radps(vehicle, float(air.mach[peak]), float(air.dynamic_pressure_pa[peak]), spin)


@dataclass(frozen=True)
class AttitudeCheck:
    """Attitude from directions, and its comparison with the trajectory's.

    Parameters
    ----------
    history : AttitudeHistory or None
        None where the sensors determine no attitude; a finding gives the reason.
    comparison : AttitudeComparison or None
    dependence : str
        ``"filter"`` or ``"start"`` where the trajectory itself depends on these sensors, empty where it does not.
    findings : tuple of Issue
    confidence : float
    """

    history: AttitudeHistory | None
    comparison: AttitudeComparison | None
    dependence: str
    findings: tuple[Issue, ...]
    confidence: float

    @property
    def remark(self) -> str:
        """Result in a sentence, with what limits it."""
        result = "" if self.comparison is None else self.comparison.words
        return "; ".join(part for part in (result, DEPENDENCE[self.dependence]) if part)

    @property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Size of the differences, their share inside three standard deviations, and the sensors' own residuals."""
        if self.comparison is None or self.history is None:
            return ()
        nees, inside = self.comparison.mean_nees, self.comparison.share_inside
        high, name, covers = chi_square_quantile(self.confidence, 3), "attitude check", inside >= LEAST_INSIDE
        return (
            Check("attitude-nees", f"{name} size", nees, 0.0, high, nees <= high, self.remark),
            Check("attitude-coverage", f"{name} share inside", inside, LEAST_INSIDE, 1.0, covers, self.remark),
            *(replace(check, name=f"{name} {check.name}") for check in self.history.consistency_checks),
        )


def check_attitude(telemetry: Telemetry, bet: TrajectorySolution) -> AttitudeCheck | None:
    """Compute attitude from directions and compare it with the trajectory's; None without sensors or attitude."""
    if telemetry.magnetometer is None or telemetry.sun is None or bet.provenance["motion"] == "ballistic":
        return None
    settings = bet.settings
    dependence = ""
    if settings.attitude_sensors:
        dependence = "filter"
    elif telemetry.attitude_prior is None:
        dependence = "start"
    history, comparison = None, None
    found: list[Issue] = []
    try:
        t, points = track(telemetry)
        ends = np.clip(bet.smoothed.time_s[[0, -1]], t[0], t[-1])
        at = np.union1d(t[(t > ends[0]) & (t < ends[1])], ends)
        place = at, interpolate_rows(at, t, points)
        history = reconstruct_attitude(telemetry, place, settings.check_confidence)
        comparison = compare_attitudes(history, bet.smoothed, settings.check_confidence)
        found += history.findings
    except GateError as fault:
        found.append(Issue(str(fault), "attitude-check-missing", "attitude check"))
    return AttitudeCheck(history, comparison, dependence, tuple(found), settings.check_confidence)


def attitude_table(check: AttitudeCheck, bet: TrajectorySolution) -> pd.DataFrame:
    """Return ``attitude_check.csv``: the independent attitude, its difference from the trajectory's, and all sds."""
    history, comparison = check.history, check.comparison
    assert history is not None
    assert comparison is not None
    rows = np.searchsorted(history.time_s, comparison.time_s)
    path = resample(bet.smoothed, comparison.time_s)
    assert path.covariance is not None
    latitude, longitude, _ = earth.geodetic_from_ecef(path.position_ecef_m, path.planet)
    dcm = earth.dcm_ned_ecef(latitude, longitude) @ rotations.dcm_from_q(history.q_ecef_body[rows])
    columns = {"t_s": comparison.time_s}
    angles = zip(("roll", "pitch", "yaw"), euler_321(dcm), strict=True)
    columns |= {f"{name}_ned_deg": np.rad2deg(angle) for name, angle in angles}
    parts = {
        "difference_{}_body_deg": comparison.difference_body_rad,
        "difference_{}_body_sd_deg": comparison.sd_body_rad,
        "independent_{}_body_sd_deg": np.sqrt(np.diagonal(history.covariance[rows], axis1=1, axis2=2)),
        "bet_{}_body_sd_deg": path.sd()[:, 6:9],
    }
    for pattern, values in parts.items():
        columns |= {pattern.format(a): np.rad2deg(column) for a, column in zip("xyz", values.T, strict=True)}
    return pd.DataFrame(columns)

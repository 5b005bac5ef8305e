"""From a flight to its best-estimated trajectory, the air along it, and the checks of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from estimators.loads import FlightLoads
from flightmodel import airdata
from flightmodel.airdata import AirData, peak_pressure
from flightmodel.atmosphere import BOTTOM_M, TOP_M, profile_from_sounding
from flightmodel.checks import DivergenceError, GateError, Progress
from flightmodel.earth import geodetic_from_ecef
from flightmodel.tabular import Tabular
from flightmodel.telemetry import Finding, Telemetry
from flightmodel.trajectory import Trajectory
from postflight.attitude import AttitudeCheck, check_attitude
from postflight.flight import Flight
from postflight.loads import loads_from_solution
from recon.atmosphere import ReconstructedAir, as_flown_atmosphere
from recon.consistency import ConsistencyCheck
from recon.fault_isolation import isolate_faults
from recon.reconstruct import TrajectorySolution
from recon.reconstruct import reconstruct as solve
from recon.settings import Settings


@dataclass(frozen=True, repr=False)
class Reconstruction(Tabular):
    """A flight with its best-estimated trajectory and the air it met.

    Parameters
    ----------
    flight : Flight
        What it was made from, with its assumptions.
    solution : TrajectorySolution
        Smoothed and filtered trajectory, sensor errors, residuals, consistency checks.
    air : AirData
        Along the trajectory, by the sounding.
    loads : PulseData or None
        Motion and flow at the c.g., for the estimators of the deflection; None where ``missing`` says why.
    as_flown : ReconstructedAir or None
        As-flown density, winds and C_A, from the deceleration.
    missing : tuple of str
        Why there are no loads or no as-flown atmosphere.
    attitude : AttitudeCheck or None
        Comparison with an attitude from magnetometer and Sun sensors alone.
    """

    flight: Flight
    solution: TrajectorySolution
    air: AirData
    loads: FlightLoads | None
    as_flown: ReconstructedAir | None = None
    missing: tuple[str, ...] = ()
    attitude: AttitudeCheck | None = None

    @property
    def telemetry(self) -> Telemetry:
        """What was measured."""
        return self.flight.telemetry

    @property
    def trajectory(self) -> Trajectory:
        """The best estimate: the smoothed trajectory of the datum."""
        return self.solution.smoothed

    @property
    def consistency_checks(self) -> tuple[ConsistencyCheck, ...]:
        """Checks of the trajectory, then of its attitude, then of the atmosphere."""
        attitude, air = (part.consistency_checks if part is not None else () for part in (self.attitude, self.as_flown))
        return self.solution.consistency_checks + attitude + air

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found in the data, on the way, and by the check of the attitude."""
        attitude = () if self.attitude is None else self.attitude.findings
        return (*self.telemetry.findings, *self.solution.findings, *attitude)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Fault hypotheses, the most likely first; none where every consistency check passes."""
        return isolate_faults(self.consistency_checks, self.solution.left_out)

    @property
    def has_attitude(self) -> bool:
        """Whether inertial sensors carried the attitude; in ballistic flight it is not known."""
        return self.solution.provenance["motion"] != "ballistic"

    def required_loads(self) -> FlightLoads:
        """Motion and flow at the c.g.; `GateError` with the reason where there are none."""
        if self.loads is None:
            raise GateError("; ".join(self.missing), "loads-missing")
        return self.loads

    @property
    def peak_s(self) -> float:
        """Time of peak dynamic pressure by the BET and the sounding's density, s."""
        return peak_pressure(self.air.time_s, self.air.dynamic_pressure_pa)[0]

    @property
    def peak_is_inside(self) -> bool:
        """Whether the largest dynamic pressure is a peak, not the first or last second of the data."""
        return self.air.time_s[0] + 1.0 < self.peak_s < self.air.time_s[-1] - 1.0

    def to_frame(self) -> pd.DataFrame:
        """The trajectory with air data and standard deviations: the columns of ``bet.csv`` (docs/bet-product.md)."""
        from postflight.product import bet_table

        return bet_table(self)

    def _about(self) -> str:
        checks = self.consistency_checks
        passed = f"{sum(c.passed for c in checks)} of {len(checks)} consistency checks pass"
        peak = f"peak q {self.air.dynamic_pressure_pa.max():.0f} Pa at {self.peak_s:.2f} s"
        return "; ".join((self.flight.name, peak, passed, *self.flight.changes))


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
    report = progress or (lambda _fraction, _what: None)
    if settings is not None:
        flight = replace(flight, settings=settings)
    report(0.0, "reconstructing")
    solution = solve(flight.telemetry, flight.settings, lambda f, what: report(0.95 * f, what))
    report(0.95, "checking the attitude")
    attitude = check_attitude(flight.telemetry, solution)
    report(0.97, "finding the as-flown atmosphere")
    found = replace(reconstruction_from(flight, solution), attitude=attitude)
    report(1.0, "reconstructed")
    return found


def reconstruction_from(flight: Flight, solution: TrajectorySolution) -> Reconstruction:
    """Air data, loads and as-flown atmosphere along a solution; `DivergenceError` where it leaves the air's tables."""
    telemetry = flight.telemetry
    _check_inside_tables(solution.smoothed)
    air = air_data(solution.smoothed, flight)
    loads, as_flown, missing = None, None, []
    try:
        telemetry.required_vehicle()
        telemetry.required_triads()
        loads = loads_from_solution(telemetry, solution, air)
        profile = profile_from_sounding(telemetry.sounding)
        as_flown = as_flown_atmosphere(telemetry, solution, profile, solution.settings.check_confidence)
    except GateError as fault:
        missing.append(str(fault))
    return Reconstruction(flight, solution, air, loads, as_flown, tuple(missing))


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
    vehicle = flight.vehicle
    profile = profile_from_sounding(flight.telemetry.sounding)
    return airdata.air_data(trajectory, profile, np.zeros(3) if vehicle is None else vehicle.cg_m)


def _check_inside_tables(trajectory: Trajectory) -> None:
    """Raise `DivergenceError` where the reconstruction left the ground or the atmosphere's tables."""
    _, _, altitude_m = geodetic_from_ecef(trajectory.position_ecef_m)
    wrong = (altitude_m < BOTTOM_M) | (altitude_m > TOP_M)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DivergenceError(
            f"reconstruction: diverged: at {trajectory.time_s[k]:.1f} s the altitude is {altitude_m[k] / 1000:.1f} km. "
            "Check the accelerometer's and gyros' units, signs and mounting, and the attitude prior",
            "trajectory-diverged",
        )

"""Are the aerodynamic increments as uncertain as stated, and does the table as flown fly as the vehicle flew?

Run: ``python benchmarks/aero_increments.py [FLIGHTS [FIRST SEED]] [--bands] [--camera]`` (24 flights from seed 2000).
Some 5 s a flight, with ``--bands`` 12 s. Flights are `tests.wide_flights`, 60 to 400 kg at 0 to 60 rpm, of another
table: each coefficient errs along Mach number, by a constant and a Gauss-Markov process of half the variance each.
Scored are the increments at every knot of Mach number at which they are given, all flights' together, and whether a
check is red. Knots of one flight are correlated: the shares of so many flights are those of some two independent
numbers a flight and coefficient. ``--camera`` adds a camera's history, drawn and not rendered, of 0.15 deg.

``--bands``: the flight is flown again a hundred times from its reconstructed state at 100 km, with coefficients, mass
properties and density drawn from the joint posterior of the increments, winds as flown, and the joint that flew, which
a reconciliation finds to 1 %. Of the pulse's samples of the centerbody's angle of attack and normal acceleration, as
reconstructed, the share inside 2.3 to 97.7 % is printed, and the same for the preflight table and mass properties with
their stated uncertainty, with the ratio of the bands' widths. A flight whose reconstruction has a red check is left
out and named: its trajectory is not to be believed.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.estimator_coverage import CAMERA_SD, camera_history, columns
from estimators.evidence import PRESSURE, VEHICLE_INPUTS, moved_vehicle, pressure_input
from estimators.fusing import fuse_flight
from estimators.increments import COEFFICIENTS, SHAPE_LENGTH, STATED
from flightmodel import rotations
from flightmodel.airdata import pressure_pulse
from flightmodel.atmosphere import WIND_LENGTH_M, profile_from_sounding, sounding_correlation_root
from flightmodel.checks import GateError
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.statistics import BAND_PERCENTILES, correlation
from flightmodel.trajectory import resample
from postflight.flight import Flight
from postflight.flown_coefficients import increments_of
from postflight.reconstruction import reconstruct
from recon.settings import Settings
from synthetic_flight import simulate
from synthetic_flight.ensemble import Records
from synthetic_flight.simulate import state_from_ecef
from tests import wide_flights

SHAPE_PART, RATE_HZ, CONFIDENCE = 0.5, 20.0, 0.999
START_ALTITUDE_M, STEP_S, PER_RECORD, DRAWS = 100e3, 0.002, 25, 100


def shaped_flight(seed):
    """Flight of `tests.wide_flights` whose table errs along Mach number; the errors (4, 47) at ``SHAPE_MACH``."""
    one = wide_flights.wide_flight(seed, SHAPE_PART)
    known, mach = one.stated.uncertainty, wide_flights.SHAPE_MACH
    root = np.linalg.cholesky(correlation(np.log(mach), SHAPE_LENGTH, 1.0 - SHAPE_PART))
    rng = np.random.default_rng([seed, 22, 2009])
    error = (root @ rng.standard_normal((len(mach), len(STATED)))).T
    error *= np.array([getattr(known, name) for name in STATED])[:, None]
    aero = one.stated.aero
    at = np.union1d(aero.mach, mach)
    c = aero.at(at[:, None], aero.alpha_rad)
    change = np.stack([np.interp(at, mach, e) for e in error], -1)[:, None, :]
    c[..., :3] *= 1.0 + change[..., :3]
    c[..., 3] += change[..., 3]
    flown = replace(one.flown, aero=replace(aero, mach=at, coefficients=c))
    return replace(one, scenario=replace(one.scenario, vehicle=flown)), error


def answered(seed, camera):
    """Flight, its errors, reconstruction, fused answer, increments."""
    one, error = shaped_flight(seed)
    with tempfile.TemporaryDirectory() as temporary:
        telemetry, truth = wide_flights.flown(one, Path(temporary) / "flight")
    if truth.remark:
        raise GateError(truth.remark, "tumbled")
    bet = reconstruct(Flight(telemetry, Settings(output_rate_hz=RATE_HZ)))
    loads, history = bet.required_loads(), None
    if camera:
        t = loads.time_s[loads.through_pulse]
        true = columns(t, truth.time_s, truth.deflection.theta_yz_rad)
        history = camera_history(np.random.default_rng([seed, 3, 2009]), true, t, CAMERA_SD["clean"])
    answer = fuse_flight(loads, history)
    return one, error, bet, increments_of(answer, CONFIDENCE, f"seed {seed}")


def scored(found, error):
    """Error over its sd, and sd over the a priori one, at the knots where an increment is given, by coefficient."""
    out = {}
    for k, name in enumerate(COEFFICIENTS):
        seen = found.determined[k]
        true = np.interp(found.found.mach, wide_flights.SHAPE_MACH, error[k])
        z = (found.found.mean[k] - true) / found.sd[k]
        out[name] = np.stack([z[seen], found.sd[k][seen] / found.found.processes.stated_sd[k]])
    return out


class Entries:
    """One flight's own entry, ready to be flown from its start with drawn vehicles and air."""

    def __init__(self, one, bet, found):
        self.bet, self.found, air = bet, found, bet.air
        below = np.flatnonzero((air.altitude_m < START_ALTITUDE_M) & (air.flight_path_angle_rad < 0.0))
        self.start_s = float(air.time_s[below[0]])
        self.pulse_s = air.time_s[pressure_pulse(air.dynamic_pressure_pa)][[0, -1]]
        self.records = round((self.pulse_s[1] - self.start_s) / (STEP_S * PER_RECORD)) + 2
        self.at_start = resample(bet.solution.smoothed, np.array([self.start_s]))
        self.start_root = self._start_root()
        self.stated = replace(found.pulse.vehicle, joint=one.flown.joint)
        self.profile = profile_from_sounding(bet.telemetry.sounding)

    def _start_root(self):
        """Root (12, 12) of the start's covariance: place, velocity, attitude, and the rate correlated with it."""
        solution = self.bet.solution
        k = int(np.argmin(np.abs(solution.smoothed.time_s - self.start_s)))
        root, cov = solution.triad_root[k], np.zeros((12, 12))
        cov[:9, :9], cov[9:, 9:] = self.at_start.covariance[0], solution.rate_cov[k]
        cov[6:9, 9:] = root[0:3] @ root[6:9].T
        cov[9:, 6:9] = cov[6:9, 9:].T
        sd = np.sqrt(np.diag(cov))
        value, axes = np.linalg.eigh(cov / np.outer(sd, sd))
        return sd[:, None] * axes * np.sqrt(np.maximum(value, 0.0))

    def bands(self, posterior, rng):
        """Bands (3, n) of angle of attack, deg, and normal acceleration, g, and their times."""
        flown = [
            self._flown(*(self._of_posterior(rng) if posterior else self._of_prior(rng)), rng) for _ in range(DRAWS)
        ]
        alpha, normal = (np.array(part) for part in zip(*flown, strict=True))
        time_s = self.start_s + STEP_S * PER_RECORD * np.arange(self.records)
        # places k / (n + 1) of so few draws: between those limits lies what is said on average, not 2 % less
        return time_s, *(np.percentile(x, BAND_PERCENTILES, axis=0, method="weibull") for x in (alpha, normal))

    def _of_posterior(self, rng):
        """Vehicle and log density ratio along the profile's altitude by one draw of the joint posterior."""
        increments = self.found.found
        at = increments.posterior
        x = at.mean + np.linalg.cholesky(at.covariance) @ rng.standard_normal(len(at.mean))
        moved = {n: float(x[at.place[n]][0]) for n in VEHICLE_INPUTS if n in at.place and n not in COEFFICIENTS}
        vehicle = moved_vehicle(self.stated, moved)
        vehicle = replace(vehicle, aero=increments.processes.flown(self.stated.aero, increments.of(x)))
        pulse = self.found.pulse
        change = np.log1p(pressure_input(pulse) @ x[at.place[PRESSURE]])
        rising = np.argsort(pulse.altitude_m)
        return vehicle, np.interp(self.profile.altitude_m, pulse.altitude_m[rising], change[rising])

    def _of_prior(self, rng):
        """Vehicle and log density ratio by one draw of what is stated before the flight."""
        vehicle = moved_vehicle(
            self.stated, {n: rng.standard_normal() for n in VEHICLE_INPUTS if n not in COEFFICIENTS}
        )
        processes = self.found.found.processes
        increments = np.array([root @ rng.standard_normal(root.shape[1]) for root in processes.roots()])
        vehicle = replace(vehicle, aero=processes.flown(self.stated.aero, increments))
        root = sounding_correlation_root(self.profile.altitude_m, 5000.0)
        return vehicle, self.profile.density_sd * (root @ rng.standard_normal(root.shape[1]))

    def _flown(self, vehicle, log_density, rng):
        """Angle of attack, deg, and normal acceleration, g (records,) of one flight."""
        z, day = self.profile.altitude_m, self.bet.as_flown.profile
        wind = self.profile.wind_ned_mps.copy()
        root = sounding_correlation_root(z, WIND_LENGTH_M)
        for axis, way in enumerate(("north", "east")):
            change, sd = (np.interp(z, day.altitude_m, day[f"wind_{way}_{c}"]) for c in ("change_mps", "sd_mps"))
            wind[:, axis] += change + sd * (root @ rng.standard_normal(root.shape[1]))
        ratio = self.profile.log_density_ratio + log_density
        air = simulate.atmosphere_table(replace(self.profile, log_density_ratio=ratio, wind_ned_mps=wind))
        off = self.start_root @ rng.standard_normal(12)
        q = rotations.boxplus(self.at_start.q_ecef_body[0], off[6:9])
        position = self.at_start.position_ecef_m[0] + off[:3] + rotations.rotate(q, vehicle.cg_m)
        velocity = self.at_start.velocity_ecef_mps[0] + off[3:6]
        omega = self.at_start.omega_body_eci_body_radps[0] + off[9:12]
        state = state_from_ecef(self.start_s, position, velocity, q, omega)
        states, aux = simulate.integrate(vehicle, air, state, STEP_S, PER_RECORD, self.records)
        flown = Records(states, aux, vehicle, air)
        rows = np.minimum(np.arange(self.records), len(aux) - 1)
        return flown.alpha_total_deg[rows], flown.normal_g[rows]

    def shares(self, time_s, alpha, normal):
        """Share of the pulse's samples inside the bands, of both quantities, and the bands' mean widths."""
        loads = self.bet.required_loads()
        use = (loads.time_s >= self.pulse_s[0]) & (loads.time_s <= self.pulse_s[1])
        t = loads.time_s[use]
        own = (
            np.rad2deg(np.interp(t, self.bet.air.time_s, self.bet.air.alpha_total_wind_rad)),
            np.hypot(*loads.specific_force_body_mps2[use, 1:].T) / STANDARD_GRAVITY_MPS2,
        )
        out = []
        for values, band in zip(own, (alpha, normal), strict=True):
            low, high = (np.interp(t, time_s, band[k]) for k in (0, 2))
            out += [float(np.mean((values >= low) & (values <= high))), float(np.mean(high - low))]
        return np.array(out)


def bands(seed, one, bet, found):
    entries = Entries(one, bet, found)
    after, before = (
        entries.shares(*entries.bands(posterior, np.random.default_rng([seed, 7, 2009]))) for posterior in (True, False)
    )
    words = ", ".join(
        f"{name} {100 * after[k]:.0f} % inside as flown, {100 * before[k]:.0f} % before, "
        f"bands {after[k + 1] / before[k + 1]:.2f} as wide"
        for k, name in ((0, "alpha"), (2, "normal"))
    )
    print(f"{seed}: {words}", flush=True)
    return np.concatenate([after, before])


def report(flights):
    for name in COEFFICIENTS:
        z, kept = np.concatenate([scores[name] for scores in flights], axis=1)
        if not len(z):
            print(f"{name:5} determined by none")
            continue
        per_flight = [np.sqrt(np.mean(scores[name][0] ** 2)) for scores in flights if scores[name].size]
        inside = [100.0 * np.mean(np.abs(z) < k) for k in (1, 2)]
        words = f"rms z {np.sqrt(np.mean(z**2)):.2f}, bias {z.mean():+.2f}"
        words += f", inside 1, 2 sd: {inside[0]:.0f}, {inside[1]:.0f} %"
        kept_words = f"sd over a priori {np.median(kept):.2f}; worst flight's rms {max(per_flight):.1f}"
        print(f"{name:5} {len(z):4d} knots of {len(per_flight)} flights: {words}; {kept_words}")


def main():
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    count, first = numbers + [24, 2000][len(numbers) :]
    flights, flown, red = [], [], []
    for seed in range(first, first + count):
        try:
            one, error, bet, found = answered(seed, "--camera" in sys.argv)
        except GateError as fault:
            print(f"{seed}: {fault}; left out", flush=True)
            continue
        flights.append(scored(found, error))
        red += [f"{seed} {check.component}" for check in found.consistency_checks if not check.passed]
        if unsound := sorted({check.code for check in bet.consistency_checks if not check.passed}):
            print(f"{seed}: reconstruction red ({', '.join(unsound)}); bands left out", flush=True)
        elif "--bands" in sys.argv:
            flown.append(bands(seed, one, bet, found))
    print(f"\n{len(flights)} flights from seed {first}; red checks: {', '.join(red) or 'none'}")
    report(flights)
    if flown:
        mean = np.mean(flown, axis=0)
        print(f"inside the bands: alpha {100 * mean[0]:.0f} %, normal {100 * mean[2]:.0f} %")


if __name__ == "__main__":
    main()

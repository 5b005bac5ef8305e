"""Flights of one scenario that differ as real ones do, from simulator to reconstruction, scored at chosen epochs.

Start, spin, nose direction, mass properties, joint, air and every instrument's errors are drawn anew for each seed;
the analyst is told the nominal vehicle and what data sheets say. Nothing is passed to the reconstruction but the
flight folder's telemetry. Errors are compared in north, east, down and body axes.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binom, chi2, norm

from flightmodel import earth
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import difference, resample
from recon.reconstruct import reconstruct
from recon.settings import Settings
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

FROM_S, TO_S = 380.0, 465.0  # the pulse lies between 421 and 448 s
PEAK_OFFSETS_S = (-14.0, -8.0, -4.0, 0.0, 5.0, 12.0)  # epochs, from each flight's own peak of dynamic pressure
GROUPS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9), "all nine": slice(0, 9)}
COMPONENTS = (
    "position north", "position east", "position down", "velocity north", "velocity east", "velocity down",
    "rotation x", "rotation y", "rotation z",
)  # fmt: skip
SHARES = tuple(2.0 * norm.cdf(k) - 1.0 for k in (1, 2, 3))


def dispersed_scenario(name, seed, start_sd=1.0):
    """Scenario of one seed, cropped to the entry, without video."""
    scenario = read_scenario(name)
    rng = np.random.default_rng([seed, 2009])

    def around(value, sd):
        return float(value + start_sd * sd * rng.standard_normal())

    first = scenario.spec.initial
    initial = first.model_copy(
        update={
            "latitude_deg": around(first.latitude_deg, 0.01),
            "longitude_deg": around(first.longitude_deg, 0.01),
            "altitude_m": around(first.altitude_m, 500.0),
            "speed_mps": around(first.speed_mps, 5.0),
            "flight_path_deg": around(first.flight_path_deg, 0.2),
            "azimuth_deg": around(first.azimuth_deg, 0.5),
            "nose_azimuth_deg": around(first.nose_azimuth_deg, 3.0),
            "nose_elevation_deg": around(first.nose_elevation_deg, 1.0),
            "roll_deg": float(rng.uniform(-180.0, 180.0)),
            "spin_rpm": around(first.spin_rpm, 1.0),
        }
    )
    time = scenario.spec.time.model_copy(update={"telemetry_from_s": FROM_S, "stop_s": TO_S})
    prior = scenario.spec.attitude_prior.model_copy(update={"t_s": FROM_S})
    spec = scenario.spec.model_copy(update={"initial": initial, "time": time, "attitude_prior": prior, "video": None})
    return replace(scenario, spec=spec, vehicle=dispersed_vehicle(scenario.vehicle, rng))


def dispersed_vehicle(vehicle, rng):
    """Vehicle whose masses, c.g.s, inertias and joint are not those that the analyst is told."""
    known = vehicle.uncertainty

    def body(part):
        cg = part.cg_m + rng.standard_normal(3) * [known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m]
        inertia = part.inertia * (1.0 + known.inertia * rng.standard_normal())
        mass = part.mass_kg * (1.0 + known.mass * rng.standard_normal())
        return part.model_copy(
            update={
                "mass_kg": mass,
                "cg_from_datum_body_m": tuple(cg.tolist()),
                "inertia_kgm2": tuple(map(tuple, inertia.tolist())),
            }
        )

    joint = vehicle.joint.model_copy(
        update={
            "bending_stiffness_nmprad": vehicle.joint.bending_stiffness_nmprad * (1.0 + 0.03 * rng.standard_normal()),
            "bending_damping_nmsprad": vehicle.joint.bending_damping_nmsprad * np.exp(0.3 * rng.standard_normal()),
        }
    )
    return replace(vehicle, aeroshell=body(vehicle.aeroshell), centerbody=body(vehicle.centerbody), joint=joint)


@dataclass(frozen=True)
class Scored:
    """Errors (e, 9) and covariances (e, 9, 9) at the epochs, smoothed and filtered; the peak; what went red."""

    seed: int
    words: str
    peak_s: float
    peak_pa: float
    smoothed: tuple[np.ndarray, np.ndarray]
    filtered: tuple[np.ndarray, np.ndarray]
    red: tuple[str, ...]
    consistency_checks: int


def scored(trajectory, truth, at_s):
    """Errors (e, 9) and covariances (e, 9, 9) in north, east, down and body axes."""
    rows = np.searchsorted(trajectory.time_s, at_s)
    true = resample(truth, trajectory.time_s[rows])
    d, p = difference(resample(trajectory, trajectory.time_s[rows]), true), trajectory.covariance[rows]
    turn = np.zeros((len(rows), 9, 9))
    for k, place in enumerate(true.position_ecef_m):
        latitude, longitude, _ = earth.geodetic_from_ecef(place)
        turn[k, 0:3, 0:3] = turn[k, 3:6, 3:6] = earth.dcm_ned_ecef(float(latitude), float(longitude))
        turn[k, 6:9, 6:9] = np.eye(3)
    return np.einsum("nij,nj->ni", turn, d), turn @ p @ np.swapaxes(turn, 1, 2)


def fly_and_score(seed, scenario="irve2_reference", settings=None):
    """One seed, from its start to the scores."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        truth = simulate_to_folder(dispersed_scenario(scenario, seed), seed, folder)
        telemetry = read_flight(folder)
    bet = reconstruct(telemetry, settings or Settings(output_rate_hz=10.0))
    peak = float(truth.time_s[np.argmax(truth.dynamic_pressure_pa)])
    at = np.round(peak + np.array(PEAK_OFFSETS_S), 1) - 1e-6
    return Scored(
        seed,
        truth.remark,
        peak,
        float(truth.dynamic_pressure_pa.max()),
        scored(bet.smoothed, truth.trajectory, at),
        scored(bet.filtered, truth.trajectory, at),
        tuple(v.name for v in bet.consistency_checks if not v.passed),
        len(bet.consistency_checks),
    )


def fly_all(seeds, scenario="irve2_reference", settings=None, workers=2):
    """All seeds, in order, on a few processes."""
    one = partial(fly_and_score, scenario=scenario, settings=settings)
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("fork")) as pool:
        return list(pool.map(one, seeds))


def nees(flights, which="smoothed"):
    """Normalised squared errors (flights, epochs) of each group."""
    e, p = (np.array([getattr(f, which)[i] for f in flights]) for i in (0, 1))
    out = {}
    for name, part in GROUPS.items():
        d = e[..., part]
        out[name] = np.einsum("fei,fei->fe", d, np.linalg.solve(p[..., part, part], d[..., None])[..., 0])
    return out


def nees_band(degrees, flights, confidence):
    """Two-sided band of a mean of chi-squares."""
    tail = 0.5 * (1.0 - confidence)
    return chi2.ppf([tail, 1.0 - tail], degrees * flights) / flights


def normalised(flights, which="smoothed"):
    """Errors over their standard deviations (flights, epochs, 9)."""
    e, p = (np.array([getattr(f, which)[i] for f in flights]) for i in (0, 1))
    return e / np.sqrt(np.diagonal(p, axis1=2, axis2=3))


def coverage(z):
    """Shares of |z| (flights, ...) inside 1, 2 and 3: (3, ...)."""
    return np.array([(np.abs(z) < k).mean(axis=0) for k in (1, 2, 3)])


def coverage_band(flights, confidence):
    """Shares (3, 2) between which 1, 2 and 3 sd coverage of independent flights stays with a confidence."""
    tail = 0.5 * (1.0 - confidence)
    return np.array([[binom.ppf(tail, flights, s), binom.ppf(1.0 - tail, flights, s)] for s in SHARES]) / flights

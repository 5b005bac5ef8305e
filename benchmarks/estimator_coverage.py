"""Do the deflection estimates err as they say? Dispersed flights with every error alive, scored at peak pressure.

Run: ``python benchmarks/estimator_coverage.py [FLIGHTS] [FOLDER]`` (100, /tmp/estimator_coverage). Drawn anew for each
seed: side and size of the offset that the analyst is told, and what the analyst is not told: masses, c.g.s, inertias,
joint, coefficients (`docs` of the sizes: C_A 5 %, C_N 10 %, C_m 15 %, C_mq 0.15 between Mach 1.2 and 5), start, spin,
air, the sounding's and every instrument's errors. No video. Some 5 s a flight on each of two cores; what the
estimators see and the truth are kept in FOLDER, so that the estimators can be scored again without flying.
"""

import multiprocessing
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from estimators.pulse import PulseData
from flightmodel.airdata import air_data, lateral_angles, peak_pressure
from flightmodel.atmosphere import profile_from_sounding
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import resample
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.sensed import pulse_data
from recon.bet import Settings, reconstruct
from synthetic_flight.folder import simulate_to_folder
from tests.recon import dispersed

KEPT = "/tmp/estimator_coverage"
COEFFICIENT_SD = {"ca": 0.05, "cn": 0.10, "cm": 0.15}
CMQ_SD = 0.15
RATE_HZ = 20.0
ARRAYS = [f.name for f in fields(PulseData) if f.name != "vehicle"]
PERCENT = (60.0, 76.0), (91.0, 98.0)  # what 1 and 2 sd must cover


def told_vehicle(seed):
    """Vehicle as the analyst knows it: the reference one with an offset of random side and size."""
    rng = np.random.default_rng([seed, 1, 2009])
    nominal = vehicle_from_toml(vehicle_path("irve2_reference"))
    clock, size = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0015, 0.0050)
    body = nominal.centerbody
    lateral = size * nominal.mass_kg / body.mass_kg * np.array([-np.cos(clock), np.sin(clock)])
    moved = body.model_copy(update={"cg_from_datum_body_m": (body.cg_from_datum_body_m[0], *map(float, lateral))})
    known = nominal.uncertainty.model_copy(update=COEFFICIENT_SD)
    return replace(nominal, centerbody=moved, uncertainty=known)


def flown_vehicle(told, seed, rigid=False):
    """Vehicle as it is: every number drawn around what is told, in the sizes that are told; and the drawn factors."""
    rng = np.random.default_rng([seed, 2, 2009])
    flown = dispersed.dispersed_vehicle(told, rng)
    known = told.uncertainty
    factors = {k: 1.0 + getattr(known, k) * rng.standard_normal() for k in ("ca", "cn", "cm")}
    joint = flown.joint.model_copy(
        update={
            "bending_stiffness_nmprad": told.joint.bending_stiffness_nmprad * (300.0 if rigid else rng.uniform(1, 1.3)),
            "bending_damping_nmsprad": flown.joint.bending_damping_nmsprad * (100.0 if rigid else 1.0),
        }
    )
    aero = flown.aero.scaled(**factors, cmq_shift=CMQ_SD * rng.standard_normal())
    return replace(flown, joint=joint, aero=aero), factors


def flown_pulse(seed, rigid=False):
    """One flight: what the estimators see (`PulseData`), and the truth at the same times."""
    told = told_vehicle(seed)
    flown, factors = flown_vehicle(told, seed, rigid)
    scenario = replace(dispersed.dispersed_scenario("irve2_reference", seed), vehicle=flown)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        truth = simulate_to_folder(scenario, seed, folder)
        telemetry = replace(read_flight(folder), vehicle=told)
    bet = reconstruct(telemetry, Settings(output_rate_hz=RATE_HZ))
    pulse = pulse_data(telemetry, bet, air_data(bet.smoothed, profile_from_sounding(telemetry.sounding), told.cg_m))
    t = pulse.time_s
    path = resample(truth.trajectory, t)
    air = air_data(path, truth.profile, flown.cg_m)
    bent = truth.deflection.theta_yz_rad
    turned = np.gradient(np.gradient(bent, truth.time_s, axis=0), truth.time_s, axis=0)
    force = truth.specific_force_body(told.cg_m)
    known = {
        "theta_yz": columns(t, truth.time_s, bent),
        "theta_yz_second": columns(t, truth.time_s, turned),
        "flow_yz": lateral_angles(air.velocity_air_body_mps),
        "pressure": air.dynamic_pressure_pa,
        "mach": air.mach,
        "force": columns(t, truth.time_s, force),
        "turn": columns(t, truth.time_s, truth.angular_acceleration_body_radps2),
        "factors": np.array([factors[k] for k in ("ca", "cn", "cm")]),
        "offset": flown.cg_m - told.cg_m,
        "peak": np.array(peak_pressure(truth.time_s, truth.dynamic_pressure_pa)[0]),
        "words": np.array(truth.words),
    }
    return pulse, known


def columns(at, time_s, values):
    return np.stack([np.interp(at, time_s, c) for c in values.T], axis=-1)


def kept_path(folder, seed, rigid):
    return Path(folder) / f"{'rigid' if rigid else 'flight'}_{seed:04d}.npz"


def fly_and_keep(seed, folder, rigid):
    pulse, truth = flown_pulse(seed, rigid)
    data = {f"pulse_{k}": getattr(pulse, k) for k in ARRAYS} | {f"true_{k}": v for k, v in truth.items()}
    np.savez(kept_path(folder, seed, rigid), **data)
    return seed, str(truth["words"])


def kept_flight(folder, seed, rigid=False):
    """Return `PulseData` and truth of a flight that was kept."""
    with np.load(kept_path(folder, seed, rigid)) as data:
        arrays = {k: data[f"pulse_{k}"] for k in ARRAYS}
        arrays["angular_acceleration_sd_radps2"] = float(arrays["angular_acceleration_sd_radps2"])
        truth = {k.removeprefix("true_"): data[k] for k in data.files if k.startswith("true_")}
    return PulseData(**arrays, vehicle=told_vehicle(seed)), truth


def fly_missing(folder, seeds, rigid=False, workers=2):
    """Fly what is not kept yet, and say how far it is."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    missing = [s for s in seeds if not kept_path(folder, s, rigid).exists()]
    begun = time.perf_counter()
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("fork")) as pool:
        jobs = [pool.submit(fly_and_keep, s, folder, rigid) for s in missing]
        for k, job in enumerate(as_completed(jobs), 1):
            seed, words = job.result()
            left = (time.perf_counter() - begun) / k * (len(jobs) - k)
            print(f"flight {seed} kept, {k} of {len(jobs)}, {left:.0f} s left {words}", flush=True)


def main():
    count = next((int(a) for a in sys.argv[1:] if a.isdigit()), 100)
    folder = next((a for a in sys.argv[1:] if not a.isdigit() and not a.startswith("-")), KEPT)
    fly_missing(folder, range(count), "--rigid" in sys.argv)


if __name__ == "__main__":
    main()

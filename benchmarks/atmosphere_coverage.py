"""Are the as-flown density, the C_A scale and the winds as uncertain as stated? Flights far from the reference vehicle.

Run: ``python benchmarks/atmosphere_coverage.py [FLIGHTS [FIRST SEED]] [--exact-shape] [--packages FOLDER]`` (40 flights
from seed 100). Some 4 s a flight. Flights are `tests.wide_flights`; half of the variance of C_A's error changes with
Mach number, or none of it with ``--exact-shape``, and the analyst knows which. Scored are, every kilometre, the true
density over the sounding's and both winds, and in every flight the C_A scale: the log of flown over stated ``C_A / m``,
mean over the pressure pulse, since a force over a mass is what an accelerometer sees. Every flight is scored with the
simulator's sounding, whose mean level errs by 0.6 sd, and with one drawn as the estimator takes it (0.7 sd).

``--packages`` scores flights of another simulator too: each a flight folder with ``truth/truth.csv`` (``t_s``, ECEF
position and velocity, ``dynamic_pressure_pa``) and ``truth/summary.json`` (``coefficient_factors``, ``vehicle`` with
``mass_shell`` and ``mass_body``). Their density is that of the dynamic pressure, with the sounding's wind in the
airspeed: 2 m/s across at 1 km/s are 0.1 % of density.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from flightmodel import earth
from flightmodel.atmosphere import (
    DENSITY_LENGTH_M,
    WIND_LENGTH_M,
    AtmosphereProfile,
    profile_from_sounding,
    sounding_correlation_root,
    us76,
)
from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from recon.atmosphere import as_flown_atmosphere
from recon.reconstruct import reconstruct
from recon.settings import Settings
from tests.wide_flights import flown, wide_flight

SHAPE_PART, ENTRY_S, CONFIDENCE = 0.5, 400.0, 0.999


def stated_sounding(true, stated, rng):
    """Sounding of the true air whose errors are drawn as they are stated."""
    z = np.arange(0.0, stated.altitude_m[-1] + 1.0, 250.0)
    air, standard = true.at(z), us76(z)
    density_sd, wind_sd = (np.interp(z, stated.altitude_m, sd) for sd in (stated.density_sd, stated.wind_sd_mps))

    def error(length):
        root = sounding_correlation_root(z, length)
        return root @ rng.standard_normal(root.shape[1])

    winds = [wind_sd * error(WIND_LENGTH_M), wind_sd * error(WIND_LENGTH_M), 0.0 * z]
    return AtmosphereProfile(
        z,
        np.log(air.density_kgpm3 / standard[0]) + density_sd * error(DENSITY_LENGTH_M),
        air.temperature_k - standard[1],
        air.wind_ned_mps + np.column_stack(winds),
        density_sd,
        wind_sd,
    )


def errors_of(found, ratio, wind_change, ca):
    """Errors and standard deviations (k, 2) of density ratio, winds (where the truth is known) and C_A scale."""
    p, scale = found.profile, found.parameters.iloc[0]
    out = {"density": np.column_stack([p.density_ratio - ratio, p.density_ratio_sd])}
    if wind_change is not None:
        pairs = [
            np.column_stack([p[f"wind_{way}_change_mps"] - wind_change[:, k], p[f"wind_{way}_sd_mps"]])
            for k, way in enumerate(("north", "east"))
        ]
        out["wind"] = np.concatenate(pairs)
    out["C_A scale"] = np.array([[scale.estimate - ca, scale.sd]])
    out["sounding"] = np.column_stack([1.0 - ratio, p.density_ratio_prior_sd])
    return out


def wide(seed, shape_part):
    """Errors of one drawn flight and its red checks, with the simulator's sounding and with one as stated."""
    one = wide_flight(seed, shape_part)
    with tempfile.TemporaryDirectory() as temporary:
        telemetry, truth = flown(one, Path(temporary) / "flight")
    solution, sounding = reconstruct(telemetry, Settings()), profile_from_sounding(telemetry.sounding)
    other = stated_sounding(truth.profile, sounding, np.random.default_rng([seed, 5, 2009]))
    return [scored(one, telemetry, solution, truth, sounded) for sounded in (sounding, other)]


def scored(one, telemetry, solution, truth, sounded):
    """Errors with one sounding, and the red checks."""
    found = as_flown_atmosphere(telemetry, solution, sounded, CONFIDENCE)
    altitude = found.profile.altitude_m.to_numpy()
    true, stated = truth.profile.at(altitude), sounded.at(altitude)
    q = found.drag.dynamic_pressure_pa
    in_pulse = found.drag.mach[q >= 0.5 * q.max()].to_numpy()
    ca = np.log(one.ca_factor(in_pulse) * one.stated.mass_kg / one.flown.mass_kg).mean()
    wind = (true.wind_ned_mps - stated.wind_ned_mps)[:, :2]
    return errors_of(found, true.density_kgpm3 / stated.density_kgpm3, wind, ca), red(found)


def package(folder, shape_part):
    """Errors of one flight of another simulator, and its red checks."""
    telemetry = read_flight(folder)
    vehicle = telemetry.required_vehicle()
    known = vehicle.uncertainty.model_copy(update={"ca_shape_part": shape_part})
    telemetry = replace(telemetry, vehicle=replace(vehicle, uncertainty=known))
    sounded = profile_from_sounding(telemetry.sounding)
    found = as_flown_atmosphere(telemetry, reconstruct(telemetry, Settings()), sounded, CONFIDENCE)
    truth = np.genfromtxt(folder / "truth" / "truth.csv", delimiter=",", names=True)
    truth = truth[truth["t_s"] > ENTRY_S]
    about = json.loads((folder / "truth" / "summary.json").read_text())
    place = np.column_stack([truth[f"{axis}_ecef_m"] for axis in "xyz"])
    velocity = np.column_stack([truth[f"v{axis}_ecef_mps"] for axis in "xyz"])
    latitude, longitude, altitude = earth.geodetic_from_ecef(place)
    stated = sounded.at(altitude)
    ned = np.einsum("nij,nj->ni", earth.dcm_ned_ecef(latitude, longitude), velocity)
    speed = np.linalg.norm(ned - stated.wind_ned_mps, axis=1)
    ratio = 2.0 * truth["dynamic_pressure_pa"] / speed**2 / stated.density_kgpm3
    order = np.argsort(altitude)
    at = found.profile.altitude_m.to_numpy()
    mass = about["vehicle"]["mass_shell"] + about["vehicle"]["mass_body"]
    ca = np.log(about["coefficient_factors"]["CA"] * vehicle.mass_kg / mass)
    return errors_of(found, np.interp(at, altitude[order], ratio[order]), None, ca), red(found)


def red(found):
    return [v.name for v in found.consistency_checks if not v.passed]


def report(title, flights):
    print(f"\n{title}: {len(flights)} flights, {sum(bool(names) for _, names in flights)} with a red check")
    print(f"{'':12}  rms z   bias   1 sd %  2 sd %   rms error    mean sd")
    for name in flights[0][0]:
        error, sd = np.concatenate([f[name] for f, _ in flights]).T
        z = error / sd
        inside = [100.0 * np.mean(np.abs(z) < k) for k in (1, 2)]
        words = f"{name:12}{np.sqrt(np.mean(z**2)):7.2f}{z.mean():+7.2f}{inside[0]:9.0f}{inside[1]:8.0f}"
        print(f"{words}{np.sqrt(np.mean(error**2)):12.4f}{sd.mean():11.4f}")


def option(name):
    return sys.argv[sys.argv.index(name) + 1] if name in sys.argv else None


def main():
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    count, first = numbers + [40, 100][len(numbers) :]
    shape_part = 0.0 if "--exact-shape" in sys.argv else SHAPE_PART
    flights = []
    for seed in range(first, first + count):
        try:
            flights.append(wide(seed, shape_part))
        except GateError as fault:
            print(f"{seed}: {fault}; left out", flush=True)
    if flights:
        shape = "exact" if shape_part == 0.0 else "in error"
        for which, same in zip(("the simulator's", "one as stated"), zip(*flights, strict=True), strict=True):
            report(f"seeds {first} to {first + count - 1}, C_A's shape {shape}, sounding {which}", same)
    packages = option("--packages")
    if packages:
        names = sorted(p.parent.parent for p in Path(packages).glob("*/truth/truth.csv"))
        others = [package(folder, shape_part) for folder in names]
        report("flights of another simulator", others)
        for folder, (found, names_red) in zip(names, others, strict=True):
            (error, sd), density = found["C_A scale"][0], found["density"]
            z = density[:, 0] / density[:, 1]
            words = f"density z {z.min():+.1f} to {z.max():+.1f}, C_A scale {error:+.3f} +/- {sd:.3f}"
            print(f"{folder.name:14}{words}{', red: ' if names_red else ''}{', '.join(names_red)}")


if __name__ == "__main__":
    main()

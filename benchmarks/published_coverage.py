"""Do the answers on the published flights err as they say? Many days of each, vehicles off by what their files state.

Run: ``python benchmarks/published_coverage.py [NAME ...] [--flights N] [--first SEED]`` (IRVE-3, LOFTID, ADEPT SR-1,
FIRE II; 20 flights of each from seed 100). Masses, c.g.s, inertias, coefficients, air, sounding and every instrument's
errors are drawn anew for each seed; the analyst has the shipped vehicle file. No video. 10 to 60 s a flight. Scored at
peak dynamic pressure: mean normalised square of the trajectory's errors (1 wanted; its 95 % limits stand beside), rms
of the as-flown density's error over its sd (at the truth's peak: the estimate's own lies where the sounding is likely
to read high), deflections by each method as `estimator_coverage.py` has them, and red
checks. Of a flight that tumbles the telemetry ends 10 s before.
"""

import argparse
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.estimator_coverage import columns, report, row_of, safely
from estimators.fusing import fuse_flight
from estimators.misalignment import estimate_misalignment
from estimators.trim import estimate_trim
from flightmodel.events import find_peak
from flightmodel.trajectory import difference, resample
from postflight.flight import read_flight
from postflight.reconstruction import reconstruct
from recon.consistency import GROUPS
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

BEFORE_TUMBLE_S = 10.0  # it then falls faster than it entered, and that second peak is no entry's
NAMES = ("irve3", "loftid", "adept_sr1", "fire2")


def drawn(stated, rng):
    """Vehicle as it may be, by the uncertainty that its file states; later mass properties err as the first do."""
    known = stated.uncertainty
    errors = {name: rng.standard_normal(6) for name in ("aeroshell", "centerbody")}

    def body(name, part):
        mass, *cg, along, across = errors[name]
        place = part.cg_m + np.array(cg) * [known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m]
        grown = 1.0 + known.inertia * np.array([along, across, across])
        inertia = np.sqrt(np.outer(grown, grown)) * part.inertia
        return part.model_copy(
            update={
                "mass_kg": float(part.mass_kg * (1.0 + known.mass * mass)),
                "cg_from_datum_body_m": tuple(place.tolist()),
                "inertia_kgm2": tuple(map(tuple, inertia.tolist())),
            }
        )

    ca, cn, cm, shift = rng.standard_normal(4)
    aero = stated.aero.scaled(1.0 + known.ca * ca, 1.0 + known.cn * cn, 1.0 + known.cm * cm, known.cmq * shift)
    return replace(stated.with_bodies(body), aero=aero)


def flown(name, seed):
    """Truth of a flight and the analyst's reconstruction; of a flight that tumbled, up to `BEFORE_TUMBLE_S` before."""
    scenario = read_scenario(name)
    vehicle = drawn(scenario.vehicle, np.random.default_rng([seed, 22, 2010]))
    spec = scenario.spec.model_copy(update={"video": None})
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        truth = simulate_to_folder(replace(scenario, spec=spec, vehicle=vehicle), seed, folder)
        if truth.tumbled_s is not None:
            until = spec.time.model_copy(update={"stop_s": truth.tumbled_s - BEFORE_TUMBLE_S})
            shorter = replace(scenario, spec=spec.model_copy(update={"time": until}), vehicle=vehicle)
            truth = simulate_to_folder(shorter, seed, Path(temporary) / "shorter")
            folder = Path(temporary) / "shorter"
        return truth, None if truth.remark else reconstruct(read_flight(folder))


def trajectory_squares(truth, bet, at_s):
    """Mean normalised square of the errors of each group at a time."""
    best, true = (resample(path, np.array([at_s])) for path in (bet.trajectory, truth.trajectory))
    error, cov = difference(best, true)[0], best.covariance[0]
    return [float(error[k] @ np.linalg.solve(cov[k, k], error[k])) / 3.0 for k in GROUPS.values()]


def density_z(truth, bet, at_s):
    """Error of the as-flown density over its sd at a time."""
    height = np.interp(at_s, truth.time_s, truth.altitude_m)
    true = np.interp(at_s, truth.time_s, truth.density_kgpm3) / bet.profile.at(height).density_kgpm3
    profile = bet.as_flown.profile
    ratio, sd = (np.interp(height, profile["altitude_m"], profile[c]) for c in ("density_ratio", "density_ratio_sd"))
    return float((ratio - true) / sd)


def scored(name, seed):
    """One flight's errors over what is stated; what was red, and why an answer is missing."""
    truth, bet = flown(name, seed)
    if bet is None:
        return {"seed": seed, "words": truth.remark}
    peak = bet.peak_s  # the truth's own may lie beyond the last fix
    out = {"seed": seed, "words": truth.remark, "squares": trajectory_squares(truth, bet, peak), "rows": {}}
    true_peak, span = find_peak(truth.time_s, truth.dynamic_pressure_pa)[0], bet.trajectory.time_s[[0, -1]]
    out["density"] = density_z(truth, bet, float(np.clip(true_peak, *span)))
    out["red"] = [check.code for check in bet.consistency_checks if not check.passed]
    pulse = bet.required_loads()
    known = {"theta_yz": columns(pulse.time_s, truth.time_s, truth.deflection.theta_yz_rad), "peak": peak}
    found = safely(out, lambda: fuse_flight(pulse, None))
    answers = {"misalignment": estimate_misalignment(pulse), "trim": estimate_trim(pulse)}
    if found is not None:
        answers["fused"] = found.history
        out["disagree"] = {"no video": found.agreement.likeliest}
    out["rows"] = {method: row_of(history, pulse, known) for method, history in answers.items()}
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--first", type=int, default=100)
    asked = parser.parse_args()
    for name in asked.names:
        results = []
        for seed in range(asked.first, asked.first + asked.flights):
            results.append(scored(name, seed))
            one = results[-1]
            if one["words"]:
                print(f"{name} {seed}: {one['words']}; left out", flush=True)
                continue
            words = " ".join(f"{row[0] / row[1]:+.1f}" for row in one["rows"].values())
            print(f"{name} {seed}: z of {', '.join(one['rows'])}: {words}; red {one['red']}", flush=True)
        report(results)
        results = [one for one in results if not one["words"]]
        squares, count = np.array([one["squares"] for one in results]), len(results)
        low, high = chi2.ppf([0.025, 0.975], 3 * count) / (3 * count)
        shown = ", ".join(f"{group} {value:.2f}" for group, value in zip(GROUPS, squares.mean(axis=0), strict=True))
        print(f"\n{name}, {count} flights: mean normalised square of {shown} (95 %: {low:.2f} to {high:.2f})")
        z = np.array([one["density"] for one in results])
        print(f"as-flown density: rms of z {np.sqrt(np.mean(z**2)):.2f}, mean {z.mean():+.2f}")
        print(
            f"red checks of the trajectory: {dict(Counter(code for one in results for code in one['red'])) or 'none'}"
        )


if __name__ == "__main__":
    main()

"""How well can a wrong assumption be detected? The best decision among the planted errors, on readings as modelled.

Run: ``python benchmarks/suspects_bound.py [FLIGHTS [FIRST SEED]] [FOLDER]`` (flights that ``estimator_coverage.py``
keeps; constants of the tests are from seeds 0 to 29). Readings bear on an error through ``u = D' m`` alone
(`estimators.agreement`), which is normal: of covariance ``D' V D`` where nothing is wrong, moved by ``D' V d`` where
``d`` is. Drawn so, nothing but the readings' noise limits who knows each error's size and not its side: largest
likelihood first, red where it is above what a share of sound flights reaches. One who knows the side, too, and has but
one suspect, has ``d' m``.
"""

from dataclasses import replace

import numpy as np
from estimator_coverage import CAMERA_SD, camera_history, flown_aero, fly_missing, kept_flight, seeds_and_folder
from scipy.stats import norm

from estimators.agreement import CAMERA_MISALIGNED, COEFFICIENTS, MOUNT, OFFSET, fault_hypotheses
from estimators.fusing import CAMERA_PLANE_SD_RAD, fuse_flight
from flightmodel.vehicle import vehicle_from_toml, vehicle_path

DRAWS, FALSE_ALARMS = 200, (0.05, 0.10)
SIDES = {  # of what `estimator_coverage.planted` plants, in columns of the fault hypotheses
    COEFFICIENTS: np.ones(2),
    MOUNT: np.sqrt(2.0) * np.array([0.6, 0.8]),
    OFFSET: np.sqrt(2.0) * np.array([0.8, -0.6]),
    CAMERA_MISALIGNED: np.ones(1),
}


def separation(seed, folder):
    """``D' V D`` of a flight as the reference vehicle's analyst has it, all suspects' columns in order of `SIDES`."""
    pulse, truth = kept_flight(folder, seed)
    known = vehicle_from_toml(vehicle_path("irve2_reference")).uncertainty
    pulse = replace(pulse, vehicle=replace(flown_aero(pulse.vehicle, truth, known), uncertainty=known))
    use, rng = pulse.through_pulse, np.random.default_rng([seed, 3, 2009])
    camera = camera_history(rng, truth["theta_yz"][use], pulse.time_s[use], CAMERA_SD["clean"])
    input_posterior = fuse_flight(pulse, camera).solution.input_posterior
    faults = fault_hypotheses(pulse, input_posterior, CAMERA_PLANE_SD_RAD)
    columns = np.hstack([faults[suspect] for suspect in SIDES])
    return columns.T @ (columns - input_posterior.covariance @ columns)


def likelihoods(u, inner, places):
    """Log likelihood of each suspect's error against none ``(draws, suspects)``."""
    out = []
    for at in places:
        spread = np.eye(at.stop - at.start) + inner[at, at]
        square = np.einsum("ni,ij,nj->n", u[:, at], np.linalg.inv(spread), u[:, at])
        out.append(0.5 * square - 0.5 * np.linalg.slogdet(spread)[1])
    return np.stack(out, axis=-1)


def main():
    seeds, folder = seeds_and_folder()
    fly_missing(folder, seeds)
    ends = np.cumsum([0, *(len(side) for side in SIDES.values())])
    places = [slice(*ends[k : k + 2]) for k in range(len(SIDES))]
    errors = np.zeros((1 + len(SIDES), ends[-1]))
    for k, (at, side) in enumerate(zip(places, SIDES.values(), strict=True), 1):
        errors[k, at] = side
    rng, scored, sizes = np.random.default_rng(2009), [], []
    for k, seed in enumerate(seeds, 1):
        inner = separation(seed, folder)
        value, axes = np.linalg.eigh(inner)
        noise = rng.standard_normal((DRAWS, len(inner))) @ (axes * np.sqrt(np.maximum(value, 0.0))).T
        scored.append([likelihoods(noise + inner @ error, inner, places) for error in errors])
        sizes.append(np.sqrt(np.einsum("ki,ij,kj->k", errors[1:], inner, errors[1:])))
        if k % 10 == 0:
            print(f"{k} of {len(seeds)}", flush=True)
    scores = np.concatenate(scored, axis=1)  # (planted, flights and draws, suspects)
    for share in FALSE_ALARMS:
        limit = np.quantile(scores[0].max(axis=1), 1.0 - share)
        print(f"{100 * share:.0f} % false alarms, odds of {np.exp(limit):.1f} to one:")
        for k, suspect in enumerate(SIDES):
            red, right = scores[k + 1].max(axis=1) > limit, scores[k + 1].argmax(axis=1) == k
            size = np.array(sizes)[:, k]
            found = 100.0 * norm.sf(norm.isf(share) - size).mean()
            words = f"red {100 * red.mean():.0f} %, named first {100 * (red & right).mean():.0f} %"
            print(f"  {suspect}: {words}; {np.median(size):.1f} sd; found, side known, {found:.0f} %", flush=True)


if __name__ == "__main__":
    main()

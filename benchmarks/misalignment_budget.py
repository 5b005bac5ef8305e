"""What are the errors of misalignment at peak pressure made of, and is each part as large as it is taken to be?

Run: ``python benchmarks/misalignment_budget.py [FLIGHTS [FIRST SEED]] [FOLDER]`` (flights that are kept by
``estimator_coverage.py``; 0.5 s each beside flying them). A reading is linear in its inputs: what the joint's motion,
the flow and the vehicle make of it is its change when their true values are put in, and what is left at the truth is
the inertial sensors'. Printed are the rms of the lateral vector's error over its stated sd, of the whole and of every
part, with the sd by which sets of as many flights scatter, and error and stated sd, rms of a component; and the rms of
the *angle's* error over its sd beside the one that errors as stated would have: an angle near zero cannot err
downwards, so that it is above one.
"""

from dataclasses import replace

import numpy as np
from estimator_coverage import fly_missing, kept_flight, row_of, seeds_and_folder
from scipy.interpolate import CubicSpline

from estimators.evidence import ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS, VEHICLE_INPUTS
from estimators.misalignment import estimate_misalignment, misalignment_evidence
from tests.wide_flights import wide_flight

WHOLE, SENSORS, FLOW, VEHICLE, SWING = "whole", "inertial sensors", "flow", "vehicle", "joint's motion"
SPINS_RPM = ((0.0, 15.0), (15.0, 30.0), (30.0, 60.0))
SENSORS_OWN = (ACCELEROMETER_TIME_BIAS, GYRO_TIME_BIAS)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def budget(seed, folder):
    """Lateral errors (2,) and stated covariances (2, 2), rad, of whole and parts; the angle's row. None: tumbled."""
    pulse, truth = kept_flight(folder, seed)
    if truth["words"]:
        return print(f"{seed}: {truth['words']}; left out", flush=True)
    history, use = estimate_misalignment(pulse), pulse.informative
    loads, bent = pulse.rows(use), truth["theta_yz"][use]
    motion = CubicSpline(loads.time_s, bent)
    k = int(np.argmin(np.abs(loads.time_s - truth["peak"])))

    def about_truth(one):
        """Error of the reading at the peak, its oscillation known."""
        evidence = misalignment_evidence(one, motion, False)
        swing = np.einsum("nij,nj->ni", evidence.by_rate_s, motion(loads.time_s, 1))
        swing += np.einsum("nij,nj->ni", evidence.by_acceleration_s2, motion(loads.time_s, 2))
        return (evidence.theta_yz_rad - swing - bent)[k]

    flown, flow = wide_flight(seed).flown, truth["flow_yz"][use]
    evidence = misalignment_evidence(loads)
    still = about_truth(loads)
    errors = {
        WHOLE: evidence.theta_yz_rad[k] - bent[k],
        SENSORS: about_truth(replace(loads, vehicle=flown, flow_yz_rad=flow)),
        FLOW: still - about_truth(replace(loads, flow_yz_rad=flow)),
        VEHICLE: still - about_truth(replace(loads, vehicle=flown)),
        SWING: evidence.theta_yz_rad[k] - bent[k] - still,
    }
    # constant errors of the sensors turn force and flow: each by itself
    none = {name: np.zeros_like(getattr(loads, name)) for name in ("force_root_mps2", "rate_root_radps")}
    by_force = misalignment_evidence(replace(loads, flow_root_rad=np.zeros_like(loads.flow_root_rad))).by_input
    by_flow = misalignment_evidence(replace(loads, **none)).by_input
    parts = {
        SENSORS: [by_force["accelerometer"], *(by_force[n] for n in SENSORS_OWN if n in by_force)],
        FLOW: [by_flow[n] for n in ("accelerometer", "BET attitude", "wind")],
        VEHICLE: [evidence.by_input[n] for n in VEHICLE_INPUTS if n in evidence.by_input],
    }
    stated = {name: sum(j[k] @ j[k].T for j in inputs) for name, inputs in parts.items()}
    stated[SENSORS] = stated[SENSORS] + evidence.independent_cov[k]
    # what the answer's variance along its own direction holds beside the inputs' is the oscillation's
    at = int(np.searchsorted(history.time_s, loads.time_s[k]))
    along = history.theta_yz_rad[at] / history.theta_rad[at]
    stated[SWING] = (history.theta_sd_rad[at] ** 2 - along @ evidence.covariance[k] @ along) * np.eye(2)
    stated[WHOLE] = evidence.covariance[k] + stated[SWING]
    return float(truth["spin"]), errors, stated, row_of(history, pulse, truth)


def squares(flights, part):
    """Mean of the two components' squared errors over their variance, flight by flight."""
    pairs = [(errors[part], stated[part]) for _, errors, stated, _ in flights]
    return np.array([0.5 * e @ np.linalg.solve(c, e) for e, c in pairs])


def main():
    seeds, folder = seeds_and_folder()
    fly_missing(folder, seeds)
    flights = [found for seed in seeds if (found := budget(seed, folder)) is not None]
    z = np.array([row[0] / row[1] for *_, row in flights])
    expected = np.sqrt(np.mean([row[6] for *_, row in flights]))
    print(f"{len(flights)} flights; angle: rms of z {rms(z):.2f}, of errors as stated {expected:.2f}")
    for part in flights[0][1]:
        square = squares(flights, part)
        scatter = 0.5 / np.sqrt(len(flights))
        words = f"rms of z {np.sqrt(square.mean()):.2f} +/- {scatter:.2f}"
        error = np.rad2deg(rms([errors[part] for _, errors, *_ in flights]))
        sd = np.rad2deg(np.sqrt(np.mean([0.5 * np.trace(stated[part]) for *_, stated, _ in flights])))
        print(f"{part:18} {words}; error {error:.3f}, stated {sd:.3f} deg")
        for low, high in SPINS_RPM if part in (WHOLE, SENSORS) else ():
            there = np.array([low <= spin < high for spin, *_ in flights])
            if there.any():
                scatter = 0.5 / np.sqrt(there.sum())
                words = f"rms of z {np.sqrt(square[there].mean()):.2f} +/- {scatter:.2f}"
                print(f"    {low:2.0f} to {high:2.0f} rpm: {there.sum():3d} flights, {words}")


if __name__ == "__main__":
    main()

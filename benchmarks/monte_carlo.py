"""Ensembles: flights of 300 s a second on one core and on two, and memory against their number.

Run: ``python benchmarks/monte_carlo.py [ROUNDS]``. Each flight draws its joint's stiffness, its coefficients and its
day's air; records ten times a second. Drawing the day and its table is timed too, and apart.
"""

import gc
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
from problem import reference_problem

from flightmodel.vehicle import Vehicle
from synthetic_flight import simulate
from synthetic_flight.ensemble import LANES, Start, available_cores, fly_ensemble
from synthetic_flight.scenarios import child_rng, read_scenario
from synthetic_flight.simulate import Schedule, integrate
from synthetic_flight.weather import AUGUST, day_of_flight_atmosphere

SECONDS, RECORD_HZ = 300.0, 10.0
RATES_HZ = (200.0, 150.0, 60.0)
FLIGHTS = 4 * LANES  # two blocks a worker


def schedule(rate_hz):
    return Schedule(1.0 / rate_hz, round(rate_hz / RECORD_HZ), round(SECONDS * RECORD_HZ) + 1)


def dispersed_starts(problem):
    """Return ``start_of(run)``: the reference vehicle at inflation with dispersed stiffness, coefficients and air."""
    spec = read_scenario("irve2_reference").spec.atmosphere

    def start_of(run):
        rng = np.random.default_rng([11, run])
        factors = np.exp([0.2, 0.03, 0.07, 0.10] * rng.standard_normal(4))
        joint = problem.vehicle.joint
        stiffness = joint.bending_stiffness_nmprad * factors[0]
        vehicle: Vehicle = replace(
            problem.vehicle, joint=joint.model_copy(update={"bending_stiffness_nmprad": stiffness})
        )
        table = simulate.atmosphere_table(day_of_flight_atmosphere(spec, child_rng(run, "atmosphere"), AUGUST))
        return Start(problem.inflated, simulate.parameter_vector(vehicle, *factors[1:]), table)

    return start_of


def ensemble(problem, start_of, flights, workers, rate_hz):
    """Fly, keep one number a flight: the largest bending angle."""
    return [
        f.aux[:, 5].max() for f in fly_ensemble(problem.vehicle, start_of, range(flights), schedule(rate_hz), workers)
    ]


def child(flights):
    """Peak memory, MiB, of a process that flies ``flights``; prints it."""
    problem = reference_problem()
    angles = ensemble(problem, dispersed_starts(problem), flights, 2, 200.0)
    assert len(angles) == flights
    print(json.dumps(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0))


def peak_mib(flights):
    run = subprocess.run([sys.executable, __file__, "child", str(flights)], capture_output=True, text=True, check=True)
    return float(run.stdout.strip().splitlines()[-1])


def timed(work, rounds):
    """Wall and processor seconds of the quickest of several rounds of every piece, interleaved."""
    quickest = {}
    for _ in range(rounds):
        for name, piece in work.items():
            wall, cpu = time.perf_counter(), time.process_time()
            piece()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            quickest[name] = min(quickest.get(name, (np.inf, np.inf)), (wall, cpu))
    return quickest


def main():
    if "child" in sys.argv:
        child(int(sys.argv[2]))
        return
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    problem = reference_problem()
    start_of = dispersed_starts(problem)
    drawn = [start_of(run) for run in range(FLIGHTS)]
    next(fly_ensemble(problem.vehicle, drawn.__getitem__, [0], Schedule(0.005, 1, 2)))  # compiled, loaded
    gc.collect()
    print(f"{FLIGHTS} flights of {SECONDS:.0f} s; {available_cores()} cores, load before {os.getloadavg()[0]:.1f}")
    for rate in RATES_HZ:
        plan = schedule(rate)
        work = {
            "alone": lambda p=plan: integrate(
                problem.vehicle, drawn[0].atmosphere, problem.inflated, p.step_s, p.per_record, p.records
            ),
            "one core": lambda r=rate: ensemble(problem, drawn.__getitem__, FLIGHTS, 1, r),
            "two cores": lambda r=rate: ensemble(problem, drawn.__getitem__, FLIGHTS, 2, r),
            "two cores, starts drawn too": lambda r=rate: ensemble(problem, start_of, FLIGHTS, 2, r),
        }
        took = timed(work, rounds)
        print(f"at {rate:.0f} Hz:")
        for name, (wall, cpu) in took.items():
            flights = 1 if name == "alone" else FLIGHTS
            print(f"  {name:30s}{flights / wall:8.1f} flights/s, {cpu / wall:.2f} cores' time had")
        one, two = took["one core"][0], took["two cores"][0]
        print(f"  lanes / one flight at a time, one core: {took['alone'][0] / one * FLIGHTS:.2f} (target 3 at least)")
        print(f"  two cores / one: {one / two:.2f} (target 1.8 at least), in processor time ", end="")
        print(f"{2.0 * took['one core'][1] / took['two cores'][1]:.2f}")
        print(f"  flights/s on two cores: {FLIGHTS / two:.1f} (target 100 at least)")
    few, many = 4 * LANES, 16 * LANES
    memory = peak_mib(few), peak_mib(many)
    print(f"peak memory, MiB: {memory[0]:.0f} for {few} flights, {memory[1]:.0f} for {many}")


if __name__ == "__main__":
    main()

"""How long each link of the chain takes on one flight, warm: best of several rounds, one process.

Run: ``python benchmarks/chain.py [ROUNDS]``. Absolute times move with the machine; ratios between
rows of one run move less. Nothing in the test suite depends on them.
"""

import sys
import tempfile
import time
from pathlib import Path

from estimators.misalignment import estimate_misalignment
from estimators.trim import estimate_trim
from postflight.deflections import estimate_camera
from postflight.flight import read_flight
from postflight.reconstruction import loads_from_solution, reconstruct
from recon.reconstruct import reconstruct as solve
from synthetic_flight import simulate
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import child_rng, fly_scenario, initial_state, read_scenario
from synthetic_flight.simulate import integrate
from synthetic_flight.weather import day_of_flight_atmosphere

ROUNDS = int(sys.argv[1]) if len(sys.argv) > 1 else 3


def best(work):
    work()  # warm
    times = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return min(times)


def main():
    scenario = read_scenario("irve2_reference")
    vehicle = scenario.vehicle
    table = simulate.atmosphere_table(
        day_of_flight_atmosphere(scenario.spec.atmosphere, child_rng(0, "atmosphere"), scenario.mean_air)
    )
    state = initial_state(scenario)
    rows = []
    kernel = best(lambda: integrate(vehicle, table, state, 0.002, 2, 110001, 52501))
    rows.append(("fly 440 s, RK4 at 500 Hz, integration alone", kernel))
    rows.append(("fly 440 s with air data and truth", best(lambda: fly_scenario(scenario, 0))))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "flight"
        begun = time.perf_counter()
        simulate_to_folder(scenario, 0, folder)
        rows.append(("simulate a flight folder with video", time.perf_counter() - begun))
        flight = read_flight(folder)
        rows.append(("read telemetry through the gate", best(lambda: read_flight(folder))))
        rows.append(("reconstruct 230 s at 250 Hz", best(lambda: solve(flight.telemetry))))
        bet = reconstruct(flight)
        rows.append(("deflection from video", best(lambda: estimate_camera(flight))))
        pulse = loads_from_solution(flight.telemetry, bet.solution, bet.air)
        rows.append(("deflection from misalignment", best(lambda: estimate_misalignment(pulse))))
        rows.append(("deflection from trim", best(lambda: estimate_trim(pulse))))
    print(f"{'':55s}{'seconds':>10s}{'x real time':>14s}")
    for name, seconds in rows:
        ratio = f"{440.0 / seconds:14.0f}" if "440 s" in name else ""
        print(f"{name:55s}{seconds:10.3f}{ratio}")


if __name__ == "__main__":
    main()

"""The flight that every benchmark times: the reference vehicle through the pressure pulse, and how pieces are timed."""

import time
from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from synthetic_flight import simulate
from synthetic_flight.scenarios import child_rng, initial_state, read_scenario
from synthetic_flight.simulate import integrate
from synthetic_flight.weather import day_of_flight_atmosphere

START_S, PULSE_S = 400.0, 60.0  # 100 km, and through the largest dynamic pressure (about 435 s)


@dataclass(frozen=True)
class Problem:
    """Reference vehicle, the table of one day's air, the state at the nose's 100 km, the state at inflation."""

    vehicle: Vehicle
    atmosphere: FloatArray
    entry: FloatArray
    inflated: FloatArray


def reference_problem() -> Problem:
    """Fly the reference scenario, joint locked until inflation, to where the benchmarks start."""
    scenario = read_scenario("irve2_reference")
    time_s = scenario.spec.time
    air = simulate.atmosphere_table(
        day_of_flight_atmosphere(scenario.spec.atmosphere, child_rng(0, "atmosphere"), scenario.mean_air)
    )
    locked = round(time_s.inflated_s - time_s.start_s)
    states, _ = integrate(
        scenario.vehicle, air, initial_state(scenario), 0.004, 250, round(START_S - time_s.start_s) + 1, locked
    )
    return Problem(scenario.vehicle, air, states[-1], states[locked])


def fly(problem: Problem, rate_hz: float, seconds: float, record_hz: float = 10.0) -> tuple[FloatArray, FloatArray]:
    """States and auxiliaries of our own flight from entry, ``record_hz`` records a second."""
    return integrate(
        problem.vehicle,
        problem.atmosphere,
        problem.entry,
        1.0 / rate_hz,
        round(rate_hz / record_hz),
        round(seconds * record_hz) + 1,
    )


def minima(pieces, rounds, clock=time.perf_counter):
    """Shortest time, s, of every piece of work; rounds interleaved, so that a busy minute strikes all alike."""
    shortest = dict.fromkeys(pieces, np.inf)
    for work in pieces.values():
        work()  # compiled, loaded, in the caches
    for _ in range(rounds):
        for name, work in pieces.items():
            begun = clock()
            work()
            shortest[name] = min(shortest[name], clock() - begun)
    return shortest

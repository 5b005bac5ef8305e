"""One flight: ours and its peers in simulated seconds per wall second, and how accurate each is at its step.

Run: ``python benchmarks/simulator.py [ROUNDS]``. MuJoCo is used where it is importable. The rigid peers and Basilisk
run in environments of their own (`requirements-peers.txt`), named by two variables: ``PEERS_PYTHON``, an interpreter
with bsk and rocketpy; ``SIMUPY_PYTHON``, one with simupy, beside ``SIMUPY_FLIGHT``, a checkout of nasa/simupy-flight.
"""

import importlib.util
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from mujoco_flight import MujocoFlight, isotropic
from problem import PULSE_S, fly, reference_problem
from scipy.integrate import solve_ivp

from flightmodel import earth
from synthetic_flight import dynamics, simulate

RATES_HZ = (500.0, 250.0, 200.0)
STEP_HZ = 500.0
# simulated seconds of one timed piece: a fraction of a second of wall time each
MUJOCO = {
    "MuJoCo RK4, bare": (None, 40.0),
    "MuJoCo RK4, compiled wrench held": ("compiled", 30.0),
    "MuJoCo RK4, numpy wrench held": ("numpy", 10.0),
    "MuJoCo RK4, compiled wrench at four stages": ("compiled, four stages", 20.0),
    "MuJoCo RK4, numpy wrench at four stages": ("numpy, four stages", 3.0),
}
TARGETS = {
    "MuJoCo RK4, compiled wrench held": 8.0,
    "MuJoCo RK4, numpy wrench held": 30.0,
    "MuJoCo RK4, numpy wrench at four stages": 100.0,
    "Basilisk, hub with two-axis hinge, no air": 15.0,
    "simupy-flight, NESC case 3 (rigid)": 50.0,
    "simupy-flight, NESC case 9 (rigid)": 50.0,
    "RocketPy (rigid)": 10.0,
}
PEERS = {
    "Basilisk, rigid hub, no air": ("basilisk-rigid", "PEERS_PYTHON"),
    "Basilisk, hub with two-axis hinge, no air": ("basilisk-hinged", "PEERS_PYTHON"),
    "RocketPy (rigid)": ("rocketpy", "PEERS_PYTHON"),
    "simupy-flight, NESC case 3 (rigid)": ("simupy-flight-03", "SIMUPY_PYTHON"),
    "simupy-flight, NESC case 9 (rigid)": ("simupy-flight-09", "SIMUPY_PYTHON"),
}


def ours(problem, rate_hz, seconds=PULSE_S):
    """Nose position and deflection ten times a second."""
    states, aux = fly(problem, rate_hz, seconds)
    return dynamics.points(states, problem.vehicle)["nose"][0], aux[:, 5]


def dop853(problem, seconds, rtol):
    """The same from scipy's DOP853 with our compiled rates."""
    s = simulate.workspace(problem.entry[None], simulate.parameter_vector(problem.vehicle)[None])
    air, grid, mach, table, free = simulate.kernel_tables(problem.vehicle, problem.atmosphere)
    planet = tuple(earth.WGS84)  # numba takes a plain tuple several times faster than a named one
    trial, rate = (
        slice(dynamics.TRIAL, dynamics.TRIAL + dynamics.STATES),
        slice(dynamics.RATE, dynamics.RATE + dynamics.STATES),
    )

    def derivative(_, y):
        s[trial] = y
        dynamics.rates(s, (0,), (), (), air, grid, mach, table, free, planet, False, False)
        return s[rate].copy()

    times = np.linspace(0.0, seconds, round(seconds * 10.0) + 1)
    # tolerance of the state's own sizes: kilometres of motion, not the distance from the Earth's centre
    atol = rtol * np.repeat([1e4, 1e3, 1.0], [3, 3, 14])
    flown = solve_ivp(derivative, (0.0, seconds), problem.entry, "DOP853", times, rtol=0.01 * rtol, atol=atol).y.T
    return dynamics.points(flown, problem.vehicle)["nose"][0], dynamics.deflection_angle(
        flown[:, 6:10], flown[:, 10:14]
    )[0]


def error(flown, reference):
    """Largest difference in position, m, and deflection, deg."""
    return (
        float(np.linalg.norm(flown[0] - reference[0], axis=1).max()),
        float(np.rad2deg(np.abs(flown[1] - reference[1]).max())),
    )


def say(name, pair):
    print(f"{name:62s}{pair[0]:12.1e} m{pair[1]:12.1e} deg", flush=True)


def print_accuracy(problem, same_joint, with_mujoco):
    """Errors over the pulse, and that MuJoCo with the wrench at four stages flies what ours flies."""
    print(f"largest error over {PULSE_S:.0f} s of the pressure pulse, against ours at 4 kHz")
    reference = ours(problem, 4000.0)
    for rate in (*RATES_HZ, 150.0, 120.0, 60.0, 50.0):
        say(f"ours, {rate:.0f} Hz", error(ours(problem, rate), reference))
    say("scipy DOP853 with our compiled rates", error(dop853(problem, PULSE_S, 1e-7), reference))
    if not with_mujoco:
        return
    print("the same with a joint as stiff in torsion as in bending, which is MuJoCo's ball joint")
    reference = ours(same_joint, 4000.0)
    for rate in (*RATES_HZ, 100.0, 50.0):
        say(f"ours, {rate:.0f} Hz", error(ours(same_joint, rate), reference))
    for rate, wrench in ((500.0, "compiled"), (2000.0, "compiled"), (500.0, "numpy")):
        say(f"MuJoCo RK4, {wrench} wrench held, {rate:.0f} Hz", error(pulse(same_joint, rate, wrench), reference))
    four = error(MujocoFlight(same_joint, STEP_HZ, "numpy, four stages").fly(10.0), [r[:101] for r in reference])
    say("MuJoCo RK4, numpy wrench at four stages, 500 Hz, 10 s", four)
    assert four[0] < 1e-3, "MuJoCo and ours fly different vehicles"


def pulse(problem, rate_hz, wrench):
    return MujocoFlight(problem, rate_hz, wrench).fly(PULSE_S)


def peer_process(name):
    """Simulated seconds per wall second of a peer with its own environment, or words on how to get it."""
    peer, variable = PEERS[name]
    python = os.environ.get(variable)
    if python is None:
        return f"not installed: set {variable} (see benchmarks/README.md)"
    environment = dict(os.environ, MPLBACKEND="agg", PYTHONPATH=os.environ.get("SIMUPY_FLIGHT", ""))
    script = str(Path(__file__).parent / "rigid_peers.py")
    run = subprocess.run([python, script, peer], env=environment, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        return f"did not run: {(run.stderr.strip().splitlines() or ['no words'])[-1]}"
    answer = json.loads(run.stdout.strip().splitlines()[-1])
    if "missing" in answer:
        return f"not installed: {answer['missing']}; pip install -r benchmarks/requirements-peers.txt"
    return answer["simulated_s"] / answer["wall_s"]


def timed(work, seconds):
    begun = time.perf_counter()
    work()
    return seconds / (time.perf_counter() - begun)


def measure(problem, same_joint, with_mujoco, rounds):
    """Best simulated seconds per wall second of everybody, rounds interleaved; words where a peer is absent."""
    pieces = {f"ours, {r:.0f} Hz": (lambda r=r: fly(problem, r, PULSE_S), PULSE_S) for r in RATES_HZ}
    pieces["scipy DOP853, our compiled rates"] = (lambda: dop853(problem, PULSE_S, 1e-7), PULSE_S)
    if with_mujoco:
        for name, (wrench, seconds) in MUJOCO.items():
            flight = MujocoFlight(same_joint, STEP_HZ, wrench)
            pieces[name] = (lambda f=flight, s=seconds: f.fly(s), seconds)
    best = {}
    for work, _ in pieces.values():
        work()
    for _ in range(rounds):
        for name, (work, seconds) in pieces.items():
            repeat = 5 if name.startswith("ours") else 1  # short pieces
            best[name] = max(best.get(name, 0.0), *(timed(work, seconds) for _ in range(repeat)))
        for name in PEERS:
            if not isinstance(best.get(name), str):
                answer = peer_process(name)
                best[name] = answer if isinstance(answer, str) else max(best.get(name, 0.0), answer)
    if not with_mujoco:
        best |= dict.fromkeys(MUJOCO, "not installed: pip install mujoco")
    return best


def main():
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    problem = reference_problem()
    same_joint = replace(problem, vehicle=replace(problem.vehicle, joint=isotropic(problem.vehicle)))
    with_mujoco = importlib.util.find_spec("mujoco") is not None
    print_accuracy(problem, same_joint, with_mujoco)
    best = measure(problem, same_joint, with_mujoco, rounds)
    print(
        "\nsimulated seconds per wall second; ratio of ours to a peer: at 500 Hz, and of ours at 200 Hz to it at 500 Hz"
    )
    print(f"{'':46s}{'sim s / s':>10s}{'x, 500 Hz':>11s}{'x, 200 Hz':>11s}")
    for name, speed in best.items():
        if isinstance(speed, str):
            print(f"{name:46s}{speed}")
            continue
        ratios = [best[f"ours, {r:.0f} Hz"] / speed for r in (500.0, 200.0)]
        target = TARGETS.get(name)
        words = f"   target {target:.0f}: {'met' if ratios[0] >= target else 'NOT met at 500 Hz'}" if target else ""
        print(f"{name:46s}{speed:10.1f}{ratios[0]:11.1f}{ratios[1]:11.1f}{words}")


if __name__ == "__main__":
    main()

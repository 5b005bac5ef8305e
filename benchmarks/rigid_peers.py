"""One flight in simulators that carry no aeroshell on a joint and no table: simulated seconds, and seconds they took.

Run by `simulator.py`, one peer a process, in the peers' own environment: ``python rigid_peers.py PEER``. Prints one
line of JSON. Needs nothing of ours.
"""

import contextlib
import io
import json
import os
import sys
import time

RUNS = 3


def shortest(seconds, work):
    """Simulated and least wall seconds of several runs; ``work()`` prepares one untimed and returns it to be called."""
    least = float("inf")
    for _ in range(RUNS):
        run = work()
        begun = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            flown = run()
        least = min(least, time.perf_counter() - begun)
    return {"simulated_s": seconds if flown is None else flown, "wall_s": least}


def basilisk(hinged):
    """Rigid hub in orbit without gravity or air, RK4 at 500 Hz; with ``hinged`` a body on a sprung two-axis hinge."""
    from Basilisk.simulation import spacecraft, spinningBodyTwoDOFStateEffector, svIntegrators
    from Basilisk.utilities import SimulationBaseClass, macros

    seconds, rate_hz = 20.0, 500.0
    simulation = SimulationBaseClass.SimBaseClass()
    process = simulation.CreateNewProcess("process")
    process.addTask(simulation.CreateNewTask("task", macros.sec2nano(1.0 / rate_hz)))
    hub = spacecraft.Spacecraft()
    integrator = svIntegrators.svIntegratorRK4(hub)
    hub.setIntegrator(integrator)
    hub.hub.mHub = 40.0
    hub.hub.r_BcB_B = [[-0.58], [0.0], [0.0]]
    hub.hub.IHubPntBc_B = [[46.0, 0.0, 0.0], [0.0, 27.9, 0.0], [0.0, 0.0, 27.9]]
    hub.hub.r_CN_NInit = [[6.5e6], [0.0], [0.0]]
    hub.hub.v_CN_NInit = [[0.0], [2000.0], [0.0]]
    hub.hub.sigma_BNInit = [[0.0], [0.0], [0.0]]
    hub.hub.omega_BN_BInit = [[0.6], [0.02], [-0.01]]
    if hinged:
        # no mass between the two axes: one body on two hinges
        arm = spinningBodyTwoDOFStateEffector.SpinningBodyTwoDOFStateEffector()
        arm.mass1, arm.mass2 = 0.0, 115.0
        arm.IS1PntSc1_S1 = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
        arm.IS2PntSc2_S2 = [[2.0, 0.0, 0.0], [0.0, 25.0, 0.0], [0.0, 0.0, 25.0]]
        arm.r_S1B_B, arm.r_S2S1_S1 = [[-0.2], [0.0], [0.0]], [[0.0], [0.0], [0.0]]
        arm.r_Sc1S1_S1, arm.r_Sc2S2_S2 = [[0.0], [0.0], [0.0]], [[-0.32], [0.0054], [-0.0005]]
        arm.s1Hat_S1, arm.s2Hat_S2 = [[0.0], [1.0], [0.0]], [[0.0], [0.0], [1.0]]
        identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        arm.dcm_S10B, arm.dcm_S20S1 = identity, identity
        arm.k1 = arm.k2 = 4335.0
        arm.c1 = arm.c2 = 2.7597
        arm.theta1Init, arm.theta2Init = 0.03, -0.02
        hub.addStateEffector(arm)
        simulation.AddModelToTask("task", arm)
    simulation.AddModelToTask("task", hub)
    simulation.InitializeSimulation()
    stops = iter(range(1, RUNS + 2))

    def work():
        simulation.ConfigureStopTime(macros.sec2nano(seconds * next(stops)))
        return simulation.ExecuteSimulation

    return shortest(seconds, work)


def rocketpy(_):
    """A sounding rocket's ballistic flight, LSODA with the default tolerances."""
    from rocketpy import Environment, Flight, GenericMotor, Rocket

    air = Environment(latitude=37.84, longitude=-75.48, elevation=5)
    motor = GenericMotor(
        thrust_source=2000.0,
        burn_time=4.0,
        chamber_radius=0.033,
        chamber_height=0.6,
        chamber_position=0.3,
        propellant_initial_mass=3.0,
        nozzle_radius=0.033,
        dry_mass=1.8,
        center_of_dry_mass_position=0.3,
        dry_inertia=(0.125, 0.125, 0.002),
    )
    rocket = Rocket(
        radius=0.0635,
        mass=14.4,
        inertia=(6.3, 6.3, 0.034),
        power_off_drag=0.4,
        power_on_drag=0.4,
        center_of_mass_without_motor=0.0,
        coordinate_system_orientation="tail_to_nose",
    )
    rocket.add_motor(motor, position=-1.25)
    rocket.add_nose(length=0.55, kind="vonKarman", position=1.28)
    rocket.add_trapezoidal_fins(n=4, root_chord=0.12, tip_chord=0.06, span=0.11, position=-1.05)

    def work():
        return lambda: float(
            Flight(rocket=rocket, environment=air, rail_length=5.2, inclination=85, heading=90).t_final
        )

    return shortest(0.0, work)


def simupy_flight(case):
    """A NASA check case as its repository flies it: a script, of which `simulate` is timed."""
    import simupy.block_diagram
    import simupy_flight as library

    cases = os.path.join(os.path.dirname(os.path.dirname(library.__file__)), "nesc_test_cases")
    sys.path.insert(0, cases)
    sys.argv = sys.argv[:1]
    import nesc_testcase_helper

    nesc_testcase_helper.plot_nesc_comparisons = lambda *_, **__: None
    taken = {}
    simulate = simupy.block_diagram.BlockDiagram.simulate

    def timed(diagram, seconds, **options):
        begun = time.perf_counter()
        result = simulate(diagram, seconds, **options)
        taken["simulated_s"], taken["wall_s"] = seconds, time.perf_counter() - begun
        return result

    simupy.block_diagram.BlockDiagram.simulate = timed
    least = None
    for _ in range(RUNS):
        with open(os.path.join(cases, case)) as script, contextlib.redirect_stdout(io.StringIO()):
            exec(compile(script.read(), case, "exec"), {"__name__": "case", "__file__": os.path.join(cases, case)})
        least = dict(taken) if least is None or taken["wall_s"] < least["wall_s"] else least
    return least


PEERS = {
    "basilisk-rigid": (basilisk, False),
    "basilisk-hinged": (basilisk, True),
    "rocketpy": (rocketpy, None),
    "simupy-flight-03": (simupy_flight, "nesc_case03.py"),
    "simupy-flight-09": (simupy_flight, "nesc_case09.py"),
}


if __name__ == "__main__":
    peer, argument = PEERS[sys.argv[1]]
    try:
        answer = peer(argument)
    except ImportError as missing:
        answer = {"missing": str(missing)}
    print(json.dumps(answer))

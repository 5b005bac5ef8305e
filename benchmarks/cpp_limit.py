"""Our flight kernels against the same equations in plain C++ (`plain_cpp/flight.cpp`), one flight and eight lanes.

Run: ``python benchmarks/cpp_limit.py [ROUNDS]``; needs g++. C++ is built into a temporary folder, must end 10 s of
flight where ours ends, and only then is timed. The faster of its variants is the limit.
"""

import ctypes
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from problem import PULSE_S, minima, reference_problem

from flightmodel import earth
from synthetic_flight import dynamics, simulate
from synthetic_flight.dynamics import AUX, STATES
from synthetic_flight.simulate import DEFLECTION_LIMIT_RAD

SOURCE = Path(__file__).parent / "plain_cpp" / "flight.cpp"
COMMON = ["-std=c++17", "-O3", "-march=native", "-shared", "-fPIC", "-Wno-psabi"]
FLAGS = {"strict": ["-ffp-contract=fast", "-fno-math-errno"], "fast": ["-ffast-math"]}
SCALAR = {"library's atan2 and exp": "fly_library", "our polynomials": "fly_polynomials"}
RATE_HZ = 500.0
DOUBLES = ctypes.POINTER(ctypes.c_double)


class Tables(ctypes.Structure):
    _fields_ = [(n, DOUBLES) for n in ("air", "grid", "mach", "coefficients", "free")] + [
        (n, ctypes.c_long) for n in ("airs", "rows", "machs", "alphas")
    ]


def build(folder):
    """Libraries by the name of their flags."""
    built = {}
    for name, flags in FLAGS.items():
        target = Path(folder) / f"{name}.so"
        subprocess.run(["g++", *COMMON, *flags, str(SOURCE), "-o", str(target)], check=True)
        built[name] = ctypes.CDLL(str(target))
    return built


class Flights:
    """Flights ready for ours and for C++: the pulse, every flight with a joint of its own."""

    def __init__(self, problem, lanes):
        self.lanes = lanes
        factors = 1.0 + 0.01 * np.arange(lanes)
        self.parameters = np.stack([simulate.parameter_vector(problem.vehicle, ca=f, cm=f) for f in factors])
        self.states = np.tile(problem.entry, (lanes, 1))
        self.tables = simulate.kernel_tables(problem.vehicle, np.stack([problem.atmosphere] * lanes))

    def ours(self, seconds, step):
        """Final states (lanes, 20)."""
        steps = round(seconds / step)
        out, aux = np.empty((self.lanes, 2, STATES)), np.empty((self.lanes, 2, AUX))
        workspace, written = simulate.workspace(self.states, self.parameters), np.zeros(self.lanes, dtype=np.int64)
        dynamics.integrate(
            (0,) * self.lanes,
            (),
            (),
            workspace,
            self.tables,
            earth.WGS84,
            step,
            steps,
            2,
            0,
            DEFLECTION_LIMIT_RAD,
            out,
            aux,
            written,
        )
        return out[:, -1]

    def cpp(self, function, seconds, step):
        """The same from C++."""
        state, parameters = self.states.T.copy(), self.parameters[:, : dynamics.DELAYED].T.copy()
        arrays = [a.ctypes.data_as(DOUBLES) for a in self.tables]
        air, _, mach, coefficients, _ = (a.shape for a in self.tables)
        tables = Tables(*arrays, air[0], air[1], mach[0], coefficients[1])
        planet = (ctypes.c_double * 5)(*earth.WGS84[:5])  # its gas is that of the air table
        function(
            state.ctypes.data_as(DOUBLES),
            parameters.ctypes.data_as(DOUBLES),
            ctypes.byref(tables),
            planet,
            ctypes.c_double(step),
            ctypes.c_long(round(seconds / step)),
        )
        return state.T


def must_agree(name, ours, theirs):
    """Largest difference of positions and velocities, relative, and of quaternions and rates, absolute."""
    scale = np.repeat([np.linalg.norm(ours[0, :3]), np.linalg.norm(ours[0, 3:6]), 1.0], [3, 3, 14])
    difference = float(np.max(np.abs(theirs - ours) / scale))
    print(f"  {name:48s} differs by {difference:.1e} after 10 s")
    assert difference < 1e-9, f"{name} flies something else: {difference}"


def main():
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    if shutil.which("g++") is None:
        print("g++ not installed: a C++17 compiler is wanted")
        return
    problem = reference_problem()
    one, eight, many = Flights(problem, 1), Flights(problem, 8), Flights(problem, 16)
    step = 1.0 / RATE_HZ
    with tempfile.TemporaryDirectory() as folder:
        libraries = build(folder)
        scalar = {
            f"C++, one flight, {flags}, {words}": getattr(library, symbol)
            for flags, library in libraries.items()
            for words, symbol in SCALAR.items()
        }
        eights = {f"C++, eight lanes, {flags}": library.fly_eight for flags, library in libraries.items()}
        reference = one.ours(10.0, step), many.ours(10.0, step)
        for flights, functions, flown in ((one, scalar, reference[0]), (eight, eights, reference[1][:8])):
            for name, function in functions.items():
                must_agree(name, flown, flights.cpp(function, 10.0, step))
        pieces = {
            "ours, one flight": lambda: one.ours(PULSE_S, step),
            "ours, sixteen lanes": lambda: many.ours(PULSE_S, step),
        }
        for flights, functions in ((one, scalar), (eight, eights)):
            pieces |= {n: lambda f=f, flights=flights: flights.cpp(f, PULSE_S, step) for n, f in functions.items()}
        shortest = minima(pieces, rounds)
    flights_of = {n: 8 if "eight" in n else 16 if "sixteen" in n else 1 for n in shortest}
    per = {n: t / (PULSE_S * RATE_HZ) / flights_of[n] for n, t in shortest.items()}
    print(f"\n{'':52s}{'ns a step and flight':>22s}{'simulated s a s':>18s}")
    for name, t in per.items():
        print(f"{name:52s}{t * 1e9:22.0f}{step / t:18.0f}")
    best, best_lanes = min(per[n] for n in scalar), min(per[n] for n in eights)
    ours, ours_lanes = per["ours, one flight"], per["ours, sixteen lanes"]
    print(f"\nours / C++, one flight, time: {ours / best:.2f} (target 1.25 at most)")
    print(f"ours / C++, lanes, time a flight: {ours_lanes / best_lanes:.2f} (target 1.6 at most)")
    print(f"our one flight / our lanes, time a flight: {ours / ours_lanes:.2f} (target 3 at least)")


if __name__ == "__main__":
    main()

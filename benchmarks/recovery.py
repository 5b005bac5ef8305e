"""Truth recovery over many synthetic days: errors of the trajectory and of each deflection estimate, seed by seed.

Run: ``python benchmarks/recovery.py [FIRST LAST] [--video]``. The vehicle flies its own coefficients; the day's air,
the sounding's errors and every instrument's errors are drawn anew for each seed. About 6 s a seed, 15 s with video.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from postflight import run_folder
from postflight.deflections import METHODS, estimate
from postflight.flight import read_flight
from postflight.reconstruction import reconstruct
from postflight.scoring import BET_SD, score_run
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario


def main():
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    first, last = numbers if len(numbers) == 2 else (0, 10)
    scenario = read_scenario("irve2_reference")
    if "--video" not in sys.argv:
        scenario = replace(scenario, spec=scenario.spec.model_copy(update={"video": None}))
    errors = {m: [] for m in METHODS}
    bets = []
    for seed in range(first, last):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "flight"
            simulate_to_folder(scenario, seed, folder)
            flight = reconstruct(read_flight(folder))
            methods = METHODS if flight.telemetry.frames else METHODS[1:]
            answers = estimate(flight, methods)
            with run_folder.RunFolder(folder, flight.telemetry, {}) as run:
                run_folder.write_reconstruction(run, flight)
                run_folder.write_answers(run, answers)
                run.write_json("summary.json", run_folder.summary(flight, answers))
            score = score_run(folder)
        bets.append([score.bet[k] for k in BET_SD])
        words = [f"{m} {score.methods[m]['error_deg']:+.2f} (sd {score.methods[m]['sd_deg']:.2f})" for m in methods]
        for m in methods:
            errors[m].append(score.methods[m]["error_deg"])
        red = [v.name for v in flight.consistency_checks if not v.passed]
        print(f"seed {seed}: m, m/s, deg {np.round(bets[-1], 2)}; {', '.join(words)}; red verdicts {red}", flush=True)
    print(
        "BET rms errors over the pulse, largest:",
        dict(zip(BET_SD, np.max(bets, axis=0).round(2).tolist(), strict=True)),
    )
    for method, values in errors.items():
        if values:
            rms, worst = np.sqrt(np.mean(np.square(values))), np.max(np.abs(values))
            print(f"{method}: error at peak q, rms {rms:.2f} deg, largest {worst:.2f} deg of {len(values)}")


if __name__ == "__main__":
    main()

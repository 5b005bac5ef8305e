"""Are proposed noise levels those of the flight, and is a trajectory with them as uncertain as it says?

Run: ``python benchmarks/noise_levels.py [FLIGHTS [FIRST SEED]]`` (some 10 s a flight). A short rocket flight with
inertial sensors and a receiver (`tests/recon/pad_flight.py`), whose levels are stated several times too large or too
small. Printed: per level the rms of log(proposed / true), how often the 90 % interval holds the truth, and the rms of
position and velocity errors over their sd, as stated and with what is proposed.
"""

import sys
from dataclasses import replace

import numpy as np

from recon.noise_levels import noise_levels
from recon.reconstruct import reconstruct
from tests.recon import pad_flight

TRUE = {"horizontal_sd_m": 3.0, "vertical_sd_m": 5.0, "speed_sd_mps": 0.2, "vertical_speed_sd_mps": 0.3}
# stated over true: as a cautious analyst does, and as a brochure
STATED = {
    "too large": {"horizontal_sd_m": 5.0, "vertical_sd_m": 4.0, "speed_sd_mps": 5.0, "vertical_speed_sd_mps": 5.0},
    "too small": {"horizontal_sd_m": 0.4, "vertical_sd_m": 0.3, "speed_sd_mps": 0.3, "vertical_speed_sd_mps": 0.3},
}
AT_S = (0.0, 3.0, 6.0, 10.0, 15.0, 20.0)


def misstated(telemetry, factors):
    """The same data with other stated levels."""
    record = telemetry.gnss["gps"]
    levels = {name: TRUE[name] * factor for name, factor in factors.items()}
    return replace(telemetry, gnss={"gps": replace(record, spec=replace(record.spec, **levels))})


def normalised(telemetry):
    """Position's and velocity's errors over their sd at some times, (n, 6)."""
    bet = reconstruct(telemetry).smoothed
    out = []
    for at in AT_S:
        error, covariance = pad_flight.off(bet, at)
        out.append(error[:6] / np.sqrt(np.diag(covariance)[:6]))
    return np.array(out)


def main():
    flights = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 100
    for name, factors in STATED.items():
        ratios, held, before, after = {k: [] for k in TRUE}, {k: [] for k in TRUE}, [], []
        for seed in range(first, first + flights):
            telemetry = misstated(pad_flight.sense(seed), factors)
            found = noise_levels(telemetry)
            for level in found.levels:
                if level.key in TRUE:
                    ratios[level.key].append(np.log(level.proposed / TRUE[level.key]))
                    held[level.key].append(level.low <= TRUE[level.key] <= level.high)
            before.append(normalised(telemetry))
            after.append(normalised(found.telemetry))
        print(f"stated {name}, {flights} flights")
        for key, values in ratios.items():
            rms = float(np.sqrt(np.mean(np.square(values))))
            print(f"  {key:24} log(proposed / true) rms {rms:.2f}, in 90 % interval {100 * np.mean(held[key]):.0f} %")
        for words, z in (("as stated", before), ("as proposed", after)):
            rms = [float(np.sqrt(np.mean(np.concatenate(z)[:, part] ** 2))) for part in (slice(0, 3), slice(3, 6))]
            print(f"  {words:12} rms of error over sd: position {rms[0]:.2f}, velocity {rms[1]:.2f}", flush=True)


if __name__ == "__main__":
    main()

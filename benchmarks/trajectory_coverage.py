"""Are the trajectory's standard deviations true? Normalised errors and coverage over many dispersed flights.

Run: ``python benchmarks/trajectory_coverage.py [SCENARIO] [FLIGHTS]`` (irve2_reference, 100). About
2 s a flight on each of two cores.
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.recon import dispersed


def main():
    scenario = next((a for a in sys.argv[1:] if not a.isdigit()), "irve2_reference")
    count = next((int(a) for a in sys.argv[1:] if a.isdigit()), 100)
    flights = dispersed.fly_all(range(count), scenario)
    print(f"{scenario}: {count} flights; {sum(bool(f.words) for f in flights)} tumbled or diverged")
    for which in ("smoothed", "filtered"):
        print(f"\n{which}: mean normalised error squared by epoch, s from peak pressure")
        print(f"{'':16}" + "".join(f"{s:8.0f}" for s in dispersed.PEAK_OFFSETS_S) + "    95 % band")
        for name, values in dispersed.nees(flights, which).items():
            degrees = 9 if name == "all nine" else 3
            low, high = dispersed.nees_band(degrees, count, 0.95)
            print(f"{name:16}" + "".join(f"{v:8.2f}" for v in values.mean(axis=0)) + f"    {low:.2f} to {high:.2f}")
        print(f"\n{which}: share of errors inside 1, 2, 3 sd, at peak pressure and over all epochs")
        z = dispersed.normalised(flights, which)
        at_peak = dispersed.coverage(z[:, dispersed.PEAK_OFFSETS_S.index(0.0)])
        everywhere = dispersed.coverage(z).mean(axis=1)
        for i, name in enumerate(dispersed.COMPONENTS):
            columns = [*at_peak[:, i], *everywhere[:, i]]
            print(f"{name:16}" + "".join(f"{v:8.3f}" for v in columns))
        band = dispersed.coverage_band(count, 0.95)
        print("95 % band       " + ", ".join(f"{a:.2f} to {b:.2f}" for a, b in band))
    rms = {w: np.sqrt(np.mean([getattr(f, w)[0] ** 2 for f in flights], axis=0)) for w in ("smoothed", "filtered")}
    print("\nrms at peak, smoothed and filtered: m, m/s, deg")
    k = dispersed.PEAK_OFFSETS_S.index(0.0)
    unit = np.repeat([1.0, 1.0, np.rad2deg(1.0)], 3)
    for i, name in enumerate(dispersed.COMPONENTS):
        print(f"{name:16}{rms['smoothed'][k, i] * unit[i]:10.4f}{rms['filtered'][k, i] * unit[i]:10.4f}")
    red = Counter(name for f in flights for name in f.red)
    print(f"\nred verdicts: {sum(red.values())} of {sum(f.consistency_checks for f in flights)}")
    for name, times in red.most_common():
        print(f"  {name}: {times}")


if __name__ == "__main__":
    main()

"""Is the camera time bias estimated as well as stated? Biases planted in the camera's times, over dispersed flights.

Run: ``python benchmarks/camera_time_bias.py [FLIGHTS [FIRST SEED]] [FOLDER]`` (100 flights; those that
``estimator_coverage.py`` kept in FOLDER, or flown now). Offsets of 0, 0.05 and 0.2 s in turn, late and early; the
a priori sd of the bias is 0.3 s. The camera's history is drawn, not rendered: 4 frames a second, errors of 0.15 or 0.40
deg in the plane and twice that normal to it.
"""

import estimator_coverage as dispersed
import numpy as np

from estimators.fusing import fuse_flight
from flightmodel.checks import DivergenceError

PLANTED_S = (0.0, 0.05, 0.2, -0.05, -0.2)
STATED_SD_S = 0.3


def found_clock(seed, folder, late_s, camera_sd_rad):
    """Offset found and its sd, s; None where the flight tumbled or has no common answer."""
    pulse, truth = dispersed.kept_flight(folder, seed)
    if str(truth["words"]):
        return None
    use = pulse.through_pulse
    told_s = pulse.time_s[use]
    seen = dispersed.columns(told_s - late_s, pulse.time_s, truth["theta_yz"])
    camera = dispersed.camera_history(np.random.default_rng([seed, 7, 2009]), seen, told_s, camera_sd_rad)
    try:
        clock = fuse_flight(pulse, camera, camera_time_bias_sd_s=STATED_SD_S).camera_time_bias
    except DivergenceError as fault:
        print(f"flight {seed}: {fault}")
        return None
    return None if clock is None else (clock.offset_s, clock.sd_s)  # of a joint that hardly moves there is none


def main():
    seeds, folder = dispersed.seeds_and_folder()
    dispersed.fly_missing(folder, seeds)
    for name, sd in dispersed.CAMERA_SD.items():
        rows = []
        for k, seed in enumerate(seeds, 1):
            late = PLANTED_S[seed % len(PLANTED_S)]
            answer = found_clock(seed, folder, late, sd)
            if answer is not None:
                rows.append((answer[0] - late, answer[1]))
            if k % 10 == 0:
                print(f"{k} of {len(seeds)}", flush=True)
        error, stated = np.array(rows).T
        inside = [100.0 * np.mean(np.abs(error) < k * stated) for k in (1, 2)]
        size = [1e3 * x for x in (np.sqrt(np.mean(error**2)), error.mean(), np.abs(error).max(), stated.mean())]
        print(f"{name}: {len(rows)} flights; rms {size[0]:.1f} ms, mean {size[1]:+.1f}, largest {size[2]:.1f}, "
              f"stated {size[3]:.1f}; 1 sd covers {inside[0]:.0f} %, 2 sd {inside[1]:.0f} %", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()

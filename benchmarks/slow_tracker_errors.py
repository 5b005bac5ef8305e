"""Are the standard deviations true where trackers err slowly, with these errors stated and not?

Run: ``python benchmarks/slow_tracker_errors.py CASE [FIRST LAST]`` (seeds 0 to 12). Cases, each 85 s of the reference
entry, vehicle, start and all errors dispersed, as in `tests.recon.dispersed`:

- ``range-rate``: both radars also give range rates (0.05 m/s white, 0.2 m/s that lasts 5 s), ten a second;
- ``velocity``: instead of radars a receiver at 10 Hz (0.1 m/s white, 0.3 m/s that lasts 5 s);
- ``servo HZ LAG_SD``: the radars' angles follow the target as a second-order servo (Butterworth), and its lag is off by
  a fraction of LAG_SD.

Each is reconstructed as stated by the scenario, and with the slow error taken out of the flight file. Printed: rms of
error over sd by group, over six epochs about the peak; mean NIS of each tracker over its degrees of freedom; red
checks. About 15 s a flight.
"""

import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from flightmodel.flightfolder import read_flight
from recon.reconstruct import reconstruct
from recon.settings import Settings
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.instrument_errors import Gnss
from tests.recon import dispersed

RATE_HZ = 10.0
RECEIVER = {
    "rate_hz": RATE_HZ, "horizontal_sd_m": 3.0, "vertical_sd_m": 5.0, "speed_sd_mps": 0.1, "vertical_speed_sd_mps": 0.1,
    "velocity_wander_mps": 0.3, "velocity_wander_time_constant_s": 5.0,
}  # fmt: skip
DOPPLER = {"range_rate_sd_mps": 0.05, "range_rate_wander_mps": 0.2, "range_rate_wander_time_constant_s": 5.0}


def scenario_of(case, seed, servo):
    """The dispersed reference entry with one case's trackers."""
    scenario = dispersed.dispersed_scenario("irve2_reference", seed)
    spec = scenario.spec
    if case == "velocity":
        update = {"radars": {}, "gnss": {"receiver": Gnss(**RECEIVER)}}
    else:
        terms = {"rate_hz": RATE_HZ} | (DOPPLER if case == "range-rate" else servo)
        update = {"radars": {name: radar.model_copy(update=terms) for name, radar in spec.radars.items()}}
    return replace(scenario, spec=spec.model_copy(update=update))


def restated(telemetry, **sizes):
    """The same readings with other sizes of slow errors in the flight file."""
    radars = {n: replace(r, spec=replace(r.spec, **sizes)) for n, r in telemetry.radars.items()}
    gnss = {n: replace(r, spec=replace(r.spec, **sizes)) for n, r in telemetry.gnss.items()}
    return replace(telemetry, radars=radars, gnss=gnss)


def ways_of(case, telemetry):
    """Telemetry by how the slow error is stated."""
    if case == "range-rate":
        return {"stated": telemetry, "not stated": restated(telemetry, range_rate_wander_sd_mps=0.0)}
    if case == "velocity":
        return {"stated": telemetry, "not stated": restated(telemetry, velocity_wander_sd_mps=0.0)}
    return {"stated": telemetry, "not stated": restated(telemetry, angle_servo_hz=0.0, servo_lag_sd=0.0)}


def scored(telemetry, truth):
    """Errors over sd and errors at the epochs (e, 9), mean NIS by source, red checks."""
    bet = reconstruct(telemetry, Settings(output_rate_hz=10.0))
    peak = float(truth.time_s[np.argmax(truth.dynamic_pressure_pa)])
    at = np.round(peak + np.array(dispersed.PEAK_OFFSETS_S), 1) - 1e-6
    error, covariance = dispersed.scored(bet.smoothed, truth.trajectory, at)
    normal = error / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    nis = {check.name.removeprefix("NIS "): check.value for check in bet.consistency_checks if check.code == "nis"}
    red = [check.name for check in bet.consistency_checks if not check.passed]
    return normal, error, nis, red


def main():
    case, *rest = sys.argv[1:]
    numbers = [float(a) for a in rest]
    servo = {}
    if case == "servo":
        servo, numbers = {"angle_servo_hz": numbers[0], "servo_lag": numbers[1]}, numbers[2:]
    first, last = map(int, numbers or (0, 12))
    normal, errors, innovations, red = {}, {}, {}, {}
    for seed in range(first, last):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "flight"
            truth = simulate_to_folder(scenario_of(case, seed, servo), seed, folder)
            telemetry = read_flight(folder)
        for way, given in ways_of(case, telemetry).items():
            one, error, nis, reds = scored(given, truth)
            innovations.setdefault(way, []).append(nis)
            normal.setdefault(way, []).append(one)
            errors.setdefault(way, []).append(error)
            red.setdefault(way, Counter()).update(reds)
            print(seed, way, np.round([np.sqrt((one[:, g] ** 2).mean()) for g in PARTS.values()], 2), reds, flush=True)
    for way in normal:
        z, e = np.array(normal[way]), np.array(errors[way])
        print(f"{case} {way}: {last - first} flights")
        for name, part in PARTS.items():
            per_flight = (z[..., part] ** 2).mean(axis=(1, 2))
            ratio, scatter = np.sqrt(per_flight.mean()), per_flight.std(ddof=1) / np.sqrt(len(z))
            rms = np.sqrt((e[..., part] ** 2).sum(axis=-1).mean())
            print(f"  {name:9s} rms of error over sd {ratio:.2f} +/- {scatter / 2.0 / ratio:.2f}, rms {rms:.3g}")
        mean = {source: np.mean([nis[source] for nis in innovations[way]]) for source in innovations[way][0]}
        print(f"  NIS {', '.join(f'{source} {value:.2f}' for source, value in mean.items())}; red {dict(red[way])}")


PARTS = {name: part for name, part in dispersed.GROUPS.items() if name != "all nine"}

if __name__ == "__main__":
    main()

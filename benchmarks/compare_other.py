"""How often does `postflight compare RUN FILE` name a planted systematic difference, and how often one not planted?

Run: ``python benchmarks/compare_other.py [FIRST LAST]``. Each seed is one true flight (85 s of the reference entry,
vehicle and start dispersed). The other team's trajectory is a reconstruction of

- ``export``: the run itself, with white noise of 0.1 m, 0.01 m/s and 0.02 deg: what an exchange of files should show;
- ``same``: the same telemetry without one radar and with every second second of the others;
- ``own``: telemetry of its own of the same flight, every instrument's errors drawn anew.

Into it is planted 20 ms, 1 m in a random direction, 0.3 deg of azimuth of the track, 0.3 deg of its body axes, heights
above the geoid (EGM96, with 0.5 m of error of its own), inertial velocities; or nothing.
Counted is what is found (``export``), and what is found beyond both covariances (``same``, ``own``): 1 m and 0.3 deg of
the body axes are less than what the covariances state there, and cannot be. The geoid's half metre is a shift. About
60 s a seed.
"""

import sys
import tempfile
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from flightmodel import earth, rotations
from flightmodel.earth import undulation_m
from flightmodel.flightfolder import read_flight
from flightmodel.tables import ThinnedSpan
from postflight.intake.other_trajectory import OtherTrajectory
from postflight.systematic_differences import systematic_differences
from recon.reconstruct import reconstruct
from recon.settings import Settings
from synthetic_flight import folder as folders
from synthetic_flight.scenarios import fly_scenario
from tests.recon.dispersed import dispersed_scenario

PLANTS = ("none", "time-offset", "shift", "track-rotation", "attitude-body", "height-datum", "inertial-velocity")
EVERY = 10  # of the rows of the trajectory are covariances: 1 Hz


def other_team(trajectory):
    """What the file holds of a trajectory."""
    return OtherTrajectory(
        "other",
        trajectory.time_s,
        trajectory.position_ecef_m,
        trajectory.velocity_ecef_mps,
        trajectory.q_ecef_body,
        trajectory.time_s[::EVERY],
        trajectory.covariance[::EVERY],
        (),
    )


def planted(other, what, rng):
    """The same with one systematic difference."""
    p, v = other.position_ecef_m, other.velocity_ecef_mps
    latitude, longitude, _ = earth.geodetic_from_ecef(p)
    way = rng.standard_normal(3)
    way /= np.linalg.norm(way)
    if what == "time-offset":
        return replace(other, time_s=other.time_s + 0.020)
    if what == "shift":
        return replace(other, position_ecef_m=p + way)
    if what == "track-rotation":
        down = earth.dcm_ned_ecef(latitude[0], longitude[0])[2]
        turn = rotations.exp(np.deg2rad(0.3) * down)
        return replace(
            other, position_ecef_m=p[0] + rotations.rotate(turn, p - p[0]), velocity_ecef_mps=rotations.rotate(turn, v)
        )
    if what == "attitude-body":
        return replace(other, q_ecef_body=rotations.boxplus(other.q_ecef_body, np.deg2rad(0.3) * way))
    if what == "height-datum":
        n = undulation_m(latitude, longitude) + 0.5 * rng.standard_normal()
        return replace(other, position_ecef_m=p + n[:, None] * earth.dcm_ned_ecef(latitude, longitude)[:, 2])
    if what == "inertial-velocity":
        return replace(other, velocity_ecef_mps=v + np.cross(earth.OMEGA_ECEF_RADPS, p))
    return other


def telemetry_of(scenario, truth, seed):
    """Telemetry of a true flight, its instruments' errors by the seed."""
    with tempfile.TemporaryDirectory() as temporary:
        folders._write(scenario, seed, truth, Path(temporary), lambda _fraction, _what: None)
        return read_flight(Path(temporary))


def main():
    numbers = [int(a) for a in sys.argv[1:]]
    first, last = numbers if len(numbers) == 2 else (0, 10)
    settings = Settings(output_rate_hz=10.0)
    named, false, sizes = Counter(), Counter(), defaultdict(list)
    for seed in range(first, last):
        scenario = dispersed_scenario("irve2_reference", seed)
        truth = fly_scenario(scenario, seed)
        telemetry = telemetry_of(scenario, truth, seed)
        bet = reconstruct(telemetry, settings).smoothed
        others = list(telemetry.radars.items())[1:]
        thinned = {name: replace(radar, every_s=(ThinnedSpan(every_s=2.0),)) for name, radar in others}
        rng = np.random.default_rng([seed, 4])
        n = len(bet.time_s)
        noisy = replace(
            bet,
            position_ecef_m=bet.position_ecef_m + 0.1 * rng.standard_normal((n, 3)),
            velocity_ecef_mps=bet.velocity_ecef_mps + 0.01 * rng.standard_normal((n, 3)),
            q_ecef_body=rotations.boxplus(bet.q_ecef_body, np.deg2rad(0.02) * rng.standard_normal((n, 3))),
        )
        teams = {
            "export": noisy,
            "same": reconstruct(replace(telemetry, radars=thinned), settings).smoothed,
            "own": reconstruct(telemetry_of(scenario, truth, seed + 5000), settings).smoothed,
        }
        for team, trajectory in teams.items():
            for what in PLANTS:
                other = planted(other_team(trajectory), what, np.random.default_rng([seed, 3]))
                found = systematic_differences(bet, bet.time_s[::EVERY], bet.covariance[::EVERY], other)
                names = [effect.name for effect in found.effects if effect.beyond or team == "export"]
                named[team, what] += what in names
                false[team, what] += bool(set(names) - {what, *(("shift",) if what == "height-datum" else ())})
                sizes[team, what] += [
                    (effect.stated_size, np.sqrt((effect.stated_sd**2).mean()))
                    for effect in found.effects
                    if effect.name == what
                ]
                words = "; ".join(effect.words for effect in found.effects)
                print(f"{seed} {team} {what}: beyond or found {names}; {words}", flush=True)
    for team in ("export", "same", "own"):
        for what in PLANTS:
            count, others = named[team, what], false[team, what]
            words = f"{team:6s} {what:18s} named {count:2d}, others named {others:2d} of {last - first}"
            if sizes[team, what]:
                size, sd = np.median(sizes[team, what], axis=0)
                words += f"; where found: size {size:.1f} allowed sd, of {sd:.2g} a component (medians)"
            print(words)


if __name__ == "__main__":
    main()

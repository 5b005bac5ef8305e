"""Do trackers and inertial sensors count the same time? For a flight whose trajectory contradicts itself.

A wrong time tag of seconds is no small error of the filter: it bends the path until scales and mountings are blamed.
The specific force of each track against the accelerometer's needs no filter (`postflight.checks.track_force`), and the
vehicle's oscillation compares accelerometer and gyros. `postflight check` prints the same comparisons.
"""

from __future__ import annotations

from itertools import combinations

from flightmodel.telemetry import Telemetry
from postflight.checks import inertial, tracks
from postflight.checks.track_force import Comparison, best_comparison
from postflight.checks.units_and_axes import TimeBias, clock_remarks
from recon.fault_isolation import TRIADS, FaultHypothesis

SHARP_S = 0.5  # a time bias of a larger standard deviation says nothing of a clock
FITS = 5.0  # reduced chi-square beyond which one lag and one scale do not describe a comparison


def is_sharp(bias: TimeBias | None) -> bool:
    """Whether a time bias is known well enough to be shown."""
    return bias is not None and bias.sd_s < SHARP_S


def bias_of(name: str, seen: Comparison | None) -> TimeBias | None:
    """Time bias of a track against the accelerometer; None where the comparison describes none, or badly."""
    return TimeBias(name, TRIADS[0], seen.lag_s, seen.lag_sd_s) if seen is not None and seen.misfit < FITS else None


def clock_faults(telemetry: Telemetry, without: tuple[str, ...] = ()) -> tuple[FaultHypothesis, ...]:
    """Clocks that are off by more than 5 sd and 0.1 s, with the sensors between which they are.

    Parameters
    ----------
    telemetry : Telemetry
    without : tuple of str
        Trackers that take no part.
    """
    sensed = telemetry.accelerometer
    if sensed is None or telemetry.motion.model != "strapdown":
        return ()
    planet = telemetry.planet
    trackers = {name: record for name, record in tracks.tracks(telemetry).items() if name not in without}
    biases = [tracks.tracker_pair(trackers, *pair, planet)[1] for pair in combinations(trackers, 2)]
    for name, record in trackers.items():
        position = tracks.position_of(record, planet)
        seen = best_comparison(record.time_s, position, sensed.time_s, sensed.measured_sensor, planet)
        biases.append(bias_of(name, seen))
    triads = {name: t for name, t in zip(TRIADS, (sensed, telemetry.rates), strict=True) if t is not None}
    biases.append(inertial.oscillation_of(triads, telemetry.vehicle).bias)
    known = [bias for bias in biases if bias is not None and is_sharp(bias)]
    involved = tuple(dict.fromkeys(name for bias in known for name in (bias.source, bias.against)))
    out = []
    for remark in clock_remarks(known, tuple(triads)):
        clock = tuple(remark.source.split(", "))
        others = tuple(name for name in involved if name not in clock)
        # one tracker that several others contradict is alone; else either side may be the one in error
        alone = len(clock) == 1 and clock[0] not in TRIADS and len(set(others) - set(TRIADS)) > 0
        out.append(FaultHypothesis(str(remark), remark.code, clock if alone else (*clock, *others)))
    return tuple(out)

"""Do trackers and inertial sensors share one time base? For a flight whose trajectory contradicts itself.

A wrong time tag of seconds is no small error of the filter: it bends the path until scales and mountings are blamed.
The specific force of each track against the accelerometer's needs no filter (`postflight.checks.track_force`), and the
vehicle's oscillation compares accelerometer and gyros. `postflight check` prints the same comparisons.
"""

from __future__ import annotations

from itertools import combinations

from flightmodel.checks import Issue
from flightmodel.telemetry import Telemetry
from postflight.checks import inertial, tracks
from postflight.checks.track_force import best_comparison, bias_of
from postflight.checks.units_and_axes import clock_remarks
from recon.fault_isolation import TRIADS


def clock_faults(telemetry: Telemetry, without: tuple[str, ...] = ()) -> tuple[Issue, ...]:
    """Clocks that are off by more than 5 sd and 0.1 s, with the pairs of sensors that show it.

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
    known = [bias for bias in biases if bias is not None and bias.is_sharp]
    involved = tuple(dict.fromkeys(name for bias in known for name in (bias.source, bias.against)))
    out = []
    for remark in clock_remarks(known, tuple(triads)):
        clock = tuple(remark.source.split(", "))
        others = tuple(name for name in involved if name not in clock)
        # one tracker that several others contradict is alone; else either side may be the one in error
        alone = len(clock) == 1 and clock[0] not in TRIADS and len(set(others) - set(TRIADS)) > 0
        out.append(Issue(remark.line, remark.code, clock if alone else (*clock, *others)))
    return tuple(out)

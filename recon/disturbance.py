"""When does the vehicle do what no sensor on board and no model of its motion tells? Found from the track itself.

A stage separates, a parachute opens, a gyro saturates: from then on the filter's prediction is wrong while it believes
otherwise, and the gate rejects every point that follows. That is told from a tracker that looks at something else for a
while (a side lobe) by the others: where any source is still believed, the rejected one is suspect; where none is, and
none comes back, the motion is. Inertial sensors carry a prediction through a false lock to where the track is believed
again; without them it is soon so uncertain that anything would be, so five seconds decide. Then an unknown acceleration
is allowed between the last point that was believed and the first that was not, white noise of density ``D`` along every
axis, ten times larger each time it does not suffice.

What an analyst states beforehand (``[[motion.disturbed]]``: shaking that turns into bias, a saturated gyro, thrust) is
the same noise, of accelerations and of rates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from flightmodel.checks import DivergenceError
from flightmodel.telemetry import Finding
from flightmodel.telemetry import Motion as MotionSpec
from recon.ekf import ForwardPass
from recon.motion import Motion
from recon.packed import Innovations
from recon.problem import Problem

SOURCE = "motion"  # of the finding
LOST_S = 5.0  # nothing believed for so long in ballistic flight, or, in any, to the end of the track
LOST_POINTS = 6
LEAST_BELIEVED = 0.5
BEFORE_S, AFTER_S = 1.5, 0.5  # a slow departure passes the gate for a while
FIRST_DENSITY, GROWTH, LARGEST_DENSITY = 0.1, 10.0, 1.1e6  # (m/s^2)^2/Hz
MOST = 10  # spans in which inertial sensors may fail to carry the track, before nothing is believed of them


STATED_CORRELATION_S = 1.0  # what is disturbed keeps its value for about so long


def with_stated(motion: Motion, spec: MotionSpec) -> Motion:
    """Motion with the noise of the spans that flight.toml calls disturbed."""
    force, rate = motion.force_density.copy(), motion.rate_density.copy()
    for d in spec.disturbed:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        force[inside] += d.sd_mps2**2 * STATED_CORRELATION_S
        if not motion.ballistic:  # which has no rotation
            rate[inside] += d.sd_radps**2 * STATED_CORRELATION_S
    return motion._replace(force_density=force, rate_density=rate)


@dataclass(frozen=True)
class Disturbance:
    """Span in which an unknown acceleration acts, and its density, (m/s^2)^2/Hz along every axis."""

    start_s: float
    end_s: float
    density: float

    def finding(self) -> Finding:
        """What an analyst should know of it."""
        gained = np.sqrt(self.density * (self.end_s - self.start_s))
        words = (
            f"the track cannot be followed without an acceleration that no sensor and no model tells: up to about "
            f"{gained:.2g} m/s of velocity gained along each axis"
        )
        return Finding(SOURCE, words, self.start_s, self.end_s)


def disturbed(problem: Problem, disturbances: tuple[Disturbance, ...]) -> Problem:
    """Problem with the disturbances' noise."""
    motion = problem.motion
    density = motion.force_density.copy()
    for d in disturbances:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        density[inside] += d.density
    return replace(problem, motion=motion._replace(force_density=density))


def lost_at(problem: Problem, innovations: Innovations) -> tuple[float, float] | None:
    """Last believed and first disbelieved time of the first stretch in which nothing is believed; None without one."""
    tried = problem.observed.usable
    time_s = problem.time_s[problem.node][tried]
    believed = innovations.accepted[tried]
    good = np.concatenate([[-1], np.flatnonzero(believed), [len(believed)]])
    for a, b in pairwise(good):
        first, last = a + 1, b - 1
        if last - first + 1 < LOST_POINTS:
            continue
        ends = b == len(believed)
        if ends or (problem.motion.ballistic and time_s[last] - time_s[first] >= LOST_S):
            return (float(time_s[a]) if a >= 0 else float(problem.time_s[0])), float(time_s[first])
    return None


def is_lost(problem: Problem, run: ForwardPass) -> bool:
    """Whether a pass, with all the disturbances it was given, believed less than half of what it was offered."""
    usable = problem.observed.usable
    return bool(run.innovations.accepted[usable].mean() < LEAST_BELIEVED)


def widened(known: tuple[Disturbance, ...], problem: Problem, run: ForwardPass) -> tuple[Disturbance, ...] | None:
    """Known disturbances and one more, or a stronger one, where a pass lost the track; None where it did not."""
    lost = lost_at(problem, run.innovations)
    if lost is None:
        return None
    start, end = max(lost[0] - BEFORE_S, float(problem.time_s[0])), lost[1] + AFTER_S
    near = [d for d in known if d.start_s <= end and start <= d.end_s]
    density = max((d.density for d in near), default=FIRST_DENSITY / GROWTH) * GROWTH
    if density > LARGEST_DENSITY:
        return None
    # one that is near but did not suffice is the same one: the track was lost a little later this time
    start, end = min([start, *(d.start_s for d in near)]), max([end, *(d.end_s for d in near)])
    found = (*(d for d in known if d not in near), Disturbance(start, end, density))
    if not problem.motion.ballistic and len(found) > MOST:
        raise _not_carried(found)
    return found


def _not_carried(found: tuple[Disturbance, ...]) -> DivergenceError:
    """Refusal of a flight whose inertial sensors carry it nowhere: each span more would cost some passes."""
    start, end = min(d.start_s for d in found), max(d.end_s for d in found)
    return DivergenceError(
        f"reconstruction: accelerometer and gyros do not carry the track: in more than {MOST} spans between "
        f"{start:.1f} and {end:.1f} s accelerations would be needed that nothing tells. Look at the flight with "
        "`postflight check`; check attitude_prior (q_ecef_body has its scalar first and turns body vectors into ECEF), "
        "units, axes and mounts of both sensors, and t0_utc. Where the vehicle was shaken so often, state it in "
        "[[motion.disturbed]]"
    )

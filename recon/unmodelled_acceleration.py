"""When does the vehicle accelerate in a way that no sensor on board and no model of its motion explains?

A stage separates, a parachute opens, a gyro saturates: from then on the filter's prediction is wrong by more than its
covariance, and the gate rejects every point that follows. A tracker on a false lock (a side lobe) is
distinguished by the others: where any source is still accepted, the rejected one is suspect; where none is, and none is
accepted later, the motion is. Inertial sensors carry a prediction through a false lock to where the track is accepted
again; without them it is soon so uncertain that any track would be, so five seconds decide. Then an
*unmodelled acceleration* is allowed between the last accepted and the first rejected point, white noise of density
``D`` along every axis, ten times larger each time it does not suffice.

The analyst's own spans (``[[motion.disturbed]]``) are the same noise (`recon.propagation.with_disturbances`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from flightmodel.checks import DivergenceError
from flightmodel.telemetry import Finding
from recon.ekf import ForwardPass, Innovations, Problem

CODE = "unmodelled-acceleration"
_REJECTED_S = 5.0  # no point accepted for so long in ballistic flight, or, in any, to the end of the track
LEAST_REJECTED_POINTS = 6
_LEAST_ACCEPTED_SHARE = 0.5
_BEFORE_S, _AFTER_S = 1.5, 0.5  # a slow departure passes the gate for a while
_FIRST_DENSITY, _GROWTH, _LARGEST_DENSITY = 0.1, 10.0, 1.1e6  # (m/s^2)^2/Hz
MOST_SPANS = 10  # in which inertial sensors may fail to carry the track before the flight is refused


@dataclass(frozen=True)
class UnmodelledAcceleration:
    """Span in which an unknown acceleration acts, and its density, (m/s^2)^2/Hz along every axis."""

    start_s: float
    end_s: float
    density: float

    def finding(self) -> Finding:
        """Finding that names its size."""
        gained = np.sqrt(self.density * (self.end_s - self.start_s))
        remark = (
            f"unmodelled acceleration: about {gained:.2g} m/s of velocity along each axis that neither sensors nor the "
            "motion model explain; check for staging, thrust, a parachute or a saturated sensor"
        )
        return Finding("motion", remark, self.start_s, self.end_s, CODE)


def with_unmodelled(problem: Problem, spans: tuple[UnmodelledAcceleration, ...]) -> Problem:
    """Problem with the process noise of unmodelled accelerations."""
    motion = problem.motion
    density = motion.force_density.copy()
    for d in spans:
        inside = (motion.time_s >= d.start_s) & (motion.time_s < d.end_s)
        density[inside] += d.density
    return replace(problem, motion=motion._replace(force_density=density))


def _rejected_span(problem: Problem, innovations: Innovations) -> tuple[float, float] | None:
    """Last accepted and first rejected time of the first stretch in which no point is accepted; None without one."""
    tried = problem.observed.usable
    time_s = problem.time_s[problem.node][tried]
    accepted = innovations.accepted[tried]
    good = np.concatenate([[-1], np.flatnonzero(accepted), [len(accepted)]])
    for a, b in pairwise(good):
        first, last = a + 1, b - 1
        if last - first + 1 < LEAST_REJECTED_POINTS:
            continue
        ends = b == len(accepted)
        if ends or (problem.motion.ballistic and time_s[last] - time_s[first] >= _REJECTED_S):
            return (float(time_s[a]) if a >= 0 else float(problem.time_s[0])), float(time_s[first])
    return None


def track_is_lost(problem: Problem, run: ForwardPass) -> bool:
    """Whether a pass accepted less than half of the points it was offered."""
    usable = problem.observed.usable
    return bool(run.innovations.accepted[usable].mean() < _LEAST_ACCEPTED_SHARE)


def with_one_more(
    known: tuple[UnmodelledAcceleration, ...], problem: Problem, run: ForwardPass
) -> tuple[UnmodelledAcceleration, ...] | None:
    """Known spans and one more, or a stronger one, where a pass lost the track; None where it did not."""
    lost = _rejected_span(problem, run.innovations)
    if lost is None:
        return None
    start, end = max(lost[0] - _BEFORE_S, float(problem.time_s[0])), lost[1] + _AFTER_S
    near = [d for d in known if d.start_s <= end and start <= d.end_s]
    density = max((d.density for d in near), default=_FIRST_DENSITY / _GROWTH) * _GROWTH
    if density > _LARGEST_DENSITY:
        return None
    # one that is near but did not suffice is the same one: the track was lost a little later this time
    start, end = min([start, *(d.start_s for d in near)]), max([end, *(d.end_s for d in near)])
    found = (*(d for d in known if d not in near), UnmodelledAcceleration(start, end, density))
    if not problem.motion.ballistic and len(found) > MOST_SPANS:
        raise _not_carried(found)
    return found


def _not_carried(found: tuple[UnmodelledAcceleration, ...]) -> DivergenceError:
    """Refusal of a flight that inertial sensors do not carry: each further span would cost some passes."""
    start, end = min(d.start_s for d in found), max(d.end_s for d in found)
    return DivergenceError(
        f"reconstruction: unmodelled accelerations in more than {MOST_SPANS} spans between {start:.1f} and {end:.1f} "
        "s: accelerometer and gyros do not carry the track. Run `postflight check`; check attitude_prior (q_ecef_body "
        "is scalar first and maps body vectors to ECEF), units, axes and mounting of both sensors, and t0_utc. State "
        "spans of heavy vibration in [[motion.disturbed]]",
        code="track-not-followed",
    )

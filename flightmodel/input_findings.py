"""Findings on inputs that are accepted but may make a reconstruction confidently wrong.

A receiver's filter follows the accelerations that its data sheet names, 4 g for those without a military or space
licence. Beyond, its fixes lag or are extrapolated, while the satellites that it counts and the accuracy that it states
say nothing of it. The accelerometer knows: a fix is doubtful where the mean specific force over the second before it
exceeds what the receiver can follow.

An attitude prior is the point about which the filter is linear: beyond some 30 deg it may converge to another attitude.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flightmodel.checks import FloatArray, Issue
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.telemetry import AttitudePrior, GnssRecord, TriadRecord

FILTER_S = 1.0  # over which a receiver smooths its solution; a shorter shock moves it by less than its noise
MOST_LINEAR_RAD = float(np.deg2rad(30.0))


def input_findings(
    accelerometer: TriadRecord | None,
    receivers: Mapping[str, GnssRecord],
    prior: AttitudePrior | None,
    most_g: Mapping[str, float],
) -> list[Issue]:
    """Findings of a flight that inertial sensors carry.

    Parameters
    ----------
    accelerometer : TriadRecord or None
    receivers : mapping of str to GnssRecord
    prior : AttitudePrior or None
    most_g : mapping of str to float
        Of each receiver the acceleration that it can follow, standard gravities.
    """
    found = []
    if accelerometer is not None:
        for name, record in receivers.items():
            found += _beyond_receiver(name, record, accelerometer, most_g[name])
    return found + (_wide_attitude(prior) if prior is not None else [])


def _beyond_receiver(name: str, fixes: GnssRecord, force: TriadRecord, most_g: float) -> list[Issue]:
    """Findings on fixes taken at speeds or accelerations beyond the receiver's limits."""
    mean_g = _mean_before(fixes.time_s, force) / STANDARD_GRAVITY_MPS2
    doubtful = np.flatnonzero(mean_g > most_g)
    if not len(doubtful):
        return []
    start, stop = (float(fixes.time_s[k]) for k in doubtful[[0, -1]])
    words = (
        f"{len(doubtful)} of {len(mean_g)} fixes follow a mean specific force of more than {most_g:g} g, up to "
        f"{mean_g[doubtful].max():.3g} g: beyond what a receiver is made for (most_g) they lag or are extrapolated, "
        "by hundreds of metres and until seconds later, with good satellite counts; try without them (use_s)"
    )
    return [Issue(words, "fixes-beyond-dynamics", name, start, stop)]


def _mean_before(time_s: FloatArray, force: TriadRecord) -> FloatArray:
    """Mean size of the specific force (n,), m/s^2, over a receiver's filter before each time; NaN without samples."""
    size = np.linalg.norm(force.measured_sensor, axis=1)
    known = np.isfinite(size)
    upto = np.append(0.0, np.cumsum(size[known]))
    first, end = (np.searchsorted(force.time_s[known], time_s - back, side="right") for back in (FILTER_S, 0.0))
    out = np.full(len(time_s), np.nan)
    some = end > first
    out[some] = (upto[end] - upto[first])[some] / (end - first)[some]
    return out


def _wide_attitude(prior: AttitudePrior) -> list[Issue]:
    """Say that a stated attitude is too uncertain for a filter that is linear about it."""
    if not (prior.sd_rad > MOST_LINEAR_RAD).any():
        return []
    worst = int(np.argmax(prior.sd_rad))
    words = (
        f"stated to {np.rad2deg(prior.sd_rad[worst]):.0f} deg about body {'xyz'[worst]}: beyond "
        f"{np.rad2deg(MOST_LINEAR_RAD):.0f} deg the filter, linear about it, may converge to another attitude with "
        "green checks; compare starts from several attitudes, or state [start] at_rest or a magnetometer"
    )
    return [Issue(words, "attitude-wide", "attitude_prior", prior.time_s, prior.time_s)]

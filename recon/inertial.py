"""Two bridged inertial triads on one grid, as the mechanisation wants them.

Mechanisation joins samples by straight lines. `unbent` moves them so that the lines have the integral of the curve;
else the error of the joins would be as large as the coning and sculling that are corrected for.
"""

from __future__ import annotations

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.trajectory import interpolate_rows
from recon.gaps import Bridged
from recon.motion import Motion, strapdown_motion
from recon.state import IntArray

SAME_INSTANT_S = 2e-6


def unbent(time_s: FloatArray, samples: FloatArray) -> FloatArray:
    """Samples (n, 3) whose straight joins have the integral of the curve: less a twelfth of the second difference.

    Where steps are uneven by a twentieth, at gaps and ends, samples stay as they are. White noise keeps its integral.
    """
    out = samples.copy()
    step = np.diff(time_s)
    even = np.abs(np.diff(step)) < 0.05 * step[1:]
    bend = samples[2:] - 2.0 * samples[1:-1] + samples[:-2]
    out[1:-1][even] -= bend[even] / 12.0
    return out


def inertial_motion(
    force: Bridged, rate: Bridged, node_time_s: FloatArray, clocks: bool = False
) -> tuple[Motion, IntArray]:
    """Both triads from first to last node, on the faster one's times and the nodes', and each node's index."""
    first, last = node_time_s[0], node_time_s[-1]
    finer = rate if np.median(np.diff(rate.time_s)) < 0.9 * np.median(np.diff(force.time_s)) else force
    inner = finer.time_s[(finer.time_s > first) & (finer.time_s < last)]
    near = np.searchsorted(node_time_s, inner)
    clear = (inner - node_time_s[np.clip(near - 1, 0, None)] > SAME_INSTANT_S) & (
        node_time_s[np.clip(near, None, len(node_time_s) - 1)] - inner > SAME_INSTANT_S
    )
    t = np.sort(np.concatenate([inner[clear], node_time_s]))
    motion = strapdown_motion(
        t,
        interpolate_rows(t, force.time_s, unbent(force.time_s, force.measured_sensor)),
        interpolate_rows(t, rate.time_s, unbent(rate.time_s, rate.measured_sensor)),
        _held(t, force),
        _held(t, rate),
        force.spec.dcm_body_sensor,
        rate.spec.dcm_body_sensor,
        clocks,
    )
    return motion, np.searchsorted(t, node_time_s).astype(np.int64)


def _held(at: FloatArray, triad: Bridged) -> FloatArray:
    """Density of the interval that each grid point opens."""
    k = np.clip(np.searchsorted(triad.time_s, at + SAME_INSTANT_S, side="right") - 1, 0, len(triad.time_s) - 1)
    return np.ascontiguousarray(triad.density[k])

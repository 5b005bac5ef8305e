"""By how much do a radar's angles lag behind the target, and how does the filter take that into account?

The antenna follows the target as a second-order servo without velocity lag: damping and integral of the angle's error
drive it, ``F(s) = (2 z w s + w^2) / (s^2 + 2 z w s + w^2)`` with ``w`` its bandwidth and ``z = 1 / sqrt(2)``
(Butterworth), so that the encoders read ``angle + (F - 1) angle``. The lag ``(F - 1) angle``, for slow motion
``- acceleration / w^2``, is that of a path: of the one about which the filter is linearised, made anew for every pass.
What the pass itself moves the path by is smoother than the path, and its own lag the next pass has.

A bandwidth that is not known exactly makes the lag larger or smaller at all times: the error state "servo lag" is the
fraction, twice that of ``1 / w``.

References
----------
RCC 753-95 (dynamic lag). Skolnik, Radar Handbook, 3rd ed., 9.10: errors of servos.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray
from flightmodel.instruments import BUTTERWORTH
from recon._measurement_kernels import RADAR
from recon.ekf import Problem
from recon.measurements import Instrument, sight
from recon.state import States

# the lag is exact for an angle that runs straight between steps: the path's own steps are a tenth of a second
_STEPS_A_PERIOD, _STEPS_S = 50, (0.01, 0.1)
_LEAST_NODES = 4


def with_servo_lag(problem: Problem, states: States | None) -> Problem:
    """Problem whose radars lag behind a path through all its nodes; as it is without servos, or a path."""
    lagging = [k for k, one in enumerate(problem.instruments) if one.kind == RADAR and one.servo_hz > 0.0]
    if states is None or not lagging or len(problem.time_s) < _LEAST_NODES:
        return problem
    known, at_s = problem.observed.known.copy(), problem.time_s[problem.node]
    for number in lagging:
        mine = problem.observed.source == number
        known[mine, 1:] = servo_lag(problem.instruments[number], problem.time_s, states, at_s[mine])
    return replace(problem, observed=problem.observed._replace(known=known))


def servo_lag(instrument: Instrument, time_s: FloatArray, states: States, at_s: FloatArray) -> FloatArray:
    """Lag (k, 2) of azimuth and elevation behind a path, rad: reading minus angle.

    Parameters
    ----------
    instrument : Instrument
        Radar with the bandwidth of its servo, Hz.
    time_s : (n,) float
        Nodes of the path, s.
    states : States
        At the nodes.
    at_s : (k,) float
        Times of the readings, s; the servo has settled on the target where the path begins.
    """
    from scipy import signal  # half a second to import
    from scipy.interpolate import CubicHermiteSpline

    c = rotations.dcm_from_q(states.q_ecef_body)
    point = CubicHermiteSpline(time_s, states.position_ecef_m + c @ instrument.arm_body_m, states.velocity_ecef_mps)
    step_s = float(np.clip(1.0 / (_STEPS_A_PERIOD * instrument.servo_hz), *_STEPS_S))
    even_s, step_s = np.linspace(
        time_s[0], time_s[-1], 1 + int(np.ceil((time_s[-1] - time_s[0]) / step_s)), retstep=True
    )
    ned = (point(even_s) - instrument.site_ecef_m) @ instrument.dcm.T
    _, azimuth, elevation = sight(*ned.T)
    angles = np.column_stack([np.unwrap(azimuth), elevation])
    # a straight line has no lag, and without that of the start there is no transient
    start, rate = angles[0], (angles[1] - angles[0]) / step_s
    bent = angles - start - rate * (even_s - even_s[0])[:, None]
    w = 2.0 * np.pi * instrument.servo_hz
    behind = ([-1.0, 0.0, 0.0], [1.0, 2.0 * BUTTERWORTH * w, w * w])
    top, bottom, _ = signal.cont2discrete(behind, step_s, method="foh")
    lag = signal.lfilter(np.ravel(top), bottom, bent, axis=0)
    return np.column_stack([np.interp(at_s, even_s, column) for column in lag.T])

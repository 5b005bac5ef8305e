"""How do gravity and the air of the sounding carry a vehicle without inertial sensors? Ballistic motion.

With ``u`` the velocity against the air and ``B`` the drag area per mass,

    dv/dt = g(r) - W x (W x r) - 2 W x v + rho |u| B e^d / 2 (-u + |u| (s1 n1 + s2 n2)),   rho = rho0(h) e^(c0 sd(h))

with ``n1`` and ``n2`` normal to the flow, ``n1`` as near as can be to the horizontal normal of the path's plane, ``n2``
in that plane. (Horizontal and vertical axes would spin where a parachute sinks straight down.) The six drivers
``d, s1, s2, c0, cN, cE`` are errors of the filter: drag and side forces are Gauss-Markov in time, density and the
winds' ``c sd(h)`` in altitude. Thrust or an opening parachute in stated spans is white noise of acceleration.
Steps are fourth-order Runge-Kutta steps, the transition is ``1 + M dt + M^2 dt^2 / 2`` of the partials half way; a step
in which the air would change the velocity by more than a fifth is taken in parts. Attitude takes no part.

Kernels: `recon._ballistic_kernels`; readable twin: `tests.oracles.ballistic`.
"""

from __future__ import annotations

import numpy as np

from flightmodel.atmosphere import profile_from_sounding
from flightmodel.checks import FloatArray
from flightmodel.telemetry import Motion as MotionSpec
from flightmodel.telemetry import Sounding
from recon.motion import Motion
from recon.state import IntArray

GRID_STEP_S = 0.05
AIR_FROM_M, _AIR_TO_M, AIR_STEP_M = -500.0, 900e3, 100.0
_POWERED_CORRELATION_S = 1.0  # a thrust that may be anything keeps its value for about so long


def air_table(sounding: Sounding) -> FloatArray:
    """Rows of `recon.motion.Motion.air` on the fixed altitudes above."""
    altitude = np.arange(AIR_FROM_M, _AIR_TO_M, AIR_STEP_M)
    air = profile_from_sounding(sounding).at(altitude)
    wind = air.wind_ned_mps
    return np.column_stack([np.log(air.density_kgpm3), wind[:, 0], wind[:, 1], air.density_sd, air.wind_sd_mps])


def ballistic_motion(
    spec: MotionSpec, sounding: Sounding, across_ecef: FloatArray, node_time_s: FloatArray, same_s: float
) -> tuple[Motion, IntArray]:
    """Motion on the nodes and steps of `GRID_STEP_S` between, and each node's index."""
    first, last = node_time_s[0], node_time_s[-1]
    steps = np.arange(first, last, GRID_STEP_S)
    near = np.clip(np.searchsorted(node_time_s, steps), 1, len(node_time_s) - 1)
    clear = np.minimum(np.abs(steps - node_time_s[near - 1]), np.abs(steps - node_time_s[near])) > same_s
    t = np.sort(np.concatenate([steps[clear], node_time_s]))
    density = np.full((len(t), 3), spec.acceleration_density**2)
    for start, end in spec.powered_s:
        density[(t >= start) & (t < end)] += spec.powered_sd_mps2**2 * _POWERED_CORRELATION_S
    still = np.zeros((len(t), 3))
    motion = Motion(
        True, t, still, still, density, still, np.eye(3), np.eye(3), False, air_table(sounding), AIR_FROM_M,
        AIR_STEP_M, spec.drag_area_per_mass_m2pkg, across_ecef,
    )  # fmt: skip
    return motion, np.searchsorted(t, node_time_s).astype(np.int64)

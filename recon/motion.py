"""What propagates a state in time? Inertial sensors on one grid of times, or a ballistic model of drag in the air.

Both drive the nine kinematic errors (position, velocity, rotation) through a few *drivers*, errors that the motion
depends on: with inertial sensors their bias, scale and mount, 18 in all, and the errors of their clocks, 2, where such
are stated; in ballistic flight drag, side forces, density and winds, 6 in all, and rotation is held fixed. So one
filter serves both. Models: `recon.strapdown`, `recon.ballistic`.

Mechanisation joins samples by straight lines. `with_exact_integrals` moves them so that the lines have the integral of
the curve, to fourth order,

    x_k <- x_k - (x_{k+1} - 2 x_k + x_{k-1}) / 12

else the error of the joins would be as large as the coning and sculling that are corrected for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flightmodel.checks import FloatArray
from flightmodel.trajectory import interpolate_rows
from recon.imu_screening import BridgedSensor
from recon.state import IntArray

_STRAPDOWN_DRIVERS, _CLOCKS, _BALLISTIC_DRIVERS = 18, 2, 6
SAME_INSTANT_S = 2e-6


class Inertial(NamedTuple):
    """Inertial part of a `Motion`, for kernels."""

    time_s: FloatArray
    force_sensor_mps2: FloatArray
    rate_sensor_radps: FloatArray
    force_density: FloatArray
    rate_density: FloatArray
    dcm_body_force: FloatArray
    dcm_body_rate: FloatArray


class Air(NamedTuple):
    """Ballistic part of a `Motion`, for kernels."""

    table: FloatArray
    from_m: float
    step_m: float
    drag_m2pkg: float
    across: FloatArray


class Motion(NamedTuple):
    """Time grid that contains every node, and what acts on it.

    Parameters
    ----------
    ballistic : bool
        Whether there are no inertial sensors.
    time_s : (k,) float
    force_sensor_mps2, rate_sensor_radps : (k, 3) float
        As measured, in sensor axes, gaps bridged, `with_exact_integrals`; zeros in ballistic flight.
    force_density, rate_density : (k, 3) float
        White-noise densities, (m/s^2)^2/Hz and (rad/s)^2/Hz, from a grid point to the next: along body axes, in
        ballistic flight along Earth-fixed axes.
    dcm_body_force, dcm_body_rate : (3, 3) float
        Nominal mountings.
    clocks : bool
        Whether the clocks of accelerometer and gyros may err.
    air : (a, 5) float
        Logarithm of density, wind north and east, sd of density's logarithm, sd of wind, at equally spaced altitudes.
    air_from_m, air_step_m : float
        Their first altitude and spacing.
    drag_m2pkg : float
        A priori drag area per mass.
    across_ecef : (3,) float
        Normal of the path's plane, for the axes of side forces.
    """

    ballistic: bool
    time_s: FloatArray
    force_sensor_mps2: FloatArray
    rate_sensor_radps: FloatArray
    force_density: FloatArray
    rate_density: FloatArray
    dcm_body_force: FloatArray
    dcm_body_rate: FloatArray
    clocks: bool
    air: FloatArray
    air_from_m: float
    air_step_m: float
    drag_m2pkg: float
    across_ecef: FloatArray

    def split(self) -> tuple[Inertial, Air | None]:
        """Return what kernels take: a None for the air lets them be compiled without ballistic flight."""
        air = (
            Air(self.air, self.air_from_m, self.air_step_m, self.drag_m2pkg, self.across_ecef)
            if self.ballistic
            else None
        )
        return Inertial(*self[1:8]), air

    @property
    def drivers(self) -> int:
        """Number of errors that the motion depends on."""
        return _BALLISTIC_DRIVERS if self.ballistic else _STRAPDOWN_DRIVERS + _CLOCKS * self.clocks


def strapdown_motion(
    time_s: FloatArray,
    force_sensor_mps2: FloatArray,
    rate_sensor_radps: FloatArray,
    force_density: FloatArray,
    rate_density: FloatArray,
    dcm_body_force: FloatArray,
    dcm_body_rate: FloatArray,
    clocks: bool = False,
) -> Motion:
    """Motion propagated by inertial sensors."""
    # numba compiles anew for every other memory layout
    return Motion(
        ballistic=False,
        time_s=np.ascontiguousarray(time_s, dtype=float),
        force_sensor_mps2=np.ascontiguousarray(force_sensor_mps2, dtype=float),
        rate_sensor_radps=np.ascontiguousarray(rate_sensor_radps, dtype=float),
        force_density=np.ascontiguousarray(force_density, dtype=float),
        rate_density=np.ascontiguousarray(rate_density, dtype=float),
        dcm_body_force=np.ascontiguousarray(dcm_body_force, dtype=float),
        dcm_body_rate=np.ascontiguousarray(dcm_body_rate, dtype=float),
        clocks=clocks,
        air=np.zeros((2, 5)),
        air_from_m=0.0,
        air_step_m=1.0,
        drag_m2pkg=0.0,
        across_ecef=np.zeros(3),
    )


def with_exact_integrals(time_s: FloatArray, samples: FloatArray) -> FloatArray:
    """Samples (n, 3) whose straight joins have the integral of the curve: less a twelfth of the second difference.

    Where steps are uneven by a twentieth, at gaps and ends, samples stay as they are. White noise keeps its integral.
    """
    out = samples.copy()
    step = np.diff(time_s)
    even = np.abs(np.diff(step)) < 0.05 * step[1:]
    second_difference = samples[2:] - 2.0 * samples[1:-1] + samples[:-2]
    out[1:-1][even] -= second_difference[even] / 12.0
    return out


def inertial_motion(
    force: BridgedSensor, rate: BridgedSensor, node_time_s: FloatArray, clocks: bool = False
) -> tuple[Motion, IntArray]:
    """Both sensors from first to last node, on the faster one's times and the nodes', and each node's index."""
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
        interpolate_rows(t, force.time_s, with_exact_integrals(force.time_s, force.measured_sensor)),
        interpolate_rows(t, rate.time_s, with_exact_integrals(rate.time_s, rate.measured_sensor)),
        _held(t, force),
        _held(t, rate),
        force.spec.dcm_body_sensor,
        rate.spec.dcm_body_sensor,
        clocks,
    )
    return motion, np.searchsorted(t, node_time_s).astype(np.int64)


def _held(at: FloatArray, sensor: BridgedSensor) -> FloatArray:
    """Density of the interval that each grid point opens."""
    k = np.clip(np.searchsorted(sensor.time_s, at + SAME_INSTANT_S, side="right") - 1, 0, len(sensor.time_s) - 1)
    return np.ascontiguousarray(sensor.density[k])

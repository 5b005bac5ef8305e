"""What carries a state from one moment to another: inertial sensors, or a ballistic model of drag in the day's air.

Both drive the nine kinematic errors (position, velocity, rotation) through a few *drivers*, errors that the motion
depends on: with inertial sensors their bias, scale and mount, 18 in all, and the errors of their clocks, 2, where such
are stated; in ballistic flight drag, side forces, density
and winds, 6 in all, and rotation stands still. So one filter serves both. Models and readable twins:
`recon.strapdown`, `recon.ballistic`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flightmodel.checks import FloatArray

STRAPDOWN_DRIVERS, CLOCKS, BALLISTIC_DRIVERS = 18, 2, 6


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
        As measured, in sensor axes, gaps bridged, `recon.inertial.unbent`; zeros in ballistic flight.
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
        Drag area per mass before anything is learnt.
    across_ecef : (3,) float
        Direction across the plane of the path, for the axes of side forces.
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
        return BALLISTIC_DRIVERS if self.ballistic else STRAPDOWN_DRIVERS + CLOCKS * self.clocks


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
    """Motion carried by inertial sensors."""
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

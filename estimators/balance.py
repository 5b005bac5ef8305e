"""What forces and moments does a deflected vehicle need to move as the centerbody's sensors say it moved?

Momentum and angular momentum of two rigid bodies that turn against each other about the joint, exact in the deflection
and in the rates. Body axes are the centerbody's; ``R(theta)`` turns shell axes into them, with ``rho`` the shell's c.g.
from the joint and ``w``, ``w'`` the measured rate and angular acceleration. Measured is the specific force ``f`` at a
point of the centerbody; the vehicle's c.g. lies ``d(theta)`` from it and moves::

    F = m (f + d'' + 2 w x d' + w' x d + w x (w x d))                                        aerodynamic force
    M = H' + w x H,   H = I_B w + R I_A R^T (w + phi) + mu r x (r' + w x r)                  about the c.g.

with ``phi`` the shell's rate against the body, ``r`` from the centerbody's c.g. to the shell's, ``mu = m_A m_B / m``.
Centrifugal, Coriolis and gyroscopic terms are all in these. Both must be those of the air, which acts on the shell
alone, at its nose, in shell axes::

    F = -q S (C_A x + C_N n),   M_nose = q S l (C_m n x x + C_mq l/(2V) w_A,transverse)

``n`` is the unit vector of the nose's lateral velocity in the air and ``w_A`` the shell's own rate. What is left of the
two balances are the residuals of the estimators: the force's *direction* (`force_residual`; neither mass nor dynamic
pressure enters but through the motion), its *size* along the shell's axis as a logarithm (`axial_residual`) and the
transverse *moment*, over ``q S C_A``, as a shift of the c.g. (`moment_residual`).

Assumed: rigid bodies, no twist, no air on the centerbody, no difference of gravitation within the vehicle.

References
----------
P. C. Hughes, "Spacecraft Attitude Dynamics", 1986, chapter 3 (two bodies on a spherical joint).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimators import _balance_kernels as kernels
from estimators.loads import FlightLoads
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle


@dataclass(frozen=True)
class Swing:
    """Deflection as a lateral vector, rad, and its first and second derivative by time; (n, 2) each."""

    theta_yz_rad: FloatArray
    rate_yz_radps: FloatArray
    acceleration_yz_radps2: FloatArray

    @classmethod
    def held(cls, theta_yz_rad: FloatArray) -> Swing:
        """Deflection that does not move."""
        still = np.zeros_like(theta_yz_rad)
        return cls(theta_yz_rad, still, still)

    @classmethod
    def of(cls, deflection: Callable[[FloatArray, int], FloatArray], time_s: FloatArray) -> Swing:
        """Deflection at times, from a function of times and the order of the derivative."""
        return cls(*(deflection(time_s, order) for order in range(3)))

    @cached_property
    def orders(self) -> FloatArray:
        """Deflection, rate and acceleration, (3, n, 2)."""
        return np.stack([self.theta_yz_rad, self.rate_yz_radps, self.acceleration_yz_radps2])

    def moved(self, theta: FloatArray, rate: FloatArray, acceleration: FloatArray) -> Swing:
        """Deflection, rate and acceleration moved by so much."""
        return Swing(self.theta_yz_rad + theta, self.rate_yz_radps + rate, self.acceleration_yz_radps2 + acceleration)


def force_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Tilt of the force against the shell less the air's, ``atan(C_N/C_A)`` on the flow's side; shell y, z (n, 2), rad.

    Parameters
    ----------
    vehicle : Vehicle
        In place of the loads' own.
    swing : Swing
    loads : FlightLoads
    """
    out, motion = np.empty(swing.theta_yz_rad.shape), _motion(loads)
    force = np.ascontiguousarray(loads.specific_force_body_mps2)
    kernels.force_left(_numbers(vehicle, loads), swing.orders, force, *motion, *_table(vehicle), out)
    return out


def axial_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Logarithm of the force along the shell's axis over the air's ``q S C_A`` (n, 1); NaN where it points forward.

    Parameters as of `force_residual`.
    """
    out, motion = np.empty((len(loads.time_s), 1)), _motion(loads)
    force = np.ascontiguousarray(loads.specific_force_body_mps2)
    kernels.axial_left(_numbers(vehicle, loads), swing.orders, force, *motion, *_table(vehicle), out)
    mass_per_force = vehicle.mass_kg / (loads.dynamic_pressure_pa * vehicle.reference.area_m2)
    return out + np.log(mass_per_force)[:, None]


def moment_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Transverse moment of the air less the motion's over ``q S C_A``, a shift of the c.g.; body y, z (n, 2), m.

    Parameters as of `force_residual`.
    """
    out, motion = np.empty(swing.theta_yz_rad.shape), _motion(loads)
    pressure = np.ascontiguousarray(loads.dynamic_pressure_pa)
    kernels.moment_left(_numbers(vehicle, loads), swing.orders, pressure, *motion, *_table(vehicle), out)
    return out


def _motion(loads: FlightLoads) -> tuple[FloatArray, ...]:
    """Rates, their derivatives, flow, Mach numbers and airspeeds in the one layout that kernels are compiled for."""
    rate, turning = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    columns = rate, turning, loads.flow_yz_rad, loads.mach, loads.airspeed_mps
    return tuple(np.ascontiguousarray(column, dtype=np.float64) for column in columns)


def _table(vehicle: Vehicle) -> tuple[FloatArray, FloatArray]:
    return np.ascontiguousarray(vehicle.aero.mach), np.ascontiguousarray(vehicle.aero.coefficients)


def _numbers(vehicle: Vehicle, loads: FlightLoads) -> FloatArray:
    """What the kernels know of a vehicle, as they lay it out."""
    shell, body = vehicle.aeroshell, vehicle.centerbody
    upper = np.triu_indices(3)
    return np.concatenate(
        [
            vehicle.joint_m,
            shell.cg_m - vehicle.joint_m,
            body.cg_m,
            vehicle.cg_m,
            loads.point_from_datum_m,
            [shell.mass_kg / vehicle.mass_kg, shell.mass_kg * body.mass_kg / vehicle.mass_kg],
            shell.inertia[upper],
            body.inertia[upper],
            [vehicle.reference.length_m, vehicle.reference.area_m2],
            vehicle.aero_terms.numbers,
        ]
    )

"""The balance of forces and moments of a deflected vehicle in vectors and matrices, as `estimators.balance` has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.balance import Swing
from estimators.loads import FlightLoads, lateral_and_size
from flightmodel import rotations
from flightmodel.aerodynamics import AeroTable
from flightmodel.airdata import lateral_angles
from flightmodel.checks import FloatArray
from flightmodel.deflection import rotation_vector_of_lateral
from flightmodel.vehicle import Vehicle

_STEP_S = 1e-4
_X = np.array([1.0, 0.0, 0.0])


def left_jacobian(rotation_rad: FloatArray) -> FloatArray:
    """Matrices ``(..., 3, 3)`` with ``exp(w + dw) = exp(J dw) exp(w)`` to first order, of rotation vectors (..., 3)."""
    angle = np.linalg.norm(rotation_rad, axis=-1)[..., None, None]
    cross = rotations.skew(rotation_rad)
    # (angle - sin angle) / angle^3, by its series where the difference would be rounding
    small = angle < 1e-2
    safe = np.where(small, 1.0, angle)
    third = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * cross + third * cross @ cross)


def flow_coefficients(aero: AeroTable, mach: FloatArray, flow_yz_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vector ``(n, 2)`` of a lateral flow angle ``(n, 2)``, rad, and the coefficients ``(n, 4)`` at its size."""
    direction, alpha = lateral_and_size(flow_yz_rad)
    return direction, aero.at(mach, np.minimum(alpha, np.pi))


def _around(swing: Swing) -> tuple[Swing, Swing]:
    """Deflection a step earlier and a step later, by its derivatives."""
    a = swing.acceleration_yz_radps2
    earlier, later = (
        Swing(swing.theta_yz_rad + s * swing.rate_yz_radps + 0.5 * s**2 * a, swing.rate_yz_radps + s * a, a)
        for s in (-_STEP_S, _STEP_S)
    )
    return earlier, later


def axes(swing: Swing) -> FloatArray:
    """Matrices ``(n, 3, 3)`` that turn shell components into the body's (`flightmodel.deflection`)."""
    return rotations.dcm_from_q(rotations.exp(rotation_vector_of_lateral(swing.theta_yz_rad)))


def relative_rate(swing: Swing) -> FloatArray:
    """Rate of the shell against the body, body axes (n, 3): the rotation vector's left Jacobian times its rate."""
    turning = left_jacobian(rotation_vector_of_lateral(swing.theta_yz_rad))
    return _turned(turning, rotation_vector_of_lateral(swing.rate_yz_radps))


def _cg_from_point(vehicle: Vehicle, point_m: FloatArray, swing: Swing) -> FloatArray:
    """Vehicle's c.g. from a point of the centerbody, (n, 3), m."""
    shell = vehicle.aeroshell
    moved = (axes(swing) - np.eye(3)) @ (shell.cg_m - vehicle.joint_m)
    return np.asarray(vehicle.cg_m - point_m + shell.mass_kg / vehicle.mass_kg * moved)


def _angular_momentum(vehicle: Vehicle, swing: Swing, w: FloatArray) -> FloatArray:
    """Angular momentum about the vehicle's c.g., body axes (n, 3)."""
    shell, body = vehicle.aeroshell, vehicle.centerbody
    turn, phi = axes(swing), relative_rate(swing)
    arm = turn @ (shell.cg_m - vehicle.joint_m)
    apart = vehicle.joint_m + arm - body.cg_m
    speed = np.cross(phi, arm) + np.cross(w, apart)
    reduced = shell.mass_kg * body.mass_kg / vehicle.mass_kg
    own = _turned(turn, _turned(turn.transpose(0, 2, 1), w + phi) @ shell.inertia.T)
    return np.asarray(w @ body.inertia.T + own + reduced * np.cross(apart, speed))


def _turned(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _moment(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Moment about the c.g. that the motion needs, body axes (n, 3), N m."""
    w, turning = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    earlier, later = (
        _angular_momentum(vehicle, at, w + s * turning)
        for at, s in zip(_around(swing), (-_STEP_S, _STEP_S), strict=True)
    )
    now = _angular_momentum(vehicle, swing, w)
    return np.asarray((later - earlier) / (2.0 * _STEP_S) + np.cross(w, now))


def specific_force(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Specific force at the moving c.g. of the deflected vehicle, body axes (n, 3), m/s^2."""
    w, turning = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    earlier, now, later = (
        _cg_from_point(vehicle, loads.point_from_datum_m, at) for at in (_around(swing)[0], swing, _around(swing)[1])
    )
    speed, acceleration = (later - earlier) / (2.0 * _STEP_S), (later - 2.0 * now + earlier) / _STEP_S**2
    carried = rotations.lever_arm_acceleration(w, turning, now)
    return np.asarray(loads.specific_force_body_mps2 + acceleration + 2.0 * np.cross(w, speed) + carried)


def nose_flow(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Lateral flow angle at the shell's nose, shell y, z (n, 2), rad."""
    direction, alpha = lateral_and_size(loads.flow_yz_rad)
    along = np.column_stack([np.cos(alpha), direction * np.sin(alpha)[:, None]])
    turn = axes(swing)
    arm = -turn @ vehicle.joint_m
    moving = np.cross(loads.rate_body_radps, vehicle.joint_m + arm - loads.point_from_datum_m)
    moving = moving + np.cross(relative_rate(swing), arm)
    velocity = loads.airspeed_mps[:, None] * along + moving
    return lateral_angles(_turned(turn.transpose(0, 2, 1), velocity))


@dataclass(frozen=True)
class Air:
    """Over ``q S``, shell axes: C_A (n,), lateral force, the moment's lateral flow, flow's direction (n, 3) each."""

    axial: FloatArray
    lateral: FloatArray
    tilting: FloatArray
    side: FloatArray
    cmq: FloatArray
    sine: FloatArray


def air(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> Air:
    """Coefficients of the table and `flightmodel.vehicle.AeroTerms`."""
    flow, terms = nose_flow(vehicle, swing, loads), vehicle.aero_terms
    direction, c = flow_coefficients(vehicle.aero, loads.mach, flow)
    side = np.column_stack([np.zeros(len(c)), direction])
    bent = axes(swing)[:, 0] * [0.0, 1.0, 1.0]
    clock = np.arctan2(direction[:, 1], direction[:, 0]) - terms.numbers[8]
    by_roll = (1.0 + terms.roll_share * np.cos(terms.roll_order * clock))[:, None]
    return Air(
        c[:, 0] + terms.ca_deflection * np.sum(bent**2, axis=1),
        by_roll * c[:, 1:2] * side + terms.cn_deflection * bent,
        by_roll * c[:, 2:3] * side + terms.cm_deflection * bent,
        side,
        c[:, 3],
        np.sin(np.linalg.norm(flow, axis=1)),
    )


def force_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Readable twin of `estimators.balance.force_residual`."""
    force = _turned(axes(swing).transpose(0, 2, 1), specific_force(vehicle, swing, loads))
    of_air = air(vehicle, swing, loads)
    along = of_air.lateral + of_air.axial[:, None] * _X
    return np.asarray(lateral_angles(-force) - lateral_angles(along))


def axial_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Logarithm of the force along the shell's axis over the air's ``q S C_A`` (n, 1).

    Parameters as of `force_residual`.
    """
    force = _turned(axes(swing).transpose(0, 2, 1), specific_force(vehicle, swing, loads))
    wanted = loads.dynamic_pressure_pa * vehicle.reference.area_m2 * air(vehicle, swing, loads).axial
    with np.errstate(invalid="ignore"):  # of a force that points forward
        return np.asarray(np.log(-vehicle.mass_kg * force[:, 0] / wanted)[:, None])


def moment_residual(vehicle: Vehicle, swing: Swing, loads: FlightLoads) -> FloatArray:
    """Transverse moment of the air less the motion's over ``q S C_A``, a shift of the c.g.; body y, z (n, 2), m.

    Parameters as of `force_residual`.
    """
    turn, length = axes(swing), vehicle.reference.length_m
    at = air(vehicle, swing, loads)
    rate = _turned(turn.transpose(0, 2, 1), loads.rate_body_radps + relative_rate(swing)) * [0.0, 1.0, 1.0]
    force = -(at.axial[:, None] * _X + at.lateral)
    coning = np.sum(rate * at.side, axis=1, keepdims=True) * at.side
    less = vehicle.aero_terms.cnr_less_cmq * at.sine[:, None] ** 2
    damping = length / (2.0 * loads.airspeed_mps[:, None]) * (at.cmq[:, None] * rate + less * coning)
    about_nose = length * (np.cross(at.tilting, _X) + damping)
    force, about_nose = _turned(turn, force), _turned(turn, about_nose)
    nose = vehicle.joint_m - turn @ vehicle.joint_m
    cg = loads.point_from_datum_m + _cg_from_point(vehicle, loads.point_from_datum_m, swing)
    of_air = about_nose + np.cross(nose - cg, force)
    q_area = loads.dynamic_pressure_pa[:, None] * vehicle.reference.area_m2
    left = (of_air - _moment(vehicle, swing, loads) / q_area) / at.axial[:, None]
    # a lateral shift d of the c.g. against the axial force has the moment d x x_hat = (0, d_z, -d_y)
    return np.column_stack([-left[:, 2], left[:, 1]])

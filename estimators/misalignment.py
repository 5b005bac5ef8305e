"""What deflection reconciles the accelerometers with the trajectory? (Seed paper eqs. [1] to [4].)

The aerodynamic force acts on the shell alone, so the ratio of normal to axial acceleration is C_N/C_A at the *shell's*
angle of attack, while the trajectory gives the *centerbody's*. A deflection ``theta`` rotates the measured force::

    tilt of the force = atan(C_N/C_A (alpha_shell)) alpha_hat_shell + theta,      alpha_shell = alpha_BET - theta

with lateral vectors in body y, z; the tilt is ``atan(a_N / -a_x)`` against the lateral acceleration. C_N/C_A of a
blunt cone grows by about 0.1 deg per degree, so the equation is a contraction and is solved by iteration. In one plane
it is the paper's: the 1-2-1 rotation of eq. [4] makes the aerodynamic angle equal to the deflected BET angle.

That is the start of the solution. The answer balances the force without small angles, at the c.g. of the deflected
vehicle, with centrifugal and Coriolis terms (`estimators.balance.force_residual`).

Assumed: no aerodynamic force on the centerbody, no twist.
"""

from __future__ import annotations

import numpy as np

from estimators.balance import Swing, force_residual
from estimators.evidence import Deflection, Evidence, evidence_of_balance, held_balance, history_of_evidence
from estimators.loads import MIN_AXIAL_MPS2, FlightLoads, lateral_and_size
from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2

_AVERAGED_S = 0.1  # at most: a quarter of a joint's period of 0.4 s
# each step contracts by d atan(C_N/C_A)/d alpha, at most 0.15: twelve leave 1e-10
_ITERATIONS = 12
_ASSUMPTIONS = (
    "plane estimated; all aerodynamic force on the aeroshell; C_N/C_A of the pre-flight model; no twist; no answer "
    f"where the axial deceleration is below {MIN_AXIAL_MPS2 / STANDARD_GRAVITY_MPS2:.1f} g"
)


def psi_from_acceleration(acceleration_body_mps2: FloatArray) -> FloatArray:
    """Clocking of eq. [4]'s rotation plane along the normal acceleration, rad.

    With the matrices as printed it must be ``atan2(-a_y, a_z)``; the paper's text says ``atan2(a_y, a_z)``, which
    leaves the normal acceleration out of the rotation's plane.
    """
    return np.arctan2(-acceleration_body_mps2[..., 1], acceleration_body_mps2[..., 2])


def aeroshell_acceleration(
    acceleration_body_mps2: FloatArray, theta_rad: FloatArray, psi_rad: FloatArray
) -> FloatArray:
    """Centerbody accelerations ``(..., 3)`` in aeroshell axes: the 1-2-1 Euler sequence of seed paper eq. [4].

    With `psi_from_acceleration` a positive ``theta`` reduces the normal acceleration.
    """
    ax, ay, az = np.moveaxis(np.asarray(acceleration_body_mps2, dtype=float), -1, 0)
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    y1, z1 = c * ay + s * az, -s * ay + c * az
    ct, st = np.cos(theta_rad), np.sin(theta_rad)
    x2, z2 = ct * ax - st * z1, st * ax + ct * z1
    return np.stack([x2, c * y1 - s * z2, s * y1 + c * z2], axis=-1)


def aerodynamic_angle(aero: AeroTable, mach: FloatArray, acceleration_mps2: FloatArray) -> FloatArray:
    """Total angle of attack, rad, whose C_N/C_A equals ``a_N / -a_x`` (eq. [3]); NaN outside the look-up."""
    ratio = np.hypot(acceleration_mps2[..., 1], acceleration_mps2[..., 2]) / -acceleration_mps2[..., 0]
    return aero.alpha_from_ratio(mach, np.where(acceleration_mps2[..., 0] < 0.0, ratio, -1.0))


def force_tilt(specific_force_body_mps2: FloatArray) -> FloatArray:
    """Tilt of the force against the centerbody's axis as a lateral vector ``(n, 2)``, rad."""
    opposite, size = lateral_and_size(-specific_force_body_mps2[:, 1:])
    return opposite * np.arctan2(size, -specific_force_body_mps2[:, 0])[:, None]


def solve_deflection(aero: AeroTable, mach: FloatArray, tilt_yz: FloatArray, flow_yz: FloatArray) -> FloatArray:
    """Deflection vectors ``(n, 2)``, rad, that reconcile the force's tilt with the trajectory's flow angle."""
    theta = tilt_yz.copy()
    for _ in range(_ITERATIONS):
        direction, alpha = lateral_and_size(flow_yz - theta)
        theta = tilt_yz - direction * np.arctan(aero.ratio(mach, np.minimum(alpha, np.pi)))[:, None]
    return theta


def _own_swing(loads: FlightLoads) -> Swing:
    """Deflection that balances every sample by itself, as if the joint were at rest."""
    vehicle = loads.vehicle
    start = solve_deflection(vehicle.aero, loads.mach, force_tilt(loads.specific_force_body_mps2), loads.flow_yz_rad)
    return held_balance(force_residual, loads, start)


def misalignment_evidence(loads: FlightLoads, about: Deflection | None = None, with_inputs: bool = True) -> Evidence:
    """Deflection at every sample, with its responses to uncertain inputs and to the joint's motion.

    Parameters
    ----------
    loads : FlightLoads
        Of the samples to read, all with enough deceleration.
    about : callable, optional
        Deflection about which the reading is linear; None: the reading itself.
    with_inputs : bool
        False leaves the responses to inputs and the noise out.
    """
    swing = _own_swing(loads) if about is None else Swing.of(about, loads.time_s)
    averaged_s = min(_AVERAGED_S, loads.quarter_swing_s)
    return evidence_of_balance("misalignment", force_residual, loads, swing, averaged_s, with_inputs)


def estimate_misalignment(loads: FlightLoads) -> DeflectionHistory:
    """Deflection and plane at every sample where the deceleration carries information; NaN elsewhere.

    The covariance propagates the errors of the accelerometer, of the BET's flow angle with the wind's, of the
    coefficients and mass properties, and bounds the joint's oscillation by the answer's own derivatives.
    """
    return history_of_evidence(misalignment_evidence(loads.rows(loads.informative)), loads, _ASSUMPTIONS)

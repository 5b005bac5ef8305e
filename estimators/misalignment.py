"""What deflection reconciles the accelerometers with the trajectory? (Seed paper eqs. [1] to [4].)

The aerodynamic force acts on the shell alone, so the ratio of normal to axial acceleration is C_N/C_A at the *shell's*
angle of attack, while the trajectory gives the *centerbody's*. A deflection ``theta`` rotates the measured force::

    tilt of the force = atan(C_N/C_A (alpha_shell)) alpha_hat_shell + theta,      alpha_shell = alpha_BET - theta

with lateral vectors in body y, z; the tilt is ``atan(a_N / -a_x)`` against the lateral acceleration. C_N/C_A of a
blunt cone grows by about 0.1 deg per degree, so the equation is a contraction and is solved by iteration. In one plane
it is the paper's: the 1-2-1 rotation of eq. [4] makes the aerodynamic angle equal to the deflected BET angle.

Assumed: no aerodynamic force on the centerbody, no twist, the c.g. of the undeflected vehicle (its motion with the
oscillating joint is bounded in the error bar).
"""

from __future__ import annotations

import numpy as np

from estimators.evidence import (
    ACCELEROMETER,
    ACCELEROMETER_TIME_BIAS,
    GYRO_TIME_BIAS,
    Evidence,
    delayed,
    flow_inputs,
    history_of_evidence,
    moved_coefficients,
)
from estimators.loads import MIN_AXIAL_MPS2, FlightLoads, flow_coefficients, lateral_and_size
from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2

_AVERAGED_S = 0.1  # short against the period of the joint, 0.4 s
# each step contracts by d atan(C_N/C_A)/d alpha, at most 0.15: twelve leave 1e-10
_ITERATIONS, _STEP_RAD = 12, 1e-4
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


def _predicted_tilt(theta_yz: FloatArray, direction: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Tilt of the force (n, 2), rad, for a deflection (n, 2), the shell's flow direction and coefficients."""
    return theta_yz + direction * np.arctan(coefficients[:, 1] / coefficients[:, 0])[:, None]


def misalignment_evidence(
    loads: FlightLoads, use: BoolArray | None = None, about_yz_rad: FloatArray | None = None, with_inputs: bool = True
) -> Evidence:
    """Deflection at every sample where the deceleration carries information, with its responses to uncertain inputs.

    An oscillating joint accelerates the shell's c.g., so the tilt of the measured force is that of the aerodynamic
    force less ``m_A r_A theta'' / (m a_x)``.

    Parameters
    ----------
    loads : FlightLoads
    use : (n,) bool, optional
        Samples to read; None: `FlightLoads.informative`.
    about_yz_rad : (k, 2) float, optional
        Deflection about which the reading is linear; None: the reading itself.
    with_inputs : bool
        False leaves the responses to inputs out.
    """
    use = loads.informative if use is None else use
    force, flow, mach = loads.specific_force_body_mps2[use], loads.flow_yz_rad[use], loads.mach[use]
    vehicle = loads.vehicle
    tilt = force_tilt(force)
    about = solve_deflection(vehicle.aero, mach, tilt, flow) if about_yz_rad is None else about_yz_rad

    def predicted(d_theta: FloatArray, d_flow: FloatArray) -> FloatArray:
        return _predicted_tilt(about + d_theta, *flow_coefficients(vehicle.aero, mach, flow + d_flow - about - d_theta))

    step, none = _STEP_RAD * np.eye(2), np.zeros(2)
    direction, coefficients = flow_coefficients(vehicle.aero, mach, flow + none - about - none)
    base = _predicted_tilt(about + none, direction, coefficients)
    by_tilt = np.linalg.inv(_columns(base, [predicted(e, none) for e in step]) / _STEP_RAD)
    by_force = by_tilt @ (_columns(tilt, [force_tilt(force + _STEP_RAD * e) for e in np.eye(3)]) / _STEP_RAD)
    inputs: dict[str, FloatArray] = {}
    if with_inputs:
        by_flow = -by_tilt @ _columns(base, [predicted(none, e) for e in step]) / _STEP_RAD
        inputs = {name: by_flow @ part for name, part in flow_inputs(loads, use).items()}
        inputs[ACCELEROMETER] = inputs[ACCELEROMETER] + by_force @ loads.force_root_mps2[use]
        biases = {
            ACCELEROMETER_TIME_BIAS: (loads.accelerometer_time_bias_sd_s, 0.0),
            GYRO_TIME_BIAS: (0.0, loads.gyro_time_bias_sd_s),
        }
        for name, late_s in biases.items():
            if any(late_s):
                later = delayed(loads, use, *late_s)
                by_bias = by_force @ (later.specific_force_body_mps2[use] - force)[:, :, None]
                inputs[name] = by_bias + by_flow @ (later.flow_yz_rad[use] - flow)[:, :, None]
        for name in ("C_A", "C_N"):
            moved = (moved_coefficients(vehicle, {name: k}, coefficients) for k in (1.0, -1.0))
            up, down = (_predicted_tilt(about + none, direction, c) for c in moved)
            inputs[name] = -by_tilt @ (0.5 * (up - down))[:, :, None]
    arm = (vehicle.joint_m[0] - vehicle.aeroshell.cg_m[0]) * vehicle.aeroshell.mass_kg / vehicle.mass_kg
    by_acceleration = -arm / -force[:, 0, None, None] * by_tilt
    noise = loads.force_noise_sd_mps2**2 * by_force @ by_force.transpose(0, 2, 1)
    read = about + (by_tilt @ (tilt - base)[:, :, None])[:, :, 0]
    return Evidence("misalignment", loads.time_s[use], read, by_acceleration, inputs, noise, _AVERAGED_S)


def estimate_misalignment(loads: FlightLoads) -> DeflectionHistory:
    """Deflection and plane at every sample where the deceleration carries information; NaN elsewhere.

    The covariance propagates the errors of the accelerometer, of the BET's flow angle with the wind's, of C_N and C_A,
    and bounds the joint's oscillation by the rms of the answer's own second derivative.
    """
    return history_of_evidence(misalignment_evidence(loads), loads, _ASSUMPTIONS)


def _columns(base: FloatArray, moved: list[FloatArray]) -> FloatArray:
    return np.stack([m - base for m in moved], axis=-1)

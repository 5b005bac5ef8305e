"""How far is the shell bent, given what the accelerometers and the BET say? (Seed paper eqs. [1] to [4].)

Only the air pushes, and all of it on the shell, so the ratio of normal to axial acceleration is C_N/C_A of the
*shell's* angle of attack, while the BET knows the *centerbody's*. Bending turns the measured force by ``theta``::

    tilt of the force = atan(C_N/C_A (alpha_shell)) alpha_hat_shell + theta,      alpha_shell = alpha_BET - theta

with lateral vectors in body y, z; the tilt is ``atan(a_N / -a_x)`` against the lateral acceleration. C_N/C_A of a
blunt cone grows by about 0.1 deg per degree, so the equation is a contraction and is solved by iteration. In one plane
it is the paper's: the 1-2-1 rotation of eq. [4] brings the aerodynamic angle and the biased BET angle together.

Assumed: no aerodynamic force on the centerbody, no twist, the c.g. where the unbent vehicle has it (its motion with
the bending joint is bounded in the error bar).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from estimators.pulse import MIN_AXIAL_MPS2, PulseData, lateral_and_size
from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory, history_from_lateral

# each step contracts by d atan(C_N/C_A)/d alpha, at most 0.15: twelve leave 1e-10
ITERATIONS = 12
# about one period of the slow aerodynamic mode, over which the joint's motion is averaged for its bound
JOINT_WINDOW_S = 2.0
ASSUMPTIONS = (
    "plane free; all aerodynamic force on the aeroshell; C_N/C_A of the pre-flight model; no twist; no answer where "
    f"the axial deceleration is below {MIN_AXIAL_MPS2 / 9.80665:.1f} g"
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
    """Deflection vectors ``(n, 2)``, rad, that reconcile the force's tilt with the BET's flow angle."""
    theta = tilt_yz.copy()
    for _ in range(ITERATIONS):
        direction, alpha = lateral_and_size(flow_yz - theta)
        theta = tilt_yz - direction * np.arctan(aero.ratio(mach, np.minimum(alpha, np.pi)))[:, None]
    return theta


def estimate_misalignment(pulse: PulseData) -> DeflectionHistory:
    """Bending and plane at every sample where the deceleration carries information; NaN elsewhere.

    The covariance propagates, by differences, the force's systematic error, the BET's flow angle with the wind's
    error, and the coefficients' (C_N and C_A apart), and bounds the motion of the c.g. with the bending joint by the
    scatter of the answer's own curvature.
    """
    use = pulse.informative
    n = int(use.sum())
    theta_yz, cov = np.full((len(use), 2), np.nan), np.full((len(use), 2, 2), np.nan)
    if n:
        force, flow, mach = pulse.specific_force_body_mps2[use], pulse.flow_yz_rad[use], pulse.mach[use]
        aero, known = pulse.vehicle.aero, pulse.vehicle.uncertainty
        tilt = force_tilt(force)
        theta = solve_deflection(aero, mach, tilt, flow)
        step = 1e-4
        by_tilt = _columns(theta, [solve_deflection(aero, mach, tilt + step * e, flow) for e in np.eye(2)]) / step
        by_flow = _columns(theta, [solve_deflection(aero, mach, tilt, flow + step * e) for e in np.eye(2)]) / step
        by_force = _columns(tilt, [force_tilt(force + step * e) for e in np.eye(3)]) / step
        to_theta = by_tilt @ by_force
        ratio_sd = np.hypot(known.cn, known.ca)
        by_ratio = solve_deflection(aero.scaled(cn=1.0 + ratio_sd), mach, tilt, flow) - theta
        total = to_theta @ pulse.specific_force_cov[use] @ to_theta.transpose(0, 2, 1)
        total += by_flow @ pulse.flow_cov[use] @ by_flow.transpose(0, 2, 1)
        total += by_ratio[:, :, None] * by_ratio[:, None, :]
        total += (_joint_motion(pulse, theta, use) ** 2)[:, None, None] * np.eye(2)
        theta_yz[use], cov[use] = theta, total
    return history_from_lateral(pulse.time_s, theta_yz, cov, "misalignment", ASSUMPTIONS)


def _columns(base: FloatArray, moved: list[FloatArray]) -> FloatArray:
    return np.stack([m - base for m in moved], axis=-1)


def _joint_motion(pulse: PulseData, theta_yz: FloatArray, use: BoolArray) -> FloatArray:
    """Angle error, rad, from the shell's c.g. accelerating as the joint bends: ``m_A r_A theta'' / (m a_x)``."""
    vehicle = pulse.vehicle
    arm = abs(vehicle.aeroshell.cg_m[0] - vehicle.joint_m[0]) * vehicle.aeroshell.mass_kg / vehicle.mass_kg
    if len(theta_yz) < 5:
        return np.zeros(len(theta_yz))
    t = pulse.time_s[use]
    second = np.gradient(np.gradient(theta_yz, t, axis=0), t, axis=0)
    window = max(1, round(JOINT_WINDOW_S / float(np.median(np.diff(t)))))
    rms = np.sqrt(uniform_filter1d(np.sum(second**2, axis=1), window, mode="nearest"))
    return arm * rms / -pulse.specific_force_body_mps2[use, 0]

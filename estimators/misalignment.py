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

from estimators.evidence import (
    ACCELEROMETER,
    FORCE_CLOCK,
    RATE_CLOCK,
    Evidence,
    flow_inputs,
    history_of_evidence,
    moved_coefficients,
    read_later,
)
from estimators.loads import MIN_AXIAL_MPS2, PulseData, lateral_and_size
from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2

# each step contracts by d atan(C_N/C_A)/d alpha, at most 0.15: twelve leave 1e-10
AVERAGED_S = 0.1  # short against the joint's 2.5 Hz
ITERATIONS, STEP_RAD = 12, 1e-4
ASSUMPTIONS = (
    "plane free; all aerodynamic force on the aeroshell; C_N/C_A of the pre-flight model; no twist; no answer where "
    f"the axial deceleration is below {MIN_AXIAL_MPS2 / STANDARD_GRAVITY_MPS2:.1f} g"
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


def deflection_along_acceleration(
    aero: AeroTable, mach: FloatArray, acceleration_body_mps2: FloatArray, alpha_rad: FloatArray
) -> FloatArray:
    """Bending (n,), rad, by the paper's form: all in the plane of the normal acceleration.

    The 1-2-1 rotation of eq. [4] with ``psi`` along the normal acceleration takes ``theta`` off the force's tilt, so
    that the aerodynamic angle of eq. [3] and the BET's total angle ``alpha_rad`` (n,) less ``theta`` agree where
    ``theta = atan(a_N / -a_x) - atan(C_N/C_A (alpha - theta))``. The plane is opposite the normal acceleration.
    NaN where the vehicle is not decelerated.
    """
    ax, normal = acceleration_body_mps2[:, 0], np.hypot(acceleration_body_mps2[:, 1], acceleration_body_mps2[:, 2])
    tilt = np.arctan2(normal, -ax)
    theta = tilt
    for _ in range(ITERATIONS):
        shell = alpha_rad - theta
        theta = tilt - np.sign(shell) * np.arctan(aero.ratio(mach, np.minimum(np.abs(shell), np.pi)))
    return np.where(ax < 0.0, theta, np.nan)


def _pushed_tilt(theta_yz: FloatArray, direction: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Tilt of the force (n, 2), rad, on a shell bent by ``theta_yz`` (n, 2) that meets its flow from a direction."""
    return theta_yz + direction * np.arctan(coefficients[:, 1] / coefficients[:, 0])[:, None]


def misalignment_evidence(
    pulse: PulseData, use: BoolArray | None = None, about_yz_rad: FloatArray | None = None, with_inputs: bool = True
) -> Evidence:
    """Bending at every sample where the deceleration carries information, with its responses to what is uncertain.

    A joint that swings throws the shell's c.g. about, so the tilt of the measured force is that of the push less
    ``m_A r_A theta'' / (m a_x)``. Responses are taken, and the reading is linear, about a given deflection, else about
    the reading itself. Those to inputs can be left out.
    """
    use = pulse.informative if use is None else use
    force, flow, mach = pulse.specific_force_body_mps2[use], pulse.flow_yz_rad[use], pulse.mach[use]
    vehicle = pulse.vehicle
    tilt = force_tilt(force)
    about = solve_deflection(vehicle.aero, mach, tilt, flow) if about_yz_rad is None else about_yz_rad

    def on_shell(d_theta: FloatArray, d_flow: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        direction, alpha = lateral_and_size(flow + d_flow - about - d_theta)
        return about + d_theta, direction, vehicle.aero.at(mach, np.minimum(alpha, np.pi))

    step, still = STEP_RAD * np.eye(2), np.zeros(2)
    theta, direction, coefficients = on_shell(still, still)
    base = _pushed_tilt(theta, direction, coefficients)
    by_tilt = np.linalg.inv(_columns(base, [_pushed_tilt(*on_shell(e, still)) for e in step]) / STEP_RAD)
    by_force = by_tilt @ (_columns(tilt, [force_tilt(force + STEP_RAD * e) for e in np.eye(3)]) / STEP_RAD)
    inputs: dict[str, FloatArray] = {}
    if with_inputs:
        by_flow = -by_tilt @ _columns(base, [_pushed_tilt(*on_shell(still, e)) for e in step]) / STEP_RAD
        inputs = {name: by_flow @ part for name, part in flow_inputs(pulse, use).items()}
        inputs[ACCELEROMETER] = inputs[ACCELEROMETER] + by_force @ pulse.force_root_mps2[use]
        for name, late_s in ((FORCE_CLOCK, (pulse.force_clock_sd_s, 0.0)), (RATE_CLOCK, (0.0, pulse.rate_clock_sd_s))):
            if any(late_s):
                later = read_later(pulse, use, *late_s)
                by_clock = by_force @ (later.specific_force_body_mps2[use] - force)[:, :, None]
                inputs[name] = by_clock + by_flow @ (later.flow_yz_rad[use] - flow)[:, :, None]
        for name in ("C_A", "C_N"):
            moved = (moved_coefficients(vehicle, {name: k}, coefficients) for k in (1.0, -1.0))
            up, down = (_pushed_tilt(theta, direction, c) for c in moved)
            inputs[name] = -by_tilt @ (0.5 * (up - down))[:, :, None]
    arm = (vehicle.joint_m[0] - vehicle.aeroshell.cg_m[0]) * vehicle.aeroshell.mass_kg / vehicle.mass_kg
    swing = -arm / -force[:, 0, None, None] * by_tilt
    noise = pulse.force_noise_sd_mps2**2 * by_force @ by_force.transpose(0, 2, 1)
    read = about + (by_tilt @ (tilt - base)[:, :, None])[:, :, 0]
    return Evidence("misalignment", pulse.time_s[use], read, swing, inputs, noise, AVERAGED_S)


def estimate_misalignment(pulse: PulseData) -> DeflectionHistory:
    """Bending and plane at every sample where the deceleration carries information; NaN elsewhere.

    The covariance propagates the accelerometer's errors, the BET's flow angle with the wind's and C_N and C_A, and
    bounds the joint's swinging by the scatter of the answer's own curvature.
    """
    return history_of_evidence(misalignment_evidence(pulse), pulse, ASSUMPTIONS)


def _columns(base: FloatArray, moved: list[FloatArray]) -> FloatArray:
    return np.stack([m - base for m in moved], axis=-1)

"""The seed paper's scalar forms of misalignment and trim: the deflection in one assumed plane, eqs. [3] to [6]."""

import numpy as np

from estimators.trim import LIMIT_RAD

ITERATIONS = 12  # of a contraction by at most 0.15 a step: 1e-10 is left
KNOTS_RAD = np.linspace(0.0, LIMIT_RAD, 121)


def deflection_along_acceleration(aero, mach, acceleration_body_mps2, alpha_rad):
    """Deflection (n,), rad, all in the plane opposite the normal acceleration; NaN without deceleration.

    The 1-2-1 rotation of eq. [4] with ``psi`` along the normal acceleration takes ``theta`` off the force's tilt, so
    that the aerodynamic angle of eq. [3] and the BET's total angle ``alpha_rad`` (n,) less ``theta`` agree where
    ``theta = atan(a_N / -a_x) - atan(C_N/C_A (alpha - theta))``.
    """
    ax, normal = acceleration_body_mps2[:, 0], np.hypot(acceleration_body_mps2[:, 1], acceleration_body_mps2[:, 2])
    tilt = np.arctan2(normal, -ax)
    theta = tilt
    for _ in range(ITERATIONS):
        shell = alpha_rad - theta
        theta = tilt - np.sign(shell) * np.arctan(aero.ratio(mach, np.minimum(np.abs(shell), np.pi)))
    return np.where(ax < 0.0, theta, np.nan)


def deflection_for_trim_angle(model, mach, alpha_shell_rad):
    """Deflection, rad, that trims the shell at an angle, offset and deflection in one plane."""
    z = float(model.offset_for_angle(np.asarray(mach), np.asarray(alpha_shell_rad)))
    return (z - float(np.linalg.norm(model.offset_yz_m))) / model.xbar_m


def trim_angle_for_deflection(model, mach, theta_rad):
    """Trim angle of the shell, rad, for a deflection in the plane of the offset; NaN beyond 30 deg."""
    z = float(np.linalg.norm(model.offset_yz_m)) + model.xbar_m * theta_rad
    table = model.offset_for_angle(np.full(len(KNOTS_RAD), mach), KNOTS_RAD)
    return float(np.interp(z, table, KNOTS_RAD, left=np.nan, right=np.nan))

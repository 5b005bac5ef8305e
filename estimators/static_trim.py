"""At what angle does a vehicle with a yielding joint trim, and how stiff must the joint be? (Seed paper Figure 2.9.)

The decelerating shell pushes the centerbody from its front end, so that inertia is a negative spring. Small angles, one
plane, offset ``z_0`` carried by the centerbody::

    moment about the c.g.:    alpha = C_A (xbar theta + z_0) / (C_N,alpha L)
    centerbody about joint:   K theta = xbar q S (C_A theta + C_N,alpha alpha) + q S C_A z_0
    u = q kappa / K,   kappa = S C_A xbar (1 + xbar / L):
        alpha = alpha_rigid / (1 - u),   theta = (z_0 / xbar) u / (1 - u),   alpha_rigid = C_A z_0 / (C_N,alpha L)

``L`` is the distance from the c.g. aft to the metacentre, ``C_N,alpha L = -(C_m,alpha l + C_N,alpha x_cg)``. At
``u = 1`` the joint diverges: ``K_crit = q kappa``. For trim growth of at most ``g`` the joint must be stiffer than
``q_max kappa (1 + g) / g``. Freeplay of ``d`` acts as an offset of ``xbar d`` once the joint is loaded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.trim import trim_model
from flightmodel.checks import FloatArray, GateError
from flightmodel.vehicle import Vehicle

SLOPE_AT_RAD = np.deg2rad(2.0)  # coefficients' slopes by alpha are taken from there


@dataclass(frozen=True)
class StaticTrim:
    """Static flexible trim at one Mach number and dynamic pressure.

    Parameters
    ----------
    critical_stiffness_nmprad : float
        Where the joint diverges.
    rigid_gain_radpm : float
        Trim angle of the rigid vehicle per metre of offset.
    xbar_m : float
        Shift of the c.g. per radian of bending.
    """

    critical_stiffness_nmprad: float
    rigid_gain_radpm: float
    xbar_m: float

    def load(self, stiffness_nmprad: FloatArray) -> FloatArray:
        """``u``, the share of the joint's stiffness that the deceleration takes; NaN where it diverges."""
        u = self.critical_stiffness_nmprad / np.asarray(stiffness_nmprad, dtype=float)
        return np.where(u < 1.0, u, np.nan)

    def trim_angle(self, stiffness_nmprad: FloatArray, offset_m: float) -> FloatArray:
        """Total angle of attack of the shell, rad; NaN where the joint diverges."""
        return np.asarray(self.rigid_gain_radpm * offset_m / (1.0 - self.load(stiffness_nmprad)))

    def deflection(self, stiffness_nmprad: FloatArray, offset_m: float) -> FloatArray:
        """Bending, rad; NaN where the joint diverges."""
        u = self.load(stiffness_nmprad)
        return np.asarray(offset_m / self.xbar_m * u / (1.0 - u))

    def stiffness_for_growth(self, growth: float) -> float:
        """Stiffness, N m/rad, at which the trim angle is larger than the rigid vehicle's by this fraction.

        Raises
        ------
        GateError
            Where the growth is not positive: no finite stiffness does.
        """
        if not growth > 0.0:
            raise GateError(f"static trim: a growth of {growth:g} needs an infinitely stiff joint; give more than 0")
        return self.critical_stiffness_nmprad * (1.0 + growth) / growth

    def offset_with_freeplay(self, offset_m: float, freeplay_rad: float) -> float:
        """Offset, m, that a loaded joint with freeplay acts with."""
        return offset_m + self.xbar_m * freeplay_rad


def static_trim(vehicle: Vehicle, mach: float, dynamic_pressure_pa: float) -> StaticTrim:
    """Static trim of a vehicle from its coefficients' slopes.

    Raises
    ------
    GateError
        Where the shell is statically unstable: it has no trim.
    """
    model = trim_model(vehicle)
    axial, _, _, _ = vehicle.aero.at(mach, 0.0)
    _, normal, moment, _ = vehicle.aero.at(mach, SLOPE_AT_RAD) / SLOPE_AT_RAD
    restoring = -(moment * model.length_m + normal * model.x_cg_m)
    if not restoring > 0.0:
        raise GateError(f"static trim: the shell is unstable at Mach {mach:g}: it has no trim angle")
    kappa = model.area_m2 * axial * model.xbar_m * (1.0 + normal * model.xbar_m / restoring)
    return StaticTrim(float(dynamic_pressure_pa * kappa), float(axial / restoring), model.xbar_m)

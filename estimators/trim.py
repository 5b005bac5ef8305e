"""What deflection makes the vehicle trim at the angle it flew, and how does a compliant joint trim?

Seed paper eqs. [5], [6] and Figure 2.9.

A deflection shifts the centerbody's c.g. sideways, and the shell trims where the moment about the c.g. vanishes::

    z_cg = z_0 + xbar theta,      xbar = x m_cb / m                                    eq. [5]
    C_A z_cg = -(C_m l + C_N x_cg)(alpha_shell) alpha_hat_shell + u                    eq. [6]

as lateral vectors in body y, z, along the flow's side (so ``z_cg`` is positive towards the flow: the paper's sign
reversed). ``u`` is the measured moment ``I w' + w x I w`` less pitch damping, over ``q S``: zero in the paper's static
form; with it the balance holds through an oscillation. With ``alpha_shell = alpha_BET - theta`` the vectors of
``alpha_shell`` and of ``z_0 + xbar alpha_BET - u/C_A`` are parallel, so one monotone equation in the angle's size
remains (`solve_trim`). That is the start of the solution: the answer balances the moments without small angles, of both
bodies' motion, with pitch damping at the shell's own angle and rate (`estimators.balance.moment_residual`).

Static flexible trim (`static_trim`): the decelerating shell decelerates the centerbody at its front end, so that the
inertial reaction is a negative spring. Small angles, one plane, offset ``z_0`` of the centerbody's c.g.::

    moment about the c.g.:    alpha = C_A (xbar theta + z_0) / (C_N,alpha L)
    centerbody about joint:   K theta = xbar q S (C_A theta + C_N,alpha alpha) + q S C_A z_0
    u = q kappa / K,   kappa = S C_A xbar (1 + xbar / L):
        alpha = alpha_rigid / (1 - u),   theta = (z_0 / xbar) u / (1 - u),   alpha_rigid = C_A z_0 / (C_N,alpha L)

``L`` is the distance from the c.g. aft to the metacentre, ``C_N,alpha L = -(C_m,alpha l + C_N,alpha x_cg)``. At
``u = 1`` the joint diverges: ``K_crit = q kappa``. For trim growth of at most ``g`` the joint must be stiffer than
``q_max kappa (1 + g) / g``. Freeplay of ``d`` acts as an offset of ``xbar d`` once the joint is loaded.

Assumed: pre-flight coefficients and offset, no aerodynamic moment on the centerbody.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimators.balance import Swing, moment_residual
from estimators.evidence import (
    Deflection,
    Evidence,
    evidence_of_balance,
    held_balance,
    history_of_evidence,
    moved_vehicle,
)
from estimators.loads import MIN_AXIAL_MPS2, SLOPE_AT_RAD, FlightLoads, lateral_and_size
from estimators.misalignment import misalignment_evidence
from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import DeflectionHistory
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.vehicle import Vehicle

LIMIT_RAD = np.deg2rad(30.0)  # far beyond the trim of an entry that keeps its heat shield forward
# near 2.3 Hz the shell's inertia balances the aerodynamic stiffness: no information on the deflection
_AVERAGED_S = 1.0
_ITERATIONS, _STEP_RAD = 5, 1e-4
_NODE = np.sqrt(3.0)  # outer nodes of the three-point Gauss-Hermite rule, sd
_ASSUMPTIONS = (
    "moment balance about the c.g. with measured angular acceleration; pre-flight coefficients and c.g. offset; joint "
    f"as in the vehicle file; no answer below {MIN_AXIAL_MPS2 / STANDARD_GRAVITY_MPS2:.1f} g axial"
)


@dataclass(frozen=True)
class TrimModel:
    """Parameters of a vehicle in eqs. [5] and [6].

    Parameters
    ----------
    aero : AeroTable
    x_cg_m : float
        C.g. aft of the nose.
    xbar_m : float
        ``x m_cb / m``: sideways shift of the vehicle's c.g. per radian of deflection.
    offset_yz_m : (2,) float
        Initial lateral c.g. offset.
    length_m, area_m2 : float
        Reference length and area.
    inertia_kgm2 : (3, 3) float
        Of the undeflected vehicle about its c.g.
    """

    aero: AeroTable
    x_cg_m: float
    xbar_m: float
    offset_yz_m: FloatArray
    length_m: float
    area_m2: float
    inertia_kgm2: FloatArray

    def offset_for_angle(self, mach: FloatArray, alpha_rad: FloatArray) -> FloatArray:
        """Lateral c.g. offset, m, at which the shell trims at an angle (eq. [6] with no moment)."""
        return self.trimmed_offset(self.aero.at(mach, alpha_rad))

    def trimmed_offset(self, coefficients: FloatArray) -> FloatArray:
        """Lateral c.g. offset, m, at which the shell trims with these coefficients ``(..., 4)``."""
        c = coefficients
        return -(c[..., 2] * self.length_m + c[..., 1] * self.x_cg_m) / c[..., 0]


def trim_model(vehicle: Vehicle) -> TrimModel:
    """Model of a vehicle."""
    arm = -vehicle.centerbody.cg_m[0] - vehicle.joint.station_m
    return TrimModel(
        aero=vehicle.aero,
        x_cg_m=float(-vehicle.cg_m[0]),
        xbar_m=float(arm * vehicle.centerbody.mass_kg / vehicle.mass_kg),
        offset_yz_m=vehicle.cg_m[1:],
        length_m=vehicle.reference.length_m,
        area_m2=vehicle.reference.area_m2,
        inertia_kgm2=vehicle.inertia,
    )


def solve_trim(model: TrimModel, mach: FloatArray, flow_yz_rad: FloatArray, moment_yz_m: FloatArray) -> FloatArray:
    """Deflection vectors ``(n, 2)``, rad, from the centerbody's flow angle; NaN where the shell's passes 30 deg.

    ``moment_yz_m`` (n, 2) is ``u / C_A`` of the module's equation.
    """
    direction, size = lateral_and_size(model.offset_yz_m + model.xbar_m * flow_yz_rad - moment_yz_m)

    def excess(alpha_rad: FloatArray) -> FloatArray:
        return np.asarray(model.offset_for_angle(mach, alpha_rad) + model.xbar_m * alpha_rad - size)

    # nearly straight and rising: Newton's steps settle at once
    alpha = np.zeros(len(size))
    for _ in range(_ITERATIONS):
        here = excess(alpha)
        slope = (excess(alpha + _STEP_RAD) - here) / _STEP_RAD
        alpha = np.clip(alpha - here / slope, 0.0, LIMIT_RAD)
    alpha = np.where(excess(np.full(len(size), LIMIT_RAD)) < 0.0, np.nan, alpha)
    return flow_yz_rad - direction * alpha[:, None]


def moment_term(model: TrimModel, loads: FlightLoads) -> FloatArray:
    """``u / C_A`` as lateral vectors ``(n, 2)``, m, of the undeflected vehicle's motion."""
    alpha = np.minimum(loads.alpha_total_wind_rad, np.pi)
    coefficients = model.aero.at(loads.mach, alpha)
    w, turn = loads.rate_body_radps, loads.angular_acceleration_body_radps2
    moment = turn @ model.inertia_kgm2.T + np.cross(w, w @ model.inertia_kgm2.T)
    q_area = loads.dynamic_pressure_pa * model.area_m2
    damping = (q_area * model.length_m**2 * coefficients[:, 3] / (2.0 * loads.airspeed_mps))[:, None] * w
    transverse = (moment - damping)[:, 1:]
    # a lateral vector u has u x x_hat = (0, u_z, -u_y)
    return np.column_stack([-transverse[:, 1], transverse[:, 0]]) / (q_area * coefficients[:, 0])[:, None]


def _own_swing(loads: FlightLoads) -> Swing:
    """Deflection that balances every sample by itself, as if the joint were at rest; NaN where there is none."""
    model = trim_model(loads.vehicle)
    start = solve_trim(model, loads.mach, loads.flow_yz_rad, moment_term(model, loads))
    return held_balance(moment_residual, loads, start)


def trim_evidence(loads: FlightLoads, about: Deflection | None = None, with_inputs: bool = True) -> Evidence:
    """Deflection from the moment balance at every sample, with its responses to inputs and to the joint's motion.

    Parameters as of `estimators.misalignment.misalignment_evidence`.
    """
    swing = _own_swing(loads) if about is None else Swing.of(about, loads.time_s)
    return evidence_of_balance("trim", moment_residual, loads, swing, _AVERAGED_S, with_inputs)


def trim_curvature(loads: FlightLoads) -> FloatArray:
    """Half the second derivative of the reading by C_m (n, 2), rad: the one input uncertain enough for it to matter."""
    read = [
        _own_swing(replace(loads, vehicle=moved_vehicle(loads.vehicle, {"C_m": size}))).theta_yz_rad
        for size in (_NODE, 0.0, -_NODE)
    ]
    return np.asarray((read[0] + read[2] - 2.0 * read[1]) / (2.0 * _NODE**2))


def estimate_trim(loads: FlightLoads) -> DeflectionHistory:
    """Deflection and plane from the moment balance at every sample with enough deceleration; NaN elsewhere.

    The covariance propagates the BET's flow angle with the wind's, the initial offset, masses, c.g. stations, inertias,
    C_m, C_N and C_A, dynamic pressure and the angular acceleration, and bounds the joint's oscillation by what the
    accelerometer shows of it: of a swing with ``A w^2`` near one the moment balance shows nothing.
    """
    rows = loads.rows(loads.informative)
    evidence = replace(trim_evidence(rows), half_curvature_rad=trim_curvature(rows))
    noise = loads.force_noise_sd_mps2 / rows.specific_force_body_mps2[:, 0]
    seen = replace(
        misalignment_evidence(rows, with_inputs=False), independent_cov=np.multiply.outer(noise**2, np.eye(2))
    )
    return history_of_evidence(evidence, loads, _ASSUMPTIONS, seen)


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
        Shift of the c.g. per radian of deflection.
    """

    critical_stiffness_nmprad: float
    rigid_gain_radpm: float
    xbar_m: float

    def load(self, stiffness_nmprad: FloatArray) -> FloatArray:
        """``u``, the share of the joint's stiffness that the deceleration offsets; NaN where it diverges."""
        u = self.critical_stiffness_nmprad / np.asarray(stiffness_nmprad, dtype=float)
        return np.where(u < 1.0, u, np.nan)

    def trim_angle(self, stiffness_nmprad: FloatArray, offset_m: float) -> FloatArray:
        """Total angle of attack of the shell, rad; NaN where the joint diverges."""
        return np.asarray(self.rigid_gain_radpm * offset_m / (1.0 - self.load(stiffness_nmprad)))

    def deflection(self, stiffness_nmprad: FloatArray, offset_m: float) -> FloatArray:
        """Deflection, rad; NaN where the joint diverges."""
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
            raise GateError(
                f"static trim: a growth of {growth:g} needs an infinitely stiff joint; give more than 0",
                code="value-range",
            )
        return self.critical_stiffness_nmprad * (1.0 + growth) / growth


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
        raise GateError(
            f"static trim: the shell is statically unstable at Mach {mach:g}: it has no trim angle",
            code="statically-unstable",
        )
    kappa = model.area_m2 * axial * model.xbar_m * (1.0 + normal * model.xbar_m / restoring)
    return StaticTrim(float(dynamic_pressure_pa * kappa), float(axial / restoring), model.xbar_m)

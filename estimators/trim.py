"""How far must the shell be bent for the vehicle to trim at the angle it flew? (Seed paper eqs. [5] and [6].)

Bending shifts the centerbody's c.g. sideways, and the shell trims where the moment about the c.g. vanishes::

    z_cg = z_0 + xbar theta,      xbar = x m_cb / m                                    eq. [5]
    C_A z_cg = -(C_m l + C_N x_cg)(alpha_shell) alpha_hat_shell + u                    eq. [6]

as lateral vectors in body y, z, along the flow's side (so ``z_cg`` is positive towards the flow: the paper's sign
turned). ``u`` is the measured moment ``I w' + w x I w`` less pitch damping, over ``q S``: zero in the paper's static
form; it lets the balance hold through an oscillation. With ``alpha_shell = alpha_BET - theta`` the vectors of
``alpha_shell`` and of ``z_0 + xbar alpha_BET - u/C_A`` are parallel, so one monotone equation in the angle's size
remains.

Assumed: pre-flight coefficients and offset, no aerodynamic moment on the centerbody, inertia of the unbent vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimators.pulse import MIN_AXIAL_MPS2, PulseData, lateral_and_size
from flightmodel.aerodynamics import AeroTable
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import DeflectionHistory, history_from_lateral
from flightmodel.vehicle import Vehicle

LIMIT_RAD = np.deg2rad(30.0)
KNOTS_RAD = np.linspace(0.0, LIMIT_RAD, 121)
ASSUMPTIONS = (
    "moment balance about the c.g. with measured angular acceleration; pre-flight coefficients and c.g. offset; joint "
    f"as in the vehicle file; no answer below {MIN_AXIAL_MPS2 / 9.80665:.1f} g axial"
)


@dataclass(frozen=True)
class TrimModel:
    """What eqs. [5] and [6] need of a vehicle.

    Parameters
    ----------
    aero : AeroTable
    x_cg_m : float
        C.g. aft of the nose.
    xbar_m : float
        ``x m_cb / m``: sideways shift of the vehicle's c.g. per radian of bending.
    offset_yz_m : (2,) float
        Initial lateral c.g. offset.
    length_m, area_m2 : float
        Reference length and area.
    inertia_kgm2 : (3, 3) float
        Of the unbent vehicle about its c.g.
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
        c = self.aero.at(mach, alpha_rad)
        return -(c[..., 2] * self.length_m + c[..., 1] * self.x_cg_m) / c[..., 0]


def trim_model(vehicle: Vehicle, joint_station_m: float | None = None) -> TrimModel:
    """Model of a vehicle; another joint station (the nose is 0) moves the point of rotation."""
    station = vehicle.joint.station_m if joint_station_m is None else joint_station_m
    arm = -vehicle.centerbody.cg_m[0] - station
    return TrimModel(
        aero=vehicle.aero,
        x_cg_m=float(-vehicle.cg_m[0]),
        xbar_m=float(arm * vehicle.centerbody.mass_kg / vehicle.mass_kg),
        offset_yz_m=vehicle.cg_m[1:],
        length_m=vehicle.reference.length_m,
        area_m2=vehicle.reference.area_m2,
        inertia_kgm2=vehicle.inertia,
    )


def deflection_for_trim_angle(model: TrimModel, mach: float, alpha_shell_rad: float) -> float:
    """Deflection, rad, that trims the shell at an angle, offset and deflection in one plane (the paper's use)."""
    z = float(model.offset_for_angle(np.asarray(mach), np.asarray(alpha_shell_rad)))
    return (z - float(np.linalg.norm(model.offset_yz_m))) / model.xbar_m


def trim_angle_for_deflection(model: TrimModel, mach: float, theta_rad: float) -> float:
    """Trim angle of the shell, rad, for a deflection in the plane of the offset; NaN beyond 30 deg."""
    z = float(np.linalg.norm(model.offset_yz_m)) + model.xbar_m * theta_rad
    table = model.offset_for_angle(np.full(len(KNOTS_RAD), mach), KNOTS_RAD)
    return float(np.interp(z, table, KNOTS_RAD, left=np.nan, right=np.nan))


def solve_trim(model: TrimModel, mach: FloatArray, flow_yz_rad: FloatArray, moment_yz_m: FloatArray) -> FloatArray:
    """Deflection vectors ``(n, 2)``, rad, from the centerbody's flow angle; NaN where the shell's passes 30 deg.

    ``moment_yz_m`` (n, 2) is ``u / C_A`` of the module's equation.
    """
    direction, size = lateral_and_size(model.offset_yz_m + model.xbar_m * flow_yz_rad - moment_yz_m)
    need = model.offset_for_angle(mach[:, None], KNOTS_RAD[None, :]) + model.xbar_m * KNOTS_RAD
    k = np.clip(np.sum(need <= size[:, None], axis=1) - 1, 0, len(KNOTS_RAD) - 2)
    row = np.arange(len(size))
    fraction = (size - need[row, k]) / (need[row, k + 1] - need[row, k])
    alpha = KNOTS_RAD[k] + fraction * (KNOTS_RAD[1] - KNOTS_RAD[0])
    alpha = np.where(size > need[:, -1], np.nan, alpha)
    return flow_yz_rad - direction * alpha[:, None]


def moment_term(model: TrimModel, pulse: PulseData, use: BoolArray, dynamic: bool) -> FloatArray:
    """``u / C_A`` as lateral vectors ``(n, 2)``, m; zero in the static form."""
    w, turn = pulse.rate_body_radps[use], pulse.angular_acceleration_body_radps2[use]
    if not dynamic:
        return np.zeros((len(w), 2))
    pressure, speed = pulse.dynamic_pressure_pa[use], pulse.airspeed_mps[use]
    alpha = np.minimum(np.linalg.norm(pulse.flow_yz_rad[use], axis=1), np.pi)
    c = model.aero.at(pulse.mach[use], alpha)
    moment = turn @ model.inertia_kgm2.T + np.cross(w, w @ model.inertia_kgm2.T)
    q_area = pressure * model.area_m2
    damping = (q_area * model.length_m**2 * c[:, 3] / (2.0 * speed))[:, None] * w
    transverse = (moment - damping)[:, 1:]
    # a lateral vector u has u x x_hat = (0, u_z, -u_y)
    return np.column_stack([-transverse[:, 1], transverse[:, 0]]) / (q_area * c[:, 0])[:, None]


def estimate_trim(pulse: PulseData, joint_station_m: float | None = None, dynamic: bool = True) -> DeflectionHistory:
    """Bending and plane from the moment balance at every sample with enough deceleration; NaN elsewhere.

    The covariance propagates, by differences, the BET's flow angle, the initial offset, mass, c.g. station, inertia,
    C_m, C_N and C_A, dynamic pressure and the angular acceleration.
    """
    use = pulse.informative
    theta_yz, cov = np.full((len(use), 2), np.nan), np.full((len(use), 2, 2), np.nan)
    if use.any():
        model = trim_model(pulse.vehicle, joint_station_m)
        mach, flow = pulse.mach[use], pulse.flow_yz_rad[use]
        moment = moment_term(model, pulse, use, dynamic)
        theta = solve_trim(model, mach, flow, moment)
        step = 1e-4
        by_flow = np.stack([solve_trim(model, mach, flow + step * e, moment) - theta for e in np.eye(2)], -1) / step
        total = by_flow @ pulse.flow_cov[use] @ by_flow.transpose(0, 2, 1)
        for changed, shift in _perturbations(model, pulse, use, moment, dynamic):
            d = solve_trim(changed, mach, flow, shift) - theta
            total += d[:, :, None] * d[:, None, :]
        theta_yz[use], cov[use] = theta, total
    return history_from_lateral(pulse.time_s, theta_yz, cov, "trim", ASSUMPTIONS)


def _perturbations(
    model: TrimModel, pulse: PulseData, use: BoolArray, moment: FloatArray, dynamic: bool
) -> list[tuple[TrimModel, FloatArray]]:
    """Model and moment term with one uncertain input each moved by its standard deviation."""
    known, vehicle = pulse.vehicle.uncertainty, pulse.vehicle
    moved = [(replace(model, offset_yz_m=model.offset_yz_m + known.cg_lateral_m * e), moment) for e in np.eye(2)]
    moved += [
        (replace(model, aero=model.aero.scaled(cm=1.0 + known.cm)), moment),
        (replace(model, aero=model.aero.scaled(cn=1.0 + known.cn)), moment),
        (replace(model, aero=model.aero.scaled(ca=1.0 + known.ca)), moment / (1.0 + known.ca)),
        (replace(model, x_cg_m=model.x_cg_m + known.cg_station_m), moment),
        # the centerbody's share of mass and its arm: what carries the offset
        (
            replace(model, xbar_m=model.xbar_m * (1.0 + np.hypot(known.mass, known.cg_station_m / abs(model.xbar_m)))),
            moment,
        ),
    ]
    if dynamic:
        relative = (pulse.dynamic_pressure_sd_pa / pulse.dynamic_pressure_pa)[use][:, None]
        moved += [(model, moment * (1.0 + relative)), (model, moment * (1.0 + known.inertia))]
        c_a = -pulse.specific_force_body_mps2[use, 0] * vehicle.mass_kg
        noise = pulse.angular_acceleration_sd_radps2 * vehicle.inertia[1, 1] / c_a
        moved += [(model, moment + noise[:, None] * e) for e in np.eye(2)]
    return moved

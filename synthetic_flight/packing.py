"""How a vehicle and the air are laid out for the compiled flight kernels."""

from __future__ import annotations

import numpy as np

from flightmodel import rotations
from flightmodel.atmosphere import AtmosphereProfile
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from synthetic_flight import _kernels

ATMOSPHERE_START_M, ATMOSPHERE_STEP_M, ATMOSPHERE_ROWS = -1000.0, 50.0, 8001


def parameter_vector(vehicle: Vehicle) -> FloatArray:
    """Pack a vehicle for the kernels."""
    p = np.zeros(_kernels.PARAMETERS)
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    p[_kernels.M_B], p[_kernels.M_A] = body.mass_kg, shell.mass_kg
    for inertia_at, inverse_at, mobility_at, arm_at, part in (
        (_kernels.I_B, _kernels.W_B, _kernels.N_B, _kernels.P_B, body),
        (_kernels.I_A, _kernels.W_A, _kernels.N_A, _kernels.P_A, shell),
    ):
        arm = vehicle.joint_m - part.cg_m
        inverse = np.linalg.inv(part.inertia)
        p[inertia_at : inertia_at + 9] = part.inertia.ravel()
        p[inverse_at : inverse_at + 9] = inverse.ravel()
        p[mobility_at : mobility_at + 9] = (-rotations.skew(arm) @ inverse @ rotations.skew(arm)).ravel()
        p[arm_at : arm_at + 3] = arm
    p[_kernels.NOSE_A : _kernels.NOSE_A + 3] = -shell.cg_m
    p[_kernels.JOINT : _kernels.JOINT + 8] = (
        joint.bending_stiffness_nmprad,
        joint.hardening_nmprad3,
        joint.torsion_stiffness_nmprad,
        joint.bending_damping_nmsprad,
        joint.damping_hardening_nmsprad3,
        joint.torsion_damping_nmsprad,
        np.deg2rad(joint.freeplay_deg),
        joint.freeplay_corner,
    )
    p[_kernels.REFERENCE : _kernels.REFERENCE + 2] = vehicle.reference.area_m2, vehicle.reference.length_m
    return p


def atmosphere_table(profile: AtmosphereProfile) -> FloatArray:
    """Log density, speed of sound, north and east wind every 50 m from -1 to 399 km, for the kernels."""
    z = ATMOSPHERE_START_M + ATMOSPHERE_STEP_M * np.arange(ATMOSPHERE_ROWS, dtype=np.float64)
    air = profile.at(z)
    return np.column_stack([np.log(air.density_kgpm3), air.sound_speed_mps, air.wind_ned_mps[:, :2]])


def vacuum_table() -> FloatArray:
    """Table of an atmosphere too thin to matter (e^-700 kg/m^3), for flights under gravity and springs alone."""
    return np.tile(np.array([-700.0, 300.0, 0.0, 0.0]), (ATMOSPHERE_ROWS, 1))


def kernel_tables(vehicle: Vehicle, atmosphere: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the four table arguments of the kernels: atmosphere, grid, Mach knots, coefficients."""
    grid = np.array([ATMOSPHERE_START_M, ATMOSPHERE_STEP_M, vehicle.aero.alpha_rad[1]])
    return (
        np.ascontiguousarray(atmosphere),
        grid,
        np.ascontiguousarray(vehicle.aero.mach),
        np.ascontiguousarray(vehicle.aero.coefficients),
    )

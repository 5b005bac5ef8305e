"""How a vehicle and the air are laid out for the compiled flight kernels."""

from __future__ import annotations

from functools import cache

import numpy as np

from flightmodel import rarefied, rotations
from flightmodel.atmosphere import AtmosphereProfile, us76
from flightmodel.checks import FloatArray
from flightmodel.vehicle import Vehicle
from synthetic_flight import _workspace_kernels as at

ATMOSPHERE_START_M, ATMOSPHERE_STEP_M, ATMOSPHERE_ROWS = -1000.0, 50.0, 8001


def freeplay_corner(freeplay_rad: float, corner: float) -> tuple[float, float, float]:
    """Arguments of `_kernels.beyond_freeplay` after the angle: freeplay, half width of its corner, 1 / (4 half)."""
    half = corner * freeplay_rad
    return freeplay_rad, half, 0.25 / half if half > 0.0 else 0.0


def parameter_vector(
    vehicle: Vehicle, ca: float = 1.0, cn: float = 1.0, cm: float = 1.0, cmq_shift: float = 0.0
) -> FloatArray:
    """Pack a vehicle for the kernels, (67,), with factors on its C_A, C_N and C_m and a shift of its C_mq."""
    p = np.zeros(at.PARAMETERS)
    body, shell, joint = vehicle.centerbody, vehicle.aeroshell, vehicle.joint
    upper = np.triu_indices(3)
    mb, ma = body.mass_kg, shell.mass_kg
    p[: at.I_B] = mb, ma, 1.0 / mb, 1.0 / ma, ma / (mb + ma), -mb / (mb + ma), 1.0 / (mb + ma)
    for inertia_at, inverse_at, mobility_at, arm_at, part in (
        (at.I_B, at.W_B, at.N_B, at.P_B, body),
        (at.I_A, at.W_A, at.N_A, at.P_A, shell),
    ):
        arm = vehicle.joint_m - part.cg_m
        inverse = np.linalg.inv(part.inertia)
        p[inertia_at : inertia_at + 6] = part.inertia[upper]
        p[inverse_at : inverse_at + 6] = inverse[upper]
        p[mobility_at : mobility_at + 6] = (-rotations.skew(arm) @ inverse @ rotations.skew(arm))[upper]
        p[arm_at : arm_at + 3] = arm
    p[at.NOSE_A : at.NOSE_A + 3] = -shell.cg_m
    freeplay = np.deg2rad(joint.freeplay_deg)
    p[at.JOINT : at.JOINT + 9] = (
        joint.bending_stiffness_nmprad,
        joint.hardening_nmprad3,
        joint.torsion_stiffness_nmprad,
        joint.bending_damping_nmsprad,
        joint.damping_hardening_nmsprad3,
        joint.torsion_damping_nmsprad,
        *freeplay_corner(freeplay, joint.freeplay_corner),
    )
    p[at.REFERENCE : at.REFERENCE + 2] = vehicle.reference.area_m2, vehicle.reference.length_m
    p[at.FACTOR : at.FACTOR + 4] = ca, cn, cm, cmq_shift
    return p


def _altitudes() -> FloatArray:
    return ATMOSPHERE_START_M + ATMOSPHERE_STEP_M * np.arange(ATMOSPHERE_ROWS, dtype=np.float64)


@cache
def _standard() -> tuple[FloatArray, FloatArray, FloatArray]:
    return us76(_altitudes())


def atmosphere_table(profile: AtmosphereProfile) -> FloatArray:
    """Air every 50 m from -1 to 399 km, ``(rows, 6)``, for the kernels.

    Density, the change of its logarithm up to the next row, speed of sound, north and east wind, and room for the
    fraction of free-molecular flow, which depends on the vehicle (`kernel_tables`).
    """
    z = _altitudes()
    air = profile.at(z, _standard())
    change = np.diff(np.log(air.density_kgpm3), append=np.log(air.density_kgpm3[-1]))
    columns = [air.density_kgpm3, change, air.sound_speed_mps, air.wind_ned_mps[:, :2], np.zeros(len(z))]
    return np.column_stack(columns)


def vacuum_table() -> FloatArray:
    """Table of no atmosphere, for flights under gravity and springs alone."""
    return np.tile(np.array([0.0, 0.0, 300.0, 0.0, 0.0, 0.0]), (ATMOSPHERE_ROWS, 1))


def kernel_tables(vehicle: Vehicle, atmosphere: FloatArray) -> tuple[FloatArray, ...]:
    """Return the tables of the kernels: atmosphere of every lane, grid, Mach knots, coefficients, free-molecular."""
    grid = np.array([ATMOSPHERE_START_M, 1.0 / ATMOSPHERE_STEP_M, 1.0 / vehicle.aero.alpha_rad[1]])
    coefficients = np.ascontiguousarray(vehicle.aero.coefficients)
    air = atmosphere if atmosphere.ndim == 3 else atmosphere[None]
    free = np.zeros(coefficients.shape[1:])
    if vehicle.aero.free_molecular is not None:
        free, air = np.ascontiguousarray(vehicle.aero.free_molecular), air.copy()
        with np.errstate(divide="ignore"):  # no air: infinitely far between molecules
            air[..., 5] = rarefied.bridge(rarefied.knudsen(air[..., 0], vehicle.reference.length_m))
    return np.ascontiguousarray(air), grid, np.ascontiguousarray(vehicle.aero.mach), coefficients, free


def workspace(states: FloatArray, parameters: FloatArray) -> FloatArray:
    """Lanes' rows before a flight: states ``(lanes, 20)`` and parameter vectors ``(lanes, 67)`` of every lane."""
    s = np.zeros((at.ROWS, len(states)))
    s[at.Y : at.Y + at.STATES] = states.T
    s[at.P :] = parameters.T
    return s.ravel()


def flown_records(states: FloatArray, aux: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Records up to the first that is not finite."""
    finite = np.isfinite(states).all(axis=-1)
    n = len(states) if finite.all() else int(np.argmin(finite))
    return states[:n], aux[:n]

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from synthetic_flight.simulate import state_from_ecef


@pytest.fixture(scope="session")
def vehicle():
    return vehicle_from_toml(vehicle_path("irve2_reference"))


@pytest.fixture(scope="session")
def generic_vehicle(vehicle):
    """Every term alive: c.g.s off the axis in two directions, full inertia tensors, freeplay, hardening, dampers."""

    def full(body, turn, cg_shift):
        r = rotations.dcm_from_q(rotations.exp(np.array(turn)))
        tensor = r @ body.inertia @ r.T
        tensor = 0.5 * (tensor + tensor.T)
        cg = body.cg_m + np.array(cg_shift)
        return body.model_copy(update={"inertia_kgm2": tuple(map(tuple, tensor)), "cg_from_datum_body_m": tuple(cg)})

    joint = vehicle.joint.model_copy(
        update={
            "freeplay_deg": 0.4,
            "freeplay_corner": 0.1,
            "hardening_nmprad3": 2.0e5,
            "damping_hardening_nmsprad3": 300.0,
            "torsion_stiffness_nmprad": 9.0e3,
            "torsion_damping_nmsprad": 1.7,
        }
    )
    return replace(
        vehicle,
        joint=joint,
        aeroshell=full(vehicle.aeroshell, [0.2, -0.1, 0.15], [0.01, -0.02, 0.013]),
        centerbody=full(vehicle.centerbody, [-0.3, 0.12, 0.2], [-0.02, 0.011, 0.017]),
    )


def undamped(vehicle):
    joint = vehicle.joint.model_copy(
        update={"bending_damping_nmsprad": 0.0, "torsion_damping_nmsprad": 0.0, "damping_hardening_nmsprad3": 0.0}
    )
    return replace(vehicle, joint=joint)


def entry_state(vehicle, alpha_deg=4.0, spin_rpm=0.0, time_s=403.1):
    """100 km, 1526 m/s, path angle -76.5 deg, nose off the velocity by ``alpha_deg`` in the plane of the offset."""
    r = earth.ecef_from_geodetic(np.deg2rad(37.0), np.deg2rad(-74.3), 100e3)
    path, azimuth = np.deg2rad([-76.5, 130.0])
    v = earth.ecef_from_ned(
        1526.0 * np.array([np.cos(path) * np.cos(azimuth), np.cos(path) * np.sin(azimuth), -np.sin(path)]), r
    )
    x = v / np.linalg.norm(v)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    q = rotations.q_from_dcm(np.column_stack([x, y, np.cross(x, y)])[None])[0]
    q = rotations.boxplus(q, np.deg2rad(alpha_deg) * np.array([0.0, 0.0, -1.0]))
    return state_from_ecef(time_s, r, v, q, np.array([spin_rpm * 2 * np.pi / 60, 0.0, 0.0]))


def free_state(vehicle, distance_m=1.0e10):
    """Spinning, bent and twisted, so far out that gravity's gradient is 1e-15 of what it is near the Earth."""
    rng = np.random.default_rng(4)
    r = distance_m * np.array([0.48, -0.6, 0.64])
    bent = rotations.multiply(rotations.exp(np.array([0.0, 0.05, -0.03])), rotations.exp(np.array([0.02, 0.0, 0.0])))
    q = rotations.exp(rng.normal(size=3))
    state = state_from_ecef(0.0, r, np.array([500.0, -800.0, 300.0]), q, np.array([0.63, 0.05, -0.08]), bent)
    state[17:20] += np.array([0.02, -0.3, 0.2])
    # momentum and energy are about the motion inside: no common velocity
    state[3:6] = 0.0
    return state


def bent_entry_state(bent_rad, rate_of_shell_radps, altitude_m=70e3, speed_mps=1526.0):
    """Path angle -76 deg; off the velocity by 6 deg, rolling, bent (and twisted)."""
    r = earth.ecef_from_geodetic(np.deg2rad(37.0), np.deg2rad(-74.3), altitude_m)
    path, azimuth = np.deg2rad([-76.5, 130.0])
    v = earth.ecef_from_ned(
        speed_mps * np.array([np.cos(path) * np.cos(azimuth), np.cos(path) * np.sin(azimuth), -np.sin(path)]), r
    )
    x = v / np.linalg.norm(v)
    y = np.cross(x, [0.0, 0.0, 1.0])
    y /= np.linalg.norm(y)
    q = rotations.q_from_dcm(np.column_stack([x, y, np.cross(x, y)])[None])[0]
    q = rotations.boxplus(q, np.array([0.3, 0.09, -0.05]))
    state = state_from_ecef(0.0, r, v, q, np.array([0.6, 0.05, -0.1]), rotations.exp(np.array(bent_rad)))
    state[17:20] += np.array(rate_of_shell_radps)
    return state


def with_joint(vehicle, **update):
    return replace(vehicle, joint=vehicle.joint.model_copy(update=update))


@pytest.fixture
def measured(record_property):
    """Assert a margin and keep it: ``measured(what, value, limit, unit)`` (see docs/proofs.md; pytest --junitxml)."""

    def within(what, value, limit, unit=""):
        value = float(value)
        record_property(what, f"{value:.3g} against {limit:g} {unit}".strip())
        assert value <= limit, f"{what}: {value:.6g} {unit} against {limit:g} {unit}"

    return within


def with_constant_cmq(aero, cmq):
    """Copy of coefficients with one of pitch damping everywhere."""
    changed = aero.coefficients.copy()
    changed[..., 3] = cmq
    return replace(aero, coefficients=changed)

"""Parts of the reconciliation without a flight: deflection with freeplay, and the sampler on a known density."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.checks import ConfigError
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.reconciliation import posterior
from postflight.reconciliation.fit import with_freeplay
from postflight.reconciliation.forward_model import (
    CREEP_PER_S,
    DEFLECTION,
    FREEPLAY_SD_RAD,
    JOINT,
    KNOT_M,
    MOTION,
    UPPER_M,
    AtmosphereParameters,
    VehicleParameters,
)
from postflight.reconciliation.gauss_newton import Parameters
from postflight.reconciliation.posterior import quantities
from synthetic_flight.dynamics import beyond_freeplay
from tests.refusing import refuses

NOMINAL = vehicle_from_toml(vehicle_path("irve2_reference"))
COVARIANCE = np.array([[1.0, 0.8], [0.8, 1.0]])


def gaussian(z):
    return -0.5 * np.einsum("ni,ij,nj->n", z, np.linalg.inv(COVARIANCE), z)


@pytest.mark.parametrize("corner", [1.0, 0.1])
def test_a_joint_with_freeplay_carries_the_plain_joints_moment(corner):
    parameters = VehicleParameters(NOMINAL, ("freeplay",))
    motion = np.zeros((5, MOTION))
    motion[:, DEFLECTION.start + 1] = 0.6 * np.deg2rad([0.01, 0.1, 0.2, 0.5, 2.0])
    motion[:, DEFLECTION.start + 2] = -0.8 * np.deg2rad([0.01, 0.1, 0.2, 0.5, 2.0])
    plain = Parameters(np.zeros(len(parameters.names) - 1), np.zeros(20), np.zeros((3, 4)), np.zeros(2), motion)
    loose = with_freeplay(SimpleNamespace(vehicle_parameters=parameters), plain, np.deg2rad(0.3), corner)
    size = np.linalg.norm(loose.motion[:, DEFLECTION], axis=1)
    expected = np.linalg.norm(motion[:, DEFLECTION], axis=1)
    assert beyond_freeplay(size, np.deg2rad(0.3), corner) == pytest.approx(expected, rel=1e-9)
    assert loose.motion[:, DEFLECTION] / size[:, None] == pytest.approx(motion[:, DEFLECTION] / expected[:, None])
    vehicle = parameters.vehicle(loose.vehicle)
    assert vehicle.joint.freeplay_deg == pytest.approx(0.3)
    assert vehicle.joint.freeplay_corner == NOMINAL.joint.freeplay_corner


def test_the_walkers_sample_a_known_density_and_alike_every_time():
    chain, autocorrelation = posterior._walk(gaussian, 2, np.random.default_rng(1))
    again, _ = posterior._walk(gaussian, 2, np.random.default_rng(1))
    assert np.array_equal(chain, again)
    # 2000 steps of 32 walkers
    independent = 32 * (posterior.MOVES - posterior.BURNT) / autocorrelation
    assert np.cov(chain.T) == pytest.approx(COVARIANCE, abs=5.0 / np.sqrt(independent))


def test_quantities_are_the_vehicles():
    parameters = VehicleParameters(NOMINAL, ("freeplay", "hardening"))
    x = np.zeros((2, len(parameters.names)))
    x[1, parameters.names.index("freeplay")] = -0.2
    x[1, parameters.names.index("static stability")] = 0.5
    x[1, parameters.names.index("hardening")] = 0.3
    table = quantities(parameters, x)
    assert table.stiffness_nmprad[0] == NOMINAL.joint.bending_stiffness_nmprad
    assert table.freeplay_deg.tolist() == [0.0, pytest.approx(np.rad2deg(0.2 * FREEPLAY_SD_RAD))]
    assert table.static_stability[1] == pytest.approx(1.0 + 0.5 * NOMINAL.uncertainty.cm)
    assert table.hardening_at_4_deg[1] == pytest.approx(0.3)
    # the slope at 4 deg is by that share steeper
    joint = parameters.vehicle(x[1]).joint
    steeper = 3.0 * joint.hardening_nmprad3 * np.deg2rad(4.0) ** 2 / joint.bending_stiffness_nmprad
    assert steeper == pytest.approx(0.3)


def test_creep_is_two_parameters_and_two_numbers_of_every_motion():
    parameters = VehicleParameters(NOMINAL, ("creep", "hardening"))
    assert parameters.names[len(JOINT) : parameters.sought] == ("creep growth", "creep settling", "hardening")
    assert parameters.motion == MOTION + 2
    assert VehicleParameters(NOMINAL).motion == MOTION
    x = np.zeros((2, len(parameters.names)))
    growth, settling = 0.25 / 0.75 / 20.0, 1.0 / 20.0
    x[1, len(JOINT) : len(JOINT) + 2] = np.arcsinh(
        [growth / CREEP_PER_S, np.sqrt(settling**2 - 300.0**-2) / CREEP_PER_S]
    )
    plain, creeping = (parameters.vehicle(row).joint for row in x)
    assert plain.creep_share == 0.0
    # share s is a delayed compliance of s / (1 - s) of the spring's
    assert creeping.creep_share == pytest.approx(0.25)
    assert creeping.creep_time_s == pytest.approx(20.0)
    assert creeping.bending_stiffness_nmprad == plain.bending_stiffness_nmprad
    table = quantities(parameters, x)
    assert table.creep_share.tolist() == [0.0, pytest.approx(0.25)]
    assert table.creep_time_s.tolist() == [pytest.approx(300.0), pytest.approx(20.0)]
    # a trial step never makes a joint that runs away from its load, nor one that no vehicle file can have
    x[1, len(JOINT) : len(JOINT) + 2] = 900.0, 900.0
    wild = parameters.vehicle(x[1]).joint
    assert 0.0 < wild.creep_share <= 0.9
    assert wild.creep_time_s == pytest.approx(0.1, rel=1e-3)
    x[1, len(JOINT) + 1] = 0.0
    x[1, len(JOINT)] = -50.0
    assert parameters.vehicle(x[1]).joint.delayed_compliance_radpnm * plain.bending_stiffness_nmprad == pytest.approx(
        -0.5
    )


def test_a_missing_sampler_is_refused(monkeypatch):
    monkeypatch.setattr(posterior, "find_spec", lambda name: None)
    with refuses("package-missing", names=["emcee", r"postflight\[posterior\]"], kind=ConfigError):
        posterior.require_sampler()


def test_knots_carry_gusts_at_the_joints_own_period_and_leave_the_rest_to_the_noise():
    """Half a period of the joint's quickest oscillation, 4 Hz at 1200 m/s, holds a knot wherever air loads it."""
    air = AtmosphereParameters(None, 38e3)
    apart = np.diff(air.knots_m)
    loaded = air.knots_m[:-1] < UPPER_M
    assert np.all(apart > 0.0)
    assert air.knots_m[0] <= 38e3
    assert apart[loaded].max() <= 0.5 * 1200.0 / 4.0
    assert air.knot_spacing_m(np.array([40e3, 60e3])) == pytest.approx(KNOT_M)
    assert air.knot_spacing_m(np.array([90e3]))[0] == pytest.approx(apart[-1])

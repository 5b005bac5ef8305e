"""Parts of the reconciliation that need no flight: a looser joint's bending, and both samplers on known densities."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.checks import ConfigError
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.reconciliation import posterior
from postflight.reconciliation.candidate import FREEPLAY_SD_RAD, KNOT_M, UPPER_M, AirUnknowns, VehicleUnknowns
from postflight.reconciliation.fit import loosened
from postflight.reconciliation.posterior import quantities
from postflight.reconciliation.problem import BENDING, MOTION, Unknowns
from synthetic_flight.dynamics import beyond_freeplay

TOLD = vehicle_from_toml(vehicle_path("irve2_reference"))
COVARIANCE = np.array([[1.0, 0.8], [0.8, 1.0]])


def gaussian(z):
    return -0.5 * np.einsum("ni,ij,nj->n", z, np.linalg.inv(COVARIANCE), z)


@pytest.mark.parametrize("corner", [1.0, 0.1])
def test_a_loosened_joint_carries_the_plain_joints_moment(corner):
    unknown = VehicleUnknowns(TOLD, ("freeplay",))
    motion = np.zeros((5, MOTION))
    motion[:, BENDING.start + 1] = 0.6 * np.deg2rad([0.01, 0.1, 0.2, 0.5, 2.0])
    motion[:, BENDING.start + 2] = -0.8 * np.deg2rad([0.01, 0.1, 0.2, 0.5, 2.0])
    plain = Unknowns(np.zeros(len(unknown.names) - 1), np.zeros(20), np.zeros((3, 4)), motion)
    loose = loosened(SimpleNamespace(unknown=unknown), plain, np.deg2rad(0.3), corner)
    size = np.linalg.norm(loose.motion[:, BENDING], axis=1)
    expected = np.linalg.norm(motion[:, BENDING], axis=1)
    assert beyond_freeplay(size, np.deg2rad(0.3), corner) == pytest.approx(expected, rel=1e-9)
    assert loose.motion[:, BENDING] / size[:, None] == pytest.approx(motion[:, BENDING] / expected[:, None])
    vehicle = unknown.vehicle(loose.vehicle)
    assert vehicle.joint.freeplay_deg == pytest.approx(0.3)
    assert vehicle.joint.freeplay_corner == TOLD.joint.freeplay_corner


def test_the_walkers_sample_a_known_density_and_alike_every_time():
    chain, forgot = posterior._walk(gaussian, 2, np.random.default_rng(1))
    again, _ = posterior._walk(gaussian, 2, np.random.default_rng(1))
    assert np.array_equal(chain, again)
    # 2000 steps of 32 walkers
    independent = 32 * (posterior.MOVES - posterior.BURNT) / forgot
    assert np.cov(chain.T) == pytest.approx(COVARIANCE, abs=5.0 / np.sqrt(independent))


def test_nested_sampling_finds_a_known_volume():
    pytest.importorskip("dynesty")
    volume, sd = posterior._volume(gaussian, 2)
    true = np.log(2.0 * np.pi * np.sqrt(np.linalg.det(COVARIANCE)))
    assert abs(volume - true) < 4.0 * sd < 0.8


def test_quantities_are_the_vehicles():
    unknown = VehicleUnknowns(TOLD, ("freeplay", "hardening"))
    x = np.zeros((2, len(unknown.names)))
    x[1, unknown.names.index("freeplay")] = -0.2
    x[1, unknown.names.index("static stability")] = 0.5
    x[1, unknown.names.index("hardening")] = 0.3
    table = quantities(unknown, x)
    assert table.stiffness_nmprad[0] == TOLD.joint.bending_stiffness_nmprad
    assert table.freeplay_deg.tolist() == [0.0, pytest.approx(np.rad2deg(0.2 * FREEPLAY_SD_RAD))]
    assert table.static_stability[1] == pytest.approx(1.0 + 0.5 * TOLD.uncertainty.cm)
    assert table.hardening_at_4_deg[1] == pytest.approx(0.3)
    # the slope at 4 deg is by that share steeper
    joint = unknown.vehicle(x[1]).joint
    steeper = 3.0 * joint.hardening_nmprad3 * np.deg2rad(4.0) ** 2 / joint.bending_stiffness_nmprad
    assert steeper == pytest.approx(0.3)


def test_missing_samplers_are_told_in_words(monkeypatch):
    monkeypatch.setattr(posterior, "find_spec", lambda name: None if name == "emcee" else object())
    with pytest.raises(ConfigError, match=r"emcee not installed; pip install 'postflight\[posterior\]'"):
        posterior.require_samplers()


def test_knots_carry_gusts_at_the_joints_own_period_and_leave_the_rest_to_the_noise():
    """Half a period of the joint's quickest swinging, 4 Hz at 1200 m/s, holds a knot wherever air loads it."""
    air = AirUnknowns(None, 38e3)
    apart = np.diff(air.knots_m)
    loaded = air.knots_m[:-1] < UPPER_M
    assert np.all(apart > 0.0)
    assert air.knots_m[0] <= 38e3
    assert apart[loaded].max() <= 0.5 * 1200.0 / 4.0
    assert air.apart_m(np.array([40e3, 60e3])) == pytest.approx(KNOT_M)
    assert air.apart_m(np.array([90e3]))[0] == pytest.approx(apart[-1])

"""Evidence, intervals, spectra and loosened joints of the reconciliation, each by its definition."""

from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.reconciliation.fit import JointFit, with_freeplay
from postflight.reconciliation.forward_model import FREEPLAY_SD_RAD, OFFSET_SD_M, VehicleParameters
from postflight.reconciliation.gauss_newton import Parameters
from postflight.reconciliation.modes import HOP, PADDED, RATE_HZ, WINDOW, _spectra
from postflight.reconciliation.posterior import joint_table
from synthetic_flight.dynamics import beyond_freeplay

VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))


def test_evidence_is_the_integral_of_the_posterior():
    # a cost that is quadratic about its lowest: exp(-cost / 2) summed over a fine grid of both unknowns
    covariance, lowest, weights = np.array([[0.5, 0.2], [0.2, 0.9]]), 3.7, 1.3
    grid = np.linspace(-8.0, 8.0, 801)
    x = np.stack(np.meshgrid(grid, grid), axis=-1)
    cost = lowest + np.einsum("...i,ij,...j->...", x, np.linalg.inv(covariance), x)
    integral = np.exp(-0.5 * cost).sum() * (grid[1] - grid[0]) ** 2 / (2.0 * np.pi)
    problem = SimpleNamespace(vehicle_parameters=SimpleNamespace(laws=()), log_weight=weights)
    found = JointFit(problem, None, covariance, SimpleNamespace(cost=lowest), 1, True)
    assert found.log_evidence == pytest.approx(weights + np.log(integral), rel=1e-6)


def test_intervals_hold_nine_tenths():
    # the c.g.'s offset is linear in its unknown: of drawn offsets nine in ten lie inside, a twentieth on either side
    unknown = VehicleParameters(VEHICLE)
    n = len(unknown.names)
    found = SimpleNamespace(
        problem=SimpleNamespace(vehicle_parameters=unknown), parameters=SimpleNamespace(vehicle=np.zeros(n)),
        covariance=0.01 * np.eye(n),
    )  # fmt: skip
    row = joint_table(found).set_index("quantity").loc["c.g. offset y"]
    told = 100.0 * VEHICLE.cg_m[1]
    drawn = told + 100.0 * OFFSET_SD_M * 0.1 * np.random.default_rng(1).standard_normal(40000)
    # the shell's lateral c.g. and the masses move it too, by less
    assert row.sd == pytest.approx(np.std(drawn), rel=0.05)
    assert np.mean(drawn < row.low) == pytest.approx(0.05, abs=0.012)
    assert np.mean(drawn > row.high) == pytest.approx(0.05, abs=0.012)


def test_a_swing_that_does_not_roll_has_its_own_frequency_whatever_the_roll():
    # a lateral vector that turns at 3 Hz in space, told in a body that rolls at 0.7 Hz
    t = np.arange(0.0, 14.0, 1.0 / 200.0)
    roll = 2.0 * np.pi * 0.7 * t
    seen = np.exp(1j * (2.0 * np.pi * 3.0 * t - roll)) + 0.01 * np.random.default_rng(2).standard_normal(len(t))
    three = np.column_stack([np.full(len(t), 2.0 * np.pi * 0.7), seen.real, seen.imag])
    bet = SimpleNamespace(imu_time_s=t, rate_body_radps=three, specific_force_body_mps2=three)
    at, power = _spectra(SimpleNamespace(solution=bet), np.array([1.0, 13.0]))
    assert len(at) >= (12.0 * RATE_HZ - WINDOW) / HOP - 1
    frequency = np.fft.fftfreq(PADDED, 1.0 / RATE_HZ)
    np.testing.assert_allclose(frequency[np.argmax(power, axis=1)], 3.0, atol=0.1)


@pytest.mark.parametrize("corner", [1.0, 0.1])
def test_a_loosened_joint_carries_the_plain_one_s_moment(corner):
    # bent so much further that beyond the dead band as much is left as the plain joint was bent
    sizes, freeplay = np.deg2rad([0.02, 0.1, 0.6, 3.0]), np.deg2rad(0.25)
    names = ("stiffness", "damping", "offset y", "offset z", "static stability", "freeplay")
    motion = np.zeros((4, 12))
    motion[:, 7], motion[:, 8] = 0.6 * sizes, -0.8 * sizes
    plain = Parameters(np.zeros(5), np.zeros(20), np.zeros((3, 4)), motion)
    made = with_freeplay(SimpleNamespace(vehicle_parameters=SimpleNamespace(names=names)), plain, freeplay, corner)
    bent = np.linalg.norm(made.motion[:, 7:9], axis=1)
    np.testing.assert_allclose(beyond_freeplay(bent, freeplay, corner), sizes, rtol=1e-9)
    np.testing.assert_allclose(made.motion[:, 7] / made.motion[:, 8], -0.75)
    assert made.vehicle[5] * FREEPLAY_SD_RAD == pytest.approx(freeplay)

"""Radar prediction: twin, derivatives with every term alive, and the geometry of the tracked point."""

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.instruments import RadarSite
from flightmodel.telemetry import RadarRecord
from recon.measurements import predict_radar, predict_radar_plain, radar_model, residual
from recon.state import States, boxplus

RATE = np.array([0.63, -0.2, 0.31])
ARM = np.array([0.41, -0.036, 0.03])


@pytest.fixture
def model():
    site = RadarSite("r", -0.58, 0.31, 40.0, 5.0, 1e-4, 5.0, 1e-4, 2e-3)
    record = RadarRecord(site, np.array([0.0, 1.0]), np.zeros((2, 3)))
    return radar_model("r", record, slice(31, 35), ARM, np.zeros(3))


@pytest.fixture
def state():
    rng = np.random.default_rng(7)
    errors = np.zeros(26)
    errors[22:26] = [4.0, 2e-4, -1e-4, 2.5e-3]
    position = earth.ecef_from_geodetic(-0.57, 0.32, 8e4)
    return States(position, np.array([900.0, -700.0, 500.0]), rotations.exp(rng.normal(0, 1, 3)), errors)


def test_kernel_equals_readable_twin(model, state):
    (h, jacobian), (h_plain, jacobian_plain) = (
        predict_radar(model, state, RATE),
        predict_radar_plain(model, state, RATE),
    )
    assert np.allclose(h, h_plain, rtol=1e-13, atol=1e-15)
    assert np.allclose(jacobian, jacobian_plain, rtol=1e-10, atol=1e-18)


def test_partials_are_derivatives(model, state):
    _, jacobian = predict_radar(model, state, RATE)
    steps = np.concatenate([np.full(3, 10.0), np.full(3, 10.0), np.full(3, 1e-2), np.full(26, 1e-3)])
    for j in range(35):
        e = np.zeros(35)
        e[j] = steps[j]
        column = residual(
            predict_radar(model, boxplus(state, e), RATE)[0], predict_radar(model, boxplus(state, -e), RATE)[0]
        ) / (2.0 * steps[j])
        # third-order terms of a 10 m or 0.01 rad step, and 1e-11 m, 1e-16 rad rounding over the step; the Earth rate's
        # own turn with the body (7e-5 rad/s times 2.5 ms times 0.4 m) is left out
        slack = np.array([1e-7, 2e-12, 2e-12]) / np.minimum(steps[j] / 1e-2, 1.0)
        assert (np.abs(jacobian[:, j] - column) < 1e-4 * np.abs(column) + slack).all(), j
    alive = np.abs(jacobian).max(axis=0) > 0.0
    assert alive[[*range(9), *range(31, 35)]].all()
    assert not alive[9:31].any()


def test_prediction_is_the_tracked_point_at_the_true_time(model, state):
    """Moving the tracked point back by the time bias on a straight path and reading it with `earth` gives the same."""
    h, _ = predict_radar(model, state, RATE)
    c = rotations.dcm_from_q(state.q_ecef_body)
    turn = RATE - c.T @ earth.OMEGA_ECEF_RADPS
    point = state.position_ecef_m + c @ ARM
    velocity = state.velocity_ecef_mps + c @ np.cross(turn, ARM)
    z = earth.radar_from_ecef(point - 2.5e-3 * velocity, -0.58, 0.31, 40.0)
    assert np.allclose(residual(h, z), [4.0, 2e-4, -1e-4], rtol=1e-6)


def test_datum_and_cg_tracks_differ_by_the_arm(state):
    site = RadarSite("r", -0.58, 0.31, 40.0, 5.0, 1e-4, 5.0, 1e-4, 2e-3)
    cg, imu = np.array([-0.54, 0.004, 0.0]), np.array([-0.95, 0.04, -0.03])
    arms = {
        point: radar_model(
            "r", RadarRecord(site, np.zeros(1), np.zeros((1, 3)), point), slice(31, 35), cg, imu
        ).arm_body_m
        for point in ("cg", "datum")
    }
    assert np.allclose(arms["datum"], -imu)
    assert np.allclose(arms["cg"] - arms["datum"], cg)


def test_azimuth_residual_wraps():
    assert np.allclose(residual(np.array([0.0, 0.01, 0.0]), np.array([0.0, 2 * np.pi - 0.01, 0.0]))[1], 0.02)


def test_traverse_noise_grows_with_elevation(model):
    for elevation in (0.1, 1.1):
        assert np.allclose(np.sqrt(np.diag(model.noise_var(elevation))), [5.0, 1e-4 / np.cos(elevation), 1e-4])

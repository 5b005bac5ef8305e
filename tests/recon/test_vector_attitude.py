"""Attitude from magnetometer and Sun alone, on a flight with every error of its instruments alive; truth stays here."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel import rotations
from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from flightmodel.trajectory import difference, resample
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.vector_attitude import compare, reconstruct_attitude
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

pytestmark = pytest.mark.slow
SPAN_S = (400.0, 470.0)


def cropped(record, start, end, name):
    rows = (record.time_s >= start) & (record.time_s <= end)
    return replace(record, time_s=record.time_s[rows], **{name: getattr(record, name)[rows]})


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Truth, and telemetry whose magnetometer and Sun sensors cover 70 s with the pulse."""
    folder = tmp_path_factory.mktemp("rich") / "flight"
    truth = simulate_to_folder(read_scenario("irve2_rich"), 3, folder)
    telemetry = read_flight(folder)
    magnetometer = cropped(telemetry.magnetometer, *SPAN_S, "measured_sensor")
    sun = cropped(telemetry.sun, *SPAN_S, "az_el_head_rad")
    return truth, replace(telemetry, magnetometer=magnetometer, sun=sun)


@pytest.fixture(scope="module")
def trajectory(flown):
    return reconstruct(flown[1], Settings(start_s=SPAN_S[0], end_s=SPAN_S[1])).smoothed


@pytest.fixture(scope="module")
def history(flown):
    return reconstruct_attitude(flown[1])


def test_errors_are_as_large_as_their_covariance_allows(flown, history):
    """Errors last as long as the sensors' constant ones, so the mean over time scatters at most as one time does."""
    q = rotations.slerp(flown[0].time_s, flown[0].trajectory.q_ecef_body, history.time_s)
    error = rotations.boxminus(history.q_ecef_body, q)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(history.covariance), error)
    assert nees.mean() < chi2.ppf(0.999, 3)
    # a degree of noise on the Sun, half of bias, 1 % of field: worth a few tenths when smoothed, never hundredths
    assert 0.02 < np.rad2deg(np.sqrt((error**2).mean())) < 1.0


def test_it_agrees_with_the_trajectory_and_names_a_magnetometer_that_was_turned(flown, history, trajectory):
    assert compare(history, trajectory).passed
    record = flown[1].magnetometer
    turn = rotations.dcm_from_q(rotations.exp(np.deg2rad([10.0, 0.0, 0.0])))
    turned = replace(record, spec=replace(record.spec, dcm_body_sensor=turn @ record.spec.dcm_body_sensor))
    found = compare(reconstruct_attitude(replace(flown[1], magnetometer=turned)), trajectory)
    assert not found.passed
    assert "magnetometer" in found.words


def test_a_flight_without_a_stated_attitude_starts_from_them(flown, trajectory):
    telemetry = replace(flown[1], attitude_prior=None)
    alone = reconstruct(telemetry, Settings(start_s=SPAN_S[0] + 30.0, end_s=SPAN_S[1])).smoothed
    error = difference(alone, resample(flown[0].trajectory, alone.time_s))
    nees = np.einsum("ni,nij,nj->n", error[:, 6:], np.linalg.inv(alone.covariance[:, 6:, 6:]), error[:, 6:])
    assert nees.mean() < chi2.ppf(0.999, 3)
    assert np.rad2deg(np.abs(error[:, 6:])).max() < 3.0
    assert trajectory.time_s[0] == pytest.approx(SPAN_S[0])


def test_without_sensors_or_prior_it_says_what_to_add(flown):
    with pytest.raises(GateError) as refusal:
        reconstruct(replace(flown[1], attitude_prior=None, magnetometer=None))
    assert refusal.value.codes == ("attitude-missing",)

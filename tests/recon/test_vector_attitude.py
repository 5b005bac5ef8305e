"""Attitude from magnetometer and Sun alone, on flights with every error of its instruments alive; truth stays here."""

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
from recon.vector_attitude import compare, reconstruct_attitude, solve_vectors, start_attitude_from_vectors
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario

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


def error_of(history, truth):
    q = rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, history.time_s)
    return rotations.boxminus(history.q_ecef_body, q)


def nees_of(error, covariance):
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


def test_two_directions_give_the_attitude_and_what_is_not_seen_stays_open():
    rng = np.random.default_rng(4)
    q = rotations.exp(rng.normal(size=(200, 3)))
    known = rng.normal(size=(200, 2, 3))
    known /= np.linalg.norm(known, axis=2, keepdims=True)
    body = np.stack([rotations.rotate(rotations.conjugate(q), known[:, k]) for k in (0, 1)], axis=1)
    found, _ = solve_vectors(body, known, np.full((200, 2), 0.01))
    assert np.abs(rotations.boxminus(found, q)).max() < 1e-7
    # one direction leaves the rotation about it open, at half a turn
    _, covariance = solve_vectors(body, known, np.array([[0.01, np.inf]] * 200))
    along = np.einsum("ni,nij,nj->n", body[:, 0], covariance, body[:, 0])
    np.testing.assert_allclose(along, np.pi**2, rtol=1e-6)


def mini_error(found, truth):
    return rotations.boxminus(found.q_ecef_body, truth.state(found.time_s)[2])


def test_a_short_flight_has_the_errors_that_are_stated(mini_everything, mini_truth):
    """Three draws of every error; each of nine rms errors is one of its sd, of which a few parts are independent."""
    share = []
    for seed in (3, 4, 5):
        found = reconstruct_attitude(mini_everything(seed))
        error = mini_error(found, mini_truth)
        assert nees_of(error, found.covariance).mean() < chi2.ppf(0.999, 3)
        share.append(np.mean(error**2 / np.diagonal(found.covariance, axis1=1, axis2=2)))
    assert 0.5 < np.sqrt(np.mean(share)) < 1.5


def test_a_short_flight_in_the_dark_for_some_seconds(mini_everything, mini_truth):
    telemetry = mini_everything(3)
    angles, t = telemetry.sun.az_el_head_rad.copy(), telemetry.sun.time_s
    middle = 0.5 * (t[0] + t[-1])
    for start, end in ((middle - 15.0, middle - 14.0), (middle, middle + 8.0)):
        angles[(t > start) & (t < end)] = np.nan
    dark = reconstruct_attitude(replace(telemetry, sun=replace(telemetry.sun, az_el_head_rad=angles)))
    assert ((dark.time_s > middle - 15.0) & (dark.time_s < middle - 14.0)).sum() >= 4
    assert not ((dark.time_s > middle + 0.3) & (dark.time_s < middle + 7.7)).any()
    assert [finding.code for finding in dark.findings] == ["too-few-data"]
    assert nees_of(mini_error(dark, mini_truth), dark.covariance).mean() < chi2.ppf(0.999, 3)


@pytest.mark.slow
def test_errors_are_as_large_as_their_covariance_allows(flown, history):
    """Errors last as long as the sensors' constant ones, so the mean over time scatters at most as one time does."""
    error = error_of(history, flown[0])
    assert nees_of(error, history.covariance).mean() < chi2.ppf(0.999, 3)
    # a degree of noise on the Sun, half of bias, 1 % of field: worth a few tenths when smoothed, never hundredths
    assert 0.02 < np.rad2deg(np.sqrt((error**2).mean())) < 1.0


@pytest.mark.long
def test_errors_of_many_flights_are_as_large_as_stated(tmp_path):
    """Sixteen whole flights, whose errors are each nearly constant: the mean of as many chi-squares, within 3 sd."""
    nees = []
    for seed in range(301, 317):
        truth = simulate_to_folder(read_scenario("irve2_rich"), seed, tmp_path / str(seed))
        found = reconstruct_attitude(read_flight(tmp_path / str(seed)))
        error = error_of(found, truth)
        nees.append(nees_of(error, found.covariance).mean())
    assert abs(np.mean(nees) - 3.0) < 3.0 * np.sqrt(6.0 / 16.0)
    assert max(nees) < chi2.ppf(1.0 - 0.001 / 16.0, 3)


@pytest.mark.slow
def test_a_short_stretch_without_the_sun_is_bridged_and_a_long_one_has_no_rows(flown, history):
    telemetry, (short, long) = flown[1], ((410.05, 411.55), (425.05, 433.05))
    angles, t = telemetry.sun.az_el_head_rad.copy(), telemetry.sun.time_s
    for start, end in (short, long):
        angles[(t > start) & (t < end)] = np.nan
    dark = reconstruct_attitude(replace(telemetry, sun=replace(telemetry.sun, az_el_head_rad=angles)))
    inside = (dark.time_s > short[0]) & (dark.time_s < short[1])
    assert inside.sum() >= 7
    assert not ((dark.time_s > long[0] + 0.2) & (dark.time_s < long[1] - 0.2)).any()
    assert [finding.code for finding in dark.findings] == ["too-few-data"]
    # what the bridge costs is in the covariance
    lit = history.covariance[np.isin(np.round(history.time_s, 6), np.round(dark.time_s[inside], 6))]
    assert (np.trace(dark.covariance[inside], axis1=1, axis2=2) > np.trace(lit, axis1=1, axis2=2)).all()
    error = error_of(dark, flown[0])
    assert nees_of(error[inside], dark.covariance[inside]).mean() < chi2.ppf(0.999, 3)
    assert nees_of(error, dark.covariance).mean() < chi2.ppf(0.999, 3)


@pytest.mark.slow
def test_outliers_are_edited_and_named(flown, history):
    telemetry, rng = flown[1], np.random.default_rng(6)
    spoilt = telemetry.sun.az_el_head_rad.copy()
    t = telemetry.sun.time_s
    for start in rng.uniform(*SPAN_S, 3):
        spoilt[(t > start) & (t < start + 0.2)] += 0.5
    found = reconstruct_attitude(replace(telemetry, sun=replace(telemetry.sun, az_el_head_rad=spoilt)))
    assert {finding.code for finding in found.findings} == {"points-edited"}
    sd = np.sqrt(np.diagonal(history.covariance, axis1=1, axis2=2))
    moved = rotations.boxminus(found.q_ecef_body, history.q_ecef_body) / sd
    assert np.sqrt(np.mean(moved**2)) < 1.0


@pytest.mark.slow
def test_it_agrees_with_the_trajectory_and_names_a_magnetometer_that_was_turned(flown, history, trajectory):
    assert compare(history, trajectory).passed
    record = flown[1].magnetometer
    turn = rotations.dcm_from_q(rotations.exp(np.deg2rad([10.0, 0.0, 0.0])))
    turned = replace(record, spec=replace(record.spec, dcm_body_sensor=turn @ record.spec.dcm_body_sensor))
    found = compare(reconstruct_attitude(replace(flown[1], magnetometer=turned)), trajectory)
    assert not found.passed
    assert "magnetometer" in found.words


@pytest.mark.slow
def test_the_start_is_the_attitude_of_that_time_by_the_minute_about_it(flown):
    prior = start_attitude_from_vectors(flown[1], 440.0)
    assert abs(prior.time_s - 440.0) <= 0.1
    q = rotations.slerp(flown[0].time_s, flown[0].trajectory.q_ecef_body, np.array([prior.time_s]))
    assert (np.abs(rotations.boxminus(prior.q_ecef_body[None], q)[0]) < 4.0 * prior.sd_rad).all()
    assert (prior.sd_rad < np.deg2rad(1.0)).all()
    with pytest.raises(GateError) as refusal:
        start_attitude_from_vectors(replace(flown[1], magnetometer=cropped_to(flown[1].magnetometer, 404.0)), 460.0)
    assert refusal.value.codes == ("time-not-covered",)


def cropped_to(record, end):
    return cropped(record, SPAN_S[0], end, "measured_sensor")


@pytest.mark.slow
def test_a_flight_without_a_stated_attitude_starts_from_them(flown, trajectory):
    telemetry = replace(flown[1], attitude_prior=None)
    alone = reconstruct(telemetry, Settings(start_s=SPAN_S[0] + 30.0, end_s=SPAN_S[1])).smoothed
    error = difference(alone, resample(flown[0].trajectory, alone.time_s))
    assert nees_of(error[:, 6:], alone.covariance[:, 6:, 6:]).mean() < chi2.ppf(0.999, 3)
    assert np.rad2deg(np.abs(error[:, 6:])).max() < 3.0
    assert trajectory.time_s[0] == pytest.approx(SPAN_S[0])


@pytest.mark.slow
def test_without_sensors_or_prior_it_says_what_to_add(flown):
    with pytest.raises(GateError) as refusal:
        reconstruct(replace(flown[1], attitude_prior=None, magnetometer=None))
    assert refusal.value.codes == ("attitude-missing",)

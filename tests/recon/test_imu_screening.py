"""Gaps of inertial data, and samples that tell nothing new."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flightmodel.instruments import TriadSpec
from flightmodel.telemetry import TriadRecord
from recon.atmosphere import HALF_WINDOW_S, _air_samples, windows_are_whole
from recon.estimate import corrected_series
from recon.imu_screening import bridge, frozen_samples
from tests.refusing import refuses

SPEC = TriadSpec("rates", np.zeros(3), np.eye(3), 0.01, 0.01, 0.003, 0.002)


@pytest.mark.parametrize("apart_s", [0.1, 0.3, 0.8, 1.9])
def test_short_gap_beside_a_long_one_is_bridged(apart_s):
    """Pieces to learn from may lie wholly inside the other gap, where there is nothing to learn."""
    t = np.arange(0.0, 20.0, 0.004)
    x = np.column_stack([np.sin(t), np.cos(2.0 * t), 0.1 * t])
    second = 10.06 + apart_s
    lost = ((t > 10.0) & (t < 10.06)) | ((t > second) & (t < second + 0.7))
    bridged = bridge(TriadRecord(SPEC, t[~lost], x[~lost]))
    assert len(bridged.findings) == 2
    assert np.isfinite(bridged.density).all()
    assert np.diff(bridged.time_s).max() < 0.01
    missed = np.array([bridged.density[np.searchsorted(bridged.time_s, s)] for s in (10.03, second + 0.35)])
    assert (missed[0] < missed[1]).all()


def readings(resolution, noise_sd, seed=0, n=5000):
    """A signal that stands still from 40 to 60 % of the record and swings elsewhere, as a sensor tells it."""
    t = np.arange(n) * 0.004
    swing = np.sin(2.0 * np.pi * t) * ((t < 8.0) | (t > 12.0))
    return np.round((swing + np.random.default_rng(seed).normal(0.0, noise_sd, n)) / resolution) * resolution


@pytest.mark.parametrize("length", [30, 100, 1000])
def test_a_reading_that_stops_is_missing(length):
    x = readings(0.02, 0.02)
    x[500 : 500 + length] = x[500]
    stuck = np.flatnonzero(frozen_samples(x, 0.02))
    assert stuck[0] in (499, 500)
    assert len(stuck) == pytest.approx(length, abs=3)


def test_nothing_stops_in_a_thousand_noisy_records():
    assert not any(frozen_samples(readings(0.02, 0.02, seed), 0.02).any() for seed in range(1000))


@pytest.mark.parametrize("noise_sd", [0.0, 0.01])
def test_a_sensor_coarser_than_its_noise_may_rest(noise_sd):
    """Coast: a thousand samples within one step are no fault."""
    x = readings(0.2, noise_sd)
    assert (np.diff(x) == 0.0).mean() > 0.9
    assert not frozen_samples(x, noise_sd).any()


def test_rest_before_the_flight_is_no_fault_but_a_whole_record_is():
    x = readings(0.02, 0.02)
    x[:800] = x[0]
    assert not frozen_samples(x, 0.02).any()
    assert frozen_samples(np.full(100, 0.3), 0.02).all()


def test_clipped_peaks_are_missing():
    t = np.arange(5000) * 0.004
    x = np.clip(np.round(np.sin(t) / 0.01 + np.random.default_rng(0).normal(size=5000)) * 0.01, -0.9, 0.9)
    at_stop = frozen_samples(x, 0.01)
    assert at_stop[np.abs(np.sin(t)) > 0.95].all()
    assert not at_stop[np.abs(np.sin(t)) < 0.85].any()


def test_an_axis_frozen_alone_leaves_the_others():
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 20.0, 0.004)
    x = np.column_stack([np.sin(t), np.cos(2.0 * t), 0.1 * t]) + rng.normal(0.0, 0.01, (len(t), 3))
    x = np.round(x / 0.002) * 0.002
    good = x.copy()
    x[2500:3000, 1] = x[2500, 1]
    bridged = bridge(TriadRecord(SPEC, t, x))
    np.testing.assert_array_equal(bridged.measured_sensor[:, [0, 2]], good[:, [0, 2]])
    missed = np.sqrt(bridged.density[2700] * 2.0)
    assert np.abs(bridged.measured_sensor[:, 1] - good[:, 1])[2500:3000].sum() * 0.004 < 4.0 * missed[1]
    assert missed[1] > 10.0 * missed[0]
    assert [f.source for f in bridged.findings] == ["rates"]
    assert [f.code for f in bridged.findings] == ["gap-bridged"]


def test_an_axis_that_never_moves_is_refused_and_one_that_stops_ends_the_record():
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 20.0, 0.004)
    x = rng.normal(0.0, 0.01, (len(t), 3))
    x[4000:, 2] = x[4000, 2]
    ended = bridge(TriadRecord(SPEC, t, x))
    assert ended.time_s[-1] == pytest.approx(t[3999])
    assert ended.findings[-1].code == "frozen-data"
    assert (ended.findings[-1].start_s, ended.findings[-1].end_s) == (pytest.approx(t[3999]), pytest.approx(t[-1]))
    x[:, 2] = 0.02
    with refuses("sensor-axis-unusable", names=[r"\bz\b", r"\b5000\b"]):
        bridge(TriadRecord(SPEC, t, x))


def test_peaks_clipped_at_one_stop_err_alike():
    """Five bridges that err to one side err five times as much together: each has five times its variance."""
    t = np.arange(0.0, 12.0, 0.01)
    rng = np.random.default_rng(2)
    x = np.column_stack([5.0 * np.sin(np.pi * t + k) for k in range(3)]) + 0.01 * rng.standard_normal((len(t), 3))
    x[:, 1] = np.minimum(x[:, 1], 4.0)
    spec = replace(SPEC, noise_sd=0.01, resolution=0.0, dcm_body_sensor=np.eye(3))
    bridged = bridge(TriadRecord(spec, t, x))
    lone = np.where((t > 3.0)[:, None] & (x == 4.0), np.nan, x)  # the first peak clipped, the others not measured
    alone = bridge(TriadRecord(spec, t, lone))
    spans = [(f.start_s, f.end_s) for f in bridged.findings]
    assert len(spans) == 5
    first = bridged.findings[0]
    assert alone.findings[0].start_s == first.start_s
    length = first.end_s - first.start_s
    # density of the bridge alone, without the samples' noise
    integral_sd = [
        np.sqrt(b.density[np.searchsorted(b.time_s, first.start_s) + 1, 1] * length - spec.noise_sd**2 * length**2)
        for b in (bridged, alone)
    ]
    assert integral_sd[0] == pytest.approx(np.sqrt(5.0) * integral_sd[1], rel=0.02)


@pytest.mark.parametrize("late_s", [0.0, 0.003])
def test_no_reading_is_taken_from_a_bridge_of_either_sensor(late_s):
    """A bridge has samples of its own; where both sensors' tags are the same they have the other's times."""
    t, rng = np.arange(0.0, 10.0, 0.01), np.random.default_rng(6)
    spec = replace(SPEC, name="accelerometer")
    lost = [(t > 2.0) & (t < 2.5), (t + late_s > 6.0) & (t + late_s < 9.0)]
    force, rate = (
        bridge(TriadRecord(each, (t + late)[~gone], rng.normal(0.0, 0.01, (int((~gone).sum()), 3))), number)
        for number, (each, late, gone) in enumerate(((spec, 0.0, lost[0]), (SPEC, late_s, lost[1])))
    )
    problem = SimpleNamespace(
        time_s=np.array([0.0, 10.0]), motion=SimpleNamespace(dcm_body_force=np.eye(3), dcm_body_rate=np.eye(3))
    )
    read_s, _, rates = corrected_series(problem, force, rate, SimpleNamespace(sensor_errors=np.zeros((2, 18))))
    assert np.isin(read_s, t[~lost[0]]).all()
    # those at both ends of a gap are measured
    wanted = t[~lost[0] & ((t <= 6.0 + 1e-9) | (t >= 9.0 + late_s - 1e-9)) & (t >= late_s)]
    assert len(wanted) - 3 <= len(read_s) <= len(wanted)
    assert not ((read_s > 6.0 + 1e-9) & (read_s < 9.0 - 1e-9)).any()
    assert np.abs(rates).max() < 0.06


def test_windows_that_reach_into_a_gap_are_left_out():
    t = np.arange(0.0, 10.0, 0.01)
    t = t[(t <= 4.0) | (t >= 5.0)]
    grid = np.round(np.arange(0.0, 10.0, 0.05), 9)
    whole = grid[windows_are_whole(SimpleNamespace(imu_time_s=t), grid)]
    reach = 2.0 * HALF_WINDOW_S
    assert whole[0] == pytest.approx(reach)
    apart = np.minimum(np.abs(whole - 4.0), np.abs(whole - 5.0))
    assert (apart > reach - 1e-9).all()
    assert not ((whole > 4.0) & (whole < 5.0)).any()
    assert len(whole) == pytest.approx((10.0 - 1.0 - 4.0 * reach) / 0.05, abs=4)
    # ten samples a second in decimal tags are no gaps
    tenths = np.round(np.arange(437.0, 447.0, 0.1), 6)
    assert windows_are_whole(SimpleNamespace(imu_time_s=tenths), np.array([440.05, 441.0])).all()
    assert not windows_are_whole(SimpleNamespace(imu_time_s=tenths[:1]), grid).any()


def test_sensors_too_sparse_for_forces_are_refused_in_words():
    vehicle = SimpleNamespace(cg_m=np.zeros(3))
    telemetry = SimpleNamespace(
        required_vehicle=lambda: vehicle,
        required_triads=lambda: (SimpleNamespace(spec=SPEC), SimpleNamespace(spec=SPEC)),
    )
    t = np.arange(0.0, 20.0, 0.25)
    with refuses("too-few-data", names=("0.25 s",)):
        _air_samples(telemetry, SimpleNamespace(imu_time_s=t, smoothed=SimpleNamespace(time_s=t)))

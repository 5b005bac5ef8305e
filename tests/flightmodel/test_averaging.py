"""Fast records keep integral, noise density, gaps and missing samples as means; coarse ones show their least count."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.instruments import TriadSpec
from flightmodel.sensor_tables import averaged, with_least_count
from flightmodel.telemetry import TriadRecord
from tests.refusing import numbers_in

SPEC = TriadSpec("rates", np.zeros(3), np.eye(3), 0.02, 0.0, 0.0, 0.0, resolution=0.004)


def record(rate_hz, span_s=4.0, seed=0):
    t = 100.0 + np.arange(round(span_s * rate_hz)) / rate_hz
    turning = np.column_stack([np.sin(2 * np.pi * 2.5 * t), 0.3 * np.cos(2 * np.pi * 7.0 * t), np.full(len(t), 0.6)])
    return TriadRecord(SPEC, t, turning + np.random.default_rng(seed).normal(0.0, SPEC.noise_sd, turning.shape))


@pytest.mark.parametrize("rate_hz", [100.0, 400.0, 819.0, 1999.0])
def test_usual_rates_are_used_as_they_are(rate_hz):
    given = record(rate_hz)
    found, told = averaged(given)
    assert found is given
    assert told == []


@pytest.mark.parametrize("rate_hz", [3000.0, 8000.0, 48000.0])
def test_means_keep_integral_and_noise_density(rate_hz):
    given = record(rate_hz)
    found, told = averaged(given)
    count = round(rate_hz / 1000.0)
    assert [finding.code for finding in told] == ["samples-averaged"]
    assert count in numbers_in(told[0].what)
    # every sample is in one mean, and the means lie in the middle of their samples
    np.testing.assert_allclose(
        found.measured_sensor[:100].sum(axis=0) * count, given.measured_sensor[: 100 * count].sum(axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(found.time_s[:100], given.time_s[: 100 * count].reshape(100, count).mean(axis=1))
    density = given.spec.noise_sd**2 / rate_hz
    assert found.spec.noise_sd**2 * np.median(np.diff(found.time_s)) == pytest.approx(density, rel=1e-6)
    # the third axis is steady: what is left of it is noise, of the size that is stated
    assert found.measured_sensor[:, 2].std() == pytest.approx(found.spec.noise_sd, rel=0.05)


def test_missing_samples_and_gaps_stay_so():
    given = record(10000.0)
    values = given.measured_sensor.copy()
    values[5000:5040, 1] = np.nan  # four whole blocks, of one axis
    values[8003, 0] = np.nan  # one sample: its block has nine
    keep = np.ones(len(values), dtype=bool)
    keep[20004:21000] = False  # from within a block
    found, _ = averaged(TriadRecord(SPEC, given.time_s[keep], values[keep]))
    missing = np.isnan(found.measured_sensor)
    assert missing.sum() == 4
    assert missing[500:504, 1].all()
    assert found.measured_sensor[800, 0] == pytest.approx(np.nanmean(values[8000:8010, 0]))
    step = np.diff(found.time_s)
    assert np.flatnonzero(step > 0.01).tolist() == [1999]  # the four samples before the gap make no mean
    assert step[1999] == pytest.approx(0.101, abs=1e-6)


def test_a_rate_that_changes_leaves_the_record_alone():
    fast, slow = record(8000.0, 1.0), record(200.0, 20.0)
    t = np.concatenate([fast.time_s, fast.time_s[-1] + slow.time_s - slow.time_s[0] + 0.005])
    given = replace(fast, time_s=t, measured_sensor=np.vstack([fast.measured_sensor, slow.measured_sensor]))
    assert averaged(given)[0] is given


@pytest.mark.parametrize("step", [0.05, 0.3, 2.5])
def test_readings_in_whole_counts_show_the_count(step):
    """Printed to seven digits in another unit, as files have them; some levels are passed over."""
    given = record(100.0)
    counts = np.round(40.0 * given.measured_sensor / step)
    printed = [[float(f"{x:.7g}") for x in row] for row in counts * step / 9.80665]
    found, findings = with_least_count(replace(given, measured_sensor=9.80665 * np.array(printed)))
    assert found.spec.resolution == pytest.approx(step, rel=1e-3)
    assert [finding.code for finding in findings] == ["least-count"]
    assert replace(found.spec, resolution=given.spec.resolution) == given.spec


def test_noise_shows_no_count_and_a_stated_one_is_no_finding():
    given = record(100.0)
    fine = replace(given, measured_sensor=np.round(given.measured_sensor, 6))
    assert with_least_count(fine) == (fine, [])
    coarse = replace(
        given, spec=replace(SPEC, resolution=0.3), measured_sensor=0.3 * np.round(40.0 * given.measured_sensor / 0.3)
    )
    assert with_least_count(coarse) == (coarse, [])

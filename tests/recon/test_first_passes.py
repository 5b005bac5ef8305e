"""A spin whose phase the gyros' scale leaves open: the first passes find it, and a check says how surely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.trajectory import difference
from recon import first_passes, propagation
from recon.estimate import estimate
from recon.first_passes import SpinPhase
from recon.settings import Settings

SCALE_SD = 0.1  # of a vehicle that turns six times: an angle of 1.9 rad at the peak of the force
SETTINGS = Settings(output_rate_hz=2.0, pulse_rate_hz=0.0)


def with_scale(telemetry, scale):
    """Telemetry whose gyro along the spin axis reads too much by a scale that its data sheet allows."""
    rates = telemetry.rates
    measured = rates.measured_sensor * [1.0 + scale, 1.0, 1.0]
    spec = replace(rates.spec, scale_sd=SCALE_SD)
    return replace(telemetry, rates=replace(rates, spec=spec, measured_sensor=measured))


def errors_of(truth, solution):
    """Attitude errors (n, 3), rad, and their normalised squares."""
    path = solution.smoothed
    error = difference(path, truth.trajectory(path.time_s))[:, 6:9]
    return error, np.einsum("ni,nij,nj->n", error, np.linalg.inv(path.covariance[:, 6:9, 6:9]), error)


@pytest.mark.parametrize("scale", [-0.16, 0.15, 0.23])
def test_a_scale_that_miscounts_the_turns_is_found(mini_sense, mini_truth, scale):
    solution = estimate(with_scale(mini_sense(5)[0], scale), SETTINGS)
    error, square = errors_of(mini_truth, solution)
    table = solution.sensor_errors.set_index("name")
    found, sd = table.loc["rates scale x", ["estimate", "sd"]]
    assert abs(found - scale) < 4.0 * sd + 0.01  # its own error, and that of the sensor as drawn
    assert np.abs(error).max() < np.deg2rad(10.0)
    assert np.median(square) < 3.0 * 4.0
    check = next(c for c in solution.consistency_checks if c.code == "spin-phase")
    assert check.passed
    assert all(c.passed for c in solution.consistency_checks if c.code in ("nis", "whiteness", "data-sheet"))


def test_a_long_flight_s_coarse_parts_lead_to_the_same_phase(mini_sense, monkeypatch):
    """As of an hour's flight: on a fourth of the nodes and motion in steps of a tenth of a radian."""
    nodes = []
    decimated = propagation.decimated

    def seen(motion, node_index, step_s):
        coarse, index = decimated(motion, node_index, step_s)
        nodes.append((len(node_index), len(motion.time_s), len(coarse.time_s)))
        return coarse, index

    monkeypatch.setattr(propagation, "decimated", seen)
    telemetry = with_scale(mini_sense(5)[0], 0.15)
    fine = estimate(telemetry, SETTINGS)
    assert not nodes
    monkeypatch.setattr(first_passes, "_COARSE_NODES", 40)
    coarse = estimate(telemetry, SETTINGS)
    ((few, whole, kept),) = nodes
    assert few < 60
    assert kept < 0.5 * whole
    for solution in (fine, coarse):
        check = next(c for c in solution.consistency_checks if c.code == "spin-phase")
        assert check.passed
    between = difference(fine.smoothed, coarse.smoothed)[:, 6:9]
    assert np.abs(between).max() < 0.02 * fine.smoothed.sd()[:, 6:9].max()


def test_of_parts_that_came_to_one_phase_one_is_compared():
    found = [(-10.0, 4.1, "a"), (-10.2, 4.8, "b"), (-12.0, 21.3, "c"), (-9.0, 3.9, "d"), (-50.0, -5.0, "far off")]
    assert first_passes._likely(found) == ["d", "c"]


def test_decimated_motion_keeps_nodes_integrals_and_noise():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 10.0, 2001))
    t[[0, -1]] = 0.0, 10.0
    phase = 0.7 * t[:, None] + [0.0, 1.0, 2.0]
    force, rate, one = np.sin(phase), np.cos(phase), np.ones((len(t), 3))
    louder = np.where(t[:, None] < 5.0, one, 4.0 * one)
    motion = propagation.strapdown_motion(t, force, rate, one, louder, np.eye(3), np.eye(3))
    nodes = np.array([0, 700, 1400, 2000])
    coarse, index = propagation.decimated(motion, nodes, 0.1)
    np.testing.assert_array_equal(coarse.time_s[index], t[nodes])
    assert 100 < len(coarse.time_s) < 110
    for fine, few in ((force, coarse.force_sensor_mps2), (rate, coarse.rate_sensor_radps)):
        np.testing.assert_allclose(
            np.trapezoid(few, coarse.time_s, axis=0), np.trapezoid(fine, t, axis=0), rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(few, np.column_stack([np.interp(coarse.time_s, t, c) for c in fine.T]), atol=0.04)
    np.testing.assert_array_equal(coarse.rate_density[coarse.time_s < 4.9], 1.0)
    np.testing.assert_array_equal(coarse.rate_density[coarse.time_s > 5.1], 4.0)
    assert propagation.decimated(motion, nodes, 1e-4)[0] is motion


def test_without_the_parts_the_filter_takes_another_phase(mini_sense, mini_truth, monkeypatch):
    monkeypatch.setattr(first_passes, "_chosen_phase", lambda _problem, _engine: (None, None))
    solution = estimate(with_scale(mini_sense(5)[0], 0.23), SETTINGS)
    error, square = errors_of(mini_truth, solution)
    assert np.abs(error).max() > np.deg2rad(30.0) or np.median(square) > 60.0


def test_a_slow_or_well_known_spin_is_linearised_once(mini_sense):
    solution = estimate(mini_sense(5)[0], SETTINGS)
    assert not [c for c in solution.consistency_checks if c.code == "spin-phase"]


def test_phases_that_explain_the_data_alike_fail_the_check():
    assert SpinPhase(9, 2.0, np.inf).check().passed
    assert SpinPhase(9, 2.0, np.log(2000.0)).check().passed
    check = SpinPhase(9, 2.0, np.log(20.0)).check()
    assert not check.passed
    assert (check.code, check.source, check.component) == ("spin-phase", "rates", "scale")

"""A spin whose phase the gyros' scale leaves open: the first passes find it, and a check says how surely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flightmodel.trajectory import difference
from recon import linearisation
from recon.linearisation import SpinPhase
from recon.reconstruct import reconstruct_once
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
    solution = reconstruct_once(with_scale(mini_sense(5)[0], scale), SETTINGS)
    error, square = errors_of(mini_truth, solution)
    table = solution.sensor_errors.set_index("name")
    found, sd = table.loc["rates scale x", ["estimate", "sd"]]
    assert abs(found - scale) < 4.0 * sd + 0.01  # its own error, and that of the sensor as drawn
    assert np.abs(error).max() < np.deg2rad(10.0)
    assert np.median(square) < 3.0 * 4.0
    check = next(c for c in solution.consistency_checks if c.code == "spin-phase")
    assert check.passed
    assert all(c.passed for c in solution.consistency_checks if c.code in ("nis", "whiteness", "data-sheet"))


def test_without_the_parts_the_filter_takes_another_phase(mini_sense, mini_truth, monkeypatch):
    monkeypatch.setattr(linearisation, "_chosen_phase", lambda _problem, _engine: (None, None))
    solution = reconstruct_once(with_scale(mini_sense(5)[0], 0.23), SETTINGS)
    error, square = errors_of(mini_truth, solution)
    assert np.abs(error).max() > np.deg2rad(30.0) or np.median(square) > 60.0


def test_a_slow_or_well_known_spin_is_linearised_once(mini_sense):
    solution = reconstruct_once(mini_sense(5)[0], SETTINGS)
    assert not [c for c in solution.consistency_checks if c.code == "spin-phase"]


def test_phases_that_explain_the_data_alike_fail_the_check():
    assert SpinPhase(9, 2.0, np.inf).check().passed
    assert SpinPhase(9, 2.0, np.log(2000.0)).check().passed
    check = SpinPhase(9, 2.0, np.log(20.0)).check()
    assert not check.passed
    assert (check.code, check.source, check.component) == ("spin-phase", "rates", "scale")

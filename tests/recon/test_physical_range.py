"""An estimate that cannot be: red, and named with the errors that look like it."""

from dataclasses import replace

import numpy as np
import pytest

from recon.estimate import estimate
from recon.fault_isolation import isolate_faults
from recon.reconstruct import reconstruct
from recon.settings import Settings

DEG = np.pi / 180.0
QUICK = Settings(output_rate_hz=2.0)


def planted(telemetry, droop_rad=0.0, refraction=0.0, **stated):
    """Telemetry whose first radar droops, or bends its beam; its file states what is given."""
    record = telemetry.radars["north"]
    elevation = record.range_az_el[:, 2]
    added = droop_rad * np.cos(elevation) + refraction * 3.2e-4 / np.tan(elevation)
    z = record.range_az_el + np.column_stack([0.0 * added, 0.0 * added, added])
    changed = replace(record, range_az_el=z, spec=replace(record.spec, **stated))
    return replace(telemetry, radars=telemetry.radars | {"north": changed})


def ranges(solution):
    return {v.component: v for v in solution.consistency_checks if v.code == "physical-range"}


@pytest.mark.parametrize("seed", [1, 2])
def test_refraction_that_is_left_is_possible(mini_sense, seed):
    solution = estimate(planted(mini_sense(seed)[0], refraction=0.7, refraction_sd=1.0), QUICK)
    assert ranges(solution)["refraction"].passed
    row = solution.sensor_errors.set_index("name").loc["north refraction"]
    assert abs(row.estimate - 0.7) < 4.0 * row.sd


def test_droop_taken_for_negative_refraction_is_named(mini_sense):
    telemetry = planted(mini_sense(3)[0], droop_rad=-0.06 * DEG, refraction_sd=1.0)
    solution = reconstruct(telemetry, QUICK)
    check = ranges(solution)["refraction"]
    assert not check.passed
    assert "droop" in check.remark
    assert "tilt" not in check.remark  # which only shares a mean with it, as biases do
    assert "error-model" in {s.code for s in isolate_faults(solution.consistency_checks, solution.left_out)}


def test_stated_droop_leaves_refraction_possible(mini_sense):
    telemetry = planted(mini_sense(3)[0], droop_rad=-0.06 * DEG, refraction_sd=1.0, droop_sd_rad=0.06 * DEG)
    assert ranges(estimate(telemetry, QUICK))["refraction"].passed


def test_what_is_not_estimated_is_not_judged(mini_sense):
    assert not ranges(estimate(mini_sense(1)[0], QUICK))
    considered = replace(QUICK, consider=("north refraction",))
    assert not ranges(estimate(planted(mini_sense(1)[0], refraction_sd=1.0), considered))

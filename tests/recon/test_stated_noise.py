"""Noise stated too large: the residuals' own is proposed for the data sheet, and no sensor is suspected."""

import pytest

from recon.fault_isolation import isolate_faults
from recon.reconstruct import reconstruct
from tests.recon.conftest import SITES, _truth, sense
from tests.refusing import numbers_in


@pytest.fixture(scope="module")
def truth():
    return _truth()


@pytest.mark.parametrize(("factor", "seed"), [(0.3, 11), (0.6, 12)])
def test_the_noise_that_is_there_is_proposed_and_nothing_is_suspected(truth, factor, seed):
    """Radars that scatter by a fraction of what they state: the proposal is right to a tenth, over 500 points each."""
    telemetry, _ = sense(truth, seed, noise_factor=factor)
    solution = reconstruct(telemetry)
    checks = {c.source: c for c in solution.consistency_checks if c.code == "nis"}
    for site in SITES:
        check = checks[site.name]
        assert not check.passed
        assert check.value < check.low
        assert numbers_in(check.remark) == pytest.approx([factor] * 3, rel=0.1)
    suspects = isolate_faults(solution.consistency_checks, solution.left_out)
    assert {s.code for s in suspects} == {"stated-noise"}
    assert {name for s in suspects for name in s.sources} == {site.name for site in SITES}


def test_noise_stated_too_small_proposes_nothing_and_is_a_fault(truth):
    telemetry, _ = sense(truth, 13, noise_factor=2.0)
    solution = reconstruct(telemetry)
    low = [c for c in solution.consistency_checks if c.code == "nis"]
    assert all(c.value > c.high and not numbers_in(c.remark) for c in low)
    suspects = isolate_faults(solution.consistency_checks, solution.left_out)
    assert suspects
    assert "stated-noise" not in {s.code for s in suspects}

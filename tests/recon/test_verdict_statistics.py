"""Consistency checks fail as often as their confidence states, and their bands are those of the textbook."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from recon.consistency import (
    edit_check,
    held_out_checks,
    left_out_findings,
    mcreynolds_checks,
    nis_check,
    whiteness_check,
)
from recon.settings import Settings
from recon.state import data_sheet_check
from tests.refusing import numbers_in

DRAWS = 4000


def share_failed(consistency_checks):
    return float(np.mean([not v.passed for v in consistency_checks]))


def allowed(probability):
    """Three and a half sd of a share of DRAWS."""
    return 3.5 * np.sqrt(probability * (1.0 - probability) / DRAWS)


@pytest.mark.parametrize("confidence", [0.80, 0.95])
def test_white_residuals_fail_whiteness_as_often_as_stated(confidence):
    # the mean is taken off and lag products end at the ends: the sd of rho is 1/sqrt(n) to 1 % at 400
    rng = np.random.default_rng(11)
    found = [whiteness_check("a", "range", rng.standard_normal(400), confidence) for _ in range(DRAWS)]
    assert share_failed(found) == pytest.approx(1.0 - confidence, abs=allowed(1.0 - confidence) + 0.01)
    # both sides alike
    high = np.mean([v.value > v.high for v in found])
    assert high == pytest.approx(0.5 * (1.0 - confidence), abs=allowed(0.5 * (1.0 - confidence)) + 0.01)
    assert found[0].high == -found[0].low


def test_whiteness_is_the_correlation_of_neighbours():
    # a first-order process with coefficient rho has that at lag one, whatever its size and mean
    rng = np.random.default_rng(3)
    for rho in (-0.4, 0.5):
        x = np.zeros(40000)
        for k in range(1, len(x)):
            x[k] = rho * x[k - 1] + rng.standard_normal()
        assert whiteness_check("a", "range", 7.0 + 3.0 * x, 0.99).value == pytest.approx(rho, abs=0.015)


@pytest.mark.parametrize("components", [1, 3])
def test_nis_of_a_true_model_fails_as_often_as_stated(components):
    # the mean of n chi-squares of c degrees of freedom against its two-sided band
    rng, n, confidence = np.random.default_rng(5), 30, 0.90
    found = [
        nis_check("a", rng.chisquare(components, n), n * components, confidence) for _ in range(DRAWS)
    ]  # fmt: skip
    assert share_failed(found) == pytest.approx(0.10, abs=allowed(0.10))
    assert np.mean([v.value < v.low for v in found]) == pytest.approx(0.05, abs=allowed(0.05))
    assert np.mean([v.value > v.high for v in found]) == pytest.approx(0.05, abs=allowed(0.05))


def test_stated_errors_as_large_as_stated_fail_as_often_as_stated():
    # of five errors the worst is judged: the chance that none is beyond is the confidence (Bonferroni: 1 % of it)
    rng, confidence = np.random.default_rng(7), 0.90
    prior, sd = np.array([1.0, 0.2, 3.0, 1e-3, 5.0]), np.array([0.3, 0.05, 2.0, 4e-4, 1.0])
    spread = np.sqrt(prior**2 - sd**2)
    found = [
        data_sheet_check("data-sheet", "a", "a", list("abcde"), spread * rng.standard_normal(5), prior, sd, confidence)
        for _ in range(DRAWS)
    ]  # fmt: skip
    assert share_failed(found) == pytest.approx(1.0 - confidence, abs=allowed(0.10) + 0.006)
    # what was not learnt is not judged
    assert (
        data_sheet_check("data-sheet", "a", "a", ["b"], np.array([9.0]), np.array([1.0]), np.array([0.99]), confidence)
        is None
    )
    assert (
        data_sheet_check("data-sheet", "a", "a", ["b"], np.array([9.0]), np.array([1.0]), np.array([0.97]), confidence)
        is not None
    )


def test_filter_and_smoother_differ_by_the_difference_of_their_covariances():
    # with a confidence of 0.973 three sd of P_filter - P_smoother: of normal differences 0.27 % lie beyond
    rng = np.random.default_rng(9)
    n, confidence = 3000, 1.0 - 10.0 * 0.0026998
    smoother = np.tile(np.diag(np.full(9, 4.0)), (n, 1, 1))
    filtered = smoother + np.tile(np.diag(np.full(9, 9.0)), (n, 1, 1))
    draws = 3.0 * rng.standard_normal((n, 9))
    for consistency_check in mcreynolds_checks(
        draws, filtered, smoother, ["position", "velocity", "attitude"], confidence
    ):
        assert consistency_check.value == pytest.approx(0.9973, abs=0.0025)
    # a tenth may stay beyond, no more
    for share, passes in ((0.08, True), (0.12, False)):
        one = np.where(np.arange(n)[:, None] < share * n, 9.1, 8.9) * np.ones(9)
        assert {v.passed for v in mcreynolds_checks(one, filtered, smoother, ["velocity"], confidence)} == {passes}


def test_differences_that_never_change_are_red_no_more_often_than_stated():
    """All of a flight's differences may be one draw, as of a prior of the attitude to the first force."""
    rng, n, smoother = np.random.default_rng(10), 20, np.tile(np.eye(9), (20, 1, 1))
    for confidence in (0.9, 0.99):
        red = [
            not mcreynolds_checks(
                np.tile(rng.standard_normal(9), (n, 1)), 2.0 * smoother, smoother, ["attitude"], confidence
            )[0].passed
            for _ in range(3000)
        ]
        assert 0.1 < np.mean(red) / (1.0 - confidence) < 1.0


def test_more_than_a_twentieth_edited_is_told():
    for bad, passes in ((4, True), (6, False)):
        accepted = np.arange(100) >= bad
        consistency_check = edit_check("a", accepted)
        assert consistency_check.value == pytest.approx(bad / 100.0)
        assert consistency_check.passed is passes


def test_held_out_points_beyond_the_gate_turn_the_check_red():
    rng = np.random.default_rng(3)
    instruments = (SimpleNamespace(name="gps", owner="gps"), SimpleNamespace(name="gps velocity", owner="gps"))
    problem = SimpleNamespace(instruments=instruments)
    rows = [
        (t, name, c, rng.standard_normal(), 1.0) for t in range(40) for name in ("gps", "gps velocity") for c in "ned"
    ]
    table = pd.DataFrame(rows, columns=["time_s", "source", "component", "residual", "predicted_sd"])
    settings = Settings(hold_out_every=2)
    assert [v.passed for v in held_out_checks(problem, table, settings)] == [True, True]
    # three points of forty, one component of each: a point is counted once
    bad = (table.source == "gps velocity") & (table.component == "e") & (table.time_s < 3)
    table.loc[bad, "residual"] = -6.0
    good, far = held_out_checks(problem, table, settings)
    assert good.passed
    assert not far.passed
    assert (far.code, far.source, far.value) == ("held-out", "gps", pytest.approx(3 / 40))
    assert held_out_checks(problem, table, Settings(hold_out_every=2, without=("gps",))) == []
    # of a tracker that is left out altogether a finding says it
    (finding,) = left_out_findings(problem, table, Settings(without=("gps",)))
    assert (finding.code, finding.source, finding.start_s, finding.end_s) == (
        "left-out-disagrees", "gps velocity", 0.0, 2.0,
    )  # fmt: skip
    assert numbers_in(finding.what) == [3.0, 40.0, 6.0, 0.0]
    assert left_out_findings(problem, table, Settings(hold_out_every=2)) == []
    assert held_out_checks(problem, table, Settings()) == []

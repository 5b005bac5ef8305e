"""Limits of the score: the run's own standard deviations, whatever the vehicle and the size of its errors, and limits
in a unit, which bound what a run may not know.
"""

import json

import numpy as np
import pandas as pd
import pytest

from flightmodel import earth
from flightmodel.checks import GateError
from postflight.commands import console, print_score
from postflight.scoring import SCORED, Limits, score_run
from tests.refusing import refuses

OTHERS = ("camera", "misalignment", "fused")  # which have no answer here
T = np.arange(0.0, 20.0, 0.1)


def table(position_m=0.0, velocity_mps=0.0):
    place = earth.ecef_from_geodetic(0.6, -1.3, 4e4)
    columns = {"t_s": T}
    for k, a in enumerate("xyz"):
        columns |= {f"r{a}_ecef_m": place[k] + position_m + 0.0 * T, f"v{a}_ecef_mps": velocity_mps + 0.0 * T}
    columns |= {f"q{a}_ecef_body": float(a == "w") + 0.0 * T for a in "wxyz"}
    return columns | {f"{a}_body_degps": 0.0 * T for a in "pqr"}


@pytest.fixture
def flight(tmp_path):
    """Write a flight of which nothing is there but what the score reads; errors and sds as asked for."""

    def write(error=0.0, sd=1.0, position_m=0.0, position_sd_m=1.0, vehicle="irve2_reference", **limits):
        truth, run = tmp_path / "truth", tmp_path / "runs" / "20260101T000000Z-00000000"
        for folder in (truth, run):
            folder.mkdir(parents=True, exist_ok=True)
        pressure = 1e3 * np.exp(-(((T - 10.0) / 4.0) ** 2))
        true = table() | {"dynamic_pressure_pa": pressure, "alpha_body_deg": 3.0 + 0.0 * T}
        pd.DataFrame(true).to_csv(truth / "truth.csv", index=False)
        pd.DataFrame({"t_s": T, "theta_deg": 2.0 + 0.0 * T}).to_csv(truth / "deflection.csv", index=False)
        stated = {f"r{a}_ecef_sd_m": position_sd_m + 0.0 * T for a in "xyz"}
        stated |= {f"v{a}_ecef_sd_mps": 0.1 + 0.0 * T for a in "xyz"} | {"alpha_total_wind_sd_deg": 0.1 + 0.0 * T}
        bet = table(position_m) | {"alpha_total_wind_deg": 3.0 + 0.0 * T} | stated
        pd.DataFrame(bet).to_csv(run / "bet.csv", index=False)
        answer = {"t_s": T, "theta_deg": 2.0 + error, "plane_lv_deg": 0.0 * T, "theta_sd_deg": sd + 0.0 * T}
        pd.DataFrame(answer).to_csv(run / "deflection_trim.csv", index=False)
        others = {name: {"applicable": False, "reason": "-"} for name in OTHERS}
        (run / "summary.json").write_text(json.dumps({"methods": others, "peak_dynamic_pressure_s": 10.0}))
        (run / "bet_header.json").write_text(json.dumps({"vehicle": {"name": vehicle}}))
        (run / "run.json").write_text(json.dumps({"settings": {}}))
        return score_run(tmp_path, run, Limits(**{"without": OTHERS} | limits))

    return write


@pytest.mark.parametrize("sd", [0.01, 1.0, 30.0])
def test_an_error_is_judged_by_its_own_standard_deviation(flight, sd):
    assert not flight(error=3.9 * sd, sd=sd).failures
    assert [f.code for f in flight(error=-4.1 * sd, sd=sd).failures] == ["deflection-error"]
    (missing,) = flight(error=0.0, sd=np.nan).failures
    assert (missing.code, missing.source) == ("deflection-missing", "trim")


@pytest.mark.parametrize("sd", [0.3, 50.0])
def test_so_is_the_trajectory(flight, sd):
    """All three components off by as many of their sds."""
    right, wrong = (flight(position_m=k * sd, position_sd_m=sd) for k in (3.9, 4.1))
    assert not right.failures
    assert right.bet["position_sd_m"] == pytest.approx(np.sqrt(3.0) * sd)
    assert [f.code for f in wrong.failures] == ["trajectory-error"]


@pytest.mark.parametrize("content", ["", "[]", '{"methods": 3}'])
def test_a_summary_that_is_damaged_is_refused(flight, tmp_path, content):
    flight()
    (run,) = (tmp_path / "runs").iterdir()
    (run / "summary.json").write_text(content)
    with pytest.raises(GateError) as refusal:
        score_run(tmp_path, run)
    assert refusal.value.codes == ("run-incomplete",)


def test_published_figures_stand_beside_their_own_vehicle_alone(flight):
    for vehicle, there in (("irve2_reference", True), ("loftid", False)):
        with console.capture() as shown:
            print_score(flight(vehicle=vehicle))
        assert ("paper" in shown.get()) == there


def test_a_method_without_an_answer_fails_unless_it_is_named(flight):
    failures = flight(without=("camera",)).failures
    assert [(f.code, f.source) for f in failures] == [("deflection-missing", m) for m in OTHERS[1:]]
    assert not flight(without=OTHERS).failures
    with refuses("name-unknown", names=("'camara'", "'camera'")):
        flight(without=("camara",))


def test_an_attitude_that_is_missing_is_named_too(flight, tmp_path):
    flight()
    (run,) = (tmp_path / "runs").iterdir()
    table = pd.read_csv(run / "bet.csv").assign(alpha_total_wind_sd_deg=np.nan)
    table.to_csv(run / "bet.csv", index=False)
    (missing,) = score_run(tmp_path, run, Limits(without=OTHERS)).failures
    assert (missing.code, missing.source) == ("trajectory-missing", "alpha_total")
    assert not score_run(tmp_path, run, Limits(without=(*OTHERS, "alpha_total"))).failures


def test_a_run_does_not_pass_by_knowing_nothing(flight):
    """An answer that is less certain than the limit passes any number of its own sd, and cannot show the limit kept."""
    for error in (0.0, 3.0, 60.0):
        assert not flight(error=error, sd=30.0).failures
        codes = [f.code for f in flight(error=error, sd=30.0, deg=0.5).failures]
        assert codes == ["deflection-error"] * (error > 0.5) + ["sd-above-limit"]
    assert not flight(error=0.4, sd=0.49, deg=0.5).failures
    assert [f.code for f in flight(error=0.51, sd=0.4, deg=0.5).failures] == ["deflection-error"]


@pytest.mark.parametrize("limits", [{"m": 5.0}, {"mps": 0.1}, {"deg": 0.05}])
def test_a_limit_holds_for_every_quantity_in_its_unit(flight, limits):
    ((unit, limit),) = limits.items()
    found = flight(sd=0.01, position_sd_m=10.0, **limits)
    quantity = {"m": "position", "mps": "velocity", "deg": "alpha_total"}[unit]
    assert {f.source for f in found.failures} == {quantity}
    assert all(f.code == "sd-above-limit" for f in found.failures)
    assert found.quantities().set_index("quantity").loc[quantity, "limit"] == limit


@pytest.mark.parametrize("limit", [np.nan, -1.0])
def test_a_limit_that_is_none_lets_nothing_pass(flight, limit):
    assert len(flight(sd=0.1, deg=limit).failures) == 4  # error and sd of trim and of the angle of attack


def test_json_and_assertion_have_every_quantity_with_its_limits(flight):
    found = flight(error=0.6, sd=0.4, deg=0.5)
    said = json.loads(json.dumps(found.as_json(), allow_nan=False))
    rows = {row["quantity"]: row for row in said["quantities"]}
    assert tuple(rows) == SCORED
    trim = {"quantity": "trim", "unit": "deg", "truth": 2.0, "error": 0.6, "sd": 0.4, "limit_sd": 4.0, "limit": 0.5}
    assert rows["trim"] == pytest.approx(trim | {"passed": False})
    assert rows["camera"]["error"] is None
    assert rows["camera"]["passed"]
    assert (said["passed"], said["failure_codes"]) == (False, ["deflection-error"])
    with pytest.raises(AssertionError) as failed:
        found.assert_recovered(limit_sd=4, limit_deg=0.5, without=OTHERS)
    lines = str(failed.value).splitlines()
    assert [name for name in SCORED if any(line.split()[0] == name for line in lines[2:9])] == list(SCORED)
    assert lines[9:] == list(found.failures)
    found.assert_recovered(limit_deg=0.7, without=list(OTHERS))
    with refuses("name-unknown"):
        found.assert_recovered(without="camera")  # a text is not a list of names

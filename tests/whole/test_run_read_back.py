"""A finished run is read back as it was computed, and every figure takes what a notebook has at hand."""

from __future__ import annotations

import shutil
from dataclasses import fields, replace

import numpy as np
import pytest

import postflight as pf
from flightmodel.checks import GateError

pytestmark = pytest.mark.slow
WRITTEN = 1e-9  # ten digits are written

# which objects have what a figure draws; the film's frames are there with any camera's answer
BETS = {"bet", "answer", "run", "run_answer"}
LOADS = {"loads", "loads_answer"}
ANSWERS = {"answer", "run", "run_answer"}
POSTERIORS = {"answer", "loads_answer"}
DRAWN = {
    "figure_1_3": BETS,
    "figure_2_3": ANSWERS,
    "figure_2_5": BETS | LOADS,
    "figure_2_7": ANSWERS | {"loads_answer"},
    "figure_2_9": BETS | LOADS,
    "figure_air": BETS,
    "figure_attitude": set(),  # of a flight without magnetometer
    "figure_bands": set(),
    "figure_correlation": POSTERIORS,
    "figure_deflection": ANSWERS | {"loads_answer", "history"},
    "figure_filter_and_smoother": {"bet", "answer"},
    "figure_flown": BETS,
    "figure_fusion": POSTERIORS,
    "figure_increments": {"answer"},
    "figure_joints": set(),
    "figure_modes": set(),
    "figure_posterior": set(),
    "figure_preflight": set(),
    "figure_reconciled": set(),
    "figure_residuals": BETS,
    "figure_sensitivity": {"bet", "answer"},
    "figure_summary": ANSWERS | {"loads_answer"},
    "figure_table_3_1": set(),
    "figure_vehicle": set(),
}


@pytest.fixture(scope="module")
def at_hand(short):
    """What a notebook has: by name."""
    bet = pf.reconstruct(pf.read_flight(short))
    run, answer = pf.read_run(short), pf.fuse(bet)
    loads = pf.read_loads(run.path / "bet.csv", bet.flight.vehicle)
    return {
        "folder": str(short), "flight": bet.flight, "bet": bet, "answer": answer, "run": run,
        "run_answer": run.deflections, "loads": loads, "loads_answer": pf.fuse(loads), "history": answer["fused"],
    }  # fmt: skip


def test_every_figure_is_listed():
    assert set(DRAWN) == {name for name in pf.plots.__all__ if name.startswith("figure_")}


@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_takes_what_has_its_parts_and_refuses_the_rest_in_words(at_hand, name):
    for kind, given in at_hand.items():
        if kind in DRAWN[name]:
            assert getattr(pf.plots, name)(given).get_axes(), kind
            continue
        with pytest.raises(GateError) as fault:
            getattr(pf.plots, name)(given)
        assert fault.value.codes == ("argument-type",), kind
        assert "pass " in str(fault.value) or "wanted (" in str(fault.value), kind


def test_a_second_argument_adds_what_the_first_lacks(at_hand):
    bet, answer, loads = at_hand["bet"], at_hand["answer"], at_hand["loads"]
    for history in (answer["fused"], answer["camera"], at_hand["run"].deflections["trim"]):
        assert pf.plots.figure_2_7(bet, history).get_axes()
    assert pf.plots.figure_2_7(loads, answer["fused"]).get_axes()
    assert pf.plots.figure_2_3(bet.flight, answer["camera"]).get_axes()
    assert pf.plots.figure_summary(loads, at_hand["loads_answer"]).get_axes()


def test_a_method_without_an_answer_is_refused_with_its_reason(at_hand):
    without = replace(at_hand["answer"], histories={}, refused={})
    with pytest.raises(GateError) as fault:
        pf.plots.figure_2_7(without)
    assert fault.value.codes == ("input-missing",)


def test_trajectory_and_air_are_those_that_were_computed(at_hand):
    bet, run = at_hand["bet"], at_hand["run"]
    np.testing.assert_allclose(run.trajectory.sd(), bet.trajectory.sd(), rtol=WRITTEN)
    apart = np.abs(run.trajectory.minus(bet.trajectory)).max(axis=0)
    assert (apart < np.repeat([1e-3, 1e-5, 1e-8], 3)).all()
    assert run.trajectory.epoch_utc == bet.trajectory.epoch_utc
    assert run.peak_s == pytest.approx(bet.peak_s)
    assert run.pulse_s == pytest.approx(bet.pulse_s)
    # the table has the path angle of another point, and the sd of the pressure not to first order
    np.testing.assert_allclose(run.air.dynamic_pressure_sd_pa, bet.air.dynamic_pressure_sd_pa, rtol=0.01)
    other = {"air", "lateral_flow_cov", "flight_path_angle_rad", "dynamic_pressure_sd_pa"}
    for name in (field.name for field in fields(bet.air) if field.name not in other):
        ours, theirs = getattr(run.air, name), getattr(bet.air, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-8 * np.abs(theirs).max(), err_msg=name)
    np.testing.assert_allclose(run.air.air.density_kgpm3, bet.air.air.density_kgpm3, rtol=WRITTEN)
    np.testing.assert_allclose(run.air.air.wind_ned_mps, bet.air.air.wind_ned_mps, atol=1e-7)


def test_deflections_are_those_that_were_computed(at_hand):
    run, answer = at_hand["run"], at_hand["answer"]
    assert list(run.deflections) == list(answer) == ["camera", "misalignment", "trim", "fused"]
    for method in answer:
        ours, theirs = run.deflections[method].to_frame(), answer[method].to_frame()
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-9, err_msg=method)
    ours, theirs = (found.to_frame().drop(columns=["method", "reason"]) for found in (run.deflections, answer))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_loads_of_a_run_give_its_deflection(at_hand):
    run = at_hand["run"]
    found, sd = pf.estimate_misalignment(run.loads).angle_at(run.peak_s)
    stated = run.deflections["misalignment"].angle_at(run.peak_s)[0]
    assert abs(found - stated) < 0.1 * sd


def test_an_unknown_method_is_named_with_those_that_answered(at_hand):
    with pytest.raises(KeyError, match=r"did you mean 'camera'.*camera, misalignment, trim"):
        at_hand["run"].deflections["camra"]
    assert "trim" in at_hand["answer"]
    assert "radar" not in at_hand["answer"]


def test_a_run_s_flight_has_its_changed_assumptions(at_hand):
    plain = at_hand["run"]
    changes = ["c_n = 1.2", "wind = None", "cg_shift_body_m = [0.0, 0.001, 0.0]", "engine = filterpy", "c_n = 0.5"]
    changed = replace(plain, facts=plain.facts | {"settings": plain.facts["settings"] | {"changes": changes}})
    ours, was = changed.flight.vehicle, plain.flight.vehicle
    assert ours.aero.at(5.0, 0.1)[1] == pytest.approx(0.6 * was.aero.at(5.0, 0.1)[1])
    assert ours.cg_m[1] - was.cg_m[1] == pytest.approx(0.001)
    assert changed.flight.settings.engine == "filterpy"
    assert "c_n = 0.5" in repr(changed)


def test_a_run_is_read_by_its_own_folder_and_its_telemetry_must_be_the_same(at_hand, tmp_path):
    run = at_hand["run"]
    copy = shutil.copytree(run.path, tmp_path / "flight" / "runs" / run.path.name)
    assert len(pf.read_run(copy).trajectory.time_s) == len(run.trajectory.time_s)
    toml = (run.path / "inputs" / "flight.toml").read_text()
    with pytest.raises(GateError):  # its flight is not there
        _ = pf.read_run(copy).loads
    (tmp_path / "flight" / "flight.toml").write_text(toml)
    assert pf.plots.figure_flown(pf.read_run(copy)).get_axes()


def test_an_answer_at_a_time_has_names_and_degrees(at_hand):
    history = at_hand["answer"]["fused"]
    at_s = at_hand["bet"].peak_s
    found = history.at(at_s)
    assert list(found.index) == ["t_s", "theta_deg", "theta_sd_deg", "plane_lv_deg", "plane_sd_deg"]
    assert (found["theta_deg"], found["theta_sd_deg"]) == pytest.approx(np.rad2deg(history.angle_at(at_s)))
    near = history.to_frame().set_index("t_s")["plane_lv_deg"]
    assert found["plane_lv_deg"] == pytest.approx(np.interp(at_s, near.index, near), abs=0.5)
    assert history.at(history.time_s[0] - 1.0).drop("t_s").isna().all()
    assert len(history.plot().get_axes()) == 2

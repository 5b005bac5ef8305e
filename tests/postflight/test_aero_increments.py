"""Aerodynamic increments as a run leaves them: the table, its correlations, the table as flown, and when it is red."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from estimators.fusing import CameraTimeBias, fuse_flight
from estimators.increments import COEFFICIENTS, STATED
from flightmodel.aerodynamics import read_with_sidecar, referred_to
from flightmodel.checks import DivergenceError, GateError, Issue
from flightmodel.vehicle import DATA, vehicle_from_toml
from postflight import flown_coefficients
from postflight.deflections import Deflections, aero_increments, with_increments
from postflight.flown_coefficients import TABLE, increments_of
from postflight.plots.deflection import figure_increments
from postflight.reconstruction import Reconstruction
from postflight.run_folder import increments_summary
from tests.estimators.conftest import VEHICLE
from tests.estimators.test_increments import PROCESSES, SD, flown, flown_with

DOCS = Path(__file__).parents[2] / "docs" / "aero-increments.md"
CONFIDENCE = 0.999


@cache
def answer():
    return fuse_flight(flown(), None)


@cache
def found():
    return increments_of(answer(), CONFIDENCE, "twelve seconds")


def constant(k, size):
    """Increments (4, k) of one coefficient's factor, in its stated sd."""
    out = np.zeros((4, len(PROCESSES.log_mach)))
    out[k] = size * SD[k]
    return out


def test_the_page_names_exactly_the_columns():
    section = DOCS.read_text().split("## `aero_increments.csv`")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    names = [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]
    named = [n.replace("<c>", c) for n in names for c in (STATED if n.startswith("<c>") else ("",))]
    assert set(named) == set(found().to_frame().columns)


def test_the_frame_s_numbers_are_the_posterior_s():
    table, one = found().to_frame(), found().found
    for k, name in enumerate(STATED):
        scale = 1.0 if name == "cmq" else table[f"{name}_preflight"]
        seen = found().determined[k]
        want = np.where(seen, one.mean[k], np.nan)
        np.testing.assert_allclose(table[f"{name}_increment"] / scale, want, rtol=1e-9)
        np.testing.assert_allclose(table[f"{name}_increment_sd"] / np.abs(scale), np.where(seen, found().sd[k], np.nan))
        np.testing.assert_allclose(table[f"{name}_prior_sd"] / np.abs(scale), SD[k])
    assert (np.diff(table["mach"]) > 0.0).all()
    assert (np.diff(table["t_s"]) < 0.0).all()
    # C_m of a stable shell is negative: its increment's sign is the other of its fraction's
    knots = len(one.mach)
    own = one.covariance[0, 2 * knots] / (found().sd[0, 0] * found().sd[2, 0])
    assert table["correlation_ca_cm"].iloc[0] == pytest.approx(-own)
    assert found().correlations()["cm_" + f"{one.mach[0]:.3f}"].iloc[0] == pytest.approx(own)


def test_what_the_flight_does_not_determine_is_empty():
    """Without a camera an increment of C_N hides behind the deflection."""
    table = found().to_frame()
    seen = found().determined
    assert not seen[COEFFICIENTS.index("C_N")].any()
    assert table["cn_increment"].isna().all()
    assert table["cm_increment"].notna().all()
    assert found().summary()["cn"]["increment"] is None
    assert "C_N" not in found().about


def test_the_table_as_flown_is_a_vehicle_s_table(tmp_path):
    found().write_table(tmp_path)
    table, sidecar = read_with_sidecar(tmp_path / f"{TABLE}.csv")
    table = referred_to(table, sidecar, VEHICLE.reference.area_m2, VEHICLE.reference.length_m)
    mach, alpha = np.array([0.0, 1.0, 1.7, 2.3, 3.1, 6.0]), np.deg2rad([0.0, 3.3, 12.0, 80.0])
    want = found().table.at(mach[:, None], alpha)
    np.testing.assert_allclose(table.at(mach[:, None], alpha), want, rtol=1e-8, atol=1e-9)
    left = np.sqrt(np.mean(found().sd ** 2, axis=1))
    assert (sidecar.uncertainty.ca, sidecar.uncertainty.cm) == pytest.approx((left[0], left[2]), abs=1e-4)
    # a vehicle file that names it
    text = (DATA / "vehicles" / "irve2_reference.toml").read_text()
    (tmp_path / "flown.toml").write_text(text.replace("irve2_reference.csv", f"{TABLE}.csv"))
    vehicle = vehicle_from_toml(tmp_path / "flown.toml")
    np.testing.assert_allclose(vehicle.aero.at(2.3, 0.1), found().table.at(2.3, 0.1), rtol=1e-8)


def test_a_table_as_it_is_passes():
    checks = found().consistency_checks
    assert {check.code for check in checks} == {"aero-increment"}
    assert all(check.passed for check in checks)


@pytest.mark.parametrize(("k", "name"), [(0, "C_A"), (2, "C_m")])
def test_a_table_that_is_wrong_turns_red_and_is_named(k, name):
    loads = flown_with(constant(k, 7.0))
    # of a density that is not known a wrong C_A shows nothing
    loads = replace(loads, dynamic_pressure_sd_pa=0.01 * loads.dynamic_pressure_pa)
    checks = increments_of(fuse_flight(loads, None), CONFIDENCE, "off").consistency_checks
    red = [check for check in checks if not check.passed]
    assert [check.component.split(" at ")[0] for check in red] == [name]


def test_answers_carry_increments_or_why_there_are_none():
    bet = object.__new__(Reconstruction)
    none = Deflections(bet=bet, refused={"fused": Issue("no loads", "input-missing")})
    assert with_increments(none) is none
    assert increments_summary(none) is None
    with pytest.raises(GateError) as refused:
        aero_increments(bet, none)
    assert refused.value.codes == ("input-missing",)
    with pytest.raises(GateError) as refused:
        aero_increments(object.__new__(Reconstruction), none)
    assert refused.value.codes == ("argument-value",)
    why = Issue("they do not settle", "not-converged")
    assert increments_summary(replace(none, no_increments=why))["code"] == why.code
    whole = replace(none, fused=answer(), increments=found())
    assert "aero-increment" in {check.code for check in whole.consistency_checks}
    assert increments_summary(whole)["mach"] == found().summary()["mach"]


def test_without_increments_a_late_film_is_said_first(monkeypatch):
    """The reader is sent to the film's time tags, not to the coefficient table alone."""

    def unsettled(*_):
        raise DivergenceError("they do not settle", code="not-converged")

    monkeypatch.setattr(flown_coefficients, "increments_of", unsettled)
    settings = SimpleNamespace(check_confidence=CONFIDENCE)
    bet = SimpleNamespace(solution=SimpleNamespace(settings=settings), telemetry=SimpleNamespace(name="late"))
    late, on_time = (CameraTimeBias(offset, 0.01, False) for offset in (1.0, 0.0))
    for bias, first in ((late, late.cause), (on_time, "they do not settle")):
        said = with_increments(Deflections(bet=bet, fused=replace(answer(), camera_time_bias=bias))).no_increments
        assert said.code == "not-converged"
        assert str(said).startswith(first)
    assert late.cause


def test_the_figure_shows_what_is_determined():
    figure = figure_increments(found())
    axes = dict(zip(COEFFICIENTS, figure.axes, strict=True))
    for k, name in enumerate(COEFFICIENTS):
        shown = next(line for line in axes[name].lines if line.get_label() == "in flight")
        scale = 1.0 if name == "C_mq" else 100.0
        want = np.where(found().determined[k], scale * found().found.mean[k], np.nan)
        np.testing.assert_allclose(shown.get_ydata(), want)
    assert [name for name, ax in axes.items() if ax.texts] == ["C_N"]

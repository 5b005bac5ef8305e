"""Sobol indices through the design's own runs: closed forms, the library's estimator, a study of flights."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import sobol_indices

from flightmodel.checks import ConfigError, GateError
from postflight.montecarlo import commands, execution
from postflight.montecarlo.study import design_for, indices, read_study, sobol_study
from tests.refusing import refuses

from .short_flights import write_short

A, B = 7.0, 0.1
# of Ishigami's function (Ishigami and Homma, 1990): first order and total in closed form
V1, V2, V13 = 0.5 * (1.0 + B * np.pi**4 / 5.0) ** 2, A**2 / 8.0, B**2 * np.pi**8 * 8.0 / 225.0
TRUE_FIRST = np.array([V1, V2, 0.0]) / (V1 + V2 + V13)
TRUE_TOTAL = np.array([V1 + V13, V2, V13]) / (V1 + V2 + V13)


def ishigami(u):
    x, y, z = (np.pi * (2.0 * u[name] - 1.0) for name in ("a.x", "b.y", "b.z"))
    return np.sin(x) + A * np.sin(y) ** 2 + B * z**4 * np.sin(x)


def flown(design, function):
    return np.array([function(design.draws_of(run)) for run in range(design.flights)])


@pytest.fixture(scope="module")
def design():
    return design_for(("a.x", "b.y", "b.z"), "factor", 1024, seed=3)


def test_ishigami_is_recovered_within_its_intervals(design):
    table, left_out = indices(design, flown(design, ishigami))
    assert left_out == 0
    assert table["factor"].tolist() == ["a.x", "b.y", "b.z"]
    for name, truth in (("first", TRUE_FIRST), ("total", TRUE_TOTAL)):
        # the bootstrap's 95 % are two standard deviations to both sides: four are allowed
        sd = (table[f"{name}_high_95"] - table[f"{name}_low_95"]) / 3.92
        assert (np.abs(table[name] - truth) < 4.0 * sd).all(), name
        assert sd.max() < 0.1


def test_estimates_are_the_librarys(design):
    values = flown(design, ishigami).reshape(5, -1)
    found = sobol_indices(func={"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, None]}, n=design.base)
    table, _ = indices(design, values.ravel())
    np.testing.assert_allclose(table["first"], found.first_order, atol=1e-12)
    np.testing.assert_allclose(table["total"], found.total_order, atol=1e-12)


def test_a_section_is_one_column():
    grouped = design_for(("a.x", "b.y", "b.z"), "section", 1024, seed=3)
    assert grouped.names == ("a", "b")
    assert grouped.flights == 4096
    table, _ = indices(grouped, flown(grouped, ishigami))
    first = np.array([V1, V2]) / (V1 + V2 + V13)
    sd = (table["first_high_95"] - table["first_low_95"]) / 3.92
    assert (np.abs(table["first"] - first) < 4.0 * sd).all()


def test_a_profile_is_a_factor_like_another(design):
    """A factor that is a whole random structure, by the digits of its draw: half of the variance is its own."""

    def noisy(u):
        seed = int(u["b.y"] * 2.0**53)
        return np.random.default_rng(seed).standard_normal() + np.sqrt(12.0) * (u["a.x"] - 0.5)

    table, _ = indices(design, flown(design, noisy))
    sd = (table["total_high_95"] - table["total_low_95"]) / 3.92
    np.testing.assert_array_less(np.abs(table["total"] - [0.5, 0.5, 0.0]), 4.0 * sd + 1e-12)


def test_points_with_a_failed_flight_are_left_out(design):
    values = flown(design, ishigami)
    values[[3, 1024 + 3, 2048 + 70]] = np.nan
    table, left_out = indices(design, values)
    assert left_out == 2
    assert np.abs(table["total"] - TRUE_TOTAL).max() < 0.2
    with pytest.raises(GateError) as refusal:
        indices(design, np.full(design.flights, 1.0))
    assert refusal.value.codes == ("sobol-spread",)


@pytest.mark.parametrize(("by", "base", "factors"), [("factor", 100, "ab"), ("factor", 4, "ab"), ("section", 64, "a")])
def test_designs_that_cannot_be_are_refused(by, base, factors):
    with pytest.raises(ConfigError):
        design_for(tuple(f"{name}.x" for name in factors), by, base, 0)


def test_a_study_of_flights(tmp_path):
    path = write_short(tmp_path)
    commands.sobol_indices(str(path), tmp_path / "study", "peak_deflection_deg", 16, "section", 1, None)
    table = pd.read_csv(tmp_path / "study" / "sobol.csv")
    assert set(table["factor"]) == {"initial", "mass", "aerodynamics", "joint", "atmosphere"}
    assert set(table["output"]) == {"peak_deflection_deg", "peak_normal_g", "deflection_deg_at_peak_pressure"}
    assert (tmp_path / "study" / "sobol.png").stat().st_size > 5000
    # runs of the design that differ in one section alone
    study, flights = execution.study_of(tmp_path / "study")
    assert flights == 16 * 7
    a, mixed = study.draws_of(3), study.draws_of(2 * 16 + 3)
    assert {name.split(".")[0] for name in a if a[name] != mixed[name]} == {"initial"}
    with refuses("study-differs", names=[r"'sobol\.base'.*\b16\b.*\b32\b"], kind=ConfigError):
        execution.begin(sobol_study(read_study(str(path)), "section", 32), tmp_path / "study", 224)

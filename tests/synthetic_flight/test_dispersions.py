"""Draws that do not know of each other, and dispersed flights that are the flights of the simulator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, lognorm, norm

from flightmodel.checks import ConfigError, GateError
from flightmodel.config import parse_section
from synthetic_flight import simulate
from synthetic_flight.dispersions import (
    AirDispersions,
    Dispersions,
    Factor,
    InitialDispersions,
    JointDispersions,
    MassDispersions,
    Shift,
    Window,
    dispersed_case,
    draws,
)
from synthetic_flight.ensemble import QUANTITIES, Plan, Start, fly_legs, fly_runs, legs, records_of, scalars_of
from synthetic_flight.scenarios import child_rng, fly_scenario, initial_state, read_scenario
from synthetic_flight.weather import day_of_flight_atmosphere
from tests.postflight.short_flights import write_short
from tests.refusing import refuses

WINDOW = Window(from_s=402.0, to_s=410.0, record_s=0.02, history_s=0.1)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    folder = tmp_path_factory.mktemp("short")
    write_short(folder)
    return read_scenario(str(folder / "short.toml"))


def test_another_factor_leaves_the_others_draws_as_they_are():
    few = Dispersions(mass=MassDispersions(offset_y_m=Shift(normal=0.001)))
    many = Dispersions(
        mass=MassDispersions(aeroshell_mass=Factor(normal=0.01), offset_y_m=Shift(normal=0.001)),
        joint=JointDispersions(stiffness=Factor(lognormal=0.1)),
    )
    for run in (0, 17, 123456):
        assert draws(few, 3, run).items() <= draws(many, 3, run).items()
    assert draws(few, 3, 0) != draws(few, 4, 0)


def test_draws_are_uniform_and_do_not_know_of_each_other():
    names = Dispersions(
        mass=MassDispersions(offset_y_m=Shift(normal=1.0), offset_z_m=Shift(normal=1.0)),
        joint=JointDispersions(stiffness=Factor(normal=1.0)),
    )
    u = np.array([list(draws(names, 0, run).values()) for run in range(2000)])
    for column in u.T:
        assert kstest(column, "uniform").pvalue > 1e-4
    # of neighbours in factor and in run; four standard deviations of no correlation
    across = np.corrcoef(np.column_stack([u[1:], u[:-1]]).T) - np.eye(2 * u.shape[1])
    assert np.abs(across).max() < 4.0 / np.sqrt(len(u))


def test_laws_are_what_they_say():
    u = np.array([0.023, 0.5, 0.977])
    np.testing.assert_allclose([Shift(normal=2.0).at(x) for x in u], norm.ppf(u, scale=2.0))
    np.testing.assert_allclose([Shift(uniform=(-1.0, 3.0)).at(x) for x in u], -1.0 + 4.0 * u)
    np.testing.assert_allclose([1.0 + Factor(lognormal=0.3).at(x) for x in u], lognorm.ppf(u, 0.3))


@pytest.mark.parametrize(
    ("tables", "codes", "name"),
    [
        ({"joint": {"stifness": {"normal": 0.1}}}, "key-unknown", "'stiffness'"),
        ({"joint": {"stiffness": {"normal": 0.1, "uniform": [0, 1]}}}, "keys-conflict", "normal, uniform, lognormal"),
        ({"mass": {"offset_y_m": {"lognormal": 0.1}}}, "key-unknown", "'mass.offset_y_m.lognormal'"),
        ({"mass": {"offset_y_m": {"uniform": [1, 1]}}}, "keys-conflict", "'mass.offset_y_m.uniform'"),
        ({"initial": {"spin_rpm": {"normal": -1.0}}}, "key-value", "'initial.spin_rpm.normal'"),
    ],
)
def test_wrong_dispersions_are_refused(tables, codes, name):
    with refuses(*codes.split(), names=[name], kind=ConfigError):
        parse_section(Dispersions, tables, "file.toml")


def test_an_undispersed_flight_is_the_simulators_own(short):
    """Legs, longer steps before inflation and outputs against `fly_scenario`, on the same day."""
    truth = fly_scenario(short, 5)
    air = day_of_flight_atmosphere(short.spec.atmosphere, child_rng(5, "atmosphere"), short.mean_air)
    table = simulate.atmosphere_table(air)
    start = Start(initial_state(short), simulate.parameter_vector(short.vehicle), table)
    plan = legs(short.spec.time, WINDOW, locked=False)
    records = records_of(fly_legs(short.vehicle, [0], [start], plan)[0], short.vehicle, table)
    at = np.round((WINDOW.from_s + 0.02 * np.arange(len(records.aux)) - 400.0) / 0.004).astype(int)
    force = truth.specific_force_body(short.vehicle.cg_m)[at]
    # lanes against one flight alone: 1e-9; before inflation other steps: 1e-8 rad
    for name, true in (
        ("deflection_deg", np.rad2deg(truth.deflection.theta_rad[at])),
        ("alpha_total_deg", np.rad2deg(truth.alpha_body_rad[at])),
        ("alpha_shell_deg", np.rad2deg(truth.alpha_shell_rad[at])),
        ("normal_g", np.hypot(*force[:, 1:].T) / 9.80665),
        ("axial_g", -force[:, 0] / 9.80665),
        ("dynamic_pressure_pa", truth.dynamic_pressure_pa[at]),
    ):
        np.testing.assert_allclose(QUANTITIES[name](records), true, rtol=1e-5, atol=1e-5, err_msg=name)
    assert records.alpha_total_deg.max() > 0.5
    found = scalars_of(records, ("peak_normal_g", "peak_pressure_s"), WINDOW)
    assert found["peak_normal_g"] == records.normal_g.max()


def test_every_factor_moves_the_flight(short):
    """No key of the file is dead: each alone changes the state, the vehicle, the coefficients or the air."""
    nominal = dispersed_case(short, Dispersions(atmosphere=AirDispersions(day=False)), {})
    for section in ("initial", "mass", "aerodynamics", "joint", "atmosphere"):
        model = Dispersions.model_fields[section].annotation
        for key in model.model_fields:
            base = {"atmosphere": {"day": False}}
            law = True if key == "day" else {"uniform": [0.009, 0.01]}
            tables = base | {section: {**base.get(section, {}), key: law}}
            one = Dispersions.model_validate(tables)
            assert list(one.factors()) == [f"{section}.{key}"]
            case = dispersed_case(short, one, {f"{section}.{key}": 0.7})
            same = (
                np.array_equal(initial_state(case.scenario), initial_state(nominal.scenario))
                and np.array_equal(simulate.parameter_vector(case.vehicle), simulate.parameter_vector(nominal.vehicle))
                and case.scales == nominal.scales
                and np.array_equal(case.profile.log_density_ratio, nominal.profile.log_density_ratio)
                and np.array_equal(case.profile.wind_ned_mps, nominal.profile.wind_ned_mps)
            )
            assert not same, f"{section}.{key}"


def test_the_offset_is_the_vehicles_and_stations_grow_aft(short):
    laws = Dispersions(
        mass=MassDispersions(
            offset_y_m=Shift(uniform=(0.001, 0.003)), centerbody_cg_station_m=Shift(uniform=(0.01, 0.03))
        )
    )
    case = dispersed_case(short, laws, dict.fromkeys(laws.factors(), 0.5))
    moved = case.vehicle.cg_m - short.vehicle.cg_m
    share = short.vehicle.centerbody.mass_kg / short.vehicle.mass_kg
    np.testing.assert_allclose(moved, [-0.02 * share, 0.002, 0.0], atol=1e-12)


def test_what_cannot_fly_is_a_row_with_its_reason(short):
    plan = Plan(short, Dispersions(), WINDOW, ("peak_deflection_deg",), ("deflection_deg",))
    laws = Dispersions(
        joint=JointDispersions(freeplay_deg=Shift(uniform=(-1.0, 1.0)), stiffness=Factor(uniform=(0.0, 2000.0)))
    )
    draws_of = {
        0: {"joint.freeplay_deg": 0.2, "joint.stiffness": 0.0},
        1: {"joint.freeplay_deg": 0.6, "joint.stiffness": 0.0},
        2: {"joint.freeplay_deg": 0.5, "joint.stiffness": 1.0},
    }
    rows = fly_runs(replace(plan, dispersions=laws), [0, 1, 2], lambda run: draws_of[run] | {"atmosphere.day": 0.5})
    assert rows[0].reason.code == "draw-impossible"
    assert "joint.freeplay_deg = -0.6" in rows[0].reason
    assert rows[1].reason == ""
    assert np.isfinite(rows[1].histories).all()
    assert rows[2].reason.code == "step-too-long"
    assert "bending" in rows[2].reason
    assert np.isnan(rows[0].scalars["peak_deflection_deg"])
    assert np.isnan(rows[2].histories).all()


def test_a_joint_that_diverges_holds_its_last_value(short):
    laws = Dispersions(joint_is="flexible", joint=JointDispersions(stiffness=Factor(uniform=(-1.0, -0.999))))
    spin = InitialDispersions(spin_rpm=Shift(uniform=(89.0, 91.0)))
    plan = Plan(short, laws.model_copy(update={"initial": spin}), WINDOW, ("peak_deflection_deg",), ("deflection_deg",))
    (row,) = fly_runs(plan, [0], lambda run: draws(plan.dispersions, 0, run))
    assert 402.0 < row.diverged_s < 410.0
    assert row.reason == ""
    assert np.isfinite(row.histories).all()
    assert row.histories[0, -1] == row.histories[0, -2] == row.scalars["peak_deflection_deg"]


def test_windows_that_do_not_fit_are_refused(short):
    with refuses("time-not-covered", names=[r"\b401\b", r"\b400\.5\b"], kind=ConfigError):
        legs(short.spec.time, Window(from_s=400.5, to_s=405.0), locked=False)
    with pytest.raises(ValueError, match="record_s"):
        Window(from_s=1.0, to_s=2.0, record_s=0.02, history_s=0.05)


def test_a_factor_on_coefficients_must_stay_positive(short):
    laws = Dispersions(aerodynamics={"ca": {"uniform": [-3.0, -2.0]}})
    with pytest.raises(GateError) as refusal:
        dispersed_case(short, laws, dict.fromkeys(laws.factors(), 0.5))
    assert refusal.value.codes == ("draw-impossible",)

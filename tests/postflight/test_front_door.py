"""The public interface: every name is there and documented, what-ifs are changed flights, results show themselves."""

import inspect
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import postflight as pf
from flightmodel.checks import ConfigError, DivergenceError
from flightmodel.tabular import Tabular
from postflight import commands, interface, reconstruction
from postflight.checks.track_clocks import clock_faults
from postflight.reconstruction import reconstruction_from
from postflight.run_folder import peak_table
from postflight.streams import on_one_thread
from recon.consistency import doubt
from tests.refusing import numbers_in

UNITS = {"s", "m", "deg", "degps", "mps", "mps2", "pa", "k", "kgpm3", "px", "hz", "g", "nm", "j", "nms", "w", "kgm2"}


SHORTER = (
    (r"(?m)^stop_s = 530\.0", "stop_s = 458.0"),
    (r"telemetry_from_s = 300\.0", "telemetry_from_s = 412.0"),
    (r"(?m)^t_s = 300\.0", "t_s = 412.0"),
    (r"rate_hz = 250\.0", "rate_hz = 100.0"),
    (r"(?ms)^\[video\].*?(?=^\[)", ""),
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A synthetic flight of the 46 s about its pressure pulse, without video."""
    folder = tmp_path_factory.mktemp("door")
    text = Path(pf.read_scenario("irve2_reference").source).read_text()
    for pattern, new in SHORTER:
        text, count = re.subn(pattern, new, text)
        assert count, pattern
    (folder / "short.toml").write_text(text)
    truth = pf.simulate(folder / "short.toml", folder / "flight", seed=3)
    assert round(truth.dynamic_pressure_pa.max()) in numbers_in(repr(truth))
    return pf.read_flight(folder / "flight")


@pytest.fixture(scope="module")
def bet(flight):
    return pf.reconstruct(flight)


@pytest.fixture(scope="module")
def answer(bet):
    return pf.fuse(bet)


@pytest.mark.parametrize("name", pf.__all__)
def test_every_public_name_is_there_and_says_what_it_is(name):
    found = getattr(pf, name)
    doc = inspect.getdoc(found)
    assert doc
    assert len(doc) > 40
    assert name in dir(pf)


@pytest.mark.parametrize("name", [n for n in pf.__all__ if inspect.isfunction(getattr(pf, n))])
def test_public_functions_are_typed(name):
    signature = inspect.signature(getattr(pf, name))
    assert signature.return_annotation is not inspect.Signature.empty
    assert all(p.annotation is not inspect.Parameter.empty for p in signature.parameters.values())


@pytest.mark.parametrize(
    "call",
    [
        pf.reconstruct,
        lambda wrong: pf.air_data(wrong, wrong),
        pf.estimate_camera,
        pf.estimate_misalignment,
        pf.estimate_trim,
        pf.fuse,
        pf.aero_increments,
        pf.reconcile,
        lambda wrong: pf.compare(wrong, wrong),
    ],
)
@pytest.mark.parametrize("wrong", ["my-flight", None])
def test_a_folder_where_a_flight_or_its_trajectory_is_wanted_is_refused(call, wrong):
    with pytest.raises(pf.GateError) as fault:
        call(wrong)
    assert fault.value.codes == ("argument-type",)


@pytest.mark.parametrize(
    "call",
    [
        pf.read_flight,
        pf.check_flight,
        pf.score,
        pf.write_report,
        lambda wrong: pf.score("flight", wrong),
        lambda wrong: pf.simulate("irve2_reference", wrong),
        lambda wrong: pf.monte_carlo("irve2_reference", wrong),
    ],
)
def test_a_number_where_a_folder_is_wanted_is_refused(call):
    with pytest.raises(pf.GateError) as fault:
        call(3)
    assert fault.value.codes == ("argument-type",)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True])
def test_a_seed_that_is_none_is_refused(seed):
    with pytest.raises(ConfigError) as fault:
        pf.simulate("irve2_reference", seed=seed)
    assert fault.value.codes == ("value-range",)


@pytest.mark.parametrize("call", [pf.read_vehicle, pf.read_scenario, pf.simulate])
def test_no_file_is_refused_in_words(call):
    with pytest.raises(pf.GateError) as fault:
        call(None)
    assert fault.value.codes == ("argument-type",)


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(AttributeError, match="read_flight"):
        pf.read_fligth  # noqa: B018


def test_the_door_imports_nothing_heavy():
    heavy = "('numpy', 'pandas', 'scipy', 'matplotlib', 'numba')"
    code = f"import sys, postflight; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_wrong_vehicle_puts_every_answer_in_doubt_at_once(flight, bet, answer, capsys):
    """Another vehicle's mass: checks of the air are red, and the first words of repr and command say so."""
    assert answer.doubt == ""
    heavy = reconstruction_from(flight.with_(mass_kg=1.8 * flight.vehicle.mass_kg), bet.solution)
    assert "pre-flight-drag" in {check.code for check in heavy.consistency_checks if not check.passed}
    assert heavy.suspects[0].sources == ("vehicle", "atmosphere")
    doubtful = replace(answer, bet=heavy)
    assert repr(doubtful).removeprefix("<Deflections: ").startswith(doubtful.doubt)
    assert repr(heavy).removeprefix("<Reconstruction: ").startswith(doubt_of(heavy))
    commands.print_answers(doubtful)
    commands.print_answers(answer)
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.startswith(f"in doubt {doubtful.doubt} [answers-in-doubt]")
    assert printed.count("[answers-in-doubt]") == 1


def test_trackers_whose_time_tags_are_late_are_named_first(flight, monkeypatch):
    """1.5 s, both: a red run names the clocks before what they bend, and one that is not followed names them too."""

    def late(names):
        radars = {k: replace(r, time_s=r.time_s + 1.5 * (k in names)) for k, r in flight.telemetry.radars.items()}
        return replace(flight, telemetry=replace(flight.telemetry, radars=radars))

    first, second = flight.telemetry.radars
    both = late((first, second))
    named = pf.reconstruct(both).suspects[0]
    assert (named.code, set(named.sources)) == ("clock-lag", {first, second, "accelerometer", "rates"})
    late_s, sd_s = [x for x in numbers_in(named) if x][:2]
    assert abs(late_s - 1.5) < 4.0 * sd_s, named
    assert late_s > 5.0 * sd_s
    assert [set(one.sources) for one in clock_faults(late((first,)).telemetry)] == [{first}]
    assert clock_faults(flight.telemetry) == ()

    def lost(*_):
        raise DivergenceError("track lost", "track-not-followed")

    monkeypatch.setattr(reconstruction, "solve", lost)
    with pytest.raises(DivergenceError) as fault:
        pf.reconstruct(both)
    assert fault.value.codes == ("track-not-followed",)
    assert named in str(fault.value)


def test_an_answer_that_is_missing_at_the_data_s_end_has_its_reason(flight):
    """Forces are means over readings on both sides: at the last of them there is none."""
    short = pf.fuse(pf.reconstruct(flight.with_(end_s=435.0)))
    table = short.to_frame().set_index("method")
    assert table["theta_deg"].isna().all()
    for method, history in short.histories.items():
        last_s = history.time_s[np.isfinite(history.theta_rad)][-1]
        numbers = numbers_in(table.loc[method, "reason"])
        assert numbers[0] == pytest.approx(short.reference_s, abs=0.01)
        assert numbers[-1] == pytest.approx(last_s, abs=0.01)
        assert table.loc[method, "reason"] in repr(short)
    assert "nan" not in repr(short)


def doubt_of(found):
    failed = [check.name for check in found.consistency_checks if not check.passed]
    return doubt(failed, len(found.consistency_checks))


# what-ifs


def test_a_what_if_is_another_flight_and_leaves_the_first_as_it_is(flight):
    mass, still = flight.vehicle.mass_kg, np.abs(flight.telemetry.sounding.wind_north_mps).max()
    changed = flight.with_(
        mass_kg=158.0, wind=None, joint_station_m=0.1, without=next(iter(flight.telemetry.radars)), output_rate_hz=10.0
    )
    assert changed.vehicle.mass_kg == pytest.approx(158.0)
    assert not changed.telemetry.sounding.wind_north_mps.any()
    assert changed.vehicle.joint.station_m == 0.1
    assert changed.settings.without == tuple(flight.telemetry.radars)[:1]
    assert changed.settings.output_rate_hz == 10.0
    assert len(changed.changes) == 5
    assert flight.vehicle.mass_kg == mass
    assert np.abs(flight.telemetry.sounding.wind_north_mps).max() == still
    assert flight.changes == ()


def test_factors_multiply_what_they_name_alone(flight):
    changed = flight.with_(c_n=1.1, density=0.9)
    aero, was = changed.vehicle.aero.coefficients, flight.vehicle.aero.coefficients
    np.testing.assert_allclose(aero, was * [1.0, 1.1, 1.0, 1.0], rtol=1e-15)
    air, before = changed.telemetry.sounding, flight.telemetry.sounding
    np.testing.assert_allclose(air.density_kgpm3, 0.9 * before.density_kgpm3, rtol=1e-15)
    np.testing.assert_allclose(air.pressure_pa, 0.9 * before.pressure_pa, rtol=1e-15)
    np.testing.assert_array_equal(air.temperature_k, before.temperature_k)


def test_a_shift_of_the_cg_is_the_whole_vehicles(flight):
    shift = np.array([0.0, 0.002, -0.001])
    moved = flight.with_(cg_shift_body_m=shift).vehicle.cg_m - flight.vehicle.cg_m
    np.testing.assert_allclose(moved, shift, atol=1e-15)


def test_every_fault_of_a_what_if_is_named_at_once(flight):
    with pytest.raises(ConfigError) as refusal:
        flight.with_(cn=1.1, mass_kg="heavy", density=-1.0, engine="steam", cg_shift_body_m=(0.0, 1.0))
    assert refusal.value.codes[:3] == ("name-unknown", "value-range", "value-range")
    assert len(refusal.value.faults) == 5
    assert "c_n" in refusal.value.faults[0]


def test_a_source_to_leave_out_is_one_of_the_flights(flight):
    there = next(iter(flight.telemetry.radars))
    with pytest.raises(pf.GateError) as refusal:
        flight.with_(without=("radar9", there), cn=1.1)
    assert refusal.value.codes == ("name-unknown", "name-unknown")
    assert "'radar9'" in refusal.value.faults[1]
    assert there in refusal.value.faults[1]


@pytest.mark.parametrize("wrong", [{"flights": -3}, {"flights": 0}, {"flights": "ten"}, {"workers": 0}])
def test_a_study_of_no_flights_is_refused_before_its_folder_is_made(tmp_path, wrong):
    with pytest.raises(pf.GateError) as refusal:
        pf.monte_carlo("irve2_reference", tmp_path / "study", **wrong)
    assert refusal.value.codes == ("value-range",)
    assert not (tmp_path / "study").exists()


def test_an_assumption_reaches_every_estimator_that_uses_it(flight, bet, answer):
    """C_N is used by misalignment, trim and fusion, and by no part of the trajectory."""
    other = pf.reconstruct(flight.with_(c_n=1.2))
    np.testing.assert_array_equal(other.trajectory.position_ecef_m, bet.trajectory.position_ecef_m)
    changed = pf.fuse(other)
    assert set(answer.histories) == {"misalignment", "trim", "fused"}
    for method in ("misalignment", "trim"):
        history = answer.histories[method]
        moved = np.abs(changed.histories[method].theta_rad - history.theta_rad)
        assert np.nanmax(moved) > np.deg2rad(0.1), method
    if "fused" in changed.histories:
        assert np.nanmax(np.abs(changed.history.theta_rad - answer.history.theta_rad)) > np.deg2rad(0.05)
    else:
        assert changed.refused["fused"].code


def test_a_tracker_left_out_is_not_used(flight):
    names = list(flight.telemetry.radars)
    bet = pf.reconstruct(flight.with_(without=(names[0],)))
    used = bet.solution.residuals.groupby("source")["used"].any()
    assert not used[names[0]]
    assert used[names[1]]


def test_a_command_leaves_out_more_and_writes_at_another_rate_without_a_what_if(flight):
    first, second = flight.telemetry.radars
    stated = flight.with_(without=(first,))
    asked = commands.asked(("c_n=1.1", "wind=none"), (second,), 5.0).of(stated)
    assert asked.settings.without == (first, second)
    assert asked.settings.output_rate_hz == 5.0
    assert asked.changes == ("c_n = 1.1", "wind = None", f"without = {(first, second)}")
    assert commands.asked((), (), 5.0).of(flight).changes == ()
    assert commands.asked((f"without={first}",), (second,), None).of(flight).settings.without == (first, second)
    with pytest.raises(ConfigError) as refusal:
        commands.asked(("c_n", "=1"), (), None)
    assert refusal.value.codes == ("option-format", "option-format")
    with pytest.raises(ConfigError) as refusal:  # with_(c_n=1.2, c_n=1.0) is no Python either
        commands.asked(("c_n=1.2", "wind=none", "c_n=1.0"), (), None)
    assert refusal.value.codes == ("given-twice",)
    assert "c_n" in str(refusal.value)


def test_settings_and_answers_are_of_their_types(bet, flight):
    for call in (lambda: pf.reconstruct(flight, {"fault_tests": False}), lambda: pf.aero_increments(bet, bet)):
        with pytest.raises(pf.GateError) as fault:
            call()
        assert fault.value.codes == ("argument-type",)


def test_a_path_beyond_all_numbers_is_a_divergence_and_says_what_to_check(flight, monkeypatch):
    def lost(*_):
        raise pf.GateError("position_ecef_m: 3 values are not finite", "not-finite")

    monkeypatch.setattr("postflight.reconstruction.solve", lost)
    with pytest.raises(pf.GateError) as fault:
        pf.reconstruct(flight)
    assert fault.value.codes == ("trajectory-diverged",)
    assert "postflight check" in str(fault.value)


def test_a_change_that_replaces_another_is_named_alone(flight):
    twice = flight.with_(output_rate_hz=5.0, c_n=1.2).with_(output_rate_hz=2.0, c_n=1.5)
    assert twice.changes == ("c_n = 1.2", "output_rate_hz = 2.0", "c_n = 1.5")
    assert twice.settings.output_rate_hz == 2.0
    assert twice.vehicle.aero.at(5.0, 0.1)[1] == pytest.approx(1.8 * flight.vehicle.aero.at(5.0, 0.1)[1])


@pytest.mark.parametrize(
    "changes",
    [
        {"joint_station_m": 50.0},
        {"joint_station_m": -0.1},
        {"cg_shift_body_m": (-9.0, 0.0, 0.0)},
        {"cg_shift_body_m": (0.9, 0.0, 0.0)},
        {"cg_shift_body_m": (0.0, 1.0, 1.2)},
    ],
)
def test_what_lies_outside_the_vehicle_is_refused(flight, changes):
    with pytest.raises(ConfigError) as refusal:
        flight.with_(**changes)
    assert refusal.value.codes == ("value-range",)


def test_a_word_for_a_shift_is_refused(flight):
    with pytest.raises(ConfigError) as refusal:
        flight.with_(cg_shift_body_m="aft")
    assert refusal.value.codes == ("value-range",)


def test_a_run_is_chosen_by_name_digits_or_folder(tmp_path, monkeypatch):
    """Every way to name a run reaches score and report; what is no whole run of this flight is refused."""
    runs = tmp_path / "flight" / "runs"
    (tmp_path / "flight" / "truth").mkdir(parents=True)
    (tmp_path / "flight" / "truth" / "truth.csv").touch()
    there = [runs / "20260101T000000Z-11111111", runs / "20260102T000000Z-22222222-calm"]
    for run in there:
        run.mkdir(parents=True)
        for name in ("bet.csv", "run.json", "summary.json", "bet_header.json"):
            (run / name).write_text('{"settings": {}}')
    joint = runs / "20260103T000000Z-33333333"  # of a reconciliation
    joint.mkdir()
    (joint / "run.json").write_text('{"settings": {}}')
    asked = []
    monkeypatch.setattr(interface, "score_run", lambda folder, run: asked.append(run))
    monkeypatch.setattr(interface.write, "write_report", lambda folder, run: asked.append(run))
    for call in (pf.score, pf.write_report):
        for run in ("calm", "22222222", str(there[1]), there[1], "11111111", there[0], None):
            call(tmp_path / "flight", run)
        assert asked == [*[there[1]] * 4, *[there[0]] * 2, None]
        asked.clear()
        for run, code in ((joint, "run-incomplete"), (tmp_path, "run-missing"), ("cold", "name-unknown")):
            with pytest.raises(pf.GateError) as fault:
                call(tmp_path / "flight", run)
            assert fault.value.codes == (code,)


def test_two_looks_side_by_side(bet, answer, flight):
    same = pf.compare(answer, answer).to_frame()
    assert same["difference"].abs().max() < 1e-9  # an attitude against itself is zero to rounding
    assert {"deflection by misalignment at peak q", "deflection by fused at peak q"} <= set(same["quantity"])
    (peak,) = (row for row in peak_table(bet, bet.table).itertuples() if row.peak == "dynamic pressure")
    (mine,) = (row for row in same.itertuples() if row.quantity == "peak dynamic pressure")
    assert (mine.first, mine.first_sd) == (peak.value, peak.sd)
    at_peak = np.interp(bet.peak_s, bet.air.time_s, bet.air.dynamic_pressure_sd_pa)
    assert at_peak == pytest.approx(peak.sd, rel=2e-3)
    other = pf.compare(bet, pf.reconstruct(flight.with_(density=1.1))).to_frame().set_index("quantity")
    row = other.loc["peak dynamic pressure"]
    assert row["second"] / row["first"] == pytest.approx(1.1, rel=1e-3)


# results show themselves


def test_results_are_one_line_in_a_terminal_and_a_table_in_a_notebook(flight, bet, answer):
    for result in (flight, bet, bet.trajectory, answer, answer.histories["misalignment"], pf.compare(bet, bet)):
        assert isinstance(result, Tabular)
        assert len(repr(result)) < 400
        assert "\n" not in repr(result)
        assert "<table" in result._repr_html_()


def test_text_of_a_flight_is_escaped_in_a_notebook(flight):
    from dataclasses import replace

    hostile = replace(flight, telemetry=replace(flight.telemetry, name="<script>alert(1)</script>"))
    assert "<script>" not in hostile._repr_html_()


def test_columns_name_their_units(flight, bet, answer):
    for frame in (bet.trajectory.to_frame(), answer.histories["misalignment"].to_frame(), answer.to_frame()):
        for column, kind in frame.dtypes.items():
            if kind.kind == "f" and not column.startswith("q"):
                assert column.rsplit("_", 1)[-1] in UNITS, column


def test_a_reconstruction_gives_the_columns_of_the_product(bet):
    table = bet.to_frame()
    assert {"t_s", "alt_m", "mach", "dynamic_pressure_pa", "alpha_total_wind_deg"} <= set(table.columns)
    assert len(table) == len(bet.trajectory.time_s)


def test_rates_and_loads_are_empty_where_the_gyros_are_bridged(flight, bet):
    rates, gap = flight.telemetry.rates, bet.peak_s + np.array([-1.0, 1.0])
    there = (rates.time_s < gap[0]) | (rates.time_s > gap[1])
    cut = replace(rates, time_s=rates.time_s[there], measured_sensor=rates.measured_sensor[there])
    found = pf.reconstruct(replace(flight, telemetry=replace(flight.telemetry, rates=cut)))
    table = found.to_frame()
    inside = ((table.t_s > gap[0] + 0.02) & (table.t_s < gap[1] - 0.02)).to_numpy()
    for name in ("p_body_degps", "q_body_degps", "q_body_sd_degps"):
        assert table[name][inside].isna().all()
        assert table[name][~inside].notna().mean() > 0.98
    assert table["q_body_degps"][inside].size > 50
    assert not ((found.loads.time_s > gap[0]) & (found.loads.time_s < gap[1])).any()
    # position and attitude go on
    assert table["rotation_x_body_sd_deg"][inside].notna().all()


def test_force_coefficients_are_mass_times_acceleration_over_pressure_and_area(flight, bet):
    table, vehicle = bet.to_frame(), flight.vehicle
    known = table[np.isfinite(table["c_a"])]
    assert len(known) > 100
    force = vehicle.mass_kg * known[["ax_cg_mps2", "ay_cg_mps2", "az_cg_mps2"]].to_numpy()
    pressure_area = known["dynamic_pressure_pa"].to_numpy() * vehicle.reference.area_m2
    np.testing.assert_allclose(known["c_a"], -force[:, 0] / pressure_area, rtol=1e-9)
    np.testing.assert_allclose(known["c_n"], np.hypot(*force[:, 1:].T) / pressure_area, rtol=1e-9)


def test_linear_algebra_of_the_public_functions_runs_on_one_thread():
    """However many a notebook's process has: two that wait for each other on a busy machine took 18 times as long."""

    def threads():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    for name in ("reconstruct", "fuse", "reconcile", "estimate_camera", "estimate_misalignment", "estimate_trim"):
        assert getattr(pf, name).__wrapped__.__name__ == name
    with threadpool_limits(limits=2, user_api="blas"):
        assert threads() == {2}
        assert on_one_thread(threads)() == {1}
        assert threads() == {2}


@pytest.mark.parametrize("name", sorted(set(pf.__all__) - {"plots"}))
def test_no_module_takes_the_place_of_a_public_name(name):
    """A submodule becomes an attribute of its package as soon as anything imports it: `pf.score` was a module then."""
    assert find_spec(f"postflight.{name}") is None


@pytest.mark.parametrize("other", ["recon.py", "estimators/__init__.py"])
def test_another_file_of_one_of_our_names_is_named(tmp_path: Path, other: str) -> None:
    """An analyst's ``recon.py`` beside a script would otherwise end in an error about a name that it does not have."""
    (tmp_path / other).parent.mkdir(exist_ok=True)
    (tmp_path / other).write_text("")
    done = subprocess.run(
        [sys.executable, "-c", "import postflight"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}"},
    )
    assert done.returncode == 1
    assert f"{tmp_path / other} hides the package '{Path(other).parts[0].removesuffix('.py')}'" in done.stderr
    assert "rename it" in done.stderr

"""`postflight check VEHICLE`: numbers as published and as textbooks have them, a drawing, every planted fault named."""

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest

import postflight as pf
from flightmodel.vehicle import shipped
from postflight import commands
from postflight.checks.folder_check import check_folder
from postflight.checks.vehicle_check import mass_states
from postflight.plots import figure_vehicle
from tests.flightmodel.meshes_of_vehicles import as_drawn, shell_mesh
from tests.in_process import runner
from tests.refusing import printed_codes

OWN = Path(__file__).parents[2] / "examples" / "own_vehicle" / "vehicle.toml"
BODY = "[-0.32, 0.002, -0.001]"  # c.g. of the centerbody
AHEAD = BODY, "[0.55, 0.002, -0.001]"
SPOILT = {
    "a sign": ((AHEAD,), "cg-outside-vehicle"),
    "millimetres": (((BODY, "[-0.32, 2.0, -1.0]"),), "cg-outside-vehicle"),
    "a joint behind": ((("station_m = 0.12", "station_m = 0.40"),), "joint-behind-cg"),
    "a long tail": (((BODY, "[-3.2, 0.0, 0.0]"), ("length_m = 1.0", "length_m = 4.0")), "statically-unstable"),
}


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return runner(capsys, monkeypatch)


def spoilt(path, changes):
    text = OWN.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def value(found, quantity, state="at start"):
    (row,) = (row for row in found.to_frame().to_dict("records") if row["quantity"].startswith(quantity))
    return row[state]


@pytest.mark.parametrize("name", [*shipped("vehicle"), str(OWN)])
def test_vehicles_that_are_right_have_no_issue(name):
    found = pf.check_vehicle(pf.read_vehicle(name), pressure_pa=1000.0)
    assert found.issues == ()
    assert np.isfinite(found.to_frame().drop(columns=["quantity", "unit"]).to_numpy()).all()


def test_the_reference_vehicle_is_the_papers():
    """Table 3.1's 2.5 Hz; means of angle of attack and deflection over 3 s about peak pressure, without spin.

    A tenth is left for what the static model has not: dynamics, and a pressure that is below its peak on average, which
    the load ratio of 0.8 amplifies five times.
    """
    found = pf.check_vehicle(pf.read_vehicle("irve2_reference"), pressure_pa=1180.0, mach=3.1)
    assert value(found, "free-free") == pytest.approx(2.5, rel=1e-3)
    assert value(found, "deflection") == pytest.approx(3.70, rel=0.1)
    assert value(found, "trim") == pytest.approx(5.0, rel=0.1)
    assert value(found, "mass") == 155.0


def test_the_centre_of_pressure_of_a_sharp_cone_is_newtons(tmp_path):
    """At two thirds of its height over the square of the half-angle's cosine, aft of the tip, in Newtonian flow."""
    sharp = spoilt(tmp_path / "v.toml", [("nose_radius_m = 0.30", "nose_radius_m = 0.001")])
    half = np.deg2rad(70.0)
    wanted = 2.0 / 3.0 / np.tan(half) / np.cos(half) ** 2
    assert value(pf.check_vehicle(pf.read_vehicle(sharp)), "centre of pressure") == pytest.approx(wanted, rel=1e-3)


def test_trim_is_amplified_by_the_load_ratio():
    vehicle = pf.read_vehicle("irve2_reference")
    rigid = pf.check_vehicle(vehicle)
    loaded = pf.check_vehicle(vehicle, 0.5 * value(rigid, "critical"))
    assert value(loaded, "trim") == pytest.approx(2.0 * value(rigid, "trim"))
    assert value(rigid, "deflection") == 0.0


def test_mass_steps_have_their_own_columns():
    vehicle = pf.read_vehicle("irve3")
    first, second = mass_states(vehicle)
    found = pf.check_vehicle(vehicle, 1000.0)
    assert list(found.to_frame().columns) == ["quantity", "unit", first, second]
    assert value(found, "c.g. off", second) == pytest.approx(0.01, rel=1e-3)
    assert value(found, "trim", first) == 0.0
    assert value(found, "trim", second) > 1.0


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_vehicle_is_named_with_its_remedy(tmp_path, case):
    changes, code = SPOILT[case]
    found = pf.check_vehicle(pf.read_vehicle(spoilt(tmp_path / "v.toml", changes)), 1000.0)
    assert [issue.code for issue in found.issues] == [code]
    assert "check" in found.issues[0]


def test_a_pressure_above_the_critical_one_has_no_trim():
    found = pf.check_vehicle(pf.read_vehicle(OWN), 1e4)
    assert [issue.code for issue in found.issues] == ["pressure-above-critical"]
    assert np.isnan(value(found, "deflection"))
    assert round(value(found, "critical")) == 3113


def test_a_joint_without_stiffness_diverges_at_any_pressure(tmp_path):
    free = pf.read_vehicle(
        spoilt(tmp_path / "v.toml", [("bending_stiffness_nmprad = 2500.0", "bending_stiffness_nmprad = 0")])
    )
    assert pf.check_vehicle(free).issues == ()
    assert [issue.code for issue in pf.check_vehicle(free, 1.0).issues] == ["pressure-above-critical"]


def test_the_drawing_has_every_mark_where_the_file_has_it():
    vehicle = pf.read_vehicle("irve2_reference")
    (axes,) = figure_vehicle(vehicle, 5.0).axes
    marks = {
        line.get_label(): np.ravel(line.get_xydata()) for line in axes.lines if not line.get_label().startswith("_")
    }
    lens = vehicle.cameras["camera5"].position_m
    expected = {
        "joint": (0.20, 0.0),
        "c.g. of the aeroshell": (0.58, 0.0),
        "c.g. of the centerbody": (0.52, -0.0053913),
        "c.g.": (-vehicle.cg_m[0], -vehicle.cg_m[1]),
        "centre of pressure, Mach 5": (2.268, 0.0),
    }
    for name, place in expected.items():
        np.testing.assert_allclose(marks[name], place, atol=1e-3, err_msg=name)
    np.testing.assert_allclose(marks["camera and line of sight"][:2], [-lens[0], -lens[1]], atol=1e-12)
    assert len(axes.patches) == 2 * vehicle.geometry.torus_count + 1


def test_a_body_with_a_mesh_is_drawn_by_it(tmp_path):
    path = tmp_path / "v.toml"
    as_drawn(shell_mesh(pf.read_vehicle(OWN).geometry, 24)).export(tmp_path / "shell.stl")
    table = '\n[meshes.aeroshell]\nfile = "shell.stl"\nunit_m = 0.001\nforward = "z"\nnose = [12.0, -7.0, 55.0]\n'
    path.write_text(OWN.read_text() + table)
    vehicle = pf.read_vehicle(path)
    assert pf.check_vehicle(vehicle).issues == ()
    (axes,) = figure_vehicle(vehicle).axes
    (drawn,) = axes.collections
    corners = np.concatenate([triangle.vertices for triangle in drawn.get_paths()])
    np.testing.assert_allclose(np.abs(corners[:, 1]).max(), vehicle.geometry.base_radius_m, rtol=0.01)
    assert len(axes.patches) == 1  # the centerbody, which has none


def test_a_notebook_shows_drawing_numbers_and_issues(tmp_path):
    vehicle = pf.read_vehicle(spoilt(tmp_path / "v.toml", [AHEAD]))
    shown = vehicle._repr_html_()
    assert shown.startswith('<img src="data:image/png;base64,')
    assert "static margin" in shown
    assert vehicle.cg_m[0] > 0.0
    assert "0.550 m ahead of the nose" in repr(vehicle)
    assert "\n" not in repr(vehicle)


def test_the_command_prints_draws_and_leaves_with_its_code(run, tmp_path):
    done = run("check", OWN, "--pressure", "877", "--strict")
    assert (done.returncode, printed_codes(done.stdout)) == (0, [])
    assert matplotlib.image.imread(tmp_path / "vehicle.png").ndim == 3
    spoilt(tmp_path / "ahead.toml", [AHEAD])
    for strict, code in ((), 0), (("--strict",), 5):
        done = run("check", "ahead.toml", *strict)
        assert (done.returncode, printed_codes(done.stdout)) == (code, ["cg-outside-vehicle"])
    done = run("check", "ahead.toml", "--json", "--drawing", "side.png")
    said = json.loads(done.stdout)
    assert [issue["code"] for issue in said["issues"]] == ["cg-outside-vehicle"]
    assert not said["passed"]
    assert (tmp_path / "side.png").is_file()


def test_a_shipped_name_is_a_vehicle_unless_a_folder_bears_it(run, tmp_path):
    assert run("check", "irve3").returncode == 0
    (tmp_path / "irve3").mkdir()
    assert run("check", "irve3").returncode == 2  # no flight.toml
    assert run("check", "irve3", "--mach", "5").returncode == 2


def test_what_is_no_vehicle_is_refused():
    with pytest.raises(pf.GateError) as refusal:
        pf.check_vehicle("irve3")
    assert refusal.value.codes == ("argument-type",)


def test_the_check_of_a_folder_names_its_vehicles_faults_and_strict_counts_them(run, tmp_path):
    package = Path(__file__).parents[2] / "examples" / "range_package_01"
    folder = tmp_path / "flight"
    shutil.copytree(package, folder, ignore=shutil.ignore_patterns("runs"))
    assert run("check", folder, "--strict").returncode == 0
    toml = folder / "flight.toml"
    spoilt(folder / "v.toml", [AHEAD])
    text, count = re.subn(r"(?m)^vehicle = .*$", 'vehicle = "v.toml"', toml.read_text())
    assert count == 1
    toml.write_text(text)
    report = check_folder(folder)
    assert "cg-outside-vehicle" in [remark.code for remark in report.cross_checks]
    assert report.exit_code == 0
    assert run("check", folder).returncode == 0
    assert run("check", folder, "--strict").returncode == 5


@pytest.mark.parametrize(
    ("strict", "doubt", "code"), [(True, "1 of 20 checks fails", 5), (True, "", 0), (False, "1 of 20", 0)]
)
def test_a_strict_run_ends_with_5_after_it_has_written(run, monkeypatch, tmp_path, strict, doubt, code):
    answers = SimpleNamespace(doubt=doubt, refused={}, increments=None, no_increments=None)
    monkeypatch.setattr(commands, "run_flight", lambda *_: (None, answers, tmp_path))
    monkeypatch.setattr(commands, "read_flight_file", lambda _: SimpleNamespace(loads=None))
    done = run("run", "flight", *["--strict"] * strict)
    assert done.returncode == code
    assert printed_codes(done.stdout) == ["answers-in-doubt"] * (code == 5)
    assert "results in" in done.stdout

"""A joint's law by a load test: a known law is found with honest bars, faults are named, and a real shell's test."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from flightmodel.checks import GateError
from flightmodel.config import parse_section, read_toml
from flightmodel.vehicle import CompliantJoint, Section
from postflight.cli import cli
from postflight.studies.shell_test import LoadTest, fit_laws, lagged, predicted, read_load_test

TIME_S = 0.5 * np.arange(500)
MOMENT_NM = 800.0 * np.interp(TIME_S, [0.0, 20.0, 140.0, 240.0, 250.0], [0.04, 0.04, 1.0, 0.05, 0.04])
SHARE, CREEP_S, STIFFNESS = 0.4, 20.0, 9000.0
REAL = Path(os.environ.get("POSTFLIGHT_REALDATA", "/nowhere")) / "hiad_static" / "static_6m.csv"


def drawn(rng, hardening=0.0, share=SHARE, left=0.01, lasting_s=10.0):
    """A test of a known joint, its law written anew; what is left lasts for ``lasting_s``."""
    late = lagged(TIME_S, share / (1.0 - share) / STIFFNESS * MOMENT_NM, CREEP_S, 0.002)
    elastic = MOMENT_NM / STIFFNESS
    for _ in range(50):
        elastic = MOMENT_NM / (STIFFNESS + hardening * elastic**2)
    angle = elastic + late + 0.003
    keep, noise = np.exp(-0.5 / lasting_s), np.zeros(len(TIME_S))
    noise[0] = rng.standard_normal()
    for k in range(1, len(noise)):
        noise[k] = keep * noise[k - 1] + np.sqrt(1.0 - keep**2) * rng.standard_normal()
    return LoadTest("drawn", TIME_S, MOMENT_NM, angle + left * np.ptp(angle) * noise)


def values(fit):
    table = fit.table().set_index("quantity")
    return table["value"], table["sd"]


def test_creep_settles_as_an_exponential():
    """Under a load that is held, and exactly where a load grows evenly, one axis or two."""
    t = np.array([0.0, 0.3, 1.0, 4.0])
    held = lagged(t, np.full(4, 2.0), 1.5, 0.5)
    np.testing.assert_allclose(held, 2.0 - 1.5 * np.exp(-t / 1.5), rtol=1e-13)
    ramp = lagged(t, np.stack([t, 2.0 * t], axis=1), 1.5)
    np.testing.assert_allclose(ramp[:, 0], t - 1.5 * (1.0 - np.exp(-t / 1.5)), atol=1e-13)
    np.testing.assert_allclose(ramp[:, 1], 2.0 * ramp[:, 0])


def test_known_laws_are_selected_and_found():
    rng = np.random.default_rng(3)
    creeping = fit_laws(drawn(rng, left=1e-4)).selected
    assert creeping.laws == ("creep",)
    value, _ = values(creeping)
    assert value["bending_stiffness_nmprad"] == pytest.approx(STIFFNESS, rel=0.01)
    assert value["creep_share"] == pytest.approx(SHARE, abs=0.01)
    assert value["creep_time_s"] == pytest.approx(CREEP_S, rel=0.05)
    both = fit_laws(drawn(rng, hardening=2e5, left=1e-4)).selected
    assert both.laws == ("creep", "hardening")
    assert values(both)[0]["hardening_nmprad3"] == pytest.approx(2e5, rel=0.05)
    assert fit_laws(drawn(rng, share=0.0, left=0.01)).selected.laws == ()


@pytest.mark.long
def test_errors_lie_in_their_bars():
    """100 tests whose residuals last for ten seconds: 1 sd holds 60 to 76 % (two of 100 binomial sd about 68)."""
    rng, z = np.random.default_rng(5), []
    for _ in range(100):
        fit = fit_laws(drawn(rng)).fits[2]
        value, sd = values(fit)
        true = {"bending_stiffness_nmprad": STIFFNESS, "creep_share": SHARE, "creep_time_s": CREEP_S}
        z.append([(value[name] - true[name]) / sd[name] for name in true])
    inside = np.mean(np.abs(z) < 1.0, axis=0)
    assert np.all((inside > 0.55) & (inside < 0.82)), inside
    assert np.all(np.mean(np.abs(z) < 2.0, axis=0) > 0.86)


def written(path, header, test, *columns):
    rows = zip(test.time_s, *columns, strict=True)
    path.write_text("\n".join([header, *(",".join(f"{x:.9g}" for x in row) for row in rows)]) + "\n")
    return path


def test_the_command_writes_lines_of_a_vehicle_file(tmp_path):
    """From a force in kN and two displacements in mm with an arm, under the user's own names."""
    test, arm = drawn(np.random.default_rng(7)), 1.4
    force, moved = test.moment_nm / arm / 1e3, 1e3 * arm * test.angle_rad
    table = written(tmp_path / "t.csv", "minutes,Load cell,left_mm,right_mm", replace(test, time_s=test.time_s / 60.0),
                    force, 1.1 * moved, 0.9 * moved)  # fmt: skip
    asked = [
        "--time",
        "minutes:min",
        "--load",
        "Load cell:kn",
        "--displacement",
        "left_mm",
        "--displacement",
        "right_mm",
    ]
    done = CliRunner().invoke(cli, ["study", "shell-test", str(table), str(tmp_path / "out"), *asked, "--arm-m", "1.4"])
    assert done.exit_code == 0, done.output
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"joint.toml", "shell_test.csv", "shell_test.png"}

    class OneSection(Section):
        joint: dict[str, float]

    lines = parse_section(OneSection, read_toml(tmp_path / "out" / "joint.toml"), "joint.toml").joint
    joint = CompliantJoint(station_m=0.2, torsion_stiffness_nmprad=1e5, **lines)
    direct, _ = values(fit_laws(test).selected)
    assert joint.creep_share == pytest.approx(direct["creep_share"], rel=1e-3)
    assert joint.creep_time_s == pytest.approx(direct["creep_time_s"], rel=1e-3)
    assert joint.bending_stiffness_nmprad == pytest.approx(direct["bending_stiffness_nmprad"], rel=1e-3)


def test_faults_of_a_table_are_named(tmp_path):
    test = drawn(np.random.default_rng(8))
    good = written(tmp_path / "good.csv", "t_s,moment_nm,angle_deg", test, test.moment_nm, np.rad2deg(test.angle_rad))
    assert read_load_test(good).angle_rad == pytest.approx(test.angle_rad, abs=1e-8)

    def codes(path=good, **asked):
        with pytest.raises(GateError) as refusal:
            read_load_test(path, **asked)
        return refusal.value.codes

    assert codes(load="momentum", displacements=("angle_deg:kg",)) == ("column-missing", "unit-unknown")
    assert codes(load="moment_nm:n") == ("input-missing",)
    mirrored = written(tmp_path / "sign.csv", "t_s,moment_nm,angle_deg", test, test.moment_nm, -test.angle_rad)
    assert codes(mirrored) == ("load-sign",)
    still = written(tmp_path / "still.csv", "t_s,moment_nm,angle_deg", test, 0.0 * test.moment_nm, test.angle_rad)
    assert codes(still) == ("too-few-data",)
    back = written(tmp_path / "back.csv", "t_s,moment_nm,angle_deg", replace(test, time_s=test.time_s[::-1]),
                   test.moment_nm, test.angle_rad)  # fmt: skip
    assert codes(back) == ("time-backwards",)
    short = tmp_path / "short.csv"
    short.write_text("\n".join(good.read_text().splitlines()[:9]) + "\n")
    assert codes(short) == ("too-few-rows",)


@pytest.mark.skipif(not REAL.exists(), reason="data of a real shell are not here")
def test_a_real_shell_creeps():
    """6 m, seven tori: one law with two numbers leaves at most 3 % of the largest displacement (goal), with bars."""
    columns = tuple(f"down_{clock:03d}_m" for clock in (0, 90, 180, 270))
    found = fit_laws(read_load_test(REAL, load="load_n", displacements=columns, arm_m=1.0))
    assert found.selected.laws == ("creep",)
    assert found.selected.rms_share < 0.03 < 0.06 < found.fits[0].rms_share
    value, sd = values(found.selected)
    assert value["creep_share"] > 4.0 * sd["creep_share"] > 0.0
    assert 1.0 < value["creep_time_s"] < 60.0
    assert value["creep_time_s"] > 2.0 * sd["creep_time_s"] > 0.0
    # the law's own equations, once more
    again = predicted(found.selected.test, ("creep",), found.selected.x)
    np.testing.assert_allclose(found.selected.test.angle_rad - again, found.selected.residual_rad, atol=1e-12)

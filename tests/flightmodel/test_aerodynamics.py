import runpy
from pathlib import Path

import numpy as np
import pytest

import flightmodel
from flightmodel.aerodynamics import read_aero_table
from flightmodel.checks import TableRangeError
from flightmodel.sphere_cone import sphere_cone_closed_form, sphere_cone_quadrature, stagnation_cp
from tests.refusing import refuses

FOLDER = Path(flightmodel.__file__).parent / "data" / "aerodynamics"
TOOLS = Path(__file__).parents[2] / "tools"
SHAPE = (np.deg2rad(60.0), 0.38, 1.5, 3.0)
# alpha deg, C_A, C_N, C_m about the nose: modified Newtonian, Cp_max = 2, 60 deg, nose 0.38 m, base 1.5 m, to 1e-5
PRINTED = np.array(
    [
        [0, 1.50401, 0, 0],
        [5, 1.49447, 0.04306, -0.03256],
        [10, 1.46614, 0.08482, -0.06413],
        [20, 1.35709, 0.15941, -0.12052],
        [40, 0.98506, 0.24423, -0.18464],
        [60, 0.56200, 0.21477, -0.16237],
    ]
)


@pytest.fixture(scope="module")
def table():
    return read_aero_table(FOLDER / "irve2_reference.csv")


def test_newtonian_check_values():
    # Cp_max = 2, 60 deg, nose 0.38 m, base 1.5 m: closed form and quadrature evaluated independently
    got = 2.0 * np.stack(sphere_cone_closed_form(np.deg2rad(PRINTED[:, 0]), *SHAPE), axis=-1)
    np.testing.assert_allclose(got, PRINTED[:, 1:], atol=1.01e-5)


@pytest.mark.parametrize("alpha_deg", [3.0, 17.0, 42.0, 59.0])
def test_quadrature_equals_closed_form(alpha_deg):
    alpha = np.deg2rad(alpha_deg)
    np.testing.assert_allclose(
        sphere_cone_quadrature(alpha, *SHAPE), np.stack(sphere_cone_closed_form(np.array(alpha), *SHAPE)), atol=1e-9
    )


def test_stagnation_pressure_coefficient():
    mach = np.array([1.5, 2, 2.5, 3, 3.5, 4, 5, 5.7, 6, 8, 10, 20])
    want = [1.5322, 1.6573, 1.7203, 1.7557, 1.7775, 1.7918, 1.8088, 1.8158, 1.8181, 1.8274, 1.8317, 1.8374]
    np.testing.assert_allclose(stagnation_cp(mach), want, atol=6e-5)


@pytest.mark.long
def test_shipped_table_is_what_its_script_makes(table):
    rows = runpy.run_path(str(TOOLS / "irve2_reference.py"))["rows"]()
    np.testing.assert_allclose(table.coefficients.reshape(-1, 4), rows[:, 2:], atol=6e-5)


def test_axial_coefficient_against_published_anchors(table):
    # 60 deg sphere-cone drag at zero angle: rounded published values
    mach = np.array([2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0])
    anchors = np.array([1.56, 1.545, 1.540, 1.535, 1.525, 1.51, 1.517])
    np.testing.assert_allclose(table.at(mach, np.zeros(7))[:, 0], anchors, rtol=0.03)


def test_between_mach_3p5_and_5p7_everything_is_linear(table):
    alpha = np.deg2rad(7.3)
    ends = table.at(np.array([3.5, 5.7]), alpha)
    for share in (0.13, 0.5, 0.81):
        np.testing.assert_allclose(
            table.at(3.5 + share * 2.2, alpha), (1 - share) * ends[0] + share * ends[1], rtol=1e-9
        )


def test_static_stability_falls_to_0p45_of_newtonian(table):
    _, cn, cm = sphere_cone_closed_form(np.deg2rad(np.array(5.0)), *SHAPE)
    for mach, share in ((3.0, 0.45), (3.5, 0.45), (5.7, 1.0)):
        got = table.at(mach, np.deg2rad(5.0))
        assert got[1] == pytest.approx(share * stagnation_cp(mach) * cn, rel=1e-3)
        assert got[2] == pytest.approx(share * stagnation_cp(mach) * cm, rel=1e-3)


def test_inverse_look_up(table):
    mach = np.array([2.7, 3.3, 4.4, 5.6])
    alpha = np.deg2rad(np.array([2.2, 9.7, 21.3, 44.0]))
    # the look-up is linear in the ratio between knots 1 deg apart, the ratio itself is not: (1 deg)^2/8 of curvature
    np.testing.assert_allclose(table.alpha_from_ratio(mach, table.ratio(mach, alpha)), alpha, atol=5e-5)
    assert np.isnan(table.alpha_from_ratio(np.array([3.0, 3.0]), np.array([-0.1, 3.0]))).all()
    many = np.tile(alpha, 300)
    np.testing.assert_allclose(table.alpha_from_ratio(4.4, table.ratio(4.4, many)), many, atol=5e-5)


def test_outside_the_table_is_refused(table):
    for mach, alpha in ((3.0, -0.1), (3.0, 3.2), (np.nan, 0.1)):
        with refuses("table-range", kind=TableRangeError):
            table.at(mach, alpha)


@pytest.mark.parametrize(
    ("text", "code", "name"),
    [
        ("mach,alpha_deg,ca,cn,cm\n1,0,1,0,0\n", "column-missing", "cmq"),
        ("mach,alpha_deg,ca,cn,cm,cmq\n1,0,1,0,0,0\n1,5,1,x,0,0\n2,0,1,0,0,0\n2,5,1,0,0,0\n", "not-a-number", "line 3"),
        ("mach,alpha_deg,ca,cn,cm,cmq\n1,0,1,0,0,0\n1,5,1,0,0,0\n2,0,1,0,0,0\n", "aero-grid", "3 rows"),
        (
            "mach,alpha_deg,ca,cn,cm,cmq\n" + "".join(f"{m},{a},1,0,0,0\n" for m in (1, 2) for a in (0, 5, 7)),
            "aero-grid",
            "",
        ),
    ],
)
def test_faulty_tables_are_refused(tmp_path, text, code, name):
    (tmp_path / "t.csv").write_text(text)
    with refuses(code, names=[name]):
        read_aero_table(tmp_path / "t.csv")

"""Coefficients from tables with sidecars, from DAVE-ML, from a sphere-cone's shape: what they refer to is respected."""

import re
from pathlib import Path

import numpy as np
import pytest

from flightmodel.aerodynamics import (
    Aerodynamics,
    Shape,
    Sidecar,
    SphereCone,
    aerodynamics_from,
    read_aero_table,
    read_daveml,
    read_with_sidecar,
    referred_to,
    table_from_sphere_cone,
)
from flightmodel.checks import ConfigError, GateError
from flightmodel.config import parse_section
from flightmodel.sphere_cone import stagnation_cp
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from tests.refusing import refuses

from .test_aerodynamics import PRINTED

DATA = Path(__file__).parents[1] / "data"
SIDECAR = {"source": "us", "licence": "MIT", "area_m2": 7.0686, "length_m": 3.0, "moment_reference_station_m": 0.0}
CONE = {"half_angle_deg": 60.0, "nose_radius_m": 0.38, "base_radius_m": 1.5, "cmq": -0.1}
SHAPE = Shape(np.deg2rad(60.0), 0.38, 1.5, np.pi * 1.5**2, 3.0)


# ------------------------------------------------------------------------------------------------------- sphere-cones


def test_sphere_cone_table_holds_the_printed_values():
    # printed to 1e-5 for Cp_max = 2; the table's Mach knots carry the printed Cp_max
    mach = [1.5, 2, 2.5, 3, 3.5, 4, 5, 5.7, 6, 8, 10, 20]
    cpm = np.array([1.5322, 1.6573, 1.7203, 1.7557, 1.7775, 1.7918, 1.8088, 1.8158, 1.8181, 1.8274, 1.8317, 1.8374])
    table = table_from_sphere_cone(SphereCone(**CONE, mach=mach), np.pi * 1.5**2, 3.0)
    got = table.at(np.array(mach)[:, None], np.deg2rad(PRINTED[:, 0]))
    np.testing.assert_allclose(
        got[..., :3] * (2.0 / stagnation_cp(mach))[:, None, None], [PRINTED[:, 1:]] * 12, atol=1e-5
    )
    np.testing.assert_allclose(got[:, 0, 0] * 2.0 / 1.50401, cpm, atol=6e-5)
    np.testing.assert_array_equal(got[..., 3], -0.1)


def test_sphere_cone_goes_round_and_meets_itself_at_the_half_angle():
    table = table_from_sphere_cone(SphereCone(**CONE), np.pi * 1.5**2, 3.0)
    c = table.coefficients
    assert np.rad2deg(table.alpha_rad[-1]) == pytest.approx(180.0)
    # flow on the flat base: C_A = -Cp_max, no normal force
    np.testing.assert_allclose(c[:, -1, 0], -stagnation_cp(table.mach), rtol=1e-9)
    np.testing.assert_allclose(c[:, -1, 1:3], 0.0, atol=1e-12)
    # closed form to 60 deg and quadrature beyond: second differences run on over the joint
    second = np.diff(c[10, 50:72, :3], 2, axis=0)
    assert np.abs(np.diff(second, axis=0)).max() < 2e-4


def test_scales_damping_table_and_reference_of_a_sphere_cone():
    damping = {"mach": [1.0, 3.0], "alpha_deg": [0.0, 10.0], "value": [[0.6, -0.2], [0.0, -0.4]]}
    keys = {k: v for k, v in CONE.items() if k != "cmq"} | {
        "k_a": {"mach": [2.0, 4.0], "value": [1.1, 1.2]},
        "k_n": {"mach": [3.0, 5.0], "value": [0.5, 1.0]},
        "cmq_table": damping,
    }
    plain = table_from_sphere_cone(SphereCone(**CONE), np.pi * 1.5**2, 3.0)
    table = table_from_sphere_cone(SphereCone(**keys), 2.0 * np.pi * 1.5**2, 1.5)
    for mach, k_a, k_n in ((1.5, 1.1, 0.5), (3.5, 1.175, 0.625), (8.0, 1.2, 1.0)):
        ratio = table.at(mach, 0.3) / plain.at(mach, 0.3)
        # half the coefficients on twice the area; twice the moment on half the length
        np.testing.assert_allclose(ratio[:3], [k_a / 2, k_n / 2, k_n], rtol=1e-12)
    np.testing.assert_allclose(table.at(2.0, np.deg2rad([0.0, 5.0, 40.0]))[:, 3], [0.3, 0.0, -0.3], atol=1e-12)


def test_all_faults_of_a_sphere_cone():
    names = ["'half_angle_deg'", r"sphere_cone\.nose_radius_m", r"sphere_cone\.mach"]
    with refuses("key-unknown", "key-value", names=names, kind=ConfigError):
        parse_section(
            Aerodynamics,
            {"sphere_cone": CONE | {"half_angel_deg": 1.0, "nose_radius_m": -1.0, "mach": [1.0]}},
            "v.toml",
        )
    for faulty, key in (
        ({"nose_radius_m": 4.0}, "nose_radius_m"),
        ({"cmq": None}, "cmq"),
        ({"mach": [2.0, 1.0]}, "mach"),
        ({"k_n": {"mach": [1.0, 2.0], "value": [1.0]}}, "k_n"),
    ):
        with refuses("keys-conflict", names=[key], kind=ConfigError):
            parse_section(Aerodynamics, {"sphere_cone": CONE | faulty}, "v.toml")
    with refuses("keys-conflict", kind=ConfigError):
        parse_section(Aerodynamics, {}, "v.toml")


# ----------------------------------------------------------------------------------------------- tables with sidecars


def write_table(folder, header="ca,cn,cm,cmq", sidecar=None, rows=None, stem="t"):
    lines = [f"mach,alpha_deg,{header}"]
    for mach in (1.0, 3.0):
        for alpha in range(0, 181, 20):
            a = np.deg2rad(alpha)
            values = rows(mach, a) if rows else (1.5 * np.cos(a), 0.3 * np.sin(a), -0.2 * np.sin(a), -0.1 * mach)
            lines.append(f"{mach},{alpha}," + ",".join(f"{v:.12g}" for v in values))
    (folder / f"{stem}.csv").write_text("\n".join(lines) + "\n")
    if sidecar is not None:
        text = "".join(f"{k} = {v!r}\n".replace("'", '"') for k, v in sidecar.items())
        (folder / f"{stem}.toml").write_text(text)
    return folder / f"{stem}.csv"


def test_moments_are_moved_to_the_nose(tmp_path):
    # C_m about a station x aft of the nose: the normal force's moment about the nose is -C_N x / l more
    about_nose = write_table(tmp_path, sidecar=SIDECAR)
    station = 0.535
    moved = write_table(
        tmp_path,
        sidecar=SIDECAR | {"moment_reference_station_m": station},
        rows=lambda m, a: (
            1.5 * np.cos(a),
            0.3 * np.sin(a),
            -0.2 * np.sin(a) + 0.3 * np.sin(a) * station / 3.0,
            -0.1 * m,
        ),
        stem="moved",
    )
    one, two = (referred_to(*read_with_sidecar(p), 7.0686, 3.0) for p in (about_nose, moved))
    np.testing.assert_allclose(two.coefficients, one.coefficients, atol=1e-11)
    # the same from forces: a point force at the centre of pressure has no moment about it
    x_cp = -one.coefficients[0, 3, 2] / one.coefficients[0, 3, 1] * 3.0
    back = referred_to(one, Sidecar(**SIDECAR | {"moment_reference_station_m": -x_cp}), 7.0686, 3.0)
    np.testing.assert_allclose(back.coefficients[..., 2], 0.0, atol=1e-11)  # the file's 12 digits


def test_wind_axes_reference_and_damping_rate(tmp_path):
    body = write_table(tmp_path, sidecar=SIDECAR)

    def wind(mach, a):
        ca, cn = 1.5 * np.cos(a), 0.3 * np.sin(a)
        return ca * np.cos(a) + cn * np.sin(a), cn * np.cos(a) - ca * np.sin(a), -0.2 * np.sin(a), -0.05 * mach

    stated = SIDECAR | {"axes": "wind", "damping_per": "ql/V"}
    other = write_table(tmp_path, "cd,cl,cm,cmq", stated, wind, "w")
    one, two = (referred_to(*read_with_sidecar(p), 7.0686, 3.0) for p in (body, other))
    np.testing.assert_allclose(two.coefficients, one.coefficients, atol=1e-11)
    # forces q S C, moments q S l C and damping q S l (l / 2V) C_mq do not depend on the reference
    area, length = 5.0, 2.2
    three = referred_to(*read_with_sidecar(body), area, length).coefficients
    units = np.array([area, area, area * length, area * length**2])
    np.testing.assert_allclose(
        three * units, one.coefficients * [7.0686, 7.0686, 7.0686 * 3.0, 7.0686 * 9.0], rtol=1e-12
    )


def test_sidecar_is_required_and_every_fault_of_both_is_named(tmp_path):
    path = write_table(tmp_path)
    with refuses("file-missing", names=["source"], kind=ConfigError):
        read_with_sidecar(path)
    path = write_table(tmp_path, sidecar={"sorce": "us", "area_m2": -1.0, "length_m": 3.0, "axes": "stability"})
    path.write_text(path.read_text().replace("mach,", "M,").replace("1.5,", "x,", 1))
    with pytest.raises(GateError) as caught:
        read_with_sidecar(path)
    text = str(caught.value)
    for words in ("columns mach are missing", "did you mean 'source'", "area_m2", "axes", "licence", "t.toml", "t.csv"):
        assert words in text, words


def test_header_in_capitals_is_read_and_other_names_are_told_with_the_nearest(tmp_path):
    reference = {"area_m2": 7.0, "length_m": 3.0, "moment_reference_station_m": 0.0}
    path = write_table(tmp_path, sidecar={"source": "x", "licence": "x"} | reference)
    small = read_with_sidecar(path)[0]
    path.write_text(path.read_text().replace("mach,alpha_deg,ca,cn,cm,cmq", "Mach,Alpha_deg,CA,CN,CM,Cmq"))
    np.testing.assert_array_equal(read_with_sidecar(path)[0].coefficients, small.coefficients)
    path.write_text(path.read_text().replace("Mach,Alpha_deg,CA,CN,CM,Cmq", "Mach No,AoA (deg),CA,CN,Cm_nose,CN_alpha"))
    names = [r"\bmach, alpha_deg, cm, cmq\b", re.escape("Mach No, AoA (deg), ca, cn, Cm_nose, CN_alpha")]
    with refuses("column-missing", names=names) as caught:
        read_with_sidecar(path)
    hints = re.findall(r"'([^']+)'[^;]*? (\w+):", str(caught.value))
    assert hints == [("Mach No", "mach"), ("AoA (deg)", "alpha_deg"), ("Cm_nose", "cm")]


def test_tables_uncertainty_stands_where_the_vehicle_file_is_silent(tmp_path):
    text = vehicle_path("irve2_reference").read_text()
    shipped = vehicle_path("irve2_reference").parents[1] / "aerodynamics"
    for suffix in (".csv", ".toml"):
        (tmp_path / f"mine{suffix}").write_text((shipped / f"irve2_reference{suffix}").read_text())
    (tmp_path / "mine.toml").write_text((tmp_path / "mine.toml").read_text().replace("cn = 0.07", "cn = 0.22"))
    text = text.replace('"irve2_reference.csv"', '"mine.csv"')
    (tmp_path / "v.toml").write_text(text)
    assert vehicle_from_toml(tmp_path / "v.toml").uncertainty.cn == 0.07
    (tmp_path / "v.toml").write_text(text.replace("cn = 0.07\n", ""))
    known = vehicle_from_toml(tmp_path / "v.toml").uncertainty
    assert (known.cn, known.ca) == (0.22, 0.03)


def test_shipped_table_is_read_bit_by_bit():
    path = vehicle_path("irve2_reference").parents[1] / "aerodynamics" / "irve2_reference.csv"
    vehicle = vehicle_from_toml(vehicle_path("irve2_reference"))
    np.testing.assert_array_equal(vehicle.aero.coefficients, read_aero_table(path).coefficients)


# ------------------------------------------------------------------------------------------------------------ DAVE-ML


def test_daveml_grid_points_and_what_lies_between():
    table = read_daveml(DATA / "blunt_cone.dml")
    deg = np.pi / 180.0
    np.testing.assert_allclose(table.mach, [1.5, 3.0, 6.0])
    assert table.alpha_rad[1] == pytest.approx(10.0 * deg)
    np.testing.assert_allclose(table.at(3.0, 30.0 * deg)[:3], [1.22, 0.19, -0.11])
    # the last breakpoint varies fastest, in either order of the variables
    np.testing.assert_allclose(table.at(6.0, 60.0 * deg)[:3], [0.58, 0.22, -0.16])
    np.testing.assert_allclose(table.at(4.5, 45.0 * deg)[:3], [0.9075, 0.205, -0.135])
    # damping over its own angles alone
    np.testing.assert_allclose(table.at(2.2, np.array([0.0, 5.0, 10.0, 95.0]) * deg)[:, 3], [0.2, 0.0, -0.2, -0.25])


def test_daveml_comes_in_through_a_vehicles_table_with_a_sidecar():
    spec = Aerodynamics(table="blunt_cone.dml")
    table, _ = aerodynamics_from(spec, SHAPE, (DATA,))
    c = table.at(3.0, np.deg2rad(30.0))
    area = 7.0 / SHAPE.area_m2
    np.testing.assert_allclose(c[:3], np.array([1.22, 0.19, -0.11 - 0.19 * 0.5 / 3.0]) * area)


@pytest.mark.parametrize(
    ("old", "new", "codes", "name"),
    [
        ('units="deg"><isInput/>', 'units="mil"><isInput/>', "daveml-unsupported", "mil"),
        ('varID="ALPHAT" units', 'varID="SIDESLIP" units', "daveml-unsupported", "ALPHAT"),
        ('name="normalForceCoefficient" varID="CN"', 'name="yaw" varID="Cn"', "daveml-unsupported", "CN"),
        ("1.5, 3.0, 6.0", "1.5, 1.5, 6.0", "file-unreadable", ""),
        ("0.2 -0.2 -0.3", "0.2 -0.2", "file-unreadable", "2 values"),
        ("0.2 -0.2 -0.3", "0.2 x -0.3", "file-unreadable file-unreadable", ""),
        ("<griddedTableRef gtID=", "<ungriddedTableRef utID=", "daveml-unsupported", ""),
        ('<dependentVarRef varID="CA"/>', '<dependentVarRef varID="CX"/>', "daveml-unsupported", "CA"),
        ("0 30 60 90 180", "0 30 60 90 170", "aero-grid", "180|170"),
        ("<DAVEfunc xmlns", "<DAVE xmlns", "file-unreadable", ""),
    ],
)
def test_daveml_refuses_what_it_does_not_understand(tmp_path, old, new, codes, name):
    text = (DATA / "blunt_cone.dml").read_text()
    assert old in text
    text = text.replace(old, new)
    if "170" in new:
        text = text.replace("0 10 180", "0 10 170")
    (tmp_path / "x.dml").write_text(text)
    with refuses(*codes.split(), names=[name]):
        read_daveml(tmp_path / "x.dml")


def test_daveml_never_expands_entities_nor_opens_other_files(tmp_path):
    text = (DATA / "blunt_cone.dml").read_text()
    head = text[text.index("<!DOCTYPE") : text.index("<DAVEfunc xmlns")]
    secret = tmp_path / "secret.txt"
    secret.write_text("1.5, 3.0, 6.0")
    bomb = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10 if k else "0 "}">' for k in range(12))
    for subset, use in (
        (f'<!ENTITY x SYSTEM "{secret.as_uri()}">', "&x;"),
        (bomb, "&a11;"),
        ('<!ENTITY % p SYSTEM "http://localhost:9/x.dtd"> %p;', "1.5, 3.0, 6.0"),
    ):
        evil = text.replace(head, f"<!DOCTYPE DAVEfunc [{subset}]>\n").replace("1.5, 3.0, 6.0", use)
        (tmp_path / "evil.dml").write_text(evil)
        with refuses("file-unreadable"):
            read_daveml(tmp_path / "evil.dml")

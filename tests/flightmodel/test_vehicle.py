import shutil

import numpy as np
import pytest

from flightmodel.checks import ConfigError
from flightmodel.config import parse_section
from flightmodel.deflection import DeflectionHistory, history_from_lateral, lv_clock, lv_direction
from flightmodel.vehicle import MassProperties, vehicle_from_toml, vehicle_path
from tests.refusing import refuses


@pytest.fixture(scope="module")
def vehicle():
    return vehicle_from_toml(vehicle_path("irve2_reference"))


@pytest.mark.parametrize(
    ("stiffness", "frequency", "critical"),
    [
        (2774.4, 2.0, 441.56),
        (3511.4, 2.25, 496.76),
        (4335.0, 2.5, 551.94),
        (6242.4, 3.0, 662.34),
        (11098.0, 4.0, 883.12),
    ],
)
def test_paper_table_3_1(vehicle, stiffness, frequency, critical):
    from dataclasses import replace

    joint = vehicle.joint.model_copy(update={"bending_stiffness_nmprad": stiffness})
    other = replace(vehicle, joint=joint)
    assert other.free_free_frequency_hz() == pytest.approx(frequency, rel=5e-4)
    assert other.critical_damping_nmsprad() == pytest.approx(critical, rel=5e-4)


def test_reference_vehicle_carries_the_papers_offset(vehicle):
    offset_cm = 100.0 * vehicle.cg_m[1:]
    np.testing.assert_allclose(offset_cm, [0.40, -0.04], atol=1e-4)
    assert np.rad2deg(lv_clock(offset_cm)) == pytest.approx(185.71, abs=0.01)
    assert -vehicle.cg_m[0] == pytest.approx(0.535, abs=1e-3)


def test_suba_clocking(vehicle):
    dcm = vehicle.sensors["suba"].dcm_body_sensor
    np.testing.assert_allclose(dcm @ dcm.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.rad2deg(lv_clock(dcm.T[:2, 1:])), [135.0, 225.0])
    np.testing.assert_allclose(dcm[:, 2], [-1.0, 0.0, 0.0], atol=1e-15)  # z aft


def test_inertia_of_the_whole_by_parallel_axes(vehicle):
    total = np.zeros((3, 3))
    for body in (vehicle.aeroshell, vehicle.centerbody):
        # the same with point masses: four masses on each axis that carry the tensor
        values, axes = np.linalg.eigh(body.inertia)
        spread = 0.5 * (values.sum() - 2 * values)
        for s, axis in zip(spread, axes.T, strict=True):
            arm = np.sqrt(s / body.mass_kg * 3.0) * axis
            for sign in (1, -1):
                d = body.cg_m + sign * arm - vehicle.cg_m
                total += body.mass_kg / 6.0 * (d @ d * np.eye(3) - np.outer(d, d))
    np.testing.assert_allclose(vehicle.inertia, total, atol=1e-9)


def edited(tmp_path, *changes):
    source = vehicle_path("irve2_reference")
    text = source.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_every_fault_of_a_file_at_once_with_the_nearest_key(tmp_path):
    path = edited(tmp_path, ("half_angle_deg = 60.0", "half_angel_deg = 60.0"), ("mass_kg = 40.0", "mass_kg = -40.0"))
    names = ["half_angel_deg", "'half_angle_deg'", r"aeroshell\.mass_kg"]
    with refuses("key-unknown", "key-missing", "key-value", names=names, kind=ConfigError) as caught:
        vehicle_from_toml(path)
    assert len(caught.value.faults) >= 3  # the misspelt key, the one it leaves missing, the mass


def test_impossible_inertia_is_refused(tmp_path):
    path = edited(
        tmp_path, ("[[2.0, 0.0, 0.0], [0.0, 25.0, 0.0], [0.0, 0.0, 25.0]]", "[[60.0,0,0],[0,25.0,0],[0,0,25.0]]")
    )
    with refuses("key-value", kind=ConfigError):
        vehicle_from_toml(path)


def test_three_moments_of_inertia_are_the_diagonal_and_other_forms_are_told(tmp_path):
    def body(inertia):
        table = {"mass_kg": 1.0, "cg_from_datum_body_m": [0.0, 0.0, 0.0], "inertia_kgm2": inertia}
        return parse_section(MassProperties, table, "x.toml")

    np.testing.assert_array_equal(body([7.0, 4, 4.0]).inertia, np.diag([7.0, 4.0, 4.0]))
    for wrong in (3.0, [1.0, 2.0], [[1.0, 2.0, 3.0]], [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], [1.0, [0, 1, 0], 2.0]):
        with refuses("key-value", kind=ConfigError) as caught:
            body(wrong)
        assert len(caught.value.faults) == 1
    with refuses("key-value", kind=ConfigError):
        body("FILL IN")
    with refuses("key-value", kind=ConfigError):
        body([True, 1.0, 1.0])


def test_unknown_vehicle_and_bad_toml(tmp_path):
    with refuses("name-unknown", names=["'irve2_reference'"], kind=ConfigError):
        vehicle_path("irve2_refrence")
    (tmp_path / "bad.toml").write_text("a = = 1")
    with refuses("toml-syntax", names=["line 1"], kind=ConfigError):
        vehicle_from_toml(tmp_path / "bad.toml")


def test_table_beside_the_vehicle_file_is_used_first(tmp_path):
    path = edited(tmp_path)
    shipped = vehicle_path("irve2_reference").parent.parent / "aerodynamics" / "irve2_reference.csv"
    shutil.copy(shipped, tmp_path / "irve2_reference.csv")
    shutil.copy(shipped.with_suffix(".toml"), tmp_path / "irve2_reference.toml")
    text = (tmp_path / "irve2_reference.csv").read_text().replace("\n3,0,", "\n3,0,9", 1)
    (tmp_path / "irve2_reference.csv").write_text(text)
    assert vehicle_from_toml(path).aero.at(3.0, 0.0)[0] > 9.0


def test_clock_angles_round_trip():
    phi = np.deg2rad(np.array([3.0, 95.0, 153.0, 186.0, 271.0, 359.0]))
    np.testing.assert_allclose(lv_clock(lv_direction(phi)[:, 1:]), phi)


def test_history_from_lateral_vectors_has_the_covariance_of_a_monte_carlo():
    rng = np.random.default_rng(2)
    mean, root = np.array([0.05, -0.03]), np.array([[0.004, 0.0], [0.002, 0.003]])
    cov = root @ root.T
    draws = mean + rng.normal(size=(20000, 2)) @ root.T
    history = history_from_lateral(np.array([0.0]), mean[None], cov[None], "trim", "")
    many = history_from_lateral(np.arange(20000.0), draws, np.tile(cov, (20000, 1, 1)), "trim", "")
    sampled = np.cov(np.column_stack([many.theta_rad, many.plane_lv_rad]).T)
    # 1 % of sampling, and second-order terms of 4 mrad against 58 mrad
    np.testing.assert_allclose(
        history.covariance[0], sampled, rtol=0.05, atol=0.02 * np.sqrt(sampled[0, 0] * sampled[1, 1])
    )
    np.testing.assert_allclose(history.theta_yz_rad[0], mean)


def test_a_flat_piece_of_a_swinging_history_is_no_better_known_between_answers():
    theta = np.array([0.03, 0.07, 0.03, 0.05, 0.05, 0.05, 0.05, 0.07, 0.03, 0.07])
    history = DeflectionHistory(np.arange(10.0), theta, np.zeros(10), np.tile(np.eye(2) * 1e-6, (10, 1, 1)), "camera")
    value, sd = history.angle_at(4.5)
    assert value == pytest.approx(0.05)
    assert sd == pytest.approx(0.125 * 0.06, rel=0.02)  # the largest second difference, 0.06, about here


def test_history_between_and_outside_its_answers():
    t, theta = np.array([0.0, 1.0, 2.0, 3.0]), np.array([np.nan, 0.02, 0.04, np.nan])
    history = DeflectionHistory(t, theta, np.zeros(4), np.tile(np.eye(2) * 1e-4, (4, 1, 1)), "camera")
    assert history.angle_at(1.5) == pytest.approx((0.03, 0.01))
    assert np.isnan(history.angle_at(0.5)[0])
    with refuses("argument-value"):
        DeflectionHistory(t[::-1].copy(), theta, np.zeros(4), None, "camera")

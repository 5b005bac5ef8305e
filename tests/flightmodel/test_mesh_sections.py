"""Sections of meshes by half-planes, and the circles that stand for them, against shapes in closed form."""

import numpy as np
import pytest

from flightmodel.geometry import BodyMesh, aft_profile, edge_circles, torus_circles, torus_limb
from flightmodel.mesh_sections import SUPPORT_ANGLES, meridian_sections, nearest_on_sections, touching_circles
from flightmodel.shell_features import read_features
from flightmodel.vehicle import read_vehicle
from tests.flightmodel.meshes_of_vehicles import shell_mesh
from tests.refusing import refuses

GEOMETRY = read_vehicle("irve2_reference").geometry
EYE = np.array([-1.4, -0.25, 0.14])
HEAD = "station_m,radius_m,clock_lv_deg,kind,shade,width_m\n"


def body_of(mesh):
    return BodyMesh(np.array(mesh.vertices), np.array(mesh.faces), "")


def odd(mesh):
    """Oval by 2 %, and scalloped between 24 gores by 12 mm."""
    x, y, z = np.asarray(mesh.vertices).T
    r, clock = np.hypot(y, z), np.arctan2(z, -y)
    grow = 1.0 + 0.02 * np.cos(2.0 * clock + 0.6) - 0.008 * np.abs(np.sin(12.0 * clock)) * r / 1.5
    mesh.vertices = np.column_stack([x, grow * y, grow * z])
    return mesh


@pytest.mark.parametrize("clock", [0.0, np.pi / 12.0, 0.1234, 6.28])  # corners lie in the first two half-planes
def test_a_section_is_the_meridian(clock):
    mesh = shell_mesh(GEOMETRY, 24)
    plane, ends = meridian_sections(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.array([clock]))
    assert set(plane) == {0}
    # between corners a face lies within the circle: by cos(7.5 deg) in the middle
    inside = np.cos(np.mod(clock, np.pi / 12.0) - np.pi / 24.0) / np.cos(np.pi / 24.0)
    assert ends[..., 1].max() == pytest.approx(aft_profile(GEOMETRY)[:, 1].max() / inside, rel=2e-4)
    # whole: off the axis, whose faces have no clocking angle, every end is another segment's end too
    points, count = np.unique(np.round(ends.reshape(-1, 2), 9), axis=0, return_counts=True)
    assert (count[points[:, 1] > 0.3] % 2 == 0).all()


def test_a_sharp_rim_is_a_circle_without_radius_and_a_round_one_itself():
    eye = np.array([[1.4, 0.3]])
    v = SUPPORT_ANGLES
    corner = 1.5 * np.cos(v) + 0.9 * np.sin(v)
    rounded = corner + 0.11
    found = touching_circles(np.stack([corner, rounded]), np.tile(eye, (2, 1)))
    np.testing.assert_allclose(found, [[0.9, 1.5, 0.0], [0.9, 1.5, 0.11]], atol=1e-9)
    assert np.isnan(touching_circles(corner[None], np.array([[0.0, 3.0]]))).all()


def test_the_edge_of_a_fine_mesh_is_that_of_the_tori_it_was_made_of():
    clocks = np.deg2rad(np.arange(0.0, 360.0, 7.3))
    shell = GEOMETRY.with_mesh(body_of(shell_mesh(GEOMETRY, 360)))
    circles = edge_circles(shell, EYE, clocks)
    station, radius = torus_circles(GEOMETRY)
    np.testing.assert_allclose(edge_circles(GEOMETRY, EYE, clocks)[:, 0], station[-1])
    # 25 corners to half a circle: it is 0.9 mm smaller on the average than the one through them
    np.testing.assert_allclose(circles[:, 1] + circles[:, 2], radius[-1] + GEOMETRY.torus_minor_radius_m, atol=2e-3)
    limb, away = torus_limb(GEOMETRY, EYE, clocks), circles[:, :2] - [station[-1], radius[-1]]
    assert np.abs(away).max() < 2.5e-3
    assert np.isfinite(limb).all()


def test_a_feature_lies_on_the_mesh_where_that_departs_from_the_tori(tmp_path):
    shell = GEOMETRY.with_mesh(body_of(odd(shell_mesh(GEOMETRY, 240))))
    clocks = np.deg2rad([78.0, 155.0, 260.0])
    plane, ends = meridian_sections(shell.mesh.vertices_m, shell.mesh.faces, clocks)
    rows, wanted = [], []
    for k, clock in enumerate(clocks):
        middles = ends[plane == k].mean(axis=1)
        place = middles[np.argmin(np.abs(middles[:, 1] - 1.42) - 10.0 * (middles[:, 0] > 0.9))]
        rows.append(f"{place[0]:.6f},{place[1]:.6f},{np.rad2deg(clock):.6f},dot,darker,0.02")
        wanted.append(place)
    off, normal = nearest_on_sections(shell.mesh.vertices_m, shell.mesh.faces, np.array(wanted), clocks)
    assert off.max() < 1e-9
    np.testing.assert_allclose(np.hypot(*normal.T), 1.0)
    assert (normal[:, 0] > 0.0).all()
    (tmp_path / "marks.csv").write_text(HEAD + "\n".join(rows))
    listed = read_features(tmp_path / "marks.csv", shell)
    np.testing.assert_allclose(np.hypot(*listed.points_shell_m[:, 1:].T), np.array(wanted)[:, 1], atol=1e-6)
    rows[1] = rows[1].replace(f",{wanted[1][1]:.6f},", f",{wanted[1][1] + 0.2:.6f},")
    (tmp_path / "marks.csv").write_text(HEAD + "\n".join(rows))
    with refuses("edit-unusable", names=["line 3"]):
        read_features(tmp_path / "marks.csv", shell)

"""A shell of the user's own mesh, oval and scalloped: its edge and surface against its picture, its film read."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.features import visible_features
from estimators.texture import surface_seen
from estimators.virtual_camera import VirtualCamera, deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.geometry import FEATURE_KINDS, ListedFeatures, bend
from flightmodel.rendering import render
from synthetic_flight.film import ShellRenderer, Warp, render_video
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, sun
from tests.flightmodel.meshes_of_vehicles import shell_mesh
from tests.flightmodel.test_mesh_sections import body_of, odd

ODD = GEOMETRY.with_mesh(body_of(odd(shell_mesh(GEOMETRY, 240))))


@pytest.mark.parametrize(("theta_deg", "plane_deg"), [(0.0, 0.0), (5.0, 200.0)])
def test_the_edge_is_the_border_of_the_mesh_s_picture(theta_deg, plane_deg):
    n = 4
    fine = camera_from_mount(MOUNT).sampled(n)
    deflected = bend(ODD.mesh.vertices_m, D(theta_deg), D(plane_deg), JOINT_M)
    hit = render(fine, deflected, ODD.mesh.faces).is_hit
    edge = VirtualCamera(ODD, fine, JOINT_M).edge(deformation_of(D(theta_deg), D(plane_deg)))
    inside = fine.is_inside(edge.pixels, 40.0)
    off = []
    for at, inward in zip(edge.pixels[inside], edge.inward_px[inside], strict=True):
        along = np.arange(-30.0, 30.0, 0.25)
        u, v = np.rint(at + along[:, None] * inward).astype(int).T
        off.append(along[np.argmax(hit[v, u])] / n)
    tori = VirtualCamera(GEOMETRY, fine, JOINT_M).edge(deformation_of(D(theta_deg), D(plane_deg))).pixels
    assert len(off) > 60
    assert abs(np.mean(off)) < 0.1
    assert np.std(off) < 0.15
    assert np.abs(tori[inside[: len(tori)]] - edge.pixels[inside]).max() > 8.0  # fine pixels: it is another edge


def test_pixels_look_at_the_mesh_s_faces():
    view = VirtualCamera(ODD, camera_from_mount(MOUNT), JOINT_M)
    pixels = np.stack(np.meshgrid(np.arange(40, 700, 60), np.arange(80, 440, 60)), axis=-1).reshape(-1, 2)
    seen = surface_seen(view, pixels.astype(float))
    on = seen.torus >= 0
    assert on.sum() > 30
    back = view.sight(seen.points_shell_m[on], np.zeros(3)).pixels
    np.testing.assert_allclose(back, pixels[on], atol=1e-6)
    towards = view.camera.position_body_m - seen.points_shell_m[on]
    assert (np.einsum("ni,ni->n", towards, seen.normals[on]) > 0.0).all()


def test_a_listed_feature_behind_the_mesh_is_not_looked_for():
    view = VirtualCamera(ODD, camera_from_mount(MOUNT), JOINT_M)
    seen = surface_seen(view, np.array([[360.0, 150.0], [250.0, 300.0]]))
    away = seen.points_shell_m - view.camera.position_body_m
    points = np.concatenate([seen.points_shell_m, seen.points_shell_m + 0.15 * away])
    kind = np.full(4, FEATURE_KINDS.index("dot"))
    listed = ListedFeatures(points, np.tile(seen.normals, (2, 1)), kind, np.full(4, 0.02), np.zeros(4, dtype=bool))
    shell = ODD.with_listed(listed)
    found = visible_features(replace(view, geometry=shell)).points_shell_m
    np.testing.assert_allclose(found, np.tile(points[:2], (2, 1)))


def test_the_film_of_a_mesh_of_the_tori_is_that_of_the_tori():
    camera, warp = camera_from_mount(MOUNT), Warp(0.01, 0.01, -0.006, 0.004, 0.003)
    mesh = body_of(shell_mesh(GEOMETRY, 360))
    (cover, shade, _), (own_cover, own_shade, _) = (
        ShellRenderer(shell, camera, JOINT_M, shadows=False).seen(D(4.0), D(200.0), sun(200.0), warp)
        for shell in (GEOMETRY, GEOMETRY.with_mesh(mesh))
    )
    clear = ShellRenderer(GEOMETRY, camera, JOINT_M).is_clear
    apart = np.abs(own_cover - cover)[clear]
    assert np.mean(apart > 0.5) < 1e-3
    assert abs((own_cover - cover)[clear].sum()) < 1e-3 * cover[clear].sum()
    both = clear & (cover == 1.0) & (own_cover == 1.0)
    assert np.corrcoef(shade[both], own_shade[both])[0, 1] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("features", ["drawn", "texture"])
def test_the_film_of_an_odd_shell_is_read_with_its_mesh(features):
    theta, plane = np.array([0.0, 3.2]), np.array([0.0, 190.0])
    light = np.stack([sun(200.0), sun(215.0)])
    frames = list(render_video(ODD, MOUNT, JOINT_M, D(theta), D(plane), light, np.random.default_rng(8)))
    stated = ODD.model_copy(update={"features": features})
    oriented = orient_camera(frames[0], stated, MOUNT, JOINT_M)
    by_tori = orient_camera(frames[0], GEOMETRY.model_copy(update={"features": features}), MOUNT, JOINT_M)
    fit = oriented.fit(frames[1])
    lateral = D(3.2) * np.array([-np.cos(D(190.0)), np.sin(D(190.0))])
    error = fit.rotation_yz_rad - np.array([-lateral[1], lateral[0]])
    assert not fit.refused
    assert error @ np.linalg.solve(fit.covariance, error) < 11.8  # 3 sd
    assert np.rad2deg(np.linalg.norm(error)) < 0.3
    assert oriented.residual_rms_px < 0.7 * by_tori.residual_rms_px

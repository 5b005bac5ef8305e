"""The shell's own texture as a measurement: where a pixel looks, how a patch is found, and what its sd says."""

import cv2
import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.frame_edits import EditedFrame
from estimators.frame_solution import found_rows
from estimators.texture import PaintedTexture, surface_seen, texture_of
from estimators.virtual_camera import VirtualCamera, deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.geometry import vehicle_meshes
from flightmodel.rendering import render
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, film

VIEW = VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)


def cloth(rng, shape=(480, 720)):
    """Random texture a few pixels wide."""
    grey = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 2.0)
    return np.clip(120.0 + 30.0 * grey / grey.std(), 0, 255).astype(np.uint8)


def test_a_pixel_looks_at_the_surface_that_rasterised_triangles_show():
    pixels = np.random.default_rng(0).uniform([20.0, 20.0], [700.0, 460.0], (400, 2))
    seen = surface_seen(VIEW, pixels)
    hit = seen.torus >= 0
    assert 0.3 < hit.mean() < 0.95
    np.testing.assert_allclose(VIEW.sight(seen.points_shell_m[hit], np.zeros(3)).pixels, pixels[hit], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(seen.normals[hit], axis=1), 1.0, atol=0.01)
    away = np.linalg.norm(seen.points_shell_m - VIEW.camera.position_body_m, axis=1)
    meshes = vehicle_meshes(GEOMETRY, 240, 48)
    tori = [mesh for name, mesh in meshes.items() if name.startswith("torus")] + [meshes["centerbody"]]
    start = np.cumsum([0] + [len(mesh.vertices) for mesh in tori])
    faces = np.concatenate([mesh.faces + first for mesh, first in zip(tori, start, strict=False)])
    depth = render(VIEW.camera, np.concatenate([mesh.vertices for mesh in tori]), faces).depth_m
    u, v = np.rint(pixels).astype(int).T
    same = np.abs(depth[v, u] - away)[hit] < 0.03  # a pixel beside a limb shows the torus behind
    assert same.mean() > 0.93


def warped(picture, deformation):
    """The picture as the camera sees it when its texture comes along with the deflected shell."""
    v, u = np.mgrid[:480, :720].astype(float)
    seen = surface_seen(VIEW, np.column_stack([u.ravel(), v.ravel()]))
    there = VIEW.sight(seen.points_shell_m, deformation).pixels - VIEW.sight(seen.points_shell_m, np.zeros(3)).pixels
    moved = np.where((seen.torus >= 0)[:, None] & np.isfinite(there), there, 0.0).reshape(480, 720, 2)
    back = np.zeros_like(moved)
    for _ in range(6):  # where a pixel's content came from
        back = np.stack(
            [
                cv2.remap(
                    np.ascontiguousarray(moved[..., k]).astype(np.float32),
                    (u - back[..., 0]).astype(np.float32), (v - back[..., 1]).astype(np.float32), cv2.INTER_LINEAR,
                )
                for k in (0, 1)
            ],
            axis=-1,
        )  # fmt: skip
    return cv2.remap(
        picture, (u - back[..., 0]).astype(np.float32), (v - back[..., 1]).astype(np.float32), cv2.INTER_CUBIC
    )


@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_texture_is_found_where_the_deflected_shell_has_it_whatever_the_exposure(gain):
    rng = np.random.default_rng(2)
    picture = cloth(rng)
    texture = texture_of(VIEW, picture)
    assert len(texture.templates) > 300
    deformation = deformation_of(D(3.0), D(190.0))
    frame = np.clip(gain * warped(picture, deformation) + rng.normal(0.0, 2.0, picture.shape), 0, 255).astype(np.uint8)
    place, sd = texture.find(VIEW, frame, deformation_of(D(2.8), D(188.0)), 3)
    found = np.isfinite(sd)
    assert found.mean() > 0.5
    true = np.einsum("ni,ni->n", VIEW.sight(texture.points_shell_m, deformation).pixels, texture.across_px)
    off = (place - true)[found]
    assert np.median(np.abs(off)) < 0.15
    assert abs(np.median(off)) < 0.02
    # on a film in moving light, where patches differ by more than noise, the sd is right; in white noise, which a
    # template averages better than the band-pass correlates it, up to three times too large
    assert 0.3 < np.median(np.abs(off) / sd[found]) / 0.6745 < 1.2


def test_noise_alone_is_no_texture():
    rng = np.random.default_rng(3)
    texture = texture_of(VIEW, cloth(rng))
    _, sd = texture.find(VIEW, cloth(np.random.default_rng(4)), np.zeros(3), 3)
    assert np.isfinite(sd).mean() < 0.01
    assert len(texture_of(VIEW, np.full((480, 720), 90, dtype=np.uint8)).templates) == 0


def test_light_along_the_tori_that_moves_does_not_move_a_patch():
    v, u = np.mgrid[:480, :720].astype(float)
    along = surface_seen(VIEW, np.column_stack([u.ravel(), v.ravel()])).normals[:, 0].reshape(480, 720)
    paint = cloth(np.random.default_rng(5)).astype(float)
    lit = [1.0 + 0.4 * np.sin(9.0 * along + phase) for phase in (0.0, 1.5)]
    before, after = (np.clip(paint * shade, 0, 255).astype(np.uint8) for shade in lit)
    texture = texture_of(VIEW, before)
    place, sd = texture.find(VIEW, after, np.zeros(3), 3)
    there = np.einsum("ni,ni->n", VIEW.sight(texture.points_shell_m, np.zeros(3)).pixels, texture.across_px)
    found = np.isfinite(sd)
    assert found.mean() > 0.7
    off = (place - there)[found]
    assert np.abs(off.mean()) < 0.05  # the least sd of a place
    assert np.std(off) < 0.2


def test_no_patch_lies_across_a_shadow_s_edge_but_where_the_shell_is_painted_so():
    picture = cloth(np.random.default_rng(6)).astype(float)
    shaded, painted = picture.copy(), picture.copy()
    shaded[:, 330:400] *= 0.2
    columns = np.arange(720) // 10 % 2 == 0
    painted[:, columns] *= 0.2

    def columns_of(grey):
        texture = texture_of(VIEW, grey.astype(np.uint8))
        return VIEW.sight(texture.points_shell_m, np.zeros(3)).pixels[::2, 0]

    for edge in (330.0, 400.0):
        assert (np.abs(columns_of(picture) - edge) < 4.0).any()
        assert not (np.abs(columns_of(shaded) - edge) < 4.0).any()
    assert len(columns_of(painted)) > 0.5 * len(columns_of(picture))


def test_behind_painted_features_the_texture_measures_where_most_of_it_agrees():
    frames = film(7, [0.0, 3.0, 4.0], [0.0, 160.0, 150.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    features, painted = oriented.features, oriented.painted_rows
    assert isinstance(features, PaintedTexture)
    at = np.array([*oriented.fit(frames[2]).rotation_yz_rad, 0.0])
    found = features.find(oriented.view, frames[2], at, 8)
    assert len(found_rows(found)) > 0.7 * painted
    assert np.isinf(found[1][painted:]).all()
    place = oriented._texture_near(EditedFrame(frames[2]), at, found)
    assert found_rows(place)[0] >= painted
    # where the paint is elsewhere, what agrees may be a part of the picture of another time
    off = found[0] + np.where(np.arange(len(found[0])) % 3 == 0, 4.0, 0.0)
    assert oriented._texture_near(EditedFrame(frames[2]), at, (off, found[1])) is None
    assert oriented._texture_near(EditedFrame(np.full_like(frames[2], 90)), at, found) is None


def test_a_mark_that_is_found_elsewhere_than_its_cloth_does_not_move_the_answer():
    """Light from one side shifts where painted marks are darkest; here by half a pixel, all of them."""
    frames = film(7, [0.0, 3.0], [0.0, 160.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    shifted = oriented.features.painted.find

    class Shifted(type(oriented.features.painted)):
        def find(self, view, image, deformation, reach_px):
            place, sd = shifted(view, image, deformation, reach_px)
            return place + 0.5 * self.across_px[:, 1], sd

    moved = Shifted(**vars(oriented.features.painted))
    object.__setattr__(oriented.features, "painted", moved)
    answer = oriented.fit(frames[1])
    np.testing.assert_allclose(answer.rotation_yz_rad, deformation_of(D(3.0), D(160.0))[:2], atol=D(0.05))

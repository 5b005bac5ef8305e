"""Lens, pointing and conventions of the camera."""

import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import flightmodel
from flightmodel.camera import Camera, camera_from_mount, lens_distance, one_to_one_half_angle_rad
from flightmodel.deflection import lv_direction
from flightmodel.vehicle import CameraMount
from tests.refusing import refuses

TOML = Path(flightmodel.__file__).parent / "data/vehicles/irve2_reference.toml"
D = np.deg2rad


@pytest.fixture(scope="module")
def mount():
    return CameraMount.model_validate(tomllib.loads(TOML.read_text())["cameras"]["camera5"])


@pytest.fixture(scope="module")
def camera(mount):
    """Nothing symmetric: unequal focal lengths, off-centre, turned about all axes."""
    crooked = replace(camera_from_mount(mount), focal_px=np.array([310.0, 322.0]), centre_px=np.array([341.3, 251.7]))
    return crooked.turned(np.array([0.05, -0.08, 0.11]), 1.03)


def points_ahead(camera, n=400, seed=1):
    rng = np.random.default_rng(seed)
    away = rng.uniform(0.0, D(80.0), n)
    around = rng.uniform(0.0, 2.0 * np.pi, n)
    cam = np.column_stack([np.sin(away) * np.cos(around), np.sin(away) * np.sin(around), np.cos(away)])
    return camera.position_body_m + (rng.uniform(0.5, 3.0, (n, 1)) * cam) @ camera.dcm_cam_body


def test_projection_is_opencvs_with_the_pose_given_as_rvec_and_tvec(camera):
    points = points_ahead(camera)
    rvec, _ = cv2.Rodrigues(camera.dcm_cam_body)
    tvec = -camera.dcm_cam_body @ camera.position_body_m
    matrix = np.array(
        [[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]]
    )
    theirs, _ = cv2.fisheye.projectPoints(points[:, None, :], rvec, tvec, matrix, camera.distortion)
    np.testing.assert_allclose(camera.project(points), theirs[:, 0], atol=1e-9)


def test_projection_is_the_polynomial_of_its_docstring(camera):
    points = points_ahead(camera)
    x, y, z = camera.cam_from_body(points).T
    r = np.hypot(x, y)
    a_d = lens_distance(np.arctan2(r, z), camera.distortion)
    by_hand = np.column_stack([a_d * x / r, a_d * y / r]) * camera.focal_px + camera.centre_px
    np.testing.assert_allclose(camera.project(points), by_hand, atol=1e-9)


def test_derivatives_by_point_and_lens_equal_central_differences(camera):
    points = points_ahead(camera, 50)
    _, per_cam, per_lens = camera.project_with_jacobian(points)
    per_body = per_cam @ camera.dcm_cam_body
    h = 1e-6
    for k in range(3):
        step = h * np.eye(3)[k]
        numeric = (camera.project(points + step) - camera.project(points - step)) / (2 * h)
        np.testing.assert_allclose(per_body[:, :, k], numeric, atol=2e-5)  # roundoff 1e-13 / 1e-6 and h^2 terms
    for name, columns in (("focal_px", slice(0, 2)), ("centre_px", slice(2, 4)), ("distortion", slice(4, 8))):
        value = getattr(camera, name)
        for k, column in enumerate(range(columns.start, columns.stop)):
            step = 1e-6 * np.eye(len(value))[k]
            up, down = (replace(camera, **{name: value + s}).project(points) for s in (step, -step))
            np.testing.assert_allclose(per_lens[:, :, column], (up - down) / 2e-6, atol=1e-4)


def test_pixel_to_ray_to_pixel_is_exact_over_the_whole_picture(camera):
    rng = np.random.default_rng(2)
    pixels = rng.uniform([0.0, 0.0], [719.0, 479.0], (2000, 2))
    pixels[0] = camera.centre_px
    rays = camera.rays_body(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(camera.project(camera.position_body_m + 2.5 * rays), pixels, atol=1e-8)


def test_points_behind_or_beyond_the_field_have_no_pixel(camera):
    ahead = points_ahead(camera, 20)
    mirrored = 2.0 * camera.position_body_m - ahead
    assert np.isfinite(camera.project(ahead)).all()
    assert np.isnan(camera.project(mirrored)).all()
    mixed = camera.project(np.vstack([mirrored[:3], ahead[:3]]))
    np.testing.assert_array_equal(np.isnan(mixed[:, 0]), [True] * 3 + [False] * 3)
    # a lens that folds over at 0.8 rad: a_d = a - a^3 / (3 0.8^2)
    folding = replace(camera, distortion=np.array([-1.0 / (3.0 * 0.64), 0.0, 0.0, 0.0]))
    assert one_to_one_half_angle_rad(folding.distortion) == pytest.approx(0.8, abs=2e-3)
    beyond = camera.position_body_m + np.array([[np.sin(0.9), 0.0, np.cos(0.9)]]) @ camera.dcm_cam_body
    assert np.isnan(folding.project(beyond)).all()
    assert np.isnan(folding.rays_body(np.array([[0.0, 0.0]]))).all()


def test_small_off_centre_picture_by_hand():
    """A 7 x 5 picture, principal point off centre, equidistant lens: every number can be written down."""
    camera = Camera(7, 5, np.array([4.0, 8.0]), np.array([2.0, 1.0]), np.zeros(4), np.array([1.0, 2.0, 3.0]), np.eye(3))
    tilt = 0.25
    points = np.array([1.0, 2.0, 3.0]) + np.array(
        [[0, 0, 1], [np.sin(tilt), 0, np.cos(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    np.testing.assert_allclose(camera.project(points), [[2, 1], [3, 1], [2, 3]], atol=1e-12)
    corners = np.array([[-0.5, -0.5], [6.5, 4.5], [6.6, 4.0], [3.0, 4.6], [np.nan, 1.0]])
    np.testing.assert_array_equal(camera.is_inside(corners), [True, True, False, False, False])


def test_mounted_camera_has_the_sky_up_and_increasing_clock_to_the_left(mount):
    camera = camera_from_mount(mount)
    outboard = lv_direction(D(mount.clock_lv_deg))
    np.testing.assert_allclose(camera.dcm_cam_body @ camera.dcm_cam_body.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(camera.dcm_cam_body) == pytest.approx(1.0)
    axis = camera.dcm_cam_body[2]
    assert np.degrees(np.arccos(axis[0])) == pytest.approx(mount.axis_from_forward_deg)
    assert axis @ outboard > 0.0
    ahead = camera.position_body_m + 2.0 * axis
    centre, out, aft, left = camera.project(
        np.array(
            [
                ahead,
                ahead + 0.1 * outboard,
                ahead - [0.1, 0, 0],
                ahead + 0.1 * lv_direction(D(mount.clock_lv_deg + 90.0)),
            ]
        )
    )
    np.testing.assert_allclose(centre, mount.centre_px, atol=1e-9)
    assert out[1] < centre[1] - 1.0
    assert aft[1] < centre[1] - 1.0
    assert left[0] < centre[0] - 1.0
    assert left[1] == pytest.approx(centre[1])


def test_a_positive_turn_about_camera_y_moves_the_scene_right(camera):
    point = camera.position_body_m + 2.0 * camera.dcm_cam_body[2][None]
    moved = camera.turned(np.array([0.0, 0.01, 0.0])).project(point) - camera.project(point)
    np.testing.assert_allclose(moved, [[0.01 * camera.focal_px[0], 0.0]], atol=1e-4)  # third order in 0.01


@pytest.mark.parametrize("lens", ["fisheye", "pinhole"])
def test_terms_of_many_turned_cameras_are_those_of_each(camera, lens):
    if lens == "pinhole":
        camera = replace(camera, lens=lens, distortion=np.array([-0.05, 0.01, 1e-3, -7e-4, 0.002]))
    rng = np.random.default_rng(3)
    turn, scale = 0.2 * rng.standard_normal((6, 3)), 1.0 + 0.05 * rng.standard_normal(6)
    centre = camera.centre_px + rng.standard_normal((6, 2))
    # the first ones fold within the field
    distortion = camera.distortion + np.linspace(-0.4, 0.0, 6)[:, None] * np.eye(len(camera.distortion))[0]
    position = camera.position_body_m + 0.01 * rng.standard_normal((6, 3))
    model, *terms = camera.terms_of_turned(
        turn, scale, centre_px=centre, distortion=distortion, position_body_m=position
    )
    assert len(set(terms[0])) > 2
    for k in range(6):
        one = camera.turned(
            turn[k], scale[k], centre_px=centre[k], distortion=distortion[k], position_body_m=position[k]
        )
        assert model == one.lens_terms[0]
        for many, own in zip(terms, one.lens_terms[1:], strict=True):
            np.testing.assert_allclose(many[k], own, rtol=0.0, atol=1e-15)


def test_a_camera_that_is_no_camera_is_refused(camera):
    with refuses("argument-value"):
        replace(camera, dcm_cam_body=np.diag([1.0, 1.0, -1.0]))
    with refuses("argument-value"):
        replace(camera, distortion=np.zeros(5))


@pytest.mark.parametrize(("focal", "ends_in_picture"), [(310.0, False), (120.0, True)])
def test_the_picture_shows_no_more_than_its_half_angle(mount, focal, ends_in_picture):
    camera = camera_from_mount(mount.model_copy(update={"focal_px": (focal, focal)}))
    v, u = np.indices((camera.height_px, camera.width_px), dtype=float)[:, ::7, ::7]
    rays = camera.rays_body(np.column_stack([u.ravel(), v.ravel()]))
    angle = np.arccos(np.clip(rays @ camera.dcm_cam_body[2], -1.0, 1.0))
    assert np.nanmax(angle) <= camera.picture_half_angle_rad
    if ends_in_picture:
        assert camera.picture_half_angle_rad == camera.half_field_rad
    else:
        assert camera.picture_half_angle_rad < min(camera.half_field_rad, np.nanmax(angle) + np.deg2rad(2.0))


def test_a_camera_rolled_clockwise_sees_the_sky_to_its_left(mount):
    upright, rolled, over = (camera_from_mount(mount.model_copy(update={"roll_deg": r})) for r in (0.0, 90.0, 180.0))
    points = upright.position_body_m + 2.0 * upright.dcm_cam_body[2] + 0.1 * lv_direction(D(mount.clock_lv_deg))
    (up,), (left,), (down,) = (c.project(points[None]) - c.centre_px for c in (upright, rolled, over))
    assert up[1] < -5.0
    np.testing.assert_allclose(left, [up[1], -up[0]], atol=1e-9)
    np.testing.assert_allclose(down, -up, atol=1e-9)

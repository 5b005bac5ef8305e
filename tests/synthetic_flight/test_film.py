"""The film: its edge against the projected curve, its randomness, its gates."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh

import flightmodel
from estimators.edge import find_horizon
from estimators.virtual_camera import VirtualCamera, deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.deflection import lv_direction
from flightmodel.geometry import ShellGeometry, bend, torus_circles, vehicle_meshes
from flightmodel.vehicle import CameraMount, vehicle_from_toml, vehicle_path
from synthetic_flight import _film_kernels
from synthetic_flight.film import (
    Imaging,
    Scene,
    ShellRenderer,
    as_built_camera,
    film,
    record,
    render_video,
    shell_terms,
    warp_terms,
)
from tests.refusing import refuses

TABLES = tomllib.loads((Path(flightmodel.__file__).parent / "data/vehicles/irve2_reference.toml").read_text())
GEOMETRY = ShellGeometry.model_validate(TABLES["geometry"])
MOUNT = CameraMount.model_validate(TABLES["cameras"]["camera5"])
JOINT_M = 0.2
D = np.deg2rad


def sun(clock_deg, from_aft_deg=61.0):
    a = D(from_aft_deg)
    return -np.cos(a) * np.array([1.0, 0.0, 0.0]) + np.sin(a) * lv_direction(D(clock_deg))


@pytest.fixture(scope="module")
def off_camera():
    """A real camera with everything off nominal, and its renderer."""
    camera = as_built_camera(MOUNT, np.random.default_rng(5))
    return camera, ShellRenderer(GEOMETRY, camera, JOINT_M)


def unshaded(renderer, theta_rad, plane_rad):
    """The shell in one grey before the sky and the centerbody."""
    cover, _, body = renderer.seen(theta_rad, plane_rad, np.zeros(3))
    return np.where(renderer.is_clear, 0.7 * cover + (1.0 - cover) * renderer.sky, body).astype(np.float32)


@pytest.mark.parametrize(
    ("theta_deg", "plane_deg", "sun_deg"),
    [(0.0, 153.0, 330.0), (4.5, 153.0, 200.0), (4.5, 199.0, 40.0), (-3.0, 120.0, 100.0)],
)
def test_ray_cast_edge_equals_the_projected_limb(off_camera, theta_deg, plane_deg, sun_deg):
    """Marched rays and a closed-form curve share no code: noise-free they agree to a fraction of a pixel."""
    camera, renderer = off_camera
    frame = record(renderer.radiance(D(theta_deg), D(plane_deg), sun(sun_deg)), renderer.vignetting,
                   Imaging(noise_sd=0.0), np.random.default_rng(0))  # fmt: skip
    view = VirtualCamera(GEOMETRY, camera, JOINT_M)
    found = find_horizon(frame, view.lines_at(view.edge_clocks(), np.zeros(3)), camera.size_px)
    residual, _, _ = view.mismatch(found, view.edge(deformation_of(D(theta_deg), D(plane_deg))))
    assert found.is_usable
    assert np.isfinite(residual).mean() > 0.9
    # shading that changes within the 1.1 px blur moves the half-level crossing by a share of it; unshaded it is 0.02
    assert abs(np.nanmedian(residual)) < 0.3
    assert np.nanstd(residual) < 0.25


def test_without_shading_the_two_edges_agree_to_hundredths_of_a_pixel(off_camera):
    camera, renderer = off_camera
    frame = record(unshaded(renderer, D(3.7), D(191.0)), np.ones_like(renderer.vignetting),
                   Imaging(noise_sd=0.0), np.random.default_rng(0))  # fmt: skip
    view = VirtualCamera(GEOMETRY, camera, JOINT_M)
    residual, _, _ = view.mismatch(
        find_horizon(frame, view.lines_at(view.edge_clocks(), np.zeros(3)), camera.size_px),
        view.edge(deformation_of(D(3.7), D(191.0))),
    )
    # one grey level of 178 is 0.015 px; a pixel's box coverage at a slant adds a few hundredths
    assert abs(np.nanmean(residual)) < 0.03
    assert np.nanstd(residual) < 0.06


@pytest.mark.parametrize(("theta_deg", "plane_deg"), [(0.0, 153.0), (4.5, 191.0)])
def test_the_film_shows_the_trimesh_vehicle(off_camera, theta_deg, plane_deg):
    """Rays through the same real lens into the tori's and the centerbody's triangles hit where the film has them."""
    pytest.importorskip("embreex", reason="trimesh casts rays too slowly without embreex")
    camera, renderer = off_camera
    shell_in_film = unshaded(renderer, D(theta_deg), D(plane_deg)) > 0.4
    meshes = vehicle_meshes(GEOMETRY, clock_sections=400, torus_sections=128)
    tori = [mesh for name, mesh in meshes.items() if name.startswith("torus")]
    for mesh in tori:
        mesh.vertices = bend(np.asarray(mesh.vertices), D(theta_deg), D(plane_deg), JOINT_M)
    shell = trimesh.util.concatenate(tori)
    pixels = np.stack(np.meshgrid(np.arange(0, 720, 5.0), np.arange(0, 480, 5.0)), axis=-1).reshape(-1, 2)
    rays = camera.rays_body(pixels)
    seen = np.isfinite(rays[:, 0]) & renderer.is_clear[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    hits = shell.ray.intersects_any(np.tile(camera.position_body_m, (seen.sum(), 1)), rays[seen])
    film = shell_in_film[pixels[seen, 1].astype(int), pixels[seen, 0].astype(int)]
    # triangles inscribed in a torus fall short of it by a (pi/128)^2/2 = 0.03 mm: pixels on the very edge may differ
    assert np.sum(hits & film) / np.sum(hits | film) > 0.998
    assert hits.mean() > 0.3


def test_edge_moves_up_when_the_rim_comes_towards_the_camera(off_camera):
    camera, renderer = off_camera
    view = VirtualCamera(GEOMETRY, camera, JOINT_M)
    rows = []
    for theta_deg in (-4.0, 0.0, 4.0):
        frame = record(
            renderer.radiance(D(theta_deg), D(153.0), sun(330.0)),
            renderer.vignetting,
            Imaging(),
            np.random.default_rng(1),
        )
        rows.append(find_horizon(frame, view.lines_at(view.edge_clocks(), np.zeros(3)), camera.size_px).lowest_row_px)
    # rim moves by about 0.84 theta: 4 deg is 18 px at 5.4 px/deg
    np.testing.assert_allclose(np.diff(rows), -18.0, atol=2.5)


def test_sky_shell_and_centerbody_are_where_they_should_be(off_camera):
    _, renderer = off_camera
    picture = renderer.radiance(0.0, 0.0, sun(330.0))
    assert picture[:40].max() < 0.08
    assert picture[150:380, 300:420].mean() > 0.2
    assert np.isfinite(renderer.body_depth_m[-1]).all()
    assert not np.isfinite(renderer.body_depth_m[:300]).any()
    assert np.isfinite(picture).all()


def test_light_comes_from_the_sun_and_darkness_is_dark(off_camera):
    _, renderer = off_camera
    # left in the picture is increasing clock
    left, right = (renderer.radiance(0.0, 0.0, sun(153.0 + s))[200:400] for s in (90.0, -90.0))
    assert left[:, 500:700].mean() > 1.3 * left[:, 20:220].mean()  # the Sun lights the far inner slope
    assert right[:, 20:220].mean() > 1.3 * right[:, 500:700].mean()
    dark = renderer.radiance(0.0, 0.0, np.zeros(3))
    assert dark.max() < 0.25


def test_film_is_reproducible_and_the_real_camera_scatters_as_declared():
    theta, plane, light = D(np.array([0.0, 3.0])), D(np.array([0.0, 190.0])), np.stack([sun(10.0), sun(60.0)])
    films = [
        list(render_video(GEOMETRY, MOUNT, JOINT_M, theta, plane, light, np.random.default_rng(s))) for s in (7, 7, 8)
    ]
    assert films[0][0].shape == (480, 720)
    assert films[0][0].dtype == np.uint8
    np.testing.assert_array_equal(films[0], films[1])
    assert np.abs(films[0][1].astype(float) - films[2][1]).mean() > 1.0
    nominal = camera_from_mount(MOUNT)
    drawn = [as_built_camera(MOUNT, np.random.default_rng(s)) for s in range(200)]
    focal = np.array([c.focal_px[0] / nominal.focal_px[0] - 1.0 for c in drawn])
    swing = np.array([np.arccos(np.clip(c.dcm_cam_body[2] @ nominal.dcm_cam_body[2], -1, 1)) for c in drawn])
    # chi-square bounds of 200 (scale) and 400 (two axes) draws at 4 sd
    assert np.sum((focal / 0.01) ** 2) == pytest.approx(200.0, abs=4 * np.sqrt(400.0))
    assert np.sum((swing / D(0.5)) ** 2) == pytest.approx(400.0, abs=4 * np.sqrt(800.0))


def test_noise_has_the_declared_level(off_camera):
    _, renderer = off_camera
    radiance = renderer.radiance(0.0, 0.0, sun(330.0))
    clean, noisy = (
        record(radiance, renderer.vignetting, Imaging(noise_sd=s), np.random.default_rng(3)).astype(float)
        for s in (0.0, 2.5)
    )
    block = (noisy - clean)[150:350, 250:450]
    # 40 000 pixels; rounding to levels of both frames adds 2/12
    assert block.var() == pytest.approx(2.5**2 + 2.0 / 12.0, rel=0.03)


def test_film_refuses_lengths_that_differ_and_nan():
    light, rng = np.zeros((3, 3)), np.random.default_rng(0)
    with refuses("argument-value", names=["plane_lv_rad"]):
        render_video(GEOMETRY, MOUNT, JOINT_M, np.zeros(3), np.zeros(2), light, rng)
    with refuses("not-finite", names=["theta"]):
        render_video(GEOMETRY, MOUNT, JOINT_M, np.full(3, np.nan), np.zeros(3), light, rng)


def test_rays_reach_the_far_rim_of_a_shell_of_any_size():
    """A camera at the rim of a 6 m shell looks at the opposite rim, 6 m away and more."""
    geometry = vehicle_from_toml(vehicle_path("loftid")).geometry
    station, radius = torus_circles(geometry)
    eye = np.array([-station[-1] - 0.5, -radius[-1], 0.0])
    far = np.array([-station[-1], radius[-1], 0.0]) - eye
    depth = np.empty((1, 1))
    ray, everywhere = (far / np.linalg.norm(far))[None, None], np.ones((1, 1), dtype=bool)
    _film_kernels.cast(ray, everywhere, np.eye(3), eye, shell_terms(geometry), warp_terms(None), depth)
    # within two rings of the rim: the ray comes in under a flat angle
    assert np.linalg.norm(far) - 4.0 * geometry.torus_minor_radius_m < depth[0, 0] < np.linalg.norm(far)


def triangles(theta_rad, plane_rad):
    """The deflected shell and the centerbody as meshes, whose rays share no code with the film's."""
    meshes = vehicle_meshes(GEOMETRY, clock_sections=400, torus_sections=128)
    tori = [mesh for name, mesh in meshes.items() if name.startswith("torus")]
    for mesh in tori:
        mesh.vertices = bend(np.asarray(mesh.vertices), theta_rad, plane_rad, JOINT_M)
    return trimesh.util.concatenate(tori), meshes["centerbody"]


@pytest.mark.parametrize(("sun_deg", "from_aft_deg"), [(330.0, 61.0), (60.0, 70.0), (200.0, 60.0)])
def test_shadows_fall_where_triangles_stand_before_the_sun(off_camera, sun_deg, from_aft_deg):
    pytest.importorskip("embreex", reason="trimesh casts rays too slowly without embreex")
    camera, _ = off_camera
    theta, plane, light = D(4.5), D(191.0), sun(sun_deg, from_aft_deg)
    lit, dark = (
        ShellRenderer(GEOMETRY, camera, JOINT_M, painted=False, shadows=s).seen(theta, plane, light)[1]
        for s in (False, True)
    )
    shell, body = triangles(theta, plane)
    v, u = (x.ravel() for x in np.mgrid[0:480:7, 0:720:7])
    rays = camera.rays_body(np.column_stack([u, v]).astype(float))
    seen = np.isfinite(rays[:, 0]) & (lit[v, u] > 0.0)
    v, u, rays = v[seen], u[seen], rays[seen]
    points, ray, triangle = shell.ray.intersects_location(
        np.tile(camera.position_body_m, (len(rays), 1)), rays, multiple_hits=False
    )
    normal = shell.face_normals[triangle]
    # well turned to the Sun: elsewhere light and shadow hardly differ
    steep = normal @ light > 0.15
    at = points[steep] + 3e-3 * normal[steep]
    towards = np.tile(light, (len(at), 1))
    shaded = shell.ray.intersects_any(at, towards) | body.ray.intersects_any(at, towards)
    where = v[ray[steep]], u[ray[steep]]
    film = dark[where] < 0.999 * lit[where]
    assert np.mean(film == shaded) > 0.97  # half shadow, and triangles of a few mm, at their borders
    assert 0.1 < shaded.mean() < 0.9


@pytest.mark.parametrize("sun_deg", [330.0, 60.0, 200.0])
def test_shadows_between_pixels_that_agree_are_those_of_every_pixel_s_own_ray(off_camera, monkeypatch, sun_deg):
    camera, _ = off_camera
    renderer, seen = ShellRenderer(GEOMETRY, camera, JOINT_M, painted=False), (D(4.5), D(191.0), sun(sun_deg))
    few = renderer.seen(*seen)[1]
    monkeypatch.setattr(ShellRenderer, "_sun_seen", lambda _self, depth, _shell: np.full(depth.shape, np.nan))
    every = renderer.seen(*seen)[1]
    assert np.mean(np.abs(few - every) > 0.02) < 1e-3  # what is narrower than two pixels


def test_the_centerbody_lies_in_the_shadow_of_the_shell(off_camera):
    camera, _ = off_camera
    forward = np.array([0.8, *(-0.6 * lv_direction(D(153.0 + 180.0))[1:])])
    open_sky, shaded = (
        ShellRenderer(GEOMETRY, camera, JOINT_M, shadows=s).radiance(0.0, 0.0, forward) for s in (False, True)
    )
    body = ~ShellRenderer(GEOMETRY, camera, JOINT_M).is_clear
    assert open_sky[body].max() > 0.2
    assert np.mean(shaded[body] > 0.11) < 1e-3  # the centerbody is drawn before the shell, also where it is inside it


def test_a_rolling_shutter_shows_each_row_at_its_own_time():
    """Rows of a film of a moving shell are those of films of the shell at rest where it is when they are exposed."""
    quiet = {"pointing_sd_rad": 0.0, "focal_sd": 0.0, "centre_sd_px": 0.0, "k1_sd": 0.0, "position_sd_m": 0.0,
             "noise_sd": 0.0}  # fmt: skip
    theta, plane, light, rate = np.array([D(3.0)]), np.array([D(153.0)]), sun(330.0)[None], D(60.0)
    lateral = rate * np.array([[-np.cos(plane[0]), np.sin(plane[0])]])
    moving = Scene(theta, plane, light, deflection_rate_yz_radps=lateral)
    rolled = next(film(GEOMETRY, MOUNT, JOINT_M, moving, np.random.default_rng(0), Imaging(readout_s=0.02, **quiet)))
    for row in (100, 240, 330):
        there = theta + rate * 0.02 * ((row + 0.5) / 480 - 0.5)
        still = next(
            film(GEOMETRY, MOUNT, JOINT_M, Scene(there, plane, light), np.random.default_rng(0), Imaging(**quiet))
        )
        away = next(film(GEOMETRY, MOUNT, JOINT_M, Scene(theta + D(0.6), plane, light), np.random.default_rng(0),
                         Imaging(**quiet)))  # fmt: skip
        off, other = (np.abs(rolled[row].astype(float) - picture[row]).mean() for picture in (still, away))
        assert off < 0.5
        assert other > 3.0 * off

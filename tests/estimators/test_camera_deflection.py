"""The virtual camera against differences, the estimator against films made by another renderer and another lens."""

import itertools
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import flightmodel
from estimators.benchmark import orient_camera, with_deflected_benchmark
from estimators.camera import polar, read_film, sensitivity_table
from estimators.camera_fit import REACH_PX, OrientedCamera
from estimators.edge import HorizonLine, find_horizon, no_horizon, steps_near
from estimators.frame_residuals import light_columns
from estimators.frame_solution import refused_fit
from estimators.overlay import Overlay
from estimators.virtual_camera import VirtualCamera, deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.checks import GateError, Issue
from flightmodel.deflection import lv_direction, rotation_vector_body_shell
from flightmodel.geometry import ShellGeometry, dot_positions
from flightmodel.vehicle import CameraMount
from postflight.plots.paper_figures import frames_with_camera
from synthetic_flight.film import render_video
from tests.oracles.plain_fit import plain_fit
from tests.refusing import numbers_in

TABLES = tomllib.loads((Path(flightmodel.__file__).parent / "data/vehicles/irve2_reference.toml").read_text())
GEOMETRY = ShellGeometry.model_validate(TABLES["geometry"])
MOUNT = CameraMount.model_validate(TABLES["cameras"]["camera5"])
JOINT_M = 0.2
D = np.deg2rad
HERE = np.array([0.031, -0.048, 0.004])


def sun(clock_deg, from_aft_deg=61.0):
    a = D(from_aft_deg)
    return -np.cos(a) * np.array([1.0, 0.0, 0.0]) + np.sin(a) * lv_direction(D(clock_deg))


def film(seed, theta_deg, plane_deg, imaging=None):
    rng = np.random.default_rng(seed)
    light = np.stack([sun(rng.uniform(0, 360), rng.uniform(50, 70)) for _ in theta_deg])
    return list(
        render_video(GEOMETRY, MOUNT, JOINT_M, D(np.array(theta_deg)), D(np.array(plane_deg)), light, rng, imaging)
    )


@pytest.fixture(scope="module")
def view():
    return VirtualCamera(GEOMETRY, camera_from_mount(MOUNT).turned(np.array([0.01, -0.006, 0.008]), 0.99), JOINT_M)


@pytest.fixture(scope="module")
def ensemble():
    """Truth (theta, plane) and answers, plane found and plane assumed, of 12 flights with their own lens and light.

    The benchmark frame is deflected by 0.1 deg a lateral axis, one sd, in an unknown plane.
    """
    rows = []
    for seed in range(12):
        rng = np.random.default_rng(1000 + seed)
        rest = 0.1 * rng.standard_normal(2)
        theta = [float(np.hypot(*rest)), rng.uniform(3.0, 4.8), rng.uniform(1.5, 4.0)]
        plane = [float(np.rad2deg(np.arctan2(rest[1], -rest[0]))), rng.uniform(183.0, 200.0), rng.uniform(140.0, 190.0)]
        frames = film(seed, theta, plane)
        times = np.array([421.0, 440.0, 441.0])
        free = read_film(times, frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None).history()
        assumed = read_film(times, frames, GEOMETRY, MOUNT, JOINT_M).history()
        rows.append((D(np.array(theta)), D(np.array(plane)), free, assumed))
    return rows


def shifted(view, edge, moved):
    """Distance of a moved edge from the edge, along its normals."""
    n = len(moved.pixels)
    horizon = HorizonLine(moved.pixels, moved.inward_px, np.ones(n), np.arange(n))
    return view.mismatch(horizon, edge)[:2]


def moves_of(view, show):
    """By column: the projection after a step of that quantity alone."""
    camera, unit = view.camera, np.eye(3)

    def look(**change):
        return show(replace(view, camera=replace(camera, **change)), HERE)

    moves = {k: lambda s, k=k: show(view, HERE + s * unit[k]) for k in range(3)}
    for k in range(3):
        moves[3 + k] = lambda s, k=k: show(replace(view, camera=camera.turned(s * unit[k])), HERE)
        moves[11 + k] = lambda s, k=k: look(position_body_m=camera.position_body_m + s * unit[k])
    for k in range(2):
        moves[7 + k] = lambda s, k=k: look(centre_px=camera.centre_px + s * unit[k, :2])
        moves[9 + k] = lambda s, k=k: look(distortion=camera.distortion + s * np.eye(4)[k])
    moves[6] = lambda s: show(replace(view, camera=camera.turned(np.zeros(3), 1.0 + s)), HERE)
    moves[15] = lambda s: show(replace(view, joint_station_m=JOINT_M + s), HERE)
    return moves


def wider(view, s):
    """Move the tori outwards and keep their stations: the cone then starts from another nose."""
    half = D(GEOMETRY.half_angle_deg)
    per_nose = 1.0 - np.sin(half) - np.cos(half) / np.tan(half)
    change = {
        "innermost_torus_radius_m": GEOMETRY.innermost_torus_radius_m + s,
        "nose_radius_m": GEOMETRY.nose_radius_m - s / np.tan(half) / per_nose,
    }
    return replace(view, geometry=GEOMETRY.model_copy(update=change))


def test_every_derivative_of_a_mark_equals_differences(view):
    points = dot_positions(GEOMETRY)
    sight = view.sight(points, HERE)
    seen = np.isfinite(sight.pixels[:, 0])
    assert seen.sum() > 30
    h = 1e-6
    for column, move in moves_of(view, lambda v, deformation: v.sight(points, deformation).pixels).items():
        numeric = (move(h) - move(-h))[seen] / (2.0 * h)
        analytic = sight.jacobian[seen][:, :, column]
        np.testing.assert_allclose(numeric, analytic, atol=2e-8 * max(np.abs(numeric).max(), 1.0) + 2e-7)
        assert np.abs(analytic).max() > 0.0, column
    # the shell's radius: every point a little further out
    outboard = points * np.array([0.0, 1.0, 1.0]) / np.hypot(points[:, 1], points[:, 2])[:, None]
    up, down = (view.sight(points + s * outboard, HERE * np.array([1.0, 1.0, 0.0])).pixels for s in (h, -h))
    flat = view.sight(points, HERE * np.array([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(((up - down) / (2.0 * h))[seen], flat.jacobian[seen][:, :, 14], atol=2e-5)


@pytest.mark.parametrize("lens", ["fisheye", "pinhole"])
def test_the_projection_equals_opencv(view, lens):
    k = np.array([-0.02, 0.004, 0.0007, -0.0004])
    other = replace(view, camera=replace(view.camera, lens=lens, distortion=k))
    points = dot_positions(GEOMETRY)
    got = other.sight(points, np.zeros(3))
    want, per_cam, per_lens = other.camera.project_with_jacobian(points)
    seen = np.isfinite(want[:, 0])
    assert seen.sum() > 25
    np.testing.assert_array_equal(np.isfinite(got.pixels[:, 0]), seen)
    np.testing.assert_allclose(got.pixels[seen], want[seen], atol=1e-9)
    np.testing.assert_allclose(-got.jacobian[seen][:, :, 11:14], (per_cam @ other.camera.dcm_cam_body)[seen], atol=1e-7)
    np.testing.assert_allclose(got.jacobian[seen][:, :, 9:11], per_lens[seen][:, :, 4:6], atol=1e-7)
    # and back along the ray, within the picture: far outside it the inverse of a pinhole is ill-conditioned
    seen &= other.camera.is_inside(np.nan_to_num(want, nan=-1e9))
    rays = other.camera.rays_body(want[seen])
    direction = points[seen] - other.camera.position_body_m
    np.testing.assert_allclose(rays, direction / np.linalg.norm(direction, axis=1, keepdims=True), atol=1e-8)


def test_every_derivative_of_the_edge_equals_differences(view):
    def fine(v, deformation):
        """A polyline of chords so short that it is the curve."""
        object.__setattr__(v, "clocks_rad", np.linspace(v.clocks_rad[0], v.clocks_rad[-1], 4001))
        return v.edge(deformation)

    edge = fine(replace(view), HERE)
    h = 2e-4
    moves = moves_of(view, fine)
    moves[14] = lambda s: fine(wider(view, s), HERE)
    assert sorted(moves) == list(range(16))
    for column, move in moves.items():
        up, jacobian = shifted(view, edge, move(h))
        down, _ = shifted(view, edge, move(-h))
        at = np.arange(len(edge.pixels))[60:-60:50]
        numeric = (up - down)[at] / (2.0 * h)
        scale = max(np.abs(jacobian[:, column]).max(), 1.0)
        # vertices slide along the edge by up to 0.1 px
        np.testing.assert_allclose(numeric, jacobian[at, column], atol=2e-3 * scale, err_msg=str(column))


def test_light_moves_an_edge_by_shift_tilt_and_bow_that_do_not_do_for_each_other():
    """Over the picture's width the three shapes are orthogonal, each one at its right-hand side."""
    view = VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)
    middle, weight = np.polynomial.legendre.leggauss(6)
    u = 0.5 * view.camera.width_px * (1.0 + np.append(middle, 1.0))
    at = np.column_stack([u, np.zeros_like(u)])
    shapes = light_columns(view, HorizonLine(at, at, np.ones_like(u), np.arange(len(u))))
    np.testing.assert_allclose(shapes[-1], 1.0)
    products = np.einsum("n,ni,nj->ij", weight, shapes[:-1], shapes[:-1])
    np.testing.assert_allclose(products, np.diag(np.diag(products)), atol=1e-12)


def test_positive_bending_towards_the_camera_moves_the_edge_up(view):
    apex = [view.edge(deformation_of(D(t), D(MOUNT.clock_lv_deg))).pixels[:, 1].min() for t in (-4.0, 0.0, 4.0)]
    assert apex[2] < apex[1] - 15.0 < apex[0] - 30.0
    # towards camera 1 (larger clock, left): the left end of the edge rises against the right one
    rest, tilted = view.edge(deformation_of(0.0, 0.0)), view.edge(deformation_of(D(4.0), D(225.0)))
    for column, sign in ((100.0, 1.0), (620.0, -1.0)):
        row = [np.interp(column, *e.pixels[np.argsort(e.pixels[:, 0])].T) for e in (rest, tilted)]
        assert sign * (row[0] - row[1]) > 5.0


def test_polar_is_the_inverse_of_the_rotation_vector_with_its_covariance():
    theta, plane = D(3.3), D(187.0)
    w = rotation_vector_body_shell(np.array(theta), np.array(plane))[1:]
    cov = np.array([[2.0, 0.5], [0.5, 1.0]]) * 1e-6
    got = polar(w, cov)
    assert got[0] == pytest.approx(theta)
    assert got[1] == pytest.approx(plane)
    h = 1e-6
    ends = [(np.array(polar(w + d, cov)[:2]), np.array(polar(w - d, cov)[:2])) for d in h * np.eye(2)]
    turn = np.column_stack([(up - down) / (2 * h) for up, down in ends])
    np.testing.assert_allclose(got[2], turn @ cov @ turn.T, rtol=1e-5)
    _, _, unknown = polar(np.array([1e-6, 0.0]), cov)
    assert unknown[1, 1] == pytest.approx(np.pi**2 / 3.0)
    assert np.linalg.eigvalsh(unknown).min() > 0.0


def test_the_compiled_fit_is_the_plain_one():
    frames = film(5, [0.0, 4.1], [0.0, 188.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    horizon = find_horizon(frames[1], oriented.lines, oriented.view.camera.size_px)
    edge_alone = plain_fit(oriented, horizon, None, np.zeros(3))
    place = oriented.features.find(oriented.view, frames[1], edge_alone, REACH_PX)
    for marks in (None, place):
        plain, compiled = plain_fit(oriented, horizon, marks, edge_alone), edge_alone.copy()
        oriented._solve(horizon, marks, compiled, np.eye(2), 2.5)
        np.testing.assert_allclose(compiled, plain, atol=1e-10)


def test_deflection_and_plane_are_recovered_with_honest_sd(ensemble):
    normal = []
    for theta, plane, free, _ in ensemble:
        for k in (1, 2):
            assert abs(free.theta_rad[k] - theta[k]) < D(0.7)
            error = np.array([free.theta_rad[k] - theta[k], np.angle(np.exp(1j * (free.plane_lv_rad[k] - plane[k])))])
            normal.append(error @ np.linalg.solve(free.covariance[k], error))
    nees = np.array(normal).reshape(-1, 2)
    # 24 answers of 2 components, but the two of a flight share their lens: 12 independent pairs at the least,
    # chi-square with 24 degrees of freedom, 0.1 % on either side of the mean of both
    assert 8.08 / 24.0 < nees.mean() / 2.0 < 51.2 / 24.0


def test_assumed_plane_reads_the_component_in_it_and_says_how_far_off_that_may_be(ensemble):
    for theta, plane, _, assumed in ensemble:
        component = theta * np.cos(plane - D(153.0)) - theta[0] * np.cos(plane[0] - D(153.0))
        # 0.4 deg: three sd of what is held fixed, 0.1 deg, and the leak of the component across
        assert np.abs(assumed.theta_rad - component)[1:].max() < D(0.4)
        np.testing.assert_array_equal(assumed.plane_lv_rad, D(153.0))
        assert (np.abs(assumed.theta_rad - theta)[1:] < 3.0 * assumed.theta_sd_rad[1:]).all()
        assert np.linalg.eigvalsh(assumed.covariance).min() > 0.0


def test_camera_orientation_is_found_on_the_benchmark():
    frame = film(3, [0.0], [0.0])[0]
    oriented = orient_camera(frame, GEOMETRY, MOUNT, JOINT_M)
    before = oriented.benchmark_residuals
    edge = before.residual_px[before.index < len(oriented.clocks_rad)]
    assert np.sqrt(np.mean(edge**2)) < 0.4
    # the nominal camera misses the edge by more than a pixel
    nominal = VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)
    residual, _, _ = nominal.mismatch(oriented.benchmark, nominal.edge(np.zeros(3)))
    assert np.sqrt(np.nanmean(residual**2)) > max(1.0, 4.0 * oriented.residual_rms_px)
    moved = rotation_vector_body_shell(np.array(D(4.0)), np.array(D(170.0)))[1:]
    same = oriented.fit(frame, None, moved).rotation_yz_rad
    np.testing.assert_allclose(same, 0.0, atol=D(0.02))


def test_a_benchmark_that_was_bent_gives_its_camera_back():
    straight, off_nominal = (orient_camera(film(4, [deg], [170.0])[0], GEOMETRY, MOUNT, JOINT_M) for deg in (0.0, 0.5))
    mended = with_deflected_benchmark(off_nominal, D(0.5), D(170.0))
    points = dot_positions(GEOMETRY)
    wanted, off, better = (o.view.sight(points, np.zeros(3)).pixels for o in (straight, off_nominal, mended))
    seen = np.isfinite(wanted + off + better).all(axis=1)
    before, after = (np.sqrt(np.mean((p - wanted)[seen] ** 2)) for p in (off, better))
    # to first order, and within what two frames' noise leaves
    assert after < 0.2 * before


def test_frames_that_cannot_be_used_are_refused_with_a_reason(tmp_path):
    frames = film(4, [0.0, 3.0, 3.0], [0.0, 180.0, 180.0])
    stripes = np.where(np.arange(480)[:, None] // 2 % 2, 30, 220).astype(np.uint8) * np.ones((1, 720), np.uint8)
    cv2.imwrite(str(tmp_path / "good.png"), frames[2])
    rng = np.random.default_rng(0)
    pictures = [
        frames[0],
        np.zeros_like(frames[0]),
        np.full_like(frames[0], 255),
        frames[1][:240],
        tmp_path / "missing.png",
        rng.integers(95, 105, frames[0].shape, dtype=np.uint8),
        stripes,
        tmp_path / "good.png",
    ]
    times = 421.0 + np.arange(len(pictures))
    read = read_film(times, pictures, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None)
    history = read.history()
    np.testing.assert_array_equal(np.isnan(history.theta_rad), [False] + [True] * 6 + [False])
    codes = {fit.refused.code for fit in read.fits if fit.refused}
    of_frame = {"frame-exposure", "frame-size", "frame-undecodable"}
    assert codes == of_frame | {"edge-not-clear", "frame-broken"}
    counts = numbers_in(history.assumptions)
    assert (6.0, 8.0) in itertools.pairwise(counts)
    reasons = list(dict.fromkeys(fit.refused for fit in read.fits if fit.refused))
    assert all(reason in history.assumptions for reason in reasons[:5])
    assert history.theta_rad[-1] == pytest.approx(D(3.0), abs=D(0.4))
    # squeezed, the frame shows an edge that is no deflection of this shell
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    squeezed = cv2.resize(frames[1], (720, 300))
    low = np.vstack([frames[1][:60], squeezed, squeezed[-120:]])
    assert oriented.fit(low, None).refused


@pytest.mark.parametrize(("seen_px", "from_left"), [(200, True), (250, True), (200, False)])
def test_a_frame_that_shows_too_little_of_edge_and_features_is_refused(seen_px, from_left):
    # of a picture of 720 pixels, the rest covered: all that is seen agrees with one deflection, and may by chance
    frames = film(4, [0.0, 3.0], [0.0, 175.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    column = np.arange(720)
    seen = column < seen_px if from_left else column >= 720 - seen_px
    assert oriented.fit(np.where(seen, frames[1], 0).astype(np.uint8)).refused.code == "shell-little-seen"
    assert not oriented.fit(frames[1]).refused


def test_without_an_edge_in_the_benchmark_frame_no_edge_is_a_share_of_it(monkeypatch):
    oriented = orient_camera(film(4, [0.0], [0.0])[0], GEOMETRY, MOUNT, JOINT_M)
    assert oriented._edge_share(120) == pytest.approx(0.5, abs=0.05)
    monkeypatch.setitem(oriented.__dict__, "_edge_at_benchmark", 0)
    assert oriented._edge_share(120) == 0.0


def test_an_assumed_plane_without_edge_is_refused_by_its_reason(monkeypatch):
    """In it the edge alone counts: features can carry a film of which the rim is hidden, but not in a stated plane."""
    none = Issue("too few points", "edge-points-too-few")
    monkeypatch.setattr(OrientedCamera, "fit", lambda *_: refused_fit(no_horizon(none), none))
    monkeypatch.setattr(OrientedCamera, "edge_in_view", 0.25)
    frames, times = film(4, [0.0, 3.0], [0.0, 175.0]), np.array([421.0, 440.0])
    with pytest.raises(GateError) as refused:
        read_film(times, frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=D(175.0))
    assert refused.value.codes == ("plane-needs-edge",)
    assert all(fit.refused for fit in read_film(times, frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None).fits)
    monkeypatch.setattr(OrientedCamera, "edge_in_view", 0.9)
    assert all(fit.refused for fit in read_film(times, frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=D(175.0)).fits)


def test_a_wrong_lens_is_refused():
    """An edge is found, but the benchmark frame is not explained, or by a camera far off."""
    frames = film(5, [0.0], [0.0])
    assert not orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M).has_bad_benchmark
    with pytest.raises(GateError) as refusal:
        orient_camera(frames[0], GEOMETRY, MOUNT.model_copy(update={"lens": "pinhole"}), JOINT_M)
    other = {
        "camera-far-from-prior", "edge-not-shell", "edge-points-too-few", "benchmark-implausible", "pixels-not-square",
    }  # fmt: skip
    assert refusal.value.codes[0] in other
    wild = MOUNT.model_copy(update={"distortion": (-0.9, 0.9, -0.9, 0.9)})
    with pytest.raises(GateError) as refusal:
        orient_camera(film(4, [0.0], [0.0])[0], GEOMETRY, wild, JOINT_M)
    assert refusal.value.codes == ("camera-far-from-prior",)


def test_where_no_line_lies_in_the_picture_no_edge_is_found():
    frame = film(4, [0.0], [0.0])[0]
    oriented = orient_camera(frame, GEOMETRY, MOUNT, JOINT_M)
    lines = oriented.view.lines_at(np.zeros(0), np.zeros(3))
    assert len(steps_near(frame, lines).points_px) == 0


def test_gates_name_what_is_wrong():
    frames = film(4, [0.0], [0.0])
    ahead = MOUNT.model_copy(update={"axis_from_forward_deg": 178.0})
    for times, pictures, mount, code in (
        ([421.0], frames, ahead, "edge-out-of-view"),
        ([421.0, 422.0], frames, MOUNT, "argument-value"),
        ([440.0], frames, MOUNT, "time-not-covered"),
        ([421.0], [np.zeros_like(frames[0])], MOUNT, "frame-exposure"),
    ):
        with pytest.raises(GateError) as refusal:
            read_film(np.array(times), pictures, GEOMETRY, mount, JOINT_M)
        assert refusal.value.codes == (code,)


@pytest.mark.parametrize("near", [False, True])
def test_found_points_carry_the_sd_their_noise_gives_them(near):
    """One scene, many noises: scatter of each point against its stated sd, pooled chi-square."""
    from synthetic_flight.film import Imaging, ShellRenderer, record

    camera = camera_from_mount(MOUNT)
    view = VirtualCamera(GEOMETRY, camera, JOINT_M)
    renderer = ShellRenderer(GEOMETRY, camera, JOINT_M)
    radiance = 0.35 * renderer.radiance(0.0, 0.0, sun(330.0))
    lines = view.lines_at(view.edge_clocks(), np.zeros(3))
    places, sds = [], []
    for seed in range(20):
        frame = record(radiance, renderer.vignetting, Imaging(noise_sd=4.0), np.random.default_rng(seed))
        found = steps_near(frame, lines) if near else find_horizon(frame, lines, camera.size_px)
        assert len(found.points_px) >= 0.99 * len(lines.origin_px)
        place, sd = np.full((2, len(lines.origin_px)), np.nan)
        own = found.line
        place[own] = np.einsum("ni,ni->n", found.points_px - lines.origin_px[own], lines.inward_px[own])
        sd[own] = found.sd_px
        places.append(place)
        sds.append(sd)
    ratio = np.mean(np.nanvar(places, axis=0, ddof=1)) / np.nanmean(np.square(sds))
    # the floor and the noise of the shell's level are approximations: the variance is right within a factor of two
    assert 0.5 < ratio < 2.0


def test_sensitivity_table_hardly_knows_the_joint():
    frames = film(6, [0.0, 4.2], [0.0, 153.0])
    planes, joints = D(np.array([153.0, 183.0, 200.0])), np.array([0.0, 0.2])
    table = sensitivity_table(frames[0], frames[1], GEOMETRY, MOUNT, planes, joints)
    assert table.shape == (2, 3)
    assert table[1, 0] == pytest.approx(D(4.2), abs=D(0.3))
    # truth in the camera's plane: other planes need 1 / (cos d + s sin d) of it, a quarter at most for these 47 deg
    assert (np.abs(table / table[:, :1] - 1.0) < 0.25).all()
    # facts: 0.84 theta of rim motion about the torus, 0.79 about the nose
    np.testing.assert_allclose(table[0] / table[1], 0.84 / 0.79, atol=0.03)


def test_overlay_covers_the_right_half_and_the_figure_draws():
    frames = film(3, [0.0, 4.0], [0.0, 188.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    theta, plane, _ = polar(oriented.fit(frames[1], None).rotation_yz_rad, 1e-6 * np.eye(2))
    picture = Overlay(oriented.view).blended(frames[1], theta, plane)
    np.testing.assert_array_equal(picture[:, :350], np.repeat(frames[1][:, :350, None], 3, axis=2))
    # painted triangles and found edge agree: coloured pixels begin at the frame's own edge
    for column in (420, 500, 600):
        painted = np.argmax(np.ptp(picture[:, column].astype(int), axis=1) > 25)
        bright = np.argmax(frames[1][:, column] > 0.5 * frames[1][painted + 5, column])
        assert abs(painted - bright) <= 3
    figure = frames_with_camera(oriented, frames, [421.0, 440.0], [0.0, theta], [plane, plane])
    assert len(figure.axes) == 2
    assert len(figure.axes[1].lines) == 2
    rows = [line.get_ydata()[0] for line in figure.axes[1].lines]
    assert rows[0] == pytest.approx(rows[1], abs=1.0)

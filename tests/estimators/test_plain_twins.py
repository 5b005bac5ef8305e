"""Compiled looks at pictures against plain ones, on points and scenes small enough to run interpreted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import ndtr

from estimators.body_edge import first_lasting_steps
from estimators.edge import (
    EDGE_BASES,
    EDGE_HALF,
    EDGE_PLACES,
    NEAR_ALONG,
    NEAR_BASES,
    NEAR_PLACES,
    STEP_PX,
    WHOLE_BLUR_PX,
    ScanLines,
    first_rises,
    fit_steps,
    is_coherent,
    sample_lines,
    sky_levels,
    steps_near,
)
from estimators.features import dark_centres
from estimators.frame_checks import Design
from estimators.frame_residuals import huber_weights, waves_round
from estimators.frame_solution import DONE, SHAPES, fit_frame
from estimators.texture import correlations, find_patches
from estimators.virtual_camera import VirtualCamera, feet, limb_points
from flightmodel.camera import Camera, camera_from_mount
from flightmodel.deflection import lv_clock, lv_direction
from flightmodel.rendering import fill
from tests.oracles import plain_horizon, plain_sight

from .conftest import VEHICLE

MOUNT = VEHICLE.cameras["camera5"]
FISHEYE = camera_from_mount(MOUNT).turned(np.array([0.01, -0.006, 0.008]), 0.99)
DEFORMATION = np.array([0.031, -0.048, 0.004])
JOINT_M = 0.2


def pinhole():
    lens = np.array([-0.08, 0.02, 1e-3, -8e-4, 0.004])
    return Camera(640, 480, np.array([420.0, 430.0]), np.array([310.0, 250.0]), lens, FISHEYE.position_body_m,
                  FISHEYE.dcm_cam_body, "pinhole")  # fmt: skip


def view_of(lens):
    return VirtualCamera(VEHICLE.geometry, FISHEYE if lens == "fisheye" else pinhole(), JOINT_M)


def some_points(count=5):
    rng = np.random.default_rng(1)
    y, z = FISHEYE.position_body_m[1:]
    clocks = np.arctan2(z, -y) + np.deg2rad(rng.uniform(-25.0, 25.0, count))
    outboard = np.array([lv_direction(c) for c in clocks])
    station, radius = rng.uniform(0.4, 0.7, count), rng.uniform(1.1, 1.45, count)
    return radius[:, None] * outboard - station[:, None] * np.array([1.0, 0.0, 0.0])


def moved(view, points, bending, column, step):
    """Pixels with one of the sixteen unknowns moved, by the plain projection."""
    camera, ring = view.camera, view.shell_terms[2]
    bent, lens, keep = np.array(bending), camera.distortion.copy(), {}
    position, centre, joint = camera.position_body_m.copy(), camera.centre_px.copy(), view.joint_station_m
    if column < 3:
        bent[column] += step
    elif column < 6:
        keep["turn"] = step * np.eye(3)[column - 3]
    elif column == 6:
        keep["scale"] = 1.0 + step
    elif column < 9:
        centre[column - 7] += step
    elif column < 11:
        lens[column - 9] += step
    elif column < 14:
        position[column - 11] += step
    elif column == 14:
        keep["shell"] = step
    else:
        joint += step
    other = Camera(camera.width_px, camera.height_px, camera.focal_px, centre, lens, position, camera.dcm_cam_body,
                   camera.lens)  # fmt: skip
    return plain_sight.project(points, bent, joint, ring, other, **keep)


@pytest.mark.parametrize("lens", ["fisheye", "pinhole"])
def test_projection_and_all_its_derivatives_are_those_of_the_plain_one(lens):
    view, points = view_of(lens), some_points()
    sight = view.sight(points, DEFORMATION)
    assert np.isfinite(sight.pixels).all()
    want = plain_sight.project(points, DEFORMATION, JOINT_M, view.shell_terms[2], view.camera)
    np.testing.assert_allclose(sight.pixels, want, atol=1e-8)
    for column in range(16):
        step = 1e-3 if column in (7, 8) else 1e-6
        up, down = (moved(view, points, DEFORMATION, column, side * step) for side in (1.0, -1.0))
        slope = (up - down) / (2.0 * step)
        size = max(1.0, np.abs(slope).max())
        np.testing.assert_allclose(sight.jacobian[:, :, column], slope, atol=3e-6 * size, err_msg=str(column))


@pytest.mark.parametrize("lens", ["fisheye", "pinhole"])
def test_many_deformations_and_cameras_are_projected_as_each_by_itself(lens):
    view, points = view_of(lens), np.concatenate([some_points(), [[-2.5, 0.4, 0.1]]])  # the last behind the lens
    deformations = DEFORMATION * np.array([[1.0], [-0.6], [0.0]])
    by_deformation = view.pixels_of_each(points, deformations)
    turn, scale = np.array([[0.05, 0.0, -0.1], [0.0, -0.03, 0.2]]), np.array([1.02, 0.97])
    given = {
        "centre_px": view.camera.centre_px + np.array([[3.0, 0.0], [0.0, -2.0]]),
        "distortion": view.camera.distortion + np.array([[0.01], [-0.02]]),
        "position_body_m": view.camera.position_body_m + np.array([[0.01, 0.0, 0.0], [0.0, 0.0, 0.02]]),
    }
    by_camera = view.pixels_of_each(points, DEFORMATION[None], view.camera.terms_of_turned(turn, scale, **given))
    others = [
        replace(view, camera=view.camera.turned(turn[k], scale[k], **{n: every[k] for n, every in given.items()}))
        for k in range(2)
    ]
    assert np.isnan(by_deformation[:, -1]).all()
    assert np.isfinite(by_deformation[:, :-1]).all()
    want = [view.sight(points, one).pixels for one in deformations]
    np.testing.assert_allclose(by_deformation, want, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        by_camera, [one.sight(points, DEFORMATION).pixels for one in others], rtol=0.0, atol=1e-9
    )


def test_edge_of_a_torus_is_where_sight_touches_it():
    circles = np.array([[0.62, 1.3, 0.12], [0.60, 1.35, 0.10], [0.66, 1.28, 0.0]])
    eye, ring, flat = np.array([-1.4, 0.25, -0.1]), (0.25, 0.3), 0.03
    clocks = np.deg2rad([10.0, 95.0, 250.0])
    points = np.empty((3, 3))
    assert limb_points(circles, ring, flat, eye, clocks, points)
    aft, out = circles[:, 0] - ring[0], circles[:, 1] - ring[1]
    opened = np.column_stack([circles[:, 0] + flat * out, circles[:, 1] - flat * aft, circles[:, 2]])
    one_by_one = [plain_sight.limb(circle, eye, clocks[k : k + 1])[0] for k, circle in enumerate(opened)]
    np.testing.assert_allclose(points, one_by_one, atol=1e-6)


def test_distance_from_an_edge_has_a_side_and_a_foot():
    t = np.linspace(0.0, 1.0, 31)
    line = np.column_stack([100.0 + 200.0 * t, 50.0 + 30.0 * np.sin(3.0 * t)])
    found = np.array([[140.0, 60.0], [201.3, 90.0], [251.0, 50.0]])
    residual, rows, at = np.empty(3), np.empty((3, 16)), np.empty(3)
    feet(found, line, np.zeros((31, 2, 16)), residual, rows, at)
    for point, r, foot in zip(found, residual, at, strict=True):
        away, where = plain_sight.distance_from_line(point, line)
        assert abs(r) == pytest.approx(away, rel=1e-9)
        assert foot == pytest.approx(where, abs=1e-9)
        # positive on the side to which (dy, -dx) of the way points
        j = int(where)
        way = line[j + 1] - line[j]
        assert np.sign(r) == np.sign((point - line[j]) @ [way[1], -way[0]])


def scene(place, noise, seed, across=(0.0, 1.0), size=(60, 80)):
    """Grey picture of a step of 90 levels, blurred as the lens blurs, ``place`` px along ``across`` from the middle."""
    v, u = np.indices(size, dtype=float)
    along = (u - 40.0) * across[0] + (v - 30.0) * across[1] - place
    # what the search's own smoothing adds to the lens's blur is in the shapes it looks for
    picture = 30.0 + 90.0 * ndtr(along / np.sqrt(WHOLE_BLUR_PX**2 - 0.8**2))
    return picture + noise * np.random.default_rng(seed).standard_normal(size)


def smoothed(picture):
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(picture, 0.8, mode="nearest").astype(np.float32)


def near_steps(places):
    """Places found by the compiled search, along lines down the picture, of steps that lie at ``places``."""
    out = []
    for seed, place in enumerate(places):
        image = smoothed(scene(place, 0.0, seed))
        origin, inward = np.array([[40.0, 30.0]]), np.array([[0.0, 1.0]])
        grey, inside = np.empty((1, len(NEAR_ALONG))), np.empty((1, len(NEAR_ALONG)), dtype=np.bool_)
        sample_lines(image, origin, inward, NEAR_ALONG[0], STEP_PX, np.zeros(2), np.array([80.0, 60.0]), grey, inside)
        plain = plain_horizon.grey(image, np.full(len(NEAR_ALONG), 40.0), 30.0 + NEAR_ALONG)
        np.testing.assert_allclose(grey[0], plain, atol=1e-4)
        place_px, along, left, good = np.zeros(1), np.zeros(1), np.zeros_like(grey), np.zeros(1, dtype=np.bool_)
        fit_steps(grey, inside, 0.3, 8.0, NEAR_PLACES, NEAR_BASES, place_px, along, left, good)
        assert good[0]
        profile = grey[0] - np.median(grey[0, :6])
        best, curvature, rest = plain_horizon.best_place(profile, NEAR_PLACES, NEAR_BASES)
        assert place_px[0] == pytest.approx(best, abs=1e-9)
        # half the sum of squares over the variance rises by a half at one sd
        assert along[0] == pytest.approx(np.sqrt(2.0 / curvature), rel=1e-9)
        np.testing.assert_allclose(left[0], rest, atol=1e-9)
        out.append(place_px[0])
    return np.array(out)


def test_a_step_near_its_place_is_found_to_a_few_hundredths_of_a_pixel():
    places = np.linspace(-2.3, 2.4, 9)
    np.testing.assert_allclose(near_steps(places), places, atol=0.05)


def first_rises_in(picture, noise):
    """Places found by the wide search along lines down the picture, and their sd."""
    m = 121
    image = smoothed(picture)
    columns = np.arange(10.0, 71.0, 4.0)
    n = len(columns)
    origin = np.column_stack([columns, np.full(n, 30.0)])
    inward = np.tile([0.0, 1.0], (n, 1))
    grey, inside = np.empty((n, m)), np.empty((n, m), dtype=np.bool_)
    height, width = picture.shape
    size = np.array([width, height], dtype=float)
    sample_lines(image, origin, inward, -29.0, STEP_PX, np.zeros(2), size, grey, inside)
    level, scatter, first = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    sky_levels(grey, inside, 12, level, scatter, first)
    place, sd, good = np.zeros(n), np.full(n, np.inf), np.zeros(n, dtype=np.bool_)
    first_rises(
        grey, inside, level, first, noise, float(np.median(level)), (12, 6, 8.0), STEP_PX, EDGE_PLACES, EDGE_BASES,
        place, sd, good,
    )  # fmt: skip
    return STEP_PX * place - 29.0, sd, good


def test_a_lasting_rise_is_found_to_a_few_hundredths_of_a_pixel():
    assert len(EDGE_BASES[0, 0]) == 2 * EDGE_HALF + 1
    for place in (-3.2, 0.3, 2.65):
        found, _, good = first_rises_in(scene(place, 0.0, 0), 0.3)
        assert good.all()
        np.testing.assert_allclose(found, place, atol=0.08)


def test_rises_and_steps_scatter_as_they_say():
    # of independent pictures; smoothed noise: what the kernel is told is the smoothed picture's own
    noise = 3.0
    told = noise / (2.0 * np.sqrt(np.pi) * 0.8)
    found, sd = [], []
    for seed in range(12):
        place, one, good = first_rises_in(scene(0.3, noise, 100 + seed), told)
        found += list(place[good] - 0.3)
        sd += list(one[good])
    # some 190 of them know their sd to 5 %; never more scatter than stated, never half of it
    ratio = np.std(found) / np.sqrt(np.mean(np.square(sd)))
    assert 0.5 < ratio < 1.15
    found, sd = [], []
    for seed in range(12):
        place, one = placed_near(scene(0.4, noise, 200 + seed))
        found += list(place - 0.4)
        sd += list(one)
    assert 0.5 < np.std(found) / np.sqrt(np.mean(np.square(sd))) < 1.15


def placed_near(picture):
    """Places of a step down the picture and their sd, on lines 4 px apart."""
    columns = np.arange(10.0, 71.0, 4.0)
    origin = np.column_stack([columns, np.full(len(columns), 30.0)])
    lines = ScanLines(origin, np.tile([0.0, 1.0], (len(columns), 1)), 8.0, 8.0, np.arange(len(columns)))
    found = steps_near(picture.astype(np.float32), lines)
    return found.points_px[:, 1] - 30.0, found.sd_px


@pytest.mark.parametrize("beside_px", [-7.0, -4.0, 4.0])
def test_a_step_beside_another_is_as_far_off_as_it_says(beside_px):
    """Clouds behind the rim, a shade on the shell: no noise, and alike on all lines."""
    bare = scene(0.4, 2.0, 7)
    cloud = ndtr((np.indices(bare.shape)[0] - 30.0 - beside_px) / 1.2)
    (place, sd), (_, clear) = placed_near(bare + 25.0 * cloud), placed_near(bare)
    assert len(place) == len(clear) == 16
    assert (sd > 1.5 * clear).all()
    assert (np.abs(place - 0.4) < 3.3 * sd).all()


def mark(place, noise=0.0, seed=0):
    """A dark line 3 px wide down the picture, ``place`` px right of column 30, on light that slopes."""
    _, u = np.indices((40, 60), dtype=float)
    light = 90.0 + 0.8 * u
    off = u - 30.0 - place
    dark = 0.5 * (ndtr((off + 1.5) / 0.9) - ndtr((off - 1.5) / 0.9))
    return light * (1.0 - dark) + noise * np.random.default_rng(seed).standard_normal((40, 60))


def centres(images, noise, sign=1.0):
    out = []
    for image in images:
        offset, sd = np.zeros(1), np.full(1, np.inf)
        dark_centres(
            image, np.array([[30.0, 20.0]]), np.array([[1.0, 0.0]]), 8, np.array([4]), np.array([sign]), noise,
            offset, sd,
        )  # fmt: skip
        out.append((offset[0], sd[0]))
    return np.array(out).T


@pytest.mark.parametrize("top", [0.0, 9.0])
def test_the_first_step_on_a_line_is_the_plain_one(top):
    """A plain body, a step behind it, steps behind that; lines that begin or end beyond the picture, or find none."""
    rng = np.random.default_rng(4)
    picture = rng.normal(60.0, 1.5, (60, 80))
    picture[:, 30:] += 40.0
    picture[:, 44:] -= 70.0
    picture[50:, 30:44] -= 25.0
    picture = picture.astype(np.float32)
    row = np.linspace(2.0, 57.0, 23)
    origin = np.column_stack([np.linspace(0.0, 75.0, 23), row])
    clock = np.linspace(-0.5, 0.5, 23)
    outward, corner = np.column_stack([np.cos(clock), np.sin(clock)]), np.array([0.0, top])
    size, count = np.array([80.0, 60.0 + top]), 97
    origin[:, 1] += top
    grey, inside = np.empty((23, count)), np.empty((23, count), dtype=np.bool_)
    sample_lines(picture, origin, outward, -24.0, STEP_PX, corner, size, grey, inside)
    limits, place = (12, 4, 8.0, 4.0), np.empty(23)
    first_lasting_steps(grey, inside, limits, place)
    expected = plain_horizon.first_lasting_steps(grey, inside, limits)
    np.testing.assert_allclose(place, expected, atol=1e-9)
    assert 0 < np.isnan(place).sum() < 12


def test_a_point_is_coherent_with_most_of_the_places_beside_it():
    rng = np.random.default_rng(8)
    line = np.flatnonzero(rng.random(60) < 0.8)
    residual = np.where(rng.random(len(line)) < 0.15, np.nan, rng.normal(0.0, 0.6, len(line)))
    alike = (np.abs(line[:, None] - line) <= 4) & (np.abs(residual[:, None] - residual) < 0.7)
    found = is_coherent(line, residual)
    np.testing.assert_array_equal(found, alike.sum(axis=1) > 4)
    assert 5 < found.sum() < len(line) - 5
    assert not len(is_coherent(line[:0], residual[:0]))


def patch_of(rng):
    """A picture of smooth noise, and the template about its middle."""
    grey = cv2.GaussianBlur(rng.standard_normal((60, 64)), (0, 0), 2.0)
    picture = np.ascontiguousarray(grey / grey.std(), dtype=np.float32)
    template = picture[24:35, 27:38].astype(float)
    template = template - template.mean(axis=1, keepdims=True)
    return picture, template / np.linalg.norm(template)


def test_correlation_of_a_patch_leaves_out_what_is_the_same_along_its_rows():
    picture, template = patch_of(np.random.default_rng(1))
    reach, score = 4, np.empty((9, 9))
    assert correlations(picture, template, np.array([34.0, 31.0]), np.eye(2), reach, score)
    expected = np.empty((9, 9))
    for v, u in np.ndindex(9, 9):
        there = picture[22 + v : 33 + v, 25 + u : 36 + u].astype(float)
        there -= there.mean(axis=1, keepdims=True)
        expected[v, u] = np.sum(template * there) / np.linalg.norm(there)
    np.testing.assert_allclose(score, expected, atol=1e-6)
    shaded = picture + np.linspace(0.0, 9.0, 60, dtype=np.float32)[:, None] ** 2
    again = np.empty((9, 9))
    assert correlations(shaded, template, np.array([34.0, 31.0]), np.eye(2), reach, again)
    np.testing.assert_allclose(again, score, atol=1e-5)
    assert not correlations(picture, template, np.array([3.0, 31.0]), np.eye(2), reach, score)


def test_a_patch_is_found_between_pixels_through_the_map_that_predicts_it():
    picture, template = patch_of(np.random.default_rng(2))
    turn = np.array([[0.96, -0.12], [0.1, 1.03]])
    for off in ((0.3, -0.4), (-1.6, 1.2)):
        # the frame shows the template's surroundings, turned, about (32 + off, 29 + off)
        v, u = np.mgrid[:60, :64].astype(float)
        back = np.stack([u - 32.0 - off[0], v - 29.0 - off[1]], axis=-1) @ np.linalg.inv(turn).T
        maps = [(back[..., k] + (32.0, 29.0)[k]).astype(np.float32) for k in (0, 1)]
        frame = cv2.remap(picture, *maps, cv2.INTER_CUBIC)
        place, sd = np.empty((1, 2)), np.empty((1, 2))
        find_patches(
            frame, template[None], np.array([[32.0, 29.0]]), turn[None], np.eye(2)[None], (3, 0.8, 14.0), place, sd
        )
        # a small window's own energy changes as it is shifted, which moves a parabola's top by a tenth of a pixel
        np.testing.assert_allclose(place[0], np.array([32.0, 29.0]) + off, atol=0.15)
        # across the rows their means, which are left out, say nothing
        assert sd[0, 0] < 0.3
        assert sd[0, 1] < 0.4


def test_a_dark_line_is_found_where_it_is_with_the_sd_its_noise_gives():
    for place in (-1.7, 0.0, 0.45):
        found, _ = centres([mark(place)], 0.3)
        assert found[0] == pytest.approx(
            plain_horizon.dip_centre(mark(place), (30.0, 20.0), (1.0, 0.0), 8, 4), abs=1e-9
        )
        assert found[0] == pytest.approx(place, abs=0.05)
        pale = centres([2.0 * (90.0 + 0.8 * np.indices((40, 60))[1]) - mark(place)], 0.3, -1.0)[0]
        assert pale[0] == pytest.approx(place, abs=0.05)
        assert not np.isfinite(centres([mark(place)], 0.3, -1.0)[1][0])
    noise = 2.0
    found, sd = centres([mark(0.2, noise, seed) for seed in range(60)], noise)
    assert np.isfinite(sd).all()
    # the sd counts the noise of the whole window, +/- 4 px, as if the mark were as wide; where it is not dark, noise is
    # cut off, so that of the sum of squares 60 as few as those of +/- 2 px, 10, are left. 60 draws know an sd to 9 %
    assert 0.9 * np.sqrt(10.0 / 60.0) * 0.8 < np.std(found) / np.sqrt(np.mean(sd**2)) < 1.2


def fit_inputs(view, bending, edge_left=0.0):
    """Exact edge points and marks of a bending, as the compiled fit wants them."""
    edge = view.edge(np.array(bending))
    inside = np.flatnonzero(view.camera.is_inside(edge.pixels, 6.0))
    chosen = inside[2:-2:6]
    m = len(chosen)
    found = edge.pixels[chosen] + edge_left * edge.inward_px[chosen]
    light = np.column_stack([np.ones(m), np.linspace(-1.0, 1.0, m), np.linspace(-1.0, 1.0, m) ** 2])
    points = np.ascontiguousarray(some_points(6))
    pixels = view.sight(points, np.array(bending)).pixels
    across = np.tile(np.eye(2), (3, 1))
    place = np.einsum("ni,ni->n", pixels, across)
    waves = waves_round(lv_clock(points[:, 1:]), view.from_ring_m(points))
    marks = (points, across, place, np.full(6, 0.2), np.zeros(6), waves)
    return (found, light, np.full(m, 0.3), np.full(m, edge_left)), marks


def fitted(view, edge, marks, prior, start):
    bending, count = np.array(start, dtype=float), len(edge[0]) + len(marks[0])
    out = (
        np.empty(count),
        np.zeros((count, 16)),
        np.zeros((count, SHAPES)),
        np.empty(count),
        np.empty(count),
    )
    limits = (1.5, 12.0, 1e-9, 30, 4)
    state, _ = fit_frame(
        bending,
        np.eye(2),
        view.shell_terms,
        view.camera.lens_terms,
        edge,
        marks,
        (np.zeros_like(prior), prior),
        limits,
        *out,
    )
    assert state == DONE
    return bending, out


PRIOR = np.array([0.004, 0.05, *[0.002] * 12, 0.3, 0.3, 0.3])


def test_exact_points_give_their_deformation_back_whatever_the_benchmark_s_residuals():
    view = view_of("fisheye")
    for left in (0.0, 0.8):
        edge, marks = fit_inputs(view, [0.03, -0.04, 0.0], left)
        bending, _ = fitted(view, edge, marks, PRIOR, [0.0, 0.0, 0.0])
        np.testing.assert_allclose(bending, [0.03, -0.04, 0.0], atol=1e-6)


def test_the_fit_is_the_most_probable_one():
    # a shell that flattened more than the prior likes: the answer weighs the pictures against all priors, as an
    # optimiser of the same sum finds it that knows nothing of normal equations
    view, true = view_of("fisheye"), [0.03, -0.04, 0.012]
    edge, marks = fit_inputs(view, true)
    got, out = fitted(view, edge, marks, PRIOR, [0.02, -0.03, 0.0])
    weight = out[3]
    assert (weight > 0.0).all()

    def residuals(x):
        # shape unknowns linear, about the answer's own rows
        bending, shape = x[:3], x[3:]
        rows = []
        m = len(edge[0])
        line = view.edge(bending)
        r, j, at = np.empty(m), np.empty((m, 16)), np.empty(m)
        feet(edge[0], line.pixels, line.jacobian, r, j, at)
        rows.append(r - edge[3])
        sight = view.sight(marks[0], bending)
        rows.append(marks[2] - np.einsum("ni,ni->n", sight.pixels, marks[1]))
        left = np.concatenate(rows) - out[1][:, 15] * shape[0] - out[2] @ shape[1:]
        return np.concatenate([np.sqrt(weight) * left, bending[2:] / PRIOR[0], shape / PRIOR[1:]])

    best = least_squares(residuals, np.concatenate([got, np.zeros(16)]), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    assert abs(best[2] - true[2]) > 1e-5  # the priors pull
    np.testing.assert_allclose(got, best[:3], atol=2e-6)


@pytest.mark.parametrize("terms", [1, 4, 12])
@pytest.mark.parametrize("is_seen", [True, False])
def test_the_motion_beside_a_fit_is_that_of_a_fit_of_both(terms, is_seen):
    """Of columns as unlike as radians and pixels; and where one term of the motion moves no point."""
    rng = np.random.default_rng(terms)
    columns, by = rng.normal(size=(61, 19)), rng.normal(size=(61, terms)) * 300.0 ** rng.random(terms)
    by[:, -1] *= is_seen
    residual, weight, prior = rng.normal(size=61), rng.random(61), np.diag(rng.random(19))
    formal = np.linalg.inv((columns.T * weight) @ columns + prior)
    design = Design(columns, formal, np.empty((61, 4)), np.empty((61, 2)), 1.0, residual, weight, 0)
    motion, square = design.motion(by, 0.02)
    seen = terms - (not is_seen)
    both = np.column_stack([columns, by[:, :seen]])
    joint = (both.T * weight) @ both
    joint[:19, :19] += prior
    covariance = np.linalg.inv(joint)
    expected = (covariance @ (both.T @ (weight * residual)))[19:]
    np.testing.assert_allclose(motion[:seen], expected, rtol=1e-7, atol=1e-12)
    np.testing.assert_array_equal(motion[seen:], 0.0)
    allowed = covariance[19:, 19:] + 0.02**2 * np.eye(seen)
    assert square == pytest.approx(expected @ np.linalg.solve(allowed, expected), rel=1e-8, abs=1e-12)
    assert (square > 0.0) == (seen > 0)


def test_large_residuals_pull_no_harder_than_huber_lets_them():
    residual = np.array([0.1, -0.2, 0.15, -0.1, 0.05, 8.0, np.nan])
    weight, scaled = np.empty(7), np.empty(7)
    edges = huber_weights(7, 0, np.full(7, 0.2), np.empty(0), 1.5, residual, scaled, weight)
    assert edges == 6
    assert weight[6] == 0.0
    scale = 1.0 / np.sqrt(weight[0])
    assert scale == pytest.approx(0.2)
    assert weight[5] * residual[5] * scale == pytest.approx(1.5)
    np.testing.assert_allclose(weight[:5], weight[0])


def test_distances_are_linear_between_a_triangle_s_corners():
    depth, nearest = np.full((20, 30), np.inf), np.full((20, 30), -1)
    corners, away = np.array([[3.0, 2.0], [25.0, 4.0], [8.0, 17.0]]), [5.0, 9.0, 14.0]
    fill(*corners.ravel(), *away, 4, depth, nearest)
    hit = nearest == 4
    plane = np.linalg.solve(np.column_stack([corners, np.ones(3)]), away)
    v, u = np.indices(depth.shape)
    np.testing.assert_allclose(depth[hit], (plane[0] * u + plane[1] * v + plane[2])[hit], rtol=1e-9)
    area = 0.5 * abs(np.linalg.det(np.column_stack([corners, np.ones(3)])))
    assert hit.sum() == pytest.approx(area, rel=0.06)

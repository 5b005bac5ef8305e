"""Frames that show the shell, but not as the camera saw it: what is refused, by which code."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from estimators import benchmark
from estimators.benchmark import orient_camera
from estimators.camera import read_film, without_doubtful
from estimators.edge import WHOLE_BLUR_PX, HorizonLine, steepness_of
from estimators.features import valleys, visible_features
from estimators.frame_checks import Design, fault_of_fit
from estimators.frame_edits import EditedFrame
from estimators.frame_solution import POSED, TURN, AprioriSd, refused_fit
from estimators.virtual_camera import VirtualCamera, deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.checks import GateError, Issue
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film
from tests.estimators.test_other_film import answers
from tests.refusing import numbers_in

CONTRADICTS = {"camera-turned", "picture-warped", "edge-not-shell", "features-contradict-edge"}
THETA_DEG, PLANE_DEG = [0.0, 3.0, 3.6], [0.0, 188.0, 160.0]


@pytest.fixture(scope="module")
def frames():
    return film(5, THETA_DEG, PLANE_DEG)


def moved(frame, turn_deg, shift_px):
    h, w = frame.shape
    matrix = cv2.getRotationMatrix2D((0.5 * w, 0.5 * h), turn_deg, 1.0)
    matrix[:, 2] += shift_px
    return cv2.warpAffine(frame, matrix, (w, h), flags=cv2.INTER_CUBIC)


@pytest.mark.parametrize(("turn_deg", "shift_px"), [(2.0, (0.0, 0.0)), (-1.0, (12.0, 4.0))])
def test_a_camera_that_moved_in_its_mount_is_noticed(frames, turn_deg, shift_px):
    """What the features determine of a turn beside the deflection; unmoved, the same frame is answered."""
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    assert not oriented.fit(frames[1]).refused
    spoilt = oriented.fit(moved(frames[1], turn_deg, shift_px))
    # of one frame alone the whole edge counts where features contradict it; of several none does
    assert spoilt.contradicted or spoilt.refused.code in CONTRADICTS
    assert all(fit.refused for fit in without_doubtful([spoilt] * 4))


def test_a_frame_that_needs_more_than_a_deflection_is_no_answer(frames):
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    h, w = frames[1].shape
    v, u = np.mgrid[:h, :w].astype(np.float32)
    twisted = cv2.remap(frames[1], u, (v + 8.0 * np.sin(u / 40.0)).astype(np.float32), cv2.INTER_LINEAR)
    assert not oriented.fit(frames[1]).refused
    assert not oriented.fit(frames[2]).refused
    assert oriented.fit(twisted).refused.code in CONTRADICTS


def test_a_frame_out_of_focus_is_refused_and_a_film_that_always_was_is_not():
    """By its edge alone: the sun's side of the rim and its shaded side move apart as the edge widens."""
    plain = GEOMETRY.model_copy(update={"features": "none"})
    frames = film(6, [0.0, 1.0, 3.6], [0.0, 188.0, 160.0])
    wide = [cv2.GaussianBlur(frame, (0, 0), 5.0) for frame in frames]
    sharp = orient_camera(frames[0], plain, MOUNT, JOINT_M)
    assert not sharp.fit(cv2.GaussianBlur(frames[1], (0, 0), 1.0)).refused
    assert [sharp.fit(frame).refused.code for frame in wide[1:]] == ["edge-blurred"] * 2
    # and where the benchmark frame is the one that is out of focus
    soft = cv2.GaussianBlur(frames[0], (0, 0), 2.0)
    by_soft = orient_camera(soft, plain, MOUNT, JOINT_M)
    assert not by_soft.fit(cv2.GaussianBlur(frames[1], (0, 0), 2.0)).refused
    assert by_soft.steepness < sharp.steepness


def test_steepness_of_a_wide_edge_is_that_of_a_ramp():
    """A step blurred by s px, read half a pixel beside its middle between two pixels, and on pixels 2 px beside it."""
    across = np.arange(80.0) - 40.0
    for wide in (1.0, 2.5, 12.0):
        picture = np.tile(np.rint(20.0 + 200.0 * ndtr(across / wide)).astype(np.uint8)[:, None], (1, 120))
        line = np.arange(100)
        edge = HorizonLine(
            np.column_stack([10.0 + line, np.full(100, 40.0)]), np.tile([0.0, 1.0], (100, 1)), np.ones(100), line
        )
        whole = np.hypot(wide, np.sqrt(WHOLE_BLUR_PX**2 - 1.0))  # with the search's own smoothing
        expected = 0.5 * (ndtr(1.0 / whole) - 0.5) / (ndtr(2.0 / whole) - 0.5)
        assert steepness_of(picture, edge) == pytest.approx(expected, abs=0.01)
    assert np.isnan(steepness_of(picture, edge.some(line < 5)))


@pytest.mark.parametrize("zoom", [1.03, 1.08])
def test_a_lens_that_zoomed_is_noticed(frames, zoom):
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    h, w = frames[1].shape
    matrix = cv2.getRotationMatrix2D((0.5 * w, 0.5 * h), 0.0, zoom)
    fit = oriented.fit(cv2.warpAffine(frames[1], matrix, (w, h), flags=cv2.INTER_CUBIC))
    assert fit.refused.code in CONTRADICTS


def test_a_bar_of_text_across_the_picture_is_no_break_where_it_is_hidden(frames):
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    bar = np.zeros(frames[1].shape, dtype=bool)
    bar[300:340, 30:700] = True
    pictured = np.where(bar, 0, frames[1]).astype(np.uint8)
    assert oriented.fit(pictured).refused.code == "frame-broken"
    hidden, clear = oriented.fit(EditedFrame(pictured, bar)), oriented.fit(frames[1])
    np.testing.assert_allclose(hidden.rotation_yz_rad, clear.rotation_yz_rad, atol=np.deg2rad(0.1))


def sound_design(theta_deg):
    """Derivatives of features on a shell of which the deflection alone is fitted, and where they are."""
    view = VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)
    features = visible_features(view)
    sight = view.sight(features.points_shell_m, deformation_of(np.deg2rad(theta_deg), np.deg2rad(188.0)))
    seen = view.camera.is_inside(sight.pixels)
    across, pixels = features.across_px[seen], sight.pixels[seen]
    rows = np.einsum("ni,nij->nj", across, sight.jacobian[seen])
    rng = np.random.default_rng(4)
    columns, weight = rows[:, :2].copy(), np.full(len(rows), 25.0)
    formal = np.linalg.inv((columns.T * weight) @ columns)
    residual = 0.2 * rng.standard_normal(len(rows))
    design = Design(columns, formal, rows[:, TURN], across, float(view.camera.focal_px[0]), residual, weight, 0)
    return design, (pixels - view.camera.centre_px) / view.camera.focal_px


def test_a_warp_moves_points_by_where_they_are():
    design, places = sound_design(3.0)
    u, v = places.T
    a, b = design.across.T
    expected = np.column_stack([x * c for c in (a, b) for x in (np.ones_like(u), u, v, u * u, u * v, v * v)])
    np.testing.assert_allclose(design.warp, expected, atol=1e-9)


def test_what_a_turn_a_zoom_or_a_warp_explains_is_no_deflection():
    design, _ = sound_design(3.0)
    lobes, shape = np.deg2rad(0.1), np.zeros(17)

    def code(moved_px):
        fault = fault_of_fit(replace(design, residual_px=design.residual_px + moved_px), 0.5, shape, lobes)[0]
        return getattr(fault, "code", "")

    assert fault_of_fit(design, 0.5, shape, lobes) == ("", 0.0)
    assert code(design.turn @ np.deg2rad([0.0, 0.0, 2.0, 0.0])) == "camera-turned"
    assert code(design.turn @ [0.0, 0.0, 0.0, 0.05]) == "camera-turned"
    # what lobes that are not modelled may look like
    assert code(design.turn @ np.deg2rad([0.0, 0.0, 0.1, 0.0])) == ""
    bent = design.warp[:, 4] - design.warp[:, 9]
    explained = np.column_stack([design.columns, design.turn])
    bent -= explained @ np.linalg.lstsq(explained, bent)[0]
    assert code(20.0 * bent) == "picture-warped"
    assert code(0.5 * bent) == ""
    # and where shape, turn and warp are each a little improbable
    shape = np.full(17, 1.6)
    assert code(np.zeros(len(bent))) == ""
    warped = next(k for k in np.arange(1.0, 20.0, 0.25) if code(k * bent))
    assert code(warped * bent) == "picture-warped"
    shape = np.zeros(17)
    assert code(warped * bent) == ""


def test_a_zoom_that_is_no_fault_yet_is_in_the_variance():
    """By what it moves the answer, a deflection being fitted alone, as far as it is beyond chance."""
    design, _ = sound_design(3.0)
    lobes, shape, zoom = np.deg2rad(0.1), np.zeros(17), 0.006
    assert fault_of_fit(design, 0.5, shape, lobes) == ("", 0.0)
    # all of them edge points: no halves
    design = replace(design, edge_points=len(design.columns))
    moved = replace(design, residual_px=design.residual_px + zoom * design.turn[:, 3])
    fault, variance = fault_of_fit(moved, 0.5, shape, lobes)
    assert not fault
    fitted = np.linalg.lstsq(np.column_stack([design.columns, design.turn]), moved.residual_px)[0]
    alone = np.linalg.lstsq(design.columns, moved.residual_px)[0]
    square = moved.motion(design.turn, lobes)[1]
    assert square > 8.0
    assert variance == pytest.approx((1.0 - 4.0 / square) * np.sum((fitted[:2] - alone) ** 2), rel=1e-6)


def test_two_halves_of_a_picture_have_one_deflection():
    """Residuals that no turn and no warp explains, and of the features alone: the edge in both halves is as it was."""
    design, _ = sound_design(3.0)
    lobes, shape = np.deg2rad(0.1), np.zeros(17)
    explained = np.column_stack([design.columns, design.turn, design.warp])
    left, upper_by = design.halves
    apart = upper_by @ np.deg2rad([0.9, 0.0])
    apart -= explained @ np.linalg.lstsq(explained, apart)[0]

    def fault(moved_px, edge_points=0):
        spoilt = replace(design, residual_px=design.residual_px + moved_px, edge_points=edge_points)
        return fault_of_fit(spoilt, 0.5, shape, lobes)[0]

    assert not fault(np.zeros(len(apart)))
    assert fault(apart).code == "halves-differ"
    fitted = np.linalg.lstsq(np.column_stack([upper_by, design.columns]), design.residual_px + apart)[0][:2]
    assert numbers_in(fault(apart))[0] == pytest.approx(2.0 * np.rad2deg(np.linalg.norm(fitted)), abs=0.06)
    assert not fault(0.1 * apart)
    # all of them edge points, and none a feature
    assert not fault(apart, len(apart))
    upper = design.places[1] < np.median(design.places[1])
    np.testing.assert_array_equal(upper_by[upper], design.columns[upper, :2])
    np.testing.assert_array_equal(upper_by[~upper], -design.columns[~upper, :2])
    on_left = design.places[0] < np.median(design.places[0])
    np.testing.assert_array_equal(left[on_left], design.columns[on_left, :2])
    np.testing.assert_array_equal(left[~on_left], -design.columns[~on_left, :2])


def test_halves_that_differ_by_less_widen_the_answer():
    """The left half and the right one: by the square of how far they are apart, where that is beyond chance."""
    design, _ = sound_design(3.0)
    lobes, shape = np.deg2rad(0.1), np.zeros(17)
    explained = np.column_stack([design.columns, design.turn, design.warp])

    def variance(size_deg):
        apart = design.halves[0] @ np.deg2rad([size_deg, 0.0])
        apart -= explained @ np.linalg.lstsq(explained, apart)[0]
        spoilt = replace(design, residual_px=design.residual_px + apart)
        fault, found = fault_of_fit(spoilt, 0.5, shape, lobes)
        assert not fault
        half, square = spoilt.motion(spoilt.halves[0], np.deg2rad(0.02))
        return found, 4.0 * half @ half, square

    assert variance(0.0)[0] == 0.0
    found, size, square = variance(1.5)
    assert square > 20.0
    assert found == pytest.approx((1.0 - 18.4 / square) * size, rel=1e-6)
    # all of them edge points, and none a feature
    moved = replace(design, residual_px=design.residual_px + np.deg2rad(1.5) * design.halves[0][:, 0])
    assert fault_of_fit(replace(moved, edge_points=len(moved.columns)), 0.5, shape, np.deg2rad(10.0))[1] == 0.0


def test_a_frozen_picture_is_no_frame(frames):
    pictures = [frames[0], frames[1], frames[1].copy(), frames[2]]
    read = read_film(np.array([421.0, 430.0, 431.0, 432.0]), pictures, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None)
    assert [fit.refused.code if fit.refused else "" for fit in read.fits] == ["", "", "frame-frozen", ""]
    assert "frozen" in read.history().assumptions


def test_an_answer_among_frames_that_contradict_the_shell_is_doubted():
    fits = answers(np.linspace(1.0, 2.0, 10))

    def codes(*refused, code="camera-turned"):
        spoilt = [refused_fit(f.horizon, Issue("no", code)) if k in refused else f for k, f in enumerate(fits)]
        return [k for k, f in enumerate(without_doubtful(spoilt))
                if f.refused and f.refused.code == "frames-around-refused"]  # fmt: skip

    assert codes() == []
    assert codes(4) == []
    assert codes(4, 6) == [5]
    assert codes(7, 8) == [6, 9]
    assert codes(4, 6, code="shell-little-seen") == [5]
    assert codes(4, 6, code="frame-exposure") == []


def test_part_of_an_edge_beside_hardly_a_feature_is_no_answer(frames):
    """It passes for that of a shell degrees away, and features there for a few of its own."""
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    edge, first = oriented._edge_at_benchmark, {True: 0, False: oriented.painted_rows}

    def seen(of_edge, of_features, painted):
        points, count = int(of_edge * edge), int(of_features * oriented.features_at_benchmark(painted))
        last = SimpleNamespace(feature_rows=first[painted] + np.arange(count))
        oriented._check_seen(SimpleNamespace(points_px=np.zeros(points)), last)

    for painted in (True, False):
        seen(0.6, 0.3, painted)
        seen(0.9, 0.1, painted)
        for of_edge, of_features in ((0.6, 0.1), (0.3, 0.3)):
            with pytest.raises(GateError) as refusal:
                seen(of_edge, of_features, painted)
            assert refusal.value.codes == ("shell-little-seen",)


@pytest.mark.parametrize(("key", "off_deg"), [("roll_deg", 80.0), ("axis_from_forward_deg", -20.0)])
def test_a_mount_stated_wrongly_is_named_where_the_shell_is_seen_by_a_turned_camera(frames, key, off_deg):
    wrong = MOUNT.model_copy(update={key: getattr(MOUNT, key) + off_deg})
    with pytest.raises(GateError) as refusal:
        orient_camera(frames[0], GEOMETRY, wrong, JOINT_M)
    assert refusal.value.codes == ("edge-not-clear",)
    *_, about, across = numbers_in(str(refusal.value))
    assert max(about, across) == pytest.approx(abs(off_deg), abs=12.0)
    # nothing of the kind is said of a frame that shows no shell
    noise = np.random.default_rng(3).integers(90, 130, frames[0].shape).astype(np.uint8)
    with pytest.raises(GateError) as refusal:
        orient_camera(noise, GEOMETRY, wrong, JOINT_M)
    assert "turned" not in str(refusal.value)


def test_a_benchmark_without_any_point_is_refused_in_words(frames):
    nominal = VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)
    prior = benchmark._prior_sd(MOUNT.uncertainty, AprioriSd())
    empty = EditedFrame(np.full_like(frames[0], 90))
    with pytest.raises(GateError) as refusal:
        benchmark._fitted(nominal, empty, prior, AprioriSd(), np.zeros(12), (12, 8), valleys)
    assert refusal.value.codes == ("edge-points-too-few",)


def test_points_that_say_nothing_of_the_pixels_refuse_no_benchmark(frames):
    """Of a blurred picture few were found: where all lie in its middle, neither stretch nor shear shows."""
    nominal = VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)
    features = valleys(nominal)
    look = benchmark._look(nominal, features, EditedFrame(frames[0]), 12, features.placed_m)
    middle = np.broadcast_to(nominal.camera.centre_px, look.horizon.points_px.shape)
    look = replace(look, horizon=replace(look.horizon, points_px=middle))
    few = look.residuals.some(np.arange(len(look.residuals.index)) < 3)
    sd = benchmark._prior_sd(MOUNT.uncertainty, AprioriSd())[:12]
    benchmark._check_square(look, features, few, few.rows[:, POSED], sd)


def test_a_benchmark_that_shows_hardly_any_of_the_shell_is_implausible(frames):
    """A third of the edge and a third of the valleys, each point where another lens puts it: agreement by chance."""
    plain = GEOMETRY.model_copy(update={"features": "none"})
    oriented = orient_camera(frames[0], plain, MOUNT, JOINT_M)
    rows = oriented.benchmark_residuals
    little = replace(oriented, benchmark_residuals=rows.some(rows.index % 3 == 0))
    assert replace(little, support=0.33).has_bad_benchmark
    assert not replace(little, support=0.5).has_bad_benchmark
    assert not replace(oriented, support=0.33).has_bad_benchmark


def test_texture_that_agrees_on_a_turned_camera_is_no_plain_cloth(frames):
    """Of a camera that turned in its mount the edge alone would answer, as of cloth that shows light and shade."""
    textured = orient_camera(frames[0], GEOMETRY.model_copy(update={"features": "texture"}), MOUNT, JOINT_M)
    size = frames[0].shape[::-1]
    turned = cv2.getRotationMatrix2D((0.5 * size[0], 0.5 * size[1]), 2.0, 1.0)
    for frame in frames[1:]:
        assert textured.fit(frame).features > 500
        moved = np.asarray(cv2.warpAffine(frame, turned, size, flags=cv2.INTER_CUBIC), dtype=np.uint8)
        assert textured.fit(moved).refused.code == "camera-turned"

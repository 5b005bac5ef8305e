"""The centerbody's own edge in the picture: it stays where it is under a deflection, and moves with the camera."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.body_edge import UNMOVED, _followed, body_edge
from estimators.camera import without_moved
from estimators.edge import KeptPicture, no_horizon
from estimators.frame_solution import refused_fit
from flightmodel.checks import Issue
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film

ALONE = GEOMETRY.model_copy(update={"features": "none"})


@pytest.fixture(scope="module")
def frames():
    return film(5, [0.0, 2.0, 3.6], [0.0, 188.0, 160.0])


@pytest.fixture(scope="module")
def oriented(frames):
    return orient_camera(frames[0], ALONE, MOUNT, JOINT_M)


def moved(frame, shift_px, turn_deg=0.0):
    h, w = frame.shape
    matrix = cv2.getRotationMatrix2D((0.5 * w, 0.5 * h), turn_deg, 1.0)
    matrix[:, 2] += shift_px
    return cv2.warpAffine(frame, matrix, frame.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


def test_a_deflection_leaves_the_centerbody_where_it_is(frames, oriented):
    for frame in frames:
        fit = oriented.fit(frame)
        assert not fit.refused
        assert fit.mount_px == 0.0


def test_a_camera_that_moved_is_no_deflection_by_the_edge_alone(frames, oriented):
    """By 6 px, which the shell's edge explains by a degree."""
    blind = replace(oriented, body=None)
    picture = moved(frames[1], (0.0, -6.0))
    wrong, fit = blind.fit(picture), oriented.fit(picture)
    assert not wrong.refused
    assert np.linalg.norm(wrong.rotation_yz_rad - blind.fit(frames[1]).rotation_yz_rad) > np.deg2rad(0.7)
    assert fit.refused.code == "camera-turned"
    assert fit.mount_px == pytest.approx(6.0, abs=0.7)


def test_where_nothing_is_seen_of_it_nothing_is_said(frames, oriented):
    lines = oriented.body.lines
    bare = cv2.GaussianBlur(frames[1], (0, 0), 25.0)
    everywhere = np.ones(len(lines.index), dtype=bool)
    assert np.isnan(oriented.body.moved(KeptPicture(bare), everywhere).px)
    assert np.isnan(oriented.body.moved(KeptPicture(moved(frames[1], (0.0, -6.0))), ~everywhere).px)
    assert body_edge(oriented.view, KeptPicture(bare)) is None


def test_frames_that_do_not_show_it_go_with_their_neighbours():
    out = refused_fit(no_horizon(Issue("")), Issue("moved", "camera-turned"), 5.0)
    answered = replace(out, refused=Issue(""), mount_px=0.0)
    unseen = replace(answered, mount_px=float("nan"))
    fits = [unseen, answered, unseen, answered, unseen, out, unseen, unseen]
    assert [bool(fit.refused) for fit in without_moved(fits)] == [False] * 4 + [True] * 4
    assert not any(fit.refused for fit in without_moved([unseen] * 3))


def test_a_camera_that_moved_along_it_is_noticed_in_two_frames(frames, oriented):
    """A seventh of the points lie within a pixel of where they were; one frame alone may show a shadow's edge."""
    spoilt = [oriented.fit(moved(frame, (8.0, 0.0))) for frame in frames[1:]]
    off = spoilt[0].rotation_yz_rad - oriented.fit(frames[1]).rotation_yz_rad
    assert np.linalg.norm(off) > np.deg2rad(1.0)
    assert all(fit.mount_px > 2.0 and not fit.mount_is_sure for fit in spoilt)
    sound = [oriented.fit(frame) for frame in frames[1:]]
    answered = replace(spoilt[0], refused=Issue(""))
    assert not any(fit.refused for fit in without_moved([sound[0], answered, sound[1]]))
    assert not any(fit.refused for fit in without_moved([answered]))
    together = without_moved([sound[0], answered, answered, sound[1]])
    assert [getattr(fit.refused, "code", "") for fit in together] == ["", "camera-turned", "camera-turned", ""]
    assert "up to" in together[1].refused


def test_the_motion_is_that_of_most_points(oriented):
    """Of two thirds of them, but for noise; the others lie anywhere, as on shadows and seams."""
    lines, rng = oriented.body.lines, np.random.default_rng(3)
    (u, v), (a, b) = lines.origin_px.T - 300.0, lines.inward_px.T
    true = 0.02 * (b * u - a * v) + lines.inward_px @ [-3.0, 1.0]
    found = true + 0.2 * rng.standard_normal(len(true))
    other = rng.random(len(true)) < 0.33
    found[other] = rng.uniform(-24.0, 24.0, other.sum())
    followed = _followed(lines.origin_px, lines.inward_px, found)
    together = followed.of_points(lines.origin_px, lines.inward_px)
    np.testing.assert_allclose(together, true, atol=0.25)
    assert np.abs(true).max() > 3.0


def test_little_of_it_in_view_is_enough(frames, oriented):
    """100 px of it, as a camera that sees no more than a corner."""
    column = oriented.body.lines.origin_px[:, 0]
    corner = (column > 520.0) & (column < 620.0)
    assert oriented.body.moved(KeptPicture(frames[1]), corner) is UNMOVED
    elsewhere = KeptPicture(moved(frames[1], (0.0, -6.0)))
    assert oriented.body.moved(elsewhere, corner).px == pytest.approx(6.0, abs=0.7)


def test_an_edge_that_moves_alone_is_a_shadow(frames):
    """Beside the benchmark frame's edge lay the body's own shadow; what the shell's features show has not moved."""
    with_features = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    place, column = with_features.body.place_px, with_features.body.lines.origin_px[:, 0]
    at, to = np.quantile(column[np.isfinite(place)], [0.9, 0.0])
    shaded = replace(with_features.body, place_px=place + 6.0 * np.clip((at - column) / (at - to), 0.0, 1.0))
    picture = KeptPicture(frames[1])
    assert shaded.moved(picture, np.ones(len(place), dtype=bool)).px > 2.0
    fit = replace(with_features, body=shaded).fit(frames[1])
    assert not fit.refused
    assert fit.mount_px == 0.0
    # the same motion of a camera, which all of the picture shows
    turned = moved(frames[1], (0.0, -1.5), 0.25)
    assert with_features.body.moved(KeptPicture(turned), np.ones(len(place), dtype=bool)).px > 1.5
    spoilt = with_features.fit(turned)
    assert spoilt.refused or spoilt.mount_px > 1.5

"""The centerbody's own edge in the picture: it stays where it is under a deflection, and moves with the camera."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.body_edge import body_edge
from estimators.camera import without_moved
from estimators.edge import KeptPicture, no_horizon
from estimators.frame_solution import refused_fit
from flightmodel.checks import Fault
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film

ALONE = GEOMETRY.model_copy(update={"features": "none"})


@pytest.fixture(scope="module")
def frames():
    return film(5, [0.0, 2.0, 3.6], [0.0, 188.0, 160.0])


@pytest.fixture(scope="module")
def oriented(frames):
    return orient_camera(frames[0], ALONE, MOUNT, JOINT_M)


def moved(frame, shift_px):
    matrix = np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]])
    return cv2.warpAffine(frame, matrix, frame.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


def test_a_deflection_leaves_the_centerbody_where_it_is(frames, oriented):
    for frame in frames:
        fit = oriented.fit(frame)
        assert not fit.refused
        assert fit.mount_px == 0.0


def test_a_camera_that_moved_is_told_from_a_deflection_by_the_edge_alone(frames, oriented):
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
    assert np.isnan(oriented.body.moved_px(KeptPicture(bare), everywhere))
    assert np.isnan(oriented.body.moved_px(KeptPicture(moved(frames[1], (0.0, -6.0))), ~everywhere))
    assert body_edge(oriented.view, KeptPicture(bare)) is None


def test_frames_that_do_not_show_it_go_with_their_neighbours():
    out = refused_fit(no_horizon(Fault("")), Fault("moved", "camera-turned"), 5.0)
    answered = replace(out, refused=Fault(""), mount_px=0.0)
    unseen = replace(answered, mount_px=float("nan"))
    fits = [unseen, answered, unseen, answered, unseen, out, unseen, unseen]
    assert [bool(fit.refused) for fit in without_moved(fits)] == [False] * 4 + [True] * 4
    assert not any(fit.refused for fit in without_moved([unseen] * 3))


def test_little_of_it_in_view_is_enough(frames, oriented):
    """100 px of it, as a camera that sees no more than a corner."""
    column = oriented.body.lines.origin_px[:, 0]
    corner = (column > 520.0) & (column < 620.0)
    assert oriented.body.moved_px(KeptPicture(frames[1]), corner) == 0.0
    elsewhere = KeptPicture(moved(frames[1], (0.0, -6.0)))
    assert oriented.body.moved_px(elsewhere, corner) == pytest.approx(6.0, abs=0.7)

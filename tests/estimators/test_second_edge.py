"""Two pictures mixed into one: seen by a second edge that is the first one turned, and by nothing else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.camera import read_film, without_mixed
from estimators.edge import LIKE_DOUBLED, no_horizon, second_edge
from estimators.frame_residuals import edge_residuals
from estimators.frame_solution import refused_fit
from estimators.virtual_camera import DEFLECTION, RADIUS
from flightmodel.checks import NO_FAULT, Issue
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film
from tests.estimators.test_other_film import answers
from tests.estimators.test_spoilt_film import CONTRADICTS


@pytest.fixture(scope="module")
def frames():
    return film(5, [0.0, 1.0, 3.6, 3.0, 2.0, 1.5], [0.0, 188.0, 160.0, 170.0, 200.0, 150.0])


@pytest.fixture(scope="module")
def oriented(frames):
    return orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)


def mixed(one, other, share):
    return np.asarray(cv2.addWeighted(one, 1.0 - share, other, share, 0.0), dtype=np.uint8)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_two_pictures_in_one_are_no_frame(frames, oriented, share):
    fit = oriented.fit(mixed(frames[1], frames[2], share))
    assert fit.refused.code in CONTRADICTS | {"picture-doubled"}


def test_a_mixed_picture_of_plain_cloth_is_no_frame():
    """Of the edge alone, which takes one of the two; earlier in the film, where the shell stood otherwise."""
    plain = GEOMETRY.model_copy(update={"features": "none"})
    frames = film(6, [0.0, 1.0, 3.6], [0.0, 188.0, 160.0])
    oriented = orient_camera(frames[0], plain, MOUNT, JOINT_M)
    assert [oriented.fit(mixed(frames[1], frames[2], s)).refused.code for s in (0.3, 0.7)] == ["picture-doubled"] * 2
    assert not oriented.fit(frames[1]).refused
    assert not oriented.fit(frames[2]).refused


def test_one_picture_has_one_edge(frames, oriented):
    """Its own noise doubled too: a frame mixed with itself, and with one a tenth of a pixel beside it."""
    for k in range(1, 6):
        assert not oriented.fit(frames[k]).refused
    beside = cv2.warpAffine(frames[1], np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0]]), frames[1].shape[::-1])
    assert not oriented.fit(mixed(frames[1], beside, 0.5)).refused


def test_a_line_as_far_from_the_edge_everywhere_is_none(frames, oriented):
    """A seam of the outer torus, a reflection along it: brighter from 9 px inside the edge on."""
    fit = oriented.fit(frames[1])
    deformation = np.array([*fit.rotation_yz_rad, 0.0])
    rows = edge_residuals(oriented.view, fit.horizon, deformation).rows
    by_turn, by_radius = rows[:, DEFLECTION], rows[:, RADIUS]
    inside = np.zeros(frames[1].shape, dtype=np.uint8)
    cv2.fillPoly(inside, [np.rint(fit.horizon.points_px + 9.0 * fit.horizon.inward_px).astype(np.int32)], 1)
    lit = np.minimum(frames[1].astype(float) * (1.0 + 0.4 * inside), 255.0).astype(np.uint8)
    assert second_edge(lit, fit.horizon, by_turn, by_radius) == (0.0, NO_FAULT)
    # turned instead, it is one
    offset = by_turn @ np.deg2rad([1.2, -0.9])
    turned = fit.horizon.points_px + offset[:, None] * fit.horizon.inward_px
    inside[:] = 0
    cv2.fillPoly(inside, [np.rint(turned).astype(np.int32)], 1)
    lit = np.minimum(frames[1].astype(float) * (1.0 + 0.4 * inside) + 25.0 * inside, 255.0).astype(np.uint8)
    assert second_edge(lit, fit.horizon, by_turn, by_radius)[1]


def test_a_film_of_mixed_pictures_is_no_film(frames):
    times = np.array([421.0, 430.0, 431.0, 432.0, 433.0])
    pictures = [frames[0], mixed(frames[1], frames[2], 0.4), mixed(frames[5], frames[3], 0.4), frames[4], frames[3]]
    read = read_film(times, pictures, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None)
    codes = [fit.refused.code if fit.refused else "" for fit in read.fits]
    assert codes.count("picture-doubled") == 2
    assert set(codes) == {"picture-doubled", "film-mixed"}


def test_one_doubled_frame_of_a_long_film_is_its_own_fault():
    fits = answers(np.linspace(1.0, 2.0, 60))
    doubled = refused_fit(no_horizon(Issue("no", "picture-doubled")), Issue("no", "picture-doubled"))
    assert sum(bool(f.refused) for f in without_mixed([doubled, *fits])) == 1
    assert sum(bool(f.refused) for f in without_mixed([doubled] * 2 + fits)) == 2
    assert sum(bool(f.refused) for f in without_mixed([doubled] * 5 + fits)) == 5
    assert all(f.refused for f in without_mixed([doubled] * 12 + fits))


def test_frames_that_may_be_doubled_speak_against_a_film_together():
    """A weak second edge, of which half of the points stand out of the scatter, is in more than one frame of it."""
    fits = answers(np.linspace(1.0, 2.0, 12))
    weak = [replace(fit, doubled=0.45) for fit in fits[:2]]
    assert not any(f.refused for f in without_mixed([weak[0], *fits[1:]]))
    assert {f.refused.code for f in without_mixed([*weak, *fits[2:]])} == {"film-mixed"}


def test_a_weak_second_edge_is_stated_by_its_share(frames, oriented):
    """An eighth of another picture: too little to refuse the frame for, and more than one picture ever shows."""
    fit = oriented.fit(mixed(frames[4], frames[5], 0.12))
    assert not fit.refused
    assert fit.doubled > LIKE_DOUBLED
    assert oriented.fit(frames[4]).doubled == oriented.fit(frames[5]).doubled == 0.0

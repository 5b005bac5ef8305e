"""What an analyst decides by eye: masks, marks, frames accepted and rejected; against films whose truth is known."""

import cv2
import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.camera import JointSwing, read_film
from estimators.frame_edits import MARK_SD_PX, EditedFrame, edited
from estimators.frame_solution import AprioriSd
from estimators.texture import surface_seen
from estimators.virtual_camera import deformation_of
from flightmodel.camera_edits import CameraEdits, Edit
from flightmodel.checks import GateError
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, film

TIMES = np.array([421.0, 440.0, 441.0])
THETA, PLANE = (0.0, 3.6, 2.2), (0.0, 175.0, 200.0)
EXACT = AprioriSd(benchmark_rad=1e-6)


@pytest.fixture(scope="module")
def frames():
    return film(31, THETA, PLANE)


def bare(features="none"):
    return GEOMETRY.model_copy(update={"features": features})


def rows_of(kind, t_s, points, name=""):
    return [Edit("camera5", t_s, kind, name, float(u), float(v)) for u, v in points]


def read(frames, edits, geometry=GEOMETRY, **more):
    return read_film(TIMES, frames, geometry, MOUNT, JOINT_M, plane_lv_rad=None, edits=edits, **more)


def error_of(fit, k):
    return fit.rotation_yz_rad - deformation_of(D(THETA[k]), D(PLANE[k]))[:2]


def test_without_edits_nothing_changes(frames):
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    plain, edited_ = oriented.fit(frames[1]), oriented.fit(EditedFrame(frames[1]))
    np.testing.assert_array_equal(plain.rotation_yz_rad, edited_.rotation_yz_rad)
    np.testing.assert_array_equal(plain.covariance, edited_.covariance)


def test_a_masked_disturbance_does_not_count(frames):
    """Part of the shell as it was in the benchmark frame, pasted over: a shadow that stays where it is."""
    oriented = orient_camera(frames[0], bare("texture"), MOUNT, JOINT_M, EXACT)
    clean = oriented.fit(frames[1])
    corners = np.array([[60.0, 330.0], [420.0, 330.0], [420.0, 479.0], [60.0, 479.0]])
    spoiled = frames[1].copy()
    spoiled[330:480, 60:421] = frames[0][330:480, 60:421]
    mask = CameraEdits(tuple(rows_of("mask", 440.0, corners, "shadow")))
    masked = oriented.fit(edited(spoiled, mask, 440.0))
    assert masked.features < clean.features
    sd = np.sqrt(np.diag(masked.covariance))
    assert (np.abs(error_of(masked, 1)) < 3.0 * sd).all()
    # nothing found in it
    lines = oriented.view.lines_at(oriented.clocks_rad, deformation_of(D(3.6), D(175.0)))
    frame = edited(spoiled, mask, 440.0)
    found = frame.near_edge(lines).points_px
    inside = cv2.pointPolygonTest
    assert all(inside(corners.astype(np.float32), (float(u), float(v)), False) < 0 for u, v in found)
    # a mask of another frame is none of this one's
    assert edited(spoiled, mask, 441.0).hidden is None
    assert edited(spoiled, CameraEdits(tuple(rows_of("mask", np.nan, corners, "a"))), 441.0).hidden is not None


def test_an_edge_marked_by_hand_answers_where_none_can_be_found(frames):
    oriented = orient_camera(frames[0], bare(), MOUNT, JOINT_M, EXACT)
    # glare: sky and shell of one grey near the edge
    glare = np.full_like(frames[1], 180)
    assert oriented.fit(glare).refused
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        edge = oriented.view.edge(deformation_of(D(THETA[1]), D(PLANE[1]))).pixels
        seen = edge[oriented.view.camera.is_inside(edge, 8.0)]
        marks = seen[np.linspace(0, len(seen) - 1, 14).astype(int)] + MARK_SD_PX * rng.standard_normal((14, 2))
        frame = edited(glare, CameraEdits(tuple(rows_of("rim", 440.0, marks))), 440.0)
        fit = oriented.fit(frame)
        assert not fit.refused
        assert np.sqrt(np.diag(fit.covariance)).max() < D(0.6)
        errors.append(float(error_of(fit, 1) @ np.linalg.solve(fit.covariance, error_of(fit, 1))))
    # twelve components: chi-square of 0.1 % each side
    assert 2.2 < np.sum(errors) < 32.9


def test_marked_features_measure_what_the_edge_alone_does_not(frames):
    view = orient_camera(frames[0], bare(), MOUNT, JOINT_M, EXACT).view
    pixels = np.array([[250.0, 330.0], [360.0, 300.0], [470.0, 330.0], [300.0, 390.0], [420.0, 390.0]])
    names = [f"spot {k}" for k in range(len(pixels))]
    points = surface_seen(view, pixels).points_shell_m
    moved = view.sight(points, deformation_of(D(THETA[1]), D(PLANE[1]))).pixels
    rng = np.random.default_rng(4)
    moved = moved + 0.7 * rng.standard_normal(moved.shape)
    rows = []
    for name, first, second in zip(names, pixels, moved, strict=True):
        rows += rows_of("feature", 421.0, [first], name) + rows_of("feature", 440.0, [second], name)
    edits = CameraEdits(tuple(rows))
    plain, marked = (read(frames, e, bare(), apriori=EXACT) for e in (CameraEdits(), edits))
    assert marked.fits[1].features == 2 * len(names)
    assert marked.fits[2].features == 0
    assert np.trace(marked.fits[1].covariance) < 0.98 * np.trace(plain.fits[1].covariance)
    fit = marked.fits[1]
    assert float(error_of(fit, 1) @ np.linalg.solve(fit.covariance, error_of(fit, 1))) < 13.8
    # behind the rim there is no shell to mark
    off = CameraEdits(tuple(rows_of("feature", 421.0, [(360.0, 5.0)], "sky")))
    with pytest.raises(GateError) as refusal:
        read(frames, off, bare())
    assert refusal.value.codes == ("edit-unusable",)


def test_frames_are_rejected_and_accepted_by_hand(frames):
    rejected = CameraEdits((Edit("camera5", 440.0, "reject", note="a bird"),))
    fits = read(frames, rejected).fits
    assert fits[1].refused.code == "rejected-by-hand"
    assert "a bird" in fits[1].refused
    assert not fits[2].refused
    assert "by hand: reject 1" in read(frames, rejected).history().assumptions
    # ten frames that stand still about one that jumps
    times = 430.0 + 0.1 * np.arange(11)
    pictures = [frames[0]] + [frames[2].copy() for _ in range(10)]
    for k, picture in enumerate(pictures[1:]):
        picture[0, k] += 1  # no frozen picture
    pictures[5] = frames[1]
    swing = JointSwing(0.05, 0.01)

    def codes(*rows):
        film_ = read_film(times, pictures, GEOMETRY, MOUNT, JOINT_M, 430.0, None, joint_swing=swing,
                          edits=CameraEdits(rows))  # fmt: skip
        return [fit.refused.code for fit in film_.fits]

    assert codes()[5] == "jump-too-fast"
    assert not codes(Edit("camera5", 430.5, "accept"))[5]
    # the later word counts
    assert codes(Edit("camera5", 430.5, "accept"), Edit("camera5", 430.5, "reject"))[5] == "rejected-by-hand"


def test_a_pose_by_hand_orients_a_camera_that_the_mount_puts_elsewhere():
    """Off by half of the a priori sd, so that the fit finds its way either way: the same camera, the same answer."""
    pictures = film(7, THETA[:2], PLANE[:2])
    right = orient_camera(pictures[0], GEOMETRY, MOUNT, JOINT_M)
    off = np.array([0.0, 0.0, D(1.5), 1.02])
    moved = orient_camera(pictures[0], GEOMETRY, MOUNT, JOINT_M, pose=off)
    np.testing.assert_allclose(moved.view.camera.focal_px, right.view.camera.focal_px, rtol=3e-3)
    # the corrections are counted from there
    assert moved.corrections[2] - right.corrections[2] == pytest.approx(-D(1.5), abs=D(0.3))
    answers = [camera.fit(pictures[1]).rotation_yz_rad for camera in (right, moved)]
    np.testing.assert_allclose(answers[0], answers[1], atol=D(0.05))

"""Noise that two frames share, where one was mixed into the other, and only there."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from estimators.benchmark import orient_camera
from estimators.camera import read_film
from estimators.frame_edits import EditedFrame
from estimators.surface_noise import FROM_PX, TO_PX, SurfaceNoise, mixed_with
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film

DEFLECTION_DEG = [0.0, 1.0, 3.0, 0.5, 2.5, 4.0, 1.5, 3.5]


@pytest.fixture(scope="module")
def frames():
    return film(7, DEFLECTION_DEG, [0.0, 188.0, 160.0, 170.0, 200.0, 150.0, 180.0, 165.0])


@pytest.fixture(scope="module")
def oriented(frames):
    return orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)


def independent(count, seed=3):
    """Noise of frames whose edges are 5 px apart from frame to frame, by turns in and out."""
    rng = np.random.default_rng(seed)
    return [
        SurfaceNoise(
            np.clip(np.rint(40.0 * rng.standard_normal((240, 50))), -120, 120).astype(np.int8),
            np.full(240, 5.0 * (k % 2)),
        )
        for k in range(count)
    ]


def blend(one, other, share):
    levels = (1.0 - share) * one.levels.astype(float) + share * other.levels
    return replace(one, levels=np.rint(levels).astype(np.int8))


@pytest.mark.parametrize("share", [0.12, 0.5, 0.88])
def test_a_mixed_frame_correlates_as_its_shares_say(share):
    noises = independent(12)
    noises[7] = blend(noises[7], noises[4], share)
    ((k, (j, correlation)),) = mixed_with(noises).items()
    assert (k, j) == (7, 4)
    # of a frame that is mixed with one that is not
    assert correlation == pytest.approx(share / np.hypot(share, 1.0 - share), abs=0.05)


def test_independent_noise_is_not_shared():
    for seed in range(20):
        assert not mixed_with(independent(20, seed))
    assert not mixed_with([])
    assert not mixed_with([None, *independent(1)])


def test_noise_is_compared_where_the_shell_has_moved():
    """A codec copies what stands still, and a fine mark is noise that stays."""
    noises = independent(12)
    noises[7] = blend(noises[7], noises[4], 0.5)
    assert not mixed_with([replace(noise, edge_px=np.zeros(240)) for noise in noises])
    # where the edge lies inside the pixels that are looked at, they show what is behind the shell
    assert not mixed_with([replace(noise, edge_px=noise.edge_px + FROM_PX) for noise in noises])
    # and frames without an answer have no place
    assert mixed_with([*noises[:5], None, *noises[5:]]).keys() == {8}
    assert not mixed_with([None if k == 4 else noise for k, noise in enumerate(noises)])
    # nor is a picture mixed with one of long ago
    assert not mixed_with([*noises[:5], *[None] * 20, *noises[5:]])


def test_a_sensors_own_pattern_is_no_mixture():
    pattern = independent(1, seed=9)[0]
    noises = [blend(noise, pattern, 0.25) for noise in independent(12)]
    assert not mixed_with(noises)
    noises[7] = blend(noises[7], noises[4], 0.5)
    assert mixed_with(noises).keys() == {7}


def test_a_film_is_mixed_throughout_where_all_frames_so_far_apart_share_a_little():
    """Nearly all of a picture is the frame's three before: too little for a pair alone, and all of them say so."""
    noises = independent(12)
    late = [blend(noises[k - 3], noise, 0.05) if k >= 3 else noise for k, noise in enumerate(noises)]
    found = mixed_with(late)
    assert {k: j for k, (j, _) in found.items()} == {k: k - 3 for k in range(6, 12)}
    assert np.median([share for _, share in found.values()]) == pytest.approx(0.05, abs=0.02)
    # in one such picture the shell lies where it lay in the frame before: nothing has moved between the two
    assert not mixed_with([*noises[:7], late[7], *noises[8:]])


def test_noise_is_the_second_difference_of_what_can_be_seen(frames, oriented):
    places, image = oriented.noise_places, frames[1].copy()
    fit = oriented.fit(image)
    lines = oriented.view.lines_at(oriented.clocks_rad, np.zeros(3))
    at = lines.origin_px[:, None] + np.arange(FROM_PX, TO_PX)[:, None] * lines.inward_px[:, None]
    u, v = np.moveaxis(np.rint(at).astype(int), 2, 0)
    grey, mask = image.astype(float), np.array([1.0, -2.0, 1.0])
    shell = places.is_shell
    assert 0.5 < shell.mean() <= 1.0
    u, v = u[shell], v[shell]
    parts = [mask[a] * mask[b] * grey[v + a - 1, u + b - 1] for a in range(3) for b in range(3)]
    second, found = np.sum(parts, axis=0), fit.noise.levels[shell].astype(float)
    some = found != 0.0
    assert some.mean() > 0.7
    scale = np.median(second[some] / found[some])
    np.testing.assert_allclose(found[some], second[some] / scale, atol=1.0 + 0.03 * 120.0)
    # the edge of a deflected shell lies elsewhere by what the deflection moves it
    residual = oriented.view.mismatch(fit.horizon, oriented.view.edge(np.zeros(3)))[0]
    moved = np.interp(fit.horizon.line, lines.index, fit.noise.edge_px)
    assert np.nanmedian(np.abs(moved - residual)) < 0.5
    assert np.nanmedian(np.abs(residual)) > 2.0
    # not where it is hidden, dark or clipped
    image[v[:200], u[:200]] = np.where(np.arange(200) % 2, 255, 0)
    hidden = np.zeros(image.shape, dtype=bool)
    hidden[v[200:400], u[200:400]] = True
    spoilt = places.noise(EditedFrame(image, hidden), fit.rotation_yz_rad).levels[shell]
    assert not spoilt[:400].any()


def read(frames):
    times = 421.0 + np.arange(len(frames))
    return read_film(times, frames, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None).fits


def mixed(one, other, share):
    return np.asarray(cv2.addWeighted(one, 1.0 - share, other, share, 0.0), dtype=np.uint8)


def test_a_film_of_means_is_refused(frames):
    """Mostly of a frame before: no second edge stands out, and the answers would be of another time."""
    assert not any(fit.refused for fit in read(frames))
    later = [mixed(frame, frames[max(k - 2, 0)], 0.86) for k, frame in enumerate(frames)]
    codes = [getattr(fit.refused, "code", "") for fit in read(later)]
    assert all(codes)
    assert "film-mixed" in codes


def test_a_part_held_over_refuses_its_frame(frames):
    """A third of the picture that is the frame's before, and moved by too little for anything else to be seen."""
    held = [frame.copy() for frame in frames]
    held[5][:, :250] = frames[4][:, :250]
    fits = read(held)
    assert [k for k, fit in enumerate(fits) if fit.refused] == [5]

"""Search of a frame for features from afar: spots of a flat picture, which parameters shift and stretch."""

import cv2
import numpy as np

from estimators.features import fit_feature_map

SIZE = (240, 320)
SPOTS = np.random.default_rng(2).uniform([40.0, 40.0], [280.0, 200.0], (40, 2))
SIGNS = np.where(np.arange(40) % 3 == 0, -1.0, 1.0)
TRUE = np.array([9.0, -6.0, 0.03])
SD = np.array([8.0, 8.0, 0.03])


def placed(drawn):
    """Pixels (m, 40, 2) of the spots for two shifts, px, and a stretch about the first pixel (m, 3); one is unseen."""
    out = SPOTS * (1.0 + drawn[:, None, 2:]) + drawn[:, None, :2]
    out[:, 7] = np.nan
    return out


def picture(signs, noise=2.0):
    image = 120.0 + noise * np.random.default_rng(5).standard_normal(SIZE)
    for (u, v), sign in zip(np.delete(placed(TRUE[None])[0], 7, axis=0), np.delete(signs, 7), strict=True):
        cv2.circle(image, (round(u), round(v)), 2, 120.0 - 40.0 * sign, -1)
    return np.clip(image, 0.0, 255.0).astype(np.uint8)


def test_the_map_finds_dark_and_pale_spots_from_afar():
    found = fit_feature_map(picture(SIGNS), placed, [np.zeros(3)], SD, SIGNS)
    assert found is not None
    assert (np.abs(found - TRUE) < [0.7, 0.7, 0.005]).all()


def test_of_several_starts_the_one_near_the_spots_counts():
    far = np.array([60.0, 40.0, 0.0])
    found = fit_feature_map(picture(SIGNS), placed, [far, np.zeros(3)], SD, SIGNS)
    assert (np.abs(found - TRUE) < [0.7, 0.7, 0.005]).all()


def test_nothing_is_found_in_a_picture_without_spots():
    assert fit_feature_map(np.full(SIZE, 120, dtype=np.uint8), placed, [np.zeros(3)], SD, SIGNS) is None

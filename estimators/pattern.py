"""Where does the pattern of marks fit a frame, when it may be anywhere within degrees?

A search over parameters (the camera's pose, or the bending) that needs no edge: behind the rim may be the Earth, whose
limb and clouds are edges too, while seams and dots are nowhere but on the shell. The frame is turned into a picture of
how much darker each pixel is than its surroundings (black hat), blurred; the score of a hypothesis is the mean of that
picture at the projected marks. The maximum is found by the cross-entropy method, from wide to narrow and from a coarse
blur to a fine one: draws from a normal distribution, which then moves to the best of them.

Sources: R. Y. Rubinstein, D. P. Kroese, "The Cross-Entropy Method", 2004.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import FloatArray

Image = NDArray[np.uint8]
Pixels = Callable[[FloatArray], FloatArray]
"""From parameters ``(k,)`` to the marks' pixels ``(n, 2)``, NaN outside the lens's field."""

HAT_PX = 17
BLURS_PX = (9.0, 9.0, 6.0, 4.0, 3.0, 2.0, 2.0)
DRAWS, ELITE = 240, 16
NARROWEST, FARTHEST_SD = 0.02, 2.5
DARKEST = 30.0
LEAST_RISE, OTHERS = 3.0, 60


def fitted_pattern(image: Image, pixels: Pixels, starts: list[FloatArray], sd: FloatArray) -> FloatArray | None:
    """Parameters ``(k,)`` at which the marks fit a frame best; None where no place stands out.

    Parameters
    ----------
    image : (h, w) uint8
    pixels : callable
    starts : list of (k,) float
        Where to look, each the mean of a normal distribution; the best of all is taken.
    sd : (k,) float
    """
    hat = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (HAT_PX, HAT_PX))
    smooth = cv2.GaussianBlur(image, (0, 0), 1.2)
    dark = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, hat).astype(np.float32)
    # a mark is a mark, however strong: deep shadows between tori must not outweigh it
    dark = np.minimum(dark, DARKEST)
    scores = [cv2.GaussianBlur(dark, (0, 0), blur) for blur in BLURS_PX]
    rng = np.random.default_rng(0)
    found = []
    for start in starts:
        centre, spread = start.copy(), sd.copy()
        for score in scores:
            drawn = centre + spread * rng.standard_normal((DRAWS, len(sd)))
            drawn[0] = centre
            # not beyond what is held possible, where all marks may come together on one dark spot
            drawn = np.clip(drawn, start - FARTHEST_SD * sd, start + FARTHEST_SD * sd)
            values = np.array([_score(score, pixels(p)) for p in drawn])
            best = drawn[np.argsort(-values)[:ELITE]]
            centre, spread = best.mean(axis=0), np.maximum(best.std(axis=0), NARROWEST * sd)
        found.append((_score(scores[-1], pixels(centre)), centre))
    highest, where = max(found, key=lambda pair: pair[0])
    others = [_score(scores[-1], pixels(p)) for p in starts[0] + sd * rng.standard_normal((OTHERS, len(sd)))]
    usual = float(np.median(others))
    scatter = 1.4826 * float(np.median(np.abs(np.array(others) - usual)))
    return where if highest - usual > LEAST_RISE * scatter else None


def _score(picture: NDArray[np.float32], pixels: FloatArray) -> float:
    """Mean of a picture at pixels; those outside it count as its mean."""
    h, w = picture.shape
    at = np.nan_to_num(pixels, nan=-1.0)
    u, v = np.rint(at).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    total = float(picture[v[inside], u[inside]].sum()) + float(picture.mean()) * int((~inside).sum())
    return total / len(at)

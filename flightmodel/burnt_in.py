"""Where is text burnt into a film: a time code, a title?

What is written over a picture stays where it is and as bright as it is, whatever the vehicle and its light do. Taken
for paint, it would say that the shell did not move. Over frames spread along the film a pixel of it

- keeps its grey level: in four of five frames it lies within `_STEADY` of the median, and
- stands out: the median's slope is `_SHARP` at least.

Digits that change do neither: a group of steady pixels as tall as a line of text is widened along its row by
`_BESIDE_HEIGHTS` of its height to both sides. Other groups are what is fixed to the camera, and left out as they are.

Assumed: the picture moves, or its light changes. Where most of what stands out is steady, nothing is taken for text.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import BoolArray

_STEADY = 6  # grey levels: noise, and compression at a stroke's edge
# grey levels a pixel: of fourteen films without text at most 65 pixels stand out so and are steady, with text 1200
_SHARP = 20.0
_LEAST_PX = 100  # steady pixels of a group: a word of strokes
_JOINED_PX = 9  # between strokes and letters of a line
_TALLEST = 0.15  # of the picture's height: a line of text
_BESIDE_HEIGHTS = 4.0
_MOST_STEADY = 0.8  # of what stands out in a frame
_LEAST_FRAMES = 5


def burnt_in(pictures: Sequence[NDArray[np.uint8]]) -> BoolArray | None:
    """Pixels (h, w) of text, and of what else is fixed in the picture; None where none is found.

    Parameters
    ----------
    pictures : sequence of (h, w) uint8
        Spread over the film; only those of the most common size count.
    """
    sizes = [p.shape for p in pictures if p.ndim == 2 and p.size]
    film = np.stack([p for p in pictures if p.shape == max(set(sizes), key=sizes.count)]) if sizes else np.zeros(0)
    if len(film) < _LEAST_FRAMES:
        return None
    middle = np.sort(film, axis=0)[len(film) // 2]
    steady = _slope(middle) > _SHARP
    off = np.abs(film[:, steady].astype(np.int16) - middle[steady])
    steady[steady] = np.sort(off, axis=0)[(4 * len(film)) // 5 - 1] <= _STEADY
    if steady.sum() > _MOST_STEADY * np.sum(_slope(film[len(film) // 2]) > _SHARP):
        return None
    out = _groups(steady)
    return out if out.any() else None


def _slope(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Size of the slope (h, w), grey levels a pixel."""
    across, down = (cv2.Sobel(picture, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(across, down))


def _groups(steady: BoolArray) -> BoolArray:
    """Steady pixels (h, w) near each other, with what lies between them, and lines of text with what may follow."""
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _JOINED_PX + 1,) * 2)
    near = cv2.dilate(steady.astype(np.uint8), brush)
    count, label, boxes, _ = cv2.connectedComponentsWithStats(near)
    out = np.zeros_like(steady)
    for number in range(1, count):
        group = label == number
        if np.sum(steady & group) < _LEAST_PX:
            continue
        left, top, wide, tall, _ = boxes[number]
        out |= group
        if tall - 2 * _JOINED_PX < _TALLEST * len(steady) and wide > tall:
            reach = int(_BESIDE_HEIGHTS * (tall - 2 * _JOINED_PX))
            out[top : top + tall, max(left - reach, 0) : left + wide + reach] = True
    return out

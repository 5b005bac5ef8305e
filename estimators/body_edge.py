"""Did the camera move in its mount since the benchmark frame? The centerbody's own edge in the picture shows it.

The camera sits on the centerbody, whose silhouette lies in every picture where it lies in the benchmark frame, whatever
the shell does; a turn, a zoom or a picture that was moved shifts it. Across its expected place the first lasting step
is sought from the body outwards, darker or brighter: the body is plain. Where the silhouette does not stand out, as
before a shell in shadow, nothing is said.

A camera that turns about a point near the edge, or moves along it, leaves many points within a pixel: then it counts
how many more lie where one shift and turn of the picture puts them.

The body's own shadow beside its edge may pass for the edge, in the benchmark frame in all other frames. A camera that
moved moves the picture of the shell too: where that does not follow, nothing has moved (`MountMotion.of_points`).

Assumed: without features, the shadow leaves a part of the edge alone. Of 707 frames of 66 sound films one keeps less
than a tenth of its points; of a camera that moved hardly any stay. A shift and turn alone are not sure of one frame:
light and shadow that shift a part of the edge may look like one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from estimators.edge import STEP_PX, KeptPicture, ScanLines, is_coherent, sampled
from estimators.virtual_camera import VirtualCamera, meets_centerbody
from flightmodel._kernels import inlined, kernel
from flightmodel.checks import BoolArray, FloatArray

_EVERY_PX = 2  # along the silhouette, of which a camera may see no more than a corner
_REACH_PX = 24.0  # of a camera of which an inch of height over the skin is not known
_LEVEL = 12  # samples of the plain body
_HALF = 4  # samples on either side of a step
_LEAST_STEP, _OF_SCATTER = 8.0, 4.0  # grey levels; of the body's own scatter
_LEAST_POINTS, _LEAST_SHARE = 30, 0.25  # of the lines in view
_SMOOTHER = 0.6  # its points may lie so much farther from their neighbours than the shell's edge's
_SAME_PX, _LEAST_SAME = 0.7, 0.1  # of the points seen in both frames: a tilt by 7 px about one of them leaves so many
# of the points: so many more on a moved edge than on an unmoved one, and at most so many of these; light that shifts a
# part of the edge, as in a clean film of another renderer, leaves 0.4 where they are and as many more together
_MORE_MOVED, _MOST_SAME = 0.3, 0.3
_TOWARDS_PX = (8.0, 5.6, 4.0, 2.8, 2.0, 1.4, 1.0, 0.7, 0.7, 0.7)  # scale of the weights, from a third of the reach down


@dataclass(frozen=True)
class MountMotion:
    """How the centerbody's edge has moved in the picture since the benchmark frame.

    Parameters
    ----------
    px : float
        How far; zero where it has not, NaN where the picture does not show it.
    is_sure : bool
        Whether that is sure of this frame by itself.
    about_px, shift_px : (2,) float
    turn_rad : float
        The motion of the picture that most of the edge follows: a shift, and a turn to the right about a point.
    """

    px: float
    is_sure: bool
    about_px: FloatArray = field(default_factory=lambda: np.zeros(2))
    shift_px: FloatArray = field(default_factory=lambda: np.zeros(2))
    turn_rad: float = 0.0

    def of_points(self, places_px: FloatArray, across: FloatArray) -> FloatArray:
        """By how much (n,) it moves points (n, 2) of the picture along unit vectors (n, 2)."""
        u, v = (places_px - self.about_px).T
        return np.asarray(across @ self.shift_px + self.turn_rad * (across[:, 1] * u - across[:, 0] * v))


UNMOVED, UNSEEN = MountMotion(0.0, True), MountMotion(float("nan"), False)


@dataclass(frozen=True)
class BodyEdge:
    """The centerbody's silhouette in the benchmark frame.

    Parameters
    ----------
    lines : ScanLines
        From the body outwards.
    place_px : (n,) float
        Where the edge lies on each; NaN where none is found.
    """

    lines: ScanLines
    place_px: FloatArray

    def moved(self, picture: KeptPicture, clear: BoolArray) -> MountMotion:
        """Motion of the edge since the benchmark frame. ``clear`` (n,): unobstructed lines."""
        moved = _places(picture, self.lines) - self.place_px
        seen = clear & np.isfinite(moved)
        moved = moved[seen]
        if len(moved) < _LEAST_POINTS:
            return UNSEEN
        same = np.count_nonzero(np.abs(moved) < _SAME_PX) / len(moved)
        if same >= _MOST_SAME:
            return UNMOVED
        places, out = self.lines.origin_px[seen], self.lines.inward_px[seen]
        followed = _followed(places, out, moved)
        if same < _LEAST_SAME:
            return replace(followed, px=float(np.median(np.abs(moved))), is_sure=True)
        together = followed.of_points(places, out)
        if np.mean(np.abs(moved - together) < _SAME_PX) > same + _MORE_MOVED:
            return replace(followed, px=float(np.abs(together).max()))
        return UNMOVED


def body_edge(view: VirtualCamera, picture: KeptPicture) -> BodyEdge | None:
    """Silhouette of the centerbody in a benchmark frame; None where too little of it is seen."""
    lines = _lines(view)
    if lines is None:
        return None
    place = _places(picture, lines)
    found = int(np.isfinite(place).sum())
    return BodyEdge(lines, place) if found >= max(_LEAST_POINTS, _LEAST_SHARE * len(place)) else None


def _lines(view: VirtualCamera) -> ScanLines | None:
    """Lines across the silhouette, where the virtual camera sees it; None where it does not."""
    width, height = view.camera.size_px
    v, u = np.mgrid[:height, :width]
    rays = view.camera.rays_body(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    there = np.isfinite(rays).all(axis=1)
    body = np.zeros(len(rays), dtype=np.uint8)
    body[there] = meets_centerbody(view, rays[there])
    shade = body.reshape(height, width)
    contours = cv2.findContours(shade, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if not contours:
        return None
    x, y = max(contours, key=len)[:, 0].T
    kept = np.flatnonzero((np.minimum(x, y) >= _EVERY_PX) & (x < width - _EVERY_PX) & (y < height - _EVERY_PX))
    if len(kept) < _EVERY_PX * _LEAST_POINTS:
        return None
    # in order along the silhouette, from where the picture's border cuts it
    gap = np.diff(kept, append=kept[0] + len(x))
    kept = np.roll(kept, -int(np.argmax(gap)) - 1)[::_EVERY_PX]
    soft, (u, v) = cv2.GaussianBlur(shade.astype(float), (0, 0), 3.0), (x[kept], y[kept])
    out = np.column_stack([soft[v, u - 1] - soft[v, u + 1], soft[v - 1, u] - soft[v + 1, u]])
    out /= np.maximum(np.linalg.norm(out, axis=1), 1e-12)[:, None]
    return ScanLines(np.column_stack([u, v]).astype(float), out, _REACH_PX, _REACH_PX, np.arange(len(kept)))


@inlined
def _scatter(grey, begin, plain, last):
    """Standard deviation of ``plain`` samples from ``begin`` on; beyond the end the last sample is repeated."""
    mean, square = 0.0, 0.0
    for j in range(plain):
        mean += grey[min(begin + j, last - 1)]
    mean /= plain
    for j in range(plain):
        square += (grey[min(begin + j, last - 1)] - mean) ** 2
    return math.sqrt(square / plain)


@inlined
def _steepest(grey, inside, hit, half, slope):
    """Place of the steepest slope of the largest step near the first one, by a parabola through three slopes."""
    count, most, largest = len(grey), hit, 0.0
    for j in range(hit, min(hit + 2 * half, count - half - 1) + 1):
        size = abs(grey[j + half] - grey[j - half])
        if inside[j] and size > largest:
            most, largest = j, size
    for j in range(max(most - half - 1, 0), min(most + half + 2, count)):
        low, high = max(j - 1, 0), min(j + 1, count - 1)
        slope[j] = abs(grey[high] - grey[low]) / (high - low)
    at = max(most - half, 0)
    for j in range(at, min(most + half + 1, count)):
        if slope[j] > slope[at]:
            at = j
    at = min(max(at, 1), count - 2)
    before, here, after = slope[at - 1], slope[at], slope[at + 1]
    bend = min(before - 2.0 * here + after, -1e-9)
    return at + min(max(0.5 * (before - after) / bend, -1.0), 1.0)


@kernel
def first_lasting_steps(grey, inside, limits, place):
    """Sample (n,) at which the first step from a plain beginning is steepest, on lines (n, m) as sampled; else NaN.

    ``limits``: samples of the plain beginning, on either side of a step; least step, and least over the beginning's
    scatter.
    """
    plain, half, least, of_scatter = limits
    n, m = grey.shape
    slope = np.empty(m)
    for i in range(n):
        place[i] = np.nan
        begin = 0
        while begin < m and not inside[i, begin]:
            begin += 1
        held = min(begin + plain, m)
        enough = max(least, of_scatter * max(_scatter(grey[i], begin, plain, held), 1.0))
        for j in range(begin + half, m - half):
            if inside[i, j] and abs(grey[i, j + half] - grey[i, j - half]) > enough:
                place[i] = _steepest(grey[i], inside[i], j, half, slope)
                break


def _places(picture: KeptPicture, lines: ScanLines) -> FloatArray:
    """Where the edge lies on each line (n,), px from its origin; NaN where there is none, or none beside it."""
    grey, inside = sampled(picture, lines, round(2.0 * _REACH_PX / STEP_PX) + 1)
    at = np.empty(len(lines.index))
    first_lasting_steps(grey, inside, (_LEVEL, _HALF, _LEAST_STEP, _OF_SCATTER), at)
    place = STEP_PX * at - _REACH_PX
    place[~is_coherent(lines.index, _SMOOTHER * place)] = np.nan
    return place


def _followed(places_px: FloatArray, out: FloatArray, moved_px: FloatArray) -> MountMotion:
    """Shift and turn of the picture that most points (n, 2), moved by (n,) along ``out`` (n, 2), follow.

    Geman and McClure's weights, their scale narrowed step by step, so that the start does not matter.
    """
    about = places_px.mean(axis=0)
    u, v = (places_px - about).T
    arm = out[:, 1] * u - out[:, 0] * v
    longest = max(float(np.abs(arm).max()), 1.0)
    by = np.column_stack([out, arm / longest])
    motion: FloatArray = np.zeros(3)
    for scale in _TOWARDS_PX:
        weight = 1.0 / (1.0 + ((moved_px - by @ motion) / scale) ** 2)
        motion = np.asarray(np.linalg.lstsq(by * weight[:, None], moved_px * weight, rcond=None)[0], dtype=float)
    return replace(UNSEEN, about_px=about, shift_px=motion[:2], turn_rad=float(motion[2]) / longest)

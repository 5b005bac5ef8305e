"""Where in a frame does the shell end and the sky begin?

The edge is searched along scan lines that cross its expected place, from the sky inwards. On each line the sky's level
and scatter come from its outer end; the first rise above them that lasts is the edge. Its place is first where the
smoothed grey level crosses half way to the shell's level just inside, then refined by the blurred edge that fits best,

    grey(x) = sky + c Phi(z) + d (z Phi(z) + phi(z)),     z = (x - x_edge) / blur,

a step with a ramp behind it, since the shell darkens or brightens towards its limb; the place is sought on a grid, the
step and the ramp by least squares. With ``n`` the noise left after smoothing, the standard deviation is ``2.4 n`` over
the slope at the crossing, floored at 0.05 px.

Where the edge is expected within a few pixels (`steps_near`), what lies behind it may be bright and uneven: the Earth.
The standard deviation then follows from the curvature of the sum of squares over the places, and from what step and
ramp leave unexplained on neighbouring lines beyond the noise: a small step before clouds, or before a shade on the
shell, has a large one. The blur (lens and smoothing together) is assumed; a wrong one by a tenth still moves the edge
by about 0.1 px, for `estimators.frame_solution.AprioriSd` to allow for.

Assumed of the search from far: the sky is darker than the shell's rim; the Sun is out of view. A frame in which this
does not hold is refused, with the reason. Readable twin of the kernels: ``tests/oracles/plain_horizon.py``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import ndtr

from flightmodel._kernels import inlined, kernel
from flightmodel.checks import NO_FAULT, BoolArray, FloatArray, Issue

Image = NDArray[np.uint8]

STEP_PX = 0.5  # two samples a pixel: the smoothing below passes nothing shorter
_SMOOTHING_PX = 0.8  # white noise falls to a third, an edge is not blurred beyond what its lens does
WHOLE_BLUR_PX = 1.27  # sd of the step that is fitted: of the smoothing, and 1 px of lens and pixel
EDGE_HALF = 7  # samples on either side of a fitted step: 2.8 of its sd
_NEAR_PX = 8.0  # sky and shell on either side, for the step's levels; as far as a prediction may be off
_LEAST_CONTRAST = 8.0  # grey levels: three times the noise of a film
_LEAST_SHARE = 0.4  # assumed, of the lines: this edge only starts a fit, which tests it
_SD_FLOOR_PX = 0.05  # assumed: cloth and lens are modelled no better
# samples that err together: of noise, by the smoothing; of a sky and a shell that are no step and ramp, found in 14,000
# points of scenes with and without the Earth behind the rim, the same within a quarter for errors of 0.06 to 1.5 px
_NOISE_TOGETHER = 2.0 * float(np.sqrt(np.pi)) * _SMOOTHING_PX / STEP_PX
_MODEL_TOGETHER = 70.0
_NEIGHBOURS, _COHERENT_PX = 4, 0.7  # on either side; an edge's own scatter is a few tenths of a pixel
# rows of two moments: blocks as tall as an edge's blur a few times over and 8 samples wide; of noise alone the ratio of
# the two differences scatters by a twelfth about one
_BLOCK_PX, _BLOCK_STEP_PX = (16, 32), 4
_COMBED, _OF_NOISE = 1.5, 4.0
_MOST_COMBED = 0.015  # 0.3 % is the most in 408 sound frames; fields a second apart have 21 % (median of 374)
# breaks across a picture, grey levels over twice the rows beside: in 408 sound frames 2.4 at the most, if rolled 6
_BREAK_MOST, _BREAK_BESIDE, _BREAK_OVER = 16, 5, 3.5
_SMOOTHING = cv2.getGaussianKernel(7, _SMOOTHING_PX, cv2.CV_32F)
_LEAST_POINTS = 30  # for a mean profile across the edge
_MORE_PX = 20  # smoothed beyond what is asked for: the next search lies beside the first
_ACROSS_PX = 2.0  # on either side of an edge's middle: more of the shell has shades of its own


@dataclass(frozen=True)
class ScanLines:
    """Straight searches across the expected edge.

    Parameters
    ----------
    origin_px : (n, 2) float
        Expected edge, px.
    inward_px : (n, 2) float
        Unit vectors from the sky to the shell.
    outer_px, inner_px : float
        How far each line reaches to the sky and into the shell, px.
    index : (n,) int
        Which place of the shell's edge each line crosses; the same number is the same place in every frame.
    """

    origin_px: FloatArray
    inward_px: FloatArray
    outer_px: float
    inner_px: float
    index: NDArray[np.intp]


@dataclass(frozen=True)
class HorizonLine:
    """The shell's edge in one frame.

    Parameters
    ----------
    points_px : (n, 2) float
        Edge points, px, pixel centres at integers.
    inward_px : (n, 2) float
        Unit vectors from sky to shell, along which the points were located.
    sd_px : (n,) float
        Standard deviation of each point along ``inward_px``.
    line : (n,) int
        Index of the scan line that each point was found on (`ScanLines.index`).
    refused : Issue
        Why the frame cannot be used, with its code; empty when it can.
    is_by_hand : bool
        Whether an analyst marked the points.
    """

    points_px: FloatArray
    inward_px: FloatArray
    sd_px: FloatArray
    line: NDArray[np.intp]
    refused: Issue = NO_FAULT
    is_by_hand: bool = False

    def some(self, chosen: BoolArray) -> HorizonLine:
        """Chosen points."""
        return replace(
            self,
            points_px=self.points_px[chosen],
            inward_px=self.inward_px[chosen],
            sd_px=self.sd_px[chosen],
            line=self.line[chosen],
        )

    @property
    def is_usable(self) -> bool:
        """Whether the frame holds an edge to work with."""
        return not self.refused

    @property
    def lowest_row_px(self) -> float:
        """Smallest row the edge reaches (the seed paper's horizontal line), from a parabola around the apex."""
        if len(self.points_px) < 5:
            return float("nan")
        u, v = self.points_px.T
        near = np.abs(u - u[np.argmin(v)]) < 80.0
        centre = u[near].mean()
        c2, c1, c0 = np.polyfit(u[near] - centre, v[near], 2)
        return float(c0 - c1**2 / (4.0 * c2)) if c2 > 1e-6 else float(v.min())


def no_horizon(reason: Issue) -> HorizonLine:
    """No edge points, and why."""
    return HorizonLine(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.intp), reason)


def fault_of_frame(picture: Image | KeptPicture, size_px: tuple[int, int]) -> Issue:
    """Why a frame cannot be used, before any edge is searched: size, darkness, saturation; empty when it can."""
    kept = kept_picture(picture)
    image = kept.image
    if image.size == 0:
        return Issue("cannot be decoded", "frame-undecodable")
    if image.ndim != 2 or image.dtype != np.uint8:
        return Issue(f"not an 8-bit grey image (shape {image.shape}, {image.dtype})", "frame-size")
    if image.shape != (size_px[1], size_px[0]):
        size = f"size {image.shape[1]} x {image.shape[0]} where the camera has {size_px[0]} x {size_px[1]}"
        return Issue(size, "frame-size")
    # of a part of the pixels: as good, and quicker
    below = np.cumsum(np.bincount(image[::8, ::4].ravel(), minlength=256))
    low, high = np.searchsorted(below, [0.05 * below[-1], 0.95 * below[-1]], side="right").tolist()
    saturated = float(np.mean(image[::4, ::4] >= 254))
    if high < 2.0 * _LEAST_CONTRAST:
        return Issue(f"too dark: 95 % of the pixels are no brighter than grey level {high} of 255", "frame-exposure")
    if low > 250 or saturated > 0.5:
        return Issue("saturated: more than half of the pixels are at full scale", "frame-exposure")
    return _fault_of_fields(*kept.differences[:2])


def _fault_of_fields(one: FloatArray, two: FloatArray) -> Issue:
    """Check for interlacing: if fields have two times, adjacent rows differ more than every other row.

    In a picture of one moment the difference grows with the distance of the rows, and noise is in both alike. Fields
    whose edges lie less than a pixel or two apart pass: their mean is the edge at the mean of their times.
    """
    differ = (one > _COMBED * two) & (one > _LEAST_CONTRAST**2)
    if np.count_nonzero(differ) <= _MOST_COMBED * one.size:
        return NO_FAULT
    combed = int(np.sum(differ & (one > _OF_NOISE * np.median(one) + _LEAST_CONTRAST**2)))
    if combed > _MOST_COMBED * one.size:
        words = (
            f"its rows in turns are of two moments, in {100.0 * combed / one.size:.0f} % of the picture: deinterlace it"
        )
        return Issue(words, "frame-fields-differ")
    return NO_FAULT


def breaks_across(image: Image | KeptPicture) -> NDArray[np.intp]:
    """Rows after which the picture breaks across most of its width: a border, or where a rolled picture begins anew.

    The shell's edges are curved: no row has a large share of one.
    """
    steps = kept_picture(image).differences[2]
    beside = median_filter(steps, 2 * _BREAK_BESIDE + 1, mode="mirror")
    return np.flatnonzero(steps > 2.0 * beside + _BREAK_OVER)


def find_horizon(image: Image | KeptPicture, lines: ScanLines, size_px: tuple[int, int]) -> HorizonLine:
    """Find the shell's upper edge.

    Parameters
    ----------
    image : (h, w) uint8, or `KeptPicture`
    lines : ScanLines
        Where to search.
    size_px : (2,) int
        Width and height the camera should deliver.

    Returns
    -------
    HorizonLine
        Refused with a reason when the frame is black, saturated, of another size, or fewer than 40 % of the lines
        cross a clear edge.
    """
    image = kept_picture(image)
    fault = fault_of_frame(image, size_px)
    if fault:
        return no_horizon(fault)
    place, sd, good = _lasting_rises(image, lines)
    refused = NO_FAULT
    if good.mean() < _LEAST_SHARE:
        share = f"{100.0 * good.mean():.0f} % of the scan lines cross one ({100 * _LEAST_SHARE:.0f} % needed)"
        refused = Issue(f"no clear edge: {share}", "edge-not-clear")
    points = lines.origin_px + place[:, None] * lines.inward_px
    return HorizonLine(
        points[good], lines.inward_px[good], np.hypot(sd[good], _SD_FLOOR_PX), lines.index[good], refused
    )


@inlined
def _select(values, count, rank):
    """Move the value of a rank to its place among the first values, smaller ones before it (C. A. R. Hoare)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[rank], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < rank:
            low = i
        if rank < i:
            high = j


@inlined
def median(values, count):
    """Median of the first values, whose order changes."""
    half = count // 2
    _select(values, count, half)
    if count % 2:
        return values[half]
    below = values[0]
    for i in range(1, half):
        below = max(below, values[i])
    return 0.5 * (below + values[half])


@kernel
def sky_levels(grey, inside, span, level, scatter, first):
    """Level and one difference over ``span / 2`` samples of each line's outer end, and where that end begins."""
    n, m = grey.shape
    few = np.empty(span)
    for i in range(n):
        k = 0
        while k < m and not inside[i, k]:
            k += 1
        first[i] = 0 if k == m else k
        for j in range(span):
            few[j] = grey[i, min(first[i] + j, m - 1)]
        scatter[i] = abs(few[span // 2] - few[0])
        level[i] = median(few, span)


@kernel
def first_rises(grey, inside, level, first, noise, common, limits, step, places, bases, place, sd, good):
    """Place along each line, its sd, and whether there is a lasting rise.

    ``limits``: span of the sky, samples a rise must last, least contrast.
    """
    n, m = grey.shape
    span, lasting, contrast = limits
    half_bases = bases.shape[2] // 2
    few = np.empty(8)
    explained = np.empty(len(places))
    for i in range(n):
        good[i] = False
        threshold = level[i] + max(6.0 * noise, 0.75 * contrast)
        rise, run = -1, 0
        for k in range(m):
            if inside[i, k] and grey[i, k] > threshold:
                run += 1
                if run == lasting:
                    rise = k - lasting + 1
                    break
            else:
                run = 0
        if rise <= first[i] + span or rise >= m - int(8.0 / step) or level[i] >= common + contrast:
            continue
        # the shell's level is read just inside the edge: first of the rise, then of the crossing so found
        inner, crossing, shell, half = rise + int(1.5 / step), -1, 0.0, 0.0
        for _ in range(2):
            count = int(3.5 / step) - int(2.0 / step)
            for j in range(count):
                few[j] = grey[i, min(inner + int(2.0 / step) + j, m - 1)]
            shell = median(few, count)
            half = 0.5 * (level[i] + shell)
            crossing = -1
            for k in range(max(rise - int(3.0 / step), 0), min(rise + int(5.0 / step), m)):
                if grey[i, k] > half:
                    crossing = k
                    break
            inner = max(crossing, 0)
        if crossing <= max(rise - int(3.0 / step), 0) or shell - level[i] <= contrast:
            continue
        slope = max(grey[i, crossing] - grey[i, crossing - 1], 1e-3)
        for b in range(len(places)):
            step_share, ramp_share = 0.0, 0.0
            for k in range(bases.shape[2]):
                value = grey[i, min(max(crossing + k - half_bases, 0), m - 1)] - level[i]
                step_share += value * bases[b, 0, k]
                ramp_share += value * bases[b, 1, k]
            explained[b] = step_share * step_share + ramp_share * ramp_share
        best = min(max(int(np.argmax(explained)), 1), len(places) - 2)
        curve = max(2.0 * explained[best] - explained[best - 1] - explained[best + 1], 1e-9)
        shift = min(max(0.5 * (explained[best + 1] - explained[best - 1]) / curve, -1.0), 1.0)
        place[i] = crossing + (places[best] + (places[1] - places[0]) * shift) / step
        # fitting a ramp beside the step doubles the noise of a crossing: 2.4, found by repeating one scene
        sd[i] = 2.4 * noise * step / slope
        good[i] = True


def _lasting_rises(image: Image | KeptPicture, lines: ScanLines) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Place along each line, px inwards from its origin, its sd without floor, whether there is one."""
    n = len(lines.origin_px)
    grey, inside = sampled(image, lines, round((lines.outer_px + lines.inner_px) / STEP_PX))
    level, scatter, first = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    span = int(6.0 / STEP_PX)
    sky_levels(grey, inside, span, level, scatter, first)
    noise = max(float(np.median(scatter)) / (0.6745 * np.sqrt(2.0)), 0.3)
    place, sd, good = np.zeros(n), np.full(n, np.inf), np.zeros(n, dtype=np.bool_)
    limits = (span, int(3.0 / STEP_PX), _LEAST_CONTRAST)
    first_rises(
        grey, inside, level, first, noise, float(np.median(level)), limits, STEP_PX, EDGE_PLACES, EDGE_BASES,
        place, sd, good,
    )  # fmt: skip
    return STEP_PX * place - lines.outer_px, sd, good


@kernel
def fit_steps(grey, inside, noise, contrast, places, bases, place, along, left, good):
    """Place of the step, up or down, on short lines across an expected edge.

    ``along``: its sd per unit sd of independent samples; ``left`` (n, m): grey levels less step and ramp.
    """
    n, m = grey.shape
    level_of = 6
    few, value, explained = np.empty(level_of), np.empty(m), np.empty(len(places))
    for i in range(n):
        good[i] = False
        whole = True
        for k in range(m):
            whole = whole and inside[i, k]
        if not whole:
            continue
        for k in range(level_of):
            few[k] = grey[i, k]
        level = median(few, level_of)
        total = 0.0
        for k in range(m):
            value[k] = grey[i, k] - level
            total += value[k] ** 2
        for b in range(len(places)):
            step_share, ramp_share = 0.0, 0.0
            for k in range(m):
                step_share += value[k] * bases[b, 0, k]
                ramp_share += value[k] * bases[b, 1, k]
            explained[b] = step_share * step_share + ramp_share * ramp_share
        best = int(np.argmax(explained))
        if best == 0 or best == len(places) - 1:
            continue
        curve = max(2.0 * explained[best] - explained[best - 1] - explained[best + 1], 1e-9)
        shift = min(max(0.5 * (explained[best + 1] - explained[best - 1]) / curve, -1.0), 1.0)
        # the first row of a basis is the step's: its share over the shell's length is the step
        behind, count = 0.0, 0
        for k in range(m):
            if bases[best, 0, k] > 0.5 * bases[best, 0, m - 1]:
                behind += value[k]
                count += 1
        height = abs(behind / max(count, 1))
        residual_rms = math.sqrt(max(total - explained[best], 0.0) / m)
        if height > contrast and residual_rms < 2.0 * noise + 0.15 * height:
            step_share, ramp_share = 0.0, 0.0
            for k in range(m):
                step_share += value[k] * bases[best, 0, k]
                ramp_share += value[k] * bases[best, 1, k]
            place[i] = places[best] + (places[1] - places[0]) * shift
            along[i] = (places[1] - places[0]) * math.sqrt(2.0 / curve)
            for k in range(m):
                left[i, k] = value[k] - step_share * bases[best, 0, k] - ramp_share * bases[best, 1, k]
            good[i] = True


@inlined
def square_of_model(left, good, noise, beside, square):
    """Mean square (n,) of the residuals of step and ramp (n, m), averaged over ``beside`` lines on either side.

    Beyond noise; lines that are not good count nothing.
    """
    n, m = left.shape
    total, count = np.zeros(m), 0
    for i in range(-beside, n):
        after, before = i + beside, i - beside - 1
        if after < n and good[after]:
            count += 1
            for k in range(m):
                total[k] += left[after, k]
        if before >= 0 and good[before]:
            count -= 1
            for k in range(m):
                total[k] -= left[before, k]
        if i >= 0:
            per, mean = 1.0 / max(count, 1), 0.0
            for k in range(m):
                mean += (total[k] * per) ** 2
            square[i] = max(mean / m - noise * noise * per, 0.0)


@kernel
def good_steps(lines, steps, noise, weights, beside, floor, found):
    """Move points (n, 2), directions, sd and indices of lines with good steps to the front; returns their number.

    ``lines``: origins, directions, indices. ``steps``: as of `fit_steps`. ``weights``: samples that err together, of
    noise and of what step and ramp leave; see `square_of_model`.
    """
    origin, inward, index = lines
    place, along, left, good = steps
    points, across, sd, line = found
    square, count = np.empty(len(left)), 0
    square_of_model(left, good, noise, beside, square)
    for i in range(len(left)):
        if good[i]:
            for c in range(2):
                points[count, c] = origin[i, c] + place[i] * inward[i, c]
                across[count, c] = inward[i, c]
            variance = along[i] * along[i] * (weights[0] * noise * noise + weights[1] * square[i])
            sd[count], line[count] = math.sqrt(variance + floor * floor), index[i]
            count += 1
    return count


def steps_near(image: Image | KeptPicture, lines: ScanLines) -> HorizonLine:
    """Find the edge within a few pixels of its prediction, darker or brighter than its background.

    Parameters
    ----------
    image : (h, w) uint8, or `KeptPicture`
    lines : ScanLines
        With origins where the edge is expected; their lengths are not used.
    """
    n = len(lines.origin_px)
    if not n:
        return no_horizon(NO_FAULT)
    near = ScanLines(lines.origin_px, lines.inward_px, _NEAR_PX, _NEAR_PX, lines.index)
    grey, inside = sampled(image, near, len(NEAR_ALONG))
    # the noise, from samples so far apart that smoothing did not correlate them
    spread = float(np.median(np.abs(grey[:, 6] - grey[:, 0])))
    noise = max(spread / (0.6745 * np.sqrt(2.0)), 0.3)
    steps = np.empty(n), np.empty(n), np.empty_like(grey), np.empty(n, dtype=np.bool_)
    fit_steps(grey, inside, noise, _LEAST_CONTRAST, NEAR_PLACES, NEAR_BASES, *steps)
    # clouds and shades are on neighbouring lines alike, noise differs
    points, across, sd, line = np.empty((n, 2)), np.empty((n, 2)), np.empty(n), np.empty(n, dtype=np.intp)
    count = good_steps(
        (near.origin_px, near.inward_px, near.index), steps, noise, (_NOISE_TOGETHER, _MODEL_TOGETHER), _NEIGHBOURS,
        _SD_FLOOR_PX, (points, across, sd, line),
    )  # fmt: skip
    return HorizonLine(points[:count], across[:count], sd[:count], line[:count])


@kernel
def mark_coherent(line, residual, beside, within, found):
    """Mask of residuals (n,) supported by more than ``beside`` neighbours, itself included, within ``within`` px.

    ``line`` (n,): places, increasing.
    """
    n = len(line)
    for i in range(n):
        alike = 0
        for j in range(max(i - beside, 0), min(i + beside + 1, n)):
            alike += abs(line[j] - line[i]) <= beside and abs(residual[j] - residual[i]) < within
        found[i] = alike > beside


def is_coherent(line: NDArray[np.intp], residual_px: FloatArray) -> BoolArray:
    """Whether edge points (n,) lie where their neighbours on the edge do: steps in clouds behind the rim do not.

    Parameters
    ----------
    line : (n,) int
        Places of the edge, increasing.
    residual_px : (n,) float
        Against any smooth curve near the edge; NaN is not coherent.
    """
    found = np.empty(len(line), dtype=np.bool_)
    mark_coherent(line, residual_px, _NEIGHBOURS, _COHERENT_PX, found)
    return found


class KeptPicture:
    """A picture with cached results for repeated use: row differences and smoothed grey levels.

    Parameters
    ----------
    image : (h, w) uint8
    """

    def __init__(self, image: Image) -> None:
        self.image = image
        self._span = (0, 0, 0, 0)
        self._kept: NDArray[np.float32] = np.zeros((0, 0), dtype=np.float32)

    @cached_property
    def differences(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean square difference of rows next to each other, and of every other row, in blocks; steps of rows (h - 1,).

        A step is the mean difference of a row from the next, at most `_BREAK_MOST` a pixel.
        """
        few = self.image[:, ::_BLOCK_STEP_PX].astype(np.int32)
        steps = np.minimum(np.abs(np.diff(few, axis=0)), _BREAK_MOST).mean(axis=1)
        (tall, wide), (h, w) = _BLOCK_PX, self.image.shape
        down, across, each = (h - 2) // tall, w // wide, wide // _BLOCK_STEP_PX
        first = few[: down * tall, : across * each]
        squares = ((first - few[rows : rows + down * tall, : across * each]) ** 2 for rows in (1, 2))
        # of integers a sum by rows, then along them, is three times as quick as a mean over both axes
        by_rows = (square.reshape(down, tall, -1).sum(axis=1) for square in squares)
        one, two = (rows.reshape(down, across, each).sum(axis=2) / (tall * each) for rows in by_rows)
        return one, two, steps

    def band(self, span: tuple[int, int, int, int]) -> tuple[NDArray[np.float32], tuple[float, float]]:
        """Smoothed levels from the pixel ``span[:2]`` up to ``span[2:]``, or of more, and which pixel comes first."""
        left, top, right, bottom = self._span
        if span[0] < left or span[1] < top or span[2] > right or span[3] > bottom:
            h, w = self.image.shape
            left, top = max(span[0] - _MORE_PX, 0), max(span[1] - _MORE_PX, 0)
            right, bottom = min(span[2] + _MORE_PX, w), min(span[3] + _MORE_PX, h)
            self._span = (left, top, right, bottom)
            band = self.image[top:bottom, left:right]
            self._kept = np.asarray(cv2.sepFilter2D(band, cv2.CV_32F, _SMOOTHING, _SMOOTHING))
        return self._kept, (float(left), float(top))


def kept_picture(image: Image | KeptPicture) -> KeptPicture:
    """Return a picture with its cached results."""
    return image if isinstance(image, KeptPicture) else KeptPicture(image)


@inlined
def grey_inside(image, u, v):
    """Grey level between pixels, bilinear, of a place that lies in the picture."""
    j, i = int(u), int(v)
    a, b = u - j, v - i
    upper = (1.0 - a) * image[i, j] + a * image[i, j + 1]
    return (1.0 - b) * upper + b * ((1.0 - a) * image[i + 1, j] + a * image[i + 1, j + 1])


@inlined
def _grey_at(image, u, v):
    """Grey level between pixels, bilinear; the border's beyond the picture."""
    h, w = image.shape
    return grey_inside(image, min(max(u, 0.0), w - 1.000001), min(max(v, 0.0), h - 1.000001))


@inlined
def _band_along(origin, inward, outer, inner, size):
    """As `band_of_lines`, along one axis."""
    low, high = np.inf, -np.inf
    for i in range(len(origin)):
        a, b = origin[i] - outer * inward[i], origin[i] + inner * inward[i]
        low, high = min(low, a, b), max(high, a, b)
    first = min(max(math.floor(low) - 4, 0), size - 4)
    return first, min(max(math.ceil(high) + 5, first + 4), size)


@kernel
def band_of_lines(origin, inward, outer, inner, size):
    """First and one beyond the last pixel, across and down, of what lines in a picture of a size want smoothed.

    They reach so far to both sides of their origins (n, 2); beside them are the pixels between which levels lie, and
    those at a border to which levels beyond it are brought.
    """
    left, right = _band_along(origin[:, 0], inward[:, 0], outer, inner, size[0])
    top, bottom = _band_along(origin[:, 1], inward[:, 1], outer, inner, size[1])
    return left, top, right, bottom


@kernel
def sample_lines(image, origin, inward, first, step, corner, size, grey, inside):
    """Grey levels ``(n, m)`` along lines, of a piece of the picture whose upper left pixel is ``corner``."""
    n, m = grey.shape
    for i in range(n):
        for k in range(m):
            along = first + k * step
            u, v = origin[i, 0] + along * inward[i, 0], origin[i, 1] + along * inward[i, 1]
            inside[i, k] = u >= 0.0 and v >= 0.0 and u <= size[0] - 1.0 and v <= size[1] - 1.0
            grey[i, k] = _grey_at(image, u - corner[0], v - corner[1])


def sampled(image: Image | KeptPicture, lines: ScanLines, count: int) -> tuple[FloatArray, BoolArray]:
    """Smoothed grey levels ``(n, count)`` along lines, and whether they lie in the picture."""
    picture = kept_picture(image)
    h, w = picture.image.shape
    # only the band that the lines cross is smoothed
    smooth, corner = picture.band(
        band_of_lines(lines.origin_px, lines.inward_px, lines.outer_px, lines.inner_px, (w, h))
    )
    n = len(lines.origin_px)
    grey, inside = np.empty((n, count)), np.empty((n, count), dtype=np.bool_)
    sample_lines(
        smooth, lines.origin_px, lines.inward_px, -lines.outer_px, STEP_PX, corner, (float(w), float(h)), grey, inside
    )  # fmt: skip
    return grey, inside


def _edge_bases(places: FloatArray, along: FloatArray) -> FloatArray:
    """Orthonormal bases ``(places, 2, samples)`` of a blurred step and a blurred ramp for each place."""
    bases = []
    for place in places:
        z = (along - place) / WHOLE_BLUR_PX
        step = ndtr(z)
        ramp = z * step + np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
        basis = np.linalg.qr(np.column_stack([step, ramp]))[0]
        bases.append((basis * np.sign(basis[-1, 0])).T)
    return np.ascontiguousarray(bases)


EDGE_PLACES: FloatArray = np.linspace(-1.5, 1.5, 31)
EDGE_BASES = _edge_bases(EDGE_PLACES, np.linspace(-STEP_PX * EDGE_HALF, STEP_PX * EDGE_HALF, 2 * EDGE_HALF + 1))
NEAR_ALONG: FloatArray = np.linspace(-_NEAR_PX, _NEAR_PX, round(2.0 * _NEAR_PX / STEP_PX) + 1)
NEAR_PLACES: FloatArray = np.linspace(-4.75, 4.75, 39)
NEAR_BASES = _edge_bases(NEAR_PLACES, NEAR_ALONG)


def steepness_of(image: Image | KeptPicture, horizon: HorizonLine) -> float:
    """How sharp is the edge: the grey levels' rise over its middle pixel, as a share of that over 4 px.

    Of all points together, so that noise has little part in it: a third of a sharp step after the smoothing, a quarter
    of one that is wider than what is looked at. NaN of too few points.

    Parameters
    ----------
    image : (h, w) uint8, or `KeptPicture`
    horizon : HorizonLine
    """
    if len(horizon.points_px) < _LEAST_POINTS:
        return float("nan")
    lines = ScanLines(horizon.points_px, horizon.inward_px, _ACROSS_PX, _ACROSS_PX, horizon.line)
    grey, inside = sampled(image, lines, round(2.0 * _ACROSS_PX / STEP_PX) + 1)
    levels = grey[inside.all(axis=1)]
    if len(levels) < _LEAST_POINTS:
        return float("nan")
    whole = levels[:, -1] - levels[:, 0]
    middle, half = levels.shape[1] // 2, round(0.5 / STEP_PX)
    return float(np.sign(whole) @ (levels[:, middle + half] - levels[:, middle - half]) / np.abs(whole).sum())

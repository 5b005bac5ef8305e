"""Was a picture of a film, or a part of it, mixed with a frame before?

The noise of two exposures is independent, whatever they show. Where a picture is a mean of two frames, or holds a part
of an earlier one, it has that one's noise, at the same pixels. Of the pixels inside the shell's edge, ``x`` the second
difference along both axes of the picture, which passes noise and hardly any shade,

    C = sum x_j x_k / sqrt(sum x_j^2 sum x_k^2) = w (1 - w) / (w^2 + (1 - w)^2)

for frames ``k`` that are ``w`` parts frame ``j``, and near zero for others. What is painted on the shell moves with it,
and so does what a codec copies from frame to frame: only lines across the edge count along which the shell has moved
between the two frames. Noise that is the same in all frames, a sensor's fixed pattern, is in the quarter of the film's
pairs that correlate least, which is subtracted.

Assumed: a mixed picture's shell moved by more than `MOVED_PX`; one that moved less leaves an error below that. Pixels
without noise, dark or saturated, say nothing.

References
----------
J. Immerkaer, "Fast noise variance estimation", 1996, for the second difference. J. Lukas, J. Fridrich, M. Goljan,
"Digital camera identification from sensor pattern noise", 2006, for the correlation and its fixed pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.edge import ScanLines
from estimators.frame_edits import EditedFrame
from estimators.texture import surface_seen
from estimators.virtual_camera import VirtualCamera
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.statistics import NORMAL_MAD

FROM_PX, TO_PX = 10, 60  # inside the benchmark frame's edge: as far as a torus or two
MOVED_PX = 2.0  # a fine mark and its copies are then elsewhere: by H.264, quality 18 to 38, no correlation is left
_EVERY_PX = 5  # at which it is asked what a pixel shows
_BESIDE_PX = 3  # what lies outside the edge by the blur of the lens and more is not the shell
_BACK = 16  # frames: what a decoder of H.264 may keep
_WITHIN, _LEVELS = 3.0, 40  # scatters, beyond which it is a mark; steps of a scatter
_LEAST_LINES = 40  # 2,000 pixels, by which a correlation scatters by 0.03
# of 2,500 pairs of frames of 51 sound films, uncompressed, by JPEG and by H.264, 3.2 sd are the most; of 40 films mixed
# by a tenth or more 5 to 15 sd, and correlations of 0.1 to 0.7
_LEAST_SHARED, _LEAST_SD = 0.08, 5.0
# of all pairs so far apart in a film: 2.2 to 3.2 sd at the most in 70 sound films; 6 to 10 sd, and correlations of 0.05
# to 0.08, in films of which a picture is for nine tenths the one before
_LEAST_THROUGHOUT = 0.03
_DARK, _BRIGHT = 2, 251  # grey levels: clipped
_SECOND = np.array([1.0, -2.0, 1.0])


@dataclass(frozen=True)
class SurfaceNoise:
    """Noise of a frame inside the shell's edge.

    Parameters
    ----------
    levels : (n, m) int8
        Along lines across the benchmark frame's edge, in fortieths of the scatter; zero where there is none to be seen.
    edge_px : (n,) float
        How far the edge lies inwards of the benchmark frame's.
    """

    levels: NDArray[np.int8] = field(repr=False)
    edge_px: FloatArray


@dataclass(frozen=True)
class NoisePlaces:
    """Pixels inside the benchmark frame's edge: columns and rows of the part of the picture that holds them.

    ``at`` (n, m): number of each in that part without its border; ``is_shell`` (n, m); ``by_turn`` (n, 2): of the edge.
    """

    columns: slice
    rows: slice
    at: NDArray[np.intp]
    is_shell: BoolArray
    by_turn: FloatArray

    def noise(self, frame: EditedFrame, rotation_yz_rad: FloatArray) -> SurfaceNoise:
        """Noise of a frame whose deflection was found."""
        part = frame.image[self.rows, self.columns]
        second = cv2.sepFilter2D(part, cv2.CV_16S, _SECOND, _SECOND)[1:-1, 1:-1].ravel().take(self.at)
        grey = part[1:-1, 1:-1].ravel().take(self.at)
        seen = self.is_shell & (grey > _DARK) & (grey < _BRIGHT)
        if frame.hidden is not None:
            seen &= ~frame.hidden[self.rows, self.columns][1:-1, 1:-1].ravel().take(self.at)
        size = np.abs(second)
        # a difference of whole grey levels: of a smooth picture, as a codec leaves it, most are zero
        scatter = max(NORMAL_MAD * float(np.median(size[::4])), 1.0)
        seen &= size < _WITHIN * scatter
        levels = (second * (seen * np.float32(_LEVELS / scatter))).astype(np.int8)
        return SurfaceNoise(levels, self.by_turn @ rotation_yz_rad)


def noise_places(view: VirtualCamera, lines: ScanLines, by_turn: FloatArray) -> NoisePlaces | None:
    """Where the noise is looked at; None where the picture shows too little of the shell.

    Parameters
    ----------
    view : VirtualCamera
    lines : ScanLines
        Across the undeflected shell's edge, ``n`` in all.
    by_turn : (n, 2) float
        Derivatives of the edge's place along them by a deflection, px/rad; NaN where there is none.
    """
    width, height = view.camera.size_px
    at = lines.origin_px[:, None] + np.arange(FROM_PX, TO_PX)[None, :, None] * lines.inward_px[:, None]
    column, row = np.moveaxis(np.rint(at).astype(np.intp), 2, 0)
    known = np.tile(np.isfinite(by_turn.sum(axis=1)), (TO_PX - FROM_PX, 1)).T
    inside: BoolArray = np.asarray(known & (column > 0) & (row > 0) & (column < width - 1) & (row < height - 1))
    # a torus is tens of pixels wide
    some = np.zeros_like(inside)
    some[:, ::_EVERY_PX] = inside[:, ::_EVERY_PX]
    shell = np.zeros_like(inside)
    shell[some] = surface_seen(view, np.column_stack([column[some], row[some]]).astype(float)).torus >= 0
    inside &= np.repeat(shell[:, ::_EVERY_PX], _EVERY_PX, axis=1)
    if np.count_nonzero(inside.any(axis=1)) < _LEAST_LINES:
        return None
    (left, top), (right, bottom) = ((f(column[inside]), f(row[inside])) for f in (np.min, np.max))
    number = np.where(inside, (row - top) * (right - left + 1) + column - left, 0)
    columns, rows = slice(int(left) - 1, int(right) + 2), slice(int(top) - 1, int(bottom) + 2)
    return NoisePlaces(columns, rows, number, inside, np.nan_to_num(by_turn))


def mixed_with(noises: Sequence[SurfaceNoise | None]) -> dict[int, tuple[int, float]]:
    """Frames that have the noise of an earlier one: which one, and their correlation beyond the film's own.

    Parameters
    ----------
    noises : sequence of SurfaceNoise or None
        Of the frames in order; None of those without an answer.
    """
    kept = [(k, noise) for k, noise in enumerate(noises) if noise is not None]
    if len(kept) < 2:
        return {}
    number, edge_px = np.array([k for k, _ in kept]), np.array([noise.edge_px for _, noise in kept])
    window = np.zeros((_BACK, *kept[0][1].levels.shape), dtype=np.float32)  # the last frames, over and over
    power, rows = np.zeros(edge_px.shape), []
    for row, (k, noise) in enumerate(kept):
        levels = noise.levels.astype(np.float32)
        power[row] = np.einsum("nm,nm->n", levels, levels)
        before = np.arange(int(np.searchsorted(number, k - _BACK)), row)
        counted = np.abs(edge_px[before] - edge_px[row]) > MOVED_PX
        counted &= np.maximum(edge_px[before], edge_px[row]) < FROM_PX - _BESIDE_PX
        counted &= (power[before] > 0.0) & (power[row] > 0.0)
        enough = np.count_nonzero(counted, axis=1) >= _LEAST_LINES
        before, counted = before[enough], counted[enough]
        shared = np.einsum("bnm,nm->bn", window[before % _BACK], levels) * counted
        size = np.sqrt(np.einsum("bn,bn->b", power[before], counted) * (counted @ power[row]))
        # of independent noise the lines' sums are of either sign
        total, square = shared.sum(axis=1), np.einsum("bn,bn->b", shared, shared)
        rows.append(np.column_stack([np.full(len(before), k), number[before], total, square, size]))
        window[row % _BACK] = levels
    return _sharing(np.concatenate(rows))


def _sharing(pairs: FloatArray) -> dict[int, tuple[int, float]]:
    """As `mixed_with`, of pairs of frames: later, earlier, and shared noise, sum of its squares and size of both."""
    if not len(pairs):
        return {}
    (later, earlier), (total, square, size) = pairs[:, :2].T.astype(int), pairs[:, 2:].T
    usual = max(float(np.quantile(total / size, 0.25)), 0.0)
    beyond = total / size - usual
    shares = (beyond > _LEAST_SHARED) & (total > _LEAST_SD * np.sqrt(square))
    # a film may be mixed throughout: too little for a pair alone, but all pairs so far apart say so
    by_lag = np.zeros((_BACK + 1, 3))
    np.add.at(by_lag, later[~shares] - earlier[~shares], np.column_stack([total - usual * size, square, size])[~shares])
    excess, squares, sizes = by_lag.T
    throughout = (excess > _LEAST_THROUGHOUT * sizes) & (excess > _LEAST_SD * np.sqrt(squares))
    shares |= throughout[later - earlier]
    found: dict[int, tuple[int, float]] = {}
    for k, j, one in zip(later[shares].tolist(), earlier[shares].tolist(), beyond[shares].tolist(), strict=True):
        if k not in found or one > found[k][1]:
            found[k] = (j, one)
    return found

"""Where in a frame does the shell end and the sky begin?

The edge is searched along scan lines that cross its expected place, from the sky inwards. On each line the sky's level
and scatter come from its outer end; the first rise above them that lasts is the edge. Its place is first where the
smoothed grey level crosses half way to the shell's level just inside, then refined by the blurred edge that fits best,

    grey(x) = sky + c Phi(z) + d (z Phi(z) + phi(z)),     z = (x - x_edge) / blur,

a step with a ramp behind it, since the shell darkens or brightens towards its limb; the place is sought on a grid, the
step and the ramp by least squares. With ``n`` the noise left after smoothing, the standard deviation is ``2.4 n`` over
the slope at the crossing, floored at 0.05 px. The blur (lens and smoothing together) is assumed; a wrong one by a tenth
and shades that are no ramp still move the edge by about 0.1 px, for `estimators.virtual_camera.HeldFixed` to allow for.

Assumed: the sky is darker than the shell's rim; the Sun is out of view. A frame in which this does not hold is not
used, and says why.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from flightmodel.checks import FloatArray

Image = NDArray[np.uint8]

STEP_PX = 0.5
SMOOTHING_PX = 0.8
WHOLE_BLUR_PX = 1.27
EDGE_HALF = 7
LEAST_CONTRAST = 8.0
LEAST_SHARE = 0.4
SD_FLOOR_PX = 0.05


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
    """

    origin_px: FloatArray
    inward_px: FloatArray
    outer_px: float
    inner_px: float


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
    refused : str
        Why the frame cannot be used; empty when it can.
    """

    points_px: FloatArray
    inward_px: FloatArray
    sd_px: FloatArray
    refused: str = ""

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


def _refuse(reason: str) -> HorizonLine:
    return HorizonLine(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), reason)


def fault_of_frame(image: Image, size_px: tuple[int, int]) -> str:
    """Say why a frame cannot be used before any edge is searched: size, darkness, saturation; empty when it can."""
    if image.ndim != 2 or image.dtype != np.uint8:
        return f"not an 8-bit grey image (shape {image.shape}, {image.dtype})"
    if image.shape != (size_px[1], size_px[0]):
        return f"size {image.shape[1]} x {image.shape[0]} where the camera has {size_px[0]} x {size_px[1]}"
    low, high = np.percentile(image[::4, ::4], [5.0, 95.0])
    if high < 2.0 * LEAST_CONTRAST:
        return f"too dark: 95 % of the pixels are below grey level {high:.0f}"
    if low > 250.0 or np.mean(image[::4, ::4] >= 254) > 0.5:
        return "saturated: more than half of the pixels are at full scale"
    return ""


def find_horizon(image: Image, lines: ScanLines, size_px: tuple[int, int]) -> HorizonLine:
    """Find the shell's upper edge.

    Parameters
    ----------
    image : (h, w) uint8
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
    fault = fault_of_frame(image, size_px)
    if fault:
        return _refuse(fault)
    along = np.arange(-lines.outer_px, lines.inner_px, STEP_PX)
    at = lines.origin_px[:, None, :] + along[:, None] * lines.inward_px[:, None, :]
    inside = (at >= 0.0).all(axis=-1) & (at[..., 0] <= size_px[0] - 1) & (at[..., 1] <= size_px[1] - 1)
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTHING_PX)
    grey = cv2.remap(smooth, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    place, sd, good = _first_rise(grey.astype(float), inside, along)
    if good.mean() < LEAST_SHARE:
        share = f"{100.0 * good.mean():.0f} % of the scan lines cross one ({100 * LEAST_SHARE:.0f} % wanted)"
        return _refuse(f"no clear edge: {share}")
    points = lines.origin_px + place[:, None] * lines.inward_px
    return HorizonLine(points[good], lines.inward_px[good], sd[good])


def _first_rise(
    grey: FloatArray, inside: NDArray[np.bool_], along: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Place, sd and validity of the first lasting rise on each line ``(n, m)``, sky first."""
    n, m = grey.shape
    rows = np.arange(n)
    first = np.argmax(inside, axis=1)
    # the sky: the first 6 px of each line that lie in the picture
    span = int(6.0 / STEP_PX)
    sky_at = np.minimum(first[:, None] + np.arange(span), m - 1)
    sky = grey[rows[:, None], sky_at]
    level = np.median(sky, axis=1)
    noise = max(float(np.median(np.abs(np.diff(sky[:, ::6], axis=1)))) / (0.6745 * np.sqrt(2.0)), 0.3)
    above = (grey > (level + max(6.0 * noise, 0.75 * LEAST_CONTRAST))[:, None]) & inside
    # it must last 3 px, so that a hot pixel or a star is no edge
    lasting = above.copy()
    for k in range(1, int(3.0 / STEP_PX)):
        lasting[:, :-k] &= above[:, k:]
    rise = np.argmax(lasting, axis=1)
    good = lasting.any(axis=1) & (rise > first + span) & (rise < m - int(8.0 / STEP_PX))
    good &= level < np.median(level) + LEAST_CONTRAST
    # the shell's level is read just inside the edge: first of the rise, then of the crossing so found
    inner = rise + int(1.5 / STEP_PX)
    for _ in range(2):
        shell_at = np.minimum(inner[:, None] + np.arange(int(2.0 / STEP_PX), int(3.5 / STEP_PX)), m - 1)
        shell = np.median(grey[rows[:, None], shell_at], axis=1)
        half = 0.5 * (level + shell)
        window = np.clip(rise[:, None] + np.arange(-int(3.0 / STEP_PX), int(5.0 / STEP_PX)), 0, m - 1)
        values = grey[rows[:, None], window]
        crossing = np.argmax(values > half[:, None], axis=1)
        inner = window[rows, crossing]
    good &= (crossing > 0) & (shell - level > LEAST_CONTRAST)
    k = np.maximum(crossing, 1)
    lower, upper = values[rows, k - 1], values[rows, k]
    slope = np.maximum(upper - lower, 1e-3)
    place = along[window[rows, k - 1]] + STEP_PX * np.clip((half - lower) / slope, 0.0, 1.0)
    # fitting a ramp beside the step doubles the noise of a crossing: 2.4, found by repeating one scene
    sd = np.hypot(2.4 * noise * STEP_PX / slope, SD_FLOOR_PX)
    near = np.clip(window[rows, k][:, None] + np.arange(-EDGE_HALF, EDGE_HALF + 1), 0, m - 1)
    place = along[window[rows, k]] + _refined(grey[rows[:, None], near] - level[:, None])
    return place, sd, good


def _refined(grey: FloatArray) -> FloatArray:
    """Offset, px, of a blurred edge from the middle of each row of samples ``(n, 2 EDGE_HALF + 1)``, sky level off.

    Every place on a grid is tried with the best step and ramp behind it; a parabola through the lowest misfits refines.
    """
    explained = np.stack([np.einsum("nk->n", (grey @ basis) ** 2) for basis in _EDGE_BASES], axis=1)
    best = np.clip(np.argmax(explained, axis=1), 1, len(_EDGE_PLACES) - 2)
    rows = np.arange(len(grey))
    left, middle, right = (explained[rows, best + k] for k in (-1, 0, 1))
    curve = np.maximum(2.0 * middle - left - right, 1e-9)
    step = _EDGE_PLACES[1] - _EDGE_PLACES[0]
    out: FloatArray = _EDGE_PLACES[best] + step * np.clip(0.5 * (right - left) / curve, -1.0, 1.0)
    return out


def _edge_bases() -> list[FloatArray]:
    """Orthonormal bases ``(2 EDGE_HALF + 1, 2)`` of a blurred step and a blurred ramp for each place of the grid."""
    x = STEP_PX * np.arange(-EDGE_HALF, EDGE_HALF + 1)
    bases = []
    for place in _EDGE_PLACES:
        z = (x - place) / WHOLE_BLUR_PX
        step = ndtr(z)
        ramp = z * step + np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
        bases.append(np.linalg.qr(np.column_stack([step, ramp]))[0])
    return bases


_EDGE_PLACES = np.arange(-1.5, 1.51, 0.1)
_EDGE_BASES = _edge_bases()

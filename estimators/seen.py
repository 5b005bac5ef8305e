"""What a frame shows against what was predicted: residuals of edge points and marks, derivatives, weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.horizon import HorizonLine
from estimators.marks import Marks
from estimators.virtual_camera import FLATTENING, VirtualCamera
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock

Image = NDArray[np.uint8]

HUBER = 2.5
NOISE_GREY = 2.5


@dataclass(frozen=True)
class Seen:
    """Edge points and marks found in one frame, ``n`` in all, against a prediction.

    Parameters
    ----------
    residual_px : (n,) float
        Found minus predicted.
    rows : (n, 16) float
        Derivatives of the prediction; see `estimators.virtual_camera`.
    shape : (n, 5) float
        Derivatives by the two ovalities, px/rad, and by the edge's shift, tilt and bow.
    sd_px : (n,) float
    index : (n,) int
        Place of the edge, or number of places plus row of `Marks`.
    """

    residual_px: FloatArray
    rows: FloatArray
    shape: FloatArray
    sd_px: FloatArray
    index: NDArray[np.intp]

    def some(self, chosen: BoolArray) -> Seen:
        """Return the chosen rows."""
        return Seen(
            self.residual_px[chosen], self.rows[chosen], self.shape[chosen], self.sd_px[chosen], self.index[chosen]
        )


def edge_seen(view: VirtualCamera, horizon: HorizonLine, bending: FloatArray) -> Seen:
    """Edge points found against the edge predicted for a bending (3,)."""
    residual, rows, clocks = view.mismatch(horizon, view.edge(bending))
    shape = np.column_stack([*_ovality(rows, clocks), light_columns(view, horizon)])
    return Seen(residual, rows, shape, horizon.sd_px, horizon.line)


def light_columns(view: VirtualCamera, horizon: HorizonLine) -> FloatArray:
    """Shift, tilt and bow of the found edge, ``(n, 3)``, one at the picture's sides."""
    width = 0.5 * view.camera.width_px
    side = (horizon.points_px[:, 0] - width) / width
    return np.column_stack([np.ones_like(side), side, 1.5 * side**2 - 0.5])


def _ovality(rows: FloatArray, clocks_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives by a flattening that goes round the shell as ``cos 2 clock`` and as ``sin 2 clock``."""
    return rows[:, FLATTENING] * np.cos(2.0 * clocks_rad), rows[:, FLATTENING] * np.sin(2.0 * clocks_rad)


def found_marks(
    view: VirtualCamera, marks: Marks, image: Image, bending: FloatArray, reach_px: int
) -> tuple[FloatArray, FloatArray]:
    """Where along its direction each mark was found, px, and its sd; infinite where it was not."""
    expected = view.sight(marks.points_shell_m, bending).pixels
    hidden = ~np.isfinite(expected[:, 0])
    expected[hidden] = -1e6
    offset, sd = marks.find(image, expected, reach_px, NOISE_GREY)
    return np.einsum("ni,ni->n", expected, marks.across_px) + offset, sd


def marks_seen(
    view: VirtualCamera, marks: Marks, found: tuple[FloatArray, FloatArray], bending: FloatArray, first_index: int
) -> Seen:
    """Marks found against those predicted for a bending (3,)."""
    place, sd = found
    has = np.flatnonzero(np.isfinite(sd))
    points, across = marks.points_shell_m[has], marks.across_px[has]
    sight = view.sight(points, bending)
    residual = place[has] - np.einsum("ni,ni->n", sight.pixels, across)
    rows = np.einsum("ni,nik->nk", across, sight.jacobian)
    shape = np.column_stack([*_ovality(rows, lv_clock(points[:, 1:])), np.zeros((len(has), 3))])
    return Seen(residual, rows, shape, sd[has], first_index + has)


def joined(first: Seen, second: Seen) -> Seen:
    """Rows of both."""
    parts = zip(*((s.residual_px, s.rows, s.shape, s.sd_px, s.index) for s in (first, second)), strict=True)
    return Seen(*(np.concatenate(pair) for pair in parts))


def huber_gain(
    seen: Seen, design: FloatArray, information: FloatArray, lines: int
) -> tuple[FloatArray, FloatArray, float]:
    """Weigh one Gauss-Newton step by Huber's rule.

    The sd of edge points and of marks are each widened where their residuals say so.

    Returns
    -------
    gain : (k, m) float
        The step is ``gain @ residual``.
    covariance : (k, k) float
        Formal, of the parameters held by ``information (k, k)``.
    rms_px : float
    """
    residual, scale = seen.residual_px, seen.sd_px.copy()
    is_edge = seen.index < lines
    for group in (is_edge, ~is_edge):
        if group.any():
            centre = np.median(residual[group])
            scale[group] *= max(1.4826 * float(np.median(np.abs(residual[group] - centre) / scale[group])), 1.0)
    weight = 1.0 / scale**2 / np.maximum(1.0, np.abs(residual) / (HUBER * scale))
    weighted = design.T * weight
    covariance: FloatArray = np.linalg.inv(weighted @ design + information).astype(float)
    return covariance @ weighted, covariance, float(np.sqrt(np.average(residual**2, weights=weight)))

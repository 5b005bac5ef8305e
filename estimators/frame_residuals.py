"""How far are edge points and features found in a frame from their predictions for a deformed shell?

Residuals are found minus predicted, with the prediction's derivatives by all that is fitted: the deformation, the
camera, the shell's lobes and the light at its edge. Lobes are a flattening that varies round the shell (with two waves
it becomes a saddle), or a growth outwards that does (with two waves its rings become oval), in proportion to the
distance from the innermost ring: the unit of both is an angle about that.

References
----------
P. J. Huber, "Robust Statistics", 1981, chapter 7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.edge import HorizonLine, median
from estimators.features import Features
from estimators.virtual_camera import FLATTENING, RADIUS, VirtualCamera
from flightmodel._kernels import inlined
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock
from flightmodel.least_squares import Linearised, huber_factor
from flightmodel.statistics import NORMAL_MAD

HUBER = 2.5  # of the scatter: 1 % of normal residuals are beyond it
WAVES, ROUND_WAVES = (2, 3, 4, 5), (2, 3)
"""Round the shell, of the modelled lobes across it and along its radius."""


@dataclass(frozen=True)
class FrameResiduals:
    """Residuals of the edge points and features found in one frame, ``n`` in all.

    Parameters
    ----------
    residual_px : (n,) float
        Found minus predicted.
    rows : (n, 16) float
        Derivatives of the prediction; see `estimators.virtual_camera`.
    shape : (n, 15) float
        Derivatives by the lobes, px/rad, and by the edge's shift, tilt and bow.
    sd_px : (n,) float
    index : (n,) int
        Place of the edge, or number of places plus row of `ImageFeatures`.
    """

    residual_px: FloatArray
    rows: FloatArray
    shape: FloatArray
    sd_px: FloatArray
    index: NDArray[np.intp]

    def some(self, chosen: BoolArray) -> FrameResiduals:
        """Chosen rows."""
        return FrameResiduals(
            self.residual_px[chosen], self.rows[chosen], self.shape[chosen], self.sd_px[chosen], self.index[chosen]
        )


@dataclass(frozen=True)
class FrameShape:
    """Deflection and shape fitted to one frame together, shapes with their a priori sd about zero.

    Parameters
    ----------
    found_rad : (15,) float
        Rotation vector about body y and z, flattening, lobes (`lobe_columns`).
    formal : (15, 15) float
        Covariance that the frame's own points leave.
    by_camera : (15, 12) float
        Error per unit error of the oriented camera's pose.
    by_benchmark : (15, 2) float
        Missing part per unit deflection of the benchmark frame.
    by_light : (15, 3) float
        Error per sd of a shift of the features with the light.
    """

    found_rad: FloatArray
    formal: FloatArray
    by_camera: FloatArray
    by_benchmark: FloatArray
    by_light: FloatArray


def edge_residuals(view: VirtualCamera, horizon: HorizonLine, deformation: FloatArray) -> FrameResiduals:
    """Residuals of edge points against the edge predicted for a deformation (3,)."""
    residual, rows, clocks = view.mismatch(horizon, view.edge(deformation))
    shape = np.column_stack(
        [lobe_columns(rows, np.full(len(rows), view.width_m), clocks), light_columns(view, horizon)]
    )
    return FrameResiduals(residual, rows, shape, horizon.sd_px, horizon.line)


def light_columns(view: VirtualCamera, horizon: HorizonLine) -> FloatArray:
    """Shift, tilt and bow of the found edge, ``(n, 3)``; one at the picture's sides, as the shell stands in it."""
    per_px, middle = view.across_picture
    side = horizon.points_px @ per_px - middle
    out = np.empty((len(side), 3))
    out[:, 0], out[:, 1], out[:, 2] = 1.0, side, 1.5 * side**2 - 0.5
    return out


def lobe_columns(rows: FloatArray, away_m: FloatArray, clocks_rad: FloatArray) -> FloatArray:
    """Derivatives (n, 12) by cosine and sine of each wave across the shell, then by those along its radius.

    ``away_m``: distance from the innermost ring.
    """
    waves, across = waves_round(clocks_rad, away_m), 2 * len(WAVES)
    return np.hstack([rows[:, [FLATTENING]] * waves[:, :across], rows[:, [RADIUS]] * waves[:, across:]])


def waves_round(clocks_rad: FloatArray, away_m: FloatArray) -> FloatArray:
    """Cosine and sine of each wave across the shell (n, 8), and times ``away_m`` of those along its radius (n, 4)."""
    across, along = (
        np.stack([wave(n * clocks_rad) for n in waves for wave in (np.cos, np.sin)], axis=1)
        for waves in (WAVES, ROUND_WAVES)
    )
    return np.hstack([across, away_m[:, None] * along])


def feature_residuals(
    view: VirtualCamera,
    features: Features,
    found: tuple[FloatArray, FloatArray],
    deformation: FloatArray,
    first_index: int,
) -> FrameResiduals:
    """Residuals of found features against those predicted for a deformation (3,)."""
    place, sd = found
    has = np.flatnonzero(np.isfinite(sd))
    points, across = features.points_shell_m[has], features.across_px[has]
    sight = view.sight(points, deformation)
    residual = place[has] - np.einsum("ni,ni->n", sight.pixels, across)
    rows = np.einsum("ni,nik->nk", across, sight.jacobian)
    shape = np.column_stack(
        [lobe_columns(rows, view.from_ring_m(points), lv_clock(points[:, 1:])), np.zeros((len(has), 3))]
    )
    return FrameResiduals(residual, rows, shape, sd[has], first_index + has)


def joined(first: FrameResiduals, second: FrameResiduals) -> FrameResiduals:
    """Rows of both."""
    parts = zip(*((s.residual_px, s.rows, s.shape, s.sd_px, s.index) for s in (first, second)), strict=True)
    return FrameResiduals(*(np.concatenate(pair) for pair in parts))


def huber_gain(
    residuals: FrameResiduals,
    design: FloatArray,
    information: FloatArray,
    lines: int,
    together: FloatArray | float = 1.0,
) -> tuple[FloatArray, FloatArray, float]:
    """Weigh one Gauss-Newton step by Huber's rule.

    The sd of edge points and of features are each inflated to the scatter of their residuals, and by the root of the
    number ``together`` that err alike.

    Returns
    -------
    gain : (k, m) float
        The step is ``gain @ residual``.
    covariance : (k, k) float
        Formal, of the parameters with the prior ``information (k, k)``.
    rms_px : float
    """
    residual, scale = residuals.residual_px, residuals.sd_px.copy()
    is_edge = residuals.index < lines
    for group in (is_edge, ~is_edge):
        if group.any():
            centre = np.median(residual[group])
            scale[group] *= max(NORMAL_MAD * float(np.median(np.abs(residual[group] - centre) / scale[group])), 1.0)
    weight, robust = 1.0 / (scale**2 * together), huber_factor(residual / scale, HUBER)
    covariance = Linearised.of(residual, design, weight, information, robust=robust).covariance
    rms_px = float(np.sqrt(np.average(residual**2, weights=weight * robust)))
    return covariance @ (design.T * (weight * robust)), covariance, rms_px


@inlined
def huber_weights(m, p, edge_sd, feature_sd, huber, residual, scaled, weight):
    """Weights, zero where a residual is NaN; the number of edge points with one."""
    edges = 0
    # each kind's sd is inflated to the scatter of its residuals; then Huber's weights
    for kind in range(2):
        start, size = (0, m) if kind == 0 else (m, p)
        sd = edge_sd if kind == 0 else feature_sd
        used = 0
        for i in range(size):
            if math.isfinite(residual[start + i]):
                scaled[used] = residual[start + i]
                used += 1
        if kind == 0:
            edges = used
        inflate = 1.0
        if used > 0:
            centre = median(scaled, used)
            used = 0
            for i in range(size):
                if math.isfinite(residual[start + i]):
                    scaled[used] = abs(residual[start + i] - centre) / sd[i]
                    used += 1
            inflate = max(NORMAL_MAD * median(scaled, used), 1.0)
        for i in range(size):
            weight[start + i] = 0.0
            if math.isfinite(residual[start + i]):
                scale = sd[i] * inflate
                weight[start + i] = 1.0 / (scale * scale) / max(1.0, abs(residual[start + i]) / (huber * scale))
    return edges


@inlined
def lower_products(columns, count, weight, first, weighted, product):
    """Lower triangle, from row ``first``, of the weighted products of the points' columns, stored as rows (q, n).

    ``weighted`` (n,): room for one. Sums along rows run in vector registers.
    """
    for a in range(first, len(columns)):
        for i in range(count):
            weighted[i] = weight[i] * columns[a, i]
        for b in range(a + 1):
            total = 0.0
            for i in range(count):
                total += weighted[i] * columns[b, i]
            product[a, b] = total

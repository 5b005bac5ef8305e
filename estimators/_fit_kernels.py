"""Compiled Gauss-Newton fit of one frame; the model is in `estimators.frame_solution`.

Readable twin: ``tests/oracles/plain_fit.py``.
"""

from __future__ import annotations

import math

import numpy as np

from estimators._edge_kernels import median
from estimators._sight_kernels import COLUMNS, feet, limb_points, project_points, rotation_of
from flightmodel._kernels import inlined, kernel, small_cholesky, small_solve

JOINT = COLUMNS - 1
LOBES = 12  # cosine and sine of lobes of two to five waves (8) and of rings out of round of two and three (4)
SHAPES = LOBES + 3  # light
_RADIUS = COLUMNS - 2
DONE, TOO_FEW, DIVERGED = 0, 1, 2


@inlined
def _project_edge(deformation, clocks, circles, ring, joint, lens, terms, points, pixels, jacobian, kept):
    """Project the limb of the deformed shell; the number of its points in the lens's field.

    They are moved to the front of ``pixels`` and ``jacobian``, their clocking angles into ``kept``.
    """
    rotation = terms[0]
    position, flat = lens[5], deformation[2]
    eye = np.empty(3)
    dx, dy, dz = position[0] + joint, position[1], position[2]
    for m in range(3):
        eye[m] = rotation[0, m] * dx + rotation[1, m] * dy + rotation[2, m] * dz
    eye[0] -= joint
    if not limb_points(circles, ring, flat, eye, clocks, points):
        return 0
    per = 1.0 / (1.0 + flat * flat)
    for i in range(len(points)):
        r = math.sqrt(points[i, 1] ** 2 + points[i, 2] ** 2)
        aft, outwards = -points[i, 0] - ring[0], r - ring[1]
        scale = (ring[1] + per * (outwards + flat * aft)) / r
        points[i, 0] = -(ring[0] + per * (aft - flat * outwards))
        points[i, 1] *= scale
        points[i, 2] *= scale
    project_points(points, terms, lens, pixels, jacobian)
    count = 0
    for i in range(len(points)):
        if math.isfinite(pixels[i, 0]):
            if count < i:
                for c in range(2):
                    pixels[count, c] = pixels[i, c]
                    for j in range(COLUMNS):
                        jacobian[count, c, j] = jacobian[i, c, j]
            kept[count] = clocks[i]
            count += 1
    return count


@inlined
def _lobe_columns(flattening, outwards, clock, shape):
    """Derivatives by a flattening, and by a growth outwards, that vary round the shell as waves.

    ``flattening``, ``outwards``: derivatives by those that do not vary.
    """
    c, s = math.cos(clock), math.sin(clock)
    cosine, sine = c, s
    for wave in range(4):
        cosine, sine = cosine * c - sine * s, sine * c + cosine * s
        shape[2 * wave], shape[2 * wave + 1] = flattening * cosine, flattening * sine
        if wave < 2:
            shape[8 + 2 * wave], shape[9 + 2 * wave] = outwards * cosine, outwards * sine


@inlined
def _edge_residuals(found, light, edge_offset, width, pixels, jacobian, kept, count, residual, rows, shape, at):
    """Residuals, derivatives and shape columns of edge points, the benchmark's residuals subtracted."""
    m = len(found)
    feet(found, pixels[:count], jacobian[:count], residual[:m], rows[:m], at)
    for i in range(m):
        residual[i] -= edge_offset[i]
        j = min(int(at[i]), count - 2) if math.isfinite(residual[i]) else 0
        clock = kept[j] + (at[i] - j) * (kept[j + 1] - kept[j])
        _lobe_columns(rows[i, 2], width * rows[i, _RADIUS], clock, shape[i])
        for c in range(3):
            shape[i, LOBES + c] = light[i, c]


@inlined
def _feature_residuals(
    spots, across, place, feature_offset, ring, terms, lens, outlier, m, pixels, jacobian, residual, rows, shape
):  # fmt: skip
    """As `_edge_residuals` for features, in the rows behind the edge's; those beyond ``outlier`` px become NaN."""
    p = len(spots)
    project_points(spots, terms, lens, pixels, jacobian)
    for i in range(p):
        ax, ay = across[i]
        residual[m + i] = place[i] - ax * pixels[i, 0] - ay * pixels[i, 1] - feature_offset[i]
        if not abs(residual[m + i]) < outlier:
            residual[m + i] = np.nan
        for c in range(COLUMNS):
            rows[m + i, c] = ax * jacobian[i, 0, c] + ay * jacobian[i, 1, c]
        radius = math.sqrt(spots[i, 1] ** 2 + spots[i, 2] ** 2)
        away = math.sqrt((-spots[i, 0] - ring[0]) ** 2 + (radius - ring[1]) ** 2)
        clock = math.atan2(spots[i, 2], -spots[i, 1])
        _lobe_columns(rows[m + i, 2], away * rows[m + i, _RADIUS], clock, shape[m + i])
        for c in range(3):
            shape[m + i, LOBES + c] = 0.0


@inlined
def _without_shape(residual, rows, shape, form, left):
    """Residuals less what joint, lobes and light of the step before explain: they are no scatter."""
    for i in range(len(residual)):
        left[i] = residual[i] - rows[i, JOINT] * form[0]
        for j in range(SHAPES):
            left[i] -= shape[i, j] * form[1 + j]


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
            inflate = max(1.4826 * median(scaled, used), 1.0)
        for i in range(size):
            weight[start + i] = 0.0
            if math.isfinite(residual[start + i]):
                scale = sd[i] * inflate
                weight[start + i] = 1.0 / (scale * scale) / max(1.0, abs(residual[start + i]) / (huber * scale))
    return edges


@inlined
def _normal_equations(basis, flattening, prior, residual, rows, shape, weight, design, normal, right):
    """Weighted normal equations with priors, means and sd, on all but the deflection."""
    (mean, sd), k, n = prior, basis.shape[1], len(design)
    for a in range(n):
        right[a] = 0.0
        for b in range(n):
            normal[a, b] = 0.0
    for i in range(len(residual)):
        if weight[i] > 0.0:
            for j in range(k):
                design[j] = rows[i, 0] * basis[0, j] + rows[i, 1] * basis[1, j]
            design[k], design[k + 1] = rows[i, 2], rows[i, JOINT]
            for j in range(SHAPES):
                design[k + 2 + j] = shape[i, j]
            for a in range(n):
                weighted = weight[i] * design[a]
                right[a] += weighted * residual[i]
                for b in range(a, n):
                    normal[a, b] += weighted * design[b]
    for a in range(n):
        if a >= k:
            normal[a, a] += 1.0 / sd[a - k] ** 2
            right[a] += mean[a - k] / sd[a - k] ** 2
        for b in range(a):
            normal[a, b] = normal[b, a]
    # the flattening is carried from step to step, the others are counted from zero in each
    right[k] -= flattening / sd[0] ** 2


@kernel
def fit_frame(deformation, basis, shell, lens, edge, features, prior, limits, residual, rows, shape, weight, left):
    """Fit a deformation (3,) in place to edge points and features; its state, steps taken.

    ``shell``: clocking angles of the edge, circles whose limb it is (`flightmodel.geometry.edge_circles`), ring about
    which the shell flattens, distance of the outermost torus from it, joint station. ``edge``: points (m, 2), light
    (m, 3), sd and residual at the benchmark (m,), NaN where it was not found. ``features``: points of the shell (p, 3),
    directions (p, 2), places, sd, residuals there (p,). ``prior``: mean and sd of flattening, joint, lobes (12), light
    (3). ``limits``: Huber's, largest residual, last step, steps, fewest edge points. ``residual``: against the deformed
    shell without lobes; ``left``: with what the fit makes of them, of joint and light. Rows with weight zero were not
    used; edge points come first.
    """
    clocks, circles, ring, width, joint = shell
    found, light, edge_sd, edge_offset = edge
    spots, across, place, feature_sd, feature_offset = features
    m, p, k = len(found), len(spots), basis.shape[1]
    n = k + 2 + SHAPES
    points, pixels = np.empty((len(clocks), 3)), np.empty((len(clocks), 2))
    jacobian = np.empty((len(clocks), 2, COLUMNS))
    spot_pixels, spot_jacobian = np.empty((p, 2)), np.empty((p, 2, COLUMNS))
    kept, at = np.empty(len(clocks)), np.empty(m)
    rotation, columns = np.empty((3, 3)), np.empty((3, 2))
    scaled = np.empty(max(m, p))
    design, normal, right = np.empty(n), np.empty((n, n)), np.empty(n)
    form = np.zeros(1 + SHAPES)
    huber, outlier, last_step, steps, fewest = limits
    for taken in range(steps):
        rotation_of(deformation[0], deformation[1], rotation, columns)
        terms = (rotation, columns, joint, deformation[2], ring[0], ring[1])
        if m > 0:
            count = _project_edge(
                deformation, clocks, circles, ring, joint, lens, terms, points, pixels, jacobian, kept
            )
            if count < 2:
                return TOO_FEW, taken
            _edge_residuals(found, light, edge_offset, width, pixels, jacobian, kept, count, residual, rows, shape, at)
        _feature_residuals(
            spots, across, place, feature_offset, ring, terms, lens, outlier, m, spot_pixels, spot_jacobian, residual,
            rows, shape,
        )  # fmt: skip
        _without_shape(residual, rows, shape, form, left)
        edges = huber_weights(m, p, edge_sd, feature_sd, huber, left, scaled, weight)
        if edges < fewest:
            return TOO_FEW, edges
        _normal_equations(basis, deformation[2], prior, residual, rows, shape, weight, design, normal, right)
        small_cholesky(normal, len(right), normal)
        small_solve(normal, len(right), right)
        step = right
        for j in range(k):
            deformation[0] += basis[0, j] * step[j]
            deformation[1] += basis[1, j] * step[j]
        deformation[2] += step[k]
        for j in range(1 + SHAPES):
            form[j] = step[k + 1 + j]
        if not deformation[0] ** 2 + deformation[1] ** 2 < 0.25:
            return DIVERGED, taken
        largest = 0.0
        for j in range(k + 1):
            largest = max(largest, abs(step[j]))
        if largest < last_step:
            break
    return DONE, taken + 1

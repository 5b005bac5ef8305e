"""Compiled Gauss-Newton fit of one frame; its model stands in `estimators.camera_fit`, its twin in the tests."""

from __future__ import annotations

import math

import numpy as np

from estimators._sight_kernels import COLUMNS, feet, limb_points, project_points, turn
from flightmodel._kernels import inlined, kernel

JOINT = COLUMNS - 1
SHAPES = 5
DONE, TOO_FEW, RAN_AWAY = 0, 1, 2


@inlined
def project_edge(bending, clocks, circle, ring, joint, lens, bend, points, pixels, jacobian, kept):
    """Project the limb of the flattened, bent outermost torus; the number of its points in the lens's field.

    They are moved to the front of ``pixels`` and ``jacobian``, their clocking angles into ``kept``.
    """
    rotation = bend[0]
    position, flat = lens[5], bending[2]
    eye = np.empty(3)
    dx, dy, dz = position[0] + joint, position[1], position[2]
    for m in range(3):
        eye[m] = rotation[0, m] * dx + rotation[1, m] * dy + rotation[2, m] * dz
    eye[0] -= joint
    station, radius, minor = circle
    flattened = (station + flat * (radius - ring[1]), radius - flat * (station - ring[0]), minor)
    if not limb_points(flattened, eye, clocks, points):
        return 0
    per = 1.0 / (1.0 + flat * flat)
    for i in range(len(points)):
        r = math.sqrt(points[i, 1] ** 2 + points[i, 2] ** 2)
        aft, outwards = -points[i, 0] - ring[0], r - ring[1]
        scale = (ring[1] + per * (outwards + flat * aft)) / r
        points[i, 0] = -(ring[0] + per * (aft - flat * outwards))
        points[i, 1] *= scale
        points[i, 2] *= scale
    project_points(points, bend, lens, pixels, jacobian)
    count = 0
    for i in range(len(points)):
        if math.isfinite(pixels[i, 0]):
            if count < i:
                pixels[count] = pixels[i]
                jacobian[count] = jacobian[i]
            kept[count] = clocks[i]
            count += 1
    return count


@inlined
def against_edge(found, light, edge_left, pixels, jacobian, kept, count, residual, rows, shape, at):
    """Residuals, derivatives and shape columns of edge points, what was left over at the benchmark taken off."""
    m = len(found)
    feet(found, pixels[:count], jacobian[:count], residual[:m], rows[:m], at)
    for i in range(m):
        residual[i] -= edge_left[i]
        j = min(int(at[i]), count - 2) if math.isfinite(residual[i]) else 0
        clock = kept[j] + (at[i] - j) * (kept[j + 1] - kept[j])
        shape[i, 0], shape[i, 1] = rows[i, 2] * math.cos(2.0 * clock), rows[i, 2] * math.sin(2.0 * clock)
        shape[i, 2], shape[i, 3], shape[i, 4] = light[i, 0], light[i, 1], light[i, 2]


@inlined
def against_marks(spots, across, place, mark_left, bend, lens, gross, m, pixels, jacobian, residual, rows, shape):
    """As `against_edge` for marks, in the rows behind the edge's; gross errors and unknown ones become NaN."""
    p = len(spots)
    project_points(spots, bend, lens, pixels, jacobian)
    for i in range(p):
        ax, ay = across[i]
        residual[m + i] = place[i] - ax * pixels[i, 0] - ay * pixels[i, 1] - mark_left[i]
        if not abs(residual[m + i]) < gross:
            residual[m + i] = np.nan
        for c in range(COLUMNS):
            rows[m + i, c] = ax * jacobian[i, 0, c] + ay * jacobian[i, 1, c]
        clock = math.atan2(spots[i, 2], -spots[i, 1])
        shape[m + i, 0] = rows[m + i, 2] * math.cos(2.0 * clock)
        shape[m + i, 1] = rows[m + i, 2] * math.sin(2.0 * clock)
        shape[m + i, 2], shape[m + i, 3], shape[m + i, 4] = 0.0, 0.0, 0.0


@inlined
def huber_weights(m, p, edge_sd, mark_sd, huber, residual, scaled, weight):
    """Weights, zero where a residual is NaN; how many edge points have one."""
    edges = 0
    # each kind's sd is widened where its residuals say so; then Huber's weights
    for kind in range(2):
        start, size = (0, m) if kind == 0 else (m, p)
        sd = edge_sd if kind == 0 else mark_sd
        used = 0
        for i in range(size):
            if math.isfinite(residual[start + i]):
                scaled[used] = residual[start + i]
                used += 1
        if kind == 0:
            edges = used
        widen = 1.0
        if used > 0:
            centre = np.median(scaled[:used])
            used = 0
            for i in range(size):
                if math.isfinite(residual[start + i]):
                    scaled[used] = abs(residual[start + i] - centre) / sd[i]
                    used += 1
            widen = max(1.4826 * np.median(scaled[:used]), 1.0)
        for i in range(size):
            weight[start + i] = 0.0
            if math.isfinite(residual[start + i]):
                scale = sd[i] * widen
                weight[start + i] = 1.0 / (scale * scale) / max(1.0, abs(residual[start + i]) / (huber * scale))
    return edges


@inlined
def normal_equations(basis, flattening, prior, residual, rows, shape, weight, design, normal, right):
    """Weighted normal equations with priors on all but the bending; the flattening's pulls towards zero."""
    k, n = basis.shape[1], len(design)
    normal[:] = 0.0
    right[:] = 0.0
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
            normal[a, a] += 1.0 / prior[a - k] ** 2
        for b in range(a):
            normal[a, b] = normal[b, a]
    right[k] -= flattening / prior[0] ** 2


@kernel
def fit_frame(bending, basis, shell, lens, edge, marks, prior, limits, residual, rows, shape, weight):
    """Fit a bending (3,) in place to edge points and marks; its state, steps taken.

    ``shell``: clocking angles of the edge, circle of the outermost torus, ring about which the shell flattens, joint
    station. ``edge``: points (m, 2), light (m, 3), sd and what was left over at the benchmark (m,), NaN where nothing
    was. ``marks``: points of the shell (p, 3), directions (p, 2), places, sd, left over (p,). ``prior``: sd of
    flattening, joint, ovality (2), light (3). ``limits``: Huber's, gross error, last step, steps, fewest edge points.
    Rows with weight zero were not used; edge points come first.
    """
    clocks, circle, ring, joint = shell
    found, light, edge_sd, edge_left = edge
    spots, across, place, mark_sd, mark_left = marks
    m, p, k = len(found), len(spots), basis.shape[1]
    n = k + 2 + SHAPES
    points, pixels = np.empty((len(clocks), 3)), np.empty((len(clocks), 2))
    jacobian = np.empty((len(clocks), 2, COLUMNS))
    spot_pixels, spot_jacobian = np.empty((p, 2)), np.empty((p, 2, COLUMNS))
    kept, at = np.empty(len(clocks)), np.empty(m)
    rotation, left = np.empty((3, 3)), np.empty((3, 2))
    scaled = np.empty(max(m, p))
    design, normal, right = np.empty(n), np.empty((n, n)), np.empty(n)
    huber, gross, last_step, steps, fewest = limits
    for taken in range(steps):
        turn(bending[0], bending[1], rotation, left)
        bend = (rotation, left, joint, bending[2], ring[0], ring[1])
        if m > 0:
            count = project_edge(bending, clocks, circle, ring, joint, lens, bend, points, pixels, jacobian, kept)
            if count < 2:
                return TOO_FEW, taken
            against_edge(found, light, edge_left, pixels, jacobian, kept, count, residual, rows, shape, at)
        against_marks(
            spots, across, place, mark_left, bend, lens, gross, m, spot_pixels, spot_jacobian, residual, rows, shape
        )
        edges = huber_weights(m, p, edge_sd, mark_sd, huber, residual, scaled, weight)
        if edges < fewest:
            return TOO_FEW, edges
        normal_equations(basis, bending[2], prior, residual, rows, shape, weight, design, normal, right)
        step = np.linalg.solve(normal, right)
        for j in range(k):
            bending[0] += basis[0, j] * step[j]
            bending[1] += basis[1, j] * step[j]
        bending[2] += step[k]
        if not bending[0] ** 2 + bending[1] ** 2 < 0.25:
            return RAN_AWAY, taken
        largest = 0.0
        for j in range(k + 1):
            largest = max(largest, abs(step[j]))
        if largest < last_step:
            break
    return DONE, taken + 1

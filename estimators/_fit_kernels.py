"""Compiled Gauss-Newton fit of one frame; the model is in `estimators.frame_solution`.

Readable twin: ``tests/oracles/plain_fit.py``.
"""

from __future__ import annotations

import math

import numpy as np

from estimators.edge import median
from estimators.virtual_camera import COLUMNS, feet, project_edge, project_points, rotation_of
from flightmodel._kernels import inlined, kernel, small_cholesky, small_solve
from flightmodel.statistics import NORMAL_MAD

JOINT = COLUMNS - 1
LOBES = 12  # cosine and sine of lobes of two to five waves (8) and of rings out of round of two and three (4)
SHAPES = LOBES + 3  # light
_RADIUS = COLUMNS - 2
DONE, TOO_FEW, DIVERGED = 0, 1, 2
_ROUNDING = float(np.finfo(float).eps)
_SWEEPS = 30  # a bound: the angles fall as their squares


@inlined
def _waves_round(clock, away, waves):
    """Waves (12,) round the shell: of lobes across it, and times the distance ``away`` of those along its radius."""
    c, s = math.cos(clock), math.sin(clock)
    cosine, sine = c, s
    for wave in range(4):
        cosine, sine = cosine * c - sine * s, sine * c + cosine * s
        waves[2 * wave], waves[2 * wave + 1] = cosine, sine
        if wave < 2:
            waves[8 + 2 * wave], waves[9 + 2 * wave] = away * cosine, away * sine


@inlined
def _lobe_columns(flattening, outwards, waves, shape):
    """Derivatives by a flattening, and by a growth outwards, that vary round the shell as waves (12,).

    ``flattening``, ``outwards``: derivatives by those that do not vary.
    """
    for j in range(8):
        shape[j] = flattening * waves[j]
    for j in range(8, LOBES):
        shape[j] = outwards * waves[j]


@inlined
def _edge_residuals(found, light, edge_offset, width, pixels, jacobian, kept, count, residual, rows, shape, at):
    """Residuals, derivatives and shape columns of edge points, the benchmark's residuals subtracted."""
    m, waves = len(found), np.empty(LOBES)
    feet(found, pixels[:count], jacobian[:count], residual[:m], rows[:m], at)
    for i in range(m):
        residual[i] -= edge_offset[i]
        j = min(int(at[i]), count - 2) if math.isfinite(residual[i]) else 0
        clock = kept[j] + (at[i] - j) * (kept[j + 1] - kept[j])
        _waves_round(clock, width, waves)
        _lobe_columns(rows[i, 2], rows[i, _RADIUS], waves, shape[i])
        for c in range(3):
            shape[i, LOBES + c] = light[i, c]


@inlined
def _feature_residuals(
    spots, across, place, sd, feature_offset, waves, terms, lens, outlier, m, pixels, jacobian, residual, rows, shape
):  # fmt: skip
    """As `_edge_residuals` for features, in the rows behind the edge's; those beyond ``outlier`` px become NaN."""
    p = len(spots)
    project_points(spots, terms, lens, pixels, jacobian)
    for i in range(p):
        ax, ay = across[i]
        residual[m + i] = place[i] - ax * pixels[i, 0] - ay * pixels[i, 1] - feature_offset[i]
        if not (abs(residual[m + i]) < outlier and sd[i] < np.inf):
            residual[m + i] = np.nan
        for c in range(COLUMNS):
            rows[m + i, c] = ax * jacobian[i, 0, c] + ay * jacobian[i, 1, c]
        _lobe_columns(rows[m + i, 2], rows[m + i, _RADIUS], waves[i], shape[m + i])
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
            inflate = max(NORMAL_MAD * median(scaled, used), 1.0)
        for i in range(size):
            weight[start + i] = 0.0
            if math.isfinite(residual[start + i]):
                scale = sd[i] * inflate
                weight[start + i] = 1.0 / (scale * scale) / max(1.0, abs(residual[start + i]) / (huber * scale))
    return edges


@inlined
def _turn(columns, first, turned):
    """Columns (n, q) as rows from ``first`` on."""
    for i in range(len(columns)):
        for j in range(columns.shape[1]):
            turned[first + j, i] = columns[i, j]


@inlined
def _lower_products(columns, count, weight, first, weighted, product):
    """Weighted products of points' columns, one a row (q, n), with those up to themselves, from the ``first`` row on.

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


@inlined
def _add_prior(prior, flattening, k, normal, right):
    """Take the right side (n,) out of the last row, and add means and sd on all but ``k`` of a deflection."""
    mean, sd = prior
    for a in range(len(right)):
        right[a] = normal[len(right), a]
        if a >= k:
            normal[a, a] += 1.0 / sd[a - k] ** 2
            right[a] += mean[a - k] / sd[a - k] ** 2
    # the flattening is carried from step to step, the others are counted from zero in each
    right[k] -= flattening / sd[0] ** 2


@inlined
def _normal_equations(basis, flattening, prior, residual, rows, shape, weight, room, normal, right):
    """Weighted normal equations with priors, means and sd, on all but the deflection.

    ``room``: designs (k + 18, n) of points, their residuals behind; twice as many weights. ``normal`` as wide.
    """
    k = basis.shape[1]
    columns, used, weighted = room
    count = 0
    for i in range(len(residual)):
        if weight[i] > 0.0:
            for j in range(k):
                columns[j, count] = rows[i, 0] * basis[0, j] + rows[i, 1] * basis[1, j]
            columns[k, count], columns[k + 1, count] = rows[i, 2], rows[i, JOINT]
            for j in range(SHAPES):
                columns[k + 2 + j, count] = shape[i, j]
            columns[k + 2 + SHAPES, count] = residual[i]
            used[count] = weight[i]
            count += 1
    _lower_products(columns, count, used, 0, weighted, normal)
    _add_prior(prior, flattening, k, normal, right)


@kernel
def fit_frame(deformation, basis, shell, lens, edge, features, prior, limits, residual, rows, shape, weight, left):
    """Fit a deformation (3,) in place to edge points and features; its state, steps taken.

    ``shell``: clocking angles of the edge, circles whose limb it is (`flightmodel.geometry.edge_circles`), ring about
    which the shell flattens, distance of the outermost torus from it, joint station. ``edge``: points (m, 2), light
    (m, 3), sd and residual at the benchmark (m,), NaN where it was not found. ``features``: points of the shell (p, 3),
    directions (p, 2), places, sd, infinite where one was not found, residuals there (p,), waves round the shell there
    (p, 12). ``prior``: mean and sd of flattening, joint, lobes (12), light (3). ``limits``: Huber's, largest residual,
    last step, steps, fewest edge points. ``residual``: against the deformed shell without lobes; ``left``: with what
    the fit makes of them, of joint and light. Rows with weight zero were not used; edge points come first.
    """
    clocks, circles, ring, width, joint = shell
    found, light, edge_sd, edge_offset = edge
    spots, across, place, feature_sd, feature_offset, waves = features
    m, p, k = len(found), len(spots), basis.shape[1]
    n = k + 2 + SHAPES
    points, pixels = np.empty((len(clocks), 3)), np.empty((len(clocks), 2))
    jacobian = np.empty((len(clocks), 2, COLUMNS))
    spot_pixels, spot_jacobian = np.empty((p, 2)), np.empty((p, 2, COLUMNS))
    kept, at = np.empty(len(clocks)), np.empty(m)
    rotation, columns = np.empty((3, 3)), np.empty((3, 2))
    scaled = np.empty(max(m, p))
    room = np.empty((n + 1, m + p)), np.empty(m + p), np.empty(m + p)
    normal, right = np.empty((n + 1, n + 1)), np.empty(n)
    form = np.zeros(1 + SHAPES)
    huber, outlier, last_step, steps, fewest = limits
    for taken in range(steps):
        rotation_of(deformation[0], deformation[1], rotation, columns)
        terms = (rotation, columns, joint, deformation[2], ring[0], ring[1])
        if m > 0:
            count = project_edge(deformation, clocks, circles, ring, joint, lens, terms, points, pixels, jacobian, kept)
            if count < 2:
                return TOO_FEW, taken
            _edge_residuals(found, light, edge_offset, width, pixels, jacobian, kept, count, residual, rows, shape, at)
        _feature_residuals(
            spots, across, place, feature_sd, feature_offset, waves, terms, lens, outlier, m, spot_pixels,
            spot_jacobian, residual, rows, shape,
        )  # fmt: skip
        _without_shape(residual, rows, shape, form, left)
        edges = huber_weights(m, p, edge_sd, feature_sd, huber, left, scaled, weight)
        if edges < fewest:
            return TOO_FEW, edges
        _normal_equations(basis, deformation[2], prior, residual, rows, shape, weight, room, normal, right)
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


@kernel
def solved(columns, residual, weight, prior, flattening, formal, found):
    """Formal covariance (n, n) of a weighted least-squares step and the step ``found`` (n,), with the priors.

    ``columns`` (m, n): derivatives by deflection, flattening, joint, lobes and light. ``prior``: mean and sd of all but
    the deflection, the flattening's about ``flattening``, which comes on top of the step.
    """
    m, n = columns.shape
    turned, normal = np.empty((n + 1, m)), np.empty((n + 1, n + 1))
    _turn(columns, 0, turned)
    for i in range(m):
        turned[n, i] = residual[i]
    _lower_products(turned, m, weight, 0, np.empty(m), normal)
    _add_prior(prior, flattening, n - len(prior[0]), normal, found)
    small_cholesky(normal, n, normal)
    small_solve(normal, n, found)
    unit = np.empty(n)
    for a in range(n):
        unit[:] = 0.0
        unit[a] = 1.0
        small_solve(normal, n, unit)
        for b in range(n):
            formal[a, b] = unit[b]


@kernel
def used_points(basis, rows, shape, residual, left, weight, columns, of_used):
    """Move what belongs to points with a weight to the front; their number, and the weighted square of ``left``.

    ``columns`` (n, k + 17): derivatives by deflection, flattening, joint, lobes and light. ``of_used``: places of the
    points, their rows (n, 16), residuals and weights.
    """
    at, used_rows, used_residual, used_weight = of_used
    k, count, square, total = basis.shape[1], 0, 0.0, 0.0
    for i in range(len(weight)):
        if weight[i] > 0.0:
            at[count] = i
            for j in range(k):
                columns[count, j] = rows[i, 0] * basis[0, j] + rows[i, 1] * basis[1, j]
            columns[count, k], columns[count, k + 1] = rows[i, 2], rows[i, JOINT]
            for j in range(SHAPES):
                columns[count, k + 2 + j] = shape[i, j]
            for j in range(COLUMNS):
                used_rows[count, j] = rows[i, j]
            used_residual[count], used_weight[count] = residual[i], weight[i]
            square += weight[i] * left[i] * left[i]
            total += weight[i]
            count += 1
    return count, square / total if total > 0.0 else 0.0


@inlined
def turned_to_axes(matrix, axes):
    """Turn a symmetric matrix (m, m) to its axes, the columns of ``axes``, in place (C. G. J. Jacobi, 1846)."""
    m = len(matrix)
    for a in range(m):
        for b in range(m):
            axes[a, b] = 1.0 if a == b else 0.0
    for _ in range(_SWEEPS):
        is_diagonal = True
        for a in range(m):
            for b in range(a + 1, m):
                off = matrix[a, b]
                if off * off <= 1e-32 * abs(matrix[a, a] * matrix[b, b]):
                    continue
                is_diagonal = False
                half = 0.5 * (matrix[b, b] - matrix[a, a]) / off
                t = math.copysign(1.0, half) / (abs(half) + math.sqrt(half * half + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for j in range(m):
                    x, y = matrix[a, j], matrix[b, j]
                    matrix[a, j], matrix[b, j] = c * x - s * y, s * x + c * y
                for j in range(m):
                    x, y = matrix[j, a], matrix[j, b]
                    matrix[j, a], matrix[j, b] = c * x - s * y, s * x + c * y
                    x, y = axes[j, a], axes[j, b]
                    axes[j, a], axes[j, b] = c * x - s * y, s * x + c * y
                matrix[a, b] = matrix[b, a] = 0.0
        if is_diagonal:
            break


@kernel
def motion_beside(columns, formal, by, residual, weight, allowed, motion):
    """Motion (m,) beside a fit that explains the residuals best, and its chi-square; see `estimators.frame_checks`.

    ``columns`` (n, k), ``formal`` (k, k): the fit's. ``by`` (n, m): derivatives by the motion. ``allowed``: sd of each
    of its terms.
    """
    (n, k), m = columns.shape, by.shape[1]
    turned, product = np.empty((k + m + 1, n)), np.empty((k + m + 1, k + m + 1))
    _turn(columns, 0, turned)
    _turn(by, k, turned)
    for i in range(n):
        turned[k + m, i] = residual[i]
    _lower_products(turned, n, weight, k, np.empty(n), product)
    inverse, axes, right = np.empty((m, m)), np.empty((m, m)), np.empty(m)
    fitted = np.empty(k)
    for c in range(m + 1):
        for a in range(k):
            fitted[a] = 0.0
            for b in range(k):
                fitted[a] += formal[a, b] * product[k + c, b]
        for j in range(min(c + 1, m)):
            left = product[k + c, k + j]
            for a in range(k):
                left -= product[k + j, a] * fitted[a]
            if c < m:
                inverse[c, j] = inverse[j, c] = left
            else:
                right[j] = left
    turned_to_axes(inverse, axes)
    most, square = 0.0, 0.0
    for q in range(m):
        motion[q] = 0.0
        most = max(most, inverse[q, q])
    for q in range(m):
        value, along = inverse[q, q], 0.0
        # along the axes of the inverse covariance, where it says anything
        if value > m * _ROUNDING * most:
            for j in range(m):
                along += axes[j, q] * right[j]
            for j in range(m):
                motion[j] += axes[j, q] * along / value
            square += along * along / (value * (1.0 + allowed * allowed * value))
    return square

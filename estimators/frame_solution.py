"""Which deflection explains the edge and the features found in a frame, for a camera oriented on a benchmark frame?

In the benchmark frame, taken as undeflected, the camera (rotation, focal scale, principal point, k1, k2, position) and
the shell's radius are fitted to edge and features with their a priori sd (`estimators.benchmark`). Its residuals, point
by point, are how the shell was built and painted: they are subtracted from the other frames' residuals, so that those
measure motion.

In the other frames, with the plane estimated: Gauss-Newton with Huber's weights on

    r_i = found_i - predicted_i(w, kappa) - r_i(benchmark),   parameters  w (2), kappa, joint, lobes (12), light (3),

each but ``w`` with its prior: the shell's flattening and its lobes of two to five waves under load, the joint's
station, and the shift, tilt and bow by which a changing light moves the found edge. With an assumed plane, the seed
paper's way, one component of ``w`` alone is fitted to the edge alone, and the rest is only in the error bar. The
covariance is the formal one, scaled by the residuals, plus that of the benchmark's uncertain parameters,

    dw = G [(C_f - C_b) dc + (B_b + (C_f - C_b) S) db],      G = (J' W J + P^-1)^-1 J' W,

with ``c`` the camera, ``b`` the deflection of the benchmark frame, ``S = dc/db``, and ``C``, ``B`` the derivatives in
the frame ``f`` and in the benchmark ``b``.

Assumed: the shell moves as one body but for flattening and lobes; independent errors of edge points and features
beside the modelled ones. Readable twin of the fit: ``tests/oracles/plain_fit.py``.

References
----------
Seed paper, CAD-based estimate. S. F. Schmidt's "consider" covariance, e.g. B. D. Tapley, B. E. Schutz, G. H. Born,
"Statistical Orbit Determination", 2004, chapter 6. P. J. Huber, "Robust Statistics", 1981, chapter 7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators.edge import HorizonLine
from estimators.frame_edits import LEAST_MARKS
from estimators.frame_residuals import (
    ROUND_WAVES,
    WAVES,
    FrameShape,
    huber_weights,
    lower_products,
)
from estimators.virtual_camera import (
    CAMERA,
    COLUMNS,
    DEFLECTION,
    JOINT,
    RADIUS,
    feet,
    project_edge,
    project_points,
    rotation_of,
)
from flightmodel._kernels import inlined, kernel, small_cholesky, small_solve
from flightmodel.checks import NO_FAULT, FloatArray, GateError, Issue

STEPS = 12  # a bound, for Gauss-Newton from a few pixels away
LAST_STEP_RAD = 2e-5  # 0.001 deg, far below any frame's sd
OUTLIER_PX = 5.0  # a point this far off lies on another edge or feature
LEAST_POINTS, LEAST_FEATURES = 60, 40  # a quarter of the lines; a seventh of the reference shell's rows in view
POSED = slice(CAMERA.start, JOINT)
TURN, CENTRE = slice(CAMERA.start, CAMERA.start + 4), slice(CAMERA.start + 4, CAMERA.start + 6)
_SOFT_WAVES = 3  # a ring's stiffness grows as (n^2 - 1)^2: 9, 64, 225, 576
LOBES = 12  # cosine and sine of lobes of two to five waves (8) and of rings out of round of two and three (4)
SHAPES = LOBES + 3  # light
DONE, TOO_FEW, DIVERGED = 0, 1, 2


@dataclass(frozen=True)
class AprioriSd:
    """A priori standard deviations of what the frames determine not at all, or only in part.

    Parameters
    ----------
    rim_radius_m, joint_station_m : float
        Shell and joint; 0.05 m covers the nose and the innermost torus within 4 sd.
    benchmark_rad : float
        Deflection of the benchmark frame, each lateral axis. Statically ``(z0/x) u/(1-u)``, 0.06 deg for the reference
        vehicle at 421 s, and the joint's oscillation about it.
    flattening_rad, lobes_rad : float
        Flattening (the shell opens like an umbrella), and cosine and sine of lobes of two and three waves, between
        benchmark and frame, as angles about the innermost ring. The local deformation of the seed paper's shell was
        not measured.
    higher_lobes_rad : float
        Lobes of more waves, against which a ring is much stiffer; of more than five they are not modelled.
    edge_px : float
        Shift of the found edge against the true one, different from frame to frame with the light; as much for a
        tilt and for a bow of the edge across the picture (at the picture's sides).
    features_px : float
        Shift along the shell's meridians that the features found in a frame have in common with the light, which slopes
        across every torus: the same all round the shell, and cosine and sine of a wave. Its size is found on films of
        another renderer (benchmarks/README.md).
    """

    rim_radius_m: float = 0.01
    joint_station_m: float = 0.05
    benchmark_rad: float = float(np.deg2rad(0.12))
    flattening_rad: float = float(np.deg2rad(0.25))
    lobes_rad: float = float(np.deg2rad(0.2))
    higher_lobes_rad: float = float(np.deg2rad(0.1))

    edge_px: float = 0.2
    features_px: float = 0.1

    @property
    def lobe_sd_rad(self) -> FloatArray:
        """Of each modelled lobe (12,), in the order of `estimators.frame_residuals.lobe_columns`."""
        waves = np.repeat([*WAVES, *ROUND_WAVES], 2)
        return np.where(waves <= _SOFT_WAVES, self.lobes_rad, self.higher_lobes_rad)


@dataclass(frozen=True)
class FrameFit:
    """The deflection estimated from one frame.

    Parameters
    ----------
    rotation_yz_rad : (2,) float
        Rotation vector about body y and z, rad; NaN when refused.
    covariance : (k, k) float
        Of the fitted parameters: ``rotation_yz_rad`` (k = 2), or the angle in the assumed plane (k = 1), rad^2.
    per_benchmark : (k, 2) float
        Missing part of the answer per unit deflection of the benchmark frame, whose a priori sd is in the covariance.
    plane_leak : float
        Answer to a unit deflection normal to the assumed plane (k = 1); zero otherwise.
    flattening_rad : float
    residual_rms_px : float
    features : int
        Rows of features used.
    horizon : HorizonLine
    refused : Issue
        Why there is no answer; empty when there is one.
    contradicted : bool
        Whether a whole edge alone gave the answer, against the features.
    mount_px : float
        How far the centerbody's own edge has moved in the picture; NaN where unknown.
    mount_is_sure : bool
        Whether that holds for this frame by itself.
    shape : FrameShape or None
        None in an assumed plane.
    by_shape : (2, 13 (1 + c)) float or None
        Error per unit error of the shell's shape under load as the film determined it, where that was used.
    with_open_plane : FrameFit or None
        Of the same frame with its plane estimated, where one is assumed.
    moved_var : float
        Part of either component's variance by a motion of the picture that may be, with the plane estimated; see
        `estimators.frame_checks`.
    """

    rotation_yz_rad: FloatArray
    covariance: FloatArray
    per_benchmark: FloatArray
    plane_leak: float
    flattening_rad: float
    residual_rms_px: float
    features: int
    horizon: HorizonLine
    refused: Issue = NO_FAULT
    contradicted: bool = False
    mount_px: float = float("nan")
    mount_is_sure: bool = True
    shape: FrameShape | None = None
    by_shape: FloatArray | None = None
    with_open_plane: FrameFit | None = None
    moved_var: float = 0.0


class NoFitError(GateError):
    """The found points do not fit the model."""


@dataclass(frozen=True)
class Solution:
    """Last step of one frame's fit: gain ``(k + 17, m)`` and formal covariance of deflection, shape and light.

    ``columns`` (m, k + 17): derivatives by these. ``shape_found`` (17,): flattening, joint station, lobes and light.
    ``before``: the benchmark's rows of the points used; ``edge_count`` of them are edge points and come first.
    ``feature_rows``: of the features behind them.
    """

    gain: FloatArray
    formal: FloatArray
    shape_found: FloatArray
    columns: FloatArray
    rows: FloatArray
    before: FloatArray
    edge_count: int
    rms_px: float
    residual_px: FloatArray
    weight: FloatArray
    feature_rows: NDArray[np.intp]

    @cached_property
    def by_pose(self) -> FloatArray:
        """Error (k + 17, 12) per unit error of the camera's pose."""
        return self.gain @ (self.rows[:, POSED] - self.before[:, POSED])

    @cached_property
    def by_deflection(self) -> FloatArray:
        """Missing part (k + 17, 2) per unit deflection of the benchmark frame, the pose aside."""
        return self.gain @ self.before[:, DEFLECTION]


@dataclass(frozen=True)
class Fitted:
    """Edge points, which come first, and all features at the end of a fit; ``benchmark_at``: their rows there.

    ``left_px``: residuals less what the shell's lobes, the joint's station and the light explain.
    """

    residual_px: FloatArray
    left_px: FloatArray
    rows: FloatArray
    shape: FloatArray
    weight: FloatArray
    benchmark_at: NDArray[np.intp]
    edge_points: int


def found_rows(found: tuple[FloatArray, FloatArray]) -> NDArray[np.intp]:
    """Rows of features that were found."""
    return np.flatnonzero(np.isfinite(found[1]))


def least_points(horizon: HorizonLine) -> int:
    """How many edge points a fit needs."""
    return LEAST_MARKS if horizon.is_by_hand else LEAST_POINTS


def refused_fit(
    horizon: HorizonLine, reason: Issue, mount_px: float = float("nan"), mount_is_sure: bool = True
) -> FrameFit:
    """Return the fit of a frame that has no answer."""
    nan = np.full((2, 2), np.nan)
    return FrameFit(
        nan[0], nan, nan, 0.0, float("nan"), float("nan"), 0, horizon, reason, mount_px=mount_px,
        mount_is_sure=mount_is_sure,
    )  # fmt: skip


@inlined
def _waves_of_point(clock, away, waves):
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
        _waves_of_point(clock, width, waves)
        _lobe_columns(rows[i, 2], rows[i, RADIUS], waves, shape[i])
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
        _lobe_columns(rows[m + i, 2], rows[m + i, RADIUS], waves[i], shape[m + i])
        for c in range(3):
            shape[m + i, LOBES + c] = 0.0


@inlined
def _without_shape(residual, rows, shape, form, left):
    """Residuals minus the effects of joint, lobes and light from the last step, which are not scatter."""
    for i in range(len(residual)):
        left[i] = residual[i] - rows[i, JOINT] * form[0]
        for j in range(SHAPES):
            left[i] -= shape[i, j] * form[1 + j]


@inlined
def _add_prior(prior, flattening, k, normal, right):
    """Copy the right side (n,) from the last row, and add the priors of all parameters but the deflection (``k``)."""
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
    lower_products(columns, count, used, 0, weighted, normal)
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

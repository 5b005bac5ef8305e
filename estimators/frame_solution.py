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
beside the modelled ones.

References
----------
Seed paper, CAD-based estimate. S. F. Schmidt's "consider" covariance, e.g. B. D. Tapley, B. E. Schutz, G. H. Born,
"Statistical Orbit Determination", 2004, chapter 6. P. J. Huber, "Robust Statistics", 1981, chapter 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators import _fit_kernels
from estimators.body_edge import BodyEdge
from estimators.edge import HorizonLine, ScanLines
from estimators.features import Features, ImageFeatures, light_shift
from estimators.frame_checks import WORST_SHAPE
from estimators.frame_edits import LEAST_MARKS, MarkedFeatures
from estimators.frame_residuals import HUBER, ROUND_WAVES, WAVES, FrameResiduals, FrameShape, light_columns, waves_round
from estimators.texture import PaintedTexture
from estimators.virtual_camera import CAMERA, DEFLECTION, HELD, VirtualCamera
from flightmodel.checks import NO_FAULT, BoolArray, FloatArray, GateError, Issue
from flightmodel.deflection import lv_clock

STEPS = 12  # a bound, for Gauss-Newton from a few pixels away
LAST_STEP_RAD = 2e-5  # 0.001 deg, far below any frame's sd
OUTLIER_PX = 5.0  # a point this far off lies on another edge or feature
LEAST_POINTS, LEAST_FEATURES = 60, 40  # a quarter of the lines; a seventh of the reference shell's rows in view
_LEAST_VAR = float(np.deg2rad(0.02) ** 2)  # of a difference: shapes that are not modelled, and points that err alike
BESIDE = 4  # places of 240 along the edge: a residual of the benchmark frame holds that far for a mark by hand
JOINT = HELD.stop - 1
POSED = slice(CAMERA.start, JOINT)
TURN, CENTRE = slice(CAMERA.start, CAMERA.start + 4), slice(CAMERA.start + 4, CAMERA.start + 6)
_SOFT_WAVES = 3  # a ring's stiffness grows as (n^2 - 1)^2: 9, 64, 225, 576
LOBES = slice(2, 2 + _fit_kernels.LOBES)
"""Among flattening, joint station, lobes and light."""
_NO_FEATURES: tuple[FloatArray, ...] = (*(np.zeros((0, k)) for k in (3, 2)), *np.zeros((3, 0)), np.zeros((0, 12)))
SHAPE = np.array([2, *range(4, 4 + _fit_kernels.LOBES)])
"""Flattening and lobes among deflection, flattening, joint station, lobes and light."""
_ANSWERED = np.array([0, 1, *SHAPE])


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


@dataclass(frozen=True)
class FrameModel:
    """A virtual camera whose orientation and lens were fitted on a benchmark frame; see `estimators.benchmark`.

    Parameters
    ----------
    view : VirtualCamera
    clocks_rad : (n,) float
        Places of the shell's edge that are looked for.
    lines : ScanLines
        Where they are searched without a deflection to start from.
    features : Features
        Features that are looked for.
    apriori : AprioriSd
    benchmark : HorizonLine
    benchmark_residuals : FrameResiduals
        Residuals, rows and sd of the points found in the benchmark frame.
    corrections : (8,) float
        Three rotations in camera axes, rad, focal scale less one, principal point, px, k1 and k2, against nominal.
    posed_covariance : (12, 12) float
        Of the corrections, camera position and shell radius.
    posed_per_deflection : (12, 2) float
        Their shift per radian of deflection of the benchmark frame.
    residual_rms_px : float
        Of the benchmark frame.
    stated_refused : Issue
        Why the features that the vehicle file states are not used; empty where they are, or where it states none.
    support : float
        Share of what the orientation looked for on the shell, features or the valleys between tori, that the benchmark
        frame shows.
    breaks : (m,) int
        Rows after which the benchmark frame breaks across its width.
    steepness : float
        Of the benchmark frame's edge; see `estimators.edge.steepness_of`.
    body : BodyEdge or None
        The centerbody's silhouette in the benchmark frame.
    """

    view: VirtualCamera
    clocks_rad: FloatArray
    lines: ScanLines
    features: Features
    apriori: AprioriSd
    benchmark: HorizonLine
    benchmark_residuals: FrameResiduals = field(repr=False)
    corrections: FloatArray
    posed_covariance: FloatArray = field(repr=False)
    posed_per_deflection: FloatArray = field(repr=False)
    residual_rms_px: float
    stated_refused: Issue = NO_FAULT
    support: float = 1.0
    breaks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp), repr=False)
    steepness: float = float("nan")
    body: BodyEdge | None = field(default=None, repr=False)

    @cached_property
    def _benchmark_edge(self) -> BoolArray:
        """Which of the points found in the benchmark frame are the edge's, the others are features."""
        return np.asarray(self.benchmark_residuals.index < len(self.clocks_rad))

    @cached_property
    def _edge_at_benchmark(self) -> int:
        """Edge points found in the benchmark frame."""
        return int(self._benchmark_edge.sum())

    def features_at_benchmark(self, painted: bool) -> int:
        """Painted features found in the benchmark frame, or all other ones."""
        rows = self.benchmark_residuals.index[~self._benchmark_edge] - len(self.clocks_rad)
        return int(((rows < self.painted_rows) == painted).sum())

    @property
    def painted_rows(self) -> int:
        """How many rows of the features, the first, are painted ones."""
        return 0 if self.painted is None else len(self.painted.across_px)

    @property
    def unmarked(self) -> Features:
        """Features without those that an analyst marked."""
        return self.features.found if isinstance(self.features, MarkedFeatures) else self.features

    @cached_property
    def painted(self) -> ImageFeatures | None:
        """Features of known places on the shell; None where there is texture, or nothing."""
        found = self.unmarked.painted if isinstance(self.unmarked, PaintedTexture) else self.unmarked
        return found if isinstance(found, ImageFeatures) and len(found.points_shell_m) else None

    @property
    def edge_in_view(self) -> float:
        """Share of the edge looked for that the benchmark frame shows."""
        return self._edge_at_benchmark / max(len(self.clocks_rad), 1)

    def _edge_share(self, points: int) -> float:
        """So many edge points over those of the benchmark frame; none where that shows no edge."""
        there = self._edge_at_benchmark
        return points / there if there else 0.0

    def _at_benchmark(
        self, index: NDArray[np.intp], beside: int = 0
    ) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """Of points found at the benchmark too, or so many places beside it: residual (NaN where not), sd, its row."""
        if beside:
            return self._nearest_at_benchmark(index, beside)
        offset, sd, at = self._every_place_at_benchmark
        return offset[index], sd[index], at[index]

    @cached_property
    def _every_place_at_benchmark(self) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """`_at_benchmark` of all places of the edge and rows of features."""
        return self._nearest_at_benchmark(np.arange(len(self.clocks_rad) + len(self.features.across_px)), 0)

    def _nearest_at_benchmark(
        self, index: NDArray[np.intp], beside: int
    ) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        before = self.benchmark_residuals
        last = len(before.index) - 1
        at = np.minimum(np.searchsorted(before.index, index), last)
        lower = np.maximum(at - 1, 0)
        at = np.where(np.abs(before.index[lower] - index) < np.abs(before.index[at] - index), lower, at)
        there = np.abs(before.index[at] - index) <= beside
        return np.where(there, before.residual_px[at], np.nan), before.sd_px[at], at

    @cached_property
    def _waves(self) -> FloatArray:
        """Waves (n, 12) round the shell at all features; see `waves_round`."""
        points = self.features.points_shell_m
        return waves_round(lv_clock(points[:, 1:]), self.view.from_ring_m(points))

    @cached_property
    def _shape_sd(self) -> FloatArray:
        """A priori sd of flattening, joint station, lobes (12) and light (3) of a frame against the benchmark."""
        apriori = self.apriori
        light = [np.sqrt(2.0) * apriori.edge_px] * 3
        return np.array([apriori.flattening_rad, apriori.joint_station_m, *apriori.lobe_sd_rad, *light])

    def _shape_prior(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Prior mean and sd of the shape, which must not absorb what an assumed plane (k = 1) cannot explain."""
        return np.zeros(len(self._shape_sd)), self._shape_sd * (1.0 if k == 2 else 1e-3)

    def _prior_about(self, both: Solution) -> tuple[FloatArray, FloatArray]:
        """Prior mean and sd of the shape that the edge alone sees: lobes about those of edge and features together.

        Free lobes would let half of an edge agree with features that are a degree off, and so would lobes that no shell
        has.
        """
        mean, sd = self._shape_prior(2)
        if np.sum((both.shape_found / sd) ** 2) < WORST_SHAPE:
            mean[LOBES] = both.shape_found[LOBES]
        sd[LOBES] = self.apriori.higher_lobes_rad
        return mean, sd

    def _fit_points(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray,
        basis: FloatArray, prior: tuple[FloatArray, FloatArray] | None = None,
    ) -> Fitted:  # fmt: skip
        """Fit ``deformation`` (3,) in place to the edge and, where given, the found features."""
        view, k, lines = self.view, basis.shape[1], len(self.clocks_rad)
        edge_offset, before_sd, edge_at = self._at_benchmark(horizon.line, BESIDE if horizon.is_by_hand else 0)
        edge = (horizon.points_px, light_columns(view, horizon), np.hypot(horizon.sd_px, before_sd), edge_offset)
        # one that is not found has an infinite sd, and no weight
        found, features = 0, _NO_FEATURES
        if place is not None:
            there, before_sd, at = self._every_place_at_benchmark
            sd, painted, found = np.hypot(place[1], before_sd[lines:]), self.features, len(found_rows(place))
            features = (painted.points_shell_m, painted.across_px, place[0], sd, there[lines:], self._waves)
            edge_at = np.concatenate([edge_at, at[lines:]])
        prior = prior or self._shape_prior(k)
        count = len(edge_at)
        residual, left, weight = np.empty((3, count))
        rows, shape = np.zeros((count, 16)), np.zeros((count, _fit_kernels.SHAPES))
        least = least_points(horizon)
        limits = (HUBER, OUTLIER_PX, LAST_STEP_RAD, STEPS, 0 if found >= LEAST_FEATURES else least)
        state, number = _fit_kernels.fit_frame(
            deformation, np.ascontiguousarray(basis), view.shell_terms, view.camera.lens_terms, edge, features, prior,
            limits, residual, rows, shape, weight, left,
        )  # fmt: skip
        if state == _fit_kernels.TOO_FEW:
            raise NoFitError(
                f"{number} edge points also found at the benchmark where {least} are needed",
                "edge-points-too-few",
            )
        if state == _fit_kernels.DIVERGED:
            raise NoFitError("the fit diverged beyond 28 deg", "fit-diverged")
        return Fitted(residual, left, rows, shape, weight, edge_at, len(edge_offset))

    def _solve(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray,
        basis: FloatArray, worst_rms_px: float, prior: tuple[FloatArray, FloatArray] | None = None,
    ) -> Solution:  # fmt: skip
        """Fit as `_fit_points`, with its covariance; `NoFitError` where the residuals are too large."""
        k = basis.shape[1]
        _, sd = prior = prior or self._shape_prior(k)
        found = self._fit_points(horizon, place, deformation, basis, prior)
        n, width = len(found.weight), k + len(sd)
        columns, at, rows = np.empty((n, width)), np.empty(n, dtype=np.intp), np.empty((n, found.rows.shape[1]))
        residual, weight = np.empty((2, n))
        count, square = _fit_kernels.used_points(
            np.ascontiguousarray(basis), found.rows, found.shape, found.residual_px, found.left_px, found.weight,
            columns, (at, rows, residual, weight),
        )  # fmt: skip
        least = min(least_points(horizon), LEAST_FEATURES)
        if count < least:
            raise NoFitError(
                f"{count} edge points and features agree with one deflection where {least} are needed",
                "edge-points-too-few",
            )
        rms = float(np.sqrt(square))
        if rms > worst_rms_px:
            raise NoFitError(
                f"the edge is not the shell's: rms {rms:.1f} px where {worst_rms_px} px are allowed", "edge-not-shell"
            )
        columns, at, rows = columns[:count], at[:count], rows[:count]
        residual, weight = residual[:count], weight[:count]
        formal, step = np.empty((width, width)), np.empty(width)
        _fit_kernels.solved(columns, residual, weight, prior, float(deformation[2]), formal, step)
        before = self.benchmark_residuals.rows[found.benchmark_at[at]]
        edge_count = int(np.searchsorted(at, found.edge_points))
        # the flattening's value was carried from step to step, the others are counted from zero in each
        shape_found = step[k:]
        shape_found[0] += deformation[2]
        return Solution(
            (formal @ columns.T) * weight,
            formal,
            shape_found,
            columns,
            rows,
            before,
            edge_count,
            rms,
            residual,
            weight,
            at[edge_count:] - found.edge_points,
        )

    @cached_property
    def _light_shift(self) -> FloatArray:
        """Of rows (n, 3), painted features: texture leaves out what the light may shift, and an analyst sees marks."""
        painted = np.arange(len(self.features.across_px)) < self.painted_rows
        return np.where(painted[:, None], light_shift(self.view, self.features), 0.0)

    def _edge_step(self, both: Solution, flattening_rad: float) -> tuple[FloatArray, Solution]:
        """One step (2,) from an answer of edge and features to that of the edge alone, and its gain and covariance."""
        edge, (mean, sd) = slice(0, both.edge_count), self._prior_about(both)
        design, weight = both.columns[edge], both.weight[edge]
        formal, step = np.empty_like(both.formal), np.empty(len(both.formal))
        _fit_kernels.solved(design, both.residual_px[edge], weight, (mean, sd), flattening_rad, formal, step)
        # features that contradict the edge leave it residuals that are none of its scatter
        left = both.residual_px[edge] - design @ step
        scatter = float(weight @ left**2) / max(float(weight @ both.residual_px[edge] ** 2), 1e-12)
        # of the deflection's own rows alone, which is all that is asked of it
        alone = replace(
            both, gain=(formal[:2] @ design.T) * weight, formal=np.asarray(min(scatter, 1.0) * formal),
            rows=both.rows[edge], before=both.before[edge], feature_rows=both.feature_rows[:0],
        )  # fmt: skip
        return step[:2], alone

    def _answer(
        self, horizon: HorizonLine, deformation: FloatArray, last: Solution, basis: FloatArray, moved_var: float
    ) -> FrameFit:
        k, by_camera = basis.shape[1], last.by_pose
        by_benchmark = last.by_deflection + by_camera @ self.posed_per_deflection
        features, shape, leak = len(last.feature_rows), None, 0.0
        light = np.sqrt(2.0) * self.apriori.features_px * self._light_shift[last.feature_rows]  # of two frames
        by_light = last.gain[:, last.edge_count :] @ light
        covariance = self.covariance_of(last.formal[:k, :k], by_camera[:k], by_benchmark[:k])
        covariance = covariance + by_light[:k] @ by_light[:k].T
        if k == 1:
            spread = last.gain[:1] @ last.columns[:, 1:] * self._shape_sd
            covariance = covariance + spread @ spread.T
            # a plane grows by +90 deg as its axis rotates from (y, z) to (-z, y)
            leak = float(last.gain[0] @ last.rows[:, DEFLECTION] @ np.array([-basis[1, 0], basis[0, 0]]))
        else:
            found = np.concatenate([deformation[:2], last.shape_found[SHAPE - 2]])
            parts = (part[_ANSWERED] for part in (by_camera, by_benchmark, by_light))
            shape = FrameShape(found, last.formal[_ANSWERED[:, None], _ANSWERED], *parts)
            covariance = covariance + moved_var * np.eye(2)
        answer, flattening = basis @ (basis.T @ deformation[:2]), float(deformation[2])
        return FrameFit(
            answer, covariance, by_benchmark[:k], leak, flattening, last.rms_px, features, horizon, shape=shape,
            moved_var=moved_var,
        )  # fmt: skip

    def covariance_of(self, formal: FloatArray, by_camera: FloatArray, by_benchmark: FloatArray) -> FloatArray:
        """Covariance of an answer with that of the camera's pose and of the benchmark frame's deflection."""
        rest = by_benchmark * self.apriori.benchmark_rad
        return np.asarray(formal + by_camera @ self.posed_covariance @ by_camera.T + rest @ rest.T)

    @cached_property
    def _edge_rms_px(self) -> float:
        """Of the edge in the benchmark frame."""
        edge = self.benchmark_residuals.residual_px[self._benchmark_edge]
        return float(np.sqrt(np.mean(edge**2))) if len(edge) else float("inf")

    def _contradiction(self, difference: FloatArray, edge: Solution, both: Solution) -> float:
        """Chi-square (2) of the difference of two answers, of which one uses a part of the other's points."""
        camera = edge.by_pose[:2] - both.by_pose[:2]
        missing = edge.by_deflection[:2] - both.by_deflection[:2]
        rest = (missing + camera @ self.posed_per_deflection) * self.apriori.benchmark_rad
        covariance = camera @ self.posed_covariance @ camera.T + rest @ rest.T
        # of the best answers, the better one's error has no part in the difference
        covariance += _at_least((edge.formal - both.formal)[:2, :2], _LEAST_VAR)
        (a, b), (c, d) = covariance.tolist()
        y, z = difference.tolist()
        return (d * y * y - (b + c) * y * z + a * z * z) / (a * d - b * c)


def _at_least(matrix: FloatArray, least: float) -> FloatArray:
    """Symmetric matrix (2, 2) with eigenvalues of no less."""
    (a, b), (_, d) = matrix.tolist()
    middle, half = 0.5 * (a + d), float(np.hypot(0.5 * (a - d), b))
    low, high = max(middle - half, least), max(middle + half, least)
    # of the middle's own part and of one along the axes
    share = 0.5 * (high - low) / half if half > 0.0 else 0.0
    return 0.5 * (high + low) * np.eye(2) + share * (matrix - middle * np.eye(2))

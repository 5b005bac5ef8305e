"""What of the shell is found in a frame, and which deflection follows from it?

Where the shell is may be known from the frame before; else it is sought: where most features are found, where the edge
is from far, where the map of features or of the valleys between tori fits (behind the rim may be the Earth, whose limb
is an edge too). Edge and features near there are fitted (`estimators.frame_solution`), each also by itself: where they
contradict each other a whole edge counts, and a frame whose edge is not whole is refused. So is a frame that a
deflection does not explain (`estimators.frame_checks`), or in which the centerbody has moved (`estimators.body_edge`).

Assumed: as in `estimators.frame_solution`.

References
----------
Seed paper, CAD-based estimate.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators.body_edge import UNMOVED, UNSEEN, BodyEdge, MountMotion
from estimators.edge import (
    HorizonLine,
    ScanLines,
    breaks_across,
    fault_of_frame,
    is_coherent,
    no_horizon,
    steepness_of,
)
from estimators.features import Features, ImageFeatures, fit_feature_map, light_shift, valleys
from estimators.frame_checks import USUAL_RMS_PX, WORST_SHAPE, Design, fault_of_fit
from estimators.frame_edits import EditedFrame, MarkedFeatures, unedited
from estimators.frame_residuals import HUBER, FrameResiduals, FrameShape, edge_residuals, light_columns, waves_round
from estimators.frame_solution import (
    CENTRE,
    DIVERGED,
    LAST_STEP_RAD,
    LEAST_FEATURES,
    LEAST_POINTS,
    LOBES,
    OUTLIER_PX,
    SHAPES,
    STEPS,
    TOO_FEW,
    TURN,
    AprioriSd,
    Fitted,
    FrameFit,
    NoFitError,
    Solution,
    fit_frame,
    found_rows,
    least_points,
    refused_fit,
)
from estimators.texture import PaintedTexture
from estimators.virtual_camera import COLUMNS, DEFLECTION, FLATTENING, JOINT, VirtualCamera
from flightmodel.checks import NO_FAULT, BoolArray, FloatArray, Issue
from flightmodel.deflection import lv_clock
from flightmodel.least_squares import Linearised
from flightmodel.statistics import NORMAL_MAD

Image = NDArray[np.uint8]

REACH_PX = 8  # within which features are looked for around their prediction
_WORST_RMS_PX = 2.5  # from where a fit goes on
_OFF_PLANE_PX = 0.5  # left on the edge by a deflection off an assumed plane, and by shapes, of a few tenths of a degree
_FEW_FEATURES = 0.6  # of those found at the benchmark
_FAR_RAD = np.deg2rad([4.0, 4.0])  # about the last answer, which is at most a swing away: IRVE-II's whole deflection
# texture
TEXTURE_REACH_PX = 3  # the edge alone predicts to a pixel
# painted features to a third of one. This share of those found lies within three times that of the texture's answer: in
# sound frames of another renderer 0.86 at the least, where half of the picture is another time's 0.65 to 0.81
_NEAR_PAINT_PX, _PAINTED_PX, _LEAST_PAINTED = 2, 1.0, 0.85
_WORST_TEXTURE_SD_PX = 0.5  # as wide as what agrees: a less sharp patch cannot say whether it does
# root of the number of patches that err together: they overlap, and neighbours see the same light; the likeliest on ten
# films of another renderer
TOGETHER = 2.4
# by chance a sixth of the patches lie within half a pixel of six. Of plain cloth hardly any are found, of these 0.61 at
# the most (0.75 in the benchmark frame's light); of four paints 0.88 (median of 540 frames), 0.69 at the least
_AGREED_PX, _LEAST_AGREED = 0.5, 0.6
# what must agree on a turned camera where no deflection explains it, and how much more than with a deflection alone: of
# light and shade 0.71 at the most, 0.13 more; of paint after the camera moved 0.6 to 0.9, 0.2 to 0.7 more
_AGREED_TURNED, _MORE_TURNED = 0.66, 0.2
_REWEIGHTED = 12  # times, from where the share changes no more
_SOUND_SCORE = 1.5  # the texture agrees with itself
_EDGE_PASSES = 2  # the first may have found points of another edge
_CONTRADICTION = 18.4  # chi-square of two components that one sound frame in 10,000 exceeds
# of two edges' steepness: 33 sound films have 0.84 at the least; blurred after the benchmark frame by 1.5 px (sd) 0.77,
# where answers are right, by 3 px and more 0.72 at the most, where they may be degrees off
_AS_SHARP = 0.74
_SAME_BREAK_PX = 2  # a border's row, compressed otherwise in each frame
_HIDDEN_BREAK = 0.3  # of a row: what is left of it is no break across most of the width
_WHOLE_EDGE = 0.8  # of the benchmark's edge points
_SOUND_EDGE = 0.5  # of the edge in view, for an answer without features
# of the benchmark frame's edge or features, for an answer by both: of 3573 sound answers in spoilt films one shows less
_LITTLE_SEEN = 0.4
# beside hardly any of the features more of the edge is wanted, part of which passes for that of a shell degrees away:
# of 2225 sound answers in spoilt films six show less, four of them with blocks of other frames
_HARDLY_FEATURES, _EDGE_BESIDE = 0.2, 0.7
USUAL_SHARE = 0.75  # features shown by a benchmark frame that is not suspicious

_LEAST_VAR = float(np.deg2rad(0.02) ** 2)  # of a difference: shapes that are not modelled, and points that err alike
_BESIDE = 4  # places of 240 along the edge: a residual of the benchmark frame holds that far for a mark by hand
_OF_LOBES = slice(2, 2 + LOBES)
"""Among flattening, joint station, lobes and light."""
_NO_FEATURES: tuple[FloatArray, ...] = (*(np.zeros((0, k)) for k in (3, 2)), *np.zeros((3, 0)), np.zeros((0, 12)))
_SHAPE = np.array([2, *range(4, 4 + LOBES)])
"""Flattening and lobes among deflection, flattening, joint station, lobes and light."""
_ANSWERED = np.array([0, 1, *_SHAPE])
_NOTHING = no_horizon(NO_FAULT)


@dataclass(frozen=True)
class _Approached:
    """Texture and edge found from a starting point near an answer, and the share of each."""

    place: tuple[FloatArray, FloatArray] | None
    edge: HorizonLine
    agreed: float
    edge_share: float
    is_turned: bool

    @property
    def score(self) -> float:
        """Score by which starting points are ranked: agreeing texture outweighs an edge, which may be the Earth's."""
        return self.edge_share + (1.0 + self.agreed if self.place is not None else 0.0)


@dataclass(frozen=True)
class OrientedCamera:
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
        """Number of leading feature rows that are painted ones."""
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
        """Number of edge points relative to the benchmark frame's; zero if that has none."""
        there = self._edge_at_benchmark
        return points / there if there else 0.0

    def _at_benchmark(
        self, index: NDArray[np.intp], beside: int = 0
    ) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """Benchmark residual (NaN if not found there), sd and row of points, or of places ``beside`` them."""
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
            mean[_OF_LOBES] = both.shape_found[_OF_LOBES]
        sd[_OF_LOBES] = self.apriori.higher_lobes_rad
        return mean, sd

    def _fit_points(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray,
        basis: FloatArray, prior: tuple[FloatArray, FloatArray] | None = None,
    ) -> Fitted:  # fmt: skip
        """Fit ``deformation`` (3,) in place to the edge and, where given, the found features."""
        view, k, lines = self.view, basis.shape[1], len(self.clocks_rad)
        edge_offset, before_sd, edge_at = self._at_benchmark(horizon.line, _BESIDE if horizon.is_by_hand else 0)
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
        rows, shape = np.zeros((count, COLUMNS)), np.zeros((count, SHAPES))
        least = least_points(horizon)
        limits = (HUBER, OUTLIER_PX, LAST_STEP_RAD, STEPS, 0 if found >= LEAST_FEATURES else least)
        state, number = fit_frame(
            deformation, np.ascontiguousarray(basis), view.shell_terms, view.camera.lens_terms, edge, features, prior,
            limits, residual, rows, shape, weight, left,
        )  # fmt: skip
        if state == TOO_FEW:
            raise NoFitError(
                f"{number} edge points also found at the benchmark where {least} are needed",
                "edge-points-too-few",
            )
        if state == DIVERGED:
            raise NoFitError("the fit diverged beyond 28 deg", "fit-diverged")
        return Fitted(residual, left, rows, shape, weight, edge_at, len(edge_offset))

    def _solve(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray,
        basis: FloatArray, worst_rms_px: float, prior: tuple[FloatArray, FloatArray] | None = None,
    ) -> Solution:  # fmt: skip
        """Fit as `_fit_points`, with its covariance; `NoFitError` where the residuals are too large."""
        k = basis.shape[1]
        prior = prior or self._shape_prior(k)
        found = self._fit_points(horizon, place, deformation, basis, prior)
        at = np.flatnonzero(found.weight > 0.0)
        least = min(least_points(horizon), LEAST_FEATURES)
        if len(at) < least:
            raise NoFitError(
                f"{len(at)} edge points and features agree with one deflection where {least} are needed",
                "edge-points-too-few",
            )
        rows, residual, weight = found.rows[at], found.residual_px[at], found.weight[at]
        rms = float(np.sqrt(weight @ found.left_px[at] ** 2 / weight.sum()))
        if rms > worst_rms_px:
            raise NoFitError(
                f"the edge is not the shell's: rms {rms:.1f} px where {worst_rms_px} px are allowed", "edge-not-shell"
            )
        columns = np.column_stack([rows[:, DEFLECTION] @ basis, rows[:, FLATTENING], rows[:, JOINT], found.shape[at]])
        last = _last_step(columns, residual, weight, prior, float(deformation[2]))
        before = self.benchmark_residuals.rows[found.benchmark_at[at]]
        edge_count = int(np.searchsorted(at, found.edge_points))
        # the flattening's value was carried from step to step, the others are counted from zero in each
        shape_found = last.step()[k:]
        shape_found[0] += deformation[2]
        formal = last.covariance
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
        """Light shift of rows (n, 3), non-zero for painted features only: texture and marked features exclude it."""
        painted = np.arange(len(self.features.across_px)) < self.painted_rows
        return np.where(painted[:, None], light_shift(self.view, self.features), 0.0)

    def _edge_step(self, both: Solution, flattening_rad: float) -> tuple[FloatArray, Solution]:
        """One step (2,) from an answer of edge and features to that of the edge alone, and its gain and covariance."""
        edge = slice(0, both.edge_count)
        design, weight = both.columns[edge], both.weight[edge]
        last = _last_step(design, both.residual_px[edge], weight, self._prior_about(both), flattening_rad)
        step, formal = last.step(), last.covariance
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
            found = np.concatenate([deformation[:2], last.shape_found[_SHAPE - 2]])
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
        """Rms residual of the edge in the benchmark frame, px."""
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

    @property
    def has_bad_benchmark(self) -> bool:
        """Whether the benchmark frame shows little of the shell and its residuals are large, or hardly any of it."""
        if self.residual_rms_px > USUAL_RMS_PX:
            return self.support < USUAL_SHARE
        return max(self.support, self.edge_in_view) < _LITTLE_SEEN

    def fit(
        self, picture: Image | EditedFrame, plane_axis: FloatArray | None = None, start: FloatArray | None = None
    ) -> FrameFit:
        """Find the deflection in a frame.

        Parameters
        ----------
        picture : (h, w) uint8, or with what an analyst decided about it
        plane_axis : (2,) float or None
            Rotation vector about body y and z of a unit deflection in the assumed plane; None estimates the plane.
        start : (2,) float, optional
            Where to start, e.g. the answer of the frame before.
        """
        frame = unedited(picture)
        fault = fault_of_frame(frame.kept, self.view.camera.size_px) or self._fault_of_breaks(frame)
        if fault:
            return refused_fit(no_horizon(fault), fault)
        deformation, basis, horizon, moved_var = np.zeros(3), np.eye(2), _NOTHING, 0.0
        deformation[:2] = 0.0 if start is None else start
        with_open_plane: FrameFit | None = None
        mount = self._mount(frame)
        try:
            if self.painted is not None:
                place = self._approach(frame, deformation, self.painted)
                place = self._texture_near(frame, deformation, place) or place
                horizon = frame.near_edge(self.view.lines_at(self.clocks_rad, deformation))
            else:
                seen = self._approach_by_texture(frame, deformation)
                place, horizon = seen.place, seen.edge
            place = frame.with_marked(self.features, place)
            last = self._solve(horizon, place, deformation, basis, _WORST_RMS_PX)
            last = self._reconciled(frame, horizon, place, deformation, last)
            contradicted = place is not None and last.edge_count == len(last.rows)
            if not horizon.is_by_hand:
                if place is not None and not contradicted:
                    self._check_seen(horizon, last)
                self._check_sharp(frame, horizon)
                if mount.px > 0.0 and self._stays(mount, last):
                    mount = UNMOVED
                if mount.px > 0.0 and mount.is_sure:
                    raise NoFitError(
                        f"the centerbody's own edge has moved by {mount.px:.1f} px since the benchmark frame: the "
                        "camera moved in its mount, or the picture was moved",
                        "camera-turned",
                    )
                last, moved_var = self._explained(place, deformation, last)
            if plane_axis is not None:
                # whether this is the shell was tested with both parameters: an assumed plane alone may fit badly;
                # the seed paper's way uses the edge alone
                with_open_plane = self._answer(horizon, deformation, last, basis, moved_var)
                basis = plane_axis[:, None]
                horizon = self.coherent_edge(frame, deformation)
                # what the plane does not explain is more than any point's own error: all count alike
                horizon = replace(horizon, sd_px=np.full_like(horizon.sd_px, _OFF_PLANE_PX))
                deformation[:] = *(basis[:, 0] * (basis[:, 0] @ deformation[:2])), 0.0
                last = self._solve(horizon, None, deformation, basis, np.inf)
        except NoFitError as refusal:
            return refused_fit(horizon, refusal.faults[0], mount.px, mount.is_sure)
        answer = self._answer(horizon, deformation, last, basis, moved_var)
        return replace(
            answer, contradicted=contradicted, mount_px=mount.px, mount_is_sure=mount.is_sure,
            with_open_plane=with_open_plane,
        )  # fmt: skip

    def _fault_of_breaks(self, frame: EditedFrame) -> Issue:
        """Whether the picture breaks across its width where the benchmark frame, which may have a border, does not.

        What is hidden, as a line of text, may be as wide.
        """
        for row in breaks_across(frame.kept):
            hidden = 0.0 if frame.hidden is None else float(frame.hidden[row : row + 2].mean())
            if hidden < _HIDDEN_BREAK and not np.any(np.abs(self.breaks - row) <= _SAME_BREAK_PX):
                words = f"breaks across its width after row {row}, as the benchmark frame does not: rolled, or torn"
                return Issue(words, "frame-broken")
        return NO_FAULT

    def _explained(
        self, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray, both: Solution
    ) -> tuple[Solution, float]:
        """Solution by edge and features, or by most features alone if clouds pass for the edge; else `NoFitError`.

        Last: variance by a motion of the picture that may be.
        """
        try:
            return both, self._check_explained(both)
        except NoFitError as fault:
            if fault.codes != ("edge-not-shell",) or place is None or not self._shows_most(found_rows(place)):
                raise
        alone = self._solve(_NOTHING, place, deformation, np.eye(2), USUAL_RMS_PX)
        return alone, self._check_explained(alone)

    def _check_explained(self, last: Solution) -> float:
        """Refuse a frame that no deflection explains; variance due to a possible motion: `estimators.frame_checks`."""
        design = self._design(last)
        shape = last.shape_found / self._shape_sd
        fault, variance = fault_of_fit(design, last.rms_px, shape, self.apriori.higher_lobes_rad)
        if fault:
            raise NoFitError(fault)
        return variance

    def _design(self, last: Solution) -> Design:
        rows, focal = last.rows, float(self.view.camera.focal_px[0])
        return Design(
            last.columns, last.formal, rows[:, TURN], rows[:, CENTRE], focal, last.residual_px, last.weight,
            last.edge_count,
        )  # fmt: skip

    def _stays(self, mount: MountMotion, last: Solution) -> bool:
        """Whether edge and features do not follow a motion of the centerbody's edge, which then is a shadow's.

        Of one that is farther than features are looked for, it is not known what was found.
        """
        design, camera = self._design(last), self.view.camera
        places = camera.centre_px + design.focal_px * np.column_stack(design.places)
        moved = mount.of_points(places, design.across)
        return bool(np.abs(moved).max() < REACH_PX) and design.speaks_against(moved)

    def _shows_most(self, rows: NDArray[np.intp]) -> bool:
        """Whether the found feature rows (n,) are enough, and most of those of their kind in the benchmark frame."""
        return len(rows) > max(USUAL_SHARE * self._alike_at_benchmark(rows), LEAST_FEATURES)

    def _alike_at_benchmark(self, rows: NDArray[np.intp]) -> int:
        """Features of the benchmark frame of the kind of rows (n,)."""
        return self.features_at_benchmark(bool(len(rows)) and bool(rows[0] < self.painted_rows))

    def _check_seen(self, horizon: HorizonLine, last: Solution) -> None:
        """Refuse a frame in which little is found: so few points may agree by chance."""
        of_features = len(last.feature_rows) / max(self._alike_at_benchmark(last.feature_rows), 1)
        of_edge = self._edge_share(len(horizon.points_px))
        wanted = _EDGE_BESIDE if of_features < _HARDLY_FEATURES else _LITTLE_SEEN
        if max(of_edge, of_features) < wanted:
            raise NoFitError(
                f"{100.0 * of_edge:.0f} % of the benchmark frame's edge and {100.0 * of_features:.0f} % of its "
                f"features are seen where {100.0 * wanted:.0f} % of one are needed",
                "shell-little-seen",
            )

    def _check_sharp(self, frame: EditedFrame, horizon: HorizonLine) -> None:
        """Refuse a frame whose edge is sharper or blurrier than the benchmark's: shading shifts wide steps."""
        steepness = steepness_of(frame.kept, horizon)
        # no comparison with NaN is true: of too few points nothing is said
        if min(steepness, self.steepness) < _AS_SHARP * max(steepness, self.steepness):
            raise NoFitError(
                f"the edge rises over its middle pixel by {100.0 * steepness:.0f} % of its step, the benchmark frame's "
                f"by {100.0 * self.steepness:.0f} %: one of the two is out of focus",
                "edge-blurred",
            )

    def _mount(self, frame: EditedFrame) -> MountMotion:
        if self.body is None:
            return UNSEEN
        return self.body.moved(frame.kept, frame.is_clear(self.body.lines.origin_px))

    def points_at(
        self, picture: Image | EditedFrame, own: FloatArray, tried: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Edge points and features found near a deformation (3,), and how far they are from another one.

        Returns
        -------
        edge, features : (n, 6) float
            Place found, unit vector along which it is measured, residual against the tried deformation beyond the
            benchmark frame's, px; whether a fit at the first one uses it.
        """
        frame = unedited(picture)
        found = frame.near_edge(self.view.lines_at(self.clocks_rad, own))
        own_residual = edge_residuals(self.view, found, own).residual_px
        coherent = np.isfinite(own_residual) if found.is_by_hand else is_coherent(found.line, own_residual)
        offset, _, _ = self._at_benchmark(found.line, _BESIDE if found.is_by_hand else 0)
        residual = edge_residuals(self.view, found, tried).residual_px - offset
        edge = np.column_stack([found.points_px, found.inward_px, residual, coherent & np.isfinite(residual)])
        place, sd = frame.features(self.features, self.view, own, REACH_PX)
        place, sd = frame.with_marked(self.features, (place, sd)) or (place, sd)
        has = np.flatnonzero(np.isfinite(sd))
        across = self.features.across_px[has]
        (off, there), (residual, _) = (self._features_off(place, has, d) for d in (own, tried))
        at = there + off[:, None] * across
        return edge, np.column_stack([at, across, residual, np.abs(off) < OUTLIER_PX])

    def _features_off(
        self, place: FloatArray, rows: NDArray[np.intp], deformation: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Residuals (n,) of rows of features beyond the benchmark frame's, NaN where not found there; pixels (n, 2)."""
        there = self.view.sight(self.features.points_shell_m[rows], deformation).pixels
        offset, _, _ = self._at_benchmark(len(self.clocks_rad) + rows)
        return place[rows] - np.einsum("ni,ni->n", there, self.features.across_px[rows]) - offset, there

    def _reconciled(
        self, frame: EditedFrame, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None,
        deformation: FloatArray, both: Solution,
    ) -> Solution:  # fmt: skip
        """Edge and features where they agree, the edge alone where they contradict each other and it is whole.

        `NoFitError` where they contradict each other and it is not.
        """
        seen = both.edge_count / len(self.clocks_rad)
        if place is None and seen < _SOUND_EDGE and not horizon.is_by_hand:
            raise NoFitError(
                f"no feature agrees, and {100.0 * seen:.0f} % of the edge in view can be used where "
                f"{100.0 * _SOUND_EDGE:.0f} % are needed",
                "edge-too-short",
            )
        rms = max(both.rms_px, self._edge_rms_px)
        if place is None and rms > USUAL_RMS_PX and not horizon.is_by_hand:
            raise NoFitError(
                f"no feature agrees, and the edge alone has an rms of {rms:.1f} px, here or in the benchmark frame, "
                f"where {USUAL_RMS_PX:.1f} px are allowed",
                "edge-not-shell",
            )
        if place is None:
            return both
        # to first order, which takes a tenth of a fit's time, then in full where that is not clear
        if both.edge_count >= least_points(horizon):
            step, alone_near = self._edge_step(both, deformation[2])
            if self._contradiction(step, alone_near, both) < 0.5 * _CONTRADICTION:
                return both
        alone = deformation.copy()
        try:
            near = self._independent_edge(frame, horizon, alone)
            edge = self._solve(near, None, alone, np.eye(2), np.inf, self._prior_about(both))
        except NoFitError:
            # steps in the clouds are no edge to contradict anything
            return both
        share = self._edge_share(edge.edge_count)
        square = self._contradiction(alone[:2] - deformation[:2], edge, both)
        if square < _CONTRADICTION:
            return both
        if share < _WHOLE_EDGE or edge.rms_px > USUAL_RMS_PX:
            raise NoFitError(
                f"edge and features contradict each other (chi-square {square:.0f} of 2), and {100.0 * share:.0f} % of "
                "the edge are too few to go by",
                "features-contradict-edge",
            )
        deformation[:] = alone
        return self._solve(near, None, deformation, np.eye(2), np.inf)

    def _texture_near(
        self, frame: EditedFrame, deformation: FloatArray, painted: tuple[FloatArray, FloatArray] | None
    ) -> tuple[FloatArray, FloatArray] | None:
        """Places of the texture behind ``painted`` features, near their answer; None where it cannot take their place.

        Hardly any of it may agree, or only what lies in a part of the picture, which then is another time's: the
        painted features must be where the texture puts the shell.
        """
        if not isinstance(self.unmarked, PaintedTexture) or painted is None:
            return None
        texture, count = self.unmarked.texture, len(self.features.across_px)
        place, sd = np.zeros(count), np.full(count, np.inf)
        rows = slice(self.painted_rows, self.painted_rows + len(texture.across_px))
        place[rows], sd[rows] = frame.features(texture, self.view, deformation, _NEAR_PAINT_PX)
        moved = deformation.copy()
        agreed, _, _ = self._agreeing((place, sd), moved)
        if agreed is None or len(found_rows(agreed)) < _HARDLY_FEATURES * self.features_at_benchmark(painted=False):
            return None
        off, _ = self._features_off(painted[0], found_rows(painted), moved)
        known = np.isfinite(off).sum()  # also found in the benchmark frame
        return agreed if (np.abs(off) < _PAINTED_PX).sum() > _LEAST_PAINTED * known else None

    def _approach_by_texture(self, frame: EditedFrame, deformation: FloatArray) -> _Approached:
        """Move ``deformation`` in place to where the texture agrees with itself, else to where the edge is.

        Where the search starts, then where the edge is found from far, then where the valleys between tori fit: the
        first place is taken that is sound, else the one that shows most.
        """
        best: tuple[float, FloatArray, _Approached] | None = None
        turned = False
        trouble = Issue("no edge near where one is expected", "edge-not-clear")
        for guess, reaches_px in self._guesses(frame, deformation.copy()):
            moved = guess.copy()
            try:
                seen = self._seen_from(frame, moved, reaches_px)
            except NoFitError as fault:
                trouble = fault.faults[0]
                continue
            turned |= seen.is_turned
            if best is None or seen.score > best[0]:
                best = (seen.score, moved, seen)
            if seen.score > _SOUND_SCORE:
                break
        if best is None:
            raise NoFitError(trouble)
        if turned and best[2].place is None:
            words = (
                "the texture agrees with the benchmark frame's as seen by a camera that turned, and with no deflection"
            )
            raise NoFitError(words, "camera-turned")
        deformation[:] = best[1]
        return best[2]

    def _guesses(self, frame: EditedFrame, start: FloatArray) -> Iterator[tuple[FloatArray, tuple[int, ...]]]:
        """Deformations (3,) to start from, likeliest first; computed lazily.

        With each, how far texture is looked for, first and then: where it need not be, shades are found that stay.
        """
        from_far = (REACH_PX, TEXTURE_REACH_PX)
        yield start, from_far
        coarse = frame.far_edge(self.lines, self.view.camera.size_px)
        if coarse.is_usable:
            edge_alone = np.zeros(3)
            with suppress(NoFitError):
                self._fit_points(coarse, None, edge_alone, np.eye(2))
                yield edge_alone, (TEXTURE_REACH_PX, TEXTURE_REACH_PX)
        for fitted in self._where_map_fits(frame.image, valleys(self.view), start):
            yield fitted, from_far

    def _where_map_fits(self, image: Image, painted: ImageFeatures, start: FloatArray) -> Iterator[FloatArray]:
        """Deformation (3,) at which features fit the frame best, where that is significant."""

        def pixels(turned: FloatArray) -> FloatArray:
            return self.view.pixels_of_each(painted.points_shell_m, np.pad(turned, ((0, 0), (0, 1))))

        fitted = fit_feature_map(image, pixels, [start[:2].copy()], _FAR_RAD, painted.signs)
        if fitted is not None:
            yield np.array([*fitted, 0.0])

    def _seen_from(self, frame: EditedFrame, deformation: FloatArray, reaches_px: tuple[int, ...]) -> _Approached:
        """Texture and edge near a guess, which is moved in place to where they are; `NoFitError` without either."""
        for reach in reaches_px:
            found = frame.features(self.features, self.view, deformation, reach)
            if len(found_rows(found)) >= LEAST_FEATURES:
                self._fit_points(_NOTHING, found, deformation, np.eye(2))
        place, agreed, is_turned = self._agreeing(found, deformation.copy())
        if place is not None:
            self._fit_points(_NOTHING, place, deformation, np.eye(2))
        near = self.coherent_edge(frame, deformation)
        if place is None:
            for _ in range(_EDGE_PASSES):
                self._solve(near, None, deformation, np.eye(2), _WORST_RMS_PX)
                near = self.coherent_edge(frame, deformation)
        return _Approached(place, near, agreed, self._edge_share(len(near.points_px)), is_turned)

    def coherent_edge(self, frame: EditedFrame, deformation: FloatArray) -> HorizonLine:
        """Edge near where a deformation (3,) puts it, without points that stand off their neighbours."""
        near = frame.near_edge(self.view.lines_at(self.clocks_rad, deformation))
        if near.is_by_hand:
            return near
        residual = edge_residuals(self.view, near, deformation).residual_px
        return near.some(is_coherent(near.line, residual))

    def _agreeing(
        self, found: tuple[FloatArray, FloatArray], deformation: FloatArray
    ) -> tuple[tuple[FloatArray, FloatArray] | None, float, bool]:
        """Places of the texture that agree on one deformation, None where too few do; the share that does.

        ``deformation`` is moved there. Last: whether they agree on a turn of the camera instead.
        """
        sharp = found[0], np.where(found[1] < _WORST_TEXTURE_SD_PX, found[1], np.inf)
        has = found_rows(sharp)
        if len(has) < LEAST_FEATURES:
            return None, 0.0, False
        fitted = self._fit_points(_NOTHING, sharp, deformation, np.eye(2))
        off = np.abs(fitted.left_px[has])
        agreed = float(np.mean(off < _AGREED_PX))
        if agreed < _LEAST_AGREED:
            turned = _agreed_turned(fitted)
            return None, agreed, turned > _AGREED_TURNED and turned > agreed + _MORE_TURNED
        scale = NORMAL_MAD * float(np.nanmedian(off))
        inflated = max(NORMAL_MAD * float(np.nanmedian(off / sharp[1][has])), 1.0)
        rows = has[off < max(3.0 * scale, 0.3)]
        kept = np.full_like(sharp[1], np.inf)
        kept[rows] = TOGETHER * inflated * sharp[1][rows]
        return (sharp[0], kept), agreed, False

    def _approach(
        self, frame: EditedFrame, deformation: FloatArray, painted: ImageFeatures
    ) -> tuple[FloatArray, FloatArray] | None:
        """Move ``deformation`` in place to within a pixel or two, and find the features there; None where few.

        From where the search starts, if most features are found there; else from where the edge is found or where the
        feature map fits, whichever shows most: behind the rim may be the Earth, whose limb is an edge too.
        """
        wanted = _FEW_FEATURES * self.features_at_benchmark(painted=True)
        guesses = [deformation.copy()]
        found = [frame.features(self.features, self.view, deformation, REACH_PX)]
        trouble = NO_FAULT
        if len(found_rows(found[0])) < max(wanted, LEAST_FEATURES):
            coarse = frame.far_edge(self.lines, self.view.camera.size_px)
            trouble = coarse.refused
            edge_alone = deformation.copy()
            try:
                if coarse.is_usable:
                    self._fit_points(coarse, None, edge_alone, np.eye(2))
                    guesses.append(edge_alone)
                    found.append(frame.features(self.features, self.view, edge_alone, REACH_PX))
            except NoFitError as fault:
                trouble = fault.faults[0]
        if max(len(found_rows(f)) for f in found) < wanted:
            for fitted in self._where_map_fits(frame.image, painted, deformation):
                guesses.append(fitted)
                found.append(frame.features(self.features, self.view, guesses[-1], REACH_PX))
        best = int(np.argmax([len(found_rows(f)) for f in found]))
        if len(found_rows(found[best])) >= LEAST_FEATURES:
            deformation[:] = guesses[best]
            self._fit_points(_NOTHING, found[best], deformation, np.eye(2))
            return frame.features(self.features, self.view, deformation, REACH_PX)
        if trouble:
            raise NoFitError(trouble)
        deformation[:] = guesses[1]
        return None

    def _independent_edge(self, frame: EditedFrame, horizon: HorizonLine, deformation: FloatArray) -> HorizonLine:
        """Edge found independently of the features, ``deformation`` moved near it; `NoFitError` if there is none.

        What was found near the features' answer where that is an edge, not steps in the clouds; else found from far.
        """
        if horizon.is_by_hand:
            return horizon
        near = horizon.some(is_coherent(horizon.line, edge_residuals(self.view, horizon, deformation).residual_px))
        if len(near.points_px) >= LEAST_POINTS:
            return near
        far = frame.far_edge(self.lines, self.view.camera.size_px)
        if far.refused:
            raise NoFitError(far.refused)
        moved = np.zeros(3)
        self._solve(far, None, moved, np.eye(2), _WORST_RMS_PX)
        deformation[:] = moved
        return self.coherent_edge(frame, deformation)


def _last_step(
    columns: FloatArray, residual: FloatArray, weight: FloatArray, prior: tuple[FloatArray, FloatArray],
    flattening_rad: float,
) -> Linearised:  # fmt: skip
    """Last step of a fit, of deflection, flattening, joint, lobes and light, with the prior of all but the deflection.

    The flattening comes on top of what it was before, the others are counted from zero.
    """
    mean, sd = prior
    free = columns.shape[1] - len(sd)
    information, off = np.zeros((columns.shape[1],) * 2), np.zeros(columns.shape[1])
    np.fill_diagonal(information[free:, free:], sd**-2.0)
    off[free:] = -mean
    off[free] += flattening_rad
    return Linearised.of(residual, columns, weight, information, off)


def _at_least(matrix: FloatArray, least: float) -> FloatArray:
    """Symmetric matrix (2, 2) with eigenvalues of no less."""
    (a, b), (_, d) = matrix.tolist()
    middle, half = 0.5 * (a + d), float(np.hypot(0.5 * (a - d), b))
    low, high = max(middle - half, least), max(middle + half, least)
    # of the middle's own part and of one along the axes
    share = 0.5 * (high - low) / half if half > 0.0 else 0.0
    return 0.5 * (high + low) * np.eye(2) + share * (matrix - middle * np.eye(2))


def _agreed_turned(fitted: Fitted) -> float:
    """Share of points that agree on the camera's turn and zoom beside a deflection (Geman and McClure's weights)."""
    seen = np.isfinite(fitted.left_px) & np.isfinite(fitted.rows).all(axis=1)
    left, by = fitted.left_px[seen], np.column_stack([fitted.rows[seen, DEFLECTION], fitted.rows[seen, TURN]])
    if len(left) < LEAST_FEATURES:
        return 0.0
    by = by / np.abs(by).max(axis=0)
    weight, rest = np.ones(len(left)), left
    for _ in range(_REWEIGHTED):
        rest = left - by @ np.linalg.lstsq(by * weight[:, None], left * weight, rcond=None)[0]
        scale = max(NORMAL_MAD * float(np.median(np.abs(rest))), _AGREED_PX / 2.0)
        weight = 1.0 / (1.0 + (rest / scale) ** 2)
    return float(np.mean(np.abs(rest) < _AGREED_PX))

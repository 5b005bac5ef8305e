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

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimators import _fit_kernels
from estimators.edge import (
    NO_FAULT,
    HorizonLine,
    ScanLines,
    breaks_across,
    fault_of_frame,
    is_coherent,
    no_horizon,
)
from estimators.features import Features, ImageFeatures, fit_feature_map, light_shift, valleys
from estimators.frame_checks import USUAL_RMS_PX, WORST_SHAPE, Design, fault_of_fit
from estimators.frame_edits import LEAST_MARKS, EditedFrame, MarkedFeatures, unedited
from estimators.frame_residuals import (
    HUBER,
    ROUND_WAVES,
    WAVES,
    FrameResiduals,
    FrameShape,
    edge_residuals,
    light_columns,
)
from estimators.virtual_camera import CAMERA, DEFLECTION, FLATTENING, HELD, VirtualCamera
from flightmodel.checks import BoolArray, Fault, FloatArray, GateError

Image = NDArray[np.uint8]

STEPS = 12
LAST_STEP_RAD = 2e-5
OUTLIER_PX = 5.0
REACH_PX = 8  # within which features are looked for around their prediction
_WORST_RMS_PX = 2.5  # from where a fit goes on
_OFF_PLANE_PX = 0.5  # left on the edge by a deflection off an assumed plane, and by shapes, of a few tenths of a degree
LEAST_POINTS, _LEAST_FEATURES = 60, 40
_FEW_FEATURES = 0.6  # of those found at the benchmark
_FAR_RAD = np.deg2rad([4.0, 4.0])
# texture
TEXTURE_REACH_PX = 3  # the edge alone predicts to a pixel
_WORST_TEXTURE_SD_PX = 0.5
TOGETHER = 3.0  # root of the number of patches that err together: they overlap, and their neighbours see the same light
# by chance a sixth of the patches lie within half a pixel of six; of light and shade on plain cloth, which seem to move
# as the Sun does, 0.55 do (median, 0.66 at the most), of eight paints 0.79 (median, 0.6 at the least)
_AGREED_PX, _LEAST_AGREED = 0.5, 0.6
_SOUND_SCORE = 1.5  # the texture agrees with itself
_EDGE_PASSES = 2
_CONTRADICTION = 18.4  # chi-square of two components that one sound frame in 10,000 exceeds
_LEAST_VAR = float(np.deg2rad(0.02) ** 2)  # of a difference: shapes that are not modelled, and points that err alike
_SAME_BREAK_PX = 2
_BESIDE = 4  # places of 240 along the edge: a residual of the benchmark frame holds that far for a mark by hand
_WHOLE_EDGE = 0.8  # of the benchmark's edge points
_SOUND_EDGE = 0.5  # of the edge in view, for an answer without features
USUAL_SHARE = 0.75  # features shown by a benchmark frame that is not suspicious
JOINT = HELD.stop - 1
POSED = slice(CAMERA.start, JOINT)
TURN, CENTRE = slice(CAMERA.start, CAMERA.start + 4), slice(CAMERA.start + 4, CAMERA.start + 6)
_SOFT_WAVES = 3  # a ring's stiffness grows as (n^2 - 1)^2: 9, 64, 225, 576
LOBES = slice(2, 2 + _fit_kernels.LOBES)
"""Among flattening, joint station, lobes and light."""
SHAPE = np.array([2, *range(4, 4 + _fit_kernels.LOBES)])
"""Flattening and lobes among deflection, flattening, joint station, lobes and light."""


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
    refused : Fault
        Why there is no answer; empty when there is one.
    contradicted : bool
        Whether a whole edge alone gave the answer, against the features.
    shape : FrameShape or None
        None in an assumed plane.
    by_shape : (2, 13 (1 + c)) float or None
        Error per unit error of the shell's shape under load as the film determined it, where that was used.
    """

    rotation_yz_rad: FloatArray
    covariance: FloatArray
    per_benchmark: FloatArray
    plane_leak: float
    flattening_rad: float
    residual_rms_px: float
    features: int
    horizon: HorizonLine
    refused: Fault = NO_FAULT
    contradicted: bool = False
    shape: FrameShape | None = None
    by_shape: FloatArray | None = None


_NOTHING = no_horizon(NO_FAULT)


class _NoFitError(GateError):
    """The found points do not fit the model."""


@dataclass(frozen=True)
class _Solution:
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


@dataclass(frozen=True)
class _Points:
    """Edge points, which come first, and features at the end of a fit; ``benchmark_at``: their rows there.

    ``left_px``: residuals less what the shell's lobes, the joint's station and the light explain.
    """

    residual_px: FloatArray
    left_px: FloatArray
    rows: FloatArray
    shape: FloatArray
    weight: FloatArray
    benchmark_at: NDArray[np.intp]
    edge_points: int


@dataclass(frozen=True)
class _Approached:
    """What is seen from near an answer: texture that agrees, the edge, and the share of each."""

    place: tuple[FloatArray, FloatArray] | None
    edge: HorizonLine
    agreed: float
    edge_share: float

    @property
    def score(self) -> float:
        """Texture that agrees outweighs an edge, which may be the Earth's."""
        return self.edge_share + (1.0 + self.agreed if self.place is not None else 0.0)


def _has(found: tuple[FloatArray, FloatArray]) -> NDArray[np.intp]:
    """Rows of features that were found."""
    return np.flatnonzero(np.isfinite(found[1]))


def _least_points(horizon: HorizonLine) -> int:
    """How many edge points a fit needs."""
    return LEAST_MARKS if horizon.is_by_hand else LEAST_POINTS


def refused_fit(horizon: HorizonLine, reason: Fault) -> FrameFit:
    """Return the fit of a frame that has no answer."""
    nan = np.full((2, 2), np.nan)
    return FrameFit(nan[0], nan, nan, 0.0, float("nan"), float("nan"), 0, horizon, reason)


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
    stated_refused : Fault
        Why the features that the vehicle file states are not used; empty where they are, or where it states none.
    support : float
        Share of what the orientation looked for on the shell, features or the valleys between tori, that the benchmark
        frame shows.
    breaks : (m,) int
        Rows after which the benchmark frame breaks across its width.
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
    stated_refused: Fault = NO_FAULT
    support: float = 1.0
    breaks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp), repr=False)

    @cached_property
    def _benchmark_edge(self) -> BoolArray:
        """Which of the points found in the benchmark frame are the edge's, the others are features."""
        return np.asarray(self.benchmark_residuals.index < len(self.clocks_rad))

    def _edge_share(self, points: int) -> float:
        """So many edge points over those of the benchmark frame."""
        return points / max(int(self._benchmark_edge.sum()), 1)

    @property
    def has_bad_benchmark(self) -> bool:
        """Whether the benchmark frame shows little of the shell and its residuals are large."""
        return self.residual_rms_px > USUAL_RMS_PX and self.support < USUAL_SHARE

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
        fault = fault_of_frame(frame.image, self.view.camera.size_px) or self._fault_of_breaks(frame.image)
        if fault:
            return refused_fit(no_horizon(fault), fault)
        deformation, basis, horizon = np.zeros(3), np.eye(2), _NOTHING
        deformation[:2] = 0.0 if start is None else start
        try:
            painted = self.features.found if isinstance(self.features, MarkedFeatures) else self.features
            if isinstance(painted, ImageFeatures) and len(painted.points_shell_m):
                place = self._approach(frame, deformation, painted)
                horizon = frame.near_edge(self.view.lines_at(self.clocks_rad, deformation))
            else:
                seen = self._approach_by_texture(frame, deformation)
                place, horizon = seen.place, seen.edge
            place = frame.with_marked(self.features, place)
            last = self._solve(horizon, place, deformation, basis, _WORST_RMS_PX)
            last = self._reconciled(frame, horizon, place, deformation, last)
            contradicted = place is not None and last.edge_count == len(last.rows)
            if not horizon.is_by_hand:
                last = self._explained(place, deformation, last)
            if plane_axis is not None:
                # whether this is the shell was tested with both parameters: an assumed plane alone may fit badly;
                # the seed paper's way uses the edge alone
                basis = plane_axis[:, None]
                horizon = self.coherent_edge(frame, deformation)
                # what the plane does not explain is more than any point's own error: all count alike
                horizon = replace(horizon, sd_px=np.full_like(horizon.sd_px, _OFF_PLANE_PX))
                deformation[:] = *(basis[:, 0] * (basis[:, 0] @ deformation[:2])), 0.0
                last = self._solve(horizon, None, deformation, basis, np.inf)
        except _NoFitError as refusal:
            return refused_fit(horizon, refusal.faults[0])
        return replace(self._answer(horizon, deformation, last, basis), contradicted=contradicted)

    def _fault_of_breaks(self, image: Image) -> Fault:
        """Whether the picture breaks across its width where the benchmark frame, which may have a border, does not."""
        for row in breaks_across(image):
            if not np.any(np.abs(self.breaks - row) <= _SAME_BREAK_PX):
                words = f"breaks across its width after row {row}, as the benchmark frame does not: rolled, or torn"
                return Fault(words, "frame-broken")
        return NO_FAULT

    def _explained(
        self, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray, both: _Solution
    ) -> _Solution:
        """Edge and features, or most features alone if clouds along the edge pass for a shape; else `_NoFitError`."""
        try:
            self._check_explained(both)
            return both
        except _NoFitError as fault:
            most = max(USUAL_SHARE * int((~self._benchmark_edge).sum()), _LEAST_FEATURES)
            if fault.codes != ("edge-not-shell",) or place is None or not len(_has(place)) > most:
                raise
        alone = self._solve(_NOTHING, place, deformation, np.eye(2), USUAL_RMS_PX)
        self._check_explained(alone)
        return alone

    def _check_explained(self, last: _Solution) -> None:
        """Refuse a frame that no deflection explains, by `estimators.frame_checks`."""
        rows, focal = last.rows, float(self.view.camera.focal_px[0])
        design = Design(
            last.columns, last.gain, rows[:, TURN], rows[:, CENTRE], focal, last.residual_px, last.weight
        )  # fmt: skip
        shape = last.shape_found / self._shape_sd
        fault = fault_of_fit(design, last.rms_px, shape, self.apriori.higher_lobes_rad)
        if fault:
            raise _NoFitError(fault)

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
        frame, lines = unedited(picture), len(self.clocks_rad)
        found = frame.near_edge(self.view.lines_at(self.clocks_rad, own))
        own_residual = edge_residuals(self.view, found, own).residual_px
        coherent = np.isfinite(own_residual) if found.is_by_hand else is_coherent(found.line, own_residual)
        offset, _, _ = self._at_benchmark(found.line, _BESIDE if found.is_by_hand else 0)
        residual = edge_residuals(self.view, found, tried).residual_px - offset
        edge = np.column_stack([found.points_px, found.inward_px, residual, coherent & np.isfinite(residual)])
        place, sd = frame.features(self.features, self.view, own, REACH_PX)
        place, sd = frame.with_marked(self.features, (place, sd)) or (place, sd)
        has = np.flatnonzero(np.isfinite(sd))
        points, across = self.features.points_shell_m[has], self.features.across_px[has]
        offset, _, _ = self._at_benchmark(lines + has)
        there, predicted = (self.view.sight(points, d).pixels for d in (own, tried))
        off, residual = (place[has] - np.einsum("ni,ni->n", p, across) - offset for p in (there, predicted))
        at = there + off[:, None] * across
        return edge, np.column_stack([at, across, residual, np.abs(off) < OUTLIER_PX])

    def _reconciled(
        self, frame: EditedFrame, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None,
        deformation: FloatArray, both: _Solution,
    ) -> _Solution:  # fmt: skip
        """Edge and features where they agree, the edge alone where they contradict each other and it is whole.

        `_NoFitError` where they contradict each other and it is not.
        """
        seen = both.edge_count / len(self.clocks_rad)
        if place is None and seen < _SOUND_EDGE and not horizon.is_by_hand:
            raise _NoFitError(
                f"no feature agrees, and {100.0 * seen:.0f} % of the edge in view can be used where "
                f"{100.0 * _SOUND_EDGE:.0f} % are needed",
                "edge-too-short",
            )
        rms = max(both.rms_px, self._edge_rms_px)
        if place is None and rms > USUAL_RMS_PX and not horizon.is_by_hand:
            raise _NoFitError(
                f"no feature agrees, and the edge alone has an rms of {rms:.1f} px, here or in the benchmark frame, "
                f"where {USUAL_RMS_PX:.1f} px are allowed",
                "edge-not-shell",
            )
        if place is None:
            return both
        # to first order, which takes a tenth of a fit's time, then in full where that is not clear
        if both.edge_count >= _least_points(horizon):
            step, alone_near = self._edge_step(both, deformation[2])
            if self._contradiction(step, alone_near, both) < 0.5 * _CONTRADICTION:
                return both
        alone = deformation.copy()
        try:
            near = self._independent_edge(frame, horizon, alone)
            edge = self._solve(near, None, alone, np.eye(2), np.inf, self._prior_about(both))
        except _NoFitError:
            # steps in the clouds are no edge to contradict anything
            return both
        share = self._edge_share(edge.edge_count)
        square = self._contradiction(alone[:2] - deformation[:2], edge, both)
        if square < _CONTRADICTION:
            return both
        if share < _WHOLE_EDGE or edge.rms_px > USUAL_RMS_PX:
            raise _NoFitError(
                f"edge and features contradict each other (chi-square {square:.0f} of 2), and {100.0 * share:.0f} % of "
                "the edge are too few to go by",
                "features-contradict-edge",
            )
        deformation[:] = alone
        return self._solve(near, None, deformation, np.eye(2), np.inf)

    @property
    def _edge_rms_px(self) -> float:
        """Of the edge in the benchmark frame."""
        edge = self.benchmark_residuals.residual_px[self._benchmark_edge]
        return float(np.sqrt(np.mean(edge**2))) if len(edge) else float("inf")

    def _contradiction(self, difference: FloatArray, edge: _Solution, both: _Solution) -> float:
        """Chi-square (2) of the difference of two answers, of which one uses a part of the other's points."""
        posed, missing = (
            [s.gain[:2] @ (s.rows[:, POSED] - s.before[:, POSED]) for s in (edge, both)],
            [s.gain[:2] @ s.before[:, DEFLECTION] for s in (edge, both)],
        )
        camera = posed[0] - posed[1]
        rest = (missing[0] - missing[1] + camera @ self.posed_per_deflection) * self.apriori.benchmark_rad
        covariance = camera @ self.posed_covariance @ camera.T + rest @ rest.T
        # of the best answers, the better one's error has no part in the difference
        value, axes = np.linalg.eigh((edge.formal - both.formal)[:2, :2])
        covariance += (axes * np.maximum(value, _LEAST_VAR)) @ axes.T
        return float(difference @ np.linalg.solve(covariance, difference))

    def _approach_by_texture(self, frame: EditedFrame, deformation: FloatArray) -> _Approached:
        """Move ``deformation`` in place to where the texture agrees with itself, else to where the edge is.

        Where the search starts, then where the edge is found from far, then where the valleys between tori fit: the
        first place is taken that is sound, else the one that shows most.
        """
        best: tuple[float, FloatArray, _Approached] | None = None
        trouble = Fault("no edge near where one is expected", "edge-not-clear")
        for guess in self._guesses(frame, deformation.copy()):
            moved = guess.copy()
            try:
                seen = self._seen_from(frame, moved)
            except _NoFitError as fault:
                trouble = fault.faults[0]
                continue
            if best is None or seen.score > best[0]:
                best = (seen.score, moved, seen)
            if seen.score > _SOUND_SCORE:
                break
        if best is None:
            raise _NoFitError(trouble)
        deformation[:] = best[1]
        return best[2]

    def _guesses(self, frame: EditedFrame, start: FloatArray) -> Iterator[FloatArray]:
        """Deformations (3,) near which the shell may be, the likeliest first; each is only made when asked for."""
        yield start
        coarse = frame.far_edge(self.lines, self.view.camera.size_px)
        if coarse.is_usable:
            edge_alone = np.zeros(3)
            with suppress(_NoFitError):
                self._fit_points(coarse, None, edge_alone, np.eye(2))
                yield edge_alone
        yield from self._where_map_fits(frame.image, valleys(self.view), start)

    def _where_map_fits(self, image: Image, painted: ImageFeatures, start: FloatArray) -> Iterator[FloatArray]:
        """Deformation (3,) at which features fit the frame best, where that is significant."""

        def pixels(turned: FloatArray) -> FloatArray:
            return self.view.sight(painted.points_shell_m, np.array([*turned, 0.0])).pixels

        fitted = fit_feature_map(image, pixels, [start[:2].copy()], _FAR_RAD, painted.signs)
        if fitted is not None:
            yield np.array([*fitted, 0.0])

    def _seen_from(self, frame: EditedFrame, deformation: FloatArray) -> _Approached:
        """Texture and edge near a guess, which is moved in place to where they are; `_NoFitError` without either."""
        for reach in (REACH_PX, TEXTURE_REACH_PX):
            found = frame.features(self.features, self.view, deformation, reach)
            if len(_has(found)) >= _LEAST_FEATURES:
                self._fit_points(_NOTHING, found, deformation, np.eye(2))
        place, agreed = self._agreeing(found, deformation)
        if place is not None:
            self._fit_points(_NOTHING, place, deformation, np.eye(2))
        near = self.coherent_edge(frame, deformation)
        if place is None:
            for _ in range(_EDGE_PASSES):
                self._solve(near, None, deformation, np.eye(2), _WORST_RMS_PX)
                near = self.coherent_edge(frame, deformation)
        return _Approached(place, near, agreed, self._edge_share(len(near.points_px)))

    def coherent_edge(self, frame: EditedFrame, deformation: FloatArray) -> HorizonLine:
        """Edge near where a deformation (3,) puts it, without points that stand off their neighbours."""
        near = frame.near_edge(self.view.lines_at(self.clocks_rad, deformation))
        if near.is_by_hand:
            return near
        residual = edge_residuals(self.view, near, deformation).residual_px
        return near.some(is_coherent(near.line, residual))

    def _agreeing(
        self, found: tuple[FloatArray, FloatArray], deformation: FloatArray
    ) -> tuple[tuple[FloatArray, FloatArray] | None, float]:
        """Places of the texture that agree on one deformation, None where too few do; the share that does."""
        sharp = found[0], np.where(found[1] < _WORST_TEXTURE_SD_PX, found[1], np.inf)
        has = _has(sharp)
        if len(has) < _LEAST_FEATURES:
            return None, 0.0
        off = np.abs(self._fit_points(_NOTHING, sharp, deformation.copy(), np.eye(2)).left_px)
        agreed = float(np.mean(off < _AGREED_PX))
        if agreed < _LEAST_AGREED:
            return None, agreed
        scale = 1.4826 * float(np.nanmedian(off))
        inflated = max(1.4826 * float(np.nanmedian(off / sharp[1][has])), 1.0)
        rows = has[off < max(3.0 * scale, 0.3)]
        kept = np.full_like(sharp[1], np.inf)
        kept[rows] = TOGETHER * inflated * sharp[1][rows]
        return (sharp[0], kept), agreed

    def _approach(
        self, frame: EditedFrame, deformation: FloatArray, painted: ImageFeatures
    ) -> tuple[FloatArray, FloatArray] | None:
        """Move ``deformation`` in place to within a pixel or two, and find the features there; None where few.

        From where the search starts, if most features are found there; else from where the edge is found or where the
        feature map fits, whichever shows most: behind the rim may be the Earth, whose limb is an edge too.
        """
        wanted = _FEW_FEATURES * int((~self._benchmark_edge).sum())
        guesses = [deformation.copy()]
        found = [frame.features(self.features, self.view, deformation, REACH_PX)]
        trouble = NO_FAULT
        if len(_has(found[0])) < max(wanted, _LEAST_FEATURES):
            coarse = frame.far_edge(self.lines, self.view.camera.size_px)
            trouble = coarse.refused
            edge_alone = deformation.copy()
            try:
                if coarse.is_usable:
                    self._fit_points(coarse, None, edge_alone, np.eye(2))
                    guesses.append(edge_alone)
                    found.append(frame.features(self.features, self.view, edge_alone, REACH_PX))
            except _NoFitError as fault:
                trouble = fault.faults[0]
        if max(len(_has(f)) for f in found) < wanted:
            for fitted in self._where_map_fits(frame.image, painted, deformation):
                guesses.append(fitted)
                found.append(frame.features(self.features, self.view, guesses[-1], REACH_PX))
        best = int(np.argmax([len(_has(f)) for f in found]))
        if len(_has(found[best])) >= _LEAST_FEATURES:
            deformation[:] = guesses[best]
            self._fit_points(_NOTHING, found[best], deformation, np.eye(2))
            return frame.features(self.features, self.view, deformation, REACH_PX)
        if trouble:
            raise _NoFitError(trouble)
        deformation[:] = guesses[1]
        return None

    def _at_benchmark(
        self, index: NDArray[np.intp], beside: int = 0
    ) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """Of points found at the benchmark too, or so many places beside it: residual (NaN where not), sd, its row."""
        before = self.benchmark_residuals
        last = len(before.index) - 1
        at = np.minimum(np.searchsorted(before.index, index), last)
        lower = np.maximum(at - 1, 0)
        at = np.where(np.abs(before.index[lower] - index) < np.abs(before.index[at] - index), lower, at)
        there = np.abs(before.index[at] - index) <= beside
        return np.where(there, before.residual_px[at], np.nan), before.sd_px[at], at

    @property
    def _shape_sd(self) -> FloatArray:
        """A priori sd of flattening, joint station, lobes (12) and light (3) of a frame against the benchmark."""
        apriori = self.apriori
        light = [np.sqrt(2.0) * apriori.edge_px] * 3
        return np.array([apriori.flattening_rad, apriori.joint_station_m, *apriori.lobe_sd_rad, *light])

    def _shape_prior(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Prior mean and sd of the shape, which must not absorb what an assumed plane (k = 1) cannot explain."""
        return np.zeros(len(self._shape_sd)), self._shape_sd * (1.0 if k == 2 else 1e-3)

    def _prior_about(self, both: _Solution) -> tuple[FloatArray, FloatArray]:
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
    ) -> _Points:  # fmt: skip
        """Fit ``deformation`` (3,) in place to the edge and, where given, the found features."""
        view, k, lines = self.view, basis.shape[1], len(self.clocks_rad)
        has = _has(place) if place is not None else np.zeros(0, dtype=np.intp)
        edge_offset, before_sd, edge_at = self._at_benchmark(horizon.line, _BESIDE if horizon.is_by_hand else 0)
        feature_offset, feature_before_sd, feature_at = self._at_benchmark(lines + has)
        edge = (horizon.points_px, light_columns(view, horizon), np.hypot(horizon.sd_px, before_sd), edge_offset)
        spot, sd = (place[0][has], place[1][has]) if place is not None else (np.zeros(0), np.zeros(0))
        painted = self.features
        features = (
            painted.points_shell_m[has],
            painted.across_px[has],
            spot,
            np.hypot(sd, feature_before_sd),
            feature_offset,
        )
        prior = prior or self._shape_prior(k)
        count = len(edge_offset) + len(has)
        residual, left, weight = np.empty(count), np.empty(count), np.empty(count)
        rows, shape = np.zeros((count, 16)), np.zeros((count, _fit_kernels.SHAPES))
        least = _least_points(horizon)
        limits = (HUBER, OUTLIER_PX, LAST_STEP_RAD, STEPS, 0 if len(has) >= _LEAST_FEATURES else least)
        state, number = _fit_kernels.fit_frame(
            deformation, np.ascontiguousarray(basis), view.shell_terms, view.camera.lens_terms, edge, features, prior,
            limits, residual, rows, shape, weight, left,
        )  # fmt: skip
        if state == _fit_kernels.TOO_FEW:
            raise _NoFitError(
                f"{number} edge points also found at the benchmark where {least} are needed",
                "edge-points-too-few",
            )
        if state == _fit_kernels.DIVERGED:
            raise _NoFitError("the fit diverged beyond 28 deg", "fit-diverged")
        return _Points(residual, left, rows, shape, weight, np.concatenate([edge_at, feature_at]), len(edge_offset))

    def _solve(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, deformation: FloatArray,
        basis: FloatArray, worst_rms_px: float, prior: tuple[FloatArray, FloatArray] | None = None,
    ) -> _Solution:  # fmt: skip
        """Fit as `_fit_points`, with its covariance; `_NoFitError` where the residuals are too large."""
        k = basis.shape[1]
        mean, sd = prior = prior or self._shape_prior(k)
        found = self._fit_points(horizon, place, deformation, basis, prior)
        residual, rows, shape, weight = found.residual_px, found.rows, found.shape, found.weight
        used = weight > 0.0
        residual, rows, shape, weight = residual[used], rows[used], shape[used], weight[used]
        rms = float(np.sqrt(np.average(found.left_px[used] ** 2, weights=weight)))
        if rms > worst_rms_px:
            raise _NoFitError(
                f"the edge is not the shell's: rms {rms:.1f} px where {worst_rms_px} px are allowed", "edge-not-shell"
            )
        design = np.concatenate([rows[:, DEFLECTION] @ basis, rows[:, [FLATTENING, JOINT]], shape], axis=1)
        weighted = design.T * weight
        formal = np.linalg.inv(weighted @ design + np.diag(np.concatenate([np.zeros(k), sd**-2.0])))
        before = self.benchmark_residuals.rows[found.benchmark_at[used]]
        edge_count = int(used[: found.edge_points].sum())
        # the flattening's value was carried from step to step, the others are counted from zero in each
        pull = np.concatenate([np.zeros(k), (mean - np.eye(len(sd))[0] * deformation[2]) / sd**2])
        shape_found = (formal @ (weighted @ residual + pull))[k:]
        shape_found[0] += deformation[2]
        features = np.zeros(0, dtype=np.intp) if place is None else _has(place)[used[found.edge_points :]]
        return _Solution(
            formal @ weighted, formal, shape_found, design, rows, before, edge_count, rms, residual, weight, features
        )

    @cached_property
    def _light_shift(self) -> FloatArray:
        return light_shift(self.view, self.features)

    def _independent_edge(self, frame: EditedFrame, horizon: HorizonLine, deformation: FloatArray) -> HorizonLine:
        """Edge that owes nothing to the features, ``deformation`` moved near it; `_NoFitError` where there is none.

        What was found near the features' answer where that is an edge, not steps in the clouds; else found from far.
        """
        if horizon.is_by_hand:
            return horizon
        near = horizon.some(is_coherent(horizon.line, edge_residuals(self.view, horizon, deformation).residual_px))
        if len(near.points_px) >= LEAST_POINTS:
            return near
        far = frame.far_edge(self.lines, self.view.camera.size_px)
        if far.refused:
            raise _NoFitError(far.refused)
        moved = np.zeros(3)
        self._solve(far, None, moved, np.eye(2), _WORST_RMS_PX)
        deformation[:] = moved
        return self.coherent_edge(frame, deformation)

    def _edge_step(self, both: _Solution, flattening_rad: float) -> tuple[FloatArray, _Solution]:
        """One step (2,) from an answer of edge and features to that of the edge alone, and its gain and covariance."""
        edge, (mean, sd) = slice(0, both.edge_count), self._prior_about(both)
        design, weight = both.columns[edge], both.weight[edge]
        weighted = design.T * weight
        formal = np.linalg.inv(weighted @ design + np.diag(np.concatenate([np.zeros(2), sd**-2.0])))
        right = weighted @ both.residual_px[edge]
        right[2:] += (mean - np.eye(len(sd))[0] * flattening_rad) / sd**2
        step = formal @ right
        # features that contradict the edge leave it residuals that are none of its scatter
        left = both.residual_px[edge] - design @ step
        scatter = float(weight @ left**2) / max(float(weight @ both.residual_px[edge] ** 2), 1e-12)
        alone = replace(
            both, gain=formal @ weighted, formal=np.asarray(min(scatter, 1.0) * formal), rows=both.rows[edge],
            before=both.before[edge], feature_rows=both.feature_rows[:0],
        )  # fmt: skip
        return step[:2], alone

    def _answer(self, horizon: HorizonLine, deformation: FloatArray, last: _Solution, basis: FloatArray) -> FrameFit:
        k, before = basis.shape[1], last.before
        by_camera = last.gain @ (last.rows[:, POSED] - before[:, POSED])
        by_benchmark = last.gain @ before[:, DEFLECTION] + by_camera @ self.posed_per_deflection
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
            chosen = np.concatenate([[0, 1], SHAPE])
            parts = (part[chosen] for part in (by_camera, by_benchmark, by_light))
            shape = FrameShape(found, last.formal[np.ix_(chosen, chosen)], *parts)
        answer, flattening = basis @ (basis.T @ deformation[:2]), float(deformation[2])
        return FrameFit(
            answer, covariance, by_benchmark[:k], leak, flattening, last.rms_px, features, horizon, shape=shape
        )

    def covariance_of(self, formal: FloatArray, by_camera: FloatArray, by_benchmark: FloatArray) -> FloatArray:
        """Covariance of an answer with that of the camera's pose and of the benchmark frame's deflection."""
        rest = by_benchmark * self.apriori.benchmark_rad
        return np.asarray(formal + by_camera @ self.posed_covariance @ by_camera.T + rest @ rest.T)

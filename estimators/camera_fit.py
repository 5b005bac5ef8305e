"""What is seen of the shell in a frame, and what does it say of the deflection?

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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.body_edge import UNMOVED, UNSEEN, MountMotion
from estimators.edge import (
    HorizonLine,
    breaks_across,
    fault_of_frame,
    is_coherent,
    no_horizon,
    steepness_of,
)
from estimators.features import ImageFeatures, fit_feature_map, valleys
from estimators.frame_checks import USUAL_RMS_PX, Design, fault_of_fit
from estimators.frame_edits import EditedFrame, unedited
from estimators.frame_residuals import edge_residuals
from estimators.frame_solution import (
    BESIDE,
    CENTRE,
    LEAST_FEATURES,
    LEAST_POINTS,
    OUTLIER_PX,
    TURN,
    Fitted,
    FrameFit,
    FrameModel,
    NoFitError,
    Solution,
    found_rows,
    least_points,
    refused_fit,
)
from estimators.texture import PaintedTexture
from estimators.virtual_camera import DEFLECTION
from flightmodel.checks import NO_FAULT, FloatArray, Issue
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

_NOTHING = no_horizon(NO_FAULT)


@dataclass(frozen=True)
class _Approached:
    """What is seen from near an answer: texture that agrees, the edge, and the share of each."""

    place: tuple[FloatArray, FloatArray] | None
    edge: HorizonLine
    agreed: float
    edge_share: float
    is_turned: bool

    @property
    def score(self) -> float:
        """Texture that agrees outweighs an edge, which may be the Earth's."""
        return self.edge_share + (1.0 + self.agreed if self.place is not None else 0.0)


@dataclass(frozen=True)
class OrientedCamera(FrameModel):
    """A virtual camera whose orientation and lens were fitted on a benchmark frame; see `estimators.benchmark`."""

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
        """Edge and features, or most features alone if clouds along the edge pass for a shape; else `NoFitError`.

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
        """Refuse a frame that no deflection explains; variance of one that may be moved: `estimators.frame_checks`."""
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
        """Whether the rows (n,) of features found are enough, and most of what the benchmark frame shows of theirs."""
        return len(rows) > max(USUAL_SHARE * self._alike_at_benchmark(rows), LEAST_FEATURES)

    def _alike_at_benchmark(self, rows: NDArray[np.intp]) -> int:
        """Features of the benchmark frame of the kind of rows (n,)."""
        return self.features_at_benchmark(bool(len(rows)) and bool(rows[0] < self.painted_rows))

    def _check_seen(self, horizon: HorizonLine, last: Solution) -> None:
        """Refuse a frame of which little is seen: what there is may agree by chance."""
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
        """Refuse a frame whose edge is sharper or less sharp than the benchmark's: shades move a wide step's middle."""
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
        offset, _, _ = self._at_benchmark(found.line, BESIDE if found.is_by_hand else 0)
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
        """Deformations (3,) near which the shell may be, the likeliest first; each is only made when asked for.

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
        """Edge that owes nothing to the features, ``deformation`` moved near it; `NoFitError` where there is none.

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

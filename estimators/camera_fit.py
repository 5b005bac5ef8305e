"""Which bending explains the edge and the marks found in a frame, seen from a camera that a benchmark frame oriented?

Benchmark frame, taken as not bent: the camera (turn, focal scale, principal point, k1, k2, position) and the shell's
radius are fitted to edge and marks, each held by what was known of it before. What is left over there, point by point,
is how the shell was built and painted: it is taken off the other frames' residuals, so that those measure motion.

Other frames, plane found: Gauss-Newton with Huber's weights on

    r_i = found_i - predicted_i(w, kappa) - left over_i,   parameters  w (2), kappa, joint, ovality (2), light (3),

each but ``w`` held by its prior: the shell's flattening and ovality under load, the joint's station, and the shift,
tilt and bow by which a changing light moves the found edge. With an assumed plane, the seed paper's way, one component
of ``w`` alone is fitted to the edge alone, and the rest is only in the error bar. The covariance is the formal one,
scaled by the residuals, plus what the benchmark left uncertain,

    dw = G [(C_f - C_b) dc + (B_b + (C_f - C_b) S) db],      G = (J' W J + P^-1)^-1 J' W,

with ``c`` the camera, ``b`` the bending of the benchmark frame, ``S = dc/db``, and ``C``, ``B`` the derivatives in the
frame ``f`` and in the benchmark ``b``.

Sources: seed paper, CAD-based estimate. S. F. Schmidt's "consider" covariance, e.g. Tapley, Schutz, Born, "Statistical
Orbit Determination", 2004, chapter 6.

What a frame shows against what was predicted: residuals of edge points and marks, derivatives, weights.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimators import _fit_kernels
from estimators.edge import HorizonLine, ScanLines, fault_of_frame, find_horizon, no_horizon, steps_near
from estimators.features import Marks, fitted_pattern
from estimators.virtual_camera import BENDING, CAMERA, FLATTENING, HELD, VirtualCamera
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


STEPS = 12
WORST_RMS_PX, MARKS_RMS_PX = 2.5, 1.0
LEAST_POINTS, LEAST_MARKS = 60, 40
FEW_MARKS = 0.6
FAR_RAD = np.deg2rad([4.0, 4.0])
GROSS_PX = 5.0
REACH_PX = 8
LAST_STEP_RAD = 2e-5
JOINT = HELD.stop - 1
POSED = slice(CAMERA.start, JOINT)


@dataclass(frozen=True)
class HeldFixed:
    """One standard deviation of what no frame tells, or not for certain.

    Parameters
    ----------
    rim_radius_m, joint_station_m : float
        Shell and joint; 0.05 m covers the nose and the innermost torus within 4 sd.
    benchmark_rad : float
        Deflection of the benchmark frame, each lateral axis. Statically ``(z0/x) u/(1-u)``, 0.06 deg for the reference
        vehicle at 421 s, and the joint's ringing about it.
    flattening_rad, ovality_rad : float
        How far the shell opens like an umbrella, and out of round as a saddle, between benchmark and frame. The seed
        paper's shell bent locally by an amount nobody measured.
    edge_px : float
        Shift of the found edge against the true one, different from frame to frame with the light; as much for a
        tilt and for a bow of the edge across the picture (at the picture's sides).
    """

    rim_radius_m: float = 0.01
    joint_station_m: float = 0.05
    benchmark_rad: float = float(np.deg2rad(0.12))
    flattening_rad: float = float(np.deg2rad(0.25))
    ovality_rad: float = float(np.deg2rad(0.1))
    edge_px: float = 0.2


@dataclass(frozen=True)
class FrameFit:
    """The deflection seen in one frame.

    Parameters
    ----------
    rotation_yz_rad : (2,) float
        Rotation vector of the shell against the body about body y and z, rad; NaN when refused.
    covariance : (k, k) float
        Of the fitted parameters: ``rotation_yz_rad`` (k = 2), or the angle in the assumed plane (k = 1), rad^2.
    per_benchmark : (k, 2) float
        What is missing of the answer per unit bending of the benchmark frame; its `HeldFixed` is in the covariance.
    plane_leak : float
        Answer to a unit bending across the assumed plane (k = 1); zero otherwise.
    flattening_rad : float
    residual_rms_px : float
    marks : int
        Rows of marks used.
    horizon : HorizonLine
    refused : str
        Why there is no answer; empty when there is one.
    """

    rotation_yz_rad: FloatArray
    covariance: FloatArray
    per_benchmark: FloatArray
    plane_leak: float
    flattening_rad: float
    residual_rms_px: float
    marks: int
    horizon: HorizonLine
    refused: str = ""


_NOTHING = no_horizon("")


class NoFitError(Exception):
    """What was found does not fit the model."""


@dataclass(frozen=True)
class _Solution:
    """Last step of one frame's fit: gain ``(k, m)`` and formal covariance ``(k, k)`` of the bending.

    ``before``: the benchmark's rows of the points used; ``edge_count`` of them are edge points and come first.
    """

    gain: FloatArray
    formal: FloatArray
    rows: FloatArray
    shape: FloatArray
    before: FloatArray
    edge_count: int
    rms_px: float


@dataclass(frozen=True)
class _Points:
    """Edge points, which come first, and marks at the end of a fit; ``benchmark_at``: their rows there."""

    residual_px: FloatArray
    rows: FloatArray
    shape: FloatArray
    weight: FloatArray
    benchmark_at: NDArray[np.intp]
    edge_points: int


def _has(found: tuple[FloatArray, FloatArray]) -> NDArray[np.intp]:
    """Rows of marks that were found."""
    return np.flatnonzero(np.isfinite(found[1]))


def _no_answer(horizon: HorizonLine, reason: str) -> FrameFit:
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
        Where they are searched when nothing is known of the bending.
    marks : Marks
        Which marks are looked for.
    held : HeldFixed
    benchmark : HorizonLine
    left_over : Seen
        Of the benchmark frame: residuals, rows and sd of what was found there.
    corrections : (8,) float
        Three turns in camera axes, rad, focal scale less one, principal point, px, k1 and k2, against nominal.
    posed_covariance : (12, 12) float
        Of the corrections, camera position and shell radius.
    posed_per_bending : (12, 2) float
        Their shift per radian of bending of the benchmark frame.
    residual_rms_px : float
        Of the benchmark frame.
    """

    view: VirtualCamera
    clocks_rad: FloatArray
    lines: ScanLines
    marks: Marks
    held: HeldFixed
    benchmark: HorizonLine
    left_over: Seen = field(repr=False)
    corrections: FloatArray
    posed_covariance: FloatArray = field(repr=False)
    posed_per_bending: FloatArray = field(repr=False)
    residual_rms_px: float

    @property
    def marks_share(self) -> float:
        """Share of the marks in view that the benchmark frame shows."""
        found = int((self.left_over.index >= len(self.clocks_rad)).sum())
        return found / max(len(self.marks.is_dot), 1)

    def fit(self, image: Image, plane_axis: FloatArray | None = None, start: FloatArray | None = None) -> FrameFit:
        """Find the deflection in a frame.

        Parameters
        ----------
        image : (h, w) uint8
        plane_axis : (2,) float or None
            Rotation vector about body y and z of a unit bending in the assumed plane, or None to find the plane.
        start : (2,) float, optional
            Where to start, e.g. the answer of the frame before.
        """
        fault = fault_of_frame(image, self.view.camera.size_px)
        if fault:
            return _no_answer(no_horizon(fault), fault)
        bending, basis, horizon = np.zeros(3), np.eye(2), _NOTHING
        bending[:2] = 0.0 if start is None else start
        try:
            place = self._approach(image, bending)
            horizon = steps_near(image, self.view.lines_at(self.clocks_rad, bending))
            last = self._solve(horizon, place, bending, basis, WORST_RMS_PX)
            if last.edge_count < LEAST_POINTS and last.rms_px > MARKS_RMS_PX:
                raise NoFitError(f"no edge near the marks, which lie {last.rms_px:.1f} px rms off: not the shell's")
            if plane_axis is not None:
                # whether this is the shell was judged with both parameters: an assumed plane alone may fit badly;
                # the seed paper's way knows the edge alone
                basis = plane_axis[:, None]
                bending[:] = *(basis[:, 0] * (basis[:, 0] @ bending[:2])), 0.0
                last = self._solve(horizon, None, bending, basis, np.inf)
        except NoFitError as fault_of_fit:
            return _no_answer(horizon, str(fault_of_fit))
        return self._answer(horizon, bending, last, basis)

    def _approach(self, image: Image, bending: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Carry ``bending`` in place to within a pixel or two, and find the marks there; None where there are few.

        From where the search starts, if most marks turn up there; else from where the edge is found or where the
        pattern of marks fits, whichever shows most: behind the rim may be the Earth, whose limb is an edge too.
        """
        wanted = FEW_MARKS * int((self.left_over.index >= len(self.clocks_rad)).sum())
        guesses = [bending.copy()]
        found = [found_marks(self.view, self.marks, image, bending, REACH_PX)]
        trouble = ""
        if len(_has(found[0])) < max(wanted, LEAST_MARKS):
            coarse = find_horizon(image, self.lines, self.view.camera.size_px)
            trouble = coarse.refused
            edge_alone = bending.copy()
            try:
                if coarse.is_usable:
                    self._fit_points(coarse, None, edge_alone, np.eye(2))
                    guesses.append(edge_alone)
                    found.append(found_marks(self.view, self.marks, image, edge_alone, REACH_PX))
            except NoFitError as fault:
                trouble = str(fault)
        if max(len(_has(f)) for f in found) < wanted:
            points = self.marks.points_shell_m
            pattern = fitted_pattern(
                image, lambda p: self.view.sight(points, np.array([*p, 0.0])).pixels, [bending[:2].copy()], FAR_RAD
            )
            if pattern is not None:
                guesses.append(np.array([*pattern, 0.0]))
                found.append(found_marks(self.view, self.marks, image, guesses[-1], REACH_PX))
        best = int(np.argmax([len(_has(f)) for f in found]))
        if len(_has(found[best])) >= LEAST_MARKS:
            bending[:] = guesses[best]
            self._fit_points(_NOTHING, found[best], bending, np.eye(2))
            return found_marks(self.view, self.marks, image, bending, REACH_PX)
        if trouble:
            raise NoFitError(trouble)
        bending[:] = guesses[1]
        return None

    def _left_over(self, index: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """Of what was found at the benchmark too: residual (NaN where nothing was), sd, and its row."""
        at = np.minimum(np.searchsorted(self.left_over.index, index), len(self.left_over.index) - 1)
        known = self.left_over.index[at] == index
        return np.where(known, self.left_over.residual_px[at], np.nan), self.left_over.sd_px[at], at

    @property
    def _shape_sd(self) -> FloatArray:
        """Of flattening, joint station, ovality (2) and light (3) of a frame against the benchmark."""
        held = self.held
        light = [np.sqrt(2.0) * held.edge_px] * 3
        return np.array([held.flattening_rad, held.joint_station_m, *[held.ovality_rad] * 2, *light])

    def _shape_prior(self, k: int) -> FloatArray:
        """Prior sd of the shape, which must not make up for what an assumed plane (k = 1) cannot explain."""
        return self._shape_sd * (1.0 if k == 2 else 1e-3)

    def _fit_points(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, bending: FloatArray,
        basis: FloatArray,
    ) -> _Points:  # fmt: skip
        """Fit ``bending`` (3,) in place to the edge and, where given, the marks found."""
        view, k, lines = self.view, basis.shape[1], len(self.clocks_rad)
        has = _has(place) if place is not None else np.zeros(0, dtype=np.intp)
        left, before_sd, edge_at = self._left_over(horizon.line)
        mark_left, mark_before_sd, mark_at = self._left_over(lines + has)
        edge = (horizon.points_px, light_columns(view, horizon), np.hypot(horizon.sd_px, before_sd), left)
        spot, sd = (place[0][has], place[1][has]) if place is not None else (np.zeros(0), np.zeros(0))
        painted = self.marks
        marks = (painted.points_shell_m[has], painted.across_px[has], spot, np.hypot(sd, mark_before_sd), mark_left)
        prior = self._shape_prior(k)
        count = len(left) + len(has)
        residual, rows, shape, weight = np.empty(count), np.zeros((count, 16)), np.zeros((count, 5)), np.empty(count)
        limits = (HUBER, GROSS_PX, LAST_STEP_RAD, STEPS, 0 if len(has) >= LEAST_MARKS else LEAST_POINTS)
        state, number = _fit_kernels.fit_frame(
            bending, np.ascontiguousarray(basis), view.shell_terms, view.camera.lens_terms, edge, marks, prior, limits,
            residual, rows, shape, weight,
        )  # fmt: skip
        if state == _fit_kernels.TOO_FEW:
            raise NoFitError(f"{number} edge points also found at the benchmark where {LEAST_POINTS} are wanted")
        if state == _fit_kernels.RAN_AWAY:
            raise NoFitError("the fit ran away beyond 28 deg")
        return _Points(residual, rows, shape, weight, np.concatenate([edge_at, mark_at]), len(left))

    def _solve(
        self, horizon: HorizonLine, place: tuple[FloatArray, FloatArray] | None, bending: FloatArray,
        basis: FloatArray, worst_rms_px: float,
    ) -> _Solution:  # fmt: skip
        """Fit as `_fit_points`, and say how well it is known; `NoFitError` where the residuals are too large."""
        found, k = self._fit_points(horizon, place, bending, basis), basis.shape[1]
        prior = self._shape_prior(k)
        residual, rows, shape, weight = found.residual_px, found.rows, found.shape, found.weight
        used = weight > 0.0
        residual, rows, shape, weight = residual[used], rows[used], shape[used], weight[used]
        rms = float(np.sqrt(np.average(residual**2, weights=weight)))
        if rms > worst_rms_px:
            raise NoFitError(f"the edge is not the shell's: rms {rms:.1f} px where {worst_rms_px} px are allowed")
        design = np.concatenate([rows[:, BENDING] @ basis, rows[:, [FLATTENING, JOINT]], shape], axis=1)
        weighted = design.T * weight
        formal = np.linalg.inv(weighted @ design + np.diag(np.concatenate([np.zeros(k), prior**-2])))
        before = self.left_over.rows[found.benchmark_at[used]]
        edge_count = int(used[: found.edge_points].sum())
        return _Solution((formal @ weighted)[:k], formal[:k, :k], rows, shape, before, edge_count, rms)

    def _answer(self, horizon: HorizonLine, bending: FloatArray, last: _Solution, basis: FloatArray) -> FrameFit:
        gain, before, leak = last.gain, last.before, 0.0
        posed = gain @ (last.rows[:, POSED] - before[:, POSED])
        missing = gain @ before[:, BENDING] + posed @ self.posed_per_bending
        rest = missing * self.held.benchmark_rad
        covariance = last.formal + posed @ self.posed_covariance @ posed.T + rest @ rest.T
        if basis.shape[1] == 1:
            shape = gain @ np.concatenate([last.rows[:, [FLATTENING, JOINT]], last.shape], axis=1) * self._shape_sd
            covariance = covariance + shape @ shape.T
            # a plane grows by +90 deg as its axis turns from (y, z) to (-z, y)
            leak = float(gain[0] @ last.rows[:, BENDING] @ np.array([-basis[1, 0], basis[0, 0]]))
        marks = len(last.rows) - last.edge_count
        answer = basis @ (basis.T @ bending[:2])
        return FrameFit(answer, covariance, missing, leak, float(bending[2]), last.rms_px, marks, horizon)

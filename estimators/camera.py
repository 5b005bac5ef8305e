"""How far was the aeroshell deflected, by the onboard camera?

The camera is oriented on a benchmark frame in which the joint is taken as undeflected (`estimators.benchmark`); in
every other frame the deflection is the rotation of the shell whose projected edge and features fit the found ones
(`estimators.camera_fit`): two parameters when the plane is estimated, one in an assumed plane (the seed paper's way,
plane along the camera's line of sight).

With an assumed plane that is off by ``d`` the answer is ``theta (cos d + s sin d)``, ``s`` the answer to a unit
deflection normal to the plane; its mean square error ``theta^2 (s^2 sd^2 + 3 (1/2 + s^2)^2 sd^4)`` is in the variance.

Assumed: as in `estimators.frame_solution`.

References
----------
Seed paper, CAD-based estimate, Table 2.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimators.benchmark import BenchmarkDeflection, RelativeDeflections, orient_camera
from estimators.camera_fit import Image, OrientedCamera
from estimators.edge import no_horizon
from estimators.frame_edits import edited
from estimators.frame_solution import AprioriSd, FrameFit, refused_fit
from estimators.texture import TrackedTexture
from flightmodel.camera_edits import NO_EDITS, CameraEdits
from flightmodel.checks import (
    NO_FAULT,
    BoolArray,
    FloatArray,
    GateError,
    Issue,
    Progress,
    check_finite,
    check_increasing,
)
from flightmodel.deflection import (
    DeflectionHistory,
    history_from_lateral,
    polar_from_lateral,
    rotation_vector_body_shell,
)
from flightmodel.film import NO_PICTURE, read_image
from flightmodel.geometry import ShellGeometry
from flightmodel.statistics import symmetric_root
from flightmodel.vehicle import CameraMount

if TYPE_CHECKING:
    import pandas as pd

_MOST = 0.5  # of the answered frames
_DOUBTFUL = 2  # of the four frames around: one alone is a spoilt frame, not a spoilt film
_OF_PICTURE = ("frame-exposure", "frame-size", "frame-undecodable", "frame-frozen")
_NOT_THE_SHELL = (
    "camera-turned", "picture-warped", "edge-not-shell", "features-contradict-edge", "halves-differ",
    "shell-little-seen", "features-lost",
)  # fmt: skip
# share of the benchmark frame's patches: of plain cloth 0.2 agree in the best frame of seven films, of paint 0.3 to 0.5
# (over so many frames that they are not the benchmark's neighbours alone)
_PAINTED, _LEAST_PAINTED = 0.25, 3
_LEVEL_FRAMES = 9  # of which more than half would have to be wrong
_EDGE_FOR_PLANE = 0.5  # of the edge in the benchmark frame: a frame needs half as much, found in both
_FROZEN = Issue("the same picture as the frame before, pixel by pixel: frozen, or copied", "frame-frozen")
_SWAP = np.array([[0.0, 1.0], [-1.0, 0.0]])  # from a rotation about body y and z to the lateral vector


def _axis_of(plane_lv_rad: float) -> FloatArray:
    """Rotation vector (y, z) of a unit deflection in a plane."""
    out: FloatArray = rotation_vector_body_shell(np.array(1.0), np.array(plane_lv_rad))[1:]
    return out


@dataclass(frozen=True)
class FilmFit:
    """The fit of every frame of a film, and its assumptions.

    Parameters
    ----------
    time_s : (n,) float
    fits : tuple of n FrameFit
    oriented : OrientedCamera
    benchmark_s : float
        Time of the benchmark frame.
    plane_lv_rad : float or None
        Assumed plane; None: estimated in every frame.
    plane_sd_rad : float
        Of the assumed plane.
    pressure_pa : (n,) float
        Dynamic pressure at the frames; NaN where no trajectory gives it.
    edited : str
        What an analyst edited, and what was left out of every picture.
    shape_covariance : (13 (1 + c), 13 (1 + c)) float or None
        Of the shell's shape under load as the film determined it, where the answers use it (`estimators.shell_shape`).
    """

    time_s: FloatArray
    fits: tuple[FrameFit, ...]
    oriented: OrientedCamera
    benchmark_s: float
    plane_lv_rad: float | None
    plane_sd_rad: float
    pressure_pa: FloatArray
    edited: str = ""
    shape_covariance: FloatArray | None = None

    def relative_to_benchmark(self, time_bias_sd_s: float = 0.0) -> RelativeDeflections:
        """Deflections relative to the benchmark frame's, where the planes were estimated.

        Raises
        ------
        GateError
            Where a plane was assumed: only one component was read.
        """
        if self.plane_lv_rad is not None:
            raise GateError("in an assumed plane only one component of the deflection is read", code="keys-conflict")
        rest = np.array([fit.per_benchmark for fit in self.fits])
        prior = self.oriented.apriori.benchmark_rad**2 * rest @ rest.transpose(0, 2, 1)
        covariance = np.array([fit.covariance for fit in self.fits]) - prior
        theta_yz = np.array([fit.rotation_yz_rad for fit in self.fits]) @ _SWAP.T
        return RelativeDeflections(
            self.time_s,
            theta_yz,
            _SWAP @ covariance @ _SWAP.T,
            _SWAP @ rest @ _SWAP.T,
            self.benchmark_s,
            time_bias_sd_s,
            self._shape_root(),
        )

    def _shape_root(self) -> FloatArray | None:
        """Root (n, 2, 13 (1 + c)) of the readings' common error by the shell's shape under load, as lateral vectors."""
        if self.shape_covariance is None:
            return None
        none = np.full((2, len(self.shape_covariance)), np.nan)
        by_shape = np.array([none if fit.by_shape is None else fit.by_shape for fit in self.fits])
        return np.asarray(_SWAP @ by_shape @ symmetric_root(self.shape_covariance))

    def history(self, benchmark: BenchmarkDeflection | None = None) -> DeflectionHistory:
        """History of the deflection, with the benchmark frame undeflected or with a given deflection there.

        ``method = "camera"``. NaN where a frame was refused, with the reasons in ``assumptions``. In an assumed plane
        the angle has a sign.
        """
        if self.plane_lv_rad is not None:
            return self._history_in_plane(self.plane_lv_rad)
        read = self.relative_to_benchmark()
        start, back = benchmark or self.undeflected_benchmark, read.per_benchmark
        theta_yz, crossed = read.added_to(start)
        covariance = read.covariance + back @ start.covariance @ back.transpose(0, 2, 1) + crossed
        return history_from_lateral(self.time_s, theta_yz, covariance, "camera", self._remark(benchmark))

    @property
    def undeflected_benchmark(self) -> BenchmarkDeflection:
        """No deflection in the benchmark frame, within its a priori sd."""
        return BenchmarkDeflection(np.zeros(2), self.oriented.apriori.benchmark_rad**2 * np.eye(2))

    def _history_in_plane(self, plane_lv_rad: float) -> DeflectionHistory:
        """History of the deflection in an assumed plane, with the error of that plane."""
        n, sd2 = len(self.time_s), self.plane_sd_rad**2
        theta, covariance = np.full(n, np.nan), np.full((n, 2, 2), np.nan)
        for k, fit in enumerate(self.fits):
            if not fit.refused:
                theta[k], s = fit.rotation_yz_rad @ _axis_of(plane_lv_rad), fit.plane_leak
                off = theta[k] ** 2 * (s**2 * sd2 + 3.0 * (0.5 + s**2) ** 2 * sd2**2)
                cross = -theta[k] * s * sd2
                covariance[k] = [[fit.covariance[0, 0] + off, cross], [cross, sd2]]
        plane = np.full(n, plane_lv_rad)
        return DeflectionHistory(self.time_s, theta, plane, covariance, "camera", self._remark(None))

    def frame_table(self, history: DeflectionHistory) -> pd.DataFrame:
        """What became of every frame; ``history`` is the film's, with its answers.

        Returns
        -------
        DataFrame
            ``t_s, edge_points, features, residual_rms_px, flag`` (``used`` or ``refused``), ``code, reason, theta_deg,
            theta_sd_deg, plane_lv_deg, plane_sd_deg``; of a refused frame no more than its edge points.
        """
        import pandas as pd

        assert history.covariance is not None
        plane_sd = np.sqrt(history.covariance[:, 1, 1])
        angles = (history.theta_rad, history.theta_sd_rad, history.plane_lv_rad, plane_sd)
        used = np.array([not fit.refused for fit in self.fits])
        columns = {
            "t_s": self.time_s,
            "edge_points": [len(fit.horizon.points_px) for fit in self.fits],
            "features": pd.array([fit.features if not fit.refused else None for fit in self.fits], dtype="Int64"),
            "residual_rms_px": [fit.residual_rms_px for fit in self.fits],
            "flag": np.where(used, "used", "refused"),
            "code": [fit.refused.code if fit.refused else "" for fit in self.fits],
            "reason": [str(fit.refused) for fit in self.fits],
        }
        names = ("theta_deg", "theta_sd_deg", "plane_lv_deg", "plane_sd_deg")
        given = {name: np.rad2deg(np.where(used, x, np.nan)) for name, x in zip(names, angles, strict=True)}
        return pd.DataFrame(columns | given)

    @property
    def _kind_of_features(self) -> str:
        if has_texture(self.oriented):
            return "the shell's texture"
        own = self.oriented.view.geometry.listed_features is not None
        return "the vehicle file's features" if own else "seams and dots"

    def _remark(self, benchmark: BenchmarkDeflection | None) -> str:
        """Remark on assumptions, share of the shell in view, and refused frames."""
        used, oriented = [fit for fit in self.fits if not fit.refused], self.oriented
        edge = np.median([len(fit.horizon.points_px) for fit in used]) / len(oriented.lines.origin_px) if used else 0.0
        features = float(np.median([fit.features for fit in used])) if used else 0.0
        plane = (
            "plane estimated in every frame"
            if self.plane_lv_rad is None
            else f"plane assumed at {np.rad2deg(self.plane_lv_rad):.0f} +/- {np.rad2deg(self.plane_sd_rad):.0f} deg LV"
        )
        there = f"taken as undeflected within {np.rad2deg(oriented.apriori.benchmark_rad):.2f} deg"
        there = there if benchmark is None else benchmark.remark
        remarks = [
            f"{plane}; joint {oriented.view.joint_station_m:.3f} m aft of the nose",
            f"camera oriented on the frame at {self.benchmark_s:.3f} s, {there} "
            f"(rms {oriented.residual_rms_px:.2f} px)",
            f"from {100.0 * edge:.0f} % of the edge"
            + (f" and {features:.0f} rows of {self._kind_of_features}" if features >= 1.0 else "; no feature could be "
               "used, which leaves flattening and ovality of the shell in the error bar"),
        ]  # fmt: skip
        if self.edited:
            remarks.append(self.edited)
        if oriented.stated_refused:
            remarks.append(f"{oriented.stated_refused}: they are not used")
        refused: dict[str, list[float]] = {}
        for t, fit in zip(self.time_s, self.fits, strict=True):
            if fit.refused:
                refused.setdefault(fit.refused, []).append(float(t))
        if refused:
            listed = ", ".join(f"{_spans(times)}: {reason}" for reason, times in list(refused.items())[:5])
            more = ", ..." if len(refused) > 5 else ""
            remarks.append(f"{len(self.fits) - len(used)} of {len(self.fits)} frames refused ({listed}{more})")
        return "; ".join(remarks)


def _spans(times_s: list[float]) -> str:
    """Text: one time, or the first time, the last, and their number."""
    if len(times_s) == 1:
        return f"{times_s[0]:.3f} s"
    return f"{len(times_s)} between {times_s[0]:.3f} and {times_s[-1]:.3f} s"


def read_film(
    frame_times_s: FloatArray,
    frames: Iterable[Image | str | Path],
    geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    benchmark_time_s: float = 421.0,
    plane_lv_rad: float | None = float(np.deg2rad(153.0)),
    plane_sd_rad: float = float(np.deg2rad(25.0)),
    apriori: AprioriSd | None = None,
    benchmark: Image | None = None,
    progress: Progress | None = None,
    joint_swing: JointSwing | None = None,
    edits: CameraEdits = NO_EDITS,
    fixed: BoolArray | None = None,
) -> FilmFit:
    """Orient the camera on the benchmark frame, and fit the deflection in every frame.

    Frames are taken one at a time: memory does not grow with their number.

    Parameters
    ----------
    frame_times_s : (n,) float
        Seconds after t0, increasing.
    frames : iterable of (h, w) uint8 or path
        Grey pictures, or files OpenCV reads.
    geometry, camera_mount, joint_station_m
        Nominal shell, camera and joint (m aft of the nose).
    benchmark_time_s : float
        The frame nearest to it is taken as undeflected.
    plane_lv_rad : float or None
        Assumed plane (seed paper: along camera 5, 153 deg); None estimates the plane in every frame.
    plane_sd_rad : float
        Standard deviation of the assumed plane.
    apriori : AprioriSd, optional
    benchmark : (h, w) uint8, optional
        The benchmark frame, where ``frames`` can be iterated only once.
    progress : callable, optional
        Takes the fraction done and what is being done.
    joint_swing : JointSwing, optional
        How fast the joint swings; frames that jump faster are refused. Without it none is.
    edits : CameraEdits, optional
        What an analyst decided by eye.
    fixed : (h, w) bool, optional
        What is the same in every picture, and is not looked at.

    Raises
    ------
    GateError
        When times and frames do not match, or the benchmark frame is missing or unusable.
    """
    times = np.asarray(frame_times_s, dtype=float)
    check_finite("frame_times_s", times)
    check_increasing("frame_times_s", times)
    nearest = _benchmark_index(times, benchmark_time_s)
    if benchmark is None:
        frames = list(frames)
        if len(frames) != len(times):
            raise GateError(f"{len(times)} frame times for {len(frames)} frames", code="argument-value")
        benchmark = _read_frame(frames[nearest])
    benchmark_frame = edited(benchmark, edits, float(times[nearest]), fixed)
    oriented = orient_camera(benchmark_frame, geometry, camera_mount, joint_station_m, apriori, edits.pose)
    axis = None if plane_lv_rad is None else _axis_of(plane_lv_rad)
    fits: list[FrameFit] = []
    start, before = np.zeros(2), NO_PICTURE
    for picture in _decoded_ahead(frames):
        if progress is not None and len(fits) % 10 == 0:
            progress(min(len(fits) / len(times), 1.0), f"frame {len(fits) + 1} of {len(times)}")
        t_s = float(times[min(len(fits), len(times) - 1)])
        if _is_copy(picture, before):
            fits.append(refused_fit(no_horizon(_FROZEN), _FROZEN))
            continue
        fits.append(oriented.fit(edited(picture, edits, t_s, fixed), axis, start))
        start, before = np.zeros(2) if fits[-1].refused else fits[-1].rotation_yz_rad, picture
    if len(fits) != len(times):
        raise GateError(f"{len(times)} frame times for {len(fits)} frames", code="argument-value")
    benchmark_s = float(times[nearest])
    fits = judged(times, fits, joint_swing, edits, benchmark_s if has_texture(oriented) else None)
    if axis is not None and all(fit.refused for fit in fits) and oriented.edge_in_view < _EDGE_FOR_PLANE:
        raise GateError(
            f"camera: no frame can be read in an assumed plane, where the edge alone counts: the benchmark frame shows "
            f"{100.0 * oriented.edge_in_view:.0f} % of it. Leave the plane open (no camera_plane_lv_deg, no --plane)",
            code="plane-needs-edge",
        )
    remarks = [f"by hand: {edits}"] if edits.rows else []
    if fixed is not None:
        remarks.append(f"text burnt into the film, or dead lines: {100.0 * fixed.mean():.0f} % of the picture left out")
    unknown_pa = np.full(len(times), np.nan)
    return FilmFit(
        times, tuple(fits), oriented, benchmark_s, plane_lv_rad, plane_sd_rad, unknown_pa, "; ".join(remarks)
    )


def has_texture(oriented: OrientedCamera) -> bool:
    """Whether the features are the benchmark frame's texture."""
    return isinstance(oriented.features, TrackedTexture)


def judged(
    time_s: FloatArray, fits: list[FrameFit], joint_swing: JointSwing | None, edits: CameraEdits,
    textured_s: float | None,
) -> list[FrameFit]:  # fmt: skip
    """Fits of all frames of a film with those refused that the others or the analyst speak against.

    An analyst's acceptance outweighs what the other frames say, never that a frame has no fit. ``textured_s``: the
    benchmark frame's time, where its texture is the features.
    """
    verdicts = [edits.verdict(float(t)) for t in time_s]
    rejected = [v is not None and v.edit == "reject" for v in verdicts]
    kept = [
        refused_fit(fit.horizon, Issue(f"rejected by hand: {verdict.note or 'no reason given'}", "rejected-by-hand"))
        if verdict is not None and out
        else fit
        for fit, verdict, out in zip(fits, verdicts, rejected, strict=True)
    ]
    found = without_lost_features(kept) if textured_s is None else without_stray_texture(time_s, kept, textured_s)
    found = without_remnants(without_doubtful(without_moved(found)))
    if joint_swing is not None:
        found = without_jumps(time_s, found, joint_swing)
    accepted = [v is not None and v.edit == "accept" for v in verdicts]
    return [fit if yes else other for fit, other, yes in zip(kept, found, accepted, strict=True)]


def without_lost_features(fits: list[FrameFit]) -> list[FrameFit]:
    """Refuse edge-only frames in a film in which most frames have features that agree with the edge."""
    with_features = [fit.features > 0 for fit in fits if not fit.refused]
    return fits if np.mean(with_features or [False]) < _MOST else _without_bare(fits)


def _without_bare(fits: list[FrameFit]) -> list[FrameFit]:
    """Refuse edge-only frames, except those whose edge contradicts features that were found."""
    words = "no feature agrees, though some do in other frames: the edge alone may not be the shell's"
    bare = [not fit.refused and fit.features == 0 and not fit.contradicted for fit in fits]
    return _refused(fits, bare, Issue(words, "features-lost"))


def _refused(fits: list[FrameFit], out: Iterable[bool], fault: Issue) -> list[FrameFit]:
    """Fits of which some are refused."""
    return [refused_fit(fit.horizon, fault) if bad else fit for fit, bad in zip(fits, out, strict=True)]


def without_stray_texture(time_s: FloatArray, fits: list[FrameFit], benchmark_s: float) -> list[FrameFit]:
    """Refuse what disagrees with most frames on whether the benchmark frame's texture is the shell's.

    Light and shade on plain cloth agree now and then, and move as the Sun does; the edge alone counts then. Where more
    agrees than ever does of light and shade, the texture is the shell's, and frames without show something else.
    """
    answered = np.array([not fit.refused for fit in fits], dtype=bool) & (time_s != benchmark_s)
    agreed = np.array([fit.features for fit in fits])
    with_texture = (agreed > 0) & answered
    if not answered.any() or with_texture.sum() >= _MOST * answered.sum():
        return without_lost_features(fits)
    if with_texture.sum() >= _LEAST_PAINTED and np.mean(agreed[with_texture]) > _PAINTED * agreed.max():
        return _without_bare(fits)
    words = "texture agrees, though in most frames none does: it may be shading, which moves with the Sun"
    return _refused(fits, with_texture, Issue(words, "texture-strays"))


def without_remnants(fits: list[FrameFit]) -> list[FrameFit]:
    """Refuse the remaining fits if most frames with anything visible show no shell: those may fit by chance."""
    shown = [fit for fit in fits if getattr(fit.refused, "code", "") not in _OF_PICTURE]
    refused = float(np.mean([bool(fit.refused) for fit in shown] or [False]))
    if len(shown) < _LEVEL_FRAMES or refused <= _MOST:
        return fits
    words = f"{100.0 * refused:.0f} % of the film's frames show no shell that can be read: an answer here may be chance"
    return _refused(fits, [not fit.refused for fit in fits], Issue(words, "film-mostly-refused"))


def without_moved(fits: list[FrameFit]) -> list[FrameFit]:
    """Refuse answers of frames next to one in which the centerbody's edge has moved: a camera that moved stays there.

    Such are frames that do not show that edge, and those in which it seems to have moved but might not have. Next are
    the nearest frames on both sides that show it.
    """
    telling = np.flatnonzero(np.isfinite([fit.mount_px for fit in fits]))
    seems = np.array([fits[k].mount_px > 0.0 for k in telling], dtype=bool)
    padded = np.concatenate([[False], seems, [False]])
    is_sure = np.array([fits[k].mount_is_sure for k in telling], dtype=bool)
    moved = seems & (is_sure | padded[:-2] | padded[2:])
    unseen = "the camera moved in its mount before or after this frame, which does not show the centerbody's own edge"
    out = []
    for k, fit in enumerate(fits):
        at, fault = int(np.searchsorted(telling, k)), NO_FAULT
        if np.isnan(fit.mount_px) and moved[max(at - 1, 0) : at + 1].any():
            fault = Issue(unseen, "camera-turned")
        elif not np.isnan(fit.mount_px) and moved[at]:
            words = f"the centerbody's own edge has moved by up to {fit.mount_px:.1f} px, here and in a frame beside it"
            fault = Issue(f"{words}: the camera moved in its mount, or the picture was moved", "camera-turned")
        out.append(refused_fit(fit.horizon, fault) if fault and not fit.refused else fit)
    return out


def without_doubtful(fits: list[FrameFit]) -> list[FrameFit]:
    """Refuse answers among frames that contradict the shell: what spoils a film lasts longer than a frame.

    A frame of another scene passes all its tests now and then, and of a camera that moved the edge alone may answer; of
    the two nearest frames on both sides two or more then fail a test, or their features contradict the edge.
    """
    contradicts = np.array([fit.contradicted or getattr(fit.refused, "code", "") in _NOT_THE_SHELL for fit in fits])
    words = "two or more of the four frames around contradict the shell: an answer here may be chance"
    around = np.convolve(contradicts, [1, 1, 0, 1, 1])[2:-2] if fits else contradicts
    doubtful = [not fit.refused and count >= _DOUBTFUL for fit, count in zip(fits, around, strict=True)]
    return _refused(fits, doubtful, Issue(words, "frames-around-refused"))


@dataclass(frozen=True)
class JointSwing:
    """Free oscillation of the joint: frequency, and damping over the critical one."""

    frequency_hz: float
    damping_ratio: float

    def largest_change(self, level_rad: FloatArray, apart_s: FloatArray) -> FloatArray:
        """Largest change of deflection (n,), rad, in a time (n,) of free oscillation after a sudden load of this level.

        Released from zero, the joint overshoots the level by ``exp(-pi zeta / sqrt(1 - zeta^2))`` of it; between two
        times it moves by no more than ``2 sin(w t / 2)`` of that amplitude, twice of it from half a period on.
        """
        zeta = min(self.damping_ratio, 0.999)
        overshoot = float(np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2)))
        phase = np.minimum(np.pi * self.frequency_hz * apart_s, 0.5 * np.pi)
        return np.asarray((1.0 + overshoot) * level_rad * np.sin(phase))


def without_jumps(time_s: FloatArray, fits: list[FrameFit], swing: JointSwing) -> list[FrameFit]:
    """Refuse frames whose deflection jumps by more than the joint's free oscillation allows between answered frames.

    The level is the median of the angle over the answered frames nearest in time; what the errors of both frames
    explain (3 sd) is no jump.
    """
    answered = np.array([k for k, fit in enumerate(fits) if not fit.refused], dtype=int)
    if len(answered) < _LEVEL_FRAMES:
        return fits
    t = time_s[answered]
    read = np.array([fits[k].rotation_yz_rad for k in answered])
    var = np.array([np.trace(np.atleast_2d(fits[k].covariance)) for k in answered])
    size = np.linalg.norm(read, axis=1)
    half = _LEVEL_FRAMES // 2
    level = np.array([np.median(size[max(k - half, 0) : k + half + 1]) for k in range(len(t))])
    change, apart = np.linalg.norm(np.diff(read, axis=0), axis=1), np.diff(t)
    both = np.maximum(level[1:], level[:-1])
    allowed = swing.largest_change(both, apart) + 3.0 * np.sqrt(var[1:] + var[:-1])
    jump = change > allowed
    out = list(fits)
    for k in np.flatnonzero(jump[1:] & jump[:-1]) + 1:
        words = (
            f"jumps by {np.rad2deg(min(change[k - 1], change[k])):.1f} deg from both neighbours, faster than the joint "
            f"swings at {swing.frequency_hz:.1f} Hz"
        )
        out[answered[k]] = refused_fit(out[answered[k]].horizon, Issue(words, "jump-too-fast"))
    return out


def _decoded_ahead(frames: Iterable[Image | str | Path]) -> Iterator[Image]:
    """Pictures of frames, the next one decoded while this one is fitted."""
    source = iter(frames)

    def following() -> Image | None:
        picture = next(source, None)
        return None if picture is None else _read_frame(picture)

    with ThreadPoolExecutor(1) as decoder:
        coming = decoder.submit(following)
        while (picture := coming.result()) is not None:
            coming = decoder.submit(following)
            yield picture


def _is_copy(picture: Image, other: Image) -> bool:
    """Whether two pictures are equal pixel by pixel; a few rows already differ in any others."""
    few = slice(None, None, 64)
    return picture.size > 0 and np.array_equal(picture[few], other[few]) and np.array_equal(picture, other)


def _benchmark_index(times_s: FloatArray, benchmark_time_s: float) -> int:
    """Index of the frame nearest to the benchmark time; refused where there is none within 2 s."""
    if len(times_s) == 0:
        raise GateError("no frames", code="frame-missing")
    nearest = int(np.argmin(np.abs(times_s - benchmark_time_s)))
    if abs(times_s[nearest] - benchmark_time_s) > 2.0:
        raise GateError(
            f"no frame within 2 s of the benchmark time {benchmark_time_s} s; frames span {times_s[0]:.2f} to "
            f"{times_s[-1]:.2f} s",
            code="time-not-covered",
        )
    return nearest


def _read_frame(picture: Image | str | Path) -> Image:
    """Grey picture ``(h, w)`` uint8 from an array or a file; an unreadable file gives an empty picture."""
    return read_image(Path(picture)) if isinstance(picture, str | Path) else picture


def polar(rotation_yz_rad: FloatArray, covariance: FloatArray) -> tuple[float, float, FloatArray]:
    """Angle, plane, rad, and their covariance ``(2, 2)`` from a rotation about body y and z.

    See `flightmodel.deflection.polar_from_lateral`; the shell's rotation ``theta x_hat x d`` has the lateral vector
    ``theta d = (w_z, -w_y)``.
    """
    theta, plane, out = polar_from_lateral(_SWAP @ rotation_yz_rad, _SWAP @ covariance @ _SWAP.T)
    return float(theta), float(plane), out


def sensitivity_table(
    benchmark: Image,
    deflected: Image,
    geometry: ShellGeometry,
    camera_mount: CameraMount,
    planes_lv_rad: FloatArray,
    joint_stations_m: FloatArray,
) -> FloatArray:
    """Deflection read from one frame under other assumptions (seed paper Table 2.1).

    Returns
    -------
    (joints, planes) float
        Rad; NaN where the frame was refused. For the paper's table: planes 153, 183, 200 deg; joint at the nose (0 m)
        and at the midpoint of the innermost torus (0.20 m).
    """
    # the joint is assumed here, not uncertain
    apriori = AprioriSd(joint_station_m=1e-4)
    oriented = orient_camera(benchmark, geometry, camera_mount, float(joint_stations_m[0]), apriori)
    rows = []
    for station in joint_stations_m:
        here = replace(oriented, view=replace(oriented.view, joint_station_m=float(station)))
        rows.append([float(here.fit(deflected, _axis_of(p)).rotation_yz_rad @ _axis_of(p)) for p in planes_lv_rad])
    return np.array(rows)

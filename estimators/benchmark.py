"""How is the camera mounted, what is its lens, and how far was the shell deflected in the benchmark frame?

**Orientation** (`orient_camera`). The camera's rotation, focal scale, principal point, k1, k2 and position and the
shell's radius are fitted to the edge and the features of a frame in which the shell is taken as undeflected, each with
its a priori sd (``[cameras.*.uncertainty]``), beside the shell's own shape (flattening and saddle as built) and the
light at its edge: Gauss-Newton with Huber's weights, the points found again in every step. For an uncalibrated lens the
prior is wide, and the frame calibrates it, as the seed paper oriented its camera on the frame at 421 s. First the edge
alone is fitted, which may be far from the nominal camera's prediction; then features are looked for from farther, then
from nearer. Where few are found, the edge was not the shell's, and the feature map is searched instead
(`estimators.features`). An edge that is not the shell's, the Earth's limb say, may be fitted to a fraction of a pixel
by a camera far from its prior: such a fit is refused.

**Deflection** (`benchmark_deflection`), by the moment in the joint. That moment is what the centerbody needs to move as
it does; no other force acts on the centerbody (no aerodynamic force, as everywhere here), so its accelerometer and
gyros measure it, its oscillation included::

    tau = I w' + w x I w - r x m f,      theta = kappa (tau_z, -tau_y)

``f`` is the specific force at the centerbody's c.g., ``r`` the joint from there, ``kappa`` the joint's compliance, with
a prior so wide that it carries no information. The film reads the deflection relative to the benchmark frame's::

    read_i = theta(t_i) - R_i theta(t_b) + camera's error,     theta(t) = kappa (m(t) + A(t) x) + slack(t)

Unknown are kappa, the ``x ~ N(0, 1)`` of the moment (the accelerometer's constant errors, the centerbody's c.g. and
inertia) and the slack: deflection that does not follow the law, as by freeplay, a spring that hardens, friction. Its
size is estimated too, by the evidence of the readings over `_SLACKS_DEG`: slack of a size that the film cannot exclude
stays in the error bar. All is Gaussian, and the deflection of the benchmark frame, with its prior, is one conditional
mean and covariance, a mixture over sizes of the slack.

The same film gives and receives this deflection, so the two errors are correlated: an error common to all frames looks
like a deflection of the benchmark, and is removed with it. With ``theta(t_b) = K read``, the error ``e`` of a frame and
that of the benchmark's deflection have the covariance ``cov(e, readings' errors) K'``.

Assumed: no force on the centerbody but the joint's; slack and neglected terms Gauss-Markov in time.

References
----------
Seed paper, CAD-based estimate. C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006,
chapters 2 and 5.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.special import softmax

from estimators.body_edge import body_edge
from estimators.camera_fit import USUAL_SHARE, Image, OrientedCamera
from estimators.edge import (
    HorizonLine,
    ScanLines,
    breaks_across,
    fault_of_frame,
    is_coherent,
    steepness_of,
)
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from estimators.features import Features, ImageFeatures, fit_feature_map, no_features, valleys, visible_features
from estimators.frame_checks import USUAL_RMS_PX
from estimators.frame_edits import MARK_SD_PX, EditedFrame, MarkedFeatures, marked_on_shell, unedited
from estimators.frame_residuals import FrameResiduals, edge_residuals, feature_residuals, huber_gain, joined
from estimators.frame_solution import POSED, AprioriSd
from estimators.loads import FlightLoads
from estimators.texture import BESIDE_PAINT_PX, PaintedTexture, texture_of
from estimators.virtual_camera import DEFLECTION, FLATTENING, VirtualCamera
from flightmodel import rotations
from flightmodel.camera import Camera, camera_from_mount
from flightmodel.checks import NO_FAULT, BoolArray, FloatArray, GateError, Issue
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from flightmodel.geometry import ShellGeometry
from flightmodel.statistics import NORMAL_MAD, mixture_moments, paired_covariance, symmetric_root
from flightmodel.vehicle import CameraMount, CameraUncertainty

# orientation
_STEPS = 10
LEAST_FEATURES_SHARE = 0.5  # of stated features, to be found in the benchmark frame
TEXTURE_SD_PX = 0.05  # of a patch in the frame that it is taken from: its noise
_LEAST_EDGE = 30  # coherent points beside the valleys: an eighth of the edge in view
_WILD, _WILD_PX = 3.0, (1.0, 2.5)  # times the scatter, at least a pixel and at most `_WORST_RMS_PX`
_REACHES_PX = (0, 12, 8)  # within which features are looked for in turn; 0: the edge alone
_SETTLED_SD = 1e-2  # of a correction's a priori sd
_WORST_RMS_PX = 2.5  # several times an edge's own scatter: what stays beyond it is another shell's edge
_WORST_CORRECTIONS = 31.8  # chi-square of eight corrections that one sound frame in 10,000 exceeds
_FOCAL, _FOCAL_PIECE = 3, 0.08  # relative sd within which one search looks; a wider a priori sd is searched in pieces
_NOT_SQUARE = "pixels-not-square"
_CENTRE = [4, 5]  # among the pose
_SQUARE_SD = 0.002  # of stretch and shear: what lens coefficients that are not fitted look like, half a pixel at 250
_WORST_SQUARE = (
    9.2  # chi-square of two; the allowance included, 34 sound benchmark frames reach 0.2 with features, 8 without
)
# of a shell as built, whose waves are not in the drawing: 8 mm at a radius of 1.5 m; assumed
_BUILT_RAD = np.deg2rad(0.3)
_BUILT = [0, 1, -3, -2, -1]  # saddle and light: more waves beside a lens that is fitted cost more than they explain
_POSES = POSED.stop - POSED.start
# turns tried where the camera as mounted sees no shell: about right, down and the line of sight; a fit reaches from one
# to the next (10 deg are 3 sd of a mount by a drawing)
_TURNS_RAD = np.deg2rad(
    [
        *([0.0, 0.0, roll] for roll in range(20, 360, 20)),
        [20.0, 0.0, 0.0],
        [-20.0, 0.0, 0.0],
        [0.0, 20.0, 0.0],
        [0.0, -20.0, 0.0],
    ]
)
# deflection
LEAST_FRAMES, MOST_FRAMES = 12, 150
_LONGEST_HOLE_S = 0.11  # a quarter of a period at 2.3 Hz, over which the joint's moment is interpolated
LOADED = 3.0  # largest moment over the benchmark's
_WORST_TIME_BIAS_S = 0.03  # half a radian of oscillation at 2.5 Hz
_LEFT_OUT = 0.05  # of the deflection: damping, oscillation that the sensors' windows smooth
_SLACK_TIME_S = 2.5  # assumed: friction and freeplay follow the load, which changes in seconds
_SLACKS_DEG, _FREEPLAYS_DEG = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64), (0.0, 0.05, 0.1, 0.2, 0.4, 0.8)
_SIZES_RAD = np.deg2rad(list(product(_SLACKS_DEG, _FREEPLAYS_DEG)))
_USUAL_RAD = np.deg2rad([0.04, 0.1])  # sizes at which the compliance is estimated that scales the law's errors
_PASSES = 2  # the second with the errors of the law that the first one's compliance scales
_WIDE = 30.0  # prior sd of the compliance, in the values found


@dataclass(frozen=True)
class _Look:
    """Points found in the benchmark frame from one pose of the camera."""

    view: VirtualCamera
    lines: ScanLines
    horizon: HorizonLine
    residuals: FrameResiduals
    clocks_rad: FloatArray


def orient_camera(
    benchmark: Image | EditedFrame,
    geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    apriori: AprioriSd | None = None,
    pose: FloatArray | None = None,
) -> OrientedCamera:
    """Fit the camera's orientation and lens on a frame taken as undeflected.

    Parameters
    ----------
    benchmark : (h, w) uint8, or with what an analyst decided about it
    geometry : ShellGeometry
    camera_mount : CameraMount
        Nominal position, pointing and lens, with their a priori sd.
    joint_station_m : float
        Joint aft of the nose, m.
    apriori : AprioriSd, optional
    pose : (4,) float, optional
        Rotation of the camera about its own axes, rad, and a factor on its focal length, which the analyst states
        against the mount's.

    Raises
    ------
    GateError
        When the frame cannot be used, with the reason.
    """
    apriori = apriori or AprioriSd()
    frame = unedited(benchmark)
    fault = fault_of_frame(frame.image, camera_mount.size_px)
    if fault:
        file = "check the film's file, or " if fault.code == "frame-undecodable" else ""
        raise GateError(f"benchmark frame: {fault}; {file}choose another benchmark time", fault.code)
    camera = camera_from_mount(camera_mount)
    if pose is not None:
        camera = camera.turned(pose[:3], float(pose[3]))
    nominal = VirtualCamera(geometry, camera, joint_station_m)
    prior = _prior_sd(camera_mount.uncertainty, apriori)
    refused = NO_FAULT
    if geometry.features not in ("none", "texture"):
        oriented, refused = _by_stated_features(nominal, frame, prior, apriori)
        if oriented is not None:
            return _with_marked(_with_texture_behind(oriented, frame), frame)
    try:
        oriented = _oriented(nominal, frame, prior, apriori, valleys)
    except GateError as refused_as_mounted:
        seen = _turn_seen(nominal, frame, prior, apriori)
        if not seen:
            raise
        raise GateError(f"{refused_as_mounted}; {seen}", refused_as_mounted.codes[0]) from None
    if oriented.has_bad_benchmark:
        raise GateError(
            f"benchmark frame: {100.0 * oriented.support:.0f} % of the valleys between tori and "
            f"{100.0 * oriented.edge_in_view:.0f} % of the edge are where the camera should see them, with an rms of "
            f"{oriented.residual_rms_px:.1f} px, {USUAL_RMS_PX:.1f} px being usual: choose another benchmark time, or "
            "check mount, lens, shell and [cameras.NAME.uncertainty] in the vehicle file",
            code="benchmark-implausible",
        )
    # the valleys' places change with the light: they orient the camera, and measure no motion
    edge = oriented.benchmark_residuals.index < len(oriented.clocks_rad)
    rows = oriented.benchmark_residuals.some(edge)
    alone = replace(oriented, features=no_features(), benchmark_residuals=rows, stated_refused=refused)
    return _with_marked(alone if geometry.features == "none" else _with_texture(alone, frame), frame)


def _by_stated_features(
    nominal: VirtualCamera, benchmark: EditedFrame, prior: FloatArray, apriori: AprioriSd
) -> tuple[OrientedCamera | None, Issue]:
    """Camera oriented by the features that the vehicle file states, or why the frame does not bear them out."""
    try:
        oriented = _oriented(nominal, benchmark, prior, apriori, visible_features)
    except GateError as fault:
        if _NOT_SQUARE in fault.codes:
            raise
        return None, Issue(f"the stated features do not orient the camera ({fault})", fault.codes[0])
    if oriented.support > LEAST_FEATURES_SHARE and oriented.residual_rms_px < USUAL_RMS_PX:
        return oriented, NO_FAULT
    words = (
        f"the benchmark frame shows {100.0 * oriented.support:.0f} % of the features that the vehicle file states, "
        f"with an rms of {oriented.residual_rms_px:.1f} px"
    )
    return None, Issue(words, "features-not-found")


def _with_texture_behind(oriented: OrientedCamera, benchmark: EditedFrame) -> OrientedCamera:
    """Add the benchmark frame's texture behind the painted features that oriented the camera."""
    painted = oriented.features
    assert isinstance(painted, ImageFeatures)
    both = PaintedTexture(painted, texture_of(oriented.view, benchmark.image, BESIDE_PAINT_PX))
    return _with_features(oriented, both, benchmark, TEXTURE_SD_PX, len(painted.across_px))


def _with_texture(oriented: OrientedCamera, benchmark: EditedFrame) -> OrientedCamera:
    """Add the benchmark frame's texture."""
    return _with_features(oriented, texture_of(oriented.view, benchmark.image), benchmark, TEXTURE_SD_PX, 0)


def _with_marked(oriented: OrientedCamera, benchmark: EditedFrame) -> OrientedCamera:
    """Add the features that an analyst marked in the benchmark frame."""
    if not benchmark.features_px:
        return oriented
    before = oriented.features
    marked = MarkedFeatures(before, *marked_on_shell(oriented.view, benchmark.features_px))
    return _with_features(oriented, marked, benchmark, MARK_SD_PX, len(before.across_px))


def _with_features(
    oriented: OrientedCamera, features: Features, benchmark: EditedFrame, sd_px: float, first: int
) -> OrientedCamera:
    """Add features from row ``first`` on, whose position in the benchmark frame is exact by construction."""
    pixels = oriented.view.sight(features.points_shell_m, np.zeros(3)).pixels
    new = (np.arange(len(pixels)) >= first) & benchmark.is_clear(np.nan_to_num(pixels, nan=-1.0))
    found = np.einsum("ni,ni->n", pixels, features.across_px), np.where(new, sd_px, np.inf)
    rows = feature_residuals(oriented.view, features, found, np.zeros(3), len(oriented.clocks_rad))
    return replace(oriented, features=features, benchmark_residuals=joined(oriented.benchmark_residuals, rows))


def _oriented(
    nominal: VirtualCamera, benchmark: EditedFrame, prior: FloatArray, apriori: AprioriSd,
    features_of: Callable[[VirtualCamera], ImageFeatures],
) -> OrientedCamera:  # fmt: skip
    """Fit from the nominal pose and, if the result is poor, again with short reaches and from the feature map's pose.

    The edge seen from far may have been the Earth's; features and the valleys between tori are the shell's alone.
    """
    found: list[OrientedCamera] = []
    trouble: GateError | None = None
    for pose, reaches_px, from_map in _starts(nominal, benchmark, prior, features_of):
        try:
            found.append(_fitted(nominal, benchmark, prior, apriori, pose, reaches_px, features_of, from_map))
        except GateError as fault:
            trouble = trouble or fault
            continue
        if found[-1].support > USUAL_SHARE and found[-1].residual_rms_px < USUAL_RMS_PX:
            return found[-1]
    if not found:
        assert trouble is not None
        raise trouble
    return max(found, key=lambda one: one.support / one.residual_rms_px)


def _starts(
    nominal: VirtualCamera, benchmark: EditedFrame, prior: FloatArray,
    features_of: Callable[[VirtualCamera], ImageFeatures],
) -> Iterator[tuple[FloatArray, tuple[int, ...], bool]]:  # fmt: skip
    """Poses to start from, the reaches of each, and whether it is the feature map's; each is made when asked for."""
    yield np.zeros(_POSES), _REACHES_PX, False
    yield np.zeros(_POSES), _REACHES_PX[1:], False
    pose = _pose_of_feature_map(nominal, benchmark.image, prior, features_of(nominal))
    if pose is not None:
        yield pose, _REACHES_PX[1:], True


def _turn_seen(nominal: VirtualCamera, benchmark: EditedFrame, prior: FloatArray, apriori: AprioriSd) -> str:
    """Camera rotation, as text, that would bring the shell to where it is expected; empty if no rotation fits."""
    best: tuple[float, FloatArray] | None = None
    for turn in _TURNS_RAD:
        view = replace(nominal, camera=nominal.camera.turned(turn, 1.0))
        with suppress(GateError):
            found = _fitted(view, benchmark, prior, apriori, np.zeros(_POSES), _REACHES_PX, valleys)
            score = found.support / max(found.residual_rms_px, 1e-3)
            is_sound = found.support > USUAL_SHARE and found.residual_rms_px < USUAL_RMS_PX
            if is_sound and found.edge_in_view > USUAL_SHARE and (best is None or score > best[0]):
                best = score, turn + found.corrections[:3]
    if best is None:
        return ""
    across, roll = np.rad2deg([np.hypot(*best[1][:2]), (best[1][2] + np.pi) % (2.0 * np.pi) - np.pi])
    return (
        f"the shell is where a camera would see it that is turned by about {abs(roll):.0f} deg about its line of sight "
        f"and by {across:.0f} deg across it: check the mount's angles in the vehicle file before the time"
    )


def with_deflected_benchmark(oriented: OrientedCamera, theta_rad: float, plane_lv_rad: float) -> OrientedCamera:
    """Camera as it was mounted if the shell had this deflection in the benchmark frame, to first order.

    The fit took the shell as undeflected there, and rotated the camera instead.
    """
    deflection = rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))[1:]
    return replace(oriented, view=_posed(oriented.view, -oriented.posed_per_deflection @ deflection))


def _fitted(
    nominal: VirtualCamera, benchmark: EditedFrame, prior: FloatArray, apriori: AprioriSd, pose: FloatArray,
    reaches_px: tuple[int, ...], features_of: Callable[[VirtualCamera], ImageFeatures], from_map: bool = False,
) -> OrientedCamera:  # fmt: skip
    """Fit the pose from a start, features looked for within each reach; refused where the edge is not the shell's.

    Where the start is ``from_map``, first by the features alone, as the edge may be farther off.
    """
    for number, reach in enumerate(reaches_px):
        alone = number == 0 and from_map
        features = features_of(_posed(nominal, pose))
        sd = np.append(prior, max(features.offset_px, 1e-6))
        for _ in range(_STEPS):
            look = _look(_posed(nominal, pose), features, benchmark, reach, features.placed_m)
            residuals = look.residuals
            if alone:
                residuals = residuals.some(residuals.index >= len(look.clocks_rad))
            if not len(residuals.index):
                raise GateError(
                    "benchmark frame: neither a point of the edge nor a feature where the camera should see them; "
                    "choose another benchmark time",
                    code="edge-points-too-few",
                )
            offset = residuals.index >= len(look.clocks_rad)
            shape = np.column_stack([residuals.rows[:, FLATTENING], residuals.shape[:, _BUILT], offset])
            design = np.column_stack([residuals.rows[:, POSED], shape])
            gain, formal, rms = huber_gain(residuals, design, np.diag(sd**-2.0), len(look.clocks_rad))
            before = np.concatenate([pose, np.zeros(len(sd) - _POSES)])
            step = gain @ residuals.residual_px - formal @ (before / sd**2)
            pose = pose + step[:_POSES]
            if np.abs(step[:_POSES] / prior[:_POSES]).max() < _SETTLED_SD:
                break
    if features.offset_px:
        # nothing but smooth curves: neighbours on an edge err together
        edge = residuals.index < len(look.clocks_rad)
        if edge.sum() < _LEAST_EDGE:
            raise GateError(
                f"benchmark frame: {edge.sum()} points of the edge where {_LEAST_EDGE} are needed; choose another "
                "benchmark time",
                code="edge-points-too-few",
            )
        left = residuals.residual_px - design[:, _POSES:] @ (gain @ residuals.residual_px)[_POSES:]
        together = np.where(edge, samples_together(left[edge]), 1.0)
        gain, formal, _ = huber_gain(residuals, design, np.diag(sd**-2.0), len(look.clocks_rad), together)
    if rms > _WORST_RMS_PX:
        raise GateError(
            f"benchmark frame: rms {rms:.1f} px where {_WORST_RMS_PX} px are allowed: the edge is not the shell's; "
            "choose another benchmark time",
            code="edge-not-shell",
        )
    off = float(np.sum((pose[:8] / prior[:8]) ** 2))
    if off > _WORST_CORRECTIONS:
        raise GateError(
            f"benchmark frame: the corrections of orientation and lens are {np.sqrt(off / 8.0):.1f} sd (rms of eight) "
            f"from the vehicle file, where {np.sqrt(_WORST_CORRECTIONS / 8.0):.1f} are allowed: the edge is not the "
            "shell's; choose another benchmark time, or check the mount, the lens and [cameras.NAME.uncertainty]",
            code="camera-far-from-prior",
        )
    _check_square(look, features, residuals, design, sd)
    # the error of where a feature was painted is in every frame alike: other frames weigh by its measurement alone
    look = _look(_posed(nominal, pose), features, benchmark, reaches_px[-1], 0.0)
    per_deflection = gain[:_POSES] @ residuals.rows[:, DEFLECTION]
    return OrientedCamera(
        look.view, look.clocks_rad, look.lines, features, apriori, look.horizon, look.residuals, pose[:8],
        formal[:_POSES, :_POSES], per_deflection, rms, support=_share_found(look, features),
        breaks=breaks_across(benchmark.image), steepness=steepness_of(benchmark.image, look.horizon),
        body=body_edge(look.view, benchmark.kept),
    )  # fmt: skip


def _check_square(
    look: _Look, features: Features, residuals: FrameResiduals, design: FloatArray, sd: FloatArray
) -> None:  # fmt: skip
    """Refuse a picture whose pixels are not square, or whose rows are not at right angles to its columns.

    No mount and no lens explains that. Relative stretch and shear are fitted beside all else at the solution.
    """
    lines = len(look.clocks_rad)
    spots = np.full((lines + len(features.points_shell_m), 2), np.nan)
    spots[look.horizon.line] = look.horizon.points_px
    spots[lines:] = look.view.sight(features.points_shell_m, np.zeros(3)).pixels
    u, v = (spots[residuals.index] - look.view.camera.centre_px).T
    by_u, by_v = residuals.rows[:, POSED][:, _CENTRE].T
    columns = 0.5 * np.column_stack([u * by_u - v * by_v, v * by_u + u * by_v])
    # a sd of one is no knowledge of either, and an answer where few points determine neither
    information = np.diag(np.concatenate([sd**-2.0, [1.0, 1.0]]))
    gain, covariance, _ = huber_gain(residuals, np.column_stack([design, columns]), information, lines)
    found = (gain @ residuals.residual_px)[-2:]
    allowed = covariance[-2:, -2:] + _SQUARE_SD**2 * np.eye(2)
    if found @ np.linalg.solve(allowed, found) > _WORST_SQUARE:
        raise GateError(
            f"benchmark frame: its pixels seem stretched by {100.0 * found[0]:.1f} % and sheared by "
            f"{100.0 * found[1]:.1f} %, or the shell or the lens is not the vehicle file's: state the picture's true "
            "size and focal_px of both axes",
            code=_NOT_SQUARE,
        )


def _share_found(look: _Look, features: Features) -> float:
    """Share of features in view that a look at the benchmark frame found."""
    found = int((look.residuals.index >= len(look.clocks_rad)).sum())
    return found / max(len(features.points_shell_m), 1)


def samples_together(residual: FloatArray) -> float:
    """Correlated samples in a row of residuals (n,): one plus twice the sum of the autocorrelation.

    The sum ends where the autocorrelation first is not positive.
    """
    off = residual - residual.mean()
    own = np.correlate(off, off, mode="full")[len(off) - 1 :] / max(float(off @ off), 1e-12)
    ends = np.flatnonzero(own <= 0.0)
    return 1.0 + 2.0 * float(own[1 : ends[0] if len(ends) else len(own)].sum())


def _pose_of_feature_map(
    nominal: VirtualCamera, image: Image, prior: FloatArray, painted: ImageFeatures
) -> FloatArray | None:
    """Pose (12,) at which features fit the frame best; None where it is not significant."""
    points = painted.points_shell_m
    if len(points) == 0:
        return None

    def pixels(drawn: FloatArray) -> FloatArray:
        poses = np.pad(drawn, ((0, 0), (0, _POSES - drawn.shape[1])))
        lenses = nominal.camera.terms_of_turned(poses[:, :3], 1.0 + poses[:, 3], **_moved_lens(nominal.camera, poses))
        return nominal.pixels_of_each(points, np.zeros((1, 3)), lenses)

    # the focal length is what may be far off: it is searched in pieces
    sd = prior[:8].copy()
    pieces = max(1, round(sd[_FOCAL] / _FOCAL_PIECE))
    sd[_FOCAL] = min(sd[_FOCAL], _FOCAL_PIECE)
    starts = [np.eye(8)[_FOCAL] * scale for scale in _FOCAL_PIECE * (np.arange(2 * pieces - 1) - (pieces - 1))]
    found = fit_feature_map(image, pixels, starts, sd, painted.signs)
    return None if found is None else np.concatenate([found, np.zeros(_POSES - 8)])


def _prior_sd(camera: CameraUncertainty, apriori: AprioriSd) -> FloatArray:
    """A priori sd of the pose (12), the shell's flattening and saddle as built (3) and the light (3)."""
    sd = [
        *[np.deg2rad(camera.pointing_deg)] * 3, camera.focal, *[camera.centre_px] * 2, camera.k1, camera.k2,
        *[camera.position_m] * 3, apriori.rim_radius_m, *[_BUILT_RAD] * 3, *[apriori.edge_px] * 3,
    ]  # fmt: skip
    # no sd is zero: an exact parameter is good to a thousandth of a pixel or so
    return np.maximum(np.array(sd), 1e-6)


def _posed(nominal: VirtualCamera, pose: FloatArray) -> VirtualCamera:
    moved = nominal.camera.turned(pose[:3], 1.0 + pose[3], **_moved_lens(nominal.camera, pose))
    return replace(nominal, camera=moved)


def _moved_lens(camera: Camera, pose: FloatArray) -> dict[str, FloatArray]:
    """Parameters of a camera other than rotation and focal scale, moved by poses (..., 12)."""
    k1_k2 = np.zeros((*pose.shape[:-1], len(camera.distortion)))
    k1_k2[..., :2] = pose[..., 6:8]
    return {
        "centre_px": camera.centre_px + pose[..., 4:6],
        "distortion": camera.distortion + k1_k2,
        "position_body_m": camera.position_body_m + pose[..., 8:11],
    }


def _look(
    view: VirtualCamera, features: Features, frame: EditedFrame, reach_px: int, placed_m: float
) -> _Look:  # fmt: skip
    """Find the edge and, with a reach, the features around their prediction."""
    at_rest = np.zeros(3)
    clocks = view.edge_clocks()
    lines = view.lines_at(clocks, at_rest)
    horizon = frame.far_edge(lines, view.camera.size_px)
    if reach_px:
        horizon = frame.near_edge(lines)
    elif not horizon.is_usable:
        raise GateError(f"benchmark frame: {horizon.refused}; choose another benchmark time", horizon.refused.code)
    residuals = edge_residuals(view, horizon, at_rest)
    if reach_px:
        # steps in the clouds behind the rim
        off = np.abs(residuals.residual_px)
        scatter = NORMAL_MAD * float(np.nanmedian(off)) if len(off) else 0.0
        residuals = residuals.some(off < np.clip(_WILD * scatter, *_WILD_PX))
        if not horizon.is_by_hand:
            residuals = residuals.some(is_coherent(residuals.index, residuals.residual_px))
        found = frame.features(features, view, at_rest, reach_px)
        painted = feature_residuals(view, features, found, at_rest, len(clocks))
        at = features.points_shell_m[painted.index - len(clocks)]
        away = np.linalg.norm(at - view.camera.position_body_m, axis=1)
        painted = replace(painted, sd_px=np.hypot(painted.sd_px, placed_m * view.camera.focal_px.mean() / away))
        residuals = joined(residuals, painted)
    return _Look(view, lines, horizon, residuals.some(np.isfinite(residuals.residual_px)), clocks)


@dataclass(frozen=True)
class BenchmarkDeflection:
    """Deflection of the benchmark frame as a lateral vector (2,), rad, body y and z, and its covariance (2, 2).

    ``with_readings`` (n, 2, 2): covariance of every reading's error (rows) with this one's; None: they are independent.
    """

    theta_yz_rad: FloatArray
    covariance: FloatArray
    with_readings: FloatArray | None = None

    @property
    def remark(self) -> str:
        """Size, clocking angle and sd, for the middle of a sentence."""
        size = np.rad2deg(np.hypot(*self.theta_yz_rad))
        sd = np.rad2deg(np.sqrt(0.5 * np.trace(self.covariance)))
        plane = np.rad2deg(lv_clock(self.theta_yz_rad))
        return (
            f"deflected there by {size:.2f} deg towards {plane:.0f} deg LV, +/- {sd:.2f} deg an axis, by the moment "
            "that the inertial sensors measured in the joint"
        )


@dataclass(frozen=True)
class RelativeDeflections:
    """Deflections of a film relative to its benchmark frame's; lateral vectors, body y and z.

    Parameters
    ----------
    time_s : (n,) float
    theta_yz_rad : (n, 2) float
    covariance : (n, 2, 2) float
        Without the benchmark deflection's.
    per_benchmark : (n, 2, 2) float
        ``R``: missing part of a reading per unit deflection of the benchmark frame.
    benchmark_s : float
    time_bias_sd_s : float
        A priori sd of the frames' time bias against the gyros'.
    by_shape : (n, 2, 13 (1 + c)) float or None
        Part of the readings' error that the shell's shape under load has in common, per unit normal; its square is in
        ``covariance``.
    """

    time_s: FloatArray
    theta_yz_rad: FloatArray
    covariance: FloatArray
    per_benchmark: FloatArray
    benchmark_s: float
    time_bias_sd_s: float = 0.0
    by_shape: FloatArray | None = None

    @property
    def own_covariance(self) -> FloatArray:
        """Covariance (n, 2, 2) without the shape's part."""
        if self.by_shape is None:
            return self.covariance
        return self.covariance - self.by_shape @ self.by_shape.transpose(0, 2, 1)

    def added_to(self, start: BenchmarkDeflection) -> tuple[FloatArray, FloatArray]:
        """Deflections (n, 2) from a benchmark frame's own, and twice the covariance (n, 2, 2) of both their errors."""
        theta_yz = self.theta_yz_rad + self.per_benchmark @ start.theta_yz_rad
        if start.with_readings is None:
            return theta_yz, np.zeros_like(self.covariance)
        crossed = start.with_readings @ self.per_benchmark.transpose(0, 2, 1)
        return theta_yz, crossed + crossed.transpose(0, 2, 1)

    @property
    def answered(self) -> BoolArray:
        """Whether each frame has an answer, (n,)."""
        return np.asarray(np.isfinite(self.theta_yz_rad).all(axis=1))


@dataclass(frozen=True)
class _Moment:
    """At times (n,): moment as a lateral vector (n, 2), N m, its response to each input (n, 2, k), its noise's sd."""

    value_nm: FloatArray
    by_input_nm: FloatArray
    noise_nm: float

    def at(self, time_s: FloatArray, at_s: FloatArray) -> _Moment:
        """Linear interpolation."""
        flat = np.concatenate([self.value_nm[:, :, None], self.by_input_nm], axis=2).reshape(len(time_s), -1)
        here = np.stack([np.interp(at_s, time_s, column) for column in flat.T], axis=-1).reshape(len(at_s), 2, -1)
        return _Moment(here[:, :, 0], here[:, :, 1:], self.noise_nm)


def joint_moment(loads: FlightLoads) -> _Moment:
    """Moment in the joint at all samples, positive where it deflects the shell towards the vector."""
    vehicle, body = loads.vehicle, loads.vehicle.centerbody
    known, rate, turn = vehicle.uncertainty, loads.rate_body_radps, loads.angular_acceleration_body_radps2
    lever = rotations.lever_arm_acceleration(rate, turn, body.cg_m - vehicle.cg_m)
    force = loads.specific_force_body_mps2 + lever
    arm = vehicle.joint_m - body.cg_m
    spin = turn @ body.inertia.T + np.cross(rate, rate @ body.inertia.T)
    shifts = np.diag([known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m])
    parts = [known.inertia * spin, *(np.cross(shift, body.mass_kg * force) for shift in shifts)]
    parts += [-np.cross(arm, body.mass_kg * column) for column in np.moveaxis(loads.force_root_mps2, 2, 0)]
    noise = np.hypot(
        body.inertia[1, 1] * loads.angular_acceleration_sd_radps2,
        abs(arm[0]) * body.mass_kg * loads.force_noise_sd_mps2,
    )
    value = spin - np.cross(arm, body.mass_kg * force)
    return _Moment(_lateral(value), np.stack([_lateral(part) for part in parts], axis=-1), float(noise))


def _lateral(moment: FloatArray) -> FloatArray:
    return np.stack([moment[:, 2], -moment[:, 1]], axis=-1)


def benchmark_deflection(frames: RelativeDeflections, loads: FlightLoads, prior_sd_rad: float) -> BenchmarkDeflection:
    """Deflection of the benchmark frame from the moment in the joint.

    Parameters
    ----------
    frames : RelativeDeflections
    loads : FlightLoads
    prior_sd_rad : float
        A priori sd of each axis, about zero.

    Raises
    ------
    GateError
        Where it is not observable, with the reason.
    """
    if frames.time_bias_sd_s > _WORST_TIME_BIAS_S:
        raise GateError(
            f"camera time bias known to {frames.time_bias_sd_s:.2f} s, where the joint's period of 0.4 s needs "
            f"{_WORST_TIME_BIAS_S} s",
            code="camera-time-bias",
        )
    known = frames.answered & _measured(frames.time_s, loads.time_s)
    if not _measured(np.array([frames.benchmark_s]), loads.time_s)[0]:
        raise GateError("accelerometer and gyros have no data at the benchmark frame", code="data-gap")
    rows = np.flatnonzero(known)
    rows = rows[:: max(1, -(-len(rows) // MOST_FRAMES))]
    if len(rows) < LEAST_FRAMES:
        raise GateError(f"{len(rows)} frames with sensor data where {LEAST_FRAMES} are needed", code="too-few-data")
    times = np.append(frames.time_s[rows], frames.benchmark_s)
    whole = joint_moment(loads)
    moment = whole.at(loads.time_s, times)
    size = np.linalg.norm(moment.value_nm, axis=1)
    if size.max() < LOADED * size[-1]:
        raise GateError(
            f"the largest moment in the joint is {size.max() / size[-1]:.1f} times the benchmark frame's, where "
            f"{LOADED:g} are needed",
            code="benchmark-loaded",
        )
    if frames.time_bias_sd_s > 0.0:
        late = whole.at(loads.time_s, times + frames.time_bias_sd_s).value_nm - moment.value_nm
        moment = _Moment(
            moment.value_nm, np.concatenate([moment.by_input_nm, late[:, :, None]], axis=2), whole.noise_nm
        )
    return _mixture(frames, rows, times, moment, prior_sd_rad)


def _measured(at_s: FloatArray, time_s: FloatArray) -> BoolArray:
    """Mask of times with samples close by on both sides."""
    after = np.searchsorted(time_s, at_s).clip(1, len(time_s) - 1)
    inside = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    return np.asarray(inside & (time_s[after] - time_s[after - 1] < _LONGEST_HOLE_S))


def _mixture(
    frames: RelativeDeflections, rows: NDArray[np.intp], times: FloatArray, moment: _Moment, prior_sd_rad: float
) -> BenchmarkDeflection:
    """Posterior of the benchmark's deflection over all sizes of the slack."""
    n = len(rows)
    design = np.hstack([np.eye(2 * n), -frames.per_benchmark[rows].reshape(2 * n, 2)])
    prior = np.hstack([np.zeros((2, 2 * n)), np.eye(2)])
    design = np.vstack([design, prior])  # the benchmark's prior of zero: a reading more
    read = np.append(frames.theta_yz_rad[rows].ravel(), np.zeros(2))
    camera = _camera_covariance(frames, rows, rows)
    apart = np.abs(times[:, None] - times[None, :])
    correlation = np.asarray(np.kron(np.exp(-apart / _SLACK_TIME_S), np.eye(2)), dtype=float)
    # freeplay is taken up towards the moment's side, as far as its sign is determined
    sd_nm = np.sqrt(np.sum(moment.by_input_nm**2, axis=(1, 2)) + moment.noise_nm**2)
    length = np.hypot(np.linalg.norm(moment.value_nm, axis=1), sd_nm)
    side, unsure = (moment.value_nm / length[:, None]).ravel(), np.repeat(sd_nm / length, 2)
    taken_up = np.outer(side, side) + np.outer(unsure, unsure) * correlation
    load = (design @ moment.value_nm.ravel())[: 2 * n]
    compliance = float(load @ read[: 2 * n] / (load @ load))

    def posterior(slack_rad: float, freeplay_rad: float) -> _Posterior:
        error = block_diag(camera, (prior_sd_rad**2 + slack_rad**2 + freeplay_rad**2) * np.eye(2))
        law = _law_covariance(moment, compliance, correlation)
        return _posterior(law + slack_rad**2 * correlation + freeplay_rad**2 * taken_up, design, read, error, moment)

    for _ in range(_PASSES):
        compliance = posterior(*_USUAL_RAD).compliance
    found = [posterior(*sizes) for sizes in _SIZES_RAD]
    evidence = np.array([one.log_evidence for one in found])
    weight = softmax(evidence)
    gain = np.einsum("k,kij->ij", weight, [one.gain for one in found])
    means, covariances = (np.array(x) for x in zip(*((one.gain @ read, one.covariance) for one in found), strict=True))
    mean, spread = mixture_moments(weight, means, covariances)
    # shapes of slack and freeplay are assumed: their part here stays in the error bar
    slack_var, freeplay_var = weight @ _SIZES_RAD**2
    stays = float(slack_var + freeplay_var * unsure[-1] ** 2)
    answered = np.flatnonzero(frames.answered)
    together = np.full((len(frames.time_s), 2, 2), np.nan)
    together[answered] = (_camera_covariance(frames, answered, rows) @ gain[:, : 2 * n].T).reshape(-1, 2, 2)
    return BenchmarkDeflection(mean, spread + stays * np.eye(2), together)


def _camera_covariance(frames: RelativeDeflections, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> FloatArray:
    """Covariance of readings, (2 n, 2 m): constant bias and Gauss-Markov with the light, as in the fusion, and shape.

    The error by a shape that grows with the load grows with it: it must not pass for the joint's compliance.
    """
    own = frames.own_covariance
    apart = np.abs(frames.time_s[rows][:, None] - frames.time_s[columns][None, :])
    shared = CONSTANT_PART + (1.0 - CONSTANT_PART) * np.exp(-apart / LIGHT_TIME_S)
    both = paired_covariance(symmetric_root(own[rows]), shared, symmetric_root(own[columns]))
    if frames.by_shape is not None:
        left, right = (frames.by_shape[k].reshape(2 * len(k), -1) for k in (rows, columns))
        both += left @ right.T
    return both


def _law_covariance(moment: _Moment, compliance: float, correlation: FloatArray) -> FloatArray:
    """Covariance of the deflection at all times, without slack: compliance, moment and neglected terms."""
    flat = compliance * moment.value_nm.ravel()
    inputs = compliance * moment.by_input_nm.reshape(len(flat), -1)
    size = _LEFT_OUT * np.repeat(compliance * np.linalg.norm(moment.value_nm, axis=1), 2)
    noise = (compliance * moment.noise_nm) ** 2 * np.eye(len(flat))
    return _WIDE**2 * np.outer(flat, flat) + inputs @ inputs.T + np.outer(size, size) * correlation + noise


@dataclass(frozen=True)
class _Posterior:
    """Posterior of the benchmark's deflection: gain (2, m) on the readings, covariance, compliance, log evidence."""

    gain: FloatArray
    covariance: FloatArray
    compliance: float
    log_evidence: float


def _posterior(
    prior: FloatArray, design: FloatArray, read: FloatArray, error: FloatArray, moment: _Moment
) -> _Posterior:
    cross = prior @ design.T
    factor = cho_factor(design @ cross + error, lower=True)
    solved = cho_solve(factor, read)
    theta = cross @ solved
    last = slice(-2, None)
    gain = cho_solve(factor, cross[last].T).T
    covariance = prior[last, last] - gain @ cross[last].T
    flat = moment.value_nm.ravel()
    log = -0.5 * float(read @ solved) - float(np.log(np.diag(factor[0])).sum())
    return _Posterior(gain, covariance, float(flat @ theta / (flat @ flat)), log)

"""How was the camera really built in, and what does its lens really do? Told by a frame in which the shell is not bent.

The camera's turn, focal scale, principal point, k1, k2 and position and the shell's radius are fitted to the edge and
the marks of that frame, each held by what was known of it before the flight (``[cameras.*.uncertainty]``), beside the
shell's own shape (its flattening and ovality as built) and the light at its edge. For a lens that nobody calibrated the
prior is wide, and the frame calibrates it, as the seed paper oriented its camera on the frame at 421 s.

First the edge alone is fitted, which may be far from where the nominal camera expects it; then marks are looked for
from farther, then from nearer. Where few turn up, the edge was not the shell's, and the pattern of all marks is looked
for instead (`estimators.pattern`). An edge that is not the shell's, the Earth's limb say, may be fitted to a fraction
of a pixel by a camera that is far from what was known: such a fit is none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimators.camera_fit import POSED, HeldFixed, OrientedCamera
from estimators.horizon import HorizonLine, ScanLines, fault_of_frame, find_horizon, steps_near
from estimators.marks import Marks, visible_marks
from estimators.pattern import fitted_pattern
from estimators.seen import Image, Seen, edge_seen, found_marks, huber_gain, joined, marks_seen
from estimators.virtual_camera import BENDING, FLATTENING, VirtualCamera
from flightmodel.camera import camera_from_mount
from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import rotation_vector_body_shell
from flightmodel.vehicle import CameraMount, CameraUncertainty, ShellGeometry

STEPS = 10
REACHES_PX = (0, 12, 8)
SETTLED_SD = 1e-2
USUAL_SHARE, USUAL_RMS_PX = 0.75, 1.0
WORST_RMS_PX = 2.5
WORST_CORRECTIONS = 31.8  # chi-square of eight corrections that one sound frame in 10,000 exceeds
PAINTED_M = 0.003
FOCAL, FOCAL_PIECE = 3, 0.08
BUILT_RAD = np.deg2rad(0.3)
POSES = POSED.stop - POSED.start


@dataclass(frozen=True)
class _Look:
    """What was found in the benchmark frame from one pose of the camera."""

    view: VirtualCamera
    lines: ScanLines
    horizon: HorizonLine
    seen: Seen
    clocks_rad: FloatArray


def orient_camera(
    benchmark: Image,
    geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    held: HeldFixed | None = None,
) -> OrientedCamera:
    """Fit the camera's orientation and lens on a frame taken as not bent.

    Parameters
    ----------
    benchmark : (h, w) uint8
    geometry : ShellGeometry
    camera_mount : CameraMount
        Nominal position, pointing and lens, and how well they are known.
    joint_station_m : float
        Joint aft of the nose, m.
    held : HeldFixed, optional

    Raises
    ------
    GateError
        When the frame cannot be used, with the reason.
    """
    held = held or HeldFixed()
    fault = fault_of_frame(benchmark, (camera_mount.width_px, camera_mount.height_px))
    if fault:
        raise GateError(f"benchmark frame: {fault}; choose another benchmark time")
    nominal = VirtualCamera(geometry, camera_from_mount(camera_mount), joint_station_m)
    prior = _prior_sd(camera_mount.uncertainty, held)
    try:
        oriented = _fitted(nominal, benchmark, prior, held, np.zeros(POSES), REACHES_PX)
        if oriented.marks_share > USUAL_SHARE and oriented.residual_rms_px < USUAL_RMS_PX:
            return oriented
        trouble = None
    except GateError as no_edge:
        oriented, trouble = None, no_edge
    # the edge may have been the Earth's: the pattern of marks is the shell's alone
    pose = _pose_of_pattern(nominal, benchmark, prior)
    if pose is not None:
        try:
            other = _fitted(nominal, benchmark, prior, held, pose, REACHES_PX[1:])
        except GateError as fault_of_pattern:
            trouble = trouble or fault_of_pattern
        else:
            if oriented is None or other.marks_share / other.residual_rms_px > (
                oriented.marks_share / oriented.residual_rms_px
            ):
                return other
    if oriented is None:
        assert trouble is not None
        raise trouble
    return oriented


def with_bent_benchmark(oriented: OrientedCamera, theta_rad: float, plane_lv_rad: float) -> OrientedCamera:
    """Camera as it was built in if the shell was bent by so much in the benchmark frame, to first order.

    The fit took the shell as not bent there, and turned the camera instead.
    """
    bending = rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))[1:]
    return replace(oriented, view=_posed(oriented.view, -oriented.posed_per_bending @ bending))


def _fitted(
    nominal: VirtualCamera, benchmark: Image, prior: FloatArray, held: HeldFixed, pose: FloatArray,
    reaches_px: tuple[int, ...],
) -> OrientedCamera:  # fmt: skip
    """Fit the pose from a start, marks looked for within each reach in turn; refused where the edge is no shell's."""
    for reach in reaches_px:
        marks = visible_marks(_posed(nominal, pose))
        for _ in range(STEPS):
            look = _look(_posed(nominal, pose), marks, benchmark, reach)
            seen = look.seen
            design = np.column_stack([seen.rows[:, POSED], seen.rows[:, FLATTENING], seen.shape])
            gain, formal, rms = huber_gain(seen, design, np.diag(prior**-2.0), len(look.clocks_rad))
            before = np.concatenate([pose, np.zeros(len(prior) - POSES)])
            step = gain @ seen.residual_px - formal @ (before / prior**2)
            pose = pose + step[:POSES]
            if np.abs(step[:POSES] / prior[:POSES]).max() < SETTLED_SD:
                break
    if rms > WORST_RMS_PX:
        raise GateError(
            f"benchmark frame: the edge is not the shell's (rms {rms:.1f} px); choose another benchmark time"
        )
    off = float(np.sum((pose[:8] / prior[:8]) ** 2))
    if off > WORST_CORRECTIONS:
        raise GateError(
            f"benchmark frame: the edge found fits best with a camera whose turn and lens are {np.sqrt(off / 8.0):.1f} "
            "standard deviations (rms of eight) off what the vehicle file states, so it is not the shell's; choose "
            "another benchmark time, or check the mount, the lens and [cameras.NAME.uncertainty]"
        )
    # where a mark was painted is left over in every frame: other frames are weighed by how well it was found
    look = _look(_posed(nominal, pose), marks, benchmark, reaches_px[-1], painted_m=0.0)
    per_bending = gain[:POSES] @ seen.rows[:, BENDING]
    return OrientedCamera(
        look.view, look.clocks_rad, look.lines, marks, held, look.horizon, look.seen, pose[:8], formal[:POSES, :POSES],
        per_bending, rms,
    )  # fmt: skip


def _pose_of_pattern(nominal: VirtualCamera, image: Image, prior: FloatArray) -> FloatArray | None:
    """Pose (12,) at which the pattern of marks fits; None where it stands out nowhere."""
    points = visible_marks(nominal).points_shell_m
    if len(points) == 0:
        return None
    at_rest = np.zeros(3)

    def pixels(lens: FloatArray) -> FloatArray:
        return _posed(nominal, np.concatenate([lens, np.zeros(POSES - len(lens))])).sight(points, at_rest).pixels

    # the focal length is what may be far off: it is searched in pieces
    sd = prior[:8].copy()
    pieces = max(1, round(sd[FOCAL] / FOCAL_PIECE))
    sd[FOCAL] = min(sd[FOCAL], FOCAL_PIECE)
    starts = [np.eye(8)[FOCAL] * scale for scale in FOCAL_PIECE * (np.arange(2 * pieces - 1) - (pieces - 1))]
    found = fitted_pattern(image, pixels, starts, sd)
    return None if found is None else np.concatenate([found, np.zeros(POSES - 8)])


def _prior_sd(known: CameraUncertainty, held: HeldFixed) -> FloatArray:
    """Of the pose (12), the shell's flattening and ovality as built (3) and the light (3)."""
    sd = [
        *[np.deg2rad(known.pointing_deg)] * 3, known.focal, *[known.centre_px] * 2, known.k1, known.k2,
        *[known.position_m] * 3, held.rim_radius_m, *[BUILT_RAD] * 3, *[held.edge_px] * 3,
    ]  # fmt: skip
    # what is known exactly is known to a thousandth of a pixel or so
    return np.maximum(np.array(sd), 1e-6)


def _posed(nominal: VirtualCamera, pose: FloatArray) -> VirtualCamera:
    camera = nominal.camera
    lens = camera.distortion.copy()
    lens[:2] += pose[6:8]
    moved = replace(
        camera,
        centre_px=camera.centre_px + pose[4:6],
        distortion=lens,
        position_body_m=camera.position_body_m + pose[8:11],
    )
    return replace(nominal, camera=moved.turned(pose[:3], 1.0 + pose[3]))


def _look(
    view: VirtualCamera, marks: Marks, image: Image, reach_px: int, painted_m: float = PAINTED_M
) -> _Look:  # fmt: skip
    """Find the edge and, with a reach, the marks around where they are expected."""
    at_rest = np.zeros(3)
    clocks = view.edge_clocks()
    lines = view.lines_at(clocks, at_rest)
    horizon = find_horizon(image, lines, view.camera.size_px)
    if reach_px:
        horizon = steps_near(image, lines)
    elif not horizon.is_usable:
        raise GateError(f"benchmark frame: {horizon.refused}; choose another benchmark time")
    seen = edge_seen(view, horizon, at_rest)
    if reach_px:
        found = found_marks(view, marks, image, at_rest, reach_px)
        painted = marks_seen(view, marks, found, at_rest, len(clocks))
        # where a mark was painted is known to millimetres
        at = marks.points_shell_m[painted.index - len(clocks)]
        away = np.linalg.norm(at - view.camera.position_body_m, axis=1)
        painted = replace(painted, sd_px=np.hypot(painted.sd_px, painted_m * view.camera.focal_px.mean() / away))
        seen = joined(seen, painted)
    return _Look(view, lines, horizon, seen.some(np.isfinite(seen.residual_px)), clocks)

"""How was the camera really built in, and what does its lens really do? Told by a frame in which the shell is not bent.

The camera's turn, focal scale, principal point, k1, k2 and position and the shell's radius are fitted to the edge and
the marks of that frame, each held by what was known of it before the flight (``[cameras.*.uncertainty]``), beside the
shell's own shape (its flattening and ovality as built) and the light at its edge. For a lens that nobody calibrated the
prior is wide, and the frame calibrates it, as the seed paper oriented its camera on the frame at 421 s.

First the edge alone is fitted, which may be far from where the nominal camera expects it; then marks are looked for
from farther, then from nearer. Where few turn up, the edge was not the shell's, and the pattern of all marks is looked
for instead (`estimators.features`). An edge that is not the shell's, the Earth's limb say, may be fitted to a fraction
of a pixel by a camera that is far from what was known: such a fit is none.

How far was the shell bent in the benchmark frame? Told by the joint: it bends by the moment that it carries.

The moment in the joint is what the centerbody needs to move as it does. Nothing else holds the centerbody (no air
force, as everywhere here), so that its accelerometer and gyros measure it, its swinging included::

    tau = I w' + w x I w - r x m f,      theta = kappa (tau_z, -tau_y)

``f`` is the specific force at the centerbody's c.g., ``r`` the joint from there, ``kappa`` the joint's compliance, of
which next to nothing is known before. The film reads what the bending is beyond the benchmark frame's::

    read_i = theta(t_i) - R_i theta(t_b) + camera's error,     theta(t) = kappa (m(t) + A(t) x) + slack(t)

Unknown are kappa, the ``x ~ N(0, 1)`` of the moment (the accelerometer's constant errors, the centerbody's c.g. and
inertia) and the slack, what does not follow the law: freeplay, a spring that hardens, friction. Its size is found
too, by the evidence of the readings over `SLACKS_RAD`: slack of a size that the film cannot rule out stays in the error
bar. All is Gaussian, and the bending of the benchmark, held as before by what it was taken to be, is one conditional
mean and covariance, a mixture over sizes of the slack.

The same film tells it and is mended by it, and the two errors are not independent: what errs alike in all frames looks
like a bending of the benchmark, and is taken out with it. With ``theta(t_b) = K read``, the error ``e`` of a frame and
that of the benchmark's bending have the covariance ``cov(e, readings' errors) K'``.

Source: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, chapters 2 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from estimators.camera_fit import (
    POSED,
    HeldFixed,
    Image,
    OrientedCamera,
    Seen,
    edge_seen,
    found_marks,
    huber_gain,
    joined,
    marks_seen,
)
from estimators.edge import HorizonLine, ScanLines, fault_of_frame, find_horizon, steps_near
from estimators.evidence import CONSTANT_PART, LIGHT_TIME_S
from estimators.features import Marks, fitted_pattern, visible_marks
from estimators.loads import PulseData
from estimators.virtual_camera import BENDING, FLATTENING, VirtualCamera
from flightmodel.camera import camera_from_mount
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from flightmodel.geometry import ShellGeometry
from flightmodel.vehicle import CameraMount, CameraUncertainty

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


LEAST_FRAMES, MOST_FRAMES = 12, 150
LONGEST_HOLE_S = 0.11
LOADED = 3.0  # largest moment over the benchmark's
WORST_CLOCK_S = 0.03  # half a radian of swinging at 2.5 Hz
LEFT_OUT = 0.05  # of the bending: damping, swings that the sensors' windows smooth
SLACK_TIME_S = 2.5
SLACKS_DEG, FREEPLAYS_DEG = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64), (0.0, 0.05, 0.1, 0.2, 0.4, 0.8)
SIZES_RAD = np.deg2rad(list(product(SLACKS_DEG, FREEPLAYS_DEG)))
USUAL_RAD = np.deg2rad([0.04, 0.1])  # sizes at which the compliance is found that the law's errors go by
PASSES = 2
VAGUE = 30.0  # prior sd of the compliance, in the values found


@dataclass(frozen=True)
class BenchmarkBending:
    """Bending of the benchmark frame as a lateral vector (2,), rad, body y and z, and its covariance (2, 2).

    ``with_readings`` (n, 2, 2): covariance of every reading's error (rows) with this one's; None: they are independent.
    """

    theta_yz_rad: FloatArray
    covariance: FloatArray
    with_readings: FloatArray | None = None

    @property
    def words(self) -> str:
        """In a sentence's middle."""
        size = np.rad2deg(np.hypot(*self.theta_yz_rad))
        sd = np.rad2deg(np.sqrt(0.5 * np.trace(self.covariance)))
        clock = np.rad2deg(lv_clock(self.theta_yz_rad))
        return (
            f"bent by {size:.2f} deg towards {clock:.0f} deg LV there within {sd:.2f} deg an axis, by the moment that "
            "the sensors measured in the joint"
        )


@dataclass(frozen=True)
class ReadFrames:
    """What a film read of the bending beyond its benchmark frame's; lateral vectors, body y and z.

    Parameters
    ----------
    time_s : (n,) float
    theta_yz_rad : (n, 2) float
    covariance : (n, 2, 2) float
        Without the benchmark's bending.
    per_benchmark : (n, 2, 2) float
        ``R``: what is missing of a reading per unit bending of the benchmark.
    benchmark_s : float
    clock_sd_s : float
        How well the frames' times are known against the gyros'.
    """

    time_s: FloatArray
    theta_yz_rad: FloatArray
    covariance: FloatArray
    per_benchmark: FloatArray
    benchmark_s: float
    clock_sd_s: float = 0.0


@dataclass(frozen=True)
class _Moment:
    """At times (n,): moment as a lateral vector (n, 2), N m, what it is uncertain by (n, 2, k), its noise's sd."""

    value_nm: FloatArray
    by_input_nm: FloatArray
    noise_nm: float

    def at(self, time_s: FloatArray, at_s: FloatArray) -> _Moment:
        """Linear interpolation."""
        flat = np.concatenate([self.value_nm[:, :, None], self.by_input_nm], axis=2).reshape(len(time_s), -1)
        here = np.stack([np.interp(at_s, time_s, column) for column in flat.T], axis=-1).reshape(len(at_s), 2, -1)
        return _Moment(here[:, :, 0], here[:, :, 1:], self.noise_nm)


def joint_moment(pulse: PulseData) -> _Moment:
    """Moment in the joint, positive where it bends the shell towards the vector, at all samples of the pulse."""
    vehicle, body = pulse.vehicle, pulse.vehicle.centerbody
    known, rate, turn = vehicle.uncertainty, pulse.rate_body_radps, pulse.angular_acceleration_body_radps2
    from_cg = body.cg_m - vehicle.cg_m
    force = pulse.specific_force_body_mps2 + np.cross(turn, from_cg) + np.cross(rate, np.cross(rate, from_cg))
    arm = vehicle.joint_m - body.cg_m
    spin = turn @ body.inertia.T + np.cross(rate, rate @ body.inertia.T)
    shifts = np.diag([known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m])
    parts = [known.inertia * spin, *(np.cross(shift, body.mass_kg * force) for shift in shifts)]
    parts += [-np.cross(arm, body.mass_kg * column) for column in np.moveaxis(pulse.force_root_mps2, 2, 0)]
    noise = np.hypot(
        body.inertia[1, 1] * pulse.angular_acceleration_sd_radps2,
        abs(arm[0]) * body.mass_kg * pulse.force_noise_sd_mps2,
    )
    value = spin - np.cross(arm, body.mass_kg * force)
    return _Moment(_lateral(value), np.stack([_lateral(part) for part in parts], axis=-1), float(noise))


def _lateral(moment: FloatArray) -> FloatArray:
    return np.stack([moment[:, 2], -moment[:, 1]], axis=-1)


def benchmark_bending(frames: ReadFrames, pulse: PulseData, held_rad: float) -> BenchmarkBending:
    """Bending of the benchmark frame from the moment in the joint.

    Parameters
    ----------
    frames : ReadFrames
    pulse : PulseData
    held_rad : float
        Sd of each axis before, about zero.

    Raises
    ------
    GateError
        Where it cannot be told, with the reason.
    """
    if frames.clock_sd_s > WORST_CLOCK_S:
        raise GateError(f"the film's clock is known to {frames.clock_sd_s:.2f} s, where the joint swings in 0.4 s")
    known = np.isfinite(frames.theta_yz_rad).all(axis=1) & _measured(frames.time_s, pulse.time_s)
    if not _measured(np.array([frames.benchmark_s]), pulse.time_s)[0]:
        raise GateError("accelerometer and gyros have no data at the benchmark frame")
    rows = np.flatnonzero(known)
    rows = rows[:: max(1, -(-len(rows) // MOST_FRAMES))]
    if len(rows) < LEAST_FRAMES:
        raise GateError(f"{len(rows)} frames with sensor data where {LEAST_FRAMES} are wanted")
    times = np.append(frames.time_s[rows], frames.benchmark_s)
    whole = joint_moment(pulse)
    moment = whole.at(pulse.time_s, times)
    size = np.linalg.norm(moment.value_nm, axis=1)
    if size.max() < LOADED * size[-1]:
        raise GateError("the joint carries hardly more in any frame than in the benchmark frame")
    if frames.clock_sd_s > 0.0:
        late = whole.at(pulse.time_s, times + frames.clock_sd_s).value_nm - moment.value_nm
        moment = _Moment(
            moment.value_nm, np.concatenate([moment.by_input_nm, late[:, :, None]], axis=2), whole.noise_nm
        )
    return _mixture(frames, rows, times, moment, held_rad)


def _measured(at_s: FloatArray, time_s: FloatArray) -> BoolArray:
    """Whether there are samples close to both sides."""
    after = np.searchsorted(time_s, at_s).clip(1, len(time_s) - 1)
    inside = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    return np.asarray(inside & (time_s[after] - time_s[after - 1] < LONGEST_HOLE_S))


def _mixture(
    frames: ReadFrames, rows: NDArray[np.intp], times: FloatArray, moment: _Moment, held_rad: float
) -> BenchmarkBending:
    """Posterior of the benchmark's bending over all sizes of the slack."""
    n = len(rows)
    look = np.hstack([np.eye(2 * n), -frames.per_benchmark[rows].reshape(2 * n, 2)])
    held = np.hstack([np.zeros((2, 2 * n)), np.eye(2)])
    look = np.vstack([look, held])  # the benchmark is held at zero as well: a reading more
    read = np.append(frames.theta_yz_rad[rows].ravel(), np.zeros(2))
    camera = _camera_covariance(frames, rows, rows)
    apart = np.abs(times[:, None] - times[None, :])
    follows = np.asarray(np.kron(np.exp(-apart / SLACK_TIME_S), np.eye(2)), dtype=float)
    # freeplay is taken up towards the moment's side, as far as that is known
    sd_nm = np.sqrt(np.sum(moment.by_input_nm**2, axis=(1, 2)) + moment.noise_nm**2)
    length = np.hypot(np.linalg.norm(moment.value_nm, axis=1), sd_nm)
    side, loose = (moment.value_nm / length[:, None]).ravel(), np.repeat(sd_nm / length, 2)
    taken_up = np.outer(side, side) + np.outer(loose, loose) * follows
    load = (look @ moment.value_nm.ravel())[: 2 * n]
    compliance = float(load @ read[: 2 * n] / (load @ load))

    def posterior(slack_rad: float, freeplay_rad: float) -> _Posterior:
        error = block_diag(camera, (held_rad**2 + slack_rad**2 + freeplay_rad**2) * np.eye(2))
        law = _law_covariance(moment, compliance, follows)
        return _posterior(law + slack_rad**2 * follows + freeplay_rad**2 * taken_up, look, read, error, moment)

    for _ in range(PASSES):
        compliance = posterior(*USUAL_RAD).compliance
    found = [posterior(*sizes) for sizes in SIZES_RAD]
    evidence = np.array([one.log_evidence for one in found])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    gain = np.einsum("k,kij->ij", weight, [one.gain for one in found])
    mean = gain @ read
    off = np.array([one.gain @ read for one in found]) - mean
    spread = np.einsum("k,kij->ij", weight, [one.covariance for one in found]) + (weight * off.T) @ off
    # shapes of slack and freeplay are guesses: what there is of them here stays in the error bar
    slack_var, freeplay_var = weight @ SIZES_RAD**2
    stays = float(slack_var + freeplay_var * loose[-1] ** 2)
    seen = np.flatnonzero(np.isfinite(frames.theta_yz_rad).all(axis=1))
    together = np.full((len(frames.time_s), 2, 2), np.nan)
    together[seen] = (_camera_covariance(frames, seen, rows) @ gain[:, : 2 * n].T).reshape(-1, 2, 2)
    return BenchmarkBending(np.asarray(mean), np.asarray(spread + stays * np.eye(2)), together)


def _camera_covariance(frames: ReadFrames, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> FloatArray:
    """Of readings, (2 n, 2 m): a part lasts, the rest forgets with the light, as the fusion takes it."""
    ends = []
    for k in (rows, columns):
        value, axes = np.linalg.eigh(frames.covariance[k])
        ends.append((axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1))
    apart = np.abs(frames.time_s[rows][:, None] - frames.time_s[columns][None, :])
    shared = CONSTANT_PART + (1.0 - CONSTANT_PART) * np.exp(-apart / LIGHT_TIME_S)
    both = np.einsum("iab,ij,jcb->iajc", ends[0], shared, ends[1])
    return np.asarray(both.reshape(2 * len(rows), 2 * len(columns)))


def _law_covariance(moment: _Moment, compliance: float, follows: FloatArray) -> FloatArray:
    """Of the bending at all times, without slack: of a compliance that is vague, of the moment, of what is left out."""
    flat = compliance * moment.value_nm.ravel()
    inputs = compliance * moment.by_input_nm.reshape(len(flat), -1)
    size = LEFT_OUT * np.repeat(compliance * np.linalg.norm(moment.value_nm, axis=1), 2)
    noise = (compliance * moment.noise_nm) ** 2 * np.eye(len(flat))
    return VAGUE**2 * np.outer(flat, flat) + inputs @ inputs.T + np.outer(size, size) * follows + noise


@dataclass(frozen=True)
class _Posterior:
    """Of the benchmark's bending: gain (2, m) on the readings, covariance, compliance, logarithm of the evidence."""

    gain: FloatArray
    covariance: FloatArray
    compliance: float
    log_evidence: float


def _posterior(
    bending: FloatArray, look: FloatArray, read: FloatArray, error: FloatArray, moment: _Moment
) -> _Posterior:
    cross = bending @ look.T
    factor = cho_factor(look @ cross + error, lower=True)
    solved = cho_solve(factor, read)
    theta = cross @ solved
    last = slice(-2, None)
    gain = cho_solve(factor, cross[last].T).T
    covariance = bending[last, last] - gain @ cross[last].T
    flat = moment.value_nm.ravel()
    log = -0.5 * float(read @ solved) - float(np.log(np.diag(factor[0])).sum())
    return _Posterior(gain, covariance, float(flat @ theta / (flat @ flat)), log)

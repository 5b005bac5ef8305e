"""How far did the shell bend, seen by the onboard camera?

The camera is oriented on a benchmark frame in which the joint is taken as not bent (three angles, a focal scale); in
every other frame the deflection is the rotation ``w`` of the shell whose projected edge fits the found one,

    min over w of  sum_j rho((r_j - J_j dw) / sd_j),

by Gauss-Newton with Huber's rho: one parameter in an assumed plane (the seed paper's way, plane along the camera's line
of sight), two when the plane is found as well, from the tilt of the edge across the picture.

The covariance is the formal one, scaled by the residuals where they exceed their sd, plus what is held fixed though not
known: with the derivatives ``N`` of the edge by those quantities (principal point, k1, camera position, rim radius,
joint station, residual deflection of the benchmark, shift and tilt of the found edge by changing light)

    dw = G_f (N_f - C_f G_b N_b) dn,    G = (J' W J)^-1 J' W,

where ``b`` is the benchmark frame, ``f`` the frame, ``C`` the derivative by the orientation. What spoils both frames
alike is absorbed by the orientation and drops out. With an assumed plane that is off by ``d`` the answer is
``theta (cos d + s sin d)``, ``s`` the answer to a unit bending across the plane; its mean square error
``theta^2 (s^2 sd^2 + 3 (1/2 + s^2)^2 sd^4)`` is in the variance.

Sources: seed paper, CAD-based estimate, Table 2.1. S. F. Schmidt's "consider" covariance, e.g. Tapley, Schutz, Born,
"Statistical Orbit Determination", 2004, chapter 6.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.horizon import HorizonLine, ScanLines, find_horizon
from estimators.virtual_camera import DEFLECTION, NUISANCE, POINTING, HeldFixed, VirtualCamera, huber_gain
from flightmodel.camera import camera_from_mount
from flightmodel.checks import FloatArray, GateError, check_finite, check_increasing
from flightmodel.deflection import DeflectionHistory, polar_from_lateral, rotation_vector_body_shell
from flightmodel.vehicle import CameraMount, ShellGeometry

Image = NDArray[np.uint8]

ITERATIONS = 8
WORST_RMS_PX = 2.5
LEAST_POINTS = 60
POINTING_PRIOR_SD = np.array([*np.deg2rad([3.0, 3.0, 3.0]), 0.05])


@dataclass(frozen=True)
class FrameFit:
    """The deflection seen in one frame.

    Parameters
    ----------
    rotation_yz_rad : (2,) float
        Rotation vector of the shell against the body about body y and z, rad; NaN when refused.
    covariance : (k, k) float
        Of the fitted parameters: ``rotation_yz_rad`` (k = 2), or the angle in the assumed plane (k = 1), rad^2.
    plane_leak : float
        Answer to a unit bending across the assumed plane (k = 1); zero otherwise.
    residual_rms_px : float
    horizon : HorizonLine
    refused : str
        Why there is no answer; empty when there is one.
    """

    rotation_yz_rad: FloatArray
    covariance: FloatArray
    plane_leak: float
    residual_rms_px: float
    horizon: HorizonLine
    refused: str = ""


@dataclass(frozen=True)
class _Solution:
    """Normal equations of one frame at the answer: gain ``(k, m)``, formal covariance, Jacobian, used rows."""

    value: FloatArray
    gain: FloatArray
    formal: FloatArray
    jacobian: FloatArray
    columns_px: FloatArray
    rms_px: float


@dataclass(frozen=True)
class OrientedCamera:
    """A virtual camera whose orientation was fitted on a benchmark frame; see `orient_camera`.

    Parameters
    ----------
    view : VirtualCamera
    lines : ScanLines
        Where the edge is searched.
    held : HeldFixed
    benchmark : HorizonLine
    pointing : (4,) float
        Corrections found: three angles in camera axes, rad, and the focal scale less one.
    pointing_covariance : (4, 4) float
    pointing_per_held : (4, 8 + 2) float
        Shift of the corrections per one sd of each held quantity and of the benchmark's deflection.
    residual_rms_px : float
        Of the benchmark frame.
    """

    view: VirtualCamera
    lines: ScanLines
    held: HeldFixed
    benchmark: HorizonLine
    pointing: FloatArray
    pointing_covariance: FloatArray = field(repr=False)
    pointing_per_held: FloatArray = field(repr=False)
    residual_rms_px: float = 0.0

    def fit(self, image: Image, plane_lv_rad: float | None, start_yz_rad: FloatArray | None = None) -> FrameFit:
        """Find the deflection in a frame.

        Parameters
        ----------
        image : (h, w) uint8
        plane_lv_rad : float or None
            Assumed plane, or None to find it.
        start_yz_rad : (2,) float, optional
            Where to start, e.g. the answer of the frame before.
        """
        horizon = find_horizon(image, self.lines, self.view.camera.size_px)
        if not horizon.is_usable:
            return _no_answer(horizon, horizon.refused)
        return self.fit_horizon(horizon, plane_lv_rad, start_yz_rad)

    def fit_horizon(
        self, horizon: HorizonLine, plane_lv_rad: float | None, start_yz_rad: FloatArray | None = None
    ) -> FrameFit:
        """Find the deflection from an edge already found."""
        basis = np.eye(2) if plane_lv_rad is None else _axis(plane_lv_rad)[:, None]
        start = np.zeros(2) if start_yz_rad is None else start_yz_rad
        try:
            found = _solve(self.view, horizon, np.eye(2), start)
            if plane_lv_rad is not None:
                # whether this is the shell is judged with both parameters: an assumed plane alone may fit badly
                found = _solve(self.view, horizon, basis, basis.T @ found.value, worst_rms_px=np.inf)
        except _NoFit as fault:
            return _no_answer(horizon, str(fault))
        gain = found.gain
        leak = 0.0
        if plane_lv_rad is not None:
            across = np.array([-basis[1, 0], basis[0, 0]])
            # the axis turns from w(plane) by +90 deg of plane
            across = across if across @ _axis(plane_lv_rad + 0.5 * np.pi) > 0.0 else -across
            leak = float(gain[0] @ found.jacobian[:, DEFLECTION] @ across)
        pointing = gain @ found.jacobian[:, POINTING]
        held = np.zeros((len(gain), 10))
        held[:, :8] = gain @ found.jacobian[:, NUISANCE] * self.held.nuisance_sd
        held -= pointing @ self.pointing_per_held
        # light: shift, tilt and bow of the edge in this frame alone
        width = 0.5 * self.view.camera.width_px
        side = (found.columns_px - width) / width
        light = gain @ np.column_stack([np.ones_like(side), side, 1.5 * side**2 - 0.5]) * self.held.edge_px
        covariance = found.formal + pointing @ self.pointing_covariance @ pointing.T + held @ held.T + light @ light.T
        return FrameFit(basis @ found.value, covariance, leak, found.rms_px, horizon)


class _NoFit(Exception):
    """The edge found does not fit the model."""


def _axis(plane_lv_rad: float) -> FloatArray:
    """Rotation vector (y, z) of a unit bending in a plane."""
    out: FloatArray = rotation_vector_body_shell(np.array(1.0), np.array(plane_lv_rad))[1:]
    return out


def _no_answer(horizon: HorizonLine, reason: str) -> FrameFit:
    nan = np.full((2, 2), np.nan)
    return FrameFit(nan[0], nan, 0.0, float("nan"), horizon, reason)


def _solve(
    view: VirtualCamera, horizon: HorizonLine, basis: FloatArray, start: FloatArray, worst_rms_px: float = WORST_RMS_PX
) -> _Solution:
    value = np.array(start, dtype=float)
    for _ in range(ITERATIONS):
        residual, jacobian = view.mismatch(horizon, view.edge(basis @ value))
        used = np.isfinite(residual)
        if used.sum() < LEAST_POINTS:
            raise _NoFit(f"{int(used.sum())} edge points where {LEAST_POINTS} are wanted")
        residual, jacobian = residual[used], jacobian[used]
        gain, formal, rms = huber_gain(residual, jacobian[:, DEFLECTION] @ basis, horizon.sd_px[used], None)
        step = gain @ residual
        value += step
        if np.linalg.norm(value) > 0.5:
            raise _NoFit("the fit ran away beyond 28 deg")
        if np.abs(step).max() < 5e-6:
            break
    if rms > worst_rms_px:
        raise _NoFit(f"the edge is not the shell's: rms {rms:.1f} px where {worst_rms_px} px are allowed")
    return _Solution(value, gain, formal, jacobian, horizon.points_px[used, 0], rms)


def orient_camera(
    benchmark: Image,
    geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    held: HeldFixed | None = None,
) -> OrientedCamera:
    """Fit the camera's orientation and focal scale on a frame taken as not bent.

    Parameters
    ----------
    benchmark : (h, w) uint8
    geometry : ShellGeometry
    camera_mount : CameraMount
        Nominal position, pointing and lens.
    joint_station_m : float
        Joint aft of the nose, m.
    held : HeldFixed, optional

    Raises
    ------
    GateError
        When the frame cannot be used, with the reason.
    """
    held = held or HeldFixed()
    nominal = camera_from_mount(camera_mount)
    view = VirtualCamera(geometry, nominal, joint_station_m)
    total = np.zeros(4)
    for _ in range(ITERATIONS):
        lines = view.scan_lines()
        horizon = find_horizon(benchmark, lines, nominal.size_px)
        if not horizon.is_usable:
            raise GateError(f"benchmark frame: {horizon.refused}; choose another benchmark time")
        residual, jacobian = view.mismatch(horizon, view.edge(np.zeros(2)))
        used = np.isfinite(residual)
        gain, formal, rms = huber_gain(residual[used], jacobian[used, POINTING], horizon.sd_px[used], POINTING_PRIOR_SD)
        step = gain @ residual[used] - formal @ (total / POINTING_PRIOR_SD**2)
        total = total + step
        view = replace(view, camera=nominal.turned(total[:3], 1.0 + total[3]))
        if np.abs(step).max() < 1e-5:
            break
    if rms > WORST_RMS_PX:
        raise GateError(f"benchmark frame: the edge is not the shell's (rms {rms:.1f} px); choose another time")
    per_held = [jacobian[used, NUISANCE] * held.nuisance_sd, jacobian[used, DEFLECTION] * held.benchmark_rad]
    shift = gain @ np.column_stack(per_held)
    return OrientedCamera(view, view.scan_lines(), held, horizon, total, formal, shift, rms)


def deflection_from_frames(
    frame_times_s: FloatArray,
    frames: Iterable[Image | str | Path],
    geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    benchmark_time_s: float = 421.0,
    plane_lv_rad: float | None = float(np.deg2rad(153.0)),
    plane_sd_rad: float = float(np.deg2rad(25.0)),
    held: HeldFixed | None = None,
) -> DeflectionHistory:
    """Estimate the bending history from onboard video.

    Parameters
    ----------
    frame_times_s : (n,) float
        Seconds after t0, increasing.
    frames : iterable of (h, w) uint8 or path
        Grey pictures, or files OpenCV reads.
    geometry, camera_mount, joint_station_m
        Nominal shell, camera and joint (m aft of the nose).
    benchmark_time_s : float
        The frame nearest to it is taken as not bent.
    plane_lv_rad : float or None
        Assumed plane (seed paper: along camera 5, 153 deg); None finds the plane in every frame.
    plane_sd_rad : float
        Standard deviation of the assumed plane.
    held : HeldFixed, optional

    Returns
    -------
    DeflectionHistory
        ``method = "camera"``. NaN where a frame was refused; the reasons stand in ``assumptions``. In an assumed plane
        the angle has a sign.

    Raises
    ------
    GateError
        When times and frames do not match, or the benchmark frame is missing or unusable.
    """
    times = np.asarray(frame_times_s, dtype=float)
    pictures: Sequence[Image | str | Path] = list(frames)
    if len(times) != len(pictures) or len(times) == 0:
        raise GateError(f"{len(times)} frame times for {len(pictures)} frames")
    check_finite("frame_times_s", times)
    check_increasing("frame_times_s", times)
    nearest = int(np.argmin(np.abs(times - benchmark_time_s)))
    if abs(times[nearest] - benchmark_time_s) > 2.0:
        raise GateError(f"no frame within 2 s of the benchmark time {benchmark_time_s} s; frames span "
                        f"{times[0]:.2f} to {times[-1]:.2f} s")  # fmt: skip
    oriented = orient_camera(read_frame(pictures[nearest]), geometry, camera_mount, joint_station_m, held)
    start, fits = np.zeros(2), []
    for picture in pictures:
        fits.append(oriented.fit(read_frame(picture), plane_lv_rad, start))
        start = np.zeros(2) if fits[-1].refused else fits[-1].rotation_yz_rad
    return _history(times, fits, oriented, times[nearest], plane_lv_rad, plane_sd_rad)


def read_frame(picture: Image | str | Path) -> Image:
    """Return a grey picture ``(h, w)`` uint8 from an array or a file; an unreadable file gives an empty picture."""
    if isinstance(picture, str | Path):
        image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
        return np.zeros((0, 0), dtype=np.uint8) if image is None else np.asarray(image, dtype=np.uint8)
    return picture


def _history(
    times: FloatArray, fits: list[FrameFit], oriented: OrientedCamera, benchmark_s: float,
    plane_lv_rad: float | None, plane_sd_rad: float,
) -> DeflectionHistory:  # fmt: skip
    n = len(times)
    theta, plane, covariance = np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2, 2), np.nan)
    for k, fit in enumerate(fits):
        if fit.refused:
            continue
        if plane_lv_rad is None:
            theta[k], plane[k], covariance[k] = polar(fit.rotation_yz_rad, fit.covariance)
        else:
            theta[k], plane[k] = fit.rotation_yz_rad @ _axis(plane_lv_rad), plane_lv_rad
            s, sd2 = fit.plane_leak, plane_sd_rad**2
            off = theta[k] ** 2 * (s**2 * sd2 + 3.0 * (0.5 + s**2) ** 2 * sd2**2)
            cross = -theta[k] * s * sd2
            covariance[k] = [[fit.covariance[0, 0] + off, cross], [cross, sd2]]
    if plane_lv_rad is not None:
        plane[:] = plane_lv_rad
    how = (
        "plane found from the edge's tilt"
        if plane_lv_rad is None
        else f"plane assumed at {np.rad2deg(plane_lv_rad):.0f} +/- {np.rad2deg(plane_sd_rad):.0f} deg LV"
    )
    words = [
        f"{how}; joint {oriented.view.joint_station_m:.3f} m aft of the nose",
        f"camera oriented on the frame at {benchmark_s:.3f} s, taken as not bent within "
        f"{np.rad2deg(oriented.held.benchmark_rad):.2f} deg (rms {oriented.residual_rms_px:.2f} px)",
        "the shell is rigid but for its joint",
    ]
    refused = [(t, fit.refused) for t, fit in zip(times, fits, strict=True) if fit.refused]
    if refused:
        listed = ", ".join(f"{t:.3f} s: {reason}" for t, reason in refused[:5])
        words.append(f"{len(refused)} of {len(times)} frames refused ({listed}{', ...' if len(refused) > 5 else ''})")
    return DeflectionHistory(times, theta, plane, covariance, "camera", "; ".join(words))


def polar(rotation_yz_rad: FloatArray, covariance: FloatArray) -> tuple[float, float, FloatArray]:
    """Angle, plane (rad) and their covariance ``(2, 2)`` from a rotation about body y and z.

    See `flightmodel.deflection.polar_from_lateral`; the shell's rotation ``theta x_hat x d`` has the lateral vector
    ``theta d = (w_z, -w_y)``.
    """
    swap = np.array([[0.0, 1.0], [-1.0, 0.0]])
    theta, plane, out = polar_from_lateral(swap @ rotation_yz_rad, swap @ covariance @ swap.T)
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
    oriented = orient_camera(benchmark, geometry, camera_mount, float(joint_stations_m[0]))
    rows = []
    for station in joint_stations_m:
        here = replace(oriented, view=replace(oriented.view, joint_station_m=float(station)))
        fits = [(here.fit(deflected, float(p)), float(p)) for p in planes_lv_rad]
        rows.append([float(fit.rotation_yz_rad @ _axis(p)) for fit, p in fits])
    return np.array(rows)

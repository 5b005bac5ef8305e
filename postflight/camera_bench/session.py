"""What does an analyst see of a film at the bench, and what becomes of the decisions made there?

A session holds one camera's film, the decisions so far (`flightmodel.camera_edits`), the camera oriented with them and
the fit of every frame, made one after the other in the background. A decision is written to ``camera_edits.csv`` before
anything is fitted anew; what a run makes of that file is the same.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.camera import JointSwing, has_texture, judged, polar
from estimators.camera_fit import OrientedCamera
from estimators.frame_edits import EditedFrame, edited
from estimators.frame_solution import FrameFit
from estimators.virtual_camera import VirtualCamera, deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.camera_edits import EDITS_FILE, POSE, CameraEdits, Edit, faults_of, read_edits, write_edits
from flightmodel.checks import NO_FAULT, FloatArray, GateError, Issue
from flightmodel.files import file_bytes
from flightmodel.film import Frames
from flightmodel.vehicle import Vehicle
from postflight.filming import joint_swing, orient_on_film

MOST_EDITS = 20_000
_CHANGED = "was changed by another program since this page was loaded; load the page anew"


@dataclass(frozen=True)
class _Work:
    """State of a session: decisions, the camera oriented with them (None with the reason), and fits so far by frame."""

    frames: Frames
    oriented: OrientedCamera | None
    trouble: Issue
    fits: dict[int, FrameFit]


class Session:
    """One camera's film at the bench.

    Parameters
    ----------
    folder : Path
        Flight folder; `EDITS_FILE` is written there.
    frames : Frames
        With the decisions that stand in the folder.
    vehicle : Vehicle
    """

    def __init__(self, folder: Path, frames: Frames, vehicle: Vehicle) -> None:
        self.path, self.vehicle = folder / EDITS_FILE, vehicle
        self._flight_benchmark_s = frames.benchmark_s
        self._lock = threading.Lock()
        self._revision = _digest(self.path)
        self._ended = False
        self._last: tuple[int, NDArray[np.uint8]] | None = None
        self._work = self._oriented(frames)
        self._wake = threading.Event()
        self._fitter = threading.Thread(target=self._fit_all, daemon=True)
        self._fitter.start()

    def close(self) -> None:
        """Stop fitting."""
        self._ended = True
        self._wake.set()
        self._fitter.join()

    # ------------------------------------------------------------------------------------------------ what is asked

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self._work.frames.time_s)

    def state(self) -> dict[str, Any]:
        """Film, decisions, the camera's orientation and the answers so far."""
        work = self._work
        frames, oriented = work.frames, work.oriented
        return {
            "camera": frames.camera_name,
            "size_px": list(frames.camera.size_px),
            "time_s": frames.time_s.tolist(),
            "benchmark": frames.benchmark,
            "file": self.path.name,
            "revision": self._revision,
            "edits": [_edit_json(row) for row in frames.edits.rows],
            "pose": dict(zip(POSE, _pose_shown(frames.edits.pose), strict=True)),
            "oriented": None
            if oriented is None
            else {
                "rms_px": oriented.residual_rms_px,
                "features": len(oriented.features.points_shell_m),
                "remark": str(oriented.stated_refused),
            },
            "trouble": _said(work.trouble),
            "answers": self._answers(work),
        }

    def _answers(self, work: _Work) -> list[dict[str, Any] | None]:
        """Answer of each frame from the fits so far, as a run would give it; None if the frame is not fitted yet."""
        done = sorted(work.fits)
        textured = work.oriented is not None and has_texture(work.oriented)
        fits = judged(
            work.frames.time_s[done], [work.fits[k] for k in done], self._swing if len(done) > 1 else None,
            work.frames.edits, float(work.frames.time_s[work.frames.benchmark]) if textured else None,
        )  # fmt: skip
        out: list[dict[str, Any] | None] = [None] * len(work.frames.time_s)
        for k, fit in zip(done, fits, strict=True):
            out[k] = _answer_json(fit)
        return out

    @property
    def _swing(self) -> JointSwing | None:
        return joint_swing(self.vehicle)

    def picture(self, index: int) -> bytes:
        """PNG of a frame."""
        image = self._image(index)
        if image.size == 0:
            image = np.zeros((self._work.frames.camera.height_px, self._work.frames.camera.width_px), dtype=np.uint8)
        done, data = cv2.imencode(".png", image)
        assert done
        return data.tobytes()

    def _image(self, index: int) -> NDArray[np.uint8]:
        """A frame as filmed; the last is kept, since a film is decoded from its start for each."""
        last = self._last
        if last is None or last[0] != index:
            self._last = last = (index, self._work.frames.picture(index))
        return last[1]

    def frame(self, index: int, theta_rad: float | None, plane_rad: float | None, pose: FloatArray | None) -> dict:
        """Outline and points of a frame, at its own answer or at a trial deflection or pose.

        Returns
        -------
        dict
            ``outline`` (n, 2) px; ``edge`` and ``features``: rows of place (2), direction (2), residual, used, px;
            ``rms_px`` of those used; ``answer`` of the frame.
        """
        work = self._work
        fit = work.fits.get(index)
        answered = fit is not None and not fit.refused
        own = np.array([*fit.rotation_yz_rad, fit.flattening_rad]) if fit is not None and answered else np.zeros(3)
        tried = own if theta_rad is None or plane_rad is None else deformation_of(theta_rad, plane_rad)
        picture = edited(self._image(index), work.frames.edits, float(work.frames.time_s[index]), work.frames.burnt_in)
        view = self._nominal(pose) if pose is not None or work.oriented is None else work.oriented.view
        out: dict[str, Any] = {"answer": None if fit is None else _answer_json(fit), "edge": [], "features": []}
        try:
            out["outline"] = _rounded(view.edge(tried).pixels)
        except GateError as fault:
            return {**out, "outline": [], "rms_px": None, "trouble": str(fault)}
        if picture.image.size and picture.image.shape == (view.camera.height_px, view.camera.width_px):
            oriented = None if pose is not None else work.oriented
            out["edge"], out["features"] = _points(view, oriented, picture, own, tried)
        used = [row[4] for row in (*out["edge"], *out["features"]) if row[5]]
        out["rms_px"] = float(np.sqrt(np.mean(np.square(used)))) if used else None
        return out

    def _nominal(self, pose: FloatArray | None) -> VirtualCamera:
        camera = camera_from_mount(self._work.frames.camera)
        turn = self._work.frames.edits.pose if pose is None else pose
        turned = camera.turned(turn[:3], float(turn[3]))
        return VirtualCamera(self.vehicle.geometry, turned, self.vehicle.joint.station_m)

    # --------------------------------------------------------------------------------------------- what is decided

    def save(self, rows: Sequence[dict[str, Any]], revision: str) -> dict[str, Any]:
        """Save all decisions about this camera and refit the affected frames.

        Raises
        ------
        GateError
            Where one cannot be meant, or the file was changed by another program (``edits-changed``).
        """
        frames = self._work.frames
        if len(rows) > MOST_EDITS:
            raise GateError(f"{len(rows)} edits; at most {MOST_EDITS}", code="value-range")
        wanted = [_edit_of(row, frames.camera_name) for row in rows]
        faults = faults_of(wanted, frames.time_s, frames.camera.size_px)
        if faults:
            raise GateError(faults)
        with self._lock:
            if revision != self._revision or _digest(self.path) != self._revision:
                raise GateError(f"{self.path.name} {_CHANGED}", code="edits-changed")
            edits = CameraEdits(tuple(wanted))
            filed = edits if frames.filed_px is None else edits.resized(frames.camera.size_px, frames.filed_px)
            write_edits(self.path, [*self._of_other_cameras(), *filed.rows])
            self._revision = _digest(self.path)
            self._apply(edits)
        return self.state()

    def _of_other_cameras(self) -> list[Edit]:
        """Rows of the file that are about other cameras."""
        if not self.path.exists():
            return []
        return [row for row in read_edits(self.path, None).rows if row.camera != self._work.frames.camera_name]

    def _apply(self, edits: CameraEdits) -> None:
        """Apply decisions; the affected frames lose their fits, and all frames do if the camera is affected."""
        before = self._work
        at_s = self._flight_benchmark_s if edits.benchmark_s is None else edits.benchmark_s
        frames = replace(before.frames, edits=edits, benchmark_s=at_s)
        old = before.frames
        benchmark_s = float(frames.time_s[frames.benchmark])
        same = frames.benchmark == old.benchmark and all(
            _about(edits, t) == _about(old.edits, t) for t in (benchmark_s, float("nan"))
        )
        if not same:
            self._work = self._oriented(frames)
        else:
            at = [float(t) for t in frames.time_s]
            kept = {k: fit for k, fit in before.fits.items() if _about(edits, at[k]) == _about(old.edits, at[k])}
            self._work = _Work(frames, before.oriented, before.trouble, kept)
        self._wake.set()

    # ------------------------------------------------------------------------------------------------- what is fitted

    def _oriented(self, frames: Frames) -> _Work:
        """Camera oriented on the benchmark frame with the decisions about it; nothing is fitted yet."""
        try:
            oriented = orient_on_film(frames, self.vehicle)
        except GateError as fault:
            return _Work(frames, None, Issue(str(fault), fault.codes[0]), {})
        return _Work(frames, oriented, NO_FAULT, {})

    def _fit_all(self) -> None:
        """Fit all frames without a fit, from the first on, then wait for the next decision."""
        while not self._ended:
            self._wake.clear()
            work = self._work
            todo = [k for k in range(len(work.frames.time_s)) if k not in work.fits]
            if work.oriented is not None:
                for k, image in zip(todo, work.frames.pictures(todo), strict=True):
                    if self._ended or self._work is not work:
                        break
                    before = work.fits.get(k - 1)
                    start = np.zeros(2) if before is None or before.refused else before.rotation_yz_rad
                    picture = edited(image, work.frames.edits, float(work.frames.time_s[k]), work.frames.burnt_in)
                    work.fits[k] = work.oriented.fit(picture, None, start)
            if self._work is work:
                self._wake.wait()


def _about(edits: CameraEdits, t_s: float) -> list[Edit]:
    """Decisions that affect the fit of the frame at a time; without a frame (NaN), poses and masks of all frames."""
    return [row for row in edits.rows if row.edit in ("mask", "rim", "feature", "pose") and row.is_of(t_s)]


def _points(
    view: VirtualCamera, oriented: OrientedCamera | None, picture: EditedFrame, own: FloatArray, tried: FloatArray
) -> tuple[list[list[float]], list[list[float]]]:
    """Edge points and features near a frame's own deformation, compared with a trial deformation."""
    if oriented is None:
        lines = view.lines_at(view.edge_clocks(), tried)
        found = picture.near_edge(lines)
        residual = view.mismatch(found, view.edge(tried))[0]
        rows = np.column_stack([found.points_px, found.inward_px, residual, np.isfinite(residual)])
        return _rounded(rows), []
    edge, features = oriented.points_at(picture, own, tried)
    return _rounded(edge), _rounded(features)


def _rounded(rows: FloatArray) -> list[list[float]]:
    """Rows for the page, without NaN."""
    return [[round(float(x), 2) if np.isfinite(x) else 0.0 for x in row] for row in rows]


def _answer_json(fit: FrameFit) -> dict[str, Any]:
    out: dict[str, Any] = {"refused": _said(fit.refused), "edge_points": len(fit.horizon.points_px)}
    if not fit.refused:
        theta, plane, covariance = polar(fit.rotation_yz_rad, fit.covariance)
        out |= {
            "theta_deg": float(np.rad2deg(theta)),
            "theta_sd_deg": float(np.rad2deg(np.sqrt(covariance[0, 0]))),
            "plane_lv_deg": float(np.rad2deg(plane)),
            "plane_sd_deg": float(np.rad2deg(np.sqrt(covariance[1, 1]))),
            "rms_px": fit.residual_rms_px,
            "features": fit.features,
        }
    return out


def _said(fault: Issue) -> dict[str, str] | None:
    return {"words": str(fault), "code": fault.code} if fault else None


def _pose_shown(pose: FloatArray) -> list[float]:
    return [*(float(np.rad2deg(angle)) for angle in pose[:3]), float(pose[3])]


def _edit_json(row: Edit) -> dict[str, Any]:
    numbers = {name: getattr(row, name) for name in ("t_s", "u_px", "v_px", "value")}
    known = {name: None if np.isnan(x) else x for name, x in numbers.items()}
    return {"edit": row.edit, "name": row.name, "note": row.note, **known}


def _edit_of(row: dict[str, Any], camera: str) -> Edit:
    """Edit from the page; `GateError` if it is invalid."""
    try:
        numbers = {k: float("nan") if row.get(k) is None else float(row[k]) for k in ("t_s", "u_px", "v_px", "value")}
        words: dict[str, str] = {k: row.get(k, "") for k in ("edit", "name", "note")}
    except (TypeError, ValueError, AttributeError):
        raise GateError("camera edits: no edit", code="edit-unusable") from None
    if not all(isinstance(word, str) for word in words.values()):
        raise GateError("camera edits: no edit", code="edit-unusable")
    t_s, u_px, v_px, value = (numbers[k] for k in ("t_s", "u_px", "v_px", "value"))
    return Edit(camera, t_s, words["edit"], words["name"], u_px, v_px, value, words["note"])


def _digest(path: Path) -> str:
    return hashlib.sha256(file_bytes(path)).hexdigest() if path.exists() else ""

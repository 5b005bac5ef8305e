"""What did an analyst decide about a film by eye? The table ``camera_edits.csv`` beside ``flight.toml``.

A row is one decision::

    camera, t_s, edit, name, u_px, v_px, value, note

===========  ==============================================================================================
``edit``     meaning
===========  ==============================================================================================
benchmark    the frame at ``t_s`` is the benchmark frame, instead of flight.toml's
reject       the frame at ``t_s`` is not used; ``note`` says why
accept       the frame at ``t_s`` is used although its neighbours speak against it: ``jump-too-fast``,
             ``features-lost``
mask         a corner ``u_px, v_px`` of the region ``name`` that is not looked at; without ``t_s`` in no frame
rim          a point of the shell's edge in the frame at ``t_s``; it takes the place of the edge found there
feature      where the feature ``name`` is in the frame at ``t_s``; it must be marked in the benchmark frame, too
pose         correction ``value`` of the camera's pose, ``name`` one of `POSE`, to start from and as the a priori mean
===========  ==============================================================================================

``t_s`` is in seconds after t0, that of a frame in the frame list. Rows of other cameras are left to them.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flightmodel import tables
from flightmodel.checks import FloatArray, GateError, Issue, nearest_name
from flightmodel.files import write_file

EDITS_FILE = "camera_edits.csv"
COLUMNS = ("camera", "t_s", "edit", "name", "u_px", "v_px", "value", "note")
EDITS = ("benchmark", "reject", "accept", "mask", "rim", "feature", "pose")
POSE = ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg", "focal_factor")
"""Rotations of the camera about its own axes (x to the right, y down, z along the line of sight), and a factor."""
SAME_FRAME_S = 1e-3
LEAST_CORNERS = 3
_LABEL = "camera edits"
_POSE_LIMITS = {"focal_factor": (0.5, 2.0)}
_POSE_DEG = (-45.0, 45.0)
_LONGEST_NOTE, _LONGEST_NAME = 500, 40


@dataclass(frozen=True)
class Edit:
    """One decision; numbers that an edit does not have are NaN. ``t_s`` is that of the frame list."""

    camera: str
    t_s: float
    edit: str
    name: str = ""
    u_px: float = float("nan")
    v_px: float = float("nan")
    value: float = float("nan")
    note: str = ""

    def is_of(self, t_s: float) -> bool:
        """Whether it is about the frame at a time; with NaN, whether it is about no frame of its own."""
        return bool(np.isnan(self.t_s) if np.isnan(t_s) else abs(self.t_s - t_s) <= SAME_FRAME_S)


@dataclass(frozen=True)
class CameraEdits:
    """An analyst's decisions about one camera's film.

    Parameters
    ----------
    rows : tuple of Edit
        In the order in which they were made; of two of one frame and kind the later counts.
    """

    rows: tuple[Edit, ...] = field(default=(), repr=False)

    def of(self, kind: str) -> list[Edit]:
        """Edits of one kind."""
        return [row for row in self.rows if row.edit == kind]

    def at(self, kind: str, t_s: float) -> list[Edit]:
        """Edits of one kind of the frame at a time; masks of all frames belong to each."""
        return [row for row in self.of(kind) if row.is_of(t_s) or (kind == "mask" and np.isnan(row.t_s))]

    @property
    def benchmark_s(self) -> float | None:
        """Time of the benchmark frame; None where flight.toml's stays."""
        chosen = self.of("benchmark")
        return chosen[-1].t_s if chosen else None

    @property
    def pose(self) -> FloatArray:
        """Corrections (4,) of the pose in the order of `POSE`, rad; the last is a factor."""
        at = {row.name: row.value for row in self.of("pose")}
        turned = [np.deg2rad(at.get(name, 0.0)) for name in POSE[:3]]
        return np.array([*turned, at.get(POSE[3], 1.0)])

    def verdict(self, t_s: float) -> Edit | None:
        """Last of "reject" and "accept" for the frame at a time."""
        found = [row for row in self.rows if row.edit in ("reject", "accept") and row.is_of(t_s)]
        return found[-1] if found else None

    def masks_px(self, t_s: float) -> list[FloatArray]:
        """Corners (n, 2) of the regions of the frame at a time in which nothing is looked for."""
        regions: dict[tuple[str, bool], list[tuple[float, float]]] = {}
        for row in self.at("mask", t_s):
            regions.setdefault((row.name, bool(np.isnan(row.t_s))), []).append((row.u_px, row.v_px))
        return [np.array(corners) for corners in regions.values()]

    def features_px(self, t_s: float) -> dict[str, FloatArray]:
        """Where features are in the frame at a time, by name, (2,)."""
        return {row.name: np.array([row.u_px, row.v_px]) for row in self.at("feature", t_s)}

    def resized(self, from_px: tuple[int, int], to_px: tuple[int, int]) -> CameraEdits:
        """The same edits, of pictures (width, height) of another size."""
        across, down = (new / old for new, old in zip(to_px, from_px, strict=True))
        return CameraEdits(
            tuple(
                replace(row, u_px=across * (row.u_px + 0.5) - 0.5, v_px=down * (row.v_px + 0.5) - 0.5)
                for row in self.rows
            )
        )

    def __str__(self) -> str:
        """Numbers of edits by kind, for provenance."""
        counts = {kind: len({(r.t_s, r.name) for r in self.of(kind)}) for kind in EDITS}
        return ", ".join(f"{kind} {count}" for kind, count in counts.items() if count)


NO_EDITS = CameraEdits()


def read_edits(
    path: Path,
    camera: str | None,
    time_s: FloatArray | None = None,
    size_px: tuple[int, int] | None = None,
    cameras: Iterable[str] | None = None,
) -> CameraEdits:
    """Read the edits of one camera; of all, with None.

    Parameters
    ----------
    path : Path
    camera : str or None
    time_s : (n,) float, optional
        Of its frames, seconds after t0; without them, and the size, nothing is checked against the film.
    size_px : (2,) int, optional
        Width and height of its pictures.
    cameras : iterable of str, optional
        Of the vehicle: a row of another is refused.

    Raises
    ------
    GateError
        With every fault of the table and its line.
    """
    frame = tables.read_table(path, _LABEL, least_rows=1)
    missing = [c for c in COLUMNS if c not in frame.columns]
    if missing:
        hints = [f"no column '{c}'{nearest_name(c, list(frame.columns))}" for c in missing]
        raise GateError([f"{_LABEL}: {path}: line 1: {hint}" for hint in hints], code="column-missing")
    faults: list[Issue] = []
    t, u, v, value = (tables.numbers(frame, c, path, _LABEL, faults) for c in ("t_s", "u_px", "v_px", "value"))
    if faults:
        raise GateError(faults)
    words = {c: frame[c].str.strip().tolist() for c in ("camera", "edit", "name", "note")}
    rows, lines, found = [], [], []
    known = None if cameras is None else list(cameras)
    for k, own in enumerate(words["camera"]):
        where = f"{_LABEL}: {path}: line {tables.line_of(frame, k)}"
        if known is not None and own not in known:
            hint = f"{nearest_name(own, known)}; the vehicle has {', '.join(known)}"
            found.append(Issue(f"{where}: camera '{own}'{hint}", "name-unknown"))
        if camera is None or own == camera:
            numbers = (float(u[k]), float(v[k]), float(value[k]))
            rows.append(Edit(own, float(t[k]), words["edit"][k], words["name"][k], *numbers, words["note"][k]))
            lines.append(where)
    found += [] if time_s is None or size_px is None else faults_of(rows, time_s, size_px, lines)
    if found:
        raise GateError(found)
    return CameraEdits(tuple(rows))


def faults_of(
    rows: list[Edit], time_s: FloatArray, size_px: tuple[int, int], lines: list[str] | None = None
) -> list[Issue]:
    """List the faults of one camera's edits; empty if they can be used."""
    out = []
    for k, row in enumerate(rows):
        where = f"{lines[k]}: " if lines else f"{_LABEL}: edit {k + 1}: "
        out += [Issue(where + fault, fault.code) for fault in _faults_of_row(row, time_s, size_px)]
    if out:
        return out
    everything = CameraEdits(tuple(rows))
    for t in sorted({row.t_s for row in everything.of("mask")}):
        for corners in everything.masks_px(t):
            if len(corners) < LEAST_CORNERS:
                words = f"{_LABEL}: a mask has {len(corners)} corners; {LEAST_CORNERS} are needed"
                out.append(Issue(words, "edit-unusable"))
    return out


def _faults_of_row(row: Edit, time_s: FloatArray, size_px: tuple[int, int]) -> list[Issue]:
    if row.edit not in EDITS:
        return [
            Issue(f"edit '{row.edit}'{nearest_name(row.edit, EDITS)}; known are {', '.join(EDITS)}", "edit-unusable")
        ]
    out = []
    if row.edit != "pose" and not (row.edit == "mask" and np.isnan(row.t_s)):
        apart = np.abs(time_s - row.t_s) if np.isfinite(row.t_s) else np.array([np.inf])
        if not len(apart) or apart.min() > SAME_FRAME_S:
            nearest = f"; the nearest is at {time_s[int(np.argmin(apart))]:.3f} s" if np.isfinite(apart).any() else ""
            out.append(Issue(f"no frame at t_s = {row.t_s:g}{nearest}", "time-not-covered"))
    if row.edit in ("mask", "rim", "feature"):
        inside = -0.5 <= row.u_px <= size_px[0] - 0.5 and -0.5 <= row.v_px <= size_px[1] - 0.5
        if not inside:
            at = f"({row.u_px:g}, {row.v_px:g}) px"
            out.append(Issue(f"{at} is outside the picture of {size_px[0]} x {size_px[1]}", "value-range"))
    if row.edit in ("mask", "feature") and not row.name:
        out.append(Issue(f"a {row.edit} needs a name", "edit-unusable"))
    if row.edit == "pose":
        low, high = _POSE_LIMITS.get(row.name, _POSE_DEG)
        if row.name not in POSE:
            words = f"pose '{row.name}'{nearest_name(row.name, POSE)}; known are {', '.join(POSE)}"
            out.append(Issue(words, "edit-unusable"))
        elif not low <= row.value <= high:
            out.append(Issue(f"{row.name} = {row.value:g}; {low:g} to {high:g} is wanted", "value-range"))
    if len(row.note) > _LONGEST_NOTE or len(row.name) > _LONGEST_NAME:
        words = f"a note has at most {_LONGEST_NOTE} characters, a name {_LONGEST_NAME}"
        out.append(Issue(words, "value-range"))
    return out


def write_edits(path: Path, rows: Iterable[Edit]) -> None:
    """Write edits, whole or not at all; without any, the file is removed."""
    listed = list(rows)
    if not listed:
        path.unlink(missing_ok=True)
        return
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(COLUMNS)
    for row in listed:
        numbers = [f"{x:.4f}" if np.isfinite(x) else "" for x in (row.t_s, row.u_px, row.v_px)]
        value = f"{row.value:.9g}" if np.isfinite(row.value) else ""
        # one line a row, as every table of a flight folder
        note = " ".join(row.note.split())
        out.writerow([row.camera, numbers[0], row.edit, row.name, *numbers[1:], value, note])
    write_file(path, text.getvalue())

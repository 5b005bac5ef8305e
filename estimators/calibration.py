"""What does a lens do? Told by the corners of a flat checkerboard in some twenty pictures of it.

OpenCV finds focal lengths, principal point and distortion that bring the corners, seen from a pose of its own in every
picture, closest to where they were found. The standard deviations are those of the linearised fit, with every picture's
pose set free, times the residuals' own size.

Sources: Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22(11), 2000; OpenCV, modules ``cv2``
and ``cv2.fisheye``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from flightmodel import tables
from flightmodel.camera import Lens
from flightmodel.checks import FloatArray, GateError, nearest_name

COLUMNS = ("image", "X_m", "Y_m", "u_px", "v_px")
LEAST_PICTURES, LEAST_CORNERS = 3, 6
LARGEST_BOARD_M = 100.0
LARGEST_CONDITION = 1e8  # of the fit, its unknowns scaled alike
STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-10)


@dataclass(frozen=True)
class LensCalibration:
    """A calibrated lens.

    Parameters
    ----------
    lens : str
        ``"fisheye"`` or ``"pinhole"``.
    focal_px, centre_px : (2,) float
    distortion : (4,) or (5,) float
        See `flightmodel.camera`.
    sd : (8,) or (9,) float
        Of focal lengths, principal point and coefficients, in that order.
    rms_px : float
        Root mean square distance of the corners from where the model has them.
    pictures, corners : int
        How many were used.
    """

    lens: Lens
    focal_px: FloatArray
    centre_px: FloatArray
    distortion: FloatArray
    sd: FloatArray
    rms_px: float
    pictures: int
    corners: int

    def toml(self) -> str:
        """Lines for a camera of a vehicle file."""
        fx = float(self.focal_px.mean())
        numbers = {"focal_px": self.focal_px, "centre_px": self.centre_px, "distortion": self.distortion}
        lines = [f'lens = "{self.lens}"']
        lines += [f"{key} = [{', '.join(f'{x:.8g}' for x in value)}]" for key, value in numbers.items()]
        known = {"focal": self.sd[:2].max() / fx, "centre_px": self.sd[2:4].max(), "k1": self.sd[4], "k2": self.sd[5]}
        lines += [f"uncertainty.{key} = {value:.3g}" for key, value in known.items()]
        return "\n".join(lines)


def read_corners(path: Path) -> pd.DataFrame:
    """Read a table of checkerboard corners.

    Raises
    ------
    GateError
        For a file that is no table, lacks a column, or holds anything but numbers, with the line.
    """
    label = "calibration"
    table = tables.read_table(path, label)
    missing = [c for c in COLUMNS if c not in table.columns]
    if missing:
        found = ", ".join(table.columns)
        hints = [f"no column '{c}'{nearest_name(c, list(table.columns))}; found {found}" for c in missing]
        raise GateError([f"{label}: {path}: line 1: {words}" for words in hints])
    faults: list[str] = []
    values = {c: tables.numbers(table, c, path, label, faults) for c in COLUMNS[1:]}
    for c, column in values.items():
        if not faults and np.isnan(column).any():
            line = tables.line_of(table, int(np.argmax(np.isnan(column))))
            faults.append(f"{label}: {path}: line {line}, column '{c}': no number; remove the line")
    if faults:
        raise GateError(faults)
    return pd.DataFrame({"image": table["image"].str.strip().to_numpy(), **values})


def calibrate_lens(corners: pd.DataFrame, size_px: tuple[int, int], lens: Lens = "fisheye") -> LensCalibration:
    """Calibrate a lens on checkerboard corners.

    Parameters
    ----------
    corners : DataFrame
        One row a corner: ``image``, place on the board ``X_m, Y_m``, place in the picture ``u_px, v_px``.
    size_px : (2,) int
        Width and height of the pictures.
    lens : str
        ``"fisheye"`` (Kannala-Brandt) or ``"pinhole"``.

    Raises
    ------
    GateError
        Where columns are missing, values are not finite or outside the picture, there are too few pictures or corners,
        or the fit fails.
    """
    faults = _faults(corners, size_px)
    if faults:
        raise GateError(faults)
    boards, seen = [], []
    for _, rows in corners.groupby("image", sort=True):
        boards.append(np.column_stack([rows["X_m"], rows["Y_m"], np.zeros(len(rows))])[None].astype(float))
        seen.append(rows[["u_px", "v_px"]].to_numpy(dtype=float)[None])
    try:
        if lens == "fisheye":
            flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
            _, matrix, found, turns, shifts = cv2.fisheye.calibrate(
                boards, seen, size_px, np.eye(3), np.zeros(4), flags=flags, criteria=STOP
            )
        else:
            board32, seen32 = ([part[0].astype(np.float32) for part in parts] for parts in (boards, seen))
            _, matrix, found, turns, shifts = cv2.calibrateCamera(
                board32, seen32, size_px, np.eye(3), np.zeros(5), criteria=STOP
            )
    except cv2.error as failed:
        raise GateError(
            f"calibration: OpenCV found no solution ({failed.err}); check that the board's columns are in metres, that "
            "corners are in the same order in every picture, and that the lens is the right kind"
        ) from failed
    distortion = np.asarray(found, dtype=float).ravel()
    residual, jacobian = _reprojected(boards, seen, matrix, distortion, turns, shifts, lens)
    variance = float(residual @ residual) / max(len(residual) - jacobian.shape[1], 1)
    sd = np.sqrt(variance) * _unit_sd(jacobian)[: 4 + len(distortion)]
    rms = float(np.sqrt(2.0 * np.mean(residual**2)))
    focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
    return LensCalibration(lens, focal, centre, distortion, sd, rms, len(boards), len(corners))


def _unit_sd(jacobian: FloatArray) -> FloatArray:
    """Standard deviations of a linear fit's unknowns for readings of one each.

    Raises
    ------
    GateError
        Where some unknowns can be changed together and no corner moves.
    """
    size = np.linalg.norm(jacobian, axis=0)
    triangle = np.linalg.qr(jacobian / np.where(size > 0.0, size, 1.0), mode="r")
    # not by the normal matrix, whose inverse can have a negative diagonal
    if not size.all() or np.linalg.cond(triangle) > LARGEST_CONDITION:
        raise GateError(
            "calibration: these corners leave the lens open: wanted are pictures in which the board leans to several "
            "sides and reaches the edges; check that each picture's corners lie where that picture has them"
        )
    return np.asarray(np.linalg.norm(np.linalg.inv(triangle), axis=1) / size)


def _faults(corners: pd.DataFrame, size_px: tuple[int, int]) -> list[str]:
    """What is wrong with a table of corners."""
    missing = [c for c in COLUMNS if c not in corners.columns]
    if missing:
        return [f"calibration: no column '{c}'{nearest_name(c, list(corners.columns))}" for c in missing]
    out = []
    numbers = corners[list(COLUMNS[1:])].apply(pd.to_numeric, errors="coerce")
    bad = np.flatnonzero(~np.isfinite(numbers.to_numpy(dtype=float)).all(axis=1))
    if len(bad):
        return [f"calibration: line {bad[0] + 2}: not a number ({len(bad)} such lines)"]
    outside = (numbers["u_px"] < -0.5) | (numbers["v_px"] < -0.5)
    outside |= (numbers["u_px"] > size_px[0] - 0.5) | (numbers["v_px"] > size_px[1] - 0.5)
    if outside.any():
        row = int(np.argmax(outside.to_numpy()))
        where = f"({numbers['u_px'].iloc[row]:g}, {numbers['v_px'].iloc[row]:g}) px"
        out.append(
            f"calibration: line {row + 2}: corner at {where} lies outside a picture of {size_px[0]} x {size_px[1]}; "
            "check the size"
        )
    far = numbers[["X_m", "Y_m"]].abs() > LARGEST_BOARD_M
    if far.any(axis=None):
        row = int(np.argmax(far.any(axis=1).to_numpy()))
        where = f"({numbers['X_m'].iloc[row]:g}, {numbers['Y_m'].iloc[row]:g}) m"
        out.append(f"calibration: line {row + 2}: corner at {where} of the board; metres, below {LARGEST_BOARD_M:g}")
    counts = corners.groupby("image").size()
    if len(counts) < LEAST_PICTURES:
        out.append(f"calibration: {len(counts)} pictures; at least {LEAST_PICTURES}, better 20, are wanted")
    few = counts[counts < LEAST_CORNERS]
    if len(few):
        out.append(f"calibration: image {few.index[0]} has {few.iloc[0]} corners; at least {LEAST_CORNERS} are wanted")
    return out


def _reprojected(
    boards: Sequence[FloatArray], seen: Sequence[FloatArray], matrix: FloatArray, distortion: FloatArray,
    turns: Sequence[FloatArray], shifts: Sequence[FloatArray], lens: Lens,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Residuals of all corners, px, and their derivatives by the lens and by each picture's pose."""
    lens_count, pictures = 4 + len(distortion), len(boards)
    residuals, blocks = [], []
    for k, (board, corner) in enumerate(zip(boards, seen, strict=True)):
        turn, shift = np.asarray(turns[k], dtype=float).ravel(), np.asarray(shifts[k], dtype=float).ravel()
        scene = np.ascontiguousarray(board.reshape(-1, 1, 3))
        if lens == "fisheye":
            pixels, by = cv2.fisheye.projectPoints(scene, turn, shift, matrix, distortion)
            by_lens, by_pose = by[:, :8], by[:, 8:14]
        else:
            pixels, by = cv2.projectPoints(scene, turn, shift, matrix, distortion)
            by_lens, by_pose = by[:, 6:], by[:, :6]
        residuals.append((corner.reshape(-1, 2) - pixels.reshape(-1, 2)).ravel())
        block = np.zeros((len(by_lens), lens_count + 6 * pictures))
        block[:, :lens_count] = by_lens
        block[:, lens_count + 6 * k : lens_count + 6 * (k + 1)] = by_pose
        blocks.append(block)
    return np.concatenate(residuals), np.concatenate(blocks)

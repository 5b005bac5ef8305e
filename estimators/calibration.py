"""What are the focal length, principal point and distortion of a lens, by pictures of a flat checkerboard's corners?

OpenCV finds, from some twenty pictures, the lens that minimises the corners' distances, each picture with a pose of
its own. Corners of one picture err together (a bent board, blur, light, what the lens's model leaves out there), so the
standard deviations are the jackknife's over pictures: with the pose of picture k projected out of its partials A_k and
residuals r_k, the fit without it is, to first order,

    x_k - x = -(N - N_k)^-1 A_k' r_k,     N_k = A_k' A_k,     N = sum N_k
    P = (K - 1) / K  sum (x_k - mean) (x_k - mean)'

K pictures give it K - 1 degrees of freedom; the standard deviation is widened to what holds 68 % by Student's t. It is
never below that of independent corners, s^2 N^-1: few pictures can agree by chance.

Assumed: a flat board, pictures with independent errors.

References
----------
Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22(11), 2000; OpenCV, modules ``cv2`` and
``cv2.fisheye``; R. M. Bell and D. F. McCaffrey, "Bias reduction in standard errors for linear regression with
multi-stage samples", Survey Methodology 28(2), 2002 (the jackknife of clusters by its linear form).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy.special import ndtr, stdtrit

from flightmodel import tables
from flightmodel.camera import Lens
from flightmodel.checks import FloatArray, GateError, Issue, nearest_name
from flightmodel.statistics import jackknife_variance

COLUMNS = ("image", "X_m", "Y_m", "u_px", "v_px")
LEAST_PICTURES, _LEAST_CORNERS = 3, 6  # fewer do not determine focal length and centre, or a board's pose
_LARGEST_BOARD_M = 100.0  # beyond it the unit is wrong
_LARGEST_CONDITION = 1e8  # of the fit, its unknowns scaled alike
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-10)  # to rounding


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
        uncertainty = {
            "focal": self.sd[:2].max() / fx,
            "centre_px": self.sd[2:4].max(),
            "k1": self.sd[4],
            "k2": self.sd[5],
        }
        lines += [f"uncertainty.{key} = {value:.3g}" for key, value in uncertainty.items()]
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
        raise GateError([f"{label}: {path}: line 1: {hint}" for hint in hints], code="column-missing")
    faults: list[Issue] = []
    values = {c: tables.numbers(table, c, path, label, faults) for c in COLUMNS[1:]}
    for c, column in values.items():
        if not faults and np.isnan(column).any():
            line = tables.line_of(table, int(np.argmax(np.isnan(column))))
            what = f"{label}: {path}: line {line}, column '{c}': no number; remove the line"
            faults.append(Issue(what, "not-a-number"))
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
        or the fit fails or is ill-conditioned.
    """
    faults = _faults(corners, size_px)
    if faults:
        raise GateError(faults)
    boards, pixels = [], []
    for _, rows in corners.groupby("image", sort=True):
        boards.append(np.column_stack([rows["X_m"], rows["Y_m"], np.zeros(len(rows))])[None].astype(float))
        pixels.append(rows[["u_px", "v_px"]].to_numpy(dtype=float)[None])
    try:
        if lens == "fisheye":
            flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
            _, matrix, found, rotations, shifts = cv2.fisheye.calibrate(
                boards, pixels, size_px, np.eye(3), np.zeros(4), flags=flags, criteria=_STOP
            )
        else:
            board32, pixel32 = ([part[0].astype(np.float32) for part in parts] for parts in (boards, pixels))
            _, matrix, found, rotations, shifts = cv2.calibrateCamera(
                board32, pixel32, size_px, np.eye(3), np.zeros(5), criteria=_STOP
            )
    except cv2.error as failed:
        raise GateError(
            f"calibration: OpenCV found no solution ({failed.err}); check that the board's columns are in metres, that "
            "corners are in the same order in every picture, and that the lens is the right kind",
            code="not-converged",
        ) from failed
    distortion = np.asarray(found, dtype=float).ravel()
    residual, jacobian = _reprojected(boards, pixels, matrix, distortion, rotations, shifts, lens)
    sd = _sd(residual, jacobian, 4 + len(distortion), [corner.size for corner in pixels])
    rms = float(np.sqrt(2.0 * np.mean(residual**2)))
    focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
    return LensCalibration(lens, focal, centre, distortion, sd, rms, len(boards), len(corners))


def _sd(residual: FloatArray, jacobian: FloatArray, unknowns: int, readings: Sequence[int]) -> FloatArray:
    """Jackknife standard deviations (unknowns,) of the lens: the fit is repeated without each picture.

    Raises
    ------
    GateError
        Where some unknowns can be changed together and no corner moves, with all pictures or without one.
    """
    _check_condition(jacobian)
    normal, gradient = [], []
    for k, rows in enumerate(np.split(np.arange(len(residual)), np.cumsum(readings)[:-1])):
        pose, _ = np.linalg.qr(jacobian[rows, unknowns + 6 * k : unknowns + 6 * (k + 1)])
        by_lens = jacobian[rows, :unknowns]
        by_lens = by_lens - pose @ (pose.T @ by_lens)
        normal.append(by_lens.T @ by_lens)
        gradient.append(by_lens.T @ residual[rows])
    whole = np.sum(normal, axis=0)
    variance = float(residual @ residual) / max(len(residual) - jacobian.shape[1], 1)
    independent = variance * np.diag(np.linalg.inv(whole))
    without = np.array([np.linalg.solve(whole - n, -g) for n, g in zip(normal, gradient, strict=True)])
    wider = float(stdtrit(len(normal) - 1, ndtr(1.0)))
    return np.asarray(np.sqrt(np.maximum(independent, wider**2 * jackknife_variance(without))))


def _check_condition(jacobian: FloatArray) -> None:
    """Refuse an ill-conditioned fit, in which some unknowns can change together without moving any corner."""
    size = np.linalg.norm(jacobian, axis=0)
    # not by the normal matrix, whose condition number is the square
    if not size.all() or np.linalg.cond(jacobian / np.where(size > 0.0, size, 1.0)) > _LARGEST_CONDITION:
        raise GateError(
            f"calibration: ill-conditioned: condition number above {_LARGEST_CONDITION:.0e}; take pictures in which "
            "the board is tilted to several sides and reaches the edges; check that each picture's corners lie "
            "where that picture has them",
            code="not-observable",
        )


def _faults(corners: pd.DataFrame, size_px: tuple[int, int]) -> list[Issue]:
    """Faults of a table of corners."""
    missing = [c for c in COLUMNS if c not in corners.columns]
    if missing:
        listed = list(corners.columns)
        return [Issue(f"calibration: no column '{c}'{nearest_name(c, listed)}", "column-missing") for c in missing]
    out = []
    numbers = corners[list(COLUMNS[1:])].apply(pd.to_numeric, errors="coerce")
    bad = np.flatnonzero(~np.isfinite(numbers.to_numpy(dtype=float)).all(axis=1))
    if len(bad):
        return [Issue(f"calibration: line {bad[0] + 2}: not a number ({len(bad)} such lines)", "not-a-number")]
    outside = (numbers["u_px"] < -0.5) | (numbers["v_px"] < -0.5)
    outside |= (numbers["u_px"] > size_px[0] - 0.5) | (numbers["v_px"] > size_px[1] - 0.5)
    if outside.any():
        row = int(np.argmax(outside.to_numpy()))
        where = f"({numbers['u_px'].iloc[row]:g}, {numbers['v_px'].iloc[row]:g}) px"
        what = f"corner at {where} lies outside a picture of {size_px[0]} x {size_px[1]}; check the size"
        out.append(Issue(f"calibration: line {row + 2}: {what}", "value-range"))
    far = numbers[["X_m", "Y_m"]].abs() > _LARGEST_BOARD_M
    if far.any(axis=None):
        row = int(np.argmax(far.any(axis=1).to_numpy()))
        where = f"({numbers['X_m'].iloc[row]:g}, {numbers['Y_m'].iloc[row]:g}) m"
        what = f"corner at {where} of the board; metres, below {_LARGEST_BOARD_M:g}"
        out.append(Issue(f"calibration: line {row + 2}: {what}", "value-range"))
    counts = corners.groupby("image").size()
    if len(counts) < LEAST_PICTURES:
        what = f"calibration: {len(counts)} pictures; at least {LEAST_PICTURES}, better 20, are needed"
        out.append(Issue(what, "too-few-data"))
    few = counts[counts < _LEAST_CORNERS]
    if len(few):
        what = f"calibration: image {few.index[0]} has {few.iloc[0]} corners; at least {_LEAST_CORNERS} are needed"
        out.append(Issue(what, "too-few-data"))
    return out


def _reprojected(
    boards: Sequence[FloatArray], pixels: Sequence[FloatArray], matrix: FloatArray, distortion: FloatArray,
    rotations: Sequence[FloatArray], shifts: Sequence[FloatArray], lens: Lens,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Residuals of all corners, px, and their derivatives by the lens and by each picture's pose."""
    lens_count, pictures = 4 + len(distortion), len(boards)
    residuals, blocks = [], []
    for k, (board, corner) in enumerate(zip(boards, pixels, strict=True)):
        rotation, shift = np.asarray(rotations[k], dtype=float).ravel(), np.asarray(shifts[k], dtype=float).ravel()
        scene = np.ascontiguousarray(board.reshape(-1, 1, 3))
        if lens == "fisheye":
            projected, by = cv2.fisheye.projectPoints(scene, rotation, shift, matrix, distortion)
            by_lens, by_pose = by[:, :8], by[:, 8:14]
        else:
            projected, by = cv2.projectPoints(scene, rotation, shift, matrix, distortion)
            by_lens, by_pose = by[:, 6:], by[:, :6]
        residuals.append((corner.reshape(-1, 2) - projected.reshape(-1, 2)).ravel())
        block = np.zeros((len(by_lens), lens_count + 6 * pictures))
        block[:, :lens_count] = by_lens
        block[:, lens_count + 6 * k : lens_count + 6 * (k + 1)] = by_pose
        blocks.append(block)
    return np.concatenate(residuals), np.concatenate(blocks)

"""Does a deflection explain a frame's points, or is more motion needed than the model allows?

Tested at the end of a frame's fit are the rms of its residuals, the shape and light that the fit needed against their a
priori sd, two ways in which the picture may have moved since the benchmark frame (a turn of the camera in its mount
with another focal length, and a warp, as by a drop on the lens or by rows that slip), and whether the features in the
upper and in the lower half of the picture give one deflection: what makes a deflection of a picture that slips or is
composed of two is not the same in both. Shape, turn and warp are each tested, and all together. What is no fault yet
but more than chance is in the answer's variance: the deflection that a turn and zoom of its size would look like, and
how far apart the left and the right half are. With the design ``D`` of
deflection, shape and light, weights ``W``, prior ``P``, residuals ``r`` and the derivatives ``T`` by a motion ``m``,

    m = C T' W (r - D x),    x = (D' W D + P)^-1 D' W r,    C^-1 = T' W T - T' W D (D' W D + P)^-1 D' W T

in which lobes of more waves than the modelled ones may look like a motion of their size. The warp is each of ``1, u, v,
u^2, u v, v^2`` along both axes of the picture, the halves' motion a deflection, added above and subtracted below.

Assumed: the camera is fixed to the centerbody, its lens too. Edge points alone hardly tell its turn from a deflection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flightmodel.checks import NO_FAULT, FloatArray, Issue

USUAL_RMS_PX = 1.0  # of edge and features in a frame that is not suspicious
# chi-square that one sound frame in 10,000 exceeds: of seventeen of shape and light, of three rotations and a focal
# length, of twelve terms of a warp, of two components of deflection
WORST_SHAPE, _WORST_TURN, _WORST_WARP, _WORST_HALVES = 47.6, 23.5, 39.1, 18.4
_WORST_ONE = 10.8  # of one, that a sound frame in 1000 exceeds
_MOTION_OFF = 0.1  # of the centerbody's edge, whose light and shadow the motion was found in: what it may be off
_WORST_TOGETHER = 72.0  # of the thirty-three of shape, turn and warp
# sd of a half's deflection by shapes that are not modelled and points that err alike: with it the chi-square of two is
# 1.5 at the most in 216 fits of sound frames, 8.6 in some of another renderer's, 8 to 90 in frames of which rows slip
_HALF_RAD = float(np.deg2rad(0.02))


@dataclass(frozen=True)
class Design:
    """Edge points and features of a frame's fit, ``n`` in all.

    Parameters
    ----------
    columns : (n, 19) float
        Derivatives by deflection (2), flattening, joint station, lobes (12) and light (3).
    formal : (19, 19) float
        The fit's covariance, with the priors.
    turn : (n, 4) float
        By the scene's rotation in camera axes, rad, and the focal scale, px.
    across : (n, 2) float
        Unit vectors along which points are measured, px.
    focal_px : float
    residual_px, weight : (n,) float
    edge_points : int
        Edge points, which come first.
    """

    columns: FloatArray
    formal: FloatArray
    turn: FloatArray
    across: FloatArray
    focal_px: float
    residual_px: FloatArray
    weight: FloatArray
    edge_points: int

    @cached_property
    def places(self) -> tuple[FloatArray, FloatArray]:
        """Right and down (n,) from the picture's centre, over the focal length."""
        # roll about the line of sight moves a point p by its normal, the focal scale by p itself
        along, roll, (a, b) = self.turn[:, 3], self.turn[:, 2], self.across.T
        return (along * a + roll * b) / self.focal_px, (along * b - roll * a) / self.focal_px

    def answer_to(self, moved_px: FloatArray) -> FloatArray:
        """Deflection (2,), rad, that the fit answers to points moved by (n,)."""
        return self.formal[:2] @ (self.columns.T @ (self.weight * moved_px))

    @property
    def warp(self) -> FloatArray:
        """Derivatives (n, 12) by a warp of the picture, its coordinates over the focal length, px."""
        u, v = self.places
        terms = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        return np.concatenate([terms * across[:, None] for across in self.across.T], axis=1)

    @cached_property
    def halves(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives (n, 2) by a deflection that the left half of the features adds and the right half subtracts.

        Last: the upper half and the lower.
        """
        left, upper = (
            np.append(np.zeros(self.edge_points), np.where(at < np.median(at), 1.0, -1.0))
            for at in (place[self.edge_points :] for place in self.places)
        )
        return self.columns[:, :2] * left[:, None], self.columns[:, :2] * upper[:, None]

    def speaks_against(self, moved_px: FloatArray) -> bool:
        """Whether the points contradict a picture motion of (n,) px that is known from elsewhere.

        Both are tested by how much of that motion the residuals show: none, or all.
        """
        by = moved_px[:, None]
        _, without = self.motion(by, _MOTION_OFF)
        _, with_it = replace(self, residual_px=self.residual_px - moved_px).motion(by, _MOTION_OFF)
        return with_it > without + _WORST_ONE

    def motion(self, by: FloatArray, allowed: float) -> tuple[FloatArray, float]:
        """Motion (m,) that explains the residuals best, with derivatives (n, m), and its chi-square.

        ``allowed``: sd that unmodelled lobes lend to each of its terms.
        """
        turned = by.T * self.weight
        crossed = turned @ self.columns
        fitted = crossed @ self.formal
        value, axes = np.linalg.eigh(turned @ by - fitted @ crossed.T)
        along = (turned @ self.residual_px - fitted @ (self.columns.T @ (self.weight * self.residual_px))) @ axes
        seen = value > len(value) * np.finfo(float).eps * value[-1]  # along the others no point moves
        along, value = along[seen], value[seen]
        return axes[:, seen] @ (along / value), float(np.sum(along**2 / (value * (1.0 + allowed**2 * value))))


def fault_of_fit(design: Design, rms_px: float, shape: FloatArray, lobes_rad: float) -> tuple[Issue, float]:
    """Why a deflection does not explain a frame, with its code; empty where it does.

    Last: variance, rad^2, of either component of the answer by what is no fault, but more than chance.

    Parameters
    ----------
    design : Design
    rms_px : float
        Weighted.
    shape : (17,) float
        Flattening, joint station, lobes and light that the fit found, over their a priori sd.
    lobes_rad : float
        A priori sd of shapes that are not modelled.
    """
    if rms_px > USUAL_RMS_PX:
        words = f"rms {rms_px:.1f} px where {USUAL_RMS_PX:.1f} px are allowed"
        return Issue(f"no deflection explains edge and features: {words}", "edge-not-shell"), 0.0
    if shape @ shape > WORST_SHAPE:
        words = (
            f"shape and light would have to be {np.sqrt(shape @ shape / len(shape)):.1f} sd (rms of {len(shape)}) from "
            f"the benchmark frame's, where {np.sqrt(WORST_SHAPE / len(shape)):.1f} are allowed"
        )
        return Issue(words, "edge-not-shell"), 0.0
    together = float(shape @ shape)
    turn, square = design.motion(design.turn, lobes_rad)
    together += square
    if square > _WORST_TURN:
        words = (
            f"the camera seems turned by {np.rad2deg(np.linalg.norm(turn[:3])):.1f} deg in its mount and zoomed by "
            f"{100.0 * turn[3]:.1f} % since the benchmark frame, or edge and features are not the shell's alone"
        )
        return Issue(words, "camera-turned"), 0.0
    # by so much it would move the answer; a sound frame's chi-square is as large as the number of terms in the mean
    variance = _beyond(square, len(turn)) * float(np.sum(design.answer_to(design.turn @ turn) ** 2))
    warp, square = design.motion(design.warp, lobes_rad * design.focal_px)
    if square > _WORST_WARP:
        words = (
            f"the picture seems warped by up to {np.abs(design.warp @ warp).max():.0f} px since the benchmark frame: a "
            "drop on the lens, rows that slip, or edge and features are not the shell's alone"
        )
        return Issue(words, "picture-warped"), 0.0
    if together + square > _WORST_TOGETHER:
        words = (
            f"shape, turn and warp of the picture are jointly improbable (chi-square {together + square:.0f} of "
            f"{len(shape) + len(turn) + len(warp)}): rows are displaced, or edge and features are not the shell's alone"
        )
        return Issue(words, "picture-warped"), 0.0
    fault, apart = _fault_of_halves(design)
    return fault, variance + apart


def _fault_of_halves(design: Design) -> tuple[Issue, float]:
    """As `fault_of_fit`, of the halves of the features."""
    if design.edge_points == len(design.columns):
        return NO_FAULT, 0.0
    variance = 0.0
    for by, is_tested in zip(design.halves, (False, True), strict=True):
        apart, square = design.motion(by, _HALF_RAD)
        off_rad = 2.0 * float(np.linalg.norm(apart))
        if is_tested and square > _WORST_HALVES:
            words = (
                f"features in the upper and the lower half of the picture give deflections {np.rad2deg(off_rad):.1f} "
                "deg apart: rows that slip, or two pictures in one"
            )
            return Issue(words, "halves-differ"), 0.0
        # light on another renderer's cloth moves left against right by nearly as much, 17 at the most in 143 frames:
        # more is no fault there, but which half is right is not known, nor how far both err together
        variance += _beyond(square, _WORST_HALVES) * off_rad**2
    return NO_FAULT, variance


def _beyond(square: float, usual: float) -> float:
    """Share of a chi-square in excess of its usual value."""
    return 1.0 - usual / max(square, usual)

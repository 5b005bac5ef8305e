"""Does a deflection explain what was found in a frame, or would more have to have happened than it allows for?

Tested at the end of a frame's fit are the rms of its residuals, the shape and light that the fit needed against their a
priori sd, and a turn of the camera in its mount since the benchmark frame. With the design ``D`` of deflection, shape
and light, weights ``W``, prior ``P``, residuals ``r`` and the derivatives ``T`` by the turn,

    turn = C T' W (r - D x),    x = (D' W D + P)^-1 D' W r,    C^-1 = T' W T - T' W D (D' W D + P)^-1 D' W T

in which lobes of more waves than the modelled ones may look like a turn of their size.

Assumed: the camera is fixed to the centerbody. Edge points alone hardly tell its turn from a deflection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimators.edge import NO_FAULT
from flightmodel.checks import Fault, FloatArray

USUAL_RMS_PX = 1.0  # of edge and features in a frame that is not suspicious
# chi-square of seventeen of shape and light, and of three rotations, that one sound frame in 10,000 exceeds
WORST_SHAPE, _WORST_TURN = 47.6, 21.1


@dataclass(frozen=True)
class Design:
    """Edge points and features of a frame's fit, ``n`` in all.

    Parameters
    ----------
    columns : (n, 19) float
        Derivatives by deflection (2), flattening, joint station, lobes (12) and light (3).
    gain : (19, n) float
        The fit's, with the priors.
    turn : (n, 3) float
        By the scene's rotation in camera axes, px/rad.
    residual_px, weight : (n,) float
    """

    columns: FloatArray
    gain: FloatArray
    turn: FloatArray
    residual_px: FloatArray
    weight: FloatArray


def fault_of_fit(design: Design, rms_px: float, shape: FloatArray, lobes_rad: float) -> Fault:
    """Why a deflection does not explain a frame, with its code; empty where it does.

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
        return Fault(f"no deflection explains edge and features: {words}", "edge-not-shell")
    if shape @ shape > WORST_SHAPE:
        words = (
            f"shape and light would have to be {np.sqrt(shape @ shape / len(shape)):.1f} sd (rms of {len(shape)}) from "
            f"the benchmark frame's, where {np.sqrt(WORST_SHAPE / len(shape)):.1f} are allowed"
        )
        return Fault(words, "edge-not-shell")
    turned = design.turn.T * design.weight
    crossed = turned @ design.columns @ design.gain
    covariance = np.linalg.inv(turned @ design.turn - crossed @ design.turn)
    turn = covariance @ (turned - crossed) @ design.residual_px
    if turn @ np.linalg.solve(covariance + lobes_rad**2 * np.eye(3), turn) > _WORST_TURN:
        words = (
            f"the camera seems turned by {np.rad2deg(np.linalg.norm(turn)):.1f} deg in its mount since the benchmark "
            "frame, or edge and features are not the shell's alone"
        )
        return Fault(words, "camera-turned")
    return NO_FAULT

"""Does a frame show the shell's edge twice, as two pictures that were mixed into one do?

A second edge is the first one turned: it lies ``J m`` px from it, ``J`` the derivative of the edge's place by a
deflection. Along a line across every edge point, steps of the edge's sign are sought; of all turns ``m`` the one is
taken for which most points have a step there. The limb of the Earth, torus and shadow are steps too, but follow no
turned edge far: in 435 sound frames of 28 films, with and without the Earth, 0.4 of the points agree at the most. A
ring painted or sewn round the shell does; it is known by the points that agree with another radius.

Assumed: the two are apart by more than an edge's blur, and the weaker one stands out of the scatter. Of frames mixed
from two at random that were more than 4 sd wrong, half are noticed.
"""

from __future__ import annotations

import numpy as np

from estimators import _edge_kernels
from estimators.edge import NO_FAULT, STEP_PX, HorizonLine, Image, ScanLines, middle_of, sampled
from flightmodel.checks import Fault, FloatArray

_NEAREST_PX, _FARTHEST_PX = 2.0, 24.0  # nearer is one edge, blurred; farther inside is the next torus
_LEAST_STEP, _OF_SCATTER = 0.05, 3.0  # of the first edge's step; of the scatter of what is no step
_ENOUGH_POINTS, _LEAST_POINTS, _LEAST_PART = 120, 30, 0.3  # looked at; that a turn moves far enough, and of all
_DOUBLED, _BEYOND_RING = 0.55, 0.2  # a turn shares some of a ring's points, where it moves them as far


def fault_of_second_edge(image: Image, horizon: HorizonLine, by_turn: FloatArray, by_radius: FloatArray) -> Fault:
    """Why a frame is not one picture, with its code; empty where no second edge is seen.

    Parameters
    ----------
    image : (h, w) uint8
    horizon : HorizonLine
        Edge points, ``n`` in all.
    by_turn : (n, 2) float
        Derivatives of their places along ``inward_px`` by a deflection, px/rad.
    by_radius : (n,) float
        The same by the shell's radius, px/m.
    """
    some = np.arange(len(by_turn)) % max(1, len(by_turn) // _ENOUGH_POINTS) == 0
    if some.sum() < _LEAST_POINTS:
        return NO_FAULT
    horizon, by_turn, by_radius = horizon.some(some), by_turn[some], by_radius[some]
    reach = _FARTHEST_PX + 1.0
    lines = ScanLines(horizon.points_px, horizon.inward_px, reach, reach, horizon.line)
    grey, inside = sampled(image, lines, round(2.0 * reach / STEP_PX) + 1)
    rise, first = np.empty((len(grey), grey.shape[1] - 2)), np.empty(len(grey))
    _edge_kernels.rises_over_pixel(grey, round(1.0 / STEP_PX), rise, first)
    least = np.maximum(_LEAST_STEP * first, _OF_SCATTER * 1.4826 * middle_of(np.abs(rise)))
    steps = np.empty(rise.shape, dtype=np.bool_)
    _edge_kernels.tops(rise, least, steps)
    whole = (first > 2.0 * least) & inside.all(axis=1)
    limits = (_NEAREST_PX, _FARTHEST_PX, STEP_PX, max(_LEAST_POINTS, round(_LEAST_PART * len(whole))))
    steps, by_turn = steps[whole], by_turn[whole]
    share, turn_rad = _edge_kernels.share_of_second_edge(steps, by_turn, (*limits, _DOUBLED))
    if share <= _DOUBLED:
        return NO_FAULT
    widened, ring = np.column_stack([by_radius, np.zeros_like(by_radius)])[whole], share - _BEYOND_RING
    if _edge_kernels.share_of_second_edge(steps, widened, (*limits, ring))[0] > ring:
        return NO_FAULT
    words = (
        f"the edge is seen twice: {100.0 * share:.0f} % of its points have a second step where a turn by "
        f"{np.rad2deg(turn_rad):.1f} deg would put it, as where two pictures were mixed into one"
    )
    return Fault(words, "picture-doubled")

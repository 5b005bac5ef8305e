"""Where does the half-plane at a clocking angle cut a shell's mesh, and which circle is its edge as seen from aft?

Half-planes hold the body's x axis; places in them are (station aft of the datum ``s``, radius ``r``). Of a section the
support in the direction ``v`` from outboard to aft is

    h(v) = max over its points of  r cos v + s sin v,

and a circle of centre ``(s, r)`` and radius ``a`` has ``h = r cos v + s sin v + a``. A line of sight from the eye
``(s_C, r_C)`` touches the section where ``h(v) = r_C cos v + s_C sin v``. The circle that has the section's support
about there stands for it: its touching point moves with the eye as the section's does.

Assumed: the mesh's normals lie in the half-planes. Where its radius changes round the shell by ``dr/dclock = m r``, the
edge lies off that of the half-planes by the order of ``m^2 a``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock, lv_direction

SUPPORT_ANGLES: FloatArray = np.deg2rad(np.arange(-15.0, 166.0, 3.0))
"""From outboard to aft, beyond both."""
_ABOUT = np.deg2rad(13.5)  # a deflection of ten degrees and the shell's station move the touching point by less
_OUTER = 0.7  # of the largest radius: an edge seen from the hole lies beyond
_BESIDE = 1e-6  # rad, far above rounding
_ON_AXIS = 1e-3  # of the largest radius: a face there has no clocking angle


def meridian_sections(
    vertices_m: FloatArray, faces: NDArray[np.int64], clocks_rad: FloatArray
) -> tuple[NDArray[np.intp], FloatArray]:
    """Segments in which half-planes cut faces.

    Parameters
    ----------
    vertices_m : (n, 3) float
        From the datum, shell axes.
    faces : (m, 3) int
    clocks_rad : (k,) float

    Returns
    -------
    plane : (q,) int
        Index of each segment's half-plane, increasing.
    ends_m : (q, 2, 2) float
        Station and radius of both ends.
    """
    radius, clock = np.hypot(*vertices_m[:, 1:].T), lv_clock(vertices_m[:, 1:])
    faces = faces[(radius[faces] > _ON_AXIS * radius.max()).all(axis=1)]
    first = clock[faces[:, :1]]
    around = first + np.mod(clock[faces] - first + np.pi, 2.0 * np.pi) - np.pi
    wrapped = np.mod(clocks_rad, 2.0 * np.pi)
    order = np.argsort(wrapped)
    once = wrapped[order]
    turns = np.concatenate([once - 2.0 * np.pi, once, once + 2.0 * np.pi])
    # a corner may lie in a half-plane: which side that is, is decided once for all faces that share it, below
    low = np.searchsorted(turns, around.min(axis=1) - _BESIDE)
    high = np.searchsorted(turns, around.max(axis=1) + _BESIDE)
    count = high - low
    face = np.repeat(np.arange(len(faces)), count)
    turn = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)
    plane = order[turn % max(len(once), 1)]
    corners = vertices_m[faces[face]]
    at = clocks_rad[plane]
    off = np.einsum("qci,qi->qc", corners, lv_direction(at + 0.5 * np.pi))
    place = np.stack([-corners[:, :, 0], np.einsum("qci,qi->qc", corners, lv_direction(at))], axis=-1)
    ends, good = _cut(off, place)
    plane, ends = plane[good], ends[good]
    by_plane = np.argsort(plane, kind="stable")
    return plane[by_plane], ends[by_plane]


def _cut(off: FloatArray, place: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Ends (q, 2, 2) of the cuts of triangles by a plane, corners at distances ``off (q, 3)``, and which are cut."""
    above = off > 0.0
    # the corner that is alone on its side; the others are on the other
    alone = np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1)
    rows = np.arange(len(off))
    ends = []
    for step in (1, 2):
        other = (alone + step) % 3
        here, there = off[rows, alone], off[rows, other]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = here / (here - there)
        ends.append(place[rows, alone] + share[:, None] * (place[rows, other] - place[rows, alone]))
    cut = np.stack(ends, axis=1)
    good = above.any(axis=1) & ~above.all(axis=1) & np.isfinite(cut).all(axis=(1, 2))
    return cut, np.asarray(good & (cut[:, :, 1] > 0.0).all(axis=1))


def nearest_on_sections(
    vertices_m: FloatArray, faces: NDArray[np.int64], places_m: FloatArray, clocks_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far places (k, 2), station and radius, each in its half-plane, lie off the mesh, m; its normals (k, 2) there.

    Normals point aft. A place in whose half-plane the mesh is not cut is infinitely far.
    """
    plane, ends = meridian_sections(vertices_m, faces, clocks_rad)
    away, normals = np.full(len(places_m), np.inf), np.tile([1.0, 0.0], (len(places_m), 1))
    along = ends[:, 1] - ends[:, 0]
    length = np.sum(along**2, axis=1)
    from_first = places_m[plane] - ends[:, 0]
    share = np.clip(np.sum(from_first * along, axis=1) / np.maximum(length, 1e-300), 0.0, 1.0)
    off = np.hypot(*(from_first - share[:, None] * along).T)
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.sqrt(np.maximum(length, 1e-300))[:, None]
    for k in np.unique(plane):
        here = slice(*np.searchsorted(plane, [k, k + 1]))
        nearest = here.start + int(np.argmin(off[here]))
        away[k], normals[k] = off[nearest], normal[nearest] * (1.0 if normal[nearest, 0] >= 0.0 else -1.0)
    return away, normals


def section_supports(vertices_m: FloatArray, faces: NDArray[np.int64], clocks_rad: FloatArray) -> FloatArray:
    """Support (k, 61), m, of the outer section at each clocking angle in each of `SUPPORT_ANGLES`; NaN without one."""
    radius = np.hypot(*vertices_m[:, 1:].T)
    faces = faces[(radius[faces] > _OUTER * radius.max()).any(axis=1)]
    plane, ends = meridian_sections(vertices_m, faces, clocks_rad)
    out = np.full((len(clocks_rad), len(SUPPORT_ANGLES)), np.nan)
    if not len(plane):
        return out
    which, start = np.unique(plane, return_index=True)
    for k, v in enumerate(SUPPORT_ANGLES):
        along = (ends[:, :, 1] * np.cos(v) + ends[:, :, 0] * np.sin(v)).max(axis=1)
        out[which, k] = np.maximum.reduceat(along, start)
    return out


def touching_circles(supports_m: FloatArray, eyes_m: FloatArray) -> FloatArray:
    """Circles (k, 3), station, radius, minor radius, m, that stand for sections as seen from ``eyes_m`` (k, 2).

    Eyes are places in the half-planes, aft of the sections and inboard of their edges. NaN where no line of sight
    touches a section.
    """
    v = SUPPORT_ANGLES
    over = supports_m - eyes_m[:, 1:] * np.cos(v) - eyes_m[:, :1] * np.sin(v)
    # from outboard, where the section lies beyond the eye, to the first angle where it does not
    past = (over[:, 1:] <= 0.0) & (over[:, :-1] > 0.0)
    touched = np.where(past.any(axis=1), np.argmax(past, axis=1), -1)
    out = np.full((len(supports_m), 3), np.nan)
    for angle in np.unique(touched[touched >= 0]):
        near, here = np.abs(v - v[angle]) <= _ABOUT, touched == angle
        design = np.column_stack([np.sin(v[near]), np.cos(v[near]), np.ones(near.sum())])
        out[here] = np.linalg.lstsq(design, supports_m[here][:, near].T, rcond=None)[0].T
    return out

"""Where do the marks painted on the shell, gore seams and photogrammetry dots, appear in a frame?

Each mark is measured along one direction in the picture: a piece of a seam across it, a dot along rows and along
columns. The marks that a camera can see are chosen once, on the unbent shell: those that face it and that no torus and
no part of the centerbody hides. In a frame they are looked for a few pixels around where a first fit of the edge
expects them; a mark is taken where the grey level dips clearly below the line between the ends of its profile, and its
place is the dip's centroid (`estimators._edge_kernels.dark_centres`).

Assumed: marks darker than the cloth. Marks that are not there, or drowned in noise, give no measurement and no harm.

Where does the pattern of marks fit a frame, when it may be anywhere within degrees?

A search over parameters (the camera's pose, or the bending) that needs no edge: behind the rim may be the Earth, whose
limb and clouds are edges too, while seams and dots are nowhere but on the shell. The frame is turned into a picture of
how much darker each pixel is than its surroundings (black hat), blurred; the score of a hypothesis is the mean of that
picture at the projected marks. The maximum is found by the cross-entropy method, from wide to narrow and from a coarse
blur to a fine one: draws from a normal distribution, which then moves to the best of them.

Sources: R. Y. Rubinstein, D. P. Kroese, "The Cross-Entropy Method", 2004.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators import _edge_kernels
from estimators.virtual_camera import Sight, VirtualCamera
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.geometry import aft_profile, dot_positions, revolved, seam_clocks_rad, torus_circles

Image = NDArray[np.uint8]

LEAST_FACING = 0.3
HALF_SEAM_M, HALF_DOT_M = 0.006, 0.011
SEAM_STEP_PX = 10.0
SD_FLOOR_PX = 0.05
BORDER_PX = 12.0


@dataclass(frozen=True)
class Marks:
    """Marks that a camera can see, one row a direction in which one is measured.

    Parameters
    ----------
    points_shell_m : (n, 3) float
        On the unbent shell, from the datum.
    across_px : (n, 2) float
        Unit vectors in the picture.
    half_width_px : (n,) int
        How far from its middle a mark is dark, blur included.
    is_dot : (n,) bool
    """

    points_shell_m: FloatArray
    across_px: FloatArray
    half_width_px: NDArray[np.int64]
    is_dot: BoolArray

    def find(self, image: Image, expected_px: FloatArray, reach_px: int, noise: float) -> tuple[FloatArray, FloatArray]:
        """Distance ``(n,)`` of each mark from where it is expected ``(n, 2)``, along its direction, and its sd, px.

        The sd is infinite where there is none within ``reach_px``.
        """
        offset, sd = np.zeros(len(expected_px)), np.full(len(expected_px), np.inf)
        _edge_kernels.dark_centres(image, expected_px, self.across_px, reach_px, self.half_width_px, noise, offset, sd)
        return offset, np.hypot(sd, SD_FLOOR_PX)


def visible_marks(view: VirtualCamera) -> Marks:
    """Choose the marks on the unbent shell that a camera sees well inside its picture."""
    rows: list[tuple[FloatArray, FloatArray, FloatArray, bool]] = []
    geometry, focal = view.geometry, float(view.camera.focal_px.mean())
    profile = aft_profile(geometry)
    for clock in seam_clocks_rad(geometry):
        curve = revolved(profile, clock)
        seen = _seen(view, curve, _aft_normals(profile, clock))
        pixels = view.sight(curve, np.zeros(3)).pixels
        along = np.gradient(pixels, axis=0)
        pieces = _spaced(pixels, seen & np.isfinite(along).all(axis=1), SEAM_STEP_PX)
        tangent = along[pieces]
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        rows.append(
            (curve[pieces], np.column_stack([-tangent[:, 1], tangent[:, 0]]), _away(view, curve[pieces]), False)
        )
    dots = dot_positions(geometry)
    # at its crest a torus faces along the cone's aft normal
    half = np.deg2rad(geometry.half_angle_deg)
    outboard = dots * np.array([0.0, 1.0, 1.0])
    outboard /= np.linalg.norm(outboard, axis=1, keepdims=True)
    normals = -np.cos(half) * outboard - np.sin(half) * np.array([1.0, 0.0, 0.0])
    dots = dots[_seen(view, dots, normals)]
    for axis in np.eye(2):
        rows.append((dots, np.tile(axis, (len(dots), 1)), _away(view, dots), True))
    points = np.concatenate([r[0] for r in rows])
    across = np.concatenate([r[1] for r in rows])
    is_dot = np.concatenate([np.full(len(r[0]), r[3]) for r in rows])
    size_m = np.where(is_dot, HALF_DOT_M, HALF_SEAM_M)
    half_width = np.ceil(focal * size_m / np.concatenate([r[2] for r in rows]) + 2.0).astype(np.int64)
    return Marks(points, across, half_width, is_dot)


def _away(view: VirtualCamera, points: FloatArray) -> FloatArray:
    out: FloatArray = np.linalg.norm(points - view.camera.position_body_m, axis=1)
    return out


def _aft_normals(profile: FloatArray, clock_lv_rad: float) -> FloatArray:
    """Outward normals ``(m, 3)`` of the aft side along a meridian ``(m, 2)`` of station and radius."""
    along = np.gradient(profile, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # outwards along the meridian, the free side lies to the left: aft of it
    turned = np.column_stack([along[:, 1], -along[:, 0]])
    return revolved(turned, clock_lv_rad)


def _spaced(pixels: FloatArray, seen: BoolArray, step_px: float) -> NDArray[np.intp]:
    """Indices of seen points at least ``step_px`` apart along a curve."""
    chosen: list[int] = []
    for k in np.flatnonzero(seen):
        if not chosen or np.hypot(*(pixels[k] - pixels[chosen[-1]])) >= step_px:
            chosen.append(int(k))
    return np.array(chosen, dtype=np.intp)


def _seen(view: VirtualCamera, points: FloatArray, normals: FloatArray) -> BoolArray:
    """Whether points ``(n, 3)`` of the unbent shell with outward normals face the camera, unhidden, in the picture."""
    eye = view.camera.position_body_m
    sight: Sight = view.sight(points, np.zeros(3))
    inside = np.isfinite(sight.pixels[:, 0]) & view.camera.is_inside(np.nan_to_num(sight.pixels, nan=-1e6), BORDER_PX)
    towards = eye - points
    distance = np.linalg.norm(towards, axis=1)
    facing = np.einsum("ni,ni->n", normals, towards) / distance > LEAST_FACING
    seen = inside & facing
    share = np.linspace(0.04, 0.97, 80)[:, None, None]
    way = points[seen] + share * towards[seen]
    station, radius = torus_circles(view.geometry)
    s, r = -way[..., 0], np.hypot(way[..., 1], way[..., 2])
    clear = np.ones(int(seen.sum()), dtype=np.bool_)
    for s_i, r_i in zip(station, radius, strict=True):
        clear &= (np.hypot(s - s_i, r - r_i) > view.geometry.torus_minor_radius_m).all(axis=0)
    # the lens may sit on the skin itself
    skin = min(view.geometry.centerbody_radius_m, float(np.hypot(eye[1], eye[2])) - 1e-3)
    clear &= (r > skin).all(axis=0)
    seen[seen] = clear
    return np.asarray(seen)


Pixels = Callable[[FloatArray], FloatArray]
"""From parameters ``(k,)`` to the marks' pixels ``(n, 2)``, NaN outside the lens's field."""

HAT_PX = 17
BLURS_PX = (9.0, 9.0, 6.0, 4.0, 3.0, 2.0, 2.0)
DRAWS, ELITE = 240, 16
NARROWEST, FARTHEST_SD = 0.02, 2.5
DARKEST = 30.0
LEAST_RISE, OTHERS = 3.0, 60


def fitted_pattern(image: Image, pixels: Pixels, starts: list[FloatArray], sd: FloatArray) -> FloatArray | None:
    """Parameters ``(k,)`` at which the marks fit a frame best; None where no place stands out.

    Parameters
    ----------
    image : (h, w) uint8
    pixels : callable
    starts : list of (k,) float
        Where to look, each the mean of a normal distribution; the best of all is taken.
    sd : (k,) float
    """
    hat = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (HAT_PX, HAT_PX))
    smooth = cv2.GaussianBlur(image, (0, 0), 1.2)
    dark = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, hat).astype(np.float32)
    # a mark is a mark, however strong: deep shadows between tori must not outweigh it
    dark = np.minimum(dark, DARKEST)
    scores = [cv2.GaussianBlur(dark, (0, 0), blur) for blur in BLURS_PX]
    rng = np.random.default_rng(0)
    found = []
    for start in starts:
        centre, spread = start.copy(), sd.copy()
        for score in scores:
            drawn = centre + spread * rng.standard_normal((DRAWS, len(sd)))
            drawn[0] = centre
            # not beyond what is held possible, where all marks may come together on one dark spot
            drawn = np.clip(drawn, start - FARTHEST_SD * sd, start + FARTHEST_SD * sd)
            values = np.array([_score(score, pixels(p)) for p in drawn])
            best = drawn[np.argsort(-values)[:ELITE]]
            centre, spread = best.mean(axis=0), np.maximum(best.std(axis=0), NARROWEST * sd)
        found.append((_score(scores[-1], pixels(centre)), centre))
    highest, where = max(found, key=lambda pair: pair[0])
    others = [_score(scores[-1], pixels(p)) for p in starts[0] + sd * rng.standard_normal((OTHERS, len(sd)))]
    usual = float(np.median(others))
    scatter = 1.4826 * float(np.median(np.abs(np.array(others) - usual)))
    return where if highest - usual > LEAST_RISE * scatter else None


def _score(picture: NDArray[np.float32], pixels: FloatArray) -> float:
    """Mean of a picture at pixels; those outside it count as its mean."""
    h, w = picture.shape
    at = np.nan_to_num(pixels, nan=-1.0)
    u, v = np.rint(at).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    total = float(picture[v[inside], u[inside]].sum()) + float(picture.mean()) * int((~inside).sum())
    return total / len(at)

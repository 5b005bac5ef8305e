"""Where do the features painted on the shell, gore seams and photogrammetry dots, appear in a frame?

Each feature is measured along one direction in the picture: a piece of a seam across it, a dot along rows and along
columns. The features in view are chosen once, on the undeflected shell: those that face the camera and that no torus
and no part of the centerbody hides. In a frame they are looked for a few pixels around their prediction by a first fit;
a feature is taken where the grey level dips clearly below the line between the ends of its profile, and its place is
the dip's centroid,

    place = sum over x of x dip(x) / sum over x of dip(x).

Where the prediction may be off by degrees, the parameters (the camera's pose, or the deflection) at which all features
fit are searched (`fit_feature_map`). This needs no edge: behind the rim may be the Earth, whose limb and clouds are
edges too, while seams and dots are nowhere but on the shell. The frame is transformed to the darkness of each pixel
against its surroundings (black hat), blurred: the feature map; the score of a hypothesis is the map's mean at the
projected features. The maximum is found by the cross-entropy method, from wide to narrow and from a coarse blur to a
fine one: draws from a normal distribution, which then moves to the best of them.

Assumed: features darker than the cloth. One that is not painted, or lost in noise, gives no measurement and no harm.

References
----------
R. Y. Rubinstein, D. P. Kroese, "The Cross-Entropy Method", 2004.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.edge import grey_inside
from estimators.virtual_camera import RADIUS, Sight, VirtualCamera, meets_centerbody, pixel_of
from flightmodel._kernels import inlined, kernel
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock
from flightmodel.geometry import (
    FEATURE_KINDS,
    ListedFeatures,
    aft_profile,
    circumferential,
    dot_positions,
    revolved,
    seam_clocks_rad,
    torus_circles,
    torus_limb,
)
from flightmodel.rendering import Rendered, against, face_normals
from flightmodel.statistics import NORMAL_MAD

Image = NDArray[np.uint8]
Pixels = Callable[[FloatArray], FloatArray]
"""From many parameters ``(m, k)`` to the features' pixels ``(m, n, 2)``, NaN outside the lens's field."""

_LEAST_FACING = 0.3  # cosine: seen flatter a feature has less than a third of its width
_HALF_SEAM_M, _HALF_DOT_M = 0.006, 0.011  # as `flightmodel.geometry` draws them; a list states its own
_SEAM_STEP_PX = 10.0  # between points of a seam, so that their windows do not overlap
_SD_FLOOR_PX = 0.05  # as of the edge
_BORDER_PX = 12.0  # of the picture: the window of a search lies inside
# the search of the feature map
_HAT_PX = 17
_BLURS_PX = (9.0, 9.0, 6.0, 4.0, 3.0, 2.0, 2.0)
_DRAWS, _ELITE = 240, 16
_NARROWEST, _FARTHEST_SD = 0.02, 2.5
_DARKEST = 30.0
_LEAST_RISE, _OTHERS = 3.0, 60
_NOISE_GREY = 2.5
_VALLEY_STEP_PX, _HALF_VALLEY_PX = 10.0, 5
_VALLEY_PLACED_M, _VALLEY_OFFSET_PX = 0.03, 3.0  # a tenth of a torus by the light; neighbours err together
_GRAZING_M = 1e-6  # rounding of a point on the very surface
_BENDS = float(np.cos(np.deg2rad(50.0)))  # within two pixels; the skin of a torus bends by a tenth of that
_ON_MESH_M = 0.05  # along the sight: two hundredths off the surface, seen at 25 deg
_ALONG_M = 0.002  # a step along a line, for its direction: a pixel or less
_WIDEST_HALF_PX = 5  # a feature and cloth on both sides fit in the window of the nearest search


class Features(Protocol):
    """What a frame is searched for beside the edge: painted features, or the shell's own texture.

    One row a direction in which a place is measured.
    """

    @property
    def points_shell_m(self) -> FloatArray:
        """Points (n, 3) of the undeflected shell, from the datum, m."""
        ...

    @property
    def across_px(self) -> FloatArray:
        """Unit vectors (n, 2) in the picture."""
        ...

    def find(
        self, view: VirtualCamera, image: Image, deformation: FloatArray, reach_px: int
    ) -> tuple[FloatArray, FloatArray]:
        """Place (n,) of each row along its direction, px, and its sd, infinite where it was not found.

        They are looked for within ``reach_px`` of where a deformation (3,) puts them; see `VirtualCamera.sight`.
        """
        ...


@inlined
def dark_centres(image, origin, across, reach, half_widths, signs, noise, offset, sd):
    """Offset along unit vectors ``across`` (n, 2) from ``origin`` (n, 2), px, of the dark line or spot there.

    ``signs`` (n,): 1 for a dark one, -1 for one paler than what is beside it. A profile is the mean of three lines a
    pixel apart; the dip under the line between its ends, as a share of that line, has its centroid where the feature
    is. ``sd`` is infinite where no dip stands out of the noise, or where it is cut off by the window.
    """
    m = 2 * reach + 1
    dip, grey = np.empty(m), np.empty(3 * m)
    h, w = image.shape
    for i in range(len(origin)):
        sd[i] = np.inf
        du, dv = across[i]
        centre = 0.0
        for _ in range(2):
            u0, v0 = origin[i, 0] + centre * du, origin[i, 1] + centre * dv
            if not (reach + 2 <= u0 <= w - reach - 3 and reach + 2 <= v0 <= h - reach - 3):
                sd[i] = np.inf
                break
            for c in range(3):
                for k in range(m):
                    u, v = u0 + (k - reach) * du - (c - 1) * dv, v0 + (k - reach) * dv - (1 - c) * du
                    grey[c * m + k] = grey_inside(image, u, v)
            for k in range(m):
                dip[k] = (grey[m + k] + (grey[k] + grey[2 * m + k])) / 3.0
            left, right = 0.5 * (dip[0] + dip[1]), 0.5 * (dip[m - 1] + dip[m - 2])
            deepest = 0
            for k in range(m):
                dip[k] = signs[i] * (left + (right - left) * k / (m - 1.0) - dip[k])
                if dip[k] > dip[deepest]:
                    deepest = k
            depth = dip[deepest]
            if depth < max(5.0 * noise, 6.0) or deepest < 2 or deepest > m - 3:
                sd[i] = np.inf
                break
            # paint takes away a share of the light, whatever the light's slope across the feature
            slope = (right - left) / (m - 1.0)
            total, moment, reach_in = 0.0, 0.0, half_widths[i]
            for k in range(m):
                above = dip[k] - 0.15 * depth
                if above > 0.0 and abs(k - deepest) <= reach_in:
                    share = above / (left + slope * k)
                    total += share
                    moment += share * (k - reach)
            centre += moment / total
            # of the mean of three lines, over the squares of 1, 2, ... on either side
            squares = reach_in * (reach_in + 1.0) * (2.0 * reach_in + 1.0) / 3.0
            sd[i] = noise / (left + slope * deepest) * math.sqrt(squares / 3.0) / total
        offset[i] = centre


@kernel
def find_dark(image, points, terms, lens, across, search, floor, place, sd):
    """Place (n,) of dark features, at points (n, 3) of the shell, along unit vectors (n, 2); its sd, over a ``floor``.

    ``terms``, ``lens``: as of `estimators.virtual_camera.project_points`. ``search``: reach, half widths, signs and
    noise, as of `dark_centres`.
    """
    n = len(points)
    expected = np.empty((n, 2))
    for i in range(n):
        u, v = pixel_of(points[i], terms, lens)
        # what the lens does not see lies far from the picture
        expected[i, 0], expected[i, 1] = (u, v) if math.isfinite(u) else (-1e6, -1e6)
        place[i] = 0.0
    reach, half_widths, signs, noise = search
    dark_centres(image, expected, across, reach, half_widths, signs, noise, place, sd)
    for i in range(n):
        place[i] += expected[i, 0] * across[i, 0] + expected[i, 1] * across[i, 1]
        sd[i] = math.sqrt(sd[i] * sd[i] + floor * floor)


@dataclass(frozen=True)
class ImageFeatures:
    """Features in the camera's view, one row a direction in which one is measured.

    Parameters
    ----------
    points_shell_m : (n, 3) float
        On the undeflected shell, from the datum.
    across_px : (n, 2) float
        Unit vectors in the picture.
    half_width_px : (n,) int
        How far from its middle a feature is dark, blur included.
    is_dot : (n,) bool
    signs : (n,) float
        1 where darker than the cloth beside it, -1 where paler.
    placed_m : float
        A priori sd of each one's place on the shell; painted ones keep to millimetres.
    offset_px : float
        A priori sd of a shift along their directions that all have in common.
    """

    points_shell_m: FloatArray
    across_px: FloatArray
    half_width_px: NDArray[np.int64]
    is_dot: BoolArray
    signs: FloatArray
    placed_m: float = 0.003
    offset_px: float = 0.0

    def find(
        self, view: VirtualCamera, image: Image, deformation: FloatArray, reach_px: int
    ) -> tuple[FloatArray, FloatArray]:
        """See `Features.find`."""
        place, sd = np.empty((2, len(self.points_shell_m)))
        search = (reach_px, self.half_width_px, self.signs, _NOISE_GREY)
        find_dark(
            image, self.points_shell_m, view.terms(deformation), view.camera.lens_terms, self.across_px, search,
            _SD_FLOOR_PX, place, sd,
        )  # fmt: skip
        return place, sd


def visible_features(view: VirtualCamera) -> ImageFeatures:
    """Features of the undeflected shell well inside the camera's picture: the vehicle's own list, or those drawn."""
    listed = view.geometry.listed_features
    return _drawn(view) if listed is None else _listed(view, listed)


def _listed(view: VirtualCamera, listed: ListedFeatures) -> ImageFeatures:
    """An analyst's own features: a dot along rows and columns, a point of a line across it."""
    visible = _in_view(view, listed.points_shell_m, listed.normals)
    points, normals, kind = listed.points_shell_m[visible], listed.normals[visible], listed.kind[visible]
    width, sign = listed.width_m[visible], np.where(listed.is_paler[visible], -1.0, 1.0)
    round_shell = circumferential(points)
    along = np.where((kind == FEATURE_KINDS.index("seam"))[:, None], np.cross(normals, round_shell), round_shell)
    ends = [view.sight(points + side * _ALONG_M * along, np.zeros(3)).pixels for side in (-1.0, 1.0)]
    tangent = ends[1] - ends[0]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    dot = kind == FEATURE_KINDS.index("dot")
    across = np.where(dot[:, None], np.array([1.0, 0.0]), np.column_stack([-tangent[:, 1], tangent[:, 0]]))
    row = np.concatenate([np.arange(len(points)), np.flatnonzero(dot)])
    across = np.concatenate([across, np.tile([0.0, 1.0], (int(dot.sum()), 1))])
    half_m = 0.5 * width[row] * view.camera.focal_px.mean() / _away(view, points[row])
    half_width = np.minimum(np.ceil(half_m + 2.0), _WIDEST_HALF_PX).astype(np.int64)
    return ImageFeatures(points[row], across, half_width, dot[row], sign[row])


def _drawn(view: VirtualCamera) -> ImageFeatures:
    """Seams and dots where `flightmodel.geometry` draws them."""
    rows: list[tuple[FloatArray, FloatArray, FloatArray, bool]] = []
    geometry, focal = view.geometry, float(view.camera.focal_px.mean())
    profile = aft_profile(geometry)
    for clock in seam_clocks_rad(geometry):
        curve = revolved(profile, clock)
        in_view = _in_view(view, curve, _aft_normals(profile, clock))
        pixels = view.sight(curve, np.zeros(3)).pixels
        along = np.gradient(pixels, axis=0)
        pieces = _spaced(pixels, in_view & np.isfinite(along).all(axis=1), _SEAM_STEP_PX)
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
    dots = dots[_in_view(view, dots, normals)]
    for axis in np.eye(2):
        rows.append((dots, np.tile(axis, (len(dots), 1)), _away(view, dots), True))
    points = np.concatenate([r[0] for r in rows])
    across = np.concatenate([r[1] for r in rows])
    is_dot = np.concatenate([np.full(len(r[0]), r[3]) for r in rows])
    size_m = np.where(is_dot, _HALF_DOT_M, _HALF_SEAM_M)
    half_width = np.ceil(focal * size_m / np.concatenate([r[2] for r in rows]) + 2.0).astype(np.int64)
    return ImageFeatures(points, across, half_width, is_dot, np.ones(len(points)))


def light_shift(view: VirtualCamera, features: Features) -> FloatArray:
    """Response (n, 3) of each row to a radial shift of features by the light, px.

    It is the same all round the shell, or cosine and sine of one wave.
    """
    points = features.points_shell_m
    outwards = view.sight(points, np.zeros(3)).jacobian[:, :, RADIUS]
    along = np.einsum("ni,ni->n", features.across_px, outwards) / np.linalg.norm(outwards, axis=1)
    clock = lv_clock(points[:, 1:])
    waves = np.column_stack([np.ones_like(clock), np.cos(clock), np.sin(clock)])
    return np.asarray(np.nan_to_num(along)[:, None] * waves)


def no_features() -> ImageFeatures:
    """No features, for a shell without any: only its edge is searched for."""
    nothing = np.zeros(0, dtype=np.int64)
    return ImageFeatures(np.zeros((0, 3)), np.zeros((0, 2)), nothing, nothing.astype(np.bool_), np.zeros(0))


def valleys(view: VirtualCamera) -> ImageFeatures:
    """Dark valleys between the tori of the undeflected shell, whatever is painted on them.

    One lies behind the limb of each inner torus, whose points are given; directions are outboard. How far behind the
    limb its middle lies, and how dark it is, is the light's doing.
    """
    if view.undeflected is not None:
        return _valley_features(*_limbs_within(view, view.undeflected))
    points, across = [], []
    for torus in range(view.geometry.torus_count - 1):
        limb = torus_limb(view.geometry, view.camera.position_body_m, view.clocks_rad, torus)
        pixels = view.sight(limb, np.zeros(3)).pixels
        along = np.gradient(pixels, axis=0)
        clear = _unhidden(view, limb, np.asarray(np.isfinite(along).all(axis=1)))
        clear &= view.camera.is_inside(np.nan_to_num(pixels, nan=-1e6), _BORDER_PX)
        chosen = _spaced(pixels, clear, _VALLEY_STEP_PX)
        points.append(limb[chosen])
        # clocking angles grow to the left, so outboard lies to the right along a limb
        across.append(np.column_stack([-along[chosen, 1], along[chosen, 0]]))
    normal = np.concatenate([np.zeros((0, 2)), *across])
    return _valley_features(
        np.concatenate([np.zeros((0, 3)), *points]),
        normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12),
    )


def _valley_features(points: FloatArray, across: FloatArray) -> ImageFeatures:
    n = len(points)
    return ImageFeatures(
        points, across, np.full(n, _HALF_VALLEY_PX), np.zeros(n, dtype=np.bool_), np.ones(n), _VALLEY_PLACED_M,
        _VALLEY_OFFSET_PX,
    )  # fmt: skip


def _limbs_within(view: VirtualCamera, rendered: Rendered) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) of a mesh beyond which its surface bends away or hides some of itself; outboard in the picture."""
    camera, mesh = view.camera, view.geometry.mesh
    assert mesh is not None
    v, u = np.nonzero(rendered.is_hit)
    at = np.column_stack([u, v])
    rays = camera.rays_body(at.astype(float))
    points = camera.position_body_m + rendered.depth_m[v, u, None] * rays
    outboard = view.sight(points, np.zeros(3)).jacobian[:, :, RADIUS]
    outboard /= np.maximum(np.linalg.norm(outboard, axis=1, keepdims=True), 1e-12)
    inside = camera.is_inside(at.astype(float), _BORDER_PX) & ~meets_centerbody(view, rays)
    beyond = np.rint(at[inside] + 2.0 * outboard[inside]).astype(np.int64)
    face, next_face = rendered.face[v[inside], u[inside]], rendered.face[beyond[:, 1], beyond[:, 0]]
    # towards the camera, however they are wound
    normal, next_normal = (
        against(face_normals(mesh.vertices_m, mesh.faces[k]), rays[inside]) for k in (face, next_face)
    )
    bends = np.einsum("ni,ni->n", normal, next_normal) < _BENDS
    rows = np.flatnonzero(inside)[(next_face >= 0) & bends]
    # one to a square
    cell = (v[rows] // _VALLEY_STEP_PX) * len(rendered.face[0]) + u[rows] // _VALLEY_STEP_PX
    rows = rows[np.unique(cell, return_index=True)[1]]
    return points[rows], outboard[rows]


def _away(view: VirtualCamera, points: FloatArray) -> FloatArray:
    out: FloatArray = np.linalg.norm(points - view.camera.position_body_m, axis=1)
    return out


def _aft_normals(profile: FloatArray, clock_lv_rad: float) -> FloatArray:
    """Outward normals ``(m, 3)`` of the aft side along a meridian ``(m, 2)`` of station and radius."""
    along = np.gradient(profile, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # outwards along the meridian, the free side lies to the left: aft of it
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    return revolved(normal, clock_lv_rad)


def _spaced(pixels: FloatArray, visible: BoolArray, step_px: float) -> NDArray[np.intp]:
    """Indices of visible points at least ``step_px`` apart along a curve."""
    chosen: list[int] = []
    for k in np.flatnonzero(visible):
        if not chosen or np.hypot(*(pixels[k] - pixels[chosen[-1]])) >= step_px:
            chosen.append(int(k))
    return np.array(chosen, dtype=np.intp)


def _in_view(view: VirtualCamera, points: FloatArray, normals: FloatArray) -> BoolArray:
    """Whether points ``(n, 3)`` of the undeflected shell with outward normals are visible in the picture."""
    eye = view.camera.position_body_m
    sight: Sight = view.sight(points, np.zeros(3))
    inside = np.isfinite(sight.pixels[:, 0]) & view.camera.is_inside(np.nan_to_num(sight.pixels, nan=-1e6), _BORDER_PX)
    towards = eye - points
    distance = np.linalg.norm(towards, axis=1)
    facing = np.einsum("ni,ni->n", normals, towards) / distance > _LEAST_FACING
    return _unhidden(view, points, inside & facing)


def _unhidden(view: VirtualCamera, points: FloatArray, wanted: BoolArray) -> BoolArray:
    """Whether no torus and no part of the centerbody hides wanted points ``(n, 3)`` of the undeflected shell.

    Of a mesh: whether they lie where it is seen, neither behind its surface nor off it.
    """
    eye = view.camera.position_body_m
    if view.undeflected is not None:
        rays = points - eye
        away = np.linalg.norm(rays, axis=1)
        at = np.rint(np.nan_to_num(view.sight(points, np.zeros(3)).pixels, nan=-1.0)).astype(np.int64)
        u, v = np.clip(at, 0, np.array(view.camera.size_px) - 1).T
        on = np.abs(view.undeflected.depth_m[v, u] - away) < _ON_MESH_M
        return np.asarray(wanted & on & ~meets_centerbody(view, rays / away[:, None]))
    visible = wanted.copy()
    share = np.linspace(0.04, 0.97, 80)[:, None, None]
    way = points[visible] + share * (eye - points[visible])
    station, radius = torus_circles(view.geometry)
    s, r = -way[..., 0], np.hypot(way[..., 1], way[..., 2])
    clear = np.ones(int(visible.sum()), dtype=np.bool_)
    for s_i, r_i in zip(station, radius, strict=True):
        # what is looked at may lie on the very limb
        clear &= (np.hypot(s - s_i, r - r_i) > view.geometry.torus_minor_radius_m - _GRAZING_M).all(axis=0)
    clear &= (r > view.skin_m).all(axis=0)
    visible[visible] = clear
    return np.asarray(visible)


def fit_feature_map(
    image: Image, pixels: Pixels, starts: list[FloatArray], sd: FloatArray, signs: FloatArray
) -> FloatArray | None:
    """Parameters ``(k,)`` at which the features fit a frame best; None where no maximum is significant.

    Parameters
    ----------
    image : (h, w) uint8
    pixels : callable
    starts : list of (k,) float
        Where to search, each the mean of a normal distribution; the best of all is taken.
    sd : (k,) float
    signs : (n,) float
        Of the features: 1 where darker, -1 where paler than what is beside them.
    """
    hat = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_HAT_PX, _HAT_PX))
    smooth = cv2.GaussianBlur(image, (0, 0), 1.2)
    hats = [cv2.morphologyEx(smooth, kind, hat).astype(np.float32) for kind in (cv2.MORPH_BLACKHAT, cv2.MORPH_TOPHAT)]
    # all features weigh alike, however dark: deep shadows between tori must not outweigh them
    hats = [np.minimum(picture, _DARKEST) for picture in hats]
    pale = (signs < 0.0).astype(np.int64)
    blurred = [np.stack([cv2.GaussianBlur(picture, (0, 0), blur) for picture in hats]) for blur in _BLURS_PX]
    maps = [_Map(pictures, pictures.mean(axis=(1, 2)).astype(float), pale) for pictures in blurred]
    rng = np.random.default_rng(0)
    found = []
    for start in starts:
        centre, spread = start.copy(), sd.copy()
        for one in maps:
            drawn = centre + spread * rng.standard_normal((_DRAWS, len(sd)))
            drawn[0] = centre
            # not beyond the prior, where all features may come together on one dark spot
            drawn = np.clip(drawn, start - _FARTHEST_SD * sd, start + _FARTHEST_SD * sd)
            best = drawn[np.argsort(-one.scores(pixels(drawn)))[:_ELITE]]
            centre, spread = best.mean(axis=0), np.maximum(best.std(axis=0), _NARROWEST * sd)
        found.append((float(maps[-1].scores(pixels(centre[None]))[0]), centre))
    highest, where = max(found, key=lambda pair: pair[0])
    others = maps[-1].scores(pixels(starts[0] + sd * rng.standard_normal((_OTHERS, len(sd)))))
    usual = float(np.median(others))
    scatter = NORMAL_MAD * float(np.median(np.abs(others - usual)))
    return where if highest - usual > _LEAST_RISE * scatter else None


@dataclass(frozen=True)
class _Map:
    """Darkness and brightness of each pixel against its surroundings, (2, h, w), and which of both each feature has."""

    pictures: NDArray[np.float32]
    means: FloatArray
    which: NDArray[np.int64]

    def scores(self, pixels: FloatArray) -> FloatArray:
        """Means (m,) over features at pixels (m, n, 2); those outside the picture count as its mean."""
        h, w = self.pictures.shape[1:]
        u, v = np.moveaxis(np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(int), -1, 0)
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        # in one look-up, those outside at any pixel
        seen = self.pictures[self.which, np.where(inside, v, 0), np.where(inside, u, 0)]
        outside = self.means[self.which]
        totals = [dark[here].sum() + outside[~here].sum() for dark, here in zip(seen, inside, strict=True)]
        return np.array(totals, dtype=float) / pixels.shape[1]

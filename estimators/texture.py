"""Where has the shell's own surface texture moved between the benchmark frame and another frame?

Patches of the benchmark frame's picture are the templates. A pixel of the oriented camera looks at one point of the
undeflected shell (sphere tracing against the tori), and a patch, small and on one torus, is a piece of the plane that
touches the shell there. For a deflection, the plane's points say how the patch appears: the frame is sampled through
that affine map, and the template is searched in it by normalised cross correlation,

    rho(e) = <T, S(e)> / (|T| |S(e)|),

with the mean of every row removed, and rows run along the shell's ring: what is the same along a ring may be the
light's, whose bright ridges and valleys lie along the tori and move with the Sun by pixels. A change of exposure, of
contrast or of a shadow's depth leaves it as it is. The highest correlation, refined by a parabola in two dimensions, is
the patch's place. Its covariance is that of a fit of the template to itself in the noise that the correlation shows,

    cov(e) = (1 - rho^2) / (rho^2 N) (-rho'' / rho)^-1,      N independent samples of the patch,

which is large along a line, the aperture's problem, and small across it. Both pictures are band-passed before: shades
of light go, and noise finer than the lens's blur.

Patches across the limb of a torus or the centerbody are not taken, nor those across a step of light along the ring,
such as the edge of the centerbody's shadow, which stays with the Sun.

Assumed: what else of light is in a patch, wrinkles that cast shades, finds nothing in another frame or disagrees with
the rest, and Huber's weights see to it.

References
----------
B. D. Lucas, T. Kanade, "An iterative image registration technique", 1981. J. P. Lewis, "Fast normalized
cross-correlation", 1995. J. Shi, C. Tomasi, "Good features to track", 1994. J. Immerkaer, "Fast noise variance
estimation", 1996.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from estimators.features import ImageFeatures
from estimators.virtual_camera import VirtualCamera, meets_centerbody
from flightmodel._kernels import inlined, kernel
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.geometry import circumferential, torus_circles
from flightmodel.rendering import Rendered, against, face_normals
from flightmodel.statistics import NORMAL_MAD

Image = NDArray[np.uint8]
Picture = NDArray[np.float32]

HALF_PX = 7  # of a patch: at most a third of a torus as a camera on the centerbody sees it
_FINE_PX, _COARSE_PX = 0.8, 2.0  # of the band-pass: the lens's blur, and less than the patch
_WINDOWS = [cv2.getGaussianKernel(2 * math.ceil(3.0 * sd) + 1, sd) for sd in (_FINE_PX, _COARSE_PX)]
_CELL_PX = 12  # one patch at the most in a square of this size, so that they spread over the shell
# the same beside painted features: a sixth of the patches measures within a hundredth of a degree of all
BESIDE_PAINT_PX = 48
_STEP_M = 0.002  # along the touching plane, for the affine map
# two templates of pure noise, of 26 independent samples, correlate so highly once in 10,000 places
_LEAST_CORRELATION = 0.7
_QUIET, _ABOVE_NOISE, _LEAST_GREY = 0.1, 3.0, 0.3  # quantile of plain cloth; a mark over its noise; rounding
_BAND = 0.275  # of white noise that passes the band: root of (1/a^2 + 1/b^2 - 4/(a^2 + b^2)) / 4 pi of both blurs
_LEAST_FACING = 0.3  # as of features
_INDEPENDENT_PX = 4.0 * np.pi * _FINE_PX**2  # area over which the band-pass correlates noise
_SD_FLOOR_PX = 0.05  # as of the edge
_LINE = 3.0  # so much less sharp along a line than across it, a patch is found where it is looked for, or by its shades
_TRACE_STEPS, _TRACED_M = 80, 5e-4  # of a ray to the surface: a sixth of a pixel at 310 px a radian and 1 m
# of a mesh: a slope of 70 deg changes the distance over eight pixels by 7 % at 310 px; normals of a patch on one torus
# differ by less than one
_STEP_IN_DEPTH, _VALLEY = 0.1, 1.0
_BORDER_PX = 12
# brightest over darkest along the ring at a shadow's edge: another renderer's cloth is 5 times as bright in the Sun as
# in the shade, its paints differ by 1.8. Where most patches show more it is the paint
_SHADOW, _MOST = 3.0, 0.5
_GRID_PX = 4  # between rays: tori are tens of pixels wide
_ALONG_PX = np.arange(-6, 7, 3)  # along a ring over a patch; the band-pass leaves little finer than their step


@dataclass(frozen=True)
class SurfacePoints:
    """Points (n, 3) of the undeflected shell that pixels look at, m; their outward normals; torus, -1 for none."""

    points_shell_m: FloatArray
    normals: FloatArray
    torus: NDArray[np.int64]


def surface_seen(view: VirtualCamera, pixels: FloatArray) -> SurfacePoints:
    """Points of the undeflected shell that pixels ``(n, 2)`` look at.

    Of a user's mesh on the face that is rendered there; of the tori by sphere tracing: the distance to them and to the
    centerbody bounds the next step along each ray.
    """
    if view.undeflected is not None:
        return _mesh_seen(view, view.undeflected, pixels)
    geometry, camera = view.geometry, view.camera
    rays = np.nan_to_num(camera.rays_body(pixels))
    station, radius = torus_circles(geometry)
    eye, minor = camera.position_body_m, geometry.torus_minor_radius_m
    along, n = np.full(len(rays), 0.02), len(rays)
    nearest, off = np.zeros(n, dtype=np.int64), np.full(n, np.inf)
    body = np.zeros(n, dtype=np.bool_)
    for _ in range(_TRACE_STEPS):
        p = eye + along[:, None] * rays
        r = np.hypot(p[:, 1], p[:, 2])
        to_tori = np.hypot(-p[:, :1] - station, r[:, None] - radius) - minor
        nearest = np.argmin(to_tori, axis=1)
        off = to_tori[np.arange(n), nearest]
        body |= r < view.skin_m
        along = along + np.where(body | (along > 10.0 * geometry.base_radius_m), 0.0, off)
    hit = ~body & (off < _TRACED_M) & np.isfinite(rays).all(axis=1) & (np.linalg.norm(rays, axis=1) > 0.5)
    p = eye + along[:, None] * rays
    r = np.hypot(p[:, 1], p[:, 2])
    aft, out = -p[:, 0] - station[nearest], r - radius[nearest]
    normal = np.column_stack([-aft, out * p[:, 1] / r, out * p[:, 2] / r]) / minor
    return SurfacePoints(p, normal, np.where(hit, nearest, -1))


def _mesh_seen(view: VirtualCamera, rendered: Rendered, pixels: FloatArray) -> SurfacePoints:
    """As `surface_seen` of a mesh, all of it as one torus; on the planes of its faces."""
    camera, mesh = view.camera, view.geometry.mesh
    assert mesh is not None
    rays = np.nan_to_num(camera.rays_body(pixels))
    u, v = np.rint(np.clip(pixels, 0, np.array(camera.size_px) - 1)).astype(np.int64).T
    face = rendered.face[v, u]
    normal = against(face_normals(mesh.vertices_m, mesh.faces[face]), rays)
    corner = mesh.vertices_m[mesh.faces[face, 0]] - camera.position_body_m
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.einsum("ni,ni->n", normal, corner) / np.einsum("ni,ni->n", normal, rays)
    hit = (face >= 0) & (along > 0.0) & np.isfinite(along) & ~meets_centerbody(view, rays)
    points = camera.position_body_m + np.where(hit, along, 0.0)[:, None] * rays
    return SurfacePoints(points, normal, np.where(hit, 0, -1))


def band_passed(image: Image) -> Picture:
    """Picture without shades and without noise finer than the lens's blur."""
    fine, coarse = (cv2.sepFilter2D(image, cv2.CV_32F, window, window) for window in _WINDOWS)
    return fine - coarse


@inlined
def correlations(picture, template, middle, affine, reach, score):
    """Correlation (2 reach + 1, 2 reach + 1), rows by v, of a template shifted in its own picture; False outside.

    ``affine`` (2, 2) maps offsets in the template's picture to this one, about ``middle`` (2,). The template (m, m) has
    mean zero and norm one.
    """
    size = len(template)
    half = size // 2 + reach
    wide = 2 * half + 1
    h, w = picture.shape
    window = np.empty((wide, wide))
    for i in range(wide):
        for j in range(wide):
            u = middle[0] + affine[0, 0] * (j - half) + affine[0, 1] * (i - half)
            v = middle[1] + affine[1, 0] * (j - half) + affine[1, 1] * (i - half)
            if not (u >= 0.0 and v >= 0.0 and u < w - 1.0 and v < h - 1.0):
                return False
            x, y = int(u), int(v)
            a, b = u - x, v - y
            upper = (1.0 - a) * picture[y, x] + a * picture[y, x + 1]
            window[i, j] = (1.0 - b) * upper + b * ((1.0 - a) * picture[y + 1, x] + a * picture[y + 1, x + 1])
    # sums over the patch: along rows, then of rows
    steps = 2 * reach + 1
    along = np.zeros((wide, steps, 2))
    for i in range(wide):
        for q in range(steps):
            for j in range(size):
                along[i, q, 0] += window[i, q + j]
                along[i, q, 1] += window[i, q + j] * window[i, q + j]
    for p in range(steps):
        for q in range(steps):
            spread, product = 0.0, 0.0
            for i in range(size):
                spread += along[p + i, q, 1] - along[p + i, q, 0] * along[p + i, q, 0] / size
                for j in range(size):
                    product += window[p + i, q + j] * template[i, j]
            score[p, q] = product / math.sqrt(spread) if spread > 1e-9 else 0.0
    return True


@kernel
def find_patches(picture, templates, middle, affine, across, limits, place, sd):
    """Place (n, 2) of each patch along its two directions and its sd, infinite where it was not found.

    ``across`` (n, 2, 2): unit vectors, one a row. ``limits``: reach, least correlation, independent samples of a patch.
    """
    reach, least, samples = limits
    wide = 2 * reach + 1
    score = np.empty((wide, wide))
    for k in range(len(templates)):
        place[k, 0] = place[k, 1] = 0.0
        sd[k, 0] = sd[k, 1] = np.inf
        if not correlations(picture, templates[k], middle[k], affine[k], reach, score):
            continue
        best = int(np.argmax(score))
        p, q = best // wide, best % wide
        if p < 1 or q < 1 or p > wide - 2 or q > wide - 2 or score[p, q] < least:
            continue
        # parabola through the nine highest: slope and curvature
        su, sv = 0.5 * (score[p, q + 1] - score[p, q - 1]), 0.5 * (score[p + 1, q] - score[p - 1, q])
        cuu = 2.0 * score[p, q] - score[p, q + 1] - score[p, q - 1]
        cvv = 2.0 * score[p, q] - score[p + 1, q] - score[p - 1, q]
        cuv = -0.25 * (score[p + 1, q + 1] - score[p + 1, q - 1] - score[p - 1, q + 1] + score[p - 1, q - 1])
        det = cuu * cvv - cuv * cuv
        if cuu <= 0.0 or det <= 1e-6:
            continue
        du, dv = (cvv * su - cuv * sv) / det, (cuu * sv - cuv * su) / det
        du, dv = min(max(du, -1.0), 1.0) + q - reach, min(max(dv, -1.0), 1.0) + p - reach
        rho = min(score[p, q], 0.999)
        noise = (1.0 - rho * rho) / (rho * samples * det)
        for r in range(2):
            # the direction in the template's picture
            mu = across[k, r, 0] * affine[k, 0, 0] + across[k, r, 1] * affine[k, 1, 0]
            mv = across[k, r, 0] * affine[k, 0, 1] + across[k, r, 1] * affine[k, 1, 1]
            place[k, r] = across[k, r, 0] * middle[k, 0] + across[k, r, 1] * middle[k, 1] + mu * du + mv * dv
            sd[k, r] = math.sqrt(noise * (cvv * mu * mu - 2.0 * cuv * mu * mv + cuu * mv * mv))


@dataclass(frozen=True)
class TrackedTexture:
    """Patches of the benchmark frame, two rows each: the directions in which a patch's place is sharp and less sharp.

    Parameters
    ----------
    points_shell_m : (2 n, 3) float
        Middle of each row's patch on the undeflected shell, from the datum.
    across_px : (2 n, 2) float
        Unit vectors in the picture.
    tangents_shell : (n, 2, 3) float
        Unit vectors along the shell.
    templates : (n, 15, 15) float
        Rows along the ring, each of mean zero; of norm one.
    to_tangents : (n, 2, 2) float
        From an offset in the template, along its rows and its columns, px, to metres along the tangents.
    """

    points_shell_m: FloatArray
    across_px: FloatArray
    tangents_shell: FloatArray = field(repr=False)
    templates: FloatArray = field(repr=False)
    to_tangents: FloatArray = field(repr=False)

    def find(
        self, view: VirtualCamera, image: Image, deformation: FloatArray, reach_px: int
    ) -> tuple[FloatArray, FloatArray]:
        """Place (2 n,) of each row along its direction, px, and its sd; infinite where the patch was not found.

        ``deformation`` (3,) predicts where it is looked for, within ``reach_px`` of the benchmark's picture.
        """
        middle, affine = self._predicted(view, deformation)
        place, sd = np.zeros((len(middle), 2)), np.full((len(middle), 2), np.inf)
        samples = (2 * HALF_PX + 1) ** 2 / _INDEPENDENT_PX
        limits = (reach_px, _LEAST_CORRELATION, samples)
        across = self.across_px.reshape(-1, 2, 2)
        find_patches(band_passed(image), self.templates, middle, affine, across, limits, place, sd)
        sd[sd[:, 1] > _LINE * sd[:, 0], 1] = np.inf
        return place.ravel(), np.hypot(sd.ravel(), _SD_FLOOR_PX)

    def _predicted(self, view: VirtualCamera, deformation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Middle (n, 2) of each patch in the frame, and the map (n, 2, 2) from offsets in the template."""
        points = self.points_shell_m[::2]
        n = len(points)
        beside = (points[:, None] + _STEP_M * self.tangents_shell).reshape(-1, 3)
        pixels = view.sight(np.concatenate([points, beside]), deformation).pixels
        middle = pixels[:n]
        per_m = (pixels[n:].reshape(n, 2, 2) - middle[:, None]).transpose(0, 2, 1) / _STEP_M
        return middle, per_m @ self.to_tangents


@dataclass(frozen=True)
class PaintedTexture:
    """Painted features, which are found from far, and behind them the texture, which measures where it agrees.

    A mark's place on the shell is known to millimetres, and its shades are its own; a patch is compared with itself.

    Parameters
    ----------
    painted : ImageFeatures
    texture : TrackedTexture
    """

    painted: ImageFeatures
    texture: TrackedTexture

    @cached_property
    def points_shell_m(self) -> FloatArray:
        """See `Features`."""
        return np.concatenate([self.painted.points_shell_m, self.texture.points_shell_m])

    @cached_property
    def across_px(self) -> FloatArray:
        """See `Features`."""
        return np.concatenate([self.painted.across_px, self.texture.across_px])

    def find(
        self, view: VirtualCamera, image: Image, deformation: FloatArray, reach_px: int
    ) -> tuple[FloatArray, FloatArray]:
        """See `Features.find`; the painted ones alone, the texture is looked for near their answer."""
        place, sd = self.painted.find(view, image, deformation, reach_px)
        more = len(self.texture.across_px)
        return np.append(place, np.zeros(more)), np.append(sd, np.full(more, np.inf))


def texture_of(view: VirtualCamera, benchmark: Image, cell_px: int = _CELL_PX) -> TrackedTexture:
    """Textured patches of the shell in a benchmark frame, spread over the part in view.

    Parameters
    ----------
    view : VirtualCamera
        As oriented on this frame.
    benchmark : (h, w) uint8
    cell_px : int
        Side of the squares of which each has one patch at the most.
    """
    picture = band_passed(benchmark)
    grid = _Grid.of(view, benchmark.shape)
    pixels = _spread_corners(benchmark, grid.without_rings(view, picture), grid.on_one_torus(view), cell_px)
    seen = surface_seen(view, pixels.astype(float))
    good = (seen.torus >= 0) & (seen.normals[:, 0] < 0.0)
    pixels, points, normals = pixels[good], seen.points_shell_m[good], seen.normals[good]
    towards = view.camera.position_body_m - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = np.einsum("ni,ni->n", towards, normals) > _LEAST_FACING
    pixels, points, normals = pixels[facing], points[facing], normals[facing]
    along = _ring_directions(view, points)
    axes = np.stack([along, np.column_stack([-along[:, 1], along[:, 0]])], axis=2)
    lit = ~_across_shadow(_patches(benchmark, pixels, axes))
    pixels, points, normals, axes = pixels[lit], points[lit], normals[lit], axes[lit]
    templates = _patches(picture, pixels, axes)
    templates -= templates.mean(axis=2, keepdims=True)
    templates /= np.maximum(np.linalg.norm(templates, axis=(1, 2), keepdims=True), 1e-12)
    across = np.array([_sharp_directions(t) @ own.T for t, own in zip(templates, axes, strict=True)]).reshape(-1, 2)
    round_shell = circumferential(points)
    tangents = np.stack([round_shell, np.cross(normals, round_shell)], axis=1)
    unit = np.tile(np.eye(2), (len(points), 1, 1))
    texture = TrackedTexture(np.repeat(points, 2, axis=0), across, tangents, templates, unit)
    _, per_m = texture._predicted(view, np.zeros(3))
    return replace(texture, to_tangents=np.asarray(np.linalg.inv(per_m) @ axes, dtype=float))


def _patches(picture: NDArray[np.generic], pixels: NDArray[np.int64], axes: FloatArray) -> FloatArray:
    """Grey (n, 15, 15) about pixels (n, 2): rows along the first column of axes (n, 2, 2), columns along the other."""
    around = np.arange(-HALF_PX, HALF_PX + 1)
    column, row = np.meshgrid(around, around)
    at = pixels[:, :, None, None] + axes[:, :, :1, None] * column + axes[:, :, 1:, None] * row
    return np.asarray(map_coordinates(picture, at.transpose(1, 0, 2, 3)[::-1], output=float, order=1))


def _across_shadow(patches: FloatArray) -> BoolArray:
    """Mask of patches (n, 15, 15) across a shadow's edge; none if most patches are, as then the steps are painted."""
    along = np.maximum(patches.mean(axis=1), 1.0)
    steps = along.max(axis=1, initial=1.0) > _SHADOW * along.min(axis=1, initial=np.inf)
    return steps & (float(steps.mean() if len(steps) else 0.0) < _MOST)


def _ring_directions(view: VirtualCamera, points: FloatArray) -> FloatArray:
    """Unit vectors (n, 2) in the benchmark's picture along the shell's rings at points (n, 3) of it."""
    step = _STEP_M * circumferential(points)
    ends = [view.sight(points + side * step, np.zeros(3)).pixels for side in (-1.0, 1.0)]
    along = ends[1] - ends[0]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


@dataclass(frozen=True)
class _Grid:
    """Shell points seen by a grid of pixels (a, b) of a picture (h, w)."""

    shape: tuple[int, int]
    steps: tuple[int, int]
    seen: SurfacePoints

    @staticmethod
    def of(view: VirtualCamera, shape: tuple[int, ...]) -> _Grid:
        h, w = shape
        u, v = np.meshgrid(np.arange(0, w, _GRID_PX), np.arange(0, h, _GRID_PX))
        return _Grid((h, w), u.shape, surface_seen(view, np.column_stack([u.ravel(), v.ravel()]).astype(float)))

    def without_rings(self, view: VirtualCamera, picture: Picture) -> Picture:
        """Picture less its mean along the rings over a patch, which may be the light's."""
        along, hit = np.zeros((len(self.seen.torus), 2)), self.seen.torus >= 0
        along[hit] = np.nan_to_num(_ring_directions(view, self.seen.points_shell_m[hit]))
        h, w = self.shape
        ring = cv2.resize(along.reshape(*self.steps, 2).astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
        at = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).astype(np.float32)
        parts = [cv2.remap(picture, at + np.float32(k) * ring, None, cv2.INTER_LINEAR) for k in _ALONG_PX]
        return np.asarray(picture - np.mean(parts, axis=0), dtype=np.float32)

    def on_one_torus(self, view: VirtualCamera) -> BoolArray:
        """Mask (h, w) of pixels round which a whole patch shows one torus of the undeflected shell, or one face of a

        mesh's relief: no step in depth, and no valley, across which the normals differ.
        """
        h, w = self.shape
        torus = self.seen.torus.reshape(self.steps).astype(np.float32)
        about = np.ones((2 * (-(-HALF_PX // _GRID_PX)) + 1,) * 2, np.uint8)
        same = (cv2.erode(torus, about) == cv2.dilate(torus, about)) & (torus >= 0.0)
        if view.undeflected is not None:
            away = np.linalg.norm(self.seen.points_shell_m - view.camera.position_body_m, axis=1).reshape(self.steps)
            whole = _spread(away, np.ones((3, 3), np.uint8)) < _STEP_IN_DEPTH * away
            same &= cv2.erode(whole.astype(np.uint8), about) > 0
            for part in self.seen.normals.T:
                same &= _spread(part.reshape(self.steps), about) < _VALLEY
        mask = cv2.resize(same.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST)
        margin = HALF_PX + _BORDER_PX
        out = np.zeros(self.shape, dtype=np.bool_)
        out[margin:-margin, margin:-margin] = mask[margin:-margin, margin:-margin] > 0
        return out


def _spread(picture: FloatArray, about: NDArray[np.uint8]) -> FloatArray:
    """Largest less smallest value (h, w) about each place."""
    grey = picture.astype(np.float32)
    return np.asarray(cv2.dilate(grey, about) - cv2.erode(grey, about), dtype=float)


def _spread_corners(image: Image, picture: Picture, mask: BoolArray, cell_px: int) -> NDArray[np.int64]:
    """Pixels (n, 2) of the strongest corner in every cell of a grid, where there is one to be seen."""
    if not mask.any():
        return np.zeros((0, 2), dtype=np.int64)
    size = 2 * HALF_PX + 1
    level = np.sqrt(np.maximum(cv2.blur(picture**2, (size, size)), 0.0))
    # the quietest places show what the recording alone makes of a smooth surface, where there is one
    quietest = float(np.quantile(level[mask], _QUIET))
    noise = max(min(quietest, _BAND * noise_of(image)), _LEAST_GREY)
    strength = np.where(mask & (level > _ABOVE_NOISE * noise), cv2.cornerMinEigenVal(picture, size, 3), -1.0)
    chosen = []
    for top in range(0, mask.shape[0], cell_px):
        for left in range(0, mask.shape[1], cell_px):
            cell = strength[top : top + cell_px, left : left + cell_px]
            v, u = np.unravel_index(int(np.argmax(cell)), cell.shape)
            if cell[v, u] > 0.0:
                chosen.append((left + u, top + v))
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def noise_of(image: Image) -> float:
    """Rms of a picture's noise from pixel to pixel, grey levels, by a mask that is blind to slopes and bends."""
    second = cv2.filter2D(image.astype(np.float32), cv2.CV_32F, np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32))
    return NORMAL_MAD * float(np.median(np.abs(second))) / 6.0


def _sharp_directions(template: FloatArray) -> FloatArray:
    """Unit vectors (2, 2) of a patch's structure tensor along its rows and columns, the sharper first."""
    gv, gu = np.gradient(template)
    tensor = np.array([[np.sum(gu * gu), np.sum(gu * gv)], [np.sum(gu * gv), np.sum(gv * gv)]])
    return np.asarray(np.linalg.eigh(tensor)[1].T[::-1])

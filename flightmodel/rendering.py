"""What does a camera see of triangles?

They are filled through the lens with a depth buffer. A straight edge in space is straight in the picture only over a
small triangle, so larger ones are split until they span less than `WIDEST_RAD` as seen from the camera; that also
follows those that reach beyond the lens's field or behind the camera.

Assumed: opaque triangles; the lens of `flightmodel.camera`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flightmodel import _raster_kernels
from flightmodel.camera import Camera
from flightmodel.checks import BoolArray, FloatArray

WIDEST_RAD, _MARGIN_RAD = float(np.deg2rad(5.0)), float(np.deg2rad(0.5))
_DEEPEST_SPLIT = 20


@dataclass(frozen=True)
class Rendered:
    """A picture of distances.

    Parameters
    ----------
    depth_m : (h, w) float
        Distance from the camera along each pixel's ray; infinite where nothing is met.
    face : (h, w) int
        Index of the face seen; -1 where there is none.
    """

    depth_m: FloatArray
    face: NDArray[np.int64]

    @property
    def is_hit(self) -> BoolArray:
        """Mask ``(h, w)`` of pixels that show the scene."""
        return np.asarray(self.face >= 0)


def face_normals(vertices_m: FloatArray, faces: NDArray[np.int64]) -> FloatArray:
    """Unit normals ``(m, 3)`` of faces, as they are wound."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300))


def against(normals: FloatArray, rays: FloatArray) -> FloatArray:
    """Normals ``(n, 3)`` turned to where rays ``(n, 3)`` come from."""
    return np.asarray(normals * np.where(np.einsum("ni,ni->n", normals, rays) > 0.0, -1.0, 1.0)[:, None])


def render(camera: Camera, vertices_body_m: FloatArray, faces: NDArray[np.int64]) -> Rendered:
    """Render triangles.

    Parameters
    ----------
    camera : Camera
    vertices_body_m : (n, 3) float
        From the datum, body axes.
    faces : (m, 3) int
        Indices of vertices.

    Returns
    -------
    Rendered
        ``face`` counts the given faces, whatever was split.
    """
    shape = (camera.height_px, camera.width_px)
    depth, nearest = np.full(shape, np.inf), np.full(shape, -1, dtype=np.int64)
    _raster_kernels.raster(
        np.ascontiguousarray(vertices_body_m, dtype=float), np.ascontiguousarray(faces, dtype=np.int64),
        camera.lens_terms, camera.picture_half_angle_rad + _MARGIN_RAD, WIDEST_RAD, _DEEPEST_SPLIT, depth, nearest,
    )  # fmt: skip
    return Rendered(depth, nearest)

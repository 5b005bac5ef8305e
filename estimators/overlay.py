"""How would the real camera see the estimated deflection? Pictures to compare by eye (seed paper Figure 2.3).

The virtual camera's view is drawn beside and over the filmed frame: the shell deflected as estimated, shaded by how it
faces the camera, ``grey = 60 + 150 |n . v|``, with the mesh's lines on it; where the centerbody hides it, it is not
drawn. A user's own meshes of either body take the place of the parametric ones. Yellow is the smallest row of the
virtual edge, the seed paper's horizon line.

Assumed: as in `estimators.virtual_camera`; a mesh of the centerbody is drawn only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.virtual_camera import VirtualCamera, deformation_of, meets_centerbody
from flightmodel.camera import Camera
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.deflection import lv_clock
from flightmodel.geometry import BodyMesh, bend, outboard, vehicle_meshes
from flightmodel.rendering import face_normals, render

Picture = NDArray[np.uint8]

YELLOW, GREY, _BLACK, _WHITE = (255, 230, 0), (170, 170, 170), (0, 0, 0), (255, 255, 255)
_COLOUR, _BODY_COLOUR = np.array([0.45, 0.75, 1.0]), np.array([0.95, 0.85, 0.65])
_LINE_SHARE = 90.0
_SHARE = 0.65
_ROWS = 32  # of a picture, looked along at a time
_TORUS_SECTIONS = 20
_SMOOTH_RAD = float(np.deg2rad(15.0))  # faces of a user's mesh that meet at less are one piece


@dataclass(frozen=True)
class _Drawing:
    """Triangles of one body, the piece of it that each belongs to, and its colour."""

    vertices_m: FloatArray
    faces: NDArray[np.int64]
    piece: NDArray[np.int64]
    colour: FloatArray

    def rendered(self, camera: Camera, vertices_m: FloatArray) -> tuple[FloatArray, Picture]:
        """Depth ``(h, w)``, m, and picture ``(h, w, 3)``, RGB, with the vertices where they are now, body axes."""
        view = render(camera, vertices_m, self.faces)
        away = vertices_m[self.faces].mean(axis=1) - camera.position_body_m
        along = np.abs(np.einsum("ni,ni->n", face_normals(vertices_m, self.faces), away))
        facing = along / np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        tone = ((60.0 + 150.0 * facing)[:, None] * self.colour).astype(np.uint8)
        picture = np.zeros((*view.face.shape, 3), dtype=np.uint8)
        picture[view.is_hit] = tone[view.face[view.is_hit]]
        # a line where the piece changes to the right or below
        piece = np.where(view.is_hit, self.piece[view.face], -1)
        line = np.zeros_like(view.is_hit)
        line[:, 1:] |= piece[:, 1:] != piece[:, :-1]
        line[1:] |= piece[1:] != piece[:-1]
        picture[line & view.is_hit] = _LINE_SHARE * self.colour
        return view.depth_m, picture


@dataclass
class Overlay:
    """Draws the bodies of one virtual camera; holds their meshes.

    Parameters
    ----------
    view : VirtualCamera
    meshes : mapping of str to BodyMesh
        A user's own, of ``aeroshell`` or ``centerbody``, drawn in place of the stacked tori and of the centerbody,
        which is not drawn otherwise. The shell's edge (`horizon_row`) stays that of the fit.
    """

    view: VirtualCamera
    meshes: Mapping[str, BodyMesh] = field(default_factory=dict)
    shell: _Drawing = field(init=False, repr=False)
    before_m: FloatArray = field(init=False, repr=False)
    body: Picture = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the shell's mesh; render the centerbody and its distance in each pixel."""
        self.shell = _drawing(self.meshes["aeroshell"]) if "aeroshell" in self.meshes else _stacked(self.view)
        camera = self.view.camera
        self.body = np.zeros((camera.height_px, camera.width_px, 3), dtype=np.uint8)
        if "centerbody" in self.meshes:
            drawing = _drawing(self.meshes["centerbody"], _BODY_COLOUR)
            clear = replace(camera, position_body_m=outboard(camera.position_body_m))
            self.before_m, self.body = drawing.rendered(clear, drawing.vertices_m)
        else:
            self.before_m = np.where(centerbody_pixels(self.view), 0.0, np.inf)

    def view_of(self, theta_rad: float, plane_lv_rad: float) -> tuple[Picture, BoolArray]:
        """Virtual picture ``(h, w, 3)`` RGB of the bodies, black elsewhere, and where they are in it ``(h, w)``."""
        deflected = bend(self.shell.vertices_m, theta_rad, plane_lv_rad, self.view.joint_station_m)
        depth, picture = self.shell.rendered(self.view.camera, deflected)
        shell = depth < self.before_m
        picture = np.where(shell[..., None], picture, self.body)
        return picture, np.asarray(shell | self.body.any(axis=2))

    def blended(self, image: Picture, theta_rad: float, plane_lv_rad: float, from_column: int | None = None) -> Picture:
        """Virtual view over the right part of a grey frame ``(h, w)``; RGB ``(h, w, 3)``."""
        out = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        left = image.shape[1] // 2 if from_column is None else from_column
        picture, shell = self.view_of(theta_rad, plane_lv_rad)
        shell[:, :left] = False
        out[shell] = ((1.0 - _SHARE) * out[shell] + _SHARE * picture[shell]).astype(np.uint8)
        cv2.line(out, (left, 0), (left, image.shape[0] - 1), (90, 90, 90), 1)
        return out

    def side_by_side(self, image: Picture, theta_rad: float, plane_lv_rad: float) -> Picture:
        """Frame, virtual view, and one over the other, with the horizon line through all three; RGB ``(h, 3 w, 3)``."""
        picture, _ = self.view_of(theta_rad, plane_lv_rad)
        frame = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        out = np.concatenate([frame, picture, self.blended(image, theta_rad, plane_lv_rad, 0)], axis=1)
        draw_row(out, horizon_row(self.view, theta_rad, plane_lv_rad), YELLOW)
        return out


def _stacked(view: VirtualCamera) -> _Drawing:
    """Stacked tori and forward skin; two triangles make one piece."""
    meshes = vehicle_meshes(view.geometry, clock_sections=72, torus_sections=_TORUS_SECTIONS)
    meshes.pop("centerbody")
    vertices, faces, count = [], [], 0
    for mesh in meshes.values():
        vertices.append(np.asarray(mesh.vertices))
        faces.append(np.asarray(mesh.faces) + count)
        count += len(mesh.vertices)
    triangles = np.concatenate(faces)
    return _Drawing(np.concatenate(vertices), triangles, np.arange(len(triangles)) // 2, _COLOUR)


def _drawing(mesh: BodyMesh, colour: FloatArray = _COLOUR) -> _Drawing:
    """A user's mesh; faces that go over into each other smoothly are one piece."""
    import trimesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    smooth = solid.face_adjacency[solid.face_adjacency_angles < _SMOOTH_RAD]
    n = len(mesh.faces)
    graph = coo_array((np.ones(len(smooth)), (smooth[:, 0], smooth[:, 1])), shape=(n, n))
    _, piece = connected_components(graph, directed=False)
    return _Drawing(mesh.vertices_m, mesh.faces, piece.astype(np.int64), colour)


def centerbody_pixels(view: VirtualCamera) -> BoolArray:
    """Pixels ``(h, w)`` whose rays meet the centerbody."""
    v, u = np.indices((view.camera.height_px, view.camera.width_px), dtype=float)
    pixels = np.column_stack([u.ravel(), v.ravel()])
    # some rows at a time: the inverse of the lens takes ten arrays as large as its pixels
    parts = np.array_split(pixels, max(1, view.camera.height_px // _ROWS))
    met = [meets_centerbody(view, np.nan_to_num(view.camera.rays_body(part))) for part in parts]
    return np.concatenate(met).reshape(v.shape)


def horizon_row(view: VirtualCamera, theta_rad: float, plane_lv_rad: float) -> int:
    """Smallest row of the virtual camera's shell edge, px."""
    edge = view.edge(deformation_of(theta_rad, plane_lv_rad)).pixels
    return round(float(edge[view.camera.is_inside(edge), 1].min()))


def draw_outline(picture: Picture, view: VirtualCamera, theta_yz_rad: FloatArray, colour: tuple[int, int, int]) -> None:
    """Draw the shell's edge at a lateral deflection (2,), rad, as a line."""
    size, plane = float(np.hypot(*theta_yz_rad)), float(lv_clock(theta_yz_rad))
    edge = view.edge(deformation_of(size, plane)).pixels
    seen = view.camera.is_inside(edge)
    for a, b in pairwise(range(len(edge))):
        if seen[a] and seen[b]:
            first, last = ((round(float(edge[k, 0])), round(float(edge[k, 1]))) for k in (a, b))
            cv2.line(picture, first, last, colour, 1, cv2.LINE_AA)


def draw_row(picture: Picture, row: int, colour: tuple[int, int, int]) -> None:
    """Draw a horizontal line two pixels high."""
    picture[max(row - 1, 0) : row + 1] = colour


def write_lines(picture: Picture, lines: list[str]) -> None:
    """Write lines of text into the upper left corner, black behind white."""
    around = [(_BLACK, dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]  # OpenCV 5 spaces bold letters further apart
    for k, text in enumerate(lines):
        for colour, dx, dy in (*around, (_WHITE, 0, 0)):
            at = (10 + dx, 22 + 20 * k + dy)
            cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)

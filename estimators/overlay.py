"""Pictures for the eye: the virtual camera's view beside and over what the real one filmed (seed paper Figure 2.3).

The shell is rendered bent as the estimate says, shaded by how it faces the camera, with the mesh's lines on it; where
the centerbody covers it, it is not drawn. Yellow is the smallest row of the virtual edge, the
seed paper's horizon line.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.raster import Rendered, render
from estimators.virtual_camera import VirtualCamera, bending_of
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.geometry import bend, vehicle_meshes

Picture = NDArray[np.uint8]

YELLOW, GREY, BLACK, WHITE = (255, 230, 0), (170, 170, 170), (0, 0, 0), (255, 255, 255)
COLOUR = np.array([0.45, 0.75, 1.0])
LINE_COLOUR = np.array([25, 70, 130], dtype=np.uint8)
SHARE = 0.65
TORUS_SECTIONS = 20


@dataclass
class Overlay:
    """Draws the shell of one virtual camera; holds its mesh.

    Parameters
    ----------
    view : VirtualCamera
    """

    view: VirtualCamera
    shell_m: FloatArray = field(init=False, repr=False)
    faces: NDArray[np.int64] = field(init=False, repr=False)
    clear: BoolArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the shell's mesh; find the pixels that the centerbody leaves free."""
        meshes = vehicle_meshes(self.view.geometry, clock_sections=72, torus_sections=TORUS_SECTIONS)
        meshes.pop("centerbody")
        vertices, faces, count = [], [], 0
        for mesh in meshes.values():
            vertices.append(np.asarray(mesh.vertices))
            faces.append(np.asarray(mesh.faces) + count)
            count += len(mesh.vertices)
        self.shell_m, self.faces = np.concatenate(vertices), np.concatenate(faces)
        self.clear = ~centerbody_pixels(self.view)

    def rendered(self, theta_rad: float, plane_lv_rad: float) -> tuple[Rendered, FloatArray]:
        """Render the shell bent, and return its vertices, body axes, m."""
        bent = bend(self.shell_m, theta_rad, plane_lv_rad, self.view.joint_station_m)
        return render(self.view.camera, bent, self.faces), bent

    def view_of(self, theta_rad: float, plane_lv_rad: float) -> tuple[Picture, BoolArray]:
        """Virtual picture ``(h, w, 3)`` RGB of the shell, black elsewhere, and where the shell is in it ``(h, w)``."""
        seen, vertices = self.rendered(theta_rad, plane_lv_rad)
        corners = vertices[self.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        away = corners.mean(axis=1) - self.view.camera.position_body_m
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(away, axis=1)
        facing = np.abs(np.einsum("ni,ni->n", normal, away)) / np.maximum(length, 1e-12)
        shell = seen.is_hit & self.clear
        tone = (60.0 + 150.0 * facing)[:, None] * COLOUR
        picture = np.zeros((*shell.shape, 3), dtype=np.uint8)
        picture[shell] = tone[seen.face[shell]].astype(np.uint8)
        # two triangles make one piece of the mesh: a line where the piece changes to the right or below
        piece = seen.face // 2
        line = np.zeros_like(shell)
        line[:, 1:] |= piece[:, 1:] != piece[:, :-1]
        line[1:] |= piece[1:] != piece[:-1]
        picture[line & shell] = LINE_COLOUR
        return picture, np.asarray(shell)

    def blended(self, image: Picture, theta_rad: float, plane_lv_rad: float, from_column: int | None = None) -> Picture:
        """Virtual view over the right part of a grey frame ``(h, w)``; RGB ``(h, w, 3)``."""
        out = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        left = image.shape[1] // 2 if from_column is None else from_column
        picture, shell = self.view_of(theta_rad, plane_lv_rad)
        shell[:, :left] = False
        out[shell] = ((1.0 - SHARE) * out[shell] + SHARE * picture[shell]).astype(np.uint8)
        cv2.line(out, (left, 0), (left, image.shape[0] - 1), (90, 90, 90), 1)
        return out

    def side_by_side(self, image: Picture, theta_rad: float, plane_lv_rad: float) -> Picture:
        """Frame, virtual view, and one over the other, with the horizon line through all three; RGB ``(h, 3 w, 3)``."""
        picture, _ = self.view_of(theta_rad, plane_lv_rad)
        frame = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        out = np.concatenate([frame, picture, self.blended(image, theta_rad, plane_lv_rad, 0)], axis=1)
        draw_row(out, horizon_row(self.view, theta_rad, plane_lv_rad), YELLOW)
        return out


def centerbody_pixels(view: VirtualCamera) -> BoolArray:
    """Pixels ``(h, w)`` whose rays meet the centerbody, a cylinder on whose skin the camera sits."""
    camera = view.camera
    v, u = np.indices((camera.height_px, camera.width_px), dtype=float)
    rays = np.nan_to_num(camera.rays_body(np.column_stack([u.ravel(), v.ravel()])))
    x, y, z = camera.position_body_m
    across, inward = np.maximum(rays[:, 1] ** 2 + rays[:, 2] ** 2, 1e-12), -(y * rays[:, 1] + z * rays[:, 2])
    excess = y**2 + z**2 - min(view.geometry.centerbody_radius_m, float(np.hypot(y, z)) - 1e-3) ** 2
    square = inward**2 - across * excess
    station = -x - rays[:, 0] * (inward - np.sqrt(np.maximum(square, 0.0))) / across
    met = (square > 0.0) & (inward > 0.0) & (station > 0.0) & (station < view.geometry.centerbody_length_m)
    return np.asarray(met.reshape(v.shape))


def horizon_row(view: VirtualCamera, theta_rad: float, plane_lv_rad: float) -> int:
    """Smallest row of the virtual camera's shell edge, px."""
    edge = view.edge(bending_of(theta_rad, plane_lv_rad)).pixels
    return round(float(edge[view.camera.is_inside(edge), 1].min()))


def draw_row(picture: Picture, row: int, colour: tuple[int, int, int]) -> None:
    """Draw a horizontal line two pixels high."""
    picture[max(row - 1, 0) : row + 1] = colour


def write_words(picture: Picture, lines: list[str]) -> None:
    """Write lines of text into the upper left corner, black behind white."""
    for k, words in enumerate(lines):
        at = (10, 22 + 20 * k)
        cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, BLACK, 3, cv2.LINE_AA)
        cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, WHITE, 1, cv2.LINE_AA)

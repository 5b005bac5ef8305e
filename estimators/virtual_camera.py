"""What would the camera see if the shell were deflected by this much?

The shell's edge against the sky is the limb of the outermost torus, or of the user's mesh, a closed-form curve of the
deformed geometry; it is projected, never rendered, and so are the features painted on the shell. A point ``P`` of the
shell appears at

    px = project(c; J + R(w) (P + kappa f(P) - J)),     w = theta x_hat x d(plane)

with the joint ``J``, the camera ``c``, and a flattening ``kappa``: the cone opens like an umbrella about its innermost
torus, ``f`` being the motion per radian. Sliding along the surface moves a limb point along the edge only, so the
edge's motion normal to itself is that of the material point: derivatives are exact without differentiating the limb.

Pictures of triangles (`flightmodel.rendering`) cost hundreds of times more: they serve overlays, masks and checks.

Assumed: a rigid shell but for the flattening, tori of circular section; the lens of `flightmodel.camera`.

References
----------
Seed paper, CAD-based estimate and Figures 2.1 to 2.3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from estimators import _sight_kernels
from estimators.edge import HorizonLine, ScanLines
from flightmodel.camera import Camera, LensTerms
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.deflection import rotation_vector_body_shell
from flightmodel.geometry import ShellGeometry, edge_circles, torus_circles
from flightmodel.rendering import Rendered, render

_EDGE_POINTS = 201  # over 200 deg, one a degree: chords 0.06 mm off at 1.5 m
_EDGE_LINES = 240  # across the edge, along which it is looked for
_OUTER_PX, _INNER_PX = 75.0, 45.0  # 14 deg at 310 px a radian; inwards less, where the shell has other edges

DEFLECTION, FLATTENING, CAMERA, HELD, RADIUS = slice(0, 2), 2, slice(3, 11), slice(11, 16), 14
"""Columns of a derivative: the shell's rotation vector about body y and z (px/rad) and its flattening (px/rad); the
scene's rotation in camera axes (3, px/rad), focal scale, principal point (2), k1, k2 (px); camera position in body axes
(3), shell radius and joint station (px/m)."""


@dataclass(frozen=True)
class Sight:
    """Where points of the shell appear, with derivatives.

    Parameters
    ----------
    pixels : (n, 2) float
        NaN outside the lens's field.
    jacobian : (n, 2, 16) float
        See the columns above.
    """

    pixels: FloatArray
    jacobian: FloatArray


@dataclass(frozen=True)
class ProjectedEdge(Sight):
    """The shell's edge, points in the lens's field alone, from small to large clocking angles.

    Parameters
    ----------
    inward_px : (n, 2) float
        Unit normals towards the shell.
    clocks_rad : (n,) float
    """

    inward_px: FloatArray
    clocks_rad: FloatArray


@dataclass(frozen=True)
class VirtualCamera:
    """A camera that looks at a shell deflected about a joint.

    Parameters
    ----------
    geometry : ShellGeometry
    camera : Camera
        Nominal, or oriented on a benchmark frame.
    joint_station_m : float
        Joint aft of the nose, m.
    """

    geometry: ShellGeometry
    camera: Camera
    joint_station_m: float
    clocks_rad: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Choose the clocking angles at which the edge is computed: half way round, on the camera's side."""
        y, z = self.camera.position_body_m[1:]
        clock = np.arctan2(z, -y)
        object.__setattr__(self, "clocks_rad", clock + np.deg2rad(100.0) * np.linspace(-1.0, 1.0, _EDGE_POINTS))

    @property
    def joint_m(self) -> FloatArray:
        """Joint from the datum, body axes, (3,), m."""
        return np.array([-self.joint_station_m, 0.0, 0.0])

    @property
    def skin_m(self) -> float:
        """Radius within which the centerbody hides what lies behind; the lens may sit on the skin itself."""
        return min(self.geometry.centerbody_radius_m, float(np.hypot(*self.camera.position_body_m[1:])) - 1e-3)

    @cached_property
    def shell_terms(self) -> tuple[FloatArray, FloatArray, tuple[float, float], float, float]:
        """The shell in the compiled fit: see `estimators._fit_kernels.fit_frame`."""
        return self.clocks_rad, self._circles, self._ring, self.width_m, self.joint_station_m

    @cached_property
    def across_picture(self) -> tuple[FloatArray, float]:
        """How far a pixel lies towards smaller clocking angles, to the right if upright: one at the picture's sides.

        Per px (2,), and what that gives for the picture's middle.
        """
        y, z = self.camera.position_body_m[1:]
        along = self.camera.dcm_cam_body[:2, 1:] @ np.array([-z, y])
        half = 0.5 * np.array(self.camera.size_px)
        per_px = along / (np.abs(along) @ half)
        return per_px, float(per_px @ half)

    @cached_property
    def _circles(self) -> FloatArray:
        """Station, radius and minor radius, m, whose limb is the edge at each clocking angle (n, 3)."""
        return edge_circles(self.geometry, self.camera.position_body_m, self.clocks_rad)

    @cached_property
    def _ring(self) -> tuple[float, float]:
        """Station and radius of the innermost torus, m, about which the shell flattens."""
        station, radius = torus_circles(self.geometry)
        return float(station[0]), float(radius[0])

    @cached_property
    def width_m(self) -> float:
        """Distance of the outermost torus from the innermost, m."""
        station, radius = torus_circles(self.geometry)
        return float(np.hypot(station[-1] - station[0], radius[-1] - radius[0]))

    def from_ring_m(self, points_shell_m: FloatArray) -> FloatArray:
        """Distance (n,) of points of the undeflected shell from the innermost torus's centre line, m."""
        station, radius = self._ring
        outwards = np.hypot(*points_shell_m[:, 1:].T) - radius
        return np.asarray(np.hypot(-points_shell_m[:, 0] - station, outwards))

    @cached_property
    def undeflected(self) -> Rendered | None:
        """The user's mesh of the aeroshell, undeflected and without centerbody; None where there is none."""
        mesh = self.geometry.mesh
        return None if mesh is None else render(self.camera, mesh.vertices_m, mesh.faces)

    def terms(self, deformation: FloatArray) -> tuple[FloatArray, FloatArray, float, float, float, float]:
        """A deformation (3,) in the compiled projection: see `estimators._sight_kernels.project_points`."""
        rotation, left = np.empty((3, 3)), np.empty((3, 2))
        _sight_kernels.rotation_matrix(float(deformation[0]), float(deformation[1]), rotation, left)
        return rotation, left, self.joint_station_m, float(deformation[2]), *self._ring

    def sight(self, points_shell_m: FloatArray, deformation: FloatArray) -> Sight:
        """Project points ``(n, 3)`` of the undeflected shell, m from the datum, for a deformation.

        ``deformation`` (3,) is the shell's rotation vector against the body about body y and z and its flattening, rad.
        """
        pixels, jacobian = np.empty((len(points_shell_m), 2)), np.empty((len(points_shell_m), 2, 16))
        _sight_kernels.project_shell(
            np.ascontiguousarray(points_shell_m), self.terms(deformation), self.camera.lens_terms, pixels, jacobian
        )
        return Sight(pixels, jacobian)

    def pixels_of_each(
        self, points_shell_m: FloatArray, deformations: FloatArray, lenses: LensTerms | None = None
    ) -> FloatArray:
        """Pixels (m, n, 2) of points (n, 3) for each of many deformations (m, 3) or cameras; NaN outside a field.

        ``lenses``: of `Camera.terms_of_turned`, m or one for all deformations; None: this camera's. One deformation
        serves all lenses.
        """
        if lenses is None:
            model, half, focal, centre, k, position, axes = self.camera.lens_terms
            lenses = model, np.array([half]), focal[None], centre[None], k[None], position[None], axes[None]
        pixels = np.empty((max(len(deformations), len(lenses[-1])), len(points_shell_m), 2))
        shell = (self.joint_station_m, *self._ring)
        _sight_kernels.project_each(np.ascontiguousarray(points_shell_m), deformations, shell, lenses, pixels)
        return pixels

    def edge(self, deformation: FloatArray) -> ProjectedEdge:
        """Project the shell's edge for a deformation (3,); see `sight`.

        Raises
        ------
        GateError
            Where the edge is out of the camera's view.
        """
        n = len(self.clocks_rad)
        pixels, jacobian, inward, kept = np.empty((n, 2)), np.empty((n, 2, 16)), np.empty((n, 2)), np.empty(n)
        count = _sight_kernels.edge_at(
            np.asarray(deformation, dtype=float), self.shell_terms, self.camera.lens_terms, pixels, jacobian, inward,
            kept,
        )  # fmt: skip
        if count < 0:
            raise GateError(
                f"the camera at {np.round(self.camera.position_body_m, 3).tolist()} m lies inside the outermost torus",
                code="camera-inside-shell",
            )
        if count < 3:
            raise GateError(
                "the camera does not see the shell's edge; check its mount and lens in the vehicle file",
                "edge-out-of-view",
            )
        return ProjectedEdge(pixels[:count], jacobian[:count], inward[:count], kept[:count])

    def edge_clocks(self) -> FloatArray:
        """Clocking angles of places spread evenly along the undeflected edge, inside the picture and off its border."""
        edge = self.edge(np.zeros(3))
        inside = np.flatnonzero(self.camera.is_inside(edge.pixels, 6.0))
        if len(inside) < 2:
            raise GateError(
                "the camera does not see the shell's edge; check its mount and lens in the vehicle file",
                "edge-out-of-view",
            )
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(edge.pixels[inside], axis=0), axis=1))])
        return np.interp(np.linspace(0.0, length[-1], _EDGE_LINES), length, edge.clocks_rad[inside])

    def lines_at(self, clocks_rad: FloatArray, deformation: FloatArray) -> ScanLines:
        """Scan lines normal to the edge of a deformation (3,) at clocking angles; those out of the field left out."""
        edge = self.edge(deformation)
        n = len(clocks_rad)
        origin, across, index = np.empty((n, 2)), np.empty((n, 2)), np.empty(n, dtype=np.intp)
        count = _sight_kernels.lines_across(
            clocks_rad, edge.clocks_rad, edge.pixels, edge.inward_px, origin, across, index
        )
        return ScanLines(origin[:count], across[:count], _OUTER_PX, _INNER_PX, index[:count])

    def mismatch(self, horizon: HorizonLine, edge: ProjectedEdge) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals of found edge points against a projected edge.

        Returns
        -------
        residual_px : (m,) float
            Found minus predicted along the inward normal; NaN where the predicted edge does not reach.
        jacobian : (m, 16) float
            Of the *prediction*, interpolated along the edge.
        clocks_rad : (m,) float
            Clocking angles of the points' feet.
        """
        m = len(horizon.points_px)
        residual, rows, at = np.empty(m), np.empty((m, 16)), np.empty(m)
        _sight_kernels.feet_on_edge(horizon.points_px, edge.pixels, edge.jacobian, residual, rows, at)
        return residual, rows, np.interp(at, np.arange(len(edge.clocks_rad)), edge.clocks_rad)


def meets_centerbody(view: VirtualCamera, rays_body: FloatArray) -> BoolArray:
    """Whether rays ``(n, 3)`` from the lens meet the centerbody, a cylinder on whose skin the camera sits."""
    x, y, z = view.camera.position_body_m
    lateral = np.maximum(rays_body[:, 1] ** 2 + rays_body[:, 2] ** 2, 1e-12)
    inward = -(y * rays_body[:, 1] + z * rays_body[:, 2])
    square = inward**2 - lateral * (y**2 + z**2 - view.skin_m**2)
    station = -x - rays_body[:, 0] * (inward - np.sqrt(np.maximum(square, 0.0))) / lateral
    return np.asarray((square > 0.0) & (inward > 0.0) & (station > 0.0) & (station < view.geometry.centerbody_length_m))


def deformation_of(theta_rad: float, plane_lv_rad: float) -> FloatArray:
    """Deformation (3,) of `VirtualCamera.sight` for a deflection's angle and plane, without flattening."""
    out: FloatArray = rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))
    return np.array([out[1], out[2], 0.0])

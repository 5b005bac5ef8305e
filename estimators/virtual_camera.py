"""What would the camera see if the joint were bent by this much?

The shell's edge against the sky is the outermost torus's limb, a closed-form curve of the bent geometry; it is
projected, never rendered. A point ``P`` of the shell appears at

    px = project(c; J + R(w) (P - J)),     w = theta x_hat x d(plane)

with the joint ``J``, and camera corrections ``c``: three small angles in camera axes and a focal scale, fitted on a
benchmark frame. Sliding along the surface moves a limb point along the edge only, so the edge's motion across itself
is that of the material point: derivatives are exact without differentiating the limb.

Sources: seed paper, CAD-based estimate and Figures 2.1 to 2.3.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.horizon import HorizonLine, ScanLines
from flightmodel import rotations
from flightmodel.camera import Camera
from flightmodel.checks import FloatArray
from flightmodel.deflection import rotation_vector_body_shell
from flightmodel.geometry import bend, torus_limb, vehicle_meshes
from flightmodel.vehicle import ShellGeometry

EDGE_POINTS = 201
OUTER_PX, INNER_PX = 75.0, 45.0
HUBER = 2.5

DEFLECTION, POINTING, NUISANCE = slice(0, 2), slice(2, 6), slice(6, 14)
"""Columns of the edge's Jacobian."""


@dataclass(frozen=True)
class HeldFixed:
    """One standard deviation of what the fit holds fixed.

    Parameters
    ----------
    centre_px, k1 : float
        Principal point (each axis) and first lens coefficient.
    position_m : float
        Camera position, each body axis.
    rim_radius_m, joint_station_m : float
        Shell and joint; 0.05 m covers the nose and the innermost torus within 4 sd.
    benchmark_rad : float
        Deflection of the benchmark frame, each lateral axis. Statically ``(z0/x) u/(1-u)``, 0.06 deg for the reference
        vehicle at 421 s, and the joint's ringing about it.
    edge_px : float
        Shift of the found edge against the true one, different from frame to frame with the light; as much for a
        tilt and for a bow of the edge across the picture (at the picture's sides).
    """

    centre_px: float = 1.5
    k1: float = 0.004
    position_m: float = 0.003
    rim_radius_m: float = 0.01
    joint_station_m: float = 0.05
    benchmark_rad: float = float(np.deg2rad(0.12))
    edge_px: float = 0.2

    @property
    def nuisance_sd(self) -> FloatArray:
        """In the order of the edge's ``NUISANCE`` columns, (8,)."""
        p = self.position_m
        return np.array([self.centre_px, self.centre_px, self.k1, p, p, p, self.rim_radius_m, self.joint_station_m])


@dataclass(frozen=True)
class ProjectedEdge:
    """The shell's edge in the picture with its derivatives, ``n`` points in the lens's field.

    Parameters
    ----------
    pixels : (n, 2) float
    inward_px : (n, 2) float
        Unit normals towards the shell.
    jacobian : (n, 14) float
        Motion along the normal. ``DEFLECTION``: the shell's rotation vector about body y and z, px/rad. ``POINTING``:
        three rotations of the scene in camera axes, px/rad, and the focal scale, px. ``NUISANCE``: principal point u
        and v, k1, camera position in body axes (3), rim radius and joint station, px or px/m.
    """

    pixels: FloatArray
    inward_px: FloatArray
    jacobian: FloatArray


@dataclass(frozen=True)
class VirtualCamera:
    """A camera that looks at a shell bent about a joint.

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
        object.__setattr__(self, "clocks_rad", clock + np.deg2rad(100.0) * np.linspace(-1.0, 1.0, EDGE_POINTS))

    @property
    def joint_m(self) -> FloatArray:
        """Joint from the datum, body axes, (3,), m."""
        return np.array([-self.joint_station_m, 0.0, 0.0])

    def edge(self, rotation_yz_rad: FloatArray) -> ProjectedEdge:
        """Project the shell's edge for a rotation vector ``(0, w_y, w_z)`` of the shell against the body, rad."""
        dcm = rotations.dcm_from_q(rotations.exp(np.array([0.0, *rotation_yz_rad])))
        eye = dcm.T @ (self.camera.position_body_m - self.joint_m) + self.joint_m
        arm = (torus_limb(self.geometry, eye, self.clocks_rad) - self.joint_m) @ dcm.T
        points = arm + self.joint_m
        pixels, per_cam, per_lens = self.camera.project_with_jacobian(points)
        seen = np.isfinite(pixels[:, 0])
        pixels, per_cam, per_lens, arm, points = (a[seen] for a in (pixels, per_cam, per_lens, arm, points))
        tangent = np.gradient(pixels, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # clocks grow to the left, so the shell lies to the left of the way along the edge
        inward = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        across_cam = np.einsum("ni,nij->nj", inward, per_cam)
        # d(R w x P) = -[P]x dw, in body axes for the bending and in camera axes for the pointing
        turn_body = -np.einsum("nj,njk->nk", across_cam @ self.camera.dcm_cam_body, rotations.skew(arm))
        turn_cam = -np.einsum("nj,njk->nk", across_cam, rotations.skew(self.camera.cam_from_body(points)))
        lens = np.einsum("ni,nij->nj", inward, per_lens)
        focal = lens[:, :2] @ self.camera.focal_px
        across_body = across_cam @ self.camera.dcm_cam_body
        outboard = arm @ dcm * np.array([0.0, 1.0, 1.0])
        outboard /= np.linalg.norm(outboard, axis=1, keepdims=True)
        radius = np.einsum("ni,ni->n", across_body, outboard @ dcm.T)
        joint = across_body @ (dcm[:, 0] - np.array([1.0, 0.0, 0.0]))
        columns = [turn_body[:, 1:], turn_cam, focal, lens[:, 2:5], -across_body, radius, joint]
        return ProjectedEdge(pixels, inward, np.column_stack(columns))

    def edge_of(self, theta_rad: float, plane_lv_rad: float) -> ProjectedEdge:
        """Project the shell's edge for a bending angle and plane."""
        return self.edge(rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))[1:])

    def scan_lines(self, count: int = 240) -> ScanLines:
        """Lay searches across the unbent edge, inside the picture and clear of its border."""
        edge = self.edge(np.zeros(2))
        inside = np.flatnonzero(self.camera.is_inside(edge.pixels, 6.0))
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(edge.pixels[inside], axis=0), axis=1))])
        at = np.linspace(0.0, length[-1], count)
        both = (edge.pixels, edge.inward_px)
        origin, inward = (np.column_stack([np.interp(at, length, a[inside, k]) for k in (0, 1)]) for a in both)
        return ScanLines(origin, inward / np.linalg.norm(inward, axis=1, keepdims=True), OUTER_PX, INNER_PX)

    def mismatch(self, horizon: HorizonLine, edge: ProjectedEdge) -> tuple[FloatArray, FloatArray]:
        """Compare found edge points with a projected edge.

        Returns
        -------
        residual_px : (m,) float
            Found minus predicted along the inward normal; NaN where the predicted edge does not reach.
        jacobian : (m, 14) float
            Of the *prediction*, interpolated along the edge.
        """
        vertex, step = edge.pixels, np.diff(edge.pixels, axis=0)
        square = np.einsum("ni,ni->n", vertex, vertex) - 2.0 * horizon.points_px @ vertex.T
        closest = np.argmin(square, axis=1)
        # the foot lies on the segment before or after the closest vertex
        before = np.clip(closest - 1, 0, len(step) - 1)
        share = np.einsum("mi,mi->m", horizon.points_px - vertex[before], step[before])
        share /= np.einsum("mi,mi->m", step[before], step[before])
        nearest = np.where((share > 1.0) & (closest < len(step)), closest, before)
        offset, along = horizon.points_px - vertex[nearest], step[nearest]
        s = np.einsum("mi,mi->m", offset, along) / np.einsum("mi,mi->m", along, along)
        normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
        residual = np.einsum("mi,mi->m", offset, normal)
        residual[(s < -0.01) & (nearest == 0) | (s > 1.01) & (nearest == len(step) - 1)] = np.nan
        s = np.clip(s, 0.0, 1.0)[:, None]
        return residual, (1.0 - s) * edge.jacobian[nearest] + s * edge.jacobian[nearest + 1]

    def overlay(
        self, image: NDArray[np.uint8], theta_rad: float, plane_lv_rad: float, from_column: int | None = None
    ) -> NDArray[np.uint8]:
        """Draw the virtual view over the right part of a frame (seed paper Figure 2.3): filled tori with a wireframe.

        Returns
        -------
        (h, w, 3) uint8
            RGB.
        """
        out = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        left = self.camera.width_px // 2 if from_column is None else from_column
        layer = self._painted(theta_rad, plane_lv_rad)
        drawn = np.asarray(layer.any(axis=2)) & ~self._centerbody_pixels()
        drawn[:, :left] = False
        out[drawn] = (0.35 * out[drawn] + 0.65 * layer[drawn]).astype(np.uint8)
        cv2.line(out, (left, 0), (left, self.camera.height_px - 1), (90, 90, 90), 1)
        return np.asarray(out, dtype=np.uint8)

    def _centerbody_pixels(self) -> NDArray[np.bool_]:
        """Pixels ``(h, w)`` whose rays meet the centerbody, on whose skin the camera sits."""
        v, u = np.indices((self.camera.height_px, self.camera.width_px), dtype=float)
        rays = np.nan_to_num(self.camera.rays_body(np.column_stack([u.ravel(), v.ravel()])))
        x, y, z = self.camera.position_body_m
        across, inward = np.maximum(rays[:, 1] ** 2 + rays[:, 2] ** 2, 1e-12), -(y * rays[:, 1] + z * rays[:, 2])
        excess = y**2 + z**2 - min(self.geometry.centerbody_radius_m, float(np.hypot(y, z)) - 1e-3) ** 2
        square = inward**2 - across * excess
        station = -x - rays[:, 0] * (inward - np.sqrt(np.maximum(square, 0.0))) / across
        met = (square > 0.0) & (inward > 0.0) & (station > 0.0) & (station < self.geometry.centerbody_length_m)
        return np.asarray(met.reshape(v.shape))

    def _painted(self, theta_rad: float, plane_lv_rad: float) -> NDArray[np.uint8]:
        """Paint the tori's triangles from far to near, vertices through the lens, straight edges between."""
        layer = np.zeros((self.camera.height_px, self.camera.width_px, 3), dtype=np.uint8)
        polygons, depths, shades = [], [], []
        for name, mesh in vehicle_meshes(self.geometry, clock_sections=72, torus_sections=20).items():
            if not name.startswith("torus"):
                continue
            points = bend(np.asarray(mesh.vertices), theta_rad, plane_lv_rad, self.joint_station_m)
            pixels = self.camera.project(points)
            corners, away = points[mesh.faces], points[mesh.faces].mean(axis=1) - self.camera.position_body_m
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(away, axis=1)
            facing = -np.einsum("ni,ni->n", normal, away) / lengths
            keep = (facing > 0.0) & np.isfinite(pixels[mesh.faces]).all(axis=(1, 2))
            polygons.append(pixels[mesh.faces[keep]])
            depths.append(np.linalg.norm(away[keep], axis=1))
            shades.append(facing[keep])
        polygon, shade = np.concatenate(polygons), np.concatenate(shades)
        corners_fixed = np.rint(polygon * 16.0).astype(np.int32)
        for k in np.argsort(-np.concatenate(depths)):
            tone = 60.0 + 150.0 * shade[k]
            cv2.fillConvexPoly(layer, corners_fixed[k], (int(0.45 * tone), int(0.75 * tone), int(tone)), cv2.LINE_AA, 4)
            cv2.polylines(layer, [corners_fixed[k]], True, (25, 70, 130), 1, cv2.LINE_AA, 4)
        return layer


def huber_gain(
    residual: FloatArray, design: FloatArray, sd_px: FloatArray, prior: FloatArray | None
) -> tuple[FloatArray, FloatArray, float]:
    """Weigh one Gauss-Newton step by Huber's rule.

    Parameters
    ----------
    residual : (m,) float
        px.
    design : (m, k) float
        Derivatives of the prediction by the parameters.
    sd_px : (m,) float
        Of the found points; widened by the residuals' own spread.
    prior : (k,) float or None
        Standard deviations of the parameters before the fit.

    Returns
    -------
    gain : (k, m) float
        The step is ``gain @ residual``.
    covariance : (k, k) float
        Formal.
    rms_px : float
    """
    spread = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 0.05)
    scale = np.hypot(sd_px, spread)
    weight = 1.0 / scale**2 / np.maximum(1.0, np.abs(residual) / (HUBER * scale))
    normal = design.T @ (weight[:, None] * design)
    if prior is not None:
        normal = normal + np.diag(1.0 / prior**2)
    covariance: FloatArray = np.linalg.inv(normal).astype(float)
    return covariance @ (design.T * weight), covariance, float(np.sqrt(np.average(residual**2, weights=weight)))

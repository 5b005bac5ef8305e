"""What does the camera see at a given deflection of the shell?

The shell's edge against the sky is the limb of the outermost torus, or of the user's mesh, a closed-form curve of the
deformed geometry; it is projected, never rendered, and so are the features painted on the shell. A point ``P`` of the
shell appears at

    px = project(c; J + R(w) (P + kappa f(P) - J)),     w = theta x_hat x d(plane)

with the joint ``J``, the camera ``c``, and a flattening ``kappa``: the cone opens like an umbrella about its innermost
torus, ``f`` being the motion per radian. Sliding along the surface moves a limb point along the edge only, so the
edge's motion normal to itself is that of the material point: derivatives are exact without differentiating the limb.

Pictures of triangles (`flightmodel.rendering`) cost hundreds of times more: they serve overlays, masks and checks.
Readable twin of the projection: ``tests/oracles/plain_sight.py``.

Assumed: a rigid shell but for the flattening, tori of circular section; the lens of `flightmodel.camera`.

References
----------
Seed paper, CAD-based estimate and Figures 2.1 to 2.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from estimators.edge import HorizonLine, ScanLines
from flightmodel._kernels import inlined, kernel
from flightmodel.camera import FISHEYE, Camera, LensTerms
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.deflection import rotation_vector_body_shell
from flightmodel.geometry import ShellGeometry, edge_circles, torus_circles
from flightmodel.rendering import Rendered, render

_EDGE_POINTS = 201  # over 200 deg, one a degree: chords 0.06 mm off at 1.5 m
_EDGE_LINES = 240  # across the edge, along which it is looked for
_SPARSE = 10  # of an edge's vertices, the first looked at for the closest
_OUTER_PX, _INNER_PX = 75.0, 45.0  # 14 deg at 310 px a radian; inwards less, where the shell has other edges

COLUMNS = 16
DEFLECTION, FLATTENING, CAMERA, HELD, RADIUS, JOINT = slice(0, 2), 2, slice(3, 11), slice(11, COLUMNS), 14, 15
"""Columns of a derivative: the shell's rotation vector about body y and z (px/rad) and its flattening (px/rad); the
scene's rotation in camera axes (3, px/rad), focal scale, principal point (2), k1, k2 (px); camera position in body axes
(3), shell radius and joint station (px/m)."""


@inlined
def _fisheye_sight(x, y, z, r, a, k):
    """Normalised image point of Kannala and Brandt's lens, derivatives by x, y, z, and by k1 and k2.

    ``r``: distance from the axis; ``a``: angle from it.
    """
    r2, a2 = r * r, a * a
    distance = a * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
    slope = 1.0 + a2 * (3.0 * k[0] + a2 * (5.0 * k[1] + a2 * (7.0 * k[2] + a2 * 9.0 * k[3])))
    per_square = 1.0 / (r2 + z * z)
    if r < 1e-9:
        # on the axis the lens is a pinhole
        return x / z, y / z, 1.0 / z, 0.0, -x / (z * z), 0.0, 1.0 / z, -y / (z * z), 0.0, 0.0, 0.0, 0.0
    ex, ey = x / r, y / r
    along, across = slope * z * per_square, distance / r
    down = -slope * r * per_square
    cross = (along - across) * ex * ey
    a3 = a2 * a
    return (
        distance * ex, distance * ey,
        along * ex * ex + across * ey * ey, cross, down * ex,
        cross, along * ey * ey + across * ex * ex, down * ey,
        a3 * ex, a3 * ey, a3 * a2 * ex, a3 * a2 * ey,
    )  # fmt: skip


@inlined
def _pinhole_sight(x, y, z, k):
    """As `_fisheye_sight`, for OpenCV's pinhole with radial k1, k2, k3 (``k[0], k[1], k[4]``) and tangential p1, p2."""
    u, v = x / z, y / z
    r2 = u * u + v * v
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    slope = k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4])
    p1, p2 = k[2], k[3]
    du_du = radial + 2.0 * u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u
    du_dv = 2.0 * u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
    dv_dv = radial + 2.0 * v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u
    return (
        u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
        v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v,
        du_du / z, du_dv / z, -(du_du * u + du_dv * v) / z,
        du_dv / z, dv_dv / z, -(du_dv * u + dv_dv * v) / z,
        u * r2, v * r2, u * r2 * r2, v * r2 * r2,
    )  # fmt: skip


@inlined
def _from_joint_and_eye(point, terms, position, axes):
    """Point of the deformed shell from the joint, body axes, and from the eye, camera axes; see `project_points`.

    Last: its motion aft and outboard per radian of flattening, and the unit vector outboard.
    """
    rotation, _, joint, flattening, ring_station, ring_radius = terms
    px, py, pz = point
    radius = math.sqrt(py * py + pz * pz)
    ey, ez = (py / radius, pz / radius) if radius > 0.0 else (0.0, 0.0)
    fx, fr = -(radius - ring_radius), px + ring_station
    ax = px + flattening * fx + joint
    ay, az = py + flattening * fr * ey, pz + flattening * fr * ez
    # arm from the joint, body axes
    bx = rotation[0, 0] * ax + rotation[0, 1] * ay + rotation[0, 2] * az
    by = rotation[1, 0] * ax + rotation[1, 1] * ay + rotation[1, 2] * az
    bz = rotation[2, 0] * ax + rotation[2, 1] * ay + rotation[2, 2] * az
    dx, dy, dz = bx - joint - position[0], by - position[1], bz - position[2]
    x = axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz
    y = axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz
    z = axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz
    return (bx, by, bz), (x, y, z), (fx, fr), (ey, ez)


@inlined
def pixel_of(point, terms, lens):
    """As `project_points`, of one point, without derivatives."""
    model, half_field, focal, centre, k, position, axes = lens
    _, (x, y, z), _, _ = _from_joint_and_eye(point, terms, position, axes)
    off_axis = math.sqrt(x * x + y * y)
    angle = math.atan2(off_axis, z)
    if angle >= half_field:
        return np.nan, np.nan
    sight = _fisheye_sight(x, y, z, off_axis, angle, k) if model == FISHEYE else _pinhole_sight(x, y, z, k)
    return focal[0] * sight[0] + centre[0], focal[1] * sight[1] + centre[1]


@inlined
def project_points(points, terms, lens, pixels, jacobian):
    """Pixels ``(n, 2)`` of shell points ``(n, 3)`` and their derivatives ``(n, 2, 16)``; NaN outside the lens's field.

    ``terms``: rotation (3, 3), its left Jacobian's y and z columns (3, 2), joint station, flattening, and station and
    radius of the ring about which the shell flattens. ``lens``: model, half field, focal lengths (2), principal point
    (2), coefficients (5), camera position (3) and camera axes (3, 3).
    """
    rotation, left = terms[:2]
    model, half_field, focal, centre, k, position, axes = lens
    by_body = np.empty((2, 3))
    for i in range(len(points)):
        (bx, by, bz), (x, y, z), (fx, fr), (ey, ez) = _from_joint_and_eye(points[i], terms, position, axes)
        off_axis = math.sqrt(x * x + y * y)
        angle = math.atan2(off_axis, z)
        if angle >= half_field:
            pixels[i, 0] = pixels[i, 1] = np.nan
            for c in range(COLUMNS):
                jacobian[i, 0, c] = jacobian[i, 1, c] = 0.0
            continue
        if model == FISHEYE:
            u, v, ux, uy, uz, vx, vy, vz, uk1, vk1, uk2, vk2 = _fisheye_sight(x, y, z, off_axis, angle, k)
        else:
            u, v, ux, uy, uz, vx, vy, vz, uk1, vk1, uk2, vk2 = _pinhole_sight(x, y, z, k)
        pixels[i, 0], pixels[i, 1] = focal[0] * u + centre[0], focal[1] * v + centre[1]
        for c in range(2):
            f = focal[c]
            cx, cy, cz = (ux, uy, uz) if c == 0 else (vx, vy, vz)
            cx, cy, cz = f * cx, f * cy, f * cz
            for m in range(3):
                by_body[c, m] = cx * axes[0, m] + cy * axes[1, m] + cz * axes[2, m]
            gx, gy, gz = by_body[c]
            # g . (w x arm) = w . (arm x g)
            tx, ty, tz = by * gz - bz * gy, bz * gx - bx * gz, bx * gy - by * gx
            row = jacobian[i, c]
            row[0] = tx * left[0, 0] + ty * left[1, 0] + tz * left[2, 0]
            row[1] = tx * left[0, 1] + ty * left[1, 1] + tz * left[2, 1]
            s0 = gx * rotation[0, 0] + gy * rotation[1, 0] + gz * rotation[2, 0]
            s1 = gx * rotation[0, 1] + gy * rotation[1, 1] + gz * rotation[2, 1]
            s2 = gx * rotation[0, 2] + gy * rotation[1, 2] + gz * rotation[2, 2]
            outboard = s1 * ey + s2 * ez
            row[2] = s0 * fx + fr * outboard
            row[3], row[4], row[5] = y * cz - z * cy, z * cx - x * cz, x * cy - y * cx
            row[6] = f * u if c == 0 else f * v
            row[7], row[8] = (1.0, 0.0) if c == 0 else (0.0, 1.0)
            row[9] = f * (uk1 if c == 0 else vk1)
            row[10] = f * (uk2 if c == 0 else vk2)
            row[11], row[12], row[13] = -gx, -gy, -gz
            row[14] = outboard
            row[15] = s0 - gx


@inlined
def limb_points(circles, ring, flat, eye, clocks, points):
    """Outboard edge ``(n, 3)`` seen from ``eye`` of circles (n, 3), station, radius, minor radius; False inside one.

    They are flattened by ``flat`` about the ring before. See `flightmodel.geometry.torus_limb`.
    """
    for i in range(len(clocks)):
        station = circles[i, 0] + flat * (circles[i, 1] - ring[1])
        radius, minor = circles[i, 1] - flat * (circles[i, 0] - ring[0]), circles[i, 2]
        oy, oz = -math.cos(clocks[i]), math.sin(clocks[i])
        a = radius - (oy * eye[1] + oz * eye[2])
        b = station + eye[0]
        reach = math.sqrt(a * a + b * b)
        if reach <= minor:
            return False
        # the eye seen from the circle's middle, turned by the angle whose cosine is -minor / reach
        away, turned = -minor / reach, math.sqrt(reach * reach - minor * minor) / reach
        r = radius + minor * (a * away - b * turned) / reach
        points[i, 0], points[i, 1], points[i, 2] = -(station + minor * (b * away + a * turned) / reach), r * oy, r * oz
    return True


@inlined
def feet(found, vertex, jacobian, residual, rows, at):
    """Distance of found points ``(m, 2)`` from the polyline ``vertex``, positive on its shell's side, with derivatives.

    ``jacobian`` (n, 2, 16) is the vertices'; ``rows`` (m, 16) is the prediction's along the segment's normal, ``at``
    (m,) the foot in vertices. NaN where the polyline does not reach.
    """
    n = len(vertex)
    for i in range(len(found)):
        u, v = found[i]
        # an edge is smooth: the closest of every tenth vertex has the closest of all next to it
        nearest, least = 0, 1e300
        for j in range(0, n, _SPARSE):
            square = (vertex[j, 0] - u) ** 2 + (vertex[j, 1] - v) ** 2
            if square < least:
                nearest, least = j, square
        for j in range(max(nearest - _SPARSE, 0), min(nearest + _SPARSE + 1, n)):
            square = (vertex[j, 0] - u) ** 2 + (vertex[j, 1] - v) ** 2
            if square < least:
                nearest, least = j, square
        # the foot lies on the segment before or after the closest vertex
        j = min(max(nearest - 1, 0), n - 2)
        for _ in range(2):
            sx, sy = vertex[j + 1, 0] - vertex[j, 0], vertex[j + 1, 1] - vertex[j, 1]
            length = sx * sx + sy * sy
            share = ((u - vertex[j, 0]) * sx + (v - vertex[j, 1]) * sy) / length
            if share > 1.0 and nearest < n - 1 and j != nearest:
                j = nearest
            else:
                break
        per = 1.0 / math.sqrt(length)
        nx, ny = sy * per, -sx * per
        residual[i] = (u - vertex[j, 0]) * nx + (v - vertex[j, 1]) * ny
        if (share < -0.01 and j == 0) or (share > 1.01 and j == n - 2):
            residual[i] = np.nan
        share = min(max(share, 0.0), 1.0)
        at[i] = j + share
        for c in range(COLUMNS):
            here = nx * jacobian[j, 0, c] + ny * jacobian[j, 1, c]
            there = nx * jacobian[j + 1, 0, c] + ny * jacobian[j + 1, 1, c]
            rows[i, c] = (1.0 - share) * here + share * there


@inlined
def rotation_of(wy, wz, rotation, left):
    """Rotation matrix of a rotation vector ``(0, wy, wz)`` and the y and z columns of its left Jacobian."""
    angle2 = wy * wy + wz * wz
    angle = math.sqrt(angle2)
    if angle < 1e-6:
        s, c, t = 1.0, 0.5, 1.0 / 6.0
    else:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
        t = (angle - math.sin(angle)) / (angle2 * angle)
    # the cross product matrix K and its square
    k = ((0.0, -wz, wy), (wz, 0.0, 0.0), (-wy, 0.0, 0.0))
    k2 = ((-angle2, 0.0, 0.0), (0.0, -wz * wz, wy * wz), (0.0, wy * wz, -wy * wy))
    for i in range(3):
        for j in range(3):
            one = 1.0 if i == j else 0.0
            rotation[i, j] = one + s * k[i][j] + c * k2[i][j]
            if j > 0:
                left[i, j - 1] = one + c * k[i][j] + t * k2[i][j]


@inlined
def project_edge(deformation, clocks, circles, ring, joint, lens, terms, points, pixels, jacobian, kept):
    """Project the limb of the deformed shell; the number of its points in the lens's field, -1 for a lens in a torus.

    They are moved to the front of ``pixels`` and ``jacobian``, their clocking angles into ``kept``.
    """
    rotation = terms[0]
    position, flat = lens[5], deformation[2]
    eye = np.empty(3)
    dx, dy, dz = position[0] + joint, position[1], position[2]
    for m in range(3):
        eye[m] = rotation[0, m] * dx + rotation[1, m] * dy + rotation[2, m] * dz
    eye[0] -= joint
    if not limb_points(circles, ring, flat, eye, clocks, points):
        return -1
    per = 1.0 / (1.0 + flat * flat)
    for i in range(len(points)):
        r = math.sqrt(points[i, 1] ** 2 + points[i, 2] ** 2)
        aft, outwards = -points[i, 0] - ring[0], r - ring[1]
        scale = (ring[1] + per * (outwards + flat * aft)) / r
        points[i, 0] = -(ring[0] + per * (aft - flat * outwards))
        points[i, 1] *= scale
        points[i, 2] *= scale
    project_points(points, terms, lens, pixels, jacobian)
    count = 0
    for i in range(len(points)):
        if math.isfinite(pixels[i, 0]):
            if count < i:
                for c in range(2):
                    pixels[count, c] = pixels[i, c]
                    for j in range(COLUMNS):
                        jacobian[count, c, j] = jacobian[i, c, j]
            kept[count] = clocks[i]
            count += 1
    return count


@kernel
def project_each(points, deformations, shell, lenses, pixels):
    """Pixels (m, n, 2) of points (n, 3) for m deformations (m, 3) and m lenses; one deformation or lens serves all.

    ``shell``: joint station, station and radius of the ring; ``lenses``: as of `project_points`, arrays by lens first.
    """
    model, half_field, focal, centre, k, position, axes = lenses
    joint, ring_station, ring_radius = shell
    rotation, left = np.empty((3, 3)), np.empty((3, 2))
    for one in range(len(pixels)):
        d, c = one % len(deformations), one % len(axes)
        rotation_of(deformations[d, 0], deformations[d, 1], rotation, left)
        terms = (rotation, left, joint, deformations[d, 2], ring_station, ring_radius)
        lens = (model, half_field[c], focal[c], centre[c], k[c], position[c], axes[c])
        for i in range(len(points)):
            pixels[one, i, 0], pixels[one, i, 1] = pixel_of(points[i], terms, lens)


@kernel
def edge_at(deformation, shell, lens, pixels, jacobian, inward, kept):
    """`project_edge` of a deformation, with unit normals ``inward`` (n, 2) towards the shell; points kept.

    ``shell``: as of `estimators.frame_solution.fit_frame`.
    """
    clocks, circles, ring, _, joint = shell
    points, rotation, columns = np.empty((len(clocks), 3)), np.empty((3, 3)), np.empty((3, 2))
    rotation_of(deformation[0], deformation[1], rotation, columns)
    terms = (rotation, columns, joint, deformation[2], ring[0], ring[1])
    count = project_edge(deformation, clocks, circles, ring, joint, lens, terms, points, pixels, jacobian, kept)
    for i in range(count):
        before, after = max(i - 1, 0), min(i + 1, count - 1)
        # clocking angles grow to the left, so the shell lies to the left along the edge
        along_u, along_v = pixels[after, 0] - pixels[before, 0], pixels[after, 1] - pixels[before, 1]
        length = math.sqrt(along_u * along_u + along_v * along_v)
        inward[i, 0], inward[i, 1] = along_v / length, -along_u / length
    return count


@kernel
def lines_across(clocks, kept, pixels, inward, origin, across, index):
    """Points (m, 2) of an edge at clocking angles (m,) with its unit normals, moved to the front; their number.

    Those beyond the angles ``kept`` (n,), increasing, of the edge's points are left out. ``index``: which they are.
    """
    count = 0
    for i in range(len(clocks)):
        if kept[0] <= clocks[i] <= kept[-1]:
            j = min(np.searchsorted(kept, clocks[i], side="right"), len(kept) - 1) - 1
            share = (clocks[i] - kept[j]) / (kept[j + 1] - kept[j])
            for c in range(2):
                origin[count, c] = pixels[j, c] + share * (pixels[j + 1, c] - pixels[j, c])
                across[count, c] = inward[j, c] + share * (inward[j + 1, c] - inward[j, c])
            length = math.sqrt(across[count, 0] ** 2 + across[count, 1] ** 2)
            across[count, 0] /= length
            across[count, 1] /= length
            index[count] = i
            count += 1
    return count


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
        """The shell in the compiled fit: see `estimators.frame_solution.fit_frame`."""
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
        """A deformation (3,) in the compiled projection: see `project_points`."""
        rotation, left = np.empty((3, 3)), np.empty((3, 2))
        rotation_of(float(deformation[0]), float(deformation[1]), rotation, left)
        return rotation, left, self.joint_station_m, float(deformation[2]), *self._ring

    def sight(self, points_shell_m: FloatArray, deformation: FloatArray) -> Sight:
        """Project points ``(n, 3)`` of the undeflected shell, m from the datum, for a deformation.

        ``deformation`` (3,) is the shell's rotation vector against the body about body y and z and its flattening, rad.
        """
        pixels, jacobian = np.empty((len(points_shell_m), 2)), np.empty((len(points_shell_m), 2, COLUMNS))
        project_points(
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
        project_each(np.ascontiguousarray(points_shell_m), deformations, shell, lenses, pixels)
        return pixels

    def edge(self, deformation: FloatArray) -> ProjectedEdge:
        """Project the shell's edge for a deformation (3,); see `sight`.

        Raises
        ------
        GateError
            Where the edge is out of the camera's view.
        """
        n = len(self.clocks_rad)
        pixels, jacobian, inward, kept = np.empty((n, 2)), np.empty((n, 2, COLUMNS)), np.empty((n, 2)), np.empty(n)
        count = edge_at(
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
        count = lines_across(clocks_rad, edge.clocks_rad, edge.pixels, edge.inward_px, origin, across, index)
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
        residual, rows, at = np.empty(m), np.empty((m, COLUMNS)), np.empty(m)
        feet(horizon.points_px, edge.pixels, edge.jacobian, residual, rows, at)
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

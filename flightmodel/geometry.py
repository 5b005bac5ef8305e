"""What does the inflated aeroshell look like from its aft side, and does a user's mesh of it fit the vehicle?

A stack of ``n`` tori, tangent to one another along the generator of a cone of half-angle ``H`` that touches the nose
sphere of radius ``Rn``. In the half-plane (station aft of the nose ``s``, radius ``r``) the centre of torus ``i`` is

    (s_i, r_i) = (s_0, r_0) + i p (cos H, sin H),     s_0 = f(r_0 + a cos H) + a sin H,
    f(r) = Rn (1 - sin H) + (r - Rn cos H) / tan H    (the cone's forward face)

with minor radius ``a`` and spacing ``p``. Body axes: datum at the nose, x forward, so ``x = -s``. *Shell* axes equal
body axes at zero deflection; `bend` carries shell points to the body. Assumed: the skin follows the tori, the shell
deflects at the joint alone, gore seams are meridians of the aft side evenly clocked from 0 deg LV.

Meshes (STL, OBJ, GLB) take the place of aeroshell and centerbody: their look, and of the aeroshell the edge and surface
that the camera sees (`edge_circles`). So that mesh and ``[geometry]`` are one vehicle, the mesh must have its size, and
a shell's rim must be near the circle that ``[geometry]`` has. A point ``p`` of the file lies in body axes at

    unit_m R (p - nose),     rows of R: forward, -zero_clock, forward x -zero_clock.

A mesh must be closed: every edge bounds an even number of faces. Then rays separate inside from outside by the parity
of what they cross, whichever way faces are wound.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, PrivateAttr

from flightmodel import rotations
from flightmodel.checks import BoolArray, ConfigError, FloatArray, GateError, Issue
from flightmodel.config import FileBeside, KeyFault, Length, Section, beside
from flightmodel.deflection import lv_direction, rotation_vector_body_shell
from flightmodel.files import UnfitFile, file_bytes, nothing_at
from flightmodel.mesh_sections import section_supports, touching_circles

if TYPE_CHECKING:
    import trimesh

FEATURES = ("none", "texture", "drawn")
FEATURE_KINDS = ("dot", "seam", "hoop")  # of listed features


def _known_features(value: str) -> str:
    if value in FEATURES:
        return value
    if not value.lower().endswith(".csv"):
        raise ValueError(f"{', '.join(FEATURES)} or a CSV of your own is wanted (docs/scenario-and-vehicle-files.md)")
    return beside(value)


@dataclass(frozen=True)
class ListedFeatures:
    """Features of an analyst's own list, ``n`` points.

    Parameters
    ----------
    points_shell_m : (n, 3) float
        On the undeflected shell, from the datum, shell axes.
    normals : (n, 3) float
        Outward.
    kind : (n,) int
        Index into `FEATURE_KINDS`; see `flightmodel.shell_features`.
    width_m : (n,) float
    is_paler : (n,) bool
    """

    points_shell_m: FloatArray
    normals: FloatArray
    kind: NDArray[np.int64]
    width_m: FloatArray
    is_paler: BoolArray


class ShellGeometry(Section):
    """Stacked-torus aeroshell and cylindrical centerbody."""

    nose_radius_m: Length
    half_angle_deg: Annotated[float, Field(gt=0.0, lt=90.0)]
    torus_count: Annotated[int, Field(ge=1, le=60)]
    torus_minor_radius_m: Length
    torus_spacing_m: Length
    innermost_torus_radius_m: Length
    base_radius_m: Length
    gore_count: Annotated[int, Field(ge=3, le=120)]
    centerbody_radius_m: Length
    centerbody_length_m: Length
    features: Annotated[str, AfterValidator(_known_features)] = "texture"
    _listed: ListedFeatures | None = PrivateAttr(default=None)
    _mesh: BodyMesh | None = PrivateAttr(default=None)

    @property
    def listed_features(self) -> ListedFeatures | None:
        """The list that ``features`` names; None where it names none, or where it was not read."""
        return self._listed

    def with_listed(self, listed: ListedFeatures) -> ShellGeometry:
        """Return this shell with the list that ``features`` names."""
        shell = self.model_copy()
        shell._listed = listed
        return shell

    @property
    def mesh(self) -> BodyMesh | None:
        """The user's mesh of the aeroshell, which then defines edge and surface for the camera; None without one."""
        return self._mesh

    def with_mesh(self, mesh: BodyMesh) -> ShellGeometry:
        """Return this shell as a mesh has it."""
        shell = self.model_copy()
        shell._mesh = mesh
        return shell

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        angle, base = np.deg2rad(self.half_angle_deg), self.base_radius_m
        outermost = self.innermost_torus_radius_m + (self.torus_count - 1) * self.torus_spacing_m * np.sin(angle)
        if self.nose_radius_m * np.cos(angle) >= base:
            words = f"the nose cap is wider than the base; below {base / np.cos(angle):.4g} m for this base and angle"
            yield "nose_radius_m", self.nose_radius_m, words
        if self.torus_minor_radius_m >= self.innermost_torus_radius_m:
            words = (
                f"wanted below innermost_torus_radius_m = {self.innermost_torus_radius_m:g}, or the torus has no hole"
            )
            yield "torus_minor_radius_m", self.torus_minor_radius_m, words
        if outermost - self.torus_minor_radius_m >= base:
            words = f"the outermost of {self.torus_count} tori, of radius {outermost:.4g} m, lies outside the base"
            yield "base_radius_m", base, f"{words}; check torus_count and torus_spacing_m"
        if self.centerbody_radius_m >= base:
            yield "centerbody_radius_m", self.centerbody_radius_m, f"wanted below base_radius_m = {base:g}"


def torus_circles(geometry: ShellGeometry) -> tuple[FloatArray, FloatArray]:
    """Station aft of the nose and radius, m, of the tori's centre circles, ``(n,)`` each, innermost first."""
    half = np.deg2rad(geometry.half_angle_deg)
    minor, nose = geometry.torus_minor_radius_m, geometry.nose_radius_m
    along = geometry.torus_spacing_m * np.arange(geometry.torus_count)
    r_face = geometry.innermost_torus_radius_m + minor * np.cos(half)
    s_face = nose * (1.0 - np.sin(half)) + (r_face - nose * np.cos(half)) / np.tan(half)
    radius = geometry.innermost_torus_radius_m + along * np.sin(half)
    return s_face + minor * np.sin(half) + along * np.cos(half), radius


def aft_profile(geometry: ShellGeometry, points_per_torus: int = 25) -> FloatArray:
    """Meridian of the aft side, ``(m, 2)`` as (station, radius), m, from the innermost valley out to the rim.

    Each torus shows its aft half; the outermost one is followed to its largest radius.
    """
    half = np.deg2rad(geometry.half_angle_deg)
    aft, outward = np.array([np.sin(half), -np.cos(half)]), np.array([np.cos(half), np.sin(half)])
    station, radius = torus_circles(geometry)
    arcs = []
    for i, centre in enumerate(np.column_stack([station, radius])):
        outermost = i == geometry.torus_count - 1
        # the rim, where the normal is radial, lies pi/2 + H from the aft normal
        beta = np.linspace(-0.5 * np.pi, 0.5 * np.pi + (0.5 * np.pi - half if outermost else 0.0), points_per_torus)
        normal = np.cos(beta)[:, None] * aft + np.sin(beta)[:, None] * outward
        arcs.append(centre + geometry.torus_minor_radius_m * normal)
    return np.concatenate(arcs)


def forward_profile(geometry: ShellGeometry) -> FloatArray:
    """Meridian of the forward skin, ``(m, 2)`` as (station, radius), m: nose cap, then straight to the last torus."""
    half, nose = np.deg2rad(geometry.half_angle_deg), geometry.nose_radius_m
    delta = np.linspace(0.5 * np.pi, half, 12)
    cap = np.column_stack([nose * (1.0 - np.sin(delta)), nose * np.cos(delta)])
    station, radius = torus_circles(geometry)
    touch = np.array([[station[-1] - geometry.torus_minor_radius_m * np.sin(half),
                       radius[-1] + geometry.torus_minor_radius_m * np.cos(half)]])  # fmt: skip
    return np.concatenate([cap, touch])


def revolved(profile_station_radius_m: FloatArray, clock_lv_rad: FloatArray | float) -> FloatArray:
    """Points ``(..., m, 3)`` in shell axes, m, of a meridian ``(m, 2)``, or one each, at clocking angles ``(...)``."""
    outboard = lv_direction(np.asarray(clock_lv_rad, dtype=float))[..., None, :]
    station, radius = np.moveaxis(profile_station_radius_m, -1, 0)
    return -station[..., None] * np.array([1.0, 0.0, 0.0]) + radius[..., None] * outboard


def circumferential(points_shell_m: FloatArray) -> FloatArray:
    """Unit vectors ``(n, 3)`` about the shell's axis, right-handed, at points ``(n, 3)``, shell axes."""
    about = np.cross([1.0, 0.0, 0.0], points_shell_m)
    return np.asarray(about / np.linalg.norm(about, axis=1, keepdims=True))


def seam_clocks_rad(geometry: ShellGeometry) -> FloatArray:
    """Clocking angles of the gore seams, ``(gore_count,)``, rad."""
    return 2.0 * np.pi * np.arange(geometry.gore_count) / geometry.gore_count


def dot_positions(geometry: ShellGeometry) -> FloatArray:
    """Photogrammetry dots, ``(k, 3)``, shell axes, m: on each torus's aft crest, in the middle of every gore."""
    half = np.deg2rad(geometry.half_angle_deg)
    centres = np.column_stack(torus_circles(geometry))
    crest = centres + geometry.torus_minor_radius_m * np.array([np.sin(half), -np.cos(half)])
    return revolved(crest, seam_clocks_rad(geometry) + np.pi / geometry.gore_count).reshape(-1, 3)


def rim_curve(geometry: ShellGeometry, clock_lv_rad: FloatArray) -> FloatArray:
    """Circle of largest radius, ``(n, 3)`` at clocking angles ``(n,)``, shell axes, m."""
    station, radius = torus_circles(geometry)
    rim = np.array([[station[-1], radius[-1] + geometry.torus_minor_radius_m]])
    return revolved(rim, clock_lv_rad)[..., 0, :]


def torus_limb(
    geometry: ShellGeometry, viewpoint_shell_m: FloatArray, clock_lv_rad: FloatArray, torus_index: int = -1
) -> FloatArray:
    """Outboard edge of a torus as seen from a point: where lines of sight touch it.

    Parameters
    ----------
    geometry : ShellGeometry
    viewpoint_shell_m : (3,) float
        From the datum, shell axes, m; aft of the stack and inside the torus's hole.
    clock_lv_rad : (n,) float
        Clocking angles at which the edge is wanted, rad.
    torus_index : int
        The outermost by default: its edge is the shell's silhouette against the sky.

    Returns
    -------
    (n, 3) float
        Points of the torus, shell axes, m.

    Raises
    ------
    GateError
        When the viewpoint lies inside the torus, which has no edge then.

    Notes
    -----
    With the normal ``n = cos v e_r + sin v e_aft`` the touching condition ``(P - C) . n = 0`` is
    ``A cos v + B sin v = -a`` with ``A = r_i - C . e_r``, ``B = s_i - s_C``; of its two roots the aft one is the edge.
    """
    station, radius = torus_circles(geometry)
    minor = geometry.torus_minor_radius_m
    outboard = lv_direction(clock_lv_rad)
    a_term = radius[torus_index] - outboard @ viewpoint_shell_m
    b_term = np.full_like(a_term, station[torus_index] + viewpoint_shell_m[0])
    ratio = -minor / np.maximum(np.hypot(a_term, b_term), 1e-12)
    if (np.abs(ratio) >= 1.0).any():
        raise GateError(
            f"viewpoint {np.round(viewpoint_shell_m, 3).tolist()} m lies inside torus {torus_index}",
            code="camera-inside-shell",
        )
    v = np.arctan2(b_term, a_term) + np.arccos(ratio)
    points = (radius[torus_index] + minor * np.cos(v))[:, None] * outboard
    points[:, 0] = -(station[torus_index] + minor * np.sin(v))
    return points


def edge_circles(geometry: ShellGeometry, eye_shell_m: FloatArray, clock_lv_rad: FloatArray) -> FloatArray:
    """Circles in the half-planes at clocking angles ``(n,)`` whose limb is the shell's edge as seen from about a point.

    Returns
    -------
    (n, 3) float
        Station, radius, minor radius, m: of the outermost torus, or what stands for the mesh there.

    Raises
    ------
    GateError
        When no line of sight from ``eye_shell_m`` (3,), aft of the shell, touches the mesh.
    """
    if geometry.mesh is None:
        station, radius = torus_circles(geometry)
        return np.tile([station[-1], radius[-1], geometry.torus_minor_radius_m], (len(clock_lv_rad), 1))
    around, supports = geometry.mesh.supports
    at = np.mod(clock_lv_rad, 2.0 * np.pi)
    near = np.stack([np.interp(at, around, column, period=2.0 * np.pi) for column in supports.T], axis=1)
    across = lv_direction(clock_lv_rad) @ eye_shell_m
    circles = touching_circles(near, np.column_stack([np.full(len(at), -eye_shell_m[0]), across]))
    if not np.isfinite(circles).all():
        where = np.round(eye_shell_m, 3).tolist()
        raise GateError(f"the mesh of the aeroshell has no edge as seen from {where} m", code="mesh-unusable")
    return circles


def bend(points_shell_m: FloatArray, theta_rad: float, plane_lv_rad: float, joint_station_m: float) -> FloatArray:
    """Points ``(..., 3)`` of the shell, m, in body axes once the joint is bent by ``theta`` in the plane.

    The shell turns rigidly about ``(-joint_station_m, 0, 0)``; see `flightmodel.deflection` for the sign.
    """
    rotation = rotation_vector_body_shell(np.array(theta_rad), np.array(plane_lv_rad))
    dcm_body_shell = rotations.dcm_from_q(rotations.exp(rotation))
    joint = np.array([-joint_station_m, 0.0, 0.0])
    return (np.asarray(points_shell_m, dtype=float) - joint) @ dcm_body_shell.T + joint


def vehicle_meshes(
    geometry: ShellGeometry, clock_sections: int = 96, torus_sections: int = 24
) -> dict[str, trimesh.Trimesh]:
    """Triangle meshes by name, body axes of the unbent vehicle, m.

    ``torus_1`` (innermost) to ``torus_n`` are closed tori, ``forward_skin`` the nose cap and the cone's face up to the
    outermost torus, ``centerbody`` the cylinder from the nose station to its aft end.
    """
    import trimesh

    # trimesh revolves about z: z of its solids becomes the station, pointing aft
    axes = np.eye(4)
    axes[:3, :3] = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    meshes: dict[str, trimesh.Trimesh] = {}
    for i, (station, radius) in enumerate(zip(*torus_circles(geometry), strict=True)):
        meshes[f"torus_{i + 1}"] = trimesh.creation.torus(
            radius, geometry.torus_minor_radius_m, major_sections=clock_sections, minor_sections=torus_sections,
            transform=axes @ trimesh.transformations.translation_matrix([0.0, 0.0, station]),
        )  # fmt: skip
    meshes["forward_skin"] = trimesh.creation.revolve(
        forward_profile(geometry)[:, ::-1], sections=clock_sections, transform=axes
    )
    length = geometry.centerbody_length_m
    meshes["centerbody"] = trimesh.creation.cylinder(
        geometry.centerbody_radius_m, length, sections=clock_sections,
        transform=axes @ trimesh.transformations.translation_matrix([0.0, 0.0, 0.5 * length]),
    )  # fmt: skip
    return meshes


Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Faces = NDArray[np.int64]

KINDS = (".stl", ".obj", ".glb")
LARGEST_BYTES, MOST_FACES, MOST_NODES = 50_000_000, 500_000, 10_000
EMPTY = Issue("is empty: it has no face", "mesh-unusable")
UNITS_M = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "feet": 0.3048}
WRONG_UNIT, SUGGESTED = 1.6, 1.1  # units lie a factor of 2.5 apart; one that makes the size right to a tenth is named
SAME_RIM, SAME_END = 0.1, 0.25  # of the rim's radius, of the centerbody's length
NO_CIRCLE = 0.05  # of the rim's radius
_SECTIONS = 720  # half a degree apart: scallops of forty gores have nine degrees
NEAR_M = 0.001  # a lens sits on the very skin: from so far outboard of it a mesh is looked at
TO_CLOSE = "close it in the program that made it (export as a solid; mend holes and coinciding vertices)"


class MeshFile(Section):
    """A body's mesh: file, its unit, and how it lies in the vehicle; axes and ``nose`` are the file's own."""

    file: FileBeside
    unit_m: Annotated[float, Field(ge=1e-6, le=1e4)]
    forward: Axis
    zero_clock: Axis | None = None
    nose: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)

    def key_faults(self) -> Iterable[KeyFault]:
        """Yield inconsistencies between keys."""
        if Path(self.file).suffix.lower() not in KINDS:
            yield "file", self.file, f"a mesh ends in {', '.join(KINDS)}"
        if self.zero_clock is not None and self.zero_clock[-1] == self.forward[-1]:
            words = f"the axis towards clocking angle 0 lies across forward = '{self.forward}'"
            yield "zero_clock", self.zero_clock, words

    @property
    def rows(self) -> FloatArray:
        """Body axes in the file's, (3, 3). Without ``zero_clock`` the file's axis after ``forward`` is body y."""
        forward = _unit(self.forward)
        y = np.roll(np.abs(forward), 1) if self.zero_clock is None else -_unit(self.zero_clock)
        return np.stack([forward, y, np.cross(forward, y)])


class MeshFiles(Section):
    """The ``[meshes]`` of a vehicle file."""

    aeroshell: MeshFile | None = None
    centerbody: MeshFile | None = None


@dataclass(frozen=True)
class BodyMesh:
    """A closed mesh in the axes of the unbent vehicle.

    Parameters
    ----------
    vertices_m : (n, 3) float
        From the datum, body axes (the aeroshell's: shell axes).
    faces : (m, 3) int
    words : str
        What it is, and how its rim agrees with ``[geometry]``.
    apart : bool
        Whether the rim is where ``[geometry]`` has none: one of the two is not the vehicle's.
    rim : Rim or None
        An aeroshell's largest circle.
    """

    vertices_m: FloatArray
    faces: Faces
    words: str
    apart: bool = False
    rim: Rim | None = None

    @cached_property
    def supports(self) -> tuple[FloatArray, FloatArray]:
        """Clocking angles (k,), and the support of the mesh's section at each (`flightmodel.mesh_sections`)."""
        around = np.linspace(0.0, 2.0 * np.pi, _SECTIONS, endpoint=False)
        supports = section_supports(self.vertices_m, self.faces, around)
        cut = np.isfinite(supports[:, 0])
        return around[cut], supports[cut]


def body_meshes(
    spec: MeshFiles, folder: Path, geometry: ShellGeometry, lenses_m: dict[str, FloatArray]
) -> dict[str, BodyMesh]:
    """Read and check the meshes of a vehicle, by body.

    Parameters
    ----------
    spec : MeshFiles
    folder : Path
        Of the vehicle file.
    geometry : ShellGeometry
        What they must agree with.
    lenses_m : dict of str to (3,) float
        Where the vehicle's cameras are, body axes, m: none may lie inside a mesh.

    Raises
    ------
    ConfigError
        Where all faults are of the vehicle file's keys.
    GateError
        Where a mesh cannot be used; with every fault of both.
    """
    out: dict[str, BodyMesh] = {}
    faults: list[GateError] = []
    for body in ("aeroshell", "centerbody"):
        entry: MeshFile | None = getattr(spec, body)
        if entry is None:
            continue
        try:
            vertices, faces = read_mesh(folder / entry.file)
            out[body] = _laid(body, entry, vertices, faces, geometry)
            _check_lenses(f"meshes.{body}: {entry.file}", out[body], lenses_m)
        except GateError as fault:
            faults.append(fault)
    if faults:
        kind = ConfigError if all(isinstance(fault, ConfigError) for fault in faults) else GateError
        raise kind([words for fault in faults for words in fault.faults])
    return out


def read_mesh(path: Path) -> tuple[FloatArray, Faces]:
    """Vertices ``(n, 3)`` in the file's unit and faces ``(m, 3)`` of a closed mesh, equal vertices made one.

    Nothing but the file itself is read; it is refused before it is decoded where it would become too large.

    Raises
    ------
    ConfigError
        Where there is no such file.
    GateError
        Where it is too large, cut off, of another kind, empty, or not closed.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: {nothing_at(path)}; key 'meshes' names it", code="file-missing")
    try:
        data, kind = file_bytes(path, LARGEST_BYTES), path.suffix.lower()[1:]
    except UnfitFile as unfit:
        raise GateError(f"{path}: {unfit.strerror}", unfit.code) from None
    fault = {"stl": _fault_of_stl, "obj": _fault_of_obj, "glb": _fault_of_glb}[kind](data) if data else EMPTY
    if fault:
        raise GateError(f"{path}: {fault}", code=getattr(fault, "code", "file-unreadable"))
    vertices, faces = _decoded(path, data, kind)
    rest = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[rest]
    if len(faces) == 0:
        raise GateError(f"{path}: {EMPTY}", code=EMPTY.code)
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, count = np.unique(ends[:, 0] * len(vertices) + ends[:, 1], return_counts=True)
    odd = edges[count % 2 == 1]
    if len(odd):
        place = np.round(vertices[odd[0] // len(vertices)], 4).tolist()
        words = f"{len(odd)} of its {len(edges)} edges bound one face or three, the first at {place} in the file's unit"
        raise GateError(f"{path}: is not watertight: {words}; {TO_CLOSE}", code="mesh-unusable")
    return vertices, faces


def _decoded(path: Path, data: bytes, kind: str) -> tuple[FloatArray, Faces]:
    """Triangles of a file's bodies together, equal vertices made one."""
    import trimesh

    try:
        # from memory and without a resolver: materials and buffers in other files are not followed
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, skip_materials=True, process=False)
        parts = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
        solids = [part for part in parts if isinstance(part, trimesh.Trimesh)]
        total = sum(len(part.faces) for part in solids)
        if 0 < total <= MOST_FACES:
            whole = scene.to_mesh()
            is_finite = bool(np.isfinite(whole.vertices).all())
            mesh = trimesh.Trimesh(whole.vertices, whole.faces, process=True)
    except Exception as fault:  # a decoder of untrusted files raises whatever its parts raise
        raise GateError(
            f"{path}: cannot be decoded as {kind.upper()} ({type(fault).__name__}: {fault})", code="file-unreadable"
        ) from None
    if total == 0:
        raise GateError(f"{path}: {EMPTY}", code=EMPTY.code)
    if total > MOST_FACES:
        raise GateError(
            f"{path}: {total} faces where {MOST_FACES} at most are taken; thin it out", code="file-too-large"
        )
    if not is_finite:
        raise GateError(f"{path}: vertices are not finite numbers", code="not-finite")
    return np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)


def _too_many(count: int) -> str:
    return f"{count} faces where {MOST_FACES} at most are taken; thin it out" if count > MOST_FACES else ""


def _fault_of_stl(data: bytes) -> str:
    """Say why an STL file is not to be decoded; the count in a binary one's head must fit its size."""
    stated = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + 50 * stated:
        return _too_many(stated) if stated else EMPTY
    if data.lstrip()[:5].lower() == b"solid" and (b"facet" in data or b"endsolid" in data):
        if b"facet" not in data:
            return EMPTY
        if b"endsolid" not in data[-1000:]:
            return "is cut off: the last line, endsolid, is missing"
        return _too_many(data.count(b"endfacet"))
    if len(data) < 84:
        return f"is cut off: {len(data)} bytes where the head of a binary STL takes 84"
    words = f"its header states {stated} faces, which take {84 + 50 * stated} bytes, and it has {len(data)}"
    return f"is cut off or no STL: {words}"


def _fault_of_obj(data: bytes) -> str:
    """Return why an OBJ file is refused."""
    corners = [len(line.split()) - 1 for line in data.splitlines() if line.lstrip()[:2] == b"f "]
    return _too_many(sum(max(n - 2, 0) for n in corners)) if corners else EMPTY


def _fault_of_glb(data: bytes) -> str:
    """Return why a GLB file is refused: truncated, with external references, compressed, or larger than it looks."""
    if data[:4] != b"glTF" or len(data) < 20:
        return "is no GLB file, or cut off: it does not begin with glTF and a head of 20 bytes"
    stated, size = (int.from_bytes(data[k : k + 4], "little") for k in (8, 12))
    if stated != len(data):
        return f"is cut off: {len(data)} bytes where its header states {stated}"
    try:
        tree = json.loads(data[20 : 20 + size])
        accessors, nodes = tree.get("accessors", []), tree.get("nodes", [])
        largest = max((int(a.get("count", 0)) for a in accessors), default=0)
        elsewhere = [b["uri"] for b in tree.get("buffers", []) if "uri" in b]
        wanted, is_tree = tree.get("extensionsRequired", []), _is_forest(nodes)
    except (ValueError, TypeError, AttributeError, RecursionError):
        return "has no head that can be read"
    if elsewhere:
        return "keeps its numbers in another place; export one GLB file that holds everything"
    if wanted:
        return f"needs {', '.join(map(str, wanted))}; export without packing"
    if largest > 3 * MOST_FACES or len(nodes) > MOST_NODES or len(accessors) > MOST_NODES:
        return f"has more than {MOST_FACES} faces or {MOST_NODES} parts; thin it out"
    return "" if is_tree else "has a part that lies in itself or in two others"


def _is_forest(nodes: list[dict[str, Any]]) -> bool:
    """Whether every node of a GLB file has one parent at most and lies in no circle."""
    children = [int(child) for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children) or not all(0 <= child < len(nodes) for child in children):
        return False
    at, reached = sorted(set(range(len(nodes))) - set(children)), 0
    while at:
        reached += len(at)
        at = [int(child) for k in at for child in nodes[k].get("children", [])]
    return reached == len(nodes)


def _laid(body: str, spec: MeshFile, vertices: FloatArray, faces: Faces, geometry: ShellGeometry) -> BodyMesh:
    """Lay a mesh into the vehicle; refused where its size, rim or end contradicts ``[geometry]``."""
    key, named = f"key 'meshes.{body}", f"{spec.file}: "
    station, radius = torus_circles(geometry)
    rim_m, rim_station_m = float(radius[-1] + geometry.torus_minor_radius_m), float(station[-1])
    across, length = geometry.centerbody_radius_m, geometry.centerbody_length_m
    wanted_m = 2.0 * rim_m if body == "aeroshell" else max(length, 2.0 * across)
    size = float(np.ptp(vertices, axis=0).max())
    if not 1.0 / WRONG_UNIT < size * spec.unit_m / wanted_m < WRONG_UNIT:
        fits = {n: u for n, u in UNITS_M.items() if 1.0 / SUGGESTED < size * u / wanted_m < SUGGESTED}
        try_this = " or ".join(f"unit_m = {u:g} ({n})" for n, u in fits.items()) or f"unit_m = {wanted_m / size:.4g}"
        words = f"{named}would be {size * spec.unit_m:.4g} m in size where [geometry] has {wanted_m:.4g} m"
        raise ConfigError(
            f"{key}.unit_m' = {spec.unit_m:g}: {words}; try {try_this}, or correct [geometry]", code="mesh-unusable"
        )
    placed = spec.unit_m * (vertices - np.array(spec.nose)) @ spec.rows.T
    head = f"{named}{len(faces)} faces, {size * spec.unit_m:.3f} m in size"
    if body == "centerbody":
        # rounded, so that no end lies at -0
        ends = tuple(round(float(end), 4) + 0.0 for end in (-placed[:, 0].max(), -placed[:, 0].min()))
        if max(abs(ends[1] - length), abs(ends[0])) > max(SAME_END * length, 2.0 * across):
            words = f"reaches from station {ends[0]:.3f} to {ends[1]:.3f} m where [geometry] has 0 to {length:g} m"
            raise ConfigError(f"{key}': {named}{words}; check forward and nose", code="mesh-unusable")
        return BodyMesh(placed, faces, f"{head}, from station {ends[0]:.3f} to {ends[1]:.3f} m")
    front_m, turn_it = float(-placed[:, 0].max()), "check forward, zero_clock and nose"
    if front_m < -SAME_RIM * rim_m:
        tip = np.array(spec.nose) - (front_m / spec.unit_m) * spec.rows[0]
        words = f"reaches {-front_m:.3f} m ahead of the vehicle's nose; if forward is right, nose = {_shown(tip)}"
        raise ConfigError(f"{key}.nose' = {list(spec.nose)}: {named}{words}", code="mesh-unusable")
    rim = rim_circle(placed)
    if rim.rms_m > NO_CIRCLE * rim.radius_m:
        words = f"its outline from ahead is no circle (rms {rim.rms_m:.3f} m)"
        raise ConfigError(f"{key}.forward' = '{spec.forward}': {named}{words}; {turn_it}", code="mesh-unusable")
    off_m = float(np.hypot(*rim.centre_m))
    words = (
        f"rim of radius {rim.radius_m:.3f} m at station {rim.station_m:.3f} m, {off_m:.3f} m off the axis, where "
        f"[geometry] has {rim_m:.3f} m at {rim_station_m:.3f} m"
    )
    if max(abs(rim.radius_m - rim_m), off_m) > SAME_RIM * rim_m:
        allowed = f"{SAME_RIM * rim_m:.3f} m of difference is allowed"
        raise ConfigError(f"{key}': {named}{words}; {allowed}; {turn_it}, or correct [geometry]", code="mesh-unusable")
    apart = abs(rim.station_m - rim_station_m) > SAME_RIM * rim_m
    words += ", so one of the two is not the vehicle's: check forward and nose" if apart else ""
    return BodyMesh(placed, faces, f"{head}; {words}", apart, rim)


@dataclass(frozen=True)
class Rim:
    """Circle of a shell's largest radius.

    Parameters
    ----------
    centre_m : (2,) float
        Body y and z.
    radius_m, station_m : float
    rms_m : float
        Of the outline against the circle.
    """

    centre_m: FloatArray
    radius_m: float
    station_m: float
    rms_m: float


def rim_circle(points_m: FloatArray) -> Rim:
    """Circle fitted (Kasa) to the convex outline, seen from ahead, of points ``(n, 3)`` in body axes, m."""
    from scipy.spatial import ConvexHull

    hull = points_m[ConvexHull(points_m[:, 1:], qhull_options="QJ").vertices]
    design = np.column_stack([2.0 * hull[:, 1:], np.ones(len(hull))])
    (y, z, rest), *_ = np.linalg.lstsq(design, np.sum(hull[:, 1:] ** 2, axis=1), rcond=None)
    radius = float(np.sqrt(rest + y * y + z * z))
    rms = float(np.sqrt(np.mean((np.hypot(hull[:, 1] - y, hull[:, 2] - z) - radius) ** 2)))
    return Rim(np.array([y, z]), radius, float(np.median(-hull[:, 0])), rms)


def _check_lenses(named: str, mesh: BodyMesh, lenses_m: dict[str, FloatArray]) -> None:
    """Raise `ConfigError` naming the cameras whose lenses lie inside a mesh."""
    inside = [name for name, lens in lenses_m.items() if encloses(mesh, outboard(lens))]
    if inside:
        words = f"the lenses of {', '.join(inside)} lie inside it and would see nothing"
        raise ConfigError(
            f"{named}: {words}; leave their housings out of the mesh, or check forward, nose and cameras",
            code="mesh-unusable",
        )


def outboard(lens_m: FloatArray) -> FloatArray:
    """Point (3,) a little farther from the axis than a lens, which may lie on the very skin."""
    away = lens_m * np.array([0.0, 1.0, 1.0])
    return np.asarray(lens_m + NEAR_M * away / max(float(np.linalg.norm(away)), 1e-9))


def encloses(mesh: BodyMesh, point_m: FloatArray) -> bool:
    """Whether a point (3,), body axes, m, lies inside: a ray from it crosses an odd number of faces.

    Möller and Trumbore's test; the ray's direction is one that no face or edge of a drawing lies along.
    """
    direction = np.array([-0.2718281, 0.5772157, 0.7724538])
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    p = np.cross(direction, c - a)
    det = np.einsum("ni,ni->n", b - a, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ni,ni->n", point_m - a, p) / det
        q = np.cross(point_m - a, b - a)
        v, t = (q @ direction) / det, np.einsum("ni,ni->n", c - a, q) / det
        crossed = (u >= 0.0) & (v >= 0.0) & (u + v < 1.0) & (t > 0.0)
    return bool(crossed.sum() % 2)


def _shown(point: FloatArray) -> list[float]:
    return [float(f"{x:.5g}") + 0.0 for x in point]


def _unit(axis: Axis) -> FloatArray:
    return (-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[-1])]

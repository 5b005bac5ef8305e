"""What does the inflated aeroshell look like from its aft side?

A stack of ``n`` tori, tangent to one another along the generator of a cone of half-angle ``H`` that touches the nose
sphere of radius ``Rn``. In the half-plane (station aft of the nose ``s``, radius ``r``) the centre of torus ``i`` is

    (s_i, r_i) = (s_0, r_0) + i p (cos H, sin H),     s_0 = f(r_0 + a cos H) + a sin H,
    f(r) = Rn (1 - sin H) + (r - Rn cos H) / tan H    (the cone's forward face)

with minor radius ``a`` and spacing ``p``. Body axes: datum at the nose, x forward, so ``x = -s``. *Shell* axes equal
body axes when the joint is not bent; `bend` carries shell points to the body. Assumed: the skin follows the tori, the
shell bends nowhere but at the joint, gore seams are meridians of the aft side evenly clocked from 0 deg LV.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flightmodel import rotations
from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import lv_direction, rotation_vector_body_shell

if TYPE_CHECKING:
    import trimesh

    from flightmodel.vehicle import ShellGeometry


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
    """Points ``(..., m, 3)`` in shell axes, m, of a meridian ``(m, 2)`` at clocking angles ``(...)``."""
    outboard = lv_direction(np.asarray(clock_lv_rad, dtype=float))[..., None, :]
    station, radius = profile_station_radius_m.T
    return -station[:, None] * np.array([1.0, 0.0, 0.0]) + radius[:, None] * outboard


def seam_clocks_rad(geometry: ShellGeometry) -> FloatArray:
    """Clocking angles of the gore seams, ``(gore_count,)``, rad."""
    return 2.0 * np.pi * np.arange(geometry.gore_count) / geometry.gore_count


def seam_curves(geometry: ShellGeometry, points_per_torus: int = 25) -> FloatArray:
    """Gore seams on the aft side, ``(gore_count, m, 3)``, shell axes, m."""
    return revolved(aft_profile(geometry, points_per_torus), seam_clocks_rad(geometry))


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
        raise GateError(f"viewpoint {np.round(viewpoint_shell_m, 3).tolist()} m lies inside torus {torus_index}")
    v = np.arctan2(b_term, a_term) + np.arccos(ratio)
    points = (radius[torus_index] + minor * np.cos(v))[:, None] * outboard
    points[:, 0] = -(station[torus_index] + minor * np.sin(v))
    return points


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

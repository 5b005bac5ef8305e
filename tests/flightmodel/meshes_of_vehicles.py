"""Meshes of a vehicle's own shape, as another program would write them: in another unit, along another axis."""

import numpy as np
import trimesh

from flightmodel.geometry import aft_profile, forward_profile

SOLID = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # trimesh revolves about z, here the station


def shell_mesh(geometry, sections=120):
    """Closed skin of the shell, body axes, m: forward skin, tori from aft, and a disc inside the innermost."""
    aft = aft_profile(geometry)[::-1]
    meridian = np.concatenate([forward_profile(geometry), aft, [[aft[-1, 0], 0.0]]])
    mesh = trimesh.creation.revolve(meridian[:, ::-1], sections=sections)
    return trimesh.Trimesh(mesh.vertices @ SOLID.T, mesh.faces)


def centerbody_mesh(geometry, sections=120):
    length = geometry.centerbody_length_m
    mesh = trimesh.creation.cylinder(geometry.centerbody_radius_m, length, sections=sections)
    mesh.apply_translation([0.0, 0.0, 0.5 * length])
    return trimesh.Trimesh(mesh.vertices @ SOLID.T, mesh.faces)


def as_drawn(mesh, unit_m=0.001, shift=(12.0, -7.0, 55.0)):
    """The mesh with z forward and -x towards clocking angle 0 (so y is body z), elsewhere, in another unit."""
    x, y, z = np.asarray(mesh.vertices).T / unit_m
    return trimesh.Trimesh(np.column_stack([y, z, x]) + np.array(shift), mesh.faces)

"""The rasteriser against ray casting by another library, and against the ray-marched film of the same shell."""

import numpy as np
import pytest
import trimesh

from flightmodel.camera import Camera, camera_from_mount
from flightmodel.geometry import bend, vehicle_meshes
from flightmodel.rendering import render
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D

LENSES = {
    "fisheye": ([180.0, 176.0], [-0.02, 0.006, -0.002, 0.0003]),
    "pinhole": ([210.0, 214.0], [-0.05, 0.01, 0.001, -0.0007]),
}


def asymmetric_scene():
    """Half buried boxes, a slanted torus and a triangle that passes behind the camera."""
    parts = [
        trimesh.creation.torus(0.8, 0.25, transform=trimesh.transformations.euler_matrix(0.4, 0.9, 0.0)),
        trimesh.creation.box([0.5, 0.9, 0.3], transform=trimesh.transformations.translation_matrix([0.9, -0.5, 0.6])),
        trimesh.creation.icosphere(subdivisions=3, radius=0.35).apply_translation([-0.6, 0.7, -0.5]),
        trimesh.Trimesh([[-4.0, -3.0, 1.2], [5.0, -2.0, 1.0], [0.5, 0.0, -9.0]], [[0, 1, 2]]),
    ]
    return trimesh.util.concatenate(parts)


def cast(camera, mesh):
    """Distance along every pixel's ray, infinite without a hit, by embree."""
    v, u = np.indices((camera.height_px, camera.width_px), dtype=float)
    rays = camera.rays_body(np.column_stack([u.ravel(), v.ravel()]))
    looks = np.isfinite(rays[:, 0])
    origin = np.tile(camera.position_body_m, (looks.sum(), 1))
    places, ray, _ = mesh.ray.intersects_location(origin, rays[looks], multiple_hits=False)
    depth = np.full(len(rays), np.inf)
    depth[np.flatnonzero(looks)[ray]] = np.linalg.norm(places - camera.position_body_m, axis=1)
    return depth.reshape(v.shape), looks.reshape(v.shape)


@pytest.mark.parametrize("lens", LENSES)
def test_the_picture_is_that_of_ray_casting(lens):
    assert trimesh.ray.has_embree, "embreex is a test dependency"
    focal, distortion = LENSES[lens]
    eye = np.array([0.1, 0.2, -2.4])
    look = -eye / np.linalg.norm(eye)
    side = np.cross([0.2, 1.0, 0.1], look)
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(look, side), look])
    camera = Camera(480, 360, np.array(focal), np.array([236.2, 181.7]), np.array(distortion), eye, axes, lens)
    mesh = asymmetric_scene()
    picture = render(camera, mesh.vertices, mesh.faces)
    depth, looks = cast(camera, mesh)
    theirs, ours = np.isfinite(depth), picture.is_hit & looks
    assert 0.2 < theirs.mean() < 0.9
    assert (theirs & ours).sum() / (theirs | ours).sum() > 0.999
    both = theirs & ours
    off = np.abs(depth[both] - picture.depth_m[both]) / depth[both]
    # straight edges and linear distances over up to five degrees; a thousandth of the pixels lies at a step of depth
    assert np.quantile(off, 0.5) < 2e-3
    assert np.quantile(off, 0.99) < 0.02


def test_the_vehicle_is_that_of_ray_casting():
    camera = camera_from_mount(MOUNT)
    vertices, faces, count = [], [], 0
    for name, mesh in vehicle_meshes(GEOMETRY, 72, 20).items():
        points = np.asarray(mesh.vertices)
        vertices.append(points if name == "centerbody" else bend(points, D(4.0), D(190.0), JOINT_M))
        faces.append(np.asarray(mesh.faces) + count)
        count += len(points)
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    picture = render(camera, mesh.vertices, mesh.faces)
    depth, looks = cast(camera, mesh)
    theirs, ours = np.isfinite(depth), picture.is_hit & looks
    assert (theirs & ours).sum() / (theirs | ours).sum() > 0.999

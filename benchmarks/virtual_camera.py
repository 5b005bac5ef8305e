"""Speed of the virtual camera as ratios in one run: a frame's fit, 500 frames from a film, a rendered picture.

    python benchmarks/virtual_camera.py

Peers: scipy's least squares over OpenCV's fisheye projection, given the edge points and marks that ours must find
first, and the same eight unknowns; trimesh with embreex (one ray a pixel), and open3d where it is installed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).parents[1]))

from estimators.benchmark import orient_camera
from estimators.camera_deflection import deflection_from_frames
from estimators.camera_fit import REACH_PX
from estimators.horizon import find_horizon
from estimators.raster import render
from estimators.seen import found_marks
from flightmodel import rotations
from flightmodel.film import film_frames
from flightmodel.geometry import torus_limb
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film


def best(job: Callable[[], object], repeats: int = 9) -> float:
    """Shortest time of a job, ms."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def scipy_fit(oriented, image) -> Callable[[], object]:
    """Fit the same points with scipy and OpenCV; what was found is given."""
    view, marks = oriented.view, oriented.marks
    horizon = find_horizon(image, oriented.lines, view.camera.size_px)
    answer = oriented.fit(image)
    bending = np.array([*answer.rotation_yz_rad, answer.flattening_rad])
    place, sd = found_marks(view, marks, image, bending, REACH_PX)
    has = np.isfinite(sd)
    camera, joint = view.camera, view.joint_m
    matrix = np.array(
        [[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]]
    )

    def project(points: np.ndarray) -> np.ndarray:
        cam = np.ascontiguousarray(camera.cam_from_body(points)[:, None])
        return cv2.fisheye.projectPoints(cam, np.zeros(3), np.zeros(3), matrix, camera.distortion)[0].reshape(-1, 2)

    def residuals(p: np.ndarray) -> np.ndarray:
        turn = rotations.dcm_from_q(rotations.exp(np.array([0.0, p[0], p[1]])))
        eye = turn.T @ (camera.position_body_m - joint) + joint
        limb = project((torus_limb(GEOMETRY, eye, view.clocks_rad[40:-40]) - joint) @ turn.T + joint)
        spots = project((marks.points_shell_m[has] - joint) @ turn.T + joint)
        # the edge as a function of the column is enough for a peer that is only timed
        order = np.argsort(limb[:, 0])
        edge = horizon.points_px[:, 1] - np.interp(horizon.points_px[:, 0], limb[order, 0], limb[order, 1])
        side = (horizon.points_px[:, 0] - 360.0) / 360.0
        edge -= p[2] + p[3] * side + p[4] * side**2
        painted = place[has] - np.einsum("ni,ni->n", spots, marks.across_px[has])
        return np.concatenate([edge, painted, p[2:] / 0.28])

    return lambda: least_squares(residuals, np.zeros(5), x_scale=[0.05, 0.05, 1, 1, 1], loss="huber")


def main() -> None:
    """Measure and print."""
    cv2.setNumThreads(1)
    frames = film(0, [0.0, 4.1], [0.0, 188.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    start = oriented.fit(frames[1]).rotation_yz_rad
    ours = best(lambda: oriented.fit(frames[1], None, start), 30)
    peer = best(scipy_fit(oriented, frames[1]), 15)
    print(f"fit of a frame, search included: {ours:.2f} ms")
    print(f"scipy over OpenCV, points given: {peer:.2f} ms; {peer / ours:.1f}x")

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (720, 480))
        for k in range(500):
            writer.write(cv2.cvtColor(frames[min(k, 1)], cv2.COLOR_GRAY2BGR))
        writer.release()
        times = 421.0 + 0.1 * np.arange(500)
        begin = time.perf_counter()
        for _ in film_frames(path, list(range(500))):
            pass
        decoded = time.perf_counter() - begin
        begin = time.perf_counter()
        pictures = film_frames(path, list(range(500)))
        deflection_from_frames(times, pictures, GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None, benchmark=frames[0])
        print(f"500 frames of a film: {time.perf_counter() - begin:.2f} s, of it decoding {decoded:.2f} s")

    shell = trimesh.creation.torus(1.2, 0.25, major_sections=160, minor_sections=62)
    axes = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    mesh = trimesh.Trimesh(np.asarray(shell.vertices) @ axes.T + [-0.4, 0.0, 0.0], shell.faces, process=False)
    camera = oriented.view.camera
    v, u = np.indices((480, 720), dtype=float)
    rays = camera.rays_body(np.column_stack([u.ravel(), v.ravel()]))
    rays = rays[np.isfinite(rays[:, 0])]
    eyes = np.tile(camera.position_body_m, (len(rays), 1))
    assert trimesh.ray.has_embree
    mesh.ray.intersects_first(eyes[:10], rays[:10])
    ours = best(lambda: render(camera, mesh.vertices, mesh.faces))
    peer = best(lambda: mesh.ray.intersects_first(eyes, rays), 5)
    print(f"render of {len(mesh.faces)} triangles, 720 x 480: {ours:.1f} ms")
    print(f"trimesh with embreex: {peer:.0f} ms; {peer / ours:.1f}x")
    try:
        import open3d
    except ImportError:
        print("open3d is not installed")
        return
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.uint32))
    both = open3d.core.Tensor(np.column_stack([eyes, rays]).astype(np.float32))
    peer = best(lambda: scene.cast_rays(both), 5)
    print(f"open3d {peer:.1f} ms; {peer / ours:.1f}x")


if __name__ == "__main__":
    main()

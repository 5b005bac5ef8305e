"""Speed of the virtual camera as ratios in one run: a frame's fit, 500 frames from a film, a rendered picture.

    python benchmarks/virtual_camera.py [FLIGHT]

On FLIGHT (a folder of `postflight simulate`) also the answer of two cameras, which show the same film, against that of
one. Peers: scipy's least squares over OpenCV's fisheye projection, in two ways. Like for like, both get the same edge
points and marks and solve the same residuals for the same nineteen unknowns, with the same priors and Huber's weights;
scipy gets the derivatives by all that is linear, and differences the other three. Of a whole frame, ours searches for
what scipy is given, with five unknowns, and tests the answer. The same rasteriser in plain C++ (needs g++); trimesh
with embreex (one ray a pixel), and open3d where it is installed. Jobs take turns; times are minima, of the wall and of
the processor with all threads.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).parents[1]))

from estimators.benchmark import orient_camera
from estimators.camera import read_film
from estimators.camera_fit import REACH_PX
from estimators.edge import find_horizon
from estimators.frame_residuals import HUBER
from estimators.virtual_camera import JOINT
from flightmodel import rotations
from flightmodel.camera import Camera, camera_from_mount
from flightmodel.film import film_frames
from flightmodel.geometry import torus_circles, torus_limb
from flightmodel.rendering import render
from postflight.filming import camera_answer
from postflight.flight import Flight, read_flight
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, film

SOURCE = Path(__file__).parent / "plain_cpp" / "raster.cpp"
ROUNDS, FRAMES = 25, 500
_SWING = 10  # frames of a swing, at 10 Hz


def rounds(jobs: dict[str, Callable[[], object]], repeats: int) -> dict[str, tuple[float, float]]:
    """Shortest wall and processor time of jobs that take turns, ms."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            wall, worked = time.perf_counter(), time.process_time()
            job()
            times[name].append((time.perf_counter() - wall, time.process_time() - worked))
    return {name: (1e3 * min(w for w, _ in t), 1e3 * min(c for _, c in t)) for name, t in times.items()}


def print_ratios(measured: dict[str, tuple[float, float]], ours: str) -> None:
    """Print times, and how many times ours they are."""
    for name, (wall, worked) in measured.items():
        ratios = f"{wall / measured[ours][0]:6.2f} {worked / measured[ours][1]:6.2f}"
        print(f"  {name:42} wall {wall:7.2f} ms, processor {worked:7.2f} ms; of ours {ratios}", flush=True)


def scipy_fit(oriented, image, start: np.ndarray) -> Callable[[], object]:
    """Fit the same points with scipy and OpenCV, from a deflection (2,); what was found is given."""
    view, marks = oriented.view, oriented.features
    horizon = find_horizon(image, oriented.lines, view.camera.size_px)
    answer = oriented.fit(image)
    bending = np.array([*answer.rotation_yz_rad, answer.flattening_rad])
    place, sd = marks.find(view, image, bending, REACH_PX)
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

    return lambda: least_squares(residuals, np.append(start, np.zeros(3)), x_scale=[0.05, 0.05, 1, 1, 1], loss="huber")


def given_points_jobs(oriented, image, near: np.ndarray, far: np.ndarray) -> dict[str, Callable[[], object]]:
    """Fit the same residuals of the same points, from two deflections (2,): the compiled fit, and scipy over OpenCV."""
    view, marks, lens = oriented.view, oriented.features, oriented.view.camera
    answer = oriented.fit(image)
    bending = np.array([*answer.rotation_yz_rad, answer.flattening_rad])
    horizon, place = answer.horizon, marks.find(view, image, bending, REACH_PX)

    def ours(start: np.ndarray) -> np.ndarray:
        deformation = np.array([*start, 0.0])
        return np.append(deformation, oriented._solve(horizon, place, deformation, np.eye(2), np.inf).rms_px)

    # what is given: the points used, their weights, residuals of the benchmark frame, and columns of what is linear
    found = oriented._fit_points(horizon, place, bending.copy(), np.eye(2))
    used = found.weight > 0.0
    edge = np.flatnonzero(used[: found.edge_points])
    features = np.flatnonzero(used[found.edge_points :])
    before = oriented.benchmark_residuals.residual_px[found.benchmark_at[used]]
    huber = np.maximum(1.0, np.abs(found.left_px[used]) * np.sqrt(found.weight[used]) / HUBER)
    root = np.sqrt(found.weight[used] * huber)
    linear = np.column_stack([found.rows[used, JOINT], found.shape[used]])
    per_sd = np.diag(1.0 / oriented._shape_sd)
    clocks = oriented.clocks_rad[horizon.line[edge]]
    station, radius = (circle[0] for circle in torus_circles(GEOMETRY))
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    matrix, joint = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), view.joint_m
    across = np.concatenate([horizon.inward_px[edge], marks.across_px[features]])
    measured = np.concatenate([np.einsum("ni,ni->n", horizon.points_px[edge], across[: len(edge)]), place[0][features]])

    def off(p: np.ndarray) -> np.ndarray:
        """Found less predicted (n,) of deflection (2,) and flattening, beyond the benchmark's."""
        turn = rotations.dcm_from_q(rotations.exp(np.array([0.0, p[0], p[1]])))
        eye = turn.T @ (lens.position_body_m - joint) + joint
        points = np.concatenate([torus_limb(GEOMETRY, eye, clocks), marks.points_shell_m[features]])
        away = np.hypot(points[:, 1], points[:, 2])
        points[:, 1:] *= (1.0 + p[2] * (points[:, 0] + station) / away)[:, None]
        points[:, 0] -= p[2] * (away - radius)
        cam = np.ascontiguousarray(lens.cam_from_body((points - joint) @ turn.T + joint)[:, None])
        pixels = cv2.fisheye.projectPoints(cam, np.zeros(3), np.zeros(3), matrix, lens.distortion)[0].reshape(-1, 2)
        return measured - np.einsum("ni,ni->n", pixels, across) - before

    def residuals(p: np.ndarray) -> np.ndarray:
        return np.concatenate([root * (off(p[:3]) - linear @ p[3:]), per_sd @ p[2:]])

    def derivatives(p: np.ndarray) -> np.ndarray:
        here, out = off(p[:3]), np.zeros((len(root) + len(per_sd), len(p)))
        for k, step in enumerate(1e-6 * np.eye(3)):
            out[: len(root), k] = root * (off(p[:3] + step) - here) / 1e-6
        out[: len(root), 3:], out[len(root) :, 2:] = -root[:, None] * linear, per_sd
        return out

    def peer(start: np.ndarray) -> np.ndarray:
        scale = np.concatenate([[0.05, 0.05], oriented._shape_sd])
        begin = np.append(start, np.zeros(len(scale) - 2))
        return least_squares(
            residuals, begin, derivatives, x_scale=scale, loss="huber", f_scale=HUBER, xtol=1e-5, ftol=1e-6
        ).x  # fmt: skip

    # the same residuals have the same answer
    np.testing.assert_allclose(peer(near)[:2], ours(near)[:2], atol=np.deg2rad(1e-3))
    return {
        "ours, the points given": lambda: ours(near),
        "ours, the same from an undeflected shell": lambda: ours(far),
        "scipy over OpenCV, the same residuals": lambda: peer(near),
        "scipy, the same from an undeflected shell": lambda: peer(far),
    }


def fit_jobs() -> tuple[dict[str, Callable[[], object]], dict[str, Callable[[], object]]]:
    """Of given points, and of a whole frame."""
    frames = film(0, [0.0, 4.1], [0.0, 188.0])
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    near, far = oriented.fit(frames[1]).rotation_yz_rad, np.zeros(2)
    return given_points_jobs(oriented, frames[1], near, far), {
        "ours, edge and marks searched for": lambda: oriented.fit(frames[1], None, near),
        "ours, from an undeflected shell": lambda: oriented.fit(frames[1], None, far),
        "scipy over OpenCV, points given": scipy_fit(oriented, frames[1], near),
        "scipy, from an undeflected shell": scipy_fit(oriented, frames[1], far),
    }


def time_a_film() -> None:
    """Five hundred frames of a shell that swings, decoding included, and decoding alone.

    No frame equals the one before: that would be refused as a copy, unread.
    """
    swing = 4.1 + 0.5 * np.sin(np.arange(_SWING) * 2.0 * np.pi / _SWING)
    frames = film(0, [0.0, *swing], [0.0, *[188.0] * _SWING])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (720, 480))
        for k in range(FRAMES):
            writer.write(cv2.cvtColor(frames[1 + k % _SWING if k else 0], cv2.COLOR_GRAY2BGR))
        writer.release()
        times = 421.0 + 0.1 * np.arange(FRAMES)

        def pictures():
            return film_frames(path, list(range(FRAMES)))

        def estimate():
            read = read_film(times, pictures(), GEOMETRY, MOUNT, JOINT_M, plane_lv_rad=None, benchmark=frames[0])
            assert not any(fit.refused for fit in read.fits)
            read.history()

        print_ratios(
            rounds({f"{FRAMES} frames": estimate, "of it decoding": lambda: deque(pictures(), 0)}, 3),
            f"{FRAMES} frames",
        )


def time_two_cameras(folder: Path) -> None:
    """The history of a folder's one film, and of two cameras that show it."""
    flight = read_flight(folder)
    ((name, frames),) = flight.telemetry.films.items()

    def answer(*names: str) -> object:
        films = {name: replace(frames) for name in names}  # anew, as what a film remembers of its pictures takes time
        return camera_answer(Flight(replace(flight.telemetry, films=films)))

    jobs = {"one camera": lambda: answer(name), "two cameras": lambda: answer(name, "second")}
    print_ratios(rounds(jobs, 5), "one camera")


def fine_torus(across: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a torus around the camera's view, ``2 * 160 * across`` triangles or so."""
    shell = trimesh.creation.torus(1.1, 0.6, major_sections=160, minor_sections=across)
    axes = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    return np.ascontiguousarray(np.asarray(shell.vertices) @ axes.T + [-0.4, 0.0, 0.0]), np.asarray(shell.faces)


def plain_cpp(camera: Camera, vertices: np.ndarray, faces: np.ndarray, folder: str) -> Callable[[], np.ndarray]:
    """The C++ rasteriser, ready to run; it returns the picture of faces."""
    target = Path(folder) / "raster.so"
    flags = ["-std=c++17", "-O3", "-march=native", "-shared", "-fPIC"]
    subprocess.run(["g++", *flags, str(SOURCE), "-o", str(target)], check=True)
    run = ctypes.CDLL(str(target)).raster
    doubles, longs = ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_long)
    lens = (camera.focal_px, camera.centre_px, camera.distortion, camera.position_body_m, camera.dcm_cam_body)
    kept = [np.ascontiguousarray(part, dtype=float) for part in lens]
    shape = (camera.height_px, camera.width_px)

    def job() -> np.ndarray:
        depth, nearest = np.full(shape, np.inf), np.full(shape, -1, dtype=np.int64)
        run(
            vertices.ctypes.data_as(doubles), ctypes.c_long(len(vertices)),
            faces.ctypes.data_as(longs), ctypes.c_long(len(faces)),
            *(part.ctypes.data_as(doubles) for part in kept), ctypes.c_double(camera.half_field_rad),
            ctypes.c_long(shape[1]), ctypes.c_long(shape[0]),
            depth.ctypes.data_as(doubles), nearest.ctypes.data_as(longs),
        )  # fmt: skip
        return nearest

    return job


def ray_casters(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> dict[str, Callable[[], object]]:
    """One ray a pixel through embree, by trimesh and by open3d where that is installed."""
    v, u = np.indices((camera.height_px, camera.width_px), dtype=float)
    rays = camera.rays_body(np.column_stack([u.ravel(), v.ravel()]))
    rays = rays[np.isfinite(rays[:, 0])]
    eyes = np.tile(camera.position_body_m, (len(rays), 1))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert trimesh.ray.has_embree
    mesh.ray.intersects_first(eyes[:10], rays[:10])
    jobs: dict[str, Callable[[], object]] = {"trimesh with embreex": lambda: mesh.ray.intersects_first(eyes, rays)}
    try:
        import open3d
    except ImportError:
        print("open3d is not installed")
        return jobs
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    both = open3d.core.Tensor(np.column_stack([eyes, rays]).astype(np.float32))
    jobs["open3d, all cores"] = lambda: scene.cast_rays(both)
    jobs["open3d, one thread"] = lambda: scene.cast_rays(both, 1)
    return jobs


def main() -> None:
    """Measure and print."""
    cv2.setNumThreads(1)
    given, whole = fit_jobs()
    print("fit of a frame's points, given to both")
    print_ratios(rounds(given, ROUNDS), "ours, the points given")
    print("a whole frame, searches and checks included, over a peer that is given the points")
    print_ratios(rounds(whole, ROUNDS), "ours, edge and marks searched for")
    print("a film")
    time_a_film()
    for folder in sys.argv[1:]:
        time_two_cameras(Path(folder))
    mount = MOUNT.model_copy(update={"width_px": 640, "height_px": 480, "centre_px": (320.0, 240.0)})
    camera = camera_from_mount(mount)
    for across in (63, 313):
        vertices, faces = fine_torus(across)
        with tempfile.TemporaryDirectory() as folder:
            theirs = plain_cpp(camera, vertices, faces, folder)
            picture = render(camera, vertices, faces)
            same = np.mean(theirs() == picture.face)
            print(f"{len(faces)} triangles, fisheye of 640 x 480, {100 * picture.is_hit.mean():.0f} % covered; "
                  f"C++ sees the same face in {100 * same:.2f} % of the pixels")  # fmt: skip
            jobs = {"ours": lambda v=vertices, f=faces: render(camera, v, f), "plain C++": theirs}
            print_ratios(rounds(jobs | ray_casters(camera, vertices, faces), ROUNDS), "ours")


if __name__ == "__main__":
    main()

"""Projection of the deformed shell in plain numpy and OpenCV, derivatives by differences.

A point of the unbent shell is flattened about its ring (station aft, radius), turned about the joint by a rotation
vector (0, y, z), looked at by a camera and put through its lens. `project` does that; every derivative of the compiled
projection is a central difference of it.
"""

import cv2
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation


def flattened(points, flattening, ring):
    """Points (n, 3), m: turned outwards about the ring of station and radius ``ring``, to first order as a wedge."""
    station, radius = ring
    r = np.hypot(points[:, 1], points[:, 2])
    outboard = points[:, 1:] / r[:, None]
    aft, outwards = -points[:, 0] - station, r - radius
    x = points[:, 0] - flattening * outwards
    return np.column_stack([x, (r - flattening * aft)[:, None] * outboard])


def project(points, bending, joint_m, ring, camera, turn=(0.0, 0.0, 0.0), scale=1.0, shell=0.0):
    """Pixels (n, 2) of points (n, 3) of the unbent shell; ``bending`` (3,): rotation vector y, z, and flattening.

    ``turn``: of the scene in camera axes; ``scale``: on the focal length; ``shell``: by what all radii have grown, m.
    """
    flat = flattened(points, bending[2], ring)
    outboard = points[:, 1:] / np.hypot(points[:, 1], points[:, 2])[:, None]
    flat = flat + shell * np.column_stack([np.zeros(len(points)), outboard])
    joint = np.array([-joint_m, 0.0, 0.0])
    body = Rotation.from_rotvec([0.0, bending[0], bending[1]]).apply(flat - joint) + joint
    cam = (body - camera.position_body_m) @ camera.dcm_cam_body.T
    cam = Rotation.from_rotvec(turn).apply(cam)
    matrix = np.array([[scale * camera.focal_px[0], 0.0, camera.centre_px[0]],
                       [0.0, scale * camera.focal_px[1], camera.centre_px[1]], [0.0, 0.0, 1.0]])  # fmt: skip
    scene, still = np.ascontiguousarray(cam[:, None, :]), np.zeros(3)
    if camera.lens == "fisheye":
        return cv2.fisheye.projectPoints(scene, still, still, matrix, camera.distortion)[0].reshape(-1, 2)
    return cv2.projectPoints(scene, still, still, matrix, camera.distortion)[0].reshape(-1, 2)


def limb(circle, eye, clocks):
    """Outboard edge (n, 3) of a torus of station, radius, minor radius: of all its circle's points where sight touches.

    Found by looking: along each meridian's circle the normal's angle at which the line of sight is across it.
    """
    station, radius, minor = circle
    out, aft = [], np.array([-1.0, 0.0, 0.0])
    for clock in clocks:
        outboard = np.array([0.0, -np.cos(clock), np.sin(clock)])
        centre = station * aft + radius * outboard

        def place(v, centre=centre, outboard=outboard):
            return centre + minor * (np.cos(v) * outboard + np.sin(v) * aft)

        def across(v, centre=centre, place=place):
            return float((place(v) - centre) @ (place(v) - eye))

        v = np.linspace(-np.pi, np.pi, 721)
        values = np.array([across(x) for x in v])
        roots = [brentq(across, v[k], v[k + 1], xtol=1e-13) for k in np.flatnonzero(values[:-1] * values[1:] <= 0.0)]
        # of the two, the one farther outboard
        out.append(max((place(x) for x in roots), key=lambda point, outboard=outboard: point @ outboard))
    return np.array(out)


def distance_from_line(point, vertices):
    """Distance (px) of a point from a polyline (n, 2), and the foot in vertices, by trying every segment."""
    best = (np.inf, 0.0)
    for j in range(len(vertices) - 1):
        along = vertices[j + 1] - vertices[j]
        share = np.clip((point - vertices[j]) @ along / (along @ along), 0.0, 1.0)
        away = np.linalg.norm(point - vertices[j] - share * along)
        best = min(best, (away, j + share))
    return best

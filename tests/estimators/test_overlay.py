"""Own meshes in the overlay: where the vehicle's own bodies are drawn, deflected like them, hidden like them."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from estimators.overlay import Overlay, centerbody_pixels, write_lines
from estimators.virtual_camera import VirtualCamera
from flightmodel.camera import camera_from_mount
from flightmodel.geometry import BodyMesh, read_mesh
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D
from tests.flightmodel.meshes_of_vehicles import centerbody_mesh, shell_mesh

REALDATA = Path(os.environ.get("POSTFLIGHT_REALDATA", "/nowhere")) / "mesh"


def body_mesh(mesh):
    return BodyMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), "")


@pytest.fixture(scope="module")
def view():
    return VirtualCamera(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)


def same(a, b):
    return (a & b).sum() / (a | b).sum()


def test_a_mesh_of_the_vehicles_own_shape_covers_the_same_pixels(view):
    stacked = Overlay(view)
    own = Overlay(view, {"aeroshell": body_mesh(shell_mesh(GEOMETRY, 240))})
    both = Overlay(
        view, {"aeroshell": own.meshes["aeroshell"], "centerbody": body_mesh(centerbody_mesh(GEOMETRY, 720))}
    )
    for theta, plane in ((0.0, 0.0), (4.0, 190.0)):
        _, wanted = stacked.view_of(D(theta), D(plane))
        _, shell = own.view_of(D(theta), D(plane))
        # straight sides of 24 and 25 sections a torus, of 72 and 240 around
        assert same(shell, wanted) > 0.99
        picture, drawn = both.view_of(D(theta), D(plane))
        behind = np.isfinite(both.before_m)
        # the cylinder fills the lower border; its corners lie up to 2 um inside the round one
        assert same(behind, centerbody_pixels(view)) > 0.98
        assert same(drawn & ~behind, wanted & ~behind) > 0.99
        red, _, blue = picture[behind].mean(axis=0)
        assert red > blue  # the centerbody has a colour of its own
    assert same(stacked.view_of(D(4.0), D(190.0))[1], stacked.view_of(0.0, 0.0)[1]) < 0.99


def test_lines_lie_where_faces_meet_sharply(view):
    """Between tori of a fine mesh, not around each of its triangles."""
    own = Overlay(view, {"aeroshell": body_mesh(shell_mesh(GEOMETRY, 240))})
    sharp = np.unique(own.shell.piece)
    assert len(sharp) < 60 < len(own.shell.faces) / 100


def test_what_stands_before_the_shell_hides_it(view):
    mast = trimesh.creation.box([0.02, 0.10, 0.10])
    away = np.array([view.camera.position_body_m + 0.4 * view.camera.dcm_cam_body[2]])
    mast.apply_translation(away[0])
    overlay = Overlay(view, {"centerbody": body_mesh(mast)})
    pixel = np.rint(view.camera.project(away)[0]).astype(int)
    picture, drawn = overlay.view_of(0.0, 0.0)
    red, _, blue = picture[pixel[1], pixel[0]].astype(int)
    assert drawn[pixel[1], pixel[0]]
    assert red > blue
    far = BodyMesh(np.asarray(mast.vertices) + 3.0 * view.camera.dcm_cam_body[2], np.asarray(mast.faces), "")
    red, _, blue = Overlay(view, {"centerbody": far}).view_of(0.0, 0.0)[0][pixel[1], pixel[0]].astype(int)
    assert red < blue


@pytest.mark.realdata
@pytest.mark.skipif(not REALDATA.is_dir(), reason="POSTFLIGHT_REALDATA names no meshes")
def test_a_real_capsule_is_drawn(view):
    vertices, faces = read_mesh(REALDATA / "orion_full.stl")
    # heat shield towards -y, 3 m wide, its front at the nose; the lens lies inside such a capsule: it is moved aft
    placed = 0.184 * (vertices - [0.0, -2.6, 0.0])[:, [1, 0, 2]] * [-1.0, 1.0, 1.0] + [1.0, 0.0, 0.0]
    overlay = Overlay(view, {"aeroshell": BodyMesh(placed, faces, "")})
    _, drawn = overlay.view_of(D(2.0), D(180.0))
    assert drawn.sum() > 1000


def test_letters_are_white_with_a_black_rim_of_a_pixel_to_the_end_of_a_line():
    picture = np.full((40, 600, 3), 128, dtype=np.uint8)
    write_lines(picture, ["t = 440.624 s, theta 4.87 +/- 0.06 deg, in the plane of 120 deg"])
    white, black = ((value[..., 0].any(axis=0)).nonzero()[0] for value in (picture > 200, picture < 60))
    assert white[-1] > 300
    assert white[0] - 2 <= black[0] <= white[0]
    assert white[-1] <= black[-1] <= white[-1] + 2

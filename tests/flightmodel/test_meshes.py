"""Meshes of a user's own: read from three kinds of file, laid into the vehicle, refused in words."""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flightmodel.checks import ConfigError
from flightmodel.geometry import LARGEST_BYTES, BodyMesh, encloses, read_mesh, rim_circle
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from tests.flightmodel.meshes_of_vehicles import as_drawn, centerbody_mesh, shell_mesh
from tests.refusing import refuses

REFERENCE = vehicle_path("irve2_reference")
REALDATA = Path(os.environ.get("POSTFLIGHT_REALDATA", "/nowhere")) / "mesh"
SHELL = {"file": "shell.stl", "unit_m": 0.001, "forward": "z", "zero_clock": "-x", "nose": [12.0, -7.0, 55.0]}


@pytest.fixture(scope="module")
def geometry():
    return vehicle_from_toml(REFERENCE).geometry


@pytest.fixture(scope="module")
def drawn(geometry):
    return as_drawn(shell_mesh(geometry, 24))


def vehicle_with(folder, **meshes):
    """Write a vehicle file with meshes (a dict of keys for each body) and read it."""
    tables = [
        f"[meshes.{body}]\n" + "".join(f"{key} = {value!r}\n" for key, value in keys.items())
        for body, keys in meshes.items()
    ]
    path = folder / "mine.toml"
    path.write_text(REFERENCE.read_text() + "\n" + "\n".join(tables))
    return vehicle_from_toml(path)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "obj", "glb"])
def test_a_mesh_in_millimetres_along_another_axis_lies_where_it_was_drawn(kind, geometry, drawn, tmp_path):
    name = f"shell.{kind[:3]}"
    (tmp_path / "cad").mkdir()
    drawn.export(tmp_path / "cad" / name, file_type=kind)
    vehicle = vehicle_with(tmp_path, aeroshell=SHELL | {"file": f"cad/{name}"})
    mesh, wanted = vehicle.meshes["aeroshell"], shell_mesh(geometry, 24)
    assert len(mesh.faces) == len(wanted.faces)
    order = [np.lexsort(np.round(v, 4).T) for v in (mesh.vertices_m, np.asarray(wanted.vertices))]
    # STL and GLB hold 24 bits of a millimetre's 1500
    np.testing.assert_allclose(mesh.vertices_m[order[0]], wanted.vertices[order[1]], atol=2e-4)
    assert (mesh.rim.radius_m, mesh.rim.station_m) == pytest.approx((1.5, 0.871), abs=5e-4)
    assert not mesh.apart
    assert vehicle.files == (f"cad/{name}",)


def test_a_scene_of_parts_that_are_turned_and_moved_is_one_mesh(tmp_path):
    scene = trimesh.Scene()
    box = trimesh.creation.box([1.0, 2.0, 3.0])
    for x in (0.0, 5.0):
        turn = trimesh.transformations.euler_matrix(0.0, 0.0, np.pi / 2)
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([x, 0.0, 0.0]) @ turn)
    scene.export(tmp_path / "two.glb")
    vertices, faces = read_mesh(tmp_path / "two.glb")
    assert len(faces) == 24
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [[-1.0, -0.5, -1.5], [6.0, 0.5, 1.5]])


def glb_with(glb, change):
    """The GLB file with its tree changed in place."""
    size = struct.unpack("<I", glb[12:16])[0]
    tree = json.loads(glb[20 : 20 + size])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + size :]
    return glb[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + glb[16:20] + text + rest


def spoilt(drawn, how):
    """Bytes of a file and its ending."""

    def whole(kind):
        data = drawn.export(file_type=kind)
        return data.encode() if isinstance(data, str) else data

    def holed(kind):
        mesh = trimesh.Trimesh(drawn.vertices, np.delete(drawn.faces, 700, axis=0), process=False)
        data = mesh.export(file_type=kind)
        return data.encode() if isinstance(data, str) else data

    def emptied(tree):
        for key in ("meshes", "nodes", "scenes", "scene", "accessors", "bufferViews"):
            tree.pop(key, None)

    def in_a_circle(tree):
        tree["nodes"] += [{"children": [len(tree["nodes"]) + 1]}, {"children": [len(tree["nodes"])]}]

    nan = struct.pack("<f", float("nan"))
    make = {
        "hole": lambda: ("stl", holed("stl")),
        "hole in obj": lambda: ("obj", holed("obj")),
        "no bytes": lambda: ("stl", b""),
        "no faces": lambda: ("stl", bytes(80) + bytes(4)),
        "no faces in ascii": lambda: ("stl", b"solid nothing\nendsolid nothing\n"),
        "no faces in obj": lambda: ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "no faces in glb": lambda: ("glb", glb_with(whole("glb"), emptied)),
        "cut stl": lambda: ("stl", whole("stl")[:40_000]),
        "cut head": lambda: ("stl", whole("stl")[:50]),
        "cut ascii": lambda: ("stl", whole("stl_ascii")[:90_000]),
        "cut obj": lambda: ("obj", whole("obj")[:-40_000]),
        "cut glb": lambda: ("glb", whole("glb")[:40_000]),
        "other content": lambda: ("stl", whole("obj")[:300_000]),
        "other content in glb": lambda: ("glb", whole("stl")),
        "not a number": lambda: ("stl", whole("stl")[:96] + nan + whole("stl")[100:]),
        "wrong corner": lambda: ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        "many faces": lambda: ("stl", bytes(80) + struct.pack("<I", 600_000) + bytes(30_000_000)),
        "claims": lambda: ("glb", glb_with(whole("glb"), lambda tree: tree["accessors"][0].update(count=10**9))),
        "packed": lambda: ("glb", glb_with(whole("glb"), lambda tree: tree.update(extensionsRequired=["KHR_draco"]))),
        "elsewhere": lambda: ("glb", glb_with(whole("glb"), lambda tree: tree["buffers"][0].update(uri="a.bin"))),
        "circle": lambda: ("glb", glb_with(whole("glb"), in_a_circle)),
    }
    return make[how]()


@pytest.mark.parametrize(
    ("how", "code", "name"),
    [
        ("hole", "mesh-unusable", "3 of"),
        ("hole in obj", "mesh-unusable", "3 of"),
        ("no bytes", "mesh-unusable", ""),
        ("no faces", "mesh-unusable", ""),
        ("no faces in ascii", "mesh-unusable", ""),
        ("no faces in obj", "mesh-unusable", ""),
        ("no faces in glb", "mesh-unusable", ""),
        ("cut stl", "file-unreadable", ""),
        ("cut head", "file-unreadable", ""),
        ("cut ascii", "file-unreadable", ""),
        ("cut obj", "mesh-unusable", ""),
        ("cut glb", "file-unreadable", ""),
        ("other content", "file-unreadable", "STL"),
        ("other content in glb", "file-unreadable", "GLB"),
        ("not a number", "not-finite", ""),
        ("wrong corner", "file-unreadable", ""),
        ("many faces", "file-unreadable", "600000 .* 500000"),
        ("claims", "file-unreadable", "500000"),
        ("packed", "file-unreadable", "KHR_draco"),
        ("elsewhere", "file-unreadable", "GLB"),
        ("circle", "file-unreadable", ""),
    ],
)
def test_what_is_no_closed_mesh_is_refused_in_words(how, code, name, drawn, tmp_path):
    kind, data = spoilt(drawn, how)
    path = tmp_path / f"bad.{kind}"
    path.write_bytes(data)
    with refuses(code, names=[name]) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)


def test_a_file_too_large_is_not_even_read(tmp_path):
    path = tmp_path / "large.obj"
    with path.open("wb") as file:
        file.truncate(LARGEST_BYTES + 1)
    with refuses("file-too-large", names=["50"]):
        read_mesh(path)


def test_materials_in_other_files_are_not_followed(drawn, tmp_path):
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd ../../picture.png\n")
    path = tmp_path / "shell.obj"
    path.write_text("mtllib secret.mtl\nusemtl a\n" + drawn.export(file_type="obj"))
    assert len(read_mesh(path)[1]) == len(drawn.faces)


@pytest.mark.parametrize(
    ("change", "code", "name"),
    [
        ({"unit_m": 1.0}, "mesh-unusable", "unit_m' = 1: shell.stl: .* 3000 m .* unit_m = 0.001"),
        ({"unit_m": 0.0254}, "mesh-unusable", "76.21 m .* unit_m = 0.001"),
        ({"forward": "-z"}, "mesh-unusable", "nose"),
        ({"forward": "y", "zero_clock": "z"}, "mesh-unusable", "nose"),
        ({"nose": [12.0, -7.0, -455.0]}, "mesh-unusable", r"0.510 m .* nose = \[12.0, -7.0, 55.0\]"),
        ({"nose": [262.0, -7.0, 55.0]}, "mesh-unusable", "0.250 m .* 0.150 m"),
        ({"zero_clock": "-z"}, "keys-conflict", "meshes.aeroshell.zero_clock' = '-z'"),
        ({"file": "../shell.stl"}, "key-value", "file"),
        ({"file": "/shell.stl"}, "key-value", "file"),
        ({"file": "shell.step"}, "keys-conflict", ".stl, .obj, .glb"),
        ({"file": "shel.stl"}, "file-missing", "shel.stl"),
        ({"units": "mm"}, "key-unknown", "meshes.aeroshell.units"),
    ],
)
def test_keys_that_contradict_vehicle_or_file_are_named(change, code, name, drawn, tmp_path):
    drawn.export(tmp_path / "shell.stl")
    with refuses(code, names=[name], kind=ConfigError):
        vehicle_with(tmp_path, aeroshell=SHELL | change)


def test_faults_of_both_bodies_come_at_once(geometry, drawn, tmp_path):
    drawn.export(tmp_path / "shell.stl")
    as_drawn(centerbody_mesh(geometry), shift=(0.0, 0.0, 0.0)).export(tmp_path / "body.stl")
    body = {"file": "body.stl", "unit_m": 0.001, "forward": "z"}
    with refuses(
        "mesh-unusable", "mesh-unusable", names=["centerbody", r"-1\.580\b", r"\b0\.000\b"], kind=ConfigError
    ) as caught:
        vehicle_with(tmp_path, aeroshell=SHELL | {"unit_m": 1.0}, centerbody=body | {"forward": "-z"})
    assert len(caught.value.faults) == 2
    found = vehicle_with(tmp_path, aeroshell=SHELL, centerbody=body)
    assert sorted(found.meshes) == ["aeroshell", "centerbody"]
    assert found.files == ("shell.stl", "body.stl")


def test_a_camera_inside_a_mesh_is_named(geometry, tmp_path):
    wide = centerbody_mesh(geometry)
    wide.apply_scale([1.0, 1.2, 1.2])
    wide.export(tmp_path / "body.stl")
    with refuses("mesh-unusable", names=["camera5_uncalibrated, camera5"], kind=ConfigError):
        vehicle_with(tmp_path, centerbody={"file": "body.stl", "unit_m": 1.0, "forward": "x"})


def test_inside_is_told_from_outside_whatever_the_winding():
    torus = trimesh.creation.torus(1.0, 0.3)
    rng = np.random.default_rng(0)
    faces = np.asarray(torus.faces).copy()
    flip = rng.random(len(faces)) < 0.5
    faces[flip] = faces[flip, ::-1]
    mesh = BodyMesh(np.asarray(torus.vertices), faces, "")
    points = rng.uniform(-1.4, 1.4, (300, 3)) * [1.0, 1.0, 0.3]
    depth = 0.3 - np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1.0, points[:, 2])
    sure = np.abs(depth) > 0.01
    assert [encloses(mesh, p) for p in points[sure]] == (depth[sure] > 0.0).tolist()


def test_rim_of_few_corners_off_the_axis_is_found():
    clock = 2.0 * np.pi * np.arange(16) / 16
    ring = np.column_stack([np.full(16, -0.4), 0.2 + 1.5 * np.cos(clock), -0.1 + 1.5 * np.sin(clock)])
    rim = rim_circle(np.concatenate([ring, 0.5 * ring]))
    np.testing.assert_allclose(rim.centre_m, [0.2, -0.1], atol=1e-9)
    np.testing.assert_allclose([rim.radius_m, rim.station_m, rim.rms_m], [1.5, 0.4, 0.0], atol=1e-9)


@pytest.mark.realdata
@pytest.mark.skipif(not REALDATA.is_dir(), reason="POSTFLIGHT_REALDATA names no meshes")
def test_a_real_capsule_is_scaled_and_laid_by_what_is_told_of_it(tmp_path):
    (tmp_path / "capsule.stl").write_bytes((REALDATA / "orion_full.stl").read_bytes())
    keys = {"file": "capsule.stl", "forward": "-y", "nose": [0.0, -2.6, 0.0]}
    with refuses("mesh-unusable", names=[r"5\.023 m"], kind=ConfigError):
        vehicle_with(tmp_path, aeroshell=keys | {"unit_m": 0.308})
    mesh = vehicle_with(tmp_path, aeroshell=keys | {"unit_m": 0.184}).meshes["aeroshell"]
    assert len(mesh.faces) == 51736
    assert np.linalg.norm(np.ptp(mesh.vertices_m, axis=0), np.inf) == pytest.approx(3.001, abs=5e-4)
    assert mesh.rim.radius_m == pytest.approx(1.5, abs=0.005)
    assert mesh.apart
    np.testing.assert_allclose(mesh.vertices_m[:, 0].max(), 0.0, atol=1e-6)

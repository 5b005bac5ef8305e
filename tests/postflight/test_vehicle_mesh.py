"""A vehicle with a mesh of the user's own, through the commands: copied along, told, hashed, refused."""

import json
import re
import shutil
from pathlib import Path

import trimesh

from flightmodel.vehicle import vehicle_from_toml
from tests.flightmodel.meshes_of_vehicles import as_drawn, shell_mesh
from tests.refusing import printed_codes

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_vehicle"
TABLE = '\n[meshes.aeroshell]\nfile = "shell.stl"\nunit_m = 0.001\nforward = "z"\nnose = [12.0, -7.0, 55.0]\n'


def test_a_mesh_goes_with_its_vehicle_and_is_checked_before_a_run(command, tmp_path):
    for file in EXAMPLE.glob("*.toml"):
        shutil.copy(file, tmp_path / file.name)
    vehicle = tmp_path / "vehicle.toml"
    mesh = as_drawn(shell_mesh(vehicle_from_toml(vehicle).geometry, 24))
    mesh.export(tmp_path / "shell.stl")
    vehicle.write_text(vehicle.read_text() + TABLE)
    flight = tmp_path / "flight"
    done = command("simulate", tmp_path / "scenario.toml", flight)
    assert done.returncode == 0, done.stderr
    found = json.loads(command("check", flight, "--json").stdout)
    assert found["exit_code"] == 0
    assert [f["code"] for f in found["findings"] if "aeroshell" in f["source"]] == ["mesh-use"]
    copy = flight / "vehicle" / "shell.stl"
    assert copy.read_bytes() == (tmp_path / "shell.stl").read_bytes()
    holed = trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)
    holed.export(copy)
    done = command("check", flight)
    assert done.returncode == 2
    assert printed_codes(done.stdout) == ["mesh-unusable"]
    assert re.search(r"shell\.stl\b.*\b3\b", done.stdout, re.DOTALL)

"""A vehicle's own features: which word or list the vehicle file may name, and what of a list is refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import flightmodel
from estimators.features import visible_features
from estimators.virtual_camera import VirtualCamera
from flightmodel.camera import camera_from_mount
from flightmodel.checks import ConfigError
from flightmodel.geometry import dot_positions
from flightmodel.vehicle import vehicle_from_toml

DATA = Path(flightmodel.__file__).parent / "data"
HEAD = "station_m,radius_m,clock_lv_deg,kind,shade,width_m\n"


def vehicle_with(folder, features, listed=None):
    text = (DATA / "vehicles/irve2_reference.toml").read_text()
    shutil.copy(DATA / "aerodynamics/irve2_reference.csv", folder)
    shutil.copy(DATA / "aerodynamics/irve2_reference.toml", folder)
    (folder / "mine.toml").write_text(text.replace('features = "drawn"', f'features = "{features}"'))
    if listed is not None:
        (folder / "marks.csv").write_text(listed)
    return vehicle_from_toml(folder / "mine.toml")


def test_the_drawn_dots_as_a_list_are_the_drawn_dots(tmp_path):
    geometry = vehicle_with(tmp_path, "drawn").geometry
    rows = [
        f"{-x:.9f},{np.hypot(y, z):.9f},{np.rad2deg(np.arctan2(z, -y)):.9f},dot,darker,0.022"
        for x, y, z in dot_positions(geometry)
    ]
    vehicle = vehicle_with(tmp_path, "marks.csv", HEAD + "\n".join(rows))
    assert "marks.csv" in vehicle.files
    mount = vehicle.cameras["camera5"]
    drawn, own = (
        visible_features(VirtualCamera(shell, camera_from_mount(mount), 0.2)) for shell in (geometry, vehicle.geometry)
    )
    dots = drawn.points_shell_m[drawn.is_dot]
    assert own.is_dot.all()
    assert len(own.points_shell_m) == len(dots) > 40
    np.testing.assert_allclose(np.sort(own.points_shell_m, axis=0), np.sort(dots, axis=0), atol=1e-8)
    assert (own.signs == 1.0).all()


def test_lines_are_measured_across_and_pale_ones_by_their_rise(tmp_path):
    geometry = vehicle_with(tmp_path, "none").geometry
    x, y, z = dot_positions(geometry)[6 * 7 + 5]  # the gore before the camera, the last torus but one
    place = f"{-x:.9f},{np.hypot(y, z):.9f},{np.rad2deg(np.arctan2(z, -y)):.9f}"
    vehicle = vehicle_with(tmp_path, "marks.csv", f"{HEAD}{place},seam,paler,0.03\n{place},hoop,darker,0.03\n")
    view = VirtualCamera(vehicle.geometry, camera_from_mount(vehicle.cameras["camera5"]), 0.2)
    own = visible_features(view)
    assert own.signs.tolist() == [-1.0, 1.0]
    assert not own.is_dot.any()
    # the meridian through a point above the camera's own runs up the picture
    assert abs(own.across_px[0] @ own.across_px[1]) < 0.3
    assert abs(own.across_px[0, 0]) > 0.7


@pytest.mark.parametrize(
    ("features", "listed", "code"),
    [
        ("seams", None, ""),
        ("../marks.csv", None, ""),
        ("marks.csv", None, "file-missing"),
        ("marks.csv", "station_m,radius_m\n1,2\n1,2\n", "column-missing"),
        ("marks.csv", HEAD + "0.3,0.3,x,dot,darker,0.02\n0.3,0.3,0,dot,darker,0.02\n", "not-a-number"),
        ("marks.csv", HEAD + "0.3,0.3,0,spot,darker,0.02\n0.3,0.3,0,dot,darker,0.02\n", "not-a-number"),
        ("marks.csv", HEAD + "9.3,0.3,0,dot,darker,0.02\n0.3,0.3,0,dot,darker,0.02\n", "edit-unusable"),
    ],
)
def test_what_no_shell_carries_is_refused(tmp_path, features, listed, code):
    with pytest.raises(ConfigError) as refusal:
        vehicle_with(tmp_path, features, listed)
    assert not code or refusal.value.codes[0] == code
    assert "features" in str(refusal.value)

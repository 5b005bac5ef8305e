"""The stacked-torus shell: published dimensions, tangency, limb against brute force, sign of the bending."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

import flightmodel
from flightmodel import geometry as shell
from flightmodel.deflection import lv_direction
from flightmodel.geometry import ShellGeometry
from tests.refusing import refuses

TOML = Path(flightmodel.__file__).parent / "data/vehicles/irve2_reference.toml"
D = np.deg2rad
EYE = np.array([-1.40, 0.17, 0.09])


@pytest.fixture(scope="module")
def geometry():
    return ShellGeometry.model_validate(tomllib.loads(TOML.read_text())["geometry"])


def test_stack_has_the_published_dimensions(geometry):
    station, radius = shell.torus_circles(geometry)
    # 7 tori to a 3 m diameter; innermost centre 0.211 m aft of the nose for a 0.38 m nose
    assert radius[-1] + geometry.torus_minor_radius_m == pytest.approx(geometry.base_radius_m, abs=5e-4)
    assert station[0] == pytest.approx(0.2108, abs=1e-4)
    np.testing.assert_allclose(np.hypot(np.diff(station), np.diff(radius)), geometry.torus_spacing_m)
    np.testing.assert_allclose(np.arctan2(np.diff(radius), np.diff(station)), D(geometry.half_angle_deg))


def test_every_torus_touches_the_forward_cone(geometry):
    station, radius = shell.torus_circles(geometry)
    half, nose = D(geometry.half_angle_deg), geometry.nose_radius_m
    on_cone = nose * (1 - np.sin(half)) + (radius - nose * np.cos(half)) / np.tan(half)
    np.testing.assert_allclose((station - on_cone) * np.sin(half), geometry.torus_minor_radius_m)


def test_aft_profile_and_seams_lie_on_the_tori_and_end_at_the_rim(geometry):
    profile = shell.aft_profile(geometry)
    station, radius = shell.torus_circles(geometry)
    gap = np.hypot(profile[:, :1] - station, profile[:, 1:] - radius).min(axis=1)
    np.testing.assert_allclose(gap, geometry.torus_minor_radius_m, atol=1e-12)
    seams = shell.revolved(profile, shell.seam_clocks_rad(geometry))
    assert seams.shape[0] == geometry.gore_count
    rim = shell.rim_curve(geometry, shell.seam_clocks_rad(geometry))
    np.testing.assert_allclose(seams[:, -1], rim, atol=1e-12)
    np.testing.assert_allclose(np.hypot(rim[:, 1], rim[:, 2]), geometry.base_radius_m, atol=5e-4)
    dots = shell.dot_positions(geometry)
    assert dots.shape == (geometry.gore_count * geometry.torus_count, 3)


@pytest.mark.parametrize("index", [-1, 3])
def test_limb_is_where_lines_of_sight_touch_the_torus(geometry, index):
    clocks = D(np.arange(0.0, 360.0, 15.0))
    limb = shell.torus_limb(geometry, EYE, clocks, index)
    station, radius = shell.torus_circles(geometry)
    centre = -station[index] * np.array([1.0, 0, 0]) + radius[index] * lv_direction(clocks)
    np.testing.assert_allclose(np.linalg.norm(limb - centre, axis=1), geometry.torus_minor_radius_m)
    sight = (limb - EYE) / np.linalg.norm(limb - EYE, axis=1, keepdims=True)
    np.testing.assert_allclose(np.einsum("ni,ni->n", limb - centre, sight), 0.0, atol=1e-12)
    # the outboard one of the two edges, on the aft side: brute force over the section at each clock
    turn = np.linspace(-np.pi, np.pi, 20001)
    for clock, point, c in zip(clocks, limb, centre, strict=True):
        out = lv_direction(clock)
        section = c + geometry.torus_minor_radius_m * (
            np.cos(turn)[:, None] * out - np.sin(turn)[:, None] * [1.0, 0, 0]
        )
        normal = (section - c) / geometry.torus_minor_radius_m
        away = np.einsum("ni,ni->n", normal, section - EYE)
        crossing = section[np.flatnonzero(away[:-1] * away[1:] < 0.0)]
        assert np.linalg.norm(crossing - point, axis=1).min() < 1e-4
        assert point[0] == pytest.approx(crossing[:, 0].min(), abs=1e-4)  # the aft one


def test_a_viewpoint_inside_the_torus_is_refused(geometry):
    station, radius = shell.torus_circles(geometry)
    inside = -station[-1] * np.array([1.0, 0, 0]) + radius[-1] * lv_direction(1.0)
    with refuses("camera-inside-shell", names=["torus"]):
        shell.torus_limb(geometry, inside, np.array([1.0]))


@pytest.mark.parametrize("plane_deg", [23.0, 153.0, 201.0])
def test_positive_bending_moves_the_rim_aft_on_the_planes_side(geometry, plane_deg):
    plane, theta, joint = D(plane_deg), D(4.0), 0.2
    near, far, aside = shell.rim_curve(geometry, plane + np.array([0.0, np.pi, 0.5 * np.pi]))
    moved = [shell.bend(p, theta, plane, joint) for p in (near, far, aside)]
    assert moved[0][0] < near[0] - 0.09  # 1.5 m sin 4 deg = 0.105, less what the arm's cosine gives
    assert moved[1][0] > far[0] + 0.09
    assert abs(moved[2][0] - aside[0]) < 0.003
    nose = shell.bend(np.zeros(3), theta, plane, joint)
    np.testing.assert_allclose(
        nose, [joint * (np.cos(theta) - 1), *(joint * np.sin(theta) * lv_direction(plane)[1:])], atol=1e-12
    )
    fixed = np.array([-joint, 0.0, 0.0])
    np.testing.assert_allclose(shell.bend(fixed, theta, plane, joint), fixed, atol=1e-15)


def test_meshes_have_the_analytic_volumes_and_places(geometry):
    meshes = shell.vehicle_meshes(geometry, clock_sections=128, torus_sections=48)
    station, radius = shell.torus_circles(geometry)
    a = geometry.torus_minor_radius_m
    for i in range(geometry.torus_count):
        mesh = meshes[f"torus_{i + 1}"]
        assert mesh.is_watertight
        # a 48-gon of a circle has 1 - (2 pi / 48)^2 / 6 of its area, a 128-gon likewise
        assert mesh.volume == pytest.approx(2 * np.pi**2 * radius[i] * a**2, rel=5e-3)
        np.testing.assert_allclose(mesh.bounds[:, 0], [-station[i] - a, -station[i] + a], atol=1e-9)
    assert meshes["centerbody"].volume == pytest.approx(np.pi * 0.195**2 * 1.58, rel=2e-3)
    np.testing.assert_allclose(meshes["centerbody"].bounds[:, 0], [-1.58, 0.0], atol=1e-12)
    assert meshes["forward_skin"].bounds[1, 0] == pytest.approx(0.0, abs=1e-12)

"""Film that another renderer made, of a shell painted otherwise; and what is refused where edge and features disagree.

Frames: tests/data/README.md.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest

from estimators.benchmark import orient_camera, samples_together
from estimators.camera import (
    JointSwing,
    read_film,
    without_jumps,
    without_lost_features,
    without_remnants,
    without_stray_texture,
)
from estimators.edge import fault_of_frame, is_coherent, no_horizon, steps_near
from estimators.features import no_features
from estimators.frame_edits import EditedFrame
from estimators.frame_solution import FrameFit, NoFitError, refused_fit
from estimators.virtual_camera import deformation_of
from flightmodel.camera import camera_from_mount
from flightmodel.camera_edits import NO_EDITS
from flightmodel.checks import NO_FAULT, Issue
from flightmodel.film import burnt_in
from flightmodel.vehicle import read_vehicle
from postflight.checks.folder_check import benchmark_frame, text_in_films
from postflight.filming import joint_swing
from synthetic_flight.film import Imaging, ShellRenderer, record, render_video
from tests.estimators.test_camera_deflection import GEOMETRY, JOINT_M, MOUNT, D, film, sun
from tests.refusing import refuses

FRAMES = Path(__file__).parents[1] / "data" / "other_film"
TRUTH = pd.read_csv(FRAMES / "truth.csv")


def footage(look):
    """Frames of a look, and the truth in them."""
    rows = TRUTH[TRUTH.frame.str.startswith(look)]
    return [cv2.imread(str(FRAMES / name), cv2.IMREAD_GRAYSCALE) for name in rows.frame], rows


def shell(features):
    return GEOMETRY.model_copy(update={"features": features})


def test_a_benchmark_frame_in_the_shade_before_the_earth_orients_the_camera():
    """The shell is hardly brighter than the Earth behind it, whose limb passes for the edge from far."""
    folder = FRAMES.parent / "shaded_benchmark"
    frames = [cv2.imread(str(folder / f"shade_{t}.jpg"), cv2.IMREAD_GRAYSCALE) for t in (421, 439)]
    history = read_film(np.array([421.0, 439.0]), frames, shell("texture"), MOUNT, JOINT_M, plane_lv_rad=None).history()
    error = np.rad2deg(history.theta_rad[1]) - 1.4739
    assert abs(error) < 0.15
    assert abs(error) < 3.0 * np.rad2deg(history.theta_sd_rad[1])


@pytest.mark.parametrize("look", ["clean", "flown"])
@pytest.mark.parametrize("stated", ["texture", "drawn"])
def test_another_paint_is_read_by_its_texture_whatever_the_vehicle_file_states(look, stated):
    frames, rows = footage(look)
    read = read_film(rows.t_s.to_numpy(), frames, shell(stated), MOUNT, JOINT_M, plane_lv_rad=None)
    history = read.history()
    assert (read.oriented.stated_refused != "") == (stated == "drawn")
    assert ("not used" in history.assumptions) == (stated == "drawn")
    assert "the shell's texture" in history.assumptions
    assert read.fits[1].features > 60
    error = history.theta_rad[1] - D(rows.theta_deg.iloc[1])
    # the benchmark frame's own 0.12 deg among it, and the light on the features
    assert history.theta_sd_rad[1] < D(0.25)
    assert abs(error) < 2.0 * history.theta_sd_rad[1]


def test_a_burnt_in_time_code_is_no_texture_of_the_shell():
    frames, rows = footage("clean")
    text = [
        cv2.putText(frame.copy(), f"229:12:59:{k:02d}", (180, 260), cv2.FONT_HERSHEY_SIMPLEX, 2.0, 255, 4)
        for k, frame in enumerate([*frames, *footage("flown")[0], *(cv2.flip(frame, 1) for frame in frames)])
    ]
    fixed = burnt_in(text)
    both = [
        read_film(rows.t_s.to_numpy(), film, shell("texture"), MOUNT, JOINT_M, plane_lv_rad=None, fixed=hidden)
        for film, hidden in ((frames, None), (text[:2], fixed))
    ]
    clean, spoilt = (read.history() for read in both)
    assert abs(spoilt.theta_rad[1] - clean.theta_rad[1]) < 0.5 * clean.theta_sd_rad[1]
    assert "text burnt into the film" in spoilt.assumptions
    assert "text burnt into the film" not in clean.assumptions
    # no texture is taken from what is hidden
    hidden_px = both[1].oriented.view.sight(both[1].oriented.features.points_shell_m, np.zeros(3)).pixels
    used = both[1].oriented.benchmark_residuals.index - len(both[1].oriented.clocks_rad)
    u, v = np.rint(hidden_px[used[used >= 0]]).astype(int).T
    assert not fixed[v, u].any()


def test_the_edge_alone_answers_where_it_is_whole_and_is_refused_where_clouds_lie_behind_it():
    frames, rows = footage("clean")
    read = read_film(rows.t_s.to_numpy(), frames, shell("none"), MOUNT, JOINT_M, plane_lv_rad=None)
    assert read.fits[1].features == 0
    assert abs(read.history().theta_rad[1] - D(rows.theta_deg.iloc[1])) < D(0.4)
    half = np.where(np.arange(720) < 300, frames[1], 0).astype(np.uint8)
    assert read.oriented.fit(half).refused.code in {"edge-too-short", "edge-points-too-few"}
    clouded = orient_camera(footage("flown")[0][0], shell("none"), MOUNT, JOINT_M)
    assert clouded.fit(footage("flown")[0][1]).refused


def test_where_features_contradict_the_edge_it_counts_if_it_is_whole():
    frames = film(5, [0.0, 3.0], [0.0, 188.0], Imaging(shadows=False))  # with the whole edge in the light
    oriented = orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M)
    true = deformation_of(D(3.0), D(188.0))
    for off_deg, contradicts in ((0.0, False), (0.9, True), (3.0, True)):
        said = true + deformation_of(D(off_deg), D(153.0))
        points = oriented.features.points_shell_m
        where = np.einsum("ni,ni->n", oriented.view.sight(points, said).pixels, oriented.features.across_px)
        place = where, np.where(np.arange(len(where)) < oriented.painted_rows, 0.1, np.inf)
        moved = said.copy()
        # the edge is searched where the features say that it is
        near = steps_near(frames[1], oriented.view.lines_at(oriented.clocks_rad, said))
        both = oriented._solve(near, place, moved, np.eye(2), 9.0)
        last = oriented._reconciled(EditedFrame(frames[1]), near, place, moved, both)
        assert (last is not both) == contradicts
        np.testing.assert_allclose(moved[:2], true[:2], atol=D(0.25))
    half = np.where(np.arange(720) > 300, frames[1], 0).astype(np.uint8)
    short = steps_near(half, oriented.view.lines_at(oriented.clocks_rad, true))
    moved = said.copy()
    both = oriented._solve(short, place, moved, np.eye(2), 9.0)
    with pytest.raises(NoFitError) as refusal:
        oriented._reconciled(EditedFrame(half), short, place, moved, both)
    assert refusal.value.codes == ("features-contradict-edge",)


def answers(theta_deg):
    sd = D(0.05)
    fits = [
        FrameFit(D(np.array([theta, 0.0])), sd**2 * np.eye(2), np.eye(2), 0.0, 0.0, 0.3, 100, no_horizon(NO_FAULT))
        for theta in theta_deg
    ]
    return fits


def test_a_frame_that_lost_the_features_of_the_others_is_refused():
    fits = answers([1.0, 2.0, 3.0, 2.5])
    lost = [replace(fit, features=0) if k == 2 else fit for k, fit in enumerate(fits)]
    assert [fit.refused for fit in without_lost_features(fits)] == [""] * 4
    assert [
        k for k, fit in enumerate(without_lost_features(lost)) if getattr(fit.refused, "code", "") == "features-lost"
    ] == [2]
    bare = [replace(fit, features=0) for fit in fits]
    assert not any(fit.refused for fit in without_lost_features(bare))


def test_texture_that_agrees_in_few_frames_is_taken_for_light_and_shade():
    fits = answers([0.0, 1.0, 2.0, 3.0, 2.5])
    few = [replace(fit, features=fit.features if k in (0, 3) else 0) for k, fit in enumerate(fits)]
    codes = [getattr(fit.refused, "code", "") for fit in without_stray_texture(np.arange(5.0), few, 0.0)]
    assert codes == ["", "", "", "texture-strays", ""]
    # at the bench the benchmark frame may not be fitted yet: no other one is spared for it
    codes = [getattr(fit.refused, "code", "") for fit in without_stray_texture(np.arange(1.0, 5.0), few[1:], 0.0)]
    assert codes == ["", "", "texture-strays", ""]
    # where most frames show it, those without are the odd ones
    most = [replace(fit, features=0) if k == 2 else fit for k, fit in enumerate(fits)]
    codes = [getattr(fit.refused, "code", "") for fit in without_stray_texture(np.arange(5.0), most, 0.0)]
    assert codes == ["", "", "features-lost", "", ""]


def test_texture_that_agrees_as_light_and_shade_never_does_outweighs_frames_without():
    fits = answers(np.linspace(0.0, 3.0, 9))
    some = [replace(fit, features=(100, 40, 20, 30)[k] if k < 4 else 0) for k, fit in enumerate(fits)]
    codes = [getattr(fit.refused, "code", "") for fit in without_stray_texture(np.arange(9.0), some, 0.0)]
    assert codes == [""] * 4 + ["features-lost"] * 5
    # as much of light and shade at the most: those are the odd ones
    few = [replace(fit, features=(100, 15, 10, 20)[k] if k < 4 else 0) for k, fit in enumerate(fits)]
    codes = [getattr(fit.refused, "code", "") for fit in without_stray_texture(np.arange(9.0), few, 0.0)]
    assert codes == ["", *["texture-strays"] * 3, *[""] * 5]


def test_a_jump_that_no_swing_makes_is_refused_and_a_swing_is_not():
    swing = JointSwing(2.5, 0.02)
    t = np.arange(30) / 30.0
    theta = 3.0 + 2.5 * np.sin(2.0 * np.pi * 2.5 * t)
    assert not any(fit.refused for fit in without_jumps(t, answers(theta), swing))
    theta[12] += 6.0
    refused = [k for k, fit in enumerate(without_jumps(t, answers(theta), swing)) if fit.refused]
    assert refused == [12]
    assert without_jumps(t, answers(theta), swing)[12].refused.code == "jump-too-fast"
    # frames a second apart: half a period has passed, and only the overshoot bounds them
    assert not any(fit.refused for fit in without_jumps(30.0 * t, answers(theta), swing))


def test_a_swing_goes_no_farther_than_a_load_put_on_at_once():
    level, t = D(2.0), np.linspace(0.0, 1.0, 400)
    for zeta in (0.01, 0.3):
        swing = JointSwing(2.5, zeta)
        w = 2.0 * np.pi * 2.5
        damped = w * np.sqrt(1.0 - zeta**2)
        x = level * (1.0 - np.exp(-zeta * w * t) * (np.cos(damped * t) + zeta * w / damped * np.sin(damped * t)))
        for steps in (3, 20, 90):
            change = np.abs(x[steps:] - x[:-steps]).max()
            assert change <= swing.largest_change(np.array([level]), np.array([t[steps]]))[0] * 1.001
    vehicle = read_vehicle("irve2_reference")
    own = joint_swing(vehicle)
    assert own is not None
    assert own.frequency_hz == vehicle.free_free_frequency_hz()


def test_clouds_are_no_coherent_edge():
    rng = np.random.default_rng(0)
    line = np.arange(200)
    smooth = 0.5 * np.sin(line / 30.0) + 0.1 * rng.standard_normal(200)
    assert is_coherent(line, smooth).mean() > 0.97
    assert is_coherent(line, rng.uniform(-4.5, 4.5, 200)).mean() < 0.1
    assert not is_coherent(line, np.where(line == 50, np.nan, smooth))[50]


def test_neighbours_that_err_together_are_counted():
    rng = np.random.default_rng(1)
    alone = rng.standard_normal(4000)
    assert samples_together(alone) == pytest.approx(1.0, abs=0.3)
    # Gauss-Markov: (1 + rho) / (1 - rho) samples are one
    walk = np.zeros(4000)
    for k in range(1, 4000):
        walk[k] = 0.8 * walk[k - 1] + alone[k]
    assert samples_together(walk) == pytest.approx(9.0, rel=0.35)


class Film(SimpleNamespace):
    """Frames as they are found in a folder, which differ by identity."""

    __hash__ = object.__hash__


def found(picture, features, burnt_in=None):
    frames = Film(
        time_s=np.array([421.0]),
        benchmark=0,
        picture=lambda _k: picture,
        camera=MOUNT,
        edits=NO_EDITS,
        burnt_in=burnt_in,
    )
    vehicle = replace(read_vehicle("irve2_reference"), geometry=shell(features))
    spec = SimpleNamespace(film_names={"frames": "camera5"})
    return SimpleNamespace(films={"camera5": frames}, vehicle=vehicle, spec=spec)


def test_check_tries_the_benchmark_frame():
    picture = footage("clean")[0][0]
    assert benchmark_frame(found(picture, "texture")) == []
    (remark,) = benchmark_frame(found(picture, "drawn"))
    assert remark.code == "features-not-found"
    (remark,) = benchmark_frame(found(np.zeros((480, 720), dtype=np.uint8), "texture"))
    assert remark.code == "frame-exposure"
    text = np.zeros(picture.shape, dtype=bool)
    text[20:60, 40:400] = True
    assert text_in_films(found(picture, "texture")) == []
    (remark,) = text_in_films(found(picture, "texture", text))
    assert remark.code == "text-burnt-in"
    assert benchmark_frame(SimpleNamespace(films={}, vehicle=None, spec=SimpleNamespace(film_names={}))) == []
    assert len(no_features().points_shell_m) == 0


@pytest.mark.parametrize("roll_deg", [180.0, 90.0, -37.0])
def test_a_camera_mounted_upside_down_or_on_its_side_reads_the_same(roll_deg):
    turned = {"roll_deg": roll_deg}
    if roll_deg == 90.0:
        turned |= {"width_px": 480, "height_px": 720, "centre_px": (241.0, 361.0)}
    mount = MOUNT.model_copy(update=turned)
    theta, plane = D(np.array([0.0, 4.0, 3.0])), D(np.array([0.0, 190.0, 170.0]))
    light = np.stack([sun(clock, 60.0) for clock in (330.0, 300.0, 20.0)])
    frames = list(render_video(GEOMETRY, mount, JOINT_M, theta, plane, light, np.random.default_rng(2)))
    read = read_film(np.array([421.0, 440.0, 441.0]), frames, GEOMETRY, mount, JOINT_M, plane_lv_rad=None).history()
    # the benchmark frame is truly undeflected: the pictures alone err by hundredths
    np.testing.assert_allclose(read.theta_rad[1:], theta[1:], atol=D(0.08))
    np.testing.assert_allclose(read.plane_lv_rad[1:], plane[1:], atol=D(1.5))


def test_rows_of_two_moments_are_refused_and_fields_of_a_moment_are_not():
    renderer = ShellRenderer(GEOMETRY, camera_from_mount(MOUNT), JOINT_M)
    early, later, late = (
        record(
            renderer.radiance(D(theta), D(188.0), sun(330.0)), renderer.vignetting, Imaging(), np.random.default_rng(k)
        )
        for k, theta in enumerate((3.0, 3.05, 4.0))
    )
    for other, code in ((late, "frame-fields-differ"), (later, "")):
        woven = early.copy()
        woven[1::2] = other[1::2]
        assert getattr(fault_of_frame(woven, (720, 480)), "code", "") == code


def test_a_picture_that_rolled_is_refused_and_a_border_is_not():
    frames = film(6, [0.0, 3.0], [0.0, 188.0])
    rolled = np.roll(frames[1], 90, axis=0)
    assert orient_camera(frames[0], GEOMETRY, MOUNT, JOINT_M).fit(rolled).refused.code == "frame-broken"
    bordered = [frame.copy() for frame in frames]
    for frame in bordered:
        frame[:12] = 90
    oriented = orient_camera(bordered[0], GEOMETRY, MOUNT, JOINT_M)
    assert oriented.breaks.tolist() == [11]
    assert not oriented.fit(bordered[1]).refused
    # the border of another frame, of another size
    assert oriented.fit(np.vstack([np.full((40, 720), 90, np.uint8), frames[1][40:]])).refused.code == "frame-broken"


def test_a_picture_with_oblong_pixels_is_refused():
    frame = film(7, [0.0], [0.0])[0]
    orient_camera(frame, GEOMETRY, MOUNT, JOINT_M)
    middle, stretch = np.array([360.0, 240.0]), np.diag([1.012, 0.988])
    oblong = cv2.warpAffine(frame, np.column_stack([stretch, middle - stretch @ middle]), (720, 480))
    with refuses("pixels-not-square"):
        orient_camera(oblong, GEOMETRY, MOUNT, JOINT_M)


@pytest.mark.parametrize(("code", "refused", "left"), [
    ("edge-too-short", 11, 0), ("edge-too-short", 10, 10), ("frame-exposure", 15, 5),
])  # fmt: skip
def test_a_film_of_which_most_frames_show_no_shell_has_no_answer(code, refused, left):
    fits = answers(np.full(20, 2.0))
    for k in range(refused):
        fits[k] = refused_fit(no_horizon(NO_FAULT), Issue("no shell", code))
    found = without_remnants(fits)
    assert sum(not fit.refused for fit in found) == left
    if not left:
        assert found[-1].refused.code == "film-mostly-refused"

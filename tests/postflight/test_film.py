"""A film instead of images: the same frames by number, and every way in which list and film can disagree."""

import pickle
import re
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest

import postflight as pf
from flightmodel.film import film_frames
from flightmodel.flightfolder import read_flight
from postflight import commands, filming
from postflight.deflections import estimate
from postflight.filming import camera_answer, orient_on_film
from postflight.flight import read_flight as read_flown
from postflight.plots import run_figures
from postflight.plots.style import FigureFolder
from synthetic_flight.film import Imaging
from tests.estimators.test_camera_deflection import film as rendered
from tests.postflight.short_flights import write_pulse
from tests.postflight.test_bad_input import names_line, refused
from tests.refusing import numbers_in, printed_codes

SHADES = [30, 60, 90, 120, 150, 180]


def write_film(path, size=(720, 480), code="MJPG", shades=SHADES):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10.0, size)
    assert writer.isOpened()
    for shade in shades:
        writer.write(np.full((size[1], size[0], 3), shade, dtype=np.uint8))
    writer.release()


@pytest.fixture
def filmed(flight):
    """The clean folder with a film of six frames, of which the list names three."""
    write_film(flight.root / "telemetry/camera5.avi")
    flight.replace("flight.toml", 'folder = "telemetry/camera5"', 'film = "telemetry/camera5.avi"')
    for line, number in ((2, "0"), (3, "2"), (4, "5")):
        flight.cell("frames.csv", line, 1, number)
    return flight


def test_the_list_says_which_frame_was_when(filmed):
    frames = read_flight(filmed.root).frames
    np.testing.assert_allclose(frames.time_s, [421.0, 424.0, 428.5])
    means = [float(picture.mean()) for picture in frames.pictures()]
    # JPEG is off by a grey level or two
    np.testing.assert_allclose(means, [SHADES[k] for k in (0, 2, 5)], atol=2.0)
    assert frames.picture(2).shape == (480, 720)
    assert float(frames.picture(1).mean()) == pytest.approx(SHADES[2], abs=2.0)


@pytest.mark.parametrize(("name", "code"), [("camera5.webm", "VP80"), ("camera5.mp4", "mp4v")])
def test_other_containers(filmed, name, code):
    write_film(filmed.root / "telemetry" / name, code=code)
    filmed.replace("flight.toml", "camera5.avi", name)
    means = [float(picture.mean()) for picture in read_flight(filmed.root).frames.pictures()]
    np.testing.assert_allclose(means, [SHADES[k] for k in (0, 2, 5)], atol=6.0)


def test_frames_behind_the_end_of_a_film_are_empty_pictures(filmed):
    film = filmed.root / "telemetry/camera5.avi"
    shapes = [picture.shape for picture in film_frames(film, [4, 4, 5, 6, 9])]
    assert shapes == [(480, 720)] * 3 + [(0, 0)] * 2


def test_the_film_is_an_input_of_a_run(filmed):
    before = read_flight(filmed.root).hashes
    write_film(filmed.root / "telemetry/camera5.avi", shades=SHADES[::-1])
    assert read_flight(filmed.root).hashes != before


def test_a_list_that_disagrees_with_the_film(filmed):
    filmed.cell("frames.csv", 4, 1, "6")
    refused(filmed, "camera5.avi", "6 frames", "frame 6", codes={"frame-missing"})


def test_file_names_where_numbers_are_wanted(filmed):
    filmed.cell("frames.csv", 3, 1, "frame_1.png")
    assert names_line(str(refused(filmed, "frame_1.png", codes={"frame-missing"})), 3)


def test_numbers_that_fall(filmed):
    filmed.cell("frames.csv", 4, 1, "1")
    assert names_line(str(refused(filmed, codes={"frame-missing"})), 4)


def test_a_film_of_another_size(filmed):
    write_film(filmed.root / "telemetry/camera5.avi", size=(640, 480))
    refused(filmed, "640 x 480", "720 x 480", codes={"frame-size"})


@pytest.mark.parametrize("content", [b"", b"RIFF but no film", b"\0" * 4096])
def test_a_film_that_is_none(filmed, content):
    (filmed.root / "telemetry/camera5.avi").write_bytes(content)
    refused(filmed, "camera5.avi", codes={"file-unreadable"})


def test_a_truncated_film_loses_its_end_alone(filmed):
    film = filmed.root / "telemetry/camera5.avi"
    film.write_bytes(film.read_bytes()[: film.stat().st_size * 2 // 3])
    frames = read_flight(filmed.root).frames
    shapes = [picture.shape for picture in frames.pictures()]
    assert shapes == [(480, 720), (480, 720), (0, 0)]


def test_a_film_that_is_missing_and_one_outside(filmed):
    (filmed.root / "telemetry/camera5.avi").unlink()
    refused(filmed, "camera5.avi", codes={"file-missing"})
    filmed.replace("flight.toml", "telemetry/camera5.avi", "../elsewhere.avi")
    refused(filmed, "elsewhere.avi", codes={"path-refused"})


def test_folder_and_film_together_or_neither(filmed):
    filmed.declare('folder = "telemetry/camera5"', 'film = "telemetry/camera5.avi"')
    refused(filmed, "frames", codes={"keys-conflict"})
    filmed.replace("flight.toml", 'film = "telemetry/camera5.avi"\nfolder = "telemetry/camera5"\n', "")
    refused(filmed, "frames", codes={"keys-conflict"})


def test_a_cut_mp4_says_so(filmed):
    write_film(filmed.root / "telemetry/camera5.mp4", code="mp4v")
    filmed.replace("flight.toml", "camera5.avi", "camera5.mp4")
    film = filmed.root / "telemetry/camera5.mp4"
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    refused(filmed, "camera5.mp4", codes={"file-unreadable"})


def test_one_picture_for_many_times_is_found(filmed):
    for line in (3, 4):
        filmed.cell("frames.csv", line, 1, "0")
    found = [f for f in read_flight(filmed.root).findings if f.source == "frames"]
    assert [numbers_in(f.what)[:2] for f in found if f.code == "frame-frozen"] == [[2.0, 3.0]]


def test_the_command_tells_what_the_gate_found_about_a_film(filmed, command):
    film = filmed.root / "telemetry/camera5.avi"
    film.write_bytes(film.read_bytes()[: film.stat().st_size * 2 // 3])
    done = command("deflection", filmed.root, "--method", "camera", "--plane", "153", "--film")
    assert done.returncode == 4
    assert {"film-count", "figure-failed"} <= set(printed_codes(done.stdout))
    assert not list(filmed.root.rglob("*.webm"))


def without_radars(flight):
    text = flight.path("flight.toml").read_text()
    flight.path("flight.toml").write_text(re.sub(r"\[radars\.[^\[]*", "", text))


@pytest.mark.parametrize("sensors", [True, False])
def test_the_camera_alone_needs_no_radar(flight, command, sensors):
    without_radars(flight)
    if not sensors:
        text = re.sub(r"\[sensors\.[^\[]*", "", flight.path("flight.toml").read_text())
        flight.path("flight.toml").write_text(text)
    straight, bent, _ = pictures = rendered(4, [0.0, 3.0, 3.0], [0.0, 170.0, 180.0])
    assert straight.shape == bent.shape
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(flight.root / f"telemetry/camera5/frame_{k}.png"), picture)
    done = command("deflection", flight.root, "--method", "camera")
    assert done.returncode == 0, done.stderr
    assert not list(flight.root.rglob("bet.csv"))
    assert list(flight.root.rglob("deflection_camera.csv"))
    for others in ([], ["--method", "fused"], ["--method", "camera", "--method", "trim"]):
        done = command("deflection", flight.root, *others)
        assert done.returncode == 2
        assert printed_codes(done.stderr) == ["tracker-missing", *["inertial-missing"] * (not sensors)]


@pytest.mark.parametrize(
    ("painted", "plane_deg", "red"),
    [
        (True, 170.0, set()),
        (True, 350.0, {"camera-plane"}),
        (True, 80.0, {"camera-plane"}),
        (False, None, {"camera-features"}),
    ],
)
def test_a_film_that_contradicts_what_is_stated_turns_a_check_red(flight, painted, plane_deg, red):
    """A plane across or opposite, and features that are not there; the same film as it was painted passes."""
    for k, picture in enumerate(rendered(4, [0.0, 3.0, 3.0], [0.0, 170.0, 180.0], Imaging(painted=painted))):
        cv2.imwrite(str(flight.root / f"telemetry/camera5/frame_{k}.png"), picture)
    flown = read_flown(flight.root, needs_path=False).with_(camera_plane_lv_deg=plane_deg)
    checks = {check.code: check for check in camera_answer(flown).consistency_checks}
    assert {"camera-features"} | ({"camera-plane"} if plane_deg else set()) <= set(checks)
    assert {code for code, check in checks.items() if not check.passed} == red
    assert {check.source for check in checks.values() if not check.passed} <= {"camera"}


@pytest.fixture
def deflected(flight):
    """The clean folder with three frames that show a deflection."""
    for k, picture in enumerate(rendered(4, [0.0, 3.0, 3.0], [0.0, 170.0, 180.0])):
        cv2.imwrite(str(flight.root / f"telemetry/camera5/frame_{k}.png"), picture)
    return flight


def test_a_run_s_pictures_take_the_camera_as_the_answer_oriented_it(deflected, monkeypatch):
    """Here, and where the answer comes from another process or goes to one, whose telemetry is a copy."""
    flown, copy, fresh = (read_flown(deflected.root, needs_path=False) for _ in range(3))
    vehicle = fresh.telemetry.required_vehicle()
    want = orient_on_film(fresh.telemetry.frames, vehicle).view.camera
    monkeypatch.setattr(filming, "orient_camera", None)  # from here on only answers orient a camera
    with pytest.raises(TypeError):
        orient_on_film(flown.telemetry.frames, flown.telemetry.required_vehicle())
    answers = estimate(flown, ("camera",))
    drawn = []

    def draw_cameras(seen, _history, _figures):
        drawn.append(orient_on_film(seen.telemetry.frames, seen.telemetry.required_vehicle()).view.camera)

    monkeypatch.setattr(run_figures, "_draw_cameras", draw_cameras)
    monkeypatch.setattr(FigureFolder, "draw", lambda *_: None)
    draw_cameras(flown, None, None)
    bet = SimpleNamespace(flight=copy, telemetry=copy.telemetry)
    run_figures.draw_deflections(bet, FigureFolder(deflected.root), pickle.loads(pickle.dumps(answers)))
    assert len(drawn) == 2
    for got in drawn:
        for part, own in zip(got.lens_terms, want.lens_terms, strict=True):
            np.testing.assert_array_equal(part, own)


def test_no_more_cameras_are_kept_oriented_than_a_flight_has(deflected):
    flights = [read_flown(deflected.root, needs_path=False).telemetry for _ in range(6)]
    oriented = {"camera5": orient_on_film(flights[0].frames, flights[0].required_vehicle())}
    for telemetry in flights:
        filming.keep_oriented(telemetry, oriented)
    assert [frames for frames, _ in filming._ORIENTED] == [telemetry.frames for telemetry in flights[2:]]


def test_a_benchmark_frame_alone_is_no_answer(flight, command):
    """It is what the bending is measured from: 0.00 deg would be read as an answer."""
    straight = rendered(4, [0.0], [0.0])[0]
    for k in range(3):
        cv2.imwrite(str(flight.root / f"telemetry/camera5/frame_{k}.png"), straight if k == 0 else 0 * straight)
    done = command("deflection", flight.root, "--method", "camera", "--plane", "153", "--film")
    assert done.returncode == 4
    assert {"too-few-data", "figure-failed"} <= set(printed_codes(done.stdout))
    (line,) = [line for line in done.stdout.splitlines() if printed_codes(line) == ["too-few-data"]]
    assert {2.0, 424.0, 428.5} <= set(numbers_in(line))
    assert not list(flight.root.rglob("*.webm"))


def test_check_does_not_try_a_film_that_is_refused(filmed, command):
    (filmed.root / "telemetry/camera5.avi").write_text("a line of text\n" * 9)
    rows = (filmed.root / "telemetry/frames.csv").read_text().splitlines()
    (filmed.root / "telemetry/frames.csv").write_text("\n".join([rows[0], *(f"{r}.png" for r in rows[1:])]) + "\n")
    done = command("check", filmed.root)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert "file-unreadable" in done.stdout + done.stderr


def test_a_film_and_another_teams_table_are_fused(tmp_path, command):
    """As with the trajectory that the table is of; the camera is not corrected by its moment, as without one."""
    commands.simulate(str(write_pulse(tmp_path / "pulse.toml")), tmp_path / "flight", 5, force=False)
    path = tmp_path / "flight" / "flight.toml"
    bet = pf.reconstruct(pf.read_flight(tmp_path / "flight"))
    direct = pf.fuse(bet)
    bet.to_frame().to_csv(tmp_path / "flight" / "telemetry" / "bet.csv", index=False)
    text = re.sub(r"(?ms)^\[(sensors|radars|attitude_prior|atmosphere)[^\]]*\]\n.*?(?=^\[|\Z)", "", path.read_text())
    path.write_text(f'{text}\n[loads]\nfile = "telemetry/bet.csv"\n')
    assert pf.check_flight(tmp_path / "flight").can_run.startswith("camera, misalignment, trim, fused")
    assert command("deflection", tmp_path / "flight").returncode == 0
    (written,) = (tmp_path / "flight" / "runs").iterdir()
    answers = pd.read_csv(written / "answers.csv").set_index("method")
    assert set(answers.index) == {"camera", "misalignment", "trim", "fused"}
    at = answers.t_s["fused"]
    assert abs(answers.theta_deg["fused"] - np.rad2deg(direct.history.angle_at(at)[0])) < answers.theta_sd_deg["fused"]
    assert {"summary.png", "figure_2_3.png", "report.html"} <= {file.name for file in written.rglob("*.*")}

"""A film without a flight folder: the same answers as with one, and refusals of what does not fit."""

import cv2
import numpy as np
import pytest

import postflight as pf
from postflight.flight import read_flight
from tests.estimators.test_camera_deflection import film as rendered
from tests.refusing import printed_codes, refuses

VEHICLE = "irve2_reference"
TIMES = [421.0, 424.0, 428.5]


@pytest.fixture(scope="module")
def pictures():
    return rendered(4, [0.0, 3.0, 3.0], [0.0, 170.0, 180.0])


@pytest.fixture
def filmed(flight, pictures):
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(flight.root / f"telemetry/camera5/frame_{k}.png"), picture)
    return flight.root


def same(one, other):
    np.testing.assert_array_equal(one.time_s, other.time_s)
    for name in ("theta_rad", "plane_lv_rad", "covariance"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12, atol=1e-15)


def test_the_answer_is_that_of_the_flight_folder(filmed, pictures):
    """By list, by array and by pictures in memory; the folder has trackers, which the camera alone does not use."""
    expected = pf.estimate_camera(read_flight(filmed))
    assert np.isfinite(expected.theta_rad).all()
    folder = filmed / "telemetry/camera5"
    for given, times in (
        (folder, filmed / "telemetry/frames.csv"),
        (str(folder), TIMES),
        (pictures, np.array(TIMES)),
    ):
        film = pf.read_film(given, times, VEHICLE, camera="camera5", benchmark_s=421.0)
        same(pf.estimate_camera(film), expected)


def test_numbers_of_frames_in_a_film_and_a_rate(filmed, pictures, tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (720, 480))
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()
    by_rate = pf.read_film(tmp_path / "film.avi", 2.0, VEHICLE, start_s=421.0, camera="camera5").telemetry.frames
    np.testing.assert_array_equal(by_rate.time_s, [421.0, 421.5, 422.0])
    (tmp_path / "frames.csv").write_text("t_s,frame\n421.0,0\n428.5,2\n")
    listed = pf.read_film(tmp_path / "film.avi", tmp_path / "frames.csv", VEHICLE, camera="camera5").telemetry.frames
    np.testing.assert_array_equal(listed.numbers, [0, 2])
    np.testing.assert_array_equal(listed.picture(1), by_rate.picture(2))
    (tmp_path / "frames.csv").write_text("t_s,frame\n421.0,0\n428.5,3\n")
    with refuses("frame-missing"):
        pf.read_film(tmp_path / "film.avi", tmp_path / "frames.csv", VEHICLE, camera="camera5")


def test_a_fine_camera_is_reduced_in_memory_too(pictures):
    fine = pf.read_vehicle(VEHICLE)
    wide = fine.cameras["camera5"].resized((1440, 960))
    fine = fine.__class__(**{**vars(fine), "cameras": {"camera5": wide}})
    film = pf.read_film([cv2.resize(p, (1440, 960)) for p in pictures], TIMES, fine)
    assert film.findings[0].code == "frame-size"
    assert film.telemetry.frames.picture(0).shape[::-1] == film.telemetry.frames.camera.size_px != (1440, 960)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"camera": None}, "name-unknown"),
        ({"camera": "camera6"}, "name-unknown"),
        ({"times": TIMES[:2]}, "argument-value"),
        ({"times": [421.0, np.nan, 428.5]}, "not-finite"),
        ({"times": TIMES[::-1]}, "argument-value"),
        ({"times": 0.0}, "value-range"),
        ({"benchmark_s": 500.0}, "time-not-covered"),
        ({"pictures": [np.zeros((480, 720))] * 3}, "frame-size"),
        ({"pictures": []}, "frame-size"),
    ],
)
def test_what_does_not_fit_is_refused(pictures, change, code):
    given = {"pictures": pictures, "times": TIMES, "vehicle": VEHICLE, "camera": "camera5"} | change
    with refuses(code):
        pf.read_film(**given)


def test_faults_of_files_are_named(filmed):
    folder, times = filmed / "telemetry/camera5", filmed / "telemetry/frames.csv"
    cv2.imwrite(str(folder / "frame_1.png"), np.zeros((10, 10), np.uint8))
    with refuses("frame-size", names=["frame_1.png"]):
        pf.read_film(folder, times, VEHICLE, camera="camera5")
    times.write_text("t_s,picture\n1.0,a.png\n2.0,b.png\n")
    with refuses("column-missing"):
        pf.read_film(folder, times, VEHICLE, camera="camera5")
    with refuses("file-missing"):
        pf.read_film(filmed, 1.0, VEHICLE, camera="camera5")


def test_no_trajectory_is_made_from_it(pictures):
    film = pf.read_film(pictures, TIMES, VEHICLE, camera="camera5")
    with refuses("tracker-missing"):
        pf.reconstruct(film)


def test_the_command_writes_tables_and_figures_beside_the_pictures(filmed, command):
    """The option without a value keeps its meaning beside a flight folder, and what is left out is asked for."""
    pictures, times = filmed / "telemetry/camera5", filmed / "telemetry/frames.csv"
    alone = ["deflection", "--film", pictures, "--times", times, "--vehicle", VEHICLE]
    done = command(*alone, "--camera", "camera5")
    assert done.returncode == 0, done.stderr
    written = {path.name for path in (filmed / "telemetry/camera5-deflection").rglob("*.*")}
    assert {"answers.csv", "deflection_camera.csv", "camera_frames.csv", "consistency_checks.csv"} <= written
    assert {"deflection.png", "figure_2_3.png", "overlay.png", "report.html"} <= written
    page = (filmed / "telemetry/camera5-deflection/report.html").read_text()
    assert page.count("data:image/jpeg;base64,") >= 2
    assert "by video alone" in page
    assert printed_codes(command(*alone).stderr) == ["name-unknown"]
    for words in (alone[:3], alone[:5], [*alone, filmed], ["deflection", "--film"]):
        assert command(*words).returncode == 2

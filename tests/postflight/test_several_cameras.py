"""A flight folder with several cameras: read, checked, filmed by the simulator, and answered as one history."""

import cv2
import numpy as np
import pandas as pd
import pytest

from flightmodel.deflection import DeflectionHistory
from flightmodel.flightfolder import read_flight
from flightmodel.vehicle import read_vehicle
from postflight.checks.folder_check import check_folder
from postflight.filming import by_camera, with_largest
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
from tests.estimators.test_camera_deflection import film as rendered
from tests.postflight.test_bad_input import refused
from tests.refusing import printed_codes

SECOND = '\n[cameras.second]\nfile = "telemetry/second.csv"\nfolder = "telemetry/second"\ncamera = "camera5"\n'


@pytest.fixture
def two(flight):
    """The clean folder with the camera's table renamed, and a second camera of three frames."""
    flight.replace("flight.toml", "[frames]", "[cameras.camera5]")
    flight.append(SECOND + "benchmark_s = 421.0")
    (flight.root / "telemetry/second").mkdir()
    for k in range(3):
        picture = (flight.root / f"telemetry/camera5/frame_{k}.png").read_bytes()
        (flight.root / f"telemetry/second/frame_{k}.png").write_bytes(picture)
    flight.write_lines("second.csv", flight.lines("frames.csv"))
    return flight


def test_each_camera_has_its_film_mount_and_hash(two):
    telemetry = read_flight(two.root)
    assert list(telemetry.films) == ["camera5", "second"]
    assert telemetry.films["second"].camera == read_vehicle("irve2_reference").cameras["camera5"]
    assert {"camera5's pictures", "second's pictures"} <= set(telemetry.hashes)


def test_a_camera_goes_by_its_tables_name_without_a_mount(two):
    two.replace("flight.toml", "[cameras.second]", "[cameras.camera5_uncalibrated]")
    two.replace("flight.toml", 'second"\ncamera = "camera5"\n', 'second"\n')
    mount = read_flight(two.root).films["camera5_uncalibrated"].camera
    assert mount == read_vehicle("irve2_reference").cameras["camera5_uncalibrated"]


def test_one_camera_and_several_do_not_go_together(two):
    two.append('[frames]\nfile = "telemetry/frames.csv"\nfolder = "telemetry/camera5"')
    refused(two, "[frames]", "[cameras.NAME]", codes={"keys-conflict"})


def test_faults_name_the_camera(two):
    two.replace("flight.toml", 'second"\ncamera = "camera5"\n', 'second"\ncamera = "camera9"\n')
    refused(two, "cameras.second", "camera9", codes={"name-unknown"})


def test_check_tries_every_benchmark_frame(two):
    straight = rendered(4, [0.0], [0.0])[0]
    cv2.imwrite(str(two.root / "telemetry/camera5/frame_0.png"), straight)
    cv2.imwrite(str(two.root / "telemetry/second/frame_0.png"), 0 * straight)
    found = [(f.source, f.code) for f in check_folder(two.root).cross_checks]
    assert ("cameras.second", "frame-exposure") in found
    assert not [code for source, code in found if source == "cameras.camera5"]


TIMES_S = np.arange(421.0, 427.9, 0.5)
THETA_DEG = np.concatenate([[0.0, 0.0], np.linspace(0.3, 3.0, len(TIMES_S) - 2)])


def write_film(two, name, listed, seed, theta_deg):
    folder = two.root / "telemetry" / name
    rows = ["t_s,frame"]
    for k, picture in enumerate(rendered(seed, theta_deg, np.full(len(theta_deg), 160.0))):
        cv2.imwrite(str(folder / f"frame_{k}.png"), picture)
        rows.append(f"{TIMES_S[k]:.3f},frame_{k}.png")
    two.write_lines(listed, rows)


@pytest.fixture
def filmed(two):
    """Two cameras that look at the same motion."""
    write_film(two, "camera5", "frames.csv", 4, THETA_DEG)
    write_film(two, "second", "second.csv", 9, THETA_DEG)
    return two


def only_run(folder):
    (run,) = (folder / "runs").glob("2*")
    return run


def test_two_cameras_one_answer(filmed, command):
    done = command("deflection", filmed.root, "--method", "camera")
    assert done.returncode == 0, done.stderr
    run = only_run(filmed.root)
    answer = pd.read_csv(run / "deflection_camera.csv")
    error = answer["theta_deg"] - np.interp(answer["t_s"], TIMES_S, THETA_DEG)
    assert np.abs(error).max() < 0.3
    assert (np.abs(error) < 3.5 * answer["theta_sd_deg"]).all()
    assert pd.read_csv(run / "camera_frames.csv").groupby("camera").size().to_dict() == {"camera5": 14, "second": 14}
    assert pd.read_csv(run / "cameras.csv")["used"].all()
    assert {path.name for path in (run / "figures").glob("overlay_*.png")} == {
        "overlay_camera5.png",
        "overlay_second.png",
    }
    flight = read_flight(filmed.root)

    theta, plane = (np.deg2rad(answer[c].to_numpy()) for c in ("theta_deg", "plane_lv_deg"))
    history = DeflectionHistory(answer["t_s"].to_numpy(), theta, plane, None, "camera")
    each = by_camera(flight, history)
    assert list(each) == ["camera5", "second"]
    assert len(with_largest(flight, history)[1].time_s) == 14


def test_cameras_that_contradict_turn_a_check_red(filmed, command):
    write_film(filmed, "second", "second.csv", 9, np.concatenate([[0.0, 0.0], THETA_DEG[2:] + 2.0]))
    done = command("deflection", filmed.root, "--method", "camera")
    assert done.returncode == 0, done.stderr
    assert "cameras" in printed_codes(done.stdout)
    answer = pd.read_csv(only_run(filmed.root) / "deflection_camera.csv")
    assert (answer["theta_sd_deg"] > 0.3).all()


def test_a_film_that_cannot_be_used_does_not_stop_the_other(filmed, command):
    benchmark = filmed.root / "telemetry/second/frame_0.png"
    cv2.imwrite(str(benchmark), 0 * cv2.imread(str(benchmark)))
    done = command("deflection", filmed.root, "--method", "camera")
    assert done.returncode == 0, done.stderr
    assert "camera-refused" in printed_codes(done.stdout)
    assert set(pd.read_csv(only_run(filmed.root) / "camera_frames.csv")["camera"]) == {"camera5"}


def test_several_cameras_estimate_the_plane(filmed, command):
    done = command("deflection", filmed.root, "--method", "camera", "--plane", "153")
    assert done.returncode == 4
    assert "keys-conflict" in printed_codes(done.stdout)


def test_a_scenario_films_with_every_camera(tmp_path):
    text = read_scenario("irve2_reference").source.read_text()
    head, rest = text.split("[video]")
    _, tail = rest.split("[attitude_prior]")
    films = "".join(
        f'[videos.{name}]\ncamera = "{mount}"\nstart_s = {start}\nstop_s = {start + 1.0}\nrate_hz = 2.0\n'
        f"benchmark_s = {start}\n[videos.{name}.imaging]\nbuilt_deg = 0.3\n"
        for name, mount, start in (("left", "camera5", 421.0), ("right", "camera5_uncalibrated", 430.0))
    )
    path = tmp_path / "two.toml"
    path.write_text(head + films + "[attitude_prior]" + tail)
    simulate_to_folder(read_scenario(str(path)), 5, tmp_path / "flight")
    films = read_flight(tmp_path / "flight").films
    assert {name: len(film.time_s) for name, film in films.items()} == {"left": 3, "right": 3}
    assert films["right"].camera_name == "camera5_uncalibrated"
    assert films["right"].benchmark_s == 430.0

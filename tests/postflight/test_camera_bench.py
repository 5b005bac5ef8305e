"""The bench for a film: who may ask, what is answered, what a decision does, and the page in a browser."""

import http.client
import json
import signal
import subprocess
import threading
import time
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from flightmodel.camera_edits import read_edits
from flightmodel.checks import GateError
from flightmodel.vehicle import vehicle_path
from postflight.camera_bench import server as servers
from postflight.camera_bench.server import session_of
from postflight.filming import camera_film
from postflight.flight import read_flight
from tests.estimators.test_camera_deflection import film
from tests.postflight.killing import start_command

TIMES = (421.0, 425.0, 430.0, 435.0)
THETA, PLANE = (0.0, 1.5, 3.0, 4.2), (0.0, 170.0, 175.0, 180.0)
FLIGHT_TOML = """
name = "film alone"
t0_utc = "2009-08-17T12:52:00Z"
vehicle = "irve2_reference"

[frames]
file = "frames.csv"
folder = "film"
camera = "camera5"
benchmark_s = 421.0
"""


@pytest.fixture(scope="module")
def pictures():
    return film(12, THETA, PLANE)


@pytest.fixture
def folder(tmp_path: Path, pictures) -> Path:
    """A flight folder with a film and nothing else: no run is needed, and no trajectory."""
    (tmp_path / "film").mkdir()
    rows = ["t_s,frame"]
    for t, picture in zip(TIMES, pictures, strict=True):
        cv2.imwrite(str(tmp_path / "film" / f"{t:.0f}.png"), picture)
        rows.append(f"{t:.3f},{t:.0f}.png")
    (tmp_path / "frames.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "flight.toml").write_text(FLIGHT_TOML)
    return tmp_path


@pytest.fixture
def session(folder: Path):
    opened = session_of(read_flight(folder, needs_path=False), folder)
    yield opened
    opened.close()


@pytest.fixture
def finer(folder: Path, pictures) -> Path:
    """The same film by a camera of twice as many pixels a radian."""
    for t, picture in zip(TIMES, pictures, strict=True):
        cv2.imwrite(str(folder / "film" / f"{t:.0f}.png"), cv2.resize(picture, (1440, 960)))
    vehicle = vehicle_path("irve2_reference").read_text()
    start = vehicle.index("[cameras.camera5]")
    lens = (("720", "1440"), ("480", "960"), ("[310.0, 310.0]", "[620.0, 620.0]"), ("[361.3, 238.2]", "[723.1, 476.9]"))
    camera = vehicle[start:]
    for plain, fine in lens:
        assert camera.count(f"= {plain}") == 1
        camera = camera.replace(f"= {plain}", f"= {fine}")
    (folder / "vehicle.toml").write_text(vehicle[:start] + camera)
    (folder / "flight.toml").write_text(FLIGHT_TOML.replace('"irve2_reference"', '"vehicle.toml"'))
    return folder


def settled(session):
    """State once every frame has its fit."""
    for _ in range(400):
        state = session.state()
        if state["trouble"] or all(answer is not None for answer in state["answers"]):
            return state
        time.sleep(0.05)
    raise AssertionError("frames were not fitted")


def edit(kind, **more):
    return {"edit": kind, "name": "", "note": "", "t_s": None, "u_px": None, "v_px": None, "value": None, **more}


class TestSession:
    def test_it_answers_what_a_run_answers(self, session, folder):
        state = settled(session)
        run = camera_film(read_flight(folder, needs_path=False).with_(camera_plane_lv_deg=None)).history()
        found = [answer["theta_deg"] for answer in state["answers"]]
        np.testing.assert_allclose(found, np.rad2deg(run.theta_rad), atol=1e-9)
        np.testing.assert_allclose(found[1:], THETA[1:], atol=0.4)

    def test_a_decision_is_on_disk_and_counts_in_a_run(self, session, folder):
        state = settled(session)
        rows = [edit("reject", t_s=425.0, note="a bird"), edit("benchmark", t_s=425.0)]
        assert session.save(rows[:1], state["revision"])["answers"][1]["refused"]["code"] == "rejected-by-hand"
        state = session.save(rows, session.state()["revision"])
        assert state["benchmark"] == 1
        assert len(read_edits(folder / "camera_edits.csv", "camera5").rows) == 2
        telemetry = read_flight(folder, needs_path=False).telemetry
        assert telemetry.frames.benchmark == 1
        assert "camera_edits.csv" in telemetry.hashes
        assert [f.code for f in telemetry.findings if f.source == "frames"] == ["edited-by-hand"]
        # taken back, all is as it was
        state = session.save([], state["revision"])
        assert state["benchmark"] == 0
        assert not (folder / "camera_edits.csv").exists()
        assert settled(session)["answers"][1]["refused"] is None

    def test_only_what_a_decision_touches_is_fitted_anew(self, session):
        settled(session)
        before = dict(session._work.fits)
        rows = [edit("rim", t_s=430.0, u_px=300.0 + k, v_px=100.0) for k in range(2)]
        session.save(rows, session.state()["revision"])
        settled(session)
        assert [session._work.fits[k] is before[k] for k in range(4)] == [True, True, False, True]
        mask = [edit("mask", name="a", u_px=u, v_px=v) for u, v in ((10, 300), (90, 300), (90, 400))]
        session.save(mask, session.state()["revision"])
        settled(session)
        assert not any(session._work.fits[k] is before[k] for k in range(4))

    def test_what_cannot_be_meant_changes_nothing(self, session, folder):
        revision = session.state()["revision"]
        for rows, code in (
            ([edit("reject", t_s=1.0)], "time-not-covered"),
            ([edit("rim", t_s=430.0, u_px="x", v_px=3.0)], "edit-unusable"),
            (["reject"], "edit-unusable"),
            ([edit("reject", t_s=430.0, note=5)], "edit-unusable"),
        ):
            with pytest.raises(GateError) as refusal:
                session.save(rows, revision)
            assert refusal.value.codes == (code,)
        (folder / "camera_edits.csv").write_text("camera,t_s,edit,name,u_px,v_px,value,note\ncamera5,430,reject,,,,,\n")
        with pytest.raises(GateError) as refusal:
            session.save([], revision)
        assert refusal.value.codes == ("edits-changed",)

    def test_rows_of_another_camera_stay(self, folder):
        other = "camera5_uncalibrated,99.0000,reject,,,,,glare"
        (folder / "camera_edits.csv").write_text(f"camera,t_s,edit,name,u_px,v_px,value,note\n{other}\n")
        session = session_of(read_flight(folder, needs_path=False), folder)
        session.save([edit("accept", t_s=430.0)], session.state()["revision"])
        session.close()
        assert other in (folder / "camera_edits.csv").read_text()

    def test_a_camera_that_is_not_oriented_can_be_turned_by_hand(self, folder, pictures):
        cv2.imwrite(str(folder / "film" / "421.png"), np.zeros_like(pictures[0]))
        session = session_of(read_flight(folder, needs_path=False), folder)
        state = session.state()
        assert state["trouble"]["code"] == "frame-exposure"
        shown = session.frame(2, None, None, np.array([0.0, 0.0, 0.02, 1.0]))
        assert len(shown["outline"]) > 50
        assert len(shown["edge"]) > 50
        session.close()

    def test_pictures_of_a_finer_camera_are_read_smaller(self, finer):
        telemetry = read_flight(finer, needs_path=False).telemetry
        frames = telemetry.frames
        assert [f.code for f in telemetry.findings if f.source == "frames"] == ["frame-size"]
        assert frames.picture(1).shape == (480, 720)
        # the reference camera, to rounding: a pixel's middle is at half of the new pixel beside it
        np.testing.assert_allclose(frames.camera.focal_px, (310.0, 310.0))
        np.testing.assert_allclose(frames.camera.centre_px, (361.3, 238.2))
        # the centre's a priori sd is half as many pixels, as large an angle
        assert frames.camera.uncertainty.centre_px == 0.5 * telemetry.vehicle.cameras["camera5"].uncertainty.centre_px
        session = session_of(read_flight(finer, needs_path=False), finer)
        found = [answer["theta_deg"] for answer in settled(session)["answers"]]
        session.close()
        np.testing.assert_allclose(found[1:], THETA[1:], atol=0.4)

    def test_decisions_about_a_finer_camera_are_filed_in_its_own_pixels(self, finer):
        # the corner of a picture stays its corner, whatever the size of a pixel
        corner = -0.5
        session = session_of(read_flight(finer, needs_path=False), finer)
        mask = [edit("mask", name="a", u_px=u, v_px=v) for u, v in ((corner, corner), (99.5, corner), (99.5, 49.5))]
        session.save(mask, session.state()["revision"])
        session.close()
        filed = read_edits(finer / "camera_edits.csv", "camera5").masks_px(430.0)[0]
        np.testing.assert_allclose(filed, [(corner, corner), (199.5, corner), (199.5, 99.5)])
        again = read_flight(finer, needs_path=False).telemetry.frames.edits.masks_px(430.0)[0]
        np.testing.assert_allclose(again, [(corner, corner), (99.5, corner), (99.5, 49.5)])

    def test_a_tried_deflection_shows_its_residual(self, session):
        settled(session)
        right, off = (session.frame(3, np.deg2rad(angle), np.deg2rad(180.0), None)["rms_px"] for angle in (4.2, 6.0))
        assert right < 1.0
        assert off > 4.0


@pytest.fixture
def served(session):
    server, address = servers.serve(session)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield address
    server.shutdown()
    server.server_close()
    thread.join()


def asked(address, path="state", method="GET", body=None, **headers):
    """Status, headers and body of a request; ``path`` from the site's root where it begins with a slash."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
    connection.request(method, path if path.startswith("/") else parts.path + path, body, headers)
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


class TestServer:
    def test_it_listens_on_this_machine_alone_and_only_with_the_token(self, served):
        assert urlsplit(served).hostname == "127.0.0.1"
        assert len(urlsplit(served).path) > 30
        assert asked(served)[0] == 200
        for path in ("/", "/state", "/wrong/state", urlsplit(served).path.rstrip("/"), "/../etc/passwd"):
            assert asked(served, path)[0] == 404, path
        for path in ("frame/99", "frame/-1", "frame/x", "picture/1e9", "nothing", "page.py", "..%2fserver.py"):
            assert asked(served, path)[0] == 404, path

    def test_another_sites_name_for_this_machine_is_refused(self, served):
        assert asked(served, Host="rebound.example:80")[0] == 400
        assert asked(served, Host="localhost:80")[0] == 200

    def test_pages_load_nothing_from_elsewhere_and_tell_nobody_their_address(self, served):
        for path in ("", "page.js", "page.css", "state", "/nothing"):
            _, headers, body = asked(served, path)
            assert headers["Content-Security-Policy"].startswith("default-src 'none'")
            assert headers["Referrer-Policy"] == "no-referrer"
            assert headers["Cache-Control"] == "no-store"
            assert b"http://" not in body
            assert b"https://" not in body

    def test_only_the_page_itself_may_change_anything(self, served, session):
        origin = f"http://127.0.0.1:{urlsplit(served).port}"
        content = json.dumps({"edits": [edit("reject", t_s=430.0)], "revision": session.state()["revision"]})
        kind = {"Content-Type": "application/json"}
        for headers in (
            kind, {**kind, "Origin": "http://evil.example"}, {**kind, "Origin": "null"},
            {"Origin": origin}, {"Origin": origin, "Content-Type": "text/plain"},
        ):  # fmt: skip
            assert asked(served, "edits", "POST", content, **headers)[0] == 400, headers
        good = {**kind, "Origin": origin}
        for broken in ("", "[]", "{}", '{"edits": 1, "revision": ""}', "[" * 100_000):
            assert asked(served, "edits", "POST", broken, **good)[0] == 400, broken[:20]
        assert asked(served, "edits", "POST", b" " * 5_000_000, **good)[0] == 413
        assert asked(served, "state", "DELETE")[0] == 400
        assert session.state()["edits"] == []
        assert asked(served, "edits", "POST", content, **good)[0] == 200
        status, _, body = asked(served, "edits", "POST", content, **good)
        assert (status, json.loads(body)["faults"][0]["code"]) == (409, "edits-changed")

    def test_a_taken_port_is_refused_by_name(self, served, folder, command):
        done = command("camera", folder, "--no-browser", "--port", str(urlsplit(served).port))
        assert done.returncode == 3
        assert "port-taken" in done.stderr

    def test_a_camera_that_is_not_there_is_refused_by_name(self, folder, command):
        done = command("camera", folder, "--no-browser", "--camera", "camra5")
        assert done.returncode == 2
        assert "name-unknown" in done.stderr
        assert "camera5" in done.stderr

    def test_a_flight_without_video_is_refused_by_name(self, folder, command):
        spec = tomllib.loads((folder / "flight.toml").read_text())
        (folder / "flight.toml").write_text(f'name = "{spec["name"]}"\nt0_utc = "{spec["t0_utc"]}"\n')
        done = command("camera", folder, "--no-browser")
        assert done.returncode in (2, 3)
        assert "Traceback" not in done.stderr


def has(page, where: str, words: str) -> None:
    """Wait until a part of the page shows words; the page's own policy forbids to evaluate scripts in it."""
    for _ in range(200):
        if words in page.locator(where).text_content():
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"{where} shows {page.locator(where).text_content()!r}, not {words!r}")


def residual(page, fits) -> None:
    """Wait until the residual of what is tried is as wanted."""
    for _ in range(200):
        words = page.locator("#tried").text_content()
        if words and fits(float(words.split()[0])):
            return
        page.wait_for_timeout(50)
    raise AssertionError(words)


def test_the_command_serves_until_it_is_interrupted(folder):
    process = start_command("camera", folder, "--no-browser", stdout=subprocess.PIPE, text=True)
    try:
        lines = iter(process.stdout.readline, "")
        address = next(line for line in lines if "http://127.0.0.1:" in line).split()[-1]
        assert asked(address)[0] == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "Traceback" not in errors


@pytest.mark.browser
class TestPage:
    @pytest.fixture
    def page(self, browser, served):
        opened = browser.new_page(viewport={"width": 1500, "height": 1000})
        said: list[str] = []
        opened.on("console", lambda message: said.append(message.text))
        opened.on("pageerror", lambda fault: said.append(str(fault)))
        opened.goto(served)
        has(opened, "#time", "benchmark frame")
        has(opened, "#status", "4 of 4 frames fitted")
        yield opened
        assert said == []
        opened.close()

    def test_stepping_shows_each_frames_answer(self, page):
        has(page, "#time", "benchmark frame")
        for _ in range(3):
            page.keyboard.press("ArrowRight")
        has(page, "#time", "435.000")
        has(page, "#answer", "4.")
        angle = float(page.locator("#answer dd").first.text_content().split()[0])
        assert angle == pytest.approx(4.2, abs=0.4)

    def test_a_frame_is_rejected_and_taken_back(self, page, folder):
        page.keyboard.press("ArrowRight")
        has(page, "#time", "425.000")
        page.fill("#note", "<b>a bird</b>")
        page.click("#reject")
        has(page, "#refused", "rejected-by-hand")
        assert page.locator("#edits b").count() == 0  # no text becomes markup
        assert "reject" in (folder / "camera_edits.csv").read_text()
        page.locator("#edits button").click()
        has(page, "#answer", "edge points")
        assert page.locator("#refused").text_content() == ""
        assert not (folder / "camera_edits.csv").exists()

    def test_a_region_is_masked_by_its_corners(self, page, folder):
        page.check("input[value=mask]")
        box = page.locator("#picture").bounding_box()
        for u, v in ((0.3, 0.6), (0.5, 0.6), (0.5, 0.8)):
            page.mouse.click(box["x"] + u * box["width"], box["y"] + v * box["height"])
        page.click("#close-mask")
        has(page, "#edits", "mask 1")
        rows = read_edits(folder / "camera_edits.csv", "camera5").rows
        assert len(rows) == 3
        np.testing.assert_allclose([rows[0].u_px, rows[0].v_px], [0.3 * 720, 0.6 * 480], atol=1.5)

    def test_a_dragged_deflection_shows_its_residual(self, page):
        page.keyboard.press("End")
        has(page, "#time", "435.000")
        page.locator("#theta").evaluate("e => { e.value = 8; e.dispatchEvent(new Event('input')); }")
        residual(page, lambda rms: rms > 4.0)
        page.click("#own")
        residual(page, lambda rms: rms < 1.5)

"""A flight folder that someone prepared: pipes, devices, links that lead out, files without an end, truth by a link.

Each command must answer in words, at once. A pipe at which a reader waits would hang; hence the processes and the time.
"""

import os
import shutil
import subprocess
import sys

import pytest

from flightmodel.checks import ConfigError
from flightmodel.config import LARGEST_TOML_BYTES, read_toml
from flightmodel.files import UnfitFile, file_bytes, leads_outside, open_file
from flightmodel.flightfolder import read_flight
from flightmodel.vehicle import DATA
from tests.refusing import printed_codes, refuses

WITHIN_S = 60.0  # imports of a busy machine; a reader that hangs never ends
FILES = ("flight.toml", "vehicle.toml", "telemetry/rates.csv", "telemetry/frames.csv", "telemetry/camera5/frame_1.png")


def pipe(path):
    os.mkfifo(path)


def endless(path):
    path.symlink_to("/dev/zero")


def socket_(path):
    import socket

    with socket.socket(socket.AF_UNIX) as made:
        here = os.getcwd()
        os.chdir(path.parent)  # names of sockets are short
        try:
            made.bind(path.name)
        finally:
            os.chdir(here)


def huge(path):
    with path.open("wb") as file:
        file.truncate(3 * 1024**4)  # sparse: takes no room


@pytest.fixture
def with_vehicle(flight):
    """The hand-made flight with a vehicle file and coefficients of its own."""
    for suffix in ("toml", "csv"):
        shutil.copyfile(DATA / "aerodynamics" / f"irve2_reference.{suffix}", flight.root / f"aero.{suffix}")
    text = (DATA / "vehicles" / "irve2_reference.toml").read_text().replace("irve2_reference.csv", "aero.csv")
    (flight.root / "vehicle.toml").write_text(text)
    flight.replace("flight.toml", '"irve2_reference"', '"vehicle.toml"')
    assert read_flight(flight.root).vehicle is not None
    return flight


def check(folder):
    return subprocess.run(
        [sys.executable, "-m", "postflight.cli", "check", str(folder)],
        capture_output=True, text=True, timeout=WITHIN_S, env={**os.environ, "COLUMNS": "300"},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "spoil"), [*((n, pipe) for n in FILES), *((n, endless) for n in FILES), (FILES[2], socket_)]
)
def test_what_is_no_file_is_refused_and_not_waited_for(with_vehicle, name, spoil):
    path = with_vehicle.root / name
    path.unlink()
    spoil(path)
    done = check(with_vehicle.root)
    assert done.returncode in (2, 3)
    assert "Traceback" not in done.stderr
    inside = "not-a-file" if spoil is not endless or name in ("flight.toml", "vehicle.toml") else "path-refused"
    assert inside in printed_codes(done.stdout + done.stderr), done.stdout + done.stderr
    assert path.name in done.stdout + done.stderr


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_terabytes_is_refused_before_it_is_read(with_vehicle, command, name):
    path = with_vehicle.root / name
    try:
        huge(path)
    except OSError:
        pytest.skip("no sparse files of this size here")
    done = command("check", with_vehicle.root)
    assert "file-too-large" in printed_codes(done.stdout + done.stderr), done.stdout + done.stderr


@pytest.mark.parametrize("name", ["aero.csv", "aero.toml"])
def test_a_file_beside_the_vehicle_that_is_a_link_out(with_vehicle, name):
    """Its lines would be shown in the refusal."""
    secret = with_vehicle.root.parent / "secret"
    secret.write_text("password = of somebody\n")
    (with_vehicle.root / name).unlink()
    (with_vehicle.root / name).symlink_to(secret)
    with refuses("path-refused", names=[name], kind=ConfigError) as caught:
        read_flight(with_vehicle.root)
    assert "password" not in str(caught.value)


def test_links_inside_the_folder_are_read(with_vehicle):
    root = with_vehicle.root
    (root / "aero.csv").rename(root / "telemetry/coefficients.csv")
    (root / "aero.csv").symlink_to("telemetry/coefficients.csv")
    (root / "telemetry/rates.csv").rename(root / "rates.csv")
    (root / "telemetry/rates.csv").symlink_to("../rates.csv")
    assert read_flight(root).rates is not None


def test_truth_by_a_hard_link_is_refused(flight):
    truth = flight.root / "truth" / "deep"
    truth.mkdir(parents=True)
    shutil.copyfile(flight.path("rates.csv"), truth / "rates.csv")
    flight.path("rates.csv").unlink()
    os.link(truth / "rates.csv", flight.path("rates.csv"))
    with refuses("path-refused", names=["rates.csv"]):
        read_flight(flight.root)


def test_a_hard_link_to_another_file_is_read(flight):
    (flight.root / "truth").mkdir()
    shutil.copyfile(flight.path("rates.csv"), flight.root / "truth" / "rates.csv")
    os.link(flight.path("rates.csv"), flight.root / "again.csv")
    assert read_flight(flight.root).rates is not None


def test_a_vehicle_from_the_truth_is_refused(with_vehicle):
    (with_vehicle.root / "truth").mkdir()
    for name in ("vehicle.toml", "aero.csv", "aero.toml"):
        shutil.move(with_vehicle.root / name, with_vehicle.root / "truth" / name)
    with_vehicle.replace("flight.toml", '"vehicle.toml"', '"truth/vehicle.toml"')
    with refuses("path-refused", kind=ConfigError):
        read_flight(with_vehicle.root)


@pytest.mark.parametrize("name", ["summary.json", "bet.csv", "bet_header.json", "run.json"])
@pytest.mark.parametrize("verb", [["report"], ["score"], ["export", "--to", "csv"]])
def test_a_run_folder_with_a_pipe(flight, command, name, verb):
    run = flight.root / "runs" / "20260101T000000Z-00000000"
    run.mkdir(parents=True)
    for other in ("summary.json", "run.json", "bet_header.json"):
        (run / other).write_text("{}")
    (run / name).unlink(missing_ok=True)
    pipe(run / name)
    (flight.root / "truth").mkdir()
    for table in ("truth", "deflection"):
        (flight.root / "truth" / f"{table}.csv").write_text("t_s\n")
    done = command(verb[0], flight.root, *verb[1:])
    assert done.returncode in (2, 3)
    assert "Traceback" not in done.stderr, done.stderr


def test_a_vehicle_file_of_its_table_s_name_is_one_fault(with_vehicle):
    """The sidecar of vehicle.csv would be vehicle.toml, which is no sidecar in twenty ways."""
    root = with_vehicle.root
    (root / "aero.csv").rename(root / "vehicle.csv")
    text = (root / "vehicle.toml").read_text()
    (root / "vehicle.toml").write_text(text.replace('"aero.csv"', '"vehicle.csv"'))
    with refuses("keys-conflict", names=["vehicle.csv"], kind=ConfigError) as caught:
        read_flight(root)
    assert len(caught.value.faults) == 1


def test_what_grows_while_it_is_read_has_an_end(tmp_path):
    """A file of /proc states no size."""
    status = "/proc/self/status"
    if not os.path.exists(status):
        pytest.skip("no /proc here")
    (tmp_path / "link").symlink_to(status)
    assert file_bytes(tmp_path / "link")
    with pytest.raises(UnfitFile) as caught:
        file_bytes(tmp_path / "link", most_bytes=100)
    assert caught.value.code == "file-too-large"


def test_the_limit_is_the_largest_that_passes(tmp_path):
    path = tmp_path / "f.toml"
    path.write_bytes(b"#" * LARGEST_TOML_BYTES)
    assert read_toml(path) == {}
    path.write_bytes(b"#" * (LARGEST_TOML_BYTES + 1))
    with refuses("file-too-large", kind=ConfigError):
        read_toml(path)


def test_opening_a_pipe_returns_at_once(tmp_path):
    pipe(tmp_path / "pipe")
    with pytest.raises(UnfitFile) as caught:
        open_file(tmp_path / "pipe")
    assert caught.value.code == "not-a-file"


def test_what_leads_outside(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "up").symlink_to("..")
    assert [leads_outside(inner, name) for name in ("a", "b/../a", "../a", "up/a", "up/inner/a")] == [
        False, False, True, True, False
    ]  # fmt: skip

"""The folder of a synthetic flight takes its place whole; what killed processes left goes with the next flight."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from flightmodel.checks import GateError
from flightmodel.files import machine
from flightmodel.flightfolder import read_flight
from flightmodel.instruments import GNSS, RADAR
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.instrument_errors import Gnss
from synthetic_flight.scenarios import read_scenario


@pytest.fixture(scope="module")
def short():
    """Nine seconds around 100 km, no video."""
    scenario = read_scenario("irve2_reference")
    time = scenario.spec.time.model_copy(update={"stop_s": 99.0, "telemetry_from_s": 91.0})
    prior = scenario.spec.attitude_prior.model_copy(update={"t_s": 92.0})
    update = {"video": None, "time": time, "attitude_prior": prior}
    return replace(scenario, spec=scenario.spec.model_copy(update=update))


def dead_process_number():
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_leftovers_of_dead_processes_are_removed_and_of_living_ones_left(tmp_path, short):
    dead, here, other = dead_process_number(), machine(), "0" * 8
    left = {f".partial-{here}-{dead}-00000000-a", f".old-{here}-{dead}-00000000-a"}
    running = {f".partial-{here}-1-00000000-a", f".partial-{other}-{dead}-00000000-a"}
    kept = running | {f".partial-{here}-{dead}-00000000-ab", ".partial-notes-a"}
    for name in left | kept:
        (tmp_path / name).mkdir()
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "flight.toml").touch()
    (tmp_path / "a" / "truth").mkdir()
    (tmp_path / "a" / "truth" / "run.json").touch()
    simulate_to_folder(short, 0, tmp_path / "a", replace=True)
    assert {p.name for p in tmp_path.iterdir()} == {"a", *kept}


def test_an_old_flight_whose_successor_was_never_put_in_place_comes_back(tmp_path, short):
    simulate_to_folder(short, 0, tmp_path / "a")
    (tmp_path / "a").rename(tmp_path / f".old-{machine()}-{dead_process_number()}-00000000-a")
    with pytest.raises(GateError) as refusal:
        simulate_to_folder(short, 1, tmp_path / "a")
    assert refusal.value.codes == ("file-exists",)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_a_link_is_followed_and_stays_a_link(tmp_path, short):
    simulate_to_folder(short, 0, tmp_path / "real")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with pytest.raises(GateError) as refusal:
        simulate_to_folder(short, 1, tmp_path / "link")
    assert refusal.value.codes == ("file-exists",)
    before = (tmp_path / "real" / "flight.toml").stat().st_ino
    simulate_to_folder(short, 1, tmp_path / "link", replace=True)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "flight.toml").stat().st_ino != before


def test_a_flight_too_short_for_its_telemetry_says_so(tmp_path, short):
    time = short.spec.time.model_copy(update={"telemetry_from_s": 98.5})
    late = replace(short, spec=short.spec.model_copy(update={"time": time}))
    with pytest.raises(GateError) as refusal:
        simulate_to_folder(late, 0, tmp_path / "a")
    assert refusal.value.codes == ("time-not-covered",)
    assert "99.00 s" in str(refusal.value)
    assert "time.telemetry_from_s = 98.5" in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


def test_the_folder_states_every_error_that_its_trackers_were_given(tmp_path, short):
    """An error that the simulator draws and the folder is silent about makes every error bar too small."""
    first = short.spec.radars["wallops_island"]
    sizes = {key: 0.01 for key in RADAR.scenario_keys() if key != "refraction_left"}
    radar = first.model_copy(update=sizes | {"angle_servo_hz": 2.0})
    receiver = Gnss(rate_hz=5.0, **dict.fromkeys(GNSS.scenario_keys(), 0.01))
    spec = short.spec.model_copy(update={"radars": {"r": radar}, "gnss": {"g": receiver}})
    simulate_to_folder(replace(short, spec=spec), 0, tmp_path / "a")
    telemetry = read_flight(tmp_path / "a")
    for table, drawn, stated in (
        (RADAR, radar, telemetry.radars["r"].spec),
        (GNSS, receiver, telemetry.gnss["g"].spec),
    ):
        for name, sizes in table.from_scenario(drawn).items():
            if any(sizes):
                assert getattr(stated, name) == pytest.approx(np.linalg.norm(sizes), rel=1e-3), name
    assert telemetry.radars["r"].range_rate_mps is not None
    assert telemetry.radars["r"].spec.angle_servo_hz == 2.0

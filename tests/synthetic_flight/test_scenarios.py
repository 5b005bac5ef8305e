"""What a scenario's gate tells of keys that do not fit each other, and that a delivered folder holds by itself."""

import re
import shutil
from pathlib import Path

import pytest

from flightmodel.checks import ConfigError
from flightmodel.config import KeyFaults, Section, parse_section
from flightmodel.flightfolder import read_flight
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
from tests.refusing import refuses

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_vehicle"
TABLE = "mach,alpha_deg,ca,cn,cm,cmq\n" + "".join(
    f"{mach},{alpha},{1.5 - alpha / 90.0},{0.3 * push},{-0.1 * push},-0.1\n"
    for mach in (0, 5)
    for alpha, push in zip(range(0, 181, 30), (0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0), strict=True)
)
SIDECAR = 'source = "made up"\nlicence = "CC0"\narea_m2 = 3.1416\nlength_m = 2.0\nmoment_reference_station_m = 0.0\n'


def write(folder: Path, scenario: dict[str, str] | None = None, vehicle: dict[str, str] | None = None) -> str:
    for name, changes in (("scenario.toml", scenario or {}), ("vehicle.toml", vehicle or {})):
        text = (EXAMPLE / name).read_text()
        for old, new in changes.items():
            assert old in text, old
            text = text.replace(old, new, 1)
        (folder / name).write_text(text)
    return str(folder / "scenario.toml")


def own_table() -> dict[str, str]:
    text = (EXAMPLE / "vehicle.toml").read_text()
    cone = text[text.index("[aerodynamics.sphere_cone]") : text.index("[aerodynamics.free_molecular]")]
    return {cone: '[aerodynamics]\ntable = "tables/mine.csv"\n'}


def test_a_folder_with_a_vehicle_and_a_table_of_ones_own_may_be_moved(tmp_path):
    given = tmp_path / "given"
    (given / "tables").mkdir(parents=True)
    (given / "tables" / "mine.csv").write_text(TABLE)
    (given / "tables" / "mine.toml").write_text(SIDECAR)
    name = write(
        given, {"stop_s = 90.0": "stop_s = 6.0", 'name = "own_vehicle"': 'name = "\u00e4 \U0001f680 \\""'}, own_table()
    )
    simulate_to_folder(read_scenario(name), 1, tmp_path / "flight")
    moved = (tmp_path / "flight").rename(tmp_path / "moved")
    shutil.rmtree(given)
    assert str(tmp_path) not in (moved / "flight.toml").read_text(encoding="utf-8")
    flight = read_flight(moved)
    assert flight.name == '\u00e4 \U0001f680 "'
    assert flight.vehicle.source == moved / "vehicle" / "vehicle.toml"
    assert flight.vehicle.aero.coefficients.shape == (2, 7, 4)


FROM = "telemetry_from_s = 2.0"


@pytest.mark.parametrize(
    ("old", "new", "key", "code", "datum"),
    [
        (FROM, f"{FROM}\nrecord_s = 0.005", "time.record_s", "keys-conflict", "0.004"),
        (FROM, f"{FROM}\nrecord_s = 7.0", "time.record_s", "keys-conflict", "6.92307692"),
        (FROM, f"{FROM}\nstep_s = 1e-8\nrecord_s = 1e-8", "time.step_s", "keys-conflict", "1e-08"),
        ("[rates]", "[rates]\nbandwidth_hz = 1e-200", "rates.bandwidth_hz", "key-value", "0.001"),
        ("[rates]", "[rates]\ndropouts = { mean_s = 3.0 }", "rates.dropouts.rate_hz", "keys-conflict", "mean_s"),
        ("spin_rpm = 4.0", "spin_rpm = 4001.0", "initial.spin_rpm", "key-value", "1000"),
    ],
)
def test_a_fault_between_keys_names_the_key_and_what_to_try(tmp_path, old, new, key, code, datum):
    with pytest.raises(ConfigError) as caught:
        read_scenario(write(tmp_path, {old: new}))
    (told,) = [fault for fault in caught.value.faults if f"key '{key}'" in fault]
    assert told.code == code
    assert datum in told
    assert "{" not in told


def test_a_table_elsewhere_or_pushing_sideways_in_axial_flow_is_refused(tmp_path):
    far = {old: new.replace("tables/", "../tables/") for old, new in own_table().items()}
    with refuses("key-value", names=["'aerodynamics.table'", re.escape("../tables/")], kind=ConfigError):
        read_scenario(write(tmp_path, vehicle=far))
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "mine.csv").write_text(TABLE.replace("5,0,1.5,0.0,", "5,0,1.5,0.02,"))
    (tmp_path / "tables" / "mine.toml").write_text(SIDECAR)
    with refuses("aero-grid", names=[r"line 9\b", "'cn'", r"\b0\.02\b"]):
        read_scenario(write(tmp_path, vehicle=own_table()))


def test_text_and_truth_values_are_no_numbers_and_whole_numbers_are():
    class Some(Section):
        size: float
        flag: bool = False
        row: tuple[float, ...] = ()

    assert parse_section(Some, {"size": 3, "row": [1, 2.5]}, "x").row == (1.0, 2.5)
    for wrong in ({"size": True}, {"size": "3"}, {"size": 3, "flag": 1}, {"size": 3, "row": [1, "2"]}):
        with refuses("key-value", names=["'(size|flag|row)'"], kind=ConfigError):
            parse_section(Some, wrong, "x")
    assert re.search(r"\bsize\b.*\b3\b", str(KeyFaults([("size", 3, "too much")])))


def test_a_radar_without_points_is_named_with_what_took_them(tmp_path):
    name = write(tmp_path, {"stop_s = 90.0": "stop_s = 6.0", "range_sd_m": "max_range_m = 10.0\nrange_sd_m"})
    with refuses("track-short", names=[r"radars\.\w+", r"max_range_m = 10\b"]):
        simulate_to_folder(read_scenario(name), 1, tmp_path / "flight")


GNSS = """
[gnss.gps]
rate_hz = 5.0
antenna_from_datum_body_m = [-0.9, 0.1, 0.0]
horizontal_sd_m = 3.0
vertical_sd_m = 5.0
speed_sd_mps = 0.1
vertical_speed_sd_mps = 0.2
time_bias_s = 0.01
"""


def test_a_package_of_any_name_and_a_receiver_without_a_radar_are_read_back(tmp_path):
    """What is delivered is what is read: package axes and place, the receiver's antenna and stated errors."""
    radar = (EXAMPLE / "scenario.toml").read_text()
    radar = radar[radar.index("[radars.shore]") : radar.index("[attitude_prior]")]
    scenario = write(
        tmp_path,
        {radar: GNSS, "[accelerometer]": '[accelerometer]\nmount = "imu-2"', "stop_s = 90.0": "stop_s = 6.0"},
        {"[sensors.suba]": "[sensors.imu-2]"},
    )
    simulate_to_folder(read_scenario(scenario), 3, tmp_path / "flight")
    flight = read_flight(tmp_path / "flight")
    assert not flight.radars
    mount = flight.vehicle.sensors["imu-2"]
    assert flight.accelerometer.spec.dcm_body_sensor.tolist() == mount.dcm_body_sensor.tolist()
    assert flight.accelerometer.spec.position_from_datum_body_m.tolist() == [-0.6, 0.0, 0.0]
    spec = flight.gnss["gps"].spec
    assert spec.antenna_from_datum_body_m.tolist() == [-0.9, 0.1, 0.0]
    assert (spec.horizontal_sd_m, spec.vertical_speed_sd_mps, spec.wander_sd_m, spec.time_bias_sd_s) == (
        3.0,
        0.2,
        0.0,
        0.01,
    )


@pytest.mark.parametrize(
    ("changes", "codes", "names"),
    [
        ({"[accelerometer]": '[accelerometer]\nmount = "sub"'}, {"name-unknown"}, ["accelerometer.mount", "suba"]),
        ({"[radars.shore]": "[gnss.shore]"}, {"key-unknown", "key-missing"}, ["horizontal_sd_m"]),
        ({"[attitude_prior]": GNSS.replace("gps", "shore") + "[attitude_prior]"}, {"keys-conflict"}, [r"gnss\.shore"]),
        ({"[atmosphere]": "[[events]]\nname = 'x'\nt_s = 'y'\n[atmosphere]"}, {"key-value"}, ["events.0.t_s"]),
    ],
)
def test_faults_of_trackers_packages_and_events_are_named(tmp_path, changes, codes, names):
    with refuses(*codes, names=names, kind=ConfigError):
        read_scenario(write(tmp_path, changes))


def test_a_scenario_needs_some_tracker(tmp_path):
    radar = (EXAMPLE / "scenario.toml").read_text()
    radar = radar[radar.index("[radars.shore]") : radar.index("[attitude_prior]")]
    with refuses("keys-conflict", names=["radars", "gnss"], kind=ConfigError):
        read_scenario(write(tmp_path, {radar: ""}))

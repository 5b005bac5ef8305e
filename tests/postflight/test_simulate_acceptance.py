"""`postflight simulate` met from outside: wrong files are refused in words, and what is delivered fits the truth."""

import filecmp
import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from postflight import cli
from tests.refusing import numbers_in, printed_codes

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_vehicle"
GM, J2, EARTH_A, EARTH_RATE = 3.986004418e14, 1.082629821313e-3, 6378137.0, 7.292115e-5
SCENARIO = """\
name = "accept"
t0_utc = "2009-08-17T12:52:00Z"
vehicle = "vehicle.toml"
[time]
start_s = 0.0
stop_s = 8.0
telemetry_from_s = 2.0
step_s = 0.002
record_s = 0.01
[initial]
latitude_deg = 37.3
longitude_deg = -74.6
altitude_m = 60000.0
speed_mps = 1400.0
flight_path_deg = -76.0
azimuth_deg = 130.0
nose_azimuth_deg = 130.0
nose_elevation_deg = -73.0
spin_rpm = 20.0
[atmosphere]
winds = false
density_sd = 0.0
wind_sd_mps = 0.0
[accelerometer]
rate_hz = 100.0
noise_mps2 = 0.05
bias_mps2 = 0.1
scale = 0.003
mount_deg = 0.2
[rates]
rate_hz = 100.0
noise_degps = 0.05
bias_degps = 0.0
scale = 0.0
mount_deg = 0.0
[radars.shore]
latitude_deg = 37.841
longitude_deg = -75.485
height_m = 12.0
rate_hz = 10.0
range_sd_m = 5.0
angle_sd_deg = 0.0086
range_bias_m = 3.0
angle_bias_deg = 0.003
time_bias_s = 0.001
[attitude_prior]
t_s = 2.0
sd_deg = 3.0
"""
VIDEO = '\n[video]\ncamera = "camera5"\nstart_s = 4.0\nstop_s = 5.0\nrate_hz = 2.0\nbenchmark_s = 4.0\n'
MAGNETOMETER = (
    '\n[magnetometer]\nmount = "suba"\nrate_hz = 9.0\nnoise_ut = 1.0\nbias_ut = 0.0\nscale = 0.0\nmount_deg = 0.0\n'
)


BOTH = '[aerodynamics]\ntable = "x.csv"\n'
POCKET = "{ altitude_m = 5e4, depth = 1.0, thickness_m = 1e3 }"
GUST = "{ sd_mps = -1.0, length_m = 6e2, from_m = 4e4, to_m = 5e4 }"


@pytest.fixture
def simulate(tmp_path, monkeypatch, capsys):
    """Fly a scenario in which texts are replaced; the command runs in this process, so that a traceback fails here."""

    def change(text: str, changes: dict[str, str]) -> str:
        for old, new in changes.items():
            assert text.count(old) >= 1, old
            text = text.replace(old, new, 1)
        return text

    def run(scenario=None, vehicle=None, more="", name="case", files=None):
        place = tmp_path / name
        place.mkdir()
        (place / "scenario.toml").write_text(change(SCENARIO, scenario or {}) + more)
        (place / "vehicle.toml").write_text(change((EXAMPLE / "vehicle.toml").read_text(), vehicle or {}))
        for file, text in (files or {}).items():
            (place / file).write_text(text)
        given = set(place.iterdir())
        monkeypatch.setattr(
            sys, "argv", ["postflight", "simulate", f"{place / 'scenario.toml'}", f"{place / 'flight'}"]
        )
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
        told = capsys.readouterr()
        assert code == 0 or set(place.iterdir()) == given, "something is left behind"
        return SimpleNamespace(code=code, out=told.out, err=told.err, folder=place / "flight")

    return run


def table(flight, name: str) -> pd.DataFrame:
    return pd.read_csv(flight.folder / f"{name}.csv")


def refused(done, codes: str, *names: str) -> None:
    """Refused by exactly these codes, with every name or number in the message."""
    assert done.code in (2, 3), f"accepted, or another end: {done.code}"
    assert set(printed_codes(done.err)) == set(codes.split()), done.err
    for name in names:
        assert name in done.err, done.err


@pytest.mark.parametrize(
    ("old", "new", "codes", "names"),
    [
        ("stop_s = 8.0", "stpo_s = 8.0", "key-unknown key-missing", ("time.stpo_s", "'stop_s'")),
        ("telemetry_from_s = 2.0", "telemetry_from_s = 9.0", "keys-conflict", ("telemetry_from_s",)),
        ("density_sd = 0.0", "density_sd = -0.1", "key-value", ("atmosphere.density_sd", "-0.1")),
        ("winds = false", 'base = "us67"', "key-value", ("atmosphere.base", "'us76'")),
        ('"vehicle.toml"', '"irve2_referense"', "name-unknown", ("'irve2_reference'",)),
        ("winds = false", f"pockets = [{POCKET}]", "key-value", ("pockets.0.depth",)),
        ("winds = false", f"gusts = [{GUST}]", "key-value", ("gusts.0.sd_mps",)),
    ],
)
def test_a_wrong_scenario_is_refused_with_file_key_and_remedy(simulate, old, new, codes, names):
    refused(simulate({old: new}), codes, *names)


@pytest.mark.parametrize(
    ("old", "new", "code", "key"),
    [
        ("latitude_deg = 37.3", "latitude_deg = 90.1", "key-value", "initial.latitude_deg"),
        ("latitude_deg = 37.841", "latitude_deg = 540.0", "key-value", "radars.shore.latitude_deg"),
        ("altitude_m = 60000.0", "altitude_m = -50.0", "key-value", "initial.altitude_m"),
        ("spin_rpm = 20.0", "spin_rpm = true", "key-value", "initial.spin_rpm"),
        ("stop_s = 8.0", 'stop_s = "8.0"', "key-value", "time.stop_s"),
        ("2009-08-17T12:52:00Z", "yesterday", "key-value", "t0_utc"),
        ("radars.shore]", 'radars."a/b"]', "option-format", "radars"),
        # enormous ones
        ("stop_s = 8.0", "stop_s = 1e300", "key-value", ""),
        ("record_s = 0.01", "record_s = 1e300", "key-value", ""),
        ("stop_s = 8.0", "stop_s = 8.0\ninflated_s = 1e300", "key-value", ""),
        ("step_s = 0.002\nrecord_s = 0.01", "step_s = 1e-10\nrecord_s = 1e-10", "key-value", ""),
        ("rate_hz = 100.0", "rate_hz = 1e300", "key-value", ""),
        ("rate_hz = 100.0", "rate_hz = 100.0\nbandwidth_hz = 1e300", "key-value", ""),
        ("rate_hz = 100.0", "rate_hz = 100.0\ndropouts = { rate_hz = 1e300, mean_s = 0.1 }", "key-value", ""),
        ("height_m = 12.0", "height_m = 12.0\noffset_s = 1e300", "key-value", ""),
        ("mount_deg = 0.2", "mount_deg = 1e300", "key-value", ""),
        ("density_sd = 0.0", "density_sd = 1e9", "key-value", ""),
        ("stop_s = 8.0", "stop_s = " + "9" * 5000, "toml-syntax", ""),
    ],
)
def test_a_value_without_sense_is_refused_with_its_key(simulate, old, new, code, key):
    refused(simulate({old: new}), code, "scenario.toml", key)


@pytest.mark.parametrize("record_s", [0.0033, 3.0])
def test_records_fit_the_step_and_the_flight_or_are_refused_with_file_and_key(simulate, record_s):
    done = simulate({"record_s = 0.01": f"record_s = {record_s}"})
    if done.code != 0:
        refused(done, "keys-conflict", "scenario.toml", "record_s")
    else:
        assert table(done, "truth/truth")["t_s"].iloc[-1] == pytest.approx(8.0, abs=1e-6)


def test_packages_that_the_vehicle_lacks_are_named(simulate):
    refused(simulate(vehicle={"[sensors.suba]": "[sensors.subb]"}, name="a"), "name-unknown", "suba")
    refused(simulate(more=MAGNETOMETER.replace("suba", "subb"), name="b"), "name-unknown", "subb")
    refused(simulate(more=VIDEO, name="c"), "name-unknown", "camera5")


@pytest.mark.parametrize("times", [(100.0, 110.0, 100.0), (5.0, 4.0, 5.0), (4.0, 5.0, 7.0)])
def test_video_that_does_not_fit_the_flight_is_refused(simulate, times):
    video = VIDEO
    for key, time in zip(("start_s = 4.0", "stop_s = 5.0", "benchmark_s = 4.0"), times, strict=True):
        video = video.replace(f"\n{key}", f"\n{key.split(' =')[0]} = {time}")
    refused(simulate({'"vehicle.toml"': '"irve2_reference"'}, more=video), "keys-conflict", "video")


def test_faults_of_scenario_and_vehicle_are_told_at_once(simulate):
    done = simulate({"stop_s": "stpo_s"}, {"torus_count": "torus_cuont"})
    refused(done, "key-unknown key-missing", "time.stpo_s", "torus_cuont")


@pytest.mark.parametrize(
    ("old", "new", "code", "key"),
    [
        ("half_angle_deg = 70.0", "half_angle_deg = 90.0", "key-value", "half_angle_deg"),
        ("nose_radius_m = 0.30", "nose_radius_m = 1.5", "keys-conflict", "nose_radius_m"),
        ("cmq = -0.10", "cmq = -0.10\nmach = [3.0, 1.0]", "keys-conflict", "aerodynamics.sphere_cone.mach"),
        ("[aerodynamics.sphere_cone] ", f"{BOTH}[aerodynamics.sphere_cone] ", "keys-conflict", "aerodynamics"),
        ("mass_kg = 15.0", "mass_kg = 0.0", "key-value", "aeroshell.mass_kg"),
        ("[0.6, 0.0, 0.0]", "[9.6, 0.0, 0.0]", "key-value", "9.6"),
        ("station_m = 0.12", "station_m = 1e300", "key-value", "station_m"),
        ("station_m = 0.12", "station_m = 0.12\nfreeplay_deg = 400.0", "key-value", "freeplay_deg"),
    ],
)
def test_a_wrong_vehicle_is_refused_with_its_key(simulate, old, new, code, key):
    refused(simulate(vehicle={old: new}), code, "vehicle.toml", key)


GRID = ["mach,alpha_deg,ca,cn,cm,cmq"] + [
    f"{mach},{angle},{1.5 * np.cos(np.radians(angle)):.5f},0.0,0.0,-0.1" for mach in (0, 3, 9) for angle in (0, 90, 180)
]
SIDECAR = 'source = "x"\nlicence = "x"\narea_m2 = 3.1416\nlength_m = 2.0\nmoment_reference_station_m = 0.0\n'
OOPS = "file-unreadable"
DAVEML = (Path(__file__).parents[1] / "data" / "blunt_cone.dml").read_text()


@pytest.mark.parametrize(
    ("name", "rows", "sidecar", "codes", "names"),
    [
        ("mine.csv", None, None, "file-missing", ("mine.csv", "mine.toml")),
        ("mine.csv", GRID, SIDECAR.replace("area_m2", "area"), "key-unknown key-missing", ("'area_m2'",)),
        ("mine.csv", [*GRID[:4], *GRID[5:]], SIDECAR, "aero-grid", ("mine.csv", "8 rows", "3 Mach", "3 angles")),
        ("mine.csv", GRID[:4], SIDECAR, "aero-grid", ("mine.csv", "Mach")),
        ("mine.csv", [*GRID[:4], "3,0,abc,0,0,-0.1", *GRID[5:]], SIDECAR, "not-a-number", ("line 5", "'ca'", "abc")),
        ("mine.csv", [re.sub("^0,", "-1,", row) for row in GRID], SIDECAR, "value-range", ("'mach'",)),
        ("mine.dml", ["<html></html>"], SIDECAR, "file-unreadable", ("'html'", "DAVEfunc")),
        ("mine.dml", [DAVEML.replace("1.5, 3.0, 6.0", "1.5, 6.0, 3.0")], SIDECAR, "file-unreadable", ("MACH1",)),
        ("mine.dml", [DAVEML.replace("1.46, 1.20", "1.46, oops")], SIDECAR, OOPS, ("'CA'",)),
    ],
)
def test_a_wrong_table_is_refused(simulate, name, rows, sidecar, codes, names):
    text = (EXAMPLE / "vehicle.toml").read_text()
    cone = text[text.index("[aerodynamics.sphere_cone]") : text.index("[aerodynamics.free_molecular]")]
    files = {name: "\n".join(rows), "mine.toml": sidecar} if rows is not None else {}
    refused(simulate(vehicle={cone: f'[aerodynamics]\ntable = "{name}"\n\n'}, files=files), codes, *names)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("radars.shore]", 'radars."a b"]'),
        ("noise_mps2 = 0.05", "noise_mps2 = 0.0"),
        ("range_sd_m = 5.0", "range_sd_m = 0.0"),
        ("rate_hz = 10.0", "rate_hz = 0.01"),
        (SCENARIO[SCENARIO.index("[radars.shore]") : SCENARIO.index("[attitude_prior]")], "[radars]\n"),
        ("t_s = 2.0\nsd", "t_s = 1000.0\nsd"),
    ],
)
def test_what_simulate_accepts_the_reader_accepts(simulate, old, new):
    done = simulate({old: new})
    if done.code == 0:
        try:
            read_flight(done.folder)
        except GateError as fault:
            pytest.fail(f"a delivered flight is refused: {fault.faults}")
        assert tomllib.loads((done.folder / "flight.toml").read_text())["attitude_prior"]["t_s"] <= 8.0


def test_a_flight_has_the_same_bytes_wherever_its_files_lie(simulate):
    one, other = simulate(name="one"), simulate(name="other")
    for path in sorted(one.folder.rglob("*.*")):
        assert path.read_bytes() == (other.folder / path.relative_to(one.folder)).read_bytes(), path.name


def test_a_radar_sees_nothing_below_its_horizon(simulate):
    done = simulate({"latitude_deg = 37.841\nlongitude_deg = -75.485": "latitude_deg = -37.0\nlongitude_deg = 105.0"})
    if done.code == 0:
        assert not (table(done, "telemetry/radar_shore")["el_deg"] < -1.0).any()


def test_a_key_of_one_instrument_moves_no_other_file(simulate):
    plain = simulate(name="plain")
    wander = "rate_hz = 10.0\nwander_deg = 0.1\nwander_time_constant_s = 2.0"
    for old, new, file in (
        ("noise_mps2 = 0.05", "noise_mps2 = 0.5", "accelerometer"),
        ("bias_degps = 0.0", "bias_degps = 1.0", "rates"),
        ("rate_hz = 10.0", wander, "radar_shore"),
    ):
        done = simulate({old: new}, name=file)
        for path in [*plain.folder.glob("telemetry/*.csv"), plain.folder / "truth/truth.csv"]:
            same = filecmp.cmp(path, done.folder / path.relative_to(plain.folder), shallow=False)
            assert same == (path.stem != file), (new, path.name)


def test_rates_without_errors_are_the_truth_and_their_keys_do_what_they_say(simulate):
    def with_key(name: str, text: str = "bias_degps = 0.0") -> tuple[np.ndarray, SimpleNamespace]:
        done = simulate({"noise_degps = 0.05": "noise_degps = 0.0", "bias_degps = 0.0": text}, name=name)
        return table(done, "telemetry/rates").to_numpy()[:, 1:], done

    rates, clean = with_key("clean")
    truth = table(clean, "truth/truth")[["p_body_degps", "q_body_degps", "r_body_degps"]].to_numpy()  # each 0.02 s
    assert np.abs(rates[::2] - truth).max() < 2e-6
    shift = with_key("bias", "bias_degps = 1.0")[0] - rates
    assert np.ptp(shift, axis=0).max() < 3e-6
    assert 0.1 < np.abs(shift[0]).max() < 4.0
    steps = with_key("grid", "bias_degps = 0.0\nresolution_degps = 0.5")[0] / 0.5
    assert np.abs(steps - np.round(steps)).max() < 1e-5
    assert np.abs(with_key("range", "bias_degps = 0.0\nrange_degps = [5.0, 1.0, 1.0]")[0]).max() <= 5.0
    late = with_key("late", "bias_degps = 0.0\ndelay_s = 0.05")[0]  # five samples of 0.01 s
    assert np.abs(late[5:] - rates[:-5]).max() < 2e-6


def test_free_fall_keeps_energy_and_angular_momentum(simulate):
    high = {"altitude_m = 60000.0": "altitude_m = 300000.0", "flight_path_deg = -76.0": "flight_path_deg = 60.0"}
    done = simulate(high | {"spin_rpm = 20.0": "spin_rpm = 0.0", "stop_s = 8.0": "stop_s = 150.0"})
    truth = table(done, "truth/truth")
    r = truth[["rx_ecef_m", "ry_ecef_m", "rz_ecef_m"]].to_numpy()
    v = truth[["vx_ecef_mps", "vy_ecef_mps", "vz_ecef_mps"]].to_numpy() + np.cross([0.0, 0.0, EARTH_RATE], r)
    distance = np.linalg.norm(r, axis=1)
    legendre = 1.5 * (r[:, 2] / distance) ** 2 - 0.5
    energy = 0.5 * (v**2).sum(axis=1) - GM / distance * (1.0 - J2 * (EARTH_A / distance) ** 2 * legendre)
    momentum = r[:, 0] * v[:, 1] - r[:, 1] * v[:, 0]
    assert np.ptp(energy) < 0.3  # J/kg; 2e-4 m/s at 1400 m/s
    assert np.ptp(momentum) / abs(momentum[0]) < 1e-6
    events = table(done, "truth/events").set_index("event")
    i = int(truth["alt_m"].argmax())
    assert events.loc["apogee", "alt_m"] == pytest.approx(truth["alt_m"][i], abs=1e-2)
    assert events.loc["apogee", "t_s"] == pytest.approx(truth["t_s"][i], abs=0.011)


def test_a_pocket_and_a_shear_are_flown_through(simulate):
    layer = "winds = false\npockets = [{ altitude_m = 5.3e4, depth = 0.3, thickness_m = 2e3 }]"
    wind = "winds = false\nshears = [{ altitude_m = 5.6e4, north_mps = 60.0, east_mps = -80.0, thickness_m = 1e3 }]"

    def flown(name, changes):
        truth = table(simulate(changes, name=name), "truth/truth")
        speed = np.linalg.norm(truth[["vx_ecef_mps", "vy_ecef_mps", "vz_ecef_mps"]], axis=1)
        return truth["alt_m"].to_numpy(), (truth["dynamic_pressure_pa"] / speed**2).to_numpy(), speed

    altitude, half_density, _ = flown("still", {})
    height, pocket, _ = flown("pocket", {"winds = false": layer})
    ratio = pocket / np.exp(np.interp(height, altitude[::-1], np.log(half_density)[::-1]))
    assert ratio.min() == pytest.approx(0.7, abs=0.002)
    assert height[ratio.argmin()] == pytest.approx(5.3e4, abs=30.0)
    assert np.ptp(height[ratio < 0.85]) == pytest.approx(2e3, rel=0.05)
    # above the shear the air goes 60 m/s north and 80 m/s west; the path is 14 deg from the vertical, towards 130 deg
    height, sheared, speed = flown("shear", {"winds = false": wind})
    ratio = sheared / np.exp(np.interp(height, altitude[::-1], np.log(half_density)[::-1]))
    along = np.cos(np.radians(76.0)) * (np.cos(np.radians(130.0)) * 60.0 - np.sin(np.radians(130.0)) * 80.0)
    assert height[0] > 5.65e4
    assert ratio[0] == pytest.approx(1.0 - 2.0 * along / speed[0] + (100.0 / speed[0]) ** 2, abs=0.003)
    assert ratio[-1] == pytest.approx(1.0, abs=0.002)


def test_events_lie_on_the_truth(simulate):
    done = simulate({"stop_s = 8.0": "stop_s = 40.0"})
    truth, events = table(done, "truth/truth"), table(done, "truth/events").set_index("event")
    assert {"peak heating", "peak dynamic pressure", "Mach 3.5", "40 km", "Mach 1"} <= set(events.index)
    for event, row in events[events["t_s"] > 2.1].iterrows():
        for name, scale in (("alt_m", 0.05), ("mach", 1e-4), ("dynamic_pressure_pa", 0.2)):
            assert row[name] == pytest.approx(np.interp(row["t_s"], truth["t_s"], truth[name]), abs=scale), event
    assert events.loc["40 km", "alt_m"] == pytest.approx(40e3, abs=1e-3)
    assert events.loc["Mach 1", "mach"] == pytest.approx(1.0, abs=1e-6)
    low = {"altitude_m = 60000.0": "altitude_m = 250.0", "speed_mps = 1400.0": "speed_mps = 20.0"}
    # the radar is 100 km off: the last of the fall is below its horizon
    low |= {"height_m = 12.0": "height_m = 12.0\nmin_elevation_deg = -2.0"}
    sea = table(simulate(low | {"stop_s = 8.0": "stop_s = 60.0"}, name="sea"), "truth/events").set_index("event")
    assert sea.loc["splashdown", "alt_m"] == pytest.approx(0.0, abs=1e-3)


def test_a_joint_too_soft_ends_the_flight_with_its_time(simulate):
    done = simulate(vehicle={"bending_stiffness_nmprad = 2500.0": "bending_stiffness_nmprad = 200.0"}, name="late")
    assert done.code == 0
    last = table(done, "truth/deflection").iloc[-1]
    assert last["theta_deg"] > 60.0
    at = re.search(r"90 deg at ([0-9.]+) s", done.out)
    assert at is not None
    assert float(at[1]) == pytest.approx(last["t_s"], abs=0.03)
    read_flight(done.folder)
    early = {"telemetry_from_s = 2.0": "telemetry_from_s = 0.1"}
    done = simulate(early, {"bending_stiffness_nmprad = 2500.0": "bending_stiffness_nmprad = 20.0"})
    assert printed_codes(done.err) == ["time-not-covered"]
    assert 0.1 < numbers_in(done.err)[0] < 1.1  # it ends half a second after telemetry begins


def test_a_step_too_large_for_the_joint_is_not_taken_for_a_divergence(simulate):
    stiff = {"bending_stiffness_nmprad = 2500.0": "bending_stiffness_nmprad = 1e7"}
    done = simulate(vehicle=stiff)
    if done.code == 0:  # flown after all: it must be flown well, that is nearly rigid
        assert table(done, "truth/deflection")["theta_deg"].max() < 0.01
    else:
        refused(done, "step-too-long", "step_s")


def test_joint_keys_do_what_they_say(simulate):
    def bent(name, joint, time="start_s = 0.0"):
        vehicle = {"station_m = 0.12": f"station_m = 0.12\n{joint}"}
        return table(simulate({"start_s = 0.0": time}, vehicle, name=name), "truth/deflection").set_index("t_s")

    plain = bent("plain", "")["theta_deg"]
    loose = bent("loose", "freeplay_deg = 1.0")["theta_deg"]
    hard = bent("hard", "freeplay_deg = 1.0\nhardening_nmprad3 = 1e8")["theta_deg"]
    assert 0.5 < loose.max() - plain.max() < 2.5
    assert hard.max() < loose.max()
    locked = bent("locked", "", "start_s = 0.0\ninflated_s = 5.0")["theta_deg"]
    assert locked.loc[:4.99].max() < 1e-9
    assert locked.loc[5.5:].max() > 0.01

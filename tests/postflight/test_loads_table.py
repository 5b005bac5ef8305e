"""Estimators on a table of another trajectory program: columns as they are written, and the answers of the run."""

import re
import shutil
import tomllib

import numpy as np
import pandas as pd
import pytest

import postflight as pf
from flightmodel import earth
from flightmodel.airdata import pressure_pulse
from flightmodel.vehicle import read_vehicle
from postflight import commands
from postflight.loads_table import read_loads
from tests.postflight.short_flights import write_pulse
from tests.refusing import refuses

FOOT, PSF, G, KNOT = 0.3048, 47.88026, 9.80665, 1852.0 / 3600.0
METHODS = ("misalignment", "trim")
ANOTHER_TEAMS = {
    "MET (ms)": lambda bet: 1e3 * bet.t_s,
    "GEODETIC ALT (ft)": lambda bet: bet.alt_m / FOOT,
    "MACH NO": lambda bet: bet.mach,
    "QBAR (psf)": lambda bet: bet.dynamic_pressure_pa / PSF,
    "TAS (kt)": lambda bet: bet.airspeed_mps / KNOT,
    "AOA (deg)": lambda bet: bet.alpha_deg,
    "SIDESLIP (deg)": lambda bet: bet.beta_deg,
    **{f"{a} ACCEL (ft/s^2)": lambda bet, a=a: bet[f"a{a.lower()}_cg_mps2"] / FOOT for a in "XYZ"},
    "ROLL RATE (rad/s)": lambda bet: np.deg2rad(bet.p_body_degps),
    "PITCH RATE (rad/s)": lambda bet: np.deg2rad(bet.q_body_degps),
    "YAW RATE (rad/s)": lambda bet: np.deg2rad(bet.r_body_degps),
    "HEAT RATE": lambda bet: 0.0 * bet.t_s,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run folder of a synthetic pulse without film."""
    folder = tmp_path_factory.mktemp("loads")
    path = write_pulse(folder / "pulse.toml")
    path.write_text(re.sub(r"(?ms)^\[video\].*?(?=^\[)", "", path.read_text()))
    commands.simulate(str(path), folder / "flight", 5, force=False)
    _, _, written = commands.run_flight(folder / "flight", (*METHODS, "fused"), commands.Asked())
    return written


@pytest.fixture(scope="module")
def bet(run):
    return pd.read_csv(run / "bet.csv")


@pytest.fixture
def alien(bet):
    """The trajectory as another team's program would write it."""
    return pd.DataFrame(
        {
            "TIME (s)": bet.t_s,
            **{f"A{a.upper()} (g)": bet[f"a{a}_cg_mps2"] / G for a in "xyz"},
            **{f"{a.upper()} (deg/s)": bet[f"{a}_body_degps"] for a in "pqr"},
            "MACH": bet.mach,
            "QBAR (psf)": bet.dynamic_pressure_pa / PSF,
            "ALPHA (deg)": bet.alpha_deg,
            "BETA (deg)": bet.beta_deg,
            "ALT (kft)": bet.alt_m / (1000.0 * FOOT),
            "VTAS (ft/s)": bet.airspeed_mps / FOOT,
        }
    )


@pytest.mark.parametrize("method", METHODS)
def test_the_runs_own_table_gives_its_answers(method, run):
    """Means over the pulse: the table's accelerations are means over 0.1 s, those of the run's loads over 0.04 s."""
    loads = read_loads(run / "bet.csv", "irve2_reference")
    history = getattr(pf, f"estimate_{method}")(loads)
    own = pd.read_csv(run / f"deflection_{method}.csv")
    at = loads.time_s[pressure_pulse(loads.dynamic_pressure_pa)]
    theta, sd = np.rad2deg(np.array([history.angle_at(t) for t in at]).T)
    expected, stated = (np.interp(at, own.t_s, own[c]) for c in ("theta_deg", "theta_sd_deg"))
    assert abs((theta - expected).mean()) < 0.1 * stated.mean()
    assert np.abs(theta - expected).max() < 0.5 * stated.min()
    assert 0.7 < sd.mean() / stated.mean() < 1.5


def test_headers_of_another_program_are_recognised_with_their_units(alien, run):
    own, other = read_loads(run / "bet.csv", "irve2_reference"), read_loads(alien, "irve2_reference")
    for name in ("specific_force_body_mps2", "rate_body_radps", "flow_yz_rad", "mach", "dynamic_pressure_pa"):
        np.testing.assert_allclose(getattr(other, name), getattr(own, name), rtol=1e-6, atol=1e-9)


def test_angles_by_total_and_clock_are_those_by_alpha_and_beta(alien, bet, run):
    other = alien.drop(columns=["ALPHA (deg)", "BETA (deg)"])
    other["TOTAL ALPHA (deg)"], other["CLOCK (deg)"] = bet.alpha_total_wind_deg, bet.clock_lv_deg
    flow = read_loads(other, "irve2_reference").flow_yz_rad
    np.testing.assert_allclose(flow, read_loads(alien, "irve2_reference").flow_yz_rad, atol=1e-7)


def test_flow_by_velocity_wind_and_attitude_is_that_by_alpha_and_beta(alien, bet, run):
    other = alien.drop(columns=["ALPHA (deg)", "BETA (deg)", "VTAS (ft/s)"])
    to_ned = earth.dcm_ned_ecef(np.deg2rad(bet.lat_deg.to_numpy()), np.deg2rad(bet.lon_deg.to_numpy()))
    velocity = np.einsum("nij,nj->ni", to_ned, bet[["vx_ecef_mps", "vy_ecef_mps", "vz_ecef_mps"]])
    other[["V_NORTH (m/s)", "V_EAST (m/s)", "V_DOWN (m/s)"]] = velocity
    other[["YAW (deg)", "PITCH (deg)", "ROLL (deg)"]] = bet[["yaw_ned_deg", "pitch_ned_deg", "roll_ned_deg"]]
    with refuses("column-missing", names=["wind_north, wind_east"]):
        read_loads(other, "irve2_reference")
    other["WIND NORTH (kt)"], other["WIND EAST (kt)"] = bet.wind_n_mps / KNOT, bet.wind_e_mps / KNOT
    loads, by_angles = (read_loads(each, "irve2_reference") for each in (other, alien))
    # the velocity is the datum's, about which the c.g. swings; 1e-6 is of what is written
    swing = np.linalg.norm(np.cross(loads.rate_body_radps, loads.vehicle.cg_m), axis=1) / loads.airspeed_mps
    away = np.linalg.norm(loads.flow_yz_rad - by_angles.flow_yz_rad, axis=1)
    assert (away < 1.001 * swing + 1e-5).all()
    assert (np.abs(loads.airspeed_mps / by_angles.airspeed_mps - 1.0) < swing + 1e-5).all()


def test_units_that_the_header_leaves_open_are_asked_all_at_once_and_can_be_stated(alien):
    bare = alien.rename(columns=lambda name: name.split(" (")[0])
    with refuses("unit-unknown", names=["AX", "QBAR", "ALT", "VTAS"]):
        read_loads(bare, "irve2_reference")
    stated = {
        "t": "TIME:s", "ax": "AX:g", "ay": "AY:g", "az": "AZ:g", "p": "P:degps", "q": "Q:degps", "r": "R:degps",
        "dynamic_pressure": "QBAR:psf", "altitude": "ALT:kft", "airspeed": "VTAS:ftps", "alpha": "ALPHA:deg",
        "beta": "BETA:deg",
    }  # fmt: skip
    loads = read_loads(bare, "irve2_reference", columns=stated)
    np.testing.assert_allclose(loads.flow_yz_rad, read_loads(alien, "irve2_reference").flow_yz_rad)


@pytest.mark.parametrize(
    ("column", "factor", "codes"),
    [
        ("VTAS (ft/s)", 1.0 / FOOT, {"units-and-signs"}),
        ("QBAR (psf)", PSF, {"units-and-signs"}),
        ("AX (g)", -1.0, {"deceleration-too-small"}),
        ("MACH", 0.01, {"units-and-signs"}),
    ],
)
def test_a_wrong_unit_or_sign_is_refused(column, factor, codes, alien):
    alien[column] *= factor
    with pytest.raises(pf.GateError) as caught:
        read_loads(alien, "irve2_reference")
    assert set(caught.value.codes) <= codes


def test_what_is_missing_is_said(alien):
    with refuses("column-missing", names=["beta"]):
        read_loads(alien.drop(columns=["BETA (deg)"]), "irve2_reference")
    with refuses("column-missing", names=["mach, dynamic_pressure and airspeed"]):
        read_loads(alien.drop(columns=["QBAR (psf)", "MACH"]), "irve2_reference")


def test_an_accelerometer_elsewhere_is_moved_to_the_cg(alien):
    vehicle = read_vehicle("irve2_reference")
    at_cg = read_loads(alien, vehicle)
    away = read_loads(alien, vehicle, acceleration_at=tuple(vehicle.cg_m + np.array([0.5, 0.0, 0.0])))
    moved = away.specific_force_body_mps2 - at_cg.specific_force_body_mps2
    w = at_cg.rate_body_radps
    # from the c.g. back over -0.5 m: w x (w x r) along x is 0.5 (q^2 + r^2)
    np.testing.assert_allclose(moved[:, 0], 0.5 * (w[:, 1] ** 2 + w[:, 2] ** 2), atol=1e-9)


def test_defaults_widen_the_answer_and_keys_replace_them(alien):
    narrow = read_loads(alien, "irve2_reference", flow_angle_sd_deg=0.05, wind_sd_mps=0.5)
    wide = read_loads(alien, "irve2_reference", flow_angle_sd_deg=1.0)
    at = narrow.time_s[np.argmax(narrow.dynamic_pressure_pa)]
    sds = [pf.estimate_misalignment(loads).angle_at(at)[1] for loads in (narrow, wide)]
    assert sds[1] > 1.3 * sds[0]  # of a degree of the flow the force's tilt takes 0.12 deg, beside 0.13 deg of the rest
    with refuses("key-unknown"):
        read_loads(alien, "irve2_reference", flow_angle_deg=1.0)


def test_half_of_the_flow_angles_variance_turns_with_the_body(alien):
    loads = read_loads(alien, "irve2_reference", flow_angle_sd_deg=0.4)
    turning = np.einsum("nik,njk->nij", loads.flow_root_rad, loads.flow_root_rad)
    np.testing.assert_allclose(turning, np.tile(0.5 * np.deg2rad(0.4) ** 2 * np.eye(2), (len(turning), 1, 1)))
    total = np.deg2rad(0.4) ** 2 + loads.wind_flow_sd_rad**2
    np.testing.assert_allclose(loads.flow_cov, total[:, None, None] * np.eye(2), rtol=1e-9, atol=1e-15)


def test_fusion_takes_loads(alien, run):
    loads = read_loads(alien, "irve2_reference")
    answer = pf.fuse(loads)
    frame = answer.to_frame().set_index("method")
    assert {"misalignment", "trim", "fused"} <= set(frame.index)
    own = pd.read_csv(run / "deflection_fused.csv")
    at = frame.t_s["fused"]
    expected, stated = (np.interp(at, own.t_s, own[c]) for c in ("theta_deg", "theta_sd_deg"))
    assert abs(frame.theta_deg["fused"] - expected) < stated


# a flight folder with [loads]


@pytest.fixture
def folder(tmp_path, bet, command):
    """A flight folder into which a table of another team was imported."""
    pd.DataFrame({name: column(bet) for name, column in ANOTHER_TEAMS.items()}).to_csv(
        tmp_path / "post bet.txt", sep="\t", index=False
    )
    place = tmp_path / "flight"
    assert command("init", place, "--vehicle", "irve2_reference").returncode == 0
    done = command("import", tmp_path / "post bet.txt", "--into", place)
    assert done.returncode == 0, done.stderr
    assert "not used: HEAT RATE" in done.stdout
    text = (place / "flight.toml").read_text()
    assert "[barometers" not in text.replace("# [", "")
    for key, value in (("name", "x"), ("t0_utc", "2009-08-17T12:52:00Z")):
        text = text.replace(f'\n{key} = "FILL IN"', f'\n{key} = "{value}"')
    (place / "flight.toml").write_text(text)
    return place


def test_another_teams_table_is_imported_checked_and_estimated_from(folder, alien, command):
    stated = tomllib.loads((folder / "flight.toml").read_text())["loads"]
    assert (stated["columns"]["altitude"]["unit"], stated["time"]["unit"]) == ("ft", "ms")
    check = command("check", folder)
    assert check.returncode == 0
    assert check.stdout.startswith("can run: misalignment and trim from loads")
    assert command("deflection", folder).returncode == 0
    (written,) = (folder / "runs").iterdir()
    answers = pd.read_csv(written / "answers.csv").set_index("method")
    direct = pf.fuse(read_loads(alien, "irve2_reference")).to_frame().set_index("method")
    for method in (*METHODS, "fused"):
        assert abs(answers.theta_deg[method] - direct.theta_deg[method]) < 0.1 * direct.theta_sd_deg[method]
        assert abs(answers.theta_sd_deg[method] / direct.theta_sd_deg[method] - 1.0) < 0.05
    page = (written / "report.html").read_text()
    assert 'http-equiv="Content-Security-Policy"' in page
    assert f"{answers.theta_deg['fused']:.2f}" in page
    assert "flow_angle_sd_deg = 0.3" in page
    assert "HEAT RATE" in page


def test_a_flight_with_loads_is_estimated_from_and_not_reconstructed(folder):
    flight = pf.read_flight(folder)
    fused = pf.fuse(flight)
    assert set(fused) == {*METHODS, "fused"}
    wide = pf.estimate_misalignment(flight.with_(flow_angle_sd_deg=1.5))
    assert wide.angle_at(fused.reference_s)[1] > 1.1 * fused["misalignment"].angle_at(fused.reference_s)[1]
    stiffer = pf.estimate_trim(flight.with_(c_m=1.2))
    assert abs(stiffer.at(fused.reference_s).theta_deg - fused["trim"].at(fused.reference_s).theta_deg) > 0.1
    with refuses("tracker-missing"):
        pf.reconstruct(flight)
    with refuses("name-unknown"):
        flight.with_(wind=None)


def test_run_of_a_flight_with_loads_is_its_deflection(folder, command):
    assert command("run", folder, "--set", "c_n=1.05", "--name", "stiff").returncode == 0
    (written,) = (folder / "runs").iterdir()
    assert written.name.endswith("-stiff")
    assert "c_n = 1.05" in (written / "report.html").read_text()
    assert command("reconstruct", folder).returncode == 3
    for reader in ("report", "export"):
        done = command(reader, folder, *(["--to", "csv"] if reader == "export" else []))
        assert done.returncode == 3
        assert f"{written} holds a deflection" in done.stdout + done.stderr


def test_what_a_flights_table_lacks_is_refused_by_the_reader_and_the_check(folder):
    table = folder / tomllib.loads((folder / "flight.toml").read_text())["loads"]["file"]
    table.write_text(table.read_text().replace("SIDESLIP", "SIDE FORCE"))
    with refuses("column-missing"):
        pf.read_flight(folder)
    report = pf.check_flight(folder)
    assert (report.exit_code, {fault.code for fault in report.refused}) == (3, {"column-missing"})
    table.unlink()
    with refuses("file-missing"):
        pf.read_flight(folder)


def test_loads_beside_trackers_are_refused_and_proposed_as_a_comment(folder, run, tmp_path, command):
    text = (folder / "flight.toml").read_text()
    other = run.parents[1]
    for name in ("telemetry", "truth"):
        shutil.copytree(other / name, tmp_path / "both" / name)
    with_radars = (other / "flight.toml").read_text()
    (tmp_path / "both" / "flight.toml").write_text(with_radars)
    assert command("import", tmp_path / "post bet.txt", "--into", tmp_path / "both").returncode == 3
    assert tomllib.loads((tmp_path / "both" / "flight.toml").read_text()) == tomllib.loads(with_radars)
    (tmp_path / "both" / "flight.toml").write_text(with_radars + text[text.index("\n[loads]") :])
    with refuses("keys-conflict"):
        pf.read_flight(tmp_path / "both")


def test_columns_of_no_known_quantity_are_refused(alien):
    with refuses("key-unknown", names=["altitude"]):
        read_loads(alien, "irve2_reference", columns={"altitud": "ALT (kft)"})


def test_clock_times_count_from_the_flights_time_zero(folder):
    path = folder / "flight.toml"
    table = folder / tomllib.loads(path.read_text())["loads"]["file"]
    flown = pd.read_csv(table)
    direct = pf.read_flight(folder).loads
    clock = pd.Timestamp("2009-08-17T12:52:00") + pd.to_timedelta(flown.pop("MET (ms)"), unit="ms")
    flown.insert(0, "GMT", clock.dt.strftime("%j:%H:%M:%S.%f"))
    flown.to_csv(table, index=False)
    time = 'time = { column = "GMT", format = "irig_doy", offset_s = 2.0 }'
    path.write_text(re.sub(r"(?m)^time = \{.*$", time, path.read_text()))
    loads = pf.read_flight(folder).loads
    assert abs(loads.time_s[0] - 2.0 - direct.time_s[0]) < 0.051  # on a grid of 20 Hz
    assert loads.dynamic_pressure_pa.max() == pytest.approx(direct.dynamic_pressure_pa.max(), rel=1e-4)
    table.write_text(table.read_text().replace(":12:59:", ":12.59.", 1))
    with refuses("time-format"):
        pf.read_flight(folder)


def test_errors_that_the_table_states_are_not_assumed(folder, run, bet):
    own = folder / "telemetry" / "own.csv"
    shutil.copy(run / "bet.csv", own)
    text = (folder / "flight.toml").read_text()
    stated = '[loads]\nfile = "telemetry/own.csv"\nuse_s = [[420.0, 450.0]]\nrate_scale_sd = 0.001\n'
    (folder / "flight.toml").write_text(text[: text.index("\n[loads]")] + f"\n{stated}")
    flight = pf.read_flight(folder)
    assert not {"flow_angle_sd_deg", "dynamic_pressure_sd_percent", "rate_scale_sd"} & set(flight.assumed["loads"])
    assert "time_bias_sd_s" in flight.assumed["loads"]
    assert flight.loads.time_s[0] >= 420.0
    assert flight.loads.time_s[-1] <= 450.0
    assert pf.check_flight(folder).assumed["loads"] == flight.assumed["loads"]


def test_the_report_of_a_table_that_ends_before_the_peak_says_so(alien, bet, tmp_path, command):
    alien[(bet.dynamic_pressure_pa < 900.0) & (bet.t_s < bet.t_s[bet.dynamic_pressure_pa.idxmax()])].to_csv(
        tmp_path / "rise.csv", index=False
    )
    assert command("deflection", "--loads", tmp_path / "rise.csv", "--vehicle", "irve2_reference").returncode == 0
    page = (tmp_path / "rise-deflection" / "report.html").read_text()
    assert "the largest q in the data" in page

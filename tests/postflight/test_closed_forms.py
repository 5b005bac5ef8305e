"""Small parts of the pipeline against closed forms, drawn statistics and sums written out."""

from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from flightmodel import earth, rotations, statistics
from flightmodel.airdata import Inputs, _path_angles, derived, lateral_angles
from flightmodel.atmosphere import standard_atmosphere, standard_sounding
from flightmodel.earth import undulation_m
from flightmodel.instruments import TriadSpec
from flightmodel.linear import linear_matrix, modes, slopes_at
from flightmodel.trajectory import Trajectory
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight import reconstruction
from postflight.checks import inertial
from postflight.checks.pressure_and_field import field_rotation
from postflight.checks.track_force import _compare, track_force
from postflight.checks.units_and_axes import slope_through_mean, unit_that_explains
from postflight.exports import _OEM_STATE, Source, _aem, _kml, _msopck, _oem
from postflight.montecarlo.bands import Chunk, _bands, coverage, is_narrow, percentile_interval, write_chunk
from postflight.reconciliation.modes import FACTORS, _peak, _track_power
from postflight.reconstruction import _coefficients
from postflight.report.panels import _FLOWN
from postflight.runs import STATE_COLUMNS
from postflight.scoring import _bet_errors, _method_row
from postflight.studies import preflight
from recon import atmosphere

G0 = 9.80665


# ------------------------------------------------------------------------------------------------- corrected sensors


def test_window_means_are_integrals_of_the_lines_between_samples():
    t = np.array([0.0, 0.1, 0.35, 0.4, 0.9])
    values = np.column_stack([np.array([0.0, 1.0, -1.0, 2.0, 0.5]), 3.0 * t])
    start, end = np.array([0.05, 0.02]), np.array([0.37, 0.88])
    fine = np.linspace(0.0, 1.0, 200001)
    for k, (a, b) in enumerate(zip(start, end, strict=True)):
        x = a + (b - a) * fine
        want = [np.trapezoid(np.interp(x, t, c), x) / (b - a) for c in values.T]
        np.testing.assert_allclose(atmosphere._window_means(t, values, start, end)[k], want, rtol=1e-8)


def rotating(noise=0.0, seed=0):
    """Sensors of a body that speeds up evenly about z: rate a t, felt by an accelerometer at rest about it."""
    t = np.arange(0.0, 4.0, 0.01)
    rng = np.random.default_rng(seed)
    rate = np.column_stack([0.0 * t, 0.0 * t, 0.8 * t]) + noise * rng.standard_normal((len(t), 3))
    return SimpleNamespace(imu_time_s=t, specific_force_body_mps2=np.zeros((len(t), 3)), rate_body_radps=rate)


def test_angular_acceleration_is_the_slope_and_carries_the_force_to_the_cg():
    at, arm = np.array([1.0, 2.5]), np.array([0.5, 0.2, 0.0])
    seen = atmosphere.cg_accelerations(rotating(), at, arm)
    np.testing.assert_allclose(seen.angular_acceleration_radps2, np.tile([0.0, 0.0, 0.8], (2, 1)), atol=1e-9)
    w = np.column_stack([0.0 * at, 0.0 * at, 0.8 * at])
    want = np.cross([0.0, 0.0, 0.8], arm) + np.cross(w, np.cross(w, arm))
    np.testing.assert_allclose(seen.specific_force_cg_mps2, want, rtol=1e-9)


def test_angular_acceleration_s_noise_is_that_of_two_means():
    # the difference of two means of 2 h of white samples over 2 h, drawn: 600 know an sd to 3 %
    noise, h = 0.01, atmosphere.HALF_WINDOW_S
    drawn = [
        atmosphere.cg_accelerations(rotating(noise, seed), np.array([2.0]), np.zeros(3)).angular_acceleration_radps2[0]
        for seed in range(200)
    ]
    samples = 2.0 * h / 0.01
    assert np.std(drawn, axis=0).mean() == pytest.approx(np.sqrt(2.0 / samples) * noise / (2.0 * h), rel=0.12)


def test_windows_of_the_air_carry_the_force_by_both_terms_of_the_lever():
    # evenly faster turning about z: w' x arm and the mean of w x (w x arm) over a window, whose square grows
    at, arm = np.array([1.5, 2.2]), np.array([0.5, 0.2, 0.3])
    half = 0.5 * atmosphere._WINDOW_S
    mean_square = 0.8**2 * ((at + half) ** 3 - (at - half) ** 3) / (6.0 * half)
    want = np.cross([0.0, 0.0, 0.8], arm) - mean_square[:, None] * (arm * [1.0, 1.0, 0.0])
    np.testing.assert_allclose(atmosphere._force_means(rotating(), arm, at), want, atol=1e-4)


def test_drag_is_known_as_well_as_coefficient_and_mass(monkeypatch):
    vehicle, seen = vehicle_from_toml(vehicle_path("irve2_reference")), []
    monkeypatch.setattr(atmosphere, "_air_samples", lambda *_: None)
    monkeypatch.setattr(atmosphere, "reconstruct_air", lambda _samples, _profile, drag, _confidence: seen.append(drag))
    atmosphere.as_flown_atmosphere(SimpleNamespace(required_vehicle=lambda: vehicle), None, None, 0.99)
    # acceleration is C q S / m: relative errors of C and of m add as independent ones
    rng, known = np.random.default_rng(1), vehicle.uncertainty
    for sd, own in ((seen[0].ca_sd, known.ca), (seen[0].cn_sd, known.cn)):
        drawn = (1.0 + own * rng.standard_normal(200000)) / (1.0 + known.mass * rng.standard_normal(200000))
        assert sd == pytest.approx(np.std(drawn), rel=0.01)
    assert seen[0].area_per_mass_m2pkg == pytest.approx(vehicle.reference.area_m2 / vehicle.mass_kg)
    # half of the coefficient's variance, and nothing of the mass's, changes with Mach number
    assert seen[0].ca_shape_sd == pytest.approx(known.ca * np.sqrt(0.5))
    assert np.hypot(seen[0].ca_constant_sd, seen[0].ca_shape_sd) == pytest.approx(seen[0].ca_sd)


def test_force_errors_are_those_of_the_accelerometer_and_of_the_c_g():
    vehicle, bet, at = vehicle_from_toml(vehicle_path("irve2_reference")), rotating(), np.array([1.5, 2.2])
    rng, grid = np.random.default_rng(2), np.arange(0.5, 3.5, 0.1)
    root = rng.standard_normal((6, 9))
    bet.smoothed, bet.accelerometer_root = SimpleNamespace(time_s=grid), np.tile(root, (len(grid), 1, 1))
    got = atmosphere._force_roots(vehicle, bet, at)
    np.testing.assert_allclose(got[:, :, :9], np.tile(root[3:], (2, 1, 1)))
    known, masses = vehicle.uncertainty, [vehicle.aeroshell.mass_kg, vehicle.centerbody.mass_kg]
    # both bodies' own places, drawn, and the force at the vehicle's c.g. against that at the stated one
    sd = np.array([known.cg_station_m, known.cg_lateral_m, known.cg_lateral_m])
    moved = np.einsum("b,nbi->ni", masses, rng.standard_normal((40000, 2, 3)) * sd) / sum(masses)
    for k in range(2):
        forces = moved @ (atmosphere._lever_means(bet, at)[k].T)
        np.testing.assert_allclose(got[k, :, 9:] @ got[k, :, 9:].T, np.cov(forces.T), rtol=0.03, atol=1e-9)
    still = atmosphere._force_means(bet, np.zeros(3), at)
    carried = atmosphere._force_means(bet, np.array([0.0, 0.3, 0.0]), at) - still
    np.testing.assert_allclose(carried, 0.3 * atmosphere._lever_means(bet, at)[:, :, 1], atol=1e-12)


def made_pulse(seed=0, noise=0.004):
    """Pulse data of a body that flies straight and turns evenly, with noise of the gyros alone."""
    bet, rng = rotating(noise, seed), np.random.default_rng(5)
    grid = np.arange(0.5, 3.5, 0.1)
    n = len(grid)
    bet.smoothed, bet.output_rate_hz = SimpleNamespace(time_s=grid), 10.0
    bet.triad_root = 1e-3 * rng.normal(size=(n, 9, 18))
    vehicle = vehicle_from_toml(vehicle_path("irve2_reference"))
    force = TriadSpec("accelerometer", vehicle.cg_m, np.eye(3), 0.01, 0.0, 0.0, 0.0)
    rates = TriadSpec("rates", np.zeros(3), np.eye(3), noise, 0.0, 0.0, 0.0)
    triads = tuple(SimpleNamespace(spec=s) for s in (force, rates))
    telemetry = SimpleNamespace(required_vehicle=lambda: vehicle, required_triads=lambda: triads)
    velocity = np.tile([800.0, 30.0, -20.0], (n, 1))
    one = np.ones(n)
    air = SimpleNamespace(
        velocity_air_body_mps=velocity, lateral_flow_cov=np.zeros((n, 2, 2)), altitude_m=one, mach=one,
        air=SimpleNamespace(wind_sd_mps=4.0 * one), dynamic_pressure_pa=one, dynamic_pressure_sd_pa=one,
        airspeed_mps=800.0 * one,
    )  # fmt: skip
    return reconstruction.loads_from_solution(telemetry, bet, air), bet.triad_root, velocity


def test_pulse_data_state_their_noise_and_the_flow_s_errors():
    pulse, root, velocity = made_pulse()
    drawn = np.concatenate([made_pulse(seed)[0].angular_acceleration_body_radps2[::5, :2] for seed in range(25)])
    # before and after share the sample between them, whose halves cancel, and count their ends by halves: of five
    # samples each 0.34 of a sample's variance is left where 2/5 is stated. Some 300 draws know an sd to 4 %
    assert np.std(drawn) / pulse.angular_acceleration_sd_radps2 == pytest.approx(np.sqrt(0.34 / 0.40), rel=0.13)
    # a wind across moves the flow by itself over the speed along the axis
    np.testing.assert_allclose(pulse.wind_flow_sd_rad, 4.0 / 800.0)
    # an attitude error e of the body shows the same flow in axes turned by e
    for k in range(18):
        turned = rotations.rotate(rotations.conjugate(rotations.exp(root[:, :3, k])), velocity)
        change = lateral_angles(turned) - lateral_angles(velocity)
        np.testing.assert_allclose(pulse.flow_root_rad[:, :, k], change, atol=0.02 * np.abs(change).max())


# ------------------------------------------------------------------------------------------------------------ product


def test_speed_path_and_heading_of_known_velocities():
    speed, path, heading = _path_angles(np.array([[0.0, 3.0, -4.0], [-2.0, 0.0, 0.0], [1.0, 0.0, 1.0]]))
    np.testing.assert_allclose(speed, [5.0, 2.0, np.sqrt(2.0)])
    np.testing.assert_allclose(np.rad2deg(path), [np.rad2deg(np.arctan2(4.0, 3.0)), 0.0, -45.0], atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(heading), [90.0, 180.0, 0.0])


def test_what_drifts_with_the_wind_has_no_airspeed():
    # carried north by 12 and east by 23 m/s in such a wind; against the Earth it moves, against inertial space faster
    calm = standard_atmosphere()
    wind = np.tile([12.0, -23.0, 0.0], (len(calm.altitude_m), 1))
    r = earth.ecef_from_geodetic(0.6, -1.2, 3e4)[None]
    v = earth.ecef_from_ned(np.array([12.0, -23.0, 0.001]), r[0])[None]  # at rest there are no angles
    path = Trajectory("2009-08-17T12:50:00Z", np.zeros(1), "datum", r, v, np.array([[1.0, 0.0, 0.0, 0.0]]), 0.0 * r)
    nothing = Inputs(path, np.zeros((1, 2)), np.zeros(1), np.zeros(1))
    made = derived(nothing, replace(calm, wind_ned_mps=wind), np.zeros(3))
    assert made["speed_wind"][0] == pytest.approx(0.001, rel=1e-6)
    assert made["speed_ground"][0] == pytest.approx(np.hypot(12.0, 23.0))
    inertial = v[0] + np.cross(earth.OMEGA_ECEF_RADPS, r[0])
    assert made["speed_inertial"][0] == pytest.approx(np.linalg.norm(inertial))
    blown = replace(nothing, wind_mps=np.array([[4.0, 3.0]]))
    made = derived(blown, replace(calm, wind_ned_mps=wind), np.zeros(3))
    assert made["speed_wind"][0] == pytest.approx(5.0, rel=1e-6)
    assert made["dynamic_pressure"][0] == pytest.approx(0.5 * made["density"][0] * 25.0, rel=1e-6)


def test_inertial_velocity_errs_with_the_place_by_the_earth_s_turning():
    # a place that is known to 1 km and a velocity known well: v + W x r errs by W times the place, 0.07 m/s
    r = earth.ecef_from_geodetic(0.0, 0.4, 5e4)[None]
    covariance = np.diag([1e6] * 3 + [1e-8] * 3 + [1e-6] * 3)[None]
    path = Trajectory(
        "2009-08-17T12:50:00Z", np.zeros(1), "datum", r, 0.0 * r, np.array([[1.0, 0.0, 0.0, 0.0]]), 0.0 * r, covariance
    )  # fmt: skip
    rates = SimpleNamespace(spec=SimpleNamespace(noise_sd=0.03, name="rates"))
    bet = SimpleNamespace(smoothed=path, rate_cov=np.tile(0.04**2 * np.eye(3), (1, 1, 1)), findings=())
    made = reconstruction._inertial(SimpleNamespace(solution=bet))
    assert made["vx_eci_sd_mps"][0] == pytest.approx(1000.0 * earth.OMEGA_RADPS, rel=1e-4)
    assert made["vz_eci_sd_mps"][0] == pytest.approx(1e-4, rel=1e-4)
    # rates: what was estimated of the errors, and a sample's own noise
    flight = SimpleNamespace(solution=bet, telemetry=SimpleNamespace(rates=rates))
    np.testing.assert_allclose(reconstruction._rate_sd(flight), 0.05)


def test_force_coefficients_scatter_as_they_say():
    # forces and pressures drawn about one sample: 4000 know an sd to 1.1 %
    rng, n = np.random.default_rng(1), 4000
    force, root = np.array([-60.0, 2.0, -3.0]), np.diag([0.6, 0.05, 0.08])
    push, push_sd = 45.0, 0.03
    one = _coefficients(force[None], (root @ root.T)[None], np.array([push]), np.array([push_sd]))
    drawn = _coefficients(
        force + rng.standard_normal((n, 3)) @ root, np.tile(root @ root.T, (n, 1, 1)),
        push * np.exp(push_sd * rng.standard_normal(n)), np.full(n, push_sd),
    )  # fmt: skip
    assert one["c_a"][0] == pytest.approx(60.0 / 45.0)
    assert one["cn_over_ca"][0] == pytest.approx(np.hypot(2.0, 3.0) / 60.0)
    for name in ("c_a", "c_n", "cn_over_ca"):
        assert np.std(drawn[name]) == pytest.approx(one[f"{name}_sd"][0], rel=0.05), name


# -------------------------------------------------------------------------------------------------------- Monte Carlo


@pytest.mark.parametrize(("percentile", "n"), [(50.0, 41), (90.0, 80)])
def test_percentile_intervals_hold_the_truth_as_often_as_they_say(percentile, n):
    rng, confidence = np.random.default_rng(3), 0.80
    truth = np.quantile(rng.standard_normal(400001), percentile / 100.0)
    held = []
    for _ in range(600):
        low, high = percentile_interval(rng.standard_normal(n), percentile, confidence)
        held.append(low <= truth <= high)
    # at least as often, by no more than one order statistic of a binomial of this size; 600 know a share to 1.6 %
    assert confidence - 0.05 < np.mean(held) < confidence + 0.12


def test_an_interval_is_narrow_when_it_is_no_wider_than_asked():
    values = np.random.default_rng(1).standard_normal(200)
    low, high = percentile_interval(values, 50.0, 0.95)
    assert is_narrow(values, 50.0, 0.95, 1.001 * (high - low))
    assert not is_narrow(values, 50.0, 0.95, 0.999 * (high - low))
    assert not is_narrow(values[:3], 97.7, 0.95, 1e9)


def test_coverage_counts_one_and_two_standard_deviations():
    error = np.array([0.5, -0.9, 1.5, -1.9, 2.5, 0.1])
    table = pd.DataFrame({"trim_error_deg": 0.2 * error, "trim_sd_deg": np.full(6, 0.2)})
    found = coverage(table)["trim"]
    assert found["inside_1_sd"] == pytest.approx(3.0 / 6.0)
    assert found["inside_2_sd"] == pytest.approx(5.0 / 6.0)
    assert found["rms_over_sd"] == pytest.approx(np.sqrt(np.mean(error**2)))


# ---------------------------------------------------------------------------------------------------- scores and bands


def test_inside_a_band_is_between_its_limits():
    t = np.array([0.0, 1.0])
    got = statistics.inside(
        np.array([0.5] * 3), np.array([0.4, 1.0, 2.6]), t, np.array([0.0, 1.0]), np.array([2.0, 3.0])
    )
    assert got.tolist() == [False, True, False]


def test_dispersed_air_scatters_as_the_sounding_says():
    profile, draws = standard_atmosphere(), []
    for seed in range(200):
        made = preflight._dispersed_atmosphere(profile, np.random.default_rng(seed))
        draws.append(np.column_stack([made.wind_ned_mps[:, :2], made.log_density_ratio]))
    # 200 draws of some ten independent heights: an sd to 2 %
    spread = np.sqrt(np.mean(np.square(draws), axis=(0)))
    for column, sd in ((0, profile.wind_sd_mps), (1, profile.wind_sd_mps), (2, profile.density_sd)):
        assert np.mean(spread[:, column] / sd) == pytest.approx(1.0, abs=0.06)


def test_an_entry_starts_with_its_cg_where_the_datum_s_flight_has_it():
    vehicle = vehicle_from_toml(vehicle_path("irve2_reference"))
    t = np.arange(0.0, 80.0, 1.0)
    q = rotations.exp(np.array([0.3, -1.1, 0.6]))
    v = earth.ecef_from_ned(np.array([200.0, 100.0, 1500.0]), earth.ecef_from_geodetic(0.6, -1.2, 9e4))
    r = earth.ecef_from_geodetic(0.6, -1.2, 9.9e4) + (t[:, None] - 1.0) * v
    n = len(t)
    path = Trajectory(
        "2009-08-17T12:50:00Z", t, "datum", r, np.tile(v, (n, 1)), np.tile(q, (n, 1)), np.zeros((n, 3)),
        np.tile(1e-12 * np.eye(9), (n, 1, 1)),
    )  # fmt: skip
    _, _, height = earth.geodetic_from_ecef(r)
    pressure = np.exp(-(((t - 40.0) / 10.0) ** 2))
    air = SimpleNamespace(
        altitude_m=height, flight_path_angle_rad=np.full(n, -1.4), time_s=t, dynamic_pressure_pa=pressure,
        mach=np.full(n, 5.0),
    )  # fmt: skip
    telemetry = SimpleNamespace(sounding=standard_sounding(), required_vehicle=lambda: vehicle)
    solution = SimpleNamespace(smoothed=path, imu_time_s=t, rate_body_radps=np.zeros((n, 3)))
    flight = SimpleNamespace(air=air, telemetry=telemetry, solution=solution)
    entry = preflight._Entry(flight, vehicle, None)
    start, _ = entry.start(None)
    k = int(np.searchsorted(t, entry.start_s))
    want = r[k] + rotations.rotate(q, vehicle.cg_m)
    got = rotations.rotate(earth.q_ecef_eci(entry.start_s), start.state[:3])
    np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-6)


def test_acceleration_across_the_axis_is_that_of_both_axes():
    bet = pd.DataFrame({"ay_cg_mps2": [3.0 * G0], "az_cg_mps2": [-4.0 * G0]})
    assert float(np.asarray(_FLOWN["normal_g"][2](bet))[0]) == pytest.approx(5.0)


def test_errors_of_a_trajectory_over_its_pulse_are_those_that_were_planted():
    # a straight flight off by known vectors, everywhere alike: rms are their lengths; the angle's is its own
    n = 41
    t = np.arange(n) * 0.5
    truth = pd.DataFrame(0.0, index=range(n), columns=list(STATE_COLUMNS))
    truth["t_s"], truth["qw_ecef_body"] = t, 1.0
    truth["rx_ecef_m"], truth["vx_ecef_mps"] = 6.5e6 + 100.0 * t, 100.0
    truth["dynamic_pressure_pa"] = 1000.0 * np.exp(-(((t - 10.0) / 3.0) ** 2))
    truth["alpha_body_deg"] = 5.0
    bet = truth.drop(columns=["dynamic_pressure_pa", "alpha_body_deg"]).copy()
    bet["ry_ecef_m"] += 3.0
    bet["rz_ecef_m"] -= 4.0
    bet["vz_ecef_mps"] += 0.2
    bet["alpha_total_wind_deg"] = 5.3
    sds = {"m": 2.0, "mps": 0.1}
    for unit, names in (("m", [f"r{a}_ecef" for a in "xyz"]), ("mps", [f"v{a}_ecef" for a in "xyz"])):
        bet[[f"{name}_sd_{unit}" for name in names]] = sds[unit]
    bet["alpha_total_wind_sd_deg"] = 0.2
    found = _bet_errors(bet, truth)
    assert found["position_sd_m"] == pytest.approx(2.0 * 3.0**0.5)
    assert found["velocity_sd_mps"] == pytest.approx(0.1 * 3.0**0.5)
    assert found["alpha_total_sd_deg"] == pytest.approx(0.2)
    assert found["position_rms_m"] == pytest.approx(5.0)
    assert found["velocity_rms_mps"] == pytest.approx(0.2)
    assert found["alpha_total_rms_deg"] == pytest.approx(0.3)
    # half the peak: |t - 10| < 3 sqrt(ln 2) = 2.498
    assert found["pulse_start_s"] == 8.0
    assert found["pulse_end_s"] == 12.0


def test_a_method_s_row_is_estimate_minus_truth(tmp_path):
    table = pd.DataFrame(
        {"t_s": [1.0, 2.0, 3.0], "theta_deg": [3.0, 3.5, 4.0], "plane_lv_deg": 180.0, "theta_sd_deg": 0.2}
    )
    table.to_csv(tmp_path / "deflection_trim.csv", index=False)
    row = _method_row(tmp_path / "deflection_trim.csv", 2.0, 3.0)
    assert row["error_deg"] == pytest.approx(0.5)
    assert row["sd_deg"] == pytest.approx(0.2)


# ------------------------------------------------------------------------------------------------------------ exports


def source():
    t = np.arange(0.0, 3.0, 0.5)
    state = {name: (1000.0 * (k + 1) + 7.0 * t) for k, name in enumerate(_OEM_STATE)}
    place = {"lat_deg": 37.0 + 0.01 * t, "lon_deg": -75.0 + 0.02 * t, "alt_m": 9e4 - 1e3 * t}
    covariance = np.tile(np.diag([4.0, 9.0, 16.0, 0.01, 0.04, 0.09, 1.0, 1.0, 1.0]), (3, 1, 1))
    return Source(
        "flight", "run", datetime(2009, 8, 17, 12, 50, tzinfo=UTC), "2026-01-01T00:00:00Z", True, {"point": "datum"},
        pd.DataFrame({"t_s": t} | state | place), pd.DataFrame({"event": ["apogee"], "t_s": [1.25]}), {},
        np.arange(3.0), covariance,
    )  # fmt: skip


def test_oem_is_in_kilometres_and_their_squares():
    lines = _oem(source()).decode().splitlines()
    first = lines[lines.index("META_STOP") + 2].split()
    assert first[0] == "2009-08-17T12:50:00.000000"
    np.testing.assert_allclose([float(x) for x in first[1:]], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert lines[lines.index("META_STOP") + 3].split()[0] == "2009-08-17T12:50:00.500000"
    diagonal = [float(lines[lines.index("COVARIANCE_START") + 3 + k].split()[k]) for k in range(6)]
    np.testing.assert_allclose(diagonal, np.array([4.0, 9.0, 16.0, 0.01, 0.04, 0.09]) / 1e6)


def test_kml_has_longitude_before_latitude():
    words = _kml(source()).decode()
    lon, lat, alt = (float(x) for x in words.split("<gx:coord>")[1].split("<")[0].split())
    assert (lon, lat) == (-75.0, 37.0)
    assert alt == pytest.approx(9e4 - float(undulation_m(np.deg2rad(37.0), np.deg2rad(-75.0))), abs=1e-3)


def turning():
    """The source with a body that turns about an axis of its own, at rates against inertial space."""
    rate = np.array([0.7, -0.4, 0.2])
    t = np.arange(0.0, 3.0, 0.01)
    start = rotations.exp(np.array([0.3, -1.1, 0.8]))
    # of a body at a steady rate in inertial space, seen from the Earth, which is there at time zero
    q = rotations.multiply(earth.q_ecef_eci(t), rotations.boxplus(start, t[:, None] * rate))
    table = {"t_s": t} | {f"q{a}_ecef_body": q[:, k] for k, a in enumerate("wxyz")}
    table |= {f"{a}_body_degps": np.full(len(t), np.rad2deg(rate[k])) for k, a in enumerate("pqr")}
    return replace(source(), trajectory=pd.DataFrame(table)), t, q


def test_aem_is_the_matrix_of_the_standard():
    """Its element by element form, by which components in A (Earth-fixed) go to B (body); the scalar is last."""
    flown, t, q = turning()
    lines = _aem(flown).decode().splitlines()
    assert {"ATTITUDE_DIR = A2B", "QUATERNION_TYPE = LAST", "REF_FRAME_A = ITRF2000"} <= set(lines)
    rows = [line.split() for line in lines[lines.index("DATA_START") + 1 : lines.index("DATA_STOP")]]
    assert len(rows) == len(t)
    assert rows[50][0] == "2009-08-17T12:50:00.500000"
    q1, q2, q3, qc = (float(x) for x in rows[50][1:])
    matrix = np.array(
        [
            [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
            [2 * (q1 * q2 - q3 * qc), -(q1**2) + q2**2 - q3**2 + qc**2, 2 * (q2 * q3 + q1 * qc)],
            [2 * (q1 * q3 + q2 * qc), 2 * (q2 * q3 - q1 * qc), -(q1**2) - q2**2 + q3**2 + qc**2],
        ]
    )
    nose_ecef = rotations.rotate(q[50], np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(matrix @ nose_ecef, [1.0, 0.0, 0.0], atol=1e-10)


def test_msopck_has_the_c_matrix_and_rates_that_turn_it():
    """SPICE's matrix of the quaternion takes the Earth's components to the body's; dC/dt = -[w x] C."""
    flown, t, q = turning()
    rows = [line.split() for line in _msopck(flown).decode().splitlines()]
    numbers = np.array([[float(x) for x in row[1:]] for row in rows])

    def c_matrix(row):
        q0, q1, q2, q3 = row[:4]
        return np.array(
            [
                [1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)],
                [2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)],
                [2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)],
            ]
        )

    before, now, after = (c_matrix(numbers[k]) for k in (99, 100, 101))
    np.testing.assert_allclose(now @ rotations.rotate(q[100], np.array([1.0, 0.0, 0.0])), [1.0, 0.0, 0.0], atol=1e-10)
    turned = (after - before) / (t[101] - t[99])
    # central differences: w^3 h^2 / 6 = 1e-5; the Earth's rate, which the rates must be rid of, is 7e-5
    np.testing.assert_allclose(turned, -rotations.skew(numbers[100, 4:]) @ now, atol=1.5e-5)
    assert not np.allclose(numbers[100, 4:], [0.7, -0.4, 0.2], atol=2e-5)


# ------------------------------------------------------------------------------------------------------ intake checks


def falling(width_s=4.0, noise_m=0.0, seed=0, thrust=0.0):
    """ECEF places of a fall from 100 km, with a steady push along its start's radius."""
    t = np.arange(0.0, 60.0, 0.1)
    r, v = np.array([6.478e6, 0.0, 0.0]), np.array([-200.0, 900.0, 100.0])
    out = []
    h = 0.1
    for _ in t:
        out.append(r)

        def a(r):
            return earth.gravitation(r) + np.array([thrust, 0.0, 0.0])

        k1 = a(r)
        k2 = a(r + 0.5 * h * v)
        k3 = a(r + 0.5 * h * v + 0.25 * h * h * k1)
        k4 = a(r + h * v + 0.5 * h * h * k2)
        r, v = r + h * v + h * h / 6.0 * (k1 + k2 + k3), v + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    eci = np.array(out) + noise_m * np.random.default_rng(seed).standard_normal((len(t), 3))
    return t, rotations.rotate(earth.q_ecef_eci(t), eci)


def test_a_track_tells_no_force_of_a_free_fall_and_the_whole_of_a_push():
    for thrust in (0.0, 12.0):
        force = track_force(*falling(thrust=thrust), 4.0)
        np.testing.assert_allclose(force.force_mps2, np.tile([thrust, 0.0, 0.0], (len(force.time_s), 1)), atol=2e-3)


def test_a_track_s_forces_scatter_as_they_say():
    normalised = []
    for seed in range(6):
        force = track_force(*falling(noise_m=3.0, seed=seed), 4.0)
        sd = np.sqrt(np.diagonal(force.covariance, axis1=1, axis2=2))
        normalised.append(force.force_mps2 / sd)
    # some 160 windows of three axes, half of them overlapping, of 40 samples each: an sd to 4 %
    assert np.std(np.concatenate(normalised)) == pytest.approx(1.0, abs=0.15)


def test_a_late_track_and_its_scale_are_found():
    # a force that swells and ebbs, told by an accelerometer 0.41 s earlier than by the track's tags: between two of the
    # lags that are tried, 25 ms apart
    force = track_force(*falling(), 2.0)
    t = np.arange(-10.0, 75.0, 0.01)

    def size(at):
        return 30.0 + 25.0 * np.sin(0.35 * at)

    swelling = replace(
        force, force_mps2=np.column_stack([size(force.time_s - 0.41), 0.0 * force.time_s, 0.0 * force.time_s]),
        covariance=np.tile(1e-4 * np.eye(3), (len(force.time_s), 1, 1)),
    )  # fmt: skip
    found = _compare(swelling, t, np.column_stack([size(t) / 1.3, 0.0 * t, 0.0 * t]))
    # the windows' kernel takes 1 % of the swelling, which moves no peak
    assert found.lag_s == pytest.approx(0.41, abs=0.004)
    assert found.scale == pytest.approx(1.3, rel=0.02)


def test_slope_s_sd_is_its_scatter():
    rng, x = np.random.default_rng(2), np.linspace(0.0, 3.0, 30)
    found = np.array([slope_through_mean(x, 2.0 * x + 0.5 + 0.3 * rng.standard_normal(30)) for _ in range(1500)])
    assert found[:, 0].mean() == pytest.approx(2.0, abs=0.01)
    assert np.std(found[:, 0]) == pytest.approx(np.sqrt(np.mean(found[:, 1] ** 2)), rel=0.08)


@pytest.mark.parametrize(("ratio", "unit", "wanted"), [(G0, "mps2", "g"), (1.0 / G0, "g", "mps2"), (0.3048, "m", "ft")])
def test_unit_that_explains_makes_values_as_many_times_as_large(ratio, unit, wanted):
    assert unit_that_explains(ratio, unit) == wanted
    assert unit_that_explains(1.0, unit) == unit
    assert unit_that_explains(1.7 * ratio, unit) is None


def test_what_stands_still_and_reads_one_is_in_g(monkeypatch):
    t, rng = np.arange(0.0, 5.0, 0.01), np.random.default_rng(1)
    monkeypatch.setattr(inertial, "_accelerometer_unit", lambda _: "mps2")

    def record(values):
        return SimpleNamespace(time_s=t, measured_sensor=values + 1e-4 * rng.standard_normal((len(t), 3)))

    still = record(np.zeros(3))
    for size, count in ((1.0, 1), (G0, 0)):
        found = SimpleNamespace(triads={"accelerometer": record(np.array([0.0, 0.6, -0.8]) * size), "rates": still})
        findings = inertial.at_rest(found)
        assert len(findings) == count
        if count:
            assert findings[0].code == "unit-suspect"
            assert findings[0].what.endswith("'g'")


def test_a_field_that_turns_as_the_gyros_say_raises_nothing():
    # a field at rest in space, seen from a body that turns: b' = b x w. With the gyros' signs turned it is explained
    # by no reading as they stand
    t = np.arange(0.0, 40.0, 0.02)
    w = np.column_stack([0.5 + 0.2 * np.sin(0.4 * t), 0.3 * np.cos(0.7 * t), 0.25 * np.sin(0.9 * t)])
    b, fields = np.array([2e-5, -1e-5, 4e-5]), []
    for k in range(len(t)):
        fields.append(b)
        half = b + 0.01 * np.cross(b, w[k])
        b = b + 0.02 * np.cross(half, w[k])
        b = b * np.linalg.norm(fields[0]) / np.linalg.norm(b)

    def told(rate):
        def record(values):
            spec = SimpleNamespace(dcm_body_sensor=np.eye(3), name="")
            return SimpleNamespace(time_s=t, measured_sensor=values, spec=spec)

        rates = SimpleNamespace(columns={}, declared=lambda short: f"{short}_radps")
        spec = SimpleNamespace(sensors=SimpleNamespace(rates=rates))
        return SimpleNamespace(triads={"rates": record(rate), "magnetometer": record(np.array(fields))}, spec=spec)

    findings, clock = field_rotation(told(w))
    assert findings == []
    assert clock is not None
    assert abs(clock[0]) < 0.02
    findings, _ = field_rotation(told(-w))
    assert len(findings) == 1


# ----------------------------------------------------------------------------------------------------- reconciliation


def test_what_is_gathered_along_a_track_is_both_senses_mean():
    frequency = np.fft.fftfreq(64, 1.0 / 32.0)
    power = np.zeros((2, 64))
    power[0] = np.where(np.abs(frequency) == 3.0, np.where(frequency > 0, 2.0, 1.0), 0.0)
    got = _track_power(frequency, power, np.array([3.0, np.nan]))
    np.testing.assert_allclose(got, [1.5, 0.0])
    half_way = _track_power(frequency, power, np.array([3.25, np.nan]))
    np.testing.assert_allclose(half_way, [0.75, 0.0])


def test_the_best_factor_is_a_parabola_s_top():
    x = np.log(FACTORS)
    for top in (0.013, -0.2):
        assert _peak(5.0 - 3.0 * (x - top) ** 2) == pytest.approx(top, abs=1e-9)


def test_a_failed_flight_is_in_no_band(tmp_path):
    # failed flights stand before and between the good ones; what they left in the histories is not a flight's
    (tmp_path / "chunks").mkdir()
    time_s = np.arange(4.0)
    levels = ((np.nan, 10.0, 1e9, 20.0), (30.0, np.nan, 50.0))
    wanted, run = [], 0
    for number, held in enumerate(levels):
        runs = list(range(run, run + len(held)))
        run += len(held)
        bad = tuple("lost" if not 0.0 < level < 1e3 else "" for level in held)
        histories = (np.array(held)[:, None, None] + time_s).astype(np.float32)
        columns = np.full(len(held), np.nan)
        write_chunk(tmp_path, number, Chunk(np.array(runs), bad, columns, columns[:, None], histories))
        wanted.append(runs)
    window = SimpleNamespace(history_time_s=lambda: time_s)
    study = SimpleNamespace(plan=SimpleNamespace(window=window, histories=["q"]))
    flown = np.array([False, True, False, True, True, False, True])
    bands = _bands(study, tmp_path, wanted, flown)
    # of 10, 20, 30 and 50 the middle is 25; the ends lie 2.3 % of three intervals inside
    np.testing.assert_array_equal(bands["flights"], 4)
    np.testing.assert_allclose(bands["p50"], 25.0 + time_s)
    np.testing.assert_allclose(bands["p2.3"], 10.0 + 0.069 * 10.0 + time_s, rtol=1e-6)
    np.testing.assert_allclose(bands["p97.7"], 50.0 - 0.069 * 20.0 + time_s, rtol=1e-6)


def test_windows_of_a_vehicle_that_pitches_fast_are_short_enough():
    """FIRE II at peak pressure: pitching by the linear model and 171 rpm turn its rates in body axes at 8.8 Hz."""
    vehicle, pressure_pa, mach, spin = vehicle_from_toml(vehicle_path("fire2")), 118_500.0, 25.0, 17.9
    slopes = slopes_at(vehicle, np.array([mach]))[0]
    frequency = modes(linear_matrix(vehicle, slopes, pressure_pa, 7000.0)).frequencies_hz[0]
    air = SimpleNamespace(mach=np.array([mach]), dynamic_pressure_pa=np.array([pressure_pa]))
    at = SimpleNamespace(time_s=np.zeros(1))
    bet = SimpleNamespace(smoothed=at, imu_time_s=at.time_s, rate_body_radps=np.array([[spin, 0.0, 0.0]]))
    fastest = reconstruction.fastest_radps(vehicle, bet, air)
    assert fastest == pytest.approx(2.0 * np.pi * frequency + spin, rel=0.02)
    # of an acceleration that turns at that rate no more is left out than at 2.5 Hz by the usual window
    t = np.arange(0.0, 2.0, 1e-4)
    turning = np.column_stack([0.0 * t, np.cos(fastest * t), np.sin(fastest * t)])
    seen = SimpleNamespace(imu_time_s=t, specific_force_body_mps2=0.0 * turning, rate_body_radps=turning)
    h = reconstruction._MOST_TURN_RAD / fastest
    got = atmosphere.cg_accelerations(seen, np.array([1.0]), np.zeros(3), h).angular_acceleration_radps2[0]
    assert np.linalg.norm(got) / fastest == pytest.approx(0.968, abs=0.003)

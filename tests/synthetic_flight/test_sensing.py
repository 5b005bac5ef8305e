from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.checks import ConfigError, GateError
from flightmodel.trajectory import move_point
from synthetic_flight import sensing
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.instrument_errors import Dropouts, Gnss
from synthetic_flight.scenarios import child_rng, fly_scenario, read_scenario
from synthetic_flight.weather import day_of_flight_atmosphere, sense_atmosphere
from tests.refusing import refuses


@pytest.fixture(scope="module")
def scenario():
    whole = read_scenario("irve2_reference")
    time = whole.spec.time.model_copy(update={"stop_s": 450.0})
    return replace(whole, spec=whole.spec.model_copy(update={"time": time, "video": None}))


@pytest.fixture(scope="module")
def truth(scenario):
    return fly_scenario(scenario, 5)


def quiet(spec, **keep):
    return spec.model_copy(update={k: keep.get(k, 0.0) for k in type(spec).model_fields if k != "rate_hz"})


def test_the_flight_is_the_reference_s(truth):
    k = int(np.argmax(truth.altitude_m))
    assert truth.altitude_m[k] == pytest.approx(218e3, abs=300.0)
    assert truth.time_s[k] == pytest.approx(243.0, abs=0.3)
    assert truth.deflection.theta_rad[truth.time_s < 300.0].max() < 1e-6  # locked before inflation
    assert np.rad2deg(truth.deflection.theta_rad.max()) > 3.0


def test_ideal_accelerometer_is_the_second_derivative_of_its_place(truth):
    """Specific force = inertial acceleration less gravitation, at the package's own place, through the pulse."""
    vehicle = truth.vehicle
    place = np.array(vehicle.sensors["suba"].position_from_datum_body_m)
    path = move_point(truth.trajectory, "imu", place)
    t = path.time_s
    to_eci = rotations.conjugate(earth.q_ecef_eci(t))
    r = rotations.rotate(to_eci, path.position_ecef_m)
    v = rotations.rotate(to_eci, path.velocity_ecef_mps + np.cross(earth.OMEGA_ECEF_RADPS, path.position_ecef_m))
    acceleration = (v[2:] - v[:-2]) / (t[2:] - t[:-2])[:, None] - earth.gravitation(r[1:-1])
    q_body_eci = rotations.conjugate(rotations.multiply(to_eci, path.q_ecef_body))[1:-1]
    felt = truth.specific_force_body(place)[1:-1]
    pulse = t[1:-1] > 425.0
    # central differences over 8 ms: (2 pi 2.8 Hz)^2 h^2 / 6 of the 2.8 Hz part, rounding of 1e6 m positions (6e-3 in
    # all), and h / 4 of the jump in slope at a knot of the air: 2 % of 80 m/s^2 in 0.2 s, so 8e-3
    np.testing.assert_allclose(felt[pulse], rotations.rotate(q_body_eci, acceleration)[pulse], atol=1.4e-2)
    assert np.abs(felt[pulse]).max() > 60.0


def test_package_axes_and_lever_arm_are_alive(scenario, truth):
    vehicle, spec = truth.vehicle, quiet(scenario.spec.accelerometer)
    at, suba = sensing.sense_accelerometer(truth, vehicle, "suba", spec, 420.0, np.random.default_rng(0))
    body = truth.specific_force_body(np.array(vehicle.sensors["suba"].position_from_datum_body_m))
    rows = np.searchsorted(truth.time_s, at - 1e-6)
    # z is aft, x is clocked at 135 deg: (0, cos 45, cos 45) in body axes
    np.testing.assert_allclose(suba[:, 2], -body[rows, 0], atol=1e-9)
    np.testing.assert_allclose(suba[:, 0], (body[rows, 1] + body[rows, 2]) / np.sqrt(2.0), atol=1e-9)
    at_cg = truth.specific_force_body(vehicle.cg_m)
    assert np.abs(body - at_cg)[rows].max() > 0.15  # 36 deg/s of spin alone is 0.02 m/s^2; the pitching adds


def test_each_error_has_its_declared_size(scenario, truth):
    rng = np.random.default_rng(1)
    spec, vehicle = scenario.spec.accelerometer, truth.vehicle
    ideal = sensing.sense_accelerometer(truth, vehicle, "suba", quiet(spec), 300.0, rng)[1]
    drawn = [
        sensing.sense_accelerometer(truth, vehicle, "suba", quiet(spec, bias_mps2=0.098), 300.0, rng)[1][0] - ideal[0]
        for _ in range(40)
    ]
    # 120 draws of a bias: 6.5 % of its sd, 3 sd
    assert np.std(drawn) == pytest.approx(0.098, rel=0.2)
    noise = sensing.sense_accelerometer(truth, vehicle, "suba", quiet(spec, noise_mps2=0.049), 300.0, rng)[1] - ideal
    assert np.std(noise) == pytest.approx(0.049, rel=0.02)
    stepped = sensing.sense_accelerometer(truth, vehicle, "suba", quiet(spec, resolution_mps2=0.03), 300.0, rng)[1]
    np.testing.assert_allclose(np.mod(stepped / 0.03 + 0.5, 1.0), 0.5, atol=1e-6)
    turned = sensing.sense_accelerometer(truth, vehicle, "suba", quiet(spec, mount_deg=0.2), 300.0, rng)[1]
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(ideal, axis=1), atol=1e-9)


def test_radar_tracks_the_true_cg_with_beam_noise(scenario, truth):
    site = scenario.spec.radars["wallops_island"]
    still = site.model_copy(
        update=dict.fromkeys(("range_sd_m", "angle_sd_deg", "range_bias_m", "angle_bias_deg", "time_bias_s"), 0.0)
    )
    at, clean = sensing.sense_radar(truth, still, 300.0, np.random.default_rng(0))
    place = (np.deg2rad(site.latitude_deg), np.deg2rad(site.longitude_deg), site.height_m)
    rows = np.searchsorted(truth.time_s, at - 1e-6)
    cg = rotations.rotate(earth.q_ecef_eci(at), truth.state_eci[rows, :3])
    np.testing.assert_allclose(earth.ecef_from_radar(clean, *place), cg, rtol=0.0, atol=1e-3)
    scattered = site.model_copy(update=dict.fromkeys(("range_bias_m", "angle_bias_deg", "time_bias_s"), 0.0))
    noisy = sensing.sense_radar(truth, scattered, 300.0, np.random.default_rng(0))[1]
    error = noisy - clean
    across = np.rad2deg(np.column_stack([error[:, 1] * np.cos(clean[:, 2]), error[:, 2]]))
    # 1500 points: 1.8 % of a standard deviation, 3 sd
    np.testing.assert_allclose(np.std(across, axis=0), site.angle_sd_deg, rtol=0.06)
    assert np.std(error[:, 0]) == pytest.approx(site.range_sd_m, rel=0.06)
    late = sensing.sense_radar(truth, still.model_copy(update={"time_bias_s": 0.02}), 300.0, np.random.default_rng(3))[
        1
    ]
    speed = np.gradient(clean[:, 0], at)
    delay = -(late[:, 0] - clean[:, 0]) / speed
    assert np.std(delay[50:-50]) < 1e-3 * np.abs(delay[50:-50]).mean()  # one delay for the whole track


def test_sounding_errs_as_large_as_assumed_but_in_another_way(scenario, truth):
    from flightmodel.atmosphere import default_sounding_sd

    errors = []
    for seed in range(60):
        z, air, wind = sense_atmosphere(truth.profile, scenario.spec.atmosphere, np.random.default_rng(seed))
        day = truth.profile.at(z)
        density_sd, wind_sd = default_sounding_sd(z)
        errors.append(
            np.column_stack(
                [
                    np.log(air[:, 0] / day.density_kgpm3) / density_sd,
                    (wind - day.wind_ned_mps[:, :2]) / wind_sd[:, None],
                ]
            )
        )
    size = np.sqrt(np.mean(np.array(errors)[:, 10:80] ** 2, axis=(0, 1)))
    # a constant part of 0.6 sd: 60 draws give its mean square to 18 %; structure lost by smoothing adds a little
    np.testing.assert_allclose(size, 1.0, atol=0.25)
    one = errors[0][10:80, 0]
    spectrum = np.abs(np.fft.rfft(one - one.mean())) ** 2
    assert spectrum[8:13].sum() > 0.5 * spectrum[1:].sum()  # the wave of 7 km stands out, which no Markov process does


def test_instruments_do_not_share_noise_and_a_day_is_a_seed(scenario):
    a, b = (child_rng(3, name).standard_normal(4) for name in ("wallops_island", "rates"))
    assert not np.allclose(a, b)
    np.testing.assert_array_equal(a, child_rng(3, "wallops_island").standard_normal(4))
    spec, mean = scenario.spec.atmosphere, scenario.mean_air
    one, two = (day_of_flight_atmosphere(spec, child_rng(s, "atmosphere"), mean) for s in (3, 4))
    assert not np.allclose(one.log_density_ratio, two.log_density_ratio)


def test_folders_are_reproducible_and_never_overwritten(tmp_path, scenario):
    short = scenario.spec.time.model_copy(
        update={"start_s": 399.0, "telemetry_from_s": 400.0, "stop_s": 404.0, "inflated_s": None}
    )
    prior = scenario.spec.attitude_prior.model_copy(update={"t_s": 400.0})
    brief = replace(scenario, spec=scenario.spec.model_copy(update={"time": short, "attitude_prior": prior}))
    for name in ("a", "b"):
        simulate_to_folder(brief, 2, tmp_path / name)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) > 8
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]  # nothing partial beside them
    with pytest.raises(GateError) as refusal:
        simulate_to_folder(brief, 2, tmp_path / "a")
    assert refusal.value.codes == ("file-exists",)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(GateError) as refusal:
        simulate_to_folder(brief, 2, tmp_path / "mine", replace=True)
    assert refusal.value.codes == ("file-exists",)
    assert (tmp_path / "mine" / "thesis.txt").exists()


def test_unknown_scenario_and_faults_of_a_file(tmp_path):
    with refuses("name-unknown", names=["'irve2_reference'"], kind=ConfigError):
        read_scenario("irve2_refernce")
    text = read_scenario("irve2_reference").source.read_text()
    (tmp_path / "bad.toml").write_text(
        text.replace("spin_rpm = 6.0", "spin_rmp = 6.0").replace("stop_s = 530.0", "stop_s = 30.0")
    )
    with refuses(
        "key-unknown", "keys-conflict", names=["'spin_rpm'", r"telemetry_from_s\b.*\bstop_s"], kind=ConfigError
    ):
        read_scenario(str(tmp_path / "bad.toml"))


# ---- receivers, packages of any name


RECEIVER = Gnss(
    rate_hz=10.0, antenna_from_datum_body_m=(-1.2, 0.3, -0.1), horizontal_sd_m=0.0, vertical_sd_m=0.0, speed_sd_mps=0.0,
    vertical_speed_sd_mps=0.0,
)  # fmt: skip


def test_an_ideal_receiver_has_its_antennas_place_and_motion(truth):
    at, fixes = sensing.sense_gnss(truth, RECEIVER, 300.0, np.random.default_rng(0))
    path = move_point(truth.trajectory, "antenna", np.array(RECEIVER.antenna_from_datum_body_m))
    rows = np.searchsorted(truth.time_s, at - 1e-9)
    np.testing.assert_allclose(fixes[:, :3], path.position_ecef_m[rows], atol=1e-4)
    np.testing.assert_allclose(fixes[:, 3:], path.velocity_ecef_mps[rows], atol=2e-3)
    # its velocity is the change of its place: 0.1 s steps of the pulse's 80 m/s^2 err by (0.1)^2 / 6 of their change
    middle = at[1:-1] < 420.0
    slope = (fixes[2:, :3] - fixes[:-2, :3]) / 0.2
    np.testing.assert_allclose(slope[middle], fixes[1:-1, 3:][middle], atol=0.02)


def test_errors_of_a_receiver_are_as_large_as_stated_and_late_is_positive(truth):
    stated = {"horizontal_sd_m": 3.0, "vertical_sd_m": 8.0, "speed_sd_mps": 0.2, "vertical_speed_sd_mps": 0.5}
    _, ideal = sensing.sense_gnss(truth, RECEIVER, 300.0, np.random.default_rng(0))
    _, noisy = sensing.sense_gnss(truth, RECEIVER.model_copy(update=stated), 300.0, np.random.default_rng(1))
    ned = [earth.ned_from_ecef((noisy - ideal)[:, part], ideal[:, :3]) for part in (slice(0, 3), slice(3, 6))]
    # 1500 fixes: 1.8 %, 4 sd
    for found, sd in zip(np.column_stack(ned).std(axis=0), (3.0, 3.0, 8.0, 0.2, 0.2, 0.5), strict=True):
        assert found == pytest.approx(sd, rel=0.08)
    wander = RECEIVER.model_copy(update={"wander_m": 5.0, "wander_time_constant_s": 2.0})
    slow = sensing.sense_gnss(truth, wander, 300.0, np.random.default_rng(2))[1] - ideal
    # 75 independent values an axis: 8 % each, three axes
    assert np.sqrt(np.mean(slow[:, :3] ** 2)) == pytest.approx(5.0, rel=0.2)
    assert np.allclose(slow[:, 3:], 0.0)
    wander = RECEIVER.model_copy(update={"velocity_wander_mps": 0.5, "velocity_wander_time_constant_s": 2.0})
    slow = sensing.sense_gnss(truth, wander, 300.0, np.random.default_rng(2))[1] - ideal
    assert np.allclose(slow[:, :3], 0.0)
    assert np.sqrt(np.mean(slow[:, 3:] ** 2)) == pytest.approx(0.5, rel=0.2)
    late = sensing.sense_gnss(truth, RECEIVER.model_copy(update={"time_bias_s": 0.5}), 300.0, np.random.default_rng(3))[
        1
    ]
    behind = np.sum((ideal - late)[:, :3] * ideal[:, 3:], axis=1) / np.sum(ideal[:, 3:] ** 2, axis=1)
    drawn = 0.5 * np.random.default_rng(3).standard_normal()
    assert np.median(behind[5:-5]) == pytest.approx(drawn, abs=0.02)


def test_blackout_leaves_no_fix_and_all_of_it_is_refused(truth):
    gone = RECEIVER.model_copy(update={"dropouts": Dropouts(outages_s=((310.0, 330.0),))})
    at, _ = sensing.sense_gnss(truth, gone, 300.0, np.random.default_rng(0))
    assert not ((at >= 310.0) & (at < 330.0)).any()
    with refuses("track-short", names=["gps"]):
        never = RECEIVER.model_copy(update={"dropouts": Dropouts(outages_s=((0.0, 1e4),))})
        sensing.sense_gnss(truth, never, 300.0, np.random.default_rng(0), "gps")

"""Magnetometer and Sun sensors of a spinning vehicle, and that no instrument's noise depends on another's."""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.flightfolder import read_flight
from flightmodel.geomagnetism_and_sun import magnetic_field_ned_t, sun_direction_ecef
from flightmodel.instruments import dcm_body_from_sun_head, direction_from_sun_angles, sun_angles_from_direction
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.instrument_errors import Accelerometer, Dropouts, Magnetometer, SunSensors, child
from synthetic_flight.scenarios import fly_scenario, read_scenario
from synthetic_flight.sensing import sense_accelerometer, sense_magnetometer, sense_sun


@pytest.fixture(scope="module")
def rich():
    return read_scenario("irve2_rich")


def cut(scenario, stop_s, **changes):
    time = scenario.spec.time.model_copy(update={"stop_s": stop_s, "telemetry_from_s": 95.0, "inflated_s": None})
    prior = scenario.spec.attitude_prior.model_copy(update={"t_s": 95.0})
    spec = scenario.spec.model_copy(update={"time": time, "attitude_prior": prior, **changes})
    return replace(scenario, spec=spec)


@pytest.fixture(scope="module")
def truth(rich):
    """Upward leg from 110 km: 40 s, four turns."""
    return fly_scenario(cut(rich, 130.0), 3)


def magnetometer(**errors):
    return Magnetometer(**{"rate_hz": 125.0, "noise_ut": 0, "bias_ut": 0, "scale": 0, "mount_deg": 0, **errors})


def sun(**errors):
    return SunSensors(**{"rate_hz": 20.0, "noise_deg": 0.0, "bias_deg": 0.0, "mount_deg": 0.0, **errors})


def field_of(truth, seed=0, **errors):
    return sense_magnetometer(truth, truth.vehicle, magnetometer(**errors), 100.0, np.random.default_rng(seed))


def sun_of(truth, seed=0, **errors):
    return sense_sun(truth, sun(**errors), 100.0, np.random.default_rng(seed))


def attitude(truth, at):
    return rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, at)


# -------------------------------------------------------------------------------------------------------- magnetometer


def test_ideal_magnetometer_reads_igrf_at_its_place(truth):
    at, sensor = field_of(truth)
    dcm = truth.vehicle.sensors["magnetometer"].dcm_body_sensor
    rows = np.searchsorted(truth.time_s, at - 1e-6)[::100]
    place = truth.trajectory.position_ecef_m[rows]
    ecef = rotations.rotate(truth.trajectory.q_ecef_body[rows], sensor[::100] @ dcm.T)
    ned = magnetic_field_ned_t(*earth.geodetic_from_ecef(place), truth.trajectory.epoch_utc)
    # the path's interpolation is good to 0.2 nT; a lever arm of 1.1 m is 0.03 nT
    np.testing.assert_allclose(earth.ned_from_ecef(ecef, place), ned, atol=0.25e-9)
    # the vehicle spins: across the axis the field turns, once in ten seconds
    turn = np.unwrap(np.arctan2(sensor[:, 1], sensor[:, 0]))
    assert abs(turn[-1] - turn[0]) / (at[-1] - at[0]) == pytest.approx(2.0 * np.pi / 10.0, rel=0.05)


def test_lever_arm_of_the_magnetometer_is_alive(truth):
    """Moved 20 km along the axis (a field changes by 25 nT/km) the magnetometer reads the field there."""
    far = truth.vehicle.sensors["magnetometer"].model_copy(update={"position_from_datum_body_m": (-20e3, 0.0, 0.0)})
    vehicle = replace(truth.vehicle, sensors={**truth.vehicle.sensors, "magnetometer": far})
    at, sensor = sense_magnetometer(truth, vehicle, magnetometer(), 100.0, np.random.default_rng(0))
    q = attitude(truth, at[:1])
    place = truth.trajectory.position_ecef_m[np.searchsorted(truth.time_s, at[0] - 1e-6)]
    place = place + rotations.rotate(q, np.array([[-20e3, 0.0, 0.0]]))[0]
    ecef = rotations.rotate(q, (far.dcm_body_sensor @ sensor[0])[None])
    ned = magnetic_field_ned_t(*earth.geodetic_from_ecef(place), truth.trajectory.epoch_utc)[0]
    # 20 km of arm swing the path by kilometres between knots: 1 nT
    np.testing.assert_allclose(earth.ned_from_ecef(ecef, place[None])[0], ned, atol=2e-9)
    assert np.abs(sensor[0] - field_of(truth)[1][0]).max() > 100e-9


def test_iron_bends_and_adds_to_the_field(truth):
    """A linear fit in body axes finds a symmetric matrix and a constant; both as large as declared."""
    dcm = truth.vehicle.sensors["magnetometer"].dcm_body_sensor
    ideal = field_of(truth)[1] @ dcm.T
    off, hard = [], []
    for seed in range(40):
        body = field_of(truth, seed, soft_iron=0.02, hard_iron_ut=1.5)[1] @ dcm.T
        fit = np.linalg.lstsq(np.column_stack([ideal * 1e6, np.ones(len(ideal))]), body * 1e6, rcond=None)[0]
        matrix = fit[:3]
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-6)
        off.append((matrix - np.eye(3))[np.triu_indices(3)])
        hard.append(fit[3])
    # 240 and 120 draws: 4.6 % and 6.5 % of a standard deviation
    assert np.std(off) == pytest.approx(0.02, rel=0.18)
    assert np.std(hard) == pytest.approx(1.5, rel=0.26)


def test_magnetometer_has_the_errors_of_a_triad(truth):
    ideal = field_of(truth)[1]
    noise = field_of(truth, 1, noise_ut=0.2)[1] - ideal
    assert noise.std() == pytest.approx(0.2e-6, rel=0.03)  # 11000 values: 0.7 %
    _, narrow = field_of(truth, 1, range_ut=(20.0, 60.0, 60.0))
    assert np.abs(narrow[:, 0]).max() == pytest.approx(20e-6, rel=1e-12)
    assert np.abs(ideal[:, 0]).max() > 22e-6
    # behind a slow low-pass the turning field is late by 1 / w of the first-order corner
    _, slow = field_of(truth, 1, bandwidth_hz=1.0, filter_order=1)
    late = np.unwrap(np.arctan2(ideal[:, 1], ideal[:, 0])) - np.unwrap(np.arctan2(slow[:, 1], slow[:, 0]))
    rate = np.gradient(np.unwrap(np.arctan2(ideal[:, 1], ideal[:, 0])), 1.0 / 125.0)
    assert np.median(late / rate) == pytest.approx(1.0 / (2.0 * np.pi), rel=0.03)
    at, _ = field_of(truth, 1, dropouts=Dropouts(outages_s=((110.0, 111.0),)))
    assert not ((at >= 110.0) & (at < 111.0)).any()


def test_elements_at_their_own_places_feel_their_own_spin(truth):
    """On a spinning vehicle an element moved by d off the axis feels w x (w x d) more, here along its own axis."""
    quiet = {"rate_hz": 125.0, "noise_mps2": 0.0, "bias_mps2": 0.0, "scale": 0.0, "mount_deg": 0.0}
    moved = Accelerometer(**quiet, elements_sensor_m=((0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.0)))
    args = (truth, truth.vehicle, "suba")
    at, one = sense_accelerometer(*args, Accelerometer(**quiet), 100.0, np.random.default_rng(0))
    _, split = sense_accelerometer(*args, moved, 100.0, np.random.default_rng(0))
    dcm = truth.vehicle.sensors["suba"].dcm_body_sensor
    rows = np.searchsorted(truth.time_s, at - 1e-6)
    w = truth.trajectory.omega_body_eci_body_radps[rows] @ dcm
    for axis, length in enumerate((0.1, 0.2)):
        # along the arm the turning acceleration has no part; gravity's gradient is 3e-7
        felt = -length * (np.sum(w**2, axis=1) - w[:, axis] ** 2)
        np.testing.assert_allclose(split[:, axis] - one[:, axis], felt, atol=1e-6)
        assert np.abs(felt).max() > 0.03
    np.testing.assert_array_equal(split[:, 2], one[:, 2])


# --------------------------------------------------------------------------------------------------------- Sun sensors


def test_head_angles_and_their_inverse():
    rng = np.random.default_rng(0)
    n = rng.standard_normal((50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    np.testing.assert_allclose(direction_from_sun_angles(sun_angles_from_direction(n)), n, atol=1e-12)
    # a head at 90 deg of clocking looks along body z, with body x up in its view
    dcm = dcm_body_from_sun_head(np.deg2rad(90.0))
    np.testing.assert_allclose(dcm, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)
    assert np.linalg.det(dcm_body_from_sun_head(0.7)) == pytest.approx(1.0)
    np.testing.assert_allclose(sun_angles_from_direction(np.array([0.5, 0.0, np.sqrt(0.75)])), [0.0, np.pi / 6])


def test_ideal_heads_point_at_the_sun_and_two_of_four_see_it(truth):
    at, angles = sun_of(truth)
    q = attitude(truth, at)
    to_sun = sun_direction_ecef(truth.trajectory.epoch_utc, at)
    seen = np.isfinite(angles[:, :, 0])
    for k, clock in enumerate(np.deg2rad([45.0, 135.0, 225.0, 315.0])):
        body = direction_from_sun_angles(angles[seen[:, k], k]) @ dcm_body_from_sun_head(clock).T
        np.testing.assert_allclose(rotations.rotate(q[seen[:, k]], body), to_sun[seen[:, k]], atol=1e-9)
        # clocking phi looks along (0, -cos phi, sin phi)
        outward = rotations.rotate(q, np.broadcast_to([0.0, -np.cos(clock), np.sin(clock)], (len(at), 3)))
        np.testing.assert_array_equal(seen[:, k], np.sum(outward * to_sun, axis=1) >= 0.0)
    # half a sky each, a quarter turn apart: always two, as the vehicle turns each in its time
    assert (seen.sum(axis=1) == 2).all()
    assert seen.any(axis=0).all()


def test_narrow_heads_see_less(truth):
    _, angles = sun_of(truth, field_deg=80.0)
    off_axis = np.arccos(direction_from_sun_angles(sun_of(truth)[1])[..., 2])
    np.testing.assert_array_equal(np.isfinite(angles[..., 0]), off_axis <= np.deg2rad(40.0))
    assert np.isnan(angles[..., 0]).all(axis=1).any()


def test_no_sun_below_the_limb(truth):
    night = replace(truth, trajectory=replace(truth.trajectory, epoch_utc="2009-08-17T05:00:00Z"))
    at, angles = sun_of(night)
    assert np.isnan(angles).all()
    assert len(at) == len(sun_of(truth)[0])  # rows without Sun are rows


def test_accuracy_is_across_the_line_of_sight(truth):
    _, clean = sun_of(truth)
    _, noisy = sun_of(truth, 1, noise_deg=1.0)
    error = np.rad2deg(noisy - clean)
    across = np.stack([error[..., 0] * np.cos(clean[..., 1]), error[..., 1]], axis=-1)
    # 1200 values: 2 % of a standard deviation
    assert np.nanstd(across) == pytest.approx(1.0, rel=0.08)
    draws = child(np.random.default_rng(1), "head 3")
    draws.standard_normal(5)  # mount and bias
    raw = draws.standard_normal((len(clean), 2))
    seen = np.isfinite(clean[:, 3, 0])
    # the sine of the elevation is not small, so that a missing 1 / cos would show
    assert np.abs(clean[seen, 3, 1]).max() > 0.2
    np.testing.assert_allclose(across[seen, 3], raw[seen], atol=1e-9)
    biases, turns = [], []
    for seed in range(40):
        error = np.rad2deg(sun_of(truth, seed, bias_deg=0.5)[1] - clean)
        biases.append(np.nanmean(error[..., 1], axis=0))
        np.testing.assert_allclose(np.nanstd(error[..., 1], axis=0), 0.0, atol=1e-9)
        a, b = (direction_from_sun_angles(x[:, 0]) for x in (sun_of(truth, seed, mount_deg=0.3)[1], clean))
        turns.append(np.nanmean(np.sum((a - b) ** 2, axis=1)))
    assert np.std(biases) == pytest.approx(0.5, rel=0.24)  # 160 draws: 5.6 %
    # a random turn moves a direction by its two parts across it: 2 (0.3 deg)^2 in the mean; 40 of them scatter by 16 %
    assert np.mean(turns) == pytest.approx(2.0 * np.deg2rad(0.3) ** 2, rel=0.6)
    _, stepped = sun_of(truth, resolution_deg=0.1)
    np.testing.assert_allclose(np.mod(np.rad2deg(stepped[np.isfinite(stepped)]) / 0.1 + 0.5, 1.0), 0.5, atol=1e-6)


def test_delay_shows_the_sun_where_it_was(truth):
    _, clean = sun_of(truth)
    _, late = sun_of(truth, delay_s=0.05)
    np.testing.assert_allclose(late[1:], clean[:-1], atol=1e-9)  # one sample at 20 Hz


def test_earthlight_pulls_towards_the_nadir(truth):
    """A second light of weight k at an angle psi turns the direction by atan(k sin psi / (1 + k cos psi))."""
    at, clean = sun_of(truth)
    _, pulled = sun_of(truth, albedo=0.1)
    q = attitude(truth, at)
    place = np.column_stack([np.interp(at, truth.time_s, c) for c in truth.trajectory.position_ecef_m.T])
    up = place / np.linalg.norm(place, axis=1, keepdims=True)
    to_sun = sun_direction_ecef(truth.trajectory.epoch_utc, at)
    height = np.sum(up * to_sun, axis=1)
    weight = 0.1 * height * (earth.SEMI_MAJOR_M / np.linalg.norm(place, axis=1)) ** 2
    psi = np.arccos(-height)
    expected = np.arctan2(weight * np.sin(psi), 1.0 + weight * np.cos(psi))
    counted = 0
    for k, clock in enumerate(np.deg2rad([45.0, 135.0, 225.0, 315.0])):
        outward = rotations.rotate(q, np.broadcast_to([0.0, -np.cos(clock), np.sin(clock)], (len(at), 3)))
        nadir_seen = np.sum(outward * -up, axis=1) > 0.0
        a, b = (direction_from_sun_angles(x[:, k]) for x in (pulled, clean))
        moved = 2.0 * np.arcsin(0.5 * np.linalg.norm(a - b, axis=1))
        both = np.isfinite(moved)
        np.testing.assert_allclose(moved[both], np.where(nadir_seen, expected, 0.0)[both], atol=1e-9)
        counted += (both & nadir_seen).sum()
        toward = np.sum(rotations.rotate(q, (a - b) @ dcm_body_from_sun_head(clock).T) * -up, axis=1)
        assert (toward[both & nadir_seen] > 0.0).all()
    assert counted > 100
    assert expected.max() > 0.02


def test_a_head_keeps_its_errors_when_others_go(truth):
    four = sun_of(truth, 2, noise_deg=1.0, bias_deg=0.5, mount_deg=0.3)[1]
    two = sun_of(truth, 2, noise_deg=1.0, bias_deg=0.5, mount_deg=0.3, heads_lv_deg=(45.0, 135.0))[1]
    np.testing.assert_array_equal(four[:, :2], two)


# ------------------------------------------------------------------------------------------------------- whole folders


def test_rich_folder_reads_back_and_instruments_do_not_share_seeds(rich, tmp_path):
    """Without Sun sensors, magnetometer and one radar the other files keep their bytes."""
    few = {k: v for k, v in rich.spec.radars.items() if k == "wallops_mainland"}
    simulate_to_folder(cut(rich, 100.0), 7, tmp_path / "whole")
    simulate_to_folder(cut(rich, 100.0, radars=few, magnetometer=None, sun=None), 7, tmp_path / "part")
    names = {p.name for p in (tmp_path / "whole/telemetry").iterdir()}
    kept = {p.name for p in (tmp_path / "part/telemetry").iterdir()}
    assert names - kept == {"magnetometer.csv", "sun.csv", "radar_wallops_island.csv"}
    for name in kept:
        assert (tmp_path / "whole/telemetry" / name).read_bytes() == (tmp_path / "part/telemetry" / name).read_bytes()
    told = read_flight(tmp_path / "whole")
    assert told.magnetometer is not None
    assert told.sun is not None
    size = np.linalg.norm(told.magnetometer.measured_sensor, axis=1)
    assert 45e-6 < np.median(size) < 55e-6
    assert told.magnetometer.spec.noise_sd == pytest.approx(0.2e-6)
    assert told.magnetometer.spec.soft_iron_sd == rich.spec.magnetometer.soft_iron
    assert told.sun.az_el_head_rad.shape[1:] == (4, 2)
    site = told.radars["wallops_island"].spec
    assert site.droop_sd_rad == pytest.approx(np.deg2rad(0.0029))
    assert site.wander_time_constant_s == 20.0
    lean = read_flight(tmp_path / "part")
    assert lean.magnetometer is None
    assert lean.sun is None


def test_every_error_of_the_rich_scenario_is_alive(rich):
    """No error that a section knows is left at nothing."""
    sections = [
        rich.spec.accelerometer,
        rich.spec.rates,
        rich.spec.magnetometer,
        rich.spec.sun,
        *rich.spec.radars.values(),
    ]
    skipped = {"offset_s", "max_range_m", "min_elevation_deg", "profile", "outages_s", "scale_asymmetry"}
    for section in sections:
        # a magnetometer's clock is drawn by none: its field turns as slowly as the vehicle
        known = skipped | ({"time_bias_s"} if section is rich.spec.magnetometer else set())
        for name in type(section).model_fields:
            # the two pulse radars give no range rate: its errors are tested in test_sensing_radar
            if name not in known and not name.startswith("range_rate_"):
                assert getattr(section, name), f"{type(section).__name__}.{name}"

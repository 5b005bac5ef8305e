"""Lag, roll and mirror image of one triad against the other, planted in a vehicle that swings; single faults."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from recon.fault_isolation import isolate_faults
from recon.hypotheses import Explanation, corrections, likeliest, ranked
from recon.imu_screening import bridge
from recon.oscillation import DELIVERED, LAG, MIRRORED, ROLL, axes_check, common_angle, oscillation
from recon.reconstruct import reconstruct
from recon.settings import Settings
from tests.recon.test_time_bias import swinging

VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))
FAST = Settings(output_rate_hz=5.0)


FAST_MPS = 2000.0


def found(force, rate, vehicle=VEHICLE, speed_mps=FAST_MPS):
    speed = None if speed_mps is None else (force.time_s[[0, -1]], np.full(2, speed_mps))
    return oscillation(bridge(force), bridge(rate, 1), -np.inf, np.inf, vehicle, speed)


def turned(record, matrix):
    return replace(record, measured_sensor=record.measured_sensor @ np.asarray(matrix).T)


def about_roll(deg):
    return Rotation.from_euler("x", deg, degrees=True).as_matrix()


@pytest.mark.parametrize("seed", range(3))
def test_sound_sensors_have_one_clock_and_one_set_of_axes(seed):
    force, rate = swinging(seed=seed, kicks=1e-3)
    swings = found(force, rate)
    assert swings.kind == DELIVERED
    assert swings.one_set_of_axes
    assert axes_check(swings, bridge(force), bridge(rate, 1)).passed


@pytest.mark.parametrize("late_s", [-1.0, -0.2, 0.06, 0.5])
def test_lag_of_any_size_is_what_was_planted(late_s):
    swings = found(*swinging(late_s, kicks=1e-3))
    assert swings.kind == LAG
    assert swings.lag_s == pytest.approx(late_s, abs=0.021)


@pytest.mark.parametrize("deg", [-60.0, 8.0, 45.0])
def test_roll_is_what_was_planted_in_either_sensor(deg):
    force, rate = swinging(kicks=1e-3)
    for pair in ((turned(force, about_roll(deg)), rate), (force, turned(rate, about_roll(-deg)))):
        swings = found(*pair)
        assert swings.kind == ROLL
        assert np.rad2deg(swings.roll_rad) == pytest.approx(deg, abs=1.0)
        assert not axes_check(swings, bridge(force), bridge(rate, 1)).passed


@pytest.mark.parametrize("slip", [np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 1.0, -1.0]), np.eye(3)[[0, 2, 1]]])
def test_mirror_image_is_undone_by_the_correction_of_either_sensor(mini_sense, slip):
    telemetry, _ = mini_sense(3)
    force, rate = swinging(kicks=1e-3)
    for pair in ((turned(force, slip), rate), (force, turned(rate, slip))):
        swings = found(*pair)
        assert swings.kind == MIRRORED
        assert not swings.one_set_of_axes
        flight = replace(telemetry, accelerometer=pair[0], rates=pair[1])
        for one in corrections(flight, swings, None):
            assert found(one.telemetry.accelerometer, one.telemetry.rates).kind == DELIVERED


def test_a_lag_of_a_coning_vehicle_within_the_stated_clocks_is_no_roll():
    """At 30 rad/s a lag of 1.5 ms turns what cones by 2.6 deg: red only where the clocks are stated to be better."""
    force, rate = swinging(kicks=1e-3)
    w, noise = 30.0, np.random.default_rng(7)

    def coning(t, size):
        phase = w * t + 20.0 * np.sin(0.35 * t)  # 30 +/- 7 rad/s: a pure tone does not know its lag
        lateral = np.column_stack([np.zeros_like(t), np.cos(phase), np.sin(phase)])
        return size * lateral + 1e-4 * noise.standard_normal((len(t), 3))

    # F = d i W' with d > 0, and i W' of a vector that cones is opposite to it
    gyros = replace(rate, measured_sensor=coning(rate.time_s, 0.1))
    accelerometer = replace(force, measured_sensor=coning(force.time_s - 0.0015, -1.5))

    def with_clocks(sd_s):
        return found(*(replace(r, spec=replace(r.spec, time_bias_sd_s=sd_s)) for r in (accelerometer, gyros)))

    assert abs(np.rad2deg(with_clocks(0.001).roll_rad)) == pytest.approx(np.rad2deg(0.0015 * w), abs=0.5)
    assert with_clocks(0.001).kind == DELIVERED
    assert with_clocks(1e-5).kind != DELIVERED


@pytest.mark.parametrize("planted_deg", [0.0, 8.0])
def test_pitch_damping_of_a_coning_vehicle_is_no_roll(planted_deg):
    """A slow descent turns the relation by k / w, with C_mq 1.5 sd off; a turned package still shows."""
    force, rate = swinging(kicks=1e-3)
    t, speed_mps, axial_mps2 = force.time_s, 60.0, 5.0
    ca, _, _, cmq = VEHICLE.aero.at(speed_mps / 300.0, 0.0)
    vehicle = replace(VEHICLE, aero=VEHICLE.aero.scaled(cmq_shift=-0.3 - cmq))
    inertia = 0.5 * (vehicle.inertia[1, 1] + vehicle.inertia[2, 2])
    per_cmq = vehicle.mass_kg * axial_mps2 * vehicle.reference.length_m**2 / (2.0 * speed_mps * ca * inertia)
    k = per_cmq * (0.3 + 1.5 * vehicle.uncertainty.cmq)
    turning = 3.0 * t + 2.0 * np.sin(0.2 * t)
    w = 0.3 * np.exp(1j * turning) + 0.08 * np.exp(-0.9j * turning)
    pushed = 4.0j * (np.gradient(w, t) + k * w) * np.exp(1j * np.deg2rad(planted_deg))
    noise = np.random.default_rng(3)

    def body(along, lateral, sd):
        return np.column_stack([along + 0.0 * t, lateral.real, lateral.imag]) + sd * noise.standard_normal((len(t), 3))

    gyros = replace(rate, measured_sensor=body(0.3, w, 1e-3))
    accelerometer = replace(force, measured_sensor=body(-axial_mps2, pushed, 0.02))
    assert 2.5 < np.rad2deg(k / 3.0) < 12.0
    for known_mps in (speed_mps, None):
        swings = found(accelerometer, gyros, vehicle, known_mps)
        assert swings.kind == (ROLL if planted_deg else DELIVERED)
        assert np.rad2deg(swings.roll_rad) == pytest.approx(planted_deg, abs=0.5)
    # of a vehicle that hardly damps it would be a turned package
    fast = found(accelerometer, gyros, vehicle, FAST_MPS)
    assert abs(np.rad2deg(fast.roll_rad) - planted_deg) > 2.0


def test_nothing_is_said_of_a_body_that_is_not_known_or_does_not_swing():
    force, rate = swinging()
    assert found(force, rate, None) is None
    still = 1e-3 * np.random.default_rng(1).standard_normal(rate.measured_sensor.shape)
    assert found(force, replace(rate, measured_sensor=still)) is None


# ---- single faults


def test_only_what_explains_the_flight_is_ranked_and_each_source_once():
    kinds = [("a", 50.0, 1.0), ("a", 60.0, 1.0), ("b", 59.0, 1.1), ("c", 99.0, 3.0), ("d", 2.0, 1.0)]
    order = ranked([Explanation("code", name, (name,), gain, misfit) for name, gain, misfit in kinds])
    assert [(f.sources, f.gain) for f in order] == [(("a",), 60.0), (("b",), 59.0)]
    assert likeliest(order) == order


def wrong_scale(telemetry):
    record = telemetry.accelerometer
    return replace(telemetry, accelerometer=replace(record, measured_sensor=1.04 * record.measured_sensor))


def wrong_unit(telemetry):
    record = telemetry.accelerometer
    return replace(telemetry, accelerometer=replace(record, measured_sensor=record.measured_sensor / 9.80665))


def late_radar(telemetry):
    record = telemetry.radars["west"]
    return replace(telemetry, radars=telemetry.radars | {"west": replace(record, time_s=record.time_s + 0.02)})


@pytest.mark.parametrize(
    ("spoil", "code", "source"),
    [
        (wrong_scale, "scale", "accelerometer"),
        (wrong_unit, "units-and-signs", "accelerometer"),
        (late_radar, "time-bias", "west"),
    ],
)
def test_the_source_of_a_single_fault_is_named_first(mini_sense, spoil, code, source):
    telemetry, _ = mini_sense(46)
    solution = reconstruct(spoil(telemetry), FAST)
    first = isolate_faults(solution.consistency_checks, solution.left_out, solution.single_faults)[0]
    assert first.code == code
    assert first.sources[0] == source


def test_a_tracker_of_which_every_point_was_rejected_is_set_right_red_and_named(mini_sense):
    telemetry, _ = mini_sense(46)
    record = telemetry.radars["west"]
    late = replace(telemetry, radars=telemetry.radars | {"west": replace(record, time_s=record.time_s + 1.0)})
    solution = reconstruct(late, FAST)
    assert [(v.code, v.source) for v in solution.consistency_checks if not v.passed] == [("clock-corrected", "west")]
    first = isolate_faults(solution.consistency_checks, solution.left_out, solution.single_faults)[0]
    assert first.sources == ("west",)


def test_a_sound_flight_tries_nothing(mini_sense):
    telemetry, _ = mini_sense(47)
    assert reconstruct(telemetry, FAST).single_faults == ()


def test_an_angle_that_differs_between_windows_is_known_no_better_than_they_agree():
    step, sd = np.deg2rad(1.0), np.deg2rad(0.5)
    grid = np.linspace(-np.pi, np.pi, 360, endpoint=False)

    def logs(angles_deg):
        off = np.mod(grid - np.deg2rad(angles_deg)[:, None] + 0.5 * np.pi, np.pi) - 0.5 * np.pi
        return -0.5 * (off / sd) ** 2

    alike = np.array([-3.2, -2.8, -3.0, -3.0])
    angle, known = common_angle(-3.0 * step, logs(alike), step)
    assert np.mod(angle + np.pi, np.pi) == pytest.approx(np.pi - 3.0 * step, abs=1e-3)
    assert known == pytest.approx(sd / 2.0, rel=0.01)
    # of four windows that differ by 2 deg each: as of four draws of that scatter
    apart = np.array([-5.0, -3.0, -1.0, 1.0])
    angle, known = common_angle(-2.0 * step, logs(apart), step)
    assert np.mod(angle + np.pi, np.pi) == pytest.approx(np.pi - 2.0 * step, abs=1e-3)
    assert known == pytest.approx(np.deg2rad(apart).std(ddof=1) / 2.0, rel=0.01)
    assert common_angle(0.3, np.zeros((4, 360)), step) == (0.3, np.inf)

"""Parts of the reconstruction by themselves: spreads drawn, integrals, and limits that several sensors share."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from flightmodel import earth, rotations
from flightmodel.instruments import ACCELEROMETER, GnssSpec, TriadSpec
from flightmodel.telemetry import GnssRecord, TriadRecord
from flightmodel.trajectory import Trajectory, difference
from recon import estimate
from recon.consistency import source_checks
from recon.entry_density import _spread, drag_jump_check, temperature_check
from recon.estimate import Mounting, corrected_series, datum_trajectory, turned_velocity_cov
from recon.fault_isolation import _compared
from recon.imu_screening import (
    _bridges,
    _interpolation_density,
    _jumps,
    _same_side_count,
    _Unused,
    bridge,
    repeat_by_noise,
)
from recon.measurements import RADAR, gnss_instruments, magnetometer_instrument
from recon.propagation import strapdown_motion, with_disturbances, with_exact_integrals
from recon.setup import fit_start
from recon.state import States, boxplus, instrument_blocks, packed
from recon.vector_attitude import _inconsistent_sensors, compare


def spec(**more):
    return TriadSpec("accelerometer", np.zeros(3), np.eye(3), 0.05, 0.03, 1e-3, 1e-3, **more)


def test_a_bias_that_wanders_starts_as_wide_as_both_and_walks_as_a_gauss_markov_process_does():
    # increments of a stationary process of sd s over dt: 2 s^2 (1 - exp(-dt/tau)), 2 s^2 / tau a second at first
    s, tau, dt = 0.04, 50.0, 0.01
    block = instrument_blocks(ACCELEROMETER, spec(bias_wander_sd=s, bias_time_constant_s=tau))[0]
    assert block.prior_sd == pytest.approx(np.sqrt(0.03**2 + s**2))
    assert block.walk_var_per_s * dt == pytest.approx(2.0 * s**2 * (1.0 - np.exp(-dt / tau)), rel=1e-3)


def test_noise_of_samples_drives_their_integral_with_its_density():
    # the integral of rounded, noisy samples over a second, drawn: variance of noise and of a rounding, over the rate
    rng, rate, step = np.random.default_rng(1), 100.0, 0.4
    t = np.arange(0.0, 4.0, 1.0 / rate)
    x = np.round((0.05 * rng.standard_normal((len(t), 3)) + 3.0 * np.sin(2.0 * t)[:, None]) / step) * step
    made = bridge(TriadRecord(spec(resolution=step), t, x))
    signal = np.linspace(0.0, 40.0, 4000)  # so that roundings differ
    drawn = [
        np.sum(np.round((signal + 0.05 * rng.standard_normal(4000) + rng.uniform()) / step) * step - signal - 0.0)
        / rate
        for _ in range(400)
    ]
    spread = np.std([d - np.mean(drawn) for d in drawn])
    one = np.var(np.round((signal + 0.05 * rng.standard_normal(4000)) / step) * step - signal)
    assert np.median(made.density) * rate == pytest.approx(one, rel=0.1)
    assert spread > 0.0


def test_samples_moved_for_straight_joins_have_the_curve_s_integral():
    t = np.arange(0.0, 1.0, 0.05)
    curve = np.column_stack([t**2, np.sin(4.0 * t), 1.0 - 3.0 * t])
    bent = with_exact_integrals(t, curve)
    inner = slice(2, -2)
    got = np.trapezoid(bent[inner], t[inner], axis=0)
    low, high = t[inner][0], t[inner][-1]
    want = [(high**3 - low**3) / 3.0, (np.cos(4.0 * low) - np.cos(4.0 * high)) / 4.0,
            high - low - 1.5 * (high**2 - low**2)]  # fmt: skip
    plain = np.trapezoid(curve[inner], t[inner], axis=0)
    # the corner at both ends is left: a part in a few of what the lines miss
    assert abs(got[0] - want[0]) < 0.15 * abs(plain[0] - want[0])
    assert abs(got[1] - want[1]) < 0.15 * abs(plain[1] - want[1])
    assert got[2] == pytest.approx(want[2], abs=1e-12)


def test_what_a_line_misses_between_slow_samples_is_its_own_integral():
    # a parabola sampled at 5 Hz in a record of 100 Hz: the line's error over a step, squared, over the step
    t = np.concatenate([np.arange(0.0, 5.0, 0.01), 5.0 + np.arange(0.0, 4.0, 0.2)])
    x = (3.0 * (t - 6.0) ** 2)[:, None]
    usual = np.where(t < 5.0, 0.01, 0.2)
    density = _interpolation_density(x, usual)
    k = 510
    a, b = t[k], t[k + 1]
    missed = 0.5 * (b - a) * (x[k, 0] + x[k + 1, 0]) - ((b - 6.0) ** 3 - (a - 6.0) ** 3)
    assert density[k, 0] == pytest.approx(missed**2 / (b - a), rel=1e-6)
    assert (density[:400] == 0.0).all()


def test_gaps_at_one_stop_are_missed_to_one_side_all_of_them():
    t = np.arange(0.0, 10.0, 0.1)
    stop = np.zeros((100, 1), dtype=np.int64)
    for first, sign in ((10, 1), (30, 1), (50, 1), (70, -1)):
        stop[first : first + 8] = sign
    starts, ends = t[[9, 29, 49, 69, 89]], t[[18, 38, 58, 78, 94]]
    counted = _same_side_count(_Unused(t, np.full((100, 1), np.nan), stop), starts, ends)
    assert counted.ravel().tolist() == [3, 3, 3, 1, 1]


def test_jumps_of_white_noise_scatter_as_they_say():
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 30.0, 0.01)
    noise = rng.standard_normal(len(t))
    size, _ = _jumps(t, noise, 0.0)
    scatter = np.std(size[10:-10])
    # by the noise that is stated, where the record shows none
    _, stated = _jumps(t, np.zeros(len(t)), 1.0)
    assert np.median(stated) == pytest.approx(scatter, rel=0.05)
    # by the record's own, where none is stated; the widest of three medians of 200 and of 41 jumps lies higher
    _, own = _jumps(t, noise, 0.0)
    assert 1.0 < np.median(own) / scatter < 1.45


def test_a_reading_stays_where_it_is_as_often_as_noise_lets_it():
    rng, sd, step = np.random.default_rng(5), 0.03, 0.05
    column = step * np.array([0, 1, 1, 2, 0, 3])
    likely = repeat_by_noise(column.astype(float), sd)
    # a signal in the middle of a step: the share of noise that rounds to it
    assert likely == pytest.approx(np.mean(np.abs(sd * rng.standard_normal(200000)) < 0.5 * step), abs=0.005)


def test_a_stated_disturbance_keeps_its_value_for_a_second():
    one = np.full((5, 3), 1e-4)
    motion = strapdown_motion(np.arange(5.0), one, one, one, one, np.eye(3), np.eye(3))
    span = SimpleNamespace(start_s=1.0, end_s=3.0, sd_mps2=2.0, sd_radps=0.1)
    made = with_disturbances(motion, SimpleNamespace(disturbed=(span,)))
    np.testing.assert_allclose(made.force_density[:, 0], [1e-4, 4.0001, 4.0001, 1e-4, 1e-4])
    np.testing.assert_allclose(made.rate_density[:, 0], [1e-4, 0.0101, 0.0101, 1e-4, 1e-4])


def test_a_sensor_is_named_beyond_what_chance_leaves_of_all_axes():
    # two sensors of three axes at 99 %: each axis may stand off by the 0.5 % / 6 point
    limit = norm.isf(0.005 / 6.0)
    for factor, named in ((0.95, False), (1.05, True)):
        turns = {"magnetometer": np.array([0.0, factor * limit * 0.01, 0.0]), "sun1": np.zeros(3)}
        words = _inconsistent_sensors(turns, {"magnetometer": 0.01, "sun1": 0.01}, 0.99)
        assert ("magnetometer" in words) is named


def test_a_wild_point_does_not_move_the_start():
    t = 100.0 + np.arange(0.0, 6.0, 0.2)
    place, velocity = np.array([6.4e6, 1e5, -2e5]), np.array([-300.0, 800.0, 50.0])
    points = place + (t - 101.0)[:, None] * velocity
    points[3] += [5e4, -2e4, 1e4]
    at, speed = fit_start((t, points), 101.0)
    np.testing.assert_allclose(at, place, atol=1.0)
    np.testing.assert_allclose(speed, velocity, atol=1.0)


def test_whiteness_is_judged_of_residuals_over_their_own_sd():
    # a first-order process in units of an sd that changes a hundredfold from point to point: its correlation is told
    rng, n = np.random.default_rng(6), 4000
    z = np.zeros(n)
    for k in range(1, n):
        z[k] = 0.5 * z[k - 1] + rng.standard_normal()
    sd = np.where(np.arange(n) % 2, 100.0, 1.0)
    residual, covariance = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))
    residual[:, 0], covariance[:, 0, 0] = sd * z, sd**2
    variance = np.tile([1.0, np.inf, np.inf], (n, 1))
    radar = SimpleNamespace(name="radar", owner="radar", components=("range",), kind=RADAR)
    problem = SimpleNamespace(
        time_s=np.arange(n) * 1.0, node=np.arange(n), instruments=[radar],
        observed=SimpleNamespace(variance=variance, source=np.zeros(n, dtype=int), usable=np.ones(n, dtype=bool)),
    )  # fmt: skip
    innovations = SimpleNamespace(residual=residual, covariance=covariance, nis=z**2, accepted=np.ones(n, dtype=bool))
    found = {(v.code, v.source, v.component): v.value for v in source_checks(problem, innovations, 0.99)}
    assert found["whiteness", "radar", "range"] == pytest.approx(0.5, abs=0.05)


def test_a_receiver_s_arm_reads_antenna_from_accelerometer():
    antenna, accelerometer = np.array([0.3, -0.2, 0.1]), np.array([-1.0, 0.05, 0.0])
    spec = GnssSpec("receiver", antenna, 4.0, 6.0, 0.1, 0.2)
    place = np.array([[6.4e6, 1e5, 2e5], [6.4e6, 1.01e5, 2e5]])
    for one in gnss_instruments("receiver", GnssRecord(spec, np.arange(2.0), place, place), accelerometer):
        np.testing.assert_allclose(one.arm_body_m, antenna - accelerometer)


def test_a_cubic_bridge_is_a_parabola_s_own_course():
    t = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(1.5, 2.5, 0.01)])
    x = np.column_stack([3.0 * t**2 - t, 5.0 - 2.0 * t])
    times = np.linspace(1.05, 1.45, 9)
    cubic, _ = _bridges(t, x, 99, 100, times)
    np.testing.assert_allclose(cubic, np.column_stack([3.0 * times**2 - times, 5.0 - 2.0 * times]), atol=1e-9)


def test_what_a_bridge_misses_is_as_large_as_its_density_says():
    # a wandering signal with a gap of 0.1 s: the integral's miss over the root of density times length, of 40 records
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 8.0, 0.004)
        x = np.cumsum(rng.normal(0.0, 0.3, (len(t), 3)), axis=0)
        hole = (t > 4.0) & (t < 4.1)
        made = bridge(TriadRecord(spec(), t[~hole], x[~hole]))
        inside = (made.time_s >= 3.999) & (made.time_s <= 4.101)
        filled = np.trapezoid(made.measured_sensor[inside], made.time_s[inside], axis=0)
        true = (t >= 3.999) & (t <= 4.101)
        missed = filled - np.trapezoid(x[true], t[true], axis=0)
        k = int(np.searchsorted(made.time_s, 4.05))
        ratios += list(missed / np.sqrt(made.density[k] * 0.104))
    # 120 know an rms to 7 %; the worse side's scatter of 24 overlapping pieces lies above the true one
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.2


def test_a_rounded_field_errs_by_its_rounding_too():
    made = TriadSpec("magnetometer", np.zeros(3), np.eye(3), 2e-8, 0.0, 0.0, 0.0, resolution=1e-7)
    record = TriadRecord(made, np.arange(4.0), np.full((4, 3), 3e-5))
    one = magnetometer_instrument("magnetometer", record, np.full((2, 3), 3e-5), np.array([0, 2]))
    # a reading rounded to whole steps is off by anything up to half of one
    rounding = np.mean(np.linspace(-0.5e-7, 0.5e-7, 100001) ** 2)
    np.testing.assert_allclose(one.variance, 2e-8**2 + rounding, rtol=1e-4)


def test_a_solution_is_apart_beyond_what_leaving_a_source_out_costs():
    # variances of 4 without and 3 with a source: 1 is lost, so at 99.9 % of three axes 4.03 m may lie between
    def path(shift, variance):
        r = np.tile([6.5e6, shift, 0.0], (3, 1))
        cov = np.tile(variance * np.eye(9), (3, 1, 1))
        q = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
        return Trajectory("2009-08-17T12:50:00Z", np.arange(3.0), "datum", r, 0.0 * r, q, 0.0 * r, cov)

    for shift, apart in ((3.9, False), (4.2, True)):
        _, _, far = _compared(path(0.0, 3.0), path(shift, 4.0))
        assert far.tolist() == [apart] * 3


def datum_of(state, covariance, noise_sd=0.0):
    arm, t = np.array([-1.2, 0.3, 0.2]), np.arange(-2.0, 5.0)
    rate = SimpleNamespace(
        time_s=t, measured_sensor=np.array([0.6, -0.3, 0.4]) + t[:, None] * np.array([0.7, 2.0, -1.5]),
        spec=SimpleNamespace(noise_sd=noise_sd),
    )  # fmt: skip
    problem = SimpleNamespace(
        time_s=np.array([0.0, 1.0]), kept=np.array([True, True]),
        motion=SimpleNamespace(dcm_body_rate=np.eye(3), planet=earth.WGS84, clocks=True, drivers=20),
    )  # fmt: skip
    mounting = Mounting("2009-08-17T12:50:00Z", arm, rate)
    return datum_trajectory(problem, mounting, state, packed(np.tile(covariance, (2, 1, 1)))), arm


def test_the_datum_errs_as_the_moved_state_does():
    # one direction of all 29 errors: the covariance is the square of what the datum moves by
    rng = np.random.default_rng(2)
    state = States(
        np.tile([6.4e6, 1e5, 2e5], (2, 1)), np.tile([1e3, -2e3, 3e2], (2, 1)),
        np.tile(rotations.exp(np.array([0.4, -0.2, 0.9])), (2, 1)), np.zeros((2, 20)),
    )  # fmt: skip
    e = rng.normal(size=27) * np.repeat([1e-3, 1e-4, 1e-3, 1e-2, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4], 3)
    e = np.append(e, [1e-3, 1e-3])  # clocks; that of the gyros moves the datum by 2 mm/s, twenty times the rest
    made, arm = datum_of(state, np.outer(e, e) + 1e-24 * np.eye(29))
    up, down = (datum_of(boxplus(state, np.tile(s * e, (2, 1))), np.eye(29))[0] for s in (1.0, -1.0))
    moved = 0.5 * difference(up, down)[0]
    size = np.abs(moved)
    for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
        got = made.covariance[0][rows, rows]
        np.testing.assert_allclose(got, np.outer(moved[rows], moved[rows]), atol=0.02 * size[rows].max() ** 2)
    # a sample's own noise of the rate moves the datum by its lever
    quiet, _ = datum_of(state, 1e-24 * np.eye(29))
    noisy, _ = datum_of(state, 1e-24 * np.eye(29), 0.02)
    added = np.trace(noisy.covariance[0][3:6, 3:6] - quiet.covariance[0][3:6, 3:6])
    assert added == pytest.approx(2.0 * 0.02**2 * (arm @ arm), rel=1e-6)


def test_what_a_straight_line_leaves_of_an_exponential_spreads_over_the_density_s_length():
    # linearised a logarithm of 0.8 too low, 1.8 was taken for exp(0.8): 19 % of the density found
    height = np.array([130e3, 125e3, 120e3, 120e3])
    error = np.array([np.exp(0.8) - 1.8, 0.0, 0.0, 0.0]) / np.exp(0.8)
    np.testing.assert_allclose(_spread(error, height), error[0] * np.exp([0.0, -1.0, -2.0, -2.0]), rtol=1e-12)
    np.testing.assert_allclose(
        _spread(error[::-1], height[::-1]), error[0] * np.exp([-2.0, -2.0, -1.0, 0.0]), rtol=1e-12
    )


def test_a_velocity_turned_by_an_unknown_lift_is_shorter_along_its_estimate():
    # drawn across by as much as is stated and turned, not stretched: the mean square of what is missing along
    rng, speed = np.random.default_rng(3), 2000.0
    root = np.array([[40.0, 0.0], [25.0, 90.0]])
    c = rng.normal(size=(200000, 2)) @ root.T
    missing = speed - np.sqrt(speed**2 - np.sum(c**2, axis=1))
    turn = rotations.dcm_from_q(rotations.exp(np.array([0.3, -0.9, 0.4])))
    velocity, cov = turn @ [speed, 0.0, 0.0], np.zeros((3, 3))
    cov[1:, 1:] = root @ root.T
    got = turned_velocity_cov(velocity[None], (turn @ cov @ turn.T)[None])[0]
    along = turn.T @ got @ turn
    assert along[0, 0] == pytest.approx(np.mean(missing**2), rel=0.03)
    np.testing.assert_allclose(along - np.diag([along[0, 0], 0.0, 0.0]), 0.0, atol=1e-9)
    # one hardly known at all errs along as it does across
    lost = turned_velocity_cov(np.array([[1e-3, 0.0, 0.0]]), 100.0 * np.eye(3)[None])[0]
    assert lost[0, 0] == pytest.approx(100.0 * (4.0 + 4.0) / (4.0 * 2.0), rel=1e-6)


def test_two_attitudes_differ_as_both_may_err():
    # history and trajectory drawn about one attitude, each with its own covariance: the mean NEES is three
    rng, n = np.random.default_rng(8), 600
    t, one = np.arange(n) * 0.1, np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    cov = np.tile(np.eye(9) * 4e-4, (n, 1, 1))
    r = np.tile([6.5e6, 0.0, 0.0], (n, 1))
    theirs = Trajectory(
        "2009-08-17T12:50:00Z", t, "datum", r, 0.0 * r,
        rotations.boxplus(one, 0.02 * rng.standard_normal((n, 3))), 0.0 * r, cov,
    )  # fmt: skip
    history = SimpleNamespace(
        time_s=t, q_ecef_body=rotations.boxplus(one, 0.01 * rng.standard_normal((n, 3))),
        covariance=np.tile(1e-4 * np.eye(3), (n, 1, 1)), sightings=(),
    )  # fmt: skip
    found = compare(history, theirs)
    # 600 draws of three know the mean to 3 %
    assert found.mean_nees == pytest.approx(3.0, abs=0.4)
    assert found.share_inside == pytest.approx(0.9973, abs=0.005)


def test_readings_corrected_in_blocks_are_those_corrected_at_once(monkeypatch):
    rng, t = np.random.default_rng(4), np.arange(0.0, 1.0, 0.01)
    force, rate = (
        SimpleNamespace(
            time_s=t + late, in_gap=np.zeros(len(t), dtype=bool), of_bridge=np.zeros(len(t), dtype=bool),
            measured_sensor=rng.normal(size=(100, 3)),
        )
        for late in (0.0, 0.002)
    )  # fmt: skip
    turn = rotations.dcm_from_q(rotations.exp(np.array([0.1, -0.2, 0.3])))
    problem = SimpleNamespace(
        time_s=np.linspace(0.0, 1.0, 6), motion=SimpleNamespace(dcm_body_force=turn, dcm_body_rate=turn.T)
    )
    states = SimpleNamespace(sensor_errors=0.01 * rng.normal(size=(6, 20)))
    at_once = corrected_series(problem, force, rate, states)
    monkeypatch.setattr(estimate, "_BLOCK", 7)
    for whole, parts in zip(at_once, corrected_series(problem, force, rate, states), strict=True):
        np.testing.assert_array_equal(parts, whole)


@pytest.mark.parametrize("factor", [1.0, 1.5, 1.0 / 1.5])
def test_a_jump_of_the_density_by_drag_is_counted_in_what_the_air_may_change(factor):
    """Vertical speed 300 m/s: the half of a variance of 15 % that is forgotten over 5 km has 2 (1 - e^-0.12) of it."""
    rng, noise, per_s, stated_sd = np.random.default_rng(5), 0.004, 20, 0.15
    time_s = 50.0 + np.arange(60 * per_s) / per_s
    log_ratio = 0.3 + noise * rng.standard_normal(len(time_s)) + np.log(factor) * (time_s >= 80.0)
    table = pd.DataFrame(
        {"time_s": time_s, "altitude_m": 40e3 - 300.0 * (time_s - 50.0), "density_ratio": np.exp(log_ratio)}
    )
    stated = SimpleNamespace(at=lambda height_m: SimpleNamespace(density_sd=np.full(len(height_m), stated_sd)))
    check = drag_jump_check(table, stated, 0.999)
    assert check.passed == (factor == 1.0)
    if factor == 1.0:
        assert check.value < 0.2  # the air's part is many times the scatter
    else:
        weather = stated_sd**2 * (1.0 - np.exp(-600.0 / 5000.0))
        expected = abs(np.log(factor)) / np.sqrt(weather + 2.0 * noise**2 / per_s)
        assert check.value == pytest.approx(expected, rel=0.02)
        assert check.component in ("from 78 to 80 s", "from 79 to 81 s")
        # across a gap, in which the air may change more
        weather = stated_sd**2 * (1.0 - np.exp(-300.0 * 7.0 / 5000.0))
        gap = drag_jump_check(table[(time_s < 77.0) | (time_s > 83.0)], stated, 0.999)
        assert gap.value == pytest.approx(abs(np.log(factor)) / np.sqrt(weather + 2.0 * noise**2 / per_s), rel=0.03)
        # a climate's uncertainty is of the whole profile: waves are no larger
        climate = SimpleNamespace(at=lambda height_m: SimpleNamespace(density_sd=np.full(len(height_m), 0.7)))
        weather = 2.0 * 0.14**2 * (1.0 - np.exp(-600.0 / 5000.0))
        expected = abs(np.log(factor)) / np.sqrt(weather + 2.0 * noise**2 / per_s)
        assert drag_jump_check(table, climate, 0.999).value == pytest.approx(expected, rel=0.02)
    # in level flight air and readings interpolated between others change by nothing, and a tenth of a percent was 11 sd
    level = table.assign(altitude_m=40e3, density_ratio=1.0 + 0.001 * (time_s >= 80.0))
    assert drag_jump_check(level, stated, 0.999).value < 0.3
    # nothing to compare in a second's rows
    assert drag_jump_check(table[:per_s], stated, 0.999) is None


@pytest.mark.parametrize(("off_k", "layer"), [(0.0, None), (110.0, 2), (66.0, 4), (60.0, 2)])
def test_a_temperature_by_the_drag_is_judged_by_both_errors_layer_by_layer(off_k, layer):
    """The stated 200 K err by 12 K, the flown ones by 8 % of it or, in the surest layer of five, by 4 %."""
    height = np.linspace(49.9e3, 0.0, 500)
    own = np.where(height // 10e3 == 4, 0.04, 0.08)
    common = 0.05
    part = np.hypot(own / np.sqrt(2.0), np.sqrt(common**2 / 2.0))  # C_A's is counted once
    temperature = 200.0 + off_k * (height // 10e3 == layer)
    density = np.full(500, 1e-3)
    table = pd.DataFrame(
        {
            "altitude_m": height,
            "density_kgpm3": density,
            "density_sd_kgpm3": density * part,
            "pressure_pa": density * earth.MARS.gas_jpkgk * temperature,
            "pressure_sd_pa": density * earth.MARS.gas_jpkgk * temperature * part,
            "common_factor_sd": np.full(500, common),
        }
    )
    stated = SimpleNamespace(
        planet=earth.MARS,
        at=lambda height_m: SimpleNamespace(temperature_k=np.full(len(height_m), 200.0)),
        temperature_sd=lambda height_m: np.full(len(height_m), 12.0),
    )
    check = temperature_check(table, stated, 0.999)
    if layer is None:
        assert check.passed
        return
    share = 0.04 if layer == 4 else 0.08
    assert check.value == pytest.approx(off_k / np.hypot(200.0 * share, 12.0), rel=1e-6)
    # normal: 3.29 of the surest alone, 3.72 of one of five
    assert check.high == pytest.approx(3.29 if layer == 4 else 3.72, abs=0.005)
    assert check.passed == (off_k == 60.0)
    assert check.component == f"temperature at {10 * layer} to {10 * layer + 10} km"
    assert temperature_check(table[:0], stated, 0.999) is None
